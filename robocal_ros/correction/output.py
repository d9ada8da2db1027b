"""What was put out last: where it leads the controller, and what it adds to the taught joints."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.inputs import Array, Index
from robocal_ros.correction.limiter import (
    DESIRED,
    DESIRED_RATE,
    OFFSET,
    OFFSET_RATE,
    SHARE,
    OffsetLimiter,
)
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.robot_state import RESPONSE_S, TRACK_S, RobotState
from robocal_ros.correction.staged import StagedCorrection

ROUNDING = 1e-9


@dataclass
class SentPath:
    """A trajectory that was put out, and the controller's clock on it."""

    index: Index  # (k,) its joints
    begin_s: float  # zero of ``times`` on the session's clock
    times: Array  # (m,) of its points, s
    out: Array  # (m, k) as put out
    velocity: Array | None  # (m, k); None for straight lines between the points
    known_times: Array  # (r,) of the next rows: its points, before them where it leads in
    offsets: Array  # (r, n)
    rates: Array  # (r, n) of the offset
    withheld: Array  # (r, n) what of it the limiter adds
    stage: StagedCorrection | None  # that it was made with
    led_from: Array  # (k,) where the controller leads in from
    put_s: float  # since when
    at_once: bool  # it begins as it goes out
    replaced: "SentPath | None" = None  # by it, until the controller accepts it
    rejected: bool = False
    _scaling: float = 1.0
    _lost_s: float = 0.0  # by a clock that runs slower
    _since_s: float = field(default=-np.inf)
    _stopped_s: float = np.inf

    def begin(self, now_s: float) -> None:
        """It goes out now: one that begins at once begins now, not when it was corrected."""
        if self.at_once:
            self.begin_s = now_s

    def accept(self) -> None:
        """The controller took it: there is no way back."""
        self.replaced = None

    def end(self, now_s: float) -> None:
        """It ended early: the controller stays where it is on it."""
        self._stopped_s = min(self._stopped_s, now_s)

    def scale(self, scaling: float, now_s: float) -> None:
        """From now on the controller's clock runs so fast, 0 to 1."""
        since = max(self._since_s, self.begin_s)
        if now_s > since:
            self._lost_s += (1.0 - self._scaling) * (now_s - since)
        self._since_s, self._scaling = now_s, scaling

    def time(self, now_s: float) -> float:
        """Where the controller's clock is on it, s from its begin."""
        now_s = min(now_s, self._stopped_s)
        since = max(self._since_s, self.begin_s)
        lost = self._lost_s + (1.0 - self._scaling) * max(now_s - since, 0.0)
        return now_s - self.begin_s - lost

    def live(self, now_s: float) -> bool:
        """Whether the robot may still be moving by it."""
        return self.time(now_s) <= self.times[-1] + RESPONSE_S and (
            now_s <= self._stopped_s + RESPONSE_S
        )

    def place(self, now_s: float) -> Array:
        """Where the controller is (k,): cubic between points with velocities, else straight."""
        t = self.time(now_s)
        if t < self.times[0]:
            lead = self.times[0] + self.begin_s - self.put_s
            part = np.clip((self.times[0] - t) / lead, 0.0, 1.0) if lead > 0.0 else 0.0
            return np.asarray(self.out[0] + part * (self.led_from - self.out[0]))
        k = int(np.searchsorted(self.times, t, side="right")) - 1
        if k + 1 >= len(self.times):
            return self.out[-1].copy()
        dt = self.times[k + 1] - self.times[k]
        s, way = (t - self.times[k]) / dt, self.out[k + 1] - self.out[k]
        if self.velocity is None:
            return np.asarray(self.out[k] + s * way)
        v0, v1 = self.velocity[k] * dt, self.velocity[k + 1] * dt
        curve = 3.0 * way - 2.0 * v0 - v1 + s * (v0 + v1 - 2.0 * way)
        return np.asarray(self.out[k] + s * (v0 + s * curve))

    def at(self, rows: Array, now_s: float) -> Array:
        """Rows (r, n) of it now (n,)."""
        t = self.time(now_s)
        return np.array([np.interp(t, self.known_times, column) for column in rows.T])

    def offset(self, now_s: float) -> tuple[Array, Array]:
        """Offset and its rate (n,) now, as the controller drives them between the points."""
        t, times = self.time(now_s), self.known_times
        k = int(np.searchsorted(times, t, side="right")) - 1
        if self.velocity is None or not 0 <= k < len(times) - 1:
            return self.at(self.offsets, now_s), self.at(self.rates, now_s)
        h = times[k + 1] - times[k]
        s, v0, v1 = (t - times[k]) / h, self.rates[k], self.rates[k + 1]
        way = (self.offsets[k + 1] - self.offsets[k]) / h
        first, second = 3.0 * way - 2.0 * v0 - v1, v0 + v1 - 2.0 * way
        offset = self.offsets[k] + h * s * (v0 + s * (first + s * second))
        return offset, v0 + s * (2.0 * first + 3.0 * s * second)


class Output:
    """What was put out last for each joint."""

    def __init__(self, arm: SerialArm, config: CorrectionConfig, state: RobotState) -> None:
        self._state, self._near = state, config.start_near(arm)
        self._fastest = config.velocity_limits
        # the offsets of a stream, and of the begin of what comes next
        self.limiter = OffsetLimiter(arm.prismatic, config.turning, config.sliding)
        self.stage: StagedCorrection | None = None  # of the last target
        # (n,) the last target, as it was followed, and what went out; NaN before any
        self.taught, self.out = np.full((2, arm.n), np.nan)
        self.out_s = -np.inf  # when
        self.path: SentPath | None = None  # put out since; None after a target
        self.mismatch = ""  # why nothing goes out until it is acknowledged
        self._track: deque[tuple[float, Array]] = deque()  # where the controller was sent lately

    # ---- the offset -----------------------------------------------------------------------------

    def correction(self, now_s: float) -> tuple[StagedCorrection | None, Array]:
        """The correction in what is put out now, and what the limiter adds to it (n,)."""
        if self.path is not None:
            return self.path.stage, self.path.at(self.path.withheld, now_s)
        return self.stage, self.limiter.withheld

    def uncorrected(self, corrected: Array, now_s: float) -> Array:
        """Taught joints (n,) of corrected ones; of readings in part as they are."""
        stage, withheld = self.correction(now_s)
        bare = corrected - withheld
        if stage is None or not np.isfinite(bare).all():
            return bare
        return stage.uncorrect_one(bare)

    # ---- where a command may begin --------------------------------------------------------------

    def place(self, index: Index, q: Array, now_s: float) -> tuple[Array, bool]:
        """Where the controller is (k,), and whether that is known better than by readings.

        Its reference where it tells it; else what it was sent, where the robot is there or on its
        way; else where the robot stands, joints without limits at the turn nearest to ``q`` (k,):
        what reads them may count no turns, what drives them does.

        Raises `RefusedError` when readings are missing or old, or the robot moves and not by what
        was put out.
        """
        state = self._state
        known = state.reference(index, now_s)
        if known is not None:
            return known, True
        state.require_fresh(index, now_s)
        measured, near = state.measured[index], self._near[index]
        stands, sent = state.stands(index, now_s), self._sent(now_s)[index]
        if np.isfinite(sent).all():
            lately = [p[index] for t, p in self._track if t >= now_s - RESPONSE_S]
            places = np.array([sent, *(p for p in lately if np.isfinite(p).all())])
            here = state.unwrapped(index, measured, sent)
            beside = np.maximum(places.min(axis=0) - here, here - places.max(axis=0))
            if np.all(beside <= near):  # it is there, or lags on its way
                return sent, True
        if stands:
            return state.unwrapped(index, measured, q), False
        raise self.refuse("the robot moves, and where its controller is is not known")

    def note_place(self, now_s: float) -> None:
        """Keep where the controller is sent now, for robots that lag."""
        track = self._track
        if not track or now_s - track[-1][0] >= TRACK_S or now_s < track[-1][0]:
            track.append((now_s, self._sent(now_s)))
            while len(track) > 1 and track[1][0] <= now_s - RESPONSE_S:
                track.popleft()

    def _sent(self, now_s: float) -> Array:
        """Where the controller was sent by now (n,); NaN where nothing was."""
        sent = self.out.copy()
        if self.path is not None:
            sent[self.path.index] = self.path.place(now_s)
        return sent

    def begin_at(self, index: Index, q: Array, begins: Array, now_s: float) -> Array:
        """Offsets (k,) with which joints may begin at once at taught ones ``q`` (n,).

        The controller must be where they begin with an offset between the last one and those that
        a robot may show, ``begins`` (r, n). Raises `RefusedError` as `place`, and when it is
        elsewhere.
        """
        place, exact = self.place(index, q[index], now_s)
        offset, beside = self._taken_up(index, place - q[index], begins, exact=exact)
        if np.any(beside > 1.0):
            j = int(np.argmax(beside))
            raise self.refuse(
                f"{self._state.names[index[j]]} is at {place[j]:.6f}, and the command begins at "
                f"{q[index[j]]:.6f}, corrected at {(q + begins[0])[index[j]]:.6f}"
            )
        return offset

    def _taken_up(
        self, index: Index, offset: Array, begins: Array, *, exact: bool
    ) -> tuple[Array, Array]:
        """Offsets (k,) to begin with, and how far (k,) beside those known, in units of ``near``.

        Readings have noise and drives sag: one that is not exact is the nearest one known.
        """
        near = self._near[index]
        known = np.vstack([self.limiter.state[OFFSET], begins])[:, index]
        beside = np.maximum(known.min(axis=0) - offset, offset - known.max(axis=0)) / near
        miss = np.max(np.abs(known - offset) / near, axis=1)
        if not exact and np.min(miss) <= 1.0:
            offset = known[int(np.argmin(miss))].copy()
        return np.asarray(offset), np.asarray(beside)

    def lead_in(
        self, index: Index, q: Array, begins: Array, now_s: float
    ) -> tuple[Array | None, Array] | None:
        """Taught joints (n,) and offset (n,) from where a command leads in to ``q`` (n,).

        The taught joints are None where the controller is at its first point already. None where
        the robot is neither there nor where it was sent: no offset is taken up then.
        """
        everything = np.arange(self._state.count)
        before = self.mismatch
        try:
            place, exact = self.place(everything, q, now_s)
        except RefusedError:
            self.mismatch = before
            return None
        offset, beside = self._taken_up(index, (place - q)[index], begins, exact=exact)
        if np.all(beside <= 1.0):
            whole = place - q
            whole[index] = offset
            return None, whole
        if not exact:
            return None
        if self.path is not None and self.path.live(now_s):
            taught = place - self.path.offset(now_s)[0]
        else:
            taught = self.uncorrected(place, now_s)
        return taught, place - taught

    def refuse(self, detail: str) -> RefusedError:
        """A mismatch, which lasts until it is acknowledged."""
        self.mismatch = f"{detail}; call ~/acknowledge when it may begin there"
        return RefusedError(Reason.START_MISMATCH, self.mismatch)

    def acknowledge(self) -> None:
        """The next command may begin where the robot stands."""
        if self.mismatch:
            self.mismatch, self.path = "", None
            self._track.clear()
            self.taught[:], self.out[:] = np.nan, np.nan

    # ---- what goes out --------------------------------------------------------------------------

    def take_up(self, now_s: float) -> None:
        """The offset goes on from the path that was put out last."""
        if self.path is not None:
            state, path = self.limiter.state, self.path
            state[OFFSET], rate = path.offset(now_s)
            moving = path.time(now_s) < path.times[-1] and path.live(now_s)
            state[OFFSET_RATE] = rate if moving else 0.0
            state[DESIRED] = state[OFFSET] - path.at(path.withheld, now_s)
            state[DESIRED_RATE], state[SHARE] = 0.0, 1.0

    def reject(self, path: SentPath) -> None:
        """The controller did not take a path: what it took the place of goes on there."""
        path.rejected = True
        while self.path is not None and self.path.rejected:
            self.path = self.path.replaced


def hold_speeds(
    names: Sequence[str], out: Array, dt_s: Array, fastest: Array, what: str = "would move"
) -> None:
    """Refuse steps (m, k) that take less than the joints' speeds (k,) allow in ``dt_s`` (m,)."""
    speed = np.abs(out) / dt_s[:, None]
    over = speed > fastest * (1.0 + ROUNDING)
    if over.any():
        point, j = np.argwhere(over)[0]
        raise RefusedError(
            Reason.VELOCITY_LIMIT,
            f"{names[j]} {what} at {speed[point, j]:.6f}, allowed {fastest[j]:.6f} "
            f"(point {point + 1})",
        )
