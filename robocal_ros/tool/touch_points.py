"""A tool frame from touches of one point (four or more) and two straight moves (seven)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.estimation.descent import Problem
from robocal_ros.estimation.estimation import Estimate, observability, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, RankDeficientError, TooFewSamplesError

Array = NDArray[np.float64]
EulerConvention = Literal["zxz", "zyx", "zyz"]

FEWEST_TOUCHES = 4
SHORTEST_MOVE_M = 1e-2
LARGEST_RESIDUAL_M = 1e-3  # rms: the methods' class is 0.5 mm
SMALLEST_ANGLE_RAD = float(np.radians(45.0))
NAMES = ("tip_x", "tip_y", "tip_z", "point_x", "point_y", "point_z")
LEAST_SPREAD = 0.05  # smallest over largest singular value: orientations too much alike


def pose_from_euler(xyz: ArrayLike, angles_rad: ArrayLike, convention: EulerConvention) -> Array:
    """T_base_flange (..., 4, 4) of controller poses: (..., 3) m and (..., 3) rad, moving axes.

    ``zxz`` thesis eq. 4-3; ``zyx`` KUKA A, B, C; ``zyz`` Kawasaki O, A, T.
    """
    from scipy.spatial.transform import Rotation

    angles = np.array(angles_rad, dtype=np.float64)
    R = Rotation.from_euler(convention.upper(), angles.reshape(-1, 3)).as_matrix()
    return frames.transform(R.reshape(*angles.shape[:-1], 3, 3), xyz)


@dataclass(frozen=True)
class _TouchProblem:
    """``R_i tip + t_i - point = 0`` over the tip in the flange and the point in base."""

    T: Array
    sigma_m: float
    names: tuple[str, ...] = NAMES
    scale_components: int = 3

    def deviation(self, state: Array) -> Array:
        return np.zeros(6)

    def retract(self, state: Array, step: Array) -> Array:
        return np.asarray(state + step)

    def linearise(self, state: Array) -> tuple[Array, Array]:
        R = self.T[:, :3, :3]
        J = np.concatenate([R, -np.broadcast_to(np.eye(3), R.shape)], axis=2)
        residual = R @ state[:3] + self.T[:, :3, 3] - state[3:]
        return residual / self.sigma_m, J / self.sigma_m


@dataclass(frozen=True, eq=False)
class TouchFit:
    """A touched tool.

    Attributes
    ----------
    tip : (3,) flange frame, m; ``covariance`` (3, 3), m^2.
    point : (3,) the touched point, base, m.
    rotation : R_flange_tool (3, 3) of seven points; None of four.
    residual : (m, 3) of the touches, base, m.
    """

    tip: Array
    covariance: Array
    point: Array
    rotation: Array | None
    residual: Array
    estimate: Estimate[Array]

    @property
    def rms_m(self) -> float:
        """Rms distance of the touches from their point."""
        return float(np.sqrt(np.mean(np.sum(self.residual**2, axis=1))))

    @property
    def verdict(self) -> Verdict:
        """Whether the touches agree."""
        largest = float(np.max(np.linalg.norm(self.residual, axis=1)))
        words = f"touches within {self.rms_m * 1e3:.3f} mm rms, {largest * 1e3:.3f} mm at most"
        if self.rms_m > LARGEST_RESIDUAL_M:
            return Verdict(
                Code.RESIDUAL_TOO_LARGE,
                f"{words} (allowed {LARGEST_RESIDUAL_M * 1e3:.1f} mm rms): touch again, and check "
                "units and the Euler convention of the poses",
            )
        return Verdict(Code.ACCEPT, words)


def fit_four(T_base_flange: Array, sigma_m: float | None = None) -> TouchFit:
    """Tip from poses (m >= 4, 4, 4) that all touch one point: least squares over all touches.

    ``sigma_m`` of one touch; None where it is to be estimated from the residuals.

    Raises
    ------
    TooFewSamplesError
        Fewer than four touches.
    RankDeficientError
        When the flange was turned about one axis only (rank 5 of 6), or hardly at all.
    """
    count = len(T_base_flange)
    if count < FEWEST_TOUCHES:
        raise TooFewSamplesError(f"{count} touches: at least {FEWEST_TOUCHES} are needed")
    problem: Problem[Array] = _TouchProblem(T_base_flange, sigma_m or 1.0)
    rows = problem.linearise(np.zeros(6))[1].reshape(-1, 6)
    seen = observability(rows)
    if seen.rank < 6 or 1.0 / seen.condition < LEAST_SPREAD:
        raise RankDeficientError(
            f"the touches determine {seen.rank} of 6 unknowns well (condition "
            f"{seen.condition:.3g}): turn the flange about a second axis, by 30 deg or more",
            ("tip along the axis of rotation",),
        )
    right = -problem.linearise(np.zeros(6))[0].ravel()
    start: Array = np.asarray(np.linalg.lstsq(rows, right, rcond=None)[0], dtype=np.float64)
    found = solve(
        problem, start, noise_known=sigma_m is not None, robust=count > FEWEST_TOUCHES + 2
    )
    R, t = T_base_flange[:, :3, :3], T_base_flange[:, :3, 3]
    tip, point = found.state[:3], found.state[3:]
    return TouchFit(tip, found.covariance[:3, :3], point, None, R @ tip + t - point, found)


def fit_seven(T_base_flange: Array, sigma_m: float | None = None) -> TouchFit:
    """Tip from the first poses, orientation from the last three (m >= 7, 4, 4).

    At the last three the tool is aligned with the base and moves without turning: from P5 to P6
    along its x, from P6 to P7 along its z. With both in base, y = z x x, orthonormalised, and
    ``R_flange_tool = R_base_flange^T [x y z]``.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `fit_four`; when the moves are short or nearly parallel.
    InputError
        When the flange turned between the last three.
    """
    touches = fit_four(T_base_flange[:-3], sigma_m)
    last = T_base_flange[-3:]
    turned = np.linalg.norm(frames.log_rotation(last[1:, :3, :3] @ last[0, :3, :3].T), axis=1)
    if turned.max() > 1e-3:
        raise InputError(
            f"the flange turned by {np.degrees(turned.max()):.3f} deg between the last three "
            "poses: move in a straight line without turning"
        )
    x, z = np.diff(last[:, :3, 3], axis=0)
    shortest = float(min(np.linalg.norm(x), np.linalg.norm(z)))
    if shortest < SHORTEST_MOVE_M:
        raise RankDeficientError(
            f"a move of {shortest * 1e3:.1f} mm gives no direction: move by "
            f"{SHORTEST_MOVE_M * 1e3:.0f} mm or more",
            ("axes of the tool",),
        )
    x, z = x / np.linalg.norm(x), z / np.linalg.norm(z)
    if np.linalg.norm(np.cross(x, z)) < np.sin(SMALLEST_ANGLE_RAD):
        raise RankDeficientError("the two moves are nearly parallel", ("turn about the tool axis",))
    axes = frames.nearest_rotation(np.column_stack([x, np.cross(z, x), z]))
    rotation = last[0, :3, :3].T @ axes
    return TouchFit(
        touches.tip, touches.covariance, touches.point, rotation, touches.residual, touches.estimate
    )
