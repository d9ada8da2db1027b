"""When a circle or a plunge is over, from the edges and from where the flange is."""

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.tool.beam_edges import BEAMS, Beam
from robocal_ros.tool.crossed_model import StepKind
from robocal_ros.tool.crossed_run import FEWEST_EDGES

Array = NDArray[np.float64]

REST_S = 0.1
REST_M = 2e-4  # the flange rests: it moved less in REST_S
GIVEN_UP_S = 1.0  # rest after which an incomplete step is over: a program may pause in a plunge
LEFT_M = 2e-3  # out of the circle's plane, or off the plunge's line
AFTER_EDGE_S = 1e-3  # a reading so late after the last edge brackets it, whatever its latency


@dataclass(eq=False)
class StepWatch:
    """Watches one step; times in s of any one origin, positions (3,) of the flange, base, m.

    A robot program says nothing: a step is over when its edges are complete and the flange rests
    or leaves, or when edges are missing and it has left or rested for long. The last step of a
    run is over with its last edge.

    Attributes
    ----------
    up : (3,) the laser's z, base.
    first_edge_s : time of the first edge; None before.
    """

    kind: StepKind
    last: bool
    up: Array
    first_edge_s: float | None = None
    _edges: Counter[Beam] = field(default_factory=Counter)
    _newest_edge_s: float = -np.inf
    _start: Array | None = None
    _recent: deque[tuple[float, Array]] = field(default_factory=deque)
    _rest_since_s: float | None = None

    def edge(self, beam: Beam, time_s: float) -> None:
        """Take an edge."""
        self._edges[beam] += 1
        self.first_edge_s = time_s if self.first_edge_s is None else self.first_edge_s
        self._newest_edge_s = max(self._newest_edge_s, time_s)

    @property
    def edges(self) -> int:
        """How many edges there were."""
        return self._edges.total()

    def over(self, time_s: float, flange: Array) -> bool:
        """Take a reading of the flange; whether the step is over now."""
        rests_s = self._rests_s(time_s, flange)
        if not self.edges or time_s < self._newest_edge_s + AFTER_EDGE_S:
            return False
        if self._start is None:
            self._start = flange
        complete = all(self._edges[beam] >= FEWEST_EDGES[self.kind] for beam in BEAMS)
        even = all(self._edges[beam] % 2 == 0 for beam in BEAMS)
        if complete and even and (self.last or rests_s > 0.0):
            return True
        return rests_s >= GIVEN_UP_S or self._left(flange)

    def _left(self, flange: Array) -> bool:
        if self._start is None:
            return False
        away = flange - self._start
        height = float(away @ self.up)
        if self.kind == "circle":
            return abs(height) > LEFT_M
        return float(np.linalg.norm(away - height * self.up)) > LEFT_M

    def _rests_s(self, time_s: float, flange: Array) -> float:
        """How long the flange has rested by now."""
        self._recent.append((time_s, flange))
        while len(self._recent) > 1 and self._recent[1][0] <= time_s - REST_S:
            self._recent.popleft()
        first_s, first = self._recent[0]
        still = first_s <= time_s - REST_S and float(np.linalg.norm(flange - first)) < REST_M
        if not still:
            self._rest_since_s = None
            return 0.0
        if self._rest_since_s is None:
            self._rest_since_s = first_s
        return time_s - self._rest_since_s
