# SPDX-License-Identifier: Apache-2.0
"""The cell's register map by Modbus TCP, for gateways of fieldbuses (Profinet, EtherNet/IP).

Modbus has neither users nor encryption: whoever connects from an address that is allowed is the
PLC. It gives the gap, runs and cancels cycles; it decides nothing. Works without ROS and OPC UA:
`Image` is what it reads and acts on. Source: MODBUS Application Protocol V1.1b3, MODBUS Messaging
on TCP/IP V1.0b (modbus.org).
"""

import asyncio
import contextlib
import struct
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

READ_HOLDING, READ_INPUT, WRITE_ONE, WRITE_MANY = 3, 4, 6, 16
ILLEGAL_FUNCTION, ILLEGAL_ADDRESS, ILLEGAL_VALUE, FAILED, BUSY = 1, 2, 3, 4, 6
MOST_CONNECTIONS = 4
IDLE_S = 60.0
LARGEST = 3.4e38  # of a float of four bytes
NO_ANSWER = 255  # in `ANSWER`: not carried out, as the bridge or maintenance_node did not
RUN, CANCEL = 1, 2
HEARTBEAT_AT, REQUEST_AT, HOLDING_WORDS = 0, 2, 8
ANSWER, ANSWERED, CYCLE, VALID = "Answer.Status", "Answer.Number", "LastCycle.Number", "Valid"


@dataclass(frozen=True)
class Register:
    """A value in the map: ``kind`` H is a word, I two words (high one first), f a float in two."""

    address: int
    path: str
    kind: str
    meaning: str


# Addresses stay; new ones come at the end.
INPUTS = (
    Register(0, "Gap.Beat", "I", "Beat: copy it to Heartbeat while the robot may be moved"),
    Register(2, "Active", "H", "1: the bridge acts"),
    Register(3, VALID, "H", "1: what follows is fresh; else it is 0"),
    Register(4, "Accuracy.State", "H", "OK 1, DUE 2, DEGRADED 3, EXPIRED 4, FAULT 5"),
    Register(5, "Maintenance.State", "H", "IDLE 1, RUNNING 2, BREAKING_OFF 3, FAULT 4"),
    Register(6, "Maintenance.AtHome", "H", "1: the robot stands at home"),
    Register(7, "Maintenance.Disarmed", "H", "1: tcf_node is known to be disarmed"),
    Register(8, "Maintenance.FaultCode", "H", "Code of a fault"),
    Register(9, "LastCycle.Code", "H", "How the last cycle that ended did; 0: none has yet"),
    Register(10, CYCLE, "I", "Its number, while another one runs too; 0: its id is none"),
    Register(12, "LastCycle.Complete", "H", "1: nothing is left for the next gap"),
    Register(13, "LastCycle.ThermalCode", "H", "Verdict of the thermal cycle"),
    Register(14, "LastCycle.ToolFoundCode", "H", "The tool as the gap began"),
    Register(15, "LastCycle.ToolCode", "H", "Verdict of the last tool measurement"),
    Register(16, "LastCycle.ToolAnswer", "H", "Of the last quick check"),
    Register(
        17, ANSWER, "H", "Code that answers the request; 0: it is carried out; 255: no answer"
    ),
    Register(18, ANSWERED, "I", "Number of the request that Answer.Status is of"),
    Register(20, "Accuracy.PredictedErrorMm", "f", "rms, mm; -1: not known"),
    Register(22, "Accuracy.BoundMm", "f", "95 % are below, mm; -1: not known"),
    Register(24, "Accuracy.DueInS", "f", "Until the next gap is due, s"),
    Register(26, "Maintenance.LeftS", "f", "Until the gap's end, s"),
    Register(28, "LastCycle.Run", "I", "The how many-th cycle"),
    Register(30, "Candidates.ThermalId", "I", "Thermal candidate that waits; 0: none"),
    Register(32, "Candidates.ToolId", "I", "Tool candidate that waits; 0: none"),
    Register(34, "LastCycle.ThermalId", "I", "Candidate of the last thermal cycle"),
    Register(36, "LastCycle.ToolId", "I", "Candidate of the last tool measurement"),
    Register(
        38, "Fixture.Id", "I", "Candidate of the last fixture measurement, decided or not; 0: none"
    ),
    Register(40, "Fixture.Code", "H", "What that measurement said; 0: none was yet"),
    Register(41, "LastCycle.FixtureCode", "H", "Verdict of the fixture; 0: not measured"),
    Register(42, "LastCycle.FixtureId", "I", "Its candidate of that cycle; 0: none"),
    Register(44, "LastCycle.StationId", "I", "Candidate of the beams that were found again"),
    Register(46, "LastCycle.StationCode", "H", "Of the beams that were found again; 0: not"),
    Register(47, "Tool.State", "H", "CANDIDATE 1, ACCEPTED 2; 0: taught, or none said"),
    Register(48, "Tool.Revision", "I", "Of the tool in force; 0: taught"),
    Register(50, "Tool.XMm", "f", "The tool in force, in the flange frame, mm"),
    Register(52, "Tool.YMm", "f", "The same"),
    Register(54, "Tool.ZMm", "f", "The same"),
    Register(56, "Accuracy.ToleranceMm", "f", "The process allows, mm"),
    Register(58, "Candidates.FixtureId", "I", "Fixture candidate that waits; 0: none"),
)
HOLDINGS = (
    Register(HEARTBEAT_AT, "Heartbeat", "I", "Beat while the robot may be moved, else 0"),
    Register(REQUEST_AT, "Request.Number", "I", "A new one is carried out; 0: none"),
    Register(4, "Request.Command", "H", "1: run, 2: cancel"),
    Register(5, "Request.GapS", "H", "Length of the gap, s"),
    Register(6, "Request.Cycle", "I", "Number of the cycle; its id, not 0"),
)
INPUT_WORDS = 60


class Image(Protocol):
    """The cell as the register map shows it, and what it does for a client."""

    def values(self) -> Mapping[str, Any]:
        """Values by path; those that nobody stands by are left out."""

    def heartbeat(self, writer: str, echo: int) -> int:
        """Pass a heartbeat on; the exception code, 0: done."""

    def end(self, writer: str) -> None:
        """A client is gone."""

    def request(self, writer: str, command: int, cycle: int, gap_s: int) -> Awaitable[int]:
        """Carry out a request; the code that answers it."""


def words_of(registers: Sequence[Register], values: Mapping[str, Any], count: int) -> bytes:
    """Registers as sent, big-endian; without a value 0."""
    data = bytearray(2 * count)
    for register in registers:
        value = values.get(register.path, 0)
        if register.kind == "f":
            value = min(max(value, -LARGEST), LARGEST)
        struct.pack_into(f">{register.kind}", data, 2 * register.address, value)
    return bytes(data)


class ModbusServer:
    """Serves the map to clients of the addresses that are allowed."""

    def __init__(self, image: Image, clients: Sequence[str], tell: Callable[[str], object]) -> None:
        self._image, self._clients, self._tell = image, frozenset(clients), tell
        self._server: asyncio.Server | None = None
        self._writers: set[asyncio.StreamWriter] = set()
        self._tasks: set[asyncio.Task[None]] = set()
        self._holding = bytearray(2 * HOLDING_WORDS)
        self._numbers: dict[str, int] = {}  # of each connection, the request that it wrote last
        self._number = self._answered = self._answer = 0

    @property
    def is_listening(self) -> bool:
        """Whether it does."""
        return self._server is not None

    async def start(self, host: str, port: int) -> None:
        """Listen. Raises `OSError` where the port is taken or refused; it may be tried again."""
        self._server = await asyncio.start_server(self._connected, host, port, limit=1024)

    async def stop(self) -> None:
        """End all connections."""
        if self._server is not None:
            self._server.close()
        for writer in list(self._writers):
            writer.close()
        for task in list(self._tasks):
            task.cancel()

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        peer = str(writer.get_extra_info("peername", ("nobody",))[0])
        if peer not in self._clients or len(self._writers) >= MOST_CONNECTIONS:
            why = "has connections enough" if peer in self._clients else "is not in modbus_clients"
            self._tell(f"Modbus: {peer} {why}")
            writer.close()
            return
        self._writers.add(writer)
        name = f"modbus {peer}:{writer.get_extra_info('peername')[1]}"
        try:
            await self._serve(name, reader, writer)
        except (OSError, asyncio.IncompleteReadError, TimeoutError):
            return  # it is gone, or says nothing
        finally:
            self._writers.discard(writer)
            self._numbers.pop(name, None)
            self._image.end(name)
            writer.close()

    async def _serve(
        self, name: str, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        while True:
            head = await asyncio.wait_for(reader.readexactly(7), IDLE_S)
            transaction, protocol, length, unit = struct.unpack(">HHHB", head)
            if protocol != 0 or not 2 <= length <= 254:
                return  # no Modbus: nothing after it could be found
            body = await asyncio.wait_for(reader.readexactly(length - 1), IDLE_S)
            answer = self._answer_to(name, body)
            writer.write(struct.pack(">HHHB", transaction, 0, len(answer) + 1, unit) + answer)
            await writer.drain()

    def _answer_to(self, name: str, body: bytes) -> bytes:
        function = body[0]
        try:
            code, data = self._carry_out(name, function, body[1:])
        except struct.error:
            code, data = ILLEGAL_VALUE, b""
        return bytes([function | 0x80, code]) if code else bytes([function]) + data

    def _carry_out(self, name: str, function: int, data: bytes) -> tuple[int, bytes]:
        if function in (READ_HOLDING, READ_INPUT):
            first, count = struct.unpack(">HH", data)
            held = bytes(self._holding) if function == READ_HOLDING else self._input_words()
            if not 1 <= count <= 125:
                return ILLEGAL_VALUE, b""
            if 2 * (first + count) > len(held):
                return ILLEGAL_ADDRESS, b""
            found = held[2 * first : 2 * (first + count)]
            return 0, bytes([len(found)]) + found
        if function == WRITE_ONE:
            return ILLEGAL_ADDRESS, b""  # half of a number
        if function != WRITE_MANY:
            return ILLEGAL_FUNCTION, b""
        first, count, size = struct.unpack(">HHB", data[:5])
        if len(data) != 5 + size or size != 2 * count:
            return ILLEGAL_VALUE, b""
        code = self._write(name, first, count, data[5:])
        return code, struct.pack(">HH", first, count)

    def _input_words(self) -> bytes:
        own = {ANSWER: self._answer, ANSWERED: self._answered}
        return words_of(INPUTS, {**self._image.values(), **own}, INPUT_WORDS)

    def _write(self, name: str, first: int, count: int, data: bytes) -> int:
        """The heartbeat, the request, or both: each whole."""
        if (first, count) not in ((HEARTBEAT_AT, 2), (REQUEST_AT, 6), (HEARTBEAT_AT, 8)):
            return ILLEGAL_ADDRESS
        if first == HEARTBEAT_AT:
            (echo,) = struct.unpack(">I", data[:4])
            if code := self._image.heartbeat(name, echo):
                return code
        self._holding[2 * first : 2 * (first + count)] = data
        if count > 2:
            number, command, gap_s, cycle = struct.unpack(">IHHI", data[-12:])
            self._begin(name, number, command, gap_s, cycle)
        return 0

    def _begin(self, name: str, number: int, command: int, gap_s: int, cycle: int) -> None:
        """Carry a request out once: a gateway writes its image again and again.

        What a connection finds in it at first may be of before a restart: it is not carried out.
        """
        before = self._numbers.get(name)
        if number in (0, before):
            self._numbers.setdefault(name, 0)
            return
        self._numbers[name] = self._number = number
        if before is None:
            self._answer, self._answered = NO_ANSWER, number
            return

        async def carry_out() -> None:
            answer = NO_ANSWER
            with contextlib.suppress(Exception):
                answer = await self._image.request(name, command, cycle, gap_s)
            if number == self._number:
                self._answer, self._answered = answer, number

        self._answer, self._answered = 0, number
        task = asyncio.get_running_loop().create_task(carry_out())
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
