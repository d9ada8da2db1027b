"""Settings of the hand-eye session."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Any

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.streams import StandstillRule


@dataclass(frozen=True)
class HandEyeConfig:
    """Settings of a hand-eye session; plain values, so that a recording carries them.

    Attributes
    ----------
    base_frame, flange_frame, sensor_frame : names of the frames.
    standstill : when the robot counts as standing still about a measurement.
    capture_timeout_s : a capture without standstill or without a measurement for so long fails.
    robot_sigma_m, robot_sigma_rad : error of a reported flange pose along and about each axis, one
        sigma; None: found from the samples, but the second of a line laser as `HandEyeSettings`.
    limit_m : largest expected error at the working distance that is accepted.
    """

    base_frame: str = "base"
    flange_frame: str = "tool0"
    sensor_frame: str = "sensor"
    standstill: StandstillRule = field(default_factory=StandstillRule)
    capture_timeout_s: float = 10.0
    robot_sigma_m: float | None = None
    robot_sigma_rad: float | None = None
    limit_m: float = 1e-3

    def document(self) -> dict[str, Any]:
        """Plain values; `of_document` reads them back."""
        return asdict(self)

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "HandEyeConfig":
        """Read what `document` gave, also after JSON.

        Raises
        ------
        InputError
            When it has other settings than this version knows.
        """
        try:
            values = dict(document)
            return cls(standstill=StandstillRule(**values.pop("standstill")), **values)
        except (KeyError, TypeError) as error:
            raise InputError(f"the recorded configuration cannot be read: {error}") from error
