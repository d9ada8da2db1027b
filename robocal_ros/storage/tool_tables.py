"""Tables about tools: points of light beams, edges, flange poses (docs/tool.md)."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.tool.beam_edges import BEAMS, Beam, BeamEdge
from robocal_ros.storage.cells import Cells, read_cells
from robocal_ros.storage.table_columns import ORIENTATIONS, check_plain, orientation_columns
from robocal_ros.storage.tables import read_rotations

Array = NDArray[np.float64]

POSITION = ("x_mm", "y_mm", "z_mm")
STATES = {"1": True, "true": True, "0": False, "false": False}


def read_beam_points(path: Path) -> dict[str, Array]:
    """Flange positions (3,), base, m, by the name of their edge; of one measured often the mean.

    Raises
    ------
    InputError
        With file, row and column, when the table is not as docs/tool.md says.
    """
    table = read_cells(path, lambda header, file: check_plain(header, file, ("point", *POSITION)))
    positions = _positions(table)
    names = np.array(table.words("point"))
    return {str(name): positions[names == name].mean(axis=0) for name in dict.fromkeys(names)}


def read_edges(path: Path, sigma_s: float) -> list[BeamEdge]:
    """Edges of the beams, with ``sigma_s`` where the table has none of its own.

    Raises
    ------
    InputError
        As `read_beam_points`.
    """
    required, optional = ("stamp_s", "beam", "blocked"), ("sigma_s",)
    table = read_cells(path, lambda header, file: check_plain(header, file, required, optional))
    beams, states = table.words("beam"), table.words("blocked")
    for index, (beam, state) in enumerate(zip(beams, states, strict=True)):
        if beam not in BEAMS:
            table.fail(f"'{beam}' is not one of {', '.join(BEAMS)}", index, "beam")
        if state.lower() not in STATES:
            table.fail(f"'{state}' is neither 1 (blocked) nor 0", index, "blocked")
    names: dict[str, Beam] = {name: name for name in BEAMS}
    stamps = table.numbers("stamp_s")
    sigma = np.full(len(stamps), sigma_s)
    if "sigma_s" in table.columns:
        sigma = table.numbers("sigma_s")
        if np.any(sigma <= 0.0):
            table.fail("no stamp is exact", int(np.argmax(sigma <= 0.0)), "sigma_s")
    return [
        BeamEdge(names[beam], STATES[state.lower()], time, spread)
        for beam, state, time, spread in zip(
            beams, states, stamps.tolist(), sigma.tolist(), strict=True
        )
    ]


def read_flange_poses(path: Path) -> Array:
    """T_base_flange (m, 4, 4).

    Raises
    ------
    InputError
        As `read_beam_points`; without an orientation.
    """
    every = [name for names in ORIENTATIONS for name in names]

    def check(header: list[str], file: str) -> None:
        check_plain(header, file, POSITION, every)
        if orientation_columns([name.strip() for name in header], file) is None:
            check_plain(header, file, (*POSITION, *ORIENTATIONS[-1]), every)

    table = read_cells(path, check)
    kind = orientation_columns(list(table.columns), table.file)
    return frames.transform(read_rotations(table, kind or ORIENTATIONS[-1]), _positions(table))


def _positions(table: Cells) -> Array:
    return 1e-3 * np.column_stack([table.numbers(name) for name in POSITION])
