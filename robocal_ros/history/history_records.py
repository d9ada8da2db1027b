# SPDX-License-Identifier: Apache-2.0
"""What a calibration is on its way from proposal to force, and its rows in the history file.

Sessions make proposals, the history keeps them, nodes and commands show them: records that never
change. SQLite has no page checksums: a flipped bit in a stored model would pass its integrity check
and move a robot. So each document, model and set of inputs is compared with its SHA-256 when read.
"""

import hashlib
import io
import json
import sqlite3
from collections.abc import Callable, Iterator, Mapping
from dataclasses import astuple, dataclass, field, fields
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final, Literal

from robocal_ros.ground.errors import Code, InputError, StaleError, StorageError
from robocal_ros.history.history_file import DamagedError

if TYPE_CHECKING:  # the history is listed without loading NumPy
    from numpy.typing import NDArray

    from robocal_ros.history.documents import (
        CalibrationDocument,
        CorrectionDocument,
        DecisionDocument,
    )

THERMAL = "thermal"
TOOL = "tool"
REFERENCE = "reference"  # the cold reference
HEALTHY_TOOL = "tool_reference"  # how the taught tool measures while it is right
MANDREL = "mandrel_reference"  # how the mandrel measures while the beam station stands right
LASER_FRAME = "laser_frame"  # where the mandrel found the beams of a station
FRAME_SHIFT = "frame_shift"  # of a controller's base and tool frame, for one thermal model
HAND_EYE = "hand_eye"  # where a sensor sits; see `hand_eye_kind`
FIXTURE = "fixture"  # where a fixture stands; see `fixture_kind`
# What is in force before anything was accepted; of other kinds nothing.
BEFORE_ANY = {
    THERMAL: "the nominal model",
    TOOL: "the taught tool",
    FRAME_SHIFT: "what the frames were before any shift",
}


def hand_eye_kind(sensor_frame: str) -> str:
    """Each sensor is calibrated on its own: the kind names its frame."""
    return f"{HAND_EYE}/{sensor_frame}"


def fixture_kind(name: str) -> str:
    """Each fixture has calibrations of its own: the kind says its name."""
    return f"{FIXTURE}/{name}"


class Action(StrEnum):
    """A decision about a calibration."""

    ACCEPT = "accept"
    REJECT = "reject"
    ROLLBACK = "rollback"


class CalibrationState(StrEnum):
    """Where a calibration stands; follows from its verdict and the decisions log."""

    PENDING = "pending"
    """Can be accepted now."""
    STALE = "stale"
    """Was solved against, or measured with, a revision no longer in force; measure again."""
    REFUSED = "refused"
    """Its own verdict is not ACCEPT; kept for the record, can never be accepted."""
    REJECTED = "rejected"
    IN_FORCE = "in_force"
    SUPERSEDED = "superseded"
    """Was in force until another one was accepted."""
    ROLLED_BACK = "rolled_back"
    """Was in force until it was rolled back."""


def why_void(shown: Mapping[str, Any]) -> str:
    """Why what ``robocal history show`` printed must not be used; empty: it may, or is no such."""
    told = shown.get("calibration")
    state = told.get("state") if isinstance(told, Mapping) else None
    if state not in (
        CalibrationState.REFUSED, CalibrationState.REJECTED, CalibrationState.ROLLED_BACK
    ):  # fmt: skip
        return ""
    return f"was {str(state).replace('_', ' ')}: take one that is in force"


@dataclass(frozen=True, kw_only=True)
class Candidate:
    """What is known of a calibration without opening its contents.

    ``kind``: which model it changes, e.g. ``thermal``; each kind has its own revisions.
    ``model_hash``: hash of the nominal model that it corrects. ``based_on``: revision in force when
    it was solved (0 = nominal). ``cycle_id``: measurement cycle that gave the data. ``stamp_ns``:
    time of the data. ``created_ns``: wall clock when it was proposed. ``software``, ``method``:
    version and estimator that made it. ``code``, ``reason``: the verdict. ``candidate_rms_mm``:
    held-out rms error of the proposed model, None when not judged.
    """

    kind: str = THERMAL
    model_hash: str
    based_on: int
    cycle_id: str
    stamp_ns: int
    created_ns: int
    software: str
    method: str
    code: Code
    reason: str
    candidate_rms_mm: float | None = None


@dataclass(frozen=True, kw_only=True, eq=False)
class Proposal(Candidate):
    """A calibration to be put into the history.

    ``document``: the JSON document of the identification, finite numbers only.
    ``model``: the model in full precision, as JSON; what comes into force.
    ``inputs``: named arrays that it was solved from.
    """

    document: Mapping[str, Any]
    model: Mapping[str, Any]
    inputs: "Mapping[str, NDArray[Any]]" = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Decision:
    """One line of the decisions log.

    ``calibration_id`` is the one accepted, rejected or returned to (None: the nominal model);
    ``head_before`` and ``head_after`` are revisions of its kind, equal for a rejection.
    """

    seq: int
    kind: str
    action: Action
    calibration_id: int | None
    by: str
    reason: str
    wall_ns: int
    head_before: int
    head_after: int

    def document(self) -> "DecisionDocument":
        """Plain values, as a person is shown them."""
        return {
            "seq": self.seq,
            "kind": self.kind,
            "action": self.action.value,
            "calibration_id": self.calibration_id,
            "by": self.by,
            "reason": self.reason,
            "wall_ns": self.wall_ns,
            "head_before": self.head_before,
            "head_after": self.head_after,
        }


@dataclass(frozen=True, slots=True)
class Head:
    """What is in force: ``calibration_id`` and ``model`` are None for the nominal model.

    ``revision`` grows by one with each acceptance and each rollback, also one to nominal.
    """

    kind: str
    revision: int
    calibration_id: int | None
    model: dict[str, Any] | None

    @property
    def digest(self) -> str:
        """Of the model: revisions and ids of a history that has begun anew come again."""
        text = json.dumps(self.model, sort_keys=True, allow_nan=False)
        return hashlib.sha256(text.encode()).hexdigest()[:16]


@dataclass(frozen=True, slots=True)
class Past:
    """What an old message is known by: the ``revision`` in force, and the newest stamp of what was.

    ``newest_ns`` is of those that are in force no more; 0 without any.
    """

    revision: int = 0
    newest_ns: int = 0


@dataclass(frozen=True, kw_only=True)
class Entry(Candidate):
    """A calibration in the history, with where it stands.

    ``revision`` is the one under which it was accepted, 0 if never; ``decisions`` are those that
    rejected it or brought it into or out of force, oldest first.
    """

    id: int
    state: CalibrationState
    revision: int
    decisions: tuple[Decision, ...]

    def document(self) -> "CalibrationDocument":
        """Plain values, as a person is shown them."""
        return {
            "id": self.id,
            "revision": self.revision,
            "kind": self.kind,
            "state": self.state.value,
            "code": self.code.name,
            "reason": self.reason,
            "candidate_rms_mm": self.candidate_rms_mm,
            "model_hash": self.model_hash,
            "based_on": self.based_on,
            "cycle_id": self.cycle_id,
            "stamp_ns": self.stamp_ns,
            "created_ns": self.created_ns,
            "software": self.software,
            "method": self.method,
            "decisions": [made.document() for made in self.decisions],
        }


def measured_with(kind: str, model: Mapping[str, Any]) -> dict[str, int]:
    """Revisions, by kind, beside which alone a calibration may come into force.

    A tool's flange poses came from a thermal model: with another one, what the drift did to the
    flange would stay in the tool, and be corrected a second time. Frames were shifted for one. A
    drift is counted from a cold reference: the one in force from then on knows another cold robot.
    A fixture's points were placed by tool or sensor: what these erred would stay in its frame.
    """
    told: Mapping[str, Any] = {}
    if kind in (TOOL, FRAME_SHIFT):
        told = {THERMAL: model.get("thermal_revision")}
    elif kind == THERMAL:
        told = {REFERENCE: model.get("reference_revision")}
    elif kind.split("/")[0] == FIXTURE:
        told = model.get("measured_with", {})
    return {its: int(revision) for its, revision in told.items() if revision is not None}


def require_measured_with(
    what: str, needed: Mapping[str, int], revision: Callable[[str], int]
) -> None:
    """Refuse a calibration that was measured with other revisions than those in force.

    ``needed`` and ``revision`` are revisions by kind.

    Raises `StaleError`.
    """
    for kind, measured in needed.items():
        if (found := revision(kind)) != measured:
            raise StaleError(
                f"{what} was measured with {kind} revision {measured}, in force is {found}: "
                "measure it again"
            )


# ---- rows and contents of the history file ------------------------------------------------------

_COLUMNS = tuple(column.name for column in fields(Candidate))
_SELECT = f"SELECT id, {', '.join(_COLUMNS)} FROM calibrations "
_LARGEST_ID = 2**63 - 1


def packed(proposal: Proposal) -> dict[str, bytes]:
    """Document, model and inputs as bytes; equal contents give equal bytes.

    Raises `ValueError`: a number in the document or the model is not finite, or an input array
    holds objects.
    """
    import numpy as np

    payloads = {}
    for name in ("document", "model"):
        try:
            text = json.dumps(getattr(proposal, name), allow_nan=False, separators=(",", ":"))
        except ValueError as error:
            raise ValueError(f"{name} of a proposal: {error}") from error
        payloads[name] = text.encode()
    arrays = {name: np.asarray(array) for name, array in proposal.inputs.items()}
    for name, array in arrays.items():
        if array.dtype.hasobject:
            raise ValueError(f"input {name!r} of a proposal is not an array of numbers or text")
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays)  # type: ignore[arg-type]  # names are free
    payloads["inputs"] = buffer.getvalue()
    return payloads


def insert_proposal(
    connection: sqlite3.Connection, proposal: Proposal, payloads: dict[str, bytes]
) -> int:
    """Add a calibration with its contents; returns its id."""
    row = [getattr(proposal, name) for name in _COLUMNS]
    marks = ", ".join("?" * len(row))
    cursor = connection.execute(
        f"INSERT INTO calibrations ({', '.join(_COLUMNS)}) VALUES ({marks})", row
    )
    assigned = cursor.lastrowid
    if assigned is None:
        raise RuntimeError("an insert without a row")
    for name, data in payloads.items():
        digest = hashlib.sha256(data).digest()
        connection.execute(
            "INSERT INTO payloads VALUES (?, ?, ?, ?)", (assigned, name, data, digest)
        )
    return assigned


def insert_decision(connection: sqlite3.Connection, decision: Decision) -> None:
    """Add a decision; its ``seq`` is assigned."""
    connection.execute(
        "INSERT INTO decisions VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?)", astuple(decision)[1:]
    )


def read_decisions(
    connection: sqlite3.Connection, after_seq: int, newest: int = -1
) -> tuple[Decision, ...]:
    """Decisions after a sequence number, oldest first; the latest ``newest``, -1: all."""
    latest_first = "SELECT * FROM decisions WHERE seq > ? ORDER BY seq DESC LIMIT ?"
    rows = connection.execute(latest_first, (after_seq, newest)).fetchall()
    return tuple(
        Decision(seq, kind, Action(action), *rest) for seq, kind, action, *rest in reversed(rows)
    )


def rows_up_to(limit: int) -> int:
    """As many rows as an SQL LIMIT can ask for: none below zero, and 64 bits hold it."""
    return min(max(limit, 0), _LARGEST_ID)


def read_candidates(
    connection: sqlite3.Connection, clause: str, *values: str | int
) -> Iterator[tuple[int, Candidate]]:
    """Ids and calibrations that an SQL clause selects."""
    for assigned, *row in connection.execute(_SELECT + clause, values):
        columns = dict(zip(_COLUMNS, row, strict=True))
        try:
            columns["code"] = Code(columns["code"])
        except ValueError as error:
            raise StorageError(
                f"calibration {assigned} has the code {columns['code']}, unknown here: it was "
                "made by a newer robocal, update this one"
            ) from error
        yield assigned, Candidate(**columns)


def read_candidate(connection: sqlite3.Connection, calibration_id: int) -> Candidate:
    """One calibration.

    Raises `InputError`: unknown id.
    """
    if 0 < calibration_id <= _LARGEST_ID:
        for _, candidate in read_candidates(connection, "WHERE id = ?", calibration_id):
            return candidate
    raise InputError(f"no calibration has the id {calibration_id}; look at the list")


def read_json(connection: sqlite3.Connection, calibration_id: int, name: str) -> dict[str, Any]:
    """Document or model of a calibration."""
    found: dict[str, Any] = json.loads(_read(connection, calibration_id, name))
    return found


def read_arrays(connection: sqlite3.Connection, calibration_id: int) -> "dict[str, NDArray[Any]]":
    """Arrays that a calibration was solved from. Raises as `read_json`."""
    import numpy as np

    with np.load(io.BytesIO(_read(connection, calibration_id, "inputs"))) as arrays:
        return {name: arrays[name] for name in arrays.files}


def _read(connection: sqlite3.Connection, calibration_id: int, name: str) -> bytes:
    read_candidate(connection, calibration_id)
    row = connection.execute(
        "SELECT data, sha256 FROM payloads WHERE calibration_id = ? AND name = ?",
        (calibration_id, name),
    ).fetchone()
    if row is None or hashlib.sha256(row[0]).digest() != row[1]:
        raise DamagedError(f"the {name} of calibration {calibration_id} is damaged")
    return bytes(row[0])


# ---- what a robot's commands were corrected with, from when on: records that never change -------


NOMINAL: Final = "nominal"
CALIBRATED: Final = "calibrated"


@dataclass(frozen=True, kw_only=True)
class CorrectionRecord:
    """What the joint correction did from an instant on.

    ``wall_ns``: when this began. ``software``: version of this software. ``model_hash``: of the
    nominal model. ``enabled``: whether the correction was asked for. ``shadow``: whether it was
    only shown. ``model_revision``, ``tool_revision``: in force for it; 0 for none, and for the
    taught tool. ``reference``: NOMINAL or CALIBRATED: which model the program was made with, as it
    was chosen. ``reference_source``: where that came from: a robot type, or the path of a robot
    file. ``reference_name``, ``reference_hash``: of that model. ``taught_tool``: the tool that the
    program was made with: x, y, z in m, qx, qy, qz, qw.
    """

    wall_ns: int
    software: str
    model_hash: str
    enabled: bool
    shadow: bool
    model_revision: int
    tool_revision: int
    reference: Literal["nominal", "calibrated"]
    reference_source: str
    reference_name: str
    reference_hash: str
    taught_tool: tuple[float, ...]

    def document(self) -> "CorrectionDocument":
        """Plain values, as a person is shown them."""
        return {
            "wall_ns": self.wall_ns,
            "software": self.software,
            "model_hash": self.model_hash,
            "enabled": self.enabled,
            "shadow": self.shadow,
            "model_revision": self.model_revision,
            "tool_revision": self.tool_revision,
            "reference": self.reference,
            "reference_source": self.reference_source,
            "reference_name": self.reference_name,
            "reference_hash": self.reference_hash,
            "taught_tool": list(self.taught_tool),
        }


# ---- rows of the history file that tell what a robot's commands were corrected with -------------


_CORRECTION_COLUMNS = tuple(column.name for column in fields(CorrectionRecord))


def insert_correction(connection: sqlite3.Connection, record: CorrectionRecord) -> None:
    """Add a record."""
    *row, tool = astuple(record)
    marks = ", ".join("?" * len(_CORRECTION_COLUMNS))
    connection.execute(
        f"INSERT INTO corrections ({', '.join(_CORRECTION_COLUMNS)}) VALUES ({marks})",
        (*row, json.dumps(tool, allow_nan=False)),
    )


def read_corrections(connection: sqlite3.Connection, limit: int) -> Iterator[CorrectionRecord]:
    """The latest records, newest first."""
    chosen = f"SELECT {', '.join(_CORRECTION_COLUMNS)} FROM corrections ORDER BY seq DESC LIMIT ?"
    for row in connection.execute(chosen, (rows_up_to(limit),)):
        values = dict(zip(_CORRECTION_COLUMNS, row, strict=True))
        for name in ("enabled", "shadow"):
            values[name] = bool(values[name])
        values["taught_tool"] = tuple(json.loads(values["taught_tool"]))
        yield CorrectionRecord(**values)
