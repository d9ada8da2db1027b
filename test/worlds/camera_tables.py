# SPDX-License-Identifier: Apache-2.0
"""Tables and images of a simulated camera for ``robocal hand-eye camera``."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bench.hand_eye_cell import BoardCell, BoardNoise, TrueLens, TruePose
from robocal_ros.hand_eye.files import write_pose_table

NOISE = BoardNoise(1e-4, 2e-4, (2e-4, 2e-4, 2e-4), (5e-4, 5e-4, 5e-4))
CELL = BoardCell(noise=NOISE)
LENS = TrueLens()
OFFSET_S = 0.08
USED = 6  # images that solve where the others judge
MATRIX = [LENS.fx, 0.0, LENS.cx, 0.0, LENS.fy, LENS.cy, 0.0, 0.0, 1.0]
INTRINSICS = f"""image_width: 640
image_height: 480
camera_name: gripper
camera_matrix: {{rows: 3, cols: 3, data: {MATRIX}}}
distortion_model: plumb_bob
distortion_coefficients: {{rows: 1, cols: 5, data: [{LENS.k1}, {LENS.k2}, 0, 0, 0]}}
"""


def moving_flange(time_s: np.ndarray) -> TruePose:
    """A smooth motion that turns about all axes, and stands for a moment now and then."""
    t = time_s + 0.3 * np.sin(1.3 * time_s)
    turn = np.column_stack(
        [0.4 * np.sin(0.9 * t), 0.5 * np.sin(0.7 * t + 1.0), 0.8 * np.sin(0.5 * t + 2.0)]
    )
    place = np.column_stack(
        [0.5 + 0.1 * np.sin(0.8 * t), 0.1 * np.sin(1.1 * t), 0.4 + 0.05 * np.sin(0.6 * t)]
    )
    start = Rotation.from_rotvec([np.pi - 0.2, 0.0, 0.0])
    return TruePose(start * Rotation.from_rotvec(turn), place)


def camera_tables(folder: Path) -> None:
    """Pairs of poses: some to solve, some to judge; and pairs that turn about one axis."""
    rng = np.random.default_rng(0)
    views = CELL.views(rng, 20)
    robot, board = CELL.read_robot(CELL.flange(views), rng), CELL.read_board(views, rng)
    names = [f"s{i}" for i in range(20)]
    write_pose_table(folder / "board_poses.csv", board, names=names)
    write_pose_table(folder / "camera_poses.csv", robot[:14], names=names[:14])
    write_pose_table(folder / "camera_check.csv", robot[14:], names=names[14:])
    write_pose_table(folder / "few_camera_poses.csv", robot[:2], names=names[:2])


def stream_tables(folder: Path) -> None:
    """Poses of a robot and of a board with stamps, the camera's clock behind."""
    rng = np.random.default_rng(1)
    robot_s, camera_s = np.arange(0.0, 15.0, 0.02), np.arange(1.0, 14.0, 0.066)
    flange = moving_flange(camera_s)
    start_ns = 1_700_000_000_000_000_000
    for name, time_s, T in (
        ("stream_poses", robot_s, CELL.read_robot(moving_flange(robot_s), rng)),
        ("stream_boards", camera_s - OFFSET_S, CELL.read_board(CELL.seen_from(flange), rng)),
    ):
        stamps = start_ns + np.round(time_s * 1e9).astype(np.int64)
        write_pose_table(folder / f"{name}.csv", T, stamp_ns=stamps)


def image_tables(folder: Path, count: int = 9) -> None:
    """Images of a chessboard in ``images``, their poses, the true intrinsics; one is blank.

    ``image_used`` and ``image_check`` are the first six of the poses and the others.
    """
    import cv2

    rng = np.random.default_rng(2)
    views = CELL.views(rng, count)
    place = folder / "images"
    place.mkdir()
    files = [f"shot{i}.png" for i in range(count)]
    for i, file in enumerate(files):
        image = LENS.image(views.take(i), 9, 6, 0.025)
        cv2.imwrite(str(place / file), image if i != 3 else np.full_like(image, 80))
    robot = CELL.read_robot(CELL.flange(views), rng)
    for name, part in (
        ("poses", slice(None)), ("used", slice(USED)), ("check", slice(USED, None)),
    ):  # fmt: skip
        write_pose_table(
            folder / f"image_{name}.csv", robot[part], files[part], file_column="image"
        )
    (folder / "camera.yaml").write_text(INTRINSICS)
