# SPDX-License-Identifier: Apache-2.0
"""Real drift: a UR10 measured for 100 hours, tracked block by block against a static model."""

from collections.abc import Iterator, Sequence

import numpy as np

from bench.real_data import campaign, data_folder
from bench.tables import Table
from robocal_ros.estimation.assessment import summarise
from robocal_ros.ground.frames import Array, Index
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import Identification, identify
from robocal_ros.identification.full_model import identify_full
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.tracking import STEADY_TIME_S

FIRST_H = 10.0
BLOCK = 300  # poses, 1.1 hours of measuring
MOST = 2000  # poses of a refit
THROUGHOUT = 2  # every so many poses know the arm from the begin to the end


def tracked_table() -> Table:
    """Each model's error in the block that comes next."""
    table = Table(
        "ur10_tracked",
        "UR10, series A in order of time (100 hours): error of the T-Mac one block ahead, mm",
        ("known from", "model", "mean", "rms", "95 %", "best in blocks"),
        f"Real measurements. Static: from the first {FIRST_H:.0f} hours, or from every second pose "
        "of the whole series, while the others are the blocks. Tracked: its geometry is updated "
        f"after each block of {BLOCK} poses, what is known carried over, widened by the default "
        "drift prior's growth in that time; joint functions are held. Refitted: all so far as if "
        f"nothing drifted (evenly {MOST} poses of them). The poses never repeat and their order is "
        "the grid's: after the first hours a later block also lies elsewhere, and tracking gains "
        "knowledge of the arm as well. A model that knows the whole series gains by drift alone.",
    )
    arm, data = load_robot("ur10"), campaign("A")
    assert data.stamp_ns is not None
    time_s = (data.stamp_ns - data.stamp_ns[0]) / 1e9
    start = int(np.searchsorted(time_s, FIRST_H * 3600.0))
    early, later = np.arange(start), np.arange(start, len(data))
    every = np.arange(len(data)) % THROUGHOUT == 0
    for known, rows, blocks, models in (
        (f"first {FIRST_H:.0f} hours", early, later, ("geometric", "full")),
        ("every second pose", np.flatnonzero(every), np.flatnonzero(~every), ("full",)),
    ):
        errors: dict[str, list[Array]] = {}
        for model in models:
            solved = identify_full if model == "full" else identify
            first = solved(arm, data.take(rows))
            errors |= _ahead(first, model, data, time_s, blocks)
        if known.startswith("first"):
            errors["refitted, geometric"] = _refitted(arm, data, blocks)
        means = {name: [float(np.mean(e)) for e in found] for name, found in errors.items()}
        best = np.argmin(list(means.values()), axis=0)
        for i, (name, found) in enumerate(errors.items()):
            of = summarise(np.concatenate(found))
            row = (1e3 * of.mean_m, 1e3 * of.rms_m, 1e3 * of.p95_m)
            table.add(known, name, *row, f"{int(np.sum(best == i))} of {len(best)}")
    return table


def _blocks(rows: Index) -> Iterator[Index]:
    for begin in range(0, len(rows) - BLOCK + 1, BLOCK):
        yield rows[begin : begin + BLOCK]


def _ahead(
    first: Identification, model: str, data: Measurements, time_s: Array, rows: Index
) -> dict[str, list[Array]]:
    """Distances, m, of the static and the tracked model at each block, before it is used."""
    tracked, static = first, f"static, {model}"
    found: dict[str, list[Array]] = {static: [], f"tracked, {model}": []}
    before_s = float(time_s[rows[0]])
    for at in _blocks(rows):
        block, now_s = data.take(at), float(time_s[at[-1]])
        for name, cell in zip(found, (first.cell, tracked.cell), strict=True):
            found[name].append(np.linalg.norm(cell.residual(block), axis=1))
        tracked = _update(tracked, block, now_s - before_s)
        before_s = now_s
    return found


def _refitted(arm: SerialArm, data: Measurements, rows: Index) -> list[Array]:
    """The same of a geometric model of all so far."""
    cell, found = None, []
    for at in _blocks(rows):
        chosen = np.linspace(0, at[0] - 1, MOST).astype(np.int64)
        cell = identify(arm, data.take(chosen), start=cell).cell
        found.append(np.linalg.norm(cell.residual(data.take(at)), axis=1))
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
