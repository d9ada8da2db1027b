# SPDX-License-Identifier: Apache-2.0
"""Measuring cycles of the session: bracketed, timed out, broken off, repeated, and what follows."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shift import DriftingRobot, fixed_points, knocked, of_kind, postures, warmed

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JOINTS, JointSample, PointSample
from robocal_ros.session import events
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.thermal.drift_following import CHECKPOINT_EVERY, ThermalConfig

NS = 1_000_000_000
POSES = 8
CONFIG = ThermalConfig(sigma_m=2e-5, cycle_timeout_s=60.0)


class Cell(DriftingRobot):
    def __init__(self, folder: Path, config: ThermalConfig = CONFIG) -> None:
        super().__init__(folder, config, POSES)

    def visit(self, kelvin: float = 0.0, poses: slice = slice(None), after_h: float = 0.0) -> None:
        self.feed(self.shift.visit(warmed(self.cold, kelvin), self.q[poses], after_h))

    def capture(self) -> None:
        self.visit()
        assert self.ask(events.CAPTURE_REFERENCE).done

    def idle(self, seconds: float) -> None:
        """The robot stands elsewhere and is not measured."""
        self.shift.now_ns += round(seconds * NS)
        for sample in self.shift.visit(self.cold, self.q[:1] + 1.0):
            if isinstance(sample, JointSample):
                self.session.add(sample)


@pytest.fixture
def cell(tmp_path) -> Cell:
    made = Cell(tmp_path)
    made.capture()
    return made


def test_a_bracketed_cycle_takes_what_was_measured_within(cell):
    cell.visit(15.0, slice(3), after_h=2.0)  # before the cycle began
    assert cell.ask(events.BEGIN_CYCLE, cycle_id="c1").done
    cell.visit(15.0)
    found = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert (found.status, found.samples) == (Code.ACCEPT, POSES)
    assert found.document["cycle_id"] == "c1"
    assert found.document["poses"] == {"visited": POSES, "missing": []}
    assert cell.session.cycle.id == ""


def test_begin_and_end_may_be_called_again(cell):
    cell.visit(15.0, after_h=2.0)
    begun = cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    cell.visit(15.0)
    again = cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    assert again.done
    assert (begun.repeated, again.repeated) == (False, True)
    first = cell.ask(events.END_CYCLE, cycle_id="c1")
    second = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert second.repeated
    assert (second.calibration_id, second.status) == (first.calibration_id, first.status)
    assert first.samples == POSES  # the second begin dropped nothing
    reused = cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    assert reused.status is Code.CONFLICT
    assert "has ended already" in reused.message


def test_the_answer_is_known_after_a_restart(cell):
    cell.visit(15.0, after_h=2.0)
    first = cell.ask(events.END_CYCLE, cycle_id="c1")
    cell.start()
    second = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert (second.repeated, second.calibration_id) == (True, first.calibration_id)
    assert second.status is first.status


def test_only_the_open_cycle_ends(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    refused = cell.ask(events.END_CYCLE, cycle_id="c2")
    assert refused.status is Code.CONFLICT
    assert "'c1' is open, not 'c2'" in refused.message
    assert cell.session.cycle.id == "c1"


def test_a_new_cycle_breaks_off_the_open_one(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    cell.visit(40.0, slice(2), after_h=2.0)  # what is left of it must not be used
    begun = cell.ask(events.BEGIN_CYCLE, cycle_id="c2")
    assert "cycle 'c1' is broken off" in begun.message
    cell.visit(15.0)
    found = cell.ask(events.END_CYCLE)
    assert (found.status, found.samples) == (Code.ACCEPT, POSES)
    assert found.document["cycle_id"] == "c2"


def test_a_cold_reference_holds_nothing_of_a_warm_day_before(tmp_path):
    """Taught poses that were visited, and nobody's command used them: one cold visit counts."""
    alone, after = Cell(tmp_path / "alone"), Cell(tmp_path / "after")
    for made in (alone, after):
        for kelvin in [20.0] * (made is after) + [0.0]:
            made.visit(kelvin, after_h=12.0)
    one, other = (made.ask(events.CAPTURE_REFERENCE) for made in (alone, after))
    assert one.samples == other.samples == POSES
    positions = [made.session.reference.data.position for made in (alone, after)]
    assert np.max(np.abs(positions[0] - positions[1])) < 6.0 * CONFIG.sigma_m  # 20 K: 0.5 mm
    assert f"left out: {POSES} measurements before a pause of over 60 s" in other.message
    assert "left out" not in one.message
    assert "not visited since" not in other.message


def test_a_cold_visit_that_a_stop_parted_says_what_it_lacks(tmp_path):
    cell = Cell(tmp_path / "live")
    cell.q = postures(cell.nominal, 2 * POSES)
    cell.visit(poses=slice(POSES))
    later = list(cell.shift.visit(cell.cold, cell.q[POSES:], after_h=0.1))
    cell.feed(later)
    parted = cell.ask(events.CAPTURE_REFERENCE)
    assert (parted.status, parted.samples) == (Code.ACCEPT, POSES)
    words = f"; left out: {POSES} measurements before a pause of over 60 s, poses among them "
    assert f"{words}not visited since: {POSES} (to have these count, visit all" in parted.message
    again = Cell(tmp_path / "again")  # from a recording that began after the stop
    again.feed(later)
    again.session.submit(parted.command)
    (replayed,) = again.session.advance(wall_ns=1, force=True)
    assert (replayed.message, replayed.samples) == (parted.message, parted.samples)
    cell.visit(after_h=0.1)
    whole = cell.ask(events.CAPTURE_REFERENCE)
    assert (whole.status, whole.samples) == (Code.ACCEPT, 2 * POSES)
    assert "left out" not in whole.message


def test_a_refused_capture_says_what_a_stop_parted_and_keeps_it(tmp_path):
    cell = Cell(tmp_path)
    cell.visit(poses=slice(6))
    cell.visit(poses=slice(6, POSES), after_h=0.1)
    refused = cell.ask(events.CAPTURE_REFERENCE)
    assert refused.status is Code.TOO_FEW_SAMPLES
    assert "left out: 6 measurements before a pause of over 60 s" in refused.message
    assert "not visited since: 6" in refused.message
    cell.visit(poses=slice(6))
    whole = cell.ask(events.CAPTURE_REFERENCE)
    assert (whole.status, whole.samples) == (Code.ACCEPT, POSES)
    assert "not visited since" not in whole.message


def test_a_window_that_the_caller_chose_lacks_nothing(tmp_path):
    cell = Cell(tmp_path)
    cell.visit()
    from_ns = cell.shift.now_ns
    cell.visit(after_h=0.1)
    found = cell.ask(events.CAPTURE_REFERENCE, from_ns=from_ns)
    assert (found.status, found.samples) == (Code.ACCEPT, POSES)
    assert "left out" not in found.message + cell.session.ignored.words()
    assert "before a pause" not in found.message + cell.session.ignored.words()


def test_a_cycle_needs_a_cold_reference(tmp_path):
    cell = Cell(tmp_path)
    for name in (events.BEGIN_CYCLE, events.END_CYCLE):
        refused = cell.ask(name, cycle_id="c1")
        assert refused.status is Code.CONFLICT
        assert "no cold reference" in refused.message


def test_missing_poses_are_named_by_their_number(cell):
    cell.visit(15.0, slice(2, 7), after_h=2.0)
    found = cell.ask(events.END_CYCLE)
    assert found.document["poses"] == {"visited": 5, "missing": [1, 2, 8]}
    assert found.samples == 5


def test_a_failed_end_leaves_the_cycle_open(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    refused = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert refused.status is Code.TOO_FEW_SAMPLES
    cell.visit(15.0, after_h=2.0)
    assert cell.ask(events.END_CYCLE, cycle_id="c1").samples == POSES


def test_time_ends_a_cycle_with_and_without_a_beginning(cell):
    for begins in (True, False):
        if begins:
            cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
        cell.visit(15.0, slice(6), after_h=0.0 if begins else 2.0)
        assert cell.session.overdue() is None
        cell.idle(61.0)
        command = cell.session.overdue()
        assert command is not None
        cell.session.submit(command)
        outcome = cell.session.advance(wall_ns=1, force=True)[-1]
        assert outcome.samples == 6
        assert outcome.command.arguments["by"] == "time-out"
        assert cell.session.overdue() is None
        assert cell.session.cycle.id == ""


def test_an_empty_cycle_times_out_too(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    cell.idle(61.0)
    cell.session.submit(cell.session.overdue())
    (outcome,) = cell.session.advance(wall_ns=1, force=True)
    assert outcome.status is Code.TOO_FEW_SAMPLES
    assert cell.session.cycle.id == ""
    assert cell.session.overdue() is None


def test_some_stray_measurements_are_no_cycle(cell):
    cell.visit(0.0, slice(3))
    cell.idle(61.0)
    assert cell.session.overdue() is None
    cell.visit(15.0, after_h=2.0)  # nor do they get into the next one
    assert cell.ask(events.IDENTIFY).samples == POSES


def test_other_poses_are_left_out(cell):
    other = postures(cell.nominal, 2, seed=99)
    cell.feed(cell.shift.visit(cell.cold, other, after_h=2.0))
    cell.visit(15.0)
    found = cell.ask(events.END_CYCLE)
    assert (found.status, found.samples) == (Code.ACCEPT, POSES)
    assert sum(c.total() for c in cell.session.desk.ignored.values()) == 2
    cell.feed(cell.shift.visit(cell.cold, other))
    refused = cell.ask(events.END_CYCLE)
    assert refused.status is Code.BAD_INPUT
    assert "none of the 2 measured poses" in refused.message


def test_a_visit_counts_once_however_often_it_is_measured(cell):
    samples = list(cell.shift.visit(warmed(cell.cold, 15.0), cell.q, after_h=2.0))
    often = []
    for sample in samples:
        often.append(sample)
        if isinstance(sample, PointSample):
            often += [replace(sample, stamp_ns=sample.stamp_ns + i * NS // 100) for i in (1, 2)]
    cell.feed(often)
    found = cell.ask(events.END_CYCLE)
    assert found.samples == POSES
    inputs = cell.history.inputs(found.calibration_id)
    assert inputs["sigma"] == pytest.approx(np.full(POSES, CONFIG.sigma_m))


def test_so_does_one_of_a_calibration(tmp_path):
    cell = Cell(tmp_path)
    for sample in cell.shift.visit(cell.cold, cell.q):
        cell.session.add(sample)
        if isinstance(sample, PointSample):
            cell.session.add(replace(sample, stamp_ns=sample.stamp_ns + NS // 100))
    desk = cell.session.desk
    identify = events.Command(events.IDENTIFY, {}, cell.shift.now_ns, desk.marks)
    assert len(cell.session.windows.of(identify)[0]) == POSES


def test_a_restart_goes_on_from_the_same_state(tmp_path):
    """Cycles with restarts in between, beyond a kept state: the same bits as without."""
    cells = [Cell(tmp_path / name) for name in ("steady", "restarted")]
    for cell in cells:
        cell.capture()
    for number in range(CHECKPOINT_EVERY + 3):
        for cell in cells:
            cell.visit(0.3 * number, slice(4), after_h=0.2)
            assert cell.ask(events.IDENTIFY).calibration_id
        if number in (1, 7, CHECKPOINT_EVERY - 1, CHECKPOINT_EVERY + 1):
            cells[1].start()
    steady, restarted = (cell.session.follower.state for cell in cells)
    assert steady.cycles == restarted.cycles == CHECKPOINT_EVERY + 3
    assert steady.stamp_ns == restarted.stamp_ns
    assert np.array_equal(steady.tracker.mean, restarted.tracker.mean)
    assert np.array_equal(steady.tracker.covariance, restarted.tracker.covariance)


def test_what_could_not_be_kept_was_not_taken(cell):
    """The disk is full, then it is not: the cycle counts once."""
    cell.visit(15.0, after_h=2.0)
    before = cell.session.follower.state
    path = cell.history.path
    path.rename(path.with_suffix(".away"))
    refused = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert refused.status is Code.STORAGE_FAILED
    assert cell.session.follower.state is before
    path.with_suffix(".away").rename(path)
    found = cell.ask(events.END_CYCLE, cycle_id="c1")
    assert (found.status, found.samples) == (Code.ACCEPT, POSES)


def test_a_knocked_sensor_freezes_the_model(cell):
    cell.visit(15.0, after_h=2.0)
    assert cell.ask(events.END_CYCLE, cycle_id="c1").done
    accepted = cell.ask(events.ACCEPT, id=2)
    assert accepted.done
    state = cell.session.follower.state
    assert cell.session.accuracy(cell.shift.now_ns).level is AccuracyLevel.OK
    cell.feed(knocked(cell.shift.visit(warmed(cell.cold, 15.0), cell.q)))
    refused = cell.ask(events.END_CYCLE, cycle_id="c2")
    assert refused.status is Code.SENSOR_OR_ROBOT_MOVED
    assert "sensor and robot base moved against each other" in refused.message
    assert "reference_sphere_center, would decide" in refused.message
    now = cell.session.follower.state
    assert now.tracker is state.tracker
    accuracy = cell.session.accuracy(cell.shift.now_ns)
    assert accuracy.level is AccuracyLevel.FAULT
    assert accuracy.reason == refused.message
    denied = cell.ask(events.ACCEPT, id=refused.calibration_id)
    assert denied.status is Code.SENSOR_OR_ROBOT_MOVED
    cell.start()  # it is known after a restart
    assert cell.session.accuracy(cell.shift.now_ns).level is AccuracyLevel.FAULT
    cell.visit(15.0)  # the sensor is back
    again = cell.ask(events.END_CYCLE, cycle_id="c3")
    assert again.status is not Code.SENSOR_OR_ROBOT_MOVED
    assert cell.session.accuracy(cell.shift.now_ns).level is AccuracyLevel.OK


@pytest.mark.parametrize("what", ["sensor", "sphere"])
def test_a_fixed_sphere_decides(tmp_path, what):
    cell = Cell(tmp_path)
    cell.feed(fixed_points(list(cell.shift.visit(cell.cold, cell.q)), moved=False))
    assert cell.ask(events.CAPTURE_REFERENCE).samples == POSES
    warm = list(cell.shift.visit(warmed(cell.cold, 15.0), cell.q, after_h=2.0))
    if what == "sphere":
        warm = fixed_points(knocked(warm), moved=False)
    else:
        warm = fixed_points(warm, moved=True)
    cell.feed(warm)
    refused = cell.ask(events.END_CYCLE)
    assert refused.status is Code.SENSOR_OR_ROBOT_MOVED
    words = "so the sensor did" if what == "sensor" else "stands where it was, so the sensor too"
    assert words in refused.message


def test_accuracy_ages(cell):
    levels = [
        cell.session.accuracy(cell.shift.now_ns + round(hours * 3600 * NS)).level
        for hours in (0.0, 7.95, 9.0)
    ]
    assert levels[0] is AccuracyLevel.OK
    assert levels[1] in (AccuracyLevel.DUE, AccuracyLevel.DEGRADED)
    assert levels[2] is AccuracyLevel.EXPIRED


def test_a_clock_set_back_makes_nothing_younger(tmp_path):
    """Neither while the session runs nor over a restart, however long a model may be in force."""
    cell = Cell(tmp_path, replace(CONFIG, expires_after_s=24.0 * 3600.0, tolerance_m=1.0))
    cell.capture()
    cell.idle(25 * 3600.0)
    assert cell.session.accuracy(cell.shift.now_ns).level is AccuracyLevel.EXPIRED
    cell.idle(-30.0)
    assert cell.session.desk.jumps == 1
    assert cell.session.accuracy(cell.shift.now_ns).level is AccuracyLevel.EXPIRED
    cell.start()
    before_ns = cell.session.reference.data.middle_ns - 3600 * NS
    found = cell.session.accuracy(before_ns)
    assert found.level is AccuracyLevel.EXPIRED
    assert "the clock is before the last cycle" in found.reason


def test_without_a_reference_nothing_is_known(tmp_path):
    found = Cell(tmp_path).session.accuracy(5)
    assert found.level is AccuracyLevel.EXPIRED
    assert found.error is None
    assert "no cold reference" in found.reason


def test_a_tight_tolerance_is_missed(tmp_path):
    cell = Cell(tmp_path, replace(CONFIG, tolerance_m=1e-7))
    cell.capture()
    found = cell.session.accuracy(cell.shift.now_ns)
    assert found.level is AccuracyLevel.DEGRADED
    assert found.due_in_s < 0.0
    assert "of 0.00 mm allowed" in found.reason


def test_a_clock_that_jumps_back_does_not_stop_the_cycles(cell):
    cell.visit(15.0, after_h=2.0)
    assert cell.ask(events.END_CYCLE, cycle_id="c1").done
    cell.shift.now_ns -= 3600 * NS
    cell.visit(15.0)
    found = cell.ask(events.END_CYCLE, cycle_id="c2")
    assert found.samples == POSES
    assert found.status is not Code.SENSOR_OR_ROBOT_MOVED
    assert cell.session.desk.jumps == 1
    assert cell.session.accuracy(cell.shift.now_ns).error is not None


def test_a_step_does_not_become_plausible_by_waiting(cell):
    """0.3 mm of the sensor: refused at once, and after every quarter of an hour for six hours."""
    cell.visit(0.0, after_h=0.25)
    assert cell.ask(events.END_CYCLE).calibration_id
    moved = frames.transform(np.eye(3), [3e-4, 0.0, 0.0])
    for _ in range(24):
        cell.feed(knocked(cell.shift.visit(cell.cold, cell.q, after_h=0.25), moved))
        assert cell.ask(events.END_CYCLE).status is Code.SENSOR_OR_ROBOT_MOVED
    again = cell.start().follower.state
    assert again.moved_s is not None
    cell.feed(knocked(cell.shift.visit(cell.cold, cell.q, after_h=0.25), moved))
    assert cell.ask(events.END_CYCLE).status is Code.SENSOR_OR_ROBOT_MOVED
    cell.visit(0.0)  # put back
    assert cell.ask(events.END_CYCLE).status is not Code.SENSOR_OR_ROBOT_MOVED
    assert cell.session.follower.state.moved_s is None


@pytest.mark.parametrize("hours", [0.0, -1.0, -1e5])
def test_accuracy_is_told_at_any_stamp(cell, hours):
    """At the cold visit itself a visit's scatter alone; more before it, or at clocks not begun."""
    cold_ns = cell.session.reference.data.middle_ns
    found = cell.session.accuracy(max(cold_ns + round(hours * 3600 * NS), 0))
    assert found.error is not None
    assert np.isfinite([found.error.rms_m, found.error.bound_m, found.due_in_s]).all()
    scatter_m = np.sqrt(3.0) * cell.session.config.sigma_m
    assert (found.error.rms_m == pytest.approx(scatter_m)) == (hours == 0.0)


@pytest.mark.parametrize("disk_was_full", [False, True])
def test_an_open_cycle_times_out_after_a_jump_back_too(cell, disk_was_full):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    if disk_was_full:
        cell.visit(0.0)
        path = cell.history.path
        path.rename(path.with_suffix(".away"))
        cell.session.submit(events.Command(events.END_CYCLE, {"cycle_id": "c1"}))
        assert cell.session.advance(wall_ns=1, force=True)[-1].status is Code.STORAGE_FAILED
        path.with_suffix(".away").rename(path)
    cell.shift.now_ns -= 500 * NS
    cell.visit(0.0, slice(2))
    cell.idle(61.0)
    assert cell.session.desk.jumps == 1
    assert cell.session.overdue() is not None


def test_a_fixed_sphere_alone_keeps_no_cycle_open(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    cell.visit(0.0, slice(6), after_h=0.1)
    for _ in range(8):
        samples = list(cell.shift.visit(cell.cold, cell.q[:1], after_h=0.005))
        fixed = fixed_points(samples, moved=False)
        cell.feed(s for s in fixed if getattr(s, "target", "") != "ball")
    assert cell.session.overdue() is not None


@pytest.mark.parametrize("begins", [True, False])
def test_a_cycle_ends_when_its_first_measurement_is_old(tmp_path, begins):
    """However short its pauses: the links have followed what heats them meanwhile."""
    cell = Cell(tmp_path, replace(CONFIG, cycle_span_s=300.0))
    cell.capture()
    if begins:
        cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    first_ns = cell.shift.now_ns
    while cell.session.overdue() is None:
        cell.visit(15.0, slice(6), after_h=50.0 / 3600.0)
        assert cell.shift.now_ns < first_ns + 600 * NS
    command = cell.session.overdue()
    assert command.arguments["reason"] == "its first measurement is 300 s old"
    cell.session.submit(command)
    outcome = cell.session.advance(wall_ns=1, force=True)[-1]
    assert outcome.command.name == events.END_CYCLE
    assert outcome.samples > 6
    assert cell.session.overdue() is None


def test_a_time_out_on_a_full_disk_keeps_the_cycle(cell):
    cell.visit(15.0, after_h=2.0)
    cell.idle(61.0)
    path = cell.history.path
    path.rename(path.with_suffix(".away"))
    cell.session.submit(cell.session.overdue())
    assert cell.session.advance(wall_ns=1, force=True)[-1].status is Code.STORAGE_FAILED
    assert cell.session.overdue() is None  # not at once again
    path.with_suffix(".away").rename(path)
    cell.idle(61.0)
    cell.session.submit(cell.session.overdue())
    assert cell.session.advance(wall_ns=1, force=True)[-1].samples == POSES


def test_stamps_of_joints_alone_do_not_end_a_cycle_early(cell):
    cell.ask(events.BEGIN_CYCLE, cycle_id="c1")
    newest = cell.session.desk.newest_ns[JOINTS]
    joints = of_kind(list(cell.shift.visit(cell.cold, cell.q[:1])), JointSample)
    cell.feed(joints)
    assert cell.session.desk.newest_ns[JOINTS] > newest
    assert cell.session.overdue() is None
