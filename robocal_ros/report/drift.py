"""What a shift's drift correction achieved: the numbers behind the page, its JSON and its CSV."""

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import summarise

Array = NDArray[np.float64]

TOLERANCE_MM = 0.1


@dataclass(frozen=True)
class Origin:
    """Where a report comes from.

    Attributes
    ----------
    simulated : True when any of its data are simulated; the page says so at its head.
    data : what the data are, in words.
    commit : version of the software.
    created : date of the report, ISO 8601.
    """

    simulated: bool
    data: str
    robot: str
    serial: str
    model_hash: str
    commit: str
    created: str


@dataclass(frozen=True)
class Decided:
    """What was decided after a cycle and why.

    ``predicted_mm`` is the rms error at the check poses expected from the covariance of the model
    in force, None when unknown.
    """

    cycle: str
    code: str
    reason: str
    revision: int
    rejected: Sequence[str] = ()
    predicted_mm: float | None = None


@dataclass(frozen=True, eq=False)
class DriftReport:
    """Errors of a tool at check poses over a shift, and how the model moved.

    Attributes
    ----------
    hours : (c,) time of each cycle since the start of the shift.
    decisions : one of each cycle.
    before, after : (c, m, 3) error at the check poses after each cycle, m, without and with
        correction, against the cold robot.
    held : (c, m, 3) with the correction that was in force just before the cycle: at its oldest.
    parameter_names : names with unit, ``d1_mm``.
    drift, sigma : (c, k) drift of the model in force and its standard deviation, in those units.
    """

    title: str
    origin: Origin
    hours: Array
    decisions: Sequence[Decided]
    before: Array
    after: Array
    held: Array
    parameter_names: Sequence[str]
    drift: Array
    sigma: Array

    def rows(self) -> list[tuple[str, dict[str, float]]]:
        """The summary: one line without correction, two with it."""
        return [
            ("without correction", figures_of(self.before)),
            ("with correction, after each cycle", figures_of(self.after)),
            ("with correction, before each cycle", figures_of(self.held)),
        ]

    def document(self) -> dict[str, Any]:
        """Everything as JSON."""
        origin = self.origin
        return {
            "title": self.title,
            "simulated": origin.simulated,
            "data": origin.data,
            "robot": origin.robot,
            "serial": origin.serial,
            "model_hash": origin.model_hash,
            "software": origin.commit,
            "created": origin.created,
            "tolerance_mm": TOLERANCE_MM,
            "errors": dict(self.rows()),
            "cycles": [self._cycle(i) for i in range(len(self.hours))],
        }

    def _cycle(self, i: int) -> dict[str, Any]:
        decided = self.decisions[i]
        names = self.parameter_names
        return {
            "cycle": decided.cycle,
            "hours": float(self.hours[i]),
            "verdict": {
                "accept": decided.code == "ACCEPT",
                "code": decided.code,
                "reason": decided.reason,
            },
            "revision": decided.revision,
            "rejected": list(decided.rejected),
            "predicted_rms_mm": decided.predicted_mm,
            "before": figures_of(self.before[i]),
            "after": figures_of(self.after[i]),
            "oldest": figures_of(self.held[i]),
            "drift": dict(zip(names, self.drift[i].tolist(), strict=True)),
            "sigma": dict(zip(names, self.sigma[i].tolist(), strict=True)),
        }

    def table(self) -> str:
        """Every error as CSV, mm in base axes."""
        stream = io.StringIO()
        writer = csv.writer(stream, lineterminator="\n")
        kinds = {"before": self.before, "after": self.after, "oldest": self.held}
        axes = [f"{kind}_{axis}_mm" for kind in kinds for axis in "xyz"]
        writer.writerow(["cycle", "hours", "check_pose", *axes])
        for i, decided in enumerate(self.decisions):
            for pose in range(self.before.shape[1]):
                values = np.concatenate([errors[i, pose] for errors in kinds.values()]) * 1e3
                start = [decided.cycle, f"{self.hours[i]:.3f}", pose + 1]
                writer.writerow([*start, *(f"{value:.4f}" for value in values)])
        return stream.getvalue()


def read_report(document: Path, table: Path) -> DriftReport:
    """Read a report back from its JSON and its CSV (errors to 0.1 \u00b5m)."""
    found = json.loads(document.read_text(encoding="utf-8"))
    cycles = found["cycles"]
    with table.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))

    def errors(kind: str) -> Array:
        values = [[float(row[f"{kind}_{axis}_mm"]) for axis in "xyz"] for row in rows]
        return np.array(values).reshape(len(cycles), -1, 3) * 1e-3

    names = list(cycles[0]["drift"])
    return DriftReport(
        title=found["title"],
        origin=Origin(
            simulated=found["simulated"],
            data=found["data"],
            robot=found["robot"],
            serial=found["serial"],
            model_hash=found["model_hash"],
            commit=found["software"],
            created=found["created"],
        ),
        hours=np.array([cycle["hours"] for cycle in cycles]),
        decisions=[_decided(cycle) for cycle in cycles],
        before=errors("before"),
        after=errors("after"),
        held=errors("oldest"),
        parameter_names=names,
        drift=np.array([[cycle["drift"][name] for name in names] for cycle in cycles]),
        sigma=np.array([[cycle["sigma"][name] for name in names] for cycle in cycles]),
    )


def _decided(cycle: dict[str, Any]) -> Decided:
    verdict = cycle["verdict"]
    return Decided(
        cycle["cycle"],
        verdict["code"],
        verdict["reason"],
        cycle["revision"],
        cycle["rejected"],
        cycle["predicted_rms_mm"],
    )


def figures_of(error: Array) -> dict[str, float]:
    """Mean, rms, p95, max of the distances, mm, and the share of directions in tolerance.

    ``error`` is (..., 3), m; a direction is one coordinate at one pose.
    """
    found = summarise(error.reshape(-1, 3))
    within = np.abs(error) * 1e3 < TOLERANCE_MM
    return {
        "mean_mm": found.mean_m * 1e3,
        "rms_mm": found.rms_m * 1e3,
        "p95_mm": found.p95_m * 1e3,
        "max_mm": found.max_m * 1e3,
        "share_within_tolerance": float(np.mean(within)),
        "n": found.n,
    }
