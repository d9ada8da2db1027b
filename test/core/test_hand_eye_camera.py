"""Hand-eye of a camera: truth by the simulated cell, recovered; its covariance, its refusals."""

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from robocal_ros.core import frames
from robocal_ros.core.codes import Code
from robocal_ros.core.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.core.hand_eye.board import (
    Chessboard,
    Intrinsics,
    boards_of_corners,
    decode_image,
    find_corners,
    see_boards,
)
from robocal_ros.core.hand_eye.camera import CameraSettings, CheckPairs, calibrate_camera
from robocal_ros.core.hand_eye.camera_closed_forms import (
    CLOSED_FORMS,
    closed_form,
    closed_form_of_all,
)
from robocal_ros.core.hand_eye.camera_fit import GivenNoise, fit_pairs
from robocal_ros.core.hand_eye.camera_kernels import weigh
from robocal_ros.core.hand_eye.camera_model import PairState, linearised
from robocal_ros.core.hand_eye.camera_noise import Evidence, PairNoise, Parts, estimate
from robocal_ros.core.hand_eye.camera_quality import left_out, unsettled
from robocal_ros.core.hand_eye.camera_start import robust_start
from robocal_ros.core.hand_eye.increments import moved
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs, Shared
from robocal_ros.sim.board_camera import BoardCell, BoardNoise, TrueLens, TruePose

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


def test_unknown_noise_of_both_sides_is_found() -> None:
    truth = BoardNoise(3e-4, 8e-4, (4e-4, 4e-4, 4e-4), (1.2e-3, 1.2e-3, 1.2e-3))
    _, pairs = measured(400, 5, noise=truth)
    noise = fit_pairs(pairs).noise
    # 1200 degrees of freedom each: 2 % of a sigma, more where components compete
    assert noise.position_m == pytest.approx(5e-4, rel=0.12)
    assert noise.turn_rad == pytest.approx(8e-4, rel=0.12)
    assert noise.tilt_rad == pytest.approx(1.2e-3, rel=0.12)
    assert noise.roll_rad == pytest.approx(1.2e-3, rel=0.2)
    # there is none: what four sigmas of a variance from 400 numbers leave
    assert noise.depth_m < 5e-4 * (16.0 * 2.0 / 400) ** 0.25


def test_a_camera_that_sees_less_along_its_axis_is_found_out() -> None:
    truth = BoardNoise(2e-4, 1e-3, (1e-4, 1e-4, 10e-4), (2e-3, 2e-3, 6e-4))
    _, pairs = measured(400, 6, "to-hand", truth)
    noise = fit_pairs(pairs).noise
    # 400 degrees of freedom along the axis: 4 % of a sigma, more where components compete
    assert noise.position_m == pytest.approx(np.hypot(2e-4, 1e-4), rel=0.25)
    assert noise.turn_rad == pytest.approx(1e-3, rel=0.12)
    assert noise.tilt_rad == pytest.approx(2e-3, rel=0.12)
    assert noise.roll_rad == pytest.approx(6e-4, rel=0.4)  # beside the robot's 1e-3
    assert noise.depth_m == pytest.approx(np.sqrt(10e-4**2 - 1e-4**2), rel=0.16)


ANY_AXIS = BoardNoise(2e-4, 3e-4, (2e-4, 2e-4, 2e-4), (6e-4, 6e-4, 6e-4))


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


def scaled(T: np.ndarray, factor: float) -> np.ndarray:
    return frames.transform(T[:, :3, :3], factor * T[:, :3, 3])


def shifted(pairs: PosePairs, lag: int) -> PosePairs:
    rows = np.arange(max(lag, 0), len(pairs) + min(lag, 0))
    return replace(pairs.take(rows - lag), T_base_flange=pairs.T_base_flange[rows])


def mirrored(T: np.ndarray) -> np.ndarray:
    """As told in frames whose x and y changed places: left-handed ones."""
    order = [1, 0, 2, 3]
    return T[:, order][:, :, order]


def negated(T: np.ndarray, axis: int) -> np.ndarray:
    T = T.copy()
    T[:, axis, 3] *= -1.0
    return T


MISTAKES = {
    "robot mirrored": (
        lambda p: replace(p, T_base_flange=mirrored(p.T_base_flange)), "mirrored as a whole",
    ),
    "board mirrored": (
        lambda p: replace(p, T_camera_board=mirrored(p.T_camera_board)), "mirrored as a whole",
    ),
    "robot x negated": (
        lambda p: replace(p, T_base_flange=negated(p.T_base_flange, 0)),
        "the robot's positions fit with x negated: they come from a left-handed frame",
    ),
    "robot z negated": (
        lambda p: replace(p, T_base_flange=negated(p.T_base_flange, 2)),
        "the robot's positions fit with z negated: they come from a left-handed frame",
    ),
    "board y negated": (
        lambda p: replace(p, T_camera_board=negated(p.T_camera_board, 1)),
        "the board's positions fit with y negated: they come from a left-handed frame",
    ),
    "robot inverted": (
        lambda p: replace(p, T_base_flange=frames.invert(p.T_base_flange)), "T_flange_base",
    ),
    "board inverted": (
        lambda p: replace(p, T_camera_board=frames.invert(p.T_camera_board)), "T_board_camera",
    ),
    "mount": (
        lambda p: replace(p, mount="to-hand" if p.mount == "in-hand" else "in-hand"), "mounted",
    ),
    "one late": (lambda p: shifted(p, 1), "1 row(s) before its own: the pairs are shifted"),
    "two early": (lambda p: shifted(p, -2), "2 row(s) after its own: the pairs are shifted"),
    "board in mm": (
        lambda p: replace(p, T_camera_board=scaled(p.T_camera_board, 1e3)), "thousand times",
    ),
    "board in km": (
        lambda p: replace(p, T_camera_board=scaled(p.T_camera_board, 1e-3)), "thousand times",
    ),
    "robot in mm": (
        lambda p: replace(p, T_base_flange=scaled(p.T_base_flange, 1e3)), "thousand times",
    ),
    "robot in km": (
        lambda p: replace(p, T_base_flange=scaled(p.T_base_flange, 1e-3)), "thousand times",
    ),
    "squares": (
        lambda p: replace(p, T_camera_board=scaled(p.T_camera_board, 1.2)), "multiplied by 0.83",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("name", list(MISTAKES))
def test_mistakes_are_named(name: str, mount: str) -> None:
    make, words = MISTAKES[name]
    _, pairs = measured(15, 10, mount)
    with pytest.raises(InputError) as caught:
        calibrate_camera(make(pairs))
    assert words in str(caught.value)


def test_poses_that_nothing_fits_are_refused() -> None:
    _, pairs = measured(15, 11)
    order = np.random.default_rng(0).permutation(15)
    with pytest.raises(ResidualError, match="miss each other"):
        calibrate_camera(replace(pairs, T_base_flange=pairs.T_base_flange[order]))


def test_two_swapped_samples_are_named() -> None:
    _, pairs = measured(15, 12)
    T = pairs.T_base_flange.copy()
    T[[3, 9]] = T[[9, 3]]
    found = calibrate_camera(replace(pairs, T_base_flange=T))
    assert set(found.rejected) == {"s3", "s9"}
    assert "robot pose of s9: are the two swapped?" in found.rejected["s3"]
    assert found.verdict.accept


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("sideways", [True, False])
def test_turns_about_one_axis_are_refused(mount: str, sideways: bool) -> None:
    cell = BoardCell(mount=mount, noise=EXACT)
    rng = np.random.default_rng(13)
    angle = np.linspace(-0.6, 0.6, 12)
    first = cell.flange(cell.views(rng, 1))
    turn = frames.transform(frames.exp_rotation(angle[:, None] * [0.0, 0.0, 1.0]), np.zeros(3))
    if sideways:
        turn[:, :2, 3] = rng.uniform(-0.1, 0.1, (12, 2))
    T = first.matrices() @ turn
    flange = TruePose(first.R * first.R.from_matrix(turn[:, :3, :3]), T[:, :3, 3])
    pairs = PosePairs(
        T, cell.seen_from(flange).matrices(), tuple(f"s{i}" for i in range(12)), mount
    )
    with pytest.raises(RankDeficientError) as caught:
        calibrate_camera(pairs)
    directions = caught.value.directions
    assert directions[0].startswith("translation along the common rotation axis")
    assert "turn the flange about another axis" in str(caught.value)
    assert len(directions) == (1 if sideways else 2)
    axis = [0.0, 0.0, 1.0] if mount == "in-hand" else first.R.as_matrix()[0, :, 2]
    words = directions[0].partition("(")[2].split()[:3]
    named = np.array([float(word) for word in words])
    assert abs(named @ axis) == pytest.approx(1.0, abs=0.02)


def test_too_little_is_refused() -> None:
    _, pairs = measured(12, 14)
    with pytest.raises(TooFewSamplesError, match=r"at least 3.*left out: x: dark"):
        calibrate_camera(pairs.take(np.arange(2)), rejected={"x": "dark"})
    still = np.repeat(pairs.T_base_flange[:1], 12, axis=0)
    with pytest.raises(TooFewSamplesError, match=r"left out: s1: from the pose of s0"):
        calibrate_camera(replace(pairs, T_base_flange=still))
    still[:, :3, 3] = pairs.T_base_flange[:, :3, 3]
    with pytest.raises(RankDeficientError, match="turn the flange about two axes"):
        calibrate_camera(replace(pairs, T_base_flange=still))


def test_a_pose_that_is_shown_again_counts_once() -> None:
    _, pairs = measured(12, 14)
    once = calibrate_camera(pairs)
    again = calibrate_camera(replace(
        pairs.take(np.tile(np.arange(12), 3)),
        names=tuple(f"{name} {i}" for i in range(3) for name in pairs.names),
    ))  # fmt: skip
    assert again.working_error_m == once.working_error_m
    assert len(again.rejected) == 24 + len(once.rejected)


def test_three_poses_are_enough() -> None:
    cell, pairs = measured(3, 15, noise=EXACT)
    found = calibrate_camera(pairs)
    assert np.abs(error(found.T_flange_sensor, cell.camera)).max() < 1e-7
    assert found.leave_one_out_m is None


@pytest.mark.parametrize("count", [3, 4, 5, 6])
def test_few_noisy_poses_are_not_blamed(count: int) -> None:
    """By chance few samples fit another scale, or another order, no worse than their own."""
    for seed in range(30):
        _, pairs = measured(count, 700 + seed)
        found = calibrate_camera(pairs)
        assert found.residual_m.max() < 5e-3


def test_leaving_one_out_is_as_solving_without_it() -> None:
    _, pairs = measured(10, 16)
    fit = fit_pairs(pairs, KNOWN)
    told = left_out(fit)
    assert told is not None
    for i in range(10):
        rest = np.arange(10) != i
        without = fit_pairs(pairs.take(rest), KNOWN)
        miss = linearised(pairs.take(~rest), PairState(without.at, np.zeros(0)))[0]
        assert told[i] == pytest.approx(np.linalg.norm(miss[0, :3]), rel=0.02, abs=2e-6)


def test_the_expected_error_is_that_at_fresh_poses() -> None:
    runs, total, told = 40, 0.0, 0.0
    for seed in range(runs):
        cell, pairs = measured(12, 300 + seed)
        found = calibrate_camera(pairs, CameraSettings(noise=KNOWN))
        where = np.append(pairs.T_camera_board[:, :3, 3].mean(axis=0), 1.0)
        away = (found.T_flange_sensor - cell.camera.matrices()[0]) @ where
        total += float(away @ away)
        told += float(found.working_error_m or 0.0) ** 2
    assert total / told == pytest.approx(1.0, abs=4.0 * np.sqrt(2.0 / (2.0 * runs)))


def test_noise_that_swings_between_two_answers_settles() -> None:
    """Whole steps go from the robot's position alone to its turn as well, and back."""
    _, pairs = measured(8, 4, "to-hand")
    fit = fit_pairs(pairs)
    assert fit.settled
    assert unsettled(fit) is None


def test_what_is_no_solution_is_not_accepted() -> None:
    _, pairs = measured(12, 18)
    fit = fit_pairs(pairs)
    crept = replace(fit, estimate=replace(fit.estimate, converged=False))
    for wrong, words in (
        (replace(fit, settled=False), "the noise did not settle"), (crept, "still crept"),
    ):  # fmt: skip
        refused = unsettled(wrong)
        assert refused is not None
        assert refused.code is Code.POSES_NOT_INFORMATIVE
        assert words in refused.reason


def test_poses_that_tell_little_are_not_accepted() -> None:
    _, pairs = measured(12, 17)
    found = calibrate_camera(pairs, CameraSettings(limit_m=1e-5))
    assert found.verdict.code is Code.POSES_NOT_INFORMATIVE
    assert "turned further about two axes" in found.verdict.reason


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


def test_classic_names_mistakes_too() -> None:
    _, pairs = measured(15, 10)
    wrong = replace(pairs, T_camera_board=scaled(pairs.T_camera_board, 1.2))
    with pytest.raises(InputError, match=r"multiplied by 0\.83"):
        calibrate_camera(wrong, CameraSettings("classic"))


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
