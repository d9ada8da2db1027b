# SPDX-License-Identifier: Apache-2.0
"""A calibration by laser tracker and its touch test, over DDS."""

import numpy as np
import pytest
from geometry_msgs.msg import Point
from hand_eye_driver import ARM, FRAME, Driver
from hand_eye_live import NAME, LiveSensor
from robocal_msgs.msg import HandEyeSample, HandEyeStatus
from robocal_msgs.srv import Decide, HandEyeFile, VerifyHandEye
from scipy.stats import chi2
from tracked_robot import CELL, captured, captures, marks, scans_of_marks
from transforms import matrix_of

from bench.hand_eye_files import write_tracker_target
from robocal_ros.bags.bags import write_data_set
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.result import increment
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.history.calibrations import CalibrationHistory

EACH = 3  # scans of a mark: the fewest that tell its steadiness


def test_targets_have_the_numbers_of_the_message():
    from robocal_ros.hand_eye.services import MOUNTS, TARGETS

    for number, name in TARGETS.items():
        assert getattr(HandEyeStatus, name.upper()) == number
    assert set(MOUNTS) == {HandEyeStatus.ON_FLANGE, HandEyeStatus.FIXED}


def verify(sensor: LiveSensor, **request):
    return sensor.graph.call(VerifyHandEye, f"{NAME}/verify", within_s=60.0, **request)


@pytest.mark.cell
def test_the_tracker_places_the_sensor_and_marked_points_judge_it(graph, tmp_path):
    file = tmp_path / "tracker.yaml"
    write_tracker_target(file, CELL.sizes.target)
    sensor = LiveSensor(
        graph, tmp_path, target="tracker", target_file=str(file), z_grows="away",
        base_frame="base",
    )  # fmt: skip
    assert sensor.start().success
    assert sensor.status[-1].target == HandEyeStatus.TRACKER
    assert "arc_a, arc_b" in sensor.ask_capture("elbow").message
    with CalibrationHistory.open("K1", state_dir=tmp_path) as history:
        driver = Driver(HandEyeSession(ARM, history, HandEyeConfig(sensor_frame=FRAME), "test"))
        captured(driver, captures())  # live they are in test_golden_hand_eye_bag.py
    path, data = tmp_path / "set.mcap", driver.session.data
    write_data_set(path, data.document(), data.topic, FRAME, ARM)
    assert graph.call(HandEyeFile, f"{NAME}/load", path=str(path)).success
    found = sensor.calibrate()
    assert found.success, found.message
    # As well as it says: sigma is told about the sensor's origin along the flange's axes.
    T = matrix_of(found.sensor)
    off = increment(T, CELL.T_flange_sensor, np.zeros(3))
    along_flange = np.concatenate([T[:3, :3] @ off[:3], T[:3, :3] @ off[3:]])
    spread = np.reshape(found.covariance, (6, 6))
    assert along_flange @ np.linalg.solve(spread, along_flange) < chi2.ppf(0.9999, 6)
    classic = sensor.calibrate(method="classic")
    assert classic.candidate_id == 2
    assert verify(sensor).status == Code.CONFLICT  # no marked points
    assert graph.call(Decide, f"{NAME}/accept", within_s=10.0, id=1, by="Ada").success

    assert sensor.start(target=HandEyeStatus.POINT).success
    for q, mark, shot in scans_of_marks(EACH):
        sensor.robot.move(q, 0.1)
        assert sensor.capture(shot, 0.5, mark).state == HandEyeSample.CAPTURED
    steady = verify(sensor)
    assert steady.success, steady.message
    assert list(steady.judged) == [1]
    assert list(steady.off_mean_mm) == [-1.0]
    assert 0.0 < steady.three_sigma_mm[0] < 1.0
    touched = marks()
    places = [Point(**dict(zip("xyz", p.tolist(), strict=True))) for p in touched.values()]
    both = verify(sensor, candidates=[1, 2], points=list(touched), touched=places)
    assert both.success, both.message
    assert list(both.judged) == [1, 2]
    assert all(s > 0.0 for s in both.solve_s)
    # The scans add 0.1 mm at most to what the mount is expected to miss, in 99.9 % of all cases.
    assert both.off_mean_mm[0] < 3.5 * found.expected_error_mm + 0.1
    knocked = [Point(x=p.x + 0.005, y=p.y, z=p.z) for p in places]
    refused = verify(sensor, points=list(touched), touched=knocked)
    assert refused.status == Code.RESIDUAL_TOO_LARGE
    assert verify(sensor, points=["m9"], touched=places[:1]).status == Code.BAD_INPUT
    assert verify(sensor, candidates=[9]).status == Code.BAD_INPUT
    many = verify(sensor, candidates=range(1, 7))  # refused before any is solved
    assert (many.status, many.message.startswith("6 candidates")) == (Code.BAD_INPUT, True)
    assert not many.judged
