"""What is known of the tool: when it was checked, which one, and what may be concluded."""

import maintenance_cell
import pytest
from maintenance_cell import ARM, POSES, REFUSED, SILENT, Cell, bent, config_of, passed
from tool_driver import TAUGHT

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import StorageError
from robocal_ros.core.proposals import TOOL, Proposal
from robocal_ros.core.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.sessions.events import ACCEPT, ROLLBACK, WITHHOLD
from robocal_ros.sessions.maintenance import AcceptBounds, State
from robocal_ros.sessions.maintenance import requests as ask
from robocal_ros.sessions.maintenance.accuracy import Drift
from robocal_ros.sessions.maintenance.deciding import Decider
from robocal_ros.sessions.maintenance.requests import Answer
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


def proposed(cell: Cell) -> int:
    """A tool candidate one millimetre from the taught one."""
    tool = TAUGHT.copy()
    tool[0, 3] += 1e-3
    return cell.history.propose(
        Proposal(
            kind=TOOL, model_hash=ARM.model_hash, based_on=cell.history.head(TOOL).revision,
            cycle_id="", stamp_ns=0, created_ns=0, software="", method="", code=Code.ACCEPT,
            reason="", document={},
            model={
                "T_flange_tool": tool.tolist(), "covariance": None, "thermal_revision": 0,
                "made_with": {"taught": TAUGHT.tolist()},
            },
        )
    )  # fmt: skip


def decide(cell: Cell, name: str, calibration_id: int) -> None:
    assert cell.session.decide(name, calibration_id, "a person", "", cell.wall_ns).done


def found_bent(cell: Cell) -> None:
    cell.check = bent()
    cell.run("bent", TOO_SHORT_FOR_FULL_S)
    cell.finish()
    assert level(cell) is AccuracyLevel.DEGRADED


def test_a_bent_tool_stays_bent_when_another_one_comes_into_force(cell):
    """The tool of the model in force changed, the one on the robot did not."""
    decide(cell, ACCEPT, proposed(cell))
    found_bent(cell)
    assert cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns).done
    assert level(cell) is AccuracyLevel.DEGRADED
    cell.check = passed()
    cell.log.clear()
    cell.run("c2", LONG_S)
    cell.finish()
    assert modes(cell) == ["quick"]
    assert level(cell) is AccuracyLevel.OK


@pytest.mark.parametrize("rolled_back", [False, True])
def test_a_bent_tool_expires_as_any_other(cell, rolled_back):
    decide(cell, ACCEPT, proposed(cell))
    found_bent(cell)
    if rolled_back:
        cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    assert level(cell, 30 * DAY_NS) is AccuracyLevel.EXPIRED


def until_measuring(cell: Cell, mode: str) -> None:
    cell.run("c1", LONG_S)
    while not (cell.tool.measuring and cell.mode == mode):
        cell.step()


def test_a_pass_is_not_credited_to_another_tool(cell):
    """A person takes the tool back while it is checked."""
    decide(cell, ACCEPT, proposed(cell))
    until_measuring(cell, "quick")
    cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    result = cell.finish()
    assert "another tool came into force" in result.message
    assert (result.tool_answer, result.complete) == ("", False)
    assert level(cell) is AccuracyLevel.EXPIRED  # never checked
    cell.log.clear()
    cell.run("c2", LONG_S)
    assert cell.finish().tool_answer == "pass"
    assert level(cell) is AccuracyLevel.OK


def test_a_full_measurement_of_another_tool_is_not_credited(cell):
    decide(cell, ACCEPT, proposed(cell))
    cell.check = bent()
    until_measuring(cell, "full")
    cell.session.decide_only(ROLLBACK, "a person", cell.wall_ns)
    assert "another tool came into force" in cell.finish().message
    assert level(cell) is AccuracyLevel.DEGRADED


def automatic(history, **changes) -> Cell:
    """A cell that may accept without a person, whose tool is found bent."""
    cell = Cell(history, config_of(bounds=AcceptBounds(automatic=True), **changes), check=bent())
    cell.open_gap()
    return cell


def measured_in_full(cell: Cell) -> int:
    """Until the full measurement is about to give a candidate."""
    until_measuring(cell, "full")
    number = proposed(cell)
    cell.full = Answer(Code.ACCEPT, "a new tool", number, (), True, "", 1.0, 0.03)
    return number


@pytest.mark.parametrize("how", [REFUSED, SILENT])
def test_a_tool_without_a_thermal_result_waits(history, how):
    cell = automatic(history)
    cell.services["thermal"] = how
    number = measured_in_full(cell)
    result = cell.finish()
    assert f"tool candidate {number} waits" in result.message
    (withheld,) = (outcome for name, outcome in cell.events if name == WITHHOLD)
    assert withheld.command.arguments == {"id": number, "kind": TOOL}
    assert withheld.message in result.message
    assert result.accepted == ()
    assert cell.history.head(TOOL).revision == 0


@pytest.mark.parametrize("poses", [POSES, POSES[:0]])
def test_a_tool_with_a_known_drift_is_accepted(history, poses):
    cell = automatic(history, poses=poses)
    number = measured_in_full(cell)
    while not cell.history.head(TOOL).revision:
        cell.step()
    cell.check = passed()
    assert cell.finish().accepted == (number,)


def until_verified(cell: Cell) -> None:
    """Until the accepted tool is checked."""
    while not (cell.history.head(TOOL).revision and cell.tool.measuring):
        cell.step()


def test_an_accepted_tool_that_fails_its_check_is_taken_back(history):
    cell = automatic(history)
    measured_in_full(cell)
    result = cell.finish()
    assert "was taken back" in result.message
    assert (result.code, result.accepted) == (Code.ACCEPT, ())
    assert history.head(TOOL).calibration_id is None


def test_what_a_person_chose_meanwhile_is_not_taken_back(history):
    cell = automatic(history)
    first = proposed(cell)
    decide(cell, ACCEPT, first)
    second = proposed(cell)
    decide(cell, ACCEPT, second)
    number = measured_in_full(cell)
    while not (history.head(TOOL).calibration_id == number and cell.tool.measuring):
        cell.step()
    decide(cell, ROLLBACK, first)
    result = cell.finish()
    assert history.head(TOOL).calibration_id == first
    assert result.accepted == ()
    assert "taken back" not in result.message


@pytest.mark.parametrize("where", [(CalibrationHistory, "rollback"), (Decider, "roll_back")])
def test_a_tool_that_cannot_be_taken_back_is_a_fault(history, monkeypatch, where):
    def held(*args, **kwargs):
        raise StorageError("the history is held")

    cell = automatic(history)
    number = measured_in_full(cell)
    until_verified(cell)
    monkeypatch.setattr(*where, held)
    result = cell.finish()
    assert result.accepted == (number,)
    assert result.code is Code.CONFLICT
    assert "could not be taken back: the history is held" in result.message
    assert cell.state is State.FAULT
    assert not cell.tool.armed
    assert cell.at_home()
