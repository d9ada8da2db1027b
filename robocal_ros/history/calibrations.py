# SPDX-License-Identifier: Apache-2.0
"""The calibration history of one robot: proposed, accepted, rejected, rolled back; never lost.

A change is one SQLite transaction: a process killed at any moment leaves the state before it or
the state after it. Accept and rollback compare the revision in force before they set the new one,
under the write lock, so that of two at once one wins and the other gets a `ConflictError`; so
are revisions of other kinds that a calibration needs beside it.
"""

import logging
import sqlite3
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RobocalError,
    StaleError,
    WrongRobotError,
)
from robocal_ros.ground.files import SoleUser
from robocal_ros.history.history_file import (
    DamagedError,
    HistoryFile,
    history_path,
    open_file,
    state_folder,
    storage_errors,
)
from robocal_ros.history.history_records import (
    FIXTURE,
    THERMAL,
    Action,
    CalibrationState,
    Candidate,
    CorrectionRecord,
    Decision,
    Entry,
    Head,
    Past,
    read_arrays,
    read_candidate,
    read_candidates,
    read_corrections,
    read_decisions,
    read_json,
    require_measured_with,
    rows_up_to,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

from robocal_ros.history.history_records import (
    Proposal,
    insert_correction,
    insert_decision,
    insert_proposal,
    measured_with,
    packed,
)

# ---- the rules of accept, reject and rollback, as a fold over the decisions log -----------------
#
# The log alone says what is in force: there is no second place that could disagree with it.


NOMINAL = 0
"""As a rollback's target: the nominal model."""


class VerdictError(RobocalError):
    """A calibration whose own verdict refuses it; ``code`` is that verdict."""

    def __init__(self, message: str, code: Code) -> None:
        super().__init__(message)
        self.code = code


@dataclass
class _Standing:
    """What the log says of one calibration."""

    revision: int = 0  # as which it was accepted
    parent: int | None = None  # what was in force before it; None = nominal
    rejected: bool = False
    left: CalibrationState | None = None  # how it went out of force
    decisions: tuple[Decision, ...] = ()


class Ledger:
    """The decisions log, folded: what is in force, and where each calibration stands."""

    def __init__(self) -> None:
        self.last_seq = 0
        self._heads: dict[str, tuple[int, int | None]] = {}
        self._standings: dict[int, _Standing] = {}

    def head(self, kind: str) -> tuple[int, int | None]:
        """Revision in force and its calibration (None = nominal)."""
        return self._heads.get(kind, (0, None))

    def kinds(self) -> list[str]:
        """Kinds that have ever had a revision."""
        return sorted(self._heads)

    def standing(self, calibration_id: int) -> _Standing:
        """Tell what the log says of a calibration; the default when it says nothing."""
        return self._standings.get(calibration_id, _Standing())

    def state(self, calibration_id: int, candidate: Candidate) -> CalibrationState:
        """Where a calibration stands."""
        standing = self.standing(calibration_id)
        revision, in_force = self.head(candidate.kind)
        if calibration_id == in_force:
            return CalibrationState.IN_FORCE
        if standing.left is not None:
            return standing.left
        if standing.rejected:
            return CalibrationState.REJECTED
        if candidate.code is not Code.ACCEPT:
            return CalibrationState.REFUSED
        return (
            CalibrationState.PENDING if candidate.based_on == revision else CalibrationState.STALE
        )

    def extend(self, decisions: Iterable[Decision]) -> None:
        """Add the decisions that follow. Raises `DamagedError`, see `apply`."""
        for decision in decisions:
            self.apply(decision)

    def apply(self, decision: Decision) -> None:
        """Add the next decision.

        Raises `DamagedError`: it does not follow from the decisions before it.
        """
        revision, in_force = self.head(decision.kind)
        step = 0 if decision.action is Action.REJECT else 1
        chained = decision.head_before == revision and decision.head_after == revision + step
        target = decision.calibration_id
        before = None if target is None else self.standing(target)
        if decision.action is Action.ROLLBACK:
            possible = target != in_force and (before is None or before.revision > 0)
        else:
            possible = before is not None and not before.rejected and before.revision == 0
        if not chained or not possible:
            raise DamagedError(f"decision {decision.seq} contradicts those before it")
        if decision.calibration_id is not None:
            standing = self._standings.setdefault(decision.calibration_id, _Standing())
            standing.decisions += (decision,)
            if decision.action is Action.REJECT:
                standing.rejected = True
            elif decision.action is Action.ACCEPT:
                standing.revision, standing.parent = decision.head_after, in_force
        if decision.action is not Action.REJECT:
            if in_force is not None:
                out = self._standings[in_force]
                accepted = decision.action is Action.ACCEPT
                out.left = CalibrationState.SUPERSEDED if accepted else CalibrationState.ROLLED_BACK
                out.decisions += (decision,)
            self._heads[decision.kind] = (decision.head_after, decision.calibration_id)
        self.last_seq = decision.seq

    def check_open(self, calibration_id: int) -> None:
        """Refuse a calibration that was decided before.

        Raises `ConflictError`.
        """
        standing = self.standing(calibration_id)
        if standing.revision:
            raise ConflictError(
                f"calibration {calibration_id} was accepted already, as revision "
                f"{standing.revision}; to return to it use rollback"
            )
        if standing.rejected:
            raise ConflictError(
                f"calibration {calibration_id} was rejected by "
                f"{standing.decisions[-1].by or 'an unnamed person'}; measure again"
            )

    def check_head(self, kind: str, expected: int | None) -> None:
        """Refuse when another revision is in force than the caller believes.

        Raises `ConflictError`.
        """
        revision, _ = self.head(kind)
        if expected is not None and expected != revision:
            raise ConflictError(
                f"{kind} revision {revision} is in force, not {expected}: another change came "
                "first; look at the list and decide again"
            )

    def check_accept(
        self,
        calibration_id: int,
        candidate: Candidate,
        expected: int | None,
        with_heads: Mapping[str, int],
    ) -> None:
        """Refuse what must not come into force.

        Raises `ConflictError`, `VerdictError` or `StaleError`.
        """
        self.check_open(calibration_id)
        if candidate.code is not Code.ACCEPT:
            raise VerdictError(
                f"calibration {calibration_id} was judged {candidate.code.name}: "
                f"{candidate.reason}; it cannot be accepted",
                candidate.code,
            )
        self.check_head(candidate.kind, expected)
        revision, _ = self.head(candidate.kind)
        if candidate.based_on != revision:
            raise StaleError(
                f"calibration {calibration_id} was solved against {candidate.kind} revision "
                f"{candidate.based_on}, but {revision} is in force; measure again"
            )
        what = f"{candidate.kind} {calibration_id}"
        require_measured_with(what, with_heads, lambda kind: self.head(kind)[0])

    def rollback_target(self, kind: str, to: int | None) -> int | None:
        """Calibration that a rollback returns to (None = nominal).

        ``to`` None goes to what was in force when the present one was accepted, so that each
        further rollback goes further back and never forward again.

        Raises `ConflictError`.
        """
        _, in_force = self.head(kind)
        if to is None:
            if in_force is None:
                raise ConflictError(f"the nominal {kind} model is in force: nothing to roll back")
            return self.standing(in_force).parent
        target = None if to == NOMINAL else to
        if target == in_force:
            name = "the nominal model" if target is None else f"calibration {target}"
            raise ConflictError(f"{name} is in force already")
        if target is not None and not self.standing(target).revision:
            raise ConflictError(
                f"calibration {target} was never accepted: a rollback returns to what was in "
                "force before"
            )
        return target


# ---- opening and reading it ---------------------------------------------------------------------


_log = logging.getLogger(__name__)

# PENDING as `Ledger.state` has it, but without reading those that were refused or decided.
_UNDECIDED = (
    "WHERE kind = ? AND based_on = ? AND code = ? AND NOT EXISTS (SELECT 1 FROM decisions "
    "WHERE calibration_id = calibrations.id AND action <> 'rollback') ORDER BY id DESC LIMIT ?"
)

# "0" is what comes next after "/"
_FIXTURES = (
    "SELECT kind, max(id) FROM calibrations WHERE kind > ? AND kind < ? AND code IN (?, ?) "
    "GROUP BY kind"
)

_PAST = (
    "SELECT max(stamp_ns) FROM calibrations WHERE kind = ? AND id <> ? AND id IN "
    "(SELECT calibration_id FROM decisions WHERE action = ?)"
)

BUSY_TIMEOUT_S = 2.0
"""Longest wait for another process's change, itself a matter of milliseconds."""


class HistoryReader:
    """What a history holds. Use `CalibrationHistory.open`, as a context manager.

    Every method raises `StorageError` when the file cannot be read. Not for several threads at
    once.

    ``serial``: the robot. ``path``: the file. ``damaged``: where a damaged predecessor was set
    aside at this opening, or None. ``created``: whether this opening made a new, empty history.
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
        self._needed: dict[int, dict[str, int]] = {}  # see `measured_with`; by id, never changes

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

        ``serial``: robot serial; any text. ``model_hash``: hash of the nominal model in use; what
        was made for another one is refused. ``state_dir``: folder of the histories, default
        `state_folder()`. ``create``: False refuses a robot that has no history. ``busy_timeout_s``:
        longest wait for changes by other processes. ``sole_user``: the part that only one process
        may play for this robot; empty: none. ``owner``: sets a damaged file aside and begins anew;
        others are refused.

        Raises `InputError`: bad serial, or no history and ``create`` is False; `WrongRobotError`:
        the file belongs to another serial; `StorageError`: the file cannot be opened, was made by a
        newer version, or is damaged and ``owner`` is False; `ConflictError`: another process plays
        the part of ``sole_user``.
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

        Raises `WrongRobotError`: it was made for another nominal model than the one in use: it must
        not be applied.
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
            rows = read_candidates(connection, "ORDER BY id DESC LIMIT ?", rows_up_to(limit))
            return tuple(self._entry(*row) for row in rows)

    def get(self, calibration_id: int) -> Entry:
        """One calibration.

        Raises `InputError`: unknown id.
        """
        with self._reading() as connection:
            return self._entry(calibration_id, read_candidate(connection, calibration_id))

    def pending(self, kind: str = THERMAL, limit: int = -1) -> tuple[Entry, ...]:
        """Calibrations that can be accepted now, newest first; ``limit``: see `undecided`."""
        found = self.undecided(kind, limit)
        return tuple(entry for entry in found if entry.state is CalibrationState.PENDING)

    def undecided(self, kind: str = THERMAL, limit: int = -1) -> tuple[Entry, ...]:
        """Calibrations that were solved against the revision in force, newest first.

        Those too that are stale for what else they were measured with. ``limit``: so many at the
        most.
        """
        with self._reading() as connection:
            revision, _ = self._ledger.head(kind)
            rows = read_candidates(connection, _UNDECIDED, kind, revision, Code.ACCEPT, limit)
            return tuple(self._entry(*row) for row in rows)

    def fixtures(self) -> tuple[Entry, ...]:
        """Of each fixture the last calibration that told where it stands, moved or not."""
        told = Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN
        with self._reading() as connection:
            found = connection.execute(_FIXTURES, (f"{FIXTURE}/", f"{FIXTURE}0", *told))
            ids = [newest for _, newest in found]
            return tuple(self._entry(one, read_candidate(connection, one)) for one in ids)

    def decisions(self, after_seq: int = 0, newest: int = -1) -> tuple[Decision, ...]:
        """Decisions of every kind after a sequence number, oldest first.

        ``newest``: the latest so many at the most, at a cost that does not grow with the history.
        """
        with self._reading() as connection:
            return read_decisions(connection, after_seq, newest)

    def past(self, kind: str) -> Past:
        """What came before what is in force."""
        with self._reading() as connection:
            revision, in_force = self._ledger.head(kind)
            told = connection.execute(_PAST, (kind, in_force or 0, Action.ACCEPT))
            return Past(revision, int(told.fetchone()[0] or 0))

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

    def measured_with(self, calibration_id: int) -> dict[str, int]:
        """Revisions, by kind, beside which alone it may come into force.

        Raises `InputError` for an unknown id.
        """
        with self._reading() as connection:
            return self._needs(calibration_id, read_candidate(connection, calibration_id))

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
        state = self._ledger.state(calibration_id, candidate)
        if state is CalibrationState.PENDING and self._is_outdated(calibration_id, candidate):
            state = CalibrationState.STALE
        return Entry(
            **vars(candidate),
            id=calibration_id,
            state=state,
            revision=standing.revision,
            decisions=standing.decisions,
        )

    def _needs(self, calibration_id: int, candidate: Candidate) -> dict[str, int]:
        if calibration_id not in self._needed:
            model = read_json(self._file.connection, calibration_id, "model")
            self._needed[calibration_id] = measured_with(candidate.kind, model)
        return self._needed[calibration_id]

    def _is_outdated(self, calibration_id: int, candidate: Candidate) -> bool:
        """Whether it was measured with another revision, of another kind, than is in force."""
        try:
            needed = self._needs(calibration_id, candidate)
        except DamagedError:  # told where its model is used
            return False
        return any(self._ledger.head(kind)[0] != its for kind, its in needed.items())

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
        self._file.require_in_place()  # else other processes' decisions would never be seen
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


# ---- changing it --------------------------------------------------------------------------------


class CalibrationHistory(HistoryReader):
    """History of one robot: `HistoryReader`, and the decisions. Use `open`.

    Clock readings are arguments. Every method raises `StorageError` when the file cannot be
    read or written; then nothing was changed. Not for several threads at once.
    """

    def propose(self, proposal: Proposal) -> int:
        """Add a calibration and return its id; changes nothing that is in force.

        Raises `WrongRobotError`: it corrects another nominal model; `StaleError`: it is based on a
        revision that this history never had; `ValueError`: a number in its document or model is not
        finite.
        """
        self._require_hash(proposal.model_hash, "the proposal")
        payloads = packed(proposal)
        with self._changing() as connection:
            revision, _ = self._ledger.head(proposal.kind)
            if proposal.based_on > revision:
                raise StaleError(
                    f"the proposal is based on {proposal.kind} revision {proposal.based_on}, but "
                    f"this history has only come to {revision}: read the one in force again"
                )
            number = insert_proposal(connection, proposal, payloads)
        self._needed[number] = measured_with(proposal.kind, proposal.model)
        return number

    def accept(
        self,
        calibration_id: int,
        *,
        by: str,
        reason: str,
        wall_ns: int,
        expected_head: int | None = None,
        with_heads: Mapping[str, int] | None = None,
    ) -> Head:
        """Bring a pending calibration into force.

        ``expected_head`` is the revision that the caller believes in force; None stands for
        whatever is in force when the change is made. ``with_heads``: revisions, by kind, that
        must be in force beside it.

        Raises `InputError`: unknown id; `ConflictError`: decided before, or another revision is in
        force than expected; `VerdictError`: its own verdict refuses it; carries that code;
        `StaleError`: solved against a revision that is no longer in force, or measured with another
        one of ``with_heads``; `WrongRobotError`: made for another nominal model.
        """
        with self._changing() as connection:
            candidate = read_candidate(connection, calibration_id)
            self._ledger.check_accept(calibration_id, candidate, expected_head, with_heads or {})
            self._require_hash(candidate.model_hash, f"calibration {calibration_id}")
            _, in_force = self._ledger.head(candidate.kind)
            if in_force is not None:
                found = read_candidate(connection, in_force).model_hash
                if found != candidate.model_hash:
                    raise WrongRobotError(
                        f"calibration {in_force}, in force, was made for the nominal model "
                        f"{found}, this one for {candidate.model_hash}: roll back to nominal first"
                    )
            return self._decide(Action.ACCEPT, candidate.kind, calibration_id, by, reason, wall_ns)

    def reject(self, calibration_id: int, *, by: str, reason: str, wall_ns: int) -> None:
        """Rule out a calibration that was never accepted.

        Raises `InputError`: unknown id; `ConflictError`: accepted or rejected before.
        """
        with self._changing() as connection:
            kind = read_candidate(connection, calibration_id).kind
            self._ledger.check_open(calibration_id)
            self._decide(Action.REJECT, kind, calibration_id, by, reason, wall_ns)

    def rollback(
        self,
        to: int | None = None,
        *,
        kind: str = THERMAL,
        by: str,
        reason: str,
        wall_ns: int,
        expected_head: int | None = None,
    ) -> Head:
        """Return to an earlier calibration, as a new revision.

        ``to`` is a calibration id; 0 is the nominal model; None is what was in force when the
        present one was accepted, so that repeated rollbacks walk back to the nominal model.

        Raises `InputError`: unknown id, or one of another kind; `ConflictError`: nothing to roll
        back, never accepted, in force already, or another revision is in force than expected;
        `WrongRobotError`: the target was made for another nominal model.
        """
        with self._changing() as connection:
            self._ledger.check_head(kind, expected_head)
            if to:
                candidate = read_candidate(connection, to)
                self._require_hash(candidate.model_hash, f"calibration {to}")
                if candidate.kind != kind:
                    raise InputError(f"calibration {to} is of kind {candidate.kind}, not {kind}")
            target = self._ledger.rollback_target(kind, to)
            return self._decide(Action.ROLLBACK, kind, target, by, reason, wall_ns)

    def note_correction(self, record: CorrectionRecord) -> None:
        """Add what the robot's commands are corrected with from now on."""
        with self._changing() as connection:
            insert_correction(connection, record)

    def _decide(
        self, action: Action, kind: str, target: int | None, by: str, reason: str, wall_ns: int
    ) -> Head:
        before, _ = self._ledger.head(kind)
        after = before if action is Action.REJECT else before + 1
        head = self._head(kind, after, target)
        insert_decision(
            self._file.connection,
            Decision(0, kind, action, target, by, reason, wall_ns, before, after),
        )
        return head

    @contextmanager
    def _changing(self) -> Iterator[sqlite3.Connection]:
        """One write transaction on the present state: all of it or nothing."""
        self._file.require_in_place()
        with self._transaction("BEGIN IMMEDIATE") as connection:
            yield connection
        self._own_commits += 1
