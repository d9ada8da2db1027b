"""Targets that a sensor is shown, as they are known before the calibration."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.board import Chessboard, Intrinsics

Array = NDArray[np.float64]

CornerKind = Literal["convex", "concave", "both"]
FirstStep = Literal["lowest", "highest"]

MACHINING_M = 1e-4 / 3.0  # one sigma of a target that is machined to 0.1 mm
NEAR, FAR = "near", "far"


@dataclass(frozen=True)
class SphereTarget:
    """A sphere that stands still, anywhere; ``radius_m`` is its true radius."""

    radius_m: float


@dataclass(frozen=True, eq=False)
class StepTarget:
    """Corners of parallel edges at known places.

    Attributes
    ----------
    T_base_user : (4, 4), m; the user frame that was taught at the target.
    corners : of each mark the corners (k, 3), m, user frame, in the order in which a profile that
        is laid through this mark shows them.
    edge_user : (3,) unit vector along the edges, user frame.
    sigma_m : machining error of each corner's coordinate, one sigma.
    user_sigma_m, user_sigma_rad : error of ``T_base_user`` about each axis, one sigma; it is
        common to all corners.
    """

    T_base_user: Array
    corners: Mapping[str, Array]
    edge_user: Array
    sigma_m: float = MACHINING_M
    user_sigma_m: float = 0.0
    user_sigma_rad: float = 0.0


@dataclass(frozen=True, eq=False)
class LineTarget:
    """A straight edge or groove at a known place: a point (3,), m, and a unit vector (3,), base."""

    point_base: Array
    direction_base: Array


@dataclass(frozen=True, eq=False)
class BoardTarget:
    """A chessboard that a camera sees, and what is known of this camera.

    Attributes
    ----------
    columns, rows, square_m : see `Chessboard`.
    matrix, distortion, size : see `Intrinsics`; all three, or None: found from the images.
    """

    columns: int
    rows: int
    square_m: float
    matrix: Array | None = None
    distortion: Array | None = None
    size: Array | None = None

    @property
    def board(self) -> Chessboard:
        """The chessboard alone. Raises `InputError` when it has too few corners."""
        return Chessboard(self.columns, self.rows, self.square_m)

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The camera as it is given."""
        if self.matrix is None or self.distortion is None or self.size is None:
            return None
        width, height = self.size
        return Intrinsics(self.matrix, self.distortion, (int(width), int(height)))


@dataclass(frozen=True)
class Staircase:
    """Equal steps, cut from one block.

    The user frame lies in the lowest front edge: x along the edges, from one end of the block to
    the other, y into the steps, z up. Step i = 0, 1 … has its riser at ``y = i depth``, its tread
    at ``z = (i + 1) height`` and its marks at a third (near) and two thirds (far) of its length.

    Attributes
    ----------
    steps : number of treads.
    length_m, height_m, depth_m : of a step along x, z and y.
    corners : which of them a profile is read for. Riser and tread of one step meet in a convex
        corner, a tread and the next riser in a concave one.
    first : the step with which a profile begins.
    """

    steps: int
    length_m: float
    height_m: float
    depth_m: float
    corners: CornerKind = "convex"
    first: FirstStep = "lowest"

    @property
    def edge_user(self) -> Array:
        """Unit vector (3,) along the edges, user frame."""
        return np.array([1.0, 0.0, 0.0])

    def marked_corners(self) -> dict[str, Array]:
        """Corners (k, 3) of each mark, m, user frame, in the order of a profile."""
        yz = []
        for step in range(self.steps):
            front = step * self.depth_m
            if step > 0 and self.corners != "convex":
                yz.append([front, step * self.height_m])
            if self.corners != "concave":
                yz.append([front, (step + 1) * self.height_m])
        section = np.array(yz).reshape(-1, 2)
        if self.first == "highest":
            section = section[::-1]
        places = {NEAR: self.length_m / 3.0, FAR: 2.0 * self.length_m / 3.0}
        return {mark: np.insert(section, 0, x, axis=1) for mark, x in places.items()}


# ---- target documents ---------------------------------------------------------------------------


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
