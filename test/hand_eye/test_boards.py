# SPDX-License-Identifier: Apache-2.0
"""ChArUco boards, fisheyes, compressed images, and intrinsics as ``camera_info`` tells them."""

import struct
import zlib
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from board_driver import (
    CHARUCO,
    CHARUCO_FILE,
    COLUMNS,
    LENS,
    ROWS,
    SQUARE_M,
    board_set,
    camera_info,
    compressed,
    image,
    marked_image,
)
from camera_pairs import BOARD, sound
from hand_eye_driver import namespace
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import RegionOfInterest

from bench.hand_eye_cell import BoardCell
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.boards import (
    Chessboard,
    Intrinsics,
    Markers,
    begins_dark,
    boards_of_corners,
    find_corners,
    header_size,
    message_image,
    pixels_apart,
    read_intrinsics,
    see_boards,
    told_intrinsics,
)
from robocal_ros.hand_eye.data import shot_of
from robocal_ros.hand_eye.targets import read_target, target_document, target_of

INTRINSICS = told_intrinsics(camera_info(), rectified=False)


NEAR = replace(LENS, fx=900.0, fy=903.0)  # the board fills the image, some of it lies beside
NEAR_INTRINSICS = Intrinsics(
    np.array([[NEAR.fx, 0.0, NEAR.cx], [0.0, NEAR.fy, NEAR.cy], [0.0, 0.0, 1.0]]),
    INTRINSICS.distortion,
    INTRINSICS.size,
)


def views(count: int, seed: int):
    cell, rng = BoardCell(), np.random.default_rng(seed)
    return cell.views(rng, count), rng


def behind_a_hand(seen, rng) -> list[tuple[str, np.ndarray]]:
    """Images of boards of which a third is hidden: from the left, or from above."""
    images = []
    for i in range(len(seen.t)):
        pixels = marked_image(seen.take(i), rng, NEAR)
        edge = int(np.quantile(NEAR.corners(seen.take(i), CHARUCO.points)[:, i % 2], 0.3))
        (pixels if i % 2 else pixels.T)[: max(edge, 0)] = 90
        images.append((str(i), pixels))
    return images


# ---- chessboards ---------------------------------------------------------------------------------


def test_both_of_opencvs_ways_to_find_a_board_begin_at_its_dark_end() -> None:
    """The one for blurred and glaring boards begins at the other end: half a turn of the board."""
    pixels = board_set(1).images[0]
    found, corners = cv2.findChessboardCornersSB(pixels, (COLUMNS, ROWS))
    assert found
    ours = find_corners(pixels, BOARD)
    assert ours is not None
    assert np.abs(corners.reshape(-1, 2)[::-1] - ours).max() < 1.0
    grid = np.asarray(corners, dtype=np.float64).reshape(ROWS, COLUMNS, 2)
    assert not begins_dark(pixels, grid)
    assert begins_dark(pixels, grid[::-1, ::-1])
    assert begins_dark(pixels, ours.reshape(ROWS, COLUMNS, 2))


# ---- ChArUco boards -----------------------------------------------------------------------------


def test_corners_of_a_marked_board_lie_where_they_are() -> None:
    """By the board's own points: OpenCV's numbers are those of our order."""
    seen, rng = views(6, 3)
    away = []
    for i in range(6):
        found = find_corners(marked_image(seen.take(i), rng, NEAR), CHARUCO)
        assert found is not None
        points, pixels = CHARUCO.seen(found)
        away.append(pixels - NEAR.corners(seen.take(i), points))
    assert sum(len(one) for one in away) > 200  # of 324
    # The noise alone: 3 of a contrast of 150, along edges of 5 px that are 0.9 px wide, tells a
    # corner to 0.02 px; the rest is OpenCV's.
    assert np.sqrt(np.mean(np.square(np.concatenate(away)))) < 0.1


def test_a_part_of_a_marked_board_is_enough() -> None:
    seen, rng = views(12, 4)
    result = see_boards(behind_a_hand(seen, rng), CHARUCO, NEAR_INTRINSICS)
    assert not result.rejected
    assert result.noise_px < 0.15
    away = np.linalg.norm((result.T_camera_board - seen.matrices())[:, :3, 3], axis=1)
    sigma = np.sqrt(np.trace(result.covariance[:, :3, :3], 0, 1, 2))
    # Errors of corners in one image are alike (blur, light): not independent as sigma has them,
    # which is why a calibration scales it by what the robot shows.
    assert np.all(away < 6.0 * sigma)
    assert away.max() < 1e-3


def test_intrinsics_come_from_parts_of_a_marked_board_too() -> None:
    seen, rng = views(12, 5)
    found = see_boards(behind_a_hand(seen, rng), CHARUCO).intrinsics
    sigma = np.sqrt(np.diag(found.covariance))
    away = (found.matrix - NEAR_INTRINSICS.matrix)[[0, 1, 0, 1], [0, 1, 2, 2]]
    assert np.all(np.abs(away) < 6.0 * sigma[:4])
    assert sigma[0] < 0.01 * NEAR.fx


def test_another_board_shows_no_corners() -> None:
    seen, rng = views(1, 6)
    pixels = marked_image(seen.take(0), rng)
    other = Chessboard(COLUMNS, ROWS, SQUARE_M, Markers("6X6_250", 0.019))
    assert find_corners(pixels, other) is None
    plain = LENS.image(seen.take(0), COLUMNS, ROWS, SQUARE_M)
    assert find_corners(plain, CHARUCO) is None
    with pytest.raises(
        TooFewSamplesError, match=r"0 images.*no ChArUco board of 10x7 squares \(4X4_50\)"
    ):
        see_boards([("a", plain)], CHARUCO)


def test_corners_that_are_not_of_the_board_are_refused() -> None:
    whole = np.column_stack([LENS.corners(views(1, 7)[0].take(0), CHARUCO.points), np.arange(54)])
    for wrong, words in (
        (whole[:5], "5 corners .* are too few"),
        (whole[:9], "two of them beside any one row"),
        (whole[[*range(9), 9]], "two of them beside any one row"),
        (whole[:0], "0 corners .* are too few"),
        (whole[[0, 0, 1, 9, 10, 11]], "not numbered"),
        (whole + np.array([0, 0, 1]), "not numbered"),
        (whole + np.array([0, 0, 0.5]), "not numbered"),
        (whole[:, :2], "not numbered"),
    ):
        with pytest.raises(InputError, match=words):
            CHARUCO.seen(wrong)
    with pytest.raises(InputError, match="do not fit"):
        Chessboard(9, 6, 0.02, Markers("4X4_50", 0.02))
    with pytest.raises(InputError, match="no dictionary"):
        Markers("9X9_100", 0.02)
    with pytest.raises(InputError, match="has 60 markers, of which 4X4_50 has 50 only"):
        Chessboard(11, 9, 0.02, Markers("4X4_50", 0.015))
    Chessboard(11, 9, 0.02, Markers("APRILTAG_36h11", 0.015))


def test_one_image_of_a_line_of_corners_spoils_no_set() -> None:
    """No homography is told by eight corners in a line and one beside it."""
    seen, rng = views(8, 7)
    whole = []
    for i in range(8):
        pixels = NEAR.corners(seen.take(i), CHARUCO.points) + 0.1 * rng.standard_normal((54, 2))
        whole.append(np.column_stack([pixels, np.arange(54)]))
    for camera in (NEAR_INTRINSICS, None):
        names = [str(i) for i in range(8)]
        corners = [*whole[:7], whole[7][:10]]
        found = boards_of_corners(names, corners, CHARUCO, NEAR_INTRINSICS.size, camera)
        assert list(found.rejected) == ["7"]


def test_an_opencv_without_marked_boards_says_so(monkeypatch) -> None:
    """As 4.6 of the stock machine, whose main modules have no ``aruco``."""
    monkeypatch.delattr(cv2.aruco, "CharucoDetector")
    with pytest.raises(InputError, match=r"cannot look for ChArUco boards: install 4\.7"):
        find_corners(np.zeros((480, 640), np.uint8), CHARUCO)


def test_the_file_of_a_marked_board(tmp_path) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(CHARUCO_FILE + "legacy: true\nintrinsics: camera_info\nrectified: true\n")
    target = read_target(path)
    board = target.board
    assert (board.columns, board.rows, board.square_m) == (COLUMNS, ROWS, SQUARE_M)
    assert (board.markers.dictionary, board.markers.legacy) == ("4X4_50", True)
    assert board.markers.side_m == pytest.approx(0.019, rel=1e-12)
    assert (target.camera_info, target.rectified, target.intrinsics) == (True, True, None)
    given = target.with_intrinsics(INTRINSICS)
    again = target_of(target_document("camera", given))
    assert (again.board, again.intrinsics.model) == (target.board, "plumb_bob")
    assert np.array_equal(again.intrinsics.matrix, INTRINSICS.matrix)
    for text, words in (
        (CHARUCO_FILE.replace("19", "26"), "do not fit"),
        (CHARUCO_FILE.replace("4X4_50", "4X4_51"), "dictionary is '4X4_51'"),
        (CHARUCO_FILE.replace("[10, 7]", "[10.5, 7]"), "whole number"),
        (CHARUCO_FILE + "rectified: true\n", "belongs to 'intrinsics: camera_info'"),
        (CHARUCO_FILE + "legacy: 1\n", "true or false"),
    ):
        path.write_text(text)
        with pytest.raises(InputError, match=words):
            read_target(path)


# ---- fisheyes -----------------------------------------------------------------------------------


FISHEYE = Intrinsics(
    np.array([[330.0, 0.0, 318.0], [0.0, 331.0, 242.0], [0.0, 0.0, 1.0]]),
    np.array([0.02, -0.01, 0.003, -0.001]),
    (640, 480),
    model="equidistant",
)


def fisheye_pixels(seen, points: np.ndarray) -> np.ndarray:
    """Kannala and Brandt 2006, as REP-less ROS calls equidistant: r = f (t + k1 t^3 + …)."""
    x, y, z = (seen.R.apply(points) + seen.t).T
    r = np.hypot(x, y)
    t = np.arctan2(r, z)
    bent = t * (1.0 + sum(k * t ** (2 * i) for i, k in enumerate(FISHEYE.distortion, 1)))
    K = FISHEYE.matrix
    return np.column_stack([K[0, 0] * bent * x / r + K[0, 2], K[1, 1] * bent * y / r + K[1, 2]])


def test_boards_before_a_fisheye_are_within_their_sigma() -> None:
    seen, rng = views(30, 8)
    corners = [fisheye_pixels(seen.take(i), BOARD.points) for i in range(30)]
    exact = boards_of_corners(["0"], corners[:1], BOARD, FISHEYE.size, FISHEYE)
    assert np.allclose(exact.T_camera_board[0], seen.take(0).matrices(), atol=1e-9)
    noisy = [one + 0.2 * rng.standard_normal(one.shape) for one in corners]
    names = [str(i) for i in range(30)]
    result = boards_of_corners(names, noisy, BOARD, FISHEYE.size, FISHEYE)
    assert result.noise_px == pytest.approx(0.2, rel=0.05)  # of 3240 coordinates: 1.2 %
    truth, total = seen.matrices(), 0.0
    for T, true, C in zip(result.T_camera_board, truth, result.covariance, strict=True):
        turn = Rotation.from_matrix(T[:3, :3] @ true[:3, :3].T).as_rotvec()
        e = np.concatenate([T[:3, 3] - true[:3, 3], turn])
        total += float(e @ np.linalg.solve(C, e))
    assert sound(total, 6 * 30)


def test_a_file_of_a_fisheye(tmp_path) -> None:
    path = tmp_path / "camera.yaml"
    K = FISHEYE.matrix.ravel().tolist()
    path.write_text(
        f"image_width: 640\nimage_height: 480\ncamera_matrix: {{rows: 3, cols: 3, data: {K}}}\n"
        "distortion_model: equidistant\n"
        f"distortion_coefficients: {{rows: 1, cols: 4, data: {FISHEYE.distortion.tolist()}}}\n"
    )
    assert pixels_apart(read_intrinsics(path), FISHEYE) == 0.0


@pytest.mark.parametrize("model", ["plumb_bob", "equidistant"])
def test_intrinsics_that_explain_nothing_give_no_pose(model: str) -> None:
    seen, _ = views(1, 9)
    wild = Intrinsics(np.diag([1e300, 1e300, 1.0]), np.zeros(4), FISHEYE.size, model=model)
    with pytest.raises(InputError, match="no pose of a board explains the corners"):
        boards_of_corners(["0"], [fisheye_pixels(seen, BOARD.points)], BOARD, FISHEYE.size, wild)


# ---- camera_info --------------------------------------------------------------------------------


def test_a_region_and_binning_change_the_camera_as_image_geometry_has_it() -> None:
    """A point that the whole sensor shows at u is at (u - x) / b of a part of it."""
    roi = RegionOfInterest(x_offset=100, y_offset=40, width=400, height=320)
    part = told_intrinsics(camera_info(roi=roi, binning_x=2, binning_y=4), rectified=False)
    assert part.size == (200, 80)
    points = np.array([[0.05, 0.02, 0.5], [-0.04, 0.03, 0.6]])
    nowhere = np.zeros(3)
    whole = cv2.projectPoints(points, nowhere, nowhere, INTRINSICS.matrix, INTRINSICS.distortion)
    cut = cv2.projectPoints(points, nowhere, nowhere, part.matrix, part.distortion)
    expected = (whole[0].reshape(-1, 2) - [100, 40]) / [2, 4]
    assert np.allclose(cut[0].reshape(-1, 2), expected, atol=1e-9)


def test_rectified_images_have_the_projection_without_distortion() -> None:
    camera = told_intrinsics(camera_info(), rectified=True)
    assert camera.matrix[0].tolist() == [580.0, 0.0, 320.0]
    assert not np.any(camera.distortion)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"k": [0.0] * 9}, "is not calibrated"),
        ({"k": [float("nan")] * 9}, "is not calibrated"),
        ({"distortion_model": "fov", "d": [0.9]}, "1 coefficients of distortion model 'fov'"),
        ({"d": [0.1] * 3}, "3 coefficients of distortion model 'plumb_bob'"),
        ({"distortion_model": "fov", "d": [0.0]}, "1 coefficients of distortion model 'fov'"),
        ({"distortion_model": "equidistant", "d": []}, "0 coefficients"),
        ({"width": 0}, "0x480 px"),
    ],
)
def test_a_camera_that_is_not_told_is_refused(changed: dict, words: str) -> None:
    with pytest.raises(InputError, match=words):
        told_intrinsics(camera_info(**changed), rectified=False)


def test_models_of_a_topic() -> None:
    """Four and five coefficients of plumb_bob; eight; a fisheye, an ideal one too; none at all."""
    for model, d, length in (
        ("plumb_bob", [0.1] * 4, 4),
        ("rational_polynomial", [0.1] * 8, 8),
        ("equidistant", [0.1] * 4, 4),
        ("equidistant", [0.0] * 4, 4),
        ("", [], 5),
    ):
        found = told_intrinsics(camera_info(distortion_model=model, d=d), rectified=False)
        assert (len(found.distortion), found.model) == (length, model or "plumb_bob")


def test_how_far_two_cameras_see_a_ray_apart() -> None:
    assert pixels_apart(INTRINSICS, INTRINSICS) == 0.0
    moved = INTRINSICS.matrix.copy()
    moved[0, 2] += 2.0
    other = Intrinsics(moved, INTRINSICS.distortion, INTRINSICS.size)
    assert pixels_apart(INTRINSICS, other) == pytest.approx(2.0, abs=1e-2)  # OpenCV iterates
    wide = Intrinsics(FISHEYE.matrix, FISHEYE.distortion, (640, 480), model="equidistant")
    assert pixels_apart(FISHEYE, wide) == 0.0
    assert pixels_apart(INTRINSICS, FISHEYE) > 50.0
    assert pixels_apart(INTRINSICS, Intrinsics(moved, moved[0], (320, 240))) == np.inf
    # Of half a sphere: the corners of its image are dark.
    round_K = np.array([[330.0, 0.0, 640.0], [0.0, 330.0, 480.0], [0.0, 0.0, 1.0]])
    whole = Intrinsics(round_K, FISHEYE.distortion, (1280, 960), model="equidistant")
    moved = round_K.copy()
    moved[0, 2] += 0.2
    aside = replace(whole, matrix=moved)
    assert pixels_apart(whole, aside) == pytest.approx(0.2, abs=1e-6)


# ---- compressed images --------------------------------------------------------------------------


def test_a_compressed_image_is_the_image() -> None:
    pixels = board_set().images[0]
    raw = shot_of("image", namespace(image(1, pixels).fields))
    png = shot_of("image/compressed", namespace(compressed(1, pixels, ".png", "png").fields))
    assert (png.topic, png.size) == ("image", len(png.message.data))
    assert np.array_equal(png.read(), raw.read())
    colours = np.repeat(pixels[:, :, None], 3, axis=2)
    jpeg = namespace(compressed(1, colours, ".jpg", "rgb8; jpeg compressed bgr8").fields)
    corners, lossy = (find_corners(one, BOARD) for one in (pixels, message_image(jpeg)))
    assert np.abs(lossy - corners).max() < 0.1  # of OpenCV's default quality, 95


@pytest.mark.parametrize(
    "told", ["16UC1; png compressed ", "mono16; jpeg compressed ", "bayer_rggb8; png compressed ",
             "32FC1; compressedDepth png"],
)  # fmt: skip
def test_what_is_no_picture_of_8_bits_is_refused(told: str) -> None:
    message = SimpleNamespace(format=told, data=b"")
    with pytest.raises(InputError, match="are not read: have the camera publish 8 bits"):
        message_image(message)


def test_a_compressed_image_that_was_cut_is_refused() -> None:
    with pytest.raises(InputError, match="is no image that can be read"):
        message_image(SimpleNamespace(format="jpeg", data=b"\xff\xd8\xff"))


@settings(max_examples=30, deadline=None)
@given(
    st.integers(1, 3000),
    st.integers(1, 40),
    st.sampled_from(
        [(".png", []), (".jpg", []), (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
         (".jpg", [cv2.IMWRITE_JPEG_RST_INTERVAL, 3, cv2.IMWRITE_JPEG_OPTIMIZE, 1])]
    ),
    st.binary(max_size=40),
)  # fmt: skip
def test_a_header_tells_the_size(width: int, height: int, how: tuple, remark: bytes) -> None:
    suffix, options = how
    data = cv2.imencode(suffix, np.zeros((height, width), np.uint8), options)[1].tobytes()
    assert header_size(data) == (width, height)
    if suffix == ".jpg":  # with a comment, as cameras write Exif there, and a fill byte
        comment = b"\xff\xff\xfe" + (len(remark) + 2).to_bytes(2) + remark
        assert header_size(data[:2] + comment + data[2:]) == (width, height)
    assert header_size(data[:12]) == (0, 0)


@pytest.mark.parametrize("suffix", [".png", ".jpg"])
def test_an_image_that_says_it_is_huge_is_refused_before_it_is_decoded(suffix: str) -> None:
    """Of a few bytes, whose header tells more pixels than are read."""
    small = bytearray(cv2.imencode(suffix, np.zeros((2, 2), np.uint8))[1].tobytes())
    if suffix == ".png":
        small[16:24] = struct.pack(">II", 10_000, 10_001)
        small[29:33] = struct.pack(">I", zlib.crc32(small[12:29]))
    else:
        begin = small.index(b"\xff\xc0")
        small[begin + 5 : begin + 9] = struct.pack(">HH", 10_001, 10_000)
    with pytest.raises(InputError, match="has 10000x10001 px: 100000000 at most are read"):
        message_image(SimpleNamespace(format=suffix[1:], data=bytes(small)))
