"""Files that tell where a sensor sits: what ``robocal hand-eye`` prints, or a rough place by hand.

    T_flange_sensor: {xyz_mm: [60, -40, 110], rpy_deg: [0, 0, 45]}

in YAML or JSON, with ``quat_xyzw`` or ``rpy_deg`` (about the fixed x, y, z).
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, InputError
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
