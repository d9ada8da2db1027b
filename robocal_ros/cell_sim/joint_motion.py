"""Joints that follow what a joint trajectory controller sends their drives."""

from copy import copy

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.trajectory import Trajectory
from robocal_ros.cell_sim.trajectory_controller import Cycles, TrajectoryController
from robocal_ros.cell_sim.trajectory_goal import ControllerOptions, TrajectoryGoal

Array = NDArray[np.float64]

CYCLE_S = 4e-3  # of controller and drives
LAG_S = 14e-3  # ur_robot_driver's servoj_lookahead_time is 30 ms: the mean over eight cycles
ROOM = 0.05  # above the greatest speed: a correction adds a little to the programme's
BRAKES_S = 0.4  # from the greatest speed to rest
KEPT = 25_000  # cycles that are known back from now, at least
MOST = 1000  # cycles that are computed together


class JointMotion:
    """A trajectory controller and the drives that follow it, from time 0 on.

    What is asked for a time happens up to then. A message after that counts from the cycle after
    its own time on, and what was computed beyond it is done again.

    Parameters
    ----------
    q : (n,) where the joints stand at time 0, rad (prismatic: m).
    fastest : (n,) or one for all: the drives' greatest speeds, rad/s (prismatic: m/s).
    limits : drives refuse what is faster by more than `ROOM`: a drive fault, the robot brakes.
        Without, they follow: nobody behind a controller looks at its command.
    lag_s : drives smooth their command: a mean that lags so much, in whole half cycles.

    Attributes
    ----------
    controller : takes trajectories, see `TrajectoryController`.
    peak : (n,) greatest speeds that were commanded, rad/s (prismatic: m/s).
    faults : number of drive faults; ``fault``: what the last one was.
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
        # Each row is a cycle: measured, sent and desired joints with their rates.
        self._width = 1 + round(2.0 * lag_s / CYCLE_S)
        self._sent = np.tile(np.stack([here, np.zeros_like(here)]), (self._width, 1, 1))
        self._rows = np.empty((2 * KEPT, 7, len(here)))
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
        return np.asarray(self._mean(self._sent[:0])[0])

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

        Raises
        ------
        InputError
            When the controller rejects it; what runs goes on.
        """
        self.take(now_s, Trajectory.of(self.controller.names, time_s, q, qd, qdd, start_s=0.0))

    def take(self, now_s: float, given: Trajectory | TrajectoryGoal) -> None:
        """Follow a trajectory or a goal, see `TrajectoryController`, from the next cycle on.

        Raises
        ------
        InputError
            When the controller rejects it; what runs goes on.
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
        t = np.asarray(time_s, dtype=np.float64)
        if len(t):
            self._run(int(np.floor(np.max(t) / CYCLE_S * (1.0 + 1e-12))) + 1)
        number = np.floor(t / CYCLE_S * (1.0 + 1e-12)).astype(np.int64)
        number = np.clip(number, self._begin, self._count - 1)
        first = int(np.min(number, initial=self._count - 1))
        known = self._rows[first - self._begin : self._count - self._begin, :2]
        rows, row = np.concatenate([known, self.here[None]]), number - first
        s = np.clip(t / CYCLE_S - number, 0.0, 1.0)[:, None]
        (q0, v0), (q1, v1) = (rows[row + i].transpose(1, 0, 2) for i in (0, 1))
        # Drives interpolate between two cycles as the controller does between two points.
        way, v0, v1 = q1 - q0, v0 * CYCLE_S, v1 * CYCLE_S
        c2, c3 = 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way
        qd = (v0 + s * (2.0 * c2 + s * 3.0 * c3)) / CYCLE_S
        return q0 + s * (v0 + s * (c2 + s * c3)), qd

    def joints(self, time_s: Array) -> Array:
        """The joints (k, n) alone."""
        return self.at(time_s)[0]

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
        self._run(count)
        self._before = self._snapshot()

    # ---- cycles ---------------------------------------------------------------------------------

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
                passed = self.controller.judge(cycles, self._measured(cycles)[:-1, 0])
                self._append(cycles.first(passed))
            if passed == allowed < len(time):
                self._refuse()

    def _measured(self, cycles: Cycles) -> Array:
        """What the drives report (k + 1, 2, n) in each of the cycles, and after them."""
        return self._mean(np.stack([cycles.command, cycles.speed], axis=1))

    def _mean(self, sent: Array) -> Array:
        """Of what was sent and ``sent`` (k, 2, n) the means (k + 1, 2, n), to the last bit."""
        rows, count = np.concatenate([self._sent, sent]), len(sent) + 1
        total = rows[:count].copy()
        for i in range(1, self._width):
            total += rows[i : i + count]
        return np.asarray(total / self._width)

    def _append(self, cycles: Cycles) -> None:
        count = len(cycles.command)
        row = self._count - self._begin
        if row + count > len(self._rows):
            self._rows[:KEPT] = self._rows[row - KEPT : row]
            self._past_s[:KEPT] = self._past_s[row - KEPT : row]
            self._begin, row = self._count - KEPT, KEPT
        rows = slice(row, row + count)
        self._rows[rows, :2] = self._measured(cycles)[:-1]
        for i, part in enumerate(
            (cycles.command, cycles.speed, cycles.desired, cycles.desired_qd, cycles.desired_qdd)
        ):
            self._rows[rows, 2 + i] = part
        self._past_s[rows] = cycles.past_s
        sent = np.stack([cycles.command, cycles.speed], axis=1)
        self._sent = np.concatenate([self._sent, sent])[-self._width :]
        self._count += count

    # ---- drives ---------------------------------------------------------------------------------

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

    def _refuse(self) -> None:
        """All joints slow down evenly and come to rest together."""
        self.faults += 1
        highest = (1.0 + ROOM) * self._fastest
        speed = np.clip(self._sent[-1, 1], -highest, highest)
        self.controller.brake(BRAKES_S * float(np.max(np.abs(speed) / self._fastest)), speed)
