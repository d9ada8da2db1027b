"""Compile every kernel once, for all the array types it is called with.

Numba keeps the machine code beside the source, so that no node pays for it at its start.
"""

from dataclasses import replace

import numpy as np

from robocal_ros.correction.session import load_kernels
from robocal_ros.ground import frames, mcap_records, serialized_joints
from robocal_ros.ground.samples import Measurements
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.camera_fit import fit_pairs
from robocal_ros.identification import identify, row_kernels
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.joint_functions import JointFunctions

POSES = 30


def arm_of_six_joints() -> SerialArm:
    """Return a small arm with a parallel pair; only its shape matters."""
    turn = np.pi / 2
    mdh = [
        (0.3, 0.0, 0.0, turn, 0.0),
        (0.0, 0.0, -0.6, 0.0, 0.0),
        (0.1, 0.0, -0.5, turn, 0.0),
        (0.2, 0.0, 0.0, -turn, 0.0),
        (0.1, 0.0, 0.0, turn, 0.0),
        (0.1, 0.0, 0.0, 0.0, 0.0),
    ]
    return SerialArm(
        name="warm",
        joint_names=tuple(f"joint_{i}" for i in range(6)),
        mdh=np.array(mdh),
        sign=np.ones(6),
        prismatic=np.zeros(6, dtype=np.bool_),
        lower=np.full(6, -np.pi),
        upper=np.full(6, np.pi),
    )


def main() -> None:
    """Call what nodes and commands call first."""
    arm = arm_of_six_joints()
    rng = np.random.default_rng(0)
    q = rng.uniform(-1.5, 1.5, (POSES, 6))
    arm.jacobian(q)
    arm.parameter_jacobian(q)
    T = arm.fk(q)
    functions = JointFunctions(np.zeros(6), np.ones(6), np.zeros((6, 4)), np.zeros(6))
    turning = replace(arm, functions=functions)
    turning.jacobian(turning.read(q))
    here = np.array([0.1, -1.2, 1.0, 0.4, 1.2, 0.3])
    inverse(arm, arm.fk(here)[None], here)
    names = tuple(str(i) for i in range(POSES))
    noise = 1e-5 * rng.standard_normal((POSES, 3))
    position = T[:, :3, 3] + 0.1 * T[:, :3, 2] + noise
    data = Measurements(q=q, position=position, target=("tool",) * POSES, sample=names)
    identify(arm, data).cell.residual(data)
    row_kernels.load_kernels()
    fit_pairs(PosePairs(T, frames.invert(T), names))
    load_kernels(arm)
    for serialized in (mcap_records, serialized_joints):
        serialized.load_kernels()


if __name__ == "__main__":
    main()
