"""How accurate the cell is believed to be: drift, tool, correction and own faults in one state."""

from dataclasses import dataclass

import numpy as np

from robocal_ros.ground.proposals import Head
from robocal_ros.maintenance.config import MaintenanceConfig
from robocal_ros.maintenance.memory import Memory, ToolRecord
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError, both_errors, offset_error
from robocal_ros.thermal.accuracy_state import Accuracy

__all__ = ["Accuracy", "Drift", "accuracy_of"]

NS = 1_000_000_000
MM = 1e-3


@dataclass(frozen=True)
class Drift:
    """What the thermal node says of itself; ``error`` None where it is not known."""

    level: AccuracyLevel
    reason: str
    error: ToolError | None
    due_in_s: float


@dataclass(frozen=True)
class _Finding:
    level: AccuracyLevel
    words: str
    error: ToolError | None
    due_in_s: float


def accuracy_of(
    config: MaintenanceConfig,
    drift: Drift | None,
    uncorrected: str,
    memory: Memory,
    tool: Head,
    thermal_id: int,
    wall_ns: int,
) -> Accuracy:
    """Judge everything at once; the worst part gives the level.

    Parameters
    ----------
    drift : None: the thermal node is silent.
    uncorrected : why commands are not corrected with what is in force; empty: they are.
    tool, thermal_id : tool and thermal model (0: nominal) in force.
    """
    parts = []
    if len(config.poses):
        parts.append(_thermal(drift))
    if config.T_base_laser is not None:
        parts.append(_tool(config, memory.tool, tool, thermal_id, wall_ns))
    if parts and uncorrected:  # what is known of model and tool is not what the line makes
        parts.append(_Finding(AccuracyLevel.DEGRADED, f"correction: {uncorrected}", None, np.inf))
    errors = [part.error for part in parts if part.error is not None]
    known = both_errors(*errors) if len(errors) == 2 else errors[0] if errors else None
    error = known if len(errors) == len(parts) else None
    if memory.fault:
        return Accuracy(AccuracyLevel.FAULT, f"maintenance: {memory.fault}", error)
    if not parts:
        return Accuracy(AccuracyLevel.FAULT, "neither measuring poses nor a laser are configured")
    due_in_s = min(part.due_in_s for part in parts)
    worst = max(part.level for part in parts)
    words = "; ".join(part.words for part in parts if part.level >= worst)
    if known is not None:
        bound = f"95 % of tool errors below {known.bound_m * 1e3:.2f} mm"
        bound += f", of {config.tolerance_m * 1e3:.2f} mm allowed"
        if not known.bound_m <= config.tolerance_m and worst < AccuracyLevel.DEGRADED:
            whose = "drift and tool" if error is not None else "what is known of drift and tool"
            return Accuracy(AccuracyLevel.DEGRADED, f"{whose}: {bound}", error, due_in_s)
        words = f"{bound}; {words}" if error is not None else words
    return Accuracy(worst, words, error, due_in_s)


def _thermal(drift: Drift | None) -> _Finding:
    if drift is None:
        return _Finding(AccuracyLevel.FAULT, "drift: the thermal node is silent", None, 0.0)
    return _Finding(drift.level, f"drift: {drift.reason}", drift.error, drift.due_in_s)


def _tool(
    config: MaintenanceConfig, record: ToolRecord, tool: Head, thermal_id: int, wall_ns: int
) -> _Finding:
    age_s = (wall_ns - record.wall_ns) / NS
    due_in_s = config.tool_due_s - age_s
    if not record.wall_ns:
        return _Finding(AccuracyLevel.EXPIRED, f"tool: {record.words}", None, 0.0)
    if age_s < 0.0:  # the clock was set back: nobody knows how old it is
        return _Finding(AccuracyLevel.EXPIRED, "tool: checked in the future: check it", None, 0.0)
    when = f"checked {age_s / 60.0:.0f} min ago"
    same = record.revision == tool.revision
    error = _tool_error(record, tool) if same else None
    if age_s > config.tool_expires_s:
        return _Finding(AccuracyLevel.EXPIRED, f"tool: {when}", error, due_in_s)
    if record.answer == "failed":
        return _Finding(AccuracyLevel.DEGRADED, f"tool: {record.words}", None, 0.0)
    if record.candidate and record.candidate == tool.calibration_id:
        words = f"tool: {when}, measured and accepted; a check has not passed yet"
        return _Finding(AccuracyLevel.DUE, words, None, min(due_in_s, 0.0))
    if record.answer == "recalibrate":  # until a check passes, whatever else came into force since
        todo = "measure and accept it" if same else "another one is in force since: check it"
        words = f"tool: {record.words}: {todo}"
        return _Finding(AccuracyLevel.DEGRADED, words, error, min(due_in_s, 0.0))
    if not same:
        words = "tool: another one is in force than was checked: check it"
        return _Finding(AccuracyLevel.DUE, words, None, 0.0)
    if record.thermal_id != thermal_id:
        # A newer model knows the drift since the check. An older one was left for a reason, which
        # may be in the tool.
        words = "tool: another thermal model is in force than it was checked with: check it"
        known = error if thermal_id > record.thermal_id else None
        return _Finding(AccuracyLevel.DUE, words, known, 0.0)
    if record.answer == "cannot tell" or due_in_s <= 0.0:
        words = f"tool: {when}, {record.words}"
        return _Finding(AccuracyLevel.DUE, words, error, min(due_in_s, 0.0))
    return _Finding(AccuracyLevel.OK, f"tool: {when}, {record.words}", error, due_in_s)


def _tool_error(record: ToolRecord, tool: Head) -> ToolError:
    """What a check found, and what none sees: the drift that went into a measured tool."""
    found = offset_error(record.deviation_mm * MM, record.sigma_mm * MM)
    if tool.calibration_id is None:
        return found
    return both_errors(ToolError(record.drift_rms_m, record.drift_bound_m), found)
