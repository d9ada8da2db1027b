"""Where the search for a camera begins: a closed form that bad samples cannot lead astray.

R_carrier R_X = R_Z R_camera_board^T by singular vectors of a sum of Kronecker products, then both
translations by linear least squares (Shah 2013, "Solving the robot-world/hand-eye calibration
problem using the Kronecker product"), for many subsets of the samples at once.
"""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted

Array = NDArray[np.float64]

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
