# SPDX-License-Identifier: Apache-2.0
"""Hand-eye of a camera: truth by the simulated cell, recovered; its noise and its covariance."""

from dataclasses import replace

import numpy as np
import pytest
from camera_pairs import EXACT, KNOWN, MOUNTS, error, measured, sound
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.hand_eye_cell import BoardCell, BoardNoise, TruePose
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ResidualError
from robocal_ros.hand_eye.camera import CameraSettings, CheckPairs, calibrate_camera
from robocal_ros.hand_eye.camera_data import (
    CLOSED_FORMS,
    Placement,
    PosePairs,
    Shared,
    closed_form,
    closed_form_of_all,
)
from robocal_ros.hand_eye.camera_fit import (
    Evidence,
    GivenNoise,
    PairNoise,
    PairState,
    Parts,
    estimate,
    fit_pairs,
    linearised,
    robust_start,
)
from robocal_ros.hand_eye.camera_kernels import weigh
from robocal_ros.hand_eye.mount_problem import moved


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("method", ["best", *CLOSED_FORMS])
def test_exact_poses_give_the_camera(mount: str, method: str) -> None:
    cell, pairs = measured(10, 1, mount, EXACT)
    found = calibrate_camera(pairs, CameraSettings(method))
    assert np.abs(error(found.T_flange_sensor, cell.camera)).max() < 1e-8
    assert found.parent == ("flange" if mount == "in-hand" else "base")
    assert found.residual_m.max() < 1e-8
    assert found.verdict.code is Code.ACCEPT


@pytest.mark.parametrize("name", CLOSED_FORMS)
@pytest.mark.parametrize("mount", MOUNTS)
def test_closed_forms_give_both_placements(name: str, mount: str) -> None:
    cell, pairs = measured(10, 2, mount, EXACT)
    at = closed_form(name, pairs)
    assert at is not None
    assert np.abs(error(at.X, cell.camera)).max() < 1e-6
    assert np.abs(error(at.Z, cell.board)).max() < 1e-6


def test_a_closed_form_that_fails_says_so() -> None:
    _, pairs = measured(3, 2)
    assert closed_form("tsai", pairs.take(np.array([0]))) is None


def test_a_start_that_fails_is_refused() -> None:
    """Tsai's method wants turns of more than 15 deg; these are 3 deg from each other."""
    rng = np.random.default_rng(1)
    cell = BoardCell()
    views = cell.views(rng, 12)
    views = TruePose(Rotation.from_rotvec(0.1 * views.R.as_rotvec()), views.t)
    robot, board = cell.read_robot(cell.flange(views), rng), cell.read_board(views, rng)
    pairs = PosePairs(robot, board, tuple(map(str, range(12))))
    with pytest.raises(ResidualError, match="tsai does not solve these pairs: use method best"):
        calibrate_camera(pairs, CameraSettings("tsai"))
    assert calibrate_camera(pairs).more["closed_forms_mean_mm"]["tsai"] is None


@pytest.mark.parametrize("name", CLOSED_FORMS)
def test_a_closed_form_takes_a_hundred_of_many(name: str) -> None:
    """From the first sample to the last; what it skips may be anything."""
    _, pairs = measured(298, 2)
    T = pairs.T_camera_board.copy()
    skipped = np.arange(298) % 3 != 0
    T[skipped, :3, 3] += 1.0
    at = closed_form(name, replace(pairs, T_camera_board=T))
    clean = closed_form_of_all(name, pairs.take(~skipped))
    assert at is not None
    assert clean is not None
    assert np.array_equal(at.X, clean.X)
    assert np.array_equal(at.Z, clean.Z)


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_jacobian_is_that_of_the_model(mount: str) -> None:
    cell, pairs = measured(6, 3, mount)
    rng = np.random.default_rng(0)
    shared = Shared(rng.standard_normal((6, 6, 2)), np.eye(2))
    pairs = replace(pairs, shared=shared)
    at = Placement(cell.camera.matrices()[0], cell.board.matrices()[0])
    at = Placement(
        moved(at.X, 0.1 * rng.standard_normal(6)), moved(at.Z, 0.1 * rng.standard_normal(6))
    )
    state = PairState(at, np.array([0.01, -0.02]))
    _, J = linearised(pairs, state)
    for k in range(14):
        step = np.zeros(14)
        step[k] = 1e-6

        def miss(sign: float, step: np.ndarray = step) -> np.ndarray:
            d = sign * step
            there = Placement(moved(at.X, d[:6]), moved(at.Z, d[6:12]))
            return linearised(pairs, PairState(there, state.common + d[12:]))[0]

        numeric = (miss(1.0) - miss(-1.0)) / 2e-6
        assert np.abs(J[:, :, k] - numeric).max() < 1e-7


@pytest.mark.parametrize("mount", MOUNTS)
def test_the_covariance_is_that_of_the_errors(mount: str) -> None:
    runs, total = 80, 0.0
    for seed in range(runs):
        cell, pairs = measured(15, 100 + seed, mount)
        fit = fit_pairs(pairs, KNOWN)
        e = error(fit.at.X, cell.camera)
        total += float(e @ np.linalg.solve(fit.covariance[:6, :6], e))
    assert sound(total, 6 * runs)


@pytest.mark.parametrize(
    ("seed", "mount", "truth", "tolerance"),
    [
        # 1200 degrees of freedom each: 2 % of a sigma, more where components compete
        (5, "in-hand", BoardNoise(3e-4, 8e-4, (4e-4,) * 3, (1.2e-3,) * 3), (0.12, 0.12, 0.2)),
        # 400 along the axis: 4 %; the roll stands beside the robot's 1e-3
        (6, "to-hand", BoardNoise(2e-4, 1e-3, (1e-4, 1e-4, 10e-4), (2e-3, 2e-3, 6e-4)),
         (0.25, 0.12, 0.4)),
    ],
    ids=["alike", "less along the camera's axis"],
)  # fmt: skip
def test_unknown_noise_of_both_sides_is_found(seed, mount, truth, tolerance) -> None:
    noise = fit_pairs(measured(400, seed, mount, truth)[1]).noise
    place, turn, roll = tolerance
    lateral, _, along = truth.board_m
    assert noise.position_m == pytest.approx(np.hypot(truth.robot_m, lateral), rel=place)
    assert noise.turn_rad == pytest.approx(truth.robot_rad, rel=turn)
    assert noise.tilt_rad == pytest.approx(truth.board_rad[0], rel=0.12)
    assert noise.roll_rad == pytest.approx(truth.board_rad[2], rel=roll)
    if along > lateral:
        assert noise.depth_m == pytest.approx(np.sqrt(along**2 - lateral**2), rel=0.16)
    else:  # there is none: what four sigmas of a variance from 400 numbers leave
        assert noise.depth_m < 5e-4 * (16.0 * 2.0 / 400) ** 0.25


ANY_AXIS = BoardNoise(2e-4, 3e-4, (2e-4, 2e-4, 2e-4), (6e-4, 6e-4, 6e-4))


@pytest.mark.long
@pytest.mark.parametrize("noise", [BoardNoise(), ANY_AXIS], ids=["along the axis", "any axis"])
@pytest.mark.parametrize("mount", MOUNTS)
def test_noise_that_is_estimated_costs_little(mount: str, noise: BoardNoise) -> None:
    """Five variances from 108 numbers take 2.3 % of the error; a tenth of it is chance here."""
    runs, count, chi_square = 120, 20, 0.0
    given = GivenNoise(noise.robot_m, noise.robot_rad, camera_scale=1.0)
    square = np.zeros((2, 2))
    for seed in range(runs):
        cell, pairs = measured(count, 9000 + seed, mount, noise)
        told = replace(pairs, covariance=np.tile(noise.board_covariance, (count, 1, 1)))
        for row, fit in enumerate((fit_pairs(pairs), fit_pairs(told, given))):
            e = error(fit.at.X, cell.camera)
            square[row] += e[:3] @ e[:3], e[3:] @ e[3:]
            if row == 0:
                chi_square += float(e @ np.linalg.solve(fit.covariance[:6, :6], e))
    assert np.all(np.sqrt(square[0] / square[1]) < 1.0 + 2.0 * 2.5 / 108)
    assert sound(chi_square, 6 * runs)


@pytest.mark.parametrize("covariance", [True, False])
def test_slopes_of_the_noise_are_those_of_its_likelihood(covariance: bool) -> None:
    _, pairs = measured(9, 25)
    pairs = replace(pairs, shared=Shared(np.full((9, 6, 1), 1e-3), np.eye(1)))
    if not covariance:
        pairs = replace(pairs, covariance=None)
    state = PairState(robust_start(pairs), np.array([0.3]))
    parts = Parts.of(pairs, state.at.X)
    seen = Evidence.of(pairs, parts, state).with_common(pairs.shared, state.common)

    def weighed(theta: np.ndarray) -> tuple[float, np.ndarray, np.ndarray, np.ndarray]:
        step, slope, drift = np.zeros(13), np.zeros(6), np.zeros((6, 13))
        kept = (seen.parts.columns, seen.parts.owner, seen.parts.rest)
        cost = weigh(seen.rows, *kept, theta, step, slope, np.zeros((6, 6)), drift)
        return cost, step, slope, drift

    theta = np.array([4e-8, 9e-8, 1e-6, 4e-8, 1e-7, 0.7])
    _, _, slope, drift = weighed(theta)
    for one in np.unique(seen.parts.owner):
        away = np.zeros(6)
        away[one] = 1e-4 * theta[one]
        more, less = weighed(theta + away), weighed(theta - away)
        near = (more[0] - less[0]) / (2.0 * away[one])
        assert slope[one] == pytest.approx(near, rel=1e-5, abs=1e-6 / theta[one])
        moved_by = (more[1] - less[1]) / (2.0 * away[one])
        assert drift[one] == pytest.approx(moved_by, rel=1e-4, abs=1e-6 * np.abs(moved_by).max())


def test_noise_that_too_little_tells_is_not_settled() -> None:
    _, pairs = measured(8, 26)
    pairs = replace(pairs, T_base_flange=np.repeat(pairs.T_base_flange[:1], 8, axis=0))
    state = PairState(Placement(np.eye(4), np.eye(4)), np.zeros(0))
    seen = Evidence.of(pairs, Parts.of(pairs, np.eye(4)), state)
    start = PairNoise(1e-3, 1e-3, excess=1.0)
    found = estimate(seen, np.array([True, True, False, False, False, True]), start)
    assert not found.settled
    assert found.noise == start


def test_a_camera_that_is_worse_than_it_says_is_found_out() -> None:
    """As of a lens that is not as assumed: its errors are those of larger noise in the corners."""
    truth = BoardNoise(board_m=(3e-4, 3e-4, 12e-4), board_rad=(3e-3, 3e-3, 6e-4))
    cell, pairs = measured(200, 24, noise=truth)
    told = replace(pairs, covariance=np.tile(truth.board_covariance / 9.0, (200, 1, 1)))
    fit = fit_pairs(told)
    assert fit.noise.camera_scale == pytest.approx(3.0, rel=0.12)
    e = error(fit.at.X, cell.camera)
    assert e @ np.linalg.solve(fit.covariance[:6, :6], e) < chi2.ppf(0.9999, 6)


@pytest.mark.parametrize("mount", MOUNTS)
def test_a_base_that_is_moved_changes_nothing_else(mount: str) -> None:
    _, pairs = measured(12, 6, mount)
    move = frames.transform(frames.exp_rotation([0.3, -1.0, 0.5]), [2.0, -1.0, 0.4])
    here = fit_pairs(pairs, KNOWN)
    there = fit_pairs(replace(pairs, T_base_flange=move @ pairs.T_base_flange), KNOWN)
    X, Z = here.at.X, here.at.Z
    X, Z = (X, move @ Z) if mount == "in-hand" else (move @ X, Z)
    assert np.abs(there.at.X - X).max() < 2e-7
    assert np.abs(there.at.Z - Z).max() < 2e-7
    assert there.covariance[:6, :6] == pytest.approx(here.covariance[:6, :6], rel=1e-3)


def test_the_start_does_not_matter() -> None:
    _, pairs = measured(12, 7)
    best = fit_pairs(pairs)
    for name in CLOSED_FORMS:
        other = fit_pairs(pairs, None, closed_form(name, pairs))
        away = (other.at.X - best.at.X)[:3, 3]
        assert np.abs(away).max() < 0.02 * np.sqrt(np.diag(best.covariance)[:3].max())


def test_outliers_are_named_and_do_no_harm() -> None:
    cell, pairs = measured(30, 8)
    clean = fit_pairs(pairs, KNOWN)
    bad = np.random.default_rng(1).permutation(30)[:9]
    T = pairs.T_camera_board.copy()
    for i in bad:
        T[i] = moved(T[i], np.array([0.05, -0.08, 0.1, 0.2, 0.5, -0.1]) * (1.0 + 0.3 * i))
    found = calibrate_camera(
        replace(pairs, T_camera_board=T), CameraSettings(noise=KNOWN), rejected={"x": "dark"}
    )
    assert set(found.rejected) == {f"s{i}" for i in bad} | {"x"}
    assert "misses the others by" in found.rejected[f"s{bad[0]}"]
    e = error(found.T_flange_sensor, cell.camera)
    assert found.covariance is not None
    assert e @ np.linalg.solve(found.covariance, e) < chi2.ppf(0.9999, 6)
    assert np.trace(found.covariance) < 2.5 * np.trace(clean.covariance[:6, :6])


def test_a_start_among_many_outliers_is_sound() -> None:
    cell, pairs = measured(40, 9)
    T = pairs.T_base_flange.copy()
    T[:16] = T[np.random.default_rng(3).permutation(16)]
    at = robust_start(replace(pairs, T_base_flange=T))
    assert np.abs(error(at.X, cell.camera)[:3]).max() < 5e-3


# ---- poses that judge; closed forms alone --------------------------------------------------------


def test_classic_is_a_closed_form_alone() -> None:
    _, pairs = measured(12, 18)
    found = calibrate_camera(pairs, CameraSettings("classic"))
    at = closed_form(found.more["start"], pairs)
    assert at is not None
    assert np.array_equal(found.T_flange_sensor, at.X)
    assert found.covariance is None
    means = found.more["closed_forms_mean_mm"]
    assert means[found.more["start"]] == min(means.values())
    with pytest.raises(ValueError, match="not one of"):
        CameraSettings("guess")


def test_check_pairs_judge_and_are_not_used() -> None:
    _, pairs = measured(30, 19)
    some, others = pairs.take(np.arange(20)), pairs.take(np.arange(20, 30))
    found = calibrate_camera(some, check=CheckPairs(others, {"x": "dark"}))
    assert found.more["held_out"]["n"] == 10
    alone = calibrate_camera(some)
    assert np.array_equal(found.T_flange_sensor, alone.T_flange_sensor)
    assert "held_out" not in alone.more
    assert found.more["held_out"]["rejected_because"] == {"x": "dark"}
    expected = np.sqrt(np.sum(np.square([2e-4] * 3)) + np.sum(np.square([1e-4, 1e-4, 4e-4])))
    assert found.more["held_out"]["rms_mm"] == pytest.approx(1e3 * expected, rel=0.5)


@pytest.mark.parametrize("method", ["best", "classic"])
def test_check_pairs_refuse_a_board_that_moved(method: str) -> None:
    _, pairs = measured(30, 19)
    some, others = pairs.take(np.arange(20)), pairs.take(np.arange(20, 30))
    T = others.T_base_flange.copy()
    T[:, 0, 3] += 0.02  # as far as the board was moved before these were seen
    found = calibrate_camera(some, CameraSettings(method), check=CheckPairs(others))
    assert found.verdict.accept
    moved_on = CheckPairs(replace(others, T_base_flange=T))
    refused = calibrate_camera(some, CameraSettings(method), check=moved_on)
    assert refused.verdict.code is Code.RESIDUAL_TOO_LARGE
    assert "not used to solve are off by" in refused.verdict.reason
    assert refused.more["held_out"]["rms_mm"] == pytest.approx(20.0, rel=0.1)
    assert np.array_equal(refused.T_flange_sensor, found.T_flange_sensor)


@pytest.mark.parametrize("mount", MOUNTS)
def test_classic_is_judged_by_its_distance_from_the_best(mount: str) -> None:
    _, pairs = measured(12, 18, mount)
    best = calibrate_camera(pairs)
    found = calibrate_camera(pairs, CameraSettings("classic"))
    board = np.concatenate([pairs.T_camera_board[:, :3, 3], np.ones((12, 1))], axis=1)
    away = board @ (found.T_flange_sensor - best.T_flange_sensor).T
    away_m = float(np.sqrt(np.mean(np.sum(away**2, axis=1))))
    assert found.working_error_m == pytest.approx(np.hypot(away_m, best.working_error_m))
    assert found.verdict.accept
    assert f"{away_m * 1e3:.3f} mm from the best estimate" in found.verdict.reason
    limit_m = 0.5 * (found.working_error_m + best.working_error_m)
    assert calibrate_camera(pairs, CameraSettings(limit_m=limit_m)).verdict.accept
    refused = calibrate_camera(pairs, CameraSettings("classic", limit_m=limit_m))
    assert refused.verdict.code is Code.POSES_NOT_INFORMATIVE
    assert "use method best" in refused.verdict.reason


def test_classic_is_refused_where_the_best_that_judges_it_is() -> None:
    """Two boards: one placement fits neither, and two in five samples are left out."""
    _, pairs = measured(40, 18)
    T = pairs.T_camera_board.copy()
    for i in range(0, 40, 5):
        for row in (i, i + 2):
            T[row] = moved(T[row], np.array([3e-3, 0.0, 0.0, 0.0, 0.0, 0.0]) * (1.0 + row / 40))
    of_two = replace(pairs, T_camera_board=T)
    best, classic = (
        calibrate_camera(of_two, CameraSettings(method, KNOWN, limit_m=0.1))
        for method in ("best", "classic")
    )
    assert best.verdict.code is Code.RESIDUAL_TOO_LARGE
    assert "too many samples miss the others" in best.verdict.reason
    assert classic.verdict == best.verdict


def test_classic_leaves_each_out_in_turn() -> None:
    _, pairs = measured(9, 18)
    found = calibrate_camera(pairs, CameraSettings("classic"))
    assert found.leave_one_out_m is not None
    for row in (0, 4, 8):
        rest = np.arange(9) != row
        at = closed_form(found.more["start"], pairs.take(rest))
        assert at is not None
        boards = pairs.T_boardside_cameraside @ at.X @ pairs.T_camera_board
        miss = np.linalg.norm((boards[row] - at.Z)[:3, 3])
        assert found.leave_one_out_m[row] == pytest.approx(miss, rel=1e-6)
    _, many = measured(51, 18)
    assert calibrate_camera(many, CameraSettings("classic")).leave_one_out_m is None
