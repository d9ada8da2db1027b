"""What comes in: joints by name, their last known state, order in time."""

from collections import Counter
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.correction import memory as of
from robocal_ros.correction.echoes import Echoes
from robocal_ros.correction.inputs import JointCommand
from robocal_ros.correction.memory import RESPONSE_S, Memory
from robocal_ros.correction.refusals import Reason, RefusedError
from robocal_ros.correction.starting import Whereabouts

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Answer = TypeVar("Answer")

READING = "joint reading"
TARGET = "joint target"
TRAJECTORY = "trajectory"

# A message this much older than the last one comes from a clock that was set back.
CLOCK_RESET_NS = 1_000_000_000
MOST_TURNS = 4.0 * np.pi  # of a joint, where its limits allow no more
MOST_STAMPS = 64  # of so many drivers the order in time is watched one by one


class JointBook:
    """Knows the arm's joints and where they are; ``age_limit_s`` is how old a reading may be.

    Attributes
    ----------
    measured : (n,) last readings, NaN before the first.
    taught : (n,) the same, un-corrected.
    doubtful : (n,) beyond this joints may be in degrees, or in millimetres.
    """

    def __init__(self, arm: SerialArm, age_limit_s: float, memory: Memory) -> None:
        self._names = arm.joint_names
        self._age_limit_s = age_limit_s
        self._memory = memory
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        limit = np.maximum(np.abs(arm.lower), np.abs(arm.upper))
        turns = np.where(np.isfinite(limit), np.maximum(limit, MOST_TURNS), MOST_TURNS)
        self._turns, self._tenfold = np.where(arm.prismatic, np.inf, turns), 10.0 * limit
        self.doubtful = np.minimum(self._turns, self._tenfold)
        self.measured, self.taught = memory.measured, memory.taught

    @property
    def count(self) -> int:
        """Number of the arm's joints."""
        return len(self._names)

    def where(self, now_s: float) -> Whereabouts:
        """Where the robot is, how far it moved lately, and how old this is."""
        times, places = self._track()
        lately = np.vstack([self.measured, places[times >= now_s - RESPONSE_S]])
        travel = np.max(np.abs(lately - self.measured), axis=0)
        age = now_s - self._memory.read_s
        return Whereabouts(self._names, self.measured, travel, age, self._age_limit_s)

    def at_rest(self, now_s: float, near: Array) -> bool:
        """Whether the joints were read, and stayed within ``near`` (n,) for the response time."""
        times, places = self._track()
        if not len(times) or times[0] > now_s - RESPONSE_S:
            return False
        moved = float(np.max(np.abs(places - self.measured) / near))
        return moved < 1.0 and bool(np.all(now_s - self._memory.read_s <= self._age_limit_s))

    def _track(self) -> tuple[Array, Array]:
        """Times (r,) and places (r, n), the oldest first."""
        first, count = self._memory.counts[[of.OLDEST, of.PLACES]]
        row = (first + np.arange(count)) % of.TRACK
        return self._memory.track_s[row], self._memory.track[row]

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
        if not (size > self.doubtful[index]).any():
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
        memory = self._memory
        memory.read_s[index] = now_s - max(age_s, 0.0)
        of.note_place(memory.counts, memory.track_s, memory.track, memory.measured, now_s)
        return index, places


class CorrectionGuard:
    """Watches what comes in.

    Attributes
    ----------
    refused : how often, by reason.
    last_refusal : in words.
    """

    def __init__(self, memory: Memory) -> None:
        self._times = memory.times
        self._stamps: dict[tuple[str, tuple[str, ...]], Index] = {}  # by kind and joints
        self._echoes = {TARGET: Echoes(memory), TRAJECTORY: Echoes()}
        self.refused: Counter[Reason] = Counter()
        self.last_refusal = ""

    def counted(self, act: Callable[[], Answer]) -> Answer:
        """Do something; a refusal is counted and passed on."""
        try:
            return act()
        except RefusedError as error:
            self.count(error)
            raise

    def count(self, refusal: RefusedError) -> RefusedError:
        """Count a refusal, and return it."""
        self.refused[refusal.reason] += 1
        self.last_refusal = str(refusal)
        return refusal

    def require_order(
        self, kind: str, stamp: int, mark: str, now_s: float, names: tuple[str, ...] = ()
    ) -> None:
        """Refuse what carries a mark of a correction, or is older than the one before.

        Drivers of other joints have clocks of their own.
        """
        if mark == CORRECTED or (mark == TAUGHT and kind == READING):
            raise RefusedError(Reason.OWN_OUTPUT, f"{kind} with frame_id '{mark}'")
        clock_s = float(self._times[of.CLOCK])
        if not now_s >= clock_s:
            raise RefusedError(Reason.TIME_BACKWARDS, f"clock at {now_s} after {clock_s}")
        last = int(self.last_stamp(kind, names)[0])
        reset = last - stamp > CLOCK_RESET_NS
        if stamp and stamp < last and not reset:
            detail = f"{kind} is {(last - stamp) * 1e-9:.6f} s older than the one before"
            raise RefusedError(Reason.TIME_BACKWARDS, detail)

    def not_before(self, now_s: float) -> float:
        """The clock's time, or the last one where it went back."""
        clock_s = float(self._times[of.CLOCK])
        return now_s if now_s >= clock_s else clock_s

    def accept_order(
        self, kind: str, stamp: int, now_s: float, names: tuple[str, ...] = ()
    ) -> None:
        """Remember the time of what was acted on."""
        self._times[of.CLOCK] = now_s
        if stamp:
            self.last_stamp(kind, names)[0] = stamp

    def last_stamp(self, kind: str, names: tuple[str, ...]) -> Index:
        """Stamp (1,) of the last message in the same order of time, to go on with; 0: none.

        Readings have one for each driver, by its joints; beyond so many they share one.
        """
        key = kind, tuple(sorted(names)) if kind == READING else ()
        if key not in self._stamps and len(self._stamps) >= MOST_STAMPS:
            key = kind, ()
        return self._stamps.setdefault(key, np.zeros(1, dtype=np.int64))

    def forget_stamps(self) -> None:
        """Start afresh with any source stamp."""
        for last in self._stamps.values():
            last[0] = 0

    def note_output(self, kind: str, index: Index, taught: Array, out: Array) -> None:
        """Remember what was put out for joints ``index`` (k,) of what came in."""
        self._echoes[kind].remember(index, taught, out)

    def require_not_own(self, kind: str, index: Index, position: Array) -> None:
        """Refuse what was put out, and comes back without its mark, in whatever order."""
        if self._echoes[kind].holds(index, position):
            raise RefusedError(Reason.OWN_OUTPUT, f"equal to a {kind} that was corrected before")


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
