"""Results of ``robocal hand-eye`` for people."""

from typing import TYPE_CHECKING

from robocal_ros.cli.output import Document

if TYPE_CHECKING:
    from rich.console import Console


MOST_NAMED = 5  # samples left out for one reason


def show_mount(console: "Console", document: Document) -> None:
    """Print where a line laser sits, how well that is known, and which samples were left out."""
    show_placed(console, document, "Sensor", "in the field of view")
    residual = document["residual_mm"]
    console.print(
        f"Samples from the target: rms {residual['rms']:.3f} mm, largest {residual['max']:.3f} mm"
    )
    show_judged(console, document)


def show_placed(console: "Console", document: Document, what: str, where: str) -> None:
    """Print the decision, where a sensor sits, and how well that is known, ``where`` it looks."""
    show_verdict(console, document)
    parent = "flange" if "T_flange_sensor" in document else "base"
    show_pose(console, f"{what} in the {parent} frame", document[f"T_{parent}_sensor"])
    if document["sigma"] is not None:
        show_sigma(console, document["sigma"])
    error_mm = document["working_error_mm"]
    if error_mm is not None:
        console.print(f"Expected error {where}: {error_mm:.3f} mm rms")


def show_judged(console: "Console", document: Document) -> None:
    """Print how far samples are from a result without them, and which were left out."""
    left_out = document["leave_one_out_mm"]
    if left_out is not None:
        console.print(
            f"Each without itself: mean {left_out['mean']:.3f} mm, largest {left_out['max']:.3f} mm"
        )
    if document.get("held_out") is not None:
        show_held_out(console, document["held_out"])
    show_rejected(console, document["rejected_because"])


def show_verdict(console: "Console", document: Document) -> None:
    """Print the decision and why."""
    from rich.text import Text

    verdict = document["verdict"]
    style = "bold green" if verdict["accept"] else "bold red"
    console.print(Text(f"{verdict['code']}: {verdict['reason']}", style=style), soft_wrap=True)


def show_pose(console: "Console", what: str, pose: Document) -> None:
    """Print a pose."""
    xyz = ", ".join(f"{value:.3f}" for value in pose["xyz_mm"])
    quat = " ".join(f"{value:.6f}" for value in pose["quat_xyzw"])
    console.print(f"{what}, mm: {xyz}")
    console.print(f"Orientation, quaternion x y z w: {quat}")


def show_held_out(console: "Console", held_out: Document) -> None:
    """Print the distances of samples that were not used to solve."""
    console.print(
        f"Not used to solve, {held_out['n']} samples: mean {held_out['mean_mm']:.3f} mm, rms "
        f"{held_out['rms_mm']:.3f} mm, largest {held_out['max_mm']:.3f} mm"
    )
    show_rejected(console, held_out["rejected_because"])


def show_rejected(console: "Console", because: Document) -> None:
    """Print which samples were left out, and why: those of one reason together."""
    same: dict[str, list[str]] = {}
    for name, why in because.items():
        same.setdefault(why, []).append(name)
    for why, names in same.items():
        who = ", ".join(names[:MOST_NAMED]) + (", …" if len(names) > MOST_NAMED else "")
        count = f"{len(names)} samples, " if len(names) > 1 else ""
        console.print(f"Not used: {count}{who}: {why}", soft_wrap=True, markup=False)


def show_sigma(console: "Console", sigma: Document) -> None:
    """Print standard deviations of a pose."""
    xyz = ", ".join(f"{value:.3f}" for value in sigma["xyz_mm"])
    turns = ", ".join(f"{value:.4f}" for value in sigma["rot_deg"])
    console.print(f"Standard deviations: {xyz} mm; {turns} deg")
