# SPDX-License-Identifier: Apache-2.0
"""Proposals and decisions: what is in force, and since when."""

import contextlib
import sqlite3
import time

import numpy as np
import pytest
from histories import BY, reopened
from history_workers import proposal

from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError, StaleError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Action, CalibrationState, Head, Past
from robocal_ros.session.events import ACCEPT, ONLY, Command, named


class TestProposals:
    def test_come_back_bit_for_bit(self, history: CalibrationHistory) -> None:
        document = {"a": 0.1 + 0.2, "names": ["d1_mm", "θ"], "none": None}
        model = {"d": [1 / 3, 5e-324, -0.0]}
        inputs = {"q": np.random.default_rng(0).normal(size=(5, 6)), "id": np.array(["x", "y"])}
        given = proposal(document=document, model=model, inputs=inputs)
        number = history.propose(given)
        with reopened(history) as other:
            entry = other.get(number)
            assert other.document(number) == document
            assert [x.hex() for x in other.model(number)["d"]] == [x.hex() for x in model["d"]]
            found = other.inputs(number)
        assert found.keys() == inputs.keys()
        assert all(found[k].tobytes() == inputs[k].tobytes() for k in inputs)
        assert (entry.kind, entry.model_hash, entry.cycle_id) == ("thermal", "nominal-a", "morning")
        assert (entry.stamp_ns, entry.created_ns) == (given.stamp_ns, given.created_ns)
        assert (entry.code, entry.reason) == (Code.ACCEPT, given.reason)
        assert (entry.software, entry.method, entry.candidate_rms_mm) == ("0.1.0", "map", 0.11)
        assert (entry.state, entry.revision, entry.decisions) == (CalibrationState.PENDING, 0, ())

    def test_equal_contents_are_stored_as_equal_bytes(self, history: CalibrationHistory) -> None:
        first = history.propose(proposal())
        time.sleep(0.01)
        second = history.propose(proposal(created_ns=5))
        with contextlib.closing(sqlite3.connect(history.path)) as raw:
            rows = [
                raw.execute("SELECT name, data FROM payloads WHERE calibration_id=?", (n,))
                for n in (first, second)
            ]
            assert rows[0].fetchall() == rows[1].fetchall()

    @pytest.mark.parametrize("bad", [float("nan"), float("inf")])
    @pytest.mark.parametrize("where", ["document", "model"])
    def test_refuse_numbers_that_are_not_finite(
        self, history: CalibrationHistory, where: str, bad: float
    ) -> None:
        with pytest.raises(ValueError, match=where):
            history.propose(proposal(**{where: {"x": [1.0, bad]}}))
        assert history.list() == ()

    def test_refuse_objects_as_inputs(self, history: CalibrationHistory) -> None:
        with pytest.raises(ValueError, match="'q'"):
            history.propose(proposal(inputs={"q": np.array([None])}))

    def test_refuse_a_revision_that_never_was(self, history: CalibrationHistory) -> None:
        with pytest.raises(StaleError, match="revision 3"):
            history.propose(proposal(based_on=3))

    def test_nothing_can_be_changed_or_deleted(self, history: CalibrationHistory) -> None:
        number = history.propose(proposal())
        history.accept(number, **BY)
        with contextlib.closing(sqlite3.connect(history.path)) as raw:
            for table in ("calibrations", "payloads", "decisions"):
                with pytest.raises(sqlite3.IntegrityError, match="never changed"):
                    raw.execute(f"DELETE FROM {table}")
            with pytest.raises(sqlite3.IntegrityError, match="never changed"):
                raw.execute("UPDATE calibrations SET code = 2")
            with pytest.raises(sqlite3.IntegrityError, match="never changed"):
                raw.execute("UPDATE decisions SET by = 'Bob'")


class TestDecisions:
    def test_new_robot_is_nominal(self, history: CalibrationHistory) -> None:
        assert history.created
        assert history.head() == Head("thermal", 0, None, None)
        assert history.heads() == ()

    def test_accept_survives_reopening(self, history: CalibrationHistory) -> None:
        number = history.propose(proposal())
        head = history.accept(number, **BY)
        assert head == Head("thermal", 1, number, {"d": [0.1, 0.2, 1 / 3]})
        with reopened(history) as other:
            assert not other.created
            assert other.head() == head
            entry = other.get(number)
        assert (entry.state, entry.revision) == (CalibrationState.IN_FORCE, 1)
        (decision,) = entry.decisions
        assert (decision.action, decision.by, decision.reason) == (Action.ACCEPT, "Ada", "tested")
        assert (decision.head_before, decision.head_after) == (0, 1)

    def test_the_newest_decisions_are_read_alone(self, history: CalibrationHistory) -> None:
        for revision in range(4):
            history.accept(history.propose(proposal(based_on=revision)), **BY)
        made = history.decisions()
        assert [d.seq for d in made] == [1, 2, 3, 4]
        assert history.decisions(newest=2) == made[2:]
        assert history.decisions(3, newest=2) == made[3:]

    def test_the_newest_is_found_as_soon_however_many_were_refused(
        self, history: CalibrationHistory
    ) -> None:
        def steps() -> int:
            """Of SQLite's machine."""
            count = 0

            def step() -> None:
                nonlocal count
                count += 1

            history._file.connection.set_progress_handler(step, 1)
            assert [entry.id for entry in history.pending(limit=1)] == [newest]
            history._file.connection.set_progress_handler(None, 0)
            return count

        for _ in range(3):
            newest = history.propose(proposal())
            history.propose(proposal(code=Code.WORSE_THAN_CURRENT))
        few = steps()
        with contextlib.closing(sqlite3.connect(history.path)) as raw, raw:
            raw.executemany(
                "INSERT INTO calibrations SELECT NULL, kind, model_hash, based_on, cycle_id, "
                "stamp_ns, created_ns, software, method, code, reason, candidate_rms_mm "
                "FROM calibrations WHERE id = ?",
                [(newest + 1,)] * 10_000,
            )
        assert steps() == few

    def test_second_candidate_goes_stale(self, history: CalibrationHistory) -> None:
        first, second = history.propose(proposal()), history.propose(proposal())
        assert [e.id for e in history.pending()] == [second, first]
        history.accept(first, **BY)
        assert history.pending() == ()
        assert history.get(second).state is CalibrationState.STALE
        with pytest.raises(StaleError, match="revision 0, but 1"):
            history.accept(second, **BY)
        with pytest.raises(ConflictError, match="revision 1 is in force, not 0"):
            history.accept(second, expected_head=0, **BY)
        assert history.head().calibration_id == first

    def test_each_calibration_is_decided_once(self, history: CalibrationHistory) -> None:
        first, second = history.propose(proposal()), history.propose(proposal())
        history.accept(first, **BY)
        with pytest.raises(ConflictError, match="accepted already, as revision 1"):
            history.accept(first, **BY)
        with pytest.raises(ConflictError, match="accepted already"):
            history.reject(first, **BY)
        history.reject(second, **BY)
        assert history.get(second).state is CalibrationState.REJECTED
        with pytest.raises(ConflictError, match="rejected by Ada"):
            history.accept(second, **BY)
        with pytest.raises(ConflictError, match="rejected by Ada"):
            history.reject(second, **BY)

    @pytest.mark.parametrize("code", [Code.WORSE_THAN_CURRENT, Code.RESIDUAL_TOO_LARGE])
    def test_verdict_is_obeyed(self, history: CalibrationHistory, code: Code) -> None:
        number = history.propose(proposal(code=code, reason="0.4 mm instead of 0.2 mm"))
        assert history.get(number).state is CalibrationState.REFUSED
        with pytest.raises(RobocalError, match=r"0\.4 mm instead") as caught:
            history.accept(number, **BY)
        assert caught.value.code is code
        assert history.head().revision == 0

    @pytest.mark.parametrize("number", [0, -1, 7, 2**63, 2**70])
    def test_unknown_id(self, history: CalibrationHistory, number: int) -> None:
        for call in (history.get, history.document, history.model, history.inputs):
            with pytest.raises(InputError, match=f"no calibration has the id {number}"):
                call(number)
        for change in (history.accept, history.reject):
            with pytest.raises(InputError, match="no calibration"):
                change(number, **BY)

    def test_rollbacks_walk_back_to_nominal(self, history: CalibrationHistory) -> None:
        ids = []
        for revision in range(3):
            ids.append(history.propose(proposal(based_on=revision, model={"r": revision})))
            history.accept(ids[-1], **BY)
        assert history.rollback(**BY) == Head("thermal", 4, ids[1], {"r": 1})
        assert history.get(ids[2]).state is CalibrationState.ROLLED_BACK
        assert history.get(ids[2]).decisions[-1].action is Action.ROLLBACK
        assert history.rollback(**BY).calibration_id == ids[0]
        assert history.rollback(**BY) == Head("thermal", 6, None, None)
        with pytest.raises(ConflictError, match="nothing to roll back"):
            history.rollback(**BY)
        assert [e.state for e in history.list()] == [CalibrationState.ROLLED_BACK] * 3

    def test_rollback_to_a_chosen_one(self, history: CalibrationHistory) -> None:
        first = history.propose(proposal())
        history.accept(first, **BY)
        second = history.propose(proposal(based_on=1))
        waiting = history.propose(proposal(based_on=1))
        history.accept(second, **BY)
        for to, said in ((second, "in force already"), (waiting, "never accepted")):
            with pytest.raises(ConflictError, match=said):
                history.rollback(to, **BY)
        with pytest.raises(InputError, match="no calibration"):
            history.rollback(99, **BY)
        with pytest.raises(ConflictError, match="not 1"):
            history.rollback(first, expected_head=1, **BY)
        assert history.rollback(0, **BY).model is None
        with pytest.raises(ConflictError, match="nominal model is in force already"):
            history.rollback(0, **BY)
        assert history.rollback(first, expected_head=3, **BY).revision == 4
        assert [e.state for e in history.list()] == [
            CalibrationState.STALE,
            CalibrationState.ROLLED_BACK,
            CalibrationState.IN_FORCE,
        ]

    def test_the_newest_that_was_in_force_once(self, history: CalibrationHistory) -> None:
        """Neither the one that is, nor what never was."""
        past = []
        for revision, stamp_ns in enumerate((30, 40, 20)):
            number = history.propose(proposal(based_on=revision, stamp_ns=stamp_ns))
            history.accept(number, **BY)
            past.append(history.past("thermal").newest_ns)
        history.propose(proposal(based_on=3, stamp_ns=50))
        assert past == [0, 30, 40]
        for _ in range(2):
            history.rollback(**BY)
            past.append(history.past("thermal").newest_ns)
        assert past[3:] == [30, 40]
        assert history.past("thermal").revision == 5
        assert history.past("tool") == Past()

    def test_what_needs_another_kind_beside_it(self, history: CalibrationHistory) -> None:
        thermal = history.propose(proposal())
        tool = history.propose(proposal(kind="tool"))
        history.accept(thermal, **BY)
        words = f"tool {tool} was measured with thermal revision 0, in force is 1: measure it again"
        with pytest.raises(StaleError, match=words):
            history.accept(tool, with_heads={"thermal": 0}, **BY)
        assert history.get(tool).state is CalibrationState.PENDING
        assert history.accept(tool, with_heads={"thermal": 1}, **BY).revision == 1

    def test_what_was_measured_with_another_revision_does_not_wait(
        self, history: CalibrationHistory
    ) -> None:
        """Of another kind, as a tool of a thermal model: it blocks no acceptance without an id."""
        old = history.propose(proposal(kind="tool", model={"thermal_revision": 0}))
        assert history.get(old).state is CalibrationState.PENDING
        history.accept(history.propose(proposal()), **BY)
        only = Command(ACCEPT, {"choose": ONLY})
        assert named(history, only, "tool").arguments == {"id": old}  # is refused with its reason
        new = history.propose(proposal(kind="tool", model={"thermal_revision": 1}))
        with reopened(history) as other:
            for each in (history, other):
                assert [each.get(n).state.value for n in (old, new)] == ["stale", "pending"]
                assert [entry.id for entry in each.pending("tool")] == [new]
                assert each.list()[-1].state is CalibrationState.STALE
        assert named(history, only, "tool").arguments == {"id": new}

    def test_kinds_have_revisions_of_their_own(self, history: CalibrationHistory) -> None:
        thermal = history.propose(proposal())
        tool = history.propose(proposal(kind="tool"))
        history.accept(tool, **BY)
        assert history.get(thermal).state is CalibrationState.PENDING
        assert history.head("tool").revision == 1
        assert history.head().revision == 0
        with pytest.raises(InputError, match="kind tool, not thermal"):
            history.rollback(tool, **BY)
        history.accept(thermal, **BY)
        assert [(h.kind, h.calibration_id) for h in history.heads()] == [
            ("thermal", thermal),
            ("tool", tool),
        ]
