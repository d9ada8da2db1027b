"""The simulated cell with a beam station, driven by time; all of it follows from one seed.

The joints go where they are told; their readings show just that. The flange is where the true
robot's geometry puts it, off by a scatter that is drawn anew for each motion.
"""

from bisect import insort
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core import frames
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.tool.beam_edges import BeamEdge
from robocal_ros.core.tool.measuring_plan import PlannedStep
from robocal_ros.sim.beam_calibration import laser_points
from robocal_ros.sim.beam_moves import Circle, Plunge
from robocal_ros.sim.beam_program import program
from robocal_ros.sim.beams import BeamStation, RoundTool, TrueNoise
from robocal_ros.sim.cell_faults import Fault, FaultyInput
from robocal_ros.sim.joint_motion import JointMotion
from robocal_ros.sim.robot import Body, Effects, TrueRobot
from robocal_ros.sim.thermal import Warmth

Array = NDArray[np.float64]

TICK_S = 8e-3  # the cell works in whole ticks, so that it does not matter when it is asked
SETTLE_S = 0.05  # a new scatter is reached smoothly: the flange never jumps
HAND = np.array([7e-4, -7e-4, 0.0])  # how far a hand moves the flange, base, m
SETTLED = -np.inf


@dataclass(frozen=True, eq=False)
class CellPlan:
    """What the cell is made of.

    Attributes
    ----------
    robot : the true one; its ``nominal`` is what the program and the readings' users know.
    station : the true one; its ``noise`` is the robot's scatter there.
    tool : as it is mounted at the begin.
    q_start : (n,) where the robot stands then, with a straight tool above the station.
    rate_hz : of the joint readings.
    ripple : relative, of the speed of circles that the robot's program drives.
    """

    robot: TrueRobot
    station: BeamStation
    tool: RoundTool
    q_start: Array
    rate_hz: float = 125.0
    ripple: float = 0.02
    seed: int = 1

    @property
    def arm(self) -> SerialArm:
        """The nominal robot."""
        return self.robot.nominal


@dataclass(frozen=True, eq=False)
class Happened:
    """What came of a stretch of time.

    Attributes
    ----------
    time_s, q, qd : (k,), (k, n), (k, n) joint readings.
    edges : those whose stamp has passed, in its order; the stamp bears what the input did to it.
    """

    time_s: Array
    q: Array
    qd: Array
    edges: list[BeamEdge] = field(default_factory=list)


class SimulatedCell:
    """The cell over time, which begins at 0.

    Attributes
    ----------
    motion : of the joints.
    next_tool : mounted when the next motion begins: how a tool gets bent.
    """

    def __init__(self, plan: CellPlan) -> None:
        self.plan = plan
        self._tool = self.next_tool = plan.tool
        self.motion = JointMotion(plan.q_start)
        self._rng = np.random.default_rng(plan.seed)
        self._fault: Fault = "none"
        self._next_fault: Fault = "none"
        self._input = FaultyInput()
        self._ticks = self._readings = 0
        self._pending: list[BeamEdge] = []
        self._cold = Warmth.cold(plan.arm.n)
        source = plan.station.input
        self._station = replace(
            plan.station,
            input=replace(source, first_sample_s=source.sample_period_s * self._rng.random()),
            noise=TrueNoise(0.0, plan.station.noise.edge_m),
        )
        self._shifts, self._shift_s = np.zeros((2, 3)), SETTLED

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
        return self._tool

    @property
    def fault(self) -> Fault:
        """The fault in force; one that is set takes effect with the next motion, "none" at once."""
        return self._fault

    @fault.setter
    def fault(self, fault: Fault) -> None:
        self._next_fault = fault
        if fault == "none":
            self._fault = fault
            self._input.begin(fault)

    def follow(
        self,
        time_s: ArrayLike,
        q: ArrayLike,
        qd: ArrayLike | None = None,
        qdd: ArrayLike | None = None,
    ) -> None:
        """Follow a trajectory at once, see `JointMotion.follow`; times as of `now_s`.

        Raises
        ------
        InputError
            When it cannot be followed.
        """
        self.motion.follow(self.now_s, time_s, q, qd, qdd)
        self._begin()

    def hold(self) -> None:
        """Stand still at once."""
        self.motion.hold(self.now_s)

    def drive(self, step: PlannedStep) -> Circle | Plunge:
        """Let the robot's own program drive a step; its motion, on the cell's clock.

        Raises
        ------
        LimitError
            When it is out of reach.
        """
        q_now = self.motion.at([self.now_s])[0][0]
        phase = 2.0 * np.pi * self._rng.random()
        time, q, qd, move = program(self.plan.arm, step, q_now, self.plan.ripple, phase)
        self.follow(self.now_s + time, q, qd)
        return replace(move, start_s=self.now_s + move.start_s)

    def advance(self, to_s: float) -> Happened:
        """Let time pass, in whole ticks, up to ``to_s``."""
        while self.now_s + TICK_S <= to_s:
            begin, end = self.now_s, (self._ticks + 1) * TICK_S
            if begin < max(self.motion.end_s, self._shift_s + SETTLE_S):
                found = self._station.edges(self._tool, self.flange, (begin, end), self._rng)
                for edge in self._input.passed(found):
                    insort(self._pending, edge, key=lambda e: e.time_s)
            self._ticks += 1
        due = [edge for edge in self._pending if edge.time_s <= self.now_s]
        del self._pending[: len(due)]
        first, rate = self._readings, self.plan.rate_hz
        self._readings = int(np.floor(self.now_s * rate * (1.0 + 1e-12))) + 1
        time = np.arange(first, self._readings) / rate
        return Happened(time, *self.motion.at(time), due)

    def flange(self, time_s: Array) -> Array:
        """True T_base_flange (m, 4, 4) at times (m,)."""
        T = self.plan.robot.flange(self.motion.at(time_s)[0], self._cold)
        T[:, :3, 3] += self._shift(time_s)
        return T

    def _shift(self, time_s: Array) -> Array:
        share = np.clip((time_s - self._shift_s) / SETTLE_S, 0.0, 1.0)[:, None]
        smooth = share**2 * (3.0 - 2.0 * share)
        before, after = self._shifts
        return np.asarray(before + smooth * (after - before))

    def _begin(self) -> None:
        """A motion begins: another scatter, the tool and the fault that wait for it."""
        self._tool, self._fault = self.next_tool, self._next_fault
        self._input.begin(self._fault)
        hand = HAND if self._fault == "moved_by_hand" else np.zeros(3)
        scatter = self.plan.station.noise.step_m * self._rng.standard_normal(3)
        before = self._shift(np.array([self.now_s]))[0]
        self._shifts, self._shift_s = np.array([before, hand + scatter]), self.now_s


def rigid_robot(nominal: SerialArm, error_m: float, rng: np.random.Generator) -> TrueRobot:
    """A true robot that neither bends nor warms up, with errors in all its parameters.

    ``error_m``: standard deviation of its lengths, m; its angles err by as much at 1 m.
    """
    n = nominal.n
    still = np.zeros((n, 5, n))
    return TrueRobot(
        nominal=nominal,
        static_error=error_m * rng.standard_normal((n, 5)),
        motor_gain=still,
        link_gain=still,
        body=Body(np.zeros(n), np.zeros((n, 3)), np.ones(n), 0.0),
        eccentricity=np.zeros(n),
        phase=np.zeros(n),
        repeatability=0.0,
        effects=replace(Effects.none(), static=True),
    )


def known_laser(plan: CellPlan, T_base_laser: Array, rng: np.random.Generator) -> dict[str, Array]:
    """Flange positions (3,) A1 ... D4 with which this robot places the station's beams, base, m.

    They bear its scatter, the input's errors, and its geometric error as it is at ``q_start``.
    """
    arm, q = plan.arm, plan.q_start
    true = plan.robot.flange(q, Warmth.cold(arm.n))[0]
    T_known_true = arm.fk(q) @ frames.invert(true)
    points = laser_points(plan.station, T_base_laser, rng)
    return {
        name: T_known_true[:3, :3] @ place + T_known_true[:3, 3] for name, place in points.items()
    }
