# SPDX-License-Identifier: Apache-2.0
"""The maintenance node: one call from the PLC keeps a cell accurate (docs/maintenance_node.md)."""

import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from rclpy.action import ActionClient
from rclpy.task import Future
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import AccuracyState, CorrectionStatus
from robocal_msgs.srv import BeginCycle, EndCycle
from sensor_msgs.msg import JointState, PointCloud2
from std_srvs.srv import SetBool, Trigger

from robocal_ros.fixture.session import POINT
from robocal_ros.ground.errors import Code, InputError, RobocalError
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
from robocal_ros.maintenance import robot_interface
from robocal_ros.maintenance.robot_interface import MOST_ASKED, DriverAnswer, DriverRequest, Move
from robocal_ros.maintenance.services import (
    SETTINGS,
    MaintenanceOutputs,
    MaintenanceServices,
    Now,
    correction_of_message,
    drift_of_message,
    require_robot,
    session_config,
)
from robocal_ros.maintenance.session import MaintenanceSession, MaintenanceState
from robocal_ros.motion.cell import load_motion
from robocal_ros.motion.driver import LeaseHolder, MotionDriver, goal_tolerances, guarded
from robocal_ros.motion.robot_watch import BEHIND_S, MotionReport
from robocal_ros.motion.stopping import SteadyClock
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import run
from robocal_ros.ros.endpoints import ERROR, WARN, EndpointNode, Health, NotActiveError
from robocal_ros.ros.graph import CommandPath, GapSources, SourceGuard
from robocal_ros.ros.robot import RobotNode
from robocal_ros.ros.session_node import open_history, warn_of_history
from robocal_ros.session.events import Command, Outcome
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel
from robocal_ros.tool.services import ANSWERS, MODES

MODE_OF = {name: number for number, name in MODES.items()}
WORDS_OF = {number: words for words, number in ANSWERS.items()}
Answered = Callable[[int, DriverAnswer], None]


class MaintenanceDriver:
    """Clients of the capabilities' nodes, and of the robot's controller.

    ``motion``: sends motions to the controller. ``answered``: takes the number of a request and
    what came of it. ``moves``: told just before a motion goes out: later, the robot would be ahead
    of its plan.
    """

    def __init__(
        self,
        node: EndpointNode,
        motion: MotionDriver,
        answered: Answered,
        moves: Callable[[], None],
    ) -> None:
        self._node, self._motion, self._answered, self._moves = node, motion, answered, moves
        self._begin = node.add_client(BeginCycle, "thermal_node/begin_cycle")
        self._end = node.add_client(EndCycle, "thermal_node/end_cycle")
        self._start = node.add_client(Trigger, "fixture_node/start_trigger")
        self._judge = node.add_client(Trigger, "fixture_node/measure_trigger")
        self._arm = node.add_client(SetBool, "tcf_node/arm")
        self._measure = ActionClient(node, MeasureTool, "tcf_node/measure")
        self._goals: dict[int, Any] = {}  # handles; None until the goal is accepted
        self._cancelled: set[int] = set()
        self._asked: deque[tuple[Any, Future]] = deque()  # newest calls of services

    def close(self) -> None:
        """Take the actions' clients down."""
        self._measure.destroy()
        self._motion.close()

    def carry_out(self, request: DriverRequest) -> None:
        """Do it; the answer comes later."""
        number = request.number
        match request:
            case Move(plan=plan):
                self._moves()
                self._motion.send(plan, stop=False)
            case robot_interface.Stop(plan=plan):
                self._motion.send(plan, stop=True)
            case robot_interface.HardStop(why=why):
                self._motion.hard_stop(why)
            case robot_interface.BeginCycle(cycle_id=name):
                self._call(self._begin, BeginCycle.Request(cycle_id=name), number, _status)
            case robot_interface.EndCycle(cycle_id=name):
                self._call(self._end, EndCycle.Request(cycle_id=name), number, _cycle)
            case robot_interface.BeginFixture():
                self._call(self._start, Trigger.Request(), number, _triggered)
            case robot_interface.MeasureFixture():
                self._call(self._judge, Trigger.Request(), number, _triggered)
            case robot_interface.Arm():
                self._call(self._arm, SetBool.Request(data=True), number, _done)
            case robot_interface.Disarm():
                self._call(self._arm, SetBool.Request(data=False), number, _done)
            case robot_interface.Measure(mode=mode, cycle_id=name):
                self._begin_measure(number, mode, name)
            case robot_interface.CancelMeasure():
                for measure, handle in self._goals.items():
                    self._cancelled.add(measure)
                    if handle is not None:
                        handle.cancel_goal_async()

    def _call(
        self, client: Any, request: Any, number: int, read: Callable[[Any], DriverAnswer]
    ) -> None:
        if not client.service_is_ready():
            words = f"{client.srv_name} is not there: start its node"
            self._answered(number, DriverAnswer(Code.CONFLICT, words, absent=True))
            return
        asked = client.call_async(request)
        asked.add_done_callback(
            guarded(self._node, lambda future: self._answered(number, read(future.result())))
        )
        self._asked.append((client, asked))
        if len(self._asked) > MOST_ASKED:  # rclpy keeps what is never answered
            oldest, never = self._asked.popleft()
            oldest.remove_pending_request(never)

    def _begin_measure(self, number: int, mode: str, cycle_id: str) -> None:
        if not self._measure.server_is_ready():
            words = "the action tcf_node/measure is not there: start its node"
            self._answered(number, DriverAnswer(Code.CONFLICT, words))
            return
        self._goals[number] = None
        goal = MeasureTool.Goal(mode=MODE_OF[mode], cycle_id=cycle_id, only_in_gap=True)
        self._measure.send_goal_async(goal).add_done_callback(
            guarded(self._node, lambda future: self._accepted(number, future))
        )

    def _accepted(self, number: int, future: Future) -> None:
        handle: Any = future.result()
        if not handle.accepted:
            self._goals.pop(number, None)
            self._answered(number, DriverAnswer(Code.CONFLICT, "tcf_node rejected the goal"))
            return
        self._goals[number] = handle
        if number in self._cancelled:
            handle.cancel_goal_async()
        handle.get_result_async().add_done_callback(
            guarded(self._node, lambda ended: self._measured(number, ended))
        )

    def _measured(self, number: int, ended: Future) -> None:
        self._goals.pop(number, None)
        self._cancelled.discard(number)
        result: Any = ended.result().result
        found_mm = [result.deviation_mm, result.sigma_mm]
        self._answered(
            number,
            DriverAnswer(
                _code(result.status),
                result.message,
                result.candidate_id,
                has_result=result.success and bool(np.isfinite(found_mm).all()),
                answer=WORDS_OF.get(result.answer, ""),
                deviation_mm=result.deviation_mm,
                sigma_mm=result.sigma_mm,
                left_plan=result.left_plan,
            ),
        )


def _code(status: int) -> Code:
    """A status of another node; one that this version does not know is a refusal."""
    return Code(status) if status in set(Code) - {Code.NONE} else Code.BAD_INPUT


def _done(response: Any) -> DriverAnswer:
    return DriverAnswer(Code.ACCEPT if response.success else Code.CONFLICT, response.message)


def _triggered(response: Any) -> DriverAnswer:
    """Of a twin, whose message is `trigger_text`."""
    number, name, words = response.message.split(" ", 2)
    code = Code[name] if name in Code.__members__ else Code.BAD_INPUT
    return DriverAnswer(code, words, int(number))


def _status(response: Any) -> DriverAnswer:
    return DriverAnswer(_code(response.status), response.message)


def _cycle(response: Any) -> DriverAnswer:
    return DriverAnswer(
        _code(response.status),
        response.message,
        response.candidate_id,
        tuple(response.missing),
        visited=response.visited if response.success else None,
    )


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


class MaintenanceNode(RobotNode):
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
        super().configure()
        settings, self._nominal = self.settings, self.robot.arm
        self._config = session_config(settings, self._nominal)
        load_motion(self._nominal)
        self._serial_in_use, self._history = open_history(settings, self.robot, self.NAME)
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
        path, mine = motion.topic.topic_name, self._outputs.accuracy_topic
        cell = "motion_lease", CORRECTION
        self._others = CommandPath(self, path, cell, mine, lambda: self.robot_fault)
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
        if self._config.fixture_poses is not None:
            self.add_input(PointStamped, POINT, self._take_feature, endpoints.STREAM)
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
            if self._motion.see_through(self._stops):
                self._lease.hold("")
            else:
                self._lease.lapse()
            self._session.close()
            self._show()
            gone = Accuracy(AccuracyLevel.FAULT, f"maintenance: {ENDS}")
            self._outputs.accuracy(gone, self._config.tolerance_m, self.now_ns())
        if self._calls is not None:
            self._calls.break_off(ENDS)
        self._session = None

    def _stops(self) -> bool:
        self._tick()
        return self._running().robot.stopping.under_way

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

    def _take_joints(self, message: Any) -> None:
        session = self._session
        if session is None:
            return
        if fault := self._guard.fault_at(self.inputs[JOINTS].received - 1):
            raise InputError(fault)
        late_s = self._motion.hear(message)
        sample = joint_sample(message)
        q = sample.position[sample.order(self._nominal.joint_names)]
        session.reading(sample.stamp_ns / NS, q, self._steady.now_s() - late_s)
        if late_s > BEHIND_S:
            self.take_waiting(JOINTS)

    def _take_gap(self, is_open: bool, echo: int | None) -> None:
        if self._session is not None:
            self._session.doubt_gap(self._sources.doubt())
            self._session.gap(is_open, echo, self._steady.now_s())
            self._tick()  # a gap that closes stops the robot now

    def _take_measurement(self, message: Any) -> None:
        if self._session is not None:
            self._session.measured(stamp_ns(message.header.stamp) / NS)

    def _take_feature(self, message: Any) -> None:
        if self._session is not None:
            self._session.measured(stamp_ns(message.header.stamp) / NS, of_fixture=True)

    def _take_accuracy(self, message: Any) -> None:
        if self._session is not None:
            require_robot(ACCURACY, message, self._nominal.name, self._serial_in_use)
            self._session.drift(drift_of_message(message), self._steady.now_s())

    def _take_correction(self, message: Any) -> None:
        if self._session is not None:
            require_robot(CORRECTION, message, self._nominal.name, self._serial_in_use)
            self._session.correction(correction_of_message(message), self._steady.now_s())

    def _reported(self, report: MotionReport) -> None:
        if self._session is not None:
            self._session.robot.reported(report)
            self._tick()  # a motion that was rejected, or a stop, is seen to now

    def _answered(self, number: int, answer: DriverAnswer) -> None:
        if self._session is not None:
            self._session.answered(number, answer)

    def _clocks(self) -> Now:
        return Now(self._steady.now_s(), time.time_ns())

    def _slept(self, for_s: float) -> None:
        if self._session is not None:
            self._session.slept(for_s)

    def _tick(self) -> None:
        if self._session is None:
            return
        requests = self._session.tick(*self._clocks())
        running, purpose = self._session.running, ""
        if running is not None:
            purpose = f"cycle '{running.cycle_id}'"
        elif self._session.robot.stopping.under_way:
            purpose = "a stop"
        self._lease.hold(purpose)  # before anything moves
        self._carry_out(requests)

    def _carry_out(self, requests: list[DriverRequest]) -> None:
        for request in requests:
            if isinstance(request, Move):
                self._motion.look()
                self._looked()
                if self._others.violation:
                    continue  # the cycle has ended by that
            if self._driver is not None:
                self._driver.carry_out(request)

    def _moves(self) -> None:
        if self._session is not None:
            self._session.sent(self._steady.now_s())

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
        if not (session.robot.moving or session.robot.stopping.under_way):
            self._motion.look()
        session.second(self._others.look(self._motion.action), now_s)
        return session

    def _show_accuracy(self) -> None:
        if self._session is None:
            return
        try:
            found = self._session.accuracy(*self._clocks())
            if self.robot_fault:  # what is known is of another robot
                found = Accuracy(AccuracyLevel.FAULT, f"robot: {self.robot_fault}")
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
        troubles = session.robot.trouble(self._steady.now_s()), self._motion.late()
        for trouble in filter(None, (*troubles, self._motion.hard_stop.absent)):
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
