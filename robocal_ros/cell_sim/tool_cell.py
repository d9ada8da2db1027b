"""A robot that carries a tool through a beam station: its motions, edges and joint readings.

The robot goes where it is told but for its scatter; its joint readings show where it was told to
go. What it is told follows from what the estimators say after each step, as in a real cell. Also
the robot's own program, which drives such steps and a production programme.
"""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.beams import BeamStation, RoundTool
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.circle import CircleMethod, CircleMotion, CommandedCircle, fit_circle
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise, ToolEstimate, estimate_tool
from robocal_ros.tool.edges import BEAMS, BeamEdge, EdgeSample, StepKind
from robocal_ros.tool.laser_frame import JointPath, LaserFrame, axis_from_centres, upright_pose
from robocal_ros.tool.run import PlannedStep

Array = NDArray[np.float64]


def _moved(T_base_flange: Array, shift: Array) -> Array:
    T = np.tile(T_base_flange, (len(shift), 1, 1))
    T[:, :3, 3] += shift
    return T


@dataclass(frozen=True, eq=False)
class Circle:
    """One turn, from ``start_s``, with a run-up and a run-out of ``ramp_s`` along the circle.

    Attributes
    ----------
    T_base_centre : (4, 4) the flange at the centre.
    R_base_laser : (3, 3) the circle lies in its x-y plane; ``start_rad`` counts from x.
    ripple : relative amplitude of the speed, ``ripples`` times a turn.
    """

    T_base_centre: Array
    R_base_laser: Array
    radius: float
    period_s: float
    start_s: float = 0.0
    start_rad: float = float(np.pi / 4.0)
    direction: int = 1
    ripple: float = 0.0
    ripples: int = 7
    phase_rad: float = 0.0
    ramp_s: float = 0.2

    @property
    def window(self) -> tuple[float, float]:
        """The turn at full speed."""
        return self.start_s, self.start_s + self.period_s

    @property
    def span(self) -> tuple[float, float]:
        """From rest to rest."""
        return self.start_s - self.ramp_s, self.start_s + self.period_s + self.ramp_s

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        t = time_s - self.start_s
        before = np.clip(t, -self.ramp_s, 0.0)
        after = np.clip(t - self.period_s, 0.0, self.ramp_s)
        run = np.clip(t, 0.0, self.period_s) + before + after
        run += (before**2 - after**2) / (2.0 * self.ramp_s)
        turn = 2.0 * np.pi * run / self.period_s
        turn = turn + self.ripple / self.ripples * np.sin(self.ripples * turn + self.phase_rad)
        angle = self.start_rad + self.direction * turn
        flat = np.column_stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
        return _moved(self.T_base_centre, self.radius * flat @ self.R_base_laser.T)


@dataclass(frozen=True, eq=False)
class Plunge:
    """Down and up again along ``down`` (3,), base, at ``speed`` but for the ramps at each end."""

    T_base_top: Array
    down: Array
    depth: float
    speed: float
    start_s: float = 0.0
    ramp_s: float = 0.1

    @property
    def window(self) -> tuple[float, float]:
        """From rest to rest."""
        return self.start_s, self.start_s + 2.0 * self._one_way_s

    @property
    def span(self) -> tuple[float, float]:
        """The same."""
        return self.window

    @property
    def _one_way_s(self) -> float:
        return self.depth / self.speed + self.ramp_s

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        whole, ramp = self._one_way_s, self.ramp_s
        t = whole - np.abs(np.clip(time_s - self.start_s, 0.0, 2.0 * whole) - whole)
        t = np.clip(t, 0.0, whole)
        to_go = whole - t
        depth = np.where(
            to_go < ramp,
            self.depth - self.speed * to_go**2 / (2.0 * ramp),
            np.where(t < ramp, self.speed * t**2 / (2.0 * ramp), self.speed * (t - 0.5 * ramp)),
        )
        return _moved(self.T_base_top, depth[:, None] * self.down)


@dataclass(frozen=True, eq=False)
class Sweep:
    """At constant speed along ``along`` (3,), base, m; backwards where ``duration_s`` < 0."""

    T_base_start: Array
    along: Array
    duration_s: float

    @property
    def window(self) -> tuple[float, float]:
        """From begin to end."""
        return min(self.duration_s, 0.0), max(self.duration_s, 0.0)

    def __call__(self, time_s: Array) -> Array:
        """T_base_flange (m, 4, 4)."""
        return _moved(self.T_base_start, (time_s / self.duration_s)[:, None] * self.along)


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


DOWN = np.array([0.0, 0.0, -1.0])
SWEEP_M = 1e-2
SWEEP_S = 1.0
CYLINDER_M = 2.5e-3  # radius
CYLINDER_TIP_M = 0.15  # of the calibration tool along the flange's z


def laser_points(
    station: BeamStation, T_base_laser: Array, rng: np.random.Generator, along: float = 6e-3
) -> dict[str, Array]:
    """Flange positions A1 ... D4 at the edges of a calibration tool in base.

    Each point is swept back and forth, so that a constant latency cancels.

    ``T_base_laser`` is roughly known; ``along`` is the way of the points from the crossing.
    """
    T_tool = frames.transform(np.eye(3), [0.0, 0.0, CYLINDER_TIP_M])
    tool = RoundTool.cylinder(T_tool, CYLINDER_M)
    reach = CYLINDER_TIP_M - 0.02
    found: dict[str, Array] = {}
    for b, sign, name in ((0, -1.0, "A"), (0, 1.0, "B"), (1, -1.0, "C"), (1, 1.0, "D")):
        e = np.eye(3)[b]  # base axis nearest to the beam
        side = np.cross([0.0, 0.0, 1.0], e)
        beam = station.beams[b]
        u = (beam.end - beam.start) / np.linalg.norm(beam.end - beam.start)
        to = (T_base_laser[:3, 3] + sign * along * e - beam.start) @ e / (u @ e)
        target = beam.start + to * u
        # upright across the beam, then level in z
        for first, pointing, way in ((1, DOWN, side), (3, -side, DOWN)):
            R = np.column_stack([e, np.cross(pointing, e), pointing])
            start = frames.transform(R, target - reach * pointing - 0.5 * SWEEP_M * way)
            places = []
            for duration_s in (SWEEP_S, -SWEEP_S):
                sweep = Sweep(start, SWEEP_M * way, duration_s)
                edges = station.edges(tool, sweep, sweep.window, rng)
                own = [edge.time_s for edge in edges if edge.beam == BEAMS[b]]
                places.append(sweep(np.array(own))[:, :3, 3])
            both = 0.5 * (places[0] + places[1][::-1])
            found[f"{name}{first}"], found[f"{name}{first + 1}"] = both
    return found


def point_sigma(station: BeamStation) -> float:
    """Standard deviation of a coordinate of A ... D across its beam, m."""
    source, noise, speed = station.input, station.noise, SWEEP_M / SWEEP_S
    stamp = np.hypot(source.jitter_s, source.sample_period_s / np.sqrt(12.0))
    edge = np.hypot(noise.edge_m, speed * stamp)
    return float(np.sqrt(noise.step_m**2 / 2.0 + edge**2 / 4.0))


JITTER_RAD = 1e-6  # of a resting joint's reading: servo hum and encoder counts
COUNT_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Way points in order of time; between them the joints run smoothly (minimum jerk).

    Attributes
    ----------
    arrive, depart : (w,) times of each way point, s.
    q : (w, n) joint values there, rad.
    """

    arrive: Array
    depart: Array
    q: Array

    def at(self, time_s: Array) -> Array:
        """Joint values (k, n) at times (k,); resting before the first and after the last point."""
        after = np.clip(np.searchsorted(self.arrive, time_s), 1, len(self.arrive) - 1)
        start, end = self.depart[after - 1], self.arrive[after]
        s = np.clip((time_s - start) / (end - start), 0.0, 1.0)[:, None]
        share = s**3 * (10.0 - 15.0 * s + 6.0 * s**2)
        return np.asarray(self.q[after - 1] + share * (self.q[after] - self.q[after - 1]))


def readings(path: SmoothPath, time_s: Array, rng: np.random.Generator) -> Array:
    """Encoder readings (k, n) at times (k,), in whole counts."""
    q = path.at(time_s)
    q = q + JITTER_RAD * rng.standard_normal(q.shape)
    return np.asarray(np.round(q / COUNT_RAD) * COUNT_RAD)


PITCH_S = 8e-3  # between two points of the program's joint path
RUN_UP_S = 0.05  # short: at its begin the tool shall not be in a beam
ASIDE_M = 2e-3  # a tip that has to go further sideways goes over the station
OVER_M = 0.02  # so far above the higher one of both ends
SHORTEST_S = 0.3
FASTEST_RAD_S = 1.0
PEAK = 1.875  # of a minimum-jerk motion's speed, over its mean


def step_move(
    step: PlannedStep, start_s: float, ripple: float, phase_rad: float
) -> Circle | Plunge:
    """A step as a motion of the flange that leaves rest at ``start_s``.

    ``ripple``: relative amplitude of a circle's speed, with its phase at ``start_rad``.
    """
    if step.kind == "plunge":
        down = -step.R_base_laser[:, 2]
        return Plunge(step.T_base_flange, down, step.depth_m, step.speed_m_s, start_s)
    return Circle(
        T_base_centre=step.T_base_flange,
        R_base_laser=step.R_base_laser,
        radius=step.radius_m,
        period_s=2.0 * np.pi * step.radius_m / step.speed_m_s,
        start_s=start_s + RUN_UP_S,
        start_rad=step.start_rad,
        direction=step.direction,
        ripple=ripple,
        phase_rad=phase_rad,
        ramp_s=RUN_UP_S,
    )


def program(
    arm: SerialArm, step: PlannedStep, q_now: Array, ripple: float = 0.0, phase_rad: float = 0.0
) -> tuple[Array, Array, Array, Circle | Plunge]:
    """Joint path of a step from joints (n,) at rest: times (k,) from 0, q and qd (k, n).

    Also the motion itself, on the same clock.

    Raises `LimitError` when the robot does not reach it.
    """
    from scipy.interpolate import CubicSpline

    start = step_move(step, 0.0, ripple, phase_rad)
    try:
        way = _way(arm, step, q_now, start(np.array([start.span[0]]))[0])
        long = [
            max(SHORTEST_S, PEAK * np.max(np.abs(d)) / FASTEST_RAD_S) for d in np.diff(way, axis=0)
        ]
        arrive = np.cumsum([0.0, *long])
        move = step_move(step, float(arrive[-1]), ripple, phase_rad)
        end = move.span[1]
        time = np.linspace(0.0, end, int(np.ceil(end / PITCH_S)) + 1)
        driven = time > arrive[-1]
        q = SmoothPath(arrive, arrive, way).at(time)
        q[driven] = joints_at(arm, move(time[driven]), way[-1])
    except ValueError as error:
        raise LimitError(f"the robot does not reach step {step.name}: {error}") from error
    qd = CubicSpline(time, q, bc_type="clamped")(time, 1)  # from rest to rest
    return time, q, np.asarray(qd), move


def _way(arm: SerialArm, step: PlannedStep, q_now: Array, T_start: Array) -> Array:
    """Joints (k, n) of the way to a step's first pose, over the station where it goes aside."""
    here, up = arm.fk(q_now), step.R_base_laser[:, 2]
    along = (T_start - here) @ np.append(arm.T_flange_tool[:3, 3], 1.0)
    aside = along[:3] - (along[:3] @ up) * up
    poses = [T_start]
    if np.linalg.norm(aside) > ASIDE_M:
        rise = float((T_start - here)[:3, 3] @ up)
        lift = raised(here, (max(rise, 0.0) + OVER_M) * up)
        poses = [lift, raised(T_start, (max(-rise, 0.0) + OVER_M) * up), T_start]
    way = [q_now]
    for T in poses:
        way.append(joints_at(arm, T[None], way[-1])[0])
    return np.array(way)


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


SPEED_RAD_S = 1.5  # of the fastest joint at its peak
POSE_REST_S = 0.5
SHORTEST_MOTION_S = 0.5


def programme(
    q_start: ArrayLike, poses: ArrayLike, speed: float = SPEED_RAD_S, rest_s: float = POSE_REST_S
) -> tuple[Array, Array, Array, Array]:
    """Times (k,) from 0, joints, velocities and accelerations (k, n) of a way through poses.

    From ``q_start`` (n,) at rest to each of ``poses`` (m, n) in turn, with a rest at each: what
    `SimulatedCell.follow` takes. ``speed``: of the fastest joint, rad/s
    (prismatic: m/s); ``rest_s`` longer than 0.
    """
    points = np.vstack([np.asarray(q_start)[None], np.asarray(poses)])
    moves = np.maximum(
        PEAK * np.max(np.abs(np.diff(points, axis=0)), axis=1) / speed, SHORTEST_MOTION_S
    )
    depart = np.cumsum(moves + rest_s)
    time = np.column_stack([depart - rest_s, depart]).ravel()
    q = np.repeat(points[1:], 2, axis=0)
    return time, q, np.zeros_like(q), np.zeros_like(q)


def read_poses(path: Path, *kinds: str) -> NDArray[np.float64]:
    """Poses (m, n) of these kinds in the order of the file, rad."""
    with path.open(newline="") as stream:
        rows = [row[1:] for row in csv.reader(stream) if row[0] in kinds]
    return np.radians(np.array(rows, dtype=np.float64))
