# SPDX-License-Identifier: Apache-2.0
"""Hostile requests to the PLC's bridge and to the page: what nobody may do, and who is nobody.

Each of the bridge's is of a session that is good otherwise, or of none; ``rng`` picks its kind.
"""

import asyncio
import contextlib
import json
import random
import struct
import tempfile
from collections.abc import Awaitable, Callable, Mapping
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import aiohttp
from asyncua import ua

from bench.live.opc_ua import PlcClient, security_folder
from robocal_ros.panel.server import COOKIE, TOKEN
from robocal_ros.plc import access
from robocal_ros.plc.model import METHODS

TYPES = ("Boolean", "Double", "String", "DateTime", "Int32", "UInt32", "Float", "ByteString")
BEAM, WITHIN_S = "x", 5.0
NEWEST = datetime(2100, 1, 1, tzinfo=UTC)  # of heartbeats: any other time is of before


class TakenError(AssertionError):
    """Something that must be refused was taken."""


async def refused(request: Awaitable[Any]) -> None:
    """Wait for its refusal; raises `TakenError` where it was answered well."""
    try:
        found = await request
    except (ua.UaError, TimeoutError, ConnectionError):
        return
    raise TakenError(f"answered: {found}")


def wrong_variant(rng: random.Random, right: str) -> ua.Variant:
    kind = rng.choice([name for name in TYPES if name != right])
    values: dict[str, Any] = {
        "Boolean": True,
        "Double": rng.choice([0.0, float("nan"), float("inf"), 1e300]),
        "String": "x" * rng.choice([0, 1, 1000]),  # all of a request in one message
        "DateTime": datetime.now(UTC),
        "Int32": rng.randint(-(2**31), 2**31 - 1),
        "UInt32": rng.randint(0, 2**32 - 1),
        "Float": 1.5,
        "ByteString": bytes(rng.randrange(1000)),
    }
    value, variant = values[kind], ua.VariantType[kind]
    if rng.random() < 0.3:
        return ua.Variant([value] * rng.randrange(20), variant, is_array=True)
    return ua.Variant(value, variant)


def a_write(rng: random.Random, plc: PlcClient) -> ua.WriteValue:
    """Something that must not be taken: a wrong type, node, attribute, status or range."""
    index = plc.index
    node, right = rng.choice(
        [("Cell.Gap.Heartbeat", "UInt32"), (f"Cell.Beams.{BEAM}.Blocked", "Boolean"),
         (f"Cell.Beams.{BEAM}.Time", "DateTime"), ("Cell.Gap.Beat", ""),
         ("Cell.Accuracy.State", ""), ("Cell.Nowhere", ""), ("Cell.Methods.Run", ""), ("Code", "")]
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


async def bad_writes(rng: random.Random, plc: PlcClient) -> None:
    parameters = ua.WriteParameters()
    parameters.NodesToWrite = [a_write(rng, plc) for _ in range(rng.randint(1, 5))]
    for status in await plc.client.uaclient.write(parameters):
        if status.is_good():
            raise TakenError(f"a write: {parameters.NodesToWrite}")


async def bad_calls(rng: random.Random, plc: PlcClient) -> None:
    method = rng.choice(METHODS)
    index = plc.index
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
    for result in await plc.client.uaclient.call([request]):
        if result.StatusCode.is_good():
            raise TakenError(f"a call: {request}")


async def bad_services(rng: random.Random, plc: PlcClient) -> None:
    """Services that this server has not, and requests of many items."""
    client = plc.client.uaclient
    cell = ua.NodeId("Cell", plc.index)
    node = ua.ReadValueId(NodeId=cell, AttributeId=ua.AttributeIds.BrowseName)

    async def add() -> None:
        item = ua.AddNodesItem(ParentNodeId=cell, BrowseName=ua.QualifiedName("evil"))
        (result,) = await client.add_nodes([item])
        result.StatusCode.check()

    browse = ua.BrowseDescription(NodeId=cell)
    call = ua.CallMethodRequest(cell, cell, [])
    services: list[Callable[[], Awaitable[Any]]] = [
        add,
        lambda: client.delete_nodes(ua.DeleteNodesParameters([ua.DeleteNodesItem(cell)])),
        lambda: client.register_server(ua.RegisteredServer(ServerUri="urn:evil")),
        lambda: client.history_read(ua.HistoryReadParameters()),
        lambda: client.read(ua.ReadParameters(NodesToRead=[node] * 501)),
        lambda: client.browse(ua.BrowseParameters(NodesToBrowse=[browse] * 101)),
        lambda: client.call([]),
        lambda: client.call([call] * 11),
    ]
    await refused(rng.choice(services)())


async def bad_bytes(rng: random.Random, plc: PlcClient) -> None:
    """No OPC UA at all, or a header of gigabytes."""
    hello = b"HELF" + struct.pack("<IIIIIIi", 32, 0, 2**32 - 1, 2**32 - 1, 0, 0, -1)
    words = rng.choice(
        [rng.randbytes(rng.randrange(1, 3000)), b"GET / HTTP/1.1\r\n\r\n", hello,
         b"HELF" + struct.pack("<I", 2**32 - 1) + bytes(70_000),
         b"OPNF" + struct.pack("<II", 5000, 0) + rng.randbytes(5000), b"HELF\0\0\0\0"]
    )  # fmt: skip
    with contextlib.suppress(ConnectionError, TimeoutError):
        reader, writer = await asyncio.open_connection("127.0.0.1", plc.port)
        writer.write(words)
        await asyncio.wait_for(writer.drain(), 2.0)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(reader.read(100), 0.02)
        writer.close()


async def latched(rng: random.Random, plc: PlcClient) -> None:
    """A heartbeat with a time from long before: the newest of this session is of the year 2100."""
    value = ua.Variant(rng.randrange(1, 2**32), ua.VariantType.UInt32)
    at = datetime.fromtimestamp(rng.randrange(2**31), UTC)
    await refused(plc.write("Gap.Heartbeat", value, at))


async def strange_certificates(rng: random.Random, plc: PlcClient) -> None:
    """Clients that nobody trusts, with passwords that are right."""
    with tempfile.TemporaryDirectory() as name:
        elsewhere = await asyncio.to_thread(security_folder, Path(name))
        (elsewhere / access.SERVER).write_bytes((plc.folder / access.SERVER).read_bytes())
        own, plc.folder = plc.folder, elsewhere
        try:
            stranger = await plc.secured(plc.made(rng.choice(["plc", "ada"])))
        finally:
            plc.folder = own
        await refused(stranger.connect())


async def guesses(rng: random.Random, plc: PlcClient) -> None:
    """A trusted client, a name that nobody has, or a password that is none."""
    client = await plc.secured(plc.made(password=f"guess {rng.random()}"))
    client.set_user(f"nobody {rng.random()}")
    await refused(client.connect())


async def strange_sessions(rng: random.Random, plc: PlcClient) -> None:
    """A channel without a session, with another's token, or without encryption."""
    client = plc.made()
    if rng.random() < 0.7:
        await plc.secured(client)
    await client.connect_socket()
    try:
        await client.send_hello()
        await client.open_secure_channel()
        token = plc.client.uaclient.session.authentication_token
        guessed = ua.NodeId(rng.randrange(1000, 1100))
        if client.uaclient.protocol is not None:
            tokens = [token, guessed, ua.NodeId()]
            client.uaclient.protocol.authentication_token = rng.choice(tokens)
        beat = ua.DataValue(ua.Variant(rng.randrange(1, 2**32), ua.VariantType.UInt32))
        item = ua.WriteValue(NodeId=ua.NodeId("Cell.Gap.Heartbeat", plc.index))
        item.AttributeId, item.Value = ua.AttributeIds.Value, beat
        parameters = ua.WriteParameters()
        parameters.NodesToWrite = [item]
        with contextlib.suppress(ua.UaError, TimeoutError, ConnectionError):
            async with asyncio.timeout(WITHIN_S):
                if any(status.is_good() for status in await client.uaclient.write(parameters)):
                    raise TakenError("a heartbeat of no session")
    finally:
        client.disconnect_socket()


async def good_heartbeat(plc: PlcClient) -> None:
    """The next one that is taken: that the gap is not given, with a time that none was after."""
    at = NEWEST + timedelta(seconds=len(plc.written))
    await plc.write("Gap.Heartbeat", ua.Variant(0, ua.VariantType.UInt32), at)
    plc.written.append(0)


async def replayed(rng: random.Random, plc: PlcClient) -> None:
    """A good heartbeat as it was on the wire, sealed: once more, on another connection."""
    protocol = plc.client.uaclient.protocol
    if protocol is None or protocol.transport is None:
        raise ConnectionError("no session")
    wire: list[bytes] = []
    transport = protocol.transport

    class Tapped:
        """Takes down what passes."""

        def write(self, data: bytes) -> None:
            wire.append(bytes(data))
            transport.write(data)

        def __getattr__(self, name: str) -> Any:
            return getattr(transport, name)

    protocol.transport = Tapped()  # type: ignore[assignment]
    try:
        await good_heartbeat(plc)
    finally:
        protocol.transport = transport
    with contextlib.suppress(ConnectionError, TimeoutError):
        reader, writer = await asyncio.open_connection("127.0.0.1", plc.port)
        hello = struct.pack("<IIIIIi", 0, 65536, 65536, 0, 0, -1)
        writer.write(b"HELF" + struct.pack("<I", 8 + len(hello)) + hello)
        for message in wire:
            writer.write(message)
        await asyncio.wait_for(writer.drain(), 2.0)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(reader.read(1000), 0.05)
        writer.close()


Attack = Callable[[random.Random, PlcClient], Awaitable[None]]
ON_A_SESSION: Mapping[str, Attack] = {
    "writes of wrong types, sizes, nodes, ranges, statuses": bad_writes,
    "calls of wrong types, numbers, objects": bad_calls,
    "services that are not there, and too many items": bad_services,
    "bytes that are no OPC UA, headers of gigabytes": bad_bytes,
    "heartbeats with a time of before": latched,
}
OF_STRANGERS: Mapping[str, Attack] = {
    "certificates that nobody trusts": strange_certificates,
    "names and passwords that are guessed": guesses,
    "no session, another's, or no encryption": strange_sessions,
    "heartbeats replayed as they were on the wire": replayed,
}


# ---- the page -----------------------------------------------------------------------------------


class Browser:
    """Requests to the page as a browser makes them, with a login or without."""

    def __init__(self, url: str) -> None:
        self.url, self.token = url, ""
        self._http = aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))
        self._stranger = aiohttp.ClientSession(cookie_jar=aiohttp.DummyCookieJar())

    async def ask(
        self, method: str, path: str, body: Any = None, headers: Mapping[str, str] | None = None
    ) -> tuple[int, str]:
        """The status and the text of an answer; with a cookie in the headers without its own."""
        given = {"Origin": self.url, TOKEN: self.token} | dict(headers or {})
        given.setdefault("Content-Type", "application/json")
        data = body if isinstance(body, bytes) else json.dumps(body).encode()
        http = self._stranger if "Cookie" in given else self._http
        async with http.request(
            method,
            self.url + path,
            headers=given,
            ssl=False,
            allow_redirects=False,
            data=data if method == "POST" else None,
            timeout=aiohttp.ClientTimeout(WITHIN_S),
        ) as answer:
            return answer.status, await answer.text()

    async def login(self, name: str, password: str) -> None:
        """Log in; raises `ConnectionError` where it is refused."""
        status, text = await self.ask("POST", "/login", {"name": name, "password": password})
        if status != 200:
            raise ConnectionError(text)
        self.token = json.loads((await self.ask("GET", "/session"))[1])["token"]

    async def close(self) -> None:
        """Leave."""
        await self._http.close()
        await self._stranger.close()


BODIES: tuple[Any, ...] = (
    {"id": "1"}, {"id": -1}, {"id": 2**40}, {"id": True}, {"id": 1.5}, {"id": None}, {},
    {"id": 1, "reason": 5}, {"id": 1, "reason": {"a": []}}, b"", b"[]", b"null", b"{",
    b"\xff\xfe", b"[" * 4000, b'{"id": NaN}', b'{"id": 1e999}', b" " * 100_000,
)  # fmt: skip
PATHS = (
    "/act/rollback", "/act/../run", "/act/%00", "/../panel.yaml", "/panel.py", "/words.yaml",
    "/%2e%2e/%2e%2e/etc/passwd", "/panel.js/../server.py", "/users.json", "/plc/users.json",
)  # fmt: skip
ACTS = ("run", "cancel", "accept", "reject", "acknowledge")


async def hostile_bodies(rng: random.Random, page: Browser) -> None:
    """An engineer's session, and nothing in it that could be a decision."""
    act = rng.choice(["accept", "reject"])
    status, text = await page.ask("POST", f"/act/{act}", rng.choice(BODIES))
    if status not in (400, 413):
        raise TakenError(f"{status} {text}")


async def hostile_paths(rng: random.Random, page: Browser) -> None:
    """Files and acts that are none."""
    method = rng.choice(["GET", "POST"])
    status, text = await page.ask(method, rng.choice(PATHS), {"id": 1})
    if status not in (401, 403, 404, 405):
        raise TakenError(f"{status} {text}")


async def hostile_origins(rng: random.Random, page: Browser) -> None:
    """A good act of another site, of another name, without the token, without the cookie."""
    headers = rng.choice(
        [{"Origin": "https://evil.example"}, {"Host": "evil.example"}, {TOKEN: "x"}, {TOKEN: ""},
         {"Cookie": f"{COOKIE}=x"}, {"Content-Type": "text/plain"}, {"Origin": "null"}]
    )  # fmt: skip
    status, text = await page.ask("POST", f"/act/{rng.choice(ACTS)}", {"id": 1}, headers)
    if status not in (400, 401, 403, 415, 421):
        raise TakenError(f"{status} {text}")


async def hostile_logins(rng: random.Random, page: Browser) -> None:
    """Names and passwords that are none, and too long."""
    body = rng.choice(
        [{"name": f"nobody {rng.random()}", "password": "x"}, {"name": ["ada"], "password": {}},
         {"name": "x" * 3000, "password": "y"}, {"name": "", "password": ""}, {}]
    )  # fmt: skip
    status, text = await page.ask("POST", "/login", body)
    if status not in (400, 403, 413, 429):
        raise TakenError(f"{status} {text}")


async def hostile_connections(rng: random.Random, page: Browser) -> None:
    """Bytes that are neither TLS nor HTTP."""
    with contextlib.suppress(ConnectionError, TimeoutError):
        _, writer = await asyncio.open_connection("127.0.0.1", int(page.url.rsplit(":", 1)[1]))
        words = rng.randbytes(500), b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01\xff"
        writer.write(rng.choice(words))
        await asyncio.wait_for(writer.drain(), 2.0)
        writer.close()


TO_THE_PAGE: Mapping[str, Callable[[random.Random, Browser], Awaitable[None]]] = {
    "bodies that decide nothing": hostile_bodies,
    "paths that are none": hostile_paths,
    "acts of other sites, without token or cookie": hostile_origins,
    "logins of nobody": hostile_logins,
    "bytes that are no request": hostile_connections,
}
