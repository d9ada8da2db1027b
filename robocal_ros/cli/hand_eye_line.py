"""``robocal hand-eye line``: a line laser from profiles across a straight edge or groove."""

import argparse

from robocal_ros.cli.hand_eye_shots import add_feature, add_target_file
from robocal_ros.cli.hand_eye_target import add_target_action, run_target
from robocal_ros.cli.output import CliResult

NAME = "line"
HELP = "place a line laser on the flange from profiles across a straight edge or groove"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    add_target_action(parser)
    add_target_file(parser, "where the line is; default: that is found too")
    add_feature(parser)


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    return run_target(NAME, args)
