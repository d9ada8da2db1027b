"""Files of taught poses: a row each, its kind and its joint angles in degrees."""

import csv
from pathlib import Path

import numpy as np
from numpy.typing import NDArray


def read_poses(path: Path, *kinds: str) -> NDArray[np.float64]:
    """Poses (m, n) of these kinds in the order of the file, rad."""
    with path.open(newline="") as stream:
        rows = [row[1:] for row in csv.reader(stream) if row[0] in kinds]
    return np.radians(np.array(rows, dtype=np.float64))
