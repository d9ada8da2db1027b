"""How accurate the cell is by all that is known: the state that the line reads, and its rules."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.correction.interface import ToldCorrection, uncorrected
from robocal_ros.ground.errors import InputError
from robocal_ros.history.history_records import Head
from robocal_ros.maintenance.memory import MM, NS, Array, Memory, ToolRecord
from robocal_ros.motion.cell import DrivingConfig
from robocal_ros.thermal.accuracy import (
    Accuracy,
    AccuracyLevel,
    ToolError,
    both_errors,
    offset_error,
)


@dataclass(frozen=True)
class AcceptBounds:
    """What may be accepted without a person, absolute against the commissioning model."""

    automatic: bool = False  # False: nothing may
    # largest shift of the tool's tip at home and measuring poses from the cold reference
    thermal_m: float = 1e-3
    # tool_m, tool_rad: of the tip and of the axis from the taught tool
    tool_m: float = 1e-3
    tool_rad: float = float(np.radians(1.5))


@dataclass(frozen=True)
class Times:
    """How long each part may take at the most, s; what takes longer is broken off."""

    answer_s: float = 1.0  # a service of another node
    solve_s: float = 6.0  # the end of a thermal cycle
    settle_s: float = 0.3  # a measurement counts so long after the robot stands
    stay_s: float = 0.2  # the robot stays so long after the last measurement of a pose
    measure_s: float = 3.0  # at a pose, from standstill on
    # check_s, full_s: a quick check and a full measurement of the tool, from home to its end
    check_s: float = 15.0
    full_s: float = 30.0
    # kept free for the way home from the beams; a longer one counts once it was driven
    tool_home_s: float = 10.0
    reserve_s: float = 1.0  # kept free before the end of a gap
    rest_s: float = 1.0  # after a motion's end, until the robot rests where it ends
    stale_s: float = 0.5  # ``gap_open`` may pause for so long

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} = {value}: must be positive and finite")


@dataclass(frozen=True, eq=False)
class MaintenanceConfig:
    """What the maintenance of one robot is made of."""

    home: Array  # (n,) taught joints at which the robot is handed over, rad (prismatic: m)
    # (k, n) measuring poses in their order; k = 0: no thermal measurement. The straight joint lines
    # from home through all of them and back home are ways that are free.
    poses: Array
    T_flange_tool: Array  # (4, 4) the taught tool
    driving: DrivingConfig  # limits, sizes and deviations; its limits hold at the station
    T_base_laser: Array | None = None  # (4, 4) of the beam station; None: no tool measurement
    travel_speed_m_s: float = 0.25  # of the tip on the ways between taught poses
    # (n,), or one for all: the robot is at home with all joints so near, rad (m)
    home_near: ArrayLike = float(np.radians(0.5))
    measurements: int = 1  # so many make a pose measured
    # an unfinished thermal cycle goes on when its last pose is no older. The tracker takes all
    # poses of a cycle for measured in its middle, half of a pause away: within 300 s a cold robot
    # of this size drifts by as much as one measurement scatters, 0.03 mm.
    resume_within_s: float = 600.0
    # check_every_s, full_every_s: tool measurements that are due without a reason; 0: in each gap,
    # and never
    check_every_s: float = 0.0
    full_every_s: float = 0.0
    # tool_due_s, tool_expires_s: age of a tool check at which it is due, and says nothing any more
    tool_due_s: float = 2.0 * 3600.0
    tool_expires_s: float = 8.0 * 3600.0
    silent_s: float = 5.0  # `~/accuracy` of the thermal node may pause for so long
    # the same of the joint correction's status; 0: there is none, whatever is in force is applied
    # by the robot's controller
    correction_silent_s: float = 5.0
    tolerance_m: float = 3e-4  # error that the process allows
    times: Times = field(default_factory=Times)
    bounds: AcceptBounds = field(default_factory=AcceptBounds)


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
    if len(config.poses) and drift is None:
        silent = "drift: the thermal node is silent"
        parts.append(_Finding(AccuracyLevel.FAULT, silent, None, 0.0))
    elif len(config.poses) and drift is not None:
        reason = f"drift: {drift.reason}"
        parts.append(_Finding(drift.level, reason, drift.error, drift.due_in_s))
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


class NodeReports:
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
