# SPDX-License-Identifier: Apache-2.0
"""How a PLC reaches the cell: by OPC UA (`bench.live.opc_ua`), or by topics and services itself.

Both show the same by the names of maintenance_node's messages.
"""

import re
import threading
import time
from collections import deque
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, Protocol

from rclpy.exceptions import InvalidHandle
from robocal_msgs.msg import AccuracyState, GapOpen, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, RunMaintenanceCycle

from bench.live.graph import CellController, LiveError
from robocal_ros.ground.errors import Code
from robocal_ros.ros import endpoints

LOOK = {
    "Maintenance": ("State", "Doing", "Fault", "AtHome", "Disarmed"),
    "LastCycle": (
        "CycleId", "Code", "Message", "Complete", "Left", "ThermalCode", "ToolFoundCode",
        "ToolCode", "Accepted",
    ),
    "Accuracy": ("State", "Reason"),
}  # fmt: skip
ANSWER_S, THERE_S = 15.0, 60.0  # of a request; until a bridge that was lost is there again
BEAT_S = 0.05  # a PLC's program goes round many times for each beat


class Answer(NamedTuple):
    """Of a call to maintenance_node."""

    success: bool
    status: int
    message: str


class Look(NamedTuple):
    """What the line reads: as `MaintenanceStatus`, and as `AccuracyState`."""

    maintenance: Any
    accuracy: Any


class Line(Protocol):
    """The PLC's side of the cell; ``is_open``: its program gives the robot."""

    is_open: bool

    def take_over(self, within_s: float) -> None:
        """Wait until the cell can be read, and begin the heartbeat."""

    def look(self) -> Look:
        """Read the cell."""

    def run(self, cycle_id: str, gap_s: float) -> Answer:
        """Call for a cycle."""

    def acknowledge(self) -> Answer:
        """End a fault, as a person does."""

    def called_s(self) -> list[float]:
        """How long each call took to its answer, s."""

    def close(self) -> None:
        """End the heartbeat."""


class RosLine:
    """A bridge of one's own, as docs/plc.md tells it: topics and services."""

    def __init__(self, controller: CellController) -> None:
        self._controller = controller
        self.is_open, self._beats = False, True
        self._called_s: list[float] = []
        self._gap = controller.publisher(GapOpen, "gap_open")
        self._accuracy: deque[AccuracyState] = deque(maxlen=1)
        controller.listen(AccuracyState, "accuracy_state", self._accuracy, endpoints.LATCHED)
        self._maintenance: deque[MaintenanceStatus] = deque(maxlen=1)
        beats = "/maintenance_node/status"
        controller.listen(MaintenanceStatus, beats, self._maintenance, endpoints.LATCHED)
        self._heart = threading.Thread(target=self._beat, daemon=True)

    def take_over(self, within_s: float) -> None:
        """Wait until the cell can be read, and begin the heartbeat."""
        read = lambda: self._accuracy and self._maintenance  # noqa: E731
        self._controller.wait(read, "accuracy_state", within_s)
        self._heart.start()

    def _beat(self) -> None:
        """As a PLC does it: whatever else goes on here."""
        while self._beats:
            with suppress(InvalidHandle):  # the graph ends
                self._gap.publish(GapOpen(open=self.is_open, echo=self._maintenance[-1].beat))
            time.sleep(BEAT_S)

    def look(self) -> Look:
        """Read the cell."""
        return Look(self._maintenance[-1], self._accuracy[-1])

    def run(self, cycle_id: str, gap_s: float) -> Answer:
        """Call for a cycle."""
        return self._call(RunMaintenanceCycle, "run", cycle_id=cycle_id, gap_s=gap_s)

    def acknowledge(self) -> Answer:
        """End a fault, as a person does."""
        return self._call(Acknowledge, "acknowledge", by="demo")

    def _call(self, kind: type, name: str, **fields: object) -> Answer:
        begin_s = time.monotonic()
        found = self._controller.call(kind, f"/maintenance_node/{name}", **fields)
        self._called_s.append(time.monotonic() - begin_s)
        return Answer(found.success, found.status, found.message)

    def called_s(self) -> list[float]:
        """How long each call took to its answer, s."""
        return self._called_s

    def close(self) -> None:
        """End the heartbeat."""
        self._beats = False
        if self._heart.is_alive():
            self._heart.join()


class OpcUaLine:
    """The cell by OPC UA alone: a PLC's session for all but what a person decides.

    Raises
    ------
    LiveError
        In all that it does, when the bridge does not answer.
    ImportError
        When it is made where asyncua is not installed.
    """

    def __init__(self, controller: CellController, folder: Path) -> None:
        from bench.live import opc_ua

        self._controller, self._folder = controller, opc_ua.security_folder(folder)
        self.port, self._process = opc_ua.free_port(), opc_ua.PlcProcess
        self._engineer = opc_ua.ENGINEER[0], "panel"
        self._plc = self._process(folder, self.port)
        self._is_open = False

    @property
    def parameters(self) -> dict[str, object]:
        """Of its plc_bridge_node."""
        return {"security_dir": str(self._folder), "host": "127.0.0.1", "port": self.port}

    @property
    def is_open(self) -> bool:
        """Whether the PLC's program gives the robot."""
        return self._is_open

    @is_open.setter
    def is_open(self, given: bool) -> None:
        self._is_open = given
        self._ask(self._plc, "give", given)

    def _ask(self, plc: Any, what: str, *arguments: Any, within_s: float = ANSWER_S) -> Any:
        """Let a client do something while the graph goes on."""
        plc.ask(what, *arguments)
        self._controller.wait(plc.answered, f"the PLC's bridge ({what})", within_s)
        try:
            return plc.answer()
        except (ConnectionError, EOFError) as error:
            raise LiveError(f"the PLC's bridge: {what}: {error}") from error

    def take_over(self, within_s: float) -> None:
        """Wait until the cell can be read, and begin the heartbeat."""
        self._ask(self._plc, "connect_once_there", within_s, within_s=2.0 * within_s)
        for path in ("Accuracy.State", "Maintenance.State"):
            read = lambda p=path: self._ask(self._plc, "read", p)  # noqa: E731
            self._controller.wait(read, path, within_s)
        self._ask(self._plc, "begin")

    def look(self) -> Look:
        """Read the cell, in one request; of a session that was lost in a new one."""
        paths = [f"{of}.{name}" for of, names in LOOK.items() for name in names]
        try:
            read = self._ask(self._plc, "read_all", paths)
        except LiveError:
            self._ask(self._plc, "connect_once_there", THERE_S, within_s=2.0 * THERE_S)
            read = self._ask(self._plc, "read_all", paths)
        values = dict(zip(paths, read, strict=True))

        def shown(of: str) -> SimpleNamespace:
            """By the names of the messages: AtHome is at_home."""
            named = {re.sub(r"(?<!^)([A-Z])", r"_\1", n).lower(): n for n in LOOK[of]}
            return SimpleNamespace(**{new: values[f"{of}.{n}"] for new, n in named.items()})

        maintenance = shown("Maintenance")
        maintenance.last = shown("LastCycle")
        return Look(maintenance, shown("Accuracy"))

    def run(self, cycle_id: str, gap_s: float) -> Answer:
        """Call for a cycle; without an answer that is CONFLICT: the same call may come again."""
        try:
            return Answer(*self._ask(self._plc, "call", "Run", cycle_id, gap_s)[:3])
        except LiveError as error:
            return Answer(False, Code.CONFLICT, str(error))

    def acknowledge(self) -> Answer:
        """End a fault, as a person does: with an engineer's name, at a panel's client."""
        panel = self._process(self._folder, self.port, *self._engineer)
        try:
            self._ask(panel, "connect_once_there", THERE_S, within_s=2.0 * THERE_S)
            return Answer(*self._ask(panel, "call", "Acknowledge"))
        finally:
            panel.close()

    def called_s(self) -> list[float]:
        """How long each call of the PLC took to its answer, s."""
        return list(self._ask(self._plc, "called_s"))

    def close(self) -> None:
        """End the heartbeat."""
        self._plc.close()
