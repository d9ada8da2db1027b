# SPDX-License-Identifier: Apache-2.0
"""Edges of light barriers: debounced, alternating, each with the uncertainty of its stamp.

Order is judged beam by beam: two beams' shadows may overlap, so nothing follows from the order of
edges of different beams.
"""

import math
from collections import Counter, deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any, Literal

import numpy as np

from robocal_ros.ground.errors import Code, InputError, RankDeficientError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.session.inputs import AHEAD_NS, AheadOfJoints

Beam = Literal["x", "y", "up", "down"]
BEAMS: tuple[Beam, Beam] = ("x", "y")  # crossed
PARALLEL: tuple[Beam, Beam] = ("up", "down")
SMALLEST_HEIGHT_M = 2e-3  # between them
MOST_BOUNCES = 5  # edges of one burst; more is no contact that settles


@dataclass(frozen=True)
class ParallelStation:
    """Two parallel beams along the base's y: their heights and their place along its x, m.

    ``x_m``: needed for the tip alone. ``names``: of the upper and the lower beam in the edges.

    Raises `RankDeficientError` when they are too near each other.
    """

    up_m: float
    down_m: float
    x_m: float | None
    names: tuple[str, str] = ("up", "down")

    def __post_init__(self) -> None:
        if self.up_m - self.down_m < SMALLEST_HEIGHT_M:
            raise RankDeficientError(
                f"the beams are {(self.up_m - self.down_m) * 1e3:.2f} mm apart in height: the tilt "
                "needs beams further apart, the upper one first",
                ("tilt of the tool",),
            )


class BeamError(RobocalError):
    """Edges that no single passage of a tool explains: what is missing or too many."""

    code = Code.BEAM_EDGES_WRONG


@dataclass(frozen=True, slots=True)
class BeamEdge:
    """A beam was broken (``blocked``) or restored at ``time_s``, known to ``sigma_s``.

    ``time_s`` counts from any origin that all edges and the robot's readings share.

    Raises `InputError` when the time is not finite, or sigma not positive.
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

    ``jitter_s``: standard deviation of a stamp.
    ``sample_period_s``: period at which the input is read; 0 where edges are stamped by interrupt.
    An edge is seen up to one period late: half of it is latency, the rest is uniform.
    ``debounce_s``: edges of one beam closer than this belong to one contact that bounces.
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

    Raises `BeamError` when a burst leaves the beam as it was (a double edge), or does not settle.
    """
    kept: list[BeamEdge] = []
    for beam in (*BEAMS, *PARALLEL):
        own = sorted((e for e in edges if e.beam == beam), key=lambda e: e.time_s)
        first = 0
        for i in range(1, len(own) + 1):
            if i < len(own) and own[i].time_s - own[i - 1].time_s < debounce_s:
                continue
            burst, first = own[first:i], i
            start, end = burst[0], burst[-1]
            length = end.time_s - start.time_s
            if len(burst) > 1 and (start.blocked != end.blocked or len(burst) > MOST_BOUNCES):
                raise BeamError(
                    f"beam {start.beam} chatters: {len(burst)} edges within "
                    f"{length * 1e3:.2f} ms at {start.time_s:.4f} s (debounce "
                    f"{debounce_s * 1e3:.2f} ms): clean the lenses, check plug and alignment"
                )
            sigma_s = float(np.hypot(start.sigma_s, length / np.sqrt(12.0)))
            kept.append(replace(start, sigma_s=sigma_s))
    return sorted(kept, key=lambda e: e.time_s)


def edges_of(edges: Sequence[BeamEdge], beam: Beam, fewest: int) -> list[BeamEdge]:
    """Edges of one beam in order of time, breaks and restores in turn.

    Raises `BeamError` when there are fewer than ``fewest``, or two of the same kind follow each
    other.
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


StepKind = Literal["circle", "plunge"]
FEWEST_EDGES: Mapping[StepKind, int] = {"circle": 4, "plunge": 2}  # of each beam
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


def edge_sample(message: Any, names: Mapping[str, Beam]) -> EdgeSample:
    """Build a sample from a ``robocal_msgs/BeamEvent``; ``names``: which beam has which.

    Raises `InputError` when the beam is unknown, the edge is neither break nor restore, or the
    stamp's sigma is negative or not finite.
    """
    if message.beam not in names:
        known = ", ".join(f"'{name}' ({beam})" for name, beam in names.items())
        raise InputError(f"beam '{message.beam}' is none of {known}")
    if message.edge not in (BREAK, RESTORE):
        raise InputError(f"edge {message.edge} is neither {BREAK} (break) nor {RESTORE} (restore)")
    sigma_s = float(message.stamp_sigma_s)
    if not 0.0 <= sigma_s < np.inf:
        raise InputError(f"stamp_sigma_s is {sigma_s}: must be finite and not negative")
    at_ns = stamp_ns(message.header.stamp)
    if at_ns <= 0:
        raise InputError("no time stamp: edges are stamped where they happen")
    beam, blocked = names[message.beam], message.edge == BREAK
    return EdgeSample(at_ns, message.header.frame_id, beam, blocked, sigma_s)


EDGES = "beam_events"
MOST_EDGES = 1000  # of one step: more is a beam that flickers


class EdgeLog:
    """Edges since the run began, beam by beam in order of time."""

    def __init__(self) -> None:
        self._edges: list[EdgeSample] = []
        self.ahead: AheadOfJoints[EdgeSample] = AheadOfJoints()

    def add(self, sample: EdgeSample, newest_ns: dict[str, int], joints_ns: int) -> None:
        """Take an edge; ``newest_ns``: newest stamp of each beam, brought up to date.

        Raises `InputError` when it is not after the beam's last one, or far ahead of the joint
        readings, for which it waits: one wrong stamp must not blind a beam.
        """
        if why := self.ahead.why(sample.beam, sample, joints_ns, MOST_EDGES):
            raise InputError(f"edge at {sample.stamp_ns} ns {why}")
        if not self._take(sample, newest_ns):
            newest = newest_ns[f"{EDGES}/{sample.beam}"]
            raise InputError(f"edge at {sample.stamp_ns} ns is not after {newest} ns")

    def come(self, newest_ns: dict[str, int], joints_ns: int) -> list[EdgeSample]:
        """Take the edges whose joint readings have come."""
        if not self.ahead:
            return []
        came = self.ahead.come(joints_ns)
        return [sample for sample in came if self._take(sample, newest_ns)]

    def _take(self, sample: EdgeSample, newest_ns: dict[str, int]) -> bool:
        """Whether it is after the beam's last one."""
        topic = f"{EDGES}/{sample.beam}"
        if sample.stamp_ns <= newest_ns.get(topic, -1):
            return False
        newest_ns[topic] = sample.stamp_ns
        if len(self._edges) < MOST_EDGES:
            self._edges.append(sample)
        return True

    def take(self, from_ns: int, marks: Mapping[str, int]) -> list[EdgeSample]:
        """Edges after a stamp, up to the marks; they are not given again."""
        found = [
            sample
            for sample in self._edges
            if from_ns < sample.stamp_ns <= marks.get(f"{EDGES}/{sample.beam}", -1)
        ]
        self._edges = [sample for sample in self._edges if sample not in found]
        order = (*BEAMS, *PARALLEL)
        return sorted(found, key=lambda sample: (sample.stamp_ns, order.index(sample.beam)))

    def forget_marked(self, marks: Mapping[str, int]) -> None:
        """Forget edges up to the marks: a recording may bring later ones sooner than they came."""
        self.take(-1, marks)

    def forget(self, before_ns: int) -> None:
        """Forget edges from before a stamp."""
        self._edges = [sample for sample in self._edges if sample.stamp_ns >= before_ns]

    def clear(self) -> None:
        """Forget all."""
        self._edges.clear()
        self.ahead.clear()


BEHIND_S = 0.15  # a gateway brings an edge sooner; smaller offsets the edges themselves show
STRAYS = 2


class StrayEdges:
    """Edges of a run that come with a stamp far from the joints'.

    One may be a mistake, a second one is none.
    """

    def __init__(self) -> None:
        self._count = 0

    def doubt(self, sample: EdgeSample, joints_ns: int) -> str:
        """What is wrong, once it is sure; else empty."""
        away_s = (sample.stamp_ns - joints_ns) * 1e-9
        self._count += not -BEHIND_S <= away_s <= AHEAD_NS * 1e-9
        if self._count != STRAYS:
            return ""
        where = "ahead of" if away_s > 0.0 else "behind"
        return (
            f"edges come stamped {abs(away_s):.2f} s {where} the joint states: a clock has jumped, "
            "or one of them comes late; stamp both on one clock"
        )


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

    ``up`` (3,): the laser's z, base. ``beams``: those that the step breaks. ``first_edge_s``: time
    of the first edge; None before.
    """

    kind: StepKind
    last: bool
    up: Array
    beams: Sequence[Beam] = BEAMS
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
        complete = all(self._edges[beam] >= FEWEST_EDGES[self.kind] for beam in self.beams)
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
        away = flange - first
        still = first_s <= time_s - REST_S and math.sqrt(away @ away) < REST_M
        if not still:
            self._rest_since_s = None
            return 0.0
        if self._rest_since_s is None:
            self._rest_since_s = first_s
        return time_s - self._rest_since_s
