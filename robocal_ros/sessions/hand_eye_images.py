"""Images of a board: the shot, and what a sample keeps of it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError
from robocal_ros.core.hand_eye.board import find_corners
from robocal_ros.core.hand_eye.target_documents import target_of
from robocal_ros.core.hand_eye.targets import BoardTarget
from robocal_ros.core.images import image_array
from robocal_ros.core.samples import stamp_ns
from robocal_ros.sessions.hand_eye_shots import IMAGE, Shot

Array = NDArray[np.float64]


def image_shot(message: Any) -> Shot:
    """Build a shot from a ``sensor_msgs/Image``.

    Raises
    ------
    InputError
        When its encoding is not read, or its bytes are too few.
    """
    at_ns = stamp_ns(message.header.stamp)
    return Shot(IMAGE, at_ns, message.header.frame_id, image_array(message))


def seen_corners(target: Mapping[str, Any], shot: Shot) -> Array:
    """Width and height of an image, then the corners of the board in it: (1 + n, 2), px.

    Raises
    ------
    InputError
        When the image does not show the board.
    """
    board = board_of(target).board
    corners = find_corners(shot.values, board)
    if corners is None:
        raise InputError(
            f"no board of {board.columns}x{board.rows} inner corners in the image of "
            f"{shot.stamp_ns} ns: look for light, focus, and that all of the board is in sight"
        )
    return np.vstack([shot.values.shape[::-1], corners])


def board_of(target: Mapping[str, Any]) -> BoardTarget:
    """The board that a document of a target describes.

    Raises
    ------
    InputError
        When it describes none.
    """
    found = target_of(target)
    if not isinstance(found, BoardTarget):
        raise InputError(f"a {target['kind']} without a board shows no corners")
    return found
