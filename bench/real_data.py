# SPDX-License-Identifier: Apache-2.0
"""Real measurements: what a calibrated model is worth, at poses that it was not made from."""

import os
from collections.abc import Sequence
from functools import lru_cache
from itertools import product
from pathlib import Path

import numpy as np
from scipy.stats import binom

from bench.tables import Goal, Table
from robocal_ros.bags.ur10_campaigns import halves, load_campaign
from robocal_ros.estimation.assessment import ErrorSummary, summarise
from robocal_ros.ground.frames import Index
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import JudgedIdentification, identify_and_judge
from robocal_ros.identification.full_model import identify_full
from robocal_ros.identification.judged import Model
from robocal_ros.identification.planning import WORKING, plan_poses
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.universal_robots import (
    factory_arm,
    nominal_arm,
    parse_settings,
    read_panel_poses,
)

LARGEST_MEAN_MM = {
    "geometric": {"A": 0.41, "B": 0.41, "C": 0.45, "D": 0.365},
    "full": {"A": 0.066, "B": 0.088, "C": 0.087, "D": 0.124},
}
LARGEST_LATER_MEAN_MM = {
    "geometric": {"B": 0.455, "C": 0.52, "D": 0.40},
    "full": {"B": 0.24, "C": 0.42, "D": 0.145},
}
LARGEST_SECOND_HALF_MEAN_MM = {"A": 0.125, "C": 0.103}
LEAST_UNCOVERED = {"D": 30.0}  # %, of a half that saw other angles: it has to be told
MODELS: tuple[Model, Model] = ("geometric", "full")
DRAWS, PLAN_DRAWS = 10, 3
PLANNED = (60, 120, 250)
LARGEST_FEW_RATIO = {60: 0.75, 120: 0.55, 250: 0.40}  # to the geometric model of the same poses
LEAST_INSIDE, MOST_INSIDE = 0.93, 0.97  # of errors, by bounds of 95 %
LARGEST_UR5E_MEAN_MM, LARGEST_UR5E_MAX_MM = 0.0445, 0.081
WHEN = {"A": "July 2020, grid", "B": "Nov. 2020", "C": "Nov. 2020, random", "D": "March 2021"}


def data_folder() -> Path:
    """Folder of all real measurements, whether it is there or not."""
    beside = Path(__file__).resolve().parents[2] / "shared" / "data"
    return Path(os.environ.get("ROBOCAL_DATA", beside))


def campaign(series: str) -> Measurements:
    """A series of the UR10."""
    return load_campaign(series, data_folder() / "ur10_tmac")


@lru_cache
def own_half(series: str, model: Model = "full") -> JudgedIdentification:
    """Identify from half of a campaign, judge on the other half."""
    train, check = halves(campaign(series))
    return identify_and_judge(load_robot("ur10"), train, check, model=model)


@lru_cache
def carried_over(source: str, series: str, model: Model = "full") -> JudgedIdentification:
    """The model of a campaign's training half on another: only base and tool refitted there."""
    train, _ = halves(campaign(source))
    check, refit = campaign(series), ("base", "tool")
    return identify_and_judge(load_robot("ur10"), train, check, model=model, check_refit=refit)


@lru_cache
def ur5e_errors() -> dict[str, ErrorSummary]:
    """Distances from the controller's own poses, of the nominal and the factory's model."""
    folder = data_folder() / "ur5e_factory"
    nominal, delta = (
        parse_settings((folder / name).read_text(), name)
        for name in ("urcontrol.conf.UR5", "calibration.conf")
    )
    shown = read_panel_poses(folder / "joint-eef-data.csv")
    arms = {
        "nominal": nominal_arm(nominal, "UR5e"),
        "factory calibration, imported": factory_arm(nominal, delta, "UR5e"),
    }
    return {
        name: summarise(arm.fk(shown.q)[:, :3, 3] - shown.position) for name, arm in arms.items()
    }


def _millimetres(errors: ErrorSummary) -> tuple[float, float, float, float]:
    return errors.mean_m * 1e3, errors.rms_m * 1e3, errors.p95_m * 1e3, errors.max_m * 1e3


def campaigns_table() -> Table:
    """The four campaigns, each on its own held-out half."""
    table = Table(
        "ur10_campaigns",
        "UR10 with laser tracker and T-Mac: errors of the T-Mac's origin at held-out poses, mm",
        ("campaign", "poses", "model", "mean", "goal", "rms", "95 %", "max", "predicted rms"),
        "Half of each campaign's poses identify base, T-Mac and model, the other half judges; "
        "visits of one pose stay on one side. Nominal: base and T-Mac fitted to the same half. "
        "Full: with a function of each joint's angle and compliances. Predicted: from covariance "
        "and noise.",
    )
    for series in "ABCD":
        nominal = own_half(series).nominal
        mean, *others = _millimetres(nominal)
        table.add(f"{series} ({WHEN[series]})", nominal.n, "nominal", mean, None, *others, None)
        for model in MODELS:
            judged = own_half(series, model)
            mean, *others = _millimetres(judged.candidate)
            goal = Goal(mean, LARGEST_MEAN_MM[model][series])
            predicted = judged.predicted_total_rms_m * 1e3
            table.add("", judged.candidate.n, model, mean, goal, *others, predicted)
    return table


def later_table() -> Table:
    """The model of one campaign in another."""
    table = Table(
        "ur10_later",
        "The UR10's model of one campaign in others: only base and T-Mac refitted, mm",
        (
            "model of",
            "used in",
            "poses",
            "model",
            "nominal mean",
            "mean",
            "goal",
            "rms",
            "95 %",
            "max",
            "verdict",
        ),
        "The tracker stood elsewhere and the T-Mac was mounted anew, so those are fitted to the "
        "later data, for both models; the geometry is held. A's grid is a box of 0.4 x 1.3 x 0.5 m "
        "on one side, B and C lie in one of 0.8 x 0.5 x 0.5 m elsewhere, D on all sides.",
    )
    for (source, series), model in product(("AB", "AC", "AD", "CB", "CD"), MODELS):
        judged = carried_over(source, series, model)
        after = _millimetres(judged.candidate)
        goal = Goal(after[0], LARGEST_LATER_MEAN_MM[model][series]) if source == "A" else None
        table.add(
            source, f"{series} ({WHEN[series]})", judged.candidate.n, model,
            judged.nominal.mean_m * 1e3, after[0], goal, *after[1:], judged.verdict.code.name,
        )  # fmt: skip
    return table


def halves_of_time_table() -> Table:
    """A model of the first half of a campaign's time in the second."""
    table = Table(
        "ur10_time",
        "UR10: identified from the first half of a campaign's time, judged by the second, mm",
        ("campaign", "poses", "nominal mean", "geometry mean", "full mean", "goal", "95 %", "max",
         "not covered, %", "goal "),
        "Nothing is fitted to the second half. Not covered: poses with a joint where the first "
        "half did not measure it, which the verdict names.",
    )  # fmt: skip
    for series in "ACD":
        data = campaign(series)
        first, second = (data.take(part) for part in np.array_split(np.arange(len(data)), 2))
        geometric, full = (
            identify_and_judge(load_robot("ur10"), first, second, model=model) for model in MODELS
        )
        mean, _, p95, largest = _millimetres(full.candidate)
        most, away = LARGEST_SECOND_HALF_MEAN_MM.get(series), 100.0 * full.check_outside
        least = LEAST_UNCOVERED.get(series)
        table.add(
            series, full.candidate.n, full.nominal.mean_m * 1e3, geometric.candidate.mean_m * 1e3,
            mean, most and Goal(mean, most), p95, largest,
            away, least and Goal(away, least, at_least=True),
        )  # fmt: skip
    return table


def few_poses_table() -> Table:
    """How many poses it takes."""
    table = Table(
        "ur10_few_poses",
        f"UR10, campaign C: how many poses? rms at 1500 other poses, mean of {DRAWS} draws, mm",
        ("poses", "nominal", "least squares", "with prior", "full (default)", "full over prior",
         "goal", "accepted"),
        "Accepted: of the draws, the full model, judged on as many other poses as identified it "
        "(at least 20). The prior's width is found from the data.",
    )  # fmt: skip
    arm, data = load_robot("ur10"), campaign("C")
    for count in (12, 16, 24, 40, 60, 120, 250):
        squares, accepted = np.zeros(4), 0
        for seed in range(DRAWS):
            order = np.random.default_rng(seed).permutation(len(data))
            train, rest = data.take(order[:count]), data.take(order[-1500:])
            judge_by = data.take(order[count : 2 * count + max(20 - count, 0)])
            plain = identify_and_judge(arm, train, rest, method="lsq")
            prior = identify_and_judge(arm, train, rest)
            full = identify_and_judge(arm, train, rest, model="full")
            errors = (plain.nominal, plain.candidate, prior.candidate, full.candidate)
            squares += [summary.rms_m**2 for summary in errors]
            judged = identify_and_judge(arm, train, judge_by, model="full")
            accepted += judged.verdict.accept
        rms_mm = (np.sqrt(squares / DRAWS) * 1e3).tolist()
        ratio, most = rms_mm[3] / rms_mm[2], LARGEST_FEW_RATIO.get(count)
        table.add(
            count, *rms_mm, ratio, most and Goal(ratio, most), f"{accepted} of {DRAWS}"
        )  # fmt: skip
    return table


def planned_table() -> Table:
    """Poses that `robocal identify --plan` chooses, beside random ones."""
    table = Table(
        "ur10_planned",
        "UR10, campaign C: planned and random poses, mean errors at the other half, mm",
        ("poses", "planned", "random", "planned over random", "goal", "planned, predicted rms"),
        "The poses are of the half that identifies; everything is identified from them alone. "
        "Planned: chosen one after the other before anything is measured, so that the full model "
        f"errs least (robocal identify --plan). Random: mean of {PLAN_DRAWS} draws.",
    )
    arm, (train, check) = load_robot("ur10"), halves(campaign("C"))
    working = train.q[np.random.default_rng(0).permutation(len(train))[:WORKING]]

    def mean_mm(chosen: Index) -> float:
        error = identify_full(arm, train.take(chosen)).cell.residual(check)
        return float(np.mean(np.linalg.norm(error, axis=1))) * 1e3

    plan = plan_poses(arm, train.q, working, max(PLANNED))
    draws = [np.random.default_rng(i).permutation(len(train)) for i in range(PLAN_DRAWS)]
    for count in PLANNED:
        planned = mean_mm(plan.chosen[:count])
        drawn = float(np.mean([mean_mm(draw[:count]) for draw in draws]))
        ratio, told = planned / drawn, float(plan.predicted_rms_m[count - 1]) * 1e3
        table.add(count, planned, drawn, ratio, Goal(ratio, 1.0), told)
    return table


def stated_table() -> Table:
    """How true the errors are that a full model states of itself."""
    table = Table(
        "ur10_stated",
        "UR10: squared error at held-out poses over its predicted variance",
        ("campaign", "poses", "draws", "inner 99 %", "goal", "goal ", "all", "inside 95 %, %",
         "goal  ", "goal   "),
        "The full model; variance of covariance and noise, 1 expected. Inner: without the farthest "
        "one of a hundred rows. Half of a campaign, or draws from it, judged by the other half. "
        "Inside: of the bound that the model states, by what its left-out errors keep. Goals are "
        "what chance makes of 93 and 97 % in so many rows (binomial, 95 %).",
    )  # fmt: skip
    arm = load_robot("ur10")
    for series, count in product("ABCD", (None, 60, 120, 250)):
        train, check = halves(campaign(series))
        found = []
        for seed in range(1 if count is None else DRAWS):
            chosen = np.random.default_rng(seed).permutation(len(train))[:count]
            few = count is not None
            full = (
                identify_full(arm, train.take(chosen)) if few else own_half(series).identification
            )
            error = full.cell.residual(check)
            target = np.zeros(len(check), dtype=np.int64)
            variance = full.predicted_variance(check.q, target) + full.noise_m**2 * np.eye(3)
            ratio = np.sum(error**2, axis=1) / np.trace(variance, axis1=1, axis2=2)
            whitened = np.linalg.solve(variance, error[..., None])[..., 0]
            inside = np.sum(error * whitened, axis=1) < full.bound_squared
            inner = np.sort(ratio)[: int(0.99 * len(ratio))]
            found.append((inner.mean(), ratio.mean(), 100.0 * inside.mean()))
        inner, every, inside = np.mean(found, axis=0).tolist()
        least, most = Goal(inner, 0.8, at_least=True), Goal(inner, 1.25)
        rows, chance = len(check), (0.025, 0.975)
        fewest, highest = 100.0 * binom.ppf(chance, rows, (LEAST_INSIDE, MOST_INSIDE)) / rows
        table.add(
            series, count or len(train), len(found), inner, least, most, every, inside,
            Goal(inside, float(fewest), at_least=True), Goal(inside, float(highest)),
        )  # fmt: skip
    return table


def ur5e_table() -> Table:
    """The factory calibration of a UR5e."""
    table = Table(
        "ur5e_factory",
        "UR5e: distance from the poses of its own controller, 18 poses, mm",
        ("model", "mean", "goal", "rms", "95 %", "max", "goal "),
        "The controller's poses are rounded to 0.01 mm and 0.01 deg.",
    )
    for name, errors in ur5e_errors().items():
        mean, rms, p95, largest = _millimetres(errors)
        factory = name != "nominal"
        table.add(
            name, mean, Goal(mean, LARGEST_UR5E_MEAN_MM) if factory else None, rms, p95, largest,
            Goal(largest, LARGEST_UR5E_MAX_MM) if factory else None,
        )  # fmt: skip
    return table


def tables() -> Sequence[Table]:
    """All tables of this module; none where the measurements are not here."""
    if not data_folder().is_dir():
        print(f"no real measurements at {data_folder()} (set ROBOCAL_DATA): their tables left out")
        return []
    return [
        campaigns_table(), later_table(), halves_of_time_table(), few_poses_table(),
        stated_table(), planned_table(), ur5e_table(),
    ]  # fmt: skip
