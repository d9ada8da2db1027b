"""Joints behind a trajectory controller, against interpolation that is written out here."""

import numpy as np
import pytest

from robocal_ros.cell_sim.trajectory_controller import (
    BRAKES_S,
    CYCLE_S,
    ROOM,
    JointMotion,
    Trajectory,
)
from robocal_ros.ground.errors import InputError

HOME = np.array([0.1, -0.4])
FASTEST = np.array([2.0, 3.0])
REST = np.zeros((1, 2))
RNG = np.random.default_rng(0)
TIME = 1.0 + CYCLE_S * np.cumsum(RNG.integers(10, 150, 6))
Q, QD = RNG.standard_normal((6, 2)), RNG.standard_normal((6, 2))
QD[-1] = 0.0


def hermite(t, t0, t1, q0, q1, v0, v1):
    """Cubic with these ends, by the four basis polynomials."""
    h = t1 - t0
    s = (t - t0) / h
    return (
        (1 + 2 * s) * (1 - s) ** 2 * q0 + s * (1 - s) ** 2 * h * v0
        + s**2 * (3 - 2 * s) * q1 + s**2 * (s - 1) * h * v1
    )  # fmt: skip


def test_between_points_lie_cubics():
    motion = JointMotion(HOME)
    motion.follow(1.0 - CYCLE_S, TIME, Q, QD)  # from the cycle at 1 s on
    all_t = np.concatenate([[1.0], TIME])
    all_q, all_qd = np.vstack([HOME, Q]), np.vstack([np.zeros(2), QD])
    for i in range(len(TIME)):
        for t in np.linspace(all_t[i], all_t[i + 1], 7):
            wanted = hermite(
                t, all_t[i], all_t[i + 1], all_q[i], all_q[i + 1], all_qd[i], all_qd[i + 1]
            )
            assert motion.at([t])[0][0] == pytest.approx(wanted, abs=1e-9)
    position, velocity = motion.at([all_t[2], TIME[-1], TIME[-1] + 5.0])
    assert velocity[0] == pytest.approx(all_qd[2], abs=1e-9)
    assert position[1:] == pytest.approx(np.tile(Q[-1], (2, 1)), abs=1e-12)
    assert not velocity[1:].any()  # at its end it stands
    assert motion.end_s == pytest.approx(TIME[-1], abs=CYCLE_S)


def test_positions_alone_are_joined_by_lines():
    motion = JointMotion(HOME)
    motion.follow(-CYCLE_S, [1.0, 3.0], [[0.5, 0.0], [0.5, 1.0]])
    q, qd = motion.at([0.5, 2.0])
    assert q == pytest.approx(np.array([[0.3, -0.2], [0.5, 0.5]]), abs=1e-12)
    assert qd == pytest.approx(np.array([[0.4, 0.4], [0.0, 0.5]]), abs=1e-9)


def test_accelerations_make_quintics():
    """A polynomial of degree five is followed exactly, at each cycle."""
    p = np.polynomial.Polynomial([0.0, 0.0, 0.0, 4.0, -3.0, 0.7])
    time = np.array([0.4, 1.2])
    rows = [np.column_stack([d(time), -d(time)]) for d in (p, p.deriv(), p.deriv(2))]
    rows = [
        np.vstack([part, end]) for part, end in zip(rows, ([[1, 1], [0, 0], [0, 0]]), strict=True)
    ]
    motion = JointMotion(np.zeros(2))
    motion.follow(-CYCLE_S, [*time, 2.0], *rows)
    t = np.arange(0.0, 1.2, CYCLE_S)
    assert motion.at(t)[0] == pytest.approx(np.column_stack([p(t), -p(t)]), abs=1e-12)


def test_what_was_computed_ahead_is_done_again():
    """A message takes the place of what runs at its own time, whatever was asked before it."""
    ahead, plain = JointMotion(HOME), JointMotion(HOME)
    for motion in (ahead, plain):
        motion.follow(0.9, TIME, Q, QD)
        if motion is ahead:
            motion.at([TIME[-1] + 1.0])
        motion.follow(1.2, [2.0], [HOME], REST)
    t = np.linspace(0.0, 2.5, 200)
    assert np.array_equal(ahead.at(t)[0], plain.at(t)[0])


def test_how_cycles_are_cut_does_not_matter():
    whole, pieces = JointMotion(HOME, lag_s=0.014), JointMotion(HOME, lag_s=0.014)
    for motion in (whole, pieces):
        motion.follow(1.0, TIME, Q, QD)
    t = np.arange(0.0, 3.0, 0.003)
    wanted = whole.at(t)
    found = [pieces.at([time]) for time in t]
    for i in (0, 1):
        assert np.array_equal(np.vstack([part[i] for part in found]), wanted[i])


def test_it_holds_at_once():
    motion = JointMotion(HOME)
    motion.follow(1.0, TIME, Q, QD)
    now = float(TIME[1]) + 0.01
    motion.hold(now)
    at, velocity = motion.at([now + 2.0 * CYCLE_S, now + 9.0])
    assert at[0] == pytest.approx(motion.at([now])[0][0], abs=2.0 * CYCLE_S)
    assert np.array_equal(at[0], at[1])
    assert not velocity.any()


@pytest.mark.parametrize("lag_s", [0.002, 0.008, 0.014])
def test_drives_lag_behind_their_command_and_end_where_it_ends(lag_s):
    prompt, late = JointMotion(np.zeros(1)), JointMotion(np.zeros(1), lag_s=lag_s)
    for motion in (prompt, late):
        motion.follow(0.0, [1.0, 2.0], [[0.5], [1.0]], [[0.5], [0.0]])
    t = np.linspace(0.3, 0.9, 50)  # the mean of a cubic differs by its second derivative
    assert late.at(t + lag_s)[0] == pytest.approx(prompt.at(t)[0], abs=5e-4)
    assert late.at(t)[0] == pytest.approx(prompt.at(t - lag_s)[0], abs=5e-4)
    assert late.end_s - prompt.end_s == pytest.approx(2.0 * lag_s)
    assert late.at([late.end_s])[0] == pytest.approx(1.0, abs=1e-12)
    assert late.at([late.end_s + CYCLE_S])[1] == pytest.approx(0.0, abs=1e-12)


# ---- drives --------------------------------------------------------------------------------------


def driven(q=HOME, **options) -> JointMotion:
    return JointMotion(q, FASTEST, **({"limits": True} | options))


def test_a_jump_is_a_drive_fault_and_the_robot_brakes():
    motion = driven()
    motion.follow(0.0, [2.0], [HOME + 2.0], REST)
    now = 1.0
    (here,), (speed,) = motion.at([now + CYCLE_S])  # what was sent in the cycle before the fault
    motion.follow(now, [now + 0.008, now + 5.0], [here + 1.0, HOME], np.zeros((2, 2)))
    at = now + CYCLE_S
    motion.at([at])
    long_s = BRAKES_S * speed[0] / 2.0  # the first joint is nearest to its greatest speed
    time = at + np.linspace(0.0, long_s, 50)
    q, qd = motion.at(time)
    assert motion.faults == 1
    assert motion.fault.startswith("drive fault: joint 1 is sent at")
    assert motion.peak_share > 50.0
    assert motion.end_s == pytest.approx(at + long_s, abs=CYCLE_S)
    assert q[0] == pytest.approx(here, abs=1e-9)
    braked = speed * (1.0 - (time - at) / long_s)[:, None]
    assert qd == pytest.approx(braked, abs=0.02)  # the last cycle is not a whole one
    assert q[-1] == pytest.approx(here + 0.5 * long_s * speed, abs=1e-4)
    motion.follow(motion.end_s, [motion.end_s + 2.0], [HOME], REST)
    motion.at([motion.end_s + 1.0])
    assert motion.faults == 1


def test_a_robot_at_rest_stays_there_at_a_jump():
    motion = driven()
    motion.follow(0.0, [0.008], [HOME + 1.0])
    assert motion.at([1.0])[0] == pytest.approx(HOME[None], abs=1e-12)
    assert motion.faults == 1


def test_without_limits_drives_follow_a_jump():
    motion = driven(limits=False)
    motion.follow(0.0, [0.008], [HOME + 1.0])
    assert motion.at([0.012])[0] == pytest.approx(HOME[None] + 1.0, abs=1e-12)
    assert motion.faults == 0
    assert motion.peak_share > 50.0


def test_what_is_no_number_is_a_drive_fault_too():
    motion = driven(limits=False)
    motion.follow(0.0, [1.0], [HOME * np.nan], REST)
    assert np.array_equal(motion.at([1.5])[0], [HOME])
    assert motion.faults == 1


@pytest.mark.parametrize("order", [1, 2, 3])
def test_the_peak_between_points_counts(order):
    rows = [[[1.1, 0.6], [0.1, 1.6]], [[0.3, -0.4], [0.0, 0.0]], np.zeros((2, 2))][:order]
    free = driven(limits=False)
    free.follow(-CYCLE_S, [0.5, 1.0], *rows)
    cycles = np.arange(0.0, 1.0 + CYCLE_S, CYCLE_S)
    finest = np.max(np.abs(np.diff(free.at(cycles)[0], axis=0)), axis=0) / CYCLE_S
    assert free.peak == pytest.approx(finest, rel=0.01)
    for share, faults in ((1.0 + 0.8 * ROOM, 0), (1.0 + 1.3 * ROOM, 1)):
        motion = JointMotion(HOME, finest / share, limits=True)
        motion.follow(-CYCLE_S, [0.5, 1.0], *rows)
        motion.at([2.0])
        assert motion.faults == faults


def test_the_controller_rejects_with_a_reason_and_what_runs_goes_on():
    motion = JointMotion(HOME)
    motion.follow(0.0, [4.0], [HOME + 1.0], REST)
    for time, words in (([], "empty trajectory"), ([0.5], "in the past"), ([2.0, 2.0], "increase")):
        rows = np.tile(HOME, (len(time), 1))
        with pytest.raises(InputError, match=words):
            motion.take(1.0, Trajectory.of(("joint_1", "joint_2"), time, rows, start_s=0.0))
    assert motion.at([4.1])[0] == pytest.approx(HOME[None] + 1.0, abs=1e-12)
