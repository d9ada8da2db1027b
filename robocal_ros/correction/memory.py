"""What a session of the joint correction remembers from one message to the next: one array.

Python and compiled code divide it alike, read it and write it, so that either may take the next
message of a stream. Times are of the session's steady clock, in s; NaN: never.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import kernel, lean

Array = NDArray[np.float64]
Counts = NDArray[np.int64]

# of ``times``: the clock of what was acted on last; when a target went out last; of a stream of
# targets, its last message and its period
CLOCK, OUT, LAST, PERIOD = range(4)
# of ``counts``: how many came or were kept so far; the oldest place
ARRIVED, BETWEEN, ECHOED, OLDEST, PLACES = range(5)

INTERVALS = 9
ARRIVALS = 128  # more than the messages that a stall holds up, which then come in a burst
ENOUGH = 3
# Messages that are further apart are single ones: the robot may have been moved in between.
LONGEST_PERIOD_S = 1.0
# Own output comes back as it was, or rounded (float32: 2.4e-7 rad): nearer than this, and nearer
# than a share of what it was shifted by; so a target that is sent again is not taken for it.
ROUNDED = 1e-6
OF_SHIFT = 0.25
SHIFTED = 1e-9
ECHOES = 64  # a loop brings one of so many outputs back
# Within this a robot that was commanded is where the command was.
RESPONSE_S = 0.2
TRACK_S = 0.01  # between the places that tell how far the robot moved
TRACK = 32  # more places than are that far apart within the response time


class Memory(NamedTuple):
    """Parts of an array of `memory_size` numbers, for n joints.

    Attributes
    ----------
    times, counts : see above.
    intervals, arrivals : rings of a stream's last intervals and arrivals.
    figures : (3,) of the last joints put out: error at the tool without correction, m; largest
        shift of a joint; error that remains, m.
    goal : (n,) taught joints that were commanded last.
    out : (n,) what was put out for the last target; NaN where nothing was.
    offset : (n,) what was added to the target corrected last.
    measured, taught : (n,) last readings, and the same un-corrected.
    read_s : (n,) when these were taken.
    echoes, within : (64, n) ring of the last corrected positions of targets, in the arm's order
        (with fewer joints shorter rows in its place), and (64,) how near they come back.
    track_s, track : (32,) and (32, n) ring of where the robot was within the response time.
    """

    times: Array
    counts: Counts
    intervals: Array
    arrivals: Array
    figures: Array
    goal: Array
    out: Array
    offset: Array
    measured: Array
    taught: Array
    read_s: Array
    echoes: Array
    within: Array
    track_s: Array
    track: Array


def memory_size(n: int) -> int:
    """How many numbers are remembered for n joints."""
    return 4 + 5 + INTERVALS + ARRIVALS + 3 + 6 * n + ECHOES * (n + 1) + TRACK * (n + 1)


@lean
def divide(block: Array, n: int) -> Memory:
    """Divide an array of `memory_size` numbers."""
    counts = block[4:9].view(np.int64)
    intervals, at = block[9 : 9 + INTERVALS], 9 + INTERVALS
    arrivals, at = block[at : at + ARRIVALS], at + ARRIVALS
    figures, at = block[at : at + 3], at + 3
    joints, at = block[at : at + 6 * n].reshape(6, n), at + 6 * n
    echoes, at = block[at : at + ECHOES * n].reshape(ECHOES, n), at + ECHOES * n
    within, at = block[at : at + ECHOES], at + ECHOES
    track_s, at = block[at : at + TRACK], at + TRACK
    return Memory(
        block[:4], counts, intervals, arrivals, figures,
        joints[0], joints[1], joints[2], joints[3], joints[4], joints[5],
        echoes, within, track_s, block[at : at + TRACK * n].reshape(TRACK, n),
    )  # fmt: skip


def blank(n: int) -> tuple[Array, Memory]:
    """The array and its parts, before anything came."""
    block = np.zeros(memory_size(n))
    memory: Memory = getattr(divide, "py_func", divide)(block, n)
    memory.times[:] = -np.inf, -np.inf, np.nan, np.nan
    memory.read_s[:] = -np.inf
    memory.within[:] = -1.0
    for joints in (memory.goal, memory.out, memory.measured, memory.taught):
        joints[:] = np.nan
    return block, memory


# ---- a stream's period ---------------------------------------------------------------------------


@lean
def end_stream(times: Array, counts: Counts) -> None:
    """The stream is over."""
    counts[ARRIVED] = counts[BETWEEN] = 0
    times[LAST] = times[PERIOD] = np.nan


@lean
def note_arrival(
    times: Array, counts: Counts, intervals: Array, arrivals: Array, now_s: float
) -> None:
    """A message of a stream has come; its period is the median of the last intervals."""
    interval = now_s - times[LAST]
    if interval > LONGEST_PERIOD_S:
        end_stream(times, counts)
    elif interval > 0.0:
        intervals[counts[BETWEEN] % INTERVALS] = interval
        counts[BETWEEN] += 1
        known = min(counts[BETWEEN], INTERVALS)
        if known >= ENOUGH:
            times[PERIOD] = _middle(intervals[:known])
    times[LAST] = now_s
    arrivals[counts[ARRIVED] % ARRIVALS] = now_s
    counts[ARRIVED] += 1


@lean
def _middle(values: Array) -> float:
    """The median; of an even number the greater one."""
    half = values.shape[0] // 2
    for value in values:
        less, same = 0, 0
        for other in values:
            less += other < value
            same += other == value
        if less <= half < less + same:
            return float(value)
    return float(np.nan)


@lean
def mean_period(counts: Counts, arrivals: Array) -> float:
    """Mean of many intervals, which a stall and its burst leave as it is; NaN for too few."""
    last = counts[ARRIVED] - 1
    count = min(last, ARRIVALS - 1)
    if count < ENOUGH:
        return float(np.nan)
    return float((arrivals[last % ARRIVALS] - arrivals[(last - count) % ARRIVALS]) / count)


@lean
def goes_on(times: Array, least_gap_s: float, now_s: float) -> bool:
    """Whether a message now belongs to the stream: not after more than two periods."""
    gap = least_gap_s
    if times[PERIOD] > 0.0:
        gap = max(gap, 2.0 * times[PERIOD])
    return bool(now_s - times[LAST] <= gap)


# ---- own output ----------------------------------------------------------------------------------


@kernel
def is_echo(echoes: Array, within: Array, position: Array) -> bool:
    """Whether positions (k,) are one of the rows (r, k) of ``echoes``, up to rounding."""
    for i in range(within.shape[0]):
        same = within[i] >= 0.0
        for j in range(position.shape[0]):
            if not same:
                break
            same = abs(echoes[i, j] - position[j]) <= within[i]
        if same:
            return True
    return False


@kernel
def remember_echo(echoes: Array, within: Array, kept: int, taught: Array, corrected: Array) -> None:
    """Keep ``corrected`` (k,), after ``kept`` others; one that equals ``taught`` is no echo."""
    i, shift = kept % within.shape[0], 0.0
    for j in range(corrected.shape[0]):
        shift = max(shift, abs(corrected[j] - taught[j]))
        echoes[i, j] = corrected[j]
    within[i] = min(ROUNDED, OF_SHIFT * shift) if shift > SHIFTED else -1.0


# ---- where the robot was -------------------------------------------------------------------------


@lean
def note_place(counts: Counts, track_s: Array, track: Array, measured: Array, now_s: float) -> None:
    """Keep where the robot is, now and then."""
    newest = (counts[OLDEST] + counts[PLACES] - 1) % TRACK
    if counts[PLACES] and now_s - track_s[newest] < TRACK_S:
        return
    newest = (counts[OLDEST] + counts[PLACES]) % TRACK
    counts[PLACES] += 1
    track_s[newest] = now_s
    for i in range(measured.shape[0]):
        track[newest, i] = measured[i]
    while counts[PLACES] > 1 and track_s[(counts[OLDEST] + 1) % TRACK] <= now_s - RESPONSE_S:
        counts[OLDEST] = (counts[OLDEST] + 1) % TRACK
        counts[PLACES] -= 1
