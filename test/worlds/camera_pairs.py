# SPDX-License-Identifier: Apache-2.0
"""Poses of a robot and of a board that a camera on it sees, simulated."""

import numpy as np
from scipy.stats import chi2

from bench.hand_eye_cell import BoardCell, BoardNoise, TrueLens, TruePose
from robocal_ros.ground import frames
from robocal_ros.hand_eye.boards import Chessboard
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.camera_fit import GivenNoise

MOUNTS = ("in-hand", "to-hand")
EXACT = BoardNoise(0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
KNOWN = GivenNoise(robot_m=2e-4, robot_rad=3e-4, camera_scale=1.0)
BOARD = Chessboard(9, 6, 0.025)
LENS = TrueLens()


def measured(count: int, seed: int, mount: str = "in-hand", noise: BoardNoise | None = None):
    """A cell and what was read in it; the covariance of the board's poses is known."""
    rng = np.random.default_rng(seed)
    cell = BoardCell(mount=mount) if noise is None else BoardCell(mount=mount, noise=noise)
    views = cell.views(rng, count)
    pairs = PosePairs(
        cell.read_robot(cell.flange(views), rng),
        cell.read_board(views, rng),
        tuple(f"s{i}" for i in range(count)),
        mount,
        np.tile(cell.noise.board_covariance, (count, 1, 1)) if noise is None else None,
    )
    return cell, pairs


def error(T: np.ndarray, truth: TruePose) -> np.ndarray:
    """Increment (v, w), along the camera's axes, by which the truth differs from an estimate."""
    T_true = truth.matrices()[0]
    turn = frames.log_rotation(T[:3, :3].T @ T_true[:3, :3])
    return np.concatenate([T[:3, :3].T @ (T_true[:3, 3] - T[:3, 3]), turn])


def sound(value: float, dof: int) -> bool:
    """Whether a sum of squares is one that chance gives in all but one of 10 000 cases."""
    low, high = chi2.ppf([5e-5, 1.0 - 5e-5], dof)
    return bool(low < value < high)
