# SPDX-License-Identifier: Apache-2.0
"""Maximum likelihood of a hand-eye calibration, with the noise of both sides."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import Estimate, correlation, solve
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array, Index
from robocal_ros.hand_eye.camera_data import Placement, PosePairs, Shared, plain
from robocal_ros.hand_eye.camera_kernels import (
    advance,
    compare,
    differentiate,
    factorise,
    predict,
    weigh,
    whiten,
)

# ---- pairs of a robot's pose and of what a camera (or a tracker) saw from there -----------------


_NEARLY_BACK = -0.9


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


# ---- camera start -------------------------------------------------------------------------------
#
# R_carrier R_X = R_Z R_camera_board^T by singular vectors of a sum of Kronecker products, then
# both translations by linear least squares (Shah 2013, "Solving the robot-world/hand-eye
# calibration problem using the Kronecker product"), for many subsets of the samples at once.


_SUBSETS = 32  # of which one is clean with 99 % chance where three in ten samples are wrong
_SUBSET_SIZE = 5
_STRAY_START = 5.0  # medians from which a sample may lead a solution of all astray
_HALVINGS = 3  # of the better half, solved again (Rousseeuw and Van Driessen 1999)


def robust_start(pairs: PosePairs) -> Placement:
    """The placement that fits the better half of the samples best; the same data, the same start.

    ``pairs`` of two or more rotation axes; else the answer is one of many.
    """
    m = len(pairs)
    best = _closed_forms(pairs, np.ones((1, m)))[0]
    size = sample_sizes(pairs, best)
    if size.max() <= _STRAY_START * np.median(size) or m <= _SUBSET_SIZE:
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
    return frames.nearest_rotation(np.where(sign == 0.0, 1.0, sign) * matrix)


SMALLEST_M, SMALLEST_RAD = 1e-7, 1e-7  # beyond any robot; keeps noise-free data solvable
POSITION, TURN, TILT, ROLL, DEPTH, EXCESS = range(6)
_NORMAL_MEDIAN = 1.538  # median length of three unit normals
_STRAY_NOISE = 6.0  # medians from which a sample may lead the noise astray
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

    ``position_m``: of the board's position, by both sides together; where the pairs have a
    covariance of the camera's side, by the robot alone. ``turn_rad``: of the flange's orientation,
    which moves the board by its lever. ``tilt_rad``, ``roll_rad``: of the board's turn in the
    camera, across its axis and about it. ``depth_m``: what the position along the camera's axis
    errs by besides. ``excess``: root of what is added to the pairs' own covariance, as a part of
    it. It takes the place of the camera's other three, which are zero where the pairs have one.
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
        place = self.position_m, self.turn_rad
        return np.square([*place, self.tilt_rad, self.roll_rad, self.depth_m, self.excess])

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
    keep = np.all(sizes <= _STRAY_NOISE * typical, axis=1)
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

    ``settled``: whether the likelihood's top was reached.
    ``stayed``: whether the noise that the search began with was as good as at the top.
    ``spread`` (k, k) what the unknowns' covariance is larger by than for noise that is known.
    ``best`` (k,) step of the unknowns to where they are likeliest.
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
    np.einsum("ii->i", bent)[:] += _PRIOR  # at the top, where the likelihood rises as steeply
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


# ---- maximum likelihood of a hand-eye calibration, with the noise of both sides -----------------


_ROUNDS = 8  # of weights and noise in turn
_SAME = 1e-3  # m, and rad: levers change by parts in a thousand
_MANY = 30  # samples: so many bring the noise near to what all tell, in less time
_ENOUGH_TO_DOUBT = 6  # samples: fewer tell neither outliers nor several variances


@dataclass(frozen=True)
class GivenNoise:
    """What is known of the noise, standard deviations per axis; None is estimated.

    ``robot_m`` counts where the pairs have a covariance of the camera's side. Without one positions
    of both sides scatter together, and what they do is estimated.
    ``camera_scale``: factor of the sigmas in the covariance that board poses have: 1 to trust it.
    What is told of corners alone knows nothing of a lens or a board that are not as assumed.
    """

    robot_m: float | None = None
    robot_rad: float | None = None
    camera_scale: float | None = None

    def variances(self, own_covariance: bool) -> Array:
        """(6,) as of `PairNoise`; nan where they are to be estimated."""
        unknown = float("nan")
        robot = unknown if self.robot_m is None else self.robot_m**2
        turn = unknown if self.robot_rad is None else self.robot_rad**2
        if own_covariance:
            scale = unknown if self.camera_scale is None else self.camera_scale**2 - 1.0
            return np.array([robot, turn, 0.0, 0.0, 0.0, scale])
        return np.array([unknown, turn, unknown, unknown, unknown, 0.0])


@dataclass(frozen=True, eq=False)
class PairFit:
    """A solved calibration.

    ``noise``: of both sides, given or estimated.
    ``expected`` (m, 6, 6) covariance of the samples' differences by the noise alone.
    ``settled``: whether noise and placements agree in the end; where the noise is known they do.
    ``spread`` (12 + s, 12 + s) what the covariance is larger by, because the noise was estimated.
    ``differences``, ``jacobian`` (m, 6) and (m, 6, 12 + s) of all samples, as `linearised`.
    """

    pairs: PosePairs
    noise: PairNoise
    expected: Array
    estimate: Estimate[PairState]
    settled: bool
    spread: Array
    differences: Array
    jacobian: Array

    @property
    def at(self) -> Placement:
        """Where camera and board are."""
        return self.estimate.state.at

    @property
    def covariance(self) -> Array:
        """Covariance (12, 12) of the increments (v, w) of X, camera axes, and of Z, board axes.

        Of a stream it is widened, because neighbours share their errors.
        """
        return self.whole_covariance[:12, :12]

    @property
    def whole_covariance(self) -> Array:
        """The same with the common errors (12 + s, 12 + s)."""
        whole = self.estimate.covariance + self.spread
        if self.pairs.time_s is None:
            return whole
        return whole * correlation(self.estimate.residual[~self.rejected])

    @property
    def rejected(self) -> NDArray[np.bool_]:
        """(m,) samples that were not used."""
        return self.estimate.rejected


def fit_pairs(
    pairs: PosePairs, given: GivenNoise | None = None, start: Placement | None = None,
    sound: Placement | None = None,
) -> PairFit:  # fmt: skip
    """Find the most likely placements, reject what does not fit, estimate the unknown noise.

    Noise and placements in turn. ``start``: where the search begins; default ``sound``. ``sound``:
    a placement near the truth, from which the noise is guessed; default `robust_start`.
    """
    known = (given or GivenNoise()).variances(pairs.covariance is not None)
    free, shared = np.isnan(known), pairs.shared
    common = np.zeros(0 if shared is None else len(shared.covariance))
    near = PairState(robust_start(pairs) if sound is None else sound, common)
    state = near if start is None else PairState(start, common)
    parts = Parts.of(pairs, near.at.X)
    seen = Evidence.of(pairs, parts, near)
    noise, keep = first_guess(seen.rows[:, :, -1], known)
    found_noise, enough = None, len(pairs) >= _ENOUGH_TO_DOUBT
    if np.any(free) and enough:
        keep = keep if np.sum(keep) >= _ENOUGH_TO_DOUBT else np.ones_like(keep)
        if np.sum(keep) > _MANY:  # first by some of them, spread evenly
            rows, few = np.flatnonzero(keep), np.zeros_like(keep)
            few[rows[np.linspace(0, len(rows) - 1, _MANY).astype(int)]] = True
            noise = estimate(seen.take(few).with_common(shared, common), free, noise).noise
        found_noise = estimate(seen.take(keep).with_common(shared, common), free, noise)
        noise = found_noise.noise
        state = near.after(found_noise.best) if start is None else state
    for _ in range(_ROUNDS):
        V, root = parts.covariances(noise)
        problem = PairProblem(pairs, root, noise.camera_scale)
        found = solve(
            problem,
            state,
            prior_information=problem.prior_information,
            noise_known=enough or not np.any(free),
            robust=enough,
        )
        used, state = ~found.rejected, found.state
        settled = found_noise is None or found_noise.settled
        away = [np.abs(near.at.X - state.at.X).max(), np.abs(near.at.Z - state.at.Z).max()]
        # weights that follow from a placement so near do for this one too
        if found_noise is None or (np.array_equal(used, keep) and max(away) < _SAME):
            break
        parts, near, keep = parts.moved(pairs, state.at.X), state, used
        seen = Evidence.of(pairs, parts, state).take(used)
        found_noise = estimate(seen.with_common(shared, state.common), free, noise)
        settled = found_noise.stayed
        if settled:
            break
        noise = found_noise.noise
    k, (differences, jacobian) = len(found.names), linearised(pairs, state)
    spread = np.zeros((k, k)) if found_noise is None else found_noise.spread
    if np.any(free) and not enough:
        spread = found.covariance * (_of_few(differences, V) / found.scale**2 - 1.0)
    return PairFit(pairs, noise, V, found, settled, spread, differences, jacobian)


def _of_few(differences: Array, expected: Array) -> float:
    """Square of the noise over the ``expected``, as few samples (m, 6) leave it open.

    Six unknowns are of positions and six of turns, and which of the two is noisier is not known:
    the larger is taken. What n numbers tell of a variance is its inverse chi-square: n / (n - 2) of
    it in the mean.
    """
    freedom = 3.0 * len(differences) - 6.0
    parts = [
        np.einsum("mi,mij,mj->", own, np.linalg.inv(V), own)
        for own, V in (
            (differences[:, :3], expected[:, :3, :3]),
            (differences[:, 3:], expected[:, 3:, 3:]),
        )
    ]
    return float(max(parts)) / (freedom - 2.0)


# ---- whether lengths of robot and board differ by a factor ---------------------------------------


FEWEST_SCALED = 6  # samples: of fewer the sigma itself is not known
_SCALELESS = 1e-10  # share of what a factor does to the boards that no placement does too


def scale_of_board(pairs: PosePairs, at: Placement) -> tuple[float, float]:
    """Factor by which board positions would fit the robot's better, and its sigma."""
    carrier = pairs.T_boardside_cameraside
    R = carrier[:, :3, :3]
    seen = R @ (at.X[:3, :3] @ pairs.T_camera_board[:, :3, 3, None])
    A = np.concatenate([R, np.broadcast_to(-np.eye(3), R.shape), seen], axis=2).reshape(-1, 7)
    b = -carrier[:, :3, 3].ravel()
    found, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-10)
    if rank < A.shape[1] or len(pairs) < FEWEST_SCALED:
        return 1.0, np.inf
    variance = float(np.sum((b - A @ found) ** 2)) / (len(b) - A.shape[1])
    return float(found[6]), float(np.sqrt(variance * np.linalg.inv(A.T @ A)[6, 6]))


def board_scale(fit: PairFit) -> tuple[float, float, float]:
    """The same factor of a fit, its sigma, and by how much, m, the camera is elsewhere with it.

    As one more unknown, to first order: what the images leave of the focal length explains its part
    first. The noise is what is left with the factor; elsewhere: where the boards were on average.
    """
    used, e = ~fit.rejected, fit.estimate
    pairs, k = fit.pairs.take(used), len(e.names)
    column = np.zeros((len(pairs), 6, 1))
    column[:, :3, 0] = -predicted(pairs, fit.at)[:, :3, 3]
    rows = np.concatenate([fit.jacobian[used], column], axis=2)
    rows = np.linalg.solve(np.linalg.cholesky(fit.expected[used]), rows)
    J, a, left = rows[..., :k].reshape(-1, k), rows[..., k].ravel(), e.residual[used].ravel()
    taken = e.covariance / e.scale**2 @ (a @ J)
    told = float(a @ a - (a @ J) @ taken)
    if len(pairs) < FEWEST_SCALED or told < _SCALELESS * float(a @ a):
        return 1.0, np.inf, 0.0
    away = -float(a @ left) / told
    variance = max(float(left @ left) - told * away**2, 0.0) / (e.freedom - 1.0)
    if pairs.time_s is not None:
        variance *= correlation(e.residual[used])
    where = pairs.T_camera_board[:, :3, 3].mean(axis=0)
    moved = -away * (taken[:3] + np.cross(taken[3:6], where))
    return 1.0 + away, float(np.sqrt(variance / told)), float(np.linalg.norm(moved))
