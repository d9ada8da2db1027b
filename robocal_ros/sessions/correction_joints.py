"""Joints by name: partial and reordered sets against the arm's, and their last known state."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.kinematics import SerialArm
from robocal_ros.sessions.correction_inputs import JointCommand, Reason, RefusedError

Array = NDArray[np.float64]
Index = NDArray[np.int64]


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
