# SPDX-License-Identifier: Apache-2.0
"""The cold reference: base, targets and static errors, from one visit of the measuring poses."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import FEWEST_GROUPS, LARGEST_RMS_M, pose_groups, summarise
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, ResidualError
from robocal_ros.ground.frames import Array, Document, Index
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import CellModel, make_layout
from robocal_ros.identification.judged import require_match
from robocal_ros.identification.solve import identify
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of, model_document
from robocal_ros.kinematics.tables import measurements_of, read_table

SAME_VISIT_RAD = float(np.radians(0.5))
FEWEST_TO_JUDGE = 3  # visits of a spot, so that the others outvote a wrong one
# Of a joint that came from another side: as an IRB 1600's (docs/simulation.md).
LOST_MOTION_RAD = 7e-5
CONTRADICTION = 8.0  # median distances from the spot's median; noise alone stays below 5


@dataclass(frozen=True, eq=False)
class ColdSpots:
    """Each pose and target of a cold visit once.

    ``cell``: the cold model with base and targets. ``q`` (s, n): mean joints. ``target`` (s,):
    index into the cell's targets. ``error`` (s, 3): mean of predicted minus measured position, m;
    the arm's static errors. ``visits`` (s,): how many cold measurements went into it. ``first``
    (s,): the first of them. ``rejected``: names of cold measurements that other visits of the same
    spot contradict. ``on_flange``: whether the sensor is on the flange: see `SpheresInCell`.
    ``side`` (s, n): which way each joint went last, mean of the visits; None: not known.
    """

    cell: CellModel
    q: Array
    target: Index
    error: Array
    visits: Index
    first: Index
    rejected: tuple[str, ...] = ()
    on_flange: bool = False
    side: Array | None = None

    @classmethod
    def of(cls, cell: CellModel, data: Measurements, *, on_flange: bool = False) -> "ColdSpots":
        """Average the visits of each pose and target, without those that others contradict."""
        target = data.target_index(cell.targets)
        _, spot = np.unique(pose_groups(data.q) * len(cell.targets) + target, return_inverse=True)
        error, count = cell.residual(data), np.bincount(spot)
        median = np.array([np.median(error[spot == s], axis=0) for s in range(len(count))])
        away = np.linalg.norm(error - median[spot], axis=1)
        judged, keep = count[spot] >= FEWEST_TO_JUDGE, np.ones(len(error), dtype=np.bool_)
        if np.any(judged):  # of visits that all contradict each other the nearer half is kept
            own = np.array([np.median(away[spot == s]) for s in range(len(count))])[spot]
            far = np.maximum(CONTRADICTION * np.median(away[judged]), own)
            keep = ~judged | (away <= far)
        visits = np.bincount(spot[keep])
        mean = np.zeros((len(visits), len(data)))
        mean[spot[keep], np.flatnonzero(keep)] = 1.0 / visits[spot[keep]]
        first = np.array([int(np.flatnonzero(spot == s)[0]) for s in range(len(visits))])
        rejected = tuple(data.sample[i] for i in np.flatnonzero(~keep))
        q, static = mean @ data.q, mean @ error
        side = None if data.side is None else mean @ data.side
        return cls(cell, q, target[first], static, visits, first, rejected, on_flange, side)

    @cached_property
    def pose(self) -> Index:
        """Number (s,) of each spot's pose, from 1 in the order of the cold visit."""
        group = pose_groups(self.q)
        first = [int(self.first[group == g].min()) for g in range(int(group.max()) + 1)]
        return np.asarray(1 + np.argsort(np.argsort(first))[group], dtype=np.int64)

    @property
    def poses(self) -> int:
        """How many poses were visited cold."""
        return int(self.pose.max())

    def visited(self, q: Array) -> tuple[int, ...]:
        """Numbers of the cold poses, from 1 in their order, that joint readings (m, n) are at."""
        if not len(q):
            return ()
        away = np.max(np.abs(q[:, None] - self.q), axis=2)
        near = np.argmin(away, axis=1)[np.min(away, axis=1) < SAME_VISIT_RAD]
        return tuple(np.unique(self.pose[near]).tolist())

    def common(self, warm: Measurements) -> Measurements:
        """Those of the measurements that `match` finds a spot for."""
        return warm.take(_again(warm.q, warm.target, self.q, self.names))

    @property
    def names(self) -> tuple[str, ...]:
        """Name (s) of each spot's target."""
        return tuple(self.cell.targets[i] for i in self.target)

    def match(self, warm: Measurements) -> Index:
        """The spot (m,) that each warm measurement visits again: all joints within 0.5 deg.

        Raises `InputError` when a measurement has no cold counterpart.
        """
        target = warm.target_index(self.cell.targets)
        away = np.max(np.abs(warm.q[:, None] - self.q), axis=2)
        away[target[:, None] != self.target] = np.inf
        spot = np.argmin(away, axis=1)
        lost = np.flatnonzero(away[np.arange(len(warm)), spot] >= SAME_VISIT_RAD)
        if len(lost):
            i = int(lost[0])
            raise InputError(
                f"sample {warm.sample[i]} of target '{warm.target[i]}' was not measured in the "
                "cold reference: visit the reference poses, or capture a new reference"
            )
        return np.asarray(spot, dtype=np.int64)

    def average(self, warm: Measurements, sigma_m: float) -> Measurements:
        """Average the visits of each spot; ``sigma`` is of the mean.

        It holds the backlash of joints that came from another side than when cold.

        ``sigma_m``: of one visit, where the measurements have none of their own.
        """
        spot, place, count = np.unique(self.match(warm), return_inverse=True, return_counts=True)
        mean = np.zeros((len(count), len(warm)))
        mean[place, np.arange(len(warm))] = 1.0 / count[place]
        sigma = np.full(len(warm), sigma_m) if warm.sigma is None else warm.sigma
        side = None if warm.side is None else mean @ warm.side
        lag_m = LOST_MOTION_RAD * np.linalg.norm(
            self.other_side(spot, side) * self._lever[spot], axis=1
        )
        rows = [np.flatnonzero(place == i) for i in range(len(count))]
        return Measurements(
            q=mean @ warm.q,
            position=mean @ warm.position,
            target=tuple(warm.target[row[0]] for row in rows),
            sample=tuple("+".join(warm.sample[i] for i in row) for row in rows),
            sigma=np.hypot(np.sqrt(mean**2 @ sigma**2), lag_m),
            side=side,
        )

    def other_side(self, spot: Index, side: Array | None) -> Array:
        """By what share (m, n) of its backlash each joint is not as it was at spots (m,) when cold.

        ``side`` (m, n): which way it went last; a joint of which that is not known counts as 0.
        """
        if side is None or self.side is None:
            return np.zeros((len(spot), self.cell.arm.n))
        cold = self.side[spot]
        return np.where((side == 0.0) | (cold == 0.0), 0.0, 0.5 * np.abs(side - cold))

    @cached_property
    def _lever(self) -> Array:
        """How far (s, n) one coordinate of a spot moves with each joint, rms of three, m."""
        J, own = self.cell.arm.jacobian(self.q), self.cell.T_flange_target[self.target, :3, 3]
        arm = np.einsum("mij,mj->mi", self.cell.arm.fk(self.q)[:, :3, :3], own)
        moved = J[:, :3] + np.cross(J[:, 3:], arm[:, :, None], axis=1)
        return np.asarray(np.linalg.norm(moved, axis=1) / np.sqrt(3.0))

    def drift(self, warm: Measurements) -> Array:
        """Displacement (m, 3) of the targets since the cold visit, m, measuring axes.

        The joints of both visits are taken as measured: that they differ a little is no drift.
        """
        return np.asarray(self.error[self.match(warm)] - self.cell.residual(warm))

    def rows(self, q: Array, target: Index) -> tuple[Array, Array]:
        """Displacement by the arm's parameters (m, 3, k) and by a shifted set-up (m, 3, 6).

        The set-up's six: sensor (measuring axes), and target on the flange (flange axes).
        """
        arm = self.cell.arm
        layout = make_layout(
            arm,
            self.cell.targets,
            geometry=arm.parameters.names,
            base=False,
            tool=False,
            orientation=False,
        )
        T, J = layout.jacobian(self.cell, np.ascontiguousarray(q), target)
        T_target_flange = np.linalg.inv(self.cell.T_flange_target[:, :3, :3])
        own = T[:, :3, :3] @ T_target_flange[target]
        return J, np.concatenate([np.broadcast_to(np.eye(3), own.shape), own], axis=2)


def _again(
    q: Array, target: Sequence[str], spot_q: Array, spot_target: Sequence[str]
) -> NDArray[np.bool_]:
    """Which targets (m) at joints (m, n) are spots (s) again: all joints within 0.5 deg."""
    away = np.max(np.abs(q[:, None] - spot_q), axis=2)
    same = np.array(target, dtype=np.str_)[:, None] == np.array(spot_target, dtype=np.str_)
    return np.asarray(np.any(same & (away < SAME_VISIT_RAD), axis=1))


@dataclass(frozen=True, eq=False)
class SpheresInCell:
    """What the sensor of a measuring robot saw of spheres that are fixed in the cell, when cold.

    The point of the flange at which a sphere was seen from a pose stands for a target there, one
    for each pose and sphere: while the arm is cold it comes to the sphere's centre, and where it
    comes to later tells the drift, as of a sphere on the flange. The measuring frame is the base.

    ``T_flange_sensor`` (4, 4). ``sphere``, ``centre``: of each target of the cell, its name, and
    (t, 3) in base, m. ``q`` (t, n): joints of the cold visits. ``frame``: the sensor's.
    """

    T_flange_sensor: Array
    sphere: tuple[str, ...]
    centre: Array
    q: Array
    frame: str = ""

    def placed(self, cell: CellModel, data: Measurements) -> Measurements:
        """Centres (m, 3) in the sensor, as places of the cell's targets in base.

        Raises `InputError` when a sphere was not seen from its pose when cold.
        """
        spheres = tuple(dict.fromkeys(self.sphere))
        own = np.array([spheres.index(name) for name in self.sphere])
        away = np.max(np.abs(data.q[:, None] - self.q), axis=2)
        away[data.target_index(spheres)[:, None] != own] = np.inf
        spot = np.argmin(away, axis=1)
        lost = np.flatnonzero(away[np.arange(len(data)), spot] >= SAME_VISIT_RAD)
        if len(lost):
            i = int(lost[0])
            raise InputError(
                f"sample {data.sample[i]}: sphere '{data.target[i]}' was not seen from this pose "
                "in the cold reference: visit the reference poses, or capture a new reference"
            )
        seen = frames.apply(self.T_flange_sensor, data.position)
        short = cell.T_flange_target[spot, :3, 3] - seen
        R = cell.arm.fk(data.q)[:, :3, :3]
        return replace(
            data,
            position=self.centre[spot] + np.einsum("mij,mj->mi", R, short),
            target=tuple(cell.targets[i] for i in spot),
        )

    def seen(self, cell: CellModel, data: Measurements) -> Measurements:
        """The centres in the sensor again, of what `placed` made."""
        spot = data.target_index(cell.targets)
        R = cell.arm.fk(data.q)[:, :3, :3]
        short = np.einsum("mji,mj->mi", R, data.position - self.centre[spot])
        position = cell.T_flange_target[spot, :3, 3] - short
        T_sensor_flange = frames.invert(self.T_flange_sensor)
        return replace(
            data,
            position=frames.apply(T_sensor_flange, position),
            target=tuple(self.sphere[i] for i in spot),
        )


@dataclass(frozen=True)
class ColdReference:
    """Cold visit of the measuring poses.

    ``cell``: the cold model with base and targets as fitted to the cold visit. ``data``: the cold
    measurements. ``rejected``: names of those that did not fit the others. ``temperature`` (n,): of
    the motors, degrees Celsius; None where they were not read. ``fixed`` (n, 3): centres of a
    sphere fixed in the cell, measured at the same visit, m; n may be 0. ``spheres``: of a measuring
    robot, whose ``data`` are placed; None of a fixed sensor.
    """

    cell: CellModel
    data: Measurements
    rejected: tuple[str, ...] = ()
    temperature: Array | None = None
    fixed: Array = field(default_factory=lambda: np.zeros((0, 3)))
    spheres: SpheresInCell | None = None

    def placed(self, data: Measurements) -> Measurements:
        """Measurements as places of the cell's targets: they are, but of a measuring robot."""
        return data if self.spheres is None else self.spheres.placed(self.cell, data)

    def knows(self, q: Array, target: Sequence[str]) -> NDArray[np.bool_]:
        """Which targets (m), as the sensor names them, were measured cold at joints (m, n)."""
        spots, spheres = self.spots, self.spheres
        if spheres is not None:
            return _again(q, target, spheres.q, spheres.sphere)
        return _again(q, target, spots.q, spots.names)

    @property
    def used(self) -> Measurements:
        """The measurements that placed base and targets."""
        return self.data.take(~np.isin(self.data.sample, self.rejected))

    @cached_property
    def spots(self) -> ColdSpots:
        """Each pose and target of the visit once."""
        return ColdSpots.of(self.cell, self.data, on_flange=self.spheres is not None)

    @cached_property
    def static_error_m(self) -> float:
        """Of a measuring robot: rms distance, m, by which the cold arm misses what it will see.

        By how it misses the spheres of the cold visit: what its static errors and the mounting
        leave, over what mounting and centres leave free, and as much more as unseen poses miss a
        regression by that was made at others (Breiman and Freedman 1983, random design).
        """
        if self.spheres is None:
            raise ValueError("a sensor that stands still has no spheres in the cell")
        seen = frames.apply(self.cell.arm.fk(self.spheres.q), self.cell.T_flange_target[:, :3, 3])
        miss = seen - self.spheres.centre
        unknowns = 6 + 3 * len(set(self.spheres.sphere))
        free = miss.size - unknowns  # 6 at the fewest: `hand_eye_start` needs so many
        unseen = 1.0 + unknowns / (free - 1)
        return float(np.sqrt(3.0 * np.sum(miss**2) / free * unseen))


def capture_reference(arm: SerialArm, data: Measurements) -> ColdReference:
    """Place base and targets from a cold visit with the cold model ``arm``.

    Samples that do not fit the others do not place them, and are named in ``rejected``; a warm
    visit of such a pose will not fit either.

    Raises `TooFewSamplesError` or `RankDeficientError` when the visit cannot place them;
    `InputError` or `ResidualError` when the visit misses the arm by a mistake that can be named, or
    by more than 5 mm rms.
    """
    require_match(arm, data, base=True, tool=True)
    placed = identify(arm, data, fit=("base", "tool"), method="lsq")
    reference = ColdReference(placed.cell, data, placed.rejected)
    rms = summarise(placed.cell.residual(reference.used)).rms_m
    if rms > LARGEST_RMS_M:
        raise ResidualError(
            f"the cold visit misses the model by {rms * 1e3:.1f} mm rms, more than any robot's "
            f"static error ({LARGEST_RMS_M * 1e3:.0f} mm): check robot file, units, joint signs "
            "and target names"
        )
    return reference


COMMISSIONED = "commissioned_mdh"  # of a reference's model: the arm without any drift


def holds_drift(model: Document | None) -> bool:
    """Whether a model document holds a drift since a cold reference; None: the nominal model."""
    return "reference_mdh" in (model or {})


def commissioned_of(reference: Document, nominal: SerialArm) -> SerialArm:
    """The arm without any drift, also where the reference was captured with the robot warm."""
    return arm_of(reference | {"mdh": reference.get(COMMISSIONED, reference["mdh"])}, nominal)


def reference_document(reference: ColdReference) -> Document:
    """A cold reference in full precision, SI; ``reference_of`` reads it back to the last bit."""
    cell, data = reference.cell, reference.data
    model = model_document(cell.arm)
    temperature = reference.temperature
    document = {key: model[key] for key in ("mdh", "functions", "load") if key in model} | {
        "T_frame_base": cell.T_frame_base.tolist(),
        "targets": list(cell.targets),
        "T_flange_target": cell.T_flange_target.tolist(),
        "q": data.q.tolist(),
        "position": data.position.tolist(),
        "target": list(data.target),
        "sample": list(data.sample),
        "stamp_ns": None if data.stamp_ns is None else data.stamp_ns.tolist(),
        "side": None if data.side is None else data.side.tolist(),
        "fixed": reference.fixed.tolist(),
        "temperature": None if temperature is None else temperature.tolist(),
    }
    if (spheres := reference.spheres) is not None:
        document |= {
            "T_flange_sensor": spheres.T_flange_sensor.tolist(),
            "sphere": list(spheres.sphere),
            "centre": spheres.centre.tolist(),
            "spot_q": spheres.q.tolist(),
            "sensor_frame": spheres.frame,
        }
    return document


def reference_of(document: Document, nominal: SerialArm) -> ColdReference:
    """Read a cold reference back from its document."""
    cell = CellModel(
        arm_of(document, nominal),
        np.array(document["T_frame_base"]),
        tuple(document["targets"]),
        np.array(document["T_flange_target"]),
    )
    stamps, side = document["stamp_ns"], document.get("side")  # older ones have no side
    data = Measurements(
        q=np.array(document["q"]),
        position=np.array(document["position"]),
        target=tuple(document["target"]),
        sample=tuple(document["sample"]),
        stamp_ns=None if stamps is None else np.array(stamps, dtype=np.int64),
        side=None if side is None else np.array(side),
    )
    warmth, spheres = document["temperature"], None
    if "T_flange_sensor" in document:
        spheres = SpheresInCell(
            np.array(document["T_flange_sensor"]),
            tuple(document["sphere"]),
            np.array(document["centre"]),
            np.array(document["spot_q"]),
            document["sensor_frame"],
        )
    return ColdReference(
        cell,
        data,
        fixed=np.array(document["fixed"]).reshape(-1, 3),
        temperature=None if warmth is None else np.array(warmth),
        spheres=spheres,
    )


ONLY_CYCLE = "1"


@dataclass(frozen=True)
class Visits:
    """Measurements at named poses.

    ``pose`` (m,): name of the pose, which cold and warm visits share.
    ``cycle`` (m,): name of the cycle; that of `read_visits` where the table has none.
    """

    data: Measurements
    pose: tuple[str, ...]
    cycle: tuple[str, ...]

    @property
    def cycles(self) -> tuple[str, ...]:
        """The cycles in order of first appearance."""
        return tuple(dict.fromkeys(self.cycle))

    def take(self, rows: NDArray[np.bool_]) -> "Visits":
        """Return the visits of a mask (m,)."""
        index = np.flatnonzero(rows)
        return replace(
            self,
            data=self.data.take(index),
            pose=tuple(self.pose[i] for i in index),
            cycle=tuple(self.cycle[i] for i in index),
        )

    def of_cycle(self, name: str) -> "Visits":
        """Return the visits of one cycle."""
        return self.take(np.array([cycle == name for cycle in self.cycle], dtype=np.bool_))


def require_cold_counterparts(cold: Visits, warm: Visits, file: str | None = None) -> None:
    """Refuse warm visits of a pose that was not visited cold, or at other joints.

    Raises `InputError`, naming the sample, ``file``, and what differs.
    """
    known = {pose: cold.data.q[i] for i, pose in enumerate(cold.pose)}
    for i, pose in enumerate(warm.pose):
        if pose not in known:
            more = f" and {len(known) - 6} more" if len(known) > 6 else ""
            raise InputError(
                f"sample {warm.data.sample[i]}: pose '{pose}' was not visited cold (those are "
                f"{', '.join(list(known)[:6])}{more})",
                file=file,
                column="pose",
            )
        away = float(np.max(np.abs(warm.data.q[i] - known[pose])))
        if away >= SAME_VISIT_RAD:
            raise InputError(
                f"sample {warm.data.sample[i]}: pose '{pose}' was visited at other joints than "
                f"cold, by {np.degrees(away):.2f} deg (allowed {np.degrees(SAME_VISIT_RAD):.1f} "
                "deg): only the same pose can be compared",
                file=file,
                column="pose",
            )


def read_visits(path: str | Path, arm: SerialArm, only: str = ONLY_CYCLE) -> Visits:
    """Read a table of visits of named poses: as ``read_measurements``, with a column ``pose``.

    ``only``: name of the cycle where the table has no column ``cycle``.

    Raises `InputError` as ``read_measurements``, and when the column ``pose`` is missing.
    """
    table, layout = read_table(Path(path), arm)
    if "pose" not in layout.place:
        raise InputError(
            "column pose is missing: it names each measuring pose, the same name cold and warm",
            file=table.file,
            row=1,
        )
    data = measurements_of(table, layout, arm)
    cycle = table.words("cycle") or (only,) * len(data)
    return Visits(data, table.words("pose"), cycle)


# At the poses of a cold reference the arm's static errors are known and cancel. What is left is
# compared with either answer: first as if sensor and target stood still, then, where neither
# answer explains it so, with both moved anywhere, which takes more or better poses to tell.


# Noise makes the wrong answer so much likelier in one case of as many (Wald 1945).
LIKELIER = 1000.0
MOST_LEFT = 0.25  # share of the drift that an answer may leave, to be missing in all later models
FALSE_ALARM = 0.001  # chance that a set-up that stands still looks moved


@dataclass(frozen=True)
class DriftShare:
    """How much of a drift is in a visit: 0 for the cold robot, 1 for one as warm as the drift.

    ``share``, ``sigma``: its estimate and standard deviation; infinite where the visit shows
    nothing.
    """

    share: float = 0.5
    sigma: float = math.inf

    @property
    def told(self) -> bool:
        """Whether the visit tells one answer from the other.

        The chi-squares of the two fits differ by (1 - 2 share) / sigma^2, which is twice the
        logarithm of their likelihoods' ratio.
        """
        return abs(1.0 - 2.0 * self.share) >= 2.0 * math.log(LIKELIER) * self.sigma**2

    @property
    def between(self) -> bool:
        """Whether neither answer is near: the robot warms up or cools down."""
        return MOST_LEFT < self.share < 1.0 - MOST_LEFT

    @property
    def warm(self) -> bool:
        """Whether the drift fits better than the cold robot."""
        return self.share > 0.5


def drift_size_m(visit: ColdReference, warm: SerialArm) -> float:
    """Rms of one coordinate, m, by which a drift moves the targets at a visit's poses."""
    moved = replace(visit.cell, arm=warm).residual(visit.data) - visit.cell.residual(visit.data)
    return float(np.sqrt(np.mean(moved**2)))


def drift_share(
    reference: ColdReference, visit: ColdReference, warm: SerialArm, sigma_m: float
) -> DriftShare:
    """Tell how much of the drift from ``visit``'s arm to ``warm`` a visit shows.

    ``reference``: the one in force, for the static errors at its poses; other poses tell nothing.
    ``visit``: the new visit, placed with the cold arm. ``warm``: the arm with the drift.
    ``sigma_m``: standard deviation of one coordinate of one visit.
    """
    spots, cold = reference.spots, visit.cell.arm
    used = visit.used
    if visit.spheres is not None and reference.spheres is not None:
        seen = visit.spheres.seen(visit.cell, used)
        used = reference.placed(seen.take(reference.knows(seen.q, seen.target)))
    again = spots.common(used)
    again = again.take(~np.isin(again.sample, visit.spots.rejected))
    if len(spots.visited(again.q)) < FEWEST_GROUPS:
        return DriftShare()
    still, explained = _compared(spots, again, cold, warm, sigma_m, moved=False)
    if explained:
        return still
    T = reference.cell.T_frame_base @ frames.invert(visit.cell.T_frame_base)
    seen = replace(again, position=again.position @ T[:3, :3].T + T[:3, 3])
    return _compared(spots, seen, cold, warm, sigma_m, moved=True)[0]


def _compared(
    spots: ColdSpots,
    again: Measurements,
    cold: SerialArm,
    warm: SerialArm,
    sigma_m: float,
    *,
    moved: bool,
) -> tuple[DriftShare, bool]:
    """The share, and whether the better answer leaves no more than noise.

    Least squares over the set-up: sensor and target held to their usual wander, or free in
    position and turn. A fit that is worse than the noise widens sigma by as much.
    """
    again = spots.average(again, sigma_m)
    spot, parameters = spots.match(again), spots.cell.arm.parameters
    rows, setup = spots.rows(again.q, spots.target[spot])
    known = parameters.read(cold.mdh - spots.cell.arm.mdh)
    pair = [rows @ parameters.read(warm.mdh - cold.mdh), spots.drift(again) - rows @ known]
    if moved:
        turn = -frames.skew(again.position - again.position.mean(axis=0))
        setup = np.concatenate([setup, turn], axis=2)
    sigma = np.repeat(np.sqrt(visit_variance(spots, spot, again, sigma_m)), 3)[:, None]
    G = setup.reshape(len(sigma), -1) / sigma
    both = np.column_stack([one.ravel() for one in pair]) / sigma
    if not moved:
        held = np.eye(G.shape[1]) / SETUP_SIGMA_M
        G, both = np.vstack([G, held]), np.vstack([both, np.zeros((len(held), 2))])
    solved, _, rank, _ = np.linalg.lstsq(G, both, rcond=None)
    drift, shown = (both - G @ solved).T
    square, freedom = float(drift @ drift), len(G) - int(rank)
    if freedom < 1 or square <= 0.0:
        return DriftShare(), False
    chi2 = min(float(shown @ shown), float(np.sum((shown - drift) ** 2)))
    sigma_share = float(np.sqrt(max(1.0, chi2 / freedom) / square))
    explained = chi2 <= chi2_quantile(1.0 - FALSE_ALARM, freedom)
    return DriftShare(float(drift @ shown) / square, sigma_share), explained


SETUP_SIGMA_M = 1e-5


def visit_variance(
    spots: ColdSpots, spot: NDArray[np.int64], warm: Measurements, sigma_m: float
) -> Array:
    """Variance (m,), m^2, of one coordinate of a displacement: warm and cold noise."""
    sigma = np.full(len(warm), sigma_m) if warm.sigma is None else warm.sigma
    return np.asarray(sigma**2 + sigma_m**2 / spots.visits[spot])


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
