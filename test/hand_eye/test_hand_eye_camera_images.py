# SPDX-License-Identifier: Apache-2.0
"""A camera from corners and from images of its board."""

from itertools import product

import numpy as np
import pytest
from camera_pairs import BOARD, LENS, error, sound
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.hand_eye_cell import BoardCell, BoardNoise, TrueLens, TruePose
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.hand_eye.boards import (
    Chessboard,
    Intrinsics,
    board_pairs,
    boards_of_corners,
    decode_image,
    find_corners,
    see_boards,
)
from robocal_ros.hand_eye.camera import CameraSettings, CheckPairs, calibrate_camera
from robocal_ros.hand_eye.camera_data import PosePairs
from robocal_ros.hand_eye.camera_fit import GivenNoise, fit_pairs


def pixels(cell: BoardCell, count: int, seed: int, noise_px: float = 0.2):
    rng = np.random.default_rng(seed)
    views = cell.views(rng, count)
    corners = np.array([LENS.corners(views.take(i), BOARD.points) for i in range(count)])
    robot = cell.read_robot(cell.flange(views), rng)
    return robot, corners + noise_px * rng.standard_normal(corners.shape)


def true_intrinsics() -> Intrinsics:
    K = np.array([[LENS.fx, 0.0, LENS.cx], [0.0, LENS.fy, LENS.cy], [0.0, 0.0, 1.0]])
    return Intrinsics(K, np.array([LENS.k1, LENS.k2, 0.0, 0.0, 0.0]), (640, 480))


@pytest.mark.parametrize("given", [True, False])
def test_from_corners_the_covariance_holds(given: bool) -> None:
    """Errors of intrinsics from the same images are common to all poses, and counted."""
    cell = BoardCell(noise=BoardNoise(1e-4, 2e-4))
    runs, total = 40, 0.0
    for seed in range(runs):
        robot, corners = pixels(cell, 12, 500 + seed)
        names = [str(i) for i in range(12)]
        camera = true_intrinsics() if given else None
        seen = boards_of_corners(names, corners, BOARD, (640, 480), camera)
        assert seen.noise_px == pytest.approx(0.2, rel=0.15)
        pairs = PosePairs(
            robot, seen.T_camera_board, seen.names, "in-hand", seen.covariance, seen.shared
        )
        fit = fit_pairs(pairs, GivenNoise(1e-4, 2e-4, camera_scale=1.0))
        e = error(fit.at.X, cell.camera)
        total += float(e @ np.linalg.solve(fit.covariance[:6, :6], e))
    assert sound(total, 6 * runs)


def test_intrinsics_and_their_sigma_from_corners() -> None:
    truth = true_intrinsics()
    _, corners = pixels(BoardCell(), 15, 20)
    seen = boards_of_corners([str(i) for i in range(15)], corners, BOARD, (640, 480))
    found = seen.intrinsics
    assert found.covariance is not None
    K, T = found.matrix, truth.matrix
    e = np.array([K[0, 0] - T[0, 0], K[1, 1] - T[1, 1], K[0, 2] - T[0, 2], K[1, 2] - T[1, 2]])
    e = np.concatenate([e, found.distortion - truth.distortion])
    assert sound(float(e @ np.linalg.solve(found.covariance, e)), 9)


def test_no_size_of_an_image_is_a_fault() -> None:
    rng = np.random.default_rng(0)
    sides = (1, 2, 3, 9, 16, 31, 32, 33, 100)
    for shape in product(sides, sides):
        assert find_corners(rng.integers(0, 256, shape, dtype=np.uint8), BOARD) is None


@pytest.mark.parametrize("given", [True, False])
def test_corners_that_are_none_are_refused(given: bool) -> None:
    _, corners = pixels(BoardCell(), 12, 20)
    names = [str(i) for i in range(12)]
    wrong = {"in one place": 0.0 * corners, "nearly so": 1e-12 * corners}
    wrong["in one line"] = corners * [1.0, 0.0]
    camera = true_intrinsics() if given else None
    for what, these in wrong.items():
        try:
            seen = boards_of_corners(names, these, BOARD, (640, 480), camera)
        except (InputError, RankDeficientError):
            continue
        assert seen.noise_px > 1.0, what  # it is seen later, by what it misses
        assert np.all(np.isfinite(seen.covariance))


def test_intrinsics_come_again_to_the_last_bit() -> None:
    import cv2

    _, corners = pixels(BoardCell(), 12, 20)
    names, threads = [str(i) for i in range(12)], cv2.getNumThreads()
    first, *others = (boards_of_corners(names, corners, BOARD, (640, 480)) for _ in range(12))
    for other in others:
        assert np.array_equal(other.intrinsics.matrix, first.intrinsics.matrix)
        assert np.array_equal(other.T_camera_board, first.T_camera_board)
        assert np.array_equal(other.covariance, first.covariance)
    assert cv2.getNumThreads() == threads


def test_an_image_of_something_else_is_left_out() -> None:
    _, corners = pixels(BoardCell(), 12, 21)
    corners[4] += np.random.default_rng(0).standard_normal(corners[4].shape) * 3.0
    seen = boards_of_corners([f"i{k}" for k in range(12)], corners, BOARD, (640, 480))
    assert list(seen.rejected) == ["i4"]
    assert "miss a flat board" in seen.rejected["i4"]
    assert len(seen.names) == 11


def test_boards_that_all_lie_flat_do_not_show_the_focal_length() -> None:
    cell = BoardCell()
    rng = np.random.default_rng(22)
    views = cell.views(rng, 8, tilt_rad=0.005)
    corners = np.array([LENS.corners(views.take(i), BOARD.points) for i in range(8)])
    corners += 0.2 * rng.standard_normal(corners.shape)
    with pytest.raises(RankDeficientError, match="tilt the board"):
        boards_of_corners([str(i) for i in range(8)], corners, BOARD, (640, 480))


@pytest.fixture(scope="module")
def images():
    cell = BoardCell(noise=BoardNoise(1e-4, 2e-4))
    rng = np.random.default_rng(23)
    views = cell.views(rng, 9)
    named = [
        (f"i{k}", LENS.image(views.take(k), BOARD.columns, BOARD.rows, BOARD.square_m))
        for k in range(9)
    ]
    return cell, cell.read_robot(cell.flange(views), rng), views.matrices(), named


@pytest.mark.parametrize("mount", ["in-hand", "to-hand"])
@pytest.mark.parametrize("counts", [(8, 6), (6, 6)])
def test_a_board_that_looks_alike_from_its_ends_is_taken_from_one(mount, counts) -> None:
    """Finding: half of the samples, from a camera that rolls by over a right angle, were off."""
    board = Chessboard(*counts, BOARD.square_m)
    cell, rng = BoardCell(mount, noise=BoardNoise(1e-4, 2e-4)), np.random.default_rng(29)
    tilts, rolls = rng.uniform(-0.4, 0.4, (14, 2)), np.linspace(-3.1, 3.1, 14)
    turn = Rotation.from_rotvec([[0.0, 0.0, roll] for roll in rolls]) * Rotation.from_rotvec(
        np.column_stack([tilts, np.zeros(14)])
    )
    middle = rng.uniform([-0.02, -0.02, 0.45], [0.02, 0.02, 0.6], (14, 3))
    views = TruePose(turn, middle - turn.apply(0.5 * board.points[-1]))
    images = [(f"i{k}", LENS.image(views.take(k), *counts, board.square_m)) for k in range(14)]
    robot, names = cell.read_robot(cell.flange(views), rng), tuple(name for name, _ in images)
    seen = see_boards(images, board, true_intrinsics())
    assert len(seen.names) == 14
    away = np.linalg.norm(seen.T_camera_board - views.matrices(), axis=(1, 2))
    assert np.any(away > 0.1)  # as OpenCV begins where it is up in the image
    pairs = board_pairs(seen, board, names, robot, cell.mount)
    found = calibrate_camera(pairs)
    assert found.verdict.accept
    assert not found.rejected
    e = error(found.T_flange_sensor, cell.camera)
    assert found.covariance is not None
    assert sound(float(e @ np.linalg.solve(found.covariance, e)), 6)


def seen_from(board: Chessboard, end: int, corners):
    """The same corners (n, 2), numbered from another end: by quarter turns."""
    grid = corners.reshape(board.rows, board.columns, 2)
    return np.rot90(grid, end).reshape(-1, 2)


def from_ends(board: Chessboard, mount: str, count: int = 12):
    """Flange poses, names, and corners of each sample, in order."""
    cell, rng = BoardCell(mount, noise=BoardNoise(1e-4, 2e-4)), np.random.default_rng(31)
    views = cell.views(rng, count)
    robot, names = cell.read_robot(cell.flange(views), rng), tuple(f"i{k}" for k in range(count))
    corners = [LENS.corners(views.take(k), board.points) for k in range(count)]
    return robot, names, [each + 0.2 * rng.standard_normal(each.shape) for each in corners]


@pytest.mark.parametrize("mount", ["in-hand", "to-hand"])
@pytest.mark.parametrize("counts", [(8, 6), (7, 7)])
@pytest.mark.parametrize("given", [True, False])
def test_what_is_told_of_a_board_is_of_the_end_that_it_is_taken_from(mount, counts, given) -> None:
    board, camera = Chessboard(*counts, BOARD.square_m), true_intrinsics() if given else None
    robot, names, corners = from_ends(board, mount)
    ends = [2 * (k % 3 == 1) if counts == (8, 6) else (k % 3) * (k % 2) for k in range(12)]
    turned = [seen_from(board, end, each) for end, each in zip(ends, corners, strict=True)]
    one, other = (
        board_pairs(
            boards_of_corners(names, shown, board, (640, 480), camera), board, names, robot, mount
        )
        for shown in (corners, turned)
    )
    assert other.T_camera_board == pytest.approx(one.T_camera_board, abs=1e-6)
    assert one.covariance is not None
    assert other.covariance == pytest.approx(one.covariance, rel=1e-3, abs=1e-12)
    if camera is None:
        assert one.shared is not None
        shared = one.shared.sensitivity
        away = np.abs(other.shared.sensitivity - shared).max(axis=(0, 1))
        assert np.all(away < 1e-3 * np.abs(shared).max(axis=(0, 1)))


@pytest.mark.parametrize("counts", [(8, 6), (7, 7)])
def test_samples_that_judge_are_taken_from_the_end_of_those_that_solved(counts) -> None:
    """Finding: by themselves they took their own, half a board away."""
    board, camera = Chessboard(*counts, BOARD.square_m), true_intrinsics()
    robot, names, corners = from_ends(board, "in-hand")
    used = boards_of_corners(names[:9], corners[:9], board, (640, 480), camera)
    pairs = board_pairs(used, board, names, robot, "in-hand")
    turned = [seen_from(board, 2, each) for each in corners[9:]]
    kept, check = (
        board_pairs(
            boards_of_corners(names[9:], shown, board, (640, 480), camera),
            board, names, robot, "in-hand", beside=pairs,
        )
        for shown in (corners[9:], turned)
    )  # fmt: skip
    assert check.T_camera_board == pytest.approx(kept.T_camera_board, abs=1e-6)
    alone = board_pairs(
        boards_of_corners(names[9:], turned, board, (640, 480), camera),
        board, names, robot, "in-hand",
    )  # fmt: skip
    assert calibrate_camera(pairs, check=CheckPairs(check)).verdict.accept
    assert not calibrate_camera(pairs, check=CheckPairs(alone)).verdict.accept


def test_wrong_poses_of_the_robot_turn_no_board() -> None:
    """Finding: of two that were swapped both were turned, and not called swapped any more."""
    board, camera = Chessboard(8, 6, BOARD.square_m), true_intrinsics()
    cell, rng = BoardCell(noise=BoardNoise(1e-4, 2e-4)), np.random.default_rng(37)
    rolls = np.radians([-80.0, 80.0, -60.0, -30.0, 0.0, 30.0, 60.0, 15.0, -15.0, 45.0])
    turn = Rotation.from_rotvec([[0.0, 0.0, roll] for roll in rolls]) * Rotation.from_rotvec(
        np.column_stack([rng.uniform(-0.3, 0.3, (10, 2)), np.zeros(10)])
    )
    views = TruePose(turn, np.array([0.0, 0.0, 0.5]) - turn.apply(0.5 * board.points[-1]))
    robot, names = cell.read_robot(cell.flange(views), rng), tuple(f"i{k}" for k in range(10))
    corners = [LENS.corners(views.take(k), board.points) for k in range(10)]
    seen = boards_of_corners(names, corners, board, (640, 480), camera)
    swapped = robot[[1, 0, *range(2, 10)]]
    pairs = board_pairs(seen, board, names, swapped, "in-hand")
    assert np.array_equal(pairs.T_camera_board, seen.T_camera_board)
    found = calibrate_camera(pairs)
    assert "swapped" in found.rejected["i0"]
    # One board from the other end, and a robot pose that is wrong beside it: it alone is turned.
    corners[0] = seen_from(board, 2, corners[0])
    seen = boards_of_corners(names, corners, board, (640, 480), camera)
    wrong = robot.copy()
    wrong[5, :3, :3] = wrong[5, :3, :3] @ Rotation.from_rotvec([0.0, 0.7, 0.0]).as_matrix()
    pairs = board_pairs(seen, board, names, wrong, "in-hand")
    away = np.linalg.norm(pairs.T_camera_board - seen.T_camera_board, axis=(1, 2)) > 0.1
    assert away.tolist() == [True, *[False] * 9]


def test_images_give_the_camera(images) -> None:
    cell, robot, _, named = images
    blank = np.full((480, 640), 90, dtype=np.uint8)
    others = [("dark", blank), ("small", blank[:100])]
    seen = see_boards([*named, *others], BOARD)
    assert set(seen.rejected) == {"dark", "small"}
    assert "no board of 9x6" in seen.rejected["dark"]
    assert "640x480" in seen.rejected["small"]
    assert len(seen.names) == 9
    assert seen.noise_px < 0.1
    pairs = PosePairs(
        robot, seen.T_camera_board, seen.names, "in-hand", seen.covariance, seen.shared
    )
    found = calibrate_camera(pairs, CameraSettings(noise=GivenNoise(1e-4, 2e-4)))
    assert found.covariance is not None
    e = error(found.T_flange_sensor, cell.camera)
    assert e @ np.linalg.solve(found.covariance, e) < chi2.ppf(0.9999, 6)


def test_images_with_known_intrinsics_give_the_boards(images) -> None:
    _, _, views, named = images
    seen = see_boards(named[:4], BOARD, true_intrinsics())
    assert seen.shared is None
    away = np.linalg.norm((seen.T_camera_board - views[:4])[:, :3, 3], axis=1)
    assert away.max() < 4.0 * np.sqrt(np.trace(seen.covariance[:, :3, :3], 0, 1, 2).max()) + 1e-4


def test_images_without_a_board_are_too_few(images) -> None:
    blank = np.full((480, 640), 90, dtype=np.uint8)
    with pytest.raises(TooFewSamplesError, match=r"0 images show the board.*dark: no board"):
        see_boards([("dark", blank)], BOARD)
    with pytest.raises(TooFewSamplesError, match="or give the intrinsics"):
        see_boards(images[3][:3], BOARD)


def test_what_is_no_image_or_no_board_is_refused() -> None:
    for data in (b"", b"nothing"):
        with pytest.raises(InputError, match="no image"):
            decode_image(data, "x.png")
    with pytest.raises(InputError, match="shows no pose"):
        Chessboard(9, 1, 0.025)


def test_a_lens_that_cannot_be_undone_makes_no_image() -> None:
    cell = BoardCell()
    view = cell.views(np.random.default_rng(0), 1)
    with pytest.raises(ValueError, match="cannot be undone"):
        TrueLens(k1=-3.0).image(view, BOARD.columns, BOARD.rows, BOARD.square_m)
