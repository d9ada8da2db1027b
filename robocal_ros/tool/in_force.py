# SPDX-License-Identifier: Apache-2.0
"""What the history has in force for a tool: itself, and how what it is compared with measured."""

from typing import Any

import numpy as np

from robocal_ros.ground.frames import Array
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import HEALTHY_TOOL, LASER_FRAME, MANDREL, TOOL, Head
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import HistoryFollower
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.run import RunTraits, ToolConfig, alike, made_with, taught_apart
from robocal_ros.tool.station import StationMeasurement, StationTrend, measurement_of


class ToolInForce(HistoryFollower):
    """What the history has in force for a tool, as of the last look.

    ``head``, ``healthy``, ``mandrel``, ``station``: heads of the tools and of the measurements of
    the healthy tool, of the mandrel and of the beams.
    """

    def __init__(self, history: CalibrationHistory, nominal: SerialArm, config: ToolConfig) -> None:
        self._mandrel = None if config.mandrel is None else [list(row) for row in config.mandrel]
        self._mandrel_radius_m = config.mandrel_radius_m
        self._taught, self._made_with = KnownTool(config.T_flange_taught), made_with(config)
        super().__init__(history, TOOL, nominal)

    def _read(self) -> None:
        super()._read()
        self.healthy: Head = self.history.head(HEALTHY_TOOL)
        self.mandrel: Head = self.history.head(MANDREL)
        self.station: Head = self.history.head(LASER_FRAME)

    def stamp_ns(self, head: Head) -> int:
        """When what is in force was measured; 0: nothing is, or a recording does not tell."""
        if head.model is None or head.calibration_id is None:
            return 0
        return int(head.model.get("stamp_ns") or self.history.get(head.calibration_id).stamp_ns)

    def stamped(self, head: Head) -> dict[str, Any] | None:
        """Its model with that stamp, which those of older versions lack."""
        stamp_ns = self.stamp_ns(head)
        return head.model | {"stamp_ns": stamp_ns} if head.model and stamp_ns else head.model

    @property
    def foreign(self) -> str:
        """Why what the history has in force says nothing of this tool; empty: it does.

        It was measured of one that was taught otherwise, by more than a pendant rounds.
        """
        made = (self.head.model or {}).get("made_with")
        if made is None:
            return ""
        apart = taught_apart(np.array(made["taught"]), self._taught.T_flange_tool)
        if not apart:
            return ""
        return (
            f"calibration {self.head.calibration_id} was measured of a tool that was taught "
            f"{apart} from this one and is not used: measure the mounted tool and accept it, "
            "roll back, or put taught_xyz_mm and taught_quat_xyzw right"
        )

    @property
    def by_these_beams(self) -> bool:
        """Whether the tool in force was measured with this taught tool, beams and station."""
        model = self.model
        return model is not None and alike(model.get("made_with"), self._made_with)

    @property
    def model(self) -> dict[str, Any] | None:
        """Of the tool in force; None without one of this taught tool."""
        return None if self.foreign else self.head.model

    @property
    def tool(self) -> KnownTool:
        """The tool in force; without one the taught one."""
        model = self.model
        return self._taught if model is None else KnownTool.of_document(model)

    @property
    def anchor(self) -> Array:
        """Tip (3,) of the last tool whose cause was known: in force, or before small changes."""
        known = (self.model or {}).get("anchor")
        return self.tool.T_flange_tool[:3, 3] if known is None else np.array(known)

    @property
    def measured_healthy(self) -> KnownTool | None:
        """How the healthy tool was measured; None without, or with another tool or station."""
        model = self._healthy_model
        return None if model is None else KnownTool.of_document(model)

    @property
    def healthy_traits(self) -> RunTraits | None:
        """What its run showed beside the tool; None where that is not known."""
        model = self._healthy_model
        traits = None if model is None else model.get("traits")
        return None if traits is None else RunTraits.of_document(traits)

    @property
    def healthy_joints(self) -> Array | None:
        """At which (n,) its tip was measured; None where that is not known."""
        known = (self._healthy_model or {}).get("joints")
        return None if known is None else np.array(known)

    @property
    def measured_mandrel(self) -> KnownTool | None:
        """How the mandrel was measured; None without, or with another one or another station."""
        model = self.mandrel.model
        if model is None or not alike(model["made_with"], self._made_with):
            return None
        return KnownTool.of_document(model) if alike(model["mandrel"], self._mandrel) else None

    @property
    def commissioned_station(self) -> StationMeasurement | None:
        """The first measurement with this mandrel, radius and laser file; None before it."""
        model = self._station_model
        return None if model is None else measurement_of(model["first"])

    @property
    def station_trend(self) -> StationTrend:
        """How they drift since then; none before it, or of a version that did not follow it."""
        known = (self._station_model or {}).get("trend")
        return StationTrend() if known is None else StationTrend.of_model(known)

    @property
    def _station_model(self) -> dict[str, Any] | None:
        model = self.station.model
        if model is None or not alike(model["made_with"], self._made_with):
            return None
        radius_m = model.get("mandrel_radius_m", self._mandrel_radius_m)  # older ones have none
        same = [model["mandrel"], radius_m], [self._mandrel, self._mandrel_radius_m]
        return model if alike(*same) else None

    @property
    def _healthy_model(self) -> dict[str, Any] | None:
        model = self.healthy.model
        return model if model and alike(model["made_with"], self._made_with) else None
