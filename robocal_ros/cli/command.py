"""What a command's module offers."""

import argparse
from typing import Protocol

from robocal_ros.cli.output import CliResult


class CliCommand(Protocol):
    """A module of this package; it imports what is heavy inside ``run``."""

    NAME: str
    HELP: str

    def add_arguments(self, parser: argparse.ArgumentParser) -> None:
        """Declare the options."""

    def run(self, args: argparse.Namespace) -> CliResult:
        """Do it. Raises `RobocalError` for what a user can mend."""
