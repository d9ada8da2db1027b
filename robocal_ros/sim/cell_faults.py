"""What may go wrong in the simulated cell, and what faults of the input make of its edges."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Literal, get_args

import numpy as np

from robocal_ros.core.tool.beam_edges import Beam, BeamEdge

Fault = Literal[
    "none",
    "beam_x_dead",
    "beam_y_dead",
    "chatter",
    "lost_edge",
    "double_edge",
    "wrong_station",
    "joints_silent",
    "frozen_clock",
    "moved_by_hand",
]
FAULTS: tuple[Fault, ...] = get_args(Fault)

CHATTER = 7  # edges that one edge becomes
CHATTER_S = 3e-4
AGAIN_S = 5e-3  # a double edge comes so much later


class FaultyInput:
    """An input with a fault, step by step.

    ``lost_edge`` and ``double_edge`` befall the second edge of a step's y-beam.
    """

    def __init__(self) -> None:
        self.begin("none")

    def begin(self, fault: Fault) -> None:
        """A step begins."""
        self._fault, self._seen = fault, 0

    def passed(self, edges: Sequence[BeamEdge]) -> list[BeamEdge]:
        """What comes through of edges, in order of time."""
        dead: dict[Fault, Beam] = {"beam_x_dead": "x", "beam_y_dead": "y"}
        out: list[BeamEdge] = []
        for edge in edges:
            self._seen += edge.beam == "y"
            if edge.beam == dead.get(self._fault):
                continue
            if self._fault == "chatter":
                out += _chattered(edge)
            elif edge.beam == "y" and self._seen == 2 and self._fault == "lost_edge":
                continue
            elif edge.beam == "y" and self._seen == 2 and self._fault == "double_edge":
                out += [edge, replace(edge, time_s=edge.time_s + AGAIN_S)]
            else:
                out.append(edge)
        return out


def _chattered(edge: BeamEdge) -> list[BeamEdge]:
    """A burst that does not settle within any debounce time."""
    times = edge.time_s + np.linspace(0.0, CHATTER_S, CHATTER)
    return [
        replace(edge, blocked=edge.blocked ^ bool(i % 2), time_s=t)
        for i, t in enumerate(times.tolist())
    ]
