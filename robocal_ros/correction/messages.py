"""The joint correction's commands, offsets and status as messages: pure mapping."""

import math
from array import array
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from robocal_msgs.msg import CorrectionStatus as StatusMessage
from robocal_msgs.msg import JointOffset

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.status import CorrectionStatus, Offset
from robocal_ros.nodes.conversions import header, transform_message

Array = NDArray[np.float64]

POINT_FIELDS = ("positions", "velocities", "accelerations", "effort")


def doubles(values: Array) -> "array[float]":
    """The type that a message takes without looking at each number."""
    return array("d", values.tobytes())


# ---- commands and readings ----------------------------------------------------------------------


def array_command(names: tuple[str, ...], message: Any) -> JointCommand:
    """Build from a ``std_msgs/Float64MultiArray``, whose data are the positions of ``names``."""
    return JointCommand(names, np.array(message.data, dtype=np.float64))


def fill_array(message: Any, command: JointCommand) -> None:
    """Put corrected positions into a ``Float64MultiArray``; its layout stays."""
    message.data = doubles(command.position)


def fill_joints(message: Any, command: JointCommand) -> None:
    """Put positions and velocities into a ``JointState``; what they do not change stays.

    Velocities of which one is not finite (that of another's joint: a gripper) go out empty.
    """
    message.header.frame_id = command.mark
    message.position = doubles(command.position)
    if command.velocity is not None:
        known = np.all(np.isfinite(command.velocity))
        message.velocity = doubles(command.velocity if known else np.empty(0))


def fill_path(message: Any, command: TrajectoryCommand) -> None:
    """Put corrected positions and rates into a ``JointTrajectory``; times and efforts stay."""
    message.header.frame_id = command.mark
    changed = (command.position, command.velocity, command.acceleration)
    for name, values in zip(POINT_FIELDS, changed, strict=False):
        if values is not None:
            for point, row in zip(message.points, values, strict=True):
                setattr(point, name, doubles(row))


def drop_unknown_efforts(message: Any) -> None:
    """Empty the efforts of a ``JointState`` that are not finite: many drivers have none."""
    if not np.all(np.isfinite(message.effort)):
        message.effort = doubles(np.empty(0))


def is_finite(message: Any) -> bool:
    """Whether every number of a command or reading is finite."""
    if hasattr(message, "points"):
        rows = [getattr(point, name) for point in message.points for name in POINT_FIELDS]
    elif hasattr(message, "data"):
        rows = [message.data]
    else:
        rows = [message.position, message.velocity, message.effort]
    return all(all(map(math.isfinite, row)) for row in rows)


# ---- what the node tells ------------------------------------------------------------------------


class CorrectionMessages:
    """Status and offsets of one robot as messages.

    Parameters
    ----------
    reference : with the taught tool.
    name : the reference model's, as configured.
    """

    def __init__(
        self, nominal: SerialArm, reference: SerialArm, name: str, serial: str, shadow: bool
    ) -> None:
        self._name = name
        self._shadow = shadow
        self._own = {
            "robot": nominal.name,
            "serial": serial,
            "model_hash": nominal.model_hash,
            "taught_tool": transform_message(reference.T_flange_tool),
            "shadow": shadow,
        }

    def offset(self, offset: Offset, cause: int, stamp_ns: int) -> JointOffset:
        """What is added to the taught joints."""
        return JointOffset(
            header=header(stamp_ns, ""),
            cause=cause,
            joint_names=offset.names,
            offset=doubles(offset.offset),
            model_revision=offset.revision or 0,
            tool_revision=offset.tool_revision or 0,
            withheld=doubles(offset.withheld),
            shadow=self._shadow,
        )

    def status(self, status: CorrectionStatus, sources: str, stamp_ns: int) -> StatusMessage:
        """What the correction does; ``sources``: what is wrong with who sends commands."""
        return StatusMessage(
            header=header(stamp_ns, ""),
            **self._own,
            state=int(status.state),
            reason=in_words(status),
            reference=f"{self._name}: {status.reference}",
            enabled=status.enabled,
            policy=getattr(StatusMessage, status.policy.name),
            model_revision=status.revision or 0,
            tool_revision=status.tool_revision or 0,
            model_waits=status.waiting_revision is not None,
            waiting_model_revision=status.waiting_revision or 0,
            tool_waits=status.waiting_tool is not None,
            waiting_tool_revision=status.waiting_tool or 0,
            stale=status.stale,
            mismatch=status.mismatch,
            commanders=sources,
            tool_shift_mm=status.tcp_shift_m * 1e3,
            remaining_mm=status.remaining_m * 1e3,
            largest_offset=status.largest_shift,
            reduced=status.reduced,
            **_counts("refused", status.refused),
            **_counts("clamped", status.clamped),
            **_counts("passed", status.passed),
            last_refusal=status.last_refusal,
        )


def _counts(what: str, counts: Mapping[Reason, int]) -> dict[str, Sequence[Any]]:
    return {f"{what}_reasons": [r.value for r in counts], what: list(counts.values())}


def in_words(status: CorrectionStatus) -> str:
    """What the correction does now, in one line."""
    said = _said(status)
    return f"shadow, nothing is changed; it would be {said}" if status.shadow else said


def _said(status: CorrectionStatus) -> str:
    if status.mismatch:
        return f"nothing goes out, {Reason.START_MISMATCH.value}: {status.mismatch}"
    if not status.enabled:
        return "off, blending out with the next commands" if status.active else "off"
    parts = [] if status.revision is None else [f"model revision {status.revision}"]
    parts += [f"tool revision {status.tool_revision}"] if status.new_tool else []
    if not parts:
        return "on, but there is no model and no tool yet"
    settled = "on" if status.settled else "on, blending with the next commands"
    return f"{settled}: {' and '.join(parts)}"
