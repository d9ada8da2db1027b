# SPDX-License-Identifier: Apache-2.0
"""Commands to a session, what came of them, and who carries them out: the record that replay obeys.

Decisions about calibrations are commands to the history. A session carries its commands out in
their turn, as far as the joint readings have come.
"""

import hashlib
import json
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from typing import Any

from robocal_ros import __version__
from robocal_ros.ground.errors import Code, InputError, RobocalError, WrongRobotError
from robocal_ros.ground.samples import JOINTS, JUMPS, JointBlock, JointSample, JointStream
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import (
    BEFORE_ANY,
    THERMAL,
    TOOL,
    CalibrationState,
    Decision,
    Head,
    Proposal,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.session.inputs import Between, Heard, Ignored

CONFIGURE = "configure"
CALIBRATE_SENSOR = "calibrate_sensor"
CAPTURE_REFERENCE = "capture_reference"
IDENTIFY = "identify"
BEGIN_CYCLE = "begin_cycle"
END_CYCLE = "end_cycle"
MEASURE_TOOL = "measure_tool"
STEP_BEGINS = "step_begins"
TOOL_STEP = "tool_step"
BREAK_OFF = "break_off"
TOUCH, SOLVE_TOUCHES, CLEAR_TOUCHES = "touch", "solve_touches", "clear_touches"
SWEEP, SOLVE_SWEEPS, CLEAR_SWEEPS = "sweep", "solve_sweeps", "clear_sweeps"
LEFT_PLAN = "left_plan"  # argument of it: the robot was stopped because it left its plan
START = "start"
CAPTURE = "capture"
SAMPLE = "sample"
REMOVE = "remove"
CALIBRATE = "calibrate"
LOAD = "load"
ACCEPT = "accept"
REJECT = "reject"
ROLLBACK = "rollback"
WITHHOLD = "withhold"  # a candidate waits for a person
LEAVE = "leave"  # what does not fit a gap
CYCLE = (IDENTIFY, END_CYCLE)
SET_UP = (CALIBRATE_SENSOR, CAPTURE_REFERENCE)  # with the cold robot
MEASURED = (IDENTIFY, END_CYCLE, *SET_UP)  # wait for the last measurements


@dataclass(frozen=True)
class Command:
    """Something asked of a session."""

    name: str  # one of the constants of this module
    arguments: Mapping[str, Any] = field(default_factory=dict)  # plain values (JSON)
    # data time of the command: only samples up to it count. None: the newest stamp known when the
    # session takes the command.
    stamp_ns: int | None = None
    # newest stamp taken from each topic when the command was carried out; None until then. A
    # recorded command carries them, so that replay uses the same samples.
    marks: Mapping[str, int] | None = None
    heard: Heard | None = None  # once it was carried out; older recordings have none


@dataclass(frozen=True)
class Outcome:
    """A command carried out."""

    command: Command
    status: Code  # ACCEPT when done, else why not
    message: str
    document: Mapping[str, Any] | None = None  # the identification, where one was made
    # calibration_id, revision: what was proposed or decided, and the revision now in force
    calibration_id: int = 0
    revision: int = 0
    samples: int = 0
    outside: bool = False  # decided in the history by another process; nobody asked this session
    repeated: bool = False  # the answer of an earlier command, given again; nothing was done

    @property
    def left_plan(self) -> bool:
        """Whether the robot was stopped because it left its plan: it may be held, or hit."""
        return bool(self.command.arguments.get(LEFT_PLAN, False))

    @property
    def done(self) -> bool:
        """Whether the command did what was asked."""
        return self.status is Code.ACCEPT


def carried_out(
    handlers: Mapping[str, Callable[[Command, int], Outcome]], command: Command, wall_ns: int
) -> Outcome:
    """What the command's handler makes of it; what it refuses is its outcome."""
    try:
        if command.name not in handlers:
            raise InputError(f"unknown command '{command.name}'; known: {', '.join(handlers)}")
        return handlers[command.name](command, wall_ns)
    except RobocalError as error:
        return Outcome(command, error.code, str(error))


def reached(wanted: Mapping[str, int], marks: Mapping[str, int]) -> bool:
    """Whether samples, which have come to ``marks``, are as far as a recorded command wants."""
    jumps = marks[JUMPS] - wanted.get(JUMPS, 0)
    near = all(marks.get(topic, -1) >= mark for topic, mark in wanted.items() if topic != JUMPS)
    return jumps > 0 or (jumps == 0 and near)


VERSION = 1


def _text(document: Mapping[str, Any]) -> str:
    return json.dumps(document, allow_nan=False, sort_keys=True)


def digest(document: Mapping[str, Any] | None) -> str:
    """Fingerprint of a document, equal when every number is equal to the last bit."""
    if document is None:
        return ""
    return hashlib.sha256(_text(document).encode()).hexdigest()[:16]


def arguments_text(command: Command) -> str:
    """Arguments and marks of a command as JSON, with the version of this form."""
    marks = dict(command.marks or {})
    record = {"version": VERSION, "arguments": dict(command.arguments), "marks": marks}
    return _text(record if command.heard is None else record | {"heard": asdict(command.heard)})


def outcome_text(outcome: Outcome) -> str:
    """What came of a command as JSON; the document by its fingerprint."""
    return _text(
        {
            "status": int(outcome.status),
            "message": outcome.message,
            "id": outcome.calibration_id,
            "revision": outcome.revision,
            "samples": outcome.samples,
            "digest": digest(outcome.document),
        }
    )


def read_command(name: str, stamp_ns: int, arguments: str) -> Command:
    """Read a recorded command.

    Raises `InputError` when the text is no such record, or of a newer version.
    """
    try:
        record = json.loads(arguments)
        if record["version"] != VERSION:
            raise InputError(
                f"session event '{name}' has version {record['version']}; this software knows "
                f"version {VERSION}: replay it with the software that recorded it"
            )
        marks = {str(topic): int(mark) for topic, mark in record["marks"].items()}
        heard = Heard(**record["heard"]) if "heard" in record else None
        return Command(name, dict(record["arguments"]), stamp_ns, marks, heard)
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"session event '{name}' cannot be read: {error}") from error


BY = "replay"


WHY = "in force when the recording began"


# By kind of session: an argument that only its configuration has.
OWN = {"thermal": "tracker", "tool": "healthy", "hand_eye": "sensor", "fixture": "fixture"}


def session_kind(configured: Command | None) -> str:
    """Which kind of session recorded a configuration; empty where that is not known."""
    arguments = {} if configured is None else configured.arguments
    return next((kind for kind, own in OWN.items() if own in arguments), "")


def require_robot(nominal: SerialArm, configured: Command) -> None:
    """Refuse a robot that the recording was not made with: `WrongRobotError` names both models."""
    recorded = str(configured.arguments.get("model_hash", ""))
    if recorded != nominal.model_hash:
        raise WrongRobotError(
            f"this was recorded with robot '{configured.arguments.get('robot', '')}' of nominal "
            f"model {recorded}; '{nominal.name}' is {nominal.model_hash}"
        )


def seeded(
    history: CalibrationHistory,
    nominal: SerialArm,
    in_force: Mapping[str, Mapping[str, Any] | None],
    software: str,
) -> bool:
    """Bring what was in force, by its kind, into an empty history; whether it was empty.

    Called once all else of the recording was read: what is left in a history after a failure would
    be taken for the user's own at the next try.
    """
    if history.list(1):
        return False
    for kind, model in in_force.items():
        bring_into_force(history, kind, nominal, model, software)
    return True


def bring_into_force(
    history: CalibrationHistory,
    kind: str,
    nominal: SerialArm,
    model: Mapping[str, Any] | None,
    software: str,
    why: str = WHY,
) -> None:
    """Accept what was in force when, or while, a recording was made; None: nothing was."""
    if model is None:
        return
    calibration_id = history.propose(
        Proposal(
            kind=kind,
            model_hash=nominal.model_hash,
            based_on=history.head(kind).revision,
            cycle_id="",
            stamp_ns=0,
            created_ns=0,
            software=software,
            method="",
            code=Code.ACCEPT,
            reason=why,
            document={},
            model=model,
        )
    )
    history.accept(calibration_id, by=BY, reason=why, expected_head=None, wall_ns=0)


FIRST = {THERMAL: "identify", TOOL: "measure"}  # what gives a candidate of a kind
ONLY, NEWEST = "only", "newest"  # which pending candidate a command without an id is about


def decide(
    history: CalibrationHistory, command: Command, expected: int, wall_ns: int, kind: str = THERMAL
) -> Outcome:
    """Accept, reject or roll back a calibration of a kind whose revision in force is ``expected``.

    A command with ``choose`` (`ONLY`, `NEWEST`) in place of an id is about a candidate that is
    pending now, not when it was given. The outcome's command says which: replay obeys that.

    Raises `RobocalError` when the history refuses.
    """
    command = named(history, command, kind)
    arguments = command.arguments
    if "refused" in arguments:
        return Outcome(command, Code.CONFLICT, str(arguments["refused"]))
    chosen = int(arguments.get("id", 0))
    by, why = str(arguments.get("by", "")), str(arguments.get("reason", ""))
    try:
        if command.name != ROLLBACK and (own := history.get(chosen).kind) != kind:
            raise InputError(f"calibration {chosen} is of kind {own}, not {kind}")
        if command.name == REJECT:
            history.reject(chosen, by=by, reason=why, wall_ns=wall_ns)
            return Outcome(command, Code.ACCEPT, f"calibration {chosen} rejected", None, chosen)
        if command.name == ACCEPT:
            head = history.accept(
                chosen,
                by=by,
                reason=why,
                expected_head=expected,
                wall_ns=wall_ns,
                with_heads=history.measured_with(chosen),
            )
        else:
            head = history.rollback(
                None if arguments.get("previous", False) else chosen,
                by=by,
                reason=why,
                expected_head=expected,
                wall_ns=wall_ns,
                kind=kind,
            )
    except RobocalError as error:
        return Outcome(command, error.code, str(error))
    chosen = head.calibration_id or 0
    what = f"calibration {chosen}" if chosen else BEFORE_ANY.get(kind, "nothing")
    message = f"revision {head.revision}: {what} in force"
    return Outcome(command, Code.ACCEPT, message, None, chosen, head.revision)


def named(history: CalibrationHistory, command: Command, kind: str) -> Command:
    """Put the candidate's id, or why there is none (``refused``), in place of ``choose``."""
    if "choose" not in command.arguments:
        return command
    arguments = dict(command.arguments)
    undecided = history.undecided(kind)
    pending = [entry.id for entry in undecided if entry.state is CalibrationState.PENDING]
    pending = pending or [entry.id for entry in undecided[:1]]  # its refusal says why it is stale
    choose = arguments.pop("choose")
    if not pending:
        first = FIRST.get(kind, "calibrate")
        arguments["refused"] = f"no fresh candidate is pending: {first} first"
    elif choose == ONLY and len(pending) > 1:
        found = ", ".join(map(str, pending))
        arguments["refused"] = (
            f"exactly one fresh candidate must be pending, found {found}: decide by id"
        )
    else:
        arguments["id"] = pending[0]
    return replace(command, arguments=arguments)


def outside_decision(decision: Decision, marks: Mapping[str, int]) -> Outcome:
    """Put another process's decision as a command that was carried out, for the record."""
    chosen = decision.calibration_id or 0
    arguments = {"id": chosen, "by": decision.by, "reason": decision.reason}
    command = Command(decision.action.value, arguments, marks.get(JOINTS, 0), marks)
    message = f"revision {decision.head_after}: decided outside this node"
    return Outcome(command, Code.ACCEPT, message, None, chosen, decision.head_after, outside=True)


class HistoryFollower:
    """Heads of a history as of the last look; a subclass reads those that it is about.

    ``history``, ``kind``: whose decisions are told. ``nominal``: the arm without any calibration.
    ``head``: of that kind; ``thermal``: of the thermal models. ``fault``: why the history could not
    be read at the last look; empty when it could.
    """

    def __init__(self, history: CalibrationHistory, kind: str, nominal: SerialArm) -> None:
        self.history, self.kind, self.nominal = history, kind, nominal
        self._version = history.data_version()
        decided = history.decisions(newest=1)
        self._seen = decided[-1].seq if decided else 0
        self.fault = ""
        self._read()

    def _read(self) -> None:
        self.head: Head = self.history.head(self.kind)
        own = self.kind == THERMAL
        self.thermal: Head = self.head if own else self.history.head(THERMAL)
        self.__dict__.pop("arm", None)

    @property
    def beside(self) -> tuple[Head, ...]:
        """Heads of other nodes' kinds that its own calibrations are measured with."""
        return () if self.kind == THERMAL else (self.thermal,)

    @cached_property
    def arm(self) -> SerialArm:
        """The arm with the thermal model in force; the same one until a look reads heads anew."""
        model = self.thermal.model
        return self.nominal if model is None else arm_of(model, self.nominal)

    def look(self, own_wall_ns: int | None = None) -> list[Decision]:
        """Take over what was decided since the last look.

        Returns others' decisions about the kind, oldest first; those stamped ``own_wall_ns`` are
        the caller's own. Never raises for the history's sake: see ``fault``.
        """
        try:
            version = self.history.data_version()
            self.fault = ""
            if version == self._version:
                return []
            decided = self.history.decisions(self._seen)
            self._read()
        except RobocalError as error:
            self.fault = str(error)
            return []
        self._version = version
        self._seen = decided[-1].seq if decided else self._seen
        return [d for d in decided if d.kind == self.kind and d.wall_ns != own_wall_ns]


WHILE = "in force while this was recorded"
CHANGED = "changed"  # of a recorded configuration: kinds that the one before had otherwise
GAP_NS = 250_000_000
MOST_LOST = 500  # stretches of an input between two commands; the count of the joints tells more
Handler = Callable[[Command, int], Outcome]


class SessionBase:
    """Base of the sessions: commands are carried out in their turn, as soon as they are given.

    A subclass gives its handlers. A recorded command waits for its marks.

    ``kind``: of the calibrations that it decides about. ``current``: follows what is in force.
    ``stream``: the joint readings. ``received``, ``ignored``: samples by topic, and those that were
    not used. ``newest_ns``: newest stamp of each topic.
    """

    def __init__(self, current: HistoryFollower) -> None:
        self.nominal, self._history, self._kind = current.nominal, current.history, current.kind
        self._followed = current
        self._queue: list[Command] = []
        self._jumps = 0
        self.stream = JointStream(self.nominal.joint_names)
        self.newest_ns: dict[str, int] = {}
        self.received: Counter[str] = Counter()
        self.ignored = Ignored()
        self._lost: dict[str, list[Between]] = {}

    def _handlers(self) -> Mapping[str, Handler]:
        """What carries out each command beside the decisions."""
        raise NotImplementedError

    @property
    def in_force(self) -> Head:
        """Head of its kind as the session last saw it."""
        return self._followed.head

    @property
    def revisions_beside(self) -> dict[str, int]:
        """Revisions, by kind, of what other nodes brought into force, as of the last look."""
        return {head.kind: head.revision for head in self._followed.beside}

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

    def lose(self, kind: str, after_ns: int, before_ns: int) -> None:
        """Note that of an input's messages those between two stamps were lost.

        They may be in a recording all the same: a replay leaves out what the session did not have.
        """
        found = self._lost.setdefault(kind, [])
        if len(found) < MOST_LOST:
            found.append((after_ns, before_ns))

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
        awaited_ns = self._joints_awaited_ns()
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

        A command without a stamp gets one, see `_stamp_ns`.
        """
        if command.stamp_ns is None:
            command = replace(command, stamp_ns=self._stamp_ns(clock_ns))
        self._queue.append(command)

    def _stamp_ns(self, clock_ns: int | None) -> int:
        """The newest stamp of the joints, where there is one: a clock that is off does no harm."""
        return self.newest_joints_ns or clock_ns or 0

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""
        return len(self._queue)

    @property
    def ready(self) -> bool:
        """Whether the samples of the next command are complete."""
        return bool(self._queue) and reached(self._wanted(self._queue[0]), self.marks)

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command: what was decided outside before it, and it."""
        if not (self.ready or (force and self._queue)):
            return []
        command = self._queue.pop(0)
        outside = self.poll()
        command = self._completed(command)
        handlers = {**self._handlers(), **dict.fromkeys((ACCEPT, REJECT, ROLLBACK), self._decide)}
        if self._kind != THERMAL:  # whose own commands bring thermal models into force
            handlers[CONFIGURE] = self._reconfigured
        outcome = carried_out(handlers, command, wall_ns)
        if not outcome.repeated:  # it is recorded
            until_ns = (command.marks or {}).get(JOINTS, 0)
            heard = Heard(self.stream.count_until(until_ns), self._lost)
            outcome = replace(outcome, command=replace(outcome.command, heard=heard))
            self._lost = {}
        outside += [outside_decision(d, self.marks) for d in self._followed.look(wall_ns)]
        return [*outside, replace(outcome, revision=self.in_force.revision)]

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""
        return [outside_decision(d, self.marks) for d in self._followed.look()]

    def _wanted(self, command: Command) -> Mapping[str, int]:
        """Marks up to which samples must have come for a command."""
        return command.marks or {}

    def _joints_awaited_ns(self) -> int | None:
        """Stamp of the joint reading with which a command may be ready; None: not by one."""
        wanted_ns = self._wanted(self._queue[0]).get(JOINTS, -1) if self._queue else -1
        return wanted_ns if self.newest_ns.get(JOINTS, -1) < wanted_ns else None

    def _completed(self, command: Command) -> Command:
        """The command as it is recorded: with the marks of its samples."""
        return replace(command, marks=self.marks) if command.marks is None else command

    def _decide(self, command: Command, wall_ns: int) -> Outcome:
        return decide(self._history, command, self.in_force.revision, wall_ns, self._kind)

    def _reconfigured(self, command: Command, wall_ns: int) -> Outcome:
        """What other nodes brought into force while this was recorded."""
        history, changed = self._history, command.arguments[CHANGED]
        for kind in changed:
            model = in_force_beside(command)[kind]
            if model is not None:
                bring_into_force(history, kind, self.nominal, model, __version__, WHILE)
            elif history.head(kind).model is not None:
                why = {"by": BY, "reason": WHILE}
                history.rollback(to=0, kind=kind, **why, expected_head=None, wall_ns=wall_ns)
        return Outcome(command, Code.ACCEPT, f"{', '.join(changed) or 'as before'} {WHILE}")


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
        "revisions": session.revisions_beside,
    }
    return Command(CONFIGURE, arguments, session.newest_joints_ns, session.marks)


def in_force_beside(configured: Command) -> dict[str, Any]:
    """Models, by kind, that a configuration has of other nodes: thermal, and of instruments."""
    arguments = configured.arguments  # of most sessions, and of older recordings, without these
    return {THERMAL: arguments.get("model"), **arguments.get("instruments", {})}


def with_changes(configured: Command, before: Command) -> Command:
    """A configuration with the kinds of other nodes that ``before`` had otherwise.

    The same model brought into force again is another revision; older recordings tell none.
    """
    beside, had = in_force_beside(configured), in_force_beside(before)
    its, had_its = (one.arguments.get("revisions", {}) for one in (configured, before))
    changed = [k for k in beside if beside[k] != had.get(k) or its.get(k) != had_its.get(k)]
    return replace(configured, arguments={**configured.arguments, CHANGED: changed})


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
