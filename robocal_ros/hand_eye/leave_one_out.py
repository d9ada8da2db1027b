"""How far each sighting is from what is found without its pose."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.estimation import solve
from robocal_ros.ground.errors import RobocalError
from robocal_ros.hand_eye.mount_fit import MountFit, distances, without
from robocal_ros.hand_eye.mount_problem import MountProblem, MountState, TargetView

Array = NDArray[np.float64]


def solved_again(fit: MountFit) -> Callable[[tuple[TargetView, ...]], MountState]:
    """How the mount is found from part of the views of a fit: nothing is rejected any more."""

    def again(views: tuple[TargetView, ...]) -> MountState:
        part = MountProblem(views, fit.noise, fit.state)
        return solve(
            part, fit.state, prior_information=part.prior(), robust=False, sizes=part.sizes
        ).settled()

    return again


def leave_one_out(
    views: tuple[TargetView, ...], solved: Callable[[tuple[TargetView, ...]], MountState]
) -> Array | None:
    """Distance of each sighting from what is ``solved`` without its pose, m.

    None where the rest does not suffice.
    """
    sample = np.concatenate([view.sightings.pose for view in views])
    own = np.zeros(len(sample))
    for pose in np.unique(sample):
        out = sample == pose
        rest = without(views, out, {})
        if any(len(view.sightings.names) == 0 for view in rest):
            return None  # a target that only this pose saw
        try:
            own[out] = distances(views, solved(rest))[out]
        except RobocalError:
            return None
    return own
