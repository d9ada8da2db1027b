"""Starts all nodes of one robot's cell; needs ros2 launch.

ros2 launch robocal_ros cell.launch.py params:=my_cell.yaml namespace:=robot_1 simulated:=true

Each node has its file of config/; what ``params`` says comes after it (config/cell.yaml shows how).
Trajectories of program, tool measurement and maintenance end at ``controller``. Nothing is
corrected and nothing moves until it is enabled, armed, or run.
"""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
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


def cell_node(name, condition=None):
    """Describe a node with its own file, and where its topics lead."""
    simulated = name == "cell_sim_node"
    trajectories = "joint_trajectory" if simulated else "~/joint_trajectory"
    state = "~/controller_state" if simulated else "controller_state"
    return Node(
        package=PACKAGE,
        executable=name,
        name=name,
        namespace=LaunchConfiguration("namespace"),
        parameters=[
            in_share("config", f"{name}.yaml"),
            LaunchConfiguration("params"),
            *([MOTIONS] if name in ("tcf_node", "maintenance_node") else []),
        ],
        remappings=[
            (trajectories, LaunchConfiguration("controller")),
            (CONTROLLER, LaunchConfiguration("controller")),  # as recorder_node knows it
            (state, LaunchConfiguration("state")),
            ("kinematic_model", "thermal_node/model"),
            ("tool", "tcf_node/tool"),
        ],
        output="screen",
        condition=condition,
    )


def generate_launch_description():
    """Describe the nodes."""
    simulated = IfCondition(LaunchConfiguration("simulated"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("params", default_value=in_share("config", "cell.yaml")),
            DeclareLaunchArgument("namespace", default_value=""),
            DeclareLaunchArgument("controller", default_value=CONTROLLER),
            DeclareLaunchArgument("action", default_value=""),
            DeclareLaunchArgument("state", default_value=STATE),
            DeclareLaunchArgument("simulated", default_value="false"),
            *(cell_node(name) for name in NODES),
            cell_node("cell_sim_node", simulated),
        ]
    )
