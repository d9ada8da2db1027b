# SPDX-License-Identifier: Apache-2.0
"""``robocal fk`` and ``robocal import-ur``: answers, refusals, exit status and JSON."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import conforms
from joint_errors import LENGTH, SIZE, with_joint_errors

from robocal_ros.cli.main import main
from robocal_ros.ground import frames
from robocal_ros.kinematics.arm import random_postures
from robocal_ros.kinematics.joint_functions import IdentifiedFrom
from robocal_ros.kinematics.robots import load_description, load_robot, save_robot
from robocal_ros.kinematics.tables import write_cells


def answer(command: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, dict[str, Any]]:
    """Exit status and the one JSON document, which its schema allows."""
    status = main([*command, "--json"])
    document = json.loads(capsys.readouterr().out)
    conforms(document, f"{command[0]}.json")
    return status, document


def test_check_point_of_the_bx200l(capsys: pytest.CaptureFixture[str]) -> None:
    status, document = answer(["fk", "--robot", "bx200l", "--joints-deg", "90,0,0,0,0,0"], capsys)
    assert status == 0
    np.testing.assert_allclose(document["T_base_flange"]["xyz_mm"], [1675, 0, 1920], atol=1e-9)
    assert "T_base_tool" not in document
    assert document["warnings"] == []


def test_radians_and_units_give_the_same(capsys: pytest.CaptureFixture[str]) -> None:
    q = np.array([-0.5, 1.0, -0.25, 2.0, 0.5, -3.0])
    ways = {
        "--joints-rad": ",".join(map(repr, q.tolist())),
        "--joints-deg": ",".join(map(repr, np.degrees(q).tolist())),
        "--joints": "-0.5rad,1 rad,-0.25rad,2e0rad,0.5rad," + f"{float(np.degrees(-3.0))!r}deg",
    }
    expected = load_robot("ur10").fk(q)
    for option, values in ways.items():
        status, document = answer(["fk", "--robot", "ur10", option, values], capsys)
        assert status == 0
        pose = document["T_base_flange"]
        T = frames.transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"])
        np.testing.assert_allclose(T, expected, atol=1e-12)


def test_sliding_joints(capsys: pytest.CaptureFixture[str]) -> None:
    command = ["fk", "--robot", "p1r2p3", "--joints", "100mm,90deg,0.05m"]
    status, document = answer(command, capsys)
    assert status == 0
    np.testing.assert_allclose(document["T_base_flange"]["xyz_mm"], [450, 0, 400], atol=1e-9)
    assert [joint["unit"] for joint in document["joints"]] == ["mm", "deg", "mm"]
    assert any("joint limits not given" in warning for warning in document["warnings"])


def test_a_tool_and_limits_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    from dataclasses import replace

    tool = frames.transform(np.eye(3), [0.0, 0.0, 0.1])
    path = tmp_path / "tooled.yaml"
    save_robot(replace(load_robot("kr150_r3100"), T_flange_tool=tool), path)
    command = ["fk", "--robot", str(path), "--joints-deg", "-190,-90,90,0,0,0"]
    status, document = answer(command, capsys)
    assert status == 0
    flange, tip = (np.array(document[f"T_base_{key}"]["xyz_mm"]) for key in ("flange", "tool"))
    assert np.linalg.norm(tip - flange) == pytest.approx(100.0, rel=1e-12)
    assert document["warnings"] == ["joint_a1 at -190 deg is beyond its limits"]
    assert [joint["within_limits"] for joint in document["joints"]] == [False] + [True] * 5
    assert main(command) == 0
    printed = capsys.readouterr()
    assert "tool" in printed.out
    assert "beyond its limits" in printed.err


@pytest.mark.parametrize(
    ("robot", "option", "values", "words"),
    [
        ("ur10", "--joints-deg", "1,2,3", "3 values; UR10 has 6 joints"),
        ("ur10", "--joints-deg", "1,2,3,4,5,six", "'six' of joint 6 is not a number"),
        ("ur10", "--joints-deg", "1,2,3,4,5,nan", "'nan' of joint 6 is not a number"),
        ("ur10", "--joints-deg", "1,2,3,4,5,", "joint 6 is not a number"),
        ("ur10", "--joints-deg", "1,2,3,4,5,6deg", "'6deg' has a unit; use --joints"),
        ("ur10", "--joints", "1deg,2deg,3deg,4deg,5deg,6", "'6' needs the unit deg or rad"),
        ("ur10", "--joints", "1deg,2deg,3deg,4deg,5deg,6mm", "'6mm' needs the unit deg or rad"),
        ("p1r2p3", "--joints-deg", "1,2,3", "prismatic joints: use --joints"),
        ("bx20l", "--joints-deg", "1,2,3,4,5,6", "did you mean 'bx200l'"),
    ],
)
def test_refusals(
    robot: str, option: str, values: str, words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, document = answer(["fk", "--robot", robot, option, values], capsys)
    assert status == 2
    assert document["error"]["code"] == "BAD_INPUT"
    assert words in document["error"]["message"]


@pytest.mark.parametrize("value", ["x" * 10_000, "9" * 10_000, "9" * 300, "1" * 9_000 + "deg"])
@pytest.mark.parametrize("option", ["--joints-deg", "--joints"])
def test_a_huge_value_is_cut_in_the_message(
    option: str, value: str, capsys: pytest.CaptureFixture[str]
) -> None:
    status, document = answer(["fk", "--robot", "ur10", option, f"{value},2,3,4,5,6"], capsys)
    assert status == 2
    assert "…" in document["error"]["message"]
    assert len(document["error"]["message"]) < 300


@pytest.mark.parametrize("option", ["--fit", "--check-refit", "--hold-out", "--seed"])
def test_a_huge_argument_is_cut_in_the_message(
    option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    command = ["identify", "--robot", "ur10", "--data", "none.csv", option, "x" * 10_000]
    status, document = answer(command, capsys)
    assert status == 2
    assert "…" in document["error"]["message"]
    assert len(document["error"]["message"]) < 300


def test_a_bad_robot_file_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "bad.yaml"
    path.write_text("robot: a\nconvention: dh\njoints: [\n")
    status, document = answer(["fk", "--robot", str(path), "--joints-deg", "1"], capsys)
    assert status == 2
    assert document["error"]["file"] == str(path)
    assert document["error"]["row"] == 4


@pytest.mark.data
def test_the_factory_calibration_of_a_ur5e(
    data_dir: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = data_dir / "ur5e_factory"
    output = tmp_path / "my_ur5e.yaml"
    calibration, nominal = folder / "calibration.conf", folder / "urcontrol.conf.UR5"
    command = ["import-ur", "--calibration", str(calibration), "--nominal", str(nominal)]
    status, document = answer([*command, "--output", str(output)], capsys)
    assert status == 0
    assert document["conversion_error_mm"] < 1e-6
    assert max(abs(joint["d_mm"]) for joint in document["joints"]) < 200.0
    arm = load_robot(output)
    assert arm.name == "my_ur5e"
    assert arm.model_hash == document["model_hash"]

    pairs = np.loadtxt(folder / "joint-eef-data.csv", delimiter=",", skiprows=1)
    error_mm = np.linalg.norm(
        arm.fk(np.radians(pairs[:, :6]))[:, :3, 3] * 1e3 - pairs[:, 6:9], axis=1
    )
    assert error_mm.mean() <= 0.0445
    assert error_mm.max() <= 0.081

    assert main([*command, "--output", str(output)]) == 0
    assert "calibrated by the factory" in capsys.readouterr().out
    wrong = ["import-ur", "--calibration", str(calibration), "--nominal", str(calibration)]
    status, document = answer([*wrong, "--output", str(tmp_path / "none.yaml")], capsys)
    assert status == 2
    assert document["error"]["file"] == str(calibration)
    assert not (tmp_path / "none.yaml").exists()


def test_joint_functions_as_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arm, path = with_joint_errors(load_robot("ur10"), 2), tmp_path / "full.yaml"
    measured = random_postures(arm, 100)
    known = IdentifiedFrom(
        q=measured, target=np.zeros(100), weight=np.ones(100), p_flange=np.full((1, 3), 0.1),
        lever=0.0, noise=5e-5, parameter_sigma=np.full(len(arm.parameters), 1e-3), base_sigma=1.0,
        target_sigma=1.0, length=np.full(6, LENGTH), amplitude=np.full(6, SIZE),
    )  # fmt: skip
    save_robot(replace(arm, functions=replace(arm.functions, identified_from=known)), path)
    plain = ["joint-functions", "--robot", str(path), "--output", str(tmp_path / "t.csv")]
    poses = {f"q{i}_deg": [f"{x:.6f}" for x in np.degrees(measured[:, i - 1])] for i in range(1, 7)}
    write_cells(tmp_path / "poses.csv", poses)
    command = [*plain, "--data", str(tmp_path / "poses.csv"), "--figures", str(tmp_path)]
    status, document = answer(command, capsys)
    assert status == 0
    rows = [line.split(",") for line in (tmp_path / "t.csv").read_text().splitlines()[1:]]
    elbow = np.array([[row[1], row[3], row[5]] for row in rows if row[0] == "elbow_joint"], float)
    q = np.zeros((len(elbow), 6))
    q[:, 2] = np.radians(elbow[:, 0])
    # the table is rounded to 1e-6 deg, 1e-4 urad and 1e-8
    np.testing.assert_allclose(elbow[:, 1], 1e6 * arm.functions.delta(q)[:, 2], atol=1e-3)
    np.testing.assert_allclose(elbow[:, 2], arm.functions.slope(q)[:, 2], atol=2e-8)
    told = document["joints"][2]
    assert told["largest_urad"] == pytest.approx(np.max(np.abs(elbow[:, 1])), abs=1e-3)
    np.testing.assert_allclose((told["from"], told["to"]), elbow[[0, -1], 0], atol=1e-6)
    # at its poses the model is known better than before, and its own functions better than nothing
    assert document["predicted"]["rms_mm"] < 1.0
    assert document["predicted"]["not_covered"] == 0.0
    sigma = np.array([float(row[6]) for row in rows if row[0] == "elbow_joint"])
    assert sigma.min() < 0.8e6 * SIZE < sigma.max() <= 1.001e6 * SIZE
    assert (tmp_path / "joints.svg").is_file()
    assert told["compliance_micro"] == pytest.approx(1e6 * arm.functions.compliance[2])
    assert main(plain) == 0
    assert "what joints turn besides what is read" in capsys.readouterr().out


def test_bands_of_joint_functions_that_nobody_knows_are_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, drawn = tmp_path / "full.yaml", tmp_path / "drawn"
    save_robot(with_joint_errors(load_robot("ur10"), 2), path)
    command = ["joint-functions", "--robot", str(path), "--figures", str(drawn)]
    status, document = answer(command, capsys)
    assert status == 2
    assert "does not say what it was identified from" in document["error"]["message"]
    assert not drawn.exists()


def test_joint_functions_have_the_unit_of_their_joint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "120")  # of 80 a cell takes two lines
    path = tmp_path / "full.yaml"
    save_robot(with_joint_errors(load_description("p1r2p3").arm, 2), path)
    assert main(["joint-functions", "--robot", str(path)]) == 0
    told = capsys.readouterr().out
    assert told.count(" µm/N") == 2
    assert told.count(" µrad/(N m)") == 1
