# SPDX-License-Identifier: Apache-2.0
"""The two programs of docs/plc.md, as they stand there: what they do in each turn that a gap takes.

The one by Modbus talks to the bridge's own server; the cell behind is played. Time is the program's
cycles. Live, against a bridge: test/nodes/test_plc_bridge.py.
"""

import asyncio
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest
from pymodbus.client import ModbusTcpClient
from structured_text import StructuredText, samples

from bench.live.opc_ua import free_port
from robocal_ros.ground.errors import Code
from robocal_ros.plc.modbus import HOLDING_WORDS, INPUT_WORDS, NO_ANSWER, RUN, ModbusServer

CYCLE_S = 0.05  # of the PLC
CLOSES_S = 0.7  # after the last beat that was given nothing is moved any more
SHOWN_LATE = 4  # cycles
LATE, NEVER = "late", "never"
IDLE, RUNNING, FAULT = 1, 2, 4
TITLES = {"OPC UA": "In Structured Text", "Modbus": "In Structured Text, by Modbus"}


class Cell:
    """What the bridge shows, and how it answers a call: with a code, too late, or never."""

    def __init__(self) -> None:
        self.beat, self.state = 3_000_000_000, IDLE
        self.code = self.last = self.running = 0  # code, last: of the cycle that ended last
        self.at_home = self.heard = True
        self.begins: list[int] = []  # a cycle that was accepted and is not shown yet
        self.answers: list[Any] = []
        self.called: list[int] = []
        self.known: set[int] = set()  # of cycles that ran: an id is accepted, nothing begins

    def run(self, cycle: int) -> Any:
        self.called.append(cycle)
        answer = self.answers.pop(0) if self.answers else Code.ACCEPT
        if answer == Code.ACCEPT and cycle not in self.known:
            self.begins = [cycle] * SHOWN_LATE
        return answer

    def show(self) -> None:
        """The status comes behind the answer: until then it is the one of before."""
        self.beat += 1
        if self.begins:
            self.running = self.begins.pop()
            if not self.begins:
                self.state, self.at_home = RUNNING, False

    def end(self, state: int = IDLE) -> None:
        self.state, self.at_home = state, state == IDLE
        self.code, self.last = int(Code.ACCEPT), self.running


class ByOpcUa:
    """Variables and the call as a client of OPC UA has them."""

    LAG = 0

    def __init__(self, cell: Cell, program: StructuredText) -> None:
        self._cell, self._program, self._was = cell, program, False

    def take(self) -> None:
        cell, plc = self._cell, self._program
        plc["udiBeat"], plc["bBeatGood"] = cell.beat, cell.heard
        plc["diState"], plc["diCode"], plc["bAtHome"] = cell.state, cell.code, cell.at_home
        plc["sLast"] = str(cell.last)

    def give(self) -> int:
        plc = self._program
        if plc["bRun"] and not self._was:
            answer = self._cell.run(int(plc["sMine"]))
            plc["bRunDone"], plc["bTimeout"] = answer != NEVER, answer == LATE
            plc["bSuccess"] = answer == Code.ACCEPT
        elif not plc["bRun"]:
            plc["bRunDone"] = False
        self._was = plc["bRun"]
        return int(plc["udiHeartbeat"])

    def close(self) -> None:
        """Nothing is open."""


class ByModbus:
    """Registers, by pymodbus and the bridge's server; this is the image that it serves.

    A gateway stands between: what the PLC gives comes some cycles late.
    """

    LAG = 3  # cycles

    def __init__(self, cell: Cell, program: StructuredText) -> None:
        self._cell, self._program, self._echo = cell, program, -1
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, daemon=True).start()
        port = free_port()
        self._server = ModbusServer(self, ["127.0.0.1"], str)
        self._do(self._server.start("127.0.0.1", port))
        self._images = deque([[0] * HOLDING_WORDS] * self.LAG)
        self._client = ModbusTcpClient("127.0.0.1", port=port)
        assert self._client.connect()

    def _do(self, work: Any) -> None:
        asyncio.run_coroutine_threadsafe(work, self._loop).result(10.0)

    # what the server asks

    def values(self) -> Mapping[str, Any]:
        cell = self._cell
        return {
            "Gap.Beat": cell.beat,
            "Active": True,
            "Valid": cell.heard,
            "Maintenance.State": cell.state,
            "Maintenance.AtHome": cell.at_home,
            "LastCycle.Code": cell.code,
            "LastCycle.Number": cell.last,
        }

    def heartbeat(self, writer: str, echo: int) -> int:
        self._echo = echo
        return 0

    def end(self, writer: str) -> None:
        """A connection is gone."""

    async def request(self, writer: str, command: int, cycle: int, gap_s: int) -> int:
        assert (command, gap_s) == (RUN, 60)
        answer = self._cell.run(cycle)
        while answer == NEVER:
            await asyncio.sleep(3600.0)
        return NO_ANSWER if answer == LATE else int(answer)

    # what a client does in each of its cycles

    def take(self) -> None:
        read = self._client.read_input_registers(0, count=INPUT_WORDS)
        self._program["awIn"], self._program["bOnline"] = read.registers, not read.isError()

    def give(self) -> int:
        assert len(self._program["awOut"]) == HOLDING_WORDS
        self._images.append([*self._program["awOut"]])
        assert not self._client.write_registers(0, self._images.popleft()).isError()
        return self._echo

    def close(self) -> None:
        self._client.close()
        self._do(self._server.stop())
        self._loop.call_soon_threadsafe(self._loop.stop)


class Plc:
    """A PLC that runs one of the programs; never does it give the gap while it produces."""

    def __init__(self, way: str) -> None:
        self.now_s, self.given, self.closed_s, self._way = 0.0, 0, 0.0, way
        self.cell, self.program = Cell(), self._made()
        self.line = {"OPC UA": ByOpcUa, "Modbus": ByModbus}[way](self.cell, self.program)

    def _made(self) -> StructuredText:
        made = StructuredText(samples()[TITLES[self._way]], lambda: self.now_s)
        made["bCellSafe"] = True
        return made

    def restart(self) -> None:
        """A power cut of the PLC: what it retains is all that is left."""
        kept = self.program["udiNumber"]
        self.program = self.line._program = self._made()
        self.program["udiNumber"] = kept

    def scan(self) -> None:
        was = self.program["bProducing"]
        self.line.take()
        self.program.scan()
        self.given = self.line.give()
        self.closed_s = 0.0 if self.given else self.closed_s + CYCLE_S
        assert not (self.given and self.program["bProducing"])
        assert not self.given or self.given == self.cell.beat - self.line.LAG
        if self.program["bProducing"] and not was:
            assert self.closed_s >= CLOSES_S
        self.now_s += CYCLE_S
        self.cell.show()

    def closes(self) -> None:
        """At once: as soon as what it gives has come."""
        for _ in range(self.line.LAG + 1):
            self.scan()
        assert not self.given

    def until(self, holds: Callable[[], object], within_s: float = 10.0) -> None:
        end_s = self.now_s + within_s
        while not holds():
            assert self.now_s < end_s, (self.program._values, vars(self.cell))
            self.scan()

    def stays(self, holds: Callable[[], object], seconds: float = 5.0) -> None:
        end_s = self.now_s + seconds
        while self.now_s < end_s:
            self.scan()
            assert holds(), (self.program._values, vars(self.cell))

    def produces(self) -> bool:
        return bool(self.program["bProducing"])

    def pause(self) -> None:
        """The programme has ended: a gap is asked for, once it may be."""
        self.until(self.produces)
        self.program["bPause"] = True

    def runs(self) -> None:
        """A cycle runs."""
        self.pause()
        self.until(lambda: self.cell.state == RUNNING and self.program["iStep"] == 4)


@pytest.fixture(params=TITLES)
def plc(request: pytest.FixtureRequest) -> Iterator[Plc]:
    made = Plc(request.param)
    yield made
    made.line.close()


def test_the_page_has_both() -> None:
    assert set(samples()) == set(TITLES.values())


def test_a_gap_is_given_taken_back_and_given_again(plc: Plc) -> None:
    for _ in range(2):
        plc.runs()
        plc.stays(lambda: plc.given and not plc.produces(), 3.0)
        plc.cell.end()
        plc.until(plc.produces, 2.0)
        plc.stays(lambda: plc.produces() and not plc.given, 3.0)
    first, second = plc.cell.called
    assert second > first > 0


def test_a_cycle_whose_answer_is_late_is_asked_for_again_by_its_own_id(plc: Plc) -> None:
    plc.cell.answers = [LATE, LATE, Code.ACCEPT]
    plc.runs()
    assert len(plc.cell.called) == 3
    assert len(set(plc.cell.called)) == 1
    plc.cell.end()
    plc.until(plc.produces)


@pytest.mark.parametrize("answer", [NEVER, LATE, Code.CONFLICT, Code.LIMIT_EXCEEDED])
def test_without_a_cycle_the_gap_is_closed_and_the_program_goes_on(plc: Plc, answer: Any) -> None:
    plc.runs()
    plc.cell.end()  # what answered this one answers no other
    plc.cell.answers = [answer] * 1000
    plc.pause()
    plc.until(lambda: len(plc.cell.called) > 1)
    plc.until(plc.produces, 4.0)
    if isinstance(answer, Code):
        assert len(plc.cell.called) == 2
    plc.stays(plc.produces)


def test_after_a_fault_the_program_waits_for_a_person(plc: Plc) -> None:
    plc.runs()
    plc.cell.end(FAULT)
    plc.scan()
    plc.closes()
    plc.stays(lambda: not plc.given and not plc.produces())
    plc.cell.end()
    plc.until(plc.produces, 1.0)


def test_a_plc_that_starts_in_a_cycle_waits_for_its_end(plc: Plc) -> None:
    plc.runs()
    plc.restart()
    plc.closes()
    plc.stays(lambda: not plc.given and not plc.produces())
    plc.cell.end()
    plc.until(plc.produces, 1.0)
    plc.runs()
    assert plc.cell.called[1] > plc.cell.called[0], "never given again"


def test_a_number_that_was_lost_goes_on_behind_the_last_cycles(plc: Plc) -> None:
    plc.cell.last, plc.cell.code, plc.cell.known = 187, int(Code.ACCEPT), {*range(188)}
    plc.runs()
    assert plc.cell.called == [188]
    plc.cell.end()
    plc.until(plc.produces)


def test_a_cycle_that_ran_before_holds_nothing_up(plc: Plc) -> None:
    """The number was lost, and a cycle without one ended last."""
    plc.cell.known = {1}
    plc.pause()
    plc.until(lambda: plc.cell.called)
    plc.until(plc.produces, 6.0)
    plc.stays(lambda: plc.produces() and not plc.given)
    plc.runs()
    assert plc.cell.called == [1, 2]


def test_of_a_cell_that_is_not_heard_nothing_is_believed(plc: Plc) -> None:
    plc.runs()
    plc.cell.heard = False
    plc.closes()
    plc.stays(lambda: not plc.given and not plc.produces())
    plc.cell.end()
    plc.stays(lambda: not plc.produces())
    plc.cell.heard = True
    plc.until(plc.produces, 2.0)


def test_while_the_cell_is_not_heard_no_gap_begins(plc: Plc) -> None:
    plc.until(plc.produces)
    plc.cell.heard = False
    plc.program["bPause"] = True
    plc.stays(plc.produces)
    plc.cell.heard = True
    plc.runs()


def test_a_fence_that_is_opened_closes_the_gap_at_once(plc: Plc) -> None:
    plc.runs()
    plc.program["bCellSafe"] = False
    plc.closes()


def test_away_from_home_no_gap_begins(plc: Plc) -> None:
    plc.cell.at_home = False
    plc.pause()
    plc.stays(lambda: plc.produces() and not plc.given)
    assert not plc.cell.called
