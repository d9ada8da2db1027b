# SPDX-License-Identifier: Apache-2.0
"""A robot that carries a tool through a beam station, for tests, figures and bags.

What it is told follows from what the estimators say after each step, as in a real cell. Also the
robot's own program, which drives the steps that a session asks for.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import (
    SWEEP_M,
    SWEEP_S,
    BeamStation,
    Circle,
    Plunge,
    RoundTool,
    TrueInput,
    TrueNoise,
    joints_at,
    raised,
    step_move,
)
from robocal_ros.ground import frames
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse
from robocal_ros.tool.circle import (
    CircleMethod,
    CircleMotion,
    CommandedCircle,
    classic_tool,
    fit_circle,
)
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise, ToolEstimate, estimate_tool
from robocal_ros.tool.edges import BeamEdge, EdgeSample, StepKind
from robocal_ros.tool.laser_frame import JointPath, LaserFrame, axis_from_centres, upright_pose
from robocal_ros.tool.run import PlannedStep

Array = NDArray[np.float64]

# A beam station in front of a UR10.
NO_NOISE = TrueNoise(0.0, 0.0)
PERFECT = TrueInput(jitter_s=0.0)
Q_NEAR = np.array([0.047, -2.208, -1.248, 1.885, -1.571, 1.618])  # above the station
BETA_RAD = float(np.radians(92.2))
GAP_M = 5.8e-5
T_BASE_LASER = frames.transform(frames.exp_rotation([0.02, -0.04, 0.01]), [0.7994, -0.1263, 0.1945])
TAUGHT = frames.transform(np.eye(3), [0.0, 0.0, 0.15])


def laser_of(station: BeamStation, sigma_m: float = 0.0) -> LaserFrame:
    """The laser frame as it truly is."""
    x, y = station.beams
    return LaserFrame(np.array([x.start, x.end, y.start, y.end]), sigma_m)


ABOVE_TIP_M = 5e-3  # where the lower circles meet the tool
PLANNING = Held(along_m=5e-3)


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

    def classic(self) -> Array:
        """T_flange_tool (4, 4) as the source finds it."""
        edges = [np.array([e.time_s for e in step.edges]) for step in self.steps[3:]]
        plunge = np.concatenate([self.path.at(t)[0][:, :3, 3] for t in edges])
        R = self.commanded(2).T_base_centre[:3, :3]
        circles = self.commanded(0), self.commanded(1)
        return classic_tool(self.cell.laser, circles, R, plunge, self.taught)

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
        self._run(name, move)

    def plunge(self, name: str, T_base_top: Array) -> None:
        """Run a plunge."""
        plan = self.cell.plan
        depth, speed, down = plan.plunge_depth, plan.plunge_speed, -self.cell.up
        self._run(name, Plunge(T_base_top, down, depth, speed))

    def upright(self, method: CircleMethod) -> Array:
        """Centre of the next circle, with the tool set upright as the circles so far show it."""
        laser, first = self.cell.laser, self.commanded(0)
        if method == "best":
            seen = self.estimate()
            point = seen.tip - ABOVE_TIP_M * seen.axis
            return upright_pose(laser, first.T_base_centre, seen.axis, point)
        second = self.commanded(1)
        low, high = (fit_circle(of.motion, of.edges, "classic").centre for of in (first, second))
        v = axis_from_centres(laser, (first.T_base_centre, second.T_base_centre), (low, high))
        T = first.T_base_centre
        on_axis = laser.T_base_laser[:3, 3] + laser.T_base_laser[:3, :2] @ low
        return upright_pose(laser, T, v, T[:3, :3].T @ (on_axis - T[:3, 3]))

    def top(self, method: CircleMethod) -> Array:
        """Where the plunges begin, with the upright axis on the crossing."""
        rise, last = 0.5 * self.cell.plan.plunge_depth, self.commanded(2)
        if method == "best":
            seen = self.estimate()
            T = upright_pose(self.cell.laser, last.T_base_centre, seen.axis, seen.tip)
            return raised(T, rise * self.cell.up)
        centre = fit_circle(last.motion, last.edges, "classic").centre
        T = raised(last.T_base_centre, -(self.cell.laser.T_base_laser[:3, :2] @ centre))
        return raised(T, (ABOVE_TIP_M + rise) * self.cell.up)

    def _run(self, name: str, move: Circle | Plunge) -> None:
        plan = self.cell.plan
        next_s = float(self._time[-1][-1]) + plan.transfer_s if self._time else 0.0
        move = replace(move, start_s=next_s - move.span[0])
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
        kind: StepKind = "circle" if isinstance(move, Circle) else "plunge"
        self.steps.append(BeamStep(name, kind, edges))


TOUCHED = np.array([0.80, -0.13, 0.19])  # a point before the robot, base, m
WAY = 24  # poses on a way, so that no joint jumps


def touching(
    arm: SerialArm,
    tool: Array,
    q_near: Array,
    count: int,
    *,
    tilt_rad: float = 0.45,
    scatter_m: float = 0.0,
    rng: np.random.Generator | None = None,
) -> Array:
    """Joints (count, n) with the tip of a tool (4, 4) on `TOUCHED`, tilted all around it.

    ``scatter_m``: of the tip about the point along each axis, drawn from ``rng``.
    """
    found, here = [], arm.fk(q_near)
    for i in range(count):
        turn = 2.0 * np.pi * i / count
        tilt = tilt_rad * np.array([np.cos(turn), np.sin(turn), 0.0])
        off = np.zeros(3) if rng is None else scatter_m * rng.standard_normal(3)
        share = np.linspace(0.0, 1.0, WAY)[:, None]
        R = frames.exp_rotation(share * tilt) @ here[:3, :3]
        start = here[:3, 3] + here[:3, :3] @ tool[:3, 3]
        tip = start + share * (TOUCHED + off - start)
        T = frames.transform(R, tip - R @ tool[:3, 3])
        found.append(inverse(arm, T, q_near)[-1])
    return np.array(found)


def point_sigma(station: BeamStation) -> float:
    """Standard deviation of a coordinate of A ... D across its beam, m."""
    source, noise, speed = station.input, station.noise, SWEEP_M / SWEEP_S
    stamp = np.hypot(source.jitter_s, source.sample_period_s / np.sqrt(12.0))
    edge = np.hypot(noise.edge_m, speed * stamp)
    return float(np.sqrt(noise.step_m**2 / 2.0 + edge**2 / 4.0))


Sample = JointSample | EdgeSample
Edit = Callable[[PlannedStep, list[BeamEdge]], list[BeamEdge]]
TRANSFER_S = 0.384  # from step to step
REST_S = 0.25  # after a step
RIPPLE = 0.02  # of the speed on a circle


class RobotProgram:
    """Gives the samples of each motion in the order of their stamps.

    Attributes
    ----------
    edit : what happens to the edges of a step before they are reported: faults.
    now_s : end of the last motion, since ``start_ns``.
    """

    def __init__(
        self,
        cell: ToolCell,
        tool: RoundTool,
        rng: np.random.Generator,
        start_ns: int,
        station: str = "",
        edit: Edit = lambda step, edges: edges,
    ) -> None:
        self.cell, self.tool, self.edit, self.station = cell, tool, edit, station
        self.start_ns, self.now_s = start_ns, 0.0
        self.q = cell.q_near.copy()
        self._rng = rng

    def rest(self, seconds: float) -> list[Sample]:
        """Stand still."""
        rate_hz = self.cell.plan.rate_hz
        count = int(seconds * rate_hz)
        time = self.now_s + np.arange(count) / rate_hz
        return self._samples(time, np.tile(self.q, (count, 1)), [])

    def drive(self, step: PlannedStep) -> list[Sample]:
        """Go to a step's start, drive it, and rest."""
        move = step_move(step, self.now_s + TRANSFER_S + 1.0 / self.cell.plan.rate_hz, RIPPLE, 0.0)
        count = int(np.ceil((move.span[1] - move.span[0]) * self.cell.plan.rate_hz)) + 1
        time = move.span[0] + np.arange(count) / self.cell.plan.rate_hz
        q = joints_at(self.cell.arm, move(time), self.q)
        steps = round(TRANSFER_S * self.cell.plan.rate_hz) + 1
        share = np.linspace(0.0, 1.0, steps)[:, None]
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        way = self.now_s + np.arange(steps) / self.cell.plan.rate_hz
        there = self._samples(way, self.q + smooth * (q[0] - self.q), [])
        edges = self.cell.station.edges(self.tool, move, move.window, self._rng)
        driven = self._samples(time, q, self.edit(step, edges))
        return there + driven + self.rest(REST_S)

    def ns(self, time_s: float) -> int:
        """Stamp of a time since the start."""
        return self.start_ns + round(time_s * 1e9)

    def _samples(self, time: Array, q: Array, edges: Sequence[BeamEdge]) -> list[Sample]:
        names = self.cell.arm.joint_names
        samples: list[Sample] = [
            JointSample(self.ns(t), names, joints)
            for t, joints in zip(time.tolist(), q, strict=True)
        ]
        samples += [
            EdgeSample(self.ns(e.time_s), self.station, e.beam, e.blocked, e.sigma_s) for e in edges
        ]
        self.now_s = float(time[-1]) + 1.0 / self.cell.plan.rate_hz
        self.q = q[-1]
        return sorted(samples, key=lambda sample: sample.stamp_ns)
