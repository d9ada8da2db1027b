"""How well the robot repeats and the eye aims, from what a fit leaves over.

Restricted maximum likelihood (Patterson and Thompson 1971): the noise at which that part of the
measurements is most likely which the unknowns cannot explain.
"""

from dataclasses import replace
from itertools import product

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.hand_eye.mount_problem import MountProblem, MountState, PoseNoise

Array = NDArray[np.float64]

FIRST_NOISE = PoseNoise(5e-5, 5e-5, 1e-4)  # turns count as shifts at an arm's length of 1 m
NOISE_RANGE_M = (1e-6, 1e-2)
TOLERANCE = 0.005  # of the noise
NEAR = 0.2  # relative step in which the likelihood's bend is seen
NODES = (-2.0, -1.0, 0.0, 1.0, 2.0, 3.0, 4.0)  # standard deviations of a noise's logarithm
WIDEST = 1.0  # of them


class _Restricted:
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
        self._common, self._own, self._noise = G, C, problem.noise
        self._both = np.concatenate([r[..., None], J], axis=2)
        prior, k = problem.prior(), J.shape[2]
        self._known = np.zeros((k, k)) if prior is None else prior
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
        G, common = self._common, self.noise(log_sigma).covariance()
        L = np.linalg.cholesky(self._own + G @ common @ np.swapaxes(G, 1, 2))
        white = np.linalg.solve(L, self._both).reshape(-1, self._both.shape[2])
        normal = white[:, 1:].T @ white[:, 1:] + self._known
        gradient = white[:, 1:].T @ white[:, 0] + self._pull
        step = -np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        cost = white[:, 0] @ white[:, 0] + gradient @ step + spread + np.linalg.slogdet(normal)[1]
        return float(cost), normal, np.asarray(step)


def restricted_noise(
    problem: MountProblem, state: MountState, keep: NDArray[np.bool_], given: PoseNoise | None
) -> PoseNoise:
    """The most likely noise of poses, unless it is ``given``, and of light that is laid by eye.

    ``keep`` (g,): samples that are used.
    """
    from scipy.optimize import minimize

    likely = _Restricted(problem, state, keep, given)
    if not likely.unknown:
        return problem.noise
    start = likely.now
    best = minimize(
        lambda log_sigma: likely.at(log_sigma)[0],
        start,
        method="Nelder-Mead",
        bounds=[tuple(np.log(NOISE_RANGE_M))] * len(start),
        options={
            "xatol": TOLERANCE,
            "fatol": 1e-3,
            "initial_simplex": np.vstack([start, start + np.log(1.5) * np.eye(len(start))]),
        },
    )
    return likely.noise(best.x)


def averaged_covariance(problem: MountProblem, state: MountState, given: PoseNoise | None) -> Array:
    """Covariance (k, k) of the unknowns, averaged over what the noise may be.

    Few poses tell their own noise badly, and the covariance for the likeliest one is too small: for
    n numbers to spare by n / (n - 2). By the law of total variance, with a flat prior of the
    noise's logarithm, summed over a grid around the problem's own noise, which is the likeliest.
    """
    keep = np.ones(len(problem.poses), dtype=np.bool_)
    likely = _Restricted(problem, state, keep, given)
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
        cost, normal, step = likely.at(best + np.array(width) * nodes)
        weight = float(np.exp(0.5 * (least - cost)))
        total += weight * (np.linalg.inv(normal) + np.outer(step, step))
        weights += weight
    return np.asarray(total / weights)


def _with(noise: PoseNoise, unknown: list[str], log_sigma: Array) -> PoseNoise:
    found = replace(noise, **dict(zip(unknown, np.exp(log_sigma).tolist(), strict=True)))
    if "sigma_m" in unknown:
        ratio = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m
        return replace(found, sigma_rad=ratio * found.sigma_m)
    return found
