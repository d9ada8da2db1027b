"""What every command shares: arguments, the result, and how a command leaves.

Exit status: 0 = computed, also when the verdict refuses; 2 = wrong usage, or input that cannot be
read or is invalid; 3 = the data or the state of the history cannot give what was asked; 1 = a
crash of the program itself; 130 = interrupted.
"""

import argparse
import json
import math
import os
import re
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from robocal_ros.ground.errors import Code, InputError, RankDeficientError, RobocalError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.kinematics.robots import RobotDescription


_NEGATIVE = re.compile(r"-\.?\d")


class UsageError(InputError):
    """A command line that makes no sense; ``usage`` says what would."""

    def __init__(self, message: str, usage: str) -> None:
        super().__init__(message)
        self.usage = usage


class InformationAskedFor(Exception):  # noqa: N818  # asked for, no error
    """Help or version instead of a command."""

    def __init__(self, name: str, text: str) -> None:
        super().__init__(name)
        self.name = name
        self.text = text


class _Information(argparse.Action):
    def __init__(
        self, option_strings: Sequence[str], dest: str, help: str, version: str = ""
    ) -> None:
        super().__init__(option_strings, dest, nargs=0, default=argparse.SUPPRESS, help=help)
        self.version = version

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[Any] | None,
        option_string: str | None = None,
    ) -> NoReturn:
        if self.version:
            raise InformationAskedFor("version", self.version)
        raise InformationAskedFor("help", parser.format_help())


class CommandParser(argparse.ArgumentParser):
    """Parser of the command and, through ``add_subparsers``, of each command below it.

    Options are written in full, so that a later option cannot change what a script means.
    """

    def __init__(self, **options: Any) -> None:
        options |= {"allow_abbrev": False, "add_help": False}
        super().__init__(**options)
        self.add_argument("-h", "--help", action=_Information, help="show this and leave")
        self.add_argument(
            "--json",
            action="store_true",
            default=argparse.SUPPRESS,
            help="print one JSON document on standard output",
        )

    def add_version(self, version: str) -> None:
        """Offer ``--version``."""
        self.add_argument(
            "--version", action=_Information, version=version, help="show the version and leave"
        )

    def error(self, message: str) -> NoReturn:
        """Raise a `UsageError`; argparse itself would leave with text alone."""
        raise UsageError(message, self.format_usage())


def with_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join ``--option -1,2`` to ``--option=-1,2``, which argparse would take for an option."""
    joined: list[str] = []
    for argument in arguments:
        before = joined[-1] if joined else ""
        if before.startswith("--") and before != "--json" and _NEGATIVE.match(argument):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


PARTS = ("base", "tool", "geometry")
ROBOT_HELP = "robot file, or name of a shipped robot (ur10, kr150_r3100 …)"
SIGMA_MM = 0.03


def parts(value: str) -> tuple[str, ...]:
    """Type of a list such as ``base,tool``; in the order of ``PARTS``.

    Raises
    ------
    argparse.ArgumentTypeError
        For a part that is unknown or given twice, and for none.
    """
    names = [name.strip() for name in value.split(",")]
    for name in names:
        if name not in PARTS:
            raise argparse.ArgumentTypeError(f"{quoted(name)} is not one of {', '.join(PARTS)}")
    if len(set(names)) != len(names):
        raise argparse.ArgumentTypeError(f"{quoted(value)} names a part twice")
    return tuple(name for name in PARTS if name in names)


def positive(value: str) -> float:
    """Type of a finite number above zero.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    return _between(value, math.inf, "a number above 0")


def share(value: str) -> float:
    """Type of a share between 0 and 1.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    return _between(value, 1.0, "a share between 0 and 1")


def _between(value: str, most: float, what: str) -> float:
    """A number above zero and below ``most``."""
    try:
        number = float(value)
    except ValueError:
        number = 0.0
    if not 0.0 < number < most:
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not {what}")
    return number


def count(value: str) -> int:
    """Type of an argument that counts something: a whole number from 1.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    return _whole(value, 1)


def seed(value: str) -> int:
    """Type of a seed of a random choice: a whole number from 0.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    return _whole(value, 0)


def _whole(value: str, least: int) -> int:
    if not (value.isascii() and value.isdigit()) or int(value) < least:
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not a whole number from {least}")
    return int(value)


def text(value: str) -> str:
    """Type of an argument that is kept as text.

    Raises
    ------
    argparse.ArgumentTypeError
        Bytes that are no text in the terminal's encoding.
    """
    try:
        value.encode()
    except UnicodeEncodeError as error:
        raise argparse.ArgumentTypeError("holds bytes that are not text") from error
    return value


def input_topic(value: str) -> tuple[str, str]:
    """Read an input and its topic, INPUT:=TOPIC."""
    name, sign, topic = value.partition(":=")
    if not (name and sign and topic):
        raise argparse.ArgumentTypeError(f"'{value}' is not of the form INPUT:=TOPIC")
    return name, topic


def add_sigma(parser: "argparse._ActionsContainer", more: str = "") -> None:
    """Offer ``--sigma-mm``, the noise of a visit; ``more`` says what else about it."""
    parser.add_argument(
        "--sigma-mm",
        type=positive,
        default=SIGMA_MM,
        metavar="S",
        help=f"noise of a coordinate of one visit{more}; default {SIGMA_MM}",
    )


def describe_robot(name: str, warnings: list[str]) -> "RobotDescription":
    """Read a robot file; what it leaves open is added to ``warnings``.

    Raises
    ------
    InputError
        When there is no such robot, or its file is not as docs/files.md says.
    """
    from robocal_ros.kinematics.robots import load_description

    description = load_description(name)
    warnings += [f"{description.path}: {note}" for note in description.notes]
    return description


def warn(messages: Iterable[str]) -> None:
    """Tell people on standard error what may have escaped them."""
    for message in messages:
        print(f"robocal: warning: {message}", file=sys.stderr)


def three_numbers(value: str) -> tuple[float, ...]:
    """Type of three finite numbers such as ``1,-2.5,3``.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    try:
        numbers = tuple(float(cell) for cell in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(abs(number) <= 1e6 for number in numbers):
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not three numbers such as 1,-2.5,3")
    return numbers


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
