"""Bounds of the joint correction, and what is checked against them."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.inputs import Reason, RefusedError
from robocal_ros.correction.joint_correction import CorrectionResult, JointCorrection
from robocal_ros.correction.limiter import SLIDING, TURNING, OffsetLimits
from robocal_ros.correction.solution import MOST_STEPS, STEP_AHEAD_S, VELOCITY_EXACT
from robocal_ros.correction.staged import StagedCorrection, StagedResult
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

# What floating point adds to a value that lies on its bound.
ROUNDING = 1e-9
DEGREE = np.pi / 180.0
# Weak directions are damped for this share of the bound: the solution may bend a little beyond
# the first order.
FADES_FROM = 0.8
# What a survey looks at: +-3 sigma of the share are 5 % at most.
POSTURES = 1000
WITHOUT_LIMIT = np.pi  # range of a joint without limits, rad (prismatic: m)


@dataclass(frozen=True)
class ShiftBounds:
    """Largest correction: at the tool (m, rad) and of one joint (rad; prismatic: ``tcp_m``)."""

    tcp_m: float
    tcp_rad: float
    joint_rad: float

    def of_joints(self, arm: SerialArm) -> Array:
        """(n,) largest shift of each joint."""
        return np.where(arm.prismatic, self.tcp_m, self.joint_rad)

    def hold(self, result: CorrectionResult) -> NDArray[np.bool_]:
        """Whether corrections keep within them at the tool."""
        return np.asarray(
            (result.tcp_shift_m <= self.tcp_m + ROUNDING)
            & (result.tcp_rotation_rad <= self.tcp_rad + ROUNDING)
        )


class Policy(StrEnum):
    """What is done with a command whose correction would exceed a bound or a limit."""

    REFUSE = "refuse"
    CLAMP = "clamp"
    PASS = "pass"


@dataclass(frozen=True)
class CorrectionConfig:
    """Settings of a correction session, SI."""

    # Bounds of the arm's drift, and of the tool's change, whose tilt is that of a tip 10 mm aside
    # by a bend 150 mm above it.
    thermal: ShiftBounds = ShiftBounds(1e-3, 0.1 * DEGREE, 0.3 * DEGREE)
    tool: ShiftBounds = ShiftBounds(10e-3, 4.0 * DEGREE, 5.0 * DEGREE)
    turning: OffsetLimits = TURNING  # fastest change of the offset of a joint, by its kind
    sliding: OffsetLimits = SLIDING
    # (n,) rad/s, rad/s^2 (prismatic: m); a stream that ends slows down with the accelerations
    velocity_limits: Array = field(default_factory=lambda: np.array([np.inf]), compare=False)
    acceleration_limits: Array = field(default_factory=lambda: np.array([np.inf]), compare=False)
    # After a pause longer than this, and than two of its periods, a stream goes on only where the
    # robot can be there soon.
    stream_gap_s: float = 0.1
    start_rad: float = 0.02 * DEGREE  # how far from where a command begins the robot may stand
    start_m: float = 5e-5
    joint_state_age_s: float = 0.2  # older readings do not tell where the robot is
    flange_frame: str = "tool0"
    tool_frame: str = ""  # child of an acceptable tool frame; empty: any
    policy: Policy = Policy.REFUSE
    model_age_s: float = 0.0  # a model with an older stamp is not corrected with; 0: any age
    free_axis: bool = False  # the tool may turn about its z
    # Where no serial tells robots of one model apart: of the file that a model or tool must have
    # been made with.
    robot_file_hash: str = ""
    shadow: bool = False

    def start_near(self, arm: SerialArm) -> Array:
        """(n,) how far from where a command begins each joint may stand, rad (prismatic: m)."""
        return np.where(arm.prismatic, self.start_m, self.start_rad)


@dataclass(frozen=True)
class Survey:
    """An arm's correction at the tool over postures that fill its joint range."""

    beyond: float  # share of postures in which it exceeds its bounds
    worst_m: float
    worst_rad: float

    def __str__(self) -> str:
        return (
            f"{self.worst_m * 1e3:.3f} mm and {np.degrees(self.worst_rad):.3f} deg at worst, "
            f"beyond the bounds in {self.beyond:.1%} of the postures"
        )


def survey(reference: SerialArm, actual: SerialArm, bounds: ShiftBounds) -> Survey:
    """Look at the correction in `POSTURES` postures over the joint range, always the same ones."""
    lower = np.where(np.isfinite(reference.lower), reference.lower, -WITHOUT_LIMIT)
    upper = np.where(np.isfinite(reference.upper), reference.upper, WITHOUT_LIMIT)
    q = np.random.default_rng(0).uniform(lower, upper, (POSTURES, reference.n))
    found = JointCorrection.between(reference, actual).correct(q)
    fine = bounds.hold(found)
    return Survey(
        1.0 - float(np.mean(fine)),
        float(np.max(found.tcp_shift_m)),
        float(np.max(found.tcp_rotation_rad)),
    )


def require_within(result: StagedResult, config: CorrectionConfig, arm: SerialArm) -> None:
    """Refuse a correction that is beyond its bounds; names the first point that is.

    Near a singularity the weak direction is corrected in part; what remains is reported.
    """
    drift = result.arm
    bound = config.thermal
    fine = bound.hold(drift)
    if not np.all(fine):
        detail = (
            f"{np.max(drift.tcp_shift_m) * 1e3:.3f} mm and "
            f"{np.degrees(np.max(drift.tcp_rotation_rad)):.3f} deg at most, allowed "
            f"{bound.tcp_m * 1e3:g} mm and {np.degrees(bound.tcp_rad):g} deg"
        )
        _require(fine, Reason.TCP_BOUND, detail)
    _require_joints(drift.joint_shift, bound.of_joints(arm), arm)
    if result.tool is not None:
        _require_joints(result.tool.joint_shift, config.tool.of_joints(arm), arm)


def require_solved(result: StagedResult) -> None:
    """Refuse a point that has no solution near by."""
    solved = result.arm.converged
    if result.tool is not None:
        solved = solved & result.tool.converged
    _require(solved, Reason.NOT_SOLVED, "the pose is at the edge of the reach")


def require_limits(q: Array, arm: SerialArm) -> None:
    """Refuse joints (m, n) beyond the arm's limits, and what is no number."""
    inside = (q >= arm.lower - ROUNDING) & (q <= arm.upper + ROUNDING)
    if not inside.all():
        point, joint = np.argwhere(~inside)[0]
        raise RefusedError(
            Reason.JOINT_LIMIT,
            f"{arm.joint_names[joint]} would be at {q[point, joint]:.6f}, allowed "
            f"{arm.lower[joint]:.6f} to {arm.upper[joint]:.6f} (point {point + 1})",
        )


def _require(fine: NDArray[np.bool_], reason: Reason, detail: str) -> None:
    if not fine.all():
        raise RefusedError(reason, f"{detail} (point {int(np.argmin(fine)) + 1})")


def _require_joints(shift: Array, largest: Array, arm: SerialArm) -> None:
    over = np.abs(shift) > largest + ROUNDING
    if over.any():
        point, joint = np.argwhere(over)[0]
        raise RefusedError(
            Reason.JOINT_BOUND,
            f"{arm.joint_names[joint]} by {shift[point, joint]:.6f}, allowed "
            f"{largest[joint]:.6f} (point {point + 1})",
        )


# ---- correction of which no more is made than its bounds and the joint limits allow -------------
#
# With d(q) the whole shift of the joints, the shift made is k(q) d(q), with one share for all
# joints:
#
#     k = min(1, b_tool / e_tool, b_j / |d_j|, m_j / (FADES_WITHIN D_j))                        (1)
#
# where e_tool is the drift's error at the tool and b_tool its bound, b_j the bound of joint j, m_j
# its distance from the nearer limit, and D_j = b_j max_i |d_i| / b_i. A quotient by |d_j| in place
# of D_j would jump where a joint's shift changes its sign at its limit. Every term is continuous
# in q wherever d is not zero, so k d is continuous everywhere; and since the last one changes by
# at most 1 / FADES_WITHIN per unit of motion, taught joints follow from corrected ones.


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
