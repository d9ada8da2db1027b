"""The executor of nodes that serve ``async`` services: rclpy's, at a fraction of its cost.

Most of what a Python node costs is that rclpy's executor builds its wait set anew for every wait
(executors.py, `Executor._wait_for_ready_callbacks` of rclpy 7.1): each entity costs it a dozen
calls. Two thirds of a node's entities are events of the middleware, of which nearly none ever
comes: two or three of each subscription and publisher (an incompatible partner, a lost message).
Here they are one entity. And each callback wakes the executor when it is over, for the sake of
other threads; that makes a second wait for each. Here it does so only while another callback awaits
something, which the end of this one may have brought.

`rclpy.experimental.EventsExecutor` needs no wait set, but awaits no ``async`` service, and an
exception in an action client's callback ends its process.
"""

from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.context import Context
from rclpy.event_handler import EventHandler
from rclpy.exceptions import InvalidHandle
from rclpy.executors import (
    ConditionReachedException,
    ShutdownException,
    SingleThreadedExecutor,
    TimeoutException,
)
from rclpy.task import Task
from rclpy.waitable import NumberOfEntities, Waitable


class MiddlewareEvents(Waitable):
    """Events of all nodes of an executor, as one entity, and as the node that has it.

    ``handlers``: gives those that are there now. ``waits``: how often they were waited for.
    """

    subscriptions = timers = clients = services = guards = ()

    def __init__(self, handlers: Callable[[], list[EventHandler]]) -> None:
        super().__init__(ReentrantCallbackGroup())
        self._now, self._handlers = handlers, list[EventHandler]()
        self._held = deque[list[EventHandler]]()  # of waits that are not over
        self._ready = list[EventHandler]()
        self.waits = 0

    @property
    def waitables(self) -> Iterator[Waitable]:
        """As of a node."""
        yield self

    def __enter__(self) -> None:
        """Nothing of them is destroyed until `__exit__`."""
        self._handlers = []
        self._held.append(self._handlers)
        self.waits += 1
        for handler in self._now():
            try:
                handler.__enter__()
            except InvalidHandle:  # another thread takes its owner down
                continue
            self._handlers.append(handler)

    def __exit__(self, *error: Any) -> None:
        """The wait that began first is over."""
        for handler in self._held.popleft():
            handler.__exit__(*error)

    def get_num_entities(self) -> NumberOfEntities:
        """Of the wait set."""
        return NumberOfEntities(num_events=len(self._handlers))

    def add_to_wait_set(self, wait_set: Any) -> None:
        """Add all."""
        for handler in self._handlers:
            handler.add_to_wait_set(wait_set)

    def is_ready(self, wait_set: Any) -> bool:
        """Whether one came."""
        self._ready = [handler for handler in self._handlers if handler.is_ready(wait_set)]
        return bool(self._ready)

    def take_data(self) -> list[tuple[EventHandler, Any]]:
        """Take those that came."""
        return [(handler, handler.take_data()) for handler in self._ready]

    async def execute(self, taken: list[tuple[EventHandler, Any]]) -> None:
        """Call their callbacks."""
        for handler, data in taken:
            await handler.execute(data)


class NodeExecutor(SingleThreadedExecutor):
    """Runs callbacks of nodes in the thread that spins it, ``async`` ones too."""

    _guard: Any

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.events = MiddlewareEvents(self._handlers)
        self._awaiting = set[Task]()

    def _handlers(self) -> list[EventHandler]:
        waitables = (waitable for node in super().get_nodes() for waitable in node.waitables)
        return [waitable for waitable in waitables if isinstance(waitable, EventHandler)]

    def get_nodes(self) -> list[Any]:
        """The nodes, and their events as another."""
        return [*super().get_nodes(), self.events]

    def can_execute(self, entity: Any) -> bool:
        """Whether an entity of a node is waited for; its events are not, by themselves."""
        return not isinstance(entity, EventHandler) and super().can_execute(entity)

    def trigger(self) -> None:
        """A callback is over: wake up where another one awaits something."""
        if self._awaiting and (guard := self._guard) is not None:
            guard.trigger()

    def _make_handler(self, *given: Any, **named: Any) -> Task:
        # What it makes calls trigger() of the executor's guard, as which this executor stands in.
        guard, self._guard = self._guard, self
        try:
            return super()._make_handler(*given, **named)
        finally:
            self._guard = guard

    def _spin_once_impl(
        self, timeout_sec: Any = None, wait_condition: Callable[[], bool] = lambda: False
    ) -> None:
        try:
            task, _, _ = self.wait_for_ready_callbacks(timeout_sec, None, wait_condition)
        except (ShutdownException, TimeoutException, ConditionReachedException):
            return
        task()
        if task.done():
            self._awaiting.discard(task)
        else:
            self._awaiting.add(task)
        if (error := task.exception()) is not None:
            raise error
