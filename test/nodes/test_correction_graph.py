# SPDX-License-Identifier: Apache-2.0
"""Who else commands the robot: told by the graph, over DDS."""

import time
from pathlib import Path
from typing import Any

import pytest
from control_msgs.action import FollowJointTrajectory
from control_msgs.msg import JointTrajectoryControllerState
from rclpy.action import ActionClient
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from robocal_msgs.msg import AccuracyState, CorrectionStatus, MotionLease
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.graph import GraphWatch, JointSources, Leases
from robocal_ros.correction.interface import Reason
from robocal_ros.ros import endpoints
from robocal_ros.ros.graph import CommandPath, own_endpoint

PATH = "/arm_controller/joint_trajectory"
ACTION = "/arm_controller/follow_joint_trajectory"
ACCURACY, CORRECTION = "/accuracy_state", "/joint_correction_node/status"
STATED = "/arm_controller/controller_state"
NAMES = [f"joint_a{i}" for i in range(1, 7)]


class Commander:
    """A node's endpoints before a controller."""

    def __init__(self, graph: Any, name: str) -> None:
        self.graph, self.process, self.own = graph, graph.other, graph.other(name)
        self.own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
        graph.at_close.append(ActionClient(self.own, FollowJointTrajectory, ACTION).destroy)


class Watched(Commander):
    """The correction node, and its watch on who else is there."""

    def __init__(self, graph: Any) -> None:
        super().__init__(graph, "joint_correction_node")
        self.leases = Leases("kr150", "s1")
        self.sources = JointSources(self.own, "/joint_states", NAMES)
        self.watch = GraphWatch(
            self.own, {PATH: 1}, {ACTION: 1}, self.sources, self.leases, "/motion_lease", STATED
        )
        graph.at_close.append(self.sources.close)

    def becomes(self, reason: Reason | None, words: str = "") -> None:
        """Wait until the watch says so."""
        found: list[Any] = []

        def look() -> bool:
            found[:] = [self.watch.look(time.monotonic())]
            if reason is None or found[0] is None:
                return found[0] is reason
            return found[0].reason is reason and words in found[0].detail

        self.graph.spin_until(look, f"{reason} {words}, not {found}", 10.0)


class Mover(Commander):
    """A node that moves the robot for the cell, and its watch."""

    def __init__(self, graph: Any) -> None:
        super().__init__(graph, "tcf_node")
        self.watch = CommandPath(self.own, PATH, (ACCURACY, CORRECTION))

    def becomes(self, words: str) -> None:
        """Wait until it says so; empty: until nothing is wrong."""
        self.graph.spin_until(
            lambda: words in self.watch.look(ACTION) and bool(words) == bool(self.watch.violation),
            f"'{words}', not '{self.watch.violation}'",
        )


@pytest.fixture
def watched(graph: Any) -> Watched:
    return Watched(graph)


@pytest.fixture
def mover(graph: Any) -> Mover:
    return Mover(graph)


def test_endpoints_of_a_process_share_a_participant(watched: Watched) -> None:
    same = Node("another", context=watched.own.context)
    assert own_endpoint(watched.own).participant == own_endpoint(same).participant
    assert own_endpoint(watched.process("another")).participant != own_endpoint(same).participant
    same.destroy_node()


@pytest.mark.parametrize("name", ["joint_correction_node", "another_name"])
def test_a_second_correction_node_under_the_same_or_another_name(
    watched: Watched, name: str
) -> None:
    watched.becomes(None)
    other = watched.process(name)
    publisher = other.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    second = "a second /joint_correction_node" if name == "joint_correction_node" else f"/{name}"
    watched.becomes(Reason.OTHER_COMMANDER, f"{second} publishes {PATH}")
    other.destroy_publisher(publisher)
    watched.becomes(None)
    client = ActionClient(other, FollowJointTrajectory, ACTION)
    watched.becomes(Reason.OTHER_COMMANDER, f"{second} is a client of {ACTION}")
    client.destroy()
    watched.becomes(None)
    watched.own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    watched.becomes(Reason.OTHER_COMMANDER, "a second /joint_correction_node in this process")


def test_the_cell_s_own_nodes_are_known_by_their_lease(watched: Watched) -> None:
    own = watched.process("some_name", LifecycleNode)
    own.create_publisher(MotionLease, "/motion_lease", endpoints.LATCHED)
    own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    inbox = watched.graph.collect(MotionLease, "/motion_lease", endpoints.LATCHED)
    watched.graph.spin_until(lambda: watched.own.count_publishers(PATH) == 2, "both")
    watched.becomes(None)
    lease = MotionLease(robot="kr150", serial="s1", holder="/some_name", held=True, purpose="tool")
    now = time.monotonic()
    watched.leases.hear(lease, now)
    assert watched.watch.look(now) == (Reason.LEASED, "/some_name: tool")
    assert watched.watch.lease == "/some_name: tool"
    assert watched.watch.look(now + 0.99) is not None
    lease.held = False
    watched.leases.hear(lease, now + 1.1)
    assert watched.watch.look(now + 1.1) is None
    assert not inbox


def test_a_player_of_a_bag_is_a_stranger_also_where_it_plays_leases(watched: Watched) -> None:
    """Finding: who published leases, as a recording of everything does, commanded unseen."""
    player = watched.process("rosbag2_player")
    player.create_publisher(MotionLease, "/motion_lease", endpoints.LATCHED)
    player.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    watched.becomes(Reason.OTHER_COMMANDER, f"/rosbag2_player publishes {PATH}")


def test_a_client_of_the_action_beside_the_topic_is_a_stranger(watched: Watched) -> None:
    """Finding: who moves by topic did not see a planner that moves by the controller's action."""
    other, planner = watched.process("tcf_node"), watched.process("planner")
    topic, action = "/robot/joint_trajectory", "/robot/follow_joint_trajectory"
    other.create_publisher(JointTrajectory, topic, endpoints.RELIABLE)
    path = CommandPath(other, topic, ())
    assert not path.look("")
    client = ActionClient(planner, FollowJointTrajectory, action)
    words = f"/planner is a client of {action}"
    watched.graph.spin_until(lambda: words in path.look(""), words)
    client.destroy()


def test_the_robots_controller_alone_says_where_it_is(watched: Watched) -> None:
    one, other = watched.process("controller_manager"), watched.process("next_robot")
    one.create_publisher(JointTrajectoryControllerState, STATED, endpoints.RELIABLE)
    watched.graph.spin_until(lambda: watched.own.count_publishers(STATED) == 1, "the controller")
    watched.becomes(None)
    other.create_publisher(JointTrajectoryControllerState, STATED, endpoints.RELIABLE)
    words = f"{STATED} has several publishers: /controller_manager, /next_robot"
    watched.becomes(Reason.OTHER_COMMANDER, words)


def test_a_lease_that_ends_by_silence_lasts_until_the_robot_stands() -> None:
    """Finding: the node was killed, its motion was still driven, and the program began."""
    leases = Leases("kr150", "s1")
    lease = MotionLease(robot="kr150", serial="s1", holder="/some_name", held=True, purpose="tool")
    leases.hear(lease, 100.0)
    for now_s, stood_s in ((101.1, 0.0), (101.9, 50.0), (104.0, 0.9), (200.0, 0.0)):
        leases.look(now_s, stood_s)
        assert "/some_name: tool: it has not renewed its lease for 1 s" in leases.words(now_s)
        assert leases.lost(now_s)
    leases.look(201.0, 1.0)
    assert not leases.words(201.0)
    assert not leases.lost(201.0)
    leases.hear(lease, 300.0)  # it was started again
    assert leases.words(300.5) == "/some_name: tool"
    lease.held = False
    leases.hear(lease, 303.0)
    leases.look(303.0, 0.0)
    assert not leases.words(303.0)


def test_who_leases_another_robot_is_a_stranger_here(watched: Watched) -> None:
    other = watched.process("next_cell", LifecycleNode)
    other.create_publisher(MotionLease, "/motion_lease", endpoints.LATCHED)
    other.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    lease = MotionLease(robot="kr150", serial="s2", holder="/next_cell", held=True)
    watched.leases.hear(lease, time.monotonic())
    watched.becomes(Reason.OTHER_COMMANDER, f"/next_cell publishes {PATH}")
    assert not watched.watch.lease


def test_two_publishers_of_the_arms_joints_and_one_of_a_gripper(watched: Watched) -> None:
    driver, gripper = watched.process("driver"), watched.process("gripper")
    arm = driver.create_publisher(JointState, "/joint_states", endpoints.RELIABLE)
    hand = gripper.create_publisher(JointState, "/joint_states", endpoints.RELIABLE)
    message = JointState(name=NAMES, position=[0.0] * 6, velocity=[float("nan")] * 6)

    def publish(*which: tuple[Any, list[str]]) -> None:
        for publisher, names in which:
            publisher.publish(JointState(name=names, position=[0.0] * len(names)))

    def look(count: int = 20) -> Any:
        found = None
        for _ in range(count):
            arm.publish(message)
            publish((hand, ["finger"]), (hand, ["finger"]))
            watched.graph.spin_for(0.01)
            found = watched.watch.look(time.monotonic()) or found
        return found

    watched.graph.spin_until(lambda: watched.own.count_publishers("/joint_states") == 2, "both")
    read: list[Any] = []
    watched.graph.spin_until(
        lambda: look(1) or arm.get_subscription_count() == hand.get_subscription_count() == 1, "it"
    )
    assert look() is None
    assert watched.watch._sources._last["joint_a1"] > 5  # the arm's were read
    for _ in range(20):
        arm.publish(message)
        publish((hand, [*NAMES[3:], "finger"]))
        watched.graph.spin_for(0.01)
        read.append(watched.watch.look(time.monotonic()))
    assert read[-1].reason is Reason.OTHER_COMMANDER
    assert "joint_a4, joint_a5, joint_a6 by two of /driver, /gripper" in read[-1].detail
    gripper.destroy_publisher(hand)
    watched.becomes(None)


def test_a_driver_that_was_restarted_is_one_driver(watched: Watched) -> None:
    """Its predecessor was killed and is still on the graph: its numbers begin anew once."""
    old, new = watched.process("driver"), watched.process("driver")
    before = old.create_publisher(JointState, "/joint_states", endpoints.RELIABLE)
    after = new.create_publisher(JointState, "/joint_states", endpoints.RELIABLE)
    message = JointState(name=NAMES, position=[0.0] * 6)
    watched.graph.spin_until(lambda: watched.own.count_publishers("/joint_states") == 2, "both")
    watched.watch.look(time.monotonic())
    watched.graph.spin_until(
        lambda: before.get_subscription_count() and after.get_subscription_count(), "the reader"
    )
    last = watched.watch._sources._last
    for publisher in (before, after):
        for _ in range(10):
            publisher.publish(message)
            watched.graph.spin_for(0.01)
            assert watched.watch.look(time.monotonic()) is None
    assert last["joint_a1"] == 10


def test_a_killed_predecessor_is_told_until_it_is_gone(graph: Any, tmp_path: Path) -> None:
    script = tmp_path / "predecessor.py"
    script.write_text(
        "import rclpy\nfrom trajectory_msgs.msg import JointTrajectory\nrclpy.init()\n"
        "node = rclpy.create_node('joint_correction_node')\n"
        f"node.create_publisher(JointTrajectory, '{PATH}', 10)\nrclpy.spin(node)\n"
    )
    process = graph.start(script, mortal=True)
    watched = Watched(graph)
    watched.becomes(Reason.OTHER_COMMANDER, "a second /joint_correction_node")
    process.kill()
    violation = watched.watch.look(time.monotonic())
    assert violation is not None
    assert "one that was killed counts until DDS gives it up" in violation.detail
    watched.becomes(None)


@pytest.mark.parametrize(
    ("kind", "topic"), [(AccuracyState, ACCURACY), (CorrectionStatus, CORRECTION)]
)
def test_a_node_of_the_cell_may_command_the_robot_and_no_other_of_its_process(
    mover: Mover, kind: Any, topic: str
) -> None:
    """A process is composed of many nodes: the program's too."""
    mover.becomes("")
    own = mover.graph.other("another_name", LifecycleNode)
    planner = Node("planner", context=own.context)
    own.create_publisher(kind, topic, endpoints.LATCHED)
    mover.graph.spin_until(lambda: mover.own.count_publishers(topic), "it is of the cell")
    own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    of_cell = ActionClient(own, FollowJointTrajectory, ACTION)
    mover.graph.spin_until(lambda: mover.own.count_publishers(PATH) == 2, "it is there")
    mover.graph.spin_for(0.3)
    mover.becomes("")
    publisher = planner.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    mover.becomes(f"/planner publishes {PATH}")
    planner.destroy_publisher(publisher)
    mover.becomes("")
    client = ActionClient(planner, FollowJointTrajectory, ACTION)
    mover.becomes(f"/planner is a client of {ACTION}")
    client.destroy()
    mover.becomes("")
    of_cell.destroy()
    planner.destroy_node()


def test_the_topic_beside_the_controllers_action_is_looked_at(mover: Mover) -> None:
    """Motions go by the action, so that the topic of this node was left as it is."""
    mover.watch = CommandPath(mover.own, "/tcf_node/joint_trajectory", ())
    mover.becomes("")
    mover.graph.other("planner").create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    mover.becomes(f"/planner publishes {PATH}")
