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
``limits`` (6, n), ``bounds`` (4,) : see below.
``models`` (2 k + 1, 4, n + 2, 9) : packed models of the arm's correction and of the tool's, of
their inverses in reverse order, and of all together (for rates), at the end of the blend.
``largest`` (2 k, n) : largest joint shift of each stage.
``work`` : scratch of `work_size` numbers.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import serialized_joints as wire
from robocal_ros.core.compiled import lean
from robocal_ros.core.joint_correction import memory as of
from robocal_ros.core.joint_correction import solution
from robocal_ros.core.joint_correction.memory import Memory
from robocal_ros.core.joint_correction.rates import rates_at

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# rows of ``limits``: joint limits, beyond what joints are no radians, speed, largest shift by the
# arm's drift and by the tool's change
LOWER, UPPER, DOUBTFUL, FASTEST, ARM, TOOL = range(6)
# of ``bounds``: the drift's error at the tool, longest step and least gap of a stream
TCP_M, TCP_RAD, LONGEST_STEP_S, LEAST_GAP_S = range(4)
FADES_WITHIN = 3.0  # see `clamping`
EXACT = 1e-13  # rad, m: see `staged`
SETTLED = 1.0
_ROWS = 5


def work_size(n: int, k: int) -> int:
    """How many scratch numbers k stages for n joints need."""
    return solution.work_size(n) + _ROWS * n + 2 * k * (n + solution.REPORT)


@lean
def _divide(work: Array, n: int, k: int) -> tuple[Array, Array]:
    """Rows (5, n) for joints, and the solutions (2 k, n + 7) of all stages."""
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
def _within(x: Array, largest: Array) -> bool:
    """Whether no magnitude is above its bound; False for NaN."""
    within = True
    for i in range(x.shape[0]):
        within &= abs(x[i]) <= largest[i]
    return within


@lean
def _is_whole(q: Array, found: Array, limits: Array, bounds: Array) -> bool:
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
    return whole and room >= FADES_WITHIN * size


@lean
def _has_rates(
    q: Array, corrected: Array, models: Array, free_axis: bool, work: Array, rows: Array
) -> bool:
    """Speed ``rows[0]`` at q, as ``rows[1]`` at the corrected joints; False where singular."""
    room = solution.room_in(work, q.shape[0], free_axis)
    solution.settle(models, SETTLED, room)
    for i in range(q.shape[0]):
        rows[2, i] = 0.0
    rates_at(q, rows[0], rows[2], corrected, room, rows[1], rows[2])
    finite = True
    for i in range(q.shape[0]):
        finite &= abs(rows[1, i]) < np.inf
    return finite


@lean
def _keeps_limits(
    q: Array, speed: Array, memory: Memory, now_s: float, limits: Array, bounds: Array
) -> bool:
    """Whether joints q and their speed keep the limits on the way from what was put out last."""
    period = of.mean_period(memory.counts, memory.arrivals)
    if not period > 0.0:
        period = bounds[LONGEST_STEP_S]
    dt = min(max(now_s - memory.times[of.OUT], period), 2.0 * period)
    kept = _within(speed, limits[FASTEST])
    for i in range(q.shape[0]):
        kept &= abs((q[i] - memory.out[i]) / dt) <= limits[FASTEST, i]
        kept &= limits[LOWER, i] <= q[i] <= limits[UPPER, i]
    return kept


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
def plain_target(
    came: Array, form: Array, layout: Index, place: Index, goes: Array, last: Index, now_s: float,
    block: Array, limits: Array, bounds: Array, models: Array, largest: Array, free_axis: bool,
    work: Array,
) -> bool:  # fmt: skip
    """Correct a target of a settled stream; False, and nothing done, where that is not plain."""
    n, k = place.shape[0], largest.shape[0] // 2
    memory = of.divide(block, n)
    rows, found = _divide(work, n, k)
    if not _is_next(came, form, layout, last, memory, now_s):
        return False
    if not of.goes_on(memory.times, bounds[LEAST_GAP_S], now_s):
        return False
    position = came[layout[wire.CAME] : layout[wire.CAME] + n]
    echoes = memory.echoes.reshape(of.ECHOES, n)
    if of.is_echo(echoes, memory.within, position):
        return False
    q, moves = rows[3], layout[wire.COUNT + wire.VELOCITY] > 0
    for j in range(n):
        q[place[j]] = position[j]
        rows[0, place[j]] = came[layout[wire.CAME + wire.VELOCITY] + j] if moves else 0.0
    if not _within(q, limits[DOUBTFUL]):
        return False
    corrected, speed = q, rows[0]
    for stage in range(k):
        solution.correct_point(
            corrected, models[stage], SETTLED, largest[stage], free_axis, work, found[stage]
        )
        corrected = found[stage, :n]
    if k > 0:
        if not _is_whole(q, found[:k], limits, bounds):
            return False
        if moves and not _has_rates(q, corrected, models[2 * k], free_axis, work, rows):
            return False
        if moves:
            speed = rows[1]
    if not _keeps_limits(corrected, speed, memory, now_s, limits, bounds):
        return False
    _note_order(came, last, memory, now_s)
    _note_target(q, corrected, found[:k], memory, now_s)
    wire.pass_through(came, layout, goes)
    out = goes[layout[wire.GOES] : layout[wire.GOES] + n]
    for j in range(n):
        out[j] = corrected[place[j]]
        if moves:
            goes[layout[wire.GOES + wire.VELOCITY] + j] = speed[place[j]]
    of.remember_echo(echoes, memory.within, memory.counts[of.ECHOED], position, out)
    memory.counts[of.ECHOED] += 1
    return True


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
    memory = of.divide(block, n)
    rows, found = _divide(work, n, k)
    if not _is_next(came, form, layout, last, memory, now_s):
        return False
    measured, moves = rows[3], layout[wire.COUNT + wire.VELOCITY] > 0
    for i in range(n):
        measured[i] = came[layout[wire.CAME] + place[i]]
        rows[0, i] = came[layout[wire.CAME + wire.VELOCITY] + place[i]] if moves else 0.0
    if not _within(measured, limits[DOUBTFUL]):
        return False
    taught, speed, start = measured, rows[0], measured
    # the inverse of each stage, then the stages, to see that it is one
    for step in range(0 if clamped else k, 3 * k):
        stage = step % (2 * k)
        solution.correct_point(
            measured if step == k else start, models[stage], SETTLED, largest[stage], free_axis,
            work, found[stage],
        )  # fmt: skip
        start = found[stage, :n]
        if step == k - 1 and not _is_whole(measured, found[:k], limits, bounds):
            return False
    if k > 0:
        taught = found[2 * k - 1, :n]
        if not _is_whole(taught, found[:k], limits, bounds):
            return False
        for i in range(n):
            if not abs(measured[i] - found[k - 1, i]) < EXACT:
                return False
        if moves and not _has_rates(measured, taught, models[2 * k], free_axis, work, rows):
            return False
        if moves:
            speed = rows[1]
    _note_order(came, last, memory, now_s)
    stamp = wire.stamp_of(came)
    age = (now_ns - stamp) * 1e-9 if stamp != 0 else 0.0
    wire.pass_through(came, layout, goes)
    for i in range(n):
        memory.measured[i], memory.taught[i] = measured[i], taught[i]
        memory.read_s[i] = now_s - max(age, 0.0)
        goes[layout[wire.GOES] + place[i]] = taught[i]
        if moves:
            goes[layout[wire.GOES + wire.VELOCITY] + place[i]] = speed[i]
    of.note_place(memory.counts, memory.track_s, memory.track, memory.measured, now_s)
    return True
