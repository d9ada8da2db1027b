# SPDX-License-Identifier: Apache-2.0
"""What places a camera: boards in images, or streams on two clocks, paired with the robot's poses.

OpenCV's closed forms solve such pairs; `camera_fit` is better.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics.robots import read_fields

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

    ``T_base_flange``, ``T_camera_board`` (m, 4, 4).
    ``names`` (m,) of the samples.
    ``covariance`` (m, 6, 6) of T_camera_board, m and rad: of its position, and of its turn, both
    along the camera's axes; None where it is not known.
    ``time_s`` (m,) of the samples of a stream, increasing; None of single shots.
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


def plain(values: Array) -> Array:
    """As kernels take it: in one piece, and not read-only, which would be another type to them."""
    return np.require(values, np.float64, ("C", "W"))


Image = NDArray[np.uint8]

FEWEST_CORNERS = 3  # along each side
FEWEST_IMAGES = 5  # that give the intrinsics
SMALLEST_IMAGE_PX = 32  # of a side; OpenCV fails on less
FIRST_WINDOW_PX = 5  # half of the window in which a corner is refined
LARGEST_FOCAL_SIGMA = 0.03  # of the focal length; more, and the images do not show it
GROSS_RATIO = 4.0  # medians of the usual misfit, beyond which an image is left out


@dataclass(frozen=True)
class Chessboard:
    """Inner corners along both sides, and the side of a square, m.

    Board frame: origin in the first inner corner, x along ``columns``, y along ``rows``, z into
    the board as the camera sees it (OpenCV's order of corners).
    """

    columns: int
    rows: int
    square_m: float

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < FEWEST_CORNERS:
            raise InputError(
                f"a board of {self.columns}x{self.rows} inner corners shows no pose (at least "
                f"{FEWEST_CORNERS} each way)"
            )

    @property
    def points(self) -> Array:
        """(n, 3), m, board frame."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return self.square_m * np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A pinhole camera with OpenCV's distortion.

    ``matrix`` (3, 3), px. ``distortion`` (k,): k1, k2, p1, p2, k3 …
    ``size``: width and height of the images, px.
    ``covariance`` (4 + k, 4 + k) of fx, fy, cx, cy and the distortion; None where they are given
    and taken as exact.
    """

    matrix: Array
    distortion: Array
    size: tuple[int, int]
    covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class SeenBoards:
    """Where the board was in each image that shows it.

    ``names`` (m,). ``T_camera_board`` (m, 4, 4).
    ``covariance`` (m, 6, 6) of position and turn along the camera's axes, with exact intrinsics.
    ``shared``: what errors of the intrinsics do to all poses; None where they are exact.
    ``noise_px``: standard deviation of a corner's coordinate. ``rms_px`` (m,) misfit of each image.
    ``rejected``: name of each image left out, with the reason.
    """

    names: tuple[str, ...]
    T_camera_board: Array
    covariance: Array
    shared: Shared | None
    intrinsics: Intrinsics
    noise_px: float
    rms_px: Array
    rejected: dict[str, str]


def decode_image(data: bytes, name: str) -> Image:
    """Grey image (h, w) from the bytes of a file of any usual format.

    Raises `InputError` when it is no image.
    """
    import cv2

    image = None
    if data:
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    if image is None:
        raise InputError(f"{name} is no image that can be read")
    return np.asarray(image, dtype=np.uint8)


def find_corners(image: Image, board: Chessboard) -> Array | None:
    """Inner corners (n, 2), px, in the order of the board's points; None where no board shows."""
    import cv2

    if min(image.shape) < SMALLEST_IMAGE_PX:
        return None
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCorners(image, size)
    if not found:  # slower, and sees blurred and glaring boards too
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
    grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    nearest_px = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
    half = int(np.clip(0.4 * nearest_px, 1, FIRST_WINDOW_PX))  # of a window without a neighbour
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), end)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def see_boards(
    images: Sequence[tuple[str, Image]], board: Chessboard, intrinsics: Intrinsics | None = None
) -> SeenBoards:
    """Find the board in named images, and the intrinsics from the same images if none are given."""
    rejected: dict[str, str] = {}
    sizes = [(image.shape[1], image.shape[0]) for _, image in images]
    size = intrinsics.size if intrinsics else max(sizes, key=sizes.count, default=(0, 0))
    names, corners = [], []
    for name, image in images:
        if image.shape[::-1] != size:
            rejected[name] = (
                f"{image.shape[1]}x{image.shape[0]} px where {size[0]}x{size[1]} are expected"
            )
            continue
        found = find_corners(image, board)
        if found is None:
            rejected[name] = f"no board of {board.columns}x{board.rows} inner corners in it"
        else:
            names.append(name)
            corners.append(found)
    return boards_of_corners(names, np.array(corners), board, size, intrinsics, rejected)


def boards_of_corners(
    names: Sequence[str], corners: Array, board: Chessboard, size: tuple[int, int],
    intrinsics: Intrinsics | None = None, rejected: dict[str, str] | None = None,
) -> SeenBoards:  # fmt: skip
    """The same from corners (m, n, 2), px."""
    out = dict(rejected or {})
    _require(len(names), intrinsics, out)
    seen = _solve(tuple(names), corners, board, size, intrinsics)
    gross = seen.rms_px > GROSS_RATIO * np.median(seen.rms_px)
    if np.any(gross):
        for i in np.flatnonzero(gross).tolist():
            out[names[i]] = f"its corners miss a flat board by {seen.rms_px[i]:.2f} px rms"
        kept = np.flatnonzero(~gross).tolist()
        _require(len(kept), intrinsics, out)
        seen = _solve(tuple(names[i] for i in kept), corners[kept], board, size, intrinsics)
    return replace(seen, rejected=out)


def _require(count: int, intrinsics: Intrinsics | None, rejected: dict[str, str]) -> None:
    fewest = 1 if intrinsics else FEWEST_IMAGES
    if count >= fewest:
        return
    first = next(iter(rejected.items()), None)
    why = f"; {first[0]}: {first[1]}" if first else ""
    remedy = "" if intrinsics else ", or give the intrinsics"
    raise TooFewSamplesError(
        f"{count} images show the board (at least {fewest} are needed{remedy}){why}"
    )


def _solve(
    names: tuple[str, ...], corners: Array, board: Chessboard, size: tuple[int, int],
    intrinsics: Intrinsics | None,
) -> SeenBoards:  # fmt: skip
    camera = intrinsics or _calibrate(corners, board, size)
    poses = [_pose(points, board, camera) for points in corners]
    T = np.array([pose for pose, _, _ in poses])
    J_pose = np.array([J[:, :6] for _, _, J in poses])
    J_camera = np.array([J[:, 6:] for _, _, J in poses])
    miss = np.array([residual for _, residual, _ in poses])
    unknowns = 6 * len(names) + (0 if intrinsics else J_camera.shape[2])
    noise = float(np.sqrt(np.sum(miss**2) / (miss.size - unknowns)))
    alone = np.linalg.inv(J_pose.swapaxes(1, 2) @ J_pose)
    sensitivity = -alone @ J_pose.swapaxes(1, 2) @ J_camera
    if intrinsics is None:
        rest = J_camera + J_pose @ sensitivity
        camera = _with_covariance(camera, rest.reshape(-1, rest.shape[2]), noise)
    return SeenBoards(
        names=names,
        T_camera_board=T,
        covariance=noise**2 * alone,
        shared=None if camera.covariance is None else Shared(sensitivity, camera.covariance),
        intrinsics=camera,
        noise_px=noise,
        rms_px=np.sqrt(np.mean(miss**2, axis=1) * 2.0),
        rejected={},
    )


def _calibrate(corners: Array, board: Chessboard, size: tuple[int, int]) -> Intrinsics:
    import cv2

    points = [board.points.astype(np.float32)] * len(corners)
    seen = list(corners.astype(np.float32))
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)  # several add up in any order: the last bits would not come again
    try:
        _, matrix, distortion, _, _ = cv2.calibrateCamera(points, seen, size, None, None)
    except cv2.error as error:
        raise InputError(f"no camera sees a board as these corners lie: {error.err}") from error
    finally:
        cv2.setNumThreads(threads)
    return Intrinsics(
        np.asarray(matrix, dtype=np.float64), np.asarray(distortion, dtype=np.float64).ravel(), size
    )


def _with_covariance(camera: Intrinsics, rows: Array, noise_px: float) -> Intrinsics:
    """Covariance of the intrinsics once the poses have taken their part."""
    information = rows.T @ rows
    scale = 1.0 / np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    scaled = information * np.outer(scale, scale)
    inverse = np.linalg.pinv(scaled, rcond=1e-14, hermitian=True)
    covariance = np.asarray(noise_px**2 * inverse * np.outer(scale, scale))
    focal = float(np.sqrt(covariance[0, 0])) / float(camera.matrix[0, 0])
    if not focal < LARGEST_FOCAL_SIGMA:
        raise RankDeficientError(
            f"the images give the focal length to {100.0 * focal:.1f} % only: tilt the board by "
            "30 deg to 45 deg both ways in some of them, or give the intrinsics",
            ("focal length",),
        )
    return Intrinsics(camera.matrix, camera.distortion, camera.size, covariance)


def _pose(corners: Array, board: Chessboard, camera: Intrinsics) -> tuple[Array, Array, Array]:
    """T_camera_board, misfit (2 n,), px, and its Jacobian (2 n, 6 + 4 + k).

    By the pose (position and turn along the camera's axes), then fx, fy, cx, cy, distortion.
    """
    import cv2

    points, K, d = board.points, camera.matrix, camera.distortion
    # the better of the two poses in which a flat board looks alike (Collins and Bartoli 2014)
    _, turns, places, _ = cv2.solvePnPGeneric(points, corners, K, d, flags=cv2.SOLVEPNP_IPPE)
    if not turns:
        raise InputError("no pose of a board explains the corners: they nearly coincide")
    turn, place = cv2.solvePnPRefineLM(points, corners, K, d, turns[0], places[0])
    seen, J = cv2.projectPoints(points, turn, place, K, d)
    J = np.asarray(J, dtype=np.float64)
    w = np.asarray(turn, dtype=np.float64).ravel()
    T = frames.transform(frames.exp_rotation(w), np.asarray(place, dtype=np.float64).ravel())
    by_turn = J[:, :3] @ frames.left_jacobian_inverse(w)
    rows = np.concatenate([J[:, 3:6], by_turn, J[:, 6:]], axis=1)
    return T, np.asarray(seen, dtype=np.float64).reshape(-1) - corners.ravel(), rows


# ---- boards that a camera saw, paired with the robot's poses ------------------------------------


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


# ---- images of a camera, and its intrinsics as ROS writes them (camera_info YAML) ---------------


MODELS = {"plumb_bob": 5, "rational_polynomial": 8}  # and how many coefficients they have
MOST_PX = 100_000  # along a side of an image
NOT_NEEDED = ("camera_name", "rectification_matrix", "projection_matrix")


def read_intrinsics(path: Path) -> Intrinsics:
    """Read intrinsics, which are taken as exact.

    Raises `InputError`, naming file and key, when it is not as docs/hand_eye_camera.md says.
    """
    top = read_fields(path, "file of intrinsics")
    needed = ("image_width", "image_height", "camera_matrix", "distortion_model",
              "distortion_coefficients")  # fmt: skip
    top.only(*needed, *NOT_NEEDED)
    model = top.choice("distortion_model", tuple(MODELS))
    width, height = (top.whole(key, 1, MOST_PX) for key in needed[:2])
    matrix, distortion = top.below("camera_matrix"), top.below("distortion_coefficients")
    K = np.array(matrix.numbers("data", 9)).reshape(3, 3)
    if not (K[0, 0] > 0.0 and K[1, 1] > 0.0 and np.allclose(K[2], [0.0, 0.0, 1.0])):
        matrix.fail("must be fx 0 cx, 0 fy cy, 0 0 1 by rows, in px", "data")
    coefficients = np.array(distortion.numbers("data", MODELS[model]))
    return Intrinsics(K, coefficients, (width, height))


FEWEST_POSES = 20
SPAN_S = 0.25  # over which a turn is taken: noise of single poses must not drown it
STEP_S = 0.01
LEAST_OVERLAP = 0.5  # of the shorter stream
LEAST_CORRELATION = 0.6
CLOCK_JUMP_NS = 1_000_000_000
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

    Raises `InputError` when stamps go back by more than a second; `TooFewSamplesError`: fewer than
    20 poses.
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
