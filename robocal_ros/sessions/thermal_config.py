"""Settings of the thermal session, and the drift that it expects."""

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.fitting.sphere import SphereRule
from robocal_ros.core.identification import Method
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import State
from robocal_ros.core.samples import DEFAULT_TARGET
from robocal_ros.core.streams import StandstillRule
from robocal_ros.core.thermal.priors import drift_prior, learned_prior
from robocal_ros.sessions.history import History

Prior = Literal["default", "learned"]

METHODS: tuple[Method, ...] = ("map", "lsq")
PRIORS: tuple[Prior, ...] = ("default", "learned")
LEARN_FROM = 500
SPHERE_RADIUS_M = 0.01905  # 1.5 inches across, the usual reference sphere
STOOD = (State.IN_FORCE, State.SUPERSEDED)  # what was rolled back was no drift


@dataclass(frozen=True)
class ThermalConfig:
    """Settings of a thermal session.

    Attributes
    ----------
    method : estimator where a command names none.
    prior : ``default``, or ``learned`` from the drifts accepted and not rolled back so far.
    sigma_m : standard deviation of one measured coordinate in one visit of a pose.
    drift_parameters : what ``lsq`` solves of a drift; empty: all, which takes many poses.
    hold_out, seed : share of the poses kept to judge a calibration without reference.
    cycle_timeout_s : a cycle ends when nothing was measured for so long.
    tolerance_m, expires_after_s : error that the process allows, and age at which a measurement
        says nothing any more.
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
    cycle_timeout_s: float = 300.0
    tolerance_m: float = 3e-4
    expires_after_s: float = 8.0 * 3600.0
    lateness_s: float = 0.2
    measuring_frame: str = ""
    target: str = DEFAULT_TARGET
    standstill: StandstillRule = field(default_factory=StandstillRule)
    sphere: SphereRule = field(default_factory=lambda: SphereRule(SPHERE_RADIUS_M))


def expected_drift(
    nominal: SerialArm, history: History, config: ThermalConfig
) -> NDArray[np.float64]:
    """Covariance (k, k), SI, of the drift: the default, or learned from what stood."""
    default = drift_prior(nominal)
    if config.prior == "default":
        return default
    accepted = [entry.id for entry in history.list(LEARN_FROM) if entry.state in STOOD]
    models = [history.model(calibration_id) for calibration_id in accepted]
    drifts = [m for m in models if "reference_mdh" in m]
    if not drifts:
        return default
    changes = [np.array(m["mdh"]) - np.array(m["reference_mdh"]) for m in drifts]
    return learned_prior(
        default,
        np.array([nominal.parameters.read(change) for change in changes]),
        np.array([m["covariance"] for m in drifts]),
    )
