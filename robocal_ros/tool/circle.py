# SPDX-License-Identifier: Apache-2.0
"""Where the tool's axis is from one circle through two crossed beams, by time alone.

The flange runs on a circle of radius R at constant speed in the beam plane, its orientation held.
In the laser frame the axis is at ``c + R (cos theta, sin theta)``; its signed distance from beam b
is ``s_b = d_b + R sin(psi_b)`` with psi_x = theta and psi_y = beta - theta, and at an edge it is
exactly +rho_b or -rho_b. The centre is ``c = (d_y / sin beta + d_x / tan beta, d_x)``. Only ratios
to R follow from times: R itself is the commanded one, or that of the flange as it was driven.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import SOUND_FIT, Estimate, chi2_quantile, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.ground.frames import Array
from robocal_ros.tool.crossed_model import LARGEST_MISFIT_M, BeamStep, RobotNoise
from robocal_ros.tool.edges import BEAMS, FEWEST_EDGES, BeamEdge, BeamError, edges_of
from robocal_ros.tool.laser_frame import FlangePath, LaserFrame, axis_from_centres, retaught

CircleMethod = Literal["best", "classic"]

THICKEST = 0.7  # tool's radius on the circle's
DEEPEST = 0.999  # of R: an edge where the circle hardly crosses the beam
EDGE_SCATTER_M = RobotNoise.edge_m  # of a robot that repeats well
PLACES = 200  # of the flange along a circle
SHORTEST_ARC_RAD = float(np.pi)
SAME_TURN_RAD = 1e-3  # orientations that differ by less are one: a robot repeats far better


@dataclass(frozen=True)
class CircleMotion:
    """The commanded circle.

    ``radius_m``, ``period_s``: of the flange's circle. ``start_rad``: where the flange stands at
    time 0, counter-clockwise from the laser's x. ``direction``: +1 counter-clockwise seen from
    above, -1 clockwise. ``beam_angle_rad``: beta, from the x- to the y-beam.
    """

    radius_m: float
    period_s: float
    start_rad: float = 0.0
    direction: int = 1
    beam_angle_rad: float = float(np.pi / 2.0)

    def __post_init__(self) -> None:
        if not (self.radius_m > 0.0 and self.period_s > 0.0 and self.direction in (1, -1)):
            raise ValueError("radius and period must be positive, direction +1 or -1")

    @property
    def rate_rad_s(self) -> float:
        """Signed angular speed."""
        return self.direction * 2.0 * float(np.pi) / self.period_s

    def psi(self, theta: Array, beam: int) -> Array:
        """Angle psi of a beam (its own inverse)."""
        return theta if beam == 0 else self.beam_angle_rad - theta

    def psi_rate(self, beam: int) -> float:
        """Sign of the speed at which psi of a beam changes."""
        return float(self.direction if beam == 0 else -self.direction)

    def centre(self, d: Array) -> Array:
        """Centre (2,), laser frame, m, from the distances d_x, d_y (thesis eq. 4-29)."""
        return self.centre_jacobian @ d

    @property
    def centre_jacobian(self) -> Array:
        """(2, 2) derivative of the centre by d_x and d_y."""
        beta = self.beam_angle_rad
        return np.array([[1.0 / np.tan(beta), 1.0 / np.sin(beta)], [1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class CircleEdges:
    """Edges of one circle with what each one means.

    ``beam`` (m,): 0 for the x-beam, 1 for the y-beam. ``rising`` (m,): +1 where the distance from
    the beam grows, -1 where it falls. ``side`` (m,): +1 where the tool's axis is at +rho then, -1
    at -rho. ``time_s``, ``sigma_s``: (m,).
    """

    beam: NDArray[np.int64]
    rising: Array
    side: Array
    time_s: Array
    sigma_s: Array


def label_edges(
    motion: CircleMotion, edges: Sequence[BeamEdge], latency_s: float = 0.0
) -> CircleEdges:
    """Tell for each edge on which side of which beam the axis was, and which way it went.

    Between the restore of a shadow and the next break the arc's middle is exactly above or below
    the beam's middle: a latency up to a quarter of a turn does not confuse it. The first edge may
    be a restore, and there may be several turns.
    """
    parts = []
    for b, beam in enumerate(BEAMS):
        own = edges_of(edges, beam, FEWEST_EDGES["circle"])
        time = np.array([e.time_s for e in own])
        breaks = np.array([e.blocked for e in own])
        shadow = np.cumsum(breaks)  # a first restore is of shadow 0
        middle = 0.5 * (time[:-1] + time[1:])[~breaks[:-1]] - latency_s
        theta = motion.start_rad + motion.rate_rad_s * middle
        above = np.sin(motion.psi(theta, b)) * (-1.0) ** shadow[:-1][~breaks[:-1]]
        rising = np.sign(np.sum(above)) * (-1.0) ** shadow
        sigma = np.array([e.sigma_s for e in own])
        parts.append((np.full(len(own), b), rising, np.where(breaks, -rising, rising), time, sigma))
    beam_index, rising, side, time, sigma = (np.concatenate(p) for p in zip(*parts, strict=True))
    return CircleEdges(beam_index, rising, side, time, sigma)


@dataclass(frozen=True)
class CircleState:
    """Unknowns of a circle: d_x, d_y, rho_x, rho_y (m) and latency (s)."""

    d: Array
    rho: Array
    latency_s: float


@dataclass(frozen=True, eq=False)
class CircleProblem:
    """Edge times predicted minus measured, over sigma; see the module's text."""

    motion: CircleMotion
    edges: CircleEdges
    latency_free: bool = True
    scale_components: int = field(default=1, init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return ("d_x", "d_y", "rho_x", "rho_y") + ("latency",) * self.latency_free

    def deviation(self, state: CircleState) -> Array:
        """No prior."""
        return np.zeros(len(self.names))

    def retract(self, state: CircleState, step: Array) -> CircleState:
        """Add the increment."""
        latency = state.latency_s + (step[4] if self.latency_free else 0.0)
        return CircleState(state.d + step[:2], state.rho + step[2:4], latency)

    def sine(self, state: CircleState) -> Array:
        """Of psi (m,) at each edge: the axis passes the beam at speed times the cosine."""
        e = self.edges
        w = (e.side * state.rho[e.beam] - state.d[e.beam]) / self.motion.radius_m
        return np.clip(w, -DEEPEST, DEEPEST)

    def linearise(self, state: CircleState) -> tuple[Array, Array]:
        """Residual (m, 1) and Jacobian (m, 1, k)."""
        e, motion = self.edges, self.motion
        beam_rate = np.array([motion.psi_rate(b) for b in (0, 1)])[e.beam]
        w = self.sine(state)
        turn = e.rising * beam_rate  # +1: psi = asin w, -1: psi = pi - asin w
        psi = np.where(turn > 0.0, np.arcsin(w), np.pi - np.arcsin(w))
        theta = np.where(e.beam == 0, psi, motion.beam_angle_rad - psi)
        time = (theta - motion.start_rad) / motion.rate_rad_s + state.latency_s
        turns = np.round((e.time_s - time) / motion.period_s)
        time = time + turns * motion.period_s
        by_w = e.rising / (abs(motion.rate_rad_s) * np.sqrt(1.0 - w**2))
        J = np.ones((len(time), len(self.names)), order="F")  # by the latency
        J[:, :4] = 0.0
        rows = np.arange(len(time))
        J[rows, e.beam] = -by_w / motion.radius_m
        J[rows, 2 + e.beam] = e.side * by_w / motion.radius_m
        whitened = J / e.sigma_s[:, None]
        return ((time - e.time_s) / e.sigma_s)[:, None], whitened[:, None, :]


@dataclass(frozen=True, eq=False)
class CircleFit:
    """The tool's axis on one circle.

    ``centre`` (2,): place of the tool's axis in the beam plane, laser frame, when the flange is at
    the circle's centre, m. ``covariance`` (2, 2): of it, m^2; None for the classic method, which
    has no noise model. ``rho`` (2,): the tool's radius seen by the x- and the y-beam, m; the
    classic method does not see it (None). ``latency_s``:
    as estimated, or as given. ``misfit_m``: rms of the residuals along the circle, m.
    """

    method: CircleMethod
    centre: Array
    covariance: Array | None
    rho: Array | None
    latency_s: float
    latency_sigma_s: float | None
    misfit_m: float
    estimate: Estimate[CircleState] | None = None


def fit_circle(
    motion: CircleMotion,
    edges: Sequence[BeamEdge],
    method: CircleMethod = "best",
    *,
    latency_s: float | None = None,
) -> CircleFit:
    """Find the tool's axis from one circle at constant speed.

    ``best``: closed form from all edges, then maximum likelihood over the centre, the radii and the
    phase (latency). ``classic``: mid-times (thesis eq. 4-8, 4-9). ``latency_s`` fixes the latency.
    A misfit is judged (chi-square) beside the scatter of a robot that repeats well. The covariance
    is that of the stamps alone, and wider where they do not explain the misfit.

    Raises `BeamError` when edges are missing, doubled or out of order; `ResidualError` when no
    circle at constant speed explains the edges.
    """
    labelled = label_edges(motion, edges, latency_s or 0.0)
    d, rho, latency = closed_form(motion, labelled)
    if method == "classic":
        d = classic_distances(motion, labelled)
        return CircleFit(method, motion.centre(d), None, None, latency, None, 0.0)
    if np.any(rho > THICKEST * motion.radius_m):
        raise BeamError(
            f"the shadows last for most of the turn (radius {rho.max() * 1e3:.2f} mm on a circle "
            f"of {motion.radius_m * 1e3:.2f} mm): check the input's polarity; for a tool so thick "
            "enlarge the circle"
        )
    problem = CircleProblem(motion, labelled, latency_s is None)
    start = CircleState(d, rho, latency if latency_s is None else latency_s)
    found = solve(problem, start, robust=False)
    state, spread = found.state, found.covariance
    speed = 2.0 * np.pi * motion.radius_m / motion.period_s
    late = found.residual[:, 0] * labelled.sigma_s
    misfit = float(speed * np.sqrt(np.mean(late**2)))
    bound = chi2_quantile(SOUND_FIT, len(late) - len(found.names))
    passing = speed * np.sqrt(1.0 - problem.sine(state) ** 2)
    variance = labelled.sigma_s**2 + (EDGE_SCATTER_M / passing) ** 2
    unexplained = float(np.sum(late**2 / variance)) > bound
    if unexplained or misfit > LARGEST_MISFIT_M or not found.converged:
        explained = speed * float(np.sqrt(bound / len(late) * variance.mean()))
        raise ResidualError(
            f"the edges miss a circle at constant speed by {misfit * 1e3:.4f} mm rms (stamps and "
            f"the robot's scatter explain {min(explained, LARGEST_MISFIT_M) * 1e3:.4f} mm): speed "
            "not constant: record joints and give them; or else check radius, period, start, beam "
            "angle and the stamps' sigma"
        )
    J = motion.centre_jacobian
    return CircleFit(
        method="best",
        centre=motion.centre(state.d),
        covariance=J @ spread[:2, :2] @ J.T,
        rho=state.rho,
        latency_s=state.latency_s,
        latency_sigma_s=float(np.sqrt(spread[4, 4])) if latency_s is None else None,
        misfit_m=misfit,
        estimate=found,
    )


def closed_form(motion: CircleMotion, edges: CircleEdges) -> tuple[Array, Array, float]:
    """Distances (2,), radii (2,), m, and latency, s, from the arcs on each beam's negative side.

    ``R cos(inner / 2) = d + rho`` (beam clear, restore to break) and ``R cos(outer / 2) =
    d - rho`` (with both shadows, break to restore); half sum d, half difference rho.
    """
    d, rho, late = np.zeros(2), np.zeros(2), []
    for b in (0, 1):
        psi = _mean_psi(motion, edges, b)
        sign = motion.psi_rate(b)
        half_inner = 0.5 * _positive(sign * (psi[1, -1] - psi[-1, -1]))
        half_outer = 0.5 * _positive(sign * (psi[1, 1] - psi[-1, 1]))
        inner, outer = motion.radius_m * np.cos([half_inner, half_outer])
        d[b], rho[b] = 0.5 * (inner + outer), 0.5 * (inner - outer)
        for side, half in ((-1, half_inner), (1, half_outer)):  # the arcs' middle is at -pi / 2
            middle = psi[-1, side] + sign * half
            late.append(sign * (middle + 0.5 * np.pi))
    phase = np.angle(np.mean(np.exp(1j * np.array(late))))
    return d, rho, float(phase / abs(motion.rate_rad_s))


def classic_distances(motion: CircleMotion, edges: CircleEdges) -> Array:
    """Distances (2,), m, from the mid-times of the crossings: R cos(arc / 2) (eq. 4-9).

    Biased for a tool of finite radius: break and restore are not symmetric about the crossing.
    """
    d = np.zeros(2)
    for b in (0, 1):
        psi = _mean_psi(motion, edges, b)
        middle = {}
        for rising in (1, -1):
            entry, leave = psi[rising, -rising], psi[rising, rising]
            sign = motion.psi_rate(b)
            middle[rising] = entry + 0.5 * sign * _positive(sign * (leave - entry))
        arc = _positive(motion.psi_rate(b) * (middle[1] - middle[-1]))
        d[b] = motion.radius_m * np.cos(0.5 * arc)
    return d


def _mean_psi(motion: CircleMotion, edges: CircleEdges, b: int) -> dict[tuple[int, int], float]:
    """Angle psi at each kind (rising, side) of edge of a beam, mean over the turns, no latency."""
    theta = motion.start_rad + motion.rate_rad_s * edges.time_s
    found = {}
    for rising in (1, -1):
        for side in (1, -1):
            own = (edges.beam == b) & (edges.rising == rising) & (edges.side == side)
            if not np.any(own):
                raise BeamError(
                    f"beam {BEAMS[b]}: a whole turn gives four edges, and one of them is missing; "
                    "let the circle run past its start"
                )
            vector = np.mean(np.exp(1j * motion.psi(theta[own], b)))
            found[rising, side] = float(np.angle(vector))
    return found


def _positive(angle: float) -> float:
    return float(angle % (2.0 * np.pi))


@dataclass(frozen=True, eq=False)
class CommandedCircle:
    """A circle as commanded: its motion, the flange's pose at its centre, and the edges."""

    motion: CircleMotion
    T_base_centre: Array
    edges: Sequence[BeamEdge]


def classic_tool(
    laser: LaserFrame,
    circles: tuple[CommandedCircle, CommandedCircle],
    R_base_flange: Array,
    plunge: Array,
    T_flange_tool: Array,
) -> Array:
    """T_flange_tool (4, 4) as in the source, with its errors corrected.

    ``circles``: with the tool as it is, at two heights. ``plunge`` (n, 3): flange positions, base,
    m, at the edges of the plunges, made at the orientation ``R_base_flange`` (3, 3) with the
    axis upright and on the crossing. The tip is
    ``R_base_flange^T (M - mean of the plunge)`` (thesis eq. 4-14, corrected).
    """
    centres = [fit_circle(c.motion, c.edges, "classic").centre for c in circles]
    v = axis_from_centres(
        laser, (circles[0].T_base_centre, circles[1].T_base_centre), (centres[0], centres[1])
    )
    tip = R_base_flange.T @ (laser.T_base_laser[:3, 3] - plunge.mean(axis=0))
    return frames.transform(retaught(T_flange_tool[:3, :3], v), tip)


def driven_circle(
    laser: LaserFrame, path: FlangePath, edges: Sequence[BeamEdge]
) -> CommandedCircle:
    """Fit a circle at constant speed to the flange between the first and the last edge.

    The circle lies parallel to the beam plane; linear least squares of its centre and radius
    (Kåsa 1976), and of its angle over time.

    Raises `BeamError` when a beam has fewer than four edges; `RankDeficientError` when the flange
    went less than half a turn; `ResidualError` when the flange drove no such circle, or turned.
    """
    for beam in BEAMS:
        edges_of(edges, beam, FEWEST_EDGES["circle"])
    stamps = [edge.time_s for edge in edges]
    time = np.linspace(min(stamps), max(stamps), PLACES)
    T, _ = path.at(time)
    T_laser_flange = frames.invert(laser.T_base_laser) @ T
    x, y, z = T_laser_flange[:, :3, 3].T
    A = np.column_stack([2.0 * x, 2.0 * y, np.ones_like(x)])
    cx, cy, rest = np.linalg.lstsq(A, x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(rest + cx**2 + cy**2))
    angle = np.unwrap(np.arctan2(y - cy, x - cx))
    middle = float(time.mean())
    rate, phase = np.polyfit(time - middle, angle, 1)
    if np.ptp(angle) < SHORTEST_ARC_RAD:
        raise RankDeficientError(
            f"the flange went {np.degrees(np.ptp(angle)):.0f} deg about the circle's centre "
            "between the first and the last edge: drive a whole turn",
            ("centre of the circle",),
        )
    off = np.hypot(np.hypot(x - cx, y - cy) - radius, z - z.mean())
    if off.max() > LARGEST_MISFIT_M:
        raise ResidualError(
            f"the flange leaves a circle in the beam plane by {off.max() * 1e3:.3f} mm (allowed "
            f"{LARGEST_MISFIT_M * 1e3:.1f} mm): drive the circle about the laser's z"
        )
    ahead_m = radius * float(np.abs(angle - phase - rate * (time - middle)).max())
    turn_rad = float(
        np.linalg.norm(frames.log_rotation(T[:, :3, :3] @ T[0, :3, :3].T), axis=1).max()
    )
    if not (ahead_m <= LARGEST_MISFIT_M and turn_rad <= SAME_TURN_RAD):
        raise ResidualError(
            f"on the circle the flange was {ahead_m * 1e3:.3f} mm from where a constant speed has "
            f"it (allowed {LARGEST_MISFIT_M * 1e3:.1f} mm), and turned by "
            f"{np.degrees(turn_rad):.3f} deg (allowed {np.degrees(SAME_TURN_RAD):.2f} deg): use "
            "method best, which takes the flange where it was at each edge"
        )
    motion = CircleMotion(
        radius_m=radius,
        period_s=float(2.0 * np.pi / abs(rate)),
        start_rad=float(phase - rate * middle),
        direction=1 if rate > 0.0 else -1,
        beam_angle_rad=laser.beam_angle_rad,
    )
    centre = laser.T_base_laser @ [cx, cy, z.mean(), 1.0]
    return CommandedCircle(motion, frames.transform(T[0, :3, :3], centre[:3]), edges)


def classic_from_path(
    laser: LaserFrame, path: FlangePath, steps: Sequence[BeamStep], T_flange_tool: Array
) -> Array:
    """T_flange_tool (4, 4) by `classic_tool` from a recorded run.

    Its two circles are the first one and, of those with the same orientation of the flange, the
    one farthest from it in height. ``T_flange_tool``: as taught.

    Raises `BeamError` or `ResidualError` as `driven_circle`; the message names the step;
    `RankDeficientError` when there is no second circle at another height, or no plunge.
    """
    circles = []
    for step in steps:
        if step.kind == "circle":
            try:
                circles.append(driven_circle(laser, path, step.edges))
            except (BeamError, ResidualError) as error:
                raise type(error)(f"{step.name}: {error}") from error
    plunges = [edge.time_s for step in steps if step.kind == "plunge" for edge in step.edges]
    if not circles or not plunges:
        missing = "plunge" if circles else "circle"
        raise RankDeficientError(f"there is no {missing}: drive one", (f"the {missing}'s part",))
    T, _ = path.at(np.array(plunges))
    first, up = circles[0].T_base_centre, laser.T_base_laser[:3, 2]

    def height(circle: CommandedCircle) -> float:
        """Above or below the first one; 0 at another orientation."""
        there = circle.T_base_centre
        turn = np.linalg.norm(frames.log_rotation(there[:3, :3] @ first[:3, :3].T))
        return abs(float(up @ (there - first)[:3, 3])) if turn < SAME_TURN_RAD else 0.0

    pair = circles[0], max(circles, key=height)
    return classic_tool(laser, pair, T[0, :3, :3], T[:, :3, 3], T_flange_tool)
