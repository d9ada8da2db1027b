"""``robocal thermal``: place a sensor, and identify a robot's thermal drift from tables."""

import argparse
from importlib import import_module
from typing import cast

from robocal_ros.cli.command import Command
from robocal_ros.cli.output import Outcome

NAME = "thermal"
HELP = "place the sensor, identify a thermal drift, learn what drift to expect, screen, plan poses"

ACTIONS = {
    "calibrate-sensor": "thermal_sensor",
    "identify": "thermal_identify",
    "learn-prior": "thermal_prior",
    "screen": "thermal_screen",
    "plan-poses": "thermal_plan",
}
"""Name of each action and its module."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the actions and their options."""
    actions = parser.add_subparsers(dest="action", required=True, metavar="action")
    for name in ACTIONS:
        module = _module(name)
        module.add_arguments(actions.add_parser(name, help=module.HELP, description=module.HELP))


def run(args: argparse.Namespace) -> Outcome:
    """Do it. Raises `RobocalError` for what a user can mend."""
    return _module(args.action).run(args)


def _module(action: str) -> Command:
    return cast(Command, import_module(f"robocal_ros.cli.{ACTIONS[action]}"))
