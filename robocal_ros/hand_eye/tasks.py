"""One task per target: read its features from profiles, start, solve in the classic way."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.arc import ArcRule, fit_arc
from robocal_ros.estimation.edge import EdgeRule, fit_edge
from robocal_ros.ground.errors import InputError, RobocalError, TooFewSamplesError
from robocal_ros.hand_eye.edge_start import least_distances, line_starts
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import MountState, TargetView
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.result import TargetKind
from robocal_ros.hand_eye.sightings import Sightings, TargetModel, same_pose
from robocal_ros.hand_eye.sphere_start import (
    FEWEST_PROFILES,
    agreed_centre,
    classic_sphere,
    sphere_starts,
)
from robocal_ros.hand_eye.target_models import LineModel, SphereModel
from robocal_ros.hand_eye.targets import LineTarget, SphereTarget

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
