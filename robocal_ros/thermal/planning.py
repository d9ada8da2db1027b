"""Which poses a measuring cycle should visit: those that say most about the tool where it works.

Candidates are reachable poses that hold the sphere in the sensor's field. Of them those are chosen
that leave the smallest predicted error at the working poses after one cycle (A-optimal on the
prediction; Fedorov 1972): greedily, then by exchange until no exchange helps.
"""

from dataclasses import dataclass, replace
from itertools import permutations

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError, TooFewSamplesError
from robocal_ros.identification.cell import CellModel
from robocal_ros.identification.solve import random_postures
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import SETUP_SIGMA_M
from robocal_ros.thermal.reference import ColdSpots

# ---- pose planning ------------------------------------------------------------------------------


Array = NDArray[np.float64]
Index = NDArray[np.int64]

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

    Attributes
    ----------
    q : (m, n) joints.
    chosen : (m,) their places among the candidates.
    predicted_rms_m : error of the tool at the working poses after one cycle of them.
    random_rms_m : the same of as many candidates drawn at random, median of 50 draws.
    before_rms_m : the same of the prior, without any cycle.
    """

    q: Array
    chosen: tuple[int, ...]
    predicted_rms_m: float
    random_rms_m: float
    before_rms_m: float


def candidate_poses(
    cell: CellModel, field: SensorField, count: int, rng: np.random.Generator
) -> Array:
    """Poses (count, n) that hold the first target in the field, all joints as varied as can be.

    ``cell.T_frame_base`` is T_sensor_base. The stem, from the flange to the sphere, stays behind
    the sphere as the sensor sees it.

    Raises
    ------
    LimitError
        When hardly any pose within the joint limits brings the target into the field.
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


def _limits(arm: SerialArm) -> tuple[Array, Array]:
    margin = np.where(arm.prismatic, 0.1 * MARGIN_RAD, MARGIN_RAD)
    span = np.where(arm.prismatic, 0.5, np.pi)
    lower = np.where(np.isfinite(arm.lower), arm.lower + margin, -span)
    upper = np.where(np.isfinite(arm.upper), arm.upper - margin, span)
    return lower, upper


def _reached(cell: CellModel, goals: Array, rng: np.random.Generator) -> Array:
    """Joints that bring the target to goals (m, 3), from random starts; those that arrive."""
    arm, target = cell.arm, np.zeros(len(goals), dtype=np.int64)
    lower, upper = _limits(arm)
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

    Attributes
    ----------
    rows : (c, 3, d) of the drift and the set-up, whitened by the noise of a displacement.
    prior : (d, d) covariance before the cycle.
    weight : (d, d): the mean squared error at the working poses is trace(weight C).
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

    Raises
    ------
    TooFewSamplesError
        With fewer candidates than poses wanted.
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
    """Choose poses, and put them in the order of the shortest way.

    Raises
    ------
    TooFewSamplesError
        With fewer candidates than poses wanted.
    """
    chosen = choose(design, count)
    draws = [
        design.error(rng.choice(len(candidates), count, replace=False).tolist())
        for _ in range(_DRAWS)
    ]
    plan = PosePlan(
        q=candidates[list(chosen)],
        chosen=chosen,
        predicted_rms_m=design.error(list(chosen)),
        random_rms_m=float(np.median(draws)),
        before_rms_m=design.error([]),
    )
    order = list(shortest_way(plan.q))
    return replace(plan, q=plan.q[order], chosen=tuple(chosen[i] for i in order))


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


# ---- poses for a measuring cycle of one cell, and how much better they are than others ----------


POSES = 6
CANDIDATES = 1000
COLD_VISITS = 3


@dataclass(frozen=True, eq=False)
class PlannedCycle:
    """Planned poses beside a user's own.

    Attributes
    ----------
    own_rms_m : predicted error of the tool after a cycle of the user's own poses; None without.
    candidates, working : how many poses there were to choose from, and to judge at.
    """

    plan: PosePlan
    own_rms_m: float | None
    candidates: int
    working: int


def plan_cycle(
    arm: SerialArm,
    T_sensor_base: Array,
    sphere_in_flange: Array,
    field: SensorField,
    *,
    prior: Array,
    sigma_m: float,
    count: int = POSES,
    candidates: int = CANDIDATES,
    working: Array | None = None,
    own: Array | None = None,
    seed: int = 0,
) -> PlannedCycle:
    """Plan ``count`` poses for a sensor that stands at ``T_sensor_base`` (4, 4).

    Parameters
    ----------
    sphere_in_flange : (3,), m.
    prior : (k, k) covariance of the expected drift, SI; ``sigma_m`` of one visit's coordinate.
    working : (w, n) poses where the tool must be right; None: all over the joint limits.
    own : (o, n) measuring poses to compare with, or None.

    Raises
    ------
    LimitError, TooFewSamplesError
        When the sphere cannot be brought into the field often enough.
    """
    tool = frames.transform(np.eye(3), sphere_in_flange)[None]
    cell = CellModel(arm, T_sensor_base, ("sphere",), tool)
    rng = np.random.default_rng(seed)
    found = candidate_poses(cell, field, candidates, rng)
    where = random_postures(arm) if working is None else working
    every = found if own is None else np.vstack([found, own])
    point = arm.T_flange_tool[:3, 3]
    design = Design.of(cell, every, where, point, prior, sigma_m, COLD_VISITS)
    plan = plan_poses(design.of_first(len(found)), found, count, rng)
    theirs = list(range(len(found), len(every)))
    return PlannedCycle(plan, design.error(theirs) if theirs else None, len(found), len(where))
