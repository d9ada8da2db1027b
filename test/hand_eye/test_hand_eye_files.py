# SPDX-License-Identifier: Apache-2.0
"""Tables of shots, target files and documents, exports of mounts: read as written, or refused."""

import json
import re
import textwrap
import xml.etree.ElementTree as ET
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from bench.hand_eye_files import write_profile, write_target
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.files import (
    PoseTable,
    exported,
    read_pose_table,
    read_profile,
    read_profiles,
    write_pose_table,
)
from robocal_ros.hand_eye.profiles import Profile, profile_of
from robocal_ros.hand_eye.targets import (
    BoardTarget,
    LineTarget,
    SphereTarget,
    Staircase,
    StepTarget,
    read_target,
    target_document,
    target_of,
)
from robocal_ros.kinematics.robots import load_robot

UR10 = load_robot("ur10")
GOOD = (
    "sample,profile,mark,stamp_s,x_mm,y_mm,z_mm,qx,qy,qz,qw\n"
    "one,a.csv,near,10.5,800,0,300,0,0,0,1\n"
    "two,deep/b.csv,far,11.000000001,810,-10,305,1,0,0,0\n"
)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "poses.csv"


def refusal(path: Path, text: str, **more) -> InputError:
    path.write_text(text)
    with pytest.raises(InputError) as caught:
        read_pose_table(path, **more)
    assert caught.value.file == str(path)
    return caught.value


def test_poses_are_read_in_si(path):
    path.write_text(GOOD)
    table = read_pose_table(path)
    assert table.names == ("one", "two")
    assert table.files == ("a.csv", "deep/b.csv")
    assert table.mark == ("near", "far")
    assert table.stamp_ns.tolist() == [10_500_000_000, 11_000_000_001]
    assert table.joints is None
    assert table.T_base_flange[1] == pytest.approx(
        np.array([[1, 0, 0, 0.81], [0, -1, 0, -0.01], [0, 0, -1, 0.305], [0, 0, 0, 1]]), abs=1e-15
    )


def test_what_is_written_is_read(path):
    rng = np.random.default_rng(3)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.random(5, random_state=4).as_matrix()
    T[:, :3, 3] = rng.uniform(0.2, 1.0, (5, 3))
    q = rng.uniform(-1.0, 1.0, (5, 6))
    files, stamps = [f"{i}.csv" for i in range(5)], np.arange(5) + 1_790_000_000_123_456_789
    marks = ["near", "far", "near", "far", "near"]
    write_pose_table(
        path, T, files, names=list("abcde"), joints=(UR10, q), stamp_ns=stamps, mark=marks
    )
    table = read_pose_table(path, UR10)
    assert table.T_base_flange == pytest.approx(T, abs=1e-11)
    assert table.joints.q == pytest.approx(q, abs=1e-12)
    assert table.stamp_ns.tolist() == stamps.tolist()
    assert (table.names, table.files, table.mark) == (tuple("abcde"), tuple(files), tuple(marks))
    assert read_pose_table(path).joints is None  # joints beside poses need no robot


def test_a_shot_without_a_name_has_that_of_its_file(path):
    path.write_text("image,x_m,y_m,z_m,rx_deg,ry_deg,rz_deg\nleft/1.png,0.5,0,0.5,0,90,0\n")
    table = read_pose_table(path, file_column="image")
    assert table.names == table.files == ("left/1.png",)
    assert table.T_base_flange[0, :3, :3] @ [0, 0, 1] == pytest.approx(np.array([1, 0, 0]))


def test_poses_follow_from_the_joints_of_the_robot(path):
    q = np.radians([[10.0, -80.0, 90.0, -100.0, -90.0, 30.0]])
    path.write_text(
        "profile,q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\na.csv,10,-80,90,-100,-90,30\n"
    )
    assert read_pose_table(path, UR10).T_base_flange == pytest.approx(UR10.fk(q), abs=1e-14)
    assert "name the robot" in str(refusal(path, path.read_text()))


@pytest.mark.parametrize(
    ("old", "new", "row", "column", "words"),
    [
        ("1,0,0,0\n", "1,1,0,0\n", 3, "qw", "length 1.41421, not 1"),
        ("sample,", "smaple,", 1, "smaple", "did you mean 'sample'"),
        ("profile,", "image,", 1, "image", "unknown column"),
        ("a.csv", "../a.csv", 2, "profile", "not inside the folder"),
        ("a.csv", "/tmp/a.csv", 2, "profile", "not inside the folder"),
        ("a.csv", "", 2, "profile", "the cell is empty"),
        ("deep/b.csv", "a.csv", 3, "profile", "already in row 2"),
        ("two,", "one,", 3, "sample", "already in row 2"),
        ("near,", ",", 2, "mark", "the cell is empty"),
        ("-10,", "nan,", 3, "y_mm", "not a finite number"),
        ("810,", "810000,", 3, "x_mm", "a thousand times too far"),
        ("qx,qy,qz,qw", "q1_deg,q2_deg,q3_deg,q4_deg", 1, None, "orientation is missing"),
        ("x_mm,y_mm,z_mm", "x_mm,y_mm,z_m", 1, "z_m", "mixed units"),
    ],
)
def test_a_wrong_table_names_row_and_column(path, old, new, row, column, words):
    assert old in GOOD
    error = refusal(path, GOOD.replace(old, new, 1))
    assert (error.row, error.column) == (row, column)
    assert words in str(error)


@pytest.mark.parametrize(
    ("header", "rows", "words"),
    [
        ("x_m,y_m,z_m", "800,0,300", "mm where m are expected"),
        ("x_mm,y_mm,z_mm", "0.8,0,0.3", ", m where mm are expected"),
    ],
)
def test_the_factor_of_a_thousand_is_named(path, header, rows, words):
    error = refusal(path, f"profile,{header},qx,qy,qz,qw\na.csv,{rows},0,0,0,1\n")
    assert "a thousand times" in str(error)
    assert (error.row, error.column) == (2, header.split(",")[0])
    assert words in str(error)


def test_a_table_without_poses_or_files_is_refused(path):
    assert "where the flange was is missing" in str(refusal(path, "profile\na.csv\n"))
    text = "sample,x_mm,y_mm,z_mm,qx,qy,qz,qw\none,800,0,300,0,0,0,1\n"
    assert "names each shot's file" in str(refusal(path, text))
    joints = "profile,q1_deg,q2_deg\na.csv,1,2\n"
    assert "q3_deg or q3_rad is missing" in str(refusal(path, joints, arm=UR10))


def shots(folder: Path, files: list[str]) -> PoseTable:
    T = np.tile(np.eye(4), (len(files), 1, 1))
    T[:, :3, 3] = [0.5, 0.0, 0.5]
    write_pose_table(folder / "poses.csv", T, files)
    return read_pose_table(folder / "poses.csv")


POINTS = np.column_stack([np.linspace(-0.02, 0.02, 30), np.linspace(0.19, 0.21, 30)])


@pytest.mark.parametrize("nothing", [0.0, -32.768, -99999.9999])
def test_a_value_that_stands_for_no_return_is_left_out(nothing):
    """What the maker writes where nothing returned is told by its distance from all else."""
    x = np.linspace(-0.02, 0.02, 400)
    seen = np.column_stack([x, 0.2 + 0.1 * x])
    rows = seen.copy()
    rows[::7, 1] = nothing * 1e-3
    found = profile_of(rows, "one")
    np.testing.assert_array_equal(found.points, np.delete(seen, np.s_[::7], axis=0))
    wall = np.where(x < 0.0, 0.2, 0.215)  # a surface lies nearer, even one without noise
    assert len(profile_of(np.column_stack([x, wall]), "two").points) == len(x)


def test_a_flange_is_read_as_fanuc_tells_it(path):
    """W, P, R turn about the fixed axes: R = Rz Ry Rx."""
    path.write_text("profile,x_mm,y_mm,z_mm,w_deg,p_deg,r_deg\na.csv,800,0,300,-170,20,35\n")
    expected = Rotation.from_euler("ZYX", [35.0, 20.0, -170.0], degrees=True).as_matrix()
    np.testing.assert_allclose(read_pose_table(path).T_base_flange[0, :3, :3], expected)


def test_profiles_are_read_without_their_gaps(tmp_path):
    gaps = POINTS.copy()
    gaps[5], gaps[7, 1] = np.nan, np.nan
    write_profile(tmp_path / "a.csv", gaps)
    lines = (tmp_path / "a.csv").read_text().splitlines()
    assert lines[6] == ","
    lines[9] = f"{lines[9].split(',')[0]}, NaN "
    (tmp_path / "a.csv").write_text("\n".join(lines))
    (found,) = read_profiles(tmp_path, shots(tmp_path, ["a.csv"]))
    assert isinstance(found, Profile)
    assert found.name == "a.csv"
    assert found.points == pytest.approx(np.delete(POINTS, [5, 7, 8], axis=0), abs=1e-12)


@pytest.mark.parametrize("text", ["", "\n", "x_mm,z_mm\n", "x_mm,z_mm\n" + ",\n" * 50])
def test_an_empty_profile_is_told_beside_the_others(tmp_path, text):
    write_profile(tmp_path / "good.csv", POINTS)
    (tmp_path / "dark.csv").write_text(text)
    good, dark = read_profiles(tmp_path, shots(tmp_path, ["good.csv", "dark.csv"]))
    assert isinstance(good, Profile)
    assert isinstance(dark, TooFewSamplesError)
    assert "dark.csv" in str(dark)


def test_a_missing_profile_is_named_with_its_row(tmp_path):
    write_profile(tmp_path / "a.csv", POINTS)
    table = shots(tmp_path, ["a.csv", "b.csv"])
    with pytest.raises(InputError, match=r"no file 'b\.csv' in") as caught:
        read_profiles(tmp_path, table)
    assert (caught.value.row, caught.value.column) == (3, "profile")
    with pytest.raises(InputError, match="no such folder"):
        read_profiles(tmp_path / "nowhere", table)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x_mm,y_mm,z_mm\n1,2,3\n", "column y_mm: unknown column"),
        ("x_mm\n1\n", "column z_mm is missing"),
        ("x_mm,z_mm\n1,inf\n", "row 2, column z_mm: 'inf' is not a finite number"),
        ("x_mm,z_mm\n1,\n2,two\n", "row 3, column z_mm: 'two' is not a number"),
        ("x_mm,z_mm\n" + "".join(f"{i}e-3,0.2\n" for i in range(20)), "a thousand times too small"),
        ("x_mm,z_mm\n" + "".join(f"{i}000,200\n" for i in range(30)), "a thousand times too large"),
    ],
)
def test_a_wrong_profile_is_refused(tmp_path, text, words):
    path = tmp_path / "a.csv"
    path.write_text(text)
    with pytest.raises(InputError, match=words) as caught:
        read_profile(path, "a")
    assert caught.value.file == str(path)


STEP = {
    "kind": "step",
    "T_base_user": {"xyz_mm": [800.0, -100.0, 50.0], "rpy_deg": [0.0, 0.0, 90.0]},
    "staircase": {"steps": 3, "length_mm": 90, "height_mm": 10, "depth_mm": 20},
    "user_sigma_mm": 0.1,
    "user_sigma_deg": 0.05,
}


POSE = {"xyz_mm": [1, 2, 3]}
SLOPED = [[1, 0.1, 0], [0, 1, 0], [0, 0, 1]]
MIRRORED = [[1, 0, 0], [0, 1, 0], [0, 0, -1]]
LINE = {"kind": "line", "point_mm": [1, 2, 3], "direction": [1, 0, 0]}


def staircase(**more: object) -> dict[str, object]:
    return STEP | {"staircase": STEP["staircase"] | more}


def frame(**more: object) -> dict[str, object]:
    return STEP | {"T_base_user": POSE | more}


def target(tmp_path: Path, document: object):
    path = tmp_path / "target.yaml"
    path.write_text(yaml.safe_dump(document))
    return read_target(path)


def test_a_staircase_tells_its_corners(tmp_path):
    found = target(tmp_path, STEP)
    assert isinstance(found, StepTarget)
    assert set(found.corners) == {"near", "far"}
    near = [[0.03, 0.0, 0.01], [0.03, 0.02, 0.02], [0.03, 0.04, 0.03]]
    assert found.corners["near"] == pytest.approx(np.array(near), abs=1e-15)
    assert found.corners["far"] == pytest.approx(np.add(near, [0.03, 0, 0]), abs=1e-15)
    # a yaw of 90 degrees takes the user frame's x to the base's y
    assert found.T_base_user[:3, :3] @ found.edge_user == pytest.approx(np.array([0, 1, 0]))
    assert found.T_base_user[:3, 3] == pytest.approx(np.array([0.8, -0.1, 0.05]))
    assert found.sigma_m == pytest.approx(1e-4 / 3)
    assert found.user_sigma_m == pytest.approx(1e-4)
    assert found.user_sigma_rad == pytest.approx(np.radians(0.05))


def test_corners_come_in_the_order_of_a_profile():
    def section(**more):
        return Staircase(3, 0.09, 0.01, 0.02, **more).marked_corners()["near"][:, 1:].tolist()

    convex = [[0.0, 0.01], [0.02, 0.02], [0.04, 0.03]]
    concave = [[0.02, 0.01], [0.04, 0.02]]
    both = [convex[0], concave[0], convex[1], concave[1], convex[2]]
    for corners, expected in (("convex", convex), ("concave", concave), ("both", both)):
        outer = [place in convex for place in expected]
        assert Staircase(3, 0.09, 0.01, 0.02, corners).convex.tolist() == outer
        assert section(corners=corners) == pytest.approx(np.array(expected), abs=1e-15)
        turned = section(corners=corners, first="highest")
        assert turned == pytest.approx(np.array(expected[::-1]), abs=1e-15)


@pytest.mark.parametrize("kind", ["sphere", "line", "step"])
def test_a_target_that_is_written_is_read(tmp_path, kind):
    line = LineTarget(np.array([0.8, 0.1, 0.2]), np.array([0.6, 0.8, 0.0]))
    made = {"sphere": SphereTarget(0.02), "line": line, "step": target(tmp_path, STEP)}[kind]
    write_target(tmp_path / "again.yaml", made)
    again = read_target(tmp_path / "again.yaml")
    assert type(again) is type(made)
    for name, value in vars(made).items():
        if name == "corners":
            assert list(again.corners) == list(value)
            for mark in value:
                assert again.corners[mark] == pytest.approx(value[mark], abs=1e-15)
        else:
            assert getattr(again, name) == pytest.approx(value, abs=1e-15)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"kind": "sphere", "radius_mm": 0.02}, "radius_mm is 0.02; .* off by a thousand"),
        ({"kind": "sphere"}, "radius_mm is missing"),
        ({"kind": "spere", "radius_mm": 20}, "kind is 'spere'.*did you mean 'sphere'"),
        ({"kind": "sphere", "radius": 20}, "'radius' is not a known key.*radius_mm"),
        (LINE | {"direction": [0, 0, 0]}, "direction has no length"),
        (LINE | {"point_mm": [8e5, 0, 0]}, "point_mm .*thousand"),
        (STEP | {"corners_mm": {}}, "either staircase, or corners_mm"),
        (STEP | {"edge_user": [1, 0, 0]}, "edge_user is x for a staircase"),
        (STEP | {"convex": [True]}, "convex is told by corners for a staircase"),
        (STEP | {"user_sigma_mm": -1}, "user_sigma_mm is -1"),
        ({k: v for k, v in STEP.items() if k != "user_sigma_deg"}, "user_sigma_deg is missing"),
        (frame(xyz_mm=[8e5, 0, 0], rpy_deg=[0, 0, 0]), "xyz_mm .*thousand"),
        (frame(), "T_base_user needs an orientation"),
        (frame(quat_xyzw=[0, 0, 0, 2]), "T_base_user, quat_xyzw has length 2, not 1"),
        (frame(rotation=MIRRORED), "T_base_user, rotation is left-handed"),
        (frame(rotation=SLOPED), "not unit vectors at right angles"),
        (staircase(steps=2.5), "steps is 2.5"),
        (staircase(height_mm=0), "height_mm is 0"),
        (staircase(corners="outer"), "corners is 'outer'"),
        (staircase(steps=1, corners="concave"), "steps is 1"),
    ],
)
def test_a_wrong_target_names_its_key(tmp_path, change, words):
    with pytest.raises(InputError, match=words) as caught:
        target(tmp_path, change)
    assert caught.value.file == str(tmp_path / "target.yaml")


def test_corners_in_full(tmp_path):
    document = {k: v for k, v in STEP.items() if k != "staircase"}
    document["T_base_user"] = {"xyz_mm": [1, 2, 3], "rotation": [[0, -1, 0], [1, 0, 0], [0, 0, 1]]}
    document |= {"corners_mm": {"left": [[1, 2, 3], [4, 5, 6]]}, "edge_user": [0, 2, 0]}
    found = target(tmp_path, document)
    assert found.corners["left"] == pytest.approx(np.array([[1, 2, 3], [4, 5, 6]]) * 1e-3)
    assert found.edge_user.tolist() == [0.0, 1.0, 0.0]
    assert found.T_base_user[:3, :3] @ [1, 0, 0] == pytest.approx(np.array([0, 1, 0]))
    assert found.convex is None
    assert target(tmp_path, document | {"convex": [True, False]}).convex.tolist() == [True, False]
    for told, words in ((True, "must be a list of true"), ([True], "tells 1 corners, left")):
        with pytest.raises(InputError, match=f"convex {words}"):
            target(tmp_path, document | {"convex": told})
    document["corners_mm"] = {"left": [[1, 2, 3], [4, 5]]}
    with pytest.raises(InputError, match="corners_mm, left, corner 2 must be a list of 3 numbers"):
        target(tmp_path, document)


DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize("kind", ["sphere", "step", "line"])
def test_the_files_in_the_docs_are_read(tmp_path, kind):
    text = (DOCS / "hand_eye.md").read_text()
    files = re.findall(rf"```yaml\n(kind: {kind}\n.*?)```", text, re.DOTALL)
    for file in files:
        (tmp_path / "target.yaml").write_text(file)
        found = read_target(tmp_path / "target.yaml")
        assert isinstance(
            found, {"sphere": SphereTarget, "step": StepTarget, "line": LineTarget}[kind]
        )
    assert len(files) == (2 if kind == "step" else 1)
    for table in re.findall(r"((?:    \S+,profile,.*\n)(?:    \S.*\n)+)", text):
        (tmp_path / "poses.csv").write_text(textwrap.dedent(table))
        assert read_pose_table(tmp_path / "poses.csv").files == ("shot_01.csv", "shot_02.csv")
    for table in re.findall(r"(    x_mm,z_mm\n(?:    \S.*\n)+)", text):
        (tmp_path / "a.csv").write_text(textwrap.dedent(table))
        with pytest.raises(
            TooFewSamplesError, match="has 2 points"
        ):  # three rows, one of them a gap
            read_profile(tmp_path / "a.csv", "a")


T = frames.transform(frames.exp_rotation([0.1, 0.2, 0.3]), [0.7, 0.1, 1 / 3])
STAIRS = Staircase(5, 0.09, 0.01, 0.01, "both")
FULL_STEP = StepTarget(T, STAIRS.marked_corners(), STAIRS.edge_user, 1e-5, 2e-4, 1e-3)
FULL_LINE = LineTarget(T[:3, 3], T[:3, 0])
K = np.array([[610.0 / 3, 0.0, 322.0], [0.0, 612.0, 236.0], [0.0, 0.0, 1.0]])
GIVEN = BoardTarget(9, 6, 0.025 / 3, K, np.array([0.1 / 3, 0, 0, 0, 0]), np.array([640.0, 480.0]))
TARGETS = [
    ("sphere", SphereTarget(0.1 / 3)), ("step", FULL_STEP), ("line", FULL_LINE),
    ("camera", BoardTarget(9, 6, 0.025 / 3)), ("camera", GIVEN),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "target"), TARGETS)
def test_a_target_comes_back_to_the_last_bit(kind, target):
    document = json.loads(json.dumps(target_document(kind, target), allow_nan=False))
    assert document["kind"] == kind
    found = target_of(document)
    assert type(found) is type(target)
    for field in fields(target):
        before, after = getattr(target, field.name), getattr(found, field.name)
        if field.name == "corners":
            assert list(after) == list(before)
            before, after = list(before.values()), list(after.values())
        assert np.array_equal(after, before)


def test_nothing_known_stays_nothing_known():
    assert target_of(target_document("line", None)) is None
    assert target_of({"kind": "camera"}) is None


def test_a_board_with_its_camera_is_known_whole():
    assert BoardTarget(9, 6, 0.025).intrinsics is None
    assert GIVEN.intrinsics.size == (640, 480)
    assert np.array_equal(GIVEN.intrinsics.matrix, K)
    assert (GIVEN.board.columns, GIVEN.board.rows, GIVEN.board.square_m) == (9, 6, 0.025 / 3)


def test_another_target_than_named_is_refused():
    with pytest.raises(InputError, match="describes a line, not a sphere"):
        target_document("sphere", FULL_LINE)
    step, line = target_document("step", FULL_STEP), target_document("line", FULL_LINE)
    for broken in (
        {"kind": "cone", "x": 1}, {"kind": "sphere", "width_m": 1}, {"radius_m": 1},
        {"kind": "sphere", "radius_m": "x"}, {"kind": "sphere", "radius_m": 0.0},
        {"kind": "sphere", "radius_m": float("nan")}, {"kind": "sphere", "radius_m": [0.02]},
        line | {"point_base": [0.0, 1.0]}, line | {"direction_base": 3.0},
        step | {"corners": {}}, step | {"corners": {"near": []}}, step | {"corners": 3.0},
        step | {"corners": {"near": [[0.0, 1.0]]}}, step | {"sigma_m": None},
    ):  # fmt: skip
        with pytest.raises(InputError, match="cannot be read"):
            target_of(broken)


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


# ---- target files of a camera's board ------------------------------------------------------------


BOARD = "kind: board\ncolumns: 9\nrows: 6\nsquare_mm: 25.5\n"
CAMERA = """\
image_width: 640
image_height: 480
camera_matrix: {rows: 3, cols: 3, data: [603.4, 0, 319.2, 0, 603.7, 234.9, 0, 0, 1]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.035, 0.98, 0.004, 0.002, -3.8]}
"""


def board_beside_camera(folder: Path, text: str) -> Path:
    (folder / "camera.yaml").write_text(CAMERA)
    path = folder / "board.yaml"
    path.write_text(text)
    return path


def test_a_board_is_read(tmp_path):
    found = read_target(board_beside_camera(tmp_path, BOARD))
    assert (found.columns, found.rows) == (9, 6)
    assert found.square_m == pytest.approx(0.0255, abs=1e-15)
    assert found.intrinsics is None


def test_the_intrinsics_lie_beside_the_board(tmp_path, monkeypatch):
    path = board_beside_camera(tmp_path, BOARD + "intrinsics: camera.yaml\n")
    monkeypatch.chdir("/")
    camera = read_target(path).intrinsics
    assert camera.size == (640, 480)
    assert np.array_equal(camera.matrix, [[603.4, 0, 319.2], [0, 603.7, 234.9], [0, 0, 1]])
    assert np.array_equal(camera.distortion, [0.035, 0.98, 0.004, 0.002, -3.8])
    assert camera.covariance is None


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("columns: 9\n", "", "columns is missing"),
        ("columns: 9", "columns: 2", "whole number from 3 to 100"),
        ("rows: 6", "rows: 6.5", "whole number from 3 to 100"),
        ("square_mm: 25.5", "square_mm: 0", "must be above 0"),
        ("square_mm: 25.5", "square_m: 0.0255", "not a known key"),
        ("rows: 6", "rows: 6\nintrinsics: none.yaml", "none.yaml"),
        ("rows: 6", "rows: 6\nintrinsics: 3", "must be a text"),
    ],
)
def test_a_wrong_board_names_its_key(tmp_path, old, new, words):
    with pytest.raises(InputError, match=words):
        read_target(board_beside_camera(tmp_path, BOARD.replace(old, new)))


def test_a_board_is_the_target_of_a_camera_alone(tmp_path):
    target = read_target(board_beside_camera(tmp_path, BOARD))
    assert target_document("camera", target)["kind"] == "camera"
    with pytest.raises(InputError, match="describes a camera, not a sphere"):
        target_document("sphere", target)
