"""A simulated robot that holds a line laser before a target: true poses, reported poses, profiles.

The operator jogs until the laser line lies where it is wanted: the true poses are those that are
asked for, and the reported ones are off by the robot's error.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.profile_sensor import (
    Prism,
    ProfileSensor,
    Scene,
    ball_on_table,
    block,
    grooved_block,
    stairs,
)
from robocal_ros.cell_sim.robot import TrueRobot, Warmth, turn
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


# ---- simulated sets of shots of a sphere, of stairs, of an edge and of a groove -----------------


DOWN = np.diag([1.0, -1.0, -1.0])  # R_base_sensor of a sensor that looks down on the table
FREE_M = 2e-3  # of the measuring range stays free at either end
ASIDE_M = 5e-3  # how far the target lies beside the middle of the profile
OFF_CENTRE = (0.4, 0.7)  # of a sphere's radius, from its centre to the laser plane
CROSSING_RAD = float(np.radians(40.0))  # largest turn of the light against the normal of an edge
BLOCK_M = 0.2
GROOVE_M, GROOVE_DEPTH_M = 0.012, 0.005


def sphere_shots(
    cell: HandEyeCell,
    centre: ArrayLike,
    radius_m: float,
    count: int,
    rng: np.random.Generator,
    signs: tuple[int, ...] = (-1, 1),
) -> SimulatedShots:
    """Shots of a ball on a stem; the laser plane passes the centre (3,), base, off by y.

    ``signs`` that y takes in turn.
    """
    scene = ball_on_table(centre, radius_m)

    def wanted() -> Iterator[WantedView]:
        while True:
            for sign in signs:
                y = sign * radius_m * rng.uniform(*OFF_CENTRE)
                nearest = _distance(cell, rng, 0.5 * radius_m)
                p = [_aside(rng), y, nearest + np.sqrt(radius_m**2 - y**2)]
                turns = _random_turns(cell, rng, cell.roll_rad)
                yield WantedView(view(DOWN, turns, centre, p))

    return cell.shoot(scene, wanted(), count, rng)


@dataclass(frozen=True)
class TrueStairs:
    """Stairs as they stand: their steps along x, y into them, z up; marks at thirds of x."""

    T_base_user: Array
    steps: int = 5
    length_m: float = 0.09
    height_m: float = 0.01
    depth_m: float = 0.01

    @property
    def body(self) -> Prism:
        """What the light meets."""
        return stairs(self.T_base_user, self.steps, self.length_m, self.height_m, self.depth_m)

    @property
    def extent_m(self) -> float:
        """From the first step's edge to the last one's."""
        return (self.steps - 1) * float(np.hypot(self.height_m, self.depth_m))

    def middle(self, mark: str) -> Array:
        """The point (3,), base, amid the edges at a mark."""
        x = self.length_m / 3.0 * {"near": 1.0, "far": 2.0}[mark]
        y = 0.5 * (self.steps - 1) * self.depth_m
        z = 0.5 * (self.steps + 1) * self.height_m
        return np.asarray((self.T_base_user @ [x, y, z, 1.0])[:3])


def step_shots(
    cell: HandEyeCell,
    target: TrueStairs,
    count: int,
    rng: np.random.Generator,
    marks: tuple[str, ...] = ("near", "far"),
    *,
    aim_m: float = 2e-4,
    level: bool = False,
) -> SimulatedShots:
    """Shots with the laser plane through the marks, which take turns; x of a profile goes upstairs.

    Parameters
    ----------
    aim_m : how well the operator sees the light on a mark, one sigma.
    level : lay the laser plane at right angles to the edges, not just through the marks of the
        convex corners: then the concave ones lie at the marks too.
    """
    saw = target.height_m * target.depth_m / np.hypot(target.height_m, target.depth_m)
    depth = cell.sensor.far_m - cell.sensor.near_m
    steepest = (depth - saw - 2.0 * FREE_M) / target.extent_m
    along = min(cell.tilt_rad, float(np.arcsin(np.clip(steepest, 0.0, 1.0))))
    look = _look(target.T_base_user, target.height_m, target.depth_m)

    def wanted() -> Iterator[WantedView]:
        while True:
            for mark in marks:
                about_x = 0.0 if level else rng.uniform(-cell.tilt_rad, cell.tilt_rad)
                about_z = 2.0 * aim_m / target.extent_m * rng.standard_normal()
                turns = [about_x, rng.uniform(-along, along), about_z]
                middle = 0.5 * (cell.sensor.near_m + cell.sensor.far_m) - 0.5 * saw
                p = [_aside(rng), aim_m * rng.standard_normal(), middle]
                yield WantedView(view(look, turns, target.middle(mark), p), mark)

    return cell.shoot(Scene((target.body,)), wanted(), count, rng)


def edge_block(T_base_user: Array) -> Prism:
    """A block whose upper edge is x of the frame."""
    return block(T_base_user, BLOCK_M, 0.1, 0.1)


def edge_shots(
    cell: HandEyeCell, T_base_user: Array, count: int, rng: np.random.Generator
) -> SimulatedShots:
    """Shots across the upper edge of a block; the edge is x of the frame."""
    body = edge_block(T_base_user)
    return _line_shots(cell, body, _look(T_base_user, 1.0, 1.0), 0.5, count, rng)


def groove_shots(
    cell: HandEyeCell, T_base_user: Array, count: int, rng: np.random.Generator
) -> SimulatedShots:
    """Shots across a V-groove; its bottom is x of the frame, z points up out of it."""
    body = grooved_block(T_base_user, BLOCK_M, 0.05, GROOVE_M, GROOVE_DEPTH_M)
    return _line_shots(cell, body, _look(T_base_user, 0.0, 1.0), 0.0, count, rng)


def _line_shots(
    cell: HandEyeCell,
    body: Prism,
    look: Array,
    behind: float,
    count: int,
    rng: np.random.Generator,
) -> SimulatedShots:
    """Shots of the line x of a body; ``behind``: share of the range that is left beyond it."""
    sensor, T = cell.sensor, body.T_base_user
    turned = min(cell.roll_rad, CROSSING_RAD)

    def wanted() -> Iterator[WantedView]:
        while True:
            x = BLOCK_M * rng.uniform(0.3, 0.7)
            room = behind * (sensor.far_m - sensor.near_m)
            near = 0.0 if behind else GROOVE_DEPTH_M + ASIDE_M
            p = [_aside(rng), 0.0, _distance(cell, rng, room, near)]
            turns = _random_turns(cell, rng, turned)
            yield WantedView(view(look, turns, T[:3, 3] + x * T[:3, 0], p))

    return cell.shoot(Scene((body,)), wanted(), count, rng)


def taught(T_base_user: Array, error_m: float, error_rad: float, rng: np.random.Generator) -> Array:
    """A frame (4, 4) as it is taught, with errors (one sigma) along and about each axis."""
    error = frames.transform(
        frames.exp_rotation(error_rad * rng.standard_normal(3)), error_m * rng.standard_normal(3)
    )
    return np.asarray(T_base_user @ error)


def _look(T_base_user: Array, rise: float, run: float) -> Array:
    """R_base_sensor that faces a slope; the profile's x goes up it, y lies along the frame's x."""
    up = np.array([0.0, run, rise]) / np.hypot(rise, run)
    inward = np.array([0.0, rise, -run]) / np.hypot(rise, run)
    return np.asarray(T_base_user[:3, :3] @ np.column_stack([up, [1.0, 0.0, 0.0], inward]))


def _random_turns(cell: HandEyeCell, rng: np.random.Generator, roll_rad: float) -> Array:
    bounds = np.array([cell.tilt_rad, cell.tilt_rad, roll_rad])
    return bounds * rng.uniform(-1.0, 1.0, 3)


def _aside(rng: np.random.Generator) -> float:
    return float(rng.uniform(-ASIDE_M, ASIDE_M))


def _distance(
    cell: HandEyeCell, rng: np.random.Generator, behind_m: float, before_m: float = 0.0
) -> float:
    """A distance within the measuring range, with room before and behind it."""
    low = cell.sensor.near_m + FREE_M + before_m
    high = cell.sensor.far_m - FREE_M - behind_m
    return float(rng.uniform(low, max(low, high)))
