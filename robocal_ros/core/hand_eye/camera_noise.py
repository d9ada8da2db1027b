"""The noise of both sides of a hand-eye calibration, given or estimated from the residuals.

Variance components by restricted maximum likelihood (Patterson and Thompson 1971), found by the
iterated minimum-norm equations (Rao 1971): tr(P V_k P V_l) theta_l = r' P V_k P r, which count
what the unknowns take up.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.hand_eye.pose_pairs import PosePairs, levers

Array = NDArray[np.float64]

SMALLEST_M, SMALLEST_RAD = 1e-9, 1e-9  # keep noise-free data solvable
_NORMAL_MEDIAN = 1.538  # median length of three unit normals
_ROUNDS = 8
_SETTLED = 1e-2


@dataclass(frozen=True)
class PairNoise:
    """Standard deviations per axis.

    Attributes
    ----------
    position_m, turn_rad : of the robot: of the flange's position and of its orientation, which
        moves the board by its lever.
    camera_m, camera_rad : of the board in the camera, beside the pairs' own covariance.
    """

    position_m: float
    turn_rad: float
    camera_m: float = 0.0
    camera_rad: float = 0.0

    @property
    def variances(self) -> Array:
        """(3,): of positions, of the robot's turn, of the camera's turn."""
        return np.array(
            [self.position_m**2 + self.camera_m**2, self.turn_rad**2, self.camera_rad**2]
        )


def components(pairs: PosePairs, X: Array) -> Array:
    """What one unit of each variance does to the differences: (3, m, 6, 6), camera axes.

    A position error of either side, a turn of the flange about its origin, a turn of the board.
    """
    m = len(pairs)
    tilt = np.concatenate(
        [-frames.skew(levers(pairs, X)), np.broadcast_to(np.eye(3), (m, 3, 3))], axis=1
    )
    place, turn = (np.diag(np.repeat(w, 3)) for w in ([1.0, 0.0], [0.0, 1.0]))
    own = [np.broadcast_to(V, (m, 6, 6)) for V in (place, turn)]
    return np.stack([own[0], tilt @ tilt.swapaxes(1, 2), own[1]])


def covariances(pairs: PosePairs, X: Array, noise: PairNoise) -> Array:
    """Covariance (m, 6, 6) of the differences of each sample."""
    V = np.einsum("k,kmij->mij", noise.variances, components(pairs, X))
    V += np.diag(np.repeat([SMALLEST_M**2, SMALLEST_RAD**2], 3))
    return V if pairs.covariance is None else V + pairs.covariance


def first_guess(differences: Array, free: NDArray[np.bool_], known: PairNoise) -> PairNoise:
    """Unknown variances from the median of the differences (m, 6), shared out evenly."""
    place, turn = (
        max(float(np.median(np.linalg.norm(part, axis=1))) / _NORMAL_MEDIAN, 1e-7)
        for part in (differences[:, :3], differences[:, 3:])
    )
    parts = int(free[1]) + int(free[2])
    guess = np.array([place, turn / max(parts, 1) ** 0.5, turn / max(parts, 1) ** 0.5]) ** 2
    return _with(known, np.where(free, guess, known.variances), free)


def estimate(
    differences: Array, jacobian: Array, parts: Array, rest: Array, free: NDArray[np.bool_],
    noise: PairNoise,
) -> PairNoise:  # fmt: skip
    """Variances of the ``free`` components (3,) from differences (m, 6) and Jacobian (m, 6, k).

    ``parts`` (3, m, 6, 6) as from `components`, ``rest`` (m, 6, 6) what is known beside them.
    """
    if not np.any(free):
        return noise
    theta = noise.variances
    for _ in range(_ROUNDS):
        V = np.einsum("k,kmij->mij", theta, parts) + rest
        new = _round(differences, jacobian, parts, rest, V, theta, free)
        settled = np.all(np.abs(new - theta) <= _SETTLED * np.maximum(new, theta))
        theta = new
        if settled:
            break
    return _with(noise, theta, free)


def _round(
    differences: Array, jacobian: Array, parts: Array, rest: Array, V: Array, theta: Array,
    free: NDArray[np.bool_],
) -> Array:  # fmt: skip
    """One solution of the minimum-norm equations."""
    from scipy.optimize import nnls

    root = np.linalg.inv(np.linalg.cholesky(V))
    turned = root.swapaxes(1, 2)
    J = root @ jacobian
    k = J.shape[2]
    rows = J.reshape(-1, k)
    M = np.linalg.pinv(rows.T @ rows, hermitian=True)
    e = (root @ differences[..., None])[..., 0]
    e = e - J @ (M @ (rows.T @ e.ravel()))
    # the known rest is one more component, with factor one
    U = np.stack([root @ part @ turned for part in (*parts, rest)])
    Y = U @ J
    G = rows.T @ Y.reshape(len(U), -1, k) @ M
    flat, Yf = U.reshape(len(U), -1), Y.reshape(len(U), -1)
    F = flat @ flat.T - 2.0 * Yf @ (Y @ M).reshape(len(U), -1).T
    F += np.einsum("kab,lba->kl", G, G)
    q = np.sum((U @ e[..., None])[..., 0] * e, axis=(1, 2))
    held = np.append(np.where(free, 0.0, theta), 1.0)
    chosen = np.flatnonzero(free)
    right = q[chosen] - F[chosen] @ held
    scale = 1.0 / np.sqrt(np.maximum(np.diag(F)[chosen], np.finfo(float).tiny))
    found = nnls(F[np.ix_(chosen, chosen)] * np.outer(scale, scale), right * scale)[0] * scale
    new = theta.copy()
    new[chosen] = found
    return new


def _with(noise: PairNoise, variances: Array, free: NDArray[np.bool_]) -> PairNoise:
    """The free variances put where they belong."""
    place, turn, camera = np.sqrt(np.maximum(variances, 0.0)).tolist()
    if free[0]:
        # which side a position error comes from cannot be told: it is the robot's if that is free
        noise = replace(noise, position_m=place, camera_m=0.0)
    if free[1]:
        noise = replace(noise, turn_rad=turn)
    if free[2]:
        noise = replace(noise, camera_rad=camera)
    return noise
