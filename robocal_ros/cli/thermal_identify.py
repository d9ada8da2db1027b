"""``robocal thermal identify``: a thermal drift from tables of cold and warm visits."""

import argparse
from functools import partial
from pathlib import Path

from robocal_ros.cli.arguments import ROBOT_HELP, add_sigma, describe_robot, text, warn
from robocal_ros.cli.identify_view import show_identification
from robocal_ros.cli.output import CliResult
from robocal_ros.ground.errors import InputError

NAME = "identify"
HELP = "identify a thermal drift, or the geometry of a measuring robot, and judge it"

FIXED, FLANGE = "fixed-sensor", "flange-sensor"
_FIXED_ONLY = ("sensor", "cold", "warm", "prior", "parameters")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--arrangement",
        choices=(FIXED, FLANGE),
        default=FIXED,
        help="where the sensor is: fixed with the sphere on the flange (default), or on the flange "
        "with spheres fixed in the cell",
    )
    parser.add_argument("--check", type=Path, metavar="CSV", help="measurements to judge on")
    fixed = parser.add_argument_group(FIXED)
    fixed.add_argument("--sensor", type=Path, metavar="S.yaml", help="from calibrate-sensor")
    fixed.add_argument("--cold", type=Path, metavar="CSV", help="visits of the cold robot")
    fixed.add_argument("--warm", type=Path, metavar="CSV", help="visits of the warm robot")
    fixed.add_argument("--prior", type=Path, metavar="P.yaml", help="from learn-prior, for map")
    fixed.add_argument(
        "--method",
        choices=("map", "subset"),
        default="map",
        help="map (default): all parameters with a prior; subset: some by least squares",
    )
    fixed.add_argument(
        "--parameters", type=text, metavar="NAMES", help="for subset: d4_mm,a1_mm,beta2_deg …"
    )
    add_sigma(fixed, ", sensor and repeatability, where the tables have no sigma_mm")
    flange = parser.add_argument_group(FLANGE)
    flange.add_argument(
        "--data",
        type=Path,
        action="append",
        metavar="CSV",
        help="a session: joints and sphere centres in the sensor; repeat for several",
    )


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    _require_sense(args)
    from robocal_ros.cli.thermal_identification import (
        FixedRequest,
        identify_fixed_files,
        identify_flange_files,
    )

    warnings: list[str] = []
    arm = describe_robot(args.robot, warnings).arm
    if args.arrangement == FLANGE:
        document = identify_flange_files(arm, args.data, args.check)
    else:
        chosen = tuple(name.strip() for name in (args.parameters or "").split(",") if name.strip())
        request = FixedRequest(
            sensor_file=args.sensor,
            cold_file=args.cold,
            warm_file=args.warm,
            check_file=args.check,
            prior_file=args.prior,
            parameters=chosen,
            sigma_m=args.sigma_mm * 1e-3,
        )
        document = identify_fixed_files(arm, request)
    document |= {"arrangement": args.arrangement, "warnings": warnings}
    warn(warnings)
    return CliResult(document, partial(show_identification, document=document))


def _require_sense(args: argparse.Namespace) -> None:
    """Refuse options that are missing or belong to the other arrangement."""
    if args.arrangement == FLANGE:
        wrong = [name for name in _FIXED_ONLY if getattr(args, name) is not None]
        if wrong:
            raise InputError(f"--{wrong[0]} is for --arrangement {FIXED}: leave it out")
        if not args.data:
            raise InputError(f"--arrangement {FLANGE} needs --data: a session's table")
        return
    if args.data:
        raise InputError(f"--data is for --arrangement {FLANGE}; give --sensor, --cold and --warm")
    missing = [name for name in ("sensor", "cold", "warm") if getattr(args, name) is None]
    if missing:
        raise InputError(f"--{missing[0]} is missing: {FIXED} needs --sensor, --cold and --warm")
    if (args.method == "subset") != (args.parameters is not None):
        raise InputError("--method subset and --parameters NAMES belong together")
    if args.method == "subset" and args.prior is not None:
        raise InputError("--prior is for --method map: a subset is solved without one")
