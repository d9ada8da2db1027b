"""The thermal node: measurements in, judged models out, decisions kept (docs/thermal_node.md)."""

from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from numpy.typing import NDArray
from sensor_msgs.msg import JointState, PointCloud2, Temperature

from robocal_ros import __version__
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RobocalError
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    REFERENCE_SPHERE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    TEMPERATURES,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_robot, robot_file_hash
from robocal_ros.ros import endpoints
from robocal_ros.ros.clocks import DataClock
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError
from robocal_ros.ros.run import run
from robocal_ros.ros.session_node import SessionNode
from robocal_ros.session.events import CYCLE, Outcome
from robocal_ros.thermal.documents import placed_of
from robocal_ros.thermal.identification import require_parameters
from robocal_ros.thermal.proposing import SENSOR
from robocal_ros.thermal.seeding import configuration
from robocal_ros.thermal.services import SetUpServices, ThermalOutputs, ThermalServices
from robocal_ros.thermal.session import ThermalSession, take_message
from robocal_ros.thermal.settings import SETTINGS, session_config

Array = NDArray[np.float64]

ACCURACY_S = 1.0

INPUTS = {
    JOINTS: (JointState, endpoints.STREAM),
    MEASURED_POINT: (PointStamped, endpoints.STREAM),
    SPHERE_CENTER: (PointStamped, endpoints.STREAM),
    SPHERE_CLOUD: (PointCloud2, endpoints.STREAM),
    REFERENCE_SPHERE: (PointStamped, endpoints.STREAM),
    MEASURED_POSE: (PoseStamped, endpoints.STREAM),
    TEMPERATURES: (Temperature, endpoints.STREAM),
}


class ThermalNode(SessionNode[ThermalSession]):
    """Drives a `ThermalSession` with live messages and calls."""

    NAME = "thermal_node"
    SETTINGS = SETTINGS
    INPUTS = INPUTS

    def configure(self) -> None:
        """Open the history, then the topics and services."""
        settings = self.settings
        self._nominal = load_robot(settings["robot"])
        require_parameters(self._nominal, settings["drift_parameters"])
        self._config = session_config(settings, self._nominal)
        history = self.open_session(settings["command_timeout_s"])
        self._outputs = ThermalOutputs(
            self.add_output,
            self._nominal,
            self._serial_in_use,
            robot_file_hash(settings["robot"]),
            settings["base_frame"],
        )
        self._data_clock = DataClock()
        ask = self._desk.ask
        ThermalServices(self.add_service, ask, history)
        SetUpServices(self.add_service, ask, history, self._nominal, settings, self._prior)
        self.add_timer(ACCURACY_S, self._show_accuracy, steady=True)

    def new_session(self, history: CalibrationHistory) -> ThermalSession:
        """The session of an active node."""
        return ThermalSession(self._nominal, history, self._config, __version__)

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        super().activate()
        self._shown: tuple[Any, ...] = ()
        self.show_in_force()

    # ---- samples and commands -------------------------------------------------------------------

    def take(self, session: ThermalSession, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to the session."""
        take_message(session, kind, message)
        if session.waiting:
            self._desk.step()

    def _prior(self) -> Array:
        if self._session is None:
            raise NotActiveError("no session: activate the node")
        return self._session.expected_drift()

    def polled(self, session: ThermalSession) -> None:
        """End a cycle that is overdue."""
        if (command := session.overdue()) is not None:
            self._desk.ask(command)

    # ---- outputs --------------------------------------------------------------------------------

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        try:
            if not outcome.repeated:
                self._outputs.events.tell(outcome.command, outcome)
                if outcome.command.name in CYCLE:
                    self._show_candidate(outcome)
            self.show_in_force()
        except (RobocalError, ValueError) as error:  # what is done stays done
            self.get_logger().error(f"{outcome.command.name} was done but not published: {error}")

    def _show_candidate(self, outcome: Outcome) -> None:
        if self._session is None or self._history is None:
            return
        self._outputs.quality(outcome, self._session.desk.frame or "")
        if outcome.calibration_id:
            model = self._history.model(outcome.calibration_id)
            self._outputs.candidate(model, outcome.command.stamp_ns or 0)

    def show_in_force(self) -> None:
        """Publish the model in force and record the new state, when either changed."""
        session, history = self._session, self._history
        if session is None or history is None:
            return
        head, follower = session.in_force, session.follower
        cycles = 0 if follower is None else follower.state.cycles
        sensor = history.head(SENSOR)
        shown = (head.revision, session.reference_id, cycles, sensor.revision)
        if self._shown == shown and not self._outputs.events.need_configuration:
            return
        if self._shown[:1] != shown[:1]:
            stamp = history.get(head.calibration_id).stamp_ns if head.calibration_id else 0
            model = model_document(self._nominal) if head.model is None else head.model
            self._outputs.model(model, head.revision, stamp)
        if sensor.model is not None and sensor.calibration_id and self._shown[3:] != shown[3:]:
            T_sensor_base, _ = placed_of(sensor.model)
            stamp = history.get(sensor.calibration_id).stamp_ns
            self._outputs.sensor(frames.invert(T_sensor_base), sensor.model["frame"], stamp)
        self._shown = shown
        self._outputs.events.tell(configuration(session, self._topics), None)

    def _show_accuracy(self) -> None:
        if self._session is None:
            return
        newest = self._session.desk.newest_ns.get(JOINTS)
        stamp_ns = self._data_clock.at(newest, self.now_ns())
        found = self._session.accuracy(stamp_ns)
        self._outputs.accuracy(found, self._session.config.tolerance_m, stamp_ns)

    def report(self, session: ThermalSession, history: CalibrationHistory, health: Health) -> None:
        """Tell what waits, how far the cycle is, and what was lost."""
        values = health.values
        try:
            pending = [entry.id for entry in history.pending()]
            values["pending candidates"] = ", ".join(map(str, pending)) or "none"
        except RobocalError as error:
            health.worsen(ERROR, str(error))
        values["cold reference"] = "captured" if session.reference_id else "none"
        visited, poses = session.windows.progress()
        named = f"'{session.cycle.id}' open, " if session.cycle.id else ""
        values["cycle"] = f"{named}{visited} of {poses} poses measured"
        values["joint gaps"] = session.desk.stream.gap_count
        lost = [topic for topic, count in self.inputs.items() if count.lost]
        if lost:
            health.worsen(WARN, f"messages lost on {', '.join(lost)}")


def main() -> None:
    """Run the node."""
    run(ThermalNode)
