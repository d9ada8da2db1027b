# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node over DDS: a simulated robot brings a laser sensor before a sphere."""

import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command import robocal_json
from geometry_msgs.msg import TransformStamped
from hand_eye_driver import ARM, FRAME, RADIUS_M, Recorded, Robot, joints, profile, sphere_set
from hand_eye_live import NAME, SHOTS, LiveSensor, recorded, settings_of
from robocal_msgs.msg import CalibrationQuality, HandEyeSample, HandEyeStatus, SessionEvent
from robocal_msgs.srv import (
    CaptureHandEye,
    CheckHandEyePlan,
    Decide,
    RemoveHandEye,
)
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger
from tf2_msgs.msg import TFMessage
from transforms import matrix_of, off_m

from bench.hand_eye_files import write_target
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.data import Capture
from robocal_ros.hand_eye.node import HandEyeNode
from robocal_ros.hand_eye.services import HandEyeOutputs
from robocal_ros.hand_eye.targets import LineTarget
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import pose_message
from robocal_ros.ros.endpoints import ERROR
from robocal_ros.ros.session_node import EVENTS
from robocal_ros.session.events import Command, Outcome

NO_TEXT = "\ud800"  # cannot be carried: it has no UTF-8


def taken(sensor: LiveSensor) -> str:
    """Why the sensor's frame cannot stand below the flange."""
    return str(sensor.node._frames.conflict("tool0", np.eye(4)))


@pytest.fixture
def sensor(graph: Any, tmp_path: Path) -> LiveSensor:
    return LiveSensor(graph, tmp_path)


def test_a_sensor_is_calibrated_accepted_kept_and_rolled_back(
    graph: Any, sensor: LiveSensor, tmp_path: Path
) -> None:
    tf = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    quality = graph.collect(CalibrationQuality, f"{NAME}/quality", endpoints.LATCHED)
    sensor.sphere()
    result = sensor.calibrate()
    assert result.success, result.message
    assert (result.status, result.samples) == (CalibrationQuality.ACCEPT, 10)
    away_m = off_m(result.sensor, sphere_set()[0].T_flange_sensor)  # at the working distance
    assert away_m < 3e-3 * result.expected_error_mm < 1e-3  # the limit of what is accepted is 1 mm
    covariance = np.array(result.covariance).reshape(6, 6)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    graph.spin_until(lambda: quality, "the verdict")
    assert (quality[-1].candidate_id, quality[-1].accept) == (result.candidate_id, True)
    assert quality[-1].predicted_rms_mm == pytest.approx(result.expected_error_mm)
    names = ("mean", "rms", "p95", "max")
    mean, rms, p95, most = (getattr(quality[-1], f"candidate_{name}_mm") for name in names)
    assert 0.0 < mean < rms < most
    assert mean < p95 < most  # between the two largest of ten
    assert {getattr(quality[-1], f"current_{name}_mm") for name in names} == {-1.0}
    assert (quality[-1].rank, quality[-1].condition) == (0, -1.0)
    assert quality[-1].header.frame_id == "tool0"
    # Nothing is in force before somebody accepts it.
    assert [m for m in tf if m.transforms] == []
    done = graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me")
    assert (done.success, done.revision) == (True, 1), done.message
    graph.spin_until(lambda: tf and tf[-1].transforms, "the transform")
    (transform,) = tf[-1].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("tool0", FRAME)
    assert transform.transform == result.sensor
    graph.spin_until(lambda: sensor.status[-1].revision == 1, "the status")
    # A node that starts anew publishes it again, also after a crash.
    sensor.node.trigger_deactivate()
    sensor.node.trigger_cleanup()
    again = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    settings = {n: v for n, v in settings_of(tmp_path).items() if n != "target_file"}
    process = graph.start("hand_eye_node", settings, {"__node": "second_node"})
    graph.spin_until(lambda: again and again[-1].transforms, "after the start")
    process.kill()
    again.clear()
    graph.start("hand_eye_node", settings, {"__node": "second_node"})
    graph.spin_until(lambda: again and again[-1].transforms, "after the crash")
    assert again[-1].transforms == [transform]
    back = graph.call(Trigger, "/second_node/rollback_trigger")
    assert back.message == "0 ACCEPT revision 2: nothing in force"
    late = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    graph.spin_until(lambda: late, "what a late subscriber gets")
    assert late[-1].transforms == []


def test_a_makes_profiles_are_calibrated_and_replayed_alike(graph: Any, tmp_path: Path) -> None:
    """Two profiles in each cloud, as of a sensor that believes to move; z towards the sensor."""
    live = graph.collect(SessionEvent, f"{NAME}/session_events", EVENTS)
    sensor = LiveSensor(graph, tmp_path, sensor="lmi-gocator", z_grows="")
    truth = sphere_set()[0].T_flange_sensor
    assert sensor.start().success
    for (q, _), points in list(zip(SHOTS, sphere_set()[1].profiles, strict=False))[:10]:
        sensor.robot.move(q, 0.2)

        def shot(stamp_ns: int, seen: np.ndarray = points) -> Recorded:
            one, fields = profile(stamp_ns, seen), dict(profile(stamp_ns, seen, y=0.01).fields)
            fields["data"] = one.fields["data"] + fields["data"]
            fields["width"] *= 2
            fields["row_step"] *= 2
            return Recorded(one.kind, stamp_ns, fields)

        assert sensor.capture(shot).state == HandEyeSample.CAPTURED
    result = sensor.calibrate()
    assert result.success, result.message
    assert off_m(result.sensor, truth) < 3e-3 * result.expected_error_mm
    graph.spin_until(lambda: len(live) > 1 + 2 * 10 + 1, "all events, and the configuration")
    bag = recorded(tmp_path, sensor.sent, live)
    document = robocal_json("replay.hand_eye.json", "replay", bag)
    assert document["differs"] == []
    found_mm = document["calibrations"][0]["T_flange_sensor"]["xyz_mm"]
    assert found_mm == pytest.approx(1e3 * matrix_of(result.sensor)[:3, 3], abs=1e-12)


def test_a_moving_robot_is_not_captured_and_a_sample_is_removed(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path, capture_timeout_s=2.0)
    (q, shot), (other, _) = SHOTS[:2]
    assert sensor.start().success
    asked = sensor.ask_capture()
    assert (asked.success, asked.handle) == (True, 1)
    graph.spin_until(lambda: sensor.status[-1].state == HandEyeStatus.CAPTURING, "it waits")
    assert sensor.of(1).state == HandEyeSample.WAITING
    second = sensor.ask_capture()
    assert (second.success, second.status, second.handle) == (False, Code.CONFLICT, 0)
    for _ in range(4):  # never at rest for the 0.4 s that a sample takes
        for there in (other, q):
            sensor.robot.move(there, 0.2)
            sensor.robot.rest(0.1, shot)
    failed = sensor.ended(1)
    assert (failed.state, failed.status) == (HandEyeSample.FAILED, Code.BAD_INPUT)
    assert "moved by" in failed.reason
    for handle in (2, 3):
        assert sensor.capture(shot).handle == handle
    removed = graph.call(RemoveHandEye, f"{NAME}/remove", handle=2)
    assert (removed.success, removed.samples) == (True, 1)
    assert not graph.call(RemoveHandEye, f"{NAME}/remove", handle=2).success
    assert not graph.call(RemoveHandEye, f"{NAME}/remove", handle=0).success
    graph.spin_until(lambda: [s.handle for s in sensor.status[-1].samples] == [1, 3], "the status")
    few = sensor.calibrate()
    assert (few.success, few.status, few.candidate_id) == (False, Code.TOO_FEW_SAMPLES, 0)
    assert (few.expected_error_mm, few.residual_mm) == (-1.0, -1.0)
    assert sensor.calibrate(handles=[2]).status == Code.BAD_INPUT


def test_a_plan_without_turns_is_refused_in_words(graph: Any, tmp_path: Path) -> None:
    truth = sphere_set()[0].T_flange_sensor
    rough_mm = (truth[:3, 3] * 1e3 + 2.0).round(1).tolist()
    rough = {"rough_xyz_mm": rough_mm, "rough_quat_xyzw": frames.quat_xyzw(truth).tolist()}
    sensor = LiveSensor(graph, tmp_path, **rough)
    name = f"{NAME}/check_plan"
    good = [JointState(name=list(ARM.joint_names), position=q.tolist()) for q, _ in SHOTS]
    early = graph.call(CheckHandEyePlan, name, joints=good)
    assert (early.success, early.status) == (False, Code.CONFLICT)
    assert sensor.start().success
    plan = graph.call(CheckHandEyePlan, name, joints=good)
    assert plan.success, plan.message
    assert (plan.rank, plan.unknowns) == (9, 9)
    assert 0.0 < plan.expected_error_mm < 0.5
    T = ARM.fk(SHOTS[0][0])
    poses = [pose_message(frames.transform(np.eye(3), [1e-3 * i, 0, 0]) @ T) for i in range(8)]
    bad = graph.call(CheckHandEyePlan, name, flange=poses)
    assert (bad.success, bad.status) == (False, Code.RANK_DEFICIENT), bad.message
    assert bad.unobservable
    assert "the poses do not turn" in bad.message
    assert len(bad.proposed) > 0
    both = graph.call(CheckHandEyePlan, name, flange=poses + list(bad.proposed))
    assert both.success, both.message
    for wrong in ({}, {"joints": good, "flange": poses}):
        assert graph.call(CheckHandEyePlan, name, **wrong).status == Code.BAD_INPUT


def test_triggers_do_the_same_for_a_plc(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path, capture_timeout_s=2.0)

    def call(name: str) -> tuple[bool, str]:
        told = graph.call(Trigger, f"{NAME}/{name}_trigger", within_s=30.0)
        return told.success, told.message

    sensor.robot.rest(0.1)
    assert call("capture")[1].startswith("0 CONFLICT no data set is open")
    assert call("result")[1].startswith("0 CONFLICT nothing was captured yet")
    assert call("start") == (True, "0 ACCEPT data set of a sphere (best) begun")
    for number, (q, shot) in enumerate(SHOTS[:8], 1):
        sensor.robot.move(q, 0.2)
        sensor.robot.rest(0.1)
        assert call("capture")[1].startswith(f"{number} ACCEPT")
        waits = call("result")
        assert (waits[0], waits[1].split()[:2]) == (False, [str(number), "NONE"])
        sensor.robot.rest(0.7, shot)
        sensor.ended(number)
        done = call("result")
        assert (done[0], done[1].split()[:2]) == (True, [str(number), "ACCEPT"])
    assert call("calibrate")[1].startswith("1 ACCEPT")
    assert call("accept") == (True, "1 ACCEPT revision 1: calibration 1 in force")
    assert call("rollback") == (True, "0 ACCEPT revision 2: nothing in force")
    assert call("remove") == (True, "0 ACCEPT capture 8 removed, 7 samples are left")


def test_a_plc_that_asks_while_it_is_none_hears_of_a_clock_that_jumps(
    graph: Any, sensor: LiveSensor
) -> None:
    assert sensor.start().success
    assert graph.call(Trigger, f"{NAME}/capture_trigger").success
    assert graph.call(Trigger, f"{NAME}/result_trigger").message.startswith("1 NONE waits for")
    sensor.robot.now_ns -= 60 * 10**9
    sensor.robot.rest(0.1)
    sensor.ended(1)
    told = graph.call(Trigger, f"{NAME}/result_trigger")
    assert (told.success, told.message) == (
        False,
        "1 CONFLICT the clock jumped back: capture again",
    )


def test_a_capture_comes_after_all_that_the_node_has_received(
    graph: Any, sensor: LiveSensor
) -> None:
    """A node that was busy has joint states and profiles in its queues: none of them is taken."""
    assert sensor.start().success
    assert sensor.ask_capture().success
    assert graph.call(RemoveHandEye, f"{NAME}/remove", handle=1).success
    robot = sensor.robot
    backlog = Robot(sensor.publish)
    backlog.q, backlog.now_ns = robot.q, robot.now_ns
    backlog.rest(0.9, SHOTS[1][1])
    asked = graph._clients[f"{NAME}/capture"].call_async(CaptureHandEye.Request())
    time.sleep(0.3)  # all is in the queues of the node, which does not spin, and the call too
    graph.spin_until(asked.done, "the answer")
    assert asked.result().handle == 2
    robot.now_ns = backlog.now_ns
    graph.spin_for(0.2)
    assert sensor.of(2).state == HandEyeSample.WAITING
    robot.rest(0.8, SHOTS[0][1])
    assert sensor.ended(2).state == HandEyeSample.CAPTURED
    stamp = sensor.of(2).stamp
    assert stamp.sec * 10**9 + stamp.nanosec >= backlog.now_ns


def test_what_another_process_accepts_is_not_put_below_two_parents(
    graph: Any, sensor: LiveSensor
) -> None:
    sensor.sphere(8)
    result = sensor.calibrate()
    others = graph.publisher(TFMessage, "/tf", endpoints.RELIABLE)
    wrong = TransformStamped(child_frame_id=FRAME)
    wrong.header.frame_id = "camera_rail"

    def seen() -> str:
        others.publish(TFMessage(transforms=[wrong]))
        return taken(sensor)

    graph.spin_until(seen, "the transform is seen")
    # Accepted elsewhere it is in force, but not put onto tf, and that is said.
    graph.spin_until(lambda: sensor.node._frames.settled, "it would publish")
    tf = graph.collect(TFMessage, "/tf_static", endpoints.LATCHED)
    sensor.node._history.accept(result.candidate_id, by="cli", reason="", wall_ns=1)
    graph.spin_until(lambda: sensor.status[-1].revision == 1, "it is taken over")
    graph.spin_for(0.6)
    below = [t.header.frame_id for m in tf for t in m.transforms if t.child_frame_id == FRAME]
    assert "tool0" not in below
    health = sensor.node.health()
    assert health.level == ERROR
    assert "camera_rail" in health.message


def test_bad_input_never_ends_the_node(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path, capture_timeout_s=2.0)
    points = sphere_set()[1].profiles[0]
    assert sensor.start().success

    def broken(stamp_ns: int) -> Recorded:
        cloud = profile(stamp_ns, points)
        cloud.fields["data"] = cloud.fields["data"][:40]
        return cloud

    def nameless(stamp_ns: int) -> Recorded:
        cloud = profile(stamp_ns, points)
        cloud.fields["fields"] = cloud.fields["fields"][:1]
        return cloud

    told = {
        broken: "do not hold",
        nameless: "has no field y, z",
        lambda stamp_ns: profile(stamp_ns, np.empty((0, 2))): "has 0 points",
        lambda stamp_ns: profile(stamp_ns, np.full((9, 2), np.nan)): "has 0 points",
        lambda stamp_ns: profile(stamp_ns, points, y=0.01): "beside the plane y = 0",
        lambda stamp_ns: profile(stamp_ns, points, frame=""): "the sensor's frame is 'laser'",
    }
    for shot, words in told.items():
        failed = sensor.capture(shot, 2.3)
        assert failed.state == HandEyeSample.FAILED
        assert words in failed.reason
    for request in ({"target": 9}, {"mount": 9}, {"method": "x"}, {"target_file": "none.yaml"},
                    {"feature": "x"}, {"target": HandEyeStatus.STEP}, {"mount": 2}):  # fmt: skip
        refused = sensor.start(**request)
        assert (refused.success, refused.status) == (False, Code.BAD_INPUT), request
    assert sensor.node.is_active
    assert sensor.capture(SHOTS[0][1]).state == HandEyeSample.CAPTURED


def test_a_sample_that_does_not_fit_is_rejected_by_its_handle(
    graph: Any, sensor: LiveSensor
) -> None:
    """The third profile is one of another pose."""
    quality = graph.collect(CalibrationQuality, f"{NAME}/quality", endpoints.LATCHED)
    assert sensor.start().success
    assert sensor.status[-1].header.frame_id == "tool0"
    for number, (q, shot) in enumerate(SHOTS[:10], 1):
        sensor.robot.move(q, 0.2)
        assert sensor.capture(SHOTS[11][1] if number == 3 else shot).handle == number
    result = sensor.calibrate()
    assert result.candidate_id, result.message
    assert [told.partition(":")[0] for told in result.rejected] == ["3"]
    assert result.samples == 9
    graph.spin_until(lambda: quality, "the verdict")
    assert list(quality[-1].rejected) == ["3"]


def test_the_verdict_names_the_directions_that_stay_open() -> None:
    """Without a candidate there are no figures, but the reason and the directions."""
    published: list[Any] = []
    add: Any = lambda *_: SimpleNamespace(publish=published.append)  # noqa: E731
    open_ways = {"unobservable": ["along the light", "about z"]}
    refused = Outcome(Command("calibrate"), Code.RANK_DEFICIENT, "not determined", open_ways)
    HandEyeOutputs(add, "ur10", "K7").quality(refused, "tool0")
    assert list(published[0].unobservable) == open_ways["unobservable"]
    assert (published[0].code, published[0].accept) == (Code.RANK_DEFICIENT, False)
    assert published[0].reason == "not determined"


def test_settings_reach_the_session(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path, robot_sigma_mm=0.04, robot_sigma_deg=0.01, limit_mm=0.7)
    config = sensor.node._session.config
    assert config.robot_sigma_m == pytest.approx(4e-5)
    assert config.robot_sigma_rad == pytest.approx(np.radians(0.01))
    assert config.limit_m == pytest.approx(7e-4)
    assert sensor.start(target=HandEyeStatus.CAMERA, mount=HandEyeStatus.FIXED).success
    graph.spin_until(lambda: sensor.status[-1].mount == HandEyeStatus.FIXED, "the status")
    assert sensor.status[-1].header.frame_id == "base"


def test_frames_need_names_of_their_own(graph: Any, tmp_path: Path) -> None:
    for frame in ("", "tool0"):
        node = graph.add(HandEyeNode, settings_of(tmp_path, sensor_frame=frame))
        assert node.state == "unconfigured"


def test_the_error_of_a_turn_alone_is_refused(graph: Any, tmp_path: Path) -> None:
    node = graph.add(HandEyeNode, settings_of(tmp_path, robot_sigma_deg=0.01))
    assert node.state == "unconfigured"
    assert "robot_sigma_deg is 0.01, but robot_sigma_mm is 0: give both" in node._failure.message


def test_a_status_that_cannot_be_carried_takes_no_answer_from_its_caller(
    graph: Any, sensor: LiveSensor
) -> None:
    assert sensor.start().success
    sensor.node._session.data.captures[7] = Capture(7, "", 0, NO_TEXT, Code.ACCEPT)
    assert sensor.ask_capture().handle == 1
    missing = graph.call(RemoveHandEye, f"{NAME}/remove", handle=99)
    assert (missing.success, missing.message) == (False, "no capture 99; there are 7, 1")
    gone = graph.call(RemoveHandEye, f"{NAME}/remove", handle=1)
    assert gone.message == "capture 1 removed, 0 samples are left"
    assert sensor.calibrate().status == Code.TOO_FEW_SAMPLES
    assert sensor.ask_capture().handle == 2
    assert graph.call(RemoveHandEye, f"{NAME}/remove", handle=7).success
    graph.spin_until(lambda: [s.handle for s in sensor.status[-1].samples] == [2], "the status")


def test_the_desk_answers_each_caller_though_nothing_can_be_shown(
    graph: Any, sensor: LiveSensor
) -> None:
    """Whoever uses it: an outcome that cannot be published is logged, its caller is answered."""
    assert sensor.start().success
    shown = []

    def show(outcome: Any) -> None:
        shown.append(outcome)
        sensor.node._outputs._status.publish(HandEyeStatus(last_message=NO_TEXT))

    sensor.node._desk._show = show
    assert sensor.ask_capture().handle == 1
    assert sensor.calibrate().status == Code.TOO_FEW_SAMPLES
    assert graph.call(RemoveHandEye, f"{NAME}/remove", handle=1).success
    assert [outcome.command.name for outcome in shown] == ["capture", "calibrate", "remove"]


def test_a_configured_file_counts_for_the_target_that_it_describes(
    graph: Any, sensor: LiveSensor, tmp_path: Path
) -> None:
    assert sensor.start(target=HandEyeStatus.LINE).success  # of the line nothing is known
    assert sensor.node._session.data.target == {"kind": "line"}
    assert sensor.start(target=HandEyeStatus.CAMERA).success
    assert sensor.start(target=HandEyeStatus.CAMERA, mount=HandEyeStatus.FIXED).success
    refused = sensor.start(target=HandEyeStatus.STEP)
    assert (refused.success, refused.status) == (False, Code.BAD_INPUT)
    assert "describes a sphere: name the file that describes the step" in refused.message
    line = tmp_path / "line.yaml"
    write_target(line, LineTarget(np.array([0.7, 0.0, 0.1]), np.array([1.0, 0.0, 0.0])))
    assert not sensor.start(target_file=str(line)).success  # named, so it is meant
    assert sensor.start(target=HandEyeStatus.LINE, target_file=str(line)).success
    assert sensor.node._session.data.target["point_base"] == pytest.approx([0.7, 0.0, 0.1])
    assert sensor.start().success
    assert sensor.node._session.data.target["radius_m"] == RADIUS_M


def test_joint_states_that_stop_end_a_capture(graph: Any, tmp_path: Path) -> None:
    sensor = LiveSensor(graph, tmp_path, capture_timeout_s=1.0)
    assert sensor.start().success
    assert sensor.ask_capture().success
    failed = sensor.ended(1)
    assert failed.status == Code.TOO_FEW_SAMPLES
    assert "joint states are silent" in failed.reason
    # A gripper on the same topic is no reading of this arm, and the reason says so.
    assert sensor.ask_capture().success
    for i in range(60):
        gripper = joints(sensor.robot.now_ns + i * 10**7, np.zeros(1))
        gripper.fields["name"] = ["finger"]
        sensor.give(gripper)
        graph.spin_for(0.02)
    assert "joint state has no position of" in sensor.ended(2).reason


def test_nothing_is_left_of_an_earlier_session(graph: Any, sensor: LiveSensor) -> None:
    assert sensor.start().success
    assert sensor.ask_capture().success
    events = graph.collect(SessionEvent, f"{NAME}/session_events", EVENTS)
    sensor.node.trigger_deactivate()
    graph.spin_until(lambda: sensor.status[-1].state == HandEyeStatus.IDLE, "it is idle")
    (failed,) = sensor.status[-1].samples
    assert (failed.handle, failed.state) == (1, HandEyeSample.FAILED)
    assert failed.status == Code.CONFLICT
    assert sensor.status[-1].last_message.startswith("capture 1: the node was deactivated")
    graph.spin_until(lambda: events and events[-1].command == "break_off", "the event")
    inactive = sensor.ask_capture()
    assert (inactive.success, inactive.status) == (False, Code.CONFLICT)
    sensor.node.trigger_activate()
    graph.spin_until(lambda: sensor.status[-1].state == HandEyeStatus.IDLE, "it is idle")
    sensor.robot.rest(0.8, SHOTS[0][1])
    assert list(sensor.status[-1].samples) == []
    assert sensor.ask_capture().status == Code.CONFLICT
