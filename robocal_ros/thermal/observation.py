"""One measured target with its joints, and many of them as arrays."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.samples import Measurements, PointSample, PoseSample

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Observation:
    """A measured target with the joints at that instant.

    ``ready_ns``: stamp of the joint reading that completed it; ``rotation`` None for a point.
    """

    stamp_ns: int
    ready_ns: int
    topic: str
    frame: str
    target: str
    q: Array
    position: Array
    rotation: Array | None
    source: PointSample | PoseSample

    @property
    def sigma_m(self) -> float:
        """Standard deviation of a coordinate from the measurement itself; 0 where not known."""
        return self.source.sigma_m if isinstance(self.source, PointSample) else 0.0


def one_per_visit(observations: Sequence[Observation], same_rad: float) -> list[Observation]:
    """Average what was measured of a target while the robot stood at one posture.

    However often it was measured there, a visit shows the robot's repeatability once.
    ``observations`` in order of their stamps; ``same_rad``: joints that move less stand still.
    """
    visits: list[dict[str, list[Observation]]] = []
    first: Observation | None = None
    for one in observations:
        if first is None or np.max(np.abs(one.q - first.q)) > same_rad:
            first = one
            visits.append({})
        visits[-1].setdefault(one.target, []).append(one)
    return [_averaged(several) for visit in visits for several in visit.values()]


def _averaged(several: Sequence[Observation]) -> Observation:
    last = several[-1]
    if len(several) == 1:
        return last
    position = np.mean([o.position for o in several], axis=0)
    sigma_m = float(np.sqrt(np.mean([o.sigma_m**2 for o in several]) / len(several)))
    return replace(
        last,
        q=np.mean([o.q for o in several], axis=0),
        position=position,
        source=PointSample(last.stamp_ns, last.frame, last.target, position, last.topic, sigma_m),
    )


def as_measurements(
    observations: Sequence[Observation], sigma_m: float | None = None
) -> Measurements:
    """Arrays of observations; orientations only where all have one.

    ``sigma_m``: standard deviation of a coordinate of one visit, to which each measurement's own
    is added; None where the noise is to be found.
    """
    rotations = [o.rotation for o in observations if o.rotation is not None]
    complete = bool(observations) and len(rotations) == len(observations)
    several = len({o.target for o in observations}) > 1
    return Measurements(
        q=np.array([o.q for o in observations]),
        position=np.array([o.position for o in observations]),
        target=tuple(o.target for o in observations),
        sample=tuple(
            f"{o.stamp_ns}/{o.target}" if several else str(o.stamp_ns) for o in observations
        ),
        rotation=np.array(rotations) if complete else None,
        sigma=None if sigma_m is None else np.hypot(sigma_m, [o.sigma_m for o in observations]),
        stamp_ns=np.array([o.stamp_ns for o in observations], dtype=np.int64),
    )
