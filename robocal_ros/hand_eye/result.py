"""The outcome of a hand-eye calibration, whatever the target."""

import re
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, summarise, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.frames import transform_document

Array = NDArray[np.float64]
Document = dict[str, Any]
Method = Literal["best", "classic"]
TargetKind = Literal["sphere", "step", "line", "tracker", "camera", "joint"]


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """Where a sensor sits.

    Attributes
    ----------
    kind, method : of the target and of the estimator.
    T_flange_sensor : (4, 4), m. For a sensor that does not move (eye-to-hand) ``parent`` is "base"
        and this is T_base_sensor.
    covariance : (6, 6) of the `increment` (v, w) to the true pose, m and rad, sensor axes: a turn
        about ``pivot`` (3,), sensor frame, and its shift; None where the method tells none. About
        the middle of what was seen it is a Gaussian even where the sensor's origin moves far.
    samples : names (n,) of the samples used; ``residual_m`` (n,) their distances, and
        ``residual_rad`` (n,) their angles where the target has any.
    leave_one_out_m : (n,) distance of each sample from the solution without it; None where too few
        samples remain to solve without one.
    rejected : name of each sample not used, with the reason.
    target : what was found of the target, as a document (``center_mm``, ``line`` …); place: the
        same as the target's model has it, where there is one.
    working_error_m : rms error to expect of a point at the working distance; None if not known.
    more : further entries of the document, such as ``point_residual_mm``.
    """

    kind: TargetKind
    method: Method
    T_flange_sensor: Array
    covariance: Array | None
    samples: tuple[str, ...]
    residual_m: Array
    verdict: Verdict
    residual_rad: Array | None = None
    leave_one_out_m: Array | None = None
    rejected: Mapping[str, str] = field(default_factory=dict)
    unobservable: tuple[str, ...] = ()
    target: Document = field(default_factory=dict)
    working_error_m: float | None = None
    more: Document = field(default_factory=dict)
    parent: Literal["flange", "base"] = "flange"
    pivot: Array = field(default_factory=lambda: np.zeros(3))
    place: Array | None = None


def increment(T_from: Array, T_to: Array, pivot: Array) -> Array:
    """(v, w) (6,) from T_from to T_to, along T_from's axes: a pivot moves by v, turned by w."""
    T = frames.invert(T_from) @ T_to
    return np.concatenate([T[:3, :3] @ pivot + T[:3, 3] - pivot, frames.log_rotation(T[:3, :3])])


def moved_origin(step: Array, pivot: Array) -> Array:
    """An increment (v, w) (6,) about a pivot as one about the origin, to first order."""
    return np.concatenate([step[:3] - np.cross(step[3:], pivot), step[3:]])


def at_origin(covariance: Array, pivot: Array) -> Array:
    """Covariance (6, 6) of increments about a pivot as of those about the origin."""
    move = np.eye(6)
    move[:3, 3:] = frames.skew(pivot)
    return np.asarray(move @ covariance @ move.T)


def point_jacobian(points: Array) -> Array:
    """How points (n, 3), counted from the pivot, move with an increment: (n, 3, 6)."""
    return np.concatenate(
        [np.broadcast_to(np.eye(3), (len(points), 3, 3)), -frames.skew(points)], axis=2
    )


def point_covariance(result: HandEyeResult, points: Array) -> Array:
    """Covariance (n, 3, 3), m^2, sensor axes, of sensor points (n, 3) once they are in the flange.

    Raises
    ------
    ValueError
        When the method tells no covariance.
    """
    if result.covariance is None:
        raise ValueError("a method without a covariance")
    J = point_jacobian(points - result.pivot)
    return np.asarray(J @ result.covariance @ np.swapaxes(J, 1, 2))


def parent_covariance(result: HandEyeResult) -> Array | None:
    """Covariance (6, 6) of the sensor's origin and of its turn, along the parent's axes."""
    if result.covariance is None:
        return None
    turn = np.kron(np.eye(2), result.T_flange_sensor[:3, :3])
    return np.asarray(turn @ at_origin(result.covariance, result.pivot) @ turn.T)


def hand_eye_document(result: HandEyeResult) -> Document:
    """The document of ``robocal hand-eye`` and of the history, in the units people read.

    ``covariance`` (6, 6), SI, and ``sigma``: of the sensor's origin, and of its turn about that
    origin, both along the axes of the parent frame, to first order: where turns are uncertain the
    origin moves on an arc. ``covariance_at_pivot``, sensor axes, holds there too: of the
    `increment` about ``pivot_mm``, a point of the sensor frame. A shot whose
    corners were all rejected is named once.
    """
    covariance, rejected = parent_covariance(result), by_shot(result.rejected, result.samples)
    return {
        "kind": result.kind,
        "method": result.method,
        f"T_{result.parent}_sensor": transform_document(result.T_flange_sensor),
        "sigma": _sigma_document(covariance),
        "covariance": None if covariance is None else covariance.tolist(),
        "pivot_mm": (result.pivot * 1e3).tolist(),
        "covariance_at_pivot": None if result.covariance is None else result.covariance.tolist(),
        "target": result.target,
        "residual_mm": _residual_document(result.samples, result.residual_m * 1e3),
        "residual_deg": None
        if result.residual_rad is None
        else _residual_document(result.samples, np.degrees(result.residual_rad)),
        "leave_one_out_mm": _left_out_document(result.leave_one_out_m),
        "working_error_mm": None
        if result.working_error_m is None
        else result.working_error_m * 1e3,
        "rejected": list(rejected),
        "rejected_because": rejected,
        "unobservable": list(result.unobservable),
        "held_out": None,
        **result.more,
        "verdict": verdict_document(result.verdict),
    }


def by_shot(rejected: Mapping[str, str], samples: Collection[str]) -> dict[str, str]:
    """Reasons by name; a shot that has no corner among the samples used stands there once."""
    used = shots_of(samples)
    found: dict[str, list[str]] = {}
    for name, why in rejected.items():
        shot = _shots_alone(name)
        if shot in used:
            found[name] = [why]
        else:
            found.setdefault(shot, []).append(_shots_alone(why))
    return {name: max(reasons, key=reasons.count) for name, reasons in found.items()}


def shots_of(names: Iterable[str]) -> set[str]:
    """Names of the shots that samples are named after: several corners may be of one."""
    return {_shots_alone(name) for name in names}


def _shots_alone(words: str) -> str:
    """Names of corners in words as those of their shots."""
    return re.sub(r"/corner \d+\b", "", words)


def _sigma_document(covariance: Array | None) -> Document | None:
    if covariance is None:
        return None
    sigma = np.sqrt(np.diag(covariance))
    return {"xyz_mm": (sigma[:3] * 1e3).tolist(), "rot_deg": np.degrees(sigma[3:]).tolist()}


def _residual_document(samples: tuple[str, ...], residual: Array) -> Document:
    return {
        "rms": float(np.sqrt(np.mean(residual**2))),
        "max": float(np.max(residual)),
        "per_sample": dict(zip(samples, residual.tolist(), strict=True)),
    }


def _left_out_document(distance_m: Array | None) -> Document | None:
    if distance_m is None:
        return None
    told = summarise(distance_m)
    return {
        "mean": told.mean_m * 1e3,
        "rms": told.rms_m * 1e3,
        "p95": told.p95_m * 1e3,
        "max": told.max_m * 1e3,
    }
