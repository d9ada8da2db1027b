"""Motor temperatures as they come, one joint at a time, put together."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import TemperatureSample

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
