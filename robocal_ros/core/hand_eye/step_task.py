"""The staircase: corners at known places, laid under the laser mark by mark."""

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.documents import transform_document
from robocal_ros.core.errors import InputError, RobocalError
from robocal_ros.core.fitting.polyline import CornerFit, CornerRule, fit_corners
from robocal_ros.core.hand_eye.edge_start import linear_corners, robust_corners
from robocal_ros.core.hand_eye.mount_problem import MountState, View
from robocal_ros.core.hand_eye.sightings import Sightings
from robocal_ros.core.hand_eye.target_models import CornerModel
from robocal_ros.core.hand_eye.targets import StepTarget
from robocal_ros.core.hand_eye.tasks import HandEyeData, Read, seen, usable

Array = NDArray[np.float64]
Document = dict[str, Any]


@dataclass(frozen=True, eq=False)
class StepTask:
    """Corners of a staircase."""

    target: StepTarget
    kind: Literal["step"] = field(default="step", init=False)
    fewest: int = field(default=1, init=False)

    def read(self, data: HandEyeData) -> Read:
        """Corners, each with its mark."""
        marks = self._marks(data)
        rejected: dict[str, str] = {}
        fits: dict[str, tuple[int, CornerFit]] = {}
        for i, (name, profile) in enumerate(zip(data.names, data.profiles, strict=True)):
            try:
                rule = CornerRule(count=len(self.target.corners[marks[i]]))
                fits[name] = i, fit_corners(seen(profile), rule)
            except RobocalError as error:
                rejected[name] = str(error)
        usable(fits, rejected, self.fewest, "the corners")
        views = [self._view(data, marks, fits, order) for order in (1, -1)]
        start = [self._start(view) for view in views]
        miss = [float(np.median(_distances(v, X))) for v, X in zip(views, start, strict=True)]
        return Read(views[int(np.argmin(miss))], rejected)

    def _marks(self, data: HandEyeData) -> tuple[str, ...]:
        known = tuple(self.target.corners)
        marks = data.marks or (known[0],) * len(data.names)
        strange = next((mark for mark in marks if mark not in known), None)
        if strange is not None:
            raise InputError(f"mark '{strange}' is not one of {', '.join(known)}")
        return marks

    def _view(
        self,
        data: HandEyeData,
        marks: tuple[str, ...],
        fits: dict[str, tuple[int, CornerFit]],
        order: int,
    ) -> View:
        """All corners, numbered along the laser line or (order -1) against it."""
        names, poses, values, covariances, corners = [], [], [], [], []
        for name, (i, fit) in fits.items():
            places = self.target.corners[marks[i]][::order]
            for k in np.flatnonzero(~fit.repaired):
                names.append(f"{name}/corner {k + 1}")
                poses.append(i)
                values.append([*fit.points[k], 0.0])
                spread = np.zeros((3, 3))
                spread[:2, :2] = fit.covariance[k]
                covariances.append(spread + self.target.sigma_m**2 * np.eye(3))
                corners.append(places[k])
        pose = np.array(poses, dtype=np.int64)
        sightings = Sightings(
            tuple(names), pose, data.T_base_flange[pose], np.array(values), np.array(covariances)
        )
        target = self.target
        model = CornerModel(
            np.array(corners), target.edge_user, target.T_base_user, self._information()
        )
        return View(model, sightings)

    def _information(self) -> Array | None:
        """About the teaching error of the user frame; None where it is exact."""
        sigma = np.repeat([self.target.user_sigma_m, self.target.user_sigma_rad], 3)
        if not np.any(sigma):
            return None
        return np.diag(1.0 / np.maximum(sigma, np.repeat([1e-7, 1e-7], 3)) ** 2)

    def _start(self, view: View) -> Array:
        return robust_corners(view.sightings.value, _in_flange(view))

    def starts(self, view: View) -> list[MountState]:
        """The closed form of the corners that agree."""
        return [MountState(self._start(view), (self.target.T_base_user,))]

    def classic(self, view: View, near: MountState) -> MountState:
        """The closed form of all corners."""
        X = linear_corners(view.sightings.value, _in_flange(view))
        return MountState(X, (self.target.T_base_user,))

    def found(self, place: Array) -> Document:
        """The user frame."""
        return {"T_base_user": transform_document(place)}


def _in_flange(view: View) -> Array:
    """Marks (m, 3) of a view in the flange frame of their pose."""
    model = view.model
    if not isinstance(model, CornerModel):
        raise ValueError("a view of corners is needed")
    T = frames.invert(view.sightings.T_base_flange) @ model.T_base_user
    return np.asarray(np.einsum("mij,mj->mi", T[:, :3, :3], model.corner_user) + T[:, :3, 3])


def _distances(view: View, X: Array) -> Array:
    s = view.sightings
    place = view.model
    if not isinstance(place, CornerModel):
        raise ValueError("a view of corners is needed")
    return view.model.distance(s.T_base_flange @ X, place.T_base_user, s.value)
