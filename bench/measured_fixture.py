# SPDX-License-Identifier: Apache-2.0
"""A fixture measured by a sensor on the flange of a warm robot: what a session is given."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from robocal_ros.cell_sim.cell import kr150_cell, poses
from robocal_ros.cell_sim.faults import Fault, Faults
from robocal_ros.cell_sim.fixture import FRAME, PLATE, T_FLANGE_SENSOR, FixtureStation
from robocal_ros.cell_sim.robot import Draws, Warmth
from robocal_ros.fixture.features import FixturePoints
from robocal_ros.fixture.judging import FixtureInForce, FixtureLimits, FixtureResult, judge_fixture
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.robots import load_robot

ARM = load_robot("kr150_r3100")
STATION = FixtureStation()
REPEATS = 1e-5  # rad of each joint, as of the cell's robot
LIMITS = FixtureLimits(sigma_m=2.8e-5)  # the sensor's 20 um, and what REPEATS does at 2 m
TAUGHT_VISITS, GAP_VISITS = 3, 2
FEATURES = [feature.name for feature in PLATE.features]


@cache
def fixture_poses() -> Array:
    """Joints (m, 6): each feature from one side, sphere and witnesses from two."""
    q, found = poses("work")[0], []
    for i, name in enumerate(PLATE.places(PLATE.T_base_fixture)):
        turn = np.array([0.35 * np.sin(2.1 * i), 0.35 * np.cos(1.3 * i), 0.9 * np.sin(1.7 * i)])
        twice = name == "S1" or name in PLATE.witnesses
        for turned in (turn, -turn) if twice else (turn,):
            begin, end = ARM.fk(q), STATION.pose(name, tuple(turned.tolist()))
            w = frames.log_rotation(begin[:3, :3].T @ end[:3, :3])
            path = [
                frames.transform(
                    begin[:3, :3] @ frames.exp_rotation(u * w),
                    (1.0 - u) * begin[:3, 3] + u * end[:3, 3],
                )
                for u in np.linspace(0.0, 1.0, 60)
            ]
            q = inverse(ARM, np.array(path), q)[-1]
            found.append(q)
    return np.array(found)


@dataclass
class MeasuredFixture:
    """One robot of the type with its errors, which the arm in use does not have."""

    seed: int

    def __post_init__(self) -> None:
        self.cell = kr150_cell(ARM, self.seed)

    def faults(self, fault: Fault | None = None, size_m: float = 0.0) -> Faults:
        """What is wrong in it."""
        faults = Faults(seed=self.seed)
        if fault is not None:
            faults.sizes[fault] = size_m
        return faults

    def points(
        self,
        faults: Faults,
        visits: int,
        gap: int,
        warm: Warmth | None = None,
        backwards: Sequence[int] = (),
    ) -> FixturePoints:
        """Each pose so many times, from the one before it, the first from home; with backlash.

        Every ``gap`` has noise of its own. ``backwards``: visits, from 0, that come from the pose
        after it instead.
        """
        ring = np.vstack([poses("home")[0], fixture_poses()])
        q, before = np.tile(ring[1:], (visits, 1)), np.tile(np.arange(len(ring) - 1), visits)
        before[[*backwards]] += 2
        before %= len(ring)
        rng, draws = np.random.default_rng([self.seed, gap]), Draws(1000 * gap + self.seed)
        cold, gears = Warmth.cold(ARM.n) if warm is None else warm, self.cell.robot.backlash
        behind = None if gears is None else gears.behind(q - ring[before])
        reading = q + REPEATS * rng.standard_normal(q.shape)
        true = self.cell.robot.flange(reading, cold, behind=behind)
        known = ARM.fk(q)
        shots = [STATION.shoot(T, i, 0.0, faults, draws) for i, T in enumerate(true)]
        p = np.array(
            [
                frames.apply(T @ T_FLANGE_SENSOR, shot.point)
                for T, shot in zip(known, shots, strict=True)
                if shot is not None
            ]
        )
        names = tuple(PLATE.named(one, PLATE.T_base_fixture) for one in p)
        return FixturePoints(names, (FRAME,) * len(p), q, known, p)

    def taught(self, visits: int = TAUGHT_VISITS) -> FixtureInForce:
        """In force, taught by so many visits."""
        points = self.points(self.faults(), visits, 1)
        result = judge_fixture(PLATE, points, ARM, LIMITS, None)
        assert result.verdict.accept, result.verdict
        return result.next_in_force

    def gap(
        self,
        fault: Fault | None = None,
        size_m: float = 0.0,
        warm: Warmth | None = None,
        without: tuple[str, ...] = (),
        number: int = 2,
        visits: tuple[int, int] = (TAUGHT_VISITS, GAP_VISITS),
        backwards: Sequence[int] = (),
    ) -> FixtureResult:
        """What is said in a gap after a fault; ``without``: what was not measured.

        ``visits``: of each pose when it was taught, and in the gap. ``backwards``: see `points`.
        """
        points = self.points(self.faults(fault, size_m), visits[1], number, warm, backwards)
        seen = points.take(np.array([name not in without for name in points.name]))
        return judge_fixture(PLATE, seen, ARM, LIMITS, self.taught(visits[0]))

    def worst_m(self, result: FixtureResult, fault: Fault | None, size_m: float) -> float:
        """Largest error of a feature's place by the new frame, against the truth."""
        places = STATION.fixture.places(PLATE.T_base_fixture)
        at = np.array([places[name] for name in FEATURES])
        T_moved = self.faults(fault, size_m).T_fixture_move(np.mean(at, axis=0))
        away = frames.apply(T_moved, at) - frames.apply(result.change, at)
        return float(np.max(np.linalg.norm(away, axis=1)))
