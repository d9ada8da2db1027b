"""What profiles show of a target, and how a model of the target predicts it.

Each profile is reduced to features that hold all it says (Fisher information) about where the
target is: the circle that the laser plane cuts out of a sphere (x0, z0, r), or the point where an
edge pierces that plane (x, z), for a marked edge with the place along it.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SAME = 2e-4  # m, and rad: readings of a robot at rest differ by less, poses on purpose by more
COMPONENTS = 3  # of every sighting; a model with fewer leaves the last ones empty


@dataclass(frozen=True, eq=False)
class Sightings:
    """Features (m) of one target.

    Attributes
    ----------
    names : of the features, for reports.
    shot : (m,) index of the shot that each was seen in.
    pose : (m,) index of the pose that it was taken from, as of `same_pose`: those with one index
        share its error.
    T_base_flange : (m, 4, 4) reported pose of each.
    value : (m, 3), m; covariance : (m, 3, 3). Empty components have value 0 and variance 1.
    """

    names: tuple[str, ...]
    shot: Index
    pose: Index
    T_base_flange: Array
    value: Array
    covariance: Array

    def take(self, rows: NDArray[np.bool_] | Index) -> "Sightings":
        """Those at ``rows`` (mask or index)."""
        index = np.arange(len(self.names))[rows]
        return Sightings(
            tuple(self.names[i] for i in index),
            self.shot[index],
            self.pose[index],
            self.T_base_flange[index],
            self.value[index],
            self.covariance[index],
        )


def same_pose(T_base_flange: Array) -> Index:
    """Of poses (m, 4, 4) the index (m,) of the first that is the same to `SAME`.

    What errs in a pose is common to all that is seen from it, however often: only what the sensor
    itself errs by is drawn anew.
    """
    place = T_base_flange[:, :3].reshape(-1, 12)
    near = cKDTree(place).query_ball_point(place, SAME, p=np.inf)
    return np.array([min(rows) for rows in near], dtype=np.int64)


def in_plane(value: Array) -> Array:
    """Points (..., 3) of the laser plane, sensor frame, from features (..., 3) that begin x, z."""
    return np.stack([value[..., 0], np.zeros(value.shape[:-1]), value[..., 1]], axis=-1)


@dataclass(frozen=True, eq=False)
class Seen:
    """What a model predicts for m sightings.

    Attributes
    ----------
    value : (m, 3) predicted features.
    point : (m, 3) the point of the target that is seen, sensor frame, m.
    slope : (m, 3, 3) change of the value as that point moves with the target, sensor axes.
    spread : (m, 3, k) displacement of that point, base axes, for each unknown of the target.
    aim : (m, 3, 2) change of the value with how the light was laid on the target by eye, which all
        sightings of one pose have in common; None where nothing is laid by eye.
    """

    value: Array
    point: Array
    slope: Array
    spread: Array
    aim: Array | None = None


class TargetModel(Protocol):
    """A target with k unknowns of its own; ``place`` is whatever says where it is."""

    @property
    def names(self) -> tuple[str, ...]:
        """Names (k) of the unknowns."""

    @property
    def components(self) -> int:
        """How many of the three components of a sighting it has."""

    @property
    def prior(self) -> Array:
        """Information (k, k) about the unknowns beforehand."""

    def see(self, T_base_sensor: Array, place: Array) -> Seen:
        """Predict the sightings from sensor poses (m, 4, 4)."""

    def moved(self, place: Array, step: Array) -> Array:
        """The place after an increment (k,) of the unknowns."""

    def deviation(self, place: Array) -> Array:
        """Distance (k,) of the place from the prior's mean."""

    def distance(self, T_base_sensor: Array, place: Array, value: Array) -> Array:
        """How far (m,) sightings (m, 3), put into base, are from the target, m."""

    def take(self, rows: NDArray[np.bool_] | Index) -> "TargetModel":
        """The model for the sightings at ``rows``."""
