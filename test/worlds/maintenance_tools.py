# SPDX-License-Identifier: Apache-2.0
"""What tests of tools and of their acceptance ask of a cell."""

from typing import Any

from maintenance_cell import (
    KNOWN,
    LONG_S,
    Cell,
    bent,
    config_of,
    new_tool,
    opened,
    passed,
    proposed,
    thermal_proposed,
)

from robocal_ros.ground.errors import Code
from robocal_ros.history.history_records import TOOL
from robocal_ros.maintenance import robot_interface as ask
from robocal_ros.maintenance.accuracy import AcceptBounds
from robocal_ros.maintenance.robot_interface import DriverAnswer
from robocal_ros.thermal.accuracy import AccuracyLevel


def level(cell: Cell, later_ns: int = 0) -> AccuracyLevel:
    """With a drift of which all is known."""
    cell.session.drift(KNOWN, cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns + later_ns).level


def modes(cell: Cell) -> list[str]:
    return [request.mode for request in cell.log if isinstance(request, ask.Measure)]


def a_check_passes(cell: Cell, cycle_id: str) -> Any:
    """A whole run checks the tool, and nothing is left to say; its result."""
    cell.check = passed()
    cell.log.clear()
    result = cell.ran(cycle_id)
    assert (result.tool_answer, modes(cell)) == ("pass", ["quick"])
    assert level(cell) is AccuracyLevel.OK
    return result


def decide(cell: Cell, name: str, calibration_id: int) -> None:
    assert cell.session.decide(name, calibration_id, "a person", "", cell.wall_ns).done


def until_measuring(cell: Cell, mode: str) -> None:
    cell.run("c1", LONG_S)
    while not (cell.tool.measuring and cell.mode == mode):
        cell.step()


def automatic(history, **changes) -> Cell:
    """A cell that may accept without a person, whose tool is found bent."""
    config = config_of(bounds=AcceptBounds(automatic=True), **changes)
    return opened(history, config=config, check=bent(), drift=KNOWN)


def measured_in_full(cell: Cell, **given: Any) -> int:
    """Until the full measurement is about to give a candidate."""
    until_measuring(cell, "full")
    number = proposed(cell.history, **given)
    cell.full = lambda cell: new_tool(number)
    return number


def straightened(cell: Cell) -> DriverAnswer:
    """A full measurement whose candidate passes the next check."""
    cell.check = passed()
    return new_tool(proposed(cell.history))


def until_sent(cell: Cell) -> None:
    """A cycle, until its first motion goes out."""
    assert cell.run("c1", LONG_S) is Code.ACCEPT
    while not any(isinstance(request, ask.Move) for request in cell.log):
        cell.step()


def until_verified(cell: Cell) -> None:
    """Until the accepted tool is checked."""
    while not (cell.history.head(TOOL).revision and cell.tool.measuring):
        cell.step()
        assert cell.now_s < cell.ends_s


def thermal_candidate(cell: Cell) -> int:
    """What the thermal node answers from now on."""
    number = thermal_proposed(cell.history, 10.0)
    cell.thermal = DriverAnswer(Code.ACCEPT, "warm", number)
    return number
