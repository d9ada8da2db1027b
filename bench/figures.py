# SPDX-License-Identifier: Apache-2.0
"""Figures of the README: ``tools/with_ros python bench/figures.py``.

- ``ur10_campaigns.png``: real measurements (see ``ur10_campaigns``), mean error at poses that were
  held out;
- ``ur10_joints.png``: what the joints of that robot turn besides what is read, of series A;
- ``ur10_errors.png``: where in the workspace it errs, before and after, of series A;
- ``beam_circle.png``: one simulated circle through two crossed beams;
- ``demo_shift.png``: the simulated shift of ``bags/demo_shift.mcap``, as ``robocal validate`` draws
  it.
"""

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
from matplotlib.figure import Figure

sys.path.insert(0, str(Path(__file__).resolve().parent.parent))

from bench.circle_figure import circle_figure
from bench.real_data import carried_over, own_half
from robocal_ros.bags.ur10_campaigns import SERIES
from robocal_ros.cli.validating import Job, validate_bag
from robocal_ros.identification.full_model import FullIdentification
from robocal_ros.report.figures import (
    AFTER,
    BEFORE,
    FAINT,
    STYLE,
    joint_functions_figure,
    png,
)
from robocal_ros.report.measured_figures import errors_figure

ROOT = Path(__file__).resolve().parent.parent
IMAGES = ROOT / "docs" / "images"
LEFT = -0.1  # mm: there stands a figure
NAMES = {
    "A": "A  grid, July 2020",
    "B": "B  joint configurations, 2020",
    "C": "C  random poses, 2020",
    "D": "D  ISO cubes, March 2021",
}


def campaign_errors() -> dict[str, dict[str, float]]:
    """Held-out mean errors, mm: nominal, calibrated on the other half, and with A's model."""
    found: dict[str, dict[str, float]] = {}
    for series in SERIES:
        judged = own_half(series)
        found[series] = {
            "nominal": judged.nominal.mean_m * 1e3,
            "calibrated": judged.candidate.mean_m * 1e3,
            "n": judged.candidate.n,
        }
        if series != "A":
            found[series]["old"] = carried_over("A", series).candidate.mean_m * 1e3
    return found


def campaign_figure(found: Mapping[str, Mapping[str, float]]) -> Figure:
    """A dumbbell for each campaign."""
    with mpl.rc_context(STYLE | {"font.size": 10}):
        figure = Figure(figsize=(8.0, 3.3), layout="constrained")
        axes = figure.add_subplot()
        for row, (series, errors) in enumerate(found.items()):
            y = len(found) - row
            before, after = errors["nominal"], errors["calibrated"]
            axes.plot([after, before], [y, y], color="#d5dce0", lw=6, solid_capstyle="round")
            axes.plot(before, y, "o", color=BEFORE, ms=11)
            axes.plot(after, y, "o", color=AFTER, ms=11)
            axes.annotate(f"{before:.2f}", (before, y), xytext=(12, -4), **_TEXT, color=BEFORE)
            axes.annotate(
                f"{after:.2f}", (after, y), xytext=(-12, -4), **_TEXT, color=AFTER, ha="right"
            )
            if "old" in errors:
                axes.plot(errors["old"], y, "o", mfc="white", mec=AFTER, mew=1.6, ms=7)
            axes.text(LEFT - 0.015, y + 0.1, NAMES[series], ha="right", va="center")
            axes.text(
                LEFT - 0.015, y - 0.22, f"{errors['n']:,} held-out poses".replace(",", "\u2009"),
                ha="right", va="center", color=FAINT, fontsize=8,
            )  # fmt: skip
        _legend(axes)
        axes.set(
            xlim=(LEFT, 1.15),
            ylim=(0.4, len(found) + 0.75),
            yticks=[],
            xticks=np.arange(0.0, 1.1, 0.2),
        )
        axes.set_xlabel("mean position error at held-out poses, mm")
        axes.grid(visible=False, axis="y")
        axes.spines["left"].set_visible(False)
        figure.suptitle(
            "A real UR10, measured by a laser tracker", x=0.012, ha="left", fontweight="bold",
            fontsize=11.5,
        )  # fmt: skip
    return figure


_TEXT: dict[str, Any] = {"textcoords": "offset points", "fontweight": "bold"}


def _legend(axes: Any) -> None:
    handles = [
        axes.plot([], [], "o", color=AFTER, ms=9, label="calibrated on the other half")[0],
        axes.plot([], [], "o", mfc="white", mec=AFTER, mew=1.6, ms=7,
                  label="with the model of July 2020")[0],
        axes.plot([], [], "o", color=BEFORE, ms=9, label="nominal model")[0],
    ]  # fmt: skip
    axes.legend(handles=handles, loc="upper center", bbox_to_anchor=(0.5, 1.13), ncols=3,
                columnspacing=1.4, handletextpad=0.1, fontsize=9)  # fmt: skip


def main() -> None:
    """Write the images."""
    IMAGES.mkdir(parents=True, exist_ok=True)
    found = campaign_errors()
    print(json.dumps(found, indent=1))
    (IMAGES / "ur10_campaigns.png").write_bytes(png(campaign_figure(found)))
    judged = own_half("A")
    joints, errors = judged.identification, judged.errors
    shown = {"nominal model": errors["nominal"], "identified model": errors["calibrated"]}
    figure = errors_figure(joints.nominal.fk(judged.q)[:, :3, 3], shown)
    (IMAGES / "ur10_errors.png").write_bytes(png(figure, dpi=110))
    if isinstance(joints, FullIdentification):
        (IMAGES / "ur10_joints.png").write_bytes(png(joint_functions_figure(joints.known)))
    (IMAGES / "beam_circle.png").write_bytes(png(circle_figure()))
    bag = ROOT / "bags" / "demo_shift.mcap"
    (drawn,) = validate_bag(Job(str(bag), bag.name, "kr150_r3100")).figures
    shift = next(figure for figure in drawn if figure.name == "true_error")
    (IMAGES / "demo_shift.png").write_bytes(shift.png)


if __name__ == "__main__":
    main()
