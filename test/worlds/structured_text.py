# SPDX-License-Identifier: Apache-2.0
"""Runs the Structured Text of docs/plc.md as a PLC does: what it uses of IEC 61131-3:2013.

Types are held to: no number is taken for a BOOL, no WORD for a number, no UDINT for a DINT.
"""

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[2] / "docs" / "plc.md"
TOKEN = re.compile(
    r"(?P<skip>\(\*.*?\*\)|\s+)|T#(?P<time>\d+(?:MS|S))|(?P<type>[A-Z]+)#(?P<typed>\d+)"
    r"|(?P<name>[A-Za-z_]\w*)|(?P<number>\d+)|(?P<sign>:=|<>|<=|>=|\.\.|[-=<>+*/()\[\],;:.])",
    re.DOTALL,
)
WIDTHS = {"INT": (-(2**15), 2**15), "DINT": (-(2**31), 2**31), "UINT": (0, 2**16)}
WIDTHS |= {"UDINT": (0, 2**32), "WORD": (0, 2**16)}
LITERAL, BOOL, TIME, STRING = "a literal", "BOOL", "TIME", "STRING"
COMPARE: dict[str, Callable[[Any, Any], bool]] = {
    "=": lambda a, b: a == b,
    "<>": lambda a, b: a != b,
    "<": lambda a, b: a < b,
    ">": lambda a, b: a > b,
    "<=": lambda a, b: a <= b,
    ">=": lambda a, b: a >= b,
}
SUM: dict[str, Callable[[int, int], int]] = {"+": lambda a, b: a + b, "-": lambda a, b: a - b}
TERM: dict[str, Callable[[int, int], int]] = {
    "*": lambda a, b: a * b,
    "/": lambda a, b: a // b,
    "MOD": lambda a, b: a % b,
}
Value = tuple[str, Callable[[], Any]]  # its type, and what it is now


def samples() -> dict[str, str]:
    """The programs of the page, by the title that they stand below."""
    found, title = {}, ""
    for part in re.split(r"^(?=#+ )", PAGE.read_text(), flags=re.MULTILINE):
        title = part.split("\n")[0].lstrip("# ")
        if program := re.search(r"^```\n(VAR\n.*?)^```", part, re.DOTALL | re.MULTILINE):
            found[title] = program[1]
    return found


@dataclass
class OnDelay:
    """TON."""

    since_s: float | None = None
    is_over: bool = False

    def take(self, given: bool, delay_s: float, now_s: float) -> None:
        self.since_s = (now_s if self.since_s is None else self.since_s) if given else None
        self.is_over = self.since_s is not None and now_s - self.since_s >= delay_s


class StructuredText:
    """One program: its variables by name, and `scan`, a cycle. ``clock``: seconds."""

    def __init__(self, text: str, clock: Callable[[], float]) -> None:
        self._clock = clock
        self._tokens = _tokens(text)
        self.types: dict[str, str] = {}
        self._values: dict[str, Any] = {}
        while self._takes("VAR"):
            self._takes("RETAIN")
            while not self._takes("END_VAR"):
                self._declare()
        self._body = self._statements(())

    def __getitem__(self, name: str) -> Any:
        return self._values[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._values[name] = _within(self.types[name], value, name)

    def scan(self) -> None:
        """One cycle of the program."""
        self._body()

    # ---- words ----------------------------------------------------------------------------------

    def _next(self) -> tuple[str, str]:
        return self._tokens.pop(0)

    def _takes(self, *words: str) -> str:
        if self._tokens and self._tokens[0][1] in words and self._tokens[0][0] in ("name", "sign"):
            return self._next()[1]
        return ""

    def _must(self, *words: str) -> str:
        found = self._takes(*words)
        assert found, f"{' or '.join(words)} is missing before {self._tokens[:5]}"
        return found

    def _declare(self) -> None:
        names = [self._next()[1]]
        while self._takes(","):
            names.append(self._next()[1])
        self._must(":")
        kind, count = self._next()[1], 0
        if kind == "ARRAY":
            assert [self._next()[1] for _ in range(3)] == ["[", "0", ".."]
            count = int(self._next()[1]) + 1
            self._must("]") and self._must("OF")
            kind = self._next()[1]
        if kind == STRING and self._takes("("):
            self._next()
            self._must(")")
        start = {BOOL: False, STRING: "", "TON": None}.get(kind, 0)
        if self._takes(":="):
            given, value = self._expression()
            start = _within(kind, value(), names[0])
            _same(given, kind)
        self._must(";")
        for name in names:
            assert name not in self.types, f"{name} is declared twice"
            self.types[name] = f"{kind}[]" if count else kind
            self._values[name] = [start] * count if count else start
            if kind == "TON":
                self._values[name] = OnDelay()

    # ---- statements -----------------------------------------------------------------------------

    def _statements(self, ends: tuple[str, ...]) -> Callable[[], None]:
        """Up to one of the words, which stays; a number ends them too, before a colon."""
        done: list[Callable[[], None]] = []
        while self._tokens and self._tokens[0][1] not in ends:
            if "END_CASE" in ends and self._tokens[0][0] == "number":
                break
            done.append(self._statement())

        def run() -> None:
            for one in done:
                one()

        return run

    def _statement(self) -> Callable[[], None]:
        if self._takes("IF"):
            return self._if()
        if self._takes("CASE"):
            return self._case()
        name = self._next()[1]
        kind = self.types[name]
        made = self._delay(name) if kind == "TON" else self._assignment(name, kind)
        self._must(";")
        return made

    def _assignment(self, name: str, kind: str) -> Callable[[], None]:
        place = None
        if kind.endswith("[]"):
            self._must("[")
            place, kind = int(self._next()[1]), kind[:-2]
            assert place < len(self._values[name])
            self._must("]")
        self._must(":=")
        given, value = self._expression()
        _same(given, kind)

        def assign() -> None:
            if place is None:
                self._values[name] = _within(kind, value(), name)
            else:
                self._values[name][place] = _within(kind, value(), name)

        return assign

    def _delay(self, name: str) -> Callable[[], None]:
        self._must("(")
        self._must("IN") and self._must(":=")
        kind, given = self._expression()
        _same(kind, BOOL)
        self._must(",") and self._must("PT") and self._must(":=")
        kind, delay_s = self._expression()
        _same(kind, TIME)
        self._must(")")
        return lambda: self._values[name].take(given(), delay_s(), self._clock())

    def _if(self) -> Callable[[], None]:
        branches: list[tuple[Callable[[], Any], Callable[[], None]]] = []
        word = "IF"
        while word in ("IF", "ELSIF"):
            kind, holds = self._expression()
            _same(kind, BOOL)
            self._must("THEN")
            branches.append((holds, self._statements(("ELSIF", "ELSE", "END_IF"))))
            word = self._must("ELSIF", "ELSE", "END_IF")
        if word == "ELSE":
            branches.append((lambda: True, self._statements(("END_IF",))))
            self._must("END_IF")
        self._takes(";")

        def run() -> None:
            next((body for holds, body in branches if holds()), lambda: None)()

        return run

    def _case(self) -> Callable[[], None]:
        kind, value = self._expression()
        _same(kind, "INT")
        self._must("OF")
        bodies: dict[int, Callable[[], None]] = {}
        while not self._takes("END_CASE"):
            number = int(self._next()[1])
            assert number not in bodies
            self._must(":")
            bodies[number] = self._statements(("END_CASE",))
        self._takes(";")
        return lambda: bodies.get(value(), lambda: None)()

    # ---- expressions, from what binds least -----------------------------------------------------

    def _expression(self) -> Value:
        left = self._all()
        while self._takes("OR"):
            left = self._both(left, self._all(), lambda a, b: a or b)
        return left

    def _all(self) -> Value:
        left = self._comparison()
        while self._takes("AND"):
            left = self._both(left, self._comparison(), lambda a, b: a and b)
        return left

    def _both(self, left: Value, right: Value, work: Callable[[Any, Any], Any]) -> Value:
        _same(left[0], BOOL)
        _same(right[0], BOOL)
        return BOOL, lambda: work(left[1](), right[1]())

    def _comparison(self) -> Value:
        left = self._sum()
        if sign := self._takes(*COMPARE):
            right, work = self._sum(), COMPARE[sign]
            kind = _joined(left[0], right[0])
            assert kind not in ("WORD", BOOL), f"{kind} is compared"
            return BOOL, lambda: work(left[1](), right[1]())
        return left

    def _sum(self) -> Value:
        return self._chain(SUM, lambda: self._chain(TERM, self._one))

    def _chain(
        self, works: dict[str, Callable[[int, int], int]], part: Callable[[], Value]
    ) -> Value:
        left = part()
        while sign := self._takes(*works):
            left = _reckoned(works[sign], left, part())
        return left

    def _one(self) -> Value:
        if self._takes("NOT"):
            kind, value = self._one()
            _same(kind, BOOL)
            return BOOL, lambda: not value()
        if self._takes("("):
            inner = self._expression()
            self._must(")")
            return inner
        group, word = self._next()
        if group == "time":
            seconds = int(word[:-2]) * 1e-3 if word.endswith("MS") else float(word[:-1])
            return TIME, lambda: seconds
        if group in ("number", *WIDTHS):
            return LITERAL if group == "number" else group, lambda: int(word)
        if word in ("TRUE", "FALSE"):
            return BOOL, lambda: word == "TRUE"
        if self._takes("("):
            return self._function(word)
        return self._variable(word)

    def _variable(self, name: str) -> Value:
        kind = self.types[name]
        if kind == "TON":
            self._must(".") and self._must("Q")
            return BOOL, lambda: self._values[name].is_over
        if kind.endswith("[]"):
            self._must("[")
            place = int(self._next()[1])
            assert place < len(self._values[name]), f"{name}[{place}]"
            self._must("]")
            return kind[:-2], lambda: self._values[name][place]
        return kind, lambda: self._values[name]

    def _function(self, name: str) -> Value:
        given = [self._expression()]
        while self._takes(","):
            given.append(self._expression())
        self._must(")")
        if name == "SEL":
            (kind, chosen), (low, no), (high, yes) = given
            _same(kind, BOOL)
            return _joined(low, high), lambda: yes() if chosen() else no()
        before, _, after = name.partition("_TO_")
        ((kind, value),) = given
        _same(kind, before)
        if after == STRING:
            return STRING, lambda: str(value())
        if before == STRING:
            return after, lambda: _within(after, _number(value()), name)
        return after, lambda: _within(after, value(), name)


def _tokens(text: str) -> list[tuple[str, str]]:
    found, at = [], 0
    while at < len(text):
        match = TOKEN.match(text, at)
        assert match, f"no word of Structured Text: {text[at : at + 20]!r}"
        at = match.end()
        kind = match.lastgroup
        if kind == "typed":
            found.append((match["type"], match["typed"]))
        elif kind != "skip":
            found.append((str(kind), match[str(kind)]))
    return found


def _joined(one: str, other: str) -> str:
    """The type of two that belong together."""
    kinds = {one, other} - {LITERAL}
    assert len(kinds) <= 1, f"{one} beside {other}"
    return kinds.pop() if kinds else LITERAL


def _number(text: str) -> int:
    """Of a STRING; 0 where it is none, which the standard leaves to the maker."""
    return int(text) if text.isdecimal() else 0


def _same(given: str, wanted: str) -> None:
    fits = given == wanted or (given == LITERAL and wanted in WIDTHS)
    assert fits, f"{given} in place of {wanted}"


def _reckoned(work: Callable[[int, int], int], left: Value, right: Value) -> Value:
    kind = _joined(left[0], right[0])
    assert kind in (LITERAL, "INT", "DINT", "UINT", "UDINT"), f"{kind} is reckoned with"
    return kind, lambda: _within(kind, work(left[1](), right[1]()), "a result")


def _within(kind: str, value: Any, name: str) -> Any:
    low, high = WIDTHS.get(kind, (0, 0))
    assert kind not in WIDTHS or (type(value) is int and low <= value < high), (name, kind, value)
    assert kind != BOOL or type(value) is bool, (name, value)
    assert kind != STRING or len(value) <= 254, name
    return value
