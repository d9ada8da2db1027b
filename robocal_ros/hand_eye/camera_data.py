# SPDX-License-Identifier: Apache-2.0
"""What places a camera: boards in images, or streams on two clocks, paired with the robot's poses.

OpenCV's closed forms solve such pairs; `camera_fit` is better.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics.joint_errors import ShotJoints

# ---- pairs of a robot's pose and of what a camera (or a tracker) saw from there -----------------


Mount = Literal["in-hand", "to-hand"]


@dataclass(frozen=True, eq=False)
class Shared:
    """Errors common to all board poses, such as those of the intrinsics.

    ``sensitivity`` (m, 6, s) of each board pose (position and turn along the camera's axes).
    ``covariance`` (s, s) of the common errors before anything was seen.
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

    ``T_base_flange``, ``T_camera_board`` (m, 4, 4). ``names`` (m,) of the samples. ``covariance``
    (m, 6, 6) of T_camera_board, m and rad: of its position, and of its turn, both along the
    camera's axes; None where it is not known. ``time_s`` (m,) of the samples of a stream,
    increasing; None of single shots. ``joints``: that the flange poses were read by, where known.
    """

    T_base_flange: Array
    T_camera_board: Array
    names: tuple[str, ...]
    mount: Mount = "in-hand"
    covariance: Array | None = None
    shared: Shared | None = None
    time_s: Array | None = None
    joints: ShotJoints | None = None

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
            joints=None if self.joints is None else self.joints.take(index),
            shared=None
            if self.shared is None
            else replace(self.shared, sensitivity=self.shared.sensitivity[index]),
        )


@dataclass(frozen=True, eq=False)
class Placement:
    """Both unknowns: ``X`` of the camera and ``Z`` of the board (see `PosePairs`), (4, 4)."""

    X: Array
    Z: Array


def plain(values: Array) -> Array:
    """As kernels take it: in one piece, and not read-only, which would be another type to them."""
    return np.require(values, np.float64, ("C", "W"))


# ---- streams of poses on two clocks -------------------------------------------------------------


FEWEST_POSES = 20
SPAN_S = 0.25  # over which a turn is taken: noise of single poses must not drown it
STEP_S = 0.01
LEAST_OVERLAP = 0.5  # of the shorter stream
LEAST_CORRELATION = 0.6
CLOCK_JUMP_NS = 1_000_000_000
LONGEST_PAUSE_NS = 3600 * CLOCK_JUMP_NS  # a first stamp of 0 is 50 years before the next one
LONGEST_GAP = 5.0  # usual periods between two robot poses that are interpolated


@dataclass(frozen=True, eq=False)
class PoseStream:
    """Poses T (n, 4, 4) at times (n,), s, that increase; ``names`` (n,) of the samples."""

    time_s: Array
    T: Array
    names: tuple[str, ...]

    @property
    def period_s(self) -> float:
        """Usual time between two poses."""
        return float(np.median(np.diff(self.time_s)))

    def at(self, time_s: Array) -> Array:
        """Poses (m, 4, 4), interpolated along the shortest turn; held beyond both ends."""
        t = np.clip(time_s, self.time_s[0], self.time_s[-1])
        i = np.clip(np.searchsorted(self.time_s, t, side="right") - 1, 0, len(self.time_s) - 2)
        share = (t - self.time_s[i]) / (self.time_s[i + 1] - self.time_s[i])
        first, second = self.T[i], self.T[i + 1]
        R = first[:, :3, :3]
        turn = frames.log_rotation(R.swapaxes(1, 2) @ second[:, :3, :3])
        place = first[:, :3, 3] + share[:, None] * (second[:, :3, 3] - first[:, :3, 3])
        return frames.transform(R @ frames.exp_rotation(share[:, None] * turn), place)

    def covers(self, time_s: Array) -> NDArray[np.bool_]:
        """Which times (m,) lie between two poses that follow each other closely."""
        i = np.clip(np.searchsorted(self.time_s, time_s, side="right"), 1, len(self.time_s) - 1)
        close = np.diff(self.time_s)[i - 1] <= LONGEST_GAP * self.period_s
        return np.asarray(close & (time_s >= self.time_s[0]) & (time_s <= self.time_s[-1]))


def stream_of(stamp_ns: NDArray[np.int64], T: Array, names: tuple[str, ...], origin_ns: int,
              what: str) -> PoseStream:  # fmt: skip
    """A stream from stamps (n,), times counted from ``origin_ns``.

    Poses that came late are put in order, repeated stamps count once.

    Raises `InputError` when stamps go back by more than a second, or ahead by more than an hour;
    `TooFewSamplesError`: fewer than 20 poses, or those of a quarter of a second.
    """
    back = -np.diff(stamp_ns)
    if len(back) and back.max() > CLOCK_JUMP_NS:
        row = int(np.argmax(back)) + 1
        raise InputError(
            f"the stamps of the {what} poses go back by {back.max() * 1e-9:.1f} s at sample "
            f"{names[row]}: give one run, on one clock"
        )
    stamps, first = np.unique(stamp_ns, return_index=True)
    if len(stamps) < FEWEST_POSES:
        raise TooFewSamplesError(
            f"{len(stamps)} {what} poses are no stream (at least {FEWEST_POSES})"
        )
    ahead, row = int(np.diff(stamps).max()), int(np.argmax(np.diff(stamps))) + 1
    if ahead > LONGEST_PAUSE_NS:
        raise InputError(
            f"the stamps of the {what} poses leap ahead by {ahead * 1e-9:.1f} s at sample "
            f"{names[first[row]]}: give one run, on one clock, all of it stamped"
        )
    lasting_s = float(stamps[-1] - stamps[0]) * 1e-9
    if lasting_s <= SPAN_S + STEP_S:
        raise TooFewSamplesError(
            f"the {what} poses last {lasting_s:.3f} s: record both for 20 s or more, stamped in s"
        )
    time_s = np.asarray((stamps - origin_ns) * 1e-9, dtype=np.float64)
    return PoseStream(time_s, T[first], tuple(names[i] for i in first))


def coarse_offset(robot: PoseStream, camera: PoseStream) -> float:
    """What to add to the camera's stamps, s, so that both streams turn at the same times.

    Raises `InputError` when the angular speeds nowhere correlate.
    """
    a, b = _turns(robot), _turns(camera)
    here, there = np.ones(len(a)), np.ones(len(b))
    a, b = a - a.mean(), b - b.mean()
    together = _correlate(here, there)
    scale = np.sqrt(np.maximum(_correlate(a**2, there) * _correlate(here, b**2), 0.0))
    enough = together >= LEAST_OVERLAP * min(len(a), len(b))
    with np.errstate(divide="ignore", invalid="ignore"):
        value = np.where(enough & (scale > 0.0), _correlate(a, b) / scale, -1.0)
    best = int(np.argmax(value))
    if value[best] < LEAST_CORRELATION:
        raise InputError(
            f"the angular speeds of robot and camera nowhere correlate (at best "
            f"{value[best]:.2f}): are both streams of one run, and did the robot turn?"
        )
    lag, near = float(best - (len(b) - 1)), value[max(best - 1, 0) : best + 2]
    if len(near) == 3 and np.all(near > -1.0):  # where a parabola through them is highest
        curve = float(near[0] - 2.0 * near[1] + near[2])
        lag += 0.0 if curve >= 0.0 else float(0.5 * (near[0] - near[2]) / curve)
    return float(robot.time_s[0] - camera.time_s[0] + lag * STEP_S)


def _turns(stream: PoseStream) -> Array:
    """Angles turned within `SPAN_S`, every `STEP_S`: no frame's choice changes them."""
    grid = np.arange(stream.time_s[0], stream.time_s[-1] - SPAN_S, STEP_S)
    R = stream.at(grid)[:, :3, :3].swapaxes(1, 2) @ stream.at(grid + SPAN_S)[:, :3, :3]
    return np.asarray(np.linalg.norm(frames.log_rotation(R), axis=1))


def _correlate(a: Array, b: Array) -> Array:
    """Sums of products at all lags (len(a) + len(b) - 1,)."""
    from scipy.signal import correlate

    return np.asarray(correlate(a, b, method="fft"))


def pairs_at(
    robot: PoseStream, camera: PoseStream, offset_s: float, mount: Mount
) -> tuple[PosePairs, tuple[str, ...]]:
    """Camera poses with the robot's at their times; names of those that have none.

    Raises `TooFewSamplesError` when the streams hardly overlap.
    """
    time = camera.time_s + offset_s
    there = robot.covers(time)
    if int(there.sum()) < FEWEST_POSES:
        raise TooFewSamplesError(
            f"{int(there.sum())} of {len(time)} camera poses lie within the robot's stream at an "
            f"offset of {offset_s:.3f} s: record both for longer"
        )
    names = np.array(camera.names)
    pairs = PosePairs(
        T_base_flange=robot.at(time[there]),
        T_camera_board=camera.T[there],
        names=tuple(names[there].tolist()),
        mount=mount,
        time_s=camera.time_s[there],
    )
    return pairs, tuple(names[~there].tolist())


# ---- the closed forms of OpenCV: five for AX = XB, two for AX = ZB ------------------------------


HAND_EYE = ("tsai", "park", "horaud", "andreff", "daniilidis")
ROBOT_WORLD = ("shah", "li")
CLOSED_FORMS = (*HAND_EYE, *ROBOT_WORLD)

MOST_COMPARED = 100  # samples: OpenCV pairs each with each
_LEAST_DETERMINANT = 0.5  # of what OpenCV calls a rotation


def closed_form(name: str, pairs: PosePairs) -> Placement | None:
    """`closed_form_of_all`, of at most 100 of the samples, spread evenly."""
    if len(pairs) > MOST_COMPARED:
        pairs = pairs.take(np.linspace(0, len(pairs) - 1, MOST_COMPARED).astype(int))
    return closed_form_of_all(name, pairs)


def closed_form_of_all(name: str, pairs: PosePairs) -> Placement | None:
    """One of ``CLOSED_FORMS`` (cv2.calibrateHandEye, cv2.calibrateRobotWorldHandEye).

    OpenCV's five give X alone; Z is then the mean of what the samples make of it. None where
    OpenCV fails or gives what is no number. Time grows with the square of the samples.
    """
    import cv2

    carrier, board = pairs.T_boardside_cameraside, pairs.T_camera_board
    try:
        if name in HAND_EYE:
            code = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
            X = _transform(_call(cv2.calibrateHandEye, carrier, board, method=code))
            if np.array_equal(X, np.eye(4)):  # what OpenCV gives where motions tell too little
                return None
            Z = _mean(carrier @ X @ board)
        else:
            code = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
            # OpenCV's world is our board, and its robot's poses are base in flange
            turned = frames.invert(carrier)
            R, t, R_camera, t_camera = _call(
                cv2.calibrateRobotWorldHandEye, board, turned, method=code
            )
            X = frames.invert(_transform((R_camera, t_camera)))
            Z = frames.invert(_transform((R, t)))
    except (cv2.error, np.linalg.LinAlgError):
        return None
    found = Placement(X, Z)
    return found if np.all(np.isfinite(X)) and np.all(np.isfinite(Z)) else None


def _call(solve: Callable[..., Any], first: Array, second: Array, method: int) -> Any:
    return solve(
        list(first[:, :3, :3]),
        list(first[:, :3, 3]),
        list(second[:, :3, :3]),
        list(second[:, :3, 3]),
        method=method,
    )


def _transform(found: Any) -> Array:
    R, t = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.float64)
    if not np.all(np.isfinite(R)) or np.linalg.det(R) < _LEAST_DETERMINANT:
        return np.full((4, 4), np.nan)
    return frames.transform(frames.nearest_rotation(R), t.ravel())


def _mean(T: Array) -> Array:
    """Mean of poses (m, 4, 4): of their positions, and the rotation nearest to all."""
    if not np.all(np.isfinite(T)):
        return np.full((4, 4), np.nan)
    R = frames.nearest_rotation(T[:, :3, :3].mean(axis=0))
    return frames.transform(R, T[:, :3, 3].mean(axis=0))
