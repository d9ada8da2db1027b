"""Joints that follow what a joint trajectory controller sends their drives."""

from collections.abc import Callable
from copy import copy
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.programs import COUNT_RAD
from robocal_ros.cell_sim.robot import Draws, Stream
from robocal_ros.cell_sim.trajectory_controller import (
    ControllerOptions,
    Cycles,
    Trajectory,
    TrajectoryController,
    TrajectoryGoal,
)
from robocal_ros.ground.errors import InputError

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


# ---- what comes between commands and controller -------------------------------------------------


class CommandGate:
    """Passes trajectories and goals on to a motion, as the faults let them.

    ``begun`` is called when one has been taken.

    Attributes
    ----------
    scale : speed scaling that was asked for; 1 without.
    """

    def __init__(
        self, motion: JointMotion, faults: Faults, draws: Draws, begun: Callable[[], None]
    ) -> None:
        self._motion, self._faults, self._draws, self._begun = motion, faults, draws, begun
        self.scale = 1.0
        self._late: list[tuple[float, Trajectory | TrajectoryGoal]] = []
        self._messages = 0
        self.fault_began(0.0)

    def fault_began(self, now_s: float) -> None:
        """Another fault is in force from now on, or none."""
        self._lost, self._since_s = 0, now_s

    def require_taken(self, trajectory: Trajectory, now_s: float) -> None:
        """Raise where a trajectory is rejected.

        Raises
        ------
        InputError
            With the controller's reason, or with that of a fault.
        """
        if "commands_rejected" in self._faults:
            raise InputError("rejected: simulated fault commands_rejected")
        self._motion.controller.require_valid(trajectory, now_s)

    def take(self, given: Trajectory | TrajectoryGoal, now_s: float) -> None:
        """Pass one on, lose it, or let it wait.

        Raises
        ------
        InputError
            When it is rejected; what runs goes on.
        """
        goal = None if isinstance(given, Trajectory) else given
        self.require_taken(given if isinstance(given, Trajectory) else given.trajectory, now_s)
        if self._loses(goal is None, now_s):
            if goal is not None:
                self._motion.controller.accept(goal, now_s, lost=True)
        elif "commands_late" in self._faults:
            self._late.append((now_s + self._faults.size("commands_late"), given))
        else:
            self._motion.take(now_s, given)
            self._begun()

    def pass_time(self, now_s: float, to_s: float) -> float:
        """Pass on what has waited until now, set the speed; up to when nothing changes."""
        for due_s, given in [waiting for waiting in self._late if waiting[0] <= now_s]:
            self._late.remove((due_s, given))
            try:
                self._motion.take(now_s, given)
                self._begun()
            except InputError:
                pass  # ended in the past by now: dropped, as a controller drops it
        scale, stop_s = self.scale, self._faults.size("protective_stop")
        if "speed_scaling" in self._faults:
            scale *= self._faults.size("speed_scaling")
        if now_s < self._since_s + stop_s:
            scale, to_s = 0.0, min(to_s, self._since_s + stop_s)
        self._motion.controller.scale = scale
        return min([to_s, *(due_s for due_s, _ in self._late)])

    def _loses(self, of_topic: bool, now_s: float) -> bool:
        """Whether one is lost: on the topic by chance, else where it replaces a motion."""
        faults = self._faults
        if "commands_lossy" in faults and of_topic:
            self._messages += 1
            rng = self._draws.of(Stream.LOST_COMMANDS, self._messages)
            return bool(rng.random() < faults.size("commands_lossy"))
        if self._lost < faults.size("commands_lost") and now_s < self._motion.end_s:
            self._lost += 1
            return True
        return False


# ---- joint readings at their own rate, and what faults make of them -----------------------------


PAGE = 128  # readings whose random numbers belong together
KEPT_PAGES = 4


class JointReadings:
    """Reads encoders at ``k / rate_hz``; ``noise_rad``: of a reading, 0 makes it exact."""

    def __init__(
        self, rate_hz: float, noise_rad: float, faults: Faults, draws: Draws, n: int
    ) -> None:
        self._rate, self._noise, self._n = rate_hz, noise_rad, n
        self._faults, self._draws = faults, draws
        self._next, self._stamp_s = 0, 0.0
        self._stuck: float | None = None
        self._page = lru_cache(KEPT_PAGES)(self._page_of)

    def due(self, now_s: float) -> NDArray[np.int64]:
        """Numbers of the readings since the last call."""
        first = self._next
        self._next = int(np.floor(now_s * self._rate * (1.0 + 1e-12))) + 1
        return np.arange(first, self._next)

    def read(self, number: NDArray[np.int64], motion: JointMotion) -> tuple[Array, Array, Array]:
        """Stamps (k,), joints and velocities (k, n) of what is told of these readings."""
        time = number / self._rate
        q, qd = motion.at(time)
        if self._noise > 0.0:
            noise = self._paged(Stream.READINGS, number, self._n)
            q = np.round((q + self._noise * noise) / COUNT_RAD) * COUNT_RAD
        self._freeze(q, qd)
        told = self._told(number)
        return self._stamps(time)[told], q[told], qd[told]

    def _told(self, number: NDArray[np.int64]) -> NDArray[np.bool_]:
        """Which readings get through."""
        faults = self._faults
        if "lost_messages" in faults:
            chance = self._paged(Stream.LOST_READINGS, number, 1, uniform=True)[:, 0]
            return np.asarray(chance >= faults.size("lost_messages"))
        return np.full(len(number), "joints_silent" not in faults)

    def _stamps(self, time_s: Array) -> Array:
        if "frozen_clock" in self._faults:
            return np.full(len(time_s), self._stamp_s)
        if len(time_s):
            self._stamp_s = float(time_s[-1])
        return time_s + self._faults.size("clock_jump")

    def _freeze(self, q: Array, qd: Array) -> None:
        """One encoder shows what it showed when the fault began."""
        joint = min(int(self._faults.size("frozen_encoder")), self._n) - 1
        if joint < 0:
            self._stuck = None
        elif len(q):
            if self._stuck is None:
                self._stuck = float(q[0, joint])
            q[:, joint], qd[:, joint] = self._stuck, 0.0

    def _paged(
        self, stream: Stream, number: NDArray[np.int64], width: int, uniform: bool = False
    ) -> Array:
        """Random numbers (k, width) that belong to these readings."""
        rows = np.empty((len(number), width))
        pages = number // PAGE
        for page in np.unique(pages).tolist():
            drawn = self._page(stream, page, width, uniform)
            rows[pages == page] = drawn[number[pages == page] % PAGE]
        return rows

    def _page_of(self, stream: Stream, page: int, width: int, uniform: bool) -> Array:
        rng, shape = self._draws.of(stream, page), (PAGE, width)
        return rng.random(shape) if uniform else rng.standard_normal(shape)
