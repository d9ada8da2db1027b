"""What a thermal session brought, cycle by cycle and altogether, as a document."""

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.output import Document
from robocal_ros.cli.validating_thermal import CycleErrors, ReplayedCycle
from robocal_ros.kinematics import SerialArm
from robocal_ros.report.drift import TOLERANCE_MM, ShiftErrors

Array = NDArray[np.float64]


def thermal_document(cycles: Sequence[ReplayedCycle], arm: SerialArm) -> Document:
    """Every cycle, and the errors of all of them together."""
    measured = [c.measured for c in cycles if c.measured is not None]
    true = [c.true for c in cycles if c.true is not None]
    return {
        "cycles": [_cycle(cycle, arm) for cycle in cycles],
        "tolerance_mm": TOLERANCE_MM,
        "measured": together(measured),
        "true": together(true),
        "bound": _kept(cycles),
    }


def together(errors: Sequence[CycleErrors]) -> Document | None:
    """Figures over all cycles; None where there are none."""
    if not errors:
        return None
    after = [e.after for e in errors if e.after is not None]
    return CycleErrors(
        np.concatenate([e.without for e in errors]),
        np.concatenate([e.in_force for e in errors]),
        np.concatenate(after) if after else None,
    ).document()


def _cycle(cycle: ReplayedCycle, arm: SerialArm) -> Document:
    entry, found = cycle.entry, cycle.document
    names, unit = arm.parameters.names, arm.parameters.to_display
    return {
        "cycle": entry.cycle_id,
        "stamp": entry.stamp_ns * 1e-9,
        "hours": cycle.hours,
        "samples": found["samples"],
        "nominal": found["nominal"]["held_out"],
        "in_force": found["in_force"]["held_out"],
        "candidate": found["calibrated"]["held_out"],
        "predicted_rms_mm": found["calibrated"]["predicted"]["total_rms_mm"],
        "forecast": cycle.forecast,
        "measured": None if cycle.measured is None else cycle.measured.document(),
        "true": None if cycle.true is None else cycle.true.document(),
        "verdict": found["verdict"],
        "revision": entry.revision,
        "based_on": entry.based_on,
        "rejected": found["rejected"],
        "unobservable": found["unobservable"],
        "drift": dict(zip(names, (cycle.drift * unit).tolist(), strict=True)),
        "sigma": dict(zip(names, (cycle.sigma * unit).tolist(), strict=True)),
    }


def _kept(cycles: Sequence[ReplayedCycle]) -> Document:
    """Shares of the errors of the model in force below the 95 % bound expected beforehand."""
    return {
        "measured_share": _share(cycles, lambda cycle: cycle.measured),
        "true_share": _share(cycles, lambda cycle: cycle.true),
    }


def _share(
    cycles: Sequence[ReplayedCycle], errors: Callable[[ReplayedCycle], CycleErrors | None]
) -> float | None:
    below: list[Array] = []
    for cycle in cycles:
        known = errors(cycle)
        if known is not None and cycle.forecast is not None:
            bound_m = cycle.forecast["bound_mm"] * 1e-3
            below.append(np.linalg.norm(known.in_force, axis=1) <= bound_m)
    return float(np.mean(np.concatenate(below))) if below else None


def shift_errors(cycles: Sequence[ReplayedCycle]) -> ShiftErrors | None:
    """Errors of the cycles that a truth judges; None without any."""
    judged = [(c, c.true) for c in cycles if c.true is not None and c.true.after is not None]
    if not judged:
        return None
    return ShiftErrors(
        hours=np.array([c.hours for c, _ in judged]),
        accepted=[c.entry.revision > 0 for c, _ in judged],
        before=np.array([true.without for _, true in judged]),
        after=np.array([true.after for _, true in judged]),
        held=np.array([true.in_force for _, true in judged]),
    )
