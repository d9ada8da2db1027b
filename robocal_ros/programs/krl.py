# SPDX-License-Identifier: Apache-2.0
"""KUKA programs (.src, .dat): points in braces, frames by number, status and turn.

    DECL E6POS XP1={X 1250.5,Y -20.0,Z 980.25,A 90.0,B 0.0,C 180.0,S 2,T 35,E1 0.0,…}
    DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,…}

Of a point of an inline form (XP1) the frames are in FP1; elsewhere those that were set last above
in its routine, by FDAT_ACT too, or by the WITH of its motion or spline block.
Sources are in docs/programs.md.
"""

import re
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import DEGREE, pose_of
from robocal_ros.programs.flow import Flow, FlowStep, flow_steps, labels_of
from robocal_ros.programs.points import (
    EDGE,
    OF_LINE,
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
    require_numbers,
)

POSE = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
EXTERNAL = ("E1", "E2", "E3", "E4", "E5", "E6")
ROBROOT = ("$NULLFRAME", "$WORLD", "$ROBROOT")
TARGETS = ("E6POS", "POS", "E6AXIS", "AXIS")
BEHIND, ABOVE, FLIPPED = 1, 2, 4  # bits of S; the third says again what T says of A5
ABSOLUTE = 16
_ABSOLUTE = (
    "taught on an absolutely accurate robot (bit 4 of S): its controller reckons with a model of "
    "its own, not with the nominal one; switch it off, or give that model as --robot"
)
MOVES = r"S?(?:PTP|LIN|CIRC|SPL)"

_NUMBERED = re.compile(r"\[\d+\]$")
_COMPONENT = re.compile(r"[^,]+")
_BRACES = re.compile(r"\{([^{}]*)\}")
_ASSIGNED = re.compile(
    r"(?:\b(?P<type>E6POS|POS|FRAME|E6AXIS|AXIS)\s+)?(?P<name>\$?[A-Za-z_]\w*(?:\[[^\]\r\n]*\])?)"
    r"\s*=\s*$"
)
_MOVED = re.compile(
    rf"\b(?P<move>{MOVES}(?P<relative>_REL)?)\b[^\r\n{{}}]*(?:\{{[^{{}}]*\}}\s*,\s*)?$", re.I
)
_NAME = r"(\w+(?:\[\w+\])?)"
_USED = re.compile(rf"\b{MOVES}(?:\s+{_NAME}|\s*\{{[^{{}}]*\}})(?:\s*,\s*{_NAME})?", re.I)
_INDEXED = r"(\w+(?:\[\d+\])?)(?:\[[^\]\r\n]*\])?"
_RELATIVE = re.compile(
    rf"\b{MOVES}_REL(?:\s+{_INDEXED}|\s*\{{[^{{}}]*\}})(?:\s*,\s*{_INDEXED})?", re.I
)
_DECLARED = re.compile(
    r"\b(?:E6POS|POS|E6AXIS|AXIS)\s+((?:\w+(?:\[[^\]\r\n]*\])?[ \t]*,?[ \t]*)+)", re.I
)
_FDAT = re.compile(r"\bFDAT\s+(\w+)\s*=\s*\{([^{}]*)\}", re.I)
_FRAME_DATA = re.compile(
    r"\b(TOOL_DATA|BASE_DATA)\[(\d+)\](?:\.\w+)?\s*=(?!=)\s*(?:\{([^{}]*)\}(?!\s*:))?", re.I
)
_SET = re.compile(
    r"\$(?P<kind>TOOL|BASE)(?P<part>\.\w+)?\s*=(?!=)\s*"
    r"(?P<value>(?:\{[^{}]*\}|[$\w]+(?:\[[^\]\r\n]*\])?)[^\r\n;]*)"
    r"|\bBAS\s*\(\s*#(?P<bas>TOOL|BASE|INITMOV)\s*,\s*(?P<number>[^)\r\n]*)\)"
    r"|^[ \t]*FDAT_ACT(?:\.\w+)?\s*=(?!=)\s*(?P<fdat>\{[^{}]*\}|[^\r\n]*)"
    r"|\$IPO_MODE\s*=(?!=)\s*(?P<mode>#?\w+)",
    re.I | re.M,
)
_BLOCK = re.compile(
    r"^[ \t]*(?:(?P<begin>IF|SWITCH)|(?P<loop>WHILE|FOR|LOOP|REPEAT)|(?P<branch>CASE|DEFAULT)"
    r"|(?P<else>ELSE)|(?P<leave>EXIT)|(?P<end>UNTIL|END(?:IF|SWITCH|WHILE|FOR|LOOP|FCT)?)"
    r"|(?:GLOBAL[ \t]+)?DEF(?:FCT[ \t]+[\w\[\]]+)?[ \t]+(?P<alone>\w+)"
    r"|GOTO[ \t]+(?P<jump>[\w$]+))(?![\w$])",
    re.I | re.M,
)
_LABEL = re.compile(r"^[ \t]*([A-Z_$][\w$]*)[ \t]*:", re.I | re.M)
_CALL = re.compile(r"\b(\w+)[ \t]*\(")
_WITH = re.compile(
    rf"^(?P<motion>[ \t]*(?:(?P<block>(?:PTP_)?SPLINE)|{MOVES})\b[^\r\n=]*?\bWITH\b)[^\r\n]*",
    re.I | re.M,
)
_END_OF_BLOCK = re.compile(r"^[ \t]*ENDSPLINE\b", re.I | re.M)
# Of A:B frame B is given in A: a motion goes neither to A nor to B. {POS: X 1,…} names a type.
_OPERAND = re.compile(r"\{\s*\w+[ \t]*:|:[ \t]*(\w+(?:\[\d+\])?)")
_OPERATOR = re.compile(r"[ \t]*:")
_REST = r"(?:[^\r\n{}]|\{[^{}\r\n]*\})*?"
_PRODUCT = rf"{_REST}(?:[\w\])]|\{{[^{{}}\r\n]*\}})[ \t]*:[ \t]*[\w{{$]"
# A CIRC to an angle (CA) ends where the controller reckons.
_COMPUTED = re.compile(
    rf"\b{MOVES}(?:_REL)?\b(?:{_PRODUCT}|{_REST}(?:\w\(|,[ \t]*CA\b))[^\r\n]*", re.I
)
_CHANGED = re.compile(
    rf"^[ \t]*[A-Z]\w*(?:\[[^\]\r\n]*\])?\s*=(?!=){_PRODUCT}[^\r\n]*"
    r"|\b(?:TOOL|BASE)_DATA\[(?:\d+\](?:\.\w+)?\s*=(?![\s=]*\{)"
    r"|(?!\d+\])[^\]\r\n]*\](?:\.\w+)?\s*=(?!=))[^\r\n]*"
    r"|\$(?:TOOL|BASE)\.\w+\s*=(?!=)[^\r\n]*"
    r"|(?<![$\w])[A-Z]\w*(?:\[[^\]\r\n]*\])?\.(?:[XYZABC]|A[1-6])\s*=(?!=)[^\r\n]*",
    re.I | re.M,
)


class KrlDialect(Dialect):
    """KUKA: nine digits as the controller writes them; S and T follow the joints."""

    maker, suffixes = "kuka", (".src", ".dat", ".sub")
    decimals = Decimals(length=4, turn=6, joint=6)
    names_frames = True

    def read(self, text: str) -> Program:
        """Points of POS and E6POS, of AXIS and E6AXIS, and of motions; frames by number."""
        clean = masked(text, ";")
        frames = {"TOOL_DATA[0]": np.eye(4), "BASE_DATA[0]": np.eye(4)}
        frames |= {name: np.eye(4) for name in ROBROOT}
        numbered, unsettled = _numbered_frames(text, clean)
        frames |= numbered
        inline = {found[1].upper(): found[2] for found in _FDAT.finditer(clean)}
        flow, within = _flow(text, clean, frames, inline), _withs(text, clean, frames, inline)
        used = {name.upper() for found in _USED.finditer(clean) for name in found.groups() if name}
        used |= {name.partition("[")[0] for name in used if not _NUMBERED.search(name)}
        for found in _DECLARED.finditer(clean):  # an array's points are assigned one by one
            used |= set(re.findall(r"\w+", re.sub(r"\[[^\]]*\]", "", found[1].upper())))
        reckoned: dict[str, int] = {}
        for found in chain(_OPERAND.finditer(clean), _RELATIVE.finditer(clean)):
            for name in filter(None, found.groups()):
                reckoned.setdefault(name.upper(), line_of(text, found.start()))
        points: list[ProgramPoint] = []
        for braces in _BRACES.finditer(clean):
            point = _point(text, clean, braces, used)
            if point is None:
                continue
            point = _framed(point, braces.start(), inline, flow, within)
            if not point.joints:
                tool = unsettled.get(point.tool or "", point.tool)
                frame = unsettled.get(point.frame or "", point.frame)
                point = replace(point, tool=tool, frame=frame)
            name = point.name.upper()
            if line := reckoned.get(name, reckoned.get(name.partition("[")[0])):
                problem = f"the program reckons with it in line {line}"
                point = replace(point, problem=point.problem or problem)
            points.append(replace(point, order=len(points)))
        computed = tuple(
            (line_of(text, found.start()), text[found.start() : found.end()].strip())
            for found in chain(_COMPUTED.finditer(_without(clean)), _CHANGED.finditer(clean))
        )
        status = [bits_of(point.marks["S"]) for point in points if "S" in point.marks]
        exact = sum(1 for one in status if one is not None and one & ABSOLUTE)
        notes = [f"{exact} points were {_ABSOLUTE}"] if exact else []
        return Program(text, tuple(points), frames, computed, tuple(notes))

    def marks(self, point: ProgramPoint, stance: Stance) -> dict[str, str]:
        """S and T, of which only bits that have changed are written."""
        found = {}
        q, negative = stance.q, stance.q < 0.0
        for kind, mark in point.marks.items():
            old = bits_of(mark)
            if old is None or old < 0:
                continue
            new = old
            if kind == "T":
                for axis in np.flatnonzero(np.abs(q) > EDGE):
                    new = (new & ~(1 << int(axis))) | (int(negative[axis]) << int(axis))
            else:
                new = (new & ~(BEHIND | ABOVE)) | BEHIND * stance.behind | ABOVE * stance.above
                if abs(q[4]) > EDGE:
                    new = (new & ~FLIPPED) | FLIPPED * bool(negative[4])
            if new != old:
                binary = re.fullmatch(r"'B([01]+)'", mark.text.strip(), re.I)
                found[kind] = f"'B{new:0{len(binary[1])}b}'" if binary else str(new)
        return found


def _parts(body: str, at: int) -> dict[str, Field]:
    """Components of an aggregate that begins at ``at``: X, Y … by name."""
    found = {}
    for part in _COMPONENT.finditer(body, body.find(":") + 1):
        name = re.match(r"\s*(\w+(?:\[\])?)\s+", part[0])
        if name:
            value = part[0][name.end() :].rstrip()
            found[name[1].upper()] = Field(at + part.start() + name.end(), value)
    return found


def _frame(body: str) -> Array | None:
    parts = _parts(body, 0)
    fields = [parts[name] for name in POSE if name in parts]
    if len(fields) < len(POSE) or require_numbers(fields):
        return None
    return pose_of("kuka", [part.value for part in fields])


def _numbered_frames(text: str, clean: str) -> tuple[dict[str, Array], dict[str, str]]:
    """TOOL_DATA and BASE_DATA that the text gives; those of which it does not give one value.

    These have the line where that shows in their names, as what is unknown at run time.
    """
    known: dict[str, Array] = {}
    unsettled: dict[str, str] = {}
    for found in _FRAME_DATA.finditer(clean):
        name, T = f"{found[1].upper()}[{found[2]}]", _frame(found[3] or "")
        if T is None or not np.array_equal(known.setdefault(name, T), T):
            unsettled.setdefault(name, f"{name}{OF_LINE}{line_of(text, found.start())}")
    return {name: T for name, T in known.items() if name not in unsettled}, unsettled


def _point(text: str, clean: str, braces: re.Match[str], used: set[str]) -> ProgramPoint | None:
    """The point in braces; None where something else is in them."""
    parts = _parts(braces[1], braces.start() + 1)
    joints = "A1" in parts and "X" not in parts
    names = AXES if joints else POSE
    before = clean[clean.rfind("\n", 0, braces.start()) + 1 : braces.start()]
    if before.rstrip().endswith(":") or _OPERATOR.match(clean, braces.end()):
        return None
    assigned, moved = _ASSIGNED.search(before), _MOVED.search(before)
    line = line_of(text, braces.start())
    if assigned:
        name = assigned["name"].upper()
        target = (assigned["type"] or "").upper() in TARGETS
        target = target or name in used or name.partition("[")[0] in used
        if not target or name.startswith(("$", "TOOL_DATA", "BASE_DATA")):
            return None
        title = assigned["name"]
    elif moved:
        title = f"{moved['move']} in line {line}"
    else:
        return None
    if not any(name in parts for name in names):
        return None
    fields = tuple(parts[name] for name in names if name in parts)
    problem = require_numbers(fields)
    if moved and moved["relative"]:
        problem = "is relative to the point before"
    elif len(fields) < len(names):
        problem = "leaves components as they are at run time: " + ", ".join(
            name for name in names if name not in parts
        )
    external = {i: parts[name] for i, name in enumerate(EXTERNAL, start=1) if name in parts}
    marks: dict[str, Field] = {name: parts[name] for name in ("S", "T") if name in parts}
    point = ProgramPoint(title, line, fields, joints, DEGREE, marks=marks, problem=problem)
    if joints or problem:
        return replace(point, marks={})
    return replace(point, posture=_posture(parts), external=external)


def bits_of(mark: Field) -> int | None:
    """Value of S or T, also as 'B100011' or 'HFF'; None where it is none."""
    text = mark.text.strip()
    binary = re.fullmatch(r"'([BH])([0-9A-F]+)'", text, re.I)
    try:
        return int(binary[2], 2 if binary[1] in "Bb" else 16) if binary else int(text)
    except ValueError:
        return None


def _posture(parts: dict[str, Field]) -> Posture:
    status = bits_of(parts["S"]) if "S" in parts else None
    turn = bits_of(parts["T"]) if "T" in parts else None
    ranges = None
    if turn is not None and turn >= 0:
        negative = np.array([(turn >> axis) & 1 for axis in range(6)], dtype=bool)
        low, high = np.where(negative, -np.inf, 0.0), np.where(negative, 0.0, np.inf)
        ranges = np.stack([low, high], axis=1)
    if status is None or status < 0:
        return Posture(ranges)
    return Posture(ranges, bool(status & BEHIND), bool(status & ABOVE))


@dataclass(frozen=True)
class _With:
    """What a WITH sets, as of `_given`, for its motion or block."""

    at: int
    names: dict[str, str | None]
    until: int


def _without(clean: str) -> str:
    """The text with what is behind a WITH blanked, every character at its place."""
    return _WITH.sub(lambda found: found["motion"].ljust(len(found[0])), clean)


def _flow(text: str, clean: str, frames: dict[str, Array], inline: dict[str, str]) -> Flow:
    """What is set but by a WITH."""
    labels, clean = labels_of(_without(clean), _LABEL)
    steps = labels + flow_steps(clean, _BLOCK, _CALL)
    for found in _SET.finditer(clean):
        names = _given(line_of(text, found.start()), found, frames, inline)
        steps.append(FlowStep(found.start(), "set", names))
    return Flow(text, steps, frames)


def _withs(text: str, clean: str, frames: dict[str, Array], inline: dict[str, str]) -> list[_With]:
    """In the order of the text: an inner one goes before the one around it."""
    sets = []
    for found in _WITH.finditer(clean):
        end = _END_OF_BLOCK.search(clean, found.end()) if found["block"] else None
        until = end.start() if end else found.end()
        for part in arguments(clean, found.end("motion"), found.end()):
            if given := _SET.match(part.text):
                names = _given(line_of(text, part.start), given, frames, inline)
                if None not in names.values():
                    sets.append(_With(found.start(), names, until))
    return sets


def _given(
    line: int, found: re.Match[str], frames: dict[str, Array], inline: dict[str, str]
) -> dict[str, str | None]:
    """Tool or base that a place in the text sets, None: not known from it on.

    ``$IPO_MODE`` is #TCP, or empty where the tool is carried.
    """
    if (found["bas"] or "").upper() == "INITMOV":
        return dict.fromkeys(("$TOOL", "$BASE", "$IPO_MODE"))
    here = f"{OF_LINE}{line}"  # of what is not read here: unknown
    if found["mode"]:
        return {"$IPO_MODE": _carried(found["mode"])}
    if found["fdat"] is not None:  # for the BAS(#FRAMES) behind it
        word = found["fdat"].strip()
        body = word[1:-1] if word.startswith("{") else inline.get(word.upper(), "")
        return _of_fdat(body, here)
    if found["bas"]:
        kind, number = found["bas"].upper(), found["number"].strip()
        known = f"{kind}_DATA[{number}]" if number.isdigit() else f"${kind}{here}"
        return {f"${kind}": known}
    kind, value = f"${found['kind'].upper()}", found["value"].strip()
    name = f"{kind}{here}"
    T = _frame(value[1:-1]) if re.fullmatch(r"\{[^{}]*\}", value) else None
    if T is not None:
        frames[name] = T
    elif not found["part"] and re.fullmatch(r"[$\w]+(?:\[\d+\])?", value):
        name = value.upper()
    return {kind: name}


def _carried(mode: str) -> str:
    """An IPO mode where the robot carries the part; else empty."""
    return mode.strip().upper() if mode.strip().upper() == "#TCP" else ""


def _of_fdat(body: str, here: str) -> dict[str, str | None]:
    """What the components of an FDAT set; ``here``: behind the name of what they leave out."""
    parts = {name: part.text.strip().upper() for name, part in _parts(body, 0).items()}
    names: dict[str, str | None] = {"$IPO_MODE": _carried(parts.get("IPO_FRAME", ""))}
    for kind in ("TOOL", "BASE"):
        number = parts.get(f"{kind}_NO")
        names[f"${kind}"] = f"${kind}{here}" if number is None else f"{kind}_DATA[{number}]"
    return names


def _framed(
    point: ProgramPoint, at: int, inline: dict[str, str], flow: Flow, within: list[_With]
) -> ProgramPoint:
    """The point with the names of its frames, and what about them forbids a correction."""
    names = dict(flow.at(at))
    body = inline.get("F" + point.name.upper().removeprefix("X"))
    if body is not None:
        names = _of_fdat(body, f"{OF_LINE}{point.line}")
    else:
        for one in within:
            if one.at <= at < one.until:
                names |= one.names
    if mode := names.get("$IPO_MODE"):
        words = "the robot carries the part to a tool that stands"
        if mode != "#TCP":
            words = f"whether the robot carries the part is not known ({mode})"
        return replace(point, problem=point.problem or words)
    return replace(point, tool=names.get("$TOOL"), frame=names.get("$BASE"))
