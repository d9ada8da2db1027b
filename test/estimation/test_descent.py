# SPDX-License-Identifier: Apache-2.0
"""When a descent counts as converged."""

from dataclasses import dataclass

import numpy as np
import pytest

from robocal_ros.estimation.estimation import FIRST_TOLERANCE, STEP_TOLERANCE, Descent, DescentState


@dataclass(frozen=True)
class Rough:
    """Two numbers measured ten times, in units of sigma, with a Jacobian that misses a ripple.

    As a flange's path through noisy joint readings is: the ripple's slope is the Jacobian's error.
    """

    ripple: float
    pitch: float = 1e-5

    names = ("x", "y")
    scale_components = 2

    def linearise(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        angle = state / self.pitch + np.arange(10)[:, None]
        residual = state - np.linspace(-1.0, 1.0, 10)[:, None] + self.ripple * np.sin(angle)
        return residual, np.tile(np.eye(2), (10, 1, 1))

    def retract(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step

    def deviation(self, state: np.ndarray) -> np.ndarray:
        return np.zeros(2)


def descended(ripple: float, start: float) -> DescentState:
    problem = Rough(ripple)
    descent = Descent(problem, np.zeros((2, 2)), 0, np.full(10, 2))
    state = np.full(2, start)
    return descent.run(
        DescentState(state, *problem.linearise(state), 0, False), np.ones(10, dtype=bool)
    )


def test_a_smooth_problem_converges():
    run = descended(0.0, start=3.0)
    assert run.converged
    assert run.state == pytest.approx([0.0, 0.0], abs=1e-12)


@pytest.mark.parametrize("start", [-2.0, 0.3, 5.0])
def test_where_no_step_helps_a_place_far_below_a_sigma_is_found(start):
    """A ripple of 1e-3 sigma lets the full step wander by 1e-3 / sqrt(10) sigma for ever."""
    run = descended(1e-3, start)
    assert run.converged
    sigma = 1.0 / np.sqrt(10.0)
    assert np.all(np.abs(run.state) < 2.0 * FIRST_TOLERANCE * sigma)


def test_where_no_step_helps_far_away_nothing_is_found():
    """Ripples of a sigma hold it where the full step is still a part of a sigma."""
    found = [descended(2.0, start) for start in np.linspace(-3.0, 3.0, 13)]
    to_go = [np.linalg.norm(run.residual.mean(axis=0)) for run in found]
    held = [run for run, step in zip(found, to_go, strict=True) if step > 0.1]
    assert held
    assert not any(run.converged for run in held)


@dataclass(frozen=True)
class Bent:
    """One number whose residual curves by a share of the squared slope where it is smallest."""

    share: float

    names = ("x",)
    scale_components = 1

    def linearise(self, state: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        x = state[0]
        residual = np.array([[x], [1.0 + 0.5 * self.share * x**2]])
        return residual, np.array([[[1.0]], [[self.share * x]]])

    def retract(self, state: np.ndarray, step: np.ndarray) -> np.ndarray:
        return state + step

    def deviation(self, state: np.ndarray) -> np.ndarray:
        return np.zeros(1)


@pytest.mark.parametrize("share", [0.4, 0.9, 0.99, 1.5])
@pytest.mark.parametrize("start", [0.01, -0.5])
def test_a_step_that_overshoots_for_ever_is_shortened(share, start):
    """Whole steps of Gauss-Newton end at -share times where they began: 0.99 needs 500 of them."""
    problem = Bent(share)
    state = np.array([start])
    begin = DescentState(state, *problem.linearise(state), 0, False)
    run = Descent(problem, np.zeros((1, 1)), 0, np.full(2, 1)).run(begin, np.ones(2, dtype=bool))
    assert run.converged
    assert abs(run.state[0]) < STEP_TOLERANCE  # of the sigma, which is one
    assert run.iterations < 20


@pytest.mark.parametrize("sigma", [1e-10, 1e-9, 1e-6, 1e-3])
def test_a_prior_counts_beside_almost_exact_data(sigma):
    """Of six numbers the data show four; the other two are known as well as before."""
    rng = np.random.default_rng(3)
    turn = np.linalg.qr(rng.standard_normal((6, 6)))[0]
    J = rng.standard_normal((100, 4)) @ turn[:4]
    prior = np.eye(6) / 3e-3**2
    descent = Descent(Rough(0.0), prior, 0, np.full(100, 1))
    covariance = descent.posterior(J.T @ J, sigma) @ turn.T
    shown = np.linalg.inv(turn[:4] @ (J.T @ J / sigma**2 + prior) @ turn[:4].T)
    rounding = np.finfo(float).eps * 3e-3**2  # of a matrix that holds both
    np.testing.assert_allclose(turn[:4] @ covariance[:, :4], shown, rtol=1e-6, atol=rounding)
    np.testing.assert_allclose(
        turn[4:] @ covariance[:, 4:], 3e-3**2 * np.eye(2), rtol=1e-6, atol=1e-11
    )
