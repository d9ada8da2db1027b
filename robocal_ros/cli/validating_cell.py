"""How accurate a cell was, hour by hour, by what its bag tells of the truth and told the line."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.bag_truth import told_states
from robocal_ros.cli.output import Document
from robocal_ros.report.validation_cell import CellCourse
from robocal_ros.sessions.replay import topic_kind
from robocal_ros.sim.cell_faults import SIZES
from robocal_ros.storage.bags import BagReader

Array = NDArray[np.float64]

HOUR_S = 3600.0
ACCURACY = "accuracy_state"
KEYS = {  # of a state, by what it is called here, the first that is told; lengths come in m
    "without_mm": ("visited_tcp_error_rms_m", "tcp_error_rms_m"),
    "with_mm": ("commanded_tcp_error_rms_m",),
    "p95_mm": ("commanded_tcp_error_p95_m",),
    "lambda_without": ("visited_within_share", "within_share"),
    "lambda_with": ("commanded_within_share",),
}
UNITS: dict[str, tuple[float, str]] = {
    fault: (factor, unit) for fault, (_, factor, unit) in SIZES.items()
}


@dataclass(frozen=True, eq=False)
class _Line:
    """What the line read: stamps, s; 95 % bound and allowed error, mm."""

    time_s: Array
    bound_mm: Array
    tolerance_mm: float | None


def cell_course(reader: BagReader) -> CellCourse | None:
    """The course of the true error that a bag tells; None where it tells none.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    states = told_states(reader)
    if not states:
        return None
    start_ns = reader.info.start_ns or states[0][0]
    time_s = np.array([1e-9 * (stamp - start_ns) for stamp, _ in states])
    line = _line(reader, start_ns)
    truths = [truth for _, truth in states]
    series = {name: _series(truths, keys, name) for name, keys in KEYS.items()}
    return CellCourse(
        hours=time_s / HOUR_S,
        bound_mm=_held(line, time_s),
        tolerance_mm=line.tolerance_mm,
        faults=_faults(time_s / HOUR_S, truths),
        **series,
    )


def _series(truths: Sequence[Mapping[str, Any]], keys: Sequence[str], name: str) -> Array:
    scale = 1e3 if name.endswith("_mm") else 1.0
    told = [next((truth[key] for key in keys if key in truth), np.nan) for truth in truths]
    return scale * np.array(told, dtype=np.float64)


def _faults(hours: Array, truths: Sequence[Mapping[str, Any]]) -> list[Document]:
    """Each fault as it began, changed or ended (size 0)."""
    found: list[Document] = []
    before: Mapping[str, float] = {}
    for hour, truth in zip(hours.tolist(), truths, strict=True):
        now: Mapping[str, float] = truth.get("faults", {})
        for name in sorted({*now, *before}):
            if now.get(name) != before.get(name):
                size = float(now.get(name, 0.0))
                told = {"hours": hour, "fault": name, "size": size, "told": _told(name, size)}
                found.append(told)
        before = now
    return found


def _told(fault: str, size: float) -> str:
    """A size in the fault's own unit; empty where it ended."""
    factor, unit = UNITS.get(fault, (1.0, ""))
    return f"{size / factor:.4g} {unit}".strip() if size else ""


def _line(reader: BagReader, start_ns: int) -> _Line:
    topics = [topic for topic in reader.info.topics if topic_kind(topic) == ACCURACY]
    told = [(m.log_time_ns, m.message) for m in reader.messages(topics[:1])] if topics else []
    bound = [m.bound_mm if m.bound_mm >= 0.0 else np.nan for _, m in told]
    return _Line(
        time_s=np.array([1e-9 * (stamp - start_ns) for stamp, _ in told]),
        bound_mm=np.array(bound, dtype=np.float64),
        tolerance_mm=float(told[-1][1].tolerance_mm) if told else None,
    )


def _held(line: _Line, time_s: Array) -> Array:
    """The bound that was told last at each time; not a number before any."""
    if not len(line.time_s):
        return np.full(len(time_s), np.nan)
    at = np.searchsorted(line.time_s, time_s, side="right") - 1
    return np.where(at >= 0, line.bound_mm[np.maximum(at, 0)], np.nan)
