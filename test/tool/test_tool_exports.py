# SPDX-License-Identifier: Apache-2.0
"""A tool's frame as controllers write it, read back along another way: scipy's own conventions."""

import re
import xml.etree.ElementTree as ET

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from robocal_ros.ground import frames
from robocal_ros.programs.conventions import Load
from robocal_ros.tool.files import exported

NUMBER = r"-?\d+(?:\.\d+)?"
TURNS = [
    *Rotation.random(20, random_state=5).as_matrix(),
    np.eye(3),
    np.diag([1.0, -1.0, -1.0]),
    np.diag([-1.0, 1.0, -1.0]),
    *(Rotation.from_euler("ZYX", [40.0, p, 25.0], degrees=True).as_matrix() for p in (90, -90)),
]
PRINTED_MM, PRINTED_RAD = 1e-3, np.radians(2e-5)  # what four decimals and five leave, with room


def numbers(text: str) -> list[float]:
    return [float(found) for found in re.findall(NUMBER, text)]


def of_kuka(text: str) -> tuple[list[float], Rotation]:
    pattern = r"\$TOOL=\{X (.*),Y (.*),Z (.*),A (.*),B (.*),C (.*)\}"
    x, y, z, *abc = map(float, re.fullmatch(pattern, text).groups())
    return [x, y, z], Rotation.from_euler("ZYX", abc, degrees=True)


def of_fanuc(text: str) -> tuple[list[float], Rotation]:
    x, y, z, *wpr = numbers(text)
    assert re.sub(NUMBER, "#", text) == "X #  Y #  Z #\nW #  P #  R #"
    return [x, y, z], Rotation.from_euler("xyz", wpr, degrees=True)


def of_abb(text: str) -> tuple[list[float], Rotation]:
    remark, line = text.split("\n")
    assert remark.startswith("! mass and centre of gravity are placeholders")
    head, tail = "PERS tooldata tcp:=[TRUE,", ",[1,[0,0,1],[1,0,0,0],0,0,0]];"
    assert line.startswith(head)
    assert line.endswith(tail)
    x, y, z, q1, q2, q3, q4 = numbers(line.removeprefix(head).removesuffix(tail))
    assert np.hypot(np.hypot(q1, q2), np.hypot(q3, q4)) == pytest.approx(1.0, abs=1e-8)
    return [x, y, z], Rotation.from_quat([q2, q3, q4, q1])


def of_ur(text: str) -> tuple[list[float], Rotation]:
    x, y, z, *vector = map(float, re.fullmatch(r"set_tcp\(p\[(.*)\]\)", text)[1].split(","))
    return [1e3 * x, 1e3 * y, 1e3 * z], Rotation.from_rotvec(vector)


def of_urdf(text: str) -> tuple[list[float], Rotation]:
    joint = ET.fromstring(f"<robot>{text}</robot>").find("joint")
    assert joint.get("type") == "fixed"
    assert (joint.find("parent").get("link"), joint.find("child").get("link")) == ("tool0", "tcp")
    xyz, rpy = ([float(v) for v in joint.find("origin").get(k).split()] for k in ("xyz", "rpy"))
    return [1e3 * v for v in xyz], Rotation.from_euler("xyz", rpy)


def of_kawasaki(text: str) -> tuple[list[float], Rotation]:
    x, y, z, *oat = map(float, re.fullmatch(r"TOOL TRANS\((.*)\)", text)[1].split(","))
    return [x, y, z], Rotation.from_euler("ZYZ", oat, degrees=True)


READERS = {
    "kawasaki": of_kawasaki,
    "urdf": of_urdf,
    "kuka": of_kuka,
    "abb": of_abb,
    "fanuc": of_fanuc,
    "ur": of_ur,
}


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("R", TURNS)
def test_it_reads_back(name, R):
    place_mm = np.array([-13.2159, 18.2912, 152.388])
    place, turn = READERS[name](exported(frames.transform(R, 1e-3 * place_mm), name))
    assert place == pytest.approx(place_mm, abs=PRINTED_MM)
    assert (turn * Rotation.from_matrix(R).inv()).magnitude() < PRINTED_RAD


def test_each_controllers_own_names_of_the_angles():
    """Turned by 10 deg about x, then 20 about the fixed y, then 30 about the fixed z."""
    about = {"x": 10.0, "y": 20.0, "z": 30.0}
    Rx, Ry, Rz = (Rotation.from_euler(axis, angle, degrees=True) for axis, angle in about.items())
    T = frames.transform((Rz * Ry * Rx).as_matrix(), np.zeros(3))
    assert exported(T, "kuka").endswith("A 30.00000,B 20.00000,C 10.00000}")
    assert exported(T, "fanuc").endswith("W 10.00000  P 20.00000  R 30.00000")


def test_abb_as_in_its_manual():
    """The gripper of the RAPID manual: x and z turned by 45 deg, 5 kg, centre (23, 0, 75) mm."""
    R = Rotation.from_euler("y", 45.0, degrees=True).as_matrix()
    T = frames.transform(R, [0.0974, 0.0, 0.2231])
    text = exported(T, "abb", Load(5.0, (0.023, 0.0, 0.075)))
    gripper = [97.4, 0, 223.1, 0.924, 0, 0.383, 0, 5, 23, 0, 75, 1, 0, 0, 0, 0, 0, 0]
    assert numbers(text) == pytest.approx(gripper, abs=5e-4)


def test_a_zero_has_no_sign():
    T = frames.transform(np.eye(3), [-1e-12, 0.0, 0.1])
    for name in READERS:
        assert "-0.0" not in exported(T, name)
