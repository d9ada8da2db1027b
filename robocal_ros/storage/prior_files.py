"""Files of expected drifts: what ``robocal thermal learn-prior`` writes."""

from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError, WrongRobotError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.storage.files import read_text, write_text
from robocal_ros.storage.robot_fields import Fields, load_yaml

Array = NDArray[np.float64]
Document = dict[str, Any]

KEYS = ("robot", "model_hash", "parameters", "covariance", "cycles")
SYMMETRY = 1e-9  # of the largest element


def write_prior(path: Path, document: Document) -> None:
    """Write the parts of a learned prior's document that an estimator needs."""
    kept = {key: document[key] for key in KEYS}
    text = yaml.safe_dump(kept, sort_keys=False, default_flow_style=None, width=2**16)
    write_text(path, f"# Written by robocal thermal learn-prior.\n{text}")


def read_prior(path: Path, arm: SerialArm) -> Array:
    """Covariance (k, k), SI, of the expected drift of ``arm``'s free parameters.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/thermal.md says.
    WrongRobotError
        When it was learned for another nominal model.
    """
    file = str(path)
    top = Fields(load_yaml(read_text(path, "prior file"), file), file, "")
    top.only(*KEYS)
    if top.text("model_hash") != arm.model_hash:
        raise WrongRobotError(
            f"{path} was learned for {top.text('robot')} with the model {top.text('model_hash')}, "
            f"not for {arm.name} ({arm.model_hash}): learn it with this robot file"
        )
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
