# SPDX-License-Identifier: Apache-2.0
"""Kawasaki AS programs and locations as SAVE writes them (.as, .pg, .lc): mm and degrees.

    .PROGRAM weld()
      TOOL gun
      JMOVE #safe
      LMOVE seam[1]
      JOINT SPEED9 ACCU1 TIMER0 TOOL1 WORK0 CLAMP1 (OFF,0,0,O) OX= WX= #[36.46,37.629,-50.962,…] ;
    .END
    .TRANS
    seam[1] 495.507904 -83.463379 192.623932 -35.992920 112.299080 -179.965958
    .END
    .JOINTS
    #safe -39.931789 28.146606 -88.212029 1.514356 -58.995213 -3.377170
    .END

A location is a point where a motion goes to it alone, by its name. One from which the program makes
others stays as it is: a corrected one would correct them too, not as they need it. Sources are in
docs/programs.md.
"""

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import pose_of
from robocal_ros.programs.flow import Flow, FlowStep, flow_steps, labels_of
from robocal_ros.programs.points import (
    NUMBER,
    OF_LINE,
    Decimals,
    Dialect,
    Field,
    Program,
    ProgramPoint,
    arguments,
    line_of,
    masked,
    require_numbers,
)

AXES = 6  # numbers behind them are of external axes
NULL = "NULL"

_HEADER = re.compile(r"^\.([A-Z][A-Z0-9_]*)\b(?!\s*[=\[])[^\r\n]*", re.M)
_NAME = r"#?\.?[A-Za-z][\w.]*(?:\[[^\]\r\n]*\])*"
_LOCATION = re.compile(
    rf"^[ \t]*(#?[A-Za-z][\w.]*(?:\[[\d,]*\])*)((?:[ \t]+{NUMBER})+)[ \t]*\r?$", re.M
)
_STEP = re.compile(
    r"^[ \t]*(?:\d+[ \t]+)?(?:JOINT|LINEAR|FLIN|CIR1|CIR2)\b[^\r\n]*?#\[([^\]\r\n]*)\]", re.M
)
_MOTION = re.compile(
    r"\b(?:(?:J|L|X|H|FL|C1|C2)MOVE|[JL]APPRO|(?:J|L|C1|C2)W[SCE])\b[ \t]*([^\r\n]*)", re.I
)
_SET = re.compile(r"^[ \t]*(BASE|TOOL)[ \t]+([^\r\n]+)", re.M | re.I)
_TRANS = re.compile(r"TRANS[ \t]*\(", re.I)
_POINT = re.compile(rf"^[ \t]*POINT(?:/\w+)?[ \t]+({_NAME})[ \t]*=[ \t]*([^\r\n]*)", re.M | re.I)
_HERE = re.compile(rf"\bHERE[ \t]+({_NAME})", re.I)
_BLOCK = re.compile(
    r"^(?:\.PROGRAM[ \t]+(?P<alone>[\w.]+)|[ \t]*(?:(?P<begin>IF\b(?=[^\r\n]*\bTHEN\b)|S?CASE)"
    r"|(?P<loop>WHILE|FOR|DO)|(?P<branch>ELSEIF|S?VALUE|ANY)|(?P<else>ELSE)|(?P<end>END|UNTIL))"
    r"\b(?![ \t]*[=\[]))|\bGOTO[ \t]+(?P<jump>\w+)",
    re.M | re.I,
)
_LABEL = re.compile(
    r"^[ \t]*(?!(?:ANY|ELSE|S?VALUE)\b)(\d+(?![\w.])|[A-Z]\w*(?=[ \t]*:))[ \t]*:?",
    re.M | re.I,
)
_CALL = re.compile(r"\bCALL[ \t]+([\w.]+)", re.I)
_TOKEN = re.compile(_NAME)
_POSTURE = re.compile(r"^[ \t]*(LEFTY|RIGHTY|ABOVE|BELOW|UWRIST|DWRIST)\b", re.M | re.I)


@dataclass
class _Use:
    """Of a location: the motions that go to it alone, with the frames there, and what else."""

    goals: list[int] = field(default_factory=list)
    moved: bool = False  # a motion goes to it, or may: by an index that is reckoned
    frames: set[tuple[str | None, str | None]] = field(default_factory=set)
    other: int | None = None  # where the program does something else with it


class KawasakiDialect(Dialect):
    """Kawasaki: nothing in a point says the posture; the arm stays in the one that it has."""

    maker, suffixes = "kawasaki", (".as", ".pg", ".lc")
    decimals = Decimals(length=4, turn=5, joint=5)

    def read(self, text: str) -> Program:
        """Locations that motions go to, and taught steps; of a file without programs all."""
        labels, clean = labels_of(masked(text, ";"), _LABEL)
        headers = [*_HEADER.finditer(clean)]
        ends = [*(found.start() for found in headers), len(clean)][1:]
        sections = [(found[1], found.end(), end) for found, end in zip(headers, ends, strict=True)]
        programs = [(start, end) for name, start, end in sections if name == "PROGRAM"]
        located = [
            found
            for name, start, end in sections
            if name in ("TRANS", "JOINTS")
            for found in _LOCATION.finditer(clean, start, end)
        ]
        values = {found[1].lower(): found for found in located}
        arrays: dict[str, list[str]] = {}
        for name in values:
            if "[" in name:
                arrays.setdefault(name.split("[")[0], []).append(name)
        set_here = {
            found[1].lower().split("[")[0]
            for span in programs
            for pattern in (_POINT, _HERE)
            for found in pattern.finditer(clean, *span)
        }
        constants = {
            name: row for name, row in values.items() if name.split("[")[0] not in set_here
        }
        frames: dict[str, Array] = {NULL: np.eye(4)}
        uses = {name: _Use() for name in values}
        points: list[ProgramPoint] = []
        computed: list[tuple[int, str]] = []
        steps = labels + flow_steps(clean, _BLOCK, _CALL)
        for span in programs:
            steps += _set_up(text, clean, span, constants, frames)
        flow = Flow(partial(line_of, text), steps, frames)
        for span in programs:
            computed += _used(clean, span, flow, uses, arrays)
            points += _steps(text, clean, *span)
        for found in located:
            use = uses[found[1].lower()]
            if use.moved or not programs:
                points.append(_location(text, found, use if programs else None))
        notes = tuple(
            f"line {line_of(text, found.start())}: {found[1]} is not followed: of a point's "
            "postures the one nearest to the point before is taken"
            for found in _POSTURE.finditer(clean)
        )
        points.sort(key=lambda point: point.fields[0].start)
        made = tuple((line_of(text, at), words) for at, words in sorted(computed))
        return Program(text, tuple(points), frames, made, notes)


def _used(
    clean: str,
    span: tuple[int, int],
    flow: Flow,
    uses: Mapping[str, _Use],
    arrays: Mapping[str, Sequence[str]],
) -> list[tuple[int, str]]:
    """Note what one program does with each location; the places where it makes points itself."""
    computed = []
    goals: set[int] = set()
    for found in _MOTION.finditer(clean, *span):
        target = arguments(clean, found.start(1), found.end(1))[0]
        name = re.split(r"\s+TILL\b", target.text, flags=re.I)[0].strip()
        if not name:
            continue
        if not _TOKEN.fullmatch(name):
            computed.append((target.start, name))
        elif name.lower() in uses:
            set_up = flow.at(target.start)
            goals.add(target.start)
            use = uses[name.lower()]
            use.goals.append(target.start)
            use.moved = True
            use.frames.add((set_up.get("TOOL"), set_up.get("BASE")))
        else:  # a variable index, or a location that another file has
            computed.append((target.start, name))
            _note_array(name, target.start, uses, arrays, moved=True)
    for found in _POINT.finditer(clean, *span):
        computed.append((found.start(1), f"POINT {found[1]} = {found[2].strip()}"))
    for token in _TOKEN.finditer(clean, *span):
        name = token[0].lower()
        if name in uses and token.start() not in goals:
            use = uses[name]
            use.other = token.start() if use.other is None else use.other
        elif "[" in name and name not in uses:
            _note_array(name, token.start(), uses, arrays)
    return computed


def _note_array(
    name: str,
    at: int,
    uses: Mapping[str, _Use],
    arrays: Mapping[str, Sequence[str]],
    moved: bool = False,
) -> None:
    """An index that is reckoned may mean each location of its array."""
    for one in arrays.get(name.lower().split("[")[0], ()):
        use = uses[one]
        use.other = at if use.other is None else use.other
        use.moved |= moved


def _set_up(
    text: str,
    clean: str,
    span: tuple[int, int],
    constants: Mapping[str, "re.Match[str]"],
    frames: dict[str, Array],
) -> Iterator[FlowStep]:
    """Where a program sets tool or base; ``constants``: locations that no program sets, by name."""
    for setting in _SET.finditer(clean, *span):
        kind, word = setting[1].upper(), setting[2].strip()
        name = f"{kind}{OF_LINE}{line_of(text, setting.start())}"
        if word.upper() == NULL:
            name = NULL
        elif (T := _constant(clean, setting.start(2), setting.end(2), constants)) is not None:
            frames[name] = T
        yield FlowStep(setting.start(), "set", {kind: name})


def _constant(
    clean: str, start: int, end: int, constants: Mapping[str, "re.Match[str]"]
) -> Array | None:
    """A transformation that is written out, or the constant of that name; None: reckoned."""
    word = clean[start:end].strip()
    located = constants.get(word.lower())
    if located is not None and not word.startswith("#"):
        given = [part.value for part in _numbers(located)[:AXES]]
    else:
        begins = _TRANS.match(word)
        if begins is None or not word.endswith(")"):
            return None
        parts = arguments(word, begins.end(), len(word) - 1)
        given = [part.value if part.text else 0.0 for part in parts]
        given += [0.0] * (AXES - len(given))
    known = len(given) == AXES and np.all(np.isfinite(given))  # a variable may be named nan
    return pose_of("kawasaki", given) if known else None


def _numbers(found: "re.Match[str]") -> list[Field]:
    return [Field(found.start(2) + one.start(), one[0]) for one in re.finditer(r"\S+", found[2])]


def _location(text: str, found: "re.Match[str]", use: _Use | None) -> ProgramPoint:
    """A row of .TRANS or .JOINTS."""
    fields, joints = _numbers(found), found[1].startswith("#")
    own, rest = tuple(fields[:AXES]), fields[AXES:]
    external = {} if joints else {i: part for i, part in enumerate(rest, start=1)}
    line = line_of(text, found.start(1))
    point = ProgramPoint(found[1], line, own, joints, external=external, order=found.start(1))
    if len(own) < AXES:
        return replace(point, problem=f"has {len(own)} numbers in place of {AXES}")
    if problem := require_numbers(own):
        return replace(point, problem=problem)
    if use is None:
        return point
    if use.other is not None:
        words = f"the program reckons with it in line {line_of(text, use.other)}"
        return replace(point, problem=words)
    point = replace(point, order=min(use.goals))
    if joints:
        return point
    if len(use.frames) > 1:
        return replace(point, problem="motions with different tools or bases go to it")
    tool, base = next(iter(use.frames))
    return replace(point, tool=tool, frame=base)


def _steps(text: str, clean: str, start: int, end: int) -> list[ProgramPoint]:
    """Steps that were taught on the pendant, by joints."""
    points = []
    for found in _STEP.finditer(clean, start, end):
        fields = arguments(clean, found.start(1), found.end(1))
        line = line_of(text, found.start(1))
        problem = require_numbers(fields)
        if not problem and len(fields) < AXES:
            problem = f"has {len(fields)} numbers in place of {AXES}"
        point = ProgramPoint(
            f"step in line {line}", line, tuple(fields[:AXES]), True, problem=problem
        )
        points.append(replace(point, order=found.start(1)))
    return points
