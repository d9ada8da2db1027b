"""The circle that the flange drove, from joint readings: what the classic method takes as given."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.tool.crossed_model import BeamStep
from robocal_ros.tool.crossed_run import LARGEST_MISFIT_M, CommandedCircle, classic_tool
from robocal_ros.tool.edges import BEAMS, FEWEST_EDGES, BeamEdge, BeamError, CircleMotion, edges_of
from robocal_ros.tool.flange_path import FlangePath
from robocal_ros.tool.laser_frame import LaserFrame

Array = NDArray[np.float64]

PLACES = 200  # of the flange along a circle
SHORTEST_ARC_RAD = float(np.pi)
SAME_TURN_RAD = 1e-3  # orientations that differ by less are one: a robot repeats far better


def driven_circle(
    laser: LaserFrame, path: FlangePath, edges: Sequence[BeamEdge]
) -> CommandedCircle:
    """Fit a circle at constant speed to the flange between the first and the last edge.

    The circle lies parallel to the beam plane; linear least squares of its centre and radius
    (Kåsa 1976), and of its angle over time.

    Raises
    ------
    BeamError
        When a beam has fewer than four edges.
    RankDeficientError
        When the flange went less than half a turn.
    ResidualError
        When the flange drove no such circle.
    """
    for beam in BEAMS:
        edges_of(edges, beam, FEWEST_EDGES)
    stamps = [edge.time_s for edge in edges]
    time = np.linspace(min(stamps), max(stamps), PLACES)
    T, _ = path.at(time)
    T_laser_flange = frames.invert(laser.T_base_laser) @ T
    x, y, z = T_laser_flange[:, :3, 3].T
    A = np.column_stack([2.0 * x, 2.0 * y, np.ones_like(x)])
    cx, cy, rest = np.linalg.lstsq(A, x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(rest + cx**2 + cy**2))
    angle = np.unwrap(np.arctan2(y - cy, x - cx))
    middle = float(time.mean())
    rate, phase = np.polyfit(time - middle, angle, 1)
    if np.ptp(angle) < SHORTEST_ARC_RAD:
        raise RankDeficientError(
            f"the flange went {np.degrees(np.ptp(angle)):.0f} deg about the circle's centre "
            "between the first and the last edge: drive a whole turn",
            ("centre of the circle",),
        )
    off = np.hypot(np.hypot(x - cx, y - cy) - radius, z - z.mean())
    if off.max() > LARGEST_MISFIT_M:
        raise ResidualError(
            f"the flange leaves a circle in the beam plane by {off.max() * 1e3:.3f} mm (allowed "
            f"{LARGEST_MISFIT_M * 1e3:.1f} mm): drive the circle about the laser's z"
        )
    motion = CircleMotion(
        radius_m=radius,
        period_s=float(2.0 * np.pi / abs(rate)),
        start_rad=float(phase - rate * middle),
        direction=1 if rate > 0.0 else -1,
        beam_angle_rad=laser.beam_angle_rad,
    )
    centre = laser.T_base_laser @ [cx, cy, z.mean(), 1.0]
    return CommandedCircle(motion, frames.transform(T[0, :3, :3], centre[:3]), edges)


def classic_from_path(
    laser: LaserFrame, path: FlangePath, steps: Sequence[BeamStep], T_flange_tool: Array
) -> Array:
    """T_flange_tool (4, 4) by `classic_tool` from a recorded run.

    Its two circles are the first one and, of those with the same orientation of the flange, the
    one farthest from it in height. ``T_flange_tool``: as taught.

    Raises
    ------
    BeamError, ResidualError
        As `driven_circle`; the message names the step.
    RankDeficientError
        When there is no second circle at another height, or no plunge.
    """
    circles = []
    for step in steps:
        if step.kind == "circle":
            try:
                circles.append(driven_circle(laser, path, step.edges))
            except (BeamError, ResidualError) as error:
                raise type(error)(f"{step.name}: {error}") from error
    plunges = [edge.time_s for step in steps if step.kind == "plunge" for edge in step.edges]
    if not circles or not plunges:
        missing = "plunge" if circles else "circle"
        raise RankDeficientError(f"there is no {missing}: drive one", (f"the {missing}'s part",))
    T, _ = path.at(np.array(plunges))
    pair = circles[0], _farthest(circles, laser.T_base_laser[:3, 2])
    return classic_tool(laser, pair, T[0, :3, :3], T[:, :3, 3], T_flange_tool)


def _farthest(circles: Sequence[CommandedCircle], up: Array) -> CommandedCircle:
    first = circles[0].T_base_centre

    def height(circle: CommandedCircle) -> float:
        T = circle.T_base_centre
        turn = np.linalg.norm(frames.log_rotation(T[:3, :3] @ first[:3, :3].T))
        return abs(float(up @ (T - first)[:3, 3])) if turn < SAME_TURN_RAD else 0.0

    return max(circles, key=height)
