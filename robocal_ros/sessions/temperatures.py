"""Motor temperatures as they come, one joint at a time, put together."""

from bisect import bisect_right, insort
from operator import attrgetter

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.errors import InputError
from robocal_ros.core.samples import TemperatureSample

Array = NDArray[np.float64]

TEMPERATURES = "motor_temperatures"
EVERY_NS = 10_000_000_000  # of readings closer together the last one counts
MOST_KEPT = 20_000  # readings: more than two days


class MotorTemperatures:
    """All joints' temperatures at one stamp after the other, whatever order they arrive in.

    Attributes
    ----------
    newest_ns : newest stamp; None before the first.
    """

    def __init__(self, names: tuple[str, ...]) -> None:
        self._place = {name: i for i, name in enumerate(names)}
        self._samples: list[TemperatureSample] = []
        self._readings: list[tuple[int, Array]] = []
        self._latest = np.full(len(names), np.nan)
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
        late = self.newest_ns is not None and sample.stamp_ns < self.newest_ns
        insort(self._samples, sample, key=attrgetter("stamp_ns"))
        self.newest_ns = max(sample.stamp_ns, self.newest_ns or sample.stamp_ns)
        if late:
            self._put_together()
        else:
            self._follow(sample)
        if len(self._readings) > MOST_KEPT:
            del self._readings[: MOST_KEPT // 2]
            first = self._readings[0][0]
            del self._samples[: bisect_right(self._samples, first, key=attrgetter("stamp_ns"))]

    def until(self, stamp_ns: int) -> list[tuple[int, Array]]:
        """Stamps and temperatures (n,), degrees Celsius, of all joints up to a stamp."""
        end = bisect_right(self._readings, stamp_ns, key=lambda reading: reading[0])
        return self._readings[:end]

    def _put_together(self) -> None:
        self._readings, self._latest = [], np.full(len(self._place), np.nan)
        for sample in self._samples:
            self._follow(sample)

    def _follow(self, sample: TemperatureSample) -> None:
        self._latest[self._place[sample.joint]] = sample.celsius
        if np.any(np.isnan(self._latest)):
            return
        reading = sample.stamp_ns, self._latest.copy()
        if self._readings and self._readings[-1][0] // EVERY_NS == sample.stamp_ns // EVERY_NS:
            self._readings[-1] = reading
        else:
            self._readings.append(reading)
