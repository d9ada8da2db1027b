"""Kinds of arguments and messages that several commands share."""

import argparse
import math
import sys
from collections.abc import Iterable
from typing import TYPE_CHECKING

from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from robocal_ros.kinematics.robots import RobotDescription

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
