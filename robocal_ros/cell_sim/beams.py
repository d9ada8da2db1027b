# SPDX-License-Identifier: Apache-2.0
"""True edges: a round tool moved through beams of finite width, each edge found on the geometry.

Seen along a beam the tool is a chain of discs and their common tangents; its distance from the
beam's middle is that of a point from such outlines. Nothing of the estimators' line geometry is
used, so that a mistake there cannot hide.
"""

import csv
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.robot import Draws, Stream
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.edges import BEAMS, BeamEdge
from robocal_ros.tool.run import PlannedStep

Poses = Callable[[Array], Array]

GRID_S = 2e-3  # no shadow is shorter
HALVINGS = 40
FINEST_S = 1e-9  # what a perfect input claims


@dataclass(frozen=True, eq=False)
class RoundTool:
    """A tool of revolution with a round tip.

    ``T_flange_tool`` (4, 4): its tip, and its axis from flange to tip along z.
    ``height``, ``radius``: (k,) of spheres above the tip, m; the tool is the hull of each two in
    turn. The lowest one touches the tip: its height is its radius.
    ``mandrel``: another one on the same flange, which breaks the beams as the tool does.
    """

    T_flange_tool: Array
    height: Array
    radius: Array
    mandrel: "RoundTool | None" = None

    def __post_init__(self) -> None:
        if self.height[0] != self.radius[0]:
            raise ValueError("the lowest sphere must touch the tip: height equal to radius")

    @classmethod
    def cylinder(cls, T_flange_tool: Array, radius: float, length: float = 0.12) -> "RoundTool":
        """A pin of one radius."""
        return cls(T_flange_tool, np.array([radius, length]), np.array([radius, radius]))

    @classmethod
    def cone(
        cls, T_flange_tool: Array, tip_radius: float, taper: float, length: float = 0.12
    ) -> "RoundTool":
        """A cone whose radius grows by ``taper`` per length above the tip."""
        slope = taper / np.hypot(1.0, taper)  # of the spheres that touch it from within
        height = np.array([tip_radius, length])
        return cls(T_flange_tool, height, tip_radius + slope * (height - tip_radius))

    @classmethod
    def torch(cls, T_flange_tool: Array, wire: float, nozzle: float) -> "RoundTool":
        """A wire of 15 mm below a cylindrical nozzle."""
        height = np.array([wire, 0.013, 0.018, 0.12])
        return cls(T_flange_tool, height, np.array([wire, wire, nozzle, nozzle]))

    def mounted(self, T_flange_tool: Array) -> "RoundTool":
        """The same tool, bent or shifted; the mandrel stays where it is."""
        return replace(self, T_flange_tool=T_flange_tool)

    @property
    def bodies(self) -> tuple["RoundTool", ...]:
        """The tool, and the mandrel where there is one."""
        return (self,) if self.mandrel is None else (self, self.mandrel)


@dataclass(frozen=True, eq=False)
class TrueBeam:
    """A beam, base.

    ``start``, ``end``: (3,) points on its middle, from emitter to receiver, m.
    ``diameter``: m.
    ``dark_at``, ``light_at``: shares of its light still there when the input switches; their
    difference is the receiver's hysteresis.
    """

    start: Array
    end: Array
    diameter: float = 8e-4
    dark_at: float = 0.5
    light_at: float = 0.5

    def clearance(self, tool: RoundTool, T_base_flange: Array) -> Array:
        """Distance (m,) of the tool's surface from the beam's middle, negative inside."""
        parts = []
        for body in tool.bodies:
            T = T_base_flange @ body.T_flange_tool
            centres = T[:, None, :3, 3] - body.height[None, :, None] * T[:, None, :3, 2]
            outline = (centres - self.start) @ self._across.T
            parts += [
                _hull_distance(outline[:, i], outline[:, i + 1], body.radius[i], body.radius[i + 1])
                for i in range(len(body.height) - 1)
            ]
        return np.asarray(np.min(parts, axis=0))

    @cached_property
    def levels(self) -> tuple[float, float]:
        """Clearances at which the input goes dark, and light again."""
        return self.threshold(self.dark_at), self.threshold(self.light_at)

    @cached_property
    def _across(self) -> Array:
        """Two directions across the beam (2, 3)."""
        u = (self.end - self.start) / np.linalg.norm(self.end - self.start)
        return np.asarray(np.linalg.svd(u[None])[2][1:])

    def threshold(self, light: float) -> float:
        """Clearance at which a straight edge leaves this share of the light."""
        low, high = -1.0, 1.0
        for _ in range(HALVINGS):  # share of a disc on one side of a chord
            x = 0.5 * (low + high)
            share = 0.5 + (np.arcsin(x) + x * np.sqrt(1.0 - x * x)) / np.pi
            low, high = (x, high) if share < light else (low, x)
        return 0.5 * self.diameter * low


def _hull_distance(a: Array, b: Array, radius_a: float, radius_b: float) -> Array:
    """Signed distance (m,) of the origin from the hull of two discs with centres (m, 2)."""
    # forty times for each edge: np.linalg.norm and np.clip cost thrice as much
    along = b - a
    length = np.sqrt((along * along).sum(axis=1))
    e = along / length[:, None]
    slope = np.minimum(np.maximum((radius_a - radius_b) / length, -1.0), 1.0)  # one may hold both
    cosine = np.sqrt(1.0 - slope**2)
    y = -(a * e).sum(axis=1)
    x = np.abs(-a[:, 0] * e[:, 1] + a[:, 1] * e[:, 0])
    foot = cosine * y - slope * x  # along the common tangent
    before = np.sqrt((a * a).sum(axis=1)) - radius_a
    distance = np.where(foot < 0.0, before, slope * y + cosine * x - radius_a)
    beyond = np.sqrt((b * b).sum(axis=1)) - radius_b
    return np.asarray(np.where(foot > cosine * length, beyond, distance))


@dataclass(frozen=True)
class TrueInput:
    """What happens between a beam and a stamp.

    ``latency_s``, ``jitter_s``: constant and random delay.
    ``sample_period_s``: period of the input; an edge is seen at the next sample. 0: by interrupt.
    ``first_sample_s``: time of one of its samples; None: another one for each motion.
    ``bounce_s``: largest time for which a contact bounces; 0: none does.
    ``lost_share``: chance that an edge is never reported.
    """

    latency_s: float = 0.0
    jitter_s: float = 20e-6
    sample_period_s: float = 0.0
    first_sample_s: float | None = None
    bounce_s: float = 0.0
    lost_share: float = 0.0


@dataclass(frozen=True)
class TrueNoise:
    """The robot's scatter, m: one shift of each step, and a further one at each edge."""

    step_m: float = 3e-5
    edge_m: float = 1e-5


@dataclass(frozen=True, eq=False)
class BeamStation:
    """Two crossed beams and their input."""

    beams: tuple[TrueBeam, TrueBeam]
    input: TrueInput = field(default_factory=TrueInput)
    noise: TrueNoise = field(default_factory=TrueNoise)

    def edges(
        self, tool: RoundTool, poses: Poses, window: tuple[float, float], rng: np.random.Generator
    ) -> list[BeamEdge]:
        """Edges while the flange moves by ``poses`` (times -> T_base_flange), as reported."""
        shift = np.zeros((4, 4))
        shift[:3, 3] = self.noise.step_m * rng.standard_normal(3)
        source = self.input
        spread_s = np.hypot(source.jitter_s, source.sample_period_s / np.sqrt(12.0))
        sigma_s = max(float(spread_s), FINEST_S)
        found: list[BeamEdge] = []
        for name, beam in zip(BEAMS, self.beams, strict=True):
            time, blocked = crossings(
                beam, tool, lambda t: poses(t) + shift, window, self.noise.edge_m, rng
            )
            stamps = reported(time, source, rng)
            for stamp, dark in zip(stamps.tolist(), blocked.tolist(), strict=True):
                if rng.random() < source.lost_share:
                    continue
                found.append(BeamEdge(name, dark, stamp, sigma_s))
                if source.bounce_s > 0.0:
                    again, last = sorted((stamp + source.bounce_s * rng.random(2)).tolist())
                    found.append(BeamEdge(name, not dark, again, sigma_s))
                    found.append(BeamEdge(name, dark, last, sigma_s))
        return sorted(found, key=lambda e: e.time_s)


def crossings(
    beam: TrueBeam,
    tool: RoundTool,
    poses: Poses,
    window: tuple[float, float],
    scatter_m: float,
    rng: np.random.Generator,
) -> tuple[Array, NDArray[np.bool_]]:
    """True times (k,) of the edges in a window, and whether each one is a break."""
    grid = np.arange(window[0], window[1] + 0.5 * GRID_S, GRID_S)
    clear = beam.clearance(tool, poses(grid))
    dark, light = beam.levels
    breaks = np.flatnonzero((clear[:-1] > dark) & (clear[1:] <= dark))
    restores = np.flatnonzero((clear[:-1] <= light) & (clear[1:] > light))
    first = np.concatenate([breaks, restores])
    blocked = np.arange(len(first)) < len(breaks)
    level = np.where(blocked, dark, light) + scatter_m * rng.standard_normal(len(first))
    low, high = grid[first] - GRID_S, grid[first + 1] + GRID_S
    for _ in range(HALVINGS if len(first) else 0):
        middle = 0.5 * (low + high)
        past = (beam.clearance(tool, poses(middle)) <= level) == blocked
        low, high = np.where(past, low, middle), np.where(past, middle, high)
    order = np.argsort(low)
    return low[order], blocked[order]


def reported(time: ArrayLike, source: TrueInput, rng: np.random.Generator) -> Array:
    """Stamps (k,) of edges at true times (k,)."""
    late = np.asarray(time) + source.latency_s
    late = late + source.jitter_s * rng.standard_normal(late.shape)
    period = source.sample_period_s
    if period > 0.0:
        first = source.first_sample_s
        phase = period * rng.random() if first is None else first
        late = np.ceil((late - phase) / period) * period + phase
    return np.asarray(late)


def beams_of(
    T_base_laser: Array, beam_angle_rad: float, gap_m: float = 0.0, length: float = 0.1
) -> tuple[TrueBeam, TrueBeam]:
    """Two beams that cross on z of a frame; the y-beam passes ``gap_m`` above the x-beam."""
    angles = np.array([0.0, beam_angle_rad])
    made = []
    for angle, height in zip(angles, (-0.5 * gap_m, 0.5 * gap_m), strict=True):
        along = 0.5 * length * np.array([np.cos(angle), np.sin(angle), 0.0])
        ends = np.array([-along, along]) + np.array([0.0, 0.0, height])
        ends = ends @ T_base_laser[:3, :3].T + T_base_laser[:3, 3]
        made.append(TrueBeam(ends[0], ends[1]))
    return made[0], made[1]


def bent(T_flange_tool: Array, shift: ArrayLike, tilt_rad: ArrayLike) -> Array:
    """A tool pose (4, 4) shifted (3,), m, and tilted by a rotation vector (3,), flange axes."""
    R = frames.exp_rotation(tilt_rad) @ T_flange_tool[:3, :3]
    return frames.transform(R, T_flange_tool[:3, 3] + np.asarray(shift))


def on_one_clock(station: BeamStation, phase: float) -> BeamStation:
    """The station whose input is sampled on one clock, ``phase`` of a period late.

    The scatter of its motions is left to the robot.
    """
    source = station.input
    return replace(
        station,
        input=replace(source, first_sample_s=source.sample_period_s * phase),
        noise=TrueNoise(0.0, station.noise.edge_m),
    )


ROOM_M = 0.15  # beams, bends and the way within a tick
DETOUR = 1.5  # a way within a tick is at most so much longer than the straight one
SLACK_M = 1e-5


class BeamWatch:
    """Looks at one tick after the other, many at once."""

    def __init__(self, arm: SerialArm, draws: Draws) -> None:
        self._arm, self._draws = arm, draws

    def edges(
        self,
        station: BeamStation,
        tool: RoundTool,
        ticks: NDArray[np.int64],
        time_s: Array,
        q: Array,
        joints: Callable[[Array], Array],
        flange: Callable[[Array], Array],
    ) -> list[BeamEdge]:
        """Edges between ticks (k,) at times (k,), in the order of the ticks.

        ``q`` (k, n): joints there; ``joints`` and ``flange``: joints (m, n) and true T_base_flange
        (m, 4, 4) at times (m,).
        """
        middle = np.array([0.5 * (beam.start + beam.end) for beam in station.beams])
        T_flange, may = self._arm.fk(q), np.zeros(len(q), dtype=np.bool_)
        for body in tool.bodies:
            tip = (T_flange @ body.T_flange_tool[:, 3])[:, :3]
            away = np.min(np.linalg.norm(tip[:, None] - middle, axis=2), axis=1)
            may |= away < np.max(body.height) + ROOM_M
        near = np.flatnonzero(may)
        if not len(near) or near[-1] == near[0]:
            return []
        first, last = int(near[0]), int(near[-1])
        inside = slice(first, last + 1)
        T = flange(time_s[inside])
        found: list[BeamEdge] = []
        for i in np.flatnonzero(_may_cross(station, tool, T)):
            at = first + i
            window = float(time_s[at]), float(time_s[at + 1])
            poses = self._between(window, T[i : i + 2], joints)
            rng = self._draws.of(Stream.EDGES, int(ticks[at]))
            found += station.edges(tool, poses, window, rng)
        return found

    def _between(
        self, window: tuple[float, float], T: Array, joints: Callable[[Array], Array]
    ) -> Poses:
        """The true flange within a tick: the nominal one, off by what changes little in a tick."""
        begin, end = window
        off = T @ np.linalg.inv(self._arm.fk(joints(np.array(window))))

        def poses(time_s: Array) -> Array:
            share = ((time_s - begin) / (end - begin))[:, None, None]
            return np.asarray((off[0] + share * (off[1] - off[0])) @ self._arm.fk(joints(time_s)))

        return poses


def _may_cross(station: BeamStation, tool: RoundTool, T: Array) -> NDArray[np.bool_]:
    """Between which of flange poses (k + 1, 4, 4) an edge can lie (k,).

    No surface comes nearer to a beam than the tool moves.
    """
    ways = []
    for body in tool.bodies:
        T_tool, top = T @ body.T_flange_tool, np.array([0.0, body.height[-1]])
        ends = T_tool[:, None, :3, 3] - top[:, None] * T_tool[:, None, :3, 2]
        ways.append(np.max(np.linalg.norm(np.diff(ends, axis=0), axis=2), axis=1))
    way = np.max(ways, axis=0)
    may = np.zeros(len(way), dtype=np.bool_)
    for beam in station.beams:
        clear = beam.clearance(tool, T)
        pair = np.stack([clear[:-1], clear[1:]])
        room = DETOUR * way + SLACK_M
        may |= (np.min(pair, axis=0) - room < max(beam.levels)) & (
            np.max(pair, axis=0) + room > min(beam.levels)
        )
    return may


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
