"""The schema of the history file: ordered scripts, so that any older file can be brought up.

Calibrations, their payloads, the decisions about them and what commands were corrected with are
only ever added to; triggers refuse changes by any program.
"""

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
