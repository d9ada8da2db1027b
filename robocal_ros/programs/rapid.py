# SPDX-License-Identifier: Apache-2.0
r"""ABB RAPID modules (.mod, .sys, .prg): robtargets and jointtargets, tooldata and wobjdata.

    CONST robtarget p10:=[[600,0,812.5],[0.0,0.0,1.0,0.0],[0,-1,0,1],[9E9,9E9,9E9,9E9,9E9,9E9]];
    MoveL p10,v200,z10,tGripper\WObj:=wFixture;

A point's frames are those of the motions that name it. Sources are in docs/programs.md.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import DEGREE, pose_of
from robocal_ros.programs.points import (
    EDGE,
    Decimals,
    Dialect,
    Field,
    Posture,
    Program,
    ProgramPoint,
    Stance,
    arguments,
    line_of,
    masked,
    matching,
    require_numbers,
)

Tree = Field | list["Tree"]

QUADRANT = 90.0 * DEGREE
QUADRANT_OF = {"cf1": 0, "cf4": 3, "cf6": 5}

_DECLARED = re.compile(
    r"\b(?P<type>robtarget|jointtarget|tooldata|wobjdata)\s+(?P<name>\w+)\s*(?:\{[^}]*\})?\s*:=\s*(?=\[)",
    re.I,
)
_ASSIGNED = re.compile(r"(?:^|[;\n])\s*(?P<name>\w+)\s*(?:\{[^}]*\})?\s*:=\s*(?=\[)")
_SET = re.compile(r"(?<![\\.\w])(\w+)\s*:=")
_MOTION = r"(?:Move|Trigg|Arc|Spot|Search|Paint|Disp)\w*"
# A name that begins so (SearchOk, MODULE MoveParts) does not reach into the instruction behind it.
_ARGUMENTS = rf"(?:(?!(?<=[^\s,=(])\s+{_MOTION}(?:\s+\w|\s*\[|\s*\\\s*\w+\s*,))[^;:])*"
_MOVES = re.compile(rf"\b({_MOTION})\b(?!\s*\()({_ARGUMENTS}(?::={_ARGUMENTS})*);", re.I)
_PLAIN = {"movej": 1, "movel": 1, "movec": 2, "moveabsj": 1}
_TOOL_LAST = re.compile(r"Move(?:[JLC]|AbsJ)|(?:Trigg|Search|Arc|Spot|Paint|Disp)\w*", re.I)
_BY_JOINTS = re.compile(r"(?:Move|Trigg|Spot|Paint)J", re.I)
_CONF = re.compile(r"\bConf([JL])\b\s*(?:\\\s*(On|Off)\b)?\s*;", re.I)
_COMPUTED = re.compile(r"\b(Offs|RelTool)\s*\(\s*(\w+)", re.I)
_CHANGED = re.compile(
    r"\b\w+(?:\{[^}]*\})?\.(?:trans|rot|robconf|extax|robax|tframe|uframe|oframe)\b[^;:]*:=[^;]*"
    r"|\b\w+\s*:=\s*(?:CRobT|CJointT|CalcRobT|CalcJointT|MirPos)\b[^;]*"
    r"|\b(?:PDisp|EOffs)(?:On|Set)\b[^;]*",
    re.I,
)


@dataclass(frozen=True)
class _Motion:
    """Tool and work object of a motion that stands at ``at``; ``free``: ConfL or ConfJ is off."""

    tool: str
    frame: str
    at: int
    free: bool


class RapidDialect(Dialect):
    """ABB: a robtarget's quadrants follow the joints."""

    maker, suffixes = "abb", (".mod", ".sys", ".prg", ".modx", ".sysx")
    decimals = Decimals(length=4, turn=8, joint=6)
    names_frames = True

    def read(self, text: str) -> Program:
        """Robtargets and jointtargets, with the frames of the motions that name them."""
        clean = masked(text, "!")
        frames = {"tool0": np.eye(4), "wobj0": np.eye(4)}
        problems: dict[str, str] = {}
        points: list[tuple[str, ProgramPoint]] = []
        taken, declared = set(), set()
        for pattern in (_DECLARED, _ASSIGNED):
            for found in pattern.finditer(clean):
                if found.end() in taken:
                    continue
                taken.add(found.end())
                tree = _tree(clean, found.end())
                kind = (found.groupdict().get("type") or "").lower()
                name = found["name"].lower()
                if kind in ("tooldata", "wobjdata"):
                    declared.add(found.start("name"))
                    _read_frame(kind, name, tree, frames, problems)
                else:
                    points += _points(text, found["name"], name, tree)
        for found in _SET.finditer(clean):
            name, line = found[1].lower(), line_of(text, found.start(1))
            if found.start(1) not in declared and name in frames.keys() | problems.keys():
                problems[name] = f"{name} is set again in line {line}"
        uses = _uses(text, clean, frames, points)
        framed = [
            _framed(name, replace(point, order=len(text) + point.fields[0].start), uses, problems)
            for name, point in points
        ]
        framed.sort(key=lambda point: point.fields[0].start)
        made = [
            (found.start(), f"{found[1]}({found[2]}, …)") for found in _COMPUTED.finditer(clean)
        ]
        made += [(found.start(), " ".join(found[0].split())) for found in _CHANGED.finditer(clean)]
        computed = tuple((line_of(text, at), words) for at, words in sorted(made))
        return Program(text, tuple(framed), frames, computed, _notes(text, clean))

    def marks(self, point: ProgramPoint, stance: Stance) -> dict[str, str]:
        """Quadrants and cfx that have changed."""
        found = {}
        for name, joint in QUADRANT_OF.items():
            if name in point.marks:
                into = stance.q[joint] - point.marks[name].value * QUADRANT
                if not -EDGE <= into <= QUADRANT + EDGE:
                    found[name] = str(int(np.floor(stance.q[joint] / QUADRANT)))
        cfx = int(point.marks["cfx"].value) if "cfx" in point.marks else -1
        if 0 <= cfx < 8:
            new = 4 * stance.behind + 2 * (not stance.above)
            new += int(stance.q[4] < 0.0) if abs(stance.q[4]) > EDGE else cfx & 1
            if new != cfx:
                found["cfx"] = str(new)
        return found


def _tree(clean: str, at: int) -> Tree:
    """A bracketed literal as nested lists of fields."""
    end = matching(clean, at)
    return [
        _tree(clean, part.start) if part.text.startswith("[") else part
        for part in arguments(clean, at + 1, end)
    ]


def _rows(tree: Tree, *lengths: int) -> list[list[Field]] | None:
    """Rows of so many fields each; None where the tree is of another shape."""
    if not isinstance(tree, list) or len(tree) != len(lengths):
        return None
    rows = []
    for row, length in zip(tree, lengths, strict=True):
        if not isinstance(row, list) or len(row) != length:
            return None
        fields = [part for part in row if isinstance(part, Field)]
        if len(fields) < length:
            return None
        rows.append(fields)
    return rows


def _points(text: str, title: str, name: str, tree: Tree) -> list[tuple[str, ProgramPoint]]:
    """The points in a literal: one, or those of an array."""
    target, joints = _rows(tree, 3, 4, 4, 6), _rows(tree, 6, 6)
    if target is None and joints is None:
        if not isinstance(tree, list) or all(isinstance(part, Field) for part in tree):
            return []
        parts = enumerate(tree, start=1)
        return [
            found for i, part in parts for found in _points(text, f"{title}{{{i}}}", name, part)
        ]
    if joints is not None:
        fields = tuple(joints[0])
        problem = require_numbers(fields)
        line = line_of(text, fields[0].start)
        return [(name, ProgramPoint(title, line, fields, True, DEGREE, problem=problem))]
    assert target is not None
    fields, configured = (*target[0], *target[1]), target[2]
    problem = require_numbers((*fields, *configured))
    external = dict(enumerate(target[3], start=1))
    line = line_of(text, fields[0].start)
    point = ProgramPoint(title, line, fields, external=external, problem=problem)
    if not problem:
        marks = dict(zip(("cf1", "cf4", "cf6", "cfx"), configured, strict=True))
        point = replace(point, marks=marks, posture=_posture(marks))
        try:
            pose_of("abb", point.numbers)
        except InputError as error:
            point = replace(point, problem=str(error))
    return [(name, point)]


def _posture(marks: dict[str, Field]) -> Posture:
    ranges = np.tile([-np.inf, np.inf], (6, 1))
    for name, joint in QUADRANT_OF.items():
        ranges[joint] = marks[name].value * QUADRANT + np.array([0.0, QUADRANT])
    cfx = int(marks["cfx"].value)
    if not 0 <= cfx < 8:
        return Posture(ranges)
    ranges[4] = (-np.inf, 0.0) if cfx & 1 else (0.0, np.inf)
    return Posture(ranges, bool(cfx & 4), not cfx & 2)


def _read_frame(
    kind: str, name: str, tree: Tree, frames: dict[str, Array], problems: dict[str, str]
) -> None:
    """Put a tooldata or wobjdata into ``frames``, or why it cannot be into ``problems``."""
    problems[name] = f"{kind} {name} cannot be read"
    if not isinstance(tree, list) or not isinstance(tree[0], Field):
        return
    holds = tree[0].text.upper()
    if holds != ("TRUE" if kind == "tooldata" else "FALSE"):
        problems[name] = f"{name}: the robot carries the part to a tool that stands"
        return
    T = np.eye(4)
    for part in tree[1:2] if kind == "tooldata" else tree[-2:]:
        rows = _rows(part, 3, 4)
        if rows is None or require_numbers([*rows[0], *rows[1]]):
            return
        try:
            T = T @ pose_of("abb", [part.value for row in rows for part in row])
        except InputError:  # no unit quaternion
            return
    if kind == "wobjdata" and isinstance(tree[1], Field) and tree[1].text.upper() != "TRUE":
        problems[name] = f"{name}: its user frame is moved by another unit"
        return
    frames[name] = T
    del problems[name]


def _notes(text: str, clean: str) -> tuple[str, ...]:
    return tuple(
        f"line {line_of(text, found.start())}: Conf{found[1].upper()} is off: of a point that only "
        "such motions go to, the posture nearest to the point before is taken, whatever its "
        "configuration says"
        for found in _CONF.finditer(clean)
        if (found[2] or "").lower() == "off"
    )


def _is_free(kind: str, at: int, switches: Sequence["re.Match[str]"]) -> bool:
    """Whether a motion that begins at ``at`` goes to the nearest posture (ConfJ, ConfL off).

    Where no switch stands above it, one in a routine below may have been run before.
    """
    off = [
        (found.start(), (found[2] or "").lower() == "off")
        for found in switches
        if found[1].upper() == kind
    ]
    above = [value for start, value in off if start < at]
    return above[-1] if above else any(value for _, value in off)


def _uses(
    text: str, clean: str, frames: dict[str, Array], points: list[tuple[str, ProgramPoint]]
) -> dict[str, list[_Motion]]:
    """The motions that name a point, in the order of the text.

    Points that are written in a motion are added to ``points``.
    """
    uses: dict[str, list[_Motion]] = {}
    switches = list(_CONF.finditer(clean))
    for found in _MOVES.finditer(clean):
        parts = arguments(clean, found.start(2), found.end(2))
        parts = [part for part in parts if part.text and not re.fullmatch(r"\\\s*\w+", part.text)]
        if not parts:
            continue
        tool, frame = _ends(parts, found[1], line_of(text, found.start()), frames)
        kind = "J" if _BY_JOINTS.match(found[1]) else "L"
        free = _is_free(kind, found.start(), switches)
        use = _Motion(tool, frame, found.start(), free)
        first = 2 if found[1].lower().startswith("search") else 0  # behind its signal and result
        parts = [part for part in parts if not re.match(r"\\\s*\w+\s*:=", part.text)]
        for part in parts[first : first + _PLAIN.get(found[1].lower(), 2)]:
            at = clean.find("[", part.start, part.end)
            literal = (
                at >= 0
                and not clean[part.start : at].strip().startswith("\\")
                and re.match(r"(?:\\\w+\s*,?\s*)*\[", clean[part.start : part.end])
            )
            if literal:
                name = f"{found[1]} in line {line_of(text, at)}"
                points += _points(text, name, f"@{at}", _tree(clean, at))
                uses[f"@{at}"] = [use]
                continue
            for name in _named(part.text):
                uses.setdefault(name, []).append(use)
    return uses


def _ends(
    parts: Sequence[Field], motion: str, line: int, frames: dict[str, Array]
) -> tuple[str, str]:
    """Tool and work object that a motion's arguments name."""
    unknown, words = f"of {motion} in line {line}", list[str]()
    for part in parts:
        words += filter(None, [re.sub(r"\s*\\.*", "", part.text, flags=re.S).lower()])
        if wobj := re.search(r"\\\s*WObj\s*:=\s*(\w+)", part.text, re.I):  # a switch of the tool
            return words[-1] if words else unknown, wobj[1].lower()
    if words and _TOOL_LAST.fullmatch(motion):
        return words[-1], "wobj0"
    return next((one for one in words[1:] if one in frames), unknown), "wobj0"


def _named(word: str) -> Sequence[str]:
    """The point that an argument names, also within Offs( ) and RelTool( )."""
    inner = _COMPUTED.match(word)
    if inner:
        return [inner[2].lower()]
    name = re.match(r"(\w+)\s*(?:\{|\\|$)", word)
    return [name[1].lower()] if name else []


def _framed(
    name: str, point: ProgramPoint, uses: dict[str, list[_Motion]], problems: dict[str, str]
) -> ProgramPoint:
    if name not in uses:
        return point
    motions = uses[name]
    point = replace(point, order=motions[0].at)
    if point.joints:
        return point
    if all(motion.free for motion in motions):
        point = replace(point, posture=Posture(), marks={})
    ends = {motion.tool for motion in motions}, {motion.frame for motion in motions}
    tool, frame = (one.pop() if len(one) == 1 else None for one in ends)
    problem = "motions with different tools or work objects go to it"
    if tool is not None and frame is not None:
        problem = problems.get(tool) or problems.get(frame, "")
    return replace(point, tool=tool, frame=frame, problem=point.problem or problem)
