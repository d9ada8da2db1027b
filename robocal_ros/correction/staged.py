"""Correction of the arm's drift and of the tool's change, each within its own bounds.

First the drifted arm is put where the reference arm was, with the taught tool; then the new tool
where the taught one is. Together this is the correction from (reference arm, taught tool) to
(actual arm, new tool), but a bent tool's larger bounds do not loosen the arm's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction import solution
from robocal_ros.correction.joint_correction import (
    DRIFT_SLOPE,
    TOOL_SLOPE,
    CorrectionResult,
    JointCorrection,
    pack_model,
    path_rates,
    plain,
)
from robocal_ros.correction.limiter import step_out
from robocal_ros.kinematics import SerialArm

# ---- one target of a stream, from taught joints to what goes out: compiled in one piece ---------


Array = NDArray[np.float64]


# ---- correction of the arm's drift and of the tool's change, each within its own bounds ---------


EXACT = 1e-13  # rad, m: to rounding
MOST_STEPS = 100


@dataclass(frozen=True)
class StagedResult:
    """Corrected joints (m, n), and the two corrections; ``tool`` is None for the taught tool."""

    q: Array
    arm: CorrectionResult
    tool: CorrectionResult | None

    @property
    def weak(self) -> NDArray[np.bool_]:
        """(m,) True where a weak direction was given up, in part or in full."""
        return self.arm.weak if self.tool is None else self.arm.weak | self.tool.weak

    @property
    def whole(self) -> NDArray[np.bool_]:
        """(m,) True where all of the correction was made."""
        fine = self.arm.converged & ~self.weak
        return fine if self.tool is None else fine & self.tool.converged

    @property
    def remaining_m(self) -> Array:
        """(m,) position error that remains at the tool, at most."""
        rest = 0.0 if self.tool is None else self.tool.position_error_m
        return np.asarray(self.arm.position_error_m + rest)


class StagedCorrection:
    """Correction from a reference model to an actual one.

    Attributes
    ----------
    stages : 1, or 2 with a changed tool.

    Parameters
    ----------
    reference, actual : packed models (n + 2, 9), see `pack_model`. The taught tool is the
        reference's.
    arm_largest, tool_largest : (n,) largest joint shift of each stage, rad (prismatic: m).
    free_axis : the tool may turn about its z, in both stages.
    """

    def __init__(
        self,
        reference: Array,
        actual: Array,
        arm_largest: Array,
        tool_largest: Array,
        free_axis: bool = False,
    ) -> None:
        bare = actual.copy()
        bare[-1] = reference[-1]
        self.n, self._free = len(reference) - 2, free_axis
        self._arm = JointCorrection(
            np.stack([reference, bare]), arm_largest, free_axis, DRIFT_SLOPE
        )
        self._tool: JointCorrection | None = None
        if not np.array_equal(actual[-1], reference[-1]):
            self._tool = JointCorrection(
                np.stack([bare, actual]), tool_largest, free_axis, TOOL_SLOPE
            )
        parts = [self._arm] if self._tool is None else [self._arm, self._tool]
        self.stages = len(parts)
        self._works = np.stack([part.work for part in parts])
        self._largest = np.stack([part.largest for part in parts])
        self._reports = np.empty((2, self.stages, self.n + solution.REPORT))
        self._one = np.empty((self.stages, self.n + solution.REPORT))
        self._spare = np.empty((2, self.n))
        self._back = [part.inverse() for part in reversed(parts)]
        self._back_works = np.stack([part.work for part in self._back])
        self._solved: Array | None = None  # taught joints whose report is in `_one`

    def correct(self, q: Array) -> StagedResult:
        """Correct joints (m, n)."""
        arm = self._arm.correct(q)
        if self._tool is None:
            return StagedResult(arm.q, arm, None)
        tool = self._tool.correct(arm.q)
        return StagedResult(tool.q, arm, tool)

    def correct_one(self, q: Array, out: Array) -> None:
        """Correct one point (n,), for a stream: the bits of `correct`, without its objects.

        ``out`` (stages, n + solution.REPORT) gets each stage's joints and report; the corrected
        joints are ``out[-1, :n]``. Both are contiguous arrays of float64.
        """
        solution.correct_staged(q, self._largest, self._free, self._works, out)

    def uncorrect_one(self, corrected: Array) -> Array:
        """`uncorrect` for one point (n,), for a stream."""
        q = np.empty(self.n)
        limits = self._largest, self._free
        if solution.uncorrect_staged(corrected, *limits, self._works, 20, EXACT, self._one, q):
            self._solved = q
            return q
        return np.asarray(self.uncorrect(corrected[None])[0])

    def step_out(
        self, goal: Array, velocity: Array, elapsed: float, longest: float, memory: Array,
        limits: Array, active: Array, speeds: Array, span: Array, bounds: Array, tcp: Array,
        figures: Array,
    ) -> float:  # fmt: skip
        """Correct one target of a stream and put it out, see `step_out`."""
        return step_out(
            goal, velocity, elapsed, longest, memory, limits, active, speeds, span, bounds, tcp,
            self._largest, self._free, self._works, self._reports, figures,
        )  # fmt: skip

    def taught_velocity_one(self, corrected: Array, velocity: Array, q: Array) -> Array:
        """Velocities (n,) of one point's taught joints ``q``, of those of the corrected ones."""
        if q is not self._solved:
            self.correct_one(q, self._one)
        found, self._solved = np.empty(self.n), None
        whole = not self._one[:, self.n + solution.WEAK].any()
        if not (whole and self._by_chain(corrected, velocity, q, self._back_works, found)):
            given = self._largest, self._free, self._works
            at_q = self._one[-1, : self.n].copy()
            solution.taught_velocity_by_differences(
                q, velocity, at_q, *given, self._spare, self._one, found
            )
        return found

    def _by_chain(
        self, before: Array, velocity: Array, after: Array, works: Array, out: Array
    ) -> bool:
        """Velocities ``out`` (n,) at ``after`` by the chain rule; whether that is possible."""
        if self.n != 6 or self._free:
            return False
        return solution.velocity_by_chain(before, velocity, after, works[0], works[-1], out)

    def uncorrect(self, corrected: Array) -> Array:
        """Taught joints (m, n) of corrected ones: the inverse of `correct`.

        The shift changes slower than the joints move, so that q <- q' - shift(q) converges; the
        correction with the models exchanged is where it begins.
        """
        q = corrected
        for part in self._back:
            q = part.correct(q).q
        q, rows = q.copy(), np.arange(len(corrected))
        for _ in range(MOST_STEPS):
            miss = corrected[rows] - self.correct(q[rows]).q
            rows, miss = (x[np.max(np.abs(miss), axis=1) > EXACT] for x in (rows, miss))
            if not len(rows):
                break
            q[rows] += miss
        return q

    def rates(
        self, q: Array, velocity: Array, acceleration: Array | None, result: StagedResult
    ) -> tuple[Array, Array]:
        """Velocities and accelerations (m, n) of the corrected joints; without some, those alone.

        ``result`` is that of `correct` at ``q``. By the chain rule where all of the correction of
        six joints is made; with a weak direction, a free axis, or other numbers of joints, by
        central differences along the path, which the two continuous derivatives of the
        correction allow everywhere.
        """
        out_v, out_a = np.empty(q.shape), np.empty(q.shape)
        rough = np.ones(len(q), dtype=np.bool_)
        if self.n == 6 and not self._free:
            points, qd = plain(q), plain(velocity)
            qdd = np.zeros_like(points) if acceleration is None else plain(acceleration)
            solution.rates_batch(
                points, qd, qdd, plain(result.q), self._works[0], self._works[-1], out_v, out_a
            )
            rough = ~(result.whole & np.isfinite(out_v).all(axis=1))
        if np.any(rough):
            bends = None if acceleration is None else acceleration[rough]
            out_v[rough], out_a[rough] = path_rates(
                lambda at: self.correct(at).q,
                q[rough],
                velocity[rough],
                bends,
                (result.q - q)[rough],
            )
        return out_v, out_a


def load_kernels(arm: SerialArm) -> None:
    """Call the compiled code once, so that the first command need not wait for it."""
    packed, largest, q = pack_model(arm), np.ones(arm.n), np.zeros((2, arm.n))
    arm.fk(q)
    stage = StagedCorrection(packed, packed, largest, largest)
    stage.rates(q, q, q, stage.correct(q))
    stage.correct_one(q[0], np.empty((stage.stages, arm.n + solution.REPORT)))
    stage.uncorrect(q)
    stage.uncorrect_one(q[0])
    stage.taught_velocity_one(q[0], q[0], q[0])
    given = np.ones((stage.stages, arm.n)), False, stage._works, np.zeros((2, arm.n))
    report = np.empty((stage.stages, arm.n + solution.REPORT))
    solution.taught_velocity_by_differences(q[0], q[0], q[0], *given, report, np.empty(arm.n))
