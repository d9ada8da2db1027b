# SPDX-License-Identifier: Apache-2.0
"""A cell by OPC UA, as a PLC sees it: its state, a gap, decisions; who gets in, what is not.

The PLC is asyncua's own client with its own certificate; maintenance_node and the bridge are
processes, and the robot stands.
"""

import contextlib
import json
import struct
import time
from collections.abc import Callable, Coroutine, Iterator
from datetime import UTC, datetime, timedelta
from itertools import takewhile
from pathlib import Path
from typing import Any

import pytest
from asyncua import ua
from conftest import DEADLINE_S
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from other_stack import gap_by_another_stack
from pymodbus.client import ModbusTcpClient
from robocal_msgs.msg import (
    AccuracyState,
    BeamEvent,
    CalibrationQuality,
    GapOpen,
    MaintenanceStatus,
    ToolFrame,
)
from std_srvs.srv import Trigger
from structured_text import StructuredText, samples
from test_maintenance_calls import Plc, candidates, process

from bench.live.opc_ua import PlcClient, free_port, security_folder
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.plc import access
from robocal_ros.plc.cell import CONTEST_S
from robocal_ros.plc.modbus import CANCEL, CYCLE, INPUT_WORDS, INPUTS, RUN
from robocal_ros.plc.node import PlcBridgeNode
from robocal_ros.ros import endpoints
from robocal_ros.ros.endpoints import trigger_text

BRIDGE = "/plc_bridge_node"


class Line:
    """One cell with its bridge, and the PLCs that a test connects."""

    def __init__(self, graph: Any, folder: Path) -> None:
        self.graph, self.do = graph, graph.meanwhile
        self.folder, self.port = security_folder(folder), free_port()
        self.modbus_port = free_port()
        self.clients: list[PlcClient] = []
        self.number = 9000
        self.gaps: list[GapOpen] = graph.collect(GapOpen, "gap_open")
        self.edges: list[BeamEvent] = graph.collect(BeamEvent, "beam_events")
        self.maintenance = Plc(graph, lambda: process(graph, mortal=True), bridge=False)
        # tcf_node says it once, at its start: before this server is up
        self.tool = graph.probe.create_publisher(ToolFrame, "tcf_node/tool", endpoints.LATCHED)
        frame = ToolFrame(child_frame_id="tcp", revision=3, state=ToolFrame.ACCEPTED)
        frame.tool.translation.z = 0.1505
        self.tool.publish(frame)
        quality = "fixture_node/quality"
        self.fixture = graph.probe.create_publisher(CalibrationQuality, quality, endpoints.LATCHED)
        reason = "plate moved by 0.51 mm"
        self.fixture.publish(CalibrationQuality(code=1, candidate_id=9, reason=reason))
        self.bridge = self.start()
        self.plc = self.connected()
        self.plc.start(self.plc.program())

    def start(self) -> Any:
        settings = {
            "security_dir": str(self.folder),
            "host": "127.0.0.1",
            "port": self.port,
            "beams": "['x', 'y']",
            "modbus_clients": "['127.0.0.1']",
            "modbus_port": self.modbus_port,
        }
        return self.graph.start("plc_bridge_node", settings, mortal=True)

    def begin_again(self) -> None:
        """Another bridge in place of one that has ended, and the PLC on it."""
        self.bridge = self.start()
        self.do(self.plc, self.plc.connect_once_there())

    def connected(self, user: str = "plc", name: str = "line") -> PlcClient:
        client = PlcClient(self.folder, self.port, user, name)
        self.clients.append(client)
        self.do(client, client.connect_once_there())
        return client

    def read(self, path: str) -> Any:
        return self.do(self.plc, self.plc.read(path))

    def call(self, method: str, *arguments: Any, client: PlcClient | None = None) -> list[Any]:
        plc = client or self.plc
        return self.do(plc, plc.call(method, *arguments))

    @property
    def doing(self) -> str:
        """Why the gap counts as closed; empty: it is open."""
        return str(self.maintenance.statuses[-1].doing)

    def open(self) -> None:
        self.plc.is_open = self.plc.beating = True
        self.graph.spin_until(lambda: not self.doing, "the gap is open")

    def quiet(self) -> None:
        """The program writes nothing more, and what it wrote has come."""
        self.plc.beating = False
        self.graph.spin_for(0.3)
        self.gaps.clear()

    def transition(self, which: int) -> None:
        asked = Transition(id=which)
        assert self.graph.call(ChangeState, f"{BRIDGE}/change_state", transition=asked).success

    def close(self) -> None:
        for client in self.clients:
            client.close()


@pytest.fixture(scope="module")
def line(next_graph: Callable[[], Any], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Line]:
    with pytest.MonkeyPatch.context() as patch:
        graph = next_graph()
        patch.setenv("ROBOCAL_STATE", str(graph.state))
        made = Line(graph, tmp_path_factory.mktemp("plc"))
        yield made
        made.close()


def refused(work: Callable[[], Any]) -> str:
    """The status with which a request ends."""
    with pytest.raises(ua.UaStatusCodeError) as caught:
        work()
    return type(caught.value).__name__


def u32(number: int) -> ua.Variant:
    return ua.Variant(number, ua.VariantType.UInt32)


def test_what_is_shown_is_what_the_nodes_say(line):
    line.quiet()
    status: MaintenanceStatus = line.maintenance.statuses[-1]
    said: AccuracyState = line.maintenance.states[-1]
    assert line.read("Maintenance.State") == status.state == MaintenanceStatus.IDLE
    assert line.read("Maintenance.AtHome") is status.at_home is True
    assert line.read("Accuracy.Reason") == said.reason
    assert line.read("Accuracy.State") == said.state
    assert line.read("Accuracy.Serial") == "K7"
    assert line.read("Candidates.ThermalId") == 0
    beat = line.read("Gap.Beat")
    line.graph.spin_until(lambda: line.read("Gap.Beat") > beat, "it is counted up")
    shown = line.do(line.plc, line.plc.node("Accuracy.State").read_data_value())
    same = takewhile(lambda state: state.state == said.state, reversed(line.maintenance.states))
    stamps = [state.header.stamp.sec for state in same]  # it is as of the last change
    assert min(stamps) <= shown.SourceTimestamp.timestamp() < max(stamps) + 1.0
    tool = [line.read(f"Tool.{name}") for name in ("Name", "Revision", "State", "ZMm")]
    assert tool == ["tcp", 3, ToolFrame.ACCEPTED, pytest.approx(150.5)]
    fixture = [line.read(f"Fixture.{name}") for name in ("Code", "Id", "Reason")]
    assert fixture == [Code.ACCEPT, 9, "plate moved by 0.51 mm"]


def test_codes_are_an_enumeration_of_the_same_table(line):
    async def table() -> tuple[list[tuple[str, int]], list[str]]:
        kind = line.plc.client.get_node(await line.plc.node("LastCycle.Code").read_data_type())
        definition = await kind.read_data_type_definition()
        (strings,) = await kind.get_properties()
        texts = [text.Text for text in await strings.read_value()]
        return [(field.Name, field.Value) for field in definition.Fields], texts

    fields, texts = line.do(line.plc, table())
    assert fields == [(code.name, int(code)) for code in Code]
    assert texts == [code.name for code in Code]


def test_a_gap_by_opc_ua_alone(line):
    line.open()
    before = line.read("LastCycle.Run")
    begun = line.call("Run", "4711", 30.0)
    assert begun[:2] == [True, Code.ACCEPT], begun
    line.graph.spin_until(lambda: line.call("Status", "4711")[4] == Code.ACCEPT, "it ends")
    success, status, _, state, code, complete, *_ = line.call("Status", "4711")
    assert (success, status, code, complete) == (True, Code.ACCEPT, Code.ACCEPT, True)
    assert state == MaintenanceStatus.IDLE
    line.graph.spin_until(lambda: line.read("LastCycle.CycleId") == "4711", "it is shown")
    again = line.call("Run", "4711", 30.0)
    assert again[:2] == [True, Code.ACCEPT]
    assert again[4:] == [Code.ACCEPT, True]
    assert line.read("LastCycle.Run") == before + 1
    # the service's own refusals, in its own words
    unknown = line.call("Status", "4712")
    assert unknown[:2] == [False, Code.BAD_INPUT]
    assert "cycle '4712' is not known" in unknown[2]
    assert line.call("Run", "", 30.0)[1] == Code.BAD_INPUT
    assert line.call("Cancel")[:2] == [False, Code.CONFLICT]


def test_an_engineer_decides_and_the_history_knows_who(line):
    ada = line.connected("ada", "panel")
    first, second = candidates(line.graph, 2)
    line.graph.spin_until(lambda: line.read("Candidates.ThermalId") == second, "it waits")
    for method in ("Accept", "Reject", "Rollback"):
        assert refused(lambda m=method: line.call(m, second, "hm")) == "BadUserAccessDenied"
    assert refused(lambda: line.call("Acknowledge")) == "BadUserAccessDenied"
    ruled_out = line.call("Reject", first, "older", client=ada)
    assert ruled_out[:2] == [True, Code.ACCEPT], ruled_out
    success, status, message, revision = line.call("Accept", second, "drift", client=ada)
    assert (success, status, revision) == (True, Code.ACCEPT, 1), message
    assert line.call("Accept", 99, "none", client=ada)[:2] == [False, Code.BAD_INPUT]
    assert line.call("Rollback", 0, "none", client=ada)[1] == Code.BAD_INPUT
    assert line.call("Acknowledge", client=ada)[:2] == [True, Code.ACCEPT]
    arm = load_robot("ur10")
    with CalibrationHistory.open(
        "K7", model_hash=arm.model_hash, state_dir=line.graph.state
    ) as history:
        last = history.decisions(1)[0]
    assert (last.calibration_id, last.by, last.reason) == (second, "ada", "drift")


def test_a_latched_heartbeat_is_not_passed_on(line):
    """A gateway that repeats its last value with the time that it had."""
    line.quiet()
    at = datetime.now(UTC)

    def write(echo: int, when: datetime | None) -> None:
        line.do(line.plc, line.plc.write("Gap.Heartbeat", u32(echo), when))

    write(7, at)
    line.graph.spin_until(lambda: len(line.gaps) == 1, "it is passed on")
    for again in (at, at - timedelta(microseconds=1), at - timedelta(hours=1), None):
        assert refused(lambda when=again: write(7, when)) == "BadInvalidTimestamp"
    write(8, at + timedelta(microseconds=1))
    line.graph.spin_until(lambda: len(line.gaps) >= 2, "it goes on")
    line.graph.spin_for(0.3)
    assert [(gap.open, gap.echo) for gap in line.gaps] == [(True, 7), (True, 8)]
    line.plc.stamped = True  # from now on this session gives times
    line.open()


def test_a_program_that_stops_closes_the_gap_though_its_values_stand(line):
    line.open()
    echo = line.read("Gap.Heartbeat")
    assert echo > 0
    line.plc.beating = False
    line.graph.spin_until(lambda: line.doing, "the gap closes by its own rule", 5.0)
    line.graph.spin_for(0.2)
    line.gaps.clear()
    line.graph.spin_for(1.0)
    assert not line.gaps  # nothing was repeated
    assert line.read("Gap.Heartbeat") >= echo
    assert line.call("Run", "closed", 30.0)[:2] == [False, Code.CONFLICT]


def test_while_two_plcs_write_the_gap_is_closed(line):
    line.open()
    other = line.connected("plc", "panel")
    beat = line.read("Gap.Beat")
    assert (
        refused(lambda: line.do(other, other.write("Gap.Heartbeat", u32(beat))))
        == "BadInvalidState"
    )
    line.graph.spin_until(lambda: line.doing, "it closes", 5.0)
    line.open()  # once the other one is silent
    line.do(other, other.client.disconnect())


def test_beams_that_the_plc_writes_become_events_at_their_own_time(line):
    line.edges.clear()

    def now() -> datetime:  # a second later it is another one's clock
        found = datetime.now(UTC)
        return found.replace(microsecond=found.microsecond // 1000 * 1000)

    def write(blocked: bool, when: datetime | None) -> None:
        value = ua.Variant(blocked, ua.VariantType.Boolean)
        line.do(line.plc, line.plc.write("Beams.x.Blocked", value, when))

    async def with_time(blocked: bool, when: datetime) -> None:
        nodes = [line.plc.node(f"Beams.y.{part}") for part in ("Blocked", "Time")]
        values = [
            ua.DataValue(ua.Variant(blocked, ua.VariantType.Boolean)),
            ua.DataValue(ua.Variant(when, ua.VariantType.DateTime)),
        ]
        for status in await line.plc.client.write_values(nodes, values, False):
            status.check()

    ms, at = timedelta(milliseconds=1), now()
    write(False, at)
    write(True, at + 20 * ms)
    write(False, at + 30 * ms)
    assert refused(lambda: write(True, at)) == "BadInvalidTimestamp"  # out of order
    assert refused(lambda: write(True, None)) == "BadInvalidTimestamp"
    assert refused(lambda: write(True, at + timedelta(hours=1))) == "BadInvalidTimestamp"
    later = now()
    line.do(line.plc, with_time(True, later))
    line.do(line.plc, with_time(False, later + 10 * ms))
    line.graph.spin_until(lambda: len(line.edges) == 3, "three edges")
    found = [
        (e.beam, e.edge, e.header.stamp.sec + 1e-9 * e.header.stamp.nanosec, e.stamp_sigma_s)
        for e in line.edges
    ]
    x, y = at.timestamp(), later.timestamp() + 0.01
    wanted = [("x", 1, x + 0.02, 1e-3), ("x", 2, x + 0.03, 1e-3), ("y", 2, y, 1e-3)]
    for one, other in zip(found, wanted, strict=True):
        assert one[:2] == other[:2]
        assert one[2:] == pytest.approx(other[2:], abs=1e-6)
    assert {e.header.frame_id for e in line.edges} == {"station"}


def test_a_gap_by_the_register_map_of_modbus(line):
    """A gateway reads and writes its whole image in each of its cycles."""
    line.quiet()
    gateway = ModbusTcpClient("127.0.0.1", port=line.modbus_port)
    line.graph.spin_until(gateway.connect, "Modbus")
    line.graph.spin_for(CONTEST_S)  # the other PLC is silent
    request = [0] * 6

    def cycle() -> dict[str, float]:
        line.graph.spin_for(0.05)
        words = gateway.read_input_registers(0, count=INPUT_WORDS).registers
        data = struct.pack(f">{INPUT_WORDS}H", *words)
        found = {r.path: struct.unpack_from(f">{r.kind}", data, 2 * r.address)[0] for r in INPUTS}
        echo = found["Gap.Beat"]
        written = gateway.write_registers(0, [echo >> 16, echo & 0xFFFF, *request])
        assert not written.isError()
        return found

    def until(holds: Callable[[dict[str, float]], bool]) -> dict[str, float]:
        until_s = time.monotonic() + DEADLINE_S
        while not holds(found := cycle()):
            assert time.monotonic() < until_s, (found, line.doing)
        return found

    def answers(found: dict[str, float], number: int) -> bool:
        return found["Answer.Number"] == number and found["Answer.Status"] != 0

    until(lambda found: not line.doing)
    request[:] = struct.unpack(">6H", struct.pack(">IHHI", 1, RUN, 30, 815))
    assert until(lambda found: answers(found, 1))["Answer.Status"] == Code.ACCEPT
    ended = until(lambda found: found[CYCLE] == 815 and found["LastCycle.Code"])
    assert (ended["LastCycle.Code"], ended["Valid"], ended["Active"]) == (Code.ACCEPT, 1, 1)
    tool = [ended[f"Tool.{name}"] for name in ("Revision", "State", "ZMm")]
    assert tool == [3, ToolFrame.ACCEPTED, pytest.approx(150.5)]
    assert line.call("Status", "815")[4] == Code.ACCEPT
    request[:] = struct.unpack(">6H", struct.pack(">IHHI", 2, CANCEL, 0, 0))
    assert until(lambda found: answers(found, 2))["Answer.Status"] == Code.CONFLICT
    gateway.close()
    line.graph.spin_until(lambda: line.doing, "the gap closes by its own rule", 5.0)


def by_the_page(
    line: Any, title: str, take: Callable[[Any], None], give: Callable[[Any], None]
) -> None:
    """Run a program of docs/plc.md, a cycle each 50 ms, until it has given one gap."""
    line.quiet()
    line.graph.spin_until(lambda: line.doing, "the gap is closed", 5.0)
    line.graph.spin_for(CONTEST_S)  # the other PLC is silent
    program = StructuredText(samples()[title], time.monotonic)
    number = line.number = line.number + 100  # it goes on from that of the last cycle
    program["bCellSafe"], program["udiNumber"] = True, number
    cycles: list[str] = []

    def until(holds: Callable[[], object]) -> None:
        until_s = time.monotonic() + DEADLINE_S
        while not holds():
            assert time.monotonic() < until_s, (program._values, line.doing)
            line.graph.spin_for(0.05)
            take(program)
            program.scan()
            give(program)
            if not line.doing:
                assert not program["bProducing"]
            cycles.append(line.maintenance.statuses[-1].last.cycle_id)

    until(lambda: program["bProducing"])
    program["bPause"] = True
    until(lambda: program["iStep"] == 4)
    until(lambda: program["bProducing"])
    assert program["udiNumber"] == number + 1, "its first call has begun the cycle"
    assert line.call("Status", str(number + 1))[4] == Code.ACCEPT
    assert cycles[-1] == str(number + 1) != cycles[0]


def test_a_gap_by_the_program_of_the_page(line):
    paths = {
        "udiBeat": "Gap.Beat",
        "diState": "Maintenance.State",
        "diCode": "LastCycle.Code",
        "sLast": "LastCycle.CycleId",
        "bAtHome": "Maintenance.AtHome",
    }
    called: list[Any] = []

    def take(program: StructuredText) -> None:
        read = line.do(line.plc, line.plc.read_all(list(paths.values())))
        for name, value in zip(paths, read, strict=True):
            program[name] = value
        program["bBeatGood"] = True  # read_all raises else

    def give(program: StructuredText) -> None:
        at = datetime.now(UTC) if line.plc.stamped else None
        echo = u32(program["udiHeartbeat"])
        line.do(line.plc, line.plc.write("Gap.Heartbeat", echo, at))
        if program["bRun"] and not called:
            called.append(line.plc.start(line.plc.call("Run", program["sMine"], 60.0)))
        elif not program["bRun"]:
            called.clear()
        program["bRunDone"] = bool(called) and called[0].done()
        program["bSuccess"] = program["bRunDone"] and called[0].result()[0]

    by_the_page(line, "In Structured Text", take, give)


def test_a_gap_by_the_program_of_the_page_and_modbus(line):
    gateway = ModbusTcpClient("127.0.0.1", port=line.modbus_port)
    line.graph.spin_until(gateway.connect, "Modbus")

    def take(program: StructuredText) -> None:
        program["awIn"] = gateway.read_input_registers(0, count=INPUT_WORDS).registers
        program["bOnline"] = True

    def give(program: StructuredText) -> None:
        assert not gateway.write_registers(0, program["awOut"]).isError()

    by_the_page(line, "In Structured Text, by Modbus", take, give)
    gateway.close()


def test_a_gap_by_another_stack(line, tmp_path):
    """What asyncua's own client would not notice."""
    line.quiet()
    seen = gap_by_another_stack(line.graph, line.folder, line.port, tmp_path, "4715", 30.0)
    assert {"Accuracy", "Maintenance", "LastCycle", "Gap", "Methods"} <= {*seen["objects"]}
    assert seen["codes"] == [code.name for code in Code]
    assert (seen["wrongType"], seen["readOnly"]) == ("BadTypeMismatch", "BadNotWritable")
    assert (seen["accept"], seen["missing"]) == ("BadUserAccessDenied", "BadArgumentsMissing")
    assert seen["heartbeat"] == "Good"
    assert seen["run"][:3] == ["Good", True, Code.ACCEPT]
    assert (seen["lastCode"], seen["status"][:2]) == (Code.ACCEPT, ["Good", True])
    assert line.maintenance.statuses[-1].last.cycle_id == "4715"
    line.graph.spin_until(lambda: line.doing, "it has closed the gap", 5.0)


# ---- who gets in --------------------------------------------------------------------------------


def test_nobody_gets_in_without_certificate_user_and_password(line):
    def connect(change: Callable[[PlcClient], Any]) -> str:
        with contextlib.closing(PlcClient(line.folder, line.port)) as stranger:
            client = change(stranger)
            return refused(lambda: line.do(stranger, client.connect()))

    def wrong_password(stranger: PlcClient) -> Any:
        return line.do(stranger, stranger.secured(stranger.made("plc", "not it at all")))

    def unknown_user(stranger: PlcClient) -> Any:
        return line.do(stranger, stranger.secured(stranger.made("eve", "who knows")))

    def anonymous(stranger: PlcClient) -> Any:
        client = line.do(stranger, stranger.secured(stranger.made()))
        client._username = client._password = None
        return client

    assert connect(wrong_password) == "BadUserAccessDenied"
    assert connect(unknown_user) == "BadUserAccessDenied"
    assert connect(anonymous) in {"BadIdentityTokenRejected", "BadIdentityTokenInvalid"}
    assert connect(PlcClient.made) == "BadCertificateUntrusted"


def test_an_untrusted_certificate_is_turned_away_and_kept_for_a_person(line, tmp_path):
    elsewhere, rejected = security_folder(tmp_path / "elsewhere"), line.folder / access.REJECTED
    (elsewhere / access.SERVER).write_bytes((line.folder / access.SERVER).read_bytes())
    stranger, before = PlcClient(elsewhere, line.port), {*rejected.glob("*.der")}
    assert refused(lambda: line.do(stranger, stranger.connect())) == "BadCertificateUntrusted"
    (kept,) = {*rejected.glob("*.der")} - before
    assert kept.read_bytes() == (elsewhere / access.CLIENTS / "line.der").read_bytes()
    kept.rename(line.folder / access.TRUSTED / "new.der")  # a person trusts it
    line.do(stranger, stranger.connect())
    assert line.do(stranger, stranger.read("Active")) is True
    stranger.close()
    (line.folder / access.TRUSTED / "new.der").unlink()


def test_a_trusted_certificate_shown_over_another_ones_channel_opens_nothing(line, tmp_path):
    """Certificates are public: whoever has seen one may name it in CreateSession."""
    elsewhere = security_folder(tmp_path / "elsewhere")
    (elsewhere / access.SERVER).write_bytes((line.folder / access.SERVER).read_bytes())
    stranger = PlcClient(elsewhere, line.port)
    trusted = (line.folder / access.CLIENTS / "line.der").read_bytes()

    async def steal() -> None:
        client = await stranger.secured(stranger.made())
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        create = client.uaclient.create_session

        async def lie(parameters: Any) -> Any:
            parameters.ClientCertificate = trusted
            return await create(parameters)

        client.uaclient.create_session = lie
        client.security_policy.asymmetric_cryptography.verify = lambda *_: None
        await client.create_session()
        await client.activate_session(username="plc", password="a plc's password")

    assert refused(lambda: line.do(stranger, steal())) == "BadCertificateUntrusted"
    stranger.close()


def test_nobody_takes_over_the_session_of_another(line):
    """asyncua's tokens count up, and it binds a session before it looks at who asks for it."""
    line.open()
    thief = PlcClient(line.folder, line.port)
    token = line.plc.client.uaclient.protocol.authentication_token

    async def steal() -> None:
        client = thief.made()  # no certificate, no encryption
        await client.connect_socket()
        await client.send_hello()
        await client.open_secure_channel()
        client.uaclient.protocol.authentication_token = token
        parameters = ua.ActivateSessionParameters()
        parameters.UserIdentityToken = ua.AnonymousIdentityToken()
        with contextlib.suppress(ua.UaStatusCodeError):
            await client.uaclient.activate_session(parameters)
        node = client.get_node(ua.NodeId("Cell.Gap.Heartbeat", 2))
        await node.write_value(ua.DataValue(u32(0)))

    with pytest.raises((ua.UaError, ConnectionError)):
        line.do(thief, steal())
    thief.close()
    line.graph.spin_for(0.3)
    assert not line.doing  # the PLC's own gap is still open


def test_a_user_who_is_taken_out_cannot_come_back(line):
    users = access.Users(line.folder)
    users.put("guest", access.Role.OPERATOR, "ten letters.")
    guest = PlcClient(line.folder, line.port)
    client = line.do(guest, guest.secured(guest.made("guest", "ten letters.")))
    line.do(guest, client.connect())
    line.do(guest, client.disconnect())
    users.remove("guest")
    client = line.do(guest, guest.secured(guest.made("guest", "ten letters.")))
    assert refused(lambda: line.do(guest, client.connect())) == "BadUserAccessDenied"
    guest.close()
    assert "ten letters" not in json.dumps((line.folder / access.USERS).read_text())


# ---- its life -----------------------------------------------------------------------------------


def test_an_inactive_bridge_shows_the_state_and_does_nothing(line):
    line.open()
    line.gaps.clear()
    line.transition(Transition.TRANSITION_DEACTIVATE)
    line.graph.spin_until(lambda: line.gaps and not line.gaps[-1].open, "it closes the gap")
    line.graph.spin_until(lambda: line.doing, "the gap closes", 5.0)
    assert refused(lambda: line.call("Run", "4713", 30.0)) == "BadInvalidState"
    assert (
        refused(lambda: line.do(line.plc, line.plc.write("Gap.Heartbeat", u32(1))))
        == "BadInvalidState"
    )
    beat = line.read("Gap.Beat")
    line.graph.spin_until(lambda: line.read("Gap.Beat") > beat, "the state goes on")
    line.graph.spin_until(lambda: line.read("Active") is False, "it says so")
    line.transition(Transition.TRANSITION_ACTIVATE)
    line.open()


def test_a_bridge_that_is_killed_in_a_gap_closes_it_and_nothing_is_lost(line):
    line.open()
    assert line.call("Run", "before the end", 30.0)[0]
    line.graph.spin_until(lambda: line.call("Status", "before the end")[4] != Code.NONE, "it ends")
    line.bridge.kill()
    began_s = time.monotonic()
    line.graph.spin_until(lambda: line.doing, "the gap closes by its own rule", 5.0)
    # 0.5 s after the last heartbeat, 0.7 s after its beat; a status comes each 0.2 s
    assert time.monotonic() - began_s < 2.0
    line.begin_again()
    line.open()
    known = line.call("Status", "before the end")
    assert known[:2] == [True, Code.ACCEPT]
    assert known[4] == Code.ACCEPT


def test_what_falls_silent_is_uncertain(line):
    line.open()
    line.maintenance.node.kill()

    def status() -> str:
        shown = line.do(line.plc, line.plc.node("Accuracy.State").read_data_value(False))
        return str(shown.StatusCode.name)

    line.graph.spin_until(
        lambda: status() == "UncertainNoCommunicationLastUsableValue", "it is marked", 15.0
    )
    answers = {refused(lambda: line.call("Run", "4714", 30.0)) for _ in range(2)}
    assert answers <= {"BadTimeout", "BadNoCommunication"}
    line.maintenance.statuses.clear()
    line.maintenance.node = process(line.graph)
    line.graph.spin_until(lambda: status() == "Good", "it is back", 15.0)
    line.open()
    assert line.call("Run", "after", 30.0)[0]


def test_both_threads_end_at_the_first_signal(line):
    ended = line.bridge
    assert ended.stop() == 0, ended.output
    line.begin_again()
    assert "Traceback" not in ended.output, ended.output


def test_a_stalled_executor_holds_up_no_heartbeat_and_carries_out_no_old_call(graph, tmp_path):
    """Finding: a call whose PLC had long been told that nobody answers was carried out then.

    Heartbeats waited with it, behind the diagnostics too.
    """
    called: list[Any] = []

    def cancel(request: Any, response: Any) -> Any:
        called.append(request)
        response.success, response.message = True, trigger_text(0, Code.ACCEPT, "")
        return response

    graph.probe.create_service(Trigger, "maintenance_node/cancel_trigger", cancel)
    port = free_port()
    node = graph.add(
        PlcBridgeNode,
        {"security_dir": str(security_folder(tmp_path)), "host": "127.0.0.1", "port": port},
    )
    gaps = graph.collect(GapOpen, "gap_open")
    client = PlcClient(tmp_path, port)

    def do(work: Coroutine[Any, Any, Any]) -> Any:
        return graph.meanwhile(client, work)

    try:
        do(client.connect_once_there())
        graph.spin_until(lambda: node.is_active, "it acts")
        assert do(client.call("Cancel"))[0]
        do(client.write("Gap.Heartbeat", u32(1)))
        graph.spin_until(lambda: gaps, "it is passed on")
        gaps.clear()
        called.clear()
        client.do(client.write("Gap.Heartbeat", u32(2)))  # nothing of the node runs meanwhile
        client.do(client.write("Gap.Heartbeat", u32(0)))
        assert refused(lambda: client.do(client.call("Cancel"))) == "BadTimeout"
        # the probe is spun by the same thread: what comes now was sent meanwhile, in this order
        graph.spin_until(lambda: len(gaps) == 2, "both are passed on")
        graph.spin_for(0.5)
        assert [(gap.open, gap.echo) for gap in gaps] == [(True, 2), (False, 0)]
        assert not called
        assert do(client.call("Cancel"))[0]
    finally:
        client.close()
