"""The thermal node: measurements in, judged models out, decisions kept (docs/thermal_node.md)."""

import time
from collections import deque
from pathlib import Path
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from robocal_msgs.msg import CalibrationQuality, KinematicModel, SessionEvent
from sensor_msgs.msg import JointState, PointCloud2

from robocal_ros import __version__
from robocal_ros.core.documents import model_document
from robocal_ros.core.errors import RobocalError
from robocal_ros.core.thermal.identification import require_parameters
from robocal_ros.nodes import conversions, qos
from robocal_ros.nodes.base import HouseNode
from robocal_ros.nodes.diagnostics import ERROR, WARN, Health
from robocal_ros.nodes.endpoints import NotActiveError
from robocal_ros.nodes.run import run
from robocal_ros.nodes.source_guard import SourceGuard
from robocal_ros.nodes.thermal_services import ThermalServices
from robocal_ros.nodes.thermal_settings import SETTINGS, session_config
from robocal_ros.sessions.events import IDENTIFY, Command, Outcome
from robocal_ros.sessions.inputs import take_message
from robocal_ros.sessions.observations import CENTRE, CLOUD, JOINTS, POINT, POSE
from robocal_ros.sessions.records import configuration
from robocal_ros.sessions.thermal import ThermalSession
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.robots import load_robot

NO_SERIAL = "unset"
POLL_S = 0.5
INPUTS = {
    JOINTS: JointState,
    POINT: PointStamped,
    CENTRE: PointStamped,
    CLOUD: PointCloud2,
    POSE: PoseStamped,
}

# Deep enough for the seconds that a large identification takes.
STREAM = QoSProfile(
    history=HistoryPolicy.KEEP_LAST, depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT
)
# A recorder that comes later still gets the events.
EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


class ThermalNode(HouseNode):
    """Drives a `ThermalSession` with live messages and calls."""

    NAME = "thermal_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._session: ThermalSession | None = None
        self._history: CalibrationHistory | None = None

    def configure(self) -> None:
        """Open the history, then the topics and services."""
        self._asked: deque[Future] = deque()
        self._sequence = 0
        self._shown: tuple[Any, ...] = ()
        settings = self.settings
        self._nominal = load_robot(settings["robot"])
        require_parameters(self._nominal, settings["drift_parameters"])
        self._serial_in_use = settings["serial"] or NO_SERIAL
        folder = settings["state_dir"]
        self._history = CalibrationHistory.open(
            self._serial_in_use,
            model_hash=self._nominal.model_hash,
            state_dir=Path(folder) if folder else None,
        )
        self._candidate = self.add_output(KinematicModel, "~/candidate", qos.LATCHED)
        self._model = self.add_output(KinematicModel, "~/model", qos.LATCHED)
        self._quality = self.add_output(CalibrationQuality, "~/quality", qos.LATCHED)
        self._events = self.add_output(SessionEvent, "~/session_events", EVENTS)
        self._guard = SourceGuard(self, JOINTS)
        self._topics = {kind: self.resolve_topic_name(kind) for kind in INPUTS}
        for kind, message_type in INPUTS.items():
            self.add_input(message_type, kind, self._taker(kind), STREAM)
        ThermalServices(self.add_service, self._ask, self._history)
        self.add_timer(POLL_S, self._poll, steady=True)
        self._deadline = self.add_timer(settings["command_timeout_s"], self._force, steady=True)
        self._deadline.cancel()

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        if self._history is None:
            raise ValueError("activated before it was configured")
        config = session_config(self.settings)
        self._session = ThermalSession(self._nominal, self._history, config, __version__)
        self._shown = ()
        self._show_in_force()

    def deactivate(self) -> None:
        """End the session; calls that wait are answered."""
        self._session = None
        self._deadline.cancel()
        while self._asked:
            error = NotActiveError("deactivated while the command waited: nothing was done")
            self._asked.popleft().set_exception(error)

    def cleanup(self) -> None:
        """Close the history."""
        self._session = None
        if self._history is not None:
            self._history.close()
        self._history = None

    # ---- samples and commands -------------------------------------------------------------------

    def _taker(self, kind: str) -> Any:
        def take(message: Any) -> None:
            session = self._session
            if session is None:
                return
            if kind == JOINTS and not session.desk.received[JOINTS]:
                self._guard.look()
            if kind == JOINTS and self._guard.fault:
                session.desk.ignored.add(JOINTS, self._guard.fault)
                return
            take_message(session, kind, message)
            if session.waiting:
                self._step()

        return take

    def _ask(self, command: Command) -> Future:
        """Give a command to the session; the future becomes its outcome."""
        if self._session is None:
            raise NotActiveError("no session: activate the node")
        future: Future = Future()
        if not self._asked:
            self._deadline.reset()
        self._asked.append(future)
        self._session.submit(command, self.now_ns())
        self._step()
        return future

    def _force(self) -> None:
        self._step(force=True)

    def _step(self, *, force: bool = False) -> None:
        """Carry out the commands whose samples are complete."""
        while self._session is not None and self._asked:
            try:
                outcomes = self._session.step(wall_ns=time.time_ns(), force=force)
            except Exception as error:  # a defect must not end the node: the caller is told
                self._asked.popleft().set_exception(error)
                continue
            if not outcomes:
                return
            for outcome in outcomes:
                self._show(outcome)
            self._asked.popleft().set_result(outcomes[-1])
        self._deadline.cancel()

    def _poll(self) -> None:
        self._guard.look()
        if self._session is not None:
            for outcome in self._session.poll():
                self._show(outcome)
            self._show_in_force()

    # ---- outputs --------------------------------------------------------------------------------

    def _show(self, outcome: Outcome) -> None:
        words = f"{outcome.command.name}: {outcome.status.name} {outcome.message}"
        if outcome.done:
            self.get_logger().info(words)
        else:
            self.get_logger().warning(words)
        try:
            self._publish_event(outcome.command, outcome)
            if outcome.command.name == IDENTIFY:
                self._show_candidate(outcome)
            self._show_in_force()
        except (RobocalError, ValueError) as error:  # what is done stays done
            self.get_logger().error(f"{outcome.command.name} was done but not published: {error}")

    def _show_candidate(self, outcome: Outcome) -> None:
        if self._session is None or self._history is None:
            return
        stamp, frame = outcome.command.stamp_ns or 0, self._session.desk.frame or ""
        self._quality.publish(
            conversions.quality_message(
                outcome,
                robot=self._nominal.name,
                serial=self._serial_in_use,
                stamp=conversions.header(stamp, frame),
            )
        )
        if outcome.calibration_id:
            model = self._history.model(outcome.calibration_id)
            self._candidate.publish(self._message(model, 0, KinematicModel.CANDIDATE, stamp))

    def _show_in_force(self) -> None:
        """Publish the model in force and record the new state, when either changed."""
        session, history = self._session, self._history
        if session is None or history is None:
            return
        head, reference = session.in_force, session.reference_id
        if self._shown == (head.revision, reference):
            return
        if self._shown[:1] != (head.revision,):
            stamp = history.get(head.calibration_id).stamp_ns if head.calibration_id else 0
            model = model_document(self._nominal) if head.model is None else head.model
            self._model.publish(self._message(model, head.revision, KinematicModel.ACCEPTED, stamp))
        self._shown = (head.revision, reference)
        self._publish_event(configuration(session, self._topics), None)

    def _message(self, model: Any, revision: int, state: int, stamp_ns: int) -> KinematicModel:
        return conversions.kinematic_model(
            model,
            serial=self._serial_in_use,
            model_hash=self._nominal.model_hash,
            revision=revision,
            state=state,
            stamp=conversions.header(stamp_ns, self.settings["base_frame"]),
        )

    def _publish_event(self, command: Command, outcome: Outcome | None) -> None:
        self._sequence += 1
        self._events.publish(conversions.event_message(command, outcome, self._sequence))

    def health(self) -> Health:
        """Tell what is in force, what waits, what was lost or ignored, what is wrong."""
        session, history, health = self._session, self._history, Health()
        if session is None or history is None:
            return health
        values: dict[str, object] = {"revision in force": session.in_force.revision}
        try:
            pending = [entry.id for entry in history.pending()]
            values["pending candidates"] = ", ".join(map(str, pending)) or "none"
        except RobocalError as error:
            health.worsen(ERROR, str(error))
        values["cold reference"] = "captured" if session.reference_id else "none"
        values["joint gaps"] = session.desk.stream.gap_count
        ignored = session.desk.ignored
        for topic, reasons in ignored.items():
            for reason, count in reasons.items():
                last = ignored.last(topic, reason)
                values[f"{topic} ignored: {reason}"] = f"{count}, last: {last}"
        if self._guard.fault:
            health.worsen(ERROR, self._guard.fault)
        if session.fault:
            health.worsen(ERROR, session.fault)
        if history.damaged is not None:
            health.worsen(WARN, f"a damaged history was set aside as {history.damaged}")
        lost = [topic for topic, count in self.inputs.items() if count.lost]
        if lost:
            health.worsen(WARN, f"messages lost on {', '.join(lost)}")
        if self._serial_in_use == NO_SERIAL:
            health.worsen(WARN, "no serial is set: the history is kept as 'unset'")
        health.values = values
        return health


def main() -> None:
    """Run the node."""
    run(ThermalNode)
