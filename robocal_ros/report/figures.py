"""Figures of reports, drawn without a display."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Protocol

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MultipleLocator
from numpy.typing import NDArray

from robocal_ros.report.validation import TOLERANCE_MM, ShiftErrors

Array = NDArray[np.float64]

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
GREEK = {"theta": "\u03b8", "alpha": "\u03b1", "beta": "\u03b2"}


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


class Drifted(Protocol):
    """How a model moved."""

    @property
    def hours(self) -> Array:
        """Time (c,) of each model."""

    @property
    def parameter_names(self) -> Sequence[str]:
        """Names of the k parameters, with their unit."""

    @property
    def drift(self) -> Array:
        """Drift (c, k) in those units."""

    @property
    def sigma(self) -> Array:
        """Its standard deviation (c, k)."""


def parameter_drift(report: Drifted) -> Figure:
    """Drift of the parameters that moved most in units of their sigma, with two sigma."""
    with mpl.rc_context(STYLE | {"axes.titlesize": 9.5, "axes.titlepad": 5, "font.size": 8.5}):
        figure = Figure(figsize=(8.0, 3.8), layout="constrained")
        size = np.max(np.abs(report.drift) / np.maximum(report.sigma, 1e-12), axis=0)
        chosen = np.sort(np.argsort(-size)[:SHOWN_PARAMETERS])
        grid = figure.subplots(2, (len(chosen) + 1) // 2, sharex=True, squeeze=False).ravel()
        for axes, k in zip(grid, chosen, strict=False):
            value, sigma = report.drift[:, k], report.sigma[:, k]
            low, high = value - 2.0 * sigma, value + 2.0 * sigma
            axes.fill_between(report.hours, low, high, step="post", color=AFTER, alpha=0.16, lw=0)
            axes.step(report.hours, value, where="post", color=AFTER, lw=1.6)
            axes.axhline(0.0, color=FAINT, lw=0.8)
            name, _, unit = report.parameter_names[k].rpartition("_")
            axes.set_title(f"{_symbol(name)}, {unit}")
        for axes in grid[len(chosen) :]:
            axes.set_visible(False)
        figure.supxlabel("hours of production", fontsize=9, color=INK)
    return figure


def _symbol(name: str) -> str:
    for word, letter in GREEK.items():
        name = name.replace(word, letter)
    return name


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
        figure.savefig(stream, format="svg", metadata={"Date": None, "Creator": None})
    text = stream.getvalue()
    return text[text.index("<svg") :]


def png(figure: Figure, dpi: int = 160) -> bytes:
    """The figure as PNG."""
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=dpi, metadata={"Software": None})
    return stream.getvalue()


# ---- the figure of a parameter screening: the share of every round ------------------------------


def draw_rounds(path: Path, document: dict[str, Any]) -> None:
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
