"""What tells a plain message of a settled stream: inequalities alone, on the safe side.

Everything that they hold is within the bounds of `bounds` and `clamping`, which decide.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.correction import memory as of
from robocal_ros.correction import solution
from robocal_ros.correction.memory import Memory

Array = NDArray[np.float64]

# rows of ``limits``: joint limits, beyond what joints are no radians, speed, largest shift by the
# arm's drift and by the tool's change
LOWER, UPPER, DOUBTFUL, FASTEST, ARM, TOOL = range(6)
# of ``bounds``: the drift's error at the tool, longest step and least gap of a stream
TCP_M, TCP_RAD, LONGEST_STEP_S, LEAST_GAP_S = range(4)
FADES_WITHIN = 3.0  # of a joint limit: see `clamping`
EXACT = 1e-13  # rad, m: to rounding


@lean
def within(x: Array, largest: Array) -> bool:
    """Whether no magnitude is above its bound; False for NaN."""
    below = True
    for i in range(x.shape[0]):
        below &= abs(x[i]) <= largest[i]
    return below


@lean
def is_whole(q: Array, found: Array, limits: Array, bounds: Array) -> bool:
    """Whether all stages (k, n + 7) made all of the correction at q, and no bound is near."""
    n, k = q.shape[0], found.shape[0]
    whole = found[0, n + solution.TCP_SHIFT] <= bounds[TCP_M]
    whole &= found[0, n + solution.TCP_ROTATION] <= bounds[TCP_RAD]
    for stage in range(k):
        whole &= found[stage, n + solution.CONVERGED] > 0.5
        whole &= found[stage, n + solution.SHARE] == 1.0
        for i in range(n):
            before = q[i] if stage == 0 else found[stage - 1, i]
            whole &= abs(found[stage, i] - before) <= limits[ARM + stage, i]
    size, room = 0.0, np.inf
    for i in range(n):
        bound = limits[ARM, i] + limits[TOOL, i]
        size = max(size, abs(found[k - 1, i] - q[i]) / bound)
        room = min(room, min(q[i] - limits[LOWER, i], limits[UPPER, i] - q[i]) / bound)
    return whole and room > 0.0 and room >= FADES_WITHIN * size  # at a limit the session clamps


@lean
def keeps_limits(
    q: Array, speed: Array, memory: Memory, now_s: float, limits: Array, bounds: Array
) -> bool:
    """Whether joints q and their speed keep the limits on the way from what was put out last."""
    period = of.mean_period(memory.counts, memory.arrivals)
    if not period > 0.0:
        period = bounds[LONGEST_STEP_S]
    dt = min(max(now_s - memory.times[of.OUT], period), 2.0 * period)
    kept = within(speed, limits[FASTEST])
    for i in range(q.shape[0]):
        kept &= abs((q[i] - memory.out[i]) / dt) <= limits[FASTEST, i]
        kept &= limits[LOWER, i] <= q[i] <= limits[UPPER, i]
    return kept


@lean
def ends_at(q: Array, found: Array) -> bool:
    """Whether a solution is these joints, to rounding."""
    exact = True
    for i in range(q.shape[0]):
        exact &= abs(q[i] - found[i]) < EXACT
    return exact
