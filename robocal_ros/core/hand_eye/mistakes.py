"""Common mistakes in the data, recognised because undoing them makes everything fit."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.hand_eye.mount_fit import MountFit

Array = NDArray[np.float64]

CLEARLY = 0.2  # of the misfit as given: below it the undone data are the right ones
MOST_LOST = 0.34
FITS = 5.0  # times the rms of the others

_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def _scaled(factor: float) -> Callable[[Array], Array]:
    def scale(T: Array) -> Array:
        return frames.transform(T[:, :3, :3], factor * T[:, :3, 3])

    return scale


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
    (
        "the poses fit when mirrored: they come from a left-handed frame; turn one axis round",
        lambda T: _MIRROR @ T @ _MIRROR,
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


def misfit(fit: MountFit) -> float:
    """Median distance of the sightings used, m; more where many were thrown away."""
    used = len(fit.names)
    lost = len(fit.rejected) / max(used + len(fit.rejected), 1)
    return float(np.median(fit.distances())) * (1.0 if lost < MOST_LOST else 1e3)


def explain(
    refit: Callable[[Array], MountFit], T_base_flange: Array, as_given_m: float
) -> str | None:
    """Say which mistake in the poses (m, 4, 4) explains a misfit; None where none does.

    ``refit`` solves with other poses; ``as_given_m`` is the `misfit` of the poses as they are.
    """
    for words, undone in MISTAKES:
        try:
            fit = refit(undone(T_base_flange))
        except RobocalError:
            continue
        if misfit(fit) < CLEARLY * as_given_m:
            return words
    return None


def swapped(fit: MountFit, lost: "MountFit") -> dict[str, str]:
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
