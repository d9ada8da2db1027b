# SPDX-License-Identifier: Apache-2.0
"""A simulated camera on a robot before a chessboard: rendered images as messages of ROS types."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from hand_eye_driver import ARM, FRAME, Q_NEAR, Recorded

from bench.hand_eye_cell import (
    ArmRobot,
    BoardCell,
    BoardNoise,
    TrueLens,
    TruePose,
    true_pose,
)
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.hand_eye.data import IMAGE

COLUMNS, ROWS, SQUARE_M = 9, 6, 0.025
LENS = TrueLens()
ROBOT_M, ROBOT_RAD = 1e-4, 2e-4  # error of a reported pose about each axis
STRAIGHT = true_pose((0.0, 0.0, 0.0), (-0.1, -0.0625, 0.55))  # a view of the middle of the board
CAMERA = true_pose((0.1, 0.2, 1.4), (0.03, 0.08, 0.12))  # in the flange
BOARD_FILE = f"kind: board\ncolumns: {COLUMNS}\nrows: {ROWS}\nsquare_mm: {SQUARE_M * 1e3}\n"
INTRINSICS_FILE = f"""\
image_width: {LENS.width}
image_height: {LENS.height}
camera_matrix:
  {{rows: 3, cols: 3, data: [{LENS.fx}, 0, {LENS.cx}, 0, {LENS.fy}, {LENS.cy}, 0, 0, 1]}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [{LENS.k1}, {LENS.k2}, 0, 0, 0]}}
"""


class BoardSet(NamedTuple):
    """What a camera saw: the cell, joints (m, n) as reported, grey images of each."""

    cell: BoardCell
    q: np.ndarray
    images: list[np.ndarray]


@cache
def board_set(count: int = 12, seed: int = 6) -> BoardSet:
    """Images of a board that stands still, from poses about `Q_NEAR`."""
    rng = np.random.default_rng(seed)
    there = ARM.fk(Q_NEAR)
    turn = TruePose(CAMERA.R.from_matrix(there[None, :3, :3]), there[None, :3, 3])
    noise = BoardNoise(ROBOT_M, ROBOT_RAD)
    cell = BoardCell(camera=CAMERA, board=turn @ CAMERA @ STRAIGHT, noise=noise)
    views = cell.views(rng, count)
    reported = cell.read_robot(cell.flange(views), rng)
    exact = replace(rigid_robot(ARM, 0.0, rng), repeatability=0.0, effects=Effects.none())
    q = np.array([ArmRobot(exact, Q_NEAR).stand(T, rng).q for T in reported])
    images = [LENS.image(views.take(i), COLUMNS, ROWS, SQUARE_M) for i in range(count)]
    return BoardSet(cell, q, images)


def image(
    stamp_ns: int, pixels: np.ndarray, frame: str = FRAME, encoding: str = "mono8"
) -> Recorded:
    """An image of grey pixels (h, w), or of colours (h, w, 3)."""
    height, width = pixels.shape[:2]
    data = np.ascontiguousarray(pixels).tobytes()
    fields: dict[str, Any] = {
        "header": {"stamp": ros_time(stamp_ns), "frame_id": frame},
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": len(data) // height,
        "data": data,
    }
    return Recorded(IMAGE, stamp_ns, fields)


def board_file(folder: Path, intrinsics: bool = False) -> Path:
    """A target file, with or without the true intrinsics beside it."""
    path = folder / "board.yaml"
    path.write_text(BOARD_FILE + ("intrinsics: camera.yaml\n" if intrinsics else ""))
    (folder / "camera.yaml").write_text(INTRINSICS_FILE)
    return path
