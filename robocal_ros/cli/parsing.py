"""The command line: argparse with usage errors and help as results instead of exits."""

import argparse
import re
from collections.abc import Sequence
from typing import Any, NoReturn

from robocal_ros.ground.errors import InputError

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
