# SPDX-License-Identifier: Apache-2.0
"""Files beside a history, its versions, and how fast it opens after years."""

import contextlib
import os
import sqlite3
from pathlib import Path

import pytest
from histories import filled
from history_workers import SERIAL, proposal

from robocal_ros.ground.errors import StorageError
from robocal_ros.ground.files import made_folder_beside
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import (
    MIGRATIONS,
    SCHEMA_VERSION,
    history_path,
    known_serials,
    unused,
)


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
        import robocal_ros.history.history_file as module

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
