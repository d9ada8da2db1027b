"""Which circles and plunges measure a tool: each follows from what is known by then."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.tool.crossed_model import StepKind
from robocal_ros.tool.laser_frame import LaserFrame
from robocal_ros.tool.tool_axis import upright_pose

Array = NDArray[np.float64]
Mode = Literal["full", "quick"]

STEPS: Mapping[Mode, tuple[str, ...]] = {
    "full": ("low", "high", "upright", "plunge_1", "plunge_2"),
    "quick": ("circle", "plunge"),
}
START_RAD = float(np.pi / 4.0)  # in mid-quadrant: no circle begins on a beam


@dataclass(frozen=True)
class MeasuringMotion:
    """Sizes and speeds of the steps, m and m/s.

    Attributes
    ----------
    radius_m, speed_m_s : of the circles.
    height_m : between the circles; the longer, the better the axis.
    above_tip_m : where the lower circles meet the tool.
    plunge_depth_m, plunge_speed_m_s : of the plunges, half of the depth below the beams.
    """

    radius_m: float = 0.012
    speed_m_s: float = 0.05
    height_m: float = 0.05
    above_tip_m: float = 5e-3
    plunge_depth_m: float = 7e-3
    plunge_speed_m_s: float = 0.01

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not 0.0 < value < np.inf:
                raise InputError(f"{name} = {value}: must be positive")

    @property
    def period_s(self) -> float:
        """Of a turn."""
        return 2.0 * np.pi * self.radius_m / self.speed_m_s


@dataclass(frozen=True, eq=False)
class PlannedStep:
    """A circle or a plunge to be driven; the flange's orientation is held.

    Attributes
    ----------
    number, of : place in the run, from 1.
    T_base_flange : (4, 4) at the circle's centre, or where the plunge begins and ends.
    R_base_laser : (3, 3) the circle lies in its x-y plane; the plunge goes along -z and back.
    radius_m, speed_m_s : of a circle; ``direction`` +1 counter-clockwise about the laser's z.
    depth_m : of a plunge; its speed is ``speed_m_s``.
    """

    name: str
    kind: StepKind
    number: int
    of: int
    T_base_flange: Array
    R_base_laser: Array
    speed_m_s: float
    radius_m: float = 0.0
    direction: int = 1
    start_rad: float = START_RAD
    depth_m: float = 0.0


@dataclass(frozen=True, eq=False)
class MeasuringPlan:
    """The steps of a run.

    Attributes
    ----------
    T_flange_tool : (4, 4) the taught tool (full) or the stored one (quick).
    spin_rad : turn of the flange about the laser's z: with 0 its x lies along the laser's x.
    """

    mode: Mode
    laser: LaserFrame
    T_flange_tool: Array
    motion: MeasuringMotion = field(default_factory=MeasuringMotion)
    spin_rad: float = 0.0

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the steps in turn."""
        return STEPS[self.mode]

    def step(self, number: int, seen: Array | None = None) -> PlannedStep:
        """Step ``number`` (from 1).

        ``seen`` (4, 4): the tool in the flange frame as the steps so far show it; needed by what
        `needs_tool` names.

        Raises
        ------
        InputError
            When it is missing.
        """
        name = self.names[number - 1]
        if self.needs_tool(number) and seen is None:
            raise InputError(f"step {name} follows from the steps before it: measure them first")
        tool = self.T_flange_tool if seen is None or not self.needs_tool(number) else seen
        plunge = name.startswith("plunge")
        T = self._pose(
            tool, -0.5 * self.motion.plunge_depth_m if plunge else self.motion.above_tip_m
        )
        if name == "high":
            # Straight below the first circle: the tool is not set upright yet.
            T[:3, 3] -= self.motion.height_m * self.laser.T_base_laser[:3, 2]
        return PlannedStep(
            name=name,
            kind="plunge" if plunge else "circle",
            number=number,
            of=len(self.names),
            T_base_flange=T,
            R_base_laser=self.laser.T_base_laser[:3, :3],
            speed_m_s=self.motion.plunge_speed_m_s if plunge else self.motion.speed_m_s,
            radius_m=0.0 if plunge else self.motion.radius_m,
            direction=1 if number % 2 else -1,
            depth_m=self.motion.plunge_depth_m if plunge else 0.0,
        )

    def needs_tool(self, number: int) -> bool:
        """Whether a step follows from what the ones before it show."""
        return self.mode == "full" and self.names[number - 1] not in ("low", "high")

    def _pose(self, T_flange_tool: Array, above_tip_m: float) -> Array:
        """Flange pose with the tool upright and a point of its axis on the crossing."""
        spin = frames.exp_rotation([0.0, 0.0, self.spin_rad])
        down = self.laser.T_base_laser[:3, :3] @ spin @ np.diag([1.0, -1.0, -1.0])
        point = T_flange_tool[:3, 3] - above_tip_m * T_flange_tool[:3, 2]
        near = frames.transform(down, np.zeros(3))
        return upright_pose(self.laser, near, T_flange_tool[:3, 2], point)
