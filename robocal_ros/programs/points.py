# SPDX-License-Identifier: Apache-2.0
"""A robot program as text with the points in it: where each number stands, what it means.

A file is bytes to us: read as Latin-1, in which every byte is one character, and written back so;
what is not a number of a corrected point comes out as it came in, whatever its encoding and line
ends. A point that cannot be corrected keeps its place in the list, with the reason.
"""

import re
from abc import ABC, abstractmethod
from bisect import bisect_left
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from robocal_ros.ground.errors import InputError, LimitError
from robocal_ros.ground.frames import Array
from robocal_ros.programs.conventions import Maker, pose_of

NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"
_NUMBER = re.compile(NUMBER)
# How near to zero, or to a quadrant's end, a joint is on either side of it, rad.
EDGE = 1e-6
AT_ZERO = 1e-9
OF_LINE = " of line "  # in the name of a frame that has none: it is of its own file alone
NOT_CONNECTED = 8.9e8  # ABB writes 9E9, some tools 9E8 or 1E10, for an axis that is not there


@dataclass(frozen=True)
class Field:
    """A number in the text: its characters, blanks around it where the format fills with them."""

    start: int
    text: str

    @property
    def end(self) -> int:
        """Where it ends."""
        return self.start + len(self.text)

    @property
    def value(self) -> float:
        """Its value; NaN where no number is written."""
        text = self.text.strip()
        return float(text) if _NUMBER.fullmatch(text) else np.nan

    @property
    def decimals(self) -> int:
        """Digits behind its point, those that an exponent makes as well."""
        mantissa, _, exponent = self.text.strip().lower().partition("e")
        return max(len(mantissa.partition(".")[2]) - int(exponent or 0), 0)


@dataclass(frozen=True, eq=False)
class Posture:
    """What a point says of the joints that reach it.

    ``ranges`` (n, 2): of each joint, rad; infinite where nothing is said.
    ``behind``: the centre of the wrist lies behind axis 1; ``above``: before the upper arm, so that
    the elbow is up. None: not said. See `postures.shoulder_and_elbow`.
    ``near`` (n,): the posture that the controller is told to stay near; None: none.
    """

    ranges: Array | None = None
    behind: bool | None = None
    above: bool | None = None
    near: Array | None = None

    @property
    def told(self) -> bool:
        """Whether anything is said."""
        return any(part is not None for part in (self.ranges, self.behind, self.above, self.near))


@dataclass(frozen=True, eq=False)
class ProgramPoint:
    """A taught point.

    ``fields``: of a pose the numbers of its maker, of joints one number each.
    ``joints``: whether it is given by joints; ``joint_unit``: rad of one unit of theirs.
    ``tool``, ``frame``: names of the frames that a pose refers to; None: the program does not say.
    ``marks``: what says the posture, by the names that its dialect has for them.
    ``external``: of a pose the axes beside the robot's own that it says, by number from 1.
    ``problem``: why it cannot be corrected, whatever the model; empty: it can.
    ``of_another``: it moves other axes than this robot's, so that nothing of it is to be corrected.
    """

    name: str
    line: int
    fields: tuple[Field, ...]
    joints: bool = False
    joint_unit: float = np.pi / 180.0
    tool: str | None = None
    frame: str | None = None
    posture: Posture = field(default_factory=Posture)
    marks: Mapping[str, Field] = field(default_factory=dict)
    external: Mapping[int, Field] = field(default_factory=dict)
    problem: str = ""
    of_another: bool = False
    order: int = 0  # in which the program comes to it, as far as its text tells

    @property
    def numbers(self) -> list[float]:
        """The numbers as they are written."""
        return [part.value for part in self.fields]


@dataclass(frozen=True, eq=False)
class Program:
    """A program's text and what is in it.

    ``frames``: transforms (4, 4), m, of the frames that the text gives, by the name that points
    have for them; beside these the names that mean the base or the flange itself.
    ``computed``: places where the program makes a point itself, by line and words.
    ``notes``: what else a person should know, in words.
    """

    text: str
    points: tuple[ProgramPoint, ...]
    frames: Mapping[str, Array] = field(default_factory=dict)
    computed: tuple[tuple[int, str], ...] = ()
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Stance:
    """How an arm stands at joints q (n,): see `Posture`."""

    q: Array
    behind: bool
    above: bool


@dataclass(frozen=True)
class Decimals:
    """Fewest decimals that are written: of a length, of a part of the orientation, of a joint.

    ``fixed``: exactly these, in the width of the old number.
    """

    length: int
    turn: int
    joint: int
    fixed: bool = False


class Dialect(ABC):
    """How one maker writes programs; ``names_frames``: whether its files give frames by name."""

    maker: Maker
    suffixes: tuple[str, ...]  # of its files
    decimals: Decimals
    names_frames = False

    @abstractmethod
    def read(self, text: str) -> Program:
        """The points and frames in a program's text."""

    def to_arm(self, shown: Array) -> Array:
        """Joints (n,) of the robot file where the controller shows these."""
        return shown

    def from_arm(self, q: Array) -> Array:
        """What the controller shows: the inverse of `to_arm`."""
        return q

    def marks(self, point: ProgramPoint, stance: Stance) -> dict[str, str]:
        """New text of the point's marks that say another stance; near an edge they stay."""
        return {}


def base_moved(point: ProgramPoint, ways: Mapping[int, Array]) -> Array:
    """By which external axes have moved the robot's base (3,), m, in the axes of the base.

    ``ways``: of an axis the unit vector (3,) along which a millimetre of it carries the robot, zero
    where it carries neither the robot nor what the poses are in. Raises `LimitError` for an axis
    that is not at zero and of which nothing is known.
    """
    moved = np.zeros(3)
    for number, part in point.external.items():
        value = part.value
        if abs(value) < AT_ZERO or value >= NOT_CONNECTED:
            continue
        words = f"external axis {number} is at {part.text.strip()}"
        if number not in ways:
            raise LimitError(f"{words}: it may carry robot or part; say which by --external")
        if np.any(ways[number]):
            if not np.isfinite(value):
                raise LimitError(f"{words}, which is no number")
            moved += 1e-3 * value * ways[number]
    return moved


def line_of(text: str, at: int) -> int:
    """The line, from 1, of a character."""
    return text.count("\n", 0, at) + 1


def lines_of(text: str) -> Callable[[int], int]:
    """`line_of` for many characters of a long text."""
    ends = [found.start() for found in re.finditer("\n", text)]
    return lambda at: bisect_left(ends, at) + 1


def masked(text: str, comment: str, quote: str = '"') -> str:
    """The text with comments and what is quoted blanked, every character at its place.

    ``comment``: the character that begins one, up to the end of its line.
    """
    pattern = f"{quote}[^{quote}\r\n]*{quote}|{re.escape(comment)}[^\r\n]*"
    return re.sub(pattern, lambda found: " " * len(found[0]), text)


def matching(text: str, at: int) -> int:
    """Where the bracket closes that opens at ``at``; the end of the text where it never does."""
    opens = text[at]
    closes, depth = {"(": ")", "[": "]", "{": "}"}[opens], 0
    for found in re.finditer(f"[{re.escape(opens + closes)}]", text[at:]):
        depth += 1 if found[0] == opens else -1
        if depth == 0:
            return at + found.start()
    return len(text)


def arguments(text: str, start: int, end: int) -> list[Field]:
    """What stands between the commas of text[start:end] that no bracket holds, blanks stripped."""
    parts, depth, begin = [], 0, start
    for at in range(start, end + 1):
        sign = text[at] if at < end else ","
        if sign in "([{":
            depth += 1
        elif sign in ")]}":
            depth -= 1
        elif (sign == "," and depth == 0) or at == end:
            raw = text[begin:at]
            parts.append(Field(begin + len(raw) - len(raw.lstrip()), raw.strip()))
            begin = at + 1
    return parts


def require_numbers(fields: Sequence[Field]) -> str:
    """Why these are no numbers; empty where they are."""
    bad = next((part.text for part in fields if not np.isfinite(part.value)), None)
    return "" if bad is None else f"holds {bad.strip() or 'nothing'!r} in place of a number"


def written(value: float, like: Field, least: int, digits: int | None = None) -> str:
    """A number written as the one that it replaces, with ``least`` decimals or more.

    ``digits``: exactly so many decimals, in the width of the old one, and no zero before the point,
    as FANUC writes.
    """
    text = f"{value:.{max(like.decimals, least) if digits is None else digits}f}"
    text = text if float(text) else text.lstrip("-")
    if digits is None:
        return text
    return re.sub(r"^(-?)0(\.\d*[1-9])", r"\1\2", text).rjust(len(like.text))


def spliced(text: str, changes: Sequence[tuple[Field, str]]) -> str:
    """The text with fields replaced."""
    parts, at = [], 0
    for part, new in sorted(changes, key=lambda change: change[0].start):
        parts += [text[at : part.start], new]
        at = part.end
    return "".join([*parts, text[at:]])


def frame_given(maker: Maker, given: str) -> tuple[str, Array]:
    """Name and transform of NAME=X,Y,Z,… in the maker's own numbers and units.

    Raises `InputError` when it is none.
    """
    name, sign, cells = given.rpartition("=")
    try:
        numbers = [float(cell) for cell in cells.split(",")]
        if not (sign and name and np.all(np.isfinite(numbers))):
            raise ValueError(given)
        return name.strip(), pose_of(maker, numbers)
    except (ValueError, InputError) as error:
        raise InputError(f"'{given}' is no frame such as NAME=X,Y,Z,…: {error}") from error
