"""One diagnostic status per node, at 1 Hz, named after the node, with the robot's serial."""

from collections.abc import Callable
from dataclasses import dataclass, field

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock, ClockType
from rclpy.lifecycle import LifecycleNode

from robocal_ros.ros import qos

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
        self._publisher = node.create_publisher(
            DiagnosticArray, "/diagnostics", qos.own(qos.RELIABLE)
        )
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
