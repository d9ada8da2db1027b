# SPDX-License-Identifier: Apache-2.0
"""The last thing in the command path: how the offset between what comes in and goes out may change.

Whatever is upstream (a new model or tool, enabling, a refusal, a command of some joints, a
singular posture, a restart), what goes out is what came in plus an offset, and for each joint the
offset's rate and acceleration stay within limits over the time that really elapsed. At rest the
limits are low, as what changes then is the correction itself; in motion they are higher, as the
correction follows the posture.

Near a singularity the desired offset d may change faster than its limits allow, in several joints
that cancel at the tool: held back one by one they would take it far off. So a share s of d is
aimed at, one for all joints, which leaves the tool between where it would be uncorrected and where
it is wanted. With the desired rate w = d', where two steps agree on it (what one step alone does is
another correction, no motion of the posture), the limits r of the rates, and the offset o,

    s = min(1, 0.5 / max_j |w_j| / r_j),   by no more than dt / 0.5 s larger than before,       (1)
    f = s w + (s - s_before) d_before / dt,   e = o + f dt - s d.

Each step of dt follows the rate f and takes e back along its own direction,

    v = f - e / T,   T = max_j |e_j| / u_j,   u_j = (a / 2) (sqrt(dt^2 + 4 |e_j| / a) - dt)     (2)

where u_j is the fastest rate that half of the acceleration a still brings to rest within |e_j| in
steps of dt, and no more than the limit at rest. Then each joint's v is held to its limits, and a
joint that may reach s d and stay with it does so exactly.
"""

from dataclasses import astuple, dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.damping import POSITION_ERROR, TCP_SHIFT, WEAK
from robocal_ros.correction.solution import (
    correct_staged,
    rates_at,
    velocity_by_differences,
    within,
)
from robocal_ros.ground.compiled import bare, kernel, lean

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]

# rows of the limits (4, n) and of a limiter's state (5, n)
REST_RATE, REST_ACCELERATION, RATE, ACCELERATION = range(4)
OFFSET, OFFSET_RATE, DESIRED, DESIRED_RATE, SHARE = STATE = range(5)
# rows of its memory (19, n) after those of the state: the last target, as it was followed, and what
# went out; the most that was withheld of each joint, and of all together, and what went out then;
# the offset wanted for a target, the velocities that go out with it, scratch; and what is tried: a
# state, and what would go out
TAUGHT, OUT, MOST, WORST, WORST_OUT, WANTED, VELOCITY = range(5, 12)
TRIED, MEMORY = 13, 19
# A desired rate may have so much of its limit before less of the offset is aimed at; all of it
# comes back in so long, s.
FULL_RATE, WHOLE_S = 0.5, 0.5
# Time steps of a path are divided until they are at most so long, s.
LONGEST_STEP_S = 0.02
MOST_STEPS = 10_000
# A joint that was given no faster than this stands, rad/s (prismatic: m/s).
STILL = 1e-3
ROUNDING = 1e-9
NOT_WITHIN = -2.0  # a target that is not solved within all bounds
# What is said of the targets: how many were corrected in part; of the last one the error at the
# tool that the drift would have made, the largest offset wanted and the error that is left; whether
# anything is added, and whether a joint's velocity is too high.
REDUCED, SHIFT, LARGEST, REMAINING, ADDS, TOO_FAST = range(6)
FIGURES = 6
# Serialized targets, see `follow_serialized`.
ENCAPSULATION = 4  # bytes of a message before those by which its numbers are aligned
STAMP, FRAME = ENCAPSULATION, ENCAPSULATION + 8  # where these begin
# what becomes of a target: nothing went out, as it is laid out otherwise or is for the long way; it
# went out, corrected or as it came; and it did, but its velocities are too high
UNUSUAL, CORRECTED_ONE, UNCHANGED_ONE, FAST_ONE = range(4)
# rows of a target's room: what is read, and what was out before
GIVEN, GIVEN_RATE, BEFORE = range(3)
ACTIVE, PACE, FASTEST, MOST_BELIEVED = range(4)  # rows of a stream's joints


@dataclass(frozen=True)
class OffsetLimits:
    """Fastest change of the offset of one joint: rad/s and rad/s^2 (prismatic: m/s, m/s^2)."""

    rest: float  # while the joints are given no motion
    rest_acceleration: float
    motion: float  # while they are
    motion_acceleration: float

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for limits in motion below those at rest, or none."""
        if not (0.0 < self.rest <= self.motion) or not (
            0.0 < self.rest_acceleration <= self.motion_acceleration
        ):
            raise ValueError(
                f"limits of the offset must be positive, and greatest in motion: {self}"
            )


TURNING = OffsetLimits(*np.radians([2.0, 20.0, 10.0, 200.0]).tolist())
SLIDING = OffsetLimits(5e-3, 50e-3, 25e-3, 0.5)


@lean
def _range(
    rate: float, dt: float, moves: bool, limits: Array, j: int
) -> tuple[float, float, float]:
    """Least and largest rate of joint ``j`` after a step, and the acceleration that it may have.

    One that is faster than the limit at rest as the motion ends slows down as in motion.
    """
    fastest, acceleration = limits[RATE, j], limits[ACCELERATION, j]
    if not moves:
        fastest = limits[REST_RATE, j]
        if abs(rate) <= fastest:
            acceleration = limits[REST_ACCELERATION, j]
        else:
            fastest = max(fastest, abs(rate) - acceleration * dt)
    change = acceleration * dt
    return max(-fastest, rate - change), min(fastest, rate + change), acceleration


@lean
def _agreed(rate: float, before: float) -> float:
    """Smaller of two rates, 0 where they differ in direction."""
    if rate * before <= 0.0:
        return 0.0
    return rate if abs(rate) < abs(before) else before


@lean
def _aim(
    state: Array, desired: Array, dt: float, share: float, j: int
) -> tuple[float, float, float]:
    """What joint ``j`` aims at, the rate that it follows, and what is left to aim at then."""
    d, before = desired[j], state[DESIRED, j]
    follows = share * _agreed((d - before) / dt, state[DESIRED_RATE, j])
    follows += (share - state[SHARE, j]) * before / dt
    return share * d, follows, share * d - state[OFFSET, j] - follows * dt


@bare
def advance(
    state: Array, desired: Array, dt: float, moves: bool, limits: Array, active: Array
) -> None:
    """One step of ``dt`` > 0 towards ``desired`` (n,), of the joints that are active (n,)."""
    n, slowest, share, fastest = desired.shape[0], dt, 1.0, FULL_RATE
    for j in range(n):
        if active[j] != 0.0:
            rate = _agreed((desired[j] - state[DESIRED, j]) / dt, state[DESIRED_RATE, j])
            fastest = max(fastest, abs(rate) / limits[RATE, j])
            share = min(share, state[SHARE, j] + dt / WHOLE_S)
    share = min(share, FULL_RATE / fastest)
    for j in range(n):
        if active[j] == 0.0:
            continue
        acceleration = _range(state[OFFSET_RATE, j], dt, moves, limits, j)[2]
        size = abs(_aim(state, desired, dt, share, j)[2])
        if size > 0.0:
            half = 0.5 * acceleration
            u = half * (np.sqrt(dt * dt + 2.0 * size / half) - dt)
            u = min(u, limits[REST_RATE, j])
            slowest = max(slowest, size / u) if u > 0.0 else slowest
    for j in range(n):
        if active[j] == 0.0:
            continue
        rate, offset = state[OFFSET_RATE, j], state[OFFSET, j]
        least, most, acceleration = _range(rate, dt, moves, limits, j)
        aim, follows, left = _aim(state, desired, dt, share, j)
        reaches = (aim - offset) / dt
        if abs(reaches - follows) <= acceleration * dt and least <= reaches <= most:
            state[OFFSET, j], state[OFFSET_RATE, j] = aim, reaches
        else:
            v = min(max(follows + left / slowest, least), most)
            state[OFFSET, j], state[OFFSET_RATE, j] = offset + v * dt, v
        state[DESIRED_RATE, j] = (desired[j] - state[DESIRED, j]) / dt
        state[DESIRED, j], state[SHARE, j] = desired[j], share


@bare
def put_out(
    memory: Array, goal: Array, desired: Array, elapsed: float, longest: float, limits: Array,
    active: Array, fastest: Array, span: Array,
) -> float:  # fmt: skip
    """Put one target of a stream out, if no joint is too fast on the way.

    Parameters
    ----------
    memory : (19, n) of the limiter.
    elapsed, longest : time since the last output, and what of it a step may use.
    active : (n,) 1 for the joints that go out.
    fastest, span : (n,) speeds of the joints, (2, n) their limits.

    Returns
    -------
    float
        Largest share of its speed that a joint takes; -1 where one would be beyond its limits.
        Unless it is between 0 and 1, nothing has changed but what is tried.
    """
    n, fast, share, inside = goal.shape[0], 0.0, 0.0, True
    tried, would, taught, out = memory[TRIED : MEMORY - 1], memory[-1], memory[TAUGHT], memory[OUT]
    for j in range(n):
        for row in range(SHARE + 1):
            tried[row, j] = memory[row, j]
        if active[j] != 0.0:
            fast = max(fast, abs(goal[j] - taught[j]))
    if longest > 0.0:
        moves = fast > STILL * elapsed
        advance(tried, desired, min(longest, LONGEST_STEP_S), moves, limits, active)
    for j in range(n):
        tried[DESIRED, j] = desired[j]
        would[j] = goal[j] + tried[OFFSET, j]
        if active[j] != 0.0:
            inside &= span[0, j] - ROUNDING <= would[j] <= span[1, j] + ROUNDING
            step = abs(would[j] - out[j])
            if not step <= ROUNDING:  # also where it is not known what went out
                known = longest > 0.0 and step < np.inf
                share = max(share, step / (fastest[j] * longest) if known else np.inf)
    if not (inside and share <= 1.0 + ROUNDING):
        return share if inside else -1.0
    now, worst = 0.0, 0.0
    for j in range(n):
        for row in range(SHARE + 1):
            memory[row, j] = tried[row, j]
        if active[j] != 0.0:
            taught[j], out[j] = goal[j], would[j]
            withheld = abs(memory[OFFSET, j] - memory[DESIRED, j])
            memory[MOST, j] = max(memory[MOST, j], withheld)
            now += withheld
        worst += abs(memory[WORST, j])
    if now > worst:
        for j in range(n):
            memory[WORST, j] = (memory[OFFSET, j] - memory[DESIRED, j]) * active[j]
            memory[WORST_OUT, j] = out[j]
    return share


@kernel
def follow(
    state: Array, desired: Array, times: Array, speed: Array, limits: Array, active: Array,
    offsets: Array, rates: Array,
) -> None:  # fmt: skip
    """Offsets and rates (m, n) at the points of a path with the desired ones (m, n).

    Parameters
    ----------
    times : (m,) of the points, from the instant of ``state`` on; one at 0 or before has that
        state's offset.
    speed : (m,) fastest joint on the way to each point.
    """
    m, n = desired.shape
    at, before = 0.0, np.empty(n)
    between = np.empty(n)
    for k in range(m):
        dt = times[k] - at
        if dt > 0.0:
            steps = min(int(np.ceil(dt / LONGEST_STEP_S)), MOST_STEPS)
            for j in range(n):
                before[j] = state[DESIRED, j]
                # another correction than before comes at once, not as the posture moves
                if at == 0.0 and abs(desired[k, j] - before[j]) > limits[RATE, j] * dt:
                    before[j] = desired[k, j]
            for i in range(steps):
                part = (i + 1) / steps
                for j in range(n):
                    between[j] = desired[k, j]
                    if i + 1 < steps:
                        between[j] = before[j] + part * (desired[k, j] - before[j])
                advance(state, between, dt / steps, speed[k] > STILL, limits, active)
            at = times[k]
        for j in range(n):
            offsets[k, j], rates[k, j] = state[OFFSET, j], state[OFFSET_RATE, j]


@bare
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
    n, report, whole = goal.shape[0], reports[0], True
    correct_staged(goal, largest, free, works, report)
    if not within(goal, report, bounds, tcp, memory[WANTED]):
        return NOT_WITHIN
    share = put_out(memory, goal, memory[WANTED], elapsed, longest, limits, active, speeds[0], span)
    figures[SHIFT], figures[LARGEST] = report[0, n + TCP_SHIFT], 0.0
    figures[REMAINING], figures[ADDS], figures[TOO_FAST] = 0.0, 0.0, 0.0
    for stage in range(report.shape[0]):
        whole = whole and report[stage, n + WEAK] == 0.0
        figures[REMAINING] += report[stage, n + POSITION_ERROR]
    for j in range(n):
        figures[LARGEST] = max(figures[LARGEST], abs(memory[WANTED, j]))
        if memory[OFFSET, j] != 0.0:
            figures[ADDS] = 1.0
    if not 0.0 <= share <= 1.0 + ROUNDING:
        return share
    if not whole:
        figures[REDUCED] += 1.0
    out, exact = memory[VELOCITY], True
    for j in range(n):
        exact = exact and memory[OFFSET, j] == memory[DESIRED, j]
        out[j] = velocity[j] + memory[OFFSET_RATE, j]
    if exact:
        taught, corrected, last = memory[TAUGHT], memory[OUT], works.shape[0] - 1
        none, unused = memory[TRIED], memory[TRIED + 1]
        for j in range(n):
            none[j] = 0.0
        if not (
            whole and n == 6 and not free
            and rates_at(taught, velocity, none, corrected, works[0], works[last], out, unused)
        ):  # fmt: skip
            velocity_by_differences(
                taught, velocity, corrected, largest, free, works, memory[VELOCITY + 1],
                reports[1], out,
            )  # fmt: skip
    for j in range(n):
        if active[j] != 0.0 and not abs(out[j]) <= speeds[1, j] * (1.0 + ROUNDING):
            figures[TOO_FAST] = 1.0
    return share


@bare
def follow_serialized(
    elapsed: float, came: Array, like: Bytes, at: int, rates_at: int, out: Array, out_at: int,
    out_rates_at: int, room: Array, joints: Array, memory: Array, limits: Array, span: Array,
    bounds: Array, tcp: Array, largest: Array, free: bool, works: Array, reports: Array,
    figures: Array,
) -> int:  # fmt: skip
    """Correct a serialized target of all n joints and put it out: see `step_out`.

    Parameters
    ----------
    came, out : the message and what goes out, with all that is not the stamp or a number, behind
        `ENCAPSULATION` bytes. Positions begin at ``at`` and ``out_at``, velocities at ``rates_at``
        and ``out_rates_at``, in numbers; 0 where there are none.
    like : (2, b) a message that is laid out as this must be, and 255 for each byte that must be
        the same.
    room : (3, n) for what is read, and what was put out before.
    joints : (4, n) 1 where active, speeds in this step and ever, largest position believed.

    Returns
    -------
    int
        What became of it.
    """
    n, unlike, q, velocity = room.shape[1], np.uint8(0), room[GIVEN], room[GIVEN_RATE]
    data, written = came.view(np.uint8), out.view(np.uint8)
    for i in range(like.shape[1]):
        unlike |= (data[ENCAPSULATION + i] ^ like[0, i]) & like[1, i]
    fine = unlike == 0
    for j in range(n):
        q[j], velocity[j], room[BEFORE, j] = came[at + j], 0.0, memory[OUT, j]
        if rates_at > 0:
            velocity[j] = came[rates_at + j]
        fine = fine and abs(q[j]) <= joints[MOST_BELIEVED, j] and np.isfinite(velocity[j])
    if not fine:
        return UNUSUAL
    share = step_out(
        q, velocity, elapsed, elapsed, memory, limits, joints[ACTIVE], joints[PACE : FASTEST + 1],
        span, bounds, tcp, largest, free, works, reports, figures,
    )  # fmt: skip
    if not 0.0 <= share <= 1.0 + ROUNDING:
        return UNUSUAL
    for i in range(ENCAPSULATION + STAMP, ENCAPSULATION + FRAME):
        written[i] = data[i]
    for j in range(n):
        out[out_at + j] = memory[OUT, j]
        if out_rates_at > 0:
            out[out_rates_at + j] = memory[VELOCITY, j]
    if rates_at > 0 and figures[TOO_FAST] != 0.0:
        return FAST_ONE
    return CORRECTED_ONE if figures[ADDS] != 0.0 else UNCHANGED_ONE


class OffsetLimiter:
    """The offset of each joint, which never jumps.

    Attributes
    ----------
    memory : (19, n) its rows are those named above.
    state : (5, n) of it: offset, its rate, the desired offset, its rate and the share of it aimed
        at.
    limits : (4, n).
    """

    def __init__(self, prismatic: NDArray[np.bool_], turning: OffsetLimits, sliding: OffsetLimits):
        n = len(prismatic)
        rows = (np.array(astuple(of))[:, None] for of in (sliding, turning))
        self.limits = np.ascontiguousarray(np.where(prismatic, *rows))
        self.memory = np.zeros((MEMORY, n))
        self.memory[SHARE] = 1.0
        self.memory[[TAUGHT, OUT]] = np.nan
        self.state = self.memory[: len(STATE)]

    def begin(self, index: NDArray[np.int64], offset: Array, desired: Array) -> None:
        """Joints ``index`` (k,) stand with an offset (k,), at rest."""
        self.state[OFFSET, index] = offset
        self.state[OFFSET_RATE, index] = 0.0
        self.state[DESIRED, index] = desired
        self.state[DESIRED_RATE, index], self.state[SHARE, index] = 0.0, 1.0

    @property
    def withheld(self) -> Array:
        """(n,) offset less the desired one."""
        return np.asarray(self.memory[OFFSET] - self.memory[DESIRED])

    def follow(
        self, desired: Array, times: Array, speed: Array, active: Array
    ) -> tuple[Array, Array]:
        """Offsets and rates (m, n) along a path; see `follow`. The state is that of its end."""
        offsets, rates = np.empty_like(desired), np.empty_like(desired)
        follow(self.state, desired, times, speed, self.limits, active, offsets, rates)
        return offsets, rates
