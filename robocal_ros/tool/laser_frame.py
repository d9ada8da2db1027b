"""The frame of two crossed beams, calibrated with a cylinder on the flange.

methods: the cylinder finds two points on each beam, A and B on the x-beam, C and D on the y-beam;
the origin is the middle of the common perpendicular of the lines AB and CD, x along AB,
z = x times the y-beam, y = z times x (thesis, eq. 4-15 to 4-27).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, RobocalError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_fields, require_made_for, write_made
from robocal_ros.tool.edges import BEAMS

Array = NDArray[np.float64]

POINTS = ("A", "B", "C", "D")
SMALLEST_BASE_M = 2e-3  # between two points of a beam
SMALLEST_ANGLE_RAD = float(np.radians(30.0))
LARGEST_GAP_M = 2e-3


@dataclass(frozen=True, eq=False)
class LaserFrame:
    """Two beams in the robot's base.

    Attributes
    ----------
    points : (4, 3) points A, B on the x-beam and C, D on the y-beam, base, m; beams point from A
        to B and from C to D, from emitter to receiver.
    sigma_m : standard deviation of each coordinate of a point across its beam; 0 where the same
        frame serves both measurements of a change, so that its error cancels.
    reach : (2,) how far from its middle each beam is broken, m: negative where a tool must cover
        more than half of the light. It moves the height of a tip, and nothing else.

    Raises
    ------
    RankDeficientError
        When two points of a beam coincide, or the beams are nearly parallel.
    InputError
        When the beams pass each other at more than 2 mm.
    """

    points: Array
    sigma_m: float = 0.0
    reach: Array = field(default_factory=lambda: np.zeros(2))

    def __post_init__(self) -> None:
        if np.shape(self.points) != (4, 3) or not np.all(np.isfinite(self.points)):
            raise ValueError("points must be (4, 3) and finite")
        for i, beam in ((0, "x"), (2, "y")):
            base = float(np.linalg.norm(self.points[i + 1] - self.points[i]))
            if base < SMALLEST_BASE_M:
                raise RankDeficientError(
                    f"the two points on the {beam}-beam are {base * 1e3:.2f} mm apart: measure "
                    "them further apart along the beam",
                    (f"direction of the {beam}-beam",),
                )
        if not SMALLEST_ANGLE_RAD < self.beam_angle_rad < np.pi - SMALLEST_ANGLE_RAD:
            raise RankDeficientError(
                f"the beams cross at {np.degrees(self.beam_angle_rad):.1f} deg: they must cross "
                "at nearly a right angle",
                ("place along the beams",),
            )
        if abs(self.gap_m) > LARGEST_GAP_M:
            raise InputError(
                f"the beams pass each other at {abs(self.gap_m) * 1e3:.2f} mm (allowed "
                f"{LARGEST_GAP_M * 1e3:.1f} mm): check the points, or align the beams"
            )

    @cached_property
    def direction(self) -> Array:
        """(2, 3) unit directions of the x- and the y-beam, base (eq. 4-23, 4-24)."""
        along = self.points[[1, 3]] - self.points[[0, 2]]
        return np.asarray(along / np.linalg.norm(along, axis=1)[:, None])

    @cached_property
    def length_m(self) -> Array:
        """(2,) distance of the two points of each beam, m."""
        return np.asarray(np.linalg.norm(self.points[[1, 3]] - self.points[[0, 2]], axis=1))

    @cached_property
    def beam_angle_rad(self) -> float:
        """Angle beta from the x- to the y-beam about z; between 0 and pi, as z is their normal."""
        ux, uy = self.direction
        return float(np.arctan2(np.linalg.norm(np.cross(ux, uy)), ux @ uy))

    @cached_property
    def _feet(self) -> Array:
        """(2, 3) ends of the common perpendicular on the x- and the y-beam (eq. 4-21)."""
        A, C = self.points[0], self.points[2]
        along = np.column_stack([self.direction[0], -self.direction[1]])
        t, s = np.linalg.lstsq(along, C - A, rcond=None)[0]
        return np.array([A + t * self.direction[0], C + s * self.direction[1]])

    @cached_property
    def gap_m(self) -> float:
        """Height of the y-beam above the x-beam along z, m."""
        return float((self._feet[1] - self._feet[0]) @ self.T_base_laser[:3, 2])

    @cached_property
    def T_base_laser(self) -> Array:
        """(4, 4) pose of the laser frame in base (eq. 4-22 to 4-27)."""
        x = self.direction[0]
        z = np.cross(x, self.direction[1])
        z = z / np.linalg.norm(z)
        R = np.column_stack([x, np.cross(z, x), z])
        return frames.transform(R, self._feet.mean(axis=0))

    @property
    def normals(self) -> Array:
        """(2, 3) horizontal normals of the beams, base: distances d_x and d_y count along them."""
        sine, cosine = np.sin(self.beam_angle_rad), np.cos(self.beam_angle_rad)
        in_laser = np.array([[0.0, 1.0, 0.0], [sine, -cosine, 0.0]])
        return np.asarray(in_laser @ self.T_base_laser[:3, :3].T)


def calibrate_laser(
    flange: Mapping[str, Array], sigma_m: float = 0.0, radius_m: float | None = None
) -> LaserFrame:
    """Beams from flange positions (3,), base, m, at the edges A1 ... D4 of a cylinder along z_e.

    Indices 1 and 2 are break and restore with the cylinder upright, moved across the beam: their
    mean gives x and y. Indices 3 and 4 are those with the cylinder level, across the beam at the
    same place along it, moved in z: their mean gives z (eq. 4-15, 4-16). With the cylinder's
    ``radius_m`` the widths of the shadows give the beams' reach. A constant latency moves a
    point by speed times latency: give the means of sweeps back and forth.

    Raises
    ------
    InputError
        When one is missing; further what `LaserFrame` raises.
    """
    missing = [f"{p}{i}" for p in POINTS for i in range(1, 5) if f"{p}{i}" not in flange]
    if missing:
        raise InputError(f"points {', '.join(missing)} are missing: measure A1 to D4")
    points = np.zeros((4, 3))
    for row, name in zip(points, POINTS, strict=True):
        row[:2] = 0.5 * (flange[f"{name}1"] + flange[f"{name}2"])[:2]
        row[2] = 0.5 * (flange[f"{name}3"] + flange[f"{name}4"])[2]
    laser = LaserFrame(points, sigma_m)
    return laser if radius_m is None else replace(laser, reach=_reach(laser, flange, radius_m))


def _reach(laser: LaserFrame, flange: Mapping[str, Array], radius_m: float) -> Array:
    """Half the way across a beam in its shadow, less the cylinder's radius; (2,) means, m."""
    shares = []
    for name, u in zip(POINTS, np.repeat(laser.direction, 2, axis=0), strict=True):
        across = flange[f"{name}2"] - flange[f"{name}1"]
        down = flange[f"{name}4"] - flange[f"{name}3"]
        # Upright the cylinder lies along the second way, level along the first.
        for way, axis in ((across, down), (down, across)):
            normal = np.cross(u, axis)
            shares.append(0.5 * abs(way @ normal) / np.linalg.norm(normal))
    return np.asarray(np.mean(np.reshape(shares, (2, 4)), axis=1) - radius_m)


# ---- files of placed light beams: what ``robocal tool beams`` writes ----------------------------


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
