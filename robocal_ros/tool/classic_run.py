"""A tool frame as the source takes it: mid-times, commanded motion; a baseline for comparison."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.tool.beam_edges import BeamEdge
from robocal_ros.tool.circle_edges import CircleMotion
from robocal_ros.tool.crossed_beams import fit_circle
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.tool_axis import axis_from_centres, retaught

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CommandedCircle:
    """A circle as commanded: its motion, the flange's pose at its centre, and the edges."""

    motion: CircleMotion
    T_base_centre: Array
    edges: Sequence[BeamEdge]


def classic_tool(
    laser: LaserFrame,
    circles: tuple[CommandedCircle, CommandedCircle],
    R_base_flange: Array,
    plunge: Array,
    T_flange_tool: Array,
) -> Array:
    """T_flange_tool (4, 4) as in the source, with its errors corrected.

    ``circles``: with the tool as it is, at two heights. ``plunge`` (n, 3): flange positions, base,
    m, at the edges of the plunges, made at the orientation ``R_base_flange`` (3, 3) with the
    axis upright and on the crossing. The tip is
    ``R_base_flange^T (M - mean of the plunge)`` (thesis eq. 4-14, corrected).
    """
    centres = [fit_circle(c.motion, c.edges, "classic").centre for c in circles]
    v = axis_from_centres(
        laser, (circles[0].T_base_centre, circles[1].T_base_centre), (centres[0], centres[1])
    )
    tip = R_base_flange.T @ (laser.T_base_laser[:3, 3] - plunge.mean(axis=0))
    R = retaught(T_flange_tool[:3, :3], v)
    return frames.transform(R, tip)
