"""The noise of both sides of a hand-eye calibration, given or estimated from the residuals.

Variance components by restricted maximum likelihood (Patterson and Thompson 1971), found by the
iterated minimum-norm equations (Rao 1971): tr(P V_k P V_l) theta_l = r' P V_k P r, which count
what the unknowns take up.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.hand_eye.pose_pairs import (
    Placement,
    PosePairs,
    differences,
    levers,
    predicted,
)

Array = NDArray[np.float64]

SMALLEST_M, SMALLEST_RAD = 1e-7, 1e-7  # beyond any robot; keeps noise-free data solvable
_NORMAL_MEDIAN = 1.538  # median length of three unit normals
_GENEROUS = 2.0
_LEAST_TOLD = 1e-6  # of what the samples would tell of a variance without unknowns
_ROUNDS, _WHOLE_STEPS = 60, 8
_SETTLED = 1e-2
_FAINT = 1e-6  # of the largest that a variance has been: as good as none


@dataclass(frozen=True)
class PairNoise:
    """Standard deviations per axis.

    Attributes
    ----------
    position_m : of the board's position, by both sides together; where the pairs have a covariance
        of the camera's side, by the robot alone.
    turn_rad : of the flange's orientation, which moves the board by its lever.
    camera : of the board's turn in the camera, rad; where the pairs have a covariance, the root of
        what is added to it, as a part of it.
    """

    position_m: float
    turn_rad: float
    camera: float

    @property
    def variances(self) -> Array:
        """(3,): the squares."""
        return np.square([self.position_m, self.turn_rad, self.camera])

    @property
    def camera_scale(self) -> float:
        """Factor by which the sigmas of the pairs' own covariance are taken larger."""
        return float(np.sqrt(1.0 + self.camera**2))


def components(pairs: PosePairs, X: Array) -> Array:
    """What one unit of each variance does to the differences: (3, m, 6, 6), camera axes."""
    m = len(pairs)
    tilt = np.concatenate(
        [-frames.skew(levers(pairs, X)), np.broadcast_to(np.eye(3), (m, 3, 3))], axis=1
    )
    place, turn = (
        np.broadcast_to(np.diag(np.repeat(w, 3)), (m, 6, 6)) for w in ([1.0, 0.0], [0.0, 1.0])
    )
    camera = turn if pairs.covariance is None else pairs.covariance
    return np.stack([place, tilt @ tilt.swapaxes(1, 2), camera])


def known_part(pairs: PosePairs) -> Array:
    """Covariance (m, 6, 6) beside the components: never singular."""
    least = np.diag(np.repeat([SMALLEST_M**2, SMALLEST_RAD**2], 3))
    own = np.zeros((len(pairs), 6, 6)) if pairs.covariance is None else pairs.covariance
    return np.asarray(own + least)


def covariances(pairs: PosePairs, X: Array, noise: PairNoise) -> Array:
    """Covariance (m, 6, 6) of the differences of each sample."""
    parts = np.einsum("k,kmij->mij", noise.variances, components(pairs, X))
    return np.asarray(parts + known_part(pairs))


def first_guess(pairs: PosePairs, at: Placement, known: Array) -> PairNoise:
    """Unknown variances, nan in ``known`` (3,), from the median of the differences at a start.

    On the large side: what is rejected by too small a noise makes it smaller still.
    """
    if not np.any(np.isnan(known)):
        return _noise(known)
    miss = differences(predicted(pairs, at), pairs)
    place, turn = (
        max(float(np.median(np.linalg.norm(part, axis=1))) * _GENEROUS / _NORMAL_MEDIAN, SMALLEST_M)
        for part in (miss[:, :3], miss[:, 3:])
    )
    guess = np.square([place, turn, turn if pairs.covariance is None else _GENEROUS])
    return _noise(np.where(np.isnan(known), guess, known))


@dataclass(frozen=True, eq=False)
class Evidence:
    """What tells the variances: differences (m, 6), their Jacobian (m, 6, k), and covariance.

    ``parts`` (3, m, 6, 6) for one unit of each variance, ``rest`` (m, 6, 6) beside them.
    """

    differences: Array
    jacobian: Array
    parts: Array
    rest: Array

    @classmethod
    def of(
        cls, pairs: PosePairs, X: Array, miss: Array, jacobian: Array, common: Array
    ) -> "Evidence":
        """Of pairs at a solution; ``common`` (s,) errors are evidence of the camera's too."""
        own = cls(miss, jacobian, components(pairs, X), known_part(pairs))
        if pairs.covariance is None or pairs.shared is None:
            return own
        # Their deviations from zero, made independent, in rows of six as all others; rows that
        # are left over hold nothing.
        s, k = len(common), jacobian.shape[2]
        rows = -(-s // 6)
        root = np.linalg.inv(np.linalg.cholesky(pairs.shared.covariance))
        z, J, live = np.zeros(6 * rows), np.zeros((6 * rows, k)), np.zeros(6 * rows)
        z[:s], J[:s, k - s :], live[:s] = root @ common, root, 1.0
        part = np.zeros((3, rows, 6, 6))
        part[2] = live.reshape(rows, 6, 1) * np.eye(6)
        return cls(
            np.concatenate([own.differences, z.reshape(rows, 6)]),
            np.concatenate([own.jacobian, J.reshape(rows, 6, k)]),
            np.concatenate([own.parts, part], axis=1),
            np.concatenate([own.rest, np.tile(np.eye(6), (rows, 1, 1))]),
        )


def estimate(seen: Evidence, free: NDArray[np.bool_], noise: PairNoise) -> tuple[PairNoise, bool]:
    """Variances of the ``free`` components (3,); ``noise`` holds the others and the start.

    And whether they settled.
    """
    theta = largest = noise.variances
    for turn in range(_ROUNDS):
        new = _round(seen, theta, free)
        largest = np.maximum(largest, new)
        size = np.maximum(np.maximum(new, theta), _FAINT * largest)
        if np.all(np.abs(new - theta) <= _SETTLED * size):
            return _noise(new), True
        # whole steps may swing between two answers for ever
        theta = new if turn < _WHOLE_STEPS else 0.5 * (theta + new)
    return _noise(theta), False


def _round(seen: Evidence, theta: Array, free: NDArray[np.bool_]) -> Array:
    """One solution of the minimum-norm equations."""
    from scipy.optimize import nnls

    V = np.einsum("k,kmij->mij", theta, seen.parts) + seen.rest
    root = np.linalg.inv(np.linalg.cholesky(V))
    turned = root.swapaxes(1, 2)
    J = root @ seen.jacobian
    k = J.shape[2]
    rows = J.reshape(-1, k)
    M = np.linalg.pinv(rows.T @ rows, hermitian=True)
    e = (root @ seen.differences[..., None])[..., 0]
    e = e - J @ (M @ (rows.T @ e.ravel()))
    # the known rest is one more component, with factor one
    U = np.stack([root @ part @ turned for part in (*seen.parts, seen.rest)])
    Y = U @ J
    G = rows.T @ Y.reshape(len(U), -1, k) @ M
    flat, Yf = U.reshape(len(U), -1), Y.reshape(len(U), -1)
    F = flat @ flat.T - 2.0 * Yf @ (Y @ M).reshape(len(U), -1).T
    F += np.einsum("kab,lba->kl", G, G)
    q = np.sum((U @ e[..., None])[..., 0] * e, axis=(1, 2))
    held = np.append(np.where(free, 0.0, theta), 1.0)
    chosen = np.flatnonzero(free)
    right = q[chosen] - F[chosen] @ held
    told = np.diag(F)[chosen]
    if np.any(told <= _LEAST_TOLD * np.sum(flat**2, axis=1)[chosen]):
        return theta  # the unknowns take up all that the samples say
    scale = 1.0 / np.sqrt(told)
    found = nnls(F[np.ix_(chosen, chosen)] * np.outer(scale, scale), right * scale)[0] * scale
    new = theta.copy()
    new[chosen] = found
    return new


def _noise(variances: Array) -> PairNoise:
    position, turn, camera = np.sqrt(variances).tolist()
    return PairNoise(position, turn, camera)
