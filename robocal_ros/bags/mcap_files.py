# SPDX-License-Identifier: Apache-2.0
"""MCAP files without ROS: the types of their messages, and a file as blocks of messages.

Blocks are found by the index or, without one, by a scan. A file without an index is what a recorder
that was killed leaves behind. Everything up to the first incomplete record is read. A damaged chunk
is left out. What was found wrong is told.
"""

import heapq
import importlib
import struct
from collections import Counter
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import IO, TYPE_CHECKING, Any, NamedTuple

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Schema, Statistics
from mcap.stream_reader import CRCValidationError, get_chunk_data_stream
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype
from rosbags.serde.errors import SerdeError
from rosbags.typesys import Stores, get_types_from_idl, get_types_from_msg, get_typestore
from rosbags.typesys.base import TypesysError
from rosbags.typesys.store import Typestore
from zstandard import ZstdDecompressor, ZstdError

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import share_folders
from robocal_ros.ground.samples import RECORDED, JointBlock, joint_sample

if TYPE_CHECKING:
    from robocal_ros.ground.serialized import JointLayout


INTERFACES = "robocal_msgs"
_DTYPES = {"char": "uint8", "octet": "uint8"}


@cache
def ros_types() -> Typestore:
    """The standard types of Jazzy, and those of robocal_msgs where they are found."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for folder in share_folders(INTERFACES, "msg", "msg_defs/msg")[:1]:
        for file in sorted(folder.glob("*.msg")):
            name = f"{INTERFACES}/msg/{file.stem}"
            store.register(get_types_from_msg(file.read_text(encoding="utf-8"), name))
    return store


def full_name(msgtype: str) -> str:
    """``package/msg/Type`` of a name that may lack its middle part."""
    package, _, name = msgtype.partition("/")
    return msgtype if "/" in name else f"{package}/msg/{name}"


def register_schema(store: Typestore, msgtype: str, encoding: str, text: str, file: str) -> None:
    """Teach ``store`` the type that a bag defines, or the known one where it defines none.

    Raises `InputError` when the definition cannot be read and the type is not a standard one.
    """
    if msgtype in store.types:
        return
    try:
        if encoding == "ros2msg" and text:
            types = get_types_from_msg(text, msgtype)
        elif encoding in ("ros2idl", "omgidl") and text:
            types = get_types_from_idl(text)
        else:
            types = _known_type(msgtype)
        store.register({name: found for name, found in types.items() if name not in store.types})
    except (TypesysError, KeyError) as error:
        raise InputError(
            f"the definition of {msgtype} in this bag cannot be read: {error}", file=file
        ) from error


def _known_type(msgtype: str) -> dict[str, Any]:
    """A standard type with all that it is made of."""
    known = ros_types().fielddefs
    types = {msgtype: known[msgtype]}
    for part in _parts(known[msgtype]):
        types |= _known_type(part)
    return types


def _parts(fields: Any) -> list[str]:
    """Types of the fields of a type, but for the elementary ones."""
    described = [
        detail[0] if kind in (Nodetype.ARRAY, Nodetype.SEQUENCE) else (kind, detail)
        for _, (kind, detail) in fields[1]
    ]
    return [str(detail) for kind, detail in described if kind == Nodetype.NAME]


def _learn_installed(store: Typestore, msgtype: str) -> None:
    """Teach ``store`` a type with all that it is made of, as it is installed."""
    package, _, name = msgtype.partition("/msg/")
    for folder in share_folders(package, "msg", f"{package}/msg"):
        if msgtype in store.types or not (file := folder / f"{name}.msg").is_file():
            continue
        types = get_types_from_msg(file.read_text(encoding="utf-8"), msgtype)
        for part in _parts(types[msgtype]):
            _learn_installed(store, part)
        store.register(types)


def definition(msgtype: str) -> str:
    """Text of a known type with all that it is made of, as recorders store it.

    Raises `InputError` when the type is not known here.
    """
    store = ros_types()
    _learn_installed(store, msgtype)
    if msgtype not in store.types:
        package = msgtype.partition("/")[0]
        raise InputError(
            f"message type {msgtype} is not known; it is not in Jazzy's common interfaces, and "
            f"no share/{package}/msg was found below AMENT_PREFIX_PATH"
        )
    return store.generate_msgdef(msgtype, ros_version=2)[0]


def encode(msgtype: str, value: Any) -> memoryview:
    """CDR of a message: any object with the type's attributes, or a mapping of its fields.

    Fields that a mapping leaves out are zero or empty, as in ROS.
    """
    store = ros_types()
    message = value if isinstance(value, store.types[msgtype]) else _build(store, msgtype, value)
    return store.serialize_cdr(message, msgtype)


def _build(store: Typestore, msgtype: str, value: Any) -> Any:
    fields = store.fielddefs[msgtype][1]
    if isinstance(value, Mapping):
        unknown = set(value) - {name for name, _ in fields}
        if unknown:
            raise ValueError(f"{msgtype} has no field {sorted(unknown)[0]!r}")
        given = {name: value.get(name) for name, _ in fields}
    else:
        given = {name: getattr(value, name) for name, _ in fields}
    return store.types[msgtype](**{name: _field(store, kind, given[name]) for name, kind in fields})


def _field(store: Typestore, described: Any, value: Any) -> Any:
    """A field's value as the serialiser wants it; None stands for the default."""
    kind, detail = described
    if kind == Nodetype.NAME:
        return _build(store, detail, {} if value is None else value)
    if kind == Nodetype.BASE:
        if detail[0] in ("string", "wstring"):
            return value or ""
        return value or 0
    inner, length = detail
    size = length if kind == Nodetype.ARRAY else 0
    if inner[0] == Nodetype.BASE and inner[1][0] not in ("string", "wstring"):
        dtype = np.dtype(_DTYPES.get(inner[1][0], inner[1][0]))
        if isinstance(value, bytes | bytearray | memoryview):
            return np.frombuffer(value, dtype)
        return np.zeros(size, dtype) if value is None else np.ascontiguousarray(value, dtype)
    items = [None] * size if value is None else value
    return [_field(store, inner, item) for item in items]


#
# What moves a robot, says that it may be moved, how its controller moves it, or how it is to be
# corrected, lies under `RECORDED`: ``/robot/gap_open`` as ``/recorded/robot/gap_open``.
# `BagReader` gives each topic the name that it had on the graph.
MOVES = "it may move a robot"
VOUCHES = "it says that a robot may move now, or how it is moved"
CORRECTS = "a robot would be corrected by it"
_BY_TYPE = {
    "trajectory_msgs/msg/JointTrajectory": MOVES,
    "trajectory_msgs/msg/MultiDOFJointTrajectory": MOVES,
    "std_msgs/msg/Float64MultiArray": MOVES,  # as forward_command_controller takes them
    "control_msgs/msg/JointJog": MOVES,  # as MoveIt Servo takes them, with the next two
    "geometry_msgs/msg/Twist": MOVES,
    "geometry_msgs/msg/TwistStamped": MOVES,
    "robocal_msgs/msg/ToolStep": MOVES,
    "robocal_msgs/msg/GapOpen": VOUCHES,
    "std_msgs/msg/Bool": VOUCHES,  # a PLC's inputs, and `gap_open` where `gap_bool` is set
    "robocal_msgs/msg/MotionLease": VOUCHES,
    "robocal_msgs/msg/MaintenanceStatus": VOUCHES,  # the beat, and whether the robot is at home
    "robocal_msgs/msg/AccuracyState": VOUCHES,  # by which the line goes on
    "control_msgs/msg/JointTrajectoryControllerState": VOUCHES,  # where its reference is, how fast
    "control_msgs/msg/SpeedScalingFactor": VOUCHES,
    "robocal_msgs/msg/KinematicModel": CORRECTS,
    "robocal_msgs/msg/ToolFrame": CORRECTS,
    "robocal_msgs/msg/CorrectionStatus": VOUCHES,  # by which maintenance_node says OK
}
_BY_NAME = {"speed_scaling": VOUCHES, "gap_open": VOUCHES}  # last parts of names
# Of these types there are readings, by the last parts of their names, and commands of any name:
# MoveIt Servo, ros2_control and simulators are given joint states and poses to go to.
_READINGS = {
    "sensor_msgs/msg/JointState": {"joint_states"},
    "geometry_msgs/msg/PoseStamped": {"measured_pose", "target_pose"},
}


def withheld(topic: str, msgtype: str) -> str:
    """Why a message of this name on the graph may do something; empty when it does nothing."""
    end = topic.rsplit("/", 1)[-1]
    if why := _BY_TYPE.get(msgtype) or _BY_NAME.get(end):
        return why
    return MOVES if end not in _READINGS.get(msgtype, {end}) else ""


def recorded_name(topic: str, msgtype: str) -> str:
    """The name under which a topic is recorded."""
    return RECORDED + topic if topic == graph_name(topic) and withheld(topic, msgtype) else topic


def graph_name(topic: str) -> str:
    """The name that a recorded topic had on the graph."""
    return topic.removeprefix(RECORDED) if topic.startswith(f"{RECORDED}/") else topic


def message_class(msgtype: str) -> type:
    """The Python class of ``package/msg/Type``.

    Raises `InputError` when it is not installed.
    """
    package, _, name = msgtype.replace("/msg/", "/").partition("/")
    try:
        found = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise InputError(f"message type {msgtype} is not installed") from error
    if not isinstance(found, type):
        raise InputError(f"message type {msgtype} is not installed")
    return found


Places = NDArray[np.int64]


class Messages(NamedTuple):
    """Messages (k,) in the bytes that they came from.

    ``begin`` and ``end`` say where each one's data lies in ``content``.
    """

    content: memoryview
    log_time_ns: Places
    channel: Places
    begin: Places
    end: Places

    def data(self, place: int) -> memoryview:
        """A message's data."""
        return self.content[self.begin[place] : self.end[place]]

    def take(self, rows: NDArray[np.int64] | NDArray[np.bool_]) -> "Messages":
        """Return those at ``rows``."""
        return Messages(self.content, *(column[rows] for column in self[1:]))


MAGIC = b"\x89MCAP0\r\n"
ZSTD = b"\x28\xb5\x2f\xfd"
OTHER_FORMATS = {
    b"SQLite format 3\0": "an SQLite bag; convert it with 'ros2 bag convert' (storage_id: mcap)",
    b"#ROSBAG V2.0": "a bag of ROS 1; convert it with 'rosbags-convert --dst-storage mcap'",
    ZSTD: "compressed as a whole; unpack it with 'zstd -d'",
}
HEAD = struct.Struct("<BQ")  # opcode, length
TIMES = struct.Struct("<QQ")
# what the libraries raise when bytes make no sense: MCAP, zstd, lz4, numbers and text
DAMAGE = (McapError, CRCValidationError, ZstdError, RuntimeError, struct.error, ValueError)
KNOWN_OPCODES = frozenset(int(code) for code in Opcode)
LOOSE_BLOCK = 1 << 20  # bytes of messages outside chunks that are read at a time


class Block(NamedTuple):
    """A chunk, or (``chunked`` False) a run of records outside chunks, by its place in the file.

    ``channels`` that have messages in it; empty where the index does not tell.
    """

    start_ns: int
    offset: int
    size: int
    chunked: bool
    channels: frozenset[int] = frozenset()


class Lost(NamedTuple):
    """A damaged chunk: what is missing, by log time, and why; None where that is lost too."""

    from_ns: int | None
    to_ns: int | None
    why: str


@dataclass
class McapFile:
    """Content of a file: channels, schemas and blocks; ``notes`` say where it breaks off.

    ``broke_off``: the byte at which it does. ``nameless``: messages whose channel was described in
    what is damaged. ``lost``: damaged chunks by their place in the file, as far as they were met in
    reading.
    """

    path: Path
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    blocks: list[Block] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)
    start_ns: int | None = None
    end_ns: int | None = None
    notes: list[str] = field(default_factory=list)
    broke_off: int | None = None
    nameless: int = 0
    lost: dict[int, Lost] = field(default_factory=dict)

    @property
    def is_barren(self) -> bool:
        """Whether it broke off before any message, whole or damaged."""
        return self.broke_off is not None and not (self.counts or self.lost)

    def msgtype(self, channel: int) -> str:
        """Full name of a channel's type; ``unknown`` where the file does not define it."""
        schema = self.schemas.get(self.channels[channel].schema_id)
        return full_name(schema.name) if schema else "unknown"


def open_file(path: Path) -> McapFile:
    """Find out what a file holds.

    Raises `InputError` when it is missing, empty or not an MCAP file.
    """
    try:
        with path.open("rb") as stream:
            head = stream.read(16)
            if not head:
                raise InputError("this bag is empty: nothing was recorded", file=str(path))
            if not head.startswith(MAGIC):
                other = (words for start, words in OTHER_FORMATS.items() if head.startswith(start))
                raise InputError(
                    f"this is not an MCAP file but {next(other, 'something else')}", file=str(path)
                )
            return _indexed(stream, path) or _scanned(stream, path)
    except FileNotFoundError as error:
        raise InputError("no such bag", file=str(path)) from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"this bag cannot be read: {reason}", file=str(path)) from error


def read_block(
    stream: IO[bytes], file: McapFile, block: Block, wanted: Collection[int]
) -> Messages | None:
    """Messages of a block on the ``wanted`` channels, in order of log time, ties as stored.

    A damaged block has none, and is added to what the file has lost.
    """
    data = b""
    try:
        stream.seek(block.offset)
        data = stream.read(block.size)
        found = _stored(_unpacked(data) if block.chunked else memoryview(data))
        found = _decompressed(found.take(np.isin(found.channel, list(wanted))))
    except (*DAMAGE, OSError) as error:
        _lose(file, block, data, error)
        return None
    return found.take(np.argsort(found.log_time_ns, kind="stable"))


def _lose(file: McapFile, block: Block, data: bytes, error: Exception) -> None:
    """Note a damaged block with the times that stand before its content."""
    start_ns = end_ns = None
    if block.chunked and len(data) >= HEAD.size + TIMES.size:
        start_ns, end_ns = TIMES.unpack_from(data, HEAD.size)
        if not start_ns <= end_ns:
            start_ns = end_ns = None
    file.lost[block.offset] = Lost(start_ns, end_ns, f"at byte {block.offset}: {error}")


def _indexed(stream: IO[bytes], path: Path) -> McapFile | None:
    """Content by the index at the file's end; None when there is none, or not a whole one."""
    try:
        stream.seek(0)
        summary = SeekingReader(stream).get_summary()
    except (*DAMAGE, OSError):
        return None
    if summary is None or summary.statistics is None:
        return None
    statistics: Statistics = summary.statistics
    counted = sum(statistics.channel_message_counts.values())
    whole = (
        len(summary.chunk_indexes) == statistics.chunk_count
        and (statistics.chunk_count > 0 or statistics.message_count == 0)
        and counted == statistics.message_count
        and set(statistics.channel_message_counts) <= set(summary.channels)
        and {channel.schema_id for channel in summary.channels.values()} <= {0, *summary.schemas}
    )
    if not whole:
        return None
    file = McapFile(path, summary.schemas, summary.channels)
    for chunk in summary.chunk_indexes:
        channels = frozenset(chunk.message_index_offsets)
        place = chunk.chunk_start_offset, chunk.chunk_length
        file.blocks.append(Block(chunk.message_start_time, *place, True, channels))
    file.counts = Counter(statistics.channel_message_counts)
    if statistics.message_count:
        file.start_ns, file.end_ns = statistics.message_start_time, statistics.message_end_time
    return file


def _scanned(stream: IO[bytes], path: Path) -> McapFile:
    """Content by reading the file from its start to its end or first damage."""
    file = McapFile(path)
    loose = len(MAGIC)  # where the records begin that are in no block yet
    damage = ""
    for opcode, start, end, words in _records(stream):
        if words:
            damage, file.broke_off = words, start
        if opcode == Opcode.CHUNK or end - loose > LOOSE_BLOCK or opcode is None:
            _add_block(stream, file, Block(0, loose, start - loose, False))
            loose = start
        if opcode == Opcode.CHUNK:
            _add_block(stream, file, Block(0, start, end - start, True))
            loose = end
    if damage:
        file.notes.append(
            f"{path}: the recording broke off {damage}; the {file.counts.total()} messages "
            f"before that are read"
        )
    if file.nameless:
        file.notes.append(
            f"{path}: {file.nameless} messages are left out: the names of their topics are lost"
        )
    return file


def _records(stream: IO[bytes]) -> Iterator[tuple[int | None, int, int, str]]:
    """Opcode, start and end of each record of the data section.

    At the end comes opcode None, with words that say why when it is not the regular end.
    """
    size = stream.seek(0, 2)
    at = len(MAGIC)
    while at + HEAD.size <= size:
        stream.seek(at)
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        end = at + HEAD.size + length
        if end > size or opcode not in KNOWN_OPCODES:
            break
        if opcode == Opcode.DATA_END:
            stream.seek(-len(MAGIC), 2)
            whole = stream.read() == MAGIC
            yield None, at, at, "" if whole else "in the index after the last message"
            return
        yield opcode, at, end, ""
        at = end
    yield None, at, at, f"in the record at byte {at}" if at < size else "without an end mark"


def _add_block(stream: IO[bytes], file: McapFile, block: Block) -> None:
    """Take in a block's schemas, channels and messages; one without, or damaged, is left out."""
    stream.seek(block.offset)
    data = stream.read(block.size)
    try:
        content, at = _unpacked(data) if block.chunked else memoryview(data), 0
        while at < len(content):
            opcode, length = HEAD.unpack_from(content, at)
            if opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                body = ReadDataStream(BytesIO(content[at + HEAD.size : at + HEAD.size + length]))
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(body)
                    file.schemas[schema.id] = schema
                else:
                    channel = Channel.read(body)
                    file.channels[channel.id] = channel
            at += HEAD.size + length
        found = _stored(content)
    except DAMAGE as error:
        _lose(file, block, data, error)
        return
    named = found.take(np.isin(found.channel, list(file.channels)))
    file.nameless += len(found.channel) - len(named.channel)
    if not len(named.channel):
        return
    first, last = int(named.log_time_ns.min()), int(named.log_time_ns.max())
    counts = Counter(named.channel.tolist())
    file.counts.update(counts)
    file.start_ns = first if file.start_ns is None else min(first, file.start_ns)
    file.end_ns = last if file.end_ns is None else max(last, file.end_ns)
    file.blocks.append(block._replace(start_ns=first, channels=frozenset(counts)))


def _stored(content: memoryview) -> Messages:
    """Messages among MCAP records, as they are stored; ValueError when these are not whole."""
    from robocal_ros.ground.serialized import find_messages

    return Messages(content, *find_messages(content))


def _decompressed(found: Messages) -> Messages:
    """Messages as they were before ``ros2 bag record --compression-mode message``.

    The file does not tell of it; CDR never begins as zstd does.
    """
    if not len(found.begin):
        return found
    content = np.frombuffer(found.content, dtype=np.uint8)
    if not (content[np.minimum(found.begin, len(content) - 1)] == ZSTD[0]).any():
        return found
    unzip = ZstdDecompressor().decompress
    stored = [bytes(found.data(place)) for place in range(len(found.begin))]
    data = [unzip(one) if one.startswith(ZSTD) else one for one in stored]
    edges = np.cumsum([0, *map(len, data)], dtype=np.int64)
    return found._replace(content=memoryview(b"".join(data)), begin=edges[:-1], end=edges[1:])


def _unpacked(record: bytes) -> memoryview:
    """Content of a chunk record, decompressed and checked."""
    stream = ReadDataStream(BytesIO(record[HEAD.size :]))
    content, length = get_chunk_data_stream(Chunk.read(stream), validate_crc=True)
    return memoryview(content.read(length))


class Stretch(NamedTuple):
    """Messages ``start`` to ``stop`` of a block of a file: none of another block lies between."""

    file: int
    messages: Messages
    start: int
    stop: int


# time of the next message, file, block's offset, place in the block, the block's messages
_Entry = tuple[int, int, int, int, Messages]


def in_order(
    blocks: Iterable[tuple[int, Block]], read: Callable[[int, Block], Messages | None]
) -> Iterator[Stretch]:
    """Merge blocks, each with the number of its file; one is in memory only while it is needed.

    ``read`` gives a block's messages in order of log time.
    """
    heap: list[_Entry] = []
    for start_ns, index, block in sorted((block.start_ns, index, block) for index, block in blocks):
        yield from _earlier(heap, start_ns)
        messages = read(index, block)
        if messages is not None and len(messages.log_time_ns):
            first_ns = int(messages.log_time_ns[0])
            heapq.heappush(heap, (first_ns, index, block.offset, 0, messages))
    yield from _earlier(heap, None)


def _earlier(heap: list[_Entry], before_ns: int | None) -> Iterator[Stretch]:
    """Take the messages before ``before_ns`` (None: all) off the heap, in order."""
    while heap and (before_ns is None or heap[0][0] < before_ns):
        _, index, offset, start, messages = heapq.heappop(heap)
        times = messages.log_time_ns
        stop = len(times)
        if before_ns is not None:
            stop = int(np.searchsorted(times, before_ns))
        if heap:
            other_ns, *other = heap[0][:3]
            ours_first = [index, offset] < other  # of equal times
            stop = min(stop, int(np.searchsorted(times, other_ns + ours_first)))
        if stop < len(times):
            heapq.heappush(heap, (int(times[stop]), index, offset, stop, messages))
        yield Stretch(index, messages, start, stop)


#
# A reader takes messages and a range of them, and gives contents with the place of each.
Decode = Callable[[Messages, int], Any]
Reader = Callable[[Messages, int, int], Iterator[tuple[int, Any]]]
JOINT_STATE = "sensor_msgs/msg/JointState"
MOST_LAYOUTS = 8  # of a topic: a gripper and an arm may take turns
MOST_TOGETHER = 1024  # readings: where all are odd, each is looked for among so many


def message_reader(
    file: McapFile, channel: int, types: Typestore | None, blocks: Collection[str]
) -> Reader:
    """Reader of a channel.

    ``types`` decode its messages; None: they stay bytes. ``blocks``: topics whose joint states
    come in blocks.
    """
    topic, msgtype = file.channels[channel].topic, file.msgtype(channel)

    def decode(found: Messages, place: int) -> Any:
        if types is None:
            return bytes(found.data(place))
        try:
            return types.deserialize_cdr(found.data(place), msgtype)
        except (SerdeError, KeyError) as error:
            raise InputError(
                f"a message of {topic} at {found.log_time_ns[place]} ns is not a {msgtype}: "
                f"{error}",
                file=str(file.path),
            ) from error

    def one_by_one(found: Messages, start: int, stop: int) -> Iterator[tuple[int, Any]]:
        for place in range(start, stop):
            yield place, decode(found, place)

    if types is None or topic not in blocks or msgtype != JOINT_STATE:
        return one_by_one
    as_defined = types.fielddefs.get(msgtype) == ros_types().fielddefs[JOINT_STATE]
    return _JointReader(decode) if as_defined else one_by_one


class _JointReader:
    """Reader of a topic of joint states: as decoded one by one, many times faster.

    What can be used comes in blocks (`JointBlock`), what is odd as messages.
    """

    def __init__(self, decode: Decode) -> None:
        self._decode = decode
        # with the joints that have a position, and which these are among all
        self._layouts: list[tuple[JointLayout, tuple[str, ...], NDArray[np.bool_]]] = []

    def __call__(self, found: Messages, start: int, stop: int) -> Iterator[tuple[int, Any]]:
        while start < stop:
            until = min(stop, start + MOST_TOGETHER)
            block = self._block(found, start, until)
            if block is None and self._learn(found, start):
                block = self._block(found, start, until)
            if block is None:
                yield start, self._decode(found, start)
                start += 1
            else:
                yield start, block
                start += len(block)

    def _block(self, found: Messages, start: int, stop: int) -> JointBlock | None:
        """The readings from ``start`` on of the same layout and joints; None without."""
        begin, end = found.begin[start:stop], found.end[start:stop]
        content = np.frombuffer(found.content, dtype=np.uint8)
        for layout, names, known in self._layouts:
            if len(layout.pattern) != end[0] - begin[0]:
                continue
            stamps, position = layout.gather(content, begin, end)
            alike = (np.isfinite(position) == known).all(axis=1)
            count = len(stamps) if alike.all() else int(np.argmin(alike))
            if count:
                return JointBlock(stamps[:count], names, position[:count, known])
        return None

    def _learn(self, found: Messages, place: int) -> bool:
        """Take the layout of a message, if it is one that can be used."""
        from robocal_ros.ground.serialized import JointLayout

        layout = JointLayout.of(bytes(found.data(place)))
        if layout is None:
            return False
        try:
            message = self._decode(found, place)
            names, known = joint_sample(message).names, np.isfinite(message.position)
        except InputError:  # said where the message is taken
            return False
        self._layouts.insert(0, (layout, names, known))
        del self._layouts[MOST_LAYOUTS:]
        return True
