"""Trajectories against interpolation that is written out here."""

import numpy as np
import pytest

from robocal_ros.core.errors import InputError
from robocal_ros.sim.joint_motion import BRAKES_S, ROOM, JointMotion

HOME = np.array([0.1, -0.4])


def hermite(t, t0, t1, q0, q1, v0, v1):
    """Cubic with these ends, by the four basis polynomials."""
    h = t1 - t0
    s = (t - t0) / h
    return (
        (1 + 2 * s) * (1 - s) ** 2 * q0 + s * (1 - s) ** 2 * h * v0
        + s**2 * (3 - 2 * s) * q1 + s**2 * (s - 1) * h * v1
    )  # fmt: skip


def points(seed: int = 0, count: int = 6):
    rng = np.random.default_rng(seed)
    time = 1.0 + np.cumsum(0.05 + 0.5 * rng.random(count))
    return time, rng.standard_normal((count, 2)), rng.standard_normal((count, 2))


def test_between_points_lie_cubics():
    time, q, qd = points()
    motion = JointMotion(HOME)
    motion.follow(1.0, time, q, qd)
    all_t = np.concatenate([[1.0], time])
    all_q, all_qd = np.vstack([HOME, q]), np.vstack([np.zeros(2), qd])
    for i in range(len(time)):
        for t in np.linspace(all_t[i], all_t[i + 1], 7):
            wanted = hermite(
                t, all_t[i], all_t[i + 1], all_q[i], all_q[i + 1], all_qd[i], all_qd[i + 1]
            )
            assert motion.at([t])[0][0] == pytest.approx(wanted, abs=1e-9)
    position, velocity = motion.at([all_t[2], time[-1], time[-1] + 5.0])
    assert velocity[0] == pytest.approx(all_qd[2], abs=1e-9)
    assert position[1:] == pytest.approx(np.tile(q[-1], (2, 1)), abs=1e-12)
    assert not velocity[1:].any()  # at its end it stands


def test_positions_alone_are_joined_by_lines():
    motion = JointMotion(HOME)
    motion.follow(0.0, [1.0, 3.0], [[0.5, 0.0], [0.5, 1.0]])
    q, qd = motion.at([0.5, 2.0])
    assert q == pytest.approx(np.array([[0.3, -0.2], [0.5, 0.5]]), abs=1e-12)
    assert qd == pytest.approx(np.array([[0.4, 0.4], [0.0, 0.5]]), abs=1e-12)


def test_accelerations_make_quintics():
    """A polynomial of degree five is followed exactly."""
    p = np.polynomial.Polynomial([0.0, 0.0, 0.0, 4.0, -3.0, 0.7])
    time = np.array([0.4, 1.1])
    rows = [np.column_stack([d(time), -d(time)]) for d in (p, p.deriv(), p.deriv(2))]
    motion = JointMotion(np.zeros(2))
    motion.follow(0.0, time, *rows)
    t = np.linspace(0.0, 1.1, 23)
    assert motion.at(t)[0] == pytest.approx(np.column_stack([p(t), -p(t)]), abs=1e-12)


def test_a_new_trajectory_takes_over_where_the_old_one_is():
    time, q, qd = points()
    motion = JointMotion(HOME)
    motion.follow(1.0, time, q, qd)
    now = float(time[2]) + 0.07
    (before,), (speed,) = motion.at([now])
    # Its first point is where the robot was a moment ago, as somebody measured it.
    motion.follow(now, [now - 0.01, now, now + 0.5], [HOME, HOME, HOME], np.zeros((3, 2)))
    at, velocity = motion.at([now, now + 0.5])
    assert at[0] == pytest.approx(before, abs=1e-12)
    assert velocity[0] == pytest.approx(speed, abs=1e-9)
    assert at[1] == pytest.approx(HOME, abs=1e-12)


def test_it_holds_at_once():
    time, q, qd = points()
    motion = JointMotion(HOME)
    motion.follow(1.0, time, q, qd)
    now = float(time[1]) + 0.01
    (before,), _ = motion.at([now])
    motion.hold(now)
    at, velocity = motion.at([now, now + 9.0])
    assert at == pytest.approx(np.tile(before, (2, 1)), abs=1e-15)
    assert not velocity.any()
    assert motion.end_s == now


@pytest.mark.parametrize(
    ("time", "q", "words"),
    [
        ([0.5], [HOME], "in the past"),
        ([2.0, 2.0], [HOME, HOME], "do not increase"),
        ([2.0], [[np.nan, 0.0]], "not finite"),
        ([2.0], [[0.0]], "shape"),
    ],
)
def test_what_cannot_be_followed_changes_nothing(time, q, words):
    motion = JointMotion(HOME)
    motion.follow(0.0, [1.0, 4.0], [HOME + 1.0, HOME], np.zeros((2, 2)))
    before = motion.at([1.5, 3.0])[0]
    with pytest.raises(InputError, match=words):
        motion.follow(1.0, time, q, np.zeros(np.shape(q)))
    assert np.array_equal(motion.at([1.5, 3.0])[0], before)


# ---- drives --------------------------------------------------------------------------------------

FASTEST = np.array([2.0, 3.0])
REST = np.zeros((1, 2))


def driven(q=HOME) -> JointMotion:
    return JointMotion(q, FASTEST)


def test_a_jump_is_a_drive_fault_and_the_robot_brakes():
    motion = driven()
    assert motion.follow(0.0, [2.0], [HOME + 2.0], REST)
    now = 1.0
    (here,), (speed,) = motion.at([now])
    assert speed == pytest.approx([1.5, 1.5])
    assert not motion.follow(now, [now + 0.008, now + 5.0], [here + 1.0, HOME], np.zeros((2, 2)))
    assert motion.faults == 1
    assert "joint 1 is sent at 18" in motion.fault  # a cubic's peak: 1.5 times 1 rad in 8 ms
    assert motion.peak_share > 80.0
    long_s = BRAKES_S * 1.5 / 2.0  # the first joint is nearest to its greatest speed
    assert motion.end_s == pytest.approx(now + long_s)
    time = now + np.linspace(0.0, long_s, 50)
    q, qd = motion.at(time)
    assert q[0] == pytest.approx(here, abs=1e-12)
    assert qd == pytest.approx((speed * (1.0 - (time - now) / long_s)[:, None]), abs=1e-9)
    assert q[-1] == pytest.approx(here + 0.5 * long_s * speed, abs=1e-12)
    assert motion.follow(motion.end_s, [motion.end_s + 2.0], [HOME], REST)
    assert motion.faults == 1


def test_a_robot_at_rest_stays_there_at_a_jump():
    motion = driven()
    assert not motion.follow(0.0, [0.008], [HOME + 1.0])
    assert motion.end_s == 0.0
    assert np.array_equal(motion.at([0.0, 1.0])[0], [HOME, HOME])


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("at", [0.1, 0.5, 0.77])
def test_the_peak_between_points_counts(order, at):
    """The true peak by the finest look; it is found to 1 % wherever it lies."""
    rows = [[[1.1, 0.6], [0.1, 1.6]], [[0.3, -0.4], [0.0, 0.0]], np.zeros((2, 2))][:order]
    free = JointMotion(HOME)
    assert free.follow(0.0, [at, 1.0], *rows)
    finest = np.max(np.abs(free.at(np.linspace(0.0, 1.0, 200_001))[1]), axis=0)
    assert free.peak == pytest.approx(finest, rel=0.01)
    for share, taken in ((1.0 + 0.8 * ROOM, True), (1.0 + 1.3 * ROOM, False)):
        motion = JointMotion(HOME, finest / share)
        assert motion.follow(0.0, [at, 1.0], *rows) is taken
        assert motion.faults == (not taken)
