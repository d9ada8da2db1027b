"""A robot that carries a tool through a beam station: its motions, edges and joint readings.

The robot goes where it is told but for its scatter; its joint readings show where it was told to
go. What it is told follows from what the estimators say after each step, as in a real cell.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beam_moves import Circle, Plunge
from robocal_ros.cell_sim.beams import BeamStation, RoundTool
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.crossed_model import BeamStep, CircleMethod, Held, RobotNoise, fit_circle
from robocal_ros.tool.crossed_run import CommandedCircle, ToolEstimate, estimate_tool
from robocal_ros.tool.edges import CircleMotion
from robocal_ros.tool.flange_path import JointPath, axis_from_centres, upright_pose
from robocal_ros.tool.laser_frame import LaserFrame

Array = NDArray[np.float64]

ABOVE_TIP_M = 5e-3  # where the lower circles meet the tool
PLANNING = Held(along_m=5e-3)
NEWTON_STEPS = 12


@dataclass(frozen=True)
class RunPlan:
    """Size and speed of the motions; ``rate_hz`` of the joint readings."""

    radius: float = 0.012
    speed: float = 0.05
    height: float = 0.05  # between the circles
    plunge_depth: float = 0.007
    plunge_speed: float = 0.01
    transfer_s: float = 0.3
    ripple: float = 0.0
    rate_hz: float = 125.0


@dataclass(eq=False)
class ToolCell:
    """Robot, station, and the laser frame that the robot knows; one run at a time.

    Attributes
    ----------
    q_near : (n,) joints near the station, where inverse kinematics begin.
    """

    arm: SerialArm
    station: BeamStation
    laser: LaserFrame
    q_near: Array
    plan: RunPlan = field(default_factory=RunPlan)
    robot: RobotNoise = field(default_factory=RobotNoise)

    @property
    def up(self) -> Array:
        """Upward axis of the laser frame, base."""
        return self.laser.T_base_laser[:3, 2]

    def pose(self, T_flange_tool: Array, above_tip: float) -> Array:
        """Flange pose with the tool upright and a point of its axis on the crossing."""
        down = frames.transform(
            self.laser.T_base_laser[:3, :3] @ np.diag([1.0, -1.0, -1.0]), [0.0] * 3
        )
        point = T_flange_tool[:3, 3] - above_tip * T_flange_tool[:3, 2]
        return upright_pose(self.laser, down, T_flange_tool[:3, 2], point)

    def full_run(
        self,
        tool: RoundTool,
        taught: Array,
        rng: np.random.Generator,
        method: CircleMethod = "best",
    ) -> "MeasuredRun":
        """Two circles of the tool as it is, one of it set upright, and two plunges."""
        run = MeasuredRun(self, tool, taught, rng)
        low = self.pose(taught, ABOVE_TIP_M)
        run.circle("low", low)
        run.circle("high", raised(low, -self.plan.height * self.up))
        run.circle("upright", run.upright(method))
        top = run.top(method)
        for name in ("plunge_1", "plunge_2"):
            run.plunge(name, top)
        return run

    def quick_run(self, tool: RoundTool, stored: Array, rng: np.random.Generator) -> "MeasuredRun":
        """One circle and one plunge with the stored tool upright."""
        run = MeasuredRun(self, tool, stored, rng)
        run.circle("circle", self.pose(stored, ABOVE_TIP_M))
        run.plunge("plunge", self.pose(stored, -0.5 * self.plan.plunge_depth))
        return run


class MeasuredRun:
    """A run as it grows: steps with their edges, motions, joint readings."""

    def __init__(
        self, cell: ToolCell, tool: RoundTool, taught: Array, rng: np.random.Generator
    ) -> None:
        self.cell, self.tool, self.taught, self._rng = cell, tool, taught, rng
        self.steps: list[BeamStep] = []
        self.moves: list[Circle | Plunge] = []
        self._time: list[Array] = []
        self._q: list[Array] = []

    @property
    def duration_s(self) -> float:
        """From the first motion to the end of the last."""
        return self.moves[-1].span[1] - self.moves[0].span[0]

    @property
    def path(self) -> JointPath:
        """The joint readings so far."""
        return JointPath(self.cell.arm, np.concatenate(self._time), np.concatenate(self._q))

    def estimate(self, held: Held = PLANNING) -> ToolEstimate:
        """The tool as all steps so far show it."""
        cell = self.cell
        return estimate_tool(
            cell.laser, self.path, self.steps, self.taught, noise=cell.robot, held=held
        )

    def commanded(self, i: int) -> CommandedCircle:
        """Circle ``i`` as commanded."""
        move, laser = self.moves[i], self.cell.laser
        if not isinstance(move, Circle):
            raise ValueError(f"step {i} is not a circle")
        start = move.start_rad - move.direction * 2.0 * np.pi * move.start_s / move.period_s
        motion = CircleMotion(
            move.radius, move.period_s, start, move.direction, laser.beam_angle_rad
        )
        return CommandedCircle(motion, move.T_base_centre, self.steps[i].edges)

    def circle(self, name: str, T_base_centre: Array) -> None:
        """Run a circle; directions alternate."""
        plan = self.cell.plan
        period = 2.0 * np.pi * plan.radius / plan.speed
        move = Circle(
            T_base_centre=T_base_centre,
            R_base_laser=self.cell.laser.T_base_laser[:3, :3],
            radius=plan.radius,
            period_s=period,
            direction=-1 if len(self.moves) % 2 else 1,
            ripple=plan.ripple,
            phase_rad=2.0 * np.pi * self._rng.random(),
        )
        self._run(name, move.starting(self._next_s + move.ramp_s))

    def plunge(self, name: str, T_base_top: Array) -> None:
        """Run a plunge."""
        plan = self.cell.plan
        depth, speed, down = plan.plunge_depth, plan.plunge_speed, -self.cell.up
        self._run(name, Plunge(T_base_top, down, depth, speed, self._next_s))

    def upright(self, method: CircleMethod) -> Array:
        """Centre of the next circle, with the tool set upright as the circles so far show it."""
        laser, first = self.cell.laser, self.commanded(0)
        if method == "best":
            seen = self.estimate()
            point = seen.tip - ABOVE_TIP_M * seen.axis
            return upright_pose(laser, first.T_base_centre, seen.axis, point)
        second = self.commanded(1)
        centres = self._classic_centre(first), self._classic_centre(second)
        v = axis_from_centres(laser, (first.T_base_centre, second.T_base_centre), centres)
        T = first.T_base_centre
        on_axis = laser.T_base_laser[:3, 3] + self._in_base(centres[0])
        return upright_pose(laser, T, v, T[:3, :3].T @ (on_axis - T[:3, 3]))

    def top(self, method: CircleMethod) -> Array:
        """Where the plunges begin, with the upright axis on the crossing."""
        rise, last = 0.5 * self.cell.plan.plunge_depth, self.commanded(2)
        if method == "best":
            seen = self.estimate()
            T = upright_pose(self.cell.laser, last.T_base_centre, seen.axis, seen.tip)
            return raised(T, rise * self.cell.up)
        T = raised(last.T_base_centre, -self._in_base(self._classic_centre(last)))
        return raised(T, (ABOVE_TIP_M + rise) * self.cell.up)

    @property
    def _next_s(self) -> float:
        return float(self._time[-1][-1]) + self.cell.plan.transfer_s if self._time else 0.0

    def _run(self, name: str, move: Circle | Plunge) -> None:
        plan, kind = self.cell.plan, "circle" if isinstance(move, Circle) else "plunge"
        count = int(np.ceil((move.span[1] - move.span[0]) * plan.rate_hz)) + 1
        time = move.span[0] + np.arange(count) / plan.rate_hz
        q = joints_at(self.cell.arm, move(time), self._q[-1][-1] if self._q else self.cell.q_near)
        if self._q:
            share = np.linspace(0.0, 1.0, int(plan.transfer_s * plan.rate_hz) + 1)[1:-1]
            smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
            old = self._q[-1][-1]
            self._time.append(self._time[-1][-1] + share * plan.transfer_s)
            self._q.append(old + smooth[:, None] * (q[0] - old))
        self._time.append(time)
        self._q.append(q)
        edges = self.cell.station.edges(self.tool, move, move.window, self._rng)
        self.moves.append(move)
        self.steps.append(BeamStep(name, "circle" if kind == "circle" else "plunge", edges))

    def _classic_centre(self, circle: CommandedCircle) -> Array:
        return fit_circle(circle.motion, circle.edges, "classic").centre

    def _in_base(self, centre: Array) -> Array:
        return np.asarray(self.cell.laser.T_base_laser[:3, :2] @ centre)


def raised(T: Array, by: Array) -> Array:
    """A pose (4, 4) moved by (3,), base."""
    moved = T.copy()
    moved[:3, 3] += by
    return moved


def joints_at(arm: SerialArm, T_base_flange: Array, q_near: Array) -> Array:
    """Joints (m, n) that reach poses (m, 4, 4) near one another, by Newton from one near them."""
    q = np.tile(q_near, (len(T_base_flange), 1))
    for _ in range(NEWTON_STEPS):
        T = arm.fk(q)
        turn = T_base_flange[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2)
        miss = np.hstack([T_base_flange[:, :3, 3] - T[:, :3, 3], frames.log_rotation(turn)])
        step = np.linalg.solve(arm.jacobian(q), miss[:, :, None])[:, :, 0]
        q = q + np.clip(step, -0.3, 0.3)
        if np.max(np.abs(step)) < 1e-12:
            return np.asarray(q)
    raise ValueError("the poses are out of reach")
