# SPDX-License-Identifier: Apache-2.0
"""A task per target: read its features from profiles, start, solve in the classic way."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import ClassVar, TypeVar

import numpy as np

from robocal_ros.estimation.edge import EdgeRule, fit_edge
from robocal_ros.estimation.estimation import solve
from robocal_ros.estimation.sphere import ArcFit, ArcRule, LargeArcError, fit_arc
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document
from robocal_ros.hand_eye.linearity import (
    SeenArc,
    SeenCorner,
    SeenCurve,
    SensorLinearity,
    beside_corners,
    fit_linearity,
)
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import (
    LineModel,
    MountProblem,
    MountState,
    Sightings,
    SphereModel,
    TargetView,
    circle_centres,
    from_plane,
    in_plane,
    same_pose,
)
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.result import PoseNoise, TargetKind
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget
from robocal_ros.kinematics.joint_errors import ShotJoints

Fit = TypeVar("Fit")

FEWEST_SPHERES = 5  # profiles
LEAST_TOLD = 1e-9  # of an unknown, over the most
FEWEST_LINEAR = 5  # profiles for the twelve unknowns of M and t
SUBSET = 6  # profiles whose sides are tried in all patterns
TOO_LARGE = 0.1  # of the radius, by which an arc exceeds the sphere and is something else
DRAWS = 24  # one of them holds no wrong pair, very likely, even with four among 15
MIRROR = np.array([1.0, -1.0, 1.0])
KEPT_SPHERES = 3  # starts of each draw, and in the end
RADII = (
    0.5,
    0.6,
    0.7,
    0.8,
    0.83,
    0.86,
    0.89,
    *np.arange(0.91, 1.1, 0.01),
    1.12,
    1.15,
    1.2,
    1.25,
    1.4,
    1.6,
    1.8,
    2.0,
)  # as told: 1

TURNS = 400  # rotations of the sensor that are tried
DIRECTIONS = 60  # directions of an unknown line that are tried
KEPT_LINES = 8
ALIKE_M = 1e-6  # small, so that the descent goes to the very minimum
SEED = 5  # of the fixed set of trials


@dataclass(frozen=True, eq=False)
class HandEyeData:
    """Shots of one target.

    ``names`` (m) of the shots; ``T_base_flange``: (m, 4, 4) as the robot reports them.
    ``profiles`` (m) what the sensor saw, or why that cannot be used.
    ``marks`` (m) mark of a staircase that each laser plane was laid through, or None.
    ``joints``: that the poses were read by; None where they are not known.
    """

    names: tuple[str, ...]
    T_base_flange: Array
    profiles: Sequence[Profile | RobocalError]
    marks: tuple[str, ...] | None = None
    joints: ShotJoints | None = None


@dataclass(frozen=True, eq=False)
class Read:
    """Features of a data set.

    ``view``: of the features; ``rejected``: which shots gave none, and why.
    ``points``: profile points (n, 2) that each feature rests on, where they are on the target.
    ``linearity``: of the sensor, where it was found and taken out; ``pulled``: how each feature
    (3, k) moves with its coefficients.
    """

    view: TargetView
    rejected: Mapping[str, str]
    points: Mapping[str, Array] = field(default_factory=dict)
    linearity: SensorLinearity | None = None
    pulled: Mapping[str, Array] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Task(ABC):
    """A kind of target.

    ``read_by_poses``: whether poses tell which feature of a profile is which. ``plain``: profiles
    are taken as they are; else the sensor's linearity is taken out of them, where they show it.
    """

    kind: ClassVar[TargetKind]
    read_by_poses: ClassVar[bool] = False
    plain: bool = field(default=False, kw_only=True)

    @property
    @abstractmethod
    def fewest(self) -> int:
        """Profiles without which nothing is solved."""

    @abstractmethod
    def read(
        self,
        data: HandEyeData,
        T_flange_sensor: Array | None = None,
        linearity: SensorLinearity | None = None,
    ) -> Read:
        """Features of profiles. Raises `RobocalError` when fewer give any than solving needs.

        Where the sensor is known to sit, one will do. ``linearity``: of the sensor, where it is
        known.
        """

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """The same features from other poses, those of ``data``."""
        s, T = view.sightings, data.T_base_flange
        return replace(
            view, sightings=replace(s, pose=same_pose(T)[s.shot], T_base_flange=T[s.shot])
        )

    @abstractmethod
    def starts(self, view: TargetView) -> list[MountState]:
        """First states, best first."""

    @abstractmethod
    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The classic estimate; ``near`` is a state near the solution."""

    @abstractmethod
    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """Where the target is, roughly, if the sensor sits there."""

    @abstractmethod
    def found(self, place: Array) -> Document:
        """What was found of the target."""

    def more(self, fit: MountFit, read: Read) -> Document:
        """Further figures of a fit."""
        return {}

    def suspects(self) -> Iterable[tuple[str, "Task"]]:
        """Mistakes in what is told of the target: in words, and the task without it."""
        return ()


def usable(rows: Collection[object], rejected: Mapping[str, str], fewest: int, what: str) -> None:
    """Refuse when fewer than ``fewest`` shots gave a feature.

    Raises `TooFewSamplesError`, with the commonest reason.
    """
    if len(rows) >= fewest:
        return
    reasons = list(rejected.values())
    most = max(reasons, key=reasons.count, default="")
    because = f"; {len(reasons)} show none, most often because: {most}" if reasons else ""
    raise TooFewSamplesError(
        f"{len(rows)} profiles show {what}, at least {fewest} are needed{because}"
    )


def fitted(
    data: HandEyeData, fit: Callable[[Profile], Fit]
) -> tuple[dict[int, Fit], dict[str, RobocalError]]:
    """What is fitted to each profile, by its number; by its name why nothing is."""
    found, errors = {}, {}
    for i, (name, profile) in enumerate(zip(data.names, data.profiles, strict=True)):
        if isinstance(profile, RobocalError):
            errors[name] = profile
            continue
        try:
            found[i] = fit(profile)
        except RobocalError as error:
            errors[name] = error
    return found, errors


def read_with(
    task: Task,
    data: HandEyeData,
    linearity: SensorLinearity | None,
    T_flange_sensor: Array | None = None,
) -> Read:
    """Features by what is known of the sensor: its linearity is not looked for."""
    known = replace(task, plain=linearity is None)
    return known.read(data, T_flange_sensor, linearity)


def straightened(
    data: HandEyeData,
    fit: Callable[[Profile], Fit],
    curves: Callable[[Fit, Profile], Sequence[SeenCurve]],
    task: Task,
    towards: bool,
    known: SensorLinearity | None,
) -> tuple[HandEyeData, tuple[dict[int, Fit], dict[str, RobocalError]], SensorLinearity | None]:
    """Data, and what is fitted to them, without the sensor's linearity, and this, if there is any.

    ``curves``: what a fit to a profile rests on.
    """
    found = fitted(data, fit)
    if known is None and not task.plain:
        pose, shown, poses = same_pose(data.T_base_flange), list[SeenCurve](), list[int]()
        for i, one in found[0].items():
            if isinstance(profile := data.profiles[i], Profile):
                own = curves(one, profile)
                shown += own
                poses += [int(pose[i])] * len(own)
        known = fit_linearity(shown, np.array(poses, dtype=np.int64), towards)
    if known is None or known.assumed:
        return data, found, known
    profiles = [
        replace(one, points=known.corrected(one.points)) if isinstance(one, Profile) else one
        for one in data.profiles
    ]
    data = replace(data, profiles=profiles)
    return data, fitted(data, fit), known


def sightings_of(
    data: HandEyeData, shots: Iterable[int], names: Iterable[str], value: Array, covariance: Array
) -> Sightings:
    """Features (m, 3) with their covariance (m, 3, 3), of these shots (m)."""
    shot, T = np.array(list(shots), dtype=np.int64), data.T_base_flange
    return Sightings(tuple(names), shot, same_pose(T)[shot], T[shot], value, covariance)


@dataclass(frozen=True)
class SphereTask(Task):
    """A sphere that stands still, somewhere.

    A circle tells the sphere's centre but for the side: y = +-sqrt(R^2 - r^2). The sides are found
    with the pose: of all patterns of a few profiles, the right one agrees best (with rotation
    columns that are a rotation; the mirrored pattern has the determinant -1). ``towards``: see
    `ArcRule`.
    """

    target: SphereTarget
    towards: bool = False

    kind = "sphere"
    fewest = FEWEST_SPHERES

    def read(
        self,
        data: HandEyeData,
        T_flange_sensor: Array | None = None,
        linearity: SensorLinearity | None = None,
    ) -> Read:
        """Circles."""
        radius_m = self.target.radius_m
        # An arc that is a little too large is kept: together they tell that the radius is wrong.
        rule = ArcRule(radius_m, radius_tolerance_m=TOO_LARGE * radius_m, towards=self.towards)
        data, (arcs, errors), linearity = straightened(
            data, lambda profile: fit_arc(profile.points, rule),
            lambda arc, profile: [_on_circle(arc, profile)], self, self.towards, linearity,
        )  # fmt: skip
        rejected = {name: str(error) for name, error in errors.items()}
        wrong = [error for error in errors.values() if isinstance(error, InputError)]
        if wrong and not arcs:
            raise wrong[-1]  # no profile's fault: the radius is in another unit
        large = [error for error in errors.values() if isinstance(error, LargeArcError)]
        if len(large) > 1:
            raise ResidualError(f"in {len(large)} of {len(data.names)} profiles: {large[0]}")
        usable(arcs, rejected, self.fewest if T_flange_sensor is None else 1, "the sphere")
        names = [data.names[i] for i in arcs]
        shown = {
            name: _on_circle(arc, profile)
            for name, (i, arc) in zip(names, arcs.items(), strict=True)
            if isinstance(profile := data.profiles[i], Profile)
        }
        points = {name: one.points for name, one in shown.items()}
        pulled = {}
        if linearity is not None:
            pulled = {name: linearity.pull(one, self.towards) for name, one in shown.items()}
        value = np.array([[*arc.centre, arc.radius_m] for arc in arcs.values()])
        covariance = np.array([arc.covariance for arc in arcs.values()])
        sightings = sightings_of(data, arcs, names, value, covariance)
        view = TargetView(SphereModel(radius_m), sightings)
        return Read(view, rejected, points, linearity, pulled)

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """Circles depend neither on poses nor on the radius."""
        return replace(super().posed(view, data), model=SphereModel(self.target.radius_m))

    def starts(self, view: TargetView) -> list[MountState]:
        """The most promising, each from a few profiles, judged on all of them."""
        s, rng = view.sightings, np.random.default_rng(0)
        m, T = len(s.names), s.T_base_flange
        rows = np.arange(m)[None]
        if m > SUBSET:
            spread = np.linspace(0, m - 1, SUBSET).round().astype(np.int64)  # over the whole set
            drawn = [np.sort(rng.permutation(m)[:SUBSET]) for _ in range(DRAWS - 1)]
            rows = np.stack([spread, *drawn])
        X, place = self._by_patterns(T[rows], s.value[rows])
        centres = self._on_sides(s.value, _sides(T, X, place))
        score = np.median(_misses(T, X, place, centres), axis=1)
        return [MountState(X[i], (place[i],)) for i in np.argsort(score)[:KEPT_SPHERES]]

    def _by_patterns(self, T_base_flange: Array, value: Array) -> tuple[Array, Array]:
        """The best poses (b, 4, 4) and spheres (b, 3) of each draw of profiles, over all patterns.

        ``T_base_flange`` (d, m, 4, 4), ``value`` (d, m, 3): of m profiles in each of d draws.
        """
        draws, m = value.shape[:2]
        R, origin = T_base_flange[..., :3, :3], T_base_flange[..., :3, 3]
        patterns = np.array([(1.0, *rest) for rest in product((1.0, -1.0), repeat=m - 1)])
        M = _mounts_by_patterns(T_base_flange, self._on_sides(value, np.ones(m)), patterns)
        turn = frames.nearest_rotation(np.concatenate([M, M * MIRROR], axis=1))  # the opposite too
        centres = self._on_sides(value[:, None], np.concatenate([patterns, -patterns]))
        # With a rotation held the rest is linear: R_i t - c = -(R_i M s_i + t_i)
        lhs = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape)], axis=3)
        inverse = np.linalg.pinv(lhs.reshape(draws, 3 * m, 6), rcond=LEAST_TOLD)
        turned = centres @ np.swapaxes(turn, 2, 3)
        rhs = (R[:, None] @ turned[..., None])[..., 0] + origin[:, None]
        solution = -(rhs.reshape(draws, -1, 3 * m) @ np.swapaxes(inverse, 1, 2))
        X, place = frames.transform(turn, solution[..., :3]), solution[..., 3:]
        miss = _misses(T_base_flange, X, place, centres)
        best = np.argsort(np.sum(miss**2, axis=2), axis=1)[:, :KEPT_SPHERES]
        of_each = np.arange(draws)[:, None], best
        return X[of_each].reshape(-1, 4, 4), place[of_each].reshape(-1, 3)

    def _on_sides(self, value: Array, sides: Array) -> Array:
        """Sphere centres (..., m, 3), sensor frame, of circles (..., m, 3) on sides (..., m)."""
        shape = np.broadcast_shapes(value.shape[:-1], sides.shape)
        circles = np.broadcast_to(value, (*shape, 3)).reshape(-1, 3)
        side = np.broadcast_to(sides, shape).ravel()
        return circle_centres(circles, self.target.radius_m, side).reshape(*shape, 3)

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The closed form from all profiles, their sides as in a state near the solution."""
        s = view.sightings
        side = _sides(s.T_base_flange, near.T_flange_sensor[None], near.places[0][None])[0]
        centres = circle_centres(s.value, self.target.radius_m, side)
        M, t = _linear_mounts(s.T_base_flange, centres[None])
        found = frames.transform(frames.nearest_rotation(M[0]), t[0])
        T = s.T_base_flange @ found
        return MountState(found, (frames.apply(T, centres).mean(axis=0),))

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """The centre on which the profiles agree best, each on either side."""
        s = view.sightings
        T = s.T_base_flange @ T_flange_sensor
        both = []
        for side in (1.0, -1.0):
            own = circle_centres(s.value, self.target.radius_m, np.full(len(T), side))
            both.append(frames.apply(T, own))
        points = np.concatenate(both)
        gap = np.linalg.norm(points[:, None, None] - np.stack(both)[None], axis=3).min(axis=1)
        near = points[int(np.argmin(np.median(gap, axis=1)))]
        nearer = np.argmin(np.linalg.norm(np.stack(both) - near, axis=2), axis=0)
        return np.asarray(np.median(np.stack(both)[nearer, np.arange(len(T))], axis=0))

    def found(self, place: Array) -> Document:
        """Its centre in base."""
        return {"center_mm": (place * 1e3).tolist(), "radius_mm": self.target.radius_m * 1e3}

    def suspects(self) -> Iterable[tuple[str, Task]]:
        """Other radii."""
        for share in RADII:
            radius_m = share * self.target.radius_m
            words = f"the profiles fit a sphere of radius {radius_m * 1e3:.3g} mm or so"
            other = replace(self, target=SphereTarget(radius_m))
            yield f"{words}: check which sphere is mounted", other

    def more(self, fit: MountFit, read: Read) -> Document:
        """How far profile points are from the sphere, all profiles together."""
        s, centre = fit.views[0].sightings, fit.state.places[0]
        far = []
        for name, T_base_flange in zip(s.names, s.T_base_flange, strict=True):
            base = from_plane(T_base_flange @ fit.state.T_flange_sensor, read.points[name])
            far.append(np.linalg.norm(base - centre, axis=1) - self.target.radius_m)
        return {"point_residual_mm": float(np.sqrt(np.mean(np.concatenate(far) ** 2))) * 1e3}


def _on_circle(arc: ArcFit, profile: Profile) -> SeenArc:
    """Points of a profile on its circle."""
    return SeenArc(profile.points[arc.used], np.append(arc.centre, arc.radius_m))


def _linear_mounts(T_base_flange: Array, centres: Array) -> tuple[Array, Array]:
    """Classic closed form for many patterns (p) of sides: M (p, 3, 3), t (p, 3).

    R_i (M s_i + t) + t_i = c is linear in M and t; differences from the mean leave out c. M is
    near the rotation of the sensor. ``centres`` (p, m, 3): the sphere in each sensor frame.
    """
    R, place = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3]
    p, m = centres.shape[:2]
    A = np.concatenate([np.einsum("mij,pmk->pmijk", R, centres).reshape(p, m, 3, 9),
                        np.broadcast_to(R, (p, m, 3, 3))], axis=3)  # fmt: skip
    A = (A - A.mean(axis=1, keepdims=True)).reshape(p, 3 * m, 12)
    b = -(place - place.mean(axis=0)).reshape(-1)
    solution = np.linalg.pinv(A, rcond=LEAST_TOLD) @ b
    return solution[:, :9].reshape(p, 3, 3), solution[:, 9:]


def _mounts_by_patterns(T_base_flange: Array, centres: Array, patterns: Array) -> Array:
    """M (d, p, 3, 3) of `_linear_mounts`, for patterns (p, m) of sides that are +1 in ``centres``.

    ``T_base_flange`` (d, m, 4, 4), ``centres`` (d, m, 3): of each draw of profiles. Only the
    centres' y changes with the side, and with it the equations of M's second column. All other
    unknowns are eliminated once for all patterns (Frisch and Waugh 1933).
    """
    draws, m = centres.shape[:2]
    if m < FEWEST_LINEAR:  # of all solutions the shortest
        turned = np.repeat(centres[:, None], len(patterns), axis=1)
        turned[..., 1] *= patterns
        pairs = zip(T_base_flange, turned, strict=True)
        return np.stack([_linear_mounts(T, own)[0] for T, own in pairs])
    R, place = T_base_flange[..., :3, :3], T_base_flange[..., :3, 3]
    x, y, z = np.moveaxis(centres, 2, 0)[..., None, None]
    known = (place.mean(axis=1, keepdims=True) - place).reshape(draws, 3 * m, 1)
    fixed = np.concatenate([x * R, z * R, R], axis=3)
    fixed = (fixed - fixed.mean(axis=1, keepdims=True)).reshape(draws, 3 * m, 9)
    of_each = (np.eye(m)[:, :, None, None] - 1.0 / m) * (y * R)[:, :, None]
    of_each = of_each.reshape(draws, m, 3 * m, 3)  # what a profile's y has in all equations
    inverse = np.linalg.pinv(fixed, rcond=LEAST_TOLD)
    shared, alone = inverse[:, None] @ of_each, inverse @ known

    def by_pattern(parts: Array) -> Array:
        summed = patterns @ parts.reshape(draws, m, -1)
        return summed.reshape(draws, len(patterns), *parts.shape[2:])

    seen = by_pattern(of_each - fixed[:, None] @ shared)
    U, size, Vt = np.linalg.svd(seen, full_matrices=False)
    told = size > LEAST_TOLD * np.linalg.norm(of_each.reshape(draws, -1), axis=1)[:, None, None]
    left = (np.swapaxes(U, 2, 3) @ (known - fixed @ alone)[:, None])[..., 0]
    part = np.where(told, left, 0.0) / np.where(told, size, 1.0)
    second = np.swapaxes(Vt, 2, 3) @ part[..., None]
    others = (alone[:, None] - by_pattern(shared) @ second)[..., 0]
    return np.stack([others[..., :3], second[..., 0], others[..., 3:6]], axis=3)


def _misses(T_base_flange: Array, X: Array, place: Array, centres: Array) -> Array:
    """Distances (..., p, m) of centres (..., p, m, 3), put into base, from spheres (..., p, 3)."""
    T = T_base_flange[..., None, :, :, :] @ X[..., None, :, :]
    return np.asarray(np.linalg.norm(frames.apply(T, centres) - place[..., None, :], axis=-1))


def _sides(T_base_flange: Array, X: Array, place: Array) -> Array:
    """Sides (p, m) of the laser planes on which each solution's sphere lies."""
    T = T_base_flange[None] @ X[:, None]
    y = np.einsum("pmj,pmj->pm", T[..., :3, 1], place[:, None] - T[..., :3, 3])
    return np.where(y < 0.0, -1.0, 1.0)


@dataclass(frozen=True, eq=False)
class LineTask(Task):
    """A straight edge or groove; ``target`` None where its place is unknown."""

    target: LineTarget | None
    rule: EdgeRule

    kind = "line"

    @property
    def fewest(self) -> int:
        """Two equations each."""
        return 5 if self.target is None else 3

    def read(
        self,
        data: HandEyeData,
        T_flange_sensor: Array | None = None,
        linearity: SensorLinearity | None = None,
    ) -> Read:
        """Points of the edge."""
        towards = self.rule.towards
        data, (edges, errors), linearity = straightened(
            data, lambda profile: fit_edge(profile.points, self.rule),
            lambda edge, _: beside_corners(edge.sides, edge.point[None]), self, towards, linearity,
        )  # fmt: skip
        rejected = {name: str(error) for name, error in errors.items()}
        usable(edges, rejected, self.fewest if T_flange_sensor is None else 1, "the line")
        value = np.array([[*edge.point, 0.0] for edge in edges.values()])
        covariance = np.tile(np.eye(3), (len(edges), 1, 1))
        covariance[:, :2, :2] = [edge.covariance for edge in edges.values()]
        names = [data.names[i] for i in edges]
        sightings = sightings_of(data, edges, names, value, covariance)
        view = TargetView(LineModel(self.target is not None), sightings)
        pulled = {}
        if linearity is not None:
            for name, edge in zip(names, edges.values(), strict=True):
                pulled[name] = linearity.pull(SeenCorner(edge.point, edge.sides), towards)
        return Read(view, rejected, linearity=linearity, pulled=pulled)

    def starts(self, view: TargetView) -> list[MountState]:
        """The most promising of a fixed set of rotations, and of directions of an unknown line.

        With the sensor's rotation and the line's direction held, all the rest is linear.
        """
        from scipy.spatial.transform import Rotation

        rng = np.random.default_rng(SEED)
        quat = rng.standard_normal((TURNS, 4))
        turns = np.asarray(Rotation.from_quat(quat).as_matrix())
        known = self._known()
        if known is not None:
            directions = known[1][None]
        else:
            sphere = rng.standard_normal((DIRECTIONS, 3))
            directions = sphere / np.linalg.norm(sphere, axis=1)[:, None]
        T = view.sightings.T_base_flange
        R, origin = T[:, :3, :3], T[:, :3, 3]
        flange = in_plane(view.sightings.value) @ np.swapaxes(turns, 1, 2)
        seen = (R @ flange[..., None])[..., 0] + origin  # of a sensor at the flange's origin
        held = [_held(R, seen, u, None if known is None else known[0]) for u in directions]
        costs = np.array([cost for cost, _, _ in held])  # (directions, turns)
        starts = []
        for flat in np.argsort(costs, axis=None)[:KEPT_LINES]:
            d, r = (int(i) for i in np.unravel_index(int(flat), costs.shape))
            _, t, point = held[d]
            X = frames.transform(turns[r], t[r])
            starts.append(MountState(X, (np.stack([point[r], directions[d]]),)))
        return starts

    def _known(self) -> Array | None:
        """A point and the direction (2, 3), base, where the line's place is known."""
        if self.target is None:
            return None
        return np.stack([self.target.point_base, self.target.direction_base])

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The least sum of squared distances from the line, every feature alike.

        Where it still crept along what the poses hardly show, as far as it came: how far that is
        from the best estimate is told, and judged.
        """
        alike = np.tile(ALIKE_M**2 * np.eye(3), (len(view.sightings.names), 1, 1))
        view = TargetView(view.model, replace(view.sightings, covariance=alike))
        problem = MountProblem((view,), PoseNoise(0.0, 0.0), near)
        return solve(problem, near, robust=False, sizes=problem.sizes).state

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """Where it is known to be, or along the middle of the points that were seen."""
        known = self._known()
        if known is not None:
            return known
        s = view.sightings
        points = from_plane(s.T_base_flange @ T_flange_sensor, s.value)
        middle = np.median(points, axis=0)
        return np.stack([middle, np.linalg.svd(points - middle)[2][0]])

    def found(self, place: Array) -> Document:
        """A point of it and its direction in base."""
        line = {"point_mm": (place[0] * 1e3).tolist(), "direction": place[1].tolist()}
        return {"line": line, "known": self.target is not None}


def _held(
    R: Array, seen: Array, direction: Array, point: Array | None
) -> tuple[Array, Array, Array]:
    """With rotations and a direction held: costs (p,), t (p, 3), points (p, 3) of the line.

    ``R`` (m, 3, 3) of the flange; ``seen`` (p, m, 3) in base, of a sensor at the flange's origin.
    """
    across = np.linalg.svd(direction[None])[2][1:]  # (2, 3)
    lhs = across @ R
    if point is None:
        lhs = np.concatenate([lhs, np.broadcast_to(-np.eye(2), (len(R), 2, 2))], axis=2)
    lhs = lhs.reshape(2 * len(R), -1)
    known = np.zeros(3) if point is None else point
    rhs = ((seen - known) @ across.T).reshape(len(seen), -1)
    solution = -(np.linalg.pinv(lhs, rcond=1e-9) @ rhs.T).T
    cost = np.sum((solution @ lhs.T + rhs) ** 2, axis=1)
    points = np.broadcast_to(known, (len(seen), 3))
    return cost, solution[:, :3], points if point is not None else solution[:, 3:] @ across
