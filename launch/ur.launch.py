# SPDX-License-Identifier: Apache-2.0
"""All nodes of a cell behind ur_robot_driver, which must run already; needs ros2 launch.

ros2 launch robocal_ros ur.launch.py params:=my_cell.yaml beams:=true

The names are those of ur_robot_driver (docs/drivers.md); whatever cell.launch.py takes may be
given. Its robot_state_publisher shows the taught robot where the driver is started with
ur_description.launch.py as its ``description_launchfile``.
"""

from launch.actions import DeclareLaunchArgument, IncludeLaunchDescription
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "robocal_ros"
# Both beams at the first standard inputs of an e-series, which tells them at 500 Hz.
BEAMS = {"input": "ur_io", "sources": ["0", "1"], "period_ms": 2.0}


def in_share(*path):
    """Path of a file that the package installs."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *path])


def generate_launch_description():
    """Describe the nodes."""
    controller = ["/", LaunchConfiguration("ur_controller")]
    names = {
        "params": LaunchConfiguration("params"),
        "controller": [*controller, "/joint_trajectory"],
        "action": [*controller, "/follow_joint_trajectory"],
        "state": [*controller, "/controller_state"],
        "speed_scaling": "/speed_scaling_state_broadcaster/speed_scaling",
    }
    beams = Node(
        package=PACKAGE,
        executable="adapter_node",
        name="adapter_node",
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            in_share("config", "adapter_node.yaml"),
            BEAMS,
            ParameterFile(LaunchConfiguration("params"), allow_substs=True),
            {"use_sim_time": ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)},
        ],
        remappings=[("io_states", "/io_and_status_controller/io_states")],
        ros_arguments=["--log-level", LaunchConfiguration("log_level")],
        output="screen",
        condition=IfCondition(LaunchConfiguration("beams")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument(
                "params",
                default_value=in_share("config", "cell.yaml"),
                description="Parameter file of the cell",
            ),
            DeclareLaunchArgument(
                "ur_controller",
                default_value="scaled_joint_trajectory_controller",
                description="Active controller of ur_robot_driver",
            ),
            DeclareLaunchArgument(
                "beams",
                default_value="false",
                description="adapter_node makes beam events of the robot's inputs 0 and 1; others, "
                "and another rate, stand in a section /**/adapter_node of params",
            ),
            IncludeLaunchDescription(
                in_share("launch", "cell.launch.py"), launch_arguments=names.items()
            ),
            beams,
        ]
    )
