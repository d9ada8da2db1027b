"""Settings of the thermal session."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np

from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground.samples import DEFAULT_TARGET
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.identification import Method
from robocal_ros.thermal.accuracy import Work

Prior = Literal["default", "learned"]

METHODS: tuple[Method, ...] = ("map", "lsq")
PRIORS: tuple[Prior, ...] = ("default", "learned")
SPHERE_RADIUS_M = 0.01905  # 1.5 inches across, the usual reference sphere


@dataclass(frozen=True)
class ThermalConfig:
    """Settings of a thermal session.

    Attributes
    ----------
    method : estimator where a command names none.
    prior : ``default``, or ``learned`` from the shifts in the history.
    sigma_m : standard deviation of one measured coordinate in one visit of a pose.
    drift_parameters : what ``lsq`` solves of a drift; empty: all, which takes many poses.
    hold_out, seed : share of the poses kept to judge a calibration without reference.
    cycle_timeout_s : a cycle ends when nothing was measured for so long.
    tolerance_m, expires_after_s : error that the process allows, and age at which a measurement
        says nothing any more.
    work_poses, tip_m : where accuracy is judged: joints of the working poses, rad (prismatic: m),
        and the tool's tip on the flange; empty: throughout the joint limits, and the target.
    lateness_s : a command waits for joint readings this much newer, so that measurements
        under way still count.
    measuring_frame : frame of the measurements; empty: that of the first one used.
    target : name of the target where the measurement's frame_id gives none.
    sphere : what a sphere in a cloud must be like.
    """

    method: Method = "map"
    prior: Prior = "default"
    sigma_m: float = 3e-5
    drift_parameters: tuple[str, ...] = ()
    hold_out: float = 0.5
    seed: int = 0
    cycle_timeout_s: float = 660.0
    tolerance_m: float = 3e-4
    expires_after_s: float = 8.0 * 3600.0
    work_poses: tuple[tuple[float, ...], ...] = ()
    tip_m: tuple[float, ...] = ()
    lateness_s: float = 0.2
    measuring_frame: str = ""
    target: str = DEFAULT_TARGET
    standstill: StandstillRule = field(default_factory=StandstillRule)
    sphere: SphereRule = field(default_factory=lambda: SphereRule(SPHERE_RADIUS_M))

    @cached_property
    def work(self) -> Work:
        """Where accuracy is judged."""
        q, tip = (np.array(given) if given else None for given in (self.work_poses, self.tip_m))
        return Work(q, tip)
