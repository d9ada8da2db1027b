"""A recorded stream through the thermal session: the live node's results, off line."""

import json
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from robocal_ros.core.errors import InputError
from robocal_ros.core.samples import stamp_ns
from robocal_ros.core.thermal.spots import SAME_VISIT_RAD
from robocal_ros.sessions import events
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.observation import Observation
from robocal_ros.sessions.observations import JOINTS, JUMPS, MEASURING
from robocal_ros.sessions.records import digest, read_command
from robocal_ros.sessions.temperatures import TEMPERATURES

EVENTS = "session_events"
UNCORRECTED = "joint_correction"  # in the name of a correction node, and so of its topics
LARGEST_CYCLE = 60  # more poses than this are a calibration, not a measuring cycle


class Recorded(Protocol):
    """A message of a bag: its topic and the message with the attributes of the ROS type."""

    @property
    def topic(self) -> str:
        """Name of the topic."""

    @property
    def message(self) -> Any:
        """The message."""


class Replayed(Protocol):
    """What a session does with commands."""

    @property
    def newest_joints_ns(self) -> int:
        """Time of the data: what a replay's history has in place of the wall clock."""

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command."""

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command."""


S = TypeVar("S", bound=Replayed)


@dataclass
class ReplayReport:
    """What came of a replay.

    ``differs`` lists recorded commands whose result here is not the recorded one, bit for bit.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)
    commands: int = 0


def topic_kind(topic: str) -> str:
    """The input that a topic name stands for: its last part."""
    return topic.rsplit("/", 1)[-1]


def read_events(
    messages: Iterable[Recorded], from_ns: int = 0
) -> tuple[Command | None, list[tuple[Command, dict[str, Any]]]]:
    """Read the recorded commands, each with its outcome, and the configuration before them.

    A later configuration with another thermal model is a command too, without an outcome, where
    the session takes this model from the thermal node.

    ``from_ns`` is the stamp of the first recorded joint reading. What was commanded before it is
    in the bag only because the topic is latched; its samples are not. It is left out, and the
    configuration is the one that it led to.

    Raises
    ------
    InputError
        When an event cannot be read.
    """
    configured: Command | None = None
    model: Any = None
    found: list[tuple[Command, dict[str, Any]]] = []
    for recorded in messages:
        event = recorded.message
        command = read_command(event.command, stamp_ns(event.stamp), event.arguments)
        if command.name == events.CONFIGURE:
            if not found:
                configured = command
            elif _takes_over(command, model):
                found.append((command, {}))
            model = command.arguments.get("model")
        elif (command.stamp_ns or 0) >= from_ns:
            found.append((command, json.loads(event.outcome)))
    before = _jumps(configured)
    return configured, [
        (_counted_from(before, from_ns, command), outcome) for command, outcome in found
    ]


def _takes_over(configured: Command, model: Any) -> bool:
    """Whether another node has brought another thermal model into force than the one before."""
    own = "reference" in configured.arguments
    return not own and configured.arguments.get("model") != model


def _jumps(command: Command | None) -> int:
    return 0 if command is None or command.marks is None else command.marks.get(JUMPS, 0)


def _counted_from(before: int, from_ns: int, command: Command) -> Command:
    """The command with what a replay can wait for.

    Jumps of the clock count from those ``before`` the recording; a topic of which nothing came
    since the recording began, at ``from_ns``, is not awaited.
    """
    marks = {topic: mark for topic, mark in (command.marks or {}).items() if mark >= from_ns}
    return replace(command, marks=marks | {JUMPS: max(_jumps(command) - before, 0)})


def input_topics(topics: Iterable[str], configured: Command | None = None) -> dict[str, str]:
    """Tell which recorded topic is which input of the session: topic name to input.

    The configuration names them; without it the last part of a name decides. Joint states that
    a correction node has un-corrected are never an input.

    Raises
    ------
    InputError
        When two topics could be the same input.
    """
    recorded = {} if configured is None else dict(configured.arguments.get("topics", {}))
    if recorded:
        return {str(topic): str(kind) for kind, topic in recorded.items()}
    found: dict[str, str] = {}
    for topic in sorted(topics):
        kind = topic_kind(topic)
        if kind not in (JOINTS, TEMPERATURES, *MEASURING) or UNCORRECTED in topic:
            continue
        if kind in found.values():
            other = next(name for name, its in found.items() if its == kind)
            raise InputError(f"both {other} and {topic} could be {kind}: record one of them")
        found[topic] = kind
    return found


def feed(
    session: S,
    recorded: Recorded,
    topics: Mapping[str, str] | None,
    take: Callable[[S, str, Any], None],
) -> None:
    """Give a recorded sample to the session; one that cannot be used is counted.

    ``topics``: see `input_topics`; without it the last part of the name decides.
    """
    topic = recorded.topic
    kind = topic_kind(topic) if topics is None else topics.get(topic, "")
    take(session, kind, recorded.message)


def replay(
    session: S,
    messages: Iterable[Recorded],
    commands: Sequence[tuple[Command, Mapping[str, Any]]],
    topics: Mapping[str, str] | None,
    take: Callable[[S, str, Any], None],
) -> ReplayReport:
    """Play samples through a session and carry out commands where they were carried out.

    ``commands``: each with its recorded outcome (empty: none was recorded). Ids of calibrations
    differ between histories; a recorded id is translated to the one given here.
    ``topics``: see `input_topics`; ``take`` gives a message of an input to the session.
    """
    report = ReplayReport(commands=len(commands))
    expected = iter(commands)
    ids: dict[int, int] = {}
    awaited = _submit_next(session, expected, ids)
    for recorded in messages:
        feed(session, recorded, topics, take)
        while awaited is not None and (done := session.step(wall_ns=session.newest_joints_ns)):
            awaited = _take(session, report, done, awaited, expected, ids)
    while awaited is not None:
        done = session.step(wall_ns=session.newest_joints_ns, force=True)
        awaited = _take(session, report, done, awaited, expected, ids)
    return report


def _submit_next(
    session: Replayed,
    expected: Iterator[tuple[Command, Mapping[str, Any]]],
    ids: Mapping[int, int],
) -> Mapping[str, Any] | None:
    following = next(expected, None)
    if following is None:
        return None
    command, outcome = following
    arguments = dict(command.arguments)
    if arguments.get("id"):
        arguments["id"] = ids.get(int(arguments["id"]), int(arguments["id"]))
    session.submit(Command(command.name, arguments, command.stamp_ns, command.marks))
    return outcome


def _take(
    session: Replayed,
    report: ReplayReport,
    done: list[Outcome],
    recorded: Mapping[str, Any],
    expected: Iterator[tuple[Command, Mapping[str, Any]]],
    ids: dict[int, int],
) -> Mapping[str, Any] | None:
    outcome = done[-1]
    report.outcomes.append(outcome)
    if recorded:
        if recorded["id"] and outcome.calibration_id:
            ids.setdefault(int(recorded["id"]), outcome.calibration_id)
        here = (int(outcome.status), outcome.samples, digest(outcome.document))
        if here != (recorded["status"], recorded["samples"], recorded["digest"]):
            report.differs.append(
                f"{outcome.command.name} at {outcome.command.stamp_ns} ns: recorded "
                f"'{recorded['message']}', here '{outcome.message}'"
            )
    return _submit_next(session, expected, ids)


def window_commands(
    cold: tuple[int, int] | None, warm: Sequence[tuple[int, int]]
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Commands for time windows (from, to; ns): the cold reference, then one cycle each."""
    commands: list[tuple[Command, Mapping[str, Any]]] = []
    if cold is not None:
        arguments = {"from_ns": cold[0], "by": "replay"}
        commands.append((Command(events.CAPTURE_REFERENCE, arguments, cold[1]), {}))
    for number, (start, end) in enumerate(warm, start=1):
        arguments = {"from_ns": start, "cycle_id": f"window-{number}"}
        commands.append((Command(events.IDENTIFY, arguments, end), {}))
    return commands


def automatic_commands(
    observations: Sequence[Observation],
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Find the cycles of a recording without commands.

    Poses that recur from cycle to cycle: the first visit is the cold reference, each later one
    a warm cycle. Otherwise everything is one calibration.

    Raises
    ------
    InputError
        When nothing was observed.
    """
    if not observations:
        raise InputError("no measurement at standstill in this recording")
    starts = _cycle_starts(observations)
    end = observations[-1].stamp_ns
    if len(starts) < 2:
        return window_commands(None, [(observations[0].stamp_ns, end)])
    edges = [observations[i].stamp_ns for i in starts]
    last = [observations[i - 1].stamp_ns for i in starts[1:]] + [end]
    windows = list(zip(edges, last, strict=True))
    return window_commands(windows[0], windows[1:])


def _cycle_starts(observations: Sequence[Observation]) -> list[int]:
    """Index of the first observation of each cycle; one alone when poses do not recur."""

    def same(a: Observation, b: Observation) -> bool:
        near = np.max(np.abs(a.q - b.q)) < SAME_VISIT_RAD
        return a.target == b.target and bool(near)

    first = observations[0]
    limit = min(len(observations), LARGEST_CYCLE + 1)
    length = next((i for i in range(1, limit) if same(first, observations[i])), None)
    if length is None:
        return [0]
    starts = [i for i, o in enumerate(observations) if same(first, o)]
    known = observations[:length]
    recurring = sum(any(same(o, k) for k in known) for o in observations[length:])
    return starts if recurring >= 0.9 * len(observations[length:]) else [0]
