"""Which measuring cycle is open, and when it ends by itself."""

from dataclasses import dataclass

from robocal_ros.ground.errors import ConflictError
from robocal_ros.ground.proposals import THERMAL, Entry
from robocal_ros.session.history import History

TIME_OUT = "time-out"
REMEMBERED = 200  # calibrations back to which a cycle's id is known


@dataclass
class OpenCycle:
    """The open cycle.

    Attributes
    ----------
    id : its name; empty while none is open.
    begun_ns : stamp at which it began.
    postponed_ns : stamp at which it could not be kept; its time-out begins anew there.
    """

    id: str = ""
    begun_ns: int = 0
    postponed_ns: int = 0

    def begin(self, cycle_id: str, stamp_ns: int, history: History) -> str:
        """Open a cycle and say so; one that is open already goes on, another one is broken off.

        Raises
        ------
        ConflictError
            When a cycle of this id has ended.
        """
        if self.id == cycle_id:
            return f"cycle '{cycle_id}' is open already"
        if ended(cycle_id, history) is not None:
            raise ConflictError(
                f"cycle '{cycle_id}' has ended already: give each cycle an id of its own"
            )
        broken = f"; cycle '{self.id}' is broken off" if self.id else ""
        self.id, self.begun_ns = cycle_id, stamp_ns
        return f"cycle '{cycle_id}' is open{broken}"

    def close(self) -> None:
        """No cycle is open any more."""
        self.id = ""


def ended(cycle_id: str, history: History) -> Entry | None:
    """The calibration that a cycle of this id gave, the latest of them; None without."""
    entries = (e for e in history.list(REMEMBERED) if e.kind == THERMAL and e.cycle_id == cycle_id)
    return next(entries, None)
