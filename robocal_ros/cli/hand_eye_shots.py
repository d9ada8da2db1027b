"""Options and files of a line laser that the actions of ``robocal hand-eye`` share."""

import argparse
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.cli.arguments import ROBOT_HELP, input_topic, positive
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    from robocal_ros.hand_eye.quality import HandEyeSettings
    from robocal_ros.hand_eye.tables import PoseTable
    from robocal_ros.hand_eye.target_files import Target
    from robocal_ros.hand_eye.tasks import HandEyeData, Task
    from robocal_ros.kinematics import SerialArm

KINDS = ("sphere", "step", "line")
FEATURES = ("edge", "groove")
LIMIT_MM = 1.0


def add_shots(parser: argparse.ArgumentParser) -> None:
    """Offer the tables of a calibration, or a bag."""
    parser.add_argument(
        "--poses",
        type=Path,
        metavar="CSV",
        help="flange poses in base, or joints with --robot; column profile names each shot's file",
    )
    parser.add_argument(
        "--profiles",
        type=Path,
        metavar="DIR",
        help="folder of the profiles, tables of x_mm and z_mm",
    )
    parser.add_argument(
        "--bag",
        type=Path,
        help="instead of the tables: a recording of joint_states and profile, or a data file of "
        "hand_eye_node; with --robot",
    )
    parser.add_argument(
        "--topic",
        type=input_topic,
        action="append",
        default=[],
        metavar="INPUT:=TOPIC",
        help="topic of an input in the bag: joint_states, profile, session_events",
    )
    add_robot(parser, "bags and tables of joints")


def add_robot(parser: argparse.ArgumentParser, needed: str = "tables of joints") -> None:
    """Offer the robot, ``needed`` for these."""
    parser.add_argument("--robot", metavar="NAME", help=f"{ROBOT_HELP}; for {needed}")


def add_target(parser: argparse.ArgumentParser) -> None:
    """Offer what is known of a target of any kind."""
    add_target_file(parser)
    add_radius(parser)


def add_target_file(parser: argparse.ArgumentParser, help: str = "what is known of it") -> None:
    """Offer a target file."""
    parser.add_argument("--target", type=Path, metavar="YAML", help=help)


def add_radius(parser: argparse.ArgumentParser) -> None:
    """Offer a sphere's radius."""
    parser.add_argument("--radius-mm", type=positive, metavar="R", help="of a sphere, true")


def add_target_kind(parser: argparse.ArgumentParser) -> None:
    """Ask for the kind of target."""
    parser.add_argument("--target-kind", required=True, choices=KINDS, help="what the shots show")


def add_feature(parser: argparse.ArgumentParser) -> None:
    """Offer what a line is."""
    parser.add_argument(
        "--line-kind",
        choices=FEATURES,
        default=FEATURES[0],
        help="the line: nearer to the sensor than the surfaces beside it (edge, the default), or "
        "farther (groove)",
    )


def add_limits(parser: argparse.ArgumentParser, sigma_default: str) -> None:
    """Offer the robot's scatter, and what is good enough."""
    add_robot_sigma(parser, sigma_default)
    add_limit(parser, "in the field of view", LIMIT_MM)


def add_robot_sigma(parser: argparse.ArgumentParser, default: str) -> None:
    """Offer the robot's scatter."""
    for unit, of in (("mm", "position"), ("deg", "orientation")):
        parser.add_argument(
            f"--robot-sigma-{unit}",
            type=positive,
            metavar="S",
            help=f"noise of a reported pose's {of} in each axis; {default}",
        )


def add_limit(parser: argparse.ArgumentParser, where: str, default_mm: float) -> None:
    """Offer what is good enough."""
    parser.add_argument(
        "--limit-mm",
        type=positive,
        default=default_mm,
        metavar="L",
        help=f"largest expected error (rms) {where} that is accepted; default {default_mm:g}",
    )


def robot_sigma_of(args: argparse.Namespace) -> tuple[float | None, float | None]:
    """The robot's scatter, m and rad, where it is given."""
    from math import radians

    place_mm, turn_deg = args.robot_sigma_mm, args.robot_sigma_deg
    return (
        None if place_mm is None else place_mm * 1e-3,
        None if turn_deg is None else radians(turn_deg),
    )


def settings_of(args: argparse.Namespace) -> "HandEyeSettings":
    """What is known of the robot, and what is good enough.

    Raises
    ------
    InputError
        For an orientation's noise alone.
    """
    from robocal_ros.hand_eye.quality import HandEyeSettings

    if args.robot_sigma_mm is None and args.robot_sigma_deg is not None:
        raise InputError("--robot-sigma-deg goes with --robot-sigma-mm: give both, or the latter")
    return HandEyeSettings(*robot_sigma_of(args), limit_m=args.limit_mm * 1e-3)


def arm_of(args: argparse.Namespace) -> "SerialArm | None":
    """The robot that is named, if any. Raises as `load_robot`."""
    from robocal_ros.kinematics.robots import load_robot

    return None if args.robot is None else load_robot(args.robot)


@dataclass(frozen=True, eq=False)
class ReadShots:
    """Shots, the table that holds them (None: a bag), and its profiles that are none, with why."""

    data: "HandEyeData"
    table: "PoseTable | None" = None
    rejected: Mapping[str, str] = field(default_factory=dict)


def given_shots(
    args: argparse.Namespace, arm: "SerialArm | None", judges: Path | None = None
) -> ReadShots:
    """Read the shots that are given, or those like them in the file of ``judges``.

    Raises
    ------
    RobocalError
        When too little or too much is given; further as `read_shots` and `read_bag_shots`.
    """
    if args.bag is None:
        if args.poses is None or args.profiles is None:
            raise InputError("give the shots: --poses with --profiles, or --bag")
        return read_shots(judges or args.poses, args.profiles, arm)
    from robocal_ros.cli.hand_eye_bag import read_bag_shots

    if args.poses is not None or args.profiles is not None:
        raise InputError("the shots are given twice: --bag, and --poses or --profiles; keep one")
    if arm is None:
        raise InputError("a bag holds joints, not poses: name its robot with --robot")
    data, rejected = read_bag_shots(judges or args.bag, arm, dict(args.topic))
    return ReadShots(data, None, rejected)


def read_shots(poses: Path, profiles: Path, arm: "SerialArm | None") -> ReadShots:
    """Read a table and its profiles. Raises as `read_pose_table` and `read_profiles`."""
    from robocal_ros.hand_eye.tables import read_pose_table, read_profiles
    from robocal_ros.hand_eye.tasks import HandEyeData

    table = read_pose_table(poses, arm)
    seen = read_profiles(profiles, table)
    return ReadShots(HandEyeData(table.names, table.T_base_flange, seen, table.mark), table)


def require_unused(judges: "PoseTable", used: "PoseTable") -> None:
    """Refuse judges that helped to solve.

    Raises
    ------
    InputError
        Naming the row.
    """
    for index, file in enumerate(judges.files):
        if file in used.files:
            judges.fail(index, f"{quoted(file)} is in --poses too: other shots must judge")


def given_target(kind: str, target: Path | None, radius_mm: float | None) -> "Target | None":
    """What is known of a target: from its file, or a sphere's radius; None for an unknown line.

    Raises
    ------
    InputError
        When too little or too much is given, or the file is of another kind; further as
        `read_target`.
    """
    from robocal_ros.hand_eye.targets import SphereTarget

    if radius_mm is not None:
        if kind != "sphere":
            raise InputError(f"--radius-mm is a sphere's: a {kind} has none")
        if target is not None:
            raise InputError("the sphere is given twice: --radius-mm and --target; keep one")
        return SphereTarget(radius_mm * 1e-3)
    if target is not None:
        return read_target_of(kind, target)
    if kind == "line":
        return None
    missing = {"sphere": "give the sphere: --radius-mm or --target", "step": "give --target"}
    raise InputError(missing[kind])


def read_target_of(kind: str, path: Path) -> "Target":
    """Read a target file of this kind. Raises as `given_target`."""
    from robocal_ros.hand_eye.target_files import read_target
    from robocal_ros.hand_eye.targets import KIND_OF, BoardTarget

    target = read_target(path)
    found = KIND_OF[type(target)]
    if isinstance(target, BoardTarget) or found != kind:
        raise InputError(f"describes a {found}, not a {kind}", file=str(path))
    return target


def task_of(target: "Target | None", feature: str | None, classic: bool = False) -> "Task":
    """The estimator's view of a target, of a line by its ``feature``.

    ``classic``: corners and edges in the published form.
    """
    from robocal_ros.estimation.edge import EdgeRule
    from robocal_ros.estimation.polyline import CornerRule
    from robocal_ros.hand_eye.targets import SphereTarget, StepTarget
    from robocal_ros.hand_eye.tasks import LineTask, SphereTask, StepTask

    if isinstance(target, SphereTarget):
        return SphereTask(target)
    if isinstance(target, StepTarget):
        return StepTask(target, CornerRule(classic=classic))
    rule = EdgeRule(kind="groove" if feature == "groove" else "edge", classic=classic)
    return LineTask(target, rule)
