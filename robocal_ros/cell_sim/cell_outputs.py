"""What the simulated cell tells, each at its time."""

from bisect import insort
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.heating import Temperatures
from robocal_ros.cell_sim.profile_station import ProfileShot
from robocal_ros.cell_sim.sphere_station import SphereShot
from robocal_ros.tool.edges import BeamEdge

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
