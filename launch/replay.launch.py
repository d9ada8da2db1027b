"""Plays a recording through live estimators on the clock of the recording.

ros2 launch robocal_ros replay.launch.py bag:=/data/recordings/robocal_X params:=cell.yaml

Without a graph, faster, and with a report: ``robocal validate``.
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


def estimator(name, *files):
    """Describe an estimator on the clock of the recording."""
    given = [in_share("config", file) for file in files]
    params = [*given, LaunchConfiguration("params"), {"use_sim_time": True}]
    return Node(package=PACKAGE, executable=name, name=name, parameters=params, output="screen")


def generate_launch_description():
    """Describe the nodes."""
    player = Node(
        package=PACKAGE,
        executable="replay_node",
        name="replay_node",
        parameters=[{"bag": LaunchConfiguration("bag")}],
        output="screen",
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("bag"),
            DeclareLaunchArgument("params", default_value=in_share("config", "cell.yaml")),
            estimator("thermal_node", "thermal_node.yaml", "thermal_node_replay.yaml"),
            estimator("tcf_node", "tcf_node.yaml"),
            player,
        ]
    )
