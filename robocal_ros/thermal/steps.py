"""What a step between two cycles may be: the sensor, the sphere on the flange, or a joint.

A step that the drift cannot explain is compared with few simple causes, each a linear model of the
displacement; generalised least squares tells which of them leave no more than noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]

SENSOR = "sensor"
CHANCE = 0.01  # a cause is ruled out where it would leave so much in fewer cases than this
FIXED_FALSE_ALARM = 0.001
SENSOR_WANDER_M = 1e-5  # a sensor that warms up moves by so much without a knock


@dataclass(frozen=True)
class Cause:
    """Something that may have moved.

    Attributes
    ----------
    name : ``sensor`` (or the robot's base, which looks the same), ``sphere``, or a joint's name.
    words : what moved and by how much.
    """

    name: str
    words: str


@dataclass(frozen=True, eq=False)
class FixedSphere:
    """How a sphere that is fixed in the cell has moved since the cold visit.

    Attributes
    ----------
    shift_m : (3,) in the measuring frame.
    moved : whether by more than noise and the sensor's own wander allow.
    """

    shift_m: Array
    moved: bool


def fixed_sphere(cold: Array, now: Array, sigma_m: float) -> FixedSphere:
    """Compare measured centres (n, 3) of a fixed sphere; ``sigma_m`` of one coordinate of one.

    Medians: a wrong one among three or more does no harm.
    """
    shift = np.median(now, axis=0) - np.median(cold, axis=0)
    each = [(1.0 if len(p) < 3 else np.pi / 2.0) / len(p) for p in (cold, now)]
    variance = sigma_m**2 * sum(each) + SENSOR_WANDER_M**2
    limit = chi2_quantile(1.0 - FIXED_FALSE_ALARM, 3)
    return FixedSphere(shift, bool(shift @ shift > limit * variance))


def possible_causes(
    spots: ColdSpots, warm: Measurements, deviation: Array, covariance: Array
) -> tuple[Cause, ...]:
    """Single causes that explain a deviation (3m,) of covariance (3m, 3m), measuring axes.

    Few poses leave many causes possible.
    """
    target = spots.target[spots.match(warm)]
    parameters, setup = spots.rows(warm.q, target)
    lever = warm.position - warm.position.mean(axis=0)
    unit = np.broadcast_to(np.eye(3), (len(warm), 3, 3))
    rigid = np.concatenate([unit, -frames.skew(lever)], axis=2)
    found = []
    if (moved := _explains(rigid, deviation, covariance)) is not None:
        turned = float(np.degrees(np.linalg.norm(moved[3:])))
        by = f"{np.linalg.norm(moved[:3]) * 1e3:.2f} mm and {turned:.3f} deg"
        found.append(Cause(SENSOR, f"sensor and robot base moved against each other by {by}"))
    if (moved := _explains(setup[:, :, 3:], deviation, covariance)) is not None:
        by = f"{np.linalg.norm(moved) * 1e3:.2f} mm"
        found.append(Cause("sphere", f"the sphere moved on the flange by {by}"))
    for name, column in _joint_zeros(spots.cell.arm):
        if (moved := _explains(parameters[:, :, [column]], deviation, covariance)) is not None:
            by = f"{np.degrees(moved[0]):.4f} deg"
            found.append(Cause(name, f"the zero of {name} changed by {by}"))
    return tuple(found)


def step_words(causes: Sequence[Cause], fixed: FixedSphere | None) -> str:
    """Say what moved, what cannot be told, and what would decide."""
    if fixed is not None and fixed.moved:
        by = f"{np.linalg.norm(fixed.shift_m) * 1e3:.2f} mm"
        return (
            f"the fixed sphere seems to have moved by {by}, so the sensor did: fasten it, then "
            "capture a new cold reference"
        )
    said = "" if fixed is None else "the fixed sphere stands where it was, so the sensor too; "
    if causes:
        said += "or ".join(f"{cause.words}; " for cause in causes)
        said += "the data cannot tell these apart; " if len(causes) > 1 else ""
    else:
        said += "no single cause explains it; "
    if fixed is None and any(cause.name == SENSOR for cause in causes):
        said += (
            "a second sphere, fixed to the floor or the base and measured as "
            "reference_sphere_center, would decide; "
        )
    return f"{said}look at sensor, sphere and robot, then calibrate or capture a new cold reference"


def _joint_zeros(arm: SerialArm) -> list[tuple[str, int]]:
    names = arm.parameters.names
    wanted = [
        (joint, f"d{i}_mm" if arm.prismatic[i - 1] else f"theta{i}_deg")
        for i, joint in enumerate(arm.joint_names, start=1)
    ]
    return [(joint, names.index(name)) for joint, name in wanted if name in names]


def _explains(rows: Array, deviation: Array, covariance: Array) -> Array | None:
    """Size (h,) of a cause with rows (m, 3, h) that leaves only noise; None where it leaves more.

    Generalised least squares; what is left over is chi-square of 3m - h where the cause is true.
    """
    G = rows.reshape(len(deviation), -1)
    freedom = len(deviation) - G.shape[1]
    L = np.linalg.cholesky(covariance)
    whitened = np.linalg.solve(L, np.column_stack([G, deviation]))
    size, *_ = np.linalg.lstsq(whitened[:, :-1], whitened[:, -1], rcond=None)
    left = whitened[:, -1] - whitened[:, :-1] @ size
    if freedom > 0 and left @ left > chi2_quantile(1.0 - CHANCE, freedom):
        return None
    return np.asarray(size)
