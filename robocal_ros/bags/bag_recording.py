"""A recording that grows: a folder of MCAP files as ``ros2 bag`` makes it.

Each file has an index once it is full; of one that a crash left behind, `BagReader` reads
everything up to the last flush.
"""

from collections.abc import Collection
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

import yaml

from robocal_ros.bags.bag_writer import BagWriter, offered_qos
from robocal_ros.bags.recording_locks import OPEN, hold_open
from robocal_ros.ground.errors import InputError, StorageError
from robocal_ros.ground.files import lies_at, write_text


class BagRecording:
    """Writes one recording; a context manager.

    A new file is begun when one is full. ``metadata.yaml``, which ``ros2 bag play`` looks for,
    names each file from its begin on, so that a crash hides none; its counts are of that time.

    Parameters
    ----------
    folder : made where it is not there; see `recording_folders.new_folder`.
    latched : topics that are published latched; may grow.
    file_bytes : size of a file.

    Raises
    ------
    StorageError
        When it cannot be written; what was written before stays readable.
    """

    def __init__(self, folder: Path, *, latched: Collection[str], file_bytes: int) -> None:
        self.folder, self._latched, self._file_bytes = folder, latched, file_bytes
        self._types: dict[str, str] = {}
        self._counts: dict[str, int] = {}
        self._files: list[dict[str, Any]] = []
        self._writer: BagWriter | None = None
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

        Raises
        ------
        StorageError
            When it cannot be written.
        InputError
            When the type is not known.
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
        self._types[topic] = msgtype
        self._counts[topic] = self._counts.get(topic, 0) + 1

    def look(self) -> None:
        """Look whether what is written still lies in the folder.

        Raises
        ------
        StorageError
            When the folder or the file was removed, moved or replaced: what is written from here on
            would be found by nobody. What was moved is complete.
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
            writer.close()
            self._describe()

    def _broken(self, error: OSError | InputError) -> StorageError:
        self._writer = None
        self._let_go()
        if isinstance(error, InputError):  # which names the file
            return StorageError(str(error))
        return StorageError(f"{self.folder}: recording broke off: {error.strerror or error}")

    def _describe(self) -> None:
        try:
            write_text(self.folder / "metadata.yaml", yaml.safe_dump(self._metadata()))
        except InputError as error:
            raise self._broken(error) from error

    def _metadata(self) -> dict[str, Any]:
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
        return {
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


def _times(start_ns: int, end_ns: int) -> dict[str, dict[str, int]]:
    return {
        "duration": {"nanoseconds": end_ns - start_ns},
        "starting_time": {"nanoseconds_since_epoch": start_ns},
    }
