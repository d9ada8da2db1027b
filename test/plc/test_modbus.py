# SPDX-License-Identifier: Apache-2.0
"""The register map, read and written by pymodbus's client as a gateway does."""

import asyncio
import random
import socket
import struct
import threading
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
from pymodbus.client import ModbusTcpClient

from bench.live.opc_ua import free_port
from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.ground.errors import Code
from robocal_ros.plc.cell import Cell, MethodCalled, RegisterImage
from robocal_ros.plc.modbus import (
    BUSY,
    HOLDING_WORDS,
    HOLDINGS,
    ILLEGAL_ADDRESS,
    ILLEGAL_FUNCTION,
    INPUT_WORDS,
    INPUTS,
    NO_ANSWER,
    RUN,
    ModbusServer,
    words_of,
)

WAITS = 8  # a command that is carried out until the test lets it end
VALUES = {"Gap.Beat": 70_000, "Accuracy.State": 1, "Accuracy.BoundMm": 0.25, "Valid": True}


class Recorded:
    """An image that keeps what it is asked."""

    def __init__(self) -> None:
        self.echoes: list[int] = []
        self.requests: list[tuple[int, int, int]] = []
        self.busy = False
        self.goes_on = asyncio.Event()
        self.ended: list[str] = []

    def values(self) -> Mapping[str, Any]:
        return VALUES

    def heartbeat(self, writer: str, echo: int) -> int:
        self.echoes.append(echo)
        return BUSY if self.busy else 0

    def end(self, writer: str) -> None:
        self.ended.append(writer)

    async def request(self, writer: str, command: int, cycle: int, gap_s: int) -> int:
        self.requests.append((command, cycle, gap_s))
        if command == 9:
            raise ZeroDivisionError("of this test")
        if command == WAITS:
            await self.goes_on.wait()
        await asyncio.sleep(0.01)
        return 1


class Served:
    def __init__(self) -> None:
        self.image, self.told, self.port = Recorded(), [], free_port()
        self.loop = asyncio.new_event_loop()
        self.server = ModbusServer(self.image, ["127.0.0.1"], self.told.append)
        threading.Thread(target=self.loop.run_forever, daemon=True).start()
        self.do(self.server.start("0.0.0.0", self.port))
        self.client = ModbusTcpClient("127.0.0.1", port=self.port)
        assert self.client.connect()

    def answered(self, number: int) -> int:
        """What answers a request."""
        until_s = time.monotonic() + 10.0
        while (found := self.inputs())["Answer.Number"] != number or not found["Answer.Status"]:
            assert time.monotonic() < until_s, found
        return int(found["Answer.Status"])

    def do(self, work: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(work, self.loop).result(10.0)

    def inputs(self) -> dict[str, Any]:
        """As a PLC takes its words apart, high word first."""
        words = self.client.read_input_registers(0, count=INPUT_WORDS).registers
        data = struct.pack(f">{INPUT_WORDS}H", *words)
        return {r.path: struct.unpack_from(f">{r.kind}", data, 2 * r.address)[0] for r in INPUTS}


@pytest.fixture
def served() -> Iterator[Served]:
    made = Served()
    yield made
    made.client.close()
    made.do(made.server.stop())
    made.loop.call_soon_threadsafe(made.loop.stop)


def written(number: int, command: int = 1, gap_s: int = 60, cycle: int = 4711) -> list[int]:
    data = struct.pack(">IHHI", number, command, gap_s, cycle)
    return [*struct.unpack(">6H", data)]


def test_the_map_is_whole_and_no_two_values_overlap():
    for registers, words in ((INPUTS, INPUT_WORDS), (HOLDINGS, HOLDING_WORDS)):
        used = [a for r in registers for a in range(r.address, r.address + 1 + (r.kind != "H"))]
        assert used == list(range(words))
    data = words_of(INPUTS, {r.path: 1 for r in INPUTS}, INPUT_WORDS)
    assert data[:4] == b"\0\0\0\1"


def test_the_page_shows_the_map():
    page = (Path(__file__).parents[2] / "docs" / "plc.md").read_text()
    kinds = {"H": "word", "I": "32 bits", "f": "float"}
    for r in (*INPUTS, *HOLDINGS):
        assert f"| {r.address} | `{r.path}`, {kinds[r.kind]} | {r.meaning} |" in page


def test_a_gateway_reads_the_cell(served: Served) -> None:
    found = served.inputs()
    assert (found["Gap.Beat"], found["Accuracy.State"], found["Valid"]) == (70_000, 1, 1)
    assert found["Accuracy.BoundMm"] == 0.25
    assert found["Maintenance.State"] == 0  # nobody stands by it


def test_each_write_of_the_heartbeat_is_passed_on_and_half_of_one_is_not(served: Served) -> None:
    client, image = served.client, served.image
    for echo in (70_001, 0, 70_001):
        assert not client.write_registers(0, [echo >> 16, echo & 0xFFFF]).isError()
    assert image.echoes == [70_001, 0, 70_001]
    assert client.read_holding_registers(0, count=2).registers == [1, 70_001 - 65_536]
    for wrong in (
        client.write_register(0, 1),
        client.write_registers(0, [1]),
        client.write_registers(1, [1, 2]),
        client.write_registers(0, [0] * 9),
        client.write_registers(2, [0, 1]),
        client.read_input_registers(INPUT_WORDS - 1, count=2),
    ):
        assert wrong.exception_code == ILLEGAL_ADDRESS
    assert client.write_coil(0, True).exception_code == ILLEGAL_FUNCTION
    image.busy = True
    assert client.write_registers(0, [0, 5]).exception_code == BUSY
    assert len(image.echoes) == 4


def test_a_request_is_carried_out_once_however_often_the_image_is_written(served: Served) -> None:
    client, image = served.client, served.image

    client.write_registers(2, written(0))
    for _ in range(5):
        assert not client.write_registers(0, [0, 7, *written(1)]).isError()
    assert served.answered(1) == 1
    assert image.requests == [(1, 4711, 60)]
    client.write_registers(2, written(0))
    client.write_registers(2, written(2, command=9))
    assert served.answered(2) == NO_ANSWER  # a defect
    client.write_registers(2, written(3, command=2))
    assert served.answered(3) == 1
    assert image.requests[1:] == [(9, 4711, 60), (2, 4711, 60)]
    assert image.echoes == [7] * 5


def test_a_request_that_is_carried_out_is_named_at_once(served: Served) -> None:
    client, image = served.client, served.image
    client.write_registers(2, written(0))
    client.write_registers(2, written(7))
    assert served.answered(7) == 1
    client.write_registers(2, written(8, command=WAITS))
    found = served.inputs()
    assert (found["Answer.Number"], found["Answer.Status"]) == (8, 0)
    served.loop.call_soon_threadsafe(image.goes_on.set)
    assert served.answered(8) == 1


def test_what_a_connection_finds_latched_is_not_carried_out(served: Served) -> None:
    """It may be of before a restart of the bridge; so of another gateway, each by itself."""
    client, image = served.client, served.image
    client.write_registers(2, written(8, command=2))
    found = served.inputs()
    assert (found["Answer.Number"], found["Answer.Status"]) == (8, NO_ANSWER)
    other = ModbusTcpClient("127.0.0.1", port=served.port)
    assert other.connect()
    other.write_registers(2, written(0))
    for _ in range(3):
        other.write_registers(2, written(3))
        client.write_registers(2, written(8, command=2))
    other.close()
    client.write_registers(2, written(9, command=2))
    assert served.answered(9) == 1
    assert image.requests == [(1, 4711, 60), (2, 4711, 60)]


def test_a_cycle_without_a_number_is_not_run() -> None:
    handed: list[Any] = []
    cell = Cell((), InputTiming(0.0, 1e-3), handed.append)
    cell.active = True
    image = RegisterImage(cell)
    assert asyncio.run(image.request("gateway", RUN, 0, 60)) == Code.BAD_INPUT
    assert not handed
    assert asyncio.run(image.request("gateway", RUN, 1, 60)) == NO_ANSWER
    assert [type(one) for one in handed] == [MethodCalled]


def test_a_value_beyond_four_bytes_is_the_largest() -> None:
    data = words_of(INPUTS, {"Accuracy.BoundMm": 1e300}, INPUT_WORDS)
    at = next(one.address for one in INPUTS if one.path == "Accuracy.BoundMm")
    assert struct.unpack_from(">f", data, 2 * at)[0] == pytest.approx(3.4e38)


def test_hostile_bytes_end_their_connection_alone(served: Served) -> None:
    rng = random.Random(7)
    for number in range(200):
        with socket.create_connection(("127.0.0.1", served.port)) as other:
            other.settimeout(2.0)
            length = rng.randrange(2, 255)
            words = rng.choice(
                [rng.randbytes(rng.randrange(1, 300)), b"GET / HTTP/1.1\r\n\r\n",
                 struct.pack(">HHHB", number, 0, length, 1) + rng.randbytes(length - 1),
                 struct.pack(">HHHB", number, 0, 65535, 1),
                 struct.pack(">HHHBBHHB", number, 0, 8, 1, 16, 0, 8, 250)]
            )  # fmt: skip
            other.sendall(words)
    assert served.inputs()["Gap.Beat"] == 70_000
    assert served.image.requests == []


def test_who_is_not_named_is_not_served_and_four_are_enough() -> None:
    async def tried() -> None:
        told: list[str] = []
        server = ModbusServer(Recorded(), ["127.0.0.2"], told.append)
        port = free_port()
        await server.start("0.0.0.0", port)
        reader, stranger = await asyncio.open_connection("127.0.0.1", port)
        assert await reader.read(1) == b""
        assert told == ["Modbus: 127.0.0.1 is not in modbus_clients"]
        stranger.close()
        await server.stop()
        image = Recorded()
        server = ModbusServer(image, ["127.0.0.1"], told.append)
        await server.start("127.0.0.1", port)
        opened = [await asyncio.open_connection("127.0.0.1", port) for _ in range(5)]
        last = await asyncio.wait_for(opened[-1][0].read(1), 2.0)
        assert last == b""
        assert told[-1] == "Modbus: 127.0.0.1 has connections enough"
        for _, writer in opened:
            writer.close()
        while len(image.ended) < 4:
            await asyncio.sleep(0.01)
        await server.stop()

    asyncio.run(asyncio.wait_for(tried(), 10.0))
