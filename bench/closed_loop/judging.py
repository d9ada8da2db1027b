"""How accurate the cell was, by the truth, against the same shift without its suite."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.closed_loop.shift import HOUR_S, ShiftRecord
from robocal_ros.core.thermal.accuracy import AccuracyLevel
from robocal_ros.core.thermal.drift_history import THRESHOLD_M

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Figures:
    """Of many errors (..., 3), m; ``within``: share of directions below 0.1 mm."""

    rms_m: float
    p95_m: float
    within: float

    @classmethod
    def of(cls, error: Array) -> "Figures":
        """Take them all together; not a number where there are none."""
        if not error.size:
            return cls(np.nan, np.nan, np.nan)
        length = np.linalg.norm(error, axis=-1)
        rms = float(np.sqrt(np.mean(length**2)))
        share = float(np.mean(np.abs(error) <= THRESHOLD_M))
        return cls(rms, float(np.quantile(length, 0.95)), share)


def per_hour(record: ShiftRecord) -> list[Figures]:
    """One for each hour of the shift."""
    time_s, error = record.errors()
    hour = (time_s // HOUR_S).astype(int)
    return [Figures.of(error[hour == h]) for h in range(round(record.plan.hours))]


@dataclass(frozen=True)
class Stated:
    """What the line was told, beside what was true.

    Attributes
    ----------
    below : share of the true errors that lie below the stated 95 % bound, in all passes.
    bound_m, p95_m : mean of the stated bounds and 95 % quantile of the true errors, before
        ``until_s``.
    levels : share of the passes at each level, before ``until_s``.
    """

    below: float
    bound_m: float
    p95_m: float
    levels: Mapping[AccuracyLevel, float]


def stated(records: Sequence[ShiftRecord], until_s: float = np.inf) -> Stated:
    """Of several shifts together: every working pose of each pass for which a bound was told."""
    told = [
        (one.time_s, np.linalg.norm(one.error, axis=1), one.accuracy.error.bound_m)
        for record in records
        for one in record.passes
        if one.error is not None and one.accuracy is not None and one.accuracy.error is not None
    ]
    early = [(error, bound_m) for time_s, error, bound_m in told if time_s < until_s]
    levels = [
        one.accuracy.level
        for record in records
        for one in record.passes
        if one.accuracy is not None and one.time_s < until_s
    ]
    return Stated(
        float(np.mean([error < bound_m for _, error, bound_m in told])),
        float(np.mean([bound_m for _, bound_m in early])),
        float(np.quantile([error for error, _ in early], 0.95)),
        {level: levels.count(level) / len(levels) for level in AccuracyLevel},
    )


def cycle_rms(record: ShiftRecord) -> dict[int, float]:
    """Rms error, m, of the production after each gap, where there was any."""
    found: dict[int, list[Array]] = {}
    for one in record.passes:
        if one.error is not None:
            found.setdefault(one.cycle, []).append(one.error)
    return {cycle: Figures.of(np.array(errors)).rms_m for cycle, errors in found.items()}


@dataclass(frozen=True)
class Harm:
    """How much worse the suite made it, m; negative where it did good.

    Attributes
    ----------
    rms_m : over all working poses and passes; ``p99_m`` : their 99 % quantile.
    cycle_m : rms of the worst cycle.
    """

    rms_m: float
    p99_m: float
    cycle_m: float


def harm(with_suite: ShiftRecord, without: ShiftRecord) -> Harm:
    """Compare two shifts of one seed, pass by pass where both produced."""
    pairs = [
        (a.error, b.error)
        for a, b in zip(with_suite.passes, without.passes, strict=True)
        if a.error is not None and b.error is not None
    ]
    if not pairs:
        return Harm(0.0, 0.0, 0.0)
    on, off = (np.linalg.norm(np.array(part), axis=-1) for part in zip(*pairs, strict=True))
    cycles, others = cycle_rms(with_suite), cycle_rms(without)
    return Harm(
        float(np.sqrt(np.mean(on**2)) - np.sqrt(np.mean(off**2))),
        float(np.quantile(on, 0.99) - np.quantile(off, 0.99)),
        max(rms_m - others[cycle] for cycle, rms_m in cycles.items()),
    )


def gaps_to_recover(record: ShiftRecord, after_s: float, tolerance_m: float) -> int:
    """Gaps from a time until 95 % of the errors of a pass are within tolerance again.

    All gaps of the shift where they never are.
    """
    before = int(after_s // record.plan.every_s)  # gaps that had begun by then, the first at 0
    for one in record.passes:
        if one.error is None or one.time_s <= after_s:
            continue
        if Figures.of(one.error).p95_m <= tolerance_m:
            return one.cycle - before
    return record.plan.cycles
