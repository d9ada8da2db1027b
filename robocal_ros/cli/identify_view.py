"""An identification for people: the verdict in one line, then what stands behind it."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

Document = dict[str, Any]

MOVED_SIGMA = 2.0
MOST_LISTED = 12
_FIGURES = ("mean", "rms", "p95", "max")


def headline(document: Document) -> str:
    """The verdict in one plain line."""
    verdict = document["verdict"]
    after, before = document["calibrated"]["held_out"], document["in_force"]["held_out"]
    line = (
        f"{verdict['code']}: held-out mean {after['mean_mm']:.3f} mm instead of "
        f"{before['mean_mm']:.3f} mm (largest {after['max_mm']:.3f} instead of "
        f"{before['max_mm']:.3f}) at {after['n']} measurements not used to solve"
    )
    return line if verdict["accept"] else f"{line}. Keep the present model."


def show_identification(console: "Console", document: Document) -> None:
    """Print an identification."""
    from rich.text import Text

    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(headline(document), style=style), soft_wrap=True)
    if not verdict["accept"]:
        console.print(Text(f"Why: {verdict['reason']}"), soft_wrap=True)
    console.print()
    console.print(_errors(document))
    predicted = document["calibrated"]["predicted"]
    console.print(
        f"Uncertainty of the model itself: {predicted['model_rms_mm']:.3f} mm rms at these poses, "
        f"{predicted['workspace_rms_mm']:.3f} mm throughout the joint limits. "
        f"Noise: {document['noise_mm']:.3f} mm per coordinate.",
        soft_wrap=True,
    )
    console.print()
    _show_parameters(console, document)
    _show_doubts(console, document)
    if document.get("output"):
        console.print(Text(f"Written: {document['output']}"), soft_wrap=True)


def _errors(document: Document) -> "Table":
    from rich.table import Table

    table = Table(title="Errors at held-out measurements, mm", title_justify="left", box=None)
    table.add_column("")
    for name in _FIGURES:
        table.add_column(name, justify="right")
    rows = {"nominal model": document["nominal"]}
    if document["in_force"] != document["nominal"]:
        rows["model in force"] = document["in_force"]
    rows["identified model"] = document["calibrated"]
    for name, judged in rows.items():
        errors = judged["held_out"]
        table.add_row(name, *(f"{errors[f'{figure}_mm']:.3f}" for figure in _FIGURES))
    predicted = document["calibrated"]["predicted"]["total_rms_mm"]
    table.add_row("  predicted by its covariance", "", f"{predicted:.3f}", "", "")
    return table


def _show_parameters(console: "Console", document: Document) -> None:
    from rich.table import Table

    parameters = document["parameters"]
    solved = {name: row for name, row in parameters.items() if row["sigma"] is not None}
    if not solved:
        console.print("No model parameter was solved for.")
        return
    table = Table(
        title=f"Parameters that moved by more than {MOVED_SIGMA:g} sigma",
        title_justify="left",
        box=None,
    )
    table.add_column("parameter")
    for name in ("nominal", "identified", "change", "sigma"):
        table.add_column(name, justify="right")
    for name, row in solved.items():
        change = row["value"] - row["nominal"]
        if abs(change) > MOVED_SIGMA * row["sigma"]:
            shown = (f"{row['nominal']:.4f}", f"{row['value']:.4f}", f"{change:+.4f}")
            table.add_row(name, *shown, f"{row['sigma']:.4f}")
    if table.row_count:
        console.print(table)
    console.print(f"{table.row_count} of {len(solved)} parameters moved.")


def _show_doubts(console: "Console", document: Document) -> None:
    from rich.text import Text

    condition = document["condition"]
    scale = "" if condition is None else f", condition {condition:.3g}"
    console.print(
        f"The data determine {document['rank']} of {document['unknowns']} unknowns{scale}."
    )
    if document["unobservable"]:
        owner = "held as they were" if document["held"] else "left to the prior"
        console.print(f"Not seen in the data, {owner}:")
        for words in document["unobservable"]:
            console.print(Text(f"  {words}"), soft_wrap=True)
    rejected, not_judging = document["rejected"], document["held_out_rejected"]
    if rejected:
        words = f"Rejected, {len(rejected)} of {document['samples']} samples: {_listed(rejected)}"
        console.print(Text(words), soft_wrap=True)
    if not_judging:
        words = f"Left out of the judgement, no model fits them: {_listed(not_judging)}"
        console.print(Text(words), soft_wrap=True)


def _listed(samples: list[str]) -> str:
    return ", ".join(samples[:MOST_LISTED]) + (" …" if len(samples) > MOST_LISTED else "")
