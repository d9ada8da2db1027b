"""Small helpers that the readers and writers of files share."""

import difflib
import os
import threading
from collections.abc import Iterable
from pathlib import Path

from robocal_ros.ground.errors import InputError, StorageError

MOST_QUOTED = 60


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

    Raises
    ------
    InputError
        When the file is missing or unreadable.
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

    Raises
    ------
    InputError
        When the file is missing, unreadable, empty or not UTF-8.
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
    """Write a whole file or nothing: a reader never sees one that is half-written.

    ``durable``: on the disk when this returns; not even a power cut loses it.

    Raises
    ------
    InputError
        When the file cannot be written.
    """
    draft = draft_beside(path)
    try:
        with draft.open("w", encoding="utf-8", newline="") as stream:
            stream.write(text)
            if durable:
                stream.flush()
                os.fsync(stream.fileno())
        draft.replace(path)
        if durable:
            sync_folder(path.parent)
    except OSError as error:
        draft.unlink(missing_ok=True)
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
    """Bring the names in a folder to the disk; an `OSError` where that fails."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def made_folder_beside(history: Path, name: str) -> Path:
    """Folder of further files of a history's robot, ``<serial>/<name>`` beside it; made if need be.

    Raises
    ------
    StorageError
        When it cannot be made.
    """
    folder = history.with_suffix("") / name
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"the folder {folder} cannot be made: {error.strerror}") from error
    return folder
