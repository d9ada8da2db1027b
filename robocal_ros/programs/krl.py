# SPDX-License-Identifier: Apache-2.0
"""KUKA programs (.src, .dat): points in braces, frames by number, status and turn.

    DECL E6POS XP1={X 1250.5,Y -20.0,Z 980.25,A 90.0,B 0.0,C 180.0,S 2,T 35,E1 0.0,…}
    DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,…}

Of a point of an inline form (XP1) the frames are in FP1; elsewhere they are those of the motions to
it: set last above in their routine, by FDAT_ACT too, or by the WITH of a motion or spline block.
The .dat and the .src of one name are a module: what one declares the other one moves to.
Sources are in docs/programs.md.
"""

import math
import re
from bisect import bisect_left, bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from itertools import chain

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import DEGREE, pose_of
from robocal_ros.programs.flow import (
    Flow,
    FlowStep,
    TextRegion,
    TextRegions,
    flow_steps,
    labels_of,
)
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
    lines_of,
    masked,
    require_numbers,
)

POSE = ("X", "Y", "Z", "A", "B", "C")
AXES = ("A1", "A2", "A3", "A4", "A5", "A6")
EXTERNAL = ("E1", "E2", "E3", "E4", "E5", "E6")
ROBROOT = ("$NULLFRAME", "$WORLD", "$ROBROOT")
KINDS = ("$TOOL", "$BASE", "$IPO_MODE")
OF_FDAT = {"TOOL_NO": "$TOOL", "BASE_NO": "$BASE", "IPO_FRAME": "$IPO_MODE"}
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
_LITERAL = re.compile(r"(\$?[A-Za-z_]\w*(?:\[[^\]\r\n]*\])?)\s*=\s*\{([^{}]*)\}")
_NAME = r"(\w+(?:\[\w+\])?)"
_USED = re.compile(rf"\b{MOVES}(?:\s+{_NAME}|\s*\{{[^{{}}]*\}})(?:\s*,\s*{_NAME})?", re.I)
_INDEXED = r"(\w+(?:\[\d+\])?)(?:\[[^\]\r\n]*\])?"
_RELATIVE = re.compile(
    rf"\b{MOVES}_REL(?:\s+{_INDEXED}|\s*\{{[^{{}}]*\}})(?:\s*,\s*{_INDEXED})?", re.I
)
_DECLARED = re.compile(
    r"\b(E6POS|POS|E6AXIS|AXIS|FRAME)\s+((?:\w+(?:\[[^\]\r\n]*\])?[ \t]*,?[ \t]*)+)", re.I
)
_FDAT = re.compile(r"\bFDAT\s+(\w+)\s*=\s*\{([^{}]*)\}", re.I)
_FRAME_DATA = re.compile(
    r"\b(TOOL_DATA|BASE_DATA)\[(\d+)\](?:\.\w+)?\s*=(?!=)\s*(?:\{([^{}]*)\}(?!\s*:))?", re.I
)
_SET = re.compile(
    r"\$(?P<kind>TOOL|BASE)(?P<part>\.\w+)?\s*=(?!=)\s*"
    r"(?P<value>(?:\{[^{}]*\}|[$\w]+(?:\[[^\]\r\n]*\])?)[^\r\n;]*)"
    r"|\bBAS\s*\(\s*#(?P<bas>TOOL|BASE|INITMOV)\s*,\s*(?P<number>[^)\r\n]*)\)"
    r"|^[ \t]*FDAT_ACT(?:\.(?P<entry>\w+))?\s*=(?!=)\s*(?P<fdat>\{[^{}]*\}|[^\r\n]*)"
    r"|\$IPO_MODE\s*=(?!=)\s*(?P<mode>#?\w+(?:\(\s*\w+(?:\.\w+)?\s*\))?)",
    re.I | re.M,
)
# As inline forms of KSS 8 write it: what the FDAT of a point says.
_INLINE = re.compile(r"S(?:TOOL2?|BASE|IPO_MODE)\(\s*(\w+)(?:\.\w+)?\s*\)", re.I)
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
_LEFT = re.compile(rf"(?:\[[^\]\r\n]*\])?{_OPERATOR.pattern}")  # what is behind the name of A
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


@dataclass(frozen=True)
class KrlDialect(Dialect):
    """KUKA: nine digits as the controller writes them; S and T follow the joints.

    ``other``: text of the module's other file, the .src of a .dat or the .dat of a .src, which is
    read with each text; ``other_name``: the file's. Without it empty. ``config``: text of
    $config.dat, whose FDAT serve all programs.
    """

    other: str = ""
    other_name: str = ""
    config: str = ""
    maker = "kuka"
    suffixes = (".src", ".dat", ".sub")
    decimals = Decimals(length=4, turn=6, joint=6)
    names_frames = True

    def read(self, text: str) -> Program:
        """Points of POS and E6POS, of AXIS and E6AXIS, and of motions; frames by number."""
        clean = masked(f"{text}\n{self.other}", ";")
        own_line, line = lines_of(text), self._lines(text)
        frames = {"TOOL_DATA[0]": np.eye(4), "BASE_DATA[0]": np.eye(4)}
        frames |= {name: np.eye(4) for name in ROBROOT}
        numbered, unsettled = _numbered_frames(line, clean)
        frames |= numbered
        texts = masked(self.config, ";"), clean
        inline = {one[1].upper(): one[2] for each in texts for one in _FDAT.finditer(each)}
        labels, plain = labels_of(_without(clean), _LABEL)
        steps = labels + flow_steps(plain, _BLOCK, _CALL)
        in_force = _InForce(line, clean, _flow(line, plain, steps, frames, inline), frames, inline)
        variables = _Variables(clean, len(text), steps, in_force)
        points: list[ProgramPoint] = []
        for braces in _BRACES.finditer(clean, 0, len(text)):
            found = _point(own_line(braces.start()), clean, braces, variables)
            if found is None:
                continue
            point, name, at = *found, braces.start()
            goals = variables.motions(name, at) if name else [at]
            if not point.joints:
                point = _framed(point, goals, inline, in_force)
                tool = unsettled.get(point.tool or "", point.tool)
                frame = unsettled.get(point.frame or "", point.frame)
                point = replace(point, tool=tool, frame=frame)
            if name and (place := variables.reckoned_at(name, at)) is not None:
                problem = f"the program reckons with it in line {line(place)}"
                point = replace(point, problem=point.problem or problem)
            points.append(replace(point, order=min(goals, default=at)))
        made = [*_COMPUTED.finditer(_without(clean)), *_CHANGED.finditer(clean)]
        computed = tuple(
            (own_line(found.start()), text[found.start() : found.end()].strip())
            for found in made
            if found.start() < len(text)
        )
        elsewhere = [found.start() for found in made if found.start() > len(text)]
        return Program(text, tuple(points), frames, computed, self._notes(points, elsewhere, line))

    def _lines(self, text: str) -> Callable[[int], str]:
        """Of a place in both files, the line in words."""
        own, others = lines_of(text), lines_of(self.other)

        def line(at: int) -> str:
            if at <= len(text):
                return str(own(at))
            return f"{others(at - len(text) - 1)} of {self.other_name}"

        return line

    def _notes(
        self, points: Sequence[ProgramPoint], elsewhere: Sequence[int], line: Callable[[int], str]
    ) -> tuple[str, ...]:
        """``elsewhere``: where the other file makes a point or a frame itself."""
        status = [bits_of(point.marks["S"]) for point in points if "S" in point.marks]
        exact = sum(1 for one in status if one is not None and one & ABSOLUTE)
        notes = [f"{exact} points were {_ABSOLUTE}"] if exact else []
        if elsewhere:
            more = len(elsewhere) - 1
            words = f", and in {more} other places there" if more else ""
            notes.append(f"line {line(min(elsewhere))} makes points or frames itself{words}: look")
        return tuple(notes)

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


_Variable = tuple[int, str]  # the routine that declares it, 0: the module; its name


class _Variables:
    """What a module's position variables are for, each where it is named.

    A name means what its routine declares, else what the module does. ``boundary``: where the
    second of two files begins. In ``_goals`` NAME[] stands for all elements by their numbers.
    """

    def __init__(
        self, clean: str, boundary: int, steps: Sequence[FlowStep], in_force: "_InForce"
    ) -> None:
        self._in_force = in_force
        routines = {step.at for step in steps if step.does == "alone"}
        self._begins = sorted({boundary, *routines})
        self._regions = TextRegions(steps, [boundary])
        self._local: set[_Variable] = set()
        self._goals: dict[_Variable, list[int]] = {}  # by which motions go to it
        self._set: dict[_Variable, list[int]] = {}
        self._whole: dict[tuple[_Variable, TextRegion], list[int]] = {}  # set in all components
        self._setters: dict[_Variable, set[TextRegion]] = {}  # routines, by variable or array
        self._reached: dict[_Variable, tuple[list[int], dict[int, list[int]]]] = {}
        self._reckoned: dict[_Variable, int] = {}
        self._declare(clean, routines)
        for found in _LITERAL.finditer(clean):
            self._add_value(found, routines)
        for found in _USED.finditer(clean):
            self._add_motion(clean, found)
        # Of A:B frame B is given in A; what a relative motion names is a way.
        for found in chain(_OPERAND.finditer(clean), _RELATIVE.finditer(clean)):
            for name in filter(None, found.groups()):
                self._reckoned.setdefault(self._meant(name, found.start()), found.start())

    def _declare(self, clean: str, routines: set[int]) -> None:
        declared: list[tuple[str, str, int]] = []
        for found in _DECLARED.finditer(clean):
            names = re.findall(r"\w+", re.sub(r"\[[^\]]*\]", "", found[2]))
            declared += [(found[1].upper(), name, found.start()) for name in names]
        for _, name, at in declared:
            scope = bisect_right(self._begins, at)
            if scope and self._begins[scope - 1] in routines:
                self._local.add((scope, name.upper()))
        self._positions = {self._meant(name, at) for kind, name, at in declared if kind in TARGETS}

    def _add_value(self, found: re.Match[str], routines: set[int]) -> None:
        one, at = self._meant(found[1], found.start()), found.start(2) - 1
        region = self._regions.at(at)
        self._set.setdefault(one, []).append(at)
        if region.routine.begin in routines:
            self._setters.setdefault(_array_of(one), set()).add(region.routine)
        parts = _parts(found[2], 0).keys()
        if not _runs(one) and (parts >= {*POSE} or parts >= {*AXES}):
            self._whole.setdefault((one, region), []).append(at)

    def _add_motion(self, clean: str, found: re.Match[str]) -> None:
        for i, name in enumerate(found.groups(), start=1):
            if name is None:
                continue
            array, at = _array(name), found.start()
            for each in (name, f"{array}[]") if _NUMBERED.search(name) else (array,):
                self._goals.setdefault(self._meant(each, at), []).append(at)
            # a motion to A:B goes to no place A
            if not _LEFT.match(clean, found.end(i)):
                whole = name if _NUMBERED.search(name) else array
                self._positions.add(self._meant(whole, at))

    def _meant(self, name: str, at: int) -> _Variable:
        scope = bisect_right(self._begins, at)
        return (scope if (scope, _array(name).upper()) in self._local else 0, name.upper())

    def is_position(self, name: str, at: int) -> bool:
        """Whether it was declared as a position, or a motion goes to it."""
        one = self._meant(name, at)
        return one in self._positions or _array_of(one) in self._positions

    def motions(self, name: str, at: int) -> list[int]:
        """Where motions go to the value that is set at a place; where none does, to any value.

        Of many that have the same in force the first may stand for all.
        """
        one = self._meant(name, at)
        if one not in self._reached:
            self._reached[one] = self._reach(one)
        goals, reached = self._reached[one]
        return reached.get(at) or goals

    def _reach(self, one: _Variable) -> tuple[list[int], dict[int, list[int]]]:
        """The motions to a variable; by the place of a value those that may go to it."""
        array = _array_of(one)
        keys = (array, (array[0], f"{array[1]}[]")) if _runs(one) else (one, array)
        goals = sorted({at for key in keys for at in self._goals.get(key, ())})
        values = self._set.get(one, [])
        reached: dict[int, list[int]] = {at: [] for at in values}
        anywhere = []
        for goal in goals:
            first, last = self._window(one, goal)
            if first < 0:
                anywhere.append(goal)
                continue
            for at in values[bisect_left(values, first) : bisect_right(values, last)]:
                reached[at].append(goal)
        common = self._in_force.different(anywhere)
        return self._in_force.different(goals), {
            at: sorted([*common, *own]) for at, own in reached.items()
        }

    def _window(self, one: _Variable, goal: int) -> tuple[float, float]:
        """Between which places a variable is set to what a motion may go to.

        All ways to the motion lead past the first. Behind the motion are those to which a loop
        leads back.
        """
        regions, first = self._regions.around(goal), -math.inf
        for region in regions:
            values = self._whole.get((one, region), [])
            if i := bisect_left(values, goal):
                first = max(first, values[i - 1])
        last = max([goal, *(each.end for each in regions if each.loop and each.begin > first)])
        others = self._setters.get(_array_of(one), set()) - {regions[-1]}
        if first < 0 or regions[-1].jumps or (others and self._regions.calls(first, last)):
            return -math.inf, math.inf
        return first, last

    def reckoned_at(self, name: str, at: int) -> int | None:
        """Where the program reckons with it; None: it does not."""
        one = self._meant(name, at)
        return self._reckoned.get(one, self._reckoned.get(_array_of(one)))


def _array(name: str) -> str:
    """An element's array; a variable itself."""
    return name.partition("[")[0]


def _array_of(one: _Variable) -> _Variable:
    return one[0], _array(one[1])


def _runs(one: _Variable) -> bool:
    """Whether it is an element whose number runs."""
    return "[" in one[1] and not _NUMBERED.search(one[1])


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


def _numbered_frames(
    line: Callable[[int], str], clean: str
) -> tuple[dict[str, Array], dict[str, str]]:
    """TOOL_DATA and BASE_DATA that the text gives; those of which it does not give one value.

    These have the line where that shows in their names, as what is unknown at run time.
    """
    known: dict[str, Array] = {}
    unsettled: dict[str, str] = {}
    for found in _FRAME_DATA.finditer(clean):
        name, T = f"{found[1].upper()}[{found[2]}]", _frame(found[3] or "")
        if T is None or not np.array_equal(known.setdefault(name, T), T):
            unsettled.setdefault(name, f"{name}{OF_LINE}{line(found.start())}")
    return {name: T for name, T in known.items() if name not in unsettled}, unsettled


def _point(
    line: int, clean: str, braces: re.Match[str], variables: _Variables
) -> tuple[ProgramPoint, str] | None:
    """The point in braces, and the variable that it is set to, empty for a motion's.

    None where something else is in them.
    """
    parts = _parts(braces[1], braces.start() + 1)
    joints = "A1" in parts and "X" not in parts
    names = AXES if joints else POSE
    before = clean[clean.rfind("\n", 0, braces.start()) + 1 : braces.start()]
    if before.rstrip().endswith(":") or _OPERATOR.match(clean, braces.end()):
        return None
    assigned, moved = _ASSIGNED.search(before), _MOVED.search(before)
    if assigned:
        title = name = assigned["name"]
        target = (assigned["type"] or "").upper() in TARGETS
        target = target or variables.is_position(name, braces.start())
        if not target or name.upper().startswith(("$", "TOOL_DATA", "BASE_DATA")):
            return None
    elif moved:
        title, name = f"{moved['move']} in line {line}", ""
    else:
        return None
    if not any(each in parts for each in names):
        return None
    fields = tuple(parts[each] for each in names if each in parts)
    problem = require_numbers(fields)
    if moved and moved["relative"]:
        problem = "is relative to the point before"
    elif len(fields) < len(names):
        problem = "leaves components as they are at run time: " + ", ".join(
            each for each in names if each not in parts
        )
    external = {i: parts[each] for i, each in enumerate(EXTERNAL, start=1) if each in parts}
    marks: dict[str, Field] = {each: parts[each] for each in ("S", "T") if each in parts}
    point = ProgramPoint(title, line, fields, joints, DEGREE, marks=marks, problem=problem)
    if joints or problem:
        return replace(point, marks={}), name
    return replace(point, posture=_posture(parts), external=external), name


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
    until: int
    names: dict[str, str]


def _without(clean: str) -> str:
    """The text with what is behind a WITH blanked, every character at its place."""
    return _WITH.sub(lambda found: found["motion"].ljust(len(found[0])), clean)


def _flow(
    line: Callable[[int], str],
    plain: str,
    steps: Sequence[FlowStep],
    frames: dict[str, Array],
    inline: dict[str, str],
) -> Flow:
    """What is set but by a WITH; ``plain``: the text without these, and without labels."""
    sets = []
    for found in _SET.finditer(plain):
        names = _given(line(found.start()), found, frames, inline)
        sets.append(FlowStep(found.start(), "set", names))
    return Flow(line, [*steps, *sets], frames)


def _given(
    line: str, found: re.Match[str], frames: dict[str, Array], inline: dict[str, str]
) -> dict[str, str | None]:
    """Tool or base that a place in the text sets, None: not known from it on.

    ``$IPO_MODE`` is #TCP, or empty where the tool is carried.
    """
    if (found["bas"] or "").upper() == "INITMOV":
        return dict.fromkeys(KINDS)
    here = f"{OF_LINE}{line}"  # of what is not read here: unknown
    if mode := found["mode"]:
        told = _of_inline(mode, inline, here)
        return {"$IPO_MODE": told["$IPO_MODE"] if told else _carried(mode, here)}
    if found["fdat"] is not None:  # for the BAS(#FRAMES) behind it
        word = found["fdat"].strip()
        if entry := found["entry"]:
            kind = OF_FDAT.get(entry.upper())
            return {kind: _of_fdat(f"{entry} {word}", here)[kind]} if kind else {}
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
    elif told := _of_inline(value, inline, here):
        return {kind: told[kind]}
    elif not found["part"] and re.fullmatch(r"[$\w]+(?:\[\d+\])?", value):
        name = value.upper()
    return {kind: name}


def _carried(mode: str, here: str) -> str:
    """#TCP where the robot carries the part, empty where it does not; else a name that says so."""
    known = {"#TCP": "#TCP", "#BASE": "", "#NONE": ""}
    return known.get(mode.strip().upper(), f"$IPO_MODE{here}")


def _of_inline(value: str, inline: dict[str, str], here: str) -> dict[str, str | None]:
    """What the FDAT sets that a value names as inline forms do; empty where it does not."""
    named = _INLINE.fullmatch(value)
    body = inline.get(named[1].upper()) if named else None
    return {} if body is None else _of_fdat(body, here)


def _of_fdat(body: str, here: str) -> dict[str, str | None]:
    """What the components of an FDAT set; ``here``: behind the name of what they leave out.

    Without any it is not known.
    """
    parts = {name: part.text.strip().upper() for name, part in _parts(body, 0).items()}
    mode = parts.get("IPO_FRAME", "#NONE" if parts else "")
    names: dict[str, str | None] = {"$IPO_MODE": _carried(mode, here)}
    for kind in ("TOOL", "BASE"):
        number = parts.get(f"{kind}_NO", "")
        known = re.fullmatch(r"-?\d+", number)
        names[f"${kind}"] = f"{kind}_DATA[{number}]" if known else f"${kind}{here}"
    return names


class _InForce:
    """Which tool, base and IPO mode motions have."""

    def __init__(
        self,
        line: Callable[[int], str],
        clean: str,
        flow: Flow,
        frames: dict[str, Array],
        inline: dict[str, str],
    ) -> None:
        self._flow = flow
        self._blocks: list[_With] = []
        self._motions: list[_With] = []
        for found in _WITH.finditer(clean):
            names: dict[str, str | None] = {}
            for part in arguments(clean, found.end("motion"), found.end()):
                if given := _SET.match(part.text):
                    names |= _given(line(part.start), given, frames, inline)
            known = {kind: name for kind, name in names.items() if name is not None}
            end = _END_OF_BLOCK.search(clean, found.end()) if found["block"] else None
            of = self._blocks if found["block"] else self._motions
            of.append(_With(found.start(), end.start() if end else found.end(), known))
        self.at = cache(self._at)

    def _at(self, place: int) -> tuple[str | None, ...]:
        """By kind, for the motion at a place."""
        names = dict(self._flow.at(place))
        for sets in (self._blocks, self._motions):  # that of the motion goes before its block's
            i = bisect_right(sets, place, key=lambda one: one.at)
            if i and place < sets[i - 1].until:
                names |= sets[i - 1].names
        return tuple(map(names.get, KINDS))

    def different(self, goals: Sequence[int]) -> list[int]:
        """Of motions that have the same the first."""
        first: dict[tuple[str | None, ...], int] = {}
        for goal in goals:
            first.setdefault(self.at(goal), goal)
        return [*first.values()]

    def of(self, goals: Sequence[int]) -> dict[str, str | None] | None:
        """What motions have in common, empty where there are none; None: they differ."""
        first, *others = dict.fromkeys(map(self.at, goals)) or [()]
        if all(all(map(self._flow.same, first, other)) for other in others):
            return dict(zip(KINDS, first, strict=False))
        return None


def _framed(
    point: ProgramPoint, goals: Sequence[int], inline: dict[str, str], in_force: _InForce
) -> ProgramPoint:
    """The point with the names of its frames, and what about them forbids a correction.

    ``goals``: where motions go to it.
    """
    body = inline.get("F" + point.name.upper().removeprefix("X"))
    names = in_force.of(goals) if body is None else _of_fdat(body, f"{OF_LINE}{point.line}")
    if names is None:
        words = "motions with different tools or bases go to it"
        return replace(point, problem=point.problem or words)
    if mode := names.get("$IPO_MODE"):
        words = "the robot carries the part to a tool that stands"
        if mode != "#TCP":
            words = f"whether the robot carries the part is not known ({mode})"
        return replace(point, problem=point.problem or words)
    return replace(point, tool=names.get("$TOOL"), frame=names.get("$BASE"))
