# SPDX-License-Identifier: Apache-2.0
"""The limiter by itself: whatever is wanted of it, what it lets out keeps its limits over time."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.correction.limiter import (
    ACCELERATION,
    LONGEST_STEP_S,
    OFFSET,
    OUT,
    RATE,
    REST_ACCELERATION,
    REST_RATE,
    SLIDING,
    TAUGHT,
    TRIED,
    TURNING,
    OffsetLimiter,
    put_out,
)

SLIDES = np.arange(6) >= 4  # the last two joints
REACH = np.where(SLIDES, 10e-3, np.radians(5.0))  # of what is wanted
FASTEST = np.where(SLIDES, 1.0, 3.0)
ROUNDING = 1e-9
STEPS = 400


def wanted(rng: np.random.Generator, times: np.ndarray) -> np.ndarray:
    """Offsets (m, 6) that wander, jump, tremble, or go faster than they may."""
    m = len(times)
    jumps = np.cumsum(rng.standard_normal((m, 6)) * (rng.random((m, 1)) < 0.02), axis=0)
    speeds = 10.0 ** rng.uniform(-1.0, 2.0, 6)
    swings = np.sin(times[:, None] * speeds + rng.uniform(0.0, 6.0, 6))
    trembles = rng.standard_normal((m, 6))
    shares = rng.dirichlet([0.5, 0.5, 0.5])
    return np.asarray(REACH * (shares[0] * jumps + shares[1] * swings + shares[2] * trembles))


def limiter_of() -> OffsetLimiter:
    return OffsetLimiter(SLIDES, TURNING, SLIDING)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_whatever_is_wanted_the_offset_keeps_its_limits_and_comes_in(seed: int) -> None:
    rng, limiter = np.random.default_rng(seed), limiter_of()
    limits, active = limiter.limits, np.where(rng.random(6) < 0.8, 1.0, 0.0)
    dt = rng.uniform(1e-4, LONGEST_STEP_S, STEPS)
    times = np.cumsum(dt)
    moves = np.repeat(rng.random(STEPS // 20) < 0.6, 20)
    desired = wanted(rng, times)
    offsets, _ = limiter.follow(desired, times, np.where(moves, 1.0, 0.0), active)
    rate = np.diff(offsets, axis=0, prepend=0.0) / dt[:, None]
    before = np.vstack([np.zeros(6), rate[:-1]])
    # one that is faster than it may at rest slows down as in motion
    calm = ~moves[:, None] & (np.abs(before) <= limits[REST_RATE] + ROUNDING)
    rounding = ROUNDING / dt[:, None]
    assert np.all(np.abs(rate) <= np.where(calm, limits[REST_RATE], limits[RATE]) + rounding)
    most = np.where(calm, limits[REST_ACCELERATION], limits[ACCELERATION]) * dt[:, None]
    assert np.all(np.abs(rate - before) <= most + 2.0 * rounding)
    assert np.all(offsets[:, active == 0.0] == 0.0)

    still = np.arange(1, 10_000) * 0.01
    last = np.tile(desired[-1], (len(still), 1))
    offsets, rates = limiter.follow(last, still, 0.0 * still, active)
    assert np.all(offsets[-1] == np.where(active, desired[-1], 0.0))
    assert not rates[-1][active > 0.0].any()


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_target_goes_out_within_the_joints_speeds_and_limits_or_changes_nothing(
    seed: int,
) -> None:
    rng, limiter = np.random.default_rng(seed), limiter_of()
    memory, span = limiter.memory, np.stack([-REACH, REACH]) * 3.0
    memory[[TAUGHT, OUT]], out, went = 0.0, np.zeros(6), 0
    speed = FASTEST * 10.0 ** rng.uniform(-2.0, 0.5)
    for desired in wanted(rng, np.arange(STEPS) * 0.004):
        elapsed = 0.004 * rng.choice([1.0, 1.0, 0.0, 3.0, 100.0])
        longest = min(elapsed, 0.008)
        active = np.where(rng.random(6) < 0.9, 1.0, 0.0)
        goal = memory[TAUGHT] + rng.uniform(-1.0, 1.0, 6) * speed * elapsed * (rng.random() < 0.8)
        known = memory.copy()
        share = put_out(
            memory, goal, desired, elapsed, longest, limiter.limits, active, FASTEST, span
        )
        if 0.0 <= share <= 1.0 + ROUNDING:
            assert np.all(np.abs(memory[OUT] - out) <= FASTEST * longest + 2.0 * ROUNDING)
            chosen = active > 0.0
            assert np.all(np.abs(memory[OUT][chosen]) <= span[1, chosen] + ROUNDING)
            assert np.array_equal(memory[OUT][chosen], (goal + memory[OFFSET])[chosen])
            assert np.array_equal(memory[OUT][~chosen], out[~chosen])
            out, went = memory[OUT].copy(), went + 1
        else:
            assert np.array_equal(memory[:TRIED], known[:TRIED])
    assert went > STEPS // 10
