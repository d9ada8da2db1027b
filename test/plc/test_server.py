# SPDX-License-Identifier: Apache-2.0
"""Hostile requests to the server: they change nothing, end nothing, and hand nothing over."""

import asyncio
import contextlib
import gc
import os
import random
import socket
import struct
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua

from bench.live.opc_ua import NAMESPACE, PlcClient, free_port, security_folder
from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.ground.errors import Code
from robocal_ros.plc import access
from robocal_ros.plc.cell import EdgeWritten, MethodCalled
from robocal_ros.plc.inputs import Heartbeat
from robocal_ros.plc.model import METHODS
from robocal_ros.plc.server import LOCKED_AFTER, Door, ServerSettings, ServerThread

REQUESTS = int(os.environ.get("ROBOCAL_PLC_REQUESTS", "300"))
UP_S, QUICK_S = 30.0, 5.0
TYPES = ("Boolean", "Double", "String", "DateTime", "Int32", "UInt32", "Float", "ByteString")
NUMBERS = {"Code": {code.name: int(code) for code in Code}}
OTHERS = ("AccuracyLevel", "MaintenanceState", "ToolState", "ToolAnswer")


class Served:
    """A server whose node takes what is handed over, and answers nothing."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = security_folder(folder), free_port()
        self.handed: list[Any] = []
        numbers = NUMBERS | {name: {"NONE": 0, "ONE": 1} for name in OTHERS}
        timing = InputTiming(0.0, 1e-3)
        settings = ServerSettings("127.0.0.1", self.port, folder, ("x",), timing, numbers)
        self.thread = ServerThread(settings, self.handed.append)
        until_s = time.monotonic() + UP_S
        while not self.thread.state.listening:
            assert time.monotonic() < until_s, self.thread.state.trouble
            time.sleep(0.02)
        self.thread.set_active(True)
        self.plc = PlcClient(folder, self.port, "ada")
        self.plc.do(self.plc.connect())

    @property
    def acted(self) -> list[Any]:
        """What would have moved, decided or said something."""
        return [h for h in self.handed if isinstance(h, (Heartbeat, EdgeWritten, MethodCalled))]

    def works(self) -> None:
        """A good request is answered, quickly."""
        began_s = time.monotonic()
        assert self.plc.do(self.plc.read("Gap.Heartbeat")) == 0
        assert time.monotonic() - began_s < QUICK_S
        assert self.thread.state.listening
        assert self.thread.state.trouble == ""


@pytest.fixture(scope="module")
def served(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    made = Served(tmp_path_factory.mktemp("plc"))
    yield made
    made.plc.close()
    made.thread.stop()
    assert not made.thread._thread.is_alive()


def wrong_variant(rng: random.Random, right: str) -> ua.Variant:
    kind = rng.choice([name for name in TYPES if name != right])
    values: dict[str, Any] = {
        "Boolean": True,
        "Double": rng.choice([0.0, float("nan"), float("inf"), 1e300]),
        "String": "x" * rng.choice([0, 1, 5000]),
        "DateTime": datetime.now(UTC),
        "Int32": rng.randint(-(2**31), 2**31 - 1),
        "UInt32": rng.randint(0, 2**32 - 1),
        "Float": 1.5,
        "ByteString": bytes(rng.randrange(2000)),
    }
    value, variant = values[kind], ua.VariantType[kind]
    if rng.random() < 0.3:
        return ua.Variant([value] * rng.randrange(20), variant, is_array=True)
    return ua.Variant(value, variant)


def a_write(rng: random.Random, served: Served) -> ua.WriteValue:
    """Something that must not be taken: a wrong type, node, attribute, status or range."""
    index = served.plc.index
    node, right = rng.choice(
        [("Cell.Gap.Heartbeat", "UInt32"), ("Cell.Beams.x.Blocked", "Boolean"),
         ("Cell.Beams.x.Time", "DateTime"), ("Cell.Gap.Beat", ""), ("Cell.Accuracy.State", ""),
         ("Cell.Nowhere", ""), ("Cell.Methods.Run", ""), ("Code", "")]
    )  # fmt: skip
    item = ua.WriteValue(NodeId=ua.NodeId(node, index), AttributeId=ua.AttributeIds.Value)
    item.Value = ua.DataValue(wrong_variant(rng, right))
    how = rng.randrange(5)
    if how == 1:
        item.AttributeId = rng.choice([ua.AttributeIds.BrowseName, ua.AttributeIds.AccessLevel])
    elif how == 2:
        item.IndexRange = "0:1"
    elif how == 3 and right == "UInt32":
        good = ua.Variant(7, ua.VariantType.UInt32)
        item.Value = ua.DataValue(good, StatusCode=ua.StatusCode(ua.StatusCodes.BadNoData))
    elif how == 4:
        item.NodeId = ua.NodeId(rng.choice([2253, 2256, 11715, 85, 99999]))
    return item


async def bad_writes(rng: random.Random, served: Served) -> None:
    parameters = ua.WriteParameters()
    parameters.NodesToWrite = [a_write(rng, served) for _ in range(rng.randint(1, 5))]
    for status in await served.plc.client.uaclient.write(parameters):
        assert not status.is_good()


async def bad_calls(rng: random.Random, served: Served) -> None:
    method = rng.choice(METHODS)
    index = served.plc.index
    inputs = [wrong_variant(rng, item.variant_type.name) for item in method.inputs]
    request = ua.CallMethodRequest(
        ua.NodeId("Cell.Methods", index), ua.NodeId(f"Cell.Methods.{method.name}", index), inputs
    )
    how = rng.randrange(4)
    if how == 0 or not inputs:
        request.InputArguments = [*inputs, wrong_variant(rng, "")]
    elif how == 1:
        request.InputArguments = inputs[:-1]
    elif how == 2:
        request.ObjectId = ua.NodeId(rng.choice(["Cell", "Cell.Gap", "Cell.Nowhere"]), index)
    for result in await served.plc.client.uaclient.call([request]):
        assert not result.StatusCode.is_good()


async def bad_services(rng: random.Random, served: Served) -> None:
    """Services that this server has not, and requests of many items."""
    client = served.plc.client.uaclient
    cell = ua.NodeId("Cell", served.plc.index)
    node = ua.ReadValueId(NodeId=cell, AttributeId=ua.AttributeIds.BrowseName)

    async def add() -> None:
        item = ua.AddNodesItem(ParentNodeId=cell, BrowseName=ua.QualifiedName("evil"))
        (result,) = await client.add_nodes([item])
        result.StatusCode.check()

    browse = ua.BrowseDescription(NodeId=cell)
    call = ua.CallMethodRequest(cell, cell, [])
    services: list[Callable[[], Any]] = [
        add,
        lambda: client.delete_nodes(ua.DeleteNodesParameters([ua.DeleteNodesItem(cell)])),
        lambda: client.register_server(ua.RegisteredServer(ServerUri="urn:evil")),
        lambda: client.history_read(ua.HistoryReadParameters()),
        lambda: client.read(ua.ReadParameters(NodesToRead=[node] * 501)),
        lambda: client.browse(ua.BrowseParameters(NodesToBrowse=[browse] * 101)),
        lambda: client.call([]),
        lambda: client.call([call] * 11),
    ]
    with pytest.raises((ua.UaError, TimeoutError)):
        await rng.choice(services)()


async def bad_bytes(rng: random.Random, served: Served) -> None:
    """No OPC UA at all, or a header of gigabytes."""
    hello = b"HELF" + struct.pack("<IIIIIIi", 32, 0, 2**32 - 1, 2**32 - 1, 0, 0, -1)
    words = rng.choice(
        [rng.randbytes(rng.randrange(1, 3000)), b"GET / HTTP/1.1\r\n\r\n", hello,
         b"HELF" + struct.pack("<I", 2**32 - 1) + bytes(70_000),
         b"OPNF" + struct.pack("<II", 5000, 0) + rng.randbytes(5000), b"HELF\0\0\0\0"]
    )  # fmt: skip
    with contextlib.suppress(ConnectionError, TimeoutError):
        reader, writer = await asyncio.open_connection("127.0.0.1", served.port)
        writer.write(words)
        await asyncio.wait_for(writer.drain(), 2.0)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(reader.read(100), 0.02)
        writer.close()


async def latched(rng: random.Random, served: Served) -> None:
    """A heartbeat with a time from long before: the newest of this session is of the year 2100."""
    value = ua.Variant(rng.randrange(1, 2**32), ua.VariantType.UInt32)
    at = datetime.fromtimestamp(rng.randrange(2**31), UTC)
    with pytest.raises(ua.UaStatusCodeError):
        await served.plc.write("Gap.Heartbeat", value, at)


HOSTILE = (bad_writes, bad_calls, bad_services, bad_bytes, latched)


def test_hostile_requests_change_nothing_and_end_nothing(served: Served) -> None:
    rng, plc = random.Random(20), served.plc
    newest = datetime(2100, 1, 1, tzinfo=UTC)
    plc.do(plc.write("Gap.Heartbeat", ua.Variant(0, ua.VariantType.UInt32), newest))
    served.handed.clear()
    nodes = len(served.thread.cell.model._server.iserver.aspace.keys())
    for number in range(REQUESTS):
        hostile = HOSTILE[number % len(HOSTILE)]
        plc.do(hostile(rng, served))
        if number % 25 == 0:
            served.works()
    served.works()
    assert not served.acted
    assert len(served.thread.cell.model._server.iserver.aspace.keys()) == nodes
    assert [s for s in served.thread.state.sessions if not s.startswith("ada")] == []


def test_connections_that_say_nothing_are_few_and_are_cut_off(served: Served) -> None:
    silent = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(40)]
    served.works()
    until_s = time.monotonic() + 15.0
    for each in silent:
        each.settimeout(max(until_s - time.monotonic(), 0.1))
        assert each.recv(1) == b""  # the server has ended it
        each.close()
    other = PlcClient(served.folder, served.port)
    other.do(other.connect_once_there())
    other.close()


def test_sessions_with_wrong_certificates_and_passwords_open_nothing(
    served: Served, tmp_path: Path
) -> None:
    elsewhere = security_folder(tmp_path / "elsewhere")
    (elsewhere / access.SERVER).write_bytes((served.folder / access.SERVER).read_bytes())
    stranger = PlcClient(elsewhere, served.port)
    for _ in range(5):
        with pytest.raises(ua.UaStatusCodeError):
            stranger.do(stranger.connect())
    stranger.close()
    guesser = PlcClient(served.folder, served.port)

    def login(password: str) -> None:
        client = guesser.do(guesser.secured(guesser.made("plc", password)))
        guesser.do(client.connect())

    for number in range(LOCKED_AFTER):
        with pytest.raises(ua.UaStatusCodeError):
            login(f"guess {number}")
    with pytest.raises(ua.UaStatusCodeError):
        login("a plc's password")  # nobody has this name for a while
    assert any("is locked" in notice.words for notice in served.handed if hasattr(notice, "words"))
    guesser.close()
    served.works()


def test_sessions_that_are_begun_and_refused_are_not_kept(served: Served) -> None:
    """Finding: the server kept each of them for ever, of clients that it does not know, too."""

    async def begin(count: int) -> None:
        client = served.plc.made()
        await client.connect_socket()
        try:
            await client.send_hello()
            await client.open_secure_channel()
            for _ in range(count):
                with pytest.raises(ua.UaStatusCodeError):
                    await client.uaclient.create_session(ua.CreateSessionParameters())
            await client.close_secure_channel()
        finally:
            client.disconnect_socket()

    served.plc.do(begin(200))
    gc.collect()
    assert len(served.thread.cell.model._server.iserver.sessions) < 20
    served.works()


def test_names_that_nobody_has_unlock_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finding: a hundred made up names made the wrong passwords of all others forgotten."""
    told: list[Any] = []
    door = Door(tmp_path, told.append)
    monkeypatch.setattr(door, "untrusted", lambda certificate: "")
    monkeypatch.setattr(access.Users, "login", lambda *_: None)  # which takes its time
    for number in range(LOCKED_AFTER):
        assert door.get_user(None, "plc", f"guess {number}") is None
    for number in range(120):
        assert door.get_user(None, f"nobody {number}", "guess") is None
    assert door.get_user(None, "plc", "guess") is None
    assert "'plc' is locked" in told[-1].words


def test_a_call_that_nobody_answers_ends_in_time(served: Served) -> None:
    began_s = time.monotonic()
    with pytest.raises(ua.UaStatusCodeError) as caught:
        served.plc.do(served.plc.call("Run", "4711", 30.0))
    assert type(caught.value).__name__ == "BadTimeout"
    assert time.monotonic() - began_s < QUICK_S
    called, *again = [h for h in served.handed if isinstance(h, MethodCalled)]
    assert len(again) == 2
    assert (called.user, called.fields) == ("ada", {"cycle_id": "4711", "gap_s": 30.0})
    called.answer([])  # too late: nobody waits
    served.works()


def test_a_defect_in_its_thread_is_told_and_the_server_goes_on(served: Served) -> None:
    async def broken(model: Any) -> None:
        raise ZeroDivisionError("of this test")

    served.handed.clear()
    served.thread.post(broken)
    until_s = time.monotonic() + QUICK_S
    while not any("ZeroDivisionError" in str(h) for h in list(served.handed)):
        assert time.monotonic() < until_s
        time.sleep(0.01)
    served.works()


def test_a_port_that_is_taken_is_waited_for(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        numbers = NUMBERS | {name: {"NONE": 0} for name in OTHERS}
        settings = ServerSettings(
            "127.0.0.1", port, security_folder(tmp_path), (), InputTiming(0.0, 1e-3), numbers
        )
        thread = ServerThread(settings, lambda handed: None)
        _until(lambda: thread.state.trouble.startswith("cannot listen"))
    _until(lambda: thread.state.listening)
    plc = PlcClient(tmp_path, port)
    plc.do(plc.connect())
    assert plc.do(plc.client.get_namespace_index(NAMESPACE)) == 2
    plc.close()
    thread.stop()
    assert not thread._thread.is_alive()


def _until(holds: Callable[[], bool]) -> None:
    until_s = time.monotonic() + UP_S
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.02)
