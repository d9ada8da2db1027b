"""Beyond its bounds and limits nothing is corrected, nor with a model of others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    NAMES,
    NOMINAL,
    RATE,
    ROUNDING,
    Robot,
    bent_tool,
    distance,
    drifted,
    good_here_only,
    offer,
    pose,
    refused,
    still,
)

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.correction.refusals import Reason


def test_joint_limits_hold_after_the_correction(warm: Robot) -> None:
    q = HOME.copy()
    q[1] = NOMINAL.upper[1]
    # One side of the limit or the other: the correction decides, and never passes it.
    shift = (warm.stream() - HOME)[1]
    q[1] = NOMINAL.upper[1] - 0.5 * shift if shift > 0 else NOMINAL.lower[1] - 0.5 * shift
    said = refused(Reason.JOINT_LIMIT, warm.stream, q)
    assert "joint_a2" in said
    trajectory = TrajectoryCommand(NAMES, np.stack([HOME, q]), np.array([0.0, 1.0]))
    assert "point 2" in refused(Reason.JOINT_LIMIT, warm.session.trajectory, trajectory, warm.now)


def test_limits_hold_when_off_too(robot: Robot) -> None:
    q = HOME.copy()
    q[4] = 3.0
    robot.at = q
    refused(Reason.JOINT_LIMIT, robot.stream, q)


def test_a_drift_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    robot.read(HOME)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(drifted(12.0)))
    assert "mm" in said
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_a_blend_that_waits_says_why(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.stream()
    robot.session.enable(True)
    robot.stream()
    assert robot.session.status().waits == ""
    robot.read(robot.at)
    robot.session.target(JointCommand(NAMES[:1], HOME[:1]), robot.now)
    assert "part of the joints" in robot.session.status().waits
    robot.stream()
    assert robot.session.status().waits == ""
    part = TrajectoryCommand(NAMES[:1], HOME[None, :1], np.array([1.0]))
    robot.session.trajectory(part, robot.now)
    assert "part of the joints" in robot.session.status().waits
    robot.session.enable(False)
    robot.settle()
    robot.stream()
    assert robot.session.status().waits == ""


def test_where_the_bound_is_reached_the_blend_waits(robot: Robot) -> None:
    """Without readings the model is judged only when commands come."""
    robot.session.offer_model(offer(drifted(12.0)))
    robot.session.enable(True)
    outputs = [robot.stream() for _ in range(1500)]
    status = robot.session.status()
    assert status.held > 0
    assert "1 mm" in status.waits
    assert not status.settled
    assert status.tcp_shift_m <= 1e-3
    assert np.array_equal(outputs[-1], outputs[-2])
    # disabling leads back without any refusal
    robot.session.enable(False)
    assert np.array_equal(robot.settle(), HOME)
    # a trajectory is refused as a whole
    robot.session.enable(True)
    long = TrajectoryCommand(NAMES, np.tile(HOME, (2, 1)), np.array([0.0, 60.0]))
    refused(Reason.TCP_BOUND, robot.session.trajectory, long, robot.now)


def test_a_tool_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(11e-3, 0.0))
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(0.0, 4.1))
    robot.session.offer_tool(bent_tool(10e-3, 3.0))
    wrong = bent_tool(parent="flange")
    refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)


def test_near_a_singularity_a_drift_is_corrected_in_part_and_a_tool_not_at_all(
    warm: Robot,
) -> None:
    q = HOME.copy()
    for q[4] in np.linspace(0.9, 0.0, 500):
        out = warm.stream(q)
        assert np.abs(out - q).max() <= np.radians(0.3)
    assert warm.session.status().reduced > 0
    q[4] = 0.1
    last = warm.stream(q)
    warm.change_tool(bent_tool(2e-3, 2.0))
    for _ in range(6000):
        out = warm.stream(q)
        assert np.abs(out - last).max() <= RATE * DT + ROUNDING
        last = out
    status = warm.session.status()
    assert status.held > 0
    assert not status.settled
    # settled elsewhere, it is refused there
    warm.settle()
    refused(Reason.JOINT_BOUND, warm.stream, q)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"accepted": False}, Reason.NOT_ACCEPTED),
        ({"robot": "UR10"}, Reason.WRONG_ROBOT),
        ({"serial": "s2"}, Reason.WRONG_ROBOT),
        ({"model_hash": "0123456789abcdef"}, Reason.WRONG_ROBOT),
        ({"joint_names": NAMES[::-1]}, Reason.WRONG_ROBOT),
    ],
)
def test_models_of_others_are_not_taken_over(
    robot: Robot, change: dict[str, Any], reason: Reason
) -> None:
    refused(reason, robot.session.offer_model, offer(drifted(), **change))
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)
    assert robot.session.status().revision is None


def test_revisions_only_grow(warm: Robot) -> None:
    warm.session.offer_model(offer(drifted(), 1))  # the same again, from a restarted node
    refused(Reason.OLD_REVISION, warm.session.offer_model, offer(drifted(0.5), 1))
    warm.session.offer_model(offer(drifted(0.5), 3))
    refused(Reason.OLD_REVISION, warm.session.offer_model, offer(drifted(), 2))
    assert warm.session.status().revision == 3


def test_a_model_that_is_too_large_elsewhere_is_announced(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted()))
    assert robot.session.status().survey.beyond == 0.0
    assert 0.0 < robot.session.status().survey.worst_m < 1e-3
    arm, _ = good_here_only()
    robot.stream()
    robot.session.offer_model(offer(arm, 2))
    survey = robot.session.status().survey
    assert robot.session.status().revision == 2
    # against ten times as many other postures
    q = np.random.default_rng(1).uniform(NOMINAL.lower, NOMINAL.upper, (10_000, 6))
    shift = JointCorrection.between(NOMINAL, arm).correct(q)
    beyond = 1.0 - np.mean(CorrectionConfig().thermal.hold(shift))
    assert beyond > 0.05
    assert survey.beyond == pytest.approx(beyond, abs=0.05)
    assert survey.worst_m == pytest.approx(shift.tcp_shift_m.max(), rel=0.2)
    assert "of the postures" in str(survey)


def test_a_model_that_is_too_large_where_the_robot_goes_is_not_taken_over(robot: Robot) -> None:
    """It is sent far away, and has not got there yet."""
    arm, far = good_here_only()
    robot.read(HOME)
    path = TrajectoryCommand(NAMES, np.stack([HOME, far]), np.array([0.0, 60.0]))
    robot.session.trajectory(path, robot.now)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(arm))
    assert "of the postures" in said
    assert robot.session.status().waiting_revision == 1
    # there, too, the operator's look does not help; at home it does
    robot.session.enable(True)
    assert robot.session.status().revision is None
    robot.session.trajectory(still(), robot.now)
    robot.session.enable(True)
    assert robot.session.status().revision == 1
    assert robot.session.status().waiting_revision is None


@pytest.mark.parametrize("revision", [1, 7])
def test_a_history_that_began_again_is_taken_over_by_its_stamp(revision: int) -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=10**15))
    later = offer(drifted(0.5), revision, stamp_ns=10**15 + 1)
    robot.session.offer_model(later)
    assert robot.session.status().revision == revision
    robot.session.enable(True)
    q = robot.settle()
    assert distance(pose(drifted(0.5), q), pose(NOMINAL, HOME)) < 1e-9


@pytest.mark.parametrize("on", [False, True])
def test_a_history_that_began_again_waits_for_the_operator_without_a_newer_stamp(on: bool) -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=10**15))
    for old in (offer(drifted(0.5), 1, stamp_ns=10**15), offer(NOMINAL, 0)):
        said = refused(Reason.OLD_REVISION, robot.session.offer_model, old)
        assert "enable" in said
        assert robot.session.status().revision == 7
        assert robot.session.status().waiting_revision == old.revision
    robot.session.enable(on)
    status = robot.session.status()
    assert (status.revision, status.waiting_revision) == (0, None)
    # what the one in use says again is no news, and nothing waits after it
    refused(Reason.OLD_REVISION, robot.session.offer_model, offer(drifted(0.5), 0))
    robot.session.offer_model(offer(NOMINAL, 0))
    assert robot.session.status().waiting_revision is None


def test_the_frames_of_a_tool_are_those_configured() -> None:
    robot = Robot(tool_frame="welding_gun")
    named = bent_tool(child="welding_gun")
    for wrong in (bent_tool(), replace(named, child="gripper"), replace(named, parent="base")):
        refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)
    assert not robot.session.status().new_tool
    robot.session.offer_tool(named)
    assert robot.session.status().new_tool
