# SPDX-License-Identifier: Apache-2.0
"""A fixture in the simulated cell, and the sensor on the flange that finds its features.

The plate is plausible, none measured: 3-2-1 of planes, two holes, an edge and a sphere; beside it
two spheres on posts that are fixed to the floor. What a scan makes of a feature comes as one point
of it, in the sensor: somewhere on a plane or along an edge or a hole's axis, as wherever the scan
went. The points scatter as the makers' figures for such sensors (`cell_sim.sensors`).
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from robocal_ros.cell_sim.faults import Faults
from robocal_ros.cell_sim.robot import Draws, Stream
from robocal_ros.fixture.features import PLANE, Feature, Fixture
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array

FRAME = "feature_sensor"
NOISE_M = 2e-5  # of a coordinate
ASIDE_M = 2e-3  # by which a scan misses a feature's place where that says nothing
VIEW_M = 0.03  # half width of the field
NEAR_M, FAR_M = 0.20, 0.30
T_FLANGE_SENSOR = frames.transform(frames.exp_rotation([0.05, -0.03, 0.0]), [-0.12, 0.02, 0.10])
_UP, _ALONG, _ACROSS = np.eye(3)[[2, 0, 1]]
PLATE = Fixture(
    "plate",
    frames.transform(frames.exp_rotation([0.01, -0.02, 0.3]), [1.45, 0.25, 0.45]),
    (
        *(
            Feature(f"A{i}", "plane", np.array(at), _UP)
            for i, at in enumerate([[0.05, 0.05, 0.08], [0.35, 0.05, 0.08], [0.2, 0.25, 0.08]], 1)
        ),
        *(
            Feature(f"B{i}", "plane", np.array(at), -_ACROSS)
            for i, at in enumerate([[0.1, 0.0, 0.05], [0.3, 0.0, 0.05]], 1)
        ),
        Feature("C1", "plane", np.array([0.0, 0.15, 0.05]), -_ALONG),
        Feature("H1", "hole", np.array([0.1, 0.15, 0.08]), _UP),
        Feature("H2", "hole", np.array([0.3, 0.15, 0.08]), _UP),
        Feature("E1", "edge", np.array([0.4, 0.15, 0.08]), _ACROSS),
        Feature("S1", "sphere", np.array([0.2, 0.12, 0.12])),
    ),
    {"post left": np.array([1.25, 0.35, 0.55]), "post right": np.array([1.95, 0.30, 0.55])},
)


@dataclass(frozen=True)
class FeatureShot:
    """A feature's point (3,), m, in the sensor, seen at ``at_s``."""

    at_s: float
    point: Array


def along(feature: Feature, aside: Array) -> Array:
    """What of ``aside`` (3,) stays on a feature: in a plane, along an edge or an axis, no other.

    By its shape alone: what the estimator reads of it (`Feature.components`) is what is tried.
    """
    if feature.direction is None:
        return np.zeros(3)
    n = feature.direction / np.linalg.norm(feature.direction)
    lengthwise = n * (n @ aside)
    return np.asarray(aside - lengthwise if feature.kind == PLANE else lengthwise)


@dataclass(frozen=True, eq=False)
class FixtureStation:
    """A fixture, and the sensor on the flange that looks at it when the robot stands still.

    ``settle_s``, ``period_s``: rest before the first measurement, and between two of them.
    """

    fixture: Fixture = PLATE
    noise_m: float = NOISE_M
    settle_s: float = 0.5
    period_s: float = 1.0

    def near(self, T_base_flange: Array) -> bool:
        """Whether something may be in the field at a flange pose (4, 4) known to centimetres."""
        at = frames.apply(T_base_flange @ T_FLANGE_SENSOR, np.array([0.0, 0.0, FAR_M]))
        return bool(np.min(np.linalg.norm(self._places[1] - at, axis=1)) < FAR_M)

    @cached_property
    def _places(self) -> tuple[tuple[str, ...], Array]:
        places = self.fixture.places(self.fixture.T_base_fixture)
        return tuple(places), np.array(list(places.values()))

    def pose(self, name: str, turned: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
        """T_base_flange (4, 4) with a feature or witness in the middle of the field, from above.

        ``turned``: the sensor about its own axes, rad.
        """
        at = self.fixture.places(self.fixture.T_base_fixture)[name]
        down = frames.exp_rotation([np.pi, 0.0, 0.0]) @ frames.exp_rotation(turned)
        back = frames.transform(np.eye(3), [0.0, 0.0, -0.5 * (NEAR_M + FAR_M)])
        return frames.transform(down, at) @ back @ frames.invert(T_FLANGE_SENSOR)

    def shoot(
        self, T_base_flange: Array, tick: int, at_s: float, faults: Faults, draws: Draws
    ) -> FeatureShot | None:
        """What the sensor makes of the feature that is most in its middle.

        None without one, and where the message is lost.

        ``T_base_flange`` (4, 4): true.
        """
        if draws.of(Stream.LOST_SHOTS, tick).random() < faults.size("lost_messages"):
            return None
        names, places = self._places
        fixture = self.fixture
        T_moved = faults.T_fixture_move(np.mean(places[: len(fixture.features)], axis=0))
        there = places.copy()
        there[: len(fixture.features)] = frames.apply(T_moved, places[: len(fixture.features)])
        T_sensor_base = faults.T_sensor_knock @ frames.invert(T_base_flange @ T_FLANGE_SENSOR)
        seen = frames.apply(T_sensor_base, there)
        aside = np.max(np.abs(seen[:, :2]), axis=1)
        shown = (aside < VIEW_M) & (seen[:, 2] > NEAR_M) & (seen[:, 2] < FAR_M)
        if not np.any(shown):
            return None
        best = int(np.argmin(np.where(shown, aside, np.inf)))
        rng = draws.of(Stream.FEATURES, tick)
        feature = fixture.by_name.get(names[best])
        point = there[best]
        if feature is not None:
            R = T_moved[:3, :3] @ fixture.T_base_fixture[:3, :3]
            point = point + R @ along(feature, rng.uniform(-ASIDE_M, ASIDE_M, 3))
        told = frames.apply(T_sensor_base, point) + self.noise_m * rng.standard_normal(3)
        return FeatureShot(at_s, told)
