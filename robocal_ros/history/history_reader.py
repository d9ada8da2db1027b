"""Opening and reading the calibration history of one robot."""

import logging
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from robocal_ros.ground.errors import Code, InputError, WrongRobotError
from robocal_ros.ground.files import SoleUser
from robocal_ros.ground.proposals import THERMAL, Candidate, Decision, Entry, Head
from robocal_ros.history.correction_record import CorrectionRecord
from robocal_ros.history.correction_records import read_corrections
from robocal_ros.history.history_file import HistoryFile, open_file, storage_errors
from robocal_ros.history.history_paths import history_path, state_folder
from robocal_ros.history.history_records import (
    read_arrays,
    read_candidate,
    read_candidates,
    read_decisions,
    read_json,
)
from robocal_ros.history.history_rules import Ledger

if TYPE_CHECKING:
    from numpy.typing import NDArray

_log = logging.getLogger(__name__)

# As `Ledger.state`, but without reading those that were refused or decided.
_PENDING = (
    "WHERE kind = ? AND based_on = ? AND code = ? AND NOT EXISTS (SELECT 1 FROM decisions "
    "WHERE calibration_id = calibrations.id AND action <> 'rollback') ORDER BY id DESC LIMIT ?"
)

BUSY_TIMEOUT_S = 2.0
"""Longest wait for another process's change, itself a matter of milliseconds."""


class HistoryReader:
    """What a history holds. Use `CalibrationHistory.open`, as a context manager.

    Every method raises `StorageError` when the file cannot be read. Not for several threads at
    once.

    Attributes
    ----------
    serial : the robot.
    path : the file.
    damaged : where a damaged predecessor was set aside at this opening, or None.
    created : whether this opening made a new, empty history.
    """

    def __init__(
        self,
        serial: str,
        file: HistoryFile,
        ledger: Ledger,
        model_hash: str | None,
        sole: SoleUser | None,
    ) -> None:
        self.serial = serial
        self.path = file.path
        self.damaged = file.damaged
        self.created = file.created
        self._file, self._sole = file, sole
        self._ledger = ledger
        self._model_hash = model_hash
        self._own_commits = 0

    @classmethod
    def open(
        cls,
        serial: str,
        *,
        model_hash: str | None = None,
        state_dir: Path | None = None,
        create: bool = True,
        busy_timeout_s: float = BUSY_TIMEOUT_S,
        sole_user: str = "",
        owner: bool = True,
    ) -> Self:
        """Open the history of a robot.

        Parameters
        ----------
        serial : robot serial; any text.
        model_hash : hash of the nominal model in use; what was made for another one is refused.
        state_dir : folder of the histories, default `state_folder()`.
        create : False refuses a robot that has no history.
        busy_timeout_s : longest wait for other processes.
        sole_user : the part that only one process may play for this robot; empty: none.
        owner : sets a damaged file aside and begins anew; others are refused.

        Raises
        ------
        InputError
            Bad serial, or no history and ``create`` is False.
        WrongRobotError
            The file belongs to another serial.
        StorageError
            The file cannot be opened, was made by a newer version, or is damaged and ``owner`` is
            False.
        ConflictError
            Another process plays the part of ``sole_user``.
        """
        path = history_path(serial, state_dir or state_folder())
        if not create and not path.exists():
            raise InputError(f"robot {serial!r} has no calibration history here", file=str(path))
        ledger = Ledger()

        def verify(connection: sqlite3.Connection) -> None:
            nonlocal ledger
            ledger = Ledger()
            ledger.extend(read_decisions(connection, 0))
            for kind in ledger.kinds():
                _, in_force = ledger.head(kind)
                if in_force is not None:
                    read_json(connection, in_force, "model")

        sole = SoleUser(path, sole_user, serial, busy_timeout_s) if sole_user else None
        try:
            file = open_file(path, serial, timeout_s=busy_timeout_s, verify=verify, owner=owner)
        except Exception:
            if sole is not None:
                sole.close()
            raise
        if file.damaged is not None:
            _log.warning(
                "%s was damaged: it is kept as %s, the history of robot %s starts anew with the "
                "nominal model; restore a backup to go on with the former one",
                *(path, file.damaged.name, serial),
            )
        return cls(serial, file, ledger, model_hash, sole)

    def wait_at_most(self, seconds: float) -> None:
        """From now on wait for other processes no longer than so."""
        with storage_errors(self.path):
            self._file.connection.execute(f"PRAGMA busy_timeout = {round(seconds * 1e3)}")

    def close(self) -> None:
        """Close the file; idempotent."""
        self._file.close()
        if self._sole is not None:
            self._sole.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def head(self, kind: str = THERMAL) -> Head:
        """Tell what is in force.

        Raises
        ------
        WrongRobotError
            It was made for another nominal model than the one in use: it must not be applied.
        """
        with self._reading() as connection:
            revision, in_force = self._ledger.head(kind)
            if in_force is not None:
                candidate = read_candidate(connection, in_force)
                self._require_hash(candidate.model_hash, f"calibration {in_force}, in force,")
            return self._head(kind, revision, in_force)

    def heads(self) -> tuple[Head, ...]:
        """Tell what is in force of each kind that ever had a revision, whatever its model hash."""
        with self._reading():
            kinds = self._ledger.kinds()
            return tuple(self._head(kind, *self._ledger.head(kind)) for kind in kinds)

    def list(self, limit: int = 50) -> tuple[Entry, ...]:
        """Latest calibrations, newest first."""
        with self._reading() as connection:
            rows = read_candidates(connection, "ORDER BY id DESC LIMIT ?", max(limit, 0))
            return tuple(self._entry(*row) for row in rows)

    def get(self, calibration_id: int) -> Entry:
        """One calibration.

        Raises
        ------
        InputError
            Unknown id.
        """
        with self._reading() as connection:
            return self._entry(calibration_id, read_candidate(connection, calibration_id))

    def pending(self, kind: str = THERMAL, limit: int = -1) -> tuple[Entry, ...]:
        """Calibrations that can be accepted now, newest first; ``limit``: so many at the most."""
        with self._reading() as connection:
            revision, _ = self._ledger.head(kind)
            rows = read_candidates(connection, _PENDING, kind, revision, Code.ACCEPT, limit)
            return tuple(self._entry(*row) for row in rows)

    def decisions(self, after_seq: int = 0, newest: int = -1) -> tuple[Decision, ...]:
        """Decisions of every kind after a sequence number, oldest first.

        ``newest``: the latest so many at the most, at a cost that does not grow with the history.
        """
        with self._reading() as connection:
            return read_decisions(connection, after_seq, newest)

    def corrections(self, limit: int = 50) -> tuple[CorrectionRecord, ...]:
        """What the robot's commands were corrected with, newest first."""
        with self._reading() as connection:
            return tuple(read_corrections(connection, limit))

    def document(self, calibration_id: int) -> dict[str, Any]:
        """JSON document of the identification. Raises `InputError` for an unknown id."""
        with self._reading() as connection:
            return read_json(connection, calibration_id, "document")

    def model(self, calibration_id: int) -> dict[str, Any]:
        """Model in full precision. Raises `InputError` for an unknown id."""
        with self._reading() as connection:
            return read_json(connection, calibration_id, "model")

    def inputs(self, calibration_id: int) -> "dict[str, NDArray[Any]]":
        """Arrays it was solved from, bit for bit. Raises `InputError` for an unknown id."""
        with self._reading() as connection:
            return read_arrays(connection, calibration_id)

    def data_version(self) -> int:
        """Cheap number that differs after each change of the file, by this process or another.

        Meant to be polled. Raises `StorageError` when the file was deleted or replaced.
        """
        self._file.require_in_place()
        with storage_errors(self.path):
            row = self._file.connection.execute("PRAGMA data_version").fetchone()
        return int(row[0]) + self._own_commits

    def _entry(self, calibration_id: int, candidate: Candidate) -> Entry:
        standing = self._ledger.standing(calibration_id)
        return Entry(
            **vars(candidate),
            id=calibration_id,
            state=self._ledger.state(calibration_id, candidate),
            revision=standing.revision,
            decisions=standing.decisions,
        )

    def _head(self, kind: str, revision: int, calibration_id: int | None) -> Head:
        model = None
        if calibration_id is not None:
            model = read_json(self._file.connection, calibration_id, "model")
        return Head(kind, revision, calibration_id, model)

    def _require_hash(self, found: str, what: str) -> None:
        if self._model_hash is not None and found != self._model_hash:
            raise WrongRobotError(
                f"{what} was made for the nominal model {found}, but {self._model_hash} is in "
                "use: load that robot file, or roll back to nominal and measure again"
            )

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        """One consistent view of the present state."""
        with self._transaction("BEGIN") as connection:
            yield connection

    @contextmanager
    def _transaction(self, begin: str) -> Iterator[sqlite3.Connection]:
        connection = self._file.connection
        with storage_errors(self.path):
            connection.execute(begin)
            try:
                self._ledger.extend(read_decisions(connection, self._ledger.last_seq))
                yield connection
                connection.execute("COMMIT")
            finally:
                if connection.in_transaction:
                    connection.execute("ROLLBACK")
