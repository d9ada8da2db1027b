"""Tables of attained positions (docs/iso9283.md)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.cells import read_cells
from robocal_ros.ground.samples import DEFAULT_TARGET
from robocal_ros.kinematics.tables import POSITION, check_plain

Array = NDArray[np.float64]


def read_positions(path: Path) -> dict[str, Array]:
    """Positions (n, 3), m, of each target, in the order of the table.

    Raises
    ------
    InputError
        With file, row and column, when the table is not as docs/iso9283.md says.
    """
    columns = POSITION["mm"]
    table = read_cells(path, lambda header, file: check_plain(header, file, columns, ("target",)))
    position = np.column_stack([table.numbers(name) for name in columns]) * 1e-3
    target = np.array(table.words("target") or (DEFAULT_TARGET,) * len(position))
    return {str(name): position[target == name] for name in dict.fromkeys(target.tolist())}
