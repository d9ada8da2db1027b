"""One target of a stream, from taught joints to what goes out: compiled in one piece."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.limiter import (
    DESIRED,
    OFFSET,
    OFFSET_RATE,
    OUT,
    ROUNDING,
    TAUGHT,
    VELOCITY,
    WANTED,
    put_out,
)
from robocal_ros.correction.solution import (
    POSITION_ERROR,
    TCP_SHIFT,
    WEAK,
    correct_staged,
    velocity_by_chain,
    velocity_by_differences,
    within,
)
from robocal_ros.ground.compiled import lean

Array = NDArray[np.float64]

NOT_WITHIN = -2.0  # a target that is not solved within all bounds
# What is said of the targets: how many were corrected in part; of the last one the error at the
# tool that the drift would have made, the largest offset wanted and the error that is left; whether
# anything is added, and whether a joint's velocity is too high.
REDUCED, SHIFT, LARGEST, REMAINING, ADDS, TOO_FAST = range(6)


FIGURES = 6


@lean
def _say(goal: Array, reports: Array, memory: Array, figures: Array) -> bool:
    """Fill in what is said of a target; whether all of it was corrected."""
    n, whole = goal.shape[0], True
    figures[SHIFT], figures[LARGEST] = reports[0, n + TCP_SHIFT], 0.0
    figures[REMAINING], figures[ADDS], figures[TOO_FAST] = 0.0, 0.0, 0.0
    for stage in range(reports.shape[0]):
        whole = whole and reports[stage, n + WEAK] == 0.0
        figures[REMAINING] += reports[stage, n + POSITION_ERROR]
    for j in range(n):
        figures[LARGEST] = max(figures[LARGEST], abs(memory[WANTED, j]))
        if memory[OFFSET, j] != 0.0:
            figures[ADDS] = 1.0
    if not whole:
        figures[REDUCED] += 1.0
    return whole


@lean
def step_out(
    goal: Array, velocity: Array, elapsed: float, longest: float, memory: Array, limits: Array,
    active: Array, speeds: Array, span: Array, bounds: Array, tcp: Array, largest: Array,
    free: bool, works: Array, reports: Array, figures: Array,
) -> float:  # fmt: skip
    """Correct a target ``goal`` (n,) with its ``velocity`` (n,), and put it out: see `put_out`.

    Parameters
    ----------
    speeds : (2, n) fastest of the joints, in this step and ever.
    bounds, tcp : (k, n) and (2,) largest shifts, see `within`.
    largest, free, works : of `correct_staged`.
    reports : (2, k, n + 7) scratch; the first is that of the target.
    figures : (6,) what is said of it.

    Returns
    -------
    float
        As `put_out`, or `NOT_WITHIN`. The velocities that go out are in the memory then.
    """
    n, report = goal.shape[0], reports[0]
    correct_staged(goal, largest, free, works, report)
    if not within(goal, report, bounds, tcp, memory[WANTED]):
        return NOT_WITHIN
    share = put_out(memory, goal, memory[WANTED], elapsed, longest, limits, active, speeds[0], span)
    whole = _say(goal, report, memory, figures)
    if not 0.0 <= share <= 1.0 + ROUNDING:
        return share
    out, exact = memory[VELOCITY], True
    for j in range(n):
        exact = exact and memory[OFFSET, j] == memory[DESIRED, j]
        out[j] = velocity[j] + memory[OFFSET_RATE, j]
    if exact:
        taught, corrected, last = memory[TAUGHT], memory[OUT], works.shape[0] - 1
        if not (
            whole and n == 6 and not free
            and velocity_by_chain(taught, velocity, corrected, works[0], works[last], out)
        ):  # fmt: skip
            velocity_by_differences(
                taught, velocity, corrected, largest, free, works, memory[VELOCITY + 1],
                reports[1], out,
            )  # fmt: skip
    for j in range(n):
        if active[j] != 0.0 and abs(out[j]) > speeds[1, j] * (1.0 + ROUNDING):
            figures[TOO_FAST] = 1.0
    return share
