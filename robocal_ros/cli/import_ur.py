"""``robocal import-ur``: a Universal Robots factory calibration as a robot file."""

import argparse
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.output import CliResult, Document
from robocal_ros.ground.errors import InputError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray
    from rich.console import Console

    from robocal_ros.kinematics import SerialArm

    Array = NDArray[np.float64]

NAME = "import-ur"
HELP = "turn the factory calibration of a Universal Robots arm into a robot file"

_POSES = 1000


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the options."""
    parser.add_argument(
        "--calibration",
        required=True,
        type=Path,
        metavar="calibration.conf",
        help="deltas of this robot, from its controller's folder .urcontrol",
    )
    parser.add_argument(
        "--nominal",
        required=True,
        type=Path,
        metavar="urcontrol.conf",
        help="nominal model of its type, from the same folder",
    )
    parser.add_argument(
        "--output", required=True, type=Path, metavar="R.yaml", help="robot file to write"
    )
    parser.add_argument("--name", help="name of the robot, default that of the output file")


def run(args: argparse.Namespace) -> CliResult:
    """Do it. Raises `RobocalError` for what a user can mend."""
    from robocal_ros.kinematics.robots import save_robot

    name = args.name or args.output.stem
    nominal, factory, dh = _arms(args.nominal, args.calibration, name)
    save_robot(factory, args.output)
    distances = _distances(nominal, factory)
    document: Document = {
        "robot": name,
        "model_hash": factory.model_hash,
        "output": str(args.output),
        "joints": _joints(factory),
        "from_nominal": {
            "mean_mm": float(distances.mean() * 1e3),
            "max_mm": float(distances.max() * 1e3),
            "n": _POSES,
        },
        "conversion_error_mm": float(_distances(dh, factory).max() * 1e3),
    }
    return CliResult(document, partial(_show, document=document))


def _arms(nominal: Path, calibration: Path, name: str) -> "tuple[SerialArm, SerialArm, SerialArm]":
    """The arm as designed, as calibrated, and as calibrated in the controller's own numbers."""
    from dataclasses import replace

    from robocal_ros.ground.files import read_text
    from robocal_ros.kinematics.universal_robots import (
        factory_arm,
        factory_dh,
        nominal_arm,
        parse_settings,
    )

    settings = [
        parse_settings(read_text(path, "configuration"), str(path))
        for path in (nominal, calibration)
    ]
    try:
        designed = nominal_arm(settings[0], name)
        calibrated = factory_arm(settings[0], settings[1], name)
    except InputError as error:
        path = calibration if "delta_" in str(error) else nominal
        raise InputError(str(error), file=str(path)) from error
    return designed, calibrated, replace(designed, mdh=factory_dh(settings[0], settings[1]))


def _distances(a: "SerialArm", b: "SerialArm") -> "Array":
    """Distances (m,), m, between the flanges of two arms over the whole joint space."""
    import numpy as np

    q = np.random.default_rng(0).uniform(a.lower, a.upper, (_POSES, a.n))
    return np.asarray(np.linalg.norm(a.fk(q)[:, :3, 3] - b.fk(q)[:, :3, 3], axis=1))


def _joints(arm: "SerialArm") -> list[dict[str, Any]]:
    import numpy as np

    keys = ("d_mm", "theta_deg", "a_mm", "alpha_deg", "beta_deg")
    factors = np.array([1e3, 180.0 / np.pi, 1e3, 180.0 / np.pi, 180.0 / np.pi])
    rows = (arm.mdh * factors).tolist()
    return [
        {"name": name, **dict(zip(keys, row, strict=True))}
        for name, row in zip(arm.joint_names, rows, strict=True)
    ]


def _show(console: "Console", document: Document) -> None:
    from rich.table import Table

    table = Table(title=f"{document['robot']}, as calibrated by the factory")
    headings = {"name": "joint", "d_mm": "d mm", "theta_deg": "theta deg", "a_mm": "a mm"}
    headings |= {"alpha_deg": "alpha deg", "beta_deg": "beta deg"}
    for heading in headings.values():
        table.add_column(heading, justify="left" if heading == "joint" else "right")
    for joint in document["joints"]:
        numbers = (f"{joint[key]:z.4f}" for key in headings if key != "name")
        table.add_row(joint["name"], *numbers)
    console.print(table)
    far = document["from_nominal"]
    console.print(
        f"The flange is {far['mean_mm']:.3f} mm (at most {far['max_mm']:.3f} mm) from the nominal "
        f"model's over {far['n']} poses.\nWritten: {document['output']}"
    )
