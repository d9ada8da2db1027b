"""The offset that is wanted at a posture, by model, tool and policy; the limiter comes after it."""

from collections import Counter

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.bounds import (
    ClampedResult,
    CorrectionConfig,
    Policy,
    correction_between,
    require_solved,
    require_within,
)
from robocal_ros.correction.inputs import Reason
from robocal_ros.correction.joint_correction import pack_model
from robocal_ros.correction.limiter import (
    FIGURES,
    LARGEST,
    NOT_WITHIN,
    REDUCED,
    REMAINING,
    SHIFT,
    OffsetLimiter,
    put_out,
)
from robocal_ros.correction.staged import StagedCorrection, StagedResult
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

ROUNDING = 1e-12  # of packed models that are the same


class DesiredOffset:
    """Corrected less taught joints, as the model and the tool in use want it.

    Attributes
    ----------
    stage : the correction in use; None while nothing is to be corrected.
    known : the same as if it were on: a robot may show it that was corrected before.
    figures : what is said of the messages, see `limiter`.
    clamped, passed : how many messages were corrected in part, or not at all, for what bound.
    made : whether the last message was corrected with ``stage``.
    fast : whether `put_out` worked out the velocities too.
    """

    def __init__(self, reference: SerialArm, config: CorrectionConfig) -> None:
        self._arm, self._config = reference, config
        self._reference = pack_model(reference)
        self._actual = self._reference
        self.stage: StagedCorrection | None = None
        self.known: StagedCorrection | None = None
        self.figures = np.zeros(FIGURES)
        self.clamped: Counter[Reason] = Counter()
        self.passed: Counter[Reason] = Counter()
        self.made = self.fast = False
        self._zero = np.zeros(reference.n)
        self._span = np.array([reference.lower, reference.upper], dtype=np.float64)
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
        self.made = self.fast = False
        self.figures[[SHIFT, LARGEST, REMAINING]] = 0.0
        if self.stage is None:
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
        self.figures[REDUCED] += np.count_nonzero(result.weak)
        self.figures[SHIFT] = result.arm.tcp_shift_m.max()
        self.figures[LARGEST] = np.abs(offset).max()
        self.figures[REMAINING] = result.remaining_m.max()
        return offset, result

    def put_out(
        self,
        q: Array,
        velocity: Array,
        times: tuple[float, float],
        limiter: OffsetLimiter,
        active: Array,
        speeds: Array,
    ) -> float:
        """Put one target (n,) with its velocities out by the limiter; see `limiter.step_out`.

        In one piece where nothing is out of the ordinary; else raises `RefusedError` as `at`, and
        leaves the velocities to the caller.
        """
        stage, limits, span = self.stage, limiter.limits, self._span
        if stage is not None and self._config.policy is Policy.REFUSE:
            share = stage.step_out(
                q, velocity, *times, limiter.memory, limits, active, speeds, span, self._bounds,
                self._tcp, self.figures,
            )  # fmt: skip
            if share != NOT_WITHIN:
                self.made = self.fast = True
                return share
        desired = self.at(q[None])[0][0] if stage is not None else self._nothing()
        return put_out(limiter.memory, q, desired, *times, limits, active, speeds[0], span)

    def _nothing(self) -> Array:
        self.made = self.fast = False
        self.figures[SHIFT] = self.figures[LARGEST] = self.figures[REMAINING] = 0.0
        return self._zero

    def begins(self, q: Array) -> Array:
        """Offsets (3, n) at taught joints (n,) that a robot may show: wanted, known, none.

        Nothing is counted: the command itself is looked at after its begin.
        """
        rows = np.zeros((3, len(q)))
        for row, stage in zip(rows, (self.stage, self.known), strict=False):
            if stage is not None:
                row[:] = stage.correct(q[None]).q[0] - q
        return rows
