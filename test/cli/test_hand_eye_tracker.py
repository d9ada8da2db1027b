# SPDX-License-Identifier: Apache-2.0
"""``robocal hand-eye tracker``: both methods from files, and what it says of wrong files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import robocal, robocal_json
from tracker_files import SCAN, tracker_files

from bench.hand_eye_files import write_profile
from bench.laser_tracker import TrackerCell, prp_cell, six_axis_cell
from bench.measured_runs import Q_NEAR
from robocal_ros.ground import frames
from robocal_ros.hand_eye.files import read_tracker_points
from robocal_ros.hand_eye.targets import read_tracker_target
from robocal_ros.hand_eye.tracker import solve_tracker
from robocal_ros.hand_eye.tracker_data import TrackerNoise
from robocal_ros.kinematics.robots import load_robot

pytestmark = pytest.mark.filterwarnings("ignore:.*joint limits not given")


def cell() -> TrackerCell:
    return prp_cell(load_robot("p1r2p3"))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    made = tmp_path_factory.mktemp("tracker")
    tracker_files(made, cell())
    return made


def words(folder: Path, robot: str = "p1r2p3", **changed: object) -> list[object]:
    given = {
        "poses": folder / "scan_poses.csv",
        "profiles": folder / SCAN,
        "points": folder / "tracker.csv",
        "target": folder / "tracker_target.yaml",
    } | changed
    options = [word for key, value in given.items() if value for word in (f"--{key}", value)]
    return ["hand-eye", "tracker", "--robot", robot, *options]


def run(folder: Path, *more: object, status: int = 0, **changed: object):
    schema = "hand-eye.tracker.json"
    return robocal_json(schema, *words(folder, **changed), *more, status=status)


def test_both_methods_find_the_sensor(folder):
    truth = cell().T_flange_sensor
    found = run(folder)
    assert found["verdict"]["accept"]
    assert (found["kind"], found["method"], found["unobservable"]) == ("tracker", "best", [])
    away = np.subtract(found["T_flange_sensor"]["xyz_mm"], truth[:3, 3] * 1e3)
    assert np.all(np.abs(away) < 4.0 * np.array(found["sigma"]["xyz_mm"]))
    quat = np.array(found["T_flange_sensor"]["quat_xyzw"])
    apart = 1.0 - abs(float(quat @ frames.quat_xyzw(truth)))
    turn_deg = np.degrees(np.arccos(1.0 - apart)) * 2.0
    assert turn_deg < 4.0 * np.linalg.norm(found["sigma"]["rot_deg"])
    classic = run(folder, "--method", "classic")
    assert classic["sigma"] is None
    assert classic["covariance"] is None
    distance = np.subtract(classic["T_flange_sensor"]["xyz_mm"], truth[:3, 3] * 1e3)
    assert np.linalg.norm(distance) < 1.0  # four times the published 0.25 mm


def test_joints_that_err_are_said_as_far_as_residuals_show_them(folder):
    """Of this arm, which has no gears, what its scatter hides; more where sigmas are too small."""
    found, scatter_urad = run(folder), 1e6 * TrackerNoise().joint_rad
    assert found["joint_errors"]["size_urad"] < 2.0 * scatter_urad
    told = run(folder, "--joint-sigma-deg", 1e-4, "--joint-sigma-mm", 1e-4)
    factor = told["joint_errors"]["factor"]
    assert factor > found["joint_errors"]["factor"]
    assert told["verdict"]["reason"].endswith(f"count {factor:.1f} of it")
    silent = run(folder, "--joint-error-urad", 0)
    assert silent["joint_errors"] is None
    assert silent["covariance"] == found["covariance"]


def test_the_files_hold_what_was_measured(tmp_path):
    made = cell()
    data = tracker_files(tmp_path, made)
    arcs, sphere, faces = read_tracker_points(tmp_path / "tracker.csv", data.arm)
    for one, other in zip(arcs, data.arcs, strict=True):
        assert np.allclose(one.points, other.points, atol=1e-11)
        assert np.allclose(one.q, other.q, atol=1e-11)
    assert np.allclose(sphere, data.sphere, atol=1e-11)
    assert np.allclose(faces[1], data.faces[1], atol=1e-11)
    assert read_tracker_target(tmp_path / "tracker_target.yaml") == made.sizes.target


def test_a_six_axis_arm_needs_no_target_file(tmp_path):
    made = six_axis_cell(load_robot("ur10"), Q_NEAR)
    data = tracker_files(tmp_path, made)
    found = run(tmp_path, "--radius-mm", "19.05", robot="ur10", target=None)
    direct = solve_tracker(data, made.sizes.target, made.sizes.noise)
    xyz_mm = direct.T_flange_sensor[:3, 3] * 1e3
    assert found["T_flange_sensor"]["xyz_mm"] == pytest.approx(xyz_mm, abs=1e-6)  # files: 1e-8
    other = run(
        tmp_path, "--radius-mm", "19.05", "--joint-sigma-deg", "0.01", robot="ur10", target=None
    )
    noise = replace(made.sizes.noise, joint_rad=np.radians(0.01))
    xyz_mm = solve_tracker(data, made.sizes.target, noise).T_flange_sensor[:3, 3] * 1e3
    assert other["T_flange_sensor"]["xyz_mm"] == pytest.approx(xyz_mm, abs=1e-6)


def test_people_read_the_verdict_first(folder):
    done = robocal(*words(folder))
    assert done.returncode == 0
    first = done.stdout.splitlines()[0]
    assert first.startswith("ACCEPT: ")
    assert "at the working distance" in first
    assert "Expected error at the working distance: " in done.stdout


def test_a_tight_limit_is_a_verdict_not_an_error(folder):
    found = run(folder, "--limit-mm", "0.001")
    assert found["verdict"]["code"] == "POSES_NOT_INFORMATIVE"


def test_an_unlit_profile_is_named(folder, tmp_path):
    made = tmp_path / "copy"
    made.mkdir()
    data = tracker_files(made, cell())
    name = f"{data.profiles[3].name}.csv"
    (made / SCAN / name).write_text("x_mm,z_mm\n,\n")
    found = run(made)
    assert found["rejected"] == [name]
    assert name not in found["residual_mm"]["per_sample"]


def test_a_description_says_which_way_z_grows(folder, tmp_path):
    made = tmp_path / "heights"
    made.mkdir()
    for one in tracker_files(made, cell()).profiles:
        write_profile(made / SCAN / f"{one.name}.csv", one.points * [1.0, -1.0])
    plain, found = run(folder), run(made, "--sensor", "keyence")
    for key in ("sigma", "working_error_mm"):
        assert found[key] == plain[key]
    x, y, z, w = plain["T_flange_sensor"]["quat_xyzw"]
    turned = np.array([w, z, -y, -x])  # half a turn about x after it
    assert abs(turned @ found["T_flange_sensor"]["quat_xyzw"]) == pytest.approx(1.0, abs=1e-12)


def edited(folder: Path, tmp_path: Path, name: str, old: str, new: str) -> Path:
    text = (folder / name).read_text()
    assert old in text
    path = tmp_path / name
    path.write_text(text.replace(old, new))
    return path


@pytest.mark.parametrize(
    ("option", "name", "old", "new", "message"),
    [
        ("points", "tracker.csv", "face_2", "face_3", "did you mean"),
        ("points", "tracker.csv", "face_2", "face_1", "no point has the role face_2"),
        ("points", "tracker.csv", "role", "kind", "column role"),
        ("points", "tracker.csv", "q3_mm", "q4_mm", "q1 to q3"),
        ("target", "tracker_target.yaml", "19.05", "0.01905", "off by a thousand"),
        ("target", "tracker_target.yaml", "height_mm", "high_mm", "is not a known key"),
        ("target", "tracker_target.yaml", "kind: tracker", "kind: sphere", "it must be tracker"),
        ("poses", "scan_poses.csv", "q3_mm", "q3_deg", "prismatic"),
    ],
)
def test_files_that_are_wrong(folder, tmp_path, option, name, old, new, message):
    path = edited(folder, tmp_path, name, old, new)
    found = run(folder, status=2, **{option: path})
    assert found["error"]["file"] == str(path)
    assert message in found["error"]["message"]


def test_an_arc_without_joints(folder, tmp_path):
    lines = (folder / "tracker.csv").read_text().splitlines()
    lines[3] = ",".join([*lines[3].split(",")[:-1], ""])
    path = tmp_path / "tracker.csv"
    path.write_text("\n".join(lines) + "\n")
    found = run(folder, status=2, points=path)
    assert (found["error"]["row"], found["error"]["column"]) == (4, "q3_mm")


def test_a_scan_without_joints(folder, tmp_path):
    rows = [line.split(",") for line in (folder / "scan_poses.csv").read_text().splitlines()]
    keep = [i for i, name in enumerate(rows[0]) if not name.startswith("q") or name[1] in "xyzw"]
    path = tmp_path / "poses.csv"
    path.write_text("\n".join(",".join(row[i] for i in keep) for row in rows) + "\n")
    found = run(folder, status=2, poses=path)
    assert "the joints are missing" in found["error"]["message"]
