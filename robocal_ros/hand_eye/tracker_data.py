"""What a laser tracker and a profile sensor measure of one cube with a sphere beside it."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

FACES = ("face_1", "face_2")
MOVED = 1e-3  # rad or m: a joint that changes by less stands still
FEWEST_ARC_POINTS = 6
FEWEST_FACE_POINTS = 4
FEWEST_PROFILES = 8


@dataclass(frozen=True)
class TrackerTarget:
    """Sizes of what is measured.

    Attributes
    ----------
    sphere_radius_m : of the sphere that the sensor scans; the tracker measures its centre.
    reflector_radius_m : of the tracked ball that touches the faces of the cube.
    height_m, height_sigma_m : coordinate of the reflector on the flange, from the flange's origin
        along the axis of the last turning joint of the arcs, and its standard deviation. Needed
        where the other joint slides; None where it is not known.
    """

    sphere_radius_m: float
    reflector_radius_m: float
    height_m: float | None = None
    height_sigma_m: float = 2e-5


@dataclass(frozen=True)
class TrackerNoise:
    """Standard deviations: of a tracker coordinate, and of a joint that moves between visits."""

    tracker_m: float = 1.5e-5
    joint_rad: float = 5e-5
    joint_m: float = 2e-5


@dataclass(frozen=True, eq=False)
class Arc:
    """The reflector on the flange while one joint moves: an arc, or a line where it slides.

    Attributes
    ----------
    name : for reports.
    q : (n, dof) joint readings; ``points`` (n, 3) of the reflector in the tracker frame, m.
    """

    name: str
    q: Array
    points: Array

    def joint(self, arm: SerialArm) -> int:
        """The one joint that moves.

        Raises
        ------
        InputError
            When none or several move.
        TooFewSamplesError
            When there are too few points.
        """
        if len(self.points) < FEWEST_ARC_POINTS:
            raise TooFewSamplesError(
                f"{self.name} has {len(self.points)} points (at least {FEWEST_ARC_POINTS})"
            )
        moved = np.flatnonzero(np.ptp(self.q, axis=0) > MOVED)
        if len(moved) != 1:
            names = ", ".join(arm.joint_names[j] for j in moved) or "no joint"
            raise InputError(
                f"{self.name}: {names} moved; drive exactly one joint and keep the others still"
            )
        return int(moved[0])


@dataclass(frozen=True, eq=False)
class TrackerData:
    """All measurements of one calibration; the tracker, the target and the robot's base stay.

    Attributes
    ----------
    arcs : of two joints, in any order.
    sphere : (k, 3) measured centres of the sphere, tracker frame, m.
    faces : (k, 3) each, reflector centres while it touches one face and the other.
    q : (m, dof) joint readings of the profiles.
    """

    arm: SerialArm
    arcs: tuple[Arc, Arc]
    sphere: Array
    faces: tuple[Array, Array]
    q: Array
    profiles: Sequence[Profile]

    def __post_init__(self) -> None:
        if len(self.q) != len(self.profiles):
            raise ValueError(f"{len(self.q)} poses for {len(self.profiles)} profiles")

    def require_enough(self) -> None:
        """Refuse a calibration that lacks measurements.

        Raises
        ------
        TooFewSamplesError
            Naming what is missing.
        """
        if len(self.sphere) < 1:
            raise TooFewSamplesError("the tracker measured no centre of the sphere")
        for name, points in zip(FACES, self.faces, strict=True):
            if len(points) < FEWEST_FACE_POINTS:
                raise TooFewSamplesError(
                    f"{name} has {len(points)} tracker points (at least {FEWEST_FACE_POINTS}): "
                    "spread them over the face"
                )
        if len(self.profiles) < FEWEST_PROFILES:
            raise TooFewSamplesError(
                f"the scan has {len(self.profiles)} profiles (at least {FEWEST_PROFILES})"
            )

    @cached_property
    def motion(self) -> Array:
        """Flange pose of each profile in that of the first: T_flange0_flange (m, 4, 4)."""
        return self.relative(self.q)

    def relative(self, q: Array) -> Array:
        """T_flange0_flange (n, 4, 4) at joint readings (n, dof)."""
        return np.asarray(frames.invert(self.arm.fk(self.q[0])) @ self.arm.fk(q))
