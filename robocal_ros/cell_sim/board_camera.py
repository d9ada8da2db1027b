"""A camera and a chessboard about a robot: true poses, what both sides read of them, images.

Rotations are scipy's and the projection is written out: no code is shared with the estimators.
"""

from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

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

    def image(self, view: TruePose, columns: int, rows: int, square_m: float) -> NDArray[np.uint8]:
        """The board of so many inner corners, on white paper a square wider, as a grey image."""
        ideal_x, ideal_y = _rays(self)
        R, t = view.R.as_matrix().reshape(3, 3), view.t.ravel()
        # the ray d hits the board where its normal says so
        normal = R[:, 2]
        depth = (normal @ t) / (normal[0] * ideal_x + normal[1] * ideal_y + normal[2])
        away = np.stack([ideal_x * depth - t[0], ideal_y * depth - t[1], depth - t[2]], axis=-1)
        across, down = away @ R[:, 0] / square_m, away @ R[:, 1] / square_m
        inside = (np.abs(across - (columns - 1) / 2) < (columns + 1) / 2) & (
            np.abs(down - (rows - 1) / 2) < (rows + 1) / 2
        )
        paper = (np.abs(across - (columns - 1) / 2) < (columns + 3) / 2) & (
            np.abs(down - (rows - 1) / 2) < (rows + 3) / 2
        )
        black = inside & ((np.floor(across) + np.floor(down)) % 2 == 0)
        shade = np.where(black, _BLACK, np.where(paper, _WHITE, _BEHIND))
        shade = shade.reshape(self.height, _SAMPLES, self.width, _SAMPLES).mean(axis=(1, 3))
        return np.asarray(np.round(shade), dtype=np.uint8)


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


def moving_flange(time_s: Array) -> TruePose:
    """A smooth motion that turns about all axes, and stands for a moment now and then."""
    t = time_s + 0.3 * np.sin(1.3 * time_s)
    turn = np.column_stack(
        [0.4 * np.sin(0.9 * t), 0.5 * np.sin(0.7 * t + 1.0), 0.8 * np.sin(0.5 * t + 2.0)]
    )
    place = np.column_stack(
        [0.5 + 0.1 * np.sin(0.8 * t), 0.1 * np.sin(1.1 * t), 0.4 + 0.05 * np.sin(0.6 * t)]
    )
    start = Rotation.from_rotvec([np.pi - 0.2, 0.0, 0.0])
    return TruePose(start * Rotation.from_rotvec(turn), place)
