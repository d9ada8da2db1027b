"""A sensor's place as robot descriptions write it, read back along another way."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.hand_eye.files import exported

TURNS = [
    *Rotation.random(20, random_state=7).as_matrix(),
    np.eye(3),
    np.diag([1.0, -1.0, -1.0]),
    *(Rotation.from_euler("ZYX", [40.0, p, 25.0], degrees=True).as_matrix() for p in (90, -90)),
]
PLACE = np.array([0.0123456, -0.2, 1.5])
PRINTED_M, PRINTED_RAD = 1e-7, 1e-7
XACRO = "http://www.ros.org/wiki/xacro"


def agrees(xyz, rotation: Rotation, turn: np.ndarray) -> None:
    assert np.array(xyz) == pytest.approx(PLACE, abs=PRINTED_M)
    assert (Rotation.from_matrix(turn).inv() * rotation).magnitude() < PRINTED_RAD


def of_joint(joint: ET.Element) -> tuple[list[float], Rotation]:
    assert joint.attrib == {"name": "tool0-laser", "type": "fixed"}
    assert joint.find("parent").attrib["link"] == "tool0"
    assert joint.find("child").attrib["link"] == "laser"
    origin = joint.find("origin").attrib
    xyz, rpy = ([float(x) for x in origin[name].split()] for name in ("xyz", "rpy"))
    return xyz, Rotation.from_euler("xyz", rpy)


@pytest.mark.parametrize("turn", TURNS)
def test_urdf_and_xacro_are_read_back(turn):
    T = frames.transform(turn, PLACE)
    robot = ET.fromstring(f"<robot>{exported(T, 'tool0', 'laser', 'urdf')}</robot>")
    assert robot.find("link").attrib["name"] == "laser"
    agrees(*of_joint(robot.find("joint")), turn)
    text = f'<robot xmlns:xacro="{XACRO}">{exported(T, "tool0", "laser", "xacro")}</robot>'
    for given in ET.fromstring(text).findall(f"{{{XACRO}}}property"):
        text = text.replace(f"${{{given.attrib['name']}}}", given.attrib["value"])
    agrees(*of_joint(ET.fromstring(text).find("joint")), turn)


@pytest.mark.parametrize("turn", TURNS)
def test_a_static_transform_is_read_back(turn):
    found = yaml.safe_load(exported(frames.transform(turn, PLACE), "base", "cell/laser", "yaml"))
    assert found["header"]["frame_id"] == "base"
    assert found["child_frame_id"] == "cell/laser"
    t, r = found["transform"]["translation"], found["transform"]["rotation"]
    rotation = Rotation.from_quat([r[name] for name in "xyzw"])
    agrees([t[name] for name in "xyz"], rotation, turn)


@pytest.mark.parametrize("turn", TURNS)
def test_a_command_line_is_read_back(turn):
    text = exported(frames.transform(turn, PLACE), "tool0", "laser", "static-transform")
    program, *words = text.split(" --")
    assert program == "ros2 run tf2_ros static_transform_publisher"
    given = dict(word.split() for word in words)
    assert (given.pop("frame-id"), given.pop("child-frame-id")) == ("tool0", "laser")
    rotation = Rotation.from_quat([float(given[f"q{axis}"]) for axis in "xyzw"])
    agrees([float(given[axis]) for axis in "xyz"], rotation, turn)


@pytest.mark.parametrize("name", ["", 'a"b', "two words", "a: b", "<x>"])
def test_a_name_that_would_break_the_text_is_refused(name):
    with pytest.raises(InputError, match="no name of a frame"):
        exported(np.eye(4), "tool0", name, "urdf")
