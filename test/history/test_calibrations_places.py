# SPDX-License-Identifier: Apache-2.0
"""A history belongs to one robot and lies in one place; many processes share it."""

import contextlib
import fcntl
import os
import sqlite3
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from forked import HANGS_S
from histories import BY, in_process, reopened
from history_workers import SERIAL, proposal
from long_form import amount

from robocal_ros.ground.errors import InputError, StorageError, WrongRobotError
from robocal_ros.history import history_file
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import history_path, known_serials, state_folder


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
        rounds = amount(40, 100)
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
        rounds = amount(60, 200)
        outcomes = in_process("race", tmp_path, rounds)
        assert len(outcomes) == rounds
        assert all(sorted(outcome) == ["CONFLICT", "done"] for outcome in outcomes)

    def test_many_open_a_new_history_at_once(self, tmp_path: Path) -> None:
        assert in_process("open_at_once", tmp_path, 10, 6) == [0] * 10
        for number in range(10):
            with CalibrationHistory.open(f"new {number}", state_dir=tmp_path) as history:
                assert len(history.list()) == 6
                assert history.damaged is None

    def test_who_opens_waits_for_who_makes_it(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Longer than for a change: a new file takes a slow disk seconds."""
        CalibrationHistory.open("slow", state_dir=tmp_path).close()
        lock = os.open(tmp_path / "slow.sqlite.lock", os.O_RDWR)
        fcntl.flock(lock, fcntl.LOCK_EX)
        threading.Timer(0.5, os.close, [lock]).start()  # which lets go of it
        with CalibrationHistory.open("slow", state_dir=tmp_path, busy_timeout_s=0.05) as history:
            assert history.damaged is None
            lock = os.open(tmp_path / "never.sqlite.lock", os.O_RDWR | os.O_CREAT)
            fcntl.flock(lock, fcntl.LOCK_EX)
            monkeypatch.setattr(history_file, "MAKING_S", 0.05)
            with pytest.raises(StorageError, match=r"making it, or setting it aside, for 0\.05 s"):
                CalibrationHistory.open("never", state_dir=tmp_path)
            os.close(lock)

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
                timeout=HANGS_S,
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
from robocal_ros.history.calibrations import CalibrationHistory
with CalibrationHistory.open("KR-7", state_dir=Path(sys.argv[1])) as history:
    history.accept(int(sys.argv[2]), by="other", reason="", wall_ns=1)
"""
