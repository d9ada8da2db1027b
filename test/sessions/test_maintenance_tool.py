"""What is known of the tool: when it was checked, which one, and what may be concluded."""

import maintenance_cell
import pytest
from maintenance_cell import Cell, bent

from robocal_ros.core.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.sessions.maintenance import requests as ask
from robocal_ros.sessions.maintenance.accuracy import Drift
from robocal_ros.storage.calibrations import CalibrationHistory

LONG_S = 120.0
TOO_SHORT_FOR_FULL_S = 33.0
DAY_NS = 86_400 * 10**9


@pytest.fixture
def history(tmp_path):
    with CalibrationHistory.open("K1", state_dir=tmp_path) as opened:
        yield opened


@pytest.fixture
def cell(history) -> Cell:
    made = Cell(history)
    made.open_gap()
    return made


def level(cell: Cell, later_ns: int = 0) -> AccuracyLevel:
    """With a drift of which all is known."""
    cell.session.drift(Drift(AccuracyLevel.OK, "", ToolError(1e-5, 2e-5), 600.0), cell.now_s)
    return cell.session.accuracy(cell.now_s, cell.wall_ns + later_ns).level


def modes(cell: Cell) -> list[str]:
    return [request.mode for request in cell.log if isinstance(request, ask.Measure)]


def test_a_check_in_the_future_is_none(cell, monkeypatch):
    """The computer's clock was set back by a day."""
    cell.run("c1", LONG_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.OK
    monkeypatch.setattr(maintenance_cell, "WALL_NS", maintenance_cell.WALL_NS - DAY_NS)
    assert level(cell) is AccuracyLevel.EXPIRED
    cell.log.clear()
    cell.run("c2", LONG_S)
    cell.finish()
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK
