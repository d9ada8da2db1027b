"""The offset that is wanted at a posture, by model, tool and policy; the limiter comes after it."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.bounds import CorrectionConfig, Policy, require_solved, require_within
from robocal_ros.correction.clamping import ClampedResult, correction_between
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.staged import StagedCorrection, StagedResult

Array = NDArray[np.float64]

ROUNDING = 1e-12  # of packed models that are the same


class _Shim:
    def __init__(self, s):
        self._s = s

    def correct(self, q):
        r = self._s.correct(np.ascontiguousarray(q), np.ones(len(q)))
        object.__setattr__(r, "weak", ~r.whole)
        return r

    def uncorrect(self, q):
        return self._s.uncorrect(q, np.ones(len(q)))

    def rates(self, q, v, a, result):
        return self._s.rates(q, v, a, np.ones(len(q)), np.zeros(len(q)), result)


class DesiredOffset:
    """Corrected less taught joints, as the model and the tool in use want it.

    Attributes
    ----------
    stage : the correction in use; None while nothing is to be corrected.
    known : the same as if it were on: a robot may show it that was corrected before.
    reduced : how many points were corrected in part, as a direction of theirs is weak.
    clamped, passed : how many messages were corrected in part, or not at all, for what bound.
    tcp_shift_m, largest, remaining_m : of the last message: error at the tool that the drift would
        have made, largest offset wanted, error that is left.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm, self._config = reference, config
        self._reference = pack_model(reference)
        self._actual = self._reference
        self.stage: StagedCorrection | None = None
        self.known: StagedCorrection | None = None
        self.reduced = 0
        self.clamped: Counter[Reason] = Counter()
        self.passed: Counter[Reason] = Counter()
        self.tcp_shift_m = self.largest = self.remaining_m = 0.0

    def want(self, actual: SerialArm, on: bool) -> None:
        """Correct for an arm with its tool from the next command on, or for nothing."""
        packed = pack_model(actual)
        if not np.allclose(packed, self._actual, rtol=0.0, atol=ROUNDING):
            self._actual = packed
            same = np.allclose(packed, self._reference, rtol=0.0, atol=ROUNDING)
            self.known = (
                None
                if same
                else _Shim(
                    correction_between(self._reference, packed, packed, self._arm, self._config)
                )
            )
        self.stage = self.known if on else None

    def at(self, q: Array) -> tuple[Array, StagedResult | None]:
        """Wanted offsets (m, n) at taught joints; raises `RefusedError` as the policy says."""
        if self.stage is None:
            self.tcp_shift_m = self.largest = self.remaining_m = 0.0
            return np.zeros_like(q), None
        result = self.stage.correct(q)
        require_solved(result)
        policy = self._config.policy
        if policy is Policy.REFUSE:
            require_within(result, self._config, self._arm)
        elif isinstance(result, ClampedResult) and result.reason is not None:
            if policy is Policy.PASS:
                self.passed[result.reason] += 1
                return np.zeros_like(q), None
            self.clamped[result.reason] += 1
        offset = result.q - q
        self.reduced += int(np.count_nonzero(result.weak))
        self.tcp_shift_m = float(result.arm.tcp_shift_m.max())
        self.largest = float(np.abs(offset).max())
        self.remaining_m = float(result.remaining_m.max())
        return offset, result

    def begins(self, q: Array) -> Array:
        """Offsets (3, n) at taught joints (n,) that a robot may show: wanted, known, none.

        Nothing is counted: the command itself is looked at after its begin.
        """
        rows = np.zeros((3, len(q)))
        for row, stage in zip(rows, (self.stage, self.known), strict=False):
            if stage is not None:
                row[:] = stage.correct(q[None]).q[0] - q
        return rows
