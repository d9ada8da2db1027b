# SPDX-License-Identifier: Apache-2.0
"""Bags: written, read back, broken off, damaged, in folders, and as ROS itself reads them."""

import os
import random
import shutil
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from long_form import amount
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from rosbags import rosbag2

from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagReader, BagWriter, bag_info, read_bag
from robocal_ros.bags.mcap_files import ros_types
from robocal_ros.cli.recording import is_simulated
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import joint_sample, pose_sample

JOINTS = "sensor_msgs/msg/JointState"
POSE = "geometry_msgs/msg/PoseStamped"
NAMES = ["joint1", "joint2"]
MS = 1_000_000
GOLDEN = sorted((Path(__file__).parents[2] / "bags").glob("*.mcap"))


def joint_state(stamp_ns: int, *position: float) -> dict[str, Any]:
    header = {"stamp": ros_time(stamp_ns), "frame_id": "base"}
    return {"header": header, "name": NAMES, "position": list(position)}


def pose(stamp_ns: int, x: float) -> dict[str, Any]:
    return {
        "header": {"stamp": ros_time(stamp_ns), "frame_id": "tracker/tmac"},
        "pose": {"position": {"x": x}, "orientation": {"w": 1.0}},
    }


def write_small_bag(path: Path, messages: int = 200, **options: Any) -> None:
    """Two topics, a pose every tenth joint state; recorded a little out of order."""
    with BagWriter(path, **options) as bag:
        for i in range(messages):
            bag.write(
                "/joint_states", JOINTS, joint_state(i * MS, i, -i), i * MS + (i % 3) * 5 * MS
            )
            if i % 10 == 0:
                bag.write("/measured_pose", POSE, pose(i * MS, i), i * MS)


@pytest.fixture
def small_bag(tmp_path: Path) -> Path:
    write_small_bag(tmp_path / "small.mcap")
    return tmp_path / "small.mcap"


def test_messages_come_back_in_log_time_order(small_bag: Path) -> None:
    messages = list(read_bag(small_bag))
    assert len(messages) == 220
    times = [message.log_time_ns for message in messages]
    assert times == sorted(times)
    joints = [m.message for m in messages if m.topic == "/joint_states"]
    samples = [joint_sample(message) for message in joints]
    assert {sample.stamp_ns for sample in samples} == {i * MS for i in range(200)}
    assert all(sample.names == ("joint1", "joint2") for sample in samples)
    assert all(s.position.tolist() == [s.stamp_ns / MS, -s.stamp_ns / MS] for s in samples)
    poses = [m for m in messages if m.topic == "/measured_pose"]
    assert {m.msgtype for m in poses} == {POSE}
    sample = pose_sample(poses[3].message)
    assert (sample.frame, sample.target, sample.stamp_ns) == ("tracker", "tmac", 30 * MS)
    assert sample.position_m[0] == 30.0


def test_topics_can_be_chosen(small_bag: Path) -> None:
    assert len(list(read_bag(small_bag, ["/measured_pose"]))) == 20
    assert len(list(read_bag(small_bag, {"/measured_pose": None, "/absent": None}))) == 20
    assert list(read_bag(small_bag, ["/absent"])) == []


def test_info(small_bag: Path) -> None:
    info = bag_info(small_bag)
    assert info.topics == {"/joint_states": (JOINTS, 200), "/measured_pose": (POSE, 20)}
    assert (info.start_ns, info.end_ns, info.messages) == (0, 207 * MS, 220)
    assert not info.truncated
    assert info.notes == ()


def test_raw_messages_are_copied_bit_for_bit(small_bag: Path, tmp_path: Path) -> None:
    raw = list(read_bag(small_bag, raw=True))
    copy = tmp_path / "copy.mcap"
    with BagWriter(copy, compression="lz4") as bag:
        for message in raw:
            bag.write(message.topic, message.msgtype, message.message, message.log_time_ns)
    assert list(read_bag(copy, raw=True)) == raw
    assert all(isinstance(message.message, bytes) for message in raw)


def write_with_mcap(source: Path, target: Path, **options: Any) -> None:
    """Write a bag's messages as another recorder might."""
    with source.open("rb") as stream, target.open("wb") as output:
        reader = make_reader(stream)
        writer = Writer(output, chunk_size=2000, **options)
        writer.start(profile="ros2", library="another recorder")
        schemas: dict[str, int] = {}
        channels: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.topic not in channels:
                key = schema.name
                schemas[key] = writer.register_schema(key, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, "cdr", schemas[key], channel.metadata
                )
            writer.add_message(
                channels[channel.topic], message.log_time, message.data, message.publish_time
            )
        writer.finish()


@pytest.mark.parametrize(
    "options",
    [
        {"index_types": IndexType.NONE, "use_statistics": False, "use_summary_offsets": False},
        {"use_chunking": False},
        {"use_chunking": False, "use_statistics": False, "index_types": IndexType.NONE},
        {"repeat_channels": False, "repeat_schemas": False},
        {"compression": CompressionType.NONE, "enable_crcs": False},
        {"compression": CompressionType.LZ4, "use_statistics": False},
    ],
    ids=["no index", "no chunks", "nothing", "no repeats", "plain", "no statistics"],
)
def test_bags_of_other_recorders(small_bag: Path, tmp_path: Path, options: dict[str, Any]) -> None:
    other = tmp_path / "other.mcap"
    write_with_mcap(small_bag, other, **options)
    assert list(read_bag(other, raw=True)) == list(read_bag(small_bag, raw=True))
    assert bag_info(other).topics == bag_info(small_bag).topics
    assert not bag_info(other).truncated


def test_messages_that_a_recorder_compressed_one_by_one_are_read(
    small_bag: Path, tmp_path: Path
) -> None:
    """As of ``ros2 bag record -s mcap --compression-mode message --compression-format zstd``."""
    plain = list(read_bag(small_bag, raw=True))
    folder = tmp_path / "bag"
    writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.MESSAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        topics = {
            topic: writer.add_connection(topic, msgtype, typestore=ros_types())
            for topic, msgtype in {(m.topic, m.msgtype) for m in plain}
        }
        for message in plain:
            writer.write(topics[message.topic], message.log_time_ns, message.message)
    assert list(read_bag(folder, raw=True)) == plain
    assert len(list(read_bag(folder, ["/measured_pose"]))) == 20
    with BagReader(folder) as bag:
        found = bag.messages(["/joint_states"], blocks=["/joint_states"])
        assert sum(len(block.message) for block in found) == 200


@pytest.mark.parametrize("use_chunking", [True, False])
def test_a_bag_cut_anywhere_is_read_as_far_as_it_goes(
    small_bag: Path, tmp_path: Path, use_chunking: bool
) -> None:
    whole_file = tmp_path / "whole.mcap"
    write_with_mcap(small_bag, whole_file, use_chunking=use_chunking)
    data = whole_file.read_bytes()
    with small_bag.open("rb") as stream:
        stored = [m for _, _, m in make_reader(stream).iter_messages(log_time_order=False)]
    cut = tmp_path / "cut.mcap"
    counts = []
    for length in sorted(random.Random(2).sample(range(9, len(data) - 8), amount(15, 60))):
        cut.write_bytes(data[:length])
        try:
            with BagReader(cut) as bag:
                info = bag.info
                found = [message.message for message in bag.messages(raw=True)]
        except InputError:  # before its first message
            assert not counts
            continue
        assert info.truncated
        assert "broke off" in info.notes[0]
        assert sorted(found) == sorted(message.data for message in stored[: len(found)])
        assert info.messages == len(found)
        counts.append(len(found))
    assert counts == sorted(counts)
    assert counts[0] < 60
    assert counts[-1] == 220


@pytest.mark.parametrize(("length", "at"), [(8, 8), (20, 8), (200, 46), (700, 46)])
def test_a_bag_cut_before_its_first_message_is_refused(
    small_bag: Path, tmp_path: Path, length: int, at: int
) -> None:
    """The header ends at byte 46; then comes the first chunk."""
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(small_bag.read_bytes()[:length])
    words = f"broke off at byte {at} before any message; nothing can be read"
    with pytest.raises(InputError, match=words) as caught:
        bag_info(cut)
    assert caught.value.file == str(cut)


def test_a_last_file_without_a_message_loses_the_others_nothing(
    small_bag: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "split"
    folder.mkdir()
    shutil.copy(small_bag, folder / "split_0.mcap")
    (folder / "split_1.mcap").write_bytes(small_bag.read_bytes()[:200])
    with pytest.warns(UserWarning, match="broke off"):
        assert len(list(read_bag(folder))) == 220


def test_zeros_after_a_power_cut_are_told(small_bag: Path) -> None:
    data = small_bag.read_bytes()
    footer = data.rindex(b"\x02\x14\x00\x00\x00\x00\x00\x00\x00")
    small_bag.write_bytes(data[:footer] + bytes(4096))
    with pytest.warns(UserWarning, match="broke off"):
        assert len(list(read_bag(small_bag))) == 220


def test_a_recorder_that_is_killed_loses_little(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    script = (
        "import sys, time\n"
        "from robocal_ros.bags.bags import BagWriter\n"
        "bag = BagWriter(sys.argv[1])\n"
        "for i in range(10**9):\n"
        "    message = {'name': ['a'], 'position': [i], 'header': {'stamp': {'nanosec': i}}}\n"
        "    bag.write('/joint_states', 'sensor_msgs/msg/JointState', message, i)\n"
        "    if i == 20000: print('ready', flush=True)\n"
        "    if i > 20000: time.sleep(1e-4)\n"
    )
    command = [sys.executable, "-c", script, str(path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as recorder:
        assert recorder.stdout is not None
        assert recorder.stdout.readline() == "ready\n"
        os.kill(recorder.pid, signal.SIGKILL)
    with pytest.warns(UserWarning, match="broke off"):
        found = [message.message.position[0] for message in read_bag(path)]
    assert found == list(range(len(found)))
    assert len(found) > 15_000


def damage(path: Path, which: slice) -> list[tuple[int, int]]:
    """Turn one bit in the content of the chunks ``which``; return their first and last times."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    data = bytearray(path.read_bytes())
    chunks = summary.chunk_indexes[which]
    for chunk in chunks:
        data[chunk.chunk_start_offset + chunk.chunk_length - 20] ^= 0x10
    path.write_bytes(data)
    return [(chunk.message_start_time, chunk.message_end_time) for chunk in chunks]


@pytest.mark.filterwarnings("ignore:.*the recording broke off")
@pytest.mark.parametrize("cut", [False, True], ids=["with index", "broken off"])
@pytest.mark.parametrize("which", [slice(3, 5), slice(-1, None)])
def test_a_damaged_chunk_is_left_out_and_told(
    small_bag: Path, tmp_path: Path, which: slice, cut: bool
) -> None:
    path = tmp_path / "damaged.mcap"
    write_with_mcap(small_bag, path)
    whole = list(read_bag(path, raw=True))
    lost = damage(path, which)
    if cut:
        path.write_bytes(path.read_bytes()[:-300])
    with BagReader(path) as bag:
        found = list(bag.messages(raw=True))
        again = list(bag.messages(raw=True))
        info = bag.info
    assert found == again
    missing = [message for message in whole if message not in found]
    assert len(found) + len(missing) == len(whole)
    assert 0 < len(missing) < 20 * len(lost) < len(found)
    assert [(gap.from_ns, gap.to_ns) for gap in info.lost] == lost
    times = {m.log_time_ns for m in missing}
    assert min(times) == min(start for start, _ in lost)
    assert max(times) == max(end for _, end in lost)
    assert info.truncated == cut
    told = [note for note in info.notes if "damaged chunk is left out" in note]
    assert len(told) == len(lost)
    assert "1970-01-01T00:00:00." in told[0]
    with pytest.warns(UserWarning, match="damaged chunk is left out"):
        assert list(read_bag(path, raw=True)) == found


def test_messages_whose_topic_is_lost_are_told(tmp_path: Path) -> None:
    """A chunk describes a topic that begins in it; the index repeats that, but is cut off."""
    source, path = tmp_path / "source.mcap", tmp_path / "damaged.mcap"
    with BagWriter(source) as bag:
        for i in range(200):
            bag.write("/joint_states", JOINTS, joint_state(i * MS, i, -i), i * MS)
            if i >= 100:
                bag.write("/measured_pose", POSE, pose(i * MS, i), i * MS)
    write_with_mcap(source, path)
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    topics = [len(chunk.message_index_offsets) for chunk in summary.chunk_indexes]
    first = topics.index(2)
    ((start_ns, end_ns),) = damage(path, slice(first, first + 1))
    path.write_bytes(path.read_bytes()[:-300])
    with BagReader(path) as bag:
        found = list(bag.messages())
        (note,) = [note for note in bag.info.notes if "names of their topics" in note]
    joints = range(start_ns // MS), range(end_ns // MS, 200)
    assert {message.topic for message in found} == {"/joint_states"}
    assert abs(len(found) - sum(map(len, joints))) <= 1  # the two topics share a time
    assert abs(int(note.split()[1]) - len(joints[1])) <= 1


@pytest.mark.filterwarnings("ignore:.*the recording broke off")
@pytest.mark.parametrize("cut", [0, 300], ids=["with index", "broken off"])
def test_a_bag_of_nothing_but_damage_is_refused(small_bag: Path, tmp_path: Path, cut: int) -> None:
    path = tmp_path / "damaged.mcap"
    write_with_mcap(small_bag, path)
    count = len(damage(path, slice(None)))
    path.write_bytes(path.read_bytes()[: -cut or None])
    with pytest.raises(InputError, match=rf"nothing in this bag .* chunks: {count} \("):
        list(read_bag(path))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "nothing was recorded"),
        (b"q1_deg,x_mm\n1,2\n", "not an MCAP file"),
        (b"SQLite format 3\0" + bytes(100), "ros2 bag convert"),
        (b"#ROSBAG V2.0\n", "ROS 1"),
    ],
)
def test_other_files_are_refused(tmp_path: Path, content: bytes, words: str) -> None:
    path = tmp_path / "other.mcap"
    path.write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        bag_info(path)
    assert caught.value.file == str(path)


def test_a_missing_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such bag"):
        bag_info(tmp_path / "none.mcap")
    with pytest.raises(InputError, match=r"no metadata\.yaml"):
        bag_info(tmp_path)


def write_folder(folder: Path, **changes: Any) -> None:
    """A bag of two files, as ``ros2 bag record --max-bag-duration`` splits it."""
    folder.mkdir()
    for number in range(2):
        with BagWriter(folder / f"part_{number}.mcap") as bag:
            for i in range(number * 10, number * 10 + 12):  # the parts overlap in time
                bag.write("/joint_states", JOINTS, joint_state(i * MS, i, 0), i * MS)
    information = {
        "version": 9,
        "storage_identifier": "mcap",
        "relative_file_paths": ["part_0.mcap", "part_1.mcap"],
        "compression_mode": "",
    } | changes
    text = yaml.safe_dump({"rosbag2_bagfile_information": information})
    (folder / "metadata.yaml").write_text(text)


def test_a_folder_of_several_files(tmp_path: Path) -> None:
    write_folder(tmp_path / "bag")
    messages = list(read_bag(tmp_path / "bag"))
    assert [m.log_time_ns // MS for m in messages] == sorted([*range(12), *range(10, 22)])
    info = bag_info(tmp_path / "bag")
    assert info.topics == {"/joint_states": (JOINTS, 24)}
    assert (info.start_ns, info.end_ns) == (0, 21 * MS)


@pytest.mark.parametrize("empty", [False, True])
def test_a_folder_whose_recording_broke_off(tmp_path: Path, *, empty: bool) -> None:
    write_folder(tmp_path / "bag")
    metadata = tmp_path / "bag" / "metadata.yaml"
    if empty:  # as a power cut may leave it
        metadata.write_bytes(b"")
    else:
        metadata.unlink()
    with pytest.warns(UserWarning, match=r"no metadata\.yaml"):
        assert len(list(read_bag(tmp_path / "bag"))) == 24


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"storage_identifier": "sqlite3"}, "ros2 bag convert"),
        ({"compression_mode": "FILE"}, "compressed as whole files"),
        ({"relative_file_paths": []}, "no files"),
        ({"relative_file_paths": None}, "ros2 bag reindex"),
        ({"relative_file_paths": ["lost.mcap"]}, "no such bag"),
    ],
)
def test_folders_that_cannot_be_read(tmp_path: Path, changes: dict[str, Any], words: str) -> None:
    write_folder(tmp_path / "bag", **changes)
    with pytest.raises(InputError, match=words):
        bag_info(tmp_path / "bag")


def test_own_messages_need_no_ros(tmp_path: Path) -> None:
    event = {"stamp": ros_time(5), "sequence": 3, "command": "identify", "arguments": "{}"}
    path = tmp_path / "events.mcap"
    with BagWriter(path, latched=["~/session_events"]) as bag:
        bag.write("~/session_events", "robocal_msgs/msg/SessionEvent", event, 5)
        bag.write("~/model", "robocal_msgs/msg/KinematicModel", {"d": [1.0, 2.0]}, 6)
    messages = [message.message for message in read_bag(path)]
    assert (messages[0].command, messages[0].sequence, messages[0].outcome) == ("identify", 3, "")
    assert messages[1].d.tolist() == [1.0, 2.0]
    assert messages[1].base_root.rotation.w == 0.0


def test_types_come_from_the_bag_itself(tmp_path: Path) -> None:
    """A bag of a package that is not installed, whose type even has the name of a known one."""
    path = tmp_path / "own.mcap"
    definition = b"float64 left\nfloat64 right\n"
    with path.open("wb") as output:
        writer = Writer(output)
        writer.start(profile="ros2", library="test")
        for number, name in enumerate(("my_msgs/msg/Pair", "geometry_msgs/msg/Point32")):
            schema = writer.register_schema(name, "ros2msg", definition)
            channel = writer.register_channel(f"/{number}", "cdr", schema)
            data = b"\0\1\0\0" + np.array([1.5, number], "<f8").tobytes()
            writer.add_message(channel, 10, data, 10)
        writer.finish()
    messages = list(read_bag(path))
    assert [(m.message.left, m.message.right) for m in messages] == [(1.5, 0.0), (1.5, 1.0)]


@pytest.mark.parametrize(
    ("schema", "encoding", "data", "words"),
    [
        (b"float64 x\n", "json", b"{}", "encoded as 'json'"),
        (b"", "cdr", b"\0\1\0\0", "definition of my_msgs/msg/Pair"),
        (b"float64 a b c d\n[", "cdr", b"\0\1\0\0", "definition of my_msgs/msg/Pair"),
        (b"float64 x\n", "cdr", b"\0\1\0\0\0\0", "is not a my_msgs/msg/Pair"),
    ],
)
def test_what_cannot_be_decoded_is_told(
    tmp_path: Path, schema: bytes, encoding: str, data: bytes, words: str
) -> None:
    path = tmp_path / "strange.mcap"
    with path.open("wb") as output:
        writer = Writer(output)
        writer.start(profile="ros2", library="test")
        number = writer.register_schema("my_msgs/msg/Pair", "ros2msg", schema)
        channel = writer.register_channel("/pair", encoding, number)
        writer.add_message(channel, 10, data, 10)
        writer.finish()
    with pytest.raises(InputError, match=words):
        list(read_bag(path))
    assert len(list(read_bag(path, raw=True))) == 1


def test_a_standard_type_without_its_definition(small_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "bare.mcap"
    message = next(iter(read_bag(small_bag, ["/measured_pose"], raw=True)))
    with path.open("wb") as output:
        writer = Writer(output)
        writer.start(profile="ros2", library="test")
        channel = writer.register_channel("/p", "cdr", writer.register_schema(POSE, "", b""))
        writer.add_message(channel, 10, message.message, 10)
        writer.finish()
    assert pose_sample(next(read_bag(path)).message).target == "tmac"


def test_objects_with_the_attributes_of_a_message_are_written(tmp_path: Path) -> None:
    point = SimpleNamespace(x=1.0, y=2.0, z=np.float64(3.0))
    stamp = SimpleNamespace(sec=1, nanosec=2)
    message = SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="f"), point=point)
    with BagWriter(tmp_path / "p.mcap") as bag:
        bag.write("/p", "geometry_msgs/msg/PointStamped", message, 1)
    back = next(read_bag(tmp_path / "p.mcap")).message
    assert (back.point.x, back.point.z, back.header.stamp.nanosec) == (1.0, 3.0, 2)


def test_mistakes_of_a_caller(tmp_path: Path) -> None:
    with BagWriter(tmp_path / "b.mcap") as bag:
        with pytest.raises(ValueError, match="no field 'positions'"):
            bag.write("/j", JOINTS, {"positions": [1.0]}, 1)
        with pytest.raises(InputError, match="nav_msgz/msg/Odometry is not known"):
            bag.write("/o", "nav_msgz/msg/Odometry", {}, 1)
    with pytest.raises(InputError, match="cannot be written"):
        BagWriter(tmp_path / "absent" / "b.mcap")


def test_what_a_player_looks_for(small_bag: Path, tmp_path: Path) -> None:
    path = tmp_path / "q.mcap"
    write_small_bag(path, latched=["/measured_pose"])
    with path.open("rb") as stream:
        reader = make_reader(stream)
        assert reader.get_header().profile == "ros2"
        summary = reader.get_summary()
    assert summary is not None
    assert summary.statistics is not None
    qos = {
        channel.topic: yaml.safe_load(channel.metadata["offered_qos_profiles"])[0]
        for channel in summary.channels.values()
    }
    assert {topic: profile["durability"] for topic, profile in qos.items()} == {
        "/joint_states": 2,
        "/measured_pose": 1,
    }
    assert all(schema.encoding == "ros2msg" for schema in summary.schemas.values())
    assert all(b"MSG: std_msgs/Header" in schema.data for schema in summary.schemas.values())


@pytest.mark.ros
def test_the_messages_are_those_of_ros(tmp_path: Path) -> None:
    import rclpy.serialization
    import robocal_msgs.msg
    from geometry_msgs.msg import PoseStamped
    from sensor_msgs.msg import JointState

    for name in ("AccuracyState", "BeamEvent", "CalibrationQuality", "KinematicModel"):
        own = getattr(robocal_msgs.msg, name)
        fields = [field for field, _ in ros_types().fielddefs[f"robocal_msgs/msg/{name}"][1]]
        assert fields == list(own.get_fields_and_field_types())
    state = JointState(name=NAMES, position=[0.5, 1.5])
    state.header.stamp.sec = 7
    pose_message = PoseStamped()
    pose_message.pose.orientation.w = 0.25
    path = tmp_path / "ros.mcap"
    with BagWriter(path) as bag:
        bag.write("/joint_states", JOINTS, state, 1)
        bag.write("/pose", POSE, pose_message, 2)
    for recorded, original in zip(read_bag(path, raw=True), (state, pose_message), strict=True):
        back = rclpy.serialization.deserialize_message(recorded.message, type(original))
        assert back == original


@pytest.mark.parametrize("path", GOLDEN, ids=lambda path: path.stem)
def test_golden_bags_say_that_they_are_simulated(path):
    with BagReader(path) as bag:
        assert is_simulated(bag)
