"""Entry point of ``robocal``.

The table of commands holds what the help says, so that only the command that is named is loaded.
"""

# ruff: noqa: E402  # threads are set before anything can load NumPy
from robocal_ros.single_thread import use_one_thread

use_one_thread()

import contextlib
import os
import sys
import traceback
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import TextIO

from robocal_ros import __version__
from robocal_ros.cli.command import (
    BAD_REQUEST,
    CRASHED,
    DONE,
    INTERRUPTED,
    CliResult,
    CommandParser,
    Document,
    InformationAskedFor,
    UsageError,
    crash,
    exit_status,
    failure,
    show,
    tell,
    with_negative_values,
    write_json,
)
from robocal_ros.ground.errors import InputError, RobocalError


@dataclass(frozen=True)
class CliCommand:
    """A command: ``place`` is ``module:name``, where ``add_name`` and ``run_name`` are.

    The first declares options at a parser, the second takes what was given and returns a
    `CliResult`, or raises `RobocalError` for what a user can mend.
    """

    place: str
    help: str


@dataclass(frozen=True)
class CliGroup:
    """A command that has actions of its own, such as ``robocal tool beams``."""

    help: str
    actions: Mapping[str, CliCommand]


COMMANDS: Mapping[str, "CliCommand | CliGroup"] = {
    "fk": CliCommand("cli.robot:fk", "pose of the flange, and of the tool, at given joint values"),
    "identify": CliCommand(
        "cli.identify:identify",
        "identify a robot's model from a table of measurements, and judge it on unseen ones",
    ),
    "replay": CliCommand(
        "cli.replay:replay", "run a recorded bag (MCAP) through the sessions of the live nodes"
    ),
    "validate": CliCommand(
        "cli.validate:validate",
        "replay any number of bags, in parallel, and write one report: is it good, in mm?",
    ),
    "history": CliCommand(
        "cli.history:history", "list the calibrations of a robot; accept, reject or roll back"
    ),
    "thermal": CliGroup(
        "place the sensor, identify a thermal drift, learn what drift to expect, screen, plan"
        " poses",
        {
            "calibrate-sensor": CliCommand(
                "thermal.cli:calibrate_sensor",
                "place a fixed sensor and the sphere on the flange from one cold visit of "
                "five poses or more",
            ),
            "identify": CliCommand(
                "thermal.cli:identify",
                "identify a thermal drift, or the geometry of a measuring robot, and judge it",
            ),
            "learn-prior": CliCommand(
                "thermal.cli:learn_prior",
                "learn what drift to expect of a robot from tables of its measuring cycles",
            ),
            "screen": CliCommand(
                "thermal.cli:screen",
                "find which parameters a drift needs, by what is left at check poses",
            ),
            "plan-poses": CliCommand(
                "thermal.cli:plan_poses",
                "choose the poses of a measuring cycle that say most about the tool, and how "
                "much better",
            ),
        },
    ),
    "tool": CliGroup(
        "place light beams, measure a tool with them or by touching a point, hand it to a "
        "controller",
        {
            "beams": CliCommand(
                "tool.cli:beams",
                "place two crossed light beams from the edges A1 to D4 of a cylinder at the flange",
            ),
            "crossed": CliCommand(
                "tool.cli:crossed",
                "find a tool from the edges of a whole run, or its axis from one circle at "
                "constant speed",
            ),
            "points": CliCommand(
                "tool.cli:points",
                "find a tool's tip from four touches of one point or more; its orientation "
                "from seven poses",
            ),
            "parallel": CliCommand(
                "tool.cli:parallel",
                "find a tool's axis, and its tip, by sweeps through two parallel beams along "
                "the base's y",
            ),
            "export": CliCommand(
                "tool.cli:export", "print a tool's frame for a controller, or for URDF"
            ),
        },
    ),
    "hand-eye": CliGroup(
        "place a sensor on the robot's flange, or beside the robot",
        {
            "sphere": CliCommand(
                "hand_eye.cli:sphere",
                "place a line laser on the flange from profiles across a sphere that stands "
                "anywhere",
            ),
            "step": CliCommand(
                "hand_eye.cli:step",
                "place a line laser on the flange from profiles of stairs at a taught place",
            ),
            "line": CliCommand(
                "hand_eye.cli:line",
                "place a line laser on the flange from profiles across a straight edge or groove",
            ),
            "tracker": CliCommand(
                "hand_eye.cli_sensors:tracker",
                "place a profile sensor by a laser tracker that sees the flange, and a cube "
                "with a sphere",
            ),
            "camera": CliCommand(
                "hand_eye.cli_sensors:camera",
                "place a camera from images of a chessboard, or from poses of a board or a "
                "tracked target",
            ),
            "joint": CliCommand(
                "hand_eye.cli:joint",
                "place a line laser on the flange from the shots of two or three targets together",
            ),
            "check-plan": CliCommand(
                "hand_eye.cli:check_plan",
                "tell before the robot moves what planned poses would give, and which others "
                "would do",
            ),
            "verify": CliCommand(
                "hand_eye.cli:verify",
                "judge a line laser's place by shots that did not give it, of the same target"
                " or another",
            ),
            "export": CliCommand(
                "hand_eye.cli:export", "print a sensor's place for URDF, xacro or tf2"
            ),
        },
    ),
    "iso9283": CliCommand(
        "cli.identify:iso9283",
        "position accuracy and repeatability (AP, RP) of single poses as ISO 9283, 7.2, "
        "defines them; no whole test",
    ),
    "import-ur": CliCommand(
        "cli.robot:import_ur",
        "turn the factory calibration of a Universal Robots arm into a robot file",
    ),
}
"""Each command, in the order of the help."""


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
    parser = CommandParser(
        prog="robocal", description="Accuracy of industrial robots, on files and bags."
    )
    parser.add_version(f"robocal {__version__}")
    _declare(parser, "command", COMMANDS, [word for word in arguments if not word.startswith("-")])
    args = parser.parse_args(arguments)
    answer: CliResult = args.run_command(args)
    return answer


def _declare(
    parser: CommandParser,
    what: str,
    commands: Mapping[str, CliCommand | CliGroup],
    words: Sequence[str],
) -> None:
    """Declare the commands, and of the one that is named its options."""
    parsers = parser.add_subparsers(
        dest=what, required=True, metavar=what, parser_class=CommandParser
    )
    for name, command in commands.items():
        own = parsers.add_parser(name, help=command.help, description=command.help)
        if isinstance(command, CliGroup):
            _declare(own, "action", command.actions, words[1:] if words[:1] == [name] else ())
        elif words[:1] == [name]:
            module_name, place = command.place.split(":")
            module = import_module(f"robocal_ros.{module_name}")
            getattr(module, f"add_{place}")(own)
            own.set_defaults(run_command=getattr(module, f"run_{place}"))


if __name__ == "__main__":
    sys.exit(main())
