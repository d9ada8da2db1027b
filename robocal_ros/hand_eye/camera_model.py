"""The model of a hand-eye calibration, as the estimators take it."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.camera_kernels import advance, compare, differentiate, predict, whiten

# ---- pairs of a robot's pose and of what a camera (or a tracker) saw from there -----------------


Array = NDArray[np.float64]
_NEARLY_BACK = -0.9
Mount = Literal["in-hand", "to-hand"]


@dataclass(frozen=True, eq=False)
class Shared:
    """Errors common to all board poses, such as those of the intrinsics.

    Attributes
    ----------
    sensitivity : (m, 6, s) of each board pose (position and turn along the camera's axes).
    covariance : (s, s) of the common errors before anything was seen.
    """

    sensitivity: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class PosePairs:
    """What a hand-eye calibration starts from.

    ``in-hand``: the camera is on the flange, the board stands still; unknown are
    X = T_flange_camera and Z = T_base_board with T_base_flange X T_camera_board = Z.
    ``to-hand``: the camera stands still, the board is on the flange; X = T_base_camera and
    Z = T_flange_board with X T_camera_board = T_base_flange Z.

    Attributes
    ----------
    T_base_flange, T_camera_board : (m, 4, 4).
    names : (m,) of the samples.
    covariance : (m, 6, 6) of T_camera_board, m and rad: of its position, and of its turn, both
        along the camera's axes; None where it is not known.
    time_s : (m,) of the samples of a stream, increasing; None of single shots.
    """

    T_base_flange: Array
    T_camera_board: Array
    names: tuple[str, ...]
    mount: Mount = "in-hand"
    covariance: Array | None = None
    shared: Shared | None = None
    time_s: Array | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def T_boardside_cameraside(self) -> Array:
        """The camera's parent in the board's (m, 4, 4): T_base_flange in hand, its inverse to hand.

        With it, T_boardside_cameraside X T_camera_board = Z either way.
        """
        return self.T_base_flange if self.mount == "in-hand" else frames.invert(self.T_base_flange)

    @cached_property
    def for_kernels(self) -> tuple[Array, Array]:
        """``T_boardside_cameraside`` and ``T_camera_board``, as kernels take them."""
        return plain(self.T_boardside_cameraside), plain(self.T_camera_board)

    @property
    def distance_m(self) -> float:
        """Mean distance of the board from the camera."""
        return float(np.mean(np.linalg.norm(self.T_camera_board[:, :3, 3], axis=1)))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "PosePairs":
        """Some of the pairs."""
        index = np.arange(len(self))[rows]
        return replace(
            self,
            T_base_flange=self.T_base_flange[index],
            T_camera_board=self.T_camera_board[index],
            names=tuple(self.names[i] for i in index),
            covariance=None if self.covariance is None else self.covariance[index],
            time_s=None if self.time_s is None else self.time_s[index],
            shared=None
            if self.shared is None
            else replace(self.shared, sensitivity=self.shared.sensitivity[index]),
        )


@dataclass(frozen=True, eq=False)
class Placement:
    """Both unknowns: ``X`` of the camera and ``Z`` of the board (see `PosePairs`), (4, 4)."""

    X: Array
    Z: Array


def predicted(pairs: PosePairs, at: Placement) -> Array:
    """T_camera_board (m, 4, 4) as the robot's poses have it."""
    carrier, _ = pairs.for_kernels
    T = np.empty_like(carrier)
    predict(carrier, plain(at.X), plain(at.Z), T)
    return T


def differences(predicted_T: Array, pairs: PosePairs) -> Array:
    """Difference (m, 6) of predicted from seen board poses: position and turn, camera axes."""
    _, seen = pairs.for_kernels
    miss = np.empty((len(seen), 6))
    if compare(plain(predicted_T), seen, miss) < _NEARLY_BACK:
        turn = predicted_T[:, :3, :3] @ np.swapaxes(seen[:, :3, :3], 1, 2)
        miss[:, 3:] = frames.log_rotation(turn)
    return miss


def plain(values: Array) -> Array:
    """As kernels take it: in one piece, and not read-only, which would be another type to them."""
    return np.require(values, np.float64, ("C", "W"))


def levers(pairs: PosePairs, X: Array) -> Array:
    """From the flange's origin to the board (m, 3), camera axes: what a tilt error acts on."""
    carrier = frames.invert(X)  # T_camera_carrier
    if pairs.mount == "in-hand":
        return np.asarray(pairs.T_camera_board[:, :3, 3] - carrier[:3, 3])
    flange = pairs.T_base_flange[:, :3, 3] @ carrier[:3, :3].T + carrier[:3, 3]
    return np.asarray(pairs.T_camera_board[:, :3, 3] - flange)


# ---- the model of a hand-eye calibration, as the estimators take it -----------------------------


_AXES = ("x", "y", "z")
NAMES = (
    *(f"camera_{axis}" for axis in _AXES),
    *(f"camera_turn_{axis}" for axis in _AXES),
    *(f"board_{axis}" for axis in _AXES),
    *(f"board_turn_{axis}" for axis in _AXES),
)


@dataclass(frozen=True, eq=False)
class PairState:
    """A placement, and the errors (s,) common to all board poses."""

    at: Placement
    common: Array

    def after(self, step: Array) -> "PairState":
        """The state after increments (12 + s,), as of `linearised`."""
        X, Z = np.empty((4, 4)), np.empty((4, 4))
        advance(plain(self.at.X), step[:6], X)
        advance(plain(self.at.Z), step[6:12], Z)
        return PairState(Placement(X, Z), self.common + step[12:])


def linearised(pairs: PosePairs, state: PairState) -> tuple[Array, Array]:
    """Differences (m, 6), camera axes, m and rad, and their Jacobian (m, 6, 12 + s).

    Increments (v, w) of X along the camera's axes and of Z along the board's, then the errors
    common to all.
    """
    T = predicted(pairs, state.at)
    miss = differences(T, pairs)
    J = np.zeros((len(pairs), 6, 12 + len(state.common)))
    differentiate(T, miss, J)
    if pairs.shared is not None:
        J[:, :, 12:] = -pairs.shared.sensitivity
        miss = miss - pairs.shared.sensitivity @ state.common
    return miss, J


@dataclass(frozen=True, eq=False)
class PairProblem:
    """`linearised`, whitened by the lower roots (m, 6, 6) of the differences' covariances.

    ``common_scale``: by how much common errors are larger than told.
    """

    pairs: PosePairs
    root: Array
    common_scale: float
    scale_components: int = 6

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Of the unknowns."""
        count = 0 if self.pairs.shared is None else len(self.pairs.shared.covariance)
        return (*NAMES, *(f"common_{i + 1}" for i in range(count)))

    def linearise(self, state: PairState) -> tuple[Array, Array]:
        """Whitened differences (m, 6) and their Jacobian."""
        miss, J = linearised(self.pairs, state)
        white = miss[:, :, None]
        whiten(self.root, white)
        whiten(self.root, J)
        return miss, J

    def retract(self, state: PairState, step: Array) -> PairState:
        """The state after a step (12 + s,)."""
        return state.after(step)

    def deviation(self, state: PairState) -> Array:
        """Of the common errors from their mean, zero."""
        return np.concatenate([np.zeros(12), state.common])

    @property
    def prior_information(self) -> Array | None:
        """Flat but for the common errors."""
        shared = self.pairs.shared
        if shared is None:
            return None
        information = np.zeros((len(self.names), len(self.names)))
        information[12:, 12:] = np.linalg.inv(shared.covariance * self.common_scale**2)
        return information


# ---- the closed forms of OpenCV: five for AX = XB, two for AX = ZB ------------------------------


HAND_EYE = ("tsai", "park", "horaud", "andreff", "daniilidis")
ROBOT_WORLD = ("shah", "li")
CLOSED_FORMS = (*HAND_EYE, *ROBOT_WORLD)

MOST_COMPARED = 100  # samples: OpenCV pairs each with each
_LEAST_DETERMINANT = 0.5  # of what OpenCV calls a rotation


def closed_form(name: str, pairs: PosePairs) -> Placement | None:
    """`closed_form_of_all`, of at most 100 of the samples, spread evenly."""
    if len(pairs) > MOST_COMPARED:
        pairs = pairs.take(np.linspace(0, len(pairs) - 1, MOST_COMPARED).astype(int))
    return closed_form_of_all(name, pairs)


def closed_form_of_all(name: str, pairs: PosePairs) -> Placement | None:
    """One of ``CLOSED_FORMS`` (cv2.calibrateHandEye, cv2.calibrateRobotWorldHandEye).

    OpenCV's five give X alone; Z is then the mean of what the samples make of it. None where
    OpenCV fails or gives what is no number. Time grows with the square of the samples.
    """
    import cv2

    carrier, board = pairs.T_boardside_cameraside, pairs.T_camera_board
    try:
        if name in HAND_EYE:
            code = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
            X = _transform(_call(cv2.calibrateHandEye, carrier, board, method=code))
            if np.array_equal(X, np.eye(4)):  # what OpenCV gives where motions tell too little
                return None
            Z = _mean(carrier @ X @ board)
        else:
            code = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
            # OpenCV's world is our board, and its robot's poses are base in flange
            turned = frames.invert(carrier)
            R, t, R_camera, t_camera = _call(
                cv2.calibrateRobotWorldHandEye, board, turned, method=code
            )
            X = frames.invert(_transform((R_camera, t_camera)))
            Z = frames.invert(_transform((R, t)))
    except (cv2.error, np.linalg.LinAlgError):
        return None
    found = Placement(X, Z)
    return found if np.all(np.isfinite(X)) and np.all(np.isfinite(Z)) else None


def closed_forms(pairs: PosePairs) -> dict[str, Placement | None]:
    """Each of OpenCV's."""
    return {name: closed_form(name, pairs) for name in CLOSED_FORMS}


def _call(solve: Callable[..., Any], first: Array, second: Array, method: int) -> Any:
    return solve(
        list(first[:, :3, :3]),
        list(first[:, :3, 3]),
        list(second[:, :3, :3]),
        list(second[:, :3, 3]),
        method=method,
    )


def _transform(found: Any) -> Array:
    R, t = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.float64)
    if not np.all(np.isfinite(R)) or np.linalg.det(R) < _LEAST_DETERMINANT:
        return np.full((4, 4), np.nan)
    return frames.transform(frames.nearest_rotation(R), t.ravel())


def _mean(T: Array) -> Array:
    """Mean of poses (m, 4, 4): of their positions, and the rotation nearest to all."""
    if not np.all(np.isfinite(T)):
        return np.full((4, 4), np.nan)
    R = frames.nearest_rotation(T[:, :3, :3].mean(axis=0))
    return frames.transform(R, T[:, :3, 3].mean(axis=0))


# ---- camera start -------------------------------------------------------------------------------
#
# R_carrier R_X = R_Z R_camera_board^T by singular vectors of a sum of Kronecker products, then
# both translations by linear least squares (Shah 2013, "Solving the robot-world/hand-eye
# calibration problem using the Kronecker product"), for many subsets of the samples at once.


_SUBSETS = 32  # of which one is clean with 99 % chance where three in ten samples are wrong
_SUBSET_SIZE = 5
_STRAY = 5.0  # medians from which a sample may lead a solution of all astray
_HALVINGS = 3  # of the better half, solved again (Rousseeuw and Van Driessen 1999)


def robust_start(pairs: PosePairs) -> Placement:
    """The placement that fits the better half of the samples best; the same data, the same start.

    ``pairs`` of two or more rotation axes; else the answer is one of many.
    """
    m = len(pairs)
    best = _closed_forms(pairs, np.ones((1, m)))[0]
    size = sample_sizes(pairs, best)
    if size.max() <= _STRAY * np.median(size) or m <= _SUBSET_SIZE:
        return best
    order = np.random.default_rng(0).random((_SUBSETS, m)).argsort(axis=1)
    few = _closed_forms(pairs, np.where(order < _SUBSET_SIZE, 1.0, 0.0))
    best = min((best, *few), key=lambda at: score(pairs, at))
    for _ in range(_HALVINGS):
        size = sample_sizes(pairs, best)
        half = np.where(size <= np.median(size), 1.0, 0.0)
        if half.sum() < _SUBSET_SIZE:
            break
        trial = _closed_forms(pairs, half[None])[0]
        if score(pairs, trial) >= score(pairs, best):
            break
        best = trial
    return best


def sample_sizes(pairs: PosePairs, at: Placement) -> Array:
    """How far each sample (m,) misses a placement, m; turns count at the board's distance."""
    miss = differences(predicted(pairs, at), pairs)
    turn = pairs.distance_m * np.linalg.norm(miss[:, 3:], axis=1)
    return np.asarray(np.hypot(np.linalg.norm(miss[:, :3], axis=1), turn))


def score(pairs: PosePairs, at: Placement) -> float:
    """Median of `sample_sizes`; infinite where the placement is no number."""
    if not (np.all(np.isfinite(at.X)) and np.all(np.isfinite(at.Z))):
        return np.inf
    return float(np.median(sample_sizes(pairs, at)))


def _closed_forms(pairs: PosePairs, weights: Array) -> list[Placement]:
    """Placements for each set of weights (s, m)."""
    carrier, board = pairs.for_kernels
    Ra, Rb = carrier[:, :3, :3], board[:, :3, :3]
    # vec(R_Z) = (R_board_camera (x) R_carrier) vec(R_X), columns stacked
    sums = (weights[:, None, :] * Rb.reshape(-1, 9).T) @ Ra.reshape(-1, 9)
    products = sums.reshape(-1, 3, 3, 3, 3).transpose(0, 2, 3, 1, 4)
    U, _, Vt = np.linalg.svd(products.reshape(-1, 9, 9))
    R_X = _rotations(Vt[:, 0].reshape(-1, 3, 3).swapaxes(1, 2))
    R_Z = _rotations(U[:, :, 0].reshape(-1, 3, 3).swapaxes(1, 2))
    found = []
    for w, Rx, Rz in zip(weights, R_X, R_Z, strict=True):
        A = np.concatenate([Ra, np.broadcast_to(-np.eye(3), Ra.shape)], axis=2)[w > 0.0]
        b = -(carrier[:, :3, 3] + (Ra @ (Rx @ board[:, :3, 3, None]))[..., 0])[w > 0.0]
        t = np.linalg.lstsq(A.reshape(-1, 6), b.ravel(), rcond=None)[0]
        found.append(Placement(frames.transform(Rx, t[:3]), frames.transform(Rz, t[3:])))
    return found


def _rotations(matrix: Array) -> Array:
    """Rotations (s, 3, 3) nearest to matrices up to a factor of either sign."""
    sign = np.sign(np.linalg.det(matrix))[:, None, None]
    U, _, Vt = np.linalg.svd(np.where(sign == 0.0, 1.0, sign) * matrix)
    U[:, :, 2] *= np.sign(np.linalg.det(U @ Vt))[:, None]
    return np.asarray(U @ Vt)
