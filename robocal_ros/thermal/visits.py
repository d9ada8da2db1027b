"""Visits of named measuring poses: the cold ones, and the warm ones of each cycle."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import Measurements
from robocal_ros.thermal.spots import SAME_VISIT_RAD

ONLY_CYCLE = "1"


@dataclass(frozen=True)
class Visits:
    """Measurements at named poses.

    Attributes
    ----------
    pose : (m,) name of the pose, which cold and warm visits share.
    cycle : (m,) name of the cycle; all ``ONLY_CYCLE`` where none is given.
    """

    data: Measurements
    pose: tuple[str, ...]
    cycle: tuple[str, ...]

    @property
    def cycles(self) -> tuple[str, ...]:
        """The cycles in order of first appearance."""
        return tuple(dict.fromkeys(self.cycle))

    def take(self, rows: NDArray[np.bool_]) -> "Visits":
        """Return the visits of a mask (m,)."""
        index = np.flatnonzero(rows)
        return replace(
            self,
            data=self.data.take(index),
            pose=tuple(self.pose[i] for i in index),
            cycle=tuple(self.cycle[i] for i in index),
        )

    def of_cycle(self, name: str) -> "Visits":
        """Return the visits of one cycle."""
        return self.take(np.array([cycle == name for cycle in self.cycle], dtype=np.bool_))


def require_cold_counterparts(cold: Visits, warm: Visits, file: str | None = None) -> None:
    """Refuse warm visits of a pose that was not visited cold, or at other joints.

    Raises
    ------
    InputError
        Naming the sample, ``file``, and what differs.
    """
    known = {pose: cold.data.q[i] for i, pose in enumerate(cold.pose)}
    for i, pose in enumerate(warm.pose):
        if pose not in known:
            raise InputError(
                f"sample {warm.data.sample[i]}: pose '{pose}' was not visited cold (those are "
                f"{_listed(tuple(known))})",
                file=file,
                column="pose",
            )
        away = float(np.max(np.abs(warm.data.q[i] - known[pose])))
        if away >= SAME_VISIT_RAD:
            raise InputError(
                f"sample {warm.data.sample[i]}: pose '{pose}' was visited at other joints than "
                f"cold, by {np.degrees(away):.2f} deg (allowed {np.degrees(SAME_VISIT_RAD):.1f} "
                "deg): only the same pose can be compared",
                file=file,
                column="pose",
            )


def _listed(names: tuple[str, ...]) -> str:
    few = ", ".join(names[:6])
    return few if len(names) <= 6 else f"{few} and {len(names) - 6} more"
