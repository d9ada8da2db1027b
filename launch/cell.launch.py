# SPDX-License-Identifier: Apache-2.0
"""Starts all nodes of one robot's cell; needs ros2 launch.

ros2 launch robocal_ros cell.launch.py params:=my_cell.yaml namespace:=robot_1
ros2 launch robocal_ros cell.launch.py simulated:=true

Each node has its file of config/; what ``params`` says comes after it (config/cell.yaml shows how).
Trajectories of program, tool measurement and maintenance end at ``controller``. Nothing is
corrected and nothing moves until it is enabled, armed, or run.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import IfElseSubstitution, LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterFile, ParameterValue
from launch_ros.substitutions import FindPackageShare

from launch import LaunchDescription

PACKAGE = "robocal_ros"
NODES = (
    "thermal_node",
    "tcf_node",
    "hand_eye_node",
    "joint_correction_node",
    "maintenance_node",
    "recorder_node",
)
CONTROLLER = "joint_trajectory_controller/joint_trajectory"
STATE = "joint_trajectory_controller/controller_state"
MOTIONS = {"follow_joint_trajectory": LaunchConfiguration("action")}


def in_share(*path):
    """Path of a file that the package installs."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *path])


ARGUMENTS = {
    "simulated": (
        "false",
        "cell_sim_node in place of robot, sensor and beams; never in the graph of a real robot",
    ),
    "plc": ("false", "plc_bridge_node too, the PLC's OPC UA server; params has its security_dir"),
    "shared": (
        "false",
        "Others measure in the same place: plc_bridge_node asks for the gap on gap_wanted, which "
        "sharing_node passes on (two_robots.launch.py starts it)",
    ),
    "panel": ("false", "panel_node too, the page for a browser; params has its security_dir"),
    "fixture": ("false", "fixture_node too; params has its fixture_file"),
    "params": (
        IfElseSubstitution(
            LaunchConfiguration("simulated"),
            in_share("config", "cells", "kr150_shift.yaml"),
            in_share("config", "cell.yaml"),
        ),
        "Parameter file of the cell, after each node's own; by default config/cell.yaml, "
        "of a simulated cell config/cells/kr150_shift.yaml",
    ),
    "own_params": (
        LaunchConfiguration("params"),
        "Parameter file after that: what this robot alone has, where several have params in common",
    ),
    "namespace": ("", "Of all nodes, and of all topics without a leading /"),
    "controller": (CONTROLLER, "Topic where trajectories end: the controller's joint_trajectory"),
    "action": ("", "The controller's FollowJointTrajectory; empty: of who subscribes controller"),
    "state": (STATE, "Topic of the controller's state"),
    "speed_scaling": ("speed_scaling", "Topic of the robot's speed in percent, std_msgs/Float64"),
    "use_sim_time": ("false", "Take the time from /clock"),
    "log_level": ("info", "Of all nodes: debug, info, warn, error or fatal"),
    "use_respawn": ("false", "Start a node anew 2 s after it ended; it then moves nothing unasked"),
}


def cell_node(name, condition=None):
    """Describe a node with its own file, and where its topics lead."""
    simulated = name == "cell_sim_node"
    trajectories = "joint_trajectory" if simulated else "~/joint_trajectory"
    state = "~/controller_state" if simulated else "controller_state"
    sim_time = ParameterValue(LaunchConfiguration("use_sim_time"), value_type=bool)
    asks = IfElseSubstitution(LaunchConfiguration("shared"), "gap_wanted", "gap_open")
    movers = ("tcf_node", "maintenance_node", "joint_correction_node")
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            in_share("config", f"{name}.yaml"),
            ParameterFile(LaunchConfiguration("params"), allow_substs=True),
            ParameterFile(LaunchConfiguration("own_params"), allow_substs=True),
            {"use_sim_time": sim_time},
            *([MOTIONS] if name in movers else []),
        ],
        remappings=[
            (trajectories, LaunchConfiguration("controller")),
            (CONTROLLER, LaunchConfiguration("controller")),  # as recorder_node knows it
            (state, LaunchConfiguration("state")),
            ("speed_scaling", LaunchConfiguration("speed_scaling")),
            ("kinematic_model", "thermal_node/model"),
            ("tool", "tcf_node/tool"),
            *([("gap_open", asks)] if name == "plc_bridge_node" else []),
        ],
        # for SROS 2 (docs/security.md): of no effect unless ROS_SECURITY_ENABLE is true
        ros_arguments=[
            "--enclave",
            f"/robocal/{name}",
            "--log-level",
            LaunchConfiguration("log_level"),
        ],
        respawn=LaunchConfiguration("use_respawn"),
        respawn_delay=2.0,
        output="screen",
        condition=condition,
    )


def generate_launch_description():
    """Describe the nodes."""
    simulated = IfCondition(LaunchConfiguration("simulated"))
    others = ("plc_bridge_node", "plc"), ("panel_node", "panel"), ("fixture_node", "fixture")
    return LaunchDescription(
        [
            *(
                DeclareLaunchArgument(name, default_value=default, description=meaning)
                for name, (default, meaning) in ARGUMENTS.items()
            ),
            *(cell_node(name) for name in NODES),
            *(cell_node(name, IfCondition(LaunchConfiguration(asked))) for name, asked in others),
            cell_node("cell_sim_node", simulated),
        ]
    )
