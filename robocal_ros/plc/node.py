# SPDX-License-Identifier: Apache-2.0
"""The bridge to a PLC: an OPC UA server with the cell's state, its calls, the gap and the beams.

docs/plc.md.
"""

import threading
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from functools import partial
from ipaddress import ip_address
from pathlib import Path
from typing import Any

from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import (
    AccuracyState,
    BeamEvent,
    CalibrationQuality,
    GapOpen,
    MaintenanceStatus,
    ToolFrame,
)
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import Trigger

from robocal_ros.adapter.inputs import InputTiming
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.conversions import header
from robocal_ros.ros.endpoints import ERROR, WARN, ExecutorQueue, Health, Refusal, ServiceCalls
from robocal_ros.ros.parameters import Setting, number

GAP_OPEN, EVENTS = "gap_open", "beam_events"
EXPIRES_DAYS = 30  # warned of so long before
SERVICES: Mapping[str, Any] = {
    "run": RunMaintenanceCycle,
    "status": GetMaintenance,
    "cancel_trigger": Trigger,
    "accept": Decide,
    "reject": Decide,
    "rollback": Decide,
    "acknowledge": Acknowledge,
}
MESSAGES: Mapping[str, Any] = {
    "accuracy_state": AccuracyState,
    "maintenance_node/status": MaintenanceStatus,
    "tcf_node/tool": ToolFrame,
    "fixture_node/quality": CalibrationQuality,
}


def constants(message: type) -> dict[str, int]:
    """Constants of a message, by name."""
    names = [name for name in dir(type(message)) if name[0].isalpha() and name.isupper()]
    return {name: int(getattr(message, name)) for name in names}


def enumerations() -> dict[str, dict[str, int]]:
    """The enumeration types of the cell, of the messages' own tables."""
    return {
        "Code": {code.name: int(code) for code in Code},
        "AccuracyLevel": constants(AccuracyState),
        "MaintenanceState": constants(MaintenanceStatus),
        "ToolState": constants(ToolFrame),
        "ToolAnswer": constants(MeasureTool.Result),
    }


def _addresses(given: list[str]) -> str | None:
    for text in filter(None, given):
        try:
            ip_address(text)
        except ValueError:
            return f"'{text}' is no IP address"
    return None


def _beam_names(names: list[str]) -> str | None:
    wrong = [name for name in names if name and not name.replace("_", "").isalnum()]
    if wrong or len(set(names)) < len(names):
        return "each a name of its own, of letters, digits and _"
    return None


SETTINGS = (
    Setting(
        "security_dir",
        "",
        "Folder of certificates and users, as `robocal plc certificates` makes it",
    ),
    Setting("host", "0.0.0.0", "Address of this machine to listen at; 0.0.0.0: all of them"),
    number("port", 4840, "TCP port; OPC UA's own is 4840", 1, 65535),
    Setting(
        "modbus_clients",
        [""],
        "Addresses of gateways that are served the register map by Modbus TCP, which has neither "
        "users nor encryption; none: it is off",
        check=_addresses,
    ),
    number("modbus_port", 502, "TCP port of that; below 1024 only root may listen", 1, 65535),
    Setting(
        "beams", [""], "Beams whose levels the PLC writes; none: it writes none", check=_beam_names
    ),
    Setting("station", "station", "Name of the station, frame_id of beam_events"),
    number(
        "beam_latency_ms",
        0.0,
        "From an edge to the time that the PLC gives it; it is subtracted",
        0.0,
        1000.0,
    ),
    number(
        "beam_jitter_ms",
        1.0,
        "Standard deviation of that; of an input that is looked at each T: T / sqrt(12)",
        1e-3,
        1000.0,
    ),
)


class PlcBridgeNode(HouseNode):
    """Serves the cell by OPC UA; acts for maintenance_node's PLC while it is active."""

    NAME = "plc_bridge_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        self._server: Any = None
        self._heartbeat_s = float("-inf")
        self._gap_lock = threading.Lock()  # nothing opens the gap after a deactivation
        self._gap_acts = False
        self._notice: tuple[float, str] | None = None
        super().__init__(**options)

    def configure(self) -> None:
        """Read certificate and users, start the server; it shows the state from here on.

        Raises `InputError` where the folder is not complete.
        """
        try:
            from robocal_ros.plc.access import document, read_certificate
            from robocal_ros.plc.server import ServerSettings, ServerThread
        except ImportError as error:
            raise InputError(
                f"{error}: pip install 'robocal_ros[plc]', which brings asyncua"
            ) from error
        settings = self.settings
        if not settings["security_dir"]:
            raise InputError(
                "security_dir is empty: make a folder by `robocal plc certificates DIR`, users by "
                "`robocal plc user DIR NAME`, and name it"
            )
        folder = Path(settings["security_dir"]).expanduser()
        found = document(folder)
        self._expires = read_certificate(folder / "server.der").not_valid_after_utc
        # rclpy's first line looks at each module's file, which beside the server takes seconds
        self.get_logger().info(f"{folder}: certificate valid until {self._expires:%Y-%m-%d}")
        if not found["users"]:
            self.get_logger().warning(f"{folder}: nobody can log in: robocal plc user DIR NAME")
        self._gap = self.add_output(GapOpen, GAP_OPEN, endpoints.HEARTBEAT)
        beams = tuple(settings["beams"])
        self._edges = self.add_output(BeamEvent, EVENTS, endpoints.RELIABLE) if beams else None
        self._calls = ServiceCalls(self, "maintenance_node", SERVICES)
        self._handed = ExecutorQueue(self, "a PLC's request", self._take)
        timing = InputTiming(settings["beam_latency_ms"] * 1e-3, settings["beam_jitter_ms"] * 1e-3)
        self._server = ServerThread(
            ServerSettings(
                settings["host"],
                settings["port"],
                folder,
                beams,
                timing,
                enumerations(),
                tuple(settings["modbus_clients"]),
                settings["modbus_port"],
            ),
            self._hand,
        )
        for topic, kind in MESSAGES.items():
            self._watch(kind, topic)

    def _watch(self, kind: type, topic: str) -> None:
        """Show a topic; not by `add_input`: it is shown while nothing acts."""
        subscription = self.create_subscription(
            kind, topic, partial(self._show, topic), endpoints.own(endpoints.LATCHED)
        )
        self._release.append(lambda: self.destroy_subscription(subscription))

    def activate(self) -> None:
        """Let the gap and the methods act."""
        self._gap_acts = True
        self._server.set_active(True)

    def deactivate(self) -> None:
        """Close the gap, refuse methods; the state is shown on."""
        self._server.set_active(False)
        with self._gap_lock:
            self._gap_acts = False
            self._gap.publish(GapOpen(open=False))

    def cleanup(self) -> None:
        """End the server."""
        server, self._server = self._server, None
        if server is not None:
            server.stop()

    # ---- from the cell to the PLC ---------------------------------------------------------------

    def _show(self, topic: str, message: Any) -> None:
        from robocal_ros.plc.model import time_of, values_of

        if self._server is None:
            return
        try:
            values, at = values_of(topic, message), time_of(message.header.stamp)
            self._server.show(topic, values, at, time.monotonic())
        except Exception as error:  # whatever a stranger publishes, the node lives on
            self._log(topic, error)

    # ---- from the PLC to the cell ---------------------------------------------------------------

    def _hand(self, handed: Any) -> None:
        """Take what the server's thread hands over.

        A heartbeat goes out at once, as the executor may have other work; all else is carried out
        there.
        """
        from robocal_ros.plc.cell import Heartbeat, Notice

        if isinstance(handed, Heartbeat):
            try:
                self._pass_heartbeat(handed)
                return
            except Exception as error:  # it is being destroyed
                handed = Notice(f"a heartbeat is lost: {type(error).__name__}: {error}")
        self._handed.put(handed)

    def _take(self, handed: Any) -> None:
        from robocal_ros.plc.cell import EdgeWritten, MethodCalled, Notice

        match handed:
            case EdgeWritten(beam=beam, edge=edge):
                self._pass_edge(beam, edge)
            case MethodCalled():
                self._call(handed)
            case Notice(words=words):
                self._tell(words)

    def _pass_heartbeat(self, heartbeat: Any) -> None:
        stamped = header(self.now_ns(), "")
        message = GapOpen(header=stamped, open=heartbeat.echo > 0, echo=heartbeat.echo)
        with self._gap_lock:
            if self._gap_acts:
                self._heartbeat_s = heartbeat.at_s
                self._gap.publish(message)

    def _pass_edge(self, beam: str, edge: Any) -> None:
        if self._edges is not None and self.is_active:
            self._edges.publish(
                BeamEvent(
                    header=header(edge.stamp_ns, self.settings["station"]),
                    beam=beam,
                    edge=BeamEvent.BREAK if edge.blocked else BeamEvent.RESTORE,
                    stamp_sigma_s=edge.sigma_s,
                )
            )

    def _call(self, called: Any) -> None:
        method = called.method
        done = partial(self._answered, called)
        match self._calls.call(method.service, called.fields, called.user, called.until_s, done):
            case Refusal.LATE:  # the PLC was told so
                self._tell(f"{method.name} of {called.user} came too late and is not passed on")
            case Refusal.INACTIVE:
                called.answer("BadInvalidState")
            case Refusal.ABSENT:
                called.answer("BadNoCommunication")

    def _answered(self, called: Any, response: Any) -> None:
        try:
            if isinstance(response, Exception):
                raise response
            outputs = [item.variant(item.value(response)) for item in called.method.outputs]
        except Exception as error:
            self._log(called.method.name, error)
            called.answer("BadUnexpectedError")
            return
        called.answer(outputs)
        if called.method.name != "Status":  # which a PLC asks again and again
            words = f"{called.user} called {called.method.name}: {response.message}"
            self.get_logger().info(words)

    def _tell(self, words: str) -> None:
        self._notice = time.monotonic(), words
        if self._log_limit.allows("a PLC", words, time.monotonic()):
            self.get_logger().warning(words)

    def identity(self) -> list[str]:
        """Where it is served."""
        at = f"opc.tcp://{self.settings['host']}:{self.settings['port']}/robocal"
        return [f"OPC UA at {at}", *super().identity()]

    def health(self) -> Health:
        """Tell who is there, and what was refused."""
        health, now_s = Health(), time.monotonic()
        state = self._server.state
        beat_s = now_s - self._heartbeat_s
        health.values = {
            "sessions": ", ".join(state.sessions) or "none",
            "heartbeat": f"{beat_s:.1f} s ago" if beat_s < 3600.0 else "none",
            "certificate valid until": f"{self._expires:%Y-%m-%d}",
        }
        if self._notice is not None:
            at_s, words = self._notice
            health.values["last notice"] = f"{now_s - at_s:.0f} s ago: {words}"
        if state.trouble:
            health.worsen(ERROR if state.trouble != "starts" else WARN, state.trouble)
        days = (self._expires - datetime.now(UTC)).days
        if days < EXPIRES_DAYS:
            words = "has expired" if days < 0 else f"expires in {days} days"
            health.worsen(WARN, f"the server's certificate {words}: make another one")
        names = [info.node_name for info in self.get_publishers_info_by_topic(self._gap.topic_name)]
        if self.get_name() in names:
            names.remove(self.get_name())  # another one may have the same name
        for name in names:
            health.worsen(ERROR, f"{name} publishes {self._gap.topic_name} too: one PLC alone")
        return health


def main() -> None:
    """Run the node."""
    run(PlcBridgeNode)
