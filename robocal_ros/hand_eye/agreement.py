# SPDX-License-Identifier: Apache-2.0
"""Whether targets that are solved together place the sensor alike, and have stood still.

What contradicts looks like a robot with more noise: a mount between what each of the targets says
fits all of them badly, and its sigma, which that noise gives, does not hold the difference. So each
is asked where it would place the sensor by itself, and each series where its target was before a
shot and after it; the noise is found with that left open.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import fdtrc

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.mount_fit import MountFit, noise_numbers
from robocal_ros.hand_eye.mount_problem import (
    COMPONENTS,
    SENSOR_UNKNOWNS,
    Bend,
    MountProblem,
    RestrictedLikelihood,
    restricted_noise,
)
from robocal_ros.hand_eye.result import PoseNoise, expected_error_m

# Chance that what agrees is said not to, as of a clean set that loses a shot.
FALSE_ALARM = 1e-4
OWN = len(SENSOR_UNKNOWNS)
FEWEST_EACH = 3  # shots of a target before it moved, and after


@dataclass(frozen=True)
class Disagreement:
    """One target places the sensor elsewhere than the others do, or was elsewhere later on.

    ``index``: of the target; ``since``: the shot from which on it was elsewhere; empty: it
    contradicts the others. ``apart_m``, ``sigma_m``: by how much, and how well that is known.
    ``beyond_m``: what the mount may be off by for that, which its noise does not explain. Root mean
    squares over points of the field, or of the target. ``chance``: that what agrees is so far
    apart.
    """

    index: int
    since: str
    apart_m: float
    sigma_m: float
    beyond_m: float
    chance: float

    def judged(self, verdict: Verdict, kinds: Sequence[str], too_far: bool) -> Verdict:
        """A verdict that says so; where it makes the error ``too_far``, a refusal."""
        far = f"{self.apart_m * 1e3:.2f} mm (sigma {self.sigma_m * 1e3:.2f})"
        if self.since:
            words = f"from {self.since} on the {kinds[self.index]} is {far} from where it was "
            words += "before: has it moved there, or the sensor?"
        else:
            others = " and ".join(kind for n, kind in enumerate(kinds) if n != self.index)
            words = f"{kinds[self.index]} contradicts {others}: by its own shots the sensor is "
            words += f"{far} from where it is by the others', in the field of view: has a target "
            words += "or the sensor moved between them, is what is known of each right?"
        if too_far and verdict.code in (Code.ACCEPT, Code.POSES_NOT_INFORMATIVE):
            return Verdict(Code.RESIDUAL_TOO_LARGE, words)
        return Verdict(verdict.code, f"{verdict.reason}; {words}")


def disagreement(fit: MountFit, given: PoseNoise | None, points: Array) -> Disagreement | None:
    """What contradicts most surely among several targets; None where all agree.

    ``given``: noise of poses, where it is known. ``points`` (n, 3): of the field, sensor frame, m.
    """
    if len(fit.views) < 2:
        return None
    asked = range(len(fit.views)) if len(fit.views) > 2 else [1]
    found = [_apart(fit, index, given, points, len(asked)) for index in asked]
    found += [one for i in range(len(fit.views)) for one in _moved(fit, i, given, points)]
    surest = min(found, key=lambda one: one.chance)
    return surest if surest.chance < FALSE_ALARM else None


def _apart(
    fit: MountFit, index: int, given: PoseNoise | None, points: Array, tries: int
) -> Disagreement:
    """How far a target's own mount is from that of the others: six more unknowns, of it alone."""
    problem = MountProblem(fit.views, fit.noise, fit.state)
    moves = problem.linear(fit.state).jacobian[..., :OWN]
    opened = _Opened(fit, moves * _of(fit, index)[:, None, None], given)
    at = np.asarray(points - problem.pivot, dtype=np.float64)
    apart_m = _shift_m(opened.d, at)
    sigma_m = float(expected_error_m(opened.covariance, at))
    beyond_m = float(np.sqrt(max(apart_m**2 - sigma_m**2, 0.0)))  # who is right is not known
    return Disagreement(index, "", apart_m, sigma_m, beyond_m, tries * opened.chance)


def _moved(
    fit: MountFit, index: int, given: PoseNoise | None, points: Array
) -> Iterator[Disagreement]:
    """Where a target that is found too was from one of its shots on, of all the likeliest."""
    problem, s = MountProblem(fit.views, fit.noise, fit.state), fit.views[index].sightings
    first = OWN + sum(len(view.model.names) for view in fit.views[:index])
    own = slice(first, first + len(fit.views[index].model.names))
    shots, rows = np.unique(s.shot), _of(fit, index)
    if own.start == own.stop or len(shots) < 2 * FEWEST_EACH:
        return
    moves, later = problem.linear(fit.state).jacobian[..., own], np.zeros(len(rows))
    best, tried = None, shots[FEWEST_EACH : len(shots) - FEWEST_EACH + 1]
    for shot in tried:
        later[rows] = s.shot >= shot
        opened = _Opened(fit, moves * later[:, None, None], fit.noise)
        if best is None or opened.chance < best[0]:
            best = opened.chance, shot, moves * later[:, None, None]
    if best is None:
        return
    opened = _Opened(fit, best[2], given)
    T = s.T_base_flange @ fit.state.T_flange_sensor
    spread = fit.views[index].model.see(T, fit.state.places[index]).spread
    variance = np.einsum("mik,kl,mil->m", spread, opened.covariance, spread)
    yield Disagreement(
        index,
        s.names[int(np.flatnonzero(s.shot == best[1])[0])],
        float(np.sqrt(np.mean(np.sum((spread @ opened.d) ** 2, axis=1)))),
        float(np.sqrt(np.mean(variance))),
        _shift_m(opened.mount, np.asarray(points - problem.pivot, dtype=np.float64)),
        len(tried) * opened.chance,
    )


def _of(fit: MountFit, index: int) -> NDArray[np.bool_]:
    """Which sightings (m,) are of a target, as a mask."""
    sizes = [len(view.sightings.names) for view in fit.views]
    return np.asarray(np.repeat(np.arange(len(sizes)), sizes) == index)


def _shift_m(step: Array, at: Array) -> float:
    """Root mean square shift of points (n, 3), counted from the pivot, by an increment (6,)."""
    moved = step[:3] + at @ frames.skew(step[3:]).T
    return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))


class _Opened:
    """A fit with k more unknowns, to first order: what they come to, and the mount with it.

    Squares of the unknowns over what they are known to follow Fisher's distribution, for the noise
    is found from the same data. ``moves`` (m, 3, k): of each sighting with them.
    """

    def __init__(self, fit: MountFit, moves: Array, given: PoseNoise | None) -> None:
        bent, none = fit.bend or Bend({}, np.zeros(0)), np.zeros((COMPONENTS, 0))
        pull = {
            name: np.concatenate([move, bent.pull.get(name, none)], axis=1)
            for name, move in zip(fit.names, moves, strict=True)
        }
        more = moves.shape[2]
        bend = Bend(pull, np.concatenate([np.zeros(more), bent.taken]))
        problem = MountProblem(fit.views, fit.noise, fit.state, bend=bend)
        keep = np.ones(len(problem.poses), dtype=np.bool_)
        noise, _ = restricted_noise(problem, fit.state, keep, given)
        problem = MountProblem(fit.views, noise, fit.state, bend=bend)
        likely = RestrictedLikelihood(problem, fit.state, keep, given)
        _, normal, step, white, common = likely.at(likely.now)
        left = white[..., 0] + white[..., 1 : -len(common)] @ step
        k = len(problem.names)
        own, spare = slice(k, k + more), max(int(problem.sizes.sum()) - k - more, 1)
        told = spare if given is not None else min(noise_numbers(problem) - more, spare)
        scale = max(float(np.sum(left**2)) / spare, 1.0)
        self.d, self.mount = np.asarray(step[own]), np.asarray(step[:OWN])
        self.covariance = np.asarray(scale * np.linalg.inv(normal)[own, own], dtype=np.float64)
        squares = float(self.d @ np.linalg.solve(self.covariance, self.d))
        self.chance = float(fdtrc(more, max(told, 1), squares / more))
