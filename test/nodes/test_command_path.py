# SPDX-License-Identifier: Apache-2.0
"""Who else commands the robot that a node of the cell moves: told by the graph, over DDS."""

from typing import Any

import pytest
from control_msgs.action import FollowJointTrajectory
from rclpy.action import ActionClient
from rclpy.lifecycle import LifecycleNode
from rclpy.node import Node
from robocal_msgs.msg import AccuracyState, CorrectionStatus
from std_srvs.srv import SetBool
from tool_cell_live import LiveCell
from tool_driver import TRUTH
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.ros import endpoints
from robocal_ros.ros.graph import CommandPath

PATH = "/arm_controller/joint_trajectory"
ACTION = "/arm_controller/follow_joint_trajectory"
ACCURACY, CORRECTION = "/accuracy_state", "/joint_correction_node/status"


class Watched:
    """A node's endpoints before a controller, and its watch."""

    def __init__(self, graph: Any) -> None:
        self.graph = graph
        self.own = graph.other("tcf_node")
        self.own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
        graph.at_close.append(ActionClient(self.own, FollowJointTrajectory, ACTION).destroy)
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


@pytest.mark.parametrize(
    ("kind", "topic"), [(AccuracyState, ACCURACY), (CorrectionStatus, CORRECTION)]
)
def test_a_node_of_the_cell_may_command_the_robot_and_no_other_of_its_process(
    watched: Watched, kind: Any, topic: str
) -> None:
    """A process is composed of many nodes: the program's too."""
    watched.becomes("")
    own = watched.graph.other("another_name", LifecycleNode)
    planner = Node("planner", context=own.context)
    own.create_publisher(kind, topic, endpoints.LATCHED)
    watched.graph.spin_until(lambda: watched.own.count_publishers(topic), "it is of the cell")
    own.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    of_cell = ActionClient(own, FollowJointTrajectory, ACTION)
    watched.graph.spin_until(lambda: watched.own.count_publishers(PATH) == 2, "it is there")
    watched.graph.spin_for(0.3)
    watched.becomes("")
    publisher = planner.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    watched.becomes(f"/planner publishes {PATH}")
    planner.destroy_publisher(publisher)
    watched.becomes("")
    client = ActionClient(planner, FollowJointTrajectory, ACTION)
    watched.becomes(f"/planner is a client of {ACTION}")
    client.destroy()
    watched.becomes("")
    of_cell.destroy()
    planner.destroy_node()


def test_the_topic_beside_the_controllers_action_is_looked_at(watched: Watched) -> None:
    """Motions go by the action, so that the topic of this node was left as it is."""
    watched.watch = CommandPath(watched.own, "/tcf_node/joint_trajectory", ())
    watched.becomes("")
    watched.graph.other("planner").create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    watched.becomes(f"/planner publishes {PATH}")


def test_two_tool_nodes_of_two_hosts_arm_nothing_until_one_is_gone(
    graph: Any, tmp_path: Any
) -> None:
    """Each has a history of its own, so that no file tells of the other."""
    own = {"motion": "trajectory", "gap_stale_s": 0.0}
    cell = LiveCell(graph, tmp_path, TRUTH, **own)
    why = ""

    def armed() -> bool:
        nonlocal why
        cell.rest(0.1)
        answer = graph.call(SetBool, "/tcf_node/arm", data=True)
        why = answer.message
        return bool(answer.success)

    graph.spin_until(armed, "it is armed")
    laser = str(tmp_path / "laser.yaml")
    files = {"laser": laser, "serial": "K7", "state_dir": str(tmp_path / "other")}
    wired = {"__node": "another_name", "~/joint_trajectory": "/tcf_node/joint_trajectory"}
    second = graph.start("tcf_node", own | files, wired)
    graph.spin_until(lambda: "another_name" in cell.node.health().message, "it says so", 30.0)
    health = cell.node.health()
    assert health.level == b"\x02"
    assert health.values["motion"].startswith("disarmed")
    assert not armed()
    assert "another_name" in why
    assert second.stop() == 0
    graph.spin_until(armed, "the one that is left works")
