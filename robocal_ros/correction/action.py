"""The action FollowJointTrajectory before a controller: taught goals in, corrected ones out.

Each goal is corrected and forwarded; it ends as the controller ends it. Nothing here waits: goals
are ended from callbacks, so that a cancel passes at once in whatever executor the node runs. No
callback lets an exception out: in rclpy's events executor one of an action's client ends the
process. docs/joint_correction_action.md tells it to users.
"""

import functools
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
from rclpy.action import ActionClient, CancelResponse, GoalResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future

from robocal_ros.core.errors import InputError, RobocalError
from robocal_ros.core.samples import TAUGHT
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.nodes.deferred_action import DeferredActionServer
from robocal_ros.nodes.endpoints import EndpointNode

Array = NDArray[np.float64]
Result = FollowJointTrajectory.Result

ANSWER_S = 5.0  # a controller that has not answered a goal or a cancel by then never will
WATCH_S = 0.2
_ABOUT_JOINTS = {Reason.UNKNOWN_JOINT, Reason.DOUBLED_JOINT, Reason.MISSING_JOINT}


class ControllerError(RobocalError):
    """The controller cannot take a goal."""


@dataclass(eq=False)
class _Goal:
    """A goal on its way.

    Attributes
    ----------
    servers : who offered the controller's action when it was sent.
    asked_s : since when the controller owes an answer; None when it owes none.
    accepted : the goal at the controller.
    result : what it will answer in the end.
    course : its corrected trajectory; None without one.
    """

    caller: ServerGoalHandle
    servers: frozenset[bytes] = frozenset()
    asked_s: float | None = None
    accepted: ClientGoalHandle | None = None
    result: Future | None = None
    course: Course | None = None
    cancel: bool = False
    over: bool = False


class TrajectoryProxy:
    """Serves the action ``name`` with a controller's action, from `open` to `close`.

    Both ends stay until `destroy`, which must not be called while the node spins: rclpy's events
    executor reads freed memory when an action goes that something waits for. When closed, goals
    are rejected.

    Parameters
    ----------
    correct : the corrected trajectory of a taught one, and its course; raises `RefusedError`.
    taught : taught positions and velocities of (names, positions, velocities or None), each (k,).
    stop, sent : called for a goal that is a stop; after any other one has gone out.
    """

    def __init__(
        self,
        node: EndpointNode,
        name: str,
        correct: Callable[[Any], tuple[Any, Course | None]],
        taught: Callable[[tuple[str, ...], Array, Array | None], tuple[Array, Array | None]],
        stop: Callable[[], None],
        sent: Callable[[], None],
    ) -> None:
        self._node, self._correct, self._taught = node, correct, taught
        self._stop, self._sent = stop, sent
        self._goals: list[_Goal] = []
        self._clients: dict[str, ActionClient] = {}
        self._name = ""  # of the controller's action; empty when closed
        # rclpy remaps the topics and services of an action, but not its name.
        self._own_name = node.resolve_topic_name(name)
        self._server = DeferredActionServer(
            node,
            FollowJointTrajectory,
            self._own_name,
            goal_callback=self._asked,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancelled,
        )

    def open(self, controller: str) -> None:
        """Take goals for the action ``controller``; `InputError` when it is this node's own."""
        name = self._node.resolve_topic_name(controller)
        if name == self._own_name:
            raise InputError(f"{name} is this node's own action: name the controller's")
        if name not in self._clients:
            self._clients[name] = ActionClient(self._node, FollowJointTrajectory, name)
        self._name = name
        self._node.add_timer(WATCH_S, self._watch, steady=True)

    def deactivate(self) -> None:
        """Cancel every goal at the controller, and end it."""
        for goal in list(self._goals):
            self._forward_cancel(goal)
            self._fail(goal, "the joint correction was deactivated, it cancelled the goal")

    def close(self) -> None:
        """Take no goals any more."""
        self._name = ""

    def destroy(self) -> None:
        """Take both ends down."""
        for end in (self._server, *self._clients.values()):
            end.destroy()

    # ---- from the caller ------------------------------------------------------------------------

    def _asked(self, request: Any) -> GoalResponse:
        if self._node.is_active and self._name:
            return GoalResponse.ACCEPT
        self._node.get_logger().warning(f"goal rejected: the node is {self._node.state}")
        return GoalResponse.REJECT

    def _begin(self, caller: ServerGoalHandle) -> None:
        caller.execute()
        goal = _Goal(caller)
        try:
            self._forward(goal, caller.request)
        except RobocalError as error:
            about_joints = isinstance(error, RefusedError) and error.reason in _ABOUT_JOINTS
            code = Result.INVALID_JOINTS if about_joints else Result.INVALID_GOAL
            self._fail(goal, str(error), code)
        except Exception as error:
            if goal.course is not None:  # it never went out
                goal.course.reject()
            self._node.get_logger().error(traceback.format_exc())
            self._fail(goal, f"a defect of this software, please report it: {error!r}")

    def _forward(self, goal: _Goal, request: Any) -> None:
        """Correct the goal and send it; one without points is a stop, which nothing bars."""
        goal.servers, client = self._servers(), self._clients[self._name]
        if not (goal.servers and client.server_is_ready()):
            raise ControllerError(f"no controller offers {self._name}: start it")
        if not request.trajectory.points:
            for other in self._goals:  # for controllers that know no goal without points
                self._forward_cancel(other)
            self._stop()
        elif len(goal.servers) > 1:  # each of them would move the robot
            raise ControllerError(
                f"{len(goal.servers)} nodes offer {self._name}: end all but one; one that was "
                "killed counts until DDS gives it up"
            )
        else:
            request.trajectory, goal.course = self._correct(request.trajectory)
        self._goals.append(goal)
        future = client.send_goal_async(
            request, lambda message: self._feedback(goal, message.feedback), goal.caller.goal_id
        )
        goal.asked_s = time.monotonic()
        if goal.course is not None:
            goal.course.begin(goal.asked_s)
        if request.trajectory.points:
            self._sent()
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
            if goal.course is not None:
                goal.course.reject()
            self._fail(goal, f"{self._name} rejected the goal, its log says why")
            return
        goal.accepted = accepted
        if goal.course is not None:
            goal.course.accept()
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
            self._fail(goal, f"{self._name} does not know the goal any more")

    def _feedback(self, goal: _Goal, feedback: Any) -> None:
        if goal.over:
            return
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
        if goal.over or answer is None:
            return
        status, result = answer.status, answer.result
        cancelled = status == GoalStatus.STATUS_CANCELED and goal.caller.is_cancel_requested
        if status == GoalStatus.STATUS_UNKNOWN:
            self._fail(goal, f"{self._name} does not know the goal any more")
        elif cancelled or status == GoalStatus.STATUS_SUCCEEDED:
            self._end(goal, status, result)
        else:
            why = result.error_string or f"{self._name} gave the goal up without a reason"
            self._fail(goal, why, result.error_code or Result.INVALID_GOAL)

    def _watch(self) -> None:
        """End goals that the controller will not end."""
        servers = self._servers() if self._goals else frozenset()
        overdue_s = time.monotonic() - ANSWER_S
        for goal in list(self._goals):
            if not goal.servers <= servers:
                if goal.result is not None:
                    goal.result.cancel()  # rclpy would keep it for ever
                self._fail(goal, f"the controller that offered {self._name} vanished")
            elif goal.asked_s is not None and goal.asked_s < overdue_s:
                what = "cancel, the robot may still move" if goal.cancel else "goal"
                self._fail(goal, f"{self._name} did not answer within {ANSWER_S:g} s to the {what}")

    def _servers(self) -> frozenset[bytes]:
        """Who offers the controller's action: a restarted controller is another one."""
        infos = self._node.get_publishers_info_by_topic(f"{self._name}/_action/status")
        return frozenset(bytes(info.endpoint_gid) for info in infos)

    # ---- the end --------------------------------------------------------------------------------

    def _fail(self, goal: _Goal, why: str, code: int = Result.INVALID_GOAL) -> None:
        if not goal.over:
            self._node.get_logger().warning(f"goal aborted: {why}")
            result = Result(error_code=code, error_string=why)
            self._end(goal, GoalStatus.STATUS_ABORTED, result)

    def _end(self, goal: _Goal, status: int, result: Any) -> None:
        goal.over = True
        if goal in self._goals:
            self._goals.remove(goal)
        if status != GoalStatus.STATUS_SUCCEEDED:
            self._stopped(goal)
        self._server.end(goal.caller, status, result)

    def _stopped(self, goal: _Goal) -> None:
        if goal.course is not None:
            goal.course.end(time.monotonic())


def _subtract(desired: Any, actual: Any, error: Any) -> None:
    """Make the error that of two un-corrected points; what one of them lacks is left out."""
    error.accelerations = []
    for name in ("positions", "velocities"):
        pair = [np.array(getattr(point, name)) for point in (desired, actual)]
        there = len(pair[0]) == len(pair[1])
        setattr(error, name, (pair[0] - pair[1]).tolist() if there else [])
