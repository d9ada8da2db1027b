"""A tool frame from circles and plunges through two crossed beams."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.descent import SOUND_FIT, chi2_quantile
from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.tool.crossed_model import (
    BeamStep,
    Held,
    RobotNoise,
    RunProblem,
    ToolState,
    Touch,
    across,
    fit_circle,
    touch_of,
)
from robocal_ros.tool.edges import BEAMS, BeamEdge, BeamError, CircleMotion, edges_of
from robocal_ros.tool.flange_path import (
    FlangePath,
    axis_from_centres,
    require_height,
    require_upright,
    retaught,
)
from robocal_ros.tool.laser_frame import LaserFrame

# ---- run covariance -----------------------------------------------------------------------------


Array = NDArray[np.float64]


def widened(problem: RunProblem, found: Estimate[ToolState]) -> Estimate[ToolState]:
    """With a covariance for shifts, or what was held, that are larger than their sigmas explain.

    For edges that are, `solve` has widened it: here they count with the scatter that it found.
    """
    away = problem.deviation(found.state)
    misfit = float(np.sum((found.residual / found.scale) ** 2) + away @ problem.prior @ away)
    free = len(found.residual) - problem.undetermined
    if free <= 0 or misfit <= chi2_quantile(SOUND_FIT, free):
        return found
    return replace(found, covariance=misfit / free * found.covariance)


def of_laser(problem: RunProblem, found: Estimate[ToolState]) -> Array:
    """Part of the covariance C that the errors of the laser's points make: C P C, P their prior."""
    points = [i for i, name in enumerate(found.names) if name.startswith("laser_")]
    by_point = found.covariance[:, points]
    return np.asarray(by_point @ problem.prior[np.ix_(points, points)] @ by_point.T)


def tool_covariance(covariance: Array, axis: Array, R_flange_tool: Array) -> Array:
    """(5, 5) of the tip and of the tilts along the tool's x and y."""
    turn = np.eye(5)
    turn[3:, 3:] = R_flange_tool[:, :2].T @ across(axis)
    return np.asarray(turn @ covariance[:5, :5] @ turn.T)


# ---- a tool frame from circles and plunges through two crossed beams ----------------------------


Row = tuple[int, int, int, BeamEdge]

FEWEST_EDGES = {"circle": 4, "plunge": 2}  # of each beam
MOST_SIGMAS = 6.0  # of a step's shift
DEFAULT_NOISE = RobotNoise()
FREE = Held()
LARGEST_MISFIT_M = 2e-4  # rms of the edges: more is no robot's repeatability


@dataclass(frozen=True, eq=False)
class ToolEstimate:
    """A measured tool.

    Attributes
    ----------
    T_flange_tool : (4, 4) z along the axis from flange to tip, turned about it as it was taught.
    covariance : (5, 5) of the tip (flange axes, m^2) and of the axis' direction along the tool's
        own x and y (rad^2); ``own_covariance`` (5, 5) its part that is this run's alone, without
        the laser frame's, which all runs at a station have in common.
    latency_s, latency_sigma_s : of the edges behind the robot's readings.
    radius : (circles, 2) of the tool as each circle and beam sees it, m.
    misfit_m : rms of the edges' residuals, m.
    shift_m : largest shift of a step against the others, m.
    estimate : with the covariance that all sigmas here are of: wider where the noise that was told
        does not explain edges, shifts or what was held.
    """

    T_flange_tool: Array
    covariance: Array
    own_covariance: Array
    latency_s: float
    latency_sigma_s: float
    radius: Array
    misfit_m: float
    shift_m: float
    estimate: Estimate[ToolState]

    @property
    def tip(self) -> Array:
        """(3,) in the flange frame, m."""
        return np.asarray(self.T_flange_tool[:3, 3])

    @property
    def axis(self) -> Array:
        """(3,) unit vector from flange to tip, flange frame."""
        return np.asarray(self.T_flange_tool[:3, 2])


def estimate_tool(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    T_flange_tool: Array,
    *,
    noise: RobotNoise = DEFAULT_NOISE,
    taper: float = 0.0,
    held: Held = FREE,
) -> ToolEstimate:
    """Find tip and axis from the edges of all steps together, by maximum likelihood.

    The flange pose is that of the path at each edge, so that the speed need not be constant and
    the laser's axes need not be the base's.

    Parameters
    ----------
    T_flange_tool : (4, 4) the taught tool: where the search begins, and the turn about the axis.
    taper : growth of the radius per length above the tip; only matters while the tool is tilted.
    held : what the steps need not determine, with its sigma about the taught tool.

    Raises
    ------
    BeamError
        When edges are missing, doubled or out of order.
    RankDeficientError
        When a motion is missing; the message names it.
    ResidualError
        When no tool explains the edges.
    """
    _require_steps(steps, held)
    problem, start = run_problem(laser, path, steps, T_flange_tool, noise, taper, held)
    _require_motion(problem, start)
    solved = solve(problem, start, prior_information=problem.prior, robust=False)
    _require_fit(problem, steps, solved)
    found, state = widened(problem, solved), solved.state
    own = found.covariance - of_laser(problem, solved)
    R = retaught(T_flange_tool[:3, :3], state.axis)
    return ToolEstimate(
        T_flange_tool=frames.transform(R, state.tip),
        covariance=tool_covariance(found.covariance, state.axis, R),
        own_covariance=tool_covariance(own, state.axis, R),
        latency_s=state.latency_s,
        latency_sigma_s=float(np.sqrt(found.covariance[5, 5])),
        radius=state.radius,
        misfit_m=_misfit(problem, found),
        shift_m=float(np.linalg.norm(state.shift, axis=1).max()),
        estimate=found,
    )


def run_problem(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    T_flange_tool: Array,
    noise: RobotNoise,
    taper: float = 0.0,
    held: Held = FREE,
) -> tuple[RunProblem, ToolState]:
    """The problem of a run and the state at which to begin; raises BeamError as `estimate_tool`."""
    rows = _rows(steps)
    beam, step, circle = (np.array([row[k] for row in rows]) for k in range(3))
    edges = [row[3] for row in rows]
    time = np.array([edge.time_s for edge in edges])
    breaks = np.array([edge.blocked for edge in edges])
    circles = int(circle.max(initial=-1)) + 1
    start = ToolState.taught(T_flange_tool, circles, len(steps))
    touch, rate = _approach(laser, path, start, time, beam, circle)
    _require_order(steps, rows, rate)
    sigma_s = np.array([edge.sigma_s for edge in edges])
    problem = RunProblem(
        laser=laser,
        path=path,
        beam=beam,
        step=step,
        circle=circle,
        side=np.where(breaks, -np.sign(rate), np.sign(rate)),
        way=np.sign(rate),
        time_s=time,
        sigma_m=np.hypot(rate * sigma_s, noise.edge_m),
        circles=circles,
        steps=len(steps),
        taper=taper,
        height=np.array([touch.height[circle == c].mean() for c in range(circles)]),
        taught=start,
        noise=noise,
        held=held,
    )
    return problem, start


def _approach(
    laser: LaserFrame,
    path: FlangePath,
    start: ToolState,
    time: Array,
    beam: NDArray[np.int64],
    circle: NDArray[np.int64],
) -> tuple[Touch, Array]:
    """How the taught tool lies to each edge's beam, and its speed (m,) towards it, m/s."""
    T, twist = path.at(time)
    tip, axis = T[:, :3, :3] @ start.tip + T[:, :3, 3], T[:, :3, :3] @ start.axis
    ends = laser.points[2 * beam], laser.points[2 * beam + 1]
    touch = touch_of(tip, axis, *ends, circle >= 0, beam)
    return touch, np.sum(touch.normal * twist[:, :3], axis=1)


def _rows(steps: Sequence[BeamStep]) -> list[Row]:
    """Beam, step, circle (-1 in a plunge) and edge, one by one."""
    rows: list[Row] = []
    circles = 0
    for i, step in enumerate(steps):
        own = circles if step.kind == "circle" else -1
        circles += step.kind == "circle"
        for b, beam in enumerate(BEAMS):
            try:
                found = edges_of(step.edges, beam, FEWEST_EDGES[step.kind])
            except BeamError as error:
                raise BeamError(f"{step.name}: {error}") from error
            rows += [(b, i, own, edge) for edge in found]
    return rows


def _require_order(steps: Sequence[BeamStep], rows: Sequence[Row], rate: Array) -> None:
    """Refuse arcs that do not alternate, and a plunge that breaks on its way up."""
    for (b, i, circle, edge), speed in zip(rows, rate, strict=True):
        if circle < 0 and edge.blocked != (speed > 0.0):
            way = "up" if edge.blocked else "down"
            raise BeamError(
                f"{steps[i].name}: beam {BEAMS[b]} was {'broken' if edge.blocked else 'restored'} "
                f"at {edge.time_s:.4f} s while the tool moved {way}: begin above the beams, with "
                "both of them clear"
            )
    for i, step in enumerate(steps):
        for b, beam in enumerate(BEAMS):
            own = [k for k, row in enumerate(rows) if row[:2] == (b, i)]
            turned = np.sign(rate[own])
            passes = np.cumsum([rows[k][3].blocked for k in own])
            wanted = turned[0] * (-1.0) ** (passes - passes[0])
            if step.kind == "circle" and np.any(turned != wanted):
                raise BeamError(
                    f"{step.name}: the shadows on beam {beam} do not alternate between the two "
                    "ways across it: edges were lost, or the robot was moved by hand; repeat it"
                )


def _require_steps(steps: Sequence[BeamStep], held: Held) -> None:
    kinds = {step.kind for step in steps}
    if "circle" not in kinds:
        raise RankDeficientError(
            "there is no circle: the place of the tool across the beams is not determined",
            ("place across the beams",),
        )
    if "plunge" not in kinds and held.along_m is None:
        raise RankDeficientError(
            "there is no plunge: how far the tip reaches is not determined; move the axis onto the "
            "crossing and drive it down and up",
            ("place along the axis",),
        )


def _require_motion(problem: RunProblem, start: ToolState) -> None:
    """Refuse circles at one height, and an axis nearly in the beam plane."""
    laser = problem.laser
    T, _ = problem.path.at(problem.time_s)
    v = T[:, :3, :3] @ start.axis
    require_upright(float(np.min(np.abs(v @ laser.T_base_laser[:3, 2]))))
    if problem.held.tilt_rad is None:
        require_height(float(np.ptp(problem.height)))


def _misfit(problem: RunProblem, found: Estimate[ToolState]) -> float:
    return float(np.sqrt(np.mean((found.residual[:, 0] * problem.sigma_m) ** 2)))


def _require_fit(
    problem: RunProblem, steps: Sequence[BeamStep], found: Estimate[ToolState]
) -> None:
    """Refuse edges that miss any tool, and a step that lies apart from the others."""
    misfit = _misfit(problem, found)
    if not found.converged:
        raise ResidualError(
            f"no tool is found: the search still moves with the edges {misfit * 1e3:.3f} mm rms "
            "apart; check the robot's model, the laser frame and the taught tool"
        )
    if misfit > LARGEST_MISFIT_M:
        raise ResidualError(
            f"the edges miss any one tool by {misfit * 1e3:.3f} mm rms (allowed "
            f"{LARGEST_MISFIT_M * 1e3:.1f} mm): check robot, laser frame and joint readings"
        )
    shift = np.linalg.norm(found.state.shift, axis=1)
    worst = int(np.argmax(shift))
    limit = max(LARGEST_MISFIT_M, MOST_SIGMAS * problem.noise.step_m)
    if shift[worst] > limit:
        raise ResidualError(
            f"{steps[worst].name}: {shift[worst] * 1e3:.3f} mm apart from the other steps (allowed "
            f"{limit * 1e3:.3f} mm): was the robot moved by hand in between, the tool touched, or "
            "the laser frame made at another station?"
        )


# ---- run traits ---------------------------------------------------------------------------------
#
# joint readings came. No bend changes these; what differs from the healthy tool's run is a fault.


ONE_SIDED = 1.645  # sigmas: what is at a limit looks larger by so much in 5 % of cases
AS_LOW = "circle"  # of a quick check: as high above the tip as the circle `low` of a whole run
LOW = "low"


class WrongToolError(RobocalError):
    """Another tool than the healthy one that was measured."""

    code = Code.WRONG_TOOL


class ClockError(RobocalError):
    """Edges and joint readings are not stamped on one clock, or the input's delay has changed."""

    code = Code.CLOCK_WRONG


@dataclass(frozen=True)
class TraitLimits:
    """Changes against the healthy tool's run that are no fault yet; 0: any.

    Attributes
    ----------
    radius_m : of the tool as a beam sees it.
    latency_s : of the edges behind the joint readings.
    lost : share of the joint readings.
    """

    radius_m: float = 5e-5
    latency_s: float = 5e-3
    lost: float = 0.05


@dataclass(frozen=True)
class RunTraits:
    """Traits of a run.

    Attributes
    ----------
    radius_m : by circle, of the tool as the x- and the y-beam see it; ``radius_sigma_m`` of each.
    latency_s, latency_sigma_s : of the edges behind the joint readings.
    rate_hz : of the joint readings.
    """

    radius_m: Mapping[str, tuple[float, float]]
    radius_sigma_m: float
    latency_s: float
    latency_sigma_s: float
    rate_hz: float

    @classmethod
    def of(cls, estimate: ToolEstimate, circles: Sequence[str], rate_hz: float) -> "RunTraits":
        """Of a measured tool; ``circles``: names in the order of its radii."""
        found = estimate.estimate
        own = np.array([name.startswith("radius_") for name in found.names])
        variance = np.diag(found.covariance)[own]
        radii = zip(circles, estimate.radius.tolist(), strict=True)
        return cls(
            {name: (x, y) for name, (x, y) in radii},
            float(np.sqrt(np.max(variance))),
            estimate.latency_s,
            estimate.latency_sigma_s,
            rate_hz,
        )

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "RunTraits":
        """Read what `document` gave, also after JSON."""
        radius = {name: (x, y) for name, (x, y) in document["radius_m"].items()}
        return cls(**(dict(document) | {"radius_m": radius}))

    def require_readings(self, count: int, span_s: float, limits: TraitLimits) -> None:
        """Refuse ``count`` readings over a time where this run would have had clearly more.

        Raises
        ------
        TooFewSamplesError
            When messages are lost.
        """
        expected = self.rate_hz * span_s
        lost = 1.0 - count / expected if expected > 0.0 else 0.0
        sigma = np.sqrt(max(lost * (1.0 - lost), 0.0) / max(expected, 1.0))
        if _beyond(max(lost, 0.0), float(sigma), limits.lost):
            raise TooFewSamplesError(
                f"{lost:.0%} of the joint readings are missing: {count} in {span_s:.1f} s, the "
                f"healthy tool was measured with {self.rate_hz:.0f} in a second; edges are lost "
                "with them: look at network and load, or measure the healthy tool at this rate"
            )

    def require_like(self, healthy: "RunTraits", limits: TraitLimits) -> None:
        """Refuse a run that differs from the healthy tool's in what no bend changes.

        Raises
        ------
        ClockError
            When the edges are later or earlier than they were.
        BeamError
            When one beam alone sees the tool grown or shrunk.
        WrongToolError
            When both do.
        """
        self._require_clock(healthy, limits)
        change = self._grown(healthy)
        if change is None:
            return
        sigma = float(np.hypot(self.radius_sigma_m, healthy.radius_sigma_m))
        apart, both = float(change[0] - change[1]), float(np.mean(change))
        x, y = (f"{1e3 * part:+.3f}" for part in change)
        words = f"against the healthy tool its radius is {x} mm in beam x and {y} mm in beam y"
        if _beyond(apart, np.sqrt(2.0) * sigma, limits.radius_m):
            worse = BEAMS[int(np.argmax(np.abs(change)))]
            raise BeamError(
                f"{words}: a tool changes for both, so beam {worse} is dirty or out of line; clean "
                "and align it, then measure the healthy tool anew"
            )
        if _beyond(both, np.sqrt(0.5) * sigma, limits.radius_m):
            raise WrongToolError(
                f"{words}: another tool is mounted, this one is worn or fouled, or both beams are "
                "dirty; mount the right one, or measure it in mode REFERENCE"
            )

    def _require_clock(self, healthy: "RunTraits", limits: TraitLimits) -> None:
        later = self.latency_s - healthy.latency_s
        sigma = float(np.hypot(self.latency_sigma_s, healthy.latency_sigma_s))
        if _beyond(later, sigma, limits.latency_s):
            raise ClockError(
                f"the edges are {1e3 * self.latency_s:.1f} ms behind the joint readings, with the "
                f"healthy tool it were {1e3 * healthy.latency_s:.1f} ms: a clock has jumped, or "
                "the input is delayed; put both on one clock, or measure the healthy tool anew"
            )

    def _grown(self, healthy: "RunTraits") -> Array | None:
        """Growth (2,) of the radius in each beam, m; None where no circle is common."""
        pairs = [
            (radii, healthy.radius_m[LOW if name == AS_LOW else name])
            for name, radii in self.radius_m.items()
            if (LOW if name == AS_LOW else name) in healthy.radius_m
        ]
        if not pairs:
            return None
        return np.asarray(np.mean([np.subtract(now, then) for now, then in pairs], axis=0))


def require_even(rates_hz: Sequence[float], limits: TraitLimits) -> None:
    """Refuse a healthy tool's run whose steps (k,) had joint readings at unlike rates.

    Measured under loss it would hide what is lost later. A loss that is alike in all steps does
    not show.

    Raises
    ------
    TooFewSamplesError
        When the slowest and the fastest step differ by more than the limit.
    """
    slowest, fastest = min(rates_hz), max(rates_hz)
    if _beyond(1.0 - slowest / fastest, 0.0, limits.lost):
        raise TooFewSamplesError(
            f"joint readings came at {slowest:.0f} to {fastest:.0f} in a second: some were lost, "
            "and a healthy tool measured so would hide later loss; look at network and load, then "
            "measure it again"
        )


def _beyond(change: float, sigma: float, limit: float) -> bool:
    """Whether a change is larger than the limit in all but 5 % of cases; not a number is."""
    return limit > 0.0 and not abs(change) - ONE_SIDED * sigma <= limit


# ---- classic run --------------------------------------------------------------------------------


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
    R = retaught(T_flange_tool[:3, :3], v)
    return frames.transform(R, tip)
