# SPDX-License-Identifier: Apache-2.0
"""What measures in the simulated cell: line laser, sphere sensor and floor sphere; when it stands.

The light leaves its frame's origin within the plane y = 0, around z. The camera sits on the y
axis; a point is seen when light falls on it, not too flat, and nothing stands before the camera.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.faults import BALL_KNOCK, Faults
from robocal_ros.cell_sim.robot import Draws, Effects, Stream
from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.kinematics import SerialArm
from robocal_ros.thermal.cell_setup import SensorField

AWAY_M = 1e-9  # a ray does not meet the surface on which it begins
TABLE_M = 2.0
STEEPEST = 10.0  # of a surface that the spot is a mean of; beyond, it ends there


class ScannedBody(Protocol):
    """Anything that a ray meets."""

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """Where rays (n, 3) with unit directions (n, 3) first meet it.

        Returns the distances (n,), infinite for those that miss, and the outward unit normals
        (n, 3) there, any for those.
        """


@dataclass(frozen=True, eq=False)
class Ball:
    """A sphere; centre (3,)."""

    centre: Array
    radius_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        away = origin - self.centre
        distance = _first_root(
            np.ones(len(away)),
            np.sum(away * direction, axis=1),
            np.sum(away**2, axis=1) - self.radius_m**2,
        )
        return distance, _at(away, direction, distance) / self.radius_m


@dataclass(frozen=True, eq=False)
class Stem:
    """The side of a round bar from ``start`` (3,) along the unit vector ``axis`` (3,)."""

    start: Array
    axis: Array
    radius_m: float
    length_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        away = origin - self.start
        across = away - np.outer(away @ self.axis, self.axis)
        slant = direction - np.outer(direction @ self.axis, self.axis)
        distance = _first_root(
            np.sum(slant**2, axis=1),
            np.sum(across * slant, axis=1),
            np.sum(across**2, axis=1) - self.radius_m**2,
        )
        along = _at(away, direction, distance) @ self.axis
        distance = np.where((along >= 0.0) & (along <= self.length_m), distance, np.inf)
        return distance, _at(across, slant, distance) / self.radius_m


@dataclass(frozen=True, eq=False)
class Prism:
    """A body of one cross-section.

    ``T_base_user`` (4, 4): its frame.
    ``outline`` (k, 2): corners y, z of the cross-section, once around.
    ``length_m``: it reaches from x = 0 to there.
    """

    T_base_user: Array
    outline: Array
    length_m: float

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """See `ScannedBody`."""
        R, t = self.T_base_user[:3, :3], self.T_base_user[:3, 3]
        p, d = (origin - t) @ R, direction @ R
        found = []
        y, z = self.outline.T
        turn = np.sign(float(np.sum(y * np.roll(z, -1) - np.roll(y, -1) * z)))  # of its signed area
        for a, b in zip(self.outline, np.roll(self.outline, -1, axis=0), strict=True):
            side = b - a
            outward = turn * np.array([0.0, side[1], -side[0]]) / np.linalg.norm(side)
            distance = _plane(p, d, outward, np.array([0.0, *a]))
            x, y, z = _at(p, d, distance).T
            share = ((y - a[0]) * side[0] + (z - a[1]) * side[1]) / (side @ side)
            inside = (x >= 0.0) & (x <= self.length_m) & (share >= 0.0) & (share <= 1.0)
            found.append((np.where(inside, distance, np.inf), outward))
        for end, sign in ((0.0, -1.0), (self.length_m, 1.0)):
            outward = np.array([sign, 0.0, 0.0])
            distance = _plane(p, d, outward, np.array([end, 0.0, 0.0]))
            inside = _inside(self.outline, _at(p, d, distance)[:, 1:])
            found.append((np.where(inside, distance, np.inf), outward))
        best, normal = np.full(len(p), np.inf), np.zeros_like(p)
        for distance, outward in found:
            nearer = distance < best
            best = np.where(nearer, distance, best)
            normal[nearer] = outward
        return best, normal @ R.T


@dataclass(frozen=True)
class Scene:
    """Bodies that stand still together."""

    bodies: Sequence[ScannedBody]

    def meet(self, origin: Array, direction: Array) -> tuple[Array, Array]:
        """The first of all bodies that a ray meets; see `ScannedBody`."""
        best, normal = np.full(len(origin), np.inf), np.zeros_like(origin)
        for body in self.bodies:
            distance, outward = body.meet(origin, direction)
            nearer = distance < best
            best = np.where(nearer, distance, best)
            normal[nearer] = outward[nearer]
        return best, normal


def ball_on_table(centre: ArrayLike, radius_m: float, height_m: float = 0.08) -> Scene:
    """A ball on a stem of a quarter of its diameter, its centre ``height_m`` above a table."""
    c = np.asarray(centre, dtype=np.float64)
    foot = c - [0.0, 0.0, height_m]
    stem = Stem(foot, np.array([0.0, 0.0, 1.0]), 0.25 * radius_m, height_m)
    return Scene((Ball(c, radius_m), stem, table(foot)))


def table(place: ArrayLike) -> Prism:
    """A level table top around ``place`` (3,)."""
    half = 0.5 * TABLE_M
    T = np.eye(4)
    T[:3, 3] = np.asarray(place) - [half, 0.0, 0.0]
    return Prism(T, np.array([[-half, -0.05], [half, -0.05], [half, 0.0], [-half, 0.0]]), TABLE_M)


def stairs(
    T_base_user: Array, steps: int, length_m: float, height_m: float, depth_m: float
) -> Prism:
    """Steps cut from one block; they rise along y, x runs along the lowest front edge."""
    outline = [[0.0, 0.0]]
    for i in range(steps):
        outline += [[i * depth_m, (i + 1) * height_m], [(i + 1) * depth_m, (i + 1) * height_m]]
    return Prism(T_base_user, np.array([*outline, [steps * depth_m, 0.0]]), length_m)


def block(T_base_user: Array, length_m: float, width_m: float, height_m: float) -> Prism:
    """A block from the origin along x, y and down z: x is one of its upper edges."""
    outline = np.array([[0.0, 0.0], [0.0, -height_m], [width_m, -height_m], [width_m, 0.0]])
    return Prism(T_base_user, outline, length_m)


def grooved_block(
    T_base_user: Array, length_m: float, half_width_m: float, groove_m: float, depth_m: float
) -> Prism:
    """A block with a V-groove ``groove_m`` wide: x runs along its bottom, z up out of it."""
    w, g, bottom = half_width_m, 0.5 * groove_m, -depth_m
    yz = [[0.0, 0.0], [-g, depth_m], [-w, depth_m], [-w, bottom], [w, bottom], [w, depth_m]]
    return Prism(T_base_user, np.array([*yz, [g, depth_m]]), length_m)


def _at(origin: Array, direction: Array, distance: Array) -> Array:
    """Points (n, 3) on the rays; those that miss are put at the origin of their ray."""
    return np.asarray(origin + np.where(np.isfinite(distance), distance, 0.0)[:, None] * direction)


def _first_root(a: Array, b: Array, c: Array) -> Array:
    """Smallest root beyond ``AWAY_M`` of ``a t^2 + 2 b t + c = 0``, infinite without one."""
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.sqrt(b**2 - a * c)
        near, far = (-b - half) / a, (-b + half) / a
        t = np.where(near > AWAY_M, near, far)
        return np.where(t > AWAY_M, t, np.inf)  # not-a-number compares as false


def _plane(p: Array, d: Array, normal: Array, point: Array) -> Array:
    """Distances (n,) to a plane, infinite where it is behind the ray or beside it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        t = ((point - p) @ normal) / (d @ normal)
    return np.where(np.isfinite(t) & (t > AWAY_M), t, np.inf)


def _inside(outline: Array, points: Array) -> NDArray[np.bool_]:
    """Whether points (n, 2) are in a polygon, by the parity of a ray's crossings."""
    odd = np.zeros(len(points), dtype=bool)
    y, z = points.T
    for a, b in zip(outline, np.roll(outline, -1, axis=0), strict=True):
        if a[1] != b[1]:
            crosses = (a[1] > z) != (b[1] > z)
            odd ^= crosses & (y < a[0] + (z - a[1]) * (b[0] - a[0]) / (b[1] - a[1]))
    return odd


@dataclass(frozen=True)
class ProfileSensor:
    """A sensor; it errs as real ones do unless it is told not to (`ProfileSensor.exact`).

    The errors are those measured on the profiles of others (docs/simulation.md).

    ``columns``: of a profile, at equal steps of x / z.
    ``near_m``, ``far_m``: measuring range along z.
    ``half_angle_rad``: of the fan.
    ``baseline_m``: y of the camera.
    ``flattest_rad``: angle from the surface's normal, of light or view, beyond which nothing is
    seen.
    ``noise_m``: standard deviation of z.
    ``spot_m``: width over which a column sees a mean: edges have their tops rounded.
    ``horns``: how far the sensor sharpens that again; beside a top then stand two others.
    ``towards``: whether z is told as a height over the middle of the range, not as a distance; the
    sensor's frame is there then, turned about x.
    ``linearity_m``: amplitudes of a smooth error of z over the field, m: of second degree across
    it, of the product, and of second degree along the beam; as real sensors have it.
    ``ends``: columns at both ends of what is seen in a row that are off by up to ``spike_m``.
    ``quantum_m``: step of z; 0 without.
    ``spikes``, ``spike_m``: share of speckled columns, and how far at most they are off along z.
    ``dropouts``: share of columns without a return.
    ``gaps``, ``gap_columns``: number of longer gaps in a profile, and their width.
    ``ghosts``: share of columns where, given a second surface to mirror the light to, the camera
    takes the mirrored spot for the direct one.
    """

    columns: int = 1280
    near_m: float = 0.190
    far_m: float = 0.210
    half_angle_rad: float = float(np.radians(14.0))
    baseline_m: float = 0.09
    flattest_rad: float = float(np.radians(80.0))
    noise_m: float = 1.5e-5
    spot_m: float = 4e-4
    horns: float = 0.5
    towards: bool = True
    linearity_m: tuple[float, float, float] = (2e-5, -1e-5, 2e-5)
    ends: int = 2
    quantum_m: float = 0.0
    spikes: float = 0.003
    spike_m: float = 2e-3
    dropouts: float = 0.02
    gaps: int = 0
    gap_columns: int = 25
    ghosts: float = 0.0

    @classmethod
    def exact(cls, **changes: Any) -> "ProfileSensor":
        """One without errors, but for these ``changes``; z is a distance."""
        none: dict[str, Any] = dict.fromkeys(
            ("noise_m", "spot_m", "horns", "spikes", "dropouts"), 0.0
        )
        none |= {"towards": False, "linearity_m": (0.0, 0.0, 0.0), "ends": 0}
        return cls(**(none | changes))

    @property
    def T_light_sensor(self) -> Array:
        """The frame (4, 4) in which profiles are told, where the light has its own."""
        if not self.towards:
            return np.eye(4)
        T = np.diag([1.0, -1.0, -1.0, 1.0])
        T[2, 3] = 0.5 * (self.near_m + self.far_m)
        return T

    def shoot(self, T_base_light: Array, scene: Scene, rng: np.random.Generator) -> Array:
        """A profile (columns, 2): x, z, m, sensor frame; not-a-number where nothing returns."""
        u = np.linspace(-1.0, 1.0, self.columns) * np.tan(self.half_angle_rad)
        R, origin = T_base_light[:3, :3], np.tile(T_base_light[:3, 3], (self.columns, 1))
        rays = np.column_stack([u, np.zeros_like(u), np.ones_like(u)])
        rays = (rays / np.linalg.norm(rays, axis=1)[:, None]) @ R.T
        camera = T_base_light[:3, 3] + self.baseline_m * R[:, 1]
        distance, normal = scene.meet(origin, rays)
        lit = np.isfinite(distance)
        spot = origin + np.where(lit, distance, 0.0)[:, None] * rays
        seen = lit & self._faces(normal, -rays) & self._shown(scene, spot, normal, camera)
        xz = ((spot - origin) @ R)[:, ::2]
        xz[~seen] = np.nan
        if self.ghosts > 0.0:
            # Where mirrored light falls and the camera sees it.
            back = rays - 2.0 * np.sum(rays * normal, axis=1)[:, None] * normal
            distance, outward = scene.meet(spot, back)
            met = np.isfinite(distance)
            second = spot + np.where(met, distance, 0.0)[:, None] * back
            second[~(met & self._shown(scene, second, outward, camera))] = np.nan
            ghost = (second - camera) @ R
            with np.errstate(divide="ignore", invalid="ignore"):
                share = -self.baseline_m / ghost[:, 1]
            there = (share[:, None] * ghost)[:, ::2]
            taken = lit & np.isfinite(share) & (rng.random(self.columns) < self.ghosts)
            xz[taken] = there[taken]
        n = self.columns
        xz = self._spotted(xz)
        xz[:, 1] += self.noise_m * rng.standard_normal(n) + self._nonlinear(xz)
        if self.ends:
            near = np.convolve(np.isnan(xz[:, 1]), np.ones(2 * self.ends + 1), "same") > 0.0
            near[[0, -1]] = True
            xz[:, 1] += np.where(near, rng.uniform(-self.spike_m, self.spike_m, n), 0.0)
        speckled = rng.random(n) < self.spikes
        xz[:, 1] += np.where(speckled, rng.uniform(-self.spike_m, self.spike_m, n), 0.0)
        if self.quantum_m > 0.0:
            xz[:, 1] = np.round(xz[:, 1] / self.quantum_m) * self.quantum_m
        lost = rng.random(n) < self.dropouts
        for start in rng.integers(0, n, self.gaps):
            lost[start : start + self.gap_columns] = True
        with np.errstate(invalid="ignore"):
            out = ~((xz[:, 1] >= self.near_m) & (xz[:, 1] <= self.far_m))
        xz[lost | out] = np.nan
        if self.towards:
            xz[:, 1] = 0.5 * (self.near_m + self.far_m) - xz[:, 1]
        return np.asarray(xz)

    def _spotted(self, xz: Array) -> Array:
        """Points (n, 2) as means over the spot, of a surface that goes on without a jump."""
        pitch = 2.0 * self.far_m * np.tan(self.half_angle_rad) / self.columns
        half = round(0.5 * self.spot_m / pitch)
        if half == 0:
            return xz
        with np.errstate(invalid="ignore"):
            goes_on = np.abs(np.diff(xz[:, 1])) < STEEPEST * pitch  # not-a-number does not
        number = np.concatenate([[0], np.cumsum(~goes_on)])
        first = np.searchsorted(number, number)
        last = np.searchsorted(number, number, side="right") - 1
        row = np.arange(len(xz))
        sums = np.vstack([np.zeros(2), np.cumsum(np.nan_to_num(xz), axis=0)])

        def mean(half: int) -> Array:
            k = np.minimum(half, np.minimum(row - first, last - row))
            return np.asarray((sums[row + k + 1] - sums[row - k]) / (2 * k + 1)[:, None])

        told = (1.0 + self.horns) * mean(half) - self.horns * mean(2 * half)
        return np.where(np.isnan(xz), np.nan, told)

    def _nonlinear(self, xz: Array) -> Array:
        """Error of z (n,) of points (n, 2), m."""
        middle, half = 0.5 * (self.near_m + self.far_m), 0.5 * (self.far_m - self.near_m)
        u = xz[:, 0] / (self.far_m * np.tan(self.half_angle_rad))
        w = (xz[:, 1] - middle) / half
        shapes = [0.5 * (3.0 * u**2 - 1.0), u * w, 0.5 * (3.0 * w**2 - 1.0)]
        return np.asarray(np.array(self.linearity_m) @ shapes)

    def _faces(self, normal: Array, toward: Array) -> Mask:
        return np.asarray(np.sum(normal * toward, axis=1) > np.cos(self.flattest_rad))

    def _shown(self, scene: Scene, spot: Array, normal: Array, camera: Array) -> Mask:
        """Whether the camera has a free view of spots (n, 3)."""
        way = camera - spot
        length = np.linalg.norm(way, axis=1)
        way /= length[:, None]
        blocked = scene.meet(spot, way)[0] < length
        return np.asarray(self._faces(normal, way) & ~blocked)


STEM_EXPANSION_PER_K = 12e-6  # steel


@dataclass(frozen=True, eq=False)
class SphereSensor:
    """A sensor with its errors.

    ``T_sensor_base`` (4, 4): where it stands.
    ``ball`` (3,): sphere centre in the flange frame, cold, m; the stem leads there from the
    flange's centre.
    ``noise``: standard deviation of each coordinate, m.
    ``warm_up`` (3,): drift of a warm sensor in its own frame, m, reached with ``warm_up_tau_s``.
    ``outlier_share``, ``outlier_size``: how often something else is measured, and how far off it
    is, m.
    """

    T_sensor_base: Array
    ball: Array
    noise: float = 2e-5
    warm_up: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1e-5]))
    warm_up_tau_s: float = 1800.0
    outlier_share: float = 0.01
    outlier_size: float = 1e-3
    effects: Effects = field(default_factory=Effects)

    def measure(
        self,
        T_base_flange: Array,
        flange_rise: float,
        since_start_s: float,
        rng: np.random.Generator,
    ) -> Array:
        """Measured centre (3,) in the sensor frame, m.

        ``T_base_flange`` (4, 4): true pose of the flange.
        ``flange_rise``: of the flange's temperature, K.
        ``since_start_s``: time since the cold sensor was switched on.
        """
        T = self.T_sensor_base @ T_base_flange
        ball = self.ball
        if self.effects.stem:
            ball = np.asarray(ball * (1.0 + STEM_EXPANSION_PER_K * flange_rise))
        p = T[:3, :3] @ ball + T[:3, 3]
        # Drawn whether used or not: switching one effect off leaves the others' draws alone.
        noise, direction, chance = rng.standard_normal(3), rng.standard_normal(3), rng.random()
        if self.effects.sensor_warm_up:
            p = p + self.warm_up * (1.0 - np.exp(-since_start_s / self.warm_up_tau_s))
        if self.effects.noise:
            p = p + self.noise * noise
        if self.effects.outliers and chance < self.outlier_share:
            p = p + self.outlier_size * direction / np.linalg.norm(direction)
        return np.asarray(p)


@dataclass(frozen=True)
class CloudScene:
    """How the sphere is seen.

    ``radius_m``, ``noise_m``: true radius, and scatter of the points along the normal.
    ``half_angle_rad``: of the cone of normals that the sensor still resolves.
    ``stem``, ``background``, ``spikes``: shares of the points that are not the sphere's.
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


CLEAR_RAD = float(np.radians(60.0))  # between the stem and the view, else the stem hides the sphere
SPHERE_ROOM = 1.3  # the field's corners are farther than its middle


@dataclass(frozen=True, eq=False)
class SphereStation:
    """The sensor, its field and its pace.

    ``floor`` (3,): centre of the sphere on the floor, in the sensor's frame, m.
    ``floor_sigma_m``: scatter of its measured centre, a mean of some readings.
    ``points``: of a cloud; 0: none, the centre alone is told.
    ``settle_s``, ``period_s``: rest before the first measurement, and between two of them.
    ``delay_s``: from a measurement to when it is told.
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
        shift = faults.size("sphere_knocked") * BALL_KNOCK
        sensor = replace(self.sensor, ball=self.sensor.ball + shift)
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

    ``time_s``, ``told_s``: its stamp, and when it is told.
    ``centre``, ``floor``: (3,) of the sphere on the flange and of the one on the floor.
    ``points`` (count, 3): of the first one's cloud; none where the station gives no clouds.
    """

    time_s: float
    told_s: float
    centre: Array
    floor: Array
    points: Array


TARGET_ROOM = 2.0  # a target further away than this many times the range is not looked at


@dataclass(frozen=True, eq=False)
class ProfileStation:
    """The sensor and its pace.

    ``T_flange_light`` (4, 4): where its light truly leaves.
    ``target`` (3,): about where the scene is, base, m.
    ``settle_s``, ``period_s``: rest before the first profile, and between two of them.
    ``delay_s``: from a profile to when it is told.
    """

    sensor: ProfileSensor
    T_flange_light: Array
    scene: Scene
    target: Array
    settle_s: float = 0.5
    period_s: float = 1.0
    delay_s: float = 0.04

    def near(self, T_base_flange: Array) -> bool:
        """Whether the target may be in range at a flange pose (4, 4) known to centimetres."""
        away = (T_base_flange @ self.T_flange_light)[:3, 3] - self.target
        return bool(np.linalg.norm(away) < TARGET_ROOM * self.sensor.far_m)

    def shoot(
        self, T_base_flange: Array, tick: int, time_s: float, draws: Draws
    ) -> "ProfileShot | None":
        """A profile; None where nothing returns."""
        rng = draws.of(Stream.PROFILES, tick)
        points = self.sensor.shoot(T_base_flange @ self.T_flange_light, self.scene, rng)
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


class MeasuresAtRest(Protocol):
    """A station that measures when the robot rests."""

    @property
    def settle_s(self) -> float:
        """Rest before the first measurement."""

    @property
    def period_s(self) -> float:
        """Between two of them."""

    def near(self, T_base_flange: Array) -> bool:
        """Whether it may see something at a flange pose (4, 4) known to centimetres."""


def standstills(
    station: MeasuresAtRest, arm: SerialArm, ticks: Index, q: Array, stood: Index
) -> list[int]:
    """Ticks at which a station near the robot measures: it has ``stood`` (k,) for so many ticks.

    ``q`` (k, n) joints at ``ticks`` (k,).
    """
    settle, period = round(station.settle_s / TICK_S), round(station.period_s / TICK_S)
    due = np.flatnonzero((stood >= settle) & ((stood - settle) % period == 0))
    return [int(ticks[i]) for i in due if station.near(arm.fk(q[i]))]
