"""Which measured tools the correction takes over, and when."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.correction.bounds import ROUNDING, CorrectionConfig
from robocal_ros.correction.inputs import OfferedTool
from robocal_ros.correction.refusals import Reason, RefusedError

Array = NDArray[np.float64]


class ToolGate:
    """Judges the measured tools of this robot, and keeps the last good one until it may be used.

    Attributes
    ----------
    in_use : None before the first one.
    waiting : judged, and to be adopted when the robot stands or a trajectory begins.
    refused : older than the one before by revision and stamp; to be looked at again.
    """

    def __init__(self, taught: Array, config: CorrectionConfig) -> None:
        self._taught = taught
        self._config = config
        self.in_use: OfferedTool | None = None
        self.waiting: OfferedTool | None = None
        self.refused: OfferedTool | None = None

    @property
    def T_flange_tool(self) -> Array | None:
        """The tool in use; None: the taught one."""
        return None if self.in_use is None else self.in_use.T_flange_tool

    def take(self, tool: OfferedTool, *, again: bool = False) -> None:
        """Let a tool wait for its adoption; one that is in use already only ends the wait.

        A revision that is not newer than the last one must be newer by its stamp, or be looked
        at (``again``).

        Raises
        ------
        RefusedError
            When it is not accepted, its frames are not the configured ones, it is older than the
            last one, or too far from the taught tool.
        """
        if not tool.accepted:
            raise RefusedError(Reason.NOT_ACCEPTED, f"tool revision {tool.revision}")
        self._require_frames(tool)
        if tool.T_flange_tool is not None:
            self._require_small(tool.T_flange_tool)
        self.refused = None
        last = self.waiting or self.in_use
        known = last is not None and _same(tool, last)
        later = last is None or tool.revision > last.revision or tool.stamp_ns > last.stamp_ns
        if not (known or later or again):
            self.refused = tool
            raise RefusedError(
                Reason.OLD_REVISION,
                f"tool revision {tool.revision} is another tool than the last one and not newer "
                "by its stamp; ~/take_over takes it over",
            )
        if self.in_use is not None and _same(tool, self.in_use):
            self.in_use, self.waiting = tool, None
        else:
            self.waiting = tool

    def look_again(self) -> None:
        """Take the tool that was refused for its revision, if there is one."""
        if self.refused is not None:
            self.take(self.refused, again=True)

    def adopt(self) -> None:
        """Use the tool that waits, if there is one."""
        self.in_use, self.waiting = self.waiting or self.in_use, None

    def _require_frames(self, tool: OfferedTool) -> None:
        parent, child = self._config.flange_frame, self._config.tool_frame
        if child and tool.child != child:
            raise RefusedError(Reason.BAD_TOOL, f"child '{tool.child}', expected '{child}'")
        if tool.parent != parent:
            raise RefusedError(Reason.BAD_TOOL, f"parent '{tool.parent}', expected '{parent}'")

    def _require_small(self, T_flange_tool: Array) -> None:
        taught, bound = self._taught, self._config.tool
        shift = float(np.linalg.norm(T_flange_tool[:3, 3] - taught[:3, 3]))
        turn = float(np.linalg.norm(frames.log_rotation(T_flange_tool[:3, :3] @ taught[:3, :3].T)))
        if shift > bound.tcp_m + ROUNDING or turn > bound.tcp_rad + ROUNDING:
            raise RefusedError(
                Reason.TOOL_BOUND,
                f"{shift * 1e3:.3f} mm and {np.degrees(turn):.3f} deg from the taught tool, "
                f"allowed {bound.tcp_m * 1e3:g} mm and {np.degrees(bound.tcp_rad):g} deg",
            )


def _same(a: OfferedTool, b: OfferedTool) -> bool:
    if a.revision != b.revision:
        return False
    if a.T_flange_tool is None or b.T_flange_tool is None:
        return a.T_flange_tool is b.T_flange_tool
    return np.array_equal(a.T_flange_tool, b.T_flange_tool)
