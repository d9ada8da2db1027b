# SPDX-License-Identifier: Apache-2.0
"""A UR10 that errs as real ones do, made by code of its own: joint errors and weight."""

from contextlib import suppress
from dataclasses import replace

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import LimitError
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.joint_functions import STANDARD_GRAVITY
from robocal_ros.kinematics.robots import load_robot

NOISE_M = 30e-6
COMPLIANCE = np.array([0.0, 9e-6, 12e-6, 0.0, 0.0, 0.0])  # rad/(N m), as on a real UR10
LOWER = np.radians([-150.0, -140.0, -120.0, -150.0, -120.0, -150.0])
UPPER = np.radians([60.0, -20.0, 120.0, 100.0, 120.0, 150.0])
TIP = np.array([0.05, -0.08, 0.15])


class BentRobot:
    """A UR10 with errors that no class of the estimator makes: harmonics and weight."""

    def __init__(self, seed, size_rad=250e-6, compliance=COMPLIANCE, noise_m=NOISE_M):
        self.rng = np.random.default_rng(seed)
        self.nominal = load_robot("ur10")
        spread = np.where(self.nominal.parameters.is_length, 3e-4, 3e-4)
        change = spread * self.rng.standard_normal(len(spread))
        mdh = self.nominal.parameters.add(self.nominal.mdh, change)
        self.rigid = replace(self.nominal, mdh=mdh, load=None)
        self.order = self.rng.uniform(3.0, 25.0, (6, 8))  # periods in a turn, whole or not
        self.phase = self.rng.uniform(0.0, 2.0 * np.pi, (6, 8))
        self.size, self.compliance, self.noise_m = size_rad / 2.0, compliance, noise_m
        turn = frames.exp_rotation(np.array([0.1, -0.2, 2.0]))
        self.T_frame_base = frames.transform(turn, [1.5, -0.4, 0.7])

    def own_error(self, q):
        return self.size * np.sum(np.sin(self.order * q[..., None] + self.phase), axis=-1)

    def potential(self, q):
        """Of all links (m,), J, one link after another."""
        total, load, arm = np.zeros(len(q)), self.nominal.load, self.nominal
        for count in range(1, 7):
            part = replace(
                arm, joint_names=arm.joint_names[:count], mdh=arm.mdh[:count], load=None,
                sign=arm.sign[:count], prismatic=arm.prismatic[:count],
                lower=arm.lower[:count], upper=arm.upper[:count],
            )  # fmt: skip
            height = (part.fk(q[:, :count]) @ np.append(load.centre[count - 1], 1.0))[:, 2]
            total += STANDARD_GRAVITY * load.mass[count - 1] * height
        return total

    def torque(self, q):
        step = 1e-5 * np.eye(6)
        change = [self.potential(q + s) - self.potential(q - s) for s in step]
        return -np.stack(change, axis=1) / 2e-5

    def poses(self, count, lower=LOWER, upper=UPPER):
        return self.rng.uniform(lower, upper, (count, 6))

    def measured(self, q, noise_m=None):
        turned = q + self.own_error(q) + self.compliance * self.torque(q)
        point = self.T_frame_base @ self.rigid.fk(turned) @ np.append(TIP, 1.0)
        noise = self.noise_m if noise_m is None else noise_m
        position = point[:, :3] + noise * self.rng.standard_normal((len(q), 3))
        names = tuple(str(i) for i in range(len(q)))
        return Measurements(q=q, position=position, target=("tip",) * len(q), sample=names)

    def oriented(self, count, wobble_rad=0.0, reach_m=(0.2, 0.25, 0.2)):
        """Poses (count, 6) of one orientation of the flange, but for some wobble, within reach."""
        start = np.radians([20.0, -70.0, 100.0, -120.0, -90.0, 10.0])
        T = self.nominal.fk(start)
        found = []
        while len(found) < count:
            way = np.repeat(T[None], 12, axis=0)
            shift = self.rng.uniform(-1.0, 1.0, 3) * reach_m
            way[:, :3, 3] += np.linspace(0.0, 1.0, 12)[:, None] * shift
            turn = frames.exp_rotation(wobble_rad * self.rng.standard_normal(3))
            way[-1, :3, :3] = turn @ T[:3, :3]
            with suppress(LimitError):
                found.append(inverse(self.nominal, way, start)[-1])
        return np.array(found)
