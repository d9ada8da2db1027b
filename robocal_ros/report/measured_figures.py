# SPDX-License-Identifier: Apache-2.0
"""Figures of one result: what is left of each sample, how well a place is known, what was seen."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from pathlib import Path

import matplotlib as mpl
import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from robocal_ros.ground.files import write_text
from robocal_ros.ground.frames import Array
from robocal_ros.identification.known_model import KnownModel
from robocal_ros.report.figures import (
    AFTER,
    BEFORE,
    FAINT,
    STYLE,
    joint_functions_figure,
    svg,
)

HOLDS_95 = 2.4477  # Mahalanobis distance within which 95 % of a plane's Gaussian lie
MOST_NAMED = 40
CELLS = 24  # across the workspace
DECADES = 3.0  # of errors, in colour
MODEL_CAPTIONS = {
    "errors": "Errors at poses not used to solve, over the workspace, before and after",
    "joints": "What each joint of the identified model turns besides what is read, with the band "
    "of 95 %",
}


def keep_figure(folder: Path, name: str, figure: Figure) -> str:
    """Write ``name.svg`` into a folder, which is made; the file's path."""
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}.svg"
    write_text(path, svg(figure))
    return str(path)


def result_figure(
    residual_mm: Mapping[str, Sequence[float]],
    covariance: Array | None,
    *,
    place: str,
    rms_mm: float | None = None,
    seen: Mapping[str, Array] | None = None,
) -> Figure:
    """What a calibration left and how well it knows a place.

    ``residual_mm``: of each sample, one or more. ``covariance`` (3, 3), m², of ``place`` (words);
    None where the method tells none. ``rms_mm``: of all of them. ``seen``: points
    (n, 2), m, of the sensor's plane that each sample rests on.
    """
    rows = 1 + (covariance is not None) + bool(seen)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.1 * rows), layout="constrained")
        grid = figure.add_gridspec(rows, 3)
        _residuals(figure.add_subplot(grid[0, :]), residual_mm, rms_mm)
        if covariance is not None:
            planes = [figure.add_subplot(grid[1, column]) for column in range(3)]
            _ellipses(planes, 1e6 * covariance, place)
        if seen:
            _points(figure.add_subplot(grid[rows - 1, :]), seen)
    return figure


def _residuals(
    axes: Axes, residual_mm: Mapping[str, Sequence[float]], rms_mm: float | None
) -> None:
    names = list(residual_mm)
    for i, values in enumerate(residual_mm.values()):
        axes.plot(np.full(len(values), i), values, "o", ms=4, color=AFTER, alpha=0.8)
    axes.axhline(0.0, color=FAINT, lw=0.8)
    if rms_mm is not None:
        axes.axhline(rms_mm, color=BEFORE, lw=1.0, ls="--", label=f"rms {rms_mm:.3f} mm")
        axes.legend(loc="upper right", fontsize=8)
    if len(names) <= MOST_NAMED:
        turn = 90 if sum(map(len, names)) > 90 else 0
        axes.set_xticks(range(len(names)), names, rotation=turn, fontsize=8)
    axes.set_title("What is left of each sample, mm")


def _ellipses(planes: Sequence[Axes], covariance_mm2: Array, place: str) -> None:
    """In three planes the ellipse that holds the true place with 95 %; all to one scale."""
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = HOLDS_95 * np.array([np.cos(angle), np.sin(angle)])
    reach = 1.15 * HOLDS_95 * float(np.sqrt(np.max(np.diag(covariance_mm2))))
    for axes, (i, k) in zip(planes, combinations(range(3), 2), strict=True):
        values, vectors = np.linalg.eigh(covariance_mm2[np.ix_((i, k), (i, k))])
        x, y = vectors @ (np.sqrt(np.maximum(values, 0.0))[:, None] * circle)
        axes.fill(x, y, color=AFTER, alpha=0.25, lw=0)
        axes.plot(x, y, color=AFTER, lw=1.2)
        axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
        axes.set_xlabel(f"{'xyz'[i]}, mm")
        axes.set_ylabel(f"{'xyz'[k]}, mm")
    planes[0].set_title(f"95 % of {place}")


def _points(axes: Axes, seen: Mapping[str, Array]) -> None:
    for points in seen.values():
        axes.plot(*(1e3 * points.T), ".", ms=2, alpha=0.6, rasterized=True)
    axes.set(aspect="equal", xlabel="x, mm", ylabel="z, mm")
    axes.set_title("Where the target was seen, in the sensor's plane; a colour for each profile")


def errors_figure(place: Array, errors: Mapping[str, Array]) -> Figure:
    """Where in the workspace each model errs by how much: from above and from the side.

    ``place`` (m, 3): of the flange in the base, m, at poses that were judged by. ``errors``: (m,)
    of each model, m. Each cell has the mean of its poses, in one scale of colours for all models.
    """
    x, y, z = 1e3 * place.T
    views = (x, y, "x, mm", "y, mm"), (np.hypot(x, y), z, "distance from the base's z, mm", "z, mm")
    largest = max(1e3 * float(np.quantile(np.concatenate([*errors.values()]), 0.99)), 1e-9)
    smallest = 1e3 * float(np.quantile(np.concatenate([*errors.values()]), 0.01))
    norm = LogNorm(max(smallest, 10.0**-DECADES * largest), largest, clip=True)
    with mpl.rc_context(STYLE):
        figure = Figure(figsize=(9.0, 3.8 * len(errors)), layout="constrained")
        panels = figure.subplots(len(errors), 2, squeeze=False)
        for row, (name, error) in zip(panels, errors.items(), strict=True):
            for axes, (u, v, across, up) in zip(row, views, strict=True):
                wide, high = float(np.ptp(u)), float(np.ptp(v))
                per_mm = CELLS / max(wide, high, 1e-9)
                count = 1 + int(per_mm * wide), 1 + int(per_mm * high / np.sqrt(3.0))
                cells = axes.hexbin(
                    u, v, C=1e3 * error, gridsize=count, norm=norm, cmap="viridis", linewidths=0.2
                )
                axes.set(aspect="equal", xlabel=across, ylabel=up)
            row[0].set_title(f"{name}: mean {1e3 * np.mean(error):.3f} mm")
        words = "error at poses not used to solve, mm"
        figure.colorbar(cells, ax=panels, label=words, format="%.2g")
    return figure


def model_figures(
    place: Array, errors: Mapping[str, Array], known: KnownModel | None
) -> dict[str, Figure]:
    """Figures of an identified model by their names.

    ``errors``: those of `errors_figure`. ``joints``: what each does besides what is read, where the
    model has such functions, ``known`` as well as it says.
    """
    figures = {"errors": errors_figure(place, errors)}
    if known is not None and np.any(known.terms.count):
        figures["joints"] = joint_functions_figure(known)
    return figures
