# SPDX-License-Identifier: Apache-2.0
"""Universal Robots scripts (.script): poses p[x, y, z, rx, ry, rz], joints [q1, …, q6], m and rad.

    global Waypoint_1_p=p[.433025361705, -.467959205379, .522310714714, 1.5003, .5214, .5309]
    global Waypoint_1_q=[1.9942, -1.6685, 1.9331, -.2718, 1.3209, .0036]
    movej(get_inverse_kin(Waypoint_1_p, qnear=Waypoint_1_q), a=1.4, v=1.05)

A list is a point where a motion goes to it, by itself or by its name. Sources are in
docs/programs.md.
"""

import re
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import pose_of
from robocal_ros.programs.flow import Flow, FlowStep, flow_steps
from robocal_ros.programs.points import (
    OF_LINE,
    Decimals,
    Dialect,
    Field,
    Posture,
    Program,
    ProgramPoint,
    arguments,
    line_of,
    masked,
    matching,
    require_numbers,
)

TARGETS = {
    "movej": 1, "movel": 1, "movep": 1, "movec": 2, "servoj": 1, "servoc": 1,
    "optimovej": 1, "optimovel": 1,
}  # fmt: skip
BASE, TCP = "base", "tcp"
SET_TCP = "set_tcp"

_CALL = re.compile(rf"\b({'|'.join(TARGETS)}|{SET_TCP})\s*(?=\()")
_BLOCK = re.compile(
    r"\b(?:(?P<begin>if)|(?P<loop>while|for)|(?P<branch>elif)|(?P<else>else)"
    r"|(?P<leave>break|continue)|(?P<end>end)"
    r"|(?:def|thread|sec)\s+(?P<routine>\w+))\b"
)
_OWN_CALL = re.compile(r"\b(\w+)\s*\(")
_ASSIGNED = re.compile(r"\b(\w+)\s*=\s*(?=p?\[)")
_LIST = re.compile(r"p?\s*(?=\[)")
_COMPUTED = re.compile(r"\b(pose_trans|pose_add|pose_sub|interpolate_pose)\s*\(")
_SET = re.compile(
    r"^[ \t]*(?:(?:global|local)[ \t]+)?(\w+)[ \t]*(?:\[[^\]\r\n]*\])?[ \t]*=(?!=)[^\r\n]*", re.M
)


class UrScriptDialect(Dialect):
    """Universal Robots: nothing in a pose says the posture, the qnear of a motion does."""

    maker, suffixes = "ur", (".script", ".txt")
    decimals = Decimals(length=7, turn=8, joint=8)

    def read(self, text: str) -> Program:
        """Lists that motions go to."""
        clean = masked(text, "#")
        frames: dict[str, Array] = {BASE: np.eye(4)}
        assigned = list(_ASSIGNED.finditer(clean))
        lists = {found.end(): found[1] for found in assigned}
        values: dict[str, list[int]] = {}
        for at, name in lists.items():
            values.setdefault(name, []).append(at)
        targets = _targets(text, clean, frames)
        goals: dict[int, list[_Target]] = {}
        for target in targets:
            places = [target.at] if _LIST.match(target.word) else values.get(target.word, [])
            for at in places:
                goals.setdefault(at, []).append(target)
        points = []
        for at in sorted(goals):
            point = _point(text, clean, at, lists.get(at), goals[at], values)
            if point is not None:
                points.append(point)
        made = [(found.start(), f"{found[1]}(…)") for found in _COMPUTED.finditer(clean)]
        made += [
            (target.at, target.word)
            for target in targets
            if not (
                _LIST.match(target.word) or target.word in values or _COMPUTED.match(target.word)
            )
        ]
        literal, named = {found.start() for found in assigned}, {lists.get(at) for at in goals}
        made += [
            (found.start(1), found[0].strip())
            for found in _SET.finditer(clean)
            if found[1] in named and found.start(1) not in literal
        ]
        computed = tuple((line_of(text, at), words) for at, words in sorted(made))
        return Program(text, tuple(points), frames, computed)


@dataclass(frozen=True)
class _Target:
    """What a motion goes to: a list at ``at`` or the name of one; ``near`` likewise, or none."""

    at: int
    word: str
    tool: str | None
    order: int
    near: Field | None = None


def _targets(text: str, clean: str, frames: dict[str, Array]) -> list[_Target]:
    """What the motions go to, in the order of the text; poses of set_tcp go into ``frames``."""
    calls = [
        (call, arguments(clean, call.end() + 1, matching(clean, call.end())))
        for call in _CALL.finditer(clean)
    ]
    steps = flow_steps(clean, _BLOCK, _OWN_CALL)
    for call, parts in calls:
        if call[1] == SET_TCP:
            fields = _fields(clean, parts[0].start)
            tool = f"{SET_TCP}{OF_LINE}{line_of(text, call.start())}"
            if fields is not None and len(fields) == 6 and not require_numbers(fields):
                frames[tool] = pose_of("ur", [part.value for part in fields])
            steps.append(FlowStep(call.start(), "set", {SET_TCP: tool}))
    flow, found = Flow(partial(line_of, text), steps, frames), []
    for call, parts in calls:
        tool_there = flow.at(call.start()).get(SET_TCP)
        for part in parts[: TARGETS.get(call[1], 0)]:
            word, near, own = _unnamed(part), None, tool_there
            inverse = re.match(r"get_inverse_kin\s*(?=\()", word.text)
            if inverse:
                at = word.start + inverse.end()
                inner = arguments(clean, at + 1, matching(clean, at))
                word = _unnamed(inner[0])
                near = inner[1] if len(inner) > 1 else None
                if len(inner) > 4 or any(re.match(r"tcp\s*=", one.text) for one in inner[1:]):
                    own = f"tcp of get_inverse_kin in line {line_of(text, at)}"
            found.append(_Target(word.start, word.text, own, call.start(), near))
    return found


def _unnamed(part: Field) -> Field:
    """An argument without its name (q=, pose=)."""
    name = re.match(r"\w+\s*=\s*(?!=)", part.text)
    return part if name is None else Field(part.start + name.end(), part.text[name.end() :])


def _fields(clean: str, at: int) -> list[Field] | None:
    """The numbers of a list that begins at ``at``; None where none does."""
    begins = _LIST.match(clean, at)
    if begins is None:
        return None
    return arguments(clean, begins.end() + 1, matching(clean, begins.end()))


def _point(
    text: str,
    clean: str,
    at: int,
    name: str | None,
    targets: list[_Target],
    values: dict[str, list[int]],
) -> ProgramPoint | None:
    fields = _fields(clean, at)
    if fields is None or len(fields) != 6:
        return None
    line, joints = line_of(text, at), not clean.startswith("p", at)
    title = name or f"line {line}"
    point = ProgramPoint(title, line, tuple(fields), joints, 1.0, problem=require_numbers(fields))
    point = replace(point, order=min(target.order for target in targets))
    if joints:
        return point
    tools = {target.tool for target in targets}
    if len(tools) > 1:
        return replace(point, problem=point.problem or "motions with different tools go to it")
    near = next((target.near for target in targets if target.near is not None), None)
    q = None if near is None else _joints(clean, near, values)
    tool = tools.pop() or TCP
    return replace(point, tool=tool, frame=BASE, posture=Posture(near=q))


def _joints(clean: str, near: Field, values: dict[str, list[int]]) -> Array | None:
    """The joints that a qnear names, or is."""
    word = re.sub(r"^qnear\s*=\s*", "", near.text)
    at = near.start + len(near.text) - len(word)
    places = [at] if word.startswith("[") else values.get(word, [])
    fields = _fields(clean, places[0]) if len(places) == 1 else None
    if fields is None or len(fields) != 6 or require_numbers(fields):
        return None
    return np.array([part.value for part in fields])
