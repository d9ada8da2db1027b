"""A replay for people: what was identified when, what came into force, what was left out."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

from robocal_ros.cli.identify_view import show_identification

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Document = dict[str, Any]

MOST_REASONS = 5
_NOTHING_ACCEPTED = (
    "Nothing was accepted: each cycle is judged against the model in force at the start."
)
_COLUMNS = (
    "number", "time (UTC)", "cycle", "samples", "in force", "candidate", "predicted", "verdict",
)  # fmt: skip


def show_replay(console: "Console", document: Document) -> None:
    """Print a replay; a single candidate in full, several as a table."""
    from rich.text import Text

    if "runs" in document or "calibrations" in document:
        _show_commands(console, document)
        return
    candidates = document["candidates"]
    if len(candidates) == 1:
        show_identification(console, candidates[0])
    elif candidates:
        console.print(_candidates(candidates))
        if not document["recorded"]:
            console.print(_NOTHING_ACCEPTED, soft_wrap=True)
    for entry in document["commands"]:
        if entry["code"] != "ACCEPT" and not (entry["command"] == "identify" and entry["samples"]):
            words = f"{entry['command']}: {entry['code']}: {entry['message']}"
            console.print(Text(words, style="red"), soft_wrap=True)
        elif entry["command"] != "identify":
            console.print(Text(f"{entry['command']}: {entry['message']}"), soft_wrap=True)
    _show_losses(console, document)
    _show_equality(console, document)


def _show_commands(console: "Console", document: Document) -> None:
    from rich.text import Text

    for entry in document["commands"]:
        style = "" if entry["code"] == "ACCEPT" else "red"
        words = f"{entry['command']}: {entry['code']}: {entry['message']}"
        console.print(Text(words, style=style), soft_wrap=True)
    final = document["final_tool"] if "runs" in document else document["final_sensor"]
    if final is None:
        console.print("Nothing is in force at the end.")
    else:
        where = ", ".join(f"{x:.3f}" for x in final["xyz_mm"])
        console.print(f"In force at the end: revision {final['revision']}, ({where}) mm")
    _show_losses(console, document)
    _show_equality(console, document)


def _candidates(candidates: list[Document]) -> "Table":
    from rich.table import Table
    from rich.text import Text

    title = "Candidates; rms errors at unseen measurements in mm"
    table = Table(title=title, title_justify="left", box=None)
    for name in _COLUMNS:
        words = name in ("time (UTC)", "cycle", "verdict")
        table.add_column(name, justify="left" if words else "right")
    for number, one in enumerate(candidates, start=1):
        verdict = one["verdict"]
        table.add_row(
            str(number),
            datetime.fromtimestamp(one["stamp"], UTC).strftime("%Y-%m-%d %H:%M:%S"),
            Text(one["cycle_id"]),
            str(one["samples"]),
            f"{one['in_force']['held_out']['rms_mm']:.3f}",
            f"{one['calibrated']['held_out']['rms_mm']:.3f}",
            f"{one['calibrated']['predicted']['total_rms_mm']:.3f}",
            Text(verdict["code"], style="green" if verdict["accept"] else "red"),
        )
    return table


def _show_losses(console: "Console", document: Document) -> None:
    from rich.text import Text

    for topic, reasons in document["ignored_reasons"].items():
        count = document["ignored"][topic]
        console.print(Text(f"Not used: {count} messages of {topic}"), soft_wrap=True)
        most = sorted(reasons.items(), key=lambda item: -item[1])[:MOST_REASONS]
        for reason, number in most:
            console.print(Text(f"  {number}: {reason}"), soft_wrap=True)
    gaps = document["gaps"]
    if gaps["count"]:
        console.print(
            f"{gaps['count']} pauses in the joint readings, the longest {gaps['longest_s']:.2f} s"
        )


def _show_equality(console: "Console", document: Document) -> None:
    from rich.text import Text

    if not document["recorded"]:
        return
    if not document["differs"]:
        console.print("Every recorded result comes out equal, bit for bit.", style="green")
    for words in document["differs"]:
        console.print(Text(f"Differs from the recording: {words}", style="red"), soft_wrap=True)
