# SPDX-License-Identifier: Apache-2.0
"""A robot that sweeps a tool through two parallel beams along the base's y, as its program does."""

from typing import Any

import numpy as np

from bench.measured_runs import RobotProgram, Sample
from robocal_ros.cell_sim.beams import Sweep, TrueBeam, crossings, joints_at, raised, reported
from robocal_ros.ground import frames
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics.arm import inverse
from robocal_ros.tool.edges import PARALLEL, EdgeSample, ParallelStation
from robocal_ros.tool.touch_points import PLUNGE, R_BASE_FLANGE

STATION = ParallelStation(0.2645, 0.2245, 0.7994, ("top", "bottom"))
ACROSS_M, ASIDE_M = 0.02, 0.1
SPEED_M_S, PLUNGE_M_S = 0.02, 0.005
BELOW_M = 5e-3  # of the tip, under the lower beam
Y_M = -0.1263
WAY = 40  # poses on the way to a sweep


class SweepProgram(RobotProgram):
    """Drives sweeps; ``q`` and ``now_s`` as of `RobotProgram`.

    Attributes
    ----------
    back : whether sweeps along x go back through the beams, too.
    """

    back = True

    def __init__(self, *args: Any, **more: Any) -> None:
        super().__init__(*args, **more)
        self.q[-1] -= 2.0 * np.pi  # the wrist turns up to there

    def beams(self) -> list[TrueBeam]:
        """The upper and the lower one, along y."""
        found = []
        for z in (STATION.up_m, STATION.down_m):
            ends = [np.array([STATION.x_m, Y_M + side * ASIDE_M, z]) for side in (-1.0, 1.0)]
            found.append(TrueBeam(*ends))
        return found

    def sweep(
        self, R_base_flange: Array, tip: Array, name: str, x_m: float | None = None
    ) -> list[Sample]:
        """There and back through both beams, the flange turned so; ``tip`` (3,) as believed.

        ``x_m``: where the flange plunges.
        """
        at = np.array([STATION.x_m, Y_M, STATION.down_m - BELOW_M])
        along, speed = np.array([2.0 * ACROSS_M, 0.0, 0.0]), SPEED_M_S
        start = at - 0.5 * along
        if name == PLUNGE:
            start = np.array([STATION.x_m, Y_M, STATION.up_m + 4e-3])
            along, speed = np.array([0.0, 0.0, -8e-3]), PLUNGE_M_S
        T = frames.transform(R_base_flange, start - R_base_flange @ tip)
        if x_m is not None:
            T[0, 3] = x_m
        duration_s = float(np.linalg.norm(along)) / speed
        there = self._passed(Sweep(T, along, duration_s))
        if self.back or name == PLUNGE:
            there += self._passed(Sweep(raised(T, along), -along, duration_s))
        return there + self.rest(0.3)

    def _passed(self, way: Sweep) -> list[Sample]:
        """One pass; the robot has rested at its begin, and the readings tell its true joints."""
        arm, rate_hz = self.cell.arm, self.cell.plan.rate_hz
        noise, source = self.cell.station.noise, self.cell.station.input
        self.q = self._reached(way(np.zeros(1))[0])
        rest = self.rest(0.2)
        begin_s = self.now_s
        time = np.arange(int(way.duration_s * rate_hz) + 1) / rate_hz
        q = joints_at(arm, way(time), self.q)
        samples: list[Sample] = [
            JointSample(self.ns(begin_s + t), arm.joint_names, joints)
            for t, joints in zip(time.tolist(), q, strict=True)
        ]
        shift = np.zeros((4, 4))
        shift[:3, 3] = noise.step_m * self._rng.standard_normal(3)
        window = (0.0, way.duration_s)
        for name, beam in zip(PARALLEL, self.beams(), strict=True):
            when, dark = crossings(
                beam, self.tool, lambda t: way(t) + shift, window, noise.edge_m, self._rng
            )
            stamps = begin_s + reported(when, source, self._rng)
            samples += [
                EdgeSample(self.ns(t), "parallel", name, bool(b), 0.0)
                for t, b in zip(stamps.tolist(), dark, strict=True)
            ]
        self.now_s, self.q = begin_s + way.duration_s + 1.0 / rate_hz, q[-1]
        return rest + sorted(samples, key=lambda sample: sample.stamp_ns)

    def _reached(self, T_goal: Array) -> Array:
        """Joints (n,) at a pose, by way of poses between."""
        here = self.cell.arm.fk(self.q)
        share = np.linspace(0.0, 1.0, WAY)[:, None]
        turn = frames.exp_rotation(share * frames.log_rotation(T_goal[:3, :3] @ here[:3, :3].T))
        place = here[:3, 3] + share * (T_goal[:3, 3] - here[:3, 3])
        path = frames.transform(turn @ here[:3, :3], place)
        return np.asarray(inverse(self.cell.arm, path, self.q)[-1])


def upright_of(message: str) -> dict[str, Array]:
    """R_base_flange (3, 3) of the next two sweeps, as the second one's answer tells them."""
    told = message.partition("quat_xyzw ")[2]
    found = {}
    for part in told.split(", "):
        name, *quat = part.split()
        found[name] = frames.transform_from_quat([0.0] * 3, [float(x) for x in quat])[:3, :3]
    return found


def plunge_at(message: str) -> float:
    """Flange x, m, of the plunge, as the answer to the last sweep tells it."""
    return 1e-3 * float(message.partition("x_mm ")[2].split()[0])


STRAIGHT = dict(R_BASE_FLANGE)
