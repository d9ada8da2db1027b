# SPDX-License-Identifier: Apache-2.0
"""The whole cell with a KR 150, and what it does in a test."""

from dataclasses import replace

import numpy as np

from bench.cell_samples import SPIN_RAD, programme
from bench.measured_runs import laser_of
from robocal_ros.cell_sim.cell import TAUGHT, Happened, SimulatedCell, kr150_cell, poses
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.run import MeasuringPlan

NOMINAL = load_robot("kr150_r3100")
ARM = replace(NOMINAL, T_flange_tool=TAUGHT)
HOME, ABOVE = poses("home")[0], poses("tool")[0]
CYCLE, WORK = poses("cycle"), poses("work")


def cell_of(
    seed: int = 1, effects: Effects | None = None, points: int = 0, fixture: bool = False
) -> SimulatedCell:
    return SimulatedCell(kr150_cell(NOMINAL, seed, effects, points, fixture=fixture))


def go(cell: SimulatedCell, q, rest_s: float = 1.0) -> None:
    """Let it drive through poses (m, n), with a rest at each."""
    here = cell.motion.at([cell.now_s])[0][0]
    time, q, qd, qdd = programme(here, np.atleast_2d(q), rest_s=rest_s)
    cell.follow(cell.now_s + time, q, qd, qdd)


def went(cell: SimulatedCell, q, rest_s: float = 1.0, readings: bool = True) -> Happened:
    """All that came of it, and of half a second more."""
    go(cell, q, rest_s)
    return cell.advance(cell.motion.end_s + 0.5, readings)


def worked(cell: SimulatedCell, hours: float) -> None:
    """A stretch of production."""
    end_s = cell.now_s + 3600.0 * hours
    while cell.now_s < end_s:
        went(cell, np.vstack([WORK, HOME]), 0.5, readings=False)


def true_laser(cell: SimulatedCell) -> LaserFrame:
    """The beams as the robot's nominal model sees them, where it measures.

    The robot's own errors there, 5 mm, are the same with every tool: they are in a calibration too.
    """
    at = ABOVE[None]
    T_known_true = ARM.fk(ABOVE) @ np.linalg.inv(cell.plan.robot.flange(at, cell.warmth)[0])
    points = laser_of(cell.plan.station).points
    return LaserFrame(points @ T_known_true[:3, :3].T + T_known_true[:3, 3], 3e-5)


def first_circle(cell: SimulatedCell):
    return replace(
        MeasuringPlan("full", true_laser(cell), TAUGHT, spin_rad=SPIN_RAD).step(1), speed_m_s=0.1
    )
