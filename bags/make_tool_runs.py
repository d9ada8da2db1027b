# SPDX-License-Identifier: Apache-2.0
"""Make the golden tool bag: ``python bags/make_tool_runs.py``, ``tool_runs.mcap``.

Simulated: a UR10 with a pin, its gears as a real one's, with backlash, two crossed beams, an input
that is read every 2 ms and lags by 4 ms.
The healthy tool is measured as reference and passes a quick check; somebody bumps it; the quick
check says so; in the next run an edge is lost, which is refused; the one after it measures the bent
tool, which is accepted and passes. The bag holds:

- ``joint_states``, ``beam_events``: what the robot and the input say;
- ``/tcf_node/session_events``: what a tool session made of it, for ``robocal replay``;
- ``/truth/tool``: for judging only: the true tool, from when on.
"""

import json
import sys
import tempfile
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from session_events import EventLog

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))  # for the bench

from bench.measured_runs import (
    BETA_RAD,
    GAP_M,
    Q_NEAR,
    T_BASE_LASER,
    TAUGHT,
    RobotProgram,
    Sample,
    ToolCell,
    laser_of,
)
from bench.tool_erring import ErringStation, geared
from robocal_ros import __version__
from robocal_ros.bags.bags import BagWriter
from robocal_ros.cell_sim.beams import RoundTool, TrueInput, TrueNoise, beams_of, bent
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.gears import ur10_gears
from robocal_ros.ground import frames
from robocal_ros.ground.samples import JointSample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.edges import BREAK, EDGES, RESTORE, BeamEdge, InputRule, ParallelStation
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.run import PlannedStep, ToolConfig, rows_of
from robocal_ros.tool.session import ToolSession, configuration

BAG = Path(__file__).with_name("tool_runs.mcap")
SEED = 11
START_NS = 1_790_000_000_000_000_000
STATION = "north"
RADIUS_M = 2.5e-3
BENT = bent(TAUGHT, [0.003, -0.002, 0.001], [0.02, 0.03, 0.0])  # 100 mm above the tip
INPUT = TrueInput(latency_s=0.004, sample_period_s=0.002)
NOISE = TrueNoise(3e-5, 1e-5)
JOINTS, EVENTS, TRUTH = "joint_states", "/tcf_node/session_events", "/truth/tool"
BY = "cell controller"


def lose_an_edge(step: PlannedStep, edges: list[BeamEdge]) -> list[BeamEdge]:
    """The input misses one edge of the second circle."""
    return [e for i, e in enumerate(edges) if step.name != "high" or i != 3]


class Recorder:
    """A cell, its tool session, and the bag in which all of it is written."""

    def __init__(
        self,
        bag: BagWriter,
        history: CalibrationHistory,
        mandrel: np.ndarray | None = None,
        parallel: ParallelStation | None = None,
    ) -> None:
        arm = load_robot("ur10")
        true = rigid_robot(arm, 0.0, np.random.default_rng(SEED))
        effects = replace(true.effects, gears=True)
        robot = geared(replace(true, gears=ur10_gears(), effects=effects))
        beams = beams_of(T_BASE_LASER, BETA_RAD, GAP_M)
        station = ErringStation(beams, INPUT, NOISE, robot)
        # Where the robot, which found them near the station, takes the beams to be.
        T_taken_true = arm.fk(Q_NEAR) @ frames.invert(robot.true(Q_NEAR[None])[0])
        points = frames.apply(T_taken_true, laser_of(station).points)
        # To the bits that come back from a laser file, which is in millimetres.
        laser = LaserFrame(1e-3 * (points * 1e3))
        cell = ToolCell(arm, station, laser, Q_NEAR)
        config = ToolConfig(
            points_m=rows_of(laser.points),
            taught=rows_of(TAUGHT),
            station=STATION,
            input=InputRule(sample_period_s=INPUT.sample_period_s),
            mandrel=None if mandrel is None else rows_of(mandrel),
            mandrel_radius_m=RADIUS_M,
            parallel=parallel,
        )
        self.session = ToolSession(arm, history, config, __version__)
        healthy = RoundTool.cylinder(TAUGHT, RADIUS_M)
        rng = np.random.default_rng(SEED)
        self.program = RobotProgram(cell, healthy, rng, START_NS, STATION)
        self._bag, self._now_ns = bag, START_NS
        self._events = EventLog(bag, EVENTS)
        self._shown: tuple[int, ...] | None = None
        self._show_in_force()

    def run(self, mode: str, cycle_id: str) -> Outcome:
        """A run with all its steps; the outcome of the last."""
        self.rest(0.5)
        outcome = self.command(events.MEASURE_TOOL, mode=mode, cycle_id=cycle_id, by=BY)
        while outcome.done and (step := self.session.awaited) is not None:
            taken = self.give(self.program.drive(step))
            while taken is None:  # a program waits for the next step
                taken = self.give(self.program.rest(0.25))
            outcome = taken
        print(f"{cycle_id}: {outcome.status.name} {outcome.message}")
        return outcome

    def command(self, name: str, **arguments: Any) -> Outcome:
        """Give a command to the session, and record what came of it."""
        return self._carry_out(Command(name, arguments))

    def rest(self, seconds: float) -> None:
        """Stand still."""
        self.give(self.program.rest(seconds))

    def truth(self, tool: np.ndarray) -> None:
        """Mount another tool."""
        self.program.tool = self.program.tool.mounted(tool)
        told = {"simulated": True, "T_flange_tool": tool.tolist(), "time_s": self.program.now_s}
        self._write(TRUTH, "std_msgs/msg/String", {"data": json.dumps(told)})

    def give(self, samples: list[Sample]) -> Outcome | None:
        """Samples, each written and given to the session; what followed from the last of them."""
        last = None
        for sample in samples:
            self._now_ns = max(self._now_ns, sample.stamp_ns)
            self._write_sample(sample)
            self.session.add(sample)
            if (command := self.session.recognised()) is not None:
                last = self._carry_out(command)
        return last

    def _carry_out(self, command: Command) -> Outcome:
        self.session.submit(command)
        (outcome,) = self.session.step(wall_ns=self._now_ns)
        self._events.write(outcome.command, outcome, self._now_ns)
        self._show_in_force()
        return outcome

    def _show_in_force(self) -> None:
        current = self.session.current
        heads = current.head, current.healthy, current.station
        shown = tuple(head.revision for head in heads)
        if shown != self._shown:
            self._shown = shown
            topics = {JOINTS: f"/{JOINTS}", EDGES: f"/{EDGES}"}
            self._events.write(configuration(self.session, topics), None, self._now_ns)

    def _write_sample(self, sample: Sample) -> None:
        header = {"stamp": _time(sample.stamp_ns), "frame_id": ""}
        if isinstance(sample, JointSample):
            message: Mapping[str, Any] = {
                "header": header,
                "name": list(sample.names),
                "position": sample.position,
            }
            self._write(f"/{JOINTS}", "sensor_msgs/msg/JointState", message)
            return
        edge = {
            "header": header | {"frame_id": sample.station},
            "beam": sample.beam,
            "edge": BREAK if sample.blocked else RESTORE,
            "stamp_sigma_s": sample.sigma_s,
        }
        self._write(f"/{EDGES}", "robocal_msgs/msg/BeamEvent", edge)

    def _write(self, topic: str, kind: str, message: Mapping[str, Any]) -> None:
        self._bag.write(topic, kind, message, self._now_ns)


def _time(stamp_ns: int) -> dict[str, int]:
    return {"sec": stamp_ns // 10**9, "nanosec": stamp_ns % 10**9}


def record(path: Path) -> None:
    """Make the bag."""
    with (
        tempfile.TemporaryDirectory() as folder,
        CalibrationHistory.open("SIM-UR10-1", state_dir=Path(folder)) as history,
        BagWriter(path, latched=[EVENTS]) as bag,
    ):
        cell = Recorder(bag, history)
        cell.truth(TAUGHT)
        cell.run("reference", "commissioning")
        cell.run("quick", "gap-1")
        cell.truth(BENT)
        cell.run("quick", "gap-2")
        cell.program.edit = lose_an_edge
        cell.run("full", "gap-3")
        cell.program.edit = lambda step, edges: edges
        measured = cell.run("full", "gap-4")
        why = "its verdict"
        cell.command(events.ACCEPT, id=measured.calibration_id, by=BY, reason=why)
        cell.run("quick", "gap-5")


def main() -> None:
    """Write the bag beside this script."""
    record(BAG)
    print(f"{BAG.name}: {BAG.stat().st_size / 1e6:.2f} MB, simulated")


if __name__ == "__main__":
    main()
