"""Messages of a settled stream, corrected in one call from bytes to bytes.

Nothing is decided here. Each kernel either does to the message and to the session's `Memory` what
the session would have done, bit for bit, or leaves both alone and says so: wherever something is
out of the ordinary, or merely near a bound, the session decides.

Their arguments, for a correction with k stages (0: messages pass as they came):

``came``, ``goes`` : lanes of the message and of what goes out (see `serialized_joints`).
``form`` (2, lanes) : what a message of this layout has, and a mask of the bits that count.
``layout`` : of both.
``place`` (n,) : of targets, each column's joint; of readings, each joint's column.
``last`` (1,) : stamp of the message before of these joints, ns; 0: none.
``block`` : of the session's `Memory`.
``limits`` (6, n), ``bounds`` (4,) : see `plainness`.
``models`` (2 k + 1, 4, n + 2, 9) : packed models of the arm's correction and of the tool's, of
their inverses in reverse order, and of all together (for rates), at the end of the blend.
``largest`` (2 k, n) : largest joint shift of each stage.
``work`` : scratch of `work_size` numbers.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import serialized_joints as wire
from robocal_ros.core.compiled import lean
from robocal_ros.core.joint_correction import memory as of
from robocal_ros.core.joint_correction import solution
from robocal_ros.core.joint_correction.memory import Memory
from robocal_ros.core.joint_correction.plainness import (
    DOUBTFUL,
    LEAST_GAP_S,
    ends_at,
    is_whole,
    keeps_limits,
    within,
)
from robocal_ros.core.joint_correction.rates import rates_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SETTLED = 1.0
_ROWS = 4


def work_size(n: int, k: int) -> int:
    """How many scratch numbers k stages for n joints need."""
    return solution.work_size(n) + _ROWS * n + 2 * k * (n + solution.REPORT)


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
def _note_order(came: Array, last: Index, memory: Memory, now_s: float) -> None:
    memory.times[of.CLOCK] = now_s
    stamp = wire.stamp_of(came)
    if stamp != 0:
        last[0] = stamp


@lean
def _has_rates(
    q: Array, corrected: Array, models: Array, free_axis: bool, work: Array, rows: Array
) -> bool:
    """Speed ``rows[0]`` at q becomes that of the corrected joints; False where singular."""
    room, speed, zero, out = (
        solution.room_in(work, q.shape[0], free_axis),
        rows[0],
        rows[1],
        rows[2],
    )
    solution.settle(models, SETTLED, room)
    for i in range(q.shape[0]):
        zero[i] = 0.0
    rates_at(q, speed, zero, corrected, room, out, zero)
    finite = True
    for i in range(q.shape[0]):
        speed[i] = out[i]
        finite &= abs(out[i]) < np.inf
    return finite


@lean
def _note_target(q: Array, corrected: Array, found: Array, memory: Memory, now_s: float) -> None:
    n, k = q.shape[0], found.shape[0]
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
def _is_own(came: Array, layout: Index, memory: Memory, n: int) -> bool:
    """Whether positions came back that were put out."""
    position = came[layout[wire.CAME] : layout[wire.CAME] + n]
    return of.is_echo(memory.echoes, memory.within, position)


@lean
def plain_target(
    came: Array, form: Array, layout: Index, place: Index, goes: Array, last: Index, now_s: float,
    block: Array, limits: Array, bounds: Array, models: Array, largest: Array, free_axis: bool,
    work: Array,
) -> bool:  # fmt: skip
    """Correct a target of a settled stream; False, and nothing done, where that is not plain."""
    n, k = place.shape[0], largest.shape[0] // 2
    memory, (rows, found) = of.divide(block, n), _divide(work, n, k)
    follows = _is_next(came, form, layout, last, memory, now_s)
    if not (follows and of.goes_on(memory.times, bounds[LEAST_GAP_S], now_s)):
        return False
    q, speed, first = rows[3], rows[0], layout[wire.CAME + wire.VELOCITY]
    moves = layout[wire.COUNT + wire.VELOCITY] > 0
    for j in range(n):
        q[place[j]] = came[layout[wire.CAME] + j]
        speed[place[j]] = came[first + j] if moves else 0.0
    if _is_own(came, layout, memory, n) or not within(q, limits[DOUBTFUL]):
        return False
    corrected = q
    for stage in range(k):
        solution.correct_point(
            corrected, models[stage], SETTLED, largest[stage], free_axis, work, found[stage]
        )
        corrected = found[stage, :n]
    if k > 0 and not is_whole(q, found[:k], limits, bounds):
        return False
    if k > 0 and moves and not _has_rates(q, corrected, models[2 * k], free_axis, work, rows):
        return False
    if not keeps_limits(corrected, speed, memory, now_s, limits, bounds):
        return False
    _note_order(came, last, memory, now_s)
    _note_target(q, corrected, found[:k], memory, now_s)
    _put_target(came, layout, place, corrected, speed, memory, goes)
    return True


@lean
def _put_target(
    came: Array, layout: Index, place: Index, corrected: Array, speed: Array, memory: Memory,
    goes: Array,
) -> None:  # fmt: skip
    """Write what goes out, and remember it in case it comes back."""
    n, first = place.shape[0], layout[wire.GOES + wire.VELOCITY]
    wire.pass_through(came, layout, goes)
    out = goes[layout[wire.GOES] : layout[wire.GOES] + n]
    for j in range(n):
        out[j] = corrected[place[j]]
        if layout[wire.COUNT + wire.VELOCITY] > 0:
            goes[first + j] = speed[place[j]]
    position = came[layout[wire.CAME] : layout[wire.CAME] + n]
    of.remember_echo(memory.echoes, memory.within, memory.counts[of.ECHOED], position, out)
    memory.counts[of.ECHOED] += 1


@lean
def plain_reading(
    came: Array, form: Array, layout: Index, place: Index, goes: Array, last: Index,
    now_s: float, now_ns: int, clamped: bool, block: Array, limits: Array, bounds: Array,
    models: Array, largest: Array, free_axis: bool, work: Array,
) -> bool:  # fmt: skip
    """Un-correct readings of all joints; False, and nothing done, where that is not plain.

    ``clamped``: the correction is a `clamping.ClampedCorrection`. ``now_ns``: clock of the stamps.
    """
    n, k = place.shape[0], largest.shape[0] // 2
    memory, (rows, found) = of.divide(block, n), _divide(work, n, k)
    if not _is_next(came, form, layout, last, memory, now_s):
        return False
    measured, speed, first = rows[3], rows[0], layout[wire.CAME + wire.VELOCITY]
    moves = layout[wire.COUNT + wire.VELOCITY] > 0
    for i in range(n):
        measured[i] = came[layout[wire.CAME] + place[i]]
        speed[i] = came[first + place[i]] if moves else 0.0
    if not within(measured, limits[DOUBTFUL]):
        return False
    taught = measured
    # the inverse of each stage, then the stages, to see that it is one
    for step in range(0 if clamped else k, 3 * k):
        stage = step % (2 * k)
        start = measured if step in (0, k) else found[(stage - 1) % (2 * k), :n]
        solution.correct_point(
            start, models[stage], SETTLED, largest[stage], free_axis, work, found[stage]
        )
        if step == k - 1 and not is_whole(measured, found[:k], limits, bounds):
            return False
    if k > 0:
        taught = found[2 * k - 1, :n]
        if not (is_whole(taught, found[:k], limits, bounds) and ends_at(measured, found[k - 1])):
            return False
        if moves and not _has_rates(measured, taught, models[2 * k], free_axis, work, rows):
            return False
    _note_order(came, last, memory, now_s)
    stamp = wire.stamp_of(came)
    age = (now_ns - stamp) * 1e-9 if stamp != 0 else 0.0
    _put_reading(came, layout, place, taught, speed, goes)
    _note_reading(measured, taught, memory, now_s, age)
    return True


@lean
def _put_reading(
    came: Array, layout: Index, place: Index, taught: Array, speed: Array, goes: Array
) -> None:
    wire.pass_through(came, layout, goes)
    for i in range(place.shape[0]):
        goes[layout[wire.GOES] + place[i]] = taught[i]
        if layout[wire.COUNT + wire.VELOCITY] > 0:
            goes[layout[wire.GOES + wire.VELOCITY] + place[i]] = speed[i]


@lean
def _note_reading(
    measured: Array, taught: Array, memory: Memory, now_s: float, age_s: float
) -> None:
    for i in range(measured.shape[0]):
        memory.measured[i], memory.taught[i] = measured[i], taught[i]
        memory.read_s[i] = now_s - max(age_s, 0.0)
    of.note_place(memory.counts, memory.track_s, memory.track, memory.measured, now_s)


def load_kernels(n: int) -> None:
    """Call the compiled code for n joints once, so that the first message need not wait for it."""
    came, layout, place = np.zeros(n), np.zeros(9, dtype=np.int64), np.zeros(n, dtype=np.int64)
    message = came, np.zeros((2, n)), layout, place, np.zeros(n), np.zeros(1, dtype=np.int64)
    limits, models, largest = np.zeros((6, n)), np.zeros((3, 4, n + 2, 9)), np.ones((2, n))
    block, memory = of.blank(n)
    rest: tuple[Any, ...] = (
        block,
        limits,
        np.zeros(4),
        models,
        largest,
        False,
        np.zeros(work_size(n, 1)),
    )
    plain_target(*message, 0.0, *rest)
    plain_reading(*message, 0.0, 0, False, *rest)
    times, counts, position = memory.times, memory.counts, np.zeros(n)
    of.note_arrival(times, counts, memory.intervals, memory.arrivals, 0.0)
    of.mean_period(counts, memory.arrivals)
    of.goes_on(times, 0.0, 0.0)
    of.end_stream(times, counts)
    of.remember_echo(memory.echoes, memory.within, 0, position, position)
    of.is_echo(memory.echoes, memory.within, position)
    of.note_place(counts, memory.track_s, memory.track, position, 0.0)
