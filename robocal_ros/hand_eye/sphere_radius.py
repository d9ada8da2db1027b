"""A wrong radius of the sphere, seen where profiles at several heights of it disagree."""

import numpy as np

from robocal_ros.ground.errors import ResidualError
from robocal_ros.hand_eye.mount_fit import MountFit
from robocal_ros.hand_eye.mount_problem import MountProblem
from robocal_ros.hand_eye.target_models import SphereModel

CONDITION = 1e5
SURE = 5.0  # standard deviations
TOLERANCE_M = 5e-5  # of a sphere that is sold as a reference


def require_radius(fit: MountFit) -> None:
    """Refuse a fit that would be clearly better with another radius (a score test).

    Raises
    ------
    ResidualError
        Naming the radius that fits.
    """
    problem = MountProblem(fit.views, fit.noise, fit.state)
    linear = problem.linear(fit.state)
    radius = np.concatenate(
        [
            view.model.radius_m / np.maximum(view.sightings.value[:, 2], 1e-6)
            if isinstance(view.model, SphereModel)
            else np.zeros(len(view.sightings.names))
            for view in fit.views
        ]
    )
    if not np.any(radius):
        return
    column = np.zeros_like(linear.jacobian[:, :, :1])
    column[:, 2, 0] = radius  # dr / dR at a given height of the laser plane
    residual, jacobian = problem.whitened(linear, column)
    unit = np.linalg.norm(jacobian, axis=0)
    if np.any(unit == 0.0) or np.linalg.cond(jacobian / unit) > CONDITION:
        return  # the radius looks like another unknown
    normal = jacobian.T @ jacobian
    change = np.linalg.solve(normal, -jacobian.T @ residual)[-1]
    sigma = fit.scale * float(np.sqrt(np.linalg.inv(normal)[-1, -1]))
    if abs(change) > max(SURE * sigma, TOLERANCE_M):
        model = next(view.model for view in fit.views if isinstance(view.model, SphereModel))
        raise ResidualError(
            f"the profiles fit a sphere of radius {(model.radius_m + change) * 1e3:.2f} mm, not "
            f"{model.radius_m * 1e3:.2f} mm: check which sphere is mounted"
        )
