"""Where the flange was, and how fast it moved, at the stamps of edges."""

from dataclasses import dataclass
from functools import cached_property
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

FEWEST_READINGS = 4
LONGEST_GAP_S = 0.05  # of a turn of 1.5 s: the cubic between two readings misses by 0.1 um


class FlangePath(Protocol):
    """The flange over time."""

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """T_base_flange (m, 4, 4) and twist (m, 6): see `JointPath.at`."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """The flange from joint readings, with cubic splines between them.

    Attributes
    ----------
    arm : the model in force, so that the thermal drift is in the poses.
    time_s : (n,) stamps of the readings, in increasing order.
    q : (n, joints) readings, rad (prismatic: m).
    longest_gap_s : longest pause between two readings around an edge.

    Raises
    ------
    TooFewSamplesError, InputError
        Fewer than four readings; stamps that do not increase.
    """

    arm: SerialArm
    time_s: Array
    q: Array
    longest_gap_s: float = LONGEST_GAP_S

    def __post_init__(self) -> None:
        if len(self.time_s) < FEWEST_READINGS:
            raise TooFewSamplesError(
                f"{len(self.time_s)} joint readings: record joint_states during the whole motion"
            )
        step = np.diff(self.time_s)
        if np.any(step <= 0.0):
            late = int(np.argmax(step <= 0.0)) + 1
            raise InputError(
                f"joint reading at {self.time_s[late]:.6f} s is not after the one before it"
            )

    @cached_property
    def _spline(self) -> Any:
        from scipy.interpolate import CubicSpline

        return CubicSpline(self.time_s, self.q)

    def at(self, time_s: Array) -> tuple[Array, Array]:
        """T_base_flange (m, 4, 4) and twist (m, 6): of its origin, m/s, and turning, rad/s, base.

        Raises
        ------
        InputError
            When readings are missing around one of the times.
        """
        after = np.searchsorted(self.time_s, time_s, side="right")
        inside = (after > 0) & (after < len(self.time_s))
        if not np.all(inside):
            lost = float(time_s[~inside][0])
            raise InputError(
                f"no joint readings around the edge at {lost:.4f} s (they run from "
                f"{self.time_s[0]:.4f} to {self.time_s[-1]:.4f} s): record the whole motion"
            )
        gap = self.time_s[after] - self.time_s[after - 1]
        worst = int(np.argmax(gap))
        if gap[worst] > self.longest_gap_s:
            raise InputError(
                f"joint readings pause for {gap[worst] * 1e3:.0f} ms around the edge at "
                f"{time_s[worst]:.4f} s (allowed {self.longest_gap_s * 1e3:.0f} ms): raise the "
                "rate of joint_states"
            )
        q, rate = self._spline(time_s), self._spline(time_s, 1)
        return self.arm.fk(q), (self.arm.jacobian(q) @ rate[:, :, None])[:, :, 0]
