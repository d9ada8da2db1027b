"""The joint correction node: taught joints in, corrected ones out (docs/joint_correction.md)."""

import time
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
from robocal_msgs.msg import CorrectionStatus as StatusMessage
from robocal_msgs.msg import JointOffset, KinematicModel, ToolFrame
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction import messages, serialized_path
from robocal_ros.correction.action import TrajectoryProxy
from robocal_ros.correction.command_sources import CommandSources
from robocal_ros.correction.courses import Course
from robocal_ros.correction.inputs import TrajectoryCommand, offered_model, offered_tool
from robocal_ros.correction.path_messages import PathMessage
from robocal_ros.correction.periods import LONGEST_GAP_S
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.report import LOOK_S, CorrectionReport
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.correction.settings import (
    SETTINGS,
    arms,
    command_joints,
    session_config,
)
from robocal_ros.correction.settled_streams import JointStream, ReadingStream, TargetStream
from robocal_ros.correction.staged import load_kernels
from robocal_ros.correction.stream_messages import ArrayMessage, JointMessage
from robocal_ros.nodes import qos
from robocal_ros.nodes.base import NO_SERIAL, POLL_S, HouseNode
from robocal_ros.nodes.diagnostics import Health
from robocal_ros.nodes.run import run
from robocal_ros.nodes.source_guard import SourceGuard

TRAJECTORY = "joint_trajectory"
TARGETS = "joint_targets"
COMMANDS = "joint_commands"
STATES = "joint_states"
ACTION = "follow_joint_trajectory"
MODEL = "kinematic_model"
TOOL = "tool"
KINDS = {
    TRAJECTORY: JointTrajectory,
    TARGETS: JointState,
    COMMANDS: Float64MultiArray,
    STATES: JointState,
}


class JointCorrectionNode(HouseNode):
    """Drives a `CorrectionSession` with live messages."""

    NAME = "joint_correction_node"
    SETTINGS = SETTINGS
    _made_for = ""  # serial of the model in use
    _proxy: TrajectoryProxy | None = None

    def configure(self) -> None:
        """Load the models, then open the topics."""
        nominal, reference = arms(self.settings)
        config = session_config(self.settings)
        serial = self.settings["serial"] or NO_SERIAL
        self._names = command_joints(self.settings, nominal)
        self._shadow = bool(self.settings["shadow"])
        self._session = CorrectionSession(nominal, reference, serial, config)
        load_kernels(reference)  # the first command must not wait for it
        serialized_path.load_kernels()
        self._session.enable(self.settings["enable_on_start"])
        self._streams = CommandSources(max(config.stream_gap_s, LONGEST_GAP_S))
        self._paths = CommandSources(config.stream_gap_s)
        self._senders = {TARGETS: self._streams, COMMANDS: self._streams, TRAJECTORY: self._paths}
        self._sources = {topic: SourceGuard(self, topic) for topic in KINDS}
        self._commanded = False
        self._open_topics()
        told = self._session, self.settings, nominal, reference
        self._report = CorrectionReport(*told, self._offsets, self._statuses, self.now_ns)
        self._release.append(self._report.close)

    def _open_topics(self) -> None:
        self._outputs = {
            topic: self.add_output(kind, f"~/{topic}", qos.RELIABLE)
            for topic, kind in KINDS.items()
        }
        self._offsets = self.add_output(JointOffset, "~/correction", qos.RELIABLE)
        self._statuses = self.add_output(StatusMessage, "~/status", qos.LATCHED)
        self.add_input(KinematicModel, MODEL, self._on_model, qos.LATCHED)
        self.add_input(ToolFrame, TOOL, self._on_tool, qos.LATCHED)
        targets = self._session, self._outputs[TARGETS], TARGETS, self._streams
        streams: dict[str, JointStream] = {
            STATES: ReadingStream(self._session, self._outputs[STATES], self.now_ns),
            TARGETS: TargetStream(*targets, partial(self._tell_offset, JointOffset.STREAM)),
        }
        acts: dict[str, tuple[Callable[[Any], Any], Callable[[Any], None]]] = {
            STATES: (streams[STATES].read, self._on_states),
            TARGETS: (streams[TARGETS].read, partial(self._on_target, TARGETS)),
            COMMANDS: (partial(ArrayMessage, self._names), partial(self._on_target, COMMANDS)),
            TRAJECTORY: (PathMessage, self._on_path),
        }
        for topic, (read, act) in acts.items():
            receive, kind = self._guarded(topic, read, act), KINDS[topic]
            if topic in streams:
                receive = streams[topic].before(self._sources[topic], receive)
            profile = qos.SENSOR if topic == STATES else qos.RELIABLE
            opened = self.add_input(kind, topic, receive, profile, raw=topic != COMMANDS)
            if topic in self._senders:
                self._senders[topic].inputs[topic] = opened
        self.add_service(SetBool, "~/enable", self._on_enable)
        self.add_timer(POLL_S, self._look_at_graph, steady=True)
        self.add_timer(LOOK_S, self._look, steady=True)
        if self.settings[ACTION]:
            if self._proxy is None:
                acting = self._goal, self._taught, self._stop, self._tell_path
                self._proxy = TrajectoryProxy(self, f"~/{ACTION}", *acting)
            self._proxy.open(self.settings[ACTION])

    def activate(self) -> None:
        """Tell at once what is done."""
        self._tell()

    def deactivate(self) -> None:
        """Cancel the goals under way."""
        if self._proxy is not None:
            self._proxy.deactivate()

    def cleanup(self) -> None:
        """Take no goals any more."""
        if self._proxy is not None:
            self._proxy.close()

    def destroy_node(self) -> None:
        """Take the action down with the node."""
        if self._proxy is not None:
            self._proxy.destroy()
        super().destroy_node()

    # ---- what decides about the correction ------------------------------------------------------

    def _on_model(self, message: Any) -> None:
        build = self._session.counted
        self._session.offer_model(build(lambda: offered_model(message, KinematicModel.ACCEPTED)))
        self._made_for = self._session.status().serial
        self._tell()

    def _on_tool(self, message: Any) -> None:
        build = self._session.counted
        self._session.offer_tool(build(lambda: offered_tool(message, ToolFrame.ACCEPTED)))
        self._tell()

    def _on_enable(self, request: Any, response: Any) -> Any:
        self._session.enable(request.data)
        response.success = True
        response.message = messages.in_words(self._session.status())
        self.get_logger().info(f"enable {request.data}: {response.message}")
        self._tell()
        return response

    # ---- what is corrected ----------------------------------------------------------------------

    def _guarded(
        self, topic: str, read: Callable[[Any], Any], act: Callable[[Any], None]
    ) -> Callable[[Any], None]:
        """Refuse what a correction node publishes itself, and commands of several sources.

        In shadow mode a message goes out as it came before anything else is done with it.
        """
        guard = self._sources[topic]
        senders = self._senders.get(topic)

        def receive(came: Any) -> None:
            message = read(came)
            stop = topic == TRAJECTORY and not message.points  # nothing may hold it up
            if guard.fault and not stop:
                self._session.refuse(Reason.OWN_OUTPUT, guard.fault)
            if self._shadow and message.is_finite():
                self._outputs[topic].publish(message.unchanged())
            rivals = senders.hear(topic, time.monotonic()) if senders and not stop else ""
            if rivals:
                self._session.refuse(Reason.TWO_SOURCES, rivals)
            act(message)

        return receive

    def _on_target(self, topic: str, message: JointMessage | ArrayMessage) -> None:
        command, now = self._session.counted(message.command), time.monotonic()
        self._put_out(topic, message, command, self._session.target(command, now))
        self._tell_offset(JointOffset.STREAM, now)

    def _on_states(self, message: JointMessage) -> None:
        command, act = self._session.counted(message.command), self._session.reading
        age = (self.now_ns() - command.stamp_ns) * 1e-9 if command.stamp_ns else 0.0
        self._put_out(STATES, message, command, act(command, time.monotonic(), age))

    def _on_path(self, message: PathMessage) -> None:
        if message.points:
            self._put_out(TRAJECTORY, message, *self._corrected(message))
            if self._session.course is not None:
                self._session.course.begin(time.monotonic())
            self._tell_path()
        else:
            self._put_out(TRAJECTORY, message, _STOP, _STOP)
            self._stop()

    def _corrected(
        self, message: PathMessage, *, is_goal: bool = False
    ) -> tuple[TrajectoryCommand, TrajectoryCommand]:
        """What is commanded by a message, as it came and corrected."""
        command, act = self._session.counted(message.command), self._session.trajectory
        starts_in = (command.stamp_ns - self.now_ns()) * 1e-9 if command.stamp_ns else 0.0
        return command, act(command, time.monotonic(), starts_in, may_be_rejected=is_goal)

    def _put_out(self, topic: str, message: Any, came: Any, command: Any) -> None:
        """Publish a message with another command than came; in shadow mode it has gone out."""
        if not self._shadow:
            same = command is came
            self._outputs[topic].publish(message.unchanged() if same else message.changed(command))

    def _goal(self, trajectory: JointTrajectory) -> tuple[JointTrajectory, Course | None]:
        """A goal's trajectory, corrected, and its course; as it came in shadow mode."""
        message = PathMessage(trajectory)
        try:
            came, command = self._corrected(message, is_goal=True)
        except RefusedError as fault:
            held_back = fault.reason is Reason.OWN_OUTPUT or not message.is_finite()
            if held_back or not self._shadow:
                raise
            return trajectory, None
        course = self._session.course
        try:
            return trajectory if command is came else message.changed(command), course
        except Exception:
            if course is not None:  # it never goes out
                course.reject()
            raise

    def _taught(self, names: Any, position: Any, velocity: Any) -> Any:
        return self._session.taught(names, position, velocity, time.monotonic())

    def _stop(self) -> None:
        self._session.trajectory(_STOP, time.monotonic())

    # ---- what is reported -----------------------------------------------------------------------

    def _tell_offset(self, cause: int, now_s: float) -> None:
        self._commanded = True
        self._report.offset(cause, now_s)

    def _tell_path(self) -> None:
        self._tell_offset(JointOffset.TRAJECTORY, time.monotonic())

    def _look_at_graph(self) -> None:
        for guard in self._sources.values():
            guard.look()
        self._streams.look()

    def _look(self) -> None:
        """Let time pass, and tell what has changed."""
        now = time.monotonic()
        self._session.look(now, self.now_ns())
        if self._commanded:
            self._tell_offset(JointOffset.PERIODIC, now)
        self._tell(only_news=True)

    def _tell(self, *, only_news: bool = False) -> None:
        sources = "; ".join([*self._faults(), *self._rivals()])
        self._report.status(sources, only_news=only_news)

    def _faults(self) -> list[str]:
        return [guard.fault for guard in self._sources.values() if guard.fault]

    def _rivals(self) -> list[str]:
        now = time.monotonic()
        return [words for s in (self._streams, self._paths) if (words := s.words(now))]

    def _serial(self) -> str:
        """The robot's serial: as configured, else the model's, else the robot's name."""
        return super()._serial() or self._made_for or str(self.get_parameter("robot").value)

    def health(self) -> Health:
        """Tell what is corrected, and what was refused and why."""
        return self._report.health(self._faults(), self._rivals())


_STOP = TrajectoryCommand((), np.empty((0, 0)), np.empty(0))


def main() -> None:
    """Run the node."""
    run(JointCorrectionNode, events=True)
