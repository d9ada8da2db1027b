"""Settings of a driven tool measurement."""

from dataclasses import dataclass, field

import numpy as np

from robocal_ros.motion.housing import Housing
from robocal_ros.motion.limits import MotionLimits


@dataclass(frozen=True, eq=False)
class DrivingConfig:
    """What a driven measurement may do.

    Attributes
    ----------
    tool_length_m, tool_radius_m, flange_radius_m : see `ToolBody`.
    deviation_m, deviation_rad : largest distance of the tip, and of a turning joint, from the plan.
    silence_s : joint states may pause for so long while the robot moves.
    late_s : the robot lags at most so far behind its plan.
    armed_s : without a run it disarms after so long.
    """

    housing: Housing
    tool_length_m: float
    tool_radius_m: float
    flange_radius_m: float
    limits: MotionLimits = field(default_factory=MotionLimits)
    deviation_m: float = 2e-3
    deviation_rad: float = float(np.radians(0.5))
    silence_s: float = 0.1
    late_s: float = 0.15
    armed_s: float = 60.0
