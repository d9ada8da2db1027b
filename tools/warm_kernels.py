"""Compile every kernel once, so that no node pays for it at its start.

Numba keeps the machine code beside the source; a second run only loads it.
"""

import numpy as np

from robocal_ros.core.kinematics import SerialArm


def main() -> None:
    """Call what nodes and commands call first, on an arm of two joints."""
    arm = SerialArm(
        name="warm",
        joint_names=("turn", "slide"),
        mdh=np.zeros((2, 5)),
        sign=np.ones(2),
        prismatic=np.array([False, True]),
        lower=np.full(2, -np.inf),
        upper=np.full(2, np.inf),
    )
    q = np.zeros((1, 2))
    arm.fk(q)
    arm.jacobian(q)
    arm.parameter_jacobian(q)


if __name__ == "__main__":
    main()
