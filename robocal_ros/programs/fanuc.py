# SPDX-License-Identifier: Apache-2.0
"""FANUC teach pendant programs as text (.ls): positions behind /POS, numbers of three decimals.

    P[1:"pick"]{
       GP1:
        UF : 1, UT : 2,		CONFIG : 'N U T, 0, 0, 0',
        X =  1250.500  mm,	Y =   -20.000  mm,	Z =   980.250  mm,
        W =   180.000 deg,	P =     0.000 deg,	R =   -90.000 deg
    };

Group 1 is corrected; positions of others stay, and are told. Sources are in docs/programs.md.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import DEGREE
from robocal_ros.programs.points import (
    EDGE,
    Decimals,
    Dialect,
    Field,
    Posture,
    Program,
    ProgramPoint,
    Stance,
    line_of,
    require_numbers,
)

TURN_OF = (0, 3, 5)  # joints of the three numbers of turns, counted from 0
HALF_TURN = np.pi

_POINT = re.compile(r"^P\[\s*(\d+)\s*(?::\s*\"?([^\]\"]*)\"?)?\]\s*\{", re.M)
_GROUP = re.compile(r"\bGP(\d+)\s*:")
_FIELD = re.compile(r"\b([XYZWPR]|J\d|E\d)\s*=(\s*[-+.\d*]+)\s*(?:mm|deg)")
_FRAMES = re.compile(r"\bUF\s*:\s*(\w+)\s*,\s*UT\s*:\s*(\w+)")
_CONFIG = re.compile(r"CONFIG\s*:\s*'([^']*)'")
_WORDS = re.compile(r"\s*[NF]\s+[UD]\s+[TB]\s*(?:,\s*-?\d+\s*){3}")
# Options of a motion stand up to its next position (of a circle) or its end, on further lines too.
_OPTIONS = r"(?:(?!\bP\[)[^;])*"
_RELATIVE = re.compile(rf"\bP\[\s*(\d+)[^\]]*\]{_OPTIONS}\bINC\b")
_LED = re.compile(r"[JLCA]\s+P\[[^\]]*\][^;]*?\bCOORD\b")
_COMPUTED = re.compile(
    rf"[JLCA]\s+PR\[[^\]]*\]|\bP\[[^\];\n]*\]{_OPTIONS}\b(?:\w+_)?Offset\b{_OPTIONS}"
    r"|\b(?:P|UFRAME|UTOOL)\[[^\];\n]*\]\s*=[^;\n]*",
    re.I,
)


@dataclass(frozen=True)
class FanucDialect(Dialect):
    """FANUC: the configuration follows the joints.

    ``j23``: what the controller's J3 counts of J2. It measures J3 against the horizontal: a robot
    file, as ROS-Industrial's descriptions, counts it from the upper arm, J3 + J2 (``j23`` 1).
    """

    j23: float = 1.0
    maker = "fanuc"
    suffixes = (".ls",)
    decimals = Decimals(length=3, turn=3, joint=3, fixed=True)

    def read(self, text: str) -> Program:
        """The points of group 1."""
        begin = re.search(r"^/POS\b", text, re.M)
        start = begin.end() if begin else len(text)
        relative = {int(found[1]) for found in _RELATIVE.finditer(text, 0, start)}
        points: list[ProgramPoint] = []
        others: dict[str, list[int]] = {}  # by group the lines of its points
        for found in _POINT.finditer(text, start):
            end = text.find("};", found.end())
            end = len(text) if end < 0 else end
            groups = list(_GROUP.finditer(text, found.end(), end))
            own = next((group for group in groups if group[1] == "1"), None)
            name = f"P[{found[1]}]" + (f" {found[2]}" if found[2] else "")
            line = line_of(text, found.start())
            numbers = sorted({group[1] for group in groups} - {"1"}, key=int)
            for other in numbers:
                others.setdefault(other, []).append(line)
            if own is None:
                point = _of_others(name, line, numbers)
            else:
                behind = [group.start() for group in groups if group.start() > own.start()]
                point = _point(text, name, line, own.end(), min([*behind, end]))
            if own is not None and int(found[1]) in relative:
                point = replace(point, problem="is relative to the point before (INC)")
            points.append(replace(point, order=len(points)))
        frames = {"UF0": np.eye(4), "UT0": np.eye(4)}
        computed = tuple(
            (line_of(text, found.start()), " ".join(found[0].split()).rstrip(" :"))
            for found in _COMPUTED.finditer(text, 0, start)
        )
        notes = [
            f"group {number}: its positions stay as they are, the first of {len(lines)} in line "
            f"{lines[0]}; group 1 alone is corrected"
            for number, lines in sorted(others.items(), key=lambda item: int(item[0]))
        ]
        if led := _LED.search(text, 0, start):
            notes.append(
                f"line {line_of(text, led.start())}: COORD: points are corrected as if no other "
                "group carried their user frame"
            )
        return Program(text, tuple(points), frames, computed, tuple(notes))

    def to_arm(self, shown: Array) -> Array:
        """J3 from the upper arm on."""
        return self._coupled(shown, self.j23)

    def from_arm(self, q: Array) -> Array:
        """J3 from the horizontal on."""
        return self._coupled(q, -self.j23)

    def _coupled(self, q: Array, share: float) -> Array:
        moved = q.copy()
        moved[2] += share * q[1]
        return moved

    def marks(self, point: ProgramPoint, stance: Stance) -> dict[str, str]:
        """CONFIG with the letters and turns that have changed."""
        if "CONFIG" not in point.marks:
            return {}
        old = point.marks["CONFIG"].text
        parts = re.split(r"([\s,]+)", old)
        words = [i for i, part in enumerate(parts) if i % 2 == 0 and part]
        if len(words) != 6:
            return {}
        if abs(stance.q[4]) > EDGE:
            parts[words[0]] = "N" if stance.q[4] < 0.0 else "F"
        parts[words[1]], parts[words[2]] = "DU"[stance.above], "TB"[stance.behind]
        for place, joint in zip(words[3:], TURN_OF, strict=True):
            turned = stance.q[joint] / (2.0 * HALF_TURN) - int(parts[place])
            if abs(turned) > 0.5 + EDGE:
                parts[place] = str(round(stance.q[joint] / (2.0 * HALF_TURN)))
        text = "".join(parts)
        return {} if text == old else {"CONFIG": text}


def _of_others(name: str, line: int, groups: Sequence[str]) -> ProgramPoint:
    """A point without a position of group 1; ``groups``: those that it has one of."""
    if not groups:
        return ProgramPoint(name, line, (), problem="has no position")
    words = f"is of group {' and '.join(groups)} alone: group 1 alone is corrected"
    return ProgramPoint(name, line, (), problem=words, of_another=True)


def _point(text: str, name: str, line: int, start: int, end: int) -> ProgramPoint:
    found = {part[1]: Field(part.start(2), part[2]) for part in _FIELD.finditer(text, start, end)}
    joints = "J1" in found
    names = [f"J{i}" for i in range(1, 10)] if joints else list("XYZWPR")
    fields = tuple(found[one] for one in names if one in found)
    problem = require_numbers(fields)
    if not joints and len(fields) < 6:
        problem = "has no pose"
    external = {int(one[1:]): part for one, part in found.items() if re.fullmatch(r"E\d", one)}
    point = ProgramPoint(name, line, fields, joints, DEGREE, external=external, problem=problem)
    if joints or problem:
        return point
    frames = _FRAMES.search(text, start, end)
    if frames:
        frame, tool = (one if one.isdigit() else None for one in frames.groups())
        point = replace(
            point,
            frame=None if frame is None else f"UF{frame}",
            tool=None if tool is None else f"UT{tool}",
        )
    config = _CONFIG.search(text, start, end)
    if config is None:
        return point
    if not _WORDS.fullmatch(config[1]):
        problem = f"its configuration '{config[1]}' is none of three letters and three turns"
        return replace(point, problem=problem)
    marks = {"CONFIG": Field(config.start(1), config[1])}
    return replace(point, marks=marks, posture=_posture(config[1]))


def _posture(config: str) -> Posture:
    """Of a text that `_WORDS` matches."""
    words = config.replace(",", " ").split()
    ranges = np.tile([-np.inf, np.inf], (6, 1))
    ranges[4] = (-np.inf, 0.0) if words[0] == "N" else (0.0, np.inf)
    for joint, word in zip(TURN_OF, words[3:], strict=True):
        ranges[joint] = (2.0 * int(word) + np.array([-1.0, 1.0])) * HALF_TURN
    return Posture(ranges, words[2] == "B", words[1] == "U")
