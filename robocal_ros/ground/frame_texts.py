"""Frames as text: documents (JSON), fixed decimals, URDF."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames

Array = NDArray[np.float64]


def fixed(values: Array, digits: int) -> list[str]:
    """Fixed decimals; a zero has no sign."""
    rounded = np.round(values, digits) + 0.0
    return [f"{value:.{digits}f}" for value in rounded.tolist()]


def urdf_origin(T: Array) -> tuple[str, str]:
    """``xyz`` (m) and ``rpy`` (rad) of a pose (4, 4) as URDF writes them, 1e-4 mm and 1e-6 deg."""
    return " ".join(fixed(T[:3, 3], 7)), " ".join(fixed(frames.rpy(T[:3, :3]), 8))


def urdf_joint(parent: str, child: str, xyz: str, rpy: str) -> str:
    """A fixed joint, and the link that it carries."""
    return (
        f'<link name="{child}"/>\n'
        f'<joint name="{parent}-{child}" type="fixed">\n'
        f'  <parent link="{parent}"/>\n'
        f'  <child link="{child}"/>\n'
        f'  <origin xyz="{xyz}" rpy="{rpy}"/>\n'
        "</joint>"
    )


Document = dict[str, Any]


def transform_document(T: Array) -> Document:
    """A pose (4, 4) as ``xyz_mm`` and ``quat_xyzw``."""
    return {"xyz_mm": (T[:3, 3] * 1e3).tolist(), "quat_xyzw": frames.quat_xyzw(T).tolist()}
