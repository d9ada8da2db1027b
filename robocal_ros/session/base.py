"""A session's commands in their turn, and the joint readings whose stamps they go by."""

import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from robocal_ros import __version__
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.samples import JOINTS, JUMPS, JointBlock, JointSample, JointStream
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, Decision, Head
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.events import (
    BY,
    CONFIGURE,
    Command,
    Outcome,
    bring_into_force,
    decide,
    joints_awaited_ns,
    outside_decision,
    reached,
    require_robot,
)


class HistoryFollower:
    """Heads of a history as of the last look; a subclass reads those that it is about.

    ``kind``: whose decisions are told.
    ``head``: of that kind. ``fault``: why the history could not be read at the last look; empty
    when it could.
    """

    def __init__(self, history: CalibrationHistory, kind: str) -> None:
        self._history, self._kind = history, kind
        self._version = history.data_version()
        decided = history.decisions(newest=1)
        self._seen = decided[-1].seq if decided else 0
        self.fault = ""
        self._read()

    def _read(self) -> None:
        self.head: Head = self._history.head(self._kind)

    def look(self, own_wall_ns: int | None = None) -> list[Decision]:
        """Take over what was decided since the last look.

        Returns others' decisions about the kind, oldest first; those stamped ``own_wall_ns`` are
        the caller's own. Never raises for the history's sake: see ``fault``.
        """
        try:
            version = self._history.data_version()
            self.fault = ""
            if version == self._version:
                return []
            decided = self._history.decisions(self._seen)
            self._read()
        except RobocalError as error:
            self.fault = str(error)
            return []
        self._version = version
        self._seen = decided[-1].seq if decided else self._seen
        return [d for d in decided if d.kind == self._kind and d.wall_ns != own_wall_ns]


MOST_REASONS = 30
_NUMBER = re.compile(r"(?<![\w.])-?\d[\d.]*(e[+-]?\d+)?")


def kind_of(reason: str) -> str:
    """The reason with '#' for its numbers, which do not tell reasons apart."""
    return _NUMBER.sub("#", reason)


class Ignored(dict[str, Counter[str]]):
    """Counts by topic and reason; numbers (put as '#') do not tell reasons apart."""

    def __init__(self) -> None:
        super().__init__()
        self._last: dict[tuple[str, str], str] = {}

    def add(self, topic: str, reason: str, count: int = 1) -> None:
        """Count samples that are not used."""
        counter = self.setdefault(topic, Counter())
        key = kind_of(reason)
        key = key if key in counter or len(counter) < MOST_REASONS else "other"
        counter[key] += count
        self._last[topic, key] = reason

    def listed(self) -> dict[str, str]:
        """All reasons with their counts and the latest words, as nodes show them."""
        return {
            f"{topic} ignored: {key}": f"{count}, last: {self._last[topic, key]}"
            for topic, counter in self.items()
            for key, count in counter.items()
        }

    def words(self) -> str:
        """Tell the most frequent reason of each topic; empty when nothing was ignored."""
        parts = [
            f"{counter.total()} of {topic} ({self._last[topic, counter.most_common(1)[0][0]]})"
            for topic, counter in self.items()
        ]
        return f"ignored: {', '.join(parts)}" if parts else ""


WHILE = "in force while this was recorded"
GAP_NS = 250_000_000
Handler = Callable[[Command, int], Outcome]


class SessionBase:
    """Base of the sessions that carry out a command as soon as it is given.

    A subclass gives its handlers. A recorded command waits for its marks.

    ``kind``: of the calibrations that it decides about. ``current``: follows what is in force.
    ``stream``: the joint readings. ``received``, ``ignored``: samples by topic, and those that were
    not used. ``newest_ns``: newest stamp of each topic.
    """

    def __init__(
        self, nominal: SerialArm, history: CalibrationHistory, kind: str, current: HistoryFollower
    ) -> None:
        self.nominal, self._history, self._kind = nominal, history, kind
        self._followed = current
        self._queue: list[Command] = []
        self._jumps = 0
        self.stream = JointStream(nominal.joint_names)
        self.newest_ns: dict[str, int] = {}
        self.received: Counter[str] = Counter()
        self.ignored = Ignored()

    def _handlers(self) -> Mapping[str, Handler]:
        """What carries out each command beside the decisions."""
        raise NotImplementedError

    @property
    def in_force(self) -> Head:
        """Head of its kind as the session last saw it."""
        return self._followed.head

    @property
    def fault(self) -> str:
        """Why the history could not be read at the last look; empty when it could."""
        return self._followed.fault

    @property
    def marks(self) -> dict[str, int]:
        """How far the samples have come: newest stamps, and jumps of the clock."""
        return self.newest_ns | {JUMPS: self._jumps}

    @property
    def newest_joints_ns(self) -> int:
        """Stamp of the newest joint reading; 0 before any."""
        return self.newest_ns.get(JOINTS, 0)

    def refuse(self, kind: str, error: RobocalError) -> None:
        """Count a message of an input that cannot be used."""
        self.ignored.add(kind, str(error))

    def _take_joints(self, sample: JointSample) -> bool:
        """Take a reading; tells whether the clock jumped back, which begins everything anew."""
        began = self.stream.add(sample, GAP_NS).began_ns
        newest = self.stream.newest_ns
        if newest is None:
            return False
        before = self.newest_ns.get(JOINTS, newest)
        self.received[JOINTS] += 1
        self.newest_ns[JOINTS] = newest
        if began is None or newest >= before:
            return False
        self._jumps += 1
        self.newest_ns = {JOINTS: newest}
        return True

    def take_plain(self, block: JointBlock, start: int) -> int:
        """Take the joint readings from ``start`` on that decide nothing: how many these are.

        As `add` of each, many times faster. The reading after them is for `add`.
        """
        if self._watches_joints():
            return 0
        marks = self._queue[0].marks if self._queue else None
        awaited_ns = joints_awaited_ns(marks or {}, self.newest_ns)
        count = self.stream.extend(block, start, awaited_ns, GAP_NS)
        if count:
            self.received[JOINTS] += count
            self.newest_ns[JOINTS] = int(block.stamp_ns[start + count - 1])
        return count

    def _watches_joints(self) -> bool:
        """Whether each joint reading may decide something now."""
        raise NotImplementedError

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command; ``step`` carries it out when its samples are complete.

        A command without a stamp gets the newest stamp of the joints, where there is one, so that
        a clock that is off does not matter.
        """
        if command.stamp_ns is None:
            command = replace(command, stamp_ns=self.newest_joints_ns or clock_ns or 0)
        self._queue.append(command)

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""
        return len(self._queue)

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command: what was decided outside before it, and it."""
        if not self._queue or not (force or self._ready(self._queue[0])):
            return []
        command = self._queue.pop(0)
        outside = self.poll()
        if command.marks is None:
            command = replace(command, marks=self.marks)
        decisions = dict.fromkeys((events.ACCEPT, events.REJECT, events.ROLLBACK), self._decide)
        common = {**decisions, events.CONFIGURE: self._reconfigured}
        outcome = events.carried_out({**self._handlers(), **common}, command, wall_ns)
        outside += [outside_decision(d, self.marks) for d in self._followed.look(wall_ns)]
        return [*outside, replace(outcome, revision=self.in_force.revision)]

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""
        return [outside_decision(d, self.marks) for d in self._followed.look()]

    def _ready(self, command: Command) -> bool:
        return command.marks is None or reached(command.marks, self.newest_ns, self._jumps)

    def _decide(self, command: Command, wall_ns: int) -> Outcome:
        return decide(self._history, command, self.in_force.revision, wall_ns, self._kind)

    def _reconfigured(self, command: Command, wall_ns: int) -> Outcome:
        """A thermal model that another node brought into force while this was recorded."""
        model = command.arguments["model"]
        if model is None:
            why = {"by": BY, "reason": WHILE}
            self._history.rollback(to=0, kind=THERMAL, **why, expected_head=None, wall_ns=wall_ns)
        else:
            bring_into_force(self._history, THERMAL, self.nominal, model, __version__, WHILE)
        return Outcome(command, Code.ACCEPT, f"thermal model {WHILE}")


Document = Mapping[str, Any]


def configured_with(
    session: SessionBase, topics: Mapping[str, str], config: Document, in_force: Document
) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    arguments = {
        "robot": session.nominal.name,
        "model_hash": session.nominal.model_hash,
        "topics": dict(topics),
        "config": dict(config),
        **in_force,
    }
    return Command(CONFIGURE, arguments, session.newest_joints_ns, session.marks)


def recorded_arguments(nominal: SerialArm, configured: Command, names: Sequence[str]) -> Document:
    """Arguments of a configuration with ``config`` and these names.

    Raises `WrongRobotError` where the recording was made with another nominal model; `InputError`
    where one is missing.
    """
    require_robot(nominal, configured)
    arguments = configured.arguments
    missing = [name for name in ("config", *names) if name not in arguments]
    if missing:
        raise InputError(f"the recorded configuration lacks {', '.join(missing)}")
    return arguments
