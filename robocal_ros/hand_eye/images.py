"""Images of a board: what a sample keeps of them."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.board import find_corners
from robocal_ros.hand_eye.shots import Shot
from robocal_ros.hand_eye.target_documents import target_of
from robocal_ros.hand_eye.targets import BoardTarget

Array = NDArray[np.float64]


def seen_corners(target: Mapping[str, Any], shot: Shot) -> Array:
    """Width and height of an image, then the corners of the board in it: (1 + n, 2), px.

    Raises
    ------
    InputError
        When the image does not show the board.
    """
    board = board_of(target).board
    image = shot.read()
    corners = find_corners(image, board)
    if corners is None:
        raise InputError(
            f"no board of {board.columns}x{board.rows} inner corners in the image of "
            f"{shot.stamp_ns} ns: look for light, focus, and that all of the board is in sight"
        )
    return np.vstack([image.shape[::-1], corners])


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
