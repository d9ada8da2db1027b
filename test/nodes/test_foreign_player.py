# SPDX-License-Identifier: Apache-2.0
"""A recording of a cell, played by another player beside live nodes: it moves nothing."""

from pathlib import Path
from typing import Any

from control_msgs.msg import JointTrajectoryControllerState, SpeedScalingFactor
from geometry_msgs.msg import PoseStamped
from rclpy.qos import QoSProfile
from robocal_msgs.msg import (
    AccuracyState,
    CorrectionStatus,
    GapOpen,
    KinematicModel,
    MaintenanceStatus,
    MotionLease,
    ToolFrame,
    ToolStep,
)
from rosbags.highlevel import AnyReader
from sensor_msgs.msg import JointState
from std_msgs.msg import Bool, Float64, Float64MultiArray
from tool_cell_live import written_laser
from tool_driver import noisy_cell
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.bags.bag_writer import recordings
from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.mcap_files import graph_name, message_class, recorded_name
from robocal_ros.bags.recorder_node import RecorderNode
from robocal_ros.bags.replay_node import chosen_topics
from robocal_ros.cell_sim.node import CellSimNode
from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.ground.samples import RECORDED
from robocal_ros.maintenance.node import MaintenanceNode
from robocal_ros.tool.node import TcfNode

# What moves a robot, says that it may be moved, or how it is to be corrected, by the name on the
# graph.
COMMANDS = {
    "/gap_open": GapOpen,
    "/robot/gap_open": Bool,
    "/joint_trajectory": JointTrajectory,
    "/joint_trajectory_controller/joint_trajectory": JointTrajectory,
    "/maintenance_node/joint_trajectory": JointTrajectory,
    "/joint_targets": JointState,
    "/joint_correction_node/joint_targets": JointState,
    "/joint_commands": Float64MultiArray,
    "/forward/commands": Float64MultiArray,
    "/tcf_node/next_step": ToolStep,
    "/motion_lease": MotionLease,
    "/maintenance_node/status": MaintenanceStatus,
    "/accuracy_state": AccuracyState,
    "/plc/gap": Bool,
    "/servo/targets": JointState,
    "/servo/pose_target_cmds": PoseStamped,
    "/speed_scaling": Float64,
    "/arm/speed_scaling_input": SpeedScalingFactor,
    "/arm/controller_state": JointTrajectoryControllerState,
    "/kinematic_model": KinematicModel,
    "/thermal_node/candidate": KinematicModel,
    "/tool": ToolFrame,
    "/joint_correction_node/status": CorrectionStatus,
}
READINGS = {
    "/joint_states": JointState,
    "/robot/joint_states": JointState,
    "/measured_pose": PoseStamped,
    "/target_pose": PoseStamped,
}
HOME_DEG = [0.0, -90.0, 90.0, -90.0, -90.0, 0.0]


def recording(graph: Any, folder: Path) -> Path:
    """What the recorder makes of a message on each topic."""
    topics = COMMANDS | READINGS
    node = graph.add(RecorderNode, {"topics": list(topics), "folder": str(folder)})
    publishers = {name: graph.publisher(kind, name, subscribers=0) for name, kind in topics.items()}
    heard = lambda: all(one.get_subscription_count() for one in publishers.values())  # noqa: E731
    graph.spin_until(heard, "the recorder hears all")
    for name, kind in topics.items():
        publishers[name].publish(kind())
    graph.spin_until(lambda: node.health().values["messages"] == len(topics), "all is recorded")
    node.trigger_deactivate()
    for publisher in publishers.values():
        graph.probe.destroy_publisher(publisher)
    (found,) = recordings(folder)
    return found.folder


def test_what_another_player_publishes_reaches_no_node(graph: Any, tmp_path: Path) -> None:
    bag = recording(graph, tmp_path / "recordings")
    laser = written_laser(tmp_path, noisy_cell())
    graph.add(JointCorrectionNode, {"robot": "ur10"})  # one history, one robot
    graph.add(MaintenanceNode, {"home_deg": HOME_DEG})
    graph.add(TcfNode, {"motion": "trajectory", "laser": laser})
    graph.add(CellSimNode, {})
    heard = {topic for topic in COMMANDS if graph.probe.count_subscribers(topic)}
    taken = {"/gap_open", "/joint_trajectory", "/joint_targets", "/kinematic_model", "/tool"}
    assert taken <= heard  # as named on the graph
    with AnyReader([bag]) as reader:  # as a player does: each message under its recorded name
        played = {c.topic: c.msgtype for c in reader.connections}
        assert len(played) == len(COMMANDS | READINGS)
        publishers = {
            topic: graph.probe.create_publisher(message_class(msgtype), topic, QoSProfile(depth=10))
            for topic, msgtype in played.items()
        }
        for connection, _, cdr in reader.messages():
            publishers[connection.topic].publish(bytes(cdr))
    heard = {topic for topic in played if graph.probe.count_subscribers(topic)}
    assert "/joint_states" in heard
    assert heard <= READINGS.keys()
    assert {RECORDED + topic for topic in COMMANDS} == played.keys() - READINGS.keys()


def test_our_own_reader_gives_the_names_of_the_graph(graph: Any, tmp_path: Path) -> None:
    bag = recording(graph, tmp_path / "recordings")
    with BagReader(bag) as reader:
        topics = {name: found.msgtype for name, found in reader.info.topics.items()}
        assert topics.keys() == (COMMANDS | READINGS).keys()
        assert {m.topic for m in reader.messages(list(COMMANDS))} == COMMANDS.keys()
    chosen, left = chosen_topics(topics, [], [])
    assert chosen.keys() == READINGS.keys()
    assert left.keys() == COMMANDS.keys()
    # the name that it is played by counts
    renamed = ["/servo/targets:=/again/joint_states", "/robot/joint_states:=/servo/targets"]
    chosen, left = chosen_topics(topics, [], renamed)
    assert chosen["/servo/targets"] == "/again/joint_states"
    assert "/robot/joint_states" in left


def test_a_name_is_moved_once_and_back() -> None:
    once = recorded_name("/gap_open", "std_msgs/msg/Bool")
    assert (once, recorded_name(once, "std_msgs/msg/Bool")) == ("/recorded/gap_open",) * 2
    assert graph_name(once) == "/gap_open"
    for topic in ("/joint_states", "/recorded", "/recordedly/x"):
        assert recorded_name(topic, "sensor_msgs/msg/Temperature") == graph_name(topic) == topic
