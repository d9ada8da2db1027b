"""What is said of the maintenance."""

from dataclasses import dataclass
from enum import IntEnum

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.ground.proposals import THERMAL, TOOL
from robocal_ros.maintenance.deciding import Decider
from robocal_ros.maintenance.hands import Hands
from robocal_ros.maintenance.memory import CycleResult, Memory


class MaintenanceState(IntEnum):
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
    beat : counts up with each status that is published; the PLC's heartbeat echoes it.
    closed : why the gap counts as closed; empty while it is open.
    trouble : why nobody knows what waits; empty: the pending ids are true.
    """

    state: MaintenanceState
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
    beat: int
    closed: str = ""
    trouble: str = ""


def status_of(
    state: MaintenanceState,
    running: CycleResult | None,
    memory: Memory,
    hands: Hands,
    decider: Decider,
    now_s: float,
) -> Status:
    """All of it, at a time; ``running``: the cycle that runs, as far as it has come."""
    last = next(reversed(memory.cycles.values()), None)
    named = last.cycle_id if last is not None else ""
    thermal, tool, trouble = 0, 0, ""
    try:
        newest = [decider.newest(kind) for kind in (THERMAL, TOOL)]
        thermal, tool = (found.id if found else 0 for found in newest)
    except RobocalError as error:
        trouble = str(error)
    return Status(
        state=state,
        cycle_id=named if running is None else running.cycle_id,
        doing=hands.doing,
        left_s=0.0 if running is None else max(hands.gap.left_s(now_s), 0.0),
        at_home=not hands.robot.beside_home(),
        disarmed=not hands.tool.doubted,
        last=last,
        thermal_pending=thermal,
        tool_pending=tool,
        fault_code=memory.fault_code,
        fault=memory.fault,
        beat=hands.gap.beat,
        closed=hands.gap.closed(now_s),
        trouble=trouble,
    )
