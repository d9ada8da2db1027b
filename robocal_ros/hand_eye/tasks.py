"""One task per target: read its features from profiles, start, solve in the classic way."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.arc import ArcRule, fit_arc
from robocal_ros.estimation.edge import EdgeRule, fit_edge
from robocal_ros.estimation.polyline import CornerFit, CornerRule, fit_corners
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.mount_fit import MountFit, explain, first_look, misfit, undone
from robocal_ros.hand_eye.mount_problem import MountState, TargetView
from robocal_ros.hand_eye.result import TargetKind
from robocal_ros.hand_eye.shots import Profile
from robocal_ros.hand_eye.starts import (
    FEWEST_PROFILES,
    Match,
    agreed_centre,
    along,
    classic_sphere,
    closed_corners,
    least_distances,
    line_starts,
    nearest,
    robust_corners,
    sphere_starts,
)
from robocal_ros.hand_eye.target_models import (
    CornerModel,
    LineModel,
    Sightings,
    SphereModel,
    TargetModel,
    same_pose,
)
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget, StepTarget

Array = NDArray[np.float64]
Document = dict[str, Any]

RADII = (0.8, 0.83, 0.86, 0.89, *np.arange(0.91, 1.1, 0.01), 1.12, 1.15, 1.2, 1.25)  # as told: 1


@dataclass(frozen=True, eq=False)
class HandEyeData:
    """Shots of one target.

    Attributes
    ----------
    names : (m) of the shots; T_base_flange : (m, 4, 4) as the robot reports them.
    profiles : (m) what the sensor saw, or why that cannot be used.
    marks : (m) mark of a staircase that each laser plane was laid through, or None.
    """

    names: tuple[str, ...]
    T_base_flange: Array
    profiles: Sequence[Profile | RobocalError]
    marks: tuple[str, ...] | None = None


@dataclass(frozen=True, eq=False)
class Read:
    """Features of a data set.

    Attributes
    ----------
    view : of the features; rejected: which shots gave none, and why.
    points : profile points (n, 2) that each feature rests on, where they are on the target.
    """

    view: TargetView
    rejected: Mapping[str, str]
    points: Mapping[str, Array] = field(default_factory=dict)


class Task(Protocol):
    """A kind of target."""

    @property
    def kind(self) -> TargetKind:
        """Its name."""

    @property
    def fewest(self) -> int:
        """Profiles without which nothing is solved."""

    @property
    def read_by_poses(self) -> bool:
        """Whether poses tell which feature of a profile is which."""

    def read(self, data: HandEyeData, T_flange_sensor: Array | None = None) -> Read:
        """Features of profiles. Raises `RobocalError` when fewer give any than solving needs.

        Where the sensor is known to sit, one will do.
        """

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """The same features from other poses, those of ``data``."""

    def starts(self, view: TargetView) -> list[MountState]:
        """First states, best first."""

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The classic estimate; ``near`` is a state near the solution."""

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """Where the target is, roughly, if the sensor sits there."""

    def found(self, place: Array) -> Document:
        """What was found of the target."""

    def more(self, fit: MountFit, read: Read) -> Document:
        """Further figures of a fit."""

    def suspects(self) -> Iterable[tuple[str, "Task"]]:
        """Mistakes in what is told of the target: in words, and the task without it."""


def usable(rows: Collection[str], rejected: Mapping[str, str], fewest: int, what: str) -> None:
    """Refuse when fewer than ``fewest`` shots gave a feature.

    Raises
    ------
    TooFewSamplesError
        With the commonest reason.
    """
    if len(rows) >= fewest:
        return
    reasons = list(rejected.values())
    most = max(reasons, key=reasons.count, default="")
    because = f"; {len(reasons)} show none, most often because: {most}" if reasons else ""
    raise TooFewSamplesError(
        f"{len(rows)} profiles show {what}, at least {fewest} are needed{because}"
    )


@dataclass(frozen=True)
class SphereTask:
    """A sphere that stands still, somewhere."""

    target: SphereTarget
    kind: Literal["sphere"] = field(default="sphere", init=False)
    fewest: int = field(default=FEWEST_PROFILES, init=False)
    read_by_poses: bool = field(default=False, init=False)

    def read(self, data: HandEyeData, T_flange_sensor: Array | None = None) -> Read:
        """Circles."""
        rule = ArcRule(self.target.radius_m)
        found: dict[str, tuple[int, Array, Array]] = {}
        rejected, points = {}, {}
        unit: InputError | None = None
        for i, (name, profile) in enumerate(zip(data.names, data.profiles, strict=True)):
            try:
                arc = fit_arc(seen(profile), rule)
            except RobocalError as error:
                unit = error if isinstance(error, InputError) else unit
                rejected[name] = str(error)
                continue
            points[name] = seen(profile)[arc.used]
            found[name] = i, np.array([*arc.centre, arc.radius_m]), arc.covariance
        fewest = self.fewest if T_flange_sensor is None else 1
        if unit is not None and not found:
            raise unit  # no profile's fault: the radius is in another unit
        usable(found, rejected, fewest, "the sphere")
        view = TargetView(SphereModel(self.target.radius_m), _gathered(data, found))
        return Read(view, rejected, points)

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """Circles depend neither on poses nor on the radius."""
        return with_poses(view, SphereModel(self.target.radius_m), data.T_base_flange)

    def starts(self, view: TargetView) -> list[MountState]:
        """All sides of the laser plane are tried."""
        return sphere_starts(view.sightings, self.target.radius_m)

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """Linear differences."""
        return classic_sphere(view.sightings, self.target.radius_m, near)

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """The centre on which the profiles agree best, each on either side."""
        return agreed_centre(view.sightings, self.target.radius_m, T_flange_sensor)

    def found(self, place: Array) -> Document:
        """Its centre in base."""
        return {"center_mm": (place * 1e3).tolist(), "radius_mm": self.target.radius_m * 1e3}

    def suspects(self) -> Iterable[tuple[str, Task]]:
        """Other radii."""
        for share in RADII:
            radius_m = share * self.target.radius_m
            words = f"the profiles fit a sphere of radius {radius_m * 1e3:.3g} mm or so"
            yield f"{words}: check which sphere is mounted", SphereTask(SphereTarget(radius_m))

    def more(self, fit: MountFit, read: Read) -> Document:
        """How far profile points are from the sphere, all profiles together."""
        s, centre = fit.views[0].sightings, fit.state.places[0]
        far = []
        for name, T_base_flange in zip(s.names, s.T_base_flange, strict=True):
            x, z = read.points[name].T
            T = T_base_flange @ fit.state.T_flange_sensor
            base = np.outer(x, T[:3, 0]) + np.outer(z, T[:3, 2]) + T[:3, 3]
            far.append(np.linalg.norm(base - centre, axis=1) - self.target.radius_m)
        return {"point_residual_mm": float(np.sqrt(np.mean(np.concatenate(far) ** 2))) * 1e3}


@dataclass(frozen=True, eq=False)
class LineTask:
    """A straight edge or groove; ``target`` None where its place is unknown."""

    target: LineTarget | None
    rule: EdgeRule
    kind: Literal["line"] = field(default="line", init=False)
    read_by_poses: bool = field(default=False, init=False)

    @property
    def fewest(self) -> int:
        """Two equations each."""
        return 5 if self.target is None else 3

    def read(self, data: HandEyeData, T_flange_sensor: Array | None = None) -> Read:
        """Points of the edge."""
        found: dict[str, tuple[int, Array, Array]] = {}
        rejected = {}
        for i, (name, profile) in enumerate(zip(data.names, data.profiles, strict=True)):
            try:
                edge = fit_edge(seen(profile), self.rule)
            except RobocalError as error:
                rejected[name] = str(error)
                continue
            covariance = np.eye(3)
            covariance[:2, :2] = edge.covariance
            found[name] = i, np.array([*edge.point, 0.0]), covariance
        fewest = self.fewest if T_flange_sensor is None else 1
        usable(found, rejected, fewest, "the line")
        return Read(
            TargetView(LineModel(self.target is not None), _gathered(data, found)), rejected
        )

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """Points do not depend on poses."""
        return with_poses(view, view.model, data.T_base_flange)

    def starts(self, view: TargetView) -> list[MountState]:
        """Rotations, and directions of an unknown line, are tried."""
        line = None
        if self.target is not None:
            line = np.stack([self.target.point_base, self.target.direction_base])
        return line_starts(view.sightings, line)

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """Least squares of the distances from the line, all alike."""
        return least_distances(view, near)

    def placed(self, view: TargetView, T_flange_sensor: Array) -> Array:
        """The known line, or the one along the points."""
        if self.target is not None:
            return np.stack([self.target.point_base, self.target.direction_base])
        s = view.sightings
        T = s.T_base_flange @ T_flange_sensor
        x, z = s.value[:, :1], s.value[:, 1:2]
        points = x * T[:, :3, 0] + z * T[:, :3, 2] + T[:, :3, 3]
        middle = np.median(points, axis=0)
        return np.stack([middle, np.linalg.svd(points - middle)[2][0]])

    def found(self, place: Array) -> Document:
        """A point of it and its direction in base."""
        line = {"point_mm": (place[0] * 1e3).tolist(), "direction": place[1].tolist()}
        return {"line": line, "known": self.target is not None}

    def more(self, fit: MountFit, read: Read) -> Document:
        """None."""
        return {}

    def suspects(self) -> Iterable[tuple[str, Task]]:
        """None."""
        return ()


def seen(profile: Profile | RobocalError) -> Array:
    """Points (n, 2) of a profile.

    Raises
    ------
    RobocalError
        When there is none.
    """
    if isinstance(profile, RobocalError):
        raise profile
    return profile.points


def with_poses(view: TargetView, model: TargetModel, T_base_flange: Array) -> TargetView:
    """A view of a target from other poses (m, 4, 4)."""
    s = view.sightings
    pose = same_pose(T_base_flange)[s.shot]
    return TargetView(model, replace(s, pose=pose, T_base_flange=T_base_flange[s.shot]))


def _gathered(data: HandEyeData, found: Mapping[str, tuple[int, Array, Array]]) -> Sightings:
    shot = np.array([i for i, _, _ in found.values()], dtype=np.int64)
    return Sightings(
        tuple(found),
        shot,
        same_pose(data.T_base_flange)[shot],
        data.T_base_flange[shot],
        np.array([value for _, value, _ in found.values()]),
        np.array([covariance for _, _, covariance in found.values()]),
    )


# ---- the staircase: corners at known places, laid under the laser mark by mark ------------------


TURNED_M, TURNED = 5e-4, 0.3  # the order of the target file is kept unless it misses by so much
PROFILES = 256  # whose corners are remembered
SMALLEST_SIGMA = 1e-7  # m, rad: of a teaching error that is not zero in the other


@dataclass(frozen=True, eq=False)
class StepTask:
    """Corners of a staircase; ``rule`` says how they are found."""

    target: StepTarget
    rule: CornerRule = field(default_factory=CornerRule)
    kind: Literal["step"] = field(default="step", init=False)
    fewest: int = field(default=1, init=False)
    read_by_poses: bool = field(default=True, init=False)

    def read(self, data: HandEyeData, T_flange_sensor: Array | None = None) -> Read:
        """Corners, each with its mark."""
        reader = _Reader(self, data)
        if T_flange_sensor is None:
            T_flange_sensor = self._rough(reader)
        view = reader.view(reader.predicted(T_flange_sensor))
        usable(view.sightings.names, reader.rejected, self.fewest, "the corners")
        return Read(view, reader.rejected)

    def _rough(self, reader: "_Reader") -> Array:
        """Where the sensor sits, by the profiles that show the whole target."""
        matches = reader.sure()
        view = reader.view(matches)
        near = self._look(view)
        if (miss := misfit((view,), near)) > TURNED_M:
            other = reader.view({name: match.turned for name, match in matches.items()})
            turned = self._look(other)
            near = turned if misfit((other,), turned) < TURNED * miss else near
        return near.T_flange_sensor

    def _look(self, view: TargetView) -> MountState:
        """Where the closed form leads: alone it may be far off where corners are nearly in line."""
        return first_look((view,), self.starts(view)[0])

    def posed(self, view: TargetView, data: HandEyeData) -> TargetView:
        """Which corner is which depends on the poses."""
        return self.read(data).view

    def starts(self, view: TargetView) -> list[MountState]:
        """The closed form of the corners that agree."""
        X = robust_corners(view.sightings.value, _in_flange(view))
        return [MountState(X, (self.target.T_base_user,))]

    def classic(self, view: TargetView, near: MountState) -> MountState:
        """The closed form of all corners."""
        X = closed_corners(view.sightings.value, _in_flange(view))
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
        mirror = np.array([-1.0, 1.0, 1.0])
        words = "the corners fit when their x is negated: the target file is left-handed"
        yield words, self._with({mark: mirror * places for mark, places in marks.items()})
        if len(marks) == 2:
            words = f"they fit with the marks {' and '.join(marks)} exchanged"
            yield words, self._with(dict(zip(marks, list(marks.values())[::-1], strict=True)))

    def _with(self, corners: Mapping[str, Array]) -> Task:
        return replace(self, target=replace(self.target, corners=corners))

    def model(self, corner_user: Array) -> CornerModel:
        """Corners (m, 3), user frame, with what is known of that frame."""
        target = self.target
        sigma = np.repeat([target.user_sigma_m, target.user_sigma_rad], 3)
        information = None
        if np.any(sigma):
            information = np.diag(np.maximum(sigma, SMALLEST_SIGMA) ** -2.0)
        return CornerModel(corner_user, target.edge_user, target.T_base_user, information)


@lru_cache(maxsize=PROFILES)
def _corners(profile: Profile | RobocalError, rule: CornerRule) -> CornerFit:
    """Corners of a profile: they do not depend on poses, which may be tried in many ways."""
    return fit_corners(seen(profile), rule)


class _Reader:
    """Corners of all profiles; ``rejected`` collects shots that show none of the target's."""

    def __init__(self, task: StepTask, data: HandEyeData) -> None:
        self._task, self._data = task, data
        known = task.target.corners
        marks = data.marks or (next(iter(known)),) * len(data.names)
        require_marks(task.target, marks)
        self._corners = {name: known[m] for name, m in zip(data.names, marks, strict=True)}
        self.rejected: dict[str, str] = {}
        self._fits: dict[str, CornerFit] = {}
        for name, profile in zip(data.names, data.profiles, strict=True):
            try:
                self._fits[name] = _corners(profile, task.rule)
            except RobocalError as error:
                self.rejected[name] = str(error)
        usable(self._fits, self.rejected, task.fewest, "corners")

    def sure(self) -> dict[str, Match]:
        """Profiles that show the whole target, and only in one way."""
        found = {name: along(fit, self._corners[name]) for name, fit in self._fits.items()}
        sure = {name: match for name, match in found.items() if match is not None}
        if not sure:
            seen_ones = ", ".join(f"{len(fit.points)}" for fit in self._fits.values())
            wanted = len(next(iter(self._corners.values())))
            raise ResidualError(
                f"no profile shows all {wanted} corners of the target alone (they show {seen_ones} "
                "corners, concave ones too): check the target file and the field of view"
            )
        return sure

    def predicted(self, T_flange_sensor: Array) -> dict[str, Match]:
        """Corners of all profiles by where the target must be."""
        matches = {}
        for name, fit in self._fits.items():
            corners = self._corners[name]
            T = self._data.T_base_flange[self._data.names.index(name)] @ T_flange_sensor
            model = self._task.model(corners)
            place = self._task.target.T_base_user
            where = model.see(np.broadcast_to(T, (len(corners), 4, 4)), place).value
            match = nearest(fit, where[:, :2])
            if len(match.rows):
                matches[name] = match
            else:
                self.rejected[name] = "shows no corner where the target's must be"
        return matches

    def view(self, matches: Mapping[str, Match]) -> TargetView:
        """The matched corners as sightings."""
        names, shots, values, covariances, corners = [], [], [], [], []
        for name, match in matches.items():
            fit = self._fits[name]
            for row, k in zip(match.rows, match.corners, strict=True):
                names.append(f"{name}/corner {k + 1}")
                shots.append(self._data.names.index(name))
                values.append([*fit.points[row], 0.0])
                spread = self._task.target.sigma_m**2 * np.eye(3)
                spread[:2, :2] += fit.covariance[row]
                covariances.append(spread)
                corners.append(self._corners[name][k])
        shot, T_base_flange = np.array(shots, dtype=np.int64), self._data.T_base_flange
        sightings = Sightings(
            tuple(names),
            shot,
            same_pose(T_base_flange)[shot],
            T_base_flange[shot],
            np.array(values).reshape(-1, 3),
            np.array(covariances).reshape(-1, 3, 3),
        )
        return TargetView(self._task.model(np.array(corners).reshape(-1, 3)), sightings)


def require_marks(target: StepTarget, marks: Iterable[str]) -> None:
    """Refuse marks that the target does not have.

    Raises
    ------
    InputError
        Naming the first of them.
    """
    strange = next((mark for mark in marks if mark not in target.corners), None)
    if strange is not None:
        raise InputError(f"mark '{strange}' is not one of {', '.join(target.corners)}")


def _in_flange(view: TargetView) -> Array:
    """Marks (m, 3) of a view in the flange frame of their pose."""
    if not isinstance(view.model, CornerModel):
        raise ValueError("a view of corners is needed")
    T = frames.invert(view.sightings.T_base_flange) @ view.model.T_base_user
    return frames.apply(T, view.model.corner_user)


# ---- what is wrong with data that do not fit: the common mistakes, tried one by one -------------


DOUBTFUL_M = 2e-4  # median distance from which a mistake in the data is looked for
SHOWN = 0.5  # of the profiles
WRONG_M = 2e-3  # the same, from which something is wrong, whatever it is


def features(task: Task, data: HandEyeData) -> Read:
    """Features of the profiles.

    Raises
    ------
    ResidualError
        When poses must tell which feature is which, and do not: with the mistake that explains it.
    RobocalError
        When too little is seen.
    """
    try:
        return task.read(data)
    except InputError:
        raise
    except RobocalError as error:
        if task.read_by_poses:
            _name_mistake(task, data, None, np.inf, error)
        raise


def looked(task: Task, data: HandEyeData, read: Read) -> MountState:
    """A state near the solution.

    Raises
    ------
    ResidualError
        When the data do not fit: with the mistake that explains it, where one does.
    RobocalError
        When too little is seen, or the poses leave a direction open.
    """
    try:
        near = look(task, read.view)
    except RobocalError as error:
        _name_mistake(task, data, read, np.inf, error)
        raise
    as_given = misfit((read.view,), near) if _shown(read.view, data) else np.inf
    if as_given > DOUBTFUL_M:
        _name_mistake(task, data, read, as_given, None)
    if as_given > WRONG_M:
        off = f"samples are off by {misfit((read.view,), near) * 1e3:.3g} mm"
        raise ResidualError(
            f"{off} or do not show the target where it must be, and no common mistake explains it: "
            "has the target moved, are poses and profiles of the same run, is it the right target?"
        )
    return near


def _shown(view: TargetView, data: HandEyeData) -> bool:
    """Whether most of the profiles show the target where it must be."""
    usable = sum(isinstance(profile, Profile) for profile in data.profiles)
    return len(np.unique(view.sightings.shot)) > SHOWN * usable


def look(task: Task, view: TargetView) -> MountState:
    """The state nearest to the sightings to which a start leads, before the noise is known.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When none leads anywhere.
    """
    states: list[MountState] = []
    failure: RobocalError | None = None
    for start in task.starts(view):
        try:
            states.append(first_look((view,), start))
        except RobocalError as error:
            failure = failure or error
            if isinstance(error, RankDeficientError):
                break  # it lies in the poses, not in the start
    if not states:
        raise failure or RobocalError("no start was found")
    return min(states, key=lambda state: misfit((view,), state))


def _name_mistake(
    task: Task, data: HandEyeData, read: Read | None, as_given: float, error: RobocalError | None
) -> None:
    """Raise with the mistake that explains a misfit, m, or an error; nothing where none does."""

    def followed(task: Task, view: TargetView) -> float:
        if not _shown(view, data):
            return np.inf
        first = task.starts(view)[0]
        if (off := misfit((view,), first)) > as_given:  # not worth following
            return off
        return misfit((view,), first_look((view,), first))

    def with_poses(T_base_flange: Array) -> float:
        other = replace(data, T_base_flange=T_base_flange)
        return followed(
            task, task.read(other).view if read is None else task.posed(read.view, other)
        )

    def as_told(other: Task) -> float:
        known = None if read is None or task.read_by_poses else read.view
        return followed(other, other.read(data).view if known is None else other.posed(known, data))

    def suspects() -> Iterator[tuple[str, Callable[[], float]]]:
        for words, poses in undone(data.T_base_flange):
            yield words, partial(with_poses, poses)
        if read is not None and error is not None:
            return  # open directions lie in the poses, whatever is told of the target
        for words, other in task.suspects():
            yield words, partial(as_told, other)

    words = explain(suspects(), as_given)
    if words is None:
        return
    if not np.isfinite(as_given):
        raise ResidualError(f"the samples do not fit: {words}") from error
    raise ResidualError(f"samples are off by {as_given * 1e3:.3g} mm: {words}")
