# SPDX-License-Identifier: Apache-2.0
"""A tool from sweeps through parallel beams that the session records: found, judged, kept."""

from pathlib import Path

import numpy as np
from beam_cell import make_cell
from command import beyond_rounding, robocal_json
from long_form import amount
from scipy.stats import chi2
from tool_driver import NOISE, START_NS, TAUGHT, Driver, config_of

from bench.parallel_sweeps import STATION, STRAIGHT, SweepProgram, plunge_at, upright_of
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, bent
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session.events import ACCEPT, CLEAR_SWEEPS, SOLVE_SWEEPS, SWEEP, Command
from robocal_ros.tool.edges import MOST_EDGES, EdgeSample
from robocal_ros.tool.run import ToolConfig
from robocal_ros.tool.session import ToolSession
from robocal_ros.tool.touch_points import LONGEST_NS, PLUNGE

TRUTH = bent(TAUGHT, [0.0015, -0.001, 0.0006], [0.012, 0.018, 0.0])
POLLED = TrueInput(latency_s=0.004, sample_period_s=0.002)
LATE = TrueInput(latency_s=0.02, sample_period_s=0.008)
RADIUS_M = 0.0025
LEFT_M = 0.02**2 * 0.04  # without noise: second order in the lean (0.02 rad, 40 mm)
RUNS = amount(12, 40)
ROOT = Path(__file__).parents[2]


def made(tmp_path, seed=1, noise=NOISE, source=POLLED, tool=TRUTH):
    cell = make_cell(exact=noise.step_m == 0.0, source=source, noise=noise)
    history = CalibrationHistory.open(
        f"K{seed}", model_hash=cell.arm.model_hash, state_dir=tmp_path
    )
    config = config_of(cell, points_m=(), parallel=STATION)
    driver = Driver(ToolSession(cell.arm, history, config, "test"), cell, None)
    rng = np.random.default_rng(seed)
    driver.program = SweepProgram(cell, RoundTool.cylinder(tool, RADIUS_M), rng, START_NS)
    driver.history = history
    return driver


def swept(driver, R, tip, name, x_m=None):
    driver.play(driver.program.sweep(R, tip, name, x_m))
    return driver.command(Command(SWEEP, {}))


def whole(driver):
    """All five; the flange is turned and placed as the session says."""
    for name in ("straight", "turned"):
        taken = swept(driver, STRAIGHT[name], TAUGHT[:3, 3], name)
        assert taken.status is Code.ACCEPT, taken.message
    for name, R in upright_of(taken.message).items():
        told = swept(driver, R, TAUGHT[:3, 3], name)
        assert told.status is Code.ACCEPT, told.message
    told = swept(driver, R, TAUGHT[:3, 3], PLUNGE, plunge_at(told.message))
    assert told.status is Code.ACCEPT, told.message
    return driver.command(Command(SOLVE_SWEEPS, {}))


def away(driver):
    tool = driver.session.current.tool
    T = tool.T_flange_tool
    turned = T[:3, :2].T @ TRUTH[:3, 2]
    return np.concatenate([TRUTH[:3, 3] - T[:3, 3], turned]), tool.covariance


def test_a_swept_tool_is_found_and_comes_into_force(tmp_path):
    driver = made(tmp_path)
    with driver.history:
        found = whole(driver)
        assert found.status is Code.ACCEPT, found.message
        assert found.document["method"] == "parallel beams"
        kept = driver.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"}))
        assert kept.status is Code.ACCEPT, kept.message
        error, covariance = away(driver)
        assert error @ np.linalg.solve(covariance, error) < chi2.ppf(0.999, 5)
        again = driver.command(Command(SOLVE_SWEEPS, {}))
        assert again.status is Code.TOO_FEW_SAMPLES  # they were used


def test_without_noise_only_the_sources_approximations_are_left(tmp_path):
    exact = TrueInput(jitter_s=0.0)
    driver = made(tmp_path, noise=TrueNoise(0.0, 0.0), source=exact)
    with driver.history:
        found = whole(driver)
        driver.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"}))
        error, _ = away(driver)
        # The plunge meets the beam with the edge of a flat end, which is square to the axis, so the
        # height is the tip's.
        assert np.abs(error[:3]).max() < LEFT_M
        assert np.abs(error[3:]).max() < 0.02**2


def told_m(found):
    """Of a tip: its error and sigma (3,), m."""
    error_m = 1e-3 * np.array(found.document["tcp_mm"]) - TRUTH[:3, 3]
    return error_m, 1e-3 * np.array(found.document["sigma_mm"])


def test_a_delay_of_the_input_moves_nothing_there_and_back(tmp_path):
    """24 ms: at 5 mm/s the plunge down alone reads 0.12 mm too low."""
    late = TrueInput(latency_s=0.024, jitter_s=0.0)
    driver = made(tmp_path, noise=TrueNoise(0.0, 0.0), source=late)
    with driver.history:
        found = whole(driver)
        assert found.status is Code.ACCEPT, found.message
        error_m, sigma_m = told_m(found)
        assert np.abs(error_m).max() < LEFT_M
        assert sigma_m.max() < 4e-5  # no more than without it


def test_what_is_swept_one_way_is_known_as_well_as_the_delay(tmp_path):
    """24 ms at 20 mm/s are 0.48 mm across: more than is allowed, and what is told."""
    driver = made(tmp_path, source=LATE)
    driver.program.back = False
    with driver.history:
        told = swept(driver, STRAIGHT["straight"], TAUGHT[:3, 3], "straight")
        assert "4 edges, all of one way" in told.message
        assert driver.command(Command(CLEAR_SWEEPS, {})).done
        found = whole(driver)
        error_m, sigma_m = told_m(found)
        assert np.all(np.abs(error_m[:2]) > 3e-4)
        assert np.all(np.abs(error_m[:2]) < 2.0 * sigma_m[:2])
        assert found.status is Code.RESIDUAL_TOO_LARGE
        assert "sweep there and back" in found.message


def test_a_small_delay_of_one_way_is_a_weak_answer(tmp_path):
    """5 ms at 20 mm/s: 0.1 mm, and the plunge tells the delay to as much."""
    for seed in range(4):
        driver = made(tmp_path, seed=seed)
        driver.program.back = False
        with driver.history:
            found = whole(driver)
            error_m, sigma_m = told_m(found)
            assert np.all(np.abs(error_m) < 3.0 * sigma_m)
            assert sigma_m[:2].min() > 8e-5
            assert found.status is (
                Code.ACCEPT if sigma_m.max() < 2e-4 else Code.RESIDUAL_TOO_LARGE
            )


def test_a_plunge_goes_down_and_up_on_one_way(tmp_path):
    driver = made(tmp_path)
    with driver.history:
        for name in ("straight", "turned"):
            told = swept(driver, STRAIGHT[name], TAUGHT[:3, 3], name)
        for name, R in upright_of(told.message).items():
            told = swept(driver, R, TAUGHT[:3, 3], name)
        across = swept(driver, R, TAUGHT[:3, 3], "another sweep along x")
        assert across.status is Code.BEAM_EDGES_WRONG
        assert "leave it on the same way up" in across.message
        assert swept(driver, R, TAUGHT[:3, 3], PLUNGE, plunge_at(told.message)).done


def test_sweeps_that_are_no_whole_passes_are_refused(tmp_path):
    driver = made(tmp_path)
    with driver.history:
        driver.rest(0.5)
        none = driver.command(Command(SWEEP, {}))
        assert (none.status, "no beam was broken" in none.message) == (Code.BEAM_EDGES_WRONG, True)
        samples = driver.program.sweep(STRAIGHT["straight"], TAUGHT[:3, 3], "straight")
        lost = next(s for s in samples if getattr(s, "beam", "") == "down")
        driver.play([s for s in samples if s is not lost])
        odd = driver.command(Command(SWEEP, {}))
        assert odd.status is Code.BEAM_EDGES_WRONG
        assert "3 edges of beam down" in odd.message
        assert swept(driver, STRAIGHT["straight"], TAUGHT[:3, 3], "straight").done
        early = driver.command(Command(SOLVE_SWEEPS, {}))
        assert early.message.startswith("sweeps turned, upright, upright_turned, plunge are")
        cleared = driver.command(Command(CLEAR_SWEEPS, {}))
        assert cleared.message == "1 sweeps are forgotten"


def test_passes_that_begin_with_a_restore_are_refused(tmp_path):
    """Of there and back the first and the last edge are lost: both others are of one side."""
    driver = made(tmp_path)
    with driver.history:
        samples = driver.program.sweep(STRAIGHT["straight"], TAUGHT[:3, 3], "straight")
        up, down = (
            [s for s in samples if getattr(s, "beam", "") == beam] for beam in ("up", "down")
        )
        lost = (up[0], up[-1], down[0], down[-1])
        driver.play([s for s in samples if not any(s is one for one in lost)])
        assert driver.command(Command(SWEEP, {})).status is Code.BEAM_EDGES_WRONG


def test_a_flange_that_is_turned_otherwise_is_refused_at_its_sweep(tmp_path):
    driver = made(tmp_path)
    with driver.history:
        for wrong, name in ((0.03, "straight"), (0.0, "straight"), (0.03, "turned")):
            R = frames.exp_rotation([0.0, 0.0, wrong]) @ STRAIGHT[name]
            told = swept(driver, R, TAUGHT[:3, 3], name)
            assert told.done == (wrong == 0.0), told.message
            assert wrong == 0.0 or f"sweep {name}: the flange is turned by 1.72" in told.message
        told = swept(driver, STRAIGHT["turned"], TAUGHT[:3, 3], "turned")
        assert "sweep turned (2 of 5) is taken" in told.message


def test_edges_of_other_work_are_of_no_sweep(tmp_path):
    """Of a tool that passed for days; of a sweep that nobody had taken when all was cleared."""
    driver = made(tmp_path)
    with driver.history:
        driver.rest(0.5)
        begun_ns = driver.session.newest_joints_ns
        for i in range(2 * MOST_EDGES):
            at_ns = begun_ns - 2 * LONGEST_NS + i * (LONGEST_NS // MOST_EDGES // 2)
            driver.session.add(EdgeSample(at_ns, "parallel", "up", i % 2 == 0, 0.0))
        driver.play(driver.program.sweep(STRAIGHT["straight"], TAUGHT[:3, 3], "straight"))
        assert driver.command(Command(CLEAR_SWEEPS, {})).done
        told = swept(driver, STRAIGHT["straight"], TAUGHT[:3, 3], "straight")
        assert told.samples == 8, told.message
        driver.command(Command(CLEAR_SWEEPS, {}))
        for i in range(2 * MOST_EDGES):
            at_ns = driver.session.newest_joints_ns + i
            driver.session.add(EdgeSample(at_ns, "parallel", "down", i % 2 == 0, 0.0))
        driver.rest(1e-9 * LONGEST_NS + 1.0)
        told = swept(driver, STRAIGHT["straight"], TAUGHT[:3, 3], "straight")
        assert told.samples == 8, told.message


def test_a_station_of_crossed_beams_takes_no_sweeps(tmp_path):
    driver = made(tmp_path)
    with driver.history:
        crossed = driver.session.config
        plain = ToolConfig.of_document({**crossed.document(), "parallel": None})
        session = ToolSession(driver.cell.arm, driver.history, plain, "test")
        session.submit(Command(SWEEP, {}))
        outcome = session.step(wall_ns=1)[-1]
        assert outcome.status is Code.CONFLICT
        assert ToolConfig.of_document(crossed.document()) == crossed


def test_the_stated_sigma_is_the_scatter(tmp_path):
    squared = []
    for seed in range(RUNS):
        driver = made(tmp_path, seed=seed)
        with driver.history:
            found = whole(driver)
            driver.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"}))
            error, covariance = away(driver)
            squared.append(error @ np.linalg.solve(covariance, error))
    total = float(np.sum(squared))
    low, high = chi2.ppf([1e-3, 1.0 - 1e-3], 5 * RUNS)
    assert low < total < high, total / (5 * RUNS)


def test_the_golden_bag_gives_its_session_again():
    """Its tool too: `bags/make_sweeps.py`, where an edge of the first sweep is lost."""
    document = robocal_json("replay.tool.json", "replay", ROOT / "bags" / "sweeps.mcap")
    assert (document["recorded"], beyond_rounding(document)) == (True, [])
    statuses = [c["code"] for c in document["commands"] if c["command"] == SWEEP]
    assert statuses == ["BEAM_EDGES_WRONG"] + 5 * ["ACCEPT"]
    assert document["final_tool"]["revision"] == 1
