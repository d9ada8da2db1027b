# SPDX-License-Identifier: Apache-2.0
"""Figures of reports, drawn without a display."""

import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FormatStrFormatter, MultipleLocator
from numpy.typing import NDArray

from robocal_ros.ground.frames import Array, Document
from robocal_ros.identification.known_model import KnownModel

BEFORE, AFTER, OLDEST = "#c2603a", "#0f6f86", "#7fb6c3"
INK, FAINT, GRID = "#22303a", "#6d7b85", "#e6eaed"
STYLE: Any = {  # matplotlib types its keys one by one
    "font.family": "sans-serif",
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 9.5,
    "axes.edgecolor": FAINT,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "axes.titlesize": 11,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.titlepad": 12,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.8,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": GRID,
    "grid.linewidth": 0.8,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "text.color": INK,
    "legend.frameon": False,
    "figure.facecolor": "white",
    "svg.hashsalt": "robocal",
    "svg.fonttype": "path",
}
SHOWN_PARAMETERS = 8
TOLERANCE_MM = 0.1
NO_FAULT = ("ACCEPT", "NO_SIGNIFICANT_GAIN", "WORSE_THAN_CURRENT")  # the last: the model stays
GREEK = {"theta": "\u03b8", "alpha": "\u03b1", "beta": "\u03b2"}


@dataclass(frozen=True, eq=False)
class ShiftErrors:
    """True errors of a simulated tool at check poses over a shift, against the cold robot.

    ``hours`` (c,) time of each cycle since the start of the shift. ``accepted``: of each cycle:
    whether its model came into force. ``before``, ``after`` (c, m, 3) error at the check poses
    after each cycle, m, without and with correction. ``held`` (c, m, 3) with the correction that
    was in force just before the cycle: at its oldest.
    """

    hours: Array
    accepted: Sequence[bool]
    before: Array
    after: Array
    held: Array


def distances_mm(error: Array) -> Array:
    """Lengths (...,) of errors (..., 3) in m, in mm."""
    return np.asarray(np.linalg.norm(error, axis=-1) * 1e3)


def drift_over_time(report: ShiftErrors) -> Figure:
    """Error at the check poses over the shift, without and with correction."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.6), layout="constrained")
        axes = figure.add_subplot()
        hours, poses = report.hours, report.before.shape[1]
        cold = np.zeros((1, poses))  # the error counts from the cold robot
        before = np.vstack([cold, distances_mm(report.before)])
        _band(axes, np.append(0.0, hours), before, BEFORE, "without correction")
        # a saw-tooth: the correction ages until a cycle renews it
        both = np.stack([distances_mm(report.held), distances_mm(report.after)], axis=1)
        x = np.append(0.0, np.repeat(hours, 2))
        _band(axes, x, np.vstack([cold, both.reshape(-1, poses)]), AFTER, "with correction")
        taken = hours[np.asarray(report.accepted, dtype=bool)]
        axes.plot(taken, np.zeros(len(taken)), "^", color=AFTER, ms=5, clip_on=False, zorder=5)
        axes.axhline(TOLERANCE_MM, color=FAINT, lw=0.8, ls=(0, (4, 3)))
        axes.set(
            xlabel="hours of production   (triangle: a new model came into force)",
            ylabel="error at check poses, mm",
            ylim=(0.0, None),
            xlim=(0.0, float(hours[-1]) * 1.001),
        )
        axes.yaxis.set_major_locator(MultipleLocator(TOLERANCE_MM))
        axes.set_title("Tool error over the shift: mean, and 5 to 95 % of poses (simulated)")
    return figure


def _band(axes: Axes, x: Array, values: Array, color: str, label: str) -> None:
    """Mean over the poses with the band that holds nine of ten."""
    low, high = np.quantile(values, [0.05, 0.95], axis=1)
    mean = values.mean(axis=1)
    axes.fill_between(x, low, high, color=color, alpha=0.16, lw=0)
    axes.plot(x, mean, color=color, lw=2.0, solid_joinstyle="round")
    at = int(0.98 * (len(x) - 1))
    axes.annotate(
        label, (x[at], mean[at]), xytext=(0, 7), textcoords="offset points",
        color=color, fontweight="bold", ha="right", va="bottom",
    )  # fmt: skip


def error_by_pose(report: ShiftErrors) -> Figure:
    """Error of each check pose: mean over the shift, and its range."""
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.4), layout="constrained")
        axes = figure.add_subplot()
        before, after = distances_mm(report.before), distances_mm(report.after)
        order = np.argsort(before.mean(axis=0))
        place = np.arange(1, len(order) + 1)
        for values, color, label, side in (
            (before[:, order], BEFORE, "without correction", -0.14),
            (after[:, order], AFTER, "with correction", 0.14),
        ):
            x = place + side
            axes.vlines(x, values.min(axis=0), values.max(axis=0), color=color, alpha=0.35, lw=3)
            axes.plot(x, values.mean(axis=0), "o", color=color, ms=4.5, label=label)
        axes.axhline(TOLERANCE_MM, color=FAINT, lw=0.8, ls=(0, (4, 3)))
        axes.set(
            xlabel="check pose, ordered by its error without correction",
            ylabel="error, mm",
            ylim=(0.0, None),
            xlim=(0.0, len(order) + 1.0),
        )
        axes.yaxis.set_major_locator(MultipleLocator(TOLERANCE_MM))
        axes.legend(loc="upper left", ncols=2, handletextpad=0.2)
        axes.grid(visible=False, axis="x")
        axes.set_title("Each check pose: mean and range over the shift (simulated)")
    return figure


def parameter_drift(cycles: Sequence[Document]) -> Figure:
    """Drift of the parameters that moved most in units of their sigma, with two sigma."""
    hours = [cycle["hours"] for cycle in cycles]
    drift, spread = (
        np.array([list(cycle[key].values()) for cycle in cycles]) for key in ("drift", "sigma")
    )
    names = list(cycles[0]["drift"])
    with mpl.rc_context(STYLE | {"axes.titlesize": 9.5, "axes.titlepad": 5, "font.size": 8.5}):
        figure = Figure(figsize=(8.0, 3.8), layout="constrained")
        size = np.max(np.abs(drift) / np.maximum(spread, 1e-12), axis=0)
        chosen = np.sort(np.argsort(-size)[:SHOWN_PARAMETERS])
        grid = figure.subplots(2, (len(chosen) + 1) // 2, sharex=True, squeeze=False).ravel()
        for axes, k in zip(grid, chosen, strict=False):
            value, sigma = drift[:, k], spread[:, k]
            low, high = value - 2.0 * sigma, value + 2.0 * sigma
            axes.fill_between(hours, low, high, step="post", color=AFTER, alpha=0.16, lw=0)
            axes.step(hours, value, where="post", color=AFTER, lw=1.6)
            axes.axhline(0.0, color=FAINT, lw=0.8)
            name, _, unit = names[k].rpartition("_")
            for word, letter in GREEK.items():
                name = name.replace(word, letter)
            axes.set_title(f"{name}, {unit}")
        for axes in grid[len(chosen) :]:
            axes.set_visible(False)
        figure.supxlabel("hours of production", fontsize=9, color=INK)
    return figure


def joint_functions_figure(known: KnownModel) -> Figure:
    """What each joint turns besides what is read, with the band that holds 95 % of the guesses."""
    arm = known.cell.arm
    shown = [int(joint) for joint in np.flatnonzero(known.terms.count)]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 1.5 * len(shown) + 0.6), layout="constrained")
        rows = figure.subplots(max(1, len(shown)), squeeze=False)[:, 0]
        for axes, joint in zip(rows, shown, strict=False):
            q = np.zeros((1000, arm.n))
            lower, upper = known.readings[[0, -1], joint]
            q[:, joint] = np.linspace(lower, upper, len(q))
            assert arm.functions is not None
            value = 1e6 * arm.functions.delta(q)[:, joint]
            band = 1.96e6 * known.function_sigma(q)[:, joint]
            x = q[:, joint] * (1e3 if arm.prismatic[joint] else np.degrees(1.0))
            axes.fill_between(x, value - band, value + band, color=OLDEST, alpha=0.6, lw=0)
            axes.plot(x, value, color=AFTER, lw=1.2)
            unit = "mm" if arm.prismatic[joint] else "deg"
            axes.set_title(f"{arm.joint_names[joint]}, {unit}")
            axes.set_ylabel("µm" if arm.prismatic[joint] else "µrad")
    return figure


def titled(axes: Axes, words: str) -> None:
    """A title, and between it and the axes the legend: there it covers nothing."""
    axes.set_title(words, pad=28)
    axes.legend(
        loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=5, fontsize=8, borderpad=0.2,
        borderaxespad=0.2, columnspacing=1.4, handletextpad=0.5,
    )  # fmt: skip


def svg(figure: Figure) -> str:
    """The figure as an SVG element for a page."""
    stream = io.StringIO()
    with mpl.rc_context(STYLE):
        figure.savefig(stream, format="svg", dpi=160, metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def png(figure: Figure, dpi: int = 160) -> bytes:
    """The figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


def draw_rounds(path: Path, document: Mapping[str, Any]) -> None:
    """Draw the share of directions within the threshold against the number of parameters left.

    ``document``: what ``robocal thermal screen --json`` prints. Rounds that the poses do not
    determine have no share and no point.
    """
    rounds = [row for row in document["rounds"] if row["share"] is not None]
    count = [row["parameters"] for row in rounds]
    share = [100.0 * row["share"] for row in rounds]
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 3.6), layout="constrained")
        axes = figure.add_subplot()
        axes.plot(count, share, "o-", color=AFTER)
        axes.axhline(100.0 * document["uncompensated"], color=BEFORE, lw=1.0)
        axes.annotate(
            "without correction",
            (max(count), 100.0 * document["uncompensated"]),
            xytext=(0, 4),
            textcoords="offset points",
            color=BEFORE,
        )
        for row in rounds:
            if row["removed"]:
                axes.annotate(
                    row["removed"].rpartition("_")[0],
                    (row["parameters"], 100.0 * row["share"]),
                    xytext=(0, 7),
                    textcoords="offset points",
                    ha="center",
                    fontsize=7,
                    color=FAINT,
                )
        axes.invert_xaxis()
        axes.set_ylim(0.0, 105.0)
        axes.set_xlabel("parameters left (beside each point: the one removed next)")
        axes.set_ylabel("share, %")
        axes.set_title(f"Directions within {document['threshold_mm']:g} mm at check poses")
        figure.savefig(path, dpi=130)


GOAL = 0.95  # of all directions
MOST_TIMES = 2000  # drawn of a course
LEAST_MM = 0.01  # shown


@dataclass(frozen=True, eq=False)
class CellCourse:
    """True errors at the working poses over time; not a number where they are not told.

    ``topic``: on which the truth was told. ``hours`` (t,) since the recording began.
    ``without_mm``, ``with_mm`` (t,) rms without correction, and of what was commanded; at the same
    poses, where some were visited. ``p95_mm`` (t,) 95 % of the poses are better, of what was
    commanded. ``lambda_without``, ``lambda_with`` (t,) share of directions within `TOLERANCE_MM`.
    ``bound_mm`` (t,) what the line was told: 95 % of the errors are below. ``tolerance_mm``: error
    that the process allows; None where the line was told nothing. ``faults``: each with ``hours``,
    ``fault``, ``size`` (SI; 0: it ended) and ``told``, the size in words.
    """

    topic: str
    hours: Array
    without_mm: Array
    with_mm: Array
    p95_mm: Array
    lambda_without: Array
    lambda_with: Array
    bound_mm: Array
    tolerance_mm: float | None
    faults: Sequence[Document]

    def document(self, changes: Sequence[tuple[float, str]] = ()) -> Document:
        """Figures of the whole, of each hour, and of each state between ``changes``."""
        hour = self.hours.astype(int)
        return {
            "topic": self.topic,
            "states": self._states(changes),
            **self._figures(np.ones(len(hour), dtype=bool)),
            "tolerance_mm": self.tolerance_mm,
            "faults": list(self.faults),
            "by_hour": [{"hour": int(h) + 1, **self._figures(hour == h)} for h in np.unique(hour)],
        }

    def _states(self, changes: Sequence[tuple[float, str]]) -> list[Document]:
        """Before the first change and after each: as told last before the next one, or the end.

        ``changes``: hours since the recording began, and words. A change after which nothing was
        told before the next one is named with that.
        """
        begins = [(0.0, "at the beginning"), *sorted(changes)]
        ends = [*(hours for hours, _ in begins[1:]), np.inf]
        series = {"rms_without_mm": self.without_mm, "rms_with_mm": self.with_mm}
        series |= {"p95_mm": self.p95_mm, "bound_mm": self.bound_mm}
        states, unseen = [], []
        for (begin, words), end in zip(begins, ends, strict=True):
            (told,) = np.nonzero((self.hours >= begin) & (self.hours < end))
            unseen.append(words)
            if len(told) or end == np.inf:
                values = {name: s[told[-1]] if len(told) else np.nan for name, s in series.items()}
                shown = {n: float(v) if np.isfinite(v) else None for n, v in values.items()}
                states.append({"state": ", ".join(unseen), "hours": begin, **shown})
                unseen = []
        return states

    def _figures(self, chosen: NDArray[np.bool_]) -> Document:
        known = chosen & np.isfinite(self.bound_mm) & np.isfinite(self.p95_mm)
        kept = self.p95_mm[known] <= self.bound_mm[known]
        period_h = float(np.median(np.diff(self.hours))) if len(self.hours) > 1 else 0.0
        squares = [
            (f"rms_{name}_mm", _mean(values[chosen] ** 2))
            for name, values in (("without", self.without_mm), ("with", self.with_mm))
        ]
        return {
            "minutes": float(np.sum(chosen)) * period_h * 60.0,
            **{name: None if mean is None else float(np.sqrt(mean)) for name, mean in squares},
            "lambda_without": _mean(self.lambda_without[chosen]),
            "lambda_with": _mean(self.lambda_with[chosen]),
            "bound_mm": _mean(self.bound_mm[known]),
            "p95_mm": _mean(self.p95_mm[known]),
            "time_below_bound": _mean(kept.astype(np.float64)),
        }


def _mean(values: Array) -> float | None:
    known = values[np.isfinite(values)]
    return float(np.mean(known)) if len(known) else None


def cell_figure(course: CellCourse) -> Figure:
    """The true error over time beside what was expected, and the share within tolerance."""
    unit, per_hour = ("hours", 1.0) if course.hours[-1] > 1.0 else ("minutes", 60.0)
    shares = bool(np.isfinite(course.lambda_with).any() or np.isfinite(course.lambda_without).any())
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(8.0, 5.2 if shares else 3.6), layout="constrained")
        ratios = (2.2, 1.0) if shares else (1.0,)
        all_axes = figure.subplots(len(ratios), sharex=True, height_ratios=ratios, squeeze=False)
        above, lowest = all_axes[0, 0], all_axes[-1, 0]
        _errors(above, course, per_hour)
        if shares:
            _shares(lowest, course, per_hour)
        for fault in course.faults:
            at = fault["hours"] * per_hour
            for axes in all_axes[:, 0]:
                axes.axvline(at, color=BEFORE, lw=1.0, ls=(0, (1, 2)))
            above.annotate(
                fault["fault"].replace("_", " ") + ("" if fault["size"] else " ends"),
                (at, 0.0), xycoords=("data", "axes fraction"), rotation=90, xytext=(3, 4),
                textcoords="offset points", va="bottom", fontsize=8, color=BEFORE,
            )  # fmt: skip
        lowest.set(xlabel=f"{unit} of recording", xlim=(0.0, float(course.hours[-1]) * per_hour))
        figure.align_ylabels(all_axes[:, 0])
    return figure


def _errors(axes: Axes, course: CellCourse, per_hour: float) -> None:
    some = slice(None, None, max(len(course.hours) // MOST_TIMES, 1))
    hours = course.hours[some] * per_hour
    for values, color, width, style, label in (
        (course.without_mm, BEFORE, 1.8, "-", "without correction"),
        (course.with_mm, AFTER, 1.8, "-", "with correction"),
        (course.bound_mm, INK, 1.0, (0, (2, 2)), "95 % bound told to the line"),
    ):
        if np.isfinite(values).any():
            axes.plot(hours, values[some], color=color, lw=width, ls=style, label=label)
    if course.tolerance_mm is not None:
        axes.axhline(course.tolerance_mm, color=FAINT, lw=0.8, ls=(0, (4, 3)), label="tolerance")
    axes.set(ylabel="rms error of the tool, mm", yscale="log")
    axes.set_ylim(LEAST_MM, max(1.5 * axes.get_ylim()[1], 10.0 * LEAST_MM))
    axes.yaxis.set_major_formatter(FormatStrFormatter("%g"))
    titled(axes, "True error at the working poses (simulated)")


def _shares(axes: Axes, course: CellCourse, per_hour: float) -> None:
    """Of each hour; within the first one as it went."""
    if course.hours[-1] <= 1.0:
        for shares, color in ((course.lambda_without, BEFORE), (course.lambda_with, AFTER)):
            axes.plot(course.hours * per_hour, 100.0 * shares, color=color, lw=1.8)
    else:
        for row in course.document()["by_hour"]:
            begin = row["hour"] - 1.0
            ends = begin * per_hour, min(begin + 1.0, float(course.hours[-1])) * per_hour
            for name, color in (("without", BEFORE), ("with", AFTER)):
                share = row[f"lambda_{name}"]
                if share is not None:
                    axes.plot(
                        ends, (100.0 * share,) * 2, color=color, lw=2.4, solid_capstyle="butt"
                    )
    axes.axhline(100.0 * GOAL, color=FAINT, lw=0.8, ls=(0, (4, 3)))
    axes.set(ylabel=f"directions within\n{TOLERANCE_MM:g} mm, %", ylim=(0.0, 103.0))


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
    found.append(Drawn.of("drift", DRIFT_CAPTION, parameter_drift(cycles)))
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
