# SPDX-License-Identifier: Apache-2.0
"""A node that drives a session with live messages and calls: its history, clocks and services."""

import json
import time
import traceback
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar, Generic, TypeVar

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from robocal_msgs.msg import SessionEvent
from robocal_msgs.srv import Decide, ListCalibrations
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, InputError, RobocalError, WrongRobotError
from robocal_ros.ground.files import StateFile
from robocal_ros.ground.samples import JOINTS, stamp_ns
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import acknowledge, damage_notice, history_path, state_folder
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import arm_of, layer_of, payload_note
from robocal_ros.kinematics.joint_errors import SIZE_URAD
from robocal_ros.kinematics.robots import RobotDescription
from robocal_ros.ros.base import NO_SERIAL, POLL_S
from robocal_ros.ros.conversions import summary_message, time_message
from robocal_ros.ros.endpoints import (
    ERROR,
    WARN,
    EndpointNode,
    Health,
    InputCount,
    NotActiveError,
    trigger_text,
)
from robocal_ros.ros.graph import SourceGuard
from robocal_ros.ros.parameters import Setting, number
from robocal_ros.ros.robot import RobotNode
from robocal_ros.session.events import (
    ACCEPT,
    CONFIGURE,
    NEWEST,
    ONLY,
    REJECT,
    ROLLBACK,
    Command,
    Outcome,
    SessionBase,
    arguments_text,
    outcome_text,
)


class DataClock:
    """The samples' clock, read between them too: ROS time runs on where they pause."""

    def __init__(self) -> None:
        self._newest_ns: int | None = None
        self._read_ns = 0

    def at(self, newest_ns: int | None, now_ns: int) -> int:
        """Time of the samples' clock at ROS time ``now_ns``; that itself before the first."""
        if newest_ns is None:
            return now_ns
        if newest_ns != self._newest_ns:
            self._newest_ns, self._read_ns = newest_ns, now_ns
        return newest_ns + max(now_ns - self._read_ns, 0)


AHEAD_S = 0.1  # hosts that NTP keeps are some ms apart; a busy host makes messages old, not early
SILENT_S = 5.0


class StampWatch:
    """Judges inputs by receive time, beside the sessions, which go by the stamps alone.

    An input is ahead where every message since the last look was: one wrong stamp is the sessions'
    to leave out. With simulated time the stamps are the clock, and only silence is judged.

    ``node``: its clock is what stamps are compared with. ``needed``: the topic whose silence is
    worth a warning once it has been heard.
    """

    def __init__(self, node: EndpointNode, needed: str) -> None:
        self._node, self._needed = node, needed
        self._simulated = bool(node.get_parameter("use_sim_time").value)
        self._least_ns: dict[str, int] = {}  # smallest lead of the stamps since the last look
        self._ahead_ns: dict[str, int] = {}  # as the last look found it
        self._heard_s: dict[str, float] = {}  # steady clock

    def note(self, topic: str, message: Any) -> None:
        """Take notice of a message that has come in."""
        self._heard_s[topic] = time.monotonic()
        if not self._simulated:
            lead = stamp_ns(message.header.stamp) - self._node.now_ns()
            self._least_ns[topic] = min(lead, self._least_ns.get(topic, lead))

    def judge(self, health: Health) -> dict[str, object]:
        """Add what is wrong to a node's health; returns figures of each input."""
        self._ahead_ns |= self._least_ns
        self._least_ns.clear()
        for topic, lead in self._ahead_ns.items():
            if lead > AHEAD_S * 1e9:
                health.worsen(
                    ERROR,
                    f"{topic} is stamped {lead * 1e-9:.2f} s ahead of this host's clock: set the "
                    "clocks of both (NTP or PTP)",
                )
        now = time.monotonic()
        silent = {topic: now - heard for topic, heard in self._heard_s.items()}
        if silent.get(self._needed, 0.0) > SILENT_S:
            health.worsen(
                WARN, f"{self._needed} is silent for {silent[self._needed]:.0f} s: check its driver"
            )
        return {f"{topic} last received s ago": f"{s:.1f}" for topic, s in silent.items()}


STATE_DIR = Setting(
    "state_dir", "", "Folder of the histories; empty: $ROBOCAL_STATE, else the XDG folder"
)
JOINT_ERROR = number(
    "joint_error_urad",
    SIZE_URAD,
    "Joints turn by so much, rms, otherwise than they read, where the model in force has no "
    "joint functions; a UR10's do by 300, makers of gears state 50; 0: nothing is said of it",
    0.0,
    1e4,
)


def open_history(
    settings: Mapping[str, Any],
    robot: RobotDescription,
    sole_user: str = "",
    *,
    owner: bool = True,
) -> tuple[str, CalibrationHistory]:
    """The serial in use and its history; ``sole_user``: a node of which a robot has one at most.

    ``owner``: a damaged history is set aside; who only adds to it is refused.

    Raises `RobocalError` as `CalibrationHistory.open`; also where no serial is set and the history
    was begun with another robot file: nothing else tells two robots of one type apart.
    """
    serial, state_dir = settings["serial"] or NO_SERIAL, _folder(settings)
    nominal = robot.arm
    history = CalibrationHistory.open(
        serial, model_hash=nominal.model_hash, state_dir=state_dir, sole_user=sole_user, owner=owner
    )
    if serial == NO_SERIAL:
        try:
            own = {"robot": nominal.name, "robot_file_hash": robot.file_hash}
            kept = StateFile(history.path, "robot_file")
            known = kept.load()
            if known is None:
                kept.save(own)
            elif known != own:
                raise WrongRobotError(
                    f"no serial is set, and {history.path} was begun with another robot file (hash "
                    f"{known.get('robot_file_hash')} of robot '{known.get('robot')}', this is "
                    f"{own['robot_file_hash']} of '{nominal.name}'): set the serial of each robot; "
                    "if it is the same robot with its file changed, remove the folder "
                    f"{kept.path.parent}"
                )
        except BaseException:
            history.close()
            raise
    return serial, history


def history_notice(settings: Mapping[str, Any]) -> str:
    """Tell of a damaged history that nobody has acknowledged; empty without one.

    For a node that does not hold the history open.
    """
    folder = _folder(settings) or state_folder()
    return damage_notice(history_path(settings["serial"] or NO_SERIAL, folder))


def acknowledge_history(settings: Mapping[str, Any], by: str) -> None:
    """Write down that somebody knows of a damaged history."""
    folder = _folder(settings) or state_folder()
    acknowledge(history_path(settings["serial"] or NO_SERIAL, folder), by, time.time_ns())


def _folder(settings: Mapping[str, Any]) -> Path | None:
    folder = settings[STATE_DIR.name]
    return Path(folder) if folder else None


def warn_of_history(health: Health, history: CalibrationHistory) -> None:
    """Tell of a damaged history that nobody has acknowledged, and that no serial is set."""
    if notice := damage_notice(history.path):
        health.worsen(WARN, notice)
    if history.serial == NO_SERIAL:
        health.worsen(
            WARN,
            f"no serial is set: the history is kept as '{NO_SERIAL}', and only the robot file "
            "tells this robot from another one of its type",
        )


# A recorder that comes later still gets the events.
EVENTS = QoSProfile(
    history=HistoryPolicy.KEEP_LAST,
    depth=100,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)


COMMAND_S = 1.0  # a command waits at most so long for its samples
AddOutput = Callable[[type, str, QoSProfile], Any]


class SessionEvents:
    """Publisher of one session's events."""

    def __init__(self, add: AddOutput) -> None:
        self._events = add(SessionEvent, "~/session_events", EVENTS)
        self._sequence = 0
        self._since = 0  # events after the last configuration

    def tell(self, command: Command, outcome: Outcome | None) -> None:
        """Record a command and what came of it, None for the configuration."""
        self._sequence += 1
        self._since = 0 if command.name == CONFIGURE else self._since + 1
        self._events.publish(
            SessionEvent(
                stamp=time_message(command.stamp_ns or 0),
                sequence=self._sequence,
                command=command.name,
                arguments=arguments_text(command),
                outcome="{}" if outcome is None else outcome_text(outcome),
            )
        )

    @property
    def need_configuration(self) -> bool:
        """Whether to tell the configuration again although nothing has changed.

        A recording that begins later gets the last events alone, and cannot be replayed without a
        configuration among them.
        """
        return self._since >= EVENTS.depth // 2


class CommandQueue:
    """Between the callers of a node and its session.

    ``timeout_s``: a command waits at most so long for its samples. ``look``: called before each is
    carried out. ``show``: takes each outcome, also of what was decided outside. ``session``: None
    while the node is inactive.
    """

    def __init__(
        self,
        node: EndpointNode,
        timeout_s: float,
        look: Callable[[], None],
        show: Callable[[Outcome], None],
    ) -> None:
        self._node, self._look, self._show = node, look, show
        self._asked: deque[Future] = deque()
        self.session: SessionBase | None = None
        self._deadline = node.add_timer(timeout_s, lambda: self.step(force=True), steady=True)
        self._deadline.cancel()

    def ask(self, command: Command) -> Future:
        """Give a command to the session; the future becomes its outcome."""
        if self.session is None:
            raise NotActiveError("no session: activate the node")
        future: Future = Future()
        if not self._asked:
            self._deadline.reset()
        self._asked.append(future)
        self.session.submit(command, self._node.now_ns())
        self.step()
        return future

    def step(self, *, force: bool = False) -> None:
        """Carry out the commands whose samples are complete."""
        while self.session is not None and self._asked:
            if not (force or self.session.ready):
                return
            self._tell(self._look)
            try:
                outcomes: list[Any] = self.session.step(wall_ns=time.time_ns(), force=force)
            except Exception as error:  # a defect must not end the node: the caller is told
                self._asked.popleft().set_exception(error)
                continue
            if not outcomes:
                return
            asked = self._asked.popleft()  # before it is shown: that may give a command too
            for outcome in outcomes:
                self._tell(self._show, outcome)
            asked.set_result(outcomes[-1])
        self._deadline.cancel()

    def _tell(self, tell: Callable[..., None], *outcome: Outcome) -> None:
        try:
            tell(*outcome)
        except Exception:  # must not take the answer from its caller
            self._node.get_logger().error(f"not shown:\n{traceback.format_exc()}")

    def close(self) -> None:
        """End the session; calls that wait are answered."""
        self.session = None
        self._deadline.cancel()
        while self._asked:
            error = NotActiveError("deactivated while the command waited: nothing was done")
            self._asked.popleft().set_exception(error)


class _LastTaken:
    """The last message of an input that a session was given: it is told what is missing after it.

    ``count``: of the input. ``left_out``: messages since then were not given to it.
    """

    def __init__(self, count: InputCount) -> None:
        self._count, self._lost = count, 0
        self._session: SessionBase | None = None
        self._stamp_ns = 0
        self.left_out = False

    def note(self, session: SessionBase, kind: str, stamp_ns: int) -> None:
        """The session is given the message of this stamp now."""
        missing = self.left_out or self._count.lost != self._lost
        if missing and self._session is session:
            session.lose(kind, self._stamp_ns, stamp_ns)
        self._session, self._stamp_ns = session, stamp_ns
        self._lost, self.left_out = self._count.lost, False


SessionT = TypeVar("SessionT", bound=SessionBase)


class SessionNode(RobotNode, Generic[SessionT]):
    """Drives a session of one robot with live messages and calls.

    A node calls `open_session` in ``configure``, and says what its session is, how that takes a
    message, what to show, and how it is.
    """

    INPUTS: ClassVar[Mapping[str, tuple[type, QoSProfile]]]
    _nominal: SerialArm

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._session: SessionT | None = None
        self._history: CalibrationHistory | None = None

    def configure(self) -> None:
        """Find the robot."""
        super().configure()
        self._nominal = self.robot.arm

    def new_session(self, history: CalibrationHistory) -> SessionT:
        """The session of an active node."""
        raise NotImplementedError

    def take(self, session: SessionT, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to the session."""
        raise NotImplementedError

    def polled(self, session: SessionT) -> None:
        """Do what is due twice a second."""

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        raise NotImplementedError

    def show_in_force(self) -> None:
        """Publish what is in force and record the new state, when either changed."""
        raise NotImplementedError

    def report(self, session: SessionT, history: CalibrationHistory, health: Health) -> None:
        """Add to ``health`` what is of this node alone."""

    def open_session(
        self, command_s: float = COMMAND_S, *, sole: bool = True
    ) -> CalibrationHistory:
        """Open the robot's history and the inputs; the outcomes of commands go to `show`.

        ``command_s``: a command waits at most so long for its samples. ``sole``: a robot has one
        such node at most. Raises as `open_history`.
        """
        self._payload = -1, ""  # revision of the thermal model, and what is said of it
        self._serial_in_use, self._history = open_history(
            self.settings, self.robot, self.NAME if sole else ""
        )
        self._guard = SourceGuard(self, JOINTS)
        self._stamps = StampWatch(self, JOINTS)
        self._topics = {kind: self.resolve_topic_name(kind) for kind in self.INPUTS}
        for kind, (message_type, profile) in self.INPUTS.items():
            self.add_input(message_type, kind, self._taker(kind), profile, numbered=True)
        self._desk = CommandQueue(self, command_s, self._look, self._show)
        self.add_timer(POLL_S, self._poll, steady=True)
        return self._history

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        if self._history is None:
            raise ValueError("activated before it was configured")
        self._session = self._desk.session = self.new_session(self._history)

    def deactivate(self) -> None:
        """End the session; calls that wait are answered."""
        self._session = None
        self._desk.close()

    def cleanup(self) -> None:
        """Close the history."""
        self._session = None
        if self._history is not None:
            self._history.close()
        self._history = None

    def _taker(self, kind: str) -> Callable[[Any], None]:
        last = _LastTaken(self.inputs.setdefault(kind, InputCount()))

        def take(message: Any) -> None:
            session = self._session
            if session is None:
                return
            self._stamps.note(kind, message)
            if kind == JOINTS and (fault := self._guard.fault_at(session.received[JOINTS])):
                last.left_out = True
                session.refuse(JOINTS, InputError(fault))
                return
            last.note(session, kind, stamp_ns(message.header.stamp))
            self.take(session, kind, message)

        return take

    def _poll(self) -> None:
        self._guard.look()
        self._look(due=True)

    def _look(self, *, due: bool = False) -> None:
        """Tell what others brought into force: before the command that goes by it.

        ``due``: do what is due, too.
        """
        if self._session is None:
            return
        try:
            if due:
                self.polled(self._session)
            for outcome in self._session.poll():
                self._show(outcome)
            self.show_in_force()
        except RobocalError as error:  # the history cannot be read: tried again at the next poll
            self.get_logger().error(str(error), throttle_duration_sec=5.0)

    def _show(self, outcome: Outcome) -> None:
        words = f"{outcome.command.name}: {outcome.status.name} {outcome.message}"
        if outcome.done:
            self.get_logger().info(words)
        else:
            self.get_logger().warning(words)
        self.show(outcome)

    def identity(self) -> list[str]:
        """Robot and serial, and what is in force of it."""
        try:
            heads = self._history.heads() if self._history is not None else ()
        except RobocalError as error:  # no reason not to start
            return [*super().identity(), str(error)]
        told = [f"{h.kind} revision {h.revision} in force" for h in heads if h.calibration_id]
        return [*super().identity(), *(told or ["nothing measured is in force"])]

    def health(self) -> Health:
        """Tell what is in force, what was lost or ignored, what is wrong."""
        session, history, health = self._session, self._history, Health()
        if session is None or history is None:
            return health
        health.values = {"revision in force": session.in_force.revision}
        self.report(session, history, health)
        if lost := [topic for topic, count in self.inputs.items() if count.lost]:
            health.worsen(WARN, f"messages lost on {', '.join(lost)}")
        if note := self._payload_note(history):
            health.worsen(WARN, note)
        health.values |= session.ignored.listed() | self._stamps.judge(health)
        for fault in filter(None, (self._guard.fault, session.fault)):
            health.worsen(ERROR, fault)
        warn_of_history(health, history)
        return health

    def _payload_note(self, history: CalibrationHistory) -> str:
        """What another payload than the thermal model's may cost; looked at once for each model."""
        try:
            head = history.head(THERMAL)
            if self._payload[0] != head.revision:
                model, note = head.model, ""
                if model is not None:
                    arm, (_, load) = arm_of(model, self._nominal), layer_of(model)
                    note = payload_note(arm, load, self._nominal.load)
                self._payload = head.revision, note
            return self._payload[1]
        except RobocalError:  # told as the session's fault
            return ""


LIST_LIMIT = 50
TWIN = "trigger"

AddService = Callable[[type, str, Callable[[Any, Any], Any]], None]
Ask = Callable[[Command], Awaitable[Outcome]]


class DecisionServices:
    """Services about the calibrations of one kind.

    ``add``: creates a service. ``ask``: gives a command to the session and awaits its outcome.
    """

    def __init__(self, add: AddService, ask: Ask, history: CalibrationHistory, kind: str) -> None:
        self._ask, self._history, self._kind = ask, history, kind
        add(ListCalibrations, "~/list", self._list)
        add(Trigger, "~/list_trigger", self._list_twin)
        for name in (ACCEPT, REJECT, ROLLBACK):
            add(Decide, f"~/{name}", self._decide(name))
        add(Trigger, "~/accept_trigger", twin(ask, ACCEPT, {"choose": ONLY}))
        add(Trigger, "~/reject_trigger", self._reject_twin)
        add(Trigger, "~/rollback_trigger", twin(ask, ROLLBACK, {"previous": True}))

    def _decide(self, name: str) -> Callable[[Any, Any], Any]:
        async def decide(request: Any, response: Any) -> Any:
            if name != ROLLBACK and request.id == 0:
                raise InputError(f"{name} needs the id of a calibration; look at the list")
            arguments = {"id": request.id, "by": request.by, "reason": request.reason}
            outcome = await self._ask(Command(name, arguments))
            response.revision = outcome.revision
            return answer(response, outcome)

        return decide

    def _list(self, request: Any, response: Any) -> Any:
        entries = self._history.list(request.limit or LIST_LIMIT)
        response.calibrations = [summary_message(entry) for entry in entries]
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    def _list_twin(self, request: Any, response: Any) -> Any:
        lines = [
            {
                "id": entry.id,
                "revision": entry.revision,
                "kind": entry.kind,
                "state": entry.state.value,
                "code": entry.code.name,
                "cycle_id": entry.cycle_id,
                "candidate_rms_mm": entry.candidate_rms_mm,
            }
            for entry in self._history.list(LIST_LIMIT)
        ]
        response.success, response.message = True, json.dumps(lines, allow_nan=False)
        return response

    async def _reject_twin(self, request: Any, response: Any) -> Any:
        """Reject all that is undecided: a PLC's way out when the accept twin may not choose."""
        reject_one = twin(self._ask, REJECT, {"choose": NEWEST})
        await reject_one(request, response)
        while response.success and self._history.undecided(self._kind):
            await reject_one(request, response)
        return response


def twin(ask: Ask, name: str, arguments: Mapping[str, Any]) -> Callable[..., Any]:
    """A Trigger that gives one command; its message is `trigger_text`."""

    async def trigger(request: Any, response: Any) -> Any:
        return trigger_answer(response, await ask(Command(name, {"by": TWIN, **arguments})))

    return trigger


def trigger_answer(response: Any, outcome: Outcome) -> Any:
    """Put an outcome into the response of a Trigger; its message is `trigger_text`."""
    response.success = outcome.done
    response.message = trigger_text(outcome.calibration_id, outcome.status, outcome.message)
    return response


def answer(response: Any, outcome: Outcome) -> Any:
    """Put an outcome into a response with ``success``, ``message`` and ``status``."""
    response.success = outcome.done
    response.message = outcome.message
    response.status = int(outcome.status)
    return response
