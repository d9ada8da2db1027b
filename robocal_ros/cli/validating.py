# SPDX-License-Identifier: Apache-2.0
"""One bag through the code of ``robocal replay``, and judged, for ``robocal validate``.

What judges it is the truth of a simulated one, else its own measurements. Runs in a process of its
own: a `Job` goes in, a `Validated` comes out, no message between.
"""

import math
import tempfile
from array import array
from bisect import bisect_right
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.bags.bags import BagMessage, BagReader, open_bag
from robocal_ros.bags.replay import EVENTS, first_configuration, read_events, stamp_of, topic_kind
from robocal_ros.cell_sim.faults import SIZES
from robocal_ros.cli.main import Document, refusal
from robocal_ros.cli.recording import (
    HAND_EYE,
    TOOL,
    UNASKED,
    BagOverview,
    BagTruth,
    CheckPoints,
    above,
    begin_ns,
    event_topics,
    find_robot,
    finite,
    is_simulated,
    open_recording,
)
from robocal_ros.cli.replay import ReplayRequest, replay_bag, seconds
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import MEASURING, Measurements
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import REFERENCE, THERMAL, Action, Entry
from robocal_ros.identification.judged import held_out_errors
from robocal_ros.identification.known_model import known_model
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.report.figures import (
    TOLERANCE_MM,
    CellCourse,
    Drawn,
    ShiftErrors,
    cell_drawn,
    thermal_figures,
    tool_figures,
)
from robocal_ros.report.measured_figures import MODEL_CAPTIONS, model_figures
from robocal_ros.report.page import figures_of
from robocal_ros.session import events
from robocal_ros.session.events import ACCEPT, Command, session_kind
from robocal_ros.thermal.drift_following import ThermalConfig
from robocal_ros.thermal.reference import (
    ColdReference,
    holds_drift,
    measured_errors,
    reference_of,
    true_errors,
)
from robocal_ros.thermal.session import ThermalSession

Truth = Sequence[tuple[int, Array]]  # stamps, ns, and transforms (4, 4) from then on

HOUR_NS = 3.6e12
ACCURACY = "accuracy_state"
ROUTINE = (events.START, events.CAPTURE, events.SAMPLE, events.TOOL_STEP, events.STEP_BEGINS)
LISTED = "its decisions follow from what no recording holds: they are listed as recorded"
_EVERY_ENTRY = 1_000_000


@dataclass(frozen=True)
class Job:
    """A bag to validate, by a name of its own; ``robot`` is for a bag that names none.

    ``topics``: input to topic, for a bag that holds no events.
    """

    path: str
    name: str
    robot: str | None
    topics: Mapping[str, str] = field(default_factory=dict)


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
        with open_bag(job.path) as reader:
            info = reader.info
            start_ns, end_ns = info.start_ns or 0, info.end_ns or 0
            head |= {
                "from": _utc(start_ns),
                "to": _utc(end_ns),
                "duration_s": (end_ns - start_ns) * 1e-9,
                "topics": {topic: found.messages for topic, found in info.topics.items()},
                "simulated": is_simulated(reader),
            }
            recordings, skipped, others = _recordings(reader)
            if not recordings and not skipped:
                skipped = dict.fromkeys(others, LISTED)
                recordings = [] if others else [open_recording(reader, job.topics)]
            truth = BagTruth(reader)
            sessions = [_SessionReplay(job, recording, truth).judged() for recording in recordings]
            courses = cell_courses(reader, truth)
            told = [document for document, _ in sessions]
            places = [truth.state_topic(above(above(one.events or ""))) for one in recordings]
        cells = []
        for course in courses:
            own = [d for d, place in zip(told, places, strict=True) if place == course.topic]
            cells.append(course.document(changes_of(course.faults, own, start_ns * 1e-9)))
        found = {
            "sessions": told, "other_decisions": others, "skipped": skipped, "cells": cells,
        }  # fmt: skip
        require_finite(found, job.path)
    except RobocalError as error:
        return Validated(head | {"error": refusal(error.code, str(error))["error"]})
    except OSError as error:
        words = f"{error.filename or job.path}: {error.strerror}"
        return Validated(head | {"error": refusal(RobocalError.code, words)["error"]})
    figures = tuple(tuple(drawn) for _, drawn in sessions)
    return Validated(head | found, figures, tuple(cell_drawn(course) for course in courses))


def _utc(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")


def _recordings(
    reader: BagReader,
) -> tuple[list[BagOverview], dict[str, str], dict[str, list[Document]]]:
    """Sessions that can be replayed, others with why not, and what other nodes decided."""
    sessions: list[BagOverview] = []
    skipped: dict[str, str] = {}
    others: dict[str, list[Document]] = {}
    begin = begin_ns(reader)
    for topic in event_topics(reader.info):
        configured = first_configuration(reader.messages([topic]))
        if session_kind(configured):
            recording = open_recording(reader, {EVENTS: topic})
            if not recording.commands:
                skipped[topic] = UNASKED
                continue
            if session_kind(configured) == "fixture":
                skipped[topic] = "of a fixture: 'robocal replay' shows it"
                continue
            if recording.configured is not None:
                sessions.append(recording)
                continue
            skipped[topic] = "the state that its commands began from was not recorded"
        if commands := read_events(reader.messages([topic]), begin)[1]:
            others[topic] = [_recorded_decision(*event) for event in commands if event[1]]
    return sessions, skipped, others


def _recorded_decision(command: Command, outcome: Mapping[str, Any]) -> Document:
    return {
        "stamp": seconds(command.stamp_ns),
        "command": command.name,
        "code": Code(outcome["status"]).name,
        "message": str(outcome["message"]),
    }


def require_finite(found: Any, path: str, field: str = "") -> None:
    """See that a bag's document has finite numbers alone, for JSON knows no others.

    Raises `InputError` with the bag and the number's place in the document.
    """
    if isinstance(found, float) and not math.isfinite(found):
        raise InputError(f"{field} is {found}, which is no finite number", file=path)
    parts: Iterable[tuple[str, Any]] = ()
    if isinstance(found, dict):
        parts = ((f"{field}.{name}" if field else name, part) for name, part in found.items())
    elif isinstance(found, list | tuple):
        parts = ((f"{field}[{i}]", part) for i, part in enumerate(found))
    for name, part in parts:
        require_finite(part, path, name)


class _SessionReplay:
    """One node's session in a bag; the whole bag where it holds no events."""

    def __init__(self, job: Job, recording: BagOverview, truth: BagTruth) -> None:
        self._job, self._recording, self._truth = job, recording, truth
        self._namespace = above(above(recording.events or ""))  # of the node that told its events
        self._mark = " (simulated)" if is_simulated(recording.reader) else ""
        self._forecasts = Forecasts()
        self._warnings: list[str] = []
        self._arm: SerialArm | None = None

    def judged(self) -> tuple[Document, list[Drawn]]:
        """Replay it: what it gave, and its figures."""
        configured, namespace = self._recording.configured, self._namespace
        auto, topic = not self._recording.commands, self._recording.events
        with tempfile.TemporaryDirectory(prefix="robocal-") as folder:
            request = ReplayRequest(
                bag=Path(self._job.path),
                find_robot=self._robot,
                auto=auto,
                accept=auto,
                topics=self._job.topics if topic is None else {EVENTS: topic},
                state=Path(folder),
                observe=self._forecasts.observed,
            )
            replayed = replay_bag(request, lambda _, recording: recording.blocks())
            if "error" in replayed:
                failed = RobocalError(replayed["error"]["message"])
                failed.code = Code[replayed["error"]["code"]]
                raise failed
            common = self._common(replayed)
            if session_kind(configured) == "tool":
                runs = tool_runs(replayed, self._truth.transforms(TOOL, namespace))
                found = {"kind": "tool", "runs": runs, "final": replayed["final_tool"]}
                return common | found, tool_figures(runs, self._mark)
            if session_kind(configured) == "hand_eye":
                made = calibrations(replayed, self._truth.transforms(HAND_EYE, namespace))
                final = replayed["final_sensor"]
                return common | {"kind": "hand_eye", "calibrations": made, "final": final}, []
            document, figures = self._thermal(Path(folder), common["settings"])
            return common | document, figures

    def _robot(self, configured: Command | None) -> SerialArm:
        """The recorded robot, else the one that the user names."""
        name = self._job.robot
        if name is not None and configured is not None:
            arm = find_robot(name, [], None)
            if arm.model_hash != configured.arguments.get("model_hash"):
                name = None
        self._arm = find_robot(name, self._warnings, configured)
        return self._arm

    def _thermal(self, folder: Path, settings: Document) -> tuple[Document, list[Drawn]]:
        arm, serial = self._arm, Path(self._job.path).resolve().stem
        if arm is None:
            raise ValueError("replayed without a robot")
        with CalibrationHistory.open(serial, state_dir=folder, create=False) as history:
            made = ThermalHistory(history, arm, self._recording.start_ns)
            points = self._truth.check_points(self._namespace)
            cycles = made.cycles(self._forecasts, points, float(settings["sigma_m"]))
            models = made.model_figures(settings["hold_out"], settings["seed"], self._mark)
        document = thermal_document(cycles, arm)
        figures = thermal_figures(document["cycles"], shift_errors(cycles), self._mark) + models
        return {"kind": "thermal", **document}, figures

    def _common(self, replayed: Document) -> Document:
        configured, recorded = self._recording.configured, self._recording.commands
        settings = asdict(ThermalConfig()) if configured is None else configured.arguments["config"]
        commands = replayed["commands"]
        if recorded:
            # Each as it was recorded, with its own numbers of runs and calibrations: what comes
            # out otherwise here is in ``differs``.
            commands = [
                here | (_recorded_decision(*event) if event[1] else {})
                for here, event in zip(commands, recorded, strict=True)
            ]
        return {
            "node": self._recording.events,
            "robot": replayed["robot"],
            "model_hash": replayed["model_hash"],
            "as_recorded": bool(recorded),
            "differs": replayed["differs"] if recorded else [],
            "settings": settings,
            "decisions": _decisions(commands, asked=bool(recorded)),
            "ignored": replayed["ignored_reasons"],
            "gaps": replayed["gaps"],
            "warnings": [*self._warnings, *replayed["warnings"]],
        }


def _decisions(commands: Sequence[Document], *, asked: bool) -> list[Document]:
    """Commands with their code and reason, without routine steps that were carried out.

    ``asked``: somebody gave the commands; else an acceptance that did not come about is none.
    """
    return [
        {name: entry[name] for name in ("stamp", "command", "code", "message")}
        for entry in commands
        if (
            entry["command"] not in ROUTINE
            if entry["code"] == "ACCEPT"
            else asked or entry["command"] != ACCEPT
        )
    ]


def tool_runs(replayed: Document, truth: Truth) -> list[Document]:
    """Each run: what it found; the true error of a tip that it gives, where a truth is told."""
    runs = []
    for run in replayed["runs"]:
        change = run.get("change") or {}
        sigma = run.get("sigma_mm")
        true = _at(truth, round(run["stamp"] * 1e9))
        error = None
        if true is not None and "tcp_mm" in run:
            error = float(np.linalg.norm(np.array(run["tcp_mm"]) - true[:3, 3] * 1e3))
        runs.append(
            {
                "run": run["run"],
                "stamp": run["stamp"],
                "answer": run.get("answer", "measured"),
                "tcp_mm": run.get("tcp_mm"),
                "change_mm": change.get("tip_mm"),
                "change_deg": change.get("axis_deg"),
                "sigma_mm": float(np.max(sigma)) if isinstance(sigma, list) else sigma,
                "misfit_mm": run.get("misfit_mm"),
                "true_error_mm": error,
                "verdict": run["verdict"],
            }
        )
    return runs


def calibrations(replayed: Document, truth: Truth) -> list[Document]:
    """Each placement of a sensor: its figures, and the true error at the working distance."""
    made = []
    for found in replayed["calibrations"]:
        pose, away_mm = found.get("T_flange_sensor"), found.get("working_distance_mm")
        true = _at(truth, round(found["stamp"] * 1e9))
        error = None
        if true is not None and pose is not None and away_mm is not None:
            T = frames.transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"])
            at = np.array([0.0, 0.0, away_mm * 1e-3, 1.0])
            error = float(np.linalg.norm(((T - true) @ at)[:3]) * 1e3)
        made.append(
            {
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
        )
    return made


def _at(truth: Truth, stamp_ns: int) -> Array | None:
    """What was true at a stamp: told last before it, else first of all."""
    told = [T for at_ns, T in truth if at_ns <= stamp_ns] or [T for _, T in truth[:1]]
    return told[-1] if told else None


class Forecasts:
    """What a thermal session expected of the tool's error whenever something was measured."""

    def __init__(self) -> None:
        self._known: list[tuple[int, float, float]] = []  # stamp, ns; rms and 95 % bound, mm

    def observed(
        self, session: ThermalSession, recording: BagOverview, samples: Iterator[BagMessage]
    ) -> Iterator[BagMessage]:
        """Ask before each measurement; the session learns of a cycle only when it ends."""
        for sample in samples:
            kind = recording.inputs.get(sample.topic)
            if kind in MEASURING and session.reference is not None:
                now_ns = stamp_of(sample.message)
                if (error := session.accuracy(now_ns).error) is not None:
                    self._known.append((now_ns, error.rms_m * 1e3, error.bound_m * 1e3))
            yield sample

    def at(self, first_ns: int) -> Document | None:
        """The forecast when a cycle's first measurement came; None where there is none."""
        found = next((known for known in self._known if known[0] >= first_ns), None)
        return None if found is None else {"rms_mm": found[1], "bound_mm": found[2]}


@dataclass(frozen=True, eq=False)
class CycleErrors:
    """Errors (m, 3), m: without correction, with the model in force before, and (truth) after."""

    without: Array
    in_force: Array
    after: Array | None = None

    def document(self) -> Document:
        """Their figures; ``after`` only where it is known."""
        found = {"without": figures_of(self.without), "in_force": figures_of(self.in_force)}
        return found if self.after is None else found | {"after": figures_of(self.after)}


@dataclass(frozen=True, eq=False)
class ReplayedCycle:
    """A candidate of the history, with the errors around it.

    ``hours``: since the cold reference, else since the first joint reading.
    ``measured``: at the cycle's own poses, by models that it did not make; None for a calibration.
    ``true``: at check poses that were never measured; None without a truth.
    ``drift``, ``sigma``: (k,) since the cold reference, SI.
    """

    entry: Entry
    document: Document
    hours: float
    measured: CycleErrors | None
    true: CycleErrors | None
    forecast: Document | None
    drift: Array
    sigma: Array


class ThermalHistory:
    """The history of a replayed thermal session.

    ``nominal``: the arm without any calibration. ``start_ns``: first joint reading.
    """

    def __init__(self, history: CalibrationHistory, nominal: SerialArm, start_ns: int) -> None:
        self._history, self._nominal, self._start_ns = history, nominal, start_ns
        entries = sorted(history.list(_EVERY_ENTRY), key=lambda entry: entry.id)
        # what was in force when the recording began has no cycle of its own in it
        self._candidates = [e for e in entries if e.kind == THERMAL and e.stamp_ns >= start_ns]
        self._references = [e for e in entries if e.kind == REFERENCE]
        changes = [
            d for d in history.decisions() if d.kind == THERMAL and d.action is not Action.REJECT
        ]
        # calibration of each thermal revision; None for the nominal model
        self._in_force: dict[int, int | None] = {0: None}
        self._in_force |= {d.head_after: d.calibration_id for d in changes}

    def _model(self, revision: int) -> SerialArm:
        chosen = self._in_force[revision]
        if chosen is None:
            return self._nominal
        return arm_of(self._history.model(chosen), self._nominal)

    def _reference(self, model: Document) -> ColdReference | None:
        """The cold reference that a model counts from; None for one that counts from none."""
        for entry in reversed(self._references if holds_drift(model) else []):
            reference = reference_of(self._history.model(entry.id), self._nominal)
            if reference.data.middle_ns == model["reference_stamp_ns"]:
                return reference
        return None

    def cycles(
        self, forecasts: Forecasts, truth: CheckPoints | None, sigma_m: float
    ) -> list[ReplayedCycle]:
        """Every candidate, in the order in which they were made."""
        last = self._history.head(THERMAL).revision
        following = [entry.based_on for entry in self._candidates[1:]] + [last]
        return [
            self._cycle(entry, after, forecasts, truth, sigma_m)
            for entry, after in zip(self._candidates, following, strict=True)
        ]

    def model_figures(self, share: float, seed: int, mark: str) -> list[Drawn]:
        """Of each full model that was identified: errors before and after, and its joints."""
        found = []
        for entry in self._candidates:
            model, document = self._history.model(entry.id), self._history.document(entry.id)
            if document.get("model") != "full":
                continue
            arm, before = arm_of(model, self._nominal), self._model(entry.based_on)
            data = Measurements.of_arrays(self._history.inputs(entry.id))
            q, *errors = held_out_errors(document, before, arm, data, share=share, seed=seed)
            names = "in force before", "identified model"
            figures = model_figures(
                self._nominal.fk(q)[:, :3, 3],
                dict(zip(names, errors, strict=True)),
                known_model(arm),
            )
            found += [Drawn.of(n, MODEL_CAPTIONS[n] + mark, f) for n, f in figures.items()]
        return found

    def _cycle(
        self,
        entry: Entry,
        after: int,
        forecasts: Forecasts,
        truth: CheckPoints | None,
        sigma_m: float,
    ) -> ReplayedCycle:
        model, document = self._history.model(entry.id), self._history.document(entry.id)
        reference = self._reference(model)
        before, arm = self._model(entry.based_on), arm_of(model, self._nominal)
        cold = self._nominal if reference is None else reference.cell.arm
        start_ns = self._start_ns
        measured = true = forecast = None
        if reference is not None:
            start_ns = reference.data.middle_ns
            data = Measurements.of_arrays(self._history.inputs(entry.id))
            rejected = document["held_out_rejected"]
            errors = measured_errors(
                reference, data, [cold, before], left_out=rejected, sigma_m=sigma_m
            )
            measured = CycleErrors(*errors) if len(errors[0]) else None
            first_ns = entry.stamp_ns if data.stamp_ns is None else int(data.stamp_ns.min())
            forecast = forecasts.at(first_ns)
            moved = None if truth is None else truth.moved(entry.stamp_ns)
            if truth is not None and moved is not None:
                with_models = [
                    true_errors(cold, arm_then, truth.q, truth.tool, moved)
                    for arm_then in (before, self._model(after))
                ]
                true = CycleErrors(moved, *with_models)
        sigma = np.sqrt(np.diag(model["covariance"]))
        known = dict(zip(model["parameters"], sigma, strict=True))  # held ones have none
        return ReplayedCycle(
            entry=entry,
            document=document,
            hours=(entry.stamp_ns - start_ns) / HOUR_NS,
            measured=measured,
            true=true,
            forecast=forecast,
            drift=cold.parameters.read(arm.mdh - cold.mdh),
            sigma=np.array([known.get(name, 0.0) for name in cold.parameters.names]),
        )


def thermal_document(cycles: Sequence[ReplayedCycle], arm: SerialArm) -> Document:
    """Every cycle, the errors of all of them together, and how many the forecast bounded."""
    measured = [(c, c.measured) for c in cycles if c.measured is not None]
    true = [(c, c.true) for c in cycles if c.true is not None]
    return {
        "cycles": [_cycle_document(cycle, arm) for cycle in cycles],
        "tolerance_mm": TOLERANCE_MM,
        "measured": _together([errors for _, errors in measured]),
        "true": _together([errors for _, errors in true]),
        "bound": {
            "measured_share": _share_below_bound(measured),
            "true_share": _share_below_bound(true),
        },
    }


def _together(errors: Sequence[CycleErrors]) -> Document | None:
    """Figures over all cycles; None where there are none."""
    if not errors:
        return None
    after = [e.after for e in errors if e.after is not None]
    return CycleErrors(
        np.concatenate([e.without for e in errors]),
        np.concatenate([e.in_force for e in errors]),
        np.concatenate(after) if after else None,
    ).document()


def _share_below_bound(cycles: Sequence[tuple[ReplayedCycle, CycleErrors]]) -> float | None:
    """Share of the errors of the model in force below the 95 % bound expected beforehand."""
    below = [
        np.linalg.norm(errors.in_force, axis=1) <= cycle.forecast["bound_mm"] * 1e-3
        for cycle, errors in cycles
        if cycle.forecast is not None
    ]
    return float(np.mean(np.concatenate(below))) if below else None


def _cycle_document(cycle: ReplayedCycle, arm: SerialArm) -> Document:
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


FORCE = {"thermal": "drift measured and accepted", "tool": "tool measured and accepted"}


def changes_of(
    faults: Sequence[Document], sessions: Sequence[Document], start_s: float
) -> list[tuple[float, str]]:
    """What changed a cell's state, in hours since ``start_s``, and in words.

    Every fault and rollback; of the acceptances of a kind the first one after the beginning and
    after each fault, for a shift has a hundred.
    """
    changes = [
        (one["hours"], f"{one['fault'].replace('_', ' ')} {one['told'] or 'ends'}")
        for one in faults
    ]
    begins = sorted(hours for hours, _ in changes)
    for session in sessions:
        seen = set()
        for one in session["decisions"]:
            hours = (one["stamp"] - start_s) / 3600.0
            since = bisect_right(begins, hours)
            if one["code"] != Code.ACCEPT.name or session["kind"] not in FORCE:
                continue
            if one["command"] == events.ROLLBACK:
                changes.append((hours, f"{session['kind']}: rolled back"))
            elif one["command"] == events.ACCEPT and since not in seen:
                seen.add(since)
                changes.append((hours, FORCE[session["kind"]]))
    return changes


def cell_courses(reader: BagReader, truth: BagTruth) -> list[CellCourse]:
    """The course of the true error of each cell that a bag tells of."""
    if not truth.states:
        return []
    lines = {
        truth.state_topic(above(topic)): topic
        for topic in reader.info.topics
        if topic_kind(topic) == ACCURACY
    }
    start_ns = reader.info.start_ns or 0
    units = {str(fault): (factor, unit) for fault, (_, factor, unit) in SIZES.items()}
    courses = []
    for topic, states in truth.states.items():
        stamps = np.array(states.stamp_ns)
        series = {name: np.array(values) for name, values in states.series.items()}
        bound_mm, tolerance_mm = _line_bound(reader, truth, lines.get(topic), stamps)
        faults = []
        for at_ns, fault, size in states.faults:
            factor, unit = units.get(fault, (1.0, ""))
            words = f"{size / factor:.4g} {unit}".strip() if size else ""
            hours = (at_ns - start_ns) / HOUR_NS
            faults.append({"hours": hours, "fault": fault, "size": size, "told": words})
        courses.append(
            CellCourse(
                topic=topic,
                hours=(stamps - start_ns) / HOUR_NS,
                without_mm=1e3 * series["without_m"],
                with_mm=1e3 * series["with_m"],
                p95_mm=1e3 * series["p95_m"],
                lambda_without=series["lambda_without"],
                lambda_with=series["lambda_with"],
                bound_mm=bound_mm,
                tolerance_mm=tolerance_mm,
                faults=faults,
            )
        )
    return courses


def _line_bound(
    reader: BagReader, truth: BagTruth, topic: str | None, at_ns: Array
) -> tuple[Array, float | None]:
    """What the line read last at each time: 95 % bound, nan where not known; allowed error, mm."""
    stamps, bounds_mm = array("q"), array("d", [math.nan])
    tolerance_mm = None
    if topic is not None:
        with truth.reading(topic):
            for recorded in reader.messages([topic]):
                state = recorded.message
                bound_mm = finite(state.bound_mm, "bound_mm")
                stamps.append(recorded.log_time_ns)
                bounds_mm.append(bound_mm if bound_mm >= 0.0 else math.nan)
                tolerance_mm = finite(state.tolerance_mm, "tolerance_mm")
    return np.array(bounds_mm)[np.searchsorted(stamps, at_ns, side="right")], tolerance_mm
