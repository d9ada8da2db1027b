"""The services and the action of the maintenance node: what a PLC calls; each answers at once."""

from collections.abc import Callable
from typing import Any, NamedTuple

from action_msgs.msg import GoalStatus
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.qos import QoSProfile
from robocal_msgs.action import RunMaintenance
from robocal_msgs.msg import AccuracyState, MaintenanceResult, MaintenanceStatus
from robocal_msgs.srv import Acknowledge, Decide, GetMaintenance, RunMaintenanceCycle
from std_srvs.srv import Trigger

from robocal_ros.correction.status import CorrectionState, ToldCorrection
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.maintenance import CycleResult, MaintenanceSession, Status
from robocal_ros.maintenance.accuracy import Drift
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.decision_services import TWIN, DeferredActionServer
from robocal_ros.ros.endpoints import EndpointNode, NotActiveError, trigger_text
from robocal_ros.ros.session_node import SessionEvents
from robocal_ros.session.events import ACCEPT, REJECT, ROLLBACK
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel, ToolError
from robocal_ros.tool.services import ANSWERS

# ---- what the maintenance node says: its topics, and its results as messages --------------------


AddOutput = Callable[[type, str, QoSProfile], Any]


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


# ---- services -----------------------------------------------------------------------------------


DECISIONS = (ACCEPT, REJECT, ROLLBACK)


class Now(NamedTuple):
    """What the clocks show."""

    steady_s: float
    wall_ns: int


class MaintenanceServices:
    """``~/run_maintenance`` as action, the calls of a PLC, and their Trigger twins.

    Parameters
    ----------
    session : the one that runs; raises `NotActiveError` without one.
    starting : the same, for a cycle that is to begin, once it is known who else moves the robot.
    clocks : reads steady and wall clock.
    default_gap_s : of ``~/run_trigger``.
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
        add(Trigger, "~/acknowledge_trigger", self._twin(self._acknowledge_now))
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

    # ---- action ---------------------------------------------------------------------------------

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

    # ---- services -------------------------------------------------------------------------------

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

    # ---- Trigger twins --------------------------------------------------------------------------

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
            return 0, Code.STORAGE_FAILED, status.trouble
        if status.last is None:
            return waiting, Code.CONFLICT, "no cycle has ended yet"
        return waiting, status.last.code, session.memory.words_of(status.last)

    def _cancel_run(self) -> tuple[int, Code, str]:
        if self._session().cancel("cancelled by a Trigger"):
            return 0, Code.ACCEPT, "the cycle is broken off; the robot is brought home"
        return 0, Code.CONFLICT, "no cycle runs"

    def _acknowledge_now(self) -> tuple[int, Code, str]:
        return 0, Code.ACCEPT, self._session().acknowledge(TWIN)

    def _decide_only(self, name: str) -> Callable[[], tuple[int, Code, str]]:
        def decide() -> tuple[int, Code, str]:
            outcome = self._session().decide_only(name, TWIN, self._clocks().wall_ns)
            return outcome.calibration_id, outcome.status, outcome.message

        return decide


# ---- what other nodes say of one robot, as the maintenance session takes it: pure mapping -------


MM = 1e-3
LARGEST = 1e9  # mm, s: a figure beyond is a defect, and its square might be infinite


def require_robot(topic: str, message: Any, robot: str, serial: str) -> None:
    """Refuse what another robot's node says.

    Raises
    ------
    InputError
    """
    told, mine = (message.robot, message.serial), (robot, serial)
    if told != mine:
        raise InputError(
            f"{topic} is of robot and serial {told}, this node keeps {mine}: "
            "give both nodes the same, or mend the remapping"
        )


def told_drift(message: Any) -> Drift:
    """Read a ``robocal_msgs/AccuracyState`` of the thermal node.

    Raises
    ------
    InputError
        When its state is unknown, or a figure cannot be.
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
    return Drift(level, message.reason, found, due_in_s)


def told_correction(message: Any) -> ToldCorrection:
    """Read a ``robocal_msgs/CorrectionStatus``.

    Raises
    ------
    InputError
        When its state is unknown.
    """
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
