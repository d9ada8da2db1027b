# SPDX-License-Identifier: Apache-2.0
"""The action FollowJointTrajectory before a controller: taught goals in, corrected ones out.

Each goal is corrected and forwarded; it ends as the controller ends it. Nothing here waits: goals
are ended from callbacks, so that a cancel passes at once in whatever executor the node runs. No
callback lets an exception out: in rclpy's events executor one of an action's client ends the
process. docs/joint_correction.md tells it to users.
"""

import ctypes
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient, CancelResponse, GoalResponse
from rclpy.action.client import ClientGoalHandle
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.interface import MOST_POINTS, Reason, RefusedError
from robocal_ros.correction.sent_path import SentPath
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.samples import TAUGHT
from robocal_ros.motion.driver import guarded
from robocal_ros.ros.endpoints import DeferredActionServer, EndpointNode

Result = FollowJointTrajectory.Result

# Points of a goal while the robot is being moved, when a stop is to be answered within 50 ms: of
# 1000 rclpy makes objects, and messages of these again, in 11 ms.
MOST_GOAL_POINTS_IN_MOTION = 3_000
ANSWER_S = 5.0  # a controller that has not answered a goal or a cancel by then never will
WATCH_S = 0.2
_ABOUT_JOINTS = {Reason.UNKNOWN_JOINT, Reason.DOUBLED_JOINT, Reason.MISSING_JOINT}


# Where the number of points stands in the C structure of a goal's request, after goal_id, header,
# joint_names and a pointer: a sequence is a pointer, its size and its capacity (rosidl_runtime_c).
POINTS_AT = 16 + 32 + 24 + 8
_CONVERTERS = (
    "_CREATE_ROS_MESSAGE", "_CONVERT_FROM_PY", "_CONVERT_TO_PY", "_DESTROY_ROS_MESSAGE",
)  # fmt: skip


@dataclass(frozen=True)
class LongGoal:
    """In the place of a goal whose points are more than are taken."""

    points: int


def brief_action(most: Callable[[], int]) -> Any:
    """The action, as a server of rclpy takes it, whose goals of more points stay in C.

    rclpy makes an object of each point before it asks anybody: of 100 000 the node would be deaf
    for seconds. A `LongGoal` stands in place of such a goal. The action itself where messages are
    not laid out, or not converted, as expected.
    """
    whole: Any = FollowJointTrajectory
    usual = type(whole.Impl.SendGoalService.Request)
    usual.__import_type_support__()
    if not all(getattr(usual, name, None) for name in _CONVERTERS):
        return whole
    api = ctypes.PyDLL(None)  # with argument types of its own, unlike ctypes.pythonapi
    api.PyCapsule_GetPointer.argtypes = [ctypes.py_object, ctypes.c_char_p]
    api.PyCapsule_GetPointer.restype = ctypes.c_void_p
    api.PyCapsule_New.argtypes = [ctypes.c_void_p, ctypes.c_char_p, ctypes.c_void_p]
    api.PyCapsule_New.restype = ctypes.py_object

    def function(name: str, *types: Any) -> Any:
        capsule = getattr(usual, name)
        return ctypes.PYFUNCTYPE(*types)(api.PyCapsule_GetPointer(capsule, None))

    def points(request: int) -> Any:
        return ctypes.c_size_t.from_address(request + POINTS_AT)

    path = JointTrajectory(points=[JointTrajectoryPoint()] * 3)
    known = whole.Impl.SendGoalService.Request(goal=whole.Goal(trajectory=path))
    made = function("_CREATE_ROS_MESSAGE", ctypes.c_void_p)()
    fill = function("_CONVERT_FROM_PY", ctypes.c_bool, ctypes.py_object, ctypes.c_void_p)
    as_expected = fill(known, made) and points(made).value == len(path.points)
    function("_DESTROY_ROS_MESSAGE", None, ctypes.c_void_p)(made)
    if not as_expected:
        return whole
    convert = function("_CONVERT_TO_PY", ctypes.py_object, ctypes.c_void_p)

    def briefly(request: int) -> Any:
        count = points(request)
        many = count.value
        if many <= most():
            return convert(request)
        count.value = 0
        try:
            goal_id = convert(request).goal_id
        finally:
            count.value = many  # which rclpy frees
        return SimpleNamespace(goal_id=goal_id, goal=LongGoal(many))

    def brief(request: int) -> Any:
        try:
            return briefly(request)
        except BaseException:  # ctypes would return what lay in memory, which rclpy then frees
            traceback.print_exc()
            return None

    called = ctypes.PYFUNCTYPE(ctypes.py_object, ctypes.c_void_p)(brief)
    capsule = api.PyCapsule_New(ctypes.cast(called, ctypes.c_void_p), None, None)
    kind = type("BriefType", (usual,), {"_CONVERT_TO_PY": capsule, "_called": called})
    request = kind("BriefRequest", (whole.Impl.SendGoalService.Request,), {"__slots__": []})

    class BriefAction(whole):
        class Impl(whole.Impl):
            class SendGoalService(whole.Impl.SendGoalService):
                Request = request

    return BriefAction


class ControllerError(RobocalError):
    """The controller cannot take a goal."""


@dataclass(eq=False)
class _Goal:
    """A goal on its way."""

    caller: ServerGoalHandle
    servers: frozenset[bytes] = frozenset()  # that offered the controller's action at its begin
    asked_s: float | None = None  # since when the controller owes an answer
    accepted: ClientGoalHandle | None = None  # the goal at the controller
    result: Future | None = None  # what it will answer in the end
    path: SentPath | None = None  # its corrected trajectory; None in shadow mode
    stopped: str = ""  # why it was stopped here
    cancel: bool = False
    over: bool = False


class TrajectoryProxy:
    """Serves the action ``name`` with a controller's action, from `open` to `close`.

    ``correct`` makes a corrected trajectory of a taught one, and its path, or raises
    `RefusedError`; ``sent`` is called when it has gone out, ``lost`` when its controller is gone,
    and the robot may still follow it; ``unheard`` when it does not answer, which tells whether the
    robot may.

    Both ends stay until `destroy`, which must not be called while the node spins: rclpy's events
    executor reads freed memory when an action goes that something waits for. When closed, goals
    are rejected.
    """

    def __init__(
        self,
        node: EndpointNode,
        name: str,
        correct: Callable[[Any], tuple[Any, SentPath | None]],
        sent: Callable[[], None],
        lost: Callable[[str], object],
        unheard: Callable[[str], bool],
    ) -> None:
        self._node, self._correct, self._sent, self._lost = node, correct, sent, lost
        self._unheard = unheard
        self._safe = partial(guarded, node)
        self._goals: list[_Goal] = []
        self._clients: dict[str, ActionClient] = {}
        self.controller = ""  # resolved name of the controller's action; empty when closed
        # rclpy remaps the topics and services of an action, but not its name.
        self._own_name = node.resolve_topic_name(name)
        self._server = DeferredActionServer(
            node,
            brief_action(self._most),
            self._own_name,
            goal_callback=self._safe(self._asked, GoalResponse.REJECT),
            handle_accepted_callback=self._safe(self._begin),
            cancel_callback=self._safe(self._cancelled, CancelResponse.REJECT),
        )

    def open(self, controller: str, session: CorrectionSession) -> None:
        """Take goals for the action ``controller``; `InputError` when it is this node's own."""
        self._session = session
        name = self._node.resolve_topic_name(controller)
        if name == self._own_name:
            raise InputError(f"{name} is this node's own action: name the controller's")
        if name not in self._clients:
            self._clients[name] = ActionClient(self._node, FollowJointTrajectory, name)
        self.controller = name
        self._node.add_timer(WATCH_S, self._safe(self._watch), steady=True)

    @property
    def clients(self) -> dict[str, int]:
        """The actions that goals go to or went to, and how many clients of ours each has."""
        return dict.fromkeys(self._clients, 1)

    @property
    def busy(self) -> bool:
        """Whether a goal is under way."""
        return bool(self._goals)

    def close(self) -> None:
        """Take no goals any more."""
        self.controller = ""

    def destroy(self) -> None:
        """Take both ends down."""
        for end in (self._server, *self._clients.values()):
            end.destroy()

    def _when_done(self, future: Future, act: Callable[[_Goal, Any], None], goal: _Goal) -> None:
        future.add_done_callback(self._safe(lambda done: act(goal, done.result())))

    def stop(self, message: Any, why: str) -> bool:
        """Send a trajectory that stops the robot; it preempts the goals, which end for ``why``.

        False when no controller is configured. A goal is cancelled only where the controller
        rejects the stop, or is not all there: a cancel is a dead stop from any speed.
        """
        client = self._clients.get(self.controller)
        if client is None:
            return False
        goals = list(self._goals)
        for goal in goals:
            goal.stopped = why
            goal.cancel = goal.accepted is None  # follows the acceptance, should it come after all
        future = client.send_goal_async(FollowJointTrajectory.Goal(trajectory=message))

        def answered(done: Future) -> None:
            handle = done.result()
            if handle is not None and handle.accepted:
                return
            self._node.get_logger().error(
                f"{self.controller} rejected a stop: its goals are cancelled"
            )
            for goal in goals:
                self._forward_cancel(goal)

        future.add_done_callback(self._safe(answered))
        if not client.server_is_ready():  # it may drive on all the same, and may never answer
            for goal in goals:
                self._forward_cancel(goal)
        return True

    def cancel(self, why: str) -> None:
        """Cancel the goals, where no stop could be planned: the controller stops as it does."""
        for goal in self._goals:
            goal.stopped = why
            self._forward_cancel(goal)

    def end(self, why: str) -> None:
        """End the goals for their callers; the controller's were stopped before."""
        for goal in list(self._goals):
            self._fail(goal, goal.stopped or why)

    def _most(self) -> int:
        """Points of a goal that is taken now."""
        moves = self.controller and self._session.moves(time.monotonic())
        return MOST_GOAL_POINTS_IN_MOTION if moves else MOST_POINTS

    def _asked(self, request: Any) -> GoalResponse:
        why = ""
        if not (self._node.is_active and self.controller):
            why = f"the node is {self._node.state}"
        elif isinstance(request, LongGoal):
            why = (
                f"it has {request.points} points, allowed {MOST_POINTS}, and "
                f"{MOST_GOAL_POINTS_IN_MOTION} while the robot is being moved"
            )
        elif not request.trajectory.points:
            why = "it has no points, which is no stop: cancel the goal that is under way"
        if not why:
            return GoalResponse.ACCEPT
        self._node.get_logger().warning(f"goal rejected: {why}")
        return GoalResponse.REJECT

    def _begin(self, caller: ServerGoalHandle) -> None:
        """Correct the goal and send it."""
        caller.execute()
        goal, request = _Goal(caller), caller.request
        try:
            goal.servers, client = self._servers(), self._clients[self.controller]
            if not (goal.servers and client.server_is_ready()):
                raise ControllerError(f"no controller offers {self.controller}: start it")
            if len(goal.servers) > 1:  # each of them would move the robot
                raise ControllerError(
                    f"{len(goal.servers)} nodes offer {self.controller}: end all but one; one that "
                    "was killed counts until DDS gives it up"
                )
            request.trajectory, goal.path = self._correct(request.trajectory)
            self._goals.append(goal)
            future = client.send_goal_async(
                request,
                self._safe(lambda message: self._feedback(goal, message.feedback)),
                caller.goal_id,
            )
            goal.asked_s = time.monotonic()
            if goal.path is not None:
                goal.path.begin(goal.asked_s)
            self._sent()
            self._when_done(future, self._answered, goal)
        except RobocalError as error:
            about_joints = isinstance(error, RefusedError) and error.reason in _ABOUT_JOINTS
            code = Result.INVALID_JOINTS if about_joints else Result.INVALID_GOAL
            self._fail(goal, str(error), code)
        except Exception as error:
            if goal.path is not None:  # it never went out
                self._session.reject(goal.path)
            self._node.get_logger().error(traceback.format_exc())
            self._fail(goal, f"a defect of this software, please report it: {error!r}")

    def _cancelled(self, caller: ServerGoalHandle) -> CancelResponse:
        for goal in self._goals:
            if goal.caller is caller:
                self._forward_cancel(goal)
                return CancelResponse.ACCEPT
        return CancelResponse.REJECT

    def _forward_cancel(self, goal: _Goal) -> None:
        goal.cancel = True
        if goal.accepted is None:  # it follows the acceptance
            return

        def answered(goal: _Goal, answer: Any) -> None:
            goal.asked_s = None
            if answer.return_code == CancelGoal.Response.ERROR_NONE:
                self._stopped(goal)  # it holds from now on, its result follows
            elif answer.return_code == CancelGoal.Response.ERROR_UNKNOWN_GOAL_ID:
                self._fail(goal, f"{self.controller} does not know the goal any more")

        goal.asked_s = time.monotonic()
        self._when_done(goal.accepted.cancel_goal_async(), answered, goal)

    def _answered(self, goal: _Goal, accepted: ClientGoalHandle) -> None:
        goal.asked_s = None
        if not accepted.accepted:
            if goal.path is not None:
                self._session.reject(goal.path)
            self._fail(goal, f"{self.controller} rejected the goal, its log says why")
            return
        goal.accepted = accepted
        if goal.path is not None:
            goal.path.replaced = None  # there is no way back
        if goal.cancel or goal.over:
            self._forward_cancel(goal)
        if not goal.over:
            goal.result = accepted.get_result_async()
            self._when_done(goal.result, self._finished, goal)

    def _feedback(self, goal: _Goal, feedback: Any) -> None:
        """Un-correct feedback and pass it on; what one of its points lacks has no error."""
        if goal.over:
            return
        names, error = tuple(feedback.joint_names), feedback.error
        try:
            for point in (feedback.desired, feedback.actual):
                self._make_taught(names, point)
        except RobocalError:
            return
        feedback.header.frame_id = TAUGHT
        error.accelerations = []
        error.effort = []
        for name in ("positions", "velocities"):
            desired, actual = getattr(feedback.desired, name), getattr(feedback.actual, name)
            there = len(desired) == len(actual)
            setattr(error, name, (np.array(desired) - np.array(actual)).tolist() if there else [])
        goal.caller.publish_feedback(feedback)

    def _make_taught(self, names: tuple[str, ...], point: Any) -> None:
        """Un-correct positions and velocities; accelerations cannot be, and are left out.

        So are velocities and efforts that are fewer than the joints, or not finite: there are
        controllers that have none.
        """
        point.accelerations = []
        count = len(names)
        if len(point.effort) != count or not np.all(np.isfinite(point.effort)):
            point.effort = []
        if not point.positions:
            point.velocities = []
            return
        velocity = np.array(point.velocities) if len(point.velocities) == count else None
        position, velocity = self._session.taught(
            names, np.array(point.positions), velocity, time.monotonic()
        )
        point.positions = position.tolist()
        point.velocities = [] if velocity is None else velocity.tolist()

    def _finished(self, goal: _Goal, answer: Any) -> None:
        if goal.over or answer is None:
            return
        status, result = answer.status, answer.result
        cancelled = status == GoalStatus.STATUS_CANCELED and goal.caller.is_cancel_requested
        if goal.stopped:
            self._fail(goal, goal.stopped)
        elif status == GoalStatus.STATUS_UNKNOWN:
            self._fail(goal, f"{self.controller} does not know the goal any more")
        elif cancelled or status == GoalStatus.STATUS_SUCCEEDED:
            self._end(goal, status, result)
        else:
            why = result.error_string or f"{self.controller} gave the goal up without a reason"
            self._fail(goal, why, result.error_code or Result.INVALID_GOAL)

    def _watch(self) -> None:
        """End goals that the controller will not end."""
        servers = self._servers() if self._goals else frozenset()
        overdue_s = time.monotonic() - ANSWER_S
        for goal in list(self._goals):
            if not goal.servers <= servers:
                if goal.result is not None:
                    goal.result.cancel()  # rclpy would keep it for ever
                why = f"the controller that offered {self.controller} vanished"
                goal.stopped = why  # its path ends when the robot is seen to stand
                self._lost(why)
                self._forward_cancel(goal)
                self._fail(goal, f"{why}; the robot may still move")
            elif goal.asked_s is not None and goal.asked_s < overdue_s:
                what = "cancel" if goal.cancel else "goal"
                why = f"{self.controller} did not answer within {ANSWER_S:g} s to the {what}"
                later = self._goals[self._goals.index(goal) + 1 :]
                if not any(other.accepted for other in later) and self._unheard(why):
                    goal.stopped = why  # its path goes on, as the robot may follow it
                self._fail(goal, f"{why}; the robot may still move")

    def _servers(self) -> frozenset[bytes]:
        """Who offers the controller's action: a restarted controller is another one."""
        infos = self._node.get_publishers_info_by_topic(f"{self.controller}/_action/status")
        return frozenset(bytes(info.endpoint_gid) for info in infos)

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
        if goal.path is not None and not goal.stopped:
            goal.path.end(time.monotonic())
