"""The edges of a whole run as a maximum likelihood problem over the tool in the flange frame.

A circle's edge: the line of the tool's axis passes the line of the beam at a signed distance
``s = n . (tip - A)`` (n the common normal of both), which is +r or -r of the tool there. A plunge's
edge: the tip's plane reaches the beam, ``w . (tip - A) = 0`` (w the part of the axis across the
beam; less the beam's reach). Both hold for any flange pose and any tilt; for a cylinder exactly.

A receiver switches back at more light than it switched off at: both edges come late by a depth,
which differs from a latency by the speed. The robot's repeatability is an unknown shift of each
step with its own prior, and so is each point of the laser frame, so that the covariance of the
tool is that of all of them together.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import SOUND_FIT, chi2_quantile
from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import ResidualError
from robocal_ros.tool.edges import (
    BEAMS,
    BeamEdge,
    BeamError,
    CircleEdges,
    CircleMotion,
    label_edges,
)
from robocal_ros.tool.flange_path import FlangePath, minimal_rotation
from robocal_ros.tool.laser_frame import LaserFrame

Array = NDArray[np.float64]
StepKind = Literal["circle", "plunge"]

TOOL_NAMES = ("tip_x", "tip_y", "tip_z", "tilt_x", "tilt_y")
START_RADIUS_M = 2e-3
HYSTERESIS_M = 2e-4  # sigma of a receiver's: light of a beam of half a millimetre
EXACT_M = 1e-9  # prior of what is taken as exact, against edges of micrometres


@dataclass(frozen=True)
class RobotNoise:
    """How well the robot repeats, m, one standard deviation of each axis.

    Attributes
    ----------
    step_m : common to a circle or a plunge.
    edge_m : further at each edge.
    """

    step_m: float = 3e-5
    edge_m: float = 1e-5


@dataclass(frozen=True)
class BeamStep:
    """A circle or a plunge and its edges."""

    name: str
    kind: StepKind
    edges: Sequence[BeamEdge]


@dataclass(frozen=True, eq=False)
class ToolState:
    """Unknowns of a run.

    Attributes
    ----------
    tip : (3,) in the flange frame, m; ``axis`` (3,) unit vector from flange to tip there.
    latency_s : of the edges behind the robot's readings.
    depth : of an edge behind the mean of break and restore, m: the receiver's hysteresis.
    radius : (circles, 2) of the tool as each circle and beam sees it, m.
    shift : (steps, 3) of the flange in each step, base, m.
    bend : (4, 2) of the laser's points A ... D, horizontally across the beam and upwards, m.
    """

    tip: Array
    axis: Array
    latency_s: float
    depth: float
    radius: Array
    shift: Array
    bend: Array

    @classmethod
    def taught(cls, T_flange_tool: Array, circles: int, steps: int) -> "ToolState":
        """Where the search begins."""
        return cls(
            tip=T_flange_tool[:3, 3],
            axis=T_flange_tool[:3, 2],
            latency_s=0.0,
            depth=0.0,
            radius=np.full((circles, 2), START_RADIUS_M),
            shift=np.zeros((steps, 3)),
            bend=np.zeros((4, 2)),
        )


def across(axis: Array) -> Array:
    """(3, 2) the two directions in which an axis can tilt: columns across it, near x and y."""
    return minimal_rotation([0.0, 0.0, 1.0], axis)[:, :2]


@dataclass(frozen=True)
class Held:
    """What a run need not determine: how far it may be from the taught tool (sigma); None: free.

    ``tilt_rad`` of the axis, each way; ``along_m`` of the tip along the axis.
    """

    tilt_rad: float | None = None
    along_m: float | None = None


@dataclass(frozen=True, eq=False)
class RunProblem:
    """Residuals of all edges; built by `run_problem`.

    ``taper``: growth of the tool's radius per length above the tip; ``height`` (circles,): of each
    circle above the tip, where its radius counts.
    """

    laser: LaserFrame
    path: FlangePath
    beam: NDArray[np.int64]
    step: NDArray[np.int64]
    circle: NDArray[np.int64]  # -1 in a plunge
    side: Array
    way: Array  # +1 where the gap grows, -1 where it shrinks
    time_s: Array
    sigma_m: Array
    circles: int
    steps: int
    taper: float
    height: Array
    taught: ToolState
    noise: RobotNoise
    held: Held
    scale_components: int = field(default=1, init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        radii = [f"radius_{b}_{c}" for c in range(self.circles) for b in BEAMS]
        shifts = [f"shift_{a}_{s}" for s in range(self.steps) for a in "xyz"]
        bends = [f"laser_{p}_{a}" for p in "ABCD" for a in ("across", "up")]
        return (*TOOL_NAMES, "latency", "depth", *radii, *shifts, *bends)

    @property
    def undetermined(self) -> int:
        """How many unknowns have no prior."""
        held = 2 * (self.held.tilt_rad is not None) + (self.held.along_m is not None)
        return 6 + 2 * self.circles - held

    @property
    def _starts(self) -> tuple[int, int, int]:
        """First columns of radii, shifts and bends."""
        shifts = 7 + 2 * self.circles
        return 7, shifts, shifts + 3 * self.steps

    @property
    def prior(self) -> Array:
        """Information matrix of shifts, bends and what is held; none for the rest."""
        _, shifts, bends = self._starts
        diagonal = np.zeros(len(self.names))
        diagonal[6] = 1.0 / HYSTERESIS_M**2
        diagonal[shifts:bends] = 1.0 / max(self.noise.step_m, EXACT_M) ** 2
        diagonal[bends:] = 1.0 / max(self.laser.sigma_m, EXACT_M) ** 2
        if self.held.tilt_rad is not None:
            diagonal[3:5] = 1.0 / self.held.tilt_rad**2
        information = np.diag(diagonal)
        if self.held.along_m is not None:
            axis = self.taught.axis
            information[:3, :3] += np.outer(axis, axis) / self.held.along_m**2
        return information

    def deviation(self, state: ToolState) -> Array:
        """Distance from the prior's mean."""
        _, shifts, bends = self._starts
        away = np.zeros(len(self.names))
        away[:3] = state.tip - self.taught.tip
        away[3:5] = across(state.axis).T @ (state.axis - self.taught.axis)
        away[6] = state.depth
        away[shifts:bends], away[bends:] = state.shift.ravel(), state.bend.ravel()
        return away

    def retract(self, state: ToolState, step: Array) -> ToolState:
        """Move by an increment; the axis stays a unit vector."""
        radii, shifts, bends = self._starts
        tilt = across(state.axis) @ step[3:5]
        turn = frames.exp_rotation(np.cross(state.axis, tilt))
        return ToolState(
            tip=state.tip + step[:3],
            axis=turn @ state.axis,
            latency_s=state.latency_s + float(step[5]),
            depth=state.depth + float(step[6]),
            radius=state.radius + step[radii:shifts].reshape(-1, 2),
            shift=state.shift + step[shifts:bends].reshape(-1, 3),
            bend=state.bend + step[bends:].reshape(4, 2),
        )

    def linearise(self, state: ToolState) -> tuple[Array, Array]:
        """Residual (m, 1) and Jacobian (m, 1, k)."""
        T, twist = self.path.at(self.time_s - state.latency_s)
        R = T[:, :3, :3]
        arm, axis = R @ state.tip, R @ state.axis
        tip = arm + T[:, :3, 3] + state.shift[self.step]
        touch = self.touch(tip, axis, state.bend)
        circle = self.circle >= 0
        own = np.maximum(self.circle, 0)
        radius = state.radius[own, self.beam] + self.taper * (touch.height - self.height[own])
        wanted = np.where(circle, self.side * radius, -self.laser.reach[self.beam])
        residual = touch.gap - wanted - self.way * state.depth
        taper = np.where(circle, self.side * self.taper, 0.0)[:, None]
        by_tip = touch.normal - taper * touch.height_by_tip
        by_axis = touch.by_axis - taper * touch.height_by_axis
        radii, shifts, bends = self._starts
        rows = np.arange(len(residual))
        J = np.zeros((len(residual), len(self.names)))
        J[:, :3] = np.einsum("mi,mij->mj", by_tip, R)
        J[:, 3:5] = np.einsum("mi,mij->mj", by_axis, R) @ across(state.axis)
        velocity = twist[:, :3] + np.cross(twist[:, 3:], arm)
        turning = np.cross(twist[:, 3:], axis)  # a held orientation shakes as its readings do
        J[:, 5] = -np.sum(by_tip * velocity + by_axis * turning, axis=1)
        J[:, 6] = -self.way
        J[rows, radii + 2 * own + self.beam] = np.where(circle, -self.side, 0.0)
        for i in range(3):
            J[rows, shifts + 3 * self.step + i] = by_tip[:, i]
        for end, share in ((0, 1.0 - touch.share), (1, touch.share)):
            first = bends + 4 * self.beam + 2 * end
            J[rows, first] = -share * np.sum(by_tip * self.laser.normals[self.beam], axis=1)
            J[rows, first + 1] = -share * (by_tip @ self.laser.T_base_laser[:3, 2])
        return (residual / self.sigma_m)[:, None], (J / self.sigma_m[:, None])[:, None, :]

    def touch(self, tip: Array, axis: Array, bend: Array) -> "Touch":
        """How tips and axes (m, 3), base, lie to each edge's beam."""
        laser = self.laser
        up = laser.T_base_laser[:3, 2]
        normals = np.repeat(laser.normals, 2, axis=0)
        points = laser.points + bend[:, :1] * normals + bend[:, 1:] * up
        start, end = points[2 * self.beam], points[2 * self.beam + 1]
        return touch_of(tip, axis, start, end, self.circle >= 0, self.beam)


@dataclass(frozen=True, eq=False)
class Touch:
    """How an axis and a beam lie to each other, and the derivatives by tip and axis, base.

    ``gap`` (m,) along ``normal`` (m, 3); ``height`` (m,) of the touch above the tip, and its
    derivatives; ``share`` (m,) of the way from the beam's first to its second point.
    """

    gap: Array
    normal: Array
    by_axis: Array
    height: Array
    height_by_tip: Array
    height_by_axis: Array
    share: Array


def touch_of(
    tip: Array,
    axis: Array,
    start: Array,
    end: Array,
    circle: NDArray[np.bool_],
    beam: NDArray[np.int64],
) -> Touch:
    """Geometry of axes and beams (m, 3) each, base; see `Touch`."""
    length = np.linalg.norm(end - start, axis=1)
    u = (end - start) / length[:, None]
    cosine = np.sum(u * axis, axis=1)[:, None]
    sine2 = 1.0 - cosine**2
    apart = tip - start
    along = np.sum(u * apart, axis=1)[:, None]
    # Nearest points of the two lines: tip - height axis, start + reach u.
    height = (np.sum(axis * apart, axis=1)[:, None] - cosine * along) / sine2
    reach = along - height * cosine
    height_by_tip = (axis - cosine * u) / sine2
    height_by_axis = (apart - u * along + 2.0 * height * cosine * u) / sine2
    n = np.cross(u, axis) / np.sqrt(sine2)
    n = np.where((beam == 0)[:, None], n, -n)
    w = (axis - cosine * u) / np.sqrt(sine2)
    level = np.sum(w * apart, axis=1)[:, None]
    rest = apart - w * level
    w_by_axis = (rest - u * np.sum(u * rest, axis=1)[:, None]) / np.sqrt(sine2)
    upright = circle[:, None]
    normal = np.where(upright, n, w)
    share = np.where(circle, reach[:, 0], along[:, 0]) / length
    return Touch(
        gap=np.sum(normal * apart, axis=1),
        normal=normal,
        by_axis=np.where(upright, -height * n, w_by_axis),
        height=height[:, 0],
        height_by_tip=height_by_tip,
        height_by_axis=height_by_axis,
        share=share,
    )


# ---- where the tool's axis is from one circle through two crossed beams, by time alone ----------
#
# The flange runs on a circle of radius R at constant speed in the beam plane, its orientation
# held. In the laser frame the axis is at ``c + R (cos theta, sin theta)``; its signed distance
# from beam b is ``s_b = d_b + R sin(psi_b)`` with psi_x = theta and psi_y = beta - theta, and at
# an edge it is exactly +rho_b or -rho_b. The centre is ``c = (d_y / sin beta + d_x / tan beta,
# d_x)``. Only ratios to R follow from times: R itself is the commanded one.


CircleMethod = Literal["best", "classic"]

LARGEST_MISFIT_M = 2e-4  # rms along the circle: speed not constant, or an edge that belongs not
THICKEST = 0.7  # tool's radius on the circle's
DEEPEST = 0.999  # of R: an edge where the circle hardly crosses the beam
EDGE_SCATTER_M = RobotNoise().edge_m  # of a robot that repeats well


@dataclass(frozen=True)
class CircleState:
    """Unknowns of a circle: d_x, d_y, rho_x, rho_y (m), latency and period (s)."""

    d: Array
    rho: Array
    latency_s: float
    period_s: float


@dataclass(frozen=True, eq=False)
class CircleProblem:
    """Edge times predicted minus measured, over sigma; see the module's text."""

    motion: CircleMotion
    edges: CircleEdges
    latency_free: bool = True
    period_free: bool = False
    scale_components: int = field(default=1, init=False)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        free = ("latency",) * self.latency_free + ("period",) * self.period_free
        return ("d_x", "d_y", "rho_x", "rho_y", *free)

    def deviation(self, state: CircleState) -> Array:
        """No prior."""
        return np.zeros(len(self.names))

    def retract(self, state: CircleState, step: Array) -> CircleState:
        """Add the increment."""
        rest = list(step[4:])
        latency = state.latency_s + (rest.pop(0) if self.latency_free else 0.0)
        period = state.period_s + (rest.pop(0) if self.period_free else 0.0)
        return CircleState(state.d + step[:2], state.rho + step[2:4], latency, period)

    def sine(self, state: CircleState) -> Array:
        """Of psi (m,) at each edge: the axis passes the beam at speed times the cosine."""
        e = self.edges
        w = (e.side * state.rho[e.beam] - state.d[e.beam]) / self.motion.radius_m
        return np.clip(w, -DEEPEST, DEEPEST)

    def linearise(self, state: CircleState) -> tuple[Array, Array]:
        """Residual (m, 1) and Jacobian (m, 1, k)."""
        e, R = self.edges, self.motion.radius_m
        motion = replace(self.motion, period_s=state.period_s)
        beam_rate = np.array([motion.psi_rate(b) for b in (0, 1)])[e.beam]
        w = self.sine(state)
        turn = e.rising * beam_rate  # +1: psi = asin w, -1: psi = pi - asin w
        psi = np.where(turn > 0.0, np.arcsin(w), np.pi - np.arcsin(w))
        theta = np.where(e.beam == 0, psi, motion.beam_angle_rad - psi)
        time = (theta - motion.start_rad) / motion.rate_rad_s + state.latency_s
        turns = np.round((e.time_s - time) / state.period_s)
        time = time + turns * state.period_s
        by_w = e.rising / (abs(motion.rate_rad_s) * np.sqrt(1.0 - w**2))
        J = np.zeros((len(time), 6))
        rows = np.arange(len(time))
        J[rows, e.beam] = -by_w / R
        J[rows, 2 + e.beam] = e.side * by_w / R
        J[:, 4] = 1.0
        J[:, 5] = (time - state.latency_s) / state.period_s
        used = [0, 1, 2, 3, *([4] * self.latency_free), *([5] * self.period_free)]
        whitened = J[:, used] / e.sigma_s[:, None]
        return ((time - e.time_s) / e.sigma_s)[:, None], whitened[:, None, :]


@dataclass(frozen=True, eq=False)
class CircleFit:
    """The tool's axis on one circle.

    Attributes
    ----------
    centre : (2,) place of the tool's axis in the beam plane, laser frame, when the flange is at
        the circle's centre, m.
    covariance : (2, 2) of it, m^2; None for the classic method, which has no noise model.
    d, rho : (2,) distances from the x- and the y-beam, and the tool's radius seen by each, m; the
        classic method does not see the radius (None).
    latency_s, period_s : as estimated, or as given.
    misfit_m : rms of the residuals along the circle, m.
    """

    method: CircleMethod
    centre: Array
    covariance: Array | None
    d: Array
    rho: Array | None
    latency_s: float
    latency_sigma_s: float | None
    period_s: float
    misfit_m: float
    estimate: Estimate[CircleState] | None


def fit_circle(
    motion: CircleMotion,
    edges: Sequence[BeamEdge],
    method: CircleMethod = "best",
    *,
    latency_s: float | None = None,
    period_free: bool = False,
    edge_m: float = EDGE_SCATTER_M,
) -> CircleFit:
    """Find the tool's axis from one circle at constant speed.

    ``best``: closed form from all edges, then maximum likelihood over the centre, the radii, the
    phase (latency) and, where free, the period. ``classic``: mid-times (thesis eq. 4-8, 4-9).
    ``latency_s`` fixes the latency; ``edge_m`` is the robot's scatter at an edge, m, beside which
    a misfit is judged (chi-square). The covariance is that of the stamps alone, and wider where
    they do not explain the misfit.

    Raises
    ------
    BeamError
        When edges are missing, doubled or out of order.
    ResidualError
        When no circle at constant speed explains the edges.
    """
    labelled = label_edges(motion, edges, latency_s or 0.0)
    d, rho, latency = closed_form(motion, labelled)
    if method == "classic":
        d = classic_distances(motion, labelled)
        return CircleFit(
            "classic", motion.centre(d), None, d, None, latency, None, motion.period_s, 0.0, None
        )
    if np.any(rho > THICKEST * motion.radius_m):
        raise BeamError(
            f"the shadows last for most of the turn (radius {rho.max() * 1e3:.2f} mm on a circle "
            f"of {motion.radius_m * 1e3:.2f} mm): check the input's polarity; for a tool so thick "
            "enlarge the circle"
        )
    problem = CircleProblem(motion, labelled, latency_s is None, period_free)
    start = CircleState(d, rho, latency if latency_s is None else latency_s, motion.period_s)
    found = solve(problem, start, robust=False)
    return _checked(problem, found, edge_m)


def _checked(problem: CircleProblem, found: Estimate[CircleState], edge_m: float) -> CircleFit:
    motion, edges, state = problem.motion, problem.edges, found.state
    speed = 2.0 * np.pi * motion.radius_m / state.period_s
    late = found.residual[:, 0] * edges.sigma_s
    misfit = float(speed * np.sqrt(np.mean(late**2)))
    free = len(late) - len(found.names)
    bound = chi2_quantile(SOUND_FIT, free)
    passing = speed * np.sqrt(1.0 - problem.sine(state) ** 2)
    variance = edges.sigma_s**2 + (edge_m / passing) ** 2
    unexplained = float(np.sum(late**2 / variance)) > bound
    if unexplained or misfit > LARGEST_MISFIT_M or not found.converged:
        explained = speed * float(np.sqrt(bound / len(late) * variance.mean()))
        raise ResidualError(
            f"the edges miss a circle at constant speed by {misfit * 1e3:.4f} mm rms (stamps and "
            f"the robot's scatter explain {min(explained, LARGEST_MISFIT_M) * 1e3:.4f} mm): speed "
            "not constant: record joints and give them; or else check radius, period, start, beam "
            "angle and the stamps' sigma"
        )
    J, spread = motion.centre_jacobian, found.covariance
    sigma = float(np.sqrt(spread[4, 4])) if "latency" in found.names else None
    return CircleFit(
        "best", motion.centre(state.d), J @ spread[:2, :2] @ J.T, state.d, state.rho,
        state.latency_s, sigma, state.period_s, misfit, found,
    )  # fmt: skip


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
