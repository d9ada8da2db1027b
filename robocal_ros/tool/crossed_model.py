# SPDX-License-Identifier: Apache-2.0
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

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import SOUND_FIT, Estimate, chi2_quantile, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.ground.frames import Array
from robocal_ros.tool.edges import (
    BEAMS,
    FEWEST_EDGES,
    Beam,
    BeamEdge,
    BeamError,
    StepKind,
    edges_of,
)
from robocal_ros.tool.laser_frame import (
    FlangePath,
    LaserFrame,
    minimal_rotation,
    require_height,
    require_upright,
    retaught,
)

Row = tuple[int, int, int, BeamEdge]  # beam, step, circle (-1 in a plunge) and edge

TOOL_NAMES = ("tip_x", "tip_y", "tip_z", "tilt_x", "tilt_y")
START_RADIUS_M = 2e-3
HYSTERESIS_M = 2e-4  # sigma of a receiver's: light of a beam of half a millimetre
EXACT_M = 1e-9  # prior of what is taken as exact, against edges of micrometres


@dataclass(frozen=True)
class RobotNoise:
    """How well the robot repeats, m, one standard deviation of each axis.

    ``step_m``: common to a circle or a plunge. ``edge_m``: further at each edge.
    """

    step_m: float = 3e-5
    edge_m: float = 1e-5


@dataclass(frozen=True)
class BeamStep:
    """A circle or a plunge and its edges."""

    name: str
    kind: StepKind
    edges: Sequence[BeamEdge]
    beams: Sequence[Beam] = BEAMS  # those that are broken


@dataclass(frozen=True, eq=False)
class ToolState:
    """Unknowns of a run.

    ``tip`` (3,): in the flange frame, m; ``axis`` (3,) unit vector from flange to tip there.
    ``latency_s``: of the edges behind the robot's readings. ``depth``: of an edge behind the mean
    of break and restore, m: the receiver's hysteresis. ``radius`` (circles, 2): of the tool as each
    circle and beam sees it, m. ``shift`` (steps, 3): of the flange in each step, base, m. ``bend``
    (4, 2): of the laser's points A ... D, horizontally across the beam and upwards, m.
    """

    tip: Array
    axis: Array
    latency_s: float
    depth: float
    radius: Array
    shift: Array
    bend: Array


def across(axis: Array) -> Array:
    """(3, 2) the two directions in which an axis can tilt: columns across it, near x and y."""
    return minimal_rotation([0.0, 0.0, 1.0], axis)[:, :2]


@dataclass(frozen=True)
class Held:
    """What a run need not determine: how far it may be from the taught tool (sigma); None: free.

    ``tilt_rad`` of the axis, each way; ``along_m`` of the tip along the axis, ``across_m`` each way
    across it.
    """

    tilt_rad: float | None = None
    along_m: float | None = None
    across_m: float | None = None


@dataclass(frozen=True, eq=False)
class RunProblem:
    """Residuals of all edges; built by `run_problem`.

    ``taper``: growth of the tool's radius per length above the tip; ``height`` (circles,): of each
    circle above the tip, where its radius counts. ``may_turn``: both beams together about the z of
    the laser, which then counts no more in the prior of its points.
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
    may_turn: bool = False
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
        held += 2 * (self.held.across_m is not None)
        return 6 + 2 * self.circles - held + self.may_turn

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
        if self.held.across_m is not None:
            sides = across(self.taught.axis)
            information[:3, :3] += sides @ sides.T / self.held.across_m**2
        if self.may_turn:
            told = information @ self.turn
            information -= np.outer(told, told) / (self.turn @ told)
        return information

    @property
    def turn(self) -> Array:
        """(k,) how the unknowns change with a turn of the beams, per rad."""
        T, normals = self.laser.T_base_laser, np.repeat(self.laser.normals, 2, axis=0)
        across_m = np.sum(np.cross(T[:3, 2], self.laser.points - T[:3, 3]) * normals, axis=1)
        way = np.zeros(len(self.names))
        way[self._starts[2] :: 2] = across_m
        return way

    def misfit(self, found: Estimate[ToolState], scale: float = 1.0) -> float:
        """Square of what edges (in units of their sigmas times ``scale``) and prior disagree in."""
        away = self.deviation(found.state)
        return float(np.sum((found.residual / scale) ** 2) + away @ self.prior @ away)

    def edges_rms_m(self, found: Estimate[ToolState]) -> float:
        """Of the edges' residuals, m."""
        return float(np.sqrt(np.mean((found.residual[:, 0] * self.sigma_m) ** 2)))

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
        normals, up = self.laser.normals, self.laser.T_base_laser[:3, 2]
        points = self.laser.points + state.bend[:, :1] * np.repeat(normals, 2, axis=0)
        points = points + state.bend[:, 1:] * up
        circle = self.circle >= 0
        ends = points[2 * self.beam], points[2 * self.beam + 1]
        touch = touch_of(tip, axis, *ends, circle, self.beam)
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
            J[rows, first] = -share * np.sum(by_tip * normals[self.beam], axis=1)
            J[rows, first + 1] = -share * (by_tip @ up)
        return (residual / self.sigma_m)[:, None], (J / self.sigma_m[:, None])[:, None, :]


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


MOST_SIGMAS = 6.0  # of a step's shift
TURNED_SIGMAS = 3.29  # of beams that have not turned one in a thousand seems to have
MOST_TURNED_RAD = 0.05  # by a knock; what is further off is another station's frame
LARGEST_MISFIT_M = 2e-4  # rms of the edges: more is no robot's repeatability


@dataclass(frozen=True, eq=False)
class ToolEstimate:
    """A measured tool.

    ``T_flange_tool`` (4, 4): z along the axis from flange to tip, turned about it as it was taught.
    ``covariance`` (5, 5): of the tip (flange axes, m^2) and of the axis' direction along the tool's
    own x and y (rad^2); ``own_covariance`` (5, 5) its part that is this run's alone, without the
    laser frame's, which all runs at a station have in common. ``latency_s``, ``latency_sigma_s``:
    of the edges behind the robot's readings. ``radius`` (circles, 2): of the tool as each circle
    and beam sees it, m. ``misfit_m``: rms of the edges' residuals, m. ``shift_m``: largest shift of
    a step against the others, m. ``turn_rad``, ``turn_sigma_rad``: of both beams about the laser's
    z since they were placed; None of a run with something held. Taken out where the edges are not
    explained without. ``estimate``: with the covariance that all sigmas here are of: wider where
    the given noise does not explain edges, shifts or what was held. ``edge_m``, ``edge_step`` (e,):
    residual of each edge, m, and the place of its step among the steps.
    """

    T_flange_tool: Array
    covariance: Array
    own_covariance: Array
    latency_s: float
    latency_sigma_s: float
    radius: Array
    misfit_m: float
    shift_m: float
    turn_rad: float | None
    turn_sigma_rad: float
    estimate: Estimate[ToolState]
    edge_m: Array
    edge_step: NDArray[np.int64]

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
    noise: RobotNoise | None = None,
    taper: float = 0.0,
    held: Held | None = None,
) -> ToolEstimate:
    """Find tip and axis from the edges of all steps together, by maximum likelihood.

    The flange pose is that of the path at each edge, so that the speed need not be constant and
    the laser's axes need not be the base's.

    Raises `BeamError` when edges are missing, doubled or out of order; `RankDeficientError` when a
    motion is missing; the message names it; `ResidualError` when no tool explains the edges.

    ``T_flange_tool`` (4, 4): the taught tool: where the search begins, and the turn about the axis.
    ``taper``: growth of the radius per length above the tip; only matters while the tool is tilted.
    ``held``: what the steps need not determine, with its sigma about the taught tool.
    """
    noise, held = noise or RobotNoise(), held or Held()
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
    problem, start = run_problem(laser, path, steps, T_flange_tool, noise, taper, held)
    T, _ = path.at(problem.time_s)
    axes = T[:, :3, :3] @ start.axis
    require_upright(float(np.min(np.abs(axes @ laser.T_base_laser[:3, 2]))))
    if held.tilt_rad is None:
        require_height(float(np.ptp(problem.height)))
    solved = solve(problem, start, prior_information=problem.prior, robust=False)
    turn_rad, turn_sigma_rad = None, 0.0
    if held == Held():  # one circle alone does not tell a turn from a latency
        problem, solved, turn_rad, turn_sigma_rad = _turned(problem, start, solved)
    misfit = problem.edges_rms_m(solved)
    _require_fit(solved, misfit, steps, noise)
    found, state = _widened(problem, solved), solved.state
    R = retaught(T_flange_tool[:3, :3], state.axis)
    # From tilts across the axis to those along the tool's x and y.
    turn = np.eye(5)
    turn[3:, 3:] = R[:, :2].T @ across(state.axis)
    # What the laser's points make of the covariance C is C P C, with P their prior.
    points = [i for i, name in enumerate(solved.names) if name.startswith("laser_")]
    by_point = solved.covariance[:, points]
    own = found.covariance - by_point @ problem.prior[np.ix_(points, points)] @ by_point.T
    return ToolEstimate(
        T_flange_tool=frames.transform(R, state.tip),
        covariance=turn @ found.covariance[:5, :5] @ turn.T,
        own_covariance=turn @ own[:5, :5] @ turn.T,
        latency_s=state.latency_s,
        latency_sigma_s=float(np.sqrt(found.covariance[5, 5])),
        radius=state.radius,
        misfit_m=misfit,
        shift_m=float(np.linalg.norm(state.shift, axis=1).max()),
        turn_rad=turn_rad,
        turn_sigma_rad=turn_sigma_rad,
        estimate=found,
        edge_m=solved.residual[:, 0] * problem.sigma_m,
        edge_step=problem.step,
    )


def run_problem(
    laser: LaserFrame,
    path: FlangePath,
    steps: Sequence[BeamStep],
    T_flange_tool: Array,
    noise: RobotNoise,
    taper: float = 0.0,
    held: Held | None = None,
) -> tuple[RunProblem, ToolState]:
    """The problem of a run and the state at which to begin; raises BeamError as `estimate_tool`."""
    rows, circles = _edge_rows(steps)
    beam, step, circle = (np.array([row[k] for row in rows]) for k in range(3))
    time = np.array([edge.time_s for *_, edge in rows])
    breaks = np.array([edge.blocked for *_, edge in rows])
    sigma_s = np.array([edge.sigma_s for *_, edge in rows])
    start = ToolState(
        tip=T_flange_tool[:3, 3],
        axis=T_flange_tool[:3, 2],
        latency_s=0.0,
        depth=0.0,
        radius=np.full((circles, 2), START_RADIUS_M),
        shift=np.zeros((len(steps), 3)),
        bend=np.zeros((4, 2)),
    )
    # How the taught tool lies to each edge's beam, and its speed (m,) towards it, m/s.
    T, twist = path.at(time)
    tip, axis = T[:, :3, :3] @ start.tip + T[:, :3, 3], T[:, :3, :3] @ start.axis
    ends = laser.points[2 * beam], laser.points[2 * beam + 1]
    touch = touch_of(tip, axis, *ends, circle >= 0, beam)
    rate = np.sum(touch.normal * twist[:, :3], axis=1)
    _require_order(steps, rows, rate)
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
        held=held or Held(),
    )
    return problem, start


def _edge_rows(steps: Sequence[BeamStep]) -> tuple[list[Row], int]:
    """Edges of all steps, beam by beam, and how many circles there are."""
    rows: list[Row] = []
    circles = 0
    for i, each in enumerate(steps):
        own = circles if each.kind == "circle" else -1
        circles += each.kind == "circle"
        for b, name in enumerate(BEAMS):
            if name not in each.beams:
                if any(edge.beam == name for edge in each.edges):
                    raise BeamError(
                        f"{each.name}: beam {name} was broken too, where only "
                        f"{', '.join(each.beams)} is: it is moved by millimetres, or thicker than "
                        "the circle's radius leaves room for"
                    )
                continue
            try:
                found = edges_of(each.edges, name, FEWEST_EDGES[each.kind])
            except BeamError as error:
                raise BeamError(f"{each.name}: {error}") from error
            rows += [(b, i, own, edge) for edge in found]
    return rows, circles


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
        for b, beam in enumerate(BEAMS if step.kind == "circle" else ()):
            own = [k for k, row in enumerate(rows) if row[:2] == (b, i)]
            turned = np.sign(rate[own])
            passes = np.cumsum([rows[k][3].blocked for k in own])
            wanted = turned[0] * (-1.0) ** (passes - passes[0])
            if np.any(turned != wanted):
                raise BeamError(
                    f"{step.name}: the shadows on beam {beam} do not alternate between the two "
                    "ways across it: edges were lost, or the robot was moved by hand; repeat it"
                )


def _require_fit(
    found: Estimate[ToolState], misfit: float, steps: Sequence[BeamStep], noise: RobotNoise
) -> None:
    """Refuse edges that miss any tool, and a step that lies apart from the others."""
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
    limit = max(LARGEST_MISFIT_M, MOST_SIGMAS * noise.step_m)
    if shift[worst] > limit:
        raise ResidualError(
            f"{steps[worst].name}: {shift[worst] * 1e3:.3f} mm apart from the other steps (allowed "
            f"{limit * 1e3:.3f} mm): was the robot moved by hand in between, the tool touched, or "
            "the laser frame made at another station?"
        )


def _turned(
    problem: RunProblem, start: ToolState, solved: Estimate[ToolState]
) -> tuple[RunProblem, Estimate[ToolState], float | None, float]:
    """The beams' turn, its sigma, and the solution with it where that explains most of the rest."""
    turned = replace(problem, may_turn=True)
    again = solve(turned, start, prior_information=turned.prior, robust=False)
    if not again.converged:
        return problem, solved, None, 0.0
    way = turned.turn / (turned.turn @ turned.turn)
    turn_rad = float(way @ turned.deviation(again.state))
    sigma_rad = float(np.sqrt(way @ again.covariance @ way))
    misfit = problem.misfit(solved)
    explains = turned.misfit(again) < 0.5 * misfit
    told = TURNED_SIGMAS * sigma_rad < abs(turn_rad) < MOST_TURNED_RAD
    if told and explains and misfit > _most_misfit(problem, solved):
        problem, solved = turned, again
    return problem, solved, turn_rad, sigma_rad


def _widened(problem: RunProblem, found: Estimate[ToolState]) -> Estimate[ToolState]:
    """With a covariance for shifts, or what was held, that are larger than their sigmas explain.

    For edges that are, `solve` has widened it: here they count with the scatter that it found.
    """
    misfit, free = problem.misfit(found, found.scale), len(found.residual) - problem.undetermined
    if misfit <= _most_misfit(problem, found):
        return found
    return replace(found, covariance=misfit / free * found.covariance)


def _most_misfit(problem: RunProblem, found: Estimate[ToolState]) -> float:
    """Beyond which it says that given sigmas are too small."""
    free = len(found.residual) - problem.undetermined
    return chi2_quantile(SOUND_FIT, free) if free > 0 else np.inf
