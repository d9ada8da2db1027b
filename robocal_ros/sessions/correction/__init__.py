"""The joint correction's session: taught joints in, corrected ones out, and back.

session     what the node drives: commands, readings, offers, status
inputs      what comes in and the status, as types; how they are built from messages
incoming    joints by name, order in time, own output that comes back
offers      which models and tools are taken over
corrector   which model corrects at every instant, and where a correction may start
"""

from robocal_ros.core.joint_correction.bounds import CorrectionConfig, ShiftBounds
from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.sessions.correction.incoming import require_finite
from robocal_ros.sessions.correction.inputs import (
    CorrectionStatus,
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

__all__ = [
    "CorrectionConfig",
    "CorrectionSession",
    "CorrectionStatus",
    "JointCommand",
    "OfferedModel",
    "OfferedTool",
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
