# SPDX-License-Identifier: Apache-2.0
"""Tip and axis from a whole run, the quick check, refusals: on a simulated UR10."""

from dataclasses import replace

import numpy as np
import pytest
from beam_cell import SILENT, make_cell
from long_form import amount, more

from bench.measured_runs import (
    BETA_RAD,
    T_BASE_LASER,
    TAUGHT,
    MeasuredRun,
    RunPlan,
    ToolCell,
    laser_of,
)
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, bent
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, ResidualError
from robocal_ros.tool.circle import classic_tool, fit_circle
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise, estimate_tool, run_problem
from robocal_ros.tool.edges import BeamError
from robocal_ros.tool.judging import CheckRule, KnownTool, quick_check
from robocal_ros.tool.laser_frame import JointPath, LaserFrame
from robocal_ros.tool.run import RunTraits

TRUTH = bent(TAUGHT, [0.003, -0.002, 0.002], [0.05, -0.04, 0.0])
NOISE = TrueNoise(3e-5, 1e-5)
SAMPLED = TrueInput(latency_s=0.004, sample_period_s=0.002)
FREE = Held()
SPREAD = np.array([3e-3, 3e-3, 1.5e-3])


def rng(seed: int = 1) -> np.random.Generator:
    return np.random.default_rng(seed)


@pytest.fixture(scope="module")
def exact() -> MeasuredRun:
    """A bent cylinder without noise, with a latency."""
    cell = make_cell(source=TrueInput(latency_s=0.011, jitter_s=0.0))
    return cell.full_run(RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, rng())


def solved(run: MeasuredRun, **changes) -> object:
    settings = {
        "laser": run.cell.laser, "path": run.path, "steps": run.steps, "T_flange_tool": run.taught,
        "noise": run.cell.robot,
    } | changes  # fmt: skip
    return estimate_tool(
        settings.pop("laser"), settings.pop("path"), settings.pop("steps"),
        settings.pop("T_flange_tool"), **settings,
    )  # fmt: skip


def test_without_noise_the_tool_is_exact(exact):
    """Beams at 92.2 deg with a gap, laser axes not the base's, a constant latency."""
    found = solved(exact)
    # The cubic between joint readings 8 ms apart misses the circle by 0.05 nm; a few of those.
    assert found.tip == pytest.approx(TRUTH[:3, 3], abs=1e-8)
    assert found.axis == pytest.approx(TRUTH[:3, 2], abs=1e-6)
    assert found.latency_s == pytest.approx(0.011, abs=1e-6)
    assert found.radius == pytest.approx(np.full((3, 2), 0.0025), abs=1e-8)
    assert found.misfit_m < 1e-8


def test_the_taught_turn_about_the_axis_stays(exact):
    taught = TAUGHT @ frames.transform(frames.exp_rotation([0.0, 0.0, 0.9]), np.zeros(3))
    found = solved(exact, T_flange_tool=taught)
    between = frames.log_rotation(found.T_flange_tool[:3, :3] @ taught[:3, :3].T)
    assert between @ TAUGHT[:3, 2] == pytest.approx(0.0, abs=1e-9)
    assert found.axis == pytest.approx(TRUTH[:3, 2], abs=1e-6)


def test_the_search_may_begin_far_away(exact):
    far = bent(TAUGHT, [0.01, 0.01, -0.02], [0.2, 0.15, 0.0])
    assert solved(exact, T_flange_tool=far).tip == pytest.approx(TRUTH[:3, 3], abs=1e-8)


def test_moving_the_base_changes_nothing(exact):
    """Robot and station together at another place."""
    move = frames.transform(frames.exp_rotation([0.3, -0.8, 1.1]), [1.0, 2.0, -0.5])
    arm = replace(exact.cell.arm, T_base_root=move @ exact.cell.arm.T_base_root)
    points = exact.cell.laser.points @ move[:3, :3].T + move[:3, 3]
    path = JointPath(arm, exact.path.time_s, exact.path.q)
    here, there = solved(exact), solved(exact, path=path, laser=LaserFrame(points))
    assert there.T_flange_tool == pytest.approx(here.T_flange_tool, abs=1e-9)
    assert there.covariance == pytest.approx(here.covariance, rel=1e-5, abs=1e-22)


def test_a_rippling_speed_does_no_harm():
    cell = make_cell(plan=RunPlan(ripple=0.4))
    run = cell.full_run(RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, rng())
    assert solved(run).tip == pytest.approx(TRUTH[:3, 3], abs=1e-7)
    with pytest.raises(ResidualError, match="speed not constant: record joints"):
        fit_circle(run.commanded(0).motion, run.steps[0].edges)


def test_a_receiver_with_hysteresis_does_no_harm_beside_a_latency():
    """Off at 30 %, on at 70 % of the light: late by a depth, which a circle's speed hides."""
    cell = make_cell(source=TrueInput(latency_s=0.011, jitter_s=0.0))
    beams = tuple(replace(b, dark_at=0.3, light_at=0.7) for b in cell.station.beams)
    cell.station = replace(cell.station, beams=beams)
    run = cell.full_run(RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, rng())
    found = solved(run)
    assert found.tip == pytest.approx(TRUTH[:3, 3], abs=1e-7)
    assert found.latency_s == pytest.approx(0.011, abs=1e-6)
    assert found.estimate.state.depth == pytest.approx(beams[0].threshold(0.7), abs=1e-7)


def test_a_beam_that_switches_off_its_middle_moves_the_height_unless_its_reach_is_known():
    cell = make_cell()
    beams = tuple(replace(b, dark_at=0.3, light_at=0.3) for b in cell.station.beams)
    cell.station = replace(cell.station, beams=beams)
    reach = beams[0].threshold(0.3)
    run = cell.full_run(RoundTool.cylinder(TRUTH, 0.0025), TAUGHT, rng())
    off = solved(run).tip - TRUTH[:3, 3]
    assert off @ TRUTH[:3, 2] == pytest.approx(reach, abs=1e-7)
    known = replace(cell.laser, reach=np.full(2, reach))
    assert solved(run, laser=known).tip == pytest.approx(TRUTH[:3, 3], abs=1e-7)


def test_a_torch_of_two_radii_is_no_harder():
    cell = make_cell()
    run = cell.full_run(RoundTool.torch(TRUTH, 0.0006, 0.004), TAUGHT, rng())
    found = solved(run)
    assert found.tip == pytest.approx(TRUTH[:3, 3], abs=1e-7)
    assert found.radius[:2, 0] == pytest.approx([0.0006, 0.004], abs=1e-7)


def test_a_cone_is_exact_with_its_taper_and_nearly_so_without():
    """Without it the tilted circles are off by k rho tan(tilt) each; upright that vanishes."""
    taper, cell = 0.04, make_cell()
    run = cell.full_run(RoundTool.cone(TRUTH, 0.001, taper), TAUGHT, rng())
    known = solved(run, taper=taper)
    assert known.tip == pytest.approx(TRUTH[:3, 3], abs=1e-8)
    assert known.axis == pytest.approx(TRUTH[:3, 2], abs=1e-6)
    unknown = solved(run)
    tilt = np.arccos(TRUTH[2, 2])
    limit = taper * np.tan(tilt) * (taper * 0.05) / 0.05
    assert np.linalg.norm(unknown.axis - TRUTH[:3, 2]) < 1.5 * limit
    assert np.linalg.norm(unknown.tip - TRUTH[:3, 3]) < 5e-6


@pytest.mark.parametrize("taper", [0.0, 0.03])
def test_jacobian_is_that_of_the_residual(exact, taper):
    problem, state = run_problem(
        exact.cell.laser, exact.path, exact.steps, TAUGHT, SILENT, taper, FREE
    )
    count = len(problem.names)
    sizes = np.full(count, 1e-3)
    sizes[3:5] = 0.02
    state = problem.retract(state, sizes * rng(4).standard_normal(count))
    _, J = problem.linearise(state)
    for i, name in enumerate(problem.names):
        turned = name.startswith("laser")
        if taper and turned:
            continue  # that a turned beam touches a cone elsewhere is left out: of second order
        step = 1e-6 * np.eye(count)[i]
        up = problem.linearise(problem.retract(state, step))[0]
        down = problem.linearise(problem.retract(state, -step))[0]
        numeric = problem.sigma_m * (up - down)[:, 0] / 2e-6
        # So is what a turned beam does to a plunge beside it: tilt x distance / beam's length.
        near = np.where(turned & (problem.circle < 0), 0.1 * 0.01 / 0.1, 1e-6)
        assert np.all(np.abs(problem.sigma_m * J[:, 0, i] - numeric) < near), name


def noisy_cell(laser_sigma: float = 0.0) -> ToolCell:
    cell = make_cell(exact=False, source=SAMPLED, noise=NOISE)
    cell.laser = laser_of(cell.station, laser_sigma)
    return cell


def test_errors_are_what_the_covariance_says():
    """Chi-square of five degrees of each run with noise, sampled input and drawn laser points."""
    squared, tips, bound = [], [], []
    sigma, runs = 2.2e-5, amount(25, 60)
    for seed in range(runs):
        random, cell = rng(seed), noisy_cell()
        points = cell.laser.points
        across = np.repeat(cell.laser.normals, 2, axis=0) * random.standard_normal((4, 1))
        up = cell.up * random.standard_normal((4, 1))
        cell.laser = LaserFrame(points + sigma * (across + up), sigma)
        tool = bent(
            TAUGHT, random.uniform(-1.0, 1.0, 3) * SPREAD, [*random.uniform(-0.04, 0.04, 2), 0.0]
        )
        found = cell.full_run(RoundTool.cylinder(tool, 0.0025), TAUGHT, random).estimate(FREE)
        error = found.tip - tool[:3, 3]
        lean = found.T_flange_tool[:3, :2].T @ (found.axis - tool[:3, 2])
        both = np.concatenate([error, lean])
        squared.append(both @ np.linalg.solve(found.covariance, both))
        tips.append(error)
        bound.append(np.trace(found.covariance[:3, :3]))
    assert np.sum(squared) == pytest.approx(5.0 * runs, abs=4.0 * np.sqrt(10.0 * runs))
    rms = np.sqrt(np.mean(np.sum(np.square(tips), axis=1)))
    assert rms == pytest.approx(np.sqrt(np.mean(bound)), rel=4.0 / np.sqrt(6.0 * runs))


@pytest.mark.parametrize("step_m", [1e-7, *more(3e-5)])
def test_edges_that_scatter_more_than_told_widen_all_that_is_told_once(step_m):
    """Three times, over the runs; the scatter is found from about 20 residuals, so that a squared
    error over its covariance is n F(n, 20), of mean n 20 / 18 for n numbers.
    """
    runs, free, true = amount(16, 60), 20, bent(TAUGHT, [0.002, -0.001, 0.001], [0.02, -0.01, 0.0])
    squared = {"tool": 0.0, "latency": 0.0, "radius": 0.0}
    for seed in range(runs):
        cell = make_cell(exact=False, noise=TrueNoise(step_m, 6e-6))
        cell.robot = RobotNoise(step_m, 2e-6)
        run = cell.full_run(RoundTool.cylinder(true, 0.0025), TAUGHT, rng(seed))
        found = run.estimate(FREE)
        lean = found.T_flange_tool[:3, :2].T @ (found.axis - true[:3, 2])
        off = np.append(found.tip - true[:3, 3], lean)
        squared["tool"] += off @ np.linalg.solve(found.covariance, off)
        squared["latency"] += (found.latency_s / found.latency_sigma_s) ** 2
        sigma = RunTraits.of(found, ["low", "high", "upright"], 125.0).radius_sigma_m
        squared["radius"] += np.sum((found.radius - 0.0025) ** 2) / sigma**2
    for name, count in (("tool", 5), ("latency", 1), ("radius", 6)):
        mean, spread = count * free / (free - 2), np.sqrt(2.0 * count * (free + count) / free)
        wanted = pytest.approx(runs * mean, abs=4.0 * np.sqrt(runs) * spread)
        assert squared[name] == wanted, name


def test_the_classic_method_is_worse_for_a_thick_bent_tool():
    """Both see the same tool, exactly timed; the classic axis is off by its bias over 50 mm."""
    cell = make_cell()
    tool = RoundTool.cylinder(bent(TAUGHT, [0.003, 0.0025, 0.0], [0.04, -0.04, 0.0]), 0.004)
    run = cell.full_run(tool, TAUGHT, rng(), "classic")
    plunge = np.concatenate(
        [run.path.at(np.array([e.time_s for e in s.edges]))[0][:, :3, 3] for s in run.steps[3:]]
    )
    R = run.commanded(2).T_base_centre[:3, :3]
    classic = classic_tool(cell.laser, (run.commanded(0), run.commanded(1)), R, plunge, TAUGHT)
    best = solved(run)
    axis = tool.T_flange_tool[:3, 2]
    assert np.linalg.norm(best.axis - axis) < 1e-6
    assert 1e-4 < np.linalg.norm(classic[:3, 2] - axis) < 0.02
    assert classic[:3, 3] == pytest.approx(tool.T_flange_tool[:3, 3], abs=1e-3)


def test_missing_motions_are_named(exact):
    low, high, upright, *plunges = exact.steps
    with pytest.raises(RankDeficientError, match="no plunge"):
        solved(exact, steps=[low, high, upright])
    with pytest.raises(RankDeficientError, match="no circle"):
        solved(exact, steps=plunges)
    with pytest.raises(RankDeficientError, match="second circle at least 5 mm lower"):
        solved(exact, steps=[low, *plunges])
    held = Held(along_m=0.005)
    assert solved(exact, steps=[low, high], held=held).axis == pytest.approx(TRUTH[:3, 2], abs=1e-6)


def test_an_axis_in_the_beam_plane_is_refused(exact):
    lying = TAUGHT @ frames.transform(frames.exp_rotation([1.2, 0.0, 0.0]), np.zeros(3))
    with pytest.raises(RankDeficientError, match="until the tool stands upright"):
        solved(exact, T_flange_tool=lying)


def test_lost_and_exchanged_edges_are_refused_by_step(exact):
    low, *rest = exact.steps
    lost = BeamStep("low", "circle", low.edges[:3] + low.edges[4:])
    with pytest.raises(BeamError, match=r"low: beam [xy] (is|has)"):
        solved(exact, steps=[lost, *rest])
    own = [e for e in low.edges if e.beam == "x"]
    pair = BeamStep("low", "circle", [e for e in low.edges if e not in own[2:]])
    with pytest.raises(BeamError, match="low: beam x has 2 edges, 4 are needed"):
        solved(exact, steps=[pair, *rest])
    plunge = exact.steps[-1]
    inverted = [replace(e, blocked=not e.blocked) for e in plunge.edges]
    with pytest.raises(BeamError, match="while the tool moved"):
        solved(exact, steps=[*exact.steps[:-1], BeamStep("plunge", "plunge", inverted)])


def test_a_robot_moved_by_hand_and_another_station_are_refused(exact):
    q = exact.path.q.copy()
    middle = exact.moves[2].window[0] - 0.3
    q[exact.path.time_s > middle, 0] += 0.002  # 1.6 mm at the station, not seen by the edges
    with pytest.raises(ResidualError, match="moved by hand in between"):
        solved(exact, path=JointPath(exact.cell.arm, exact.path.time_s, q))
    turned = frames.transform(frames.exp_rotation([0.0, 0.0, 0.3]), np.zeros(3))
    away = exact.cell.laser.points - T_BASE_LASER[:3, 3]
    other = LaserFrame(away @ turned[:3, :3].T + T_BASE_LASER[:3, 3])
    with pytest.raises((ResidualError, BeamError)):
        solved(exact, laser=other)


def shaken(run: MeasuredRun, seed: int) -> JointPath:
    """The run's path as an encoder of 4e-6 rad reads it."""
    q = run.path.q + 4e-6 * rng(seed).standard_normal(run.path.q.shape)
    return JointPath(run.cell.arm, run.path.time_s, q)


def test_a_held_orientation_that_shakes_is_in_the_derivative_by_latency(exact):
    path, noise = shaken(exact, 1), RobotNoise(NOISE.step_m, NOISE.edge_m)
    problem, start = run_problem(exact.cell.laser, path, exact.steps, exact.taught, noise)
    column, step = problem.names.index("latency"), np.zeros(len(problem.names))
    step[column] = 1e-7
    ahead, behind = (problem.linearise(problem.retract(start, s))[0] for s in (step, -step))
    wanted = (ahead - behind)[:, 0] / 2e-7
    found = problem.linearise(start)[1][:, 0, column]
    assert found == pytest.approx(wanted, abs=1e-5 * np.abs(wanted).max())


@pytest.mark.parametrize("count", [2, 5])
def test_noisy_readings_do_not_end_the_search_early(exact, count):
    """Two circles alone tell latency and hysteresis apart by the prior only."""
    noise = RobotNoise(NOISE.step_m, NOISE.edge_m)
    for seed in range(20):
        held = Held(along_m=5e-3) if count == 2 else FREE
        found = solved(
            exact, path=shaken(exact, seed), steps=exact.steps[:count], noise=noise, held=held
        )
        assert np.linalg.norm(found.tip - TRUTH[:3, 3]) < 5 * np.sqrt(
            np.trace(found.covariance[:3, :3])
        )


def test_joint_states_that_stop_are_refused(exact):
    cut = exact.path.time_s < exact.moves[2].window[0] + 0.2
    path = JointPath(exact.cell.arm, exact.path.time_s[cut], exact.path.q[cut])
    with pytest.raises(InputError, match="no joint readings around the edge"):
        solved(exact, path=path)


def checked(tool: np.ndarray, seed: int, limit_m: float = 2e-4):
    cell = noisy_cell()
    run = cell.quick_run(RoundTool.cylinder(tool, 0.0025), TAUGHT, rng(seed))
    rule, noise = CheckRule(limit_m), RobotNoise(3e-5, 1e-5)
    return quick_check(cell.laser, run.path, run.steps, KnownTool(TAUGHT), rule, noise=noise)


def test_a_quick_check_measures_the_deviation():
    tool = bent(TAUGHT, [0.0004, -0.0003, 0.0002], [0.0, 0.0, 0.0])
    found = checked(tool, 1)
    error = found.deviation - [0.0004, -0.0003, 0.0002]
    assert error @ np.linalg.solve(found.covariance, error) < 21.1  # 1e-4 of chi-square with 3
    assert found.answer == "recalibrate"
    lateral = np.hypot(*found.deviation[:2])
    assert found.tilt_rad == pytest.approx(np.arctan2(lateral, 0.15))


def test_a_quick_check_is_wrong_as_rarely_as_it_says():
    """At the limit a pass or a recalibration is wrong half of the time each: 5 % at most."""
    runs, others = amount(20, 60), amount(3, 10)
    at_limit = [checked(bent(TAUGHT, [2e-4, 0.0, 0.0], [0, 0, 0]), i).answer for i in range(runs)]
    for answer in ("pass", "recalibrate"):
        assert at_limit.count(answer) <= runs * 0.05 + 4.0 * np.sqrt(runs * 0.05 * 0.95)
    assert {checked(TAUGHT, i).answer for i in range(others)} == {"pass"}
    moved = bent(TAUGHT, [4e-4, 0.0, 0.0], [0, 0, 0])
    assert {checked(moved, i).answer for i in range(others)} == {"recalibrate"}
    assert checked(bent(TAUGHT, [2e-4, 0, 0], [0, 0, 0]), 0, 2.05e-4).answer == "cannot tell"


def test_the_station_of_the_tests_is_not_square():
    assert laser_of(make_cell().station).beam_angle_rad == pytest.approx(BETA_RAD)
