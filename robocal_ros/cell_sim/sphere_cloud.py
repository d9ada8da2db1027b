"""What a 3-D sensor at its frame's origin sees of a sphere: a cap, its stem, and what is behind."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


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
