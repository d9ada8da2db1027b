"""Files of measured tools: the JSON that ``robocal tool`` and ``robocal history show`` print."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import read_fields

Array = NDArray[np.float64]

QUATERNION_TOLERANCE = 1e-3


def read_tool(path: Path, rotation: Array | None = None) -> Array:
    """T_flange_tool (4, 4) from ``tcp_mm`` and ``quat_xyzw``.

    ``rotation``: R_flange_tool (3, 3) for a document of touches, which tell the tip alone; another
    one takes none.

    Raises
    ------
    InputError
        Naming file and key, when one of them is missing, null or no measurement, and when the
        document's verdict does not accept the tool.
    """
    top = read_fields(path, "tool file")
    if "document" in top.values:  # as the history shows it
        top = top.below("document")
    if "error" in top.values:
        top.fail("tells why no tool was found: measure again", "error")
    if "verdict" in top.values:
        verdict = top.below("verdict")
        if verdict.values.get("accept") is not True:
            top.fail(f"is {verdict.text('code')}: this tool was not accepted", "verdict")
    xyz = np.array(top.numbers("tcp_mm", 3)) * 1e-3
    if top.values.get("quat_xyzw") is not None:
        if rotation is not None:
            top.fail("is in the file: leave out roll, pitch and yaw", "quat_xyzw")
        quat = np.array(top.numbers("quat_xyzw", 4))
        length = float(np.linalg.norm(quat))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            top.fail(f"has length {length:.6g}, not 1", "quat_xyzw")
        return frames.transform_from_quat(xyz, quat)
    if rotation is None:
        top.fail("is missing or null: give the tool's roll, pitch and yaw too", "quat_xyzw")
    return frames.transform(rotation, xyz)
