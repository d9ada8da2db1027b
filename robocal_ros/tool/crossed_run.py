"""A tool frame from circles and plunges through two crossed beams."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.tool.beam_edges import BEAMS, BeamEdge, BeamError, edges_of
from robocal_ros.tool.crossed_model import (
    BeamStep,
    Held,
    RobotNoise,
    RunProblem,
    ToolState,
    Touch,
    touch_of,
)
from robocal_ros.tool.flange_path import FlangePath
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.run_covariance import of_laser, tool_covariance, widened
from robocal_ros.tool.tool_axis import require_height, require_upright, retaught

Array = NDArray[np.float64]
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
