# SPDX-License-Identifier: Apache-2.0
"""hand_eye_node keeps what was captured."""

from pathlib import Path
from typing import Any

import pytest
from hand_eye_live import NAME, SHOTS, LiveSensor
from robocal_msgs.srv import Decide, HandEyeFile
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code


@pytest.fixture
def sensor(graph: Any, tmp_path: Path) -> LiveSensor:
    made = LiveSensor(graph, tmp_path)
    made.sphere(8)
    return made


def restarted(sensor: LiveSensor) -> None:
    for step in ("deactivate", "cleanup", "configure", "activate"):
        getattr(sensor.node, f"trigger_{step}")()


def test_the_data_of_each_calibration_are_kept_and_calibrate_to_the_same(
    graph: Any, sensor: LiveSensor
) -> None:
    folder = graph.state / "K7" / "hand_eye"
    first = sensor.calibrate()
    assert first.success, first.message
    assert [path.name for path in folder.iterdir()] == [f"{first.candidate_id}.mcap"]
    second = graph.call(Trigger, f"{NAME}/calibrate_trigger", within_s=30.0)
    number = int(second.message.split()[0])
    assert number > first.candidate_id
    kept = [folder / f"{n}.mcap" for n in (first.candidate_id, number)]
    assert sorted(folder.iterdir()) == kept
    restarted(sensor)
    loaded = graph.call(HandEyeFile, f"{NAME}/load", path=str(kept[0]))
    assert (loaded.success, loaded.samples) == (True, 8), loaded.message
    again = sensor.calibrate()
    assert (again.sensor, again.covariance) == (first.sensor, first.covariance)
    assert (again.message, again.residual_mm) == (first.message, first.residual_mm)
    # Without a candidate there is nothing to keep.
    assert sensor.calibrate(handles=[1]).candidate_id == 0
    assert len(list(folder.iterdir())) == 3


def test_a_calibration_is_solved_again_from_its_own_samples(graph: Any, sensor: LiveSensor) -> None:
    """Not from those of another whose number begins alike, though these were kept later."""
    first = sensor.calibrate()
    folder = graph.state / "K7" / "hand_eye"
    (folder / f"{first.candidate_id}0.mcap").write_bytes(b"")
    assert sensor.node._files.solved_again_s(first.candidate_id) > 0.0


def test_a_plc_saves_without_a_name(graph: Any, sensor: LiveSensor) -> None:
    told = [graph.call(Trigger, f"{NAME}/save_trigger") for _ in range(2)]
    assert [one.success for one in told] == [True, True]
    paths = [Path(one.message.removeprefix("0 ACCEPT 8 samples saved in ")) for one in told]
    assert sorted((graph.state / "K7" / "hand_eye").iterdir()) == sorted(set(paths))
    assert len(set(paths)) == 2
    for path in paths:
        assert graph.call(HandEyeFile, f"{NAME}/load", path=str(path)).samples == 8
    assert graph.call(Trigger, f"{NAME}/start_trigger").success
    nothing = graph.call(Trigger, f"{NAME}/save_trigger")
    assert (nothing.success, nothing.message[:10]) == (False, "0 CONFLICT")


def test_what_is_dropped_unsaved_is_told(graph: Any, sensor: LiveSensor) -> None:
    path = "set.mcap"
    assert graph.call(HandEyeFile, f"{NAME}/save", path=path).success
    sensor.capture(SHOTS[7][1])
    dropped = "1 samples were dropped that were not saved"
    loaded = graph.call(HandEyeFile, f"{NAME}/load", path=path)
    assert loaded.message.endswith(dropped)
    saved = sensor.start()
    assert (saved.success, "dropped" in saved.message) == (True, False)
    sensor.capture(SHOTS[7][1])
    assert graph.call(Trigger, f"{NAME}/start_trigger").message.endswith(dropped)
    assert "dropped" not in sensor.start().message


def test_a_disk_that_fails_is_told_and_the_candidate_stays(graph: Any, sensor: LiveSensor) -> None:
    (graph.state / "K7").write_text("where the folder should be")
    result = sensor.calibrate()
    assert (result.success, result.status) == (True, Code.ACCEPT)
    assert "its samples were not kept, call save: the folder" in result.message
    twin = graph.call(Trigger, f"{NAME}/calibrate_trigger", within_s=30.0)
    assert twin.success
    assert "its samples were not kept" in twin.message
    failed = graph.call(Trigger, f"{NAME}/save_trigger")
    assert (failed.success, failed.message.split()[1]) == (False, "STORAGE_FAILED")
    assert graph.call(Decide, f"{NAME}/accept", id=result.candidate_id, by="me").success
    assert "8 samples were dropped" in sensor.start().message


def test_a_caller_writes_below_the_folder_of_data_sets_alone(
    graph: Any, sensor: LiveSensor, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    folder = graph.state / "K7" / "hand_eye"
    path = folder / "a.mcap"
    saved = graph.call(HandEyeFile, f"{NAME}/save", path="a.mcap")
    assert (saved.success, saved.message) == (True, f"8 samples saved in {path}")
    assert path.is_file()
    assert not graph.call(HandEyeFile, f"{NAME}/save", path="a.mcap").success  # it is there
    missing = graph.call(HandEyeFile, f"{NAME}/load", path="b.mcap")
    assert (missing.success, missing.status) == (False, Code.BAD_INPUT)
    before = sorted(tmp_path.rglob("*"))
    for given in (str(tmp_path / "b.mcap"), "~/b.mcap", "../b.mcap", f"{folder}/../../b.mcap"):
        refused = graph.call(HandEyeFile, f"{NAME}/save", path=given)
        assert (refused.success, refused.status) == (False, Code.BAD_INPUT)
        assert f"are written below {folder} alone" in refused.message
    assert sorted(tmp_path.rglob("*")) == before
    (tmp_path / "c.mcap").write_bytes(path.read_bytes())
    for given, whole in (("a.mcap", path), ("~/c.mcap", tmp_path / "c.mcap")):
        loaded = graph.call(HandEyeFile, f"{NAME}/load", path=given)
        assert (loaded.success, loaded.message.endswith(str(whole))) == (True, True)
    nobody = graph.call(HandEyeFile, f"{NAME}/save", path="~nobody-of-this-name/a.mcap")
    assert (nobody.success, nobody.status) == (False, Code.BAD_INPUT)
    assert "name the whole path" in nobody.message
