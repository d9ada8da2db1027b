# SPDX-License-Identifier: Apache-2.0
"""What joints that err of themselves add to a mount, beyond what its residuals tell.

Poses far apart show gears as scatter, which the noise that is found from the shots holds. Near one
another they err alike, and that goes into the mount without a trace in the residuals.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import MountProblem
from robocal_ros.hand_eye.result import HandEyeResult, PoseNoise
from robocal_ros.kinematics.joint_errors import (
    JointErrors,
    ShotJoints,
    flange_errors,
    with_joint_errors,
)


def said_of_joints(result: HandEyeResult, found: JointErrors | None) -> HandEyeResult:
    """A result whose verdict and document say what the joints add to its sigma.

    ``found``: None where that is not known; the document has null.
    """
    more = {**result.more, "joint_errors": None if found is None else found.document()}
    return replace(result, verdict=with_joint_errors(result.verdict, found, "mount"), more=more)


@dataclass(frozen=True, eq=False)
class PoseRows:
    """A fit's whitened residuals, linearised: r rows of each of g poses.

    ``by_unknowns`` (g, r, k), of which ``mount`` are the sensor's six; ``known`` (k, k): their
    covariance. ``by_pose`` (g, r, 6): by six numbers that a pose errs by.
    """

    by_unknowns: Array
    by_pose: Array
    known: Array
    mount: slice

    @cached_property
    def _own(self) -> Array:
        return np.swapaxes(self.by_pose, 1, 2) @ self.by_pose

    @cached_property
    def _taken(self) -> Array:
        """(g, 6, k): what the unknowns take of the poses' errors."""
        return np.swapaxes(self.by_pose, 1, 2) @ self.by_unknowns

    @cached_property
    def _moves(self) -> Array:
        """(g, 6, 6): of the mount with each pose."""
        return self.known[self.mount] @ np.swapaxes(self._taken, 1, 2)

    def of_mount(self, errors: Array) -> Array:
        """Covariance (6, 6) of the mount by that of the poses (g, 6, g, 6)."""
        moves = self._moves
        return np.asarray(np.einsum("gka,gahb,hlb->kl", moves, errors, moves, optimize=True))

    def of_mount_anew(self) -> Array:
        """The same by numbers of variance one, drawn anew for each pose."""
        return np.asarray(np.einsum("gka,gla->kl", self._moves, self._moves))

    def squared(self, errors: Array) -> float:
        """What such errors of the poses add to the sum of the squared residuals."""
        own = float(np.einsum("gagb,gab->", errors, self._own))
        taken = self._taken
        both = np.einsum("gak,gahb,hbl->kl", taken, errors, taken, optimize=True)
        return own - float(np.sum(both * self.known))

    def share(self, errors: Array) -> float:
        """How much of the scatter such errors make that numbers of variance one make.

        What residuals show of the poses, their own less what the unknowns take, squared: of
        hundreds of shots its product with the errors would take minutes.
        """
        own, taken, poses = self._own, self._taken, len(self._own)
        V, left = (part.reshape(-1, len(self.known)) for part in (taken, own @ taken @ self.known))
        shown = (V @ self.known @ (V.T @ V) @ self.known - left) @ V.T - V @ left.T
        shown = shown.reshape(poses, 6, poses, 6)
        each = np.arange(poses)
        shown[each, :, each, :] += own @ own
        return float(np.sum(errors * shown) / np.einsum("gaga->", shown))


def beside_found_noise(
    rows: PoseRows, errors: Array, noise: PoseNoise, told: Array, size_rad: float, given: bool
) -> JointErrors:
    """What poses that err, (g, 6, g, 6), add where the noise of a pose was found from the shots.

    Of that noise the share that such joints make is in ``told`` already, as if it were drawn anew
    for each pose: what they make of the mount stands in its place. Where they would make more
    scatter than the shots show, they err by less: by so much as makes all of it. Noise that is
    ``given`` does not tell.
    """
    unit = np.repeat([noise.sigma_m, noise.sigma_rad], 3)
    rows = replace(rows, by_pose=rows.by_pose * unit)  # of six numbers of variance one
    errors = errors / unit[:, None, None] / unit
    share, by_joints = rows.share(errors), rows.of_mount(errors)
    if share > 1.0 and not given:
        by_joints, size_rad = by_joints / share, size_rad / float(np.sqrt(share))
    return JointErrors.beside(size_rad, by_joints - min(share, 1.0) * rows.of_mount_anew(), told)


def mount_errors(
    fit: MountFit, told: Array, joints: ShotJoints, size_rad: float, given: PoseNoise | None
) -> JointErrors | None:
    """What joints that err by ``size_rad`` add to a mount's covariance ``told`` (6, 6).

    To first order, with the fit's weights; see `beside_found_noise`.
    """
    problem = MountProblem(fit.views, fit.noise, fit.state)
    first = np.unique(problem.sample, return_index=True)[1]
    shot = np.concatenate([view.sightings.shot for view in fit.views])[first]
    errors = flange_errors(joints.arm, size_rad, joints.q[shot])
    if errors is None:
        return None
    linear, k = problem.linear(fit.state), len(problem.names)
    both = np.concatenate([linear.jacobian, linear.common[..., :6]], axis=2)
    J, G = np.split(problem.whitened(replace(linear, jacobian=both))[1], [k], axis=2)
    flat = J.reshape(-1, k)
    known = np.linalg.inv(flat.T @ flat + problem.prior())
    rows = PoseRows(J, G, np.asarray(known, dtype=np.float64), slice(0, 6))
    return beside_found_noise(rows, errors, fit.noise, told, size_rad, given is not None)
