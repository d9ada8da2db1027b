"""Run one node as a process."""

import gc
import os
import signal
import sys
import threading
import traceback
from collections.abc import Callable

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future

from robocal_ros.ros.base import HouseNode

# ---- garbage collection that waits until no message does ----------------------------------------
#
# Python looks for garbage when so many objects were made, which is in the middle of a callback,
# and now and then through all objects: tens of milliseconds for a node with its libraries. Here
# what the start made is never looked at again, and the little rest between callbacks.


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


# ---- run one node as a process ------------------------------------------------------------------


SPIN_S = 0.5
ENDING = {signal.SIGINT, signal.SIGTERM}


def run(node_class: type[HouseNode], *, events: bool = False) -> None:
    """Start the node, spin until SIGINT, SIGTERM or a ROS shutdown, and end cleanly.

    Parameters
    ----------
    node_class : what to run; its parameters come from the command line.
    events : use the events executor: half the CPU and latency, but no ``async`` services; and
        collect garbage between callbacks only.
    """
    # A signal must not break into a callback: neither as an exception in the middle of it (the
    # conversion of a message then fails) nor as a shutdown of the context below it.
    signal.pthread_sigmask(signal.SIG_BLOCK, ENDING)
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    node = None
    try:
        node = node_class()
        node.autostart()
        _spin(node, events)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except Exception:
        traceback.print_exc()
        sys.exit(1)
    finally:
        # Say good-bye, or others take the node for alive until its lease runs out.
        if node is not None:
            node.close()
        rclpy.try_shutdown()


def _spin(node: HouseNode, events: bool) -> None:
    ending = threading.Event()
    if not events:
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        _watch_signals(ending, executor.wake)
        while rclpy.ok() and not ending.is_set():
            executor.spin_once(timeout_sec=SPIN_S)
        return
    from rclpy.experimental.events_executor import EventsExecutor

    executor = EventsExecutor()
    executor.add_node(node)
    _watch_signals(ending, executor.wake)
    memory = QuietMemory()
    while rclpy.ok() and not ending.is_set():
        # A new future each time: one that never ends would gather callbacks.
        executor.spin_until_future_complete(Future(), timeout_sec=SPIN_S)
        memory.look()
    memory.end()


def _watch_signals(ending: threading.Event, wake: Callable[[], object]) -> None:
    """End the spinning at the first signal, the process at a second one."""

    def watch() -> None:
        signal.sigwait(ENDING)
        ending.set()
        wake()
        os._exit(128 + signal.sigwait(ENDING))

    threading.Thread(target=watch, daemon=True).start()
