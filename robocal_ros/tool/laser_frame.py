# SPDX-License-Identifier: Apache-2.0
"""The frame of two crossed beams, calibrated with a cylinder on the flange.

methods: the cylinder finds two points on each beam, A and B on the x-beam, C and D on the y-beam;
the origin is the middle of the common perpendicular of the lines AB and CD, x along AB,
z = x times the y-beam, y = z times x (thesis, eq. 4-15 to 4-27).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import read_fields, require_made_for, write_made
from robocal_ros.tool.edges import BEAMS

POINTS = ("A", "B", "C", "D")
SMALLEST_BASE_M = 2e-3  # between two points of a beam
SMALLEST_ANGLE_RAD = float(np.radians(30.0))
LARGEST_GAP_M = 2e-3


@dataclass(frozen=True, eq=False)
class LaserFrame:
    """Two beams in the robot's base.

    Raises `RankDeficientError` when two points of a beam coincide, or the beams are nearly
    parallel; `InputError` when the beams pass each other at more than 2 mm.

    ``points`` (4, 3): points A, B on the x-beam and C, D on the y-beam, base, m; beams point from A
    to B and from C to D, from emitter to receiver.
    ``sigma_m``: standard deviation of each coordinate of a point across its beam; 0 where the same
    frame serves both measurements of a change, so that its error cancels.
    ``reach`` (2,): how far from its middle each beam is broken, m: negative where a tool must cover
    more than half of the light. It moves the height of a tip, and nothing else.
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

    Raises `InputError` when one is missing; further what `LaserFrame` raises.
    """
    missing = [f"{p}{i}" for p in POINTS for i in range(1, 5) if f"{p}{i}" not in flange]
    if missing:
        raise InputError(f"points {', '.join(missing)} are missing: measure A1 to D4")
    points = np.zeros((4, 3))
    for row, name in zip(points, POINTS, strict=True):
        row[:2] = 0.5 * (flange[f"{name}1"] + flange[f"{name}2"])[:2]
        row[2] = 0.5 * (flange[f"{name}3"] + flange[f"{name}4"])[2]
    laser = LaserFrame(points, sigma_m)
    if radius_m is None:
        return laser
    # Half the way across a beam in its shadow, less the cylinder's radius.
    shares = []
    for name, u in zip(POINTS, np.repeat(laser.direction, 2, axis=0), strict=True):
        across = flange[f"{name}2"] - flange[f"{name}1"]
        down = flange[f"{name}4"] - flange[f"{name}3"]
        # Upright the cylinder lies along the second way, level along the first.
        for way, axis in ((across, down), (down, across)):
            normal = np.cross(u, axis)
            shares.append(0.5 * abs(way @ normal) / np.linalg.norm(normal))
    reach = np.mean(np.reshape(shares, (2, 4)), axis=1) - radius_m
    return replace(laser, reach=np.asarray(reach))


REQUIRED = ("station", "points_mm", "sigma_mm", "reach_mm", "robot", "model_hash")


@dataclass(frozen=True, eq=False)
class LaserFile:
    """Beams in a robot's base, and whose they are.

    ``station``: name of the beams' station, as its edges carry it. ``robot``, ``model_hash``: the
    nominal model whose flange poses placed the beams. ``serial``: of the robot, where it is known.
    """

    laser: LaserFrame
    station: str
    robot: str
    model_hash: str
    serial: str | None = None


def write_laser(path: Path, placed: LaserFile) -> None:
    """Write a laser file in millimetres, all digits kept; the file appears whole or not."""
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

    Raises `InputError`, naming file and key, when it is not as docs/tool.md says, or its points are
    no two beams.
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
    """Read a laser file that was made with ``arm``."""
    placed = read_laser(path)
    require_made_for(arm, path, placed.robot, placed.model_hash, "place the beams")
    return placed


FEWEST_READINGS = 4
LONGEST_GAP_S = 0.05  # of a turn of 1.5 s: the cubic between two readings misses by 0.1 um


class FlangePath(Protocol):
    """The flange over time."""

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """T_base_flange (m, 4, 4) and twist (m, 6): see `JointPath.at`."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """The flange from joint readings, with cubic splines between them.

    Raises `TooFewSamplesError` or `InputError`: fewer than four readings; stamps that do not
    increase.

    ``arm``: the model in force, so that the thermal drift is in the poses. ``time_s`` (n,): stamps
    of the readings, in increasing order. ``q`` (n, joints): readings, rad (prismatic: m).
    """

    arm: SerialArm
    time_s: Array
    q: Array

    def __post_init__(self) -> None:
        if len(self.time_s) < FEWEST_READINGS:
            raise TooFewSamplesError(
                f"{len(self.time_s)} joint readings: record joint_states during the whole motion"
            )
        step = np.diff(self.time_s)
        if np.any(step <= 0.0):
            late = int(np.argmax(step <= 0.0)) + 1
            raise InputError(
                f"joint reading at {self.time_s[late]:.6f} s is not after the one before it"
            )

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.time_s, self.q)

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """T_base_flange (m, 4, 4) and twist (m, 6): of its origin, m/s, and turning, rad/s, base.

        Raises `InputError` when readings are missing around one of the times.
        """
        after = np.searchsorted(self.time_s, time_s, side="right")
        inside = (after > 0) & (after < len(self.time_s))
        if not np.all(inside):
            lost = float(time_s[~inside][0])
            raise InputError(
                f"no joint readings around the edge at {lost:.4f} s (they run from "
                f"{self.time_s[0]:.4f} to {self.time_s[-1]:.4f} s): record the whole motion; where "
                "that was done, the clocks of beams and joints differ: put both on one"
            )
        gap = self.time_s[after] - self.time_s[after - 1]
        worst = int(np.argmax(gap))
        if gap[worst] > LONGEST_GAP_S:
            raise InputError(
                f"joint readings pause for {gap[worst] * 1e3:.0f} ms around the edge at "
                f"{time_s[worst]:.4f} s (allowed {LONGEST_GAP_S * 1e3:.0f} ms): raise the "
                "rate of joint_states"
            )
        q, rate = self._spline(time_s), self._spline(time_s, 1)
        return self.arm.fk(q), (self.arm.jacobian(q) @ rate[:, :, None])[:, :, 0]


SMALLEST_RISE = float(np.sin(np.radians(45.0)))  # of the axis out of the beam plane
SMALLEST_HEIGHT_M = 5e-3  # between two circles


def minimal_rotation(start: ArrayLike, end: ArrayLike) -> Array:
    """Rotation (3, 3) by the smallest angle that turns one unit vector (3,) into another.

    For opposite vectors the axis is any perpendicular one: that of the coordinate in which
    ``start`` is smallest.
    """
    a, b = np.asarray(start, dtype=np.float64), np.asarray(end, dtype=np.float64)
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        if cosine > 0.0:
            return np.eye(3)
        axis = np.cross(a, np.eye(3)[np.argmin(np.abs(a))])
    return frames.exp_rotation(axis / np.linalg.norm(axis) * np.arctan2(sine, cosine))


def first_rotation(v_flange: ArrayLike, spin_rad: float = 0.0) -> Array:
    """R_flange_tool (3, 3) of a first set-up: the minimal rotation from flange z to the axis.

    Rot(z, psi) Rot(x, theta) Rot(z, -psi) with theta = atan2(hypot(v_x, v_y), v_z) and
    psi = atan2(v_x, -v_y) (thesis eq. 4-10, with eq. 4-13 corrected). Along -z psi is
    undetermined: ``spin_rad`` takes its place.
    """
    x, y, z = np.asarray(v_flange, dtype=np.float64)
    across = float(np.hypot(x, y))
    psi = np.arctan2(x, -y) if across > 1e-12 else spin_rad
    turn = frames.exp_rotation([0.0, 0.0, psi])
    tilt = frames.exp_rotation([np.arctan2(across, z), 0.0, 0.0])
    return np.asarray(turn @ tilt @ turn.T)


def retaught(R_flange_tool: Array, v_flange: ArrayLike) -> Array:
    """R_flange_tool (3, 3) with its z along the new axis and the taught turn about it.

    ``R_min(v_taught -> v_new) R_flange_tool_taught``.
    """
    return np.asarray(minimal_rotation(R_flange_tool[:, 2], v_flange) @ R_flange_tool)


def axis_from_centres(
    laser: LaserFrame, T_base_flange: tuple[Array, Array], centre: tuple[Array, Array]
) -> Array:
    """Unit tool axis (3,), flange to tip, in flange coordinates from two circles.

    ``T_base_flange``: poses of the flange at the circles' centres, both of one orientation, the
    second lower. ``centre``: (2,) tool's centre in the beam plane then, laser frame, m. In the
    laser frame the axis is (O1 - O2) - dz z (thesis eq. 4-11, from the tip's side).
    """
    R_laser_base = laser.T_base_laser[:3, :3].T
    moved = R_laser_base @ (T_base_flange[1][:3, 3] - T_base_flange[0][:3, 3])
    require_height(float(moved[2]))
    shift = np.append(centre[0] - centre[1], 0.0) + moved
    shift *= -np.sign(moved[2])  # towards the tip, whichever circle was lower
    v_laser = shift / np.linalg.norm(shift)
    require_upright(float(v_laser[2]))
    return np.asarray(T_base_flange[0][:3, :3].T @ R_laser_base.T @ v_laser)


def require_height(height_m: float) -> None:
    """Refuse two circles at one height."""
    if abs(height_m) < SMALLEST_HEIGHT_M:
        raise RankDeficientError(
            f"the circles' heights differ by {abs(height_m) * 1e3:.2f} mm: the axis needs a second "
            f"circle at least {SMALLEST_HEIGHT_M * 1e3:.0f} mm lower, better 50 mm",
            ("tilt of the tool",),
        )


def require_upright(rise: float) -> None:
    """Refuse an axis whose component ``rise`` along the laser's z is small."""
    if abs(rise) < SMALLEST_RISE:
        raise RankDeficientError(
            f"the tool axis is {np.degrees(np.arcsin(min(abs(rise), 1.0))):.1f} deg out of the "
            "beam plane: turn the flange until the tool stands upright on the beams",
            ("place along the axis",),
        )


def upright_pose(
    laser: LaserFrame, T_base_flange: Array, v_flange: Array, p_flange: ArrayLike
) -> Array:
    """Flange pose (4, 4) that sets the axis along -z of the laser frame and a point on its origin.

    The flange turns by the smallest angle; ``p_flange`` (3,) is the point, flange frame, m.
    """
    down = -laser.T_base_laser[:3, 2]
    R_old = T_base_flange[:3, :3]
    R = minimal_rotation(R_old @ v_flange, down) @ R_old
    return frames.transform(R, laser.T_base_laser[:3, 3] - R @ np.asarray(p_flange))
