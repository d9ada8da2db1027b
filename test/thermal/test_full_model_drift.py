# SPDX-License-Identifier: Apache-2.0
"""A robot whose joints have functions: calibrated in full by the session, then its drift on top."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from joint_errors import with_joint_errors
from long_form import more
from shift import BALL, NOISE_M, T_SENSOR_BASE, DriftingRobot, Sample, built, postures, warmed

from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Proposal
from robocal_ros.identification.known_model import known_model
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import layer_of, model_document, payload_note
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome, digest
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import ThermalSession, configuration, session_as_recorded

CALIBRATION, POSES, KELVIN = 300, 8, 15.0


class Robot(DriftingRobot):
    """One with joint errors as a real UR10's, and a file that knows the load, or not.

    Calibrated, with its full model in force, and the cold reference captured.

    ``softer``: how many times as far its joints wind.

    ``parts``: what was measured and the command that used it, each with what was in force before.
    """

    def __init__(self, folder: Path, *, weighed: bool = True, softer: float = 1.0) -> None:
        super().__init__(folder, ThermalConfig(sigma_m=NOISE_M, hold_out=0.2), POSES)
        self.history.close()
        cold = with_joint_errors(built(self.nominal), 1)
        winds = replace(cold.functions, compliance=softer * cold.functions.compliance)
        self.cold = replace(cold, functions=winds)
        self.nominal = replace(self.nominal, load=self.cold.load if weighed else None)
        self.start()
        self.check = postures(self.nominal, 60, seed=9)
        self.parts: list[tuple[Command, list[Sample], Outcome]] = []
        self.calibrated = self.visit(events.IDENTIFY, postures(self.nominal, CALIBRATION, seed=4))
        self.take(self.calibrated)
        captured = self.visit(events.CAPTURE_REFERENCE, np.tile(self.q, (3, 1)), 0.0, 0.1)
        assert captured.done, captured.message

    def visit(self, command: str, q: np.ndarray, kelvin: float = 0.0, after_h: float = 0.0):
        before = configuration(self.session)
        samples = list(self.shift.visit(warmed(self.cold, kelvin), q, after_h))
        self.feed(samples)
        found = self.ask(command)
        self.parts.append((before, samples, found))
        return found

    def take(self, found: Outcome) -> None:
        assert found.status is Code.ACCEPT, found.message
        assert self.ask(events.ACCEPT, id=found.calibration_id).done

    def error_m(self, arm: SerialArm, kelvin: float) -> float:
        """Rms distance of the ball from where a model of the arm has it, static errors and all."""
        cell = replace(self.session.reference.cell, arm=arm)
        told = cell.predict(self.check, np.zeros(len(self.check), dtype=np.int64))[:, :3, 3]
        true = (T_SENSOR_BASE @ warmed(self.cold, kelvin).fk(self.check) @ BALL)[:, :3]
        return float(np.sqrt(np.mean(np.sum((told - true) ** 2, axis=1))))


@pytest.fixture
def robot(tmp_path) -> Robot:
    return Robot(tmp_path / "live")


def test_the_drift_comes_on_top_of_the_full_model(robot):
    document = robot.calibrated.document
    assert document["model"] == "full"
    assert all(joint["function"] for joint in document["joints"])
    cold_m = robot.error_m(robot.session.current.arm, 0.0)
    known, first = known_model(robot.session.current.arm), np.zeros(60, dtype=np.int64)
    variance = known.predicted_variance(robot.check, first, ("base", "tool"))
    # as a model that was read back says; the reference's base and ball add to it
    assert cold_m > 0.5 * np.sqrt(np.mean(np.trace(variance, axis1=1, axis2=2)))
    assert cold_m < 2.0 * np.sqrt(np.mean(np.trace(variance, axis1=1, axis2=2)))
    found = robot.visit(events.IDENTIFY, robot.q, KELVIN, 2.0)
    robot.take(found)
    before, now = robot.session.reference.cell.arm, robot.session.current.arm
    for name in ("first", "step", "coefficients", "compliance"):
        held = (getattr(arm.functions, name) for arm in (before, now))
        np.testing.assert_array_equal(*held)
    known_m = 3e-3 * found.document["calibrated"]["predicted"]["workspace_rms_mm"]  # 99.7 %
    assert robot.error_m(now, KELVIN) < np.hypot(cold_m, known_m)
    assert robot.error_m(before, KELVIN) > 5.0 * robot.error_m(now, KELVIN)
    assert robot.error_m(replace(now, functions=None), KELVIN) > 10.0 * robot.error_m(now, KELVIN)
    stamp_ns = robot.session.desk.clock_ns
    told, in_force = robot.session.accuracy(stamp_ns), model_document(now)
    robot.history.close()
    assert robot.start().accuracy(stamp_ns) == told  # a session that starts anew goes on with it
    assert model_document(robot.session.current.arm) == in_force


@pytest.mark.parametrize(
    ("begun", "weighed"),
    [(2, True), *more((0, True), (1, True), (2, False))],
    ids=["cycle", *more("calibration", "reference", "cycle, masses found")],
)
def test_a_replay_gives_the_same_wherever_the_recording_began(tmp_path, begun, weighed):
    robot = Robot(tmp_path / "live", weighed=weighed, softer=1.0 if weighed else 10.0)
    robot.take(robot.visit(events.IDENTIFY, robot.q, KELVIN, 2.0))
    with CalibrationHistory.open(
        "s1", model_hash=robot.nominal.model_hash, state_dir=tmp_path / "again"
    ) as history:
        again = session_as_recorded(robot.nominal, history, robot.parts[begun][0], "test")
        for _, samples, live in robot.parts[begun:]:
            found = _again(again, samples, live.command)
            assert found.message == live.message
            assert digest(found.document) == digest(live.document)
            if found.document is not None:
                _again(again, [], Command(events.ACCEPT, {"id": found.calibration_id}))
        assert again.in_force.model == robot.session.in_force.model


def _again(session: ThermalSession, samples: Sequence[Sample], command: Command) -> Outcome:
    for sample in samples:
        session.add(sample)
    session.submit(command)
    return session.advance(wall_ns=1, force=True)[-1]


def test_a_few_poses_of_an_arm_with_functions_do_not_lose_them(tmp_path):
    """Where the robot's file has them: thirty poses tell nothing of six joints' functions."""
    robot = Robot(tmp_path / "live")
    known = robot.session.current.arm
    of_file = replace(known, load=robot.nominal.load)
    with CalibrationHistory.open(
        "s2", model_hash=of_file.model_hash, state_dir=tmp_path
    ) as history:
        session = ThermalSession(of_file, history, robot.config, "test")
        worn = warmed(robot.cold, 30.0)
        samples = list(robot.shift.visit(worn, postures(of_file, 30, seed=2), 1.0))
        found = _again(session, samples, Command(events.IDENTIFY))
        assert found.status is Code.ACCEPT, found.message
        functions, _ = layer_of(history.model(found.calibration_id))
        np.testing.assert_array_equal(functions.coefficients, known.functions.coefficients)


def test_a_drift_keeps_the_load_that_the_compliances_were_found_with(robot, tmp_path):
    """The file says another payload from now on: what that may cost is told with each revision."""
    found_with = robot.nominal.load
    present = replace(found_with, payload_mass=found_with.payload_mass + 80.0)
    robot.history.close()
    robot.nominal = replace(robot.nominal, load=present)
    robot.start()
    captured = robot.visit(events.CAPTURE_REFERENCE, np.tile(robot.q, (3, 1)), 0.0, 0.1)
    assert captured.done, captured.message
    found = robot.visit(events.IDENTIFY, robot.q, KELVIN, 2.0)
    _, load = layer_of(robot.history.model(found.calibration_id))
    assert load.payload_mass == found_with.payload_mass
    note = payload_note(robot.session.current.arm, load, present)
    assert "identified with a payload of 10 kg" in note


def test_a_drift_comes_on_top_of_compliances_that_were_found_without_masses(tmp_path):
    """They are held, also where the file states a payload later: that is told, and not added."""
    robot = Robot(tmp_path / "live", weighed=False, softer=10.0)
    assert robot.calibrated.document["masses"] == "found"
    cold, held = robot.session.current.arm, robot.session.reference.cell.arm.functions
    assert cold.load.found
    found = robot.visit(events.IDENTIFY, robot.q, KELVIN, 2.0)
    robot.take(found)
    functions, load = layer_of(robot.history.model(found.calibration_id))
    np.testing.assert_array_equal(functions.compliance, held.compliance)
    assert load.found
    warm, cold_m = robot.session.current.arm, robot.error_m(cold, 0.0)
    known_m = 3e-3 * found.document["calibrated"]["predicted"]["workspace_rms_mm"]  # 99.7 %
    assert robot.error_m(warm, KELVIN) < np.hypot(cold_m, known_m) < robot.error_m(cold, KELVIN)

    robot.history.close()
    stated = replace(robot.cold.load, payload_mass=80.0)
    robot.nominal = replace(robot.nominal, load=stated)
    robot.start()
    used = robot.session.current.arm
    np.testing.assert_array_equal(used.fk(robot.check), warm.fk(robot.check))
    assert "without masses the model cannot follow" in payload_note(used, load, stated)


def test_other_joint_functions_than_the_references_are_not_put_out_of_force(robot):
    other = with_joint_errors(built(robot.nominal), 2)
    proposed = Proposal(
        model_hash=robot.nominal.model_hash,
        based_on=robot.session.in_force.revision,
        cycle_id="other",
        stamp_ns=robot.shift.now_ns,
        created_ns=0,
        software="test",
        method="map",
        code=Code.ACCEPT,
        reason="",
        document={},
        model=model_document(other),
    )
    assert robot.ask(events.ACCEPT, id=robot.history.propose(proposed)).done
    found = robot.visit(events.IDENTIFY, robot.q, KELVIN, 2.0)
    assert found.status is Code.CONFLICT
    assert "other joint functions than the cold reference: capture a new one" in found.message
