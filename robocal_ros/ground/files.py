# SPDX-License-Identifier: Apache-2.0
"""Small helpers that the readers and writers of files share."""

import contextlib
import difflib
import errno
import fcntl
import json
import os
import sys
import threading
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from robocal_ros.ground.errors import ConflictError, InputError, StateLostError, StorageError

MOST_QUOTED = 60
NO_SYNC = {errno.EINVAL, errno.ENOSYS, errno.EOPNOTSUPP}  # shares that cannot sync a folder


def quoted(value: object) -> str:
    """A user's text for a message: in quotes, on one line, cut where it is long."""
    return f"'{shortened(value)}'"


def shortened(value: object) -> str:
    """A user's text on one line, cut where it is long."""
    text = " ".join(str(value).split())
    return text if len(text) <= MOST_QUOTED else f"{text[:MOST_QUOTED]}…"


def nearest(name: str, known: Iterable[str]) -> str:
    """Words that suggest the known name nearest to ``name``: `` (did you mean 'x_mm'?)``, or none.

    Upper and lower case count as equal.
    """
    folded = {word.casefold(): word for word in known}
    found = difflib.get_close_matches(name.casefold(), folded, n=1, cutoff=0.5)
    return f" (did you mean '{folded[found[0]]}'?)" if found else ""


def read_bytes(path: Path, what: str) -> bytes:
    """Content of a file.

    Raises `InputError` when the file is missing or unreadable.
    """
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise InputError(f"no such {what}", file=str(path)) from error
    except OSError as error:
        reason = error.strerror or error
        raise InputError(f"this {what} cannot be read: {reason}", file=str(path)) from error


def read_text(path: Path, what: str) -> str:
    """Text of a UTF-8 file, without a byte order mark.

    Raises `InputError` when the file is missing, unreadable, empty or not UTF-8.
    """
    data = read_bytes(path, what)
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        message = f"byte {error.start} is not UTF-8 text; save the {what} as UTF-8"
        raise InputError(message, file=str(path)) from error
    if not text.strip():
        raise InputError(f"this {what} is empty", file=str(path))
    return text


def draft_beside(path: Path) -> Path:
    """What is to become ``path``, of this thread alone: nodes in one process may share a file."""
    return path.with_name(f".{path.name}.{os.getpid()}.{threading.get_ident()}")


def write_text(path: Path, text: str, *, durable: bool = False) -> None:
    """Write a text as UTF-8; see `write_bytes`."""
    write_bytes(path, text.encode(), durable=durable)


def write_bytes(path: Path, data: bytes, *, durable: bool = False) -> None:
    """Write a whole file or nothing: a reader never sees one that is half-written.

    ``durable``: on the disk when this returns; not even a power cut loses it.

    Raises `InputError` when the file cannot be written.
    """
    draft = draft_beside(path)
    try:
        with draft.open("wb") as stream:
            stream.write(data)
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        draft.replace(path)
        if durable:
            sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):  # a disk that is read-only refuses this too
            draft.unlink()
        reason = error.strerror or error
        raise InputError(f"cannot be written: {reason}", file=str(path)) from error


def lies_at(path: Path, descriptor: int) -> bool:
    """Whether an open file is the one of this name: neither removed, moved nor replaced."""
    try:
        found = path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        return False
    return os.path.samestat(found, os.fstat(descriptor))


def sync_folder(folder: Path) -> None:
    """Bring the names in a folder to the disk, where it can; an `OSError` where that fails."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in NO_SYNC:
            raise
    finally:
        os.close(descriptor)


def made_folder_beside(history: Path, name: str) -> Path:
    """Folder of further files of a history's robot, ``<serial>/<name>`` beside it; made if need be.

    Raises `StorageError` when it cannot be made.
    """
    folder = history.with_suffix("") / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"the folder {folder} cannot be made: {error.strerror}") from error
    return folder


# ---- where files that come with the packages are found, with and without ROS --------------------


SOURCE_ROOT = Path(__file__).resolve().parents[2]


def share_folders(package: str, inside: str, source: str) -> list[Path]:
    """Existing folders ``share/<package>/<inside>`` of all prefixes, the best first.

    Those of ROS, of this installation and of Python. ``source`` is the same folder in the source
    tree; it comes before the installed ones.
    """
    named = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    prefixes = [Path(prefix) for prefix in named if prefix]
    prefixes += [folder for folder in SOURCE_ROOT.parents if (folder / "share").is_dir()]
    prefixes += [Path(sys.prefix)]
    installed = (prefix / "share" / package / inside for prefix in prefixes)
    candidates = dict.fromkeys([SOURCE_ROOT / source, *installed])
    return [folder for folder in candidates if folder.is_dir()]


# ---- state files --------------------------------------------------------------------------------


STATE = "state.json"


class StateFile:
    """One JSON document, ``<serial>/<name>/state.json`` beside a history; empty at first.

    Raises `StorageError` when it, or its folder, cannot be made.
    """

    def __init__(self, history: Path, name: str) -> None:
        folder = history.with_suffix("") / name
        self.path = folder / STATE
        if folder.exists():  # from then on a file that is missing was lost
            return
        # The folder with the file in it, unless another makes it first.
        draft = made_folder_beside(history, draft_beside(folder).name)
        try:
            write_text(draft / STATE, "{}", durable=True)
            draft.rename(folder)
        except InputError as error:
            raise StorageError(str(error)) from error
        except OSError as error:
            if not folder.exists():
                raise StorageError(f"{folder} cannot be made: {error.strerror}") from error
        finally:
            if draft.exists():
                (draft / STATE).unlink(missing_ok=True)
                draft.rmdir()
        for parent in (folder.parent, history.parent):
            try:
                sync_folder(parent)
            except OSError as error:
                raise StorageError(f"{parent} cannot be brought to the disk: {error}") from error

    def load(self) -> Mapping[str, Any] | None:
        """The document; None before the first.

        Raises `StateLostError` when it was there once; `StorageError` when it cannot be read.
        """
        if not self.path.exists():
            raise StateLostError(f"{self.path} is gone: what it told is forgotten")
        try:
            document = json.loads(read_text(self.path, "state file"))
        except (InputError, ValueError) as error:
            words = f"{self.path} cannot be read: {error}; restore it, or move it away"
            raise StorageError(words) from error
        if not isinstance(document, dict):
            raise StorageError(f"{self.path} holds no document: move it away")
        return document or None

    def save(self, document: Mapping[str, Any]) -> None:
        """Put a document in its place.

        Raises `StorageError` when it cannot be written, or a number is not finite; the one before
        is still there.
        """
        try:
            write_text(self.path, json.dumps(document, allow_nan=False), durable=True)
        except InputError as error:
            raise StorageError(str(error)) from error
        except ValueError as error:
            raise StorageError(f"{self.path}: {error}") from error


# ---- a part of a cell that one process at a time may play for a robot ---------------------------


_POLL_S = 0.01


class SoleUser:
    """Holds ``<serial>/users/<name>`` beside a history; the system lets go of it with the process.

    Two robots that keep one history would bring each other's calibrations into force.

    ``name``: the part, as the executable is called.
    ``timeout_s``: longest wait for one that is just ending.

    Raises `ConflictError`: another process holds it; `StorageError`: the file cannot be made.
    """

    def __init__(self, history: Path, name: str, serial: str, timeout_s: float) -> None:
        path = made_folder_beside(history, "users") / name
        try:
            self._file = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise StorageError(f"{path} cannot be made: {error}") from error
        deadline = time.monotonic() + timeout_s
        try:
            while not self._held():
                if time.monotonic() > deadline:
                    other = os.pread(self._file, 20, 0).decode(errors="replace").strip()
                    self.close()
                    raise ConflictError(
                        f"another {name} (process {other or 'unknown'}) keeps the calibrations of "
                        f"robot '{serial}' in {history}: end it, or give each robot its own serial"
                    )
                time.sleep(_POLL_S)
        except OSError as error:
            self.close()
            raise StorageError(
                f"{path} cannot be locked: {error}: keep histories on a local disk, not on NFS"
            ) from error
        with contextlib.suppress(OSError):  # a full disk: it is held, by whom is not told
            os.ftruncate(self._file, 0)
            os.pwrite(self._file, f"{os.getpid()}\n".encode(), 0)

    def _held(self) -> bool:
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def close(self) -> None:
        """Let go of it; idempotent."""
        if self._file >= 0:
            os.close(self._file)
        self._file = -1
