"""Is the robot cold again, or as warm as the model in force? From a new visit of the cold poses.

At the poses of a cold reference the arm's static errors are known and cancel. What is left is
compared with either answer: first as if sensor and target stood still, then, where neither
answer explains it so, with both moved anywhere, which takes more or better poses to tell.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import FEWEST_GROUPS
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.identification import visit_variance
from robocal_ros.thermal.process import SETUP_SIGMA_M
from robocal_ros.thermal.reference import ColdReference
from robocal_ros.thermal.spots import ColdSpots

Array = NDArray[np.float64]

# Noise makes the wrong answer so much likelier in one case of as many (Wald 1945).
LIKELIER = 1000.0
MOST_LEFT = 0.25  # share of the drift that an answer may leave, to be missing in all later models
FALSE_ALARM = 0.001  # chance that a set-up that stands still looks moved


@dataclass(frozen=True)
class DriftShare:
    """How much of a drift is in a visit: 0 for the cold robot, 1 for one as warm as the drift.

    Attributes
    ----------
    share, sigma : its estimate and standard deviation; infinite where the visit shows nothing.
    """

    share: float = 0.5
    sigma: float = math.inf

    @property
    def told(self) -> bool:
        """Whether the visit tells one answer from the other.

        The chi-squares of the two fits differ by (1 - 2 share) / sigma^2, which is twice the
        logarithm of their likelihoods' ratio.
        """
        return abs(1.0 - 2.0 * self.share) >= 2.0 * math.log(LIKELIER) * self.sigma**2

    @property
    def between(self) -> bool:
        """Whether neither answer is near: the robot warms up or cools down."""
        return MOST_LEFT < self.share < 1.0 - MOST_LEFT

    @property
    def warm(self) -> bool:
        """Whether the drift fits better than the cold robot."""
        return self.share > 0.5


def drift_size_m(visit: ColdReference, warm: SerialArm) -> float:
    """Rms of one coordinate, m, by which a drift moves the targets at a visit's poses."""
    moved = replace(visit.cell, arm=warm).residual(visit.data) - visit.cell.residual(visit.data)
    return float(np.sqrt(np.mean(moved**2)))


def drift_share(
    reference: ColdReference, visit: ColdReference, warm: SerialArm, sigma_m: float
) -> DriftShare:
    """Tell how much of the drift from ``visit``'s arm to ``warm`` a visit shows.

    Parameters
    ----------
    reference : the one in force, for the static errors at its poses; other poses tell nothing.
    visit : the new visit, placed with the cold arm.
    warm : the arm with the drift.
    sigma_m : standard deviation of one coordinate of one visit.
    """
    spots, cold = reference.spots, visit.cell.arm
    again = spots.common(visit.used)
    again = again.take(~np.isin(again.sample, visit.spots.rejected))
    if len(spots.visited(again.q)) < FEWEST_GROUPS:
        return DriftShare()
    still, explained = _compared(spots, again, cold, warm, sigma_m, moved=False)
    if explained:
        return still
    T = reference.cell.T_frame_base @ frames.invert(visit.cell.T_frame_base)
    seen = replace(again, position=again.position @ T[:3, :3].T + T[:3, 3])
    return _compared(spots, seen, cold, warm, sigma_m, moved=True)[0]


def _compared(
    spots: ColdSpots,
    again: Measurements,
    cold: SerialArm,
    warm: SerialArm,
    sigma_m: float,
    *,
    moved: bool,
) -> tuple[DriftShare, bool]:
    """The share, and whether the better answer leaves no more than noise.

    Least squares over the set-up: sensor and target held to their usual wander, or free in
    position and turn. A fit that is worse than the noise widens sigma by as much.
    """
    again = spots.average(again, sigma_m)
    spot, parameters = spots.match(again), spots.cell.arm.parameters
    rows, setup = spots.rows(again.q, spots.target[spot])
    known = parameters.read(cold.mdh - spots.cell.arm.mdh)
    pair = [rows @ parameters.read(warm.mdh - cold.mdh), spots.drift(again) - rows @ known]
    if moved:
        turn = -frames.skew(again.position - again.position.mean(axis=0))
        setup = np.concatenate([setup, turn], axis=2)
    sigma = np.repeat(np.sqrt(visit_variance(spots, spot, again, sigma_m)), 3)[:, None]
    G = setup.reshape(len(sigma), -1) / sigma
    both = np.column_stack([one.ravel() for one in pair]) / sigma
    if not moved:
        held = np.eye(G.shape[1]) / SETUP_SIGMA_M
        G, both = np.vstack([G, held]), np.vstack([both, np.zeros((len(held), 2))])
    solved, _, rank, _ = np.linalg.lstsq(G, both, rcond=None)
    drift, shown = (both - G @ solved).T
    square, freedom = float(drift @ drift), len(G) - int(rank)
    if freedom < 1 or square <= 0.0:
        return DriftShare(), False
    chi2 = min(float(shown @ shown), float(np.sum((shown - drift) ** 2)))
    sigma_share = float(np.sqrt(max(1.0, chi2 / freedom) / square))
    explained = chi2 <= chi2_quantile(1.0 - FALSE_ALARM, freedom)
    return DriftShare(float(drift @ shown) / square, sigma_share), explained
