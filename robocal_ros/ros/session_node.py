"""A node that drives a session with live messages and calls."""

import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Mapping
from typing import Any, ClassVar, Generic, Protocol, TypeVar

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.task import Future
from robocal_msgs.msg import SessionEvent

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.proposals import Head
from robocal_ros.ground.samples import JOINTS
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros.base import POLL_S, HouseNode
from robocal_ros.ros.clocks import StampWatch
from robocal_ros.ros.conversions import time_message
from robocal_ros.ros.endpoints import ERROR, EndpointNode, Health, NotActiveError
from robocal_ros.ros.graph import SourceGuard
from robocal_ros.ros.history_settings import open_history, warn_of_history
from robocal_ros.session.base import Ignored
from robocal_ros.session.events import CONFIGURE, Command, Outcome, arguments_text, outcome_text

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
        self._events.publish(event_message(command, outcome, self._sequence))

    @property
    def need_configuration(self) -> bool:
        """Whether to tell the configuration again although nothing has changed.

        A recording that begins later gets the last events alone, and cannot be replayed without a
        configuration among them.
        """
        return self._since >= EVENTS.depth // 2


def event_message(command: Command, outcome: Outcome | None, sequence: int) -> SessionEvent:
    """A command and what came of it, None for the configuration."""
    return SessionEvent(
        stamp=time_message(command.stamp_ns or 0),
        sequence=sequence,
        command=command.name,
        arguments=arguments_text(command),
        outcome="{}" if outcome is None else outcome_text(outcome),
    )


class Session(Protocol):
    """What its node asks of a session.

    Attributes
    ----------
    received, ignored : samples by topic, and those that were not used.
    """

    received: Counter[str]
    ignored: Ignored

    @property
    def in_force(self) -> Head:
        """Head of the history as the session last saw it."""

    @property
    def fault(self) -> str:
        """Why the history could not be read at the last look; empty when it could."""

    def refuse(self, kind: str, error: RobocalError) -> None:
        """Count a message of an input that cannot be used."""

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command."""

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command: what was decided outside before it, and it."""


class CommandDesk:
    """Between the callers of a node and its session.

    Parameters
    ----------
    timeout_s : a command waits at most so long for its samples.
    show : takes each outcome, also of what was decided outside.

    Attributes
    ----------
    session : None while the node is inactive.
    """

    def __init__(
        self, node: EndpointNode, timeout_s: float, show: Callable[[Outcome], None]
    ) -> None:
        self._node, self._show = node, show
        self._asked: deque[Future] = deque()
        self.session: Session | None = None
        self._deadline = node.add_timer(timeout_s, self._force, steady=True)
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
            try:
                outcomes: list[Any] = self.session.step(wall_ns=time.time_ns(), force=force)
            except Exception as error:  # a defect must not end the node: the caller is told
                self._asked.popleft().set_exception(error)
                continue
            if not outcomes:
                return
            asked = self._asked.popleft()  # before it is shown: that may give a command too
            for outcome in outcomes:
                self._show_safely(outcome)
            asked.set_result(outcomes[-1])
        self._deadline.cancel()

    def _show_safely(self, outcome: Outcome) -> None:
        """A defect in showing what was done must not take the answer from its caller."""
        try:
            self._show(outcome)
        except Exception:
            self._node.get_logger().error(f"not shown:\n{traceback.format_exc()}")

    def close(self) -> None:
        """End the session; calls that wait are answered."""
        self.session = None
        self._deadline.cancel()
        while self._asked:
            error = NotActiveError("deactivated while the command waited: nothing was done")
            self._asked.popleft().set_exception(error)

    def _force(self) -> None:
        self.step(force=True)


# ---- the node -----------------------------------------------------------------------------------


SessionT = TypeVar("SessionT", bound=Session)


class SessionNode(HouseNode, Generic[SessionT]):
    """Drives a session of one robot with live messages and calls.

    A node reads the robot and calls `open_session` in ``configure``, and says what its session is,
    how that takes a message, what to show, and how it is.
    """

    INPUTS: ClassVar[Mapping[str, tuple[type, QoSProfile]]]
    _nominal: SerialArm

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._session: SessionT | None = None
        self._history: CalibrationHistory | None = None

    # ---- what a node fills in -------------------------------------------------------------------

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

    # ---- what it opens and closes ---------------------------------------------------------------

    def open_session(
        self, command_s: float = COMMAND_S, *, sole: bool = True
    ) -> CalibrationHistory:
        """Open the robot's history and the inputs; the outcomes of commands go to `show`.

        ``command_s``: a command waits at most so long for its samples. ``sole``: a robot has one
        such node at most. Raises as `open_history`.
        """
        self._serial_in_use, self._history = open_history(
            self.settings, self._nominal, self.NAME if sole else ""
        )
        self._guard = SourceGuard(self, JOINTS)
        self._stamps = StampWatch(self, JOINTS)
        self._topics = {kind: self.resolve_topic_name(kind) for kind in self.INPUTS}
        for kind, (message_type, profile) in self.INPUTS.items():
            self.add_input(message_type, kind, self._taker(kind), profile)
        self._desk = CommandDesk(self, command_s, self._show)
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

    # ---- samples, commands, outcomes ------------------------------------------------------------

    def _taker(self, kind: str) -> Callable[[Any], None]:
        def take(message: Any) -> None:
            session = self._session
            if session is None:
                return
            self._stamps.note(kind, message)
            if kind == JOINTS and (fault := self._guard.fault_at(session.received[JOINTS])):
                session.refuse(JOINTS, InputError(fault))
                return
            self.take(session, kind, message)

        return take

    def _poll(self) -> None:
        self._guard.look()
        if self._session is None:
            return
        try:
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

    def health(self) -> Health:
        """Tell what is in force, what was lost or ignored, what is wrong."""
        session, history, health = self._session, self._history, Health()
        if session is None or history is None:
            return health
        health.values = {"revision in force": session.in_force.revision}
        self.report(session, history, health)
        health.values |= session.ignored.listed() | self._stamps.judge(health)
        for fault in filter(None, (self._guard.fault, session.fault)):
            health.worsen(ERROR, fault)
        warn_of_history(health, history)
        return health
