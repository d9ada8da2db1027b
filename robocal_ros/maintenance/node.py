"""The maintenance node: one call from the PLC keeps a cell accurate (docs/maintenance_node.md)."""

import math
import time
from dataclasses import replace
from typing import Any

from geometry_msgs.msg import PointStamped, PoseStamped
from robocal_msgs.msg import AccuracyState, CorrectionStatus
from sensor_msgs.msg import JointState, PointCloud2

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.files import StateFile
from robocal_ros.ground.samples import (
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    joint_sample,
    stamp_ns,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance import MaintenanceSession, MaintenanceState
from robocal_ros.maintenance.driver import MaintenanceDriver
from robocal_ros.maintenance.requests import DriverAnswer, DriverRequest, Move
from robocal_ros.maintenance.services import (
    MaintenanceOutputs,
    MaintenanceServices,
    Now,
    require_robot,
    told_correction,
    told_drift,
)
from robocal_ros.maintenance.settings import SETTINGS, session_config
from robocal_ros.motion.cell import load_motion
from robocal_ros.motion.driver import LeaseHolder, MotionDriver
from robocal_ros.motion.robot_watch import MotionReport
from robocal_ros.motion.settings import goal_tolerances
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode
from robocal_ros.ros.clocks import SteadyClock
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError
from robocal_ros.ros.graph import CommandPath, GapSources, SourceGuard
from robocal_ros.ros.history_settings import open_history, warn_of_history
from robocal_ros.ros.run import run
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel

TICK_S = 0.02
SHOW_S, LOOK_S = 0.2, 0.5
ACCURACY_S = 1.0
HISTORY_S = 0.05  # longest wait for another process: meanwhile nobody looks after the robot
NS = 1_000_000_000
ENDS = "the node was deactivated"
ACCURACY, CORRECTION = "thermal_node/accuracy", "joint_correction_node/status"
MEASUREMENTS = {
    MEASURED_POINT: PointStamped,
    SPHERE_CENTER: PointStamped,
    SPHERE_CLOUD: PointCloud2,
    MEASURED_POSE: PoseStamped,
}


class MaintenanceNode(HouseNode):
    """Drives a `MaintenanceSession` with live messages and calls."""

    NAME = "maintenance_node"
    SETTINGS = SETTINGS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._session: MaintenanceSession | None = None
        self._steady = SteadyClock(self._slept)
        self._history: CalibrationHistory | None = None
        self._calls: MaintenanceServices | None = None
        self._driver: MaintenanceDriver | None = None

    def configure(self) -> None:
        """Read the robot and the ways, open the history, then the topics, services and clients."""
        settings = self.settings
        self._nominal = load_robot(settings["robot"])
        self._config = session_config(settings, self._nominal)
        load_motion(self._nominal)
        self._serial_in_use, self._history = open_history(settings, self._nominal, self.NAME)
        self._history.wait_at_most(HISTORY_S)
        self._keeper = StateFile(self._history.path, "maintenance")
        self._outputs = MaintenanceOutputs(
            self.add_output, self._nominal.name, self._serial_in_use, settings["base_frame"]
        )
        motion = MotionDriver(
            self,
            self._nominal.joint_names,
            settings["follow_joint_trajectory"],
            settings["hard_stop_service"],
            goal_tolerances(self._nominal, self._config.driving),
            self._reported,
            lambda: None if self._session is None else self._session.robot.watch,
            self._steady.now_s,
        )
        self._motion, default_gap_s = motion, settings["default_gap_s"]
        self._driver = MaintenanceDriver(self, motion, self._answered, self._moves)
        self._lease = LeaseHolder(self, self._nominal.name, self._serial_in_use)
        path, mine = (motion.topic.topic_name, motion.action), self._outputs.accuracy_topic
        self._others = CommandPath(self, *path, ("motion_lease", CORRECTION), mine)
        self._calls = MaintenanceServices(
            self, self._running, self._looked, self._clocks, self._outputs, default_gap_s
        )
        self._guard = SourceGuard(self, JOINTS)
        self.add_input(JointState, JOINTS, self._take_joints, endpoints.STREAM)
        self._sources = GapSources(self, settings["gap_bool"], self._take_gap)
        self.add_input(AccuracyState, ACCURACY, self._take_accuracy, endpoints.LATCHED)
        self.add_input(CorrectionStatus, CORRECTION, self._take_correction, endpoints.LATCHED)
        for topic, kind in MEASUREMENTS.items():
            self.add_input(kind, topic, self._take_measurement, endpoints.STREAM)
        self.add_timer(TICK_S, self._tick, steady=True)
        self.add_timer(SHOW_S, self._show, steady=True)
        self.add_timer(ACCURACY_S, self._show_accuracy, steady=True)

    def activate(self) -> None:
        """Begin a session: with what was kept, a fault too."""
        if self._history is None:
            raise ValueError("activated before it was configured")
        self._session = MaintenanceSession(
            self._nominal, self._history, self._config, self._keeper, self._record
        )
        self._look_s = -math.inf
        for step, worst_s in self._session.worst_cases().items():
            self.get_logger().info(f"{step}: {worst_s:.1f} s at the most, way home included")
        self._show()

    def deactivate(self) -> None:
        """Stop what moves, disarm, and end the session; the line and the PLC are told."""
        if self._session is not None:
            self._carry_out(self._session.give_up(ENDS, self._steady.now_s()))
            self._lease.hold("")
            self._session.close()
            self._show()
            gone = Accuracy(AccuracyLevel.FAULT, f"maintenance: {ENDS}")
            self._outputs.accuracy(gone, self._config.tolerance_m, self.now_ns())
        if self._calls is not None:
            self._calls.break_off(ENDS)
        self._session = None

    def cleanup(self) -> None:
        """Take action and clients down, close the history."""
        self._session = None
        for part in (self._calls, self._driver, self._history):
            if part is not None:
                part.close()
        self._calls = self._driver = self._history = None

    def _running(self) -> MaintenanceSession:
        if self._session is None:
            raise NotActiveError("no session: activate the node")
        return self._session

    # ---- what comes in --------------------------------------------------------------------------

    def _take_joints(self, message: Any) -> None:
        session = self._session
        if session is None:
            return
        if fault := self._guard.fault_at(self.inputs[JOINTS].received - 1):
            raise InputError(fault)
        self._motion.hear(message)
        sample = joint_sample(message)
        q = sample.position[sample.order(self._nominal.joint_names)]
        session.reading(sample.stamp_ns / NS, q, self._steady.now_s())

    def _take_gap(self, is_open: bool, echo: int | None) -> None:
        if self._session is not None:
            self._session.doubt_gap(self._sources.doubt())
            self._session.gap(is_open, echo, self._steady.now_s())
            self._tick()  # a gap that closes stops the robot now

    def _take_measurement(self, message: Any) -> None:
        if self._session is not None:
            self._session.measured(stamp_ns(message.header.stamp) / NS)

    def _take_accuracy(self, message: Any) -> None:
        if self._session is not None:
            require_robot(ACCURACY, message, self._nominal.name, self._serial_in_use)
            self._session.drift(told_drift(message), self._steady.now_s())

    def _take_correction(self, message: Any) -> None:
        if self._session is not None:
            require_robot(CORRECTION, message, self._nominal.name, self._serial_in_use)
            self._session.correction(told_correction(message), self._steady.now_s())

    def _reported(self, report: MotionReport) -> None:
        if self._session is not None:
            self._session.robot.reported(report)
            self._tick()  # a motion that was rejected, or a stop, is seen to now

    def _answered(self, number: int, answer: DriverAnswer) -> None:
        if self._session is not None:
            self._session.answered(number, answer)

    # ---- time -----------------------------------------------------------------------------------

    def _clocks(self) -> Now:
        return Now(self._steady.now_s(), time.time_ns())

    def _slept(self, for_s: float) -> None:
        if self._session is not None:
            self._session.slept(for_s)

    def _tick(self) -> None:
        if self._session is not None:
            requests = self._session.tick(*self._clocks())
            self._hold_lease()  # before anything moves
            self._carry_out(requests)

    def _hold_lease(self) -> None:
        session = self._session
        running = None if session is None else session.running
        cycle = "" if running is None else f"cycle '{running.cycle_id}'"
        stops = session is not None and session.robot.stopping.under_way
        self._lease.hold(cycle or "a stop" * stops)

    def _carry_out(self, requests: list[DriverRequest]) -> None:
        for request in requests:
            if isinstance(request, Move) and self._looked() and self._others.violation:
                continue  # the cycle has ended by that
            if self._driver is not None:
                self._driver.carry_out(request)

    def _moves(self) -> None:
        if self._session is not None:
            self._session.sent(self._steady.now_s())

    # ---- what goes out --------------------------------------------------------------------------

    def _record(self, command: Command, outcome: Outcome) -> None:
        words = f"{command.name}: {outcome.status.name} {outcome.message}"
        if outcome.done:
            self.get_logger().info(words)
        else:
            self.get_logger().warning(words)
        stamped = replace(command, stamp_ns=self.now_ns())
        self._outputs.events.tell(stamped, replace(outcome, command=stamped))

    def _show(self) -> None:
        """Count the next beat, and say it with the status; tell the callers of the action."""
        self._guard.look()
        session = self._session
        if session is None or self._calls is None:
            return
        session.doubt_gap(self._sources.doubt())
        now_s = self._steady.now_s()
        if now_s >= self._look_s:
            self._looked()
        status = session.status(now_s)  # which may take its time: the history is read
        status = replace(status, beat=session.beat(self._steady.now_s()))
        self._outputs.status(status, self.now_ns())
        self._calls.look(status)

    def _looked(self) -> MaintenanceSession:
        """Who else commands the robot ends a cycle, and lets none begin."""
        session, now_s = self._running(), self._steady.now_s()
        self._look_s = now_s + LOOK_S
        session.second(self._others.look(), now_s)
        return session

    def _show_accuracy(self) -> None:
        if self._session is None:
            return
        try:
            found = self._session.accuracy(*self._clocks())
        except RobocalError as error:
            found = Accuracy(AccuracyLevel.FAULT, str(error))
        self._outputs.accuracy(found, self._config.tolerance_m, self.now_ns())

    def health(self) -> Health:
        """Tell what goes on, how long each step may take, what is wrong."""
        session, health = self._session, Health()
        if session is None:
            return health
        status = session.status(self._steady.now_s())
        values: dict[str, object] = {
            "state": status.state.name,
            "doing": status.doing or "nothing",
            "last cycle": "none" if status.last is None else status.last.message,
            "tool node": "disarmed" if status.disarmed else "may be armed",
            "motions": self._motion.way or "none yet",
        }
        for step, worst_s in session.worst_cases().items():
            values[f"worst case of {step}"] = f"{worst_s:.1f} s"
        health.values = values
        if status.state is MaintenanceState.FAULT:
            health.worsen(ERROR, status.fault)
        if trouble := session.robot.trouble(self._steady.now_s()):
            health.worsen(WARN, trouble)
        faults = self._guard.fault, self._others.violation, self._sources.doubt(), status.trouble
        for words in filter(None, faults):
            health.worsen(ERROR, words)
        if self._history is not None:
            warn_of_history(health, self._history)
        return health


def main() -> None:
    """Run the node."""
    run(MaintenanceNode)
