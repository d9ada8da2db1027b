# SPDX-License-Identifier: Apache-2.0
"""Sends the motions of a node to the robot's controller, and reports what it makes of them.

Motions go as goals of FollowJointTrajectory: a rejection, a violated tolerance and an end are then
known. The action is that of the node which takes trajectories on the topic, as the graph shows it
before each motion. Where there is none they go on the topic, which tells nothing. Whoever moves the
robot holds the cell's motion lease meanwhile (docs/tool.md).

A stop is a plan that first goes on as the robot moves now (`REACTION_S`). Where the controller
tells its reference, the message is stamped with the controller's own time of the plan's begin: then
the command goes on along the plan without a step, whatever the hardware tells and however it lags,
and a stop that comes after its end is rejected. Else it begins when it arrives, where the robot is
measured; as lines, where the hardware tells no velocities: the controller would begin cubics with
a speed of 0 (Trajectory::set_point_before_trajectory_msg, ros2_controllers 4.42.1).

A message may be lost. So a stop is sent up to `COPIES` times, `COPY_S` apart: by the action until
it is answered, on the topic where it is stamped. Stamped ones are the same to the last bit, so that
one that comes after another changes nothing; others are of the same plan at their own time.
"""

import functools
import time
import traceback
from array import array
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration, Time
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance, JointTrajectoryControllerState
from numpy.typing import ArrayLike, NDArray
from rclpy.action import ActionClient
from rclpy.clock import Clock, ClockType
from rclpy.task import Future
from rclpy.type_support import check_for_type_support
from robocal_msgs.msg import MotionLease
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import JOINTS, stamp_ns
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.cell import DrivingConfig, Housing, ToolBody
from robocal_ros.motion.plan import LEAD_S, REACTION_S, JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import (
    UNSAID_S,
    Lateness,
    MotionReport,
    RobotWatch,
    SpeedScaling,
)
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.conversions import NS
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.graph import actions_beside
from robocal_ros.ros.parameters import Setting, advanced, given_pose, number, pose_settings

COPIES, COPY_S = 3, 0.006  # the last one that arrives alone still steps no command back
TRUSTED = 2  # a stop that is sent more often is not stamped: the controller may reject what is
LINES_S = 0.01  # between points for a controller that has no velocities
STATED_S = 0.05  # a controller's state that is older, or so far off in its stamp, is not gone by
SPOKEN_S = 1.0  # a controller whose state is newer tells whether there are velocities
BESIDE = 1e-3  # rad (m); a plan that passes the controller's reference further off is not of it
GRID_S = 1e-3  # instants of a plan that a reference is looked for at
PACE_S = 0.01  # of two instants as near to it the one counts that is as fast
AT_REST = 5e-3  # rad/s (m/s); slower references move nothing
STATE, SCALING = "controller_state", "speed_scaling"  # topics of a controller
SEEN_THROUGH_S = 1.0  # the stop of a node that is deactivated or ends, at most


class StatedController:
    """What a controller says of itself; times of a steady clock.

    ``scalings``: how fast its clock runs. ``velocities``: whether the hardware has any, as far as
    it is told. ``held_s``: when one that pauses was last seen to give up a motion: its reference
    came to rest. ``lateness``: of states, which are gone by as of when they were, not of when they
    came.
    """

    def __init__(self) -> None:
        self.scalings, self.lateness = SpeedScaling(), Lateness("states of the controller")
        self._heard_s, self._ahead_s = -np.inf, np.inf
        self._stated: tuple[int, tuple[str, ...], Array, Array] | None = None
        self._paused_speed = 0.0  # of the reference, in a pause
        self.velocities, self.held_s = True, -np.inf

    def take(self, message: Any, now_s: float, *ages_s: float) -> None:
        """Take a ``JointTrajectoryControllerState``, of these ages by other clocks: `Lateness`."""
        self.scalings.controller(float(getattr(message, "speed_scaling_factor", np.nan)), now_s)
        names, reference = tuple(message.joint_names), message.reference
        self._tells(np.array(message.feedback.velocities, dtype=np.float64), len(names))
        at_ns, before_s = stamp_ns(message.header.stamp), self._ahead_s
        self._heard_s = now_s - self.lateness.take(at_ns / NS, now_s, *ages_s)
        self._ahead_s, self._stated = at_ns / NS - self._heard_s, None
        if len(reference.positions) != len(names) or len(reference.velocities) != len(names):
            return  # a controller that holds may leave them out
        q, qd = np.array(reference.positions), np.array(reference.velocities)
        if not (np.isfinite(q).all() and np.isfinite(qd).all()):
            return
        if abs(self._ahead_s - before_s) < STATED_S:
            self._stated = at_ns, names, q, qd
        before, self._paused_speed = self._paused_speed, 0.0
        if self.scalings.at(now_s) == 0.0:
            self._paused_speed = float(np.max(np.abs(qd), initial=0.0))
            if self._paused_speed < AT_REST <= before:
                self.held_s = now_s

    def hear(self, velocity: ArrayLike, count: int, now_s: float) -> None:
        """Take velocities of ``count`` joint states: they count where the controller is silent.

        Of the controller's own joints. Some hardware says 0 in motion; a stop of a robot that
        stands may be of either kind.
        """
        if now_s - self._heard_s > SPOKEN_S:
            self._tells(np.asarray(velocity, dtype=np.float64), count)

    def _tells(self, speeds: Array, count: int) -> None:
        self.velocities = bool(len(speeds) == count and np.isfinite(speeds).all() and speeds.any())

    def reference(self, names: Sequence[str], now_s: float) -> tuple[Array, Array, float] | None:
        """Joints and unscaled velocities (k,) where the controller is now, as of when it is known.

        None: not known.
        """
        if (found := self._find(names, now_s)) is None:
            return None
        (_, q, qd), scaling = found, self.scalings.at(now_s)
        gone_s = (now_s - self._heard_s) * (1.0 if scaling is None else scaling)
        return q + qd * gone_s, qd, self._heard_s

    def _find(self, names: Sequence[str], now_s: float) -> tuple[int, Array, Array] | None:
        if self._stated is None or now_s - self._heard_s > STATED_S:
            return None
        at_ns, of, q, qd = self._stated
        if not set(names) <= set(of):
            return None
        index = [of.index(name) for name in names]
        return at_ns, q[index], qd[index]

    def stop_message(
        self,
        plan: JointPlan,
        names: Sequence[str],
        now_s: float,
        *,
        at_s: float = 0.0,
        first_s: float = LEAD_S,
        trusted: bool = True,
    ) -> JointTrajectory:
        """A stop by a plan that is at its time ``at_s`` now, and still goes on for `REACTION_S`.

        ``first_s``: first point of a message that is not stamped, ahead of its arrival;
        ``trusted``: whether it may be stamped.
        """
        begin_ns = self._begin_ns(plan, names, now_s, at_s) if trusted else None
        if begin_ns is not None:
            message = joint_trajectory(names, plan.time_s, plan.q, plan.qd)
            message.header.stamp = Time(sec=begin_ns // NS, nanosec=begin_ns % NS)
            return message
        since_s = at_s + REACTION_S
        # one that is over, or nearly, ends no sooner: a controller would be there in one cycle
        last_s = max(plan.duration_s - since_s, LEAD_S)
        if self.velocities:
            first_s = min(first_s, last_s)
            ahead = plan.time_s - since_s
            times = np.append(first_s, ahead[ahead > first_s + 1e-4])
        else:  # in two lines at least, which slow down, while there is time for them
            first_s = min(first_s, max(last_s - 2.0 * LINES_S, LEAD_S))
            first_s = first_s if last_s - first_s > 1e-3 else last_s
            lines = max(int(np.ceil((last_s - first_s) / LINES_S)), 2) if last_s > first_s else 0
            times = np.linspace(first_s, last_s, lines + 1)
        q, qd = plan.at(times + since_s)
        qd[-1] = 0.0  # exactly: a controller rejects a trajectory that does not end at rest
        return joint_trajectory(names, times, q, qd if self.velocities else None)

    def _begin_ns(
        self, plan: JointPlan, names: Sequence[str], now_s: float, at_s: float
    ) -> int | None:
        """When the controller is where the plan begins, by its own clock; None: not known.

        Where the plan, before its begin at the speed of its begin, passes the reference. A scaled
        clock counts from a stamp on as if it were not.
        """
        found = self._find(names, now_s)
        if found is None or self.scalings.at(now_s) not in (None, 1.0):
            return None
        stated_ns, q, qd = found
        if not stated_ns:  # it tells no time
            return None
        times = np.arange(-STATED_S, at_s + STATED_S, GRID_S)
        places, speeds = plan.at(np.maximum(times, 0.0))
        places = places + np.minimum(times, 0.0)[:, None] * plan.qd[0]
        away = np.sum((places - q) ** 2 + (PACE_S * (speeds - qd)) ** 2, axis=1)
        k = int(np.argmin(away))
        way, speed = q - places[k], speeds[k]
        if not (qd @ qd > 0.0 and speed @ speed > 0.0):
            return None
        after_s = float(way @ speed) / float(speed @ speed)
        if abs(after_s) > GRID_S or np.max(np.abs(way - after_s * speed)) > BESIDE:
            return None
        return stated_ns - round((times[k] + after_s) * NS)


def joint_trajectory(
    names: Sequence[str], times: Array, q: Array, qd: Array | None
) -> JointTrajectory:
    """Points at times (k,) with joints (k, n), and velocities where there are any."""
    message = JointTrajectory(joint_names=list(names))
    for i, ns in enumerate(np.round(times * NS).astype(np.int64).tolist()):
        point = JointTrajectoryPoint(positions=array("d", q[i].tobytes()))
        if qd is not None:
            point.velocities = array("d", qd[i].tobytes())
        point.time_from_start = Duration(sec=ns // NS, nanosec=ns % NS)
        message.points.append(point)
    return message


GOAL_TIME_S = 12  # the nodes wait less for a robot that does not come to rest where a motion ends


def _of_joints(name: str, default: float, what: str) -> Setting:
    words = f"{what}; one for all joints or one for each"
    return number(name, [default], words, 1e-3, 1e4)


MANDREL = (
    *pose_settings(
        "mandrel",
        "End of the mandrel in the flange frame; as the quaternion at its default: there is none",
        "Its orientation: z along its axis to its end",
    ),
    number("mandrel_length_mm", 100.0, "Length of the mandrel along its axis", 1.0, 2e3),
    number("mandrel_radius_mm", 10.0, "Its radius", 0.5, 500.0),
)
MOTION = (
    _of_joints("joint_velocity_deg_s", 57.0, "Largest velocity"),
    _of_joints("joint_acceleration_deg_s2", 286.0, "Largest acceleration"),
    _of_joints("stop_deceleration_deg_s2", 573.0, "Deceleration of a stop"),
    number("tcp_speed_mm_s", 50.0, "Largest speed of the tip", 1.0, 250.0),
    number(
        "tcp_acceleration_mm_s2",
        1200.0,
        "Largest acceleration of the tip on its path",
        1.0,
        10000.0,
    ),
    number("opening_radius_mm", 60.0, "Opening of the housing about the crossing", 5.0, 1e3),
    number("housing_top_mm", 30.0, "Height of the housing above the beams", 0.0, 1e3),
    number("housing_depth_mm", 120.0, "Depth of the opening below the beams", 1.0, 1e3),
    number("housing_reach_mm", 0.0, "Radius of the housing; 0: it never ends", 0.0, 1e4),
    number("retract_mm", 50.0, "Height of the tip above the beams on its way", 1.0, 2e3),
    number("tool_length_mm", 100.0, "Length of the tool along its axis", 1.0, 2e3),
    number("tool_radius_mm", 10.0, "Its radius, with the largest bend to be found", 0.5, 500.0),
    number("flange_radius_mm", 60.0, "Of a ball about the flange", 1.0, 1e3),
    *MANDREL,
    number("deviation_mm", 2.0, "The tip so far from its plan stops the robot", 0.05, 50.0),
    number(
        "deviation_deg",
        0.5,
        "A joint so far from its plan stops the robot; the tip, see deviation_mm",
        0.01,
        10.0,
    ),
    *advanced(
        number(
            "motion_silence_s",
            0.1,
            "Joint states may pause for so long while the robot moves",
            0.02,
            0.5,
        ),
        number(
            "motion_late_s", 0.15, "The robot lags at most so far behind its trajectory", 0.01, 1.0
        ),
    ),
)


def driving_config(settings: Mapping[str, Any], **plunge: float) -> DrivingConfig:
    """Settings of what moves, in SI; ``plunge``: further limits of `MotionLimits`.

    Raises `InputError` when sizes contradict each other.
    """
    T_flange_mandrel = given_pose(settings, "mandrel")
    flange_radius_m = settings["flange_radius_mm"] * 1e-3
    mandrel = None
    if T_flange_mandrel is not None:
        length_m, radius_m = (settings[f"mandrel_{of}_mm"] * 1e-3 for of in ("length", "radius"))
        mandrel = ToolBody(T_flange_mandrel, length_m, radius_m, flange_radius_m, "mandrel")
    return DrivingConfig(
        mandrel=mandrel,
        housing=Housing(
            clear_radius_m=settings["opening_radius_mm"] * 1e-3,
            top_m=settings["housing_top_mm"] * 1e-3,
            floor_m=-settings["housing_depth_mm"] * 1e-3,
            retract_m=settings["retract_mm"] * 1e-3,
            reach_m=settings["housing_reach_mm"] * 1e-3 or np.inf,
        ),
        tool_length_m=settings["tool_length_mm"] * 1e-3,
        tool_radius_m=settings["tool_radius_mm"] * 1e-3,
        flange_radius_m=flange_radius_m,
        limits=MotionLimits(
            joint_velocity=np.radians(settings["joint_velocity_deg_s"]),
            joint_acceleration=np.radians(settings["joint_acceleration_deg_s2"]),
            stop_deceleration=np.radians(settings["stop_deceleration_deg_s2"]),
            tcp_speed_m_s=settings["tcp_speed_mm_s"] * 1e-3,
            tcp_acceleration_m_s2=settings["tcp_acceleration_mm_s2"] * 1e-3,
            **plunge,
        ),
        deviation_m=settings["deviation_mm"] * 1e-3,
        deviation_rad=float(np.radians(settings["deviation_deg"])),
        silence_s=settings["motion_silence_s"],
        late_s=settings["motion_late_s"],
    )


def require_limits(arm: SerialArm, config: DrivingConfig) -> None:
    """Refuse to move a robot whose limits are not known.

    Raises `InputError` when a limit is given for another number of joints, or the robot has none.
    """
    config.limits.of_joints(arm)
    if not np.all(np.isfinite([arm.lower, arm.upper])):
        raise InputError(f"{arm.name} has joints without limits: add them to the robot file")


def goal_tolerances(arm: SerialArm, config: DrivingConfig) -> dict[str, Any]:
    """Tolerances of what moves, as fields of a FollowJointTrajectory goal; wider than `RobotWatch`.

    A controller compares places of one instant: a robot that lags as much as is allowed is beside
    its place by that way. They do not go by a plan's speeds, as joint_trajectory_controller 4.42.1
    judges what comes on its topic later by those of the last goal.
    """
    near = np.where(arm.prismatic, config.deviation_m, config.deviation_rad)
    lag = config.limits.of_joints(arm)[0] * (config.late_s + UNSAID_S)

    def of_joints(allowed: NDArray[np.float64]) -> list[JointTolerance]:
        named = zip(arm.joint_names, allowed.tolist(), strict=True)
        return [JointTolerance(name=name, position=position) for name, position in named]

    return {
        "path_tolerance": of_joints(near + lag),
        "goal_tolerance": of_joints(near),
        "goal_time_tolerance": Duration(sec=GOAL_TIME_S),
    }


HARD_STOP = Setting(
    "hard_stop_service",
    "",
    "std_srvs/Trigger that stops a robot which does not obey its stops; empty: there is none",
)
CONTROLLER = (
    Setting(
        "follow_joint_trajectory",
        "",
        "FollowJointTrajectory of the robot's controller, for example "
        "/joint_trajectory_controller/follow_joint_trajectory; empty: that of the node which "
        "subscribes ~/joint_trajectory. While nobody serves it motions go on that topic, and no "
        "rejection is seen",
    ),
    HARD_STOP,
)
LEASE_S = 0.2  # between two messages of a lease that is held
VIOLATIONS = {
    FollowJointTrajectory.Result.PATH_TOLERANCE_VIOLATED: "PATH_TOLERANCE_VIOLATED",
    FollowJointTrajectory.Result.GOAL_TOLERANCE_VIOLATED: "GOAL_TOLERANCE_VIOLATED",
}


class HardStopService:
    """Stops a robot that obeys no trajectory, by a ``std_srvs/Trigger``; empty: there is none."""

    def __init__(self, node: EndpointNode, service: str) -> None:
        self._node = node
        self._client = node.add_client(Trigger, service) if service else None

    @property
    def absent(self) -> str:
        """That nobody serves the one that is named, in words; else empty."""
        client = self._client
        if client is None or client.service_is_ready():
            return ""
        return f"hard_stop_service: nobody serves {client.srv_name}"

    def __call__(self, why: str) -> None:
        """Call it, and tell why and what it answers."""
        logger, client = self._node.get_logger(), self._client
        if client is None:
            logger.error(f"{why}: stop the robot by hand (hard_stop_service is empty)")
            return
        if absent := self.absent:  # called all the same: discovery may have lost it
            logger.error(f"{why}: stop the robot by hand ({absent})")
        else:
            logger.error(f"{why}: {client.srv_name} is called")

        def told(future: Future) -> None:
            answer: Any = future.result()
            logger.error(f"{client.srv_name}: {answer.success} {answer.message}")

        client.call_async(Trigger.Request()).add_done_callback(guarded(self._node, told))


class MotionDriver:
    """One client of the controller, and what the controller says of itself.

    ``reported``: takes what the controller makes of the motion that was sent last. ``tolerances``:
    of motions, see `goal_tolerances`; a stop has the controller's own, and is watched. ``robot``:
    where readings of the controller go now; None: nowhere. ``now``: their steady clock.
    ``hard_stop``: for a robot that does not obey.
    ``lateness``: of joint states. ``action``: by which the next motion goes; empty: by the
    ``topic``. ``named`` is its name, where it is given. ``way``: how the last motion went out, in
    words; empty before any.
    """

    def __init__(
        self,
        node: EndpointNode,
        names: Sequence[str],
        named: str,
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
        # rclpy remaps the parts of an action, but not its name
        self._named = [node.resolve_topic_name(named)] if named else []
        self.action, self._found = "", self._named
        self._client: ActionClient | None = None
        check_for_type_support(FollowJointTrajectory)  # its libraries: 80 ms, else at a motion
        self.look()
        self.hard_stop = HardStopService(node, hard_stop)
        node.add_input(JointTrajectoryControllerState, STATE, self._take_state, endpoints.NEWEST)
        node.add_input(Float64, SCALING, self._take_scaling, endpoints.NEWEST)
        self._controller = StatedController()
        self.lateness = Lateness("joint states")
        self._rejected = False
        self._stops = 0  # since the last motion
        self._first = self._newest = 0  # what was sent of the present motion, or stop
        self._stop: Callable[[], JointTrajectory] | None = None  # that may have been lost
        self._copies, self._until_s = 0, 0.0
        # It goes on where a node that sent a stop is deactivated.
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self._repeats = node.create_timer(COPY_S, guarded(node, self._repeat), clock=clock)
        self._repeats.cancel()
        self.way = ""

    def close(self) -> None:
        """Take timer and the action's client down, while nothing spins them."""
        self._node.destroy_timer(self._repeats)
        self._drop()

    def _drop(self) -> None:
        if self._client is not None:
            self._client.destroy()
        self.action, self._client = "", None

    def look(self) -> str:
        """Look for the action, while nothing moves; its name, empty where the topic is left."""
        topic = self.topic.topic_name
        self._found = self._named or actions_beside(self._node, topic)
        action = self._found[0] if len(self._found) == 1 else ""
        if action != self.action:
            self._drop()
            self.action = action
            if action:
                self._client = ActionClient(self._node, FollowJointTrajectory, action)
        return action

    def send(self, plan: JointPlan, *, stop: bool) -> None:
        """Send a motion, which takes the place of what the controller drives.

        A stop is worded by what the controller says of itself (`StatedController`). After a
        rejection no stamp is trusted, nor by a stop that is sent more often than `TRUSTED`.
        """
        self._rejected, self._stops = self._rejected and stop, (self._stops + 1) * stop
        self._repeats.cancel()
        self._first = self._newest + 1
        if not stop:
            self.look()
            self._send(joint_trajectory(self._names, *plan.points()), self._tolerances)
            return
        begin_s, going_on = self._now(), plan.going_on(REACTION_S)

        def message(*, trusted: bool = False) -> JointTrajectory:
            now_s = self._now()
            return self._controller.stop_message(
                going_on, self._names, now_s, at_s=now_s - begin_s, trusted=trusted
            )

        first = message(trusted=not self._rejected and self._stops <= TRUSTED)
        stamped = first.header.stamp != Time()
        by_action = self._send(first, {})
        if stamped or by_action:
            self._stop, self._copies = (lambda: first) if stamped else message, 1
            self._until_s = begin_s + COPIES * COPY_S
            self._repeats.reset()

    def see_through(self, moves: Callable[[], bool]) -> bool:
        """See a stop through while nothing spins, as ``moves`` looks at it; whether it stands."""
        node, until_s = self._node, time.monotonic() + SEEN_THROUGH_S
        node.is_active = True  # until what it moves stands
        try:
            while moves():
                if time.monotonic() > until_s:
                    node.get_logger().warning("deactivated while the robot is still being stopped")
                    return False
                time.sleep(COPY_S)
                self._repeat()
                node.take_waiting(JOINTS, STATE, SCALING)
        finally:
            node.is_active = False
        return True

    def _repeat(self) -> None:
        in_time = self._now() <= self._until_s
        if self._stop is not None and self._copies < COPIES and in_time:
            self._copies += 1
            self._send(self._stop(), {})
        else:
            self._repeats.cancel()

    def _send(self, message: JointTrajectory, tolerances: Mapping[str, Any]) -> bool:
        """Send a trajectory; whether it went by the action."""
        self._newest += 1
        number = self._newest
        if self._client is None or not self._client.server_is_ready():
            self.topic.publish(message)
            self._say(f"the topic {self.topic.topic_name}; no rejection is seen")
            return False
        goal = FollowJointTrajectory.Goal(trajectory=message, **tolerances)
        future = self._client.send_goal_async(goal)
        future.add_done_callback(guarded(self._node, lambda done: self._answered(number, done)))
        self._say(f"the action {self.action}")
        return True

    def _say(self, way: str) -> None:
        if way == self.way:
            return
        self.way, logger = way, self._node.get_logger()
        if self._named and not way.startswith("the action"):
            logger.warning(f"nobody serves {self.action}: motions go on {way}")
        elif len(self._found) > 1:
            which = ", ".join(self._found)
            logger.warning(f"follow_joint_trajectory: name one of {which}; motions go on {way}")
        else:
            logger.info(f"motions go on {way}")

    def _answered(self, number: int, future: Future) -> None:
        handle: Any = future.result()
        if number >= self._first:
            self._repeats.cancel()
            if handle.accepted:
                self._first = self._newest + 1  # a copy that comes too late is rejected
            else:
                self._rejected = True
                words = "the controller rejected the motion"
                self._reported(MotionReport(failed=True, words=words))
        if not handle.accepted:
            return
        result = handle.get_result_async()
        result.add_done_callback(guarded(self._node, lambda done: self._ended(number, done)))

    def _ended(self, number: int, future: Future) -> None:
        answer: Any = future.result()
        result, succeeded = answer.result, answer.status == GoalStatus.STATUS_SUCCEEDED
        code = VIOLATIONS.get(result.error_code, result.error_code)
        words = f"the controller ended the motion ({code}): {result.error_string}"
        if number == self._newest:  # one before it ended because this one took its place
            self._reported(MotionReport(ended=True, failed=not succeeded, words=words))

    def _take_state(self, message: Any) -> None:
        robot, now_s = self._robot(), self._now()
        names = tuple(message.joint_names)
        if names not in self._index:
            if missing := [name for name in self._names if name not in names]:
                raise InputError(f"no joint {', '.join(missing)} in this controller")
            self._index = {names: [names.index(name) for name in self._names]}
        index, count = self._index[names], len(names)
        age_s = (self._node.now_ns() - stamp_ns(message.header.stamp)) / NS
        self._controller.take(message, now_s, age_s)
        now_s -= self._controller.lateness.late_s
        if robot is not None:
            robot.held_s = self._controller.held_s
            if (scaling := self._controller.scalings.at(now_s)) is not None:
                robot.scaled(scaling, now_s)
        reference = message.reference
        if len(reference.positions) != count or len(reference.velocities) != count:
            return  # a controller that holds may leave them out
        q, qd = np.array(reference.positions)[index], np.array(reference.velocities)[index]
        if robot is not None:
            robot.controller(q, qd, now_s)

    def hear(self, message: Any) -> float:
        """Take a JointState, which may tell whether there are velocities; how late it comes, s.

        One without all joints is another driver's, and tells nothing of that.
        """
        now_s, at_ns = self._now(), stamp_ns(message.header.stamp)
        names, velocity = list(message.name), message.velocity
        if not set(self._names) <= set(names):
            return 0.0
        whole = len(velocity) == len(names)  # a gripper or a spindle may have others
        own = [velocity[names.index(name)] for name in self._names] if whole else []
        self._controller.hear(own, len(self._names), now_s)
        return self.lateness.take(at_ns / NS, now_s, (self._node.now_ns() - at_ns) / NS)

    def late(self) -> str:
        """That readings of the robot are late, in words, which are logged too; else empty."""
        now_s = self._now()
        of = self.lateness, self._controller.lateness
        words = "; ".join(filter(None, (each.words(now_s) for each in of)))
        if words:
            self._node.warn("joint_states", words)
        return words

    def _take_scaling(self, message: Any) -> None:
        robot, now_s = self._robot(), self._now()
        self._controller.scalings.slider(message.data, now_s)
        if robot is not None and (scaling := self._controller.scalings.at(now_s)) is not None:
            robot.scaled(scaling, now_s)


def guarded(
    node: EndpointNode, act: Callable[..., Any], otherwise: Any = None
) -> Callable[..., Any]:
    """``act`` as an action's or a client's callback, where an exception would end the process.

    ``otherwise`` is its answer then.
    """

    @functools.wraps(act)
    def call(*given: Any) -> Any:
        try:
            return act(*given)
        except Exception:
            node.get_logger().error(
                f"a defect of this software, please report it:\n{traceback.format_exc()}"
            )
            return otherwise

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

    def lapse(self) -> None:
        """Say no more of it, nor that it is let go: it counts until the robot has stood."""
        self._held = False
