"""Entry point of ``robocal``.

A command is a module of this package (see `CliCommand`).
"""

# ruff: noqa: E402  # threads are set before anything can load NumPy
from robocal_ros.single_thread import use_one_thread

use_one_thread()

import contextlib
import os
import sys
import traceback
from collections.abc import Sequence
from importlib import import_module
from typing import TextIO, cast

from robocal_ros import __version__
from robocal_ros.cli.command import CliCommand
from robocal_ros.cli.output import (
    BAD_REQUEST,
    CRASHED,
    DONE,
    INTERRUPTED,
    CliResult,
    Document,
    crash,
    exit_status,
    failure,
    show,
    tell,
    write_json,
)
from robocal_ros.cli.parsing import (
    CommandParser,
    InformationAskedFor,
    UsageError,
    with_negative_values,
)
from robocal_ros.ground.errors import InputError, RobocalError

COMMANDS = {
    "fk": "fk",
    "identify": "identify",
    "replay": "replay",
    "validate": "validate",
    "history": "history",
    "thermal": "thermal",
    "tool": "tool",
    "hand-eye": "hand_eye",
    "iso9283": "iso9283",
    "import-ur": "import_ur",
}
"""Name of each command and its module, in the order of the help."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run ``robocal`` with these arguments (default: the process's) and return its exit status."""
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
            outcome = _execute(arguments)
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
        return _fail(error, stream, as_json)
    except BrokenPipeError:
        raise
    except Exception as error:
        traceback.print_exc()
        _write_failure(crash(error), stream, as_json)
        return CRASHED


def _fail(error: RobocalError, stream: TextIO, as_json: bool) -> int:
    if isinstance(error, UsageError):
        print(error.usage.rstrip(), file=sys.stderr)
    tell(error.code.name, error)
    _write_failure(failure(error), stream, as_json)
    return BAD_REQUEST if isinstance(error, UsageError) else exit_status(error)


def _write_failure(document: Document, stream: TextIO, as_json: bool) -> None:
    if as_json:
        write_json(document, stream)


def _execute(arguments: Sequence[str]) -> CliResult:
    # Only the command that is named is imported; the help needs them all.
    named = next((word for word in arguments if not word.startswith("-")), None)
    chosen = [named] if named in COMMANDS else list(COMMANDS)
    parser = CommandParser(
        prog="robocal", description="Accuracy of industrial robots, on files and bags."
    )
    parser.add_version(f"robocal {__version__}")
    parsers = parser.add_subparsers(
        dest="command", required=True, metavar="command", parser_class=CommandParser
    )
    commands: dict[str, CliCommand] = {}
    for name in chosen:
        module = cast(CliCommand, import_module(f"robocal_ros.cli.{COMMANDS[name]}"))
        module.add_arguments(parsers.add_parser(name, help=module.HELP, description=module.HELP))
        commands[name] = module
    args = parser.parse_args(arguments)
    return commands[args.command].run(args)


if __name__ == "__main__":
    sys.exit(main())
