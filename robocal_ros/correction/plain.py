"""Messages of a settled stream, corrected in one call from bytes to bytes.

Nothing is decided here. The kernel either does to the message and to the session's `Memory` what
the session would have done, bit for bit, or leaves both alone and says so: wherever something is
out of the ordinary, or merely near a bound, the session decides.

Its arguments, for a correction with k stages (0: messages pass as they came):

``came``, ``goes`` : lanes of the message and of what goes out (see `joint_lanes`).
``form`` (2, lanes) : what a message of this layout has, and a mask of the bits that count.
``layout`` : of both.
``place`` (n,) : each joint's column.
``last`` (1,) : stamp of the message before of these joints, ns; 0: none.
``now_s``, ``now_ns`` : the session's clock, and the one that stamps the readings.
``block`` : of the session's `Memory`.
``limits`` (6, n), ``bounds`` (4,) : see `plainness`.
``models`` (2 k + 1, 4, n + 2, 9) : packed models of the arm's correction and of the tool's, of
their inverses in reverse order, and of all together (for rates), at the end of the blend.
``largest`` (2 k, n) : largest joint shift of each stage.
``clamped`` : whether it is a `clamping.ClampedCorrection`.
``work`` : scratch of `work_size` numbers.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.compiled import lean
from robocal_ros.correction import joint_lanes as wire
from robocal_ros.correction import memory as of
from robocal_ros.correction import solution
from robocal_ros.correction.memory import Memory
from robocal_ros.correction.plainness import (
    DOUBTFUL,
    LEAST_GAP_S,
    ends_at,
    is_whole,
    keeps_limits,
    within,
)
from robocal_ros.correction.rates import rates_at
from robocal_ros.correction.room import room_in, settle
from robocal_ros.correction.room import work_size as room_size

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SETTLED = 1.0
_ROWS = 4


def work_size(n: int, k: int) -> int:
    """How many scratch numbers k stages for n joints need."""
    return room_size(n) + _ROWS * n + 2 * k * (n + solution.REPORT)


@lean
def _divide(work: Array, n: int, k: int) -> tuple[Array, Array]:
    """Rows (4, n) for joints, and the solutions (2 k, n + 7) of all stages."""
    at = work.shape[0] - 2 * k * (n + solution.REPORT)
    return (
        work[at - _ROWS * n : at].reshape(_ROWS, n),
        work[at:].reshape(2 * k, n + solution.REPORT),
    )


@lean
def _is_next(
    came: Array, form: Array, layout: Index, last: Index, memory: Memory, now_s: float
) -> bool:
    """Whether a message is laid out as those before it, and follows them in time."""
    if not (wire.is_laid_out_as(came, form[0], form[1]) and wire.are_finite(came, layout)):
        return False
    stamp = wire.stamp_of(came)
    return bool((stamp == 0 or stamp >= last[0]) and now_s >= memory.times[of.CLOCK])


@lean
def _note_order(came: Array, last: Index, memory: Memory, now_s: float, now_ns: int) -> float:
    """Remember when a message came; returns how old it is."""
    memory.times[of.CLOCK] = now_s
    stamp = wire.stamp_of(came)
    if stamp == 0:
        return 0.0
    last[0] = stamp
    return (now_ns - stamp) * 1e-9


@lean
def _take_joints(came: Array, layout: Index, place: Index, q: Array, speed: Array) -> None:
    """Joints and their speed (zero where none came), in the arm's order."""
    first, moves = layout[wire.CAME + wire.VELOCITY], layout[wire.COUNT + wire.VELOCITY] > 0
    for i in range(place.shape[0]):
        q[i] = came[layout[wire.CAME] + place[i]]
        speed[i] = came[first + place[i]] if moves else 0.0


@lean
def _put_joints(
    came: Array, layout: Index, place: Index, q: Array, speed: Array, goes: Array
) -> None:
    wire.pass_through(came, layout, goes)
    first, moves = layout[wire.GOES + wire.VELOCITY], layout[wire.COUNT + wire.VELOCITY] > 0
    for i in range(place.shape[0]):
        goes[layout[wire.GOES] + place[i]] = q[i]
        if moves:
            goes[first + place[i]] = speed[i]


@lean
def _solve(
    q: Array, is_reading: bool, limits: Array, bounds: Array, models: Array, largest: Array,
    free_axis: bool, clamped: bool, work: Array, found: Array,
) -> bool:  # fmt: skip
    """Correct joints q; or un-correct them by the inverses, and correct that to see that it is one.

    Of a clamped correction it must be known first that it is whole. False where it is not plain.
    """
    n, k = q.shape[0], largest.shape[0] // 2
    begin, end = (0 if clamped else k, 3 * k) if is_reading else (0, k)
    for step in range(begin, end):
        stage = step % (2 * k)
        start = q if step in (0, k) else found[(stage - 1) % (2 * k), :n]
        solution.correct_point(
            start, models[stage], SETTLED, largest[stage], free_axis, work, found[stage]
        )
        if stage == k - 1:
            taught = q if step < k else found[2 * k - 1, :n]
            if not is_whole(taught, found[:k], limits, bounds):
                return False
    return not is_reading or k == 0 or ends_at(q, found[k - 1])


@lean
def _has_rates(
    q: Array, answer: Array, models: Array, free_axis: bool, work: Array, rows: Array
) -> bool:
    """Speed ``rows[1]`` at q becomes that of the answer; False where singular."""
    speed, zero, out = rows[1], rows[2], rows[3]
    room = room_in(work, q.shape[0], free_axis)
    settle(models, SETTLED, room)
    for i in range(q.shape[0]):
        zero[i] = 0.0
    rates_at(q, speed, zero, answer, room, out, zero)
    finite = True
    for i in range(q.shape[0]):
        speed[i] = out[i]
        finite &= abs(out[i]) < np.inf
    return finite


@lean
def _note_target(q: Array, corrected: Array, found: Array, memory: Memory, now_s: float) -> None:
    n, k = q.shape[0], found.shape[0] // 2
    of.note_arrival(memory.times, memory.counts, memory.intervals, memory.arrivals, now_s)
    shift = 0.0
    for i in range(n):
        memory.offset[i] = corrected[i] - q[i]
        shift = max(shift, abs(memory.offset[i]))
        memory.goal[i], memory.out[i] = q[i], corrected[i]
    memory.times[of.OUT] = now_s
    memory.figures[0], memory.figures[1], memory.figures[2] = 0.0, shift, 0.0
    if k > 0:
        memory.figures[0] = found[0, n + solution.TCP_SHIFT]
    for stage in range(k):
        memory.figures[2] += found[stage, n + solution.POSITION_ERROR]


@lean
def _note_echo(taught: Array, out: Array, memory: Memory) -> None:
    of.remember_echo(memory.echoes, memory.within, memory.counts[of.ECHOED], taught, out)
    memory.counts[of.ECHOED] += 1


@lean
def _note_reading(
    measured: Array, taught: Array, memory: Memory, now_s: float, age_s: float
) -> None:
    for i in range(measured.shape[0]):
        memory.measured[i], memory.taught[i] = measured[i], taught[i]
        memory.read_s[i] = now_s - max(age_s, 0.0)
    of.note_place(memory.counts, memory.track_s, memory.track, memory.measured, now_s)


@lean
def _goes_on(q: Array, memory: Memory, now_s: float, least_gap_s: float) -> bool:
    """Whether a target belongs to the stream, and was not put out before."""
    if not of.goes_on(memory.times, least_gap_s, now_s):
        return False
    return not of.is_echo(memory.echoes, memory.within, q)


@lean
def pass_plainly(
    is_reading: bool, came: Array, form: Array, layout: Index, place: Index, goes: Array,
    last: Index, now_s: float, now_ns: int, block: Array, limits: Array, bounds: Array,
    models: Array, largest: Array, free_axis: bool, clamped: bool, work: Array,
) -> bool:  # fmt: skip
    """Correct a target, or un-correct a reading; False, and nothing done, where it is not plain."""
    n, k = place.shape[0], largest.shape[0] // 2
    memory, (rows, found) = of.divide(block, n), _divide(work, n, k)
    q, speed, moves = rows[0], rows[1], layout[wire.COUNT + wire.VELOCITY] > 0
    if not _is_next(came, form, layout, last, memory, now_s):
        return False
    _take_joints(came, layout, place, q, speed)
    if not (is_reading or _goes_on(q, memory, now_s, bounds[LEAST_GAP_S])):
        return False
    if not within(q, limits[DOUBTFUL]):
        return False
    if not _solve(q, is_reading, limits, bounds, models, largest, free_axis, clamped, work, found):
        return False
    answer = q
    if k > 0:
        answer = found[2 * k - 1, :n] if is_reading else found[k - 1, :n]
        if moves and not _has_rates(q, answer, models[2 * k], free_axis, work, rows):
            return False
    if not (is_reading or keeps_limits(answer, speed, memory, now_s, limits, bounds)):
        return False
    _put_joints(came, layout, place, answer, speed, goes)
    age_s = _note_order(came, last, memory, now_s, now_ns)
    if is_reading:
        _note_reading(q, answer, memory, now_s, age_s)
    else:
        _note_target(q, answer, found, memory, now_s)
        _note_echo(q, answer, memory)
    return True


def load_kernels(n: int) -> None:
    """Call the compiled code for n joints once, so that the first message need not wait for it."""
    came, layout, place = np.zeros(n), np.zeros(9, dtype=np.int64), np.zeros(n, dtype=np.int64)
    message = came, np.zeros((2, n)), layout, place, np.zeros(n), np.zeros(1, dtype=np.int64)
    limits, models, largest = np.zeros((6, n)), np.zeros((3, 4, n + 2, 9)), np.ones((2, n))
    block, memory = of.blank(n)
    bounds, work = np.zeros(4), np.zeros(work_size(n, 1))
    correction = block, limits, bounds, models, largest
    pass_plainly(True, *message, 0.0, 0, *correction, False, False, work)
    times, counts, position = memory.times, memory.counts, np.zeros(n)
    of.note_arrival(times, counts, memory.intervals, memory.arrivals, 0.0)
    of.mean_period(counts, memory.arrivals)
    of.goes_on(times, 0.0, 0.0)
    of.end_stream(times, counts)
    of.remember_echo(memory.echoes, memory.within, 0, position, position)
    of.is_echo(memory.echoes, memory.within, position)
    of.note_place(counts, memory.track_s, memory.track, position, 0.0)
