# SPDX-License-Identifier: Apache-2.0
"""Joint states read in blocks are those that decoding one by one gives, in the same order."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from long_form import amount
from mcap.writer import CompressionType, Writer

from robocal_ros.bags import bag_writer
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.bags.bags import BagMessage, BagReader, BagWriter
from robocal_ros.bags.mcap_files import definition as known_definition
from robocal_ros.bags.mcap_files import encode, ros_types
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import TAUGHT, JointBlock, joint_sample

JOINT_STATE = "sensor_msgs/msg/JointState"
POINT = "geometry_msgs/msg/PointStamped"
MS = 1_000_000
TOPICS = ["/joint_states", "/point"]


def read(path: Path, *, blocks: bool) -> list[BagMessage]:
    with BagReader(path) as bag:
        return list(bag.messages(TOPICS, blocks=TOPICS if blocks else ()))


def told(messages: list[BagMessage]) -> list[Any]:
    """What each message says, blocks taken apart."""
    found: list[Any] = []
    for m in messages:
        if isinstance(m.message, JointBlock):
            one_by_one = [m.message.sample(i) for i in range(len(m.message))]
        elif m.topic == "/point":
            found.append(m.message.point.x)
            continue
        else:
            one_by_one = [m.message]
        for one in one_by_one:
            try:
                sample = joint_sample(one)
                found.append((sample.stamp_ns, sample.names, sample.position.tobytes()))
            except InputError as error:
                found.append(str(error))
    return found


@st.composite
def joint_states(draw: st.DrawFn) -> dict[str, Any]:
    """A joint state of one of few layouts, now and then one that cannot be used."""
    names = draw(st.sampled_from((["a", "b"], ["a", "b"], ["joint_1", "zwölf", ""], [])))
    rng = np.random.default_rng(draw(st.integers(0, 100)))
    position = rng.normal(size=len(names) + draw(st.sampled_from((0, 0, 0, 0, 1))))
    if len(position) and draw(st.integers(0, 9)) == 0:
        position[0] = draw(st.sampled_from((np.nan, np.inf)))
    frame = draw(st.sampled_from(("", "", "", "base", TAUGHT)))
    stamp = {"sec": draw(st.integers(-3, 2**31 - 1)), "nanosec": draw(st.integers(0, 2**32 - 1))}
    velocity = np.zeros(draw(st.sampled_from((0, 0, 2))))
    return {
        "header": {"stamp": stamp, "frame_id": frame},
        "name": names,
        "position": position,
        "velocity": velocity,
    }


@settings(max_examples=amount(15, 60), deadline=None)
@given(
    runs=st.lists(st.tuples(joint_states(), st.integers(1, 9)), min_size=1, max_size=12),
    seed=st.integers(0, 1000),
)
def test_blocks_say_what_decoded_messages_say(tmp_path_factory, runs, seed):
    path, rng = tmp_path_factory.mktemp("bag") / "x.mcap", np.random.default_rng(seed)
    with BagWriter(path) as bag:
        for number, (message, count) in enumerate(runs):
            for _ in range(count):
                like = message | {"position": message["position"] + rng.integers(3)}
                bag.write("/joint_states", JOINT_STATE, like, int(rng.integers(200)) * MS)
            if rng.random() < 0.5:
                point = {"point": {"x": float(number)}}
                bag.write("/point", POINT, point, int(rng.integers(200)) * MS)
    assert told(read(path, blocks=True)) == told(read(path, blocks=False))


def write_joints(path: Path, times_ms: list[int], first: int = 0) -> None:
    with BagWriter(path) as bag:
        for i, ms in enumerate(times_ms):
            header = {"stamp": ros_time((first + i) * MS), "frame_id": ""}
            message = {"header": header, "name": ["a"], "position": [float(first + i)]}
            bag.write("/joint_states", JOINT_STATE, message, ms * MS)


def test_readings_beside_a_joint_without_a_position_come_together(tmp_path):
    """joint_state_broadcaster says NaN of a spindle that has a velocity alone."""
    with BagWriter(tmp_path / "x.mcap") as bag:
        for i in range(100):
            header = {"stamp": ros_time((1 + i) * MS), "frame_id": ""}
            position = [np.nan, 0.1 * i if i != 50 else np.nan, 2.0]
            message = {"header": header, "name": ["a_spindle", "b", "c"], "position": position}
            bag.write("/joint_states", JOINT_STATE, message, i * MS)
    found = read(tmp_path / "x.mcap", blocks=True)
    assert [(len(m.message), m.message.names) for m in found] == [
        (50, ("b", "c")),
        (1, ("c",)),
        (49, ("b", "c")),
    ]
    assert told(found) == told(read(tmp_path / "x.mcap", blocks=False))


def test_joint_states_that_follow_each_other_come_together(tmp_path):
    write_joints(tmp_path / "x.mcap", [*range(500)])
    (message,) = read(tmp_path / "x.mcap", blocks=True)
    assert (len(message.message), message.log_time_ns, message.topic) == (500, 0, "/joint_states")
    assert message.message.position.ravel().tolist() == [float(i) for i in range(500)]


def test_the_order_of_files_that_overlap_is_kept(tmp_path, monkeypatch):
    """Three files of small chunks, with the same times in more than one of them."""
    monkeypatch.setattr(bag_writer, "CHUNK_BYTES", 1500)
    rng = np.random.default_rng(3)
    recorded = []
    for number in range(3):
        times = (np.sort(rng.integers(0, 150, 120)) + rng.integers(0, 4, 120)).tolist()
        write_joints(tmp_path / f"{number}.mcap", times, first=1000 * number)
        recorded += [(ms, number, float(1000 * number + i)) for i, ms in enumerate(times)]
    blocks, singles = read(tmp_path, blocks=True), read(tmp_path, blocks=False)
    assert told(blocks) == told(singles)
    assert len(singles) == 360 > len(blocks)
    assert [m.message.position[0] for m in singles] == [value for *_, value in sorted(recorded)]


def written(path: Path, data: list[bytes], definition: str = "") -> Path:
    """A bag of joint states in other hands' bytes."""
    text = definition or known_definition(JOINT_STATE)
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start(profile="ros2", library="test")
        schema = writer.register_schema(JOINT_STATE, "ros2msg", text.encode())
        channel = writer.register_channel("/joint_states", "cdr", schema)
        for i, content in enumerate(data):
            writer.add_message(channel, log_time=i, data=content, publish_time=i)
        writer.finish()
    return path


def a_joint_state(position: float = 1.0, frame: str = "") -> bytes:
    header = {"stamp": ros_time(5), "frame_id": frame}
    message = {"header": header, "name": ["ab"], "position": [position]}
    return bytes(encode(JOINT_STATE, message))


def test_what_stands_in_padding_does_not_matter(tmp_path):
    """Serialisers leave there what was in memory before."""
    plain = a_joint_state()
    assert plain[12:16] == b"\1\0\0\0"  # frame_id is its end mark alone, then three bytes are left
    dirty = bytearray(plain)
    dirty[17] = 0xAA
    path = written(tmp_path / "x.mcap", [plain, bytes(dirty), plain])
    (message,) = read(path, blocks=True)
    assert len(message.message) == 3


def test_another_definition_of_the_type_is_obeyed(tmp_path):
    swapped = "float64 position\nstring name\n"
    data = b"\0\1\0\0" + np.float64(3.0).tobytes() + b"\2\0\0\0a\0"
    (message,) = read(written(tmp_path / "x.mcap", [data], swapped), blocks=True)
    assert (message.message.position, message.message.name) == (3.0, "a")


@pytest.mark.parametrize("cut", [3, 14, 30, -1])
def test_a_message_cut_short_is_refused_as_ever(tmp_path, cut):
    path = written(tmp_path / "x.mcap", [a_joint_state(), a_joint_state()[:cut]])
    with pytest.raises(InputError, match="is not a sensor_msgs/msg/JointState"):
        read(path, blocks=True)


def test_big_endian_joint_states_are_decoded_one_by_one(tmp_path):
    types = ros_types()
    message = types.deserialize_cdr(a_joint_state(2.0), JOINT_STATE)
    data = bytes(types.serialize_cdr(message, JOINT_STATE, little_endian=False))
    found = read(written(tmp_path / "x.mcap", [data, data]), blocks=True)
    assert [m.message.position.tolist() for m in found] == [[2.0], [2.0]]


def test_chunks_without_a_wanted_topic_are_not_read(tmp_path, monkeypatch):
    """A damaged chunk of another topic is met only when that topic is read."""
    monkeypatch.setattr(bag_writer, "CHUNK_BYTES", 2000)
    path = tmp_path / "x.mcap"
    with BagWriter(path) as bag:
        for i in range(100):
            bag.write("/point", POINT, {"point": {"x": float(i)}}, i)
        for i in range(100):
            bag.write("/joint_states", JOINT_STATE, a_joint_state(float(i)), 1000 + i)
    content = bytearray(path.read_bytes())
    content[200] ^= 0xFF  # in the first chunk
    path.write_bytes(content)
    with BagReader(path) as bag:
        assert len(list(bag.messages(["/joint_states"]))) == 100
        assert bag.info.lost == ()
        assert len(list(bag.messages(["/point"]))) < 100
        assert len(bag.info.lost) == 1
