# SPDX-License-Identifier: Apache-2.0
"""Joint functions and compliances from measurements: what is unknown, and what the evidence wants.

Of each joint a smooth function of its own angle is a Gaussian process, with a Matérn 5/2 kernel
of a length and an amplitude, on the coefficients of a cubic spline (`kinematics.joint_functions`).
With the normal equations in hand, length and amplitude of every joint and the noise are those
under which the data are most likely, all unknowns integrated out (evidence, type II maximum
likelihood: MacKay, Bayesian interpolation, 1992; Rasmussen and Williams, Gaussian Processes for
Machine Learning, 2006, chapter 5).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.kinematics.joint_functions import JointFunctions

# Gears and encoders go with tens of periods in a turn: a length of a few degrees. How far length
# and amplitude may be from these, as factors (standard deviations of their logarithms), is wide
# beside what some hundred poses tell. Of a joint that slides, m stands for rad.
LENGTH_RAD, LENGTH_FACTOR = float(np.radians(3.5)), 0.5
AMPLITUDE_RAD, AMPLITUDE_FACTOR = 250e-6, 1.0
WINDING_RAD = 1e-3  # standard deviation of what the largest torque winds a joint, before the data
EVIDENCE_NEEDED = 3.0  # of a term, natural logarithm: twenty to one

# Of the knots, under a typical length: no more splines than poses, within these bounds.
FINEST_STEP_RAD, COARSEST_STEP_RAD = float(np.radians(1.5)), float(np.radians(3.0))
MOST_SPLINES = 1200
MARGIN = 3  # splines beyond the measured angles, on which a function returns to zero
_JITTER = 1e-8
LEAST_NOISE_SHARE = 1e-2  # of the noise before: what functions leave at least
_STEPS, LONGEST_STEP = 20, 1.5  # of the search, in logarithms
FLAT, FLAT_SHARE = 0.1, 3e-6  # change of the log evidence that means nothing, also relative


@dataclass(frozen=True)
class JointTerms:
    """Which joints have a function and a compliance, and their columns among the unknowns.

    The k unknowns are ``before`` others (geometry, base, targets), the compliances of the joints
    that bend, and the spline coefficients, joint by joint.

    Attributes
    ----------
    first, step : (n,) first knot and spacing of the knots, rad (prismatic: m).
    count : (n,) splines of each joint; 0: no function.
    bends : (n,) whether its compliance is unknown.
    torque_scale : (n,) largest gravity torque in the data, N m (prismatic: N).
    """

    before: int
    first: Array
    step: Array
    count: Index
    bends: Mask
    torque_scale: Array

    @classmethod
    def cover(
        cls, q: Array, torque: Array | None, before: int, coarse: bool = False
    ) -> "JointTerms":
        """All terms that readings (m, n) and, where it is known, gravity torque (m, n) can have.

        A joint that stands still has no function: it would be a constant, which theta0 is too.

        ``coarse``: with half of the splines, to search with.
        """
        lower, span = q.min(axis=0), np.ptp(q, axis=0)
        wanted = np.clip(float(span.sum()) / len(q), FINEST_STEP_RAD, COARSEST_STEP_RAD)
        step = max(wanted, float(span.sum()) / MOST_SPLINES) * (2.0 if coarse else 1.0)
        largest = np.zeros(q.shape[1]) if torque is None else np.max(np.abs(torque), axis=0)
        return cls(
            before=before,
            first=lower - (MARGIN + 3) * step,
            step=np.full(q.shape[1], step),
            count=np.where(span > 0.0, np.ceil(span / step).astype(np.int64) + 2 * MARGIN + 3, 0),
            bends=largest > 1e-3 * max(float(largest.max()), 1e-9),
            torque_scale=np.maximum(largest, 1e-9),
        )

    def without(self, functions: Mask, bends: Mask) -> "JointTerms":
        """Return the terms without some joints' functions (n,) and compliances (n,)."""
        count = np.where(functions, 0, self.count)
        return JointTerms(
            self.before, self.first, self.step, count, self.bends & ~bends, self.torque_scale
        )

    @cached_property
    def offset(self) -> Index:
        """Column (n,) of each joint's first coefficient."""
        start = self.before + int(np.sum(self.bends))
        return start + np.concatenate([[0], np.cumsum(self.count)[:-1]])

    @property
    def size(self) -> int:
        """Number k of all unknowns."""
        return self.before + int(np.sum(self.bends)) + int(np.sum(self.count))

    def block(self, joint: int) -> slice:
        """Columns of a joint's coefficients."""
        return slice(int(self.offset[joint]), int(self.offset[joint] + self.count[joint]))

    def rows(self, q: Array, by_turn: Array, torque: Array | None) -> tuple[Array, Index]:
        """Columns that poses see of these terms: Jacobian (m, c, h) and which unknown, (m, h).

        ``by_turn`` (m, c, n): derivative by what each joint turns, in the controller's sense.
        """
        m, c, n = by_turn.shape
        cell, weight = _splines((q - self.first) / self.step)
        column = cell[..., None] + np.arange(4)
        inside = (column >= 0) & (column < self.count[:, None])
        column = np.where(inside, self.offset[:, None] + column, -1).reshape(m, 4 * n)
        J = (by_turn[..., None] * weight[:, None]).reshape(m, c, 4 * n)
        if not np.any(self.bends):
            return J, column
        assert torque is not None
        by_load = (by_turn * torque[:, None])[:, :, self.bends]
        own = np.broadcast_to(self.before + np.arange(by_load.shape[2]), (m, by_load.shape[2]))
        return np.concatenate([by_load, J], axis=2), np.concatenate([own, column], axis=1)

    def mean_weights(self, joint: int) -> Array:
        """What each coefficient of a joint counts in its function's mean over the measured range.

        The range ends at the first knot beyond the last reading.
        """
        begin, count = MARGIN + 3, int(self.count[joint])
        end = count - MARGIN
        integral = np.array([0.0, 1.0, 12.0, 23.0, 24.0]) / 24.0  # of a spline, up to its knots
        upto_end, upto_begin = (
            integral[np.clip(knot - np.arange(count), 0, 4)] for knot in (end, begin)
        )
        return np.asarray((upto_end - upto_begin) / (end - begin))

    def share_outside(self, q: Array) -> Array:
        """Share (m, n) of the splines at readings (m, n) that no table has."""
        cell, weight = _splines((q - self.first) / self.step)
        column = cell[..., None] + np.arange(4)
        inside = (column >= 0) & (column < self.count[:, None])
        return np.where(self.count > 0, np.sum(weight * ~inside, axis=2), 0.0)

    def functions(self, unknowns: Array) -> JointFunctions | None:
        """Joint functions of a vector (k,) of all unknowns; None of no terms."""
        if self.size == self.before:
            return None
        coefficients = np.zeros((len(self.count), max(1, int(self.count.max()))))
        for joint, count in enumerate(self.count):
            coefficients[joint, :count] = unknowns[self.block(joint)]
        compliance = np.zeros(len(self.count))
        bent = unknowns[self.before : self.before + int(np.sum(self.bends))]
        compliance[self.bends] = np.maximum(bent, 0.0)
        return JointFunctions(self.first, self.step, coefficients, compliance)

    def values(self, functions: JointFunctions | None) -> Array:
        """Return these terms' unknowns (k - before,) in joint functions."""
        if functions is None:
            return np.zeros(self.size - self.before)
        parts = [functions.coefficients[i, :c] for i, c in enumerate(self.count)]
        return np.concatenate([functions.compliance[self.bends], *parts])


def _splines(u: Array) -> tuple[Index, Array]:
    """First of the four splines at u, in knots, and their values (..., 4)."""
    cell = np.floor(u)
    s = u - cell
    r = 1.0 - s
    weights = (r**3, 4.0 - 3.0 * s * s * (1.0 + r), 4.0 - 3.0 * r * r * (1.0 + s), s**3)
    return cell.astype(np.int64) - 3, np.stack(weights, axis=-1) / 6.0


@dataclass(frozen=True)
class FunctionPrior:
    """Lengths and amplitudes (n,) of the joints' functions, rad, and the noise of a residual."""

    length: Array
    amplitude: Array
    noise: float

    @classmethod
    def typical(cls, n: int, noise: float) -> "FunctionPrior":
        """Where the search begins."""
        return cls(np.full(n, LENGTH_RAD), np.full(n, AMPLITUDE_RAD), noise)


def _correlation(count: int, step: float, length: float) -> tuple[Array, Array]:
    """Matérn 5/2 correlation (count, count) of coefficients, and its derivative by log(length)."""
    from scipy.linalg import toeplitz

    d = np.sqrt(5.0) * step / length * np.arange(count)
    decay = np.exp(-d)
    return toeplitz((1.0 + d + d * d / 3.0) * decay), toeplitz(decay * d * d * (1.0 + d) / 3.0)


def prior_covariance(terms: JointTerms, prior: FunctionPrior) -> Array:
    """Covariance (k, k) of all unknowns before the data: of the functions; of others zeros."""
    covariance = np.zeros((terms.size, terms.size))
    for joint in np.flatnonzero(terms.count):
        block, count = terms.block(int(joint)), int(terms.count[joint])
        K, _ = _correlation(count, float(terms.step[joint]), float(prior.length[joint]))
        covariance[block, block] = prior.amplitude[joint] ** 2 * K
    return covariance


@dataclass(frozen=True)
class Posterior:
    """Mean (k,) and covariance (k, k) of all unknowns under a prior.

    Attributes
    ----------
    gain : (n,) evidence for each joint's function, natural logarithm, and ``bend_gain`` (p,) for
        each compliance: the density of its absence before over that after the data (Dickey 1971).
    left : how many numbers the unknowns leave to tell the noise.
    """

    mean: Array
    covariance: Array
    gain: Array
    bend_gain: Array
    left: float


@dataclass(frozen=True)
class JointEvidence:
    """How likely N residuals are, from their normal equations, as a function of the prior.

    Attributes
    ----------
    normal, pull : J^T J (k, k) and J^T y (k,) of the linear model y = J x + noise.
    squares, count : y^T y and N.
    flat : (k,) unknowns without a prior.
    fixed : Cholesky factor (f, f) of the prior covariance of the first unknowns that are not flat
        and not of ``terms``.
    noise_least : smallest noise allowed, where it is known.
    """

    terms: JointTerms
    normal: Array
    pull: Array
    squares: float
    count: float
    flat: Mask
    fixed: Array
    noise_least: float

    @cached_property
    def _reduced(self) -> tuple[Array, Array, float, Array, Array]:
        """Normal equations without the flat unknowns, which take their best values."""
        flat, rest = np.flatnonzero(self.flat), np.flatnonzero(~self.flat)
        cross = np.column_stack([self.normal[np.ix_(flat, rest)], self.pull[flat]])
        own = self.normal[np.ix_(flat, flat)]
        size = 1.0 / np.sqrt(np.maximum(np.diag(own), np.finfo(float).tiny))
        by_rest = np.linalg.solve(own * np.outer(size, size), cross * size[:, None]) * size[:, None]
        reduced = self.normal[np.ix_(rest, rest)] - cross[:, :-1].T @ by_rest[:, :-1]
        pull = self.pull[rest] - cross[:, :-1].T @ by_rest[:, -1]
        squares = self.squares - float(cross[:, -1] @ by_rest[:, -1])
        covariance = np.linalg.inv(own * np.outer(size, size)) * np.outer(size, size)
        return reduced, pull, squares, by_rest, covariance

    @cached_property
    def _blocks(self) -> list[tuple[int, slice]]:
        """Each joint with a function, and its place among the unknowns that are not flat."""
        place = np.cumsum(~self.flat) - 1
        found = []
        for joint in np.flatnonzero(self.terms.count):
            start = int(place[self.terms.offset[joint]])
            found.append((int(joint), slice(start, start + int(self.terms.count[joint]))))
        return found

    def _factors(self, prior: FunctionPrior) -> tuple[list[tuple[slice, Array]], list[Array]]:
        """Cholesky factors of the prior covariance's blocks, and of the joints' functions slopes.

        A slope is the derivative of the block by log(length), between the factor's inverses.
        """
        from scipy.linalg import lapack

        f, bends = len(self.fixed), self.terms.bends
        first = np.zeros((f + int(np.sum(bends)),) * 2)
        first[:f, :f] = self.fixed
        first[range(f, len(first)), range(f, len(first))] = (
            WINDING_RAD / self.terms.torque_scale[bends]
        )
        factors, slopes = [(slice(0, len(first)), first)], []
        for joint, block in self._blocks:
            count = block.stop - block.start
            K, slope = _correlation(count, float(self.terms.step[joint]), prior.length[joint])
            own = np.linalg.cholesky(K + _JITTER * np.eye(count))
            half, _ = lapack.dtrtrs(own, slope, lower=1)
            slopes.append(lapack.dtrtrs(own, half.T, lower=1)[0])
            factors.append((block, prior.amplitude[joint] * own))
        return factors, slopes

    def _whitened(self, prior: FunctionPrior) -> "_Whitened":
        """Everything in units of the prior."""
        from scipy.linalg import lapack

        reduced, pull, *_ = self._reduced
        factors, slopes = self._factors(prior)
        half, B = np.empty_like(reduced), np.empty_like(reduced)
        for block, L in factors:
            half[:, block] = reduced[:, block] @ L
        for block, L in factors:
            B[block] = L.T @ half[block]
        B /= prior.noise**2
        B[np.diag_indices_from(B)] += 1.0
        whitened = np.concatenate([L.T @ pull[block] for block, L in factors])
        R, lost = lapack.dpotrf(B.T, lower=1, overwrite_a=1)  # B is symmetric
        if lost:
            raise np.linalg.LinAlgError("what the data tell is lost in rounding")
        z, _ = lapack.dpotrs(R, whitened / prior.noise**2, lower=1)
        determinant = 2.0 * float(np.sum(np.log(np.diag(R))))
        inverse, _ = lapack.dpotri(R, lower=1, overwrite_c=1)
        return _Whitened(factors, slopes, inverse, z, determinant, float(whitened @ z))

    def _likelihood(self, prior: FunctionPrior) -> tuple[float, Array, Array, "_Whitened"]:
        """Minus the log evidence, its slope (h,), Fisher's information (h, h), and all whitened.

        By the logarithms that are searched: length and amplitude of each block, and the noise.
        """
        at, variance = self._whitened(prior), prior.noise**2
        z = at.mean
        told, p = self.count - float(np.sum(self.flat)), len(at.mean)
        loss = self._reduced[2] - at.explained
        cost = 0.5 * (told * np.log(variance) + at.determinant + loss / variance)
        C = np.tril(at.inverse) + np.tril(at.inverse, -1).T
        gained = np.eye(p) - C  # what the data tell, of one
        by_length = np.zeros_like(C)
        slope, with_noise = [], []
        for (_, block), change in zip(self._blocks, at.slopes, strict=True):
            by_length[block] = change @ gained[block]
            pulled, told_here = z[block], float(np.trace(gained[block, block]))
            length_here = float(np.trace(by_length[block, block]))
            slope.append(0.5 * (length_here - float(pulled @ change @ pulled)))
            slope.append(told_here - float(pulled @ pulled))
            with_noise.append(length_here - float(np.sum(by_length[block] * gained[block])))
            with_noise.append(2.0 * (told_here - float(np.sum(gained[block] ** 2))))
        slope.append(told - at.taken - loss / variance + float(z @ z))
        first = [block.start for _, block in self._blocks]

        def summed(product: Array) -> Array:
            """Its sums over pairs of blocks."""
            if not first:  # compliances alone
                return np.zeros((0, 0))
            part = product[first[0] :, first[0] :]
            places = np.array(first) - first[0]
            return np.asarray(np.add.reduceat(np.add.reduceat(part, places, 0), places, 1))

        h = len(slope)
        fisher = np.zeros((h, h))
        fisher[:-1:2, :-1:2] = 0.5 * summed(by_length * by_length.T)
        fisher[:-1:2, 1:-1:2] = summed(by_length * gained)
        fisher[1:-1:2, :-1:2] = fisher[:-1:2, 1:-1:2].T
        fisher[1:-1:2, 1:-1:2] = 2.0 * summed(gained**2)
        fisher[-1, :-1] = fisher[:-1, -1] = with_noise
        fisher[-1, -1] = 2.0 * (told - p + float(np.sum(C**2)))
        return cost, np.array(slope), fisher, at

    def maximise(self, start: FunctionPrior) -> tuple[FunctionPrior, Posterior]:
        """The prior under which the data are most likely, and what is known under it.

        By Fisher's scoring over the logarithms of lengths, amplitudes and noise.
        """
        joints = [joint for joint, _ in self._blocks]
        h = 2 * len(joints) + 1
        centre, precision = np.zeros(h), np.zeros(h)
        centre[:-1] = np.tile(np.log([LENGTH_RAD, AMPLITUDE_RAD]), len(joints))
        precision[:-1] = np.tile([LENGTH_FACTOR**-2, AMPLITUDE_FACTOR**-2], len(joints))
        lower, upper = np.full(h, np.log(1e-7)), np.full(h, np.log(5e-3))
        lower[:-1:2], upper[:-1:2] = np.log(0.5 * self.terms.step[joints]), np.log(np.pi)
        lower[-1] = np.log(max(self.noise_least, LEAST_NOISE_SHARE * start.noise))
        upper[-1] = np.inf

        def evaluated(x: Array) -> tuple[FunctionPrior, _Whitened, float, Array, Array]:
            length, amplitude = start.length.copy(), start.amplitude.copy()
            length[joints], amplitude[joints] = np.exp(x[:-1:2]), np.exp(x[1:-1:2])
            prior = FunctionPrior(length, amplitude, float(np.exp(x[-1])))
            cost, slope, fisher, at = self._likelihood(prior)
            away = precision * (x - centre)
            cost += 0.5 * float(away @ (x - centre))
            return prior, at, cost, slope + away, fisher + np.diag(precision)

        x = np.empty(h)
        x[:-1:2], x[1:-1:2] = np.log(start.length[joints]), np.log(start.amplitude[joints])
        x[-1] = np.log(start.noise)
        x = np.clip(x, lower, upper)
        prior, at, cost, slope, fisher = evaluated(x)
        for _ in range(_STEPS):
            free = ~(((x <= lower) & (slope > 0.0)) | ((x >= upper) & (slope < 0.0)))
            if not free.any():
                break
            step = np.zeros(h)
            step[free] = np.linalg.solve(fisher[np.ix_(free, free)], -slope[free])
            step *= min(1.0, LONGEST_STEP / float(np.max(np.abs(step))))
            flat = max(FLAT, FLAT_SHARE * abs(cost))
            if -0.5 * float(slope @ step) < flat:
                break
            last = cost
            for share in (1.0, 0.3, 0.1):
                trial = np.clip(x + share * step, lower, upper)
                found = evaluated(trial)
                if found[2] < cost:
                    x, (prior, at, cost, slope, fisher) = trial, found
                    break
            if last - cost < flat:
                break
        return prior, self._posterior(prior, at)

    def posterior(self, prior: FunctionPrior) -> Posterior:
        """What the data and the prior say of all unknowns."""
        return self._posterior(prior, self._whitened(prior))

    def _posterior(self, prior: FunctionPrior, at: "_Whitened") -> Posterior:
        *_, by_rest, flat_covariance = self._reduced
        flat, rest = np.flatnonzero(self.flat), np.flatnonzero(~self.flat)
        inverse = np.tril(at.inverse) + np.tril(at.inverse, -1).T
        mean, covariance = np.zeros(len(self.flat)), np.zeros((len(self.flat),) * 2)
        mean[rest] = np.concatenate([L @ at.mean[block] for block, L in at.factors])
        half, own = np.empty_like(inverse), np.empty_like(inverse)
        for block, L in at.factors:
            half[:, block] = inverse[:, block] @ L.T
        for block, L in at.factors:
            own[block] = L @ half[block]
        mean[flat] = by_rest[:, -1] - by_rest[:, :-1] @ mean[rest]
        cross = -by_rest[:, :-1] @ own
        covariance[np.ix_(rest, rest)] = own
        covariance[np.ix_(flat, rest)], covariance[np.ix_(rest, flat)] = cross, cross.T
        covariance[np.ix_(flat, flat)] = (
            prior.noise**2 * flat_covariance - cross @ by_rest[:, :-1].T
        )
        gain = np.full(len(self.terms.count), -np.inf)
        for joint, block in self._blocks:
            gain[joint] = _gain(inverse[block, block], at.mean[block])
        f, b = len(self.fixed), int(np.sum(self.terms.bends))
        alone = [slice(i, i + 1) for i in range(f, f + b)]
        bends = np.array([_gain(inverse[i, i], at.mean[i]) for i in alone])
        return Posterior(mean, covariance, gain, bends, self.count - len(flat) - at.taken)


@dataclass(frozen=True)
class _Whitened:
    """A linear model in units of its prior: unknowns L^-1 x with L of blocks.

    Attributes
    ----------
    factors, slopes : of ``JointEvidence._factors``.
    inverse : (p, p) lower triangle of the inverse of B = I + L^T A L / s^2.
    mean : (p,).
    determinant : log det B.
    explained : by how much the unknowns lessen the squares, prior included.
    """

    factors: list[tuple[slice, Array]]
    slopes: list[Array]
    inverse: Array
    mean: Array
    determinant: float
    explained: float

    @property
    def taken(self) -> float:
        """How many numbers the unknowns take up."""
        return len(self.mean) - float(np.trace(self.inverse))


def _gain(covariance: Array, mean: Array) -> float:
    """Evidence for unknowns whose prior was a unit normal, against their all being zero."""
    _, determinant = np.linalg.slogdet(covariance)
    return 0.5 * float(determinant + mean @ np.linalg.solve(covariance, mean))
