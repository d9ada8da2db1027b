"""Whatever comes, in whatever order: what must never be is not.

No motion in a closed gap, none that does not fit, home or FAULT at the end, always disarmed, never
a cycle twice; the simulated cell itself refuses what must not be asked of it.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from maintenance_cell import (
    ARM,
    HOME,
    OK,
    REFUSED,
    SILENT,
    SLOW,
    STALE_S,
    TICK_S,
    Cell,
    bent,
    passed,
)

from robocal_ros.core.errors import RobocalError
from robocal_ros.core.motion.stopping import SHORTEST_STOP_S
from robocal_ros.sessions.maintenance import State
from robocal_ros.storage.calibrations import CalibrationHistory

BUSY = (State.RUNNING, State.BREAKING_OFF)
SERVICES = ("thermal", "arm", "disarm", "cancel", "measure", "sensor")
STOPS_WITHIN_S = SHORTEST_STOP_S + 0.1  # with a tick and the controller's lag

happenings = st.one_of(
    st.tuples(st.just("gap"), st.sampled_from(["open", "closed", "silent"])),
    st.tuples(st.just("joints"), st.sampled_from(["heard", "silent", "off", "far"])),
    st.tuples(st.just("service"), st.sampled_from(SERVICES), st.sampled_from([OK, SILENT])),
    st.tuples(st.just("run"), st.sampled_from(["first", "second"]), st.floats(1.0, 70.0)),
    st.tuples(st.just("cancel")),
    st.tuples(st.just("acknowledge")),
    st.tuples(st.just("restart")),
)
waits = st.one_of(st.floats(0.02, 2.0), st.floats(0.1, 25.0))
services = st.dictionaries(
    st.sampled_from(SERVICES), st.sampled_from([REFUSED, SILENT, SLOW]), max_size=2
)


class Watched:
    """The cell, looked at after each of its steps."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.forbidden_s = np.inf  # since when nothing may move

    def pass_time(self, seconds: float) -> None:
        for _ in range(max(round(seconds / TICK_S), 1)):
            self.step()

    def step(self) -> None:
        cell, before = self.cell, self.cell.state
        cell.step()
        if before in BUSY and cell.state is State.IDLE:
            near = cell.config.home_near + np.max(np.abs(cell.offset))
            assert np.max(np.abs(cell.q - HOME)) <= near, "handed over away from home"
            assert not cell.tool.armed, "handed over armed"
        fresh = cell.heard and cell.now_s - cell.beat_s <= STALE_S
        allowed = fresh and cell.now_s < cell.ends_s
        self.forbidden_s = np.inf if allowed else min(self.forbidden_s, cell.now_s)
        if not self.tool_is_deaf():
            assert cell.moved_s <= self.forbidden_s + STOPS_WITHIN_S, "moves in a closed gap"

    def tool_is_deaf(self) -> bool:
        """Nothing that it is told stops the tool node."""
        how = [self.cell.services.get(name, OK) for name in ("disarm", "cancel")]
        return self.cell.tool.measuring != 0 and how[0] == SILENT and how[1] != OK

    def do(self, happening: tuple[Any, ...]) -> None:
        cell = self.cell
        match happening:
            case ("run", name, gap_s):
                cell.run(name, gap_s)
            case ("gap", how):
                cell.beating, cell.is_open = how != "silent", how != "closed"
            case ("service", name, how):
                cell.services[name] = how
            case ("joints", how):
                cell.silent = how == "silent"
                cell.offset = np.radians({"off": 0.3, "far": 5.0}.get(how, 0.0)) * np.ones(ARM.n)
            case ("cancel",):
                cell.session.cancel("by the PLC")
            case ("acknowledge",):
                try:
                    cell.session.acknowledge("me")
                except RobocalError:
                    status = cell.session.status(cell.now_s)
                    assert not status.disarmed or not status.at_home
                else:
                    assert cell.session.status(cell.now_s).state is not State.FAULT
            case ("restart",) if cell.state not in BUSY:
                cell.restart()

    def let_it_end(self) -> None:
        """No run outlives its gap; then nothing is armed, and nothing runs again."""
        cell = self.cell
        while cell.state in BUSY:
            self.step()
            assert cell.now_s <= cell.ends_s + 2 * TICK_S, "a run outlives its gap"
        self.pass_time(1.5)
        if cell.services.get("disarm", OK) not in (SILENT, REFUSED):
            assert not cell.tool.armed, "still armed"
        assert not cell.tool.armed or cell.state is State.FAULT
        count = len(cell.begun)
        for name in cell.begun:
            cell.run(name, 60.0)
        self.pass_time(0.5)
        assert len(cell.begun) == count
        assert cell.state not in BUSY


@settings(max_examples=60, deadline=None)
@given(services, st.booleans(), st.floats(5.0, 70.0), st.lists(st.tuples(waits, happenings)))
def test_nothing_that_must_not_be(broken, right, gap_s, happening):
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("K1", state_dir=Path(folder)) as history,
    ):
        cell = Cell(history, services=broken, check=passed() if right else bent())
        watched = Watched(cell)
        cell.open_gap()
        cell.run("first", gap_s)
        for wait_s, what in happening[:5]:
            watched.pass_time(wait_s)
            watched.do(what)
        watched.let_it_end()
