"""Faults of the way to the simulated controller, of its speed, and how its goals end."""

import numpy as np
import pytest
from cell_plans import Q_START, plan_of

from robocal_ros.cell_sim.cell import SimulatedCell
from robocal_ros.cell_sim.trajectory_controller import (
    GoalCode,
    GoalState,
    Tolerances,
    Trajectory,
    TrajectoryGoal,
)
from robocal_ros.ground.errors import InputError

REST = np.zeros((1, 6))
FAR = Q_START + 0.5


def to(q, time_s=1.0) -> Trajectory:
    return Trajectory.of(plan_of().arm.joint_names, [time_s], np.reshape(q, (1, 6)), REST)


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
