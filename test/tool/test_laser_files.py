"""Laser files and files of tools: what is written is read; what is wrong is named."""

import json

import numpy as np
import pytest
import yaml

from robocal_ros.ground.errors import InputError, WrongRobotError
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.tool.files import read_tool
from robocal_ros.tool.laser_frame import (
    LaserFile,
    LaserFrame,
    read_laser,
    read_laser_for,
    write_laser,
)

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
    ],
)
def test_a_tool_that_is_none_is_refused(tmp_path, document, words):
    path = tmp_path / "tool.json"
    path.write_text(json.dumps(document))
    with pytest.raises(InputError, match=words):
        read_tool(path)


def test_an_orientation_is_given_once(tmp_path):
    path = tmp_path / "tool.json"
    path.write_text(json.dumps({"tcp_mm": [1, 2, 3], "quat_xyzw": [0, 0, 0, 1]}))
    assert read_tool(path)[:3, 3] == pytest.approx([1e-3, 2e-3, 3e-3])
    with pytest.raises(InputError, match="quat_xyzw is in the file: leave out roll"):
        read_tool(path, np.eye(3))
