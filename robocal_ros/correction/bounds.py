"""Bounds of the joint correction, and what is checked against them."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.joint_correction import CorrectionResult, JointCorrection
from robocal_ros.correction.limiter import SLIDING, TURNING, OffsetLimits
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.staged import StagedResult
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
