"""The model that commands are corrected with: one at every instant, never a step.

Models are packed (see ``joint_correction.pack_model``) and compared by identity: a settled
blend *is* the model that is wanted.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.joint_correction import blend_models
from robocal_ros.correction.staged import StagedCorrection, StagedResult

Array = NDArray[np.float64]

# A controller's quintic between two points moves at most this much faster than their mean rate.
SPLINE_PEAK = 1.875
# What a step of the blend is multiplied with at least, try by try, while it is too long: the
# first is right where the correction changes evenly with s, else it is halved.
SHRINK = (1.0, *(0.5,) * 11)
UNEVEN = 1.02
ROUNDING = 1e-12


@dataclass(frozen=True)
class Commanded:
    """The model in the commands that were last put out, as a function of time.

    Attributes
    ----------
    start, end : packed models; a settled blend has both the same.
    begin_s : start of the trajectory on the session's clock.
    times_s, s : (m,) blend along the trajectory; constant before and after, and in a stream.
    before : what is commanded until ``begin_s``, while a trajectory waits for its start.
    """

    start: Array
    end: Array
    begin_s: float = 0.0
    times_s: Array = field(default_factory=lambda: np.zeros(1))
    s: Array = field(default_factory=lambda: np.ones(1))
    before: "Commanded | None" = None

    def at(self, now_s: float) -> Array:
        """The packed model at an instant."""
        latest = self.latest(now_s)
        s = latest.progress(now_s)
        if s <= 0.0:
            return latest.start
        return latest.end if s >= 1.0 else blend_models(latest.start, latest.end, s)

    def stopped(self, now_s: float) -> "Commanded":
        """The model of an instant, from then on."""
        model = self.at(now_s)
        return Commanded(model, model)

    def settled(self, now_s: float) -> Array | None:
        """The packed model at an instant and ever after; None while it is still to change."""
        if self.before is not None and now_s < self.begin_s:
            return None
        over = self.start is self.end or (
            now_s - self.begin_s >= self.times_s[-1] and self.s[-1] >= 1.0
        )
        return self.end if over else None

    def latest(self, now_s: float) -> "Commanded":
        """What is in the commands at an instant: this, or what was ``before``."""
        if self.before is not None and now_s < self.begin_s:
            return self.before.latest(now_s)
        return self

    def progress(self, now_s: float) -> float:
        """How far the blend is, 0 to 1; 1 when settled."""
        if self.start is self.end:
            return 1.0
        return float(np.interp(now_s - self.begin_s, self.times_s, self.s))


def step_towards(
    stage: StagedCorrection, q: Array, begin: float, rates: Array, dt_s: float
) -> tuple[float, StagedResult]:
    """How far a stream may blend from s = ``begin`` within ``dt_s``, and the point (1, n) there.

    No joint's correction at ``q`` (1, n) changes by more than ``rates`` (n,) times ``dt_s``.
    """
    allowed = rates * dt_s
    here = stage.correct(q, np.array([begin]))
    ds = 1.0 - begin
    for shrink in SHRINK:
        s = begin + ds if ds < 1.0 - begin else 1.0
        there = stage.correct(q, np.array([s]))
        change = np.abs(there.q - here.q)[0]
        if np.all(change <= allowed):
            return s, there
        with np.errstate(divide="ignore"):
            least = float(np.min(np.where(change > 0.0, allowed / change, 1.0)))
        ds *= min(shrink, 0.98 * least)
    return begin, here


def blend_along(
    stage: StagedCorrection, q: Array, times_s: Array, elapsed_s: float, rates: Array
) -> Array:
    """Blend (m,) at the points of a trajectory ``q`` (m, n), never faster than ``rates`` (n,).

    It begins at s = 0 when ``elapsed_s`` of the trajectory have passed (0 for one that begins
    now) and runs along the time from start. Where the correction does not change evenly with s (a
    bound holds on a part of the way), all of it is slower; 0 where it cannot be slow enough.
    """
    m = len(q)
    whole = np.abs(stage.correct(q, np.ones(m)).q - stage.correct(q, np.zeros(m)).q)
    with np.errstate(divide="ignore"):
        slowest = np.min(rates / SPLINE_PEAK / whole, axis=1)  # of s, 1/s
    before = np.concatenate([slowest[:1], slowest[:-1]])
    time = np.maximum(times_s, elapsed_s)
    dt = np.diff(time, prepend=max(elapsed_s, 0.0))
    with np.errstate(invalid="ignore"):
        ds = np.where(dt > 0.0, dt * np.minimum(slowest, before), 0.0)
    for shrink in SHRINK:
        s = np.minimum(np.cumsum(ds), 1.0)
        change = stage.correct(q, s).q - stage.correct(q, np.append(0.0, s[:-1])).q
        allowed = np.maximum(rates * dt[:, None] / SPLINE_PEAK, ROUNDING)
        excess = float(np.max(np.abs(change) / allowed))
        if excess <= UNEVEN:
            return np.asarray(s)
        ds = ds * min(shrink, 1.0 / excess)
    return np.zeros(m)


def blend_rates(times_s: Array, s: Array) -> Array:
    """Rate of s (m,) at the points, 1/s: the slower of both sides, at rest at both ends.

    So a trajectory that ends at rest still does.
    """
    rate = np.zeros(len(s))
    if len(s) > 2:
        slope = np.diff(s) / np.diff(times_s)
        rate[1:-1] = np.minimum(slope[:-1], slope[1:])
    return rate
