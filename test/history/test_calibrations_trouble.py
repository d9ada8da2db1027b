# SPDX-License-Identifier: Apache-2.0
"""A full disk, a file taken away, damage: nothing is lost, nothing half-written."""

import contextlib
import errno
import fcntl
import os
import sqlite3
import subprocess
from pathlib import Path

import numpy as np
import pytest
from histories import BY, filled, in_process, reopened
from history_workers import SERIAL, proposal

from robocal_ros.ground.errors import StorageError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import (
    acknowledge,
    damage_notice,
    damaged_files,
    history_path,
    known_serials,
)


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
        changes = (history.data_version, lambda: history.propose(proposal()))
        for call in (*changes, history.head, history.pending, history.list):
            with pytest.raises(StorageError, match="deleted or replaced"):
                call()


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

    def test_who_is_no_owner_touches_nothing(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        os.truncate(path, path.stat().st_size // 2)
        before = path.read_bytes()
        for _ in range(2):
            with pytest.raises(StorageError, match=r"thermal_node.* set it aside"):
                CalibrationHistory.open(SERIAL, state_dir=tmp_path, owner=False)
        assert path.read_bytes() == before
        assert not list(tmp_path.glob("*.damaged-*"))

    def test_it_is_told_until_somebody_acknowledges_each(self, tmp_path: Path) -> None:
        path = filled(tmp_path)
        assert damage_notice(path) == ""
        for _ in range(2):
            path.write_bytes(b"junk" * 100)
            CalibrationHistory.open(SERIAL, state_dir=tmp_path).close()
            assert "acknowledge" in damage_notice(path)
            (aside,) = damaged_files(path)
            assert acknowledge(path, "Ada", 7) == (aside,)
            assert aside.exists()
            assert damage_notice(path) == ""
        path.write_bytes(b"junk" * 100)
        CalibrationHistory.open(SERIAL, state_dir=tmp_path).close()
        (aside,) = damaged_files(path)
        aside.rename(tmp_path / "to be looked at")
        assert damage_notice(path) == ""

    @pytest.mark.parametrize("sole_user", ["", "thermal_node"])
    def test_a_disk_without_locks_is_named(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, sole_user: str
    ) -> None:
        """As an NFS server without its lock daemon answers."""

        def flock(*_: object) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(fcntl, "flock", flock)
        with pytest.raises(StorageError, match=r"No locks available.*local"):
            CalibrationHistory.open(SERIAL, state_dir=tmp_path, sole_user=sole_user)

    def test_a_read_only_disk_and_a_full_one_are_named(self, small_disk: Path) -> None:
        path = filled(small_disk)
        with pytest.raises(OSError, match="No space"):
            (small_disk / "theirs").write_bytes(bytes(3_000_000))
        before = path.read_bytes()
        with pytest.raises(StorageError, match="check the disk and its free space"):
            CalibrationHistory.open(SERIAL, state_dir=small_disk)
        (small_disk / "theirs").unlink()
        subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
        with pytest.raises(StorageError, match=r"[Rr]ead-only"):
            CalibrationHistory.open(SERIAL, state_dir=small_disk)
        assert path.read_bytes() == before

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
