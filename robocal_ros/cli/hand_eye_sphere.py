"""``robocal hand-eye sphere``: a line laser from profiles across a sphere."""

import argparse

from robocal_ros.cli.hand_eye_shots import add_target
from robocal_ros.cli.hand_eye_target import add_target_action, run_target
from robocal_ros.cli.output import CliResult

NAME = "sphere"
HELP = "place a line laser on the flange from profiles across a sphere that stands anywhere"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_target_action(parser)
    add_target(parser)


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    return run_target(NAME, args, args.radius_mm)
