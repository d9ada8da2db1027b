# SPDX-License-Identifier: Apache-2.0
"""Whatever comes, in whatever order: what must never be is not.

No motion in a closed gap, none that does not fit, home or FAULT at the end, always disarmed, never
a cycle twice, nothing accepted that is beyond the bounds; the simulated cell itself refuses what
must not be asked of it.
"""

import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from maintenance_cell import (
    ARM,
    BEAT_S,
    DRIVING,
    HOME,
    KNOWN,
    OK,
    POSES,
    REFUSED,
    SILENT,
    SLOW,
    STALE_S,
    TICK_S,
    Cell,
    ToolNode,
    bent,
    config_of,
    new_tool,
    passed,
    proposed,
    thermal_proposed,
)
from tool_driver import TAUGHT

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Action
from robocal_ros.maintenance.accuracy import AcceptBounds
from robocal_ros.maintenance.robot_interface import DEAF_S, DriverAnswer
from robocal_ros.maintenance.session import MaintenanceState
from robocal_ros.motion.plan import SHORTEST_STOP_S
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.tool.driving import SETTLED_S
from robocal_ros.tool.run import rows_of

BUSY = (MaintenanceState.RUNNING, MaintenanceState.BREAKING_OFF)
SERVICES = ("thermal", "arm", "disarm", "cancel", "measure", "sensor")
STOPS_WITHIN_S = SHORTEST_STOP_S + 0.1  # with a tick and the controller's lag
# A node that was started anew confirms that nothing moves: it is believed until a stop were over.
LOOKED_AT_S = DRIVING.late_s + SHORTEST_STOP_S + SETTLED_S
STANDS_FOR_S = 0.3

BOUNDS = AcceptBounds(automatic=True)

happenings = st.one_of(
    st.tuples(st.just("gap"), st.sampled_from(["open", "closed", "silent"])),
    st.tuples(st.just("beat"), st.sampled_from([BEAT_S, 0.9 * STALE_S, 1.5 * STALE_S])),
    st.tuples(st.just("tool"), st.sampled_from(["dies", "starts", "starts anew"])),
    st.tuples(st.just("joints"), st.sampled_from(["heard", "silent", "off", "far"])),
    st.tuples(st.just("service"), st.sampled_from(SERVICES), st.sampled_from([OK, SILENT])),
    st.tuples(st.just("run"), st.sampled_from(["first", "second"]), st.floats(1.0, 70.0)),
    st.tuples(st.just("cancel")),
    st.tuples(st.just("acknowledge")),
    st.tuples(st.just("restart")),
    st.tuples(st.just("pause"), st.floats(0.05, 2.0)),
)
waits = st.one_of(st.floats(0.02, 2.0), st.floats(0.1, 25.0))
anything = st.lists(st.tuples(waits, happenings), max_size=5)
failures = st.sampled_from(
    [
        *(("gap", how) for how in ("closed", "silent")),
        *(("tool", how) for how in ("dies", "starts", "starts anew")),
        *(("joints", how) for how in ("silent", "heard")),
        *(("service", name, SILENT) for name in ("disarm", "cancel")),
        ("cancel",),
        ("restart",),
    ]
)
while_the_tool_moves = st.lists(
    st.tuples(st.floats(0.02, 0.6), failures), min_size=2, max_size=6, unique_by=lambda one: one[1]
)
scenes = st.one_of(
    st.tuples(st.just(False), anything), st.tuples(st.just(True), while_the_tool_moves)
)
DEAF = {"disarm": SILENT, "cancel": SILENT}
services = st.one_of(
    st.sampled_from([{}, DEAF]),
    st.dictionaries(
        st.sampled_from(SERVICES), st.sampled_from([REFUSED, SILENT, SLOW]), max_size=2
    ),
)
gaps = st.one_of(st.just(70.0), st.floats(5.0, 70.0))
refusals = st.sampled_from(
    [DriverAnswer(code, "refused") for code in Code if code is not Code.ACCEPT]
)
checks = st.sampled_from([bent(), replace(bent(), answer="cannot tell"), passed()])
DRIFTS = {level.name: replace(KNOWN, level=level) for level in AccuracyLevel} | {"silent": None}
flaws = st.sampled_from(["", "", "", "revision", "taught", "EXPIRED", "FAULT", "silent"])


class Nodes:
    """What the nodes answer, and which of it may come into force without a person."""

    def __init__(self, kelvin: float | None, shift_mm: float, flaw: str = "") -> None:
        self.kelvin, self.shift_mm, self.flaw = kelvin, shift_mm, flaw
        self.allowed: set[int] = set()

    def thermal(self, cell: Cell, refused: DriverAnswer) -> DriverAnswer:
        """Of a robot that has warmed up; its links of 1.3 m grow by 16 um with each kelvin."""
        if self.kelvin is None:
            return refused
        number = thermal_proposed(cell.history, self.kelvin)
        if self.kelvin * 16e-6 < BOUNDS.thermal_m and self.level(cell) < AccuracyLevel.FAULT:
            self.allowed.add(number)
        return DriverAnswer(Code.ACCEPT, "warm", number)

    def full(self, cell: Cell) -> DriverAnswer:
        """A tool that is bent sideways."""
        other = {"revision": {"thermal_revision": 7}, "taught": {"taught": rows_of(2.0 * TAUGHT)}}
        shift_m = np.array([0.6, 0.0, 0.8]) * self.shift_mm * 1e-3
        number = proposed(cell.history, shift_m, **other.get(self.flaw, {}))
        if (
            self.shift_mm <= BOUNDS.tool_m * 1e3
            and self.flaw not in other
            and self.level(cell) < self.unknown(cell)
        ):
            self.allowed.add(number)
        return new_tool(number)

    def unknown(self, cell: Cell) -> int:
        """Without measuring poses nobody asks how far the robot has drifted."""
        return AccuracyLevel.EXPIRED if len(cell.config.poses) else AccuracyLevel.FAULT

    def level(self, cell: Cell) -> AccuracyLevel:
        silent = AccuracyLevel.FAULT if len(cell.config.poses) else AccuracyLevel.OK
        return silent if cell.drift is None else cell.drift.level


class Watched:
    """The cell, looked at after each of its steps."""

    def __init__(self, cell: Cell) -> None:
        self.cell = cell
        self.forbidden_s = np.inf  # since when nothing may move
        self.within_s = STOPS_WITHIN_S
        self.left = False  # the robot drives what a tool node left that is gone
        self.killed_s = -np.inf  # the session was; what it moved is driven to its end

    def pass_time(self, seconds: float) -> None:
        for _ in range(max(round(seconds / TICK_S), 1)):
            self.step()

    def step(self) -> None:
        cell, before = self.cell, self.cell.state
        cell.step()
        if before in BUSY and cell.state is MaintenanceState.IDLE:
            near = cell.config.home_near + np.max(np.abs(cell.offset))
            assert np.max(np.abs(cell.q - HOME)) <= near, "handed over away from home"
            assert not cell.tool.armed, "handed over armed"
        fresh = cell.heard and cell.now_s - cell.beat_s <= STALE_S
        allowed = fresh and cell.now_s < cell.ends_s
        self._look_at_motion(allowed)

    def _look_at_motion(self, allowed: bool) -> None:
        """Nothing moves in a closed gap, but for as long as nobody could stop it."""
        cell = self.cell
        if cell.now_s - max(cell.motion.end_s, self.killed_s) > STANDS_FOR_S:
            self.left, self.killed_s = False, -np.inf
        deaf = self._tool_is_deaf()
        nobody_could = self.killed_s > 0.0 or (cell.silent and (deaf or self.left))
        if allowed or nobody_could:
            self.forbidden_s, self.within_s = np.inf, STOPS_WITHIN_S
            return
        self.forbidden_s = min(self.forbidden_s, cell.now_s)
        later_s = LOOKED_AT_S if self.left else DEAF_S if deaf else 0.0
        self.within_s = max(self.within_s, STOPS_WITHIN_S + later_s)
        assert cell.moved_s <= self.forbidden_s + self.within_s, "moves in a closed gap"

    def _tool_is_deaf(self) -> bool:
        """Nothing that it is told stops the tool node, or what it left behind."""
        how = [self.cell.services.get(name, OK) for name in ("disarm", "cancel")]
        deaf = self.cell.tool.measuring != 0 and how[0] == SILENT and how[1] != OK
        return deaf or not self.cell.tool.there

    def until_the_tool_moves(self) -> None:
        """As far as the run comes to it."""
        while self.cell.state in BUSY and not self.cell.tool.measuring:
            self.step()

    def do(self, happening: tuple[Any, ...]) -> None:
        cell = self.cell
        match happening:
            case ("run", name, gap_s):
                cell.run(name, gap_s)
            case ("gap", how):
                cell.beating, cell.is_open = how != "silent", how != "closed"
            case ("beat", every_s):
                cell.beats_every_s = every_s
            case ("tool", how):
                self.left |= how != "starts" and cell.tool.measuring != 0
                if how != "starts":
                    cell.tool_dies()
                if how != "dies" and not cell.tool.there:
                    cell.tool = ToolNode()
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
                    assert cell.session.status(cell.now_s).state is not MaintenanceState.FAULT
            case ("restart",):
                self.killed_s = cell.now_s
                cell.restart()
            case ("pause", pause_s) if self.nothing_moves():
                cell.pause(min(pause_s, max(cell.ends_s - cell.now_s, 0.0)))

    def nothing_moves(self) -> bool:
        """Whether a process that stands still could not have stopped anything."""
        cell = self.cell
        return not (cell.coming or cell.tool.armed) and cell.now_s - cell.moved_s > 0.1

    def let_it_end(self) -> None:
        """No run outlives its gap; then nothing is armed, and nothing runs again."""
        cell = self.cell
        while cell.state in BUSY:
            self.step()
            assert cell.now_s <= cell.ends_s + 2 * TICK_S, "a run outlives its gap"
        self.pass_time(1.5)
        if cell.services.get("disarm", OK) not in (SILENT, REFUSED):
            assert not cell.tool.armed, "still armed"
        assert not cell.tool.armed or cell.state is MaintenanceState.FAULT
        count = len(cell.begun)
        for name in cell.begun:
            cell.run(name, 60.0)
        self.pass_time(0.5)
        assert len(cell.begun) == count
        assert cell.state not in BUSY


@settings(max_examples=25, deadline=None)
@given(
    services,
    st.booleans(),
    st.tuples(gaps, st.sampled_from([0, 1, 3])),
    scenes,
)
def test_nothing_that_must_not_be(broken, right, gap, scene):
    (gap_s, poses), (at_tool, happening) = gap, scene
    config = config_of(bounds=BOUNDS, poses=POSES[: 0 if at_tool else poses])
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("K1", state_dir=Path(folder)) as history,
    ):
        cell = Cell(history, config, services=dict(broken), drift=KNOWN)
        cell.check, cell.full = passed() if right else bent(), Nodes(None, 1.0).full
        watched = Watched(cell)
        cell.open_gap()
        cell.run("first", gap_s)
        if at_tool:
            watched.until_the_tool_moves()
        for wait_s, what in happening:
            watched.pass_time(wait_s)
            watched.do(what)
        watched.let_it_end()


@settings(max_examples=15, deadline=None)
@given(
    st.sampled_from([None, 10.0, 200.0]),
    st.floats(0.1, 6.0),
    flaws,
    refusals,
    checks,
    st.sampled_from([0, 0, 1]),
)
def test_nothing_beyond_the_bounds_comes_into_force(kelvin, shift_mm, flaw, refused, check, poses):
    config = config_of(bounds=BOUNDS, poses=POSES[:poses])
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("K1", state_dir=Path(folder)) as history,
    ):
        cell = Cell(history, config, check=check, drift=DRIFTS.get(flaw, KNOWN))
        node = Nodes(kelvin, shift_mm, flaw)
        cell.full, cell.thermal = node.full, node.thermal(cell, refused)
        watched = Watched(cell)
        cell.open_gap()
        cell.run("first", 90.0)
        watched.let_it_end()
        accepted = [d.calibration_id for d in history.decisions() if d.action is Action.ACCEPT]
        assert set(accepted) <= node.allowed
