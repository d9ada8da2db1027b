"""The unknowns of a calibration by laser tracker, and how rigid motions act on what is seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.increments import moved, tangents
from robocal_ros.hand_eye.tracker_data import FACES

Array = NDArray[np.float64]

FLANGE, SENSOR = slice(0, 6), slice(6, 12)
REFLECTOR, CENTRE = slice(12, 15), slice(15, 18)
NORMALS = (slice(18, 20), slice(20, 22))
OFFSETS, MISMATCH = slice(22, 24), slice(24, 26)
UNKNOWNS = 26
NAMES = tuple(
    f"{what} {axis}"
    for what, axes in (
        ("flange in tracker", ("x", "y", "z", "turn x", "turn y", "turn z")),
        ("sensor in flange", ("x", "y", "z", "turn x", "turn y", "turn z")),
        ("reflector", ("x", "y", "z")),
        ("sphere", ("x", "y", "z")),
        *((face, ("tilt", "turn")) for face in FACES),
        ("face offset", ("1", "2")),
        ("axes", ("angle", "gap")),
    )
    for axis in axes
)


@dataclass(frozen=True, eq=False)
class TrackerUnknowns:
    """All unknowns, SI.

    Attributes
    ----------
    T_tracker_flange : (4, 4) at the first profile; T_flange_sensor (4, 4).
    reflector : (3,) in the flange; ``centre`` (3,) of the sphere, tracker.
    normals, offsets : (2, 3) and (2,) of the faces, outward, tracker.
    mismatch : (2,) of the axes' angle and gap, real minus nominal.
    """

    T_tracker_flange: Array
    T_flange_sensor: Array
    reflector: Array
    centre: Array
    normals: Array
    offsets: Array
    mismatch: Array

    def moved(self, step: Array) -> "TrackerUnknowns":
        """The state after an increment (26,)."""
        tilts = np.array(
            [tangents(n) @ step[part] for n, part in zip(self.normals, NORMALS, strict=True)]
        )
        normals = self.normals + tilts
        return TrackerUnknowns(
            T_tracker_flange=moved(self.T_tracker_flange, step[FLANGE]),
            T_flange_sensor=moved(self.T_flange_sensor, step[SENSOR]),
            reflector=self.reflector + step[REFLECTOR],
            centre=self.centre + step[CENTRE],
            normals=normals / np.linalg.norm(normals, axis=1)[:, None],
            offsets=self.offsets + step[OFFSETS],
            mismatch=self.mismatch + step[MISMATCH],
        )

    def sensor_poses(self, motion: Array) -> Array:
        """T_tracker_sensor (m, 4, 4) of the profiles, from their T_flange0_flange (m, 4, 4)."""
        return np.asarray(self.T_tracker_flange @ motion @ self.T_flange_sensor)


def adjoint(T: Array) -> Array:
    """(..., 6, 6): twists (v, w) given on the right of a frame, on the left of T (..., 4, 4).

    ``exp(adjoint(T) x) T = T exp(x)``.
    """
    R, t = T[..., :3, :3], T[..., :3, 3]
    found = np.zeros((*T.shape[:-2], 6, 6))
    found[..., :3, :3] = found[..., 3:, 3:] = R
    found[..., :3, 3:] = frames.skew(t) @ R
    return found
