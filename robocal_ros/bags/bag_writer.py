# SPDX-License-Identifier: Apache-2.0
"""Bags (MCAP) that ``ros2 bag play`` accepts, written without ROS: files, and recordings that grow.

Each file of a recording has an index once it is full; of one that a crash left behind, `BagReader`
reads everything up to the last flush.
"""

import errno
import fcntl
import json
import os
import re
import shutil
import socket
import stat
import time
import uuid
from collections.abc import Collection
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, Literal, Self, TextIO

import yaml
from mcap.writer import CompressionType, Writer

from robocal_ros import __version__
from robocal_ros.bags.mcap_files import definition, encode, full_name
from robocal_ros.ground.errors import InputError, StorageError
from robocal_ros.ground.files import lies_at, read_text, sync_folder, write_text

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

    ``path``: an existing file is replaced. ``latched``: topics that are published latched
    (transient-local); looked up with a topic's first message. ``compression``, ``chunk_bytes``: of
    the chunks; larger ones are smaller on the disk.

    Raises `InputError` when the file cannot be made.
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

        ``msgtype``: ``package/msg/Type``, a common interface of Jazzy or one of robocal_msgs.
        ``message``: an object with the type's attributes (of rclpy, of a bag), a mapping of its
        fields (those left out are zero or empty), or its CDR as bytes.
        ``publish_time_ns``: the log time when it is not given.
        """
        channel = self._channel(topic, full_name(msgtype))
        data = message
        if not isinstance(message, bytes):
            data = bytes(encode(full_name(msgtype), message))
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
            text = definition(msgtype).encode()
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


OPEN = "OPEN"  # of this name, locked by the process that writes it; gone with its end
# As file systems say that they know no locks (NFS without its lock daemon).
_NO_LOCKS = {errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOSYS, errno.EINVAL}


def hold_open(folder: Path) -> TextIO:
    """Say that this process writes a recording, as long as the file is open.

    Raises `OSError` when it cannot be said, or another process writes it.
    """
    file = (folder / OPEN).open("w", encoding="utf-8")
    try:
        file.write(f"{socket.gethostname()} {os.getpid()}\n")
        file.flush()
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno not in _NO_LOCKS:
            file.close()
            raise
    return file


def is_open(folder: Path) -> bool:
    """Whether a process writes it; one that a crash left behind is not.

    Where the disk knows no locks, one of another host counts as open, and one of this host as long
    as there is a process of its number.
    """
    try:
        with (folder / OPEN).open("r+", encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                return error.errno not in _NO_LOCKS or _writer_lives(file.read())
    except FileNotFoundError:
        return False
    except OSError:  # it cannot be told: a read-only disk, another user's
        return True
    return False


def _writer_lives(text: str) -> bool:
    host, _, process = text.strip().rpartition(" ")
    if host != socket.gethostname() or not process.isdigit():
        return True
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


class BagRecording:
    """Writes one recording; a context manager.

    A new file is begun when one is full. ``metadata.yaml``, which ``ros2 bag play`` looks for,
    names each file from its begin on, so that a crash hides none; its counts are of that time.

    ``folder``: made where it is not there; see `recording_folders.new_folder`. ``latched``: topics
    that are published latched; may grow. ``file_bytes``: size of a file.

    ``unflushed``: messages that a break-off now may lose.

    Raises `StorageError` when it cannot be written; what was written before stays readable.
    """

    def __init__(self, folder: Path, *, latched: Collection[str], file_bytes: int) -> None:
        self.folder, self._latched, self._file_bytes = folder, latched, file_bytes
        self._types: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._files: list[dict[str, Any]] = []
        self._writer: BagWriter | None = None
        self.unflushed = 0
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._open = hold_open(folder)
        except OSError as error:
            raise StorageError(f"{folder}: cannot be made: {error.strerror or error}") from error

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def messages(self) -> int:
        """Number of messages so far."""
        return sum(self._counts.values())

    def write(self, topic: str, msgtype: str, cdr: bytes, log_time_ns: int) -> None:
        """Append a serialized message.

        Raises `StorageError` when it cannot be written; `InputError` when the type is not known.
        """
        try:
            if self._writer is not None and self._writer.size_bytes >= self._file_bytes:
                self._finish()
            writer = self._writer or self._begin(log_time_ns)
            writer.write(topic, msgtype, cdr, log_time_ns)
        except OSError as error:
            raise self._broken(error) from error
        file = self._files[-1]
        file["start_ns"] = min(file["start_ns"], log_time_ns)
        file["end_ns"] = max(file["end_ns"], log_time_ns)
        file["count"] += 1
        self.unflushed += 1
        self._types[topic] = msgtype
        self._counts[topic] = self._counts.get(topic, 0) + 1

    def look(self) -> None:
        """Look whether what is written still lies in the folder.

        Raises `StorageError` when the folder or the file was removed, moved or replaced: what is
        written from here on would be found by nobody. What was moved is complete.
        """
        try:
            lies = lies_at(self.folder / OPEN, self._open.fileno())
            if lies and (self._writer is None or self._writer.in_place):
                return
        except OSError as error:
            raise self._broken(error) from error
        writer, self._writer = self._writer, None
        with suppress(OSError):
            if writer is not None:
                writer.close()
                self.unflushed = 0
        self._open.close()
        raise StorageError(f"{self.folder}: removed, moved or replaced while it was recorded")

    def flush(self) -> None:
        """Bring everything to the disk: from here on a crash loses none of it."""
        if self._writer is None:
            return
        try:
            self._writer.flush()
        except OSError as error:
            raise self._broken(error) from error
        self.unflushed = 0

    def close(self) -> None:
        """Complete the last file, and let go of the folder."""
        try:
            self._finish()
        except OSError as error:
            raise self._broken(error) from error
        self._let_go()

    def _let_go(self) -> None:
        with suppress(OSError):
            if lies_at(self.folder / OPEN, self._open.fileno()):
                (self.folder / OPEN).unlink()
        self._open.close()

    def _begin(self, log_time_ns: int) -> BagWriter:
        name = f"{self.folder.name}_{len(self._files)}.mcap"
        try:
            self._writer = BagWriter(self.folder / name, latched=self._latched)
        except InputError as error:
            raise self._broken(error) from error
        self._files.append(
            {"path": name, "start_ns": log_time_ns, "end_ns": log_time_ns, "count": 0}
        )
        self._describe()
        return self._writer

    def _finish(self) -> None:
        writer, self._writer = self._writer, None
        if writer is not None:
            writer.flush()
            self.unflushed = 0
            writer.close()
            self._describe()

    def _broken(self, error: OSError | InputError) -> StorageError:
        self._writer = None
        self._let_go()
        if isinstance(error, InputError):  # which names the file
            return StorageError(str(error))
        return StorageError(f"{self.folder}: recording broke off: {error.strerror or error}")

    def _describe(self) -> None:
        """Write ``metadata.yaml``."""
        files = self._files
        start, end = min(f["start_ns"] for f in files), max(f["end_ns"] for f in files)
        topics = [
            {
                "topic_metadata": {
                    "name": topic,
                    "type": msgtype,
                    "serialization_format": "cdr",
                    "offered_qos_profiles": offered_qos(topic in self._latched),
                },
                "message_count": self._counts[topic],
            }
            for topic, msgtype in sorted(self._types.items())
        ]
        metadata = {
            "rosbag2_bagfile_information": {
                "version": 5,
                "storage_identifier": "mcap",
                **_times(start, end),
                "message_count": self.messages,
                "topics_with_message_count": topics,
                "compression_format": "",
                "compression_mode": "",
                "relative_file_paths": [f["path"] for f in files],
                "files": [
                    {"path": f["path"], **_times(f["start_ns"], f["end_ns"]),
                     "message_count": f["count"]}
                    for f in files
                ],
            }
        }  # fmt: skip
        try:
            text = yaml.safe_dump(metadata)
            write_text(self.folder / "metadata.yaml", text, durable=True)
        except InputError as error:
            raise self._broken(error) from error


def _times(start_ns: int, end_ns: int) -> dict[str, dict[str, int]]:
    return {
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
    }


#
# A recorder removes what it made and nothing else: its recordings carry a marker that names who
# made them, as which folder. What is a link, lies on another disk, has no marker or was copied is
# left alone, and so is every file in a recording that the recorder did not write.
PREFIX = "robocal_"
MARKER = "robocal_recording.json"  # in a recording's folder: who made it
KEEP = "KEEP"  # a file of this name there: it is never deleted
MB = 1_000_000


@dataclass(frozen=True)
class Maker:
    """A recorder, the same after a restart.

    ``node``: the full name of its node. ``serial``: of its robot; "" without. ``place``: what tells
    it from others of its name where there is no serial: host and ROS domain. ``run``: of this start
    alone; no part of who it is.
    """

    node: str
    serial: str = ""
    place: str = ""
    run: str = field(default_factory=lambda: uuid.uuid4().hex, compare=False)


@dataclass(frozen=True)
class MarkedRecording:
    """A recording as its marker describes it.

    ``number`` counts the recordings of one maker: their order, whatever became of the clock.
    """

    folder: Path
    maker: Maker
    number: int
    begun_ns: int


@dataclass(frozen=True)
class FreedSpace:
    """What became of the attempt to make room.

    ``deleted``: recordings that are gone. ``left``: why something that looks like a recording was
    left alone, by its name. ``short_bytes``: so much is missing to what shall stay free, and no
    deleting would bring it. ``rivals``: recordings that others write who say to be the same
    recorder: what earlier runs made may be theirs, and stays.
    """

    deleted: tuple[Path, ...]
    left: dict[str, str]
    short_bytes: int
    rivals: tuple[Path, ...] = ()


def new_folder(parent: Path, maker: Maker, wall_ns: int | None = None) -> Path:
    """Make the marked folder of a recording that begins now: named by UTC, nobody else's.

    Raises `StorageError` when it cannot be made.
    """
    wall_ns = time.time_ns() if wall_ns is None else wall_ns
    stamp = datetime.fromtimestamp(wall_ns // 1_000_000_000, UTC).strftime("%Y-%m-%dT%H-%M-%SZ")
    folder, again = parent / f"{PREFIX}{stamp}", 1
    try:
        parent.mkdir(parents=True, exist_ok=True)
        number = 1 + max((own.number for own in recordings(parent, maker)), default=0)
        while True:
            try:
                folder.mkdir()
                break
            except FileExistsError:
                again += 1
                folder = parent / f"{PREFIX}{stamp}_{again}"
        mark = asdict(maker) | {"folder": folder.name, "number": number, "begun_ns": wall_ns}
        try:
            text = json.dumps(mark | {"software": __version__})
            write_text(folder / MARKER, f"{text}\n", durable=True)
        except InputError:
            with suppress(OSError):  # the reason is the one to tell
                (folder / MARKER).unlink(missing_ok=True)
                folder.rmdir()
            raise
        sync_folder(parent)
    except (OSError, InputError) as error:
        words = error.strerror or error if isinstance(error, OSError) else error
        raise StorageError(f"{folder}: cannot be made: {words}") from error
    return folder


def recordings(parent: Path, maker: Maker | None = None) -> list[MarkedRecording]:
    """Recordings of a maker, the oldest first; None: of all."""
    found, _ = _look(parent)
    return [one for one in found if maker in (None, one.maker)]


def size_bytes(folder: Path) -> int:
    """What the files of a recording take; those that vanish meanwhile count for nothing."""
    total = 0
    for path in folder.iterdir():
        with suppress(FileNotFoundError):
            state = path.lstat()
            total += state.st_size if stat.S_ISREG(state.st_mode) else 0
    return total


def make_room(parent: Path, maker: Maker, most_bytes: int, least_free_bytes: int) -> FreedSpace:
    """Delete a maker's recordings, the oldest first, until the rest fits and enough is free.

    The newest one stays, and so do those that a process writes or that `keep` marked. One that
    cannot be deleted or measured does not hold up the others. Where deleting all of them did not
    free enough, none is deleted for that.
    """
    if not parent.is_dir():
        return FreedSpace((), {}, 0)
    found, left = _look(parent)
    free, total = shutil.disk_usage(parent).free, 0
    own = [one for one in found if one.maker == maker]
    rivals = [one.folder for one in own if one.maker.run != maker.run and is_open(one.folder)]
    if rivals:
        own = [one for one in own if one.maker.run == maker.run]
    sizes: dict[Path, int] = {}  # of those that may be deleted
    for one in own:
        try:
            size = size_bytes(one.folder)
            total += size
            if not (one is own[-1] or (one.folder / KEEP).exists() or is_open(one.folder)):
                sizes[one.folder] = size
        except OSError as error:
            left[one.folder.name] = f"cannot be measured: {error.strerror or error}"
    short_bytes = max(least_free_bytes - free - sum(sizes.values()), 0)
    deleted = []
    for folder, size in sizes.items():
        if total <= most_bytes and (free >= least_free_bytes or short_bytes):
            break
        try:
            strangers = _delete(folder)
        except OSError as error:
            left[folder.name] = f"cannot be deleted: {error.strerror or error}"
            continue
        if strangers:
            left[folder.name] = f"holds what no recorder wrote: {', '.join(strangers)}"
        deleted.append(folder)
        # counted, not looked at again: some disks give free later what was deleted
        total, free = total - size, free + size
    # names need not be UTF-8, which no log and no message takes
    told = {_printable(name): _printable(why) for name, why in left.items()}
    return FreedSpace(tuple(deleted), told, max(least_free_bytes - free, 0), tuple(rivals))


def _printable(text: str) -> str:
    return text.encode(errors="backslashreplace").decode()


def keep(folder: Path, why: str) -> None:
    """Mark a recording: it is never deleted.

    Raises `InputError` when it cannot be marked.
    """
    if not folder.is_dir():
        raise InputError("no such recording", file=str(folder))
    write_text(folder / KEEP, f"{why}\n", durable=True)


def _look(parent: Path) -> tuple[list[MarkedRecording], dict[str, str]]:
    """Recordings, the oldest first, and why others of such names are none."""
    found, left = [], {}
    if not parent.is_dir():
        return [], {}
    disk = parent.stat().st_dev
    for folder in sorted(parent.glob(f"{PREFIX}*")):
        try:
            found.append(_recording(folder, disk))
        except (InputError, OSError) as error:
            left[folder.name] = str(error)
    found.sort(key=lambda one: (one.number, one.begun_ns, one.folder.name))
    return found, left


def _recording(folder: Path, disk: int) -> MarkedRecording:
    """Read a folder's marker; an error says why it is no recording of a recorder here."""
    state = folder.lstat()
    if stat.S_ISLNK(state.st_mode):
        raise InputError("is a symbolic link")
    if not stat.S_ISDIR(state.st_mode):
        raise InputError("is no folder")
    if state.st_dev != disk:
        raise InputError("lies on another disk")
    marker = folder / MARKER
    if marker.is_symlink() or not marker.is_file():
        raise InputError(f"has no {MARKER}: no recorder made it")
    try:
        mark = json.loads(read_text(marker, "marker"))
        maker = Maker(*(str(mark[key]) for key in ("node", "serial", "place", "run")))
        name, number, begun_ns = mark["folder"], int(mark["number"]), int(mark["begun_ns"])
    except (ValueError, KeyError, TypeError, OverflowError, RecursionError) as error:
        raise InputError(f"has a {MARKER} that cannot be read: {error}") from error
    if name != folder.name:
        raise InputError(f"was copied or renamed: its {MARKER} names {name}")
    return MarkedRecording(folder, maker, number, begun_ns)


def _delete(folder: Path) -> list[str]:
    """Delete the recorder's files, the marker last, and the folder where it is then empty.

    Returns what else lies there, which stays.
    """
    draft = rf"\.(metadata\.yaml|{KEEP}|{re.escape(MARKER)})(\.\d+)+"
    files = rf"{re.escape(folder.name)}_\d+\.mcap|{OPEN}|metadata\.yaml|{draft}"
    strangers = []
    for path in sorted(folder.iterdir()):
        if re.fullmatch(files, path.name) and not path.is_dir():
            path.unlink(missing_ok=True)
        elif path.name != MARKER:
            strangers.append(path.name)
    (folder / MARKER).unlink(missing_ok=True)
    if not strangers:
        with suppress(FileNotFoundError):
            folder.rmdir()
    return strangers
