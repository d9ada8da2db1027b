"""Pairs of a robot's pose and of what a camera (or a tracker) saw from there."""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.camera_kernels import compare, predict

Array = NDArray[np.float64]
_NEARLY_BACK = -0.9
Mount = Literal["in-hand", "to-hand"]


@dataclass(frozen=True, eq=False)
class Shared:
    """Errors common to all board poses, such as those of the intrinsics.

    Attributes
    ----------
    sensitivity : (m, 6, s) of each board pose (position and turn along the camera's axes).
    covariance : (s, s) of the common errors before anything was seen.
    """

    sensitivity: Array
    covariance: Array


@dataclass(frozen=True, eq=False)
class PosePairs:
    """What a hand-eye calibration starts from.

    ``in-hand``: the camera is on the flange, the board stands still; unknown are
    X = T_flange_camera and Z = T_base_board with T_base_flange X T_camera_board = Z.
    ``to-hand``: the camera stands still, the board is on the flange; X = T_base_camera and
    Z = T_flange_board with X T_camera_board = T_base_flange Z.

    Attributes
    ----------
    T_base_flange, T_camera_board : (m, 4, 4).
    names : (m,) of the samples.
    covariance : (m, 6, 6) of T_camera_board, m and rad: of its position, and of its turn, both
        along the camera's axes; None where it is not known.
    time_s : (m,) of the samples of a stream, increasing; None of single shots.
    """

    T_base_flange: Array
    T_camera_board: Array
    names: tuple[str, ...]
    mount: Mount = "in-hand"
    covariance: Array | None = None
    shared: Shared | None = None
    time_s: Array | None = None

    def __len__(self) -> int:
        return len(self.names)

    @property
    def T_boardside_cameraside(self) -> Array:
        """The camera's parent in the board's (m, 4, 4): T_base_flange in hand, its inverse to hand.

        With it, T_boardside_cameraside X T_camera_board = Z either way.
        """
        return self.T_base_flange if self.mount == "in-hand" else frames.invert(self.T_base_flange)

    @cached_property
    def for_kernels(self) -> tuple[Array, Array]:
        """``T_boardside_cameraside`` and ``T_camera_board``, as kernels take them."""
        return plain(self.T_boardside_cameraside), plain(self.T_camera_board)

    @property
    def distance_m(self) -> float:
        """Mean distance of the board from the camera."""
        return float(np.mean(np.linalg.norm(self.T_camera_board[:, :3, 3], axis=1)))

    def take(self, rows: NDArray[np.intp] | NDArray[np.bool_]) -> "PosePairs":
        """Some of the pairs."""
        index = np.arange(len(self))[rows]
        return replace(
            self,
            T_base_flange=self.T_base_flange[index],
            T_camera_board=self.T_camera_board[index],
            names=tuple(self.names[i] for i in index),
            covariance=None if self.covariance is None else self.covariance[index],
            time_s=None if self.time_s is None else self.time_s[index],
            shared=None
            if self.shared is None
            else replace(self.shared, sensitivity=self.shared.sensitivity[index]),
        )


@dataclass(frozen=True, eq=False)
class Placement:
    """Both unknowns: ``X`` of the camera and ``Z`` of the board (see `PosePairs`), (4, 4)."""

    X: Array
    Z: Array


def predicted(pairs: PosePairs, at: Placement) -> Array:
    """T_camera_board (m, 4, 4) as the robot's poses have it."""
    carrier, _ = pairs.for_kernels
    T = np.empty_like(carrier)
    predict(carrier, plain(at.X), plain(at.Z), T)
    return T


def differences(predicted_T: Array, pairs: PosePairs) -> Array:
    """Difference (m, 6) of predicted from seen board poses: position and turn, camera axes."""
    _, seen = pairs.for_kernels
    miss = np.empty((len(seen), 6))
    if compare(plain(predicted_T), seen, miss) < _NEARLY_BACK:
        turn = predicted_T[:, :3, :3] @ np.swapaxes(seen[:, :3, :3], 1, 2)
        miss[:, 3:] = frames.log_rotation(turn)
    return miss


def plain(values: Array) -> Array:
    """As kernels take it: in one piece, and not read-only, which would be another type to them."""
    return np.require(values, np.float64, ("C", "W"))


def levers(pairs: PosePairs, X: Array) -> Array:
    """From the flange's origin to the board (m, 3), camera axes: what a tilt error acts on."""
    carrier = frames.invert(X)  # T_camera_carrier
    if pairs.mount == "in-hand":
        return np.asarray(pairs.T_camera_board[:, :3, 3] - carrier[:3, 3])
    flange = pairs.T_base_flange[:, :3, 3] @ carrier[:3, :3].T + carrier[:3, 3]
    return np.asarray(pairs.T_camera_board[:, :3, 3] - flange)
