"""The joint correction's session: taught joints in, corrected ones out, and back.

session     what the node drives: commands, readings, offers, status
commands    targets and trajectories, corrected
readings    joint states, un-corrected
inputs      what comes in, as types; how they are built from messages
status      what is said of it, as types
incoming    joints by name, order in time
echoes      own output that comes back
offers      which models are taken over
tools       which tools are taken over, and when
starts      where a command may begin
courses     what becomes of a trajectory that was put out
proposals   what could be put out, on the way to a model
corrector   which model corrects at every instant
plain       settled streams, from bytes to bytes
"""

from robocal_ros.core.joint_correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.sessions.correction.courses import Course
from robocal_ros.sessions.correction.incoming import require_finite
from robocal_ros.sessions.correction.inputs import (
    JointCommand,
    OfferedModel,
    OfferedTool,
    TrajectoryCommand,
    finite_command,
    joint_command,
    offered_model,
    offered_tool,
    trajectory_command,
)
from robocal_ros.sessions.correction.session import CorrectionSession
from robocal_ros.sessions.correction.status import CorrectionStatus, Offset

__all__ = [
    "CorrectionConfig",
    "CorrectionSession",
    "CorrectionStatus",
    "Course",
    "JointCommand",
    "OfferedModel",
    "OfferedTool",
    "Offset",
    "Policy",
    "Reason",
    "RefusedError",
    "ShiftBounds",
    "TrajectoryCommand",
    "finite_command",
    "joint_command",
    "offered_model",
    "offered_tool",
    "require_finite",
    "trajectory_command",
]
