# SPDX-License-Identifier: Apache-2.0
"""Robots that ROS does not command: ``robocal correct-program`` and ``frame-shift``."""

import argparse
import json
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros.cli.main import (
    ROBOT_HELP,
    CliResult,
    Document,
    add_state,
    describe_robot,
    positive,
    print_output,
    print_table,
    print_verdict,
    print_words,
    text,
)
from robocal_ros.estimation.assessment import Verdict, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError, WrongRobotError
from robocal_ros.ground.files import read_bytes, read_text, shortened, write_bytes
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import state_folder
from robocal_ros.history.history_records import THERMAL, why_void
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import ALPHA, BETA, THETA, arm_of, layer_of, payload_note
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.tables import check_plain, read_cells, read_samples
from robocal_ros.programs.conventions import COUNT, base_text, tool_text
from robocal_ros.programs.correcting import (
    STATES,
    CorrectedProgram,
    ProgramCorrection,
    dialect_of,
    report,
)
from robocal_ros.programs.fanuc import FanucDialect
from robocal_ros.programs.frame_shift import LEVER_M, PARTS, FrameShift, best_shift, given_shift
from robocal_ros.programs.krl import KrlDialect
from robocal_ros.programs.points import OF_LINE, Dialect, frame_given
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.thermal.proposing import (
    ShiftedWork,
    keep_shift,
    shift_document,
    shift_in_force,
    shift_verdict,
    shifted_work,
)

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.programs.documents import (
        CorrectedProgramDocument,
        FrameShiftDocument,
        ShiftDocument,
    )

_MODEL = (
    "robot file of the robot as identified, or what 'robocal history show --json' prints of a "
    "calibration"
)
CONFIG = "$config.dat"
SAME_M, SAME_RAD = 1e-6, 2e-5  # of one frame in two files that round it, to 0.001 mm and deg
_EXAMPLE = """example:
  robocal correct-program weld.dat --robot kr150_r3100 --model identified.yaml \\
      --frames '$config.dat' --output corrected/weld.dat
  robocal correct-program part.script --robot my_ur.yaml --robot-serial 20205501 --output new.script
"""


def _joints(value: str) -> Array:
    """Type of joints in degrees such as ``0,-90,90,0,30,0``, as rad."""
    try:
        return np.radians([float(cell) for cell in value.split(",")])
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"'{value}' is no list of joints in degrees") from error


def _external(value: str) -> tuple[int, Array]:
    """Type of an external axis such as ``1=1,0,0`` or ``2=still``."""
    number, _, way = value.partition("=")
    try:
        along = np.zeros(3) if way == "still" else np.array([float(v) for v in way.split(",")])
        right = along.shape == (3,) and (way == "still" or abs(np.linalg.norm(along) - 1.0) < 1e-3)
        if not right or not 1 <= int(number) <= 6:
            raise ValueError(value)
    except ValueError as error:
        raise argparse.ArgumentTypeError(
            f"'{value}' is no number of an axis, 1 to 6, with 'still' or a direction of length 1"
        ) from error
    return int(number), along


def add_given_model(parser: argparse.ArgumentParser) -> None:
    """Offer the robot, and the model that it truly has."""
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
    add_state(parser)


def add_model_options(parser: argparse.ArgumentParser) -> None:
    """Offer the robot, the model that it is corrected for, and that of a taught program."""
    add_given_model(parser)
    parser.add_argument(
        "--reference",
        type=Path,
        metavar="FILE",
        help="the robot as it was when the program was taught, as --model; without it the program "
        "was made off line, with the nominal model",
    )


def given_models(args: argparse.Namespace) -> tuple[CorrectionModels, list[str]]:
    """The models of `add_model_options`, and warnings."""
    robot, warnings = describe_robot(args.robot)
    nominal = robot.arm
    actual = given_model(args, nominal, warnings)
    reference = nominal if args.reference is None else read_model(args.reference, nominal)[0]
    return CorrectionModels(nominal, actual, reference), warnings


def factory_note(maker: str | None, nominal: SerialArm) -> list[str]:
    """What is wrong where a UR controller, which has a factory calibration, is taken as nominal."""
    if maker != "ur" or np.abs(np.sin(2.0 * nominal.mdh[:, [THETA, ALPHA, BETA]])).max() > 1e-6:
        return []
    return [
        f"a Universal Robots controller reckons with its arm's factory calibration, a millimetre "
        f"or two from a nominal model such as {nominal.name}: what is corrected is off by as "
        "much; give as --robot the file that 'robocal import-ur' or 'import-urdf' makes of it"
    ]


def given_model(args: argparse.Namespace, nominal: SerialArm, warnings: list[str]) -> SerialArm:
    """The model of `add_given_model`, with payload and mounting of the nominal arm's file.

    ``warnings`` takes what it may cost that these were others. Raises as `given_models`.
    """
    if args.model:
        arm, identified = read_model(args.model, nominal, in_use=True)
    else:
        with model_history(args, nominal) as history:
            chosen = history.head(THERMAL).calibration_id
            if chosen is None:
                words = f"no model is in force for {args.robot_serial}: accept one first"
                raise InputError(words, file=str(history.path))
            model = history.model(chosen)
        arm, (_, identified) = arm_of(model, nominal), layer_of(model)
    if note := payload_note(arm, identified, nominal.load):
        warnings.append(note)
    return arm


def read_model(
    path: Path, nominal: SerialArm, *, in_use: bool = False
) -> tuple[SerialArm, ArmLoad | None]:
    """A robot as identified, carrying what the nominal arm does, and what it was identified with.

    ``path``: a robot file, or a document with a ``model``. ``in_use``: what the robot is to be
    corrected with, which no person may have undone.

    Raises `InputError` when it is neither, or void (`why_void`); `WrongRobotError` for other joints
    than the nominal's.
    """
    if path.suffix == ".json":
        try:
            document = json.loads(read_text(path, "model"))
            model = document.get("model", document)
            names, arm = tuple(model["joint_names"]), arm_of(model, nominal)
            _, identified = layer_of(model)
        except (ValueError, KeyError, TypeError, AttributeError) as error:
            raise InputError(f"holds no model: {error!r}", file=str(path)) from error
        if in_use and (words := why_void(document)):
            raise InputError(f"the calibration {words}", file=str(path))
    else:
        arm = describe_robot(str(path))[0].arm
        names, identified = arm.joint_names, arm.load
        if identified is not None:
            arm = replace(arm, load=identified.carrying(nominal.load))
    if names != nominal.joint_names or np.any(arm.prismatic != nominal.prismatic):
        raise WrongRobotError(
            f"{path}: its joints are {', '.join(names)}, those of {nominal.name} are "
            f"{', '.join(nominal.joint_names)}"
        )
    return arm, identified


def model_history(
    args: argparse.Namespace, nominal: SerialArm, *, create: bool = False
) -> CalibrationHistory:
    """The history of ``--robot-serial``; ``create``: also where the robot has none yet."""
    folder = state_folder() if args.state is None else args.state.absolute()
    return CalibrationHistory.open(
        args.robot_serial,
        model_hash=nominal.model_hash,
        state_dir=folder,
        create=create,
        owner=False,
    )


def add_correct_program(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _EXAMPLE
    parser.add_argument(
        "program", type=Path, metavar="FILE", help="program: .src, .dat, .mod, .ls, .script, .as …"
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
    _add_other_files(parser)
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
    parser.add_argument(
        "--external",
        type=_external,
        action="append",
        default=[],
        metavar="N=X,Y,Z",
        help="external axis N carries the robot along X,Y,Z of its base, so many mm as the program "
        "says; N=still: it carries neither the robot nor what the poses are in",
    )
    _add_bounds(parser)
    parser.add_argument(
        "--j23",
        type=float,
        default=1.0,
        metavar="K",
        help="FANUC: the robot file's joint 3 is J3 + K J2, default 1",
    )


def _add_other_files(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--module",
        type=Path,
        metavar="FILE",
        help="KUKA: the other file of the module, read with the program (.src of a .dat, .dat of a "
        ".src); without it the one beside the program that has its name",
    )
    parser.add_argument(
        "--frames",
        type=Path,
        action="append",
        default=[],
        metavar="FILE",
        help="KUKA, ABB: further file of tools and bases ($config.dat, of which FDAT are read too, "
        "a module)",
    )
    parser.add_argument(
        "--frame",
        action="append",
        default=[],
        metavar="NAME=X,Y,Z,…",
        help="a tool or base by the program's name for it (TOOL_DATA[1], tGun, UT4, UF2, tcp), in "
        "the maker's own numbers and units",
    )


def _add_bounds(parser: argparse.ArgumentParser) -> None:
    for name, default, what in (("mm", 5.0, "of the flange"), ("deg", 1.0, "of a joint")):
        parser.add_argument(
            f"--largest-{name}",
            type=positive,
            default=default,
            metavar="S",
            help=f"largest correction {what}, default {default:g}",
        )


def run_correct_program(args: argparse.Namespace) -> CliResult:
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
    program = _program_text(args.program, dialect)
    module = None
    if isinstance(dialect, KrlDialect):
        module = _module_of(args.program, args.module)
        warnings += _module_note(args.program, module)
        config = "".join(_program_text(p, dialect) for p in args.frames if p.name.lower() == CONFIG)
        other = ("", "") if module is None else (_program_text(module, dialect), module.name)
        dialect = KrlDialect(*other, config)
    elif args.module is not None:
        raise InputError(f"--module: a program of {dialect.maker} is one file; leave it out")
    given = _given_frames(args, dialect, program)
    correction = ProgramCorrection(
        dialect, models, given, args.tool, args.base, args.posture_deg, dict(args.external)
    )
    done = correction.correct(program)
    verdict = _program_verdict(done, args)
    written = args.output is not None and (args.partial or verdict.accept)
    if written:
        write_bytes(args.output, done.text.encode("latin-1"))
    told = report(done)
    document: CorrectedProgramDocument = {
        "program": str(args.program),
        "module": None if module is None else str(module),
        "maker": dialect.maker,
        "robot": models.nominal.name,
        "model_hash": models.nominal.model_hash,
        "output": str(args.output) if written else None,
        **told,
        "warnings": [*warnings, *factory_note(dialect.maker, models.nominal), *told["warnings"]],
        "verdict": verdict_document(verdict),
    }
    return CliResult(document, _show_corrected)


def _program_verdict(done: CorrectedProgram, args: argparse.Namespace) -> Verdict:
    """Whether all points of this robot are right. Raises `InputError` where there are none."""
    own = [one for one in done.points if not one.point.of_another]
    others = [one.point.name for one in done.points if one.point.of_another]
    if not done.points:
        raise InputError("holds no point that is known here", file=str(args.program))
    if not own:
        words = f"holds no point of this robot: {others[0]} {done.points[0].reason}"
        raise InputError(words, file=str(args.program))
    names = shortened(", ".join(others))
    told = f"; of another group alone, not corrected: {names}" if others else ""
    left = sum(1 for one in own if one.reason)
    if not left:
        return Verdict(Code.ACCEPT, f"all of {len(own)} points are as they should be{told}")
    hint = "" if args.partial else "; --partial writes the others all the same"
    words = f"{left} of {len(own)} points are left as they were{hint}{told}"
    return Verdict(Code.LIMIT_EXCEEDED, words)


def _module_of(program: Path, given: Path | None) -> Path | None:
    """The other file of a KUKA program's module: as given, else beside it, in any letters.

    Raises `InputError` for one that can be none.
    """
    wanted = (".src", ".sub") if program.suffix.lower() == ".dat" else (".dat",)
    if given is not None:
        if given.suffix.lower() in wanted:
            return given
        words = f"--module: to {program.name} belongs a file with the ending {' or '.join(wanted)}"
        raise InputError(f"{words}; give one of tools and bases by --frames", file=str(given))
    try:
        beside = {
            path.suffix.lower(): path
            for path in sorted(program.parent.iterdir())
            if path.stem.lower() == program.stem.lower() and path.is_file()
        }
    except OSError:  # a folder that may not be listed
        return None
    return next((beside[suffix] for suffix in wanted if suffix in beside), None)


def _module_note(program: Path, module: Path | None) -> list[str]:
    """What is not known of a data list that is read alone."""
    if module is not None or program.suffix.lower() != ".dat":
        return []
    return [
        f"{program.name} is read without {program.stem}.src, which is not beside it: a point that "
        "its motions take as a way (LIN_REL), or reckon with, is corrected as a place; give it by "
        "--module"
    ]


def _given_frames(args: argparse.Namespace, dialect: Dialect, program: str) -> dict[str, Array]:
    """Tools and bases that ``--frame`` names, beside them those of the program and ``--frames``.

    Raises `InputError` where two of the latter differ in one that points ask for, and nothing says
    which is meant.
    """
    named = dict(frame_given(dialect.maker, words) for words in args.frame)
    read = dialect.read(program)
    ends = [args.tool, args.base, *(name for p in read.points for name in (p.tool, p.frame))]
    asked = {name.lower() for name in ends if name} - {name.lower() for name in named}
    known = dict(read.frames) if args.frames else {}
    for path in args.frames:
        for name, T in _frames_of(path, dialect_of(args.program.suffix)).items():
            off_m, off_rad = frames.apart(known.setdefault(name, T), T)
            if name.lower() in asked and (off_m > SAME_M or off_rad > SAME_RAD):
                words = f"{name} is another one than in the program, or in the file before"
                raise InputError(f"{words}: say by --frame '{name}=…' which holds", file=str(path))
    return known | named


def _frames_of(path: Path, dialect: Dialect) -> dict[str, Array]:
    """Tools and bases by the names that a file of the controller has for them."""
    read = dialect.read(_program_text(path, dialect)).frames
    found = {name: T for name, T in read.items() if OF_LINE not in name}
    if found.keys() <= dialect.read("").frames.keys():
        raise InputError("holds no tool or base that is read here", file=str(path))
    return found


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
    shown = [state for state in STATES if count[state] or state != "of_another_group"]
    title = ", ".join(f"{count[state]} {state.replace('_', ' ')}" for state in shown)
    head = ("point", "line", "moved mm", "deg", "left mm", "why not")
    if document["module"] is not None:
        print_words(console, f"Read with {document['module']}.")
    print_table(console, f"{document['program']}: {title}", head, rows, words=(0, 5))
    for place in document["computed"]:
        print_words(
            console, f"Line {place['line']} makes a point or a frame itself: {place['text']}"
        )
    print_verdict(console, document)
    print_output(console, document)


# ---- the shift of base and tool frame ------------------------------------------------------------


_SHIFT_EXAMPLE = """examples:
  robocal frame-shift --robot kr150_r3100 --robot-serial 4711 --poses work.csv --maker kuka \\
      --tool 'TOOL_DATA[1]=0,0,300,0,0,0' --base 'BASE_DATA[2]=900,0,400,0,0,0'
  robocal frame-shift --robot kr150_r3100 --robot-serial 4711 --in-force
"""
_TURNED_MM = 1e3 * LEVER_M


def add_frame_shift(parser: argparse.ArgumentParser) -> None:
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.epilog = _SHIFT_EXAMPLE
    add_model_options(parser)
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="CSV",
        help="working poses: q1_deg … (prismatic: q1_mm), and sample and weight where wanted; "
        "with --in-force, where left out, those that the shift was found for",
    )
    parser.add_argument(
        "--maker",
        choices=sorted(COUNT),
        help="of the controller: how it is written; with --in-force, where left out, the six "
        "numbers of both frames are told alone",
    )
    for name, what in (("tool", "tool"), ("base", "base, work object, user frame or feature")):
        parser.add_argument(
            f"--{name}",
            action="append",
            default=[],
            metavar="NAME=X,Y,Z,…",
            help=f"a {what} that the controller has, in the maker's own numbers and units, to be "
            "printed as shifted; several may be given",
        )
    parser.add_argument(
        "--parts",
        choices=("base,tool", *PARTS),
        default="base,tool",
        help="which frames may be shifted, default both",
    )
    parser.add_argument(
        "--lever-mm",
        type=positive,
        default=_TURNED_MM,
        metavar="L",
        help=f"a turn of the tool counts as the way of a point so far off, default {_TURNED_MM:g}",
    )
    parser.add_argument(
        "--limit-mm", type=positive, default=0.1, metavar="S", help="for the share, default 0.1"
    )
    parser.add_argument("--output", type=Path, metavar="FILE", help="text to write, never over one")
    kept = parser.add_mutually_exclusive_group()
    kept.add_argument(
        "--keep",
        action="store_true",
        help="keep the shift in the robot's history: 'robocal history accept' brings it into force",
    )
    kept.add_argument(
        "--in-force",
        action="store_true",
        help="find nothing: print the frames as the shift in force has them, and what it leaves; "
        "needs neither --poses nor --maker",
    )


def run_frame_shift(args: argparse.Namespace) -> CliResult:
    _check_shift(args)
    revision = _thermal_revision(args) if args.keep else 0
    models, warnings = given_models(args)
    nominal = models.nominal
    work, weight = _shifted_work(args, nominal)
    q, T_first = work.q, work.T_flange_tool
    in_force = None
    if args.robot_serial is not None and len(q):
        with model_history(args, nominal) as history:
            in_force = shift_in_force(history, models, q, T_first)
    shift = kept = _as_they_are(models, work) if in_force is None else in_force.shift
    if not args.in_force:
        shift = best_shift(
            models,
            q,
            T_first,
            parts=tuple(args.parts.split(",")),
            weight=weight,
            lever_m=1e-3 * args.lever_mm,
        )
    found: ShiftDocument | None = None
    verdict = Verdict(Code.ACCEPT, "no shift is in force: the frames are as they were")
    was = None if in_force is None else in_force.document(args.limit_mm)
    if len(q):
        found = shift_document(shift, work.names, args.limit_mm)
        verdict = shift_verdict(found, was, args.in_force)
    serves = shift if verdict.accept else kept
    words = None if args.maker is None else _shifted_text(args, serves, T_first)
    if args.output is not None:
        write_bytes(args.output, f"{words}\n".encode())
    document: FrameShiftDocument = {
        "robot": nominal.name,
        "model_hash": nominal.model_hash,
        "maker": args.maker,
        "text": words,
        "T_base_shift": transform_document(shift.T_base_shift),
        "T_tool_shift": transform_document(shift.T_tool_shift),
        "before": None if found is None else found["before"],
        "after": None if found is None else found["after"],
        "poses": [] if found is None else found["poses"],
        "in_force": was,
        "calibration_id": None,
        "output": None if args.output is None else str(args.output),
        "warnings": warnings + factory_note(args.maker, nominal),
        "verdict": verdict_document(verdict),
    }
    if args.keep:
        with model_history(args, nominal) as history:
            document["calibration_id"] = keep_shift(
                history, nominal, shift, q, T_first, document, verdict, revision, time.time_ns()
            )
    return CliResult(document, _show_shift)


def _thermal_revision(args: argparse.Namespace) -> int:
    """In force before its model is read: where another one comes meanwhile, the shift is stale."""
    with model_history(args, describe_robot(args.robot)[0].arm) as history:
        return history.head(THERMAL).revision


def _check_shift(args: argparse.Namespace) -> None:
    """Raises `InputError` for options that do not belong together."""
    if (args.keep or args.in_force) and args.robot_serial is None:
        raise InputError("--keep and --in-force are about a history: give --robot-serial")
    missing = [name for name in ("poses", "maker") if getattr(args, name) is None]
    if missing and not args.in_force:
        raise InputError(f"give --{' and --'.join(missing)}: only --in-force does without")
    if args.maker is None and (args.output is not None or args.tool or args.base):
        raise InputError("--output, --tool and --base are in a controller's words: give --maker")
    if args.output is not None and args.output.exists():
        raise InputError("is there already: name another file", file=str(args.output))


def _shifted_work(args: argparse.Namespace, nominal: SerialArm) -> tuple[ShiftedWork, Array | None]:
    """Working poses and tool, as given or else as in force, and weights (m,)."""
    kept = None
    if args.in_force:
        with model_history(args, nominal) as history:
            kept = shifted_work(history, nominal.T_flange_tool)
    kept = kept or ShiftedWork(np.empty((0, nominal.n)), (), nominal.T_flange_tool)
    q, names, weight = kept.q, kept.names, None
    if args.poses is not None:
        q, names, weight = _working_poses(args.poses, nominal)
    T_first = frame_given(args.maker, args.tool[0])[1] if args.tool else kept.T_flange_tool
    return ShiftedWork(q, names, T_first), weight


def _as_they_are(models: CorrectionModels, work: ShiftedWork) -> FrameShift:
    if len(work.q):
        return given_shift(models, work.q, work.T_flange_tool, np.eye(4), np.eye(4))
    return FrameShift(np.eye(4), np.eye(4), np.empty((0, 6)), np.empty((0, 6)))


def _shifted_text(args: argparse.Namespace, shift: FrameShift, T_first: Array) -> str:
    """The frames that the controller has as shifted; ``T_first`` (4, 4): the tool of the poses."""
    # of FANUC six numbers alone do not tell what they are
    tool, base = ("UTOOL", "UFRAME") if args.maker == "fanuc" else ("", "")
    tools = [frame_given(args.maker, given) for given in args.tool] or [(tool, T_first)]
    bases = [frame_given(args.maker, given) for given in args.base] or [(base, np.eye(4))]
    lines = []
    if "tool" in args.parts:
        # the shift is that of its axes; others move with the flange
        T_flange_shift = T_first @ shift.T_tool_shift @ frames.invert(T_first)
        lines += [tool_text(args.maker, T_flange_shift @ T, name) for name, T in tools]
    if "base" in args.parts:
        lines += [base_text(args.maker, shift.T_base_shift @ T, name) for name, T in bases]
    return "\n".join(lines)


def _working_poses(path: Path, arm: SerialArm) -> tuple[Array, tuple[str, ...], Array | None]:
    """Joints (m, n), names and weights (m,) of a table."""
    units = ["mm" if slides else "deg" for slides in arm.prismatic]
    columns = [f"q{i}_{unit}" for i, unit in enumerate(units, 1)]
    table = read_cells(
        path, lambda header, file: check_plain(header, file, columns, ("sample", "weight"))
    )
    factors = np.where(arm.prismatic, 1e-3, np.pi / 180.0)
    q = np.column_stack([table.numbers(name) for name in columns]) * factors
    weight = table.numbers("weight") if "weight" in table.columns else None
    if weight is not None and (np.any(weight < 0.0) or not np.any(weight > 0.0)):
        raise InputError("weights are 0 or above, and not all 0", file=str(path), column="weight")
    return q, read_samples(table, tuple(map(str, table.rows))), weight


def _show_shift(console: "Console", document: Document) -> None:
    if document["poses"]:
        _show_errors(console, document)
    if document["in_force"]:
        kept = document["in_force"]
        words = f"In force: revision {kept['revision']}, with {kept['rms_mm']:.3f} mm rms"
        print_words(console, words)
    print_verdict(console, document)
    if document["calibration_id"] is not None:
        print_words(console, f"Kept as calibration {document['calibration_id']}")
    if document["text"] is None:
        head = ("frame", "x mm", "y mm", "z mm", "rx deg", "ry deg", "rz deg")
        rows = [_six_numbers(part, document[f"T_{part}_shift"]) for part in PARTS]
        print_table(console, "The shift, its turn as a rotation vector", head, rows)
    else:
        if not document["verdict"]["accept"]:
            print_words(console, "The frames stay as they are:")
        console.out(document["text"], highlight=False)
    print_output(console, document)


def _six_numbers(part: str, shift: Document) -> list[str]:
    T = frames.transform_from_quat(shift["xyz_mm"], shift["quat_xyzw"])
    turn = np.degrees(frames.log_rotation(T[:3, :3]))
    return [part, *(f"{x:.4f}" for x in shift["xyz_mm"]), *(f"{x:.5f}" for x in turn)]


def _show_errors(console: "Console", document: Document) -> None:
    rows = []
    for pose in document["poses"]:
        sizes = [pose[when][unit] for unit in ("mm", "deg") for when in ("before", "after")]
        rows.append([pose["name"], *(f"{size:.4f}" for size in sizes)])
    head = ("pose", "before mm", "after mm", "before deg", "after deg")
    print_table(console, f"{document['robot']}: error of the tool at the working poses", head, rows)
    shares = (document[when]["share_within_limit"] for when in ("before", "after"))
    before, after = (f"{100.0 * share:.1f} %" for share in shares)
    print_words(console, f"Coordinates of the error within the limit: {before}, then {after}")
