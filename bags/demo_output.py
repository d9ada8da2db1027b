"""What the demo leaves behind: the page with its numbers, and a summary on the terminal."""

import json
import subprocess
from pathlib import Path

import numpy as np
from demo_graph import ROOT

from robocal_ros import __version__
from robocal_ros.core.codes import Code
from robocal_ros.report.drift import TOLERANCE_MM, DriftReport


def commit() -> str:
    """Version of the software, with its commit where git knows it."""
    words = ["git", "-C", str(ROOT), "describe", "--always", "--dirty", "--abbrev=10"]
    found = subprocess.run(words, capture_output=True, text=True, check=False)
    return f"robocal_ros {__version__} {found.stdout.strip()}".strip()


def write(report: DriftReport, folder: Path) -> None:
    """Write the page, the figures' numbers as JSON, and every error as CSV."""
    from robocal_ros.report.html import page

    (folder / "report.html").write_text(page(report), encoding="utf-8")
    document = json.dumps(report.document(), indent=1, allow_nan=False)
    (folder / "report.json").write_text(document + "\n", encoding="utf-8")
    (folder / "errors.csv").write_text(report.table(), encoding="utf-8")


def show(report: DriftReport, folder: Path, seconds: float) -> None:
    """Print the summary."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    cycles, poses, _ = report.before.shape
    console.print(f"\n[bold]{report.title}[/bold]  [red]simulated[/red]")
    console.print(
        f"{cycles} measuring cycles in {report.hours[-1]:.1f} h; true error of the tool at {poses} "
        "poses that were never measured:\n"
    )
    table = Table(box=None, header_style="dim")
    table.add_column("mm", no_wrap=True)
    for head in ("mean", "rms", "p95", "max", f"within {TOLERANCE_MM:g} mm"):
        table.add_column(head, justify="right")
    for i, (name, found) in enumerate(report.rows()):
        keys = ("mean_mm", "rms_mm", "p95_mm", "max_mm")
        cells = [f"{found[key]:.3f}" for key in keys] + [f"{found['share_within_tolerance']:.1%}"]
        table.add_row(name, *cells, style="bold green" if i == 1 else None)
    console.print(table)
    accepted = sum(decided.code == Code.ACCEPT.name for decided in report.decisions)
    predicted = [d.predicted_mm for d in report.decisions if d.predicted_mm is not None]
    if predicted:
        console.print(
            f"\npredicted there from the models' own covariance: "
            f"{np.sqrt(np.mean(np.square(predicted))):.3f} mm rms"
        )
    console.print(f"{accepted} of {cycles} candidates accepted; the report says why:")
    page = folder / "report.html"
    console.print(str(page.relative_to(Path.cwd()) if page.is_relative_to(Path.cwd()) else page))
    console.print(
        "[dim]The same from the bag alone: .venv/bin/robocal validate bags/demo_shift.mcap "
        "--robot kr150_r3100 --report out/validation[/dim]",
        soft_wrap=True,
    )
    console.print(f"[dim]{seconds:.0f} s, through three nodes as processes over DDS[/dim]")
