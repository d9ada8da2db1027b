"""Two faces of a cube and a sphere beside it, seen by a laser tracker or by a sensor.

Both see the temporary frame K: origin in the sphere's centre, axes along the faces' outward
normals, made orthonormal in the same way on both sides (Jing, Hu and Guo 2020, section 3.2).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.surfaces import MAD
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.hand_eye.tracker_data import FACES
from robocal_ros.hand_eye.tracker_flange import angle_between, two_axis_frame

Array = NDArray[np.float64]

NARROWEST_M = 5e-3  # rms extent of the points on a face in its narrower direction
REJECT = 5.0  # standard deviations
LARGEST_SCATTER = 10.0  # of the points of a face, over the tracker's noise
PARALLEL_FACES = float(np.cos(np.radians(20.0)))


@dataclass(frozen=True, eq=False)
class Plane:
    """Points p with ``normal @ p = offset``."""

    normal: Array
    offset: float
    middle: Array

    def distances(self, points: Array) -> Array:
        """Distances (n,) of points (n, 3), m."""
        return np.abs(points @ self.normal - self.offset)

    def away_from(self, point: Array) -> "Plane":
        """The same plane with the normal that points away from a point (3,)."""
        if self.normal @ point <= self.offset:
            return self
        return Plane(-self.normal, -self.offset, self.middle)


@dataclass(frozen=True, eq=False)
class Cube:
    """Two faces by outward normals (2, 3) and offsets (2,), and the sphere's centre (3,), m."""

    normals: Array
    offsets: Array
    centre: Array

    @property
    def frame(self) -> Array:
        """Pose (4, 4) of K in the frame of the observer."""
        return frames.transform(two_axis_frame(*self.normals), self.centre)

    @property
    def angle(self) -> float:
        """Angle between the normals, rad."""
        return angle_between(*self.normals)

    @property
    def heights(self) -> Array:
        """Distances (2,) of the sphere's centre above the faces, m."""
        return np.asarray(self.normals @ self.centre - self.offsets)


def moment(points: Array) -> Array:
    """Sum (4, 4) of the outer products of homogeneous points (n, 3)."""
    homogeneous = np.insert(points, 3, 1.0, axis=1)
    return np.asarray(homogeneous.T @ homogeneous)


def fit_plane(sums: Array) -> tuple[Plane, Array]:
    """Plane nearest to points of this `moment`, and their rms extents (3,), the least one last."""
    middle = sums[:3, 3] / sums[3, 3]
    size, axes = np.linalg.eigh(sums[:3, :3] / sums[3, 3] - np.outer(middle, middle))
    normal = axes[:, 0]
    return Plane(normal, float(normal @ middle), middle), np.sqrt(np.maximum(size[::-1], 0.0))


def outward(first: Plane, second: Plane) -> tuple[Plane, Plane]:
    """The same planes with outward normals: a face of a cube lies behind the other's plane."""
    return first.away_from(second.middle), second.away_from(first.middle)


def tracked_cube(
    faces: Sequence[Array], sphere: Array, reflector_radius_m: float, sigma_m: float
) -> Cube:
    """The target from reflector centres on two faces (k, 3) and on the sphere's centre (k, 3).

    Raises
    ------
    RankDeficientError
        When the points of a face lie on a line, or the faces are parallel.
    ResidualError
        When the points of a face miss a plane, or those of the sphere's centre differ.
    """
    first, second = outward(
        *(_tracked_face(*face, sigma_m) for face in zip(FACES, faces, strict=True))
    )
    normals = np.array([first.normal, second.normal])
    if abs(normals[0] @ normals[1]) > PARALLEL_FACES:
        raise RankDeficientError(
            "face_1 and face_2 are parallel: touch two faces that meet in an edge",
            ["turn about the normal of the faces"],
        )
    centre = np.median(sphere, axis=0)
    spread = float(np.linalg.norm(sphere - centre, axis=1).max())
    if spread > 2.0 * REJECT * sigma_m:
        raise ResidualError(
            f"the tracker's centres of the sphere differ by {spread * 1e3:.3f} mm (noise "
            f"{sigma_m * 1e3:.3f} mm): seat the reflector again and measure anew"
        )
    offsets = np.array([first.offset, second.offset]) - reflector_radius_m
    return Cube(normals, offsets, sphere.mean(axis=0))


def _tracked_face(name: str, points: Array, sigma_m: float) -> Plane:
    plane, extent = fit_plane(moment(points))
    if extent[1] < NARROWEST_M:
        raise RankDeficientError(
            f"the tracker points on {name} lie nearly on a line (rms width "
            f"{extent[1] * 1e3:.1f} mm, at least {NARROWEST_M * 1e3:.0f}): spread them over "
            "the face",
            [f"turn of {name} about a line"],
        )
    miss = plane.distances(points)
    scatter = max(sigma_m, MAD * float(np.median(miss)))
    if miss.max() > REJECT * scatter or scatter > LARGEST_SCATTER * sigma_m:
        raise ResidualError(
            f"{name}: point {int(np.argmax(miss)) + 1} of {len(points)} lies "
            f"{miss.max() * 1e3:.3f} mm beside the plane of the others (noise "
            f"{sigma_m * 1e3:.3f} mm): clean the face, and check that all points are of one face"
        )
    return plane
