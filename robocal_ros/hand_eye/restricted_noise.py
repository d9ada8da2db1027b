"""How well the robot repeats and the eye aims, from what a fit leaves over.

Restricted maximum likelihood (Patterson and Thompson 1971): the noise at which that part of the
measurements is most likely which the unknowns cannot explain.
"""

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.hand_eye.mount_problem import COMMON, MountProblem, MountState, PoseNoise

Array = NDArray[np.float64]

FIRST_NOISE = PoseNoise(5e-5, 5e-5, 1e-4)  # turns count as shifts at an arm's length of 1 m
NOISE_RANGE_M = (1e-6, 1e-2)
FLAT = 0.02  # slope of the likelihood: a hundredth of the noise's own uncertainty
NEAR = 0.2  # relative step in which the likelihood's bend is seen
NODES = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # standard deviations of a noise's logarithm
WIDEST = 1.0  # of them


class RestrictedLikelihood:
    """The restricted likelihood of noises that are not known, by their logarithms."""

    def __init__(
        self,
        problem: MountProblem,
        state: MountState,
        keep: NDArray[np.bool_],
        given: PoseNoise | None,
    ) -> None:
        r, J, G, C = (part[keep] for part in problem.grouped(problem.linear(state)))
        self.unknown = ["sigma_m"] if given is None else []
        self.unknown += ["aim_m"] if np.any(G[..., 6:]) else []
        self._own, self._noise = C, problem.noise
        self._all = np.concatenate([r[..., None], J, G], axis=2)
        self._known = problem.prior()
        self._pull = self._known @ problem.deviation(state)

    @property
    def now(self) -> Array:
        """Logarithms (n,) of the problem's own noise."""
        return np.log([getattr(self._noise, field) for field in self.unknown])

    def noise(self, log_sigma: Array) -> PoseNoise:
        """The noise that they stand for."""
        return _with(self._noise, self.unknown, log_sigma)

    def at(self, log_sigma: Array) -> tuple[float, Array, Array]:
        """-2 log likelihood, normal matrix (k, k) and the step (k,) to the best state there."""
        cost, normal, step, _, _ = self._whitened(log_sigma)
        return cost, normal, step

    def with_slope(self, log_sigma: Array) -> tuple[float, Array]:
        """-2 log likelihood and its slope (n,)."""
        cost, normal, step, white, common = self._whitened(log_sigma)
        J, G = white[..., 1:-COMMON], white[..., -COMMON:]
        left = white[..., 0] + J @ step
        JG = np.swapaxes(J, 1, 2) @ G
        grown = np.sum(G**2, axis=(0, 1)) - np.sum(JG * np.linalg.solve(normal, JG), axis=(0, 1))
        fitted = np.sum((left[:, None, :] @ G) ** 2, axis=(0, 1))
        each = 2.0 * np.diag(common) * (grown - fitted)
        parts = {"sigma_m": each[:6].sum(), "aim_m": each[6:].sum()}
        return cost, np.array([parts[field] for field in self.unknown])

    def _whitened(self, log_sigma: Array) -> tuple[float, Array, Array, Array, Array]:
        common = self.noise(log_sigma).covariance()
        G = self._all[..., -COMMON:]
        L = np.linalg.cholesky(self._own + G @ common @ np.swapaxes(G, 1, 2))
        white = np.linalg.solve(L, self._all)
        r, J = white[..., 0].ravel(), white[..., 1:-COMMON].reshape(-1, len(self._known))
        normal = J.T @ J + self._known
        gradient = J.T @ r + self._pull
        step = -np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        cost = r @ r + gradient @ step + spread + np.linalg.slogdet(normal)[1]
        return float(cost), normal, np.asarray(step), white, common


def restricted_noise(
    problem: MountProblem, state: MountState, keep: NDArray[np.bool_], given: PoseNoise | None
) -> tuple[PoseNoise, bool]:
    """The most likely noise of poses, unless it is ``given``, and of light that is laid by eye.

    ``keep`` (g,): samples that are used. The flag: whether the likelihood's top was reached.
    """
    from scipy.optimize import minimize

    likely = RestrictedLikelihood(problem, state, keep, given)
    if not likely.unknown:
        return problem.noise, True
    low, high = np.log(NOISE_RANGE_M)
    best = minimize(
        likely.with_slope,
        likely.now,
        jac=True,
        method="L-BFGS-B",
        bounds=[(low, high)] * len(likely.unknown),
        options={"gtol": FLAT},
    )
    # The search also ends, and well by its own account, where no step of it lowers the cost.
    downhill = np.clip(best.x - best.jac, low, high) - best.x
    return likely.noise(best.x), bool(np.max(np.abs(downhill)) <= FLAT)


def averaged_covariance(problem: MountProblem, state: MountState, given: PoseNoise | None) -> Array:
    """Covariance (k, k) of the unknowns, averaged over what the noise may be.

    Few poses tell their own noise badly, and the covariance for the likeliest one is too small: for
    n numbers to spare the mean of the noise's square is wider by n / (n - 3). By the law of total
    variance, summed over a grid around the problem's own noise, which is the likeliest. The prior
    is flat in the noise (Gelman 2006, Bayesian Analysis 1:515), not in its logarithm: that would
    believe in noises near zero wherever what features err by hides them, and tell too little.
    """
    keep = np.ones(len(problem.poses), dtype=np.bool_)
    likely = RestrictedLikelihood(problem, state, keep, given)
    best = likely.now
    least, normal, _ = likely.at(best)
    if not likely.unknown:
        return np.asarray(np.linalg.inv(normal))
    width = []
    for axis in NEAR * np.eye(len(best)):
        bend = (likely.at(best + axis)[0] + likely.at(best - axis)[0] - 2.0 * least) / NEAR**2
        width.append(np.sqrt(2.0 / max(bend, 2.0 / WIDEST**2)))
    total, weights = np.zeros_like(normal), 0.0
    for nodes in product(NODES, repeat=len(best)):
        away = np.array(width) * nodes
        cost, normal, step = likely.at(best + away)
        weight = float(np.exp(0.5 * (least - cost) + away.sum()))
        total += weight * (np.linalg.inv(normal) + np.outer(step, step))
        weights += weight
    return np.asarray(total / weights)


def _with(noise: PoseNoise, unknown: list[str], log_sigma: Array) -> PoseNoise:
    found = replace(noise, **dict(zip(unknown, np.exp(log_sigma).tolist(), strict=True)))
    if "sigma_m" in unknown:
        ratio = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m
        return replace(found, sigma_rad=ratio * found.sigma_m)
    return found
