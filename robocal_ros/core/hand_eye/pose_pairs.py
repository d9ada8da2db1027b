"""Pairs of a robot's pose and of what a camera (or a tracker) saw from there."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames

Array = NDArray[np.float64]
_STRAIGHT = 1e-12  # sine of an angle that is its sine to the last digit
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
    return np.asarray(frames.invert(pairs.T_boardside_cameraside @ at.X) @ at.Z)


def differences(predicted_T: Array, pairs: PosePairs) -> Array:
    """Difference (m, 6) of predicted from seen board poses: position and turn, camera axes."""
    seen = pairs.T_camera_board
    turn = _log(predicted_T[:, :3, :3] @ np.swapaxes(seen[:, :3, :3], 1, 2))
    return np.concatenate([predicted_T[:, :3, 3] - seen[:, :3, 3], turn], axis=1)


def _log(R: Array) -> Array:
    """`frames.log_rotation` of many rotations (m, 3, 3), most of them small."""
    sine = 0.5 * np.stack(
        [R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], 1
    )
    length = np.sqrt(np.einsum("mi,mi->m", sine, sine))
    cosine = 0.5 * (np.einsum("mii->m", R) - 1.0)
    w = sine * (np.arctan2(length, cosine) / np.maximum(length, np.finfo(float).tiny))[:, None]
    w[length < _STRAIGHT] = sine[length < _STRAIGHT]
    large = cosine < _NEARLY_BACK
    if np.any(large):  # the sine loses the axis
        w[large] = frames.log_rotation(R[large])
    return np.asarray(w)


def levers(pairs: PosePairs, X: Array) -> Array:
    """From the flange's origin to the board (m, 3), camera axes: what a tilt error acts on."""
    carrier = frames.invert(X)  # T_camera_carrier
    if pairs.mount == "in-hand":
        return np.asarray(pairs.T_camera_board[:, :3, 3] - carrier[:3, 3])
    flange = pairs.T_base_flange[:, :3, 3] @ carrier[:3, :3].T + carrier[:3, 3]
    return np.asarray(pairs.T_camera_board[:, :3, 3] - flange)
