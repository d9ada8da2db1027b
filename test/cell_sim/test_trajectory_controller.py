# SPDX-License-Identifier: Apache-2.0
"""The simulated controller and its drives, against interpolation written out here; its faults."""

from dataclasses import replace

import numpy as np
import pytest
from cell_plans import Q_START, plan_of

from robocal_ros.cell_sim.cell import SimulatedCell
from robocal_ros.cell_sim.trajectory_controller import (
    BRAKES_S,
    CYCLE_S,
    ROOM,
    GoalCode,
    GoalState,
    JointMotion,
    Tolerances,
    Trajectory,
    TrajectoryGoal,
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


ZERO = np.zeros((1, 6))
FAR = Q_START + 0.5


def to(q, time_s=1.0) -> Trajectory:
    return Trajectory.of(plan_of().arm.joint_names, [time_s], np.reshape(q, (1, 6)), ZERO)


def moving(fault: str = "none", size: float = 0.0, goal: bool = False, **plan):
    """A cell half a second into a motion of a second, and its goal."""
    cell = SimulatedCell(plan_of(**plan))
    given = TrajectoryGoal(to(FAR)) if goal else to(FAR)
    cell.gate.take(given, cell.now_s)
    cell.advance(0.504)
    cell.set_fault(fault, size)
    return cell, given


def at_end(cell: SimulatedCell, to_s: float = 20.0) -> np.ndarray:
    cell.advance(to_s)
    assert not cell.moving
    return cell.motion.at([cell.now_s])[0][0]


@pytest.mark.parametrize("lost", [1, 2])
def test_so_many_commands_that_come_in_motion_are_lost(lost):
    cell, _ = moving("commands_lost", lost)
    for i in range(lost):
        cell.gate.take(to(Q_START, 0.2), cell.now_s)
        cell.advance(cell.now_s + 0.1)
        q = cell.motion.at([cell.now_s])[0][0, 0] - Q_START[0]
        assert q > 0.25 + 0.02 * i  # it goes on
    cell.gate.take(to(Q_START, 0.2), cell.now_s)
    assert at_end(cell) == pytest.approx(Q_START, abs=1e-12)


def test_a_lost_goal_ends_well_where_the_one_before_it_ends():
    cell, first = moving("commands_lost", goal=True)
    second = TrajectoryGoal(to(Q_START, 0.2))
    cell.gate.take(second, cell.now_s)
    assert (first.state, first.code) == (GoalState.ABORTED, GoalCode.INVALID_GOAL)
    assert at_end(cell) == pytest.approx(FAR, abs=1e-12)
    assert second.state is GoalState.SUCCEEDED


def test_a_share_of_the_topic_is_lost_and_no_goal():
    cell = SimulatedCell(plan_of())
    cell.set_fault("commands_lossy", 0.3)
    came = 0
    for i in range(300):
        before = cell.motion.controller._new
        cell.gate.take(to(Q_START + 1e-3 * i), cell.now_s)
        came += cell.motion.controller._new is not before
    assert came == pytest.approx(210, abs=4.0 * np.sqrt(300 * 0.21))
    for _ in range(20):
        goal = TrajectoryGoal(to(FAR))
        cell.gate.take(goal, cell.now_s)
        assert cell.motion.controller.active is goal


def test_a_late_command_takes_effect_later():
    cell, _ = moving("commands_late", 200.0)
    cell.gate.take(to(Q_START, 0.3), cell.now_s)
    cell.advance(0.7)
    assert cell.motion.at([cell.now_s])[0][0, 0] > Q_START[0] + 0.35
    assert at_end(cell) == pytest.approx(Q_START, abs=1e-12)


def test_a_late_goal_that_is_over_by_then_is_aborted():
    cell, first = moving("commands_late", 200.0, goal=True)
    goal = TrajectoryGoal(replace(to(Q_START, 0.1), start_s=cell.now_s))
    cell.gate.take(goal, cell.now_s)
    assert at_end(cell) == pytest.approx(FAR, abs=1e-12)
    assert (goal.state, goal.code) == (GoalState.ABORTED, GoalCode.INVALID_GOAL)
    assert "in the past" in goal.text
    assert first.state is GoalState.SUCCEEDED


def test_what_is_late_when_the_controller_is_deactivated_never_takes_effect():
    cell, _ = moving("commands_late", 200.0)
    goal = TrajectoryGoal(to(Q_START, 0.3))
    for given in (goal, to(Q_START, 0.3)):
        cell.gate.take(given, cell.now_s)
    cell.hold()
    assert (goal.state, goal.code) == (GoalState.ABORTED, GoalCode.INVALID_GOAL)
    stood = cell.advance(0.6).q[-1]
    assert at_end(cell) == pytest.approx(stood, abs=1e-12)


def test_commands_are_rejected():
    cell, _ = moving("commands_rejected")
    with pytest.raises(InputError, match="commands_rejected"):
        cell.gate.take(to(Q_START), cell.now_s)
    assert at_end(cell) == pytest.approx(FAR, abs=1e-12)


def test_a_protective_stop_halts_for_its_time_and_goes_on():
    cell, goal = moving("protective_stop", 10.0, goal=True)
    cell.advance(0.6)
    halted = cell.motion.at([cell.now_s])[0]
    came = cell.advance(10.4, readings=True)
    assert np.max(np.abs(came.q - halted)) < 1e-12
    assert goal.state is GoalState.EXECUTING
    assert at_end(cell) == pytest.approx(FAR, abs=1e-12)
    assert goal.state is GoalState.SUCCEEDED


@pytest.mark.parametrize("percent", [10.0, 50.0, 95.0])
def test_a_scaled_motion_takes_longer_and_ends_where_it_shall(percent):
    cell = SimulatedCell(plan_of())
    cell.set_fault("speed_scaling", percent)
    cell.gate.take(to(FAR), cell.now_s)
    came = cell.advance(12.0)
    away = np.abs(came.q[:, 0] - Q_START[0])
    long_s = came.time_s[np.argmax(away >= 0.5 - 1e-9)] - came.time_s[np.argmax(away > 0.0)]
    assert long_s == pytest.approx(100.0 / percent, rel=0.01)  # less the first cycle, unscaled


def test_a_goal_that_stays_outside_its_tolerance_ends_after_its_time_or_never():
    """Drives that lag are outside at the end, and then inside."""
    for time_s, state in ((0.0, GoalState.SUCCEEDED), (0.004, GoalState.ABORTED)):
        cell = SimulatedCell(plan_of(lag_s=0.1))
        tolerances = Tolerances(np.zeros(6), np.full(6, 1e-6), time_s)
        goal = TrajectoryGoal(to(FAR, 0.2), tolerances)
        cell.gate.take(goal, cell.now_s)
        cell.advance(0.22)
        cell.advance(1.0)
        assert goal.state is state
    assert goal.code is GoalCode.GOAL_TOLERANCE_VIOLATED


def test_a_cancel_takes_the_command_back_by_the_lag():
    cell, goal = moving(goal=True, lag_s=0.014)
    sent = cell.motion.last()[1][2, 0]
    here = cell.motion.here[0, 0]
    cell.motion.cancel(cell.now_s, goal)
    cell.advance(1.0)
    assert goal.state is GoalState.CANCELED
    assert cell.motion.at([1.0])[0][0, 0] == pytest.approx(here, abs=1e-12)
    assert sent - here == pytest.approx(0.75 * 0.014, rel=0.35)
