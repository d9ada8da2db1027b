"""How accurate a cell was, hour by hour, by what its bag tells of the truth and told the line."""

from array import array
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.replay import topic_kind
from robocal_ros.cell_sim.cell_faults import SIZES
from robocal_ros.cli.bag_truth import BagTruth, ToldStates, above, finite
from robocal_ros.report.validation_cell import CellCourse

Array = NDArray[np.float64]

HOUR_NS = 3.6e12
ACCURACY = "accuracy_state"
UNITS: dict[str, tuple[float, str]] = {
    fault: (factor, unit) for fault, (_, factor, unit) in SIZES.items()
}


@dataclass(eq=False)
class _Line:
    """What the line read: stamps, ns; 95 % bound, nan where not known, and allowed error, mm."""

    stamp_ns: "array[int]" = field(default_factory=lambda: array("q"))
    bound_mm: "array[float]" = field(default_factory=lambda: array("d"))
    tolerance_mm: float | None = None

    def at(self, stamp_ns: Array) -> Array:
        """The bound that was told last at each time; not a number before any."""
        bound_mm = np.array([np.nan, *self.bound_mm])
        return bound_mm[np.searchsorted(self.stamp_ns, stamp_ns, side="right")]


def cell_courses(reader: BagReader, truth: BagTruth) -> list[CellCourse]:
    """The course of the true error of each cell that a bag tells of.

    Raises
    ------
    InputError
        When it cannot be read.
    """
    if not truth.states:
        return []
    told = [topic for topic in reader.info.topics if topic_kind(topic) == ACCURACY]
    lines = {truth.state_topic(above(topic)): topic for topic in told}
    return [
        _course(topic, states, _line(reader, truth, lines.get(topic)), reader.info.start_ns or 0)
        for topic, states in truth.states.items()
    ]


def _course(topic: str, states: ToldStates, line: _Line, start_ns: int) -> CellCourse:
    series = {name: np.array(values) for name, values in states.series.items()}
    return CellCourse(
        topic=topic,
        hours=(np.array(states.stamp_ns) - start_ns) / HOUR_NS,
        without_mm=1e3 * series["without_m"],
        with_mm=1e3 * series["with_m"],
        p95_mm=1e3 * series["p95_m"],
        lambda_without=series["lambda_without"],
        lambda_with=series["lambda_with"],
        bound_mm=line.at(np.array(states.stamp_ns)),
        tolerance_mm=line.tolerance_mm,
        faults=[
            {"hours": (stamp_ns - start_ns) / HOUR_NS, "fault": fault, "size": size}
            | {"told": _told(fault, size)}
            for stamp_ns, fault, size in states.faults
        ],
    )


def _told(fault: str, size: float) -> str:
    """A size in the fault's own unit; empty where it ended."""
    factor, unit = UNITS.get(fault, (1.0, ""))
    return f"{size / factor:.4g} {unit}".strip() if size else ""


def _line(reader: BagReader, truth: BagTruth, topic: str | None) -> _Line:
    line = _Line()
    if topic is None:
        return line
    with truth.reading(topic):
        for recorded in reader.messages([topic]):
            told = recorded.message
            bound_mm = finite(told.bound_mm, "bound_mm")
            line.stamp_ns.append(recorded.log_time_ns)
            line.bound_mm.append(bound_mm if bound_mm >= 0.0 else np.nan)
            line.tolerance_mm = finite(told.tolerance_mm, "tolerance_mm")
    return line
