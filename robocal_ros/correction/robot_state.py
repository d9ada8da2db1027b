"""What is known of the robot: its joints by name, where it was read, where its controller is."""

from collections import deque

import numpy as np
from numpy.typing import NDArray

from robocal_ros.correction.inputs import JointCommand, Reason, RefusedError, require_finite
from robocal_ros.correction.joint_correction import plain
from robocal_ros.correction.solution import ordinary
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]
Index = NDArray[np.int64]

# A robot follows what it was sent within this: drives lag, messages travel, s.
RESPONSE_S = 0.2
TRACK_S = 0.01  # between two places that are kept, s
# A controller's reference that is older is none, s; of one that moves, which is carried on at its
# speed: one and a half periods of joint_trajectory_controller's default, 50 Hz.
REFERENCE_AGE_S, MOVING_AGE_S = 0.1, 0.03
STANDS = 1e-3  # rad/s (prismatic: m/s): a reference that is slower stands
MOST_TURNS = 4.0 * np.pi  # of a joint, where its limits allow no more
# Readings whose stamp is so far ahead of the clock come from one that is set wrongly, s.
AHEAD_S = 0.1
MOST_LAYOUTS = 16  # of readings, by their joints' names, that are remembered


class RobotState:
    """The arm's joints: where they were read, and where the controller is, by a steady clock.

    Parameters
    ----------
    age_limit_s : readings that are older, by stamp or by arrival, tell nothing.
    near : (n,) a robot that moved by less within `RESPONSE_S` stands, rad (prismatic: m).

    Attributes
    ----------
    measured : (n,) last readings, NaN before the first.
    scaling : how fast the controller's clock runs, 0 to 1; 1 where nobody says.
    """

    def __init__(self, arm: SerialArm, age_limit_s: float, near: Array) -> None:
        self.names, self.count = arm.joint_names, arm.n
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        self._all = np.arange(arm.n, dtype=np.int64)
        self._columns: dict[tuple[str, ...], tuple[tuple[str, ...], Index, Index]] = {}
        self._age_limit_s, self._near = age_limit_s, near
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

    # ---- joints by name -------------------------------------------------------------------------

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

    # ---- where it is ----------------------------------------------------------------------------

    def read(self, index: Index, position: Array, now_s: float, age_s: float) -> None:
        """Take readings (k,) that were ``age_s`` old by their stamp when they came."""
        self.measured[index] = position
        if age_s < -AHEAD_S:  # where the robot is cannot be told by a clock that is wrong
            age_s = np.inf
        self._read_s[index] = now_s - max(age_s, 0.0)
        track = self._track
        if not track or now_s - track[-1][0] >= TRACK_S or now_s < track[-1][0]:
            track.append((now_s, self.measured.copy()))
            while len(track) > 1 and track[1][0] <= now_s - RESPONSE_S:
                track.popleft()

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

    def fresh(self, index: Index, now_s: float) -> bool:
        """Whether all these joints were read lately."""
        return bool(np.all(now_s - self._read_s[index] <= self._age_limit_s))

    def stands(self, index: Index, now_s: float) -> bool:
        """Whether these joints were read, and moved by less than ``near`` for the response time."""
        track = self._track
        if not track or track[0][0] > now_s - RESPONSE_S + TRACK_S or not self.fresh(index, now_s):
            return False
        here = self.measured[index]
        moved = [self.unwrapped(index, q[index], here) - here for _, q in track]
        return bool(np.all(np.abs(moved) < self._near[index]))

    def unwrapped(self, index: Index, position: Array, q: Array) -> Array:
        """Positions (k,), those of joints without limits at the turn nearest to ``q`` (k,)."""
        turns = np.where(self._continuous[index], np.round((q - position) / (2.0 * np.pi)), 0.0)
        return np.asarray(position + 2.0 * np.pi * turns)


def _require_single(names: tuple[str, ...]) -> None:
    if len(set(names)) != len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise RefusedError(Reason.DOUBLED_JOINT, doubled)
