"""Edges of light beams as messages bring them."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.tool.beam_edges import BEAMS, Beam, BeamEdge

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
