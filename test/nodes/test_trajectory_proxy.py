# SPDX-License-Identifier: Apache-2.0
"""The action of the joint correction before a controller's, over DDS."""

import math
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from builtin_interfaces.msg import Duration
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTolerance
from follower import ACTION, HOME, NAMES, Follower
from joint_correction_live import NODE, NOMINAL, drifted, model_message
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from rcl_interfaces.msg import Log
from rclpy.action import ActionClient
from rclpy.node import Node
from rclpy.qos import qos_profile_action_status_default
from rclpy.serialization import deserialize_message, serialize_message
from robocal_msgs.msg import JointOffset, KinematicModel, MotionLease
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from unique_identifier_msgs.msg import UUID

from robocal_ros.correction import action as trajectory_proxy
from robocal_ros.correction.action import MOST_GOAL_POINTS_IN_MOTION
from robocal_ros.correction.interface import MOST_POINTS
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.ground.samples import CORRECTED, TAUGHT
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import endpoints

OWN = f"{NODE}/follow_joint_trajectory"
Result = FollowJointTrajectory.Result
MOVED = HOME + np.array([0.2, 0.1, -0.1, 0.2, -0.1, 0.3])
AT_ONCE_S = 0.5  # with other work on the machine
STANDS_S = 0.4  # a robot that is known to stand
SETTINGS = {
    "serial": "s1",
    "follow_joint_trajectory": ACTION,
    "enable_on_start": True,
    "joint_state_age_s": 5.0,
}
ACTUAL = drifted()


def tcp(arm: SerialArm, q: Any) -> np.ndarray:
    return np.asarray(arm.fk(np.array(q)) @ arm.T_flange_tool)


def goal_of(*places: np.ndarray, lasts_s: float = 0.4, starts_s: float = 0.0, **fields: Any) -> Any:
    """From place to place in equal times, at rest at the ends."""
    times = np.linspace(starts_s, lasts_s, len(places))
    points = [
        JointTrajectoryPoint(
            positions=q.tolist(),
            time_from_start=Duration(sec=int(t), nanosec=round(t % 1 * 1e9)),
        )
        for q, t in zip(places, times, strict=True)
    ]
    trajectory = JointTrajectory(joint_names=NAMES, points=points)
    return FollowJointTrajectory.Goal(trajectory=trajectory, **fields)


class Sent:
    """A goal as its caller sees it."""

    def __init__(self, cell: "Cell", goal: Any) -> None:
        self._cell = cell
        self.feedback: list[Any] = []
        self.handle: Any = None
        self.answer: Any = None
        future = cell.client.send_goal_async(goal, lambda m: self.feedback.append(m.feedback))
        future.add_done_callback(self._accepted)

    def _accepted(self, future: Any) -> None:
        self.handle = future.result()
        if self.handle.accepted:
            done = self.handle.get_result_async()
            done.add_done_callback(lambda f: setattr(self, "answer", f.result()))

    def ends(self, status: int, within_s: float = 5.0) -> Any:
        self._cell.graph.spin_until(lambda: self.answer, "the goal ends", within_s)
        assert self.answer.status == status, self.answer
        return self.answer.result

    def moves(self) -> "Sent":
        self._cell.graph.spin_until(lambda: len(self.feedback) > 2, "the robot moves")
        return self


class Cell:
    """Caller (the probe), correction node and controller; the model is in force."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.client = ActionClient(
            graph.probe, FollowJointTrajectory, f"{NODE}/follow_joint_trajectory"
        )
        self.states = graph.collect(JointState, f"{NODE}/joint_states")

    def begin(self, settled: bool = True) -> None:
        self.graph.spin_until(self.client.server_is_ready, "the action")
        publisher = self.graph.publisher(KinematicModel, "kinematic_model", endpoints.LATCHED)
        publisher.publish(model_message(ACTUAL))
        self.taught()
        if settled:
            self.send(HOME, HOME).ends(GoalStatus.STATUS_SUCCEEDED)

    def send(self, *places: np.ndarray, **fields: Any) -> Sent:
        return Sent(self, goal_of(*places, **fields))

    def change(self, *transitions: int) -> None:
        """Let the node go through its lifecycle."""
        for what in transitions:
            transition = Transition(id=what)
            assert self.graph.call(
                ChangeState, f"{NODE}/change_state", transition=transition
            ).success

    def taught(self) -> np.ndarray:
        """Where the robot stands, as planners see it; the node knows by then that it stands."""
        self.states.clear()
        self.graph.spin_until(lambda: len(self.states) > 3, "joint states")
        self.graph.spin_for(STANDS_S)
        return np.array(self.states[-1].position)


@pytest.fixture
def cell(graph: Any) -> Iterator[Any]:
    """With node and controller in the test's process."""
    cell = Cell(graph)
    cell.robot = Follower(context=graph.context)
    graph.executor.add_node(cell.robot)
    cell.node = graph.add(JointCorrectionNode, SETTINGS)
    client = cell.node._proxy._clients[ACTION]
    graph.spin_until(client.server_is_ready, "the controller")
    yield cell
    cell.client.destroy()
    cell.robot.close()


def test_a_goal_reaches_the_taught_pose_and_all_else_passes(cell: Any) -> None:
    cell.begin()
    tolerance = [JointTolerance(name=NAMES[2], position=0.5, velocity=-1.0)]
    fields = {"path_tolerance": tolerance, "goal_time_tolerance": Duration(sec=3)}
    sent = cell.send(HOME, MOVED, goal_tolerance=tolerance, **fields)
    result = sent.ends(GoalStatus.STATUS_SUCCEEDED)
    assert (result.error_code, result.error_string) == (0, "Goal successfully reached!")
    received = cell.robot.goals[-1]
    points = received.trajectory.points
    assert received.trajectory.header.frame_id == CORRECTED
    assert [p.time_from_start for p in points] == [Duration(), Duration(nanosec=400_000_000)]
    assert received.path_tolerance == received.goal_tolerance == tolerance
    assert received.goal_time_tolerance == Duration(sec=3)
    for point, taught in zip(points, (HOME, MOVED), strict=True):
        assert np.abs(tcp(ACTUAL, point.positions) - tcp(NOMINAL, taught)).max() < 1e-8
        assert np.abs(tcp(ACTUAL, taught) - tcp(NOMINAL, taught)).max() > 1e-5


def test_what_a_goal_is_corrected_by_is_told(cell: Any) -> None:
    """As of a trajectory of the topic: once when it goes out, then ten times a second."""
    offsets = cell.graph.collect(JointOffset, f"{NODE}/correction")
    cell.begin(settled=False)
    assert not offsets
    cell.send(HOME, MOVED).ends(GoalStatus.STATUS_SUCCEEDED)
    cell.graph.spin_until(lambda: len(offsets) > 3, "offsets")
    assert [o.cause for o in offsets].count(JointOffset.TRAJECTORY) == 1
    assert {o.cause for o in offsets} == {JointOffset.TRAJECTORY, JointOffset.PERIODIC}
    expected = cell.robot.goals[-1].trajectory.points[-1].positions - MOVED
    cell.graph.spin_until(
        lambda: np.abs(np.array(offsets[-1].offset) - expected).max() < 1e-9, "that of the end"
    )
    assert np.abs(offsets[-1].withheld).max() < 1e-9


def test_feedback_is_of_the_taught_world(cell: Any) -> None:
    cell.begin()
    cell.robot.feedback.clear()
    sent = cell.send(HOME, MOVED)
    sent.ends(GoalStatus.STATUS_SUCCEEDED)
    cell.graph.spin_until(lambda: len(sent.feedback) >= len(cell.robot.feedback), "all feedback")
    for raw, feedback in zip(cell.robot.feedback, sent.feedback, strict=True):
        for name in ("desired", "actual"):
            taught, driven = getattr(feedback, name), getattr(raw, name)
            miss = tcp(NOMINAL, taught.positions) - tcp(ACTUAL, driven.positions)
            assert np.abs(miss).max() < 1e-8
            step = 1e-6  # the tool's velocity is the same too
            ahead = np.array(driven.positions) + step * np.array(driven.velocities)
            moved = np.array(taught.positions) + step * np.array(taught.velocities)
            assert np.abs(tcp(NOMINAL, moved) - tcp(ACTUAL, ahead)).max() < 1e-8
            assert not taught.accelerations
        for name in ("positions", "velocities"):
            desired, actual, error = (
                np.array(getattr(part, name))
                for part in (feedback.desired, feedback.actual, feedback.error)
            )
            assert np.array_equal(error, desired - actual)
        assert feedback.header.frame_id == TAUGHT
        assert feedback.multi_dof_joint_names == ["rail"]
    assert np.abs(np.array(sent.feedback[-1].desired.positions) - MOVED).max() < 1e-9


def test_a_cancel_stops_the_robot_and_the_next_goal_goes_on_from_there(cell: Any) -> None:
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=20.0).moves()
    asked = time.monotonic()
    sent.handle.cancel_goal_async()
    cell.graph.spin_until(lambda: cell.robot.path is None, "the robot holds", AT_ONCE_S)
    assert sent.ends(GoalStatus.STATUS_CANCELED, AT_ONCE_S).error_code == Result.SUCCESSFUL
    assert time.monotonic() - asked < AT_ONCE_S
    here = cell.taught()
    assert 1e-4 < np.abs(here - HOME).max() < np.abs(MOVED - HOME).max()
    cell.send(here, MOVED).ends(GoalStatus.STATUS_SUCCEEDED)
    assert np.abs(tcp(ACTUAL, cell.robot.q) - tcp(NOMINAL, MOVED)).max() < 1e-5


def test_a_rejected_goal_leaves_what_runs(cell: Any) -> None:
    cell.begin(settled=False)
    first = cell.send(HOME, MOVED, lasts_s=2.0).moves()
    cell.robot.rejects = True
    result = cell.send(MOVED, HOME, lasts_s=2.0).ends(GoalStatus.STATUS_ABORTED, AT_ONCE_S)
    assert result.error_code == Result.INVALID_GOAL
    first.ends(GoalStatus.STATUS_SUCCEEDED)
    assert np.abs(tcp(ACTUAL, cell.robot.q) - tcp(NOMINAL, MOVED)).max() < 1e-5
    assert np.abs(cell.taught() - MOVED).max() < 1e-6


def test_a_goal_that_is_refused_or_rejected_disturbs_nothing(cell: Any) -> None:
    """One without points is no stop, as before joint_trajectory_controller."""
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=3.0).moves()
    count = len(cell.robot.goals)
    unknown, again = goal_of(HOME, MOVED), goal_of(HOME, MOVED)
    unknown.trajectory.joint_names = [*NAMES[:5], "elbow"]
    again.trajectory.header.frame_id = CORRECTED
    for goal, code, words in (
        (unknown, Result.INVALID_JOINTS, "elbow"),
        (goal_of(HOME, MOVED * np.nan), Result.INVALID_GOAL, "not finite"),
        (again, Result.INVALID_GOAL, "comes from a joint correction already"),
    ):
        result = Sent(cell, goal).ends(GoalStatus.STATUS_ABORTED)
        assert result.error_code == code
        assert words in result.error_string
    for points in (0, MOST_GOAL_POINTS_IN_MOTION + 1, MOST_POINTS + 1):
        rejected = Sent(cell, goal_of(*np.linspace(HOME, MOVED, points), lasts_s=100.0))
        cell.graph.spin_until(lambda sent=rejected: sent.handle, "the answer")
        assert not rejected.handle.accepted
    correct, cell.node._proxy._correct = cell.node._proxy._correct, lambda message: 1 / 0
    result = cell.send(HOME, MOVED).ends(GoalStatus.STATUS_ABORTED)
    assert "a defect of this software" in result.error_string
    cell.node._proxy._correct = correct
    assert not sent.answer
    sent.ends(GoalStatus.STATUS_SUCCEEDED)
    assert len(cell.robot.goals) == count
    cell.taught()
    back = cell.send(
        *np.linspace(MOVED, HOME, MOST_GOAL_POINTS_IN_MOTION + 1), lasts_s=1.0
    )  # from rest
    back.ends(GoalStatus.STATUS_SUCCEEDED)


def test_of_a_long_goal_nothing_but_its_id_becomes_python() -> None:
    """So its many points keep the node from nothing; of a goal that is taken all arrive."""
    usual = FollowJointTrajectory.Impl.SendGoalService.Request
    brief = trajectory_proxy.brief_action(lambda: 1000).Impl.SendGoalService.Request
    goal_id = UUID(uuid=range(16))
    for count in (1, 1000, 1001):
        goal = goal_of(*[HOME] * count)
        goal.trajectory.header.frame_id = "world"
        goal.trajectory.points[-1].velocities = [1.0] * 6
        data = serialize_message(usual(goal_id=goal_id, goal=goal))
        took = deserialize_message(data, brief)
        assert took.goal_id == goal_id
        assert took.goal == (goal if count <= 1000 else trajectory_proxy.LongGoal(count))
    data = serialize_message(usual(goal_id=goal_id, goal=goal_of(*[HOME] * 20_000)))

    def cpu_s(kind: Any) -> float:
        begin_s = time.process_time()
        deserialize_message(data, kind)
        return time.process_time() - begin_s

    # what is left is the middleware's own part
    assert min(cpu_s(brief) for _ in range(3)) < 0.3 * min(cpu_s(usual) for _ in range(3))


def test_a_long_goal_that_cannot_be_made_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Finding: rclpy got a pointer to any object that lay there, and freed it."""
    kind = trajectory_proxy.brief_action(lambda: 1).Impl.SendGoalService.Request
    goal = goal_of(HOME, HOME)
    data = serialize_message(FollowJointTrajectory.Impl.SendGoalService.Request(goal=goal))

    def no_memory(points: int) -> None:
        raise MemoryError

    monkeypatch.setattr(trajectory_proxy, "LongGoal", no_memory)
    assert deserialize_message(data, kind) is None


def slows_down(points: Any) -> bool:
    """Lines, for a robot whose states have no velocities, each slower than the one before."""
    times = np.array([p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in points])
    q = np.array([p.positions for p in points])
    speed = np.abs(np.diff(q, axis=0)).max(axis=1) / np.diff(times)
    slower = len(speed) > 1 and np.all(np.diff(speed) < 0.0)
    return bool(slower) and not any(p.velocities for p in points)


def test_a_lease_stops_a_goal_by_a_goal_that_slows_down(cell: Any) -> None:
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=8.0).moves()
    own = cell.graph.probe.create_publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    held = MotionLease(robot=NOMINAL.name, serial="s1", holder="/probe", held=True)
    renewal = cell.graph.probe.create_timer(0.1, lambda: own.publish(held))
    result = sent.ends(GoalStatus.STATUS_ABORTED)
    assert "leased" in result.error_string
    stop = cell.robot.goals[-1].trajectory.points
    assert stop[0].time_from_start.nanosec > 0.08e9
    assert slows_down(stop)
    cell.graph.spin_until(lambda: cell.robot.path is None, "the robot stands")
    place = cell.robot.q.copy()
    assert "leased" in cell.send(HOME, HOME).ends(GoalStatus.STATUS_ABORTED).error_string
    assert np.abs(cell.robot.q - place).max() < 1e-4
    cell.graph.probe.destroy_timer(renewal)
    held.held = False
    own.publish(held)
    cell.graph.spin_for(0.6)
    cell.send(cell.taught(), HOME).ends(GoalStatus.STATUS_SUCCEEDED)


def test_a_new_goal_preempts(cell: Any) -> None:
    cell.begin()
    first = cell.send(HOME, MOVED, lasts_s=4.0).moves()
    second = cell.send(HOME, HOME, starts_s=1.0, lasts_s=1.5)
    result = first.ends(GoalStatus.STATUS_ABORTED)
    assert result.error_code == Result.INVALID_GOAL
    assert result.error_string == "preempted by a newer goal"
    second.ends(GoalStatus.STATUS_SUCCEEDED)
    assert np.abs(tcp(ACTUAL, cell.robot.q) - tcp(NOMINAL, HOME)).max() < 1e-5


def test_a_path_on_the_topic_takes_the_place_of_a_goal(cell: Any) -> None:
    """Finding: the goal was told to have succeeded when the robot was at the other path's end."""
    cell.begin()
    paths = cell.graph.publisher(JointTrajectory, "joint_trajectory")
    first = cell.send(HOME, MOVED, lasts_s=4.0).moves()
    paths.publish(goal_of(HOME, HOME, starts_s=1.0, lasts_s=1.5).trajectory)
    result = first.ends(GoalStatus.STATUS_ABORTED)
    assert result.error_string == "a trajectory on joint_trajectory took its place"


def test_a_violated_tolerance_keeps_its_code(cell: Any) -> None:
    cell.begin()
    cell.robot.stuck = True
    tolerance = [JointTolerance(name=NAMES[0], position=0.01)]
    result = cell.send(HOME, MOVED, path_tolerance=tolerance).ends(GoalStatus.STATUS_ABORTED)
    assert result.error_code == Result.PATH_TOLERANCE_VIOLATED
    assert result.error_string == "path tolerance of joint_a1"


def test_deactivation_stops_and_rejects(cell: Any) -> None:
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=20.0).moves()
    cell.change(Transition.TRANSITION_DEACTIVATE)
    result = sent.ends(GoalStatus.STATUS_ABORTED)
    assert result.error_code == Result.INVALID_GOAL
    assert "deactivated" in result.error_string
    cell.graph.spin_until(lambda: cell.robot.path is None, "the robot stands", 2.0)
    stop = cell.robot.goals[-1].trajectory.points  # a stop, no bare cancel
    assert slows_down(stop)
    assert list(stop[-1].positions) != MOVED.tolist()
    for _ in range(2):  # inactive, then unconfigured
        rejected = cell.send(HOME, MOVED)
        cell.graph.spin_until(lambda sent=rejected: sent.handle, "the answer")
        assert not rejected.handle.accepted
        if cell.node.state == "inactive":
            cell.change(Transition.TRANSITION_CLEANUP)
    cell.change(Transition.TRANSITION_CONFIGURE, Transition.TRANSITION_ACTIVATE)
    here = cell.taught()
    cell.send(here, HOME).ends(GoalStatus.STATUS_SUCCEEDED)


def test_without_a_controller_a_goal_ends_at_once(graph: Any) -> None:
    cell = Cell(graph)
    graph.add(JointCorrectionNode, SETTINGS)
    graph.spin_until(cell.client.server_is_ready, "the action")
    result = cell.send(HOME, HOME).ends(GoalStatus.STATUS_ABORTED)
    assert result.error_code == Result.INVALID_GOAL
    assert f"no controller offers {ACTION}" in result.error_string
    cell.client.destroy()


def test_its_own_action_is_not_the_controllers(graph: Any) -> None:
    node = graph.add(
        JointCorrectionNode,
        SETTINGS | {"follow_joint_trajectory": f"{NODE}/follow_joint_trajectory"},
    )
    assert node.state == "unconfigured"
    assert "name the controller's" in node._full_health().message


def test_two_controllers_get_no_goal(cell: Any) -> None:
    cell.begin()
    proxy = cell.node._proxy
    other = Follower(context=cell.graph.context)
    cell.graph.executor.add_node(other)
    cell.graph.spin_until(lambda: len(proxy._servers()) == 2, "two controllers")
    result = cell.send(HOME, MOVED).ends(GoalStatus.STATUS_ABORTED)
    assert "2 nodes offer" in result.error_string
    assert not other.goals
    other.close()
    cell.graph.spin_until(lambda: len(proxy._servers()) == 1, "one controller")
    cell.send(cell.taught(), MOVED).ends(GoalStatus.STATUS_SUCCEEDED)


def test_a_renamed_action_and_a_controller_that_goes(graph: Any) -> None:
    cell = Cell(graph)
    robot = Follower(context=graph.context)
    graph.executor.add_node(robot)
    renamed = ["--ros-args", "-r", f"{OWN}:=/arm/follow_joint_trajectory"]
    graph.add(JointCorrectionNode, SETTINGS, cli_args=renamed)
    cell.client.destroy()
    cell.client = ActionClient(graph.probe, FollowJointTrajectory, "/arm/follow_joint_trajectory")
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=20.0).moves()
    robot.close()
    assert "vanished" in sent.ends(GoalStatus.STATUS_ABORTED, 1.0).error_string
    cell.client.destroy()


class InParts(Node):
    """A controller whose action is made of its services and topics, so that one can go alone.

    It drives a straight line to a goal's end, and a stop to where it is; ``deaf``: it drives on.
    """

    def __init__(self, deaf: bool, **options: Any) -> None:
        super().__init__("arm_controller", **options)
        self.deaf, self.q, self.goals, self.cancels = deaf, HOME.copy(), [], []
        self._way, self._ends_s = np.zeros(6), 0.0
        impl, within = FollowJointTrajectory.Impl, f"{ACTION}/_action"
        self.create_service(impl.SendGoalService, f"{within}/send_goal", self._asked)
        self.create_service(impl.CancelGoalService, f"{within}/cancel_goal", self._cancelled)
        self.without_answers = Node("results", **options)  # is not spun
        self.without_answers.create_service(
            impl.GetResultService, f"{within}/get_result", lambda request, response: response
        )
        self.create_publisher(impl.FeedbackMessage, f"{within}/feedback", 10)
        status = qos_profile_action_status_default
        self.status = self.create_publisher(impl.GoalStatusMessage, f"{within}/status", status)
        self._states = self.create_publisher(JointState, "joint_states", 10)
        self.create_timer(0.02, self._tick)

    def _asked(self, request: Any, response: Any) -> Any:
        points = request.goal.trajectory.points
        self.goals.append(request.goal)
        if not (self.deaf and len(self.goals) > 1):
            lasts_s = points[-1].time_from_start.sec + 1e-9 * points[-1].time_from_start.nanosec
            self._way = (np.array(points[-1].positions) - self.q) / lasts_s
            self._ends_s = time.monotonic() + lasts_s
        response.accepted = True
        return response

    def _cancelled(self, request: Any, response: Any) -> Any:
        self.cancels.append(request)
        return response

    def _tick(self) -> None:
        if time.monotonic() < self._ends_s:
            self.q = self.q + 0.02 * self._way
        self._states.publish(JointState(name=NAMES, position=self.q.tolist()))


@pytest.fixture
def parts(graph: Any, request: Any) -> Iterator[Any]:
    """In the middle of a goal, with a hard stop that was ``called``; a parameter: deaf."""
    cell = Cell(graph)
    robot = cell.robot = InParts(request.param, context=graph.context)
    graph.executor.add_node(robot)
    cell.called = []
    cell.hard_stop = robot.create_service(
        Trigger, "/hard_stop", lambda request, response: cell.called.append(request) or response
    )
    cell.node = graph.add(JointCorrectionNode, SETTINGS | {"hard_stop_service": "/hard_stop"})
    cell.begin(settled=False)
    cell.sent = cell.send(HOME, MOVED, lasts_s=20.0)
    graph.spin_until(lambda: robot.q[0] > HOME[0] + 0.01, "the robot moves")
    yield cell
    cell.client.destroy()
    robot.without_answers.destroy_node()
    robot.destroy_node()


@pytest.mark.parametrize("parts", [False, True], indirect=True)
def test_a_controller_that_only_drops_out_of_discovery_is_stopped(parts: Any) -> None:
    """Finding: its goal was failed, but never cancelled, and the robot was believed to stand."""
    graph, robot, node = parts.graph, parts.robot, parts.node
    path = node._session.output.path
    robot.destroy_publisher(robot.status)
    assert "vanished" in parts.sent.ends(GoalStatus.STATUS_ABORTED, 5.0).error_string
    assert path.live(time.monotonic())  # it is not known to stand
    graph.spin_until(lambda: len(robot.goals) > 1 and robot.cancels, "stop and cancel")
    assert slows_down(robot.goals[1].trajectory.points)
    if robot.deaf:
        fault = "the robot does not stop: it still moves"
        graph.spin_until(lambda: fault in node._stop_fault, fault, 10.0)
        graph.spin_until(lambda: parts.called, "the hard stop")
        assert path.live(time.monotonic())
    else:
        graph.spin_until(lambda: not path.live(time.monotonic()), "it is known to stand", 5.0)
        assert time.monotonic() > robot._ends_s
        assert not parts.called


@pytest.mark.parametrize("parts", [True], indirect=True)
def test_a_stop_of_before_a_deactivation_ends_with_it(parts: Any) -> None:
    """Finding: activated again, at whatever time, the node called the hard stop at once."""
    parts.change(Transition.TRANSITION_DEACTIVATE)
    parts.graph.spin_until(lambda: len(parts.robot.goals) > 1, "the stop")
    parts.graph.spin_for(1.5)  # somebody else drives it
    parts.change(Transition.TRANSITION_ACTIVATE)
    parts.graph.spin_for(0.5)
    assert parts.node.is_active
    assert not parts.called
    assert not parts.node._stop_fault


@pytest.mark.parametrize("parts", [True], indirect=True)
def test_a_hard_stop_that_nobody_serves_is_told_before_and_when_it_is_wanted(parts: Any) -> None:
    graph, robot, node = parts.graph, parts.robot, parts.node
    logs = graph.collect(Log, "/rosout")
    nobody = "hard_stop_service: nobody serves /hard_stop"
    assert nobody not in node.health().message
    robot.destroy_service(parts.hard_stop)
    graph.spin_until(lambda: nobody in node.health().message, "the warning")
    robot.destroy_publisher(robot.status)
    by_hand = f"stop the robot by hand ({nobody})"
    graph.spin_until(lambda: any(by_hand in log.msg for log in logs), by_hand, 10.0)
    assert not any("/hard_stop is called" in log.msg for log in logs)


# ---- node and controller as processes: the node in its own executor -----------------------------

CONTROLLER = Path(__file__).parents[1] / "worlds" / "follower.py"
LEASE_S = 2.0  # of a mortal one


@pytest.fixture
def apart(graph: Any) -> Iterator[Any]:
    """The controller is a process."""
    cell = Cell(graph)
    cell.controller = graph.start(CONTROLLER, mortal=True)
    yield cell
    cell.client.destroy()


def test_goal_cancel_configuration_and_signal_in_the_events_executor(apart: Any) -> None:
    cell = apart
    process = cell.graph.start("joint_correction_node", SETTINGS)
    cell.begin()
    sent = cell.send(HOME, MOVED)
    assert sent.ends(GoalStatus.STATUS_SUCCEEDED).error_string == "Goal successfully reached!"
    assert np.abs(np.array(sent.feedback[-1].desired.positions) - MOVED).max() < 1e-9
    sent = cell.send(MOVED, HOME, lasts_s=20.0).moves()
    sent.handle.cancel_goal_async()
    sent.ends(GoalStatus.STATUS_CANCELED, AT_ONCE_S)
    for _ in range(4):  # a new configuration in mid goal
        cell.send(cell.taught(), HOME, lasts_s=20.0).moves()
        cell.change(
            Transition.TRANSITION_DEACTIVATE,
            Transition.TRANSITION_CLEANUP,
            Transition.TRANSITION_CONFIGURE,
            Transition.TRANSITION_ACTIVATE,
        )
        cell.taught()
    cell.send(cell.taught(), HOME, lasts_s=20.0).moves()
    assert process.stop(signal.SIGINT) == 0, process.output
    assert "Traceback" not in process.output
    raw = cell.graph.collect(JointState, "joint_states")
    cell.graph.spin_until(
        lambda: len(raw) > 10 and raw[-1].position == raw[-10].position, "the robot holds"
    )
    assert np.abs(np.array(raw[-1].position) - HOME).max() > 0.1


def test_a_controller_that_is_killed_ends_the_goal(apart: Any) -> None:
    cell = apart
    cell.graph.start("joint_correction_node", SETTINGS)
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=20.0).moves()
    cell.controller.kill()
    again = cell.graph.start(
        CONTROLLER, mortal=True
    )  # at once: the old one is still believed alive
    result = sent.ends(GoalStatus.STATUS_ABORTED, LEASE_S + 3.0)
    assert "vanished" in result.error_string
    assert again.process.poll() is None
    cell.graph.call(SetBool, f"{NODE}/enable", data=True)
    for _ in range(10):  # the node may have to find the new one first, and says so
        sent = cell.send(cell.taught(), HOME)
        cell.graph.spin_until(lambda sent=sent: sent.answer, "the goal ends", 5.0)
        said = sent.answer.result.error_string
        if "call ~/acknowledge" in said:  # the new robot stands elsewhere than the old one
            cell.graph.call(Trigger, f"{NODE}/acknowledge")
        elif "no controller offers" not in said:
            break
        cell.graph.spin_for(0.5)
    sent.ends(GoalStatus.STATUS_SUCCEEDED)


def test_a_goal_accepted_too_late_is_cancelled(apart: Any, monkeypatch: Any) -> None:
    monkeypatch.setattr(trajectory_proxy, "ANSWER_S", 0.4)
    cell = apart
    cell.graph.add(JointCorrectionNode, SETTINGS)
    cell.begin()
    cell.controller.process.send_signal(signal.SIGSTOP)
    result = cell.send(HOME, MOVED, lasts_s=10.0).ends(GoalStatus.STATUS_ABORTED, 1.5)
    assert "did not answer within 0.4 s to the goal" in result.error_string
    cell.controller.process.send_signal(signal.SIGCONT)
    cell.graph.spin_for(1.0)  # a tenth of the way, if it were not cancelled
    assert np.abs(cell.taught() - HOME).max() < 0.01 * np.abs(MOVED - HOME).max()


def test_a_goal_of_which_nothing_is_heard_may_be_followed_all_the_same(cell: Any) -> None:
    """So it can be stopped later; what is sent to who does not answer would wait there."""
    cell.begin()
    sent, received = cell.send(HOME, MOVED, lasts_s=20.0).moves(), len(cell.robot.goals)
    (goal,) = cell.node._proxy._goals
    goal.asked_s = -math.inf  # as where the answer to a cancel is lost
    result = sent.ends(GoalStatus.STATUS_ABORTED)
    assert "did not answer within" in result.error_string
    assert "the robot may still move" in result.error_string
    assert len(cell.robot.goals) == received
    assert "the robot may still move" in cell.node.health().message
    assert cell.node._session.moves(time.monotonic())
    cell.change(Transition.TRANSITION_DEACTIVATE)
    cell.graph.spin_until(lambda: len(cell.robot.goals) > received, "a stop is sent")
    cell.graph.spin_until(lambda: not cell.robot.speed.any(), "the robot stands")


def test_a_goal_that_was_never_answered_ends_alone_where_a_later_one_is_driven(cell: Any) -> None:
    cell.begin()
    first = cell.send(HOME, MOVED, lasts_s=20.0).moves()
    (goal,) = cell.node._proxy._goals
    lost, cell.robot.path = cell.robot.path, None  # its end is never told
    second = cell.send(cell.taught(), MOVED, lasts_s=2.0, starts_s=0.5).moves()
    assert not goal.over
    goal.asked_s = -math.inf
    result = first.ends(GoalStatus.STATUS_ABORTED)
    assert "did not answer within" in result.error_string
    second.ends(GoalStatus.STATUS_SUCCEEDED)
    lost.end(Result.INVALID_GOAL, "")


def test_hostile_feedback_does_not_end_the_process(graph: Any) -> None:
    """Finding: fewer velocities than positions ended the process in mid-goal."""
    cell = Cell(graph)
    graph.start(CONTROLLER, None, None, "hostile")
    process = graph.start("joint_correction_node", SETTINGS)
    cell.begin()
    sent = cell.send(HOME, MOVED, lasts_s=2.0)
    sent.ends(GoalStatus.STATUS_SUCCEEDED)
    assert process.process.poll() is None, process.output
    assert "Traceback" not in process.output
    assert len(sent.feedback) > 10
    for feedback in sent.feedback:
        for point in (feedback.desired, feedback.actual, feedback.error):
            for values in (point.positions, point.velocities, point.effort):
                assert len(values) in (0, 6)
                assert np.all(np.isfinite(values))
    assert any(len(f.desired.positions) and not f.desired.velocities for f in sent.feedback)
    assert any(len(f.desired.velocities) for f in sent.feedback)
    assert process.stop(signal.SIGINT) == 0, process.output
    cell.client.destroy()
