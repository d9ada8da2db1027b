# SPDX-License-Identifier: Apache-2.0
"""Hostile requests to the server: they change nothing, end nothing, and hand nothing over."""

import asyncio
import contextlib
import gc
import random
import socket
import threading
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua

from bench.hostile import ON_A_SESSION, good_heartbeat
from bench.live.opc_ua import NAMESPACE, PlcClient, free_port, security_folder
from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.ground.errors import Code
from robocal_ros.plc import access, cell
from robocal_ros.plc import server as plc_server
from robocal_ros.plc.cell import EdgeWritten, Heartbeat, MethodCalled
from robocal_ros.plc.server import (
    MOST_CALLS,
    MOST_STRANGERS,
    Door,
    Login,
    ServerSettings,
    ServerThread,
)

ACTS = (Heartbeat, EdgeWritten, MethodCalled)
REQUESTS = 300  # more of them, of strangers too, against a live cell: `bench.soak_hostile`
UP_S, QUICK_S = 30.0, 5.0
NUMBERS = {"Code": {code.name: int(code) for code in Code}}
OTHERS = ("AccuracyLevel", "MaintenanceState", "ToolState", "ToolAnswer")


class Served:
    """A server whose node takes what is handed over, and answers nothing."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.port = security_folder(folder), free_port()
        self.handed: list[Any] = []
        self.begun_s: list[float] = []  # of each that acts
        numbers = NUMBERS | {name: {"NONE": 0, "ONE": 1} for name in OTHERS}
        timing = InputTiming(0.0, 1e-3)
        settings = ServerSettings("127.0.0.1", self.port, folder, ("x",), timing, numbers)
        self.thread = ServerThread(settings, self._hand)
        until_s = time.monotonic() + UP_S
        while not self.thread.state.listening:
            assert time.monotonic() < until_s, self.thread.state.trouble
            time.sleep(0.02)
        self.thread.set_active(True)
        self.plc = PlcClient(folder, self.port, "ada")
        self.plc.do(self.plc.connect())

    def _hand(self, handed: Any) -> None:
        if isinstance(handed, ACTS):
            self.begun_s.append(time.monotonic())
        self.handed.append(handed)

    def forget(self) -> None:
        """Begin anew to note what is handed over."""
        self.handed.clear()
        self.begun_s.clear()

    @property
    def acted(self) -> list[Any]:
        """What would have moved, decided or said something."""
        return [handed for handed in self.handed if isinstance(handed, ACTS)]

    def works(self, heartbeat: int = 0) -> None:
        """A good request is answered, quickly."""
        began_s = time.monotonic()
        assert self.plc.do(self.plc.read("Gap.Heartbeat")) == heartbeat
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


def test_hostile_requests_change_nothing_and_end_nothing(served: Served) -> None:
    rng, plc = random.Random(20), served.plc
    plc.do(good_heartbeat(plc))
    served.forget()
    nodes = len(served.thread.cell.model._server.iserver.aspace.keys())
    attacks = [*ON_A_SESSION.values()]
    for number in range(REQUESTS):
        plc.do(attacks[number % len(attacks)](rng, plc))
        if number % 25 == 0:
            served.works()
    served.works()
    assert not served.acted
    assert len(served.thread.cell.model._server.iserver.aspace.keys()) == nodes
    assert [s for s in served.thread.state.sessions if not s.startswith("ada")] == []


def test_connections_that_say_nothing_are_few_and_are_cut_off(served: Served) -> None:
    """A PLC finds its place among them, from their address too."""
    silent = [socket.create_connection(("127.0.0.1", served.port)) for _ in range(60)]
    served.works()
    other = PlcClient(served.folder, served.port, "ada")
    other.do(other.connect())
    other.close()
    until_s = time.monotonic() + 15.0
    for each in silent:
        each.settimeout(max(until_s - time.monotonic(), 0.1))
        assert each.recv(1) == b""  # the server has ended it
        each.close()


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

    for number in range(access.LOCKED_AFTER):
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
    for number in range(access.LOCKED_AFTER):
        assert door.admit(Login("plc", f"guess {number}", b"")) is None
    for number in range(120):
        assert door.admit(Login(f"nobody {number}", "guess", b"")) is None
    assert door.admit(Login("plc", "guess", b"")) is None
    assert "'plc' is locked" in told[-1].words


@pytest.mark.parametrize("role", [None, access.Role.OPERATOR])
def test_who_is_taken_out_or_has_another_role_loses_his_session(
    served: Served, role: access.Role | None
) -> None:
    users, password = access.Users(served.folder), "ten letters."
    users.put("guest", access.Role.ENGINEER, password)

    def is_in() -> bool:
        return any(name.startswith("guest") for name in served.thread.state.sessions)

    with contextlib.closing(PlcClient(served.folder, served.port, "guest", "panel")) as guest:
        guest.client = guest.do(guest.secured(guest.made("guest", password)))
        guest.do(guest.client.connect())
        _until(is_in)
        assert guest.do(guest.read("Active")) is True
        if role is None:
            users.remove("guest")
        else:
            users.put("guest", role, password)
        _until(lambda: not is_in())
        served.forget()
        beat = ua.Variant(1, ua.VariantType.UInt32)
        for asked in (guest.call("Accept", 1, "x"), guest.write("Gap.Heartbeat", beat)):
            with pytest.raises((ua.UaError, ConnectionError)):
                guest.do(asked)
    assert not served.acted
    served.works()


def test_a_disk_that_hangs_below_the_users_holds_up_nothing_else(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What is silent is marked by the same loop that looks who may stay."""
    asked, goes_on = threading.Event(), threading.Event()

    def hangs(folder: Path) -> access.Users:
        asked.set()
        assert goes_on.wait(60.0)
        return access.Users(folder)

    monkeypatch.setattr(plc_server, "Users", hangs)
    try:
        assert asked.wait(30.0)
        for active in (False, True):
            served.thread.set_active(active)
            _until(lambda active=active: served.plc.do(served.plc.read("Active")) is active)
    finally:
        goes_on.set()
    served.works()


def test_logins_are_looked_at_in_one_thread(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding: glibc kept the 16 MB of a hash for each thread that had looked at a password."""
    threads: list[int] = []
    look = access.Users.login

    def noted(*arguments: Any) -> Any:
        threads.append(threading.get_ident())
        return look(*arguments)

    monkeypatch.setattr(access.Users, "login", noted)
    for _ in range(4):  # what else goes beside the loop takes the threads by turns
        with contextlib.closing(PlcClient(served.folder, served.port, "ada")) as other:
            other.do(other.connect())
    assert len(threads) == 4
    assert len(set(threads)) == 1


def test_a_client_that_connects_again_leaves_no_session(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither the one before, nor one that it cannot use; the fixture's own stays."""
    state = served.thread.state

    def open_now() -> int:
        gc.collect()
        return sum(name.startswith("ada") for name in state.sessions)

    def become(count: int) -> None:
        until_s = time.monotonic() + UP_S
        while open_now() != count:
            assert time.monotonic() < until_s, state.sessions
            time.sleep(0.05)

    with contextlib.closing(PlcClient(served.folder, served.port, "ada")) as other:
        other.do(other.connect())
        become(2)
        other.do(other.connect())
        become(2)
        monkeypatch.setattr("bench.live.opc_ua.NAMESPACE", "urn:of:nobody")
        with pytest.raises(ValueError, match="urn:of:nobody"):
            other.do(other.connect())
        become(1)


def test_a_client_that_is_gone_without_a_word_gives_its_place_back(
    served: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding: where a PLC lost its power its session ended; its connection stayed, one of 50."""
    server = served.thread.cell.model._server.iserver
    monkeypatch.setattr(server, "min_session_timeout_ms", 1000.0)
    monkeypatch.setattr(server, "max_session_timeout_ms", 1000.0)
    monkeypatch.setattr(server, "max_pending_activation_seconds", 0.0)  # long over in a shift
    with contextlib.closing(PlcClient(served.folder, served.port, "ada")) as other:
        client = other.client = other.do(other.secured(other.made()))
        client._watchdog_intervall = 10.0 * UP_S  # it says nothing by itself
        other.do(client.connect())
        connection = client.uaclient.protocol
        assert connection is not None
        _until(lambda: connection.transport is None)
    served.works()


def test_a_session_whose_socket_is_lost_ends_with_its_subscriptions(served: Served) -> None:
    """Finding: asyncua keeps it for another connection, which may not take it over here."""
    state = served.thread.state
    _until(lambda: len(state.sessions) == 1)  # the fixture's own
    with contextlib.closing(PlcClient(served.folder, served.port, "ada")) as other:
        other.do(other.connect())
        other.do(other._watch())
        _until(lambda: len(state.sessions) == 2)
        other._loop.call_soon_threadsafe(other.client.uaclient.protocol.transport.abort)
        _until(lambda: len(state.sessions) == 1)


def test_a_call_that_nobody_answers_ends_in_time(served: Served) -> None:
    served.forget()
    began_s = time.monotonic()
    with pytest.raises(ua.UaStatusCodeError) as caught:
        served.plc.do(served.plc.call("Run", "4711", 30.0))
    assert type(caught.value).__name__ == "BadTimeout"
    assert time.monotonic() - began_s < QUICK_S
    called, *again = [h for h in served.handed if isinstance(h, MethodCalled)]
    assert len(again) == 2  # as `PlcClient` calls again
    assert (called.user, called.fields) == ("ada", {"cycle_id": "4711", "gap_s": 30.0})
    called.answer([])  # too late: nobody waits
    served.works()


def calls(served: Served, count: int) -> Any:
    """One request of so many calls, which nobody answers; each with its status."""
    index = served.plc.index
    cancel = ua.CallMethodRequest(
        ua.NodeId("Cell.Methods", index), ua.NodeId("Cell.Methods.Cancel", index), []
    )
    return served.plc.client.uaclient.call([cancel] * count)


def test_many_calls_that_nobody_answers_end_with_the_first(served: Served) -> None:
    """Finding: each of them held its session for 0.45 s, one after the other."""
    served.forget()
    found = served.plc.do(calls(served, MOST_CALLS))
    assert {result.StatusCode.name for result in found} == {"BadTimeout"}
    assert len(served.acted) == 1  # nothing that the PLC was told to be late is carried out later

    async def at_once() -> list[Any]:
        requests = [calls(served, 1) for _ in range(MOST_CALLS + 2)]
        return await asyncio.gather(*requests, return_exceptions=True)

    served.forget()
    answers = served.plc.do(at_once())
    refused = [type(a).__name__ for a in answers if isinstance(a, Exception)]
    assert refused == ["BadTooManyOperations"] * 2
    # Requests come apart: the next may have a little time left when the first ends, and has begun.
    assert served.acted
    late = [
        c for begun_s, c in zip(served.begun_s, served.acted, strict=True) if begun_s >= c.until_s
    ]
    assert not late
    served.works()


@pytest.fixture(scope="module")
def for_beats(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    """A server of its own, whose PLC alone writes heartbeats."""
    made = Served(tmp_path_factory.mktemp("beats"))
    yield made
    made.plc.close()
    made.thread.stop()


@pytest.fixture
def beating(for_beats: Served) -> Served:
    """The same, of which nothing was handed over yet."""
    for_beats.forget()
    return for_beats


def beats_pass(served: Served, count: int) -> None:
    """So many heartbeats are answered and handed over."""
    before = len(served.acted)
    for number in range(count):
        beat = ua.Variant(number + 1, ua.VariantType.UInt32)
        served.plc.do(served.plc.write("Gap.Heartbeat", beat))
    beats = [h.echo for h in served.acted[before:] if isinstance(h, Heartbeat)]
    assert beats == [*range(1, count + 1)]


def test_no_heartbeat_waits_behind_a_call(beating: Served, monkeypatch: pytest.MonkeyPatch) -> None:
    """Finding: on one session they waited until the call was answered, 0.45 s at the most."""
    for module in (cell, plc_server):
        monkeypatch.setattr(module, "ANSWER_S", 30.0)  # longer than this test may take
    waits = beating.plc.start(calls(beating, 1))
    _until(lambda: beating.acted)
    beats_pass(beating, 10)
    assert not waits.done()
    beating.acted[0].answer("BadNoCommunication")
    assert [result.StatusCode.name for result in waits.result(UP_S)] == ["BadNoCommunication"]


def test_no_heartbeat_waits_behind_a_login(
    beating: Served, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Finding: passwords were hashed in the thread that passes heartbeats on, 50 ms for each."""
    begun, goes_on = threading.Event(), threading.Event()
    look = access.Users.login

    def slow(*arguments: Any) -> Any:
        begun.set()
        assert goes_on.wait(UP_S)
        return look(*arguments)

    monkeypatch.setattr(access.Users, "login", slow)
    other = PlcClient(beating.folder, beating.port)
    login = other.start(other.connect())
    try:
        assert begun.wait(UP_S)
        beats_pass(beating, 10)
        assert not login.done()
    finally:
        goes_on.set()
    login.result(UP_S)
    other.close()


def test_strangers_do_not_take_the_places_of_plcs(beating: Served) -> None:
    """Finding: thirty connections without a certificate kept the PLC out while they were renewed.

    From an address of their own, as fast as they can, for as long as a PLC comes and goes.
    """
    ended, opened = threading.Event(), [0]

    def flood() -> None:
        kept: list[socket.socket] = []
        while not ended.is_set():
            with contextlib.suppress(OSError):
                at = ("127.0.0.1", beating.port)
                kept.append(socket.create_connection(at, 1.0, ("127.0.0.2", 0)))
                opened[0] += 1
            if len(kept) > 2 * MOST_STRANGERS:
                kept.pop(0).close()
        for each in kept:
            each.close()

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        _until(lambda: opened[0] > 3 * MOST_STRANGERS)
        for _ in range(3):
            other = PlcClient(beating.folder, beating.port)
            other.do(other.connect())
            other.close()
        beats_pass(beating, 10)  # whoever is there stays
    finally:
        ended.set()
        thread.join(UP_S)
    beating.works(10)


def test_a_defect_in_its_thread_is_told_and_the_server_goes_on(served: Served) -> None:
    async def broken(model: Any) -> None:
        raise ZeroDivisionError("of this test")

    served.forget()
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


def test_a_modbus_port_that_is_taken_holds_up_no_opc_ua(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port, modbus_port = free_port(), taken.getsockname()[1]
        numbers = NUMBERS | {name: {"NONE": 0} for name in OTHERS}
        settings = ServerSettings(
            "127.0.0.1", port, security_folder(tmp_path), (), InputTiming(0.0, 1e-3), numbers,
            ("127.0.0.1",), modbus_port,
        )  # fmt: skip
        thread = ServerThread(settings, lambda handed: None)
        _until(lambda: thread.state.trouble.startswith("Modbus: cannot listen"))
        reason = ("Cell.Accuracy.Reason", ua.Variant("so it is", ua.VariantType.String))
        thread.show("accuracy_state", [reason], datetime.now(UTC), time.monotonic())
        plc = PlcClient(tmp_path, port)
        plc.do(plc.connect())
        _until(lambda: plc.do(plc.read("Accuracy.Reason")) == "so it is")
        plc.close()
    _until(lambda: not thread.state.trouble)
    socket.create_connection(("127.0.0.1", modbus_port)).close()
    thread.stop()
    assert not thread._thread.is_alive()


def _until(holds: Callable[[], bool]) -> None:
    until_s = time.monotonic() + UP_S
    while not holds():
        assert time.monotonic() < until_s
        time.sleep(0.02)
