"""Where a fixed sensor stands and where the sphere sits on the flange, from one cold visit.

``p_sensor = T_sensor_base T_base_flange(q) p_flange`` over n >= 5 poses that turn the flange about
two axes or more.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import LARGEST_RMS_M, Verdict
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell import CellModel
from robocal_ros.identification.judged import require_match
from robocal_ros.identification.solve import identify, linear_start
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_made, write_made

Array = NDArray[np.float64]
SensorMethod = Literal["ml", "classic"]

FEWEST_POSES = 5
PENALTY = 1e3  # of the orthogonality constraints, against equations in metres
NAMES = (
    "base_x_mm", "base_y_mm", "base_z_mm", "base_rx_deg", "base_ry_deg", "base_rz_deg",
    "sphere_x_mm", "sphere_y_mm", "sphere_z_mm",
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class SensorCalibration:
    """A placed sensor.

    Attributes
    ----------
    T_sensor_base : (4, 4) the robot's base in the sensor's frame.
    sphere_in_flange : (3,) centre of the sphere in the flange frame, m.
    covariance : (9, 9), SI, of ``NAMES``: shift of the base and turn about it (sensor axes), and
        the sphere (flange axes); None for the classic method, which has no noise model.
    residual : (m, 3) predicted minus measured centre, sensor axes, m.
    left_out : (m,) distance at each pose of a calibration from the others, m.
    rejected : names of the samples that do not fit the others.
    """

    method: SensorMethod
    T_sensor_base: Array
    sphere_in_flange: Array
    covariance: Array | None
    residual: Array
    left_out: Array
    rejected: tuple[str, ...]

    @property
    def sigma(self) -> Array | None:
        """Standard deviations (9,) of ``NAMES``, m and rad."""
        return None if self.covariance is None else np.sqrt(np.diag(self.covariance))


def sensor_verdict(found: SensorCalibration) -> Verdict:
    """Decide whether a placed sensor can be used.

    Drifts are compared pose by pose, so that an arm's static errors of a millimetre or two do no
    harm; a placement that misses its own poses by more belongs to another robot or mistake.
    """
    judged = found.left_out[np.isfinite(found.left_out)]
    if len(judged) < len(found.left_out):
        open_poses = len(found.left_out) - len(judged)
        return Verdict(
            Code.TOO_FEW_SAMPLES,
            f"without any of {open_poses} poses the others place nothing: measure more poses",
        )
    rms_m = float(np.sqrt(np.mean(judged**2)))
    words = f"each pose from the others: {rms_m * 1e3:.3f} mm rms"
    if rms_m > LARGEST_RMS_M:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words}, more than any robot's static error ({LARGEST_RMS_M * 1e3:.0f} mm): check "
            "robot file, units, joint signs and which sphere was measured",
        )
    return Verdict(Code.ACCEPT, words)


def calibrate_sensor(
    arm: SerialArm, data: Measurements, method: SensorMethod = "ml"
) -> SensorCalibration:
    """Place sensor and sphere with the cold model ``arm``.

    ``ml`` is robust maximum likelihood over (R, t, p) on the manifold, weighted by the samples'
    sigma, from the linear start; ``classic`` solves the pose differences for nine free elements
    of R and p with an orthogonality penalty, then t as the mean over the poses.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the poses cannot place them; the message names the missing motion.
    InputError, ResidualError
        When the data miss the arm by a mistake that can be named, or R comes out reflected.
    """
    if len(data) < FEWEST_POSES:
        raise TooFewSamplesError(
            f"{len(data)} poses cannot place sensor and sphere: at least {FEWEST_POSES} are needed"
        )
    if len(data.targets) > 1:
        raise TooFewSamplesError(
            f"{len(data.targets)} targets ({', '.join(data.targets)}) in one visit: give one sphere"
        )
    require_match(arm, data, base=True, tool=True)
    cell, covariance, rejected = _place(arm, data, method)
    return SensorCalibration(
        method=method,
        T_sensor_base=cell.T_frame_base,
        sphere_in_flange=cell.T_flange_target[0, :3, 3],
        covariance=covariance,
        residual=cell.residual(data),
        left_out=_left_out(arm, data, method, rejected),
        rejected=tuple(data.sample[i] for i in np.flatnonzero(rejected)),
    )


def _place(
    arm: SerialArm, data: Measurements, method: SensorMethod
) -> tuple[CellModel, Array | None, NDArray[np.bool_]]:
    if method == "classic":
        return _classic(arm, data), None, np.zeros(len(data), dtype=np.bool_)
    placed = identify(arm, data, fit=("base", "tool"), method="lsq")
    return placed.cell, placed.estimate.covariance, placed.estimate.rejected


def _left_out(
    arm: SerialArm, data: Measurements, method: SensorMethod, rejected: NDArray[np.bool_]
) -> Array:
    """Distance (m,) at each pose of what the others give; not a number where they give nothing."""
    error = np.full(len(data), np.nan)
    for i in range(len(data)):
        others = ~rejected
        others[i] = False
        try:
            cell = _place(arm, data.take(others), method)[0]
        except (TooFewSamplesError, RankDeficientError):
            continue
        error[i] = np.linalg.norm(cell.residual(data.take(np.array([i]))))
    return error


def _classic(arm: SerialArm, data: Measurements) -> CellModel:
    """Thesis eq. 3-14 to 3-19 with the sign of the right block of B corrected."""
    from scipy.optimize import least_squares

    start = linear_start(arm, data, base=True, tool=True)  # refuses where the rank is too low
    T = arm.fk(data.q)
    R, t = T[:, :3, :3], T[:, :3, 3]
    measured = data.position[1:] - data.position[0]
    B = np.zeros((len(measured), 3, 12))
    for axis in range(3):  # the unknowns are the rows of R_base_sensor, then the sphere
        B[:, axis, 3 * axis : 3 * axis + 3] = measured
    B[:, :, 9:] = -(R[1:] - R[0])
    rows, right = B.reshape(-1, 12), (t[1:] - t[0]).ravel()
    upper = np.triu_indices(3)

    def residual(unknowns: Array) -> Array:
        M = unknowns[:9].reshape(3, 3)
        orthogonality = (M @ M.T - np.eye(3))[upper]
        return np.concatenate([rows @ unknowns - right, PENALTY**0.5 * orthogonality])

    first = np.linalg.lstsq(rows, right, rcond=None)[0]
    found = least_squares(residual, first, method="lm", x_scale="jac").x
    M, sphere = found[:9].reshape(3, 3), found[9:]
    if np.linalg.det(M) < 0.0:
        raise ResidualError(
            "the classic method found a reflection in place of a rotation (det -1): the noise is "
            "too large for these poses; turn the flange further, or use the method ml"
        )
    R_sensor_base = frames.nearest_rotation(M).T
    in_base = t + R @ sphere
    shift = np.mean(data.position - in_base @ R_sensor_base.T, axis=0)
    tools = start.T_flange_target.copy()
    tools[0, :3, 3] = sphere
    return CellModel(arm, frames.transform(R_sensor_base, shift), start.targets, tools)


# ---- files of placed sensors: what ``robocal thermal calibrate-sensor`` writes ------------------


Document = dict[str, Any]

KEYS = ("T_sensor_base", "sphere_in_flange_mm", "covariance", "robot", "model_hash")
QUATERNION_TOLERANCE = 1e-3


@dataclass(frozen=True, eq=False)
class PlacedSensor:
    """A sensor file: ``T_sensor_base`` (4, 4), and ``sphere_in_flange`` (3,), m."""

    T_sensor_base: Array
    sphere_in_flange: Array


def write_sensor(path: Path, document: Document) -> None:
    """Write the parts of a sensor's document that place it; the file appears whole or not."""
    write_made(path, document, KEYS, "thermal calibrate-sensor")


def read_sensor(path: Path, arm: SerialArm) -> PlacedSensor:
    """Read a sensor file for ``arm``.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/thermal.md says.
    WrongRobotError
        When it was made for another nominal model.
    """
    top = read_made(path, arm, KEYS, "sensor file", "calibrate the sensor")
    pose = top.below("T_sensor_base")
    quat = np.array(pose.numbers("quat_xyzw", 4))
    if abs(float(np.linalg.norm(quat)) - 1.0) > QUATERNION_TOLERANCE:
        raise InputError("T_sensor_base: the quaternion is not of unit length", file=str(path))
    xyz = np.array(pose.numbers("xyz_mm", 3)) * 1e-3
    sphere = np.array(top.numbers("sphere_in_flange_mm", 3)) * 1e-3
    return PlacedSensor(frames.transform_from_quat(xyz, quat), sphere)
