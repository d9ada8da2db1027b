# SPDX-License-Identifier: Apache-2.0
"""How makers write a pose in numbers: order, units, what their angles turn about, and back.

Each from the frame that is referred to, with its source in docs/programs.md: KUKA A, B, C about z,
the new y, the new x; FANUC W, P, R about the fixed x, y, z, the same angles in the other order; ABB
a unit quaternion, real part first; Universal Robots metres and a rotation vector; Kawasaki O, A, T
about z, the new y, the new z.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, fixed

Maker = Literal["abb", "fanuc", "kawasaki", "kuka", "ur"]
COUNT: dict[Maker, int] = {"kuka": 6, "abb": 7, "fanuc": 6, "ur": 6, "kawasaki": 6}
MM, DEGREE = 1e-3, np.pi / 180.0
QUATERNION_TOLERANCE = 1e-3


def pose_of(maker: Maker, numbers: Sequence[float]) -> Array:
    """Transform (4, 4), m, of a pose as this maker writes it, mm and deg (UR: m and rad).

    Raises `InputError` for another count of numbers, and for a quaternion that is none.
    """
    if len(numbers) != COUNT[maker]:
        raise InputError(f"{len(numbers)} numbers, a pose of {maker} has {COUNT[maker]}")
    place, turn = np.array(numbers[:3]), np.array(numbers[3:])
    if maker == "ur":
        return frames.transform(frames.exp_rotation(turn), place)
    if maker == "abb":
        length = float(np.linalg.norm(turn))
        if abs(length - 1.0) > QUATERNION_TOLERANCE:
            raise InputError(f"the quaternion has length {length:.6g}, not 1")
        return frames.transform_from_quat(place * MM, turn[[1, 2, 3, 0]])
    first, second, third = turn * DEGREE
    if maker == "kawasaki":
        R = np.linalg.multi_dot([_about_z(first), _about_y(second), _about_z(third)])
        return frames.transform(R, place * MM)
    rpy = (first, second, third) if maker == "fanuc" else (third, second, first)
    return frames.transform(frames.rotation_from_rpy(rpy), place * MM)


def numbers_of(maker: Maker, T: Array, near: Sequence[float] | None = None) -> list[float]:
    """The numbers of a pose (4, 4) as this maker writes it: the inverse of `pose_of`.

    ``near``: numbers of a pose nearby; of those that mean the same rotation the nearest are taken.
    """
    place = T[:3, 3] if maker == "ur" else T[:3, 3] / MM
    choices = _turns(maker, T[:3, :3])
    turn = choices[0]
    if near is not None:
        before = np.array(near[3:])
        if maker in ("kuka", "fanuc", "kawasaki"):
            choices = [one + 360.0 * np.round((before - one) / 360.0) for one in choices]
        turn = min(choices, key=lambda one: float(np.sum((one - before) ** 2)))
    return [*place.tolist(), *(turn + 0.0).tolist()]


def _turns(maker: Maker, R: Array) -> list[Array]:
    """Numbers of the maker's that mean this rotation (3, 3); the usual ones first."""
    if maker == "ur":
        vector = frames.log_rotation(R)
        angle = float(np.linalg.norm(vector))
        return [vector] if angle < 1e-9 else [vector, vector * (1.0 - 2.0 * np.pi / angle)]
    if maker == "abb":
        quat = frames.quat_xyzw(frames.transform(R, np.zeros(3)))[[3, 0, 1, 2]]
        return [quat, -quat]
    if maker == "kawasaki":
        level = float(np.hypot(R[0, 2], R[1, 2]))
        a = np.arctan2(level, R[2, 2])
        if level < frames.GIMBAL_LOCK:  # O and T turn about one axis
            return [np.array([np.arctan2(-R[0, 1], R[1, 1]), a, 0.0]) / DEGREE]
        o, t = np.arctan2(R[1, 2], R[0, 2]), np.arctan2(R[2, 1], -R[2, 0])
        return [np.array(one) / DEGREE for one in ((o, a, t), (o + np.pi, -a, t + np.pi))]
    roll, pitch, yaw = frames.rpy(R)
    both = (roll, pitch, yaw), (roll + np.pi, np.pi - pitch, yaw + np.pi)
    order = slice(None) if maker == "fanuc" else slice(None, None, -1)
    return [np.array(one[order]) / DEGREE for one in both]


# ---- frames as text for a controller, with 1e-4 mm and 1e-5 deg ---------------------------------


ABB_UNKNOWN = "1,[0,0,1]"  # ABB takes no load without mass or with its centre in the flange
ABB_REMARK = "! mass and centre of gravity are placeholders: enter this tool's, in kg and mm\n"
ABB_STILL = "[[0,0,0],[1,0,0,0]]"


@dataclass(frozen=True)
class Load:
    """What ABB's tooldata holds beside the frame.

    ``mass_kg``: of the tool, above 0.
    ``centre`` (x, y, z): of gravity in the flange frame, m.
    """

    mass_kg: float
    centre: tuple[float, float, float]


def tool_text(maker: Maker, T_flange_tool: Array, name: str = "", load: Load | None = None) -> str:
    """A tool (4, 4) for a controller; ``name`` as it has it, ``load`` for ABB."""
    if maker == "kuka":
        return f"{name or '$TOOL'}={_frame_text(maker, T_flange_tool)}"
    frame = _frame_text(maker, T_flange_tool)
    if maker == "ur":
        return f"set_tcp({frame})" + (f"  # {name}" if name else "")
    if maker == "kawasaki":
        return f"TOOL {frame}{_remark(name)}"
    if maker == "fanuc":
        return f"{name}:\n{frame}" if name else frame
    weight, remark = ABB_UNKNOWN, ABB_REMARK
    if load is not None:
        centre = ",".join(fixed(np.array(load.centre) * 1e3, 3))
        weight, remark = f"{load.mass_kg:.3f},[{centre}]", ""
    return f"{remark}PERS tooldata {name or 'tcp'}:=[TRUE,{frame},[{weight},[1,0,0,0],0,0,0]];"


def base_text(maker: Maker, T_base_frame: Array, name: str = "") -> str:
    """A base, work object, user frame or feature (4, 4) for a controller; ``name`` as it has it."""
    frame = _frame_text(maker, T_base_frame)
    if maker == "kuka":
        return f"{name or '$BASE'}={frame}"
    if maker == "abb":
        return f'PERS wobjdata {name or "wobj"}:=[FALSE,TRUE,"",{frame},{ABB_STILL}];'
    if maker == "ur":
        name = name or "base"
        return f"# no base can be set: go to pose_trans({name}, p) in place of p\n{name}={frame}"
    if maker == "kawasaki":
        return f"BASE {frame}{_remark(name)}"
    return f"{name}:\n{frame}" if name else frame


def _remark(name: str) -> str:
    return f" ; {name}" if name else ""


def _frame_text(maker: Maker, T: Array) -> str:
    numbers = np.array(numbers_of(maker, T))
    digits = {"ur": (7, 8), "abb": (4, 9)}.get(maker, (4, 5))
    place, turn = fixed(numbers[:3], digits[0]), fixed(numbers[3:], digits[1])
    cells = [*place, *turn]
    if maker == "kuka":
        named = ",".join(f"{axis} {cell}" for axis, cell in zip("XYZABC", cells, strict=True))
        return f"{{{named}}}"
    if maker == "abb":
        return f"[[{','.join(place)}],[{','.join(turn)}]]"
    if maker == "fanuc":
        x, y, z, w, p, r = cells
        return f"X {x}  Y {y}  Z {z}\nW {w}  P {p}  R {r}"
    row = ",".join(cells)
    return f"p[{row}]" if maker == "ur" else f"TRANS({row})"


def _about_z(angle: float) -> Array:
    return frames.exp_rotation([0.0, 0.0, angle])


def _about_y(angle: float) -> Array:
    return frames.exp_rotation([0.0, angle, 0.0])
