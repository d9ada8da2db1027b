# SPDX-License-Identifier: Apache-2.0
"""One circle by time alone: exact, unbiased for thick tools, as good as the bound; refusals."""

from dataclasses import replace

import numpy as np
import pytest
from beam_cell import make_cell

from bench.measured_runs import NO_NOISE, PERFECT, TAUGHT
from robocal_ros.cell_sim.beams import BeamStation, Circle, RoundTool, beams_of, joints_at
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, ResidualError, TooFewSamplesError
from robocal_ros.tool.circle import (
    CircleMotion,
    CircleProblem,
    CircleState,
    classic_distances,
    closed_form,
    fit_circle,
    label_edges,
)
from robocal_ros.tool.edges import BeamEdge, BeamError, InputRule, debounced, edges_of
from robocal_ros.tool.laser_frame import JointPath

RADIUS, PERIOD, START = 0.012, 2.0, np.radians(45.0)
BETA = np.radians(92.2)
JITTER = 2e-5
UPRIGHT = np.diag([1.0, -1.0, -1.0])
TOOL = frames.transform(np.eye(3), [0.0, 0.0, 0.15])


def motion(direction: int = 1, beta: float = np.pi / 2.0) -> CircleMotion:
    return CircleMotion(RADIUS, PERIOD, START, direction, beta)


def passed(
    centre: tuple[float, float],
    rho: float,
    direction: int = 1,
    beta: float = np.pi / 2.0,
    window: tuple[float, float] = (0.0, PERIOD),
    latency: float = 0.0,
    **changes,
) -> list[BeamEdge]:
    """Edges of a cylinder whose axis circles about ``centre``; sigma is that of the jitter."""
    station = BeamStation(beams_of(np.eye(4), beta), PERFECT, NO_NOISE)
    T = frames.transform(UPRIGHT, [*centre, 0.13])
    turns = int(np.ceil((window[1] + 1.0) / PERIOD))
    move = Circle(T, np.eye(3), RADIUS, PERIOD, start_rad=START, direction=direction, **changes)
    found = []
    for i in range(turns):  # turn by turn, so that every one is at full speed
        part = max(window[0] - i * PERIOD, 0.0), min(window[1] - i * PERIOD, PERIOD)
        if part[1] > part[0]:
            tool = RoundTool.cylinder(TOOL, rho)
            edges = station.edges(tool, move, part, np.random.default_rng(0))
            found += [replace(e, time_s=e.time_s + i * PERIOD) for e in edges]
    return [replace(e, time_s=e.time_s + latency, sigma_s=JITTER) for e in found]


def jittered(edges: list[BeamEdge], rng: np.random.Generator, times: float = 1.0) -> list[BeamEdge]:
    """Stamps that scatter so many times more than their sigma says."""
    return [replace(e, time_s=e.time_s + times * JITTER * rng.standard_normal()) for e in edges]


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize("beta", [np.pi / 2.0, BETA])
@pytest.mark.parametrize(
    ("centre", "rho"),
    [((0.003, -0.004), 0.0025), ((0.006, 0.005), 0.004), ((-0.006, -0.005), 0.004)],
)
def test_without_noise_centre_radius_and_latency_are_exact(centre, rho, direction, beta):
    edges = passed(centre, rho, direction, beta, latency=0.007)
    found = fit_circle(motion(direction, beta), edges)
    assert found.centre == pytest.approx(centre, abs=1e-10)
    assert found.rho == pytest.approx([rho, rho], abs=1e-10)
    assert found.latency_s == pytest.approx(0.007, abs=1e-8)


@pytest.mark.parametrize(
    ("centre", "rho", "bias_mm"),
    [((0.003, -0.004), 0.0025, (0.07, -0.10)), ((0.006, 0.005), 0.004, (0.54, 0.39))],
)
def test_the_classic_method_is_biased_as_published(centre, rho, bias_mm):
    found = fit_circle(motion(), passed(centre, rho), "classic")
    assert 1e3 * (found.centre - centre) == pytest.approx(bias_mm, abs=0.005)
    assert found.covariance is None


def test_the_classic_method_is_exact_for_a_thin_tool():
    found = fit_circle(motion(beta=BETA), passed((0.006, 0.005), 2e-4, beta=BETA), "classic")
    # The bias is of second order in the radius: 0.56 mm at 4 mm.
    assert found.centre == pytest.approx((0.006, 0.005), abs=2.0 * 5.6e-4 * (0.2 / 4.0) ** 2)


def test_ignoring_the_beams_angle_costs_what_is_said():
    """0.19 mm at 2.2 deg for 5 mm."""
    edges = passed((0.0, 0.005), 2e-4, beta=BETA)
    square = fit_circle(motion(), edges, "classic")
    assert 1e3 * abs(square.centre[0]) == pytest.approx(0.19, abs=0.005)
    with pytest.raises(ResidualError):  # eight edges see that the beams are not at a right angle
        fit_circle(motion(), edges)


@pytest.mark.parametrize(
    "window", [(0.0, PERIOD), (0.31, 0.31 + PERIOD), (0.1, 0.1 + 2.6 * PERIOD)]
)
def test_any_whole_turn_serves_and_several_too(window):
    edges = passed((0.004, -0.005), 0.003, window=window)
    found = fit_circle(motion(), edges)
    assert found.centre == pytest.approx((0.004, -0.005), abs=1e-10)


def test_a_first_edge_may_be_a_restore():
    """The circle begins within the x-beam's shadow."""
    edges = passed((-0.006, -0.005), 0.004)
    assert not next(e for e in edges if e.beam == "x").blocked
    assert fit_circle(motion(), edges).centre == pytest.approx((-0.006, -0.005), abs=1e-10)


def test_shadows_of_both_beams_may_overlap():
    edges = passed((0.006, 0.005), 0.004)
    order = "".join(e.beam for e in edges)
    assert "xyx" in order or "yxy" in order  # one beam's edge within the other's shadow
    assert fit_circle(motion(), edges).centre == pytest.approx((0.006, 0.005), abs=1e-10)


def test_closed_form_alone_is_exact_and_has_no_bias():
    """500 runs with 20 us jitter: mean within 4 standard errors, spread about 0.4 um."""
    edges, m, rng = passed((0.006, 0.005), 0.004), motion(), np.random.default_rng(2)
    found = [m.centre(closed_form(m, label_edges(m, jittered(edges, rng)))[0]) for _ in range(500)]
    error = np.array(found) - (0.006, 0.005)
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * error.std(axis=0) / np.sqrt(500.0))
    assert np.all(error.std(axis=0) < 0.5e-6)


@pytest.mark.parametrize("latency", [None, 0.0])
def test_best_attains_the_bound_and_says_it(latency):
    edges, m, rng = passed((0.006, 0.005), 0.004, beta=BETA), motion(beta=BETA), None
    rng = np.random.default_rng(7)
    found = [fit_circle(m, jittered(edges, rng), latency_s=latency) for _ in range(500)]
    error = np.array([f.centre for f in found]) - (0.006, 0.005)
    bound = fit_circle(m, edges, latency_s=latency).covariance
    assert np.all(np.abs(error.mean(axis=0)) < 4.0 * error.std(axis=0) / np.sqrt(500.0))
    assert np.all(error.std(axis=0) < 1.1 * np.sqrt(np.diag(bound)))
    squared = [e @ np.linalg.solve(f.covariance, e) for e, f in zip(error, found, strict=True)]
    assert np.sum(squared) == pytest.approx(1000.0, abs=4.0 * np.sqrt(2000.0))
    assert (found[0].latency_sigma_s is None) == (latency is not None)


def test_edges_that_scatter_more_than_told_widen_all_that_is_told_once():
    """Five times over twelve turns: the scatter is found from 91 residuals, so that a squared error
    over its covariance is n F(n, 91) (96 - 5 unknowns), of mean n 91 / 89 for n numbers.
    """
    m, late, centre, rho, runs = motion(beta=BETA), 0.007, (0.006, 0.005), 0.004, 300
    edges = passed(centre, rho, beta=BETA, window=(0.0, 12.0 * PERIOD), latency=late)
    free, random = len(edges) - 5, np.random.default_rng(11)
    squared = {"centre": 0.0, "latency": 0.0, "radius": 0.0}
    for _ in range(runs):
        found = fit_circle(m, jittered(edges, random, times=5.0))
        off = found.centre - centre
        squared["centre"] += off @ np.linalg.solve(found.covariance, off)
        squared["latency"] += ((found.latency_s - late) / found.latency_sigma_s) ** 2
        off = found.rho - rho
        squared["radius"] += off @ np.linalg.solve(found.estimate.covariance[2:4, 2:4], off)
    for name, count in (("centre", 2), ("latency", 1), ("radius", 2)):
        mean, spread = count * free / (free - 2), np.sqrt(2.0 * count * (free + count) / free)
        wanted = pytest.approx(runs * mean, abs=4.0 * np.sqrt(runs) * spread)
        assert squared[name] == wanted, name


@pytest.mark.parametrize("direction", [1, -1])
def test_jacobian_is_that_of_the_residual(direction):
    m = motion(direction, BETA)
    edges = label_edges(m, passed((0.005, -0.004), 0.003, direction, BETA))
    problem = CircleProblem(m, edges)
    state = CircleState(np.array([-0.0041, 0.0052]), np.array([0.0031, 0.0029]), 1e-3)
    _, J = problem.linearise(state)
    for i, h in enumerate([1e-8] * 4 + [1e-7]):
        step = h * np.eye(5)[i]
        up = problem.linearise(problem.retract(state, step))[0]
        down = problem.linearise(problem.retract(state, -step))[0]
        assert J[:, 0, i] == pytest.approx((up - down)[:, 0] / (2.0 * h), rel=1e-5, abs=1e-2)


def test_radius_of_the_circle_only_scales():
    """R is not seen by times: the same edges with a circle twice as large give all twice."""
    edges = passed((0.004, -0.005), 0.003)
    one, two = (fit_circle(replace(motion(), radius_m=R), edges) for R in (RADIUS, 2.0 * RADIUS))
    assert two.centre == pytest.approx(2.0 * one.centre, abs=1e-10)
    assert two.misfit_m == pytest.approx(0.0, abs=1e-9)


def test_turning_the_station_changes_nothing():
    """The same circle, beams exchanged by a quarter turn: the centre turns with them."""
    here = fit_circle(motion(), passed((0.004, -0.005), 0.003))
    turned = passed((0.005, 0.004), 0.003)
    there = fit_circle(motion(), turned)
    assert there.centre == pytest.approx([-here.centre[1], here.centre[0]], abs=1e-10)


def edge_list() -> list[BeamEdge]:
    return passed((0.002, -0.003), 0.002)


def without(i: int) -> list[BeamEdge]:
    return [e for k, e in enumerate(edge_list()) if k != i]


def test_seven_edges_are_refused():
    for i in range(8):
        with pytest.raises(BeamError, match=r"edges, 4 are needed|is (broken|restored) twice"):
            fit_circle(motion(), without(i))


def test_nine_edges_are_refused_where_the_ninth_fits_no_turn():
    edges = edge_list()
    last = edges[-1]
    extra = BeamEdge(last.beam, not last.blocked, last.time_s + 0.05, JITTER)
    with pytest.raises(ResidualError, match="miss a circle at constant speed"):
        fit_circle(motion(), [*edges, extra])
    with pytest.raises(BeamError, match="twice"):
        fit_circle(motion(), [*edges, replace(last, time_s=last.time_s + 0.05)])


def test_a_dead_beam_and_a_missed_one_are_refused():
    with pytest.raises(BeamError, match="beam y was never broken"):
        fit_circle(motion(), [e for e in edge_list() if e.beam == "x"])
    with pytest.raises(BeamError, match=r"beam x has 2 edges|beam x was never"):
        fit_circle(motion(), passed((0.0, 0.0105), 0.002))


def test_a_speed_that_is_not_constant_is_refused():
    edges = passed((0.002, -0.003), 0.002, ripple=0.2, ripples=1)
    with pytest.raises(ResidualError, match="speed not constant: record joints"):
        fit_circle(motion(), edges)


def test_the_robots_scatter_alone_is_not_refused():
    """0.01 mm at each edge, chi-square at 99.9 %: of 400 circles 0.4 are refused, and five only
    once in ten thousand such tests.
    """
    random, refused = np.random.default_rng(8), 0
    for _ in range(400):
        centre, rho = random.uniform(-0.006, 0.006, 2), 0.004
        edges = scattered(exact_edges(centre, rho), centre, rho, random)
        try:
            fit_circle(motion(), edges)
        except ResidualError:
            refused += 1
    assert refused <= 4


def exact_edges(centre: np.ndarray, rho: float) -> list[tuple[str, bool, float]]:
    """Beam, state and angle theta of the edges, by hand: where the axis is rho from a beam."""
    found = []
    for beam, d in (("x", centre[1]), ("y", centre[0])):
        for side in (-1.0, 1.0):
            w = (side * rho - d) / RADIUS
            for psi in (np.arcsin(w), np.pi - np.arcsin(w)):
                theta = psi if beam == "x" else 0.5 * np.pi - psi
                rising = np.cos(psi) * (1.0 if beam == "x" else -1.0) > 0.0
                found.append((beam, bool(rising == (side < 0.0)), theta))
    return found


def scattered(edges, centre, rho, random) -> list[BeamEdge]:
    """Stamps of a robot that is 0.01 mm off, across the beam, at each edge, and of the jitter."""
    made, rate = [], 2.0 * np.pi / PERIOD
    for beam, blocked, theta in edges:
        across = abs(np.cos(theta) if beam == "x" else np.sin(theta)) * RADIUS * rate
        late = 1e-5 / across * random.standard_normal() + JITTER * random.standard_normal()
        time = ((theta - START) % (2.0 * np.pi)) / rate + late
        made.append(BeamEdge(beam, blocked, time, JITTER))
    return made


def test_an_inverted_input_is_refused():
    inverted = [replace(e, blocked=not e.blocked) for e in edge_list()]
    with pytest.raises(BeamError, match="polarity"):
        fit_circle(motion(), inverted)


def test_the_classic_distances_are_the_arcs_of_the_source():
    """Eq. 4-8, 4-9 by hand: four mid-times, arcs as shares of the turn."""
    m, edges = motion(), edge_list()
    middle = {b: [] for b in "xy"}
    for beam in "xy":
        own = [e.time_s for e in edges if e.beam == beam]
        middle[beam] = [0.5 * (own[0] + own[1]), 0.5 * (own[2] + own[3])]
    # From 45 deg: y (90), x (180), y (270), x (360): arcs 2, 3 between, then 4.
    y1, x1, y2, x2 = middle["y"][0], middle["x"][0], middle["y"][1], middle["x"][1]
    arcs = 2.0 * np.pi / PERIOD * np.array([x1 - y1, y2 - x1, x2 - y2])
    d_x = RADIUS * np.cos(0.5 * (arcs[1] + arcs[2]))
    d_y = RADIUS * np.cos(0.5 * (arcs[0] + arcs[1]))
    assert classic_distances(m, label_edges(m, edges)) == pytest.approx([d_x, d_y], abs=1e-12)


SIGMA = 2e-5


def edges(*times: float, beam: str = "x", first: bool = True) -> list[BeamEdge]:
    return [BeamEdge(beam, (i % 2 == 0) == first, t, SIGMA) for i, t in enumerate(times)]


@pytest.mark.parametrize(("time", "sigma"), [(np.nan, SIGMA), (0.1, 0.0), (0.1, np.nan)])
def test_an_edge_without_a_time_or_a_sigma_is_refused(time, sigma):
    with pytest.raises(InputError, match="both must be finite"):
        BeamEdge("x", True, time, sigma)


def test_sigma_of_a_sampled_input_is_uniform():
    assert InputRule(3e-5, 0.002).sigma_s == pytest.approx(np.hypot(3e-5, 0.002 / np.sqrt(12.0)))
    assert InputRule(3e-5).sigma_s == pytest.approx(3e-5)


def test_a_bounce_counts_from_its_first_edge_and_is_less_certain():
    kept = debounced(edges(0.1, 0.1002, 0.1003, 0.2), 5e-4)
    assert [e.time_s for e in kept] == [0.1, 0.2]
    assert [e.blocked for e in kept] == [True, False]
    assert kept[0].sigma_s == pytest.approx(np.hypot(SIGMA, 3e-4 / np.sqrt(12.0)), rel=1e-9)
    assert kept[1].sigma_s == SIGMA


def test_beams_are_debounced_apart():
    both = edges(0.1, 0.2) + edges(0.1001, 0.2001, beam="y")
    assert len(debounced(both, 5e-4)) == 4


@pytest.mark.parametrize(
    "times", [(0.1, 0.1002), tuple(0.1 + 1e-4 * np.arange(7))], ids=["double", "unsettled"]
)
def test_chatter_is_refused(times):
    with pytest.raises(BeamError, match=r"beam x chatters: \d edges within"):
        debounced(edges(*times), 5e-4)


def test_order_is_judged_within_a_beam():
    shadows = edges(0.1, 0.3) + edges(0.2, 0.4, beam="y")  # they overlap
    assert [e.time_s for e in edges_of(shadows, "x", 2)] == [0.1, 0.3]
    with pytest.raises(BeamError, match=r"beam x is broken twice, at 0\.1000 and 0\.2000 s"):
        edges_of([*edges(0.1), *edges(0.2)], "x", 2)
    with pytest.raises(BeamError, match="beam y was never broken"):
        edges_of(edges(0.1, 0.2), "y", 2)
    with pytest.raises(BeamError, match="beam x has 2 edges, 4 are needed"):
        edges_of(edges(0.1, 0.2), "x", 4)


def circle(rate_hz: float) -> tuple[JointPath, np.ndarray, np.ndarray]:
    """A path on a circle, and at some times between readings the true places and velocities."""
    cell = make_cell()
    centre = cell.pose(TAUGHT, 0.0)
    omega, radius = 0.05 / 0.012, 0.012

    def at(t: np.ndarray) -> np.ndarray:
        T = np.tile(centre, (len(t), 1, 1))
        T[:, 0, 3] += radius * np.cos(omega * t)
        T[:, 1, 3] += radius * np.sin(omega * t)
        return T

    time = np.arange(0.0, 2.0, 1.0 / rate_hz)
    path = JointPath(cell.arm, time, joints_at(cell.arm, at(time), cell.q_near))
    inside = np.linspace(0.5, 1.5, 37)
    turn = omega * inside
    velocity = omega * radius * np.column_stack([-np.sin(turn), np.cos(turn), 0.0 * turn])
    return path, at(inside), velocity


@pytest.mark.parametrize("rate_hz", [25.0, 125.0])
def test_poses_between_readings_follow_the_circle(rate_hz):
    path, wanted, velocity = circle(rate_hz)
    T, seen = path.at(np.linspace(0.5, 1.5, 37))
    # A cubic between readings h apart misses a circle by R (omega h)^4 / 384 (twice for margin).
    miss = 2.0 * 0.012 * (0.05 / 0.012 / rate_hz) ** 4 / 384.0
    assert np.abs(T[:, :3, 3] - wanted[:, :3, 3]).max() < miss + 1e-12
    assert seen[:, :3] == pytest.approx(velocity, abs=1e-3 * 0.05)


def test_readings_that_are_too_rare_or_missing_are_refused():
    slow, _, _ = circle(10.0)
    with pytest.raises(InputError, match=r"pause for 100 ms .* raise the rate of joint_states"):
        slow.at(np.array([1.05]))
    fast, _, _ = circle(125.0)
    with pytest.raises(InputError, match=r"no joint readings around the edge at 3\.0000 s"):
        fast.at(np.array([1.0, 3.0]))
    with pytest.raises(TooFewSamplesError, match="3 joint readings"):
        JointPath(fast.arm, fast.time_s[:3], fast.q[:3])
    with pytest.raises(InputError, match="not after the one before"):
        JointPath(fast.arm, fast.time_s[::-1], fast.q)
