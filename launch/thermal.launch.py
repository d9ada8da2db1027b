# SPDX-License-Identifier: Apache-2.0
"""Starts thermal_node and joint_correction_node for one robot; needs ros2 launch.

ros2 launch robocal_ros thermal.launch.py thermal_params:=A.yaml correction_params:=B.yaml

Robot, serial and everything else stand in the parameter files; one file may serve both nodes. By
default those of config/ are taken. Nothing is corrected until ~/enable is called.
"""

from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "robocal_ros"


def params(argument, shipped):
    """Declare the argument that names a node's parameter file; the shipped one by default."""
    default = PathJoinSubstitution([FindPackageShare(PACKAGE), "config", shipped])
    return DeclareLaunchArgument(argument, default_value=default, description="Parameter file")


def generate_launch_description():
    """Describe the nodes."""
    return LaunchDescription(
        [
            params("thermal_params", "thermal_node.yaml"),
            params("correction_params", "joint_correction_node.yaml"),
            Node(
                package=PACKAGE,
                executable="thermal_node",
                name="thermal_node",
                parameters=[LaunchConfiguration("thermal_params")],
                output="screen",
            ),
            Node(
                package=PACKAGE,
                executable="joint_correction_node",
                name="joint_correction_node",
                parameters=[LaunchConfiguration("correction_params")],
                remappings=[
                    ("kinematic_model", "/thermal_node/model"),
                    ("tool", "/tcf_node/tool"),
                ],
                output="screen",
            ),
        ]
    )
