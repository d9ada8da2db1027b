"""The SQLite file behind a calibration history: place, schema, locks, damage.

A damaged file is never repaired and never deleted: it is set aside under another name. That is
done only by an owner (see `history_damage`), and only while no other process has the file open, so
that two of them cannot go on with two different histories; a lock file beside it (shared while
open, exclusive to set aside) sees to it.
"""

import errno
import fcntl
import os
import sqlite3
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from urllib.parse import quote

from robocal_ros.ground.errors import StorageError, WrongRobotError
from robocal_ros.history.history_damage import set_aside
from robocal_ros.history.history_schema import (
    APPLICATION_ID,
    MIGRATIONS,
    SCHEMA_VERSION,
    DamagedError,
)

_FULL_CHECK_BYTES = 2_000_000
_NOT_READABLE = (sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB)


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
        raise StorageError(f"{path}: {_advice(error)}") from error


def _advice(error: sqlite3.Error | OSError) -> str:
    base = getattr(error, "sqlite_errorcode", 0) & 0xFF
    if isinstance(error, OSError) and error.errno in (errno.ENOLCK, errno.EOPNOTSUPP):
        return f"{error}: the disk knows no locks (NFS?), keep histories on a local one"
    advice = {
        sqlite3.SQLITE_BUSY: "another process holds it; nothing was changed, try again",
        sqlite3.SQLITE_FULL: "the disk is full; nothing was changed, free some space",
        sqlite3.SQLITE_READONLY: "cannot be written; check its owner and permissions",
        sqlite3.SQLITE_CANTOPEN: "cannot be opened; check the folder and its permissions",
        sqlite3.SQLITE_IOERR: "reading or writing failed; check the disk and its free space",
        sqlite3.SQLITE_CORRUPT: "is damaged; start again, then it is set aside",
        sqlite3.SQLITE_NOTADB: "is damaged; start again, then it is set aside",
    }.get(base)
    return f"{error}: {advice}" if advice else str(error)


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

    Attributes
    ----------
    path : the file.
    connection : autocommit SQLite connection.
    damaged : where a damaged predecessor was set aside at this opening, or None.
    created : whether this opening made a new, empty history.
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
        """Open, migrate and check the file; set it aside and begin anew when it is damaged."""
        deadline = time.monotonic() + self._timeout_s
        while not self._open_shared(verify):
            if self._lock_now(fcntl.LOCK_EX):
                self._renew(verify)
            elif time.monotonic() > deadline:
                raise StorageError(
                    f"{self.path}: is missing or damaged while another process has it open; "
                    "stop the nodes that use it, then start again"
                )
            else:
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

        Raises
        ------
        StorageError
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

    def _open_shared(self, verify: Verify) -> bool:
        """Open a file that is there and sound; stays locked against being set aside."""
        if not self.path.exists() or not self._lock_now(fcntl.LOCK_SH):
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
            self._disconnect()
            raise

    def _disconnect(self) -> None:
        if hasattr(self, "connection"):
            self.connection.close()

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

    Raises
    ------
    StorageError
        It cannot be opened, is of a newer version, or is damaged and in use elsewhere or not ours.
    WrongRobotError
        It belongs to another serial.
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
