"""A joint trajectory controller without a clock, as ros2_controllers' is.

Follows joint_trajectory_controller 4.42.1 (joint_trajectory_controller.cpp, tolerances.hpp) with
position commands; docs/controllers.md says which rule is taken from where. It sees what a drive
reports and gives what a drive is sent, cycle by cycle; cycles between two messages are computed
together.
"""

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.trajectory import SampledPath, Trajectory
from robocal_ros.cell_sim.trajectory_goal import (
    ControllerOptions,
    GoalCode,
    GoalState,
    Tolerances,
    TrajectoryGoal,
)
from robocal_ros.ground.errors import InputError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

AT_REST = 1.2e-7  # greatest speed of a last point, rad/s (prismatic: m/s): float's epsilon


@dataclass(frozen=True, eq=False)
class Cycles:
    """What the controller makes of some cycles: rows (k, n).

    ``desired``, its velocities and accelerations: where it should be at the cycle's time;
    ``command``, ``speed``: sent in the cycle, for the next one's time, and by how much it moves;
    ``past_s`` (k,): time of the trajectory; ``ended`` (k,): the last point is behind the command.
    """

    desired: Array
    desired_qd: Array
    desired_qdd: Array
    command: Array
    speed: Array
    past_s: Array
    ended: NDArray[np.bool_]

    def first(self, count: int) -> "Cycles":
        """The first ones."""
        return Cycles(*(getattr(self, of.name)[:count] for of in fields(self)))


@dataclass(eq=False)
class TrajectoryController:
    """Of joints ``names`` that stand at ``q`` (n,), with a cycle of ``period_s``.

    Attributes
    ----------
    scale : speed scaling, 0 and more; 0 halts and keeps what runs.
    active : the goal that runs; None without one.
    own_tolerances : those of the options.
    """

    names: tuple[str, ...]
    q: Array
    period_s: float
    options: ControllerOptions = field(default_factory=ControllerOptions)
    scale: float = 1.0
    active: TrajectoryGoal | None = None

    def __post_init__(self) -> None:
        n, of = len(self.names), self.options
        own = Tolerances(np.full(n, of.trajectory), np.full(n, of.goal), of.goal_time)
        self.own_tolerances = self._tolerances = own
        self._last, self._last_speed = self.q.copy(), np.zeros(n)
        self._sorted = self.q.copy()  # what the original wrote last when it sorted joints
        self._succeeded = False
        self._new: Trajectory | None = None
        self._path = SampledPath(self._holding(self.q), -1.0, self.q, None)
        # Its time: so many steps of so much after a begin, however the cycles are cut.
        self._begin_s, self._steps, self._step_s = -1.0, -1, self.period_s
        self._is_holding, self._is_first, self._brakes = True, False, False

    # ---- what comes in --------------------------------------------------------------------------

    def follow(self, trajectory: Trajectory, now_s: float) -> None:
        """Follow a trajectory from the next cycle on, as one that came on the topic.

        A goal that runs goes on running, and ends as this one ends.

        Raises
        ------
        InputError
            When the controller rejects it; what runs goes on.
        """
        self.require_valid(trajectory, now_s)
        self._new, self._is_holding = trajectory, False

    def accept(self, goal: TrajectoryGoal, now_s: float, lost: bool = False) -> None:
        """Follow a goal of the action from the next cycle on; the one that runs is aborted.

        ``lost``: a fault; the goal runs, and what ran before goes on in its place.

        Raises
        ------
        InputError
            When the controller rejects it; what runs goes on.
        """
        if not lost:
            self.follow(goal.trajectory, now_s)
        self._abort(GoalCode.INVALID_GOAL, "Current goal preempted by new incoming action.")
        self.active, self._tolerances = goal, goal.tolerances or self.own_tolerances

    def cancel(self, goal: TrajectoryGoal, here: Array) -> None:
        """End the goal that runs, and hold ``here`` (n,), where the drives are."""
        if goal is self.active:
            goal.end(GoalState.CANCELED)
            self.active = None
            self.hold(here)

    def hold(self, here: Array) -> None:
        """Stand ``here`` from the next cycle on: a hard stop."""
        self._new, self._is_holding = self._holding(here), True

    def deactivate(self, here: Array) -> None:
        """Stand, and abort what runs."""
        self._abort(GoalCode.INVALID_GOAL, "Current goal cancelled during deactivate transition.")
        self.hold(here)

    def require_valid(self, trajectory: Trajectory, now_s: float) -> None:
        """Look at a trajectory as the controller does before it takes one.

        Raises
        ------
        InputError
            With the reason for which it is rejected.
        """
        names, time, of = trajectory.names, trajectory.time_s, self.options
        if len(names) != len(self.names) and not (names and of.allow_partial_joints_goal):
            raise InputError(
                f"rejected: {len(names)} joints, the controller's are {', '.join(self.names)}"
            )
        if not len(time):
            raise InputError("rejected: an empty trajectory; what runs goes on")
        if unknown := [name for name in names if name not in self.names]:
            raise InputError(f"rejected: no joint {', '.join(unknown)} in this controller")
        fast = np.abs(trajectory.qd[-1]) > AT_REST
        if np.any(fast) and not of.allow_nonzero_velocity_at_trajectory_end:
            joint = int(np.argmax(fast))
            raise InputError(
                f"rejected: the last velocity of joint {names[joint]} is "
                f"{trajectory.qd[-1, joint]:.3g}, not zero"
            )
        if trajectory.start_s is not None and trajectory.start_s + time[-1] < now_s:
            late_s = now_s - trajectory.start_s - time[-1]
            raise InputError(f"rejected: the trajectory ended in the past, {late_s:.3g} s ago")
        if np.any(np.diff(time) <= 0.0):
            point = int(np.argmax(np.diff(time) <= 0.0))
            raise InputError(
                f"rejected: times do not increase: {time[point]:g} and {time[point + 1]:g} s"
            )

    # ---- cycles ---------------------------------------------------------------------------------

    def cycles(self, time_s: NDArray[Any], q: Array, qd: Array) -> Cycles:
        """Begin the cycles at times (k,), the drives being at ``q``, ``qd`` (n,) in the first."""
        self._is_first = self._new is not None
        if self._step_s != self.period_s * self.scale:
            self._begin_s, self._steps = self._time_s, 0
            self._step_s = self.period_s * self.scale
        if self._new is None:
            self._steps += 1
        else:
            self._begin_s, self._steps = float(time_s[0]), 0
            begin = (q, qd if self.options.velocity_states else None, self._begin_s)
            if self._brakes:
                begin = (self._last, self._last_speed, self._begin_s)
            elif self.options.interpolate_from_desired_state:
                # What was sent a cycle ago, for now, counts as of then: it goes twice as far.
                begin = (self._last, self._last_speed, self._begin_s - self.period_s)
            self._path = SampledPath(self._ordered(self._new), self._begin_s, *begin)
            self._new, self._brakes = None, False
        steps = self._steps + np.arange(len(time_s), dtype=np.float64)
        at = np.asarray(self._begin_s + steps * self._step_s)
        desired, desired_qd, desired_qdd, _ = self._path.sample(at)
        command, speed, _, past = self._path.sample(at + self.period_s)
        past_s, ended = np.asarray(at - self._path.start_s), past == self._path.count
        return Cycles(desired, desired_qd, desired_qdd, command, speed * self.scale, past_s, ended)

    def judge(self, cycles: Cycles, measured: Array) -> int:
        """Compare them with where (k, n) the drives were in each; how many of them pass so.

        The goal succeeds, or a tolerance is violated: then the last of them sends what the one
        before it sent, and the controller holds.
        """
        count, before = len(measured), self._last
        of = self._tolerances
        if not self._is_holding and (self.active or np.any(of.path) or np.any(of.goal)):
            error = np.abs(cycles.desired - measured)
            on_way = ~cycles.ended
            on_way[0] |= self._is_first
            lost = on_way & np.any((of.path > 0.0) & (error > of.path), axis=1)
            outside = cycles.ended & np.any((of.goal > 0.0) & (error > of.goal), axis=1)
            over_s = cycles.past_s - (self._path.end_s - self._path.start_s)
            late = outside & (of.goal_time_s > 0.0) & (over_s > of.goal_time_s)
            reached = cycles.ended & ~outside
            first = int(np.argmax(lost | late | reached))
            if lost[first] or late[first]:
                count = first + 1
                cycles.command[first] = cycles.command[first - 1] if first else before
                cycles.speed[first] = 0.0
                self._violated(bool(lost[first]), float(over_s[first]), measured[first])
            elif reached[first] and self.active:
                self.active.end(GoalState.SUCCEEDED, text="Goal successfully reached!")
                self.active, self._is_holding = None, True
                self._succeeded, self._sorted = True, np.zeros_like(self._sorted)
        self._last, self._last_speed = cycles.command[count - 1], cycles.speed[count - 1]
        self._steps += count - 1
        return count

    def brake(self, duration_s: float, speed: Array) -> None:
        """The drives refuse: every joint slows down from ``speed`` (n,) and its last command."""
        self._abort(GoalCode.PATH_TOLERANCE_VIOLATED, "the drives refused the command")
        self._last_speed, rest = speed, self._last + 0.5 * duration_s * speed
        self._new = Trajectory.of(self.names, [duration_s], rest[None], np.zeros((1, len(rest))))
        self._brakes = self._is_holding = True

    def end_s(self, next_s: float) -> float:
        """When the last point is due, the next cycle being at ``next_s``; inf while halted."""
        if self._new is not None:
            start_s = next_s if self._new.start_s is None else self._new.start_s
            return start_s + float(self._new.time_s[-1])
        left_s = self._path.end_s - self._time_s - self.period_s
        if left_s <= 0.0:
            return min(self._path.end_s, next_s)
        return next_s + left_s / self.scale if self.scale > 0.0 else np.inf

    @property
    def _time_s(self) -> float:
        """Where in the trajectory the last cycle was, on the clock of its begin."""
        return self._begin_s + self._steps * self._step_s

    # ---- small parts ----------------------------------------------------------------------------

    def _violated(self, on_way: bool, over_s: float, here: Array) -> None:
        if on_way:
            text = "Aborted due to path tolerance violation"
            self._abort(GoalCode.PATH_TOLERANCE_VIOLATED, text)
        else:
            text = f"Aborted due to goal_time_tolerance exceeding by {over_s:f} seconds"
            self._abort(GoalCode.GOAL_TOLERANCE_VIOLATED, text)
        self.hold(here)

    def _abort(self, code: GoalCode, text: str) -> None:
        if self.active:
            self.active.end(GoalState.ABORTED, code, text)
            self.active = None

    def _holding(self, here: Array) -> Trajectory:
        return Trajectory.of(self.names, [0.0], here[None])

    def _ordered(self, given: Trajectory) -> Trajectory:
        """In the controller's order; of a joint that is named twice the last value counts.

        A joint that is not named stays where it was sent last. But where the number of names is
        right, as another is named twice, it gets what the original sorted last for it: one buffer
        serves positions, velocities and accelerations of all messages. What holds after a goal
        that succeeded, and whatever holds later, has efforts, which are 0 and sorted last.
        """
        index = [self.names.index(name) for name in given.names]
        q = np.tile(self._last, (len(given.time_s), 1))
        qd, qdd = np.zeros_like(q), np.zeros_like(q)
        if len(index) == len(self.names):
            q[:] = qd[:] = qdd[:] = self._sorted
        q[:, index], qd[:, index], qdd[:, index] = given.q, given.qd, given.qdd
        self._sorted = (qdd if given.has_qdd[-1] else qd if given.has_qd[-1] else q)[-1]
        if self._is_holding and self._succeeded:
            self._sorted = np.zeros_like(self._sorted)
        return replace(given, names=self.names, q=q, qd=qd, qdd=qdd)
