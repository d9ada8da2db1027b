# SPDX-License-Identifier: Apache-2.0
"""Entry point of ``robocal``, and what every command shares: arguments, the result, how it leaves.

Exit status: 0 = computed, also when the verdict refuses; 2 = wrong usage, or input that cannot be
read or is invalid; 3 = the data or the state of the history cannot give what was asked; 1 = a
crash of the program itself; 130 = interrupted.
"""

# ruff: noqa: E402  # threads are set before anything can load NumPy
import os

# With several threads the order of additions, hence the last bits of a result, depends on the
# number of cores.
for _library in ("OPENBLAS", "OMP", "MKL"):
    os.environ[f"{_library}_NUM_THREADS"] = "1"

import argparse
import contextlib
import json
import math
import re
import sys
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn, TextIO

from robocal_ros import __version__
from robocal_ros.cli.commands import COMMANDS, CliCommand, CliGroup
from robocal_ros.ground.errors import Code, InputError, RankDeficientError, RobocalError
from robocal_ros.ground.files import nearest, quoted

if TYPE_CHECKING:
    from rich.console import Console
    from rich.text import Text

    from robocal_ros.ground.documents import FailureDocument
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
    ``example``: of a `CliCommand`.
    """

    example: str | None = None

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

    def format_help(self) -> str:
        """Options, and the example."""
        text = super().format_help()
        if self.example is not None:
            text += f"\nexample:\n  {self.prog} {self.example}".rstrip() + "\n"
        return text

    def parse_known_args(  # type: ignore[override]  # of its forms the one that is called
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> tuple[argparse.Namespace, list[str]]:
        """Keep what was typed, for `error`."""
        self._typed = list(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Raise a `UsageError`, with what may have been meant; argparse would leave with text."""
        options, commands = _known_to(self)
        if typed := re.search(r"(invalid choice: '|unrecognized arguments: )([\w-]+)", message):
            message += nearest(typed[2], options if typed[2].startswith("-") else commands)
        elif "are required: " in message:  # perhaps it is there, and misspelt
            words = {word.split("=")[0] for word in self._typed if word.startswith("--")}
            for word in sorted(words.difference(options)):
                message += f"; unrecognized {word}{nearest(word, options)}"
        raise UsageError(message, self.format_usage())


def _known_to(parser: argparse.ArgumentParser) -> tuple[list[str], list[str]]:
    """Options of a parser and of those below it, and its own commands."""
    options: list[str] = []
    commands: list[str] = []
    for action in parser._actions:
        options += action.option_strings
        if isinstance(action, argparse._SubParsersAction):
            commands += action.choices
            for below in action.choices.values():
                options += _known_to(below)[0]
    return options, commands


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


# Types of arguments: an `argparse.ArgumentTypeError` for what is none.

PARTS = ("base", "tool", "geometry")
ROBOT_HELP = "robot file, or name of a shipped robot (ur10, kr150_r3100 …)"
SIGMA_MM = 0.03
FOUND_MASSES = "Compliances count with masses that were found: they are no kilograms of links."


def parts(value: str) -> tuple[str, ...]:
    """Type of a list such as ``base,tool``, none twice; in the order of ``PARTS``."""
    names = [name.strip() for name in value.split(",")]
    for name in names:
        if name not in PARTS:
            raise argparse.ArgumentTypeError(f"{quoted(name)} is not one of {', '.join(PARTS)}")
    if len(set(names)) != len(names):
        raise argparse.ArgumentTypeError(f"{quoted(value)} names a part twice")
    return tuple(name for name in PARTS if name in names)


def positive(value: str) -> float:
    """Type of a finite number above zero."""
    return _between(value, math.inf, "a number above 0")


def from_zero(value: str) -> float:
    """Type of a finite number, zero or above."""
    return _between(value, math.inf, "a number from 0", zero=True)


def share(value: str) -> float:
    """Type of a share between 0 and 1."""
    return _between(value, 1.0, "a share between 0 and 1")


def _between(value: str, most: float, what: str, *, zero: bool = False) -> float:
    """A number above zero, or ``zero`` itself, and below ``most``."""
    try:
        number = float(value)
    except ValueError:
        number = math.nan
    if not (0.0 < number < most or (zero and number == 0.0)):
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not {what}")
    return abs(number)


def count(value: str) -> int:
    """Type of an argument that counts something: a whole number from 1."""
    return seed(value, least=1)


def seed(value: str, least: int = 0) -> int:
    """Type of a seed of a random choice: a whole number from ``least``."""
    if not (value.isascii() and value.isdigit()) or int(value) < least:
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not a whole number from {least}")
    return int(value)


def text(value: str) -> str:
    """Type of an argument that is kept as text: no bytes beside the terminal's encoding."""
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


def add_joint_error(parser: "argparse._ActionsContainer") -> None:
    """Offer ``--joint-error-urad``; None where it is not given."""
    from robocal_ros.kinematics.joint_errors import SIZE_URAD

    parser.add_argument(
        "--joint-error-urad",
        type=from_zero,
        metavar="E",
        help="joints turn by so much, rms, otherwise than they read, where the robot's model has "
        f"no joint functions; default {SIZE_URAD:g}, as a UR10's; 0: nothing is said of it",
    )


def joint_error_rad(args: argparse.Namespace, known: bool = True) -> float:
    """What is given there, or the default; 0 where it is not offered.

    Raises `InputError` where it is given, but no joints are ``known``.
    """
    from robocal_ros.kinematics.joint_errors import SIZE_URAD

    given = getattr(args, "joint_error_urad", 0.0)
    if given and not known:
        words = "--joint-error-urad needs the joints of each pose: give these, and --robot"
        raise InputError(words)
    return 1e-6 * (SIZE_URAD if given is None else float(given))


def add_state(parser: argparse.ArgumentParser) -> None:
    """Offer ``--state``, where the histories are."""
    words = "folder of the histories, default $ROBOCAL_STATE or ~/.local/state/robocal"
    parser.add_argument("--state", type=Path, metavar="DIR", help=words)


def describe_robot(name: str) -> "tuple[RobotDescription, list[str]]":
    """Read a robot file; beside it warnings of what it leaves open."""
    from robocal_ros.kinematics.robots import load_description

    description = load_description(name)
    return description, [f"{description.path}: {note}" for note in description.notes]


def warn(messages: Iterable[str]) -> None:
    """Tell people on standard error what may have escaped them."""
    for message in messages:
        print(f"robocal: warning: {message}", file=sys.stderr)


def three_numbers(value: str) -> tuple[float, ...]:
    """Type of three finite numbers such as ``1,-2.5,3``."""
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

    ``document``: what ``--json`` prints; finite numbers only. Its ``warnings``, and its ``error``
    where there is one, are told on standard error. ``render``: prints the document for people.
    """

    document: Mapping[str, Any]
    render: "Callable[[Console, Any], None]"
    exit_code: int = DONE


def exit_status(code: Code) -> int:
    """Exit status of a command that ends with an error of this code."""
    return BAD_REQUEST if code in _REQUEST_CODES else NO_ANSWER


def failure(error: RobocalError) -> "FailureDocument":
    """JSON document of a command that ends with this error."""
    document = refusal(error.code, str(error))
    if isinstance(error, InputError):
        told = document["error"]
        told["file"], told["row"], told["column"] = error.file, error.row, error.column
    if isinstance(error, RankDeficientError):
        document["unobservable"] = list(error.directions)
    return document


def crash(error: BaseException) -> "FailureDocument":
    """JSON document of a crash: no verdict came about."""
    return refusal(Code.NONE, f"internal error, {type(error).__name__}: {error}")


def refusal(code: Code, message: str) -> "FailureDocument":
    """``error`` and ``verdict`` of a command that cannot answer."""
    return {
        "error": {"code": code.name, "message": message, "file": None, "row": None, "column": None},
        "verdict": {"accept": False, "code": code.name, "reason": message},
    }


def tell(code: str, message: object) -> None:
    """Say on standard error, in one line, why a command ends without an answer."""
    print(f"robocal: {message} [{code}]", file=sys.stderr)


def write_json(document: Mapping[str, Any], stream: TextIO) -> None:
    stream.write(json.dumps(document, indent=2, allow_nan=False) + "\n")
    stream.flush()


def show(outcome: CliResult, stream: TextIO) -> None:
    """Print for people; a pipe gets wide lines, so that tables stay whole."""
    from rich.console import Console

    class Result(Console):
        def on_broken_pipe(self) -> None:  # rich itself would leave with status 1
            raise BrokenPipeError

    wide = None if stream.isatty() or "COLUMNS" in os.environ else _PIPE_COLUMNS
    outcome.render(Result(file=stream, highlight=False, width=wide), outcome.document)
    stream.flush()


def progress_console() -> "Console":
    """Where progress is shown: standard error, so that it is never mixed with the result."""
    from rich.console import Console

    return Console(file=sys.stderr, highlight=False)


def print_table(
    console: "Console",
    title: str,
    head: Sequence[str],
    rows: "Iterable[Sequence[str | Text]]",
    words: Sequence[int] = (0,),
) -> None:
    """Print rows below their heads; the columns ``words`` hold text, all others numbers."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", box=None)
    for column, name in enumerate(head):
        table.add_column(name, justify="left" if column in words else "right")
    for row in rows:
        table.add_row(*(Text(cell) if isinstance(cell, str) else cell for cell in row))
    console.print(table)


def print_words(console: "Console", words: str, style: str = "") -> None:
    """Print a line as it is: no markup, and wrapped by the terminal alone."""
    from rich.text import Text

    console.print(Text(words, style=style), soft_wrap=True)


def print_text(console: "Console", document: Document) -> None:
    """Print what was exported, as a file would hold it."""
    console.out(document["text"], highlight=False)


def print_verdict(console: "Console", document: Document) -> None:
    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    print_words(console, f"{verdict['code']}: {verdict['reason']}", style)


def print_output(console: "Console", document: Document) -> None:
    if document.get("output"):
        print_words(console, f"Written: {document['output']}")


def spaced(values: Iterable[float], digits: int, between: str = " ") -> str:
    return between.join(f"{value:.{digits}f}" for value in values)


# ---- the commands, of which only the one that is named is loaded --------------------------------


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``robocal`` with these arguments (default: the process's) and return its exit status."""
    if "_ARGCOMPLETE" in os.environ:
        _complete()
    arguments = with_negative_values(sys.argv[1:] if argv is None else argv)
    stream = sys.stdout
    as_json = "--json" in arguments
    try:
        # Whatever a library prints must not mix with the document.
        with contextlib.redirect_stdout(sys.stderr) if as_json else contextlib.nullcontext():
            return _answer(arguments, stream, as_json)
    except BrokenPipeError:
        # The reader has seen enough. Python would complain when it flushes at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return DONE
    except KeyboardInterrupt:
        print("robocal: interrupted", file=sys.stderr)
        return INTERRUPTED


def _answer(arguments: Sequence[str], stream: TextIO, as_json: bool) -> int:
    try:
        try:
            args = _parser(arguments).parse_args(arguments)
            outcome: CliResult = args.run_command(args)
            warn(outcome.document.get("warnings", ()))
            if "error" in outcome.document:
                tell(outcome.document["error"]["code"], outcome.document["error"]["message"])
        except OSError as error:
            if error.filename is None or isinstance(error, BrokenPipeError):
                raise
            raise InputError(error.strerror or str(error), file=str(error.filename)) from error
        if as_json:
            write_json(outcome.document, stream)
        else:
            show(outcome, stream)
        return outcome.exit_code
    except InformationAskedFor as asked:
        if as_json:
            write_json({asked.name: asked.text}, stream)
        else:
            stream.write(asked.text.rstrip() + "\n")
            stream.flush()
        return DONE
    except RobocalError as error:
        if isinstance(error, UsageError):
            print(error.usage.rstrip(), file=sys.stderr)
        tell(error.code.name, error)
        document, status = failure(error), exit_status(error.code)
    except BrokenPipeError:
        raise
    except Exception as error:
        traceback.print_exc()
        document, status = crash(error), CRASHED
    if as_json:
        write_json(document, stream)
    return status


def _parser(arguments: Sequence[str]) -> CommandParser:
    """With the options of the command that the arguments name."""
    parser = CommandParser(
        prog="robocal", description="Accuracy of industrial robots, on files and bags."
    )
    parser.add_argument(
        "--version",
        action=_Information,
        version=f"robocal {__version__}",
        help="show the version and leave",
    )
    words = [word for word in arguments if not word.startswith("-")]
    _declare(parser, "command", COMMANDS, words)
    return parser


def _complete() -> NoReturn:
    """Tell a shell what may follow in the line that it has."""
    try:
        from argcomplete import autocomplete
        from argcomplete.lexers import split_line
    except ImportError:
        sys.exit(BAD_REQUEST)
    line, point = os.environ["COMP_LINE"], int(os.environ["COMP_POINT"])
    *_, words, _ = split_line(line, point)
    autocomplete(_parser(words[1:]), always_complete_options="long")
    sys.exit()


def _declare(
    parser: CommandParser,
    what: str,
    commands: Mapping[str, CliCommand | CliGroup],
    words: Sequence[str],
) -> None:
    """Declare the commands, and of the one that is named its options or its own commands."""
    parsers = parser.add_subparsers(
        dest=what, required=True, metavar=what, parser_class=CommandParser
    )
    for name, command in commands.items():
        own = parsers.add_parser(name, help=command.help, description=command.help)
        if words[:1] != [name]:
            continue  # nobody will look at it: 2 ms for all
        if isinstance(command, CliGroup):
            _declare(own, "action", command.actions, words[1:])
        else:
            own.example = command.example
            module_name, place = command.place.split(":")
            module = import_module(f"robocal_ros.{module_name}")
            getattr(module, f"add_{place}")(own)
            own.set_defaults(run_command=getattr(module, f"run_{place}"))


if __name__ == "__main__":
    sys.exit(main())
