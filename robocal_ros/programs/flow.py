# SPDX-License-Identifier: Apache-2.0
"""Which tool and base are in force at a place of a program, as its branches, loops and calls tell.

A text is gone through in its order. Behind a branch or a loop holds what all ways to there have;
where they differ it is unknown, by a name that no frame has. A routine that is called sets what it
sets in some way: unknown behind its call, but for what is in force there anyway.
"""

import math
import re
from bisect import bisect_right
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.programs.points import OF_LINE

State = Mapping[str, str | None]  # by kind the frame in force; None, or left out: nothing says it


@dataclass(frozen=True)
class FlowStep:
    """A place where what is in force may change.

    ``does``: "set" these ``names`` by kind; "begin" a block, or a "loop", whose further ways begin
    at a "branch" or "else", up to its "end"; "leave" the innermost loop, or go to its begin; "jump"
    to a "label" of the same routine; define a "routine", with what its callers have, or one that
    stands "alone", of whose callers nothing is known; "call" one. ``name``: the routine's or the
    label's.
    """

    at: int
    does: str
    names: State = field(default_factory=dict)
    name: str = ""


def labels_of(clean: str, label: re.Pattern[str]) -> tuple[list[FlowStep], str]:
    """Labels, whose names are the first group, and the text with these blanked.

    So that what stands behind one begins its line; every character stays at its place.
    """
    found = [*label.finditer(clean)]
    steps = [FlowStep(one.start(), "label", name=one[1].lower()) for one in found]
    return steps, label.sub(lambda one: " " * len(one[0]), clean)


def flow_steps(clean: str, blocks: re.Pattern[str], calls: re.Pattern[str]) -> list[FlowStep]:
    """Blocks, jumps, routines and their calls; ``blocks``: its groups are named as `FlowStep.does`.

    Of ``calls`` the first group is the routine's name; routines of other texts are left out.
    """
    steps, routines = [], dict[int, str]()
    for found in blocks.finditer(clean):
        does = str(found.lastgroup)
        name = found[does].lower()
        if does in ("routine", "alone"):
            routines[found.start(does)] = name
        steps.append(FlowStep(found.start(), does, name=name))
    known = set(routines.values())
    for found in calls.finditer(clean):
        name, at = found[1].lower(), found.start(1)
        if name in known and at not in routines:
            steps.append(FlowStep(at, "call", name=name))
    return steps


@dataclass
class _Block:
    """A block of step ``begin``.

    ``before``: in force at its begin; ``routine``: that it stands in. ``ends``: of its ways so far,
    in force there; ``whole``: whether one of them is gone in any case.
    """

    begin: int
    does: str
    before: State
    routine: str
    ends: list[State] = field(default_factory=list)
    whole: bool = False


@dataclass
class _Known:
    """What one way through the text finds out for the next.

    ``starts``: by the step of a loop, in force where it begins; ``jumps``: by routine and label,
    where each jump to it is. Of a routine: ``sets``, the kinds and frames that it sets; ``called``,
    what its callers have in force.
    """

    starts: dict[int, State] = field(default_factory=dict)
    jumps: dict[tuple[str, str], list[State]] = field(default_factory=dict)
    sets: dict[str, set[tuple[str, str | None]]] = field(default_factory=dict)
    called: dict[str, State] = field(default_factory=dict)


class Flow:
    """What is in force where; ``frames``: by which two names may mean the same.

    ``line``: of a place in the text, in words.
    """

    def __init__(
        self,
        line: Callable[[int], object],
        steps: Sequence[FlowStep],
        frames: Mapping[str, Array],
    ) -> None:
        self._line, self._frames = line, frames
        self._steps = sorted(steps, key=lambda step: step.at)
        self._places = [step.at for step in self._steps]
        self._states: list[State] = []
        routines = [step for step in self._steps if step.does in ("routine", "alone")]
        self._defined = {step.name: step.at for step in routines}
        callers: dict[str, State] = {}
        for _ in range(len(routines) + 1):  # what one is called with may hang on its own caller's
            known = _Known()
            while (found := self._gone_through(callers, known)) != known:
                known = found
            if known.called == callers:
                break
            callers = known.called

    def at(self, place: int) -> State:
        """What is in force at a place of the text."""
        i = bisect_right(self._places, place)
        return self._states[i - 1] if i else {}

    def _gone_through(self, callers: Mapping[str, State], known: _Known) -> _Known:
        state: State = {}
        routine, blocks = "", list[_Block]()
        self._states, found = [], _Known()
        for i, step in enumerate(self._steps):
            match step.does:
                case "set":
                    state = {**state, **step.names}
                    found.sets.setdefault(routine, set()).update(step.names.items())
                case "call":
                    sets = known.sets.get(step.name, set())
                    found.sets.setdefault(routine, set()).update(sets)
                    kinds = {kind for kind, its in sets if not self.same(its, state.get(kind))}
                    others = found.called.get(step.name, state)
                    met = self._met([others, state], self._defined[step.name])
                    found.called[step.name] = met
                    state = {**state, **{kind: self._unknown(kind, step.at) for kind in kinds}}
                case "alone":
                    state, routine = {}, step.name
                    blocks.clear()
                case "routine":
                    blocks.append(_Block(i, step.does, state, routine))
                    state, routine = callers.get(step.name, state), step.name
                case "begin" | "loop":
                    state = self._met([state, known.starts.get(i, state)], step.at)
                    blocks.append(_Block(i, step.does, state, routine))
                case "branch" | "else" if blocks:
                    blocks[-1].ends.append(state)
                    blocks[-1].whole |= step.does == "else"
                    state = blocks[-1].before
                case "leave":
                    loops = [block for block in blocks if block.does == "loop"]
                    if loops:
                        loops[-1].ends.append(state)
                case "jump":
                    found.jumps.setdefault((routine, step.name), []).append(state)
                case "label":
                    jumps = known.jumps.get((routine, step.name), [])
                    state = self._met([state, *jumps], step.at)
                case "end" if blocks:
                    block = blocks.pop()
                    if block.does == "loop":
                        begin = self._steps[block.begin].at
                        found.starts[block.begin] = self._met(
                            [block.before, *block.ends, state], begin
                        )
                    if block.does == "routine":
                        state, routine = block.before, block.routine
                    else:
                        ways = [*block.ends, state, *([] if block.whole else [block.before])]
                        state = self._met(ways, step.at)
            self._states.append(state)
        return found

    def _met(self, states: Sequence[State], at: int) -> State:
        """In force where ways meet that have these; where they differ it is unknown."""
        first, *others = states
        kinds = dict.fromkeys(kind for state in states for kind in state)
        return {
            kind: first.get(kind)
            if all(self.same(first.get(kind), other.get(kind)) for other in others)
            else self._unknown(kind, at)
            for kind in kinds
        }

    def same(self, one: str | None, other: str | None) -> bool:
        """Whether two names mean the same frame."""
        if one == other or not (one or other):
            return True
        T_one, T_other = (self._frames.get(name or "") for name in (one, other))
        return T_one is not None and T_other is not None and np.array_equal(T_one, T_other)

    def _unknown(self, kind: str, at: int) -> str:
        return f"{kind}{OF_LINE}{self._line(at)} on"


@dataclass(eq=False)
class TextRegion:
    """A part of a text that is gone through from its begin: a routine, a loop's body, a branch.

    ``around``: the one that it is part of; None: it is a routine. ``jumps``: whether one has any.
    """

    begin: int
    around: "TextRegion | None" = None
    loop: bool = False
    end: float = math.inf
    jumps: bool = False

    @property
    def routine(self) -> "TextRegion":
        """The routine that it is part of, or is."""
        return self if self.around is None else self.around.routine


class TextRegions:
    """Of which regions a place of a text is part; at ``begins`` other texts begin."""

    def __init__(self, steps: Sequence[FlowStep], begins: Sequence[int] = ()) -> None:
        self._calls = sorted(step.at for step in steps if step.does == "call")
        self._places, self._found = [0], [TextRegion(0)]
        places = [(step.at, step.does) for step in steps]
        for at, does in sorted([*places, *((begin, "alone") for begin in begins)]):
            one = self._found[-1]
            match does:
                case "alone":
                    one = TextRegion(at)
                case "begin" | "loop":
                    one = TextRegion(at, one, does == "loop")
                case "branch" | "else" if one.around:
                    one = TextRegion(at, one.around)
                case "end" if one.around:
                    one.end, one = at, one.around
                case "jump":
                    one.routine.jumps = True
            self._places.append(at)
            self._found.append(one)

    def at(self, place: int) -> TextRegion:
        """The innermost that a place is part of."""
        return self._found[bisect_right(self._places, place) - 1]

    def around(self, place: int) -> list[TextRegion]:
        """All that a place is part of, from the innermost to its routine."""
        found = [self.at(place)]
        while found[-1].around:
            found.append(found[-1].around)
        return found

    def calls(self, first: float, last: float) -> bool:
        """Whether a routine is called between two places."""
        return bisect_right(self._calls, last) > bisect_right(self._calls, first)
