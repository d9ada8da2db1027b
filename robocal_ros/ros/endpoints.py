# SPDX-License-Identifier: Apache-2.0
"""Inputs, outputs, services and timers of a lifecycle node; their QoS; its diagnostics."""

import contextlib
import inspect
import queue
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from copy import copy
from dataclasses import dataclass, field
from enum import Enum
from functools import partial
from typing import Any

from action_msgs.msg import GoalStatus
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.session.inputs import MOST_REASONS, kind_of


def _profile(
    depth: int,
    reliability: ReliabilityPolicy,
    durability: DurabilityPolicy = DurabilityPolicy.VOLATILE,
) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST, depth=depth, reliability=reliability, durability=durability
    )


LATCHED = _profile(1, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
"""Results and states: a late subscriber gets the last one."""

LATCHED_OF_SEVERAL = _profile(10, ReliabilityPolicy.RELIABLE, DurabilityPolicy.TRANSIENT_LOCAL)
"""States that each of several publishers latches: at depth 1 one's would overwrite another's."""

SENSOR = _profile(100, ReliabilityPolicy.BEST_EFFORT)
"""Sensor streams. Deep enough for stalls of 10 to 30 ms at 1 kHz."""

RELIABLE = _profile(100, ReliabilityPolicy.RELIABLE)
"""Commands and events, where none may be lost."""

HEARTBEAT = _profile(1, ReliabilityPolicy.RELIABLE)
"""What holds for a short time only: an older one that still waits says nothing."""

NEWEST = _profile(1, ReliabilityPolicy.BEST_EFFORT)
"""States of others of which only the newest says something."""

STREAM = _profile(1000, ReliabilityPolicy.BEST_EFFORT)
"""What a session is computed from: deep enough for the seconds that a large solution takes."""


def own(profile: QoSProfile) -> QoSProfile:
    """Return a copy, because overrides are written into the profile that an entity is given."""
    return copy(profile)


def overridable() -> QoSOverridingOptions:
    """Let a user set history, depth and reliability (parameters ``qos_overrides.<topic>.…``)."""
    return QoSOverridingOptions.with_default_policies()


LOG_EVERY_S = 5.0
MOST_WAITING = 10_000  # messages of an input that are taken at once
MOST_KEPT = 10  # messages of an input that wait for the next activation


def trigger_text(number: int, status: Code, message: str) -> str:
    """The answer of a Trigger twin: id, code and words, in this order, one blank between."""
    return f"{number} {status.name} {message}"


class Refusal(Enum):
    """Why a call was not passed on."""

    LATE = "too late"
    INACTIVE = "this node is not active"
    ABSENT = "nobody serves it"


class NotActiveError(RobocalError):
    """A service was called while its node is not active."""

    code = Code.CONFLICT


@dataclass
class InputCount:
    """Messages of one input: all, ignored while inactive, refused as invalid, lost on the way."""

    received: int = 0
    ignored: int = 0
    invalid: int = 0
    lost: int = 0


class PublisherNumbers:
    """Finds what of a topic was lost, on the way or in a full queue, by its publisher's numbers.

    ``publishers``: how many there are; the numbers of several tell nothing. ``known``: whether the
    middleware tells them.
    """

    def __init__(self, publishers: Callable[[], int]) -> None:
        self._publishers = publishers
        self._last = 0
        self.known = False

    def missed(self, info: Mapping[str, Any]) -> int:
        """How many messages were lost before this one; ``info``: what rclpy knows of it."""
        number, last = info.get("publication_sequence_number") or 0, self._last
        self._last, self.known = number, number > 0
        if not 0 < last < number - 1 or self._publishers() != 1:
            return 0
        return int(number - last - 1)


class LogLimit:
    """One log line per topic and reason in `LOG_EVERY_S`: a flood hides no other reason."""

    def __init__(self) -> None:
        self._next_s: dict[str, dict[str, float]] = {}

    def allows(self, topic: str, reason: str, now_s: float) -> bool:
        """Whether to log this reason now (monotonic time); beyond 30 a topic's reasons share."""
        times = self._next_s.setdefault(topic, {})
        kind = kind_of(reason)
        kind = kind if kind in times or len(times) < MOST_REASONS else "other"
        if now_s < times.get(kind, now_s):
            return False
        times[kind] = now_s + LOG_EVERY_S
        return True


class EndpointNode(LifecycleNode):
    """A lifecycle node whose endpoints act only while it is active and go at its cleanup.

    ``is_active``: while it acts; kept here, for rclpy makes a tuple at each look at its state.
    """

    is_active = False

    def __init__(self, name: str, **options: Any) -> None:
        super().__init__(name, **options)
        self.inputs: dict[str, InputCount] = {}
        self._log_limit = LogLimit()
        self.async_group = ReentrantCallbackGroup()
        self._release: list[Callable[[], object]] = []
        self._takers: list[tuple[str, Subscription, Callable[..., None], Callable[..., None]]] = []
        self._taking = False
        self._kept: dict[str, deque[Callable[[], None]]] = {}  # by topic, for the next activation

    @property
    def state(self) -> str:
        """Label of the lifecycle state; of a node that is closed too."""
        machine = self._state_machine  # one that is destroyed ends the process, if it is asked
        return str(machine.current_state[1]) if machine.initialized else "finalized"

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the outputs."""
        result = super().on_activate(state)
        self.is_active = result == TransitionCallbackReturn.SUCCESS
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the outputs."""
        self.is_active = False
        return super().on_deactivate(state)

    def now_ns(self) -> int:
        """ROS time, ns (simulated when ``use_sim_time``)."""
        # of the clock below rclpy's, which makes an object of each: it takes four times as long
        return int(self.get_clock().handle.get_now().nanoseconds)

    def add_input(
        self,
        kind: type,
        topic: str,
        callback: Callable[..., None],
        profile: QoSProfile,
        *,
        raw: bool = False,
        timed: bool = False,
        numbered: bool = False,
        kept: bool = False,
        inactive: bool = False,
    ) -> Subscription:
        """Subscribe until cleanup. A `RobocalError` of the callback counts the message invalid.

        A defect in the callback counts it too and is logged; it does not end the node. ``raw``:
        the callback is given the serialized message; ``timed``: also what rclpy knows of it, its
        ``source_timestamp`` (ns) among that. ``numbered``: what was lost is counted by the
        publisher's numbers, also what the queue had no room for. Neither goes with an events
        executor, which ends at a callback of two arguments (rclpy 7).

        ``kept``: of what comes while the node is inactive the last `MOST_KEPT` are taken once it is
        active, in their order: latched, they come only once, and the last may be refused.
        ``inactive``: the callback is given what comes while inactive too.
        """
        count = self.inputs.setdefault(topic, InputCount())

        def give(message: Any, *info: Any) -> None:
            try:
                callback(message, *info)
            except Exception as error:
                count.invalid += 1
                self._log(topic, error)

        def take(message: Any, *info: Any) -> None:
            count.received += 1
            if self.is_active or inactive:
                give(message, *info)
            elif kept:
                waiting = self._kept.setdefault(topic, deque(maxlen=MOST_KEPT))
                count.ignored += len(waiting) == MOST_KEPT  # the oldest one falls out
                waiting.append(partial(give, message, *info))
            else:
                count.ignored += 1

        def note(info: Any) -> None:
            count.lost += numbers.missed(info) if numbered else 0

        def take_timed(message: Any, info: Any) -> None:  # rclpy counts the arguments
            take(message, info)

        def take_numbered(message: Any, info: Any) -> None:
            note(info)
            take(message)

        def lose(event: Any) -> None:
            count.lost += 0 if numbers.known else event.total_count_change

        subscription = self.create_subscription(
            kind,
            topic,
            take_numbered if numbered else take_timed if timed else take,
            own(profile),
            event_callbacks=SubscriptionEventCallbacks(message_lost=lose),
            qos_overriding_options=overridable(),
            raw=raw,
        )
        numbers = PublisherNumbers(subscription.get_publisher_count)
        self._takers.append((topic, subscription, note, take))
        self._release.append(lambda: self.destroy_subscription(subscription))
        return subscription

    def take_kept(self) -> None:
        """Take what was kept while inactive; for an `activate` that tells what there is, first."""
        kept, self._kept = self._kept, {}
        for waiting in kept.values():
            for give in waiting:
                give()

    def take_waiting(self, *topics: str, pick: Callable[[list[Any]], Iterable[Any]] = iter) -> None:
        """Take now what the inputs have received, in place of one message of each in its turn.

        So a call comes after all that was there before it, however long the node was busy.
        ``topics``: of these inputs alone. ``pick``: which messages of an input are looked at.
        Does nothing where it is called for one of the messages that it takes.
        """
        if self._taking:
            return
        self._taking = True
        try:
            for topic, subscription, note, take in self._takers:
                waiting: list[Any] = []
                while (not topics or topic in topics) and len(waiting) < MOST_WAITING:
                    with subscription.handle:
                        taken = subscription.handle.take_message(
                            subscription.msg_type, subscription.raw
                        )
                    if taken is None:
                        break
                    note(taken[1])
                    waiting.append(taken[0])
                for message in pick(waiting):
                    take(message)
        finally:
            self._taking = False

    def add_output(self, kind: type, topic: str, profile: QoSProfile) -> Any:
        """Return a publisher that is silent while the node is inactive, until cleanup."""
        publisher = self.create_lifecycle_publisher(
            kind, topic, own(profile), qos_overriding_options=overridable()
        )
        self._release.append(lambda: self.destroy_lifecycle_publisher(publisher))
        return publisher

    def add_service(
        self, kind: type, name: str, callback: Callable[[Any, Any], Any], *, inactive: bool = False
    ) -> None:
        """Serve until cleanup; ``callback(request, response)`` may be ``async``.

        While inactive, and when the callback raises a `RobocalError`, the answer is
        ``success = False`` with the reason in ``message`` and its code in ``status``; of a Trigger
        ``message`` is `trigger_text`. A defect in the callback is logged and answered too: it does
        not end the node. An async callback may await other services; the node must then run in the
        plain executor.

        ``inactive``: the callback answers while inactive too.
        """
        ready = (lambda: None) if inactive else (lambda: self._require_active(name))
        if inspect.iscoroutinefunction(callback):

            async def serve(request: Any, response: Any) -> Any:
                try:
                    ready()
                    return await callback(request, response)
                except Exception as error:
                    return self._refuse(name, response, error)

            service = self.create_service(kind, name, serve, callback_group=self.async_group)
        else:

            def answer(request: Any, response: Any) -> Any:
                try:
                    ready()
                    return callback(request, response)
                except Exception as error:
                    return self._refuse(name, response, error)

            service = self.create_service(kind, name, answer)
        self._release.append(lambda: self.destroy_service(service))

    def add_client(self, kind: type, name: str) -> Any:
        """Return a client of another node's service, until cleanup."""
        client = self.create_client(kind, name)
        self._release.append(lambda: self.destroy_client(client))
        return client

    def add_timer(
        self, period_s: float, callback: Callable[[], None], *, steady: bool = False
    ) -> Timer:
        """Call back every ``period_s`` of ROS time while active, until cleanup.

        A defect in the callback is logged; it does not end the node. ``steady``: of the steady
        clock, which runs on when a simulation stops.
        """

        def tick() -> None:
            if not self.is_active:
                return
            try:
                callback()
            except Exception as error:
                self._log("timer", error)

        clock = Clock(clock_type=ClockType.STEADY_TIME) if steady else None
        timer = self.create_timer(period_s, tick, clock=clock)
        self._release.append(lambda: self.destroy_timer(timer))
        return timer

    def release_endpoints(self) -> None:
        """Take down all of them, the last one first."""
        self._takers.clear()
        self._kept.clear()
        while self._release:
            self._release.pop()()

    def warn(self, where: str, words: str) -> None:
        """Log a warning; not all of a flood."""
        if self._log_limit.allows(where, words, time.monotonic()):
            self.get_logger().warning(f"{where}: {words}")

    def _log(self, where: str, error: Exception) -> None:
        """Why something was refused, or a defect; not all of a flood."""
        if isinstance(error, RobocalError):
            self.warn(where, str(error))
            return
        words = "".join(traceback.format_exception(error))
        if self._log_limit.allows(where, words, time.monotonic()):
            self.get_logger().error(f"{where}: a defect of this software, please report:\n{words}")

    def _require_active(self, name: str) -> None:
        if not self.is_active:
            raise NotActiveError(f"{self.get_name()} is {self.state}: activate it to use {name}")

    def _refuse(self, name: str, response: Any, error: Exception) -> Any:
        if isinstance(error, RobocalError):
            code, words = error.code, str(error)
            self.get_logger().warning(f"{name}: {error}")
        else:
            kind = type(error).__name__
            code = Code.BAD_INPUT
            words = f"a defect of this software, please report it: {kind}: {error}"
            self.get_logger().error(f"{name}:\n{''.join(traceback.format_exception(error))}")
        response.success = False
        trigger = isinstance(response, Trigger.Response)
        response.message = trigger_text(0, code, words) if trigger else words
        if hasattr(response, "status"):
            response.status = int(code)
        return response


OK = DiagnosticStatus.OK
WARN = DiagnosticStatus.WARN
ERROR = DiagnosticStatus.ERROR
STALE = DiagnosticStatus.STALE

PERIOD_S = 1.0


@dataclass
class Health:
    """What a node says of itself: level, one sentence, and figures by name."""

    level: bytes = OK
    message: str = "ok"
    values: dict[str, object] = field(default_factory=dict)

    def worsen(self, level: bytes, message: str) -> None:
        """Add a finding; the worst one gives the level, all of them the message."""
        self.message = message if self.level == OK else f"{self.message}; {message}"
        self.level = max(self.level, level)


class Diagnostics:
    """Publishes a node's `Health`, whatever state the node is in.

    The period runs on the steady clock, so that a stopped simulation still reports.
    """

    def __init__(
        self, node: LifecycleNode, health: Callable[[], Health], serial: Callable[[], str]
    ) -> None:
        self._node = node
        self._health = health
        self._serial = serial
        self._publisher = node.create_publisher(DiagnosticArray, "/diagnostics", own(RELIABLE))
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = node.create_timer(PERIOD_S, self.publish, clock=steady)

    def publish(self) -> None:
        """Publish now; also called at once when a transition fails."""
        health = self._health()
        status = DiagnosticStatus(
            level=health.level,
            name=self._node.get_fully_qualified_name().lstrip("/"),
            message=health.message,
            hardware_id=self._serial(),
            values=[KeyValue(key=key, value=str(value)) for key, value in health.values.items()],
        )
        array = DiagnosticArray(status=[status])
        array.header.stamp = self._node.get_clock().now().to_msg()
        self._publisher.publish(array)


class ExecutorQueue:
    """What other threads hand over, taken in the executor's while ``node`` is configured.

    ``take`` is given one after the other; what it raises is logged as of ``where``.
    """

    def __init__(self, node: EndpointNode, where: str, take: Callable[[Any], None]) -> None:
        self._node, self._where, self._take = node, where, take
        self._waiting: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._wake = node.create_guard_condition(self._take_all)
        node._release.append(lambda: node.destroy_guard_condition(self._wake))

    def put(self, handed: Any) -> None:
        """Hand over, from any thread."""
        self._waiting.put(handed)
        with contextlib.suppress(Exception):  # the node is being destroyed
            self._wake.trigger()

    def _take_all(self) -> None:
        while True:
            try:
                handed = self._waiting.get_nowait()
            except queue.Empty:
                return
            try:
                self._take(handed)
            except Exception as error:
                self._node._log(self._where, error)


FORGOTTEN_S = 1.0  # how often calls that nobody waits for any more are let go


class ServiceCalls:
    """Calls to services of another node, for people and machines beside the graph.

    Whoever waits is told by its own clock that nobody answered; a call that comes after that is not
    passed on, as its caller may have asked again. Works while ``node`` is configured.
    """

    def __init__(self, node: EndpointNode, server: str, kinds: Mapping[str, Any]) -> None:
        self._node, self._kinds = node, kinds
        self._clients = {
            name: node.add_client(kind, f"{server}/{name}") for name, kind in kinds.items()
        }
        self._pending: dict[Any, tuple[float, Any]] = {}
        node.add_timer(FORGOTTEN_S, self._let_go, steady=True)

    def call(
        self,
        name: str,
        fields: Mapping[str, Any],
        by: str,
        until_s: float,
        answered: Callable[[Any], None],
    ) -> Refusal | None:
        """Call; ``answered`` is given the response, or the exception. Returns why it did not.

        ``by``: who decides, where the request has a place for that. ``until_s``: steady clock.
        """
        client = self._clients[name]
        if time.monotonic() > until_s:  # this process paused meanwhile
            return Refusal.LATE
        if not self._node.is_active:
            return Refusal.INACTIVE
        if not client.service_is_ready():
            return Refusal.ABSENT
        request = self._kinds[name].Request(**fields)
        if hasattr(request, "by"):
            request.by = by

        def done(future: Any) -> None:
            self._pending.pop(future, None)
            error = future.exception()
            answered(future.result() if error is None else error)

        future = client.call_async(request)
        self._pending[future] = until_s, client
        future.add_done_callback(done)
        return None

    def _let_go(self) -> None:
        now_s = time.monotonic()
        for future, (until_s, client) in list(self._pending.items()):
            if now_s > until_s + FORGOTTEN_S:
                del self._pending[future]
                client.remove_pending_request(future)


RESULT_KEPT_S = 60  # for callers that ask late


class DeferredActionServer(ActionServer):
    """A goal begins with ``goal.execute()`` and goes on until `end`: no coroutine waits for it.

    ``callbacks`` go to rclpy; ``handle_accepted_callback`` takes the place of an execute callback.
    """

    def __init__(self, node: EndpointNode, kind: Any, name: str, **callbacks: Any) -> None:
        self._host = node
        unused = kind.Result
        super().__init__(node, kind, name, unused, result_timeout=RESULT_KEPT_S, **callbacks)

    def notify_execute(
        self, goal_handle: ServerGoalHandle, execute_callback: Callable[..., Any] | None
    ) -> None:
        """Let rclpy run a callback whose return ends the goal; without one the goal goes on."""
        if execute_callback is not None and self._host.executor is not None:
            super().notify_execute(goal_handle, execute_callback)

    def end(self, goal: ServerGoalHandle, status: int, result: Any) -> None:
        """End a goal with a status of `GoalStatus`; one that its caller did not cancel, aborted.

        Without an executor, when the process ends, nobody is told: the action goes anyway.
        """

        def finish(goal: ServerGoalHandle) -> Any:
            if status == GoalStatus.STATUS_SUCCEEDED:
                goal.succeed()
            elif status == GoalStatus.STATUS_CANCELED and goal.is_cancel_requested:
                goal.canceled()
            else:
                goal.abort()
            return result

        self.notify_execute(goal, finish)
