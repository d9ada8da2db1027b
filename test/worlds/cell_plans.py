# SPDX-License-Identifier: Apache-2.0
"""A UR10 at a beam station, driven by time."""

from dataclasses import replace

import numpy as np
from beam_cell import make_cell

from bench.measured_runs import NO_NOISE, PERFECT, TAUGHT
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, bent
from robocal_ros.cell_sim.cell import CellPlan, Happened, SimulatedCell, rigid_robot
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.crossed_model import BeamStep, Held, RobotNoise, ToolEstimate, estimate_tool
from robocal_ros.tool.laser_frame import JointPath, LaserFrame
from robocal_ros.tool.run import MeasuringPlan

TRUTH = bent(TAUGHT, [0.003, -0.002, 0.002], [0.05, -0.04, 0.0])
ARM = replace(load_robot("ur10"), T_flange_tool=TAUGHT)
Q_START = np.radians([2.3, -124.4, -70.9, 107.7, -91.1, 91.8])


def plan_of(
    source: TrueInput = PERFECT, noise: TrueNoise = NO_NOISE, error_m: float = 0.0, **changes
) -> CellPlan:
    """A bent pin; without noise and lag unless one is given."""
    settings = {
        "robot": rigid_robot(ARM, error_m, np.random.default_rng(5)),
        "station": make_cell(source=source, noise=noise).station,
        "tool": RoundTool.cylinder(TRUTH, 0.0025),
        "q_start": Q_START,
        "ripple": 0.0,
        "lag_s": 0.0,
    }
    return CellPlan(**(settings | changes))


def driven(cell: SimulatedCell, step) -> Happened:
    """A step by the robot's program, and a little rest."""
    cell.drive(step)
    return cell.advance(cell.motion.end_s + 0.2)


def measured(
    cell: SimulatedCell,
    laser: LaserFrame,
    noise: RobotNoise,
    taught: np.ndarray = TAUGHT,
    spin_rad: float = 0.0,
) -> tuple[ToolEstimate, list[int]]:
    """A whole run with each step driven as it follows from those before; edges of each step."""
    plan, arm = MeasuringPlan("full", laser, taught, spin_rad=spin_rad), cell.plan.arm
    steps, time, q, seen = [], [], [], None

    def estimate(held: Held) -> ToolEstimate:
        path = JointPath(arm, np.concatenate(time), np.concatenate(q))
        return estimate_tool(laser, path, steps, taught, noise=noise, held=held)

    for number in range(1, len(plan.names) + 1):
        if plan.needs_tool(number):
            seen = estimate(Held(along_m=5e-3)).T_flange_tool
        step = plan.step(number, seen)
        came = driven(cell, step)
        steps.append(BeamStep(step.name, step.kind, came.edges))
        time.append(came.time_s)
        q.append(came.q)
    return estimate(Held()), [len(step.edges) for step in steps]
