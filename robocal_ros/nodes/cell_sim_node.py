"""A simulated cell: robot, tool and beam station as one node (docs/cell_sim_node.md)."""

from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.core.errors import RobocalError
from robocal_ros.core.tool.measuring_plan import PlannedStep
from robocal_ros.nodes import qos
from robocal_ros.nodes.base import HouseNode
from robocal_ros.nodes.cell_sim_messages import (
    beam_event,
    in_joint_order,
    joint_state,
    planned_step,
)
from robocal_ros.nodes.cell_sim_settings import (
    SETTINGS,
    bent_tool,
    cell_plan,
    laser_pose,
    straight_arm,
)
from robocal_ros.nodes.conversions import header, transform_message
from robocal_ros.nodes.diagnostics import WARN, Health
from robocal_ros.nodes.run import run
from robocal_ros.sessions.correction.inputs import trajectory_command
from robocal_ros.sim.beams import RoundTool
from robocal_ros.sim.cell import TICK_S, SimulatedCell
from robocal_ros.sim.cell_plan import known_laser
from robocal_ros.storage.files import write_text

BEHIND_S = 1.0  # a longer pause of the process, or a jump of its clock, is none of the cell's
OTHER_STATION = "_other"


class CellSimNode(HouseNode):
    """Lets a `SimulatedCell` live in the node's time."""

    NAME = "cell_sim_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._cell: SimulatedCell | None = None

    def configure(self) -> None:
        """Build the cell, let its robot place the beams, then open the topics."""
        settings = self.settings
        self._arm = straight_arm(settings["robot"])
        plan = cell_plan(settings, self._arm)
        self._cell = SimulatedCell(plan)
        if settings["laser_csv"]:
            rng = np.random.default_rng([settings["seed"], 2])
            points = known_laser(plan, laser_pose(settings), rng)
            rows = [f"{name},{_mm(place)}\n" for name, place in sorted(points.items())]
            write_text(Path(settings["laser_csv"]), "point,x_mm,y_mm,z_mm\n" + "".join(rows))
        self._joints = self.add_output(JointState, "joint_states", qos.RELIABLE)
        self._edges = self.add_output(BeamEvent, "beam_events", qos.RELIABLE)
        self._truth = self.add_output(TransformStamped, "~/truth", qos.LATCHED)
        self.add_input(JointTrajectory, "joint_trajectory", self._follow, qos.RELIABLE)
        if settings["run_program"]:
            self.add_input(ToolStep, "next_step", self._await_step, qos.LATCHED)
        self._told, self._edges_told, self._refused = 0, 0, ""
        self.add_timer(TICK_S, self._tick, steady=True)

    def activate(self) -> None:
        """The cell goes on from where it stood."""
        self._origin_ns: int | None = None
        self._step: PlannedStep | None = None
        self._driven: tuple[int, int] | None = None
        self._shown: RoundTool | None = None
        self.settings_changed()

    def deactivate(self) -> None:
        """The robot stands still."""
        if self._cell is not None:
            self._cell.hold()

    def cleanup(self) -> None:
        """The cell is gone."""
        self._cell = None

    def settings_changed(self) -> None:
        """Another fault, or another bend: each from the next motion on."""
        if self._cell is not None:
            self._cell.set_fault(self.settings["fault"])
            self._cell.next_tool = bent_tool(self.settings, self._arm)

    # ---- what comes in --------------------------------------------------------------------------

    def _follow(self, message: Any) -> None:
        cell = self._cell
        self._tick()
        if cell is None or self._origin_ns is None:
            return
        if not message.points:
            cell.hold()
            return
        command = trajectory_command(message)
        start_s = cell.now_s
        if command.stamp_ns:
            start_s = (command.stamp_ns - self._origin_ns) * 1e-9
        q, qd, qdd = in_joint_order(command, self._arm)
        cell.follow(start_s + command.time_from_start_s, q, qd, qdd)

    def _await_step(self, message: Any) -> None:
        if message.kind == ToolStep.NONE:
            self._step = self._driven = None
        elif self._driven != (message.run, message.number):
            self._step = planned_step(message)
            self._driven = message.run, message.number

    # ---- time -----------------------------------------------------------------------------------

    def _tick(self) -> None:
        cell, now_ns = self._cell, self.now_ns()
        if cell is None or now_ns <= 0:
            return
        cell_ns = round(cell.now_s * 1e9)
        if self._origin_ns is None or not 0 <= now_ns - self._origin_ns - cell_ns < BEHIND_S * 1e9:
            self._origin_ns = now_ns - cell_ns
        if self._step is not None and not cell.moving:
            self._drive(cell, self._step)
        came = cell.advance((now_ns - self._origin_ns) * 1e-9)
        self._show_truth(cell, now_ns)
        self._tell_joints(came.time_s, came.q, came.qd)
        station = self.settings["station"]
        if "wrong_station" in cell.faults:
            station += OTHER_STATION
        for edge in came.edges:
            self._edges.publish(beam_event(edge, self._stamp_ns(edge.time_s), station))
        self._edges_told += len(came.edges)

    def _drive(self, cell: SimulatedCell, step: PlannedStep) -> None:
        self._step, self._refused = None, ""
        try:
            cell.drive(step)
        except RobocalError as error:
            self._refused = str(error)
            self.get_logger().error(self._refused)

    def _stamp_ns(self, time_s: float) -> int:
        return (self._origin_ns or 0) + round(time_s * 1e9)

    # ---- what goes out --------------------------------------------------------------------------

    def _tell_joints(self, time_s: Any, q: Any, qd: Any) -> None:
        names = list(self._arm.joint_names)
        for t, position, velocity in zip(time_s.tolist(), q, qd, strict=True):
            self._joints.publish(joint_state(names, self._stamp_ns(t), position, velocity))
            self._told += 1

    def _show_truth(self, cell: SimulatedCell, now_ns: int) -> None:
        if self._shown is cell.tool:
            return
        self._shown = cell.tool
        message = TransformStamped(
            header=header(now_ns, self.settings["flange_frame"]),
            child_frame_id=self.settings["tool_frame"],
            transform=transform_message(cell.tool.T_flange_tool),
        )
        self._truth.publish(message)

    def health(self) -> Health:
        """Tell that all of it is simulated, and what goes wrong on purpose."""
        cell, health = self._cell, Health(message="simulated")
        if cell is None:
            return health
        if self._refused:
            health.worsen(WARN, self._refused)
        if cell.faults.sizes:
            health.worsen(WARN, f"simulated fault: {', '.join(cell.faults.sizes)}")
        health.values = {
            "moving": cell.moving,
            "joint states sent": self._told,
            "beam events sent": self._edges_told,
        }
        return health


def _mm(place: Any) -> str:
    return ",".join(f"{1e3 * x:.6f}" for x in place)


def main() -> None:
    """Run the node."""
    run(CellSimNode)
