"""Edges of light barriers: debounced, alternating, each with the uncertainty of its stamp.

Order is judged beam by beam: two beams' shadows may overlap, so nothing follows from the order of
edges of different beams.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, InputError, RobocalError

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
