"""Rows of the history file that tell what a robot's commands were corrected with."""

import json
import sqlite3
from collections.abc import Iterator
from dataclasses import astuple, fields

from robocal_ros.history.correction_record import CorrectionRecord

_COLUMNS = tuple(column.name for column in fields(CorrectionRecord))


def insert_correction(connection: sqlite3.Connection, record: CorrectionRecord) -> None:
    """Add a record."""
    *row, tool = astuple(record)
    marks = ", ".join("?" * len(_COLUMNS))
    connection.execute(
        f"INSERT INTO corrections ({', '.join(_COLUMNS)}) VALUES ({marks})",
        (*row, json.dumps(tool, allow_nan=False)),
    )


def read_corrections(connection: sqlite3.Connection, limit: int) -> Iterator[CorrectionRecord]:
    """The latest records, newest first."""
    chosen = f"SELECT {', '.join(_COLUMNS)} FROM corrections ORDER BY seq DESC LIMIT ?"
    for row in connection.execute(chosen, (max(limit, 0),)):
        values = dict(zip(_COLUMNS, row, strict=True))
        for name in ("enabled", "shadow"):
            values[name] = bool(values[name])
        values["taught_tool"] = tuple(json.loads(values["taught_tool"]))
        yield CorrectionRecord(**values)
