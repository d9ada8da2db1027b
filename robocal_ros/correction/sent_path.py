# SPDX-License-Identifier: Apache-2.0
"""A trajectory that was put out, as its controller drives it."""

from dataclasses import dataclass

import numpy as np

from robocal_ros.correction.interface import TrajectoryCommand
from robocal_ros.correction.joint_correction import StagedCorrection
from robocal_ros.ground.frames import Array, Index

# A robot follows what it was sent within this: drives lag, messages travel, s.
RESPONSE_S = 0.2
# of what is known of a path: its offset, that one's rate and acceleration, what the limiter adds
OFFSETS, RATES, BENDS, WITHHELD = range(4)


@dataclass
class SentPath:
    """A trajectory that was put out, and the controller's clock on it."""

    command: TrajectoryCommand  # as put out
    index: Index  # (k,) its joints
    begin_s: float  # from when its times count, on the session's clock
    known_times: Array  # (r,) of the next rows: its points, before them where it leads in
    known: Array  # (4, r, n)
    stage: StagedCorrection | None  # that it was made with
    led_from: Array  # (k,) where the controller leads in from
    led_rate: Array | None  # (k,) and how fast it is there; None: not known
    put_s: float  # since when
    at_once: bool  # it begins as it goes out
    replaced: "SentPath | None" = None  # by it, until the controller accepts it
    rejected: bool = False
    _scaling: float = 1.0
    _lost_s: float = 0.0  # by a clock that runs slower
    _since_s: float = -np.inf
    _stopped_s: float = np.inf

    def begin(self, now_s: float) -> None:
        """It goes out now: one that begins at once begins now, not when it was corrected."""
        if self.at_once:
            self.begin_s = now_s

    def end(self, now_s: float) -> None:
        """It ended early: the controller stays where it is on it."""
        self._stopped_s = min(self._stopped_s, now_s)

    def scale(self, scaling: float, now_s: float) -> None:
        """From now on the controller's clock runs so fast, 0 to 1."""
        now_s = min(now_s, self._stopped_s)  # what ended is driven no more, however fast
        since = max(self._since_s, self.begin_s)
        if now_s > since:
            self._lost_s += (1.0 - self._scaling) * (now_s - since)
        self._since_s, self._scaling = now_s, scaling

    def time(self, now_s: float) -> float:
        """Where the controller's clock is on it, s from its begin."""
        now_s = min(now_s, self._stopped_s)
        if now_s == np.inf:  # when it has been driven, at whatever speed
            return np.inf
        since = max(self._since_s, self.begin_s)
        lost = self._lost_s + (1.0 - self._scaling) * max(now_s - since, 0.0)
        return now_s - self.begin_s - lost

    def live(self, now_s: float) -> bool:
        """Whether the robot may still be moving by it."""
        return self.time(now_s) <= self.lasts_s + RESPONSE_S and (
            now_s <= self._stopped_s + RESPONSE_S
        )

    @property
    def lasts_s(self) -> float:
        """Time of its last point."""
        return float(self.command.time_from_start_s[-1])

    def place(self, now_s: float) -> Array:
        """Where the controller is (k,), between the points as it drives there."""
        t, times, out = self.time(now_s), self.command.time_from_start_s, self.command.position
        velocity = self.command.velocity
        if t >= times[0]:
            return driven(times, out, velocity, self.command.acceleration, t)
        way = np.array([self.put_s - self.begin_s, times[0]])
        if way[0] >= way[1]:
            return out[0].copy()
        ends, rates = np.stack([self.led_from, out[0]]), None
        if velocity is not None and self.led_rate is not None:
            rates = np.stack([self.led_rate, velocity[0]])
        return spline(way, ends, rates, None, 0, max(t, float(way[0])))[0]

    def withheld(self, now_s: float) -> Array:
        """What of the offset the limiter adds now (n,)."""
        return self._at(WITHHELD, now_s)

    def _at(self, row: int, now_s: float) -> Array:
        t, times, rows = self.time(now_s), self.known_times, self.known[row]
        k = int(np.searchsorted(times, t, side="right")) - 1
        if not 0 <= k < len(times) - 1:
            return rows[max(k, 0)].copy()
        return np.asarray(
            rows[k] + (t - times[k]) / (times[k + 1] - times[k]) * (rows[k + 1] - rows[k])
        )

    def offset(self, now_s: float) -> tuple[Array, Array]:
        """Offset and its rate (n,) now, as the controller drives them between the points."""
        t, times = self.time(now_s), self.known_times
        k = int(np.searchsorted(times, t, side="right")) - 1
        if self.command.velocity is None or not 0 <= k < len(times) - 1:
            return self._at(OFFSETS, now_s), self._at(RATES, now_s)
        offsets, rates, bends, _ = self.known[:, k : k + 2]
        # it comes in by a cubic
        comes_in = k < len(times) - len(self.command)
        quintic = self.command.acceleration is not None and not comes_in
        return spline(times, offsets, rates, bends if quintic else None, k, t)


def driven(
    times: Array, points: Array, rates: Array | None, bends: Array | None, t: float
) -> Array:
    """Where a controller is (k,) at ``t`` between points (m, k), from the first one on."""
    k = int(np.searchsorted(times, t, side="right")) - 1
    if k + 1 >= len(times):
        return points[-1].copy()
    ends = slice(k, k + 2)
    rates, bends = (None if rows is None else rows[ends] for rows in (rates, bends))
    return spline(times, points[ends], rates, bends, k, t)[0]


def spline_terms(
    way: Array, v0: Array, v1: Array, bends: Array | None
) -> tuple[Array, Array, Array, Array]:
    """Factors of u^2 to u^5 of a cubic, with ``bends`` (2, ...) a quintic, from u = 0 to 1."""
    if bends is None:
        return 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way, 0.0 * way, 0.0 * way
    b0, b1 = bends
    return (
        0.5 * b0,
        10.0 * way - 6.0 * v0 - 4.0 * v1 - 1.5 * b0 + 0.5 * b1,
        -15.0 * way + 8.0 * v0 + 7.0 * v1 + 1.5 * b0 - b1,
        6.0 * way - 3.0 * (v0 + v1) - 0.5 * (b0 - b1),
    )


def spline(
    times: Array, ends: Array, rates: Array | None, bends: Array | None, k: int, t: float
) -> tuple[Array, Array]:
    """Place and speed (n,) at ``t`` between the points k and k + 1, as a controller drives.

    ``ends``, ``rates`` and ``bends`` (2, n) are those of the two: a line through the places, a
    cubic with their speeds, a quintic with their accelerations too.
    """
    h = times[k + 1] - times[k]
    u, way = (t - times[k]) / h, ends[1] - ends[0]
    if rates is None:
        return ends[0] + u * way, way / h
    v0, v1 = rates * h
    c2, c3, c4, c5 = spline_terms(way, v0, v1, None if bends is None else bends * (h * h))
    place = ends[0] + u * (v0 + u * (c2 + u * (c3 + u * (c4 + u * c5))))
    speed = v0 + u * (2.0 * c2 + u * (3.0 * c3 + u * (4.0 * c4 + u * 5.0 * c5)))
    return place, speed / h
