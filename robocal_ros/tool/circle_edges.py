"""A circle through two crossed beams, and what each of its edges means.

In the laser frame the tool's axis is at ``c + R (cos theta, sin theta)``; its signed distance from
beam b is ``s_b = d_b + R sin(psi_b)`` with psi_x = theta and psi_y = beta - theta.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.tool.beam_edges import BEAMS, BeamEdge, edges_of

Array = NDArray[np.float64]

FEWEST_EDGES = 4  # of each beam: two shadows


@dataclass(frozen=True)
class CircleMotion:
    """The commanded circle.

    Attributes
    ----------
    radius_m, period_s : of the flange's circle.
    start_rad : where the flange stands at time 0, counter-clockwise from the laser's x.
    direction : +1 counter-clockwise seen from above, -1 clockwise.
    beam_angle_rad : beta, from the x- to the y-beam.
    """

    radius_m: float
    period_s: float
    start_rad: float = 0.0
    direction: int = 1
    beam_angle_rad: float = float(np.pi / 2.0)

    def __post_init__(self) -> None:
        if not (self.radius_m > 0.0 and self.period_s > 0.0 and self.direction in (1, -1)):
            raise ValueError("radius and period must be positive, direction +1 or -1")

    @property
    def rate_rad_s(self) -> float:
        """Signed angular speed."""
        return self.direction * 2.0 * float(np.pi) / self.period_s

    def psi(self, theta: Array, beam: int) -> Array:
        """Angle psi of a beam (its own inverse)."""
        return theta if beam == 0 else self.beam_angle_rad - theta

    def psi_rate(self, beam: int) -> float:
        """Sign of the speed at which psi of a beam changes."""
        return float(self.direction if beam == 0 else -self.direction)

    def centre(self, d: Array) -> Array:
        """Centre (2,), laser frame, m, from the distances d_x, d_y (thesis eq. 4-29)."""
        return self.centre_jacobian @ d

    @property
    def centre_jacobian(self) -> Array:
        """(2, 2) derivative of the centre by d_x and d_y."""
        beta = self.beam_angle_rad
        return np.array([[1.0 / np.tan(beta), 1.0 / np.sin(beta)], [1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class CircleEdges:
    """Edges of one circle with what each one means.

    Attributes
    ----------
    beam : (m,) 0 for the x-beam, 1 for the y-beam.
    rising : (m,) +1 where the distance from the beam grows, -1 where it falls.
    side : (m,) +1 where the tool's axis is at +rho then, -1 at -rho.
    time_s, sigma_s : (m,).
    """

    beam: NDArray[np.int64]
    rising: Array
    side: Array
    time_s: Array
    sigma_s: Array


def label_edges(
    motion: CircleMotion, edges: Sequence[BeamEdge], latency_s: float = 0.0
) -> CircleEdges:
    """Tell for each edge on which side of which beam the axis was, and which way it went.

    Between the restore of a shadow and the next break the arc's middle is exactly above or below
    the beam's middle: a latency up to a quarter of a turn does not confuse it. The first edge may
    be a restore, and there may be several turns.

    Raises
    ------
    BeamError
        When a beam has fewer than four edges, or they do not come in turn.
    """
    parts = []
    for b, beam in enumerate(BEAMS):
        own = edges_of(edges, beam, FEWEST_EDGES)
        time = np.array([e.time_s for e in own])
        breaks = np.array([e.blocked for e in own])
        shadow = np.cumsum(breaks)  # a first restore is of shadow 0
        middle = 0.5 * (time[:-1] + time[1:])[~breaks[:-1]] - latency_s
        theta = motion.start_rad + motion.rate_rad_s * middle
        above = np.sin(motion.psi(theta, b)) * (-1.0) ** shadow[:-1][~breaks[:-1]]
        rising = np.sign(np.sum(above)) * (-1.0) ** shadow
        sigma = np.array([e.sigma_s for e in own])
        parts.append((np.full(len(own), b), rising, np.where(breaks, -rising, rising), time, sigma))
    beam_index, rising, side, time, sigma = (np.concatenate(p) for p in zip(*parts, strict=True))
    return CircleEdges(beam_index, rising, side, time, sigma)
