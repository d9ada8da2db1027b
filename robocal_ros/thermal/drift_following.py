"""The tracker of the cold reference in force: a function of it and of the cycles kept since.

So it survives a restart: the history holds each cycle's measurements, and every so often the
tracker's state, from which the later cycles are taken again.
"""

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code
from robocal_ros.ground.proposals import THERMAL, Entry
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.history import History
from robocal_ros.thermal.accuracy import AccuracyForecast, Work
from robocal_ros.thermal.follower_state import HEAT, STATE, TIMES, FollowerState
from robocal_ros.thermal.heat import Heat
from robocal_ros.thermal.in_force import InForce
from robocal_ros.thermal.priors import drift_prior
from robocal_ros.thermal.process import DriftProcess
from robocal_ros.thermal.process_documents import process_of
from robocal_ros.thermal.process_learning import LearnedProcess
from robocal_ros.thermal.reference import ColdReference
from robocal_ros.thermal.steps import FixedSphere
from robocal_ros.thermal.tracked_cycle import TrackedCycle, track_cycle

Array = NDArray[np.float64]

CHECKPOINT_EVERY = 32  # cycles between two kept states: a restart takes at most so many again
LOOK_BACK = 100
EXPECTED = "expected"  # of a reference's model: the learned process, None for the default


class DriftFollower:
    """Takes cycles in the order in which they are kept.

    Parameters
    ----------
    expected : how the robot is expected to drift; with temperatures where the reference has them.
    work : where the forecast is asked for.
    """

    def __init__(self, reference: ColdReference, expected: LearnedProcess, work: Work) -> None:
        if reference.temperature is None:  # what the motors' warmth is against is not known
            expected = replace(expected, gains=None)
        self._tracker = expected.tracker(reference.spots)
        self._reference, self._work = reference, work
        self._forecast: tuple[SerialArm, AccuracyForecast] | None = None
        cold_ns = reference.data.middle_ns
        self.read_ns = cold_ns
        self.state = FollowerState(
            self._tracker.state, self._tracker.heat, cold_ns, 0, anchor_ns=cold_ns
        )

    def take(
        self, cycle: Measurements, in_force: SerialArm, fixed: FixedSphere | None
    ) -> TrackedCycle:
        """Take a cycle, or refuse it as moved.

        Raises
        ------
        RobocalError
            When it cannot answer; then nothing has changed.
        """
        stamp_ns, state = cycle.middle_ns, self.state
        found = track_cycle(
            self._tracker,
            cycle,
            self.time_s(stamp_ns),
            in_force=in_force,
            fixed=fixed,
            doubt_s=state.moved_s,
        )
        refused = found.judged.verdict.code is Code.SENSOR_OR_ROBOT_MOVED
        self._count(stamp_ns, found.judged.verdict.reason if refused else "")
        return found

    def _count(self, stamp_ns: int, moved: str) -> None:
        """Go on after a cycle that was taken, or refused because something moved."""
        state, time_s = self.state, self.time_s(stamp_ns)
        self.state = FollowerState(
            tracker=self._tracker.state,
            heat=self._tracker.heat,
            stamp_ns=state.stamp_ns if moved else stamp_ns,
            cycles=state.cycles + 1,
            anchor_ns=state.anchor_ns if moved else stamp_ns,
            moved=moved,
            moved_s=(time_s if state.moved_s is None else state.moved_s) if moved else None,
        )

    def clock_jumped(self, stamp_ns: int) -> None:
        """Go on at a stamp of another clock; how long it was since the last cycle is not known."""
        unknown_ns = round(self._tracker.process.steady_s * 1e9)
        self.state = replace(self.state, anchor_ns=stamp_ns - unknown_ns)
        self.read_ns = stamp_ns - unknown_ns

    def expected_drift(self) -> Array:
        """Covariance (k, k), SI, of the drift that a shift may bring."""
        return self._tracker.expected_drift()

    def read(self, temperatures: Sequence[tuple[int, Array]]) -> None:
        """Take motor temperatures (n,), degrees Celsius, that are newer than the last ones."""
        tracker, cold = self._tracker, self._reference.temperature
        if tracker.heat is None or cold is None:
            return
        for stamp_ns, temperature in temperatures:
            time_s = self._anchored_s(stamp_ns)
            if time_s > tracker.heat.time_s:
                tracker.read_temperatures(temperature - cold, time_s)
                self.read_ns = stamp_ns

    @contextmanager
    def looking_ahead(self, temperatures: Sequence[tuple[int, Array]]) -> Iterator[None]:
        """Within, the follower knows these temperatures too; then it forgets them again."""
        heat, read_ns = self._tracker.heat, self.read_ns
        try:
            self.read(temperatures)
            yield
        finally:
            self._tracker.heat, self.read_ns = heat, read_ns

    @contextmanager
    def attempt(self) -> Iterator[None]:
        """Undo what is taken within when it cannot be kept."""
        before, read_ns = self.state, self.read_ns
        try:
            yield
        except BaseException:
            self.go_on_from(before)
            self.read_ns = read_ns
            raise

    def go_on_from(self, state: FollowerState) -> None:
        """Go on from a state of a follower of the same reference."""
        self.state, self._tracker.state, self._tracker.heat = state, state.tracker, state.heat

    def kept(self, temperature: Array | None) -> dict[str, NDArray[Any]]:
        """What to keep beside the measurements of the cycle just taken.

        ``temperature`` (n,) of the motors, degrees Celsius, for those who learn from it.
        """
        state = self.state
        moved_s = np.nan if state.moved_s is None else state.moved_s
        kept = {TIMES: np.array([state.tracker.time_s, moved_s])}
        if temperature is not None:
            kept["motor_temperature"] = temperature
        if state.heat is not None:
            kept[HEAT] = state.heat.array()
        if state.cycles % CHECKPOINT_EVERY == 0:
            kept |= state.arrays()
        return kept

    def catch_up(self, history: History, reference_id: int) -> None:
        """Take the kept cycles of this reference again, from the last kept state on."""
        waiting = []
        for entry in self._kept(history, reference_id):
            arrays = history.inputs(entry.id)
            if TIMES not in arrays:  # brought into force by a replay, not measured here
                continue
            moved = entry.reason if entry.code is Code.SENSOR_OR_ROBOT_MOVED else ""
            if STATE[0] in arrays:
                time_s, moved_s = arrays[TIMES].tolist()
                times = time_s, None if np.isnan(moved_s) else moved_s
                self.go_on_from(FollowerState.of_arrays(arrays, times, moved))
                break
            waiting.append((arrays, moved))
        for arrays, moved in reversed(waiting):
            self._take_again(arrays, moved)

    def _kept(self, history: History, reference_id: int) -> Iterator[Entry]:
        """Cycles of this reference, newest first; all of them came after it."""
        cold_ns, limit, seen = self._reference.data.middle_ns, LOOK_BACK, 0
        while len(entries := history.list(limit)) > seen:
            for entry in entries[seen:]:
                if entry.id < reference_id:
                    return
                if entry.kind == THERMAL:
                    model = history.model(entry.id)
                    if model.get("reference_stamp_ns") == cold_ns:
                        yield entry
            seen, limit = len(entries), 4 * limit

    def forecast(self, in_force: SerialArm) -> AccuracyForecast:
        """What to expect of a model in force."""
        if self._forecast is None or self._forecast[0] is not in_force:
            self._forecast = (in_force, AccuracyForecast(self._tracker, in_force, self._work))
        return self._forecast[1]

    def time_s(self, stamp_ns: int) -> float:
        """Time of the tracker's at a stamp; one before its last cycle is of another clock."""
        time_s, last_s = self._anchored_s(stamp_ns), self.state.tracker.time_s
        return time_s if time_s >= last_s else last_s + self._tracker.process.steady_s

    def _anchored_s(self, stamp_ns: int) -> float:
        return self.state.tracker.time_s + 1e-9 * (stamp_ns - self.state.anchor_ns)

    def _take_again(self, arrays: Mapping[str, NDArray[Any]], moved: str) -> None:
        tracker, cycle = self._tracker, Measurements.of_arrays(arrays)
        if HEAT in arrays:
            tracker.heat = Heat.of_array(arrays[HEAT])
        time_s, moved_s = arrays[TIMES].tolist()
        if not moved:
            tracker.take(tracker.spots.average(cycle, tracker.sigma_m), time_s)
        self._count(cycle.middle_ns, moved)
        if moved:
            self.state = replace(self.state, moved_s=moved_s)


def default_process(nominal: SerialArm, sigma_m: float) -> LearnedProcess:
    """What to expect of a robot of which nothing is known; ``sigma_m`` of one visit."""
    return LearnedProcess(DriftProcess(drift_prior(nominal)), sigma_m)


class Following:
    """The follower of the cold reference in force, made anew where another one comes into force.

    ``sigma_m``: of one visit, where none was learned; ``work``: where the robot works.
    """

    def __init__(self, history: History, current: InForce, sigma_m: float, work: Work) -> None:
        self._history, self._current = history, current
        self._sigma_m, self._work = sigma_m, work
        self._followed: tuple[int | None, DriftFollower] | None = None

    @property
    def expected(self) -> LearnedProcess:
        """What the reference in force knows of the robot's drift; the default without one."""
        kept = (self._current.reference_model or {}).get(EXPECTED)
        if kept is not None:
            return process_of(kept)
        return default_process(self._current.nominal, self._sigma_m)

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
            follower = DriftFollower(current.reference, self.expected, self._work)
            follower.catch_up(self._history, current.reference_id or 0)
            self._followed = (current.reference_id, follower)
        return self._followed[1]
