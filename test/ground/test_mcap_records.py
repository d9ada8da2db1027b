# SPDX-License-Identifier: Apache-2.0
"""Messages among records, against the library that wrote them."""

import struct
from io import BytesIO

import numpy as np
import pytest
from mcap.data_stream import ReadDataStream
from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import CompressionType, Writer

from robocal_ros.ground.serialized import find_messages

HEAD = struct.Struct("<BQ")


def record(opcode: int, content: bytes) -> bytes:
    return HEAD.pack(opcode, len(content)) + content


def message(channel: int, log_time: int, data: bytes = b"data") -> bytes:
    return record(5, struct.pack("<HIQQ", channel, 7, log_time, 9) + data)


def test_the_messages_of_a_file_without_chunks_are_those_that_the_library_reads():
    rng, stream = np.random.default_rng(1), BytesIO()
    writer = Writer(stream, compression=CompressionType.NONE, use_chunking=False)
    writer.start()
    schema = writer.register_schema("x", "", b"")
    channels = [writer.register_channel(f"/{i}", "", schema) for i in range(3)]
    for _ in range(200):
        channel, data = channels[int(rng.integers(3))], rng.bytes(int(rng.integers(50)))
        writer.add_message(channel, log_time=int(rng.integers(2**62)), data=data, publish_time=0)
    writer.finish()
    records = memoryview(stream.getvalue()[8:-8])
    ours = [
        (channel, log_time, bytes(records[begin:end]))
        for log_time, channel, begin, end in find_messages(records).T
    ]
    theirs = make_reader(BytesIO(stream.getvalue())).iter_messages(log_time_order=False)
    assert ours == [(m.channel_id, m.log_time, m.data) for _, _, m in theirs]
    assert len(ours) == 200


def test_a_message_is_read_as_the_library_reads_it():
    content = message(513, 2**62 + 3)
    records = memoryview(record(99, b"unknown") + content)
    ((log_time, channel, begin, end),) = find_messages(records).T
    read = Message.read(ReadDataStream(BytesIO(content[HEAD.size :])), len(content) - HEAD.size)
    assert (channel, log_time) == (read.channel_id, read.log_time)
    assert bytes(records[begin:end]) == read.data


def test_nothing_holds_no_message():
    assert find_messages(memoryview(b"")).shape == (4, 0)


@pytest.mark.parametrize(
    "content",
    [
        message(1, 1)[:-1],
        message(1, 1) + b"\5\1",
        HEAD.pack(5, 2**63) + bytes(40),
        HEAD.pack(5, 2**63 - 1) + bytes(40),
        record(5, bytes(21)),
        message(1, 2**63),
    ],
)
def test_bytes_that_are_no_whole_records_are_refused(content):
    with pytest.raises(ValueError, match="no whole record at byte"):
        find_messages(memoryview(message(1, 1) + content))
