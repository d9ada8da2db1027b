# SPDX-License-Identifier: Apache-2.0
"""A joint trajectory controller without a clock, as ros2_controllers' is.

Follows joint_trajectory_controller 4.42.1 (joint_trajectory_controller.cpp, tolerances.hpp) with
position commands; docs/cell_sim_node.md says which rule is taken from where. It sees what a drive
reports and gives what a drive is sent, cycle by cycle; cycles between two messages are computed
together. `Trajectory` and `SampledPath` are as in its trajectory.cpp; `JointMotion` is the drives.
"""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, fields, replace
from enum import Enum
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, Index

Flags = NDArray[np.bool_]

WITH_SPEED, WITH_BOTH, WITHOUT_SPEED = 1, 3, 2  # what both ends of a stretch have beside positions
AT_REST = 1.2e-7  # greatest speed of a last point, rad/s (prismatic: m/s): float's epsilon
CYCLE_S = 4e-3  # of controller and drives
LAG_S = 14e-3  # ur_robot_driver's servoj_lookahead_time is 30 ms: the mean over eight cycles
ROOM = 0.05  # above the greatest speed: a correction adds a little to the programme's
BRAKES_S = 0.4  # from the greatest speed to rest
KEPT = 25_000  # cycles that are known back from now, at least
MOST = 1000  # cycles that are computed together


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Points for joints ``names``, as a message holds them.

    ``time_s`` (k,): from the start.
    ``q``, ``qd``, ``qdd``: (k, n) rad, rad/s, rad/s² (prismatic: m); zeros where a point has none.
    ``has_qd``, ``has_qdd``: (k,) which points have them.
    ``start_s``: when it starts; None: when the controller first samples it.
    """

    names: tuple[str, ...]
    time_s: Array
    q: Array
    qd: Array
    qdd: Array
    has_qd: Flags
    has_qdd: Flags
    start_s: float | None = None

    @classmethod
    def of(
        cls,
        names: Sequence[str],
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
        start_s: float | None = None,
    ) -> "Trajectory":
        """Make one whose points all have the same."""
        time, rows = np.asarray(time_s, dtype=np.float64), np.asarray(q, dtype=np.float64)
        given = [np.full(len(time), part is not None) for part in (qd, qdd)]
        qd, qdd = (
            np.zeros_like(rows) if part is None else np.asarray(part, dtype=np.float64)
            for part in (qd, qdd)
        )
        return cls(tuple(names), time, rows, qd, qdd, given[0], given[1], start_s)


class SampledPath:
    """A trajectory with where the joints were when it was first sampled.

    Between points lie lines, cubics or quintics, as both have positions alone, velocities too, or
    accelerations too. The first stretch begins at ``q``, ``qd`` (n,), at ``before_s`` where that
    is not ``now_s``, when it is first sampled; a controller
    whose drives give no velocities (``qd`` None) takes them as 0 where the first point has some.
    Accelerations without velocities give 0 for everything, as they do in the original.
    """

    def __init__(
        self,
        trajectory: Trajectory,
        now_s: float,
        q: Array,
        qd: Array | None,
        before_s: float | None = None,
    ) -> None:
        of = trajectory
        start_s = now_s if of.start_s is None else of.start_s
        self.start_s, self.count, self._points_s = start_s, len(of.time_s), start_s + of.time_s
        self.end_s = float(self._points_s[-1])
        self._knots = np.append(now_s if before_s is None else before_s, self._points_s)
        zeros = np.zeros_like(q)
        begin = (q, zeros if qd is None else qd, zeros)
        rows = [
            np.vstack([first, part])
            for first, part in zip(begin, (of.q, of.qd, of.qdd), strict=True)
        ]
        has_qd = np.append(qd is not None or of.has_qd[0], of.has_qd)
        has_qdd = np.append(of.has_qdd[0], of.has_qdd)
        ends = [has_qd[:-1] & has_qd[1:], has_qdd[:-1] & has_qdd[1:]]
        kind = ends[0] * WITH_SPEED + ends[1] * WITHOUT_SPEED
        # A first point that has been passed already has no stretch before it.
        long_s = np.diff(self._knots)
        long_s[0] = max(long_s[0], 1e-9)
        self._polynomials = _coefficients(long_s[:, None], rows, kind)
        self._quintic = bool(np.any(kind == WITH_BOTH))
        self._last = np.stack([part[-1] for part in rows])

    def sample(self, time_s: Array) -> tuple[Array, Array, Array, Index]:
        """Positions, velocities, accelerations (m, n) at times (m,), and how many are past."""
        past = np.searchsorted(self._points_s, time_s, side="right")
        stretch = np.minimum(past, len(self._points_s) - 1)
        t = (time_s - self._knots[stretch])[:, None]
        if stretch[0] == stretch[-1]:  # times increase, but for what is asked a cycle ahead
            stretch = stretch[:1]
        c = self._polynomials[:, stretch]
        if self._quintic:
            q = c[0] + t * (c[1] + t * (c[2] + t * (c[3] + t * (c[4] + t * c[5]))))
            qd = c[1] + t * (2.0 * c[2] + t * (3.0 * c[3] + t * (4.0 * c[4] + t * 5.0 * c[5])))
            qdd = 2.0 * c[2] + t * (6.0 * c[3] + t * (12.0 * c[4] + t * 20.0 * c[5]))
        else:
            q = c[0] + t * (c[1] + t * (c[2] + t * c[3]))
            qd = c[1] + t * (2.0 * c[2] + t * (3.0 * c[3]))
            qdd = 2.0 * c[2] + t * (6.0 * c[3])
        over = past == len(self._points_s)
        if over.any():
            q[over], qd[over], qdd[over] = self._last
        return q, qd, qdd, past


def _coefficients(h: Array, rows: list[Array], kind: Index) -> Array:
    """Polynomials (6, k - 1, n) by powers of the time since each stretch's begin.

    ``h`` (k - 1, 1) their lengths, s; ``rows``: positions, velocities, accelerations (k, n).
    """
    q0, v0, a0 = (part[:-1] for part in rows)
    q1, v1, a1 = (part[1:] for part in rows)
    c = np.zeros((6, *q0.shape))
    way = q1 - q0
    line, cubic, quintic = kind == 0, kind == WITH_SPEED, kind == WITH_BOTH
    c[0, kind != WITHOUT_SPEED] = q0[kind != WITHOUT_SPEED]
    c[1, line] = (way / h)[line]
    c[1, cubic | quintic] = v0[cubic | quintic]
    c[2, cubic] = ((3.0 * way - (2.0 * v0 + v1) * h) / h**2)[cubic]
    c[3, cubic] = ((-2.0 * way + (v0 + v1) * h) / h**3)[cubic]
    c[2, quintic] = 0.5 * a0[quintic]
    bend = (a1 - 3.0 * a0) * h**2
    c[3, quintic] = ((20.0 * way - (12.0 * v0 + 8.0 * v1) * h + bend) / (2.0 * h**3))[quintic]
    bend = (3.0 * a0 - 2.0 * a1) * h**2
    c[4, quintic] = ((-30.0 * way + (16.0 * v0 + 14.0 * v1) * h + bend) / (2.0 * h**4))[quintic]
    bend = (a1 - a0) * h**2
    c[5, quintic] = ((12.0 * way - 6.0 * (v0 + v1) * h + bend) / (2.0 * h**5))[quintic]
    return c


class GoalState(Enum):
    """Of an action's goal."""

    EXECUTING = "executing"
    SUCCEEDED = "succeeded"
    CANCELED = "canceled"
    ABORTED = "aborted"


class GoalCode(Enum):
    """``error_code`` of control_msgs/FollowJointTrajectory."""

    SUCCESSFUL = 0
    INVALID_GOAL = -1
    PATH_TOLERANCE_VIOLATED = -4
    GOAL_TOLERANCE_VIOLATED = -5


@dataclass(frozen=True, eq=False)
class Tolerances:
    """Position errors (n,) on the way and at the end, rad (prismatic: m); 0: no check.

    ``goal_time_s``: how long after its end a goal may be out of tolerance; 0: for ever.
    """

    path: Array
    goal: Array
    goal_time_s: float = 0.0


@dataclass(eq=False)
class TrajectoryGoal:
    """A goal of the action; ``tolerances`` None: the controller's own."""

    trajectory: Trajectory
    tolerances: Tolerances | None = None
    state: GoalState = GoalState.EXECUTING
    code: GoalCode = GoalCode.SUCCESSFUL
    text: str = ""

    def end(self, state: GoalState, code: GoalCode = GoalCode.SUCCESSFUL, text: str = "") -> None:
        """Over."""
        self.state, self.code, self.text = state, code, text


@dataclass(frozen=True)
class ControllerOptions:
    """Parameters of the controller, by its own names, with its defaults.

    ``velocity_states``: the drives report velocities (``state_interfaces``); mock hardware with
    positions alone does not.
    ``goal_time``: with ``trajectory`` and ``goal`` of each joint (prismatic: m): `Tolerances`.
    """

    velocity_states: bool = True
    allow_partial_joints_goal: bool = False
    allow_nonzero_velocity_at_trajectory_end: bool = False
    interpolate_from_desired_state: bool = False
    trajectory: float = 0.0
    goal: float = 0.0
    goal_time: float = 0.0


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
    ended: Flags

    def first(self, count: int) -> "Cycles":
        """The first ones."""
        return Cycles(*(getattr(self, of.name)[:count] for of in fields(self)))


@dataclass(eq=False)
class TrajectoryController:
    """Of joints ``names`` that stand at ``q`` (n,), with a cycle of ``period_s``.

    ``scale``: speed scaling, 0 and more; 0 halts and keeps what runs.
    ``active``: the goal that runs; None without one.
    ``own_tolerances``: those of the options.
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
        here = Trajectory.of(self.names, [0.0], self.q[None])
        self._path = SampledPath(here, -1.0, self.q, None)
        # Its time: so many steps of so much after a begin, however the cycles are cut.
        self._begin_s, self._steps, self._step_s = -1.0, -1, self.period_s
        self._is_holding, self._is_first, self._brakes = True, False, False

    def follow(self, trajectory: Trajectory, now_s: float) -> None:
        """Follow a trajectory from the next cycle on, as one that came on the topic.

        A goal that runs goes on running, and ends as this one ends.

        Raises `InputError` when the controller rejects it; what runs goes on.
        """
        self.require_valid(trajectory, now_s)
        self._new, self._is_holding = trajectory, False

    def accept(self, goal: TrajectoryGoal, now_s: float, lost: bool = False) -> None:
        """Follow a goal of the action from the next cycle on; the one that runs is aborted.

        ``lost``: a fault; the goal runs, and what ran before goes on in its place.

        Raises `InputError` when the controller rejects it; what runs goes on.
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
        self._new, self._is_holding = Trajectory.of(self.names, [0.0], here[None]), True

    def deactivate(self, here: Array) -> None:
        """Stand, and abort what runs."""
        self._abort(GoalCode.INVALID_GOAL, "Current goal cancelled during deactivate transition.")
        self.hold(here)

    def require_valid(self, trajectory: Trajectory, now_s: float) -> None:
        """Look at a trajectory as the controller does before it takes one.

        Raises `InputError`, with the reason for which it is rejected.
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
        k = len(at)
        q, qd, qdd, past = self._path.sample(np.concatenate([at, at + self.period_s]))
        past_s, ended = np.asarray(at - self._path.start_s), past[k:] == self._path.count
        return Cycles(q[:k], qd[:k], qdd[:k], q[k:], qd[k:] * self.scale, past_s, ended)

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
                if lost[first]:
                    text = "Aborted due to path tolerance violation"
                    self._abort(GoalCode.PATH_TOLERANCE_VIOLATED, text)
                else:
                    text = "Aborted due to goal_time_tolerance exceeding by "
                    text += f"{over_s[first]:f} seconds"
                    self._abort(GoalCode.GOAL_TOLERANCE_VIOLATED, text)
                self.hold(measured[first])
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

    def _abort(self, code: GoalCode, text: str) -> None:
        if self.active:
            self.active.end(GoalState.ABORTED, code, text)
            self.active = None

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


class JointMotion:
    """A trajectory controller and the drives that follow it, from time 0 on.

    What is asked for a time happens up to then. A message after that counts from the cycle after
    its own time on, and what was computed beyond it is done again.

    ``q`` (n,): where the joints stand at time 0, rad (prismatic: m).
    ``fastest``: (n,) or one for all: the drives' greatest speeds, rad/s (prismatic: m/s).
    ``limits``: drives refuse what is faster by more than `ROOM`: a drive fault, the robot brakes.
    Without, they follow: nobody behind a controller looks at its command.
    ``lag_s``: drives smooth their command: a mean that lags so much, in whole half cycles.

    ``controller``: takes trajectories, see `TrajectoryController`.
    ``peak`` (n,): greatest speeds that were commanded, rad/s (prismatic: m/s).
    ``faults``: number of drive faults; ``fault``: what the last one was.
    """

    def __init__(
        self,
        q: ArrayLike,
        fastest: ArrayLike = np.inf,
        *,
        names: tuple[str, ...] = (),
        options: ControllerOptions | None = None,
        limits: bool = False,
        lag_s: float = 0.0,
    ) -> None:
        here = np.array(q, dtype=np.float64)
        self._fastest = np.broadcast_to(np.asarray(fastest, dtype=np.float64), here.shape)
        self._limits = limits
        self.peak, self.faults, self.fault = np.zeros_like(here), 0, ""
        names = names or tuple(f"joint_{i + 1}" for i in range(len(here)))
        self.controller = TrajectoryController(names, here, CYCLE_S, options or ControllerOptions())
        # Each row is a cycle: measured, sent and desired joints with their rates. What the drives
        # report next follows the last.
        self._width = 1 + round(2.0 * lag_s / CYCLE_S)
        self._sent = np.tile(np.stack([here, np.zeros_like(here)]), (self._width, 1, 1))
        self._rows = np.empty((2 * KEPT + 1, 7, len(here)))
        self._rows[0, :2] = self._mean(self._sent[:0])[0]
        self._past_s = np.empty(2 * KEPT)
        self._begin = self._count = 0  # number of the first row's cycle, and of the next one
        self._before = self._snapshot()

    @property
    def peak_share(self) -> float:
        """The greatest speed that was commanded, over that of its drive."""
        return float(np.max(self.peak / self._fastest))

    @property
    def end_s(self) -> float:
        """When the joints come to rest; inf while they are halted on their way."""
        lag = (self._width - 1) * CYCLE_S
        return self.controller.end_s(self._count * CYCLE_S) + lag

    @property
    def here(self) -> Array:
        """Joints and velocities (2, n) that the drives report next."""
        return self._rows[self._count - self._begin, :2].copy()

    def follow(
        self,
        now_s: float,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> None:
        """Follow points at times (k,) of the motion's own clock, from the cycle after ``now_s`` on.

        ``q``, ``qd``, ``qdd`` (k, n).

        Raises `InputError` when the controller rejects it; what runs goes on.
        """
        self.take(now_s, Trajectory.of(self.controller.names, time_s, q, qd, qdd, start_s=0.0))

    def take(self, now_s: float, given: Trajectory | TrajectoryGoal) -> None:
        """Follow a trajectory or a goal, see `TrajectoryController`, from the next cycle on.

        Raises `InputError` when the controller rejects it; what runs goes on.
        """
        self.pass_to(now_s)
        if isinstance(given, Trajectory):
            self.controller.follow(given, now_s)
        else:
            self.controller.accept(given, now_s)
        self._before = self._snapshot()

    def hold(self, now_s: float) -> None:
        """Stand where the drives are, at once, and abort what runs: the controller is inactive."""
        self.pass_to(now_s)
        self.controller.deactivate(self.here[0])
        self._before = self._snapshot()

    def cancel(self, now_s: float, goal: TrajectoryGoal) -> None:
        """Cancel a goal: where it is the one that runs, stand where the drives are."""
        self.pass_to(now_s)
        self.controller.cancel(goal, self.here[0])
        self._before = self._snapshot()

    def at(self, time_s: ArrayLike) -> tuple[Array, Array]:
        """Joints (k, n) and their velocities at times (k,), of which `KEPT` cycles are known."""
        s, q0, v0, c2, c3 = self._cubics(time_s)
        qd = (v0 + s * (2.0 * c2 + s * 3.0 * c3)) / CYCLE_S
        return q0 + s * (v0 + s * (c2 + s * c3)), qd

    def joints(self, time_s: Array) -> Array:
        """The joints (k, n) alone."""
        s, q0, v0, c2, c3 = self._cubics(time_s)
        return np.asarray(q0 + s * (v0 + s * (c2 + s * c3)))

    def _cubics(self, time_s: ArrayLike) -> tuple[Array, Array, Array, Array, Array]:
        """Share (k, 1) of the cycle at times (k,), and the factors (k, n) of its cubic."""
        t = np.asarray(time_s, dtype=np.float64) / CYCLE_S
        number = np.floor(t * (1.0 + 1e-12)).astype(np.int64)
        self._run(int(np.max(number, initial=-1)) + 1)
        number = np.minimum(np.maximum(number, self._begin), self._count - 1)
        s = np.minimum(np.maximum(t - number, 0.0), 1.0)[:, None]
        row = number - self._begin
        before, after = self._rows[row, :2], self._rows[row + 1, :2]
        # Drives interpolate between two cycles as the controller does between two points.
        q0, way = before[:, 0], after[:, 0] - before[:, 0]
        v0, v1 = before[:, 1] * CYCLE_S, after[:, 1] * CYCLE_S
        return s, q0, v0, 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way

    def last(self) -> tuple[float, Array]:
        """Of the last cycle: its time in the trajectory, and rows (7, n).

        Measured joints and velocities, sent ones, desired ones with accelerations.
        """
        row = self._count - 1 - self._begin
        return float(self._past_s[row]), self._rows[row]

    def pass_to(self, now_s: float) -> None:
        """Let the cycles up to a time pass for good, and undo what was computed beyond it."""
        count = int(np.floor(now_s / CYCLE_S * (1.0 + 1e-12))) + 1
        if count < self._before[0]:
            return
        if self._count > count:
            self._count, self.controller, self._sent = self._before
            self._rows[self._count - self._begin, :2] = self._mean(self._sent[:0])[0]
        self._run(count)
        self._before = self._snapshot()

    def _snapshot(self) -> tuple[int, TrajectoryController, Array]:
        return self._count, copy(self.controller), self._sent

    def _run(self, count: int) -> None:
        while self._count < count:
            time = (self._count + np.arange(min(count - self._count, MOST))) * CYCLE_S
            cycles = self.controller.cycles(time, *self.here)
            allowed = self._allowed(cycles)
            passed = 0
            if allowed:
                cycles = cycles.first(allowed)
                sent = np.stack([cycles.command, cycles.speed], axis=1)
                passed = self.controller.judge(cycles, self._mean(sent)[:-1, 0])
                self._append(cycles.first(passed))
            if passed == allowed < len(time):  # refused: all joints come to rest together
                self.faults += 1
                highest = (1.0 + ROOM) * self._fastest
                speed = np.clip(self._sent[-1, 1], -highest, highest)
                brakes_s = BRAKES_S * float(np.max(np.abs(speed) / self._fastest))
                self.controller.brake(brakes_s, speed)

    def _mean(self, sent: Array) -> Array:
        """What the drives report (k + 1, 2, n) as ``sent`` (k, 2, n) follows what was sent.

        They are means, to the last bit.
        """
        rows, count = np.concatenate([self._sent, sent]), len(sent) + 1
        total = rows[:count].copy()
        for i in range(1, self._width):
            total += rows[i : i + count]
        return np.asarray(total / self._width)

    def _append(self, cycles: Cycles) -> None:
        count = len(cycles.command)
        row = self._count - self._begin
        if row + count >= len(self._rows):
            self._rows[:KEPT] = self._rows[row - KEPT : row]
            self._past_s[:KEPT] = self._past_s[row - KEPT : row]
            self._begin, row = self._count - KEPT, KEPT
        rows = slice(row, row + count)
        sent = np.stack([cycles.command, cycles.speed], axis=1)
        self._rows[row : row + count + 1, :2] = self._mean(sent)
        for i, part in enumerate(
            (cycles.command, cycles.speed, cycles.desired, cycles.desired_qd, cycles.desired_qdd)
        ):
            self._rows[rows, 2 + i] = part
        self._past_s[rows] = cycles.past_s
        self._sent = np.concatenate([self._sent, sent])[-self._width :]
        self._count += count

    def _allowed(self, cycles: Cycles) -> int:
        """How many of the cycles the drives take; they never take what is no number."""
        way = np.diff(np.vstack([self._sent[-1:, 0], cycles.command]), axis=0)
        speed = np.abs(way) / CYCLE_S
        self.peak = np.fmax(self.peak, np.fmax.reduce(speed, axis=0))
        bad = ~np.isfinite(speed)
        if self._limits:
            bad |= speed > (1.0 + ROOM) * self._fastest * (1.0 + 1e-9)
        bad_row = np.any(bad, axis=1)
        if not np.any(bad_row):
            return len(bad)
        first = int(np.argmax(bad_row))
        joint = int(np.argmax(bad[first]))
        self.fault = (
            f"drive fault: joint {joint + 1} is sent at {speed[first, joint]:.3g} rad/s (sliding: "
            f"m/s), its drive reaches {self._fastest[joint]:.3g}; the robot brakes: send a "
            "trajectory that is slower and begins where the robot is"
        )
        return first
