"""What many validated bags say together: one row for each, and the tables beside the page."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from robocal_ros.estimation.assessment import summarise
from robocal_ros.ground.frames import Array, Document

TOLERANCE_MM = 0.1

ERRORS = ("without", "in_force", "after")
MEASURED = {"without": "nominal", "in_force": "in_force", "candidate": "candidate"}
ERROR_KEYS = ("mean_mm", "rms_mm", "p95_mm", "max_mm", "share_within_tolerance")
NO_FAULT = ("ACCEPT", "NO_SIGNIFICANT_GAIN", "WORSE_THAN_CURRENT")  # the last: the model stays
CYCLE = ("bag", "cycle", "stamp", "hours", "samples", "code", "revision")
DECISION = ("bag", "node", "stamp", "command", "code", "message")
HOUR = (
    "bag", "topic", "hour", "minutes", "rms_without_mm", "rms_with_mm", "lambda_without",
    "lambda_with", "bound_mm", "p95_mm", "time_below_bound",
)  # fmt: skip


def summary_rows(bags: Sequence[Document]) -> list[Document]:
    """A row for each session of each bag; one with ``error`` for a bag that gave none.

    One with ``skipped``, which says why, for a session that could not be replayed.
    """
    rows = []
    for bag in bags:
        if "error" in bag:
            rows.append({"bag": bag["bag"], "kind": None, "error": bag["error"]})
        rows += [_row(bag, session) for session in bag.get("sessions", [])]
        rows += [
            {"bag": bag["bag"], "kind": None, "node": node, "skipped": why}
            for node, why in bag.get("skipped", {}).items()
        ]
    return rows


def _row(bag: Document, session: Document) -> Document:
    refused = [d for d in session["decisions"] if d["code"] not in NO_FAULT]
    if session["kind"] == "thermal":
        own = _thermal(session)
    elif session["kind"] == "tool":
        own = {"runs": len(session["runs"])}
        for name in ("change_mm", "true_error_mm"):
            known = [run[name] for run in session["runs"] if run[name] is not None]
            own[f"largest_{name}"] = max(known, default=None)
    else:
        last = (session["calibrations"] or [{}])[-1]
        own = {"calibrations": len(session["calibrations"])}
        for key in ("residual_rms_mm", "predicted_rms_mm", "true_error_mm"):
            own[key] = last.get(key)
    return {
        "bag": bag["bag"],
        "kind": session["kind"],
        "node": session["node"],
        "robot": session["robot"],
        "simulated": bag["simulated"],
        "duration_s": bag["duration_s"],
        "as_recorded": session["as_recorded"],
        "differs": len(session["differs"]),
        "decisions": len(session["decisions"]),
        "refused": len(refused),
        "warnings": len(session["warnings"]),
        **own,
    }


def _thermal(session: Document) -> Document:
    """Errors by the truth where the bag has one, else those of the verdicts.

    What was in force after a cycle only the truth knows; by measurements there is what the
    candidates promised, those too that nobody accepted.
    """
    cycles, true, measured = session["cycles"], session["true"], session["measured"] or {}
    rms = dict.fromkeys((*ERRORS, *MEASURED))
    if true is not None:
        rms |= {name: true[name]["rms_mm"] for name in ERRORS}
    else:
        rms |= {name: pooled_rms_mm(cycles, judged) for name, judged in MEASURED.items()}
    shares = {
        name: (true or measured).get(name, {}).get("share_within_tolerance") for name in ERRORS
    }
    return {
        "cycles": len(cycles),
        "accepted": sum(cycle["revision"] > 0 for cycle in cycles),
        "judged_by": "truth" if true is not None else "measurements",
        **{f"rms_{name}_mm": value for name, value in rms.items()},
        **{f"lambda_{name}": value for name, value in shares.items()},
        "share_below_bound": session["bound"]["measured_share" if true is None else "true_share"],
    }


def pooled_rms_mm(cycles: Sequence[Document], key: str) -> float | None:
    """Rms over the held-out measurements of all cycles; None without cycles."""
    if not cycles:
        return None
    n = np.array([cycle[key]["n"] for cycle in cycles])
    rms = np.array([cycle[key]["rms_mm"] for cycle in cycles])
    return float(np.sqrt(np.sum(n * rms**2) / np.sum(n)))


def bags_table(bags: Sequence[Document]) -> str:
    """The rows as CSV."""
    rows = [
        {**row, "error": f"{row['error']['code']}: {row['error']['message']}"}
        if "error" in row
        else row
        for row in summary_rows(bags)
    ]
    return _csv(rows)


def cycles_table(bags: Sequence[Document]) -> str:
    """Every thermal cycle as CSV."""
    rows = []
    for bag, cycle in thermal_cycles(bags):
        row = {name: cycle[name] for name in ("cycle", "stamp", "hours", "samples")}
        row |= {"code": cycle["verdict"]["code"], "revision": cycle["revision"]}
        for name in ("nominal", "in_force", "candidate"):
            row[f"{name}_rms_mm"] = cycle[name]["rms_mm"]
        row |= {
            "predicted_rms_mm": cycle["predicted_rms_mm"],
            "bound_mm": (cycle["forecast"] or {}).get("bound_mm"),
        }
        for judge in ("measured", "true"):
            for name in ERRORS:
                found = (cycle[judge] or {}).get(name) or {}
                row |= {f"{judge}_{name}_{key}": found.get(key) for key in ERROR_KEYS}
        row |= {f"drift_{name}": value for name, value in cycle["drift"].items()}
        row |= {f"sigma_{name}": value for name, value in cycle["sigma"].items()}
        rows.append({"bag": bag["bag"], **row, "reason": cycle["verdict"]["reason"]})
    return _csv(rows, CYCLE)


def thermal_cycles(bags: Sequence[Document]) -> list[tuple[Document, Document]]:
    """Every bag's thermal cycles, each with its bag."""
    return [
        (bag, cycle)
        for bag in bags
        for session in bag.get("sessions", [])
        if session["kind"] == "thermal"
        for cycle in session["cycles"]
    ]


def decisions_table(bags: Sequence[Document]) -> str:
    """Every decision as CSV."""
    rows = []
    for bag in bags:
        sessions = [(session["node"], session["decisions"]) for session in bag.get("sessions", [])]
        for node, decisions in [*sessions, *bag.get("other_decisions", {}).items()]:
            rows += [{"bag": bag["bag"], "node": node, **decision} for decision in decisions]
    return _csv(rows, DECISION)


def hours_table(bags: Sequence[Document]) -> str:
    """Every hour of each simulated cell as CSV."""
    return _csv(
        [
            {"bag": bag["bag"], "topic": cell["topic"], **hour}
            for bag in bags
            for cell in bag.get("cells", [])
            for hour in cell["by_hour"]
        ],
        HOUR,
    )


def _csv(rows: Sequence[Mapping[str, Any]], first: Sequence[str] = ()) -> str:
    """``first``: columns that a table without rows has too."""
    columns = list(dict.fromkeys((*first, *(name for row in rows for name in row))))
    stream = io.StringIO()
    writer = csv.DictWriter(stream, columns, lineterminator="\n")
    writer.writeheader()
    for row in rows:
        cells = {name: row.get(name) for name in columns}
        for name, value in cells.items():
            if isinstance(value, float) and abs(value) < 1e6:
                cells[name] = f"{value:.9g}"
        writer.writerow(cells)
    return stream.getvalue()


@dataclass(frozen=True, eq=False)
class ShiftErrors:
    """True errors of a simulated tool at check poses over a shift, against the cold robot.

    ``hours`` (c,) time of each cycle since the start of the shift.
    ``accepted``: of each cycle: whether its model came into force.
    ``before``, ``after`` (c, m, 3) error at the check poses after each cycle, m, without and with
    correction.
    ``held`` (c, m, 3) with the correction that was in force just before the cycle: at its oldest.
    """

    hours: Array
    accepted: Sequence[bool]
    before: Array
    after: Array
    held: Array


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
