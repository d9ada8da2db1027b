"""A sensor's place in the words of robot descriptions: URDF, xacro, a static transform.

URDF's rpy turn about the fixed x, then y, then z of the parent.
"""

from collections.abc import Callable, Mapping
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import fixed, urdf_joint, urdf_origin

Array = NDArray[np.float64]
Format = Literal["urdf", "xacro", "yaml", "static-transform"]


def exported(T_parent_sensor: Array, parent: str, child: str, format: Format) -> str:
    """Text of a sensor's pose (4, 4), m, below its parent, with 1e-4 mm and 1e-6 deg.

    Raises
    ------
    InputError
        When a frame's name is empty or needs quoting.
    """
    for name in (parent, child):
        if not name or quoteattr(name) != f'"{name}"' or any(c in name for c in " :#{}\n"):
            raise InputError(f"'{name}' is no name of a frame: letters, digits, _ and / are")
    return _FORMATS[format](T_parent_sensor, parent, child)


def _urdf(T: Array, parent: str, child: str) -> str:
    return urdf_joint(parent, child, *urdf_origin(T))


def _xacro(T: Array, parent: str, child: str) -> str:
    """Properties, so that another calibration changes two lines only."""
    name = "".join(c if c.isalnum() else "_" for c in child)
    xyz, rpy = urdf_origin(T)
    return (
        f'<xacro:property name="{name}_xyz" value="{xyz}"/>\n'
        f'<xacro:property name="{name}_rpy" value="{rpy}"/>\n'
        + urdf_joint(parent, child, f"${{{name}_xyz}}", f"${{{name}_rpy}}")
    )


def _yaml(T: Array, parent: str, child: str) -> str:
    """The fields of a geometry_msgs/TransformStamped."""
    x, y, z = fixed(T[:3, 3], 7)
    qx, qy, qz, qw = fixed(frames.quat_xyzw(T), 10)
    return (
        f"header: {{frame_id: {parent}}}\n"
        f"child_frame_id: {child}\n"
        "transform:\n"
        f"  translation: {{x: {x}, y: {y}, z: {z}}}\n"
        f"  rotation: {{x: {qx}, y: {qy}, z: {qz}, w: {qw}}}"
    )


def _static_transform(T: Array, parent: str, child: str) -> str:
    """The command that publishes it."""
    values = [*fixed(T[:3, 3], 7), *fixed(frames.quat_xyzw(T), 10)]
    words = zip(("x", "y", "z", "qx", "qy", "qz", "qw"), values, strict=True)
    place = " ".join(f"--{name} {value}" for name, value in words)
    return (
        f"ros2 run tf2_ros static_transform_publisher {place} "
        f"--frame-id {parent} --child-frame-id {child}"
    )


_FORMATS: Mapping[Format, Callable[[Array, str, str], str]] = {
    "urdf": _urdf,
    "xacro": _xacro,
    "yaml": _yaml,
    "static-transform": _static_transform,
}
