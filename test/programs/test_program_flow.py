# SPDX-License-Identifier: Apache-2.0
"""Which tool and base a program has in force at its points."""

import pytest

from robocal_ros.programs.correcting import dialect_of

POINT = "{X 1,Y 2,Z 3,A 0,B 0,C 0}"
B1, B2, LIN = "$BASE=BASE_DATA[1]", "$BASE=BASE_DATA[2]", f"LIN {POINT}"
FDAT = "FDAT_ACT={TOOL_NO 1,BASE_NO 2,IPO_FRAME #BASE}"
NOT_KNOWN = "whether the robot carries the part is not known ($IPO_MODE of line {})"
A, B = "set_tcp(p[0,0,.1,0,0,0])", "set_tcp(p[0,0,.2,0,0,0])"
MOVEL = "movel(p[.4,-.3,.2,0,3.1,0])"


def test_what_with_sets_holds_for_its_motion_or_block_alone():
    """As inline forms of KSS 8 write it; SVEL_CP( ) and its like make no point."""
    krl = (
        "$TOOL=TOOL_DATA[1]\n$BASE=BASE_DATA[1]\n"
        "SPTP XHOME WITH $VEL_AXIS[1] = SVEL_JOINT(100.0), $TOOL = STOOL2(F), $BASE = SBASE(F)\n"
        f"SLIN {POINT} WITH $VEL=SVEL_CP(2.0, , L), $BASE=BASE_DATA[2]\nLIN {POINT}\n"
        "SPLINE WITH $TOOL={X 1,Y 0,Z 0,A 0,B 0,C 0}, $BASE=BASE_DATA[3]\n"
        f"SPL {POINT}\nSLIN {POINT} WITH $VEL.CP=1\nENDSPLINE\nLIN {POINT}\n"
    )
    found = dialect_of(".src").read(krl)
    tools = [point.tool for point in found.points]
    block = "$TOOL of line 6"
    assert tools == ["TOOL_DATA[1]", "TOOL_DATA[1]", block, block, "TOOL_DATA[1]"]
    assert found.frames[block][0, 3] == pytest.approx(1e-3)
    bases = [point.frame for point in found.points]
    assert bases == [f"BASE_DATA[{n}]" for n in (2, 1, 3, 3, 1)]
    assert found.computed == ()


def test_frames_that_are_set_by_fdat_act():
    """As off-line programs set them, and inline forms where these are unfolded."""
    krl = (
        "DECL FDAT FP1={TOOL_NO 3,BASE_NO 4,IPO_FRAME #BASE}\nDECL FDAT FP2={TOOL_NO 5,BASE_NO 5,"
        "IPO_FRAME #TCP}\nDECL FDAT FDAT_ACT={TOOL_NO 9,BASE_NO 9,IPO_FRAME #NONE}\n"
        f"LIN {POINT}\nBAS(#TOOL,1)\nBAS(#BASE,1)\n"
        "FDAT_ACT = {TOOL_NO 6,BASE_NO 2,IPO_FRAME #BASE}\nBAS (#FRAMES)\n"
        f"LIN {POINT}\nFDAT_ACT=FP1\nBAS(#PTP_PARAMS,100)\nLIN {POINT}\n"
        f"FDAT_ACT=FP7\nBAS(#FRAMES)\nLIN {POINT}\nFDAT_ACT=FP2\nLIN {POINT}\n"
        f"BAS(#TOOL,1)\nBAS(#BASE,1)\nLIN {POINT}\nFDAT_ACT=FP1\nLIN {POINT}\n"
    )
    points = dialect_of(".src").read(krl).points
    frames = [(point.tool, point.frame) for point in points]
    assert frames[:3] == [
        (None, None), ("TOOL_DATA[6]", "BASE_DATA[2]"), ("TOOL_DATA[3]", "BASE_DATA[4]"),
    ]  # fmt: skip
    assert points[3].problem == NOT_KNOWN.format(13)  # of another file
    assert ["stands" in point.problem for point in points[4:]] == [True, True, False]


@pytest.mark.parametrize(
    ("lines", "problem"),
    [  # of the last line's motion
        (["$IPO_MODE=MODE", LIN], 3),
        (["$IPO_MODE=MODE", "$IPO_MODE=#NONE", LIN], None),
        (["FDAT_ACT=FP9", LIN], 3),
        (["FDAT_ACT=FP9", B1, "BAS(#TOOL,1)", LIN], 3),
        (["FDAT_ACT={TOOL_NO 1,BASE_NO 1,IPO_FRAME MODE}", LIN], 3),
        (["FDAT_ACT={TOOL_NO 1,BASE_NO 1}", LIN], None),
        (["FDAT_ACT.IPO_FRAME=MODE", LIN], 3),
        (["FDAT_ACT.TOOL_NO=N", LIN], None),
        (["FDAT_ACT=FP9", "FDAT_ACT.IPO_FRAME=#BASE", LIN], None),
        ([f"S{LIN} WITH $TOOL=STOOL2(FP9), $IPO_MODE=SIPO_MODE(FP9.IPO_FRAME)"], 3),
        ([f"S{LIN} WITH $IPO_MODE=SIPO_MODE(FP1)"], None),
        ([f"S{LIN} WITH $IPO_MODE=SIPO_MODE(FP9)", LIN], None),
    ],
)
def test_a_tool_that_may_stand_is_told(lines, problem):
    """As by an FDAT of another file; the point of one would be corrected the wrong way round."""
    declared = "DECL FDAT FP1={TOOL_NO 3,BASE_NO 4,IPO_FRAME #BASE}"
    points = dialect_of(".src").read("\n".join(["DEF A()", declared, *lines, "END", ""])).points
    assert points[-1].problem == (NOT_KNOWN.format(problem) if problem else "")


def test_components_of_fdat_act_are_set_one_by_one():
    lines = ["BAS(#BASE,1)", "FDAT_ACT.TOOL_NO=3", LIN, "FDAT_ACT.BASE_NO=N", LIN]
    points = dialect_of(".src").read("\n".join([*lines, ""])).points
    assert [(point.tool, point.frame) for point in points] == [
        ("TOOL_DATA[3]", "BASE_DATA[1]"), ("TOOL_DATA[3]", "$BASE of line 4"),
    ]  # fmt: skip


def test_a_robot_that_carries_the_part_as_its_ipo_mode_says():
    krl = (
        f"DEF A()\n$IPO_MODE=#TCP\n$TOOL=TOOL_DATA[1]\n$BASE=BASE_DATA[1]\nLIN {POINT}\n"
        f"SLIN {POINT} WITH $IPO_MODE=#BASE\n$IPO_MODE=#BASE\nLIN {POINT}\n"
        f"SLIN {POINT} WITH $IPO_MODE=#TCP\nLIN {POINT}\n$IPO_MODE=#TCP\nEND\n"
        f"DEF B()\nLIN {POINT}\nEND\n"
    )
    points = dialect_of(".src").read(krl).points
    stands = ["stands" in point.problem for point in points]
    assert stands == [True, False, False, True, False, False]


def test_a_routine_does_not_have_the_frames_of_the_one_above():
    """It has those of its caller, which the order of the text does not tell."""
    krl = "DEF A()\n$BASE=BASE_DATA[1]\nB()\n$BASE=BASE_DATA[2]\nEND\n"
    krl += f"GLOBAL DEF B()\nLIN {POINT}\nEND\n"
    (point,) = dialect_of(".src").read(krl).points
    assert point.frame is None


def test_a_routine_with_the_usual_begin_carries_no_part():
    krl = (
        "DEF A()\nBAS(#INITMOV,0)\nGRIP()\n$TOOL=TOOL_DATA[1]\n$BASE=BASE_DATA[1]\n"
        f"LIN {POINT}\nTURN()\nLIN {POINT}\nEND\n"
        "DEF GRIP()\nBAS(#INITMOV,0)\n$OUT[1]=TRUE\nEND\n"
        "DEF TURN()\n$IPO_MODE=#TCP\nEND\n"
    )
    points = dialect_of(".src").read(krl).points
    assert [(point.tool, point.frame) for point in points][:1] == [("TOOL_DATA[1]", "BASE_DATA[1]")]
    assert [point.problem for point in points] == [
        "",
        "whether the robot carries the part is not known ($IPO_MODE of line 7 on)",
    ]


@pytest.mark.parametrize(
    ("lines", "bases"),
    [
        (
            ["IF K==1 THEN", B1, LIN, "ELSE", B2, LIN, "ENDIF", LIN],
            ["BASE_DATA[1]", "BASE_DATA[2]", "$BASE of line 7 on"],
        ),
        ([B1, "IF K==1 THEN", B2, "ENDIF", LIN, B1, LIN], ["$BASE of line 4 on", "BASE_DATA[1]"]),
        ([B2, "IF K==1 THEN", B1, "ELSE", B1, "ENDIF", LIN], ["BASE_DATA[1]"]),
        ([B1, "IF K==1 THEN", "$TOOL=TOOL_DATA[1]", "ENDIF", LIN], ["BASE_DATA[1]"]),
        ([B1, "SWITCH K", "CASE 1", B2, "CASE 2", B2, "ENDSWITCH", LIN], ["$BASE of line 7 on"]),
        ([B1, "LOOP", LIN, B2, LIN, "ENDLOOP"], ["$BASE of line 2 on", "BASE_DATA[2]"]),
        (
            [B1, "LOOP", B2, "IF K==1 THEN", "EXIT", "ENDIF", B1, "ENDLOOP", LIN],
            ["$BASE of line 8 on"],
        ),
        (
            [B1, "FOR I=1 TO 2", LIN, "ENDFOR", "WAIT FOR $IN[1]", LIN],
            ["BASE_DATA[1]", "BASE_DATA[1]"],
        ),
        (
            [B1, "IF K==1 THEN", "GOTO OVER", "ENDIF", B2, LIN, "OVER:", LIN, B1, LIN],
            ["BASE_DATA[2]", "$BASE of line 7 on", "BASE_DATA[1]"],
        ),
        ([B1, "again :", LIN, "WAIT SEC 1", B2, "goto AGAIN"], ["$BASE of line 2 on"]),
        ([B1, "AGAIN:", LIN, "GOTO AGAIN"], ["BASE_DATA[1]"]),
        (
            [B1, "IF K==1 THEN", "GOTO _L$1", "ENDIF", FDAT, "_L$1: WAIT SEC 1", LIN],
            ["$BASE of line 6 on"],
        ),
        (["DEF A()", B1, "L1:", LIN, "END", "DEF B()", B2, "GOTO L1", "END"], ["BASE_DATA[1]"]),
        (["DEF A()", B1, "B()", LIN, "END", "DEF B()", B2, "END"], ["$BASE of line 3 on"]),
        (["DEF A()", B2, "B()", LIN, "END", "DEF B()", B2, "END"], ["BASE_DATA[2]"]),
        (["DEF A()", B1, "B ( )", LIN, "END", "DEF B()", LIN, "END"], ["BASE_DATA[1]", None]),
    ],
)
def test_the_base_of_krl_is_that_of_all_ways_to_a_point(lines, bases):
    found = dialect_of(".src").read("\n".join([*lines, ""]))
    assert [point.frame for point in found.points] == bases


@pytest.mark.parametrize(
    ("lines", "tools"),
    [
        (["def P():", A, "def Sub():", B, MOVEL, "end", MOVEL, "end"], ["4", "2"]),
        (["def Sub():", B, "end", A, "Sub()", MOVEL], ["5 on"]),
        (["def Sub():", "Deep()", "end", "def Deep():", B, "end", A, "Sub()", MOVEL], ["8 on"]),
        ([A, "if x>1:", B, MOVEL, "elif x>0:", MOVEL, "end", A, MOVEL], ["3", "1", "8"]),
        ([A, "if x>1:", B, "end", MOVEL], ["4 on"]),
        ([A, "if x>1:", B, "else:", B, "end", MOVEL], ["3"]),
        ([A, "while True:", MOVEL, B, MOVEL, "end"], ["2 on", "4"]),
        ([A, "while True:", A, MOVEL, "end", MOVEL], ["3", "3"]),  # the same pose
        ([A, "while True:", B, "if x>1:", "break", "end", A, "end", MOVEL], ["8 on"]),
        ([A, "while x>1:", MOVEL, B, "if x>2:", "continue", "end", A, "end"], ["2 on"]),
        (["def Sub():", MOVEL, "end", A, "Sub()"], ["4"]),  # as its caller
        (["def Sub():", MOVEL, "end", A, "Sub()", B, "Sub()"], ["1 on"]),
    ],
)
def test_the_tool_of_urscript_is_that_of_all_ways_to_a_point(lines, tools):
    found = dialect_of(".script").read("\n".join([*lines, ""]))
    assert [point.tool for point in found.points] == [f"set_tcp of line {n}" for n in tools]
    assert all((f"set_tcp of line {n}" in found.frames) == n.isdigit() for n in tools)


@pytest.mark.parametrize(
    ("lines", "tool"),
    [
        (["IF n==1 THEN", "TOOL a", "ELSE", "TOOL b", "END", "LMOVE p"], "TOOL of line 6 on"),
        (["TOOL a", "CALL other", "LMOVE p"], "TOOL of line 3 on"),
        (["TOOL a", "CALL plain", "LMOVE p"], "TOOL of line 2"),
        (["TOOL a", "IF SIG(1) GOTO 10", "LMOVE p"], "TOOL of line 2"),
        (["TOOL a", "GOTO 10 IF SIG(1)", "TOOL b", "10 LMOVE p"], "TOOL of line 5 on"),
        (["TOOL a", "IF SIG(1) GOTO on", "TOOL b", "on: LMOVE p"], "TOOL of line 5 on"),
        (["TOOL a", "10 LMOVE p", "20 TOOL b", "GOTO 10"], "TOOL of line 3 on"),
        (["TOOL a", "GOTO 10 IF SIG(1)", "TOOL b", "10 ;on", "LMOVE p"], "TOOL of line 5 on"),
        (["TOOL a", "SCASE $s OF", 'SVALUE "x":', "TOOL b", "END", "LMOVE p"], "TOOL of line 6 on"),
        (["TOOL a", "CASE n OF", "VALUE 1:", "TOOL b", "END", "LMOVE p"], "TOOL of line 6 on"),
        (["TOOL a", "DO", "LMOVE p", "TOOL b", "UNTIL SIG(1)"], "TOOL of line 3 on"),
    ],
)
def test_the_tool_of_kawasaki_is_that_of_all_ways_to_a_point(lines, tool):
    programs = {"m": lines, "other": ["TOOL b"], "plain": ["BASE NULL"]}
    text = "".join(
        "\n ".join([f".PROGRAM {name}()", *body]) + "\n.END\n" for name, body in programs.items()
    )
    rows = "".join(f"{name} 1 2 {z} 0 0 0\n" for z, name in enumerate("abp"))
    (point,) = dialect_of(".as").read(f"{text}.TRANS\n{rows}.END\n").points
    assert (point.name, point.tool, point.problem) == ("p", tool, "")
