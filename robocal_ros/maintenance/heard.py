"""What the thermal node and the joint correction say of themselves, while it is fresh."""

import numpy as np

from robocal_ros.correction.status import ToldCorrection, uncorrected
from robocal_ros.ground.proposals import Head
from robocal_ros.maintenance.accuracy import Drift
from robocal_ros.maintenance.config import MaintenanceConfig


class Heard:
    """Keeps what came last; times of a steady clock."""

    def __init__(self, config: MaintenanceConfig) -> None:
        self._config = config
        self._drift: tuple[Drift, float] | None = None
        self._correction: tuple[ToldCorrection, float] | None = None
        self._in_force: tuple[int, int] | None = None
        self._since_s = -np.inf  # from when on that is in force, as far as it was looked at

    def take_drift(self, drift: Drift, now_s: float) -> None:
        """Keep what the thermal node says."""
        self._drift = drift, now_s

    def take_correction(self, told: ToldCorrection, now_s: float) -> None:
        """Keep what the joint correction says."""
        self._correction = told, now_s

    def drift(self, now_s: float) -> Drift | None:
        """None while the thermal node is silent."""
        drift = self._drift
        return drift[0] if drift is not None and now_s - drift[1] <= self._config.silent_s else None

    def uncorrected(self, thermal: Head, tool: Head, now_s: float) -> str:
        """Why commands are not corrected with what is in force; empty: they are, or need not be.

        What has just come into force reaches the correction by way of another node: until it has,
        as long as it may be silent, the revision before is no fault.
        """
        silent_s, told = self._config.correction_silent_s, self._correction
        if silent_s == 0.0:
            return ""
        in_force = thermal.revision, tool.revision
        if in_force != self._in_force:
            self._since_s = now_s if self._in_force is not None else -np.inf
            self._in_force = in_force
        fresh = told[0] if told is not None and now_s - told[1] <= silent_s else None
        return uncorrected(fresh, thermal, tool, follows=now_s - self._since_s <= silent_s)
