"""Which samples a command is about: its stamp, its marks, and whether all of them have come."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from robocal_ros.ground.samples import JOINTS, JUMPS
from robocal_ros.session import events
from robocal_ros.session.events import Command, joints_awaited_ns, reached
from robocal_ros.thermal.config import ThermalConfig
from robocal_ros.thermal.cycles import OpenCycle
from robocal_ros.thermal.observations import ObservationDesk
from robocal_ros.thermal.windows import Windows

SAME_CLOCK_NS = 1_000_000_000


class Bounds:
    """Gives commands what replay needs to find the same samples."""

    def __init__(
        self, desk: ObservationDesk, cycle: OpenCycle, windows: Windows, config: ThermalConfig
    ) -> None:
        self._desk, self._cycle, self._windows, self._config = desk, cycle, windows, config

    def stamped(self, command: Command, clock_ns: int | None) -> Command:
        """Return the command with a stamp: its own, the clock's, or the newest known."""
        if command.stamp_ns is None:
            newest = self._desk.clock_ns
            near = clock_ns is not None and newest <= clock_ns <= newest + SAME_CLOCK_NS
            command = replace(command, stamp_ns=clock_ns if near else newest)
        return command

    def named(self, command: Command) -> Command:
        """Name a cycle: as the open one, else by its time."""
        begins = command.name == events.BEGIN_CYCLE
        if command.arguments.get("cycle_id") or not (begins or command.name in events.CYCLE):
            return command
        by_time = str(np.datetime64((command.stamp_ns or 0) // 1_000_000, "ms"))
        name = by_time if begins else self._cycle.id or by_time
        return replace(command, arguments={**command.arguments, "cycle_id": name})

    def marked(self, command: Command) -> Command:
        """Return the command with the bounds of its samples, for the record."""
        marks, arguments = self._desk.marks, dict(command.arguments)
        if command.name in events.MEASURED:
            arguments.setdefault("from_ns", self._windows.from_ns(command))
        return replace(command, marks=marks, arguments=arguments)

    def ready(self, command: Command) -> bool:
        """Whether its samples are complete."""
        return reached(self._wanted(command), self._desk.newest_ns, self._desk.jumps)

    def joints_awaited_ns(self, command: Command) -> int | None:
        """Stamp of the joint reading that it waits for; None when it waits for none."""
        return joints_awaited_ns(self._wanted(command), self._desk.newest_ns)

    def _wanted(self, command: Command) -> Mapping[str, int]:
        """Marks up to which samples must have come."""
        if command.marks is not None:
            return command.marks
        marks = {JUMPS: self._desk.jumps}
        if command.name in events.MEASURED:
            marks[JOINTS] = (command.stamp_ns or 0) + int(self._config.lateness_s * 1e9)
        return marks
