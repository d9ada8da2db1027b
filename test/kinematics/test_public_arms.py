# SPDX-License-Identifier: Apache-2.0
"""Shipped robot files against their makers' and ROS-Industrial's descriptions, number by number."""

import numpy as np
import pytest

from robocal_ros.ground.frames import exp_rotation, transform
from robocal_ros.kinematics.robots import load_description, robot_folders
from robocal_ros.kinematics.universal_robots import link_transform
from robocal_ros.kinematics.urdf import Chain, arm_of, chain, read_urdf, ur_chain, urdf_of

EXACT = 1e-9  # m and rad

# config/*/default_kinematics.yaml of Universal_Robots_ROS2_Description at 2221ec0, in m: z of the
# shoulder, x of forearm and wrist 1, z of wrist 1, y of wrists 2 and 3.
UR_LENGTHS = {
    "ur3": (0.1519, -0.24365, -0.21325, 0.11235, -0.08535, 0.0819),
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, -0.08535, 0.0921),
    "ur5": (0.089159, -0.425, -0.39225, 0.10915, -0.09465, 0.0823),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, -0.0997, 0.09959999999999999),
    "ur10": (0.1273, -0.612, -0.5723, 0.163941, -0.1157, 0.0922),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, -0.11985, 0.11655),
    "ur16e": (0.1807, -0.4784, -0.36, 0.17415, -0.11985, 0.11655),
    "ur20": (0.2363, -0.862, -0.7287, 0.201, -0.1593, 0.1543),
    "ur30": (0.2363, -0.637, -0.5037, 0.201, -0.1593, 0.1543),
}
# The maker's description for ROS 1, ros-industrial/universal_robot: ur_description/config/ur7e is a
# link to ur5e (3be8136); default_kinematics.yaml of ur12e is from 2f33925, of ur15 from 499e728, of
# ur18 from 34b1371.
UR_LENGTHS |= {
    "ur7e": UR_LENGTHS["ur5e"],
    "ur12e": (0.1807, -0.6127, -0.57155, 0.17415, -0.11985, 0.11655),
    "ur15": (0.2186, -0.6475, -0.5164, 0.1824, -0.1361, 0.1434),
    "ur18": (0.2186, -0.475, -0.3389, 0.1824, -0.1361, 0.1434),
}

# config/*/physical_parameters.yaml there: mass in kg and centre in m of each link, in its frame.
_WRISTS_5 = ((0, -0.01634, -0.0018), (0, 0.01634, -0.0018), (0, 0, -0.001159))
_WRISTS_10 = ((0, -0.018, 0.007), (0, 0.018, -0.007), (0, 0, -0.026))
_WRISTS_15 = (
    (2.5e-05, -0.016413, -0.019695), (2.5e-05, 0.015886, -0.01996), (-1.8e-05, -0.000112, -0.053397)
)  # fmt: skip
_SHOULDER_5, _SHOULDER_10 = (0, -0.00193, -0.02561), (0.021, -0.027, 0)
_SHOULDER_15 = (2.4e-05, -0.025304, -0.033309)
UR_LINKS = {
    "ur3e": (
        (1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
        ((0, 0, -0.02), (-0.11355, 0, 0.1157), (-0.1632, 0, 0.0238), (0, -0.01, 0), (0, 0.01, 0),
         (0, 0, -0.02)),
    ),
    "ur5e": (
        (3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
        (_SHOULDER_5, (-0.2125, 0, 0.11336), (-0.2422, 0, 0.0265), *_WRISTS_5),
    ),
    "ur10": (
        (7.1, 12.7, 4.27, 2.0, 2.0, 0.365),
        (_SHOULDER_10, (-0.232, 0, 0.158), (-0.3323, 0, 0.068), *_WRISTS_10),
    ),
    "ur10e": (
        (7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
        (_SHOULDER_10, (-0.2327, 0, 0.158), (-0.33155, 0, 0.068), *_WRISTS_10),
    ),
    "ur16e": (
        (7.369, 10.45, 4.321, 2.18, 2.033, 0.907),
        ((0, -0.03, -0.016), (-0.1764, 0, 0.16), (-0.166, 0, 0.065), (0, -0.011, -0.009),
         (0, 0.012, -0.018), (0, 0, -0.044)),
    ),
    "ur15": (  # at 2cb0bf1
        (9.9883, 14.9255, 6.1015, 2.089, 2.0869, 1.0666),
        (_SHOULDER_15, (-0.228491, -8.3e-05, 0.192787), (-0.210929, 1.9e-05, 0.070552),
         *_WRISTS_15),
    ),
    "ur18": (  # at 6ffee81
        (9.9883, 14.2009, 5.52, 2.089, 2.0869, 1.0666),
        (_SHOULDER_15, (-0.166336, -8.8e-05, 0.190204), (-0.139248, 2.1e-05, 0.073101),
         *_WRISTS_15),
    ),
    "ur20": (
        (16.343, 29.632, 7.879, 3.054, 3.126, 0.926),
        ((0, -0.0062, -0.061), (-0.3394, 0, 0.2098), (-0.4053, 0, 0.0604), (0, -0.0393, -0.0026),
         (0, 0.0379, -0.0024), (0, 0, -0.0293)),
    ),
    "ur30": (
        (16.343, 28.542, 7.156, 3.054, 3.126, 0.926),
        ((-0.0001, -0.0069, -0.06), (-0.2476, 0, 0.2103), (-0.278, 0, 0.0629),
         (0, -0.0353, -0.0048), (0, 0.0341, -0.0046), (0, 0, -0.0293)),
    ),
}  # fmt: skip

# ROS-Industrial's *_macro.xacro (abb_experimental at 20b9cf8, kuka_experimental at e78bbd1, fanuc
# at 8fee5e3, motoman at 433be15): origin of each joint in its parent and of tool0 in the last link,
# in mm; axes; height of base over base_link; limits in degrees where the file is not read off them.
ABB = ("+z+y+y+x+y+x", "0 1.5707963267948966 0", 0)
KUKA = ("-z+y+y-x+y-x", "0 1.5707963267948966 0", 0)
_TOOL = "3.141592653589793 -1.5707963267948966 0"  # of FANUC and Yaskawa
PUBLIC = {
    "irb120_3_58": (*ABB, "0 0 0, 0 0 290, 0 0 270, 0 0 70, 302 0 0, 72 0 0, 0 0 0"),
    "irb1200_5_90": (*ABB, "0 0 399.1, 0 0 0, 0 0 448, 0 0 42, 451 0 0, 82 0 0, 0 0 0"),
    "irb1200_7_70": (*ABB, "0 0 399.1, 0 0 0, 0 0 350, 0 0 42, 351 0 0, 82 0 0, 0 0 0"),
    "irb2600_12_165": (*ABB, "0 0 445, 150 0 0, 0 0 700, 0 0 115, 795 0 0, 85 0 0, 0 0 0"),
    "irb4600_60_205": (*ABB, "0 0 495, 175 0 0, 0 0 900, 0 0 175, 960 0 0, 135 0 0, 0 0 0"),
    "irb6700_235_265": (*ABB, "0 0 780, 320 0 0, 0 0 1135, 0 0 200, 1182.5 0 0, 200 0 0, 0 0 0"),
    "kr6_r900": (*KUKA, "0 0 400, 25 0 0, 455 0 0, 0 0 35, 420 0 0, 80 0 0, 0 0 0"),
    "kr10_r1100": (*KUKA, "0 0 400, 25 0 0, 560 0 0, 0 0 35, 515 0 0, 80 0 0, 0 0 0"),
    "kr10_r1420": (*KUKA, "0 0 450, 150 0 0, 610 0 0, 0 0 20, 660 0 0, 80 0 0, 0 0 0"),
    "kr16_2": (*KUKA, "0 0 675, 260 0 0, 680 0 0, 670 0 -35, 0 0 0, 0 0 0, 158 0 0"),
    "lrmate200id": (
        "+z+y-y-x-y-x", _TOOL, 330, "0 0 330, 50 0 0, 0 0 330, 0 0 35, 335 0 0, 80 0 0, 0 0 0"),
    "m20ia": (
        "+z+y-y-x-y-x", _TOOL, 525, "0 0 525, 150 0 0, 0 0 790, 0 0 250, 835 0 0, 100 0 0, 0 0 0"),
    "m710ic50": (
        "+z+y-y-x-y-x", _TOOL, 565, "0 0 565, 150 0 0, 0 0 870, 0 0 170, 1016 0 0, 175 0 0, 0 0 0"),
    "gp7": (
        "+z+y-y-x-y-x", _TOOL, 330, "0 0 330, 40 0 0, 0 0 445, 440 0 40, 0 0 0, 0 0 0, 80 0 0"),
    "gp12": (
        "+z+y-y-x-y-x", _TOOL, 450, "0 0 450, 155 0 0, 0 0 614, 640 0 200, 0 0 0, 0 0 0, 100 0 0"),
    "gp25": (
        "+z+y-y-x-y-x", _TOOL, 505, "0 0 505, 150 0 0, 0 0 760, 0 0 200, 795 0 0, 0 0 0, 100 0 0"),
    "hc10dt": (
        "+z+y-y+z-y+z", "3.141592653589793 0 0", 275,
        "0 0 275, 0 0 0, 0 0 700, 0 0 -500, 0 162 0, 0 0 0, 0 0 -170"),
}  # fmt: skip
# Link masses (kg) and centres (m, in the links' frames) of abb_irb120_support.
IRB120 = (
    (3.067, 3.909, 2.944, 1.328, 0.546, 0.137),
    ((9.77e-05, -0.00012, 0.23841), (0.00078, -0.00212, 0.10124), (0.02281, 0.00106, 0.05791),
     (0.2247, 0.00015, 0.00041), (-0.00109, 3.68e-05, 6.22e-05), (-0.00706, -0.00017, -1.32e-06)),
)  # fmt: skip

# Of each joint lower and upper limit and speed in deg as the same descriptions have them: of
# Universal Robots config/*/joint_limits.yaml (UR12e at 49d2ca2, UR15 in the description for ROS 1,
# UR18 at 272bddd), else *_macro.xacro; None: none.
_UR5E = 2 * [(-360, 360, 180)] + [(-180, 180, 180)] + 3 * [(-360, 360, 180)]
_UR10E = 2 * [(-360, 360, 120)] + [(-180, 180, 180)] + 3 * [(-360, 360, 180)]
LIMITS = {
    "ur3e": [*_UR5E[:3], (-360, 360, 360), (-360, 360, 360), (None, None, 360)],
    "ur5e": _UR5E,
    "ur10e": _UR10E,
    "ur12e": _UR10E,
    **dict.fromkeys(
        ("ur15", "ur18"),
        2 * [(-360, 360, 180)] + [(-180, 180, 240)] + 3 * [(-360, 360, 300)],
    ),
    "ur20": 2 * [(-360, 360, 120)] + [(-180, 180, 150)] + 3 * [(-360, 360, 210)],
    "kr10_r1100": [
        (-170, 170, 300), (-190, 45, 225), (-120, 156, 225),
        (-185, 185, 381), (-120, 120, 311), (-350, 350, 492)],
    "kr10_r1420": [
        (-170, 170, 220), (-185, 65, 210), (-137, 163, 270),
        (-185, 185, 381), (-120, 120, 311), (-350, 350, 492)],
    "lrmate200id": [
        (-170, 170, 450), (-100, 145, 380), (-70, 205, 520),
        (-190, 190, 550), (-125, 125, 545), (-360, 360, 1000)],
}  # fmt: skip
LIMITS_RAD = {
    "irb120_3_58": [
        (-2.87979, 2.87979, 4.36332), (-1.91986, 1.91986, 4.36332), (-1.91986, 1.22173, 4.36332),
        (-2.79253, 2.79253, 5.58505), (-2.094395, 2.094395, 5.58505), (-6.98132, 6.98132, 7.33038)],
}  # fmt: skip
LAST_DIGIT_RAD = {"irb120_3_58": 1e-5}


def described(name: str) -> Chain:
    """The links from base to tool0 that the public description of a type has."""
    if name in UR_LENGTHS:
        d1, a2, a3, d4, d5, d6 = UR_LENGTHS[name]
        right, half = 1.570796327, 3.141592653589793  # the digits that it is written with
        rows = {
            "shoulder": (0, 0, d1, 0, 0, 0),
            "upper_arm": (0, 0, 0, right, 0, 0),
            "forearm": (a2, 0, 0, 0, 0, 0),
            "wrist_1": (a3, 0, d4, 0, 0, 0),
            "wrist_2": (0, d5, 0, right, 0, 0),
            "wrist_3": (0, d6, 0, 1.570796326589793, half, half),
        }
        keys = ("x", "y", "z", "roll", "pitch", "yaw")
        made = {link: dict(zip(keys, map(float, row), strict=True)) for link, row in rows.items()}
        return ur_chain({"kinematics": made}, name)
    axes, tool, base, text = PUBLIC[name]
    *joints, tip = [[float(x) / 1e3 for x in part.split()] for part in text.split(",")]
    rows = [f'<robot name="{name}"><link name="base_link"/><link name="base"/>']
    rows.append(_joint("b", "fixed", "base_link", "base", [0.0, 0.0, base / 1e3]))
    parent = "base_link"
    for i, origin in enumerate(joints):
        axis = np.eye(3)["xyz".index(axes[2 * i + 1])] * (-1.0 if axes[2 * i] == "-" else 1.0)
        turns = f'<axis xyz="{_words(axis)}"/><limit lower="-1" upper="1"/>'
        rows.append(f'<link name="l{i}"/>')
        rows.append(_joint(f"j{i}", "revolute", parent, f"l{i}", origin, inside=turns))
        parent = f"l{i}"
    rows += ['<link name="tool0"/>', _joint("t", "fixed", parent, "tool0", tip, tool), "</robot>"]
    return chain(read_urdf("".join(rows), name))


def _words(numbers) -> str:
    return " ".join(repr(float(x)) for x in numbers)


def _joint(name, kind, parent, child, xyz, rpy="0 0 0", inside="") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    origin = f'<origin xyz="{_words(xyz)}" rpy="{rpy}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{origin}{inside}</joint>'


@pytest.mark.parametrize("name", [*UR_LENGTHS, *PUBLIC])
def test_the_flange_is_where_the_public_description_has_it(name):
    arm, links = load_description(name).arm, described(name)
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (50, 6))
    there = np.array([links.fk(row) for row in q])
    assert np.abs(arm.fk(q) - there).max() < EXACT


@pytest.mark.parametrize("name", [*UR_LENGTHS, *PUBLIC])
def test_a_public_description_becomes_a_model_and_a_description_again(name):
    links = described(name)
    model = arm_of(links).arm
    again = chain(read_urdf(urdf_of(model), name))
    q = np.random.default_rng(2).uniform(-np.pi, np.pi, (50, 6))
    there = np.array([links.fk(row) for row in q])
    assert len(model.parameters) == 24
    assert np.abs(model.fk(q) - there).max() < EXACT
    assert np.abs(np.array([again.fk(row) for row in q]) - there).max() < EXACT


@pytest.mark.parametrize("name", [*UR_LENGTHS, *PUBLIC])
def test_a_file_is_whole_and_says_where_its_numbers_are_from(name):
    robot = load_description(name)
    assert robot.notes == ()  # all limits are there
    assert np.isfinite(robot.max_velocity).all()
    assert len(robot.arm.parameters) == 24
    comment = robot.path.read_text().split("robot:")[0].replace("\n# ", " ")
    for words in ("Joint limits and speeds", "0.5 s is assumed"):
        assert words in comment
    at_zero = robot.arm.fk(np.zeros(6))[:3, 3] * 1e3
    told = comment.split("the flange is at (")[1].split(")")[0].split(",")
    np.testing.assert_allclose([float(x) for x in told], at_zero, atol=1e-6)


@pytest.mark.parametrize("name", [*LIMITS, *LIMITS_RAD])
def test_limits_and_speeds_are_those_of_the_public_description(name):
    robot = load_description(name)
    ours = np.degrees([robot.arm.lower, robot.arm.upper, robot.max_velocity]).T
    if name in LIMITS:
        theirs, digit = np.array(LIMITS[name], dtype=float), 1e-9
    else:
        theirs, digit = np.degrees(LIMITS_RAD[name]), np.degrees(LAST_DIGIT_RAD[name])
    if name in UR_LENGTHS:
        theirs[2, :2] *= 2.0  # "half its actual joint position limit", for planners
    limited = np.isfinite(theirs)
    assert limited.all() or name == "ur3e"
    np.testing.assert_allclose(ours[limited], theirs[limited], rtol=0, atol=digit)


def test_a_ur7e_is_a_ur5e():
    """Pull request 333 of Universal_Robots_ROS2_Description makes the files of both equal."""
    one, other = load_description("ur7e"), load_description("ur5e")
    np.testing.assert_array_equal(one.arm.mdh, other.arm.mdh)
    for name in ("lower", "upper"):
        np.testing.assert_array_equal(getattr(one.arm, name), getattr(other.arm, name))
    np.testing.assert_array_equal(one.max_velocity, other.max_velocity)
    np.testing.assert_array_equal(one.arm.load.centre, other.arm.load.centre)
    np.testing.assert_array_equal(one.arm.load.mass, other.arm.load.mass)


def test_no_limit_is_above_its_sheets_for_digits_of_radians():
    """Sheets have whole degrees; a hundredth above them, a controller refuses the motion.

    (ros-industrial/motoman issue 102.) The M-20iA's joint 3 is a sum of two of the controller's.
    """
    for name in PUBLIC:
        arm, speed = load_description(name).arm, load_description(name).max_velocity
        degrees = np.degrees([arm.lower, arm.upper, speed])
        if name == "m20ia":
            degrees = np.delete(degrees, 2, axis=1)
        np.testing.assert_allclose(degrees, np.round(degrees), atol=1e-9, err_msg=name)


def test_an_irb_2600_leans_forward_further_than_back():
    """ABB's sheet ROB0142EN: axis 2 from -95 to 155 deg, which moves the arm down in front.

    So has it the IRB 2600-12/1.85 (ros-industrial/abb at 385308a); joint 3 goes to -180 deg there.
    """
    arm = load_description("irb2600_12_165").arm
    np.testing.assert_allclose(np.degrees([arm.lower[2], arm.upper[2]]), [-155.0, 75.0])
    np.testing.assert_allclose(np.degrees([arm.lower[1], arm.upper[1]]), [-95.0, 155.0])
    leant = arm.fk(np.array([0.0, 0.5, 0.0, 0.0, 0.0, 0.0]))
    assert leant[0, 3] > arm.fk(np.zeros(6))[0, 3]


@pytest.mark.parametrize("name", [*UR_LINKS, "irb120_3_58"])
def test_masses_lie_where_the_description_has_them(name):
    """The centre of each link at any joints: by the description's frames and by the file's."""
    arm, links = load_description(name).arm, described(name)
    masses, centres = UR_LINKS.get(name, IRB120)
    assert arm.load is not None
    np.testing.assert_array_equal(arm.load.mass, masses)
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (20, 6)):
        T = np.eye(4)
        for i, T_base_link in enumerate(links.frames(q)[:-1]):
            row = arm.mdh[i].copy()
            row[1] += arm.sign[i] * q[i]
            T = T @ link_transform(row)
            turned = T_base_link @ transform(exp_rotation(links.moving[i].axis * q[i]), np.zeros(3))
            ours, theirs = T @ [*arm.load.centre[i], 1.0], turned @ [*centres[i], 1.0]
            assert np.abs(ours - theirs).max() < EXACT


def test_every_shipped_arm_of_six_joints_is_looked_at_or_has_no_public_description():
    shipped = {file.stem for folder in robot_folders() for file in folder.glob("*.yaml")}
    assert shipped - {*UR_LENGTHS, *PUBLIC} == {"bx200l", "kr150_r3100", "p1r2p3"}
