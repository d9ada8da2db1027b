"""A robot that carries a tool through a beam station: its motions, edges and joint readings.

The robot goes where it is told but for its scatter; its joint readings show where it was told to
go. Also the calibration of a station's beams with a cylinder, and the program of a step.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beams import BeamStation, RoundTool
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.edges import BEAMS
from robocal_ros.tool.run import PlannedStep


def _moved(T_base_flange: Array, shift: Array) -> Array:
    T = np.tile(T_base_flange, (len(shift), 1, 1))
    T[:, :3, 3] += shift
    return T


@dataclass(frozen=True, eq=False)
class Circle:
    """One turn, from ``start_s``, with a run-up and a run-out of ``ramp_s`` along the circle.

    ``T_base_centre`` (4, 4): the flange at the centre.
    ``R_base_laser`` (3, 3): the circle lies in its x-y plane; ``start_rad`` counts from x.
    ``ripple``: relative amplitude of the speed, ``ripples`` times a turn.
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


NEWTON_STEPS = 12


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


JITTER_RAD = 1e-6  # of a resting joint's reading: servo hum and encoder counts
COUNT_RAD = 1e-6


@dataclass(frozen=True, eq=False)
class SmoothPath:
    """Way points in order of time; between them the joints run smoothly (minimum jerk).

    ``arrive``, ``depart``: (w,) times of each way point, s.
    ``q`` (w, n): joint values there, rad.
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


def read_poses(path: Path, *kinds: str) -> NDArray[np.float64]:
    """Poses (m, n) of these kinds in the order of the file, rad."""
    with path.open(newline="") as stream:
        rows = [row[1:] for row in csv.reader(stream) if row[0] in kinds]
    return np.radians(np.array(rows, dtype=np.float64))
