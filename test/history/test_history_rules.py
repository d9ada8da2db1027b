# SPDX-License-Identifier: Apache-2.0
"""Random decisions against a reference of the rules that keeps the whole story in a list."""

import tempfile
from pathlib import Path
from typing import Any

from history_workers import SERIAL, proposal
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule
from long_form import amount

from robocal_ros.ground.errors import Code, RobocalError
from robocal_ros.history.calibrations import CalibrationHistory

KINDS = ("thermal", "tool")
WAYS = st.integers(0, 1)
KIND = st.sampled_from(["thermal", "thermal", "thermal", "tool"])
BACK = st.integers(-1, 6)  # from the newest id; -1 is unknown
BELIEFS = st.sampled_from([None, None, 0, 0, -1, 1])  # off the revision in force; None: no belief


class Reference:
    """The rules, said another way: ``story[kind][revision]`` is (action, what came into force)."""

    def __init__(self) -> None:
        self.given: dict[int, tuple[str, Code, int]] = {}
        self.rejected: set[int] = set()
        self.story: dict[str, list[tuple[str, int | None]]] = {k: [("", None)] for k in KINDS}

    def head(self, kind: str) -> tuple[int, int | None]:
        return len(self.story[kind]) - 1, self.story[kind][-1][1]

    def accepted(self, number: int) -> bool:
        return any(("accept", number) in story for story in self.story.values())

    def accept(self, number: int, expected: int | None) -> str:
        if number not in self.given:
            return "BAD_INPUT"
        kind, code, based_on = self.given[number]
        revision, _ = self.head(kind)
        if self.accepted(number) or number in self.rejected:
            return "CONFLICT"
        if code is not Code.ACCEPT:
            return code.name
        if expected not in (None, revision):
            return "CONFLICT"
        if based_on != revision:
            return "STALE"
        self.story[kind].append(("accept", number))
        return "done"

    def reject(self, number: int) -> str:
        if number not in self.given:
            return "BAD_INPUT"
        if self.accepted(number) or number in self.rejected:
            return "CONFLICT"
        self.rejected.add(number)
        return "done"

    def rollback(self, to: int | None, kind: str, expected: int | None) -> str:
        revision, now = self.head(kind)
        if expected not in (None, revision):
            return "CONFLICT"
        if to and (to not in self.given or self.given[to][0] != kind):
            return "BAD_INPUT"
        if to is None and now is not None:
            target = self.story[kind][self.story[kind].index(("accept", now)) - 1][1]
        else:
            target = to or None
        if target == now or not (target is None or self.accepted(target)):
            return "CONFLICT"
        self.story[kind].append(("rollback", target))
        return "done"

    def state(self, number: int) -> str:
        kind, code, based_on = self.given[number]
        story = self.story[kind]
        if story[-1][1] == number:
            return "in_force"
        if self.accepted(number):
            last = max(i for i, (_, target) in enumerate(story) if target == number)
            return {"accept": "superseded", "rollback": "rolled_back"}[story[last + 1][0]]
        if number in self.rejected:
            return "rejected"
        if code is not Code.ACCEPT:
            return "refused"
        return "pending" if based_on == len(story) - 1 else "stale"


class History(RuleBasedStateMachine):
    """Two open handles of one file, used in turn, must both follow the reference."""

    @initialize()
    def begin(self) -> None:
        self.folder = tempfile.TemporaryDirectory()
        self.reference = Reference()
        self.handles = [self.opened(), self.opened()]

    def opened(self) -> CalibrationHistory:
        return CalibrationHistory.open(SERIAL, state_dir=Path(self.folder.name))

    def outcome(self, way: int, call: str, *arguments: Any, **options: Any) -> str:
        try:
            getattr(self.handles[way], call)(*arguments, by="x", reason="y", wall_ns=1, **options)
        except RobocalError as error:
            return error.code.name
        return "done"

    @rule(
        way=WAYS,
        kind=KIND,
        code=st.sampled_from([Code.ACCEPT, Code.ACCEPT, Code.NO_SIGNIFICANT_GAIN]),
        behind=st.integers(0, 1),
    )
    def propose(self, way: int, kind: str, code: Code, behind: int) -> None:
        revision, _ = self.reference.head(kind)
        based_on = max(0, revision - behind)
        given = proposal(kind=kind, code=code, based_on=based_on, model={"at": revision})
        number = self.handles[way].propose(given)
        assert number == len(self.reference.given) + 1
        self.reference.given[number] = (kind, code, based_on)

    def believed(self, kind: str, off: int | None) -> int | None:
        return None if off is None else self.reference.head(kind)[0] + off

    @rule(way=WAYS, back=BACK, off=BELIEFS)
    def accept(self, way: int, back: int, off: int | None) -> None:
        number = len(self.reference.given) - back
        kind = self.reference.given.get(number, KINDS)[0]
        expected = self.believed(kind, off)
        found = self.outcome(way, "accept", number, expected_head=expected)
        assert found == self.reference.accept(number, expected)

    @rule(way=WAYS, back=BACK)
    def reject(self, way: int, back: int) -> None:
        number = len(self.reference.given) - back
        assert self.outcome(way, "reject", number) == self.reference.reject(number)

    @rule(way=WAYS, back=st.none() | BACK, kind=KIND, off=BELIEFS)
    def rollback(self, way: int, back: int | None, kind: str, off: int | None) -> None:
        to = None if back is None else max(0, len(self.reference.given) - back)
        expected = self.believed(kind, off)
        found = self.outcome(way, "rollback", to, kind=kind, expected_head=expected)
        assert found == self.reference.rollback(to, kind, expected)

    @rule(way=WAYS, kind=KIND)
    def propose_and_accept(self, way: int, kind: str) -> None:
        self.propose(way, kind, Code.ACCEPT, 0)
        self.accept(way, 0, None)

    @rule(way=WAYS, kind=KIND)
    def roll_back_once_more(self, way: int, kind: str) -> None:
        self.rollback(way, None, kind, None)

    @rule(way=WAYS)
    def reopen(self, way: int) -> None:
        self.handles[way].close()
        self.handles[way] = self.opened()
        assert self.handles[way].damaged is None

    @invariant()
    def both_tell_the_same_as_the_reference(self) -> None:
        expected = {n: self.reference.state(n) for n in self.reference.given}
        for handle in self.handles:
            for kind in KINDS:
                head = handle.head(kind)
                assert (head.revision, head.calibration_id) == self.reference.head(kind)
                pending = {e.id for e in handle.pending(kind)}
                assert pending == {
                    n
                    for n, state in expected.items()
                    if state == "pending" and self.reference.given[n][0] == kind
                }
            assert {e.id: str(e.state) for e in handle.list(1000)} == expected

    def teardown(self) -> None:
        for handle in self.handles:
            handle.close()
        self.folder.cleanup()


TestHistory = History.TestCase
TestHistory.settings = settings(
    max_examples=amount(25, 60),
    stateful_step_count=50,
    deadline=None,
    derandomize=True,
    database=None,
)
