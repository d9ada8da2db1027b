"""What is said of the maintenance."""

from dataclasses import dataclass
from enum import IntEnum

from robocal_ros.core.codes import Code
from robocal_ros.sessions.maintenance.memory import CycleResult


class State(IntEnum):
    """Numbers of ``MaintenanceStatus.msg``; 0 is never sent."""

    IDLE = 1
    """Nothing runs; the robot is the PLC's."""
    RUNNING = 2
    """A cycle runs; this node may move the robot."""
    BREAKING_OFF = 3
    """A cycle was cancelled: the robot is stopped and brought home."""
    FAULT = 4
    """A person must look; nothing moves until it is acknowledged."""


@dataclass(frozen=True)
class Status:
    """The maintenance at one instant.

    Attributes
    ----------
    cycle_id : that runs, or ran last.
    doing : in words.
    left_s : of the gap; 0 while nothing runs.
    at_home, disarmed : of the robot and of the tool's driver, as far as is known; disarmed is one
        of which nothing is under way either.
    last : how the last cycle ended; None before any.
    thermal_pending, tool_pending : newest candidates that wait for a decision; 0: none.
    fault_code, fault : NONE and empty without one.
    closed : why the gap counts as closed; empty while it is open.
    trouble : why nobody knows what waits; empty: the pending ids are true.
    """

    state: State
    cycle_id: str
    doing: str
    left_s: float
    at_home: bool
    disarmed: bool
    last: CycleResult | None
    thermal_pending: int
    tool_pending: int
    fault_code: Code
    fault: str
    closed: str = ""
    trouble: str = ""
