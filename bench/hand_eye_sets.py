# SPDX-License-Identifier: Apache-2.0
"""Real measurements for the hand-eye of a camera, as pairs and streams.

A UR10 with a T-Mac (Landgraf et al. 2021, MIT), a UR with a camera (wangrp1997, MIT), an arm with
a camera and time stamps (Furrer et al. 2017, BSD-3-Clause), below $ROBOCAL_DATA.
"""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bench.real_data import data_folder
from robocal_ros.ground import frames
from robocal_ros.hand_eye.boards import Chessboard, Image, decode_image
from robocal_ros.hand_eye.camera_data import (
    Placement,
    PosePairs,
    PoseStream,
    closed_form,
    stream_of,
)
from robocal_ros.hand_eye.published import ARM, CAMERA, board_shots, stream_rows, tmac_pairs

Array = NDArray[np.float64]

BOARD = Chessboard(9, 6, 0.025)
# What a first evaluation of the same measurements gave, rounded up; each README beside them tells:
TMAC_MM = {"B": 0.80, "D": 0.77}  # mean, maximum likelihood (0.789, 0.762)
BOARD_RMS_MM = 2.46  # the best of OpenCV's closed forms (2.46 to 2.61)
ARM_RMS_MM = 4.3  # maximum likelihood (4.26; OpenCV 4.5 to 4.7)


def tmac(series: str) -> PosePairs:
    """Pairs of the UR10 and its tracker."""
    return tmac_pairs(series, data_folder() / "ur10_tmac")


def turned_tsai(pairs: PosePairs) -> Placement | None:
    """OpenCV's Tsai with the roles of X and Z exchanged: on series B it is off by millimetres."""
    found = closed_form(
        "tsai", replace(pairs, mount="in-hand", T_camera_board=frames.invert(pairs.T_camera_board))
    )
    return None if found is None else Placement(found.Z, found.X)


def board_images() -> tuple[Array, list[tuple[str, Image]]]:
    """Flange poses (n, 4, 4), m, and the 20 images of a chessboard."""
    T, paths = board_shots(data_folder() / "camera_hand_eye")
    return T, [(path.name, decode_image(path.read_bytes(), path.name)) for path in paths]


def arm_streams() -> tuple[PoseStream, PoseStream]:
    """The arm's and the camera's stream."""
    sides = [stream_rows(which, data_folder() / "eth_hand_eye") for which in (ARM, CAMERA)]
    origin_ns = int(sides[0][0][0])
    streams = [
        stream_of(stamps, T, tuple(map(str, range(2, len(T) + 2))), origin_ns, "recorded")
        for stamps, T in sides
    ]
    return streams[0], streams[1]
