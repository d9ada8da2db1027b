"""Commands with actions of their own: ``robocal thermal …``, ``robocal tool …``."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import cast

from robocal_ros.cli.command import CliCommand
from robocal_ros.cli.output import CliResult


@dataclass(frozen=True)
class Actions:
    """Actions by name, each with its module."""

    modules: Mapping[str, str]

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the actions and their options."""
        actions = parser.add_subparsers(dest="action", required=True, metavar="action")
        for name in self.modules:
            module = self._module(name)
            module.add_arguments(
                actions.add_parser(name, help=module.HELP, description=module.HELP)
            )

    def run(self, args: argparse.Namespace) -> CliResult:
        """Do it. Raises `RobocalError` for what a user can mend."""
        return self._module(args.action).run(args)

    def _module(self, action: str) -> CliCommand:
        return cast(CliCommand, import_module(f"robocal_ros.cli.{self.modules[action]}"))
