# SPDX-License-Identifier: Apache-2.0
"""Where a fixed sensor stands and where the sphere sits on the flange, from one cold visit.

``p_sensor = T_sensor_base T_base_flange(q) p_flange`` over n >= 5 poses that turn the flange about
two axes or more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import (
    LARGEST_RMS_M,
    Verdict,
    errors_document,
    summarise,
    verdict_document,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    LimitError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel, linear_start
from robocal_ros.identification.judged import require_match
from robocal_ros.identification.solve import identify
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import joint_spans
from robocal_ros.kinematics.robots import QUATERNION_TOLERANCE, read_made, write_made
from robocal_ros.thermal.reference import SETUP_SIGMA_M, ColdSpots

if TYPE_CHECKING:
    from robocal_ros.thermal.documents import PlacedSensorDocument

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

    ``T_sensor_base`` (4, 4): the robot's base in the sensor's frame. ``sphere_in_flange`` (3,):
    centre of the sphere in the flange frame, m. ``covariance``: (9, 9), SI, of ``NAMES``: shift of
    the base and turn about it (sensor axes), and the sphere (flange axes); None for the classic
    method, which has no noise model. ``residual`` (m, 3): predicted minus measured centre, sensor
    axes, m. ``left_out`` (k,): distance at each pose that fits of a calibration from the others, m.
    ``rejected``: names of the samples that do not fit the others.
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
    without = f"; not fitting: {', '.join(found.rejected)}" if found.rejected else ""
    if rms_m > LARGEST_RMS_M:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words}, more than any robot's static error ({LARGEST_RMS_M * 1e3:.0f} mm): check "
            f"robot file, units, joint signs and which sphere was measured{without}",
        )
    return Verdict(Code.ACCEPT, words + without)


def calibrate_sensor(
    arm: SerialArm, data: Measurements, method: SensorMethod = "ml"
) -> SensorCalibration:
    """Place sensor and sphere with the cold model ``arm``.

    ``ml`` is robust maximum likelihood over (R, t, p) on the manifold, weighted by the samples'
    sigma, from the linear start; ``classic`` solves the pose differences for nine free elements
    of R and p with an orthogonality penalty, then t as the mean over the poses.

    Raises `TooFewSamplesError` or `RankDeficientError` when the poses cannot place them; the
    message names the missing motion; `InputError` or `ResidualError` when the data miss the arm by
    a mistake that can be named, or R comes out reflected.
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
    cell, covariance, rejected = place_sensor(arm, data, method)
    return SensorCalibration(
        method=method,
        T_sensor_base=cell.T_frame_base,
        sphere_in_flange=cell.T_flange_target[0, :3, 3],
        covariance=covariance,
        residual=cell.residual(data),
        left_out=_left_out(arm, data.take(~rejected), method),
        rejected=tuple(data.sample[i] for i in np.flatnonzero(rejected)),
    )


def place_sensor(
    arm: SerialArm, data: Measurements, method: SensorMethod
) -> tuple[CellModel, Array | None, NDArray[np.bool_]]:
    """Sensor and sphere as a cell, their covariance, and which samples (m,) do not fit."""
    if method == "classic":
        return _classic(arm, data), None, np.zeros(len(data), dtype=np.bool_)
    placed = identify(arm, data, fit=("base", "tool"), method="lsq")
    return placed.cell, placed.estimate.covariance, placed.estimate.rejected


def _left_out(arm: SerialArm, data: Measurements, method: SensorMethod) -> Array:
    """Distance (m,) at each pose of what the others give; not a number where they give nothing."""
    error = np.full(len(data), np.nan)
    for i in range(len(data)):
        others = np.arange(len(data)) != i
        try:
            cell = place_sensor(arm, data.take(others), method)[0]
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


KEYS = ("T_sensor_base", "sphere_in_flange_mm", "covariance", "robot", "model_hash")


@dataclass(frozen=True, eq=False)
class PlacedSensor:
    """A sensor file: ``T_sensor_base`` (4, 4), and ``sphere_in_flange`` (3,), m."""

    T_sensor_base: Array
    sphere_in_flange: Array


def write_sensor(path: Path, document: Mapping[str, Any]) -> None:
    """Write the parts of a sensor's document that place it; the file appears whole or not."""
    write_made(path, document, KEYS, "thermal calibrate-sensor")


def read_sensor(path: Path, arm: SerialArm) -> PlacedSensor:
    """Read a sensor file for ``arm``.

    Raises `InputError`, naming file and key, when it is not as docs/thermal.md says;
    `WrongRobotError` when it was made for another nominal model.
    """
    top = read_made(path, arm, KEYS, "sensor file", "calibrate the sensor")
    pose = top.below("T_sensor_base")
    quat = np.array(pose.numbers("quat_xyzw", 4))
    if abs(float(np.linalg.norm(quat)) - 1.0) > QUATERNION_TOLERANCE:
        raise InputError("T_sensor_base: the quaternion is not of unit length", file=str(path))
    pose.numbers("xyz_mm", 3)
    top.numbers("sphere_in_flange_mm", 3)
    return placed_of(top.values)


def placed_spots(arm: SerialArm, path: Path, cold: Measurements) -> ColdSpots:
    """Each pose of a cold visit once, as a sensor file places sensor and sphere.

    Raises as `read_sensor`; `ResidualError` when half of the poses lie further off than any robot's
    static error: a drift would be told in the axes of a sensor that stands elsewhere.
    """
    sensor = read_sensor(path, arm)
    tool = frames.transform(np.eye(3), sensor.sphere_in_flange)[None]
    spots = ColdSpots.of(CellModel(arm, sensor.T_sensor_base, cold.targets, tool), cold)
    off_m = float(np.median(np.linalg.norm(spots.error, axis=1)))  # a wrong visit does no harm
    if off_m > LARGEST_RMS_M:
        raise ResidualError(
            f"the cold visits lie {off_m * 1e3:.1f} mm from where {path} places them, in the "
            f"median, more than any robot's static error ({LARGEST_RMS_M * 1e3:.0f} mm): calibrate "
            "the sensor anew where it, the sphere or the base was moved since; else check robot "
            "file and units"
        )
    return spots


def sensor_document(found: SensorCalibration, arm: SerialArm) -> "PlacedSensorDocument":
    """A placed sensor: where, how well, and whether to trust it.

    ``covariance`` is in SI, of ``covariance_of``.
    """
    covariance, sigma = found.covariance, found.sigma
    to_display = np.array([1e3 if name.endswith("_mm") else np.degrees(1.0) for name in NAMES])
    fitted = np.linalg.norm(found.residual, axis=1)
    judged = found.left_out[np.isfinite(found.left_out)]
    return {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "method": found.method,
        "T_sensor_base": transform_document(found.T_sensor_base),
        "sphere_in_flange_mm": (found.sphere_in_flange * 1e3).tolist(),
        "covariance_of": list(NAMES),
        "covariance": None if covariance is None else covariance.tolist(),
        "sigma": None
        if sigma is None
        else dict(zip(NAMES, (sigma * to_display).tolist(), strict=True)),
        "residual": errors_document(summarise(fitted)),
        "left_out": errors_document(summarise(judged)) if len(judged) else None,
        "samples": len(fitted),
        "rejected": list(found.rejected),
        "verdict": verdict_document(sensor_verdict(found)),
    }


def placed_of(document: Mapping[str, Any]) -> PlacedSensor:
    """Read it from what `sensor_document` gave."""
    pose = document["T_sensor_base"]
    xyz = np.array(pose["xyz_mm"]) * 1e-3
    T_sensor_base = frames.transform_from_quat(xyz, pose["quat_xyzw"])
    return PlacedSensor(T_sensor_base, np.array(document["sphere_in_flange_mm"]) * 1e-3)


MARGIN_RAD = float(np.radians(5.0))  # from a joint's limit (prismatic: m, a tenth of it)
CLEAR_RAD = float(np.radians(60.0))  # between the stem and the way from sphere to sensor
_REACHED_M = 1e-5
_STEPS = 40
_BATCH = 400
_ROUNDS = 60
_LONGEST_ORDER = 8
_DRAWS = 50
_STARTS = 9


@dataclass(frozen=True)
class SensorField:
    """The volume in which the sensor measures: a frustum along its z axis.

    ``width_m``, ``height_m``: along x and y at ``at_m``; ``near_m``, ``far_m``: along z.
    """

    width_m: float = 0.57
    height_m: float = 0.43
    at_m: float = 0.7
    near_m: float = 0.55
    far_m: float = 0.85

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which points (m, 3) in the sensor's frame lie inside."""
        x, y, z = points.T
        scale = 0.5 * z / self.at_m
        inside = (np.abs(x) <= self.width_m * scale) & (np.abs(y) <= self.height_m * scale)
        return np.asarray(inside & (z >= self.near_m) & (z <= self.far_m))

    def draw(self, count: int, rng: np.random.Generator) -> Array:
        """Points (count, 3) throughout the field."""
        z = rng.uniform(self.near_m, self.far_m, count)
        x, y = 0.5 * rng.uniform(-1.0, 1.0, (2, count)) * z / self.at_m
        return np.column_stack([self.width_m * x, self.height_m * y, z])


@dataclass(frozen=True, eq=False)
class PosePlan:
    """Chosen poses in the order of the shortest way.

    ``q`` (m, n): joints. ``predicted_rms_m``: error of the tool at the working poses after one
    cycle of them. ``random_rms_m``: the same of as many candidates drawn at random, median of 50
    draws. ``before_rms_m``: the same of the prior, without any cycle. ``own_rms_m``: after a cycle
    of a user's own poses; None without.
    """

    q: Array
    predicted_rms_m: float
    random_rms_m: float
    before_rms_m: float
    own_rms_m: float | None = None


def candidate_poses(
    cell: CellModel, field: SensorField, count: int, rng: np.random.Generator
) -> Array:
    """Poses (count, n) that hold the first target in the field, all joints as varied as can be.

    ``cell.T_frame_base`` is T_sensor_base. The stem, from the flange to the sphere, stays behind
    the sphere as the sensor sees it.

    Raises `LimitError` when hardly any pose within the joint limits brings the target into the
    field.
    """
    found: list[Array] = []
    have = 0
    for _ in range(_ROUNDS):
        q = _reached(cell, field.draw(_BATCH, rng), rng)
        q = q[_seen(cell, field, q)]
        found.append(q)
        have += len(q)
        if have >= count:
            return np.vstack(found)[:count]
    raise LimitError(
        f"{have} of {_ROUNDS * _BATCH} tries bring the sphere into the sensor's field within the "
        f"joint limits, {count} are wanted: check where the sensor stands, its field, and the "
        "sphere's mounting"
    )


def _reached(cell: CellModel, goals: Array, rng: np.random.Generator) -> Array:
    """Joints that bring the target to goals (m, 3), from random starts; those that arrive."""
    arm, target = cell.arm, np.zeros(len(goals), dtype=np.int64)
    margin = np.where(arm.prismatic, 0.1 * MARGIN_RAD, MARGIN_RAD)
    lower, upper = joint_spans(arm)
    lower, upper = lower + margin * np.isfinite(arm.lower), upper - margin * np.isfinite(arm.upper)
    q = rng.uniform(lower, upper, (len(goals), arm.n))
    lever = cell.T_flange_target[0, :3, 3]
    for _ in range(_STEPS):
        T = arm.fk(q)
        away = goals - cell.predict(q, target)[:, :3, 3]
        J = arm.jacobian(q)
        arms = np.einsum("mij,j->mi", T[:, :3, :3], lever)[:, None, :]
        moved = J[:, :3] + np.swapaxes(np.cross(np.swapaxes(J[:, 3:], 1, 2), arms), 1, 2)
        rows = cell.T_frame_base[:3, :3] @ moved
        damped = rows @ np.swapaxes(rows, 1, 2) + 1e-6 * np.eye(3)
        step = np.swapaxes(rows, 1, 2) @ np.linalg.solve(damped, away[..., None])
        q = np.clip(q + np.clip(step[..., 0], -0.3, 0.3), lower, upper)
    away = goals - cell.predict(q, target)[:, :3, 3]
    return np.asarray(q[np.linalg.norm(away, axis=1) < _REACHED_M])


def _seen(cell: CellModel, field: SensorField, q: Array) -> NDArray[np.bool_]:
    """Which poses show the sphere: inside the field, and not from behind its stem."""
    target = np.zeros(len(q), dtype=np.int64)
    sphere = cell.predict(q, target)[:, :3, 3]
    flange = (cell.T_frame_base @ cell.arm.fk(q))[:, :3, 3]
    stem = flange - sphere
    length = np.linalg.norm(stem, axis=1) * np.linalg.norm(sphere, axis=1)
    cosine = np.einsum("mi,mi->m", stem, -sphere) / np.maximum(length, 1e-12)
    return np.asarray(field.holds(sphere) & (cosine < np.cos(CLEAR_RAD)))


@dataclass(frozen=True, eq=False)
class Design:
    """What each candidate measures, and what matters.

    ``rows`` (c, 3, d): of the drift and the set-up, whitened by the noise of a displacement.
    ``prior`` (d, d): covariance before the cycle.
    ``weight`` (d, d): the mean squared error at the working poses is trace(weight C).
    """

    rows: Array
    prior: Array
    weight: Array

    @classmethod
    def of(
        cls, cell: CellModel, candidates: Array, working: Array, tool: Array, prior: Array,
        sigma_m: float, visits: int,
    ) -> "Design":  # fmt: skip
        """Design for candidates (c, n), working poses (w, n) and a tool point (3,) of the flange.

        ``sigma_m``: of one visit; ``visits``: how often each pose is visited cold.
        """
        none = np.zeros(len(candidates), dtype=np.int64)
        empty = np.zeros((len(candidates), 3))
        spots = ColdSpots(cell, candidates, none, empty, none + visits, np.arange(len(none)))
        rows = np.concatenate(spots.rows(candidates, none), axis=2)
        rows = rows / (sigma_m * np.sqrt(1.0 + 1.0 / visits))
        size, k = rows.shape[2], len(prior)
        whole = SETUP_SIGMA_M**2 * np.eye(size)
        whole[:k, :k] = prior
        told = cell.arm.parameter_jacobian(working, tool)[:, :3]
        weight = np.zeros((size, size))
        weight[:k, :k] = np.einsum("wik,wil->kl", told, told) / len(working)
        return cls(rows, whole, weight)

    def of_first(self, count: int) -> "Design":
        """The design with only the first candidates."""
        return replace(self, rows=self.rows[:count])

    def covariance(self, chosen: list[int]) -> Array:
        """Covariance (d, d) after one visit of each chosen candidate."""
        if not chosen:
            return self.prior
        H = self.rows[chosen].reshape(-1, self.rows.shape[2])
        S = H @ self.prior @ H.T + np.eye(len(H))
        return np.asarray(self.prior - self.prior @ H.T @ np.linalg.solve(S, H @ self.prior))

    def error(self, chosen: list[int]) -> float:
        """Rms error, m, of the tool at the working poses after a cycle of these."""
        return float(np.sqrt(np.trace(self.weight @ self.covariance(chosen))))

    def gains(self, covariance: Array) -> Array:
        """By how much (c,) one more visit of each candidate lowers the mean squared error."""
        G = self.rows @ covariance
        S = G @ np.swapaxes(self.rows, 1, 2) + np.eye(3)
        told = G @ self.weight @ np.swapaxes(G, 1, 2)
        return np.asarray(np.trace(np.linalg.solve(S, told), axis1=1, axis2=2))


def choose(design: Design, count: int) -> tuple[int, ...]:
    """Candidates that leave the smallest error: exchanged from several starts, one of them greedy.

    Raises `TooFewSamplesError` with fewer candidates than poses wanted.
    """
    if len(design.rows) < count:
        raise TooFewSamplesError(f"{len(design.rows)} candidates for {count} poses: give more")
    greedy: list[int] = []
    for _ in range(count):
        greedy.append(_best(design, greedy))
    rng = np.random.default_rng(0)
    starts = [rng.choice(len(design.rows), count, replace=False).tolist() for _ in range(_STARTS)]
    found = [_exchanged(design, start) for start in (greedy, *starts)]
    errors = [design.error(chosen) for chosen in found]
    return tuple(found[int(np.argmin(errors))])


def _exchanged(design: Design, chosen: list[int]) -> list[int]:
    """Replace one after the other by the best candidate until none helps any more."""
    error, untouched = design.error(chosen), 0
    while untouched < len(chosen):
        _, *others = chosen
        trial = [*others, _best(design, others)]
        better = design.error(trial)
        if better < error * (1.0 - 1e-12):
            chosen, error, untouched = trial, better, 0
        else:
            chosen, untouched = [*others, chosen[0]], untouched + 1
    return chosen


def _best(design: Design, chosen: list[int]) -> int:
    gains = design.gains(design.covariance(chosen))
    gains[chosen] = -np.inf
    return int(np.argmax(gains))


def plan_poses(design: Design, candidates: Array, count: int, rng: np.random.Generator) -> PosePlan:
    """Choose poses, and put them in the order of the shortest way."""
    chosen = list(choose(design, count))
    draws = [
        design.error(rng.choice(len(candidates), count, replace=False).tolist())
        for _ in range(_DRAWS)
    ]
    q = candidates[chosen]
    return PosePlan(
        q=q[list(shortest_way(q))],
        predicted_rms_m=design.error(chosen),
        random_rms_m=float(np.median(draws)),
        before_rms_m=design.error([]),
    )


def shortest_way(q: Array) -> tuple[int, ...]:
    """Order of poses (m, n) with the least travel of the busiest joint: exact up to eight."""
    travel = np.max(np.abs(q[:, None] - q), axis=2)
    if len(q) > _LONGEST_ORDER:
        order, left = [0], set(range(1, len(q)))
        while left:
            order.append(min(left, key=lambda i: travel[order[-1], i]))
            left.remove(order[-1])
        return tuple(order)
    orders = np.array(list(permutations(range(len(q)))))
    way = travel[orders[:, :-1], orders[:, 1:]].sum(axis=1)
    return tuple(orders[int(np.argmin(way))].tolist())


POSES = 6
CANDIDATES = 1000
COLD_VISITS = 3


def plan_cycle(
    arm: SerialArm,
    sensor: PlacedSensor,
    field: SensorField,
    *,
    prior: Array,
    sigma_m: float,
    working: Array,
    tip: Array | None = None,
    count: int = POSES,
    candidates: int = CANDIDATES,
    own: Array | None = None,
    seed: int = 0,
) -> PosePlan:
    """Plan ``count`` poses for a placed sensor.

    ``prior`` (k, k): covariance of the expected drift, SI; ``sigma_m`` of one visit's coordinate.
    ``working`` (w, n): poses where the tool must be right. ``tip`` (3,): its tip on the flange, m;
    None: the robot file's. ``own`` (o, n): measuring poses to compare with, or None.
    """
    tool = frames.transform(np.eye(3), sensor.sphere_in_flange)[None]
    cell = CellModel(arm, sensor.T_sensor_base, ("sphere",), tool)
    rng = np.random.default_rng(seed)
    found = candidate_poses(cell, field, candidates, rng)
    every = found if own is None else np.vstack([found, own])
    point = arm.T_flange_tool[:3, 3] if tip is None else tip
    design = Design.of(cell, every, working, point, prior, sigma_m, COLD_VISITS)
    plan = plan_poses(design.of_first(len(found)), found, count, rng)
    theirs = list(range(len(found), len(every)))
    return replace(plan, own_rms_m=design.error(theirs) if theirs else None)
