# SPDX-License-Identifier: Apache-2.0
"""Targets that a sensor is shown, as they are known before the calibration, and their files.

Files are YAML, in millimetres and degrees; the contract is written in docs/hand_eye.md,
hand_eye_tracker.md and, of a board, hand_eye_node.md.
"""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, Document
from robocal_ros.hand_eye.boards import (
    DICTIONARIES,
    FEWEST_CORNERS,
    Chessboard,
    Intrinsics,
    Markers,
    read_intrinsics,
)
from robocal_ros.kinematics.robots import Fields, read_fields, read_pose


@dataclass(frozen=True)
class TrackerTarget:
    """Sizes of what is measured.

    The sensor scans the sphere and the tracker measures its centre; the tracked ball (reflector)
    touches the faces of the cube. ``height_m``: coordinate of the reflector on the flange, from
    the flange's origin along the axis of the last turning joint of the arcs; needed where the
    other joint slides.
    """

    sphere_radius_m: float
    reflector_radius_m: float
    height_m: float | None = None
    height_sigma_m: float = 2e-5


ARCS, SPHERE, FACES = ("arc_a", "arc_b"), "sphere", ("face_1", "face_2")
ROLES = (*ARCS, SPHERE, *FACES)  # of what a tracker measures

CornerKind = Literal["convex", "concave", "both"]
FirstStep = Literal["lowest", "highest"]

MACHINING_M = 1e-4 / 3.0  # one sigma of a target that is machined to 0.1 mm
NEAR, FAR = "near", "far"
KINDS = ("sphere", "step", "line", "board", "charuco", "tracker")
CORNERS: dict[str, CornerKind] = {"convex": "convex", "concave": "concave", "both": "both"}
FIRST: dict[str, FirstStep] = {"lowest": "lowest", "highest": "highest"}
SMALLEST_MM, LARGEST_MM = 1.0, 1000.0  # of a sphere's radius
FARTHEST_MM = 20e3  # of a target from the base
FARTHEST_REFLECTOR_MM = 1e3  # of the reflector from the flange's origin
ROUNDING = 1e-3  # of the axes of a frame, from unit vectors at right angles
MOST_STEPS = 100
MOST_CORNERS = 100  # along a side of a board
CAMERA_INFO = "camera_info"  # in the place of a file of intrinsics: the topic


@dataclass(frozen=True)
class SphereTarget:
    """A sphere that stands still, anywhere; ``radius_m`` is its true radius."""

    radius_m: float


@dataclass(frozen=True, eq=False)
class StepTarget:
    """Corners of parallel edges at known places.

    ``T_base_user`` (4, 4), m; the user frame that was taught at the target. ``corners``: of each
    mark the corners (k, 3), m, user frame, in the order in which a profile that is laid through
    this mark shows them. ``edge_user`` (3,) unit vector along the edges, user frame. ``sigma_m``:
    machining error of each corner's coordinate, one sigma. ``user_sigma_m``, ``user_sigma_rad``:
    error of ``T_base_user`` about each axis, one sigma; it is common to all corners. ``convex``
    (k,): which of a mark's corners are outer edges, of each mark alike; None where nothing is told.

    Raises `ValueError` where a mark has another number of corners than ``convex`` tells.
    """

    T_base_user: Array
    corners: Mapping[str, Array]
    edge_user: Array
    sigma_m: float = MACHINING_M
    user_sigma_m: float = 0.0
    user_sigma_rad: float = 0.0
    convex: Array | None = None

    def __post_init__(self) -> None:
        if self.convex is not None:
            for mark, rows in self.corners.items():
                if len(rows) != len(self.convex):
                    raise ValueError(f"convex tells {len(self.convex)}, {mark} has {len(rows)}")

    def require_marks(self, marks: Iterable[str]) -> None:
        """Raise `InputError`, naming the first of the marks that the target does not have."""
        strange = next((mark for mark in marks if mark not in self.corners), None)
        if strange is not None:
            raise InputError(f"mark '{strange}' is not one of {', '.join(self.corners)}")


@dataclass(frozen=True, eq=False)
class LineTarget:
    """A straight edge or groove at a known place: a point (3,), m, and a unit vector (3,), base."""

    point_base: Array
    direction_base: Array


@dataclass(frozen=True, eq=False)
class BoardTarget:
    """A chessboard that a camera sees, and what is known of this camera.

    ``columns``, ``rows``, ``square_m``: see `Chessboard`.
    ``matrix``, ``distortion``, ``size``, ``model``: see `Intrinsics`; of the first three all, or
    None: found from the images.
    ``dictionary``, ``marker_m``, ``legacy``: of a ChArUco board, see `Markers`; empty: none.
    ``camera_info``: the camera is what the topic tells, of rectified images where ``rectified``.
    """

    columns: int
    rows: int
    square_m: float
    matrix: Array | None = None
    distortion: Array | None = None
    size: Array | None = None
    model: str = "plumb_bob"
    dictionary: str = ""
    marker_m: float = 0.0
    legacy: bool = False
    camera_info: bool = False
    rectified: bool = False

    @property
    def board(self) -> Chessboard:
        """The board alone. Raises `InputError` when no board is like that."""
        markers = None
        if self.dictionary:
            markers = Markers(self.dictionary, self.marker_m, bool(self.legacy))
        return Chessboard(self.columns, self.rows, self.square_m, markers)

    @property
    def intrinsics(self) -> Intrinsics | None:
        """The camera as it is given."""
        if self.matrix is None or self.distortion is None or self.size is None:
            return None
        width, height = self.size
        return Intrinsics(self.matrix, self.distortion, (int(width), int(height)), model=self.model)

    def with_intrinsics(self, camera: Intrinsics) -> "BoardTarget":
        """The same board before a known camera."""
        size = np.array(camera.size, dtype=np.float64)
        return replace(
            self, matrix=camera.matrix, distortion=camera.distortion, size=size, model=camera.model
        )


@dataclass(frozen=True)
class Staircase:
    """Equal steps, cut from one block.

    The user frame lies in the lowest front edge: x along the edges, from one end of the block to
    the other, y into the steps, z up. Step i = 0, 1 … has its riser at ``y = i depth``, its tread
    at ``z = (i + 1) height`` and its marks at a third (near) and two thirds (far) of its length.

    ``steps``: number of treads. ``length_m``, ``height_m``, ``depth_m``: of a step along x, z and
    y. ``corners``: which of them a profile is read for. Riser and tread of one step meet in a
    convex corner, a tread and the next riser in a concave one. ``first``: the step with which a
    profile begins.
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

    @property
    def convex(self) -> Array:
        """Which of a mark's corners (k,) are outer edges; from either end the same."""
        if self.corners == "both":
            return np.asarray(np.arange(2 * self.steps - 1) % 2 == 0)
        outer = self.corners == "convex"
        return np.full(self.steps if outer else self.steps - 1, outer)

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

    def target(self, T_base_user: Array, **known: Any) -> StepTarget:
        """The target in its user frame (4, 4), m; ``known``: what else is told, as `StepTarget`."""
        own: Document = {"corners": self.marked_corners(), "edge_user": self.edge_user}
        return StepTarget(T_base_user, **(own | {"convex": self.convex} | known))


LaserTarget = SphereTarget | StepTarget | LineTarget
Target = LaserTarget | BoardTarget | TrackerTarget

KIND_OF: dict[type[Target], str] = {
    SphereTarget: "sphere",
    StepTarget: "step",
    LineTarget: "line",
    BoardTarget: "camera",  # the target of a camera, of which more is known
    TrackerTarget: "tracker",
}
SHAPE_OF = {
    "T_base_user": (4, 4), "edge_user": (3,), "point_base": (3,), "direction_base": (3,),
    "matrix": (3, 3), "size": (2,),
}  # fmt: skip
TYPE_OF = {kind: type_ for type_, kind in KIND_OF.items()}


def target_document(kind: str, target: Target | None) -> Document:
    """A target with its ``kind``; None where nothing is known of it beforehand.

    Raises `InputError` when the target is of another kind.
    """
    if target is None:
        return {"kind": kind}
    if KIND_OF[type(target)] != kind:
        raise InputError(f"the target file describes a {KIND_OF[type(target)]}, not a {kind}")
    return {"kind": kind} | {f.name: _plain(getattr(target, f.name)) for f in fields(target)}


def target_of(document: Mapping[str, Any]) -> Target | None:
    """Read what `target_document` gave, also after JSON.

    Raises `InputError` when it is no such document.
    """
    values = {name: _array(value) for name, value in document.items() if name != "kind"}
    if not values:
        return None
    try:
        target = TYPE_OF[document["kind"]](**values)
        for field in fields(target):
            value = getattr(target, field.name)
            if isinstance(field.default, str):
                if not isinstance(value, str):
                    raise ValueError(f"{field.name} is {value}")
            elif value is not None or field.default is not None:
                _require_numbers(field.name, value)
        return target
    except (AttributeError, KeyError, TypeError, ValueError) as error:
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
    if name in ("distortion", "convex"):
        shape = (max(len(value), 1),)
    if np.shape(value) != shape or not np.all(np.isfinite(np.asarray(value, dtype=np.float64))):
        raise ValueError(f"{name} must be finite numbers of shape {shape}")
    if name.endswith("radius_m") and not value > 0.0:
        raise ValueError(f"{name} is {value}")


def _plain(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {str(name): _plain(part) for name, part in value.items()}
    return np.asarray(value).tolist()


def _array(value: Any) -> Any:
    if isinstance(value, Mapping):
        return {name: _array(part) for name, part in value.items()}
    return np.array(value, dtype=np.float64) if isinstance(value, list) else value


def read_target(path: Path) -> Target:
    """Read a target file."""
    top = read_fields(path, "target file")
    kind = top.choice("kind", KINDS)
    if kind == "sphere":
        top.only("kind", "radius_mm")
        return SphereTarget(_radius(top, "radius_mm"))
    if kind in ("board", "charuco"):
        return _board(top, path.parent, kind == "charuco")
    if kind == "step":
        return _step(top)
    if kind == "tracker":
        return _tracker(top)
    top.only("kind", "point_mm", "direction")
    point_mm = np.array(top.numbers("point_mm", 3))
    _check_near(top, "point_mm", point_mm)
    return LineTarget(point_mm * 1e-3, _direction(top, "direction"))


def _radius(top: Fields, key: str) -> float:
    radius_mm = top.number(key)
    if not SMALLEST_MM <= radius_mm <= LARGEST_MM:
        top.fail(
            f"is {radius_mm:g}; it must be {SMALLEST_MM:g} to {LARGEST_MM:g}: is it off by a "
            "thousand?",
            key,
        )
    return radius_mm * 1e-3


def _board(top: Fields, folder: Path, marked: bool) -> BoardTarget:
    camera = ("intrinsics", "rectified")
    if marked:
        top.only("kind", "squares", "square_mm", "marker_mm", "dictionary", "legacy", *camera)
        sides = dict(zip("xy", top.numbers("squares", 2), strict=True))
        squares = Fields(sides, top.file, "squares")
        columns, rows = (squares.whole(side, FEWEST_CORNERS + 1, MOST_CORNERS) - 1 for side in "xy")
        board = BoardTarget(
            columns,
            rows,
            top.positive("square_mm") * 1e-3,
            dictionary=top.choice("dictionary", DICTIONARIES),
            marker_m=top.positive("marker_mm") * 1e-3,
            legacy=top.yes("legacy"),
        )
    else:
        top.only("kind", "columns", "rows", "square_mm", *camera)
        columns, rows = (
            top.whole(key, FEWEST_CORNERS, MOST_CORNERS) for key in ("columns", "rows")
        )
        board = BoardTarget(columns, rows, top.positive("square_mm") * 1e-3)
    try:
        _ = board.board
    except InputError as error:
        top.fail(f"describes no board: {error}")
    rectified = top.yes("rectified")
    given = top.text("intrinsics") if "intrinsics" in top.values else ""
    if given == CAMERA_INFO:
        return replace(board, camera_info=True, rectified=rectified)
    if rectified:
        top.fail(f"belongs to 'intrinsics: {CAMERA_INFO}'", "rectified")
    return board.with_intrinsics(read_intrinsics(folder / given)) if given else board


def _step(top: Fields) -> StepTarget:
    top.only(
        "kind", "T_base_user", "staircase", "corners_mm", "convex", "edge_user",
        "sigma_mm", "user_sigma_mm", "user_sigma_deg",
    )  # fmt: skip
    if ("staircase" in top.values) == ("corners_mm" in top.values):
        top.fail("must give either staircase, or corners_mm with edge_user")
    if "staircase" in top.values:
        for key, told in (("edge_user", "x"), ("convex", "told by corners")):
            if key in top.values:
                top.fail(f"is {told} for a staircase: leave it out", key)
        placed: Callable[..., StepTarget] = _staircase(top.below("staircase")).target
    else:
        corners, edge = _corners(top.below("corners_mm")), _direction(top, "edge_user")
        convex = _convex(top, corners)
        placed = partial(StepTarget, corners=corners, edge_user=edge, convex=convex)
    T_base_user = _user_frame(top.below("T_base_user"))
    sigma_m = top.positive("sigma_mm", MACHINING_M * 1e3) * 1e-3
    taught = {}
    for key in ("user_sigma_mm", "user_sigma_deg"):
        taught[key] = top.number(key)
        if taught[key] < 0.0:
            top.fail(f"is {taught[key]:g}; it must not be below 0", key)
    user_sigma_rad = float(np.radians(taught["user_sigma_deg"]))
    user_sigma_m = taught["user_sigma_mm"] * 1e-3
    return placed(
        T_base_user, sigma_m=sigma_m, user_sigma_m=user_sigma_m, user_sigma_rad=user_sigma_rad
    )


def _staircase(fields: Fields) -> Staircase:
    lengths = ("length_mm", "height_mm", "depth_mm")
    fields.only("steps", *lengths, "corners", "first")
    steps = fields.whole("steps", 1, MOST_STEPS)
    length, height, depth = (fields.positive(key) * 1e-3 for key in lengths)
    corners = CORNERS[fields.choice("corners", tuple(CORNERS), "convex")]
    if corners == "concave" and steps < 2:
        fields.fail("is 1; only between two steps there is a concave corner", "steps")
    first = FIRST[fields.choice("first", tuple(FIRST), "lowest")]
    return Staircase(steps, length, height, depth, corners, first)


def _corners(fields: Fields) -> dict[str, Array]:
    if not fields.values:
        fields.fail("must name at least one mark")
    corners = {}
    for mark, rows in fields.values.items():
        if not isinstance(mark, str) or not mark.strip():
            fields.fail("is no name of a mark: give a word", str(mark))
        if not isinstance(rows, list) or not rows:
            fields.fail("must be a list of corners [x, y, z]", mark)
        corners[mark] = 1e-3 * _points(rows, "corner", fields, mark)
    return corners


def _convex(top: Fields, corners: Mapping[str, Array]) -> Array | None:
    """Which corners (k,) are outer edges; None where it is left out."""
    if "convex" not in top.values:
        return None
    told = top.values["convex"]
    if not isinstance(told, list) or not all(isinstance(one, bool) for one in told):
        top.fail("must be a list of true and false, one of each corner", "convex")
    for mark, rows in corners.items():
        if len(rows) != len(told):
            top.fail(f"tells {len(told)} corners, {mark} has {len(rows)}", "convex")
    return np.array(told, dtype=np.bool_)


def _user_frame(fields: Fields) -> Array:
    """Transform (4, 4), m, of ``{xyz_mm, quat_xyzw or rpy_deg or rotation}``."""
    if "rotation" in fields.values:
        fields.only("xyz_mm", "rotation")
        rows = fields.values["rotation"]
        if not isinstance(rows, list) or len(rows) != 3:
            fields.fail("must be a list of 3 rows of a matrix", "rotation")
        R = _points(rows, "row", fields, "rotation")
        error = float(np.abs(R.T @ R - np.eye(3)).max())
        if error > ROUNDING:
            fields.fail(
                f"has columns that are not unit vectors at right angles (off by {error:.3g})",
                "rotation",
            )
        if np.linalg.det(R) < 0.0:
            fields.fail("is left-handed: its third column must be first x second", "rotation")
        xyz_mm = np.array(fields.numbers("xyz_mm", 3))
        T = frames.transform(frames.nearest_rotation(R), xyz_mm * 1e-3)
    else:
        if not {"quat_xyzw", "rpy_deg"} & set(fields.values):
            fields.fail("needs an orientation: quat_xyzw, rpy_deg or rotation")
        T = read_pose(fields)
    _check_near(fields, "xyz_mm", T[:3, 3] * 1e3)
    return T


def _points(rows: list[Any], name: str, fields: Fields, key: str) -> Array:
    """A list of points (n, 3); ``name`` is what one of them is called."""
    values = {f"{name} {i}": row for i, row in enumerate(rows, start=1)}
    numbered = Fields(values, fields.file, f"{fields.place}, {key}")
    return np.array([numbered.numbers(key, 3) for key in values])


def _direction(fields: Fields, key: str) -> Array:
    vector = np.array(fields.numbers(key, 3))
    length = float(np.linalg.norm(vector))
    if length == 0.0:
        fields.fail("has no length", key)
    return vector / length


def _check_near(fields: Fields, key: str, point_mm: Array) -> None:
    distance = float(np.linalg.norm(point_mm))
    if distance > FARTHEST_MM:
        fields.fail(
            f"is {distance:.4g} mm from the base: is it a thousand times too far, in µm?", key
        )


def read_tracker_target(path: Path) -> TrackerTarget:
    """Read the target file of a calibration by laser tracker."""
    top = read_fields(path, "target file")
    top.choice("kind", ("tracker",))
    return _tracker(top)


def _tracker(top: Fields) -> TrackerTarget:
    top.only("kind", "sphere_radius_mm", "reflector_radius_mm", "height_mm", "height_sigma_mm")
    target = TrackerTarget(_radius(top, "sphere_radius_mm"), _radius(top, "reflector_radius_mm"))
    if "height_mm" not in top.values:
        if "height_sigma_mm" in top.values:
            top.fail("is given without height_mm", "height_sigma_mm")
        return target
    height_mm = top.number("height_mm")
    if abs(height_mm) > FARTHEST_REFLECTOR_MM:
        top.fail(f"is {height_mm:g}; the reflector is on the flange: is it in µm?", "height_mm")
    sigma_mm = top.positive("height_sigma_mm", target.height_sigma_m * 1e3)
    return replace(target, height_m=height_mm * 1e-3, height_sigma_m=sigma_mm * 1e-3)
