"""Axes of a real arm that stand to each other a little otherwise than its model says.

Both are taken to miss the model by half of it: they turn about their common perpendicular, and
shift along it, in opposite directions. What the flange is then lies midway, as in the closed form.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.tracker_data import MOVED, TrackerData
from robocal_ros.hand_eye.tracker_flange import Axis, nominal_axis
from robocal_ros.hand_eye.tracker_state import adjoint

Array = NDArray[np.float64]

ANGLE_SIGMA, GAP_SIGMA_M = float(np.radians(0.5)), 1e-3  # of real arms: hardly a restraint
HELD_M = 1e-9  # the gap from a joint that slides has no meaning


@dataclass(frozen=True, eq=False)
class AxisPair:
    """The axes of both arcs in the flange of the first profile, by the nominal geometry.

    Attributes
    ----------
    joints : of the arcs.
    screws : (6, 2) twists that turn about the common perpendicular, and shift along it.
    sigma : (2,) of the mismatch, rad and m.
    height_axis : (3,) direction of the last one that turns.
    """

    joints: tuple[int, int]
    screws: Array
    sigma: Array
    height_axis: Array

    @classmethod
    def of(cls, data: TrackerData, axes: Sequence[Axis]) -> "AxisPair":
        """The axes of the arcs of ``data``."""
        first, second = (
            nominal_axis(data, arc, axis.joint) for arc, axis in zip(data.arcs, axes, strict=True)
        )
        across = np.cross(first[0], second[0])
        across /= np.linalg.norm(across)
        turning = [i for i in (0, 1) if not axes[i].slides]
        last = max(turning, key=lambda i: axes[i].joint)
        foot = (first, second)[last][1]
        if len(turning) == 2:  # where the common perpendicular starts from the first axis
            rows = np.column_stack([first[0], -second[0], across])
            foot = first[1] + first[0] * np.linalg.solve(rows, second[1] - first[1])[0]
        screws = np.zeros((6, 2))
        screws[:3, 0], screws[3:, 0], screws[:3, 1] = np.cross(foot, across), across, across
        return cls(
            joints=(axes[0].joint, axes[1].joint),
            screws=screws,
            sigma=np.array([ANGLE_SIGMA, GAP_SIGMA_M if len(turning) == 2 else HELD_M]),
            height_axis=(first, second)[last][0],
        )

    def share_of(self, q: Array) -> float:
        """Share of the mismatch, -1/2 or 1/2, of the one joint that moves; 0 where several do."""
        moved = np.flatnonzero(np.ptp(q, axis=0) > MOVED)
        if len(moved) != 1 or moved[0] not in self.joints:
            return 0.0
        return self.joints.index(int(moved[0])) - 0.5

    def carried(self, motion: Array, mismatch: Array, share: float) -> Array:
        """Motions (n, 4, 4) about the real axis instead of the nominal one."""
        turn, gap = share * mismatch
        across = self.screws[3:, 0]
        R = frames.exp_rotation(turn * across)
        foot = np.cross(across, self.screws[:3, 0])
        C = frames.transform(R, foot - R @ foot + gap * across)
        return np.asarray(C @ motion @ frames.invert(C))

    def twists(self, carried: Array, share: float) -> Array:
        """Left twists (n, 6, 2) of carried motions by the mismatch."""
        return np.asarray(share * (self.screws - adjoint(carried) @ self.screws))
