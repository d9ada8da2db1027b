# SPDX-License-Identifier: Apache-2.0
"""Mistakes in the poses of a camera are named; poses that do not suffice are refused."""

from dataclasses import replace

import numpy as np
import pytest
from camera_pairs import EXACT, KNOWN, MOUNTS, error, measured
from long_form import more
from scipy.stats import binom, chi2, f

from bench.hand_eye_cell import BoardCell, BoardNoise, TruePose
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.hand_eye.camera import CameraSettings, calibrate_camera, left_out, unsettled
from robocal_ros.hand_eye.camera_data import PosePairs, Shared
from robocal_ros.hand_eye.camera_fit import PairState, fit_pairs, linearised


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


@pytest.mark.parametrize("mount", MOUNTS)
def test_squares_that_displace_the_camera_are_told(mount: str) -> None:
    """A board's size that is wrong by a percent lets all fit within a millimetre."""
    for seed in range(5):
        cell, pairs = measured(20, 50 + seed, mount)
        assert "multiplied" not in calibrate_camera(pairs).verdict.reason
        wrong = replace(pairs, T_camera_board=scaled(pairs.T_camera_board, 1.01))
        found = calibrate_camera(wrong)
        off_m = float(np.linalg.norm(error(found.T_flange_sensor, cell.camera)[:3]))
        assert off_m > 2e-3 > 3.0 * float(found.working_error_m or 0.0)
        assert found.verdict.code is Code.RESIDUAL_TOO_LARGE
        told = found.verdict.reason.partition("multiplied by ")[2].partition(":")[0]
        factor, sigma = map(float, told.split(" +- "))
        assert abs(factor - 1.0 / 1.01) < 4.0 * sigma < 4.0 * 2e-3
        told_m = 1e-3 * float(found.verdict.reason.partition("the camera ")[2].split()[0])
        assert told_m == pytest.approx(off_m, rel=0.3)
        allowed = calibrate_camera(wrong, CameraSettings(limit_m=2.0 * off_m)).verdict
        assert allowed.accept
        assert "check the size of its squares" in allowed.reason


@pytest.mark.parametrize("mount", MOUNTS)
def test_what_images_leave_open_of_the_focal_length_is_no_wrong_board(mount: str) -> None:
    cell, pairs = measured(20, 50, mount)
    T = scaled(pairs.T_camera_board, 1.03)
    by_focal = np.zeros((20, 6, 1))
    by_focal[:, :3, 0] = pairs.T_camera_board[:, :3, 3]
    told = replace(pairs, T_camera_board=T, shared=Shared(by_focal, np.array([[0.03**2]])))
    found = calibrate_camera(told)
    assert found.verdict.accept
    assert "multiplied" not in found.verdict.reason
    e = error(found.T_flange_sensor, cell.camera)
    assert found.covariance is not None
    assert e @ np.linalg.solve(found.covariance, e) < chi2.ppf(0.9999, 6)


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


PLACES = BoardNoise(3e-4, 1e-6, (3e-4,) * 3, (1e-6,) * 3)  # all of it


@pytest.mark.parametrize("noise", [BoardNoise(), PLACES], ids=["as usual", "of positions alone"])
@pytest.mark.parametrize("count", [3, *more(4, 5)])
def test_the_expected_error_of_few_poses_holds(count: int, noise: BoardNoise) -> None:
    """Whatever their noise is of.

    The bound is of what chance does to the mean of so many squared errors, of a noise that three to
    nine numbers told: an inverse chi-square, whose tail is long. So they are counted, too, that are
    larger than one in twenty is, were it all along one axis.
    """
    runs, numbers = 150, 3 * count - 6
    ratio = []
    for seed in range(runs):
        cell, pairs = measured(count, 9000 + seed, noise=noise)
        found = calibrate_camera(pairs)
        where = np.append(pairs.T_camera_board[:, :3, 3].mean(axis=0), 1.0)
        away = (found.T_flange_sensor - cell.camera.matrices()[0]) @ where
        ratio.append(float(away @ away) / float(found.working_error_m or 0.0) ** 2)
    rng = np.random.default_rng(1)
    drawn = (numbers - 2.0) / rng.chisquare(numbers, (4000, runs))
    drawn *= rng.chisquare(3, (4000, runs)) / 3.0
    assert np.mean(ratio) < np.quantile(drawn.mean(axis=1), 0.999)
    rare = (numbers - 2.0) / numbers * f.ppf(0.95, 1, numbers)
    assert np.sum(np.array(ratio) > rare) <= binom.ppf(0.999, runs, 0.05)


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


def test_classic_names_mistakes_too() -> None:
    _, pairs = measured(15, 10)
    wrong = replace(pairs, T_camera_board=scaled(pairs.T_camera_board, 1.2))
    with pytest.raises(InputError, match=r"multiplied by 0\.83"):
        calibrate_camera(wrong, CameraSettings("classic"))
