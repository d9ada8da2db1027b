"""Files of expected drifts: what ``robocal thermal learn-prior`` writes."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import Fields, read_made, write_made

Array = NDArray[np.float64]
Document = dict[str, Any]

KEYS = ("robot", "model_hash", "parameters", "covariance", "cycles")
SYMMETRY = 1e-9  # of the largest element


def write_prior(path: Path, document: Document) -> None:
    """Write the parts of a learned prior's document that an estimator needs."""
    write_made(path, document, KEYS, "thermal learn-prior")


def read_prior(path: Path, arm: SerialArm) -> Array:
    """Covariance (k, k), SI, of the expected drift of ``arm``'s free parameters.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/thermal.md says.
    WrongRobotError
        When it was learned for another nominal model.
    """
    file, top = str(path), read_made(path, arm, KEYS, "prior file", "learn it")
    if top.values.get("parameters") != list(arm.parameters.names):
        raise InputError(
            f"parameters must be {', '.join(arm.parameters.names)}, in this order", file=file
        )
    rows = top.values.get("covariance")
    count = len(arm.parameters)
    if not isinstance(rows, list) or len(rows) != count:
        raise InputError(f"covariance must be {count} rows", file=file)
    table = Fields({f"row {i + 1}": row for i, row in enumerate(rows)}, file, "covariance")
    covariance = np.array([table.numbers(f"row {i + 1}", count) for i in range(count)])
    if np.abs(covariance - covariance.T).max() > SYMMETRY * np.abs(covariance).max():
        raise InputError("covariance is not symmetric", file=file)
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InputError("covariance is not positive: some combination has no spread", file=file)
    return np.asarray(0.5 * (covariance + covariance.T))
