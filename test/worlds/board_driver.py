# SPDX-License-Identifier: Apache-2.0
"""A simulated camera on a robot before a board: rendered images as messages of ROS types."""

from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import cv2
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
from robocal_ros.hand_eye.boards import Chessboard, Markers
from robocal_ros.hand_eye.data import COMPRESSED, IMAGE

if TYPE_CHECKING:
    from sensor_msgs.msg import CameraInfo

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


# The same inner corners as the chessboard's, with markers between them.
CHARUCO = Chessboard(COLUMNS, ROWS, SQUARE_M, Markers("4X4_50", 0.019))
CHARUCO_FILE = f"""\
kind: charuco
squares: [{COLUMNS + 1}, {ROWS + 1}]
square_mm: {SQUARE_M * 1e3}
marker_mm: 19
dictionary: 4X4_50
"""
BLUR_PX, GREY_NOISE = 0.9, 3.0  # of the optics, one sigma; of a pixel, of 255
CELL_PX = 64  # of a square, as it is drawn


class BoardSet(NamedTuple):
    """What a camera saw: the cell, joints (m, n) as reported, grey images of each."""

    cell: BoardCell
    q: np.ndarray
    images: list[np.ndarray]


def marked_image(view: TruePose, rng: np.random.Generator, lens: TrueLens = LENS) -> np.ndarray:
    """The ChArUco board as a lens shows it: darker by cos^4 off its axis, blurred, noisy.

    OpenCV draws the board; that its corners lie where ours do is for the tests to show.
    """
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    squares = (COLUMNS + 1, ROWS + 1)
    board = cv2.aruco.CharucoBoard(squares, SQUARE_M, CHARUCO.markers.side_m, dictionary)
    drawn = board.generateImage((squares[0] * CELL_PX, squares[1] * CELL_PX)).astype(np.float32)
    drawn = cv2.GaussianBlur(drawn, (0, 0), 1.0)  # an edge between two samples of a pixel shows
    x, y = (side / SQUARE_M + 1.0 for side in lens.plane(view))  # from the board's first corner
    paper = (x > -1) & (x < squares[0] + 1) & (y > -1) & (y < squares[1] + 1)
    inside = (x >= 0) & (x < squares[0]) & (y >= 0) & (y < squares[1])
    u, v = ((side * CELL_PX - 0.5).astype(np.float32) for side in (x, y))
    ink = cv2.remap(drawn, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    shade = np.where(inside, 25.0 + ink * 200.0 / 255.0, np.where(paper, 225.0, 120.0))
    rows, columns = np.mgrid[: lens.height, : lens.width]
    far2 = ((columns - lens.cx) / lens.fx) ** 2 + ((rows - lens.cy) / lens.fy) ** 2
    dim = lens.taken(shade) / (1.0 + far2) ** 2
    seen = cv2.GaussianBlur(dim, (0, 0), BLUR_PX) + GREY_NOISE * rng.standard_normal(dim.shape)
    return np.clip(np.round(seen), 0, 255).astype(np.uint8)


@cache
def board_set(count: int = 12, seed: int = 6, marked: bool = False) -> BoardSet:
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
    images = [
        marked_image(views.take(i), rng)
        if marked
        else LENS.image(views.take(i), COLUMNS, ROWS, SQUARE_M)
        for i in range(count)
    ]
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


def compressed(
    stamp_ns: int, pixels: np.ndarray, suffix: str = ".jpg", told: str = "mono8; jpeg compressed "
) -> Recorded:
    """An image of grey pixels as compressed_image_transport sends it."""
    done, data = cv2.imencode(suffix, pixels)
    assert done
    header = {"stamp": ros_time(stamp_ns), "frame_id": FRAME}
    return Recorded(COMPRESSED, stamp_ns, {"header": header, "format": told, "data": bytes(data)})


def camera_info(**changed: Any) -> "CameraInfo":
    """What the driver of the lens tells."""
    from sensor_msgs.msg import CameraInfo
    from std_msgs.msg import Header

    K = [LENS.fx, 0.0, LENS.cx, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0]
    message = CameraInfo(
        header=Header(frame_id=FRAME),
        width=LENS.width,
        height=LENS.height,
        distortion_model="plumb_bob",
        d=[LENS.k1, LENS.k2, 0.0, 0.0, 0.0],
        k=K,
        p=[580.0, 0.0, 320.0, 0.0, 0.0, 580.0, 240.0, 0.0, 0.0, 0.0, 1.0, 0.0],
    )
    for name, value in changed.items():
        setattr(message, name, value)
    return message


def board_file(folder: Path, intrinsics: bool = False) -> Path:
    """A target file, with or without the true intrinsics beside it."""
    path = folder / "board.yaml"
    path.write_text(BOARD_FILE + ("intrinsics: camera.yaml\n" if intrinsics else ""))
    (folder / "camera.yaml").write_text(INTRINSICS_FILE)
    return path
