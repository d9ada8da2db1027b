# SPDX-License-Identifier: Apache-2.0
"""A tool by two parallel beams, recorded by the node while the robot's program sweeps through them.

The sweeps are those of `touch_points.fit_parallel`, in its order; each is taken once it is over.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ConflictError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import JOINTS, JointStream
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.crossed_model import RobotNoise, across
from robocal_ros.tool.edges import PARALLEL, BeamEdge, BeamError, EdgeLog, EdgeSample, debounced
from robocal_ros.tool.judging import KnownTool, change_between
from robocal_ros.tool.laser_frame import JointPath, minimal_rotation, retaught
from robocal_ros.tool.run import AFTER_NS, BEFORE_NS, ToolConfig
from robocal_ros.tool.touch_points import (
    AGAIN,
    FIRST,
    HEIGHTS,
    PLUNGE,
    R_BASE_FLANGE,
    SWEEPS,
    HandMeasured,
    Height,
    fit_parallel,
    judge_tip,
    require_turn,
)

STEP_M = 1e-6  # of numeric derivatives; the fit is linear but for the axis' length
LONGEST_NS = 120_000_000_000  # of a sweep: edges from before it are those of other work
QUARTER = frames.exp_rotation([0.0, 0.0, 0.5 * np.pi])


@dataclass(frozen=True, eq=False)
class RecordedSweep:
    """Edges of one sweep, and the joints q (n, joints) around them at ``time_s`` (n,)."""

    name: str
    edges: list[BeamEdge]
    time_s: Array
    q: Array

    def seen(self, arm: SerialArm, noise: RobotNoise) -> dict[Height, tuple[Array, Array]]:
        """By beam the flange (m, 4, 4) at its edges, and sigma (m,) of each along its way, m."""
        path, found = JointPath(arm, self.time_s, self.q), {}
        for beam in HEIGHTS:
            own = [edge for edge in self.edges if edge.beam == beam]
            if self.name == PLUNGE:
                own = own[:1] if beam == "up" else []
            if own:
                T, twist = path.at(np.array([edge.time_s for edge in own]))
                late_m = np.linalg.norm(twist[:, :3], axis=1) * [edge.sigma_s for edge in own]
                found[beam] = T, np.hypot(noise.edge_m, late_m)
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
            require_turn(name, np.concatenate([T for T, _ in seen.values()]))
        self._sweeps.append(sweep)
        words = f"sweep {name} ({len(self._sweeps)} of {len(SWEEPS)}) is taken: {len(edges)} edges"
        if name == FIRST[-1]:
            words += f"; {self._upright(arm)}"
        elif name == AGAIN[-1]:  # a round tip beside the beam's plane meets it late
            x_mm = 1e3 * np.mean([T[:, 0, 3].mean() for T, _ in seen.values()])
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
        edges = {key: T for key, (T, _) in seen.items()}
        axis, tip = self._fit(edges)
        columns, sides = [], across(axis).T
        for keys, way, sigma in _errors(seen, config.noise):
            moved = dict(edges)
            for key, rows in keys.items():
                moved[key] = moved[key].copy()
                moved[key][rows, way, 3] += STEP_M
            other_axis, other_tip = self._fit(moved)
            by = np.concatenate([other_tip - tip, sides @ (other_axis - axis)]) / STEP_M
            columns.append(sigma * by)
        T = frames.transform(retaught(in_force.T_flange_tool[:3, :3], axis), tip)
        own = np.array(columns).T
        turn = np.eye(5)  # the axis' part is told along the tool's own x and y
        turn[3:, 3:] = T[:3, :2].T @ across(axis)
        covariance = turn @ (own @ own.T) @ turn.T
        sigma_m = np.sqrt(np.diag(covariance)[:3])
        words = f"the tip is known to {1e3 * sigma_m.max():.3f} mm"
        verdict = judge_tip(
            Verdict(Code.ACCEPT, words), float(sigma_m.max()), T, config, "sweep more often"
        )
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

    def _seen(self, arm: SerialArm) -> dict[tuple[str, Height], tuple[Array, Array]]:
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
        axis, _ = self._fit({key: T for key, (T, _) in self._seen(arm).items()})
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


Places = dict[tuple[str, Height], list[int]]


def _errors(
    seen: Mapping[tuple[str, Height], tuple[Array, Array]], noise: RobotNoise
) -> list[tuple[Places, int, float]]:
    """Independent errors: the edges that one moves, along which axis of the base, its sigma, m."""
    found: list[tuple[Places, int, float]] = []
    for (name, beam), (_, sigma_m) in seen.items():
        way = 2 if name == PLUNGE else 0
        found += [({(name, beam): [row]}, way, float(s)) for row, s in enumerate(sigma_m)]
    for name in SWEEPS:  # a motion's own scatter, common to its edges
        every = {key: list(range(len(T))) for key, (T, _) in seen.items() if key[0] == name}
        found.append((every, 2 if name == PLUNGE else 0, noise.step_m))
    return found


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
