# SPDX-License-Identifier: Apache-2.0
"""Simulated hand-eye cells: a robot that holds a line laser before a target, or a camera and board.

The operator jogs until the laser line lies where it is wanted: the true poses are those that are
asked for, and the reported ones are off by the robot's error.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import islice
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from robocal_ros.cell_sim.robot import TrueRobot, Warmth, turn
from robocal_ros.cell_sim.sensors import (
    Prism,
    ProfileSensor,
    Scene,
    ball_on_table,
    block,
    grooved_block,
    stairs,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import inverse

Array = NDArray[np.float64]

T_FLANGE_LIGHT = frames.transform(frames.exp_rotation([0.1, -0.15, 0.6]), [0.06, -0.04, 0.11])
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
    that), ``rotation_rad`` about each axis. Of the robots of public sets the poses err by 0.2 to
    0.5 mm in space, hand-held frames and sensors with them; they repeat to a tenth of that.
    """

    position_m: float = 1.2e-4
    rotation_rad: float = 1e-4

    def stand(self, T_base_flange: Array, rng: np.random.Generator) -> Standstill:
        """See `Robot`."""
        away = self.position_m * rng.standard_normal(3)
        about = self.rotation_rad * rng.standard_normal(3)
        reported = T_base_flange.copy()
        reported[:3, :3] = reported[:3, :3] @ _turns(about)
        reported[:3, 3] += away
        return Standstill(T_base_flange, reported)


def reached(arm: SerialArm, q_near: Array, T_base_flange: Array) -> Array:
    """Joints (n,) of a pose, by way of poses between: inverse kinematics begin near each."""
    start = arm.fk(q_near)
    turned = frames.log_rotation(start[:3, :3].T @ T_base_flange[:3, :3])
    moved = T_base_flange[:3, 3] - start[:3, 3]
    far = max(float(np.linalg.norm(moved)) / WAY_M, float(np.linalg.norm(turned)) / WAY_RAD)
    share = np.linspace(0.0, 1.0, int(far) + 2)[:, None]
    way = frames.transform(
        start[:3, :3] @ frames.exp_rotation(share * turned), start[:3, 3] + share * moved
    )
    return np.asarray(inverse(arm, way, q_near)[-1])


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
        q = reached(self.nominal, self.q_near, T_base_flange)
        there = self.true.flange(q, cold)[0]
        wanted = self.nominal.fk(q) @ frames.invert(there) @ T_base_flange
        q = inverse(self.nominal, wanted[None], q)[0]
        return Standstill(self.true.flange(q, cold, rng)[0], self.nominal.fk(q), q)


class WantedView(NamedTuple):
    """A pose (4, 4) of the light in base that is wanted, and the target's mark on which it lies."""

    T_base_light: Array
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
    T_flange_light : (4, 4) where the light leaves.
    tilt_rad, roll_rad : the largest turn about the light's x and y, and about its z.
    """

    sensor: ProfileSensor = field(default_factory=ProfileSensor)
    robot: Robot = field(default_factory=PoseRobot)
    T_flange_light: Array = field(default_factory=T_FLANGE_LIGHT.copy)
    tilt_rad: float = float(np.radians(25.0))
    roll_rad: float = float(np.radians(60.0))

    @property
    def T_flange_sensor(self) -> Array:
        """The mount (4, 4) that is looked for: of the frame in which the sensor tells profiles."""
        return np.asarray(self.T_flange_light @ self.sensor.T_light_sensor)

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
            T_base_flange = view.T_base_light @ frames.invert(self.T_flange_light)
            try:
                stand = self.robot.stand(T_base_flange, rng)
            except LimitError:
                continue
            stands.append(stand)
            marks.append(view.mark)
            T_base_light = stand.true_T_base_flange @ self.T_flange_light
            profiles.append(self.sensor.shoot(T_base_light, scene, rng))
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


def view(look: Array, turns_rad: ArrayLike, p_base: ArrayLike, p_light: ArrayLike) -> Array:
    """Pose of the light (4, 4) in base that shows a point of the base at a given place.

    Parameters
    ----------
    look : (3, 3) R_base_light without turns.
    turns_rad : (3,) about the light's x, then the new y, then the new z.
    p_base, p_light : (3,) the point in base, and where the light shall fall on it, m.
    """
    R = look @ _turns(turns_rad)
    return frames.transform(R, np.asarray(p_base) - R @ np.asarray(p_light))


def _turns(angles_rad: ArrayLike) -> Array:
    """Turns (3, 3) by (3,) about x, the new y, the new z."""
    x, y, z = np.asarray(angles_rad, dtype=np.float64)[:, None]
    return np.asarray((turn(0, x) @ turn(1, y) @ turn(2, z))[0, :3, :3])


DOWN = np.diag([1.0, -1.0, -1.0])  # R_base_light of a sensor that looks down on the table
FREE_M = 2e-3  # of the measuring range stays free at either end
ASIDE_M = 5e-3  # how far the target lies beside the middle of the profile
OFF_CENTRE = (0.4, 0.7)  # of a sphere's radius, from its centre to the laser plane
ACROSS_M = 0.022  # the same of a line, which is shown all over the field, as check-plan advises
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
                p = [rng.uniform(-ASIDE_M, ASIDE_M), y, nearest + np.sqrt(radius_m**2 - y**2)]
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
                p = [rng.uniform(-ASIDE_M, ASIDE_M), aim_m * rng.standard_normal(), middle]
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
            p = [rng.uniform(-ACROSS_M, ACROSS_M), 0.0, _distance(cell, rng, room, near)]
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
    """R_base_light that faces a slope; the profile's x goes up it, y lies along the frame's x."""
    up = np.array([0.0, run, rise]) / np.hypot(rise, run)
    inward = np.array([0.0, rise, -run]) / np.hypot(rise, run)
    return np.asarray(T_base_user[:3, :3] @ np.column_stack([up, [1.0, 0.0, 0.0], inward]))


def _random_turns(cell: HandEyeCell, rng: np.random.Generator, roll_rad: float) -> Array:
    bounds = np.array([cell.tilt_rad, cell.tilt_rad, roll_rad])
    return bounds * rng.uniform(-1.0, 1.0, 3)


def _distance(
    cell: HandEyeCell, rng: np.random.Generator, behind_m: float, before_m: float = 0.0
) -> float:
    """A distance within the measuring range, with room before and behind it."""
    low = cell.sensor.near_m + FREE_M + before_m
    high = cell.sensor.far_m - FREE_M - behind_m
    return float(rng.uniform(low, max(low, high)))


IN_HAND, TO_HAND = "in-hand", "to-hand"
_SAMPLES = 2  # per pixel and axis
_MOST_ROUNDS, _SETTLED = 50, 1e-9
_MIDDLE = (0.1, 0.0625, 0.0)  # of 9 x 6 corners 25 mm apart
_WHITE, _BLACK, _BEHIND = 225.0, 25.0, 120.0


@dataclass(frozen=True, eq=False)
class TruePose:
    """Poses: rotations and positions (n, 3), m."""

    R: Rotation
    t: Array

    def __matmul__(self, other: "TruePose") -> "TruePose":
        return TruePose(self.R * other.R, self.R.apply(other.t) + self.t)

    def take(self, index: int) -> "TruePose":
        """One of them."""
        return TruePose(self.R[[index]], self.t[[index]])

    def inverse(self) -> "TruePose":
        """The way back."""
        return TruePose(self.R.inv(), -self.R.inv().apply(self.t))

    def matrices(self) -> Array:
        """(n, 4, 4)."""
        T = np.tile(np.eye(4), (len(self.t), 1, 1))
        T[:, :3, :3] = self.R.as_matrix()
        T[:, :3, 3] = self.t
        return T


def true_pose(turn: tuple[float, ...] | Array, place: tuple[float, ...] | Array) -> TruePose:
    """From rotation vectors (n, 3), rad, and positions (n, 3), m, or one of each."""
    return TruePose(Rotation.from_rotvec(np.atleast_2d(turn)), np.atleast_2d(place))


@dataclass(frozen=True, eq=False)
class BoardNoise:
    """Standard deviations an axis: of the robot, and of the board along the camera's axes."""

    robot_m: float = 2e-4
    robot_rad: float = 3e-4
    board_m: tuple[float, float, float] = (1e-4, 1e-4, 4e-4)
    board_rad: tuple[float, float, float] = (1e-3, 1e-3, 2e-4)

    @property
    def board_covariance(self) -> Array:
        """(6, 6) of position and turn."""
        return np.diag(np.square([*self.board_m, *self.board_rad]))


@dataclass(frozen=True, eq=False)
class BoardCell:
    """The truth.

    Attributes
    ----------
    camera : of the camera in its parent: the flange in hand, the base to hand.
    board : of the board in its parent: the base in hand, the flange to hand.
    """

    mount: str = IN_HAND
    camera: TruePose = field(default_factory=lambda: true_pose((0.1, 0.2, 1.4), (0.03, 0.08, 0.12)))
    board: TruePose = field(default_factory=lambda: true_pose((0.1, 0.1, 0.3), (0.6, 0.1, 0.05)))
    noise: BoardNoise = field(default_factory=BoardNoise)

    def views(self, rng: np.random.Generator, count: int, tilt_rad: float = 0.5) -> TruePose:
        """Board poses in the camera: tilted about two axes, turned about the third, in sight."""
        turn = Rotation.from_rotvec(rng.uniform(-1.0, 1.0, (count, 3)) * [tilt_rad, tilt_rad, 1.5])
        middle = rng.uniform([-0.03, -0.02, 0.4], [0.03, 0.02, 0.7], (count, 3))
        return TruePose(turn, middle - turn.apply(_MIDDLE))

    def flange(self, views: TruePose) -> TruePose:
        """Flange poses in base from which the camera has these views."""
        if self.mount == IN_HAND:
            return self.board @ views.inverse() @ self.camera.inverse()
        return self.camera @ views @ self.board.inverse()

    def seen_from(self, flange: TruePose) -> TruePose:
        """Board poses in the camera at flange poses."""
        if self.mount == IN_HAND:
            return self.camera.inverse() @ flange.inverse() @ self.board
        return self.camera.inverse() @ flange @ self.board

    def read_robot(self, flange: TruePose, rng: np.random.Generator) -> Array:
        """T_base_flange (n, 4, 4) as the robot tells them."""
        shape, noise = flange.t.shape, self.noise
        error = Rotation.from_rotvec(noise.robot_rad * rng.standard_normal(shape))
        place = flange.t + noise.robot_m * rng.standard_normal(shape)
        return TruePose(flange.R * error, place).matrices()

    def read_board(self, views: TruePose, rng: np.random.Generator) -> Array:
        """T_camera_board (n, 4, 4) as the camera tells them."""
        shape, noise = views.t.shape, self.noise
        error = Rotation.from_rotvec(np.array(noise.board_rad) * rng.standard_normal(shape))
        place = views.t + np.array(noise.board_m) * rng.standard_normal(shape)
        return TruePose(error * views.R, place).matrices()


@dataclass(frozen=True)
class TrueLens:
    """A pinhole with radial distortion, px."""

    fx: float = 610.0
    fy: float = 612.0
    cx: float = 322.0
    cy: float = 236.0
    k1: float = -0.12
    k2: float = 0.08
    width: int = 640
    height: int = 480

    def corners(self, view: TruePose, points: Array) -> Array:
        """Where points (n, 3) of a board in one view appear (n, 2), px."""
        x, y, z = (view.R.apply(points) + view.t).T
        u, v = x / z, y / z
        r2 = u**2 + v**2
        stretch = 1.0 + self.k1 * r2 + self.k2 * r2**2
        return np.column_stack([self.fx * u * stretch + self.cx, self.fy * v * stretch + self.cy])

    def plane(self, view: TruePose) -> tuple[Array, Array]:
        """X and y, m, where the ray of every sample of an image meets a board's plane."""
        ideal_x, ideal_y = _rays(self)
        R, t = view.R.as_matrix().reshape(3, 3), view.t.ravel()
        # the ray d hits the board where its normal says so
        normal = R[:, 2]
        depth = (normal @ t) / (normal[0] * ideal_x + normal[1] * ideal_y + normal[2])
        away = np.stack([ideal_x * depth - t[0], ideal_y * depth - t[1], depth - t[2]], axis=-1)
        return away @ R[:, 0], away @ R[:, 1]

    def taken(self, shade: Array) -> Array:
        """Grey values (h, w) of pixels from those of their samples."""
        return np.asarray(
            shade.reshape(self.height, _SAMPLES, self.width, _SAMPLES).mean(axis=(1, 3))
        )

    def image(self, view: TruePose, columns: int, rows: int, square_m: float) -> NDArray[np.uint8]:
        """The board of so many inner corners, on white paper a square wider, as a grey image."""
        across, down = (side / square_m for side in self.plane(view))
        inside = (np.abs(across - (columns - 1) / 2) < (columns + 1) / 2) & (
            np.abs(down - (rows - 1) / 2) < (rows + 1) / 2
        )
        paper = (np.abs(across - (columns - 1) / 2) < (columns + 3) / 2) & (
            np.abs(down - (rows - 1) / 2) < (rows + 3) / 2
        )
        black = inside & ((np.floor(across) + np.floor(down)) % 2 == 0)
        shade = np.where(black, _BLACK, np.where(paper, _WHITE, _BEHIND))
        return np.asarray(np.round(self.taken(shade)), dtype=np.uint8)


@cache
def _rays(lens: TrueLens) -> tuple[Array, Array]:
    """Undistorted x and y at depth 1 of every sample of an image.

    Raises
    ------
    ValueError
        When the lens bends rays so far that there is no way back.
    """
    fine = (np.arange(_SAMPLES) + 0.5) / _SAMPLES - 0.5
    u = (np.arange(lens.width)[:, None] + fine).ravel()
    v = (np.arange(lens.height)[:, None] + fine).ravel()
    x, y = np.meshgrid((u - lens.cx) / lens.fx, (v - lens.cy) / lens.fy)
    ideal_x, ideal_y = x, y
    for _ in range(_MOST_ROUNDS):  # the way back through the distortion
        r2 = ideal_x**2 + ideal_y**2
        stretch = 1.0 + lens.k1 * r2 + lens.k2 * r2**2
        last, ideal_x, ideal_y = np.stack([ideal_x, ideal_y]), x / stretch, y / stretch
        if np.abs(np.stack([ideal_x, ideal_y]) - last).max() < _SETTLED:
            return ideal_x, ideal_y
    raise ValueError(f"the distortion of {lens} cannot be undone")
