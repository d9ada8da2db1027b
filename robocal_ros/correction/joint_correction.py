"""Joint correction between a reference model and the actual one, each with its tool.

Given taught joints q, the corrected joints q' satisfy

    T_actual(q') T_flange_tool_actual = T_reference(q) T_flange_tool_reference          (1)

by Newton steps with the geometric Jacobian at the tool.

Near a singularity the exact q' leaves every bound. There the weak directions alone are given up,
and of the tool's turn before its position. With e the twist that is left at the tool (lengths in
units of 0.3 m), J the Jacobian at q, and (A, B; B^T, C) the blocks of J J^T for position and turn,

    q' = q + J^T y,   e(q') = D y,   D = (P, 0; 0, R),                                    (2)
    P = d(A),  T = (A + P)^-1 B,  L L^T = I + T^T T,
    R = L d(L^-1 (C - B^T T) L^-T) L^T,   d(U S U^T) = U diag(d(s)) U^T,
    d(s) = l^2 (1 - s / (3 l^2))^3 below s = 3 l^2, else exactly 0.

C - B^T A^-1 B is how the joints turn the tool without moving it. So at a wrist singularity the
position stays exact (P = 0), and of the turn one direction is left. A turn w alone is the part w of
the vector (-T w, w) that is as long as L^T w: L makes what is damped comparable with the
eigenvalues of J J^T, so that the damping of a turn is as strong where the position is weak too,
and takes over evenly from that of the position. To first order the shift is
sigma / (sigma^2 + d) times the error along each singular direction. Directions with d = 0 are
corrected exactly. The damping is as strong as the error asks for, that of the position (in P), or
all of it (in R):

    l^2 = |e| hypot(1 / slope, 0.3 |e| / b^2),   |e|^2 = e(q)^2 + (1 um)^2               (3)

so that the shift changes by no more than about ``slope`` per unit of a singular value, for any
size of error (the first term), and two joints that share it keep within their bound b (the
second). Every function here has two continuous derivatives: q' has a bounded slope in q.

A tool that may turn about its z (`free_axis`) leaves five equations: its origin and its axis. The
shift then is the least one (of the form J^T y), and only where these five are weak is less
corrected.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.correction import solution
from robocal_ros.correction.solution import (
    RATE_STEP_S,
    STEP_AHEAD_S,
    work_size,
)
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm

# ---- rates --------------------------------------------------------------------------------------


Array = NDArray[np.float64]


# ---- joint correction between a reference model and the actual one, each with its tool ----------


LARGEST_SHIFT = 1.0
# Of the shift per unit of a singular value: at 60 deg/s of the joints through a wrist singularity
# a drift's correction moves by less than 2 deg/s, with each shipped robot; a tool's, which is
# larger, by more, so that in most postures its turn is corrected too.
DRIFT_SLOPE, TOOL_SLOPE = 1.0 / 60.0, 1.0 / 10.0
SHARED = 0.3  # square of 0.77, the most of sigma l / (sigma^2 + d), over two joints


def pack_model(arm: SerialArm) -> Array:
    """Numbers (n + 2, 9) of an arm with its base and its ``T_flange_tool``, for the kernels."""
    packed = np.zeros((arm.n + 2, 9))
    packed[: arm.n] = arm.links
    for row, T in ((arm.n, arm.T_base_root), (arm.n + 1, arm.T_flange_tool)):
        packed[row, :4] = frames.quat_xyzw(T)
        packed[row, 4:7] = T[:3, 3]
    return packed


def plain(values: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    """The one array type that the kernels are compiled for: contiguous and writable."""
    array = np.asarray(values, dtype=np.float64)
    if shape is not None and array.shape != shape:
        array = np.broadcast_to(array, shape)
    if array.flags.carray:
        return array
    return np.require(array, requirements=["C", "W"])


@dataclass(frozen=True)
class CorrectionResult:
    """Corrected joints with what is left and what was done; scalars for one point, else (m,).

    Attributes
    ----------
    q : (n,) or (m, n) corrected joints, rad (prismatic: m).
    position_error_m, rotation_error_rad : error that remains at the tool; with a free axis,
        here and below, a rotation is that of the axis.
    iterations : Newton steps taken.
    converged : False where the point could not be solved; ``q`` then is the input.
    tcp_shift_m, tcp_rotation_rad : error at the tool without the correction.
    weak : whether a weak direction was given up, in part or in full.
    joint_shift : (n,) or (m, n) corrected less given joints.
    """

    q: Array
    position_error_m: Array
    rotation_error_rad: Array
    iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    tcp_shift_m: Array
    tcp_rotation_rad: Array
    weak: NDArray[np.bool_]
    joint_shift: Array


class JointCorrection:
    """Corrects joints from a reference to an actual model, in either direction.

    Parameters
    ----------
    models : (2, n + 2, 9) packed reference and actual model (see `pack_model`, `between`).
    largest : largest shift of a joint, rad (prismatic: m), for all or (n,) for each; the turning
        joints' least one is b of equation 3.
    free_axis : the tool may turn about its z; the turn is used to move the joints least.
    slope : of equation 3; infinite: the bound alone damps.
    """

    def __init__(
        self,
        models: Array,
        largest: ArrayLike = LARGEST_SHIFT,
        free_axis: bool = False,
        slope: float = np.inf,
    ) -> None:
        self.models = plain(models)
        self.free_axis, self.slope = free_axis, slope
        self.n = self.models.shape[1] - 2
        if self.models.shape != (2, self.n + 2, 9):
            raise ValueError(f"models have shape {self.models.shape}, expected (2, n + 2, 9)")
        self.largest = plain(largest, (self.n,)).copy()
        if not np.all(self.largest > 0.0):
            raise ValueError(f"largest shift must be positive: {self.largest}")
        turning = self.models[1, : self.n, 8] < 0.5
        least = float(np.min(self.largest[turning] if np.any(turning) else self.largest))
        self.work = np.zeros(work_size(self.n))
        solution.prepare(
            self.models, self.largest, 1.0 / slope, SHARED / least**2, free_axis, self.work
        )

    @classmethod
    def between(
        cls,
        reference: SerialArm,
        actual: SerialArm,
        largest: ArrayLike = LARGEST_SHIFT,
        free_axis: bool = False,
        slope: float = np.inf,
    ) -> "JointCorrection":
        """Correction from one arm to another, each with its base and its ``T_flange_tool``."""
        if reference.n != actual.n or np.any(reference.prismatic != actual.prismatic):
            raise ValueError(f"{reference.name} and {actual.name} have different joints")
        models = np.stack([pack_model(reference), pack_model(actual)])
        return cls(models, largest, free_axis, slope)

    def correct(self, q: ArrayLike) -> CorrectionResult:
        """Correct joints (n,) or (m, n).

        A point's result does not depend on its neighbours: a batch gives a single point's bits.
        """
        joints = np.asarray(q, dtype=np.float64)
        points = plain(joints.reshape(-1, self.n))
        out = np.empty((len(points), self.n + solution.REPORT))
        solution.correct_batch(points, self.largest, self.free_axis, self.work, out)
        lead = joints.shape[:-1]
        corrected, report = plain(out[:, : self.n]), out[:, self.n :].T.reshape(-1, *lead)
        return CorrectionResult(
            q=corrected.reshape(joints.shape),
            position_error_m=report[solution.POSITION_ERROR],
            rotation_error_rad=report[solution.ROTATION_ERROR],
            iterations=report[solution.ITERATIONS].astype(np.int64),
            converged=report[solution.CONVERGED] > 0.5,
            tcp_shift_m=report[solution.TCP_SHIFT],
            tcp_rotation_rad=report[solution.TCP_ROTATION],
            weak=report[solution.WEAK] > 0.5,
            joint_shift=(corrected - points).reshape(joints.shape),
        )

    def inverse(self) -> "JointCorrection":
        """The correction with the models exchanged: from corrected to taught joints.

        Exact (to rounding: 1e-11 rad for condition numbers below 1e3) where no direction is weak
        and all six equations hold; `staged.StagedCorrection.uncorrect` in the other postures too.
        """
        return JointCorrection(self.models[::-1], self.largest, self.free_axis, self.slope)


def path_rates(
    corrected: Callable[[Array], Array],
    q: Array,
    velocity: Array,
    acceleration: Array | None,
    here: Array,
) -> tuple[Array, Array]:
    """Rates (m, n) of ``corrected(q)`` along the path q + v t + a t^2 / 2 at t = 0.

    ``here`` (m, n): the shift at q. Central differences of the shift over 0.2 ms each way; without
    accelerations, of which then come none, from one side.
    """
    if acceleration is None:
        ahead = q + velocity * STEP_AHEAD_S
        rate = (corrected(ahead) - ahead - here) / STEP_AHEAD_S
        return velocity + rate, np.zeros_like(q)
    h = RATE_STEP_S
    ends = [q + velocity * t + 0.5 * acceleration * t * t for t in (-h, h)]
    before, after = (corrected(at) - at for at in ends)
    rate = (after - before) / (2.0 * h)
    return velocity + rate, acceleration + (after - 2.0 * here + before) / h**2
