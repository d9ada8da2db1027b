# SPDX-License-Identifier: Apache-2.0
"""Gives the gap to one of several robots that share a sensor or a station (docs/cell_launch.md)."""

import time
from functools import partial
from typing import Any

from robocal_msgs.msg import GapOpen, MaintenanceStatus
from std_msgs.msg import String

from robocal_ros.ground.errors import InputError
from robocal_ros.maintenance.sharing import SharedPlace
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.endpoints import ERROR, WARN, Health
from robocal_ros.ros.parameters import Setting, number

LOOK_S = 0.05
BUSY = (MaintenanceStatus.RUNNING, MaintenanceStatus.BREAKING_OFF)
SETTINGS = (
    Setting("robots", ["left", "right"], "Namespaces of the robots that share the place"),
    number(
        "lease_s",
        10.0,
        "A robot of which neither heartbeat nor status came for so long has lost the place",
        1.0,
        3600.0,
    ),
)


class SharingNode(HouseNode):
    """Passes the heartbeat of one robot's PLC on, and of all others a closed gap."""

    NAME = "sharing_node"
    SETTINGS = SETTINGS

    def configure(self) -> None:
        """Open each robot's topics. Raises `InputError` for fewer than two robots."""
        robots = self.settings["robots"]
        if len(set(robots)) < 2 or len(set(robots)) != len(robots) or "" in robots:
            raise InputError(f"robots is {robots}: name two namespaces or more, each once")
        self._gaps, self._inputs = {}, {}
        for name in robots:
            self._inputs[name] = (
                self.add_input(
                    GapOpen, f"{name}/gap_wanted", partial(self._wanted, name), endpoints.HEARTBEAT
                ),
                self.add_input(
                    MaintenanceStatus,
                    f"{name}/maintenance_node/status",
                    partial(self._status, name),
                    endpoints.LATCHED,
                ),
            )
            self._gaps[name] = self.add_output(GapOpen, f"{name}/gap_open", endpoints.HEARTBEAT)
        self._holder = self.add_output(String, "~/holder", endpoints.LATCHED)
        self.add_timer(LOOK_S, self._look, steady=True)

    def activate(self) -> None:
        """Begin: whoever may be in the place already has a lease's time to say so."""
        settings = self.settings
        self._place = SharedPlace(settings["robots"], settings["lease_s"], time.monotonic())
        self._told: str | None = None
        self._look()

    def _wanted(self, name: str, message: Any) -> None:
        # As it came: only its own PLC may echo a robot's beat, and a late one counts as late.
        wanted = bool(message.open) and not self._doubt(name)
        message.open = self._place.want(name, wanted, time.monotonic())
        self._gaps[name].publish(message)
        self._look()

    def _doubt(self, name: str) -> str:
        """Why what is said of a robot's gap does not count; empty: it does.

        Of two that ask, one may say open while the other says closed, which maintenance_node could
        not tell, as it hears this node alone. Of two that tell where the robot is, one may say that
        it is out while it works in the place.
        """
        return next(filter(None, map(_several, self._inputs[name])), "")

    def _status(self, name: str, message: Any) -> None:
        told = self._inputs[name][1]
        out = bool(message.at_home) and message.state not in BUSY and not _several(told)
        self._place.tell(name, out, time.monotonic())
        self._look()

    def _look(self) -> None:
        """Say who has the place, where that has changed."""
        holder = self._place.holder(time.monotonic())
        if holder != self._told:
            self._told = holder
            self._holder.publish(String(data=holder))
            self.get_logger().info(f"{holder} has the place" if holder else "nobody has the place")

    def health(self) -> Health:
        """Who has the place, and who waits for it."""
        now_s, health = time.monotonic(), Health()
        health.values = {"holder": self._told or "nobody"}
        if why := self._place.why(now_s):
            health.worsen(WARN, why)
        for name in self._inputs:
            if why := self._doubt(name):
                health.worsen(ERROR, why)
        return health


def _several(told: Any) -> str:
    if (count := told.get_publisher_count()) < 2:
        return ""
    return f"{told.topic_name} has {count} publishers: let one alone publish it"


def main() -> None:
    """Run the node."""
    run(SharingNode)
