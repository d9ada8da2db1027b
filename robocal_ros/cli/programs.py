"""Robots that ROS does not command: ``robocal correct-program``."""

import argparse
import json
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.cli.main import (
    ROBOT_HELP,
    CliResult,
    Document,
    describe_robot,
    positive,
    print_output,
    print_table,
    print_verdict,
    print_words,
    text,
)
from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground.errors import Code, InputError, WrongRobotError
from robocal_ros.ground.files import read_bytes, read_text, write_bytes
from robocal_ros.ground.frames import Array
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import state_folder
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of
from robocal_ros.programs.correcting import (
    STATES,
    CorrectionModels,
    ProgramCorrection,
    dialect_of,
    report,
)
from robocal_ros.programs.fanuc import FanucDialect
from robocal_ros.programs.points import Dialect, frame_given

if TYPE_CHECKING:
    from rich.console import Console

_MODEL = (
    "robot file of the robot as identified, or what 'robocal history show --json' prints of a "
    "calibration"
)
_EXAMPLE = """example:
  robocal correct-program weld.dat --robot kr150_r3100 --model identified.yaml \\
      --frames '$config.dat' --output corrected/weld.dat
  robocal correct-program part.script --robot ur10 --robot-serial 20205501 --output part_c.script
"""


def _joints(value: str) -> Array:
    """Type of joints in degrees such as ``0,-90,90,0,30,0``, as rad."""
    try:
        return np.radians([float(cell) for cell in value.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{value}' is no list of joints in degrees") from error


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Offer the robot, and the model that it is corrected for."""
    parser.add_argument(
        "--robot",
        required=True,
        metavar="R.yaml",
        help=f"nominal model, with which the controller reckons: {ROBOT_HELP}",
    )
    model = parser.add_mutually_exclusive_group(required=True)
    model.add_argument("--model", type=Path, metavar="FILE", help=_MODEL)
    model.add_argument(
        "--robot-serial",
        type=text,
        metavar="S",
        help="take the model in force in this robot's history",
    )
    parser.add_argument(
        "--state",
        type=Path,
        metavar="DIR",
        help="folder of the histories, default $ROBOCAL_STATE or ~/.local/state/robocal",
    )
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="FILE",
        help="the robot as it was when the program was taught, as --model; without it the program "
        "was made off line, with the nominal model",
    )


def given_models(args: argparse.Namespace) -> tuple[CorrectionModels, list[str]]:
    """The models of `add_model_options`, and warnings.

    Raises `InputError` where one cannot be read, `WrongRobotError` where it is of another robot.
    """
    robot, warnings = describe_robot(args.robot)
    nominal = robot.arm
    actual = read_model(args.model, nominal) if args.model else _in_force(args, nominal)
    reference = nominal if args.reference is None else read_model(args.reference, nominal)
    return CorrectionModels(nominal, actual, reference), warnings


def read_model(path: Path, nominal: SerialArm) -> SerialArm:
    """A robot as identified, from a robot file or a document with a ``model``.

    Raises `InputError` when it is neither, `WrongRobotError` for other joints than the nominal's.
    """
    if path.suffix == ".json":
        try:
            document = json.loads(read_text(path, "model"))
            model = document.get("model", document)
            names, arm = tuple(model["joint_names"]), arm_of(model, nominal)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"holds no model: {error!r}", file=str(path)) from error
    else:
        arm = describe_robot(str(path))[0].arm
        names = arm.joint_names
    if names != nominal.joint_names or np.any(arm.prismatic != nominal.prismatic):
        raise WrongRobotError(
            f"{path}: its joints are {', '.join(names)}, those of {nominal.name} are "
            f"{', '.join(nominal.joint_names)}"
        )
    return arm


def _in_force(args: argparse.Namespace, nominal: SerialArm) -> SerialArm:
    folder = state_folder() if args.state is None else args.state.absolute()
    with CalibrationHistory.open(
        args.robot_serial,
        model_hash=nominal.model_hash,
        state_dir=folder,
        create=False,
        owner=False,
    ) as history:
        chosen = history.head(THERMAL).calibration_id
        if chosen is None:
            raise InputError(f"no model is in force for {args.robot_serial}: accept one first")
        return arm_of(history.model(chosen), nominal)


def add_correct_program(parser: argparse.ArgumentParser) -> None:
    """Declare the options of ``correct-program``."""
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EXAMPLE
    parser.add_argument(
        "program", type=Path, metavar="FILE", help="program: .src, .dat, .mod, .ls, .script …"
    )
    add_model_options(parser)
    parser.add_argument(
        "--output", type=Path, metavar="FILE", help="program to write, never over another"
    )
    parser.add_argument(
        "--partial",
        action="store_true",
        help="write it also where points are left as they are",
    )
    parser.add_argument(
        "--frames",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="further file of this controller that holds tools and bases ($config.dat, a module)",
    )
    parser.add_argument(
        "--frame",
        action="append",
        default=[],
        metavar="NAME=X,Y,Z,…",
        help="a tool or base by the program's name for it (TOOL_DATA[1], tGun, UT4, UF2, tcp), in "
        "the maker's own numbers and units",
    )
    for name, what in (("tool", "tool"), ("base", "base, user frame or work object")):
        parser.add_argument(
            f"--{name}", metavar="NAME", help=f"{what} of points whose program says none"
        )
    parser.add_argument(
        "--posture-deg",
        type=_joints,
        metavar="Q1,Q2,…",
        help="joints near which the first point is that has no configuration",
    )
    for name, default, what in (("mm", 5.0, "of the flange"), ("deg", 1.0, "of a joint")):
        parser.add_argument(
            f"--largest-{name}",
            type=positive,
            default=default,
            metavar="S",
            help=f"largest correction {what}, default {default:g}",
        )
    parser.add_argument(
        "--j23",
        type=float,
        default=1.0,
        metavar="K",
        help="FANUC: the robot file's joint 3 is J3 + K J2, default 1",
    )


def run_correct_program(args: argparse.Namespace) -> CliResult:
    """Do ``correct-program``. Raises `RobocalError` for what a user can mend."""
    if args.output is not None and args.output.exists():
        raise InputError("is there already: name another file", file=str(args.output))
    models, warnings = given_models(args)
    models = replace(
        models,
        largest_m=1e-3 * args.largest_mm,
        largest_rad=float(np.radians(args.largest_deg)),
    )
    dialect = dialect_of(args.program.suffix)
    if isinstance(dialect, FanucDialect):
        dialect = FanucDialect(args.j23)
    if args.posture_deg is not None and len(args.posture_deg) != models.nominal.n:
        raise InputError(f"--posture-deg: {models.nominal.name} has {models.nominal.n} joints")
    given = dict(frame_given(dialect.maker, words) for words in args.frame)
    for path in args.frames:
        given = dict(dialect.read(_program_text(path, dialect)).frames) | given
    correction = ProgramCorrection(dialect, models, given, args.tool, args.base, args.posture_deg)
    done = correction.correct(_program_text(args.program, dialect))
    document = report(done)
    left = document["count"]["not_corrected"]
    verdict = Verdict(Code.ACCEPT, f"all of {len(done.points)} points are as they should be")
    if not done.points:
        raise InputError("holds no point that is known here", file=str(args.program))
    if left:
        words = f"{left} of {len(done.points)} points are left as they were"
        hint = "" if args.partial else "; --partial writes the others all the same"
        verdict = Verdict(Code.LIMIT_EXCEEDED, words + hint)
    written = args.output is not None and (args.partial or not left)
    if written:
        write_bytes(args.output, done.text.encode("latin-1"))
    document = {
        "program": str(args.program),
        "maker": dialect.maker,
        "robot": models.nominal.name,
        "model_hash": models.nominal.model_hash,
        "output": str(args.output) if written else None,
        **document,
        "warnings": warnings + document["warnings"],
        "verdict": verdict_document(verdict),
    }
    return CliResult(document, _show_corrected)


def _program_text(path: Path, dialect: Dialect) -> str:
    data = read_bytes(path, "program")
    if b"\0" in data:
        raise InputError(
            f"is no text of {dialect.maker} with one byte a character: export it as such",
            file=str(path),
        )
    return data.decode("latin-1")


def _show_corrected(console: "Console", document: Document) -> None:
    rows = []
    for point in document["points"]:
        left = "" if point["left_mm"] is None else f"{point['left_mm']:.4f}"
        shift = (f"{point['shift_mm']:.4f}", f"{point['shift_deg']:.4f}")
        rows.append([point["name"], str(point["line"]), *shift, left, point["reason"]])
    count = document["count"]
    title = ", ".join(f"{count[state]} {state.replace('_', ' ')}" for state in STATES)
    head = ("point", "line", "moved mm", "deg", "left mm", "why not")
    print_table(console, f"{document['program']}: {title}", head, rows, words=(0, 5))
    for place in document["computed"]:
        print_words(console, f"Line {place['line']} makes a point itself: {place['text']}")
    print_verdict(console, document)
    print_output(console, document)
