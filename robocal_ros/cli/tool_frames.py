"""Options that give a tool's frame: a document of a measured tool, or numbers."""

import argparse
from pathlib import Path
from typing import TYPE_CHECKING

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.files import quoted

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def three_numbers(value: str) -> tuple[float, ...]:
    """Type of three finite numbers such as ``1,-2.5,3``.

    Raises
    ------
    argparse.ArgumentTypeError
        For anything else.
    """
    try:
        numbers = tuple(float(cell) for cell in value.split(","))
    except ValueError:
        numbers = ()
    if len(numbers) != 3 or not all(abs(number) <= 1e6 for number in numbers):
        raise argparse.ArgumentTypeError(f"{quoted(value)} is not three numbers such as 1,-2.5,3")
    return numbers


def add_frame_options(parser: "argparse._ActionsContainer", tip: str, turn: str) -> None:
    """Offer ``--tool``, and in numbers its ``tip`` and its ``turn``: the names of both options."""
    parser.add_argument(
        "--tool", type=Path, metavar="FILE", help="JSON of a tool, as robocal tool prints it"
    )
    parser.add_argument(
        tip,
        dest="xyz_mm",
        type=three_numbers,
        metavar="X,Y,Z",
        help="or the tip in the flange frame",
    )
    parser.add_argument(
        turn,
        dest="rpy_deg",
        type=three_numbers,
        metavar="R,P,Y",
        help="turns about the flange's x, y, z in this order, where the tool brings none",
    )


def given_frame(args: argparse.Namespace) -> "NDArray[np.float64] | None":
    """T_flange_tool (4, 4) of the options of `add_frame_options`; None without any.

    Raises
    ------
    InputError
        When both are given, or a turn alone; further what `read_tool` raises.
    """
    import numpy as np

    from robocal_ros.ground import frames
    from robocal_ros.tool.files import read_tool

    R = None if args.rpy_deg is None else frames.rotation_from_rpy(np.radians(args.rpy_deg))
    if args.tool is not None and args.xyz_mm is not None:
        raise InputError("the tool is given twice: as a file, and in numbers; keep one")
    if args.tool is not None:
        return read_tool(args.tool, R)
    if args.xyz_mm is not None:
        return frames.transform(np.eye(3) if R is None else R, 1e-3 * np.array(args.xyz_mm))
    if R is not None:
        raise InputError("roll, pitch and yaw alone are no tool: give its tip too")
    return None
