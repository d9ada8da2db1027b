"""The staircase: corners at known places, laid under the laser mark by mark."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.polyline import CornerFit, CornerRule, fit_corners
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, ResidualError, RobocalError
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.corner_matching import Match, along, nearest
from robocal_ros.hand_eye.edge_start import closed_corners, robust_corners
from robocal_ros.hand_eye.mount_fit import MountFit, first_look, misfit
from robocal_ros.hand_eye.mount_problem import MountState, TargetView
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.sightings import Sightings, same_pose
from robocal_ros.hand_eye.target_models import CornerModel
from robocal_ros.hand_eye.targets import StepTarget
from robocal_ros.hand_eye.tasks import HandEyeData, Read, Task, seen, usable

Array = NDArray[np.float64]
Document = dict[str, Any]

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
