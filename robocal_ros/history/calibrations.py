"""The calibration history of one robot: proposed, accepted, rejected, rolled back; never lost.

A change is one SQLite transaction: a process killed at any moment leaves the state before it or
the state after it. Accept and rollback compare the revision in force before they set the new one,
under the write lock, so that of two at once one wins and the other gets a `ConflictError`; so
are revisions of other kinds that a calibration needs beside it.
"""

import sqlite3
from collections.abc import Iterator, Mapping
from contextlib import contextmanager

from robocal_ros.ground.errors import InputError, StaleError, WrongRobotError
from robocal_ros.ground.proposals import THERMAL, Action, Candidate, Decision, Head, Proposal
from robocal_ros.history.history_reader import HistoryReader
from robocal_ros.history.history_records import (
    CorrectionRecord,
    insert_correction,
    insert_decision,
    insert_proposal,
    packed,
    read_candidate,
)


class CalibrationHistory(HistoryReader):
    """History of one robot: `HistoryReader`, and the decisions. Use `open`.

    Clock readings are arguments. Every method raises `StorageError` when the file cannot be
    read or written; then nothing was changed. Not for several threads at once.
    """

    def propose(self, proposal: Proposal) -> int:
        """Add a calibration and return its id; changes nothing that is in force.

        Raises
        ------
        WrongRobotError
            It corrects another nominal model.
        StaleError
            It is based on a revision that this history never had.
        ValueError
            A number in its document or model is not finite.
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
            return insert_proposal(connection, proposal, payloads)

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

        Raises
        ------
        InputError
            Unknown id.
        ConflictError
            Decided before, or another revision is in force than expected.
        VerdictError
            Its own verdict refuses it; carries that code.
        StaleError
            Solved against a revision that is no longer in force, or measured with another one
            of ``with_heads``.
        WrongRobotError
            Made for another nominal model.
        """
        with self._changing() as connection:
            candidate = read_candidate(connection, calibration_id)
            self._ledger.check_accept(calibration_id, candidate, expected_head, with_heads or {})
            self._require_hash(candidate.model_hash, f"calibration {calibration_id}")
            self._require_hash_in_force(candidate)
            return self._decide(Action.ACCEPT, candidate.kind, calibration_id, by, reason, wall_ns)

    def reject(self, calibration_id: int, *, by: str, reason: str, wall_ns: int) -> None:
        """Rule out a calibration that was never accepted.

        Raises
        ------
        InputError
            Unknown id.
        ConflictError
            Accepted or rejected before.
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

        Raises
        ------
        InputError
            Unknown id, or one of another kind.
        ConflictError
            Nothing to roll back, never accepted, in force already, or another revision is in
            force than expected.
        WrongRobotError
            The target was made for another nominal model.
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

    def _require_hash_in_force(self, candidate: Candidate) -> None:
        _, in_force = self._ledger.head(candidate.kind)
        if in_force is None:
            return
        found = read_candidate(self._file.connection, in_force).model_hash
        if found != candidate.model_hash:
            raise WrongRobotError(
                f"calibration {in_force}, in force, was made for the nominal model {found}, this "
                f"one for {candidate.model_hash}: roll back to nominal first"
            )

    @contextmanager
    def _changing(self) -> Iterator[sqlite3.Connection]:
        """One write transaction on the present state: all of it or nothing."""
        self._file.require_in_place()
        with self._transaction("BEGIN IMMEDIATE") as connection:
            yield connection
        self._own_commits += 1
