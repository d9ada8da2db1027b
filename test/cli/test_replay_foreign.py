# SPDX-License-Identifier: Apache-2.0
"""Bags that others recorded: ROS 1, SQLite, any names, a tracker that streams by its own clock."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import conforms
from foreign_bags import (
    BODY_TOPIC,
    CLOCK_AHEAD_S,
    JOINT_TOPIC,
    LATENCY_S,
    stream,
    visits,
    write_ros1,
    write_sqlite,
)
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.typesys import Stores, get_typestore
from scipy.spatial.transform import Rotation

from robocal_ros.bags.bags import BagMessage, open_bag
from robocal_ros.bags.foreign import StreamAverage, StreamTiming, delay_between
from robocal_ros.cli.main import main
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import PointSample

NS = 1_000_000_000
POSE = f"measured_pose:={BODY_TOPIC}"


@pytest.fixture(scope="module")
def recorded():
    return list(stream())


@pytest.fixture(scope="module")
def ros1(recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_ros1(tmp_path_factory.mktemp("ros1") / "shift.bag", recorded)


@pytest.fixture(scope="module")
def sqlite(recorded, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_sqlite(tmp_path_factory.mktemp("ros2") / "shift", recorded)


def replayed(capsys: pytest.CaptureFixture[str], *arguments: object) -> tuple[int, Any]:
    status = main(["replay", *map(str, arguments), "--json"])
    document = json.loads(capsys.readouterr().out)
    conforms(document, "error.json" if status else "replay.json")
    return status, document


@pytest.fixture(scope="module")
def shift(ros1) -> Any:
    """The document of the ROS 1 bag, without a capture that lasts longer than a test."""
    from functools import partial

    from robocal_ros.cli.recording import find_robot
    from robocal_ros.cli.replay import ReplayRequest, replay_bag

    request = ReplayRequest(
        bag=ros1, find_robot=partial(find_robot, "kr150_r3100", []), robot_named=True, auto=True,
        topics={"measured_pose": BODY_TOPIC},
    )  # fmt: skip
    return replay_bag(request, lambda _, recording: recording.blocks())


def test_messages_of_ros1_and_of_sqlite_are_what_was_recorded(recorded, ros1, sqlite):
    for path in (ros1, sqlite, next(sqlite.glob("*.db3"))):
        with open_bag(path) as bag:
            found = bag.info
            assert found.topics[JOINT_TOPIC].msgtype == "sensor_msgs/msg/JointState"
            assert found.messages == len(recorded)
            assert (found.start_ns, found.end_ns) == (recorded[0][0], recorded[-1][0])
            joints = list(bag.messages([JOINT_TOPIC]))
        wanted = [one for one in recorded if one[1] == JOINT_TOPIC]
        assert [m.log_time_ns for m in joints] == [one[0] for one in wanted]
        assert np.array_equal(
            [m.message.position for m in joints], [one[3]["position"] for one in wanted]
        )


def test_the_visits_of_a_stream_are_its_cycles_and_its_clock_is_found(shift):
    """A standstill of two seconds is one measurement, however often the tracker measured."""
    assert len(shift["candidates"]) == len(visits()) - 1
    timing = shift["streams"][BODY_TOPIC]
    later_s = timing["clock_ns"] * 1e-9 + timing["latency_s"]
    # Those that were held back come later than the rest, by 0.2 s in the mean of a fifth of them.
    held_s = 0.2 * 0.2
    away = later_s - (CLOCK_AHEAD_S + LATENCY_S)
    assert -3 * timing["latency_sigma_s"] < away < held_s + 3 * timing["latency_sigma_s"]
    assert timing["burst"] > 10
    for candidate in shift["candidates"]:
        assert candidate["verdict"]["accept"]
        found = candidate["calibrated"]
        # Some thirty coordinates: their rms is not twice what it is expected to be.
        assert found["held_out"]["rms_mm"] < 2.0 * found["predicted"]["total_rms_mm"]
        assert found["held_out"]["rms_mm"] < candidate["in_force"]["held_out"]["rms_mm"]


def test_reasons_have_their_numbers(shift):
    reasons = [reason for told in shift["ignored_reasons"].values() for reason in told]
    assert any("moved by" in reason for reason in reasons)
    assert not any("#" in reason for reason in reasons)


def test_sqlite_gives_what_ros1_gives(shift, sqlite, capsys):
    status, document = replayed(capsys, sqlite, "--robot", "kr150_r3100", "--auto", "--topic", POSE)
    assert status == 0
    assert document["candidates"] == json.loads(json.dumps(shift["candidates"]))


def test_a_stream_of_others_is_validated_with_a_forecast_of_each_cycle(ros1, tmp_path, capsys):
    words = ("--robot", "kr150_r3100", "--topic", POSE, "--report", str(tmp_path / "report"))
    assert main(["validate", str(ros1), *words]) == 0, capsys.readouterr().out
    (bag,) = json.loads((tmp_path / "report" / "report.json").read_text())["bags"]
    (session,) = bag["sessions"]
    assert len(session["cycles"]) == len(visits()) - 1
    assert all(cycle["forecast"] is not None for cycle in session["cycles"])


def test_what_is_missing_is_said_with_the_topic_that_could_be_it(ros1, capsys):
    status, document = replayed(capsys, ros1, "--robot", "kr150_r3100", "--auto")
    assert status == 2
    assert f"of such a type: {BODY_TOPIC}" in document["error"]["message"]


def test_a_topic_of_another_type_is_refused_by_its_type(ros1, capsys):
    status, document = replayed(
        capsys, ros1, "--robot", "kr150_r3100", "--auto",
        "--topic", f"measured_pose:={JOINT_TOPIC}",
    )  # fmt: skip
    assert status == 2
    assert "is of type sensor_msgs/msg/JointState" in document["error"]["message"]


def test_a_topic_of_another_type_with_an_inputs_name_is_none(recorded, tmp_path, capsys):
    path, store = tmp_path / "named.bag", get_typestore(Stores.ROS1_NOETIC)
    text = store.types["std_msgs/msg/String"](data="none")
    with Ros1Writer(path) as writer:
        note = writer.add_connection("/joint_states", "std_msgs/msg/String", typestore=store)
        writer.write(note, 1, store.serialize_ros1(text, "std_msgs/msg/String"))
    status, document = replayed(capsys, path, "--robot", "kr150_r3100", "--auto")
    assert status == 2
    assert "no joint states; it has /joint_states" in document["error"]["message"]


def test_events_are_those_of_their_type(recorded, tmp_path, capsys):
    odd = [(at, "/n/session_events" if t == BODY_TOPIC else t, kind, fields)
           for at, t, kind, fields in recorded[:500]]  # fmt: skip
    path = write_ros1(tmp_path / "odd.bag", odd)
    status, document = replayed(capsys, path, "--robot", "kr150_r3100", "--auto")
    assert status == 2
    assert "no measurement at standstill" in document["error"]["message"]
    given = f"session_events:={JOINT_TOPIC}"
    status, document = replayed(capsys, path, "--robot", "kr150_r3100", "--auto", "--topic", given)
    assert status == 2
    assert "is read from robocal_msgs/msg/SessionEvent" in document["error"]["message"]


def test_files_that_were_recorded_side_by_side_come_in_one_order(recorded, tmp_path):
    some = recorded[:1000]
    for name in (JOINT_TOPIC, BODY_TOPIC):
        write_ros1(tmp_path / f"{name[1:4]}.bag", [one for one in some if one[1] == name])
    with open_bag(tmp_path) as bag:
        found = [(one.log_time_ns, one.topic) for one in bag.messages()]
    assert sorted(found) == sorted((at, topic) for at, topic, _, _ in some)
    stamps = [at for at, _ in found]
    assert stamps == sorted(stamps)


def test_damage_within_a_bag_is_told(recorded, tmp_path):
    data = write_ros1(tmp_path / "whole.bag", recorded[:300]).read_bytes()
    rng, refused = np.random.default_rng(4), 0
    for _ in range(30):
        damaged = bytearray(data)
        for place in rng.integers(4200, len(data), 20):
            damaged[place] = rng.integers(256)
        path = tmp_path / "damaged.bag"
        path.write_bytes(bytes(damaged))
        try:
            with open_bag(path) as bag:
                assert len(list(bag.messages())) <= 300
        except InputError:
            refused += 1
    assert refused


@pytest.mark.parametrize("name", ["cut.bag", "none.bag", "cut.db3"])
def test_what_is_no_bag_is_told(ros1, tmp_path, name):
    path = tmp_path / name
    if name.startswith("cut"):
        path.write_bytes(ros1.read_bytes()[:100_000])
    words = f"{name}: {'cannot be read' if name.startswith('cut') else 'there is no such file'}"
    with pytest.raises(InputError, match=words):
        open_bag(path)


@pytest.mark.data
def test_delays_of_streams_that_others_recorded(data_dir):
    """Arm and camera, body and camera: an added delay comes out to a tenth of a camera's frame.

    Its delay was 0.000 s for those who recorded the arm, by frames of 33 ms.
    """
    folder = data_dir / "eth_hand_eye"
    for first, other in [
        ("real/*base_link_sr300_hinge.csv", "real/*target_ir.csv"),
        ("vicon/*vicon_prime_sense.csv", "vicon/*image_raw.csv"),
        ("sim/*hand.csv", "sim/*camera.csv"),
    ]:
        tables = [np.loadtxt(next(folder.glob(name)), delimiter=",") for name in (first, other)]
        stamps = [np.round((t[:, 0] - tables[0][0, 0]) * 1e9).astype(np.int64) for t in tables]
        turns = [Rotation.from_quat(t[:, 4:8]).as_matrix().reshape(-1, 9) for t in tables]
        plain = delay_between(stamps[0], turns[0], stamps[1], turns[1])
        later = delay_between(stamps[0], turns[0], stamps[1] + 370_000_000, turns[1])
        assert plain is not None
        assert later is not None
        assert abs(plain[0]) < 0.0334
        assert later[0] - plain[0] == pytest.approx(0.37, abs=0.0033)
        assert 0.0 < plain[1] < 0.0334


def test_motions_that_are_not_one_have_no_delay():
    rng, at_ns = np.random.default_rng(2), np.arange(0, 60 * NS, NS // 50)
    walks = [np.cumsum(np.repeat(rng.normal(size=(300, 3)), 10, axis=0), axis=0) for _ in range(2)]
    assert delay_between(at_ns, walks[0], at_ns, walks[1]) is None
    assert delay_between(at_ns, np.zeros((3000, 3)), at_ns, np.zeros((3000, 3))) is None
    assert "follows something else" in StreamTiming(50.0).words("/ball")


def test_a_second_of_a_stream_is_one_measurement_without_what_was_lost():
    """A reflector that is lost gives zeros."""
    rng = np.random.default_rng(3)
    true, sigma_m = np.array([1.0, -2.0, 0.5]), 2e-5
    samples = [
        PointSample(10 * NS + i * NS // 100, "hall", "ball", true + sigma_m * rng.normal(size=3))
        for i in range(100)
    ]
    samples[40] = PointSample(samples[40].stamp_ns, "hall", "ball", np.zeros(3))
    average = StreamAverage({"/ball": "measured_point"}, {"/ball": StreamTiming(100.0, 5 * NS)})
    (one,) = average.of(BagMessage("/ball", "", s.stamp_ns, s) for s in samples)
    assert np.abs(one.message.position_m - true).max() < 5 * sigma_m / np.sqrt(99)
    assert one.message.sigma_m == pytest.approx(sigma_m / np.sqrt(99), rel=0.2)
    assert abs(one.message.stamp_ns - (5.5 * NS)) < 0.01 * NS


def test_what_was_measured_before_a_stream_ended_comes_soon_after():
    """Not when it goes on, minutes later: nobody knows any more where the joints were then."""
    ball = [
        BagMessage("/ball", "", at_ns, PointSample(at_ns, "hall", "ball", np.zeros(3)))
        for at_ns in range(10 * NS, 10 * NS + NS // 2, NS // 100)
    ]
    joints = [BagMessage("/joints", "", i * NS // 10, i) for i in range(300)]
    messages = sorted(ball + joints, key=lambda one: one.log_time_ns)
    average = StreamAverage({"/ball": "measured_point"}, {"/ball": StreamTiming(100.0)})
    found = list(average.of(messages))
    place = [one.topic for one in found].index("/ball")
    assert found[place].message.stamp_ns == pytest.approx(10.245 * NS)
    assert found[place - 1].log_time_ns <= 13 * NS
    assert [one.message for one in found if one.topic == "/joints"] == list(range(300))
    assert len(found) == 301
