# SPDX-License-Identifier: Apache-2.0
"""URDF to an arm and an arm into a URDF: the same flange, to a nanometre and a nanoradian."""

import json
import xml.etree.ElementTree as ElementTree
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from command import conforms
from drawn_arms import arms
from hypothesis import given
from hypothesis import strategies as st
from joint_errors import with_joint_errors

from robocal_ros.cli.main import main
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import exp_rotation, transform
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import JointFunctions
from robocal_ros.kinematics.robots import load_description, load_robot, robot_folders
from robocal_ros.kinematics.universal_robots import JOINT_NAMES, factory_arm, parse_settings
from robocal_ros.kinematics.urdf import (
    AT_MOST,
    AT_PRESENT,
    arm_of,
    chain,
    model_difference,
    origins_of,
    read_urdf,
    ur_chain,
    ur_kinematics,
    urdf_of,
    urdf_with,
)

EXACT = 1e-9  # m and rad, the goal
SHIPPED = sorted(file.stem for folder in robot_folders() for file in folder.glob("*.yaml"))

# An arm as descriptions write it: a base beside the root, axes along x and y, a fixed joint between
# moving ones, a link that carries the flange, a gripper beside it.
DESCRIPTION = """<?xml version="1.0"?>
<robot name="bench_arm">
  <!-- kept -->
  <link name="base_link"/>
  <link name="base"/>
  <joint name="base_joint" type="fixed">
    <origin xyz="0 0 0" rpy="0 0 3.141592653589793"/>
    <parent link="base_link"/><child link="base"/>
  </joint>
  <joint name="turn" type="revolute">
    <origin xyz="0 0 0.4" rpy="0 0 0"/><parent link="base_link"/><child link="column"/>
    <axis xyz="0 0 -1"/><limit lower="-2.9" upper="2.9" velocity="2.0" effort="10"/>
  </joint>
  <link name="column"><inertial><origin xyz="0 0.01 0.1"/><mass value="8"/></inertial></link>
  <joint name="lift" type="revolute">
    <origin xyz="0.1 0.02 0.2" rpy="0 0 0"/><parent link="column"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1.5" upper="2.0" velocity="2.0" effort="10"/>
  </joint>
  <link name="upper"><inertial><origin xyz="0 0 0.3"/><mass value="6"/></inertial></link>
  <joint name="elbow" type="revolute">
    <origin xyz="0 -0.03 0.7" rpy="0 0 0"/><parent link="upper"/><child link="bracket"/>
    <axis xyz="0 1 0"/><limit lower="-2.0" upper="1.5" velocity="2.5" effort="10"/>
  </joint>
  <link name="bracket"/>
  <joint name="bracket_joint" type="fixed">
    <origin xyz="0.05 0 0.1" rpy="0 1.5707963267948966 0"/>
    <parent link="bracket"/><child link="fore"/>
  </joint>
  <link name="fore"><inertial><origin xyz="0 0 0.2"/><mass value="4"/></inertial></link>
  <joint name="roll" type="continuous">
    <origin xyz="0 0 0.5" rpy="0 0 0"/><parent link="fore"/><child link="wrist"/>
    <axis xyz="0 0 1"/><limit velocity="6.0" effort="10"/>
  </joint>
  <link name="wrist"/>
  <joint name="bend" type="revolute">
    <origin xyz="0 0 0.1" rpy="0 0 0"/><parent link="wrist"/><child link="hand"/>
    <axis xyz="1 0 0"/><limit lower="-2.1" upper="2.1" velocity="6.0" effort="10"/>
  </joint>
  <link name="hand"/>
  <joint name="spin" type="revolute">
    <origin xyz="0 0 0.08" rpy="0 0 0"/><parent link="hand"/><child link="disc"/>
    <axis xyz="0 0 1"/><limit lower="-6.0" upper="6.0" velocity="8.0" effort="10"/>
  </joint>
  <link name="disc"/>
  <joint name="disc-tool0" type="fixed">
    <origin xyz="0 0 0.02" rpy="0.3 0 0.4"/><parent link="disc"/><child link="tool0"/>
  </joint>
  <link name="tool0"/>
  <joint name="finger_joint" type="prismatic">
    <parent link="tool0"/><child link="finger"/><axis xyz="1 0 0"/>
    <limit lower="0" upper="0.04" velocity="0.1" effort="5"/>
  </joint>
  <link name="finger"/>
</robot>
"""


def drawn_q(arm: SerialArm, count: int, seed: int = 0) -> np.ndarray:
    low, high = np.maximum(arm.lower, -3.0), np.minimum(arm.upper, 3.0)
    return np.random.default_rng(seed).uniform(low, high, (count, arm.n))


def changed(arm: SerialArm, seed: int, size: float = 1e-3) -> SerialArm:
    step = size * np.random.default_rng(seed).normal(size=len(arm.parameters))
    return arm.with_mdh(arm.parameters.add(arm.mdh, step))


def test_an_arm_of_a_description_has_its_flange_limits_and_masses():
    links = chain(read_urdf(DESCRIPTION, "arm.urdf"))
    assert (links.base, links.tip) == ("base", "tool0")
    found = arm_of(links)
    arm, q = found.arm, drawn_q(found.arm, 1000)
    there = np.array([links.fk(row) for row in q])
    assert np.abs(arm.fk(q) - there).max() < EXACT
    assert arm.joint_names == ("turn", "lift", "elbow", "roll", "bend", "spin")
    assert np.array_equal(found.max_velocity, [2.0, 2.0, 2.5, 6.0, 6.0, 8.0])
    assert np.isinf(arm.lower[3])
    assert (arm.lower[0], arm.upper[2]) == (-2.9, 1.5)
    assert len(arm.parameters) == 24  # six joints, one pair of parallel axes
    assert arm.load is not None
    assert np.array_equal(arm.load.mass, [8.0, 6.0, 4.0, 0.0, 0.0, 0.0])


def test_masses_pull_at_the_joints_as_they_do_in_the_description():
    """Torque about an axis from the centres of mass, placed link by link."""
    links = chain(read_urdf(DESCRIPTION, "arm.urdf"))
    arm = arm_of(links).arm
    n, q = arm.n, drawn_q(arm, 20)
    wound = JointFunctions(np.zeros(n), np.ones(n), np.zeros((n, 4)), np.full(n, 1e-6))
    compliant = replace(arm, functions=wound)
    gravity = np.array([0.0, 0.0, -9.80665])
    for row in q:
        T, values, axes, pulls = links.T_base_root, iter(row), [], []
        for joint in links.joints:
            T = T @ joint.T_parent_child
            if joint.moves:
                axes.append((T[:3, :3] @ joint.axis, T[:3, 3]))
                T = T @ transform(exp_rotation(joint.axis * next(values)), np.zeros(3))
            if joint.child in links.urdf.masses and axes:
                mass, centre = links.urdf.masses[joint.child]
                pulls.append((len(axes), mass, (T @ [*centre, 1.0])[:3]))
        torque = [
            sum(w @ np.cross(c - p, mass * gravity) for carried, mass, c in pulls if carried > i)
            for i, (w, p) in enumerate(axes)
        ]
        assert np.allclose((compliant.turned(row) - row) / 1e-6, torque, atol=1e-6)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_robots_go_there_and_back(name):
    described = load_description(name)
    arm = described.arm
    links = chain(read_urdf(urdf_of(arm, described.max_velocity), name))
    back = arm_of(links)
    q = drawn_q(arm, 1000)
    assert np.abs(back.arm.fk(q) - arm.fk(q)).max() < EXACT
    assert len(back.arm.parameters) == len(arm.parameters)
    assert np.allclose(back.max_velocity, described.max_velocity, equal_nan=True)
    known = np.isfinite(arm.lower)  # a slide without limits has a kilometre: a URDF needs some
    assert np.allclose(back.arm.lower[known], arm.lower[known])
    other = changed(arm, 3)
    again = chain(read_urdf(urdf_with(urdf_of(arm), links, other), name))
    assert max(np.abs(again.fk(row) - other.fk(row)).max() for row in q[:20]) < EXACT
    assert np.abs(arm_of(again).arm.fk(q) - other.fk(q)).max() < EXACT


def test_a_speed_that_is_not_known_is_written_as_0_and_read_as_not_known():
    """urdfdom, and who reads by it, refuse a limit without speed and effort."""
    arm = load_robot("ur10")
    known = np.array([1.0, np.nan, 2.0, np.nan, np.nan, 3.0])
    for speeds in (known, None):
        text = urdf_of(arm, speeds)
        limits = [joint.find("limit") for joint in ElementTree.fromstring(text).findall("joint")]
        given = [limit.attrib for limit in limits if limit is not None]
        assert len(given) == arm.n
        assert all(set(one) == {"lower", "upper", "effort", "velocity"} for one in given)
        told = np.full(arm.n, np.nan) if speeds is None else speeds
        np.testing.assert_array_equal(arm_of(chain(read_urdf(text, "a"))).max_velocity, told)


@given(arms())
def test_any_arm_goes_there_and_back(drawn):
    arm, q = drawn
    links = chain(read_urdf(urdf_of(arm), "drawn"))
    assert np.abs(links.fk(q) - arm.fk(q)).max() < EXACT
    assert np.abs(arm_of(links).arm.fk(q) - arm.fk(q)).max() < EXACT


def test_an_identified_arm_takes_a_descriptions_links_along_least():
    """All that is no origin on the way to the flange stays, the comment too."""
    links = chain(read_urdf(DESCRIPTION, "arm.urdf"))
    other = changed(arm_of(links).arm, 1)
    text = urdf_with(DESCRIPTION, links, other)
    again = chain(read_urdf(text, "out.urdf"))
    q = drawn_q(other, 200)
    assert max(np.abs(again.fk(row) - other.fk(row)).max() for row in q) < EXACT
    moved = [np.abs(a - b).max() for a, b in zip(again.at_zero, links.at_zero, strict=True)]
    # 24 parameters off by 1 mm or 1 mrad, which is 1.5 mm at this reach: four standard deviations.
    assert max(moved) < 4 * np.sqrt(24) * 1.5e-3
    before, after = (ElementTree.fromstring(part) for part in (DESCRIPTION, text))
    for joint in before.findall("joint"):
        if joint.get("name") in {"base_joint", "bracket_joint", "finger_joint"}:
            same = next(j for j in after.findall("joint") if j.get("name") == joint.get("name"))
            assert [e.attrib for e in joint] == [e.attrib for e in same]
    assert "<!-- kept -->" in text
    assert 'mass value="8"' in text


@pytest.mark.parametrize("name", SHIPPED)
def test_a_description_of_the_same_arm_does_not_differ(name):
    arm = with_joint_errors(load_robot(name), 1)  # what a URDF has no place for
    assert model_difference(chain(read_urdf(urdf_of(arm), name)), arm, drawn_q(arm, 1)[0]) is None


@given(arms(), st.integers(0, 5), st.sampled_from(("d", "a")), st.floats(2e-4, 0.1))
def test_a_longer_link_is_found_wherever_the_robot_stands(drawn, link, which, by_m):
    """One length differs: the flange is off by it in each pose, and the axes before it agree."""
    arm, q = drawn
    link = link % arm.n
    mdh = arm.mdh.copy()
    mdh[link, ["d", "theta", "a"].index(which)] += by_m
    links = chain(read_urdf(urdf_of(arm.with_mdh(mdh)), "drawn"))
    found = model_difference(links, arm, q)
    assert found is not None
    (off_m, off_rad), (most_m, most_rad) = found.flange[AT_PRESENT], found.flange[AT_MOST]
    assert (off_m, most_m) == (pytest.approx(by_m, abs=EXACT), pytest.approx(by_m, abs=EXACT))
    assert max(off_rad, most_rad) < EXACT  # rad: the same at a metre
    names = [*arm.joint_names, "flange"]
    behind = [name for name in names[link + 1 :] if f"'{name}'" in found.where]
    assert behind  # no axis up to it is named as off


def test_a_joint_that_counts_the_other_way_differs_where_it_stands_at_zero():
    """There the flange agrees, and both axes are the same line: their directions are not."""
    arm = load_robot("ur10")
    other = replace(arm, sign=np.where(np.arange(6) == 2, -1.0, 1.0))
    found = model_difference(chain(read_urdf(urdf_of(other), "other")), arm, np.zeros(6))
    assert found is not None
    assert found.flange[AT_PRESENT] == pytest.approx((0.0, 0.0), abs=EXACT)
    # the forearm and the wrist turn about the elbow by up to half a turn the other way
    assert found.flange[AT_MOST][0] > 0.5
    assert found.where == (
        "they differ behind 'shoulder_lift_joint': the axis of 'elbow_joint' is 0.000 mm and "
        "180.0000 deg off"
    )


def test_other_joints_are_another_robot():
    arm = load_robot("ur10")
    left = replace(arm, joint_names=tuple(f"left_{name}" for name in arm.joint_names))
    found = model_difference(chain(read_urdf(urdf_of(left), "left")), arm)
    assert found is not None
    assert str(found).startswith("its joints are left_shoulder_pan_joint, ")


UR5E = {  # config/ur5e/default_kinematics.yaml of Universal_Robots_ROS2_Description
    "shoulder": (0, 0, 0.1625, 0, 0, 0),
    "upper_arm": (0, 0, 0, 1.570796327, 0, 0),
    "forearm": (-0.425, 0, 0, 0, 0, 0),
    "wrist_1": (-0.3922, 0, 0.1333, 0, 0, 0),
    "wrist_2": (0, -0.0997, -2.044881182297852e-11, 1.570796327, 0, 0),
    "wrist_3": (0, 0.0996, -2.042830148012698e-11, 1.570796326589793, 3.141592653589793,
                3.141592653589793),
}  # fmt: skip
KEYS = ("x", "y", "z", "roll", "pitch", "yaw")


def kinematics() -> dict[str, Any]:
    return {"kinematics": {k: dict(zip(KEYS, map(float, v), strict=True)) for k, v in UR5E.items()}}


@pytest.mark.data
def test_a_factory_calibration_goes_into_a_kinematics_yaml_and_back(data_dir):
    folder = data_dir / "ur5e_factory"
    read = [
        parse_settings((folder / name).read_text(), name)
        for name in ("urcontrol.conf.UR5", "calibration.conf")
    ]
    factory = factory_arm(read[0], read[1], "ur5e")
    values, beyond = ur_kinematics(ur_chain(kinematics(), "k.yaml"), factory)
    back = ur_chain({"kinematics": values}, "calibrated.yaml")
    q = drawn_q(factory, 1000)
    there = np.array([back.fk(row) @ beyond for row in q])
    assert np.abs(there - factory.fk(q)).max() < EXACT
    assert np.abs(beyond - np.eye(4)).max() < EXACT  # the factory calibrates no flange
    arm = arm_of(back).arm
    assert arm.joint_names == JOINT_NAMES
    assert np.abs(arm.fk(q) - factory.fk(q)).max() < EXACT


def test_a_kinematics_yaml_is_the_nominal_arm():
    arm = arm_of(ur_chain(kinematics(), "k.yaml"), "ur5e").arm
    lengths = np.sort(np.abs(arm.mdh[:, [0, 2]]).ravel())[-6:]
    assert np.allclose(lengths, np.sort([0.1625, 0.425, 0.3922, 0.1333, 0.0997, 0.0996]), atol=1e-9)


RING = (
    '<link name="a"/><link name="b"/>'
    '<joint name="ab" type="fixed"><parent link="a"/><child link="b"/></joint>'
    '<joint name="ba" type="fixed"><parent link="b"/><child link="a"/></joint></robot>'
)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("<robot", "is no XML"),
        ("<sdf/>", "not 'robot'"),
        ('<robot xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro/></robot>', "expand it"),
        (DESCRIPTION.replace('xyz="0 0 0.4"', 'xyz="0 0"'), "not 3 finite numbers"),
        (DESCRIPTION.replace('xyz="0 0 0.4"', 'xyz="0 0 nan"'), "not 3 finite numbers"),
        (DESCRIPTION.replace('<axis xyz="0 0 -1"/>', '<axis xyz="0 0 0"/>'), "of no length"),
        (DESCRIPTION.replace('<child link="column"/>', ""), "lacks its parent or child"),
        (DESCRIPTION.replace('"turn" type="revolute"', '"turn" type="floating"'), "floating"),
        (DESCRIPTION.replace('link name="base_link"', 'link name="other"'), "no link base_link"),
        (DESCRIPTION.replace("</robot>", '<link name="loose"/></robot>'), "one root"),
        (DESCRIPTION.replace("</robot>", RING), "one root"),
        (DESCRIPTION.replace('velocity="', 'velocity="fast'), "velocity 'fast.*' is no number"),
        (DESCRIPTION.replace(' lower="-', ' lower="'), "it cannot move"),
        (DESCRIPTION.replace('<mass value="', '<mass value="-'), "has the mass -"),
        (DESCRIPTION.replace('<axis xyz="0 0 -1"/>', '<mimic joint="a"/>'), "mimic"),
        (DESCRIPTION.replace('joint name="turn"', "joint"), "without a name"),
    ],
)
def test_what_is_no_arm_is_named(text, words):
    with pytest.raises(InputError, match=words):
        chain(read_urdf(text, "bad.urdf"))


def test_links_that_cannot_be_ends_are_named():
    urdf = read_urdf(DESCRIPTION.replace('"tool0"', '"mount"'), "arm.urdf")
    with pytest.raises(InputError, match="has no link 'wirst'"):
        chain(urdf, tip="wirst")
    with pytest.raises(InputError, match="no joint moves 'base_link'"):
        chain(urdf, base="base", tip="base_link")
    links = chain(urdf, tip="disc")
    with pytest.raises(InputError, match="moved by its joint"):
        origins_of(links, arm_of(links).arm)
    with pytest.raises(InputError, match="has the joints turn"):
        origins_of(links, load_robot("ur10"))


def command(capsys: pytest.CaptureFixture[str], *words: object) -> tuple[int, Any]:
    status = main([*map(str, words), "--json"])
    document = json.loads(capsys.readouterr().out)
    conforms(document, f"{words[0]}.json")
    return status, document


def test_the_commands_go_there_and_back(tmp_path: Path, capsys):
    urdf, robot, out = tmp_path / "arm.urdf", tmp_path / "arm.yaml", tmp_path / "out.urdf"
    urdf.write_text(DESCRIPTION)
    status, document = command(capsys, "import-urdf", urdf, "--output", robot)
    assert status == 0
    assert document["conversion_error_mm"] < 1e-6
    assert document["warnings"] == []
    arm = load_robot(robot)
    assert arm.load is not None
    status, document = command(
        capsys, "export-urdf", "--robot", robot, "--into", urdf, "--output", out
    )
    assert status == 0
    assert document["conversion_error_mm"] < 1e-6
    status, document = command(
        capsys, "export-urdf", "--robot", robot, "--into", urdf, "--output", out
    )
    assert status == 2
    assert "is there already" in document["error"]["message"]


def test_what_a_kinematics_yaml_cannot_hold_is_told(tmp_path: Path, capsys):
    """The identified flange lies beside the last axis; joint functions have no place at all."""
    given, robot, out = tmp_path / "k.yaml", tmp_path / "r.yaml", tmp_path / "out.yaml"
    given.write_text(yaml.safe_dump(kinematics()))
    status, document = command(capsys, "import-urdf", given, "--output", robot)
    assert status == 0
    assert "no speed limit" in document["warnings"][0]
    from robocal_ros.kinematics.robots import save_robot

    identified = with_joint_errors(changed(load_robot(robot), 2), 1)
    save_robot(identified, tmp_path / "identified.yaml")
    status, document = command(
        capsys, "export-urdf", "--robot", tmp_path / "identified.yaml", "--into", given,
        "--output", out,
    )  # fmt: skip
    assert status == 0
    assert document["conversion_error_mm"] < 1e-6
    words = " ".join(document["warnings"])
    assert "joint functions and compliances" in words
    assert "has no place: add" in words
    assert np.linalg.norm(document["T_tip_flange"]["xyz_mm"]) > 0.1
