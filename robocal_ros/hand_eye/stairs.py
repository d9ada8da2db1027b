# SPDX-License-Identifier: Apache-2.0
"""The task of a staircase: which corner of a profile is which; and the task of any target."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.edge import CornerFit, CornerRule, EdgeRule, Kind, fit_corners
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document, Index, transform_document
from robocal_ros.hand_eye.linearity import (
    SeenCorner,
    SeenLine,
    SensorLinearity,
    beside_corners,
)
from robocal_ros.hand_eye.mount_fit import MountFit, first_look, misfit
from robocal_ros.hand_eye.mount_problem import CornerModel, MountState, TargetView, in_plane
from robocal_ros.hand_eye.profiles import Profile
from robocal_ros.hand_eye.targets import LaserTarget, SphereTarget, StepTarget
from robocal_ros.hand_eye.tasks import (
    SEED,
    HandEyeData,
    LineTask,
    Read,
    SphereTask,
    Task,
    fitted,
    sightings_of,
    straightened,
    usable,
)

Match = tuple[Index, Index]  # corners of a profile (rows of its fit), and the target's they are

PARTS = 50  # of the corners that are tried
NO_STRETCH = 2e-3  # of their length: corners that lie on one line but for so much
CLEAR = 1.5  # times better than the next, from which a place along the target is sure
SURE = 4.0  # standard deviations of distances, from which the next is no such place at all
NEAR = 0.35  # of the distance between neighbours: farther than this is another corner
TURNED_M, TURNED = 5e-4, 0.3  # the order of the target file is kept unless it misses by so much
HOPELESS_M = 2e-3  # misfit of the closed form that no place of the sensor makes one of right data
PROFILES = 256  # whose corners are remembered
SMALLEST_SIGMA = 1e-7  # m, rad: of a teaching error that is not zero in the other


@dataclass(frozen=True, eq=False)
class StepTask(Task):
    """Corners of a staircase; ``rule`` says how they are found.

    A profile may show more corners than are wanted (concave ones, the block's rear edge, the table)
    or fewer. First each profile is laid along the target by the distances between its corners; the
    pose that comes of this then tells, for every profile, where each corner must be.
    """

    target: StepTarget
    rule: CornerRule = field(default_factory=CornerRule)

    kind = "step"
    fewest = 1
    read_by_poses = True

    def read(
        self,
        data: HandEyeData,
        T_flange_sensor: Array | None = None,
        linearity: SensorLinearity | None = None,
    ) -> Read:
        """Corners, each with its mark."""
        corners = self._told(data)
        data, (fits, errors), linearity = straightened(
            data, lambda profile: _corners(profile, self.rule), _on_surfaces, self,
            self.rule.towards, linearity,
        )  # fmt: skip
        rejected = {name: str(error) for name, error in errors.items()}
        usable(fits, rejected, self.fewest, "corners")
        if T_flange_sensor is None:
            T_flange_sensor = self._rough(data, fits, corners)
        matches = {}
        for i, fit in fits.items():
            T = np.broadcast_to(data.T_base_flange[i] @ T_flange_sensor, (len(corners[i]), 4, 4))
            predicted = self.model(corners[i]).see(T, self.target.T_base_user).value
            match = _match_nearest(fit, predicted[:, :2], self.target.convex)
            if len(match[0]):
                matches[i] = match
            else:
                rejected[data.names[i]] = "shows no corner where the target's must be"
        view = self._view(data, fits, corners, matches)
        usable(view.sightings.names, rejected, self.fewest, "the corners")
        pulled = {}
        if linearity is not None:
            rows = [(fits[i], row) for i, match in matches.items() for row in match[0]]
            for name, (fit, row) in zip(view.sightings.names, rows, strict=True):
                own = SeenCorner(fit.points[row], fit.sides[row])
                pulled[name] = linearity.pull(own, self.rule.towards)
        return Read(view, rejected, linearity=linearity, pulled=pulled)

    def _rough(
        self, data: HandEyeData, fits: Mapping[int, CornerFit], corners: Sequence[Array]
    ) -> Array:
        """Where the sensor sits, by the profiles that show the whole target, and only in one way.

        Where corners are nearly in line the closed form alone may be far off.
        """
        matches = self._along(fits, corners)
        view = self._view(data, fits, corners, matches)
        near = first_look((view,), self.starts(view)[0])
        if (miss := misfit((view,), near)) > TURNED_M:
            view = self._view(data, fits, corners, _turned(matches))
            other = first_look((view,), self.starts(view)[0])
            near = other if misfit((view,), other) < TURNED * miss else near
        return near.T_flange_sensor

    def _along(self, fits: Mapping[int, CornerFit], corners: Sequence[Array]) -> dict[int, Match]:
        """Profiles that show the whole target, and only in one way, laid along it."""
        convex = self.target.convex
        kinds = None if convex is None else tuple(map(bool, convex))
        matches = {}
        for i, fit in fits.items():
            apart = tuple(np.linalg.norm(np.diff(corners[i], axis=0), axis=1).tolist())
            match = _match_along(fit, apart, kinds, self.target.sigma_m)
            if match is not None:
                matches[i] = match
        if not matches:
            shown = ", ".join(f"{len(fit.points)}" for fit in fits.values())
            raise ResidualError(
                f"no profile shows all {len(corners[0])} corners of the target alone, in one place "
                f"(they show {shown} corners, concave ones too): check the target file and the "
                "field of view, and keep what looks like one step more out of it"
            )
        return matches

    def _view(
        self,
        data: HandEyeData,
        fits: Mapping[int, CornerFit],
        corners: Sequence[Array],
        matches: Mapping[int, Match],
    ) -> TargetView:
        """The matched corners as sightings."""
        shots, names, values, covariances, shown = [], [], [], [], []
        for i, match in matches.items():
            for row, k in zip(*match, strict=True):
                shots.append(i)
                names.append(f"{data.names[i]}/corner {k + 1}")
                values.append([*fits[i].points[row], 0.0])
                spread = self.target.sigma_m**2 * np.eye(3)
                spread[:2, :2] += fits[i].covariance[row]
                covariances.append(spread)
                shown.append(corners[i][k])
        value, covariance = np.array(values), np.array(covariances)
        sightings = sightings_of(
            data, shots, names, value.reshape(-1, 3), covariance.reshape(-1, 3, 3)
        )
        return TargetView(self.model(np.array(shown).reshape(-1, 3)), sightings)

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """Which corner is which depends on the poses; hopeless ones are not followed to tell it.

        Raises `ResidualError` where the closed form leaves corners `HOPELESS_M` from their places.
        """
        fits, _ = fitted(data, lambda profile: _corners(profile, self.rule))
        corners = self._told(data)
        matches = self._along(fits, corners)
        for each in (matches, _turned(matches)):
            one = self._view(data, fits, corners, each)
            if misfit((one,), self.starts(one)[0]) < HOPELESS_M:
                return self.read(data).view
        raise ResidualError("the corners do not fit these poses")

    def _told(self, data: HandEyeData) -> list[Array]:
        """Places (k, 3) of the corners that each shot shows, user frame, by its mark."""
        known = self.target.corners
        marks = data.marks or (next(iter(known)),) * len(data.names)
        self.target.require_marks(marks)
        return [known[mark] for mark in marks]

    def starts(self, view: TargetView) -> list[MountState]:
        """The closed form of the part of corners that agrees best, then of those near them."""
        value, p_flange = view.sightings.value, _in_flange(view)
        best = closed_corners(value, p_flange)
        rows = _parts(len(value))
        X, seen = _closed(value[rows], p_flange[rows])
        median = np.median(_corners_apart(X, value, p_flange), axis=1)
        median[~seen] = np.inf
        first = int(np.argmin(median))
        if seen[first]:
            best = X[first]
        near = _corners_apart(best, value, p_flange) <= 3.0 * median[first]
        with suppress(RankDeficientError, TooFewSamplesError):
            best = closed_corners(value[near], p_flange[near])
        return [MountState(best, (self.target.T_base_user,))]

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The nine unknowns of all corners, as published."""
        X = nine_unknowns(view.sightings.value, _in_flange(view))
        return MountState(X, (self.target.T_base_user,))

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """The taught user frame."""
        return self.target.T_base_user

    def found(self, place: Array) -> Document:
        """The user frame."""
        return {"T_base_user": transform_document(place)}

    def more(self, fit: MountFit, read: Read) -> Document:
        """How well the light was laid on the marks."""
        return {"aim_sigma_mm": fit.noise.aim_m * 1e3}

    def suspects(self) -> Iterable[tuple[str, Task]]:
        """The corners in a left-handed frame; the marks exchanged."""
        marks = self.target.corners
        left = {mark: np.array([-1.0, 1.0, 1.0]) * places for mark, places in marks.items()}
        words = "the corners fit when their x is negated: the target file is left-handed"
        yield words, replace(self, target=replace(self.target, corners=left))
        if len(marks) == 2:
            exchanged = dict(zip(marks, list(marks.values())[::-1], strict=True))
            words = f"they fit with the marks {' and '.join(marks)} exchanged"
            yield words, replace(self, target=replace(self.target, corners=exchanged))

    def model(self, corner_user: Array) -> CornerModel:
        """Corners (m, 3), user frame, with what is known of that frame."""
        target = self.target
        sigma = np.repeat([target.user_sigma_m, target.user_sigma_rad], 3)
        taught = np.maximum(sigma, SMALLEST_SIGMA) if np.any(sigma) else None
        return CornerModel(corner_user, target.edge_user, target.T_base_user, taught)


def _on_surfaces(fit: CornerFit, profile: Profile) -> list[SeenLine]:
    """Points of a profile on each surface."""
    once = {id(side): side for pair in fit.sides for side in pair}
    return beside_corners(once.values(), fit.points)


@lru_cache(maxsize=PROFILES)
def _corners(profile: Profile, rule: CornerRule) -> CornerFit:
    """Corners of a profile: they do not depend on poses, which may be tried in many ways."""
    return fit_corners(profile.points, rule)


@lru_cache
def _parts(m: int) -> Index:
    """Rows (50, k) of m corners: parts of which one holds no wrong corner, very likely."""
    rng = np.random.default_rng(SEED)
    return np.array([rng.permutation(m)[: max(4, m // 3)] for _ in range(PARTS)])


def _in_flange(view: TargetView) -> Array:
    """Marks (m, 3) of a view in the flange frame of their pose."""
    if not isinstance(view.model, CornerModel):
        raise ValueError("a view of corners is needed")
    T = frames.invert(view.sightings.T_base_flange) @ view.model.T_base_user
    return frames.apply(T, view.model.corner_user)


def closed_corners(value: Array, p_flange: Array) -> Array:
    """Classic closed form: X (4, 4) from corners (m, 3) = (x, z, .) at flange points (m, 3).

    The nine unknowns of p = x r1 + z r3 + t, projected to a rotation and refined on it, are the
    rotation of the corners' cross-covariance (Kabsch 1976): the least squares of their distances.

    Raises `TooFewSamplesError`: fewer than three corners; `RankDeficientError` when all corners lie
    on one line of the laser plane.
    """
    if len(value) < 3:
        raise TooFewSamplesError(f"{len(value)} corners fit the target, at least 3 are needed")
    X, seen = _closed(value, p_flange)
    if not seen:
        words = "rotation about the line of the corners"
        raise RankDeficientError(
            f"not determined: {words}: all corners lie on one line of the laser plane; show the "
            "target from several poses, or a second line of corners",
            [words],
        )
    return X


def nine_unknowns(value: Array, p_flange: Array) -> Array:
    """X (4, 4) from corners (m, 3) = (x, z, .) at flange points (m, 3), as published.

    p = x r1 + z r3 + t by linear least squares (step-target paper, eqs. 12 to 15), then the second
    column r2 = r3 x r1 (its eq. 16 has them the other way round, which is left-handed) and the
    rotation nearest to the three.
    """
    closed_corners(value, p_flange)  # refuses what is not determined
    A = np.column_stack([value[:, :2], np.ones(len(value))])
    r1, r3, t = np.linalg.lstsq(A, p_flange, rcond=None)[0]
    R = frames.nearest_rotation(np.column_stack([r1, np.cross(r3, r1), r3]))
    return frames.transform(R, t)


def _closed(value: Array, p_flange: Array) -> tuple[Array, NDArray[np.bool_]]:
    """Closed forms X (..., 4, 4) of corners (..., m, 3), and whether these show them at all."""
    own = in_plane(value)
    middle, there = own.mean(axis=-2, keepdims=True), p_flange.mean(axis=-2, keepdims=True)
    s = np.linalg.svd(own - middle, compute_uv=False)
    R = frames.nearest_rotation(np.swapaxes(p_flange - there, -1, -2) @ (own - middle))
    t = (there - middle @ np.swapaxes(R, -1, -2))[..., 0, :]
    return frames.transform(R, t), np.asarray(s[..., 1] > NO_STRETCH * s[..., 0])


def _corners_apart(X: Array, value: Array, p_flange: Array) -> Array:
    """Distances (..., m) of corners that poses (..., 4, 4) put into the flange frame."""
    found = in_plane(value) @ np.swapaxes(X[..., :3, :3], -1, -2) + X[..., None, :3, 3]
    return np.asarray(np.linalg.norm(found - p_flange, axis=-1))


def _turned(matches: Mapping[int, Match]) -> dict[int, Match]:
    """The same, the corners in the other order."""
    return {i: (rows, order[::-1]) for i, (rows, order) in matches.items()}


@lru_cache(maxsize=PROFILES)
def _match_along(
    fit: CornerFit, spacing: tuple[float, ...], convex: tuple[bool, ...] | None, sigma_m: float
) -> Match | None:
    """Lay a profile's corners along all of a target, so far apart; None where it is not clear.

    ``convex``: which of the target's are outer edges, None where nothing is told. ``sigma_m``: of
    a target's corner.
    """
    k, apart = len(spacing) + 1, np.array(spacing)
    every = np.arange(len(fit.points))
    found: list[tuple[float, Index]] = []
    for rows in (every, every[fit.convex], every[~fit.convex]):
        for first in range(len(rows) - k + 1):
            window = rows[first : first + k]
            kinds = tuple(map(bool, fit.convex[window]))
            if convex is not None and kinds not in (convex, convex[::-1]):
                continue
            own = np.linalg.norm(np.diff(fit.points[window], axis=0), axis=1)
            off = min(_unlike(own, apart), _unlike(own, apart[::-1]))
            if not any(np.array_equal(window, other) for _, other in found):
                found.append((off, window))
    found.sort(key=lambda pair: pair[0])
    if not found:
        return None
    if len(found) > 1:
        # Corners of equal steps are equally far apart: which fits better, is then chance.
        sigma = float(np.hypot(sigma_m, fit.noise_m)) / min(spacing, default=np.inf)
        chance = SURE * sigma * np.sqrt(2.0 / max(k - 1, 1))
        if found[1][0] <= max(CLEAR * found[0][0], found[0][0] + chance):
            return None
    return found[0][1], np.arange(k)


def _unlike(own: Array, spacing: Array) -> float:
    """How unlike distances are, a common scale counting little: a tilted plane stretches them."""
    if not len(own):
        return 0.0
    ratio = own / spacing
    return float(np.std(ratio) + 0.1 * abs(np.mean(ratio) - 1.0))


def _match_nearest(fit: CornerFit, predicted: Array, convex: Array | None) -> Match:
    """The corners that lie where the target's (k, 2) are predicted, sensor frame, m.

    ``convex`` (k,): which of the target's are outer edges, None where nothing is told.
    """
    gap = np.linalg.norm(fit.points[:, None] - predicted[None], axis=2)
    if convex is not None:
        gap[fit.convex[:, None] != convex] = np.inf
    apart = np.linalg.norm(predicted[:, None] - predicted[None], axis=2)
    apart[np.diag_indices_from(apart)] = np.inf
    rows = np.argmin(gap, axis=0)
    least = gap[rows, np.arange(len(predicted))]
    mine = np.argmin(gap, axis=1)[rows] == np.arange(len(predicted))
    near = mine & (least < NEAR * apart.min(axis=1))
    return rows[near].astype(np.int64), np.flatnonzero(near).astype(np.int64)


def task_of(
    target: LaserTarget | None, feature: str | None, classic: bool = False, towards: bool = False
) -> Task:
    """The estimator's view of a target, of a line by its ``feature``.

    ``classic``: corners and edges in the published form; ``towards``: z grows towards the sensor.
    """
    if isinstance(target, SphereTarget):
        return SphereTask(target, towards, plain=classic)
    if isinstance(target, StepTarget):
        return StepTask(target, CornerRule(towards, classic=classic), plain=classic)
    kind: Kind = "groove" if feature == "groove" else "edge"
    return LineTask(target, EdgeRule(towards, kind=kind, classic=classic), plain=classic)
