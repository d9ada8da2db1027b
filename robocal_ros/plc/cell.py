# SPDX-License-Identifier: Apache-2.0
"""What the PLC's sessions act on: their writes and calls, judged and handed to the node.

Names of refusals are those of OPC UA's status codes (OPC 10000-6, annex A.2). ``now_s`` is
monotonic, ``source_ns`` the wall clock's time that the writer gave.
"""

import asyncio
import contextlib
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, NamedTuple

from asyncua import ua

from robocal_ros.adapter.inputs import BeamLevel, InputTiming, LevelChange
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.plc import modbus
from robocal_ros.plc.access import Role
from robocal_ros.plc.modbus import CYCLE, VALID
from robocal_ros.plc.model import (
    BEAMS,
    BLOCKED,
    HEARTBEAT,
    METHODS,
    METHODS_NODE,
    TIME,
    InformationModel,
    Method,
    arguments_of,
)

ANSWER_S = 0.45  # maintenance_node answers within, or the call may come again
NS = 1_000_000_000
CONTEST_S = 1.0  # a session that wrote so lately still writes
CLOCK_NS = 1_000_000_000  # a beam's time may be so far from this machine's
GOOD = "Good"
INVALID_TIME = "BadInvalidTimestamp"
CONTESTED = "BadInvalidState"


@dataclass(frozen=True)
class Heartbeat:
    """What the PLC's program says of the gap; ``echo`` 0: it is closed."""

    echo: int
    at_s: float


class HeartbeatWrite(NamedTuple):
    """What comes of a write: its status, what is passed on, and why not."""

    status: str
    passed: Heartbeat | None = None
    words: str = ""


@dataclass(frozen=True)
class _Writer:
    at_s: float
    source_ns: int | None


class HeartbeatInput:
    """Passes each write of the heartbeat on once; never one that is not new, but for a 0.

    The heartbeat is one number, so that no client can write half of it: the beat that the program
    has read while the robot may be moved, 0 while it may not.
    """

    def __init__(self) -> None:
        self._writers: dict[str, _Writer] = {}

    def write(self, session: str, echo: int, source_ns: int | None, now_s: float) -> HeartbeatWrite:
        """Take a write of a session.

        A writer that gives times must give later ones: what repeats an old one is a gateway that
        has latched it; a 0 closes the gap all the same. While two sessions write, it is closed,
        whatever they say.
        """
        before = self._writers.get(session)
        if before is not None and before.source_ns is not None:
            closes = None if echo else Heartbeat(0, now_s)
            if source_ns is None:
                return HeartbeatWrite(INVALID_TIME, closes, "without the time that came before")
            if source_ns <= before.source_ns:
                late_s = (before.source_ns - source_ns) * 1e-9
                words = f"{late_s:.3f} s before the last one: repeated, or a clock set back"
                return HeartbeatWrite(INVALID_TIME, closes, words)
        self._writers[session] = _Writer(now_s, source_ns)
        others = [
            name
            for name, writer in self._writers.items()
            if name != session and now_s - writer.at_s <= CONTEST_S
        ]
        if others:
            words = f"{session} and {', '.join(others)} both write it: one PLC alone"
            return HeartbeatWrite(CONTESTED, Heartbeat(0, now_s), words)
        return HeartbeatWrite(GOOD, Heartbeat(echo, now_s))

    def end(self, session: str) -> None:
        """A session is gone, and what it wrote counts no more."""
        self._writers.pop(session, None)


class BeamWrite(NamedTuple):
    """What comes of a write: its status, the edge in it, and why not."""

    status: str
    edge: LevelChange | None = None
    words: str = ""


class BeamInput:
    """Finds the edges in the levels of one beam, each written with its time."""

    def __init__(self, timing: InputTiming) -> None:
        self._timing = timing
        self.restart()

    def restart(self) -> None:
        """What the level was before is not known."""
        self._level = BeamLevel(self._timing)

    def write(self, blocked: bool, source_ns: int | None, wall_ns: int) -> BeamWrite:
        """Take a level that was so at ``source_ns``; ``wall_ns``: this machine's time."""
        if source_ns is None:
            words = "without a time: write it with its source time, or Time beside it"
            return BeamWrite(INVALID_TIME, None, words)
        if abs(source_ns - wall_ns) > CLOCK_NS:
            off_s = (source_ns - wall_ns) * 1e-9
            words = f"{off_s:+.3f} s from this machine's time: synchronise the PLC's clock"
            return BeamWrite(INVALID_TIME, None, words)
        try:
            return BeamWrite(GOOD, self._level.hear(blocked, source_ns))
        except InputError as error:
            return BeamWrite(INVALID_TIME, None, str(error))


@dataclass(frozen=True)
class EdgeWritten:
    """An edge of a beam."""

    beam: str
    edge: LevelChange


@dataclass(frozen=True)
class MethodCalled:
    """A call that waits; ``answer``: with the outputs, or the name of a status; thread-safe."""

    method: Method
    user: str
    fields: Mapping[str, Any]
    answer: "Callable[[list[ua.Variant] | str], None]"
    until_s: float  # by the steady clock; the PLC has been told then that nobody answers


@dataclass(frozen=True)
class Notice:
    """Something a person should read, such as who was turned away."""

    words: str


# Takes what comes from the server's thread; returns at once, raises nothing.
Handover = Callable[[Heartbeat | EdgeWritten | MethodCalled | Notice], None]


class Cell:
    """What sessions act on: carries out their writes and calls, while the bridge is active."""

    def __init__(self, beams: Sequence[str], timing: InputTiming, hand: Handover) -> None:
        self._hand = hand
        self.active = False  # set by the node's thread
        self._heartbeat = HeartbeatInput()
        self.beams = {name: BeamInput(timing) for name in beams}
        self.model: InformationModel

    def restart(self) -> None:
        """What was written before counts no more."""
        for beam in self.beams.values():
            beam.restart()

    def end(self, writer: str) -> None:
        """A session is gone."""
        self._heartbeat.end(writer)

    async def write(self, writer: str, items: Sequence[ua.WriteValue]) -> list[ua.StatusCode]:
        """Carry out the writes of one request of a session; each has its status."""
        times = {
            self.model.writable[item.NodeId]: item.Value.Value.Value
            for item in items
            if self._fault(item) == GOOD and self._path(item).endswith(f".{TIME}")
        }
        results = []
        for item in items:
            status = self._fault(item)
            if status == GOOD:
                status = self._judge(writer, item, times)
            if status == GOOD:
                await self.model.set(self._path(item), item.Value.Value, item.Value.SourceTimestamp)
            results.append(ua.StatusCode(getattr(ua.StatusCodes, status)))
        return results

    def _path(self, item: ua.WriteValue) -> str:
        return self.model.writable.get(item.NodeId, "")

    def _fault(self, item: ua.WriteValue) -> str:
        path, sent = self._path(item), item.Value
        if not path:
            return "BadNotWritable" if self.model.knows(item.NodeId) else "BadNodeIdUnknown"
        if item.AttributeId != ua.AttributeIds.Value or item.IndexRange:
            return "BadWriteNotSupported"
        wanted = self.model.input_types[path]
        if sent is None or sent.Value is None or sent.Value.VariantType is not wanted:
            return "BadTypeMismatch"
        if sent.Value.is_array or sent.Value.Value is None:
            return "BadTypeMismatch"
        if sent.StatusCode is not None and not sent.StatusCode.is_good():
            return "BadWriteNotSupported"  # a value that its writer does not stand by
        return GOOD if self.active else "BadInvalidState"

    def _judge(self, writer: str, item: ua.WriteValue, times: Mapping[str, datetime]) -> str:
        path, value = self._path(item), item.Value.Value.Value
        source_ns = _ns(item.Value.SourceTimestamp)
        if path == HEARTBEAT:
            return self.heartbeat(writer, value, source_ns)
        name, _, part = path.removeprefix(f"{BEAMS}.").rpartition(".")
        if part == BLOCKED:
            at_ns = source_ns or _ns(times.get(f"{BEAMS}.{name}.{TIME}"))
            found = self.beams[name].write(value, at_ns, time.time_ns())
            if found.edge is not None:
                self._hand(EdgeWritten(name, found.edge))
            if found.words:
                self._hand(Notice(f"beam {name} of {writer}: {found.words}"))
            return found.status
        return GOOD

    def heartbeat(self, writer: str, echo: int, source_ns: int | None) -> str:
        """Judge a heartbeat, pass it on where it is new; its status."""
        came = self._heartbeat.write(writer, echo, source_ns, time.monotonic())
        if came.passed is not None:
            self._hand(came.passed)
        if came.words:
            self._hand(Notice(f"heartbeat of {writer}: {came.words}"))
        return came.status

    async def call(
        self, user: str, rights: Role | int, request: ua.CallMethodRequest, until_s: float
    ) -> ua.CallMethodResult:
        """Carry out one call of a user; answered by a time of the steady clock."""
        method = self.model.methods.get(request.MethodId)
        sent = request.InputArguments or []
        if method is None or request.ObjectId != self.model.node_id(METHODS_NODE):
            return _call_result("BadMethodInvalid")
        if rights < method.role:
            words = f"{user} may not call {method.name}: it takes an {method.role.name}"
            self._hand(Notice(words.lower()))
            return _call_result("BadUserAccessDenied")
        fields, status, each = arguments_of(method, sent)
        if status:
            return _call_result(status, each)
        outputs = await self.carry_out(method, user, fields, until_s)
        if isinstance(outputs, str):
            return _call_result(outputs)
        return ua.CallMethodResult(OutputArguments=outputs)

    async def carry_out(
        self, method: Method, user: str, fields: Mapping[str, Any], until_s: float
    ) -> list[ua.Variant] | str:
        """Let the node call; the outputs, or the name of a status."""
        if not self.active:
            return "BadInvalidState"
        left_s = until_s - time.monotonic()
        if left_s <= 0.0:
            return "BadTimeout"
        loop = asyncio.get_running_loop()
        answered: asyncio.Future[list[ua.Variant] | str] = loop.create_future()

        def settle(outputs: list[ua.Variant] | str) -> None:
            if not answered.done():
                answered.set_result(outputs)

        def answer(outputs: list[ua.Variant] | str) -> None:
            with contextlib.suppress(RuntimeError):  # the loop has ended meanwhile
                loop.call_soon_threadsafe(settle, outputs)

        self._hand(MethodCalled(method, user, fields, answer, until_s))
        try:
            return await asyncio.wait_for(answered, left_s)
        except TimeoutError:
            return "BadTimeout"


class RegisterImage:
    """The cell for `ModbusServer`: the same values, heartbeat and calls as by OPC UA."""

    def __init__(self, cell: Cell) -> None:
        self._cell = cell

    def values(self) -> Mapping[str, Any]:
        """Good values by path; a number of the last cycle, where its id is one."""
        found = self._cell.model.good_values()
        found[VALID] = {"Accuracy.State", "Maintenance.State"} <= found.keys()
        cycle = str(found.get("LastCycle.CycleId", ""))
        found[CYCLE] = int(cycle) if cycle.isdecimal() and int(cycle) < 2**32 else 0
        return found

    def heartbeat(self, writer: str, echo: int) -> int:
        """As by OPC UA, without a source time."""
        if not self._cell.active:
            return modbus.FAILED
        return 0 if self._cell.heartbeat(writer, echo, None) == GOOD else modbus.BUSY

    def end(self, writer: str) -> None:
        """What it wrote counts no more."""
        self._cell.end(writer)

    async def request(self, writer: str, command: int, cycle: int, gap_s: int) -> int:
        """Run or cancel."""
        name = {modbus.RUN: "Run", modbus.CANCEL: "Cancel"}.get(command)
        method = next((m for m in METHODS if m.name == name), None)
        if method is None or (command == modbus.RUN and not cycle):
            return int(Code.BAD_INPUT)  # cycle 0 reads as none in `CYCLE`
        fields = {"cycle_id": str(cycle), "gap_s": float(gap_s)} if method.inputs else {}
        until_s = time.monotonic() + ANSWER_S
        outputs = await self._cell.carry_out(method, writer, fields, until_s)
        return modbus.NO_ANSWER if isinstance(outputs, str) else int(outputs[1].Value)


def _call_result(status: str, each: Sequence[str] = ()) -> ua.CallMethodResult:
    return ua.CallMethodResult(
        StatusCode=ua.StatusCode(getattr(ua.StatusCodes, status)),
        InputArgumentResults=[ua.StatusCode(getattr(ua.StatusCodes, one)) for one in each],
    )


def _ns(at: datetime | None) -> int | None:
    if at is None:
        return None
    since = at.replace(tzinfo=at.tzinfo or UTC) - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * NS + since.microseconds * 1000
