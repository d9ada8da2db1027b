"""``robocal identify``: a robot's model from measurements, judged on measurements not used."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros import __version__
from robocal_ros.cli.arguments import PARTS, ROBOT_HELP, describe_robot, parts, seed, share, warn
from robocal_ros.cli.identify_view import headline, show_identification
from robocal_ros.cli.output import DONE, NO_ANSWER, CliResult, refusal, tell
from robocal_ros.ground.errors import Code, InputError

if TYPE_CHECKING:
    from robocal_ros.cli.identification import IdentifyAnswer, IdentifyRequest
    from robocal_ros.kinematics.robots import RobotDescription

NAME = "identify"
HELP = "identify a robot's model from a table of measurements, and judge it on unseen ones"

_HOLD_OUT = 0.5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--data", required=True, type=Path, metavar="CSV", help="measurements to solve from"
    )
    _add_judging(parser)
    parser.add_argument(
        "--check-refit",
        type=parts,
        default=(),
        metavar="PARTS",
        help="base,tool: place them anew from the check data, which come from another set-up",
    )
    parser.add_argument(
        "--fit",
        type=parts,
        default=PARTS,
        metavar="PARTS",
        help="what to solve for, default base,tool,geometry; the rest is as in the robot file",
    )
    parser.add_argument(
        "--method",
        choices=("map", "lsq"),
        default="map",
        help="map (default): with building tolerances as prior; lsq: by the data alone",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="write the identified robot file, only if the verdict accepts it",
    )


def _add_judging(parser: argparse.ArgumentParser) -> None:
    judging = parser.add_mutually_exclusive_group()
    judging.add_argument(
        "--check",
        type=Path,
        metavar="CSV",
        help="measurements to judge on, none of them in --data",
    )
    judging.add_argument(
        "--hold-out",
        type=share,
        metavar="SHARE",
        help=f"without --check: share of the poses of --data to judge on, default {_HOLD_OUT}",
    )
    parser.add_argument(
        "--seed", type=seed, metavar="N", help="which poses are held out, default 0"
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    _require_sense(args)
    from robocal_ros.cli.identification import identify_files

    warnings: list[str] = []
    robot = describe_robot(args.robot, warnings)
    answer = identify_files(robot.arm, _request(args))
    warnings += answer.warnings
    document = answer.document | {"output": None}
    if args.output is not None:
        _save(robot, answer, args.output, document, warnings)
    document["warnings"] = warnings
    warn(warnings)
    status = DONE
    if answer.judged.verdict.code is Code.TOO_FEW_SAMPLES:
        document |= refusal(Code.TOO_FEW_SAMPLES, answer.judged.verdict.reason)
        tell(Code.TOO_FEW_SAMPLES.name, answer.judged.verdict.reason)
        status = NO_ANSWER
    return CliResult(document, partial(show_identification, document=document), status)


def _require_sense(args: argparse.Namespace) -> None:
    """Refuse options that contradict each other before any file is read."""
    if args.check is None and args.check_refit:
        raise InputError("--check-refit is about the check data: give them with --check")
    if args.check is not None and args.seed is not None:
        raise InputError("--seed chooses what is held out: leave it out beside --check")
    if "geometry" in args.check_refit:
        raise InputError("--check-refit: the geometry is what is checked; only base and tool")
    if args.output is not None and not args.output.parent.is_dir():
        raise InputError("no such folder for --output", file=str(args.output.parent))


def _request(args: argparse.Namespace) -> "IdentifyRequest":
    from robocal_ros.cli.identification import IdentifyRequest

    return IdentifyRequest(
        data_file=args.data,
        check_file=args.check,
        check_refit=args.check_refit,
        hold_out=_HOLD_OUT if args.hold_out is None else args.hold_out,
        seed=args.seed or 0,
        fit=args.fit,
        method=args.method,
    )


def _save(
    robot: "RobotDescription",
    answer: "IdentifyAnswer",
    path: Path,
    document: dict[str, Any],
    warnings: list[str],
) -> None:
    """Write the identified robot file, if the verdict accepts: a script may use it at once."""
    from robocal_ros.kinematics.robots import save_robot

    verdict = answer.judged.verdict
    if not verdict.accept:
        warnings.append(f"{path} is not written: the verdict is {verdict.code.name}")
        return
    arm = robot.arm.with_mdh(answer.judged.identification.cell.arm.mdh)
    used = document["data"]
    comment = (
        f"Identified by robocal {__version__} from {used['file']}, {used['train']} measurements, "
        f"method {document['method']};\nnominal model {robot.arm.model_hash} of {robot.path}.\n"
        f"{headline(document)}."
    )
    save_robot(arm, path, like=robot, comment=comment)
    document["output"] = str(path)
