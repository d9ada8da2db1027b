"""Where the tool's axis is from one circle through two crossed beams, by time alone.

The flange runs on a circle of radius R at constant speed in the beam plane, its orientation held.
In the laser frame the axis is at ``c + R (cos theta, sin theta)``; its signed distance from beam b
is ``s_b = d_b + R sin(psi_b)`` with psi_x = theta and psi_y = beta - theta, and at an edge it is
exactly +rho_b or -rho_b. The centre is ``c = (d_y / sin beta + d_x / tan beta, d_x)``.
Only ratios to R follow from times: R itself is the commanded one.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import SOUND_FIT, chi2_quantile
from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.ground.errors import ResidualError
from robocal_ros.tool.beam_edges import BEAMS, BeamEdge, BeamError
from robocal_ros.tool.circle_edges import CircleEdges, CircleMotion, label_edges
from robocal_ros.tool.crossed_model import RobotNoise

Array = NDArray[np.float64]
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
