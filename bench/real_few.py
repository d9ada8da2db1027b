# SPDX-License-Identifier: Apache-2.0
"""Few real measurements: does the full model ever harm, and what do joint functions alone need?"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from bench.real_data import DRAWS, PLANNED, campaign, data_folder
from bench.tables import Goal, Table
from robocal_ros.bags.ur10_campaigns import halves
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import Identification, identify
from robocal_ros.identification.full_model import identify_full
from robocal_ros.kinematics.robots import load_robot

SUBSETS, FEWEST, MOST = 500, 12, 40
LARGEST_RATIO = {"median": 1.0, "95 % of draws": 1.03, "worst": 1.10}
LARGEST_KNOWN_MM = {60: 0.22, 120: 0.16, 250: 0.135}


def _errors_m(found: Identification, check: Measurements) -> np.ndarray:
    return np.asarray(np.linalg.norm(found.cell.residual(check), axis=1))


def harm_table() -> Table:
    """Random subsets of all campaigns, by turns: the full model beside the geometric one."""
    table = Table(
        "ur10_harm",
        f"UR10: {SUBSETS} random subsets of {FEWEST} to {MOST} poses, full over geometric model",
        ("figure", "of the subset's poses", "full over geometric, rms", "goal"),
        "Campaigns A to D by turns; the poses are of one half, the rms of all poses of the other. "
        "Functions and compliances are taken only where the evidence wants them: elsewhere the "
        "ratio is 1.",
    )
    arm = load_robot("ur10")
    split = {series: halves(campaign(series)) for series in "ABCD"}
    ratios, counts, refused = [], [], Counter[str]()
    for seed in range(SUBSETS):
        rng = np.random.default_rng(seed)
        train, check = split["ABCD"[seed % 4]]
        count = int(rng.integers(FEWEST, MOST + 1))
        some = train.take(rng.permutation(len(train))[:count])
        try:
            errors = [_errors_m(solve(arm, some), check) for solve in (identify, identify_full)]
        except (RankDeficientError, TooFewSamplesError) as error:
            refused[error.code.name] += 1
            continue
        geometric, full = (float(np.sqrt(np.mean(error**2))) for error in errors)
        ratios.append(full / geometric)
        counts.append(count)
    ratio, of = np.array(ratios), np.array(counts)
    found = {
        "median": float(np.median(ratio)),
        "95 % of draws": float(np.quantile(ratio, 0.95)),
        "worst": float(ratio.max()),
    }
    for name, value in found.items():
        table.add(name, "all", value, Goal(value, LARGEST_RATIO[name]))
    for least, most in ((FEWEST, 19), (20, 29), (30, MOST)):
        inside = ratio[(of >= least) & (of <= most)]
        if not len(inside):
            continue
        table.add(f"median of {len(inside)}", f"{least} to {most}", float(np.median(inside)), None)
    better = 100.0 * float(np.mean(ratio < 1.0))
    table.add("with functions or compliances, %", "all", better, None)
    table.add("refused: " + (", ".join(refused) or "none"), "all", sum(refused.values()), None)
    return table


def known_geometry_table() -> Table:
    """Joint functions from few poses of a robot whose geometry is known from many."""
    table = Table(
        "ur10_known_geometry",
        "UR10, campaign C: joint functions from few poses, with the geometry of all training poses",
        ("poses", "draws", "mean, mm", "goal", "worst of the draws, mm"),
        "Nominal is here the geometric model of the half that identifies; the other half judges.",
    )
    train, check = halves(campaign("C"))
    arm = identify(load_robot("ur10"), train).cell.arm
    for count in PLANNED:
        means = []
        for seed in range(DRAWS):
            chosen = np.random.default_rng(seed).permutation(len(train))[:count]
            errors = _errors_m(identify_full(arm, train.take(chosen)), check)
            means.append(float(errors.mean()) * 1e3)
        mean = float(np.mean(means))
        table.add(count, DRAWS, mean, Goal(mean, LARGEST_KNOWN_MM[count]), max(means))
    return table


def tables() -> Sequence[Table]:
    """All tables of this module; none where the measurements are not here."""
    if not data_folder().is_dir():
        print(f"no real measurements at {data_folder()} (set ROBOCAL_DATA): their tables left out")
        return []
    return [known_geometry_table(), harm_table()]
