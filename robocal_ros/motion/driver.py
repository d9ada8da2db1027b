"""Sends the motions of a node to the robot's controller, and says what it makes of them.

Motions go as goals of FollowJointTrajectory: a rejection, a violated tolerance and an end are then
known. Where nobody serves that action they go on a topic, which tells nothing. Whoever moves the
robot holds the cell's motion lease meanwhile (docs/tool_motion.md).
"""

import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Time
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from numpy.typing import NDArray
from rclpy.action import ActionClient
from rclpy.task import Future
from robocal_msgs.msg import MotionLease
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.core.errors import InputError
from robocal_ros.core.samples import stamp_ns
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import MotionReport, RobotWatch
from robocal_ros.motion.settings import NS, trajectory_message
from robocal_ros.motion.speed_scaling import SpeedScaling
from robocal_ros.nodes import conversions, qos
from robocal_ros.nodes.endpoints import EndpointNode
from robocal_ros.nodes.parameters import Setting

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
LINES_S = 0.01  # between points for a controller that has no velocities
STATED_S = 0.05  # a controller's state that is older, or so far off in its stamp, is not gone by
STAMP_LEAD_S = (
    0.01  # at the present speed, until a stop that is stamped begins: it is taken by then
)
BESIDE = 1e-3  # rad (m); a plan that begins further from the controller's reference is not of it


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
        self.topic = node.add_output(JointTrajectory, "~/joint_trajectory", qos.RELIABLE)
        self.action = node.resolve_topic_name(action) if action else ""
        self._client = None
        if self.action:  # rclpy remaps the parts of an action, but not its name
            self._client = ActionClient(node, FollowJointTrajectory, self.action)
        self._hard_stop = node.add_client(Trigger, hard_stop) if hard_stop else None
        node.add_input(
            JointTrajectoryControllerState, "controller_state", self._take_state, qos.SENSOR
        )
        node.add_input(Float64, "speed_scaling", self._take_scaling, qos.SENSOR)
        self._stated_s = -np.inf  # when the controller told its state
        self._stated: tuple[int, NDArray[np.float64], NDArray[np.float64]] | None = None
        self._ahead_s = np.inf  # its clock, of this one, by its last stamp
        self._scaling, self._rejected = SpeedScaling(), False
        self._velocities = True  # whether the hardware has any, as far as the controller says
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

        A stop is stamped with the controller's own time of the plan's begin, where the controller
        tells its reference: then the command goes on along the plan without a step, whatever the
        hardware tells and however it lags, and a stop that comes after its end is rejected. After
        a rejection no stamp is trusted: then it begins when it arrives, where the robot is
        measured; as lines, where the hardware tells no velocities: the controller would begin
        cubics with a speed of 0 (Trajectory::set_point_before_trajectory_msg, ros2_controllers
        4.42.1).
        """
        self._rejected = self._rejected and stop
        begins_ns = self._begin_ns(plan) if stop and not self._rejected else None
        if begins_ns is not None:
            message = trajectory_message(plan.going_on(STAMP_LEAD_S), self._names, at_once=True)
            message.header.stamp = Time(sec=begins_ns // NS, nanosec=begins_ns % NS)
        else:
            spacing_s = LINES_S if stop and not self._velocities else 0.0
            message = trajectory_message(plan, self._names, spacing_s=spacing_s)
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

    def _begin_ns(self, plan: JointPlan) -> int | None:
        """When the controller is where the plan begins, by its own clock; None: not known.

        A scaled clock counts from a stamp on as if it were not.
        """
        now_s = self._now()
        if self._stated is None or now_s - self._stated_s > STATED_S:
            return None
        if self._scaling.at(now_s) not in (None, 1.0):
            return None
        begin_ns, q, qd = self._stated
        speed = float(np.linalg.norm(qd))
        if not 0.0 < speed < np.inf:
            return None
        after_s = float((plan.q[0] - q) @ qd) / speed**2
        beside = np.max(np.abs(plan.q[0] - q - after_s * qd))
        known = abs(after_s) < STATED_S and beside < BESIDE
        return begin_ns + round(after_s * NS) if known else None

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
        speeds = np.array(message.feedback.velocities, dtype=np.float64)
        known = len(speeds) == count and bool(np.isfinite(speeds).all())
        self._velocities = known and bool(speeds.any())
        begin_ns, self._stated_s, self._stated = stamp_ns(message.header.stamp), now_s, None
        before_s, self._ahead_s = self._ahead_s, begin_ns / NS - now_s
        self._scaling.controller(getattr(message, "speed_scaling_factor", np.nan), now_s)
        if robot is not None:
            self._tell_scaling(robot, now_s)
        reference = message.reference
        if len(reference.positions) != count or len(reference.velocities) != count:
            return  # a controller that holds may leave them out
        q, qd = np.array(reference.positions)[index], np.array(reference.velocities)[index]
        if abs(self._ahead_s - before_s) < STATED_S:
            self._stated = begin_ns, q, qd
        if robot is not None:
            robot.controller(q, qd, now_s)

    def hear(self, message: Any) -> None:
        """Take a JointState: where the controller does not, it tells whether there are velocities.

        Some hardware says 0 in motion; a stop of a robot that stands may be of either kind.
        """
        if self._now() - self._stated_s > 1.0:
            speeds = np.array(message.velocity, dtype=np.float64)
            known = len(speeds) == len(message.name) and bool(np.isfinite(speeds).all())
            self._velocities = known and bool(speeds.any())

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
        self._output = node.add_output(MotionLease, "motion_lease", qos.LATCHED)
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
