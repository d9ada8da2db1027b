"""Files of placed light beams: what ``robocal tool beams`` writes."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_fields, require_made_for, write_made
from robocal_ros.tool.beam_edges import BEAMS
from robocal_ros.tool.laser_frame import POINTS, LaserFrame

Document = dict[str, Any]

REQUIRED = ("station", "points_mm", "sigma_mm", "reach_mm", "robot", "model_hash")


@dataclass(frozen=True, eq=False)
class LaserFile:
    """Beams in a robot's base, and whose they are.

    Attributes
    ----------
    station : name of the beams' station, as its edges carry it.
    robot, model_hash : the nominal model whose flange poses placed the beams.
    serial : of the robot, where it is known.
    """

    laser: LaserFrame
    station: str
    robot: str
    model_hash: str
    serial: str | None = None


def write_laser(path: Path, placed: LaserFile) -> None:
    """Write a laser file in millimetres, all digits kept; the file appears whole or not.

    Raises
    ------
    InputError
        When it cannot be written.
    """
    laser = placed.laser
    document: Document = {
        "station": placed.station,
        "points_mm": dict(zip(POINTS, (laser.points * 1e3).tolist(), strict=True)),
        "sigma_mm": laser.sigma_m * 1e3,
        "reach_mm": dict(zip(BEAMS, (laser.reach * 1e3).tolist(), strict=True)),
        "robot": placed.robot,
        "model_hash": placed.model_hash,
    }
    if placed.serial is not None:
        document["serial"] = placed.serial
    write_made(path, document, tuple(document), "tool beams")


def read_laser(path: Path) -> LaserFile:
    """Read a laser file.

    Raises
    ------
    InputError
        Naming file and key, when it is not as docs/tool.md says, or its points are no two beams.
    """
    top = read_fields(path, "laser file")
    top.only(*REQUIRED, "serial")
    points, reach = top.below("points_mm"), top.below("reach_mm")
    points.only(*POINTS)
    reach.only(*BEAMS)
    sigma_mm = top.number("sigma_mm")
    if sigma_mm < 0.0:
        top.fail(f"is {sigma_mm:g}; it must not be below 0", "sigma_mm")
    places = 1e-3 * np.array([points.numbers(name, 3) for name in POINTS])
    reaches = 1e-3 * np.array([reach.number(beam) for beam in BEAMS])
    try:
        laser = LaserFrame(places, sigma_mm * 1e-3, reaches)
    except RobocalError as error:
        raise InputError(f"points_mm: {error}", file=str(path)) from error
    return LaserFile(
        laser=laser,
        station=top.text("station"),
        robot=top.text("robot"),
        model_hash=top.text("model_hash"),
        serial=top.text("serial") if "serial" in top.values else None,
    )


def read_laser_for(path: Path, arm: SerialArm) -> LaserFile:
    """Read a laser file that was made with ``arm``.

    Raises
    ------
    InputError
        As `read_laser`.
    WrongRobotError
        When it was made with another nominal model.
    """
    placed = read_laser(path)
    require_made_for(arm, path, placed.robot, placed.model_hash, "place the beams")
    return placed
