"""Loads the compiled kernels, in the process of which commands are forks (`command`)."""

import numpy as np

from robocal_ros.kinematics.robots import load_robot

_ur10 = load_robot("ur10")
_ur10.fk(np.zeros((2, _ur10.n)))
