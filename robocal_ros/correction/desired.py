"""The offset that is wanted at a posture, by model, tool and policy; the limiter comes after it."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction import rates, solution
from robocal_ros.correction.bounds import CorrectionConfig, Policy, require_solved, require_within
from robocal_ros.correction.clamping import ClampedResult, correction_between
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.staged import StagedCorrection, StagedResult

Array = NDArray[np.float64]

ROUNDING = 1e-12  # of packed models that are the same


class DesiredOffset:
    """Corrected less taught joints, as the model and the tool in use want it.

    Attributes
    ----------
    stage : the correction in use; None while nothing is to be corrected.
    known : the same as if it were on: a robot may show it that was corrected before.
    reduced : how many points were corrected in part, as a direction of theirs is weak.
    clamped, passed : how many messages were corrected in part, or not at all, for what bound.
    made, whole : whether the last message was corrected with ``stage``, and all of it by `at_one`.
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
        self.made = self.whole = False
        self._zero, self._out = np.zeros(reference.n), np.zeros((2, reference.n + solution.REPORT))
        bounds = config.thermal.of_joints(reference), config.tool.of_joints(reference)
        self._bounds = np.array(bounds, dtype=np.float64)
        self._tcp = np.array([config.thermal.tcp_m, config.thermal.tcp_rad])

    def want(self, actual: SerialArm, on: bool) -> None:
        """Correct for an arm with its tool from the next command on, or for nothing."""
        packed = pack_model(actual)
        if not np.allclose(packed, self._actual, rtol=0.0, atol=ROUNDING):
            self._actual = packed
            same = np.allclose(packed, self._reference, rtol=0.0, atol=ROUNDING)
            self.known = None
            if not same:
                self.known = correction_between(self._reference, packed, self._arm, self._config)
        self.stage = self.known if on else None

    def at(self, q: Array) -> tuple[Array, StagedResult | None]:
        """Wanted offsets (m, n) at taught joints; raises `RefusedError` as the policy says."""
        self.made = self.whole = False
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
        offset, self.made = result.q - q, True
        self.reduced += int(np.count_nonzero(result.weak))
        self.tcp_shift_m = float(result.arm.tcp_shift_m.max())
        self.largest = float(np.abs(offset).max())
        self.remaining_m = float(result.remaining_m.max())
        return offset, result

    def at_one(self, q: Array) -> Array:
        """`at` for one point (n,), fast where nothing is out of the ordinary; not kept."""
        stage, n = self.stage, len(q)
        self.made, self.whole = stage is not None, False
        if stage is None:
            self.tcp_shift_m = self.largest = self.remaining_m = 0.0
            return self._zero
        if self._config.policy is not Policy.REFUSE:
            return np.asarray(self.at(q[None])[0][0])
        out, offset = self._out[: stage.stages], np.empty(n)
        stage.correct_one(q, out)
        if not rates.within(q, out, self._bounds, self._tcp, offset):
            return np.asarray(self.at(q[None])[0][0])
        report = out[:, n:].tolist()  # for so few numbers lists are faster
        self.whole = all(row[solution.WEAK] == 0.0 for row in report)
        self.reduced += not self.whole
        self.tcp_shift_m = report[0][solution.TCP_SHIFT]
        self.largest = max(map(abs, offset.tolist()))
        self.remaining_m = sum(row[solution.POSITION_ERROR] for row in report)
        return offset

    def begins(self, q: Array) -> Array:
        """Offsets (3, n) at taught joints (n,) that a robot may show: wanted, known, none.

        Nothing is counted: the command itself is looked at after its begin.
        """
        rows = np.zeros((3, len(q)))
        for row, stage in zip(rows, (self.stage, self.known), strict=False):
            if stage is not None:
                row[:] = stage.correct(q[None]).q[0] - q
        return rows
