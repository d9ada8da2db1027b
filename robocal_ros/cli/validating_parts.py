"""Replayed tool and hand-eye sessions: their results, and how far they are from the truth."""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cli.output import Document
from robocal_ros.cli.replay_parts import seconds
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, InputError
from robocal_ros.session.events import ACCEPT, Command

Array = NDArray[np.float64]
Truth = Sequence[tuple[int, Array]]


def tool_runs(replayed: Document, truth: Truth) -> list[Document]:
    """Each run: what it found; the true error of a tip that it gives, where a truth is told."""
    return [_run(run, truth) for run in replayed["runs"]]


def _run(run: Document, truth: Truth) -> Document:
    change = run.get("change") or {}
    sigma = run.get("sigma_mm")
    true = _at(truth, round(run["stamp"] * 1e9))
    error = None
    if true is not None and "tcp_mm" in run:
        error = float(np.linalg.norm(np.array(run["tcp_mm"]) - true[:3, 3] * 1e3))
    return {
        "run": run["run"],
        "stamp": run["stamp"],
        "answer": run.get("answer", "measured"),
        "tcp_mm": run.get("tcp_mm"),
        "change_mm": change.get("tip_mm"),
        "change_deg": change.get("axis_deg"),
        "sigma_mm": float(np.linalg.norm(sigma)) if isinstance(sigma, list) else sigma,
        "misfit_mm": run.get("misfit_mm"),
        "true_error_mm": error,
        "verdict": run["verdict"],
    }


def calibrations(replayed: Document, truth: Truth) -> list[Document]:
    """Each placement of a sensor: its figures, and the true error at the working distance."""
    return [_calibration(found, truth) for found in replayed["calibrations"]]


def _calibration(found: Document, truth: Truth) -> Document:
    pose, away_mm = found.get("T_flange_sensor"), found.get("working_distance_mm")
    true = _at(truth, round(found["stamp"] * 1e9))
    error = None
    if true is not None and pose is not None and away_mm is not None:
        T = frames.transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"])
        at = np.array([0.0, 0.0, away_mm * 1e-3, 1.0])
        error = float(np.linalg.norm(((T - true) @ at)[:3]) * 1e3)
    return {
        "stamp": found["stamp"],
        "kind": found["kind"],
        "method": found["method"],
        "T_flange_sensor": pose,
        "residual_rms_mm": (found.get("residual_mm") or {}).get("rms"),
        "left_out": found.get("leave_one_out_mm"),
        "predicted_rms_mm": found.get("working_error_mm"),
        "working_distance_mm": away_mm,
        "true_error_mm": error,
        "rejected": list(found.get("rejected", [])),
        "verdict": found["verdict"],
    }


def _at(truth: Truth, stamp_ns: int) -> Array | None:
    """What was true at a stamp: told last before it, else first of all."""
    told = [T for at_ns, T in truth if at_ns <= stamp_ns] or [T for _, T in truth[:1]]
    return told[-1] if told else None


def decisions(
    commands: Sequence[Document], routine: Sequence[str], *, asked: bool
) -> list[dict[str, Any]]:
    """Commands with their code and reason, without routine steps that were carried out.

    ``asked``: somebody gave the commands; else an acceptance that did not come about is none.
    """
    return [
        {name: entry[name] for name in ("stamp", "command", "code", "message")}
        for entry in commands
        if not (
            entry["command"] in routine if entry["code"] == "ACCEPT" else _unasked(entry, asked)
        )
    ]


def as_recorded(command: Command, outcome: Mapping[str, Any]) -> Document:
    """A decision of a node that is not replayed."""
    return {
        "stamp": seconds(command.stamp_ns),
        "command": command.name,
        "code": Code(outcome["status"]).name,
        "message": str(outcome["message"]),
    }


def require_finite(told: Any, path: str, field: str = "") -> None:
    """See that a bag's document has finite numbers alone, for JSON knows no others.

    Raises
    ------
    InputError
        With the bag and the number's place in the document.
    """
    if isinstance(told, float) and not math.isfinite(told):
        raise InputError(f"{field} is {told}, which is no finite number", file=path)
    parts: Iterable[tuple[str, Any]] = ()
    if isinstance(told, dict):
        parts = ((f"{field}.{name}" if field else name, part) for name, part in told.items())
    elif isinstance(told, list | tuple):
        parts = ((f"{field}[{i}]", part) for i, part in enumerate(told))
    for name, part in parts:
        require_finite(part, path, name)


def _unasked(entry: Document, asked: bool) -> bool:
    return not asked and entry["command"] == ACCEPT
