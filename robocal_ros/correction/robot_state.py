"""Where the robot was read, where its controller is, and what was put out last."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    RefusedError,
    TrajectoryCommand,
    require_finite,
)
from robocal_ros.correction.joint_correction import StagedCorrection, plain
from robocal_ros.correction.limiter import (
    DESIRED,
    DESIRED_RATE,
    OFFSET,
    OFFSET_RATE,
    OUT,
    ROUNDING,
    SHARE,
    TAUGHT,
    OffsetLimiter,
)
from robocal_ros.correction.solution import ordinary
from robocal_ros.ground.frames import Array, Index
from robocal_ros.kinematics import SerialArm

# A robot follows what it was sent within this: drives lag, messages travel, s.
RESPONSE_S = 0.2
TRACK_S = 0.01  # between two places that are kept, s
# A controller's reference that is older is none, s; of one that moves, which is carried on at its
# speed: one and a half periods of joint_trajectory_controller's default, 50 Hz.
REFERENCE_AGE_S, MOVING_AGE_S = 0.1, 0.03
# Turning rad, sliding m: no drive leaves its reference so far aside, but for its lag.
STRAYS = {False: 0.02, True: 0.01}
STANDS = 1e-3  # rad/s (prismatic: m/s): a reference that is slower stands
MOST_TURNS = 4.0 * np.pi  # of a joint, where its limits allow no more
# Readings whose stamp is so far ahead of the clock come from one that is set wrongly, s.
AHEAD_S = 0.1
MOST_LAYOUTS = 16  # of readings, by their joints' names, that are remembered


class RobotState:
    """The arm's joints: where they were read, and where the controller is, by a steady clock.

    ``age_limit_s``: readings that are older, by stamp or by arrival, tell nothing. ``near`` (n,): a
    robot that moved by less within `RESPONSE_S` stands, rad (prismatic: m).
    ``measured`` (n,): last readings, NaN before the first. ``scaling``: how fast the controller's
    clock runs, 0 to 1; 1 where nobody says.
    """

    def __init__(self, arm: SerialArm, age_limit_s: float, near: Array) -> None:
        self.names, self.count = arm.joint_names, arm.n
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        self._all = np.arange(arm.n, dtype=np.int64)
        self._columns: dict[tuple[str, ...], tuple[tuple[str, ...], Index, Index]] = {}
        self._age_limit_s, self._near = age_limit_s, near
        self._strays = np.maximum(near, np.where(arm.prismatic, STRAYS[True], STRAYS[False]))
        limit = np.maximum(np.abs(arm.lower), np.abs(arm.upper))
        turns = np.where(np.isfinite(limit), np.maximum(limit, MOST_TURNS), np.inf)
        self._turns, self._tenfold = np.where(arm.prismatic, np.inf, turns), 10.0 * limit
        self._doubtful = np.minimum(self._turns, self._tenfold)
        self._endless = np.full(arm.n, np.finfo(np.float64).max)
        self._continuous = ~arm.prismatic & ~(np.isfinite(arm.lower) & np.isfinite(arm.upper))
        self.measured = np.full(arm.n, np.nan)
        self._read_s = np.full(arm.n, -np.inf)
        self._track: deque[tuple[float, Array]] = deque()
        self._reference, self._reference_s = np.full(arm.n, np.nan), np.full(arm.n, -np.inf)
        self._reference_rate = np.zeros(arm.n)
        self.scaling = 1.0

    def index(self, names: tuple[str, ...]) -> Index:
        """Numbers (k,) of the arm's joints; raises `RefusedError` for a name that is no such."""
        index = self._indices.get(names)
        if index is None:
            unknown = [name for name in names if name not in self._number]
            if unknown or not names:
                detail = f"{', '.join(unknown) or 'no name'}; the arm has {', '.join(self.names)}"
                raise RefusedError(Reason.UNKNOWN_JOINT, detail)
            _require_single(names)
            index = np.array([self._number[name] for name in names], dtype=np.int64)
            self._indices = {names: self._all if names == self.names else index}
            index = self._indices[names]
        return index

    def require_positions(self, names: tuple[str, ...], index: Index, position: Array) -> None:
        """Refuse positions (m, k) that are not finite, too few, or can only be degrees."""
        if position.shape[1] != len(names):
            detail = f"{len(names)} names but {position.shape[1]} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        if len(position) == 1 and ordinary(plain(position[0]), self._doubtful, index):
            return
        require_finite(names, position)
        size = np.abs(position)
        if not (size > self._doubtful[index]).any():
            return
        if np.any(size > self._turns[index]):
            point, column = np.argwhere(size > self._turns[index])[0]
            detail = f"{self.names[index[column]]} at {position[point, column]:g} rad"
            raise RefusedError(Reason.DEGREES, detail)
        if np.any(np.all(size > self._tenfold[index], axis=1)):
            raise RefusedError(Reason.DEGREES, "all joints are beyond ten times their limits")

    def require_velocities(self, names: tuple[str, ...], index: Index, velocity: Array) -> None:
        """Refuse velocities (k,) that are not finite, or of another number."""
        if len(velocity) != len(index):
            detail = f"{len(names)} names but {len(velocity)} velocities"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        if not ordinary(plain(velocity), self._endless, index):
            require_finite(names, velocity[None])

    def complete(self, index: Index, position: Array, taught: Array, now_s: float) -> Array:
        """All joints (m, n) of a command (m, k); those that it leaves out stay where they are.

        ``taught`` (n,): un-corrected readings. Raises `RefusedError` where one that is left out
        was never read, or not lately.
        """
        if index is self._all:
            return position.copy()
        if len(index) == self.count:
            q = np.empty_like(position)
        else:
            rest = np.setdiff1d(np.arange(self.count), index)
            absent = [self.names[i] for i in rest if not np.isfinite(taught[i])]
            if absent:
                raise RefusedError(Reason.MISSING_JOINT, ", ".join(absent))
            self.require_fresh(rest, now_s)
            q = np.tile(taught, (len(position), 1))
        q[:, index] = position
        return q

    def find(self, state: JointCommand) -> tuple[Index, Index]:
        """Numbers of the arm's joints in readings, and their columns; joints of others are left."""
        if len(state.position) != len(state.names):
            detail = f"{len(state.names)} names but {len(state.position)} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        known = self._columns.get(state.names)
        if known is None:
            _require_single(state.names)
            columns = [i for i, name in enumerate(state.names) if name in self._number]
            names = tuple(state.names[i] for i in columns)
            index = np.array([self._number[name] for name in names], dtype=np.int64)
            known = names, index, np.array(columns, dtype=np.int64)
            if len(self._columns) >= MOST_LAYOUTS:
                self._columns.clear()
            self._columns[state.names] = known
        names, index, column = known
        self.require_positions(names, index, state.position[column][None])
        return index, column

    def read(self, index: Index, position: Array, now_s: float, age_s: float) -> None:
        """Take readings (k,) that were ``age_s`` old by their stamp when they came."""
        self.measured[index] = position
        if age_s < -AHEAD_S:  # where the robot is cannot be told by a clock that is wrong
            age_s = np.inf
        self._read_s[index] = now_s - max(age_s, 0.0)
        if _due(self._track, now_s):
            self._track.append((now_s, self.measured.copy()))

    def controller(
        self,
        index: Index,
        reference: Array,
        velocity: Array | None,
        scaling: float | None,
        told_s: float,
    ) -> None:
        """Where the controller was at ``told_s``: its reference (k,), and velocities as planned.

        ``scaling``: how fast its clock runs. Without velocities those are as from the last
        reference to this.
        """
        if scaling is not None and np.isfinite(scaling):
            self.scaling = float(np.clip(scaling, 0.0, 1.0))
        if velocity is None:
            since = told_s - self._reference_s[index]
            lately = (since > 0.0) & (since <= REFERENCE_AGE_S)
            moved = np.where(lately, reference - self._reference[index], 0.0)
            self._reference_rate[index] = moved / np.where(lately, since, 1.0)
        else:
            self._reference_rate[index] = velocity * self.scaling
        self._reference[index], self._reference_s[index] = reference, told_s

    def reference(self, index: Index, now_s: float) -> Array | None:
        """Where the controller is by its own words (k,), where they are known and fresh."""
        rate, age_s = self._reference_rate[index], now_s - self._reference_s[index]
        moves = bool(np.any(np.abs(rate) > STANDS))
        if not np.all(age_s <= (MOVING_AGE_S if moves else REFERENCE_AGE_S)):
            return None
        return np.asarray(self._reference[index] + rate * np.maximum(age_s, 0.0))

    def elsewhere(self, index: Index, place: Array, now_s: float) -> Array:
        """Which joints (k,) were read lately beside ``place`` (k,), by more than robots lag."""
        here = self.unwrapped(index, self.measured[index], place)
        age_s = now_s - self._read_s[index]
        fastest = np.abs(self._reference_rate[index])
        if self._track:
            since_s, before = self._track[0]
            way = np.abs(self.measured - before)[index]
            fastest = np.fmax(fastest, way / max(now_s - since_s, TRACK_S))
        late_s = RESPONSE_S + np.clip(age_s, 0.0, self._age_limit_s)
        reach = self._strays[index] + late_s * fastest
        return np.asarray((age_s <= self._age_limit_s) & (np.abs(here - place) > reach))

    def require_fresh(self, index: Index, now_s: float) -> None:
        """Refuse while one of these joints has not been read, or not lately."""
        absent = [self.names[i] for i in index if not np.isfinite(self.measured[i])]
        if absent:
            detail = f"no joint state of {', '.join(absent)} has arrived"
            raise RefusedError(Reason.STALE_JOINTS, detail)
        i = index[int(np.argmin(self._read_s[index]))]
        age_s = now_s - self._read_s[i]
        if age_s > self._age_limit_s:
            detail = f"{self.names[i]} was read {age_s:.3f} s ago, allowed {self._age_limit_s:g} s"
            if not np.isfinite(age_s):
                detail = f"the stamp of {self.names[i]} is over {AHEAD_S:g} s ahead of the clock"
            raise RefusedError(Reason.STALE_JOINTS, detail)

    def require_track(self, now_s: float) -> None:
        """Refuse while it cannot be told whether the robot stands, as it is read for too short."""
        read_s = now_s - self._track[0][0] if self._track else 0.0
        if read_s < RESPONSE_S - TRACK_S:
            detail = f"read for {read_s:.3f} s, {RESPONSE_S:g} s tell whether the robot stands"
            raise RefusedError(Reason.STALE_JOINTS, detail)

    def stands(self, index: Index, now_s: float) -> bool:
        """Whether these joints were read, and moved by less than ``near`` for the response time."""
        track = self._track
        fresh = np.all(now_s - self._read_s[index] <= self._age_limit_s)
        if not track or track[0][0] > now_s - RESPONSE_S + TRACK_S or not fresh:
            return False
        here = self.measured[index]
        moved = [self.unwrapped(index, q[index], here) - here for _, q in track]
        return bool(np.all(np.abs(moved) < self._near[index]))

    def unwrapped(self, index: Index, position: Array, q: Array) -> Array:
        """Positions (k,), those of joints without limits at the turn nearest to ``q`` (k,)."""
        turns = np.where(self._continuous[index], np.round((q - position) / (2.0 * np.pi)), 0.0)
        return np.asarray(position + 2.0 * np.pi * turns)


def _due(track: deque[tuple[float, Array]], now_s: float) -> bool:
    """Let go of places of before the response time; whether another one is to be kept now."""
    while len(track) > 1 and track[1][0] <= now_s - RESPONSE_S:
        track.popleft()
    return not track or now_s - track[-1][0] >= TRACK_S or now_s < track[-1][0]


def _require_single(names: tuple[str, ...]) -> None:
    if len(set(names)) != len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise RefusedError(Reason.DOUBLED_JOINT, doubled)


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
        if t < times[0]:
            lead = times[0] + self.begin_s - self.put_s
            part = np.clip((times[0] - t) / lead, 0.0, 1.0) if lead > 0.0 else 0.0
            return np.asarray(out[0] + part * (self.led_from - out[0]))
        return driven(times, out, self.command.velocity, self.command.acceleration, t)

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


class Output:
    """What was put out last for each joint."""

    def __init__(self, arm: SerialArm, config: CorrectionConfig, state: RobotState) -> None:
        self._state, self._near = state, config.start_near(arm)
        self._fastest = config.velocity_limits
        # the offsets of a stream, and of the begin of what comes next
        self.limiter = OffsetLimiter(arm.prismatic, config.turning, config.sliding)
        self.stage: StagedCorrection | None = None  # of the last target
        self.out_s = -np.inf  # when
        self.path: SentPath | None = None  # put out since; None after a target
        self.mismatch = ""  # why nothing goes out until it is acknowledged
        self._track: deque[tuple[float, Array]] = deque()  # where the controller was sent lately

    @property
    def taught(self) -> Array:
        """(n,) the last target, as it was followed; NaN before any."""
        return self.limiter.memory[TAUGHT]

    @property
    def out(self) -> Array:
        """(n,) what went out for it."""
        return self.limiter.memory[OUT]

    def correction(self, now_s: float) -> tuple[StagedCorrection | None, Array]:
        """The correction in what is put out now, and what the limiter adds to it (n,)."""
        if self.path is not None:
            return self.path.stage, self.path.withheld(now_s)
        return self.stage, self.limiter.withheld

    def uncorrected(self, corrected: Array, now_s: float) -> Array:
        """Taught joints (n,) of corrected ones; of readings in part as they are."""
        stage, withheld = self.correction(now_s)
        bare = corrected - withheld
        if stage is None or not np.isfinite(bare).all():
            return bare
        return stage.uncorrect_one(bare)

    def place(self, index: Index, q: Array, now_s: float) -> tuple[Array, bool]:
        """Where the controller is (k,), and whether that is known better than by readings.

        Its reference where it tells it; else what it was sent, where the robot is there or on its
        way; else where the robot stands, joints without limits at the turn nearest to ``q`` (k,):
        what reads them may count no turns, what drives them does.

        Raises `RefusedError` when readings are missing, old or too few, or the robot moves and not
        by what was put out, or was read elsewhere than its controller says.
        """
        state = self._state
        known = state.reference(index, now_s)
        if known is not None:
            if (elsewhere := state.elsewhere(index, known, now_s)).any():
                j = int(np.argmax(elsewhere))
                raise self.refuse(
                    f"{state.names[index[j]]} was read at {state.measured[index[j]]:.6f}, and "
                    f"controller_state has it at {known[j]:.6f}: it is of another controller, or "
                    "the robot does not follow"
                )
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
        state.require_track(now_s)
        raise self.refuse("the robot moves, and where its controller is is not known")

    def note_place(self, now_s: float) -> None:
        """Keep where the controller is sent now, for robots that lag."""
        if _due(self._track, now_s):
            self._track.append((now_s, self._sent(now_s)))

    def _sent(self, now_s: float) -> Array:
        """Where the controller was sent by now (n,); NaN where nothing was."""
        sent = self.out.copy()
        if self.path is not None:
            sent[self.path.index] = self.path.place(now_s)
        return sent

    def begin_at(self, index: Index, q: Array, begins: Array, now_s: float) -> Array:
        """Offsets (k,) with which joints may begin at once at taught ones ``q`` (n,).

        The controller must be where they begin with an offset between the last one, the one that
        readings are un-corrected with, and those that a robot may show, ``begins`` (r, n). Raises
        `RefusedError` as `place`, and when it is elsewhere.
        """
        place, exact = self.place(index, q[index], now_s)
        here = self._state.measured.copy()
        here[index] = place
        known = np.vstack([begins, here - self.uncorrected(here, now_s)])  # as readings are told
        offset, beside = self._taken_up(index, place - q[index], known, exact=exact)
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
    ) -> tuple[Array | None, Array]:
        """Taught joints (n,) and offset (n,) from where a command leads in to ``q`` (n,).

        The taught joints are None where the controller is at its first point already. Where it is
        not known where the controller is, it is where the robot was read.
        """
        everything, before = np.arange(self._state.count), self.mismatch
        try:
            place, exact = self.place(everything, q, now_s)
        except RefusedError:
            self.mismatch = before
            place, exact = self._state.measured.copy(), False
        offset, beside = self._taken_up(index, (place - q)[index], begins, exact=exact)
        if np.all(beside <= 1.0):
            whole = place - q
            whole[index] = offset
            return None, whole
        if exact and self.path is not None and self.path.live(now_s):
            taught = place - self.path.offset(now_s)[0]
        else:  # with the offset that readings are told with
            taught = self.uncorrected(place, now_s)
        return taught, place - taught

    def refuse(self, detail: str) -> RefusedError:
        """A mismatch, which lasts until it is acknowledged."""
        self.mismatch = f"{detail}; call ~/acknowledge when it may begin there"
        return RefusedError(Reason.START_MISMATCH, self.mismatch)

    def acknowledge(self, now_s: float) -> None:
        """The next command may begin where the robot stands; readings are told as before."""
        self.take_up(now_s)
        self.stage, _ = self.correction(now_s)
        self.mismatch, self.path = "", None
        self.limiter.state[OFFSET_RATE] = 0.0
        self._track.clear()
        self.taught[:], self.out[:] = np.nan, np.nan

    def take_up(self, now_s: float) -> None:
        """The offset goes on from the path that was put out last."""
        if self.path is not None:
            state, path = self.limiter.state, self.path
            state[OFFSET], rate = path.offset(now_s)
            moving = path.time(now_s) < path.lasts_s and path.live(now_s)
            state[OFFSET_RATE] = rate if moving else 0.0
            state[DESIRED] = state[OFFSET] - path.withheld(now_s)
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
