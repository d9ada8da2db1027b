"""Where a corrected command may begin: the robot is compared with what was put out last."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.memory import RESPONSE_S
from robocal_ros.correction.refusals import Reason, RefusedError

Array = NDArray[np.float64]
Index = NDArray[np.int64]

INSTANTS = 9


@dataclass(frozen=True)
class Whereabouts:
    """Where the robot is.

    Attributes
    ----------
    names : of the n joints.
    measured : (n,) last readings, NaN before the first.
    travel : (n,) how far the readings moved within the response time.
    age_s : (n,) of the readings.
    limit_s : readings that are older say nothing.
    """

    names: tuple[str, ...]
    measured: Array
    travel: Array
    age_s: Array
    limit_s: float

    @property
    def fresh(self) -> bool:
        """Whether all readings are young enough."""
        return bool(np.all(self.age_s <= self.limit_s))

    def require_known(self, index: Index) -> None:
        """Refuse while one of these joints has never been read."""
        absent = [self.names[i] for i in index if not np.isfinite(self.measured[i])]
        if absent:
            detail = f"no joint state of {', '.join(absent)} has arrived"
            raise RefusedError(Reason.STALE_JOINTS, detail)

    def require_fresh(self, index: Index) -> None:
        """Refuse while one of these joints has not been read, or not lately."""
        self.require_known(index)
        i = index[int(np.argmax(self.age_s[index]))] if len(index) else -1
        if i >= 0 and self.age_s[i] > self.limit_s:
            detail = f"{self.names[i]} was read {self.age_s[i]:.3f} s ago"
            raise RefusedError(Reason.STALE_JOINTS, f"{detail}, allowed {self.limit_s:g} s")


@dataclass(frozen=True)
class Sent:
    """Joints that were last put out, as a function of time.

    Attributes
    ----------
    index : (k,) the joints' numbers.
    begin_s : start on the session's clock.
    times_s : (m,) from the start.
    taught, corrected : (m, k) what came in and what went out.
    led_from : (k,) where the controller was at ``put_s``, when it was put out, and leads in from.
    before : what was put out before, of the same joints; how the robot may still lag.
    stopped_s : when a stop ended it.
    """

    index: NDArray[np.int64]
    begin_s: float
    times_s: Array
    taught: Array
    corrected: Array
    led_from: Array | None = None
    put_s: float = 0.0
    before: "Sent | None" = None
    stopped_s: float = np.inf

    def live(self, now_s: float) -> bool:
        """Whether the robot may still be moving by it."""
        end = min(self.stopped_s, self.begin_s + float(self.times_s[-1]))
        return now_s <= end + RESPONSE_S

    def since(self, oldest_s: float) -> "Sent":
        """The same without what was over before an instant."""
        kept = [self]
        while kept[-1].begin_s + kept[-1].times_s[0] > oldest_s and kept[-1].before is not None:
            kept.append(kept[-1].before)
        found = replace(kept.pop(), before=None)
        while kept:  # not by recursion: there may be hundreds within the robot's response
            found = replace(kept.pop(), before=found)
        return found

    def around(self, now_s: float) -> Array | None:
        """Taught and corrected joints (2, r, k) at r instants of the robot's response time.

        They end now, or this time after a stop; None where it is not known.
        """
        last = min(now_s, self.stopped_s + RESPONSE_S)
        found = [
            self._at(t)
            for t in np.linspace(min(now_s, self.stopped_s) - RESPONSE_S, last, INSTANTS)
        ]
        known = [pair for pair in found if pair is not None]
        return np.stack(known, axis=1) if known else None

    def place(self, now_s: float) -> Array:
        """Corrected joints (k,) that the controller has come to, on straight ways."""
        then, there_s = min(now_s, self.stopped_s), self.begin_s + self.times_s[0]
        if then < there_s and self.led_from is not None:
            share = (then - self.put_s) / (there_s - self.put_s)
            return np.asarray(self.led_from + share * (self.corrected[0] - self.led_from))
        columns, t = self.corrected.T, then - self.begin_s
        return np.array([np.interp(t, self.times_s, column) for column in columns])

    def _at(self, now_s: float) -> Array | None:
        sent = self
        while now_s - sent.begin_s < sent.times_s[0]:
            if sent.before is None:
                return None
            sent = sent.before
        t, columns = now_s - sent.begin_s, [*sent.taught.T, *sent.corrected.T]
        row = np.array([np.interp(t, sent.times_s, column) for column in columns])
        return row.reshape(2, -1)


class Follows(Enum):
    """Which correction a robot shows."""

    COMMANDED = "the one that was put out"
    NONE = "none"
    UNKNOWN = "cannot be told"


def follows(sent: Sent, where: Whereabouts, near: Array, now_s: float) -> Follows:
    """Compare the robot with what was put out; ``near`` (n,) is how far it may stand from it.

    A robot that moves while a command is under way is taken to follow it: between the points of
    a trajectory its controller may go another way.
    """
    if not where.fresh:
        return Follows.UNKNOWN
    allowed, measured = near[sent.index], where.measured[sent.index]
    standing = bool(np.all(where.travel[sent.index] <= allowed))
    if not standing and sent.live(now_s):
        return Follows.COMMANDED
    places = sent.around(now_s)
    if places is None:
        return Follows.UNKNOWN
    beside = np.maximum(places.min(axis=1) - measured, measured - places.max(axis=1))
    taught, corrected = (float(np.max(np.maximum(row, 0.0) / allowed)) for row in beside)
    whole = len(sent.index) == len(where.measured)  # else the others may show one
    if standing and whole and taught <= 1.0 and taught < corrected:
        return Follows.NONE
    return Follows.COMMANDED if corrected <= 1.0 else Follows.UNKNOWN


def nearest_start(measured: Array, starts: Sequence[tuple[Array, Array]]) -> int | None:
    """Which start (joints (r, k), how far the robot may be from one of them) is where it is.

    The nearest one; None when the robot is at none of them.
    """
    best, chosen = np.inf, None
    for i, (joints, allowed) in enumerate(starts):
        miss = np.abs(joints - measured)
        for row in miss[np.all(miss <= allowed, axis=1)]:
            if float(np.max(row)) < best:
                best, chosen = float(np.max(row)), i
    return chosen
