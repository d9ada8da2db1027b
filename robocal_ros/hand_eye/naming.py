"""Directions that poses leave open, in words, with the motion that would show them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames

Array = NDArray[np.float64]

AXES = ("the laser line (x)", "the laser plane's normal (y)", "the beam (z)")
ALONG = 0.9  # cosine from which a direction is named after an axis
SMALL_TURN_RAD = float(np.radians(1.0))  # turns below this show nothing
FARTHEST_AXIS_M = 100.0  # a turn about an axis beyond it is a translation
ENOUGH = "by 20 deg or more"


@dataclass(frozen=True, eq=False)
class Turns:
    """About how many axes poses turn; ``axis`` (3,), base, where it is one."""

    count: int
    axis: Array


def turns_of(T_base_flange: Array) -> Turns:
    """Turning axes of poses (m, 4, 4): of the rotations against the first one."""
    R = T_base_flange[:, :3, :3]
    turn = frames.log_rotation(R @ R[0].T)
    _, s, Vt = np.linalg.svd(turn, full_matrices=False)
    spread = s / np.sqrt(len(turn))
    return Turns(int(np.sum(spread > SMALL_TURN_RAD)), Vt[0])


def describe_motion(direction: Array, T_base_flange: Array) -> str:
    """Words for an open direction (v, w) (6,) of the sensor, sensor axes, and what to do."""
    return f"{_words(direction)}: {_remedy(turns_of(T_base_flange))}"


def joined(words: Sequence[str]) -> str:
    """Several `describe_motion` in one sentence, a remedy that they share said once."""
    parts = [each.partition(": ") for each in words]
    what = "; ".join(first for first, _, _ in parts)
    remedies = dict.fromkeys(remedy for _, _, remedy in parts if remedy)
    return ": ".join(filter(None, (what, "; ".join(remedies))))


def _words(direction: Array) -> str:
    v, w = direction[:3], direction[3:]
    if np.linalg.norm(w) * FARTHEST_AXIS_M < max(float(np.linalg.norm(v)), 1e-300):
        return f"translation along {_axis(v)}"
    turn = float(np.linalg.norm(w))
    centre = np.cross(w, v) / turn**2  # the point of the axis next to the origin
    pitch = float(v @ w) / turn**2
    words = f"rotation about {_axis(w)}"
    if np.linalg.norm(centre) > 1e-3:
        place = ", ".join(f"{1e3 * value:.0f}" for value in centre)
        words += f" through ({place}) mm of the sensor"
    if abs(pitch) > 1e-3:
        words += ", with a translation along it"
    return words


def _axis(direction: Array) -> str:
    unit = direction / np.linalg.norm(direction)
    place = int(np.argmax(np.abs(unit)))
    if abs(unit[place]) > ALONG:
        return AXES[place]
    return f"({', '.join(f'{value:.2f}' for value in unit)}) of the sensor"


def _remedy(turns: Turns) -> str:
    if turns.count == 0:
        return f"the poses do not turn; turn the flange about two axes, {ENOUGH}"
    if turns.count == 1:
        axis = ", ".join(f"{value:.2f}" for value in turns.axis)
        found = f"all poses turn about ({axis}) of the base"
        return f"{found}; tilt the flange about another axis, {ENOUGH}"
    return "show the target at other places of the profile, at other distances and tilts"
