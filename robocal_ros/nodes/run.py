"""Run one node as a process."""

import sys
import traceback

import rclpy
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from rclpy.task import Future

from robocal_ros.nodes.base import HouseNode

SPIN_S = 0.5


def run(node_class: type[HouseNode], *, events: bool = False) -> None:
    """Start the node, spin until SIGINT, SIGTERM or a ROS shutdown, and end cleanly.

    Parameters
    ----------
    node_class : what to run; its parameters come from the command line.
    events : use the events executor: half the CPU and latency, but no ``async`` services.
    """
    rclpy.init()
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
    if not events:
        executor = SingleThreadedExecutor()
        executor.add_node(node)
        while rclpy.ok():
            executor.spin_once(timeout_sec=SPIN_S)
        return
    from rclpy.experimental.events_executor import EventsExecutor

    executor = EventsExecutor()
    executor.add_node(node)
    while rclpy.ok():
        # A new future each time: one that never ends would gather callbacks.
        executor.spin_until_future_complete(Future(), timeout_sec=SPIN_S)
