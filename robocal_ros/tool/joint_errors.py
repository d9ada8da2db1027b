# SPDX-License-Identifier: Apache-2.0
"""What joints err by of themselves, in a tool that is compared with the healthy one.

Gears and couplings make a joint turn otherwise than its encoder shows, by a function of its angle.
A run holds the joints within some degrees, and its residuals tell nothing of what these share; two
runs share less of it the further apart their joints are. So it is in no run's sigma, and cancels in
a change only as far as the bent tool is measured with the joints of the healthy one.
"""

from dataclasses import dataclass

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array, Document
from robocal_ros.kinematics import SerialArm

ALIKE_RAD = float(np.radians(3.5))  # of a UR10, between 1 and 4 deg (docs/simulation.md)
HONEST = 1.25  # squared error over what is told of it; beyond, it is said


@dataclass(frozen=True, eq=False)
class JointErrors:
    """What they add to a tip.

    ``size_rad``: of a joint, rms. ``covariance`` (3, 3): of the tip, flange axes, m^2. ``factor``:
    how many of the sigmas that are told of the tip it is off with it, rms.
    """

    size_rad: float
    covariance: Array
    factor: float

    @property
    def words(self) -> str:
        """How to read the sigma; empty where it holds them."""
        if self.factor**2 <= HONEST:
            return ""
        sigma_mm = 1e3 * float(np.sqrt(np.linalg.eigvalsh(self.covariance)[-1]))
        return (
            f"joints that err by {1e6 * self.size_rad:.0f} urad, which the model in force does not "
            f"hold, add up to {sigma_mm:.3f} mm to the tip's sigma: count {self.factor:.1f} of it"
        )

    def document(self) -> Document:
        """In the units people read."""
        return {
            "size_urad": 1e6 * self.size_rad,
            "sigma_mm": (1e3 * np.sqrt(np.diag(self.covariance))).tolist(),
            "factor": self.factor,
        }


def joint_errors(
    arm: SerialArm,
    size_rad: float,
    now: tuple[Array, Array],
    before: tuple[Array, Array] | None,
    told: Array,
) -> JointErrors | None:
    """What the joints' errors add to a tip's change; None where the model in force holds them.

    Each joint's error is a Gaussian process of its angle, of ``size_rad`` and with the correlation
    exp(-d^2 / 2 `ALIKE_RAD`^2) at angles d apart.

    ``now``, ``before``: joints (n,) of a run, and the tip (3,) that it found, flange frame, m; None
    before where there was no healthy tool's run: then nothing cancels. ``told`` (3, 3): covariance
    of the tip as it is told, m^2.
    """
    if arm.functions is not None and np.any(arm.functions.coefficients):
        return None
    by_now = _tip_by_joint(arm, *now)
    C = by_now @ by_now.T
    if before is not None:
        by_before = _tip_by_joint(arm, *before)
        both = (by_now * np.exp(-0.5 * np.square((now[0] - before[0]) / ALIKE_RAD))) @ by_before.T
        C = C + by_before @ by_before.T - both - both.T
    C = size_rad**2 * C
    return JointErrors(size_rad, C, float(np.sqrt(1.0 + np.trace(np.linalg.solve(told, C)) / 3.0)))


def _tip_by_joint(arm: SerialArm, q: Array, p_tip: Array) -> Array:
    """How a tip (3,) moves in the flange frame (3, n) by each turning joint, m/rad."""
    R, J = arm.fk(q)[:3, :3], arm.jacobian(q)
    moved = J[:3] - frames.skew(R @ p_tip) @ J[3:]
    return np.asarray(R.T @ np.where(arm.prismatic, 0.0, moved))
