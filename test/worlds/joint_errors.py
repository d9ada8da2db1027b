# SPDX-License-Identifier: Apache-2.0
"""Arms whose joints turn otherwise than they read, by as much as a real UR10's."""

from dataclasses import replace

import numpy as np

from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad, JointFunctions

# On the real UR10 they are 100-350 urad; a Gaussian process of 3-5 degrees fits them.
SIZE, LENGTH, STEP = 350e-6, np.radians(5.0), np.radians(2.5)
MASS_KG, COMPLIANCE = 20.0, 2e-7  # of each link; rad/(N m)


def with_joint_errors(arm: SerialArm, seed: int, size: float = SIZE) -> SerialArm:
    """The arm with functions of ``size`` (rms) over 5 degrees, all around, and compliances."""
    rng, n = np.random.default_rng(seed), arm.n
    span = 2.0 * np.pi + 6.0 * LENGTH
    m, reach = int(2.0 * span / STEP), int(4.0 * LENGTH / STEP)
    # white noise under a Gaussian of length / sqrt 2 has the covariance of one of that length
    window = np.exp(-((np.arange(-reach, reach + 1) * STEP / LENGTH) ** 2))
    window /= np.linalg.norm(window)
    white = rng.standard_normal((n, m - 2 * reach))
    table = np.array([np.convolve(row, window) for row in white])
    functions = JointFunctions(
        np.full(n, -span),
        np.full(n, STEP),
        size * table,
        COMPLIANCE * rng.uniform(0.5, 1.5, n),
    )
    links = np.where(arm.mdh[:, 2:3] != 0.0, arm.mdh[:, 2:3], 0.1) * [[-0.5, 0.0, 0.0]]
    load = ArmLoad(np.full(n, MASS_KG), links, 10.0, np.array([0.0, 0.0, 0.1]))
    return replace(arm, functions=functions, load=load)
