"""Cells of a CSV file, each complaint with its file, row and column."""

import csv
import io
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from decimal import InvalidOperation
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted, read_text, write_text

Array = NDArray[np.float64]

LARGEST = 1e9  # in any unit: beyond it squares lose what is left of a measurement
DIGITS = ".12g"  # 1e-9 mm in a metre, and no trailing noise of binary fractions


@dataclass(frozen=True)
class Cells:
    """A table.

    Attributes
    ----------
    rows : number of each row in the file (the header is row 1).
    columns : cells of each column.
    """

    file: str
    rows: tuple[int, ...]
    columns: Mapping[str, tuple[str, ...]]

    def fail(self, message: str, index: int, column: str) -> NoReturn:
        """Refuse the cell of a row, by its place among ``rows``.

        Raises
        ------
        InputError
            Always.
        """
        raise InputError(message, file=self.file, row=self.rows[index], column=column)

    def numbers(self, name: str, *, gaps: bool = False) -> Array:
        """A column of finite numbers (m,).

        With ``gaps`` a cell that is empty or says nan is not-a-number.

        Raises
        ------
        InputError
            At the first cell that is none.
        """
        cells = self.columns[name]
        if gaps:
            cells = tuple(cell.strip() or "nan" for cell in cells)
        try:
            values = np.array([float(cell) for cell in cells])
        except ValueError:
            self.fail_at_text(name, float, gaps=gaps)
        if "_" in "".join(cells):  # Python reads 1_000 as a thousand; a table must not mean that
            index = next(i for i, cell in enumerate(cells) if "_" in cell)
            self.fail(f"{quoted(cells[index])} is not a number", index, name)
        for wrong, words in (
            (np.isinf(values) if gaps else ~np.isfinite(values), "is not a finite number"),
            (np.abs(values) > LARGEST, "is no measurement"),
        ):
            if np.any(wrong):
                index = int(np.argmax(wrong))
                self.fail(f"{quoted(cells[index])} {words}", index, name)
        return values

    def words(self, name: str) -> tuple[str, ...]:
        """A column of texts (m,), none of them empty; nothing where there is no such column.

        Raises
        ------
        InputError
            At the first empty cell.
        """
        words = tuple(cell.strip() for cell in self.columns.get(name, ()))
        if "" in words:
            self.fail("the cell is empty", words.index(""), name)
        return words

    def fail_at_text(
        self, name: str, convert: Callable[[str], object], *, gaps: bool = False
    ) -> NoReturn:
        """Refuse the first cell that ``convert`` refuses, with ``gaps`` the first such text.

        Raises
        ------
        InputError
            Always.
        """
        for index, cell in enumerate(self.columns[name]):
            try:
                convert(cell.strip() or ("nan" if gaps else ""))
            except (ValueError, InvalidOperation):
                text = cell.strip()
                if not text:
                    self.fail("the cell is empty", index, name)
                comma = text.count(",") == 1 and text.replace(",", "").lstrip("+-").isdigit()
                hint = "; the decimal mark must be a point" if comma else ""
                self.fail(f"{quoted(text)} is not a number{hint}", index, name)
        raise AssertionError(f"every cell of {name} is a number")


def read_cells(path: Path, check: Callable[[list[str], str], None]) -> Cells:
    """Read a table; ``check`` refuses a header (its names, and the file's).

    Raises
    ------
    InputError
        When it is no table, has no rows, or rows that are longer or shorter than the header.
    """
    file = str(path)
    reader = csv.reader(io.StringIO(read_text(path, "table"), newline=""), strict=True)
    rows, numbers = [], []
    try:
        header = next(reader)
        check(header, file)
        for number, row in enumerate(reader, start=2):
            if row:
                rows.append(row)
                numbers.append(number)
    except csv.Error as error:
        raise InputError(f"not a CSV table: {error}", file=file, row=reader.line_num) from error
    if not rows:
        raise InputError("the table has a header but no measurements", file=file)
    for number, row in zip(numbers, rows, strict=True):
        if len(row) != len(header):
            raise InputError(_ragged(row, len(header)), file=file, row=number)
    names = [name.strip() for name in header]
    columns = zip(*rows, strict=True)
    return Cells(file, tuple(numbers), dict(zip(names, columns, strict=True)))


def texts(values: Array) -> list[str]:
    """Numbers as cells."""
    return [format(value, DIGITS) for value in values.tolist()]


def write_cells(path: Path, columns: Mapping[str, Sequence[str]]) -> None:
    """Write a table by its columns; the file appears whole or not at all.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows(zip(*columns.values(), strict=True))
    write_text(path, text.getvalue())


def _ragged(row: list[str], width: int) -> str:
    message = f"{len(row)} cells, but the header has {width} columns"
    if len(row) > width:
        message += "; is the decimal mark a comma? It must be a point"
    return message
