"""Settings of the tool session."""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError
from robocal_ros.tool.beam_edges import InputRule
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.judging import ToolLimits
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.measuring_plan import MeasuringMotion
from robocal_ros.tool.quick_check import CheckRule
from robocal_ros.tool.run_traits import TraitLimits
from robocal_ros.tool.witness import BendRule

Array = NDArray[np.float64]
Rows = tuple[tuple[float, ...], ...]


@dataclass(frozen=True)
class ToolConfig:
    """Settings of a tool session; plain values, so that a recording carries them.

    Attributes
    ----------
    points_m : four points (A, B on the x-beam, C, D on the y-beam), base.
    laser_sigma_m, reach_m : see `LaserFrame`.
    taught : rows of T_flange_tool (4, 4) as taught.
    station : frame_id of the beams' edges; empty: any.
    beams : names of the x- and the y-beam in the edges.
    mandrel : rows of T_flange_mandrel (4, 4), z along its axis to its end; None: there is none.
    taper : growth of the tool's radius per length above the tip.
    spin_rad : turn of the flange about the laser's z while it measures.
    step_timeout_s : a step without any edge for so long ends the run.
    """

    points_m: Rows
    taught: Rows
    mandrel: Rows | None = None
    laser_sigma_m: float = 0.0
    reach_m: tuple[float, float] = (0.0, 0.0)
    station: str = ""
    beams: tuple[str, str] = ("x", "y")
    taper: float = 0.0
    spin_rad: float = 0.0
    step_timeout_s: float = 30.0
    motion: MeasuringMotion = field(default_factory=MeasuringMotion)
    input: InputRule = field(default_factory=InputRule)
    noise: RobotNoise = field(default_factory=RobotNoise)
    check: CheckRule = field(default_factory=CheckRule)
    limits: ToolLimits = field(default_factory=ToolLimits)
    traits: TraitLimits = field(default_factory=TraitLimits)

    @property
    def laser(self) -> LaserFrame:
        """The beams."""
        return LaserFrame(np.array(self.points_m), self.laser_sigma_m, np.array(self.reach_m))

    @property
    def T_flange_taught(self) -> Array:
        """The taught tool (4, 4)."""
        return np.array(self.taught)

    @property
    def bend(self) -> BendRule:
        """Where the tool may bend: between the mount and the upper circle."""
        nearest_m = self.motion.above_tip_m + self.motion.height_m
        return BendRule(nearest_m, max(nearest_m, self.check.lever_m))

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "ToolConfig":
        """Read what `document` gave, also after JSON.

        Raises
        ------
        InputError
            When it has other settings than this version knows.
        """
        parts: dict[str, Any] = {
            "motion": MeasuringMotion,
            "input": InputRule,
            "noise": RobotNoise,
            "check": CheckRule,
            "limits": ToolLimits,
            "traits": TraitLimits,
        }
        try:
            values: dict[str, Any] = {"traits": {}} | dict(document)  # older ones have none
            rows: dict[str, Any] = {
                key: tuple(map(tuple, values.pop(key))) for key in ("points_m", "taught")
            }
            if values.get("mandrel") is not None:  # older ones have none
                rows["mandrel"] = tuple(map(tuple, values.pop("mandrel")))
            pairs: dict[str, Any] = {key: tuple(values.pop(key)) for key in ("reach_m", "beams")}
            made: dict[str, Any] = {key: part(**values.pop(key)) for key, part in parts.items()}
            return cls(**rows, **pairs, **made, **values)
        except (KeyError, TypeError) as error:
            raise InputError(f"the recorded configuration cannot be read: {error}") from error


def rows_of(matrix: Array) -> Rows:
    """A matrix as plain rows."""
    return tuple(tuple(float(x) for x in row) for row in matrix)


def made_with(config: ToolConfig) -> dict[str, Any]:
    """What two measurements must share to be compared: taught tool, beams and station."""
    document = {"taught": config.taught, "points_m": config.points_m, "station": config.station}
    return {name: json.loads(json.dumps(value)) for name, value in document.items()}
