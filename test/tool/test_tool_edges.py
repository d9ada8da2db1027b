"""Edges of a beam: bounces, order, latency; flange poses at their stamps."""

import numpy as np
import pytest
from beam_cell import make_cell

from robocal_ros.cell_sim.beams import TAUGHT
from robocal_ros.cell_sim.tool_cell import joints_at
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.tool.edges import BeamEdge, BeamError, InputRule, debounced, edges_of
from robocal_ros.tool.laser_frame import JointPath

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
