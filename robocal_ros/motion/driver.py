"""Sends the motions of a node to the robot's controller, and says what it makes of them.

Motions go as goals of FollowJointTrajectory: a rejection, a violated tolerance and an end are then
known. Where nobody serves that action they go on a topic, which tells nothing. Whoever moves the
robot holds the cell's motion lease meanwhile (docs/tool.md).
"""

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionClient
from rclpy.task import Future
from robocal_msgs.msg import MotionLease
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.ground.errors import InputError
from robocal_ros.motion.messages import StatedController
from robocal_ros.motion.plan import REACTION_S, JointPlan
from robocal_ros.motion.robot_watch import MotionReport, RobotWatch, SpeedScaling
from robocal_ros.motion.settings import trajectory_message
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.parameters import Setting

CONTROLLER = (
    Setting(
        "follow_joint_trajectory",
        "",
        "FollowJointTrajectory of the robot's controller, for example "
        "/joint_trajectory_controller/follow_joint_trajectory; empty, or while nobody serves it: "
        "motions go on ~/joint_trajectory, and no rejection is seen",
    ),
    Setting(
        "hard_stop_service",
        "",
        "std_srvs/Trigger that stops a robot which does not obey its stops; empty: there is none",
    ),
)
LEASE_S = 0.2  # between two messages of a lease that is held
VIOLATIONS = {
    FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED: "PATH_TOLERANCE_VIOLATED",
    FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED: "GOAL_TOLERANCE_VIOLATED",
}


class MotionDriver:
    """One client of the controller, and what the controller says of itself.

    Parameters
    ----------
    reported : takes what the controller makes of the motion that was sent last.
    tolerances : of motions, see `goal_tolerances`; a stop has the controller's own, and is watched.
    robot : where readings of the controller go now; None: nowhere.
    now : their steady clock.

    Attributes
    ----------
    way : how the last motion went out, in words; empty before any.
    """

    def __init__(
        self,
        node: EndpointNode,
        names: Sequence[str],
        action: str,
        hard_stop: str,
        tolerances: Mapping[str, Any],
        reported: Callable[[MotionReport], None],
        robot: Callable[[], RobotWatch | None],
        now: Callable[[], float],
    ) -> None:
        self._node, self._names, self._reported, self._robot = node, names, reported, robot
        self._tolerances = dict(tolerances)
        self._index: dict[tuple[str, ...], list[int]] = {}
        self._now = now
        self.topic = node.add_output(JointTrajectory, "~/joint_trajectory", endpoints.RELIABLE)
        self.action = node.resolve_topic_name(action) if action else ""
        self._client = None
        if self.action:  # rclpy remaps the parts of an action, but not its name
            self._client = ActionClient(node, FollowJointTrajectory, self.action)
        self._hard_stop = node.add_client(Trigger, hard_stop) if hard_stop else None
        node.add_input(
            JointTrajectoryControllerState, "controller_state", self._take_state, endpoints.SENSOR
        )
        node.add_input(Float64, "speed_scaling", self._take_scaling, endpoints.SENSOR)
        self._controller = StatedController()
        self._scaling, self._rejected = SpeedScaling(), False
        self._newest = 0
        self.way = ""

    def close(self) -> None:
        """Take the action's client down, while nothing spins it."""
        if self._client is not None:
            self._client.destroy()
        self._client = None

    # ---- motions --------------------------------------------------------------------------------

    def send(self, plan: JointPlan, *, stop: bool) -> None:
        """Send a motion, which takes the place of what the controller drives.

        A stop is worded by what the controller says of itself (`StatedController`). After a
        rejection no stamp is trusted.
        """
        self._rejected = self._rejected and stop
        if stop:
            now_s = self._now()
            message = self._controller.stop_message(
                plan.going_on(REACTION_S),
                self._names,
                now_s,
                self._scaling.at(now_s),
                trusted=not self._rejected,
            )
        else:
            message = trajectory_message(plan, self._names)
        self._newest += 1
        number = self._newest
        if self._client is None or not self._client.server_is_ready():
            self.topic.publish(message)
            self._say(f"the topic {self.topic.topic_name}; no rejection is seen")
            return
        tolerances = {} if stop else self._tolerances
        goal = FollowJointTrajectory.Goal(trajectory=message, **tolerances)
        future = self._client.send_goal_async(goal)
        future.add_done_callback(guarded(self._node, lambda done: self._answered(number, done)))
        self._say(f"the action {self.action}")

    def _say(self, way: str) -> None:
        if way == self.way:
            return
        self.way, logger = way, self._node.get_logger()
        if self.action and not way.startswith("the action"):
            logger.warning(f"nobody serves {self.action}: motions go on {way}")
        else:
            logger.info(f"motions go on {way}")

    def _answered(self, number: int, future: Future) -> None:
        handle: Any = future.result()
        if not handle.accepted:
            self._rejected = True
            self._report(number, failed=True, words="the controller rejected the motion")
            return
        self._report(number)
        result = handle.get_result_async()
        result.add_done_callback(guarded(self._node, lambda done: self._ended(number, done)))

    def _ended(self, number: int, future: Future) -> None:
        answer: Any = future.result()
        result, succeeded = answer.result, answer.status == GoalStatus.STATUS_SUCCEEDED
        code = VIOLATIONS.get(result.error_code, result.error_code)
        words = f"the controller ended the motion ({code}): {result.error_string}"
        self._report(number, ended=True, failed=not succeeded, words=words)

    def _report(self, number: int, **found: Any) -> None:
        """Of the newest motion; one before it ended because this one took its place."""
        if number == self._newest:
            self._reported(MotionReport(**found))

    def hard_stop(self, why: str) -> None:
        """The robot does not obey: stop it by the service, where there is one."""
        logger = self._node.get_logger()
        client = self._hard_stop
        if client is None:
            logger.error(f"{why}: stop it by hand (hard_stop_service is empty)")
            return
        logger.error(f"{why}: {client.srv_name} is called")

        def told(future: Future) -> None:
            answer: Any = future.result()
            logger.error(f"{client.srv_name}: {answer.success} {answer.message}")

        client.call_async(Trigger.Request()).add_done_callback(guarded(self._node, told))

    # ---- what the controller says ---------------------------------------------------------------

    def _take_state(self, message: Any) -> None:
        robot, now_s = self._robot(), self._now()
        names = tuple(message.joint_names)
        if names not in self._index:
            if missing := [name for name in self._names if name not in names]:
                raise InputError(f"no joint {', '.join(missing)} in this controller")
            self._index = {names: [names.index(name) for name in self._names]}
        index, count = self._index[names], len(names)
        self._scaling.controller(getattr(message, "speed_scaling_factor", np.nan), now_s)
        self._controller.take(message, self._scaling.at(now_s), now_s)
        if robot is not None:
            robot.held_s = self._controller.held_s
            self._tell_scaling(robot, now_s)
        reference = message.reference
        if len(reference.positions) != count or len(reference.velocities) != count:
            return  # a controller that holds may leave them out
        q, qd = np.array(reference.positions)[index], np.array(reference.velocities)[index]
        if robot is not None:
            robot.controller(q, qd, now_s)

    def hear(self, message: Any) -> None:
        """Take a JointState, which may tell whether there are velocities."""
        self._controller.hear(message.velocity, len(message.name), self._now())

    def _take_scaling(self, message: Any) -> None:
        robot, now_s = self._robot(), self._now()
        self._scaling.slider(message.data, now_s)
        if robot is not None:
            self._tell_scaling(robot, now_s)

    def _tell_scaling(self, robot: RobotWatch, now_s: float) -> None:
        scaling = self._scaling.at(now_s)
        if scaling is not None:
            robot.scaled(scaling, now_s)


def guarded(node: EndpointNode, callback: Callable[[Future], None]) -> Callable[[Future], None]:
    """For a client's callback: an exception in it would end the process."""

    def call(future: Future) -> None:
        try:
            callback(future)
        except Exception:
            node.get_logger().error(traceback.format_exc())

    return call


class LeaseHolder:
    """Says on ``motion_lease`` that this node moves the robot, five times a second."""

    def __init__(self, node: EndpointNode, robot: str, serial: str) -> None:
        self._node, self._robot, self._serial = node, robot, serial
        self._output = node.add_output(MotionLease, "motion_lease", endpoints.LATCHED)
        self._held, self._told_s = False, -np.inf

    def hold(self, purpose: str) -> None:
        """Hold it, for this purpose; empty: let it go. Call it often."""
        now_s = time.monotonic()
        held = bool(purpose)
        if held == self._held and not (held and now_s - self._told_s >= LEASE_S - 0.01):
            return
        self._held, self._told_s = held, now_s
        self._output.publish(
            MotionLease(
                header=conversions.header(self._node.now_ns(), ""),
                robot=self._robot,
                serial=self._serial,
                holder=self._node.get_fully_qualified_name(),
                held=held,
                purpose=purpose,
            )
        )
