# SPDX-License-Identifier: Apache-2.0
"""Streams of poses on two clocks: the offset and the camera, from simulated motions."""

from dataclasses import replace

import numpy as np
import pytest
from camera_tables import moving_flange
from long_form import more
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from bench.hand_eye_cell import BoardCell, BoardNoise
from robocal_ros.estimation.estimation import correlation
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.camera import CameraSettings, calibrate_streams, pair_streams
from robocal_ros.hand_eye.camera_data import PoseStream, coarse_offset, pairs_at, stream_of
from robocal_ros.hand_eye.camera_fit import GivenNoise

MOUNTS = ("in-hand", "to-hand")
NOISE = BoardNoise(1e-4, 2e-4, (4e-4, 4e-4, 4e-4), (1e-3, 1e-3, 1e-3))
GIVEN = GivenNoise(1e-4, 2e-4)


def recorded(offset_s: float, mount: str, seed: int, noise: BoardNoise = NOISE, last_s: float = 20):
    """A robot at 50 Hz and a camera at 15 Hz whose clock is behind by the offset."""
    rng = np.random.default_rng(seed)
    cell = BoardCell(mount=mount, noise=noise)
    robot_s = np.arange(0.0, last_s, 0.02)
    camera_s = np.arange(1.0, last_s - 1.0, 1.0 / 15.0) + rng.uniform(0.0, 5e-3)
    robot = cell.read_robot(moving_flange(robot_s), rng)
    board = cell.read_board(cell.seen_from(moving_flange(camera_s)), rng)
    names = tuple(f"c{i}" for i in range(len(camera_s)))
    return (
        cell,
        PoseStream(robot_s, robot, tuple(map(str, range(len(robot_s))))),
        PoseStream(camera_s - offset_s, board, names),
    )


@pytest.mark.parametrize("mount", MOUNTS)
@pytest.mark.parametrize("offset_s", [0.137, *more(0.0, -3.2)])
def test_offset_and_camera_are_found(offset_s: float, mount: str) -> None:
    cell, robot, camera = recorded(offset_s, mount, 1)
    assert coarse_offset(robot, camera) == pytest.approx(offset_s, abs=0.05)
    found = calibrate_streams(robot, camera, mount, CameraSettings(noise=GIVEN))
    sigma = found.more["time_offset_sigma_s"]
    assert sigma < 5e-4
    assert found.more["time_offset_s"] == pytest.approx(offset_s, abs=4.0 * sigma)
    truth = cell.camera.matrices()[0]
    T = found.T_flange_sensor
    turn = Rotation.from_matrix(T[:3, :3].T @ truth[:3, :3]).as_rotvec()
    e = np.concatenate([T[:3, :3].T @ (truth - T)[:3, 3], turn])
    assert found.covariance is not None
    # interpolation between noisy readings is smoother than they are: the covariance is generous
    assert e @ np.linalg.solve(found.covariance, e) < chi2.ppf(0.9999, 6)
    assert found.verdict.accept


def test_without_noise_the_offset_is_exact() -> None:
    """But for the robot's path between two readings, which is taken as straight."""
    still = BoardNoise(0.0, 0.0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    _, robot, camera = recorded(0.05, "in-hand", 2, still)
    assert pair_streams(robot, camera).offset_s == pytest.approx(0.05, abs=2e-5)


def test_outliers_and_ends_are_named() -> None:
    cell, robot, camera = recorded(0.2, "in-hand", 3)
    T = camera.T.copy()
    bad = [20, 50, 51, 120]
    T[bad, :3, 3] += 0.05
    early = replace(camera, T=T, time_s=camera.time_s - 1.5)  # 0.5 s before the robot's first pose
    found = calibrate_streams(robot, early)
    late = [name for name, why in found.rejected.items() if why == "no robot pose at its time"]
    assert late == []
    assert {f"c{i}" for i in bad} <= set(found.rejected)
    assert found.more["time_offset_s"] == pytest.approx(1.7, abs=2e-3)
    truth = cell.camera.matrices()[0, :3, 3]
    assert np.linalg.norm(found.T_flange_sensor[:3, 3] - truth) < 1e-3

    short = PoseStream(robot.time_s[200:], robot.T[200:], robot.names[200:])
    cut = calibrate_streams(short, camera)
    lost = [name for name, why in cut.rejected.items() if why == "no robot pose at its time"]
    starts = camera.time_s + 0.2 < short.time_s[0] - 2e-3
    assert set(np.array(camera.names)[starts]) <= set(lost)
    assert len(lost) <= int(starts.sum()) + 1


def test_a_pause_of_the_robot_is_not_bridged() -> None:
    _, robot, camera = recorded(0.0, "in-hand", 4)
    kept = (robot.time_s < 8.0) | (robot.time_s > 10.0)
    gap = PoseStream(robot.time_s[kept], robot.T[kept], tuple(np.array(robot.names)[kept]))
    found = pair_streams(gap, camera)
    times = {name: time for name, time in zip(camera.names, camera.time_s, strict=True)}
    assert found.left_out
    assert all(7.95 < times[name] < 10.05 for name in found.left_out)


def test_check_poses_of_another_time_judge() -> None:
    _, robot, camera = recorded(0.1, "in-hand", 5)
    half = len(robot.time_s) // 2
    first, second = (
        PoseStream(robot.time_s[part], robot.T[part], robot.names[part])
        for part in (slice(0, half), slice(half, None))
    )
    found = calibrate_streams(first, camera, check=second)
    expected = np.sqrt(3.0 * (4e-4**2 + 1e-4**2))
    assert found.more["held_out"]["rms_mm"] == pytest.approx(1e3 * expected, rel=0.25)
    held = found.more["held_out"]["n"]
    assert held > len(camera.names) // 3
    assert len(found.samples) + len(found.rejected) + held == len(camera.names)


@pytest.mark.long
def test_check_poses_are_named_where_they_belong() -> None:
    """A pause of the check is its own; before the robot's first pose nothing judges."""
    _, robot, camera = recorded(0.0, "in-hand", 5)
    late = [robot.time_s >= low for low in (2.0, 11.0)]
    first, second = (
        PoseStream(robot.time_s[part], robot.T[part], tuple(np.array(robot.names)[part]))
        for part in (
            late[0] & (robot.time_s < 11.0),
            late[1] & ((robot.time_s < 14.0) | (robot.time_s > 15.0)),
        )
    )
    found = calibrate_streams(first, camera, check=second)
    time = dict(zip(camera.names, camera.time_s, strict=True))
    judged = found.more["held_out"]
    assert judged["rejected"]
    assert all(13.95 < time[name] < 15.05 for name in judged["rejected"])
    assert set(judged["rejected_because"].values()) == {"no robot pose at its time"}
    alone = [name for name, why in found.rejected.items() if why == "no robot pose at its time"]
    assert any(time[name] < 2.0 for name in alone)
    assert all(time[name] < 2.05 or 10.95 < time[name] < 11.05 for name in alone)


def test_check_poses_that_were_used_are_refused() -> None:
    _, robot, camera = recorded(0.1, "in-hand", 5)
    with pytest.raises(InputError, match="other times must judge"):
        calibrate_streams(robot, camera, check=robot)


def test_streams_of_two_runs_are_refused() -> None:
    _, robot, camera = recorded(0.0, "in-hand", 6)
    rng = np.random.default_rng(0)
    walk = Rotation.from_rotvec(np.cumsum(rng.standard_normal((len(camera.T), 3)), axis=0) * 0.3)
    other = frames.transform(walk.as_matrix(), camera.T[:, :3, 3])
    with pytest.raises(InputError, match="nowhere correlate"):
        coarse_offset(robot, replace(camera, T=other))


def test_mistakes_in_streams_are_named() -> None:
    _, robot, camera = recorded(0.3, "in-hand", 8)
    with pytest.raises(InputError, match="mounted in-hand"):
        calibrate_streams(robot, camera, "to-hand")
    large = frames.transform(camera.T[:, :3, :3], 1.1 * camera.T[:, :3, 3])
    with pytest.raises(InputError, match=r"multiplied by 0\.9"):
        calibrate_streams(robot, replace(camera, T=large))


def test_streams_that_hardly_overlap_are_too_short() -> None:
    _, robot, camera = recorded(0.0, "in-hand", 9)
    late = PoseStream(robot.time_s[130:], robot.T[130:], robot.names[130:])
    early = PoseStream(camera.time_s[:30], camera.T[:30], camera.names[:30])
    with pytest.raises(TooFewSamplesError, match="record both for longer"):
        pairs_at(late, early, 0.0, "in-hand")


def test_stamps_are_put_in_order_or_refused() -> None:
    T = np.tile(np.eye(4), (30, 1, 1))
    T[:, 0, 3] = np.arange(30)
    stamps = np.arange(30) * 20_000_000
    names = tuple(map(str, range(30)))
    stamps[[4, 5]] = stamps[[5, 4]]
    stamps[10] = stamps[9]
    stream = stream_of(stamps, T, names, 0, "robot")
    assert np.all(np.diff(stream.time_s) > 0.0)
    assert len(stream.T) == 29
    assert stream.names[4:6] == ("5", "4")
    with pytest.raises(InputError, match=r"go back by 2\.0 s at sample 20"):
        stream_of(np.where(np.arange(30) < 20, stamps, stamps - 2_020_000_000), T, names, 0, "x")
    with pytest.raises(TooFewSamplesError, match="no stream"):
        stream_of(stamps[:12], T[:12], names[:12], 0, "robot")
    since_1970 = np.where(np.arange(30) < 1, 0, stamps + 1_700_000_000 * 10**9)
    with pytest.raises(InputError, match=r"leap ahead by 17\d{8}\.\d s at sample 1:"):
        stream_of(since_1970, T, names, 0, "robot")
    with pytest.raises(TooFewSamplesError, match=r"robot poses last 0\.058 s"):
        stream_of(stamps // 10, T, names, 0, "robot")


def test_interpolation_follows_a_screw() -> None:
    time = np.array([0.0, 1.0, 2.0])
    turn = Rotation.from_rotvec(np.outer(time, [0.2, -0.5, 0.9]))
    stream = PoseStream(
        time, frames.transform(turn.as_matrix(), np.outer(time, [1.0, 2.0, 3.0])), ("a", "b", "c")
    )
    T = stream.at(np.array([0.25, 1.7, 5.0]))
    wanted = Rotation.from_rotvec(np.outer([0.25, 1.7, 2.0], [0.2, -0.5, 0.9])).as_matrix()
    assert T[:, :3, :3] == pytest.approx(wanted, abs=1e-12)
    assert T[:, :3, 3] == pytest.approx(np.outer([0.25, 1.7, 2.0], [1.0, 2.0, 3.0]))
    assert stream.covers(np.array([-0.1, 0.5, 2.0, 2.1])).tolist() == [False, True, True, False]


def test_neighbours_that_share_errors_count_less() -> None:
    rng = np.random.default_rng(7)
    white = rng.standard_normal((4000, 6))
    assert correlation(white) == pytest.approx(1.0, abs=0.15)
    drawn = np.empty_like(white)
    drawn[0] = white[0]
    for i in range(1, len(white)):
        drawn[i] = 0.8 * drawn[i - 1] + 0.6 * white[i]
    assert correlation(drawn) == pytest.approx((1.0 + 0.8) / (1.0 - 0.8), rel=0.25)
