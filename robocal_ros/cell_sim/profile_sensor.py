"""A simulated line-laser sensor: a fan of light, a camera beside its plane, and what goes wrong.

The light leaves the sensor's origin within the plane y = 0, around z. The camera sits on the y
axis; a point is seen when light falls on it, not too flat, and nothing stands before the camera.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.profile_targets import Scene

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class ProfileSensor:
    """A sensor.

    Attributes
    ----------
    columns : of a profile, at equal steps of x / z.
    near_m, far_m : measuring range along z.
    half_angle_rad : of the fan.
    baseline_m : y of the camera.
    flattest_rad : angle from the surface's normal, of light or view, beyond which nothing is seen.
    noise_m : standard deviation of z.
    quantum_m : step of z; 0 without.
    spikes, spike_m : share of speckled columns, and how far at most they are off along z.
    dropouts : share of columns without a return.
    gaps, gap_columns : number of longer gaps in a profile, and their width.
    ghosts : share of columns where, given a second surface to mirror the light to, the camera
        takes the mirrored spot for the direct one.
    """

    columns: int = 1280
    near_m: float = 0.190
    far_m: float = 0.210
    half_angle_rad: float = float(np.radians(14.0))
    baseline_m: float = 0.09
    flattest_rad: float = float(np.radians(80.0))
    noise_m: float = 3.7e-5
    quantum_m: float = 0.0
    spikes: float = 0.0
    spike_m: float = 2e-3
    dropouts: float = 0.0
    gaps: int = 0
    gap_columns: int = 25
    ghosts: float = 0.0

    def shoot(self, T_base_sensor: Array, scene: Scene, rng: np.random.Generator) -> Array:
        """A profile (columns, 2): x, z, m, sensor frame; not-a-number where nothing returns."""
        u = np.linspace(-1.0, 1.0, self.columns) * np.tan(self.half_angle_rad)
        R, origin = T_base_sensor[:3, :3], np.tile(T_base_sensor[:3, 3], (self.columns, 1))
        rays = np.column_stack([u, np.zeros_like(u), np.ones_like(u)])
        rays = (rays / np.linalg.norm(rays, axis=1)[:, None]) @ R.T
        camera = T_base_sensor[:3, 3] + self.baseline_m * R[:, 1]
        distance, normal = scene.meet(origin, rays)
        lit = np.isfinite(distance)
        spot = origin + np.where(lit, distance, 0.0)[:, None] * rays
        seen = lit & self._faces(normal, -rays) & self._shown(scene, spot, normal, camera)
        xz = ((spot - origin) @ R)[:, ::2]
        xz[~seen] = np.nan
        if self.ghosts > 0.0:
            second = self._mirrored(scene, spot, rays, normal, camera)
            ghost = (second - camera) @ R
            with np.errstate(divide="ignore", invalid="ignore"):
                share = -self.baseline_m / ghost[:, 1]
            there = (share[:, None] * ghost)[:, ::2]
            taken = lit & np.isfinite(share) & (rng.random(self.columns) < self.ghosts)
            xz[taken] = there[taken]
        return self._disturbed(xz, rng)

    def _faces(self, normal: Array, toward: Array) -> Mask:
        return np.asarray(np.sum(normal * toward, axis=1) > np.cos(self.flattest_rad))

    def _shown(self, scene: Scene, spot: Array, normal: Array, camera: Array) -> Mask:
        """Whether the camera has a free view of spots (n, 3)."""
        way = camera - spot
        length = np.linalg.norm(way, axis=1)
        way /= length[:, None]
        blocked = scene.meet(spot, way)[0] < length
        return np.asarray(self._faces(normal, way) & ~blocked)

    def _mirrored(
        self, scene: Scene, spot: Array, rays: Array, normal: Array, camera: Array
    ) -> Array:
        """Where (n, 3) mirrored light falls and the camera sees it; else not-a-number."""
        back = rays - 2.0 * np.sum(rays * normal, axis=1)[:, None] * normal
        distance, outward = scene.meet(spot, back)
        met = np.isfinite(distance)
        second = spot + np.where(met, distance, 0.0)[:, None] * back
        second[~(met & self._shown(scene, second, outward, camera))] = np.nan
        return np.asarray(second)

    def _disturbed(self, xz: Array, rng: np.random.Generator) -> Array:
        n = self.columns
        xz[:, 1] += self.noise_m * rng.standard_normal(n)
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
        return xz
