# SPDX-License-Identifier: Apache-2.0
"""Programs of five makers for one robot, written by code of its own, and the robot that runs them.

What a maker writes of joints and frames is stated here once more, along scipy's conventions, so
that a reader that has it wrong does not agree with itself.
"""

import re
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

NOMINAL = load_robot("kr150_r3100")
TOOL_MM = np.array([120.5, -14.25, 262.0])
TOOL_TURN = Rotation.from_euler("ZYX", [30.0, 40.0, -15.0], degrees=True)
FRAME_MM = np.array([900.0, -250.5, 410.75])
FRAME_TURN = Rotation.from_euler("ZYX", [12.0, -3.0, 5.0], degrees=True)
KUKA_FRAMES = (
    "TOOL_DATA[3]={X 120.5,Y -14.25,Z 262.0,A 30.0,B 40.0,C -15.0}\n"
    "BASE_DATA[5]={X 900.0,Y -250.5,Z 410.75,A 12.0,B -3.0,C 5.0}\n"
)
NUMBER = re.compile(r"-?\d*\.?\d+(?:E[-+]?\d+)?")
NONE = "9E9,9E9,9E9,9E9,9E9,9E9"


def pose(turn: Rotation, place_mm: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = turn.as_matrix(), place_mm * 1e-3
    return T


T_FLANGE_TOOL, T_BASE_FRAME = pose(TOOL_TURN, TOOL_MM), pose(FRAME_TURN, FRAME_MM)


def drifted(arm: SerialArm, seed: int, size_m: float = 3e-4, size_rad: float = 1.5e-4) -> SerialArm:
    """The robot as identified: off its nominal model as robots are."""
    rng = np.random.default_rng(seed)
    chosen = arm.parameters
    size = np.where(chosen.is_length, size_m, size_rad)
    return arm.with_mdh(chosen.add(arm.mdh, size * rng.standard_normal(len(size))))


def postures(count: int, seed: int, arm: SerialArm = NOMINAL) -> np.ndarray:
    """Joints (count, n), wrist and arm away from what is singular."""
    rng = np.random.default_rng(seed)
    lower, upper = np.maximum(arm.lower, -np.pi), np.minimum(arm.upper, np.pi)
    found = []
    while len(found) < count:
        q = rng.uniform(lower + 0.05, upper - 0.05)
        if np.linalg.svd(arm.jacobian(q), compute_uv=False)[-1] > 0.12:
            found.append(q)
    return np.array(found)


def relative(q: np.ndarray, arm: SerialArm = NOMINAL) -> np.ndarray:
    """The tool in the fixture's frame (4, 4) where the controller takes joints q (n,) to be."""
    return np.linalg.inv(T_BASE_FRAME) @ arm.fk(q) @ T_FLANGE_TOOL


def numbers(text: list[float], digits: int) -> list[str]:
    return [f"{value:.{digits}f}" for value in text]


# ---- the geometry that status, configuration and cfx speak of, for a KR 150: by its lengths ------


def side_view(q: np.ndarray) -> tuple[bool, bool]:
    """Whether the wrist's centre lies behind axis 1, and before the upper arm (elbow up)."""
    a2, a3 = q[1], q[1] + q[2]
    elbow = np.array([350.0 + 1350.0 * np.cos(a2), 675.0 - 1350.0 * np.sin(a2)])
    along = np.array([np.cos(a3), -np.sin(a3)])
    across = np.array([np.sin(a3), np.cos(a3)])
    wrist = elbow + 1400.0 * along - 41.0 * across
    upper, lower = elbow - [350.0, 675.0], wrist - elbow
    return bool(wrist[0] < 0.0), bool(upper[1] * lower[0] - upper[0] * lower[1] > 0.0)


def krl(points: np.ndarray, joints: np.ndarray) -> str:
    """A data list as KUKA's controller keeps it, with joints of a home position."""
    lines = [
        "&ACCESS RVP", "&REL 7", "DEFDAT  WELD PUBLIC", ";FOLD DECLARATIONS;%{PE}%MKUKATPBASIS",
        ";ENDFOLD ; N\xe4he {X 1,Y 2} = kein Punkt",
    ]  # fmt: skip
    for i, q in enumerate(points, start=1):
        T = relative(q)
        xyz, abc = T[:3, 3] * 1e3, Rotation.from_matrix(T[:3, :3]).as_euler("ZYX", degrees=True)
        cells = [f"{n} {v:.9g}" for n, v in zip("XYZABC", [*xyz, *abc], strict=True)]
        turn = sum(1 << axis for axis in range(6) if q[axis] < 0.0)
        behind, above = side_view(q)
        status = int(behind) + 2 * above + 4 * (q[4] < 0.0)
        tail = f"S {status},T {turn},E1 0.0,E2 0.0,E3 0.0,E4 0.0,E5 0.0,E6 0.0"
        lines.append(f"DECL E6POS XP{i}={{{','.join(cells)},{tail}}}")
        frames = 'TOOL_NO 3,BASE_NO 5,IPO_FRAME #BASE,POINT2[] " ",TQ_STATE FALSE'
        lines += [f"DECL FDAT FP{i}={{{frames}}}", f"DECL PDAT PPDAT{i}={{VEL 100.000,ACC 50.0}}"]
    for i, q in enumerate(joints, start=1):
        cells = [f"A{n} {v:.9g}" for n, v in enumerate(np.degrees(q), start=1)]
        lines.append(f"DECL E6AXIS XHOME{i}={{{','.join(cells)},E1 0.0}}")
    return "\r\n".join([*lines, "ENDDAT", ""])


def rapid(points: np.ndarray, joints: np.ndarray) -> str:
    tool, fixture = ABB_TOOL, ABB_FRAME
    lines = [
        "MODULE Weld", "  ! p99:=[[1,2,3],[1,0,0,0],[0,0,0,0],[9E9]]; is no point",
        f"  PERS tooldata tGun:=[TRUE,{tool},[3.2,[10,0,80],[1,0,0,0],0,0,0]];",
        f'  PERS wobjdata wFix:=[FALSE,TRUE,"",{fixture},[[0,0,0],[1,0,0,0]]];',
    ]  # fmt: skip
    for i, q in enumerate(points, start=1):
        T = relative(q)
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat()
        cells = ",".join(numbers((T[:3, 3] * 1e3).tolist(), 3)), ",".join(numbers([w, x, y, z], 7))
        behind, above = side_view(q)
        cf = [int(np.floor(np.degrees(q[j]) / 90.0)) for j in (0, 3, 5)]
        cfx = 4 * behind + 2 * (not above) + int(q[4] < 0.0)
        lines.append(
            f"  CONST robtarget p{i}0:=[[{cells[0]}],[{cells[1]}],"
            f"[{cf[0]},{cf[1]},{cf[2]},{cfx}],[{NONE}]];"
        )
    for i, q in enumerate(joints, start=1):
        cells = ",".join(numbers(np.degrees(q).tolist(), 2))
        lines.append(f"  CONST jointtarget home{i}:=[[{cells}],[{NONE}]];")
    lines += [
        "",
        "  PROC main()",
        *(f"    MoveAbsJ home{i + 1},v500,fine,tGun;" for i in range(len(joints))),
    ]
    lines += [f"    MoveL p{i + 1}0, v200, z10, tGun \\WObj:=wFix;" for i in range(len(points))]
    return "\n".join(
        [
            *lines,
            "    MoveL Offs(p10,0,0,50),v200,z10,tGun\\WObj:=wFix;",
            "  ENDPROC",
            "ENDMODULE",
            "",
        ]
    )


def _abb(turn: Rotation, place_mm: np.ndarray) -> str:
    x, y, z, w = turn.as_quat()
    place, quat = numbers(place_mm.tolist(), 4), numbers([w, x, y, z], 9)
    return f"[[{','.join(place)}],[{','.join(quat)}]]"


ABB_TOOL, ABB_FRAME = _abb(TOOL_TURN, TOOL_MM), _abb(FRAME_TURN, FRAME_MM)


def fanuc(points: np.ndarray, joints: np.ndarray) -> str:
    """As a robot with FANUC's joints would keep it: J3 counts from the horizontal."""
    lines = ["/PROG  WELD", "/ATTR", 'COMMENT\t\t= "Naht";', "/MN", "   1:  UFRAME_NUM=2 ;"]
    lines += [f"{i + 2:4d}:L P[{i + 1}] 200mm/sec FINE    ;" for i in range(len(points))]
    lines.append("/POS")

    def cell(name: str, value: float, unit: str) -> str:
        text = f"{value:.3f}".replace("-0.", "-.") if abs(value) < 1.0 and value else f"{value:.3f}"
        return f"{name} = {text:>9} {unit}"

    for i, q in enumerate(points, start=1):
        T = relative(q)
        w, p, r = Rotation.from_matrix(T[:3, :3]).as_euler("xyz", degrees=True)
        behind, above = side_view(q)
        turns = [int(np.floor((np.degrees(q[j]) + 180.0) / 360.0)) for j in (0, 3, 5)]
        letters = f"{'N' if q[4] < 0 else 'F'} {'U' if above else 'D'} {'B' if behind else 'T'}"
        config = ", ".join([letters, *map(str, turns)])
        lines += [f'P[{i}:"n{i}"]{{', "   GP1:", f"\tUF : 2, UT : 4,\t\tCONFIG : '{config}',"]
        xyz = [cell(n, v, " mm") for n, v in zip("XYZ", T[:3, 3] * 1e3, strict=True)]
        wpr = [cell(n, v, "deg") for n, v in zip("WPR", (w, p, r), strict=True)]
        lines += ["\t" + ",\t".join(xyz) + ",", "\t" + ",\t".join(wpr), "};"]
    for i, q in enumerate(joints, start=len(points) + 1):
        shown = np.degrees(q - [0.0, 0.0, q[1], 0.0, 0.0, 0.0])
        cells = [f"J{n}= {v:9.3f} deg" for n, v in enumerate(shown, start=1)]
        lines += [f"P[{i}]{{", "   GP1:", "\tUF : 2, UT : 4,\t", "\t" + ",\t".join(cells[:3]) + ","]
        lines += [
            "\t" + ",\t".join(cells[3:]),
            "   GP2:",
            "\tUF : 2, UT : 4,",
            "\tJ1=   300.000  mm",
            "};",
        ]
    return "\r\n".join([*lines, "/END", ""])


def urscript(points: np.ndarray, joints: np.ndarray) -> str:
    """As PolyScope writes it: poses in the base, the posture of each beside it."""
    tcp = ", ".join(f"{v:.9f}" for v in (*TOOL_MM * 1e-3, *TOOL_TURN.as_rotvec()))
    lines = ["def Weld():", f"  set_tcp(p[{tcp}])", "  set_payload(3.2, [0.01, 0, 0.08])"]
    for i, q in enumerate(points, start=1):
        T = NOMINAL.fk(q) @ T_FLANGE_TOOL
        values = [*T[:3, 3], *Rotation.from_matrix(T[:3, :3]).as_rotvec()]
        cells = [f"{v:.12f}".replace("0.", ".", 1) if 0 < v < 1 else f"{v:.12f}" for v in values]
        lines.append(f"  global W_{i}_p=p[{', '.join(cells)}]")
        lines.append(f"  global W_{i}_q=[{', '.join(repr(float(v)) for v in q + 0.01)}]")
    for i in range(1, len(points) + 1):
        lines += [
            f'  $ {i} "W_{i}"',
            f"  movej(get_inverse_kin(W_{i}_p, qnear=W_{i}_q), a=1.4, v=1.05)",
        ]
    lines += [
        f"  movej([{', '.join(f'{v:.6f}' for v in q)}], a=1.4, v=1.05) # back" for q in joints
    ]
    return "\n".join([*lines, "end", ""])


def kawasaki(points: np.ndarray, joints: np.ndarray) -> str:
    """As SAVE writes it: a step of the pendant, motions by name, then where the names are.

    A pose says no posture: each is reached from joints beside it.
    """
    shown = ",".join(f"{v:.5g}" for v in np.degrees(joints[0]))
    lines = [
        '.PROGRAM weld()@26/11/26 18:00 #7; Naht "s1"',
        f"  TOOL {_oat(TOOL_TURN, TOOL_MM)}",
        "  BASE fix ; LMOVE s2 is none",
        '  PRINT "LMOVE s3"',
        f"  JOINT SPEED9 ACCU1 TIMER0 TOOL1 WORK0 CLAMP1 (OFF,0,0,O) OX= WX= #[{shown}] ;",
        "  SPEED 200 MM/S ALWAYS",
    ]
    for i in range(1, len(points) + 1):
        lines += [f"  JMOVE #v[{i}]", f"  {'LAPPRO' if i == 1 else 'LMOVE'} s{i}{',50' * (i == 1)}"]
    lines += [f"  JMOVE #home{i}" for i in range(2, len(joints) + 1)]
    lines += ["  POINT up = SHIFT(fix BY 0,0,50)", "  LMOVE up", ".END", ".TRANS"]
    six = lambda values: " ".join(f"{v:.6f}" for v in values)  # noqa: E731
    for i, q in enumerate(points, start=1):
        T = relative(q)
        oat = Rotation.from_matrix(T[:3, :3]).as_euler("ZYZ", degrees=True)
        lines.append(f"s{i} {six([*T[:3, 3] * 1e3, *oat])}")
    lines.append(f"fix {six([*FRAME_MM, *FRAME_TURN.as_euler('ZYZ', degrees=True)])}")
    lines += [".END", ".JOINTS"]
    lines += [f"#v[{i}] {six(np.degrees(q + 0.01))}" for i, q in enumerate(points, start=1)]
    lines += [f"#home{i} {six(np.degrees(q))}" for i, q in enumerate(joints, start=1) if i > 1]
    return "\r\n".join([*lines, ".END", ".REALS", "s1 = 5", ".END", ""])


def _oat(turn: Rotation, place_mm: np.ndarray) -> str:
    cells = [*place_mm, *turn.as_euler("ZYZ", degrees=True)]
    return f"TRANS({','.join(f'{v:.9f}' for v in cells)})"


# ---- a controller of our own: reads the texts along another way ---------------------------------


def poses_in(maker: str, text: str) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Commanded flange poses, and joints, of a program of `robot_programs`."""
    found, joints = [], []
    for line in text.splitlines():
        if maker == "kuka" and line.startswith("DECL E6POS"):
            v = [float(x) for x in re.findall(r"[XYZABC] (-?[\d.]+)", line.partition("{")[2])]
            found.append(pose(Rotation.from_euler("ZYX", v[3:], degrees=True), np.array(v[:3])))
        elif maker == "kuka" and line.startswith("DECL E6AXIS"):
            joints.append(np.radians([float(x) for x in re.findall(r"A\d (-?[\d.]+)", line)]))
        elif maker == "abb" and " robtarget " in line:
            v = [float(x) for x in NUMBER.findall(line.partition(":=")[2])]
            quat = np.array(v[3:7])
            assert abs(np.linalg.norm(quat) - 1.0) < 1e-7  # what ABB asks for
            found.append(pose(Rotation.from_quat(quat[[1, 2, 3, 0]]), np.array(v[:3])))
        elif maker == "abb" and " jointtarget " in line:
            joints.append(
                np.radians([float(x) for x in NUMBER.findall(line.partition(":=")[2])][:6])
            )
        elif maker == "ur" and "_p=p[" in line:
            v = [float(x) for x in line.partition("p[")[2].rstrip("]").split(",")]
            found.append(pose(Rotation.from_rotvec(v[3:]), 1e3 * np.array(v[:3])))
        elif maker == "ur" and "movej([" in line:
            joints.append(
                np.array([float(x) for x in re.search(r"\(\[(.*)\]", line)[1].split(",")])
            )
    if maker == "fanuc":
        for block in re.findall(r"GP1:(.*?)(?:GP2|\};)", text, re.DOTALL):
            v = [float(x) for x in re.findall(r"[XYZWPR] =\s*(-?[\d.]+) ", block)]
            if v:
                found.append(pose(Rotation.from_euler("xyz", v[3:], degrees=True), np.array(v[:3])))
            else:
                j = np.radians([float(x) for x in re.findall(r"J\d=\s*(-?[\d.]+)", block)])
                joints.append(j + np.array([0.0, 0.0, j[1], 0.0, 0.0, 0.0]))
    if maker == "kawasaki":
        rows = re.findall(r"^(#?[sv]\[?\d+\]?|#home\d+) (-?\d+\.[^\r\n]*)", text, re.MULTILINE)
        for name, cells in [
            ("#", c.replace(",", " ")) for c in re.findall(r"#\[(.*)\]", text)
        ] + rows:
            v = [float(x) for x in cells.split()]
            if name.startswith("#"):
                joints.append(np.radians(v))
            else:
                turn = Rotation.from_euler("ZYZ", v[3:], degrees=True)
                found.append(pose(turn, np.array(v[:3])))
    base = np.eye(4) if maker == "ur" else T_BASE_FRAME
    return [base @ T @ np.linalg.inv(T_FLANGE_TOOL) for T in found], joints


@dataclass(frozen=True)
class WrittenProgram:
    """A program with what its frames are called, and the file's ending."""

    text: str
    suffix: str
    frames: dict[str, np.ndarray]
    decimals: tuple[int, int, int]  # of a length (mm; UR m), of the orientation, of a joint
    joints: np.ndarray  # (k, n) of the points that are given by joints, in the order of the text


def programs(points: np.ndarray, joints: np.ndarray) -> dict[str, WrittenProgram]:
    """By maker. What the makers' files do not hold themselves is in ``frames``."""
    kuka = {"TOOL_DATA[3]": T_FLANGE_TOOL, "BASE_DATA[5]": T_BASE_FRAME}
    tp = {"UT4": T_FLANGE_TOOL, "UF2": T_BASE_FRAME}
    beside = np.vstack([joints[:1], points + 0.01, joints[1:]])
    return {
        "kuka": WrittenProgram(krl(points, joints), ".dat", kuka, (4, 6, 6), joints),
        "abb": WrittenProgram(rapid(points, joints), ".mod", {}, (4, 8, 6), joints),
        "fanuc": WrittenProgram(fanuc(points, joints), ".ls", tp, (3, 3, 3), joints),
        "ur": WrittenProgram(urscript(points, joints), ".script", {}, (7, 8, 8), joints),
        "kawasaki": WrittenProgram(kawasaki(points, joints), ".as", {}, (6, 6, 5), beside),
    }


def within(arm: SerialArm, limit_rad: float) -> SerialArm:
    """The arm with joints that turn less far."""
    return replace(arm, lower=np.full(arm.n, -limit_rad), upper=np.full(arm.n, limit_rad))
