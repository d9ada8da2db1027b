# SPDX-License-Identifier: Apache-2.0
"""The page's server: a thread of its own, so that no request ever holds up the node.

Sessions by cookie (HttpOnly, SameSite=Strict), what acts by POST with the session's token beside
it, live by server-sent events. docs/panel.md says what each of them guards against.
"""

import asyncio
import contextlib
import functools
import json
import secrets
import socket
import ssl
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from importlib.resources import files
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from aiohttp import web

from robocal_ros.panel import words
from robocal_ros.panel.records import NOTHING, Records
from robocal_ros.panel.sessions import (
    ACTS,
    DECISIONS,
    SESSION_S,
    PanelSession,
    PanelSessions,
)
from robocal_ros.panel.state import ACCURACY, PanelState, Values

AGAIN_S = 2.0  # between two trials to listen, or to start anew after a defect
STOP_S = 3.0
LOOK_S = 1.0  # at history, users and connections
ANSWER_S = 2.0  # maintenance_node answers within
EVENT_S, SOONEST_S = 1.0, 0.2  # between two events: at the most, and where much changes
WRITE_S = 10.0  # a browser that takes longer to read is let go
REQUEST_S = 10.0  # a connection that has not asked for anything by then, too
KEPT_S = 30.0  # one that asks for nothing more is let go: aiohttp keeps it for an hour
MOST_CONNECTIONS, MOST_VIEWERS, MOST_LOGINS = 100, 40, 4
MOST_BYTES = 4096  # of a request's body
LONGEST_REASON = 200
COOKIE, LANGUAGE = "robocal_session", "robocal_language"
TOKEN = "X-Robocal-Token"
HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "connect-src 'self'; img-src 'self'; form-action 'self'; frame-ancestors 'none'; "
    "base-uri 'none'",
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
ASSETS = {
    "panel.js": "text/javascript",
    "panel.css": "text/css",
    "panel.svg": "image/svg+xml",
}


@dataclass(frozen=True)
class PanelSettings:
    """Where it listens, and what it works with; ``folder`` None: nobody can log in, no TLS."""

    address: str
    port: int
    folder: Path | None
    public_view: bool
    state_dir: Path | None
    serial: str
    encryption: ssl.SSLContext | None
    host_names: frozenset[str]  # by which a browser may call it, besides addresses


@dataclass(frozen=True)
class PanelCall:
    """What a user wants of maintenance_node; the future takes ``done`` and ``message``."""

    act: str
    service: str
    fields: Mapping[str, Any]
    user: str
    until_s: float
    answer: "Future[dict[str, Any]]"


class _Refused(asyncio.Protocol):
    """A connection too many."""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        transport.close()


class PanelServer:
    """The server; `show` and `stop` come from the node's thread, all else goes on in its own."""

    def __init__(
        self,
        settings: PanelSettings,
        call: Callable[[PanelCall], None],
        tell: Callable[[str], None],
    ) -> None:
        self._settings, self._call, self._tell = settings, call, tell
        self.trouble = "starts"
        self.viewers = 0
        self.panel = PanelState()
        self._sessions = None if settings.folder is None else PanelSessions(settings.folder)
        self._records: Mapping[str, Any] = NOTHING
        self._records_version = 0
        self._logging_in = 0
        self._seen: tuple[Any, ...] = ()
        self._silent: dict[Any, float] = {}
        self._handing = threading.Lock()  # holds `trouble` and what waits for its end together
        self._waiting: dict[str, tuple[Values, int, float, float]] = {}  # by source
        self._stopped = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._changed = self._ending = asyncio.Event()
        # one each, so that SQLite has one thread and guesses of passwords wait for one another
        self._disk = ThreadPoolExecutor(1, "panel_history")
        self._doorman = ThreadPoolExecutor(1, "panel_login")
        self._thread = threading.Thread(target=self._run, name="panel", daemon=True)
        self._thread.start()

    # ---- the node's thread ----------------------------------------------------------------------

    def show(self, name: str, values: Values, stamp_ns: int) -> None:
        """Show what a source said; once the server is up, the last: a latched one is said once."""
        said = values, stamp_ns, time.monotonic(), time.time()
        with self._handing:
            if self._loop is None or self.trouble:
                self._waiting[name] = said
            else:
                self._loop.call_soon_threadsafe(self._show, name, *said)

    def stop(self) -> None:
        """End it."""
        self._stopped = True
        if self._loop is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(STOP_S + AGAIN_S)
        self._disk.shutdown(wait=False)
        self._doorman.shutdown(wait=False)

    # ---- its own ---------------------------------------------------------------------------------

    def _show(self, name: str, values: Values, stamp_ns: int, now_s: float, wall_s: float) -> None:
        self.panel.show(name, values, stamp_ns, now_s, wall_s)
        tasks = tuple(task.key for task in self.panel.tasks(now_s))
        seen = self.panel.headline(now_s), tasks, len(self.panel.steps), len(self.panel.gaps)
        if seen != self._seen:
            self._seen = seen
            self._wake()

    def _wake(self) -> None:
        """Let all viewers' events go out now."""
        self._changed.set()
        self._changed = asyncio.Event()

    def _run(self) -> None:
        while not self._stopped:
            try:
                asyncio.run(self._serve())
            except Exception as error:
                self.trouble = (
                    f"cannot listen at {self._settings.address}:{self._settings.port}: "
                    f"{error.strerror or error}"
                    if isinstance(error, OSError)
                    else f"{type(error).__name__}: {error}"
                )
                self._tell(f"the page: {self.trouble}; it is tried again")
                time.sleep(AGAIN_S)

    async def _serve(self) -> None:
        self._ending = asyncio.Event()
        self._changed = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        runner = web.AppRunner(
            self._application(),
            handle_signals=False,
            access_log=None,
            shutdown_timeout=0.5,
            keepalive_timeout=KEPT_S,
        )
        await runner.setup()
        serve = runner.server
        assert serve is not None
        silent = self._silent = {}  # connections that have not asked for anything yet

        def connected() -> asyncio.BaseProtocol:
            if len(serve.connections) >= MOST_CONNECTIONS:
                return _Refused()
            made = serve()
            silent[made] = time.monotonic()
            return made

        settings = self._settings
        listening = None
        try:
            listening = await self._loop.create_server(
                connected,
                settings.address,
                settings.port,
                ssl=settings.encryption,
                ssl_handshake_timeout=None if settings.encryption is None else REQUEST_S,
            )
            with self._handing:
                self.trouble, waiting, self._waiting = "", self._waiting, {}
                for name, said in waiting.items():
                    self._loop.call_soon(self._show, name, *said)
            while not self._stopped:
                await self._look_at_history()
                if self._sessions is not None:
                    await self._loop.run_in_executor(self._doorman, self._sessions.look)
                for connection, since_s in [*silent.items()]:
                    if time.monotonic() - since_s > REQUEST_S:
                        del silent[connection]
                        connection.force_close()
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._ending.wait(), LOOK_S)
        finally:
            with self._handing:
                self.trouble = self.trouble or "ends"
            if listening is not None:
                listening.close()
            self._wake()
            await self._loop.run_in_executor(self._disk, self._history.close)
            await runner.cleanup()

    async def _look_at_history(self) -> None:
        accuracy = self.panel.sources[ACCURACY].values
        serial = self._settings.serial or accuracy.get("serial", "")
        if not serial or self._loop is None:
            return
        try:
            found = await self._loop.run_in_executor(self._disk, self._history.look, serial)
        except Exception as error:  # the page goes on without
            self._tell(f"the history cannot be shown: {type(error).__name__}: {error}")
            return
        if found is not None:
            self._records, self._records_version = found, self._records_version + 1
            self.panel.in_force = frozenset(found["in_force"])
            self.panel.history_trouble = found["trouble"]
            self._wake()

    def _application(self) -> web.Application:
        self._history = Records(self._settings.state_dir)
        application = web.Application(middlewares=[self._guard], client_max_size=MOST_BYTES)
        application.on_response_prepare.append(self._harden)
        add = application.router
        add.add_get("/", self._index)
        add.add_get("/events", self._events)
        add.add_get("/session", self._who)
        add.add_post("/login", self._login)
        add.add_post("/logout", self._logout)
        add.add_post("/act/{act}", self._act)
        for name, kind in ASSETS.items():
            add.add_get(f"/{name}", functools.partial(_asset, name, kind))
        return application

    async def _harden(self, request: web.Request, response: web.StreamResponse) -> None:
        response.headers.update(HEADERS)
        response.headers.pop("Server", None)

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        """Refuse what no page of ours sends, and let no defect out."""
        self._silent.pop(request.protocol, None)
        if not self._called_by_name(request.host):
            return _error(421, "wrong host")  # another site's name that leads here (DNS rebinding)
        if request.method == "POST":
            origin = request.headers.get("Origin", "")
            scheme = "https" if self._settings.encryption else "http"
            if origin != f"{scheme}://{request.host}":
                return _error(403, "wrong origin")
            if request.content_type != "application/json":
                return _error(415, "not JSON")
        try:
            answer: web.StreamResponse = await handler(request)
        except web.HTTPException as refused:
            return _error(refused.status, refused.reason)
        except (ConnectionError, TimeoutError):
            raise  # the browser has gone
        except Exception as error:
            self._tell(f"a defect of this software: {type(error).__name__}: {error}")
            return _error(500, "a defect of this software")
        return answer

    def _called_by_name(self, host: str) -> bool:
        name = host.rsplit(":", 1)[0] if host.rpartition(":")[2].isdigit() else host
        with contextlib.suppress(ValueError):
            ip_address(name.strip("[]"))
            return True
        return name.lower() in self._settings.host_names

    def _session(self, request: web.Request) -> PanelSession | None:
        if self._sessions is None:
            return None
        return self._sessions.of(request.cookies.get(COOKIE, ""), time.monotonic())

    def _may_view(self, request: web.Request) -> bool:
        return self._settings.public_view or self._session(request) is not None

    # ---- reading ---------------------------------------------------------------------------------

    async def _index(self, request: web.Request) -> web.StreamResponse:
        if (chosen := request.query.get("language", "")) in words.LANGUAGES:
            moved = web.Response(status=303, headers={"Location": "/"})
            moved.set_cookie(LANGUAGE, chosen, max_age=10**7, samesite="Strict", httponly=True)
            return moved
        language = _language(request)
        initial: dict[str, Any] = {
            "words": words.document(language),
            "languages": words.LANGUAGES,
            "language": language,
            "session": self._about(request),
        }
        if self._may_view(request):
            initial |= {"state": self._state(), "curve": self._curve(), "history": self._records}
        text = _page().replace("{{language}}", language)
        data = json.dumps(initial, allow_nan=False).replace("<", "\\u003c")
        return web.Response(text=text.replace("{{initial}}", data), content_type="text/html")

    def _state(self) -> dict[str, Any]:
        return self.panel.document(time.monotonic(), time.time())

    def _curve(self) -> list[list[Any]]:
        return [*self.panel.curve.points]

    async def _events(self, request: web.Request) -> web.StreamResponse:
        """Tell the state each second and at each change; curve and history when they change."""
        if not self._may_view(request):
            return _error(401, "log in")
        if self.viewers >= MOST_VIEWERS:
            return _error(503, "too many pages are open")
        stream = web.StreamResponse(headers={"Content-Type": "text/event-stream"})
        await stream.prepare(request)
        self.viewers += 1
        sent: dict[str, int] = {}
        try:
            await stream.write(b"retry: 1000\n\n")
            while not self._stopped and self._may_view(request):
                changed = self._changed
                text = _event("state", self._state())
                for name, version, shown in (
                    ("curve", self.panel.curve.version, self._curve),
                    ("history", self._records_version, lambda: self._records),
                ):
                    if sent.get(name) != version:
                        sent[name] = version
                        text += _event(name, shown())
                async with asyncio.timeout(WRITE_S):
                    await stream.write(text.encode())
                await asyncio.sleep(SOONEST_S)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(changed.wait(), EVENT_S - SOONEST_S)
        except ConnectionError:
            pass  # it has gone
        except TimeoutError:
            if request.transport is not None:
                request.transport.abort()  # what waits for it is dropped
        finally:
            self.viewers -= 1
        return stream

    # ---- who, and what they want -----------------------------------------------------------------

    def _about(self, request: web.Request) -> dict[str, Any]:
        session = self._session(request)
        return {
            "user": session.user if session else "",
            "role": session.role.name if session else "",
            "token": session.csrf if session else "",
            "users": self._sessions is not None,
            "encrypted": self._settings.encryption is not None,
            "public": self._settings.public_view,
        }

    async def _who(self, request: web.Request) -> web.StreamResponse:
        return web.json_response(self._about(request))

    async def _login(self, request: web.Request) -> web.StreamResponse:
        given = await _body(request)
        name, password = given.get("name"), given.get("password")
        if self._sessions is None or self._loop is None:
            return _error(403, "no users")
        if not isinstance(name, str) or not isinstance(password, str):
            return _error(400, "name and password are texts")
        if self._logging_in >= MOST_LOGINS:
            return _error(429, "too many logins at once")
        self._logging_in += 1
        try:
            found = await self._loop.run_in_executor(
                self._doorman, self._sessions.login, name, password, time.monotonic()
            )
        finally:
            self._logging_in -= 1
        if isinstance(found, str):
            self._tell(f"the page: {found}")
            return _error(403, "refused")
        token, session = found
        answer = web.json_response({"user": session.user, "role": session.role.name})
        answer.set_cookie(
            COOKIE, token, max_age=round(SESSION_S), path="/", httponly=True, samesite="Strict",
            secure=self._settings.encryption is not None,
        )  # fmt: skip
        return answer

    async def _logout(self, request: web.Request) -> web.StreamResponse:
        await _body(request)
        if self._sessions is not None and self._with_token(request) is not None:
            self._sessions.end(request.cookies[COOKIE])
        answer = web.json_response({})
        answer.del_cookie(COOKIE, path="/")
        return answer

    def _with_token(self, request: web.Request) -> PanelSession | None:
        """The session, where the request carries its token too."""
        session = self._session(request)
        given = request.headers.get(TOKEN, "")
        right = session is not None and secrets.compare_digest(
            given.encode(), session.csrf.encode()
        )
        return session if right else None

    async def _act(self, request: web.Request) -> web.StreamResponse:
        given, act = await _body(request), request.match_info["act"]
        session = self._with_token(request)
        if self._sessions is None or self._loop is None or session is None:
            return _error(401, "log in")
        if act not in ACTS:
            return _error(404, "no such act")
        may = await self._loop.run_in_executor(
            self._doorman, self._sessions.allowed, session, act, time.monotonic()
        )
        if not may:
            return _error(403, "not allowed")
        fields: dict[str, Any] = {}
        if act in DECISIONS:
            number, reason = given.get("id"), given.get("reason", "")
            if type(number) is not int or not 0 < number < 2**32 or not isinstance(reason, str):
                return _error(400, "id is a number, reason a text")
            fields = {"id": number, "reason": reason[:LONGEST_REASON]}
        until_s = time.monotonic() + ANSWER_S
        answer: Future[dict[str, Any]] = Future()
        self._call(PanelCall(act, ACTS[act][1], fields, session.user, until_s, answer))
        try:
            return web.json_response(await asyncio.wait_for(asyncio.wrap_future(answer), ANSWER_S))
        except TimeoutError:
            return _error(504, "no answer")


def _event(name: str, shown: Any) -> str:
    return f"event: {name}\ndata: {json.dumps(shown, allow_nan=False)}\n\n"


def _error(status: int, words: str) -> web.Response:
    return web.json_response({"error": words}, status=status)


async def _body(request: web.Request) -> dict[str, Any]:
    """The JSON object of a request, read in time."""
    try:
        async with asyncio.timeout(REQUEST_S):
            given = json.loads(await request.read())
    except (ValueError, RecursionError) as error:
        raise web.HTTPBadRequest(reason="not JSON") from error
    except TimeoutError as error:
        raise web.HTTPRequestTimeout from error
    if not isinstance(given, dict):
        raise web.HTTPBadRequest(reason="not an object")
    return given


def _language(request: web.Request) -> str:
    """The one that was chosen, else the browser's first of ours, else English."""
    asked = request.headers.get("Accept-Language", "")[:200].split(",")
    wanted = [request.cookies.get(LANGUAGE, ""), *(part.strip()[:2].lower() for part in asked)]
    return next((name for name in wanted if name in words.LANGUAGES), "en")


@functools.cache
def _page() -> str:
    return (files("robocal_ros.panel") / "panel.html").read_text(encoding="utf-8")


async def _asset(name: str, kind: str, request: web.Request) -> web.Response:
    return web.Response(body=_file(name), content_type=kind, charset="utf-8")


@functools.cache
def _file(name: str) -> bytes:
    return (files("robocal_ros.panel") / name).read_bytes()


def host_names(certified: frozenset[str]) -> frozenset[str]:
    """Names of this machine, and those of its certificate, in small letters."""
    own = socket.gethostname().lower()
    return frozenset({"localhost", own, f"{own}.local", *(name.lower() for name in certified)})
