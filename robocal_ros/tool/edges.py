"""Edges of light barriers: debounced, alternating, each with the uncertainty of its stamp.

Order is judged beam by beam: two beams' shadows may overlap, so nothing follows from the order of
edges of different beams.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.samples import stamp_ns

# ---- beam edges ---------------------------------------------------------------------------------


Array = NDArray[np.float64]
Beam = Literal["x", "y"]

BEAMS: tuple[Beam, Beam] = ("x", "y")
MOST_BOUNCES = 5  # edges of one burst; more is no contact that settles


class BeamError(RobocalError):
    """Edges that no single passage of a tool explains: what is missing or too many."""

    code = Code.BEAM_EDGES_WRONG


@dataclass(frozen=True, slots=True)
class BeamEdge:
    """A beam was broken (``blocked``) or restored at ``time_s``, known to ``sigma_s``.

    ``time_s`` counts from any origin that all edges and the robot's readings share.

    Raises
    ------
    InputError
        When the time is not finite, or sigma not positive.
    """

    beam: Beam
    blocked: bool
    time_s: float
    sigma_s: float

    def __post_init__(self) -> None:
        if not (np.isfinite(self.time_s) and 0.0 < self.sigma_s < np.inf):
            raise InputError(
                f"edge of beam {self.beam} at {self.time_s} s with a sigma of {self.sigma_s} s: "
                "both must be finite, and no stamp is exact"
            )


@dataclass(frozen=True)
class InputRule:
    """What the input does to an edge.

    Attributes
    ----------
    jitter_s : standard deviation of a stamp.
    sample_period_s : period at which the input is read; 0 where edges are stamped by interrupt.
        An edge is seen up to one period late: half of it is latency, the rest is uniform.
    debounce_s : edges of one beam closer than this belong to one contact that bounces.
    """

    jitter_s: float = 20e-6
    sample_period_s: float = 0.0
    debounce_s: float = 5e-4

    @property
    def sigma_s(self) -> float:
        """Standard deviation of a stamp: jitter, and T / sqrt(12) of a sampled input."""
        return float(np.hypot(self.jitter_s, self.sample_period_s / np.sqrt(12.0)))


def debounced(edges: Sequence[BeamEdge], debounce_s: float) -> list[BeamEdge]:
    """Edges in order of time, each burst of a beam replaced by its first edge.

    The contact first touched when the burst began, but a bounce may have hidden an earlier one:
    the stamp's sigma grows by burst length / sqrt(12).

    Raises
    ------
    BeamError
        When a burst leaves the beam as it was (a double edge), or does not settle.
    """
    kept: list[BeamEdge] = []
    for beam in BEAMS:
        own = sorted((e for e in edges if e.beam == beam), key=lambda e: e.time_s)
        first = 0
        for i in range(1, len(own) + 1):
            if i < len(own) and own[i].time_s - own[i - 1].time_s < debounce_s:
                continue
            kept += [_settled(own[first:i], debounce_s)]
            first = i
    return sorted(kept, key=lambda e: e.time_s)


def _settled(burst: Sequence[BeamEdge], debounce_s: float) -> BeamEdge:
    start, end = burst[0], burst[-1]
    if len(burst) > 1 and (start.blocked != end.blocked or len(burst) > MOST_BOUNCES):
        raise BeamError(
            f"beam {start.beam} chatters: {len(burst)} edges within "
            f"{(end.time_s - start.time_s) * 1e3:.2f} ms at {start.time_s:.4f} s (debounce "
            f"{debounce_s * 1e3:.2f} ms): clean the lenses, check plug and alignment"
        )
    length = end.time_s - start.time_s
    return replace(start, sigma_s=float(np.hypot(start.sigma_s, length / np.sqrt(12.0))))


def edges_of(edges: Sequence[BeamEdge], beam: Beam, fewest: int) -> list[BeamEdge]:
    """Edges of one beam in order of time, breaks and restores in turn.

    Raises
    ------
    BeamError
        When there are fewer than ``fewest``, or two of the same kind follow each other.
    """
    own = sorted((e for e in edges if e.beam == beam), key=lambda e: e.time_s)
    if not own:
        raise BeamError(
            f"beam {beam} was never broken: the beam is dead or wired wrongly, or the tool missed "
            "it; check the beam by hand, then enlarge the circle"
        )
    for before, after in pairwise(own):
        if before.blocked == after.blocked:
            what = "broken" if after.blocked else "restored"
            raise BeamError(
                f"beam {beam} is {what} twice, at {before.time_s:.4f} and {after.time_s:.4f} s: an "
                "edge between was lost; repeat the motion, slower if the input is sampled"
            )
    if len(own) < fewest:
        raise BeamError(
            f"beam {beam} has {len(own)} edges, {fewest} are needed: the tool is bent beyond the "
            "circle or too thick for it, or the motion was cut short; enlarge the circle"
        )
    return own


# ---- a circle through two crossed beams, and what each of its edges means -----------------------
#
# In the laser frame the tool's axis is at ``c + R (cos theta, sin theta)``; its signed distance
# from beam b is ``s_b = d_b + R sin(psi_b)`` with psi_x = theta and psi_y = beta - theta.


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


# ---- edges of light beams as messages bring them ------------------------------------------------


BREAK, RESTORE = 1, 2  # as in robocal_msgs/BeamEvent


@dataclass(frozen=True, slots=True)
class EdgeSample:
    """A beam was broken (``blocked``) or restored; ``sigma_s`` of the stamp, 0 where unknown."""

    stamp_ns: int
    station: str
    beam: Beam
    blocked: bool
    sigma_s: float

    def edge(self, origin_ns: int, sigma_s: float) -> BeamEdge:
        """The edge at its time since ``origin_ns``; ``sigma_s`` where it brings none."""
        time_s = (self.stamp_ns - origin_ns) * 1e-9
        return BeamEdge(self.beam, self.blocked, time_s, self.sigma_s or sigma_s)


def edge_sample(message: Any, names: tuple[str, str]) -> EdgeSample:
    """Build a sample from a ``robocal_msgs/BeamEvent``; ``names`` of the x- and the y-beam.

    Raises
    ------
    InputError
        When the beam is unknown, the edge is neither break nor restore, or the stamp's sigma is
        negative or not finite.
    """
    if message.beam not in names:
        raise InputError(f"beam '{message.beam}' is neither '{names[0]}' (x) nor '{names[1]}' (y)")
    if message.edge not in (BREAK, RESTORE):
        raise InputError(f"edge {message.edge} is neither {BREAK} (break) nor {RESTORE} (restore)")
    sigma_s = float(message.stamp_sigma_s)
    if not 0.0 <= sigma_s < np.inf:
        raise InputError(f"stamp_sigma_s is {sigma_s}: must be finite and not negative")
    at_ns = stamp_ns(message.header.stamp)
    if at_ns <= 0:
        raise InputError("no time stamp: edges are stamped where they happen")
    beam = BEAMS[names.index(message.beam)]
    return EdgeSample(at_ns, message.header.frame_id, beam, message.edge == BREAK, sigma_s)


# ---- the edges of a station's beams, as a tool session takes them -------------------------------


EDGES = "beam_events"
MOST_EDGES = 1000  # of one step: more is a beam that flickers
AHEAD_NS = 1_000_000_000


class EdgeLog:
    """Edges since the run began, beam by beam in order of time."""

    def __init__(self) -> None:
        self._edges: list[EdgeSample] = []

    def add(self, sample: EdgeSample, newest_ns: dict[str, int], joints_ns: int) -> None:
        """Take an edge; ``newest_ns``: newest stamp of each beam, brought up to date.

        Raises
        ------
        InputError
            When it is not after the beam's last one, or far ahead of the joint readings: one wrong
            stamp must not blind a beam.
        """
        ahead_ns = sample.stamp_ns - joints_ns
        if joints_ns and ahead_ns > AHEAD_NS:
            raise InputError(
                f"edge at {sample.stamp_ns} ns is {ahead_ns * 1e-9:.1f} s ahead of the joint "
                "states: stamp both on one clock"
            )
        topic = f"{EDGES}/{sample.beam}"
        if sample.stamp_ns <= newest_ns.get(topic, -1):
            raise InputError(f"edge at {sample.stamp_ns} ns is not after {newest_ns[topic]} ns")
        newest_ns[topic] = sample.stamp_ns
        if len(self._edges) < MOST_EDGES:
            self._edges.append(sample)

    def take(self, from_ns: int, marks: Mapping[str, int]) -> list[EdgeSample]:
        """Edges after a stamp, up to the marks; they are not given again."""
        found = [
            sample
            for sample in self._edges
            if from_ns < sample.stamp_ns <= marks.get(f"{EDGES}/{sample.beam}", -1)
        ]
        self._edges = [sample for sample in self._edges if sample not in found]
        return sorted(found, key=lambda sample: (sample.stamp_ns, BEAMS.index(sample.beam)))

    def clear(self) -> None:
        """Forget all."""
        self._edges.clear()
