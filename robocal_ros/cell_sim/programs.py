"""A robot's own program at a beam station: it drives the steps of a tool measurement."""

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.tool_cell import Circle, Plunge, ToolCell, joints_at, raised
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.edges import BeamEdge, EdgeSample
from robocal_ros.tool.measuring_plan import PlannedStep

# ---- motion -------------------------------------------------------------------------------------


Array = NDArray[np.float64]

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


# ---- a robot's own program: goes to where a measuring step begins, and drives it ----------------


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

    Raises
    ------
    LimitError
        When the robot does not reach it.
    """
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
    return time, q, _rates(time, q), move


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


def _rates(time: Array, q: Array) -> Array:
    """Velocities (k, n) of smooth cubics through the points, from rest to rest."""
    from scipy.interpolate import CubicSpline

    return np.asarray(CubicSpline(time, q, bc_type="clamped")(time, 1))


# ---- a robot's own program at a beam station: it drives the steps of a tool measurement ---------


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
        count = int(seconds * self.cell.plan.rate_hz)
        return self._samples(self._times(count), np.tile(self.q, (count, 1)), [])

    def drive(self, step: PlannedStep) -> list[Sample]:
        """Go to a step's start, drive it, and rest."""
        move = step_move(step, self.now_s + TRANSFER_S + 1.0 / self.cell.plan.rate_hz, RIPPLE, 0.0)
        count = int(np.ceil((move.span[1] - move.span[0]) * self.cell.plan.rate_hz)) + 1
        time = move.span[0] + np.arange(count) / self.cell.plan.rate_hz
        q = joints_at(self.cell.arm, move(time), self.q)
        steps = round(TRANSFER_S * self.cell.plan.rate_hz) + 1
        share = np.linspace(0.0, 1.0, steps)[:, None]
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        there = self._samples(self._times(steps), self.q + smooth * (q[0] - self.q), [])
        edges = self.cell.station.edges(self.tool, move, move.window, self._rng)
        driven = self._samples(time, q, self.edit(step, edges))
        return there + driven + self.rest(REST_S)

    def ns(self, time_s: float) -> int:
        """Stamp of a time since the start."""
        return self.start_ns + round(time_s * 1e9)

    def _times(self, count: int) -> Array:
        return self.now_s + np.arange(count) / self.cell.plan.rate_hz

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


# ---- a production programme: from pose to pose, a rest at each, and the way home ----------------


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


# ---- files of taught poses: a row each, its kind and its joint angles in degrees ----------------


def read_poses(path: Path, *kinds: str) -> NDArray[np.float64]:
    """Poses (m, n) of these kinds in the order of the file, rad."""
    with path.open(newline="") as stream:
        rows = [row[1:] for row in csv.reader(stream) if row[0] in kinds]
    return np.radians(np.array(rows, dtype=np.float64))
