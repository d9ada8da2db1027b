"""Joint correction between a reference model and the actual one, each with its tool.

Given taught joints q, the corrected joints q' satisfy

    T_actual(q') T_flange_tool_actual = T_reference(q) T_flange_tool_reference          (1)

by Newton steps with the geometric Jacobian at the tool.

Near a singularity the exact q' leaves every bound. There only a share of the correction is made:
with x = J^-1 e the first Newton step and b the largest allowed shift of each joint,

    share = min(1, 1 / max_j(|x_j| / b_j)^2)                                             (2)

and (1) is solved exactly for the pose that lies this share of the way from the uncorrected to
the taught one. So the shift stays within about b, is continuous in q through the singularity
(where it is zero), and the remaining error is (1 - share) times the uncorrected one: never more
than without correction.

A tool that may turn about its z (`free_axis`) leaves five equations: its origin and its axis. The
turn is then the one that moves the joints least, and only where these five are singular is less
corrected.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.core import frames
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction import kernels, solution
from robocal_ros.correction.room import work_size

Array = NDArray[np.float64]

LARGEST_SHIFT = 1.0
RATE_STEP_S = 1e-3


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


def blend_models(start: Array, end: Array, s: float) -> Array:
    """Packed model between two: ``start`` at s = 0, ``end`` at 1, exactly.

    Lengths and joint offsets vary linearly, rotations along the chord between the two.
    """
    out = np.empty_like(start)
    kernels.blend(start, end, float(s), out)
    return out


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
    share : part of the correction that was made; below 1 only near a singularity.
    joint_shift : (n,) or (m, n) corrected less given joints.
    """

    q: Array
    position_error_m: Array
    rotation_error_rad: Array
    iterations: NDArray[np.int64]
    converged: NDArray[np.bool_]
    tcp_shift_m: Array
    tcp_rotation_rad: Array
    share: Array
    joint_shift: Array


class JointCorrection:
    """Corrects joints from a reference to an actual model, in either direction.

    Parameters
    ----------
    models : (4, n + 2, 9) packed reference and actual model, each at the start and at the end
        of a blend (see `pack_model`, `between`).
    largest : largest shift of a joint, rad (prismatic: m), for all or (n,) for each: bounds what
        is done near a singularity, see equation 2.
    free_axis : the tool may turn about its z; the turn is used to move the joints least.
    """

    def __init__(
        self, models: Array, largest: ArrayLike = LARGEST_SHIFT, free_axis: bool = False
    ) -> None:
        self.models = plain(models)
        self.free_axis = free_axis
        self.n = self.models.shape[1] - 2
        if self.models.shape != (4, self.n + 2, 9):
            raise ValueError(f"models have shape {self.models.shape}, expected (4, n + 2, 9)")
        self.largest = plain(largest, (self.n,)).copy()
        if not np.all(self.largest > 0.0):
            raise ValueError(f"largest shift must be positive: {self.largest}")
        self._work = np.empty(work_size(self.n))
        self._inverse: JointCorrection | None = None  # made once, for a stream of readings

    @classmethod
    def between(
        cls,
        reference: SerialArm,
        actual: SerialArm,
        largest: ArrayLike = LARGEST_SHIFT,
        free_axis: bool = False,
    ) -> "JointCorrection":
        """Correction from one arm to another, each with its base and its ``T_flange_tool``."""
        if reference.n != actual.n or np.any(reference.prismatic != actual.prismatic):
            raise ValueError(f"{reference.name} and {actual.name} have different joints")
        first, second = pack_model(reference), pack_model(actual)
        return cls(np.stack([first, first, second, second]), largest, free_axis)

    def correct(self, q: ArrayLike, s: ArrayLike = 1.0) -> CorrectionResult:
        """Correct joints (n,) or (m, n), at blend s (one, or one per point).

        A point's result does not depend on its neighbours: a batch gives a single point's bits.
        """
        joints = np.asarray(q, dtype=np.float64)
        points = plain(joints.reshape(-1, self.n))
        out = np.empty((len(points), self.n + solution.REPORT))
        blends = plain(s, (len(points),))
        solution.correct_batch(
            points, self.models, blends, self.largest, self.free_axis, self._work, out
        )
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
            share=report[solution.SHARE],
            joint_shift=(corrected - points).reshape(joints.shape),
        )

    def inverse(self) -> "JointCorrection":
        """The correction with the models exchanged: from corrected to taught joints.

        Exact (to 1e-12 rad for condition numbers below 1e3) where the share is 1, all six
        equations hold and no singularity lies within the shift (beyond it stands the mirrored
        posture); with a free axis it chooses another turn, which differs by the second order of
        the shift. `staged.StagedCorrection.uncorrect` refines both.
        """
        if self._inverse is None:
            self._inverse = JointCorrection(self.models[[2, 3, 0, 1]], self.largest, self.free_axis)
        return self._inverse


def path_rates(
    corrected: Callable[[Array, float], Array], q: Array, velocity: Array, acceleration: Array
) -> tuple[Array, Array]:
    """Rates (m, n) of ``corrected(q, t)`` along the path q + v t + a t^2 / 2 at t = 0.

    Central differences of the shift over 1 ms each way.
    """
    h = RATE_STEP_S
    shift = []
    for t in (-h, 0.0, h):
        at = q + velocity * t + 0.5 * acceleration * t * t
        shift.append(corrected(at, t) - at)
    before, here, after = shift
    rate = (after - before) / (2.0 * h)
    return velocity + rate, acceleration + (after - 2.0 * here + before) / h**2
