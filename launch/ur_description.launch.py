# SPDX-License-Identifier: Apache-2.0
"""ur_robot_driver's description with a robot_state_publisher that shows the taught robot.

ros2 launch ur_robot_driver ur_control.launch.py ur_type:=ur5e robot_ip:=192.168.56.101 \
    description_launchfile:=$(ros2 pkg prefix --share robocal_ros)/launch/ur_description.launch.py

What ur_rsp.launch.py takes may be given; /tf then agrees with what planners see.
"""

from launch.actions import GroupAction, IncludeLaunchDescription
from launch.substitutions import PathJoinSubstitution
from launch_ros.actions import SetRemap
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription


def generate_launch_description():
    """Describe it."""
    file = PathJoinSubstitution([FindPackageShare("ur_robot_driver"), "launch", "ur_rsp.launch.py"])
    # In a group: joint_state_broadcaster, of the same launch, must not be remapped.
    taught = SetRemap("joint_states", "/joint_correction_node/joint_states")
    return LaunchDescription([GroupAction([taught, IncludeLaunchDescription(file)])])
