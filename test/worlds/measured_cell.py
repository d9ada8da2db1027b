# SPDX-License-Identifier: Apache-2.0
"""A measured cell with a known truth: the arm off its nominal model, noise and nothing else."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

T_FRAME_BASE = frames.transform(frames.exp_rotation([0.4, -0.3, 2.0]), [3.0, -1.5, 0.7])
TOOLS = {
    "p": frames.transform(frames.exp_rotation([0.3, 0.1, -0.2]), [0.10, -0.05, 0.20]),
    "q": frames.transform(np.eye(3), [-0.15, 0.10, 0.05]),
    "r": frames.transform(np.eye(3), [0.05, 0.20, 0.30]),
}


@dataclass(frozen=True)
class SimulatedCell:
    """``nominal`` is what is known before, ``truth`` what is measured."""

    nominal: SerialArm
    truth: CellModel

    def postures(self, count: int, rng: np.random.Generator) -> np.ndarray:
        arm = self.nominal
        span = np.where(arm.prismatic, 0.5, np.pi)
        return rng.uniform(
            np.maximum(arm.lower, -span), np.minimum(arm.upper, span), (count, arm.n)
        )

    def measure(
        self,
        q: np.ndarray,
        rng: np.random.Generator,
        *,
        noise_m: float = 0.0,
        noise_rad: float | None = None,
        sigma: bool = False,
    ) -> Measurements:
        """Visit each posture with each target; orientation too when ``noise_rad`` is given."""
        targets = self.truth.targets
        q, index = np.repeat(q, len(targets), axis=0), np.tile(np.arange(len(targets)), len(q))
        T = self.truth.predict(q, index)
        turned = None
        if noise_rad is not None:
            wobble = frames.exp_rotation(noise_rad * rng.normal(size=(len(q), 3)))
            turned = wobble @ T[:, :3, :3]
        return Measurements(
            q=q,
            position=T[:, :3, 3] + noise_m * rng.normal(size=(len(q), 3)),
            target=tuple(targets[i] for i in index),
            sample=tuple(f"s{i}" for i in range(len(q))),
            rotation=turned,
            sigma=np.full(len(q), noise_m) if sigma else None,
        )


def make_cell(
    robot: str = "kr150_r3100",
    targets: tuple[str, ...] = ("p",),
    *,
    seed: int = 0,
    length_m: float = 5e-4,
    angle_rad: float = 1e-3,
) -> SimulatedCell:
    """Draw the truth; the deviations of the geometry are normal with these sigmas."""
    nominal, rng = load_robot(robot), np.random.default_rng(seed)
    size = np.where(nominal.parameters.is_length, length_m, angle_rad)
    true_arm = nominal.with_mdh(
        nominal.parameters.add(nominal.mdh, size * rng.normal(size=len(size)))
    )
    tools = np.stack([TOOLS[name] for name in targets])
    return SimulatedCell(nominal, CellModel(true_arm, T_FRAME_BASE, targets, tools))


@pytest.fixture(name="make_cell")
def make_cell_fixture():
    """The function ``make_cell``."""
    return make_cell


@pytest.fixture
def cell() -> SimulatedCell:
    """One KR 150 with one target."""
    return make_cell()


@pytest.fixture
def known_set_up():
    """Give the start at which base and targets are known and only the geometry is not."""
    return lambda cell: replace(cell.truth, arm=cell.nominal)
