"""What becomes of a trajectory after it was put out: it begins, is rejected, or ends early."""

import gc
import weakref

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    NAMES,
    NOT_STRAIGHT,
    RATE,
    Robot,
    bent_tool,
    drifted,
    good_here_only,
    offer,
    refused,
    still,
)

from robocal_ros.correction.courses import Course
from robocal_ros.correction.inputs import JointCommand, TrajectoryCommand
from robocal_ros.correction.refusals import Reason

STEP_S = 0.05


class Controller:
    """Follows one trajectory at a time, from point to point; tells where it is."""

    def __init__(self) -> None:
        self.robot = Robot()
        self.robot.read(HOME)
        self.robot.session.offer_model(offer(drifted()))
        self.robot.session.offer_tool(bent_tool())
        self.robot.session.enable(True)
        self._path, self._begun = still(), self.robot.now

    def send(self, accepted: bool = True, **changes: float) -> Course:
        """Send a goal; one that is not accepted is not followed."""
        robot = self.robot
        out = robot.session.trajectory(still(**changes), robot.now, may_be_rejected=True)
        course = robot.session.course
        assert course is not None
        if accepted:
            self._path, self._begun = out, robot.now
            course.accept()
        return course

    def stop(self) -> None:
        at = self.at
        self._path = TrajectoryCommand(NAMES, np.stack([at, at]), np.array([0.0, 1.0]))

    @property
    def at(self) -> np.ndarray:
        t, times = self.robot.now - self._begun, self._path.time_from_start_s
        return np.array([np.interp(t, times, column) for column in self._path.position.T])

    def passes(self, seconds: float) -> float:
        """The largest distance of the taught readings from home."""
        worst = 0.0
        for _ in range(round(seconds / STEP_S)):
            self.robot.now += STEP_S
            worst = max(worst, float(np.abs(self.robot.read(self.at).position - HOME).max()))
        return worst


def test_a_rejected_goal_leaves_the_blend_of_the_one_that_runs() -> None:
    cell = Controller()
    cell.send()
    assert cell.passes(1.0) < NOT_STRAIGHT
    second = cell.send(accepted=False)
    assert cell.passes(0.2) < NOT_STRAIGHT  # until the answer
    second.reject()
    assert cell.passes(3.0) < NOT_STRAIGHT
    assert np.abs(cell.at - HOME).max() > RATE  # it did go on


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_two_rejected_goals_leave_it_too(order: tuple[int, int]) -> None:
    cell = Controller()
    cell.send()
    cell.passes(1.0)
    goals = [cell.send(accepted=False), cell.send(accepted=False)]
    for number in order:
        cell.passes(0.1)
        goals[number].reject()
    assert cell.passes(3.0) < NOT_STRAIGHT


def test_what_ended_meanwhile_does_not_go_on() -> None:
    cell = Controller()
    first = cell.send()
    cell.passes(1.0)
    second = cell.send(accepted=False)
    cell.passes(0.1)
    cell.stop()
    first.end(cell.robot.now)
    cell.passes(0.1)
    second.reject()
    assert cell.passes(2.0) < NOT_STRAIGHT


def test_the_end_of_what_was_superseded_stops_nothing() -> None:
    """A topic, or a stream, has taken the place of a goal that its controller then gives up."""
    cell = Controller()
    first = cell.send()
    cell.passes(0.5)
    second = cell.send()
    cell.passes(0.1)
    first.end(cell.robot.now)
    assert cell.passes(2.0) < NOT_STRAIGHT

    robot = cell.robot
    robot.at = cell.at
    outs = [robot.stream() for _ in range(200)]
    second.end(robot.now)
    second.reject()
    outs += [robot.stream() for _ in range(200)]
    assert np.abs(np.diff(outs, axis=0)).max() <= RATE * DT * (1.0 + 1e-6)
    assert np.abs(robot.read(robot.at).position - HOME).max() < 1e-9


def test_a_goal_that_is_rejected_when_nothing_ran() -> None:
    cell = Controller()
    cell.send(accepted=False).reject()
    cell.stop()
    assert cell.passes(2.0) < 1e-12
    robot = cell.robot
    before = robot.session.status()
    assert not before.settled  # nothing was blended
    out = robot.session.target(JointCommand(NAMES, HOME), robot.now).position
    assert np.abs(out - HOME).max() < RATE * 0.1


def test_a_rejected_goal_is_nowhere_the_robot_goes() -> None:
    """A model is judged where the robot goes, and a target by what was put out before it."""
    arm, far = good_here_only()
    robot = Robot(velocity_limits=np.full(6, 0.01))
    robot.read(HOME)
    robot.session.enable(True)
    robot.stream()
    robot.stream()
    path = TrajectoryCommand(NAMES, np.stack([HOME, far]), np.array([0.0, 2000.0]))
    robot.session.trajectory(path, robot.now, may_be_rejected=True)
    course = robot.session.course
    assert course is not None
    course.reject()
    robot.session.offer_model(offer(arm))  # too large where the goal was
    # where it may begin, but 3e-4 rad within 20 ms of what was put out before
    refused(Reason.VELOCITY_LIMIT, robot.stream, HOME + 3e-4)


def test_a_goal_begins_as_it_is_forwarded() -> None:
    """It takes 0.4 s from its correction to the controller."""
    cell = Controller()
    course = cell.send()
    cell.robot.now += 0.4
    cell._begun = cell.robot.now
    course.begin(cell.robot.now)
    assert cell.passes(3.0) < NOT_STRAIGHT


def test_one_that_has_a_time_to_begin_is_not_entered_in_mid_blend() -> None:
    """It began 10 ms ago, and reaches the controller 0.1 s later: no step by then."""
    cell, n = Controller(), 4000
    path = TrajectoryCommand(NAMES, np.tile(HOME, (n, 1)), np.linspace(0.0, 8.0, n))
    out = cell.robot.session.trajectory(path, cell.robot.now, -0.01)
    begun = path.time_from_start_s <= 0.11
    assert np.array_equal(out.position[begun], path.position[begun])
    assert np.abs(out.position[-1] - HOME).max() > RATE  # and blends then
    cell._path, cell._begun = out, cell.robot.now - 0.01
    course = cell.robot.session.course
    assert course is not None
    cell.robot.now += 0.1
    course.begin(cell.robot.now)  # its time stays
    assert cell.passes(3.0) < NOT_STRAIGHT


def test_what_is_over_is_not_kept() -> None:
    cell = Controller()
    kept = []
    for accepted in (True, False) * 3:
        course = cell.send()
        if not accepted:
            cell.robot.session.trajectory(still(), cell.robot.now)
        kept.append(weakref.ref(course))
        del course
    gc.collect()
    assert sum(ref() is not None for ref in kept) == 0
