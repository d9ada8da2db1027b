"""The noise of both sides of a hand-eye calibration, given or estimated from the residuals.

Variance components where the restricted likelihood (Patterson and Thompson 1971: of what the
unknowns cannot explain) times a prior is largest. The prior is flat in each standard deviation
(Gelman 2006, Bayesian Analysis 1:515): none of them is nothing because chance says so. Newton steps
in the logarithms, with the average of observed and expected information (Gilmour, Thompson and
Cullis 1995), which needs no product of two large matrices.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.camera_kernels import factorise, weigh
from robocal_ros.hand_eye.camera_model import PairState, linearised
from robocal_ros.hand_eye.pose_pairs import PosePairs, Shared, levers

Array = NDArray[np.float64]
Index = NDArray[np.int64]

SMALLEST_M, SMALLEST_RAD = 1e-7, 1e-7  # beyond any robot; keeps noise-free data solvable
POSITION, TURN, TILT, ROLL, DEPTH, EXCESS = range(6)
_NORMAL_MEDIAN = 1.538  # median length of three unit normals
_STRAY = 6.0  # medians from which a sample may lead the noise astray
_MOST_STEPS, _LONGEST = 50, 2.0
_PRIOR = 1.0  # slope of the prior's logarithm, doubled: a variance's density goes as its root
_DAMPING, _LESS, _MORE = 1.0, 0.1, 4.0
_NEAR = 1e-2  # squared step in standard deviations of the noise: weights are as good as final
_CLOSE = 0.3  # the same, from where the next may be as near


@dataclass(frozen=True)
class PairNoise:
    """Standard deviations per axis.

    A board's pose in the image is told better across the camera's axis (z) than along it: its
    distance by its size alone, its tilt by foreshortening alone. So the camera has a noise of
    distance and one of tilt beside that of its lateral position and of its turn about the axis.

    Attributes
    ----------
    position_m : of the board's position, by both sides together; where the pairs have a covariance
        of the camera's side, by the robot alone.
    turn_rad : of the flange's orientation, which moves the board by its lever.
    tilt_rad, roll_rad : of the board's turn in the camera, across its axis and about it.
    depth_m : what the position along the camera's axis errs by besides.
    excess : root of what is added to the pairs' own covariance, as a part of it. It takes the place
        of the camera's other three, which are zero where the pairs have one.
    """

    position_m: float
    turn_rad: float
    tilt_rad: float = 0.0
    roll_rad: float = 0.0
    depth_m: float = 0.0
    excess: float = 0.0

    @property
    def variances(self) -> Array:
        """(6,): the squares."""
        return np.square(
            [
                self.position_m,
                self.turn_rad,
                self.tilt_rad,
                self.roll_rad,
                self.depth_m,
                self.excess,
            ]
        )

    @property
    def camera_scale(self) -> float:
        """Factor by which the sigmas of the pairs' own covariance are taken larger."""
        return float(np.sqrt(1.0 + self.excess**2))


@dataclass(frozen=True, eq=False)
class Parts:
    """What the variances do to the differences of m samples, along the camera's axes.

    ``columns`` (m, 6, c): roots of the covariances for one unit of the variances ``owner`` (c,);
    ``rest`` (m, 6, 6): covariance beside them, never singular.
    """

    columns: Array
    owner: Index
    rest: Array

    @classmethod
    def of(cls, pairs: PosePairs, X: Array) -> "Parts":
        """Of pairs, with the levers that a placement of the camera gives."""
        m, least = len(pairs), np.diag(np.repeat([SMALLEST_M**2, SMALLEST_RAD**2], 3))
        owner = [POSITION] * 3 + [TURN] * 3
        columns = np.zeros((m, 6, 12 if pairs.covariance is not None else 10))
        columns[:, :3, :3] = columns[:, 3:, 3:6] = np.eye(3)
        columns[:, :3, 3:6] = -frames.skew(levers(pairs, X))
        if pairs.covariance is not None:
            columns[:, :, 6:] = np.linalg.cholesky(pairs.covariance + least)
            return cls(columns, np.array([*owner, *[EXCESS] * 6]), pairs.covariance + least)
        columns[:, 3:, 6:9] = np.eye(3)
        columns[:, 2, 9] = 1.0
        owner += [TILT, TILT, ROLL, DEPTH]
        return cls(columns, np.array(owner), np.tile(least, (m, 1, 1)))

    def moved(self, pairs: PosePairs, X: Array) -> "Parts":
        """With the levers of another placement."""
        columns = self.columns.copy()
        columns[:, :3, 3:6] = -frames.skew(levers(pairs, X))
        return Parts(columns, self.owner, self.rest)

    def covariances(self, noise: PairNoise) -> tuple[Array, Array]:
        """Covariance (m, 6, 6) of the differences of each sample, and its lower root."""
        V, root = np.empty_like(self.rest), np.zeros_like(self.rest)
        factorise(self.columns, self.owner, noise.variances, self.rest, V, root)
        return V, root

    def take(self, keep: NDArray[np.bool_]) -> "Parts":
        """Those of some samples (m,)."""
        return self if np.all(keep) else Parts(self.columns[keep], self.owner, self.rest[keep])


def first_guess(miss: Array, known: Array) -> tuple[PairNoise, NDArray[np.bool_]]:
    """Noise whose unknown variances, nan in ``known`` (6,), come from differences (m, 6).

    From their medians, as if each were all of the noise; and samples (m,) that are not far beyond.
    """
    sizes = np.sqrt(np.einsum("mij,mij->mi", *2 * (miss.reshape(-1, 2, 3),)))
    typical = np.maximum(np.median(sizes, axis=0), SMALLEST_M)
    keep = np.all(sizes <= _STRAY * typical, axis=1)
    place, turn = typical / _NORMAL_MEDIAN
    guess = np.square([place, turn, turn, turn, place, 1.0])
    return noise_of(np.where(np.isnan(known), guess, known)), np.asarray(keep)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What tells the variances: rows (m, 6, k + 1) of Jacobian and differences, and their parts."""

    rows: Array
    parts: Parts

    @classmethod
    def of(cls, pairs: PosePairs, parts: Parts, state: PairState) -> "Evidence":
        """Of pairs at a state near the best, for parts of the same place."""
        miss, jacobian = linearised(pairs, state)
        return cls(np.concatenate([jacobian, miss[:, :, None]], axis=2), parts)

    def take(self, keep: NDArray[np.bool_]) -> "Evidence":
        """That of some samples (m,)."""
        return self if np.all(keep) else Evidence(self.rows[keep], self.parts.take(keep))

    def with_common(self, shared: Shared | None, common: Array) -> "Evidence":
        """And of ``common`` (s,) errors, whose size tells that of the camera's too.

        Their deviations from zero, made independent, in rows of six as all others; rows that are
        left over hold nothing.
        """
        if shared is None:
            return self
        s, width, parts = len(common), self.rows.shape[2], self.parts
        more = -(-s // 6)
        root = np.linalg.inv(np.linalg.cholesky(shared.covariance))
        rows = np.zeros((6 * more, width))
        rows[:s, width - 1 - s : width - 1], rows[:s, width - 1] = root, root @ common
        columns = np.zeros((6 * more, len(parts.owner)))
        excess = np.flatnonzero(parts.owner == EXCESS)
        if len(excess):
            columns[np.arange(s), excess[np.arange(s) % 6]] = 1.0
        return Evidence(
            np.concatenate([self.rows, rows.reshape(more, 6, width)]),
            Parts(
                np.concatenate([parts.columns, columns.reshape(more, 6, -1)]),
                parts.owner,
                np.concatenate([parts.rest, np.tile(np.eye(6), (more, 1, 1))]),
            ),
        )


@dataclass(frozen=True, eq=False)
class Found:
    """Noise that was estimated.

    Attributes
    ----------
    settled : whether the likelihood's top was reached.
    stayed : whether the noise that the search began with was as good as at the top.
    spread : (k, k) what the unknowns' covariance is larger by than for noise that is known.
    best : (k,) step of the unknowns to where they are likeliest.
    """

    noise: PairNoise
    settled: bool
    stayed: bool
    spread: Array
    best: Array


def estimate(seen: Evidence, free: NDArray[np.bool_], noise: PairNoise) -> Found:
    """Variances of the ``free`` components (6,); ``noise`` holds the others and the start."""
    chosen = np.flatnonzero(free)
    theta = noise.variances
    here = _weigh(seen, theta, chosen)
    damping, last = 0.0, np.inf
    for turn in range(_MOST_STEPS if here.cost < np.inf else 0):
        step, size = here.step(damping)
        trial = theta.copy()
        trial[chosen] *= np.exp(step)
        soon = turn > 0 and size < _CLOSE and size * size / last < _NEAR  # the next, as it shrinks
        if size < _NEAR or soon:
            return Found(noise_of(trial), True, turn == 0, here.spread(), here.best)
        last = size
        there = _weigh(seen, trial, chosen)
        if there.cost <= here.cost:
            theta, here, damping = trial, there, _LESS * damping
        else:
            damping = max(_MORE * damping, _DAMPING)
    return Found(noise_of(theta), False, False, here.spread(), here.best)


@dataclass(frozen=True, eq=False)
class _Weighed:
    """The posterior of the noise at one point, in the logarithms of n variances.

    ``cost``: -2 log density, infinite where the samples do not determine the unknowns; ``slope``
    (n,), ``bend`` (n, n): its derivatives; ``drift`` (n, k): by how much the best unknowns go
    along; ``best`` (k,): the step to them.
    """

    cost: float
    slope: Array
    bend: Array
    drift: Array
    best: Array

    def step(self, damping: float) -> tuple[Array, float]:
        """Towards the top (n,), and its squared length in standard deviations."""
        full = np.linalg.solve(self.bend, self.slope)
        damped = full
        if damping:
            damped = np.linalg.solve(self.bend + damping * np.eye(len(full)), self.slope)
        shorter = min(1.0, _LONGEST / max(float(np.max(np.abs(damped))), _LONGEST))
        return np.asarray(-shorter * damped), float(self.slope @ full)

    def spread(self) -> Array:
        """Twice the covariance (k, k) that the unknowns have by the noise's own.

        Once by the law of total variance; once more because the covariance at the likeliest noise
        is as much too small (Kenward and Roger 1997, Biometrics 53:983).
        """
        return np.asarray(4.0 * self.drift.T @ np.linalg.solve(self.bend, self.drift))


def _weigh(seen: Evidence, theta: Array, chosen: Index) -> _Weighed:
    """At variances (6,) of which some are ``chosen``."""
    parts, k, n = seen.parts, seen.rows.shape[2] - 1, len(theta)
    step, slope, bend, drift = np.zeros(k), np.zeros(n), np.zeros((n, n)), np.zeros((n, k))
    split = (parts.columns, parts.owner, parts.rest)
    cost = weigh(seen.rows, *split, theta, step, slope, bend, drift)
    some = theta[chosen]
    bent = np.outer(some, some) * bend[np.ix_(chosen, chosen)]
    bent[np.diag_indices_from(bent)] += _PRIOR  # at the top, where the likelihood rises as steeply
    return _Weighed(
        cost - _PRIOR * float(np.sum(np.log(some))),
        some * slope[chosen] - _PRIOR,
        bent,
        some[:, None] * drift[chosen],
        step,
    )


def noise_of(variances: Array) -> PairNoise:
    """Of variances (6,)."""
    return PairNoise(*np.sqrt(variances).tolist())
