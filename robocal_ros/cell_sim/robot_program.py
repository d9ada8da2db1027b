"""A robot's own program at a beam station: it drives the steps of a tool measurement."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.beam_program import step_move
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.tool_cell import ToolCell, joints_at
from robocal_ros.ground.samples import JointSample
from robocal_ros.tool.edges import BeamEdge, EdgeSample
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]
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
