"""What the simulated cell tells, as the samples that sessions take: the cell in one process."""

from bisect import insort
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.cell_faults import Faults
from robocal_ros.cell_sim.robot import Temperatures
from robocal_ros.cell_sim.stations import ProfileShot, SphereShot
from robocal_ros.estimation.sphere import SphereRule, fit_sphere
from robocal_ros.ground.samples import (
    MEASURED_POINT,
    REFERENCE_SPHERE,
    SPHERE_CLOUD,
    JointSample,
    PointSample,
    TemperatureSample,
)
from robocal_ros.tool.edges import BeamEdge, EdgeSample

# ---- what the simulated cell tells, each at its time --------------------------------------------


Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Happened:
    """What came of a stretch of time; each stamp bears what a fault did to it.

    Attributes
    ----------
    time_s, q, qd : (k,), (k, n), (k, n) joint readings.
    edges : those whose stamp has passed, in its order.
    shots : measurements of the spheres that were told by now.
    profiles : those that were told by now.
    temperatures : of the motors.
    """

    time_s: Array
    q: Array
    qd: Array
    edges: list[BeamEdge]
    shots: list[SphereShot]
    profiles: list[ProfileShot]
    temperatures: list[Temperatures]


@dataclass
class Outbox:
    """What waits until it is told."""

    edges: list[BeamEdge] = field(default_factory=list)
    shots: list[SphereShot] = field(default_factory=list)
    profiles: list[ProfileShot] = field(default_factory=list)
    temperatures: list[Temperatures] = field(default_factory=list)

    def add_edge(self, edge: BeamEdge) -> None:
        """An edge is told when its stamp has passed."""
        insort(self.edges, edge, key=lambda e: e.time_s)

    def told(self, now_s: float, time_s: Array, q: Array, qd: Array) -> Happened:
        """Everything that is told by now, with joint readings."""
        edges = [edge for edge in self.edges if edge.time_s <= now_s]
        shots = [shot for shot in self.shots if shot.told_s <= now_s]
        profiles = [shot for shot in self.profiles if shot.told_s <= now_s]
        del self.edges[: len(edges)], self.shots[: len(shots)], self.profiles[: len(profiles)]
        temperatures, self.temperatures = self.temperatures, []
        return Happened(time_s, q, qd, edges, shots, profiles, temperatures)


# ---- samples that sessions take -----------------------------------------------------------------


Sample = JointSample | PointSample | TemperatureSample | EdgeSample

OTHER_STATION = "_other"


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

        Raises
        ------
        TooFewSamplesError, ResidualError
            When a cloud holds no sphere as the rule wants it.
        """
        samples: list[Sample] = [
            JointSample(self.ns(t), self._names, q)
            for t, q in zip(came.time_s.tolist(), came.q, strict=True)
        ]
        station = station_name(self._station, faults)
        samples += [
            EdgeSample(self.ns(e.time_s), station, e.beam, e.blocked, e.sigma_s) for e in came.edges
        ]
        for shot in came.shots:
            samples += self._spheres(shot)
        for told in came.temperatures:
            at = self.ns(told.time_s)
            samples += [
                TemperatureSample(at, name, celsius)
                for name, celsius in zip(self._names, told.celsius.tolist(), strict=True)
            ]
        return sorted(samples, key=lambda sample: sample.stamp_ns)

    def _spheres(self, shot: SphereShot) -> list[PointSample]:
        at, frame = self.ns(shot.time_s), self._frame
        floor = PointSample(at, frame, "floor", shot.floor, REFERENCE_SPHERE)
        if not len(shot.points):
            return [PointSample(at, frame, "ball", shot.centre, MEASURED_POINT), floor]
        fit = fit_sphere(shot.points.astype(np.float32).astype(np.float64), self._rule)
        sigma_m = float(np.sqrt(np.trace(fit.covariance) / 3.0))
        return [PointSample(at, frame, "ball", fit.centre, SPHERE_CLOUD, sigma_m), floor]


def station_name(name: str, faults: Faults) -> str:
    """The station that the edges claim to come from."""
    return name + OTHER_STATION * ("wrong_station" in faults)
