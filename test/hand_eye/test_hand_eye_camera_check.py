"""Poses that judge a camera and are not used; closed forms alone, judged by the best."""

from dataclasses import replace

import numpy as np
import pytest
from camera_pairs import MOUNTS, measured

from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.camera import CameraSettings, CheckPairs, calibrate_camera
from robocal_ros.hand_eye.camera_data import closed_form


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
