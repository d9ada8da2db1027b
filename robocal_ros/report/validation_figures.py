"""Figures of a validated bag, from its document."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from robocal_ros.report.drift import TOLERANCE_MM, ShiftErrors
from robocal_ros.report.figures import (
    AFTER,
    BEFORE,
    FAINT,
    INK,
    OLDEST,
    STYLE,
    drift_over_time,
    error_by_pose,
    parameter_drift,
    png,
    svg,
    titled,
)
from robocal_ros.report.validation import NO_FAULT
from robocal_ros.report.validation_cell import CellCourse, cell_figure

Array = NDArray[np.float64]
Document = dict[str, Any]

MOST_NAMED = 8  # runs that have their name below the axis
DRIFT_CAPTION = (
    "The parameters that moved most in units of their own standard deviation; the band is two "
    "standard deviations. Single parameters can trade with each other: the errors decide."
)
CELL_CAPTION = (
    "Root mean square over the working poses of the programme, by the simulation's truth, against "
    "the cold robot with the taught tool. Below: share of all directions, of each hour, in a "
    "recording within one hour as it went; dashed: the goal of 95 %."
)
CYCLES_CAPTION = (
    "Measured at each cycle's own poses, in which the sensor's noise is contained. In force: the "
    "model from before, which never saw them. Candidate: each pose predicted from the others. "
    "Bound: 95 % of the errors were expected below it before the cycle."
)


@dataclass(frozen=True)
class Drawn:
    """A figure as it is shown and kept."""

    name: str
    caption: str
    svg: str
    png: bytes

    @classmethod
    def of(cls, name: str, caption: str, figure: Figure) -> "Drawn":
        """Draw it."""
        return cls(name, caption, svg(figure), png(figure))


@dataclass(frozen=True, eq=False)
class ModelDrift:
    """How the models of a session's cycles moved; see `figures.Drifted`."""

    hours: Array
    parameter_names: Sequence[str]
    drift: Array
    sigma: Array


def cell_drawn(course: CellCourse) -> Drawn:
    """The figure of a cell's course."""
    return Drawn.of("cell", CELL_CAPTION, cell_figure(course))


def thermal_figures(
    cycles: Sequence[Document], truth: ShiftErrors | None, mark: str = ""
) -> list[Drawn]:
    """Figures of a thermal session: errors, and how the model moved; ``mark`` ends their titles."""
    found = []
    if truth is not None:
        caption = "True error at poses that were never measured"
        found.append(Drawn.of("true_error", caption, drift_over_time(truth)))
        found.append(Drawn.of("poses", "True error of each check pose", error_by_pose(truth)))
    if not cycles:
        return found
    found.append(Drawn.of("cycles", CYCLES_CAPTION, accuracy_by_cycle(cycles, mark)))
    names = list(cycles[0]["drift"])
    moved = ModelDrift(
        hours=np.array([cycle["hours"] for cycle in cycles]),
        parameter_names=names,
        drift=np.array([list(cycle["drift"].values()) for cycle in cycles]),
        sigma=np.array([list(cycle["sigma"].values()) for cycle in cycles]),
    )
    found.append(Drawn.of("drift", DRIFT_CAPTION, parameter_drift(moved)))
    return found


def accuracy_by_cycle(cycles: Sequence[Document], mark: str = "") -> Figure:
    """Rms errors of each cycle without correction, in force and candidate, and the bound."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.6), layout="constrained")
        axes = figure.add_subplot()
        hours = [cycle["hours"] for cycle in cycles]
        for key, color, label in (
            ("nominal", BEFORE, "without correction"),
            ("in_force", OLDEST, "in force, before the cycle"),
            ("candidate", AFTER, "candidate"),
        ):
            rms = [cycle[key]["rms_mm"] for cycle in cycles]
            axes.plot(hours, rms, "o-", color=color, ms=4, lw=1.8, label=label)
        known = [cycle for cycle in cycles if cycle["forecast"] is not None]
        if known:
            bound = [cycle["forecast"]["bound_mm"] for cycle in known]
            axes.plot(
                [cycle["hours"] for cycle in known], bound, color=INK, lw=1.0, ls=(0, (2, 2)),
                label="95 % bound",
            )  # fmt: skip
        faults = [cycle for cycle in cycles if cycle["verdict"]["code"] not in NO_FAULT]
        if faults:
            axes.plot(
                [cycle["hours"] for cycle in faults],
                [cycle["candidate"]["rms_mm"] for cycle in faults],
                "x", color=BEFORE, ms=9, mew=1.6, ls="none", label="refused",
            )  # fmt: skip
        xlabel = "hours since the cold reference"
        if taken := [cycle["hours"] for cycle in cycles if cycle["revision"]]:
            axes.plot(taken, [0.0] * len(taken), "^", color=AFTER, ms=5, clip_on=False, zorder=5)
            xlabel += "   (triangle: a new model came into force)"
        axes.axhline(TOLERANCE_MM, color=FAINT, lw=0.8, ls=(0, (4, 3)))
        axes.set(xlabel=xlabel, ylabel="rms error, mm", ylim=(0.0, None))
        titled(axes, f"Held-out error at each cycle's poses{mark}")
    return figure


def tool_figures(runs: Sequence[Document], mark: str = "") -> list[Drawn]:
    """The history of a tool: by how much each run found it moved."""
    known = [run for run in runs if run["change_mm"] is not None]
    if not known:
        return []
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.0), layout="constrained")
        axes = figure.add_subplot()
        few = len(known) <= MOST_NAMED
        hours = [(run["stamp"] - known[0]["stamp"]) / 3600.0 for run in known]
        places = list(range(len(known))) if few else hours
        for accepted, color, label in (
            (True, AFTER, "right, or measured anew"),
            (False, BEFORE, "not right, or refused"),
        ):
            chosen = [i for i, run in enumerate(known) if run["verdict"]["accept"] is accepted]
            if chosen:
                change = np.array([known[i]["change_mm"] for i in chosen])
                two_sigma = 2.0 * np.array([known[i]["sigma_mm"] or 0.0 for i in chosen])
                axes.errorbar(
                    [places[i] for i in chosen], change, [np.minimum(two_sigma, change), two_sigma],
                    fmt="o", color=color, ms=5 if few else 3.5, capsize=3 if few else 0,
                    clip_on=False, label=label,
                )  # fmt: skip
        axes.set(ylabel="change of the tip, mm", ylim=(0.0, None))
        if few:
            axes.set_xticks(places, [f"run {run['run']}\n{run['answer']}" for run in known])
            axes.margins(x=0.1)
        else:
            axes.set_xlabel("hours since the first run")
        titled(axes, f"Change of the tool that each run found{mark}")
    caption = "Against the tool in force at the run, with two standard deviations."
    return [Drawn.of("tool", caption, figure)]
