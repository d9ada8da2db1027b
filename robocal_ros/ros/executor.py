# SPDX-License-Identifier: Apache-2.0
"""An executor of one thread that does for each callback what has changed since the last one.

rclpy's gathers all entities of its nodes, two wait sets of them, for each callback, and asks each
whether it may run: most of what a node of 125 messages a second takes.
"""

import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, suppress
from typing import Any

from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ConditionReachedException,
    ExternalShutdownException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
    TimeoutObject,
)
from rclpy.impl.implementation_singleton import rclpy_implementation as _rclpy
from rclpy.node import Node
from rclpy.utilities import timeout_sec_to_nsec

# As rclpy's wait sets and the ends of its `_take_…` name them.
WAITABLE, GUARD, TIMER = "waitable", "guard_condition", "timer"
# In rclpy's order, by which what is ready is called; where a node has them.
PLAIN = {TIMER: "timers", "subscription": "subscriptions", GUARD: "guards"}
PLAIN |= {"client": "clients", "service": "services"}
OF_NODE = {WAITABLE: "waitables"} | PLAIN
# What of rclpy's executor is used here beside its interface.
NEEDED = ["_tasks", "_tasks_lock", "_is_shutdown", "_sigint_gc", "_wakes", "_make_handler"]
NEEDED += [f"_take_{kind}" for kind in OF_NODE]
# A node has one or two QoS events of each publisher and subscription, and hardly ever one comes:
# where it is busy they are looked for so often. They last until they are taken.
EVENTS_NS = 100_000_000

Entity = Any
Ready = tuple[str, Entity, Node]


class _WakesLater:
    """An executor's guard condition for one callback: silent in the turn in which this begins."""

    def __init__(self, executor: "OneThreadExecutor") -> None:
        self._executor, self._turn = executor, executor.turn

    def trigger(self) -> None:
        """Wake the executor for those that wait for a callback that had awaited something."""
        if self._executor.turn != self._turn:
            self._executor.wake()


class _WaitSet:
    """All entities of nodes, held until `let_go`: none is destroyed while it is waited for."""

    def __init__(self, executor: "OneThreadExecutor") -> None:
        self._entities: dict[str, dict[int, tuple[Entity, Node | None]]] = {k: {} for k in PLAIN}
        self._handles: dict[str, list[Any]] = {kind: [] for kind in PLAIN}
        self._waitables: list[tuple[Entity, Node]] = []
        self._events: list[tuple[Entity, Node]] = []
        context = executor.context.handle
        with ExitStack() as held:
            held.enter_context(context)
            for node in executor.get_nodes():
                for kind, name in PLAIN.items():
                    for entity in list(getattr(node, name)):
                        self._hold(held, kind, entity, node)
                for waitable in list(node.waitables):
                    with suppress(InvalidHandle):  # destroyed, by another thread
                        held.enter_context(waitable)
                        rare = type(waitable) is EventHandler
                        (self._events if rare else self._waitables).append((waitable, node))
            for guard in (executor._wakes, executor._sigint_gc):
                if guard is None:
                    raise ShutdownException
                self._hold(held, GUARD, guard, None)
            each = [*self._waitables, *self._events]
            counts = [waitable.get_num_entities() for waitable, _ in each]
            own = {kind: len(handles) for kind, handles in self._handles.items()}
            self._set = _rclpy.WaitSet(
                own["subscription"] + sum(count.num_subscriptions for count in counts),
                own[GUARD] + sum(count.num_guard_conditions for count in counts),
                own[TIMER] + sum(count.num_timers for count in counts),
                own["client"] + sum(count.num_clients for count in counts),
                own["service"] + sum(count.num_services for count in counts),
                sum(count.num_events for count in counts),
                context,
            )
            self._held = held.pop_all()

    def _hold(self, held: ExitStack, kind: str, entity: Entity, node: Node | None) -> None:
        handle = entity.handle
        with suppress(InvalidHandle):  # destroyed, by another thread
            held.enter_context(handle)
            self._handles[kind].append(handle)
            self._entities[kind][handle.pointer] = entity, node

    def let_go(self) -> None:
        """What was to be destroyed meanwhile is destroyed now."""
        self._held.close()

    def wait(self, timeout_ns: int, *, events: bool) -> list[Ready]:
        """Wait for any of it, QoS ``events`` too or not; what is ready. Negative: without an end.

        Raises ``InvalidHandle`` where another thread is destroying some of it.
        """
        for guard, node in self._entities[GUARD].values():
            if node is not None and guard._executor_triggered:  # and has not been called yet
                guard.trigger()
        self._set.clear_entities()
        for kind, handles in self._handles.items():
            add = getattr(self._set, f"add_{kind}")
            for handle in handles:
                add(handle)
        waitables = [*self._waitables, *self._events] if events else self._waitables
        for waitable, _ in waitables:
            waitable.add_to_wait_set(self._set)
        self._set.wait(timeout_ns)
        ready: list[Ready] = [
            (WAITABLE, waitable, node)
            for waitable, node in waitables
            if waitable.is_ready(self._set)
        ]
        for kind, entities in self._entities.items():
            for pointer in self._set.get_ready_entities(kind):
                # one of a waitable's own is none of these
                entity, node = entities.get(pointer, (None, None))
                if node is None:
                    continue
                if kind == GUARD:
                    entity._executor_triggered = True
                ready.append((kind, entity, node))
        return ready


class OneThreadExecutor(SingleThreadedExecutor):
    """Keeps its wait set until an entity comes or goes, where rclpy's builds two for a callback.

    rclpy's handler of a callback wakes the executor after it, for those that another thread held
    back as its group was taken. In one thread nobody is held back by a callback that has ended;
    while one that awaits something holds back its group, rclpy's own way is gone. One that ends
    later wakes the executor, and whoever else does. An rclpy that names its parts otherwise is used
    as it is.
    """

    turn = 0  # number of the callback that runs
    _made_in = 0  # the thread that makes a handler
    _events_ns = 0  # when QoS events are looked for again
    _tasks: list[Any]  # rclpy's

    def __init__(self, **options: Any) -> None:
        # Of the three below it. Whoever destroys comes through here, a collection among them, which
        # may begin in the middle of these very lines.
        self._lock = threading.RLock()
        self._kept: _WaitSet | None = None
        self._waits = self._stale = False
        super().__init__(**options)
        self._known = all(hasattr(self, name) for name in NEEDED)

    @property
    def _guard(self) -> Any:
        return _WakesLater(self) if self._made_in == threading.get_ident() else self._wakes

    @_guard.setter
    def _guard(self, guard: Any) -> None:
        self._wakes = guard

    def wake(self) -> None:
        """Look anew at what there is: rclpy calls it where an entity came or went."""
        self._forget()
        super().wake()

    def add_node(self, node: Node) -> bool:
        """Let its callbacks be called."""
        added = super().add_node(node)
        self._forget()
        return added

    def remove_node(self, node: Node) -> None:
        """Let them be."""
        super().remove_node(node)
        self._forget()

    def shutdown(self, timeout_sec: float | None = None) -> bool:
        """End for good."""
        ended = super().shutdown(timeout_sec)
        self._forget()
        return ended

    def _forget(self) -> None:
        """Let go of the entities: at once, or after the wait of another thread."""
        kept = None
        with self._lock:
            self._stale = True
            if not self._waits:
                kept, self._kept = self._kept, None
        if kept is not None:
            kept.let_go()

    def _spin_once_impl(self, *given: Any, **named: Any) -> None:
        self.turn += 1
        super()._spin_once_impl(*given, **named)

    def _make_handler(self, *given: Any) -> Any:
        self._made_in = threading.get_ident()
        try:
            return super()._make_handler(*given)
        finally:
            self._made_in = 0

    def _take_waitable(self, waitable: Any) -> Any:
        """It is held until its callback has ended, which may take it down, as rclpy holds it."""
        with suppress(InvalidHandle), ExitStack() as holding:
            holding.enter_context(waitable)
            execute = super()._take_waitable(waitable)
            held = holding.pop_all()

            async def execute_held() -> None:
                with held:
                    await execute()

            return execute_held
        return None  # destroyed, by another thread

    def _wait_for_ready_callbacks(
        self,
        timeout_sec: float | TimeoutObject | None = None,
        nodes: list[Node] | None = None,
        condition: Callable[[], bool] = lambda: False,
    ) -> Iterator[tuple[Any, Entity, Node]]:
        given_s = timeout_sec.timeout if isinstance(timeout_sec, TimeoutObject) else timeout_sec
        timeout_ns = timeout_sec_to_nsec(given_s)
        until_ns = time.monotonic_ns() + timeout_ns
        while not self._is_shutdown and not condition():
            tasks = self._pending() if self._known else []
            held = any(of is not None and not self.can_execute(of) for _, of, _ in tasks)
            if not self._known or nodes is not None or held:
                yield from super()._wait_for_ready_callbacks(timeout_sec, nodes, condition)
                return
            called = False
            for task, entity, node in reversed(tasks):
                if not (task.executing() or task.done()) and node in (None, *self.get_nodes()):
                    called = True
                    yield task, entity, node
            left_ns = max(until_ns - time.monotonic_ns(), 0) if timeout_ns >= 0 else -1
            for kind, entity, node in self._ready(left_ns):
                if self._may_run(kind, entity, node):
                    called = True
                    take = getattr(self, f"_take_{kind}")
                    yield self._make_handler(entity, node, take), entity, node
            if called:
                return
            if timeout_ns >= 0 and time.monotonic_ns() >= until_ns:
                raise TimeoutException
        if self._is_shutdown:
            raise ShutdownException
        raise ConditionReachedException

    def _pending(self) -> list[tuple[Any, Entity | None, Node | None]]:
        """Callbacks that await something, and what else is to be done."""
        with self._tasks_lock:
            if self._tasks:
                self._tasks = [of for of in self._tasks if not (of[0].done() or of[0].cancelled())]
            return list(self._tasks)

    def _ready(self, timeout_ns: int) -> list[Ready]:
        """What is ready; nothing, where QoS events are to be looked for before the time is over."""
        until_events_ns = self._events_ns - time.monotonic_ns()
        events = until_events_ns <= 0
        if events:
            self._events_ns = time.monotonic_ns() + EVENTS_NS
        elif not 0 <= timeout_ns <= until_events_ns:
            timeout_ns = until_events_ns
        with self._lock:
            self._waits = True  # from here on this thread alone lets go
            kept = self._kept
            if kept is None:
                self._stale = False  # what comes or goes from here on is not surely in the new one
        try:
            if kept is None:
                kept = self._kept = _WaitSet(self)
            ready = kept.wait(timeout_ns, events=events)
        except InvalidHandle:  # another thread is destroying some of it, and then wakes this one
            self._stale, ready = True, []
        finally:
            self._waits = False
            if self._stale:
                self._forget()
        if self._is_shutdown:
            raise ShutdownException
        if not self._context.ok():
            raise ExternalShutdownException
        return ready

    def _may_run(self, kind: str, entity: Entity, node: Node) -> bool:
        """Whether it is still there, and what was called before it holds nothing back."""
        if entity not in getattr(node, OF_NODE[kind]):
            return False
        if kind == TIMER:
            try:
                if not entity.is_ready():  # it was cancelled
                    return False
            except InvalidHandle:  # destroyed, by another thread
                return False
        return bool(entity.callback_group.can_execute(entity))
