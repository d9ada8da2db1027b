# SPDX-License-Identifier: Apache-2.0
"""Make the sample tables beside this file: ``.venv/bin/python docs/examples/make_measurements.py``.

Simulated, nothing was measured: a UR10 that is off its nominal model by tenths of a millimetre,
a ball on its flange and a measuring device with noise of 0.05 mm. ``later.csv`` is another day: the
device stands elsewhere, the ball is mounted anew, the robot is the same.
"""

from pathlib import Path

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_description
from robocal_ros.kinematics.tables import write_measurements

FOLDER = Path(__file__).parent
NOISE_M = 5e-5
ERROR_M, ERROR_RAD = 3e-4, np.radians(0.02)


def as_built(nominal: SerialArm, rng: np.random.Generator) -> SerialArm:
    """The robot with errors in all of its parameters."""
    size = np.where(nominal.parameters.is_length, ERROR_M, ERROR_RAD)
    return nominal.with_mdh(nominal.parameters.add(nominal.mdh, rng.normal(scale=size)))


def measured(
    arm: SerialArm, day: str, count: int, place_m: list[float], ball_m: list[float], seed: int
) -> Measurements:
    """Random poses, seen by a device at ``place_m``, in m."""
    rng = np.random.default_rng(seed)
    q = np.round(rng.uniform(-120.0, 120.0, (count, arm.n)), 3)  # as a controller shows them
    q = np.radians(q)
    T_frame_base = frames.transform(frames.exp_rotation(rng.normal(size=3)), place_m)
    points = (T_frame_base @ arm.fk(q) @ np.array([*ball_m, 1.0]))[:, :3]
    return Measurements(
        q=q,
        position=points + rng.normal(scale=NOISE_M, size=points.shape),
        target=("ball",) * count,
        sample=tuple(f"{day}-{i}" for i in range(1, count + 1)),
    )


def main() -> None:
    """Write both tables."""
    nominal = load_description("ur10").arm
    arm = as_built(nominal, np.random.default_rng(1))
    first = measured(arm, "simulated", 120, [2.0, 1.0, -0.5], [0.05, 0.04, 0.15], 2)
    later = measured(arm, "simulated-later", 30, [-1.5, 2.2, -0.4], [-0.03, 0.06, 0.16], 3)
    write_measurements(FOLDER / "measured.csv", first, nominal)
    write_measurements(FOLDER / "later.csv", later, nominal)


if __name__ == "__main__":
    main()
