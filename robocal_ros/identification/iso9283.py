"""Position accuracy and repeatability of a pose approached again and again, as ISO 9283 has them.

ISO 9283:1998, 7.2.1 (pose accuracy) and 7.2.2 (pose repeatability), for positions.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.cells import read_cells
from robocal_ros.ground.errors import TooFewSamplesError
from robocal_ros.ground.samples import DEFAULT_TARGET
from robocal_ros.kinematics.tables import POSITION, check_plain

Array = NDArray[np.float64]

CYCLES = 30  # that the standard asks for


@dataclass(frozen=True, eq=False)
class Repeated:
    """A commanded pose that was approached ``n`` times.

    Attributes
    ----------
    barycentre : (3,) mean of the attained positions, m.
    mean_distance_m, S_m : mean of the distances to the barycentre and their standard deviation,
        with n - 1.
    offset : (3,) barycentre less the commanded position (AP_x, AP_y, AP_z), m; None where what was
        commanded is not known.
    """

    n: int
    barycentre: Array
    mean_distance_m: float
    S_m: float
    offset: Array | None

    @property
    def RP_m(self) -> float:
        """Position repeatability: mean distance and three standard deviations, m."""
        return self.mean_distance_m + 3.0 * self.S_m

    @property
    def AP_m(self) -> float | None:
        """Position accuracy: distance of the barycentre from what was commanded, m."""
        return None if self.offset is None else float(np.linalg.norm(self.offset))


def repeated(position: Array, commanded: Array | None = None) -> Repeated:
    """Accuracy and repeatability of one pose.

    Parameters
    ----------
    position : (n, 3) attained positions, m, in the frame of ``commanded``.
    commanded : (3,), m.

    Raises
    ------
    TooFewSamplesError
        For a single position: it does not show how well it is repeated.
    """
    n = len(position)
    if n < 2:
        raise TooFewSamplesError(
            f"{n} position shows no repeatability: measure the pose at least twice; ISO 9283 asks "
            f"for {CYCLES} cycles"
        )
    barycentre = position.mean(axis=0)
    distance = np.linalg.norm(position - barycentre, axis=1)
    return Repeated(
        n=n,
        barycentre=barycentre,
        mean_distance_m=float(distance.mean()),
        S_m=float(distance.std(ddof=1)),
        offset=None if commanded is None else barycentre - commanded,
    )


# ---- tables of attained positions (docs/identify.md) ---------------------------------------------


def read_positions(path: Path) -> dict[str, Array]:
    """Positions (n, 3), m, of each target, in the order of the table.

    Raises
    ------
    InputError
        With file, row and column, when the table is not as docs/identify.md says.
    """
    columns = POSITION["mm"]
    table = read_cells(path, lambda header, file: check_plain(header, file, columns, ("target",)))
    position = np.column_stack([table.numbers(name) for name in columns]) * 1e-3
    target = np.array(table.words("target") or (DEFAULT_TARGET,) * len(position))
    return {str(name): position[target == name] for name in dict.fromkeys(target.tolist())}
