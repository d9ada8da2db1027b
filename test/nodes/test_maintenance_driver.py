# SPDX-License-Identifier: Apache-2.0
"""What the maintenance session asks is carried out in the right order, by a clock that is right."""

import math
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pytest
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionServer, GoalResponse
from robocal_msgs.msg import MotionLease
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool
from trajectory_controllers import HOME as Q_UR10
from trajectory_controllers import accepted_goals
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.node import MaintenanceDriver
from robocal_ros.maintenance.robot_interface import MOST_ASKED, Disarm, Move
from robocal_ros.motion.cell import DrivingConfig, Housing
from robocal_ros.motion.driver import COPIES, COPY_S, LeaseHolder, MotionDriver
from robocal_ros.motion.plan import JointPlan, MotionLimits, stop
from robocal_ros.motion.robot_watch import MotionReport, RobotWatch
from robocal_ros.motion.stopping import SteadyClock
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.graph import actions_beside

ARM = load_robot("kr150_r3100")
ACTION = "/controller/follow_joint_trajectory"
DRIVING = DrivingConfig(Housing(0.06, 0.03, -0.12, 0.05), 0.1, 0.008, 0.05, limits=MotionLimits())
PREEMPTED_S = 0.01  # between the reads of its two clocks, at most in one of a thousand


def driving(
    graph: Any,
    names: Sequence[str],
    action: str = "",
    tolerances: Mapping[str, Any] | None = None,
    reported: Callable[[MotionReport], Any] = id,
    robot: RobotWatch | None = None,
    now: Callable[[], float] = time.monotonic,
) -> tuple[EndpointNode, MotionDriver]:
    """An active node and its driver, which end with the test."""
    node = EndpointNode("driver", context=graph.context, use_global_arguments=False)
    graph.executor.add_node(node)
    motion = MotionDriver(node, names, action, "", tolerances or {}, reported, lambda: robot, now)
    node.trigger_configure()
    node.trigger_activate()
    graph.at_close += [motion.close, lambda: graph.executor.remove_node(node), node.destroy_node]
    return node, motion


def test_the_clock_of_a_motion_is_read_before_it_goes_out(graph: Any) -> None:
    """However long that takes: a robot ahead of its plan would be off it."""
    inbox = graph.collect(JointTrajectory, "/driver/joint_trajectory")
    out_by_then: list[int] = []

    def moves() -> None:
        graph.spin_for(0.3)
        out_by_then.append(len(inbox))

    node = EndpointNode("driver", context=graph.context, use_global_arguments=False)
    motion = MotionDriver(
        node, ("a",), "", "", {}, lambda report: None, lambda: None, time.monotonic
    )
    driver = MaintenanceDriver(node, motion, lambda number, answer: None, moves)
    node.trigger_configure()
    node.trigger_activate()
    graph.spin_until(lambda: motion.topic.get_subscription_count() > 0, "the probe listens")
    rest = np.zeros((2, 1))
    driver.carry_out(Move(1, JointPlan(np.array([0.0, 1.0]), rest, rest, rest), 1.0))
    assert out_by_then == [0]
    graph.spin_until(lambda: len(inbox) == 1, "the motion goes out")
    driver.close()
    node.destroy_node()


def test_what_a_node_that_hangs_never_answers_does_not_pile_up(graph: Any) -> None:
    node, motion = driving(graph, ("a",))
    driver = MaintenanceDriver(node, motion, lambda number, answer: None, lambda: None)
    graph.at_close.insert(0, driver._measure.destroy)
    hangs = graph.other("tcf_node")  # nothing spins it
    hangs.create_service(SetBool, "tcf_node/arm", lambda request, response: response)
    graph.spin_until(driver._arm.service_is_ready, "its service")
    for number in range(1, 3 * MOST_ASKED):
        driver.carry_out(Disarm(number))
    assert len(driver._arm._pending_requests) == MOST_ASKED


def test_each_motion_goes_by_the_action_that_is_there_when_it_begins(graph: Any) -> None:
    """And its stop as it went, whatever has come since."""
    path = "/driver/joint_trajectory"
    node, motion = driving(graph, load_robot("ur10").joint_names)
    inbox, goals = graph.collect(JointTrajectory, path), accepted_goals(graph, ACTION)
    graph.spin_until(lambda: motion.topic.get_subscription_count() > 0, "the probe listens")
    rest = np.zeros((2, 6))
    plan = JointPlan(np.array([0.0, 1.0]), rest + Q_UR10, rest, rest)

    def sent(stop: bool) -> str:
        """Where it came: a stop that is answered late is sent again."""
        inbox.clear()
        goals.clear()
        motion.send(plan, stop=stop)
        graph.spin_until(lambda: inbox or goals, "it comes")
        graph.spin_for(0.1)
        assert not (inbox and goals)
        return "topic" if inbox else "action"

    assert sent(stop=False) == "topic"
    assert motion.way == f"the topic {path}; no rejection is seen"
    wired = {"__node": "controller", "joint_trajectory": path}
    controller = graph.start("cell_sim_node", {"rate_hz": 50.0}, wired)
    graph.spin_until(lambda: actions_beside(node, path) == [ACTION], "the controller", 30.0)
    assert sent(stop=True) == "topic"
    assert sent(stop=False) == "action"
    assert motion.way == f"the action {ACTION}"
    assert sent(stop=True) == "action"
    others = [graph.other(name) for name in ("one", "two")]
    for other in others:
        other.create_subscription(JointTrajectory, path, inbox.append, 1)
    graph.spin_until(lambda: motion.topic.get_subscription_count() == 4, "they listen")
    assert sent(stop=False) == "action"  # a recorder serves nothing
    for other in others:
        ActionServer(other, FollowJointTrajectory, "~/follow", inbox.append)
    graph.spin_until(lambda: len(actions_beside(node, path)) == 3, "they serve")
    assert sent(stop=False) == "topic"
    for other in others:
        graph.end(other)
    assert controller.stop() == 0
    graph.spin_until(lambda: not actions_beside(node, path), "the controller is gone")
    assert sent(stop=False) == "topic"


def test_a_stop_is_not_sent_again_too_late_and_a_copy_that_is_rejected_is_no_fault(
    graph: Any,
) -> None:
    """Finding: 0.2 s late it began at time 0 at its end; one that was lost stepped back there."""
    held_up_s, asked, reports = [0.0], [], []
    now = lambda: time.monotonic() + held_up_s[0]  # noqa: E731
    names = load_robot("ur10").joint_names
    _, motion = driving(graph, names, ACTION, reported=reports.append, now=now)

    def taken(goal: Any) -> GoalResponse:
        asked.append(goal.trajectory)
        return GoalResponse.REJECT if len(asked) > 1 else GoalResponse.ACCEPT

    def ends(goal: Any) -> Any:
        goal.succeed()
        return FollowJointTrajectory.Result()

    ActionServer(graph.probe, FollowJointTrajectory, ACTION, ends, goal_callback=taken)
    rest = np.zeros((2, 6))
    plan = JointPlan(np.array([0.0, 0.12]), rest + Q_UR10, rest, rest)
    graph.spin_until(lambda: motion._client.server_is_ready(), "the controller")
    motion.send(plan, stop=True)
    held_up_s[0] = 0.2
    time.sleep(2.0 * COPY_S)
    graph.spin_until(lambda: asked, "the stop")
    graph.spin_for(0.1)
    assert len(asked) == 1
    asked.clear()
    motion.send(plan, stop=True)
    motion._repeat()
    graph.spin_until(lambda: len(asked) > 1, "the stop and its copy")
    graph.spin_for(0.1)
    assert not any(report.failed for report in reports)


def test_a_stop_that_is_sent_on_the_topic_again_and_again_is_not_stamped(graph: Any) -> None:
    """Finding: a controller whose states are stamped by another clock took none of them."""
    names = load_robot("ur10").joint_names
    _, motion = driving(graph, names)
    inbox = graph.collect(JointTrajectory, "/driver/joint_trajectory")
    told = graph.publisher(JointTrajectoryControllerState, "controller_state")
    graph.spin_until(lambda: motion.topic.get_subscription_count() > 0, "the probe listens")
    speed, begin_s = 0.1 * np.eye(6)[0], time.monotonic()

    def tell() -> Any:
        """Where it is, by a clock of its own; its reference, where that is known."""
        at_s = time.monotonic() - begin_s
        point = JointTrajectoryPoint(
            positions=(Q_UR10 + at_s * speed).tolist(), velocities=speed.tolist()
        )
        state = JointTrajectoryControllerState(
            joint_names=names, speed_scaling_factor=1.0, feedback=point, reference=point
        )
        state.header.stamp.sec, state.header.stamp.nanosec = 3600 + int(at_s), int(at_s % 1 * 1e9)
        told.publish(state)
        graph.spin_for(0.01)
        return motion._controller.reference(names, time.monotonic())

    def sent(*, stops: bool) -> int:
        """Seconds of the stamp of a stop from there, sent as one or as a motion."""
        graph.spin_for(COPIES * COPY_S + 0.02)  # copies of the one before have come
        found: list[Any] = []
        graph.spin_until(lambda: found.append(tell()) or found[-1], "its reference is known")
        inbox.clear()
        motion.send(stop(ARM, MotionLimits(), *found[-1][:2]), stop=stops)
        graph.spin_until(lambda: inbox, "it")
        return int(inbox[0].header.stamp.sec)

    for _ in range(10):  # a state that a busy computer had wait is not gone by
        sent(stops=False)
        stamps = [sent(stops=True) for _ in range(4)]
        assert stamps[2:] == [0, 0]
        if stamps[0]:
            break
    assert stamps[0] == pytest.approx(3600, abs=60)


def test_velocities_of_other_joints_say_nothing_of_the_hardware(graph: Any) -> None:
    """A stop with velocities makes hardware that has none stand for a moment, and goes on."""
    names = load_robot("ur10").joint_names
    _, motion = driving(graph, names)
    plan = stop(load_robot("ur10"), MotionLimits(), Q_UR10, np.full(6, 0.1))

    def told(others: Sequence[str], velocity: Sequence[float], arm: Sequence[str] = names) -> bool:
        state = JointState(name=[*others, *arm], velocity=velocity)
        motion.hear(state)
        return bool(motion._controller.stop_message(plan, names, 0.0).points[0].velocities)

    nothing = [math.nan] * 6
    assert not told([], nothing)
    assert not told(["spindle"], [300.0], ())  # of another driver
    assert not told(["spindle"], [300.0, *nothing])
    assert told(["gripper"], [math.nan, *[0.1] * 6])
    assert told([], [0.1] * 6)
    assert not told([], [0.1] * 5)
    assert not told(["spindle"], [0.1] * 6)  # whose they are nobody knows


def test_a_controller_that_never_fills_its_scaling_is_not_paused(graph: Any) -> None:
    """Finding: its 0 was believed, and the motion waited for ever; so was a 5."""
    robot, names = RobotWatch(ARM, DRIVING), ARM.joint_names
    driving(graph, names, robot=robot)
    told = graph.publisher(JointTrajectoryControllerState, "controller_state")
    slider = graph.publisher(Float64, "speed_scaling")
    rest = JointTrajectoryPoint(positions=[0.0] * 6, velocities=[0.0] * 6)

    def tell(factor: float, percent: float) -> None:
        state = JointTrajectoryControllerState(
            joint_names=names, speed_scaling_factor=factor, feedback=rest, reference=rest
        )
        told.publish(state)
        slider.publish(Float64(data=percent))

    def becomes(scaling: float, *said: float) -> None:
        def look() -> bool:
            tell(*said)
            graph.spin_for(0.02)
            return bool(robot.scaling_known(time.monotonic()) and robot.scaling == scaling)

        graph.spin_until(look, f"{said} makes {scaling}, not {robot.scaling}")

    tell(0.0, 0.0)
    graph.spin_for(0.3)
    assert robot.scaling == 1.0
    becomes(0.5, 0.0, 50.0)
    becomes(1.0, 5.0, 50.0)
    becomes(0.0, 0.0, 50.0)


def test_a_suspend_is_told_once_and_counts(monkeypatch: pytest.MonkeyPatch) -> None:
    """The host's, to the clock of whoever moves the robot."""
    told: list[float] = []
    clock = SteadyClock(told.append)
    before_s = [clock.now_s() for _ in range(1000)][-1]
    assert sum(told) < PREEMPTED_S
    told.clear()
    read = time.clock_gettime

    def woken(which: int) -> float:
        return read(which) + 3600.0 * (which == time.CLOCK_BOOTTIME)

    monkeypatch.setattr(time, "clock_gettime", woken)
    assert clock.now_s() - before_s >= 3600.0
    assert len(told) == 1
    assert abs(told[0] - 3600.0) < PREEMPTED_S
    for _ in range(1000):
        clock.now_s()
    assert abs(sum(told) - 3600.0) < PREEMPTED_S


def test_a_lease_that_lapsed_is_not_let_go_by_who_begins_anew(graph: Any) -> None:
    """Finding: a node that was deactivated before its robot stood, and activated again, did so."""
    node = EndpointNode("holder", context=graph.context, use_global_arguments=False)
    lease, told = LeaseHolder(node, "robot", "serial"), graph.collect(MotionLease, "motion_lease")
    graph.at_close.append(node.destroy_node)
    node.trigger_configure()
    node.trigger_activate()
    graph.spin_until(lambda: node.count_subscribers("/motion_lease") > 0, "the probe listens")
    lease.hold("a stop")
    lease.lapse()
    lease.hold("")
    lease.hold("another motion")
    graph.spin_until(lambda: len(told) == 2, "both are told")
    assert [one.held for one in told] == [True, True]
