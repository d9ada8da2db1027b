# SPDX-License-Identifier: Apache-2.0
"""Boards that a camera saw: their corners in images, its intrinsics, and where the boards were."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import MOST_PIXELS, image_array
from robocal_ros.hand_eye.camera_data import Mount, PosePairs, Shared
from robocal_ros.kinematics.joint_errors import ShotJoints
from robocal_ros.kinematics.robots import read_fields

Image = NDArray[np.uint8]

FEWEST_CORNERS = 3  # along each side
FEWEST_MARKED = 6  # corners of a ChArUco board in an image: of fewer a pose has little to check it
FEWEST_IMAGES = 5  # that give the intrinsics
SMALLEST_IMAGE_PX = 32  # of a side; OpenCV fails on less
FIRST_WINDOW_PX = 5  # half of the window in which a corner is refined
LARGEST_FOCAL_SIGMA = 0.03  # of the focal length; more, and the images do not show it
GROSS_RATIO = 4.0  # medians of the usual misfit, beyond which an image is left out
MOST_PX = 100_000  # along a side of an image
CLEAR_RAD = float(np.radians(5.0))  # by which turns of board and robot miss where one is wrong
MOST_ROUNDS, SETTLED = 30, 1e-12  # of a fisheye's pose

DICTIONARIES = (
    *(f"{bits}X{bits}_{count}" for bits in (4, 5, 6, 7) for count in (50, 100, 250, 1000)),
    "ARUCO_ORIGINAL", "APRILTAG_16h5", "APRILTAG_25h9", "APRILTAG_36h10", "APRILTAG_36h11",
)  # fmt: skip
"""OpenCV's names of the predefined ones, without ``DICT_``."""
MARKERS_OF = {
    "ARUCO_ORIGINAL": 1024, "APRILTAG_16h5": 30, "APRILTAG_25h9": 35, "APRILTAG_36h10": 2320,
    "APRILTAG_36h11": 587,
}  # fmt: skip
"""How many markers they have; the names of the others tell it."""


# ---- boards, and their corners in an image ------------------------------------------------------


@dataclass(frozen=True)
class Markers:
    """ArUco markers in the white squares of a ChArUco board, numbered by rows from the first.

    ``dictionary``: one of `DICTIONARIES`. ``side_m``: of a marker.
    ``legacy``: the first square is white, as OpenCV before 4.6 drew boards of an even number of
    rows.
    """

    dictionary: str
    side_m: float
    legacy: bool = False

    def __post_init__(self) -> None:
        if self.dictionary not in DICTIONARIES:
            raise InputError(f"'{self.dictionary}' is no dictionary of markers that is known")


@dataclass(frozen=True)
class Chessboard:
    """Inner corners along both sides, and the side of a square, m.

    Board frame: origin in the first inner corner, x along ``columns``, y along ``rows``, z into
    the board as the camera sees it (OpenCV's order of corners).

    ``markers``: of a ChArUco board, which tell each corner from the others, so that a part of the
    board is enough; None: all corners are seen, or none.
    """

    columns: int
    rows: int
    square_m: float
    markers: Markers | None = None

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < FEWEST_CORNERS:
            raise InputError(
                f"a board of {self.columns}x{self.rows} inner corners shows no pose (at least "
                f"{FEWEST_CORNERS} each way)"
            )
        if self.markers and not 0.0 < self.markers.side_m < self.square_m:
            raise InputError(
                f"markers of {self.markers.side_m * 1e3:g} mm do not fit into squares of "
                f"{self.square_m * 1e3:g} mm"
            )

        if self.markers is None:
            return
        name, needed = self.markers.dictionary, (self.columns + 1) * (self.rows + 1) // 2
        known = MARKERS_OF.get(name) or int(name.partition("_")[2])
        if needed > known:
            raise InputError(f"{self} has {needed} markers, of which {name} has {known} only")

    def __str__(self) -> str:
        if self.markers is None:
            return f"board of {self.columns}x{self.rows} inner corners"
        squares = f"{self.columns + 1}x{self.rows + 1} squares"
        return f"ChArUco board of {squares} ({self.markers.dictionary})"

    @property
    def points(self) -> Array:
        """(n, 3), m, board frame."""
        y, x = np.mgrid[: self.rows, : self.columns]
        return self.square_m * np.stack([x.ravel(), y.ravel(), 0.0 * x.ravel()], axis=1)

    def seen(self, corners: Array) -> tuple[Array, Array]:
        """Points (k, 3), m, and pixels (k, 2) of what `find_corners` gives.

        Raises `InputError` when these are not of this board, or too few of it.
        """
        points = self.points
        if self.markers is None:
            if corners.shape != (len(points), 2):
                raise InputError(f"{len(corners)} corners where the board has {len(points)}")
            return points, corners
        numbers = corners[:, 2].astype(int) if corners.shape[1:] == (3,) else np.array([-1])
        own = np.all((numbers >= 0) & (numbers < len(points)) & (numbers == corners[:, -1]))
        if not own or len(set(numbers.tolist())) < len(numbers):
            raise InputError(f"the corners are not numbered as those of a {self}")
        # With all but one in a line no homography is determined, with which a pose begins.
        lines = (numbers % self.columns, numbers // self.columns)
        if len(numbers) < FEWEST_MARKED or any(
            len(numbers) - np.bincount(line).max() < 2 for line in lines
        ):
            raise InputError(
                f"{len(numbers)} corners of the {self} are too few (at least {FEWEST_MARKED}, and "
                "two of them beside any one row or column)"
            )
        return points[numbers], np.ascontiguousarray(corners[:, :2])


def decode_image(data: bytes, name: str) -> Image:
    """Grey image (h, w) from the bytes of a file of any usual format.

    Raises `InputError` when it is no image, and before it is decoded when the header of a PNG or
    JPEG tells more pixels than are read.
    """
    import cv2

    width, height = header_size(data)
    if width * height > MOST_PIXELS:
        raise InputError(f"{name} has {width}x{height} px: {MOST_PIXELS} at most are read")
    image = None
    if data:
        how = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION
        with suppress(cv2.error):  # of more pixels than OpenCV takes
            image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), how)
    if image is None:
        raise InputError(f"{name} is no image that can be read")
    return np.asarray(image, dtype=np.uint8)


def header_size(data: bytes) -> tuple[int, int]:
    """Width and height, px, as the header of a PNG or JPEG tells them; (0, 0) of what tells none.

    PNG: ISO/IEC 15948, 11.2.2 (IHDR comes first). JPEG: ITU-T T.81, B.1.1 and B.2.2.
    """
    if data[:8] == b"\x89PNG\r\n\x1a\n" and data[12:16] == b"IHDR" and len(data) >= 24:
        return int.from_bytes(data[16:20]), int.from_bytes(data[20:24])
    place = 2 if data[:2] == b"\xff\xd8" else len(data)
    while place + 9 <= len(data) and data[place] == 0xFF:
        marker = data[place + 1]
        if marker == 0xFF:  # a fill byte
            place += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a frame begins
            height, width = data[place + 5 : place + 7], data[place + 7 : place + 9]
            return int.from_bytes(width), int.from_bytes(height)
        else:
            place += 2 + int.from_bytes(data[place + 2 : place + 4])
    return 0, 0


def message_image(message: Any) -> Image:
    """Grey image (h, w) of a ``sensor_msgs/Image``, or of a ``CompressedImage`` (JPEG, PNG).

    ``format`` of the latter begins with the encoding of the image before it was compressed.

    Raises `InputError` as `image_array`; for depths, 16 bits and unfinished colours (Bayer).
    """
    if not hasattr(message, "format"):
        return image_array(message)
    told = str(message.format)
    encoding = told.partition(";")[0].strip()
    if "compressedDepth" in told or "bayer" in encoding or "16" in encoding or "32" in encoding:
        raise InputError(
            f"images of format '{told}' are not read: have the camera publish 8 bits of grey or "
            "colours"
        )
    return decode_image(bytes(message.data), f"the compressed image of format '{told}'")


def find_corners(image: Image, board: Chessboard) -> Array | None:
    """Inner corners (n, 2), px, in the order of the board's points; None where no board shows.

    Of a ChArUco board those that are seen (k, 3): x and y, px, and the corner's number.

    Raises `InputError` when this OpenCV cannot look for ChArUco boards.
    """
    import cv2

    if min(image.shape) < SMALLEST_IMAGE_PX:
        return None
    if board.markers is not None:
        return _find_marked(image, board, board.markers)
    size = (board.columns, board.rows)
    found, corners = cv2.findChessboardCorners(image, size)
    if not found:  # slower, and sees blurred and glaring boards too
        found, corners = cv2.findChessboardCornersSB(image, size, flags=cv2.CALIB_CB_ACCURACY)
        if not found:
            return None
    grid = np.asarray(corners, dtype=np.float64).reshape(board.rows, board.columns, 2)
    if (board.columns + board.rows) % 2 and not begins_dark(image, grid):
        corners, grid = corners[::-1].copy(), grid[::-1, ::-1]  # the two begin at opposite ends
    nearest_px = min(np.linalg.norm(np.diff(grid, axis=k), axis=2).min() for k in (0, 1))
    return _refined(image, corners, 0.4 * nearest_px)


def begins_dark(image: Image, grid: Array) -> bool:
    """Whether the square beside the first of the corners (rows, columns, 2) is a dark one."""
    middle = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    x, y = np.rint(middle).astype(int).reshape(-1, 2).T
    seen = image[np.clip(y, 0, image.shape[0] - 1), np.clip(x, 0, image.shape[1] - 1)]
    even = (np.indices(middle.shape[:2]).sum(axis=0) % 2 == 0).ravel()
    return bool(seen[even].mean() < seen[~even].mean())


def _refined(image: Image, corners: Any, free_px: float) -> Array:
    """Corners (n, 2), px; ``free_px``: half of a window that holds nothing beside the corner."""
    import cv2

    half = int(np.clip(free_px, 1, FIRST_WINDOW_PX))
    end = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-4)
    refined = cv2.cornerSubPix(image, corners, (half, half), (-1, -1), end)
    return np.asarray(refined, dtype=np.float64).reshape(-1, 2)


def _find_marked(image: Image, board: Chessboard, markers: Markers) -> Array | None:
    import cv2

    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        raise InputError(
            f"OpenCV {cv2.__version__} cannot look for ChArUco boards: install 4.7 or newer, or "
            "use a chessboard"
        )
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, f"DICT_{markers.dictionary}"))
    drawn = cv2.aruco.CharucoBoard(
        (board.columns + 1, board.rows + 1), board.square_m, markers.side_m, dictionary
    )
    drawn.setLegacyPattern(markers.legacy)
    corners, numbers, _, _ = cv2.aruco.CharucoDetector(drawn).detectBoard(image)
    if numbers is None or len(numbers) < FEWEST_MARKED:
        return None
    place = np.full((board.rows * board.columns, 2), np.nan)
    place[numbers.ravel()] = corners.reshape(-1, 2)
    grid = place.reshape(board.rows, board.columns, 2)
    steps = [np.linalg.norm(np.diff(grid, axis=k), axis=2).ravel() for k in (0, 1)]
    nearest_px = float(np.nanmin(np.concatenate([*steps, [image.size]])))
    margin = 0.5 * (1.0 - markers.side_m / board.square_m)  # of a square, beside its marker
    # cornerSubPix weighs less towards the window's edge: of 0.8 to 3.2 margins this is the best
    # (0.04 px rms; 0.09 with a smaller one, with a larger one 0.08 and errors of 0.5)
    found = _refined(image, corners, 1.2 * margin * nearest_px)
    return np.column_stack([found, numbers.ravel()])


# ---- where the boards were ----------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A camera with OpenCV's distortion.

    ``matrix`` (3, 3), px. ``distortion`` (k,): k1, k2, p1, p2, k3 … of a pinhole, four of a fisheye
    (``model`` equidistant, Kannala and Brandt 2006). ``model``: one of `MODELS`.
    ``size``: width and height of the images, px.
    ``covariance`` (4 + k, 4 + k) of fx, fy, cx, cy and the distortion; None where they are given
    and taken as exact.
    """

    matrix: Array
    distortion: Array
    size: tuple[int, int]
    covariance: Array | None = None
    model: str = "plumb_bob"


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


def see_boards(
    images: Sequence[tuple[str, Image]], board: Chessboard, intrinsics: Intrinsics | None = None,
    unread: dict[str, str] | None = None,
) -> SeenBoards:  # fmt: skip
    """Find the board in named images, and the intrinsics from the same images if none are given.

    ``unread``: name of each image that cannot be read, with the reason.
    """
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
            rejected[name] = f"no {board} in it"
        else:
            names.append(name)
            corners.append(found)
    return boards_of_corners(names, corners, board, size, intrinsics, rejected | (unread or {}))


def boards_of_corners(
    names: Sequence[str], corners: Sequence[Array], board: Chessboard, size: tuple[int, int],
    intrinsics: Intrinsics | None = None, rejected: dict[str, str] | None = None,
) -> SeenBoards:  # fmt: skip
    """The same from corners of each of m images, as `find_corners` gives them."""
    out = dict(rejected or {})
    kept, shown = list(names), list[tuple[Array, Array]]()
    for name, seen in zip(names, corners, strict=True):
        try:
            shown.append(board.seen(seen))
        except InputError as error:
            out[name] = str(error)
            kept.remove(name)
    _require(len(kept), intrinsics, out)
    found = _solve(tuple(kept), shown, size, intrinsics)
    gross = found.rms_px > GROSS_RATIO * np.median(found.rms_px)
    if np.any(gross):
        for i in np.flatnonzero(gross).tolist():
            out[kept[i]] = f"its corners miss a flat board by {found.rms_px[i]:.2f} px rms"
        rows = np.flatnonzero(~gross).tolist()
        _require(len(rows), intrinsics, out)
        found = _solve(tuple(kept[i] for i in rows), [shown[i] for i in rows], size, intrinsics)
    return replace(found, rejected=out)


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
    names: tuple[str, ...], shown: Sequence[tuple[Array, Array]], size: tuple[int, int],
    intrinsics: Intrinsics | None,
) -> SeenBoards:  # fmt: skip
    camera = intrinsics or _calibrate(shown, size)
    solve = _fisheye_pose if camera.model == "equidistant" else _pose
    try:
        T, misses, rows = zip(*(solve(*seen, camera) for seen in shown), strict=True)
        miss = np.concatenate(misses)
        with np.errstate(over="ignore"):
            squares = float(np.sum(miss**2)) if np.all(np.isfinite(T)) else np.inf
    except np.linalg.LinAlgError:
        squares = np.inf
    if not np.isfinite(squares):
        raise InputError("no pose of a board explains the corners with these intrinsics")
    unknowns = 6 * len(names) + (0 if intrinsics else rows[0].shape[1] - 6)
    noise = float(np.sqrt(squares / (len(miss) - unknowns)))
    alone = np.linalg.inv(np.array([J[:, :6].T @ J[:, :6] for J in rows]))
    sensitivity = -alone @ np.array([J[:, :6].T @ J[:, 6:] for J in rows])
    if intrinsics is None:
        rest = [J[:, 6:] + J[:, :6] @ own for J, own in zip(rows, sensitivity, strict=True)]
        camera = _with_covariance(camera, np.concatenate(rest), noise)
    return SeenBoards(
        names=names,
        T_camera_board=np.array(T),
        covariance=noise**2 * alone,
        shared=None if camera.covariance is None else Shared(sensitivity, camera.covariance),
        intrinsics=camera,
        noise_px=noise,
        rms_px=np.array([np.sqrt(np.mean(each**2) * 2.0) for each in misses]),
        rejected={},
    )


def _calibrate(shown: Sequence[tuple[Array, Array]], size: tuple[int, int]) -> Intrinsics:
    import cv2

    points = [own.astype(np.float32) for own, _ in shown]
    seen = [corners.astype(np.float32) for _, corners in shown]
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


def _pose(points: Array, corners: Array, camera: Intrinsics) -> tuple[Array, Array, Array]:
    """T_camera_board, misfit (2 n,), px, and its Jacobian (2 n, 6 + 4 + k).

    By the pose (position and turn along the camera's axes), then fx, fy, cx, cy, distortion.
    """
    import cv2

    K, d = camera.matrix, camera.distortion
    turn, place = _start(points, corners, K, d)
    turn, place = cv2.solvePnPRefineLM(points, corners, K, d, turn, place)
    seen, J = cv2.projectPoints(points, turn, place, K, d)
    return _posed(turn, place, seen, J[:, :3], J[:, 3:6], corners, J[:, 6:])


def _fisheye_pose(points: Array, corners: Array, camera: Intrinsics) -> tuple[Array, Array, Array]:
    """The same of a fisheye, whose intrinsics are exact: columns by the pose alone."""
    import cv2

    K, d = camera.matrix, camera.distortion
    flat = cv2.fisheye.undistortPoints(corners[None], K, d, P=K)[0]
    turn, place = (part.reshape(3) for part in _start(points, flat, K, np.zeros(4)))
    for _ in range(MOST_ROUNDS):
        seen, J = cv2.fisheye.projectPoints(points[None], turn, place, K, d)
        by_turn, by_place = J[:, 8:11], J[:, 11:14]  # after f, c and the distortion
        step, *_ = np.linalg.lstsq(
            np.hstack([by_turn, by_place]), corners.ravel() - seen.ravel(), rcond=None
        )
        turn, place = turn + step[:3], place + step[3:]
        if np.abs(step).max() < SETTLED:
            break
    seen, J = cv2.fisheye.projectPoints(points[None], turn, place, K, d)
    return _posed(turn, place, seen, J[:, 8:11], J[:, 11:14], corners, np.zeros((J.shape[0], 0)))


def _start(points: Array, corners: Array, K: Array, d: Array) -> tuple[Any, Any]:
    """The better of the two poses in which a flat board looks alike (Collins and Bartoli 2014)."""
    import cv2

    turns: Sequence[Any] = ()
    if np.all(np.isfinite(corners)):
        _, turns, places, _ = cv2.solvePnPGeneric(points, corners, K, d, flags=cv2.SOLVEPNP_IPPE)
    if not turns:
        raise InputError("no pose of a board explains the corners: they nearly coincide")
    return turns[0], places[0]


def _posed(
    turn: Any, place: Any, seen: Any, J_turn: Any, J_place: Any, corners: Array, J_camera: Any
) -> tuple[Array, Array, Array]:
    """A pose as `_pose` tells it, from rotation vector, place and OpenCV's Jacobians."""
    w = np.asarray(turn, dtype=np.float64).ravel()
    T = frames.transform(frames.exp_rotation(w), np.asarray(place, dtype=np.float64).ravel())
    rows = np.concatenate([J_place, J_turn @ frames.left_jacobian_inverse(w), J_camera], axis=1)
    return T, np.asarray(seen, dtype=np.float64).reshape(-1) - corners.ravel(), rows


# ---- boards that a camera saw, paired with the robot's poses ------------------------------------


def board_pairs(
    seen: SeenBoards, board: Chessboard, names: tuple[str, ...], T_base_flange: Array,
    mount: Mount, joints: ShotJoints | None = None, beside: PosePairs | None = None,
) -> PosePairs:  # fmt: skip
    """Pairs of the boards with the flange poses (m, 4, 4) of the samples ``names`` (m,).

    A board that looks alike from its other end is taken from one end in all samples, by the robot;
    ``beside``: from that of other pairs, of the same board.
    """
    row = {name: index for index, name in enumerate(names)}
    rows = np.array([row[name] for name in seen.names], dtype=np.int64)
    pairs = PosePairs(
        T_base_flange=T_base_flange[rows],
        T_camera_board=seen.T_camera_board,
        names=seen.names,
        mount=mount,
        covariance=seen.covariance,
        shared=seen.shared,
        joints=None if joints is None else joints.take(rows),
    )
    if board.markers is not None or (board.columns + board.rows) % 2:
        return pairs
    ends = 4 if board.columns == board.rows else 2
    R = frames.exp_rotation(np.outer(np.arange(ends) * 2.0 * np.pi / ends, [0.0, 0.0, 1.0]))
    middle = 0.5 * board.points[-1]
    return _turned(pairs, frames.transform(R, middle - R @ middle)[_ends(pairs, R, beside)])


def _turned(pairs: PosePairs, T_end: Array) -> PosePairs:
    """Pairs of the boards' other ends (m, 4, 4), with what is told of them."""
    J = np.tile(np.eye(6), (len(pairs), 1, 1))
    lever = pairs.T_camera_board[:, :3, :3] @ T_end[:, :3, 3, None]
    J[:, :3, 3:] = -frames.skew(lever[..., 0])
    covariance, shared = pairs.covariance, pairs.shared
    return replace(
        pairs,
        T_camera_board=pairs.T_camera_board @ T_end,
        covariance=None if covariance is None else J @ covariance @ J.swapaxes(1, 2),
        shared=None if shared is None else replace(shared, sensitivity=J @ shared.sensitivity),
    )


def _ends(pairs: PosePairs, R: Array, beside: PosePairs | None) -> NDArray[np.int64]:
    """From which end (m,) each board was seen, of turns R (ends, 3, 3); 0 where the robot is mute.

    From sample to sample a board turns by the robot's angle, wherever the camera sits.
    """
    told, ends = pairs if beside is None else beside, len(R)
    seen, there = pairs.T_camera_board[:, :3, :3], told.T_camera_board[:, :3, :3]
    robot, at = (each.T_boardside_cameraside[:, :3, :3] for each in (pairs, told))
    angles = np.array([_angles(np.einsum("iab,bc,jac->ij", seen, turn, there)) for turn in R])
    off = np.abs(angles - _angles(np.einsum("iab,jab->ij", robot, at)))
    off = np.minimum(off, CLEAR_RAD)  # a wrong pose is as wrong from any end
    each, every = np.arange(len(pairs))[:, None], np.arange(len(told))
    others = np.zeros(len(told), dtype=np.int64)
    if beside is None:
        off[:, every, every] = 0.0
        tries = []
        for first in (0, len(pairs) // 2, len(pairs) - 1):
            end = off[:, :, first].argmin(axis=0)
            for i in [*every, *every]:  # what the first pair left in doubt
                end[i] = off[(np.arange(ends)[:, None] - end) % ends, i, every].sum(1).argmin()
            tries.append((off[(end[:, None] - end) % ends, each, every].sum(), end))
        others = min(tries, key=lambda pair: float(pair[0]))[1]
    apart = (np.arange(ends)[:, None, None] - others) % ends
    usual = np.median(off[apart, each, every], axis=2)
    end, fits = usual.argmin(axis=0), usual.min(axis=0) < CLEAR_RAD
    if beside is None and np.any(fits):
        end = (end - np.bincount(end[fits]).argmax()) % ends
    return np.asarray(np.where(fits, end, 0), dtype=np.int64)


def _angles(trace: Array) -> Array:
    return np.asarray(np.arccos(np.clip(0.5 * (trace - 1.0), -1.0, 1.0)))


def intrinsics_document(seen: SeenBoards, from_images: bool) -> dict[str, Any]:
    """The camera of a result, px; ``from_images``: solved from the same images."""
    camera = seen.intrinsics
    return {
        "from_images": from_images,
        "fx_px": float(camera.matrix[0, 0]),
        "fy_px": float(camera.matrix[1, 1]),
        "cx_px": float(camera.matrix[0, 2]),
        "cy_px": float(camera.matrix[1, 2]),
        "distortion_model": camera.model,
        "distortion": camera.distortion.tolist(),
        "width_px": camera.size[0],
        "height_px": camera.size[1],
        "sigma": None
        if camera.covariance is None
        else [float(variance) ** 0.5 for variance in camera.covariance.diagonal()],
        "noise_px": seen.noise_px,
    }


# ---- intrinsics as ROS tells them: a YAML file, or a ``sensor_msgs/CameraInfo`` ------------------


MODELS = {"plumb_bob": (5, 4), "rational_polynomial": (8, 12, 14), "equidistant": (4,)}
"""Distortion models of ``sensor_msgs/distortion_models.hpp``, and how many coefficients each has
in OpenCV (docs: `calib3d`, `fisheye`); the first of them in a file."""
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
    coefficients = np.array(distortion.numbers("data", MODELS[model][0]))
    return Intrinsics(K, coefficients, (width, height), model=model)


def told_intrinsics(message: Any, rectified: bool) -> Intrinsics:
    """The camera that a ``sensor_msgs/CameraInfo`` tells, for images as they are published.

    Like image_geometry: K is of the whole sensor, a region of interest moves its principal point,
    binning then divides all of it. ``rectified``: of images that were rectified with this message,
    whose camera is P without distortion.

    Raises `InputError` when the camera is not calibrated, or by a model that OpenCV does not have.
    """
    K = np.array(message.p, dtype=np.float64).reshape(3, 4)[:, :3] if rectified else None
    if K is None:
        K = np.array(message.k, dtype=np.float64).reshape(3, 3)
    if not (np.all(np.isfinite(K)) and K[0, 0] > 0.0 and K[1, 1] > 0.0 and K[2, 2] == 1.0):
        name = "P" if rectified else "K"
        raise InputError(
            f"camera_info tells no focal length ({name} is {K.ravel().tolist()}): the camera is "
            "not calibrated; leave intrinsics out to find them from the images"
        )
    model, distortion = str(message.distortion_model), np.array(message.d, dtype=np.float64)
    none = not np.any(distortion) and (model in MODELS or not len(distortion))
    if rectified or (none and model != "equidistant"):  # a fisheye without them bends all the same
        model, distortion = "plumb_bob", np.zeros(5)
    if len(distortion) not in MODELS.get(model, ()) or not np.all(np.isfinite(distortion)):
        raise InputError(
            f"camera_info has {len(distortion)} coefficients of distortion model '{model}': known "
            f"are {', '.join(f'{name} ({one[0]})' for name, one in MODELS.items())}"
        )
    roi, step = message.roi, np.maximum([message.binning_x, message.binning_y], 1)
    whole = not (roi.width or roi.height or roi.x_offset or roi.y_offset)
    size = [message.width, message.height] if whole else [roi.width, roi.height]
    K[:2, 2] -= [roi.x_offset, roi.y_offset]
    K[:2] /= step[:, None]
    width, height = (int(side) for side in size // step)
    if not (0 < width <= MOST_PX and 0 < height <= MOST_PX):
        raise InputError(f"camera_info is of images of {width}x{height} px")
    return Intrinsics(K, distortion, (width, height), model=model)


def pixels_apart(first: Intrinsics, second: Intrinsics) -> float:
    """Largest distance, px, at which two cameras see one ray, over the first one's image.

    Infinite where their images have other sizes, or one of them does not see the ray.
    """
    import cv2

    if first.size != second.size:
        return float("inf")
    if (
        first.model == second.model
        and np.array_equal(first.matrix, second.matrix)
        and np.array_equal(first.distortion, second.distortion)
    ):
        return 0.0
    width, height = first.size
    x, y = np.meshgrid(np.linspace(0.0, width - 1.0, 9), np.linspace(0.0, height - 1.0, 7))
    corners = np.stack([x.ravel(), y.ravel()], axis=1)[None]
    if first.model == "equidistant":
        rays = cv2.fisheye.undistortPoints(corners, first.matrix, first.distortion)
    else:
        rays = cv2.undistortPoints(corners, first.matrix, first.distortion)
    rays = np.insert(np.asarray(rays, dtype=np.float64).reshape(-1, 2), 2, 1.0, axis=1)[None]
    nowhere, seen = np.zeros(3), []
    for camera in (first, second):
        project = cv2.fisheye.projectPoints if camera.model == "equidistant" else cv2.projectPoints
        pixels, _ = project(rays, nowhere, nowhere, camera.matrix, camera.distortion)
        seen.append(np.asarray(pixels).reshape(-1, 2))
    # Where a lens sees beyond what its model has, the ray that was found is another pixel's.
    shown = np.all((seen[0] > -1.0) & (seen[0] < [width, height]), axis=1)
    apart = float(np.max(np.linalg.norm(seen[1] - seen[0], axis=1)[shown], initial=-1.0))
    return apart if np.isfinite(apart) and apart >= 0.0 else float("inf")
