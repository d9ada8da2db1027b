# SPDX-License-Identifier: Apache-2.0
"""``robocal identify`` and ``iso9283``: what measurements say of a robot."""

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from robocal_ros import __version__
from robocal_ros.cli.main import (
    DONE,
    FOUND_MASSES,
    NO_ANSWER,
    PARTS,
    ROBOT_HELP,
    CliResult,
    Document,
    add_state,
    count,
    describe_robot,
    parts,
    print_output,
    print_table,
    print_words,
    refusal,
    seed,
    share,
    text,
)
from robocal_ros.estimation.assessment import pose_groups
from robocal_ros.ground.errors import Code, InputError, TooFewSamplesError
from robocal_ros.ground.files import nearest, quoted
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import JudgedIdentification, identify_and_judge
from robocal_ros.identification.full_model import FullIdentification, without_masses
from robocal_ros.identification.judged import (
    CYCLES,
    another_set_up,
    contradicted,
    explain_mismatch,
    held_out,
    identification_document,
    read_positions,
    repeated,
    require_match,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of, random_postures
from robocal_ros.kinematics.robots import save_robot
from robocal_ros.kinematics.tables import (
    beyond_limits,
    joint_texts,
    read_joints,
    read_measurements,
    write_cells,
)

if TYPE_CHECKING:
    from rich.console import Console

    from robocal_ros.identification.documents import (
        Iso9283Document,
        PlannedPoseDocument,
        PoseAccuracyDocument,
        PosePlanDocument,
    )


MOVED_SIGMA = 2.0
MOST_LISTED = 12
_FIGURES = ("mean", "rms", "p95", "max")


def headline(document: Document) -> str:
    """The verdict in one plain line."""
    verdict = document["verdict"]
    after, before = document["calibrated"]["held_out"], document["in_force"]["held_out"]
    line = (
        f"{verdict['code']}: held-out mean {after['mean_mm']:.3f} mm instead of "
        f"{before['mean_mm']:.3f} mm (largest {after['max_mm']:.3f} instead of "
        f"{before['max_mm']:.3f}) at {after['n']} measurements not used to solve"
    )
    return line if verdict["accept"] else f"{line}. Keep the present model."


def show_identification(console: "Console", document: Document) -> None:
    verdict = document["verdict"]
    print_words(console, headline(document), "bold green" if verdict["accept"] else "bold red")
    if not verdict["accept"]:
        print_words(console, f"Why: {verdict['reason']}")
    console.print()
    _show_errors(console, document)
    predicted = document["calibrated"]["predicted"]
    functions = any(row["function"] for row in document.get("joints", ()))
    of = " of its geometry alone" if functions else ""
    bound = ""
    if "bound_sigmas" in document:  # not of a drift
        bound = f" 95 % of errors stay within {document['bound_sigmas']:.2f} of their sigmas."
    console.print(
        f"Uncertainty of the model itself: {predicted['model_rms_mm']:.3f} mm rms at these poses, "
        f"{predicted['workspace_rms_mm']:.3f} mm{of} throughout the joint limits. "
        f"Noise: {document['noise_mm']:.3f} mm per coordinate.{bound}",
        soft_wrap=True,
    )
    console.print()
    if "joints" in document:  # of a drift there are none
        _show_joints(console, document)
    _show_parameters(console, document)
    _show_doubts(console, document)
    if number := document.get("calibration_id"):
        accept = verdict["accept"]
        then = "refused"
        if accept:
            then = f"'robocal history accept {number}', for the same serial, brings it into force"
        print_words(console, f"Kept as calibration {number} of the history: {then}.")
    print_output(console, document)


_JOINT_HEADS = (
    "joint", "measured from", "to", "not covered", "own function, rms", "its sigma", "compliance",
)  # fmt: skip


def _show_errors(console: "Console", document: Document) -> None:
    models = {"nominal model": document["nominal"]}
    if document["in_force"] != document["nominal"]:
        models["model in force"] = document["in_force"]
    models["identified model"] = document["calibrated"]
    rows = [
        [name, *(f"{judged['held_out'][f'{figure}_mm']:.3f}" for figure in _FIGURES)]
        for name, judged in models.items()
    ]
    predicted = document["calibrated"]["predicted"]["total_rms_mm"]
    rows.append(["  predicted by its covariance", "", f"{predicted:.3f}", "", ""])
    if document["held_out_rejected"] and "held_out_robust" in document["calibrated"]:
        errors = document["calibrated"]["held_out_robust"]
        left = f"  without the {len(document['held_out_rejected'])} that no model fits"
        rows.append([left, *(f"{errors[f'{figure}_mm']:.3f}" for figure in _FIGURES)])
    print_table(console, "Errors at held-out measurements, mm", ("", *_FIGURES), rows)


def _show_joints(console: "Console", document: Document) -> None:
    rows = []
    for row in document["joints"]:
        unit = "deg" if "measured_deg" in row else "mm"
        micro = "urad" if unit == "deg" else "um"
        function, bends = row["function"], row["compliance"]
        shown = ["none", ""]
        if function:
            shown = [f"{function[f'{name}_{micro}']:.0f} {micro}" for name in ("rms", "sigma")]
        load = f"{bends * 1e6:.2f} {micro}/{'N m' if unit == 'deg' else 'N'}" if bends else "none"
        lower, upper = row[f"measured_{unit}"]
        away = f"{row['check_outside']:.1%}" if row["check_outside"] else ""
        rows.append([row["name"], f"{lower:.0f}", f"{upper:.0f} {unit}", away, *shown, load])
    print_table(console, "Joints", _JOINT_HEADS, rows)
    gaps = [
        f"{row['name']} {', '.join(f'{a:.0f} to {b:.0f}' for a, b in row[key])} {key[5:]}"
        for row in document["joints"]
        for key in ("gaps_deg", "gaps_mm")
        if row.get(key)
    ]
    if document["masses"] == "found":
        print_words(console, FOUND_MASSES)
    if gaps:
        print_words(console, f"In between not measured: {'; '.join(gaps)}.")
    if part := document["coverage"]["not_covered"]:
        there = ", and its function is zero there" if document["model"] == "full" else ""
        after, before = (part[name]["mean_mm"] for name in ("calibrated", "in_force"))
        console.print(
            f"Not covered, {part['code']}: {document['check_outside']:.1%} of the check poses have "
            f"a joint where it was not measured{there}; mean {after:.3f} mm there instead of "
            f"{before:.3f} mm.",
            soft_wrap=True,
        )
    console.print()


def _show_parameters(console: "Console", document: Document) -> None:
    parameters = document["parameters"]
    solved = {name: row for name, row in parameters.items() if row["sigma"] is not None}
    if not solved:
        console.print("No model parameter was solved for.")
        return
    rows = []
    for name, row in solved.items():
        change = row["value"] - row["nominal"]
        if abs(change) > MOVED_SIGMA * row["sigma"]:
            shown = (f"{row['nominal']:.4f}", f"{row['value']:.4f}", f"{change:+.4f}")
            rows.append([name, *shown, f"{row['sigma']:.4f}"])
    if rows:
        title = f"Parameters that moved by more than {MOVED_SIGMA:g} sigma"
        head = ("parameter", "nominal", "identified", "change", "sigma")
        print_table(console, title, head, rows)
    console.print(f"{len(rows)} of {len(solved)} parameters moved.")


def _show_doubts(console: "Console", document: Document) -> None:
    condition = document["condition"]
    scale = "" if condition is None else f", condition {condition:.3g}"
    console.print(
        f"The data determine {document['rank']} of {document['unknowns']} unknowns{scale}."
    )
    if document["unobservable"]:
        owner = "held as they were" if document["held"] else "left to the prior"
        console.print(f"Not seen in the data, {owner}:")
        for words in document["unobservable"]:
            print_words(console, f"  {words}")
    for key, words in (
        ("rejected", f"Rejected, {len(document['rejected'])} of {document['samples']} samples"),
        ("held_out_rejected", "In the figures, but not in the verdict, no model fits them"),
    ):
        if samples := document[key]:
            more = " …" if len(samples) > MOST_LISTED else ""
            print_words(console, f"{words}: {', '.join(samples[:MOST_LISTED])}{more}")


_HOLD_OUT = 0.5


def add_identify(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", required=True, metavar="R.yaml", help=ROBOT_HELP)
    parser.add_argument(
        "--data",
        type=Path,
        metavar="CSV",
        help="measurements to solve from; for --plan poses that the robot may be driven to, "
        "default: random ones within its joint limits",
    )
    parser.add_argument(
        "--plan",
        type=count,
        metavar="N",
        help="measure nothing: say which N poses to measure, for --output",
    )
    _add_judging(parser)
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
        "--model",
        choices=("full", "geometric"),
        default="full",
        help="full (default): geometry, a function of each joint's own angle, and compliances, "
        "each only if the data want it; geometric: geometry alone",
    )
    parser.add_argument(
        "--figures",
        type=Path,
        metavar="DIR",
        help="write errors.svg there, the error over the workspace before and after, and "
        "joints.svg, each joint's function with its band",
    )
    parser.add_argument(
        "--output",
        type=Path,
        metavar="FILE",
        help="write the identified robot file, only if the verdict accepts it; of --plan the poses",
    )
    _add_keeping(parser)


def _add_keeping(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--keep",
        action="store_true",
        help="keep the model in the robot's history: 'robocal history accept' brings it into "
        "force, for thermal_node and joint_correction_node",
    )
    parser.add_argument(
        "--robot-serial",
        type=text,
        metavar="S",
        help="serial of the robot as its nodes name it, for --keep",
    )
    add_state(parser)


def _add_judging(parser: argparse.ArgumentParser) -> None:
    judging = parser.add_mutually_exclusive_group()
    judging.add_argument(
        "--check", type=Path, metavar="CSV", help="measurements to judge on, none of them in --data"
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
    parser.add_argument(
        "--check-refit",
        type=parts,
        default=(),
        metavar="PARTS",
        help="base,tool: place them anew from the check data, which come from another set-up",
    )


def run_identify(args: argparse.Namespace) -> CliResult:
    _require_sense(args)
    if args.plan is not None:
        return _planned(args)

    robot, warnings = describe_robot(args.robot)
    in_force = None
    if args.keep:
        from robocal_ros.cli.programs import model_history
        from robocal_ros.thermal.proposing import head_without_reference, keep_identified

        with model_history(args, robot.arm, create=True) as history:
            head = head_without_reference(history)
        in_force = None if head.model is None else arm_of(head.model, robot.arm)
    judged, data, document = _identified(robot.arm, args, warnings, in_force)
    sought = args.model == "full" and "geometry" in args.fit
    if sought and (words := without_masses(robot.arm, judged.identification)):
        warnings.append(f"{robot.path}: {words}")
    verdict = judged.verdict
    document["output"] = None
    if args.output is not None and verdict.accept:  # a script may use it at once
        used = document["data"]
        comment = (
            f"Identified by robocal {__version__} from {used['file']}, {used['train']} "
            f"measurements, method {document['method']};\n"
            f"nominal model {robot.arm.model_hash} of {robot.path}.\n{headline(document)}."
        )
        found = judged.identification.cell.arm
        arm = robot.arm.with_model(found.mdh, found.functions, found.load)
        save_robot(arm, args.output, like=robot, comment=comment)
        document["output"] = str(args.output)
    elif args.output is not None:
        warnings.append(f"{args.output} is not written: the verdict is {verdict.code.name}")
    if words := contradicted(judged.identification):
        warnings.append(f"{args.data}: {words}")
    document |= {"figures": None, "calibration_id": None, "warnings": warnings}
    if isinstance(judged.identification, FullIdentification):
        known = judged.identification.known
        for joint, row in enumerate(document["joints"]):
            unit, factor = ("deg", np.degrees(1.0)) if "measured_deg" in row else ("mm", 1e3)
            row[f"gaps_{unit}"] = (known.gaps(joint) * factor).tolist()
    if args.figures is not None:
        before = "nominal model" if in_force is None else "model in force"
        document["figures"] = _drawn(args.figures, judged, before)
    if args.keep:
        with model_history(args, robot.arm) as history:
            document["calibration_id"] = keep_identified(
                history, judged, data, args.method, head.revision, time.time_ns()
            )
    status = DONE
    if verdict.code is Code.TOO_FEW_SAMPLES:
        document |= refusal(verdict.code, verdict.reason)
        status = NO_ANSWER
    return CliResult(document, show_identification, status)


def _drawn(folder: Path, judged: JudgedIdentification, before: str) -> str:
    """Draw errors over the workspace, and the joints' functions where there are any: their file."""
    from robocal_ros.report.measured_figures import keep_figure, model_figures

    result, path = judged.identification, ""
    errors = {before: judged.errors["in_force"], "identified model": judged.errors["calibrated"]}
    known = result.known if isinstance(result, FullIdentification) else None
    figures = model_figures(result.nominal.fk(judged.q)[:, :3, 3], errors, known)
    for name, figure in figures.items():
        path = keep_figure(folder, name, figure)
    return path


def _require_sense(args: argparse.Namespace) -> None:
    """Refuse options that contradict each other before any file is read."""
    if args.data is None and args.plan is None:
        raise InputError("--data is missing: the measurements to solve from (or --plan N)")
    judging = (args.check, args.hold_out, args.seed, args.figures, args.check_refit or None)
    if args.plan is not None and any(option is not None for option in judging):
        raise InputError("--plan comes before measuring: there is nothing to judge or to draw yet")
    if args.plan is not None and (args.fit, args.method, args.model) != (PARTS, "map", "full"):
        raise InputError("--plan is for the full model: --fit, --method and --model say nothing")
    if args.check is None and args.check_refit:
        raise InputError("--check-refit is about the check data: give them with --check")
    if args.check is not None and args.seed is not None:
        raise InputError("--seed chooses what is held out: leave it out beside --check")
    if "geometry" in args.check_refit:
        raise InputError("--check-refit: the geometry is what is checked; only base and tool")
    if args.keep and (args.plan is not None or args.robot_serial is None):
        raise InputError("--keep puts an identified model into a history: give --robot-serial")
    if not args.keep and (args.robot_serial, args.state) != (None, None):
        raise InputError("--robot-serial and --state name a history, for --keep")
    if args.output is not None and not args.output.parent.is_dir():
        raise InputError("no such folder for --output", file=str(args.output.parent))


CANDIDATES, MOST_WORKING = 1500, 400


def _planned(args: argparse.Namespace) -> CliResult:
    from robocal_ros.identification.planning import plan_poses

    robot, warnings = describe_robot(args.robot)
    arm = robot.arm
    if args.data is None:
        candidates = random_postures(arm, CANDIDATES)
        warnings.append("collisions are not known here: look at the poses before you drive them")
    else:
        candidates = read_joints(args.data, arm)
        beyond = np.any((candidates < arm.lower) | (candidates > arm.upper), axis=1)
        if np.any(beyond):
            words = f"{args.data}: {np.sum(beyond)} poses are beyond the joint limits, left out"
            warnings.append(words)
            candidates = candidates[~beyond]
    working = np.random.default_rng(0).permutation(len(candidates))[:MOST_WORKING]
    plan = plan_poses(arm, candidates, candidates[working], args.plan)
    columns = joint_texts(plan.q, arm)
    names = [f"p{i}" for i in range(1, len(plan.q) + 1)]
    if args.output is not None:
        write_cells(args.output, {"sample": names} | columns)
    poses: list[PlannedPoseDocument] = [
        {"pose": name, "joints": [float(cell) for cell in cells]}
        for name, *cells in zip(names, *columns.values(), strict=True)
    ]
    document: PosePlanDocument = {
        "robot": arm.name,
        "model_hash": arm.model_hash,
        "columns": list(columns),
        "plan": poses,
        "predicted_mm": (plan.predicted_rms_m * 1e3).tolist(),
        "random_mm": plan.random_rms_m * 1e3,
        "candidates": len(candidates),
        "output": None if args.output is None else str(args.output),
        "warnings": warnings,
    }
    return CliResult(document, _show_plan)


def _show_plan(console: "Console", document: Document) -> None:
    predicted, poses = document["predicted_mm"], document["plan"]
    print_words(
        console,
        f"Error of the full model to expect after these {len(poses)} poses: {predicted[-1]:.3f} mm "
        f"rms; after as many random ones {document['random_mm']:.3f} mm. The first k poses are the "
        "plan of k.",
    )
    rows = [
        [pose["pose"], *(f"{value:.2f}" for value in pose["joints"]), f"{error:.3f}"]
        for pose, error in zip(poses, predicted, strict=True)
    ]
    heads = ("pose", *document["columns"], "error then, mm")
    print_table(console, "Poses, the one that tells most first", heads, rows)
    print_output(console, document)


def _moved(judged: JudgedIdentification, check: Measurements) -> list[str]:
    """Say that the check data may come from another set-up, where they look like it."""
    moved = another_set_up(judged, check)
    if not moved and judged.verdict.code is not Code.RESIDUAL_TOO_LARGE:
        return []
    words = (
        "if the check data come from another set-up (measuring device or targets moved), say so "
        "with --check-refit base,tool"
    )
    return ["; ".join(filter(None, (moved, words)))]


def _identified(
    arm: SerialArm, args: argparse.Namespace, warnings: list[str], in_force: SerialArm | None
) -> tuple[JudgedIdentification, Measurements, Document]:
    """Identify from tables and judge, else by a share of the poses that is held out.

    Beside the judgement and its document, the measurements that were used to solve.
    """

    def read(path: Path) -> Measurements:
        data = read_measurements(path, arm)
        warnings.extend(f"{path}: {words}" for words in beyond_limits(data, arm))
        return data

    data, file = read(args.data), None if args.check is None else str(args.check)
    part, draw = (args.hold_out or _HOLD_OUT, args.seed or 0) if file is None else (None, None)
    if part is not None:
        train, check = held_out(data, part, draw or 0, str(args.data))
    else:
        train, check = data, read(args.check)
        warnings += _compared(train, check, args)
    base, tool = "base" in args.fit, "tool" in args.fit
    require_match(arm, data, base=base, tool=tool, hold=True, file=str(args.data))
    refit = args.check_refit
    try:
        judged = identify_and_judge(
            arm,
            train,
            check,
            fit=args.fit,
            method=args.method,
            model=args.model,
            check_refit=refit,
            in_force=in_force,
        )
    except TooFewSamplesError as error:
        if file is not None:
            raise
        raise TooFewSamplesError(
            f"{args.data}: {error} ({len(check)} of its {len(data)} measurements are held "
            "out to judge)"
        ) from error
    if file is not None:
        # The mistake in check data that miss the identified model, as for training data.
        cell = judged.identification.cell
        if frozenset(refit) >= {"base", "tool"}:
            require_match(cell.arm, check, base=True, tool=True, hold=True, file=file)
        elif not refit and (mistake := explain_mismatch(cell.arm, check, cell.residual)):
            raise InputError(mistake, file=file)
        else:
            warnings += _moved(judged, check)
    document: Document = {**identification_document(judged)}
    document["data"] = {
        "file": str(args.data),
        "check_file": file,
        "fit": list(args.fit),
        "check_refit": list(refit),
        "model": args.model,
        "hold_out": part,
        "seed": draw,
        "train": len(train),
        "check": len(check),
    }
    return judged, train, document


def _compared(train: Measurements, check: Measurements, args: argparse.Namespace) -> list[str]:
    """What the user should know about the two files together; an error where they do not match."""
    trained, checked = (
        [row.tobytes() for row in np.ascontiguousarray(np.hstack([data.q, data.position]))]
        for data in (train, check)
    )
    known, file = set(trained), str(args.check)
    same = [i for i, row in enumerate(checked) if row in known]
    if same:
        raise InputError(
            f"{len(same)} of {len(check)} measurements are in {args.data} too (the first "
            f"is sample {check.sample[same[0]]}): a model is judged on data not used to solve; "
            "take them out of one file, or leave out --check to hold out a part",
            file=file,
        )
    unknown = [name for name in check.targets if name not in train.targets]
    if unknown and "tool" not in args.check_refit:
        raise InputError(
            f"target {quoted(unknown[0])} is not in {args.data} (it has "
            f"{', '.join(train.targets)}): use the same name, or --check-refit tool (or "
            "base,tool) to place it anew from the check data",
            file=file,
            column="target",
        )
    found = []
    group = pose_groups(np.vstack([train.q, check.q]))
    again = int(np.sum(np.isin(group[len(train) :], group[: len(train)])))
    if again:
        found.append(
            f"{again} of {len(check)} check measurements are at poses that were also used to "
            "solve: errors at new poses can be larger"
        )
    if train.rotation is None and check.rotation is not None:
        found.append(
            f"{args.check} has orientations and {args.data} has none: the "
            "model is solved and judged by positions"
        )
    return found


EVERY = ""  # stands for every target that has no commanded position of its own
Point = tuple[float, ...]


def add_iso9283(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--data",
        required=True,
        type=Path,
        metavar="CSV",
        help="attained positions: x_mm, y_mm, z_mm, and target where there are several",
    )
    parser.add_argument(
        "--commanded",
        type=_commanded,
        action="append",
        default=[],
        metavar="[TARGET=]X,Y,Z",
        help="commanded position in mm, in the frame of the table, which must come from other "
        "points than these; TARGET=X,Y,Z, repeated, where there are several targets. Without it "
        "AP is not known",
    )


def run_iso9283(args: argparse.Namespace) -> CliResult:
    table = read_positions(args.data)
    commanded = _by_target(args.commanded, list(table), str(args.data))
    targets: dict[str, PoseAccuracyDocument] = {}
    warnings: list[str] = []
    without = [name for name in table if name not in commanded]
    if EVERY in commanded and len(without) > 1:
        warnings.append(
            f"one commanded position is taken for the targets {', '.join(without)}: give each its "
            "own with --commanded TARGET=X,Y,Z"
        )
    for name, position in table.items():
        where = commanded.get(name, commanded.get(EVERY))
        try:
            found = repeated(position, None if where is None else np.array(where) * 1e-3)
        except TooFewSamplesError as error:
            raise TooFewSamplesError(f"{args.data}, target {quoted(name)}: {error}") from error
        x, y, z = (None,) * 3 if found.offset is None else (found.offset * 1e3).tolist()
        targets[name] = {
            "n": found.n,
            "AP_mm": None if found.AP_m is None else found.AP_m * 1e3,
            "RP_mm": found.RP_m * 1e3,
            "mean_distance_mm": found.mean_distance_m * 1e3,
            "S_mm": found.S_m * 1e3,
            "barycentre_mm": (found.barycentre * 1e3).tolist(),
            "AP_x_mm": x,
            "AP_y_mm": y,
            "AP_z_mm": z,
        }
        if found.n < CYCLES:
            warnings.append(
                f"target {quoted(name)}: {found.n} cycles; ISO 9283 asks for {CYCLES}: RP is less "
                "certain"
            )
    document: Iso9283Document = {"targets": targets, "warnings": warnings}
    return CliResult(document, _show_iso9283)


def _commanded(value: str) -> tuple[str, Point]:
    """Target, or ``EVERY``, and its commanded position in mm."""
    name, sign, cells = value.rpartition("=")
    try:
        point = tuple(float(cell) for cell in cells.split(","))
    except ValueError:
        point = ()
    if len(point) != 3 or not all(map(math.isfinite, point)) or (sign and not name):
        raise argparse.ArgumentTypeError(
            f"{quoted(value)} is not X,Y,Z or TARGET=X,Y,Z, in mm with a point as decimal mark"
        )
    return name, point


def _by_target(
    given: Sequence[tuple[str, Point]], targets: Sequence[str], file: str
) -> Mapping[str, Point]:
    """Commanded positions by target, each in the table and given once."""
    found: dict[str, Point] = {}
    for name, point in given:
        if name != EVERY and name not in targets:
            hint = nearest(name, targets)
            raise InputError(
                f"--commanded: no target {quoted(name)}{hint}; the table has {', '.join(targets)}",
                file=file,
            )
        if name in found:
            whose = f"target {quoted(name)}" if name else "all targets"
            raise InputError(f"--commanded: a position of {whose} is given twice")
        found[name] = point
    return found


def _show_iso9283(console: "Console", document: Document) -> None:
    title = "Position accuracy and repeatability as in ISO 9283, 7.2, in mm"
    head = ("target", "cycles", "AP", "AP x", "AP y", "AP z", "RP", "mean distance", "S")
    rows = []
    keys = ("AP_mm", "AP_x_mm", "AP_y_mm", "AP_z_mm", "RP_mm", "mean_distance_mm", "S_mm")
    for name, found in document["targets"].items():
        values = ["-" if found[key] is None else f"{found[key]:z.4f}" for key in keys]
        rows.append([name, str(found["n"]), *values])
    print_table(console, title, head, rows)
