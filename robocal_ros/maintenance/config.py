"""Settings of the maintenance of a cell."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.motion.housing import DrivingConfig

Array = NDArray[np.float64]


@dataclass(frozen=True)
class AcceptBounds:
    """What may be accepted without a person, absolute against the commissioning model.

    Attributes
    ----------
    automatic : False: nothing may.
    thermal_m : largest shift of the tool's tip at home and measuring poses from the cold reference.
    tool_m, tool_rad : of the tip and of the axis from the taught tool.
    """

    automatic: bool = False
    thermal_m: float = 1e-3
    tool_m: float = 1e-3
    tool_rad: float = float(np.radians(1.5))


@dataclass(frozen=True)
class Times:
    """How long each part may take at the most, s; what takes longer is broken off.

    Attributes
    ----------
    answer_s : a service of another node.
    solve_s : the end of a thermal cycle.
    settle_s : a measurement counts so long after the robot stands.
    stay_s : the robot stays so long after the last measurement of a pose.
    measure_s : at a pose, from standstill on.
    check_s, full_s : a quick check and a full measurement of the tool, from home to its end.
    tool_home_s : kept free for the way home from the beams; a longer one counts once it was driven.
    reserve_s : kept free before the end of a gap.
    rest_s : after a motion's end, until the robot rests where it ends.
    stale_s : ``gap_open`` may pause for so long.
    """

    answer_s: float = 1.0
    solve_s: float = 6.0
    settle_s: float = 0.3
    stay_s: float = 0.2
    measure_s: float = 3.0
    check_s: float = 15.0
    full_s: float = 30.0
    tool_home_s: float = 10.0
    reserve_s: float = 1.0
    rest_s: float = 1.0
    stale_s: float = 0.5

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} = {value}: must be positive and finite")


@dataclass(frozen=True, eq=False)
class MaintenanceConfig:
    """What the maintenance of one robot is made of.

    Attributes
    ----------
    home : (n,) taught joints at which the robot is handed over, rad (prismatic: m).
    poses : (k, n) measuring poses in their order; k = 0: no thermal measurement. The straight
        joint lines from home through all of them and back home are ways that are free.
    T_flange_tool : (4, 4) the taught tool.
    T_base_laser : (4, 4) of the beam station; None: no tool measurement.
    driving : limits, sizes and deviations; its limits hold at the station.
    travel_speed_m_s : of the tip on the ways between taught poses.
    home_near : (n,), or one for all: the robot is at home with all joints so near, rad (m).
    measurements : so many make a pose measured.
    resume_within_s : an unfinished thermal cycle goes on when its last pose is no older. The
        tracker takes all poses of a cycle for measured in its middle, half of a pause away: within
        300 s a cold robot of this size drifts by as much as one measurement scatters, 0.03 mm.
    check_every_s, full_every_s : tool measurements that are due without a reason; 0: in each gap,
        and never.
    tool_due_s, tool_expires_s : age of a tool check at which it is due, and says nothing any more.
    silent_s : `~/accuracy` of the thermal node may pause for so long.
    correction_silent_s : the same of the joint correction's status; 0: there is none, whatever is
        in force is applied by the robot's controller.
    tolerance_m : error that the process allows.
    """

    home: Array
    poses: Array
    T_flange_tool: Array
    driving: DrivingConfig
    T_base_laser: Array | None = None
    travel_speed_m_s: float = 0.25
    home_near: ArrayLike = float(np.radians(0.5))
    measurements: int = 1
    resume_within_s: float = 600.0
    check_every_s: float = 0.0
    full_every_s: float = 0.0
    tool_due_s: float = 2.0 * 3600.0
    tool_expires_s: float = 8.0 * 3600.0
    silent_s: float = 5.0
    correction_silent_s: float = 5.0
    tolerance_m: float = 3e-4
    times: Times = field(default_factory=Times)
    bounds: AcceptBounds = field(default_factory=AcceptBounds)
