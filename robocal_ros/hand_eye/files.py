"""Files that tell where a sensor sits: what ``robocal hand-eye`` prints, or a rough place by hand.

    T_flange_sensor: {xyz_mm: [60, -40, 110], rpy_deg: [0, 0, 45]}

in YAML or JSON, with ``quat_xyzw`` or ``rpy_deg`` (about the fixed x, y, z).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.ground.frames import fixed, urdf_joint, urdf_origin
from robocal_ros.kinematics.robots import Fields, read_fields, read_pose

Array = NDArray[np.float64]
Parent = Literal["flange", "base"]

FARTHEST_M = {"flange": 3.0, "base": 20.0}  # of a sensor from its parent


@dataclass(frozen=True, eq=False)
class Mount:
    """Where a sensor sits: ``T_parent_sensor`` (4, 4), m, on the flange or beside the robot."""

    parent: Parent
    T_parent_sensor: Array


def read_mount(path: Path, *, accepted: bool = False) -> Mount:
    """Read a sensor's place; ``accepted``: refuse a result whose verdict does not accept it.

    Raises
    ------
    InputError
        Naming file and key, when the place is missing, given twice or no pose.
    """
    top = read_fields(path, "mount file")
    if "document" in top.values:  # as the history shows it
        top = top.below("document")
    if "error" in top.values:
        top.fail("tells why no sensor was placed: calibrate again", "error")
    if accepted and "verdict" in top.values:
        verdict = top.below("verdict")
        accept, code = verdict.values.get("accept"), verdict.text("code")
        if accept is not True or code != Code.ACCEPT.name:
            words = f"has accept {str(accept).lower()} and code {code}: this place was not accepted"
            top.fail(words, "verdict")
    found = [parent for parent in FARTHEST_M if f"T_{parent}_sensor" in top.values]
    if len(found) != 1:
        top.fail("must give the sensor's place: either T_flange_sensor or T_base_sensor")
    parent: Parent = "base" if found[0] == "base" else "flange"
    return Mount(parent, _place(top.below(f"T_{parent}_sensor"), FARTHEST_M[parent]))


def read_flange_mount(path: Path) -> Array:
    """T_flange_sensor (4, 4), m.

    Raises
    ------
    InputError
        As `read_mount`, and for a sensor that does not sit on the flange.
    """
    mount = read_mount(path)
    if mount.parent != "flange":
        raise InputError(
            f"T_{mount.parent}_sensor is of a sensor beside the robot; a line laser sits on the "
            "flange: give T_flange_sensor",
            file=str(path),
        )
    return mount.T_parent_sensor


def _place(fields: Fields, farthest_m: float) -> Array:
    if not {"quat_xyzw", "rpy_deg"} & set(fields.values):
        fields.fail("needs an orientation: quat_xyzw or rpy_deg")
    T = read_pose(fields)
    far_m = float(np.linalg.norm(T[:3, 3]))
    if far_m > farthest_m:
        fields.fail(f"is {far_m:.4g} m away: is it a thousand times too far?", "xyz_mm")
    return T


# ---- a sensor's place in the words of robot descriptions: URDF, xacro, a static transform -------
#
# URDF's rpy turn about the fixed x, then y, then z of the parent.


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
