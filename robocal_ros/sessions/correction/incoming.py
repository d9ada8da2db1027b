"""What comes in: joints by name, their last known state, order in time, own output."""

from collections import Counter, deque
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.joint_correction.starting import RESPONSE_S, Whereabouts
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.sessions.correction.inputs import JointCommand

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Answer = TypeVar("Answer")

READING = "joint reading"
TARGET = "joint target"
TRAJECTORY = "trajectory"

# A message this much older than the last one comes from a clock that was set back.
CLOCK_RESET_NS = 1_000_000_000
# Own output comes back as it was, or rounded (float32: 2.4e-7 rad): nearer than this, and nearer
# than a share of what it was shifted by; so a target that is sent again is not taken for it.
ROUNDED = 1e-6
OF_SHIFT = 0.25
SHIFTED = 1e-9
ECHOES = 64  # a loop brings one of so many outputs back
MOST_TURNS = 4.0 * np.pi  # of a joint, where its limits allow no more
MOST_STAMPS = 64  # of so many drivers, or planners, the order in time is watched
TRACK_S = 0.01  # between the places that tell how far the robot moved


class JointBook:
    """Knows the arm's joints and where they are; ``age_limit_s`` is how old a reading may be.

    Attributes
    ----------
    measured : (n,) last readings, NaN before the first.
    taught : (n,) the same, un-corrected.
    """

    def __init__(self, arm: SerialArm, age_limit_s: float) -> None:
        self._names = arm.joint_names
        self._age_limit_s = age_limit_s
        self._read_s = np.full(arm.n, -np.inf)
        self._track: deque[tuple[float, Array]] = deque()
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        limit = np.maximum(np.abs(arm.lower), np.abs(arm.upper))
        turns = np.where(np.isfinite(limit), np.maximum(limit, MOST_TURNS), MOST_TURNS)
        self._turns, self._tenfold = np.where(arm.prismatic, np.inf, turns), 10.0 * limit
        self._doubtful = np.minimum(self._turns, self._tenfold)
        self.measured = np.full(arm.n, np.nan)
        self.taught = np.full(arm.n, np.nan)

    @property
    def count(self) -> int:
        """Number of the arm's joints."""
        return len(self._names)

    def where(self, now_s: float) -> Whereabouts:
        """Where the robot is, how far it moved lately, and how old this is."""
        places = np.array([q for t, q in self._track if t >= now_s - RESPONSE_S] or [self.measured])
        travel = np.max(np.abs(places - self.measured), axis=0)
        age = now_s - self._read_s
        return Whereabouts(self._names, self.measured, travel, age, self._age_limit_s)

    def at_rest(self, now_s: float, near: Array) -> bool:
        """Whether the joints were read, and stayed within ``near`` (n,) for the response time."""
        if not self._track or self._track[0][0] > now_s - RESPONSE_S:
            return False
        moved = max(float(np.max(np.abs(q - self.measured) / near)) for _, q in self._track)
        return moved < 1.0 and bool(np.all(now_s - self._read_s <= self._age_limit_s))

    def complete(
        self, names: tuple[str, ...], position: Array, now_s: float
    ) -> tuple[Array, Index]:
        """All joints (m, n) of a command (m, k), and the joint number (k,) of each name.

        Joints that the command leaves out keep their last known (taught) values, which must not
        be old.
        """
        index = self._indices.get(names)
        if index is None:
            index = self._index(names)
            self._indices = {names: index}
        if position.shape[1] != len(names):
            detail = f"{len(names)} names but {position.shape[1]} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        require_finite(names, position)
        self._require_radians(index, position)
        if len(names) == len(self._names):
            q = np.empty_like(position)
        else:
            rest = np.ones(len(self._names), dtype=np.bool_)
            rest[index] = False
            absent = rest & ~np.isfinite(self.taught)
            if np.any(absent):
                missing = [self._names[i] for i in np.flatnonzero(absent)]
                raise RefusedError(Reason.MISSING_JOINT, ", ".join(missing))
            self.where(now_s).require_fresh(np.flatnonzero(rest))
            q = np.tile(self.taught, (len(position), 1))
        q[:, index] = position
        return q, index

    def _require_radians(self, index: Index, position: Array) -> None:
        """Refuse positions (m, k) that can only be degrees, or millimetres."""
        size = np.abs(position)
        if not (size > self._doubtful[index]).any():
            return
        if np.any(size > self._turns[index]):
            point, column = np.argwhere(size > self._turns[index])[0]
            detail = f"{self._names[index[column]]} at {position[point, column]:g} rad"
            raise RefusedError(Reason.DEGREES, detail)
        if np.any(np.all(size > self._tenfold[index], axis=1)):
            raise RefusedError(Reason.DEGREES, "all joints are beyond ten times their limits")

    def _index(self, names: tuple[str, ...]) -> Index:
        unknown = [name for name in names if name not in self._number]
        if unknown or not names:
            detail = f"{', '.join(unknown) or 'no name'}; the arm has {', '.join(self._names)}"
            raise RefusedError(Reason.UNKNOWN_JOINT, detail)
        _require_single(names)
        return np.array([self._number[name] for name in names], dtype=np.int64)

    def spread(self, rates: Array, index: Index) -> Array:
        """Rates (m, k) of some joints as (m, n); the others are at rest."""
        out = np.zeros((len(rates), len(self._names)))
        out[:, index] = rates
        return out

    def find(self, state: JointCommand) -> tuple[Index, Index]:
        """Numbers of the arm's joints in readings, and their places; they must be finite.

        Joints of others are left alone.
        """
        _require_single(state.names)
        if len(state.position) != len(state.names):
            detail = f"{len(state.names)} names but {len(state.position)} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        place = [i for i, name in enumerate(state.names) if name in self._number]
        index = np.array([self._number[state.names[i]] for i in place], dtype=np.int64)
        places = np.array(place, dtype=np.int64)
        values = state.position[places]
        require_finite(tuple(state.names[i] for i in place), values[None])
        self._require_radians(index, values[None])
        if state.velocity is not None:
            speeds = state.velocity[places]
            require_finite(tuple(state.names[i] for i in place), speeds[None])
        return index, places

    def read(self, state: JointCommand, now_s: float, age_s: float) -> tuple[Index, Index]:
        """Take over readings that are ``age_s`` old; returns what `find` does."""
        index, places = self.find(state)
        self.measured[index] = state.position[places]
        self._read_s[index] = now_s - max(age_s, 0.0)
        if not self._track or now_s - self._track[-1][0] >= TRACK_S:
            self._track.append((now_s, self.measured.copy()))
            while len(self._track) > 1 and self._track[1][0] <= now_s - RESPONSE_S:
                self._track.popleft()
        return index, places


class CorrectionGuard:
    """Watches what comes in.

    Attributes
    ----------
    refused : how often, by reason.
    last_refusal : in words.
    """

    def __init__(self) -> None:
        self._clock_s = -np.inf
        self._stamps: dict[tuple[str, tuple[str, ...]], int] = {}  # by kind and joints
        self._echoes = {TARGET: Echoes(ECHOES), TRAJECTORY: Echoes(1)}
        self.refused: Counter[Reason] = Counter()
        self.last_refusal = ""

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something; a refusal is counted and passed on."""
        try:
            return act()
        except RefusedError as error:
            self.refused[error.reason] += 1
            self.last_refusal = str(error)
            raise

    def require_order(
        self, kind: str, stamp: int, mark: str, now_s: float, names: tuple[str, ...] = ()
    ) -> None:
        """Refuse what carries a mark of a correction, or is older than the one before.

        That is the one of the same joints: drivers of others have clocks of their own.
        """
        if mark == CORRECTED or (mark == TAUGHT and kind == READING):
            raise RefusedError(Reason.OWN_OUTPUT, f"{kind} with frame_id '{mark}'")
        if not now_s >= self._clock_s:
            raise RefusedError(Reason.TIME_BACKWARDS, f"clock at {now_s} after {self._clock_s}")
        last = self._stamps.get((kind, names), 0)
        reset = last - stamp > CLOCK_RESET_NS
        if stamp and stamp < last and not reset:
            detail = f"{kind} is {(last - stamp) * 1e-9:.6f} s older than the one before"
            raise RefusedError(Reason.TIME_BACKWARDS, detail)

    def not_before(self, now_s: float) -> float:
        """The clock's time, or the last one where it went back."""
        return now_s if now_s >= self._clock_s else self._clock_s

    def accept_order(
        self, kind: str, stamp: int, now_s: float, names: tuple[str, ...] = ()
    ) -> None:
        """Remember the time of what was acted on."""
        self._clock_s = now_s
        if stamp:
            self._stamps.pop((kind, names), None)  # so that the oldest is the first to go
            self._stamps[kind, names] = stamp
            if len(self._stamps) > MOST_STAMPS:
                del self._stamps[next(iter(self._stamps))]

    def forget_stamps(self) -> None:
        """Start afresh with any source stamp."""
        self._stamps.clear()

    def note_output(self, kind: str, names: tuple[str, ...], taught: Array, out: Array) -> None:
        """Remember what was put out for what came in."""
        self._echoes[kind].remember(names, taught, out)

    def require_not_own(self, kind: str, names: tuple[str, ...], position: Array) -> None:
        """Refuse what was put out, and comes back without its mark."""
        if self._echoes[kind].holds(names, position):
            raise RefusedError(Reason.OWN_OUTPUT, f"equal to a {kind} that was corrected before")


class Echoes:
    """The last corrected positions, to know them when they come back."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._names: tuple[str, ...] = ()
        self._positions = np.empty((0, 0))
        self._within = np.empty(0)
        self._next = 0

    def remember(self, names: tuple[str, ...], taught: Array, corrected: Array) -> None:
        """Keep ``corrected`` for a while; one that equals ``taught`` is no echo."""
        if names != self._names or corrected.shape != self._positions.shape[1:]:
            self._names = names
            self._positions = np.zeros((self._size, *corrected.shape))
            self._within = np.full(self._size, -1.0)
        shift = float(np.abs(corrected - taught).max())
        i = self._next % self._size
        self._positions[i] = corrected
        self._within[i] = min(ROUNDED, OF_SHIFT * shift) if shift > SHIFTED else -1.0
        self._next += 1

    def holds(self, names: tuple[str, ...], position: Array) -> bool:
        """Whether a position is one of them, up to rounding."""
        if names != self._names or position.shape != self._positions.shape[1:]:
            return False
        beside = np.abs(self._positions - position).reshape(self._size, -1).max(axis=1)
        return bool((beside <= self._within).any())


def require_finite(names: tuple[str, ...], values: Array | None) -> None:
    """Refuse values (m, k) of which one is NaN or infinite."""
    if values is None or np.isfinite(values).all():
        return
    point, column = np.argwhere(~np.isfinite(values))[0]
    name = names[column] if column < len(names) else f"column {column + 1}"
    raise RefusedError(Reason.NOT_FINITE, f"{name} (point {point + 1})")


def _require_single(names: tuple[str, ...]) -> None:
    if len(set(names)) != len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise RefusedError(Reason.DOUBLED_JOINT, doubled)
