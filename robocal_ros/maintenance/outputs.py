"""What the maintenance node says: its topics, and its results as messages."""

from collections.abc import Callable
from typing import Any

from rclpy.qos import QoSProfile
from robocal_msgs.msg import AccuracyState, MaintenanceResult, MaintenanceStatus

from robocal_ros.maintenance import CycleResult, Status
from robocal_ros.ros import conversions, qos
from robocal_ros.ros.session_events import SessionEvents
from robocal_ros.thermal.accuracy_state import Accuracy
from robocal_ros.thermal.services import accuracy_message
from robocal_ros.tool.services import ANSWERS

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
        self._status = add(MaintenanceStatus, "~/status", qos.LATCHED)
        self._accuracy = add(AccuracyState, "accuracy_state", qos.LATCHED)
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
            accuracy_message(
                found,
                tolerance_m,
                robot=self._robot,
                serial=self._serial,
                stamp=conversions.header(now_ns, self._base),
            )
        )
