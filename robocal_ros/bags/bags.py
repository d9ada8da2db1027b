"""Bags of ROS 2 messages (MCAP), read and written without ROS.

A message read from a bag has the attributes of the ROS message of its type.
"""

import warnings
from collections.abc import Collection, Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import IO, Any, NamedTuple, Self

import numpy as np
import yaml
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from robocal_ros.bags import bag_types
from robocal_ros.bags.bag_types import graph_name
from robocal_ros.bags.bag_writer import BagWriter
from robocal_ros.bags.mcap_files import (
    Block,
    Lost,
    McapFile,
    Messages,
    in_order,
    message_reader,
    open_file,
    read_block,
)
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import read_text

__all__ = ["BagInfo", "BagMessage", "BagReader", "BagWriter", "TopicInfo", "bag_info", "read_bag"]


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

    Parameters
    ----------
    path : str or Path
        An ``.mcap`` file, or a folder of ``ros2 bag record`` with one or more of them.

    Raises
    ------
    InputError
        When it is not such a file or folder, or broke off before any message; the message says what
        to do.
    """

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        paths, notes = _bag_files(self._path)
        self._files = [open_file(file) for file in paths]
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
        return BagInfo(
            path=str(self._path),
            topics={topic: TopicInfo(types[topic], counts[topic]) for topic in sorted(counts)},
            start_ns=min(starts, default=None),
            end_ns=max(ends, default=None),
            truncated=any(file.notes for file in self._files),
            notes=(*self._notes, *self._losses()),
            lost=tuple(lost for file in self._files for lost in file.lost.values()),
        )

    def _losses(self) -> Iterator[str]:
        for file in self._files:
            for lost in file.lost.values():
                start, end = (_utc(ns) for ns in (lost.from_ns, lost.to_ns))
                yield (
                    f"{file.path}: a damaged chunk is left out, with all messages recorded from "
                    f"{start} to {end} ({lost.why})"
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

        Raises
        ------
        InputError
            When a message cannot be decoded, or every chunk is damaged.
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
            bag_types.register_schema(
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


def _bag_files(path: Path) -> tuple[list[Path], list[str]]:
    """MCAP files of a bag in their order, and notes on what its folder lacks."""
    if not path.is_dir():
        return [path], []
    metadata = path / "metadata.yaml"
    if not metadata.is_file():
        files = sorted(path.glob("*.mcap"))
        if not files:
            raise InputError("no metadata.yaml and no .mcap file in this folder", file=str(path))
        return files, [f"{path}: no metadata.yaml (the recording broke off); all .mcap files read"]
    try:
        content = yaml.safe_load(read_text(metadata, "bag's metadata"))
        described = content["rosbag2_bagfile_information"]
        storage, mode = described["storage_identifier"], described.get("compression_mode", "")
        names = [str(name) for name in described["relative_file_paths"]]
    except (yaml.YAMLError, KeyError, TypeError, AttributeError) as error:
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
    """Topics, counts and times of a bag.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    with BagReader(path) as bag:
        return bag.info
