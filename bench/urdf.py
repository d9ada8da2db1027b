# SPDX-License-Identifier: Apache-2.0
"""URDFs of robot files as Pinocchio reads them: is its flange where ours is?"""

from collections.abc import Sequence

import numpy as np

from bench.tables import ROOT, Goal, Table
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_description
from robocal_ros.kinematics.urdf import arm_of, chain, read_urdf, urdf_of

POSES = 1000
GOAL = 1e-9  # m, and of a turn's matrix
MOVED = 1e-3  # m and rad: of each parameter, as identification moves them


def tables() -> Sequence[Table]:
    """All tables of this module."""
    table = Table(
        "urdf",
        "A robot file as URDF: largest difference of the flange's pose, m and elements of its turn",
        ("robot file", "Pinocchio, as shipped", "Pinocchio, as identified", "read back", "goal"),
        f"Over {POSES} poses, from our forward kinematics. Pinocchio reads the URDF that "
        "`export-urdf` writes; read back: the model that `import-urdf` makes of it. As identified: "
        "each parameter moved by a millimetre or a milliradian, 1 sigma.",
    )
    for path in sorted((ROOT / "config" / "robots").glob("*.yaml")):
        arm, rng = load_description(str(path)).arm, np.random.default_rng(0)
        other = arm.with_mdh(
            arm.parameters.add(arm.mdh, MOVED * rng.normal(size=len(arm.parameters)))
        )
        low, high = np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0)
        q = rng.uniform(low, high, (POSES, arm.n))
        shipped, identified = (by_pinocchio(each, q) for each in (arm, other))
        back = read_back(other, q)
        goal = Goal(max(shipped, identified, back), GOAL)
        table.add(path.stem, *(f"{size:.1e}" for size in (shipped, identified, back)), goal)
    return [table]


def by_pinocchio(arm: SerialArm, q: Array) -> float:
    """Largest difference from Pinocchio's flange; ``q`` (m, n), rad and m."""
    import pinocchio as pin

    model = pin.buildModelFromXML(urdf_of(arm))
    data, flange = model.createData(), model.getFrameId("flange")
    joints = [model.joints[model.getJointId(name)] for name in arm.joint_names]
    worst, ours = 0.0, arm.fk(q)
    for row, T_base_flange in zip(q, ours, strict=True):
        given = pin.neutral(model)
        for joint, value in zip(joints, row, strict=True):
            turns = joint.nq == 2  # without limits: cosine and sine
            given[joint.idx_q : joint.idx_q + joint.nq] = (
                (np.cos(value), np.sin(value)) if turns else value
            )
        pin.framesForwardKinematics(model, data, given)
        theirs = data.oMf[flange].homogeneous
        worst = max(worst, float(np.abs(theirs - T_base_flange).max()))
    return worst


def read_back(arm: SerialArm, q: Array) -> float:
    """Largest difference of the model read from its URDF; ``q`` (m, n), rad and m."""
    back = arm_of(chain(read_urdf(urdf_of(arm), arm.name))).arm
    return float(np.abs(back.fk(q) - arm.fk(q)).max())
