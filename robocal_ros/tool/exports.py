"""A tool frame in the words of a robot's controller.

Conventions, each from the flange to the tool: KUKA A, B, C about z, the new y, the new x; FANUC
W, P, R about the fixed x, y, z (the same angles in the other order), and so is URDF's rpy; ABB a
unit quaternion, real part first; Universal Robots a rotation vector.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.frames import fixed, urdf_joint, urdf_origin

Array = NDArray[np.float64]
Format = Literal["urdf", "kuka", "abb", "fanuc", "ur"]

ABB_UNKNOWN = "1,[0,0,1]"  # ABB takes no load without mass or with its centre in the flange
ABB_REMARK = "! mass and centre of gravity are placeholders: enter this tool's, in kg and mm\n"


@dataclass(frozen=True)
class Load:
    """What ABB's tooldata holds beside the frame.

    Attributes
    ----------
    mass_kg : of the tool, above 0.
    centre : (x, y, z) of gravity in the flange frame, m.
    """

    mass_kg: float
    centre: tuple[float, float, float]


def exported(T_flange_tool: Array, format: Format, load: Load | None = None) -> str:
    """Text for a controller, with 1e-4 mm and 1e-5 deg; ``load`` is for ABB."""
    if format == "abb":
        return _abb(T_flange_tool, load)
    return _FORMATS[format](T_flange_tool)


def _place_mm(T: Array) -> list[str]:
    return fixed(T[:3, 3] * 1e3, 4)


def _rpy_deg(T: Array) -> list[str]:
    return fixed(np.degrees(frames.rpy(T[:3, :3])), 5)


def _urdf(T: Array) -> str:
    return urdf_joint("tool0", "tcp", *urdf_origin(T))


def _kuka(T: Array) -> str:
    x, y, z = _place_mm(T)
    c, b, a = _rpy_deg(T)
    return f"$TOOL={{X {x},Y {y},Z {z},A {a},B {b},C {c}}}"


def _fanuc(T: Array) -> str:
    x, y, z = _place_mm(T)
    w, p, r = _rpy_deg(T)
    return f"X {x}  Y {y}  Z {z}\nW {w}  P {p}  R {r}"


def _ur(T: Array) -> str:
    pose = fixed(T[:3, 3], 7) + fixed(frames.log_rotation(T[:3, :3]), 8)
    return f"set_tcp(p[{','.join(pose)}])"


def _abb(T: Array, load: Load | None) -> str:
    x, y, z, w = fixed(frames.quat_xyzw(T), 9)
    place, turn = ",".join(_place_mm(T)), ",".join((w, x, y, z))
    weight, remark = ABB_UNKNOWN, ABB_REMARK
    if load is not None:
        centre = ",".join(fixed(np.array(load.centre) * 1e3, 3))
        weight, remark = f"{load.mass_kg:.3f},[{centre}]", ""
    frame = f"[[{place}],[{turn}]]"
    return f"{remark}PERS tooldata tcp:=[TRUE,{frame},[{weight},[1,0,0,0],0,0,0]];"


_FORMATS: Mapping[str, Callable[[Array], str]] = {
    "urdf": _urdf,
    "kuka": _kuka,
    "fanuc": _fanuc,
    "ur": _ur,
}
