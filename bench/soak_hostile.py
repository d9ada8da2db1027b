# SPDX-License-Identifier: Apache-2.0
"""Hostile requests to a live bridge and a live page: they change nothing and end nothing.

``tools/with_ros python -m bench.soak_hostile``; with ``--keep`` it writes
docs/figures/soak_hostile.md too. Robot, thermal_node, maintenance_node, bridge and page run as
processes, all of it simulated; one PLC and one engineer have good sessions meanwhile.
"""

import os
import random
import tempfile
import time
from collections import deque
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from robocal_msgs.msg import BeamEvent, GapOpen, MaintenanceStatus, SessionEvent
from trajectory_msgs.msg import JointTrajectory

from bench import hostile
from bench.live.graph import CellController
from bench.live.opc_ua import ENGINEER, PlcClient, free_port, security_folder
from bench.processes import resident_mb
from bench.soaking import soak_main
from bench.tables import Goal, Table
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS

ROBOT = {"robot": "kr150_r3100", "serial": "SOAK-2"}
HOME_DEG = "[0.0, -100.0, 110.0, 0.0, 70.0, 0.0]"
REQUESTS, ATTACKED = 2000, ("plc_bridge_node", "panel_node")
GOOD_EVERY = 5  # hostile requests between two good ones
LONGEST_GOOD_S = 0.5  # as of any call
WARM, MOST_GROWTH_MB = 0.5, 10.0  # share of the requests until buffers have been at their most
LOGIN_EVERY = 20  # the doorman takes names that are wrong one by one, and locks the worst


@dataclass
class Counted:
    """Of one kind: how many there were, and those that were taken."""

    sent: int = 0
    silent: int = 0  # without an answer, as of a busy machine: a good request follows
    taken: list[str] = field(default_factory=list)


class HostileCell:
    """The cell, its clients and what is watched in it."""

    def __init__(self, controller: CellController, folder: Path) -> None:
        self._controller, self._folder = controller, folder / "state"
        plc, self.port, page = security_folder(folder / "plc"), free_port(), free_port()
        out = {"~/joint_trajectory": "/robot/joint_trajectory"}
        robot = {"joint_trajectory": "/robot/joint_trajectory"}
        controller.start(folder, "cell_sim_node", {"cell": "kr150"}, robot)
        controller.start(folder, "maintenance_node", ROBOT | {"home_deg": HOME_DEG}, out)
        served = {"security_dir": str(plc)} | ROBOT
        bridge = {"security_dir": str(plc), "host": "127.0.0.1", "port": self.port}
        bridge["beams"] = f"[{hostile.BEAM}]"
        controller.start(folder, "plc_bridge_node", bridge)
        controller.start(folder, "panel_node", served | {"page_port": page})
        self.url = f"https://127.0.0.1:{page}"
        self.statuses: deque[MaintenanceStatus] = deque(maxlen=1)
        self.beats: deque[GapOpen] = deque()
        self.events: deque[SessionEvent] = deque()
        status = "/maintenance_node/status"
        controller.listen(MaintenanceStatus, status, self.statuses, endpoints.LATCHED)
        controller.listen(GapOpen, "gap_open", self.beats, endpoints.RELIABLE)
        self.moves: deque[JointTrajectory] = deque()
        self.edges: deque[BeamEvent] = deque()
        moves = out["~/joint_trajectory"]
        controller.listen(JointTrajectory, moves, self.moves, endpoints.RELIABLE)
        controller.listen(BeamEvent, "beam_events", self.edges, endpoints.RELIABLE)
        events = "/maintenance_node/session_events"
        controller.listen(SessionEvent, events, self.events, EVENTS)
        controller.wait(lambda: self.statuses, "maintenance_node", 60.0)
        self.plc = PlcClient(plc, self.port, ENGINEER[0], "panel")
        self.do(self.plc.connect_once_there(), 90.0)
        self.page = self.do(self._opened())

    async def _opened(self) -> hostile.Browser:
        page = hostile.Browser(self.url)
        await page.login(*ENGINEER)
        return page

    def do(self, work: Any, within_s: float = 30.0) -> Any:
        """Let the clients do something while the graph goes on."""
        done = self.plc.start(work)
        self._controller.wait(done.done, "a client", within_s)
        return done.result()

    def state(self) -> tuple[Any, ...]:
        """What no request may change."""
        s = self.statuses[-1]
        told = s.state, s.cycle_id, s.fault_code, s.fault, s.at_home, s.last.cycle_id
        decided = [e.command for e in self.events]
        opened = sum(beat.open for beat in self.beats)
        went = len(self.moves), [edge.beam for edge in self.edges].count(hostile.BEAM)
        files = {file: file.read_bytes() for file in self._folder.rglob("*") if file.is_file()}
        return *told, s.thermal_pending, s.tool_pending, decided, opened, went, files

    def good(self) -> float:
        """A good request of each: a heartbeat, a value, the page; s that the slowest took."""

        async def asked() -> float:
            longest = 0.0
            for work in (
                lambda: hostile.good_heartbeat(self.plc),
                lambda: self.plc.read("Maintenance.State"),
                lambda: self.page.ask("GET", "/session"),
            ):
                begin_s = time.monotonic()
                await work()
                longest = max(longest, time.monotonic() - begin_s)
            return longest

        return float(self.do(asked()))

    def memory_mb(self) -> dict[str, float]:
        """Resident, of what is attacked."""
        pids = self._controller.pids
        return {name: resident_mb(pids[name]) for name in ATTACKED}

    def close(self) -> None:
        """End the clients."""
        self.do(self.page.close())
        self.plc.close()


def soak(requests: int, seed: int = 20) -> Table:
    """So many requests of all kinds by turns.

    Raises
    ------
    LiveError
        When a node has ended, or a good request is not answered.
    """
    with tempfile.TemporaryDirectory() as name:
        controller = CellController()
        try:
            cell = HostileCell(controller, Path(name))
            try:
                return _attacked(cell, requests, random.Random(seed))
            finally:
                cell.close()
        finally:
            controller.close()


def _attacked(cell: HostileCell, requests: int, rng: random.Random) -> Table:
    cell.good()
    before, counted, good_s = cell.state(), dict[str, Counted](), []
    memory: list[dict[str, float]] = []
    kinds: list[tuple[str, Any, Callable[[random.Random, Any], Awaitable[None]]]] = []
    for attacks in (hostile.ON_A_SESSION, hostile.OF_STRANGERS):
        kinds += [(f"bridge: {words}", cell.plc, attack) for words, attack in attacks.items()]
    kinds += [(f"page: {words}", cell.page, act) for words, act in hostile.TO_THE_PAGE.items()]
    logins = {"bridge: names and passwords that are guessed", "page: logins of nobody"}
    number = 0
    while sum(each.sent for each in counted.values()) < requests:
        words, target, attack = kinds[number % len(kinds)]
        number += 1
        if words in logins and (number // len(kinds)) % LOGIN_EVERY:
            continue
        one = counted.setdefault(words, Counted())
        one.sent += 1
        try:
            cell.do(attack(rng, target))
        except hostile.TakenError as taken:
            one.taken.append(str(taken))
        except (TimeoutError, ConnectionError):
            one.silent += 1
            good_s.append(cell.good())
        if number % GOOD_EVERY == 0:
            good_s.append(cell.good())
            memory.append(cell.memory_mb())
    good_s.append(cell.good())
    return _table(cell, counted, before == cell.state(), good_s, memory)


def _table(
    cell: HostileCell,
    counted: dict[str, Counted],
    unchanged: bool,
    good_s: Sequence[float],
    memory: Sequence[dict[str, float]],
) -> Table:
    requests = sum(one.sent for one in counted.values())
    table = Table(
        "soak_hostile",
        f"{requests} hostile requests to a live bridge and a live page; simulated",
        ("what", "value", "goal"),
        "State: of the maintenance, its decisions, events and files, of the gap, of the robot, "
        "which is sent nowhere, and of the beam, which has no edge; a node that ends ends this. A "
        "good request: a heartbeat, a value and the page, by sessions "
        f"that were there before, after every {GOOD_EVERY} hostile ones. Heartbeats: what went out "
        "on gap_open, less what the good session wrote; none opened the gap. Memory: resident. "
        f"Load of the machine in the last minute: {os.getloadavg()[0]:.2f}; {os.cpu_count()} CPUs.",
    )
    for words, one in counted.items():
        print(*(f"{words} TAKEN: {taken}\n" for taken in one.taken), end="")
        table.add(f"{words}: taken of {one.sent}", len(one.taken), Goal(len(one.taken), 0))
    table.add("the state has changed", int(not unchanged), Goal(int(not unchanged), 0))
    table.add("hostile ones without an answer", sum(o.silent for o in counted.values()), None)
    more = len(cell.beats) - len(cell.plc.written)
    table.add("heartbeats that nobody wrote", more, Goal(abs(more), 0))
    table.add("good requests", 3 * len(good_s), None)
    table.add("a good one took, median, s", float(np.median(good_s)), None)
    table.add("the longest, s", max(good_s), Goal(max(good_s), LONGEST_GOOD_S))
    warm = memory[int(WARM * len(memory))]
    for name in ATTACKED:
        grown = memory[-1][name] - warm[name]
        table.add(f"{name}: grown, MB", grown, Goal(grown, MOST_GROWTH_MB))
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """Run it; 1 when a goal is missed."""
    return soak_main("soak_hostile", soak, __doc__, arguments, "requests", REQUESTS)


if __name__ == "__main__":
    raise SystemExit(main())
