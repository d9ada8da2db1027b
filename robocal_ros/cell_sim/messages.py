# SPDX-License-Identifier: Apache-2.0
"""The simulated cell on the graph: messages that it reads and publishes, its controller's action.

The action, topic, state and speed scaling are as joint_trajectory_controller 4.42.1 offers them;
docs/cell_sim_node.md tells where it is read.
"""

import json
from array import array
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState, SpeedScalingFactor
from geometry_msgs.msg import PointStamped, TransformStamped
from numpy.typing import NDArray
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import ReliabilityPolicy
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.cell import Happened, SimulatedCell, station_name
from robocal_ros.cell_sim.fixture import FRAME
from robocal_ros.cell_sim.trajectory_controller import (
    GoalState,
    Tolerances,
    Trajectory,
    TrajectoryGoal,
)
from robocal_ros.fixture.session import POINT
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import REFERENCE_SPHERE, SPHERE_CLOUD, stamp_ns
from robocal_ros.hand_eye.data import PROFILE
from robocal_ros.kinematics.urdf import urdf_of
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import NS, cloud, header, profile_cloud, transform_message
from robocal_ros.ros.endpoints import DeferredActionServer, EndpointNode
from robocal_ros.ros.robot import DESCRIPTION
from robocal_ros.thermal.screening import THRESHOLD_M
from robocal_ros.tool.edges import StepKind
from robocal_ros.tool.run import PlannedStep

KINDS: Mapping[int, StepKind] = {ToolStep.CIRCLE: "circle", ToolStep.PLUNGE: "plunge"}


def planned_step(message: ToolStep) -> PlannedStep:
    """A circle or plunge that is awaited.

    Raises `InputError` when kind, poses or sizes make no motion.
    """
    if message.kind not in KINDS:
        raise InputError(f"step {message.name} has the kind {message.kind}: no circle, no plunge")
    kind = KINDS[message.kind]
    size = "radius" if kind == "circle" else "depth"
    for name in ("speed", size):
        if not 0.0 < getattr(message, name) < np.inf:
            raise InputError(f"step {message.name}: {name} = {getattr(message, name)} is no motion")
    place, turn, laser = message.flange.position, message.flange.orientation, message.laser
    xyz = [place.x, place.y, place.z]
    flange, axes = [turn.x, turn.y, turn.z, turn.w], [laser.x, laser.y, laser.z, laser.w]
    finite = bool(np.all(np.isfinite([*xyz, message.start_angle])))
    if not finite or message.direction not in (-1, 1):
        raise InputError(f"step {message.name}: a pose is not finite, or direction not +1 or -1")
    if not all(abs(np.linalg.norm(quat) - 1.0) < 1e-3 for quat in (flange, axes)):
        raise InputError(f"step {message.name}: a quaternion is not of unit length")
    return PlannedStep(
        name=message.name,
        kind=kind,
        number=message.number,
        of=message.of,
        T_base_flange=frames.transform_from_quat(xyz, flange),
        R_base_laser=frames.transform_from_quat(np.zeros(3), axes)[:3, :3],
        speed_m_s=message.speed,
        radius_m=message.radius,
        direction=message.direction,
        start_rad=message.start_angle,
        depth_m=message.depth,
    )


def trajectory_of(message: JointTrajectory, from_ns: int) -> Trajectory:
    """A trajectory whose start, where it has one, is counted from ``from_ns`` on.

    Raises `InputError` when a controller rejects the numbers of its values.
    """
    points, count = message.points, len(message.joint_names)
    rows = []
    for what, needed in (("positions", True), ("velocities", False), ("accelerations", False)):
        values = [getattr(point, what) for point in points]
        has = np.array([len(row) > 0 for row in values], dtype=bool)
        for i, row in enumerate(values):
            if len(row) != count and (needed or has[i]):
                raise InputError(f"rejected: point {i} has {len(row)} {what} for {count} joints")
        filled = [row if given else [0.0] * count for row, given in zip(values, has, strict=True)]
        rows.append((np.array(filled, dtype=np.float64).reshape(len(points), count), has))
    if any(len(point.effort) for point in points):
        raise InputError("rejected: efforts, for which there is no command interface")
    (q, _), (qd, has_qd), (qdd, has_qdd) = rows
    times = [point.time_from_start for point in points]
    at_ns = stamp_ns(message.header.stamp)
    return Trajectory(
        names=tuple(message.joint_names),
        time_s=np.array([t.sec + 1e-9 * t.nanosec for t in times], dtype=np.float64),
        q=q,
        qd=qd,
        qdd=qdd,
        has_qd=has_qd,
        has_qdd=has_qdd,
        start_s=(at_ns - from_ns) * 1e-9 if at_ns else None,
    )


def tolerances_of(
    goal: FollowJointTrajectory.Goal, names: tuple[str, ...], own: Tolerances
) -> Tolerances:
    """A goal's tolerances for joints ``names``: 0 leaves the controller's ``own``, -1 removes one.

    As get_segment_tolerances of tolerances.hpp: what is wrong anywhere leaves all of its own.
    """

    def resolved(default: float, given: float) -> float:
        return default if given == 0.0 else max(given, 0.0)

    time = goal.goal_time_tolerance
    over_s = time.sec + 1e-9 * time.nanosec
    path, end = own.path.copy(), own.goal.copy()
    for given, into in ((goal.path_tolerance, path), (goal.goal_tolerance, end)):
        for joint in given:
            values = joint.position, joint.velocity, joint.acceleration
            if joint.name not in names or any(x < 0.0 and x != -1.0 for x in values):
                return own
            at = names.index(joint.name)
            into[at] = resolved(into[at], joint.position)
    if over_s < 0.0 and over_s != -1.0:
        return own
    return Tolerances(path, end, resolved(own.goal_time_s, over_s))


SPINDLE, SPINDLE_RAD_S = "a_spindle", 300.0  # before the arm's joints by alphabet


def joint_state(
    names: tuple[str, ...],
    stamp_ns: int,
    q: Array,
    qd: Array | None,
    missing: int = 0,
    *,
    spindle: bool = False,
) -> JointState:
    """A reading as joint_state_broadcaster tells it: by alphabet, without effort.

    ``qd`` None: hardware that has positions alone. ``missing``: as `odd_length`. ``spindle``: a
    joint that has a velocity alone is among them.
    """
    velocity = np.full(len(names), np.nan) if qd is None else qd
    if spindle:
        names, q = (*names, SPINDLE), np.append(q, np.nan)
        velocity = np.append(velocity, SPINDLE_RAD_S)
    order = sorted(range(len(names)), key=lambda i: names[i])
    nothing = np.full(len(names), np.nan)
    return JointState(
        header=header(stamp_ns, ""),
        name=[names[i] for i in order],
        position=array("d", q[order].tobytes()),
        velocity=array("d", odd_length(velocity[order], missing).tobytes()),
        effort=array("d", nothing.tobytes()),
    )


def odd_length(values: Array, missing: int) -> Array:
    """Values (n,) of which so many are missing; negative: there are so many more."""
    return values[missing:] if missing >= 0 else np.concatenate([values, values[missing:]])


def point(stamp_ns: int, frame: str, p: Array) -> PointStamped:
    """A sphere's centre (3,)."""
    message = PointStamped(header=header(stamp_ns, frame))
    message.point.x, message.point.y, message.point.z = p.tolist()
    return message


TRUTH_S = 1.0  # between two states of the truth
CENTRE = "sphere_center"

Commanded = tuple[NDArray[np.int64], Array]


class CellOutputs:
    """Publishers of a cell.

    ``told``: number of messages sent on each topic.
    ``commanded``: which (k,) working poses were commanded last, and the joints (k, n) for them;
    None before.
    """

    def __init__(
        self, add_output: Callable[..., Any], settings: Mapping[str, Any], cell: SimulatedCell
    ) -> None:
        self._settings, self._cell = settings, cell
        kinds = {"joint_states": JointState, "beam_events": BeamEvent}
        if cell.plan.sphere:
            clouds = cell.plan.sphere.points > 0
            kinds |= {SPHERE_CLOUD: PointCloud2} if clouds else {CENTRE: PointStamped}
            kinds |= {REFERENCE_SPHERE: PointStamped}
        if cell.plan.profile:
            kinds |= {PROFILE: PointCloud2}
        if cell.plan.fixture:
            kinds |= {POINT: PointStamped}
        if cell.heating:
            kinds |= {"motor_temperatures": Temperature}
        self._outputs = {
            topic: add_output(kind, topic, endpoints.RELIABLE) for topic, kind in kinds.items()
        }
        self._description = add_output(String, DESCRIPTION, endpoints.LATCHED)
        self._tool = add_output(TransformStamped, "~/truth", endpoints.LATCHED)
        self._state = add_output(String, "~/truth/state", endpoints.LATCHED)
        self.told = dict.fromkeys(kinds, 0)
        self.commanded: Commanded | None = None
        self.forget()

    def describe(self) -> None:
        """Say which arm it nominally is, as robot_state_publisher does."""
        arm = self._cell.plan.arm
        fastest = np.broadcast_to(self._cell.plan.fastest, arm.n)
        self._description.publish(String(data=urdf_of(arm, fastest)))

    def forget(self) -> None:
        """Tell the truth anew."""
        self._shown: RoundTool | None = None
        self._next_state_s = 0.0
        self._reset_ns = 0  # when the robot's clock began anew, less a second

    def tell(self, came: Happened, stamp_ns: Callable[[float], int]) -> None:
        """Publish what came; ``stamp_ns`` of a time of the cell."""
        settings, faults = self._settings, self._cell.faults
        names, missing = self._cell.plan.arm.joint_names, round(faults.size("odd_lengths"))
        for t, q, qd in zip(came.time_s.tolist(), came.q, came.qd, strict=True):
            at = stamp_ns(t)
            if "clock_reset" in faults:
                self._reset_ns = self._reset_ns or at - NS
                at -= self._reset_ns
            else:
                self._reset_ns = 0
            speed = qd if settings["velocities"] else None
            state = joint_state(names, at, q, speed, missing, spindle=settings["spindle"])
            self._send("joint_states", state)
        station = station_name(settings["station"], self._cell.faults)
        for edge in came.edges:
            event = BeamEvent(
                header=header(stamp_ns(edge.time_s), station),
                beam=edge.beam,
                edge=BeamEvent.BREAK if edge.blocked else BeamEvent.RESTORE,
                stamp_sigma_s=edge.sigma_s,
            )
            self._send("beam_events", event)
        ball, floor = f"{settings['sensor_frame']}/ball", f"{settings['sensor_frame']}/floor"
        for shot in came.shots:
            at = stamp_ns(shot.time_s)
            if len(shot.points):
                self._send(SPHERE_CLOUD, cloud(at, ball, shot.points))
            else:
                self._send(CENTRE, point(at, ball, shot.centre))
            self._send(REFERENCE_SPHERE, point(at, floor, shot.floor))
        for view in came.profiles:
            frame = settings["profile_frame"]
            self._send(PROFILE, profile_cloud(stamp_ns(view.time_s), frame, view.points))
        for feature in came.features:
            self._send(POINT, point(stamp_ns(feature.at_s), FRAME, feature.point))
        for told in came.temperatures:
            for name, celsius in zip(names, told.celsius.tolist(), strict=True):
                stamp = header(stamp_ns(told.time_s), name)
                message = Temperature(header=stamp, temperature=celsius, variance=0.01)
                self._send("motor_temperatures", message)

    def tell_truth(self, now_ns: int) -> None:
        """The true tool when it changed, and how warm and how far off the robot is."""
        cell = self._cell
        tool = cell.tool
        if self._shown is None or not np.array_equal(tool.T_flange_tool, self._shown.T_flange_tool):
            self._shown = tool
            message = TransformStamped(
                header=header(now_ns, self._settings["flange_frame"]),
                child_frame_id=self._settings["tool_frame"],
                transform=transform_message(tool.T_flange_tool),
            )
            self._tool.publish(message)
        if cell.now_s >= self._next_state_s:
            self._next_state_s = cell.now_s + TRUTH_S
            self._state.publish(String(data=json.dumps(truth_of(cell, self.commanded))))

    def _send(self, topic: str, message: Any) -> None:
        self._outputs[topic].publish(message)
        self.told[topic] += 1


def truth_of(cell: SimulatedCell, commanded: Commanded | None) -> dict[str, Any]:
    """What is true now, for judging alone; K, m, and the size of each fault in SI.

    The share is of the drives' greatest speeds, as commanded since the begin.
    """
    warmth, working = cell.warmth, cell.plan.working
    told = {
        "simulated": True,
        "cell_time_s": cell.now_s,
        "faults": dict(cell.faults.sizes),
        "drive_faults": cell.motion.faults,
        "peak_speed_share": cell.motion.peak_share,
        "motor_k": warmth.motor.tolist(),
        "link_k": warmth.link.tolist(),
    }
    if len(working):
        told |= _error("", cell.tcp_error(working))
    if commanded is not None:
        which, q = commanded
        told |= _error("commanded_", cell.tcp_error(q, which))
        told |= _error("visited_", cell.tcp_error(working[which], which))  # the same, as taught
    return told


def _error(which: str, error: Array) -> dict[str, float]:
    """Of the tool at working poses (k, 3), m; the share is of its coordinates."""
    far = np.linalg.norm(error, axis=1)
    return {
        f"{which}tcp_error_rms_m": float(np.sqrt(np.mean(far**2))),
        f"{which}tcp_error_p95_m": float(np.quantile(far, 0.95)),
        f"{which}within_share": float(np.mean(np.abs(error) <= THRESHOLD_M)),
    }


MONITOR_S = 0.05  # action_monitor_rate: goals' ends and feedback are told so often
COMMANDS = endpoints.own(endpoints.RELIABLE)
COMMANDS.reliability = ReliabilityPolicy.BEST_EFFORT
"""Of the topic: rclcpp's SystemDefaultsQoS, which is best effort for a reader of Fast DDS."""
STATUS = {
    GoalState.SUCCEEDED: GoalStatus.STATUS_SUCCEEDED,
    GoalState.CANCELED: GoalStatus.STATUS_CANCELED,
    GoalState.ABORTED: GoalStatus.STATUS_ABORTED,
}


class SimulatedController:
    """Ends of a cell's controller; ``name`` of its action.

    ``tick`` lets the cell's time pass up to now; ``start_ns`` is the stamp of its time 0.
    """

    def __init__(
        self, node: EndpointNode, name: str, tick: Callable[[], None], start_ns: Callable[[], int]
    ) -> None:
        self._node, self._tick, self._start_ns = node, tick, start_ns
        self._cell: SimulatedCell | None = None
        self._goals: list[tuple[ServerGoalHandle, TrajectoryGoal]] = []
        self._told_ns = 0
        self._asked: TrajectoryGoal | None = None
        self._server = DeferredActionServer(
            node,
            FollowJointTrajectory,
            node.resolve_topic_name(name),
            goal_callback=self._judge,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
        )

    def open(self, cell: SimulatedCell) -> None:
        """Serve a cell, until the node's cleanup."""
        self._cell = cell
        add = self._node.add_input
        add(JointTrajectory, "joint_trajectory", self._follow, COMMANDS)
        add(SpeedScalingFactor, "~/speed_scaling_input", self._scale, endpoints.LATCHED)
        self._state = self._node.add_output(
            JointTrajectoryControllerState, "~/controller_state", endpoints.RELIABLE
        )
        self._node.add_timer(MONITOR_S, self.monitor, steady=True)

    def deactivate(self) -> None:
        """Goals are aborted, the robot stands."""
        if self._cell is not None:
            self._cell.hold()
        self.monitor()

    def close(self) -> None:
        """Serve no cell any more."""
        self._cell = None

    def destroy(self) -> None:
        """Take the action down, while nothing spins."""
        self._server.destroy()

    def _follow(self, message: Any) -> None:
        cell = self._ready()
        try:
            cell.gate.take(trajectory_of(message, self._start_ns()), cell.now_s)
        except InputError as error:
            self._node.get_logger().error(f"joint_trajectory: {error}")
            raise

    def _scale(self, message: Any) -> None:
        cell = self._ready()
        if not message.factor >= 0.0:
            raise InputError(f"a speed scaling of {message.factor:g}: it must be 0 or more")
        cell.gate.scale = message.factor

    def _judge(self, request: Any) -> GoalResponse:
        """Accept what the controller accepts; it is taken in `_begin`, right after."""
        try:
            cell = self._ready()
            controller = cell.motion.controller
            trajectory = trajectory_of(request.trajectory, self._start_ns())
            cell.gate.require_taken(trajectory, cell.now_s)
        except InputError as error:
            self._node.get_logger().error(f"goal {error}")
            return GoalResponse.REJECT
        tolerances = tolerances_of(request, controller.names, controller.own_tolerances)
        self._asked = TrajectoryGoal(trajectory, tolerances)
        return GoalResponse.ACCEPT

    def _begin(self, handle: ServerGoalHandle) -> None:
        handle.execute()
        goal, cell = self._asked, self._cell
        if goal is None or cell is None:
            return
        cell.gate.take(goal, cell.now_s)
        self._goals.append((handle, goal))
        self.monitor()  # the one before it was preempted, which is told at once

    def _cancel(self, handle: ServerGoalHandle) -> CancelResponse:
        for known, goal in self._goals:
            if known is handle and self._cell is not None:
                self._tick()
                self._cell.motion.cancel(self._cell.now_s, goal)
        return CancelResponse.ACCEPT

    def _ready(self) -> SimulatedCell:
        if self._cell is None or not self._node.is_active:
            raise InputError(f"rejected: the controller is {self._node.state}")
        self._tick()
        return self._cell

    def monitor(self) -> None:
        """End the goals that are over; tell the others where they are."""
        for handle, goal in list(self._goals):
            if goal.state is GoalState.EXECUTING:
                if self._cell is not None and self._cell.motion.controller.active is goal:
                    reference, actual, error, _ = self._points(self._cell)
                    feedback = FollowJointTrajectory.Feedback(
                        header=header(self._node.now_ns(), ""),
                        joint_names=list(self._cell.motion.controller.names),
                        desired=reference,
                        actual=actual,
                        error=error,
                    )
                    handle.publish_feedback(feedback)
                continue
            if goal.state is GoalState.CANCELED and not handle.is_cancel_requested:
                continue  # rclpy marks it after the callback
            self._goals.remove((handle, goal))
            result = FollowJointTrajectory.Result(
                error_code=goal.code.value, error_string=goal.text
            )
            self._server.end(handle, STATUS[goal.state], result)

    def tell_state(self, stamp_ns: int) -> None:
        """Publish the controller's state, once for each time."""
        if self._cell is not None and stamp_ns != self._told_ns:
            self._told_ns = stamp_ns
            message = JointTrajectoryControllerState(
                header=header(stamp_ns, ""),
                joint_names=list(self._cell.motion.controller.names),
                speed_scaling_factor=self._cell.motion.controller.scale,
            )
            sides = self._points(self._cell)
            message.reference, message.feedback, message.error, message.output = sides
            self._state.publish(message)

    def _points(self, cell: SimulatedCell) -> tuple[JointTrajectoryPoint, ...]:
        """Where the joints should be, are, the error, and what was sent."""
        past_s, (q, qd, sent, _, desired, desired_qd, desired_qdd) = cell.motion.last()
        reference = _point(desired, past_s, desired_qd, desired_qdd)
        feedback, error, output = _point(q, past_s), _point(desired - q), _point(sent)
        if cell.plan.controller.velocity_states:
            feedback.velocities = array("d", qd.tobytes())
            error.velocities = array("d", bytes(qd.nbytes))  # not computed for position commands
        if "odd_lengths" in cell.faults:
            missing = round(cell.faults.size("odd_lengths"))
            feedback.velocities = array("d", odd_length(qd, missing).tobytes())
        return reference, feedback, error, output


def _point(q: NDArray[Any], time_s: float = 0.0, *rates: NDArray[Any]) -> JointTrajectoryPoint:
    point = JointTrajectoryPoint(positions=array("d", q.tobytes()))
    for name, rate in zip(("velocities", "accelerations"), rates, strict=False):
        setattr(point, name, array("d", rate.tobytes()))
    sec, nanosec = divmod(round(max(time_s, 0.0) * 1e9), 10**9)
    point.time_from_start.sec, point.time_from_start.nanosec = sec, nanosec
    return point
