# SPDX-License-Identifier: Apache-2.0
"""``robocal data``: the sets are listed, told and converted; what is absent or damaged is said."""

import json
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import ROOT, conforms, robocal, robocal_json, takes
from scipy.spatial.transform import Rotation

from robocal_ros.cli.data import SETS
from robocal_ros.cli.main import main
from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.files import read_pose_table, read_profile
from robocal_ros.hand_eye.published import (
    ARM,
    STREAM,
    TCP_POSES,
    convert_board,
    convert_laser,
    convert_streams,
    laser_sets,
)
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.kinematics.tables import read_measurements


def run(name: str, data: Path, out: Path, *more: str) -> dict:
    document = robocal_json(
        "data.json", "data", name, "--out", out, *more, ROBOCAL_DATA=str(data)
    )  # fmt: skip
    return dict(document)


def test_all_sets_are_listed_wherever_they_are(tmp_path: Path):
    (tmp_path / "eth_hand_eye").mkdir()
    document = robocal_json("data.json", "data", ROBOCAL_DATA=str(tmp_path))
    found = {one["name"]: one["found"] for one in document["sets"]}
    assert found == {name: name == "eth_hand_eye" for name in SETS}
    done = robocal("data", ROBOCAL_DATA="")
    assert done.returncode == 0
    assert "Looked for in nowhere: ROBOCAL_DATA is not set" in done.stdout
    assert all(name in done.stdout and one.licence in done.stdout for name, one in SETS.items())
    assert "yes" not in done.stdout


@pytest.mark.parametrize("name", SETS)
def test_a_set_is_told_with_how_to_get_it_and_what_to_do(name, tmp_path: Path):
    done = robocal("data", name, ROBOCAL_DATA=str(tmp_path))
    assert done.returncode == 0
    one = SETS[name]
    assert f"Not found in {tmp_path / name}; get it:" in done.stdout
    assert f"git clone {one.source} $ROBOCAL_DATA/{name}" in done.stdout
    assert f"git -C $ROBOCAL_DATA/{name} checkout {one.commit}" in done.stdout
    for command in robocal_json("data.json", "data", name)["sets"][0]["commands"]:
        takes(command)
    page = (ROOT / "docs/tutorials.md").read_text()
    assert f"`{name}`" in page
    assert one.source in page


@pytest.mark.parametrize(
    ("arguments", "folder", "words"),
    [
        (["--out", "out"], "", "--out needs the name"),
        (["ur10_tmac", "--part", "B"], "", "--part needs --out"),
        (["ur10_tmac", "--out", "out"], "", "set ROBOCAL_DATA to the folder that holds ur10_tmac"),
        (["ur10_tmac", "--out", "out"], "nowhere", "ur10_tmac: no such folder: clone https://"),
        (["ur10_tmac", "--out", "out", "--part", "E"], "here", "'E' is no part of ur10_tmac"),
        (["ur10_tmac", "--out", "out"], "here", "measurements_grid.csv: no such table"),
        (["ur5e_factory", "--out", "out"], "here", "there is no urcontrol.conf.UR5 in this folder"),
        (["camera_hand_eye", "--out", "out"], "here", "there is no tcp_pose_Fri"),
        (["eth_hand_eye", "--out", "out"], "here", "base_link_sr300_hinge.csv in this folder"),
        (["line_laser_fanuc", "--out", "out"], "here", "nothing of line_laser_fanuc is in"),
    ],
)
def test_what_cannot_be_converted_is_said(
    arguments, folder, words, tmp_path: Path, monkeypatch, capsys
):
    monkeypatch.chdir(tmp_path)
    for name in SETS:
        (tmp_path / "here" / name).mkdir(parents=True)
    monkeypatch.setenv("ROBOCAL_DATA", folder and str(tmp_path / folder))
    assert main(["data", *arguments, "--json"]) == 2
    document = json.loads(capsys.readouterr().out)
    conforms(document, "error.json")
    assert words in document["error"]["message"]
    assert not (tmp_path / "out").exists()


@pytest.mark.data
@pytest.mark.parametrize("name", SETS)
def test_what_is_converted_does_what_is_told(name, data_dir: Path, tmp_path: Path):
    """Its commands run on what was written; what they find is held by tests of their own."""
    parts = {"ur10_tmac": ["--part", "D"]}.get(name, [])
    out = tmp_path / "my DATA"  # a word of the commands, and a blank
    document = run(name, data_dir, out, *parts)
    files = {file for part in document["written"] for file in part["files"]}
    there = {str(path) for path in out.rglob("*") if path.is_file()}
    assert files == there
    if parts:
        assert "D_train.csv" in document["sets"][0]["commands"][0]
    for command in document["sets"][0]["commands"]:
        done = robocal(*shlex.split(command)[1:])
        assert done.returncode == 0, (command, done.stderr)


@pytest.mark.data
def test_the_factory_file_gives_the_poses_of_its_controller(data_dir: Path, tmp_path: Path):
    document = run("ur5e_factory", data_dir, tmp_path)
    for command in document["sets"][0]["commands"]:
        assert robocal(*shlex.split(command)[1:]).returncode == 0
    arm = load_robot(tmp_path / "ur5e.yaml")
    data = read_measurements(tmp_path / "poses.csv", arm)
    T = arm.fk(data.q)
    # joints and poses are rounded to 0.01 deg and mm; published: under 0.08 mm, 0.032 deg
    assert np.linalg.norm(T[:, :3, 3] - data.position, axis=1).max() <= 0.081e-3
    turn = Rotation.from_matrix(np.swapaxes(T[:, :3, :3], 1, 2) @ data.rotation).magnitude()
    assert turn.mean() <= np.radians(0.033)


@pytest.mark.data
@pytest.mark.parametrize(
    ("name", "file", "line", "wrong", "words"),
    [
        ("eth_hand_eye", "real/robot_arm_complete_bag_color_and_ir_target_ir.csv", 3,
         "1487321563.2, 0.2, 0.02", "is not x, y, z (m) and a quaternion"),
        ("eth_hand_eye", "real/robot_arm_complete_bag_color_and_ir_target_ir.csv", 5,
         "noon, 0, 0, 0, 0, 0, 0, 1", "'noon' is not seconds since 1970"),
        ("camera_hand_eye", "tcp_pose_Fri_Nov_25_17-19-40_2022.txt", 2,
         "[-0.5 0.1 nan 2.1 2.2 0.3]", "is not x y z (m) and a rotation vector"),
        ("ur5e_factory", "joint-eef-data.csv", 4, "1,2,3", "3 cells, but the header has 12"),
    ],
)  # fmt: skip
def test_a_damaged_line_is_told_with_its_place(
    name, file, line, wrong, words, data_dir: Path, tmp_path: Path, monkeypatch, capsys
):
    shutil.copytree(data_dir / name, tmp_path / name, copy_function=shutil.copyfile)
    path = tmp_path / name / file
    for folder in (tmp_path / name, path.parent):
        folder.chmod(0o755)
    lines = path.read_text().splitlines()
    lines[line - 1] = wrong
    path.write_text("\n".join(lines))
    monkeypatch.setenv("ROBOCAL_DATA", str(tmp_path))
    assert main(["data", name, "--out", str(tmp_path / "out"), "--json"]) == 2
    error = json.loads(capsys.readouterr().out)["error"]
    assert words in error["message"]
    assert (error["file"], error["row"]) == (str(path), line)
    assert not (tmp_path / "out").exists()


# ---- profiles as HandEyeSync publishes them: a program, and lists that OpenCV wrote -------------


def write_program(path: Path, shown: np.ndarray, tool: int = 0) -> None:
    """A FANUC program with points X Y Z W P R (n, 6), mm and deg to three decimals."""
    points = [
        f"P[{i}]{{\n   GP1:\n\tUF : 0, UT : {tool},\t\tCONFIG : 'N U T, 0, 0, 0',\n"
        + f"\tX = {x:9.3f}  mm,\tY = {y:9.3f}  mm,\tZ = {z:9.3f}  mm,\n"
        + f"\tW = {w:9.3f} deg,\tP = {p:9.3f} deg,\tR = {r:9.3f} deg\n}};\n"
        for i, (x, y, z, w, p, r) in enumerate(shown, start=1)
    ]
    path.parent.mkdir(parents=True)
    path.write_text("/PROG  CALIB\n/MN\n   1:J P[1] 100% FINE    ;\n/POS\n" + "".join(points))


def write_profile(path: Path, points: np.ndarray) -> None:
    triples = np.insert(points, 1, 0.0, axis=1).ravel()
    lines = ",\n    ".join(f"{value:.16e}" if value else "0." for value in triples)
    path.write_text(f"%YAML:1.0\n---\nprofile: [ {lines} ]\n")


@pytest.fixture
def published(tmp_path: Path) -> tuple[Path, np.ndarray, list[np.ndarray]]:
    """A set of three shots in a clone, numbers of its poses, and its profiles, mm."""
    rng = np.random.default_rng(5)
    shown = np.round(rng.uniform([300, -200, 200, -180, -80, -180], [800, 200, 600, 180, 80, 180],
                                 (3, 6)), 3)  # fmt: skip
    profiles = [np.round(rng.uniform(-50, 50, (40, 2)), 5) for _ in shown]
    place = tmp_path / "clone" / "data" / "Experiments" / "Sphere"
    write_program(place / "calib.ls", shown)
    for i, points in enumerate(profiles, start=1):
        write_profile(place / f"p{i}.yml", points)
    return place, shown, profiles


def test_a_program_and_its_profiles_become_tables(published, tmp_path: Path):
    place, shown, profiles = published
    clone = tmp_path / "clone"
    assert laser_sets(clone) == {"experiments_sphere": place}
    words, files = convert_laser("experiments_sphere", clone, tmp_path / "out")
    assert words == "3 profiles"
    assert len(files) == 4
    out = tmp_path / "out" / "experiments_sphere"
    table = read_pose_table(out / "poses.csv")
    np.testing.assert_allclose(table.T_base_flange[:, :3, 3] * 1e3, shown[:, :3], atol=1e-9)
    # W, P, R turn about the fixed x, y, z (FANUC)
    turn = Rotation.from_euler("xyz", shown[:, 3:], degrees=True).as_matrix()
    np.testing.assert_allclose(table.T_base_flange[:, :3, :3], turn, atol=1e-12)
    for name, points in zip(table.files, profiles, strict=True):
        np.testing.assert_allclose(
            np.loadtxt(out / name, delimiter=",", skiprows=1), points, atol=1e-9
        )


def test_what_is_no_such_set_is_said(published, tmp_path: Path):
    place, shown, _ = published

    def refused(words: str) -> None:
        with pytest.raises(InputError, match=words):
            convert_laser("experiments_sphere", tmp_path / "clone", tmp_path / "out")
        assert not (tmp_path / "out").exists()

    whole = (place / "p2.yml").read_text()
    for damaged in (whole[: len(whole) // 2], whole.replace(" 0.,", " 1.,"), "%YAML:1.0\n---\n"):
        (place / "p2.yml").write_text(damaged)
        refused("p2.yml: has no whole list 'profile' of triples x, 0, z")
    (place / "p2.yml").write_text(whole)
    (place / "p4.yml").write_text(whole)
    refused(r"p4.yml: calib.ls has no point P\[4\] with a pose of the flange")
    (place / "p4.yml").unlink()
    (place / "other.ls").write_text("/PROG\n")
    refused("two programs, calib.ls and other.ls")
    (place / "other.ls").unlink()
    shutil.rmtree(place)
    write_program(place / "calib.ls", shown, tool=1)
    (place / "p1.yml").write_text(whole)
    refused(r"has no point P\[1\] with a pose of the flange")


def test_a_table_without_poses_is_said(tmp_path: Path):
    (tmp_path / TCP_POSES).write_text("[ ]\n")
    (tmp_path / STREAM.format(ARM)).write_text(",,,\n")
    for convert in (convert_board, convert_streams):
        with pytest.raises(InputError, match="holds no poses"):
            convert(tmp_path, tmp_path / "out")
    assert not (tmp_path / "out").exists()


@pytest.mark.data
def test_the_real_poses_are_those_of_a_program_to_three_decimals(data_dir: Path, tmp_path: Path):
    """Others' conversion of the same programs: through W, P, R of 0.001 deg and back, nothing is
    lost beyond their nine digits, which no other convention of the angles would give."""
    real = data_dir / "line_laser_fanuc" / "experiments_sphere"
    table = read_pose_table(real / "poses.csv")
    T = table.T_base_flange
    angles = Rotation.from_matrix(T[:, :3, :3]).as_euler("xyz", degrees=True)
    place = tmp_path / "Experiments" / "Sphere"
    write_program(place / "calib_sph.ls", np.hstack([T[:, :3, 3] * 1e3, angles]))
    profiles = [read_profile(real / file, file) for file in table.files]
    for i, profile in enumerate(profiles, start=1):
        write_profile(place / f"p{i}.yml", profile.points * 1e3)
    convert_laser("experiments_sphere", tmp_path, tmp_path / "out")
    again = read_pose_table(tmp_path / "out" / "experiments_sphere" / "poses.csv")
    np.testing.assert_allclose(again.T_base_flange, T, atol=5e-9)
