"""Correction of the arm's drift and of the tool's change, each within its own bounds.

First the drifted arm is put where the reference arm was, with the taught tool; then the new tool
where the taught one is. Together this is the correction from (reference arm, taught tool) to
(actual arm, new tool), but a bent tool's larger bounds do not loosen the arm's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction import rates
from robocal_ros.correction.joint_correction import (
    CorrectionResult,
    JointCorrection,
    blend_models,
    pack_model,
    path_rates,
    plain,
)
from robocal_ros.correction.plain import load_kernels as load_plain_kernels
from robocal_ros.correction.plainness import EXACT
from robocal_ros.correction.room import work_size

Array = NDArray[np.float64]

# The inverse near a singularity is refined until it is exact, or so often.
ROUNDING = 1e-9
MOST_REFINEMENTS, MOST_NEWTON_STEPS = 30, 12
DIFFERENCE, LONGEST_STEP = 1e-6, 0.1
SHORTER = 0.5 ** np.arange(8)


@dataclass(frozen=True)
class StagedResult:
    """Corrected joints (m, n), and the two corrections; ``tool`` is None for the taught tool."""

    q: Array
    arm: CorrectionResult
    tool: CorrectionResult | None

    @property
    def whole(self) -> NDArray[np.bool_]:
        """(m,) True where all of the correction was made."""
        share = self.arm.share if self.tool is None else self.arm.share * self.tool.share
        return np.asarray(share == 1.0)

    @property
    def remaining_m(self) -> Array:
        """(m,) position error that remains at the tool, at most."""
        rest = 0.0 if self.tool is None else self.tool.position_error_m
        return np.asarray(self.arm.position_error_m + rest)


class StagedCorrection:
    """Correction from a reference model to one between two others.

    Attributes
    ----------
    models : (4, n + 2, 9) of all of it.
    analytic : whether rates are found by the chain rule.

    Parameters
    ----------
    reference, start, end : packed models, see `pack_model`; blend s goes from start to end. The
        taught tool is the reference's.
    arm_largest, tool_largest : (n,) largest joint shift of each stage, rad (prismatic: m).
    free_axis : the tool may turn about its z, in both stages.
    """

    def __init__(
        self,
        reference: Array,
        start: Array,
        end: Array,
        arm_largest: Array,
        tool_largest: Array,
        free_axis: bool = False,
    ) -> None:
        taught = reference[-1]
        bare = [model.copy() for model in (start, end)]
        for model in bare:
            model[-1] = taught
        self.n = len(reference) - 2
        self._arm = JointCorrection(np.stack([reference, reference, *bare]), arm_largest, free_axis)
        self.models = np.stack([reference, reference, start, end])
        # six joints and six equations: rates by the chain rule
        self.analytic = self.n == 6 and not free_axis
        self._work = np.empty(work_size(self.n))
        self._tool: JointCorrection | None = None
        if not (np.array_equal(start[-1], taught) and np.array_equal(end[-1], taught)):
            self._tool = JointCorrection(np.stack([*bare, start, end]), tool_largest, free_axis)

    def stacked(self) -> tuple[Array, Array]:
        """Models (2 k, 4, n + 2, 9) and largest shifts (2 k, n) of k stages, then of the inverses.

        The inverses are in reverse order.
        """
        stages = [self._arm] if self._tool is None else [self._arm, self._tool]
        stages += [stage.inverse() for stage in reversed(stages)]
        return np.stack([x.models for x in stages]), np.stack([x.largest for x in stages])

    def correct(self, q: Array, s: Array) -> StagedResult:
        """Correct joints (m, n) at blends (m,)."""
        arm = self._arm.correct(q, s)
        if self._tool is None:
            return StagedResult(arm.q, arm, None)
        tool = self._tool.correct(arm.q, s)
        return StagedResult(tool.q, arm, tool)

    def uncorrect(self, corrected: Array, s: Array) -> Array:
        """Taught joints (m, n) of corrected ones: the inverse of `correct`.

        Exact where the whole correction is made; near a singularity, or with a free axis, refined
        until it is, or until it is as near as it gets: always a number, and never further off
        than twice the bounds of both shifts together.
        """
        return self.inverse(corrected, s)[0]

    def inverse(self, corrected: Array, s: Array) -> tuple[Array, NDArray[np.bool_]]:
        """`uncorrect`, and (m,) whether all of the correction is made there."""
        answer, best = corrected.copy(), np.full(len(corrected), np.inf)
        part, whole = np.zeros((2, len(corrected)), dtype=np.bool_)
        rows, aim = np.arange(len(corrected)), corrected
        for _ in range(MOST_REFINEMENTS):
            q = self._exchanged(aim, s[rows])
            made = self.correct(q, s[rows])
            miss = corrected[rows] - made.q
            size = np.max(np.abs(miss), axis=1)
            better = size < best[rows]
            answer[rows[better]], best[rows[better]] = q[better], size[better]
            whole[rows[better]] = made.whole[better]
            if made.tool is not None:
                part[rows[better]] = made.tool.share[better] < 1.0
            more = better & (size >= EXACT)  # one that no longer gets nearer needs other steps
            if not np.any(more):
                break
            aim, rows = aim[more] + miss[more], rows[more]
        for i in np.flatnonzero((best >= ROUNDING) | part):
            exact = bool(best[i] < ROUNDING)
            answer[i] = self._searched(answer[i], corrected[i], s[i : i + 1], exact=exact)
            whole[i] = self.correct(answer[i : i + 1], s[i : i + 1]).whole[0]
        return answer, whole

    def _exchanged(self, q: Array, s: Array) -> Array:
        """Joints (m, n) corrected with the models exchanged: nearly the taught ones."""
        if self._tool is not None:
            q = self._tool.inverse().correct(q, s).q
        return self._arm.inverse().correct(q, s).q

    def _searched(self, near: Array, corrected: Array, s: Array, *, exact: bool) -> Array:
        """Taught joints (n,) from other starts; ``near`` them, where no other serves.

        A tool's change is made in full or not at all, so that joints for which it would be made
        in part are taken only when there are no others; ``exact``: ``near`` is at least such.
        """
        full = self._in_full(corrected, s)
        if self._serves(full, corrected, s):
            return full
        for start in () if exact else (near, full):
            found = self._by_newton(start, corrected, s)
            if self._serves(found, corrected, s):
                return found
        return near

    def _serves(self, q: Array, corrected: Array, s: Array) -> bool:
        made = self.correct(q[None], s)
        whole = made.tool is None or made.tool.share[0] == 1.0
        return bool(whole and np.max(np.abs(made.q[0] - corrected)) < ROUNDING)

    def _in_full(self, corrected: Array, s: Array) -> Array:
        """Taught joints (n,) as if no shift were bounded."""
        q = corrected[None]
        for stage in (self._tool, self._arm):
            if stage is not None:
                models = stage.models[[2, 3, 0, 1]]
                q = JointCorrection(models, free_axis=stage.free_axis).correct(q, s).q
        return np.asarray(q[0])

    def _by_newton(self, q: Array, corrected: Array, s: Array) -> Array:
        """Taught joints (n,) by Newton's steps from ``q`` (n,), as near as they get.

        The derivative is taken by differences. `correct` turns fast near a singularity.
        """

        def miss(points: Array) -> Array:
            return corrected - self.correct(points, np.repeat(s, len(points))).q

        left, nudges = miss(q[None])[0], DIFFERENCE * np.vstack([np.eye(self.n), -np.eye(self.n)])
        for _ in range(MOST_NEWTON_STEPS):
            if np.max(np.abs(left)) < EXACT:
                break
            there = miss(q + nudges)
            slopes = (there[self.n :] - there[: self.n]).T / (2.0 * DIFFERENCE)
            step = np.linalg.lstsq(slopes, left, rcond=None)[0]
            step *= min(1.0, LONGEST_STEP / max(float(np.max(np.abs(step))), EXACT))
            tries = q + step * SHORTER[:, None]  # the longest of these that comes nearer
            missed = miss(tries)
            nearer = np.max(np.abs(missed), axis=1) < np.max(np.abs(left))
            if not np.any(nearer):
                break
            longest = int(np.argmax(nearer))
            q, left = tries[longest], missed[longest]
        return q

    def rates(
        self,
        q: Array,
        velocity: Array,
        acceleration: Array,
        s: Array,
        s_rate: Array,
        result: StagedResult,
    ) -> tuple[Array, Array]:
        """Velocities and accelerations (m, n) of the corrected joints.

        ``result`` is that of `correct` at ``q`` and ``s``; ``s_rate`` (m,) in 1/s. Analytic
        where all of the correction is made by a settled model, else by central differences
        along the path.
        """
        out_v, out_a = np.empty(q.shape), np.empty(q.shape)
        points, qd, qdd = plain(q), plain(velocity), plain(acceleration)
        rough = np.ones(len(q), dtype=np.bool_)
        if self.analytic:
            blends = plain(s)
            rates.rates_batch(
                points, qd, qdd, plain(result.q), self.models, blends, self._work, out_v, out_a
            )
            rough = ~(result.whole & (s_rate == 0.0) & np.isfinite(out_v).all(axis=1))
        if np.any(rough):

            def corrected(p: Array, t: float) -> Array:
                return self.correct(p, np.clip(s[rough] + s_rate[rough] * t, 0.0, 1.0)).q

            out_v[rough], out_a[rough] = path_rates(
                corrected, q[rough], velocity[rough], acceleration[rough]
            )
        return out_v, out_a

    def taught(self, corrected: Array, velocity: Array) -> tuple[Array, Array]:
        """Taught joints (m, n) of corrected ones, and their velocities; at the end of the blend.

        Where a singularity is near the velocities are the corrected joints' own.
        """
        ones, zero = np.ones(len(corrected)), np.zeros_like(corrected)
        q, whole = self.inverse(corrected, ones)
        if not self.analytic:
            found = path_rates(lambda p, _: self.uncorrect(p, ones), corrected, velocity, zero)
            return q, found[0]
        out, unused, models = zero.copy(), zero.copy(), self.models[[2, 3, 0, 1]]
        rates.rates_batch(corrected, velocity, zero, q, models, ones, self._work, out, unused)
        exact = whole & np.isfinite(out).all(axis=1)
        return q, np.where(exact[:, None], out, velocity)


def load_kernels(arm: SerialArm) -> None:
    """Call the compiled code once, so that the first command need not wait for it."""
    load_plain_kernels(arm.n)
    packed, largest = pack_model(arm), np.ones(arm.n)
    q, s = np.zeros((2, arm.n)), np.full(2, 0.5)
    stage = StagedCorrection(packed, packed, packed.copy(), largest, largest)
    stage.rates(q, q, q, s, np.zeros(2), stage.correct(q, s))
    stage.uncorrect(q, s)
    blend_models(packed, packed.copy(), 0.5)
