"""Where a follower of the drift stands, in forms that are kept: bit for bit."""

import base64
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.thermal.heat import Heat
from robocal_ros.thermal.tracking import DriftState

Array = NDArray[np.float64]

HEAT = "tracker_heat"
TIMES = "tracker_times"  # of a kept cycle: the tracker's, and that of the first refused one
STATE = ("tracker_mean", "tracker_covariance", "tracker_clock")


@dataclass(frozen=True, eq=False)
class FollowerState:
    """Where a follower stands.

    Attributes
    ----------
    tracker : state of the tracker; its time counts from the cold visit.
    heat : motor temperatures as last read, where they are in use.
    anchor_ns : stamp that the tracker's time is at; that of the last cycle until the clock jumps.
    stamp_ns : of the last cycle that was taken, of the cold visit before the first.
    cycles : kept since the cold visit, refused ones among them.
    moved, moved_s : why the last cycle was refused, empty where it was not; and the tracker's
        time of the first of those that were refused in a row.
    """

    tracker: DriftState
    heat: Heat | None
    stamp_ns: int
    cycles: int
    anchor_ns: int
    moved: str = ""
    moved_s: float | None = None

    def document(self) -> dict[str, Any]:
        """In plain values, bit for bit."""
        mean, covariance, clock = (self.arrays()[name] for name in STATE)
        return {
            "mean": _text(mean),
            "covariance": _text(covariance),
            "time_s": self.tracker.time_s,
            "clock": clock.tolist(),
            "moved": self.moved,
            "moved_s": self.moved_s,
            "heat": None if self.heat is None else _text(self.heat.array()),
        }

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "FollowerState":
        """Read it back.

        Raises
        ------
        InputError
            When it is no such document.
        """
        try:
            arrays = {
                STATE[0]: _array(document["mean"]),
                STATE[1]: _array(document["covariance"]),
                STATE[2]: np.array(document["clock"], dtype=np.int64),
            }
            if document["heat"] is not None:
                arrays[HEAT] = _array(document["heat"])
            times = float(document["time_s"]), document["moved_s"]
            return cls.of_arrays(arrays, times, str(document["moved"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"the recorded state of the tracker cannot be read: {error}"
            ) from error

    def arrays(self) -> dict[str, NDArray[Any]]:
        """In arrays; the covariance is symmetric to the last bit, one half of it is kept."""
        P = self.tracker.covariance
        clock = np.array([self.stamp_ns, self.cycles, self.anchor_ns], dtype=np.int64)
        return dict(zip(STATE, (self.tracker.mean, P[np.triu_indices(len(P))], clock), strict=True))

    @classmethod
    def of_arrays(
        cls, arrays: Mapping[str, NDArray[Any]], times: tuple[float, float | None], moved: str
    ) -> "FollowerState":
        """Read it back; ``times`` are the tracker's and `moved_s`."""
        mean, half, clock = (arrays[name] for name in STATE)
        P = np.zeros((len(mean),) * 2)
        rows, columns = np.triu_indices(len(mean))
        P[rows, columns] = P[columns, rows] = half
        heat = Heat.of_array(arrays[HEAT]) if HEAT in arrays else None
        tracker = DriftState(times[0], mean, P)
        stamp_ns, cycles, anchor_ns = (int(value) for value in clock)
        return cls(tracker, heat, stamp_ns, cycles, anchor_ns, moved, times[1])


def _text(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode()


def _array(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").astype(np.float64)
