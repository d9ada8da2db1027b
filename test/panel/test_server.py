# SPDX-License-Identifier: Apache-2.0
"""The page's server by a real client: who may what, what is refused, and what ends nothing."""

import asyncio
import contextlib
import json
import socket
import ssl
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import aiohttp
import pytest
from histories import BY
from history_workers import proposal
from panel_page import Cell, Loop, accuracy, ended, status

from bench.live.opc_ua import ENGINEER, OPERATOR, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.panel import server as served
from robocal_ros.panel.server import COOKIE, HEADERS, TOKEN
from robocal_ros.panel.sessions import ENGINEER_S, SESSION_S, PanelSessions
from robocal_ros.panel.state import ACCURACY, FIXTURE, STATUS
from robocal_ros.plc.access import LOCKED_AFTER, Role, Users

Answer = tuple[int, Any]


class Client(Loop):
    """A browser's requests, without a browser."""

    def __init__(self, cell: Cell) -> None:
        super().__init__()
        self.cell, self.token = cell, ""
        self.http = self.do(self._open())

    async def _open(self) -> aiohttp.ClientSession:
        # addresses have cookies too
        return aiohttp.ClientSession(cookie_jar=aiohttp.CookieJar(unsafe=True))

    async def _ask(self, method: str, path: str, body: Any, headers: dict[str, str]) -> Any:
        given = {"Origin": self.cell.url, TOKEN: self.token, **headers}
        data = body if isinstance(body, bytes) else None
        options = {"data": data} if data is not None else {"json": body}
        if method == "GET":
            options = {}
        if data is not None:
            given.setdefault("Content-Type", "application/json")
        async with self.http.request(
            method, self.cell.url + path, headers=given, ssl=False, allow_redirects=False, **options
        ) as answer:
            text = await answer.text()
            return answer.status, text, answer.headers

    def get(self, path: str, **headers: str) -> Any:
        return self.do(self._ask("GET", path, None, headers))

    def post(self, path: str, body: Any = None, **headers: str) -> Answer:
        number, text, _ = self.do(self._ask("POST", path, {} if body is None else body, headers))
        return number, json.loads(text)

    def login(self, name: str, password: str) -> int:
        number, _ = self.post("/login", {"name": name, "password": password})
        self.token = json.loads(self.get("/session")[1])["token"]
        return number

    def events(self, count: int) -> list[tuple[str, Any]]:
        async def read() -> list[tuple[str, Any]]:
            found = []
            async with self.http.get(self.cell.url + "/events", ssl=False) as answer:
                assert answer.status == 200, await answer.text()
                assert answer.headers["Content-Type"] == "text/event-stream"
                name = ""
                async for line in answer.content:
                    kind, _, rest = line.decode().rstrip().partition(": ")
                    if kind == "event":
                        name = rest
                    elif kind == "data":
                        found.append((name, json.loads(rest)))
                        if len(found) >= count:
                            break
            return found

        return self.do(read())

    def close(self) -> None:
        self.do(self.http.close())
        super().close()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return security_folder(tmp_path_factory.mktemp("plc"))


@pytest.fixture(scope="module")
def cell(folder: Path) -> Iterator[Cell]:
    made = Cell(folder)
    yield made
    made.close()


@pytest.fixture
def client(cell: Cell) -> Iterator[Client]:
    cell.calls.clear()
    made = Client(cell)
    yield made
    made.close()


# ---- who may what -------------------------------------------------------------------------------


def test_without_a_login_all_is_seen_and_nothing_done(client, cell):
    number, page, headers = client.get("/")
    assert number == 200
    assert {name: headers[name] for name in HEADERS} == HEADERS
    assert "unsafe" not in headers["Content-Security-Policy"]
    assert "Server" not in headers
    assert 'id="initial"' in page
    for act in ("run", "cancel", "accept", "reject", "acknowledge"):
        assert client.post(f"/act/{act}", {"id": 1})[0] == 401
    assert not cell.calls


def test_an_operator_runs_and_an_engineer_decides(client, cell):
    assert client.login(*OPERATOR) == 200
    assert client.post("/act/run") == (200, {"done": True, "message": "run done"})
    assert client.post("/act/cancel")[0] == 200
    for act in ("accept", "reject", "acknowledge"):
        assert client.post(f"/act/{act}", {"id": 1})[0] == 403
    assert [call.service for call in cell.calls] == ["run_trigger", "cancel_trigger"]
    assert client.login(*ENGINEER) == 200
    cell.calls.clear()
    assert client.post("/act/accept", {"id": 7, "reason": "checked"})[0] == 200
    assert client.post("/act/acknowledge")[0] == 200
    accept, acknowledge = cell.calls
    assert accept.fields == {"id": 7, "reason": "checked"}
    assert (accept.user, acknowledge.user, acknowledge.fields) == ("ada", "ada", {})
    assert client.post("/logout")[0] == 200
    assert client.post("/act/run")[0] == 401


def test_a_cookie_is_for_this_page_alone(client, cell):
    status_, _, headers = client.do(
        client._ask("POST", "/login", dict(zip(("name", "password"), ENGINEER, strict=True)), {})
    )
    assert status_ == 200
    cookie = headers["Set-Cookie"]
    for part in ("HttpOnly", "SameSite=Strict", "Secure", "Path=/"):
        assert part in cookie
    assert cookie.startswith(f"{COOKIE}=")


def test_a_request_of_another_site_does_nothing(client, cell):
    """It would carry the cookie, if a browser let it."""
    assert client.login(*ENGINEER) == 200
    foreign = {"Origin": "https://evil.example"}
    assert client.post("/act/accept", {"id": 1}, **foreign)[0] == 403
    assert client.post("/act/accept", {"id": 1}, Origin="null")[0] == 403
    assert client.post("/act/accept", {"id": 1}, Origin=cell.url.replace("s:", ":"))[0] == 403
    token, client.token = client.token, "not it"
    assert client.post("/act/accept", {"id": 1})[0] == 401
    client.token = token[:-1]
    assert client.post("/act/accept", {"id": 1})[0] == 401
    client.token = token
    form = {"Content-Type": "application/x-www-form-urlencoded"}
    assert client.post("/act/accept", b"id=1", **form)[0] == 415
    assert client.post("/act/accept", {"id": 1}, Host="evil.example")[0] == 421
    assert client.get("/", Host="evil.example")[0] == 421
    assert not cell.calls
    assert client.post("/act/accept", {"id": 1})[0] == 200


def test_who_is_taken_out_does_nothing_any_more(client, cell, folder):
    users = Users(folder)
    users.put("guest", Role.ENGINEER, "ten letters.")
    assert client.login("guest", "ten letters.") == 200
    assert client.post("/act/acknowledge")[0] == 200
    cell.calls.clear()
    users.put("guest", Role.OPERATOR, "ten letters.")
    assert client.post("/act/acknowledge")[0] in (401, 403)  # 401: the session has ended already
    assert client.login("guest", "ten letters.") == 200
    users.remove("guest")
    assert client.post("/act/run")[0] in (401, 403)
    assert not cell.calls


def test_who_is_taken_out_sees_nothing_any_more(folder):
    users = Users(folder)
    users.put("guest", Role.OPERATOR, "ten letters.")
    cell = Cell(folder, public_view=False)
    client, other = Client(cell), Client(cell)
    try:
        assert client.login("guest", "ten letters.") == 200
        assert other.login(*OPERATOR) == 200

        async def until_it_ends() -> None:
            async with asyncio.timeout(10.0), client.http.get(cell.url + "/events", ssl=False) as s:
                assert s.status == 200
                users.remove("guest")
                await s.content.read()

        client.do(until_it_ends())
        assert client.get("/events")[0] == 401
        assert '"user": ""' in client.get("/session")[1]
        assert '"state"' in other.get("/")[1]  # nobody else is logged out
    finally:
        client.close()
        other.close()
        cell.close()


def test_who_guesses_is_locked_out(client):
    for _ in range(LOCKED_AFTER):
        assert client.login("eve", "a wrong guess") == 403
    began_s = time.process_time()
    for _ in range(20):
        assert client.login("eve", "a wrong guess") == 403
    assert time.process_time() - began_s < 0.5  # a hash of 20 guesses takes a second
    assert client.login(*OPERATOR) == 200  # another one is not locked out with her


def test_sessions_end_and_are_bounded(folder):
    sessions = PanelSessions(folder)
    token, engineer = sessions.login(*ENGINEER, 0.0)
    assert sessions.allowed(engineer, "accept", ENGINEER_S - 1.0)
    assert sessions.of(token, 2.0 * ENGINEER_S - 2.0) is engineer
    assert sessions.of(token, 2.0 * ENGINEER_S) is None
    token, _ = sessions.login(*OPERATOR, 0.0)
    assert sessions.of(token, SESSION_S) is not None
    assert sessions.of(token, SESSION_S + 1.0) is None
    assert sessions.of("", 0.0) is None


def test_a_cell_that_is_not_public_shows_nothing_before_a_login(folder):
    cell = Cell(folder, public_view=False)
    client = Client(cell)
    try:
        _, page, _ = client.get("/")
        assert '"state"' not in page.split('id="initial"')[1].replace('"state/', "")
        assert client.get("/events")[0] == 401
        assert client.login(*OPERATOR) == 200
        assert [name for name, _ in client.events(1)] == ["state"]
        assert '"headline"' in client.get("/")[1]
    finally:
        client.close()
        cell.close()


def test_without_a_folder_it_is_read_only(tmp_path):
    cell = Cell()
    client = Client(cell)
    try:
        about = json.loads(client.get("/session")[1])
        assert (about["users"], about["encrypted"]) == (False, False)
        assert client.post("/login", {"name": "ada", "password": "x"})[0] == 403
        assert client.post("/act/run")[0] == 401
    finally:
        client.close()
        cell.close()


# ---- what comes through -------------------------------------------------------------------------


def test_the_stream_tells_state_curve_and_history(cell, client, tmp_path):
    events = client.events(6)
    assert [name for name, _ in events[:3]] == ["state", "curve", "history"]
    assert events[0][1]["headline"] in {"OK", "SILENT"}
    states = [told for name, told in events if name == "state"]
    assert states[-1]["headline"] == "OK"
    assert states[-1]["bound_mm"] == 0.16
    cell.says[STATUS] = status("FAULT", fault_code=14, fault="knocked")
    faults = [
        told for name, told in client.events(12) if name == "state" and told["headline"] == "FAULT"
    ]
    cell.says[STATUS] = status()
    told = faults[-1]
    assert told["tasks"][0] == {
        "key": "SENSOR_OR_ROBOT_MOVED", "code": "SENSOR_OR_ROBOT_MOVED", "detail": "knocked",
    }  # fmt: skip


def test_the_history_is_that_of_the_command_line(tmp_path):
    with CalibrationHistory.open("K7", state_dir=tmp_path) as history:
        first = history.propose(proposal())
        history.accept(first, **BY)
        second = history.propose(proposal(based_on=1))
        cell = Cell(state_dir=tmp_path)
        client = Client(cell)
        try:
            deadline = time.monotonic() + 20.0
            while not cell.server._records["results"] and time.monotonic() < deadline:
                time.sleep(0.05)
            shown = dict(client.events(3))["history"]
            assert shown["in_force"] == [first]
            # JSON has lists where Python has tuples
            listed = json.loads(json.dumps([entry.document() for entry in history.list()]))
            assert shown["results"] == listed
            version = cell.server._records_version
            history.reject(second, **BY)
            while cell.server._records_version == version and time.monotonic() < deadline:
                time.sleep(0.05)
            shown = dict(client.events(3))["history"]
            assert shown["results"][0]["state"] == "rejected"
        finally:
            client.close()
            cell.close()


def test_texts_of_others_end_no_script(client, cell):
    hostile = "</script><script>alert(1)</script><img src=x onerror=alert(1)>\u2028"
    cell.says[ACCURACY] = accuracy("DUE", reason=hostile, serial=hostile)
    try:
        deadline = time.monotonic() + 10.0
        while hostile[:9] not in cell.server.panel.sources[ACCURACY].values["reason"]:
            assert time.monotonic() < deadline
            time.sleep(0.05)
        time.sleep(0.5)
        _, page, _ = client.get("/")
    finally:
        cell.says[ACCURACY] = accuracy()
    data = page.split('id="initial">')[1]
    assert data.count("<") == 3  # </script>, </body>, </html>
    assert json.loads(data.split("</script>")[0])["state"]["serial"] == hostile


def test_each_language_is_served(client):
    assert "Der Roboter ist genau." in client.get("/", **{"Accept-Language": "de-AT,en"})[1]
    for asked, language in (("zh-CN,zh;q=0.9", "zh"), ("fr,en;q=0.5", "en"), ("", "en")):
        _, page, _ = client.get("/", **{"Accept-Language": asked})
        assert f'<html lang="{language}">' in page
    number, _, headers = client.get("/?language=de")
    assert (number, headers["Location"]) == (303, "/")
    assert '<html lang="de">' in client.get("/", **{"Accept-Language": "zh"})[1]


def test_who_is_not_answered_is_told_so(client, cell, monkeypatch):
    monkeypatch.setattr(served, "ANSWER_S", 0.3)
    assert client.login(*ENGINEER) == 200
    answers, cell.answers = cell.answers, lambda call: None
    assert client.post("/act/accept", {"id": 1})[0] == 504
    (call,) = cell.calls
    cell.answers = answers
    assert call.until_s < time.monotonic() + 0.3
    assert not call.answer.set_running_or_notify_cancel()  # an answer that is late goes nowhere


# ---- hostile ------------------------------------------------------------------------------------


def test_hostile_requests_end_nothing(client, cell):
    assert client.login(*ENGINEER) == 200
    wrong: list[Any] = [
        {"id": "1"}, {"id": -1}, {"id": 2**40}, {"id": True}, {"id": 1.5}, {"id": None}, {},
        {"id": 1, "reason": 5}, {"id": 1, "reason": {"a": []}},
    ]  # fmt: skip
    for body in wrong:
        assert client.post("/act/accept", body)[0] == 400, body
    raw = [b"", b"[]", b"null", b"{", b"\xff\xfe", b"[" * 4000, b'{"id": NaN}', b'{"id": 1e999}']
    for data in raw:
        assert client.post("/act/accept", data)[0] == 400, data
    assert client.post("/act/accept", b" " * 100_000)[0] == 413
    for path in (
        "/act/rollback",
        "/act/../run",
        "/act/%00",
        "/../panel.js",
        "/panel.py",
        "/words.yaml",
    ):
        assert client.post(path, {"id": 1})[0] in {401, 403, 404, 405}, path
    for path in ("/%2e%2e/%2e%2e/etc/passwd", "/panel.js/../server.py", "/users.json"):
        assert client.get(path)[0] == 404, path
    for headers in (
        {"Cookie": "x" * 4000},
        {TOKEN: "\u00ff" * 100},
        {"Accept-Language": "," * 5000},
    ):
        assert client.get("/session", **headers)[0] in {200, 400}
    assert client.post("/login", {"name": ["ada"], "password": {}})[0] == 400
    assert client.post("/login", {"name": "x" * 3000, "password": "y"})[0] == 403
    assert not cell.calls
    assert client.post("/act/accept", {"id": 1, "reason": "z" * 3000})[0] == 200
    assert len(cell.calls[-1].fields["reason"]) == served.LONGEST_REASON


def test_open_connections_and_pages_are_bounded(monkeypatch):
    monkeypatch.setattr(served, "MOST_CONNECTIONS", 10)
    monkeypatch.setattr(served, "MOST_VIEWERS", 3)
    monkeypatch.setattr(served, "REQUEST_S", 1.0)
    cell = Cell()
    client = Client(cell)
    mute = []
    try:
        for _ in range(30):  # who connects and says nothing, or half a request
            one = socket.create_connection(("127.0.0.1", cell.port), 5.0)
            one.sendall(b"GET / HTTP/1.1\r\nHost: 127")
            mute.append(one)
        for one in mute:
            one.settimeout(10.0)
            with contextlib.suppress(ConnectionResetError):  # what it said was not read
                assert one.recv(1000) == b""  # let go, at once or after a while
        assert client.get("/session")[0] == 200

        async def view() -> tuple[list[int], int]:
            streams = [await client.http.get(cell.url + "/events") for _ in range(3)]
            late = await client.http.get(cell.url + "/events")
            numbers = [one.status for one in streams]
            for one in streams:
                one.close()
            return numbers, late.status

        assert client.do(view()) == ([200] * 3, 503)
        deadline = time.monotonic() + 10.0
        while cell.server.viewers and time.monotonic() < deadline:
            time.sleep(0.05)
        assert cell.server.viewers == 0
        assert client.events(1)
    finally:
        for one in mute:
            one.close()
        client.close()
        cell.close()


def test_who_does_not_encrypt_is_turned_away(cell, folder):
    with socket.create_connection(("127.0.0.1", cell.port), 5.0) as plain:
        plain.sendall(b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n")
        plain.settimeout(10.0)
        assert b"200" not in plain.recv(1000)
    known = ssl.create_default_context(
        cadata=ssl.DER_cert_to_PEM_cert((folder / "server.der").read_bytes())
    )
    with (
        socket.create_connection(("127.0.0.1", cell.port), 5.0) as plain,
        known.wrap_socket(plain, server_hostname="localhost") as trusted,
    ):
        assert trusted.version() in {"TLSv1.2", "TLSv1.3"}  # by the certificate, which is checked


def test_a_port_that_is_taken_is_told_and_tried_again():
    port, told = free_port(), list[str]()
    settings = served.PanelSettings(
        "127.0.0.1", port, None, True, None, "", None, frozenset({"localhost"})
    )
    deadline = time.monotonic() + 20.0
    with socket.create_server(("127.0.0.1", port)):
        late = served.PanelServer(settings, lambda call: None, told.append)
        while not told and time.monotonic() < deadline:
            time.sleep(0.05)
        assert f"cannot listen at 127.0.0.1:{port}" in late.trouble
    while late.trouble and time.monotonic() < deadline:
        time.sleep(0.05)
    assert late.trouble == ""
    late.stop()


def test_what_is_said_once_while_it_cannot_listen_yet_is_shown(tmp_path):
    """As a latched message is, which comes as soon as the node is there."""
    port, told = free_port(), list[str]()
    settings = served.PanelSettings(
        "127.0.0.1", port, None, True, tmp_path, "", None, frozenset({"localhost"})
    )
    deadline = time.monotonic() + 20.0
    verdict = {"code": int(Code.ACCEPT), "candidate_id": 7, "reason": "it moved"}
    with socket.create_server(("127.0.0.1", port)):
        late = served.PanelServer(settings, lambda call: None, told.append)
        late.show(FIXTURE, verdict | {"candidate_id": 6}, 1)
        late.show(FIXTURE, verdict, 2)
        late.show(ACCURACY, accuracy(), 3)
        while not told and time.monotonic() < deadline:
            time.sleep(0.05)
    while late.trouble and time.monotonic() < deadline:
        time.sleep(0.05)
    late.show(STATUS, status(), 4)
    while not late.panel.sources[STATUS].values and time.monotonic() < deadline:
        time.sleep(0.05)
    assert late.panel.sources[FIXTURE].values == verdict
    assert late.panel.sources[ACCURACY].age_s(time.monotonic()) is None  # who said it may be gone
    late.stop()


def test_who_asks_once_and_stays_is_let_go(monkeypatch):
    monkeypatch.setattr(served, "MOST_CONNECTIONS", 5)
    monkeypatch.setattr(served, "KEPT_S", 1.0)
    cell = Cell()
    asked = []
    try:
        for _ in range(5):  # all that there are, and no more than half of a second request
            one = socket.create_connection(("127.0.0.1", cell.port), 10.0)
            one.sendall(f"GET /session HTTP/1.1\r\nHost: 127.0.0.1:{cell.port}\r\n\r\n".encode())
            assert one.recv(10_000).startswith(b"HTTP/1.1 200")
            one.sendall(b"GET / HTTP/1.1\r\nHost: 127")
            asked.append(one)
        for one in asked:
            while one.recv(10_000):
                pass
        client = Client(cell)
        try:
            assert client.get("/session")[0] == 200
        finally:
            client.close()
    finally:
        for one in asked:
            one.close()
        cell.close()


def test_a_stalled_reader_is_let_go_and_holds_up_nobody(monkeypatch):
    monkeypatch.setattr(served, "WRITE_S", 0.5)
    cell = Cell()
    client = Client(cell)
    try:
        with socket.socket() as stalled:
            stalled.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            stalled.connect(("127.0.0.1", cell.port))
            host = f"127.0.0.1:{cell.port}"
            stalled.sendall(f"GET /events HTTP/1.1\r\nHost: {host}\r\n\r\n".encode())
            cell.says[ACCURACY] = accuracy(reason="x" * 900_000)  # not cut: this is not the node
            deadline = time.monotonic() + 15.0
            while cell.server.viewers == 0 and time.monotonic() < deadline:
                time.sleep(0.02)
            cell.says[STATUS] = status(last=ended(tool_code=15, message="y" * 900_000))
            while cell.server.viewers and time.monotonic() < deadline:
                time.sleep(0.05)
            assert cell.server.viewers == 0
            assert client.get("/session")[0] == 200
    finally:
        client.close()
        cell.close()


def test_a_thousand_requests_at_once_are_answered(client):
    async def many() -> list[int]:
        async def one(k: int) -> int:
            path = ("/", "/session", "/panel.js", "/act/accept")[k % 4]
            method = "POST" if k % 4 == 3 else "GET"
            return int((await client._ask(method, path, {"id": k}, {}))[0])

        gate = asyncio.Semaphore(20)

        async def gated(k: int) -> int:
            async with gate:
                return await one(k)

        return await asyncio.gather(*(gated(k) for k in range(1000)))

    assert set(client.do(many())) == {200, 401}
