"""A simulated robot that holds a line laser before a target: true poses, reported poses, profiles.

The operator jogs until the laser line lies where it is wanted: the true poses are those that are
asked for, and the reported ones are off by the robot's error.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.profile_sensor import ProfileSensor
from robocal_ros.cell_sim.profile_targets import Scene
from robocal_ros.cell_sim.robot import TrueRobot, turn
from robocal_ros.cell_sim.thermal import Warmth
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.inverse import inverse

Array = NDArray[np.float64]

T_FLANGE_SENSOR = frames.transform(frames.exp_rotation([0.1, -0.15, 0.6]), [0.06, -0.04, 0.11])
DRAWS = 20  # views that are tried for each that is wanted
WAY_M, WAY_RAD = 0.05, 0.1  # between the poses on the way to a shot


class Robot(Protocol):
    """A robot that an operator jogs to where a flange pose (4, 4) truly is."""

    def stand(self, T_base_flange: Array, rng: np.random.Generator) -> "Standstill":
        """Stand there; LimitError where it cannot."""


@dataclass(frozen=True, eq=False)
class Standstill:
    """The true and the reported flange pose (4, 4), and the joint readings (n,) where known."""

    true_T_base_flange: Array
    T_base_flange: Array
    q: Array | None = None


@dataclass(frozen=True)
class PoseRobot:
    """A robot that is known by the scatter of its poses alone.

    ``position_m`` is the standard deviation along each axis (in space it is the root of 3 times
    that), ``rotation_rad`` about each axis.
    """

    position_m: float = 5e-5
    rotation_rad: float = 0.0

    def stand(self, T_base_flange: Array, rng: np.random.Generator) -> Standstill:
        """See `Robot`."""
        away = self.position_m * rng.standard_normal(3)
        about = self.rotation_rad * rng.standard_normal(3)
        reported = T_base_flange.copy()
        reported[:3, :3] = reported[:3, :3] @ _turns(about)
        reported[:3, 3] += away
        return Standstill(T_base_flange, reported)


@dataclass(frozen=True, eq=False)
class ArmRobot:
    """A robot with joints; its poses are reported by the nominal model of the true one.

    Attributes
    ----------
    q_near : (n,) from which it goes to each shot.
    """

    true: TrueRobot
    q_near: Array

    @property
    def nominal(self) -> SerialArm:
        """Its model."""
        return self.true.nominal

    def stand(self, T_base_flange: Array, rng: np.random.Generator) -> Standstill:
        """See `Robot`."""
        cold = Warmth.cold(self.nominal.n)
        q = self._reach(T_base_flange)
        there = self.true.flange(q, cold)[0]
        wanted = self.nominal.fk(q) @ frames.invert(there) @ T_base_flange
        q = inverse(self.nominal, wanted[None], q)[0]
        return Standstill(self.true.flange(q, cold, rng)[0], self.nominal.fk(q), q)

    def _reach(self, T_base_flange: Array) -> Array:
        """Joints (n,) at a pose of the nominal model, by way of poses between."""
        start = self.nominal.fk(self.q_near)
        turned = frames.log_rotation(start[:3, :3].T @ T_base_flange[:3, :3])
        moved = T_base_flange[:3, 3] - start[:3, 3]
        far = max(float(np.linalg.norm(moved)) / WAY_M, float(np.linalg.norm(turned)) / WAY_RAD)
        share = np.linspace(0.0, 1.0, int(far) + 2)[:, None]
        way = frames.transform(
            start[:3, :3] @ frames.exp_rotation(share * turned), start[:3, 3] + share * moved
        )
        return np.asarray(inverse(self.nominal, way, self.q_near)[-1])


class WantedView(NamedTuple):
    """A sensor pose (4, 4) in base that is wanted, and the target's mark that the light lies on."""

    T_base_sensor: Array
    mark: str = ""


@dataclass(frozen=True, eq=False)
class SimulatedShots:
    """What came of m standstills.

    Attributes
    ----------
    true_T_base_flange, T_base_flange : (m, 4, 4) true and as reported.
    profiles : (columns, 2) of each.
    marks : of each; empty where the target has none.
    q : (m, n) joint readings; None for a robot without joints.
    """

    true_T_base_flange: Array
    T_base_flange: Array
    profiles: Sequence[Array]
    marks: Sequence[str]
    q: Array | None


@dataclass(frozen=True, eq=False)
class HandEyeCell:
    """A sensor, where it truly sits on its robot, and how far the operator turns it.

    Attributes
    ----------
    tilt_rad, roll_rad : the largest turn about the sensor's x and y, and about its z.
    """

    sensor: ProfileSensor = field(default_factory=ProfileSensor)
    robot: Robot = field(default_factory=PoseRobot)
    T_flange_sensor: Array = field(default_factory=T_FLANGE_SENSOR.copy)
    tilt_rad: float = float(np.radians(25.0))
    roll_rad: float = float(np.radians(60.0))

    def shoot(
        self, scene: Scene, wanted: Iterable[WantedView], count: int, rng: np.random.Generator
    ) -> SimulatedShots:
        """``count`` shots of a scene from the first of the wanted poses that are in reach.

        Raises
        ------
        LimitError
            When too few are.
        """
        stands: list[Standstill] = []
        profiles, marks = [], []
        for view in islice(wanted, DRAWS * count):
            if len(stands) == count:
                break
            T_base_flange = view.T_base_sensor @ frames.invert(self.T_flange_sensor)
            try:
                stand = self.robot.stand(T_base_flange, rng)
            except LimitError:
                continue
            stands.append(stand)
            marks.append(view.mark)
            T_base_sensor = stand.true_T_base_flange @ self.T_flange_sensor
            profiles.append(self.sensor.shoot(T_base_sensor, scene, rng))
        if len(stands) < count:
            raise LimitError(f"{len(stands)} of {count} views are in reach: move the target")
        q = [stand.q for stand in stands if stand.q is not None]
        return SimulatedShots(
            np.array([stand.true_T_base_flange for stand in stands]),
            np.array([stand.T_base_flange for stand in stands]),
            profiles,
            marks,
            np.array(q) if q else None,
        )


def view(look: Array, turns_rad: ArrayLike, p_base: ArrayLike, p_sensor: ArrayLike) -> Array:
    """Sensor pose (4, 4) in base that shows a point of the base at a given place.

    Parameters
    ----------
    look : (3, 3) R_base_sensor without turns.
    turns_rad : (3,) about the sensor's x, then the new y, then the new z.
    p_base, p_sensor : (3,) the point in base, and where the sensor shall see it, m.
    """
    R = look @ _turns(turns_rad)
    return frames.transform(R, np.asarray(p_base) - R @ np.asarray(p_sensor))


def _turns(angles_rad: ArrayLike) -> Array:
    """Turns (3, 3) by (3,) about x, the new y, the new z."""
    x, y, z = np.asarray(angles_rad, dtype=np.float64)[:, None]
    return np.asarray((turn(0, x) @ turn(1, y) @ turn(2, z))[0, :3, :3])
