"""One bag through the code of ``robocal replay``, and judged, for ``robocal validate``.

Runs in a process of its own: a `Job` goes in, a `Validated` comes out, no message between.
"""

import math
import tempfile
from array import array
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.bags.replay import EVENTS, first_configuration, read_events, topic_kind
from robocal_ros.cell_sim.faults import SIZES
from robocal_ros.cli.bag_truth import (
    HAND_EYE,
    TOOL,
    BagTruth,
    CycleErrors,
    Forecasts,
    ReplayedCycle,
    ThermalHistory,
    ToldStates,
    above,
    finite,
    is_simulated,
)
from robocal_ros.cli.output import Document, refusal
from robocal_ros.cli.recording import UNASKED, BagOverview, begin_ns, find_robot, open_recording
from robocal_ros.cli.replaying import ReplayRequest, replay_bag, seconds
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.hand_eye.session import is_hand_eye_session
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.report.figures import CellCourse, Drawn, cell_drawn, thermal_figures, tool_figures
from robocal_ros.report.validation import TOLERANCE_MM, ShiftErrors
from robocal_ros.session import events
from robocal_ros.session.events import ACCEPT, Command
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.session import is_thermal_session
from robocal_ros.tool.session import is_tool_session

# ---- the course of a simulated cell -------------------------------------------------------------


Array = NDArray[np.float64]

HOUR_NS = 3.6e12
ACCURACY = "accuracy_state"
UNITS: dict[str, tuple[float, str]] = {
    fault: (factor, unit) for fault, (_, factor, unit) in SIZES.items()
}


@dataclass(eq=False)
class _Line:
    """What the line read: stamps, ns; 95 % bound, nan where not known, and allowed error, mm."""

    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    bound_mm: "array[float]" = field(default_factory=lambda: array("d"))
    tolerance_mm: float | None = None

    def at(self, stamp_ns: Array) -> Array:
        """The bound that was told last at each time; not a number before any."""
        bound_mm = np.array([np.nan, *self.bound_mm])
        return bound_mm[np.searchsorted(self.stamp_ns, stamp_ns, side="right")]


def cell_courses(reader: BagReader, truth: BagTruth) -> list[CellCourse]:
    """The course of the true error of each cell that a bag tells of.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    if not truth.states:
        return []
    told = [topic for topic in reader.info.topics if topic_kind(topic) == ACCURACY]
    lines = {truth.state_topic(above(topic)): topic for topic in told}
    return [
        _course(topic, states, _line(reader, truth, lines.get(topic)), reader.info.start_ns or 0)
        for topic, states in truth.states.items()
    ]


def _course(topic: str, states: ToldStates, line: _Line, start_ns: int) -> CellCourse:
    series = {name: np.array(values) for name, values in states.series.items()}
    return CellCourse(
        topic=topic,
        hours=(np.array(states.stamp_ns) - start_ns) / HOUR_NS,
        without_mm=1e3 * series["without_m"],
        with_mm=1e3 * series["with_m"],
        p95_mm=1e3 * series["p95_m"],
        lambda_without=series["lambda_without"],
        lambda_with=series["lambda_with"],
        bound_mm=line.at(np.array(states.stamp_ns)),
        tolerance_mm=line.tolerance_mm,
        faults=[
            {"hours": (stamp_ns - start_ns) / HOUR_NS, "fault": fault, "size": size}
            | {"told": _told(fault, size)}
            for stamp_ns, fault, size in states.faults
        ],
    )


def _told(fault: str, size: float) -> str:
    """A size in the fault's own unit; empty where it ended."""
    factor, unit = UNITS.get(fault, (1.0, ""))
    return f"{size / factor:.4g} {unit}".strip() if size else ""


def _line(reader: BagReader, truth: BagTruth, topic: str | None) -> _Line:
    line = _Line()
    if topic is None:
        return line
    with truth.reading(topic):
        for recorded in reader.messages([topic]):
            told = recorded.message
            bound_mm = finite(told.bound_mm, "bound_mm")
            line.stamp_ns.append(recorded.log_time_ns)
            line.bound_mm.append(bound_mm if bound_mm >= 0.0 else np.nan)
            line.tolerance_mm = finite(told.tolerance_mm, "tolerance_mm")
    return line


# ---- what a thermal session brought, cycle by cycle and altogether, as a document ---------------


def thermal_document(cycles: Sequence[ReplayedCycle], arm: SerialArm) -> Document:
    """Every cycle, and the errors of all of them together."""
    measured = [c.measured for c in cycles if c.measured is not None]
    true = [c.true for c in cycles if c.true is not None]
    return {
        "cycles": [_cycle(cycle, arm) for cycle in cycles],
        "tolerance_mm": TOLERANCE_MM,
        "measured": together(measured),
        "true": together(true),
        "bound": _kept(cycles),
    }


def together(errors: Sequence[CycleErrors]) -> Document | None:
    """Figures over all cycles; None where there are none."""
    if not errors:
        return None
    after = [e.after for e in errors if e.after is not None]
    return CycleErrors(
        np.concatenate([e.without for e in errors]),
        np.concatenate([e.in_force for e in errors]),
        np.concatenate(after) if after else None,
    ).document()


def _cycle(cycle: ReplayedCycle, arm: SerialArm) -> Document:
    entry, found = cycle.entry, cycle.document
    names, unit = arm.parameters.names, arm.parameters.to_display
    return {
        "cycle": entry.cycle_id,
        "stamp": entry.stamp_ns * 1e-9,
        "hours": cycle.hours,
        "samples": found["samples"],
        "nominal": found["nominal"]["held_out"],
        "in_force": found["in_force"]["held_out"],
        "candidate": found["calibrated"]["held_out"],
        "predicted_rms_mm": found["calibrated"]["predicted"]["total_rms_mm"],
        "forecast": cycle.forecast,
        "measured": None if cycle.measured is None else cycle.measured.document(),
        "true": None if cycle.true is None else cycle.true.document(),
        "verdict": found["verdict"],
        "revision": entry.revision,
        "based_on": entry.based_on,
        "rejected": found["rejected"],
        "unobservable": found["unobservable"],
        "drift": dict(zip(names, (cycle.drift * unit).tolist(), strict=True)),
        "sigma": dict(zip(names, (cycle.sigma * unit).tolist(), strict=True)),
    }


def _kept(cycles: Sequence[ReplayedCycle]) -> Document:
    """Shares of the errors of the model in force below the 95 % bound expected beforehand."""
    return {
        "measured_share": _share(cycles, lambda cycle: cycle.measured),
        "true_share": _share(cycles, lambda cycle: cycle.true),
    }


def _share(
    cycles: Sequence[ReplayedCycle], errors: Callable[[ReplayedCycle], CycleErrors | None]
) -> float | None:
    below: list[Array] = []
    for cycle in cycles:
        known = errors(cycle)
        if known is not None and cycle.forecast is not None:
            bound_m = cycle.forecast["bound_mm"] * 1e-3
            below.append(np.linalg.norm(known.in_force, axis=1) <= bound_m)
    return float(np.mean(np.concatenate(below))) if below else None


def shift_errors(cycles: Sequence[ReplayedCycle]) -> ShiftErrors | None:
    """Errors of the cycles that a truth judges; None without any."""
    judged = [(c, c.true) for c in cycles if c.true is not None and c.true.after is not None]
    if not judged:
        return None
    return ShiftErrors(
        hours=np.array([c.hours for c, _ in judged]),
        accepted=[c.entry.revision > 0 for c, _ in judged],
        before=np.array([true.without for _, true in judged]),
        after=np.array([true.after for _, true in judged]),
        held=np.array([true.in_force for _, true in judged]),
    )


# ---- parts of a session document ----------------------------------------------------------------


Truth = Sequence[tuple[int, Array]]


def tool_runs(replayed: Document, truth: Truth) -> list[Document]:
    """Each run: what it found; the true error of a tip that it gives, where a truth is told."""
    return [_run(run, truth) for run in replayed["runs"]]


def _run(run: Document, truth: Truth) -> Document:
    change = run.get("change") or {}
    sigma = run.get("sigma_mm")
    true = _at(truth, round(run["stamp"] * 1e9))
    error = None
    if true is not None and "tcp_mm" in run:
        error = float(np.linalg.norm(np.array(run["tcp_mm"]) - true[:3, 3] * 1e3))
    return {
        "run": run["run"],
        "stamp": run["stamp"],
        "answer": run.get("answer", "measured"),
        "tcp_mm": run.get("tcp_mm"),
        "change_mm": change.get("tip_mm"),
        "change_deg": change.get("axis_deg"),
        "sigma_mm": float(np.linalg.norm(sigma)) if isinstance(sigma, list) else sigma,
        "misfit_mm": run.get("misfit_mm"),
        "true_error_mm": error,
        "verdict": run["verdict"],
    }


def calibrations(replayed: Document, truth: Truth) -> list[Document]:
    """Each placement of a sensor: its figures, and the true error at the working distance."""
    return [_calibration(found, truth) for found in replayed["calibrations"]]


def _calibration(found: Document, truth: Truth) -> Document:
    pose, away_mm = found.get("T_flange_sensor"), found.get("working_distance_mm")
    true = _at(truth, round(found["stamp"] * 1e9))
    error = None
    if true is not None and pose is not None and away_mm is not None:
        T = frames.transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"])
        at = np.array([0.0, 0.0, away_mm * 1e-3, 1.0])
        error = float(np.linalg.norm(((T - true) @ at)[:3]) * 1e3)
    return {
        "stamp": found["stamp"],
        "kind": found["kind"],
        "method": found["method"],
        "T_flange_sensor": pose,
        "residual_rms_mm": (found.get("residual_mm") or {}).get("rms"),
        "left_out": found.get("leave_one_out_mm"),
        "predicted_rms_mm": found.get("working_error_mm"),
        "working_distance_mm": away_mm,
        "true_error_mm": error,
        "rejected": list(found.get("rejected", [])),
        "verdict": found["verdict"],
    }


def _at(truth: Truth, stamp_ns: int) -> Array | None:
    """What was true at a stamp: told last before it, else first of all."""
    told = [T for at_ns, T in truth if at_ns <= stamp_ns] or [T for _, T in truth[:1]]
    return told[-1] if told else None


def decisions(
    commands: Sequence[Document], routine: Sequence[str], *, asked: bool
) -> list[dict[str, Any]]:
    """Commands with their code and reason, without routine steps that were carried out.

    ``asked``: somebody gave the commands; else an acceptance that did not come about is none.
    """
    return [
        {name: entry[name] for name in ("stamp", "command", "code", "message")}
        for entry in commands
        if not (
            entry["command"] in routine if entry["code"] == "ACCEPT" else _unasked(entry, asked)
        )
    ]


def as_recorded(command: Command, outcome: Mapping[str, Any]) -> Document:
    """A decision of a node that is not replayed."""
    return {
        "stamp": seconds(command.stamp_ns),
        "command": command.name,
        "code": Code(outcome["status"]).name,
        "message": str(outcome["message"]),
    }


def require_finite(told: Any, path: str, field: str = "") -> None:
    """See that a bag's document has finite numbers alone, for JSON knows no others.

    Raises
    ------
    InputError
        With the bag and the number's place in the document.
    """
    if isinstance(told, float) and not math.isfinite(told):
        raise InputError(f"{field} is {told}, which is no finite number", file=path)
    parts: Iterable[tuple[str, Any]] = ()
    if isinstance(told, dict):
        parts = ((f"{field}.{name}" if field else name, part) for name, part in told.items())
    elif isinstance(told, list | tuple):
        parts = ((f"{field}[{i}]", part) for i, part in enumerate(told))
    for name, part in parts:
        require_finite(part, path, name)


def _unasked(entry: Document, asked: bool) -> bool:
    return not asked and entry["command"] == ACCEPT


# ---- one bag through the code of ``robocal replay``, and judged, for ``robocal validate`` -------


_SESSIONS = (is_thermal_session, is_tool_session, is_hand_eye_session)
ROUTINE = (events.START, events.CAPTURE, events.SAMPLE, events.TOOL_STEP, events.STEP_BEGINS)


@dataclass(frozen=True)
class Job:
    """A bag to validate, by a name of its own; ``robot`` is for a bag that names none."""

    path: str
    name: str
    robot: str | None


@dataclass(frozen=True)
class Validated:
    """What a bag gave: its document, in it ``error`` or ``sessions``; each session's figures.

    ``cells``: the figure of each cell as a whole.
    """

    document: Document
    figures: tuple[tuple[Drawn, ...], ...] = ()
    cells: tuple[Drawn, ...] = ()


def validate_bag(job: Job) -> Validated:
    """Replay and judge a bag; one that cannot be is told, not raised."""
    head: Document = {"bag": job.name, "path": job.path}
    try:
        with BagReader(job.path) as reader:
            head |= _about(reader)
            recordings, skipped, others = _events_of(reader)
            if not recordings and not skipped:
                recordings = [open_recording(reader, {})]
            truth = BagTruth(reader)
            sessions = [_Session(job, recording, truth).judged() for recording in recordings]
            courses = cell_courses(reader, truth)
        told = {"sessions": [document for document, _ in sessions], "other_decisions": others}
        told["skipped"] = skipped
        told["cells"] = [course.document() for course in courses]
        require_finite(told, job.path)
    except RobocalError as error:
        return Validated(head | {"error": refusal(error.code, str(error))["error"]})
    except OSError as error:
        words = f"{error.filename or job.path}: {error.strerror}"
        return Validated(head | {"error": refusal(RobocalError.code, words)["error"]})
    figures = tuple(tuple(drawn) for _, drawn in sessions)
    return Validated(head | told, figures, tuple(cell_drawn(course) for course in courses))


def _about(reader: BagReader) -> Document:
    info = reader.info
    start_ns, end_ns = info.start_ns or 0, info.end_ns or 0
    return {
        "from": _utc(start_ns),
        "to": _utc(end_ns),
        "duration_s": (end_ns - start_ns) * 1e-9,
        "topics": {topic: found.messages for topic, found in info.topics.items()},
        "simulated": is_simulated(reader),
    }


def _utc(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _events_of(
    reader: BagReader,
) -> tuple[list[BagOverview], dict[str, str], dict[str, list[Document]]]:
    """Sessions that can be replayed, others with why not, and what other nodes decided.

    Raises
    ------
    InputError
        When an event cannot be read, or a session's joint states.
    """
    sessions: list[BagOverview] = []
    skipped: dict[str, str] = {}
    others: dict[str, list[Document]] = {}
    begin = begin_ns(reader)
    for topic in (topic for topic in reader.info.topics if topic_kind(topic) == EVENTS):
        told_by = first_configuration(reader.messages([topic]))
        if any(is_of(told_by) for is_of in _SESSIONS):
            recording = open_recording(reader, {EVENTS: topic})
            if not recording.commands:
                skipped[topic] = UNASKED
                continue
            if recording.configured is not None:
                sessions.append(recording)
                continue
            skipped[topic] = "the state that its commands began from was not recorded"
        if commands := read_events(reader.messages([topic]), begin)[1]:
            others[topic] = [as_recorded(*event) for event in commands if event[1]]
    return sessions, skipped, others


class _Session:
    """One node's session in a bag; the whole bag where nobody told events."""

    def __init__(self, job: Job, recording: BagOverview, truth: BagTruth) -> None:
        self._job, self._recording, self._truth = job, recording, truth
        self._topic = topic = recording.events
        self._namespace = above(above(topic or ""))  # of the node that told its events
        self._given = {} if topic is None else {EVENTS: topic}
        self._mark = " (simulated)" if is_simulated(recording.reader) else ""
        self._forecasts = Forecasts()
        self._warnings: list[str] = []
        self._arm: SerialArm | None = None

    def judged(self) -> tuple[Document, list[Drawn]]:
        """Replay it: what it gave, and its figures."""
        configured, truth, space = self._recording.configured, self._truth, self._namespace
        with tempfile.TemporaryDirectory(prefix="robocal-") as folder:
            replayed = self._replayed(Path(folder))
            common = self._common(replayed)
            if is_tool_session(configured):
                runs = tool_runs(replayed, truth.transforms(TOOL, space))
                found = {"kind": "tool", "runs": runs, "final": replayed["final_tool"]}
                return common | found, tool_figures(runs, self._mark)
            if is_hand_eye_session(configured):
                sensor = truth.transforms(HAND_EYE, space)
                made = {"calibrations": calibrations(replayed, sensor)}
                made |= {"final": replayed["final_sensor"]}
                return common | {"kind": "hand_eye", **made}, []
            document, figures = self._thermal(Path(folder), common)
            return common | document, figures

    def _replayed(self, folder: Path) -> Document:
        auto = not self._recording.commands
        request = ReplayRequest(
            bag=Path(self._job.path),
            find_robot=self._robot,
            auto=auto,
            accept=auto,
            topics=self._given,
            state=folder,
            beside=self._forecasts.beside,
        )
        replayed = replay_bag(request, _silent)
        if "error" in replayed:
            raise _ReplayError(replayed["error"])
        return replayed

    def _robot(self, configured: Command | None) -> SerialArm:
        """The recorded robot, else the one that the user names."""
        name = self._job.robot
        if name is not None and configured is not None:
            notes: list[str] = []
            arm = find_robot(name, notes, None)
            if arm.model_hash != configured.arguments.get("model_hash"):
                name = None
        self._arm = find_robot(name, self._warnings, configured)
        return self._arm

    def _thermal(self, folder: Path, common: Document) -> tuple[Document, list[Drawn]]:
        arm, serial = self._arm, Path(self._job.path).resolve().stem
        if arm is None:
            raise ValueError("replayed without a robot")
        with CalibrationHistory.open(serial, state_dir=folder, create=False) as history:
            made = ThermalHistory(history, arm, self._recording.start_ns)
            sigma_m = float(common["settings"]["sigma_m"])
            points = self._truth.check_points(self._namespace)
            cycles = made.cycles(self._forecasts, points, sigma_m)
        document = thermal_document(cycles, arm)
        shown = thermal_figures(document["cycles"], shift_errors(cycles), self._mark)
        return {"kind": "thermal", **document}, shown

    def _common(self, replayed: Document) -> Document:
        configured, recorded = self._recording.configured, bool(self._recording.commands)
        settings = asdict(ThermalConfig()) if configured is None else configured.arguments["config"]
        return {
            "node": self._topic,
            "robot": replayed["robot"],
            "model_hash": replayed["model_hash"],
            "as_recorded": recorded,
            "differs": replayed["differs"] if recorded else [],
            "settings": settings,
            "decisions": decisions(self._as_told(replayed["commands"]), ROUTINE, asked=recorded),
            "ignored": replayed["ignored_reasons"],
            "gaps": replayed["gaps"],
            "warnings": [*self._warnings, *replayed["warnings"]],
        }

    def _as_told(self, commands: list[Document]) -> list[Document]:
        """Each as it was recorded, with its own numbers of runs and calibrations.

        What comes out otherwise here is in ``differs``.
        """
        recorded = self._recording.commands
        if not recorded:
            return commands
        told = [as_recorded(*event) if event[1] else {} for event in recorded]
        return [here | there for here, there in zip(commands, told, strict=True)]


class _ReplayError(RobocalError):
    """What a replay told in its document, as an error."""

    def __init__(self, told: Document) -> None:
        super().__init__(told["message"])
        self.code = Code[told["code"]]


def _silent(what: str, recording: BagOverview) -> Iterator[BagMessage]:
    return recording.blocks()
