"""What a robot does that is driven through a tool measurement, and how long it may."""

from enum import Enum

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.motion.cell import MotionCell
from robocal_ros.motion.driving_config import DrivingConfig
from robocal_ros.motion.housing import ToolBody
from robocal_ros.tool.run import ToolRun

STANDS_S = 0.2  # a robot that a run takes over has rested for so long
SETTLED_S = 0.03  # one whose own motion has ended
SILENT_ARMED_S = 1.0  # an armed robot without joint states is disarmed
REST_WITHIN_S = 2.0  # after a motion's end
MOST_EDGES = {"circle": 24, "plunge": 16}  # with bounces; more is no tool on its way
NO_RUN = (0, 0)


class DrivePhase(Enum):
    """What the robot does."""

    IDLE = "idle"
    APPROACH = "on its way to a step"
    MEASURE = "driving a step"


class StopError(RobocalError):
    """Something happened at which the robot must stop."""

    def __init__(self, code: Code, message: str) -> None:
        super().__init__(message)
        self.code = code


def station_cell(run: ToolRun, config: DrivingConfig) -> MotionCell:
    """Robot, the tool as it was seen last, and the station of a run."""
    seen = run.plan.T_flange_tool if run.seen is None else run.seen
    body = ToolBody(seen, config.tool_length_m, config.tool_radius_m, config.flange_radius_m)
    return MotionCell(run.arm, body, run.plan.laser.T_base_laser, config.housing, config.limits)
