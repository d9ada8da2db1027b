# SPDX-License-Identifier: Apache-2.0
"""Figure of the docs: one circle through two crossed beams, with its eight edges; simulated."""

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle as Disc

from bench.measured_runs import NO_NOISE, PERFECT
from robocal_ros.cell_sim.beams import BeamStation, Circle, RoundTool, beams_of
from robocal_ros.ground import frames
from robocal_ros.report.figures import AFTER, BEFORE, FAINT, STYLE
from robocal_ros.tool.edges import BeamEdge

RADIUS_M, TOOL_M = 0.012, 0.0025
CENTRE_M = np.array([0.003, -0.004])  # the bent tool's axis at the circle's centre
BETA_RAD = float(np.radians(92.2))
ABOVE_M = 5e-3
COLOUR = {True: BEFORE, False: AFTER}
REACH_MM = 20.0


def passed() -> tuple[Circle, list[BeamEdge]]:
    """The motion of the tool's tip, and its edges."""
    tip = frames.transform(np.diag([1.0, -1.0, -1.0]), [*CENTRE_M, -ABOVE_M])
    move = Circle(tip, np.eye(3), RADIUS_M, 1.5)
    station = BeamStation(beams_of(np.eye(4), BETA_RAD), PERFECT, NO_NOISE)
    tool = RoundTool.cylinder(np.eye(4), TOOL_M)
    rng = np.random.default_rng(1)
    return move, station.edges(tool, move, move.window, rng)


def circle_figure() -> Figure:
    """Seen from above, laser frame."""
    move, edges = passed()
    with mpl.rc_context(STYLE | {"font.size": 10}):
        figure = Figure(figsize=(5.6, 5.6), layout="constrained")
        axes = figure.add_subplot()
        _beams(axes)
        path = 1e3 * move(np.linspace(*move.window, 400))[:, :2, 3]
        axes.plot(*path.T, color=FAINT, lw=1.2)
        for edge in edges:
            x, y = 1e3 * move(np.array([edge.time_s]))[0, :2, 3]
            colour = COLOUR[edge.blocked]
            axes.add_patch(Disc((x, y), 1e3 * TOOL_M, fc="none", ec=colour, lw=1.4))
            axes.plot(x, y, "o", color=colour, ms=4)
        axes.plot(*(1e3 * CENTRE_M), "+", color="black", ms=10)
        axes.annotate(
            "the tool's axis when the flange\nis at the circle's centre", 1e3 * CENTRE_M,
            xytext=(34, -58), textcoords="offset points", fontsize=8, ha="center",
            arrowprops={"arrowstyle": "-", "color": FAINT, "lw": 0.8},
        )  # fmt: skip
        for blocked, words in ((True, "beam breaks"), (False, "beam is restored")):
            axes.plot([], [], "o", mfc="none", color=COLOUR[blocked], label=words)
        axes.legend(loc="upper left", frameon=False, fontsize=8)
        axes.set(xlim=(-REACH_MM, REACH_MM), ylim=(-REACH_MM, REACH_MM), aspect="equal")
        axes.set(xlabel="x of the laser frame, mm", ylabel="y, mm")
        axes.set_title("One circle, eight edges (simulated)", loc="left", fontweight="bold")
    return figure


def _beams(axes: Axes) -> None:
    for angle, name in ((0.0, "x-beam"), (BETA_RAD, "y-beam")):
        along = REACH_MM * np.array([np.cos(angle), np.sin(angle)])
        axes.plot([-along[0], along[0]], [-along[1], along[1]], color="#d03b3b", lw=2.0, alpha=0.6)
        axes.annotate(
            name, 0.93 * along, xytext=(6, 6), textcoords="offset points", fontsize=8,
            color="#d03b3b", ha="right" if angle == 0.0 else "left",
        )  # fmt: skip
