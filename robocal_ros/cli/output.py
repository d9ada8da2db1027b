"""What a command hands back, and how it leaves: tables for people, one JSON document for machines.

Exit status: 0 = computed, also when the verdict refuses; 2 = wrong usage, or input that cannot be
read or is invalid; 3 = the data or the state of the history cannot give what was asked; 1 = a
crash of the program itself; 130 = interrupted.
"""

import json
import os
import sys
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TextIO

from robocal_ros.ground.errors import Code, InputError, RankDeficientError, RobocalError

if TYPE_CHECKING:  # rich takes 50 ms, which help and JSON need not wait for
    from rich.console import Console

DONE = 0
CRASHED = 1
BAD_REQUEST = 2
NO_ANSWER = 3
INTERRUPTED = 130

_REQUEST_CODES = {Code.BAD_INPUT, Code.WRONG_ROBOT, Code.STORAGE_FAILED}
_PIPE_COLUMNS = 160

Document = dict[str, Any]


@dataclass(frozen=True)
class CliResult:
    """Result of a command.

    Attributes
    ----------
    document : what ``--json`` prints; finite numbers only.
    render : prints the same for people.
    exit_code : exit status.
    """

    document: Document
    render: "Callable[[Console], None]"
    exit_code: int = DONE


def exit_status(error: RobocalError) -> int:
    """Exit status of a command that ends with this error."""
    return BAD_REQUEST if error.code in _REQUEST_CODES else NO_ANSWER


def failure(error: RobocalError) -> Document:
    """JSON document of a command that ends with this error."""
    where = error if isinstance(error, InputError) else None
    document = refusal(error.code, str(error))
    document["error"] |= {
        "file": where and where.file,
        "row": where and where.row,
        "column": where and where.column,
    }
    if isinstance(error, RankDeficientError):
        document["unobservable"] = list(error.directions)
    return document


def crash(error: BaseException) -> Document:
    """JSON document of a crash: no verdict came about."""
    return refusal(Code.NONE, f"internal error, {type(error).__name__}: {error}")


def refusal(code: Code, message: str) -> Document:
    """``error`` and ``verdict`` of a command that cannot answer."""
    place = {"file": None, "row": None, "column": None}
    return {
        "error": {"code": code.name, "message": message, **place},
        "verdict": {"accept": False, "code": code.name, "reason": message},
    }


def tell(code: str, message: object) -> None:
    """Say on standard error, in one line, why a command ends without an answer."""
    print(f"robocal: {message} [{code}]", file=sys.stderr)


def write_json(document: Document, stream: TextIO) -> None:
    """Write the one document."""
    stream.write(json.dumps(document, indent=2, allow_nan=False) + "\n")
    stream.flush()


def show(outcome: CliResult, stream: TextIO) -> None:
    """Print for people; a pipe gets wide lines, so that tables stay whole."""
    from rich.console import Console

    class Result(Console):
        def on_broken_pipe(self) -> None:  # rich itself would leave with status 1
            raise BrokenPipeError

    wide = None if stream.isatty() or "COLUMNS" in os.environ else _PIPE_COLUMNS
    outcome.render(Result(file=stream, highlight=False, width=wide))
    stream.flush()


def progress_console() -> "Console":
    """Where progress is shown: standard error, so that it is never mixed with the result."""
    from rich.console import Console

    return Console(file=sys.stderr, highlight=False)
