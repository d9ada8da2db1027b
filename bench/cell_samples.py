# SPDX-License-Identifier: Apache-2.0
"""The simulated cell without a graph: its samples, and a way of its robot through poses."""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.cell_sim.beams import PEAK
from robocal_ros.cell_sim.cell import Happened, station_name
from robocal_ros.cell_sim.faults import Faults
from robocal_ros.cell_sim.fixture import FRAME as FEATURE_FRAME
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.fixture.session import FixturePointSample
from robocal_ros.ground.samples import (
    MEASURED_POINT,
    REFERENCE_SPHERE,
    SPHERE_CLOUD,
    JointSample,
    PointSample,
    TemperatureSample,
)
from robocal_ros.tool.edges import EdgeSample

Array = NDArray[np.float64]

SPIN_RAD = float(np.radians(-135.0))  # of the flange about the laser's z, where the robot measures
Sample = JointSample | PointSample | TemperatureSample | EdgeSample | FixturePointSample


class CellSamples:
    """Makes samples of what happened, with stamps from ``start_ns`` on.

    ``joint_names`` of the arm; ``station`` and ``frame`` of beams and sphere sensor; ``rule``: of
    the sphere in a cloud.
    """

    def __init__(
        self,
        joint_names: tuple[str, ...],
        rule: SphereRule,
        start_ns: int = 1_790_000_000_000_000_000,
        station: str = "station",
        frame: str = "sensor",
    ) -> None:
        self._names, self._rule, self._start_ns = joint_names, rule, start_ns
        self._station, self._frame = station, frame

    def ns(self, time_s: float) -> int:
        """Stamp of a time of the cell."""
        return self._start_ns + round(time_s * 1e9)

    def of(self, came: Happened, faults: Faults) -> list[Sample]:
        """Samples in the order of their stamps; ``faults`` of the cell.

        Raises `TooFewSamplesError` or `ResidualError` when a cloud holds no sphere as the rule
        wants it.
        """
        samples: list[Sample] = [
            JointSample(self.ns(t), self._names, q)
            for t, q in zip(came.time_s.tolist(), came.q, strict=True)
        ]
        station = station_name(self._station, faults)
        samples += [
            EdgeSample(self.ns(e.time_s), station, e.beam, e.blocked, e.sigma_s) for e in came.edges
        ]
        frame = self._frame
        for shot in came.shots:
            at = self.ns(shot.time_s)
            floor = PointSample(at, frame, "floor", shot.floor, REFERENCE_SPHERE)
            if len(shot.points):
                fit = fit_sphere(shot.points.astype(np.float32).astype(np.float64), self._rule)
                sigma_m = float(np.sqrt(np.trace(fit.covariance) / 3.0))
                ball = PointSample(at, frame, "ball", fit.centre, SPHERE_CLOUD, sigma_m)
            else:
                ball = PointSample(at, frame, "ball", shot.centre, MEASURED_POINT)
            samples += [ball, floor]
        samples += [
            FixturePointSample(self.ns(seen.at_s), FEATURE_FRAME, seen.point)
            for seen in came.features
        ]
        for told in came.temperatures:
            at = self.ns(told.time_s)
            samples += [
                TemperatureSample(at, name, celsius)
                for name, celsius in zip(self._names, told.celsius.tolist(), strict=True)
            ]
        return sorted(samples, key=lambda sample: sample.stamp_ns)


SPEED_RAD_S = 1.5  # of the fastest joint at its peak
POSE_REST_S = 0.5
SHORTEST_MOTION_S = 0.5


def programme(
    q_start: ArrayLike, poses: ArrayLike, speed: float = SPEED_RAD_S, rest_s: float = POSE_REST_S
) -> tuple[Array, Array, Array, Array]:
    """Times (k,) from 0, joints, velocities and accelerations (k, n) of a way through poses.

    From ``q_start`` (n,) at rest to each of ``poses`` (m, n) in turn, with a rest at each: what
    `SimulatedCell.follow` takes. ``speed``: of the fastest joint, rad/s
    (prismatic: m/s); ``rest_s`` longer than 0.
    """
    points = np.vstack([np.asarray(q_start)[None], np.asarray(poses)])
    moves = np.maximum(
        PEAK * np.max(np.abs(np.diff(points, axis=0)), axis=1) / speed, SHORTEST_MOTION_S
    )
    depart = np.cumsum(moves + rest_s)
    time = np.column_stack([depart - rest_s, depart]).ravel()
    q = np.repeat(points[1:], 2, axis=0)
    return time, q, np.zeros_like(q), np.zeros_like(q)
