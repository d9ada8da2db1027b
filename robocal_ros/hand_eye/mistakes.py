"""Common mistakes in the data, recognised because undoing them makes everything fit."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import TargetView

Array = NDArray[np.float64]

CLEARLY = 0.4  # of the misfit as given: below it the undone data may be the right ones
FITS_M = 5e-4  # misfit of data that are right
FITS = 5.0  # times the rms of the others
FARTHEST_M, NEAREST_M = 20.0, 0.02  # of a flange from its base

LEFT_HANDED = "they come from a left-handed frame: turn one axis round"

_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def _mirrored(T: Array) -> Array:
    return np.asarray(_FLIP @ T @ _FLIP)


def _mirrored_place(T: Array, axis: int) -> Array:
    mirrored = T.copy()
    mirrored[:, axis, 3] *= -1.0
    return mirrored


def _real_first(T: Array) -> Array:
    """Rotations as they are if the four numbers were w, x, y, z."""
    return frames.transform_from_quat(T[:, :3, 3], np.roll(frames.quat_xyzw(T), -1, axis=1))


def _scaled(T: Array, factor: float) -> Array:
    return frames.transform(T[:, :3, :3], factor * T[:, :3, 3])


MISTAKES: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    (
        "each profile fits the pose after its own: the two lists are shifted by one",
        partial(np.roll, shift=-1, axis=0),
    ),
    (
        "each profile fits the pose before its own: the two lists are shifted by one",
        partial(np.roll, shift=1, axis=0),
    ),
    ("the poses fit when inverted: give the flange in the base, not the base in it", frames.invert),
    ("the poses fit when their quaternions are read as w, x, y, z: reorder them", _real_first),
    (f"the poses fit when mirrored as a whole: {LEFT_HANDED}", _mirrored),
    *(
        (
            f"the poses fit with {axis} of their positions negated: {LEFT_HANDED}",
            partial(_mirrored_place, axis=number),
        )
        for number, axis in enumerate("xyz")
    ),
)
"""What is wrong, in words, and what undoes it: poses (m, 4, 4) as they should have been."""


def undone(T_base_flange: Array) -> Iterator[tuple[str, Array]]:
    """Each mistake that may be in poses (m, 4, 4), in words, and the poses without it."""
    for words, undo in MISTAKES:
        yield words, undo(T_base_flange)
    far = float(np.linalg.norm(T_base_flange[:, :3, 3], axis=1).max())
    if far < NEAREST_M:
        words = "the poses fit when 1000 times larger: their positions are in m where mm are meant"
        yield words, _scaled(T_base_flange, 1e3)
    if far > FARTHEST_M:
        words = "the poses fit when 1000 times smaller: their positions are in mm where m are meant"
        yield words, _scaled(T_base_flange, 1e-3)


def explain(suspects: Iterable[tuple[str, Callable[[], float]]], as_given_m: float) -> str | None:
    """The words of the suspect with the smallest misfit, m; None where none fits."""
    best, least = None, min(CLEARLY * as_given_m, FITS_M)
    for words, misfit in suspects:
        try:
            found = misfit()
        except RobocalError:
            continue
        if found < least:
            best, least = words, found
    return best


def swapped(fit: MountFit, lost: TargetView, place: Array, shots: Sequence[str]) -> dict[str, str]:
    """Which rejected sightings fit the pose of another rejected shot: names and reasons.

    ``lost`` holds the rejected sightings; ``shots``: the name of each.
    """
    limit = FITS * float(np.sqrt(np.mean(fit.distances() ** 2)))
    s = lost.sightings
    found: dict[str, str] = {}
    for shot in np.unique(s.shot):
        rows = np.flatnonzero(s.shot == shot)
        for other in np.unique(s.shot[s.shot != shot]):
            T = s.T_base_flange[[np.flatnonzero(s.shot == other)[0]]] @ fit.state.T_flange_sensor
            own = lost.take(rows)
            far = own.model.distance(np.repeat(T, len(rows), axis=0), place, own.sightings.value)
            if np.median(far) < limit:
                words = f"fits the pose of {shots[other]}, not its own: swapped?"
                found |= {s.names[row]: words for row in rows}
    return found
