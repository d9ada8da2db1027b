# SPDX-License-Identifier: Apache-2.0
"""Starts the nodes of two robots, each in a namespace and with a parameter file of its own.

ros2 launch robocal_ros two_robots.launch.py left_params:=left.yaml right_params:=right.yaml

Where they share a sensor or a station, shared:=true: sharing_node gives the gap to one at a time.
Other arguments are those of cell.launch.py, and for both: plc:=true panel:=true simulated:=true.
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import IfElseSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

ROBOTS = ("left", "right")


def share(*path):
    """Path of a file that the package installs."""
    return PathJoinSubstitution([FindPackageShare("robocal_ros"), *path])


def generate_launch_description():
    """Describe both cells."""
    actions = [
        DeclareLaunchArgument(
            "simulated",
            default_value="false",
            description="cell_sim_node in each namespace; what left_params and right_params do "
            "not have is of config/cells/kr150_shift.yaml. Never in the graph of a real robot",
        ),
        DeclareLaunchArgument(
            "shared",
            default_value="false",
            description="Both measure in one place: each PLC publishes gap_wanted, sharing_node "
            "the gap_open of one at a time (docs/cell_launch.md); plc_bridge_node does so",
        ),
        Node(
            package="robocal_ros",
            executable="sharing_node",
            name="sharing_node",
            parameters=[share("config", "sharing_node.yaml"), {"robots": list(ROBOTS)}],
            ros_arguments=["--enclave", "/robocal/sharing_node"],
            output="screen",
            condition=IfCondition(LaunchConfiguration("shared")),
        ),
    ]
    for robot in ROBOTS:
        params = f"{robot}_params"
        own = LaunchConfiguration(params)
        simulated = share("config", "cells", "kr150_shift.yaml")
        given = {
            "namespace": robot,
            "params": IfElseSubstitution(LaunchConfiguration("simulated"), simulated, own),
            "own_params": own,
        }
        actions += [
            # No default: each robot has a serial of its own.
            DeclareLaunchArgument(params, description=f"Of the {robot} robot's cell"),
            IncludeLaunchDescription(
                share("launch", "cell.launch.py"), launch_arguments=given.items()
            ),
        ]
    return LaunchDescription(actions)
