# SPDX-License-Identifier: Apache-2.0
"""What the demo leaves behind: the validated bag's page, and a summary on the terminal."""

import os
import webbrowser
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from bench.demo import GOAL_S
from bench.live.plc import Gap
from robocal_ros.ground.errors import Code


@dataclass(frozen=True)
class Moment:
    """True rms error of the tool at the working poses, mm, and what the line read then."""

    words: str
    without_mm: float
    with_mm: float
    state: str
    reason: str


@dataclass
class Story:
    """What came of the demo."""

    moments: list[Moment] = field(default_factory=list)
    gaps: list[Gap] = field(default_factory=list)
    page: dict[str, Any] | None = None  # what panel_node shows at the end
    called_s: list[float] = field(default_factory=list)  # of the PLC's calls

    def document(self) -> dict[str, object]:
        """Plain values."""
        moments = [asdict(moment) for moment in self.moments]
        gaps = [_gap(gap) for gap in self.gaps]
        told = {"page": self.page, "called_s": self.called_s}
        return {"simulated": True, "moments": moments, "gaps": gaps, **told}


def _gap(gap: Gap) -> dict[str, object]:
    result = gap.result
    codes = {name: Code(getattr(result, name)).name for name in ("code", "tool_code")}
    # a try that was broken off may have found it bent, and mended it
    bent = any(tried.tool_found_code == Code.LIMIT_EXCEEDED for tried in gap.results)
    found = Code.LIMIT_EXCEEDED if bent else Code(result.tool_found_code)
    thermal = [Code(r.thermal_code).name for r in gap.results if r.thermal_code != Code.NONE]
    return {
        "gap": gap.name,
        "length_s": gap.length_s,
        "used_s": gap.used_s,
        **codes,
        "tool_found_code": found.name,
        "thermal_codes": thermal,
        "complete": result.complete,
        "accepted": accepted(gap),
        "message": result.message,
        "broken_off": [broken.message for broken in gap.results[:-1]],
    }


def accepted(gap: Gap) -> list[int]:
    """What came into force in it."""
    return [number for result in gap.results for number in result.accepted]


def tell(words: str) -> None:
    """Say what goes on."""
    print(f"  {words}", flush=True)


def show(story: Story, page: Path, seconds: float, nodes: int, *, opened: bool) -> None:
    """Print the summary; open the page where there is a desktop."""
    from rich.console import Console
    from rich.table import Table

    console = Console(highlight=False)
    console.print("\n[bold]A cell that keeps itself accurate[/bold]  [red]simulated[/red]\n")
    table = Table(box=None, header_style="dim")
    table.add_column("true error at the working poses, rms mm", no_wrap=True)
    for head in ("without", "with"):
        table.add_column(head, justify="right")
    table.add_column("the line reads")
    for moment in story.moments:
        figures = f"{moment.without_mm:.3f}", f"{moment.with_mm:.3f}"
        table.add_row(moment.words, *figures, moment.state)
    console.print(table)
    console.print()
    for gap in story.gaps:
        result = gap.result
        brought = ", ".join(map(str, accepted(gap))) or "nothing"
        thermal = next((r.thermal_code for r in gap.results[::-1] if r.thermal_code), Code.NONE)
        broken = len(gap.results) - 1
        console.print(
            f"{gap.name}: {gap.used_s:.0f} of {gap.length_s:.0f} s; "
            f"{f'broken off {broken} times by a busy computer; ' if broken else ''}thermal "
            f"{Code(thermal).name}, tool found {Code(result.tool_found_code).name}, "
            f"then {Code(result.tool_code).name}; "
            f"came into force: {brought}"
        )
    near = page.relative_to(Path.cwd()) if page.is_relative_to(Path.cwd()) else page
    console.print(f"\n{near}", soft_wrap=True)
    missed = " MISSED" if seconds > GOAL_S else ""
    took = f"{seconds:.0f} s (goal {GOAL_S:.0f} s{missed})"
    console.print(f"[dim]{took}, {nodes} nodes as processes over DDS[/dim]")
    if opened and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        webbrowser.open(page.as_uri())
