"""Images of a camera, and its intrinsics as ROS writes them (camera_info YAML)."""

from pathlib import Path

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import read_bytes
from robocal_ros.hand_eye.board import Image, Intrinsics, decode_image
from robocal_ros.hand_eye.tables import PoseTable
from robocal_ros.kinematics.robots import read_fields

MODELS = {"plumb_bob": 5, "rational_polynomial": 8}  # and how many coefficients they have
MOST_PX = 100_000  # along a side of an image
NOT_NEEDED = ("camera_name", "rectification_matrix", "projection_matrix")


def read_images(folder: Path, table: PoseTable) -> tuple[list[tuple[str, Image]], dict[str, str]]:
    """Named grey images of the shots that a table names, and why any of them cannot be read.

    Raises
    ------
    InputError
        When a file is missing.
    """
    images, rejected = [], {}
    for path, name in zip(table.files_in(folder), table.names, strict=True):
        try:
            images.append((name, decode_image(read_bytes(path, "image"), path.name)))
        except InputError as error:
            rejected[name] = str(error)
    return images, rejected


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics, which are taken as exact.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/hand_eye_camera.md says.
    """
    top = read_fields(path, "file of intrinsics")
    needed = ("image_width", "image_height", "camera_matrix", "distortion_model",
              "distortion_coefficients")  # fmt: skip
    top.only(*needed, *NOT_NEEDED)
    model = top.choice("distortion_model", tuple(MODELS))
    width, height = (top.whole(key, 1, MOST_PX) for key in needed[:2])
    matrix, distortion = top.below("camera_matrix"), top.below("distortion_coefficients")
    K = np.array(matrix.numbers("data", 9)).reshape(3, 3)
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and np.allclose(K[2], [0.0, 0.0, 1.0])):
        matrix.fail("must be fx 0 cx, 0 fy cy, 0 0 1 by rows, in px", "data")
    coefficients = np.array(distortion.numbers("data", MODELS[model]))
    return Intrinsics(K, coefficients, (width, height))
