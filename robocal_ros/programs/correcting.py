# SPDX-License-Identifier: Apache-2.0
"""Programs corrected point by point for the robot as it is.

The controller reckons with its own nominal model. For taught joints q, which a pose of the program
has by the nominal model and its configuration, the joints q' are sought at which the robot as
identified stands where the program means it,

    T_actual(q') = T_reference(q),      p' = T_base_frame^-1 T_nominal(q') T_flange_tool,      (1)

and p', or q' itself for a point given by joints, is written in place of p. Sent there, the
controller moves to q', and the robot stands right. The tool drops out of the first equation: it is
the same on both sides. ``reference`` is the nominal model for a program that was made off line, and
the robot as it was when it was taught for one that was taught by hand.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import numbers_of, pose_of
from robocal_ros.programs.fanuc import FanucDialect
from robocal_ros.programs.kawasaki import KawasakiDialect
from robocal_ros.programs.krl import KrlDialect
from robocal_ros.programs.points import (
    OF_LINE,
    Dialect,
    Field,
    Program,
    ProgramPoint,
    base_moved,
    spliced,
    written,
)
from robocal_ros.programs.postures import (
    CorrectionModels,
    chosen_posture,
    is_singular,
    reach,
    stance_of,
)
from robocal_ros.programs.rapid import RapidDialect
from robocal_ros.programs.urscript import UrScriptDialect

if TYPE_CHECKING:
    from robocal_ros.programs.documents import ProgramPointDocument, ProgramReportDocument

DIALECTS: tuple[Dialect, ...] = (
    KrlDialect(),
    RapidDialect(),
    FanucDialect(),
    UrScriptDialect(),
    KawasakiDialect(),
)
# Below this nothing is to be corrected: no format has as many digits.
LEAST_M, LEAST_RAD = 1e-7, 1e-7


@dataclass(frozen=True, eq=False)
class CorrectedPoint:
    """What became of a point.

    ``q``, ``q_corrected`` (n,): its joints before and after; None where they are not known.
    ``shift_m``, ``shift_rad``: of what is written. ``left_m``, ``left_rad``: by which the robot as
    identified misses the place with the digits that are written, at the tool, of joints at the
    flange; without a correction, where its joints are known, with those that were there.
    ``reason``: why it was not corrected; empty where it was, or nothing was to be done.
    """

    point: ProgramPoint
    reason: str = ""
    q: Array | None = None
    q_corrected: Array | None = None
    shift_m: float = 0.0
    shift_rad: float = 0.0
    left_m: float | None = None
    left_rad: float | None = None
    changes: tuple[tuple[Field, str], ...] = ()


@dataclass(frozen=True, eq=False)
class CorrectedProgram:
    """A program's text with its points corrected; ``points`` in the order of the text."""

    text: str
    points: tuple[CorrectedPoint, ...]
    program: Program


def dialect_of(suffix: str) -> Dialect:
    """How a file with such an ending is written. Raises `InputError` for an unknown one."""
    for dialect in DIALECTS:
        if suffix.lower() in dialect.suffixes:
            return dialect
    known = ", ".join(suffix for dialect in DIALECTS for suffix in dialect.suffixes)
    raise InputError(f"'{suffix}' is no ending of a program; known are {known}")


class ProgramCorrection:
    """Corrects one program.

    ``given``: frames beside those of the program, by name. ``tool``, ``frame``: names of those of
    points for which the program says none. ``posture`` (n,): joints near which the first point is
    whose configuration nothing says; None: it is not corrected. ``external``: where external axes
    carry the robot, see `base_moved`.
    """

    def __init__(
        self,
        dialect: Dialect,
        models: CorrectionModels,
        given: Mapping[str, Array] | None = None,
        tool: str | None = None,
        frame: str | None = None,
        posture: Array | None = None,
        external: Mapping[int, Array] | None = None,
    ) -> None:
        self._dialect, self._models = dialect, models
        self._external = external or {}
        self._given = {name.lower(): T for name, T in (given or {}).items()}
        self._tool, self._frame, self._before = tool, frame, posture

    def correct(self, text: str) -> CorrectedProgram:
        """The program with every point corrected that can be."""
        program = self._dialect.read(text)
        known = {name.lower(): T for name, T in program.frames.items()} | self._given
        found: dict[int, CorrectedPoint] = {}
        for i, point in sorted(enumerate(program.points), key=lambda pair: pair[1].order):
            try:
                found[i] = self._corrected(point, known)
            except LimitError as error:
                found[i] = CorrectedPoint(point, str(error))
        points = tuple(found[i] for i in range(len(program.points)))
        changes = [change for point in points for change in point.changes]
        return CorrectedProgram(spliced(text, changes), points, program)

    def _corrected(self, point: ProgramPoint, known: Mapping[str, Array]) -> CorrectedPoint:
        if point.problem:
            raise LimitError(point.problem)
        ends = np.eye(4), np.eye(4)
        if not point.joints:
            T_base_frame = self._end(point, "frame", known).copy()
            T_base_frame[:3, 3] -= base_moved(point, self._external)
            ends = T_base_frame, self._end(point, "tool", known)
        T_base_frame, tool = ends
        nominal = self._models.nominal
        if point.joints:
            count = len(point.fields)
            if count != nominal.n:
                raise LimitError(f"{count} joints, {nominal.name} has {nominal.n}")
            q = self._dialect.to_arm(np.array(point.numbers) * point.joint_unit)
        else:
            T = pose_of(self._dialect.maker, point.numbers)
            T_base_flange = T_base_frame @ T @ frames.invert(tool)
            q = chosen_posture(nominal, T_base_flange, point.posture, self._before)
        self._before = q
        result = CorrectedPoint(point, q=q)
        wanted = self._models.reference.fk(q)
        corrected = self._solved(q, wanted)
        if isinstance(corrected, str):
            left_m, left_rad = frames.apart(self._models.actual.fk(q) @ tool, wanted @ tool)
            return replace(result, reason=corrected, left_m=left_m, left_rad=left_rad)
        shift_m, shift_rad = frames.apart(nominal.fk(corrected), nominal.fk(q))
        if shift_m < LEAST_M and shift_rad < LEAST_RAD:
            return replace(result, q_corrected=q, left_m=shift_m, left_rad=shift_rad)
        changes = self._changes(point, q, corrected, ends)
        numbers = [float(text) for _, text in changes]
        reached = self._commanded(point, numbers, corrected, ends)
        if point.marks:
            marks = self._dialect.marks(point, stance_of(nominal, reached))
            changes += [(point.marks[name], text) for name, text in marks.items()]
        left_m, left_rad = frames.apart(self._models.actual.fk(reached) @ tool, wanted @ tool)
        T_tool = [nominal.fk(one) @ tool for one in (q, corrected)]
        shift_m, shift_rad = frames.apart(T_tool[1], T_tool[0])
        return replace(
            result,
            q_corrected=corrected,
            shift_m=shift_m,
            shift_rad=shift_rad,
            left_m=left_m,
            left_rad=left_rad,
            changes=tuple(changes),
        )

    def _end(self, point: ProgramPoint, kind: str, known: Mapping[str, Array]) -> Array:
        """The frame or tool of a pose. Raises `LimitError` where it is not known."""
        name = point.tool if kind == "tool" else point.frame
        name = name if name is not None else self._tool if kind == "tool" else self._frame
        if name is None:
            option = "tool" if kind == "tool" else "base"
            raise LimitError(f"the program does not say its {kind}: give --{option} NAME")
        if name.lower() not in known:
            in_file = self._dialect.names_frames and OF_LINE not in name
            way = "--frames FILE or " if in_file else ""
            raise LimitError(f"unknown {kind} {name}: give {way}--frame '{name}=…'")
        return known[name.lower()]

    def _solved(self, q: Array, wanted: Array) -> Array | str:
        """Corrected joints (n,), or why there are none."""
        models = self._models
        found, reached = reach(models.actual, wanted[None], q[None])
        change = found[0] - q
        joint = int(np.argmax(np.abs(change) * np.where(models.nominal.prismatic, 0.0, 1.0)))
        if not reached[0] or abs(change[joint]) > models.largest_rad:
            if is_singular(models.actual, q):
                return "singular: a direction is not reached by small changes of the joints"
            if not reached[0]:
                return "the place is out of the robot's reach"
            return (
                f"{models.nominal.joint_names[joint]} would turn by "
                f"{np.degrees(change[joint]):.3f} deg, at most "
                f"{np.degrees(models.largest_rad):g} are allowed"
            )
        shift_m, _ = frames.apart(models.nominal.fk(found[0]), models.nominal.fk(q))
        if shift_m > models.largest_m:
            return (
                f"it would move by {1e3 * shift_m:.3f} mm, at most {1e3 * models.largest_m:g} are"
            )
        outside = (found[0] < models.nominal.lower) | (found[0] > models.nominal.upper)
        if np.any(outside):
            name = models.nominal.joint_names[int(np.argmax(outside))]
            return f"{name} would be beyond its limits"
        return np.asarray(found[0])

    def _changes(
        self, point: ProgramPoint, q: Array, corrected: Array, ends: tuple[Array, Array]
    ) -> list[tuple[Field, str]]:
        """New texts of the numbers."""
        decimals, old = self._dialect.decimals, point.numbers
        if point.joints:
            moved = self._dialect.from_arm(corrected) - self._dialect.from_arm(q)
            values = [
                value + step / point.joint_unit for value, step in zip(old, moved, strict=True)
            ]
            least = [decimals.joint] * len(values)
        else:
            T = frames.invert(ends[0]) @ self._models.nominal.fk(corrected) @ ends[1]
            values = numbers_of(self._dialect.maker, T, old)
            least = [decimals.length] * 3 + [decimals.turn] * (len(values) - 3)
        texts = [
            written(value, part, most, most if decimals.fixed else None)
            for value, part, most in zip(values, point.fields, least, strict=True)
        ]
        return list(zip(point.fields, texts, strict=True))

    def _commanded(
        self, point: ProgramPoint, numbers: list[float], near: Array, ends: tuple[Array, Array]
    ) -> Array:
        """Joints (n,) to which the controller moves with the numbers that are written."""
        if point.joints:
            return self._dialect.to_arm(np.array(numbers) * point.joint_unit)
        T = ends[0] @ pose_of(self._dialect.maker, numbers) @ frames.invert(ends[1])
        return np.asarray(reach(self._models.nominal, T[None], near[None])[0][0])


def report(done: CorrectedProgram) -> "ProgramReportDocument":
    """What became of each point, as a document (JSON)."""
    points = [_point_document(one) for one in done.points]
    states = [one["state"] for one in points]
    return {
        "points": points,
        "count": {
            "corrected": states.count("corrected"),
            "unchanged": states.count("unchanged"),
            "not_corrected": states.count("not_corrected"),
            "of_another_group": states.count("of_another_group"),
        },
        "warnings": list(done.program.notes),
        "computed": [{"line": line, "text": text} for line, text in done.program.computed],
    }


State = Literal["corrected", "unchanged", "not_corrected", "of_another_group"]
STATES: tuple[State, ...] = get_args(State)


def _point_document(one: CorrectedPoint) -> "ProgramPointDocument":
    state: State = "not_corrected" if one.reason else "corrected" if one.changes else "unchanged"
    if one.point.of_another:
        state = "of_another_group"
    return {
        "name": one.point.name,
        "line": one.point.line,
        "by": "joints" if one.point.joints else "pose",
        "state": state,
        "reason": one.reason,
        "shift_mm": 1e3 * one.shift_m,
        "shift_deg": float(np.degrees(one.shift_rad)),
        "left_mm": None if one.left_m is None else 1e3 * one.left_m,
        "left_deg": None if one.left_rad is None else float(np.degrees(one.left_rad)),
        "joints": None if one.q is None else one.q.tolist(),
    }
