"""Common mistakes in the data, recognised because undoing them makes everything fit."""

from collections.abc import Callable, Iterable, Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.hand_eye.mount_fit import MountFit

Array = NDArray[np.float64]

CLEARLY = 0.4  # of the misfit as given: below it the undone data are the right ones
FITS = 5.0  # times the rms of the others

LEFT_HANDED = "they come from a left-handed frame: turn one axis round"


def _scaled(factor: float) -> Callable[[Array], Array]:
    def scale(T: Array) -> Array:
        return frames.transform(T[:, :3, :3], factor * T[:, :3, 3])

    return scale


_FLIP = np.diag([1.0, -1.0, 1.0, 1.0])


def _mirrored(T: Array) -> Array:
    return np.asarray(_FLIP @ T @ _FLIP)


def _mirrored_place(T: Array, axis: int) -> Array:
    mirrored = T.copy()
    mirrored[:, axis, 3] *= -1.0
    return mirrored


MISTAKES: tuple[tuple[str, Callable[[Array], Array]], ...] = (
    (
        "each profile fits the pose after its own: the two lists are shifted by one",
        lambda T: np.roll(T, -1, axis=0),
    ),
    (
        "each profile fits the pose before its own: the two lists are shifted by one",
        lambda T: np.roll(T, 1, axis=0),
    ),
    ("the poses fit when inverted: give the flange in the base, not the base in it", frames.invert),
    (f"the poses fit when mirrored as a whole: {LEFT_HANDED}", _mirrored),
    *(
        (
            f"the poses fit with {axis} of their positions negated: {LEFT_HANDED}",
            partial(_mirrored_place, axis=number),
        )
        for number, axis in enumerate("xyz")
    ),
    (
        "the poses fit when 1000 times larger: their positions are in m where mm are expected",
        _scaled(1e3),
    ),
    (
        "the poses fit when 1000 times smaller: their positions are in mm where m are expected",
        _scaled(1e-3),
    ),
)
"""What is wrong, in words, and what undoes it: poses (m, 4, 4) as they should have been."""


def undone(
    misfit_with: Callable[[Array], float], T_base_flange: Array
) -> Iterator[tuple[str, Callable[[], float]]]:
    """Each mistake in poses (m, 4, 4) in words, and the misfit, m, once it is undone.

    ``misfit_with`` solves with other poses.
    """
    for words, undo in MISTAKES:
        yield words, partial(misfit_with, undo(T_base_flange))


def explain(suspects: Iterable[tuple[str, Callable[[], float]]], as_given_m: float) -> str | None:
    """The words of the suspect with the smallest misfit; None where none is clearly better."""
    best, least = None, CLEARLY * as_given_m
    for words, misfit in suspects:
        try:
            found = misfit()
        except RobocalError:
            continue
        if found < least:
            best, least = words, found
    return best


def swapped(fit: MountFit, lost: MountFit) -> dict[str, str]:
    """Which rejected sightings fit the pose of another rejected one: names and reasons.

    ``lost`` holds the rejected sightings under the same state.
    """
    limit = FITS * float(np.sqrt(np.mean(fit.distances() ** 2)))
    found: dict[str, str] = {}
    for view, place in zip(lost.views, lost.state.places, strict=True):
        s = view.sightings
        for i, name in enumerate(s.names):
            for j, other in enumerate(s.names):
                if s.pose[i] == s.pose[j]:
                    continue
                T = s.T_base_flange[[j]] @ fit.state.T_flange_sensor
                one = view.take(np.array([i], dtype=np.int64))
                far = one.model.distance(T, place, one.sightings.value)
                if far[0] < limit:
                    found[name] = f"fits the pose of {other}, not its own: swapped?"
    return found
