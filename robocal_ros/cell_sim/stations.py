"""What measures at the robot: sphere sensor and floor sphere, line laser; when it stands still."""

from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.profile_sensor import ProfileSensor, Scene
from robocal_ros.cell_sim.robot import Draws, Effects, Stream
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.planning import SensorField

# ---- a fixed sensor that measures the centre of a sphere carried at the flange ------------------


Array = NDArray[np.float64]

STEM_EXPANSION_PER_K = 12e-6  # steel


@dataclass(frozen=True, eq=False)
class SphereSensor:
    """A sensor with its errors.

    Attributes
    ----------
    T_sensor_base : (4, 4) where it stands.
    ball : (3,) sphere centre in the flange frame, cold, m; the stem leads there from the flange's
        centre.
    noise : standard deviation of each coordinate, m.
    warm_up : (3,) drift of a warm sensor in its own frame, m, reached with ``warm_up_tau_s``.
    outlier_share, outlier_size : how often something else is measured, and how far off it is, m.
    """

    T_sensor_base: Array
    ball: Array
    noise: float = 2e-5
    warm_up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1e-5]))
    warm_up_tau_s: float = 1800.0
    outlier_share: float = 0.01
    outlier_size: float = 1e-3
    effects: Effects = field(default_factory=Effects)

    def ball_in_flange(self, flange_rise: float) -> Array:
        """Sphere centre (3,) when the flange is so many kelvin warmer than cold."""
        if not self.effects.stem:
            return self.ball
        return np.asarray(self.ball * (1.0 + STEM_EXPANSION_PER_K * flange_rise))

    def measure(
        self,
        T_base_flange: Array,
        flange_rise: float,
        since_start_s: float,
        rng: np.random.Generator,
    ) -> Array:
        """Measured centre (3,) in the sensor frame, m.

        Parameters
        ----------
        T_base_flange : (4, 4) true pose of the flange.
        flange_rise : of the flange's temperature, K.
        since_start_s : time since the cold sensor was switched on.
        """
        T = self.T_sensor_base @ T_base_flange
        p = T[:3, :3] @ self.ball_in_flange(flange_rise) + T[:3, 3]
        # Drawn whether used or not: switching one effect off leaves the others' draws alone.
        noise, direction, chance = rng.standard_normal(3), rng.standard_normal(3), rng.random()
        if self.effects.sensor_warm_up:
            p = p + self.warm_up * (1.0 - np.exp(-since_start_s / self.warm_up_tau_s))
        if self.effects.noise:
            p = p + self.noise * noise
        if self.effects.outliers and chance < self.outlier_share:
            p = p + self.outlier_size * direction / np.linalg.norm(direction)
        return np.asarray(p)


# ---- what a 3-D sensor sees of a sphere ---------------------------------------------------------


@dataclass(frozen=True)
class CloudScene:
    """How the sphere is seen.

    Attributes
    ----------
    radius_m, noise_m : true radius, and scatter of the points along the normal.
    half_angle_rad : of the cone of normals that the sensor still resolves.
    stem, background, spikes : shares of the points that are not the sphere's.
    """

    radius_m: float = 0.01905
    noise_m: float = 3e-5
    half_angle_rad: float = float(np.radians(60.0))
    stem: float = 0.12
    background: float = 0.10
    spikes: float = 0.02


def sphere_cloud(
    centre: Array, count: int, rng: np.random.Generator, scene: CloudScene | None = None
) -> Array:
    """Points (count, 3), m, in the sensor's frame, in random order."""
    scene = scene or CloudScene()
    r = scene.radius_m
    kinds = np.round(count * np.array([scene.stem, scene.background, scene.spikes])).astype(int)
    stems, behind, spikes = (int(n) for n in kinds)
    seen = count - stems - behind - spikes
    view = -centre / np.linalg.norm(centre)
    side = np.cross(view, [1.0, 0.0, 0.0])
    side /= np.linalg.norm(side)
    across = np.cross(view, side)

    def place(x: Array, y: Array, toward: Array) -> Array:
        """Points by their distances from the centre across, along the stem, to the sensor."""
        return np.asarray(centre + np.outer(x, across) + np.outer(y, side) + np.outer(toward, view))

    cosine = rng.uniform(np.cos(scene.half_angle_rad), 1.0, seen)
    turn, sine = rng.uniform(0.0, 2.0 * np.pi, seen), np.sqrt(1.0 - cosine**2)
    reach = r + scene.noise_m * rng.standard_normal(seen)
    cap = place(reach * sine * np.cos(turn), reach * sine * np.sin(turn), reach * cosine)
    angle = rng.uniform(-1.0, 1.0, stems)  # the stem: a cylinder of a quarter of the diameter
    stem = place(0.25 * r * np.sin(angle), rng.uniform(r, 3.0 * r, stems), 0.25 * r * np.cos(angle))
    x, y = rng.uniform(-4.0 * r, 4.0 * r, (2, behind))
    plane = place(x, y, np.full(behind, -3.0 * r))
    wild = centre + rng.uniform(-2.0 * r, 2.0 * r, (spikes, 3))
    cloud = np.vstack([cap, stem, plane, wild])
    return np.asarray(cloud[rng.permutation(len(cloud))])


# ---- a sphere at the flange and one on the floor ------------------------------------------------


CLEAR_RAD = float(np.radians(60.0))  # between the stem and the view, else the stem hides the sphere
SPHERE_ROOM = 1.3  # the field's corners are farther than its middle


@dataclass(frozen=True, eq=False)
class SphereStation:
    """The sensor, its field and its pace.

    Attributes
    ----------
    floor : (3,) centre of the sphere on the floor, in the sensor's frame, m.
    floor_sigma_m : scatter of its measured centre, a mean of some readings.
    points : of a cloud; 0: none, the centre alone is told.
    settle_s, period_s : rest before the first measurement, and between two of them.
    delay_s : from a measurement to when it is told.
    """

    sensor: SphereSensor
    floor: Array
    field: SensorField = field(default_factory=SensorField)
    floor_sigma_m: float = 1e-5
    points: int = 2000
    settle_s: float = 0.5
    period_s: float = 1.0
    delay_s: float = 0.15

    def near(self, T_base_flange: Array) -> bool:
        """Whether the sphere may be in the field at a flange pose (4, 4) known to centimetres."""
        ball = self.sensor.T_sensor_base @ T_base_flange @ np.append(self.sensor.ball, 1.0)
        return bool(np.linalg.norm(ball[:3]) < SPHERE_ROOM * self.field.far_m)

    def sees(self, T_base_flange: Array) -> bool:
        """Whether the sphere is in the field, in front of its stem, at a flange pose (4, 4)."""
        T = self.sensor.T_sensor_base @ T_base_flange
        stem = T[:3, :3] @ self.sensor.ball
        centre = stem + T[:3, 3]
        cosine = stem @ centre / np.linalg.norm(stem) / np.linalg.norm(centre)
        return bool(self.field.holds(centre[None])[0] and cosine < np.cos(CLEAR_RAD))

    def shoot(
        self,
        T_base_flange: Array,
        flange_rise: float,
        tick: int,
        time_s: float,
        faults: Faults,
        draws: Draws,
    ) -> "SphereShot | None":
        """Measure both spheres; None where the message is lost."""
        if draws.of(Stream.LOST_SHOTS, tick).random() < faults.size("lost_messages"):
            return None
        rng = draws.of(Stream.SHOTS, tick)
        sensor = replace(self.sensor, ball=self.sensor.ball + faults.ball_shift)
        centre = sensor.measure(T_base_flange, flange_rise, time_s, rng)
        floor = self.floor + self.floor_sigma_m * rng.standard_normal(3)
        seen = np.vstack([centre, floor])
        if self.points:
            seen = np.vstack([seen, sphere_cloud(centre, self.points, rng)])
        T = faults.T_sensor_knock
        seen = seen @ T[:3, :3].T + T[:3, 3]
        stamp_s = time_s + faults.size("sensor_clock_jump")
        return SphereShot(stamp_s, time_s + self.delay_s, seen[0], seen[1], seen[2:])


@dataclass(frozen=True, eq=False)
class SphereShot:
    """A measurement, in the sensor's frame, m.

    Attributes
    ----------
    time_s, told_s : its stamp, and when it is told.
    centre, floor : (3,) of the sphere on the flange and of the one on the floor.
    points : (count, 3) of the first one's cloud; none where the station gives no clouds.
    """

    time_s: float
    told_s: float
    centre: Array
    floor: Array
    points: Array


# ---- a line laser on the flange, and the target that it looks at while the robot stands ---------


TARGET_ROOM = 2.0  # a target further away than this many times the range is not looked at


@dataclass(frozen=True, eq=False)
class ProfileStation:
    """The sensor and its pace.

    Attributes
    ----------
    T_flange_sensor : (4, 4) where it truly sits.
    target : (3,) about where the scene is, base, m.
    settle_s, period_s : rest before the first profile, and between two of them.
    delay_s : from a profile to when it is told.
    """

    sensor: ProfileSensor
    T_flange_sensor: Array
    scene: Scene
    target: Array
    settle_s: float = 0.5
    period_s: float = 1.0
    delay_s: float = 0.04

    def near(self, T_base_flange: Array) -> bool:
        """Whether the target may be in range at a flange pose (4, 4) known to centimetres."""
        away = (T_base_flange @ self.T_flange_sensor)[:3, 3] - self.target
        return bool(np.linalg.norm(away) < TARGET_ROOM * self.sensor.far_m)

    def shoot(
        self, T_base_flange: Array, tick: int, time_s: float, draws: Draws
    ) -> "ProfileShot | None":
        """A profile; None where nothing returns."""
        rng = draws.of(Stream.PROFILES, tick)
        points = self.sensor.shoot(T_base_flange @ self.T_flange_sensor, self.scene, rng)
        if not np.any(np.isfinite(points)):
            return None
        return ProfileShot(time_s, time_s + self.delay_s, points)


@dataclass(frozen=True, eq=False)
class ProfileShot:
    """A profile (columns, 2): x and z in the sensor's frame, m, not-a-number without a return.

    ``time_s`` is its stamp, ``told_s`` when it is told.
    """

    time_s: float
    told_s: float
    points: Array


# ---- when a robot stands, counted in ticks ------------------------------------------------------


Index = NDArray[np.int64]

TICK_S = 8e-3  # the cell works in whole ticks, so that it does not matter when it is asked
FEWEST = 4  # ticks: a shorter stop, as where a plunge turns, is no rest


class Standing:
    """Looks at what moved, from tick to tick."""

    def __init__(self) -> None:
        self._moved = -FEWEST - 1

    def look(self, tick: int, moved: NDArray[np.bool_]) -> tuple[Index, Index]:
        """Ticks at which a motion begins, and for how many ticks it stood at each (k,).

        ``moved`` (k,): whether it moved until each of the ticks after ``tick``.
        """
        ticks = tick + 1 + np.arange(len(moved))
        last = np.maximum.accumulate(np.where(moved, ticks, self._moved))
        before = np.append(self._moved, last[:-1])
        self._moved = int(last[-1])
        return ticks[moved & (ticks - 1 - before >= FEWEST)] - 1, ticks - last


def standstills(
    station: SphereStation | ProfileStation, arm: SerialArm, ticks: Index, q: Array, stood: Index
) -> list[int]:
    """Ticks at which a station near the robot measures: it has ``stood`` (k,) for so many ticks.

    ``q`` (k, n) joints at ``ticks`` (k,).
    """
    settle, period = round(station.settle_s / TICK_S), round(station.period_s / TICK_S)
    due = np.flatnonzero((stood >= settle) & ((stood - settle) % period == 0))
    return [int(ticks[i]) for i in due if station.near(arm.fk(q[i]))]
