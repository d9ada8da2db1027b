# SPDX-License-Identifier: Apache-2.0
"""The house node: a lifecycle node that starts by itself, reports its faults and ends cleanly.

A node names its parameters in ``SETTINGS`` and fills in four hooks:

- ``configure``: read ``self.settings``, open what is needed, create inputs, outputs, services;
- ``activate`` and ``deactivate``: start and stop acting (inputs while inactive: see `add_input`);
- ``cleanup``: release what ``configure`` opened; also called when ``configure`` failed half-way
  and when the process ends.

Attributes of a subclass must not be named ``_parameters``, ``_clock``, ``_logger``, ``_timers``,
``_services``, ``_clients``, ``_callbacks`` or ``_context``: those are rclpy's own.
"""

import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable
from dataclasses import replace
from typing import Any, ClassVar

import rclpy
from lifecycle_msgs.msg import State
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from robocal_ros.ground.errors import RobocalError
from robocal_ros.ros.endpoints import ERROR, WARN, Diagnostics, EndpointNode, Health
from robocal_ros.ros.executor import OneThreadExecutor
from robocal_ros.ros.parameters import ParameterTable, Setting

NO_SERIAL = "unset"  # the history's name where none is set
POLL_S = 0.5  # between two looks at what others decided in the history
AUTOSTART = Setting("autostart", True, "Configure and activate at the start")
SERIAL = Setting("serial", "", "Serial number of the robot; its history is kept under this name")


class AwaitedError(RobocalError):
    """What a node is to be configured with has not come yet: no fault of anybody."""


class HouseNode(EndpointNode):
    """Base of all nodes; see the module's text.

    ``options`` go to rclpy: ``context``, ``namespace``, ``parameter_overrides``, ``cli_args`` …
    """

    NAME: ClassVar[str]
    SETTINGS: ClassVar[tuple[Setting, ...]] = ()

    def __init__(self, **options: Any) -> None:
        super().__init__(self.NAME, **options)
        self.settings: dict[str, Any] = {}
        self._failure: Health | None = None
        self._table = ParameterTable(self, (AUTOSTART, SERIAL, *self.SETTINGS))
        self._table.changed = self._settings_changed
        self._diagnostics = Diagnostics(self, self._full_health, self._serial)

    def configure(self) -> None:
        """Open what is needed, from ``self.settings``; raise to refuse."""

    def activate(self) -> None:
        """Start acting; raise to refuse."""

    def deactivate(self) -> None:
        """Stop acting."""

    def cleanup(self) -> None:
        """Release what `configure` opened, even when it did so only in part."""

    def settings_changed(self) -> None:
        """Use new values of the ``live`` settings."""

    def health(self) -> Health:
        """Say how an active node is."""
        return Health()

    def identity(self) -> list[str]:
        """What a configured node works for, and with what."""
        return [f"serial {serial}"] if (serial := self.settings[SERIAL.name]) else []

    def autostart(self) -> None:
        """Configure and activate, where the parameter says so; a failure is logged and shown."""
        if not self.get_parameter(AUTOSTART.name).value:
            return
        if self.trigger_configure() == TransitionCallbackReturn.SUCCESS:
            self.trigger_activate()

    def close(self) -> None:
        """Release everything at the end of the process, without a transition."""
        if self.is_active:
            self._stop_acting()
        self._clean_up()
        self.destroy_node()
        # Jazzy's rclpy forgets it, and what it holds keeps the DDS participant: that would be taken
        # down by C's exit amid its running threads, now and then by a SIGSEGV.
        self._state_machine.destroy_when_not_in_use()

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Validate the parameters, then `configure`; undone when it fails."""
        result = self._attempt("configure", self._configure)
        if result == TransitionCallbackReturn.SUCCESS:
            self._log_identity("configured")
        else:
            self._clean_up()
        return result

    def _log_identity(self, became: str) -> None:
        said = ", ".join(self.identity())
        self.get_logger().info(f"{became}: {said}" if said else became)

    def _configure(self) -> None:
        self.settings = self._table.read()
        self._table.locked = True
        compiled = sys.modules.get("robocal_ros.ground.compiled")  # of nodes that have kernels
        if compiled is not None and compiled.is_cold():
            self.get_logger().warning(
                "no machine code of the kernels is kept for this software and processor: they are "
                "compiled now, which takes about a minute once; 'robocal warm' does it before"
            )
        self.configure()

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the outputs, then `activate`."""
        super().on_activate(state)
        self.is_active = False  # before `activate` has done its part nothing is taken
        result = self._attempt("activate", self.activate)
        if result == TransitionCallbackReturn.SUCCESS:
            self.is_active = True
            self._log_identity("active")
            self.take_kept()
        else:
            super().on_deactivate(state)
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """`deactivate`, then close the outputs."""
        self.is_active = False
        result = self._attempt("deactivate", self.deactivate)
        self.is_active = result != TransitionCallbackReturn.SUCCESS
        if not self.is_active:
            super().on_deactivate(state)
        return result

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Release everything; parameters may change again."""
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop acting and release everything, for good."""
        if state.state_id == State.PRIMARY_STATE_ACTIVE:
            self._stop_acting()
        self._clean_up()
        return TransitionCallbackReturn.SUCCESS

    def _attempt(self, what: str, step: Callable[[], None]) -> TransitionCallbackReturn:
        # rclpy swallows what is raised in a transition: say it here, in log and diagnostics.
        try:
            step()
        except AwaitedError as error:
            self.get_logger().info(str(error))
            return self._fail(Health(WARN, str(error)))
        except Exception as error:
            if not isinstance(error, RobocalError):
                self.get_logger().error(traceback.format_exc())
            message = f"cannot {what}: {_named(error)}"
            self.get_logger().error(message)
            return self._fail(Health(ERROR, message))
        self._failure = None
        return TransitionCallbackReturn.SUCCESS

    def _fail(self, why: Health) -> TransitionCallbackReturn:
        self._failure = why
        self._diagnostics.publish()
        return TransitionCallbackReturn.FAILURE

    def _stop_acting(self) -> None:
        self.is_active = False
        try:
            self.deactivate()
        except Exception as error:
            self.get_logger().error(f"deactivate: {error}\n{traceback.format_exc()}")

    def _clean_up(self) -> None:
        try:
            self.cleanup()
        except Exception as error:
            self.get_logger().error(f"cleanup: {error}\n{traceback.format_exc()}")
        self.release_endpoints()
        self._table.locked = False

    def _settings_changed(self) -> None:
        self.settings.update(self._table.read())
        self.settings_changed()

    def _serial(self) -> str:
        return str(self.get_parameter(SERIAL.name).value)

    def _acting_health(self) -> Health:
        try:
            return self.health()
        except Exception as error:  # a disk that fails below the history, too: the node works on
            self._log("health", error)
            return Health(ERROR, f"cannot tell how it is: {_named(error)}")

    def _full_health(self) -> Health:
        if self._failure is not None:
            health = replace(self._failure)
        elif self.is_active:
            health = self._acting_health()
        else:
            health = Health(message=self.state)
        values: dict[str, object] = {"state": self.state}
        for topic, count in self.inputs.items():
            values[f"{topic} received"] = count.received
            values[f"{topic} ignored while inactive"] = count.ignored
            values[f"{topic} invalid"] = count.invalid
            values[f"{topic} lost"] = count.lost
        health.values = values | health.values
        return health


def _named(error: Exception) -> str:
    """Its words; of one that no user can act on with its kind."""
    return str(error) if isinstance(error, RobocalError) else f"{type(error).__name__}: {error}"


# Python looks for garbage when so many objects were made, which is in the middle of a callback,
# and now and then through all objects. For maintenance_node, with 150 000 of its libraries, that is
# after 8000 more, and 75 ms: a stop would be late by as much. So what the start made is never
# looked at again, and where every millisecond counts the little rest between callbacks.


class QuietMemory:
    """Turns automatic collection off, until `end`; `look` takes its place."""

    def __init__(self) -> None:
        gc.collect()
        gc.freeze()
        gc.disable()

    def look(self) -> None:
        """Collect what was made since the start; to be called between callbacks, now and then."""
        gc.collect()

    def end(self) -> None:
        """Collect as Python does."""
        gc.unfreeze()
        gc.enable()


SPIN_S = 0.5
ENDING = {signal.SIGINT, signal.SIGTERM}


def run(node_class: type[HouseNode], *, events: bool = False) -> None:
    """Start the node, spin until SIGINT, SIGTERM or a ROS shutdown, and end cleanly.

    ``node_class``: what to run; its parameters come from the command line.
    ``events``: use the events executor: half the CPU and latency, but no ``async`` services; and
    collect garbage between callbacks only.
    """
    # A signal must not break into a callback: neither as an exception in the middle of it (the
    # conversion of a message then fails) nor as a shutdown of the context below it.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node, executor, status = None, _executor(events), 0
    try:
        ending = threading.Event()
        _watch_signals(ending, executor.wake)  # before a start that may have kernels to compile
        node = node_class()
        node.autostart()
        executor.add_node(node)
        _spin(executor, ending, events)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        traceback.print_exc()
        status = 1
    finally:
        # Say good-bye, or others take the node for alive until its lease runs out.
        try:
            if node is None:
                gc.collect()  # one that failed half way, which nobody can close
            else:
                node.close()
        finally:
            executor.shutdown()
            rclpy.try_shutdown()
    if status:
        sys.exit(status)


def _executor(events: bool) -> Executor:
    if not events:
        return OneThreadExecutor()
    from rclpy.experimental.events_executor import EventsExecutor

    return EventsExecutor()


def _spin(executor: Executor, ending: threading.Event, events: bool) -> None:
    if not events:
        gc.freeze()
        while rclpy.ok() and not ending.is_set():
            executor.spin_once(timeout_sec=SPIN_S)
        return
    memory = QuietMemory()
    while rclpy.ok() and not ending.is_set():
        # A new future each time: one that never ends would gather callbacks.
        executor.spin_until_future_complete(Future(), timeout_sec=SPIN_S)
        memory.look()
    memory.end()


def _watch_signals(ending: threading.Event, wake: Callable[[], object]) -> None:
    """End the spinning at the first signal, the process at a second one, in the start too."""

    def watch() -> None:
        signal.sigwait(ENDING)
        ending.set()
        wake()
        os._exit(128 + signal.sigwait(ENDING))

    threading.Thread(target=watch, daemon=True).start()
