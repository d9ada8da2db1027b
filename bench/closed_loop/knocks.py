# SPDX-License-Identifier: Apache-2.0
"""What a knock of station, sensor or sphere costs, in many cells. Simulated.

In each cell one of the station's faults and one of the others is tried, of a size of its sweep:
fault and size go on with the seed, so that each comes up in several cells.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

import numpy as np

from bench.closed_loop.checks import SEEDS
from bench.closed_loop.faults import AFTER, CLEAN, SWEEP, Trial
from bench.closed_loop.judging import harm
from bench.closed_loop.shift import ShiftRecord
from bench.closed_loop.tables import FAULTY_RMS_M, MM
from bench.closed_loop.trials import run_all
from bench.tables import Goal, Table
from robocal_ros.cell_sim.faults import Fault
from robocal_ros.ground.errors import Code

STATION: tuple[Fault, ...] = ("station_knocked", "station_knocked_shift", "station_knocked_turn")
OTHERS: tuple[Fault, ...] = ("sensor_knocked", "sphere_knocked")
Found = tuple[Trial, float, set[Code]]  # how much worse the worst cycle is, m, and what was said


def trials(seeds: Sequence[int]) -> list[Trial]:
    """A trial of the station and one of sensor or sphere in each cell."""
    found = []
    for faults in (STATION, OTHERS):
        for number, seed in enumerate(seeds):
            fault = faults[number % len(faults)]
            sizes = SWEEP[fault]
            found.append(Trial(fault, sizes[number // len(faults) % len(sizes)], seed, AFTER))
    return found


def found_in(trial: Trial, on: ShiftRecord, off: ShiftRecord) -> Found:
    """Of a short shift with the suite and without it."""
    results = [gap.result for gap in on.gaps[CLEAN:] if gap.result is not None]
    codes = {r.tool_code for r in results} | {r.tool_found_code for r in results}
    codes |= {r.thermal_code for r in results}
    return trial, harm(on, off, after=CLEAN).cycle_m, codes - {Code.NONE, Code.ACCEPT}


def tables() -> Sequence[Table]:
    """The worst of each fault, on all cores."""
    tried = trials(SEEDS)
    with ProcessPoolExecutor(os.cpu_count()) as pool:
        of = run_all(pool, [(t.plan, t.seed, suite) for t in tried for suite in (True, False)])
    found = [found_in(t, *(of[t.plan, t.seed, suite] for suite in (True, False))) for t in tried]
    table = Table(
        "closed_loop_knocks",
        f"Knocks of station, sensor and sphere, one of each kind in {len(SEEDS)} cells",
        ("fault", "cells", "sizes", "worst cycle worse by, mm", "goal", "stood", "codes"),
        "Simulated: one gap, then the knock, then two gaps. Worse: rms error of the production "
        "after a gap from the knock on, with the suite less without it. Stood: nothing was made.",
    )
    for fault in (*STATION, *OTHERS):
        own = [one for one in found if one[0].fault == fault]
        worst = np.array([cycle_m for _, cycle_m, _ in own])
        made = worst[np.isfinite(worst)]
        codes = sorted({code.name for _, _, told in own for code in told})
        sizes = ", ".join(f"{size:g}" for size in sorted({one[0].size for one in own}))
        most = MM * float(np.max(made)) if len(made) else np.nan
        table.add(
            fault, len(own), sizes, most, Goal(most, MM * FAULTY_RMS_M), len(own) - len(made),
            ", ".join(codes),
        )  # fmt: skip
    return [table]
