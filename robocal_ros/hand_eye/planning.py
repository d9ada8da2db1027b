# SPDX-License-Identifier: Apache-2.0
"""Will planned poses do? Rank, expected error and better poses, before the robot moves.

The Fisher information of a pose is that of its predicted sighting: the Jacobian of the estimator at
the place where the target is expected, with the noise that sensor and robot are said to have.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, LimitError, RobocalError
from robocal_ros.ground.frames import Array, Index
from robocal_ros.ground.samples import JointSample
from robocal_ros.hand_eye.data import POINT, DataSet
from robocal_ros.hand_eye.mount_fit import OPEN_M, joined, open_directions
from robocal_ros.hand_eye.mount_problem import (
    LineModel,
    MountProblem,
    MountState,
    Seen,
    Sightings,
    SphereModel,
    TargetModel,
    TargetView,
    same_pose,
)
from robocal_ros.hand_eye.profiles import SensorDescription, SensorRange
from robocal_ros.hand_eye.result import (
    AIM_M,
    HandEyeSettings,
    PoseNoise,
    at_origin,
    expected_error_m,
)
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.hand_eye.stairs import StepTask
from robocal_ros.hand_eye.targets import (
    BoardTarget,
    LaserTarget,
    SphereTarget,
    StepTarget,
    TrackerTarget,
    target_of,
)
from robocal_ros.hand_eye.tasks import FEWEST_SPHERES, HandEyeData, SphereTask
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import CalibrationState
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import FARTHEST_M, flange_unit_fault, joint_unit_fault

VAGUE = 1.0  # m, rad: what is known without any measurement; an open direction has a large error
ROBOT_SIGMA_M = 5e-5  # of a reported pose in each axis, where it is not given
MOST_PROPOSED = 12
SPARE_POSES = 2  # beyond the fewest, so that one may be lost

OFF_EQUATOR = 0.55  # of the radius: where a laser plane tells the side and the height of a sphere
BEHIND = 0.7  # of the radius: how far the centre lies behind the arc that is seen
MOST_ROUNDS = 100  # the best centres settle in a handful
SETTLED_M = 1e-6

SMALLEST = 0.2  # of the radius: a circle that the laser plane cuts out
STEEPEST_RAD = float(np.radians(60.0))  # slope of a surface that still returns light
NEEDED = 0.3  # of a circle's radius: how deep an arc must be seen to know its centre
CUT = 0.3  # of that depth: what may be cut off at the near end
EDGE_POINTS = 10.0  # on each side of an edge, by which its place is known
TILTS_RAD = np.radians([-25.0, 0.0, 25.0])
ROLLS_RAD = np.radians([-60.0, 0.0, 60.0])
ASIDE = (-0.25, 0.25)  # of the field's width
ALONG_M = (-0.04, 0.0, 0.04)  # of an edge


@dataclass(frozen=True, eq=False)
class PlanReport:
    """What a plan is worth.

    ``rank``, ``unknowns``: of the problem; a direction that stays open by 2 cm is not seen, even
    where rounding or a faint effect would tell something. ``unobservable``: those of the sensor, in
    words. ``sigma`` (6,) expected, sensor axes: m, rad; ``working_error_m``: rms at the working
    distance. ``unseen``: poses (by index) that do not see the target, with the reason. ``proposed``
    (n, 4, 4) flange poses to add, best first; ``proposed_error_m``: with all of them, None where
    there is none.
    """

    rank: int
    unknowns: int
    unobservable: tuple[str, ...]
    sigma: Array | None
    working_error_m: float | None
    unseen: dict[int, str]
    proposed: Array
    proposed_error_m: float | None
    verdict: Verdict


def check_plan(
    target: "PlannedTarget",
    T_base_flange: Array,
    T_flange_sensor: Array,
    noise: PoseNoise | None,
    limit_m: float,
) -> PlanReport:
    """Judge planned flange poses (m, 4, 4), with an approximate T_flange_sensor (4, 4).

    ``noise``: of poses, and of light that is laid by eye; None: that of a good robot. ``limit_m``:
    largest expected error (rms) of a point at the working distance.
    """
    fewest = target.fewest - (target.for_noise if noise is not None else 0)
    noise = noise or PoseNoise(ROBOT_SIGMA_M, 0.0, AIM_M)
    sensor, place = target.sensor, target.place(T_base_flange @ T_flange_sensor)
    state = MountState(T_flange_sensor, (place,))
    whole = target.view(T_base_flange, T_flange_sensor, place)
    unseen = target.unseen(whole)
    rows = ~np.isin(whole.sightings.shot, list(unseen))
    looking = np.delete(T_base_flange, list(unseen), axis=0)
    seen = len(set(same_pose(looking).tolist())) if len(looking) else 0
    rank, information, covariance, words = _shown(whole.take(rows), state, noise, sensor)
    sigma = error = None
    if covariance is not None:
        sigma = np.sqrt(np.diag(at_origin(covariance, sensor.pivot)))
        error = float(expected_error_m(covariance, sensor.field_points - sensor.pivot))
    verdict = _verdict(seen, fewest, words, error, limit_m)
    proposed, better = np.empty((0, 4, 4)), None
    if not verdict.accept:
        wanted = fewest + SPARE_POSES - seen
        proposed, better = _propose(
            target, T_base_flange, state, information, noise, limit_m, wanted
        )
    return PlanReport(
        rank, len(information), tuple(words), sigma, error, unseen, proposed, better, verdict
    )


def _shown(
    view: TargetView, state: MountState, noise: PoseNoise, sensor: SensorRange
) -> tuple[int, Array, Array | None, list[str]]:
    """What sightings show: rank, information (k, k), open directions in words.

    Before these the covariance (6, 6) of the sensor, where no direction is open.
    """
    k = 6 + len(view.model.names)
    if not view.sightings.names:
        return 0, np.zeros((k, k)), None, ["no pose sees the target"]
    problem = MountProblem((view,), noise, state, pivot=sensor.pivot)
    J = problem.linearise(state)[1].reshape(-1, k)
    information = J.T @ J + problem.prior()
    covariance = np.asarray(np.linalg.inv(information + VAGUE**-2 * np.eye(k)))
    size = np.ones(k)
    size[3:6] = sensor.reach_m
    rank = int(np.sum(np.linalg.eigvalsh(covariance * np.outer(size, size)) < OPEN_M**2))
    at_sensor = at_origin(covariance[:6, :6], sensor.pivot)
    words = open_directions(at_sensor, sensor.reach_m, view.sightings.T_base_flange)
    return rank, information, None if words else covariance[:6, :6], words


def _verdict(
    seen: int, fewest: int, words: Sequence[str], error: float | None, limit_m: float
) -> Verdict:
    open_ones = f"not determined: {joined(words)}" if words else ""
    if seen < fewest:
        few = f"{seen} poses that differ see the target, at least {fewest} are needed"
        return Verdict(Code.TOO_FEW_SAMPLES, "; ".join(filter(None, (few, open_ones))))
    if words or error is None:
        return Verdict(Code.RANK_DEFICIENT, open_ones)
    figures = f"a point in the field of view is to be expected off by {error * 1e3:.3f} mm rms"
    if error > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{figures} (allowed {limit_m * 1e3:g} mm): add the proposed poses",
        )
    return Verdict(Code.ACCEPT, figures)


def _propose(
    target: "PlannedTarget",
    T_base_flange: Array,
    state: MountState,
    information: Array,
    noise: PoseNoise,
    limit_m: float,
    wanted: int,
) -> tuple[Array, float | None]:
    """Add, one by one, the candidate that lowers the expected error most, until they will do.

    ``information`` (k, k): what is known already; ``wanted``: at least so many are added.
    """
    sensor, X, place = target.sensor, state.T_flange_sensor, state.places[0]
    candidates = target.candidates(T_base_flange @ X, place)
    view = target.view(candidates @ frames.invert(X), X, place)
    problem = MountProblem((view,), noise, state, pivot=sensor.pivot)
    J = problem.linearise(state)[1]
    gain = np.zeros((len(candidates), *information.shape))
    gain[problem.poses] = np.swapaxes(J, 1, 2) @ J
    gain[list(target.unseen(view))] = 0.0
    total = information + VAGUE**-2 * np.eye(len(information))
    chosen: list[int] = []
    error = np.inf
    while np.any(gain) and len(chosen) < MOST_PROPOSED:
        if error <= limit_m and len(chosen) >= wanted:
            break
        covariance = np.asarray(np.linalg.inv(total + gain)[:, :6, :6])
        errors = expected_error_m(covariance, sensor.field_points - sensor.pivot)
        best = int(np.argmin(errors))
        error = float(errors[best])
        total = total + gain[best]
        gain[best] = 0.0  # once: the same pose again shows the same error again
        chosen.append(best)
    return candidates[chosen] @ frames.invert(X), error if chosen else None


def looked_at(T_base_sensor: Array, radius_m: float, sensor: SensorRange) -> tuple[Array, Array]:
    """Centres (2 m, 3) that poses (m, 4, 4) may look at, base, and the misfit (2 m,) of each.

    A laser plane passes a sphere on one of two sides. From each side of each pose the centre goes
    to where the others agree best: iteratively reweighted least squares with Cauchy's weights, so
    that a pose which looks elsewhere hardly counts; each pose on the side that is nearer. Lengths
    in the sensor frame are in terms of how far the sphere may be off and still be seen. The centre
    is rough, to some mm: nobody lays the light where a sphere is best seen.
    """
    R, origin = T_base_sensor[:, :3, :3], T_base_sensor[:, :3, 3]
    off = OFF_EQUATOR * radius_m
    depth_m = 0.5 * abs(sensor.far_m - sensor.near_m) + radius_m
    allowed = np.array([0.5 * sensor.width_m, radius_m - off, depth_m])
    # Its surface is seen, not its centre.
    middle_m = sensor.middle_m + sensor.sense * BEHIND * radius_m
    starts = np.array([[0.0, side * off, middle_m] for side in (-1.0, 1.0)])
    centres = (np.einsum("mij,sj->smi", R, starts) + origin).reshape(-1, 3)
    for _ in range(MOST_ROUNDS):
        miss, at = _misses(R, origin, centres, off, middle_m, allowed)
        weight = 1.0 / (1.0 + np.sum(miss**2, axis=2))
        precision = np.einsum("mij,j,mkj->mik", R, allowed**-2.0, R)
        wanted = origin + np.einsum("mij,pmj->pmi", R, at)
        A = np.einsum("pm,mik->pik", weight, precision)
        b = np.einsum("pm,mik,pmk->pi", weight, precision, wanted)
        before, centres = centres, np.linalg.solve(A, b[..., None])[..., 0]
        if np.abs(centres - before).max() < SETTLED_M:
            break
    miss, _ = _misses(R, origin, centres, off, middle_m, allowed)
    return centres, np.sum(np.log1p(np.sum(miss**2, axis=2)), axis=1)


def _misses(
    R: Array, origin: Array, centres: Array, off: float, middle_m: float, allowed: Array
) -> tuple[Array, Array]:
    """Misses (p, m, 3) of centres (p, 3), in terms of what is allowed, and where each is wanted."""
    s = np.einsum("mji,pmj->pmi", R, centres[:, None] - origin)
    at = np.zeros_like(s)
    at[..., 1] = np.where(s[..., 1] < 0.0, -off, off)
    at[..., 2] = middle_m
    return (s - at) / allowed, at


def _tilted(T_base_sensor: Array) -> Array:
    """Rotations (n, 3, 3) of a sensor turned about the mean of planned ones."""
    mean = frames.nearest_rotation(T_base_sensor[:, :3, :3].mean(axis=0))
    turns = np.array(list(product(TILTS_RAD, TILTS_RAD, ROLLS_RAD)))
    return np.stack([mean @ frames.rotation_from_rpy(turn) for turn in turns])


def _looking(turns: Array, at: Array, target: Array) -> Array:
    """Sensor poses (n, 4, 4) with these rotations that see the target (3,) at ``at`` (n, 3)."""
    return frames.transform(turns, target - np.einsum("nij,nj->ni", turns, at))


def _places(sensor: SensorRange, heights: tuple[float, ...], behind_m: float = 0.0) -> Array:
    """Where a target may be seen (k, 3), sensor frame, m.

    ``behind_m``: how far the point that is placed lies behind the surface that is seen.
    """
    far = np.linspace(sensor.near_m, sensor.far_m, 5)[[1, 3]]
    far = far + sensor.sense * behind_m
    aside = np.array(ASIDE) * sensor.width_m
    return np.array(list(product(aside, heights, far)))


def _expected(
    model: TargetModel, seen: Seen, T_base_flange: Array, shot: Index, covariance: Array
) -> TargetView:
    """A view in which everything is seen as predicted, from the poses of these shots (n,)."""
    names = tuple(f"pose {i + 1}" for i in shot)
    T, pose = T_base_flange[shot], same_pose(T_base_flange)[shot]
    return TargetView(model, Sightings(names, shot, pose, T, seen.value, covariance))


def _out_of_range(x: Array, z: Array, depth: Array, sensor: SensorRange) -> dict[int, str]:
    """Poses whose sighting (x, and z to ``depth`` behind it), m, lies out of the field of view."""
    found = {}
    before, behind = sensor.sense * (z - sensor.near_m), sensor.sense * (sensor.far_m - z)
    for i in np.flatnonzero((before < -CUT * depth) | (behind < depth)):
        found[int(i)] = f"the target is at {z[i] * 1e3:.0f} mm, the sensor sees "
        found[int(i)] += f"{sensor.near_m * 1e3:.0f} to {sensor.far_m * 1e3:.0f} mm"
    for i in np.flatnonzero(np.abs(x) > 0.5 * sensor.width_m):
        found.setdefault(int(i), f"the target is {x[i] * 1e3:.0f} mm aside, out of the laser line")
    return found


@dataclass(frozen=True)
class PlannedSphere:
    """A sphere; ``centre`` (3,) in base, or None: where most poses see it.

    As each planned target it tells which ``sensor`` looks, how many poses are the ``fewest`` to
    solve anything, so many of these ``for_noise`` of the robot, where that is not given, its
    ``place`` by sensor poses (m, 4, 4) that look at it, the ``view`` to expect from flange poses
    (m, 4, 4), from which poses it is ``unseen``, and why, and ``candidates`` (n, 4, 4): sensor
    poses that see it well, turned about those that are planned.
    """

    radius_m: float
    sensor: SensorRange
    centre: Sequence[float] | None = None
    fewest: int = field(default=FEWEST_SPHERES, init=False)
    for_noise: int = field(default=0, init=False)

    def place(self, T_base_sensor: Array) -> Array:
        """Its centre."""
        if self.centre is not None:
            return np.array(self.centre)
        centres, misfit = looked_at(T_base_sensor, self.radius_m, self.sensor)
        blind = [
            len(self.unseen(self.view(T_base_sensor, np.eye(4), centre))) for centre in centres
        ]
        return np.asarray(centres[min(range(len(blind)), key=lambda i: (blind[i], misfit[i]))])

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """Circles, with the covariance that their arcs will have."""
        model = SphereModel(self.radius_m)
        seen = model.see(T_base_flange @ T_flange_sensor, place)
        r = np.maximum(seen.value[:, 2], 0.1 * self.radius_m)
        slope = np.linspace(-STEEPEST_RAD, STEEPEST_RAD, 41)
        normal = np.sin(slope), -self.sensor.sense * np.cos(slope)
        J = np.column_stack([*normal, np.ones(len(slope))])
        step = self.sensor.width_m / self.sensor.points
        share = np.cos(slope) * (slope[1] - slope[0])  # columns are even along the laser line
        unit = np.linalg.inv((J * share[:, None]).T @ J)
        covariance = self.sensor.noise_m**2 * (step / r)[:, None, None] * unit
        return _expected(model, seen, T_base_flange, np.arange(len(r)), covariance)

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Out of the field of view, or beside the sphere."""
        x, z, r = view.sightings.value.T
        beside = r < SMALLEST * self.radius_m  # there the model's r is no circle's
        arc = np.where(beside, BEHIND * self.radius_m, r)
        found = _out_of_range(x, z - self.sensor.sense * arc, NEEDED * arc, self.sensor)
        for i in np.flatnonzero(beside):
            found.setdefault(int(i), "the laser plane passes beside the sphere")
        return found

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """On both sides of the laser plane."""
        high = OFF_EQUATOR * self.radius_m
        cut = np.sqrt(self.radius_m**2 - high**2)  # the arc lies before the circle's centre
        at = _places(self.sensor, (-high, high), (1.0 - 0.5 * NEEDED) * cut)
        pairs = list(product(_tilted(T_base_sensor), at))
        return _looking(np.array([R for R, _ in pairs]), np.array([s for _, s in pairs]), place)


@dataclass(frozen=True, eq=False)
class PlannedLine:
    """A straight edge; ``line`` (2, 3), a point and the direction, or None: across the poses."""

    sensor: SensorRange
    line: Array | None = None
    for_noise: int = field(default=1, init=False)

    @property
    def fewest(self) -> int:
        """Two equations each, and enough over to tell the noise."""
        return 8 if self.line is None else 6

    def place(self, T_base_sensor: Array) -> Array:
        """A point and the direction."""
        if self.line is not None:
            return self.line
        point = (T_base_sensor @ np.array([0.0, 0.0, self.sensor.middle_m, 1.0])).mean(axis=0)[:3]
        normals = T_base_sensor[:, :3, 1]  # turned round, the sensor sees the same edge
        sums = np.where(normals @ normals.T < 0.0, -1.0, 1.0) @ normals
        lengths = np.linalg.norm(sums, axis=1)
        return np.stack([point, sums[np.argmax(lengths)] / lengths.max()])

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """Points of the edge."""
        model = LineModel(self.line is not None)
        seen = model.see(T_base_flange @ T_flange_sensor, place)
        step = self.sensor.width_m / self.sensor.points
        spread = np.diag([(0.5 * step) ** 2, self.sensor.noise_m**2 / EDGE_POINTS, 1.0])
        shot = np.arange(len(T_base_flange))
        return _expected(model, seen, T_base_flange, shot, np.tile(spread, (len(shot), 1, 1)))

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Out of the field of view."""
        x, z, nothing = view.sightings.value.T
        return _out_of_range(x, z, nothing, self.sensor)

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """At several places along the edge."""
        at = _places(self.sensor, (0.0,))
        trios = list(product(_tilted(T_base_sensor), at, ALONG_M))
        poses = [_looking(R[None], s[None], place[0] + a * place[1])[0] for R, s, a in trios]
        return np.array(poses)


@dataclass(frozen=True, eq=False)
class PlannedStairs:
    """A staircase; ``marks`` of the planned poses: None where all lay the light on the first.

    Raises `InputError` for a mark that the target does not have.
    """

    target: StepTarget
    sensor: SensorRange
    marks: Sequence[str] | None = None
    fewest: int = field(default=4, init=False)
    for_noise: int = field(default=1, init=False)

    def __post_init__(self) -> None:
        self.target.require_marks(self.marks or ())

    def place(self, T_base_sensor: Array) -> Array:
        """The taught user frame."""
        return self.target.T_base_user

    def view(self, T_base_flange: Array, T_flange_sensor: Array, place: Array) -> TargetView:
        """All corners of each pose's mark; those out of the field of view tell nothing."""
        marks = self.lit(T_base_flange @ T_flange_sensor)
        corners = [self.target.corners[mark] for mark in marks]
        shot = np.repeat(np.arange(len(corners)), [len(each) for each in corners])
        model = StepTask(self.target).model(np.concatenate(corners))
        seen = model.see(T_base_flange[shot] @ T_flange_sensor, place)
        step = self.sensor.width_m / self.sensor.points
        sigma = np.array([0.5 * step, self.sensor.noise_m / np.sqrt(EDGE_POINTS), 0.0])
        spread = np.tile(np.diag(sigma**2 + self.target.sigma_m**2), (len(shot), 1, 1))
        spread[list(self._out(seen.value))] = np.eye(3)  # tell nothing
        return _expected(model, seen, T_base_flange, shot, spread)

    def lit(self, T_base_sensor: Array) -> tuple[str, ...]:
        """The mark that is nearest to the laser plane of each sensor pose (m, 4, 4)."""
        known = self._known
        middles = np.array([self.target.corners[mark].mean(axis=0) for mark in known])
        base = middles @ self.target.T_base_user[:3, :3].T + self.target.T_base_user[:3, 3]
        away = base[None] - T_base_sensor[:, None, :3, 3]
        y = np.abs(np.einsum("mki,mi->mk", away, T_base_sensor[:, :3, 1]))
        return tuple(known[nearest] for nearest in np.argmin(y, axis=1))

    @property
    def _known(self) -> list[str]:
        known = list(self.target.corners)
        return known[:1] if self.marks is None else known

    def _out(self, value: Array) -> dict[int, str]:
        """Corners out of the field of view, of m (m, 3)."""
        x, z, _ = value.T
        return _out_of_range(x, z, np.zeros_like(z), self.sensor)

    def unseen(self, view: TargetView) -> dict[int, str]:
        """Poses that see less than two corners, or not the only one of a mark."""
        found: dict[int, str] = {}
        out = self._out(view.sightings.value)
        for pose in np.unique(view.sightings.shot):
            rows = np.flatnonzero(view.sightings.shot == pose)
            if sum(int(row) not in out for row in rows) < min(2, len(rows)):
                found[int(pose)] = next(out[int(row)] for row in rows if int(row) in out)
        return found

    def candidates(self, T_base_sensor: Array, place: Array) -> Array:
        """Light through the marks: tilted about their line, and within the plane of the light."""
        every = [self.target.corners[mark] for mark in self._known]
        mean = frames.nearest_rotation(T_base_sensor[:, :3, :3].mean(axis=0))
        x = mean[:, 0]
        if len(every[0]) > 1:  # a corner alone lies on no line
            along = place[:3, :3] @ (every[0][-1] - every[0][0])
            x = along / np.linalg.norm(along) * np.sign(along @ x)
        y = mean[:, 1] - x * (x @ mean[:, 1])
        y /= np.linalg.norm(y)
        level = np.column_stack([x, y, np.cross(x, y)])
        poses = []
        places = _places(self.sensor, (0.0,))
        for number, (about_x, about_y, at) in enumerate(product(TILTS_RAD, TILTS_RAD, places)):
            R = level @ frames.rotation_from_rpy([about_x, 0.0, 0.0])
            R = R @ frames.rotation_from_rpy([0.0, about_y, 0.0])
            middle = place[:3, :3] @ every[number % len(every)].mean(axis=0) + place[:3, 3]
            poses.append(_looking(R[None], at[None], middle)[0])
        return np.array(poses)


PlannedTarget = PlannedSphere | PlannedLine | PlannedStairs


def planned_target(
    target: LaserTarget | None,
    sensor: SensorRange,
    centre: Sequence[float] | None,
    marks: Sequence[str] | None,
) -> PlannedTarget:
    """How a line laser's target would be seen; None: a line whose place is not known.

    ``centre`` (3,), base, of a sphere; ``marks``: of a staircase, see `PlannedStairs`.
    """
    if isinstance(target, SphereTarget):
        return PlannedSphere(target.radius_m, sensor, centre)
    if isinstance(target, StepTarget):
        return PlannedStairs(target, sensor, marks)
    if target is None:
        return PlannedLine(sensor)
    return PlannedLine(sensor, np.stack([target.point_base, target.direction_base]))


MOST_POSES = 200
FEWEST_SEEN = 3  # samples that tell on which side of the laser plane a sphere lies
# What was refused or taken back tells nothing.
TO_GO_BY = (CalibrationState.PENDING, CalibrationState.STALE)


def planned_poses(
    arm: SerialArm, joints: Sequence[JointSample], flange: Sequence[tuple[ArrayLike, ArrayLike]]
) -> Array:
    """Flange poses (m, 4, 4) at joint readings, or of positions (3,), m, and quaternions (4,).

    Raises `InputError` when they are given in both ways or in none, a joint is missing, one is no
    pose, or a value is in another unit; `LimitError` when there are too many.
    """
    if bool(joints) == bool(flange):
        raise InputError(
            f"{len(joints)} joint states and {len(flange)} flange poses: give the planned poses in "
            "one of the two ways"
        )
    if (count := len(joints) + len(flange)) > MOST_POSES:
        raise LimitError(f"{count} poses: at most {MOST_POSES} are judged at a time")
    if joints:
        q = np.array([sample.position[sample.order(arm.joint_names)] for sample in joints])
        poses, fault = arm.fk(q), joint_unit_fault(arm, q)
    else:
        poses = np.array([pose_of(*pose, f"flange pose {i}") for i, pose in enumerate(flange, 1)])
        fault = flange_unit_fault(poses[:, :3, 3])
    if fault is not None:
        raise InputError(f"planned pose {fault[0] + 1}: {fault[1]}")
    return poses


def pose_of(position: ArrayLike, quat_xyzw: ArrayLike, name: str) -> Array:
    """A pose (4, 4) of a position (3,), m, and a quaternion (4,).

    Raises `InputError` when it is none; ``name`` says which.
    """
    quat, place = np.asarray(quat_xyzw, np.float64), np.asarray(position, np.float64)
    norm = float(np.linalg.norm(quat))
    if not (abs(norm - 1.0) <= 1e-3):
        raise InputError(f"{name} is none: its quaternion has length {norm:.6g}")
    return frames.transform_from_quat(require_near(place, name), quat / norm)


def require_near(place: ArrayLike, name: str) -> Array:
    """A place (3,), m.

    Raises `InputError` when it is none within reach of an arm; ``name`` says which.
    """
    point = np.asarray(place, np.float64)
    if not np.all(np.isfinite(point)):
        raise InputError(f"{name} is none: its position is {point}")
    if (away := float(np.linalg.norm(point))) > FARTHEST_M:
        raise InputError(
            f"{name} is {away:.4g} m away: is it a thousand times too far: mm where m are expected?"
        )
    return point


def rough_mount(
    session: HandEyeSession,
    history: CalibrationHistory,
    given: Array | None,
    configured: Array | None,
) -> tuple[Array, str]:
    """About where the sensor sits on the flange (4, 4), and who says so.

    What the request has given; else what is in force; else the open data set's last candidate,
    unless it was refused; else what is configured.

    Raises `InputError` when nothing says it.
    """
    if given is not None:
        return given, "the request"
    head, number = session.in_force, _candidate(session.data, history)
    for model, name in (
        (head.model, f"calibration {head.calibration_id} in force"),
        (history.model(number) if number else None, f"candidate {number}"),
    ):
        if model is not None and model["parent"] == session.config.flange_frame:
            return np.array(model["T_parent_sensor"]), name
    if configured is not None:
        return configured, "rough_xyz_mm and rough_quat_xyzw"
    raise InputError(
        "nothing says where the sensor sits: set rough_xyz_mm and rough_quat_xyzw to a few "
        "millimetres and degrees, or give sensor in the request"
    )


def _candidate(data: DataSet | None, history: CalibrationHistory) -> int:
    """The last calibration of a data set that can be gone by; 0 without."""
    number = 0 if data is None else data.candidate
    return number if number and history.get(number).state in TO_GO_BY else 0


def sphere_centre(
    data: DataSet,
    history: CalibrationHistory,
    arm: SerialArm,
    T_flange_sensor: Array,
    sensor: SensorDescription,
) -> Array | None:
    """Where the sphere was last found (3,), base; None where neither result nor samples tell."""
    target = target_of(data.target)
    if not isinstance(target, SphereTarget):
        return None
    if number := _candidate(data, history):
        return 1e-3 * np.array(history.document(number)["target"]["center_mm"])
    samples = list(data.samples.values())
    if len(samples) < FEWEST_SEEN:
        return None
    profiles = [sample.profile for sample in samples]
    poses = arm.fk(np.array([sample.q for sample in samples]))
    task = SphereTask(target, sensor.towards)
    shots = HandEyeData(tuple(profile.name for profile in profiles), poses, profiles)
    try:
        view = task.read(shots, T_flange_sensor).view
    except RobocalError:  # they show no sphere: calibrate says so
        return None
    return task.placed(view, T_flange_sensor) if len(view.sightings.names) >= FEWEST_SEEN else None


def laser_target(data: DataSet) -> LaserTarget | None:
    """What a line laser is shown. Raises `InputError` for what no plans are judged for."""
    target = target_of(data.target)
    if data.kind in ("camera", POINT) or isinstance(target, BoardTarget | TrackerTarget):
        raise InputError(f"plans are judged for a line laser's targets, not for a {data.kind}")
    return target


def judged_plan(
    data: DataSet,
    T_base_flange: Array,
    marks: Sequence[str],
    T_flange_sensor: Array,
    sensor: SensorRange,
    config: HandEyeConfig,
    centre: Array | None = None,
) -> PlanReport:
    """Judge planned flange poses (m, 4, 4) with a rough T_flange_sensor (4, 4).

    ``marks``: of a step target the mark (m) of each pose; without any its first one. ``centre``:
    of a sphere (3,), base; None: where most of the poses see it.

    Raises `InputError` for a target whose plans cannot be judged, and for marks that it does not
    have.
    """
    if marks and len(marks) != len(T_base_flange):
        raise InputError(f"{len(marks)} marks for {len(T_base_flange)} poses: give each its own")
    for mark in marks:
        data.require_mark(mark)
    if centre is not None and data.kind != "sphere":
        raise InputError(f"center is a sphere's, not a {data.kind}'s: leave it out")
    target = laser_target(data)
    given = HandEyeSettings(config.robot_sigma_m, config.robot_sigma_rad).noise()
    middle = None if centre is None else centre.tolist()
    planned = planned_target(target, sensor, middle, tuple(marks) or None)
    return check_plan(planned, T_base_flange, T_flange_sensor, given, config.limit_m)
