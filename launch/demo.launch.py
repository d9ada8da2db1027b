# SPDX-License-Identifier: Apache-2.0
"""The demo: a simulated cell keeps itself accurate, in closed loop, in three minutes.

ros2 launch robocal_ros demo.launch.py

It stays on this machine and in a domain of its own. Its page is robocal_demo/report/report.html.
"""

from launch.actions import DeclareLaunchArgument, Shutdown
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

from launch import LaunchDescription


def generate_launch_description():
    """Describe it."""
    out = DeclareLaunchArgument(
        "out", default_value="robocal_demo", description="Folder of report, recording and logs"
    )
    demo = Node(
        package="robocal_ros",
        executable="demo",
        arguments=["--out", LaunchConfiguration("out"), "--no-open"],
        output="screen",
        additional_env={"PYTHONUNBUFFERED": "1"},
        on_exit=Shutdown(),
    )
    return LaunchDescription([out, demo])
