# SPDX-License-Identifier: Apache-2.0
"""Starts another launch file whose nodes are to see the taught robot: MoveIt, displays.

ros2 launch robocal_ros taught.launch.py package:=ur_moveit_config file:=ur_moveit.launch.py \
    ur_type:=ur5e

All its nodes read the un-corrected joint states of joint_correction_node in place of the
controller's. No driver, controller or estimator may be among them: they would be corrected twice.
What that file takes may be given too.
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import SetRemap
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Describe it."""
    file = PathJoinSubstitution(
        [FindPackageShare(LaunchConfiguration("package")), "launch", LaunchConfiguration("file")]
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("package", description="Package of the launch file"),
            DeclareLaunchArgument("file", description="Its name in that package's folder launch"),
            DeclareLaunchArgument(
                "joint_states",
                default_value="/joint_correction_node/joint_states",
                description="Topic of the un-corrected joint states",
            ),
            # Not in a group: what the file starts later, on an event, would be out of its scope.
            SetRemap("joint_states", LaunchConfiguration("joint_states")),
            IncludeLaunchDescription(file),
        ]
    )
