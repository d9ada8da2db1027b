"""Warm-up by what the robot really does: its joints' motion heats it, standing still cools it."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.cell_sim.draws import Draws, Stream
from robocal_ros.cell_sim.thermal import Warmth, WarmUp

Array = NDArray[np.float64]

ROUNDED_K = 0.1  # a temperature is told in such steps


@dataclass(frozen=True, eq=False)
class HeatPlan:
    """What heats a robot.

    Attributes
    ----------
    rated : (n,) mean speed of each joint that is duty 1, rad/s (prismatic: m/s).
    ambient_c, noise_k : of the cell, and of a told temperature.
    """

    warm_up: WarmUp
    rated: Array
    ambient_c: float = 22.0
    noise_k: float = 0.1


@dataclass(frozen=True, eq=False)
class Temperatures:
    """Motor temperatures (n,), deg C, as told at a time."""

    time_s: float
    celsius: Array


class Heating:
    """A robot that warms up, from cold.

    Attributes
    ----------
    warmth : as it is.
    level : factor on the heat; 0: it stays as it is, or cools.
    """

    def __init__(self, plan: HeatPlan, draws: Draws) -> None:
        self.plan, self._draws = plan, draws
        self.warmth = Warmth.cold(len(plan.rated))
        self.level = 1.0

    def step(self, way: Array, duration_s: float) -> None:
        """The joints went so far (n,), to and fro, in this time."""
        duty = self.level * way / duration_s / self.plan.rated
        self.warmth = self.plan.warm_up.step(self.warmth, duty, duration_s)

    def tell(self, time_s: float, number: int, swapped: bool) -> Temperatures:
        """What the motors' sensors say; ``swapped``: with the second and third cable exchanged."""
        noise = self._draws.of(Stream.TEMPERATURES, number).standard_normal(len(self.plan.rated))
        celsius = self.plan.ambient_c + self.warmth.motor + self.plan.noise_k * noise
        if swapped:
            celsius[[1, 2]] = celsius[[2, 1]]
        return Temperatures(time_s, np.round(celsius / ROUNDED_K) * ROUNDED_K)
