"""Beyond its bounds and limits nothing is corrected, nor with a model of others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from correction_robot import (
    HOME,
    NAMES,
    NOMINAL,
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
from robocal_ros.correction.interface import Reason, TrajectoryCommand
from robocal_ros.correction.joint_correction import JointCorrection


def test_joint_limits_hold_after_the_correction(warm: Robot) -> None:
    q = HOME.copy()
    q[1] = NOMINAL.upper[1]
    # One side of the limit or the other: the correction decides, and never passes it.
    shift = (warm.stream() - HOME)[1]
    q[1] = NOMINAL.upper[1] - 0.5 * shift if shift > 0 else NOMINAL.lower[1] - 0.5 * shift
    trajectory = TrajectoryCommand(NAMES, np.stack([HOME, q]), np.array([0.0, 5.0]))
    assert "point 2" in refused(Reason.JOINT_LIMIT, warm.session.trajectory, trajectory, warm.now)


def test_limits_hold_when_off_too(robot: Robot) -> None:
    q = HOME.copy()
    q[4] = 3.0
    robot.at = q
    robot.rest()
    refused(Reason.JOINT_LIMIT, robot.stream, q)


def test_a_drift_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    robot.read(HOME)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(drifted(12.0)))
    assert "mm" in said
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_a_tool_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(11e-3, 0.0))
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(0.0, 4.1))
    robot.session.offer_tool(bent_tool(10e-3, 3.0))
    wrong = bent_tool(parent="flange")
    refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)


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


def test_without_serials_robots_share_a_model_only_with_the_same_robot_file() -> None:
    nameless = Robot(robot_file_hash="0123456789abcdef")
    for other in ("", "fedcba9876543210"):
        told = refused(
            Reason.WRONG_ROBOT,
            nameless.session.offer_model,
            offer(drifted(), robot_file_hash=other),
        )
        assert "set the serial" in told
        refused(Reason.WRONG_ROBOT, nameless.session.offer_tool, bent_tool(robot_file_hash=other))
    nameless.session.offer_model(offer(drifted(), robot_file_hash="0123456789abcdef"))
    nameless.session.offer_tool(bent_tool(robot_file_hash="0123456789abcdef"))
    named = Robot()
    named.session.offer_model(offer(drifted(), robot_file_hash="fedcba9876543210"))


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
    robot.session.take_over()
    assert robot.session.status().revision is None
    robot.rest()
    robot.session.trajectory(still(first_s=1.0), robot.now)
    robot.session.take_over()
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
        assert "take_over" in said
        assert robot.session.status().revision == 7
        assert robot.session.status().waiting_revision == old.revision
    robot.session.enable(on)  # is no look at it
    assert robot.session.status().revision == 7
    robot.session.take_over()
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
