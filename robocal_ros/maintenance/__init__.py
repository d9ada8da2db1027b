"""The maintenance of a cell in its production gaps.

session         what is driven: heartbeats, readings, calls and answers in, requests out
requests        what it asks of its driver, and what is answered
asking          requests that wait for answers, from tick to tick
config          settings, bounds, and how long each part may take
conductor       plays a run's script, stops everything where something is odd
run             the script of a run: thermal, tool, decisions
thermal_part    visit the measuring poses, end the cycle
tool_part       quick check, full measurement, verification
tool_measuring  one measurement of the tool, and what it tells
hands           what a script does with robot and nodes
disarming       whether the tool's node may move the robot
mover           one motion at a time, supervised
ways            the ways that the robot may take
deciding        accept, reject, roll back; what needs no person
settling        what a run decides itself, with patience
memory          what outlives a restart
heard           what the thermal node and the joint correction say
accuracy        drift, tool, correction and faults in one state
status          what is said
"""

from robocal_ros.maintenance.memory import AcceptBounds, CycleResult, MaintenanceConfig, Times
from robocal_ros.maintenance.session import MaintenanceSession, MaintenanceState, Status

__all__ = [
    "AcceptBounds",
    "CycleResult",
    "MaintenanceConfig",
    "MaintenanceSession",
    "MaintenanceState",
    "Status",
    "Times",
]
