# SPDX-License-Identifier: Apache-2.0
"""A tool frame from touches of one point (four or more) and two straight moves (seven).

methods: flange z down and y_e along y_b; the tool sweeps along x_b through both beams: mid-places
x_up, x_down. Turned by 90 deg, so that x_e lies along y_b: x'_up, x'_down. The axis, flange to tip,
in the flange frame is ``(-(x_up - x_down), x'_up - x'_down, h_up - h_down)`` (thesis eq. 4-6).

A tool by two parallel beams may also be recorded by the node while the robot's program sweeps
through them: `SweepLog` takes each of the sweeps of `fit_parallel`, in its order, once it is over.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.estimation.estimation import Estimate, Problem, observability, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import JOINTS, JointStream, StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.crossed_model import RobotNoise, across
from robocal_ros.tool.edges import (
    PARALLEL,
    BeamEdge,
    BeamError,
    EdgeLog,
    EdgeSample,
    ParallelStation,
    debounced,
)
from robocal_ros.tool.judging import KnownTool, change_between
from robocal_ros.tool.laser_frame import JointPath, minimal_rotation, retaught
from robocal_ros.tool.run import AFTER_NS, BEFORE_NS, ToolConfig

FEWEST_TOUCHES = 4
SHORTEST_MOVE_M = 1e-2
LARGEST_RESIDUAL_M = 1e-3  # rms: the methods' class is 0.5 mm
SMALLEST_ANGLE_RAD = float(np.radians(45.0))
NAMES = ("tip_x", "tip_y", "tip_z", "point_x", "point_y", "point_z")
LEAST_SPREAD = 0.05  # smallest over largest singular value: orientations too much alike


@dataclass(frozen=True)
class _TouchProblem:
    """``R_i tip + t_i - point = 0`` over the tip in the flange and the point in base."""

    T: Array
    sigma_m: float
    names: tuple[str, ...] = NAMES
    scale_components: int = 3

    def deviation(self, state: Array) -> Array:
        return np.zeros(6)

    def retract(self, state: Array, step: Array) -> Array:
        return np.asarray(state + step)

    def linearise(self, state: Array) -> tuple[Array, Array]:
        R = self.T[:, :3, :3]
        J = np.concatenate([R, -np.broadcast_to(np.eye(3), R.shape)], axis=2)
        residual = R @ state[:3] + self.T[:, :3, 3] - state[3:]
        return residual / self.sigma_m, J / self.sigma_m


@dataclass(frozen=True, eq=False)
class TouchFit:
    """A touched tool.

    ``tip`` (3,): flange frame, m; ``covariance`` (3, 3), m^2. ``point`` (3,): the touched point,
    base, m. ``rotation``: R_flange_tool (3, 3) of seven points; None of four. ``residual`` (m, 3):
    of the touches, base, m.
    """

    tip: Array
    covariance: Array
    point: Array
    rotation: Array | None
    residual: Array
    estimate: Estimate[Array]

    @property
    def rms_m(self) -> float:
        """Rms distance of the touches from their point."""
        return float(np.sqrt(np.mean(np.sum(self.residual**2, axis=1))))

    @property
    def verdict(self) -> Verdict:
        """Whether the touches agree."""
        largest = float(np.max(np.linalg.norm(self.residual, axis=1)))
        words = f"touches within {self.rms_m * 1e3:.3f} mm rms, {largest * 1e3:.3f} mm at most"
        if self.rms_m > LARGEST_RESIDUAL_M:
            return Verdict(
                Code.RESIDUAL_TOO_LARGE,
                f"{words} (allowed {LARGEST_RESIDUAL_M * 1e3:.1f} mm rms): touch again, and check "
                "units and the Euler convention of the poses",
            )
        return Verdict(Code.ACCEPT, words)


def fit_four(T_base_flange: Array, sigma_m: float | None = None) -> TouchFit:
    """Tip from poses (m >= 4, 4, 4) that all touch one point: least squares over all touches.

    ``sigma_m`` of one touch; None where it is to be estimated from the residuals.

    Raises `TooFewSamplesError`: fewer than four touches; `RankDeficientError` when the flange was
    turned about one axis only (rank 5 of 6), or hardly at all.
    """
    count = len(T_base_flange)
    if count < FEWEST_TOUCHES:
        raise TooFewSamplesError(f"{count} touches: at least {FEWEST_TOUCHES} are needed")
    problem: Problem[Array] = _TouchProblem(T_base_flange, sigma_m or 1.0)
    rows = problem.linearise(np.zeros(6))[1].reshape(-1, 6)
    seen = observability(rows)
    if seen.rank < 6 or 1.0 / seen.condition < LEAST_SPREAD:
        raise RankDeficientError(
            f"the touches determine {seen.rank} of 6 unknowns well (condition "
            f"{seen.condition:.3g}): turn the flange about a second axis, by 30 deg or more",
            ("tip along the axis of rotation",),
        )
    right = -problem.linearise(np.zeros(6))[0].ravel()
    start: Array = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    found = solve(
        problem, start, noise_known=sigma_m is not None, robust=count > FEWEST_TOUCHES + 2
    )
    R, t = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3]
    tip, point = found.state[:3], found.state[3:]
    return TouchFit(tip, found.covariance[:3, :3], point, None, R @ tip + t - point, found)


def fit_seven(T_base_flange: Array, sigma_m: float | None = None) -> TouchFit:
    """Tip from the first poses, orientation from the last three (m >= 7, 4, 4).

    At the last three the tool is aligned with the base and moves without turning: from P5 to P6
    along its x, from P6 to P7 along its z. With both in base, y = z x x, orthonormalised, and
    ``R_flange_tool = R_base_flange^T [x y z]``.

    Raises `TooFewSamplesError` or `RankDeficientError` as `fit_four`; when the moves are short or
    nearly parallel; `InputError` when the flange turned between the last three.
    """
    touches = fit_four(T_base_flange[:-3], sigma_m)
    last = T_base_flange[-3:]
    turned = np.linalg.norm(frames.log_rotation(last[1:, :3, :3] @ last[0, :3, :3].T), axis=1)
    if turned.max() > 1e-3:
        raise InputError(
            f"the flange turned by {np.degrees(turned.max()):.3f} deg between the last three "
            "poses: move in a straight line without turning"
        )
    x, z = np.diff(last[:, :3, 3], axis=0)
    shortest = float(min(np.linalg.norm(x), np.linalg.norm(z)))
    if shortest < SHORTEST_MOVE_M:
        raise RankDeficientError(
            f"a move of {shortest * 1e3:.1f} mm gives no direction: move by "
            f"{SHORTEST_MOVE_M * 1e3:.0f} mm or more",
            ("axes of the tool",),
        )
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    if np.linalg.norm(np.cross(x, z)) < np.sin(SMALLEST_ANGLE_RAD):
        raise RankDeficientError("the two moves are nearly parallel", ("turn about the tool axis",))
    axes = frames.nearest_rotation(np.column_stack([x, np.cross(z, x), z]))
    rotation = last[0, :3, :3].T @ axes
    return TouchFit(
        touches.tip, touches.covariance, touches.point, rotation, touches.residual, touches.estimate
    )


LARGEST_LEAN_M = 3e-4  # between both beams after straightening
Height = Literal["up", "down"]
FIRST = ("straight", "turned")
AGAIN = ("upright", "upright_turned")
PLUNGE = "plunge"
SWEEPS = (*FIRST, *AGAIN, PLUNGE)
HEIGHTS: tuple[Height, Height] = ("up", "down")
# Flange z down; y_e along y_b, then x_e along y_b.
R_BASE_FLANGE = {
    "straight": np.diag([-1.0, 1.0, -1.0]),
    "turned": np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]),
}
LARGEST_TURN_RAD = 1e-3  # off these: the axis is off by as much
Edges = Mapping[tuple[str, Height], Array]


@dataclass(frozen=True, eq=False)
class ParallelFit:
    """A tool by parallel beams: ``axis`` (3,) unit, and ``tip`` (3,), m, or None; flange frame."""

    axis: Array
    tip: Array | None


def fit_parallel(station: ParallelStation, edges: Edges) -> ParallelFit:
    """Axis from the sweeps ``straight`` and ``turned``; the tip where it was straightened too.

    ``edges``: flange poses T_base_flange (m, 4, 4) at the edges, by sweep and beam: break and
    restore, or several of both; ``plunge`` of the upper beam has its break, better with the restore
    on the way up: what a late input reads too low and too high is right in the mean.

    Raises `TooFewSamplesError` when a sweep is missing; `InputError` when edges are odd in number,
    the flange is turned otherwise than methods say, or the place of the beams is missing;
    `ResidualError` when the re-sweep shows a tool that still leans; `RankDeficientError` when both
    sweeps of the straightened tool have one orientation.
    """
    more = [name for name, _ in edges if name not in FIRST]
    _require(edges, [*FIRST, *AGAIN] if more else FIRST)
    for name in FIRST:
        require_turn(name, np.concatenate([edges[name, beam] for beam in HEIGHTS]))
    up, down, turned_up, turned_down = (
        _middle(edges, name, beam) for name in FIRST for beam in HEIGHTS
    )
    v = np.array([-(up - down), turned_up - turned_down, station.up_m - station.down_m])
    axis = np.asarray(v / np.linalg.norm(v))
    return ParallelFit(axis, _tip(station, edges) if more else None)


def _tip(station: ParallelStation, edges: Edges) -> Array:
    """Tip (3,) of the straightened tool, which is D = z - h_up below the flange (eq. 4-7)."""
    if (PLUNGE, "up") not in edges:
        raise TooFewSamplesError("there is no plunge: drive the upright tool into the upper beam")
    if station.x_m is None:
        raise InputError("the tip needs the beams' place along the base's x: it is missing")
    z_m = float(edges[PLUNGE, "up"][:, 2, 3].mean())
    rows, right = [np.array([0.0, 0.0, 1.0])], [station.up_m - z_m]
    frame = edges[AGAIN[0], "up"][0, :3, :3]
    for name in AGAIN:
        x_up, x_down = (_middle(edges, name, beam) for beam in HEIGHTS)
        if abs(x_up - x_down) > LARGEST_LEAN_M:
            raise ResidualError(
                f"the straightened tool leans by {abs(x_up - x_down) * 1e3:.3f} mm between the "
                f"beams (allowed {LARGEST_LEAN_M * 1e3:.1f} mm): straighten it again"
            )
        rows.append(np.array([1.0, 0.0, 0.0]) @ edges[name, "up"][0, :3, :3] @ frame.T)
        right.append(station.x_m - 0.5 * (x_up + x_down))
    A = np.array(rows)
    if np.linalg.cond(A) > 1e3:
        raise RankDeficientError(
            "both sweeps have one orientation: turn the flange by 90 deg about z in between",
            ("place along the beams",),
        )
    return np.asarray(frame.T @ np.linalg.solve(A, np.array(right)))


def _require(edges: Edges, names: Sequence[str]) -> None:
    for name in names:
        for beam in HEIGHTS:
            if (name, beam) not in edges:
                raise TooFewSamplesError(
                    f"sweep {name} has no edges of beam {beam}: sweep the tool through both beams"
                )
            if not np.all(np.isfinite(edges[name, beam])):
                raise InputError(f"sweep {name}, beam {beam}: a flange pose is not finite")
            if len(edges[name, beam]) % 2:
                raise InputError(
                    f"sweep {name}, beam {beam}: {len(edges[name, beam])} edges; each pass of the "
                    "tool has a break and a restore"
                )


def require_turn(name: str, T_base_flange: Array) -> None:
    """Refuse flange poses (m, 4, 4) at the edges of one of `FIRST` that are turned otherwise.

    Raises `InputError`.
    """
    turn = T_base_flange[:, :3, :3] @ R_BASE_FLANGE[name].T
    off = np.linalg.norm(frames.log_rotation(turn), axis=1).max()
    if off > LARGEST_TURN_RAD:
        how = "y along" if name == FIRST[0] else "x along"
        raise InputError(
            f"sweep {name}: the flange is turned by {np.degrees(off):.2f} deg from z down and "
            f"{how} the base's y (allowed {np.degrees(LARGEST_TURN_RAD):.2f} deg)"
        )


def _middle(edges: Edges, name: str, beam: Height) -> float:
    """Flange x, base, m: the mean of the lower and the upper half of the edges, of their means."""
    x = np.sort(edges[name, beam][:, 0, 3])
    return float(x.reshape(2, -1).mean(axis=1).mean())


# ---- touches that the node records while the robot stands at each -------------------------------


STANDS = StandstillRule(after_s=0.0)  # up to the newest reading
SAME_RAD = float(np.radians(2.0))  # a touch from the same posture says nothing new


@dataclass(frozen=True, eq=False)
class HandMeasured:
    """A tool from motions that the robot's own program made, judged; kept as a run is.

    ``samples``: how many touches, or edges; ``inputs``: what it was found from.
    """

    method: str
    samples: int
    found: KnownTool
    verdict: Verdict
    document: Document
    thermal_revision: int
    inputs: dict[str, NDArray[Any]]
    cycle_id: str = ""


class TouchLog:
    """Touches of one point since the last tool that they gave, each the joints at rest (n,)."""

    def __init__(self, config: ToolConfig) -> None:
        self._config = config
        self._touches: list[Array] = []

    def add(self, command: Command, stream: JointStream) -> Outcome:
        """Take a touch; one from a posture that was touched from already takes its place.

        Raises `NotStillError` while the robot moves; `TooFewSamplesError` without joint readings.
        """
        stamp_ns = (command.marks or {}).get(JOINTS, 0)
        q = stream.resting(stamp_ns, STANDS) if stamp_ns else None
        if q is None:
            raise TooFewSamplesError("no joint states received: does the robot's driver publish?")
        apart = [old for old in self._touches if np.max(np.abs(old - q)) > SAME_RAD]
        words = "" if len(apart) == len(self._touches) else ", in place of one from this posture"
        self._touches = [*apart, q]
        return Outcome(command, Code.ACCEPT, f"touch {len(self._touches)} is taken{words}")

    def clear(self, command: Command) -> Outcome:
        """Forget all."""
        count, self._touches = len(self._touches), []
        return Outcome(command, Code.ACCEPT, f"{count} touches are forgotten")

    def solve(self, arm: SerialArm, in_force: KnownTool, thermal_revision: int) -> HandMeasured:
        """Find the tip with the model ``arm``, and judge it; the orientation stays."""
        q = np.array(self._touches).reshape(-1, arm.n)
        fit = fit_four(arm.fk(q))
        T = frames.transform(in_force.T_flange_tool[:3, :3], fit.tip)
        covariance = np.zeros((5, 5))
        if in_force.covariance is not None:
            covariance[3:, 3:] = in_force.covariance[3:, 3:]
        covariance[:3, :3] = fit.covariance
        sigma_m = float(np.sqrt(np.max(np.diag(fit.covariance))))
        verdict = judge_tip(fit.verdict, sigma_m, T, self._config, "touch from more sides")
        document: Document = {
            "method": "touches",
            "touches": len(q),
            "tcp_mm": (1e3 * fit.tip).tolist(),
            "sigma_mm": (1e3 * np.sqrt(np.diag(fit.covariance))).tolist(),
            "change": change_between(in_force.T_flange_tool, T).document(),
            "misfit_mm": 1e3 * fit.rms_m,
            "verdict": verdict_document(verdict),
        }
        found = KnownTool(T, covariance)
        return HandMeasured("touches", len(q), found, verdict, document, thermal_revision, {"q": q})


def judge_tip(
    verdict: Verdict, sigma_m: float, T_flange_tool: Array, config: ToolConfig, mend: str
) -> Verdict:
    """A fit's own verdict, then how well the tip is known and how far it is from the taught."""
    limits = config.limits
    away = change_between(config.T_flange_taught, T_flange_tool)
    if verdict.accept and sigma_m > limits.sigma_m:
        words = f"{verdict.reason}; the tip is known to {1e3 * sigma_m:.3f} mm only: {mend}"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    if verdict.accept and away.tip_m > limits.change_m:
        words = f"{verdict.reason}; the tip is {1e3 * away.tip_m:.2f} mm from the taught one"
        return Verdict(Code.LIMIT_EXCEEDED, f"{words} (allowed {1e3 * limits.change_m:g} mm)")
    if verdict.accept and away.axis_rad > limits.tilt_rad:
        words = f"{verdict.reason}; the axis is {np.degrees(away.axis_rad):.2f} deg from the"
        allowed = f"taught one (allowed {np.degrees(limits.tilt_rad):g} deg)"
        return Verdict(Code.LIMIT_EXCEEDED, f"{words} {allowed}")
    return verdict


SHARE = 1e-2  # of a sigma, in numeric derivatives; the fit is linear but for the axis' length
MEND = "sweep there and back, the plunge down as fast as up, and more often"
LONGEST_NS = 120_000_000_000  # of a sweep: edges from before it are those of other work
QUARTER = frames.exp_rotation([0.0, 0.0, 0.5 * np.pi])


WAYS: Mapping[str, int] = {name: 2 if name == PLUNGE else 0 for name in SWEEPS}  # axis of base
FURTHEST_M = 1e-3  # across its way, between a plunge's edges: a round tip would meet the beam late


@dataclass(frozen=True, eq=False)
class SeenEdges:
    """Edges of one beam in one sweep, in order of time.

    ``T`` (m, 4, 4): the flange then, in base. Along the sweep's way ``sigma_m`` (m,) of each, and
    ``speed_m_s`` (m,), by which a late one is read too far.
    """

    T: Array
    sigma_m: Array
    speed_m_s: Array


Seen = Mapping[tuple[str, Height], SeenEdges]


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """Edges of one sweep, and the joints q (n, joints) around them at ``time_s`` (n,)."""

    name: str
    edges: list[BeamEdge]
    time_s: Array
    q: Array

    def seen(self, arm: SerialArm, noise: RobotNoise) -> dict[Height, SeenEdges]:
        """By beam what it showed; of a plunge the upper one alone."""
        path, found = JointPath(arm, self.time_s, self.q), dict[Height, SeenEdges]()
        for beam in HEIGHTS[:1] if self.name == PLUNGE else HEIGHTS:
            own = [edge for edge in self.edges if edge.beam == beam]
            T, twist = path.at(np.array([edge.time_s for edge in own]))
            late_m = np.linalg.norm(twist[:, :3], axis=1) * [edge.sigma_s for edge in own]
            speed = twist[:, WAYS[self.name]]
            found[beam] = SeenEdges(T, np.hypot(noise.edge_m, late_m), speed)
        return found


class SweepLog:
    """Sweeps since the last tool that they gave."""

    def __init__(self, config: ToolConfig) -> None:
        self._config = config
        self._edges = EdgeLog()
        self._sweeps: list[RecordedSweep] = []
        self._from_ns = 0

    def add_edge(self, sample: EdgeSample, newest_ns: dict[str, int], joints_ns: int) -> None:
        """Take an edge; as `EdgeLog.add`."""
        self._edges.forget(min(sample.stamp_ns, joints_ns) - LONGEST_NS)
        self._edges.add(sample, newest_ns, joints_ns)

    def come(self, newest_ns: dict[str, int], joints_ns: int) -> None:
        """As `EdgeLog.come`."""
        self._edges.come(newest_ns, joints_ns)

    @property
    def awaits_joints(self) -> bool:
        """Whether an edge waits for joint readings."""
        return bool(self._edges.ahead)

    def add(self, command: Command, stream: JointStream, arm: SerialArm) -> Outcome:
        """Take the sweep that is over.

        Raises `ConflictError` where there are no parallel beams, or all sweeps are taken;
        `BeamError` when its edges are not whole passes, `InputError` when the flange is turned
        otherwise: sweep again.
        """
        if self._config.parallel is None:
            raise ConflictError("there are no parallel beams: give parallel_up_mm and its others")
        if len(self._sweeps) == len(SWEEPS):
            raise ConflictError("all sweeps are taken: solve, or clear them")
        name, marks = SWEEPS[len(self._sweeps)], command.marks or {}
        samples = self._edges.take(self._from_ns, marks)
        joints_ns = marks.get(JOINTS, 0)
        self._from_ns = max(joints_ns, self._from_ns)
        if not samples:
            raise BeamError(f"sweep {name}: no beam was broken: sweep the tool through both")
        origin_ns, rule = samples[0].stamp_ns, self._config.input
        edges = debounced(
            [sample.edge(origin_ns, rule.sigma_s) for sample in samples], rule.debounce_s
        )
        _require_passes(name, edges)
        stamps, q = stream.window(origin_ns - BEFORE_NS, samples[-1].stamp_ns + AFTER_NS)
        time_s = 1e-9 * (stamps - origin_ns).astype(np.float64)
        sweep = RecordedSweep(name, edges, time_s, q)
        seen = sweep.seen(arm, self._config.noise)  # refuses what has no readings around it
        if name in FIRST:
            require_turn(name, np.concatenate([one.T for one in seen.values()]))
        if name == PLUNGE:
            _require_plunge(seen["up"])
        self._sweeps.append(sweep)
        words = f"sweep {name} ({len(self._sweeps)} of {len(SWEEPS)}) is taken: {len(edges)} edges"
        if all(np.ptp(np.sign(one.speed_m_s)) == 0.0 for one in seen.values()):
            words += ", all of one way: there and back a delay of the input cancels"
        if name == FIRST[-1]:
            words += f"; {self._upright(arm)}"
        elif name == AGAIN[-1]:  # a round tip beside the beam's plane meets it late
            x_mm = 1e3 * np.mean([one.T[:, 0, 3].mean() for one in seen.values()])
            words += f"; plunge as it is turned, with the flange at x_mm {x_mm:.4f} of the base"
        return Outcome(command, Code.ACCEPT, words, samples=len(edges))

    def jumped(self) -> None:
        """Stamps begin anew: edges of before belong to no sweep."""
        self._edges.clear()
        self._from_ns = 0

    def clear(self, command: Command) -> Outcome:
        """Forget all, and the edges of a sweep that was not taken."""
        self._edges.take(0, command.marks or {})
        count, self._sweeps = len(self._sweeps), []
        return Outcome(command, Code.ACCEPT, f"{count} sweeps are forgotten")

    def solve(self, arm: SerialArm, in_force: KnownTool, thermal_revision: int) -> HandMeasured:
        """Find axis and tip with the model ``arm``, and judge them; the turn about the axis stays.

        Raises `RobocalError` when the sweeps cannot answer.
        """
        config = self._config
        if len(self._sweeps) < len(SWEEPS):
            missing = ", ".join(SWEEPS[len(self._sweeps) :])
            raise TooFewSamplesError(f"sweeps {missing} are missing: take them first")
        seen = self._seen(arm)
        edges = {key: one.T for key, one in seen.items()}
        axis, tip = self._fit(edges)
        columns, sides = [], across(axis).T
        for error in _errors(seen, config.noise):
            moved = dict(edges)
            for key, away_m in error.items():
                moved[key] = moved[key].copy()
                moved[key][:, WAYS[key[0]], 3] += SHARE * away_m
            other_axis, other_tip = self._fit(moved)
            columns.append(np.concatenate([other_tip - tip, sides @ (other_axis - axis)]) / SHARE)
        T = frames.transform(retaught(in_force.T_flange_tool[:3, :3], axis), tip)
        own = np.array(columns).T
        turn = np.eye(5)  # the axis' part is told along the tool's own x and y
        turn[3:, 3:] = T[:3, :2].T @ across(axis)
        covariance = turn @ (own @ own.T) @ turn.T
        sigma_m = np.sqrt(np.diag(covariance)[:3])
        words = f"the tip is known to {1e3 * sigma_m.max():.3f} mm"
        verdict = judge_tip(Verdict(Code.ACCEPT, words), float(sigma_m.max()), T, config, MEND)
        leans = [np.diff([edges[name, beam][:, 0, 3].mean() for beam in HEIGHTS]) for name in AGAIN]
        count = sum(len(sweep.edges) for sweep in self._sweeps)
        document: Document = {
            "method": "parallel beams",
            "edges": count,
            "tcp_mm": (1e3 * tip).tolist(),
            "axis": axis.tolist(),
            "sigma_mm": (1e3 * sigma_m).tolist(),
            "sigma_axis_deg": np.degrees(np.sqrt(np.diag(covariance)[3:])).tolist(),
            "change": change_between(in_force.T_flange_tool, T).document(),
            "misfit_mm": 1e3 * float(np.sqrt(np.mean(np.square(leans)))),  # of the upright tool
            "verdict": verdict_document(verdict),
        }
        known = KnownTool(T, covariance)
        return HandMeasured(
            "parallel beams", count, known, verdict, document, thermal_revision, self._arrays()
        )

    def _seen(self, arm: SerialArm) -> Seen:
        """By sweep and beam what `RecordedSweep.seen` gives."""
        return {
            (sweep.name, beam): one
            for sweep in self._sweeps
            for beam, one in sweep.seen(arm, self._config.noise).items()
        }

    def _fit(self, edges: Mapping[tuple[str, Height], Array]) -> tuple[Array, Array]:
        """Axis and tip (3,), zero as long as the sweeps of the upright tool are missing."""
        station = self._config.parallel
        if station is None:
            raise ConflictError("there are no parallel beams")
        fit = fit_parallel(station, edges)
        return fit.axis, np.zeros(3) if fit.tip is None else fit.tip

    def _upright(self, arm: SerialArm) -> str:
        """In words how the flange stands for the next two sweeps."""
        axis, _ = self._fit({key: one.T for key, one in self._seen(arm).items()})
        straight = R_BASE_FLANGE[FIRST[0]]
        upright = minimal_rotation(straight @ axis, [0.0, 0.0, -1.0]) @ straight
        told = []
        for name, R in zip(AGAIN, (upright, QUARTER @ upright), strict=True):
            quat = frames.quat_xyzw(frames.transform(R, np.zeros(3)))
            told.append(f"{name} {' '.join(f'{part:.6f}' for part in quat)}")
        return f"turn the flange to quat_xyzw {', '.join(told)}"

    def _arrays(self) -> dict[str, NDArray[Any]]:
        """All that was measured, for keeping."""
        edges = [(i, edge) for i, sweep in enumerate(self._sweeps) for edge in sweep.edges]
        return {
            "sweep": np.array([i for i, _ in edges]),
            "beam": np.array([edge.beam for _, edge in edges]),
            "blocked": np.array([edge.blocked for _, edge in edges]),
            "edge_s": np.array([edge.time_s for _, edge in edges]),
            "edge_sigma_s": np.array([edge.sigma_s for _, edge in edges]),
            "readings": np.array([len(sweep.time_s) for sweep in self._sweeps]),
            "joint_s": np.concatenate([sweep.time_s for sweep in self._sweeps]),
            "q": np.concatenate([sweep.q for sweep in self._sweeps]),
        }


def _errors(seen: Seen, noise: RobotNoise) -> Iterator[dict[tuple[str, Height], Array]]:
    """Independent errors: by how much one sigma of each moves edges (m,) along their way, m."""
    for key, one in seen.items():
        for row, sigma_m in enumerate(one.sigma_m):
            yield {key: np.eye(len(one.T))[row] * sigma_m}
    for name in SWEEPS:  # a motion's own scatter, common to its edges
        own = {key: one for key, one in seen.items() if key[0] == name}
        yield {key: np.full(len(one.T), noise.step_m) for key, one in own.items()}
    # A delay, common to all, cancels there and back. Its size shows, as well as these scatter, in
    # how far a plunge's restore is above its break; a receiver's hysteresis is in that, too.
    plunge = seen[PLUNGE, "up"]
    above_m, faster_m_s = (
        np.mean(of[1::2] - of[::2]) for of in (plunge.T[:, 2, 3], plunge.speed_m_s)
    )
    size_m = np.linalg.norm([above_m, noise.step_m, noise.step_m, *plunge.sigma_m])
    yield {key: one.speed_m_s * size_m / faster_m_s for key, one in seen.items()}


def _require_plunge(seen: SeenEdges) -> None:
    """Refuse a plunge that does not break the beam downwards and leave it upwards."""
    rises = seen.speed_m_s > 0.0
    if np.any(rises != (np.arange(len(rises)) % 2 == 1)) or np.ptp(seen.T[:, 0, 3]) > FURTHEST_M:
        raise BeamError(
            f"sweep {PLUNGE}: the tip must come down into beam up and leave it on the same way up: "
            "sweep again"
        )


def _require_passes(name: str, edges: list[BeamEdge]) -> None:
    """Refuse edges that are not whole passes through each beam; of the plunge the upper one."""
    for beam in PARALLEL[:1] if name == PLUNGE else PARALLEL:
        own = [edge for edge in edges if edge.beam == beam]
        whole = len(own) >= 2 and len(own) % 2 == 0 and own[0].blocked
        if not whole or any(a.blocked == b.blocked for a, b in pairwise(own)):
            raise BeamError(
                f"sweep {name}: {len(own)} edges of beam {beam}, which are no whole passes with a "
                "break and a restore each: sweep again"
            )
