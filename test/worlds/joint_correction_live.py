# SPDX-License-Identifier: Apache-2.0
"""A joint correction node between a planner and a controller, both played by the test."""

import time
from array import array
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from robocal_msgs.msg import CorrectionStatus, JointOffset, KinematicModel, ToolFrame
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray, Header
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.node import JointCorrectionNode
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_description, load_robot
from robocal_ros.ros import conversions, endpoints
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.services import ToolMessages

NOMINAL = load_robot("kr150_r3100")
NAMES = list(NOMINAL.joint_names)
HOME = np.array([0.3, -1.2, 1.2, 0.4, 0.9, -0.3])
NODE = "/joint_correction_node"


def drifted(times: float = 1.0) -> SerialArm:
    rng = np.random.default_rng(0)
    chosen = NOMINAL.parameters
    size = times * np.where(chosen.is_length, 1e-4, 5e-5)
    return NOMINAL.with_mdh(chosen.add(NOMINAL.mdh, size * rng.standard_normal(len(chosen))))


def model_message(arm: SerialArm, revision: int = 1, **changes: Any) -> KinematicModel:
    fields = {
        "serial": "s1",
        "model_hash": NOMINAL.model_hash,
        "robot_file_hash": load_description("kr150_r3100").file_hash,
        "revision": revision,
        "state": KinematicModel.ACCEPTED,
        "stamp": Header(frame_id="base"),
    }
    return conversions.kinematic_model(model_document(arm), **(fields | changes))


def tool_message(T: np.ndarray, revision: int = 1, **changes: Any) -> ToolFrame:
    """As tcf_node makes it."""
    build = ToolMessages(load_description("kr150_r3100"), "s1", "tool0", "tool")
    message = build.frame(KnownTool(T), revision, 0, ToolFrame.ACCEPTED, 0)
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def joints(q: Any, **fields: Any) -> JointState:
    return JointState(name=NAMES, position=array("d", q), **fields)


def trajectory(q: np.ndarray, times: np.ndarray, **fields: Any) -> JointTrajectory:
    still = array("d", np.zeros(6))
    points = [
        JointTrajectoryPoint(
            positions=array("d", row),
            velocities=still,
            accelerations=still,
            effort=array("d", np.full(6, 7.0)),
            time_from_start=Duration(sec=int(t), nanosec=round(t % 1 * 1e9)),
        )
        for row, t in zip(q, times, strict=True)
    ]
    return JointTrajectory(joint_names=NAMES, points=points, **fields)


# Other work on the machine may hold readings up: they still tell where a robot at rest is.
PATIENT = {"joint_state_age_s": 5.0}


REST_S = 0.3


class Line:
    """The node between a planner and a controller, both played by the probe.

    The robot stands at ``at``, which is where the last target sent it.
    """

    def __init__(self, graph: Any, **parameters: Any) -> None:
        self.graph = graph
        self.at: Any = HOME
        self.rested = False
        self.node = graph.add(JointCorrectionNode, {"serial": "s1"} | PATIENT | parameters)
        self._connect(graph)
        report = self.node._report
        outputs = (*self.node._outputs.values(), report._offsets, report._statuses)
        graph.spin_until(
            lambda: all(output.get_subscription_count() for output in outputs), "the outputs"
        )

    def _connect(self, graph: Any) -> None:
        """Listen to all outputs, and wait for the inputs."""
        self.targets = graph.collect(JointState, f"{NODE}/joint_targets")
        self.paths = graph.collect(JointTrajectory, f"{NODE}/joint_trajectory")
        self.arrays = graph.collect(Float64MultiArray, f"{NODE}/joint_commands")
        self.states = graph.collect(JointState, f"{NODE}/joint_states")
        self.offsets = graph.collect(JointOffset, f"{NODE}/correction")
        self.statuses = graph.collect(CorrectionStatus, f"{NODE}/status", endpoints.LATCHED)
        self.diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
        self.to_target = graph.publisher(JointState, "joint_targets")
        self.to_array = graph.publisher(Float64MultiArray, "joint_commands")
        self.to_path = graph.publisher(JointTrajectory, "joint_trajectory")
        self.to_states = graph.publisher(JointState, "joint_states")
        self.to_model = graph.publisher(KinematicModel, "kinematic_model", endpoints.LATCHED)
        self.to_tool = graph.publisher(ToolFrame, "tool", endpoints.LATCHED)

    def wait(self, inbox: list[Any], count: int = 1) -> Any:
        self.graph.spin_until(lambda: len(inbox) >= count, f"{count} outputs")
        return inbox[-1]

    def stand(self, **fields: Any) -> None:
        self.take(joints(self.at, **fields), self.to_states, "joint_states")

    def rest(self) -> None:
        """Stand for so long that the node knows it."""
        until = time.monotonic() + REST_S
        while time.monotonic() < until:
            self.stand()
            self.graph.spin_for(0.02)
        self.rested = True

    def target(self, q: Any = HOME, **fields: Any) -> JointState:
        self.stand() if self.rested else self.rest()
        count = len(self.targets)
        self.to_target.publish(joints(q, **fields))
        out = self.wait(self.targets, count + 1)
        self.at = out.position
        return out

    def report(self, level: bytes, words: str) -> DiagnosticStatus:
        """The next diagnostics of this level that say so."""
        self.diagnostics.clear()
        found: list[DiagnosticStatus] = []

        def look() -> bool:
            every = [s for array in self.diagnostics for s in array.status]
            found[:] = [s for s in every if s.level == level and words in s.message]
            return bool(found)

        self.graph.spin_until(look, f"'{words}' in the diagnostics")
        return found[-1]

    def told(self, **fields: Any) -> CorrectionStatus:
        """The next status that says so."""
        found: list[CorrectionStatus] = []

        def look() -> bool:
            found[:] = [
                status
                for status in self.statuses
                if all(getattr(status, name) == value for name, value in fields.items())
            ]
            return bool(found)

        self.graph.spin_until(look, f"a status with {fields}")
        return found[-1]

    def enable(self, on: bool = True) -> str:
        """Ask for the correction or its end; what the node answers."""
        return str(self.graph.call(SetBool, f"{NODE}/enable", data=on).message)

    def take(self, message: Any, publisher: Any, topic: str) -> None:
        count = self.node.inputs[topic]
        before = count.received
        publisher.publish(message)
        self.graph.spin_until(lambda: count.received > before, f"{topic} is received")

    def refused(self, publisher: Any, message: Any, topic: str) -> None:
        count = self.node.inputs[topic]
        before = count.invalid
        publisher.publish(message)
        self.graph.spin_until(lambda: count.invalid > before, f"{topic} is refused")

    def settle(self) -> JointState:
        for _ in range(3000):
            out = self.target()
            if self.node._session.status().settled:
                self.stand()
                return out
        pytest.fail("the blend does not end")


def distance(actual: SerialArm, q: Any, reference: SerialArm = NOMINAL) -> float:
    goal = reference.fk(HOME) @ reference.T_flange_tool
    T = actual.fk(np.array(q)) @ actual.T_flange_tool
    return float(np.linalg.norm((T - goal)[:3, 3]))
