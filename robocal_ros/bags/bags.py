# SPDX-License-Identifier: Apache-2.0
"""Bags of ROS 2 messages (MCAP), read without ROS, and the data files of hand-eye calibrations.

A message read from a bag has the attributes of the ROS message of its type.
"""

import json
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from robocal_ros.bags.bag_writer import BagWriter, ros_time
from robocal_ros.bags.mcap_files import (
    Block,
    Lost,
    McapFile,
    Messages,
    graph_name,
    in_order,
    message_reader,
    open_file,
    read_block,
    register_schema,
)
from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.ground.files import draft_beside, read_text
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import cloud_points, joint_sample
from robocal_ros.kinematics import SerialArm

__all__ = [
    "BagInfo", "BagMessage", "BagReader", "BagWriter", "TopicInfo", "bag_info", "open_bag",
    "read_bag",
]  # fmt: skip
ROS1, SQLITE = ".bag", ".db3"


class BagMessage(NamedTuple):
    """A recorded message; ``message`` is its CDR (bytes) when read raw."""

    topic: str
    msgtype: str
    log_time_ns: int
    message: Any


class TopicInfo(NamedTuple):
    """Type and number of messages of a topic."""

    msgtype: str
    messages: int


@dataclass(frozen=True)
class BagInfo:
    """Content of a bag.

    ``start_ns`` and ``end_ns`` (log time) are None when it holds no message. ``notes`` tell what
    is wrong with it; ``truncated``: the recording broke off; ``lost``: damaged chunks, known when
    they were met in reading.
    """

    path: str
    topics: Mapping[str, TopicInfo]
    start_ns: int | None
    end_ns: int | None
    truncated: bool
    notes: tuple[str, ...]
    lost: tuple[Lost, ...] = ()

    @property
    def messages(self) -> int:
        """Number of messages."""
        return sum(topic.messages for topic in self.topics.values())


class BagReader:
    """A bag's messages in log-time order; a context manager.

    Topics have the names that they had on the graph, also where they were recorded under another
    one (`recorded_names`).

    ``path``: an ``.mcap`` file, or a folder of ``ros2 bag record`` with one or more of them.

    Raises `InputError` when it is not such a file or folder, or broke off before any message; the
    message says what to do.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        paths, notes = _bag_files(self._path)
        begun = [file for file in paths if not _is_empty(file)]
        if begun:  # a crash just after a split leaves a file in which nothing is yet
            notes += [f"{p}: empty, the recording broke off there" for p in paths if p not in begun]
        self._files = [open_file(file) for file in begun or paths]
        for file in self._files:
            for number, channel in file.channels.items():
                file.channels[number] = replace(channel, topic=graph_name(channel.topic))
        if all(file.is_barren for file in self._files):
            raise InputError(
                f"the recording broke off at byte {self._files[0].broke_off} before any message; "
                "nothing can be read",
                file=str(self._files[0].path),
            )
        self._notes = (*notes, *(note for file in self._files for note in file.notes))
        self._types: list[Typestore] = [get_typestore(Stores.EMPTY) for _ in self._files]
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()

    @property
    def info(self) -> BagInfo:
        """What the bag holds and what is wrong with it."""
        counts: dict[str, int] = {}
        types: dict[str, str] = {}
        for file in self._files:
            for number, channel in file.channels.items():
                counts[channel.topic] = counts.get(channel.topic, 0) + file.counts[number]
                types[channel.topic] = file.msgtype(number)
        starts = [file.start_ns for file in self._files if file.start_ns is not None]
        ends = [file.end_ns for file in self._files if file.end_ns is not None]
        losses = [
            f"{file.path}: a damaged chunk is left out, with all messages recorded from "
            f"{_utc(lost.from_ns)} to {_utc(lost.to_ns)} ({lost.why})"
            for file in self._files
            for lost in file.lost.values()
        ]
        return BagInfo(
            path=str(self._path),
            topics={topic: TopicInfo(types[topic], counts[topic]) for topic in sorted(counts)},
            start_ns=min(starts, default=None),
            end_ns=max(ends, default=None),
            truncated=bool(self._notes),
            notes=(*self._notes, *losses),
            lost=tuple(lost for file in self._files for lost in file.lost.values()),
        )

    def messages(
        self,
        topics: Collection[str] | None = None,
        *,
        raw: bool = False,
        blocks: Collection[str] = (),
    ) -> Iterator[BagMessage]:
        """Messages of all topics, or of ``topics``, by log time, ties as they were recorded.

        On the topics of ``blocks``, joint states that follow each other come together, as a
        ``JointBlock`` with the log time of its first; those that are odd come as messages.
        A damaged chunk is left out; afterwards ``info`` tells of it.

        Raises `InputError` when a message cannot be decoded, or every chunk is damaged.
        """
        wanted = [
            {
                number: file.msgtype(number)
                for number, channel in file.channels.items()
                if topics is None or channel.topic in topics
            }
            for file in self._files
        ]
        if not raw:
            for number, channels in enumerate(wanted):
                self._learn_types(number, channels)
        yield from self._read(wanted, raw, blocks)
        if (lost := self.info.lost) and all(
            block.offset in file.lost for file in self._files for block in file.blocks
        ):
            told = "; ".join([f"damaged {lost[0].why}", *self._notes])
            raise InputError(
                f"nothing in this bag can be read; damaged chunks: {len(lost)} ({told})",
                file=str(self._path),
            )

    def _learn_types(self, index: int, channels: Collection[int]) -> None:
        file = self._files[index]
        for number in channels:
            channel = file.channels[number]
            if channel.message_encoding != "cdr":
                raise InputError(
                    f"topic {channel.topic} is encoded as '{channel.message_encoding}'; only "
                    f"'cdr', the encoding of ROS 2, can be read",
                    file=str(file.path),
                )
            schema = file.schemas.get(channel.schema_id)
            text = schema.data.decode("utf-8", "replace") if schema else ""
            encoding = schema.encoding if schema else ""
            register_schema(
                self._types[index], file.msgtype(number), encoding, text, str(file.path)
            )

    def _read(
        self, wanted: list[dict[int, str]], raw: bool, blocks: Collection[str]
    ) -> Iterator[BagMessage]:
        readers = [
            {
                number: message_reader(file, number, None if raw else types, blocks)
                for number in channels
            }
            for file, types, channels in zip(self._files, self._types, wanted, strict=True)
        ]
        streams = [self._open(file) for file in self._files]
        needed = (
            (index, block)
            for index, file in enumerate(self._files)
            for block in file.blocks
            if wanted[index] and (not block.channels or block.channels & wanted[index].keys())
        )

        def read(index: int, block: Block) -> Messages | None:
            return read_block(streams[index], self._files[index], block, wanted[index])

        for index, messages, first, last in in_order(needed, read):
            turns = np.flatnonzero(np.diff(messages.channel[first:last])) + first + 1
            for start, stop in pairwise([first, *turns.tolist(), last]):
                number = int(messages.channel[start])
                of = self._files[index].channels[number].topic, wanted[index][number]
                for place, content in readers[index][number](messages, start, stop):
                    yield BagMessage(*of, int(messages.log_time_ns[place]), content)

    def _open(self, file: McapFile) -> IO[bytes]:
        try:
            return self._stack.enter_context(file.path.open("rb"))
        except OSError as error:
            raise InputError(f"cannot be read: {error.strerror}", file=str(file.path)) from error


def open_bag(path: str | Path) -> BagReader:
    """Open a bag of any kind: MCAP, SQLite (``.db3``), or of ROS 1 (``.bag``).

    ``path``: a file, or a folder of them.

    Raises `InputError` when it is no such bag, or broke off before any message.
    """
    path = Path(path)
    if path.suffix in (ROS1, SQLITE) and not path.exists():
        raise InputError("there is no such file or folder", file=str(path))
    files = [path]
    if path.is_dir():
        files = sorted(path.glob(f"*{ROS1}"))
        if not files and not list(path.glob("*.mcap")) and list(path.glob(f"*{SQLITE}*")):
            described = path / "metadata.yaml"
            files = [path] if described.is_file() else sorted(path.glob(f"*{SQLITE}"))
    if files and (path.is_dir() or path.suffix in (ROS1, SQLITE)):
        from robocal_ros.bags.foreign import ForeignBagReader

        return ForeignBagReader(path, files)
    return BagReader(path)


def _bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """MCAP files of a bag in their order, and notes on what its folder lacks."""
    if not path.is_dir():
        return [path], []
    metadata = path / "metadata.yaml"
    if not metadata.is_file() or _is_empty(metadata):
        files = sorted(path.glob("*.mcap"))
        if not files:
            raise InputError("no metadata.yaml and no .mcap file in this folder", file=str(path))
        lacks = "no metadata.yaml, or an empty one (the recording broke off)"
        return files, [f"{path}: {lacks}; all .mcap files read"]
    try:
        content = yaml.safe_load(read_text(metadata, "bag's metadata"))
        described = content["rosbag2_bagfile_information"]
        storage, mode = described["storage_identifier"], described.get("compression_mode", "")
        names = [str(name) for name in described["relative_file_paths"]]
    except (yaml.YAMLError, KeyError, TypeError, AttributeError, ValueError) as error:
        raise InputError(
            "this is not the metadata of a bag; 'ros2 bag reindex' makes it anew",
            file=str(metadata),
        ) from error
    if storage != "mcap" or str(mode).upper() == "FILE":
        kind = "compressed as whole files" if storage == "mcap" else f"stored as {storage}"
        raise InputError(
            f"this bag is {kind}; convert it with 'ros2 bag convert' (storage_id: mcap)",
            file=str(path),
        )
    if not names:
        raise InputError("this bag has no files", file=str(metadata))
    return [path / name for name in names], []


def _is_empty(file: Path) -> bool:
    """Whether it is there without a byte."""
    try:
        return not file.stat().st_size
    except OSError:  # told where it is opened
        return False


def _utc(stamp_ns: int | None) -> str:
    """A log time for people."""
    return "an unknown time" if stamp_ns is None else f"{np.datetime64(stamp_ns, 'ns')} UTC"


def read_bag(
    path: str | Path, topics: Collection[str] | None = None, *, raw: bool = False
) -> Iterator[BagMessage]:
    """Messages of a bag by log time; see ``BagReader``, which also tells what is wrong with it.

    A recording that broke off is read as far as it goes, a damaged one around the damage, with a
    warning.
    """
    with BagReader(path) as bag:
        known = bag.info.notes
        for note in known:
            warnings.warn(note, stacklevel=2)
        yield from bag.messages(topics, raw=raw)
        for note in bag.info.notes:
            if note not in known:
                warnings.warn(note, stacklevel=2)


def bag_info(path: str | Path) -> BagInfo:
    """Topics, counts and times of a bag."""
    with BagReader(path) as bag:
        return bag.info


DATA_SET, JOINTS, PROFILE, POSE = "data_set", "joint_states", "profile", "target_pose"
IMAGE, TRACKER_POINT = "image", "tracker_point"
_TYPE = {
    PROFILE: "sensor_msgs/msg/PointCloud2",
    POSE: "geometry_msgs/msg/PoseStamped",
    IMAGE: "std_msgs/msg/Float64MultiArray",
    TRACKER_POINT: "geometry_msgs/msg/PointStamped",
}
_DOUBLE = 8  # of sensor_msgs/PointField
_BYTES = 24  # of a point


def write_data_set(
    path: Path,
    document: Mapping[str, Any],
    topic: str,
    frame: str,
    arm: SerialArm,
    tracker_frame: str = "tracker",
) -> None:
    """Write a data set; the file appears whole or not at all.

    ``document``: of the data set, with its ``samples`` in SI.
    ``topic``: ``profile``, ``target_pose``, ``image`` or ``tracker_point``, of samples that name
    none of their own; ``frame``: the sensor's, ``tracker_frame``: that of a tracker's points. The
    file names those that it is referred to.

    Raises `InputError` when the file is there already, or cannot be written.
    """
    if path.exists():
        raise InputError("is there already: name another file", file=str(path))
    if not path.parent.is_dir():
        raise InputError(f"cannot be written: no folder {path.parent}", file=str(path))
    samples = sorted(document["samples"], key=lambda row: (row["stamp_ns"], row["handle"]))
    apart = ("q", "values")  # messages of their own
    rows = [{name: row[name] for name in row if name not in apart} for row in samples]
    made_with = {"robot": arm.name, "model_hash": arm.model_hash, "sensor_frame": frame}
    if any(row.get("topic", topic) == TRACKER_POINT for row in samples):
        made_with["tracker_frame"] = tracker_frame
    text = json.dumps({**document, **made_with, "samples": rows}, allow_nan=False)
    draft = draft_beside(path)
    try:
        with BagWriter(draft) as writer:
            start_ns = rows[0]["stamp_ns"] if rows else 0
            writer.write(DATA_SET, "std_msgs/msg/String", {"data": text}, start_ns)
            for row in samples:
                at_ns = row["stamp_ns"]
                own, stamp = row.get("topic", topic), ros_time(at_ns)
                of = tracker_frame if own == TRACKER_POINT else frame
                header = {"stamp": stamp, "frame_id": of}
                joints = {
                    "header": {"stamp": stamp, "frame_id": ""},
                    "name": list(arm.joint_names),
                    "position": row["q"],
                }
                writer.write(JOINTS, "sensor_msgs/msg/JointState", joints, at_ns)
                writer.write(own, _TYPE[own], _shot(own, header, row["values"]), at_ns)
        draft.replace(path)
    except OSError as error:
        raise InputError(f"cannot be written: {error.strerror}", file=str(path)) from error
    finally:
        draft.unlink(missing_ok=True)


def _shot(topic: str, header: Document, values: Sequence[Sequence[float]]) -> Document:
    """Message of a profile, point, pose or image (rows: its width and height, each corner)."""
    if topic == IMAGE:
        wide = len(values[0])  # of a ChArUco board with the number of each corner
        layout = [("size and corners", len(values), wide * len(values)), ("x, y", wide, wide)]
        dim = [{"label": label, "size": n, "stride": stride} for label, n, stride in layout]
        return {"layout": {"dim": dim, "data_offset": 0}, "data": np.ravel(values)}
    if topic == PROFILE:
        data = np.insert(np.array(values, dtype="<f8").reshape(-1, 2), 1, 0.0, axis=1)
        fields = [
            {"name": name, "offset": 8 * i, "datatype": _DOUBLE, "count": 1}
            for i, name in enumerate("xyz")
        ]
        return {
            "header": header, "height": 1, "width": len(data), "fields": fields,
            "point_step": _BYTES, "row_step": len(data) * _BYTES, "data": data.tobytes(),
            "is_dense": True,
        }  # fmt: skip
    if topic == TRACKER_POINT:
        place = dict(zip("xyz", values[0], strict=True))
        return {"header": header | {"frame_id": "tracker"}, "point": place}
    x, y, z, *quat = values[0]
    turn = dict(zip("xyzw", quat, strict=True))
    return {"header": header, "pose": {"position": {"x": x, "y": y, "z": z}, "orientation": turn}}


def read_data_set(path: Path, arm: SerialArm) -> Document:
    """Read what `write_data_set` wrote: the same numbers to the last bit.

    Raises `InputError` when it is no such file, or a part of it is missing; `WrongRobotError`: it
    was made with another nominal model.
    """
    with BagReader(path) as reader:
        found = list(reader.messages([DATA_SET, JOINTS, *_TYPE]))
        info = reader.info
    if info.notes or info.lost:  # what is missing cannot be told from the rest
        told = "; ".join([*info.notes, *(part.why for part in info.lost)])
        raise InputError(f"is truncated or damaged: copy it again ({told})", file=str(path))
    texts = [m.message.data for m in found if m.topic == DATA_SET]
    if len(texts) != 1:
        raise InputError(f"is no data file of hand_eye_node: no topic {DATA_SET}", file=str(path))
    try:
        document = json.loads(texts[0])
        made_with, rows = document["model_hash"], document["samples"]
        if made_with != arm.model_hash:
            raise WrongRobotError(
                f"{path} was made with robot '{document['robot']}' of nominal model {made_with}; "
                f"'{arm.name}' is {arm.model_hash}"
            )
        joints = [joint_sample(m.message) for m in found if m.topic == JOINTS]
        shots = [_values(m) for m in found if m.topic in _TYPE]
        document["samples"] = [
            row | {"q": q.position[q.order(arm.joint_names)].tolist(), "values": values.tolist()}
            for row, q, values in zip(rows, joints, shots, strict=True)
        ]
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the data set cannot be read: {error}", file=str(path)) from error
    return dict(document)


def _values(recorded: BagMessage) -> Array:
    """Points (n, 2) of a cloud; point (1, 3); pose (1, 7); size and corners of an image."""
    if recorded.topic == IMAGE:
        wide = recorded.message.layout.dim[1].size
        return np.asarray(recorded.message.data, dtype=np.float64).reshape(-1, wide)
    if recorded.topic == PROFILE:
        return cloud_points(recorded.message)[:, [0, 2]]
    if recorded.topic == TRACKER_POINT:
        p = recorded.message.point
        return np.array([[p.x, p.y, p.z]])
    p, o = recorded.message.pose.position, recorded.message.pose.orientation
    return np.array([[p.x, p.y, p.z, o.x, o.y, o.z, o.w]])
