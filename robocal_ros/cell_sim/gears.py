# SPDX-License-Identifier: Apache-2.0
"""What the joints of a true robot turn besides what their encoders show: gears, and backlash.

Sums of sines, where the estimators have splines: another code path, so that neither hides the
other's mistakes. Where the sizes come from stands in docs/simulation.md.
"""

import csv
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from robocal_ros.ground.frames import Array

# 1 minute of arc between the extremes is what makers of gears for robots allow; of some sines the
# extremes are 5.4 standard deviations apart.
GEAR_RAD = float(np.radians(1.0 / 60.0)) / 5.4
LINES, PERIODS = 8, (1.0, 70.0)  # in a turn: as a UR10's
LOST_MOTION_RAD = 7e-5  # 0.1 mm at 1.45 m, as an IRB 1600's
# Of a UR10 from 11 911 poses in the order in which they were measured; of the last joint as of the
# one before, for the target was near its axis.
UR10_LOST_MOTION_RAD = np.array([25e-6, 20e-6, 17e-6, 48e-6, 90e-6, 90e-6])


@dataclass(frozen=True, eq=False)
class GearErrors:
    """What joints turn besides what their encoders show, as gears and couplings make them.

    The sum over k of ``amplitude sin(frequency q + phase)``; and backlash: a joint that turns back
    stays where it is until its reading has gone by its ``lost_motion``.

    ``amplitude``, ``frequency``, ``phase`` (n, k): rad; periods in a turn, which need not be whole;
    rad.
    ``lost_motion`` (n,): rad.
    """

    amplitude: Array
    frequency: Array
    phase: Array
    lost_motion: Array

    def at(self, q: Array) -> Array:
        """What each joint adds at readings (m, n), rad."""
        waves = np.sin(q[..., None] * self.frequency + self.phase)
        return np.asarray(np.sum(self.amplitude * waves, axis=-1))

    def behind(self, way: Array) -> Array:
        """How far joints are behind their readings (..., n), rad, after a long ``way`` (..., n)."""
        return np.asarray(0.5 * self.lost_motion * np.sign(way))


class BacklashPlay:
    """How far backlash holds joints (n,) back over time: they follow once all the play is taken up.

    From ``q`` (n,) on, in the middle of their play.
    """

    def __init__(self, gears: GearErrors, q: Array) -> None:
        self._half, self._joint = 0.5 * gears.lost_motion, np.array(q)
        self._passes = [(np.zeros(1), np.zeros((1, len(q))))]

    def follow(self, time_s: Array, q: Array) -> None:
        """Readings (m, n) at times (m,), the first of which is the last one of before."""
        joint, low, high = np.empty_like(q), q - self._half, q + self._half
        before = self._joint
        for here, least, most in zip(joint, low, high, strict=True):
            np.minimum(np.maximum(before, least, out=here), most, out=here)
            before = here
        self._joint = before.copy()
        self._passes = [*self._passes[-1:], (time_s, q - joint)]

    def at(self, time_s: Array) -> Array:
        """How far (m, n), rad, at times (m,) of the last two passes."""
        known_s, behind = (np.concatenate(part) for part in zip(*self._passes, strict=True))
        return np.stack([np.interp(time_s, known_s, one) for one in behind.T], axis=1)


def gear_errors(n: int, rng: np.random.Generator) -> GearErrors:
    """Gears of n joints as their makers allow."""
    share = rng.uniform(0.3, 1.0, (n, LINES))
    share *= GEAR_RAD * np.sqrt(2.0) / np.linalg.norm(share, axis=1, keepdims=True)
    return GearErrors(
        amplitude=share,
        frequency=rng.uniform(*PERIODS, (n, LINES)),
        phase=rng.uniform(-np.pi, np.pi, (n, LINES)),
        lost_motion=np.full(n, LOST_MOTION_RAD),
    )


def ur10_gears() -> GearErrors:
    """Those of a real UR10, as identified."""
    with Path(__file__).with_name("ur10_gears.csv").open(newline="") as stream:
        rows = np.array(list(csv.reader(stream))[1:], dtype=np.float64).reshape(6, -1, 4)
    _, frequency, amplitude_urad, phase_deg = np.moveaxis(rows, 2, 0)
    phase = np.radians(phase_deg)
    return GearErrors(1e-6 * amplitude_urad, frequency, phase, UR10_LOST_MOTION_RAD)
