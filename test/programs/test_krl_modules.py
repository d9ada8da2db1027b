# SPDX-License-Identifier: Apache-2.0
"""KUKA's modules: what the .src does with what the .dat declares, and the other way round."""

import pytest

from robocal_ros.programs.correcting import dialect_of
from robocal_ros.programs.krl import KrlDialect

POINT = "{X 1,Y 2,Z 3,A 0,B 0,C 0}"
# As controllers keep it: points of inline forms, frames that a hand wrote, a way, an offset.
DATA = f"""DEFDAT  WELD PUBLIC
DECL E6POS XP1={POINT}
DECL FDAT FP1={{TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE,POINT2[] " "}}
DECL E6POS XVIA={POINT}
DECL E6POS XP3={POINT}
DECL FDAT FP3={{TOOL_NO 7,BASE_NO 8,IPO_FRAME #BASE,POINT2[] " "}}
DECL POS WAY={{X 0.0,Y 0.0,Z 50.0,A 0.0,B 0.0,C 0.0}}
DECL FRAME OFFS={POINT}
DECL FRAME SEAM[3]
SEAM[1]={POINT}
SEAM[2]={POINT}
SEAM[3]={POINT}
DECL POS P2={POINT}
ENDDAT
"""
PROGRAM = """DEF  WELD( )
BAS(#TOOL,3)
BAS(#BASE,4)
PTP XP1
LIN seam[1] C_DIS
LIN_REL WAY
LIN XP1:OFFS
FDAT_ACT=FP3
CIRC XVIA, XP3
BAS(#TOOL,3)
$BASE=BASE_DATA[5]
LIN SEAM[2]
LIN P2
$BASE=BASE_DATA[6]
LIN P2
END
"""


def frames_of(points) -> dict[str, tuple[str | None, str | None]]:
    return {point.name: (point.tool, point.frame) for point in points}


def test_what_the_program_does_with_the_points_of_its_data_list():
    found = KrlDialect(PROGRAM, "weld.src").read(DATA)
    problems = {point.name: point.problem for point in found.points if point.problem}
    assert problems == {
        "WAY": "the program reckons with it in line 6 of weld.src",
        "P2": "motions with different tools or bases go to it",
    }
    assert frames_of(point for point in found.points if not point.problem) == {
        "XP1": ("TOOL_DATA[1]", "BASE_DATA[2]"),
        "XVIA": ("TOOL_DATA[7]", "BASE_DATA[8]"),  # of the circle's end
        "XP3": ("TOOL_DATA[7]", "BASE_DATA[8]"),
        "SEAM[1]": ("TOOL_DATA[3]", "BASE_DATA[4]"),
        "SEAM[2]": ("TOOL_DATA[3]", "BASE_DATA[5]"),
    }
    assert found.computed == ()  # it is of the other file, and told there
    assert found.notes == ("line 7 of weld.src makes points or frames itself: look",)
    in_order = sorted((point for point in found.points), key=lambda point: point.order)
    moved = [point.name for point in in_order if point.name != "WAY"]
    assert moved == ["XP1", "SEAM[1]", "XVIA", "XP3", "SEAM[2]", "P2"]
    for point in found.points:
        assert all(DATA[part.start : part.end] == part.text for part in point.fields)


def test_alone_a_data_list_has_what_it_declares_as_positions():
    found = dialect_of(".dat").read(DATA)
    assert [point.name for point in found.points] == ["XP1", "XVIA", "XP3", "WAY", "P2"]
    assert not any(point.problem for point in found.points)


def test_a_program_has_the_frames_of_its_data_list():
    """Of an inline form's FDAT, and TOOL_DATA that stand in it; its points are of that file."""
    data = f"{DATA}TOOL_DATA[7]={POINT}\nDECL E6POS OWN\n"
    lines = f"DEF WELD()\nFDAT_ACT=FP3\nLIN {POINT}\nOWN={POINT}\nLIN OWN\nEND\n"
    found = KrlDialect(data, "weld.dat").read(lines)
    assert frames_of(found.points) == {
        "LIN in line 3": ("TOOL_DATA[7]", "BASE_DATA[8]"),
        "OWN": ("TOOL_DATA[7]", "BASE_DATA[8]"),
    }
    assert "TOOL_DATA[7]" in found.frames
    other = KrlDialect(f"{data}TOOL_DATA[7]={POINT.replace('1', '9')}\n", "weld.dat").read(lines)
    line = data.count("\n") + 1
    assert other.points[0].tool == f"TOOL_DATA[7] of line {line} of weld.dat"


@pytest.mark.parametrize(
    ("lines", "frames"),
    [  # set before the base that the motion has
        ([f"P={POINT}", "$BASE=BASE_DATA[2]", "LIN P"], ["BASE_DATA[2]"]),
        # once more: each value has the motions behind it
        (
            [f"P={POINT}", "LIN P", f"P={POINT}", "$BASE=BASE_DATA[2]", "LIN P"],
            ["BASE_DATA[1]", "BASE_DATA[2]"],
        ),
        (
            ["IF A THEN", f"P={POINT}", "ELSE", f"P={POINT}", "ENDIF", "LIN P"],
            ["BASE_DATA[1]", "BASE_DATA[1]"],
        ),
        # a routine's own variable is not that of another one
        (
            [f"P={POINT}", "LIN P", "END", "DEF B()", "DECL FRAME P", f"P={POINT}",
             "$BASE=BASE_DATA[3]", "LIN P", "LIN_REL P"],
            ["BASE_DATA[1]", "BASE_DATA[3]"],
        ),
        ([f"P={POINT}", "SLIN P WITH $BASE=BASE_DATA[9]"], ["BASE_DATA[9]"]),
        ([f"P={POINT}", "GO_THERE(P)"], [None]),  # nobody says which
    ],
)  # fmt: skip
def test_a_point_is_in_the_base_of_its_motions(lines, frames):
    text = "\n".join(["DEF A()", "DECL POS P", "$BASE=BASE_DATA[1]", *lines, "END", ""])
    points = dialect_of(".src").read(text).points
    assert [point.frame for point in points] == frames
    reckoned = [point.problem for point in points if point.problem]
    assert reckoned == (["the program reckons with it in line 12"] if "DEF B()" in lines else [])


B1, B2, LIN, SET = "$BASE=BASE_DATA[1]", "$BASE=BASE_DATA[2]", "LIN P", f"P={POINT}"
DIFFERENT = "motions with different tools or bases go to it"


@pytest.mark.parametrize(
    ("lines", "found"),
    [  # by value its base, or that motions differ
        ([B1, SET, LIN, B2, SET, LIN], ["BASE_DATA[1]", "BASE_DATA[2]"]),
        # the next round begins with the value that the one before has set
        (["LOOP", B1, LIN, B2, SET, LIN, "ENDLOOP"], [DIFFERENT]),
        (["LOOP", B1, SET, LIN, B2, SET, LIN, "ENDLOOP"], ["BASE_DATA[1]", "BASE_DATA[2]"]),
        ([SET, "WHILE A", B1, LIN, B2, SET, LIN, "ENDWHILE"], ["BASE_DATA[1]", DIFFERENT]),
        ([B1, SET, "REPEAT", LIN, "UNTIL A", B2, SET, LIN], ["BASE_DATA[1]", "BASE_DATA[2]"]),
        # and so does a routine that is called again, or that others call
        ([B1, LIN, B2, SET, LIN], [DIFFERENT]),
        ([SET, B1, LIN, "B()", SET, LIN, "END", "DEF B()", B2, LIN], [DIFFERENT, DIFFERENT]),
        (
            [SET, B1, LIN, "END", "DEF B()", SET, B2, LIN],
            ["BASE_DATA[1]", "BASE_DATA[2]"],
        ),
        (  # what is called between sets it anew
            [SET, "B()", B1, LIN, "END", "DEF B()", SET, B2, LIN],
            ["BASE_DATA[1]", DIFFERENT],
        ),
        (
            [B1, SET, "B()", LIN, B2, SET, "B()", LIN, "END", "DEF B()"],
            ["BASE_DATA[1]", "BASE_DATA[2]"],
        ),
        # a value that only one branch sets does not end the one before
        ([B1, SET, LIN, "IF A THEN", SET, "ENDIF", B2, LIN], [DIFFERENT, "BASE_DATA[2]"]),
        (
            ["SWITCH A", "CASE 1", B1, SET, LIN, "CASE 2", B2, SET, LIN, "ENDSWITCH"],
            ["BASE_DATA[1]", "BASE_DATA[2]"],
        ),
        ([B1, SET, "GOTO ON", B2, SET, "ON:", B1, LIN, B2, LIN], [DIFFERENT, DIFFERENT]),
        # nor does one that leaves components as they are
        (
            [B1, SET, LIN, "P={Z 9}", B2, LIN],
            [DIFFERENT, "leaves components as they are at run time: X, Y, A, B, C"],
        ),
    ],
)
def test_a_value_has_the_base_of_the_motions_that_it_reaches(lines, found):
    """P is the module's, declared in its data list: it outlives the routines."""
    text = "\n".join(["DEF A()", *lines, "END", ""])
    points = KrlDialect("DEFDAT A\nDECL POS P\nENDDAT\n", "a.dat").read(text).points
    assert [point.problem or point.frame for point in points] == found


def test_a_value_of_the_data_list_reaches_what_no_other_one_goes_before():
    data = f"DEFDAT A\nDECL POS P={POINT}\nENDDAT\n"
    for body, found in (
        ([B1, LIN, "PLACE()", SET, "END", "DEF PLACE()", B2, LIN], DIFFERENT),
        ([B1, LIN, B2, SET, LIN], "BASE_DATA[1]"),
    ):
        text = "\n".join(["DEF A()", *body, "END", ""])
        (point,) = KrlDialect(text, "a.src").read(data).points
        assert (point.problem or point.frame) == found


def test_a_value_of_an_element_reaches_motions_to_it_by_a_number_that_runs():
    lines = [B1, f"P[1]={POINT}", "LIN P[1]", B2, f"P[1]={POINT}", "LIN P[I]", f"P[I]={POINT}"]
    text = "\n".join(["DEF A()", "DECL POS P[2]", *lines, B1, "LIN P[2]", "END", ""])
    points = dialect_of(".src").read(text).points
    assert [point.problem or point.frame for point in points] == [
        "BASE_DATA[1]", "BASE_DATA[2]", DIFFERENT,
    ]  # fmt: skip


@pytest.mark.parametrize("place", [POINT, "P[1]", "P[I+1], P[I+2]"])
def test_a_frame_that_places_are_given_in_is_no_place(place):
    """Corrected as if the tool went to it, the work object's origin would move."""
    lines = f"LIN WOBJ:{place}\nLIN FIX[1] : {place}\nCIRC VIA, FIX[I+1]:{place}\nLIN SEAM\n"
    frames = "".join(f"DECL FRAME {name}={POINT}\n" for name in ("WOBJ", "SEAM", "VIA"))
    data = f"{frames}DECL FRAME FIX[2]\nFIX[1]={POINT}\nFIX[2]={POINT}\n"
    points = KrlDialect(f"DEF A()\n{lines}END\n", "a.src").read(data).points
    assert [point.name for point in points] == ["SEAM", "VIA"]


def test_what_an_inline_form_sets_for_its_motion():
    """KSS 8: of a circle's auxiliary point, which has no FDAT of its own."""
    sets = "$TOOL = STOOL2(FP3), $BASE = SBASE(FP3.BASE_NO), $IPO_MODE = SIPO_MODE(FP3.IPO_FRAME)"
    program = f"DEF WELD()\nSCIRC XVIA, XP3 WITH $VEL = SVEL_CP(2.0, , L), {sets}\nEND\n"
    points = KrlDialect(program, "weld.src").read(DATA).points
    assert frames_of(points)["XVIA"] == ("TOOL_DATA[7]", "BASE_DATA[8]")
    stands = DATA.replace(
        "TOOL_NO 7,BASE_NO 8,IPO_FRAME #BASE", "TOOL_NO 7,BASE_NO 8,IPO_FRAME #TCP"
    )
    points = KrlDialect(program, "weld.src").read(stands).points
    assert [point.name for point in points if "stands" in point.problem] == ["XVIA", "XP3"]


def test_frames_of_all_programs_are_those_of_the_robots_own_data_list():
    """As FHOME of $config.dat; what the module itself has of that name goes before it."""
    config = "DEFDAT  $CONFIG\nDECL FDAT FHOME={TOOL_NO 3,BASE_NO 4,IPO_FRAME #BASE}\n"
    config += "DECL FDAT FP3={TOOL_NO 9,BASE_NO 9,IPO_FRAME #TCP}\nENDDAT\n"
    text = f"DEF A()\nFDAT_ACT=FHOME\nLIN {POINT}\nFDAT_ACT=FP3\nLIN {POINT}\nEND\n"
    points = KrlDialect(DATA, "a.dat", config).read(text).points
    assert [(point.tool, point.frame, point.problem) for point in points] == [
        ("TOOL_DATA[3]", "BASE_DATA[4]", ""), ("TOOL_DATA[7]", "BASE_DATA[8]", ""),
    ]  # fmt: skip


def test_a_point_by_joints_needs_no_frames():
    """The flange stands right, whichever tool is in force."""
    axes = "{A1 0,A2 -90,A3 90,A4 0,A5 30,A6 0}"
    text = f"$IPO_MODE=#TCP\nPTP {axes}\n$IPO_MODE=#BASE\nPTP H\nH={axes}\n"
    points = dialect_of(".src").read(text).points
    assert [(point.joints, point.problem) for point in points] == [(True, "")] * 2
