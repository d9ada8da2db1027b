import contextlib
import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from history_workers import SERIAL, proposal

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import (
    ConflictError,
    InputError,
    RobocalError,
    StaleError,
    StorageError,
    WrongRobotError,
)
from robocal_ros.core.proposals import Action, Head, State
from robocal_ros.storage.calibrations import CalibrationHistory
from robocal_ros.storage.history_paths import (
    history_path,
    known_serials,
    made_folder_beside,
    state_folder,
    unused,
)
from robocal_ros.storage.history_schema import MIGRATIONS, SCHEMA_VERSION

BY = {"by": "Ada", "reason": "tested", "wall_ns": 1_700_000_002_000_000_000}


@pytest.fixture
def history(tmp_path: Path) -> Iterator[CalibrationHistory]:
    with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as opened:
        yield opened


def reopened(history: CalibrationHistory, **options: Any) -> CalibrationHistory:
    return CalibrationHistory.open(SERIAL, state_dir=history.path.parent, **options)


def in_process(work: str, *arguments: object, timeout_s: float = 30.0) -> Any:
    """Run a worker in a process group of its own, which never outlives the test."""
    script = Path(__file__).with_name("history_workers.py")
    command = [sys.executable, str(script), work, *(str(a) for a in arguments)]
    root = str(Path(__file__).parents[2])
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=os.environ | {"PYTHONPATH": root},
    ) as process:
        try:
            out, _ = process.communicate(timeout=timeout_s)
        finally:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
    assert process.returncode == 0
    return json.loads(out)


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
        assert (entry.state, entry.revision, entry.decisions) == (State.PENDING, 0, ())

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
        assert (entry.state, entry.revision) == (State.IN_FORCE, 1)
        (decision,) = entry.decisions
        assert (decision.action, decision.by, decision.reason) == (Action.ACCEPT, "Ada", "tested")
        assert (decision.head_before, decision.head_after) == (0, 1)

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
        assert history.get(second).state is State.STALE
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
        assert history.get(second).state is State.REJECTED
        with pytest.raises(ConflictError, match="rejected by Ada"):
            history.accept(second, **BY)
        with pytest.raises(ConflictError, match="rejected by Ada"):
            history.reject(second, **BY)

    @pytest.mark.parametrize("code", [Code.WORSE_THAN_CURRENT, Code.RESIDUAL_TOO_LARGE])
    def test_verdict_is_obeyed(self, history: CalibrationHistory, code: Code) -> None:
        number = history.propose(proposal(code=code, reason="0.4 mm instead of 0.2 mm"))
        assert history.get(number).state is State.REFUSED
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
        assert history.get(ids[2]).state is State.ROLLED_BACK
        assert history.get(ids[2]).decisions[-1].action is Action.ROLLBACK
        assert history.rollback(**BY).calibration_id == ids[0]
        assert history.rollback(**BY) == Head("thermal", 6, None, None)
        with pytest.raises(ConflictError, match="nothing to roll back"):
            history.rollback(**BY)
        assert [e.state for e in history.list()] == [State.ROLLED_BACK] * 3

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
            State.STALE,
            State.ROLLED_BACK,
            State.IN_FORCE,
        ]

    def test_kinds_have_revisions_of_their_own(self, history: CalibrationHistory) -> None:
        thermal = history.propose(proposal())
        tool = history.propose(proposal(kind="tool"))
        history.accept(tool, **BY)
        assert history.get(thermal).state is State.PENDING
        assert history.head("tool").revision == 1
        assert history.head().revision == 0
        with pytest.raises(InputError, match="kind tool, not thermal"):
            history.rollback(tool, **BY)
        history.accept(thermal, **BY)
        assert [(h.kind, h.calibration_id) for h in history.heads()] == [
            ("thermal", thermal),
            ("tool", tool),
        ]


class TestWrongRobot:
    def test_other_nominal_model(self, history: CalibrationHistory) -> None:
        number = history.propose(proposal())
        with reopened(history, model_hash="nominal-b") as other:
            with pytest.raises(WrongRobotError, match="nominal-a"):
                other.propose(proposal())
            with pytest.raises(WrongRobotError, match=f"calibration {number}"):
                other.accept(number, **BY)
            history.accept(number, **BY)
            with pytest.raises(WrongRobotError, match="in force"):
                other.head()
            assert other.rollback(**BY).revision == 2  # the way out
            assert other.head().model is None
            with pytest.raises(WrongRobotError, match="nominal-a"):
                other.rollback(number, **BY)

    def test_other_nominal_model_than_the_one_in_force(self, history: CalibrationHistory) -> None:
        history.accept(history.propose(proposal()), **BY)
        other = history.propose(proposal(based_on=1, model_hash="nominal-b"))
        with pytest.raises(WrongRobotError, match="roll back to nominal first"):
            history.accept(other, **BY)
        assert history.head().revision == 1

    def test_file_of_another_robot(self, history: CalibrationHistory) -> None:
        history.propose(proposal())
        history.close()
        other = history_path("KR-8", history.path.parent)
        other.write_bytes(history.path.read_bytes())
        with pytest.raises(WrongRobotError, match="'KR-7', not 'KR-8'"):
            CalibrationHistory.open("KR-8", state_dir=other.parent)


class TestPlace:
    @pytest.mark.parametrize(
        "serial", ["../../etc/passwd", "a/b", "..", ".", "x" * 200, "Ä 1", "a\0b", "%2F", "a?b#c"]
    )
    def test_any_serial_stays_in_the_folder(self, tmp_path: Path, serial: str) -> None:
        with CalibrationHistory.open(serial, state_dir=tmp_path / "state") as history:
            number = history.propose(proposal())
        with CalibrationHistory.open(serial, state_dir=tmp_path / "state") as history:
            assert history.get(number).id == number
        assert [path.name for path in tmp_path.iterdir()] == ["state"]
        assert history.path.parent == tmp_path / "state"
        assert known_serials(tmp_path / "state") == [serial]

    @pytest.mark.parametrize("serial", ["", "  ", "x" * 201, "Ä" * 40])
    def test_bad_serial(self, tmp_path: Path, serial: str) -> None:
        with pytest.raises(InputError, match="robot serial"):
            CalibrationHistory.open(serial, state_dir=tmp_path)

    def test_state_folder(self, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
        monkeypatch.delenv("ROBOCAL_STATE", raising=False)
        monkeypatch.setenv("HOME", str(tmp_path))
        monkeypatch.setenv("XDG_STATE_HOME", "not/absolute")
        assert state_folder() == tmp_path / ".local" / "state" / "robocal"
        monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path / "xdg"))
        assert state_folder() == tmp_path / "xdg" / "robocal"
        monkeypatch.setenv("ROBOCAL_STATE", str(tmp_path / "mine"))
        with CalibrationHistory.open(SERIAL) as history:
            assert history.path == tmp_path / "mine" / "KR-7.sqlite"

    def test_create_false(self, tmp_path: Path) -> None:
        with pytest.raises(InputError, match="has no calibration history"):
            CalibrationHistory.open(SERIAL, state_dir=tmp_path, create=False)
        assert list(tmp_path.iterdir()) == []


class TestManyProcesses:
    def test_killed_while_the_file_was_made(self, tmp_path: Path) -> None:
        """A hot rollback journal, as a kill before the switch to write-ahead logging leaves it."""
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            path = history.path
        path.unlink()
        code = (
            "import os, signal, sqlite3, sys\n"
            "c = sqlite3.connect(sys.argv[1], isolation_level=None)\n"
            "c.execute('PRAGMA cache_size=2')\n"
            "c.execute('BEGIN')\n"
            "c.execute('CREATE TABLE t (x)')\n"
            "c.executemany('INSERT INTO t VALUES (?)', [(b'x' * 4000,)] * 200)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        subprocess.run([sys.executable, "-c", code, path], check=False)
        assert Path(f"{path}-journal").exists()
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.head().revision == 0
            assert history.damaged is None

    def test_killed_at_any_moment(self, tmp_path: Path) -> None:
        rounds = 100
        seen = in_process("kill_while_accepting", tmp_path, rounds, 1)
        before = 0
        for killed, told, found in seen:
            assert killed
            old = before if told < 0 else told
            assert found in (old, old + 1)
            before = found
        assert len(seen) == rounds
        assert before >= rounds  # they were at work when they were killed
        with contextlib.closing(sqlite3.connect(tmp_path / "KR-7.sqlite")) as raw:
            assert raw.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
            assert raw.execute("PRAGMA foreign_key_check").fetchall() == []
            log = raw.execute("SELECT head_before, head_after, calibration_id FROM decisions")
            assert [row[:2] for row in log] == [(n, n + 1) for n in range(before)]
            orphans = raw.execute(
                "SELECT count(*) FROM calibrations WHERE 3 <> "
                "(SELECT count(*) FROM payloads WHERE calibration_id = id)"
            )
            assert orphans.fetchone() == (0,)
        assert {path.name for path in tmp_path.iterdir()} == {"KR-7.sqlite", "KR-7.sqlite.lock"}

    def test_two_accepts_at_once_leave_one_winner(self, tmp_path: Path) -> None:
        outcomes = in_process("race", tmp_path, 200)
        assert len(outcomes) == 200
        assert all(sorted(outcome) == ["CONFLICT", "done"] for outcome in outcomes)

    def test_many_open_a_new_history_at_once(self, tmp_path: Path) -> None:
        assert in_process("open_at_once", tmp_path, 10, 6) == [0] * 10
        for number in range(10):
            with CalibrationHistory.open(f"new {number}", state_dir=tmp_path) as history:
                assert len(history.list()) == 6
                assert history.damaged is None

    def test_data_version_tells_of_changes_by_anyone(self, history: CalibrationHistory) -> None:
        before = history.data_version()
        assert history.data_version() == before
        number = history.propose(proposal())
        own = history.data_version()
        assert own != before
        with reopened(history) as reader:
            seen = reader.data_version()
            subprocess.run(
                [sys.executable, "-c", _ACCEPT, str(history.path.parent), str(number)],
                check=True,
                timeout=20,
                env=os.environ | {"PYTHONPATH": str(Path(__file__).parents[2])},
            )
            assert reader.data_version() != seen  # at once, so at the next poll
            assert history.data_version() != own
            assert reader.head().calibration_id == history.head().calibration_id == number

    def test_busy_beyond_the_time_out(self, history: CalibrationHistory) -> None:
        with (
            contextlib.closing(sqlite3.connect(history.path, isolation_level=None)) as raw,
            reopened(history, busy_timeout_s=0.05) as other,
        ):
            raw.execute("BEGIN IMMEDIATE")
            with pytest.raises(StorageError, match="another process holds it"):
                other.propose(proposal())
            assert other.list() == ()  # reading goes on
            raw.execute("ROLLBACK")
            assert other.propose(proposal()) == 1


_ACCEPT = """
import sys
from pathlib import Path
from robocal_ros.storage.calibrations import CalibrationHistory
with CalibrationHistory.open("KR-7", state_dir=Path(sys.argv[1])) as history:
    history.accept(int(sys.argv[2]), by="other", reason="", wall_ns=1)
"""


class TestTrouble:
    def test_disk_full_changes_nothing(self, history: CalibrationHistory) -> None:
        number = history.propose(proposal())
        connection = history._file.connection
        used = connection.execute("PRAGMA page_count").fetchone()[0]
        connection.execute(f"PRAGMA max_page_count={used + 2}")
        big = {"q": np.random.default_rng(0).random(10_000)}
        with pytest.raises(StorageError, match="disk is full; nothing was changed"):
            history.propose(proposal(inputs=big))
        assert [entry.id for entry in history.list()] == [number]
        history.accept(number, **BY)  # a small change still fits
        connection.execute(f"PRAGMA max_page_count={used + 1000}")
        assert history.propose(proposal(inputs=big, based_on=1)) > number
        with reopened(history) as other:
            assert other.head().calibration_id == number

    def test_system_refuses_to_write(self, tmp_path: Path) -> None:
        said = in_process("write_beyond_limit", tmp_path, 300_000)
        assert 0 < len(said) < 100
        assert all("STORAGE_FAILED" in line and "check the disk" in line for line in said)
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is None
            entries = history.list(1000)
            assert len(entries) == 100 - len(said)
            for entry in entries:
                assert history.inputs(entry.id)["q"].shape == (2_000,)

    def test_folder_is_a_file(self, tmp_path: Path) -> None:
        place = tmp_path / "file"
        place.write_text("")
        for folder in (place, place / "below"):
            with pytest.raises(StorageError, match="file"):
                CalibrationHistory.open(SERIAL, state_dir=folder)

    def test_history_is_a_folder(self, tmp_path: Path) -> None:
        (tmp_path / "KR-7.sqlite").mkdir()
        with pytest.raises(StorageError, match="KR-7"):
            CalibrationHistory.open(SERIAL, state_dir=tmp_path)
        assert (tmp_path / "KR-7.sqlite").is_dir()

    @pytest.mark.parametrize("verb", ["delete", "replace"])
    def test_file_taken_away_while_open(self, history: CalibrationHistory, verb: str) -> None:
        history.propose(proposal())
        history.path.unlink()
        if verb == "replace":
            history.path.write_bytes(b"")
        for call in (history.data_version, lambda: history.propose(proposal())):
            with pytest.raises(StorageError, match="deleted or replaced"):
                call()


def filled(folder: Path) -> Path:
    with CalibrationHistory.open(SERIAL, state_dir=folder) as history:
        for revision in range(5):
            history.accept(history.propose(proposal(based_on=revision)), **BY)
    return history.path


class TestDamage:
    @pytest.mark.parametrize(
        ("start", "junk"), [(0, b"not a database, not at all"), (4096, b"\xff" * 4096)]
    )
    def test_set_aside_and_reported(
        self, tmp_path: Path, caplog: pytest.LogCaptureFixture, start: int, junk: bytes
    ) -> None:
        path = filled(tmp_path)
        with path.open("r+b") as file:
            file.seek(start)
            file.write(junk)
        kept = path.read_bytes()
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None
            assert history.created
            assert history.damaged.name.startswith("KR-7.sqlite.damaged-2")
            assert history.damaged.read_bytes() == kept
            assert history.head().revision == 0
            assert history.propose(proposal()) == 1
        assert "was damaged: it is kept as KR-7.sqlite.damaged-" in caplog.text
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is None
            assert len(history.list()) == 1
        assert known_serials(tmp_path) == [SERIAL]

    def test_cut_short(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        os.truncate(path, path.stat().st_size // 2)
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None

    def test_every_damage_in_one_second_is_kept(self, tmp_path: Path) -> None:
        for _ in range(3):
            history_path(SERIAL, tmp_path).write_bytes(b"junk" * 100)
            with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
                assert history.damaged is not None
        assert len(list(tmp_path.glob("*damaged*"))) == 3

    def test_one_flipped_bit_in_the_model_in_force(self, tmp_path: Path) -> None:
        # SQLite itself sees nothing wrong: only the digest tells.
        path = filled(tmp_path)
        self.flip(path, 5)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            assert raw.execute("PRAGMA integrity_check").fetchall() == [("ok",)]
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None
            assert history.head().model is None

    def test_one_flipped_bit_in_an_old_model(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        self.flip(path, 2)
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is None
            assert history.head().revision == 5
            with pytest.raises(StorageError, match="model of calibration 2 is damaged"):
                history.rollback(2, **BY)
            assert history.rollback(1, **BY).revision == 6

    @staticmethod
    def flip(path: Path, number: int) -> None:
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("DROP TRIGGER payloads_update")
            raw.execute(
                "UPDATE payloads SET data = CAST(replace(data, '0.1', '0.3') AS BLOB) "
                "WHERE calibration_id = ? AND name = 'model'",
                (number,),
            )
            raw.commit()

    def test_contradicting_log(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("DROP TRIGGER decisions_delete")
            raw.execute("DELETE FROM decisions WHERE seq = 3")
            raw.commit()
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None

    def test_lost_tables(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("DROP TABLE decisions")
            raw.commit()
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None

    def test_log_without_its_file(self, tmp_path: Path) -> None:
        # As left by a kill between the two renames of setting aside.
        path = history_path(SERIAL, tmp_path)
        Path(f"{path}-wal").write_bytes(b"anything")
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.damaged is not None
            assert Path(f"{history.damaged}-wal").read_bytes() == b"anything"
            assert history.propose(proposal()) == 1

    def test_not_set_aside_under_the_feet_of_another_process(
        self, history: CalibrationHistory
    ) -> None:
        history.propose(proposal())
        with history.path.open("r+b") as file:
            file.write(b"junk" * 2000)
        before = set(history.path.parent.iterdir())
        with pytest.raises(StorageError, match="stop the nodes"):
            reopened(history, busy_timeout_s=0.1)
        assert set(history.path.parent.iterdir()) == before
        history.close()
        with reopened(history) as other:
            assert other.damaged is not None


class TestFolderBeside:
    def test_it_belongs_to_the_serial_and_hides_no_history(self, tmp_path: Path) -> None:
        file = history_path("K.7/a", tmp_path)
        folder = made_folder_beside(file, "hand_eye")
        assert folder == made_folder_beside(file, "hand_eye") == tmp_path / "K.7%2Fa" / "hand_eye"
        assert folder.is_dir()
        assert known_serials(tmp_path) == []

    def test_no_file_is_named_twice(self, tmp_path: Path) -> None:
        for name in ("1.mcap", "1_2.mcap", "1_3.mcap"):
            path = unused(tmp_path, "1", ".mcap")
            assert path.name == name
            path.touch()

    def test_a_folder_that_cannot_be_made(self, tmp_path: Path) -> None:
        (tmp_path / "K7").touch()
        with pytest.raises(StorageError, match="cannot be made"):
            made_folder_beside(history_path("K7", tmp_path), "hand_eye")


class TestVersions:
    def test_an_empty_database_is_brought_up(self, tmp_path: Path) -> None:
        path = history_path(SERIAL, tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("PRAGMA journal_mode=WAL")
            assert raw.execute("PRAGMA user_version").fetchone() == (0,)
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.created
            assert history.propose(proposal()) == 1
        with contextlib.closing(sqlite3.connect(path)) as raw:
            assert raw.execute("PRAGMA user_version").fetchone() == (SCHEMA_VERSION,)

    def test_a_failing_script_leaves_the_old_version(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        import robocal_ros.storage.history_file as module

        path = filled(tmp_path)
        kept = path.read_bytes()
        more = (*MIGRATIONS, ("CREATE TABLE extra (x)", "CREATE TABLE extra (x)"))
        monkeypatch.setattr(module, "MIGRATIONS", more)
        monkeypatch.setattr(module, "SCHEMA_VERSION", len(more))
        with pytest.raises(StorageError, match="extra"):
            module.open_file(path, SERIAL, timeout_s=1.0, verify=lambda _: None)
        assert path.read_bytes() == kept

    def test_newer_version_is_not_touched(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute(f"PRAGMA user_version={SCHEMA_VERSION + 1}")
        self.assert_untouched(path, "made by a newer robocal")

    def test_foreign_database_is_not_touched(self, tmp_path: Path) -> None:
        path = history_path(SERIAL, tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("CREATE TABLE addresses (name)")
            raw.commit()
        self.assert_untouched(path, "not a calibration history")

    @staticmethod
    def assert_untouched(path: Path, said: str) -> None:
        kept, state = path.read_bytes(), path.stat()
        with pytest.raises(StorageError, match=said):
            CalibrationHistory.open(SERIAL, state_dir=path.parent)
        assert path.read_bytes() == kept
        assert path.stat().st_mtime_ns == state.st_mtime_ns


class TestSpeed:
    def test_opens_at_once_after_years(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        with contextlib.closing(sqlite3.connect(path)) as raw:
            raw.execute("PRAGMA synchronous=OFF")
            columns = "kind, model_hash, based_on, cycle_id, stamp_ns, created_ns, software, method"
            raw.executemany(
                f"INSERT INTO calibrations ({columns}, code, reason) "
                "SELECT kind, model_hash, ?, cycle_id, stamp_ns, created_ns, software, method, "
                "code, reason FROM calibrations WHERE id = 1",
                [(n,) for n in range(5, 1005)],
            )
            blob = os.urandom(40_000)
            raw.executemany(
                "INSERT INTO payloads VALUES (?, ?, ?, ?)",
                [(n, "document", blob, b"") for n in range(6, 1006)],
            )
            raw.executemany(
                "INSERT INTO decisions VALUES (NULL, 'thermal', 'reject', ?, '', '', 0, 5, 5)",
                [(n,) for n in range(6, 1006)],
            )
            raw.commit()
        assert path.stat().st_size > 40_000_000
        with CalibrationHistory.open(SERIAL, state_dir=tmp_path) as history:
            assert history.head().revision == 5
