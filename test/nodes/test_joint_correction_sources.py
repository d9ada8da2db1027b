# SPDX-License-Identifier: Apache-2.0
"""Who commands: several publishers at once, and publishers that vanish, over DDS."""

import time
from array import array
from typing import Any

import numpy as np
from conftest import DISCOVERY_S
from joint_correction_live import HOME, NAMES, NODE, NOMINAL, Line, joints, trajectory
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.node import Node
from robocal_msgs.msg import CorrectionStatus, MotionLease
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.interface import Reason
from robocal_ros.correction.node import ONE_SOURCE_S
from robocal_ros.correction.trajectories import AHEAD_S
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.endpoints import WARN

# A stream is a stream although other work on the machine may hold its messages up.
SLOW = {"stream_gap_s": 2.0}


def two_on(line: Line, topic: str) -> None:
    publishers = line.node._senders[topic].inputs[topic].get_publisher_count
    line.graph.spin_until(lambda: publishers() == 2, "two publishers")


def test_a_stream_of_two_publishers_is_refused_until_one_is_left(graph: Any) -> None:
    line = Line(graph, **SLOW)
    line.target()
    other = Node("teleop", context=graph.context)
    also = other.create_publisher(JointState, "joint_targets", endpoints.RELIABLE)
    two_on(line, "joint_targets")
    for publisher in (line.to_target, also, line.to_target):
        line.refused(publisher, joints(HOME + 0.1), "joint_targets")
    assert len(line.targets) == 1
    assert "2 publishers" in line.report(WARN, "joint_targets has 2").message
    graph.spin_until(lambda: sum(line.statuses[-1].refused) >= 3, "three are counted")
    told = line.told(commanders="joint_targets has 2 publishers: stop all but one")
    assert list(told.refused_reasons) == ["two publishers at once"]
    other.destroy_node()

    def alone() -> bool:
        line.stand()
        line.to_target.publish(joints(HOME))
        graph.spin_for(0.02)
        return len(line.targets) > 1

    graph.spin_until(alone, "the one that is left is heard")
    line.told(commanders="")


def test_the_first_command_of_a_second_publisher_is_refused(graph: Any) -> None:
    """Also in the events executor, which hears it before it is told who publishes it."""
    line = Line(graph, **SLOW)
    line.target()
    graph.executor.remove_node(line.node)
    executor = EventsExecutor(context=graph.context)
    executor.add_node(line.node)
    other = Node("teleop", context=graph.context)
    also = other.create_publisher(JointState, "joint_targets", endpoints.RELIABLE)
    until_s = time.monotonic() + DISCOVERY_S
    while not also.get_subscription_count() and time.monotonic() < until_s:
        line.to_target.publish(joints(HOME))
        executor.spin_once(timeout_sec=0.01)
    also.publish(joints(HOME + 1e-6))
    heard = line.node.inputs["joint_targets"]
    count = heard.received
    while heard.received == count and time.monotonic() < until_s:
        executor.spin_once(timeout_sec=0.01)
    assert heard.received > count
    assert line.node._session.status().refused[Reason.TWO_SOURCES] > 0
    assert line.node._session.output.taught[0] == HOME[0]
    executor.remove_node(line.node)
    graph.executor.add_node(line.node)
    other.destroy_node()


def test_two_streams_at_once_are_refused(graph: Any) -> None:
    line = Line(graph, **SLOW)
    line.target()
    for data in (HOME, HOME):
        line.refused(line.to_array, line.to_array.msg_type(data=data.tolist()), "joint_commands")
    line.refused(line.to_target, joints(HOME), "joint_targets")
    words = "commands come on joint_commands and joint_targets at once: stop one of them"
    line.told(commanders=words)
    assert not line.arrays


def test_planners_that_wait_do_not_hold_up_another(graph: Any) -> None:
    line = Line(graph, stream_gap_s=0.5)  # what is at once, on a machine with other work
    idle = graph.probe.create_publisher(JointTrajectory, "joint_trajectory", endpoints.RELIABLE)
    two_on(line, "joint_trajectory")
    path = trajectory(np.stack([HOME, HOME]), np.array([0.5, 1.0]))
    line.rest()
    line.to_path.publish(path)
    # at once with it: refused, whoever sent it
    line.refused(idle, path, "joint_trajectory")
    line.wait(line.paths)
    graph.spin_until(lambda: not line.node._rivals(), "a while later")
    line.rest()
    idle.publish(path)
    assert len(line.wait(line.paths, 2).points) == 2


def test_a_stop_counts_beside_other_publishers(graph: Any) -> None:
    """Of a supervisor, at once with the trajectory of a planner."""
    line = Line(graph, stream_gap_s=5.0)  # what is at once, on a machine with other work
    supervisor = graph.probe.create_publisher(
        JointTrajectory, "joint_trajectory", endpoints.RELIABLE
    )
    two_on(line, "joint_trajectory")
    line.rest()
    way = trajectory(np.stack([HOME, HOME + 0.9 * np.eye(6)[0]]), np.array([0.1, 9.0]))
    line.to_path.publish(way)
    line.wait(line.paths)
    path, robot = line.node._session.output.path, line.node._session.output.robot

    def is_on_its_way() -> bool:
        line.to_states.publish(joints(path.place(time.monotonic())))
        graph.spin_for(0.02)
        return bool(robot.measured[0] > HOME[0] + 0.05)

    graph.spin_until(is_on_its_way, "it is seen on its way")
    supervisor.publish(JointTrajectory(joint_names=NAMES))
    stop = line.wait(line.paths, 2)
    assert stop.points[-1].positions[0] < HOME[0] + 0.5
    assert Reason.TWO_SOURCES not in line.node._session.status().refused


def test_a_stream_whose_publisher_vanishes_is_told(graph: Any) -> None:
    line = Line(graph)
    line.target()
    graph.probe.destroy_publisher(line.to_target)
    line.told(commanders="nobody publishes joint_targets any more")
    assert "nobody publishes joint_targets" in line.report(WARN, "nobody").message
    line.to_target = graph.publisher(JointState, "joint_targets")
    line.statuses.clear()
    line.target()
    told: CorrectionStatus = line.told(commanders="")
    assert list(told.refused) == []


def test_a_stop_while_readings_come_late_lies_ahead_on_the_way(graph: Any) -> None:
    """Finding: the robot was taken to be where it had been, and was thrown back there."""
    line = Line(graph, joint_state_age_s=0.2)

    def reads(q: Any, late_s: float) -> None:
        stamp = conversions.header(line.node.now_ns() - round(late_s * 1e9), "")
        line.to_states.publish(joints(q, header=stamp))
        graph.spin_for(0.02)

    for _ in range(20):
        reads(HOME, 0.0)
    way = trajectory(np.stack([HOME, HOME + 0.9 * np.eye(6)[0]]), np.array([0.1, 5.0]))
    line.to_path.publish(way)
    line.wait(line.paths)
    path, late_s = line.node._session.output.path, 0.4
    graph.spin_for(late_s + 0.02)  # it falls behind
    until_s = time.monotonic() + 2.0
    while time.monotonic() < until_s:
        reads(path.place(time.monotonic() - late_s), late_s)
    stopped_s = time.monotonic()
    line.to_path.publish(JointTrajectory(joint_names=NAMES))
    stop = line.wait(line.paths, 2)
    assert stop.points[0].positions[0] > path.place(stopped_s + AHEAD_S)[0]
    assert "joint states come up to" in line.report(WARN, "ms late").message


def test_a_stranger_and_then_a_lease_are_both_told(graph: Any) -> None:
    line = Line(graph)
    stranger = line.graph.probe.create_publisher(
        JointTrajectory, f"{NODE}/joint_trajectory", endpoints.RELIABLE
    )
    line.told(state=CorrectionStatus.OTHER_COMMANDER)
    graph.probe.destroy_publisher(stranger)
    line.statuses.clear()
    line.told(state=CorrectionStatus.OFF)
    lease = graph.probe.create_publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    lease.publish(
        MotionLease(robot=NOMINAL.name, serial="s1", holder="/h", held=True, purpose="tool")
    )
    line.told(state=CorrectionStatus.LEASED)


def test_that_one_holder_lets_go_is_heard_beside_what_another_says(graph: Any) -> None:
    """Finding: what waited for a busy node was overwritten, and the program refused."""
    line = Line(graph)
    by = {
        holder: graph.probe.create_publisher(MotionLease, "motion_lease", endpoints.LATCHED)
        for holder in ("/tool", "/maintenance")
    }

    def says(holder: str, held: bool) -> None:
        lease = MotionLease(robot=NOMINAL.name, serial="s1", holder=holder, held=held, purpose="x")
        by[holder].publish(lease)

    for holder in by:
        says(holder, True)
    line.told(state=CorrectionStatus.LEASED)
    graph.spin_until(lambda: all(f"{h}: x" in line.statuses[-1].lease for h in by), "both hold one")
    says("/tool", False)
    says("/maintenance", True)
    time.sleep(0.1)  # both wait for the node
    graph.spin_until(lambda: "/tool: x" not in line.statuses[-1].lease, "it has let go")
    assert "/tool" not in line.statuses[-1].lease  # not lost either


def test_a_stream_that_is_being_ended_ends_on_its_own_topic(graph: Any) -> None:
    line = Line(graph)
    line.rest()
    line.node._session.stream._slowdown[:] = 0.005  # as of a heavy robot: it takes 5 s
    q, taken = HOME.copy(), line.node.inputs["joint_commands"]
    for k in range(20):
        q[0] += 1e-4 * k
        line.take(Float64MultiArray(data=array("d", q)), line.to_array, "joint_commands")
        line.wait(line.arrays, taken.received)
        line.at = line.arrays[-1].data
        line.stand()
        graph.spin_for(0.08)  # a period, twice which the slow-down may be held up
    line.refused(line.to_array, Float64MultiArray(data=array("d", 6 * [np.nan])), "joint_commands")
    graph.spin_for(ONE_SOURCE_S + 0.1)
    line.arrays.clear()
    line.refused(line.to_target, joints(q), "joint_targets")
    graph.spin_until(lambda: len(line.arrays) > 1, "what slows it down")
    assert not line.targets
