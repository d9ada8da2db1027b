"""Where the histories live: a file per robot serial in the state folder, and what is beside it."""

import itertools
import os
from pathlib import Path
from urllib.parse import quote, unquote

from robocal_ros.ground.errors import InputError, StorageError

_SUFFIX = ".sqlite"
_LONGEST_NAME = 200  # bytes; file systems allow 255, the names of files set aside are longer


def state_folder() -> Path:
    """Folder of the histories: $ROBOCAL_STATE, else ``robocal`` in the XDG state folder.

    Raises
    ------
    StorageError
        There is no home folder to put it in.
    """
    if chosen := os.environ.get("ROBOCAL_STATE"):
        return Path(chosen).absolute()
    base = Path(os.environ.get("XDG_STATE_HOME", ""))
    if not base.is_absolute():  # XDG: unset, empty or relative means the default
        try:
            base = Path.home() / ".local" / "state"
        except RuntimeError as error:
            raise StorageError(f"no home folder: {error}; set ROBOCAL_STATE") from error
    return base / "robocal"


def history_path(serial: str, folder: Path) -> Path:
    """File of a robot serial; any serial gives a safe name, and the serial can be read back.

    Raises
    ------
    InputError
        Empty or too long serial.
    """
    name = quote(serial, safe=" ")
    if name.startswith("."):
        name = "%2E" + name[1:]
    if not serial.strip() or len(name) > _LONGEST_NAME:
        raise InputError(f"robot serial {serial!r}: must have 1 to {_LONGEST_NAME} characters")
    return folder / (name + _SUFFIX)


def unused(folder: Path, stem: str, suffix: str) -> Path:
    """A file that is not there yet: named by its stem, else with a number behind it."""
    names = itertools.chain([stem], (f"{stem}_{number}" for number in itertools.count(2)))
    paths = (folder / (name + suffix) for name in names)
    return next(path for path in paths if not path.exists())


def known_serials(folder: Path) -> list[str]:
    """Robot serials that have a history in the folder."""
    return sorted(unquote(path.name.removesuffix(_SUFFIX)) for path in folder.glob(f"*{_SUFFIX}"))
