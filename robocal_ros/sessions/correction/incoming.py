"""What comes in: joints by name, their last known state, order in time, own output."""

from collections import Counter
from collections.abc import Callable
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.joint_correction.refusals import Reason, RefusedError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.sessions.correction.inputs import JointCommand

Array = NDArray[np.float64]
Index = NDArray[np.int64]
Answer = TypeVar("Answer")

READING = "joint reading"
TARGET = "joint target"
TRAJECTORY = "trajectory"

# A reading this much older than the last one comes from a clock that was set back.
CLOCK_RESET_NS = 1_000_000_000
# Positions nearer than this are the same; own output is told by what it was shifted.
SAME = 1e-12
SHIFTED = 1e-9


class JointBook:
    """Knows the arm's joints and where they are.

    Attributes
    ----------
    measured : (n,) last readings, NaN before the first.
    taught : (n,) the same, un-corrected.
    """

    def __init__(self, arm: SerialArm) -> None:
        self._names = arm.joint_names
        self._number = {name: i for i, name in enumerate(arm.joint_names)}
        self._indices: dict[tuple[str, ...], Index] = {}
        self.measured = np.full(arm.n, np.nan)
        self.taught = np.full(arm.n, np.nan)

    @property
    def count(self) -> int:
        """Number of the arm's joints."""
        return len(self._names)

    def complete(self, names: tuple[str, ...], position: Array) -> tuple[Array, Index]:
        """All joints (m, n) of a command (m, k), and the joint number (k,) of each name.

        Joints that the command leaves out keep their last known (taught) values.
        """
        index = self._indices.get(names)
        if index is None:
            index = self._index(names)
            self._indices = {names: index}
        if position.shape[1] != len(names):
            detail = f"{len(names)} names but {position.shape[1]} positions"
            raise RefusedError(Reason.WRONG_SIZE, detail)
        require_finite(names, position)
        if len(names) == len(self._names):
            q = np.empty_like(position)
        else:
            rest = np.ones(len(self._names), dtype=np.bool_)
            rest[index] = False
            absent = rest & ~np.isfinite(self.taught)
            if np.any(absent):
                missing = [self._names[i] for i in np.flatnonzero(absent)]
                raise RefusedError(Reason.MISSING_JOINT, ", ".join(missing))
            q = np.tile(self.taught, (len(position), 1))
        q[:, index] = position
        return q, index

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

    def read(self, state: JointCommand) -> tuple[Index, Index]:
        """Take over readings; numbers of the arm's joints in it, and their places in the message.

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
        if state.velocity is not None:
            speeds = state.velocity[places]
            require_finite(tuple(state.names[i] for i in place), speeds[None])
        self.measured[index] = values
        return index, places

    def known_measured(self) -> Array:
        """Readings (n,) of all joints; refused while one has not been read."""
        absent = ~np.isfinite(self.measured)
        if np.any(absent):
            missing = [self._names[i] for i in np.flatnonzero(absent)]
            raise RefusedError(Reason.MISSING_JOINT, ", ".join(missing))
        return self.measured


class CorrectionGuard:
    """Watches what comes in.

    Attributes
    ----------
    refused : how often, by reason.
    last_refusal : in words.
    """

    def __init__(self) -> None:
        self._clock_s = -np.inf
        self._stamps: dict[str, int] = {}
        self._last_output: tuple[tuple[str, ...], Array] | None = None
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

    def require_order(self, kind: str, stamp: int, mark: str, now_s: float) -> None:
        """Refuse what carries a mark of a correction, or is older than the one before."""
        if mark == CORRECTED or (mark == TAUGHT and kind == READING):
            raise RefusedError(Reason.OWN_OUTPUT, f"{kind} with frame_id '{mark}'")
        if not now_s >= self._clock_s:
            raise RefusedError(Reason.TIME_BACKWARDS, f"clock at {now_s} after {self._clock_s}")
        last = self._stamps.get(kind, 0)
        reset = kind == READING and last - stamp > CLOCK_RESET_NS
        if stamp and stamp < last and not reset:
            detail = f"{kind} is {(last - stamp) * 1e-9:.6f} s older than the one before"
            raise RefusedError(Reason.TIME_BACKWARDS, detail)

    def accept_order(self, kind: str, stamp: int, now_s: float) -> None:
        """Remember the time of what was acted on."""
        self._clock_s = now_s
        if stamp:
            self._stamps[kind] = stamp

    def forget_stamps(self) -> None:
        """Start afresh with any source stamp."""
        self._stamps.clear()

    def note_output(self, corrected: JointCommand | None, shift: float = 0.0) -> None:
        """Remember a corrected target, and by how much it was shifted."""
        self._last_output = None
        if corrected is not None and shift > SHIFTED:
            self._last_output = (corrected.names, corrected.position)

    def require_not_own(self, command: JointCommand) -> None:
        """Refuse a target that is the last corrected one."""
        if self._last_output is None:
            return
        names, position = self._last_output
        if command.names != names or command.position.shape != position.shape:
            return
        if np.max(np.abs(command.position - position)) <= SAME:
            raise RefusedError(Reason.OWN_OUTPUT, "equal to the last corrected target")


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
