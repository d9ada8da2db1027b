"""What the maintenance remembers over a restart, where it was written by another version."""

import pytest
from maintenance_cell import LONG_S, Cell, opened

from robocal_ros.ground.errors import Code, StorageError
from robocal_ros.maintenance.memory import VERSION

SPOILT = {
    "a part is missing": lambda kept: kept.pop("tool"),
    "a figure that is not known": lambda kept: kept["tool"].update(newer=1),
    "a code that is not known": lambda kept: kept["cycles"][0].update(code=99),
    "a later one": lambda kept: kept.update(version=VERSION + 1),
    "a cycle is no document": lambda kept: kept.update(cycles=["c1"]),
}


@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT)
def test_a_state_of_another_version_is_refused_by_its_name(history, spoil):
    cell = opened(history)
    cell.run("c1", LONG_S)
    cell.finish()
    spoil(cell.shelf.document)
    with pytest.raises(StorageError, match=r"^shelf is not of this version.*move it away"):
        Cell(history, shelf=cell.shelf)


def test_a_cycle_of_before_a_restart_is_told_to_be_old(history):
    cell = opened(history)
    for name in ("c1", "c2"):
        cell.run(name, LONG_S)
        ended = cell.finish()
        assert cell.session.memory.words_of(ended) == ended.message
    assert (ended.run, ended.stamp_ns) == (2, cell.wall_ns)
    cell.restart()
    old = cell.session.run("c2", LONG_S, cell.now_s, cell.wall_ns)
    assert old == ended
    assert cell.session.memory.earlier == {"c1", "c2"}
    words = cell.session.memory.words_of(old)
    old = "cycle 'c2' is one of before this start of the node, run 2, 2023-11-14T"
    assert words.startswith(old)
    assert words.endswith(f"nothing runs now; it ended so: {ended.message}")
    cell.open_gap()
    cell.run("c3", LONG_S)
    new = cell.finish()
    assert (new.run, cell.session.memory.words_of(new)) == (3, new.message)


def test_a_cycle_that_was_killed_has_its_run_and_when_it_began(history):
    cell = opened(history)
    cell.run("c1", LONG_S)
    began_ns = cell.wall_ns
    cell.pass_time(0.5)
    cell.restart()
    result = cell.session.result("c1")
    assert result is not None
    assert (result.run, result.stamp_ns, result.code) == (1, began_ns, Code.CONFLICT)
    assert "run 1" in cell.session.memory.words_of(result)


def test_a_cycle_that_could_not_be_written_is_no_run(history):
    cell = opened(history)

    def full() -> None:
        raise StorageError("the disk is full")

    cell.shelf.takes = full
    assert cell.run("c1", LONG_S) is Code.STORAGE_FAILED
    cell.shelf.takes = lambda: None
    cell.run("c2", LONG_S)
    assert cell.finish().run == 1


def test_a_state_of_the_first_version_is_read(history):
    cell = opened(history)
    cell.run("c1", LONG_S)
    message = cell.finish().message
    kept = cell.shelf.document
    for name in ("version", "runs", "began_ns"):
        del kept[name]
    for cycle in kept["cycles"]:
        del cycle["stamp_ns"], cycle["run"]
    cell.restart()
    result = cell.session.result("c1")
    words = "cycle 'c1' is one of before this start of the node; nothing runs now; it ended so: "
    assert cell.session.memory.words_of(result) == words + message
    cell.open_gap()
    cell.run("c2", LONG_S)
    assert cell.finish().run == 1
