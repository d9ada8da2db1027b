"""Which folders are recordings and whose, and how room is made on their disk.

A recorder removes what it made and nothing else: its recordings carry a marker that names who made
them, as which folder. What is a link, lies on another disk, has no marker or was copied is left
alone, and so is every file in a recording that the recorder did not write.
"""

import json
import re
import shutil
import stat
import time
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path

from robocal_ros import __version__
from robocal_ros.bags.recording_locks import OPEN, is_open
from robocal_ros.ground.errors import InputError, StorageError
from robocal_ros.ground.files import read_text, write_text

PREFIX = "robocal_"
MARKER = "robocal_recording.json"  # in a recording's folder: who made it
KEEP = "KEEP"  # a file of this name there: it is never deleted
MB = 1_000_000


@dataclass(frozen=True)
class Maker:
    """A recorder, the same after a restart.

    Attributes
    ----------
    node : the full name of its node.
    serial : of its robot; "" without.
    place : what tells it from others of its name where there is no serial: host and ROS domain.
    run : of this start alone; no part of who it is.
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

    Attributes
    ----------
    deleted : recordings that are gone.
    left : why something that looks like a recording was left alone, by its name.
    short_bytes : so much is missing to what shall stay free, and no deleting would bring it.
    rivals : recordings that others write who say to be the same recorder: what earlier runs made
        may be theirs, and stays.
    """

    deleted: tuple[Path, ...]
    left: dict[str, str]
    short_bytes: int
    rivals: tuple[Path, ...] = ()


def new_folder(parent: Path, maker: Maker, wall_ns: int | None = None) -> Path:
    """Make the marked folder of a recording that begins now: named by UTC, nobody else's.

    Raises
    ------
    StorageError
        When it cannot be made.
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
            write_text(folder / MARKER, json.dumps(mark | {"software": __version__}) + "\n")
        except InputError:
            folder.rmdir()
            raise
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

    Raises
    ------
    OSError
        When the folder or its disk cannot be looked at.
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
    return FreedSpace(tuple(deleted), left, max(least_free_bytes - free, 0), tuple(rivals))


def keep(folder: Path, why: str) -> None:
    """Mark a recording: it is never deleted.

    Raises
    ------
    InputError
        When it cannot be marked.
    """
    if not folder.is_dir():
        raise InputError("no such recording", file=str(folder))
    write_text(folder / KEEP, f"{why}\n")


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
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(f"has a {MARKER} that cannot be read: {error}") from error
    if name != folder.name:
        raise InputError(f"was copied or renamed: its {MARKER} names {name}")
    return MarkedRecording(folder, maker, number, begun_ns)


def _delete(folder: Path) -> list[str]:
    """Delete the recorder's files, the marker last, and the folder where it is then empty.

    Returns what else lies there, which stays.
    """
    draft = rf"\.(metadata\.yaml|{KEEP}|{re.escape(MARKER)})\.\d+"
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
