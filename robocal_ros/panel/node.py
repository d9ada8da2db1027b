# SPDX-License-Identifier: Apache-2.0
"""The page for the people at the line, in any browser: docs/panel.md."""

import time
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from functools import partial
from ipaddress import ip_address
from operator import attrgetter
from pathlib import Path
from typing import Any

from robocal_msgs.msg import (
    AccuracyState,
    CalibrationQuality,
    CorrectionStatus,
    MaintenanceStatus,
)
from robocal_msgs.srv import Acknowledge, Decide
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import InputError
from robocal_ros.panel.state import (
    ACCURACY,
    CORRECTION,
    FIXTURE,
    LONGEST_TEXT,
    PENDING,
    STATUS,
    plain,
)
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.endpoints import (
    ERROR,
    WARN,
    ExecutorQueue,
    Health,
    Refusal,
    ServiceCalls,
)
from robocal_ros.ros.parameters import Setting, number
from robocal_ros.ros.session_node import STATE_DIR

EXPIRES_DAYS = 30  # warned of so long before
NS = 1_000_000_000
MOST_LEFT = 20  # things that a gap left, of which the page tells
SERVICES: Mapping[str, Any] = {
    "run_trigger": Trigger,
    "cancel_trigger": Trigger,
    "accept": Decide,
    "reject": Decide,
    "acknowledge": Acknowledge,
}

Read = dict[str, Callable[[Any], Any]]


def _of(*names: str) -> Read:
    return {name: attrgetter(name) for name in names}


LAST: Read = _of(
    "cycle_id", "code", "message", "complete", "thermal_code", "thermal_id", "tool_found_code",
    "tool_code", "tool_id", "station_code",
) | {
    "left": lambda m: [words[:LONGEST_TEXT] for words in m.left[:MOST_LEFT]],
    "accepted": lambda m: list(m.accepted[:MOST_LEFT]),
    "stamp_ns": lambda m: m.stamp.sec * NS + m.stamp.nanosec,
}  # fmt: skip
SOURCES: Mapping[str, tuple[type, str, Read]] = {
    ACCURACY: (
        AccuracyState,
        "accuracy_state",
        _of("robot", "serial", "state", "predicted_error_mm", "bound_mm", "tolerance_mm",
            "due_in_s", "reason"),
    ),
    STATUS: (
        MaintenanceStatus,
        "maintenance_node/status",
        _of("state", "cycle_id", "doing", "left_s", "at_home", "fault_code", "fault", *PENDING)
        | {"last": lambda m: plain(m.last, LAST)},
    ),
    CORRECTION: (CorrectionStatus, "joint_correction_node/status", _of("state", "reason")),
    FIXTURE: (CalibrationQuality, FIXTURE, _of("code", "candidate_id", "reason")),
}  # fmt: skip
"""Messages by the name of their source: type, topic, and what of them is shown."""


def _address(given: str) -> str | None:
    try:
        ip_address(given)
    except ValueError:
        return f"'{given}' is no IP address"
    return None


SETTINGS = (
    Setting(
        "security_dir",
        "",
        "Folder of certificates and users, as `robocal plc certificates` makes it; empty: read "
        "only, and not encrypted",
    ),
    STATE_DIR,
    Setting(
        "address",
        "127.0.0.1",
        "Address of this machine to listen at; 0.0.0.0: all of them",
        check=_address,
    ),
    number("page_port", 8480, "TCP port of the page", 1, 65535),
    Setting("public_view", True, "State and history are shown without a login too"),
)


class PanelNode(HouseNode):
    """Shows the cell in a browser; acts for its users while it is active."""

    NAME = "panel_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        self._server: Any = None
        self._expires: datetime | None = None
        super().__init__(**options)

    def configure(self) -> None:
        """Start the server; it shows the state from here on. Raises `InputError`."""
        try:
            from robocal_ros.panel.server import PanelServer, PanelSettings, host_names
            from robocal_ros.panel.sessions import encryption
            from robocal_ros.plc.access import certified_hosts, document, read_certificate
        except ImportError as error:
            raise InputError(
                f"{error}: pip install 'robocal_ros[panel]', which brings aiohttp"
            ) from error
        settings = self.settings
        given = settings["security_dir"]
        folder = Path(given).expanduser() if given else None
        names: frozenset[str] = frozenset()
        self._expires = None
        if folder is not None:
            certificate = read_certificate(folder / "server.der")
            self._expires = certificate.not_valid_after_utc
            names = certified_hosts(certificate)
            if not document(folder)["users"]:
                self.get_logger().warning(f"{folder}: nobody can log in: robocal plc user DIR NAME")
        elif not ip_address(settings["address"]).is_loopback:
            self.get_logger().warning(
                "the page is not encrypted and nobody can log in: give security_dir"
            )
        self._calls = ServiceCalls(self, "maintenance_node", SERVICES)
        handed = ExecutorQueue(self, "the page", self._take)
        state_dir = settings[STATE_DIR.name]
        self._server = PanelServer(
            PanelSettings(
                settings["address"],
                settings["page_port"],
                folder,
                settings["public_view"],
                Path(state_dir).expanduser() if state_dir else None,
                settings["serial"],
                None if folder is None else encryption(folder),
                host_names(names),
            ),
            handed.put,
            handed.put,
        )
        for name in SOURCES:
            self._watch(name)

    def _watch(self, name: str) -> None:
        """Show a source; not by `add_input`: it is shown while nothing acts."""
        kind, topic, read = SOURCES[name]

        def show(message: Any) -> None:
            stamp = message.header.stamp
            try:
                if self._server is not None:
                    values = plain(message, read)
                    self._server.show(name, values, stamp.sec * NS + stamp.nanosec)
            except Exception as error:  # whatever a stranger publishes, the node lives on
                self._log(topic, error)

        subscription = self.create_subscription(kind, topic, show, endpoints.own(endpoints.LATCHED))
        self._release.append(lambda: self.destroy_subscription(subscription))

    def cleanup(self) -> None:
        """End the server."""
        server, self._server = self._server, None
        if server is not None:
            server.stop()

    def _take(self, handed: Any) -> None:
        if isinstance(handed, str):
            self._tell(handed)
        else:
            self._act(handed)

    def _tell(self, words: str) -> None:
        if self._log_limit.allows("the page", words, time.monotonic()):
            self.get_logger().warning(words)

    def _act(self, called: Any) -> None:
        done = partial(self._answered, called)
        refused = self._calls.call(called.service, called.fields, called.user, called.until_s, done)
        if refused is Refusal.LATE:
            self._tell(f"{called.act} of {called.user} came too late and is not passed on")
        elif refused is Refusal.ABSENT:
            _answer(called, False, "maintenance_node is not there: start it")
        elif refused is Refusal.INACTIVE:
            _answer(called, False, f"{self.get_name()} is {self.state}: activate it")

    def _answered(self, called: Any, response: Any) -> None:
        if isinstance(response, Exception):
            self._log(called.act, response)
            _answer(called, False, str(response))
            return
        message = response.message
        if SERVICES[called.service] is Trigger:
            message = message.split(" ", 2)[-1]  # of `trigger_text` the words alone
        _answer(called, bool(response.success), message)
        which = f" {called.fields['id']}" if "id" in called.fields else ""
        self.get_logger().info(f"{called.user}: {called.act}{which}: {response.message}")

    def identity(self) -> list[str]:
        """Where it is served."""
        address, port = self.settings["address"], self.settings["page_port"]
        scheme = "https" if self._expires is not None else "http"
        host = f"[{address}]" if ":" in address else address
        return [f"page at {scheme}://{host}:{port}", *super().identity()]

    def health(self) -> Health:
        """Tell who looks, and what is wrong."""
        health = Health()
        health.values = {"viewers": self._server.viewers}
        if (trouble := self._server.trouble) != "":
            health.worsen(ERROR if trouble != "starts" else WARN, trouble)
        if self._expires is not None:
            health.values["certificate valid until"] = f"{self._expires:%Y-%m-%d}"
            days = (self._expires - datetime.now(UTC)).days
            if days < EXPIRES_DAYS:
                words = "has expired" if days < 0 else f"expires in {days} days"
                health.worsen(WARN, f"the server's certificate {words}: make another one")
        return health


def _answer(called: Any, done: bool, message: str) -> None:
    """Tell the browser, unless it waits no more."""
    if called.answer.set_running_or_notify_cancel():
        called.answer.set_result({"done": done, "message": message})


def main() -> None:
    """Run the node."""
    run(PanelNode)
