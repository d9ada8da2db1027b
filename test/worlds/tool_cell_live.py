# SPDX-License-Identifier: Apache-2.0
"""A simulated robot over DDS: it drives each step that tcf_node announces, as fast as it can."""

from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from rclpy.action import ActionClient
from rclpy.qos import HistoryPolicy, QoSProfile
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState
from tool_driver import TAUGHT, Driver, noisy_cell

from bench.measured_runs import ToolCell
from robocal_ros.cell_sim.beams import RoundTool
from robocal_ros.cell_sim.messages import planned_step
from robocal_ros.ground.samples import JointSample
from robocal_ros.ros import endpoints
from robocal_ros.tool.laser_frame import LaserFile, write_laser
from robocal_ros.tool.node import TcfNode

STATION = "north"
STREAM = QoSProfile(history=HistoryPolicy.KEEP_LAST, depth=2000)


def written_laser(folder: Path, cell: ToolCell) -> str:
    """File of a cell's beams."""
    path = folder / "laser.yaml"
    write_laser(path, LaserFile(cell.laser, STATION, cell.arm.name, cell.arm.model_hash))
    return str(path)


class LiveCell(Driver):
    """Robot, beams and PLC of one tcf_node."""

    def __init__(self, graph: Any, folder: Path, tool: np.ndarray, **parameters: Any) -> None:
        cell = noisy_cell()
        super().__init__(None, cell, RoundTool.cylinder(tool, 0.0025))
        self.graph = graph
        settings = {
            "laser": written_laser(folder, cell),
            "serial": "K7",
            "input_period_ms": 2.0,
            "taught_xyz_mm": (TAUGHT[:3, 3] * 1e3).tolist(),
        } | parameters
        self.steps = graph.collect(ToolStep, "/tcf_node/next_step", endpoints.LATCHED)
        self.node = graph.add(TcfNode, settings)
        self.joints = graph.publisher(JointState, "joint_states", STREAM)
        self.edges = graph.publisher(BeamEvent, "beam_events")
        self.client = ActionClient(graph.probe, MeasureTool, "/tcf_node/measure")
        graph.spin_until(self.client.server_is_ready, "the action appears")
        graph.spin_for(0.2)
        self.feedback: list[Any] = []
        self.station = STATION
        self.silent = False

    def give(self, sample: Any) -> None:
        """Publish a sample, and let the node take it."""
        self.samples.append(sample)
        stamp = Time(sec=sample.stamp_ns // 10**9, nanosec=sample.stamp_ns % 10**9)
        if isinstance(sample, JointSample):
            if self.silent:
                return
            message = JointState(name=list(sample.names), position=sample.position.tolist())
            message.header.stamp = stamp
            self.joints.publish(message)
        else:
            edge = BeamEvent.BREAK if sample.blocked else BeamEvent.RESTORE
            message = BeamEvent(beam=sample.beam, edge=edge, stamp_sigma_s=sample.sigma_s)
            message.header.stamp, message.header.frame_id = stamp, self.station
            self.edges.publish(message)
        self._taken(2)

    def _taken(self, waiting: int) -> None:
        """Keep at most so many samples on their way, so that topics stay in step."""
        received = self.node.inputs

        def near() -> bool:
            taken = sum(count.received for count in received.values())
            return taken >= self.published - waiting

        self.published = getattr(self, "published", 0) + 1
        self.graph.spin_until(near, "the samples arrive")

    def begin(self, mode: int = MeasureTool.Goal.FULL, cycle_id: str = "") -> Any:
        """Send the goal; returns the handle."""
        self.rest(0.1)
        goal = MeasureTool.Goal(mode=mode, cycle_id=cycle_id)
        sent = self.client.send_goal_async(goal, feedback_callback=self.feedback.append)
        handle = self.graph.awaited(sent, "the goal is accepted")
        assert handle.accepted
        return handle

    def measure(self, mode: int = MeasureTool.Goal.FULL, cycle_id: str = "") -> Any:
        """A whole run by the action; its result."""
        ended = self.begin(mode, cycle_id).get_result_async()
        self.follow(ended.done)
        return self.graph.awaited(ended, "the result arrives").result

    def follow(self, ended: Any) -> None:
        """Drive what is announced until the run has ended."""
        driven = (0, 0)
        for _ in range(400):
            self.graph.spin_for(0.02)
            step = self.steps[-1]
            if ended():
                return
            if step.kind != ToolStep.NONE and (step.run, step.number) > driven:
                driven = (step.run, step.number)
                self.play(self.program.drive(planned_step(step)))
            elif not self.silent:
                self.rest(0.25)
        raise AssertionError("the run never ends")
