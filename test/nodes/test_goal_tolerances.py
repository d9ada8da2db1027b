# SPDX-License-Identifier: Apache-2.0
"""What goals of our own motions allow the controller's robot, and what is told where it is not."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer
from test_maintenance_driver import driving

from robocal_ros.cell_sim.messages import tolerances_of
from robocal_ros.cell_sim.trajectory_controller import (
    GoalCode,
    GoalState,
    JointMotion,
    Tolerances,
    Trajectory,
    TrajectoryGoal,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.driver import goal_tolerances
from robocal_ros.motion.plan import JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import UNSAID_S, MotionReport

ARM = load_robot("ur10")
Q_START = np.radians([2.3, -124.4, -70.9, 107.7, -91.1, 91.8])
FASTEST = 1.0  # rad/s, of each joint
DRIVING = DrivingConfig(
    Housing(0.06, 0.03, -0.12, 0.05),
    0.1,
    0.008,
    0.05,
    limits=MotionLimits(joint_velocity=FASTEST),
)
NONE = np.zeros(ARM.n)
RESULT = FollowJointTrajectory.Result


def given(arm: SerialArm = ARM) -> Tolerances:
    """What a controller that is stricter itself makes of a goal's."""
    goal = FollowJointTrajectory.Goal(**goal_tolerances(arm, DRIVING))
    return tolerances_of(goal, tuple(arm.joint_names), Tolerances(NONE + 1e-3, NONE, 0.0))


def driven(lag_s: float, to_s: float) -> tuple[TrajectoryGoal, np.ndarray]:
    """A goal of a second in which each joint is as fast as it may be; it, and the joints then."""
    robot = JointMotion(Q_START, names=tuple(ARM.joint_names), lag_s=lag_s)
    far = Q_START[None] + FASTEST / 1.5
    goal = TrajectoryGoal(Trajectory.of(ARM.joint_names, [1.0], far, NONE[None]), given())
    robot.take(0.0, goal)
    robot.pass_to(to_s)
    return goal, robot.at([to_s])[0][0]


@pytest.mark.parametrize("lag_s", [0.0, 0.014, 0.24])
def test_a_robot_that_lags_no_more_than_our_own_watch_allows_keeps_its_goal(lag_s: float) -> None:
    assert lag_s < DRIVING.late_s + UNSAID_S
    goal, q = driven(lag_s, 3.0)
    assert goal.state is GoalState.SUCCEEDED
    assert q == pytest.approx(Q_START + FASTEST / 1.5, abs=1e-9)


def test_a_robot_that_does_not_follow_loses_its_goal_on_the_way() -> None:
    """At 1 rad/s half a second behind is 0.5 rad; 0.5 deg and a quarter of a second are allowed."""
    goal, _ = driven(0.5, 0.9)
    assert (goal.state, goal.code) == (GoalState.ABORTED, GoalCode.PATH_TOLERANCE_VIOLATED)


def test_turning_joints_go_by_the_angle_and_a_prismatic_one_by_the_way() -> None:
    found = given(replace(ARM, prismatic=np.eye(ARM.n, dtype=bool)[0]))
    near = np.full(ARM.n, DRIVING.deviation_rad)
    near[0] = DRIVING.deviation_m
    assert found.goal == pytest.approx(near)
    assert found.path == pytest.approx(near + FASTEST * (DRIVING.late_s + UNSAID_S))


@pytest.mark.parametrize("code", ["PATH_TOLERANCE_VIOLATED", "GOAL_TOLERANCE_VIOLATED"])
def test_a_violation_is_told_with_the_controllers_words(graph: Any, code: str) -> None:
    goals: list[Any] = []

    def execute(handle: Any) -> Any:
        goals.append(handle.request)
        handle.abort()
        return RESULT(error_code=getattr(RESULT, code), error_string="joint 3 is held")

    ActionServer(graph.probe, FollowJointTrajectory, "/controller/follow", execute)
    reports: list[MotionReport] = []
    names, tolerances = ARM.joint_names, goal_tolerances(ARM, DRIVING)
    _, motion = driving(graph, names, "/controller/follow", tolerances, reports.append)
    graph.spin_until(lambda: motion._client.server_is_ready(), "the action")
    rest = np.zeros((2, ARM.n))
    plan = JointPlan(np.array([0.0, 1.0]), rest, rest, rest)
    motion.send(plan, stop=False)
    graph.spin_until(lambda: reports and reports[-1].ended, "the end")
    assert reports[-1].failed
    assert reports[-1].words == f"the controller ended the motion ({code}): joint 3 is held"
    assert [each.name for each in goals[0].path_tolerance] == list(names)
    motion.send(plan, stop=True)
    graph.spin_until(lambda: len(goals) == 2, "the stop")
    assert not goals[1].path_tolerance  # nothing of ours ends a stop
    assert not goals[1].goal_tolerance
