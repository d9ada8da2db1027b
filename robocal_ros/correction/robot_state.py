# SPDX-License-Identifier: Apache-2.0
"""Where the robot was read, where its controller is, and what was put out last."""

import math
import sys
from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike

from robocal_ros.correction.bounds import CorrectionConfig, DesiredOffset
from robocal_ros.correction.interface import (
    JointCommand,
    Reason,
    RefusedError,
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
)
from robocal_ros.correction.sent_path import RESPONSE_S, SentPath
from robocal_ros.correction.solution import ordinary
from robocal_ros.ground.frames import Array, Index
from robocal_ros.kinematics import SerialArm
from robocal_ros.motion.robot_watch import STANDS_S

TRACK_S = 0.01  # between two places of the controller that are kept, s
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
# Numbers or columns of joints; all of them in the arm's own order, which NumPy takes faster so.
Joints = Index | slice
EVERY = slice(None)
# A velocity is of readings of the last so many seconds, of five at least: a wild one is outvoted.
VELOCITY_S, LEAST = 0.05, 5
LEAST_TRACK_S = 0.02  # readings that span less tell no speed
FARTHEST = 1e9  # rad or m; of what is beyond no speed is finite
LAG_S = 0.03  # by so much the robot, and what is known of it, may follow its controller late
FOLLOWED = 25  # instants of a path that a place is compared with
DECELERATION = {False: 10.0, True: 1.0}  # turning rad/s^2, sliding m/s^2, where none is known


class RobotState:
    """The arm's joints: where they were read, and where the controller is, by a steady clock.

    ``age_limit_s``: readings that are older, by stamp or by arrival, tell nothing. ``near`` (n,): a
    robot that moved by less within `RESPONSE_S` stands, rad (prismatic: m). ``doubtful`` (n,): a
    position beyond it may not be one.
    ``fastest`` (n,): no joint is faster, rad/s (m/s).
    ``measured``, ``velocity`` (n,): last readings, NaN before the first, and where there is none.
    ``scaling``: how fast the controller's clock runs, 0 to 1; 1 where nobody says. ``held_s``: when
    one that pauses was last seen to give up a motion. ``told``: joints and unscaled velocities (n,)
    where it is by its own words, whatever its clock says, and of when these are; None: not known.
    """

    def __init__(
        self, arm: SerialArm, age_limit_s: float, near: Array, fastest: ArrayLike = np.inf
    ) -> None:
        self.names, self.count = arm.joint_names, arm.n
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        self._all = np.arange(arm.n, dtype=np.int64)
        self._columns: dict[tuple[str, ...], tuple[tuple[str, ...], Index, Joints, Joints]] = {}
        self._age_limit_s, self._near = age_limit_s, near
        self._strays = np.maximum(near, np.where(arm.prismatic, STRAYS[True], STRAYS[False]))
        limit = np.maximum(np.abs(arm.lower), np.abs(arm.upper))
        turns = np.where(np.isfinite(limit), np.maximum(limit, MOST_TURNS), np.inf)
        self._turns, self._tenfold = np.where(arm.prismatic, np.inf, turns), 10.0 * limit
        # finite, so that infinity is beyond it for a joint without limits too
        self.doubtful = np.minimum(np.minimum(self._turns, self._tenfold), sys.float_info.max)
        self._continuous = ~arm.prismatic & ~(np.isfinite(arm.lower) & np.isfinite(arm.upper))
        changes = np.where(arm.prismatic, DECELERATION[True], DECELERATION[False])
        self._turned = 0.5 * VELOCITY_S * changes + near / LEAST_TRACK_S
        self._fastest = np.broadcast_to(fastest, (arm.n,))
        self.measured, self.velocity = np.full((2, arm.n), np.nan)
        self._read_s = np.full(arm.n, -np.inf)  # by stamp too
        self._heard_s = np.full(arm.n, -np.inf)
        self._track: deque[tuple[float, Array]] = deque()  # of `RESPONSE_S`
        self._whole_s = -np.inf  # since when it is without a gap
        self._place, self._place_s = np.full(arm.n, np.nan), np.inf  # where it stands, since when
        self._reference, self._reference_s = np.full(arm.n, np.nan), np.full(arm.n, -np.inf)
        self._reference_rate = np.zeros(arm.n)
        self.scaling, self.held_s = 1.0, -np.inf
        self.told: Callable[[float], tuple[Array, Array, float] | None] = lambda now_s: None

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
        require_finite(names, position)
        size = np.abs(position)
        if not (size > self.doubtful[index]).any():
            return
        if np.any(size > self._turns[index]):
            point, column = np.argwhere(size > self._turns[index])[0]
            detail = f"{self.names[index[column]]} at {position[point, column]:g} rad"
            raise RefusedError(Reason.DEGREES, detail)
        if np.any(np.all(size > self._tenfold[index], axis=1)):
            raise RefusedError(Reason.DEGREES, "all joints are beyond ten times their limits")

    def require_target(self, command: JointCommand, index: Index) -> None:
        """As `require_positions`, and velocities that are not finite, or of another number."""
        names, position, velocity = command.names, command.position, command.velocity
        usual = len(position) == len(names) and ordinary(plain(position), self.doubtful, index)
        if not usual:
            self.require_positions(names, index, position[None])
        if velocity is None:
            return
        if len(velocity) != len(names):
            detail = f"{len(names)} names but {len(velocity)} velocities"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        if not math.isfinite(sum(velocity.tolist())):
            require_finite(names, velocity[None])

    def complete(self, index: Index, position: Array, taught: Array, now_s: float) -> Array:
        """All joints (..., n) of a command (..., k); those that it leaves out stay where they are.

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
            q = np.broadcast_to(taught, (*position.shape[:-1], self.count)).copy()
        q[..., index] = position
        return q

    def find(self, state: JointCommand) -> tuple[Joints, Joints]:
        """Numbers of the arm's joints in readings, and their columns; joints of others are left.

        Raises `RefusedError` as `require_positions`, and for a joint that is named twice.
        """
        if len(state.position) != len(state.names):
            detail = f"{len(state.names)} names but {len(state.position)} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        known = self._columns.get(state.names)
        if known is None:
            _require_single(state.names)
            columns = [i for i, name in enumerate(state.names) if name in self._number]
            names = tuple(state.names[i] for i in columns)
            index = np.array([self._number[name] for name in names], dtype=np.int64)
            known = names, index, index, np.array(columns, dtype=np.int64)
            if state.names == self.names:
                known = names, index, EVERY, EVERY
            if len(self._columns) >= MOST_LAYOUTS:
                self._columns.clear()
            self._columns[state.names] = known
        names, index, joints, column = known
        position = state.position[column]
        if not ordinary(plain(position), self.doubtful, index):
            self.require_positions(names, index, position[None])
        return joints, column

    def read(
        self,
        index: Joints,
        position: Array,
        now_s: float,
        age_s: float = 0.0,
        velocity: Array | None = None,
        late_s: float = 0.0,
    ) -> None:
        """Take readings (k,) that were ``age_s`` old by their stamp when they came.

        ``late_s``: they are so much older than when they came, whatever the clocks differ by.
        """
        if not len(position):  # another driver's: where the arm was last is not where it is
            return
        at_s = now_s - late_s
        blind = self.blind(at_s)
        if blind:
            self._whole_s = at_s
        self.measured[index], self._heard_s[index] = position, at_s
        self.velocity[index] = np.nan if velocity is None else velocity
        if age_s < -AHEAD_S:  # where the robot is cannot be told by a clock that is wrong
            age_s = np.inf
        self._read_s[index] = now_s - max(age_s, late_s)
        while len(self._track) > 1 and self._track[1][0] <= at_s - RESPONSE_S:
            self._track.popleft()
        self._track.append((at_s, self.measured.copy()))
        if blind or not ordinary(self.measured - self._place, self._near, self._all):
            self._place, self._place_s = self.measured.copy(), at_s

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

    def tracked_s(self, now_s: float) -> float:
        """For how long readings are known, up to the response time."""
        return now_s - self._track[0][0] if self._track else 0.0

    def stands(self, index: Index, now_s: float) -> bool:
        """Whether these joints were read, and moved by less than ``near`` for the response time."""
        track = self._track
        fresh = np.all(now_s - self._read_s[index] <= self._age_limit_s)
        if self.tracked_s(now_s) < RESPONSE_S - TRACK_S or not fresh:
            return False
        here, places = self.measured[index], np.array([q for _, q in track])
        moved = self.unwrapped(index, places[:, index], here) - here
        return bool(np.all(np.abs(moved) < self._near[index]))

    def unwrapped(self, index: Index, position: Array, q: Array) -> Array:
        """Positions (..., k), those of joints without limits at the turn nearest to ``q`` (k,)."""
        turns = np.where(self._continuous[index], np.round((q - position) / (2.0 * np.pi)), 0.0)
        return np.asarray(position + 2.0 * np.pi * turns)

    # By when readings came, less what they were late, and gaps in them: what a stop is planned
    # from and watched by, see `motion.stopping`.

    @property
    def heard_s(self) -> float:
        """Of when the oldest joint's reading is."""
        return min(self._heard_s.tolist())

    def blind(self, now_s: float) -> bool:
        """Whether a joint has not come for longer than the age limit."""
        return not now_s - self.heard_s <= self._age_limit_s

    def here(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and speeds (n,) now; None where they were not all read lately.

        Those read last, where the readings of before bear them out; else those of most readings
        (Theil-Sen: the medians of the slopes of pairs, and of where each reading puts it): a stop
        from a single wild reading would be a motion of its own.
        """
        if self.blind(now_s):
            return None
        read = self.measured.clip(-FARTHEST, FARTHEST)
        # some drivers say 0 in motion
        place, speed = read, self.velocity if self.velocity.any() else np.nan * self.velocity
        times, q = self._recent()
        i, j = np.triu_indices(len(times), 1)
        apart = times[j] - times[i] >= LEAST_TRACK_S
        if apart.any():
            i, j = i[apart], j[apart]
            slope = np.median((q[j] - q[i]) / (times[j] - times[i])[:, None], axis=0)
            middle = np.median(q + (times[-1] - times)[:, None] * slope, axis=0)
            speed = np.where(np.abs(speed - slope) <= self._turned, speed, slope)
            beside = self._turned * max(float(times[-1] - times[0]), LEAST_TRACK_S)
            place = np.where(np.abs(read - middle) <= beside, read, middle)
        here = place + speed * (now_s - self.heard_s)
        return (here, speed) if np.isfinite(here).all() else None

    def _recent(self) -> tuple[Array, Array]:
        """Times (m,) and joints (m, n) of the readings that tell a speed."""
        track = [row for row in self._track if row[0] >= self._whole_s]
        since_s = track[-1][0] - VELOCITY_S
        recent = track[-max(sum(at_s >= since_s for at_s, _ in track), LEAST) :]
        times, q = np.array([at_s for at_s, _ in recent]), np.array([place for _, place in recent])
        return times, q.clip(-FARTHEST, FARTHEST)

    def to_stop(self, now_s: float) -> tuple[Array, Array] | None:
        """Joints and speeds (n,) to stop from: the controller's, where the robot follows it.

        None where nobody knows where the robot is. One that pauses is held.
        """
        here = self.here(now_s)
        if here is None:
            return None
        q, qd = self._followed(here, now_s) or here
        return q, np.clip(qd, -self._fastest, self._fastest) * (self.scaling > 0.0)

    def _followed(self, here: tuple[Array, Array], now_s: float) -> tuple[Array, Array] | None:
        """Where the controller is, if the robot is ``here`` but for its lag."""
        told = self.told(now_s)
        if told is None:
            return None
        reach = LAG_S * (np.abs(told[1]) + np.abs(here[1])) + self._near
        return told[:2] if np.all(np.abs(told[0] - here[0]) < reach) else None

    def speed(self, now_s: float) -> float:
        """Of the fastest joint, unscaled; of one that pauses as read; NaN where it is not known."""
        here = self.here(now_s)
        if here is None:
            return float("nan")
        told = self._followed(here, now_s) if self.scaling > 0.0 else None
        if told is not None:
            return float(np.max(np.abs(told[1])))
        return float(np.max(np.abs(here[1]))) / (max(self.scaling, 0.1) if self.scaling else 1.0)

    def seen_s(self, now_s: float) -> float:
        """What the robot is sent shows so late: what comes seldom or late tells an older speed."""
        if self.blind(now_s):
            return np.inf
        times, _ = self._recent()
        span_s, told = float(times[-1] - times[0]), self.told(now_s)
        read_s = float(times[-1]) - max(0.5 * (span_s - VELOCITY_S), 0.0)
        return LAG_S + now_s - (read_s if told is None else min(read_s, told[2]))

    def at_rest(self, now_s: float) -> bool:
        """Whether all joints were read lately, and by these have not moved for `STANDS_S`."""
        return self.stood_s(now_s) >= STANDS_S

    def stood_s(self, now_s: float) -> float:
        """How long the joints were read in one place; 0 where they were not all read lately."""
        return 0.0 if self.blind(now_s) else max(self.heard_s - self._place_s, 0.0)

    def follows(self, path: SentPath, now_s: float) -> bool:
        """Whether the robot is where a path has it, or was lately; True where it is not known."""
        if self.here(now_s) is None:
            return True
        times = np.linspace(self.heard_s - RESPONSE_S, now_s + LAG_S, FOLLOWED)
        places = np.array([path.place(t) for t in times])
        near = self._near[path.index]
        q = self.unwrapped(path.index, self.measured[path.index], places[-1])
        return bool(np.all((q > places.min(axis=0) - near) & (q < places.max(axis=0) + near)))


def _require_single(names: tuple[str, ...]) -> None:
    if len(set(names)) != len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise RefusedError(Reason.DOUBLED_JOINT, doubled)


class Output:
    """What was put out last for each joint, and by what: of streams and trajectories alike."""

    def __init__(self, arm: SerialArm, config: CorrectionConfig) -> None:
        self.arm, self.config = arm, config
        # (n,) how far from where a command begins each joint may stand, rad (prismatic: m)
        self.near = np.where(arm.prismatic, config.start_m, config.start_rad)
        self.robot = RobotState(arm, config.joint_state_age_s, self.near, config.velocity_limits)
        self.desired = DesiredOffset(arm, config)
        # of a stream, and of the begin of what comes next
        self.limiter = self.desired.limiter
        # (n,) the last target, as it was followed, and what went out for it; NaN before any
        self.taught, self.out = self.limiter.memory[TAUGHT], self.limiter.memory[OUT]
        self.stage: StagedCorrection | None = None  # of the last target
        self.out_s = -np.inf  # when
        self.path: SentPath | None = None  # put out since; None after a target
        self.mismatch = ""  # why nothing goes out until it is acknowledged
        self._track: deque[tuple[float, Array]] = deque()  # where the controller was sent lately

    def correction(self, now_s: float) -> tuple[StagedCorrection | None, Array]:
        """The correction in what is put out now, and what the limiter adds to it (n,)."""
        if self.path is not None:
            return self.path.stage, self.path.withheld(now_s)
        return self.stage, self.limiter.withheld

    def uncorrected(
        self, corrected: Array, correction: tuple[StagedCorrection | None, Array]
    ) -> Array:
        """Taught joints (n,) of corrected ones, by what `correction` gives; in part as they are."""
        stage, withheld = correction
        bare = corrected - withheld
        if stage is None or not math.isfinite(sum(bare.tolist())):
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
        state = self.robot
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
        measured, near = state.measured[index], self.near[index]
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
        if (read_s := state.tracked_s(now_s)) < RESPONSE_S - TRACK_S:
            detail = f"read for {read_s:.3f} s, {RESPONSE_S:g} s tell whether the robot stands"
            raise RefusedError(Reason.STALE_JOINTS, detail)
        raise self.refuse("the robot moves, and where its controller is is not known")

    def note_place(self, now_s: float) -> None:
        """Keep where the controller is sent now, for robots that lag."""
        track = self._track
        if track and 0.0 <= now_s - track[-1][0] < TRACK_S:
            return
        while len(track) > 1 and track[1][0] <= now_s - RESPONSE_S:
            track.popleft()
        track.append((now_s, self._sent(now_s)))

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
        here = self.robot.measured.copy()
        here[index] = place
        told = here - self.uncorrected(here, self.correction(now_s))  # as readings are
        known = np.vstack([begins, told])
        offset, beside = self._taken_up(index, place - q[index], known, exact=exact)
        if np.any(beside > 1.0):
            j = int(np.argmax(beside))
            raise self.refuse(
                f"{self.robot.names[index[j]]} is at {place[j]:.6f}, and the command begins at "
                f"{q[index[j]]:.6f}, corrected at {(q + begins[0])[index[j]]:.6f}"
            )
        return offset

    def _taken_up(
        self, index: Index, offset: Array, begins: Array, *, exact: bool
    ) -> tuple[Array, Array]:
        """Offsets (k,) to begin with, and how far (k,) beside those known, in units of ``near``.

        Readings have noise and drives sag: one that is not exact is the nearest one known.
        """
        near = self.near[index]
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
        everything, before = np.arange(self.robot.count), self.mismatch
        try:
            place, exact = self.place(everything, q, now_s)
        except RefusedError:
            self.mismatch = before
            place, exact = self.robot.measured.copy(), False
        offset, beside = self._taken_up(index, (place - q)[index], begins, exact=exact)
        if np.all(beside <= 1.0):
            whole = place - q
            whole[index] = offset
            return None, whole
        if exact and self.path is not None and self.path.live(now_s):
            taught = place - self.path.offset(now_s)[0]
        else:  # with the offset that readings are told with
            taught = self.uncorrected(place, self.correction(now_s))
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
    names: Sequence[str], speed: Array, fastest: Array, what: str = "would move"
) -> None:
    """Refuse speeds (m, k) beyond those of the joints (k,)."""
    speed = np.abs(speed)
    over = ~(speed <= fastest * (1.0 + ROUNDING))
    if over.any():
        point, j = np.argwhere(over)[0]
        raise RefusedError(
            Reason.VELOCITY_LIMIT,
            f"{names[j]} {what} at {speed[point, j]:.6f}, allowed {fastest[j]:.6f} "
            f"(point {point + 1})",
        )
