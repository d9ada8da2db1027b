"""Why data do not fit a robot at all: wrong units, a mirrored frame, a joint's sign, in words."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.start import linear_start
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

SUSPICIOUS_M = 0.02  # no robot's nominal model is off by this much at half of the poses
CLEAR_M = 0.01
CLEAR_RATIO = 20.0
_ENOUGH_ROWS = 300
_DEGREE = float(np.pi / 180.0)


def require_match(
    arm: SerialArm, data: Measurements, *, base: bool, tool: bool, file: str | None = None
) -> None:
    """Refuse data that miss the nominal arm as no robot does, where the mistake can be named.

    ``base``, ``tool``: whether they are placed from the data or known (see ``linear_start``).

    Raises
    ------
    InputError
        Naming the mistake, and ``file``.
    TooFewSamplesError, RankDeficientError
        When the data cannot place base and targets.
    """

    def residual(measured: Measurements) -> Array:
        return linear_start(arm, measured, base=base, tool=tool).residual(measured)

    if mistake := explain_mismatch(arm, data, residual):
        raise InputError(mistake, file=file)


def explain_mismatch(
    arm: SerialArm, data: Measurements, residual: Callable[[Measurements], Array]
) -> str:
    """Name the mistake with which the data fit and without which they do not; empty if none.

    Parameters
    ----------
    residual : errors (m, 3), m, of a plain fit to (or prediction of) measurements.

    A mistake is named only when undoing it brings the median error from more than 20 mm to under
    10 mm, and to a twentieth: no real deviation of a robot looks like that.
    """
    if len(data) > _ENOUGH_ROWS:
        data = data.take(np.linspace(0, len(data) - 1, _ENOUGH_ROWS).astype(np.int64))
    found = _median(residual(data))
    if found < SUSPICIOUS_M:
        return ""
    clear = min(CLEAR_M, found / CLEAR_RATIO)
    for words, corrected in _mistakes(arm, data):
        if (after := _median(residual(corrected))) < clear:
            return (
                f"{words}: as given, the data miss the robot by {found * 1e3:.3g} mm (median), "
                f"with that undone by {after * 1e3:.3g} mm"
            )
    return ""


def _median(residual: Array) -> float:
    return float(np.median(np.linalg.norm(residual, axis=1)))


def _mistakes(arm: SerialArm, data: Measurements) -> Iterator[tuple[str, Measurements]]:
    """Each common mistake in words, with the data as they are once it is undone."""
    for words, factor in (
        ("the measured positions are 1000 times too large (millimetres given as metres?)", 1e-3),
        ("the measured positions are 1000 times too small (metres given as millimetres?)", 1e3),
    ):
        yield words, replace(data, position=data.position * factor)
    turning = ~arm.prismatic
    for words, factor in (
        ("the joint readings are degrees given as radians", _DEGREE),
        ("the joint readings are radians given as degrees", 1.0 / _DEGREE),
    ):
        yield words, replace(data, q=np.where(turning, data.q * factor, data.q))
    for axis, name in enumerate("xyz"):
        position = data.position.copy()
        position[:, axis] *= -1.0
        words = f"{name} has the wrong sign, or two axes are swapped"
        yield f"the measuring frame is left-handed: {words}", replace(data, position=position)
    for a, b in combinations(range(3), 2):
        position = data.position.copy()
        position[:, [a, b]] = position[:, [b, a]]
        yield f"{'xyz'[a]} and {'xyz'[b]} are swapped", replace(data, position=position)
    for joint, name in enumerate(arm.joint_names):
        q = data.q.copy()
        q[:, joint] *= -1.0
        words = f"joint {joint + 1} ({name}) counts the other way: check its sign"
        yield words, replace(data, q=q)
    for a, b in combinations(range(arm.n), 2):
        q = data.q.copy()
        q[:, [a, b]] = q[:, [b, a]]
        yield f"joints {a + 1} and {b + 1} are swapped", replace(data, q=q)
