"""The action FollowJointTrajectory before a controller: taught goals in, corrected ones out.

Each goal is corrected and forwarded; it ends as the controller ends it. Nothing here waits: goals
are ended from callbacks, so that a cancel passes at once in whatever executor the node runs.
docs/joint_correction_action.md tells it to users.
"""

import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from control_msgs.action import FollowJointTrajectory
from numpy.typing import NDArray
from rclpy.action import ActionClient, ActionServer, CancelResponse, GoalResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from robocal_ros.core.errors import InputError, RobocalError
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.samples import TAUGHT
from robocal_ros.nodes.endpoints import EndpointNode

Array = NDArray[np.float64]
Result = FollowJointTrajectory.Result

ANSWER_S = 5.0  # a controller that has not answered a goal or a cancel by then never will
WATCH_S = 0.2
RESULT_KEPT_S = 60  # for callers that ask late
_ABOUT_JOINTS = {Reason.UNKNOWN_JOINT, Reason.DOUBLED_JOINT, Reason.MISSING_JOINT}


class _Server(ActionServer):
    """An action server whose goals are ended by a callback, not by a coroutine that waits."""

    def __init__(self, node: EndpointNode, name: str, **callbacks: Any) -> None:
        self._host = node
        super().__init__(
            node,
            FollowJointTrajectory,
            name,
            lambda goal: Result(),
            result_timeout=RESULT_KEPT_S,
            **callbacks,
        )

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Called when a goal begins, without a callback, and with one when it shall end."""
        if execute_callback is not None and self._host.executor is not None:
            super().notify_execute(goal_handle, execute_callback)


@dataclass(eq=False)
class _Goal:
    """A goal on its way.

    Attributes
    ----------
    servers : of the controller's action, when it was sent.
    asked_s : since when the controller owes an answer; None when it owes none.
    accepted : the goal at the controller.
    result : what it will answer in the end.
    """

    caller: ServerGoalHandle
    servers: frozenset[bytes] = frozenset()
    asked_s: float | None = None
    accepted: ClientGoalHandle | None = None
    result: Future | None = None
    cancel: bool = False
    over: bool = False


class TrajectoryProxy:
    """Serves ``server_name`` until `close`, by means of the controller's action ``client_name``.

    Parameters
    ----------
    correct : the corrected trajectory of a taught one; raises `RefusedError`.
    taught : taught positions and velocities of (names, positions, velocities or None), each (k,).
    stop : called when the trajectory that was corrected last ends early.

    Raises
    ------
    InputError
        When both names are the same.
    """

    def __init__(
        self,
        node: EndpointNode,
        server_name: str,
        client_name: str,
        correct: Callable[[Any], Any],
        taught: Callable[[tuple[str, ...], Array, Array | None], tuple[Array, Array | None]],
        stop: Callable[[], None],
    ) -> None:
        self._node, self._correct, self._taught, self._stop = node, correct, taught, stop
        self._controller = node.resolve_topic_name(client_name)
        if node.resolve_topic_name(server_name) == self._controller:
            raise InputError(f"{self._controller} is this node's own action: name the controller's")
        self._goals: list[_Goal] = []
        self._last: _Goal | None = None
        self._client = ActionClient(node, FollowJointTrajectory, client_name)
        self._server = _Server(
            node,
            server_name,
            goal_callback=self._requested,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancelled,
        )
        node.add_timer(WATCH_S, self._watch, steady=True)

    def deactivate(self) -> None:
        """Cancel every goal at the controller, and end it."""
        for goal in list(self._goals):
            self._forward_cancel(goal)
            self._fail(goal, "the joint correction was deactivated, it cancelled the goal")

    def close(self) -> None:
        """Take both actions down."""
        self._server.destroy()
        self._client.destroy()

    # ---- from the caller ------------------------------------------------------------------------

    def _requested(self, request: Any) -> GoalResponse:
        if self._node.is_active:
            return GoalResponse.ACCEPT
        self._node.get_logger().warning(f"goal rejected: {self._node.get_name()} is not active")
        return GoalResponse.REJECT

    def _begin(self, caller: ServerGoalHandle) -> None:
        caller.execute()
        goal, request = _Goal(caller), caller.request
        is_stop = not request.trajectory.points
        if not self._client.server_is_ready():
            self._fail(goal, f"the controller's action {self._controller} is not there")
            return
        if not is_stop:
            try:
                request.trajectory = self._correct(request.trajectory)
            except RefusedError as error:
                about_joints = error.reason in _ABOUT_JOINTS
                code = Result.INVALID_JOINTS if about_joints else Result.INVALID_GOAL
                self._fail(goal, str(error), code)
                return
            except Exception as error:
                self._node.get_logger().error(traceback.format_exc())
                self._fail(goal, f"a defect of this software, please report it: {error!r}")
                return
        earlier = list(self._goals)
        self._send(goal, request)
        if is_stop:  # controllers that do not take it for one hold when the goal is cancelled
            for other in earlier:
                self._forward_cancel(other)
            self._stop()

    def _send(self, goal: _Goal, request: Any) -> None:
        goal.servers, goal.asked_s = self._servers(), time.monotonic()
        self._goals.append(goal)
        self._last = goal
        future = self._client.send_goal_async(
            request, lambda message: self._feedback(goal, message.feedback), goal.caller.goal_id
        )
        future.add_done_callback(lambda done: self._answered(goal, done.result()))

    def _cancelled(self, caller: ServerGoalHandle) -> CancelResponse:
        for goal in self._goals:
            if goal.caller is caller:
                self._forward_cancel(goal)
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def _forward_cancel(self, goal: _Goal) -> None:
        goal.cancel = True
        if goal.accepted is not None:  # else it follows the acceptance
            goal.asked_s = time.monotonic()
            future = goal.accepted.cancel_goal_async()
            future.add_done_callback(lambda done: self._cancel_answered(goal, done.result()))

    # ---- from the controller --------------------------------------------------------------------

    def _answered(self, goal: _Goal, accepted: ClientGoalHandle) -> None:
        goal.asked_s = None
        if not accepted.accepted:
            self._fail(goal, f"{self._controller} rejected the goal, its log says why")
            return
        goal.accepted = accepted
        if goal.cancel or goal.over:
            self._forward_cancel(goal)
        if not goal.over:
            goal.result = accepted.get_result_async()
            goal.result.add_done_callback(lambda done: self._finished(goal, done.result()))

    def _cancel_answered(self, goal: _Goal, answer: Any) -> None:
        goal.asked_s = None
        if answer.return_code == CancelGoal.Response.ERROR_NONE:
            self._stopped(goal)  # it holds from now on, its result follows
        elif answer.return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID:
            self._fail(goal, f"{self._controller} does not know the goal any more")

    def _feedback(self, goal: _Goal, feedback: Any) -> None:
        names = tuple(feedback.joint_names)
        try:
            for point in (feedback.desired, feedback.actual):
                self._make_taught(names, point)
        except RobocalError:  # counted by the session
            return
        feedback.header.frame_id = TAUGHT
        _subtract(feedback.desired, feedback.actual, feedback.error)
        goal.caller.publish_feedback(feedback)

    def _make_taught(self, names: tuple[str, ...], point: Any) -> None:
        """Un-correct positions and velocities; accelerations cannot be, and are left out."""
        point.accelerations = []
        if not point.positions:
            return
        velocity = np.array(point.velocities) if point.velocities else None
        position, velocity = self._taught(names, np.array(point.positions), velocity)
        point.positions = position.tolist()
        point.velocities = [] if velocity is None else velocity.tolist()

    def _finished(self, goal: _Goal, answer: Any) -> None:
        if goal.over:
            return
        if answer.status == GoalStatus.STATUS_UNKNOWN:
            self._fail(goal, f"{self._controller} does not know the goal any more")
            return
        self._end(goal, answer.status, answer.result)

    def _watch(self) -> None:
        """End goals that the controller will not end."""
        servers = self._servers() if self._goals else frozenset()
        overdue_s = time.monotonic() - ANSWER_S
        for goal in list(self._goals):
            if not goal.servers & servers:
                self._fail(goal, f"the controller's action {self._controller} vanished")
            elif goal.asked_s is not None and goal.asked_s < overdue_s:
                what = "cancel, it may still move" if goal.cancel else "goal"
                text = f"{self._controller} did not answer within {ANSWER_S:g} s to the {what}"
                self._fail(goal, text)

    def _servers(self) -> frozenset[bytes]:
        """Who offers the controller's action: a restarted controller is another one."""
        infos = self._node.get_publishers_info_by_topic(f"{self._controller}/_action/status")
        return frozenset(bytes(info.endpoint_gid) for info in infos)

    # ---- the end --------------------------------------------------------------------------------

    def _fail(self, goal: _Goal, why: str, code: int = Result.INVALID_GOAL) -> None:
        if not goal.over:
            self._node.get_logger().warning(f"goal aborted: {why}")
            self._end(goal, GoalStatus.STATUS_ABORTED, Result(error_code=code, error_string=why))

    def _end(self, goal: _Goal, status: int, result: Any) -> None:
        goal.over = True
        if goal in self._goals:
            self._goals.remove(goal)
        if goal.result is not None:
            goal.result.cancel()  # so that nothing is kept of it
        if status != GoalStatus.STATUS_SUCCEEDED:
            self._stopped(goal)
        self._server.notify_execute(goal.caller, lambda caller: _close(caller, status, result))

    def _stopped(self, goal: _Goal) -> None:
        if goal is self._last:
            self._stop()


def _close(caller: ServerGoalHandle, status: int, result: Any) -> Any:
    """Give the caller's goal the controller's outcome."""
    if status == GoalStatus.STATUS_SUCCEEDED:
        caller.succeed()
    elif status == GoalStatus.STATUS_CANCELED and caller.is_cancel_requested:
        caller.canceled()
    else:
        if result.error_code == Result.SUCCESSFUL:
            result.error_code = Result.INVALID_GOAL
            result.error_string = result.error_string or "the controller gave the goal up"
        caller.abort()
    return result


def _subtract(desired: Any, actual: Any, error: Any) -> None:
    """Make the error that of two un-corrected points; what one of them lacks is left out."""
    error.accelerations = []
    for name in ("positions", "velocities"):
        pair = [np.array(getattr(point, name)) for point in (desired, actual)]
        there = len(pair[0]) == len(pair[1])
        setattr(error, name, (pair[0] - pair[1]).tolist() if there else [])
