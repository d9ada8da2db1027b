# SPDX-License-Identifier: Apache-2.0
"""Recordings: complete and broken off, and split."""

import os
import resource

import pytest
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from robocal_ros.bags.bag_writer import BagRecording
from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.mcap_files import encode
from robocal_ros.ground.errors import StorageError

BOOL, TEXT = "std_msgs/msg/Bool", "std_msgs/msg/String"
FILE_BYTES = 20_000


def text(number: int) -> bytes:
    noise = os.urandom(200).hex()  # does not compress away
    return bytes(encode(TEXT, {"data": f"{number} {noise}"}))


def fill(recording: BagRecording, count: int, start: int = 0) -> None:
    for i in range(start, start + count):
        recording.write("/words", TEXT, text(i), 1_000_000_000 + i)
        if i % 20 == 0:
            recording.flush()


def numbers(folder) -> list[int]:
    with BagReader(folder) as bag:
        return [int(m.message.data.split()[0]) for m in bag.messages(["/words"])]


def test_nothing_is_lost_between_files_and_each_is_of_its_size(tmp_path):
    latched = set()
    with BagRecording(tmp_path / "r", latched=latched, file_bytes=FILE_BYTES) as recording:
        fill(recording, 300)
        latched.add("/open")
        recording.write("/open", BOOL, bytes(encode(BOOL, {"data": True})), 2_000_000_000)
    files = sorted((tmp_path / "r").glob("*.mcap"))
    assert len(files) > 3
    # a file is full with the first chunk that passes the size: twenty messages, each below 600 B
    assert all(file.stat().st_size < FILE_BYTES + 20 * 600 + 4000 for file in files)
    assert numbers(tmp_path / "r") == list(range(300))
    with BagReader(tmp_path / "r") as bag:
        assert not bag.info.notes
        assert bag.info.messages == recording.messages == 301


def test_another_reader_of_ros2_bags_takes_the_folder(tmp_path):
    with BagRecording(tmp_path / "r", latched={"/words"}, file_bytes=FILE_BYTES) as recording:
        fill(recording, 120)
    store = get_typestore(Stores.ROS2_JAZZY)
    with AnyReader([tmp_path / "r"], default_typestore=store) as reader:
        assert reader.message_count == 120
        found = [reader.deserialize(raw, c.msgtype).data for c, _, raw in reader.messages()]
        profile = reader.connections[0].ext.offered_qos_profiles[0]
    assert [int(words.split()[0]) for words in found] == list(range(120))
    assert profile.durability.name == "TRANSIENT_LOCAL"


def test_what_was_flushed_is_there_after_a_crash(tmp_path):
    recording = BagRecording(tmp_path / "r", latched=(), file_bytes=FILE_BYTES)
    fill(recording, 130)
    recording.flush()
    fill(recording, 7, start=130)  # neither flushed nor closed
    found = numbers(tmp_path / "r")
    assert found == list(range(len(found)))
    assert len(found) >= 130


def test_a_crash_just_after_a_split_leaves_the_files_before_readable(tmp_path):
    """The new file is named at once, and its first bytes come with the next flush."""
    recording, written = BagRecording(tmp_path / "r", latched=(), file_bytes=FILE_BYTES), 0
    while len(files := sorted((tmp_path / "r").glob("*.mcap"))) < 2:
        fill(recording, 1, start=written)
        written += 1
    assert files[1].stat().st_size == 0
    assert numbers(tmp_path / "r") == list(range(written - 1))
    with BagReader(tmp_path / "r") as bag:
        (note,) = bag.info.notes
        assert bag.info.truncated
    assert note == f"{files[1]}: empty, the recording broke off there"


def test_a_folder_that_cannot_be_made_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(StorageError, match="file/r: cannot be made"):
        BagRecording(tmp_path / "file" / "r", latched=(), file_bytes=1)


def test_a_disk_that_takes_no_more_is_told_and_what_it_took_is_read(tmp_path):
    """A limit on the size of files stands for a full disk."""
    recording = BagRecording(tmp_path / "r", latched=(), file_bytes=10 * FILE_BYTES)
    fill(recording, 40)
    recording.flush()
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_BYTES, before[1]))
    try:
        with pytest.raises(StorageError, match="recording broke off: File too large"):
            fill(recording, 200, start=40)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    found = numbers(tmp_path / "r")
    assert found == list(range(len(found)))
    assert len(found) >= 40
    assert recording.messages - len(found) == recording.unflushed > 0
