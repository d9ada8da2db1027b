"""What other nodes say of one robot, as the maintenance session takes it: pure mapping."""

from typing import Any

from robocal_ros.correction.status import CorrectionState, ToldCorrection
from robocal_ros.ground.errors import InputError
from robocal_ros.maintenance.accuracy import Drift
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError

MM = 1e-3
LARGEST = 1e9  # mm, s: a figure beyond is a defect, and its square might be infinite


def require_robot(topic: str, message: Any, robot: str, serial: str) -> None:
    """Refuse what another robot's node says.

    Raises
    ------
    InputError
    """
    told, mine = (message.robot, message.serial), (robot, serial)
    if told != mine:
        raise InputError(
            f"{topic} is of robot and serial {told}, this node keeps {mine}: "
            "give both nodes the same, or mend the remapping"
        )


def told_drift(message: Any) -> Drift:
    """Read a ``robocal_msgs/AccuracyState`` of the thermal node.

    Raises
    ------
    InputError
        When its state is unknown, or a figure cannot be.
    """
    try:
        level = AccuracyLevel(message.state)
    except ValueError as error:
        raise InputError(f"accuracy state {message.state} is unknown") from error
    rms_mm, bound_mm, due_in_s = message.predicted_error_mm, message.bound_mm, message.due_in_s
    if not all(abs(figure) <= LARGEST for figure in (rms_mm, bound_mm, due_in_s)):
        raise InputError(f"rms {rms_mm:g} mm, bound {bound_mm:g} mm, due in {due_in_s:g} s")
    known = rms_mm >= 0.0 and bound_mm >= 0.0
    found = ToolError(rms_mm * MM, bound_mm * MM) if known else None
    return Drift(level, message.reason, found, due_in_s)


def told_correction(message: Any) -> ToldCorrection:
    """Read a ``robocal_msgs/CorrectionStatus``.

    Raises
    ------
    InputError
        When its state is unknown.
    """
    try:
        state = CorrectionState(message.state)
    except ValueError as error:
        raise InputError(f"correction state {message.state} is unknown") from error
    return ToldCorrection(
        state=state,
        enabled=message.enabled,
        shadow=message.shadow,
        model_revision=message.model_revision,
        tool_revision=message.tool_revision,
        waiting_tool_revision=message.waiting_tool_revision if message.tool_waits else None,
        stale=message.stale,
        mismatch=message.mismatch,
        commanders=message.commanders,
        last_refusal=message.last_refusal,
    )
