"""Correction of which no more is made than its bounds and the joint limits allow.

With d(q) the whole shift of the joints, the shift made is k(q) d(q), with one share for all
joints:

    k = min(1, b_tool / e_tool, b_j / |d_j|, m_j / (FADES_WITHIN D_j))                        (1)

where e_tool is the drift's error at the tool and b_tool its bound, b_j the bound of joint j, m_j
its distance from the nearer limit, and D_j = b_j max_i |d_i| / b_i. A quotient by |d_j| in place
of D_j would jump where a joint's shift changes its sign at its limit. Every term is continuous
in q wherever d is not zero, so k d is continuous everywhere; and since the last one changes by
at most 1 / FADES_WITHIN per unit of motion, taught joints follow from corrected ones.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.bounds import FADES_FROM, CorrectionConfig, Policy
from robocal_ros.correction.rates import MOST_STEPS, STEP_AHEAD_S, VELOCITY_EXACT
from robocal_ros.correction.refusals import Reason
from robocal_ros.correction.staged import StagedCorrection, StagedResult
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

TINY = 1e-300
FADES_WITHIN = 3.0  # of a joint limit


@dataclass(frozen=True)
class ClampedResult(StagedResult):
    """Corrected joints (m, n), the part that was made of the shift (m,), and what bound it."""

    kept: Array
    reason: Reason | None

    @property
    def whole(self) -> NDArray[np.bool_]:
        """(m,) True where all of the correction was made."""
        return np.asarray(super().whole & (self.kept == 1.0))

    @property
    def remaining_m(self) -> Array:
        """(m,) position error that remains at the tool, at most."""
        shift = self.arm.tcp_shift_m + (0.0 if self.tool is None else self.tool.tcp_shift_m)
        return np.asarray(super().remaining_m + (1.0 - self.kept) * shift)


class ClampedCorrection(StagedCorrection):
    """A `StagedCorrection` that makes as much of the shift as the bounds allow (equation 1)."""

    def __init__(
        self, reference: Array, actual: Array, arm: SerialArm, config: CorrectionConfig
    ) -> None:
        thermal, tool = config.thermal.of_joints(arm), config.tool.of_joints(arm)
        super().__init__(reference, actual, FADES_FROM * thermal, tool, config.free_axis)
        self._thermal, self._joint_bounds = config.thermal, (thermal, tool)
        self._lower, self._upper = arm.lower, arm.upper

    def correct(self, q: Array) -> ClampedResult:
        """Correct joints (m, n)."""
        full = super().correct(q)
        shares = self._shares(q, full)
        worst = min(shares, key=lambda reason: float(np.min(shares[reason])))
        kept = np.minimum(1.0, np.min(list(shares.values()), axis=0))
        part = q + kept[:, None] * (full.q - q)
        made = np.where((kept == 1.0)[:, None], full.q, part)
        reason = worst if np.any(kept < 1.0) else None
        return ClampedResult(made, full.arm, full.tool, kept, reason)

    def uncorrect_one(self, corrected: Array) -> Array:
        """Taught joints (n,) of one point's corrected ones."""
        return np.asarray(self.uncorrect(corrected[None])[0])

    def velocity_one(self, q: Array, velocity: Array, corrected: Array) -> Array:
        """Velocities (n,) of one point's corrected joints."""
        at = q + STEP_AHEAD_S * velocity
        change = self.correct(at[None]).q[0] - at - (corrected - q)
        return np.asarray(velocity + change / STEP_AHEAD_S)

    def taught_velocity_one(self, corrected: Array, velocity: Array, q: Array) -> Array:
        """Velocities (n,) of one point's taught joints, of those of the corrected ones."""
        found, corrected = velocity, self.correct(q[None]).q[0]
        for _ in range(MOST_STEPS):
            miss = velocity - self.velocity_one(q, found, corrected)
            found = found + miss
            if not np.max(np.abs(miss)) > VELOCITY_EXACT:
                break
        return np.asarray(found)

    def _shares(self, q: Array, full: StagedResult) -> dict[Reason, Array]:
        """Largest share (m,) of the shift by each bound; equation 1."""
        arm, (of_arm, of_tool) = full.arm, self._joint_bounds
        at_tool = np.minimum(
            self._thermal.tcp_m / np.maximum(arm.tcp_shift_m, TINY),
            self._thermal.tcp_rad / np.maximum(arm.tcp_rotation_rad, TINY),
        )
        joints = np.min(of_arm / np.maximum(np.abs(arm.joint_shift), TINY), axis=1)
        if full.tool is not None:
            shift = np.maximum(np.abs(full.tool.joint_shift), TINY)
            joints = np.minimum(joints, np.min(of_tool / shift, axis=1))
        bound = of_arm + of_tool
        size = np.max(np.abs(full.q - q) / bound, axis=1)
        room = np.maximum(np.minimum(q - self._lower, self._upper - q), 0.0)
        limit = np.min(room / bound, axis=1) / np.maximum(FADES_WITHIN * size, TINY)
        return {Reason.TCP_BOUND: at_tool, Reason.JOINT_BOUND: joints, Reason.JOINT_LIMIT: limit}


def correction_between(
    reference: Array, actual: Array, arm: SerialArm, config: CorrectionConfig
) -> StagedCorrection:
    """The correction from one model to another that the policy asks for."""
    if config.policy is not Policy.REFUSE:
        return ClampedCorrection(reference, actual, arm, config)
    thermal, tool = config.thermal.of_joints(arm), config.tool.of_joints(arm)
    return StagedCorrection(reference, actual, FADES_FROM * thermal, tool, config.free_axis)
