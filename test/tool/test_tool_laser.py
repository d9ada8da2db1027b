# SPDX-License-Identifier: Apache-2.0
"""The laser frame: the source's data, simulated calibrations, refusals; axes and tool rotations."""

import json

import numpy as np
import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st
from tool_tables import PUBLISHED_MM

from bench.measured_runs import (
    BETA_RAD,
    GAP_M,
    NO_NOISE,
    PERFECT,
    T_BASE_LASER,
    laser_of,
    point_sigma,
)
from robocal_ros.cell_sim.beams import (
    CYLINDER_M,
    BeamStation,
    TrueBeam,
    TrueInput,
    TrueNoise,
    beams_of,
    laser_points,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, RankDeficientError, WrongRobotError
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.files import read_tool
from robocal_ros.tool.laser_frame import (
    LaserFile,
    LaserFrame,
    axis_from_centres,
    calibrate_laser,
    first_rotation,
    minimal_rotation,
    read_laser,
    read_laser_for,
    retaught,
    upright_pose,
    write_laser,
)


def published() -> dict[str, np.ndarray]:
    return {name: 1e-3 * np.array(place) for name, place in PUBLISHED_MM.items()}


def test_the_sources_station_to_the_printed_digits():
    laser = calibrate_laser(published())
    T = laser.T_base_laser
    assert np.round(1e3 * T[:3, 3], 3).tolist() == [799.413, -126.302, 194.498]
    assert round(1e3 * abs(laser.gap_m), 3) == 0.058
    assert np.round(T[:3, 0], 5).tolist() == [0.99876, -0.02981, 0.03988]
    assert np.round(T[:3, 2], 5).tolist() == [-0.04057, -0.02273, 0.99892]
    assert round(np.degrees(laser.beam_angle_rad), 2) == 92.20
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)


def test_moving_the_base_moves_the_frame_and_nothing_else():
    """Points that are lines in space, not their raw sweeps, which run along the base's axes."""
    laser = calibrate_laser(published())
    move = frames.transform(frames.exp_rotation([0.4, -1.1, 0.7]), [0.3, -0.2, 0.9])
    moved = LaserFrame(laser.points @ move[:3, :3].T + move[:3, 3])
    assert moved.T_base_laser == pytest.approx(move @ laser.T_base_laser, abs=1e-12)
    assert moved.gap_m == pytest.approx(laser.gap_m, abs=1e-14)
    assert moved.beam_angle_rad == pytest.approx(laser.beam_angle_rad, abs=1e-12)


def test_simulated_sweeps_give_the_true_frame():
    """A gap and beams that cross at 92.2 deg, level in base."""
    level = frames.transform(frames.exp_rotation([0.0, 0.0, 0.03]), T_BASE_LASER[:3, 3])
    station = BeamStation(beams_of(level, BETA_RAD, GAP_M), PERFECT, NO_NOISE)
    found = calibrate_laser(laser_points(station, level, np.random.default_rng(0)))
    assert found.T_base_laser == pytest.approx(level, abs=1e-9)
    assert found.gap_m == pytest.approx(GAP_M, abs=1e-12)
    assert found.beam_angle_rad == pytest.approx(BETA_RAD, abs=1e-9)


def test_a_constant_latency_cancels_in_sweeps_back_and_forth():
    source = TrueInput(latency_s=0.02, jitter_s=0.0)
    station = BeamStation(beams_of(T_BASE_LASER, BETA_RAD, GAP_M), source, NO_NOISE)
    found = calibrate_laser(laser_points(station, T_BASE_LASER, np.random.default_rng(0)))
    assert found.T_base_laser == pytest.approx(T_BASE_LASER, abs=1e-9)


@pytest.mark.parametrize("light", [0.3, 0.5, 0.8])
def test_a_cylinder_of_known_radius_gives_the_beams_reach(light):
    """Beams that lean by 2 deg in base: exact to the square of that."""
    beams = tuple(
        TrueBeam(b.start, b.end, 8e-4, light, light)
        for b in beams_of(T_BASE_LASER, BETA_RAD, GAP_M)
    )
    station = BeamStation(beams, PERFECT, NO_NOISE)
    points = laser_points(station, T_BASE_LASER, np.random.default_rng(0))
    found = calibrate_laser(points, radius_m=CYLINDER_M)
    assert found.reach == pytest.approx([beams[0].threshold(light)] * 2, abs=1e-9)
    assert found.T_base_laser == pytest.approx(T_BASE_LASER, abs=1e-9)


@pytest.mark.long
def test_scatter_of_the_points_is_what_is_said():
    source, noise = TrueInput(sample_period_s=0.002), TrueNoise(3e-5, 1e-5)
    station = BeamStation(beams_of(T_BASE_LASER, BETA_RAD, GAP_M), source, noise)
    exact = BeamStation(station.beams, PERFECT, NO_NOISE)
    true = calibrate_laser(laser_points(exact, T_BASE_LASER, np.random.default_rng(0)))
    errors = []
    for seed in range(40):
        found = calibrate_laser(laser_points(station, T_BASE_LASER, np.random.default_rng(seed)))
        away = found.points - true.points
        errors += [away[:2, 1], away[2:, 0], away[:, 2]]  # across the beams
    squares = np.concatenate(errors) ** 2
    assert len(squares) == 320
    sigma = point_sigma(station)
    assert squares.mean() == pytest.approx(sigma**2, rel=4.0 * np.sqrt(2.0 / 320.0))


def test_what_gives_no_frame_is_refused():
    points = laser_of(BeamStation(beams_of(T_BASE_LASER, BETA_RAD))).points
    with pytest.raises(InputError, match="points B3, C1 are missing"):
        calibrate_laser({k: v for k, v in published().items() if k not in ("B3", "C1")})
    with pytest.raises(RankDeficientError, match=r"two points on the y-beam are 0\.00 mm apart"):
        LaserFrame(points[[0, 1, 2, 2]])
    with pytest.raises(RankDeficientError, match="the beams cross at"):
        LaserFrame(np.vstack([points[:2], points[:2] + 1e-4]))
    with pytest.raises(InputError, match=r"pass each other at 5\.00 mm"):
        LaserFrame(points + np.array([0, 0, 1, 1])[:, None] * 5e-3 * T_BASE_LASER[:3, 2])


unit = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 0.1)


@given(unit, unit)
def test_the_minimal_rotation_turns_one_into_the_other_by_their_angle(a, b):
    a, b = (np.array(v) / np.linalg.norm(v) for v in (a, b))
    R = minimal_rotation(a, b)
    assert R @ a == pytest.approx(b, abs=1e-7)
    angle = np.arctan2(np.linalg.norm(np.cross(a, b)), a @ b)
    assert np.linalg.norm(frames.log_rotation(R)) == pytest.approx(angle, abs=1e-6)


@given(unit)
def test_a_first_rotation_is_the_minimal_one_from_z(v):
    v = np.array(v) / np.linalg.norm(v)
    if v[2] > -0.999:
        assert first_rotation(v) == pytest.approx(minimal_rotation([0, 0, 1], v), abs=1e-7)


@pytest.mark.parametrize("z", [1.0, -1.0])
def test_a_first_rotation_along_z_divides_by_nothing(z):
    R = first_rotation([0.0, 0.0, z], spin_rad=0.3)
    assert R[:, 2] == pytest.approx([0.0, 0.0, z], abs=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    if z > 0.0:
        assert pytest.approx(np.eye(3)) == R


def test_the_sources_bent_tool_points_along_its_tip():
    """The third row of the published rotation (5-6) is the axis, its third column is not."""
    tip = np.array([-13.2159, 18.2912, 152.3880])
    axis = np.array([-0.0857, 0.1187, 0.9892])
    R = first_rotation(axis / np.linalg.norm(axis))
    assert R[:, 2] @ tip / np.linalg.norm(tip) == pytest.approx(1.0, abs=2e-6)
    published = [[0.9963, 0.0051, 0.0857], [0.0051, 0.9929, -0.1187], [-0.0857, 0.1187, 0.9892]]
    assert pytest.approx(np.array(published), abs=1e-4) == R.T


def test_the_taught_turn_about_the_axis_stays():
    taught = frames.exp_rotation([0.1, -0.2, 0.8])
    axis = frames.exp_rotation([0.05, 0.07, 0.0]) @ taught[:, 2]
    new = retaught(taught, axis)
    assert new[:, 2] == pytest.approx(axis)
    between = frames.log_rotation(new @ taught.T)
    assert between @ taught[:, 2] == pytest.approx(0.0, abs=1e-12)  # no turn about the axis


def two_centres(v_flange, order):
    """Where a straight tool passes the beam plane at two heights of the flange."""
    laser = laser_of(BeamStation(beams_of(T_BASE_LASER, BETA_RAD)))
    R = laser.T_base_laser[:3, :3] @ np.diag([1.0, -1.0, -1.0]) @ frames.exp_rotation([0, 0, 0.4])
    poses, centres = [], []
    for height in order:
        place = laser.T_base_laser @ np.array([0.001, -0.002, height, 1.0])
        T_laser_flange = frames.invert(laser.T_base_laser) @ frames.transform(R, place[:3])
        v, t = T_laser_flange[:3, :3] @ v_flange, T_laser_flange[:3, 3]
        poses.append(frames.transform(R, place[:3]))
        centres.append((t - t[2] / v[2] * v)[:2])
    return laser, tuple(poses), tuple(centres)


@pytest.mark.parametrize("order", [(0.15, 0.10), (0.10, 0.15)])
def test_two_heights_give_the_axis(order):
    v = np.array([0.08, -0.05, 1.0]) / np.linalg.norm([0.08, -0.05, 1.0])
    laser, poses, centres = two_centres(v, order)
    assert axis_from_centres(laser, poses, centres) == pytest.approx(v, abs=1e-12)


def test_one_height_gives_none():
    laser, poses, centres = two_centres(np.array([0.0, 0.0, 1.0]), (0.15, 0.149))
    with pytest.raises(RankDeficientError, match=r"heights differ by 1\.00 mm"):
        axis_from_centres(laser, poses, centres)
    with pytest.raises(RankDeficientError, match="turn the flange until the tool stands upright"):
        axis_from_centres(laser, two_centres(np.array([0.0, 0.0, 1.0]), (0.15, 0.14))[1],
                          (np.array([0.02, 0.0]), np.zeros(2)))  # fmt: skip


def test_the_upright_pose_sets_the_axis_down_and_the_point_on_the_crossing():
    laser = laser_of(BeamStation(beams_of(T_BASE_LASER, BETA_RAD)))
    v = np.array([0.1, 0.05, 1.0]) / np.linalg.norm([0.1, 0.05, 1.0])
    T = upright_pose(laser, np.eye(4), v, [0.01, 0.02, 0.15])
    assert T[:3, :3] @ v == pytest.approx(-laser.T_base_laser[:3, 2])
    assert (T @ [0.01, 0.02, 0.15, 1.0])[:3] == pytest.approx(laser.T_base_laser[:3, 3])


POINTS = np.array(
    [[0.79367, -0.12861, 0.2], [0.80558, -0.12896, 0.2], [0.797, -0.1324, 0.2], [0.797, -0.12, 0.2]]
)
LASER = LaserFrame(POINTS, 3e-5, np.array([1e-4, -2e-4]))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "laser.yaml"


@pytest.mark.parametrize("serial", [None, "2016300001"])
def test_it_reads_back(path, serial):
    arm = load_robot("ur10")
    write_laser(path, LaserFile(LASER, "cell_1", arm.name, arm.model_hash, serial))
    found = read_laser_for(path, arm)
    assert (found.station, found.robot, found.serial) == ("cell_1", arm.name, serial)
    assert found.laser.points == pytest.approx(POINTS, rel=1e-15)
    assert found.laser.sigma_m == pytest.approx(3e-5, rel=1e-15)
    assert found.laser.reach == pytest.approx(LASER.reach, rel=1e-15)
    assert [p.name for p in path.parent.iterdir()] == ["laser.yaml"]
    with pytest.raises(WrongRobotError, match="place the beams with this robot file"):
        read_laser_for(path, load_robot("kr150_r3100"))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda d: d.pop("station"), "station is missing"),
        (lambda d: d.pop("reach_mm"), "reach_mm is missing"),
        (lambda d: d["points_mm"].pop("C"), "points_mm, C is missing"),
        (lambda d: d["points_mm"].update(C=[1.0, 2.0]), "points_mm, C must be a list of 3 numbers"),
        (lambda d: d["points_mm"].update(E=[0, 0, 0]), "points_mm, 'E' is not a known key"),
        (lambda d: d["reach_mm"].update(y=".nan"), "reach_mm, y is"),
        (lambda d: d.update(sigma_mm=-1.0), "sigma_mm is -1; it must not be below 0"),
        (lambda d: d.update(sigma_m=1.0), "'sigma_m' is not a known key .*sigma_mm"),
        (lambda d: d.update(model_hash=7), "model_hash must be a text"),
        (lambda d: d["points_mm"].update(B=d["points_mm"]["A"]), "points_mm: the two points on"),
        (lambda d: d["points_mm"].update(D=[801.0, -132.4, 203.0]), "points_mm: the beams"),
    ],
)
def test_a_wrong_file_names_its_key(path, change, words):
    write_laser(path, LaserFile(LASER, "cell_1", "r", "h"))
    document = yaml.safe_load(path.read_text())
    change(document)
    path.write_text(yaml.safe_dump(document))
    with pytest.raises(InputError, match=words) as refused:
        read_laser(path)
    assert refused.value.file == str(path)


def test_there_must_be_a_file(path):
    with pytest.raises(InputError, match="no such laser file"):
        read_laser(path)


@pytest.mark.parametrize(
    ("document", "words"),
    [
        ({"tcp_mm": [1, 2, 3]}, "quat_xyzw is missing or null"),
        ({"tcp_mm": None, "quat_xyzw": [0, 0, 0, 1]}, "tcp_mm has no value"),
        ({"tcp_mm": [1, 2, 3], "quat_xyzw": [0, 0, 1, 1]}, "quat_xyzw has length 1.41421"),
        ({"error": {}, "verdict": {}}, "error tells why no tool was found"),
        (
            {"tcp_mm": [1, 2, 3], "verdict": {"accept": False, "code": "LIMIT_EXCEEDED"}},
            "verdict is LIMIT_EXCEEDED: this tool was not accepted",
        ),
        (
            {"calibration": {"state": "rolled_back"}, "document": {"tcp_mm": [1, 2, 3]}},
            "calibration was rolled back: take one that is in force",
        ),
    ],
)
def test_a_tool_that_is_none_is_refused(tmp_path, document, words):
    path = tmp_path / "tool.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=words):
        read_tool(path)


def test_of_the_history_a_tool_has_the_orientation_that_it_comes_into_force_with(tmp_path):
    """Touches and sweeps have none in their document."""
    T = frames.transform(frames.exp_rotation([0.1, -0.2, 0.3]), [1e-3, 2e-3, 3e-3])
    path = tmp_path / "tool.json"
    shown = {"document": {"tcp_mm": [1, 2, 3]}, "model": {"T_flange_tool": T.tolist()}}
    path.write_text(json.dumps(shown))
    assert read_tool(path) == pytest.approx(T)
    assert read_tool(path, np.eye(3))[:3, :3] == pytest.approx(np.eye(3))


def test_an_orientation_is_given_once(tmp_path):
    path = tmp_path / "tool.json"
    path.write_text(json.dumps({"tcp_mm": [1, 2, 3], "quat_xyzw": [0, 0, 0, 1]}))
    assert read_tool(path)[:3, 3] == pytest.approx([1e-3, 2e-3, 3e-3])
    with pytest.raises(InputError, match="quat_xyzw is in the file: leave out roll"):
        read_tool(path, np.eye(3))
