"""``robocal hand-eye step``: a line laser from profiles along the marks of known stairs."""

import argparse

from robocal_ros.cli.hand_eye_shots import add_target_file
from robocal_ros.cli.hand_eye_target import add_target_action, run_target
from robocal_ros.cli.output import CliResult

NAME = "step"
HELP = "place a line laser on the flange from profiles of stairs at a taught place"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_target_action(parser)
    add_target_file(parser, "the stairs and where they were taught")


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    return run_target(NAME, args)
