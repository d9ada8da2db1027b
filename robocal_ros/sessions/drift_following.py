"""The tracker of the cold reference in force: a function of it and of the cycles kept since.

So it survives a restart: the history holds each cycle's measurements, and every so often the
tracker's state, from which the later cycles are taken again.
"""

import base64
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import InputError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import THERMAL
from robocal_ros.core.samples import Measurements
from robocal_ros.core.thermal.accuracy import AccuracyForecast
from robocal_ros.core.thermal.process import DriftProcess
from robocal_ros.core.thermal.reference import ColdReference
from robocal_ros.core.thermal.steps import FixedSphere
from robocal_ros.core.thermal.tracked_cycle import TrackedCycle, track_cycle
from robocal_ros.core.thermal.tracking import DriftTracker, TrackerState
from robocal_ros.sessions.history import History
from robocal_ros.sessions.in_force import InForce

Array = NDArray[np.float64]

CHECKPOINT_EVERY = 32  # cycles between two kept states: a restart takes at most so many again
LOOK_BACK = 500
STATE = ("tracker_mean", "tracker_covariance", "tracker_clock")


@dataclass(frozen=True, eq=False)
class FollowerState:
    """Where a follower stands.

    Attributes
    ----------
    tracker : state of the tracker; its time counts from the cold visit.
    stamp_ns : of the last cycle that was taken, of the cold visit before the first.
    cycles : kept since the cold visit, refused ones among them.
    moved : why the last cycle was refused; empty where it was not.
    """

    tracker: TrackerState
    stamp_ns: int
    cycles: int
    moved: str = ""

    def document(self) -> dict[str, Any]:
        """In plain values, bit for bit."""
        mean, covariance, clock = self.arrays().values()
        return {
            "mean": _text(mean),
            "covariance": _text(covariance),
            "time_s": self.tracker.time_s,
            "clock": clock.tolist(),
            "moved": self.moved,
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
            return cls.of_arrays(arrays, float(document["time_s"]), str(document["moved"]))
        except (KeyError, TypeError, ValueError) as error:
            raise InputError(
                f"the recorded state of the tracker cannot be read: {error}"
            ) from error

    def arrays(self) -> dict[str, NDArray[Any]]:
        """In arrays; the covariance is symmetric to the last bit, one half of it is kept."""
        P = self.tracker.covariance
        clock = np.array([self.stamp_ns, self.cycles], dtype=np.int64)
        return dict(zip(STATE, (self.tracker.mean, P[np.triu_indices(len(P))], clock), strict=True))

    @classmethod
    def of_arrays(
        cls, arrays: Mapping[str, NDArray[Any]], time_s: float, moved: str
    ) -> "FollowerState":
        """Read it back."""
        mean, half, clock = (arrays[name] for name in STATE)
        P = np.zeros((len(mean),) * 2)
        rows, columns = np.triu_indices(len(mean))
        P[rows, columns] = P[columns, rows] = half
        return cls(TrackerState(time_s, mean, P), int(clock[0]), int(clock[1]), moved)


class DriftFollower:
    """Takes cycles in the order in which they are kept.

    Parameters
    ----------
    reference, prior : cold reference, and (k, k) covariance of the expected drift, SI.
    """

    def __init__(self, reference: ColdReference, prior: Array, sigma_m: float) -> None:
        self._process = DriftProcess(prior)
        self._tracker = DriftTracker(reference.spots, self._process, sigma_m)
        self._reference = reference
        self._sigma_m = sigma_m
        self._forecast: tuple[SerialArm, AccuracyForecast] | None = None
        self.state = FollowerState(self._tracker.state, reference.data.middle_ns, 0)

    def take(
        self, cycle: Measurements, in_force: SerialArm, fixed: FixedSphere | None
    ) -> TrackedCycle:
        """Take a cycle, or refuse it as moved.

        Raises
        ------
        RobocalError
            When it cannot answer; then nothing has changed.
        """
        stamp_ns = cycle.middle_ns
        time_s = self._time_s(stamp_ns)
        found = track_cycle(self._tracker, cycle, time_s, in_force=in_force, fixed=fixed)
        refused = found.judged.verdict.code is Code.SENSOR_OR_ROBOT_MOVED
        self.state = FollowerState(
            tracker=self._tracker.state,
            stamp_ns=self.state.stamp_ns if refused else stamp_ns,
            cycles=self.state.cycles + 1,
            moved=found.judged.verdict.reason if refused else "",
        )
        return found

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Undo what is taken within when it cannot be kept."""
        before = self.state
        try:
            yield
        except BaseException:
            self.go_on_from(before)
            raise

    def go_on_from(self, state: FollowerState) -> None:
        """Go on from a state of a follower of the same reference."""
        self.state, self._tracker.state = state, state.tracker

    def checkpoint(self) -> dict[str, NDArray[Any]]:
        """What to keep with the cycle just taken; empty for most."""
        if self.state.cycles % CHECKPOINT_EVERY:
            return {}
        return {**self.state.arrays(), "tracker_time_s": np.array(self.state.tracker.time_s)}

    def catch_up(self, history: History) -> None:
        """Take the kept cycles of this reference again, from the last kept state on."""
        waiting = []
        for entry in history.list(LOOK_BACK):
            if entry.kind != THERMAL:
                continue
            if history.model(entry.id).get("reference_stamp_ns") != self._reference.data.middle_ns:
                continue
            arrays = history.inputs(entry.id)
            if "q" not in arrays:  # brought into force by a replay, not measured here
                continue
            moved = entry.reason if entry.code is Code.SENSOR_OR_ROBOT_MOVED else ""
            if STATE[0] in arrays:
                time_s = float(arrays["tracker_time_s"])
                self.go_on_from(FollowerState.of_arrays(arrays, time_s, moved))
                break
            waiting.append((arrays, moved))
        for arrays, moved in reversed(waiting):
            self._take_again(Measurements.of_arrays(arrays), moved)

    def forecast(self, in_force: SerialArm) -> AccuracyForecast:
        """What to expect of a model in force."""
        if self._forecast is None or self._forecast[0] is not in_force:
            self._forecast = (in_force, AccuracyForecast(self._tracker, in_force))
        return self._forecast[1]

    def time_s(self, stamp_ns: int) -> float:
        """Time of the tracker's at a stamp; not before its last cycle."""
        ahead_ns = max(stamp_ns - self.state.stamp_ns, 0)
        return self.state.tracker.time_s + ahead_ns * 1e-9

    def _time_s(self, stamp_ns: int) -> float:
        """The same for a cycle; how long ago the last one was is not known after a jump back."""
        step_ns = stamp_ns - self.state.stamp_ns
        step_s = step_ns * 1e-9 if step_ns >= 0 else self._process.steady_s
        return self.state.tracker.time_s + step_s

    def _take_again(self, cycle: Measurements, moved: str) -> None:
        state, stamp_ns = self.state, cycle.middle_ns
        if not moved:
            averaged = self._tracker.spots.average(cycle, self._sigma_m)
            self._tracker.take(averaged, self._time_s(stamp_ns))
        self.state = FollowerState(
            tracker=self._tracker.state,
            stamp_ns=state.stamp_ns if moved else stamp_ns,
            cycles=state.cycles + 1,
            moved=moved,
        )


def _text(array: NDArray[Any]) -> str:
    return base64.b64encode(np.ascontiguousarray(array, dtype="<f8").tobytes()).decode()


def _array(text: str) -> Array:
    return np.frombuffer(base64.b64decode(text), dtype="<f8").astype(np.float64)


class Following:
    """The follower of the cold reference in force, made anew where another one comes into force."""

    def __init__(self, history: History, current: InForce, prior: Array, sigma_m: float) -> None:
        self._history, self._current, self._prior = history, current, prior
        self._sigma_m = sigma_m
        self._followed: tuple[int | None, DriftFollower] | None = None

    @property
    def follower(self) -> DriftFollower | None:
        """None without a reference.

        Raises
        ------
        StorageError
            When the cycles kept so far cannot be read.
        """
        current = self._current
        if current.reference is None:
            return None
        if self._followed is None or self._followed[0] != current.reference_id:
            follower = DriftFollower(current.reference, self._prior, self._sigma_m)
            follower.catch_up(self._history)
            self._followed = (current.reference_id, follower)
        return self._followed[1]
