"""The figure of a parameter screening: the share of every round."""

from pathlib import Path
from typing import Any

import matplotlib as mpl
from matplotlib.figure import Figure

from robocal_ros.report.figures import AFTER, BEFORE, FAINT, STYLE


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
