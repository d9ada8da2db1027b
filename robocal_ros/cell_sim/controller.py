"""The simulated cell's trajectory controller on the graph: action, topic, state, speed scaling.

As joint_trajectory_controller 4.42.1 offers them; docs/cell_sim_node.md tells where it is read.
"""

from array import array
from collections.abc import Callable
from typing import Any

from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState, SpeedScalingFactor
from numpy.typing import NDArray
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import ReliabilityPolicy
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.cell_sim.cell import SimulatedCell
from robocal_ros.cell_sim.outputs import odd_length, tolerances_of, trajectory_of
from robocal_ros.cell_sim.trajectory_controller import GoalState, TrajectoryGoal
from robocal_ros.ground.errors import InputError
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import header
from robocal_ros.ros.decision_services import DeferredActionServer
from robocal_ros.ros.endpoints import EndpointNode

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

    # ---- commands -------------------------------------------------------------------------------

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

    # ---- what is told ---------------------------------------------------------------------------

    def monitor(self) -> None:
        """End the goals that are over; tell the others where they are."""
        for handle, goal in list(self._goals):
            if goal.state is GoalState.EXECUTING:
                if self._cell is not None and self._cell.motion.controller.active is goal:
                    handle.publish_feedback(self._feedback(self._cell))
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

    def _feedback(self, cell: SimulatedCell) -> Any:
        reference, feedback, error, _ = self._points(cell)
        return FollowJointTrajectory.Feedback(
            header=header(self._node.now_ns(), ""),
            joint_names=list(cell.motion.controller.names),
            desired=reference,
            actual=feedback,
            error=error,
        )

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
