# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node over DDS: its other targets, plans that the session's own knowledge mends."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import Point
from hand_eye_driver import ARM, FRAME, T_BASE_BOARD, profile, sphere_set, target_pose, wide_cell
from hand_eye_live import NAME, SHOTS, LiveSensor
from robocal_msgs.msg import HandEyeSample, HandEyeStatus
from robocal_msgs.srv import CheckHandEyePlan, Decide, HandEyeFile
from sensor_msgs.msg import JointState
from tf2_msgs.msg import TFMessage
from transforms import off_m

from bench.hand_eye_cell import TrueStairs, edge_shots, step_shots
from bench.hand_eye_files import write_target
from robocal_ros.bags.bags import write_data_set
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.result import HandEyeSettings
from robocal_ros.hand_eye.targets import Staircase
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import pose_message

TRUTH = sphere_set()[0].T_flange_sensor
STAIRS = TrueStairs(frames.transform(frames.exp_rotation([0.02, -0.03, 0.4]), [0.75, -0.1, 0.1]))
STEPS = Staircase(5, 0.09, 0.01, 0.01)
OFF_M = 5e-4  # at the working distance


def captured(sensor: LiveSensor, shots: Iterator[tuple[np.ndarray, Any, str]]) -> None:
    for q, shot, mark in shots:
        sensor.robot.move(q, 0.2)
        assert sensor.capture(shot, mark=mark).state == HandEyeSample.CAPTURED


@pytest.mark.parametrize("mount", ["in-hand", "to-hand"])
def test_a_camera_by_the_poses_of_its_target(graph: Any, tmp_path: Path, mount: str) -> None:
    """0.05 mm and 0.02 deg of noise; to-hand the same pose is that of the camera in base."""
    sensor = LiveSensor(graph, tmp_path, target="camera", target_file="", mount=mount)
    rng, parent = np.random.default_rng(2), {"in-hand": "tool0", "to-hand": "base"}[mount]

    def shots() -> Iterator[tuple[np.ndarray, Any, str]]:
        for q, _ in SHOTS[:12]:
            T = ARM.fk(q)
            away = T @ TRUTH if mount == "in-hand" else frames.invert(T) @ TRUTH
            noise = frames.exp_rotation(np.radians(0.02) * rng.standard_normal(3))
            board = frames.transform(noise, 5e-5 * rng.standard_normal(3))
            seen = frames.invert(away) @ T_BASE_BOARD @ board
            yield q, lambda stamp_ns, seen=seen: target_pose(stamp_ns, seen), ""

    assert sensor.start().success
    captured(sensor, shots())
    assert sensor.status[-1].header.frame_id == parent
    assert sensor.status[-1].target == HandEyeStatus.CAMERA
    result = sensor.calibrate()
    assert result.success, result.message
    assert off_m(result.sensor, TRUTH, 0.5) < OFF_M
    tf = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    graph.spin_until(lambda: tf and tf[-1].transforms, "the transform")
    header = tf[-1].transforms[0].header
    assert (header.frame_id, tf[-1].transforms[0].child_frame_id) == (parent, FRAME)


@pytest.mark.parametrize("kind", ["line", "step"])
def test_an_edge_and_the_marks_of_a_staircase(graph: Any, tmp_path: Path, kind: str) -> None:
    cell, rng = wide_cell(), np.random.default_rng(3)
    file = ""
    if kind == "step":
        file = str(tmp_path / "step.yaml")
        write_target(Path(file), STEPS.target(STAIRS.T_base_user))
        shots = step_shots(cell, STAIRS, 8, rng)
    else:
        shots = edge_shots(cell, STAIRS.T_base_user, 12, rng)
    sensor = LiveSensor(graph, tmp_path, target=kind, target_file=file)
    assert sensor.start().success
    if kind == "step":
        assert sensor.ask_capture("middle").status == Code.BAD_INPUT
    assert shots.q is not None
    looks = [lambda ns, points=points: profile(ns, points) for points in shots.profiles]
    captured(sensor, iter(zip(shots.q, looks, shots.marks, strict=True)))
    assert [one.mark for one in sensor.status[-1].samples] == list(shots.marks)
    result = sensor.calibrate()
    assert result.success, result.message
    # Of an edge the other side may be hidden from the camera.
    assert result.samples >= len(looks) - (kind == "line")
    assert off_m(result.sensor, cell.T_flange_sensor) < OFF_M


def test_plans_rest_on_what_is_known_best(graph: Any, tmp_path: Path) -> None:
    """The configured place of the sensor is half a metre off."""
    rough_mm = (TRUTH[:3, 3] * 1e3 + [500.0, 0.0, 0.0]).tolist()
    turn = frames.quat_xyzw(TRUTH).tolist()
    sensor = LiveSensor(graph, tmp_path, rough_xyz_mm=rough_mm, rough_quat_xyzw=turn)
    poses = [ARM.fk(q) for q, _ in SHOTS]

    def plan(T: list[np.ndarray], **more: Any) -> Any:
        flange = [pose_message(each) for each in T]
        return graph.call(CheckHandEyePlan, f"{NAME}/check_plan", flange=flange, **more)

    sensor.sphere(8)
    blind = plan(poses)  # the samples tell where the sphere is, and the place is wrong
    assert not blind.success
    assert "rough_xyz_mm" in blind.message
    told = plan(poses, sensor=[pose_message(TRUTH)])
    assert told.success, told.message
    assert "the request" in told.message
    result = sensor.calibrate()
    assert f"candidate {result.candidate_id}" in plan(poses).message
    second = sensor.calibrate()
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    # The second was solved against a revision that is no longer in force.
    stale = graph.call(Decide, f"{NAME}/accept", id=second.candidate_id, by="me")
    assert (stale.success, stale.status) == (False, Code.STALE)
    lifted = [*poses[:2], frames.transform(np.eye(3), [0.0, 0.0, 0.1]) @ poses[2], *poses[3:]]
    good = plan(lifted)
    assert good.success, good.message
    assert f"calibration {result.candidate_id} in force" in good.message
    (unseen,) = good.unseen
    assert unseen.startswith("pose 3: ")
    assert "mm" in unseen
    far = plan(poses, center=[Point(x=0.75, y=-0.1, z=0.5)])
    assert len(far.unseen) == len(poses)
    many = plan([poses[0]] * 201)
    assert (many.success, many.status) == (False, Code.LIMIT_EXCEEDED)
    degrees = [JointState(name=list(ARM.joint_names), position=np.degrees(SHOTS[0][0]).tolist())]
    wrong = graph.call(CheckHandEyePlan, f"{NAME}/check_plan", joints=degrees)
    assert (wrong.status, "degrees where rad" in wrong.message) == (Code.BAD_INPUT, True)


def test_what_the_poses_leave_open_and_whose_data_they_are(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path)
    assert sensor.node._config.limit_m == HandEyeSettings().limit_m  # as in the commands
    assert sensor.start().success
    for _ in range(6):
        assert sensor.capture(SHOTS[0][1]).state == HandEyeSample.CAPTURED
    open_ = sensor.calibrate()
    assert (open_.success, open_.status) == (False, Code.RANK_DEFICIENT)
    assert any("translation" in words for words in open_.unobservable)
    data = sensor.node._session.data
    other, path = load_robot("kr150_r3100"), tmp_path / "other.mcap"
    write_data_set(path, data.document(), data.topic, FRAME, other)
    loaded = graph.call(HandEyeFile, f"{NAME}/load", path=str(path))
    assert (loaded.success, loaded.status) == (False, Code.WRONG_ROBOT)
