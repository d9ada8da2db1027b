"""Bags of ROS 2 messages (MCAP) that ``ros2 bag play`` accepts, written without ROS."""

import os
from collections.abc import Collection
from pathlib import Path
from typing import IO, Any, Literal, Self

import yaml
from mcap.writer import CompressionType, Writer

from robocal_ros import __version__
from robocal_ros.bags import bag_types
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import lies_at

CHUNK_BYTES = 256 * 1024  # what a writer that is killed can lose
_COMPRESSIONS = {"zstd": CompressionType.ZSTD, "lz4": CompressionType.LZ4}
_FOREVER = {"sec": 9223372036, "nsec": 854775807}


def ros_time(stamp_ns: int) -> dict[str, int]:
    """Fields of a ``builtin_interfaces/Time``."""
    sec, nanosec = divmod(stamp_ns, 1_000_000_000)
    return {"sec": sec, "nanosec": nanosec}


def offered_qos(latched: bool) -> str:
    """Reliable QoS as recorders store it; ``latched`` topics are transient-local, keep last 1.

    Numbers instead of names, which every distribution reads.
    """
    profile = {
        "history": 1,
        "depth": 1 if latched else 100,
        "reliability": 1,
        "durability": 1 if latched else 2,
        "deadline": dict(_FOREVER),
        "lifespan": dict(_FOREVER),
        "liveliness": 1,
        "liveliness_lease_duration": dict(_FOREVER),
        "avoid_ros_namespace_conventions": False,
    }
    return str(yaml.safe_dump([profile], sort_keys=False))


class BagWriter:
    """Writes one ``.mcap`` file; a context manager, the file is complete when it is left.

    Parameters
    ----------
    path : str or Path
        An existing file is replaced.
    latched : topics that are published latched (transient-local); looked up with a topic's first
        message.
    compression, chunk_bytes : of the chunks; larger ones are smaller on the disk.

    Raises
    ------
    InputError
        When the file cannot be made.
    """

    def __init__(
        self,
        path: str | Path,
        *,
        latched: Collection[str] = (),
        compression: Literal["zstd", "lz4"] = "zstd",
        chunk_bytes: int | None = None,
    ) -> None:
        self.path = Path(path)
        try:
            self._stream: IO[bytes] = self.path.open("wb")
        except OSError as error:
            raise InputError(f"cannot be written: {error.strerror}", file=str(path)) from error
        self._writer = Writer(
            self._stream,
            chunk_size=chunk_bytes or CHUNK_BYTES,
            compression=_COMPRESSIONS[compression],
        )
        self._writer.start(profile="ros2", library=f"robocal_ros {__version__}")
        self._latched = latched
        self._schemas: dict[str, int] = {}
        self._channels: dict[tuple[str, str], int] = {}
        self._count: dict[int, int] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write the index: the file is complete."""
        with self._stream:
            self._writer.finish()  # type: ignore[no-untyped-call]

    def flush(self) -> None:
        """Bring everything to the disk: neither a kill nor a power cut loses it any more."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._stream.fileno())

    @property
    def in_place(self) -> bool:
        """Whether the file that is written is still the one of this name."""
        return lies_at(self.path, self._stream.fileno())

    @property
    def size_bytes(self) -> int:
        """Size of the file, without the chunk that is being filled."""
        return self._stream.tell()

    def write(
        self,
        topic: str,
        msgtype: str,
        message: Any,
        log_time_ns: int,
        publish_time_ns: int | None = None,
    ) -> None:
        """Append a message.

        Parameters
        ----------
        msgtype : ``package/msg/Type``, a common interface of Jazzy or one of robocal_msgs.
        message : an object with the type's attributes (of rclpy, of a bag), a mapping of its
            fields (those left out are zero or empty), or its CDR as bytes.
        publish_time_ns : the log time when it is not given.

        Raises
        ------
        InputError
            When the type is not known.
        ValueError
            When a mapping has a field that the type has not.
        """
        channel = self._channel(topic, bag_types.full_name(msgtype))
        data = message
        if not isinstance(message, bytes):
            data = bytes(bag_types.encode(bag_types.full_name(msgtype), message))
        self._count[channel] += 1
        self._writer.add_message(
            channel_id=channel,
            log_time=log_time_ns,
            data=data,
            publish_time=log_time_ns if publish_time_ns is None else publish_time_ns,
            sequence=self._count[channel],
        )

    def _channel(self, topic: str, msgtype: str) -> int:
        known = self._channels.get((topic, msgtype))
        if known is not None:
            return known
        if msgtype not in self._schemas:
            text = bag_types.definition(msgtype).encode()
            self._schemas[msgtype] = self._writer.register_schema(msgtype, "ros2msg", text)
        channel = self._writer.register_channel(
            topic=topic,
            message_encoding="cdr",
            schema_id=self._schemas[msgtype],
            metadata={"offered_qos_profiles": offered_qos(topic in self._latched)},
        )
        self._count[channel] = 0
        self._channels[topic, msgtype] = channel
        return channel
