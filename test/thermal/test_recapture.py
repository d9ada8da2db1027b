# SPDX-License-Identifier: Apache-2.0
"""A new cold reference while a drift is in force: of a robot that has cooled, or one still warm."""

from pathlib import Path

import numpy as np
import pytest
from maintenance_cell import config_of
from shift import BALL, KNOCK, NOISE_M, DriftingRobot, knocked, postures, warmed

from robocal_ros.ground.errors import Code, StaleError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.accuracy import AcceptBounds
from robocal_ros.maintenance.deciding import Decider
from robocal_ros.session import events
from robocal_ros.session.events import Outcome
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import configuration, session_as_recorded

POSES, KELVIN, NIGHT_H = 8, 15.0, 12.0
STILL = np.eye(4)
TAUGHT = np.eye(4)
TAUGHT[:3, 3] = BALL[:3]


class Robot(DriftingRobot):
    """``T_sensor``: how the sensor was moved by now."""

    def __init__(self, folder: Path) -> None:
        self.check = postures(load_robot("kr150_r3100"), 40, seed=9)
        work = {"work_poses": tuple(map(tuple, self.check.tolist())), "tip_m": tuple(BALL[:3])}
        super().__init__(folder, ThermalConfig(sigma_m=NOISE_M, **work), POSES)
        self.T_sensor = STILL
        self.known_m = 0.0  # how well the model in force is known
        poses = {"home": self.q[0], "poses": self.q[1:]}
        bounds = config_of(**poses, T_flange_tool=TAUGHT, bounds=AcceptBounds(automatic=True))
        self.decider = Decider(self.nominal, self.history, bounds)

    def visit(self, command: str, kelvin: float, after_h: float, q=None, rounds=1) -> Outcome:
        q = np.tile(self.q if q is None else q, (rounds, 1))
        samples = self.shift.visit(warmed(self.cold, kelvin), q, after_h)
        self.visited = knocked(samples, self.T_sensor)
        self.feed(self.visited)
        return self.ask(command)

    def work(self, kelvin: float = KELVIN, after_h: float = 2.0) -> Outcome:
        """A cycle of the warm robot whose model is accepted."""
        found = self.visit(events.IDENTIFY, kelvin, after_h)
        assert found.status is Code.ACCEPT, found.message
        assert self.ask(events.ACCEPT, id=found.calibration_id).done
        return found

    def capture(self, kelvin: float, after_h: float, **more) -> Outcome:
        return self.visit(events.CAPTURE_REFERENCE, kelvin, after_h, **more)

    def off_m(self, kelvin: float) -> float:
        """Rms distance over the workspace of the model in force's drift from the true one."""
        true = self._ball(warmed(self.cold, kelvin)) - self._ball(self.cold)
        found = self._ball(self.session.current.arm) - self._ball(self.nominal)
        return float(np.sqrt(np.mean(np.sum((found - true) ** 2, axis=1))))

    def _ball(self, arm):
        return (arm.fk(self.check) @ BALL)[:, :3]

    def shift_m(self, kelvin: float) -> float:
        """The true shift at home and measuring poses that a bound is about."""
        moved = warmed(self.nominal, kelvin).fk(self.q) @ BALL - self.nominal.fk(self.q) @ BALL
        return float(np.max(np.linalg.norm(moved[:, :3], axis=1)))


@pytest.fixture
def robot(tmp_path) -> Robot:
    """After a shift: its model is in force."""
    made = Robot(tmp_path)
    assert made.capture(0.0, 0.0, rounds=3).done
    made.known_m = known_m(made.work())
    return made


def known_m(found: Outcome) -> float:
    """What the covariance leaves open over the workspace, at 99.7 %."""
    return 3e-3 * found.document["calibrated"]["predicted"]["workspace_rms_mm"]


@pytest.mark.parametrize("T_sensor", [STILL, KNOCK], ids=["still", "knocked"])
def test_a_robot_that_cooled_has_not_yesterdays_drift(robot, T_sensor):
    drift_m = robot.off_m(0.0)
    robot.T_sensor = T_sensor
    captured = robot.capture(0.0, NIGHT_H, rounds=3)
    assert captured.done, captured.message
    assert np.array_equal(robot.session.reference.cell.arm.mdh, robot.nominal.mdh)
    assert "the robot is cold" in captured.message
    told = robot.session.accuracy(robot.session.newest_joints_ns)
    assert told.level is AccuracyLevel.DEGRADED
    assert told.error.rms_m >= drift_m
    found = robot.work(0.0, 0.1)
    assert robot.off_m(0.0) < known_m(found)
    told = robot.session.accuracy(robot.session.newest_joints_ns)
    assert told.level is AccuracyLevel.OK
    assert told.error.rms_m < drift_m


def test_a_candidate_of_an_earlier_reference_is_stale(robot):
    """Finding: yesterday's drift could be accepted after the cold capture of the morning."""
    found = robot.visit(events.IDENTIFY, 2.0 * KELVIN, 1.0)
    assert found.status is Code.ACCEPT, found.message
    old = found.calibration_id
    assert robot.decider.newest(THERMAL).id == old
    assert robot.capture(0.0, NIGHT_H, rounds=3).done
    words = "measured with reference revision 1, in force is 2"
    refused = robot.ask(events.ACCEPT, id=old)
    assert refused.status is Code.STALE, refused.message
    assert words in refused.message
    with pytest.raises(StaleError, match=words):
        robot.decider.decide(events.ACCEPT, old, "plc", "", 0)
    assert words in robot.decider.withheld(old)
    assert robot.decider.newest(THERMAL) is None
    assert robot.history.head(THERMAL).revision == 1
    robot.work(0.0, 0.1)  # what is measured since the capture is accepted


def test_a_candidate_of_before_any_reference_is_stale(tmp_path):
    """A reference counts its drifts from the model that was in force, not from that one."""
    robot = Robot(tmp_path)
    calibrated = robot.visit(events.IDENTIFY, 0.0, 0.0, q=postures(robot.nominal, 40))
    assert calibrated.status is Code.ACCEPT, calibrated.message
    assert robot.capture(0.0, 0.5).done
    refused = robot.ask(events.ACCEPT, id=calibrated.calibration_id)
    assert refused.status is Code.STALE, refused.message


def test_a_warm_robot_keeps_its_drift_when_the_sensor_was_knocked(robot):
    robot.T_sensor = KNOCK
    assert robot.visit(events.IDENTIFY, KELVIN, 0.1).status is Code.SENSOR_OR_ROBOT_MOVED
    captured = robot.capture(KELVIN, 0.1, rounds=3)
    assert captured.done, captured.message
    assert "as warm as the model in force" in captured.message
    assert np.array_equal(robot.session.reference.cell.arm.mdh, robot.session.current.arm.mdh)
    found = robot.visit(events.IDENTIFY, KELVIN, 0.5)
    assert found.status is Code.NO_SIGNIFICANT_GAIN, found.message
    assert robot.off_m(KELVIN) < robot.known_m
    captured = robot.capture(0.0, NIGHT_H, rounds=3)  # against the warm reference
    assert "the robot is cold" in captured.message
    assert np.array_equal(robot.session.reference.cell.arm.mdh, robot.nominal.mdh)


def test_what_cannot_be_told_is_refused_with_what_to_do(robot):
    """After the rollback of a person who knows, the same measurements do."""
    other = postures(robot.nominal, 3 * POSES)[POSES:]
    refused = robot.capture(0.0, NIGHT_H, q=other)
    assert refused.status is Code.TOO_FEW_SAMPLES
    assert "cold or as warm as the model in force" in refused.message
    assert "roll the drift back (~/rollback, id 0, the nominal model)" in refused.message
    assert robot.ask(events.ROLLBACK, id=0).done
    captured = robot.ask(events.CAPTURE_REFERENCE)
    assert captured.samples == len(other)
    assert np.array_equal(robot.session.reference.cell.arm.mdh, robot.nominal.mdh)


def test_a_drift_within_the_noise_hinders_no_capture(robot):
    """After a cold cycle was accepted; the poses are new and the sensor was moved."""
    assert robot.capture(0.0, NIGHT_H, rounds=3).done
    robot.work(0.0, 0.1)
    robot.T_sensor = KNOCK
    captured = robot.capture(0.0, 0.1, q=postures(robot.nominal, 2 * POSES)[POSES:])
    assert captured.done, captured.message
    assert "the drift in force is within the noise" in captured.message
    assert np.array_equal(robot.session.reference.cell.arm.mdh, robot.nominal.mdh)


def test_a_robot_that_is_cooling_is_no_reference(robot):
    before = robot.session.current.reference_id
    refused = robot.capture(0.35 * KELVIN, 1.0, rounds=3)
    assert refused.status is Code.CONFLICT, refused.message
    assert "neither cold nor as warm as the model in force" in refused.message
    assert robot.session.current.reference_id == before


def test_the_bound_does_not_creep_over_five_mornings(robot):
    for _ in range(5):
        assert robot.capture(0.0, NIGHT_H, rounds=3).done
        robot.work(0.0, 0.1)
        found = robot.work(KELVIN, 2.0)
        shift_m = robot.decider.thermal_shift_m(found.calibration_id)
        assert shift_m == pytest.approx(robot.shift_m(KELVIN), abs=known_m(found))
        assert robot.off_m(KELVIN) < known_m(found)


def test_the_bound_counts_what_a_warm_reference_holds(robot):
    for kelvin in (20.0, 25.0, 30.0):
        robot.T_sensor = KNOCK @ robot.T_sensor
        assert robot.capture(kelvin - 5.0, 0.1, rounds=3).done
        found = robot.work(kelvin, 1.0)
        shift_m = robot.decider.thermal_shift_m(found.calibration_id)
        assert shift_m == pytest.approx(robot.shift_m(kelvin), abs=known_m(found))


@pytest.mark.parametrize(("kelvin", "after_h"), [(0.0, NIGHT_H), (KELVIN, 0.1)])
def test_a_replay_decides_the_same(robot, tmp_path, kelvin, after_h):
    """Of a recording that began when the drift was in force already."""
    configured = configuration(robot.session)
    captured = robot.capture(kelvin, after_h, rounds=3)
    history = CalibrationHistory.open(
        "s1", model_hash=robot.nominal.model_hash, state_dir=tmp_path / "again"
    )
    again = session_as_recorded(robot.nominal, history, configured, "test")
    for sample in robot.visited:
        again.add(sample)
    again.submit(captured.command)
    (outcome,) = again.advance(wall_ns=1, force=True)
    assert outcome.message == captured.message
    assert again.current.reference_model == robot.session.current.reference_model
