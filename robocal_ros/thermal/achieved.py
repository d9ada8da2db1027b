"""What models of a drifting arm leave of its errors: as measured, and in truth."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.reference import ColdReference

Array = NDArray[np.float64]


def measured_errors(
    reference: ColdReference,
    warm: Measurements,
    models: Sequence[SerialArm],
    *,
    left_out: Sequence[str] = (),
    sigma_m: float,
) -> list[Array]:
    """Errors (m, 3), m, in measuring axes, that each model leaves at the poses of a warm visit.

    Against the cold visit: the cold model itself leaves the whole drift. Visits of one pose are
    averaged; the noise of both visits is in it. ``left_out``: names of averaged visits that no
    model can fit. ``sigma_m``: of a coordinate of one visit.

    Raises
    ------
    InputError
        When a measurement has no cold counterpart.
    """
    spots, cold = reference.spots, reference.cell.arm
    data = spots.average(warm, sigma_m)
    data = data.take(~np.isin(data.sample, left_out))
    moved = spots.drift(data)
    rows = spots.rows(data.q, spots.target[spots.match(data)])[0]
    return [moved - rows @ cold.parameters.read(model.mdh - cold.mdh) for model in models]


def true_errors(cold: SerialArm, model: SerialArm, q: Array, tool: Array, moved: Array) -> Array:
    """Errors (m, 3), m, base, that a model leaves where the tool truly moved by ``moved`` (m, 3).

    What joints corrected by the model miss: its own displacement of the tool (3,), flange, at the
    joints (m, n) is corrected away. The second order, drift times correction, is left out.
    """
    point = np.append(tool, 1.0)
    told = (model.fk(q) - cold.fk(q)) @ point
    return np.asarray(moved - told[:, :3])
