"""Which measurements belong to a command, and when a cycle ends by itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.samples import JOINTS, REFERENCE_SPHERE, Measurements
from robocal_ros.session import events
from robocal_ros.session.events import Command
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.cycles import TIME_OUT, OpenCycle
from robocal_ros.thermal.in_force import InForce
from robocal_ros.thermal.observation import Observation, as_measurements, one_per_visit
from robocal_ros.thermal.observations import ObservationDesk

Array = NDArray[np.float64]

OTHER_POSE = "measured at a pose that the cold reference lacks"


@dataclass(frozen=True, eq=False)
class Beside:
    """What was measured beside the targets.

    ``fixed`` (n, 3): centres of a sphere fixed in the cell, m; ``temperatures``: stamps and
    temperatures (n,) of all motors since the last cycle, degrees Celsius; ``temperature`` (n,):
    those of that time, None where they are not known.
    """

    fixed: Array
    temperatures: Sequence[tuple[int, Array]]
    temperature: Array | None


class Windows:
    """Takes the observations of a command from the desk."""

    def __init__(
        self, desk: ObservationDesk, cycle: OpenCycle, current: InForce, config: ThermalConfig
    ) -> None:
        self._desk, self._cycle, self._current, self._config = desk, cycle, current, config
        self._pause_ns = int(config.cycle_timeout_s * 1e9)

    def from_ns(self, command: Command) -> int:
        """Stamp of the first measurement that counts: a cycle holds no pause of its time-out."""
        calibrates = self._current.reference is None or command.name in events.SET_UP
        if calibrates or self._cycle.id:
            return self._desk.from_ns
        return self._desk.last_run_ns(self._pause_ns)

    def of(self, command: Command) -> tuple[Measurements, Array]:
        """Targets on the flange, and centres (n, 3) of a sphere fixed in the cell.

        Raises
        ------
        TooFewSamplesError
            When nothing was measured.
        InputError
            When a cycle holds no pose of the cold reference.
        """
        desk, sets_up = self._desk, command.name in events.SET_UP
        desk.drop_far_ahead()
        after = int(command.arguments.get("from_ns", desk.from_ns)) - 1
        observed = desk.window(after, command.stamp_ns or 0, command.marks or {})
        fixed = [o.position for o in observed if o.topic == REFERENCE_SPHERE]
        found = [o for o in observed if o.topic != REFERENCE_SPHERE]
        if not found:
            raise TooFewSamplesError(desk.why_nothing())
        drift = self._current.reference is not None and not sets_up
        if drift or sets_up:
            found = one_per_visit(found, self._config.standstill.tolerance_rad)
        if drift:
            found = self._at_cold_poses(found)
        last = int(command.arguments.get("samples", 0))
        sigma_m = self._config.sigma_m if drift else None  # a calibration finds its noise itself
        data = as_measurements(found[-last:] if last else found, sigma_m)
        return data, np.array(fixed).reshape(-1, 3)

    def overdue(self) -> Command | None:
        """The command that ends a cycle in which nothing came for its time-out, or None.

        Without ``begin_cycle`` a cycle is what follows each other without such a pause, at half
        of the cold reference's poses or more.
        """
        desk, cycle = self._desk, self._cycle
        last_ns = max(desk.latest_ns, cycle.begun_ns if cycle.id else 0)
        due_ns = max(last_ns, cycle.postponed_ns) + self._pause_ns
        if not last_ns or desk.newest_ns.get(JOINTS, 0) <= due_ns:
            return None
        if not cycle.id and not self._half_visited():
            return None
        return Command(events.END_CYCLE, {"by": TIME_OUT}, due_ns)

    def progress(self) -> tuple[int, int]:
        """How many poses of the cold reference were visited in this cycle, and of how many."""
        reference, desk = self._current.reference, self._desk
        if reference is None:
            return 0, 0
        start = desk.from_ns if self._cycle.id else desk.last_run_ns(self._pause_ns)
        q = [o.q for o in desk.unused(start)]
        return len(reference.spots.visited(np.array(q))), reference.spots.poses

    def _half_visited(self) -> bool:
        visited, poses = self.progress()
        return poses > 0 and 2 * visited >= poses

    def _at_cold_poses(self, found: list[Observation]) -> list[Observation]:
        """Those at a pose of the cold reference; that of another pose shows no drift."""
        if self._current.reference is None:
            return found
        known = self._current.reference.spots.knows(np.array([o.q for o in found]))
        for other in (o for o, at_one in zip(found, known, strict=True) if not at_one):
            self._desk.ignored.add(other.topic, OTHER_POSE)
        if not np.any(known):
            raise InputError(
                f"none of the {len(found)} measured poses was measured in the cold reference: "
                "visit the reference poses, or capture a new reference"
            )
        return [o for o, at_one in zip(found, known, strict=True) if at_one]
