# SPDX-License-Identifier: Apache-2.0
"""The SQLite file behind a calibration history: place, schema, locks, damage.

A damaged file is never repaired and never deleted: it is set aside under another name. That is
done only by an owner (see `history_damage`), and only while no other process has the file open, so
that two of them cannot go on with two different histories; a lock file beside it (shared while
open, exclusive to set aside) sees to it.
"""

import errno
import fcntl
import glob
import itertools
import json
import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote, unquote

from robocal_ros.ground.errors import InputError, StorageError, WrongRobotError
from robocal_ros.ground.files import made_folder_beside, write_text

# ---- history schema -----------------------------------------------------------------------------
#
# Calibrations, their payloads, the decisions about them and what commands were corrected with are
# only ever added to; triggers refuse changes by any program.


APPLICATION_ID = 0x52434C48
"""Marks the file as ours ("RCLH"), so that no other program's database is ever migrated."""


def _append_only(*tables: str) -> tuple[str, ...]:
    return tuple(
        f"CREATE TRIGGER {table}_{verb.lower()} BEFORE {verb} ON {table} "
        f"BEGIN SELECT RAISE(ABORT, '{table} are never changed'); END"
        for table in tables
        for verb in ("UPDATE", "DELETE")
    )


MIGRATIONS: tuple[tuple[str, ...], ...] = (
    (
        "CREATE TABLE history (serial TEXT NOT NULL)",
        """CREATE TABLE calibrations (
            id INTEGER PRIMARY KEY AUTOINCREMENT,
            kind TEXT NOT NULL,
            model_hash TEXT NOT NULL,
            based_on INTEGER NOT NULL CHECK (based_on >= 0),
            cycle_id TEXT NOT NULL,
            stamp_ns INTEGER NOT NULL,
            created_ns INTEGER NOT NULL,
            software TEXT NOT NULL,
            method TEXT NOT NULL,
            code INTEGER NOT NULL,
            reason TEXT NOT NULL,
            candidate_rms_mm REAL,
            UNIQUE (id, kind))""",
        # Apart from the small tables, so that opening and listing never read through them.
        """CREATE TABLE payloads (
            calibration_id INTEGER NOT NULL REFERENCES calibrations (id),
            name TEXT NOT NULL CHECK (name IN ('document', 'model', 'inputs')),
            data BLOB NOT NULL,
            sha256 BLOB NOT NULL,
            PRIMARY KEY (calibration_id, name))""",
        """CREATE TABLE decisions (
            seq INTEGER PRIMARY KEY AUTOINCREMENT,
            kind TEXT NOT NULL,
            action TEXT NOT NULL CHECK (action IN ('accept', 'reject', 'rollback')),
            calibration_id INTEGER,
            by TEXT NOT NULL,
            reason TEXT NOT NULL,
            wall_ns INTEGER NOT NULL,
            head_before INTEGER NOT NULL CHECK (head_before >= 0),
            head_after INTEGER NOT NULL,
            CHECK (head_after = head_before + (action <> 'reject')),
            CHECK (calibration_id IS NOT NULL OR action = 'rollback'),
            FOREIGN KEY (calibration_id, kind) REFERENCES calibrations (id, kind))""",
        # The last line of defence for compare-and-set: no revision can be given twice.
        "CREATE UNIQUE INDEX one_revision ON decisions (kind, head_after) WHERE action <> 'reject'",
        "CREATE UNIQUE INDEX one_decision ON decisions (calibration_id) WHERE action <> 'rollback'",
        *_append_only("calibrations", "payloads", "decisions"),
    ),
    (
        """CREATE TABLE corrections (
            seq INTEGER PRIMARY KEY AUTOINCREMENT,
            wall_ns INTEGER NOT NULL,
            software TEXT NOT NULL,
            model_hash TEXT NOT NULL,
            enabled INTEGER NOT NULL CHECK (enabled IN (0, 1)),
            shadow INTEGER NOT NULL CHECK (shadow IN (0, 1)),
            model_revision INTEGER NOT NULL CHECK (model_revision >= 0),
            tool_revision INTEGER NOT NULL CHECK (tool_revision >= 0),
            reference TEXT NOT NULL CHECK (reference IN ('nominal', 'calibrated')),
            reference_source TEXT NOT NULL,
            reference_name TEXT NOT NULL,
            reference_hash TEXT NOT NULL,
            taught_tool TEXT NOT NULL)""",
        *_append_only("corrections"),
    ),
    # What waits is asked for all the time, and must not take longer with each year.
    ("CREATE INDEX of_a_revision ON calibrations (kind, based_on, code)",),
)
"""Script ``n`` brings schema version ``n`` to ``n + 1``; shipped ones are never edited."""

SCHEMA_VERSION = len(MIGRATIONS)


class DamagedError(Exception):
    """The file, or something in it, cannot be trusted."""


# ---- damaged histories that were set aside, until a person has taken notice ---------------------
#
# A history that begins anew forgets what was in force, so every node that reads it says so, also
# after a restart, until ``robocal history acknowledge`` has written who knows of it into
# ``<serial>/damage/acknowledged.json``. A file that was moved away needs no acknowledgement.


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

    Raises `StorageError` when it cannot be written.
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


# ---- the SQLite file behind a calibration history: place, schema, locks, damage -----------------


MAKING_S = 15.0  # a new file is brought to the disk, which may be slow and busy
_FULL_CHECK_BYTES = 2_000_000
_NOT_READABLE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)
_ADVICE = {
    sqlite3.SQLITE_BUSY: ": another process holds it; nothing was changed, try again",
    sqlite3.SQLITE_FULL: ": the disk is full; nothing was changed, free some space",
    sqlite3.SQLITE_READONLY: ": cannot be written; check its owner and permissions",
    sqlite3.SQLITE_CANTOPEN: ": cannot be opened; check the folder and its permissions",
    sqlite3.SQLITE_IOERR: ": reading or writing failed; check the disk and its free space",
    sqlite3.SQLITE_CORRUPT: ": is damaged; start again, then it is set aside",
    sqlite3.SQLITE_NOTADB: ": is damaged; start again, then it is set aside",
}


@contextmanager
def storage_errors(path: Path) -> Iterator[None]:
    """Turn SQLite's and the system's errors into `StorageError` with what to do."""
    try:
        yield
    except DamagedError as error:
        raise StorageError(f"{path}: {error}; restore a backup") from error
    except sqlite3.IntegrityError:
        raise  # a rule of the schema was broken: a bug, not a storage failure
    except (sqlite3.Error, OSError) as error:
        advice = _ADVICE.get(getattr(error, "sqlite_errorcode", 0) & 0xFF, "")
        if isinstance(error, OSError) and error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
            advice = ": the disk knows no locks (NFS?), keep histories on a local one"
        raise StorageError(f"{path}: {error}{advice}") from error


@contextmanager
def _damage(*codes: int) -> Iterator[None]:
    """Turn SQLite's errors of these kinds into `DamagedError`."""
    try:
        yield
    except sqlite3.DatabaseError as error:
        if getattr(error, "sqlite_errorcode", 0) & 0xFF in codes:
            raise DamagedError(str(error)) from error
        raise


Verify = Callable[[sqlite3.Connection], None]
"""Raises `DamagedError` when the contents make no sense."""


class HistoryFile:
    """One open history file. Use `open_file`.

    ``path``: the file. ``connection``: autocommit SQLite connection. ``damaged``: where a damaged
    predecessor was set aside at this opening, or None. ``created``: whether this opening made a
    new, empty history.
    """

    def __init__(self, path: Path, serial: str, timeout_s: float, *, owner: bool) -> None:
        self.path, self._owner = path, owner
        self.damaged: Path | None = None
        self.created = False
        self._serial = serial
        self._timeout_s = timeout_s
        self._lock = os.open(f"{path}.lock", os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        self.connection: sqlite3.Connection

    def open(self, verify: Verify) -> None:
        """Open, migrate and check the file; set it aside and begin anew when it is damaged.

        It stays locked against being set aside. Of several that begin at once one makes it.
        """
        waits_for, since_s = "", 0.0
        while True:
            if not self._lock_now(fcntl.LOCK_SH):
                most_s = MAKING_S if self._owner else self._timeout_s
                why = f"another process has been making it, or setting it aside, for {most_s:g} s"
            elif self._sound(verify):
                break
            elif self._lock_now(fcntl.LOCK_EX):
                self._renew(verify)
                continue
            else:
                most_s = self._timeout_s
                why = (
                    "is missing or damaged while another process has it open; stop the nodes that "
                    "use it, then start again"
                )
            if why != waits_for:
                waits_for, since_s = why, time.monotonic()
            elif time.monotonic() - since_s > most_s:
                raise StorageError(f"{self.path}: {why}")
            time.sleep(0.005)
        state = self.path.stat()
        self._identity = (state.st_dev, state.st_ino)

    def close(self) -> None:
        """Close the file; idempotent."""
        if hasattr(self, "connection"):
            self.connection.close()
        if self._lock >= 0:
            os.close(self._lock)
        self._lock = -1

    def require_in_place(self) -> None:
        """Refuse to go on with a file that was deleted or replaced while it was open.

        Raises `StorageError`.
        """
        try:
            state = self.path.stat()
            there = (state.st_dev, state.st_ino) == self._identity
        except OSError:
            there = False
        if not there:
            raise StorageError(
                f"{self.path}: was deleted or replaced while in use; nothing was changed, "
                "restart this program to go on with the file that is there now"
            )

    def _lock_now(self, mode: int) -> bool:
        fcntl.flock(self._lock, fcntl.LOCK_UN)
        try:
            fcntl.flock(self._lock, mode | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        return True

    def _sound(self, verify: Verify) -> bool:
        """Open a file that is there and sound."""
        if not self.path.exists():
            return False
        try:
            self._connect(verify)
        except DamagedError:
            return False
        return True

    def _renew(self, verify: Verify) -> None:
        """Make the file, alone; what is there and damaged is set aside."""
        try:  # another process may have made it or set it aside meanwhile
            self._connect(verify)
        except DamagedError as error:
            if not self._owner:
                raise DamagedError(
                    f"is damaged ({error}) and was not touched: thermal_node, tcf_node, "
                    "hand_eye_node and maintenance_node set it aside when they start"
                ) from error
            self.damaged = set_aside(self.path)
            self._connect(verify)
        self.connection.close()

    def _connect(self, verify: Verify) -> None:
        existed = self.path.exists()
        if not existed and Path(f"{self.path}-wal").exists():
            raise DamagedError("a write-ahead log without its file")
        try:
            with _damage(*_NOT_READABLE):
                if existed:
                    self._refuse_foreign()
                self.connection = sqlite3.connect(
                    self.path, timeout=self._timeout_s, isolation_level=None
                )
                for setting in ("journal_mode=WAL", "synchronous=FULL", "foreign_keys=ON"):
                    self.connection.execute(f"PRAGMA {setting}")
                self._migrate()
            with _damage(*_NOT_READABLE, sqlite3.SQLITE_ERROR):  # the last: a table is missing
                self._check()
                verify(self.connection)
        except BaseException:
            if hasattr(self, "connection"):
                self.connection.close()
            raise

    def _refuse_foreign(self) -> None:
        """Look at the file without touching it: closing a writable one would write to it.

        Where a killed writer left a rollback journal, SQLite must undo that write to read at all.
        """
        try:
            version, mark, tables = self._probe("ro")
        except sqlite3.OperationalError as error:
            if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_READONLY:
                raise
            version, mark, tables = self._probe("rw")
        if mark != APPLICATION_ID and (mark or tables):
            raise StorageError(f"{self.path}: is not a calibration history; it was not touched")
        if version > SCHEMA_VERSION:
            raise StorageError(
                f"{self.path}: has schema version {version}, this program knows "
                f"{SCHEMA_VERSION}: made by a newer robocal, update this one; "
                "the file was not touched"
            )

    def _probe(self, mode: str) -> tuple[int, int, int]:
        """Schema version, application and number of schema entries of whatever file this is."""
        probe = sqlite3.connect(
            f"file:{quote(str(self.path))}?mode={mode}", uri=True, timeout=self._timeout_s
        )
        try:
            version = probe.execute("PRAGMA user_version").fetchone()[0]
            mark = probe.execute("PRAGMA application_id").fetchone()[0]
            return version, mark, probe.execute("SELECT count(*) FROM sqlite_master").fetchone()[0]
        finally:
            probe.close()

    def _migrate(self) -> None:
        if self._version() == SCHEMA_VERSION:
            return
        self.connection.execute("BEGIN IMMEDIATE")
        try:
            start = self._version()  # another process may have migrated it meanwhile
            for script in MIGRATIONS[start:]:
                for statement in script:
                    self.connection.execute(statement)
            if start == 0:
                self.connection.execute("INSERT INTO history VALUES (?)", (self._serial,))
                self.connection.execute(f"PRAGMA application_id={APPLICATION_ID}")
            self.connection.execute(f"PRAGMA user_version={SCHEMA_VERSION}")
            self.connection.execute("COMMIT")
        finally:
            if self.connection.in_transaction:
                self.connection.execute("ROLLBACK")
        self.created = self.created or start == 0

    def _version(self) -> int:
        return int(self.connection.execute("PRAGMA user_version").fetchone()[0])

    def _check(self) -> None:
        """Check the structure.

        A full check reads every page, which takes seconds in a file of years; there the tables
        that decide what is in force are checked, and each payload when it is read, by digest.
        """
        run = self.connection.execute
        pages, page_bytes = (run(f"PRAGMA {n}").fetchone()[0] for n in ("page_count", "page_size"))
        whole = pages * page_bytes <= _FULL_CHECK_BYTES
        for part in ("1",) if whole else ("history", "calibrations", "decisions"):
            found = run(f"PRAGMA integrity_check({part})").fetchone()[0]
            if found != "ok":
                raise DamagedError(str(found))
        serials = [row[0] for row in run("SELECT serial FROM history")]
        if len(serials) != 1:
            raise DamagedError("the file names no robot")
        if serials[0] != self._serial:
            raise WrongRobotError(
                f"{self.path}: is the history of robot {serials[0]!r}, not {self._serial!r}"
            )


def open_file(
    path: Path, serial: str, *, timeout_s: float, verify: Verify, owner: bool = True
) -> HistoryFile:
    """Open a history file; ``verify`` raises `DamagedError` when its contents make no sense.

    ``owner``: a damaged one is set aside.

    Raises `StorageError`: it cannot be opened, is of a newer version, or is damaged and in use
    elsewhere or not ours; `WrongRobotError`: it belongs to another serial.
    """
    with storage_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        file = HistoryFile(path, serial, timeout_s, owner=owner)
        try:
            file.open(verify)
        except BaseException:
            file.close()
            raise
    return file


# ---- history paths ------------------------------------------------------------------------------


_SUFFIX = ".sqlite"
_LONGEST_NAME = 200  # bytes; file systems allow 255, the names of files set aside are longer


def state_folder() -> Path:
    """Folder of the histories: $ROBOCAL_STATE, else ``robocal`` in the XDG state folder.

    Raises `StorageError`: there is no home folder to put it in.
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

    Raises `InputError`: empty or too long serial.
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
