# SPDX-License-Identifier: Apache-2.0
"""Room for recordings on real disks: only what this recorder made goes, and nothing holds it up."""

import errno
import fcntl
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from robocal_ros.bags.bag_writer import (
    KEEP,
    MARKER,
    BagRecording,
    Maker,
    is_open,
    keep,
    make_room,
    new_folder,
    recordings,
    size_bytes,
)
from robocal_ros.bags.bags import BagReader
from robocal_ros.bags.mcap_files import encode
from robocal_ros.ground.errors import StorageError
from robocal_ros.ground.files import draft_beside

TEXT = "std_msgs/msg/String"
MINE, OTHER = Maker("/recorder_node", "R1"), Maker("/left/recorder_node", "R1")
SECOND_NS = 1_000_000_000
ALL = 10**15


def made(parent: Path, at_s: int, maker: Maker = MINE, kilobytes: int = 20) -> Path:
    """A complete recording that was begun so many seconds after 1970."""
    folder = new_folder(parent, maker, at_s * SECOND_NS)
    with BagRecording(folder, latched=(), file_bytes=10_000) as recording:
        for i in range(kilobytes):
            noise = os.urandom(500).hex()  # does not compress away
            recording.write("/words", TEXT, bytes(encode(TEXT, {"data": noise})), at_s + i)
    return folder


def names(folders: object) -> list[str]:
    return [folder.name for folder in folders]


def test_the_oldest_go_first_but_for_those_that_are_kept(tmp_path: Path) -> None:
    folders = [made(tmp_path, 100 + i) for i in range(5)]
    sizes = [size_bytes(folder) for folder in folders]
    keep(folders[0], "a dispute")
    room = sum(sizes) + size_bytes(folders[0]) - sizes[0] - sizes[1] - sizes[2] + 100
    assert names(make_room(tmp_path, MINE, room, 0).deleted) == names(folders[1:3])
    assert names(make_room(tmp_path, MINE, 0, 0).deleted) == [folders[3].name]
    left = [one.folder for one in recordings(tmp_path)]
    assert left == [folders[0], folders[4]]  # the newest stays


def test_links_files_copies_and_other_recorders_are_left_alone_and_hold_nothing_up(
    tmp_path: Path,
) -> None:
    elsewhere = tmp_path / "elsewhere"
    target = made(elsewhere, 1)
    parent = tmp_path / "recordings"
    parent.mkdir()
    (parent / "robocal_0_link").symlink_to(target)
    (parent / "robocal_0_dangling").symlink_to(tmp_path / "nothing")
    (parent / "robocal_0_file").write_text("mine")
    (parent / "robocal_0_broken").mkdir()
    (parent / "robocal_0_broken" / MARKER).write_text('{"node": ')
    theirs = made(parent, 50, OTHER)
    original = made(parent, 60)
    copy = parent / "robocal_0_copy"
    subprocess.run(["cp", "-r", original, copy], check=True)
    newest = made(parent, 70)
    room = make_room(parent, MINE, 0, 0)
    assert room.deleted == (original,)
    why = {
        "robocal_0_link": "symbolic link",
        "robocal_0_dangling": "symbolic link",
        "robocal_0_file": "no folder",
        "robocal_0_broken": "cannot be read",
        "robocal_0_copy": "was copied or renamed",
    }
    assert room.left.keys() == why.keys()
    assert all(words in room.left[name] for name, words in why.items())
    for path in (*(parent / name for name in why if "dangling" not in name), target, theirs):
        assert path.exists()
    assert list(copy.glob("*.mcap"))
    assert newest.exists()


def test_what_has_an_odd_name_or_marker_is_left_alone_and_can_be_told(tmp_path: Path) -> None:
    (tmp_path / os.fsdecode(b"robocal_Pr\xfcfung")).mkdir()
    odd = {
        "robocal_endless": '{"number": 1e999}',
        "robocal_deep": "[" * 100_000,
        "robocal_renamed": '{"number": 1, "folder": "\\udc80"}',
    }
    who = '"node": "/n", "serial": "", "place": "", "run": "1", "folder": "f", "begun_ns": 1, '
    for name, mark in odd.items():
        (tmp_path / name).mkdir()
        (tmp_path / name / MARKER).write_text(mark.replace("{", "{" + who))
    old, new = made(tmp_path, 100), made(tmp_path, 200)
    (old / os.fsdecode(b"\xfc")).touch()
    room = make_room(tmp_path, MINE, 0, 0)
    assert names(room.deleted) == [old.name]
    assert set(room.left) == {*odd, old.name, "robocal_Pr\\udcfcfung"}
    for words in (*room.left, *room.left.values()):
        words.encode()  # as logs and messages do
    assert new_folder(tmp_path, MINE, 300 * SECOND_NS).is_dir()
    assert new.is_dir()


def test_what_somebody_put_into_a_recording_stays(tmp_path: Path) -> None:
    old, _ = made(tmp_path, 100), made(tmp_path, 200)
    (old / "notes.txt").write_text("what we found")
    (old / "frames").mkdir()
    room = make_room(tmp_path, MINE, 0, 0)
    assert room.deleted == (old,)
    assert sorted(names(old.iterdir())) == ["frames", "notes.txt"]
    assert "frames, notes.txt" in room.left[old.name]


def test_what_a_killed_recorder_did_not_finish_goes_with_its_recording(tmp_path: Path) -> None:
    old, _ = made(tmp_path, 100), made(tmp_path, 200)
    for name in (MARKER, KEEP, "metadata.yaml"):
        draft_beside(old / name).touch()
    assert make_room(tmp_path, MINE, 0, 0).left == {}
    assert not old.exists()


def test_they_are_ordered_by_what_they_hold(tmp_path: Path) -> None:
    """A copy to another disk gives new times, and a clock may begin again in 1970."""
    folders = [made(tmp_path, at_s) for at_s in (1_900_000_000, 1_900_000_100, 10)]
    for age, folder in enumerate(folders):
        os.utime(folder, (1e9 - age, 1e9 - age))
    assert [one.folder for one in recordings(tmp_path)] == folders
    assert make_room(tmp_path, MINE, 0, 0).deleted == tuple(folders[:2])


def test_one_that_cannot_be_deleted_does_not_hold_up_the_others(tmp_path: Path) -> None:
    folders = [made(tmp_path, 100 + i) for i in range(3)]
    (first,) = folders[0].glob("*_0.mcap")
    if subprocess.run(["chattr", "+i", first], capture_output=True, check=False).returncode:
        pytest.skip("this disk or user makes no file immutable")
    try:
        room = make_room(tmp_path, MINE, 0, 0)
    finally:
        subprocess.run(["chattr", "-i", first], check=True)
    assert room.deleted == (folders[1],)
    assert "cannot be deleted: Operation not permitted" in room.left[folders[0].name]


def test_a_full_disk_is_relieved_by_what_the_recorder_made_alone(small_disk: Path) -> None:

    def fill() -> None:
        for i in range(100):
            made(small_disk, 100 + i, kilobytes=200)

    with pytest.raises(StorageError, match="No space left on device"):
        fill()
    before = [one.folder for one in recordings(small_disk)]
    room = make_room(small_disk, MINE, ALL, 700_000)
    assert len(room.deleted) >= 2
    assert room.deleted == tuple(before[: len(room.deleted)])
    assert room.short_bytes == 0
    free = os.statvfs(small_disk)
    assert free.f_bavail * free.f_frsize >= 700_000
    made(small_disk, 300)  # it goes on


def test_a_disk_that_others_fill_is_told_and_every_recording_stays(small_disk: Path) -> None:
    folders = [made(small_disk, 100 + i, kilobytes=100) for i in range(3)]
    free = os.statvfs(small_disk)
    (small_disk / "theirs").write_bytes(bytes(free.f_bavail * free.f_frsize - 50_000))
    before = [size_bytes(folder) for folder in folders]
    room = make_room(small_disk, MINE, ALL, 1_000_000)
    assert room.deleted == ()
    assert 0 < room.short_bytes < 1_000_000
    assert (small_disk / "theirs").exists()
    assert [size_bytes(folder) for folder in folders] == before


def test_for_a_floor_that_cannot_be_reached_nothing_is_deleted(tmp_path: Path) -> None:
    folders = [made(tmp_path, 100 + i) for i in range(5)]
    room = make_room(tmp_path, MINE, ALL, 10**18)
    assert room.deleted == ()
    assert room.short_bytes > 10**17
    most = sum(size_bytes(folder) for folder in folders[3:])
    room = make_room(tmp_path, MINE, most, 10**18)  # what all may take together still holds
    assert room.deleted == tuple(folders[:3])
    assert all(folder.exists() for folder in folders[3:])


def test_while_another_of_the_name_writes_what_earlier_runs_made_stays(tmp_path: Path) -> None:
    """Two robots' recorders with all defaults, in one folder."""
    theirs = Maker(MINE.node, MINE.serial)
    earlier = [made(tmp_path, 100 + i, Maker(MINE.node, MINE.serial)) for i in range(2)]
    complete = made(tmp_path, 200, theirs)
    written = new_folder(tmp_path, theirs, 300 * SECOND_NS)
    with BagRecording(written, latched=(), file_bytes=10_000):
        own = [made(tmp_path, 400 + i) for i in range(2)]
        room = make_room(tmp_path, MINE, 0, 0)
        assert (room.deleted, room.rivals) == ((own[0],), (written,))
    room = make_room(tmp_path, MINE, 0, 0)
    assert (room.deleted, room.rivals) == ((*earlier, complete, written), ())
    assert own[1].exists()


def test_without_a_serial_host_and_domain_tell_recorders_apart(tmp_path: Path) -> None:
    left, right = (Maker(MINE.node, "", f"host, domain {domain}") for domain in (1, 2))
    kept = [made(tmp_path, 100 + i, left) for i in range(3)]
    gone, newest = made(tmp_path, 200, right), made(tmp_path, 300, right)
    assert make_room(tmp_path, right, 0, 0).deleted == (gone,)
    assert all(folder.exists() for folder in (*kept, newest))


@pytest.mark.parametrize("fate", ["removed", "moved", "replaced", "file"])
def test_a_recording_that_is_taken_away_while_it_is_written_is_noticed(
    tmp_path: Path, fate: str
) -> None:
    folder, elsewhere = new_folder(tmp_path, MINE, 100 * SECOND_NS), tmp_path / "elsewhere"
    recording = BagRecording(folder, latched=(), file_bytes=10_000)
    recording.look()
    for i in range(10):
        recording.write("/words", TEXT, bytes(encode(TEXT, {"data": f"{i}"})), i)
        recording.look()
    if fate == "removed":
        shutil.rmtree(folder)
    elif fate == "file":
        (folder / f"{folder.name}_0.mcap").unlink()
    else:
        folder.rename(elsewhere)
        if fate == "replaced":
            shutil.copytree(elsewhere, folder)
    with pytest.raises(StorageError, match="removed, moved or replaced"):
        recording.look()
    if elsewhere.exists():
        with BagReader(elsewhere) as bag:
            assert [m.message.data for m in bag.messages()] == [f"{i}" for i in range(10)]
            assert not bag.info.truncated


def test_no_folder_is_left_behind_where_the_disk_takes_no_marker(small_disk: Path) -> None:
    full = small_disk / "full"
    with pytest.raises(OSError, match="No space"):
        full.write_bytes(bytes(3_000_000))
    with pytest.raises(StorageError, match="No space left on device"):
        new_folder(small_disk, MINE)
    assert list(small_disk.glob("robocal_*")) == []


def test_a_read_only_disk_is_told(small_disk: Path) -> None:
    old, _ = made(small_disk, 100), made(small_disk, 200)
    subprocess.run(["mount", "-o", "remount,ro", str(small_disk)], check=True)
    room = make_room(small_disk, MINE, 0, 0)
    assert room.deleted == ()
    assert "Read-only file system" in room.left[old.name]
    with pytest.raises(StorageError, match="Read-only file system"):
        new_folder(small_disk, MINE)
    assert list(old.glob("*.mcap"))


def test_a_folder_on_another_disk_is_left_alone(small_disk: Path) -> None:
    """Deleting it makes no room here, and a mount point cannot be removed."""
    parent = small_disk.parent / "recordings"
    folders = [made(parent, 100 + i) for i in range(3)]
    bind = ["mount", "--bind", str(small_disk), str(folders[0])]
    (small_disk / MARKER).write_text((folders[0] / MARKER).read_text())
    (small_disk / f"{folders[0].name}_0.mcap").write_text("theirs")
    subprocess.run(bind, check=True)
    try:
        room = make_room(parent, MINE, 0, 0)
    finally:
        subprocess.run(["umount", str(folders[0])], check=True)
    assert room.deleted == (folders[1],)
    assert "another disk" in room.left[folders[0].name]
    assert (small_disk / f"{folders[0].name}_0.mcap").exists()


def test_what_is_being_written_is_not_deleted(tmp_path: Path) -> None:
    folder = new_folder(tmp_path, MINE, 100 * SECOND_NS)
    recording = BagRecording(folder, latched=(), file_bytes=10_000)
    made(tmp_path, 200)
    assert make_room(tmp_path, MINE, 0, 0).deleted == ()
    recording.close()
    assert make_room(tmp_path, MINE, 0, 0).deleted == (folder,)


WRITER = """
import sys
from pathlib import Path
from robocal_ros.bags.bag_writer import BagRecording
recording = BagRecording(Path(sys.argv[1]), latched=(), file_bytes=1000)
print(flush=True)
sys.stdin.read()
"""


@pytest.mark.parametrize("locks", [True, False])
def test_what_another_process_writes_is_not_deleted_until_it_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, locks: bool
) -> None:
    """Also on a disk without locks: an NFS server without its lock daemon says ENOLCK."""
    without = "import errno, fcntl\ndef flock(*_): raise OSError(errno.ENOLCK, 'No locks')\n"
    program = WRITER if locks else f"{without}fcntl.flock = flock\n{WRITER}"
    if not locks:

        def flock(*_: object) -> None:
            raise OSError(errno.ENOLCK, "No locks available")

        monkeypatch.setattr(fcntl, "flock", flock)
    folder = new_folder(tmp_path, MINE, 100 * SECOND_NS)
    with subprocess.Popen(
        [sys.executable, "-c", program, folder], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as writer:
        writer.stdout.readline()
        made(tmp_path, 200)
        assert is_open(folder)
        assert make_room(tmp_path, MINE, -1, 0).deleted == ()
        writer.kill()
        writer.wait()
    assert make_room(tmp_path, MINE, -1, 0).deleted == (folder,)


def test_on_a_disk_without_locks_another_hosts_counts_as_open(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = made(tmp_path, 100)
    (folder / "OPEN").write_text("another-host 1\n")
    assert not is_open(folder)

    def flock(*_: object) -> None:
        raise OSError(errno.ENOLCK, "No locks available")

    monkeypatch.setattr(fcntl, "flock", flock)
    assert is_open(folder)


def test_marker_description_and_keep_outlive_a_power_cut(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced, fsync = set(), os.fsync

    def noted(descriptor: int) -> None:
        synced.add(os.fstat(descriptor).st_ino)
        fsync(descriptor)

    def are_on_the_disk(*paths: Path) -> bool:
        found = {path.stat().st_ino for path in paths} <= synced
        synced.clear()
        return found

    monkeypatch.setattr(os, "fsync", noted)
    folder = new_folder(tmp_path, MINE)
    assert are_on_the_disk(tmp_path, folder, folder / MARKER)
    with BagRecording(folder, latched=(), file_bytes=10_000) as recording:
        recording.write("/words", TEXT, bytes(encode(TEXT, {"data": ""})), 1)
        assert are_on_the_disk(folder, folder / "metadata.yaml")
    assert are_on_the_disk(folder, folder / "metadata.yaml", *folder.glob("*.mcap"))
    keep(folder, "a dispute")
    assert are_on_the_disk(folder, folder / KEEP)


def test_two_recordings_of_one_second_have_two_folders(tmp_path: Path) -> None:
    first = new_folder(tmp_path, MINE, 1_800_000_000_123_000_000)
    assert first.name == "robocal_2027-01-15T08-00-00Z"
    second = new_folder(tmp_path, MINE, 1_800_000_000_900_000_000)
    assert second.name == f"{first.name}_2"
    assert [one.number for one in recordings(tmp_path)] == [1, 2]
    mark = json.loads((second / MARKER).read_text())
    assert (Maker(mark["node"], mark["serial"]), mark["folder"]) == (MINE, second.name)
