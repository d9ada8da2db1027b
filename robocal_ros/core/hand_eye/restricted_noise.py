"""How well the robot repeats and the eye aims, from what a fit leaves over.

Restricted maximum likelihood (Patterson and Thompson 1971): the noise at which that part of the
measurements is most likely which the unknowns cannot explain.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.hand_eye.mount_problem import MountProblem, MountState, PoseNoise

Array = NDArray[np.float64]

FIRST_NOISE = PoseNoise(5e-5, 5e-5, 1e-4)  # turns count as shifts at an arm's length of 1 m
NOISE_RANGE_M = (1e-6, 1e-2)
TOLERANCE = 0.005  # of the noise


def restricted_noise(
    problem: MountProblem, state: MountState, keep: NDArray[np.bool_], given: PoseNoise | None
) -> PoseNoise:
    """The most likely noise of poses, unless it is ``given``, and of light that is laid by eye.

    ``keep`` (g,): samples that are used.
    """
    from scipy.optimize import minimize

    r, J, G, C = (part[keep] for part in problem.grouped(problem.linear(state)))
    unknown = ["sigma_m"] if given is None else []
    unknown += ["aim_m"] if np.any(G[..., 6:]) else []
    if not unknown:
        return problem.noise
    k = J.shape[2]
    prior = problem.prior()
    known = np.zeros((k, k)) if prior is None else prior
    both = np.concatenate([r[..., None], J], axis=2)

    def cost(log_sigma: Array) -> float:
        common = _with(problem.noise, unknown, log_sigma).covariance()
        L = np.linalg.cholesky(C + G @ common @ np.swapaxes(G, 1, 2))
        white = np.linalg.solve(L, both).reshape(-1, k + 1)
        normal = white[:, 1:].T @ white[:, 1:] + known
        gradient = white[:, 1:].T @ white[:, 0]
        misfit = white[:, 0] @ white[:, 0] - gradient @ np.linalg.solve(normal, gradient)
        spread = 2.0 * np.sum(np.log(np.diagonal(L, axis1=1, axis2=2)))
        return float(misfit + spread + np.linalg.slogdet(normal)[1])

    start = np.log([getattr(problem.noise, field) for field in unknown])
    corners = np.vstack([start, start + np.log(1.5) * np.eye(len(start))])
    best = minimize(
        cost,
        start,
        method="Nelder-Mead",
        bounds=[tuple(np.log(NOISE_RANGE_M))] * len(start),
        options={"xatol": TOLERANCE, "fatol": 1e-3, "initial_simplex": corners},
    )
    return _with(problem.noise, unknown, best.x)


def _with(noise: PoseNoise, unknown: list[str], log_sigma: Array) -> PoseNoise:
    found = replace(noise, **dict(zip(unknown, np.exp(log_sigma).tolist(), strict=True)))
    if "sigma_m" in unknown:
        ratio = FIRST_NOISE.sigma_rad / FIRST_NOISE.sigma_m
        return replace(found, sigma_rad=ratio * found.sigma_m)
    return found
