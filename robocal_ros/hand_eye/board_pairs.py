"""Boards that a camera saw, paired with the robot's poses."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.hand_eye.board import SeenBoards
from robocal_ros.hand_eye.pose_pairs import Mount, PosePairs

Array = NDArray[np.float64]


def board_pairs(
    seen: SeenBoards, names: tuple[str, ...], T_base_flange: Array, mount: Mount
) -> PosePairs:
    """Pairs of the boards with the flange poses (m, 4, 4) of the samples ``names`` (m,)."""
    row = {name: index for index, name in enumerate(names)}
    return PosePairs(
        T_base_flange=T_base_flange[[row[name] for name in seen.names]],
        T_camera_board=seen.T_camera_board,
        names=seen.names,
        mount=mount,
        covariance=seen.covariance,
        shared=seen.shared,
    )


def intrinsics_document(seen: SeenBoards, from_images: bool) -> dict[str, Any]:
    """The camera of a result, px; ``from_images``: solved from the same images."""
    camera = seen.intrinsics
    return {
        "from_images": from_images,
        "fx_px": float(camera.matrix[0, 0]),
        "fy_px": float(camera.matrix[1, 1]),
        "cx_px": float(camera.matrix[0, 2]),
        "cy_px": float(camera.matrix[1, 2]),
        "distortion": camera.distortion.tolist(),
        "width_px": camera.size[0],
        "height_px": camera.size[1],
        "sigma": None
        if camera.covariance is None
        else [float(variance) ** 0.5 for variance in camera.covariance.diagonal()],
        "noise_px": seen.noise_px,
    }
