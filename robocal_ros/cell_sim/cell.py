"""The simulated cell, driven by time; all of it follows from one seed.

The joints go where they are told; their readings show just that. The flange is where the true
robot's geometry puts it, as warm as its motion has made it, off by a scatter that is drawn anew
each time it moves after a rest. Every random number belongs to its place in time, so that it does
not matter when the cell is asked, and what is switched on or off leaves all else alone.
"""

from dataclasses import replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.beams import BeamWatch, RoundTool, on_one_clock
from robocal_ros.cell_sim.cell_faults import (
    LASTING,
    NEXT_MOTION,
    AnyFault,
    Faults,
    FaultyInput,
    size_of,
)
from robocal_ros.cell_sim.cell_plan import CellPlan
from robocal_ros.cell_sim.cell_samples import Happened, Outbox
from robocal_ros.cell_sim.joint_motion import ROOM, CommandGate, JointMotion, JointReadings
from robocal_ros.cell_sim.programs import program
from robocal_ros.cell_sim.robot import Draws, Heating, Scatter, Stream, Warmth
from robocal_ros.cell_sim.stations import (
    TICK_S,
    ProfileStation,
    SphereStation,
    Standing,
    standstills,
)
from robocal_ros.cell_sim.tool_cell import Circle, Plunge
from robocal_ros.cell_sim.trajectory_controller import Trajectory
from robocal_ros.ground.errors import LimitError
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]
Index = NDArray[np.int64]

BEAT = 125  # ticks in which warmth is taken as constant: a second
STILL = 1e-9  # a joint that goes less in a tick stands, rad (prismatic: m)


class SimulatedCell:
    """The cell over time, which begins at 0.

    Attributes
    ----------
    motion : of the joints; ``gate``: what passes commands on to it, and its speed scaling.
    next_tool : mounted when the next motion begins: how a tool gets bent.
    faults : what is wrong now.
    heating : None where the robot stays cold.
    """

    def __init__(self, plan: CellPlan) -> None:
        self.plan = plan
        self._mounted = self.next_tool = plan.tool
        self.motion = JointMotion(
            plan.q_start,
            plan.fastest,
            names=plan.arm.joint_names,
            options=plan.controller,
            limits=plan.limits,
            lag_s=plan.lag_s,
        )
        self.faults = Faults(seed=plan.seed)
        self._waiting: tuple[AnyFault, float] | None = None
        self._draws = Draws(plan.seed)
        self.gate = CommandGate(self.motion, self.faults, self._draws, self._begin)
        self.heating = Heating(plan.heat, self._draws) if plan.heat else None
        self._readings = JointReadings(
            plan.rate_hz, plan.reading_noise_rad, self.faults, self._draws, plan.arm.n
        )
        self._input = FaultyInput(self.faults)
        self._watch = BeamWatch(plan.arm, self._draws)
        self._station = on_one_clock(plan.station, self._draws.of(Stream.STATION).random())
        self._standing = Standing()
        self._scatter = Scatter(3 + plan.arm.n)
        self._hand, self._drawn = np.zeros(3), np.zeros(3 + plan.arm.n)
        self._ticks = self._motions = 0
        self._way = np.zeros((BEAT, plan.arm.n))
        self._out = Outbox()
        # What it loads at its first use shall not stop a motion.
        self._see_edges(np.arange(2), np.array([0.0, TICK_S]), np.tile(plan.q_start, (2, 1)))

    @property
    def now_s(self) -> float:
        """Everything up to here has happened."""
        return self._ticks * TICK_S

    @property
    def moving(self) -> bool:
        """Whether a motion is not over yet."""
        return self.now_s < self.motion.end_s

    @property
    def tool(self) -> RoundTool:
        """The tool as it is."""
        return self.faults.tool(self._mounted)

    @property
    def warmth(self) -> Warmth:
        """The robot's."""
        return self.heating.warmth if self.heating else Warmth.cold(self.plan.arm.n)

    # ---- what is told to it ---------------------------------------------------------------------

    def set_fault(self, fault: AnyFault, size: float = 0.0) -> None:
        """Let something go wrong, in place of what went wrong before; "none" ends all at once.

        What `NEXT_MOTION` names begins with the next motion, all else now; what `LASTING` names
        stays until "none". ``size`` in the unit that `SIZES` gives; 0: the usual one.
        """
        self.gate.fault_began(self.now_s)
        if fault == "none":
            self._waiting = None
            self.faults.sizes.clear()
        elif fault in NEXT_MOTION:
            self._waiting = fault, size_of(fault, size)
        else:
            self._waiting = None
            self._replace_fault(fault, size_of(fault, size))

    def follow(
        self,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> None:
        """Follow a trajectory at once, see `JointMotion.follow`; times of the cell.

        Raises
        ------
        InputError
            When the controller rejects it; what runs goes on.
        """
        names = self.plan.arm.joint_names
        self.gate.take(Trajectory.of(names, time_s, q, qd, qdd, start_s=0.0), self.now_s)

    def hold(self) -> None:
        """Stand still at once: the controller is inactive."""
        self.motion.hold(self.now_s)

    def drive(self, step: PlannedStep) -> Circle | Plunge:
        """Let the robot's own program drive a step; its motion, on the cell's clock.

        Raises
        ------
        LimitError
            When it is out of reach, or too fast for the drives.
        """
        q_now = self.motion.at([self.now_s])[0][0]
        phase = 2.0 * np.pi * self._draws.of(Stream.RIPPLE, self._motions).random()
        time, q, qd, move = program(self.plan.arm, step, q_now, self.plan.ripple, phase)
        share = float(np.max(np.abs(qd) / self.plan.fastest))
        if self.plan.limits and share > 1.0 + ROOM:
            raise LimitError(
                f"the robot cannot drive step {step.name}: a joint would go at {share:.3g} times "
                "its drive's greatest speed"
            )
        self.follow(self.now_s + time, q, qd)
        return replace(move, start_s=self.now_s + move.start_s)

    # ---- time -----------------------------------------------------------------------------------

    def advance(self, to_s: float, readings: bool = True) -> Happened:
        """Let time pass, in whole ticks, up to ``to_s``.

        Without ``readings`` no joints are read: a long stretch of work takes less time.
        """
        last = int(np.floor(to_s / TICK_S * (1.0 + 1e-12)))
        read = [self._read(readings)]
        while self._ticks < last:
            self._pass(min(last, (self._ticks // BEAT + 1) * BEAT))
            read.append(self._read(readings))
        joints = [np.concatenate(parts) for parts in zip(*read, strict=True)]
        return self._out.told(self.now_s, *joints)

    def _read(self, readings: bool) -> tuple[Array, Array, Array]:
        number = self._readings.due(self.now_s)
        return self._readings.read(number if readings else number[:0], self.motion)

    def flange(self, time_s: Array) -> Array:
        """True T_base_flange (m, 4, 4) at times (m,), the robot as warm as it is now."""
        off = self._scatter.at(time_s)
        T = self.plan.robot.flange(self.motion.joints(time_s) + off[:, 3:], self.warmth)
        T[:, :3, 3] += off[:, :3]
        return T

    def tcp_error(self, q: ArrayLike, which: Index | slice = slice(None)) -> Array:
        """True error (k, 3) of the tool's tip at the working poses, or at some of them, base, m.

        For joints (k, n) commanded there: where they put the tip, mean over visits, with robot
        and tool as they are now, from where the cold robot put the taught tool at the taught pose.
        """
        plan, now = self.plan, self.tool.T_flange_tool[:3, 3]
        tip = plan.robot.point(q, self.warmth, now) + self._hand
        return np.asarray(tip - self._taught[which])

    @cached_property
    def _taught(self) -> Array:
        """Where (k, 3) the cold robot put the taught tool."""
        plan = self.plan
        p = plan.arm.T_flange_tool[:3, 3]
        return plan.robot.point(plan.working, Warmth.cold(plan.arm.n), p)

    def _pass(self, stop: int) -> None:
        """From tick to tick, at most to the next beat."""
        until_s = self.gate.pass_time(self.now_s, stop * TICK_S)
        stop = min(stop, max(self._ticks + 1, int(np.ceil(until_s / TICK_S * (1.0 - 1e-12)))))
        ticks = np.arange(self._ticks, stop + 1)
        time, now = np.asarray(ticks * TICK_S), self._ticks
        q = self.motion.joints(time)
        way = np.abs(np.diff(q, axis=0))
        departed, stood = self._standing.look(now, np.max(way, axis=1) > STILL)
        for tick in departed.tolist():
            self._depart(tick)
        if not np.all(stood) or self._scatter.settled_s > time[0]:
            self._see_edges(ticks, time, q)
        if self.plan.sphere:
            self._see_sphere(self.plan.sphere, ticks[1:], q[1:], stood)
        if self.plan.profile:
            self._see_profile(self.plan.profile, ticks[1:], q[1:], stood)
        begin = now % BEAT
        self._way[begin : begin + len(way)] = way
        self._ticks = stop
        if stop % BEAT == 0 and self.heating:
            self.heating.step(np.sum(self._way, axis=0), BEAT * TICK_S)
            swapped = "swapped_temperatures" in self.faults
            self._out.temperatures.append(self.heating.tell(self.now_s, stop // BEAT, swapped))

    def _see_edges(self, ticks: Index, time_s: Array, q: Array) -> None:
        station = self.faults.station(self._station)
        found = self._watch.edges(
            station, self.tool, ticks, time_s, q, self.motion.joints, self.flange
        )
        lost = self.faults.size("lost_messages")
        for edge in self._input.passed(found):
            place = round(edge.time_s * 1e9)
            if not lost or self._draws.of(Stream.LOST_EDGES, place).random() >= lost:
                self._out.add_edge(edge)

    def _see_sphere(self, sphere: SphereStation, ticks: Index, q: Array, stood: Index) -> None:
        """Measure the ball where the robot has ``stood`` still for so many ticks."""
        for tick in standstills(sphere, self.plan.arm, ticks, q, stood):
            T = self.flange(np.array([tick * TICK_S]))[0]
            if sphere.sees(T):
                rise = float(self.warmth.link[-1])
                shot = sphere.shoot(T, rise, tick, tick * TICK_S, self.faults, self._draws)
                if shot is not None:
                    self._out.shots.append(shot)

    def _see_profile(self, profile: ProfileStation, ticks: Index, q: Array, stood: Index) -> None:
        """Look at the target with the robot's own sensor."""
        for tick in standstills(profile, self.plan.arm, ticks, q, stood):
            T = self.flange(np.array([tick * TICK_S]))[0]
            shot = profile.shoot(T, tick, tick * TICK_S, self._draws)
            if shot is not None:
                self._out.profiles.append(shot)

    # ---- what changes ---------------------------------------------------------------------------

    def _begin(self) -> None:
        """A motion is told: the tool, the fault and the hand that wait for it."""
        self._mounted = self.next_tool
        if self._waiting:
            self._replace_fault(*self._waiting)
        self._waiting = None
        self._input.begin()
        self._motions += 1
        if not np.array_equal(self._hand, self.faults.hand):
            self._hand = self.faults.hand
            self._scatter.begin(self.now_s, self._offset)

    def _depart(self, tick: int) -> None:
        """The robot moves after a rest: another scatter."""
        rng, noise = self._draws.of(Stream.SCATTER, tick), self.plan.station.noise.step_m
        robot = self.plan.robot
        in_joints = robot.repeatability if robot.effects.noise else 0.0
        drawn = rng.standard_normal(3 + self.plan.arm.n)
        self._drawn = np.append(noise * drawn[:3], in_joints * drawn[3:])
        self._scatter.begin(tick * TICK_S, self._offset)

    @property
    def _offset(self) -> Array:
        return np.append(self._drawn[:3] + self._hand, self._drawn[3:])

    def _replace_fault(self, fault: AnyFault, size: float) -> None:
        sizes = self.faults.sizes
        for other in [name for name in sizes if name not in LASTING]:
            del sizes[other]
        sizes[fault] = size
