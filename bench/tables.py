# SPDX-License-Identifier: Apache-2.0
"""Tables of results: on the terminal, as Markdown, as JSON; where they are kept, and of what."""

import platform
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

ROOT = Path(__file__).resolve().parent.parent
OUT = ROOT / "out" / "bench"
KEPT = ROOT / "bench" / "results"  # the last figures that stand in the documents
PAGES = ROOT / "docs" / "figures"  # the same to read

Cell = str | float | int | None


@dataclass(frozen=True)
class Goal:
    """A figure that must lie on one side of a limit."""

    value: float
    limit: float
    at_least: bool = False

    @property
    def met(self) -> bool:
        """Whether it does."""
        return bool(self.value >= self.limit if self.at_least else self.value <= self.limit)

    def __str__(self) -> str:
        words = f"{'≥' if self.at_least else '≤'} {self.limit:.4g}"
        return words if self.met else f"{words} MISSED"


@dataclass
class Table:
    """Named columns of text, numbers and goals, with a remark that says how to read them."""

    name: str
    title: str
    columns: tuple[str, ...]
    remark: str = ""
    rows: list[tuple[Cell | Goal, ...]] = field(default_factory=list)

    def add(self, *cells: Cell | Goal) -> None:
        """Append a row."""
        if len(cells) != len(self.columns):
            raise ValueError(f"{len(cells)} cells for {len(self.columns)} columns")
        self.rows.append(cells)

    @property
    def met(self) -> bool:
        """Whether every goal in it is met."""
        return all(cell.met for row in self.rows for cell in row if isinstance(cell, Goal))

    def texts(self) -> list[list[str]]:
        """Cells as shown."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def markdown(self) -> str:
        """The table for a document."""
        lines = [self.columns, ["---"] * len(self.columns), *self.texts()]
        body = "\n".join("| " + " | ".join(line) + " |" for line in lines)
        return f"### {self.title}\n\n{body}\n\n{self.remark}\n"

    def document(self) -> dict[str, Any]:
        """The table in full precision, for machines."""
        return {
            "name": self.name,
            "title": self.title,
            "remark": self.remark,
            "columns": list(self.columns),
            "rows": [[_plain(cell) for cell in row] for row in self.rows],
            "met": self.met,
        }


def _text(cell: Cell | Goal) -> str:
    if isinstance(cell, float):
        return f"{cell:.4g}" if abs(cell) < 1e-3 or abs(cell) >= 100.0 else f"{cell:.3f}"
    return "" if cell is None else str(cell)


def _plain(cell: Cell | Goal) -> Any:
    if isinstance(cell, Goal):
        return {
            "value": _finite(cell.value),
            "limit": cell.limit,
            "at_least": cell.at_least,
            "met": cell.met,
        }
    return _finite(cell.item() if isinstance(cell, np.generic) else cell)


def _finite(value: Cell) -> Cell:
    """JSON knows no other numbers."""
    return None if isinstance(value, float) and not np.isfinite(value) else value


def show(tables: Sequence[Table]) -> None:
    """Print them."""
    from rich.console import Console
    from rich.table import Table as View

    console = Console()
    for table in tables:
        view = View(title=table.title, title_justify="left", caption=table.remark or None)
        view.caption_justify = "left"
        for column in table.columns:
            view.add_column(column)
        for row, texts in zip(table.rows, table.texts(), strict=True):
            missed = any(isinstance(cell, Goal) and not cell.met for cell in row)
            view.add_row(*texts, style="bold red" if missed else None)
        console.print(view)
        console.print()


def commit() -> str:
    """The commit of this tree, with a mark when files differ from it."""

    def git(*words: str) -> str:
        done = subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True)
        return done.stdout.strip() if done.returncode == 0 else ""

    changed = git("status", "--porcelain", "--", "robocal_ros", "bench", "config")
    return (git("rev-parse", "--short", "HEAD") or "unknown") + ("+" if changed else "")


def about(seconds: float) -> dict[str, str]:
    """Where and when figures were made."""
    import numpy
    import scipy

    return {
        "date": datetime.now(UTC).strftime("%Y-%m-%d"),
        "commit": commit(),
        "python": platform.python_version(),
        "numpy": numpy.__version__,
        "scipy": scipy.__version__,
        "machine": platform.machine(),
        "duration_s": f"{seconds:.0f}",
    }
