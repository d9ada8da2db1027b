# SPDX-License-Identifier: Apache-2.0
"""What joints that err of themselves add to a mount, beyond what its residuals tell.

Poses far apart show gears as scatter, which the noise that is found from the shots holds. Near one
another they err alike, and that goes into the mount without a trace in the residuals.
"""

from dataclasses import replace

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import MountProblem
from robocal_ros.hand_eye.result import HandEyeResult, HandEyeSettings, PoseNoise
from robocal_ros.hand_eye.tasks import ShotJoints
from robocal_ros.kinematics.joint_errors import JointErrors, flange_errors, with_joint_errors


def judged_with_joints(
    result: HandEyeResult, fit: MountFit, joints: ShotJoints | None, settings: HandEyeSettings
) -> HandEyeResult:
    """A result whose verdict and document say what the joints add to its sigma.

    Where that is not told the document has null: without ``joints``, or where the model that they
    were read by holds what joints err by.
    """
    found = None
    if joints is not None and settings.joint_error_rad > 0.0 and result.covariance is not None:
        size_rad, given = settings.joint_error_rad, settings.noise()
        found = mount_errors(fit, result.covariance, joints, size_rad, given)
    more = {**result.more, "joint_errors": None if found is None else found.document()}
    verdict = with_joint_errors(result.verdict, found, "mount")
    return replace(result, verdict=verdict, more=more)


def mount_errors(
    fit: MountFit, told: Array, joints: ShotJoints, size_rad: float, given: PoseNoise | None
) -> JointErrors | None:
    """What joints that err by ``size_rad`` add to a mount's covariance ``told`` (6, 6).

    To first order, with the fit's weights. Of the noise that was found from the shots, the share
    that such joints make of it is in ``told`` already, as if it were drawn anew for each pose: what
    they make of the mount stands in its place. Where they would make more scatter than the shots
    show, they err by less: by so much as makes all of it. Noise that is ``given`` does not tell.
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
    unit = np.repeat([fit.noise.sigma_m, fit.noise.sigma_rad], 3)
    G = G * unit  # so that the noise of a pose is drawn from six numbers of size one
    errors = errors / unit[:, None, None] / unit
    poses = len(G)
    flat = J.reshape(-1, k)
    by_pose = np.swapaxes(J, 1, 2) @ G  # (g, k, 6)
    known = np.linalg.inv(flat.T @ flat + problem.prior())
    moves = known[:6] @ by_pose  # (g, 6, 6): of the mount with each pose
    # What of the poses' errors residuals show, their own less what the unknowns take, squared: of
    # hundreds of shots its product with the errors would take minutes.
    own, taken = np.swapaxes(G, 1, 2) @ G, np.swapaxes(by_pose, 1, 2)
    V, left = taken.reshape(-1, k), (own @ taken @ known).reshape(-1, k)
    shown = (V @ known @ (V.T @ V) @ known - left) @ V.T - V @ left.T
    shown = shown.reshape(poses, 6, poses, 6)
    each = np.arange(poses)
    shown[each, :, each, :] += own @ own
    share = float(np.sum(errors * shown) / np.einsum("gaga->", shown))
    by_joints = np.einsum("gka,gahb,hlb->kl", moves, errors, moves, optimize=True)
    if share > 1.0 and given is None:
        by_joints, size_rad = by_joints / share, size_rad / float(np.sqrt(share))
    as_noise = np.einsum("gka,gla->kl", moves, moves)
    return JointErrors.beside(size_rad, by_joints - min(share, 1.0) * as_noise, told)
