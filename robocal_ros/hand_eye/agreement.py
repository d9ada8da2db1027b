# SPDX-License-Identifier: Apache-2.0
"""Whether targets that are solved together place the sensor alike.

Targets that contradict each other look like a robot with more noise: a mount between what each of
them says fits all of them badly, and its sigma, which that noise gives, does not hold the
difference. So each is asked where it would place the sensor by itself, and the noise is found with
that left open.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
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

# Chance that targets which agree are said not to, as of a clean set that loses a shot.
FALSE_ALARM = 1e-4
OWN = len(SENSOR_UNKNOWNS)


@dataclass(frozen=True)
class Disagreement:
    """One target places the sensor elsewhere than the others do.

    ``index``: of the target. ``apart_m``, ``sigma_m``: by how much, and how well that is known;
    root mean squares over points of the field. ``chance``: that targets which agree are so far
    apart.
    """

    index: int
    apart_m: float
    sigma_m: float
    chance: float

    @property
    def beyond_m(self) -> float:
        """What the noise does not explain of it."""
        return float(np.sqrt(max(self.apart_m**2 - self.sigma_m**2, 0.0)))

    def judged(self, verdict: Verdict, kinds: Sequence[str], too_far: bool) -> Verdict:
        """A verdict that says so; where it makes the error ``too_far``, a refusal."""
        others = " and ".join(kind for n, kind in enumerate(kinds) if n != self.index)
        words = (
            f"{kinds[self.index]} contradicts {others}: by its own shots the sensor is "
            f"{self.apart_m * 1e3:.2f} mm (sigma {self.sigma_m * 1e3:.2f}) from where it is by the "
            "others', in the field of view: has a target or the sensor moved between them, is what "
            "is known of each right?"
        )
        if too_far and verdict.code in (Code.ACCEPT, Code.POSES_NOT_INFORMATIVE):
            return Verdict(Code.RESIDUAL_TOO_LARGE, words)
        return Verdict(verdict.code, f"{verdict.reason}; {words}")


def disagreement(fit: MountFit, given: PoseNoise | None, points: Array) -> Disagreement | None:
    """The target that contradicts the others most surely; None where all agree.

    ``given``: noise of poses, where it is known. ``points`` (n, 3): of the field, sensor frame, m.
    """
    asked = range(len(fit.views)) if len(fit.views) > 2 else range(1, len(fit.views))
    found = [_apart(fit, index, given, points) for index in asked]
    surest = min(found, key=lambda one: one.chance, default=None)
    return surest if surest is not None and surest.chance * len(found) < FALSE_ALARM else None


def _apart(fit: MountFit, index: int, given: PoseNoise | None, points: Array) -> Disagreement:
    """How far a target's own mount is from that of the others, to first order.

    Six more unknowns, of its sightings alone: how its mount differs. Their squares over what they
    are known to follow Fisher's distribution, for the noise is found from the same data.
    """
    plain = MountProblem(fit.views, fit.noise, fit.state)
    bent = fit.bend or Bend({}, np.zeros(0))
    own = [number == index for number, view in enumerate(fit.views) for _ in view.sightings.names]
    moves = plain.linear(fit.state).jacobian[..., :OWN] * np.array(own)[:, None, None]
    none = np.zeros((COMPONENTS, 0))
    pull = {
        name: np.concatenate([move, bent.pull.get(name, none)], axis=1)
        for name, move in zip(fit.names, moves, strict=True)
    }
    bend = Bend(pull, np.concatenate([np.zeros(OWN), bent.taken]))
    keep = np.ones(len(plain.poses), dtype=np.bool_)
    open_one = MountProblem(fit.views, fit.noise, fit.state, bend=bend)
    noise, _ = restricted_noise(open_one, fit.state, keep, given)
    open_one = MountProblem(fit.views, noise, fit.state, bend=bend)
    likely = RestrictedLikelihood(open_one, fit.state, keep, given)
    _, normal, step, white, common = likely.at(likely.now)
    k = len(open_one.names)
    six = slice(k, k + OWN)
    left = white[..., 0] + white[..., 1 : -len(common)] @ step
    spare = int(open_one.sizes.sum()) - k - OWN
    told = spare if given is not None else min(noise_numbers(open_one) - OWN, spare)
    scale = max(float(np.sum(left**2)) / max(spare, 1), 1.0)
    covariance = np.asarray(scale * np.linalg.inv(normal)[six, six], dtype=np.float64)
    d = step[six]
    T2 = float(d @ np.linalg.solve(covariance, d))
    at = np.asarray(points - open_one.pivot, dtype=np.float64)
    moved = d[:3] + at @ frames.skew(d[3:]).T
    return Disagreement(
        index,
        float(np.sqrt(np.mean(np.sum(moved**2, axis=1)))),
        float(expected_error_m(covariance, at)),
        float(fdtrc(OWN, max(told, 1), T2 / OWN)),
    )
