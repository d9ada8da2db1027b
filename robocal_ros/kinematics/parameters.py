"""Names and choice of the identifiable model parameters."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from robocal_ros.kinematics.arm import SerialArm

Array = NDArray[np.float64]

COLUMNS = ("d", "theta", "a", "alpha", "beta")
D, THETA, A, ALPHA, BETA = range(5)
IS_LENGTH = (True, False, True, False, False)
NEARLY_PARALLEL = np.sin(np.radians(5.0))
_TO_DISPLAY = {True: 1e3, False: 180.0 / np.pi}


@dataclass(frozen=True)
class ParameterSet:
    """An ordered choice of model parameters.

    ``index`` (k, 2): joint (from 0) and column (d, theta, a, alpha, beta) of each.
    """

    index: tuple[tuple[int, int], ...]

    def __len__(self) -> int:
        return len(self.index)

    @property
    def names(self) -> tuple[str, ...]:
        """Names with the unit shown to people: ``d1_mm``, ``theta1_deg``, ``beta2_deg``."""
        return tuple(
            f"{COLUMNS[column]}{joint + 1}_{'mm' if IS_LENGTH[column] else 'deg'}"
            for joint, column in self.index
        )

    @property
    def is_length(self) -> NDArray[np.bool_]:
        """(k,) True for lengths (m), False for angles (rad)."""
        return np.array([IS_LENGTH[column] for _, column in self.index], dtype=np.bool_)

    @property
    def to_display(self) -> Array:
        """(k,) factors from SI to the unit in the name."""
        return np.array([_TO_DISPLAY[IS_LENGTH[column]] for _, column in self.index])

    def read(self, mdh: Array) -> Array:
        """Values (k,) of these parameters in a model (n, 5)."""
        rows, columns = np.array(self.index, dtype=np.int64).reshape(-1, 2).T
        return np.asarray(mdh[rows, columns])

    def add(self, mdh: Array, delta: Array) -> Array:
        """Return a model (n, 5) with ``delta`` (k,) added to these parameters."""
        changed = mdh.copy()
        rows, columns = np.array(self.index, dtype=np.int64).reshape(-1, 2).T
        changed[rows, columns] += delta
        return changed

    def slots(self, n: int) -> NDArray[np.int64]:
        """Column (n, 5) of each parameter in a Jacobian of this set, -1 where not in it."""
        table = np.full((n, 5), -1, dtype=np.int64)
        for column, (joint, kind) in enumerate(self.index):
            table[joint, kind] = column
        return table

    def subset(self, names: tuple[str, ...]) -> "ParameterSet":
        """Return the parameters of these names, in this set's order.

        Raises
        ------
        ValueError
            When a name is not in the set.
        """
        unknown = set(names) - set(self.names)
        if unknown:
            raise ValueError(
                f"unknown parameter {sorted(unknown)[0]!r}; this model has {', '.join(self.names)}"
            )
        return ParameterSet(
            tuple(i for i, n in zip(self.index, self.names, strict=True) if n in names)
        )


def free_parameters(arm: "SerialArm") -> ParameterSet:
    """Choose the parameters that can differ between robots of this type.

    Between nearly parallel consecutive axes d is held and beta is free, elsewhere beta is held
    and d is free; the last frame is the flange, so its d is always free (Hayati 1983). A joint
    that slides leaves its axis' position without effect; what is then redundant for the flange
    pose is dropped, the later parameter first.
    """
    index: list[tuple[int, int]] = []
    for joint in range(arm.n):
        parallel = joint < arm.n - 1 and abs(np.sin(arm.mdh[joint, ALPHA])) < NEARLY_PARALLEL
        first = [BETA, THETA] if parallel else [D, THETA]
        index += [(joint, column) for column in (*first, A, ALPHA)]
    if not np.any(arm.prismatic):
        return ParameterSet(tuple(index))
    return _without_redundant(arm, ParameterSet(tuple(index)))


def _without_redundant(arm: "SerialArm", candidates: ParameterSet) -> ParameterSet:
    """Drop each parameter that the earlier ones reproduce at every pose."""
    from robocal_ros.kinematics import kernels

    rng = np.random.default_rng(0)
    poses, k = 40, len(candidates)
    q = rng.uniform(-1.0, 1.0, (poses, arm.n)) * np.where(arm.prismatic, 0.5, 2.0)
    T, J = np.empty((poses, 4, 4)), np.zeros((poses, 6, k))
    target, none = np.zeros(poses, dtype=np.int64), np.array([-1], dtype=np.int64)
    kernels.parameter_batch(
        q,
        arm.links,
        arm.T_base_root,
        np.eye(4)[None],
        target,
        candidates.slots(arm.n),
        -1,
        none,
        T,
        J,
    )
    columns = J.reshape(-1, k)
    diagonal = np.abs(np.diag(np.linalg.qr(columns, mode="r")))
    keep = diagonal > 1e-9 * np.linalg.norm(columns, axis=0)
    return ParameterSet(tuple(i for i, kept in zip(candidates.index, keep, strict=True) if kept))
