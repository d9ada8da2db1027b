# SPDX-License-Identifier: Apache-2.0
"""The maintenance of a cell in closed loop, in one process: real sessions, simulated cell."""

import re
import shutil
from copy import deepcopy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from long_form import more
from maintained_cell import POSES, TOLERANCE_M, MaintainedCell
from tool_driver import TAUGHT, TRUTH, Driver, config_of, noisy_cell

from robocal_ros.cell_sim import cell as simulated
from robocal_ros.cell_sim.beams import RoundTool, bent
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError, StaleError
from robocal_ros.history import history_records
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    LASER_FRAME,
    THERMAL,
    TOOL,
    CalibrationState,
    Proposal,
)
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.accuracy import AcceptBounds, Times, ToolRecord
from robocal_ros.maintenance.mover import STATION
from robocal_ros.session.events import ACCEPT, REJECT, ROLLBACK, Command, bring_into_force
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.session import ThermalSession
from robocal_ros.thermal.tracking import DriftProcess
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.session import ToolSession

GAP_S = 240.0
EVERY_S, HALF_S = 300.0, 29.0
KELVIN, HOT_KELVIN = 10.0, 40.0
HEALTHY = RoundTool.cylinder(TAUGHT, 0.0025)
BEYOND = 16.3  # chi-square of 3 unknowns, one in a thousand


def shipped(node: str) -> dict[str, Any]:
    """A node's parameters as its file in config/ has them."""
    file = Path(__file__).parents[2] / "config" / f"{node}.yaml"
    return yaml.safe_load(file.read_text())[f"/**/{node}"]["ros__parameters"]


@dataclass(frozen=True)
class Kept:
    """A state folder, and how far the cell had come; each test goes on with a copy of its own."""

    folder: Path
    now_s: float
    result: Any = None
    rng: Any = None  # of its measurements, which go on

    def opened(self, folder: Path) -> CalibrationHistory:
        shutil.copytree(self.folder, folder, dirs_exist_ok=True)
        return CalibrationHistory.open("K1", state_dir=folder)


@pytest.fixture(scope="module")
def captured(tmp_path_factory) -> Kept:
    """A cell whose cold reference is captured, and whose healthy tool was measured."""
    folder = tmp_path_factory.mktemp("captured")
    with CalibrationHistory.open("K1", state_dir=folder) as opened:
        station = noisy_cell()
        session = ToolSession(station.arm, opened, config_of(station), "test")
        assert Driver(session, station, HEALTHY).measure("reference").done
        cell = MaintainedCell(opened)
        cell.capture_reference()
    return Kept(folder, cell.now_s)


@pytest.fixture
def history(captured, tmp_path):
    with captured.opened(tmp_path) as opened:
        yield opened


@pytest.fixture
def warm(history, captured):
    """Makes the cell with a bent tool after three hours of work; takes bounds."""

    def made(
        kelvin: float = KELVIN,
        poses: np.ndarray = POSES,
        times: Times = Times(),  # noqa: B008 (frozen)
        **bounds: Any,
    ) -> MaintainedCell:
        config = {"poses": poses, "bounds": AcceptBounds(**bounds), "times": times}
        cell = MaintainedCell(history, TRUTH, from_s=captured.now_s, **config)
        cell.production(3.0, kelvin)
        return cell

    return made


@pytest.fixture(scope="module")
def measured(captured, tmp_path_factory) -> Kept:
    """After a cycle of a warm robot with a bent tool: both candidates wait."""
    folder = tmp_path_factory.mktemp("measured")
    with captured.opened(folder) as opened:
        cell = MaintainedCell(opened, TRUTH, from_s=captured.now_s)
        cell.production(3.0, KELVIN)
        result = cell.maintain("c1", GAP_S)
        assert cell.accuracy().level is AccuracyLevel.DEGRADED
    return Kept(folder, cell.now_s, result)


@pytest.fixture
def waiting(measured, tmp_path):
    """The cell in which both candidates wait, and the cycle that brought them."""
    with measured.opened(tmp_path / "waiting") as opened:
        cell = MaintainedCell(opened, TRUTH, from_s=measured.now_s)
        cell.production(0.1, KELVIN)
        yield cell, measured.result


def true_error_m(cell: MaintainedCell) -> np.ndarray:
    """(m,) distance of the true tip from where model and tool in force have it."""
    in_force, tool = cell.thermal.current.arm, cell.session.current.tool.T_flange_tool
    q = cell.maintenance.config.poses
    believed = in_force.fk(q) @ np.append(tool[:3, 3], 1.0)
    true = cell.true.fk(q) @ np.append(cell.tool.T_flange_tool[:3, 3], 1.0)
    return np.linalg.norm((believed - true)[:, :3], axis=1)


def test_one_call_makes_a_warm_robot_with_a_bent_tool_accurate(warm):
    cell = warm(automatic=True, tool_m=0.01, tool_rad=0.1)
    before = true_error_m(cell)
    result = cell.maintain("c1", GAP_S)
    assert result.complete, result.message
    assert (result.thermal_code, result.tool_code) == (Code.ACCEPT, Code.ACCEPT), result.message
    assert result.tool_answer == "pass"
    assert result.accepted == (result.thermal_id, result.tool_id)
    after = true_error_m(cell)
    assert before.min() > 3e-3
    said = cell.accuracy()
    assert said.level is AccuracyLevel.OK, said.reason
    assert np.all(after < said.error.bound_m), (after, said.error)


PAUSE_S = 10.0


@pytest.mark.long
@pytest.mark.parametrize("tells", [False, True])
def test_a_slow_cycle_ends_as_at_full_speed(warm, tells):
    """Ways between taught poses, to the beams, through them and home; model and tool are right."""
    speed = 0.1  # at which people watch; of motions alone: test_watched_motion
    slow = Times() if tells else Times(check_s=15.0 / speed, full_s=30.0 / speed)
    cell = warm(automatic=True, tool_m=0.01, tool_rad=0.1, times=slow)
    cell.speed, cell.tells = speed, tells
    source = cell.cell.station.input  # whose delay does not go by the robot's speed
    source = replace(
        source,
        latency_s=speed * source.latency_s,
        sample_period_s=speed * source.sample_period_s,
    )
    cell.cell.station = replace(cell.cell.station, input=source)
    cell.run(1.0)
    result = cell.maintain("c1", GAP_S / speed)
    assert result.complete, result.message
    assert (result.thermal_code, result.tool_code) == (Code.ACCEPT, Code.ACCEPT), result.message
    assert result.tool_answer == "pass"
    assert np.all(true_error_m(cell) < cell.accuracy().error.bound_m)


@pytest.mark.long
@pytest.mark.parametrize("tells", [True, False])
def test_a_pause_of_ten_seconds_in_every_second_motion_of_a_cycle_is_waited_for(warm, tells):
    """In the odd ones where the robot tells its speed, in the even ones where it does not."""
    slow = Times() if tells else Times(check_s=60.0, full_s=200.0)
    cell = warm(automatic=True, tool_m=0.01, tool_rad=0.1, times=slow)
    cell.tells = tells
    step, paused = cell.step, set()

    def pausing() -> None:
        step()
        since_s = cell.now_s - cell.sent[-1][0] if cell.sent else 0.0
        turn = len(cell.sent) % 2 == int(tells) and len(cell.sent) not in paused
        if 0.3 < since_s < PAUSE_S and turn:
            paused.add(len(cell.sent))
            cell.speed, until_s = 0.0, cell.now_s + PAUSE_S
            while cell.now_s < until_s:
                step()
            while tells and cell.speed < 1.0:  # as ur_robot_driver comes out of a pause
                cell.speed = min(cell.speed + 0.05, 1.0)
                step()
            cell.speed = 1.0

    cell.step = pausing
    result = cell.maintain("c1", 900.0)
    assert result.complete, result.message
    assert result.tool_answer == "pass"
    long = [number for number, (_, plan) in enumerate(cell.sent, 1) if plan.duration_s > 0.4]
    assert paused >= {number for number in long if number % 2 == int(tells)}
    assert len(long) > 7 + 10 + 4  # poses and home, full measurement, checks
    assert np.all(true_error_m(cell) < cell.accuracy().error.bound_m)


@pytest.mark.long
def test_gaps_that_hold_half_of_the_poses_complete_a_cycle_as_all_is_set(history, captured):
    """Gaps begin every five minutes; one that falls out does no harm."""
    cell = MaintainedCell(
        history,
        from_s=captured.now_s,
        T_base_laser=None,
        measurements=20,  # of ten in a second
        resume_within_s=shipped("maintenance_node")["resume_within_s"],
    )
    assert cell.thermal.config.cycle_timeout_s == ThermalConfig().cycle_timeout_s  # as the node's
    cell.production(3.0, KELVIN)
    for number, every_s in enumerate((EVERY_S, 2.0 * EVERY_S), start=1):
        first = cell.maintain(f"{number}a", HALF_S)
        assert first.left == ("thermal measurement, 3 poses",), first.message
        cell.production((every_s - HALF_S) / 3600.0, KELVIN)
        second = cell.maintain(f"{number}b", HALF_S)
        assert second.complete, second.message
        assert second.thermal_code in (Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN), second.message
        cell.production((EVERY_S - HALF_S) / 3600.0, KELVIN)


def test_a_cycle_that_pauses_drifts_no_more_than_a_measurement_scatters():
    """It counts as measured in its middle, half of the longest pause from its poses.

    Poses of more than two gaps are spread over the cycle, and the last gap begins within its span.
    """
    arm, q = load_robot("kr150_r3100"), simulated.poses("cycle")
    process = DriftProcess(drift_prior(arm))
    rows = arm.parameter_jacobian(q, simulated.TAUGHT[:3, 3])[:, :3]
    steady = rows @ np.sqrt(process.covariance)  # which is diagonal
    settings = shipped("maintenance_node")
    spread_s = (settings["cycle_within_s"] + HALF_S) / np.sqrt(12.0)
    for away_s in (0.5 * settings["resume_within_s"], spread_s):
        F, noise = process.transition(away_s)
        fastest = np.hypot(F[0, 1], np.sqrt(noise[0, 0]))  # of a cold robot that begins to work
        drift_mm = 1e3 * fastest * np.sqrt(np.mean(np.sum(steady**2, axis=-1)))
        assert drift_mm <= shipped("thermal_node")["sigma_mm"]


def test_without_leave_everything_is_proposed_and_nothing_changed(waiting):
    cell, result = waiting
    history = cell.history
    assert "auto_accept is off" in result.message
    assert (history.head(THERMAL).revision, history.head(TOOL).revision) == (0, 0)
    status = cell.maintenance.status(cell.now_s)
    assert (status.thermal_pending, status.tool_pending) == (result.thermal_id, result.tool_id)
    assert result.thermal_id > 0
    assert result.tool_id > 0
    again = cell.maintain("c2", GAP_S)  # the tool waits for a person: it is not measured again
    assert f"tool candidate {result.tool_id} waits" in again.message
    assert len(cell.sent) == len(cell.maintenance.config.poses) + 1
    decide = cell.maintenance.decide
    for _ in range(2):
        assert decide(ACCEPT, result.tool_id, "plc", "", cell.wall_ns).done
    assert cell.maintain("c3", GAP_S).tool_answer == "pass"


@pytest.mark.parametrize(
    ("bounds", "words"),
    [({"tool_m": 3.5e-3}, "mm from where"), ({"thermal_m": 5e-5, "tool_m": 0.01}, "commissioning")],
)
def test_what_is_beyond_the_bounds_waits(warm, bounds, words):
    """The true tool is 3.7 mm and 2.6 deg away, the true drift some hundredths of a millimetre."""
    cell = warm(automatic=True, **({"tool_rad": 0.1} | bounds))
    result = cell.maintain("c1", GAP_S)
    if "thermal_m" in bounds:
        assert "at commissioning (allowed without a person 0.05 mm)" in result.message
        assert f"tool candidate {result.tool_id} waits" in result.message.replace("tool: ", "")
        assert result.accepted == ()  # what was measured with an unknown drift waits too
    else:
        assert "mm from the taught one" in result.message or "deg from the" in result.message
        assert result.accepted == (result.thermal_id,)


def test_a_tool_that_is_measured_after_something_moved_waits(warm):
    """A robot that was pushed shows its beams a bent tool."""
    cell = warm(automatic=True, tool_m=0.01, tool_rad=0.1)
    cell.sensor_off_m = np.array([5e-3, 0.0, -4e-3])
    result = cell.maintain("c1", GAP_S)
    assert result.thermal_code is Code.SENSOR_OR_ROBOT_MOVED
    assert result.tool_code is Code.ACCEPT
    assert f"tool candidate {result.tool_id} waits" in result.message.replace("tool: ", "")
    assert result.accepted == ()


def test_a_full_measurement_of_a_healthy_tool_leaves_all_as_it_is(history):
    """Due by the calendar, of the taught tool: no candidate waits, and the line stays right."""
    cell = MaintainedCell(history, TAUGHT, poses=np.zeros((0, 6)), full_every_s=3600.0)
    commissioning = ToolSession(cell.arm, history, cell.session.config, "test")
    assert Driver(commissioning, cell.cell, cell.tool).measure("reference").done
    cell.run(0.5)
    result = cell.maintain("c1", GAP_S)
    assert (result.tool_code, result.tool_answer) == (Code.NO_SIGNIFICANT_GAIN, "pass")
    assert result.tool_found_code is Code.ACCEPT
    assert history.get(result.tool_id).code is Code.NO_SIGNIFICANT_GAIN
    assert history.pending(TOOL) == ()
    assert cell.accuracy().level is not AccuracyLevel.DEGRADED


def test_a_full_measurement_that_is_overdue_says_which_gap_would_do(history):
    """The check fits, the full measurement after it does not; in the gap that is told it does."""
    cell = MaintainedCell(history, TAUGHT, poses=np.zeros((0, 6)), full_every_s=3600.0)
    commissioning = ToolSession(cell.arm, history, cell.session.config, "test")
    assert Driver(commissioning, cell.cell, cell.tool).measure("reference").done
    cell.run(0.5)
    times = cell.maintenance.config.times
    way_s = 3.0 * times.answer_s + 4.0 * times.rest_s + times.tool_home_s + times.reserve_s
    short = cell.maintain("short", times.check_s + way_s + 1.0)
    assert (short.code, short.tool_answer, short.complete) == (Code.ACCEPT, "pass", False)
    assert short.left == ("tool measurement (full)",)
    told = r"tool measurement \(full\): the gap is [\d.]+ s too short, one of (\d+) s would do"
    would_do = re.search(told, short.message)
    assert would_do, short.message
    done = cell.maintain("done", float(would_do[1]))
    assert (done.complete, done.tool_code) == (True, Code.NO_SIGNIFICANT_GAIN), done.message
    assert "too short" not in done.message


def test_a_thermal_node_that_is_started_anew_between_two_gaps_has_lost_poses(warm):
    """The cycle's name is open again, but what was measured before is gone."""
    cell = warm()
    session = cell.maintenance
    session.run("c1", GAP_S, cell.now_s, cell.wall_ns)
    cell.run(GAP_S, until=lambda: "way to measuring pose 2" in session.status(cell.now_s).doing)
    session.cancel("the line wants the robot")
    cell.run(GAP_S, until=lambda: session.running is None)
    cell.thermal = ThermalSession(
        cell.arm, cell.history, ThermalConfig(tolerance_m=TOLERANCE_M), "test"
    )
    result = cell.maintain("c2", GAP_S)
    words = "thermal measurement at 6 poses, of which the thermal node has 5"
    assert (result.complete, result.left) == (False, (words,)), result.message
    assert "thermal measurement" not in str(cell.maintain("c3", GAP_S).left)


def test_small_steps_do_not_creep_past_the_bounds(history):
    """Each step is small against the one before, their sum is not: the last ones wait."""
    bounds = AcceptBounds(automatic=True, tool_m=2e-3, tool_rad=0.2)
    cell = MaintainedCell(history, TAUGHT, poses=np.zeros((0, 6)), bounds=bounds)
    cell.run(0.5)
    cell.maintain("c0", GAP_S)
    accepted = []
    for number in range(1, 5):
        shift_m = 0.8e-3 * number
        tool = bent(TAUGHT, [shift_m, 0.0, 0.0], [0.0, shift_m / 0.1, 0.0])
        cell.tool = replace(cell.tool, T_flange_tool=tool)
        cell.production(0.5, KELVIN)
        result = cell.maintain(f"c{number}", GAP_S)
        accepted.append(result.tool_id in result.accepted and result.tool_id > 0)
        if not accepted[-1]:
            break
    assert accepted == [True, True, False]
    tip = KnownTool.of_document(history.head(TOOL).model).T_flange_tool[:3, 3]
    assert np.linalg.norm(tip - TAUGHT[:3, 3]) <= 2e-3


def test_a_candidate_of_an_older_revision_is_stale(waiting):
    cell, first = waiting
    cell.production(1.0, KELVIN + 2.0)
    second = cell.maintain("c2", GAP_S)
    decide, wall_ns = cell.maintenance.decide, cell.wall_ns
    assert decide(ACCEPT, second.thermal_id, "plc", "", wall_ns).revision == 1
    with pytest.raises(StaleError, match="solved against revision 0, in force is 1"):
        decide(ACCEPT, first.thermal_id, "plc", "", wall_ns)
    assert cell.history.head(THERMAL).calibration_id == second.thermal_id


def test_a_tool_that_was_measured_with_another_thermal_model_is_stale(waiting):
    """The drift is in it, and would be corrected a second time."""
    cell, result = waiting
    decide, wall_ns = cell.maintenance.decide, cell.wall_ns
    assert decide(ACCEPT, result.thermal_id, "plc", "", wall_ns).done
    with pytest.raises(StaleError, match="measured with thermal revision 0, in force is 1"):
        decide(ACCEPT, result.tool_id, "plc", "", wall_ns)
    cell.ask(Command(ACCEPT, {"id": result.tool_id, "by": "me"}))  # as `tcf_node` is asked
    assert cell.outcomes[-1].status is Code.STALE
    assert cell.history.head(TOOL).revision == 0
    assert cell.maintenance.status(cell.now_s).tool_pending == 0


def tool_off_m(history, tool_id: int) -> tuple[np.ndarray, np.ndarray]:
    """(3,) of the measured tip from the true one, and (3, 3) covariance of the measurement."""
    found = KnownTool.of_document(history.model(tool_id))
    return found.T_flange_tool[:3, 3] - TRUTH[:3, 3], found.covariance[:3, :3]


@pytest.mark.long
def test_a_tool_is_measured_with_the_drift_that_was_just_found(warm, history):
    """The same hot robot carries the tool through the beams; the cold model puts its drift there.

    Of the fresh model the held-out measurements tell how well it is known.
    """
    bounds = {"automatic": True, "tool_m": 0.01, "tool_rad": 0.1}
    result = warm(HOT_KELVIN, **bounds).maintain("c1", GAP_S)
    assert result.accepted == (result.thermal_id, result.tool_id), result.message
    assert history.model(result.tool_id)["thermal_revision"] == 1
    held_out_m = history.get(result.thermal_id).candidate_rms_mm * 1e-3
    off_m, covariance = tool_off_m(history, result.tool_id)
    noise = covariance + held_out_m**2 / 3.0 * np.eye(3)
    assert off_m @ np.linalg.solve(noise, off_m) < BEYOND
    for kind in (TOOL, THERMAL):
        history.rollback(0, kind=kind, by="test", reason="", wall_ns=0)
    cold = warm(HOT_KELVIN, poses=POSES[:0]).maintain("c2", GAP_S)
    off_m, _ = tool_off_m(history, cold.tool_id)
    assert off_m @ np.linalg.solve(noise, off_m) > 2.0 * BEYOND


def test_decisions_are_the_same_when_they_come_twice(waiting):
    cell, result = waiting
    session, wall_ns = cell.maintenance, cell.wall_ns
    with pytest.raises(ConflictError, match="one candidate must wait"):
        session.decide_only(ACCEPT, "plc", wall_ns)  # one of each kind
    for _ in range(2):
        assert session.decide(REJECT, result.tool_id, "plc", "", wall_ns).done
    with pytest.raises(InputError, match="nothing was accepted"):
        session.decide_only(ROLLBACK, "plc", wall_ns)
    assert session.decide_only(ACCEPT, "plc", wall_ns).calibration_id == result.thermal_id
    back = session.decide_only(ROLLBACK, "plc", wall_ns)
    assert (back.done, back.revision) == (True, 2)
    with pytest.raises(RobocalError):
        session.decide(ACCEPT, 999, "plc", "", wall_ns)


def test_a_calibration_of_another_kind_is_decided_elsewhere(history):
    cell = MaintainedCell(history)
    number = history.propose(
        Proposal(
            kind="hand_eye/sensor", model_hash=cell.arm.model_hash, based_on=0, cycle_id="",
            stamp_ns=0, created_ns=0, software="", method="", code=Code.ACCEPT, reason="",
            document={}, model={},
        )
    )  # fmt: skip
    with pytest.raises(InputError, match="decide elsewhere"):
        cell.maintenance.decide(ACCEPT, number, "plc", "", cell.wall_ns)


# Across the flange, so that the tool lies above the housing while it stands in the beams.
ACROSS = frames.exp_rotation(np.radians([-85.0, 0.0, 0.0]))
MANDREL = frames.transform(ACROSS, 0.17 * ACROSS[:, 2] + [0.0, 0.0, 0.02])
SMALL_BEND = bent(TAUGHT, [3e-4, 0.0, 0.0], [0.0, 3e-3, 0.0])  # its tilt drowns in the noise


def test_the_beams_are_found_again_in_gaps_and_a_knock_is_told(tmp_path):
    """Due, not due, and due after a knock of the station by 0.3 mm; by the run's own motions."""
    slow = Times(laser_frame_s=150.0, tool_home_s=30.0)
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        cell = MaintainedCell(
            history,
            TAUGHT,
            mandrel=MANDREL,
            poses=POSES[:0],
            times=slow,
            check_every_s=1e6,
            laser_frame_every_s=3600.0,
        )
        gap_s = 2.0 * GAP_S
        cell.run(0.5)
        early = cell.maintain("early", gap_s)
        assert (early.code, early.tool_answer) == (Code.ACCEPT, "pass"), early.message
        assert not history.head(LASER_FRAME).revision  # the first time is a person's
        cell.driver.arm(cell.now_s)
        cell.measure("laser")
        cell.run(150.0, until=cell.at_rest)
        cell.run(0.5)
        assert cell.outcomes[-1].status is Code.ACCEPT, cell.outcomes[-1].message
        home = cell.maintenance.ways.home(STATION, cell.q).plan
        cell.send(home)
        cell.run(home.duration_s + 1.0)
        due = cell.maintain("due", gap_s)
        assert (due.code, due.complete) == (Code.ACCEPT, True), due.message
        assert "beam station: " in due.message
        assert "no drift is seen over 2 measurements" in due.message
        kept = history.head(LASER_FRAME)
        assert (due.station_code, due.station_id) == (Code.ACCEPT, kept.calibration_id)
        assert history.head(LASER_FRAME).revision == 2
        again = cell.maintain("again", gap_s)
        assert again.message == "nothing was due"
        cell.maintenance.memory.note_tool(laser_ns=1)  # long ago
        short = cell.maintain("short", 60.0)
        assert (short.code, short.station_code) == (Code.ACCEPT, Code.LIMIT_EXCEEDED)
        assert (short.complete, short.left) == (False, ("tool measurement (laser)",))
        would_do = re.search(r"beam station: .* s too short, one of (\d+) s", short.message)
        assert would_do, short.message
        gap_s = float(would_do[1])  # in which it is found
        side = 3e-4 * cell.cell.laser.T_base_laser[:3, 0]
        x, y = (replace(b, start=b.start + side, end=b.end + side) for b in cell.cell.station.beams)
        cell.cell.station = replace(cell.cell.station, beams=(x, y))
        moved = cell.maintain("moved", gap_s)
        assert moved.tool_code is Code.STATION_MOVED, moved.message
        found = next(e for e in history.list(10) if e.kind == LASER_FRAME)
        shift_mm = history.document(found.id)["change"]["tip_mm"]
        sigma_mm = history.document(found.id)["sigma_mm"][0]
        assert (moved.station_code, moved.station_id) == (Code.STATION_MOVED, found.id)
        assert abs(shift_mm - 0.3) < 3.3 * sigma_mm  # one in a thousand
        assert cell.maintenance.memory.tool.answer == "failed"  # checks of before hold no more


def beside_a_mandrel(history: CalibrationHistory, from_s: float = 0.0) -> MaintainedCell:
    bounds = AcceptBounds(automatic=True, tool_m=0.01, tool_rad=0.1)
    slow = Times(full_s=60.0, tool_home_s=30.0)  # 50 mm/s, and the flange turns by 85 deg
    settings = {"poses": POSES[:0], "bounds": bounds, "times": slow}
    return MaintainedCell(history, TAUGHT, mandrel=MANDREL, from_s=from_s, **settings)


@pytest.fixture(scope="module")
def witnessed(tmp_path_factory) -> Kept:
    """After the healthy tool and the mandrel were measured; the robot is home again."""
    folder = tmp_path_factory.mktemp("witnessed")
    with CalibrationHistory.open("K1", state_dir=folder) as history:
        cell = beside_a_mandrel(history)
        cell.run(0.5)
        for mode in ("reference", "witness reference"):
            cell.driver.arm(cell.now_s)
            cell.measure(mode)
            cell.run(100.0, until=cell.at_rest)
            cell.run(0.5)
            assert cell.outcomes[-1].status is Code.ACCEPT, cell.outcomes[-1].message
        home = cell.maintenance.ways.home(STATION, cell.q).plan
        cell.send(home)
        cell.run(home.duration_s + 1.0)
    return Kept(folder, cell.now_s, rng=cell.rng)


@pytest.mark.parametrize(
    ("knocked", "rejected"), [(True, False), (False, True), *more((False, False), (True, True))]
)
def test_a_mandrel_settles_in_the_cycle_what_has_changed(witnessed, tmp_path, knocked, rejected):
    """A shift of 0.3 mm of the station or of the tool, which the tool's own run cannot tell.

    Finding: what a person rejected while the mandrel ran was measured anew.
    """
    with witnessed.opened(tmp_path) as history:
        cell = beside_a_mandrel(history, witnessed.now_s)
        cell.rng = deepcopy(witnessed.rng)
        cell.run(0.5)
        if knocked:
            station = cell.cell.station
            side = 3e-4 * cell.cell.laser.T_base_laser[:3, 0]
            x, y = (replace(b, start=b.start + side, end=b.end + side) for b in station.beams)
            cell.cell.station = replace(station, beams=(x, y))
        else:
            cell.tool = RoundTool.cylinder(SMALL_BEND, 0.0025)
        session, rejections = cell.maintenance, []

        def reject() -> None:
            if rejected and "witness" in session.status(cell.now_s).doing:
                for waiting in history.pending(TOOL, 1):
                    rejections.append(waiting.id)
                    session.decide(REJECT, waiting.id, "a person", "", cell.wall_ns)

        result = cell.maintain("c1", 1.5 * GAP_S, reject)
        if rejected:
            entries = [entry for entry in history.list() if entry.kind == TOOL]
            assert [entry.id for entry in entries] == rejections
            assert entries[0].decisions[-1].by == "a person"
            assert result.accepted == ()
            assert (result.tool_code is Code.STATION_MOVED) is knocked
        elif knocked:
            assert result.tool_code is Code.STATION_MOVED, result.message
            assert result.accepted == ()
            assert not history.pending(TOOL, 1)
        else:
            assert result.accepted == (result.tool_id,), result.message
            found = KnownTool.of_document(history.model(result.tool_id)).T_flange_tool
            assert np.linalg.norm(found[:3, 3] - SMALL_BEND[:3, 3]) < 1.5e-4


def test_a_mandrel_that_cannot_tell_is_not_asked_in_every_gap(witnessed, tmp_path):
    """First measured two hours after the healthy tool: a change in doubt waits for a person."""
    with witnessed.opened(tmp_path) as history:
        model = history.head(history_records.MANDREL).model
        later = model | {"stamp_ns": model["stamp_ns"] + 2 * 3600 * 10**9}
        cell = beside_a_mandrel(history, witnessed.now_s)
        bring_into_force(history, history_records.MANDREL, cell.cell.arm, later, "test")
        cell.rng = deepcopy(witnessed.rng)
        cell.run(0.5)
        cell.tool = RoundTool.cylinder(SMALL_BEND, 0.0025)
        for name in ("c1", "c2"):
            result = cell.maintain(name, 1.5 * GAP_S)
            assert result.accepted == (), result.message
            (waiting,) = [entry for entry in history.list() if entry.kind == TOOL]
            assert waiting.state is CalibrationState.PENDING
            assert "the mandrel cannot tell" in waiting.reason


def test_a_check_of_another_taught_tool_is_none():
    """Over a restart with another one in the parameters; what a pendant rounds is the same."""
    checked = ToolRecord(answer="pass", words="passed", wall_ns=5, laser_ns=3).of_taught(TAUGHT)
    rounded, longer = (bent(TAUGHT, [0.0, 0.0, by_m], [0.0, 0.0, 0.0]) for by_m in (5e-6, 5e-3))
    assert checked.of_taught(rounded).answer == "pass"
    other = checked.of_taught(longer)
    assert (other.answer, other.wall_ns, other.laser_ns) == ("", 0, 3)
    assert other.words == "the tool was taught otherwise when it was checked"
