# SPDX-License-Identifier: Apache-2.0
"""What is read of programs of each maker, and what of them comes out as it came in."""

import re
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from bench.robot_programs import NOMINAL, postures, programs
from robocal_ros.ground import frames
from robocal_ros.programs.conventions import numbers_of, pose_of
from robocal_ros.programs.correcting import DIALECTS, dialect_of
from robocal_ros.programs.points import Field, spliced, written

POINTS, JOINTS = postures(6, 1), postures(2, 2)
WRITTEN = programs(POINTS, JOINTS)

# Numbers of a rotation as each maker's manual has them, by scipy.
TURNS = {
    "kuka": lambda R: R.as_euler("ZYX", degrees=True),
    "fanuc": lambda R: R.as_euler("xyz", degrees=True),
    "kawasaki": lambda R: R.as_euler("ZYZ", degrees=True),
    "abb": lambda R: R.as_quat()[[3, 0, 1, 2]],
    "ur": lambda R: R.as_rotvec(),
}


@pytest.mark.filterwarnings("ignore:Gimbal lock")
@pytest.mark.parametrize("maker", TURNS)
@given(quat=st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_a_pose_is_read_as_its_maker_means_it(maker, quat):
    if np.linalg.norm(quat) < 1e-3:
        return
    R = Rotation.from_quat(quat)
    scale = 1.0 if maker == "ur" else 1e3
    place = [0.25, -1.5, 0.75]
    T = pose_of(maker, [*(scale * np.array(place)), *TURNS[maker](R)])
    # scipy's own angles leave out what is nearer to gimbal lock than 1e-7 rad
    exact = 1e-12 if maker in ("abb", "ur") else 4e-7
    np.testing.assert_allclose(T, frames.transform(R.as_matrix(), place), atol=exact)
    again = pose_of(maker, numbers_of(maker, T))
    np.testing.assert_allclose(again, T, atol=1e-7)  # at half a turn and at +-90 deg: by the root


@pytest.mark.parametrize("maker", TURNS)
def test_of_numbers_that_mean_the_same_the_nearest_are_written(maker):
    """A flange that looks down stays at +180 where it was at +180."""
    rng = np.random.default_rng(5)
    for R in Rotation.random(50, random_state=6):
        small = Rotation.from_rotvec(1e-4 * rng.standard_normal(3))
        before = [0.0, 0.0, 0.0, *TURNS[maker](R)]
        if maker == "abb":
            before[3:] = [-value for value in before[3:]]
        T = frames.transform((small * R).as_matrix(), np.zeros(3))
        after = np.array(numbers_of(maker, T, before)[3:])
        # near +-90 deg, or half a turn, the numbers themselves run
        slow = maker in ("abb", "ur") or min(abs(np.cos(np.radians(before[4]))), 1.0) > 0.1
        if slow and not (maker == "kawasaki" and abs(np.sin(np.radians(before[4]))) < 0.1):
            assert np.max(np.abs(after - before[3:])) < (0.3 if maker != "ur" else 0.05)


@pytest.mark.parametrize("maker", WRITTEN)
def test_every_point_is_found_where_it_is_written(maker):
    program = WRITTEN[maker]
    dialect = dialect_of(program.suffix)
    assert dialect.maker == maker
    found = dialect.read(program.text)
    poses = [point for point in found.points if not point.joints]
    given = [point for point in found.points if point.joints]
    assert (len(poses), len(given)) == (len(POINTS), len(program.joints))
    assert not any(point.problem for point in found.points)
    for point, q in zip(given, program.joints, strict=True):
        shown = dialect.to_arm(np.array(point.numbers) * point.joint_unit)
        digits = {"kuka": 1e-8, "abb": 1e-4, "fanuc": 2e-5, "ur": 1e-6, "kawasaki": 1e-4}[maker]
        np.testing.assert_allclose(shown, q, atol=digits)
    lines = program.text.split("\n")
    for point in found.points:
        block = "\n".join(lines[point.line - 1 : point.line + 6])
        assert all(part.text.strip() in block for part in point.fields)


@pytest.mark.parametrize("maker", WRITTEN)
def test_text_that_is_not_changed_stays_to_the_byte(maker):
    program = WRITTEN[maker]
    raw = program.text.encode("latin-1")
    text = raw.decode("latin-1")
    found = dialect_of(program.suffix).read(text)
    parts = [part for one in found.points for part in (*one.fields, *one.marks.values())]
    same = spliced(text, [(part, part.text) for part in parts])
    assert same.encode("latin-1") == raw
    for part in parts:  # each field is what it says
        assert text[part.start : part.end] == part.text
    gone = spliced(text, [(part, "") for part in parts])
    assert len(gone) == len(text) - sum(len(part.text) for part in parts)


@pytest.mark.parametrize("dialect", DIALECTS, ids=lambda dialect: dialect.maker)
@pytest.mark.parametrize("text", ["", "\n", "nothing of a program\n", "( ; ' \" .\n"])
def test_a_text_that_is_no_program_holds_no_points(dialect, text):
    assert dialect.read(text).points == ()


def test_endings_are_of_one_maker_each():
    endings = [suffix for dialect in DIALECTS for suffix in dialect.suffixes]
    assert len(endings) == len(set(endings))


KRL = """DEF Weld( )
$BASE=$NULLFRAME
BAS (#TOOL,2)
PTP {A1 0,A2 -90,A3 90,A4 0,A5 30,A6 0} ; {A1 1,A2 2,A3 3,A4 4,A5 5,A6 6}
LIN {X 1500,Y 0,Z 900,A 0,B 90,C 0,S 'B110',T 'B010010'} C_DIS
$TOOL={X 0,Y 0,Z 200,A 0,B 0,C 0}
CIRC {X 1,Y 2,Z 3,A 0,B 0,C 0},{X 4,Y 5,Z 6,A 0,B 0,C 0}
LIN_REL {X 10,Y 0,Z 0,A 0,B 0,C 0}
LIN {Z 900}
FRAME offset={X 1,Y 2,Z 3,A 0,B 0,C 0}
E6POS away={X 1500,Y 0,Z high,A 0,B 90,C 0,S 2,T 2}
E6POS track={X 1500,Y 0,Z 900,A 0,B 90,C 0,S 2,T 2,E1 812.5}
LIN away:offset
END
"""


def test_krl_in_a_program():
    found = dialect_of(".src").read(KRL)
    words = {point.name: point for point in found.points}
    assert list(words) == [
        "PTP in line 4", "LIN in line 5", "CIRC in line 7", "LIN_REL in line 8", "LIN in line 9",
        "away", "track",
    ]  # fmt: skip
    assert len(found.points) == 8  # both of the circle
    line = words["LIN in line 5"]
    assert (line.tool, line.frame) == ("TOOL_DATA[2]", "$NULLFRAME")
    assert line.posture.behind is False
    assert line.posture.above is True
    assert np.array_equal(
        line.posture.ranges[:, 1] == 0.0, [False, True, False, False, True, False]
    )
    circle = words["CIRC in line 7"]
    assert found.frames[circle.tool][2, 3] == pytest.approx(0.2)
    assert "relative" in words["LIN_REL in line 8"].problem
    assert "A, B, C" in words["LIN in line 9"].problem
    assert "'high'" in words["away"].problem
    assert (words["track"].problem, words["track"].external[1].value) == ("", 812.5)
    assert found.computed == ((13, "LIN away:offset"),)


def test_what_a_program_changes_itself_is_told():
    krl = (
        "BASE_DATA[2].Z=5\nTOOL_DATA[1]={X 1,Y 0,Z 0,A 0,B 0,C 0}\nXP1.X = XP1.X + 10\n"
        "IF XP1.Y == 3 THEN\n$TOOL=TOOL_DATA[1]\n$TOOL.Z=250\nLIN {X 1,Y 2,Z 3,A 0,B 0,C 0}\n"
    )
    found = dialect_of(".src").read(krl)
    words = {line: text for line, text in found.computed}
    assert words == {1: "BASE_DATA[2].Z=5", 3: "XP1.X = XP1.X + 10", 6: "$TOOL.Z=250"}
    assert found.points[0].tool == "$TOOL of line 6"  # no longer what it was
    assert "$TOOL of line 6" not in found.frames
    rapid = (
        "p10.trans.z:=p10.trans.z+5;\npNow := CRobT(\\Tool:=tGun);\nPDispOn p10,p20,tGun;\n"
        "wFix.uframe := DefFrame(p1,\n p2,p3);\n"
    )
    words = [text.partition(" ")[0] for _, text in dialect_of(".mod").read(rapid).computed]
    assert words == ["p10.trans.z:=p10.trans.z+5", "pNow", "PDispOn", "wFix.uframe"]
    fanuc = "/MN\n 1: UFRAME[2]=PR[3] ;\n 2: P[4]=LPOS ;\n 3:L P[4] 9mm/sec FINE ;\n/POS\n/END\n"
    words = [text for _, text in dialect_of(".ls").read(fanuc).computed]
    assert words == ["UFRAME[2]=PR[3]", "P[4]=LPOS"]


POINT = "{X 1,Y 2,Z 3,A 0,B 0,C 0}"


@pytest.mark.parametrize(
    ("lines", "points", "computed"),
    [
        (f"PTP XTC:{POINT}", {}, [3]),
        (f"LIN {POINT}:XP1", {}, [3]),
        (f"LIN {POINT} : {POINT}", {}, [3]),
        (f"LIN_REL {POINT}:XP1", {}, [3]),
        (
            f"DECL POS OFFS={POINT}\nDECL E6POS XP1={POINT}\nLIN XP1:OFFS",
            {"OFFS": "the program reckons with it in line 5", "XP1": ""},
            [5],
        ),
        (
            f"DECL POS P[2]\nP[1]={POINT}\nP[2]={POINT}\nLIN XP1:P[2]",
            {"P[1]": "", "P[2]": "the program reckons with it in line 6"},
            [6],
        ),
        (
            f"DECL POS P[1]\nP[1]={POINT}\nLIN F[I]:P[I]",
            {"P[1]": "the program reckons with it in line 5"},
            [5],
        ),
        (f"DECL POS XP2\nXP2={POINT}:XP1\nXP2=XP1:{POINT}", {}, [4, 5]),
        ("DECL POS XP2={POS: X 1,Y 2,Z 3,A 0,B 0,C 0}\nLIN XP2", {"XP2": ""}, []),
        (
            f"DECL POS WAY={POINT}\nDECL E6POS XP1={POINT}\nLIN_REL WAY\nCIRC_REL {POINT},XP1",
            {
                "WAY": "the program reckons with it in line 5",
                "XP1": "the program reckons with it in line 6",
                "CIRC_REL in line 6": "is relative to the point before",
            },
            [],
        ),
        (
            f"DECL E6POS WAY[2]\nWAY[1]={POINT}\nSLIN_REL WAY[I]",
            {"WAY[1]": "the program reckons with it in line 5"},
            [],
        ),
    ],
)
def test_an_operand_and_a_way_to_go_are_no_points(lines, points, computed):
    text = f"$TOOL=TOOL_DATA[1]\n$BASE=BASE_DATA[1]\n{lines}\n"
    found = dialect_of(".src").read(text)
    assert {point.name: point.problem for point in found.points} == points
    assert [line for line, _ in found.computed] == computed


def test_both_points_of_a_circle_are_found_and_one_to_an_angle_is_told():
    """Named and written out; where an angle is given the circle ends beyond its second point."""
    lines = f"XP1={POINT}\nXP2={POINT}\nCIRC {POINT},XP1\nSCIRC XP2,{POINT}, CA 270.0\n"
    found = dialect_of(".src").read(lines)
    assert [point.name for point in found.points] == [
        "XP1", "XP2", "CIRC in line 3", "SCIRC in line 4",
    ]  # fmt: skip
    assert not any(point.problem for point in found.points)
    assert [line for line, _ in found.computed] == [4]


def test_a_base_that_is_a_product_is_unknown():
    place = "{X 100,Y 0,Z 0,A 0,B 0,C 0}"
    for value in (f"{place}:BASE_DATA[2]", f"BASE_DATA[2]:{place}", f"{place} : {place}"):
        found = dialect_of(".src").read(f"$BASE={value}\nLIN {POINT}\n")
        assert [point.frame for point in found.points] == ["$BASE of line 1"]
        assert "$BASE of line 1" not in found.frames


def test_a_base_of_which_the_program_gives_no_one_value_is_unknown():
    """Set anew, whole or in part, or in part alone; once more the same is no other."""
    text = (
        f"BASE_DATA[1]={POINT}\nBASE_DATA[2]={POINT}\nBASE_DATA[3]={POINT}\n"
        f"BASE_DATA[1]={POINT}\nBASE_DATA[2]={POINT.replace('X 1', 'X 9')}\nBASE_DATA[3].Z=5\n"
        "BASE_DATA[4].Z=5\nBASE_DATA[4].X=I\n"
    )
    text += "".join(f"$BASE=BASE_DATA[{n}]\nLIN {POINT}\n" for n in (1, 2, 3, 4))
    found = dialect_of(".src").read(text)
    assert [point.frame for point in found.points] == [
        "BASE_DATA[1]", "BASE_DATA[2] of line 5", "BASE_DATA[3] of line 6",
        "BASE_DATA[4] of line 7",
    ]  # fmt: skip
    assert found.frames.keys() & {f"BASE_DATA[{n}]" for n in (1, 2, 3, 4)} == {"BASE_DATA[1]"}


def test_a_base_by_a_number_that_runs_is_told():
    text = f"BASE_DATA[NR]={POINT}\nBASE_DATA[1]={POINT}\n$BASE=BASE_DATA[NR]\n"
    assert [line for line, _ in dialect_of(".src").read(text).computed] == [1]


def test_points_in_an_array_are_found_whatever_counts_them():
    text = f"P[1]={POINT}\nQ[1]={POINT}\nR[1]={POINT}\nFOR I=1 TO 2\nPTP P[I]\nLIN Q[1]\nENDFOR\n"
    assert [point.name for point in dialect_of(".src").read(text).points] == ["P[1]", "Q[1]"]


def test_points_of_an_array_that_only_another_file_goes_to():
    """A data list declares an array and assigns its points; the motions stand in the .src."""
    text = f"DECL GLOBAL E6POS P[2], Q\nP[1]={POINT}\nP[2]={POINT}\nQ={POINT}\n"
    text += (
        f"DECL E6AXIS H[1]\nH[1]={{A1 0,A2 0,A3 0,A4 0,A5 0,A6 0}}\nDECL FRAME F[1]\nF[1]={POINT}\n"
    )
    points = dialect_of(".dat").read(text).points
    assert [point.name for point in points] == ["P[1]", "P[2]", "Q", "H[1]"]
    assert not any(point.problem for point in points)


def test_a_frame_that_is_set_but_not_read_is_unknown():
    """Not one that nothing is said of: for such the caller names what is taken."""
    krl = f"$BASE=BASE_DATA[1]:off\nLIN {POINT}\nBAS(#BASE,n)\nLIN {POINT}\n"
    found = dialect_of(".src").read(krl)
    assert [point.frame for point in found.points] == ["$BASE of line 1", "$BASE of line 3"]
    frame = '[FALSE,TRUE,"",[[0,0,0],[1,0,0,0]],[[0,0,0],[1,0,0,0]]]'
    rapid = f"PERS wobjdata w1:={frame};\nPERS wobjdata w2:={frame};\nw1:=w2;\n"
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    rapid += f"MoveL {target},v,z,tool0\\WObj:=w1;\nMoveL {target},v,z,tool0\\WObj:=w2;\n"
    found = dialect_of(".mod").read(rapid)
    assert [point.problem for point in found.points] == ["w1 is set again in line 3", ""]
    script = "set_tcp(a)\nmovel(p[1,2,3,0,0,0])\nset_tcp(b)\nmovel(p[1,2,3,0,0,0])\n"
    script += "movej(get_inverse_kin(p[1,2,3,0,0,0], tcp=c))\n"
    tools = ["set_tcp of line 1", "set_tcp of line 3", "tcp of get_inverse_kin in line 5"]
    found = dialect_of(".script").read(script)
    assert [point.tool for point in found.points] == tools
    assert not found.frames.keys() & set(tools)


def test_a_switch_before_the_point_of_a_motion():
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    rapid = f"CONST robtarget p1:={target};\nMoveL \\Conc, p1, v100, z10, tool0\\WObj:=w1;\n"
    (point,) = dialect_of(".mod").read(rapid).points
    assert (point.tool, point.frame) == ("tool0", "w1")


@pytest.mark.parametrize(
    ("motion", "tool", "frame"),
    [
        ("MoveLDO p1,v9,fine,tGun\\WObj:=wFix,doGrip,1", "tgun", "wfix"),
        ("ArcLStart p1,v9,sSeam,wWeld\\Weave:=wv,fine,tGun\\WObj:=wFix", "tgun", "wfix"),
        ("TriggL p1,v9,trOn\\T2:=trOff,z20,tGun", "tgun", "wobj0"),
        ("SearchL\\Stop,diTouch,pFound,p1,v9,tGun\\WObj:=wFix", "tgun", "wfix"),
        ("SearchC\\Stop,diTouch,pFound,pVia,p1,v9,tGun", "tgun", "wobj0"),
        ("MoveJ \\ID:=5,p1,v9,z1,tGun,\\WObj:=wFix", "tgun", "wfix"),
        ("MoveLDO p1,v9,fine,tGun,doGrip,1", "of MoveLDO in line 2", "wobj0"),
    ],
)
def test_a_motion_says_its_tool_wherever_that_is_declared(motion, tool, frame):
    """What is not found is unknown: `--tool` is of motions that say none."""
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    (point,) = dialect_of(".mod").read(f"CONST robtarget p1:={target};\n{motion};\n").points
    assert (point.tool, point.frame) == (tool, frame)


@pytest.mark.parametrize(
    ("text", "tool"),
    [
        ("PROC MoveHome()\n{};\nENDPROC", "tgun"),
        ("PROC ArcPath()\n{};\nENDPROC\nPROC B ()\n{};\nENDPROC", "tgun"),
        ("PROC MovePick()\n{};\nENDPROC\nPROC B()\nMoveL p1,v9,z1,tB;\nENDPROC", None),
        ("MODULE MoveParts\nPROC B()\n{};\nENDPROC\nENDMODULE", "tgun"),
        ("IF SearchOk THEN\n{};\nENDIF", "tgun"),
        ("IF SearchOk=TRUE AND i>2 {};", "tgun"),
        ("IF SearchOk THEN\nMoveJ\\Conc,p1,v9,z1,tGun;\nENDIF", "tgun"),
        ("TEST n\nCASE SpotA: {};\nENDTEST", "tgun"),
        ("MoveSafe;\nSearchCount:=0;\n{};", "tgun"),
        ("SearchL\\Stop,searchSig\\Flanks,pFound,p1,v9,tGun;", "tgun"),
        ("MoveJ p1,\n  moveSpeed,moveZone \\Inpos:=i,\n  tGun;", "tgun"),
    ],
)
def test_a_name_that_begins_as_a_motion_hides_none_behind_it(text, tool):
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    motion = "MoveL p1,v9,fine,tGun"
    module = f"CONST robtarget p1:={target};\n" + text.replace("{}", motion) + "\n"
    (point,) = dialect_of(".mod").read(module).points
    assert point.tool == tool
    literal = text.replace("{}", motion).replace("p1", target)
    points = dialect_of(".mod").read(literal + "\n").points
    assert len(points) == literal.count(target)


@pytest.mark.parametrize(
    ("switch", "motion", "followed"),
    [
        ("ConfL\\Off;", "MoveL", False),
        ("ConfL\\Off;", "MoveJ", True),
        ("ConfJ \\Off;", "MoveJ", False),
        ("ConfL\\Off;\nConfL\\On;", "MoveL", True),
        ("ConfL\\Off;\nMoveJ p1,v100,z10,tool0;", "MoveL", True),  # one of its motions follows it
        ("! ConfL\\Off;", "MoveL", True),
    ],
)
def test_a_configuration_holds_where_a_motion_follows_it(switch, motion, followed):
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    text = f"CONST robtarget p1:={target};\n{switch}\n{motion} p1,v100,z10,tool0;\n"
    (point,) = dialect_of(".mod").read(text).points
    assert point.posture.told is followed
    assert bool(point.marks) is followed


def test_points_come_in_the_order_of_their_motions():
    target = "[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]"
    text = "".join(f"CONST robtarget p{i}:={target};\n" for i in (1, 2, 3))
    text += "MoveL p3,v100,z10,tool0;\nMoveL p1,v100,z10,tool0;\n"
    points = sorted(dialect_of(".mod").read(text).points, key=lambda point: point.order)
    assert [point.name for point in points] == ["p3", "p1", "p2"]


def test_urscript_with_named_arguments_and_targets_that_are_not_read():
    script = (
        "movel(pose=p[1,2,3,0,0,0], a=1)\nl=[p[1,2,3,0,0,0]]\nmovel(l[0])\nmovej(q=[0,1,2,3,4,5])\n"
    )
    found = dialect_of(".script").read(script)
    assert [(point.line, point.joints) for point in found.points] == [(1, False), (4, True)]
    assert found.computed == ((3, "l[0]"),)


def test_points_that_a_script_changes_itself_are_told():
    script = (
        "A_p=p[.4,-.3,.2,0,3.1,0]\nA_p[2]=0.415+dz\nmovel(A_p)\n"
        "  global A_p = get_actual_tcp_pose()\nif A_p==B:\nmovel(A_p)\nend\n"
        "q=[0,1,2,3,4,5]\nx=q[1]\nmovej(q)\nA_p=p[.5,-.3,.2,0,3.1,0]\n"
    )
    found = dialect_of(".script").read(script)
    assert [point.line for point in found.points] == [1, 8, 11]
    assert found.computed == ((2, "A_p[2]=0.415+dz"), (4, "global A_p = get_actual_tcp_pose()"))


def test_points_of_optimised_motions_of_urscript():
    script = "A_p=p[.4,-.3,.2,0,3.1,0]\noptimovel(A_p, a=.3, v=.3)\noptimovej([0,1,2,3,4,5])\n"
    found = dialect_of(".script").read(script)
    assert [(point.name, point.joints) for point in found.points] == [
        ("A_p", False), ("line 3", True),
    ]  # fmt: skip


def test_krl_with_a_tool_that_stands_and_an_exact_robot():
    text = (
        "DECL E6POS XP1={X 1,Y 2,Z 3,A 0,B 0,C 0,S 18,T 2}\n"
        "DECL FDAT FP1={TOOL_NO 1,BASE_NO 2,IPO_FRAME #TCP}\n"
        "TOOL_DATA[1]={X 10,Y 0,Z 0,A 90,B 0,C 0}\nBASE_DATA[2]={X 0,Y 0,Z 5,A 0,B 0,C 0}\n"
    )
    found = dialect_of(".dat").read(text)
    assert [point.name for point in found.points] == ["XP1"]
    assert "stands" in found.points[0].problem
    np.testing.assert_allclose(found.frames["TOOL_DATA[1]"][:3, 1], [-1.0, 0.0, 0.0], atol=1e-12)
    assert "absolutely accurate" in found.notes[0]


RAPID = r"""MODULE M
  PERS tooldata tStand:=[FALSE,[[0,0,10],[1,0,0,0]],[1,[0,0,1],[1,0,0,0],0,0,0]];
  PERS wobjdata wTwo:=[FALSE,TRUE,"",[[100,0,0],[1,0,0,0]],[[0,50,0],[0.7071068,0,0,0.7071068]]];
  VAR robtarget pa{2}:=[[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]],
    [[4,5,6],[1,0,0,0],[-1,0,0,5],[9E9,9E9,9E9,9E9,9E9,9E9]]];
  CONST robtarget pOnTrack:=[[1,2,3],[1,0,0,0],[0,0,0,0],[812.5,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget pVar:=[[1,y,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget pTwice:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  CONST robtarget pStand:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]];
  PROC main()
    MoveJ [[6,0,8],[0,0,1,0],[0,0,0,0],[9E9,9E9,9E9,9E9,9E9,9E9]]\ID:=1,v9,fine,tool0\WObj:=wTwo;
    MoveL pTwice,v200\V:=50,z10,tool0;
    MoveL RelTool(pTwice,0,0,5),v200,z10,tool0\WObj:=wTwo; ! MoveL pa,v1,fine,tOther;
    MoveL pStand,v200,z10,tStand;
    MoveC pa{1},pa{2},v200,z10,tool0\WObj:=wTwo;
  ENDPROC
ENDMODULE
"""


def test_rapid_in_a_module():
    found = dialect_of(".mod").read(RAPID)
    words = {point.name: point for point in found.points}
    assert set(words) == {
        "pa{1}", "pa{2}", "pOnTrack", "pVar", "pTwice", "pStand", "MoveJ in line 11",
    }  # fmt: skip
    inline = words["MoveJ in line 11"]
    assert (inline.tool, inline.frame) == ("tool0", "wtwo")
    np.testing.assert_allclose(found.frames["wtwo"][:3, 3], [0.1, 0.05, 0.0], atol=1e-12)
    np.testing.assert_allclose(found.frames["wtwo"][:3, 0], [0.0, 1.0, 0.0], atol=1e-8)
    second = words["pa{2}"]
    assert second.numbers[:3] == [4.0, 5.0, 6.0]
    assert second.posture.behind is True
    assert second.posture.above is True
    np.testing.assert_allclose(second.posture.ranges[0], np.radians([-90.0, 0.0]))
    assert second.posture.ranges[4, 1] == 0.0
    assert (second.tool, second.frame) == ("tool0", "wtwo")
    assert words["pOnTrack"].problem == ""
    assert words["pOnTrack"].external[1].value == 812.5
    assert "'y'" in words["pVar"].problem
    assert "different" in words["pTwice"].problem
    assert "stands" in words["pStand"].problem
    assert found.computed == ((13, "RelTool(pTwice, …)"),)


FANUC = """/PROG  A
/MN
   1:J P[1] 50% FINE    ;
   2:L P[2] 100mm/sec FINE INC    ;
   3:L P[3] 100mm/sec FINE Offset,PR[1]    ;
/POS
P[1]{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'F D B, 0, 1, -1',
\tX =  1731.500  mm,\tY =     2.242  mm,\tZ =  -321.863  mm,
\tW =  -176.060 deg,\tP =      .147 deg,\tR =  -172.829 deg
   GP2:
\tUF : 0, UT : 1,\t
\tJ1=   300.000  mm
};
P[2]{
   GP1:
\tUF : 0, UT : 1,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX =    10.000  mm,\tY =     0.000  mm,\tZ =     0.000  mm,
\tW =     0.000 deg,\tP =     0.000 deg,\tR =     0.000 deg
};
P[3:"gap"]{
   GP1:
\tUF : F, UT : F,\t\tCONFIG : 'N U T, 0, 0, 0',
\tX = ********  mm,\tY =     0.000  mm,\tZ =     0.000  mm,
\tW =     0.000 deg,\tP =     0.000 deg,\tR =     0.000 deg
};
/END
"""


def test_fanuc_positions():
    found = dialect_of(".LS").read(FANUC)
    one, two, three = found.points
    assert one.numbers == [1731.5, 2.242, -321.863, -176.06, 0.147, -172.829]
    assert (one.tool, one.frame) == ("UT1", "UF0")
    assert (one.posture.above, one.posture.behind) == (False, True)
    assert one.posture.ranges[4, 0] == 0.0
    turned = np.degrees(one.posture.ranges[[0, 3, 5]])
    np.testing.assert_allclose(turned, [[-180, 180], [180, 540], [-540, -180]])
    assert "INC" in two.problem
    assert three.name == "P[3] gap"
    assert "'********'" in three.problem
    assert three.tool is None
    assert found.computed == ((5, "P[3] 100mm/sec FINE Offset,PR[1]"),)
    (note,) = found.notes
    assert "group 2: its positions stay as they are, the first of 1 in line 7" in note


def test_a_fanuc_position_of_another_group_is_told_and_no_position_of_the_robot():
    """Beside the robot's, before it, and alone: as of a program for the second robot."""
    text = FANUC.replace("GP2:", "GP3:").replace("   GP1:\n\tUF : F", "   GP2:\n\tUF : F")
    other = "   GP2:\n\tUF : 0, UT : 1,\n\tX = 7.000 mm,\tY = 8.000 mm\n"
    text = text.replace("P[2]{\n", f"P[2]{{\n{other}")
    found = dialect_of(".ls").read(text)
    one, two, three = found.points
    assert one.numbers[0] == 1731.5
    assert two.numbers[0] == 10.0
    assert (three.name, three.fields, three.problem) == (
        "P[3] gap", (), "is of group 2 alone: group 1 alone is corrected",
    )  # fmt: skip
    told = [note.partition(":")[0] + note.partition(",")[2] for note in found.notes]
    assert told == [
        "group 2 the first of 2 in line 16; group 1 alone is corrected",
        "group 3 the first of 1 in line 7; group 1 alone is corrected",
    ]


@pytest.mark.parametrize(
    ("motion", "led"),
    [
        ("L P[1] 9mm/sec FINE COORD PTH ;", True),
        ("C P[1]\n    :  P[2] 9mm/sec FINE\n    :  COORD ;", True),
        ("L P[1:COORD] 9mm/sec FINE ;\n   2:  !COORD ;", False),
    ],
)
def test_fanuc_motions_that_another_group_leads_are_told(motion, led):
    notes = dialect_of(".ls").read(f"/PROG  A\n/MN\n   1:{motion}\n/POS\n/END\n").notes
    assert [note.startswith("line 3: COORD") for note in notes] == [True] * led


def test_fanuc_options_on_the_line_behind():
    """As controllers write circles and long motions; the second point is not relative."""
    lines = "   1:C P[1] INC\n    :  P[2] 9mm/sec FINE\n    :  WKZ_Offset,PR[1]    ;\n"
    lines += "   2:L P[3] 9mm/sec FINE\n    :  INC    ;\n"
    blocks = FANUC[FANUC.index("/POS") :]
    found = dialect_of(".ls").read(f"/PROG  A\n/MN\n{lines}{blocks}")
    relative = ["relative" in point.problem for point in found.points]
    assert relative == [True, False, True]
    assert found.computed == ((4, "P[2] 9mm/sec FINE : WKZ_Offset,PR[1]"),)


SCRIPT = """def P():
  global A_p=p[.4, -.3, .2, 0, 3.1416, 0]  # p[1,2,3,4,5,6]
  B=[0, -1.57, 1.57, 0, 1.57, 0]
  set_tcp(p[0,0,.1,0,0,0])
  force_mode(p[0,0,0,0,0,0], [0,0,1,0,0,0], [0,0,10,0,0,0], 2, [.1,.1,.1,.1,.1,.1])
  movej(B, a=1.4, v=1)
  movel(A_p, a=1.2, v=.25)
  set_tcp(p[0,0,.2,0,0,0])
  movec(p[.4,-.3,.25,0,3.1,0], pose_trans(A_p, p[0,0,.1,0,0,0]), a=1.2, v=.25)
  movej(get_inverse_kin(p[.4,-.3,z,0,3.1,0], qnear=B))
end
"""


@pytest.mark.parametrize(
    "config", ["N R U T, 0, 1, 0", "NUT, 0, 0, 0", "N U T, 0, 0", "N U T, 0, x, 0"]
)
def test_a_fanuc_configuration_of_another_shape_is_not_guessed(config):
    point = dialect_of(".ls").read(FANUC.replace("F D B, 0, 1, -1", config)).points[0]
    assert f"'{config}'" in point.problem
    assert not point.posture.told


def test_urscript_targets():
    found = dialect_of(".script").read(SCRIPT)
    assert [point.name for point in found.points] == ["A_p", "B", "line 9", "line 10"]
    named, joints, circle, last = found.points
    assert (joints.joints, named.joints) == (True, False)
    assert named.order > joints.order  # the motion to it comes later
    np.testing.assert_allclose(found.frames[named.tool][2, 3], 0.1)
    np.testing.assert_allclose(found.frames[circle.tool][2, 3], 0.2)
    assert "'z'" in last.problem
    np.testing.assert_allclose(last.posture.near, joints.numbers)
    assert found.computed == ((9, "pose_trans(…)"),)


@pytest.mark.parametrize(
    ("value", "old", "digits", "expected"),
    [
        (12.34567, "12.3", None, "12.3457"),
        (12.34567, "12.3456789", None, "12.3456700"),
        (-0.00001, "0", None, "0.0000"),
        (600.0, "6E+02", None, "600.0000"),
        (-0.3841, "   -.384", 3, "   -.384"),
        (0.0002, "    0.000", 3, "    0.000"),
        (-1371.1664, " -1371.166", 3, " -1371.166"),
    ],
)
def test_a_number_is_written_as_the_one_before(value, old, digits, expected):
    assert written(value, Field(0, old), 4, digits) == expected


def test_decimals_with_an_exponent():
    assert Field(0, "1.25E-3").decimals == 5
    assert Field(0, "9E9").decimals == 0
    assert re.fullmatch(r"-?\d+\.\d{5}", written(-0.001251, Field(0, "1.25E-3"), 4))


def test_the_robot_of_these_programs_is_as_its_side_view():
    """The lengths that `robot_programs.side_view` states are the robot file's."""
    T = NOMINAL.fk(np.radians([0.0, -90.0, 90.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(T[:3, 3], [1.965, 0.0, 1.984], atol=1e-9)


@pytest.mark.parametrize("maker", WRITTEN)
@given(data=st.data())
def test_text_that_somebody_has_spoiled_harms_nothing(maker, data):
    """Cut, doubled and mistyped: what is still read as a point is written where it stands."""
    text = WRITTEN[maker].text
    for _ in range(data.draw(st.integers(1, 4))):
        at, length = data.draw(st.tuples(st.integers(0, len(text)), st.integers(0, 40)))
        new = data.draw(st.text("[](){},;:=.-+019eEXPJ\"'!#\\ \n\xe4", max_size=3))
        text = text[:at] + new + text[at + length :]
    found = dialect_of(WRITTEN[maker].suffix).read(text)
    fine = [point for point in found.points if not point.problem]
    parts = [part for point in fine for part in (*point.fields, *point.marks.values())]
    assert all(text[part.start : part.end] == part.text for part in parts)
    assert all(np.all(np.isfinite(point.numbers)) for point in fine)
    assert spliced(text, [(part, part.text) for part in set(parts)]) == text


AS = """.NETCONF 192.168.0.2,"c",255.255.255.0
.PROGRAM main() ;LMOVE a
  TOOL gun
  LMOVE a
  BASE TRANS(0,0,100)
  JAPPRO b, 50
  TOOL hand[.n]
  LMOVE c
  LMOVE fix+d
  FOR .i = 1 TO 2
    LMOVE row[.i]
  END
  JMOVE #e
  HERE f
  LMOVE f
  ABOVE
  LMOVE g
  TOOL NULL
  LMOVE g
  LMOVE there
.END
.TRANS
a 1 2 3 0 0 0
b 1 2 3 0 0 0
c 1 2 3 0 0 0
d 1 2 3 0 0 0
f 1 2 3 0 0 0
g 1 2 3 0 0 0
gun 0 0 250 0 0 0
lone 1 2 3 0 0 0
row[1] 1 2 3 0 0 0
short 1 2 3
.END
.JOINTS
#e 1 2 3 4 5 6 812.5
.END
"""


def test_as_programs_and_their_locations():
    found = dialect_of(".as").read(AS)
    words = {point.name: point for point in found.points}
    assert list(words) == ["a", "b", "c", "f", "g", "row[1]", "#e"]
    assert (words["a"].tool, words["a"].frame) == ("TOOL of line 3", None)
    assert (words["b"].tool, words["b"].frame) == ("TOOL of line 3", "BASE of line 5")
    np.testing.assert_allclose(found.frames["TOOL of line 3"][:3, 3], [0.0, 0.0, 0.25])
    np.testing.assert_allclose(found.frames["BASE of line 5"][:3, 3], [0.0, 0.0, 0.1])
    assert words["c"].tool == "TOOL of line 7"  # reckoned, so unknown: not the one before
    assert "TOOL of line 7" not in found.frames
    assert "reckons with it in line 14" in words["f"].problem
    assert "different" in words["g"].problem
    assert "reckons with it in line 11" in words["row[1]"].problem
    assert len(words["#e"].fields) == 6  # what is behind them is an external axis
    assert found.computed == ((9, "fix+d"), (11, "row[.i]"), (20, "there"))
    assert "ABOVE" in found.notes[0]


def test_points_of_weld_motions_and_of_motions_up_to_a_signal():
    moves = ("JMOVE a", "XMOVE b TILL 1001", "LWS c,1", "LWC d,1", "C1WC e,1", "C2WE f, 1")
    lines = "\n ".join(("TOOL NULL", "BASE NULL", *moves))
    rows = "\n".join(f"{name} 1 2 3 0 0 0" for name in "abcdef")
    found = dialect_of(".as").read(f".PROGRAM m()\n {lines}\n.END\n.TRANS\n{rows}\n.END\n")
    assert [point.name for point in found.points] == [*"abcdef"]
    assert {(point.tool, point.frame, point.problem) for point in found.points} == {
        ("NULL", "NULL", "")
    }
    assert found.computed == ()


@pytest.mark.parametrize(
    ("line", "constant"),
    [
        ("POINT gun = gun+TRANS(0,0,dz)", False),
        ("POINT/OAT gun = far", False),
        ("HERE gun", False),
        ("POINT far = gun", True),
        ("d = DISTANCE(gun,far)", True),
    ],
)
def test_a_tool_that_the_program_sets_itself_is_unknown(line, constant):
    """Also where another program sets it."""
    rows = ".TRANS\na 500 0 300 0 180 0\ngun 0 0 250 0 0 0\nfar 1 2 3 0 0 0\n.END\n"
    text = f".PROGRAM m()\n TOOL gun\n LMOVE a\n.END\n.PROGRAM set()\n {line}\n.END\n{rows}"
    found = dialect_of(".as").read(text)
    assert found.points[0].tool == "TOOL of line 2"
    assert ("TOOL of line 2" in found.frames) is constant


def test_a_file_of_locations_alone_has_them_all():
    found = dialect_of(".lc").read(AS[AS.index(".TRANS") :])
    assert [point.name for point in found.points] == [
        "a", "b", "c", "d", "f", "g", "gun", "lone", "row[1]", "short", "#e",
    ]  # fmt: skip
    assert "3 numbers" in found.points[-2].problem
    assert {point.tool for point in found.points} == {None}


@pytest.mark.parametrize("tool", ["TRANS(nan)", "TRANS(1e999,0,0)", "inf", "far", "TRANS(1,,x)"])
def test_what_is_no_number_is_no_tool_and_no_point_of_kawasaki(tool):
    """Finding: a number too large to be one ended the correction of the whole program."""
    text = f".PROGRAM m()\n TOOL {tool}\n LMOVE a\n LMOVE b\n JMOVE #c\n.END\n.TRANS\n"
    text += (
        "a 1 2 3 0 0 0\nb 1e999 2 3 0 0 0\nfar 1e999 0 0 0 0 0\n.END\n.JOINTS\n#c 0 0 0 1e999 0 0\n"
    )
    found = dialect_of(".as").read(text)
    assert list(found.frames) == ["NULL"]
    assert ["number" in point.problem for point in found.points] == [False, True, True]


def test_a_long_program_of_kawasaki_is_read_in_time():
    """Finding: 8000 points took 47 s, and four times as long twice as many."""
    count = 8000
    moves = "".join(f"  LMOVE p{i}\n  x[.k] = 1\n" for i in range(count))
    rows = "".join(f"p{i} 1 2 3 0 0 0\n" for i in range(count))
    text = f".PROGRAM m()\n  TOOL gun\n{moves}.END\n.TRANS\ngun 0 0 9 0 0 0\n{rows}.END\n"
    begin_s = time.process_time()
    found = dialect_of(".as").read(text)
    assert time.process_time() - begin_s < 15.0
    assert len(found.points) == count
    assert {point.tool for point in found.points} == {"TOOL of line 2"}
