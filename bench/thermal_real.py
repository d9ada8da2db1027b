"""Real drift: a UR10 measured for 100 hours, tracked block by block against a static model."""

from collections.abc import Sequence

import numpy as np

from bench.tables import Table
from bench.ur10_campaigns import data_folder, load_campaign
from robocal_ros.estimation.assessment import summarise
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import Identification, identify
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.tracking import STEADY_TIME_S

FIRST_H = 10.0
BLOCK = 300  # poses, 1.1 hours of measuring
MOST = 2000  # poses of a refit


def tracked_table() -> Table:
    """Each model's error in the block that comes next."""
    table = Table(
        "ur10_tracked",
        "UR10, series A in order of time (100 hours): error of the T-Mac one block ahead, mm",
        ("model", "mean", "rms", "95 %", "best in blocks"),
        f"Real measurements. Static: from the first {FIRST_H:.0f} hours. Tracked: updated after "
        f"each block of {BLOCK} poses, what is known carried over, widened by the default drift "
        "prior's growth in that time. Refitted: all so far as if nothing drifted "
        f"(evenly {MOST} poses of them). The poses never repeat and their order is the grid's, so "
        "that a later block also lies elsewhere: tracking gains knowledge of the arm as well.",
    )
    errors = _ahead()
    means = {name: [float(np.mean(e)) for e in blocks] for name, blocks in errors.items()}
    best = np.argmin(list(means.values()), axis=0)
    for i, (name, blocks) in enumerate(errors.items()):
        all_of = summarise(np.concatenate(blocks))
        row = (1e3 * all_of.mean_m, 1e3 * all_of.rms_m, 1e3 * all_of.p95_m)
        table.add(name, *row, f"{int(np.sum(best == i))} of {len(best)}")
    return table


def _ahead() -> dict[str, list[np.ndarray]]:
    """Distances, m, of each model at each block, before the block is used."""
    arm, data = load_robot("ur10"), load_campaign("A")
    assert data.stamp_ns is not None
    time_s = (data.stamp_ns - data.stamp_ns[0]) / 1e9
    start = int(np.searchsorted(time_s, FIRST_H * 3600.0))
    first = identify(arm, data.take(np.arange(start)))
    static, tracked, refitted = first.cell, first, first.cell
    found: dict[str, list[np.ndarray]] = {"static": [], "tracked": [], "refitted": []}
    before_s = float(time_s[start - 1])
    for begin in range(start, len(data) - BLOCK + 1, BLOCK):
        block = data.take(np.arange(begin, begin + BLOCK))
        for name, cell in (("static", static), ("tracked", tracked.cell), ("refitted", refitted)):
            found[name].append(np.linalg.norm(cell.residual(block), axis=1))
        now_s = float(time_s[begin + BLOCK - 1])
        tracked = _update(tracked, block, now_s - before_s)
        chosen = np.linspace(0, begin + BLOCK - 1, MOST).astype(np.int64)
        refitted = identify(arm, data.take(chosen), start=refitted).cell
        before_s = now_s
    return found


def _update(last: Identification, block: Measurements, step_s: float) -> Identification:
    """The last model as prior, widened by what may have drifted since."""
    arm = last.cell.arm
    count = len(arm.parameters)
    known = last.estimate.covariance[:count, :count]
    growth = min(1.0, step_s / STEADY_TIME_S) * drift_prior(arm)
    return identify(arm, block, fit=("geometry",), prior_covariance=known + growth, start=last.cell)


def tables() -> Sequence[Table]:
    """The table; none where the measurements are not here."""
    return [tracked_table()] if data_folder().is_dir() else []
