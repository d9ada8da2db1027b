# SPDX-License-Identifier: Apache-2.0
"""What joints err by of themselves, in what is found with them: a tool's tip, a sensor's place.

Gears and couplings make a joint turn otherwise than its encoder shows, by a smooth function of its
angle. Readings near one another share it, and residuals tell nothing of what they share: so it is
in no sigma that is found from these, but for what of it looks like scatter.
"""

from dataclasses import dataclass, replace

import numpy as np

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.documents import JointErrorsDocument
from robocal_ros.ground.frames import Array, Index
from robocal_ros.kinematics.arm import SerialArm

ALIKE_RAD = float(np.radians(3.5))  # of a UR10, between 1 and 4 deg (docs/simulation.md)
SIZE_URAD = 300.0  # rms of a UR10's joints, 240 to 380 (docs/simulation.md)
HONEST = 1.25  # squared error over what is told of it; beyond, it is said


@dataclass(frozen=True, eq=False)
class ShotJoints:
    """Readings (m, n) of joints at m shots, rad (prismatic: m), and the arm that poses are of."""

    arm: SerialArm
    q: Array

    def take(self, rows: Index) -> "ShotJoints":
        """Those at some shots."""
        return replace(self, q=self.q[rows])


@dataclass(frozen=True, eq=False)
class JointErrors:
    """What they add to k numbers that were found, the first three of which are a place.

    ``size_rad``: of a joint, rms. ``covariance`` (k, k): what they add, SI. ``factor``: how many of
    the sigmas that are told of the k numbers these are off with it, rms.
    """

    size_rad: float
    covariance: Array
    factor: float

    @classmethod
    def beside(cls, size_rad: float, more: Array, told: Array) -> "JointErrors":
        """What ``more`` (k, k) makes of ``told`` (k, k), covariances in SI."""
        ratio = float(np.trace(np.linalg.solve(told, more))) / len(told)
        return cls(size_rad, more, float(np.sqrt(max(1.0 + ratio, 0.0))))

    def words(self, what: str) -> str:
        """How to read the sigma of ``what`` was found; empty where it holds them."""
        if self.factor**2 <= HONEST:
            return ""
        sigma_mm = 1e3 * float(np.sqrt(max(np.linalg.eigvalsh(self.covariance[:3, :3])[-1], 0.0)))
        size_urad = 1e6 * self.size_rad
        return (
            f"joints that err by {size_urad:.0f} urad, which the model in force does not hold, add "
            f"up to {sigma_mm:.3f} mm to the {what}'s sigma: count {self.factor:.1f} of it"
        )

    def document(self) -> JointErrorsDocument:
        """In the units people read."""
        variance = np.maximum(np.diag(self.covariance)[:3], 0.0)
        return {
            "size_urad": 1e6 * self.size_rad,
            "sigma_mm": (1e3 * np.sqrt(variance)).tolist(),
            "factor": self.factor,
        }


def with_joint_errors(verdict: Verdict, found: JointErrors, what: str) -> Verdict:
    """A verdict on ``what`` was found that says them, where they are more than told."""
    words = found.words(what)
    return replace(verdict, reason=f"{verdict.reason}; {words}") if words else verdict


def flange_errors(arm: SerialArm, size_rad: float, q: Array) -> Array | None:
    """Covariance (m, 6, m, 6) of flange poses at joints (m, n): (v, w), flange axes, m and rad.

    Each turning joint's error is a Gaussian process of its angle, of ``size_rad`` and with the
    correlation exp(-d^2 / 2 `ALIKE_RAD`^2) at angles d apart. None where the model holds them.
    """
    if arm.functions is not None and np.any(arm.functions.coefficients):
        return None
    to_flange = np.swapaxes(arm.fk(q)[:, :3, :3], 1, 2)[:, None]
    J = arm.jacobian(q).reshape(len(q), 2, 3, arm.n)
    moved = np.where(arm.prismatic, 0.0, (to_flange @ J).reshape(len(q), 6, arm.n))
    alike = np.exp(-0.5 * np.square((q[:, None] - q) / ALIKE_RAD))
    return np.asarray(size_rad**2 * np.einsum("gan,ghn,hbn->gahb", moved, alike, moved))
