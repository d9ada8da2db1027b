"""Parameters of the nodes that measure at standstill."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from robocal_ros.ground.streams import StandstillRule
from robocal_ros.ros.parameters import Setting

STANDSTILL = (
    Setting(
        "standstill_before_s",
        0.3,
        "The robot stands still so long before a measurement's stamp",
        unit="s",
        low=0.0,
        high=10.0,
    ),
    Setting("standstill_after_s", 0.1, "and so long after it", unit="s", low=0.0, high=10.0),
    Setting(
        "standstill_tolerance_deg",
        0.02,
        "Largest range of a joint that stands still",
        unit="deg",
        low=1e-4,
        high=5.0,
    ),
    Setting(
        "joint_gap_s",
        0.25,
        "Longest pause between two joint readings about a measurement",
        unit="s",
        low=1e-3,
        high=10.0,
    ),
)


def standstill_rule(settings: Mapping[str, Any]) -> StandstillRule:
    """The rule that they say."""
    return StandstillRule(
        before_s=settings["standstill_before_s"],
        after_s=settings["standstill_after_s"],
        tolerance_rad=float(np.radians(settings["standstill_tolerance_deg"])),
        gap_s=settings["joint_gap_s"],
    )
