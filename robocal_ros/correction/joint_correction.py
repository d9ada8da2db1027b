# SPDX-License-Identifier: Apache-2.0
"""Joint correction between a reference model and the actual one, each with its tool.

Given taught joints q, the corrected joints q' satisfy

    T_actual(q') T_flange_tool_actual = T_reference(q) T_flange_tool_reference          (1)

by Newton steps with the geometric Jacobian at the tool. Where joints have functions of their own,
or wind under load (`kinematics.joint_functions`), q and q' here are what rigid arms would read;
what the joints do besides is put on before and taken off behind, joint by joint.

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

`StagedCorrection` corrects the arm's drift and the tool's change, each within its own bounds. First
the drifted arm is put where the reference arm was, with the taught tool; then the new tool
where the taught one is. Together this is the correction from (reference arm, taught tool) to
(actual arm, new tool), but a bent tool's larger bounds do not loosen the arm's.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.correction import damping, solution
from robocal_ros.correction.solution import RATE_STEP_S, STEP_AHEAD_S, work_size
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm

LARGEST_SHIFT = 1.0
# Of the shift per unit of a singular value: a tool's, which is larger, by more, so that in most
# postures its turn is corrected too. A drift below the number in the second line (0.24 mm, in units
# of `damping.LENGTH`) is given up sooner, by so much, as little is lost: see `_drift_slope`.
DRIFT_SLOPE, TOOL_SLOPE = 1.0 / 60.0, 1.0 / 10.0
LITTLE_DRIFT, SLOWER = 8e-4, 5.0
POSTURES, RANGE = 200, 2.0  # in which a drift is looked at, rad (prismatic: m)
SHARED = 0.3  # square of 0.77, the most of sigma l / (sigma^2 + d), over two joints


def pack_model(arm: SerialArm) -> Array:
    """Numbers (n + 2, 9 + w) of an arm with its base and its ``T_flange_tool``, for the kernels.

    w columns hold its joint functions; 0 where it has none.
    """
    width = 0 if arm.functions is None else arm.layer.shape[1]
    packed = np.zeros((arm.n + 2, 9 + width))
    packed[: arm.n, :9] = arm.links
    if width:
        packed[: arm.n + 1, 9:] = arm.layer
    for row, T in ((arm.n, arm.T_base_root), (arm.n + 1, arm.T_flange_tool)):
        packed[row, :4] = frames.quat_xyzw(T)
        packed[row, 4:7] = T[:3, 3]
    return packed


def stack_models(*packed: Array) -> Array:
    """Packed models in one array; those with fewer coefficients, or none, get zeros."""
    width = max(model.shape[1] for model in packed)
    return np.stack([np.pad(model, ((0, 0), (0, width - model.shape[1]))) for model in packed])


def same_models(a: Array, b: Array, within: float) -> bool:
    """Whether packed models are the same to so much."""
    one, other = stack_models(a, b)
    return np.allclose(one, other, rtol=0.0, atol=within)


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

    With a free axis a rotation is that of the axis.
    """

    q: Array  # (n,) or (m, n) corrected joints, rad (prismatic: m)
    position_error_m: Array  # that remains at the tool
    rotation_error_rad: Array
    iterations: NDArray[np.int64]  # Newton steps taken
    converged: NDArray[np.bool_]  # False where there is no solution; ``q`` then is the input
    tcp_shift_m: Array  # error at the tool without the correction
    tcp_rotation_rad: Array
    weak: NDArray[np.bool_]  # whether a weak direction was given up, in part or in full
    joint_shift: Array  # (n,) or (m, n) corrected less given joints


class JointCorrection:
    """Corrects joints from a reference to an actual model, in either direction.

    ``models`` (2, n + 2, 9 + w): packed reference and actual model (see `pack_model`,
    `stack_models`).
    ``largest``: largest shift of a joint, rad (prismatic: m), for all or (n,) for each; the turning
    joints' least one is b of equation 3.
    ``free_axis``: the tool may turn about its z; the turn is used to move the joints least.
    ``slope``: of equation 3; infinite: the bound alone damps.
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
        width = self.models.shape[2] - 9
        if len(self.models) != 2 or width < 0:
            raise ValueError(f"models have shape {self.models.shape}, expected (2, n + 2, 9 + w)")
        self.largest = plain(largest, (self.n,)).copy()
        if not np.all(self.largest > 0.0):
            raise ValueError(f"largest shift must be positive: {self.largest}")
        turning = self.models[1, : self.n, 8] < 0.5
        least = float(np.min(self.largest[turning] if np.any(turning) else self.largest))
        self.work = np.zeros(work_size(self.n, width))
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
        models = stack_models(pack_model(reference), pack_model(actual))
        return cls(models, largest, free_axis, slope)

    def correct(self, q: ArrayLike) -> CorrectionResult:
        """Correct joints (n,) or (m, n).

        A point's result does not depend on its neighbours: a batch gives a single point's bits.
        """
        joints = np.asarray(q, dtype=np.float64)
        points = plain(joints.reshape(-1, self.n))
        out = np.empty((len(points), self.n + damping.REPORT))
        solution.correct_batch(points, self.largest, self.free_axis, self.work, out)
        lead = joints.shape[:-1]
        corrected, report = plain(out[:, : self.n]), out[:, self.n :].T.reshape(-1, *lead)
        return CorrectionResult(
            q=corrected.reshape(joints.shape),
            position_error_m=report[damping.POSITION_ERROR],
            rotation_error_rad=report[damping.ROTATION_ERROR],
            iterations=report[damping.ITERATIONS].astype(np.int64),
            converged=report[damping.CONVERGED] > 0.5,
            tcp_shift_m=report[damping.TCP_SHIFT],
            tcp_rotation_rad=report[damping.TCP_ROTATION],
            weak=report[damping.WEAK] > 0.5,
            joint_shift=(corrected - points).reshape(joints.shape),
        )

    def inverse(self) -> "JointCorrection":
        """The correction with the models exchanged: from corrected to taught joints.

        Exact (to rounding: 1e-11 rad for condition numbers below 1e3) where no direction is weak
        and all six equations hold; `StagedCorrection.uncorrect` in the other postures too.
        """
        return JointCorrection(self.models[::-1], self.largest, self.free_axis, self.slope)


EXACT = 1e-13  # rad, m: to rounding
MOST_STEPS = 100


@dataclass(frozen=True)
class StagedResult:
    """Corrected joints (m, n), and the two corrections; ``tool`` is None for the taught tool."""

    q: Array
    arm: CorrectionResult
    tool: CorrectionResult | None

    @property
    def parts(self) -> tuple[CorrectionResult, ...]:
        """Those that were made."""
        return (self.arm,) if self.tool is None else (self.arm, self.tool)

    @property
    def converged(self) -> NDArray[np.bool_]:
        """(m,) False where there is no solution."""
        return np.all([part.converged for part in self.parts], axis=0)

    @property
    def weak(self) -> NDArray[np.bool_]:
        """(m,) True where a weak direction was given up, in part or in full."""
        return np.any([part.weak for part in self.parts], axis=0)

    @property
    def whole(self) -> NDArray[np.bool_]:
        """(m,) True where all of the correction was made."""
        return self.converged & ~self.weak

    @property
    def remaining_m(self) -> Array:
        """(m,) position error that remains at the tool, at most."""
        return np.sum([part.position_error_m for part in self.parts], axis=0)


def _drift_slope(models: Array) -> float:
    """The slope of equation 3 for a drift of the arm (2, n + 2, 9 + w), by its size.

    At 60 deg/s of the joints through a wrist singularity the correction of one of up to 0.12 mm
    moves by less than 2 deg/s, with each shipped robot (`bench/correction.py`); one of 0.5 mm,
    whose turn would be missed, is corrected in more postures.
    """
    n = models.shape[1] - 2
    q = np.random.default_rng(0).uniform(-RANGE, RANGE, (POSTURES, n))
    found = JointCorrection(models).correct(q)
    size = np.hypot(found.tcp_shift_m * damping.WEIGHT, found.tcp_rotation_rad).max()
    return float(DRIFT_SLOPE / (1.0 + (SLOWER - 1.0) / (1.0 + (size / LITTLE_DRIFT) ** 4)))


class StagedCorrection:
    """Correction from a reference model to an actual one, in 1 stage, or 2 with a changed tool.

    ``reference``, ``actual``: packed models (n + 2, 9 + w), see `pack_model`. The taught tool is
    the reference's.
    ``arm_largest``, ``tool_largest`` (n,): largest joint shift of each stage, rad (prismatic: m).
    ``free_axis``: the tool may turn about its z, in both stages.
    ``works``, ``largest``, ``reports``: of its stages, for kernels.
    """

    def __init__(
        self,
        reference: Array,
        actual: Array,
        arm_largest: Array,
        tool_largest: Array,
        free_axis: bool = False,
    ) -> None:
        reference, actual = stack_models(reference, actual)
        bare = actual.copy()
        bare[-1] = reference[-1]
        self.n, self.free_axis = len(reference) - 2, free_axis
        drift, tool = np.stack([reference, bare]), np.stack([bare, actual])
        self._parts = [JointCorrection(drift, arm_largest, free_axis, _drift_slope(drift))]
        if not np.array_equal(actual[-1], reference[-1]):
            self._parts.append(JointCorrection(tool, tool_largest, free_axis, TOOL_SLOPE))
        self.works = np.stack([part.work for part in self._parts])
        self.largest = np.stack([part.largest for part in self._parts])
        self.reports = np.empty((2, len(self._parts), self.n + damping.REPORT))
        self._spare = np.empty((3, self.n))
        self._back = [part.inverse() for part in reversed(self._parts)]
        self._back_works = np.stack([part.work for part in self._back])

    def correct(self, q: Array) -> StagedResult:
        """Correct joints (m, n)."""
        arm = self._parts[0].correct(q)
        if len(self._parts) == 1:
            return StagedResult(arm.q, arm, None)
        tool = self._parts[1].correct(arm.q)
        return StagedResult(tool.q, arm, tool)

    def uncorrect_one(self, corrected: Array) -> Array:
        """`uncorrect` for one point (n,), for a stream."""
        q = np.empty(self.n)
        given = self.largest, self.free_axis, self.works, 20, EXACT, self.reports[0], q
        if solution.uncorrect_staged(corrected, *given):
            return q
        return np.asarray(self.uncorrect(corrected[None])[0])

    def taught_velocity_one(self, corrected: Array, velocity: Array, q: Array) -> Array:
        """Velocities (n,) of one point's taught joints ``q``, of those of the corrected ones."""
        found = np.empty(self.n)
        solution.taught_velocity(
            corrected, velocity, q, self.largest, self.free_axis, self.works, self._back_works,
            self.reports[0], self._spare, found,
        )  # fmt: skip
        return found

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
        six joints is made; with a weak direction, a free axis, joint functions or other numbers of
        joints, by central differences along the path, which the two continuous derivatives of
        the correction allow everywhere.
        """
        out_v, out_a = np.empty(q.shape), np.empty(q.shape)
        rough = np.ones(len(q), dtype=np.bool_)
        if self.n == 6 and not self.free_axis:
            points, qd = plain(q), plain(velocity)
            qdd = np.zeros_like(points) if acceleration is None else plain(acceleration)
            solution.rates_batch(
                points, qd, qdd, plain(result.q), self.works[0], self.works[-1], out_v, out_a
            )
            rough = ~(result.whole & np.isfinite(out_v).all(axis=1))
        if np.any(rough):
            bends = None if acceleration is None else acceleration[rough]
            out_v[rough], out_a[rough] = self._path_rates(
                q[rough], velocity[rough], bends, (result.q - q)[rough]
            )
        return out_v, out_a

    def _path_rates(
        self, q: Array, velocity: Array, acceleration: Array | None, shift: Array
    ) -> tuple[Array, Array]:
        """Rates (m, n) along the path q + v t + a t^2 / 2, on which the ``shift`` is that at t = 0.

        Central differences over 0.2 ms each way; without accelerations, of which then come none,
        from one side.
        """
        if acceleration is None:
            ahead = q + velocity * STEP_AHEAD_S
            rate = (self.correct(ahead).q - ahead - shift) / STEP_AHEAD_S
            return velocity + rate, np.zeros_like(q)
        h = RATE_STEP_S
        ends = [q + velocity * t + 0.5 * acceleration * t * t for t in (-h, h)]
        before, after = (self.correct(at).q - at for at in ends)
        rate = (after - before) / (2.0 * h)
        return velocity + rate, acceleration + (after - 2.0 * shift + before) / h**2
