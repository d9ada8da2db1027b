# SPDX-License-Identifier: Apache-2.0
"""What drift to expect of a robot, learned from its cycles; how far the tool may be off by now."""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground.errors import Code, InputError, RobocalError, TooFewSamplesError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Measurements
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import REFERENCE, THERMAL, CalibrationState, Entry
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import random_postures
from robocal_ros.kinematics.robots import Fields, read_made, write_made
from robocal_ros.thermal.identification import drift_prior, identify_cycle, learned_prior
from robocal_ros.thermal.reference import ColdSpots, reference_of
from robocal_ros.thermal.tracking import DriftProcess, DriftTracker, HeatGains

FEWEST_CYCLES = 10


def learn_drift(
    histories: Sequence[tuple[ColdSpots, Sequence[Measurements]]], *, sigma_m: float
) -> Array:
    """Covariance (k, k), SI, of the free parameters' drift since the cold visit, from earlier ones.

    ``histories``: cold visits and the cycles that followed each, all of one robot.
    Each cycle is identified with the default prior; `learned_prior` weighs what the
    cycles show against it. What no cycle can show keeps its default.

    Raises `InputError` when a cycle does not belong to its cold visit; `TooFewSamplesError` with
    fewer than ten cycles.
    """
    total = sum(len(cycles) for _, cycles in histories)
    if total < FEWEST_CYCLES:
        raise TooFewSamplesError(
            f"{total} cycles show too little of what drift to expect: at least {FEWEST_CYCLES}"
        )
    default = drift_prior(histories[0][0].cell.arm)
    found = [
        identify_cycle(spots, cycle, prior_covariance=default, sigma_m=sigma_m)
        for spots, cycles in histories
        for cycle in cycles
    ]
    drifts = np.array([one.drift for one in found])
    covariances = np.array([one.covariance for one in found])
    return learned_prior(default, drifts, covariances)


# Widths are chosen where earlier cycles are most likely, each shift judged by what the others
# teach; of what is to be tracked nothing is used.
SCALES = tuple(2.0**-i for i in range(6))
APPROACH_S = (1800.0, 2400.0, 3600.0)
WORK_TIME_S = 7200.0  # within which work, and so the steady state, is taken to change
LAGS_S = (1800.0, 3600.0, 7200.0)
THINNED = 5  # cycles of one shift resemble each other: every fifth tells how large drifts are,
SUCCESSIVE = 2  # and every second how they go on,
JUDGING_POSES = 7  # by so many of its poses, or a few more
LEFT_OVER = (1e-2, 1e-3, 1e-4, 1e-5)  # share of the default prior's variance that gains leave
MEDIAN_SQUARE = 2.3659739  # of three standard normal numbers
OUTLYING = 5.0  # standard deviations


@dataclass(frozen=True, eq=False)
class EarlierShift:
    """A cold visit and the t cycles that followed it.

    ``time_s`` (t,): of each cycle, since the cold visit. ``temperature`` (t, n): motors at each
    cycle above those at the cold visit, K; None where they were not read.
    """

    spots: ColdSpots
    cycles: Sequence[Measurements]
    time_s: Array
    temperature: Array | None = None


@dataclass(frozen=True, eq=False)
class LearnedProcess:
    """What a tracker needs.

    ``process``, ``sigma_m``: of the drift, and of one coordinate of one visit.
    ``gains``: of the motors' temperatures; None: track without them.
    """

    process: DriftProcess
    sigma_m: float
    gains: HeatGains | None = None

    def tracker(self, spots: ColdSpots) -> DriftTracker:
        """Start a tracker at a cold visit, from which its time counts."""
        return DriftTracker(spots, self.process, self.sigma_m, self.gains)


def visit_noise(shifts: Sequence[EarlierShift]) -> float:
    """Standard deviation, m, of one coordinate of one visit.

    From second differences over three cycles in a row, in which a drift all but cancels (Gasser,
    Sroka and Jennen-Steinmetz 1986), without points far beyond the median: outliers.

    Raises `TooFewSamplesError` with fewer than ten cycles that visit the same poses as the cold
    visit.
    """
    found = [np.empty(0)]
    for shift in shifts:
        whole = [
            (time, shift.spots.drift(cycle)[np.argsort(shift.spots.match(cycle))])
            for time, cycle in zip(shift.time_s.tolist(), shift.cycles, strict=True)
            if len(cycle) == len(shift.spots.visits)
        ]
        if len(whole) < FEWEST_CYCLES:
            continue
        y = np.array([drift for _, drift in whole])
        time = np.array([at for at, _ in whole])
        share = ((time[1:-1] - time[:-2]) / (time[2:] - time[:-2]))[:, None, None]
        miss = y[1:-1] - (1.0 - share) * y[:-2] - share * y[2:]
        miss /= np.sqrt(1.0 + share**2 + (1.0 - share) ** 2)
        found.append(np.sum(miss**2, axis=2).ravel())
    squares = np.concatenate(found)
    if not len(squares):
        raise TooFewSamplesError(
            f"no shift has {FEWEST_CYCLES} cycles that visit all its cold poses: the noise of a "
            "visit does not show"
        )
    likely = squares <= OUTLYING**2 * np.median(squares) / MEDIAN_SQUARE
    return float(np.sqrt(np.mean(squares[likely]) / 3.0))


def learn_process(shifts: Sequence[EarlierShift]) -> LearnedProcess:
    """Learn to track without temperatures.

    The covariance is ``learn_drift``'s; its size, and the time of approach, are those with which
    each shift is most likely under what the others teach (one shift alone judges itself).
    """
    sigma_m = visit_noise(shifts)

    def covariance(of: Sequence[EarlierShift]) -> Array:
        every = max(1, min(THINNED, sum(len(s.cycles) for s in of) // FEWEST_CYCLES))
        histories = [(shift.spots, shift.cycles[::every]) for shift in of]
        return learn_drift(histories, sigma_m=sigma_m)

    pairs = [
        (covariance([s for s in shifts if s is not judged] or [judged]), _fewer(judged))
        for judged in shifts
    ]

    def likely(scale: float, approach_s: float) -> float:
        total = 0.0
        for learned, judged in pairs:
            process = DriftProcess(scale * learned, approach_s, WORK_TIME_S)
            total += _follow(LearnedProcess(process, sigma_m), judged, SUCCESSIVE)[1]
        return total

    approach_s = max(APPROACH_S, key=lambda x: likely(SCALES[2], x))
    scale = _first_peak(lambda x: likely(x, approach_s), SCALES)
    process = DriftProcess(scale * covariance(shifts), approach_s, WORK_TIME_S)
    return LearnedProcess(process, sigma_m)


def learn_gains(shifts: Sequence[EarlierShift]) -> LearnedProcess:
    """Learn to track with temperatures: gains, and the process of what they leave.

    The gains pass from shift to shift with their covariance, as the tracker updates them. Their
    expected size (lengths, angles) and the process are those that make the shifts most likely.

    Raises `InputError` when a shift has no temperatures, or a cycle does not belong to its cold
    visit; `TooFewSamplesError` with fewer than ten cycles.
    """
    if any(shift.temperature is None for shift in shifts):
        raise InputError("a shift without motor temperatures teaches no gains: leave it out")
    sigma_m, arm = visit_noise(shifts), shifts[0].spots.cell.arm

    def start(left: float, lag_s: float, length: float, angle: float) -> LearnedProcess:
        gains = HeatGains.expected(arm, lag_s, length, angle)
        process = DriftProcess(left * drift_prior(arm))
        return LearnedProcess(process, sigma_m, gains)

    def likely(*settings: float) -> float:
        return _pass(start(*settings), shifts, THINNED)[1]

    left, lag_s = LEFT_OVER[1], LAGS_S[1]
    angle = _first_peak(lambda x: likely(left, lag_s, 1.0, x), SCALES)
    length = _first_peak(lambda x: likely(left, lag_s, x, angle), SCALES)
    lag_s = max(LAGS_S, key=lambda x: likely(left, x, length, angle))
    left = _first_peak(lambda x: likely(x, lag_s, length, angle), LEFT_OVER)
    return _pass(start(left, lag_s, length, angle), shifts, 1)[0]


def _fewer(shift: EarlierShift) -> EarlierShift:
    """The shift by a part of its poses: quicker, and no less telling of time."""
    spots = shift.spots
    every = max(1, len(spots.visits) // JUDGING_POSES)
    kept = np.arange(0, len(spots.visits), every)
    few = replace(
        spots, q=spots.q[kept], target=spots.target[kept], error=spots.error[kept],
        visits=spots.visits[kept],
    )  # fmt: skip
    cycles = [cycle.take(np.isin(spots.match(cycle), kept)) for cycle in shift.cycles]
    return replace(shift, spots=few, cycles=cycles)


def _pass(
    learned: LearnedProcess, shifts: Sequence[EarlierShift], every: int
) -> tuple[LearnedProcess, float]:
    """The gains after shift upon shift, and the log-likelihood of all."""
    total = 0.0
    for shift in shifts:
        tracker, log_likelihood = _follow(learned, shift, every)
        learned, total = replace(learned, gains=tracker.gains), total + log_likelihood
    return learned, total


def _follow(learned: LearnedProcess, shift: EarlierShift, every: int) -> tuple[DriftTracker, float]:
    """Track a shift by some of its cycles; and how likely those are, as a logarithm."""
    tracker, total = learned.tracker(shift.spots), 0.0
    for i, (cycle, time_s) in enumerate(zip(shift.cycles, shift.time_s.tolist(), strict=True)):
        if learned.gains is not None and shift.temperature is not None:
            tracker.read_temperatures(shift.temperature[i], time_s)
        if i % every == 0 and len(cycle):  # of some of its poses a cycle may have visited none
            total += tracker.take(cycle, time_s).log_likelihood
    return tracker, total


def _first_peak(likely: Callable[[float], float], candidates: Sequence[float]) -> float:
    """The candidate after which it gets no more likely."""
    best, peak = candidates[0], likely(candidates[0])
    for candidate in candidates[1:]:
        value = likely(candidate)
        if value <= peak:
            break
        best, peak = candidate, value
    return best


def process_document(learned: LearnedProcess) -> dict[str, Any]:
    """A learned (or default) process; SI."""
    process, gains = learned.process, learned.gains
    return {
        "covariance": process.covariance.tolist(),
        "approach_s": process.approach_s,
        "steady_s": process.steady_s,
        "sigma_m": learned.sigma_m,
        "gains": None
        if gains is None
        else {
            "mean": gains.mean.tolist(),
            "covariance": gains.covariance.tolist(),
            "lag_s": gains.lag_s,
        },
    }


def process_of(document: Mapping[str, Any]) -> LearnedProcess:
    """Read it back."""
    gains = document["gains"]
    return LearnedProcess(
        DriftProcess(
            np.array(document["covariance"]),
            approach_s=float(document["approach_s"]),
            steady_s=float(document["steady_s"]),
        ),
        float(document["sigma_m"]),
        None
        if gains is None
        else HeatGains(
            np.array(gains["mean"]), np.array(gains["covariance"]), float(gains["lag_s"])
        ),
    )


LEARN_FROM = 2000
MOST_SHIFTS = 5  # the newest; learning takes half a second each
FEWEST_WITH_TEMPERATURES = 2  # shifts, so that what one motor does is not what all of them do
WRONG = (CalibrationState.REJECTED, CalibrationState.ROLLED_BACK)  # somebody did not believe it


def expected_drift(
    nominal: SerialArm, history: CalibrationHistory
) -> tuple[LearnedProcess | None, str]:
    """What every cold reference in the history with its cycles teaches, and the same in words.

    With the motors' temperatures where all cycles have them. None: too little.
    """
    shifts = earlier_shifts(nominal, history)
    warm = [shift for shift in shifts if shift.temperature is not None]
    if len(warm) >= FEWEST_WITH_TEMPERATURES:
        with suppress(RobocalError, np.linalg.LinAlgError):  # then without temperatures
            return learn_gains(warm), f"learned with temperatures from {len(warm)} shifts"
    try:
        return learn_process(shifts), f"learned from {len(shifts)} shifts"
    except (RobocalError, np.linalg.LinAlgError) as error:
        return None, f"default, because {error}"


def earlier_shifts(nominal: SerialArm, history: CalibrationHistory) -> list[EarlierShift]:
    """Every cold reference of the history with its cycles, those apart that nobody believed."""
    entries = history.list(LEARN_FROM)
    cycles: dict[int, list[Entry]] = defaultdict(list)
    for entry in entries:
        sound = entry.state not in WRONG and entry.code is not Code.SENSOR_OR_ROBOT_MOVED
        if entry.kind == THERMAL and sound:
            cycles[int(history.model(entry.id).get("reference_stamp_ns", 0))].append(entry)
    shifts: list[EarlierShift] = []
    for entry in entries:
        if entry.kind != REFERENCE or len(shifts) == MOST_SHIFTS:
            continue
        reference = reference_of(history.model(entry.id), nominal)
        cold_ns = reference.data.middle_ns
        arrays = [history.inputs(e.id) for e in cycles[cold_ns]]
        arrays = [a for a in arrays if "q" in a and "stamp_ns" in a]
        data = [Measurements.of_arrays(a) for a in arrays]
        order = np.argsort([d.middle_ns for d in data], kind="stable").tolist()
        times = [1e-9 * (data[i].middle_ns - cold_ns) for i in order]
        if not order or times[0] <= 0.0 or np.any(np.diff(times) <= 0.0):
            continue  # the clock jumped within it
        cold = reference.temperature
        known = cold is not None and all("motor_temperature" in a for a in arrays)
        rise = [arrays[i]["motor_temperature"] - cold for i in order] if known else None
        shifts.append(
            EarlierShift(
                reference.spots,
                [data[i] for i in order],
                np.array(times),
                None if rise is None else np.array(rise),
            )
        )
    return shifts[::-1]


KEYS = ("robot", "model_hash", "parameters", "covariance", "cycles")
SYMMETRY = 1e-9  # of the largest element


def write_prior(path: Path, document: Mapping[str, Any]) -> None:
    """Write the parts of a learned prior's document that an estimator needs."""
    write_made(path, document, KEYS, "thermal learn-prior")


def read_prior(path: Path, arm: SerialArm) -> Array:
    """Covariance (k, k), SI, of the expected drift of ``arm``'s free parameters.

    Raises `InputError`, naming file and key, when it is not as docs/thermal.md says;
    `WrongRobotError` when it was learned for another nominal model.
    """
    file, top = str(path), read_made(path, arm, KEYS, "prior file", "learn it")
    if top.values.get("parameters") != list(arm.parameters.names):
        raise InputError(
            f"parameters must be {', '.join(arm.parameters.names)}, in this order", file=file
        )
    rows = top.values.get("covariance")
    count = len(arm.parameters)
    if not isinstance(rows, list) or len(rows) != count:
        raise InputError(f"covariance must be {count} rows", file=file)
    table = Fields({f"row {i + 1}": row for i, row in enumerate(rows)}, file, "covariance")
    covariance = np.array([table.numbers(f"row {i + 1}", count) for i in range(count)])
    if np.abs(covariance - covariance.T).max() > SYMMETRY * np.abs(covariance).max():
        raise InputError("covariance is not symmetric", file=file)
    if np.linalg.eigvalsh(covariance)[0] <= 0.0:
        raise InputError("covariance is not positive: some combination has no spread", file=file)
    return np.asarray(0.5 * (covariance + covariance.T))


# ---- how far the tool may be off by now ---------------------------------------------------------

HORIZON_S = 24.0 * 3600.0
STEPS = 2**17
FIRST_STEPS = 2**8  # looked ahead at first: under three minutes
STEP_S = HORIZON_S / STEPS  # to which the time that is left is found


class AccuracyLevel(IntEnum):
    """Numbers of ``AccuracyState.msg``; 0 is never sent."""

    OK = 1
    DUE = 2
    DEGRADED = 3
    EXPIRED = 4
    FAULT = 5


@dataclass(frozen=True, eq=False)
class Work:
    """Where the tool is to be accurate.

    ``q`` (m, n): working poses, rad (prismatic: m); None: throughout the joint limits.
    ``tip`` (3,): of the tool, flange, m; None: the first measured target.
    """

    q: Array | None = None
    tip: Array | None = None

    def rows(self, spots: ColdSpots) -> Array:
        """Displacement (m, 3, k) of the tip by the arm's parameters, base."""
        arm = spots.cell.arm
        q = random_postures(arm) if self.q is None else self.q
        tip = spots.cell.T_flange_target[0, :3, 3] if self.tip is None else self.tip
        return arm.parameter_jacobian(q, tip)[:, :3]


@dataclass(frozen=True)
class ToolError:
    """Expected error of the tool at all poses of the work, m.

    ``rms_m``: root mean square length. ``bound_m``: 95 % of the errors are shorter.
    """

    rms_m: float
    bound_m: float

    @classmethod
    def of_square(cls, mean: float, variance: float) -> "ToolError":
        """From mean, m^2, and variance of the squared length.

        It is taken for a scaled chi-square of these two moments (Satterthwaite 1946).
        """
        rms_m = float(np.sqrt(mean))
        if variance <= 1e-12 * mean**2:  # a fixed length
            return cls(rms_m, rms_m)
        scale, freedom = variance / (2.0 * mean), 2.0 * mean**2 / variance
        return cls(rms_m, float(np.sqrt(scale * chi2_quantile(0.95, freedom))))


class AccuracyForecast:
    """Expected error of a model in force, from what the tracker knows.

    ``in_force``: an arm of the cold model's type. ``work``: where the error is asked for.
    """

    def __init__(self, tracker: DriftTracker, in_force: SerialArm, work: Work) -> None:
        cold = tracker.spots.cell.arm
        self._tracker, self._work = tracker, work
        self._in_force = cold.parameters.read(in_force.mdh - cold.mdh)
        self._exceeded_s = 0.0  # when the bound exceeds the tolerance, as it was found last

    @cached_property
    def _rows(self) -> Array:
        return self._work.rows(self._tracker.spots)

    def drift_at(self, time_s: float) -> tuple[Array, Array]:
        """Expected drift (k,) since the cold visit and its covariance (k, k), SI."""
        return self._tracker.drift(time_s)

    def at(self, time_s: float) -> ToolError:
        """Expected error at a time of the tracker's.

        At one posture the squared length of a Gaussian error of mean m and covariance C has mean
        m'm + tr C and variance 4 m'Cm + 2 tr C^2; `ToolError.of_square` takes both over all
        postures. The scatter of one visit belongs to it, as large as that of a measured one.
        """
        drift, covariance = self.drift_at(time_s)
        rows = self._rows
        miss = rows @ (drift - self._in_force)
        C = rows @ covariance @ rows.transpose(0, 2, 1) + self._tracker.sigma_m**2 * np.eye(3)
        mean = np.einsum("pi,pi->p", miss, miss) + np.trace(C, axis1=1, axis2=2)
        variance = 4.0 * np.einsum("pi,pij,pj->p", miss, C, miss)
        variance += 2.0 * np.einsum("pij,pij->p", C, C)
        all_mean = float(mean.mean())
        all_variance = float(np.mean(variance + mean**2)) - all_mean**2
        return ToolError.of_square(all_mean, all_variance)

    def due_in_s(self, time_s: float, tolerance_m: float) -> float:
        """Time from ``time_s`` until the bound exceeds a tolerance: zero where it does already.

        At most a day, which stands for longer.
        """

        def exceeds(step: int) -> bool:
            return self.at(time_s + step * STEP_S).bound_m > tolerance_m

        early, late = 0, FIRST_STEPS
        if exceeds(early):
            return 0.0
        while not exceeds(late):  # twice as far: within a day a drift comes and is forgotten again
            if late == STEPS:
                return HORIZON_S
            early, late = late, 2 * late
        near, reach = int((self._exceeded_s - time_s) / STEP_S), 1
        while late - early > 1:  # about where it was found last, else by halves
            middle = near if early < near < late else (early + late) // 2
            if exceeds(middle):
                late, near = middle, middle - reach
            else:
                early, near = middle, middle + reach
            reach *= 4
        self._exceeded_s = time_s + late * STEP_S
        return early * STEP_S


MOST_FREEDOM = 1e6  # more of it: as good as a fixed length
HALVINGS = 60


def offset_error(offset_m: float, sigma_m: float) -> ToolError:
    """Of a tip found so far away, with this standard deviation in each axis.

    Mean and variance of the squared length as in `AccuracyForecast.at`.
    """
    mean = offset_m**2 + 3.0 * sigma_m**2
    return ToolError.of_square(mean, 4.0 * offset_m**2 * sigma_m**2 + 6.0 * sigma_m**4)


def both_errors(drift: ToolError, tool: ToolError) -> ToolError:
    """Of both together, taken as independent: other sensors tell them, in other measurements.

    Their mean squares add. So do the variances of their squared lengths, with that of twice their
    product: as large as if both lay on one line, this way or that. An error that is wholly in both,
    on one line, stays below the bound in 83 % of cases.
    """
    (one, its), (other, others) = _square(drift), _square(tool)
    both = ToolError.of_square(one + other, its + others + 4.0 * one * other)
    return ToolError(float(np.hypot(drift.rms_m, tool.rms_m)), both.bound_m)


def _square(error: ToolError) -> tuple[float, float]:
    """Mean and variance of the squared length, of a scaled chi-square with the same bound.

    One degree of freedom at least: the squared length of a Gaussian error has no fewer.
    """
    if error.bound_m == 0.0:
        return 0.0, 0.0
    if error.rms_m == 0.0:
        return error.bound_m**2, 0.0
    ratio = error.bound_m / error.rms_m
    wanted = ratio * ratio  # infinite where ** would raise
    few, many = 0.0, float(np.log(MOST_FREEDOM))
    if wanted <= _over_mean(np.exp(many)):
        return error.bound_m**2, 0.0
    for _ in range(HALVINGS):
        middle = 0.5 * (few + many)
        few, many = (middle, many) if _over_mean(np.exp(middle)) > wanted else (few, middle)
    freedom = float(np.exp(many))
    mean = error.bound_m**2 / _over_mean(freedom)
    return mean, 2.0 * mean**2 / freedom


def _over_mean(freedom: float) -> float:
    """95 % quantile of a chi-square over its mean; falls with the degrees of freedom."""
    return chi2_quantile(0.95, freedom) / freedom


@dataclass(frozen=True)
class Accuracy:
    """What the line reads.

    ``error``: expected error of the tool; None where it is not known.
    ``due_in_s``: time until a measurement is due; negative when overdue, 0 where nothing is known.
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
