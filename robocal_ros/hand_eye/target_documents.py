"""Targets as plain documents (JSON, SI), exact to the last bit: as recordings carry them."""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.targets import BoardTarget, LineTarget, SphereTarget, StepTarget

Array = NDArray[np.float64]
Document = dict[str, Any]
Target = SphereTarget | StepTarget | LineTarget | BoardTarget

KIND_OF: dict[type[Target], str] = {
    SphereTarget: "sphere",
    StepTarget: "step",
    LineTarget: "line",
    BoardTarget: "camera",  # the target of a camera, of which more is known
}
SHAPE_OF = {
    "T_base_user": (4, 4), "edge_user": (3,), "point_base": (3,), "direction_base": (3,),
    "matrix": (3, 3), "size": (2,),
}  # fmt: skip
TYPE_OF = {kind: type_ for type_, kind in KIND_OF.items()}


def target_document(kind: str, target: Target | None) -> Document:
    """A target with its ``kind``; None where nothing is known of it beforehand.

    Raises
    ------
    InputError
        When the target is of another kind.
    """
    if target is None:
        return {"kind": kind}
    if KIND_OF[type(target)] != kind:
        raise InputError(f"the target file describes a {KIND_OF[type(target)]}, not a {kind}")
    return {"kind": kind} | {f.name: _plain(getattr(target, f.name)) for f in fields(target)}


def target_of(document: Mapping[str, Any]) -> Target | None:
    """Read what `target_document` gave, also after JSON.

    Raises
    ------
    InputError
        When it is no such document.
    """
    values = {name: _array(value) for name, value in document.items() if name != "kind"}
    if not values:
        return None
    try:
        target = TYPE_OF[document["kind"]](**values)
        for field in fields(target):
            value = getattr(target, field.name)
            if value is not None or field.default is not None:
                _require_numbers(field.name, value)
        return target
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"the target cannot be read: {error}") from error


def _require_numbers(name: str, value: Any) -> None:
    """Raise ValueError where a value has another shape, or is not finite."""
    if name == "corners":
        if not isinstance(value, Mapping) or not value:
            raise ValueError("corners has no mark")
        for mark, rows in value.items():
            _require_numbers(f"corners of {mark}", rows)
        return
    shape = SHAPE_OF.get(name, (max(len(value), 1), 3) if name.startswith("corners") else ())
    if name == "distortion":
        shape = (max(len(value), 1),)
    if np.shape(value) != shape or not np.all(np.isfinite(np.asarray(value, dtype=np.float64))):
        raise ValueError(f"{name} must be finite numbers of shape {shape}")
    if name == "radius_m" and not value > 0.0:
        raise ValueError(f"radius_m is {value}")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    return np.asarray(value).tolist()


def _array(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _array(part) for name, part in value.items()}
    return np.array(value, dtype=np.float64) if isinstance(value, list) else value
