# SPDX-License-Identifier: Apache-2.0
"""The tracker on simulated shifts: between cycles, and whether its bounds and innovations are true.

Each robot has worked four earlier shifts, measured in twenty poses; of them everything is learned.
The shift that is judged comes after them and is measured in six.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bench.measured_shifts import DriftingCell, DriftPlan, DriftRecord, record
from bench.tables import Goal, Table
from bench.thermal_shifts import MEASURING, PARTS, SEEDS, Measured, cell_of
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.accuracy import (
    EarlierShift,
    LearnedProcess,
    learn_drift,
    learn_gains,
    learn_process,
    visit_noise,
)
from robocal_ros.thermal.identification import identify_cycle
from robocal_ros.thermal.tracking import Innovation

Array = NDArray[np.float64]

SHIFTS = 20  # of each of ten robots
EVERY = 3  # the truth is told at every third cycle
LAGS = 10
NORMAL_95 = 1.959964
FALSE_ALARM = 0.05
CHANCE = 0.001


@dataclass(frozen=True, eq=False)
class Trained:
    """A robot and what its earlier shifts have taught."""

    cell: DriftingCell
    arm: SerialArm
    rows: Array  # (c, 3, k) of the check poses
    prior: Array
    trackers: dict[str, LearnedProcess]


@cache
def trained(seed: int) -> Trained:
    """Learn from the first two shifts, and from two of the same course and other work."""
    cell = cell_of(seed, Effects())
    arm = cell.robot.nominal
    early, own = [], []
    rng = np.random.default_rng([seed, 50])
    others = [_other_work(plan, rng) for plan in cell.plans[:2]]
    for i, plan in enumerate((*cell.plans[:2], *others)):
        shift = record(cell, plan, np.random.default_rng([seed, 10 * i] if i > 1 else [seed, i]))
        early.append(_seen(arm, shift, range(len(cell.sphere))))
        own.append(_seen(arm, shift, MEASURING))
    noise = visit_noise(own)  # of the poses that will measure
    learned = {
        name: replace(learn(early), sigma_m=noise)
        for name, learn in (("tracker", learn_process), ("with temperatures", learn_gains))
    }
    histories = [(shift.spots, shift.cycles) for shift in early]
    return Trained(
        cell=cell,
        arm=arm,
        rows=arm.parameter_jacobian(cell.check, kr150.TOOL)[:, :3],
        prior=learn_drift(histories, sigma_m=noise),
        trackers=learned,
    )


def _other_work(plan: DriftPlan, rng: np.random.Generator) -> DriftPlan:
    return replace(plan, duty=rng.uniform(0.3, 1.0, len(plan.duty)))


def _seen(arm: SerialArm, shift: DriftRecord, own: Sequence[int]) -> EarlierShift:
    """What some of the poses showed; how noisy they are is not told."""
    measured = Measured.of(arm, shift, own)
    cycles = [replace(cycle, sigma=None) for cycle in measured.cycles]
    return EarlierShift(measured.spots, cycles, measured.time_s, shift.temperature)


def follow(learned: LearnedProcess, seen: EarlierShift, parts: int = 1) -> Iterator[
    tuple[Innovation, list[tuple[Array, Array]]]
]:  # fmt: skip
    """Each cycle's innovation, and the drifts said at so many parts of the time to the next."""
    tracker = learned.tracker(seen.spots)
    temperature = seen.temperature
    for i, (cycle, time_s) in enumerate(zip(seen.cycles, seen.time_s.tolist(), strict=True)):
        if learned.gains is not None and temperature is not None:
            tracker.read_temperatures(temperature[i], time_s)
        innovation = tracker.take(cycle, time_s)
        step = seen.time_s[0] / parts
        yield innovation, [tracker.drift(time_s + part * step) for part in range(parts)]


def _between(seed: int, number: int) -> dict[str, float]:
    """Rms errors, mm, over check poses and time, of what was held and what was tracked.

    ``number`` 0: the robot's third shift; others: of the same course and other work.
    """
    robot = trained(seed)
    rng = np.random.default_rng([seed, 2, number] if number else [seed, 2])
    plan = robot.cell.plans[2]
    plan = _other_work(plan, rng) if number else plan
    seen = _seen(robot.arm, record(robot.cell, plan, rng), MEASURING)
    truth = robot.cell.truth(plan, PARTS)[PARTS - 1 :]
    noise = robot.trackers["tracker"].sigma_m
    found = [
        identify_cycle(seen.spots, cycle, prior_covariance=robot.prior, sigma_m=noise).drift
        for cycle in seen.cycles
    ]
    said = {"held": np.repeat(found, PARTS, axis=0)}
    for name, learned in robot.trackers.items():
        said[name] = np.array([x for _, steps in follow(learned, seen, PARTS) for x, _ in steps])
    count = len(truth)
    return {
        name: _rms_mm(truth - np.einsum("cik,tk->tci", robot.rows, drift[:count]))
        for name, drift in said.items()
    }


def _rms_mm(error: Array) -> float:
    return float(np.sqrt(np.mean(error**2))) * 1e3


def between_table(seeds: Sequence[int]) -> Table:
    """Rms error between cycles of what was held, and of what the tracker says."""
    table = Table(
        "thermal_between",
        "Between cycles (5 min), rms error in mm over check poses and time",
        ("robot", "last MAP model held", "tracker", "with temperatures", "ratio",
         "ratio with temperatures", "goal"),
        "Simulated, all effects; two shifts of each robot, after four to learn from. Held: "
        "the drift identified from the last cycle, with the prior learned from the same four. "
        "Without temperatures half of it cannot be had: of what the model held is off, what the "
        "cold visit's noise and the other poses hide is half already.",
    )  # fmt: skip
    squares = np.zeros(3)
    shifts = [(seed, number) for seed in seeds for number in range(2)]
    for seed, number in shifts:
        figures = list(_between(seed, number).values())
        squares += np.square(figures)
        name = f"seed {seed}{', other work' if number else ''}"
        ratios = figures[1] / figures[0], figures[2] / figures[0]
        table.add(name, *figures, *ratios, None)
    held, tracked, warm = np.sqrt(squares / len(shifts)).tolist()
    goal = Goal(warm / held, min(0.5, tracked / held))
    table.add("all", held, tracked, warm, tracked / held, warm / held, goal)
    return table


def limits_table(seeds: Sequence[int]) -> Table:
    """What a model identified from one cycle lacks."""
    table = Table(
        "thermal_limits",
        "What the error of one cycle's MAP model is made of, rms in mm",
        ("robot", "noise of the cycle", "noise of the cold visit", "what six poses do not show",
         "drift until the next cycle", "no parameters can follow"),
        "Simulated, from the linear model, without outliers. No tracker sees through the third; "
        "time averages the first, and only a known course in time tells the second from drift.",
    )  # fmt: skip
    for seed in seeds:
        table.add(f"seed {seed}", *_limits(trained(seed)))
    return table


def _limits(robot: Trained) -> list[float]:
    cell, arm, plan = robot.cell, robot.arm, robot.cell.plans[2]
    own = cell.sphere[list(MEASURING)]
    k = len(robot.prior)
    H = arm.parameter_jacobian(own, kr150.BALL)[:, :3].reshape(-1, k)
    told, noise_m = robot.rows.reshape(-1, k), robot.trackers["tracker"].sigma_m

    def gain(variance: float) -> Array:
        S = H @ robot.prior @ H.T + variance * np.eye(len(H))
        return np.asarray(told @ np.linalg.solve(S, H @ robot.prior).T)

    K = gain(noise_m**2 * 4.0 / 3.0)
    noise = 1e3 * noise_m * float(np.sqrt(np.mean(np.sum(K**2, axis=1))))
    truth = cell.truth(plan, PARTS)
    flat = truth.reshape(len(truth), -1)
    drift = flat @ np.linalg.pinv(told).T
    return [
        noise,
        noise / np.sqrt(3.0),
        _rms_mm(drift @ told.T - drift @ H.T @ gain(1e-14).T),
        _rms_mm(truth[PARTS:] - truth[:-PARTS]),
        _rms_mm(flat - drift @ told.T),
    ]


@dataclass(frozen=True, eq=False)
class Honesty:
    """Of one shift: share of true errors inside the 95 % bound, and its innovations."""

    inside: float
    squared: float
    freedom: int
    portmanteau: float

    @property
    def square_passes(self) -> bool:
        """Whether the sum of squares is chi-square (two-sided, 5 %)."""
        low, high = (
            chi2_quantile(p, self.freedom) for p in (0.5 * FALSE_ALARM, 1.0 - 0.5 * FALSE_ALARM)
        )
        return low <= self.squared <= high

    @property
    def white(self) -> bool:
        """Whether successive innovations are independent (5 %)."""
        return self.portmanteau <= chi2_quantile(1.0 - FALSE_ALARM, LAGS)


def judge_bounds(seed: int, number: int) -> dict[str, Honesty]:
    """A further shift of a robot: the third's course, other work of the motors."""
    robot = trained(seed)
    rng = np.random.default_rng([seed, 100 + number])
    plan = _other_work(robot.cell.plans[2], rng)
    six = replace(robot.cell, sphere=robot.cell.sphere[list(MEASURING)])
    seen = _seen(robot.arm, record(six, plan, rng), range(len(MEASURING)))
    truth = robot.cell.truth(plan, every=EVERY)
    return {
        name: _honesty(list(follow(learned, seen)), truth, robot.rows)
        for name, learned in robot.trackers.items()
    }


def _honesty(
    steps: Sequence[tuple[Innovation, list[tuple[Array, Array]]]], truth: Array, rows: Array
) -> Honesty:
    said = [drifts[0] for _, drifts in steps][EVERY - 1 :: EVERY]
    error = truth - np.einsum("cik,tk->tci", rows, np.array([x for x, _ in said]))
    variance = np.einsum("cik,tkl,cil->tci", rows, np.array([P for _, P in said]), rows)
    innovations = [innovation for innovation, _ in steps]
    return Honesty(
        inside=float(np.mean(np.abs(error) <= NORMAL_95 * np.sqrt(variance))),
        squared=sum(one.squared for one in innovations),
        freedom=sum(one.freedom for one in innovations),
        portmanteau=_portmanteau([one.whitened for one in innovations]),
    )


def _portmanteau(series: Sequence[Array]) -> float:
    """Ljung and Box's figure of a series of vectors, over cycles that lost no sample."""
    whole = max(len(v) for v in series)
    total, size = 0.0, float(np.mean([v @ v for v in series if len(v) == whole])) / whole
    for lag in range(1, LAGS + 1):
        products = [
            float(a @ b)
            for a, b in zip(series[lag:], series[:-lag], strict=True)
            if len(a) == len(b) == whole
        ]
        total += (sum(products) / size) ** 2 / (whole * len(products))
    return total


def bounds_table(seeds: Sequence[int], shifts: int) -> Table:
    """Coverage, chi-square and whiteness."""
    count = len(seeds) * shifts
    table = Table(
        "thermal_bounds",
        f"Is the tracker's bound true? {count} simulated shifts",
        ("tracker", "errors inside the 95 % bound, %", "goal", "goal ", "shifts 5 to 95 %",
         "squared innovation", "pass chi-square, %", "goal  ", "pass whiteness, %", "goal   "),
        f"{len(seeds)} robots, {shifts} shifts each with other work of the motors; all effects. "
        "Squared innovation: mean, 1 expected. Tests at 5 % in each shift: 95 % pass if all is "
        "true; the goal is what chance leaves of that but once in a thousand. The tracker alone "
        "is not told when work stops and goes on, and has none.",
    )  # fmt: skip
    judged = [judge_bounds(seed, number) for seed in seeds for number in range(shifts)]
    from scipy.stats import binom

    least = 100.0 * float(binom.ppf(CHANCE, count, 1.0 - FALSE_ALARM)) / count
    for name in judged[0]:
        all_of = [one[name] for one in judged]
        inside = 100.0 * np.array([one.inside for one in all_of])
        mean = float(inside.mean())
        square = 100.0 * float(np.mean([one.square_passes for one in all_of]))
        white = 100.0 * float(np.mean([one.white for one in all_of]))
        tests = [
            None if name == "tracker" else Goal(x, least, at_least=True) for x in (square, white)
        ]
        table.add(
            name, mean, Goal(mean, 93.0, at_least=True), Goal(mean, 97.0),
            f"{np.quantile(inside, 0.05):.0f} to {np.quantile(inside, 0.95):.0f}",
            sum(one.squared for one in all_of) / sum(one.freedom for one in all_of),
            square, tests[0], white, tests[1],
        )  # fmt: skip
    return table


def tables() -> Sequence[Table]:
    """All of them."""
    return [
        limits_table(SEEDS[:3]),
        between_table(SEEDS),
        bounds_table(SEEDS, SHIFTS),
    ]
