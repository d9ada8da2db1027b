"""How accurate the robot is believed to be now, for the line."""

import math
from dataclasses import dataclass
from typing import Any

from robocal_ros.ground.errors import RobocalError
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.drift_following import DriftFollower, Following
from robocal_ros.thermal.in_force import InForce
from robocal_ros.thermal.temperatures import MotorTemperatures

DUE_AHEAD_S = 300.0  # a measurement is due so long before the bound reaches the tolerance


@dataclass(frozen=True)
class Accuracy:
    """What the line reads.

    Attributes
    ----------
    error : expected error of the tool; None where it is not known.
    due_in_s : time until a measurement is due; negative when overdue, 0 where nothing is known.
    """

    level: AccuracyLevel
    reason: str
    error: ToolError | None = None
    due_in_s: float = 0.0

    def document(self, tolerance_m: float) -> dict[str, Any]:
        """The fields of ``AccuracyState.msg``; -1 where the error is not known.

        A figure that is not finite makes it a FAULT: the line must not go on with what it read
        before.
        """
        error = self.error
        told_mm = (-1.0, -1.0) if error is None else (error.rms_m * 1e3, error.bound_m * 1e3)
        if not all(map(math.isfinite, (*told_mm, self.due_in_s))):
            words = "a figure of the accuracy is not finite, please report it"
            return Accuracy(AccuracyLevel.FAULT, words).document(tolerance_m)
        return {
            "state": int(self.level),
            "predicted_error_mm": told_mm[0],
            "bound_mm": told_mm[1],
            "tolerance_mm": tolerance_m * 1e3,
            "due_in_s": self.due_in_s,
            "reason": self.reason,
        }


def accuracy_of(
    following: Following,
    current: InForce,
    config: ThermalConfig,
    temperatures: MotorTemperatures,
    stamp_ns: int,
) -> Accuracy:
    """Judge the model in force at a stamp, with the motors' temperatures."""
    if current.fault:
        return Accuracy(AccuracyLevel.FAULT, current.fault)
    try:
        follower = following.follower
        if follower is None:
            words = "no cold reference: how far the robot has drifted is not known; capture one"
            return Accuracy(AccuracyLevel.EXPIRED, words)
        with follower.looking_ahead(temperatures.between(follower.read_ns, stamp_ns)):
            return _judged(follower, current, config, stamp_ns)
    except RobocalError as error:
        return Accuracy(AccuracyLevel.FAULT, str(error))


def _judged(
    follower: DriftFollower, current: InForce, config: ThermalConfig, stamp_ns: int
) -> Accuracy:
    time_s = follower.time_s(stamp_ns)
    forecast = follower.forecast(current.arm)
    error, tolerance_mm = forecast.at(time_s), config.tolerance_m * 1e3
    age_s = time_s - follower.state.tracker.time_s
    left_s = config.expires_after_s - age_s
    due_in_s = min(forecast.due_in_s(time_s, config.tolerance_m), left_s) - DUE_AHEAD_S
    bound = f"95 % of tool errors below {error.bound_m * 1e3:.2f} mm"
    allowed = f"of {tolerance_mm:.2f} mm allowed"
    if follower.state.moved:
        return Accuracy(AccuracyLevel.FAULT, follower.state.moved, error, due_in_s)
    if left_s <= 0.0:
        words = f"last measured {age_s / 3600.0:.1f} h ago: measure a cycle"
        return Accuracy(AccuracyLevel.EXPIRED, words, error, due_in_s)
    if error.bound_m > config.tolerance_m:
        words = f"{bound}, {allowed}: measure a cycle, accept its model"
        return Accuracy(AccuracyLevel.DEGRADED, words, error, due_in_s)
    if due_in_s <= 0.0:
        return Accuracy(AccuracyLevel.DUE, f"{bound}, {allowed}: measure a cycle", error, due_in_s)
    return Accuracy(AccuracyLevel.OK, f"{bound}, {allowed}", error, due_in_s)
