"""A simulated cell: robot, tool and beam station as one node (docs/cell_sim_node.md)."""

from pathlib import Path
from typing import Any

import numpy as np
from robocal_msgs.msg import ToolStep
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.cell_sim.cell import SimulatedCell
from robocal_ros.cell_sim.cell_plan import known_laser, worked_for
from robocal_ros.cell_sim.controller import SimulatedController
from robocal_ros.cell_sim.outputs import CellOutputs, planned_step, trajectory_of
from robocal_ros.cell_sim.settings import SETTINGS, at_station, bent_tool, cell_plan, laser_pose
from robocal_ros.cell_sim.stations import TICK_S
from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.files import write_text
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode
from robocal_ros.ros.endpoints import WARN, Health
from robocal_ros.ros.run import run
from robocal_ros.tool.measuring_plan import PlannedStep

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
            there = at_station(settings, plan)
            points = known_laser(plan, laser_pose(settings), there, rng)
            rows = [f"{name},{_mm(place)}\n" for name, place in sorted(points.items())]
            write_text(Path(settings["laser_csv"]), "point,x_mm,y_mm,z_mm\n" + "".join(rows))
        self._out = CellOutputs(self.add_output, settings, self._cell)
        self._controller.open(self._cell)
        self.add_input(JointTrajectory, "~/truth/commanded", self._judge, endpoints.RELIABLE)
        if settings["run_program"]:
            self.add_input(ToolStep, "next_step", self._await_step, endpoints.LATCHED)
        self._refused = ""
        self.add_timer(TICK_S, self._tick, steady=True)

    def activate(self) -> None:
        """The cell goes on from where it stood."""
        self._origin_ns = None
        self._step: PlannedStep | None = None
        self._driven: tuple[int, int] | None = None
        self._fault: tuple[str, float] = ("none", 0.0)
        self._out.forget()
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

    # ---- what comes in --------------------------------------------------------------------------

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
        faults = cell.motion.faults
        came = cell.advance((now_ns - self._origin_ns) * 1e-9)
        if cell.motion.faults > faults:
            self.get_logger().error(cell.motion.fault)
        self._out.tell_truth(now_ns)
        self._out.tell(came, self._stamp_ns)
        self._controller.tell_state(self._stamp_ns(cell.now_s))

    def _drive(self, cell: SimulatedCell, step: PlannedStep) -> None:
        self._step, self._refused = None, ""
        try:
            cell.drive(step)
        except RobocalError as error:
            self._refused = str(error)
            self.get_logger().error(self._refused)

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


def _mm(place: Any) -> str:
    return ",".join(f"{1e3 * x:.6f}" for x in place)


def main() -> None:
    """Run the node."""
    run(CellSimNode, events=True)
