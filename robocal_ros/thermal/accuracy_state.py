"""How accurate the robot is believed to be now, for the line."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.samples import TemperatureSample
from robocal_ros.thermal.accuracy import AccuracyLevel, ToolError
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.drift_following import DriftFollower, Following, InForce

# ---- motor temperatures as they come, one joint at a time, put together -------------------------


Array = NDArray[np.float64]

EVERY_NS = 10_000_000_000  # of a joint's samples within ten seconds the first one counts
SILENT_NS = 900_000_000_000  # a temperature says nothing any more after a quarter of an hour
MOST_KEPT = 20_000  # of those ten seconds: more than two days


class MotorTemperatures:
    """All joints' temperatures, whatever order they arrive in.

    Attributes
    ----------
    newest_ns : newest stamp; None before the first.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._place = {name: i for i, name in enumerate(names)}
        self._kept: dict[int, dict[int, TemperatureSample]] = {}
        self.newest_ns: int | None = None

    def add(self, sample: TemperatureSample) -> None:
        """Take a joint's temperature.

        Raises
        ------
        InputError
            When the robot has no such joint.
        """
        if sample.joint not in self._place:
            raise InputError(
                f"temperature of '{sample.joint}': frame_id must be a joint's name, one of "
                f"{', '.join(self._place)}"
            )
        joint, ten = self._place[sample.joint], sample.stamp_ns // EVERY_NS
        first = self._kept.setdefault(ten, {}).setdefault(joint, sample)
        if sample.stamp_ns < first.stamp_ns:
            self._kept[ten][joint] = sample
        self.newest_ns = max(sample.stamp_ns, self.newest_ns or sample.stamp_ns)
        if len(self._kept) > MOST_KEPT:
            for old in sorted(self._kept)[: MOST_KEPT // 2]:
                del self._kept[old]

    def between(self, after_ns: int, until_ns: int) -> list[tuple[int, Array]]:
        """Stamps and temperatures (n,), degrees Celsius, after one stamp and up to another.

        None where a joint has been silent for a quarter of an hour.
        """
        stamp = np.full(len(self._place), -SILENT_NS, dtype=np.int64)
        celsius = np.full(len(self._place), np.nan)
        first, last = (after_ns - SILENT_NS) // EVERY_NS, until_ns // EVERY_NS
        found = []
        for ten in sorted(t for t in self._kept if first <= t <= last):
            known = {j: s for j, s in self._kept[ten].items() if s.stamp_ns <= until_ns}
            for joint, sample in known.items():
                stamp[joint], celsius[joint] = sample.stamp_ns, sample.celsius
            now_ns = max((s.stamp_ns for s in known.values()), default=after_ns)
            if now_ns > after_ns and now_ns - int(stamp.min()) < SILENT_NS:
                found.append((now_ns, celsius.copy()))
        return found

    def at(self, stamp_ns: int) -> Array | None:
        """Temperatures (n,) at a stamp; None where they are not known."""
        found = self.between(stamp_ns - SILENT_NS, stamp_ns)
        return found[-1][1] if found else None


# ---- how accurate the robot is believed to be now, for the line ---------------------------------


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
