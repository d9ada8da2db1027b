"""Names of commands in a recording: nobody listens to them, whoever plays it.

What moves a robot, says that it may be moved, or how its controller moves it, lies under
`RECORDED`: ``/robot/gap_open`` as ``/recorded/robot/gap_open``. `BagReader` gives each topic the
name that it had on the graph.
"""

RECORDED = "/recorded"
MOVES_TYPES = {
    "trajectory_msgs/msg/JointTrajectory",
    "trajectory_msgs/msg/MultiDOFJointTrajectory",
    "std_msgs/msg/Float64MultiArray",  # as forward_command_controller takes them
    "control_msgs/msg/JointJog",  # as MoveIt Servo takes them, with the next two
    "geometry_msgs/msg/Twist",
    "geometry_msgs/msg/TwistStamped",
    "robocal_msgs/msg/ToolStep",
}
MOVES_ENDS = {"joint_targets", "joint_commands"}  # last parts of names
VOUCHES_TYPES = {
    "robocal_msgs/msg/GapOpen",
    "robocal_msgs/msg/MotionLease",
    "control_msgs/msg/JointTrajectoryControllerState",  # where the robot's reference is, how fast
}
VOUCHES_ENDS = {"gap_open", "speed_scaling"}


def recorded_name(topic: str, msgtype: str) -> str:
    """The name under which a topic is recorded."""
    by_name = topic.rsplit("/", 1)[-1] in MOVES_ENDS | VOUCHES_ENDS
    commands = by_name or msgtype in MOVES_TYPES | VOUCHES_TYPES
    return RECORDED + topic if commands and topic == graph_name(topic) else topic


def graph_name(topic: str) -> str:
    """The name that a recorded topic had on the graph."""
    return topic.removeprefix(RECORDED) if topic.startswith(f"{RECORDED}/") else topic
