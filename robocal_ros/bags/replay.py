# SPDX-License-Identifier: Apache-2.0
"""A recorded stream through the thermal session: the live node's results, off line."""

import json
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, TypeVar

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURING,
    TEMPERATURES,
    UNCORRECTED,
    JointBlock,
    stamp_ns,
)
from robocal_ros.session import events
from robocal_ros.session.events import (
    CHANGED,
    Command,
    Outcome,
    SessionBase,
    digest,
    read_command,
    with_changes,
)
from robocal_ros.session.inputs import Between

EVENTS = "session_events"
NOT_BITS = "not to the last bit"


class RecordedMessage(Protocol):
    """A message of a bag: its topic and the message with the attributes of the ROS type.

    In place of messages that follow each other there may be a ``JointBlock``.
    """

    @property
    def topic(self) -> str:
        """Name of the topic."""

    @property
    def message(self) -> Any:
        """The message."""


S = TypeVar("S", bound=SessionBase)


@dataclass
class ReplayReport:
    """What came of a replay.

    ``differs`` lists recorded commands whose result here is not the recorded one, bit for bit.
    ``unheard``: recorded messages, by topic, that were left out: they never came to the session.
    ``lacking``: joint readings that it had, and the recording has not.
    """

    outcomes: list[Outcome] = field(default_factory=list)
    differs: list[str] = field(default_factory=list)
    commands: int = 0
    unheard: Counter[str] = field(default_factory=Counter)
    lacking: int = 0

    @property
    def warnings(self) -> list[str]:
        """That recording and session had not the same, in words."""
        told = [
            f"{count} recorded messages of {topic} never came to the node and are left out"
            for topic, count in self.unheard.items()
        ]
        if self.lacking:
            told.append(
                f"the recording lacks {self.lacking} joint states that the node had: what was made "
                "of them may differ"
            )
        return told


def topic_kind(topic: str) -> str:
    """The input that a topic name stands for: its last part."""
    return topic.rsplit("/", 1)[-1]


def first_configuration(messages: Iterable[RecordedMessage]) -> Command | None:
    """The first configuration among the events: whose they are, and the names of the inputs."""
    for recorded in messages:
        if (event := recorded.message).command == events.CONFIGURE:
            return read_command(event.command, stamp_ns(event.stamp), event.arguments)
    return None


def read_events(
    messages: Iterable[RecordedMessage], from_ns: int = 0
) -> tuple[Command | None, list[tuple[Command, dict[str, Any]]]]:
    """Read the recorded commands, each with its outcome, and the configuration before them.

    A later configuration with another model of other nodes is a command too, without an outcome;
    the thermal one is the thermal session's own.

    ``from_ns`` is the stamp of the first recorded joint reading. What was commanded before it is
    in the bag only because the topic is latched; its samples are not. It is left out, and the
    configuration is the one that it led to.
    """
    configured: Command | None = None
    newest = Command(events.CONFIGURE)
    before = 0  # jumps of the clock
    found: list[tuple[Command, dict[str, Any]]] = []
    for recorded in messages:
        event = recorded.message
        command = read_command(event.command, stamp_ns(event.stamp), event.arguments)
        if command.name == events.CONFIGURE:
            if not found:
                configured, before = command, _jumps(command)
            elif "reference" not in command.arguments:
                command = with_changes(command, newest)
                if command.arguments[CHANGED]:  # another node brought another model into force
                    found.append((command, {}))
            newest = command
        elif (command.stamp_ns or 0) >= from_ns:
            found.append((command, json.loads(event.outcome)))
        elif not found:
            before = _jumps(command)
    return configured, [
        (_counted_from(before, from_ns, command), outcome) for command, outcome in found
    ]


def _jumps(command: Command) -> int:
    return 0 if command.marks is None else command.marks.get(JUMPS, 0)


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

    Raises `InputError` when two topics could be the same input.
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


def needed_inputs(
    configured: Command | None, commands: Iterable[tuple[Command, Mapping[str, Any]]]
) -> set[str]:
    """Inputs without whose samples recorded commands cannot come out as they did.

    Those of which the marks tell samples; motor temperatures only where a learned prior uses them.
    """
    marks = {mark for command, _ in commands for mark in command.marks or {}}
    inputs = {mark.split("/")[0] for mark in marks - {JUMPS}}  # of edges each beam has its own
    config = {} if configured is None else configured.arguments.get("config", {})
    unused = {TEMPERATURES} if config.get("prior", "default") == "default" else set()
    return inputs - unused


@dataclass(frozen=True)
class One:
    """One sample of a recording."""

    topic: str
    message: Any


def one_by_one(
    session: SessionBase, messages: Iterable[RecordedMessage]
) -> Iterator[RecordedMessage]:
    """Samples that may decide something; joint readings that do not, the session takes at once.

    It has the rest of a block of them before the next sample is asked for.
    """
    for recorded in messages:
        block = recorded.message
        if not isinstance(block, JointBlock):
            yield recorded
            continue
        start = session.take_plain(block, 0)
        while start < len(block):
            yield One(recorded.topic, block.sample(start))
            start += 1
            start += session.take_plain(block, start)


def heard_messages(
    messages: Iterable[RecordedMessage],
    commands: Iterable[Command],
    topics: Mapping[str, str] | None,
    unheard: Counter[str],
) -> Iterator[RecordedMessage]:
    """The messages without those that were lost on their way to the session, as commands tell.

    ``topics``: see `feed`. ``unheard``: counts those that are left out, by topic.
    """
    lost: dict[str, list[Between]] = {}
    for command in commands:
        for kind, between in ({} if command.heard is None else command.heard.lost).items():
            lost.setdefault(kind, []).extend((after, before) for after, before in between)
    ends = {kind: np.array(sorted(found), dtype=np.int64).T for kind, found in lost.items()}
    for recorded in messages:
        message, kind = recorded.message, _input(recorded.topic, topics)
        if kind not in ends:
            yield recorded
            continue
        block = isinstance(message, JointBlock)
        stamps = message.stamp_ns if block else np.array([stamp_of(message)])
        after, before = ends[kind]
        place = np.searchsorted(after, stamps) - 1  # of the last one that begins before the stamp
        gone = (place >= 0) & (stamps < before[place])
        if not gone.any():
            yield recorded
            continue
        unheard[recorded.topic] += int(gone.sum())
        if block and not gone.all():
            kept = JointBlock(message.stamp_ns[~gone], message.names, message.position[~gone])
            yield One(recorded.topic, kept)


def stamp_of(message: Any) -> int:
    """Stamp of a message, or of a sample that was made of some, ns."""
    return int(message.stamp_ns if hasattr(message, "stamp_ns") else stamp_ns(message.header.stamp))


def _input(topic: str, topics: Mapping[str, str] | None) -> str:
    return topic_kind(topic) if topics is None else topics.get(topic, "")


def feed(
    session: S,
    recorded: RecordedMessage,
    topics: Mapping[str, str] | None,
    take: Callable[[S, str, Any], None],
) -> None:
    """Give a recorded sample to the session; one that cannot be used is counted.

    ``topics``: see `input_topics`; without it the last part of the name decides.
    """
    take(session, _input(recorded.topic, topics), recorded.message)


def replay(
    session: S,
    messages: Iterable[RecordedMessage],
    commands: Sequence[tuple[Command, Mapping[str, Any]]],
    topics: Mapping[str, str] | None,
    take: Callable[[S, str, Any], None],
) -> ReplayReport:
    """Play samples through a session and carry out commands where they were carried out.

    ``commands``: each with its recorded outcome (empty: none was recorded). Ids of calibrations
    differ between histories; a recorded id is translated to the one given here. What was lost on
    its way to the session is left out.
    ``topics``: see `input_topics`; ``take`` gives a message of an input to the session.
    """
    report = ReplayReport(commands=len(commands))
    obeyed = _Obeyed(session, commands, report)
    heard = heard_messages(messages, [command for command, _ in commands], topics, report.unheard)
    for recorded in one_by_one(session, heard):
        feed(session, recorded, topics, take)
        while obeyed.step():
            pass
    while obeyed.step(force=True):
        pass
    return report


class _Obeyed:
    """Recorded commands, one given to a session after the other."""

    def __init__(
        self,
        session: SessionBase,
        commands: Sequence[tuple[Command, Mapping[str, Any]]],
        report: ReplayReport,
    ) -> None:
        self._session, self._report = session, report
        self._following = iter(commands)
        self._ids: dict[int, int] = {}
        self._joints: tuple[int, int] | None = None  # readings so far, recorded and here
        self._submit()

    def _submit(self) -> None:
        self._awaited = next(self._following, None)
        if self._awaited is None:
            return
        command = self._awaited[0]
        arguments = dict(command.arguments)
        if arguments.get("id"):
            arguments["id"] = self._ids.get(int(arguments["id"]), int(arguments["id"]))
        self._session.submit(replace(command, arguments=arguments))

    def step(self, *, force: bool = False) -> bool:
        """Carry the next command out, if its samples are there; whether it was."""
        if self._awaited is None:
            return False
        done = self._session.step(wall_ns=self._session.newest_joints_ns, force=force)
        if not done:
            return False
        command, recorded = self._awaited
        outcome, report = done[-1], self._report
        report.outcomes.append(outcome)
        lacking = self._lacking(command, outcome)
        report.lacking += max(lacking, 0)
        if recorded:
            if recorded["id"] and outcome.calibration_id:
                self._ids.setdefault(int(recorded["id"]), outcome.calibration_id)
            more = f" (without {lacking} joint states that the node had)" if lacking > 0 else ""
            report.differs += [f"{words}{more}" for words in _difference(outcome, recorded)]
        self._submit()
        return True

    def _lacking(self, command: Command, outcome: Outcome) -> int:
        """Joint readings since the command before that the session had and the recording has not.

        Negative: the recording has more. Of an older recording, and of what a node had before the
        recording or its own restart, nothing is known.
        """
        if command.heard is None or outcome.command.heard is None:
            return 0
        now = command.heard.joints, outcome.command.heard.joints
        before, self._joints = self._joints, now
        if before is None or now[0] < before[0]:
            return 0
        return (now[0] - before[0]) - (now[1] - before[1])


def _difference(outcome: Outcome, recorded: Mapping[str, Any]) -> list[str]:
    """In what an outcome is not the recorded one, in words; empty where it is, bit for bit."""
    counted, bits = (int(outcome.status), outcome.samples), digest(outcome.document)
    same = counted == (recorded["status"], recorded["samples"])
    if same and bits == recorded["digest"]:
        return []
    which = f"{outcome.command.name} at {outcome.command.stamp_ns} ns"
    told, found = recorded["message"], outcome.message
    if same and told == found:
        return [f"{which}: as recorded in its words, {NOT_BITS}: '{told}'"]
    return [f"{which}: recorded '{told}', here '{found}'"]
