# SPDX-License-Identifier: Apache-2.0
"""Settings of the maintenance, what it remembers over a restart, and how accurate the cell is.

The state that the line reads is judged by all that is known: `accuracy_of`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.correction.interface import ToldCorrection, uncorrected
from robocal_ros.ground.errors import Code, InputError, StateLostError, StorageError
from robocal_ros.ground.frames import Array
from robocal_ros.history.history_records import Head
from robocal_ros.motion.cell import DrivingConfig
from robocal_ros.thermal.accuracy import (
    Accuracy,
    AccuracyLevel,
    ToolError,
    both_errors,
    offset_error,
)
from robocal_ros.tool.run import taught_apart

NS, MM = 1_000_000_000, 1e-3
REMEMBERED = 200  # ended cycles
UNKNOWN = ToolError(-1.0, -1.0)  # as it is kept
VERSION = 2  # of the document; one without a version is the first, which knew no runs and stamps


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
    laser_frame_s: float = 90.0  # the beams found with the mandrel, the same
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
    # (m, n) poses at which the fixture's features are measured, a ring as of ``poses``; None: no
    # fixture is. Each is visited so often: between two of one place the robot repeats anew.
    fixture_poses: Array | None = None
    fixture_visits: int = 2
    travel_speed_m_s: float = 0.25  # of the tip on the ways between taught poses
    # (n,), or one for all: the robot is at home with all joints so near, rad (m)
    home_near: ArrayLike = float(np.radians(0.5))
    measurements: int = 1  # so many make a pose measured
    # an unfinished thermal cycle goes on when its last pose is no older. The tracker takes all
    # poses of a cycle for measured in its middle, half of a pause away: within 300 s a cold robot
    # of this size drifts by as much as one measurement scatters, 0.03 mm.
    resume_within_s: float = 600.0
    # and with poses that are left, when its first one is no older: of poses spread evenly over a
    # span the rms distance from its middle is a square root of twelfth, 260 s of this one
    cycle_within_s: float = 900.0
    # check_every_s, full_every_s: tool measurements that are due without a reason; 0: in each gap,
    # and never
    check_every_s: float = 0.0
    full_every_s: float = 0.0
    # the beams' own place is found again, with a mandrel; 0: never
    laser_frame_every_s: float = 0.0
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


class DocumentStore(Protocol):
    """Keeps one document; whole or not at all.

    ``path``: where, for whoever must mend it.
    """

    path: Path

    def load(self) -> Mapping[str, Any] | None:
        """What was kept last; None before anything; raises `StateLostError` where it is gone."""

    def save(self, document: Mapping[str, Any]) -> None:
        """Keep it; raises a `RobocalError` when that fails."""


def utc_of(stamp_ns: int) -> str:
    """A time of the wall clock for a person, to the second."""
    return f"{np.datetime64(stamp_ns, 'ns').astype('datetime64[s]')}Z"


@dataclass(frozen=True)
class CycleResult:
    """How a maintenance cycle ended, or how far it has come."""

    cycle_id: str
    # ACCEPT when it ran as planned, with the robot at home; NONE while it runs
    code: Code = Code.NONE
    message: str = ""
    complete: bool = False  # nothing that was due is left for the next gap; ``left`` names what is
    left: tuple[str, ...] = ()
    # thermal_code, thermal_id: of the end of the thermal cycle; NONE where it did not end
    thermal_code: Code = Code.NONE
    thermal_id: int = 0
    # tool_code, tool_id: of the last tool measurement, and its candidate
    tool_code: Code = Code.NONE
    tool_id: int = 0
    tool_answer: str = ""  # of the last quick check
    accepted: tuple[int, ...] = ()  # calibrations that were accepted without a person
    # what was found of the tool as the gap began, also where that was mended
    tool_found_code: Code = Code.NONE
    # when it ended, by the wall clock; began, while it runs, and of one that was killed
    stamp_ns: int = 0
    # the how many-th since the state folder was made; 0: of a version that did not count
    run: int = 0
    # of the fixture's measurement, where it was judged, and its candidate; NONE where it was not
    fixture_code: Code = Code.NONE
    fixture_id: int = 0
    # of the beams that were found again, the same
    station_code: Code = Code.NONE
    station_id: int = 0

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "CycleResult":
        """Read what `document` gave, also after JSON."""
        values = dict(document)
        codes = ("thermal_code", "tool_code", "tool_found_code", "fixture_code", "station_code")
        for name in ("code", *codes):
            values[name] = Code(values.get(name, Code.NONE))
        for name in ("left", "accepted"):
            values[name] = tuple(values[name])
        return cls(**values)


@dataclass(frozen=True)
class ToolRecord:
    """What is known of the tool in force from its last measurement."""

    # "pass", "recalibrate" or "cannot tell"; "failed": the last run found something wrong and has
    # no result for the tool in force, or what it found is lost; empty: never measured
    answer: str = ""
    words: str = "the tool was never checked"
    deviation_mm: float = 0.0
    sigma_mm: float = 0.0
    revision: int = 0  # of the tool that was in force in the last run
    tool_digest: str = ""  # of it; empty: not known, as of a version that did not keep it
    thermal_id: int = 0  # thermal model that was in force in it; 0: the nominal one
    thermal_digest: str = ""
    candidate: int = 0  # calibration that a full measurement proposes in its place; 0: none
    postponed: bool = False  # only the time for its check was missing to accept it without a person
    # wall_ns, full_ns: of its last result, and of the last full one; 0: none
    wall_ns: int = 0
    full_ns: int = 0
    laser_ns: int = 0  # when the beams were found last, or were not found
    # drift_rms_m, drift_bound_m: error of the thermal model through which a tool was last measured;
    # `UNKNOWN`: the drift was not known
    drift_rms_m: float = 0.0
    drift_bound_m: float = 0.0
    taught: Sequence[Sequence[float]] = ()  # T_flange_tool (4, 4) of then; empty: not known

    def of_taught(self, T_flange_tool: Array) -> "ToolRecord":
        """It, where it was of the tool that is taught so (4, 4), else of one never checked."""
        rows = T_flange_tool.tolist()
        if self.taught and taught_apart(np.array(self.taught), T_flange_tool):
            words = "the tool was taught otherwise when it was checked"
            return ToolRecord(words=words, laser_ns=self.laser_ns, taught=rows)
        return replace(self, taught=rows)

    @staticmethod
    def measured_with(tool: Head, thermal: Head) -> dict[str, Any]:
        """Fields of what was in force in a measurement."""
        return {
            "revision": tool.revision,
            "tool_digest": tool.digest,
            "thermal_id": thermal.calibration_id or 0,
            "thermal_digest": thermal.digest,
        }

    def is_of(self, tool: Head) -> bool:
        """Whether it was measured with this tool in force."""
        return self.revision == tool.revision and self.tool_digest in ("", tool.digest)

    def is_through(self, thermal: Head) -> bool:
        """Whether it was measured with this thermal model in force."""
        same = self.thermal_id == (thermal.calibration_id or 0)
        return same and self.thermal_digest in ("", thermal.digest)


@dataclass
class Memory:
    """The kept state."""

    keeper: DocumentStore
    cycles: dict[str, CycleResult] = field(default_factory=dict)
    tool: ToolRecord = field(default_factory=ToolRecord)
    # fault_code, fault: what stopped the maintenance until it is acknowledged; empty: nothing
    fault_code: Code = Code.NONE
    fault: str = ""
    # running, began_ns: the cycle that is open
    running: str = ""
    began_ns: int = 0
    runs: int = 0  # cycles that have begun, ever
    earlier: frozenset[str] = frozenset()  # ids of the cycles that had ended before this start

    @classmethod
    def load(cls, keeper: DocumentStore) -> "Memory":
        """Read what is kept; a fault where a cycle was open, or where what was kept is gone.

        Raises `RobocalError` when it cannot be read, or is of another version.
        """
        try:
            document = keeper.load()
        except StateLostError as error:
            memory = cls(keeper)
            known = "ended cycles, whose ids would run again, the last check, an open fault"
            memory.set_fault(error.code, f"{error} ({known}): see where the robot is")
            memory.save()
            return memory
        if document is None:
            return cls(keeper)
        memory = cls._of_document(keeper, document)
        if memory.running:
            words = f"the node ended while cycle '{memory.running}' ran: see where the robot is"
            result = CycleResult(
                memory.running,
                Code.CONFLICT,
                words,
                stamp_ns=memory.began_ns,
                run=memory.runs,
            )
            memory.end(result, Code.CONFLICT, words)
            lost = "what the cycle in which the node ended found of it is lost: check it"
            memory.note_tool(answer="failed", words=lost)
            memory.save()
        memory.earlier = frozenset(memory.cycles)
        return memory

    @classmethod
    def _of_document(cls, keeper: DocumentStore, document: Mapping[str, Any]) -> "Memory":
        try:
            if not 1 <= (version := int(document.get("version", 1))) <= VERSION:
                raise ValueError(f"version {version}")
            results = [CycleResult.of_document(each) for each in document["cycles"]]
            return cls(
                keeper,
                {result.cycle_id: result for result in results},
                ToolRecord(**document["tool"]),
                Code(document["fault_code"]),
                str(document["fault"]),
                str(document["running"]),
                int(document.get("began_ns", 0)),
                int(document.get("runs", 0)),
            )
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise StorageError(
                f"{keeper.path} is not of this version ({type(error).__name__}: {error}): go back "
                "to the version that wrote it, or see where the robot is and move it away"
            ) from error

    def begin(self, cycle_id: str, wall_ns: int) -> CycleResult:
        """A cycle runs from now on; its result, as yet."""
        self.running, self.began_ns, self.runs = cycle_id, wall_ns, self.runs + 1
        try:
            self.save()
        except Exception:
            self.running, self.runs = "", self.runs - 1
            raise
        self.earlier -= {cycle_id}  # an id of long ago, which is not among `cycles` any more
        return CycleResult(cycle_id, stamp_ns=wall_ns, run=self.runs)

    def end(self, result: CycleResult, fault_code: Code = Code.NONE, fault: str = "") -> None:
        """It has ended, for good; `save` keeps that."""
        self.running = ""
        self.cycles[result.cycle_id] = result
        self.earlier -= {result.cycle_id}
        while len(self.cycles) > REMEMBERED:
            del self.cycles[next(iter(self.cycles))]
        if fault:
            self.fault_code, self.fault = fault_code, fault

    def words_of(self, result: CycleResult) -> str:
        """How a cycle ended; of one from before this start it is said that it is old."""
        if result.cycle_id not in self.earlier:
            return result.message
        when = f", run {result.run}, {utc_of(result.stamp_ns)}" if result.run else ""
        return (
            f"cycle '{result.cycle_id}' is one of before this start of the node{when}; nothing "
            f"runs now; it ended so: {result.message}"
        )

    def note_tool(self, **known: Any) -> None:
        """The tool was measured; `save` keeps it."""
        self.tool = replace(self.tool, **known)

    def set_fault(self, code: Code, words: str) -> None:
        """A fault; `save` keeps it."""
        self.fault_code, self.fault = code, words

    def clear_fault(self) -> None:
        """Its end; it stays where that cannot be kept."""
        before = self.fault_code, self.fault
        self.fault_code, self.fault = Code.NONE, ""
        try:
            self.save()
        except Exception:
            self.fault_code, self.fault = before
            raise

    def save(self) -> None:
        """Keep all of it."""
        self.keeper.save(
            {
                "version": VERSION,
                "cycles": [result.document() for result in self.cycles.values()],
                "tool": asdict(self.tool),
                "fault_code": int(self.fault_code),
                "fault": self.fault,
                "running": self.running,
                "began_ns": self.began_ns,
                "runs": self.runs,
            }
        )


def accuracy_of(
    config: MaintenanceConfig,
    drift: Accuracy | None,
    uncorrected: str,
    memory: Memory,
    tool: Head,
    thermal: Head,
    wall_ns: int,
) -> Accuracy:
    """Judge everything at once; the worst part gives the level.

    ``drift``: None: the thermal node is silent.
    ``uncorrected``: why commands are not corrected with what is in force; empty: they are.
    ``tool``, ``thermal``: in force.
    """
    parts = []
    if len(config.poses) and drift is None:
        silent = "drift: the thermal node is silent"
        parts.append(Accuracy(AccuracyLevel.FAULT, silent, None, 0.0))
    elif len(config.poses) and drift is not None:
        parts.append(replace(drift, reason=f"drift: {drift.reason}"))
    if config.T_base_laser is not None:
        parts.append(_tool(config, memory.tool, tool, thermal, wall_ns))
    if parts and uncorrected:  # what is known of model and tool is not what the line makes
        parts.append(Accuracy(AccuracyLevel.DEGRADED, f"correction: {uncorrected}", None, np.inf))
    errors = [part.error for part in parts if part.error is not None]
    known = both_errors(*errors) if len(errors) == 2 else errors[0] if errors else None
    error = known if len(errors) == len(parts) else None
    if memory.fault:
        return Accuracy(AccuracyLevel.FAULT, f"maintenance: {memory.fault}", error)
    if not parts:
        return Accuracy(AccuracyLevel.FAULT, "neither measuring poses nor a laser are configured")
    due_in_s = min(part.due_in_s for part in parts)
    worst = max(part.level for part in parts)
    words = "; ".join(part.reason for part in parts if part.level >= worst)
    if known is not None:
        bound = f"95 % of tool errors below {known.bound_m * 1e3:.2f} mm"
        bound += f", of {config.tolerance_m * 1e3:.2f} mm allowed"
        if not known.bound_m <= config.tolerance_m and worst < AccuracyLevel.DEGRADED:
            whose = "drift and tool" if error is not None else "what is known of drift and tool"
            return Accuracy(AccuracyLevel.DEGRADED, f"{whose}: {bound}", error, due_in_s)
        words = f"{bound}; {words}" if error is not None else words
    return Accuracy(worst, words, error, due_in_s)


def _tool(
    config: MaintenanceConfig, record: ToolRecord, tool: Head, thermal: Head, wall_ns: int
) -> Accuracy:
    age_s = (wall_ns - record.wall_ns) / NS
    due_in_s = config.tool_due_s - age_s
    if not record.wall_ns:
        return Accuracy(AccuracyLevel.EXPIRED, f"tool: {record.words}", None, 0.0)
    if age_s < 0.0:  # the clock was set back: nobody knows how old it is
        return Accuracy(AccuracyLevel.EXPIRED, "tool: checked in the future: check it", None, 0.0)
    when = f"checked {age_s / 60.0:.0f} min ago"
    same = record.is_of(tool)
    error = None
    if same and record.answer != "failed":  # what an older check found holds no more
        error = _tool_error(record, tool)
    if age_s > config.tool_expires_s:
        return Accuracy(AccuracyLevel.EXPIRED, f"tool: {when}, {record.words}", error, due_in_s)
    if record.answer == "failed":
        return Accuracy(AccuracyLevel.DEGRADED, f"tool: {record.words}", None, 0.0)
    if record.candidate and record.candidate == tool.calibration_id:
        words = f"tool: {when}, measured and accepted; a check has not passed yet"
        return Accuracy(AccuracyLevel.DUE, words, None, min(due_in_s, 0.0))
    if record.answer == "recalibrate":  # until a check passes, whatever else came into force since
        todo = "measure and accept it" if same else "another one is in force since: check it"
        words = f"tool: {record.words}: {todo}"
        return Accuracy(AccuracyLevel.DEGRADED, words, error, min(due_in_s, 0.0))
    if not same:
        words = "tool: another one is in force than was checked: check it"
        return Accuracy(AccuracyLevel.DUE, words, None, 0.0)
    if not record.is_through(thermal):
        # A newer model knows the drift since the check. An older one was left for a reason, which
        # may be in the tool.
        words = "tool: another thermal model is in force than it was checked with: check it"
        known = error if (thermal.calibration_id or 0) > record.thermal_id else None
        return Accuracy(AccuracyLevel.DUE, words, known, 0.0)
    if record.answer == "cannot tell" or due_in_s <= 0.0:
        words = f"tool: {when}, {record.words}"
        return Accuracy(AccuracyLevel.DUE, words, error, min(due_in_s, 0.0))
    return Accuracy(AccuracyLevel.OK, f"tool: {when}, {record.words}", error, due_in_s)


def _tool_error(record: ToolRecord, tool: Head) -> ToolError | None:
    """What a check found, and what none sees: the drift that went into a measured tool.

    None where that is not known.
    """
    found = offset_error(record.deviation_mm * MM, record.sigma_mm * MM)
    if tool.calibration_id is None:
        return found
    drift = ToolError(record.drift_rms_m, record.drift_bound_m)
    return None if drift == UNKNOWN else both_errors(drift, found)


class NodeReports:
    """Keeps what came last; times of a steady clock."""

    def __init__(self, config: MaintenanceConfig) -> None:
        self._config = config
        # what was told, and when
        self.told_drift: tuple[Accuracy, float] | None = None
        self.told_correction: tuple[ToldCorrection, float] | None = None
        self._in_force: tuple[int, int] | None = None
        self._since_s = -np.inf  # from when on that is in force, as far as it was looked at

    def drift(self, now_s: float) -> Accuracy | None:
        """None while the thermal node is silent."""
        drift = self.told_drift
        return drift[0] if drift is not None and now_s - drift[1] <= self._config.silent_s else None

    def uncorrected(self, thermal: Head, tool: Head, now_s: float) -> str:
        """Why commands are not corrected with what is in force; empty: they are, or need not be.

        What has just come into force reaches the correction by way of another node: until it has,
        as long as it may be silent, the revision before is no fault.
        """
        silent_s, told = self._config.correction_silent_s, self.told_correction
        if silent_s == 0.0:
            return ""
        in_force = thermal.revision, tool.revision
        if in_force != self._in_force:
            self._since_s = now_s if self._in_force is not None else -np.inf
            self._in_force = in_force
        fresh = told[0] if told is not None and now_s - told[1] <= silent_s else None
        return uncorrected(fresh, thermal, tool, follows=now_s - self._since_s <= silent_s)
