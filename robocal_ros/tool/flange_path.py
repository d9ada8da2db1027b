"""Where the flange was, and how fast it moved, at the stamps of edges."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.kinematics import SerialArm
from robocal_ros.tool.laser_frame import LaserFrame

Array = NDArray[np.float64]

FEWEST_READINGS = 4
LONGEST_GAP_S = 0.05  # of a turn of 1.5 s: the cubic between two readings misses by 0.1 um


class FlangePath(Protocol):
    """The flange over time."""

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """T_base_flange (m, 4, 4) and twist (m, 6): see `JointPath.at`."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """The flange from joint readings, with cubic splines between them.

    Attributes
    ----------
    arm : the model in force, so that the thermal drift is in the poses.
    time_s : (n,) stamps of the readings, in increasing order.
    q : (n, joints) readings, rad (prismatic: m).
    longest_gap_s : longest pause between two readings around an edge.

    Raises
    ------
    TooFewSamplesError, InputError
        Fewer than four readings; stamps that do not increase.
    """

    arm: SerialArm
    time_s: Array
    q: Array
    longest_gap_s: float = LONGEST_GAP_S

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

        Raises
        ------
        InputError
            When readings are missing around one of the times.
        """
        after = np.searchsorted(self.time_s, time_s, side="right")
        inside = (after > 0) & (after < len(self.time_s))
        if not np.all(inside):
            lost = float(time_s[~inside][0])
            raise InputError(
                f"no joint readings around the edge at {lost:.4f} s (they run from "
                f"{self.time_s[0]:.4f} to {self.time_s[-1]:.4f} s): record the whole motion"
            )
        gap = self.time_s[after] - self.time_s[after - 1]
        worst = int(np.argmax(gap))
        if gap[worst] > self.longest_gap_s:
            raise InputError(
                f"joint readings pause for {gap[worst] * 1e3:.0f} ms around the edge at "
                f"{time_s[worst]:.4f} s (allowed {self.longest_gap_s * 1e3:.0f} ms): raise the "
                "rate of joint_states"
            )
        q, rate = self._spline(time_s), self._spline(time_s, 1)
        return self.arm.fk(q), (self.arm.jacobian(q) @ rate[:, :, None])[:, :, 0]


# ---- tool axis ----------------------------------------------------------------------------------


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

    Raises
    ------
    RankDeficientError
        When both circles are at one height, or the axis lies nearly in the beam plane.
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
