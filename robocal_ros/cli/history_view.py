"""The history for people."""

from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

Document = dict[str, Any]

_STYLES = {"in_force": "bold green", "pending": "bold yellow", "refused": "red"}


def show_list(console: "Console", document: Document) -> None:
    """Print the calibrations as a table, and what is in force."""
    from rich.table import Table
    from rich.text import Text

    _show_damage(console, document)
    table = Table(title=f"Robot {document['serial']}", title_justify="left", box=None)
    for name in ("id", "revision", "kind", "state", "verdict", "rms mm", "data (UTC)", "cycle"):
        table.add_column(name, justify="right" if name in ("id", "revision", "rms mm") else "left")
    table.add_column("last decision")
    for entry in document["calibrations"]:
        rms = entry["candidate_rms_mm"]
        table.add_row(
            str(entry["id"]),
            str(entry["revision"] or ""),
            Text(entry["kind"]),
            Text(entry["state"], style=_STYLES.get(entry["state"], "")),
            entry["code"],
            "" if rms is None else f"{rms:.3f}",
            _time(entry["stamp_ns"]),
            Text(entry["cycle_id"]),
            Text(_words(entry["decisions"][-1]) if entry["decisions"] else ""),
        )
    console.print(table)
    for head in document["in_force"]:
        console.print(Text(_in_force(head)))
    if not document["in_force"]:
        console.print("In force: the nominal model; nothing was accepted yet")


def show_entry(console: "Console", document: Document) -> None:
    """Print one calibration: the record, its inputs, its decisions."""
    from rich.table import Table
    from rich.text import Text

    _show_damage(console, document)
    entry = document["calibration"]
    table = Table(box=None, show_header=False)
    table.add_row("robot", Text(document["serial"]))
    for name, value in entry.items():
        if name == "decisions" or value is None:
            continue
        shown = _time(value) if name.endswith("_ns") else str(value)
        table.add_row(name.removesuffix("_ns").replace("_", " "), Text(shown))
    for name, kind in document["inputs"].items():
        size = " x ".join(str(n) for n in kind["shape"])
        table.add_row(f"input {name}", f"{kind['dtype']} {size}")
    for decision in entry["decisions"]:
        table.add_row("decision", Text(_words(decision)))
    console.print(table)
    console.print("The full document, the model and its figures: --json")


def show_corrections(console: "Console", document: Document) -> None:
    """Print what the commands were corrected with, and since when."""
    from rich.table import Table
    from rich.text import Text

    _show_damage(console, document)
    table = Table(title=f"Robot {document['serial']}", title_justify="left", box=None)
    for name in ("since (UTC)", "correction", "model", "tool", "reference", "from", "its hash"):
        table.add_column(name, justify="right" if name in ("model", "tool") else "left")
    table.add_column("version")
    for record in document["corrections"]:
        asked = ("shadow" if record["shadow"] else "on") if record["enabled"] else "off"
        table.add_row(
            _time(record["wall_ns"]),
            Text(asked, style="bold green" if asked == "on" else ""),
            str(record["model_revision"] or "none"),
            str(record["tool_revision"] or "taught"),
            record["reference"],
            Text(record["reference_source"]),
            record["reference_hash"][:8],
            Text(record["software"]),
        )
    console.print(table)
    if not document["corrections"]:
        console.print("Nothing yet: joint_correction_node adds a record when it becomes active")


def show_acknowledged(console: "Console", document: Document) -> None:
    """Print which damaged histories somebody knows of now."""
    from rich.text import Text

    for path in document["acknowledged"]:
        console.print(Text(f"Acknowledged by {document['by']}: {path}"), soft_wrap=True)
    if not document["acknowledged"]:
        console.print("There is nothing to acknowledge")


def show_decision(console: "Console", document: Document) -> None:
    """Print what was done."""
    from rich.text import Text

    _show_damage(console, document)
    console.print(Text(document["verdict"]["reason"].capitalize()), soft_wrap=True)


def _show_damage(console: "Console", document: Document) -> None:
    if document["damaged"]:
        console.print(
            f"The history was damaged and is kept as {document['damaged']}; 'robocal history "
            "acknowledge' ends the warnings",
            style="bold red",
            soft_wrap=True,
        )


def _in_force(head: Document) -> str:
    number = head["calibration_id"]
    name = "the nominal model" if number is None else f"calibration {number}"
    return f"In force: {name}, {head['kind']} revision {head['revision']}"


def _words(decision: Document) -> str:
    number = decision["calibration_id"]
    target = ""
    if decision["action"] == "rollback":
        target = " to nominal" if number is None else f" to {number}"
    by = f" by {decision['by']}" if decision["by"] else ""
    why = f": {decision['reason']}" if decision["reason"] else ""
    return f"{_time(decision['wall_ns'])} {decision['action']}{target}{by}{why}"


def _time(stamp_ns: int) -> str:
    return datetime.fromtimestamp(stamp_ns / 1e9, UTC).strftime("%Y-%m-%d %H:%M:%S")
