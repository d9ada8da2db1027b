"""Names of commands in a recording: nobody listens to them, whoever plays it.

What moves a robot, says that it may be moved, or how its controller moves it, lies under
`RECORDED`: ``/robot/gap_open`` as ``/recorded/robot/gap_open``. `BagReader` gives each topic the
name that it had on the graph.
"""

RECORDED = "/recorded"
MOVES = "it may move a robot"
VOUCHES = "it says that a robot may move now, or how it is moved"

_BY_TYPE = {
    "trajectory_msgs/msg/JointTrajectory": MOVES,
    "trajectory_msgs/msg/MultiDOFJointTrajectory": MOVES,
    "std_msgs/msg/Float64MultiArray": MOVES,  # as forward_command_controller takes them
    "control_msgs/msg/JointJog": MOVES,  # as MoveIt Servo takes them, with the next two
    "geometry_msgs/msg/Twist": MOVES,
    "geometry_msgs/msg/TwistStamped": MOVES,
    "robocal_msgs/msg/ToolStep": MOVES,
    "robocal_msgs/msg/GapOpen": VOUCHES,
    "std_msgs/msg/Bool": VOUCHES,  # a PLC's inputs, and `gap_open` where `gap_bool` is set
    "robocal_msgs/msg/MotionLease": VOUCHES,
    "robocal_msgs/msg/MaintenanceStatus": VOUCHES,  # the beat, and whether the robot is at home
    "robocal_msgs/msg/AccuracyState": VOUCHES,  # by which the line goes on
    "control_msgs/msg/JointTrajectoryControllerState": VOUCHES,  # where its reference is, how fast
    "control_msgs/msg/SpeedScalingFactor": VOUCHES,
}
_BY_NAME = {"speed_scaling": VOUCHES, "gap_open": VOUCHES}  # last parts of names
# Of these types there are readings, by the last parts of their names, and commands of any name:
# MoveIt Servo, ros2_control and simulators are given joint states and poses to go to.
_READINGS = {
    "sensor_msgs/msg/JointState": {"joint_states"},
    "geometry_msgs/msg/PoseStamped": {"measured_pose", "target_pose"},
}


def withheld(topic: str, msgtype: str) -> str:
    """Why a message of this name on the graph may do something; empty when it does nothing."""
    end = topic.rsplit("/", 1)[-1]
    if why := _BY_TYPE.get(msgtype) or _BY_NAME.get(end):
        return why
    return MOVES if end not in _READINGS.get(msgtype, {end}) else ""


def recorded_name(topic: str, msgtype: str) -> str:
    """The name under which a topic is recorded."""
    return RECORDED + topic if topic == graph_name(topic) and withheld(topic, msgtype) else topic


def graph_name(topic: str) -> str:
    """The name that a recorded topic had on the graph."""
    return topic.removeprefix(RECORDED) if topic.startswith(f"{RECORDED}/") else topic
