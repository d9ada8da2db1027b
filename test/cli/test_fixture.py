# SPDX-License-Identifier: Apache-2.0
"""``robocal fixture`` on files: taught, compared, kept."""

import json

import numpy as np
import pytest
from command import robocal_json
from fixture_driver import fixture_bag
from fixture_tables import MOVED_M, fixture_tables

from bench.measured_fixture import ARM, PLATE
from robocal_ros.cli.main import main
from robocal_ros.fixture.files import read_fixture
from robocal_ros.ground.errors import InputError
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import fixture_kind

ROBOT = ("--robot", "kr150_r3100", "--fixture", "plate.yaml")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    fixture_tables(tmp_path)
    return tmp_path


def command(capsys, *words):
    status = main(["fixture", *ROBOT, *words, "--json"])
    return status, json.loads(capsys.readouterr().out)


def test_a_fixture_file_is_read_as_it_was_written(folder):
    again = read_fixture(folder / "plate.yaml")
    assert list(again.by_name) == list(PLATE.by_name)
    np.testing.assert_allclose(again.T_base_fixture, PLATE.T_base_fixture, atol=1e-12)
    for name, feature in again.by_name.items():
        np.testing.assert_allclose(feature.at, PLATE.by_name[name].at, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("kind: hole", "kind: bore", "must be plane or edge or hole or sphere"),
        ("capture_mm: 10.0", "capture_mm: 90.0", "twice capture_mm"),
        ("name: H2", "name: H1", "twice"),
        ("kind: sphere", "kind: plane", "direction is missing"),
    ],
)
def test_a_fixture_file_that_is_wrong_is_refused_by_name(folder, old, new, words):
    text = (folder / "plate.yaml").read_text()
    assert old in text
    (folder / "plate.yaml").write_text(text.replace(old, new, 1))
    with pytest.raises(InputError, match=words):
        read_fixture(folder / "plate.yaml")


def test_a_moved_fixture_is_told_and_written_for_a_controller(folder, capsys):
    status, document = command(
        capsys, "--points", "fixture_now.csv", "--taught", "fixture_taught.csv", "--maker", "kuka"
    )
    assert status == 0
    assert document["verdict"]["code"] == "ACCEPT"
    assert document["shift_mm"] == pytest.approx(1e3 * MOVED_M, abs=0.06)
    assert document["moved"]["plate"]["chance"] > 0.99
    x = document["frame"]["xyz_mm"][0]
    assert document["text"].startswith(f"$BASE={{X {x:.4f},")


def test_a_frame_that_is_not_accepted_is_not_written_for_a_controller(folder, capsys):
    taught, kuka = ("--taught", "fixture_taught.csv"), ("--maker", "kuka")
    before = command(capsys, "--points", "fixture_taught.csv", *kuka)[1]["text"]
    document = command(capsys, "--points", "fixture_knocked.csv", *taught, *kuka)[1]
    assert document["verdict"]["code"] == "SENSOR_OR_ROBOT_MOVED"
    assert document["text"] == before
    x = document["frame"]["xyz_mm"][0]
    assert not before.startswith(f"$BASE={{X {x:.4f},")
    main(["fixture", *ROBOT, "--points", "fixture_knocked.csv", *taught, *kuka])
    assert f"The frame stays as it is:\n{before}\n" in capsys.readouterr().out
    refused = ("--points", "fixture_taught.csv", "--form-mm", "0.001")
    document = command(capsys, *refused, *kuka)[1]
    assert (document["verdict"]["code"], document["text"]) == ("RESIDUAL_TOO_LARGE", None)


def test_taught_kept_accepted_and_compared_with_what_is_in_force(folder, capsys):
    kept = ("--robot-serial", "R1", "--state", str(folder))
    with CalibrationHistory.open("R1", model_hash=ARM.model_hash, state_dir=folder):
        pass
    status, taught = command(capsys, "--points", "fixture_taught.csv", *kept, "--keep")
    assert (status, taught["verdict"]["code"]) == (0, "ACCEPT")
    assert not taught["moved"]
    kind = fixture_kind("plate")
    decided = ["history", "accept", str(taught["calibration_id"]), "--state", str(folder)]
    assert main([*decided, "--by", "test", "--reason", "taught", "--json"]) == 0
    capsys.readouterr()
    status, now = command(capsys, "--points", "fixture_now.csv", *kept, "--keep")
    assert now["revision"] == 1
    assert now["verdict"]["code"] == "ACCEPT"
    with CalibrationHistory.open("R1", model_hash=ARM.model_hash, state_dir=folder) as history:
        inputs = history.inputs(now["calibration_id"])
    assert set(inputs) == {"name", "instrument", "q", "T_base_flange", "p"}
    assert {len(rows) for rows in inputs.values()} == {len(inputs["p"])}
    back = ["history", "rollback", "--to", "nominal", "--kind", kind, "--state", str(folder)]
    assert main([*back, "--by", "test", "--reason", "test", "--json"]) == 0


def test_a_taught_table_that_is_refused_is_told(folder, capsys):
    strict = "--form-mm", "0.001"  # no sensor measures a feature so well
    alone = command(capsys, "--points", "fixture_taught.csv", *strict)[1]["verdict"]
    assert alone["code"] == "RESIDUAL_TOO_LARGE"
    taught = "--taught", "fixture_taught.csv"
    document = command(capsys, "--points", "fixture_now.csv", *taught, *strict)[1]
    assert document["warnings"] == [f"fixture_taught.csv: {alone['reason']}"]
    assert command(capsys, "--points", "fixture_now.csv", *taught)[1]["warnings"] == []


def test_a_recording_of_a_fixture_is_replayed_without_a_warning(tmp_path):
    fixture_bag(tmp_path / "fixture.mcap")
    document = robocal_json("replay.fixture.json", "replay", tmp_path / "fixture.mcap")
    assert document["warnings"] == []
    assert [f["verdict"]["code"] for f in document["fixtures"]] == ["ACCEPT", "ACCEPT"]
    words = "replay", tmp_path / "fixture.mcap", "--topic", "fixture_point:=/fixture_point"
    assert robocal_json("replay.fixture.json", *words)["fixtures"] == document["fixtures"]
