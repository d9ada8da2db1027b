# SPDX-License-Identifier: Apache-2.0
"""Robots with a tool over a beam station, for the tests of motions."""

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody
from robocal_ros.motion.plan import JointPlan, MotionLimits
from robocal_ros.tool.run import PlannedStep

POSTURES = {
    "ur10": np.array([0.047, -2.208, -1.248, 1.885, -1.571, 1.618]),
    "kr150_r3100": np.array([0.3, -1.5, 1.7, 0.4, 0.9, 0.2]),
}
TOOL = ToolBody(
    frames.transform(frames.exp_rotation([0.2, -0.1, 0.3]), [0.02, -0.03, 0.2]), 0.12, 0.004, 0.06
)
OPENING = Housing(clear_radius_m=0.04, top_m=0.02, floor_m=-0.08, retract_m=0.04)


def make_motion_cell(
    robot: str,
    q: np.ndarray | None = None,
    *,
    housing: Housing = OPENING,
    limits: MotionLimits | None = None,
    tool: ToolBody = TOOL,
) -> MotionCell:
    """A station whose crossing is at the tip in a posture, with the tool upright on it."""
    arm = load_robot(robot)
    T_base_tool = arm.fk(POSTURES[robot] if q is None else q) @ tool.T_flange_tool
    T_base_laser = T_base_tool @ frames.transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
    return MotionCell(arm, tool, T_base_laser, housing, limits or MotionLimits())


def shifted(cell: MotionCell, T_base_flange: np.ndarray, by_laser: list[float]) -> np.ndarray:
    """A flange pose moved along the laser's axes."""
    T = T_base_flange.copy()
    T[:3, 3] += cell.T_base_laser[:3, :3] @ by_laser
    return T


def upright(cell: MotionCell, height_m: float) -> np.ndarray:
    """Flange pose with the tool upright over the crossing, the tip at a height."""
    T_laser_tool = frames.transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, height_m])
    return cell.T_base_laser @ T_laser_tool @ frames.invert(cell.tool.T_flange_tool)


def circle_step(cell: MotionCell, **other: object) -> PlannedStep:
    """A circle at 5 mm above the tip."""
    values = {"speed_m_s": 0.05, "radius_m": 0.012} | other
    return _step(cell, "circle", -5e-3, values)


def plunge_step(cell: MotionCell, **other: object) -> PlannedStep:
    """A plunge of 7 mm."""
    return _step(cell, "plunge", 3.5e-3, {"speed_m_s": 0.01, "depth_m": 7e-3} | other)


def _step(cell: MotionCell, kind: str, height_m: float, values: dict) -> PlannedStep:
    fixed = {"name": kind, "kind": kind, "number": 1, "of": 2}
    where = {"T_base_flange": upright(cell, height_m), "R_base_laser": cell.T_base_laser[:3, :3]}
    return PlannedStep(**(fixed | where | values))


def instants(plan: JointPlan, step_s: float = 1e-3) -> np.ndarray:
    """Times over a plan that do not fall on its points."""
    return np.linspace(0.0, plan.duration_s, int(plan.duration_s / step_s) + 2)


def tip_in_laser(cell: MotionCell, q: np.ndarray, point: np.ndarray | None = None) -> np.ndarray:
    """Where the tip (or another point of the flange) is seen from the laser frame."""
    p = cell.tool.T_flange_tool[:3, 3] if point is None else point
    in_base = cell.arm.fk(q) @ np.append(p, 1.0)
    return (frames.invert(cell.T_base_laser) @ in_base[..., None])[..., :3, 0]
