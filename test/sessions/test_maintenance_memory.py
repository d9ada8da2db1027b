"""What the maintenance remembers over a restart, where it was written by another version."""

import pytest
from maintenance_cell import LONG_S, Cell, opened

from robocal_ros.core.errors import StorageError

SPOILT = {
    "a part is missing": lambda kept: kept.pop("tool"),
    "a figure that is not known": lambda kept: kept["tool"].update(newer=1),
    "a code that is not known": lambda kept: kept["cycles"][0].update(code=99),
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
