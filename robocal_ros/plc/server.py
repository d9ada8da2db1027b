# SPDX-License-Identifier: Apache-2.0
"""The OPC UA server: who gets in, what may be asked, and the thread that it runs in.

asyncua (2.1) leaves some doors open, which are closed here; docs/plc.md names each with its place
in asyncua's source. Its loop has a thread of its own; what a PLC wants goes to the node as
`Handover` takes it, and comes back by `ServerThread.post`.
"""

import asyncio
import contextlib
import gc
import logging
import threading
import time
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import Buffer, ServiceError
from asyncua.crypto.permission_rules import User, UserRole
from asyncua.crypto.uacrypto import x509_from_der
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.uaprocessor import UaProcessor
from asyncua.ua.ua_binary import nodeid_from_binary, struct_from_binary, uatcp_to_binary
from cryptography.hazmat.primitives import serialization

from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.ground.errors import InputError
from robocal_ros.plc.access import (
    KEY,
    SERVER,
    Account,
    Logins,
    Role,
    Trust,
    Users,
    application_uri,
    read_certificate,
)
from robocal_ros.plc.cell import ANSWER_S, Cell, Handover, Notice, RegisterImage
from robocal_ros.plc.modbus import ModbusServer
from robocal_ros.plc.model import ACTIVE, InformationModel

AGAIN_S = 2.0  # between two trials to listen, or to start anew after a defect
LOOK_S = 0.5
STOP_S = 3.0
CHUNK_BYTES = 65535
MESSAGE_BYTES = 2 * CHUNK_BYTES
MOST_CONNECTIONS = 30
MOST_STRANGERS = 20  # connections whose channel no trusted certificate has opened; beside those
MOST_ITEMS, MOST_BROWSED = 500, 100  # of one request
MOST_CALLS = 10  # of one request; and so many requests of a session may wait
CALL = ua.NodeId(ua.ObjectIds.CallRequest_Encoding_DefaultBinary)
NO_SECURITY = "http://opcfoundation.org/UA/SecurityPolicy#None"
T = TypeVar("T")


@dataclass(frozen=True)
class ServerSettings:
    """Where it listens and what it works with."""

    host: str
    port: int
    folder: Path
    beams: tuple[str, ...]
    timing: InputTiming
    enumerations: Mapping[str, Mapping[str, int]]
    modbus_clients: tuple[str, ...] = ()  # none: Modbus is off
    modbus_port: int = 502


@dataclass(kw_only=True)
class PlcUser(User):
    """Who has logged in, and as what."""

    role: UserRole = UserRole.User  # of asyncua: may not change nodes
    account: Account = field(repr=False)  # as it was then; no hash goes into a log


class Login(NamedTuple):
    """Who wants in: a name and a password, over a channel of a certificate."""

    name: str
    password: str
    certificate: bytes | None


class LoginWaitsError(Exception):
    """A login has not been looked at yet: it takes its time, beside asyncua's loop."""

    def __init__(self, login: Login) -> None:
        super().__init__()
        self.login = login


class Door:
    """Lets users in whose client is trusted and whose password is right (asyncua's UserManager).

    asyncua checks a certificate only where CreateSession carries one, and not that it is the secure
    channel's; what is checked here is the one that the channel was opened with. Files and hashes
    are looked at in a thread beside the loop, one login after the other.
    """

    def __init__(self, folder: Path, hand: Handover) -> None:
        self._hand, self._trust, self._logins = hand, Trust(folder), Logins(folder)
        self._folder = folder
        self.answers: dict[Login, PlcUser | None] = {}  # for the one pass that follows
        # One thread: glibc keeps the 16 MB of a hash for the thread that asked for them.
        self._one = ThreadPoolExecutor(1, "login")

    def untrusted(self, certificate: bytes | None) -> str:
        """Why a client with this certificate is turned away; empty: it is not."""
        if not certificate:
            return "without a certificate"
        try:
            return self._trust.refusal(certificate)
        except (OSError, InputError) as error:
            return str(error)

    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: str | None = None,
        certificate: bytes | None = None,
    ) -> PlcUser | None:
        """Who has logged in; None: refused. Raises `LoginWaitsError` where `look` comes first."""
        login = Login((username or "")[:100], password or "", certificate)
        if login not in self.answers:
            raise LoginWaitsError(login)
        return self.answers[login]

    async def look(self, login: Login) -> None:
        """Look at it beside the loop; `get_user` has the answer then."""
        loop = asyncio.get_running_loop()
        self.answers[login] = await loop.run_in_executor(self._one, self.admit, login)

    def admit(self, login: Login) -> PlcUser | None:
        """Log a user in; None: refused. It reads files, and hashes for some 50 ms."""
        name = login.name
        if why := self.untrusted(login.certificate):
            self._hand(Notice(f"a client is turned away: {why}"))
            return None
        account = self._logins.login(name, login.password, time.monotonic())
        if isinstance(account, str):
            self._hand(Notice(account))
            return None
        return PlcUser(name=name, account=account)

    def accounts(self) -> Mapping[str, Account] | None:
        """The users as they are now; None: their table cannot be read, for a moment perhaps."""
        try:
            return Users(self._folder).accounts
        except (OSError, InputError):
            return None


class CellSession(InternalSession):
    """A client's session: bounded requests, writes and calls by `Cell`."""

    iserver: "CellInternalServer"

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._calls_waiting, self._in_order = 0, asyncio.Lock()

    @property
    def rights(self) -> Role | int:
        """Of the user who is logged in; 0: nobody is."""
        return self.user.account.role if isinstance(self.user, PlcUser) else 0

    @property
    def user_name(self) -> str:
        """Who is logged in."""
        return (self.user and self.user.name) or "nobody"

    @property
    def label(self) -> str:
        """The session in words; no other one has it."""
        return f"{self.user_name} (session {self.session_id.Identifier})"

    async def create_session(
        self, params: ua.CreateSessionParameters, sockname: tuple[str, int] | None = None
    ) -> ua.CreateSessionResult:
        """Begin; refused for a client that is not trusted."""
        try:
            found = x509_from_der(params.ClientCertificate)
            sent = None if found is None else found.public_bytes(serialization.Encoding.DER)
        except ValueError as error:
            raise ServiceError(ua.StatusCodes.BadCertificateInvalid) from error
        if why := await asyncio.to_thread(self.iserver.door.untrusted, sent):
            self.iserver.hand(Notice(f"{self.name}: {why}"))
            raise ServiceError(ua.StatusCodes.BadCertificateUntrusted)
        return await super().create_session(params, sockname)

    async def close_session(self, delete_subs: bool = True) -> None:
        """End, with what it wrote; asyncua keeps one with subscriptions when its socket goes."""
        self.iserver.cell.end(self.label)
        await super().close_session(True)

    async def read(self, params: ua.ReadParameters) -> list[ua.DataValue]:
        """Read."""
        _bounded(params.NodesToRead, MOST_ITEMS)
        return await super().read(params)

    async def browse(self, params: ua.BrowseParameters) -> list[ua.BrowseResult]:
        """Browse."""
        _bounded(params.NodesToBrowse, MOST_BROWSED)
        return await super().browse(params)

    async def translate_browsepaths_to_nodeids(
        self, params: list[ua.BrowsePath]
    ) -> list[ua.BrowsePathResult]:
        """Find nodes by their paths."""
        _bounded(params, MOST_BROWSED)
        return await super().translate_browsepaths_to_nodeids(params)

    async def create_monitored_items(
        self, params: ua.CreateMonitoredItemsParameters
    ) -> list[ua.MonitoredItemCreateResult]:
        """Watch."""
        _bounded(params.ItemsToCreate, MOST_ITEMS)
        return await super().create_monitored_items(params)

    async def write(self, params: ua.WriteParameters) -> list[ua.StatusCode]:
        """Write."""
        return await self.iserver.cell.write(self.label, _bounded(params.NodesToWrite, MOST_ITEMS))

    async def call(self, params: list[ua.CallMethodRequest]) -> list[ua.CallMethodResult]:
        """Call, one after the other; all are answered within `ANSWER_S`."""
        requests, until_s = _bounded(params, MOST_CALLS), time.monotonic() + ANSWER_S
        cell, user, rights = self.iserver.cell, self.user_name, self.rights
        if self._calls_waiting >= MOST_CALLS:
            raise ServiceError(ua.StatusCodes.BadTooManyOperations)
        self._calls_waiting += 1
        try:
            async with self._in_order:
                return [await cell.call(user, rights, request, until_s) for request in requests]
        finally:
            self._calls_waiting -= 1

    async def history_read(self, params: ua.HistoryReadParameters) -> list[ua.HistoryReadResult]:
        """There is none."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


def _bounded(items: list[T] | None, most: int) -> list[T]:
    if not items:
        raise ServiceError(ua.StatusCodes.BadNothingToDo)
    if len(items) > most:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)
    return items


class CellInternalServer(InternalServer):
    """asyncua's inner server, whose sessions are `CellSession`."""

    def __init__(self, cell: Cell, door: Door, hand: Handover) -> None:
        super().__init__(user_manager=door)
        self.cell, self.door, self.hand = cell, door, hand
        self.supported_tokens = (ua.UserNameIdentityToken,)
        self.allow_remote_admin = False
        self.match_discovery_source_ip = False
        self.max_connections = MOST_CONNECTIONS + MOST_STRANGERS
        self.max_pending_activation_seconds = 5.0
        self.max_pending_messages_per_connection = 100
        self.max_session_timeout_ms = 60_000.0
        self.max_subscriptions = 2 * MOST_CONNECTIONS
        self.max_monitored_item_queue_size = 100
        self.max_unacked_messages_per_subscription = 100
        self.max_lifetime_count = self.max_keep_alive_count = 3_000
        # A connection that begins another session drops the one before without ending it.
        self.sessions: weakref.WeakSet[CellSession] = weakref.WeakSet()

    def create_session(
        self, name: str, user: User | None = None, external: bool = False
    ) -> InternalSession:
        """A session of a client."""
        return CellSession(
            self, self.aspace, self.subscription_service, name, user or User(), external=external
        )

    def register_external_session(self, session: InternalSession) -> None:
        """Know a session, but let no other connection take it over.

        asyncua gives whoever names its token, a counter, the session before it has looked at
        signature and password, and leaves it to him when these are wrong.
        """
        if isinstance(session, CellSession):
            self.sessions.add(session)

    def unregister_external_session(self, session: InternalSession) -> None:
        """Forget it."""
        self.sessions.discard(session)

    def lookup_external_session(self, auth_token: ua.NodeId) -> InternalSession | None:
        """No session but one's own: see `register_external_session`."""
        return None

    def register_server(self, server: Any, conf: Any = None) -> None:
        """Refused, as this is no discovery server; asyncua takes the request from anybody."""
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)


class CellProcessor(UaProcessor):
    """Serves the messages of a connection: neither a call nor a login holds up what comes after.

    asyncua serves them one after the other, and looks at passwords in its loop.
    """

    iserver: CellInternalServer

    def __init__(self, *arguments: Any) -> None:
        super().__init__(*arguments)
        self.is_trusted = False  # a certificate that is has opened the channel
        self._calls: set[asyncio.Task[Any]] = set()

    async def process(self, header: Any, body: Buffer) -> bool:
        """Serve a message; a certificate that is not trusted opens no channel."""
        if header.MessageType == ua.MessageType.SecureOpen and not self._connection.is_open():
            opens = struct_from_binary(ua.AsymmetricAlgorithmHeader, body.copy())
            secured = opens.SecurityPolicyURI != NO_SECURITY
            untrusted = self.iserver.door.untrusted
            if secured and (why := await asyncio.to_thread(untrusted, opens.SenderCertificate)):
                self.iserver.hand(Notice(f"{self.name}: {why}"))
                status = ua.StatusCode(ua.StatusCodes.BadCertificateUntrusted)
                error = ua.ErrorMessage(status, "not trusted")
                self._transport.write(uatcp_to_binary(ua.MessageType.Error, error))
                return False
            goes_on = bool(await super().process(header, body))
            self.is_trusted = secured and self._connection.is_open()
            return goes_on
        return bool(await super().process(header, body))

    async def close(self) -> None:
        """End a connection with its session, also where that has only timed out.

        A PLC that lost its power says no good-bye, and would keep its place for ever.
        """
        await super().close()
        self._transport.abort()

    def _should_close_session_on_transport_loss(self) -> bool:
        """With subscriptions too, for no other connection may take it over."""
        return True

    async def process_message(self, seqhdr: Any, body: Buffer) -> Any:
        """Serve a service; a call beside what comes after it."""
        if nodeid_from_binary(body.copy()) != CALL:
            return await super().process_message(seqhdr, body)
        task = asyncio.create_task(super().process_message(seqhdr, body))
        self._calls.add(task)
        task.add_done_callback(self._calls.discard)
        return True

    async def _process_message(
        self, typeid: Any, requesthdr: Any, seqhdr: Any, body: Buffer
    ) -> Any:
        again = body.copy()
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, body)
        except LoginWaitsError as waits:
            login = waits.login
        await self.iserver.door.look(login)
        try:
            return await super()._process_message(typeid, requesthdr, seqhdr, again)
        finally:
            self.iserver.door.answers.pop(login, None)


class CellProtocol(OPCUAProtocol):
    """A connection; asyncua gathers what comes for a message of any size that its header names."""

    _buffer: bytes
    processor: UaProcessor | None

    @property
    def is_trusted(self) -> bool:
        """Whether a trusted certificate has opened its channel."""
        return isinstance(self.processor, CellProcessor) and self.processor.is_trusted

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take it; of too many strangers the oldest goes of the address that has the most."""
        strangers = [c for c in self.clients if isinstance(c, CellProtocol) and not c.is_trusted]
        if len(strangers) >= MOST_STRANGERS:
            ((crowd, _),) = Counter(c.peer_name[0] for c in strangers).most_common(1)
            oldest = next(c for c in strangers if c.peer_name[0] == crowd)
            self.clients.remove(oldest)
            if oldest.transport is not None:
                oldest.transport.abort()
        super().connection_made(transport)
        if self.processor is not None:
            self.processor = CellProcessor(self.iserver, self.transport, self.limits)
            self.processor.set_policies(self.policies)

    def data_received(self, data: bytes) -> None:
        """Take bytes; who sends more than a chunk without an end is cut off."""
        super().data_received(data)
        if len(self._buffer) > CHUNK_BYTES and self.transport is not None:
            self._buffer = b""
            self.transport.close()


class CellBinaryServer(BinaryServer):
    """Listens."""

    def _make_protocol(self) -> OPCUAProtocol:
        return CellProtocol(
            self.iserver, self._policies, self.clients, self.closing_tasks, self.limits
        )


class CellServer(Server):
    """asyncua's server with one endpoint, signed and encrypted, for users with passwords."""

    iserver: CellInternalServer

    def __init__(self, settings: ServerSettings, cell: Cell, door: Door, hand: Handover) -> None:
        super().__init__(iserver=CellInternalServer(cell, door, hand))
        self._settings = settings
        self.name = "robocal cell"
        self.manufacturer_name, self.product_uri = "robocal_ros", "urn:robocal_ros:plc_bridge"
        self.application_type = ua.ApplicationType.Server
        self.set_security_policy([ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt])
        self.set_endpoint(f"opc.tcp://{settings.host}:{settings.port}/robocal")
        self.limits = TransportLimits(CHUNK_BYTES, CHUNK_BYTES, 4, MESSAGE_BYTES)

    async def prepare(self) -> None:
        """Read the certificate, make the nodes."""
        folder = self._settings.folder
        await self.init()
        await self.load_certificate(folder / SERVER)
        await self.load_private_key(folder / KEY)
        await self.set_application_uri(application_uri(read_certificate(folder / SERVER)))
        model = InformationModel(self, self._settings.enumerations, self._settings.beams)
        await model.build()
        self.iserver.cell.model = model
        # A look for garbage through the standard's address space would take hundreds of
        # milliseconds, in which no heartbeat is passed on.
        gc.collect()
        gc.freeze()

    async def start(self) -> None:
        """Listen. Raises `OSError` where the port is taken; it may then be tried again."""
        if not self._policies:
            await self._setup_server_nodes()
            await self.iserver.start()
        self.bserver = CellBinaryServer(
            self.iserver, self._settings.host, self._settings.port, self.limits
        )
        self.bserver.set_policies(self._policies)
        await self.bserver.start()


class _Notices(logging.Handler):
    """What asyncua logs, such as requests that make no sense, for the node's own log."""

    def __init__(self, hand: Handover) -> None:
        super().__init__(logging.WARNING)
        self._hand = hand

    def emit(self, record: logging.LogRecord) -> None:
        found = record.exc_info[1] if record.exc_info else None
        cause = f": {type(found).__name__}: {found}" if found else ""
        self._hand(Notice(f"OPC UA: {record.getMessage()[:200]}{cause[:200]}"))


@dataclass
class ServerState:
    """How the server is; written by its thread, read by the node's."""

    listening: bool = False
    trouble: str = "starts"
    sessions: tuple[str, ...] = ()


class ServerThread:
    """Runs the server until `stop`; a defect in it ends neither the process nor the thread."""

    def __init__(self, settings: ServerSettings, hand: Handover) -> None:
        self.state = ServerState()
        self.cell = Cell(settings.beams, settings.timing, hand)
        self._settings, self._hand = settings, hand
        self._loop: asyncio.AbstractEventLoop | None = None
        self._ending: asyncio.Event | None = None
        self._stopped = False
        self._tasks: set[asyncio.Future[Any]] = set()
        self._expelling: asyncio.Future[None] | None = None
        self._latest: dict[str, tuple[Sequence[tuple[str, ua.Variant]], datetime, float]] = {}
        self._log = _Notices(hand)
        self._thread = threading.Thread(target=self._run, name="opc_ua", daemon=True)
        self._thread.start()

    def show(
        self, source: str, values: Sequence[tuple[str, ua.Variant]], at: datetime, now_s: float
    ) -> None:
        """Show what a source said; what comes before the server is up, then. Thread-safe."""
        self._latest[source] = values, at, now_s
        self.post(lambda model: model.show(source, values, at, now_s))

    def post(self, act: Callable[[InformationModel], Any]) -> None:
        """Let the loop await ``act`` of the model; nothing while there is none. Thread-safe."""
        if self._loop is not None and self.state.listening:
            with contextlib.suppress(RuntimeError):  # it has ended meanwhile
                self._loop.call_soon_threadsafe(self._begin, act)

    def _begin(self, act: Callable[[InformationModel], Any]) -> None:
        task = asyncio.ensure_future(act(self.cell.model))
        self._tasks.add(task)
        task.add_done_callback(self._ended)

    def _ended(self, task: "asyncio.Future[Any]") -> None:
        self._tasks.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            self._hand(Notice(f"a defect of this software: {type(error).__name__}: {error}"))

    def set_active(self, active: bool) -> None:
        """Methods and writes act, or are refused; what is shown goes on."""
        self.cell.restart()
        self.cell.active = active

    def stop(self) -> None:
        """End the server and its thread."""
        self._stopped = True
        self.cell.active = False
        if self._loop is not None and self._ending is not None:
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(self._ending.set)
        self._thread.join(STOP_S + AGAIN_S)

    def _run(self) -> None:
        logger = logging.getLogger("asyncua")
        logger.addHandler(self._log)
        logger.propagate = False
        logger.setLevel(logging.WARNING)
        while not self._stopped:
            try:
                asyncio.run(self._serve())
            except Exception as error:
                self.state.trouble = f"{type(error).__name__}: {error}"
                self._hand(Notice(f"the OPC UA server starts anew: {self.state.trouble}"))
                time.sleep(AGAIN_S)
        logger.removeHandler(self._log)

    async def _serve(self) -> None:
        self._ending = asyncio.Event()
        self._loop = asyncio.get_running_loop()
        door = Door(self._settings.folder, self._hand)
        server = CellServer(self._settings, self.cell, door, self._hand)
        await server.prepare()
        registers = ModbusServer(
            RegisterImage(self.cell),
            self._settings.modbus_clients,
            lambda words: self._hand(Notice(words)),
        )
        try:
            await self._listen(server)
            for source, latest in list(self._latest.items()):
                await self.cell.model.show(source, *latest)
            while not self._stopped:
                await self._look(server)
                await self._open_registers(registers)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._ending.wait(), LOOK_S)
        finally:
            self.state.listening = False
            self.state.sessions = ()
            await registers.stop()
            if server.bserver is not None:
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(server.stop(), STOP_S)

    async def _listen(self, server: CellServer) -> None:
        assert self._ending is not None
        while not self._stopped:
            try:
                await server.start()
            except OSError as error:
                self.state.trouble = f"cannot listen: {error.strerror or error}"
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(self._ending.wait(), AGAIN_S)
            else:
                self.state.listening, self.state.trouble = True, ""
                return

    async def _open_registers(self, registers: ModbusServer) -> None:
        """Listen by Modbus too; a port that is refused is tried again, and holds up no OPC UA."""
        if not self._settings.modbus_clients or registers.is_listening:
            return
        try:
            await registers.start(self._settings.host, self._settings.modbus_port)
        except OSError as error:
            self.state.trouble = f"Modbus: cannot listen: {error.strerror or error}"
        else:
            self.state.trouble = ""

    async def _look(self, server: CellServer) -> None:
        model = self.cell.model
        await model.look(time.monotonic())
        await model.set(ACTIVE, ua.Variant(self.cell.active))
        if self._expelling is None or self._expelling.done():  # a disk that hangs holds up nothing
            self._expelling = asyncio.ensure_future(self._expel(server.iserver))
            self._expelling.add_done_callback(self._ended)
        names = [s.label for s in server.iserver.sessions if s.is_activated()]
        self.state.sessions = tuple(sorted(names))

    async def _expel(self, iserver: CellInternalServer) -> None:
        """End the sessions of users who were taken out, or given another password or role."""
        users = [(s, s.user) for s in iserver.sessions if s.is_activated()]
        accounts = await asyncio.to_thread(iserver.door.accounts) if users else None
        if accounts is None:
            return
        for session, user in users:
            if session.user is user and accounts.get(user.name) != user.account:
                words = "its user was taken out, or has another password or role"
                self._hand(Notice(f"{session.label} is ended: {words}"))
                await session.close_session()
