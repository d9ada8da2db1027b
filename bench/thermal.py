# SPDX-License-Identifier: Apache-2.0
"""Simulated shifts: how much of the workspace stays accurate, by method; see docs/simulation.md.

Nothing is tuned on the shift that is judged: prior and parameters come from another shift of the
same robot.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from bench import thermal_real, thermal_setup, thermal_tracking
from bench.measured_shifts import LENGTHS, MEASURING, DriftingCell, DriftPlan, record
from bench.tables import Goal, Table
from bench.thermal_shifts import PARTS, SEEDS, SIGMA_M, Measured, cell_of
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects
from robocal_ros.cell_sim.sensors import CloudScene, sphere_cloud
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.accuracy import EarlierShift, LearnedProcess, learn_drift, learn_process
from robocal_ros.thermal.identification import (
    drift_prior,
    identify_cycle,
    judge_cycle,
    subset_drift,
)
from robocal_ros.thermal.reference import ColdSpots
from robocal_ros.thermal.screening import (
    THRESHOLD_M,
    WANTED,
    DriftHistory,
    best_subset,
    screen,
    share_within,
)

Array = NDArray[np.float64]

PUBLISHED = {  # KR 150 R3100, three test runs, judged by measurement
    "no correction": (43.18, 49.41, 48.05),
    "six lengths": (73.86, 80.00, 87.01),
    "screened": (90.91, 96.47, 94.81),
}
# Thesis, table 5-1: shares from 24 parameters down to 8, and what each round removed.
ROUNDS = (7.95, 61.36, 77.27, 77.27, 76.14, 77.27, 75.00, 84.09, 89.77, *[93.18] * 5, *[90.91] * 3)
REMOVED = (
    "theta6", "theta4", "theta3", "theta1", "theta5", "theta2", "a6", "alpha2", "alpha1", "a5",
    "alpha5", "d5", "d1", "alpha6", "a4", "d3",
)  # fmt: skip
WANTED_SHARE = 97.0  # %
WANTED_BEYOND = 0.4  # of the share of directions that the screened subset leaves beyond 0.1 mm


@dataclass(frozen=True, eq=False)
class Judged:
    """One shift of one robot: its truth, and what another shift has taught."""

    measured: Measured
    teacher: Measured
    truth: Array  # (t, c, 3) displacement at the check poses at each cycle
    between: Array  # (PARTS t, c, 3) the same at every part of a period
    rows: Array  # (c, 3, k) of the check poses
    prior: Array
    history: DriftHistory  # of the teacher's shift
    screened: tuple[int, ...]
    learned: LearnedProcess
    planned: Measured  # the same shift, measured in as many planned poses

    def left(self, drift: Array) -> Array:
        """Residual (t, c, 3) at the check poses after a correction with drifts (t, k)."""
        return np.asarray(self.truth - np.einsum("cik,tk->tci", self.rows, drift))


@cache
def prepare(seed: int, effects: Effects) -> list[Judged]:
    """The three shifts of one robot, each with the one before as its teacher."""
    arm = load_robot("kr150_r3100")
    cell = cell_of(seed, effects)
    records = [
        record(cell, plan, np.random.default_rng([seed, i])) for i, plan in enumerate(cell.plans)
    ]
    planned = replace(cell, sphere=thermal_setup.planned().q)
    others = [
        record(planned, plan, np.random.default_rng([seed, 10 + i]))
        for i, plan in enumerate(cell.plans)
    ]
    rows = arm.parameter_jacobian(cell.check, kr150.TOOL)[:, :3]
    everything = range(len(cell.sphere))
    found = []
    for i, plan in enumerate(cell.plans):
        between = cell.truth(plan, PARTS)
        teacher = Measured.of(arm, records[i - 1], everything)
        learned = learn_drift([(teacher.spots, teacher.cycles)], sigma_m=SIGMA_M)
        history = _history(arm, cell, teacher, cell.plans[i - 1], seed)
        chosen = screen(history, wanted=1).highest.names
        found.append(
            Judged(
                measured=Measured.of(arm, records[i], MEASURING),
                teacher=teacher,
                truth=between[PARTS - 1 :: PARTS],
                between=between,
                rows=rows,
                prior=learned,
                history=history,
                screened=tuple(arm.parameters.names.index(name) for name in chosen),
                learned=learn_process([_earlier(teacher)]),
                planned=Measured.of(arm, others[i], range(len(planned.sphere))),
            )
        )
    return found


def _earlier(teacher: Measured) -> EarlierShift:
    cycles = [replace(cycle, sigma=None) for cycle in teacher.cycles]
    return EarlierShift(teacher.spots, cycles, teacher.time_s)


def _history(
    arm: SerialArm, cell: DriftingCell, teacher: Measured, plan: DriftPlan, seed: int
) -> DriftHistory:
    """The teacher's shift for screening, its check poses judged as measured."""
    spots = teacher.spots
    truth = cell.truth(plan).reshape(len(teacher.cycles), -1)
    noise = SIGMA_M * np.random.default_rng([seed, 99]).standard_normal(truth.shape)
    return DriftHistory(
        names=arm.parameters.names,
        displacement=np.array([_displacement(spots, cycle) for cycle in teacher.cycles]),
        rows=spots.rows(spots.q, spots.target)[0].reshape(-1, len(arm.parameters)),
        check=truth + noise,
        check_rows=arm.parameter_jacobian(cell.check, kr150.TOOL)[:, :3].reshape(
            truth.shape[1], -1
        ),
    )


def _displacement(spots: ColdSpots, cycle: Measurements) -> Array:
    """Displacement (3s,) at each spot in the spots' order."""
    return np.asarray(spots.drift(cycle)[np.argsort(spots.match(cycle))].ravel())


def _subset(judged: Judged, chosen: Sequence[int]) -> Array:
    spots, names = judged.measured.spots, judged.measured.spots.cell.arm.parameters.names
    seen = np.array([_displacement(spots, cycle) for cycle in judged.measured.cycles])
    A = spots.rows(spots.q, spots.target)[0].reshape(seen.shape[1], -1)
    found = subset_drift(seen, A, chosen, names)
    drift = np.zeros((len(seen), len(names)))
    drift[:, found.chosen] = found.drift
    return drift


def _map(judged: Judged, prior: Array) -> Array:
    measured = judged.measured
    return np.array(
        [
            identify_cycle(measured.spots, cycle, prior_covariance=prior, sigma_m=SIGMA_M).drift
            for cycle in measured.cycles
        ]
    )


def _tracked(measured: Measured, learned: LearnedProcess) -> Array:
    """Drifts (t, k) right after each cycle."""
    tracker = learned.tracker(measured.spots)
    drifts = []
    for cycle, time_s in zip(measured.cycles, measured.time_s.tolist(), strict=True):
        tracker.take(replace(cycle, sigma=None), time_s)
        drifts.append(tracker.drift(time_s)[0])
    return np.array(drifts)


def _drifts(judged: Judged) -> dict[str, Array]:
    names = judged.measured.spots.cell.arm.parameters.names
    return {
        "no correction": np.zeros((len(judged.truth), len(names))),
        "six lengths": _subset(judged, [names.index(name) for name in LENGTHS]),
        "screened": _subset(judged, judged.screened),
        "MAP, default prior": _map(judged, drift_prior(judged.measured.spots.cell.arm)),
        "MAP, learned prior": _map(judged, judged.prior),
        "MAP and tracker": _tracked(judged.measured, judged.learned),
        "MAP, tracker, planned poses": _tracked(judged.planned, judged.learned),
    }


def shares(seeds: Sequence[int], effects: Effects) -> dict[str, Array]:
    """Share in % (seeds, shifts, 2) within 0.1 mm by method: true residuals, and as measured."""
    found: dict[str, list[list[tuple[float, float]]]] = {}
    for seed in seeds:
        rows: dict[str, list[tuple[float, float]]] = {}
        for judged in prepare(seed, effects):
            noise = SIGMA_M * np.random.default_rng([seed, 7]).standard_normal(judged.truth.shape)
            for name, drift in _drifts(judged).items():
                left = judged.left(drift)
                pair = (100.0 * share_within(left), 100.0 * share_within(left + noise))
                rows.setdefault(name, []).append(pair)
        for name, row in rows.items():
            found.setdefault(name, []).append(row)
    return {name: np.array(values) for name, values in found.items()}


def share_table(seeds: Sequence[int], effects: Effects, name: str, title: str) -> Table:
    """Mean (worst) of each shift over the seeds, the same as measured, and as published."""
    columns = ("method", "shift 1", "shift 2", "shift 3", "as measured", "published", "goal")
    table = Table(
        name,
        title,
        columns,
        f"{len(seeds)} simulated robots, six poses a cycle, 90 cycles a shift; 34 check poses, "
        "x, y, z apart. True residuals without noise: mean over the robots (worst). As measured: "
        "mean over all, judged with noise, as the published row had to be. Prior and parameters "
        "come from the shift before; the planned poses from the default prior.",
    )
    found = shares(seeds, effects)
    beyond = 100.0 - found["screened"][:, :, 0].mean()
    for method, values in found.items():
        true = values[:, :, 0]
        cells = [f"{true[:, i].mean():.1f} ({true[:, i].min():.1f})" for i in range(3)]
        published = PUBLISHED.get(method)
        goal = None
        if method == "MAP, tracker, planned poses":
            limit = max(WANTED_SHARE, 100.0 - WANTED_BEYOND * beyond)
            goal = Goal(float(true.mean(axis=0).min()), limit, at_least=True)
        words = None if published is None else " ".join(f"{x:.2f}" for x in published)
        table.add(method, *cells, float(values[:, :, 1].mean()), words, goal)
    return table


def within_by_direction(left: Array) -> tuple[float, float]:
    """Share of directions of residuals (t, c, 3) within 0.1 mm over all cycles: by rms, by worst.

    The source counts 88, 85 and 77 directions, each once for a whole run, and does not say which.
    """
    rms, worst = np.sqrt(np.mean(left**2, axis=0)), np.max(np.abs(left), axis=0)
    return float(np.mean(rms < THRESHOLD_M)), float(np.mean(worst < THRESHOLD_M))


def counting_table(seed: int = SEEDS[0]) -> Table:
    """Shares counted as the source counts them, with all its ways to choose parameters."""
    table = Table(
        "thermal_counting",
        "Directions within 0.1 mm, %: by cycle and direction, and each direction once as published",
        ("method", "by cycle", "once, by rms", "once, by the worst cycle", "published"),
        "One simulated robot, mean of three shifts, judged with noise; parameters from the shift "
        "before, of twenty poses. Eight: where the source stops. C_p: best subset of eight.",
    )
    found: dict[str, list[Array]] = {}
    for judged in prepare(seed, Effects()):
        noise = SIGMA_M * np.random.default_rng([seed, 7]).standard_normal(judged.truth.shape)
        names = judged.history.names
        sets = {
            "no correction": (),
            "six lengths": LENGTHS,
            "eight, C_p": best_subset(judged.history, WANTED).names,
            "eight, screened as the source": screen(judged.history, removal="classic").chosen.names,
            "eight, screened": screen(judged.history).chosen.names,
            "screened": tuple(names[i] for i in judged.screened),
        }
        for method, chosen in sets.items():
            drift = np.zeros((len(judged.truth), len(names)))
            if chosen:
                drift = _subset(judged, [names.index(name) for name in chosen])
            left = judged.left(drift) + noise
            shares = np.array([share_within(left), *within_by_direction(left)])
            found.setdefault(method, []).append(100.0 * shares)
    for method, rows in found.items():
        like = "screened" if method == "eight, screened as the source" else method
        published = PUBLISHED.get(like) if method != "screened" else None
        words = None if published is None else " ".join(f"{x:.2f}" for x in published)
        title = "the best set of the search" if method == "screened" else method
        table.add(title, *np.mean(rows, axis=0).tolist(), words)
    return table


def rounds_table(seed: int = SEEDS[0]) -> Table:
    """All rounds of a screening beside the source's."""
    table = Table(
        "thermal_rounds",
        "Screening, round by round: share within 0.1 mm, %, and what is removed next",
        ("parameters", "classic", "removed", "best", "removed ", "published", "removed  "),
        "One simulated robot, its second shift, twenty poses and ninety cycles, check points as "
        "measured; by cycle and direction. Empty: the poses do not determine the parameters left. "
        "Published: a real KR 150 R3100, its first run, each direction once.",
    )
    history = prepare(seed, Effects())[2].history
    classic, best = (screen(history, removal=way).rounds for way in ("classic", "best"))
    gone = (*REMOVED, None)
    for ours, other, share, name in zip(classic, best, ROUNDS, gone, strict=True):
        row: list[float | str | None] = []
        for one in (ours, other):
            row += [None if one.share is None else 100.0 * one.share, one.removed]
        table.add(len(ours.names), *row, share, name)
    return table


def speed_table() -> Table:
    """What a cycle costs on line, and a screening off line."""
    table = Table(
        "thermal_speed",
        "Thermal drift: time on one thread, ms",
        ("what", "median", "95 %", "goal"),
        "Sphere: 2000 points, a quarter of them not the sphere's. Cycle: from six centres to the "
        "judged drift of all parameters. Screening: from 24 parameters to one.",
    )
    rng = np.random.default_rng(0)
    clouds = [sphere_cloud(np.array([0.05, -0.03, 0.7]), 2000, rng) for _ in range(100)]
    rule = SphereRule(CloudScene().radius_m)
    _add_times(
        table, "fit of a sphere", [partial(fit_sphere, cloud, rule) for cloud in clouds], 3.0
    )
    judged = prepare(SEEDS[0], Effects())[1]
    spots, prior, arm = judged.measured.spots, judged.prior, judged.measured.spots.cell.arm

    def cycle(one: Measurements) -> object:
        found = identify_cycle(spots, one, prior_covariance=prior, sigma_m=SIGMA_M)
        return judge_cycle(found, spots, in_force=arm, sigma_m=SIGMA_M)

    _add_times(table, "one cycle", [partial(cycle, one) for one in judged.measured.cycles], 5.0)
    history = judged.history
    _add_times(table, "screening, 90 cycles of 20 poses", [partial(screen, history, wanted=1)], 1e4)
    return table


def _add_times(
    table: Table, what: str, calls: Sequence[Callable[[], object]], limit: float
) -> None:
    calls[0]()
    took = []
    for call in calls:
        start = time.perf_counter()
        call()
        took.append(1e3 * (time.perf_counter() - start))
    p95 = float(np.quantile(took, 0.95))
    table.add(what, float(np.median(took)), p95, Goal(p95, limit))


def tables() -> Sequence[Table]:
    """All of them."""
    return [
        share_table(SEEDS, Effects(), "thermal_shares", "Directions within 0.1 mm, %, simulated"),
        share_table(
            SEEDS,
            Effects.modelled(),
            "thermal_shares_modelled",
            "The same without what no estimator knows of",
        ),
        counting_table(),
        rounds_table(),
        *thermal_setup.tables(),
        *thermal_tracking.tables(),
        *thermal_real.tables(),
    ]
