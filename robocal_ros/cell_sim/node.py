# SPDX-License-Identifier: Apache-2.0
"""Parameters of the simulated cell."""

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from robocal_msgs.msg import ToolStep
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.cell_sim.beams import BeamStation, RoundTool, TrueInput, TrueNoise, beams_of, bent
from robocal_ros.cell_sim.cell import (
    T_BASE_LASER,
    CellPlan,
    SimulatedCell,
    known_laser,
    kr150_cell,
    poses,
    rigid_robot,
    worked_for,
)
from robocal_ros.cell_sim.faults import CONTROLLER_FAULTS, FAULTS
from robocal_ros.cell_sim.gears import gear_errors, ur10_gears
from robocal_ros.cell_sim.messages import (
    CellOutputs,
    SimulatedController,
    planned_step,
    trajectory_of,
)
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.cell_sim.sensors import TICK_S
from robocal_ros.cell_sim.trajectory_controller import LAG_S, ControllerOptions
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.files import write_text
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.motion.driver import MANDREL
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.endpoints import WARN, Health
from robocal_ros.ros.parameters import Setting, given_pose, number
from robocal_ros.tool.run import PlannedStep

MM, MS = 1e-3, 1e-3
PIN_M = 0.15  # tip of the straight tool along the flange's z, where the robot file has no tool
TAPER = 0.1  # of the cone
NOZZLE_M = 3.5e-3  # by so much the torch's nozzle is wider than its wire
TOOLS = ("cylinder", "cone", "torch")
CELLS = ("tool", "kr150")
KR150, UR10 = "kr150_r3100", "UR10"


def _numbers(count: int) -> Callable[[Any], str | None]:
    return lambda values: None if len(values) == count else f"not {count} numbers"


SETTINGS = (
    Setting(
        "cell",
        "tool",
        "tool: a robot that stays cold, at a beam station, as the parameters describe it; kr150: a "
        "whole cell with a KR 150 that warms up, a sphere sensor and a beam station",
        choices=CELLS,
    ),
    Setting(
        "robot",
        "ur10",
        "Robot type (config/robots) or path of a robot file; its tool is the straight one, 150 mm "
        "along the flange's z where it has none",
    ),
    number(
        "q_start_deg",
        [2.3, -124.4, -70.9, 107.7, -91.1, 91.8],
        "Where the robot stands first, tool above the station (sliding joint: mm)",
        -1e5,
        1e5,
    ),
    number("rate_hz", 125.0, "Rate of joint_states", 1.0, 1000.0),
    Setting(
        "velocities",
        False,
        "The robot reports velocities; false: they are NaN in joint_states and absent in "
        "~/controller_state, as of hardware that has positions alone",
    ),
    Setting(
        "spindle",
        False,
        "joint_states name a spindle too, whose velocity alone is known: its position is NaN",
    ),
    Setting(
        "limits",
        False,
        "Drives refuse a command that is more than 5 % faster than their greatest speed; nobody "
        "behind a real controller does by default",
    ),
    number("lag_ms", 1e3 * LAG_S, "By so much the drives are behind their command", 0.0, 200.0),
    *(
        Setting(name, getattr(ControllerOptions(), name), f"Of the controller: {what}")
        for name, what in (
            ("allow_partial_joints_goal", "take trajectories for some of the joints"),
            ("allow_nonzero_velocity_at_trajectory_end", "take those that end in motion"),
            ("interpolate_from_desired_state", "begin at the last command, not where the robot is"),
        )
    ),
    *(
        Setting(name, 0.0, f"Of the controller, of every joint: {what}", low=0.0, high=100.0)
        for name, what in (
            ("trajectory", "greatest error on the way, rad (sliding: m); 0: no check"),
            ("goal", "greatest error at the end, rad (sliding: m); 0: no check"),
            ("goal_time", "how long a goal may be out of that, s; 0: for ever"),
        )
    ),
    number(
        "arm_error_mm",
        0.0,
        "Scatter of the true arm's lengths; angles err as much at 1 m",
        0.0,
        5.0,
    ),
    number("repeatability_mm", 0.03, "Scatter of a motion in each axis", 0.0, 2.0),
    number("edge_noise_mm", 0.01, "Further scatter at each edge", 0.0, 2.0),
    number("ripple", 0.02, "Relative ripple of the program's speed", 0.0, 0.5),
    Setting(
        "warm_h",
        0.0,
        "The kr150 has worked for so long when it begins",
        unit="h",
        low=0.0,
        high=100.0,
    ),
    number("warm_up", 1.0, "Heat of the kr150, over the usual", 0.0, 10.0, live=True),
    number(
        "cloud_points",
        2000,
        "Of a sphere's cloud of the kr150; 0: its centre is told instead",
        0,
        100_000,
    ),
    Setting("gears", True, "The robot's gears err as real ones do, and have backlash"),
    Setting("sensor_frame", "sensor", "Frame of the sphere sensor"),
    Setting("profile", False, "A line laser on the flange of the kr150"),
    Setting("fixture", False, "A fixture of the kr150, and a sensor on the flange that finds it"),
    Setting("profile_frame", "profile_sensor", "Frame of the line laser"),
    Setting("station", "station", "Name of the beam station: frame_id of its edges"),
    number(
        "laser_xyz_mm",
        [799.4, -126.3, 194.5],
        "True crossing of the beams in base",
        -1e5,
        1e5,
        check=_numbers(3),
    ),
    number(
        "laser_rotation_deg",
        [1.2, -2.3, 0.6],
        "True rotation vector of the laser frame in base",
        -180.0,
        180.0,
        check=_numbers(3),
    ),
    number("beam_angle_deg", 92.2, "True angle of the beams", 40.0, 140.0),
    number("beam_gap_mm", 0.058, "By so much the y-beam passes above the x-beam", -2.0, 2.0),
    Setting(
        "laser_csv",
        "",
        "File to which the robot's calibration of the station is written (robocal tool beams); "
        "empty: none",
    ),
    Setting("tool", "cylinder", "Shape of the tool", choices=TOOLS),
    number("tool_radius_mm", 2.5, "Of cylinder, cone's tip, or torch's wire", 0.1, 20.0),
    number(
        "tool_bend_mm",
        [0.0, 0.0, 0.0],
        "Shift of the true tip from the straight tool's, flange axes",
        -50.0,
        50.0,
        check=_numbers(3),
        live=True,
    ),
    number(
        "tool_tilt_deg",
        [0.0, 0.0],
        "Tilt of the true tool about the flange's x and y",
        -45.0,
        45.0,
        check=_numbers(2),
        live=True,
    ),
    *MANDREL,
    number("input_latency_ms", 4.0, "Constant delay of an edge's stamp", 0.0, 1000.0),
    number("input_jitter_ms", 0.02, "Scatter of an edge's stamp", 0.0, 10.0),
    number("input_period_ms", 0.0, "How often the input is read; 0: by interrupt", 0.0, 100.0),
    number("input_bounce_ms", 0.0, "For how long a contact may bounce", 0.0, 20.0),
    Setting("run_program", False, "Drive each step that is announced on next_step"),
    Setting("flange_frame", "tool0", "Parent frame of ~/truth"),
    Setting("tool_frame", "true_tool", "Child frame of ~/truth"),
    Setting("fault", "none", "What goes wrong", choices=(*FAULTS, *CONTROLLER_FAULTS), live=True),
    number(
        "fault_size",
        0.0,
        "Its size, in the unit that belongs to it; 0: the usual one",
        -1e4,
        1e4,
        live=True,
    ),
    number("seed", 1, "Of everything that is random", 0, 2**31 - 1),
)


def straight_arm(name: str) -> SerialArm:
    """The nominal robot with its straight tool."""
    arm = load_robot(name)
    if not np.array_equal(arm.T_flange_tool, np.eye(4)):
        return arm
    return replace(arm, T_flange_tool=frames.transform(np.eye(3), [0.0, 0.0, PIN_M]))


def bent_tool(settings: Mapping[str, Any], plan: CellPlan) -> RoundTool:
    """The tool as it is mounted, and the mandrel, which is where its certificate says."""
    shift = np.array(settings["tool_bend_mm"]) * MM
    tilt = np.radians([*settings["tool_tilt_deg"], 0.0])
    tool = plan.tool.mounted(bent(plan.arm.T_flange_tool, shift, tilt))
    T_flange_mandrel = given_pose(settings, "mandrel")
    if T_flange_mandrel is None:
        return tool
    length_m, radius_m = (settings[f"mandrel_{of}_mm"] * MM for of in ("length", "radius"))
    return replace(tool, mandrel=RoundTool.cylinder(T_flange_mandrel, radius_m, length_m))


def laser_pose(settings: Mapping[str, Any]) -> Array:
    """T_base_laser (4, 4), true."""
    if settings["cell"] == "kr150":
        return T_BASE_LASER
    R = frames.exp_rotation(np.radians(settings["laser_rotation_deg"]))
    return frames.transform(R, np.array(settings["laser_xyz_mm"]) * MM)


def cell_plan(settings: Mapping[str, Any]) -> CellPlan:
    """The cell that the parameters describe.

    Raises `InputError` when ``q_start_deg`` has not a number for each joint.
    """
    seed = settings["seed"]
    if settings["cell"] == "kr150":
        plan = kr150_cell(
            load_robot(KR150),
            seed,
            Effects(gears=settings["gears"]),
            points=settings["cloud_points"],
            profile=settings["profile"],
            fixture=settings["fixture"],
        )
    else:
        plan = _tool_cell(settings)
    source = TrueInput(
        latency_s=settings["input_latency_ms"] * MS,
        jitter_s=settings["input_jitter_ms"] * MS,
        sample_period_s=settings["input_period_ms"] * MS,
        bounce_s=settings["input_bounce_ms"] * MS,
    )
    return replace(
        plan,
        station=replace(plan.station, input=source),
        rate_hz=settings["rate_hz"],
        tool=bent_tool(settings, plan),
        ripple=settings["ripple"],
        limits=settings["limits"],
        lag_s=settings["lag_ms"] * MS,
        controller=ControllerOptions(
            velocity_states=settings["velocities"],
            **{of.name: settings[of.name] for of in fields(ControllerOptions)[1:]},
        ),
        seed=seed,
    )


def _tool_cell(settings: Mapping[str, Any]) -> CellPlan:
    """A robot that stays cold, at a beam station."""
    arm = straight_arm(settings["robot"])
    given = np.array(settings["q_start_deg"], dtype=np.float64)
    if given.shape != (arm.n,):
        raise InputError(f"q_start_deg has {given.size} numbers, {arm.name} has {arm.n} joints")
    gap_m, angle = settings["beam_gap_mm"] * MM, float(np.radians(settings["beam_angle_deg"]))
    noise = TrueNoise(settings["repeatability_mm"] * MM, settings["edge_noise_mm"] * MM)
    rng = np.random.default_rng([settings["seed"], 1])
    T, radius = arm.T_flange_tool, settings["tool_radius_mm"] * MM
    if settings["tool"] == "cone":
        tool = RoundTool.cone(T, radius, TAPER)
    elif settings["tool"] == "torch":
        tool = RoundTool.torch(T, radius, radius + NOZZLE_M)
    else:
        tool = RoundTool.cylinder(T, radius)
    robot = rigid_robot(arm, settings["arm_error_mm"] * MM, rng)
    if settings["gears"]:
        gears = ur10_gears() if arm.name == UR10 else gear_errors(arm.n, rng)
        robot = replace(robot, gears=gears, effects=replace(robot.effects, gears=True))
    return CellPlan(
        robot=robot,
        station=BeamStation(beams_of(laser_pose(settings), angle, gap_m), noise=noise),
        tool=tool,
        q_start=np.where(arm.prismatic, given * MM, np.radians(given)),
        fastest=np.nan_to_num(load_description(settings["robot"]).max_velocity, nan=np.inf),
    )


BEHIND_S = 1.0  # a longer pause of the process, or a jump of its clock, is none of the cell's


class CellSimNode(HouseNode):
    """Lets a `SimulatedCell` live in the node's time."""

    NAME = "cell_sim_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._cell: SimulatedCell | None = None
        self._origin_ns: int | None = None
        self._controller = SimulatedController(
            self, "~/follow_joint_trajectory", self._tick, lambda: self._origin_ns or 0
        )

    def configure(self) -> None:
        """Build the cell, let its robot place the beams, then open the topics."""
        settings = self.settings
        plan = cell_plan(settings)
        self._cell = SimulatedCell(plan)
        if self._cell.heating:
            self._cell.heating.warmth = worked_for(settings["warm_h"])
        if settings["laser_csv"]:
            rng = np.random.default_rng([settings["seed"], 2])
            # Above the beams.
            there = poses("tool")[0] if settings["cell"] == "kr150" else plan.q_start
            points = known_laser(plan, laser_pose(settings), there, rng)
            rows = [
                f"{name},{','.join(f'{1e3 * x:.6f}' for x in place)}\n"
                for name, place in sorted(points.items())
            ]
            write_text(Path(settings["laser_csv"]), "point,x_mm,y_mm,z_mm\n" + "".join(rows))
        self._out = CellOutputs(self.add_output, settings, self._cell)
        self._controller.open(self._cell)
        self.add_input(JointTrajectory, "~/truth/commanded", self._judge, endpoints.RELIABLE)
        if settings["run_program"]:
            self.add_input(ToolStep, "next_step", self._await_step, endpoints.LATCHED)
        self._refused = ""
        self._fault: tuple[str, float] = ("none", 0.0)
        self.add_timer(TICK_S, self._tick, steady=True)

    def activate(self) -> None:
        """The cell goes on from where it stood."""
        self._origin_ns = None
        self._step: PlannedStep | None = None
        self._driven: tuple[int, int] | None = None
        self._out.forget()
        self._out.describe()
        self.settings_changed()

    def deactivate(self) -> None:
        """The robot stands still."""
        self._controller.deactivate()

    def cleanup(self) -> None:
        """The cell is gone."""
        self._controller.close()
        self._cell = None

    def close(self) -> None:
        """At the end of the process."""
        super().close()
        self._controller.destroy()

    def settings_changed(self) -> None:
        """Another fault, another bend, another heat."""
        cell, settings = self._cell, self.settings
        if cell is None:
            return
        fault = settings["fault"], settings["fault_size"]
        if fault != self._fault:
            cell.set_fault(*fault)
            self._fault = fault
        cell.next_tool = bent_tool(settings, cell.plan)
        if cell.heating:
            cell.heating.level = settings["warm_up"]

    def _judge(self, message: Any) -> None:
        """A trajectory of the programme: the truth tells what would come of it.

        A point belongs to the working pose that it is near to; others are on the way.
        """
        cell = self._cell
        if cell is None:
            return
        names, given = cell.plan.arm.joint_names, trajectory_of(message, 0)
        if sorted(given.names) != sorted(names):
            raise InputError(f"a trajectory for {', '.join(given.names)}, not {', '.join(names)}")
        q = given.q[:, [given.names.index(name) for name in names]]
        which, points = cell.plan.at_work(q)
        if len(which):
            self._out.commanded = which, q[points]

    def _await_step(self, message: Any) -> None:
        if message.kind == ToolStep.NONE:
            self._step = self._driven = None
        elif self._driven != (message.run, message.number):
            self._step = planned_step(message)
            self._driven = message.run, message.number

    def _tick(self) -> None:
        cell, now_ns = self._cell, self.now_ns()
        if cell is None or now_ns <= 0:
            return
        cell_ns = round(cell.now_s * 1e9)
        if self._origin_ns is None or not 0 <= now_ns - self._origin_ns - cell_ns < BEHIND_S * 1e9:
            self._origin_ns = now_ns - cell_ns
        if self._step is not None and not cell.moving:
            step, self._step, self._refused = self._step, None, ""
            try:
                cell.drive(step)
            except RobocalError as error:
                self._refused = str(error)
                self.get_logger().error(self._refused)
        faults = cell.motion.faults
        came = cell.advance((now_ns - self._origin_ns) * 1e-9)
        if cell.motion.faults > faults:
            self.get_logger().error(cell.motion.fault)
        self._out.tell_truth(now_ns)
        self._out.tell(came, self._stamp_ns)
        self._controller.tell_state(self._stamp_ns(cell.now_s))

    def _stamp_ns(self, time_s: float) -> int:
        return (self._origin_ns or 0) + round(time_s * 1e9)

    def health(self) -> Health:
        """Tell that all of it is simulated, and what goes wrong on purpose."""
        cell, health = self._cell, Health(message="simulated")
        if cell is None:
            return health
        if self._refused:
            health.worsen(WARN, self._refused)
        if cell.motion.faults:
            health.worsen(WARN, cell.motion.fault)
        if cell.faults.sizes:
            health.worsen(WARN, f"simulated fault: {', '.join(cell.faults.sizes)}")
        health.values = {"moving": cell.moving, "drive faults": cell.motion.faults}
        health.values |= {f"{topic} sent": count for topic, count in self._out.told.items()}
        return health


def main() -> None:
    """Run the node."""
    run(CellSimNode, events=True)
