# SPDX-License-Identifier: Apache-2.0
"""A tip from touches that the session records: found, judged, kept; the golden bag again."""

import numpy as np
import pytest
from command import ROOT, beyond_rounding, robocal_json
from scipy.stats import chi2
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell

from bench.measured_runs import touching
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.session.events import ACCEPT, CLEAR_TOUCHES, SOLVE_TOUCHES, TOUCH, Command
from robocal_ros.tool.session import ToolSession

SCATTER_M = 3e-5


def touched(driver: Driver, tool: np.ndarray, count: int, tilt_rad: float = 0.45) -> None:
    """Touch a point from postures tilted all around it."""
    rng, cell = np.random.default_rng(1), driver.cell
    more = {"tilt_rad": tilt_rad, "scatter_m": SCATTER_M, "rng": rng}
    for q in touching(cell.arm, tool, cell.q_near, count, **more):
        driver.program.q = q
        driver.rest(0.5)
        taken = driver.command(Command(TOUCH, {}))
        assert taken.status is Code.ACCEPT, taken.message


@pytest.fixture
def driver(tmp_path):
    cell = noisy_cell()
    with CalibrationHistory.open(
        "K1", model_hash=cell.arm.model_hash, state_dir=tmp_path
    ) as history:
        session = ToolSession(cell.arm, history, config_of(cell), "test")
        made = Driver(session, cell, RoundTool.cylinder(TRUTH, 0.0025))
        made.history = history
        yield made


def test_a_touched_tip_is_found_and_comes_into_force(driver):
    touched(driver, TRUTH, 8)
    found = driver.command(Command(SOLVE_TOUCHES, {}))
    assert found.status is Code.ACCEPT, found.message
    assert (found.samples, found.document["touches"]) == (8, 8)
    assert driver.session.in_force.revision == 0  # solving changes nothing
    kept = driver.command(Command(ACCEPT, {"id": found.calibration_id, "by": "me"}))
    assert kept.status is Code.ACCEPT, kept.message
    tool = driver.session.current.tool
    away = tool.T_flange_tool[:3, 3] - TRUTH[:3, 3]
    # The scatter is found from 18 degrees of freedom: an F, here by its own wide bound.
    squared = away @ np.linalg.solve(tool.covariance[:3, :3], away)
    assert squared < 2.5 * chi2.ppf(0.999, 3)
    assert np.array_equal(tool.T_flange_tool[:3, :3], TAUGHT[:3, :3])  # touches tell no turn
    again = driver.command(Command(SOLVE_TOUCHES, {}))
    assert again.status is Code.TOO_FEW_SAMPLES  # they were used


def test_a_touch_while_the_robot_moves_is_refused(driver):
    driver.rest(0.5)
    driver.program.q = driver.program.q + 0.01
    driver.rest(0.1)
    moving = driver.command(Command(TOUCH, {}))
    assert moving.status is Code.BAD_INPUT
    assert "moved by" in moving.message


def test_one_posture_counts_once_and_all_can_be_forgotten(driver):
    touched(driver, TRUTH, 3)
    driver.rest(0.5)
    again = driver.command(Command(TOUCH, {}))
    assert "touch 3 is taken, in place of one from this posture" in again.message
    cleared = driver.command(Command(CLEAR_TOUCHES, {}))
    assert cleared.message == "3 touches are forgotten"


def test_touches_that_hardly_turn_are_kept_and_refused(driver):
    touched(driver, TRUTH, 6, tilt_rad=0.012)
    outcome = driver.command(Command(SOLVE_TOUCHES, {}))
    assert outcome.status in (Code.RANK_DEFICIENT, Code.TOO_FEW_SAMPLES), outcome.message


def test_a_tool_far_from_the_taught_one_is_not_proposed_as_good(driver):
    far = TRUTH.copy()
    far[:3, 3] += [0.02, 0.0, 0.0]
    touched(driver, far, 8)
    assert driver.command(Command(SOLVE_TOUCHES, {})).status is Code.LIMIT_EXCEEDED
    assert driver.command(Command(CLEAR_TOUCHES, {})).message == "0 touches are forgotten"


def test_touches_that_contradict_each_other_stay_for_others_to_be_added(driver):
    touched(driver, TRUTH, 3)
    other = TRUTH.copy()
    other[:3, 3] += [0.0, 0.006, 0.0]
    touched(driver, other, 3, tilt_rad=0.3)
    for _ in range(2):  # nothing is forgotten with the first answer
        refused = driver.command(Command(SOLVE_TOUCHES, {}))
        assert (refused.status, refused.samples) == (Code.RESIDUAL_TOO_LARGE, 6)
        assert refused.message.endswith("the 6 touches stay: add others, or clear them")
    assert driver.command(Command(CLEAR_TOUCHES, {})).message == "6 touches are forgotten"


def test_the_golden_bag_gives_its_session_again():
    document = robocal_json("replay.tool.json", "replay", ROOT / "bags" / "touches.mcap")
    assert (document["recorded"], beyond_rounding(document)) == (True, [])
    assert document["runs"][0]["touches"] == 8
    assert document["final_tool"]["revision"] == 1
