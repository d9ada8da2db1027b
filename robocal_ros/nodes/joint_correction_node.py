"""The joint correction node: taught joints in, corrected ones out (docs/joint_correction.md)."""

import time
from array import array
from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from robocal_msgs.msg import KinematicModel
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.core import serialized_path
from robocal_ros.core.joint_correction.staged import load_kernels
from robocal_ros.nodes import qos
from robocal_ros.nodes.base import NO_SERIAL, POLL_S, HouseNode
from robocal_ros.nodes.diagnostics import ERROR, WARN, Health
from robocal_ros.nodes.joint_correction_settings import SETTINGS, arms, session_config
from robocal_ros.nodes.path_messages import PathMessage, read_message
from robocal_ros.nodes.run import run
from robocal_ros.nodes.source_guard import SourceGuard
from robocal_ros.sessions.correction import (
    CorrectionSession,
    CorrectionStatus,
    JointCommand,
    Reason,
    RefusedError,
    TrajectoryCommand,
    finite_command,
    joint_command,
    offered_model,
    offered_tool,
)
from robocal_ros.sessions.correction.wire import JointWire

TRAJECTORY = "joint_trajectory"
TARGETS = "joint_targets"
STATES = "joint_states"
MODEL = "kinematic_model"
TOOL = "tool_frame"


class JointCorrectionNode(HouseNode):
    """Drives a `CorrectionSession` with live messages."""

    NAME = "joint_correction_node"
    SETTINGS = SETTINGS
    _made_for = ""  # serial of the model in use

    def configure(self) -> None:
        """Load the models, then open the topics."""
        nominal, reference = arms(self.settings)
        config = session_config(self.settings)
        serial = self.settings["serial"] or NO_SERIAL
        self._session = CorrectionSession(nominal, reference, serial, config)
        load_kernels(reference)  # the first command must not wait for it
        serialized_path.load_kernels()
        self._session.enable(self.settings["enable_on_start"])
        self._refusals = 0
        self._outputs = {
            topic: self.add_output(kind, f"~/{topic}", qos.RELIABLE)
            for topic, kind in ((TRAJECTORY, JointTrajectory), (TARGETS, JointState))
        }
        self._outputs[STATES] = self.add_output(JointState, f"~/{STATES}", qos.RELIABLE)
        self._sources = {topic: SourceGuard(self, topic) for topic in self._outputs}
        self.add_input(KinematicModel, MODEL, self._on_model, qos.LATCHED)
        self.add_input(TransformStamped, TOOL, self._on_tool, qos.LATCHED)
        self._wires = {topic: JointWire() for topic in (STATES, TARGETS)}
        states, targets = (
            self._guarded(topic, act)
            for topic, act in ((STATES, self._on_states), (TARGETS, self._on_target))
        )
        self.add_input(JointState, STATES, states, qos.SENSOR, raw=True)
        self.add_input(JointState, TARGETS, targets, qos.RELIABLE, raw=True)
        receive = self._guarded(TRAJECTORY, self._on_path)
        self.add_input(
            JointTrajectory,
            TRAJECTORY,
            lambda data: receive(PathMessage(data)),
            qos.RELIABLE,
            raw=True,
        )
        self.add_service(SetBool, "~/enable", self._on_enable)
        self.add_timer(POLL_S, self._look, steady=True)

    # ---- what decides about the correction ------------------------------------------------------

    def _on_model(self, message: Any) -> None:
        build = self._session.counted
        self._session.offer_model(build(lambda: offered_model(message, KinematicModel.ACCEPTED)))
        self._made_for = self._session.status().serial

    def _on_tool(self, message: Any) -> None:
        self._session.offer_tool(self._session.counted(lambda: offered_tool(message)))

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._session.enable(request.data)
        status = self._session.status()
        response.success = True
        response.message = _in_words(status)
        self.get_logger().info(f"enable {request.data}: {response.message}")
        return response

    # ---- what is corrected ----------------------------------------------------------------------

    def _guarded(self, topic: str, act: Callable[[Any], None]) -> Callable[[Any], None]:
        """Refuse what a correction node publishes itself."""
        guard = self._sources[topic]

        def receive(message: Any) -> None:
            stop = topic == TRAJECTORY and not message.points  # nothing may hold it up
            if guard.fault and not stop:
                self._session.counted(lambda: _refuse(guard.fault))
            act(message)

        return receive

    def _on_target(self, data: bytes) -> None:
        command, message = self._wires[TARGETS].read(data), None
        if command is None:
            message = read_message(data, JointState)
            command = self._session.counted(lambda: finite_command(message))
        self._put_out(TARGETS, data, message, self._session.target(command, time.monotonic()))

    def _on_states(self, data: bytes) -> None:
        command, message = self._wires[STATES].read(data), None
        if command is None:
            message = read_message(data, JointState)
            command = self._session.counted(lambda: joint_command(message))
            if not np.all(np.isfinite(message.effort)):
                message.effort = _doubles(np.empty(0))  # many drivers have none: no NaN goes out
        age = (self.now_ns() - command.stamp_ns) * 1e-9 if command.stamp_ns else 0.0
        taught = self._session.reading(command, time.monotonic(), age)
        self._put_out(STATES, data, message, taught)

    def _put_out(self, topic: str, data: bytes, message: Any, command: JointCommand) -> None:
        """Publish what came with the command's values; what it did not change stays.

        ``message`` is None for data that were read from the wire.
        """
        if message is None:
            self._outputs[topic].publish(self._wires[topic].written(data, command))
            return
        message.header.frame_id = command.mark
        message.position = _doubles(command.position)
        if command.velocity is not None:
            message.velocity = _doubles(command.velocity)
        self._outputs[topic].publish(message)

    def _on_path(self, message: PathMessage) -> None:
        now = time.monotonic()
        if not message.points:
            self._outputs[TRAJECTORY].publish(message.unchanged())
            self._session.trajectory(_STOP, now)
            return
        command = self._session.counted(message.command)
        starts_in = (command.stamp_ns - self.now_ns()) * 1e-9 if command.stamp_ns else 0.0
        corrected = self._session.trajectory(command, now, starts_in)
        same = corrected is command
        self._outputs[TRAJECTORY].publish(
            message.unchanged() if same else message.corrected(corrected)
        )

    # ---- what is reported -----------------------------------------------------------------------

    def _look(self) -> None:
        for guard in self._sources.values():
            guard.look()

    def _serial(self) -> str:
        """The robot's serial: as configured, else the model's, else the robot's name."""
        return super()._serial() or self._made_for or str(self.get_parameter("robot").value)

    def health(self) -> Health:
        """Tell what is corrected, and what was refused and why."""
        status, health = self._session.status(), Health()
        refusals = sum(status.refused.values())
        if refusals > self._refusals:
            health.worsen(WARN, status.last_refusal)
        self._refusals = refusals
        for guard in self._sources.values():
            if guard.fault:
                health.worsen(ERROR, guard.fault)
        if status.mismatch:
            health.worsen(ERROR, f"{Reason.START_MISMATCH.value}: {status.mismatch}")
        if status.waits:
            health.worsen(WARN, f"the blend waits, {status.waits}")
        if status.survey.beyond:
            health.worsen(WARN, f"model revision {status.revision}: {status.survey}")
        if status.waiting_revision is not None:
            health.worsen(
                WARN,
                f"model revision {status.waiting_revision} was refused, ~/enable looks at it again",
            )
        if status.enabled and status.revision is None and not status.new_tool:
            health.worsen(WARN, "enabled, but neither a model nor a tool was taken over")
        health.values = {
            "correction": _in_words(status),
            "shift at the tool mm": f"{status.tcp_shift_m * 1e3:.4f}",
            "largest joint shift deg": f"{np.degrees(status.largest_shift):.4f}",
            "remaining error mm": f"{status.remaining_m * 1e3:.6f}",
            "over the joint range": status.survey,
            "start mismatch": status.mismatch,
            "blend waits": status.waits,
            "blend held": status.held,
            "points corrected in part": status.reduced,
        } | {f"refused, {reason.value}": count for reason, count in status.refused.items()}
        return health


_STOP = TrajectoryCommand((), np.empty((0, 0)), np.empty(0))


def _refuse(detail: str) -> None:
    raise RefusedError(Reason.OWN_OUTPUT, detail)


def _doubles(values: NDArray[np.float64]) -> "array[float]":
    """The type that a message takes without looking at each number."""
    return array("d", values.tobytes())


def _in_words(status: CorrectionStatus) -> str:
    """What the correction does now, in one line."""
    if status.mismatch:
        return f"nothing goes out, {Reason.START_MISMATCH.value}: {status.mismatch}"
    if not status.enabled:
        return "off, blending out with the next commands" if status.active else "off"
    parts = [] if status.revision is None else [f"model revision {status.revision}"]
    parts += ["new tool"] if status.new_tool else []
    if not parts:
        return "on, but there is no model and no tool yet"
    settled = "on" if status.settled else "on, blending with the next commands"
    return f"{settled}: {' and '.join(parts)}"


def main() -> None:
    """Run the node."""
    run(JointCorrectionNode, events=True)
