# SPDX-License-Identifier: Apache-2.0
"""How accurate the cell was, by the truth, against the same shift without its suite."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.closed_loop.plant import PASS_S, REST_S
from bench.closed_loop.shift import HOUR_S, ShiftPlan, ShiftRecord
from robocal_ros.thermal.accuracy import AccuracyLevel
from robocal_ros.thermal.screening import THRESHOLD_M

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
        share = float(np.mean(np.abs(error) <= THRESHOLD_M))
        return cls(_rms(length), float(np.quantile(length, 0.95)), share)


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


@dataclass(frozen=True)
class Harm:
    """How much worse the suite made it, m; negative where it did good.

    Attributes
    ----------
    rms_m : over all working poses and passes; ``p99_m`` : their 99 % quantile.
    cycle_m : rms of the worst cycle of those that are asked for; not a number where none was made.
    refused : passes that only the shift without the suite produced. They are in no other figure;
        where they are all, these are not a number.
    """

    rms_m: float
    p99_m: float
    cycle_m: float
    refused: int


def harm(with_suite: ShiftRecord, without: ShiftRecord, after: int = -1) -> Harm:
    """Compare two shifts of one seed, pass by pass where both produced.

    ``after`` : the worst cycle is one of those after this one.
    """
    both = [
        (a.cycle, a.error, b.error)
        for a, b in zip(with_suite.passes, without.passes, strict=True)
        if b.error is not None
    ]
    made = [(cycle, on, off) for cycle, on, off in both if on is not None]
    refused = len(both) - len(made)
    if not made:
        return Harm(np.nan, np.nan, np.nan, refused)
    cycle = np.array([number for number, _, _ in made])
    on, off = (np.linalg.norm([one[i] for one in made], axis=-1) for i in (1, 2))
    return Harm(
        _rms(on) - _rms(off),
        float(np.quantile(on, 0.99) - np.quantile(off, 0.99)),
        max(
            (_rms(on[cycle == c]) - _rms(off[cycle == c]) for c in np.unique(cycle) if c > after),
            default=np.nan,
        ),
        refused,
    )


def _rms(length: Array) -> float:
    return float(np.sqrt(np.mean(length**2)))


def gaps_to_recover(record: ShiftRecord, after_s: float, tolerance_m: float) -> int:
    """Gaps from an incident until each pass is within tolerance again, up to the next incident.

    A pass is where 95 % of its errors are; one that was refused is not. All gaps of the shift
    where the last pass is not.
    """
    plan = record.plan
    until_s = min((i.at_s for i in plan.incidents if i.at_s > after_s), default=np.inf)
    passes = [one for one in record.passes if after_s < one.time_s <= until_s]
    bad = [one.error is None or Figures.of(one.error).p95_m > tolerance_m for one in passes]
    first_good = max((i + 1 for i, is_bad in enumerate(bad) if is_bad), default=0)
    if first_good == len(passes):
        return plan.cycles
    return passes[first_good].cycle - sum(begin_s < after_s for begin_s in plan.begins_s)


def refused(record: ShiftRecord, hours: Collection[int]) -> int:
    """Passes that were refused in these hours of the shift, the first is 0."""
    return sum(one.error is None and one.time_s // HOUR_S in hours for one in record.passes)


def incident_hours(plan: ShiftPlan) -> dict[int, str]:
    """What goes wrong in which hour of a shift, the first is 0."""
    return {int(one.at_s // HOUR_S): one.fault for one in plan.incidents}


def within_at_worst(record: ShiftRecord, at_s: float) -> float:
    """Share of directions below 0.1 mm in an incident's hour, had it come right after a gap.

    All passes between the two gaps are then as the last of them really was; one that was refused
    has no direction below it.
    """
    begun = [one.cycle for one in record.passes if one.time_s - PASS_S - REST_S <= at_s]
    hit = max(begun, default=0)
    last = [one.error for one in record.passes if one.cycle == hit][-1:]
    hour = [one for one in record.passes if one.time_s // HOUR_S == at_s // HOUR_S]
    errors = [last[0] if one.cycle == hit else one.error for one in hour]
    return float(np.mean([0.0 if e is None else Figures.of(e).within for e in errors]))
