# SPDX-License-Identifier: Apache-2.0
"""Real measurements for the hand-eye of a camera, as pairs, streams, and tables of the command.

A UR10 with a T-Mac (Landgraf et al. 2021, MIT), a UR with a camera (wangrp1997, MIT), an arm with
a camera and time stamps (Furrer et al. 2017, BSD-3-Clause), below $ROBOCAL_DATA.
"""

import csv
from dataclasses import dataclass, replace
from decimal import Decimal
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.ur10_campaigns import data_folder
from robocal_ros.ground import frames
from robocal_ros.hand_eye.boards import Chessboard, Image, decode_image
from robocal_ros.hand_eye.camera_data import (
    Placement,
    PosePairs,
    PoseStream,
    closed_form,
    stream_of,
)
from robocal_ros.hand_eye.files import write_pose_table

Array = NDArray[np.float64]

BOARD = Chessboard(9, 6, 0.025)
# What a first evaluation of the same measurements gave, rounded up; each README beside them tells:
TMAC_MM = {"B": 0.80, "D": 0.77}  # mean, maximum likelihood (0.789, 0.762)
BOARD_RMS_MM = 2.46  # the best of OpenCV's closed forms (2.46 to 2.61)
ARM_RMS_MM = 4.3  # maximum likelihood (4.26; OpenCV 4.5 to 4.7)

IMAGES = "camera_hand_eye"
ARM = "eth_hand_eye/real/robot_arm_complete_bag_color_and_ir_{}.csv"


def folder() -> Path:
    """Of all real measurements."""
    return data_folder().parent


def tmac_pairs(series: str) -> PosePairs:
    """Flange poses and T-Mac poses of series B or D: the tracker stands still."""
    path = folder() / "ur10_tmac" / f"Series_{series}" / "calibration_handeye.csv"
    with path.open(newline="") as stream:
        rows = list(csv.DictReader(stream, delimiter=";"))

    def columns(*names: str) -> Array:
        return np.array([[float(row[name].replace(",", ".")) for name in names] for row in rows])

    flange = frames.transform_from_quat(
        columns("flange_x", "flange_y", "flange_z"),
        columns("flange_qx", "flange_qy", "flange_qz", "flange_qw"),
    )
    angles = columns("measurement_rx", "measurement_ry", "measurement_rz")
    turn = Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()
    place = columns("measurement_x", "measurement_y", "measurement_z") * 1e-3
    names = tuple(str(row) for row in range(2, len(rows) + 2))
    return PosePairs(flange, frames.transform(turn, place), names, "to-hand")


def turned_tsai(pairs: PosePairs) -> Placement | None:
    """OpenCV's Tsai with the roles of X and Z exchanged: on series B it is off by millimetres."""
    found = closed_form(
        "tsai", replace(pairs, mount="in-hand", T_camera_board=frames.invert(pairs.T_camera_board))
    )
    return None if found is None else Placement(found.Z, found.X)


@dataclass(frozen=True, eq=False)
class BoardShots:
    """Flange poses (m, 4, 4) and the images taken there."""

    T_base_flange: Array
    images: list[tuple[str, Image]]


def board_shots() -> BoardShots:
    """The 20 images of a chessboard."""
    place = folder() / IMAGES
    text = next(place.glob("tcp_pose*.txt")).read_text().replace("[", " ").replace("]", " ")
    rows = np.array(text.split(), dtype=np.float64).reshape(-1, 6)
    T = frames.transform(Rotation.from_rotvec(rows[:, 3:]).as_matrix(), rows[:, :3])
    names = [f"image{index:02d}.bmp" for index in range(1, len(rows) + 1)]
    images = [(name, decode_image((place / name).read_bytes(), name)) for name in names]
    return BoardShots(T, images)


def arm_rows(which: str) -> tuple[NDArray[np.int64], Array]:
    """Stamps (n,), ns, and poses (n, 4, 4) of one side: the flange's, or T_camera_board."""
    lines = (folder() / ARM.format(which)).read_text().split("\n")
    cells = [line.split(",") for line in lines if line.strip()]
    stamps = [int(Decimal(row[0].strip()).scaleb(9)) for row in cells]
    values = np.array([row[1:] for row in cells], dtype=np.float64)
    T = frames.transform_from_quat(values[:, :3], values[:, 3:])
    if which == "target_ir":
        T = frames.invert(T)  # the file has the camera in the target's frame
    return np.array(stamps, dtype=np.int64), T


def arm_streams() -> tuple[PoseStream, PoseStream]:
    """The arm's and the camera's stream."""
    sides = [arm_rows("base_link_sr300_hinge"), arm_rows("target_ir")]
    origin_ns = int(sides[0][0][0])
    streams = [
        stream_of(stamps, T, tuple(map(str, range(2, len(T) + 2))), origin_ns, "recorded")
        for stamps, T in sides
    ]
    return streams[0], streams[1]


def write_tables(out: Path) -> None:
    """The same as tables of ``robocal hand-eye camera``; images stay where they are."""
    for series in ("B", "D"):
        pairs = tmac_pairs(series)
        write_pose_table(out / f"{series}_poses.csv", pairs.T_base_flange)
        write_pose_table(out / f"{series}_measured.csv", pairs.T_camera_board)
    shots = board_shots()
    names = [name for name, _ in shots.images]
    write_pose_table(out / "board_poses.csv", shots.T_base_flange, names, file_column="image")
    for which, name in (("base_link_sr300_hinge", "poses"), ("target_ir", "measured")):
        stamps, T = arm_rows(which)
        write_pose_table(out / f"arm_{name}.csv", T, stamp_ns=stamps)
