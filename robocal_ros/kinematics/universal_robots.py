# SPDX-License-Identifier: Apache-2.0
"""Factory calibration of Universal Robots as a serial arm in Hayati's form.

The factory file describes nearly parallel axes by plain DH parameters, whose common normal then
lies hundreds of metres away. The same axes in Hayati's form (Hayati 1983) have no such offsets.
"""

import ast
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, exp_rotation
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics.arm import ALPHA, NEARLY_PARALLEL, THETA, A, D, SerialArm
from robocal_ros.kinematics.tables import read_published

JOINT_NAMES = (
    "shoulder_pan_joint",
    "shoulder_lift_joint",
    "elbow_joint",
    "wrist_1_joint",
    "wrist_2_joint",
    "wrist_3_joint",
)


def parse_settings(text: str, file: str) -> dict[str, Array]:
    """Read the numeric lists of a controller's ``.conf`` text: ``name = [ … ]`` by name.

    Raises `InputError` when a list cannot be read; names file and row.
    """
    found: dict[str, Array] = {}
    for row, line in enumerate(text.splitlines(), start=1):
        name, equals, value = line.partition("#")[0].partition("=")
        if not equals or not value.strip().startswith("["):
            continue
        try:
            numbers = ast.literal_eval(value.strip())
            array = np.array(numbers, dtype=np.float64)
        except (ValueError, SyntaxError, TypeError):
            continue  # lists of words and hexadecimal checksums are not kinematics
        if not np.all(np.isfinite(array)):
            raise InputError(
                f"'{name.strip()}' holds a value that is not finite", file=file, row=row
            )
        found.setdefault(name.strip(), array)
    return found


def _row(settings: Mapping[str, Array], name: str, file: str) -> Array:
    values = settings.get(name)
    if values is None or values.shape != (6,):
        raise InputError(f"no list '{name}' of six numbers", file=file)
    return values


PANEL = (
    *(f"{joint} (°)" for joint in ("Base", "Shoulder", "Elbow", "Wrist 1", "Wrist 2", "Wrist 3")),
    *(f"{axis} (mm)" for axis in "XYZ"),
    *(f"R{axis} (rad)" for axis in "XYZ"),
)


def read_panel_poses(path: Path) -> Measurements:
    """Joints and poses of the flange in base as the controller's panel shows them, from a CSV.

    The orientation is a rotation vector; a sample's id is its row (the header is row 1).

    Raises `InputError` for a file that is not such a table.
    """
    table = read_published(path, PANEL)
    values = np.stack([table.numbers(name) for name in PANEL], axis=1)
    return Measurements(
        q=np.radians(values[:, :6]),
        position=values[:, 6:9] * 1e-3,
        rotation=exp_rotation(values[:, 9:]),
        target=("flange",) * len(values),
        sample=tuple(map(str, table.rows)),
    )


def factory_dh(nominal: Mapping[str, Array], delta: Mapping[str, Array]) -> Array:
    """DH parameters (6, 5), m and rad: ``urcontrol.conf`` plus the deltas of ``calibration.conf``.

    Raises `InputError` when a list is missing.
    """
    base = {name: _row(nominal, name, "nominal file") for name in ("a", "d", "alpha")}
    mdh = np.zeros((6, 5))
    mdh[:, D] = base["d"] + _row(delta, "delta_d", "calibration file")
    mdh[:, THETA] = _row(delta, "delta_theta", "calibration file")
    mdh[:, A] = base["a"] + _row(delta, "delta_a", "calibration file")
    mdh[:, ALPHA] = base["alpha"] + _row(delta, "delta_alpha", "calibration file")
    return mdh


def nominal_arm(nominal: Mapping[str, Array], name: str) -> SerialArm:
    """The uncalibrated arm of ``urcontrol.conf``; right angles are taken as exact."""
    zero = {f"delta_{key}": np.zeros(6) for key in ("theta", "a", "d", "alpha")}
    mdh = factory_dh(nominal, zero)
    quarter = np.round(mdh[:, ALPHA] / (np.pi / 2.0)) * (np.pi / 2.0)
    mdh[:, ALPHA] = np.where(np.abs(mdh[:, ALPHA] - quarter) < 1e-6, quarter, mdh[:, ALPHA])
    limit = np.full(6, 2.0 * np.pi)
    return SerialArm(name, JOINT_NAMES, mdh, np.ones(6), np.zeros(6, dtype=np.bool_), -limit, limit)


def factory_arm(nominal: Mapping[str, Array], delta: Mapping[str, Array], name: str) -> SerialArm:
    """The arm as calibrated by the factory, in Hayati's form, with the same flange poses.

    The joint angles stay the controller's own.
    """
    arm = nominal_arm(nominal, name)
    return replace(arm, mdh=hayati_from_dh(factory_dh(nominal, delta), arm.mdh))


def hayati_from_dh(dh: Array, nominal: Array) -> Array:
    """Rewrite plain DH parameters (n, 5) of a revolute arm in Hayati's form, exactly.

    Where consecutive axes are nearly parallel, the next origin is where the next axis meets the
    plane z = 0 of the frame before; what then remains is a turn about and a shift along that
    axis, which the next joint takes over. ``nominal`` (n, 5) chooses between the two solutions.
    """
    result = dh.copy()
    turn, shift = 0.0, 0.0
    for i in range(len(dh)):
        result[i, THETA] += turn
        result[i, D] += shift
        turn, shift = 0.0, 0.0
        last = i == len(dh) - 1
        if not last and abs(np.sin(nominal[i, ALPHA])) < NEARLY_PARALLEL:
            result[i], turn, shift = _parallel_link(result[i], nominal[i])
    turned = result[:, THETA] - nominal[:, THETA]
    result[:, THETA] = nominal[:, THETA] + ((turned + np.pi) % (2.0 * np.pi) - np.pi)
    return result


def link_transform(row: Array) -> Array:
    """One link (4, 4): Trans(z, d) Rot(z, theta) Trans(x, a) Rot(x, alpha) Rot(y, beta)."""
    d, theta, a, alpha, beta = row
    c, s, ca, sa, cb, sb = (f(x) for x in (theta, alpha, beta) for f in (np.cos, np.sin))
    Rz = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    Rx = np.array([[1.0, 0.0, 0.0], [0.0, ca, -sa], [0.0, sa, ca]])
    Ry = np.array([[cb, 0.0, sb], [0.0, 1.0, 0.0], [-sb, 0.0, cb]])
    T = np.eye(4)
    T[:3, :3] = Rz @ Rx @ Ry
    T[:3, 3] = (a * c, a * s, d)
    return T


def parallel_row(axis: Array, meeting: Array, sign: float = 1.0) -> Array:
    """Hayati's row (5,), m and rad, to a line along a unit ``axis`` (3,), nearly parallel to z.

    ``meeting`` (3,), m: where it meets the plane z = 0. ``sign``: that of the row's a.
    """
    a = float(np.copysign(np.hypot(meeting[0], meeting[1]), sign))
    theta = float(np.arctan2(meeting[1] * np.sign(a), meeting[0] * np.sign(a)))
    c, s = np.cos(theta), np.sin(theta)
    x, y = c * axis[0] + s * axis[1], c * axis[1] - s * axis[0]
    # the axis in the turned frame is (sin beta, -sin alpha cos beta, cos alpha cos beta)
    return np.array([0.0, theta, a, np.arctan2(-y, axis[2]), np.arcsin(x)])


def _parallel_link(dh: Array, nominal: Array) -> tuple[Array, float, float]:
    """Hayati row of one link, and the turn about and shift along its z axis that remain."""
    T = link_transform(dh)
    axis, origin = T[:3, 2], T[:3, 3]
    row = parallel_row(axis, origin - axis * (origin[2] / axis[2]), nominal[A])
    rest = np.linalg.solve(link_transform(row), T)
    return row, float(np.arctan2(rest[1, 0], rest[0, 0])), float(rest[2, 3])
