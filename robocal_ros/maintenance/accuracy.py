"""How accurate the cell is believed to be: drift, tool, correction and own faults in one state."""

from dataclasses import dataclass

import numpy as np

from robocal_ros.correction.status import ToldCorrection, uncorrected
from robocal_ros.ground.proposals import Head
from robocal_ros.maintenance.memory import MaintenanceConfig, Memory, ToolRecord
from robocal_ros.thermal.accuracy import (
    Accuracy,
    AccuracyLevel,
    ToolError,
    both_errors,
    offset_error,
)

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


# ---- what the thermal node and the joint correction say of themselves, while it is fresh --------


class Heard:
    """Keeps what came last; times of a steady clock."""

    def __init__(self, config: MaintenanceConfig) -> None:
        self._config = config
        self._drift: tuple[Drift, float] | None = None
        self._correction: tuple[ToldCorrection, float] | None = None
        self._in_force: tuple[int, int] | None = None
        self._since_s = -np.inf  # from when on that is in force, as far as it was looked at

    def take_drift(self, drift: Drift, now_s: float) -> None:
        """Keep what the thermal node says."""
        self._drift = drift, now_s

    def take_correction(self, told: ToldCorrection, now_s: float) -> None:
        """Keep what the joint correction says."""
        self._correction = told, now_s

    def drift(self, now_s: float) -> Drift | None:
        """None while the thermal node is silent."""
        drift = self._drift
        return drift[0] if drift is not None and now_s - drift[1] <= self._config.silent_s else None

    def uncorrected(self, thermal: Head, tool: Head, now_s: float) -> str:
        """Why commands are not corrected with what is in force; empty: they are, or need not be.

        What has just come into force reaches the correction by way of another node: until it has,
        as long as it may be silent, the revision before is no fault.
        """
        silent_s, told = self._config.correction_silent_s, self._correction
        if silent_s == 0.0:
            return ""
        in_force = thermal.revision, tool.revision
        if in_force != self._in_force:
            self._since_s = now_s if self._in_force is not None else -np.inf
            self._in_force = in_force
        fresh = told[0] if told is not None and now_s - told[1] <= silent_s else None
        return uncorrected(fresh, thermal, tool, follows=now_s - self._since_s <= silent_s)
