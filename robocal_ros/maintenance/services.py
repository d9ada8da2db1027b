# SPDX-License-Identifier: Apache-2.0
"""The maintenance node as a PLC sees it: parameters, services, the action, topics."""

from collections.abc import Callable, Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from action_msgs.msg import GoalStatus
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from robocal_msgs.action import RunMaintenance
from robocal_msgs.msg import AccuracyState, MaintenanceResult, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import Trigger

from robocal_ros.correction.interface import CorrectionState, ToldCorrection
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.kinematics import SerialArm
from robocal_ros.maintenance.accuracy import AcceptBounds, CycleResult, MaintenanceConfig, Times
from robocal_ros.maintenance.session import MaintenanceSession, Status
from robocal_ros.motion.driver import CONTROLLER, MOTION, driving_config, require_limits
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.conversions import MM, NO_POSES, joint_poses, joints_of
from robocal_ros.ros.endpoints import (
    DeferredActionServer,
    EndpointNode,
    NotActiveError,
    trigger_text,
)
from robocal_ros.ros.graph import GAP_BOOL, SHORTEST_STALE_S
from robocal_ros.ros.parameters import (
    ROBOT_SETTINGS,
    Setting,
    advanced,
    given_pose,
    number,
    pose_settings,
)
from robocal_ros.ros.session_node import STATE_DIR, TWIN, AddOutput, SessionEvents
from robocal_ros.session.events import ACCEPT, REJECT, ROLLBACK
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError
from robocal_ros.tool.laser_frame import read_laser_for
from robocal_ros.tool.services import ANSWERS


def result_message(result: CycleResult | None) -> MaintenanceResult:
    """How a cycle ended; all empty without one."""
    if result is None:
        return MaintenanceResult()
    return MaintenanceResult(
        cycle_id=result.cycle_id,
        stamp=conversions.time_message(result.stamp_ns),
        run=result.run,
        code=int(result.code),
        message=result.message,
        complete=result.complete,
        left=list(result.left),
        thermal_code=int(result.thermal_code),
        thermal_id=result.thermal_id,
        tool_found_code=int(result.tool_found_code),
        tool_code=int(result.tool_code),
        tool_id=result.tool_id,
        tool_answer=ANSWERS.get(result.tool_answer, 0),
        fixture_code=int(result.fixture_code),
        fixture_id=result.fixture_id,
        station_code=int(result.station_code),
        station_id=result.station_id,
        accepted=list(result.accepted),
    )


class MaintenanceOutputs:
    """Publishers of one robot's maintenance."""

    def __init__(self, add: AddOutput, robot: str, serial: str, base_frame: str) -> None:
        self._robot, self._serial, self._base = robot, serial, base_frame
        self._status = add(MaintenanceStatus, "~/status", endpoints.LATCHED)
        self._accuracy = add(AccuracyState, "accuracy_state", endpoints.LATCHED)
        self.accuracy_topic: str = self._accuracy.topic_name
        self.events = SessionEvents(add)

    def status_message(self, status: Status, now_ns: int) -> MaintenanceStatus:
        """A status."""
        return MaintenanceStatus(
            header=conversions.header(now_ns, self._base),
            state=int(status.state),
            beat=status.beat,
            cycle_id=status.cycle_id,
            doing="; ".join(filter(None, (status.doing or status.closed, status.trouble))),
            left_s=status.left_s,
            at_home=status.at_home,
            disarmed=status.disarmed,
            thermal_pending=status.thermal_pending,
            tool_pending=status.tool_pending,
            fixture_pending=status.fixture_pending,
            fault_code=int(status.fault_code),
            fault=status.fault,
            last=result_message(status.last),
        )

    def status(self, status: Status, now_ns: int) -> MaintenanceStatus:
        """Say it."""
        message = self.status_message(status, now_ns)
        self._status.publish(message)
        return message

    def accuracy(self, found: Accuracy, tolerance_m: float, now_ns: int) -> None:
        """Tell the line how accurate the cell is believed to be."""
        self._accuracy.publish(
            AccuracyState(
                header=conversions.header(now_ns, self._base),
                robot=self._robot,
                serial=self._serial,
                **found.document(tolerance_m),
            )
        )


DECISIONS = (ACCEPT, REJECT, ROLLBACK)


class Now(NamedTuple):
    """What the clocks show."""

    steady_s: float
    wall_ns: int


class MaintenanceServices:
    """``~/run_maintenance`` as action, the calls of a PLC, and their Trigger twins.

    ``session``: the one that runs; raises `NotActiveError` without one. ``starting``: the same, for
    a cycle that is to begin, once it is known who else moves the robot. ``clocks``: reads steady
    and wall clock. ``default_gap_s``: of ``~/run_trigger``.
    """

    def __init__(
        self,
        node: EndpointNode,
        session: Callable[[], MaintenanceSession],
        starting: Callable[[], MaintenanceSession],
        clocks: Callable[[], Now],
        outputs: MaintenanceOutputs,
        default_gap_s: float,
    ) -> None:
        self._node, self._session, self._starting = node, session, starting
        self._clocks = clocks
        self._outputs, self._default_gap_s = outputs, default_gap_s
        self._goals: list[ServerGoalHandle] = []
        add = node.add_service
        add(RunMaintenanceCycle, "~/run", self._run)
        add(GetMaintenance, "~/status", self._status)
        add(Acknowledge, "~/acknowledge", self._acknowledge)
        for name in DECISIONS:
            add(Decide, f"~/{name}", self._decide(name))
            add(Trigger, f"~/{name}_trigger", self._twin(self._decide_only(name)))
        add(Trigger, "~/run_trigger", self._twin(self._run_now))
        add(Trigger, "~/status_trigger", self._twin(self._last))
        add(Trigger, "~/cancel_trigger", self._twin(self._cancel_run))
        acknowledge = self._twin(lambda: (0, Code.ACCEPT, self._session().acknowledge(TWIN)))
        add(Trigger, "~/acknowledge_trigger", acknowledge)
        self._server = DeferredActionServer(
            node,
            RunMaintenance,
            "~/run_maintenance",
            goal_callback=lambda goal: GoalResponse.ACCEPT,
            handle_accepted_callback=self._begin,
            cancel_callback=self._cancel,
        )

    def close(self) -> None:
        """Take the action down."""
        self._server.destroy()

    def _begin(self, goal: ServerGoalHandle) -> None:
        goal.execute()
        request, now = goal.request, self._clocks()
        try:
            if not self._node.is_active:
                raise NotActiveError(f"the node is {self._node.state}")
            self._starting().run(request.cycle_id, request.gap_s, now.steady_s, now.wall_ns)
        except RobocalError as error:
            self._end(goal, CycleResult(request.cycle_id, error.code, str(error)), str(error))
            return
        self._goals.append(goal)
        self.look()

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        running = self._session().running if goal in self._goals else None
        if running is None or running.cycle_id != goal.request.cycle_id:
            return CancelResponse.REJECT  # it has ended; another cycle is not meant
        self._session().cancel("cancelled by the caller of the action")
        return CancelResponse.ACCEPT

    def look(self, status: Status | None = None) -> None:
        """End the goals whose cycles have ended; tell the others what goes on."""
        for goal in list(self._goals):
            result = self._session().result(goal.request.cycle_id)
            if result is not None and result.code is not Code.NONE:
                self._goals.remove(goal)
                self._end(goal, result, self._session().memory.words_of(result))
            elif status is not None:
                message = self._outputs.status_message(status, self._node.now_ns())
                goal.publish_feedback(RunMaintenance.Feedback(state=message))

    def break_off(self, reason: str) -> None:
        """The node goes: its callers are told."""
        for goal in self._goals:
            self._end(goal, CycleResult(goal.request.cycle_id, Code.CONFLICT, reason), reason)
        self._goals.clear()

    def _end(self, goal: ServerGoalHandle, result: CycleResult, words: str) -> None:
        done = result.code is Code.ACCEPT
        answer = RunMaintenance.Result(
            success=done,
            message=words,
            status=int(result.code),
            result=result_message(result),
        )
        status = GoalStatus.STATUS_SUCCEEDED if done else GoalStatus.STATUS_CANCELED
        self._server.end(goal, status, answer)

    def _run(self, request: Any, response: Any) -> Any:
        now = self._clocks()
        result = self._starting().run(request.cycle_id, request.gap_s, now.steady_s, now.wall_ns)
        response.success, response.status = True, int(Code.ACCEPT)
        memory = self._session().memory
        response.before_start = result.cycle_id in memory.earlier
        response.message = memory.words_of(result) or f"cycle '{result.cycle_id}' runs"
        response.result = result_message(result)
        return response

    def _status(self, request: Any, response: Any) -> Any:
        session = self._session()
        status = session.status(self._clocks().steady_s)
        response.state = self._outputs.status_message(status, self._node.now_ns())
        result = session.result(request.cycle_id) if request.cycle_id else status.last
        response.result = result_message(result)
        if request.cycle_id and result is None:
            raise InputError(f"cycle '{request.cycle_id}' is not known: it never ran, or long ago")
        response.success, response.status = True, int(Code.ACCEPT)
        response.message = status.fault or status.doing or status.state.name
        if result is not None and request.cycle_id in session.memory.earlier:
            response.message = f"{response.message}; {session.memory.words_of(result)}"
        if status.trouble:
            response.success, response.status = False, int(Code.STORAGE_FAILED)
            response.message = status.trouble
        return response

    def _acknowledge(self, request: Any, response: Any) -> Any:
        response.message = self._session().acknowledge(request.by)
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    def _decide(self, name: str) -> Callable[[Any, Any], Any]:
        def decide(request: Any, response: Any) -> Any:
            if request.id == 0:
                raise InputError(f"{name} needs the id of a calibration; ask ~/status for it")
            outcome = self._session().decide(
                name, request.id, request.by, request.reason, self._clocks().wall_ns
            )
            response.success, response.status = outcome.done, int(outcome.status)
            response.message, response.revision = outcome.message, outcome.revision
            return response

        return decide

    def _twin(self, act: Callable[[], tuple[int, Code, str]]) -> Callable[[Any, Any], Any]:
        def trigger(request: Any, response: Any) -> Any:
            try:
                number, code, words = act()
            except RobocalError as error:
                number, code, words = 0, error.code, str(error)
            response.success = code is Code.ACCEPT
            response.message = trigger_text(number, code, words)
            return response

        return trigger

    def _run_now(self) -> tuple[int, Code, str]:
        now, session = self._clocks(), self._starting()
        if (running := session.running) is None:
            name = f"at {now.wall_ns}"
            session.run(name, self._default_gap_s, now.steady_s, now.wall_ns)
            return 0, Code.ACCEPT, f"cycle '{name}' begins"
        return 0, Code.ACCEPT, f"cycle '{running.cycle_id}' runs already"

    def _last(self) -> tuple[int, Code, str]:
        """NONE while a cycle runs, for a PLC that asks until it has ended."""
        session = self._session()
        status = session.status(self._clocks().steady_s)
        waiting = status.thermal_pending or status.tool_pending
        if status.fault:
            return waiting, status.fault_code, status.fault
        if session.running is not None:
            return waiting, Code.NONE, status.doing
        if status.trouble:
            return waiting, Code.STORAGE_FAILED, status.trouble
        if status.last is None:
            return waiting, Code.CONFLICT, "no cycle has ended yet"
        return waiting, status.last.code, session.memory.words_of(status.last)

    def _cancel_run(self) -> tuple[int, Code, str]:
        if self._session().cancel("cancelled by a Trigger"):
            return 0, Code.ACCEPT, "the cycle is broken off; the robot is brought home"
        return 0, Code.CONFLICT, "no cycle runs"

    def _decide_only(self, name: str) -> Callable[[], tuple[int, Code, str]]:
        def decide() -> tuple[int, Code, str]:
            outcome = self._session().decide_only(name, TWIN, self._clocks().wall_ns)
            return outcome.calibration_id, outcome.status, outcome.message

        return decide


LARGEST = 1e9  # mm, s: a figure beyond is a defect, and its square might be infinite


def require_robot(topic: str, message: Any, robot: str, serial: str) -> None:
    """Refuse what another robot's node says. Raises `InputError`."""
    told, mine = (message.robot, message.serial), (robot, serial)
    if told != mine:
        raise InputError(
            f"{topic} is of robot and serial {told}, this node keeps {mine}: "
            "give both nodes the same, or mend the remapping"
        )


def drift_of_message(message: Any) -> Accuracy:
    """Read a ``robocal_msgs/AccuracyState`` of the thermal node.

    Raises `InputError` when its state is unknown, or a figure cannot be.
    """
    try:
        level = AccuracyLevel(message.state)
    except ValueError as error:
        raise InputError(f"accuracy state {message.state} is unknown") from error
    rms_mm, bound_mm, due_in_s = message.predicted_error_mm, message.bound_mm, message.due_in_s
    if not all(abs(figure) <= LARGEST for figure in (rms_mm, bound_mm, due_in_s)):
        raise InputError(f"rms {rms_mm:g} mm, bound {bound_mm:g} mm, due in {due_in_s:g} s")
    known = rms_mm >= 0.0 and bound_mm >= 0.0
    found = ToolError(rms_mm * MM, bound_mm * MM) if known else None
    return Accuracy(level, message.reason, found, due_in_s)


def correction_of_message(message: Any) -> ToldCorrection:
    """Read a ``robocal_msgs/CorrectionStatus``. Raises `InputError` when its state is unknown."""
    try:
        state = CorrectionState(message.state)
    except ValueError as error:
        raise InputError(f"correction state {message.state} is unknown") from error
    return ToldCorrection(
        state=state,
        enabled=message.enabled,
        shadow=message.shadow,
        model_revision=message.model_revision,
        tool_revision=message.tool_revision,
        waiting_tool_revision=message.waiting_tool_revision if message.tool_waits else None,
        stale=message.stale,
        mismatch=message.mismatch,
        commanders=message.commanders,
        last_refusal=message.last_refusal,
    )


SHORTEST_SILENCE_S = 2.0


def _silence_fault(silent_s: float) -> str | None:
    told = 0.0 < silent_s < SHORTEST_SILENCE_S
    return f"0, or {SHORTEST_SILENCE_S:g} s at least: it is told each second" if told else None


SETTINGS = (
    *ROBOT_SETTINGS,
    STATE_DIR,
    *pose_settings(
        "taught",
        "Taught tool in the flange frame; as the quaternion at its default: the robot file's",
        "Its orientation: z from flange to tip",
    ),
    number(
        "home_deg",
        [0.0],
        "Taught home pose, a number for each joint (sliding joint: mm)",
        -1e5,
        1e5,
    ),
    number(
        "measuring_poses_deg",
        NO_POSES,
        "Measuring poses, one after the other, each as home_deg; at its default: no thermal "
        "measurement",
        -1e5,
        1e5,
    ),
    number(
        "fixture_poses_deg",
        NO_POSES,
        "Poses at which fixture_node's sensor sees the fixture's features, as measuring_poses_deg; "
        "at its default: no fixture measurement",
        -1e5,
        1e5,
    ),
    number("fixture_visits", 2, "Each of them is visited so often in a measurement", 1, 10),
    Setting(
        "laser",
        "",
        "Laser file of the station, as tcf_node's; empty: no tool measurement",
    ),
    number(
        "travel_speed_mm_s", 250.0, "Largest speed of the tip between the taught poses", 1.0, 5000.0
    ),
    number(
        "home_near_deg",
        0.5,
        "The robot is at home with all joints so near (sliding joint: mm)",
        0.01,
        5.0,
    ),
    *MOTION,
    *CONTROLLER,
    number("default_gap_s", 60.0, "Length of the gap of ~/run_trigger", 0.01, 86400.0),
    number(
        "gap_stale_s",
        0.5,
        "gap_open may pause for so long, and so old may the beat be that it echoes",
        SHORTEST_STALE_S,
        0.5,
    ),
    GAP_BOOL,
    number("measurements", 1, "So many measurements make a pose measured", 1, 1000),
    number("check_s", 15.0, "A quick check takes at the most", 1.0, 600.0),
    number("full_s", 30.0, "A full tool measurement takes at the most", 1.0, 3600.0),
    number("laser_frame_s", 90.0, "Finding the beams with the mandrel, the same", 1.0, 3600.0),
    number(
        "resume_within_s",
        600.0,
        "An unfinished thermal cycle goes on when its last pose is no older; a minute shorter than "
        "thermal_node's cycle_timeout_s",
        0.01,
        86400.0,
    ),
    number(
        "cycle_within_s",
        900.0,
        "With poses that are left it goes on when its first pose is no older, else it ends with "
        "those it has: they count as measured at once",
        0.01,
        86400.0,
    ),
    number("check_every_s", 0.0, "A quick check is due so often; 0: in each gap", 0.0, 1e7),
    number(
        "full_every_s",
        0.0,
        "A full tool measurement is due so often, when time allows; 0: only when needed",
        0.0,
        1e7,
    ),
    number(
        "laser_frame_every_s",
        0.0,
        "The beams are found again with the mandrel so often, when time allows; 0: never",
        0.0,
        1e8,
    ),
    number("tool_due_s", 7200.0, "Age of a tool check at which accuracy_state is DUE", 0.01, 1e7),
    number("tool_expires_s", 28800.0, "Age at which it is EXPIRED", 0.01, 1e7),
    number(
        "correction_silent_s",
        5.0,
        "joint_correction_node's status may pause for so long; 0: there is none, the robot's "
        "controller takes model and tool itself",
        0.0,
        600.0,
        check=_silence_fault,
    ),
    number("tolerance_mm", 0.3, "Error of the tool that the process allows", 0.001, 100.0),
    Setting("auto_accept", False, "Accept inside the bounds without a person"),
    number(
        "accept_thermal_mm",
        1.0,
        "Largest shift of the tip since commissioning at home and measuring poses",
        0.001,
        100.0,
    ),
    number("accept_tool_mm", 1.0, "Largest distance of the tip from the taught one", 0.001, 100.0),
    number("accept_tool_deg", 1.5, "Largest tilt of the axis from the taught one", 0.001, 90.0),
    *advanced(
        number(
            "rest_s", 1.0, "After a motion's end, until the robot rests where it ends", 0.1, 10.0
        ),
        number("reserve_s", 1.0, "Kept free before the end of a gap", 0.01, 60.0),
        number("settle_s", 0.3, "A measurement counts so long after the robot stands", 0.01, 10.0),
        number(
            "stay_s",
            0.2,
            "The robot stays so long after the last measurement of a pose",
            0.01,
            10.0,
        ),
        number("measure_s", 3.0, "The longest time at a pose", 0.01, 600.0),
        number("answer_s", 1.0, "Another node answers within", 0.1, 60.0),
        number("solve_s", 6.0, "thermal_node ends a cycle within", 0.1, 600.0),
        number("tool_home_s", 10.0, "Kept free for the way home from the beams", 0.1, 600.0),
        number(
            "thermal_silent_s", 5.0, "thermal_node's accuracy may pause for so long", 1.0, 600.0
        ),
    ),
)


def session_config(settings: Mapping[str, Any], arm: SerialArm) -> MaintenanceConfig:
    """Settings of the session, in SI.

    Raises `InputError` when a value makes no sense, or the laser file cannot be read.
    """
    driving = driving_config(settings)
    require_limits(arm, driving)
    laser = settings["laser"]
    taught = given_pose(settings, "taught")
    degree = float(np.radians(1.0))
    fixture = joint_poses(arm, settings["fixture_poses_deg"], "fixture_poses_deg")
    return MaintenanceConfig(
        home=joints_of(arm, settings["home_deg"], "home_deg"),
        poses=joint_poses(arm, settings["measuring_poses_deg"], "measuring_poses_deg"),
        T_flange_tool=arm.T_flange_tool if taught is None else taught,
        driving=driving,
        T_base_laser=read_laser_for(Path(laser), arm).laser.T_base_laser if laser else None,
        fixture_poses=fixture if len(fixture) else None,
        fixture_visits=settings["fixture_visits"],
        travel_speed_m_s=settings["travel_speed_mm_s"] * MM,
        home_near=settings["home_near_deg"] * np.where(arm.prismatic, MM, degree),
        measurements=settings["measurements"],
        resume_within_s=settings["resume_within_s"],
        cycle_within_s=settings["cycle_within_s"],
        check_every_s=settings["check_every_s"],
        full_every_s=settings["full_every_s"],
        laser_frame_every_s=settings["laser_frame_every_s"],
        tool_due_s=settings["tool_due_s"],
        tool_expires_s=settings["tool_expires_s"],
        silent_s=settings["thermal_silent_s"],
        correction_silent_s=settings["correction_silent_s"],
        tolerance_m=settings["tolerance_mm"] * MM,
        times=Times(
            stale_s=settings["gap_stale_s"],
            **{each.name: settings[each.name] for each in fields(Times) if each.name != "stale_s"},
        ),
        bounds=AcceptBounds(
            settings["auto_accept"],
            settings["accept_thermal_mm"] * MM,
            settings["accept_tool_mm"] * MM,
            settings["accept_tool_deg"] * degree,
        ),
    )
