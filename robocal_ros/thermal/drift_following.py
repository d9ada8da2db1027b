# SPDX-License-Identifier: Apache-2.0
"""Settings, what is in force, and the tracker of the cold reference in force.

The tracker is a function of the reference and of the cycles kept since, so it survives a restart:
the history holds each cycle's measurements, and every so often the tracker's state, from which
the later cycles are taken again.
"""

import base64
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground.errors import Code, ConflictError, InputError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import DEFAULT_TARGET, Measurements, StandstillRule
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import REFERENCE, THERMAL, Entry
from robocal_ros.identification import Method
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import HistoryFollower
from robocal_ros.thermal.accuracy import AccuracyForecast, LearnedProcess, Work, process_of
from robocal_ros.thermal.identification import FixedSphere, drift_prior
from robocal_ros.thermal.reference import ColdReference, commissioned_of, holds_drift, reference_of
from robocal_ros.thermal.tracking import (
    APPROACH_S,
    DriftProcess,
    DriftState,
    Heat,
    TrackedCycle,
    track_cycle,
)

Prior = Literal["default", "learned"]
Arrangement = Literal["fixed-sensor", "flange-sensor"]
FIXED: Arrangement = "fixed-sensor"
FLANGE: Arrangement = "flange-sensor"
ARRANGEMENTS = FIXED, FLANGE
METHODS: tuple[Method, ...] = ("map", "lsq")
PRIORS: tuple[Prior, ...] = ("default", "learned")
SPHERE_RADIUS_M = 0.01905  # 1.5 inches across, the usual reference sphere
HEAT = "tracker_heat"
TIMES = "tracker_times"  # of a kept cycle: the tracker's, and that of the first refused one
STATE = ("tracker_mean", "tracker_covariance", "tracker_clock")
CHECKPOINT_EVERY = 32  # cycles between two kept states: a restart takes at most so many again
LOOK_BACK = 100
EXPECTED = "expected"  # of a reference's model: the learned process, None for the default


@dataclass(frozen=True)
class ThermalConfig:
    """Settings of a thermal session.

    ``arrangement``: a fixed sensor sees targets on the flange, or a sensor on the flange spheres
    that are fixed in the cell. ``method``: estimator where a command names none. ``prior``:
    ``default``, or ``learned`` from the shifts in the history. ``sigma_m``: standard deviation of
    one measured coordinate in one visit of a pose. ``drift_parameters``: what ``lsq`` solves of a
    drift; empty: all, which takes many poses. ``hold_out``, ``seed``: share of the poses kept to
    judge a calibration without reference. ``cycle_timeout_s``: a cycle ends when nothing was
    measured for so long, or its first measurement is ``cycle_span_s`` old: what belongs to a cycle
    counts as measured in its middle. ``tolerance_m``, ``expires_after_s``: error that the process
    allows, and age at which a measurement says nothing any more. ``work_poses``, ``tip_m``: where
    accuracy is judged: joints of the working poses, rad (prismatic: m), and the tool's tip on the
    flange; empty: throughout the joint limits, and the target. ``lateness_s``: a command waits for
    joint readings this much newer, so that measurements under way still count.
    ``measuring_frame``: frame of the measurements; empty: that of the first one used. ``target``:
    name of the target where the measurement's frame_id gives none. ``sphere``: what a sphere in a
    cloud must be like.
    """

    method: Method = "map"
    prior: Prior = "default"
    sigma_m: float = 3e-5
    drift_parameters: tuple[str, ...] = ()
    hold_out: float = 0.5
    seed: int = 0
    cycle_timeout_s: float = 660.0
    cycle_span_s: float = APPROACH_S
    tolerance_m: float = 3e-4
    expires_after_s: float = 8.0 * 3600.0
    work_poses: tuple[tuple[float, ...], ...] = ()
    tip_m: tuple[float, ...] = ()
    lateness_s: float = 0.2
    measuring_frame: str = ""
    target: str = DEFAULT_TARGET
    standstill: StandstillRule = field(default_factory=StandstillRule)
    sphere: SphereRule = field(default_factory=lambda: SphereRule(SPHERE_RADIUS_M))
    arrangement: Arrangement = FIXED

    @cached_property
    def work(self) -> Work:
        """Where accuracy is judged."""
        q, tip = (np.array(given) if given else None for given in (self.work_poses, self.tip_m))
        return Work(q, tip)


@dataclass(frozen=True, eq=False)
class FollowerState:
    """Where a follower stands.

    ``tracker``: state of the tracker; its time counts from the cold visit. ``heat``: motor
    temperatures as last read, where they are in use. ``anchor_ns``: stamp that the tracker's time
    is at; that of the last cycle until the clock jumps. ``stamp_ns``: of the last cycle that was
    taken, of the cold visit before the first. ``cycles``: kept since the cold visit, refused ones
    among them. ``moved``, ``moved_s``: why the last cycle was refused, empty where it was not; and
    the tracker's time of the first of those that were refused in a row.
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

        Raises `InputError` when it is no such document.
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


class InForce(HistoryFollower):
    """The thermal model (``head``) and the cold reference in force, as of the last look.

    ``reference``, ``reference_id``, ``reference_model``: the cold reference, its calibration, and
    what is kept of it; or None. ``reference_revision``: its, counted up where it goes too.
    ``config``: of the session.
    """

    def __init__(
        self, history: CalibrationHistory, nominal: SerialArm, config: ThermalConfig
    ) -> None:
        self.config = config
        self._followed: tuple[int | None, DriftFollower] | None = None
        super().__init__(history, THERMAL, nominal)

    def _read(self) -> None:
        super()._read()
        head = self.history.head(REFERENCE)
        reference = None if head.model is None else reference_of(head.model, self.nominal)
        self.reference: ColdReference | None = reference
        self.reference_id, self.reference_model = head.calibration_id, head.model
        self.reference_revision = head.revision

    @property
    def drifted(self) -> bool:
        """Whether the model in force holds a drift since a cold reference."""
        return holds_drift(self.head.model)

    @property
    def commissioned(self) -> SerialArm:
        """The arm without any drift: what is in force while none is, else what the reference keeps.

        Raises `ConflictError` when a drift is in force and no cold reference.
        """
        if not self.drifted:
            return self.arm
        if self.reference_model is None:
            raise ConflictError(
                "the model in force holds a drift, but there is no cold reference any more: roll "
                "the thermal model back to the one without it"
            )
        return commissioned_of(self.reference_model, self.nominal)

    @property
    def expected(self) -> LearnedProcess:
        """What the reference in force knows of the robot's drift; the default without one."""
        kept = (self.reference_model or {}).get(EXPECTED)
        if kept is not None:
            return process_of(kept)
        return default_process(self.nominal, self.config.sigma_m)

    @property
    def follower(self) -> "DriftFollower | None":
        """Of the drift since the reference, made anew for another one; None without a reference."""
        if self.reference is None:
            return None
        if self._followed is None or self._followed[0] != self.reference_id:
            follower = DriftFollower(self.reference, self.expected, self.config.work)
            follower.catch_up(self.history, self.reference_id or 0)
            self._followed = (self.reference_id, follower)
        return self._followed[1]


class DriftFollower:
    """Takes cycles in the order in which they are kept.

    ``expected``: how the robot is expected to drift; with temperatures where the reference has
    them. ``work``: where the forecast is asked for.
    """

    def __init__(self, reference: ColdReference, expected: LearnedProcess, work: Work) -> None:
        if reference.temperature is None and expected.gains is not None:
            # What the motors' warmth is against is not known: all that it may bring is expected.
            whole = expected.tracker(reference.spots).expected_drift()
            process = replace(expected.process, covariance=whole)
            expected = replace(expected, process=process, gains=None)
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

        Raises `RobocalError` when it cannot answer; then nothing has changed.
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

    def clock_jumped(self, left_ns: int, stamp_ns: int) -> None:
        """Go on at a stamp of another clock, after the last one of the clock before.

        How long it was since the last cycle is not known; no less than it was before.
        """
        unknown_ns = max(
            round(self._tracker.process.steady_s * 1e9), left_ns - self.state.anchor_ns
        )
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

    def unread(self, silent: Sequence[str]) -> str:
        """What to say of joints of whose motors no temperature comes; empty where none is asked."""
        if self.state.heat is None or not silent:
            return ""
        return f"no temperature of {', '.join(silent)}: see what sends motor_temperatures"

    @contextmanager
    def looking_ahead(
        self, between: Callable[[int, int], Sequence[tuple[int, Array]]], until_ns: int
    ) -> Iterator[None]:
        """Within, the follower knows the temperatures ``between`` its last ones and a stamp too.

        Then it forgets them again; without gains nobody asks for them.
        """
        heat, read_ns = self._tracker.heat, self.read_ns
        try:
            if heat is not None:
                self.read(between(read_ns, until_ns))
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

    def catch_up(self, history: CalibrationHistory, reference_id: int) -> None:
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
        tracker = self._tracker
        for arrays, moved in reversed(waiting):
            cycle = Measurements.of_arrays(arrays)
            if HEAT in arrays:
                tracker.heat = Heat.of_array(arrays[HEAT])
            time_s, moved_s = arrays[TIMES].tolist()
            if not moved:
                tracker.take(tracker.spots.average(cycle, tracker.sigma_m), time_s)
            self._count(cycle.middle_ns, moved)
            if moved:
                self.state = replace(self.state, moved_s=moved_s)

    def _kept(self, history: CalibrationHistory, reference_id: int) -> Iterator[Entry]:
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

    def forecast_at(self, in_force: SerialArm, q: Array, tip: Array) -> AccuracyForecast:
        """The same at joints (n,), of a point (3,) of the flange, m."""
        return AccuracyForecast(self._tracker, in_force, Work(q[None], tip))

    def time_s(self, stamp_ns: int) -> float:
        """Time of the tracker's at a stamp; one before its last cycle is of another clock."""
        time_s, last_s = self._anchored_s(stamp_ns), self.state.tracker.time_s
        return time_s if time_s >= last_s else last_s + self._tracker.process.steady_s

    def _anchored_s(self, stamp_ns: int) -> float:
        return self.state.tracker.time_s + 1e-9 * (stamp_ns - self.state.anchor_ns)


def default_process(nominal: SerialArm, sigma_m: float) -> LearnedProcess:
    """What to expect of a robot of which nothing is known; ``sigma_m`` of one visit."""
    return LearnedProcess(DriftProcess(drift_prior(nominal)), sigma_m)
