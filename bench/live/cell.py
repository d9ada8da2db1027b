# SPDX-License-Identifier: Apache-2.0
"""The cell before its shift: commissioned while it was cold, in one process. Simulated.

What a person does once in a real cell is done by the sessions of the nodes on the simulated robot
(`bench.closed_loop`): the sphere sensor is placed, the cold reference captured, the beams placed,
the healthy tool measured. It is left in a state folder, as the nodes would leave it.
"""

import json
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
from rcl_interfaces.srv import SetParametersAtomically

from bench.cell_samples import CellSamples
from bench.closed_loop import setting
from bench.closed_loop.plant import Plant
from bench.closed_loop.suite import Suite
from bench.live.graph import LiveError
from robocal_ros.cell_sim.cell import SimulatedCell, kr150_cell
from robocal_ros.cell_sim.faults import Fault
from robocal_ros.ground.files import share_folders
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_description, load_robot, save_robot
from robocal_ros.tool.laser_frame import LaserFile, write_laser

ROBOT, SERIAL = "kr150_r3100", setting.SERIAL
PARAMETERS = share_folders("robocal_ros", "config/cells", "config/cells")[0] / "kr150_shift.yaml"
SEED = 1
WARM_H = 3.0  # so long ago the cell was commissioned and began to work
PROGRAM, CONTROLLER = "/program/joint_trajectory", "/robot/joint_trajectory"
RECORDED = "joint_trajectory_controller/joint_trajectory"  # by default
TRUTH = "/cell_sim_node/truth/state"
TOLERANCE_MM = 0.5  # the bound of a measured tool, with the default prior, is some 0.3 mm
SHARE = 0.95  # of what the drives reach
BRISK_DEG_S2 = [573.0] * 3 + [1000.0] * 3  # with a light tool, stops too
LATE_S = 0.6  # joint states may come so late: this machine may have other work too


@dataclass(frozen=True)
class Commissioned:
    """Files that the commissioning left: histories in ``state``, beams, calibrated cold robot."""

    state: Path
    laser: Path
    reference: Path


def commission(folder: Path) -> Commissioned:
    """Commission the cold cell, `WARM_H` hours ago.

    Raises
    ------
    RobocalError
        When a step is refused.
    """
    made = Commissioned(folder / "state", folder / "laser.yaml", folder / "reference.yaml")
    nominal = load_robot(ROBOT)
    cell = SimulatedCell(kr150_cell(nominal, SEED))
    laser = setting.laser_of(cell.plan)
    placed = LaserFile(laser, setting.STATION, nominal.name, nominal.model_hash, SERIAL)
    write_laser(made.laser, placed)
    with CalibrationHistory.open(
        SERIAL, model_hash=nominal.model_hash, state_dir=made.state
    ) as history:
        plant = Plant(cell, None)
        plant.samples = CellSamples(
            nominal.joint_names,
            setting.THERMAL.sphere,
            start_ns=time.time_ns() - round(WARM_H * 3600e9),
            station=setting.STATION,
            frame=setting.FRAME,
        )
        plant.suite = suite = Suite(nominal, history, laser, plant.send)
        plant.commission()
        if suite.thermal.reference is not None:
            save_robot(suite.thermal.reference.cell.arm, made.reference)
    return made


def write_settings(made: Commissioned, recordings: Path, path: Path) -> None:
    """Write the parameters of each node beside `PARAMETERS`."""
    from robocal_ros.bags.recorder_node import TOPICS

    motion: dict[str, object] = {"motion_silence_s": 0.5, "motion_late_s": LATE_S}
    motion |= {"deviation_mm": 5.0}  # at 1.5 m/s, where the usual 2 mm go with 0.25 m/s
    drives = load_description(ROBOT)
    motion |= {
        "laser": str(made.laser),
        "joint_velocity_deg_s": (SHARE * np.degrees(drives.max_velocity)).tolist(),
        "joint_acceleration_deg_s2": BRISK_DEG_S2,
        "stop_deceleration_deg_s2": BRISK_DEG_S2,
    }
    nodes: dict[str, dict[str, object]] = {
        "cell_sim_node": {"seed": SEED, "warm_h": WARM_H, "laser_csv": ""},
        "recorder_node": {"folder": str(recordings), "topics": [*TOPICS, TRUTH]},
        "thermal_node": {"tolerance_mm": TOLERANCE_MM},
        "tcf_node": motion
        | {"joint_silence_s": LATE_S, "circle_speed_mm_s": 80.0, "plunge_speed_mm_s": 20.0},
        "joint_correction_node": {"reference": str(made.reference), "joint_state_age_s": LATE_S},
        "maintenance_node": motion
        | {"auto_accept": True, "accept_tool_mm": 3.0}
        | {"tolerance_mm": TOLERANCE_MM, "travel_speed_mm_s": 1500.0},
    }
    document = {f"/**/{name}": {"ros__parameters": given} for name, given in nodes.items()}
    path.write_text(json.dumps(document, indent=1), encoding="utf-8")  # which is YAML too


def set_fault(call: Callable[..., Any], fault: Fault, size: float = 0.0) -> None:
    """Let something go wrong, see `SimulatedCell.set_fault`; ``call`` calls a service.

    Raises
    ------
    LiveError
        When the simulator refuses.
    """
    amount = ParameterValue(type=ParameterType.PARAMETER_DOUBLE, double_value=size)
    name = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=fault)
    parameters = [Parameter(name="fault_size", value=amount), Parameter(name="fault", value=name)]
    # at once: a size by itself would be that of the fault before
    service = "/cell_sim_node/set_parameters_atomically"
    result = call(SetParametersAtomically, service, parameters=parameters).result
    if not result.successful:
        raise LiveError(f"no {fault}: {result.reason}")


def wiring() -> Mapping[str, Mapping[str, str]]:
    """The nodes, and where their topics lead."""
    out = {"~/joint_trajectory": CONTROLLER}
    corrects = {
        "joint_trajectory": PROGRAM,
        "kinematic_model": "/thermal_node/model",
        "tool": "/tcf_node/tool",
    }
    return {
        "cell_sim_node": {"joint_trajectory": CONTROLLER, "~/truth/commanded": CONTROLLER},
        "recorder_node": {"joint_trajectory": PROGRAM, RECORDED: CONTROLLER},
        "thermal_node": {},
        "tcf_node": out,
        "joint_correction_node": out | corrects,
        "maintenance_node": out,
    }
