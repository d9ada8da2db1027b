# SPDX-License-Identifier: Apache-2.0
"""A PLC as asyncua's own client: its certificate, its user, its program's heartbeat, its calls.

`PlcClient` is one in a thread, `PlcProcess` one in a process of its own.
"""

import asyncio
import contextlib
import logging
import multiprocessing
import os
import socket
import threading
import time
from collections.abc import Coroutine, Sequence
from concurrent.futures import Future
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from asyncua import Client, ua
from asyncua.crypto.security_policies import SecurityPolicyBasic256Sha256

from bench.processes import hand_nice_on
from robocal_ros.plc import access
from robocal_ros.plc.access import Role, Users

OPERATOR, ENGINEER = ("plc", "a plc's password"), ("ada", "an engineer's password")
PASSWORDS = dict((OPERATOR, ENGINEER))
LEAVES_S = 3.0
PROGRAM_S, BEATS_MS = 0.05, 20.0  # the program's cycle; how often its client looks for a beat
NAMESPACE = "urn:robocal_ros:cell"
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


def security_folder(folder: Path) -> Path:
    """As `robocal plc` makes it: an operator, an engineer, two clients that are trusted."""
    access.make_server_certificate(folder, ["localhost", "127.0.0.1"], 30)
    for name in ("line", "panel"):
        access.make_client_certificate(folder, name, 30)
    users = Users(folder)
    users.put(OPERATOR[0], Role.OPERATOR, OPERATOR[1])
    users.put(ENGINEER[0], Role.ENGINEER, ENGINEER[1])
    return folder


def free_port() -> int:
    """A TCP port that nobody listens at."""
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        return int(taken.getsockname()[1])


class PlcClient:
    """One PLC; all of it goes on in a thread of its own, as a PLC does."""

    def __init__(self, folder: Path, port: int, user: str = "plc", name: str = "line") -> None:
        self.folder, self.port, self.user, self.name = folder, port, user, name
        self.beating, self.is_open, self.stamped = False, True, False
        self.written: list[int] = []
        self.called_s: list[float] = []  # that each call of a method took to its answer
        self._beat = 0
        self._came = asyncio.Event()
        self._watched: Client | None = None
        self.index = 2
        self.client: Client
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._thread.start()

    def start(self, work: Coroutine[Any, Any, Any]) -> "Future[Any]":
        """Begin it; nothing waits."""
        return asyncio.run_coroutine_threadsafe(work, self._loop)

    def do(self, work: Coroutine[Any, Any, Any], within_s: float = 15.0) -> Any:
        """Do it, while the graph of this thread stands still."""
        return self.start(work).result(within_s)

    def made(self, user: str | None = None, password: str | None = None) -> Client:
        """A client that has not connected yet."""
        client = Client(f"opc.tcp://127.0.0.1:{self.port}/robocal", timeout=5)
        client.application_uri = f"urn:robocal_ros:client:{self.name}"
        name = user or self.user
        client.set_user(name)
        client.set_password(PASSWORDS[name] if password is None else password)
        return client

    async def secured(self, client: Client) -> Client:
        """The same, signed and encrypted."""
        own = self.folder / access.CLIENTS / f"{self.name}.der"
        await client.set_security(
            SecurityPolicyBasic256Sha256,
            str(own),
            str(own.with_name(f"{self.name}_key.pem")),
            server_certificate=str(self.folder / access.SERVER),
        )
        return client

    async def connect(self) -> None:
        """Begin a session; the one before ends, and so does one that cannot be used."""
        if hasattr(self, "client"):
            await _ended(self.client)
        client = await self.secured(self.made())
        try:
            await client.connect()
            self.index = await client.get_namespace_index(NAMESPACE)
        except BaseException:
            await _ended(client)
            raise
        self.client = client

    async def connect_once_there(self, within_s: float = 60.0) -> None:
        """Again and again, as a PLC does."""
        until_s = time.monotonic() + within_s
        while True:
            try:
                await self.connect()
                return
            except Exception:
                if time.monotonic() > until_s:
                    raise
                await asyncio.sleep(0.2)

    def node(self, path: str) -> Any:
        """Of the cell, by its name."""
        return self.client.get_node(ua.NodeId(f"Cell.{path}", self.index))

    async def read(self, path: str) -> Any:
        """A value; None where nobody has said one yet."""
        found = await self.node(path).read_data_value(raise_on_bad_status=False)
        return None if found.Value is None else found.Value.Value

    async def read_all(self, paths: Sequence[str]) -> list[Any]:
        """In one request."""
        return await self.client.read_values([self.node(path) for path in paths])

    async def write(self, path: str, value: ua.Variant, at: datetime | None = None) -> None:
        """Write a value, with its time or without."""
        await self.node(path).write_value(ua.DataValue(value, SourceTimestamp=at))

    async def call(self, method: str, *arguments: Any) -> list[Any]:
        """As docs/plc.md says: without an answer again, three times."""
        sent = [ua.Variant(a, ua.VariantType.UInt32) if type(a) is int else a for a in arguments]
        for again in range(3):
            begin_s = time.monotonic()
            try:
                return list(await self.node("Methods").call_method(f"{self.index}:{method}", *sent))
            except ua.uaerrors.BadTimeout:
                if again == 2:
                    raise
            finally:
                self.called_s.append(time.monotonic() - begin_s)
        raise AssertionError("never reached")

    def datachange_notification(self, node: Any, value: Any, data: Any) -> None:
        """A beat has come, as asyncua tells a subscription."""
        self._beat = value or 0
        self._came.set()

    async def _watch(self) -> None:
        """Subscribe the beat, of each session anew."""
        if self._watched is not self.client:
            self._beat, client = 0, self.client
            beats = await client.create_subscription(BEATS_MS, self)
            await beats.subscribe_data_change(self.node("Gap.Beat"))
            self._watched = client

    async def program(self) -> None:
        """The PLC's program: it copies the newest beat in each cycle while it gives the gap.

        Beats come by a subscription, so that writing waits for no reading; each is echoed at once.
        """
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._came.wait(), PROGRAM_S)
            self._came.clear()
            if not self.beating:
                continue
            try:
                await self._watch()
                echo = self._beat if self.is_open else 0
                at = datetime.now(UTC) if self.stamped else None
                await self.write("Gap.Heartbeat", ua.Variant(echo, ua.VariantType.UInt32), at)
                self.written.append(echo)
            except Exception as error:
                logging.getLogger(__name__).info("heartbeat: %r", error)  # written again

    def close(self) -> None:
        """Leave."""

        async def leave() -> None:
            self.beating = False
            for task in asyncio.all_tasks() - {asyncio.current_task()}:
                if getattr(task.get_coro(), "__name__", "") == "program":
                    task.cancel()
            if hasattr(self, "client"):
                await _ended(self.client)

        try:
            self.do(leave(), 5.0)
        except Exception as error:  # the server may be gone
            logging.getLogger(__name__).debug("leaves: %s", error)
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5.0)


async def _ended(client: Client) -> None:
    """Leave the server, which may be gone."""
    with contextlib.suppress(Exception):
        await asyncio.wait_for(client.disconnect(), LEAVES_S)


class PlcProcess:
    """A `PlcClient` that shares neither interpreter nor session with who asks it.

    A real PLC has a processor of its own: what goes on here must not hold its heartbeat up. It
    ends with its owner.
    """

    def __init__(
        self, folder: Path, port: int, user: str = OPERATOR[0], name: str = "line"
    ) -> None:
        context = multiprocessing.get_context("spawn")
        self._pipe, other = context.Pipe()
        arguments = other, folder, port, user, name
        self._process = context.Process(target=_serve, args=arguments, daemon=True)
        self._process.start()
        other.close()

    def ask(self, what: str, *arguments: Any) -> None:
        """Ask for what the client can do, by its name."""
        self._pipe.send((what, arguments))

    def answered(self) -> bool:
        """Whether `answer` waits for nothing."""
        return self._pipe.poll()

    def answer(self) -> Any:
        """What was answered; raises `ConnectionError` with the words of what went wrong."""
        done, value = self._pipe.recv()
        if not done:
            raise ConnectionError(value)
        return value

    def close(self) -> None:
        """End its heartbeat and itself."""
        self._pipe.close()
        self._process.join(10.0)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()


def _serve(pipe: Any, folder: Path, port: int, user: str, name: str) -> None:
    """The process of a PLC: until its owner is gone."""
    os.setsid()
    hand_nice_on(os.getpid())
    plc = PlcClient(folder, port, user, name)
    plc.is_open = False
    with contextlib.suppress(EOFError, OSError):
        while True:
            what, arguments = pipe.recv()
            try:
                if what == "give":
                    (plc.is_open,) = arguments
                    found = None
                elif what == "called_s":
                    found = plc.called_s
                elif what == "begin":
                    plc.beating, found = True, None
                    plc.start(plc.program())
                else:
                    found = plc.start(getattr(plc, what)(*arguments)).result()
            except Exception as error:
                pipe.send((False, f"{type(error).__name__}: {error}"))
            else:
                pipe.send((True, found))
    plc.close()
