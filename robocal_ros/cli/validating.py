"""One bag through the code of ``robocal replay``, and judged, for ``robocal validate``.

Runs in a process of its own: a `Job` goes in, a `Validated` comes out, no message between.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from datetime import UTC, datetime
from pathlib import Path

from robocal_ros.bags.bags import BagMessage, BagReader
from robocal_ros.bags.replay import EVENTS, first_configuration, read_events, topic_kind
from robocal_ros.cli.bag_truth import HAND_EYE, TOOL, BagTruth, above, is_simulated
from robocal_ros.cli.output import Document, refusal
from robocal_ros.cli.recorded_robot import find_robot
from robocal_ros.cli.recording import UNASKED, BagOverview, begin_ns, open_recording
from robocal_ros.cli.replaying import ReplayRequest, replay_bag
from robocal_ros.cli.validating_cell import cell_courses
from robocal_ros.cli.validating_cycles import shift_errors, thermal_document
from robocal_ros.cli.validating_parts import (
    as_recorded,
    calibrations,
    decisions,
    require_finite,
    tool_runs,
)
from robocal_ros.cli.validating_thermal import Forecasts, ThermalHistory
from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.hand_eye.recorded import is_hand_eye_session
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.report.validation_figures import Drawn, cell_drawn, thermal_figures, tool_figures
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.seeding import is_thermal_session
from robocal_ros.tool.recorded import is_tool_session

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
