# SPDX-License-Identifier: Apache-2.0
"""A simulated controller with the action FollowJointTrajectory, as joint_trajectory_controller.

It begins where it is and as fast as it is, follows with a lag, watches the path tolerance, aborts a
goal for a newer one, holds when it is cancelled, and rejects a goal without points. Run as a script
it is a process of its own; with ``hostile`` its feedback is what vendors send, and worse.
"""

import copy
import sys
from array import array
from dataclasses import dataclass
from typing import Any

import numpy as np
import rclpy
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionServer, CancelResponse, GoalResponse
from rclpy.node import Node
from rclpy.task import Future
from scipy.interpolate import CubicHermiteSpline
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectoryPoint

ACTION = "/arm_controller/follow_joint_trajectory"
NAMES = [f"joint_a{i}" for i in range(1, 7)]
HOME = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])
TICK_S = 0.02
LAG = 0.5  # of the way in each tick
THERE = 1e-6
Result = FollowJointTrajectory.Result


@dataclass(eq=False)
class Path:
    """A goal that is followed."""

    goal: Any
    times: np.ndarray
    points: np.ndarray
    spline: Any  # where all points have velocities
    begun_s: float
    ended: Future

    def end(self, code: int, words: str) -> None:
        if not self.ended.done():
            self.ended.set_result(Result(error_code=code, error_string=words))


class Follower(Node):
    """The controller and its robot.

    Attributes
    ----------
    goals : as they were received, rejected ones too.
    feedback : what it sent.
    stuck : the robot does not move.
    rejects : all goals.
    hostile : feedback of odd lengths and with numbers that are none.
    """

    def __init__(self, **options: Any) -> None:
        super().__init__("arm_controller", **options)
        self.q, self.hold = HOME.copy(), HOME.copy()
        self.goals: list[Any] = []
        self.feedback: list[Any] = []
        self.stuck = self.rejects = self.hostile = False
        self.speed = np.zeros(6)
        self.path: Path | None = None
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self._server = ActionServer(
            self,
            FollowJointTrajectory,
            ACTION,
            self._execute,
            goal_callback=self._asked,
            cancel_callback=self._cancelled,
        )
        self.create_timer(TICK_S, self._tick)

    def close(self) -> None:
        """Go, so that others see it gone."""
        self._server.destroy()
        self.destroy_node()

    def _asked(self, request: Any) -> GoalResponse:
        self.goals.append(request)
        good = request.trajectory.points and set(request.trajectory.joint_names) == set(NAMES)
        return GoalResponse.ACCEPT if good and not self.rejects else GoalResponse.REJECT

    async def _execute(self, goal: Any) -> Any:
        if self.path is not None:
            self.path.end(Result.INVALID_GOAL, "preempted by a newer goal")
        trajectory = goal.request.trajectory
        order = [trajectory.joint_names.index(name) for name in NAMES]
        from_start = [p.time_from_start for p in trajectory.points]
        times = np.array([t.sec + t.nanosec * 1e-9 for t in from_start])
        points = np.array([p.positions for p in trajectory.points])[:, order]
        spline = None
        if times[0] > 0.0:  # it leads in from where it is, as fast as it is
            times, points = np.array([0.0, *times]), np.vstack([self.hold, points])
        if all(len(p.velocities) for p in trajectory.points):
            speeds = np.array([p.velocities for p in trajectory.points])[:, order]
            speeds = np.vstack([self.speed, speeds])[-len(times) :]
            spline = CubicHermiteSpline(times, points, speeds)
        path = self.path = Path(goal, times, points, spline, self._now_s(), Future())
        result = await path.ended
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.error_code == Result.SUCCESSFUL:
            goal.succeed()
        else:
            goal.abort()
        return result

    def _cancelled(self, goal: Any) -> CancelResponse:
        if self.path is not None and self.path.goal == goal:
            self.path.end(Result.SUCCESSFUL, "")
            self.path, self.hold = None, self.q.copy()
        return CancelResponse.ACCEPT

    def _now_s(self) -> float:
        return self.get_clock().now().nanoseconds * 1e-9

    def _tick(self) -> None:
        path = self.path
        if path is not None:
            at = self._now_s() - path.begun_s
            before = self.hold
            if path.spline is not None:
                self.hold = path.spline(np.clip(at, path.times[0], path.times[-1]))
            else:
                self.hold = np.array([np.interp(at, path.times, row) for row in path.points.T])
            self.speed = (self.hold - before) / TICK_S
        else:
            self.speed = np.zeros(6)
        lag = 0.0 if self.stuck else LAG
        moved = lag * (self.hold - self.q)
        self.q = self.q + moved
        stamp = self.get_clock().now().to_msg()
        state = JointState(name=NAMES, position=self.q.tolist())
        state.header.stamp = stamp
        self._states.publish(state)
        if path is not None:
            self._tell(path, moved / TICK_S)
            self._judge(path, at)

    def _tell(self, path: Path, speed: np.ndarray) -> None:
        def point(position: np.ndarray, velocity: np.ndarray) -> JointTrajectoryPoint:
            return JointTrajectoryPoint(
                positions=position.tolist(),
                velocities=velocity.tolist(),
                accelerations=[0.5] * 6,
            )

        message = FollowJointTrajectory.Feedback(joint_names=NAMES)
        message.desired = point(self.hold, 2.0 * speed)
        message.actual = point(self.q, speed)
        message.error = point(self.hold - self.q, speed)
        message.multi_dof_joint_names = ["rail"]
        self.feedback.append(message)
        path.goal.publish_feedback(message)
        if self.hostile:
            for strange in hostile_feedback(message):
                path.goal.publish_feedback(strange)

    def _judge(self, path: Path, at: float) -> None:
        error = np.abs(self.hold - self.q)
        for tolerance in path.goal.request.path_tolerance:
            if error[NAMES.index(tolerance.name)] > tolerance.position:
                path.end(Result.PATH_TOLERANCE_VIOLATED, f"path tolerance of {tolerance.name}")
                self.path, self.hold = None, self.q.copy()
                return
        if at >= path.times[-1] and error.max() < THERE:
            path.end(Result.SUCCESSFUL, "Goal successfully reached!")
            self.path = None


def hostile_feedback(message: Any) -> list[Any]:
    """What some controllers send, and what none should."""
    out = []
    for velocities, positions, names in (
        (array("d", [0.1] * 3), None, None),
        (array("d", [np.nan] * 6), None, None),
        (array("d", [0.1] * 9), None, None),
        (None, array("d", [np.nan] * 6), None),
        (None, array("d", [0.1] * 2), None),
        (None, array("d"), None),
        (None, None, []),
        (None, None, ["x"] * 6),
        (None, None, [NAMES[0]] * 6),
        (array("d"), array("d", [1e300] * 6), None),
    ):
        strange = copy.deepcopy(message)
        for point in (strange.desired, strange.actual):
            point.velocities = point.velocities if velocities is None else velocities
            point.positions = point.positions if positions is None else positions
            point.effort = array("d", [np.nan] * 2)
        strange.joint_names = strange.joint_names if names is None else names
        out.append(strange)
    return out


if __name__ == "__main__":
    rclpy.init()
    robot = Follower()
    robot.hostile = "hostile" in sys.argv
    rclpy.spin(robot)
