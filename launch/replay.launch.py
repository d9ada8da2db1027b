# SPDX-License-Identifier: Apache-2.0
"""Plays a recording through live estimators on the clock of the recording.

ros2 launch robocal_ros replay.launch.py bag:=/data/recordings/robocal_X params:=cell.yaml

Give it a ROS_DOMAIN_ID of its own: never the graph of a live cell. What is found goes to the
history of the serial REPLAY, whatever ``params`` says. It begins when each topic of
``wait_for_subscribers`` (default: joint_states) has a subscriber; one that the bag has not is
refused. Without a graph, faster, and with a report: ``robocal validate``.
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "robocal_ros"


def in_share(*path):
    """Path of a file that the package installs."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *path])


def estimator(name):
    """Describe an estimator on the clock of the recording, with a history of its own."""
    given = [in_share("config", file) for file in (f"{name}.yaml", "replay.yaml")]
    apart = in_share("config", "replay_history.yaml")
    params = [*given, LaunchConfiguration("params"), apart, {"use_sim_time": True}]
    return Node(package=PACKAGE, executable=name, name=name, parameters=params, output="screen")


def generate_launch_description():
    """Describe the nodes."""
    player = Node(
        package=PACKAGE,
        executable="replay_node",
        name="replay_node",
        parameters=[
            {
                "bag": LaunchConfiguration("bag"),
                "wait_for_subscribers": LaunchConfiguration("wait_for_subscribers"),
            }
        ],
        output="screen",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag", description="Folder or file of the recording"),
            DeclareLaunchArgument(
                "params",
                default_value=in_share("config", "cell.yaml"),
                description="Parameter file of the cell",
            ),
            DeclareLaunchArgument(
                "wait_for_subscribers",
                default_value="[joint_states]",
                description="It begins when each of these topics has a subscriber",
            ),
            estimator("thermal_node"),
            estimator("tcf_node"),
            player,
        ]
    )
