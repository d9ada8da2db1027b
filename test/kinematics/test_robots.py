# SPDX-License-Identifier: Apache-2.0
"""Robot files: the shipped ones, reading, writing, looking up, and every way to get one wrong."""

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad, JointFunctions
from robocal_ros.kinematics.robots import (
    find_robot,
    load_description,
    load_robot,
    robot_folders,
    save_robot,
)

SHIPPED = ("bx200l", "kr150_r3100", "ur10")

GOOD = """\
robot: test arm
convention: mdh
joints:
  - {name: one, sign: -1, d_mm: 100, theta_deg: 90, a_mm: 20, alpha_deg: 1e0, beta_deg: 0.5,
     lower_deg: -90, upper_deg: 180, max_velocity_deg_s: 90, max_acceleration_deg_s2: 180}
  - {name: two, type: prismatic, d_mm: 1e1, theta_deg: 0, a_mm: 0, alpha_deg: -90,
     lower_mm: -5, upper_mm: 500, max_velocity_mm_s: 250}
base: {xyz_mm: [1, 2, 3], rpy_deg: [0, 0, 90]}
tool: {xyz_mm: [0, 0, 50], quat_xyzw: [0, 0, 0, 1]}
"""


def write(tmp_path: Path, text: str) -> Path:
    path = tmp_path / "arm.yaml"
    path.write_text(text)
    return path


def test_every_key_is_read_in_si(tmp_path: Path) -> None:
    description = load_description(write(tmp_path, GOOD))
    arm = description.arm
    assert (arm.name, arm.joint_names) == ("test arm", ("one", "two"))
    expected = [[0.1, np.pi / 2, 0.02, np.pi / 180, np.pi / 360], [0.01, 0, 0, -np.pi / 2, 0]]
    np.testing.assert_allclose(arm.mdh, expected, rtol=1e-15)
    assert arm.sign.tolist() == [-1.0, 1.0]
    assert arm.prismatic.tolist() == [False, True]
    np.testing.assert_allclose(arm.lower, [-np.pi / 2, -0.005], rtol=1e-15)
    np.testing.assert_allclose(arm.upper, [np.pi, 0.5], rtol=1e-15)
    np.testing.assert_allclose(description.max_velocity, [np.pi / 2, 0.25], rtol=1e-15)
    # the second joint's is the rule's: full speed in 0.5 s
    np.testing.assert_allclose(description.max_acceleration, [np.pi, 0.5], rtol=1e-15)
    assert description.acceleration_assumed.tolist() == [False, True]
    np.testing.assert_allclose(arm.T_base_root[:3, 3], [1e-3, 2e-3, 3e-3], rtol=1e-15)
    np.testing.assert_allclose(arm.T_base_root[:3, 0], [0, 1, 0], atol=1e-15)
    assert arm.T_flange_tool[:3, 3].tolist() == [0, 0, 0.05]
    assert description.notes == ()


def test_rpy_turns_about_the_fixed_axes_as_in_urdf(tmp_path: Path) -> None:
    text = GOOD.replace("[0, 0, 90]", "[30, 40, 50]")
    R = load_robot(write(tmp_path, text)).T_base_root[:3, :3]
    r, p, y = np.radians([30, 40, 50])
    # first column and last row of Rz(y) Ry(p) Rx(r), written out
    np.testing.assert_allclose(
        R[:, 0], [np.cos(y) * np.cos(p), np.sin(y) * np.cos(p), -np.sin(p)], atol=1e-15
    )
    np.testing.assert_allclose(
        R[2], [-np.sin(p), np.cos(p) * np.sin(r), np.cos(p) * np.cos(r)], atol=1e-15
    )


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_robots_have_limits_around_their_check_pose(name: str) -> None:
    description = load_description(name)
    assert description.notes == ()
    pose = {"bx200l": (90, 0, 0, 0, 0, 0), "kr150_r3100": (0, -90, 90, 0, 0, 0)}
    q = np.radians(pose.get(name, (0, 0, 0, 0, 0, 0)))
    assert np.all((description.arm.lower <= q) & (q <= description.arm.upper))
    assert len(description.arm.parameters) == 24


@pytest.mark.parametrize("name", [*SHIPPED, "p1r2p3"])
def test_shipped_robots_have_speeds_and_accelerations(name: str) -> None:
    description = load_description(name)
    assert np.all(description.max_velocity > 0.0)
    np.testing.assert_allclose(description.max_acceleration, 2.0 * description.max_velocity)
    assert description.acceleration_assumed.all()  # none is published
    comment = description.path.read_text().split("robot:")[0]
    assert "0.5 s" in comment.replace("\n# ", " ")


def test_the_makers_speeds_are_in_the_files() -> None:
    kuka = np.degrees(load_description("kr150_r3100").max_velocity)
    np.testing.assert_allclose(kuka, [105, 107, 114, 179, 172, 219])
    ur = np.degrees(load_description("ur10").max_velocity)
    np.testing.assert_allclose(ur, [120, 120, 180, 180, 180, 180])


def test_a_speed_that_is_not_given_is_nan_and_invents_no_acceleration(tmp_path: Path) -> None:
    text = GOOD.replace(", max_velocity_mm_s: 250", "").replace("max_velocity_deg_s: 90, ", "")
    description = load_description(write(tmp_path, text))
    assert np.isnan(description.max_velocity).all()
    np.testing.assert_allclose(description.max_acceleration, [np.pi, np.nan], rtol=1e-15)


def test_missing_limits_are_told_not_invented(tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="joint limits not given.*joint1, joint2, joint3"):
        arm = load_robot("p1r2p3")
    assert np.all(np.isneginf(arm.lower))
    assert np.all(np.isposinf(arm.upper))
    one_sided = GOOD.replace("lower_deg: -90, ", "").replace(", upper_mm: 500", "")
    notes = load_description(write(tmp_path, one_sided)).notes
    assert [note.split(" ", 3)[1:] for note in notes] == [
        ["lower", "limit", "not given, nothing is assumed: one"],
        ["upper", "limit", "not given, nothing is assumed: two"],
    ]


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("robot: test arm\n", "", "robot is missing"),
        ("robot: test arm", "robot: 10", "robot must be a text, not 10"),
        ("robot: test arm", "robot:", "robot has no value"),
        ("convention: mdh", "convention: craig", "convention is 'craig'; it must be dh or mdh"),
        ("convention: mdh", "convention: dh", "joint 1 'one', beta_deg is not part of"),
        ("convention: mdh", "convetion: mdh", "'convetion' is not a known key .*'convention'"),
        ("name: one, ", "", "joint 1, name is missing"),
        ("name: two", "name: one", "two joints have the name 'one'"),
        ("d_mm: 100, ", "", "joint 1 'one', d_mm is missing"),
        ("d_mm: 100", "d_mm: long", "joint 1 'one', d_mm is 'long', not a number"),
        ("d_mm: 100", "d_mm: .nan", "joint 1 'one', d_mm is nan, not a finite"),
        ("d_mm: 100", "d_mm: [1]", "d_mm must be a number, not a list"),
        ("d_mm: 100", "d_mm: true", "d_mm must be a number, not True"),
        ("d_mm: 100", "d: 100", "joint 1 'one', 'd' is not a known key"),
        ("d_mm: 100", "d_m: 100", "did you mean 'd_mm'"),
        ("d_mm: 100", "d_mm: 100, d_mm: 101", "key 'd_mm' appears twice"),
        ("sign: -1", "sign: 2", "joint 1 'one', sign is 2; it must be 1 or -1"),
        ("type: prismatic", "type: prismatik", "did you mean 'prismatic'"),
        ("lower_mm: -5", "lower_deg: -5", "joint 2 'two', 'lower_deg' is not .*'lower_mm'"),
        ("lower_mm: -5", "lower_mm: 500", "lower_mm is not below upper_mm"),
        ("lower_mm: -5", "lower_mm: -.inf", "lower_mm is -inf, not a finite"),
        ("velocity_mm_s: 250", "velocity_mm_s: 0", "max_velocity_mm_s is 0; it must be above 0"),
        ("xyz_mm: [0, 0, 50]", "xyz_mm: [0, 0]", "tool, xyz_mm must be a list of 3 numbers"),
        ("xyz_mm: [0, 0, 50], ", "", "tool, xyz_mm is missing"),
        ("quat_xyzw: [0, 0, 0, 1]", "quat_xyzw: [0, 0, 0, 2]", "quat_xyzw has length 2, not 1"),
        ("quat_xyzw: [0", "rpy_deg: [0, 0, 0], quat_xyzw: [0", "given beside rpy_deg"),
        ("quat_xyzw", "quat_wxyz", "tool, 'quat_wxyz' is not a known key .*'quat_xyzw'"),
        ("base: {xyz_mm: [1, 2, 3], rpy_deg: [0, 0, 90]}", "base: 3", "base must be keys and"),
        (GOOD, "robot: a\nconvention: dh\njoints: []\n", "joints must be a list with at least"),
        (GOOD, "robot: a\nconvention: dh\njoints: [1]\n", "joint 1 must be keys and values"),
        (GOOD, "- 1\n", "the file must be keys and values, not a list"),
        (GOOD, "\n", "is empty"),
    ],
)
def test_what_is_wrong_is_named(tmp_path: Path, old: str, new: str, words: str) -> None:
    assert GOOD.count(old) == 1
    path = write(tmp_path, GOOD.replace(old, new))
    with pytest.raises(InputError, match=words) as caught:
        load_robot(path)
    assert caught.value.file == str(path)


def test_broken_yaml_is_refused_with_its_row(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD.replace("convention: mdh", "convention: [mdh"))
    with pytest.raises(InputError, match="not valid YAML") as caught:
        load_robot(path)
    assert caught.value.row == 3


@pytest.mark.parametrize("name", ["2026-02-30", "!!bool x", "!!timestamp x", "!!map [x]"])
def test_a_value_that_is_none_of_its_kind_is_no_yaml(tmp_path: Path, name: str) -> None:
    path = write(tmp_path, GOOD.replace("robot: test arm", f"robot: {name}"))
    with pytest.raises(InputError, match="not valid YAML") as caught:
        load_robot(path)
    assert caught.value.file == str(path)


@pytest.mark.parametrize("name", SHIPPED)
def test_a_calibrated_arm_is_saved_and_read_back(tmp_path: Path, name: str) -> None:
    nominal = load_robot(name)
    rng = np.random.default_rng(3)
    parameters = nominal.parameters
    arm = replace(
        nominal.with_mdh(parameters.add(nominal.mdh, 1e-3 * rng.normal(size=len(parameters)))),
        T_base_root=frames.transform(frames.exp_rotation([0.1, 0.2, 0.3]), [0.5, -0.25, 1.0]),
        T_flange_tool=frames.transform(frames.exp_rotation([-1.0, 0.2, 0.3]), [0.0, 0.1, 0.3]),
    )
    save_robot(arm, tmp_path / "calibrated.yaml")
    back = load_robot(tmp_path / "calibrated.yaml")
    for field in ("mdh", "sign", "prismatic", "lower", "upper", "T_base_root", "T_flange_tool"):
        np.testing.assert_allclose(getattr(back, field), getattr(arm, field), atol=1e-15)
    q = rng.uniform(-1, 1, (50, arm.n))
    np.testing.assert_allclose(back.fk(q), arm.fk(q), atol=1e-14)
    assert back.joint_names == arm.joint_names


@pytest.mark.parametrize("name", SHIPPED)
def test_a_nominal_arm_keeps_its_identity_through_a_file(tmp_path: Path, name: str) -> None:
    arm = load_robot(name)
    save_robot(arm, tmp_path / "copy.yaml")
    copy = load_robot(tmp_path / "copy.yaml")
    assert copy.model_hash == arm.model_hash
    assert copy.mdh.tolist() == arm.mdh.tolist()
    assert copy.name == arm.name


def test_joint_functions_and_load_are_saved_and_read_back(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    for bare in (load_robot("ur10"), load_robot(write(tmp_path, GOOD))):
        n = bare.n
        made = JointFunctions(
            rng.normal(size=n),
            rng.uniform(0.03, 0.1, n),
            rng.normal(0.0, 1e-4, (n, 40)),
            rng.uniform(0.0, 1e-6, n),
        )
        load = ArmLoad(rng.uniform(0, 9, n), rng.normal(size=(n, 3)), 5.0, [0.1, 0, 0], [0, 9.8, 0])
        save_robot(replace(bare, functions=made, load=load), tmp_path / "whole.yaml")
        back = load_robot(tmp_path / "whole.yaml")
        for field in ("first", "step", "coefficients", "compliance"):
            found = getattr(back.functions, field)
            np.testing.assert_allclose(found, getattr(made, field), rtol=1e-15)
        for field in ("mass", "centre", "payload_mass", "payload_centre", "gravity"):
            found = getattr(back.load, field)
            np.testing.assert_allclose(found, getattr(load, field), rtol=1e-15)


def test_masses_that_were_found_are_marked_in_the_file_and_take_no_payload(tmp_path: Path) -> None:
    path, bare = tmp_path / "found.yaml", replace(load_robot("ur10"), load=ArmLoad.unknown(6))
    save_robot(bare, path)
    text = path.read_text()
    assert "found: true" in text
    assert "payload" not in text
    load = load_robot(path).load
    assert load.found
    assert load.mass.tolist() == [0.0] * 5 + [1.0]
    assert not load_robot("ur10").load.found
    path.write_text(text.replace("found: true", "found: true\n  payload_kg: 5"))
    with pytest.raises(InputError, match="payload of 5 kg beside masses that were found"):
        load_robot(path)
    path.write_text(text.replace("found: true", "found: 3"))
    with pytest.raises(InputError, match="load, found must be true or false, not 3"):
        load_robot(path)


def test_the_links_of_the_ur10_weigh_no_more_than_the_arm_and_lie_within_its_reach() -> None:
    load = load_robot("ur10").load
    assert 25.0 < np.sum(load.mass) < 28.9  # kg: the whole arm, by its user manual
    assert np.max(np.linalg.norm(load.centre, axis=1)) < 0.612  # m: its longest link
    assert load.payload_mass == 0.0
    np.testing.assert_allclose(load.gravity, [0.0, 0.0, -9.80665])


LAYER = """
load: {masses_kg: [1, 2], centres_mm: [[0, 0, 0], [1, 2, 3]]}
functions:
  - {name: one, first_deg: -10, step_deg: 5, coefficients_urad: [1, 2, 1], compliance_urad_nm: 0.5}
"""


def test_two_functions_of_one_joint_are_refused(tmp_path: Path) -> None:
    path = write(tmp_path, GOOD + LAYER + "  - {name: one, compliance_urad_nm: 2}\n")
    words = "joint function 2, name is 'one', which has a function already"
    with pytest.raises(InputError, match=words):
        load_robot(path)


def test_a_joint_that_is_not_named_has_no_function(tmp_path: Path) -> None:
    arm = load_robot(write(tmp_path, GOOD + LAYER))
    at = np.array([[np.radians(2.5), 0.1]])
    assert arm.functions.delta(at)[0, 1] == 0.0
    assert arm.functions.compliance.tolist() == [0.5e-6, 0.0]
    assert arm.functions.first[0] == pytest.approx(np.radians(-10.0))


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("name: one, first", "name: three, first", "joint function 1, name is 'three'; it must be"),
        ("step_deg: 5", "step_deg: 0", "step_deg is 0; it must be above 0"),
        ("first_deg", "first_mm", "'first_mm' is not a known key .*'first_deg'"),
        ("[1, 2, 1]", "[1, .nan, 1]", "coefficients_urad is nan, not a finite"),
        ("[1, 2, 1]", "3", "coefficients_urad must be a list"),
        ("[1, 2, 1]", "[1, 90000, 1]", "functions cannot be: .* joint 1 has a slope"),
        ("compliance_urad_nm: 0.5", "compliance_urad_nm: -1", "compliances not below"),
        ("[1, 2]", "[1]", "load, masses_kg must be a list of 2 numbers"),
        ("[1, 2]", "[1, -2]", "load cannot be: load: a mass must not be below 0"),
        ("[[0, 0, 0], ", "[", "load, centres_mm must be 2 lists of 3 numbers"),
        ("[0, 0, 0]", "[0, 0]", "load, centres_mm must be a list of 3 numbers"),
        ("load: {masses_kg: [1, 2], centres_mm: [[0, 0, 0], [1, 2, 3]]}", "", "there is no load"),
    ],
)
def test_what_is_wrong_with_functions_and_load_is_named(
    tmp_path: Path, old: str, new: str, words: str
) -> None:
    assert LAYER.count(old) == 1
    with pytest.raises(InputError, match=words):
        load_robot(write(tmp_path, GOOD + LAYER.replace(old, new)))


def test_joint_speeds_are_kept(tmp_path: Path) -> None:
    description = load_description(write(tmp_path, GOOD))
    save_robot(description.arm, tmp_path / "copy.yaml", like=description)
    copy = load_description(tmp_path / "copy.yaml")
    assert copy.max_velocity.tolist() == description.max_velocity.tolist()
    assert copy.max_acceleration.tolist() == description.max_acceleration.tolist()
    assert copy.acceleration_assumed.tolist() == [False, True]
    assert "max_acceleration_mm_s2" not in (tmp_path / "copy.yaml").read_text()


def test_infinite_limits_and_sliding_joints_are_saved(tmp_path: Path) -> None:
    arm = SerialArm(
        "slide", ("s",), np.zeros((1, 5)), np.ones(1), np.ones(1), -np.full(1, np.inf), np.ones(1)
    )
    save_robot(arm, tmp_path / "slide.yaml")
    description = load_description(tmp_path / "slide.yaml")
    assert description.arm.prismatic.tolist() == [True]
    assert (description.arm.lower[0], description.arm.upper[0]) == (-np.inf, 1.0)
    assert len(description.notes) == 1


def test_own_files_come_before_shipped_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "config" / "robots"
    folder.mkdir(parents=True)
    (folder / "ur10.yaml").write_text(GOOD)
    (folder / "mine.yaml").write_text(GOOD)
    assert find_robot("ur10").parent != folder
    monkeypatch.setenv("ROBOCAL_CONFIG", str(tmp_path / "config"))
    assert find_robot("ur10") == folder / "ur10.yaml"
    assert load_robot("mine").name == "test arm"
    assert load_robot("bx200l").name == "BX200L"


def test_prefixes_of_ros_are_searched(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "share" / "robocal_ros" / "config" / "robots"
    folder.mkdir(parents=True)
    (folder / "overlay.yaml").write_text(GOOD)
    monkeypatch.setenv("AMENT_PREFIX_PATH", f"/nowhere{os.pathsep}{tmp_path}")
    assert load_robot("overlay").name == "test arm"
    assert robot_folders()[-1] == folder or folder in robot_folders()


def test_an_unknown_name_lists_the_known_ones(tmp_path: Path) -> None:
    known = r"or one of bx200l, .*kr150_r3100, .*ur10, .*ur5e, "
    words = rf"no robot 'bx20l' \(did you mean 'bx200l'\?\): .*{known}"
    with pytest.raises(InputError, match=words) as refused:
        load_robot("bx20l")
    shipped = find_robot("ur10").parent.glob("*.yaml")
    listed = str(refused.value).split("or one of ")[1].split(", ")
    assert {file.stem for file in shipped} <= set(listed)
    with pytest.raises(InputError, match="no such robot file"):
        load_robot(tmp_path / "ur10.yaml")
    with pytest.raises(InputError, match="no such robot file"):
        load_robot("ur10.yaml")


def test_an_installed_copy_finds_its_files_from_anywhere(tmp_path: Path) -> None:
    """A prefix without ROS' variables: packages and share folder as pip installs them."""
    prefix = tmp_path / "prefix"
    packages = prefix / "lib" / "python3" / "site-packages"
    packages.mkdir(parents=True)
    import robocal_ros

    source = Path(robocal_ros.__file__).resolve().parent
    subprocess.run(["cp", "-r", str(source), str(packages)], check=True)
    share = prefix / "share" / "robocal_ros" / "config"
    share.mkdir(parents=True)
    subprocess.run(["cp", "-r", str(find_robot("ur10").parent), str(share)], check=True)
    script = "from robocal_ros.kinematics.robots import find_robot; print(find_robot('ur10'))"
    environment = {k: v for k, v in os.environ.items() if k != "AMENT_PREFIX_PATH"}
    environment["PYTHONPATH"] = str(packages)
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        cwd="/",
        capture_output=True,
        text=True,
        check=True,
    )
    assert Path(done.stdout.strip()) == share / "robots" / "ur10.yaml"
