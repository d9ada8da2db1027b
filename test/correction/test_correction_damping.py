# SPDX-License-Identifier: Apache-2.0
"""The compiled damping is that of equations 2 and 3, whatever eigenvalues lie together."""

from collections.abc import Callable

import numpy as np
import pytest

from robocal_ros.correction import damping

Draw = Callable[[np.random.Generator], np.ndarray]
EPS = np.finfo(float).eps
# three eigenvalues, some of them in the reach of a damping (1e-3 to 1)
SPECTRA: dict[str, Draw] = {
    "apart": lambda rng: 10.0 ** rng.uniform(-6.0, 1.0, 3),
    "all equal": lambda rng: np.full(3, 10.0 ** rng.uniform(-3.0, 1.0)),
    "equal to rounding": lambda rng: 1.0 + rng.integers(-3, 4, 3) * EPS,
    "two equal, one smaller": lambda rng: np.array([1.0, 1.0, 10.0 ** rng.uniform(-9.0, 0.0)]),
    "two equal, one larger": lambda rng: np.array([1.0, 1.0, 10.0 ** rng.uniform(0.0, 3.0)]) * 0.1,
    "two almost equal": lambda rng: np.array([1.0, 1.0 + 10.0 ** rng.uniform(-16.0, -1.0), 2.0]),
    "one, and nothing": lambda rng: np.array([1.0, 0.0, 0.0]),
    "nothing": lambda rng: np.zeros(3),
}


def with_spectrum(draw: Draw, rng: np.random.Generator, turned: bool) -> np.ndarray:
    """A symmetric matrix; where it is not turned, its axes are those of the base."""
    axes = np.linalg.qr(rng.standard_normal((3, 3)))[0] if turned else np.eye(3)
    return np.asarray((axes * rng.permutation(draw(rng))) @ axes.T)


def d(M: np.ndarray, square: float) -> np.ndarray:
    s, U = np.linalg.eigh(M)
    return np.asarray((U * square * np.maximum(1.0 - s / (3.0 * square), 0.0) ** 3) @ U.T)


def by_the_equations(
    A: np.ndarray, B: np.ndarray, C: np.ndarray, squares: tuple[float, float]
) -> tuple[np.ndarray, np.ndarray]:
    P = d(A, squares[0])
    T = np.linalg.solve(A + P, B)
    L = np.linalg.cholesky(np.eye(3) + T.T @ T)
    inner = np.linalg.solve(L, np.linalg.solve(L, C - B.T @ T).T)
    return P, L @ d(0.5 * (inner + inner.T), squares[1]) @ L.T


@pytest.mark.parametrize("of_turn", SPECTRA)
@pytest.mark.parametrize("of_position", SPECTRA)
def test_damping_is_that_of_its_equations(of_position: str, of_turn: str) -> None:
    rng = np.random.default_rng(3)
    for k in range(50):
        A = with_spectrum(SPECTRA[of_position], rng, k % 5 > 0)
        # blocks of a J J^T: B within the reach of A, C so that the turn alone has its spectrum
        s, U = np.linalg.eigh(A)
        root = (U * np.sqrt(np.maximum(s, 0.0))) @ U.T
        share = rng.uniform(-1.0, 1.0, (3, 3)) if k % 5 > 1 else np.zeros((3, 3))
        B, C = root @ share, share.T @ share + with_spectrum(SPECTRA[of_turn], rng, k % 5 > 0)
        e = 10.0 ** rng.uniform(-3.0, 0.0) * rng.standard_normal(6)
        size = np.hypot([np.linalg.norm(e[:3]), np.linalg.norm(e)], damping.LEAST_ERROR)
        squares = size * np.hypot(1.0, 0.3 * size)
        blocks = (tuple(block.ravel().tolist()) for block in (A, B, C))
        found = damping.damping(*blocks, tuple(e.tolist()), 1.0, 0.3)
        # rounding, and how much the inverse of A + P makes of it
        P, R = by_the_equations(A, B, C, (float(squares[0]), float(squares[1])))
        least, size_of_P = np.linalg.eigvalsh(A + P)[0], np.trace(A) + squares[0]
        size_of_R = (1.0 + np.trace(B.T @ B) / least**2) * (np.trace(C) + squares[1])
        bounds = 30.0 * EPS * size_of_P, 30.0 * EPS * size_of_R * (1.0 + size_of_P / least)
        for block, wanted, bound in zip(found, (P, R), bounds, strict=False):
            np.testing.assert_allclose(np.reshape(block, (3, 3)), wanted, rtol=0.0, atol=bound)
