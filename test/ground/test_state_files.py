# SPDX-License-Identifier: Apache-2.0
"""The state of a robot beside its history: whole, on the disk, and missed when it is gone."""

import errno
import os
import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from robocal_ros.ground.errors import ConflictError, StateLostError, StorageError
from robocal_ros.ground.files import SoleUser, StateFile


@pytest.fixture
def history(tmp_path: Path) -> Path:
    return tmp_path / "K1.sqlite"


def test_a_document_comes_back(history):
    keeper = StateFile(history, "maintenance")
    assert keeper.load() is None
    keeper.save({"a": 1})
    assert StateFile(history, "maintenance").load() == {"a": 1}


def test_nodes_of_one_process_open_it_at_once(history):
    """Finding: one took the other's draft away, and could not be configured."""
    together = threading.Barrier(8)

    def opened(number: int) -> dict[str, int] | None:
        together.wait()
        keeper = StateFile(history, "robot_file")
        found = keeper.load()
        keeper.save({"a": number})
        return found

    with ThreadPoolExecutor(8) as threads:
        assert all(found is None or found["a"] < 8 for found in threads.map(opened, range(8)))
    (file,) = StateFile(history, "robot_file").path.parent.iterdir()
    assert file.name == "state.json"
    assert [path.name for path in history.with_suffix("").iterdir()] == ["robot_file"]


def test_a_power_cut_loses_nothing_that_was_saved(history, monkeypatch):
    """The file is on the disk before it takes its name, and its name before save returns."""
    keeper = StateFile(history, "maintenance")
    before = keeper.path.stat().st_ino
    synced: list[tuple[int, int]] = []  # what was brought to the disk; what had the name then
    sync = os.fsync

    def spied(descriptor: int) -> None:
        sync(descriptor)
        synced.append((os.fstat(descriptor).st_ino, keeper.path.stat().st_ino))

    monkeypatch.setattr(os, "fsync", spied)
    keeper.save({"a": 1})
    saved, folder = keeper.path.stat().st_ino, keeper.path.parent.stat().st_ino
    assert synced == [(saved, before), (folder, saved)]


def test_a_state_that_was_there_once_is_missed(history):
    keeper = StateFile(history, "maintenance")
    keeper.path.unlink()
    for each in (keeper, StateFile(history, "maintenance")):
        with pytest.raises(StateLostError, match=r"state\.json is gone"):
            each.load()


def test_a_state_that_is_no_document_is_refused(history):
    keeper = StateFile(history, "maintenance")
    for text in ("", "{", "[1]"):
        keeper.path.write_text(text)
        with pytest.raises(StorageError):
            keeper.load()


def test_a_state_whose_place_takes_nothing_is_not_saved(history):
    """A file in the folder's place: as on a disk that is read-only the draft cannot be removed."""
    keeper = StateFile(history, "maintenance")
    keeper.path.unlink()
    keeper.path.parent.rmdir()
    keeper.path.parent.touch()
    with pytest.raises(StorageError, match=r"state\.json: cannot be written: Not a directory"):
        keeper.save({"a": 1})


@pytest.mark.parametrize("bad", [float("nan"), float("inf")])
def test_a_number_that_is_not_finite_is_not_kept(history, bad):
    keeper = StateFile(history, "maintenance")
    keeper.save({"a": 1})
    with pytest.raises(StorageError, match=r"state\.json: .*not JSON compliant"):
        keeper.save({"a": bad})
    assert keeper.load() == {"a": 1}


def test_a_full_disk_keeps_no_node_from_its_part(history, monkeypatch):
    """The file is there and locked; only the number of the process has no room in it."""

    def full(*given: object) -> int:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(os, "pwrite", full)
    holder = SoleUser(history, "maintenance_node", "K1", 0.0)
    with pytest.raises(ConflictError, match=r"another maintenance_node \(process unknown\)"):
        SoleUser(history, "maintenance_node", "K1", 0.0)
    holder.close()
    SoleUser(history, "maintenance_node", "K1", 0.0).close()
