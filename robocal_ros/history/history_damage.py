"""Damaged histories that were set aside, until a person has taken notice.

A history that begins anew forgets what was in force, so every node that reads it says so, also
after a restart, until ``robocal history acknowledge`` has written who knows of it into
``<serial>/damage/acknowledged.json``. A file that was moved away needs no acknowledgement.
"""

import glob
import json
import time
from pathlib import Path
from typing import Any

from robocal_ros.ground.errors import InputError, StorageError
from robocal_ros.ground.files import made_folder_beside, write_text

COMPANIONS = ("", "-wal", "-shm")
_FILE = "acknowledged.json"


def set_aside(history: Path) -> Path:
    """Rename a history and its companions, the file first; the name that it has now.

    A kill in between leaves a log without its file, which the next opening sets aside too;
    the other way round it would leave an older state that looks healthy.
    """
    stamp = time.strftime("%Y%m%dT%H%M%SZ", time.gmtime())
    aside = Path(f"{history}.damaged-{stamp}")
    number = 1
    while any(Path(f"{aside}{end}").exists() for end in COMPANIONS):
        number += 1
        aside = Path(f"{history}.damaged-{stamp}-{number}")
    for end in COMPANIONS:
        part = Path(f"{history}{end}")
        if part.exists():
            part.rename(f"{aside}{end}")
    return aside


def damaged_files(history: Path) -> tuple[Path, ...]:
    """Histories that were set aside and that nobody has acknowledged, the oldest first."""
    found = set()
    for path in history.parent.glob(f"{glob.escape(history.name)}.damaged-*"):
        name = path.name
        for end in COMPANIONS[1:]:
            name = name.removesuffix(end)
        found.add(name)
    return tuple(history.with_name(name) for name in sorted(found - _acknowledged(history).keys()))


def damage_notice(history: Path) -> str:
    """What a node says of them; empty where there are none."""
    files = damaged_files(history)
    if not files:
        return ""
    return (
        f"a damaged history was set aside as {files[-1]}, and the calibrations began anew: restore "
        "a backup, or acknowledge it with 'robocal history acknowledge'"
    )


def acknowledge(history: Path, by: str, wall_ns: int) -> tuple[Path, ...]:
    """Write down who knows of the damage; returns what was not acknowledged before.

    Raises
    ------
    StorageError
        When it cannot be written.
    """
    files = damaged_files(history)
    if files:
        known = _acknowledged(history) | {
            path.name: {"by": by, "wall_ns": wall_ns} for path in files
        }
        try:
            folder = made_folder_beside(history, "damage")
            write_text(folder / _FILE, json.dumps(known) + "\n", durable=True)
        except InputError as error:
            raise StorageError(str(error)) from error
    return files


def _acknowledged(history: Path) -> dict[str, Any]:
    """By the names of files; empty where it cannot be read: then the nodes say it again."""
    try:
        known = json.loads((history.with_suffix("") / "damage" / _FILE).read_bytes())
    except (OSError, ValueError):
        return {}
    return known if isinstance(known, dict) else {}
