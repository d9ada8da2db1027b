"""Poses in YAML files."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.kinematics.robot_fields import Fields

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3


def read_pose(fields: Fields) -> Array:
    """Transform (4, 4), m, of ``{xyz_mm, quat_xyzw or rpy_deg}``; not turned without the latter.

    Raises
    ------
    InputError
        For another key, both orientations, or a quaternion that is not of unit length.
    """
    fields.only("xyz_mm", "quat_xyzw", "rpy_deg")
    xyz = np.array(fields.numbers("xyz_mm", 3)) * 1e-3
    if "quat_xyzw" in fields.values and "rpy_deg" in fields.values:
        fields.fail("is given beside rpy_deg; use one of them", "quat_xyzw")
    if "quat_xyzw" in fields.values:
        quat = np.array(fields.numbers("quat_xyzw", 4))
        length = float(np.linalg.norm(quat))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            fields.fail(f"has length {length:.6g}, not 1", "quat_xyzw")
        return frames.transform_from_quat(xyz, quat)
    rpy = np.array(fields.numbers("rpy_deg", 3, (0.0, 0.0, 0.0))) * (np.pi / 180.0)
    return frames.transform(frames.rotation_from_rpy(rpy), xyz)
