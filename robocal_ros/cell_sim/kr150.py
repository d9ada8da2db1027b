# SPDX-License-Identifier: Apache-2.0
"""A KUKA KR 150 R3100 as it might stand in a cell: plausible figures, none measured.

Lengths grow by steel's expansion; what an engineer cannot look up (bending per kelvin, static
errors, encoder phases) is drawn from ``rng``.
"""

import numpy as np

from robocal_ros.cell_sim.gears import gear_errors
from robocal_ros.cell_sim.robot import Effects, FlexibleBody, TrueRobot, WarmUp
from robocal_ros.cell_sim.sensors import SphereSensor
from robocal_ros.ground import frames
from robocal_ros.kinematics import SerialArm

UNCORRECTED = 0.45  # share within 0.1 mm: the middle of the published 43 to 49 %
EXPANSION_PER_K = 12e-6
HOUSING_M = 0.25  # a drive's housing grows too, also where the nominal length is zero
BENDING_RAD_PER_K = 1.5e-6
STATIC_LENGTH_M = 4e-4
STATIC_ANGLE_RAD = float(np.radians(0.02))
ECCENTRICITY_RAD = float(np.radians(10.0 / 3600.0))
REPEATABILITY_RAD = 1e-5  # 0.02 mm per axis at the tool
# As in config/robots/kr150_r3100.yaml, with the source.
FASTEST_RAD_S = np.radians([105.0, 107.0, 114.0, 179.0, 172.0, 219.0])

# Heat sits at joints 2 to 4; duty 1 is the rated programme.
WARM_UP = WarmUp(
    motor_rise=np.array([20.0, 34.0, 34.0, 26.0, 18.0, 16.0]),
    motor_tau_s=2400.0,
    link_share=np.array([0.4, 0.4, 0.5, 0.4, 0.4, 0.3]),
    link_tau_s=3600.0,
)

BODY = FlexibleBody(
    mass=np.array([420.0, 190.0, 260.0, 70.0, 40.0, 120.0]),
    centre=np.array(
        [
            [-0.25, 0.15, 0.0],
            [-0.70, 0.0, 0.1],
            [0.0, 0.0, 0.15],
            [0.0, 0.25, 0.0],
            [0.0, 0.0, 0.05],
            [0.0, 0.0, 0.15],
        ]
    ),
    stiffness=np.array([4.0e6, 4.5e6, 3.5e6, 6.0e5, 6.0e5, 4.0e5]),
    softening=1e-4,  # half of what steel loses: a gear warms by about half its motor's rise
)

BALL = np.array([0.09, 0.0, 0.20])
TOOL = np.array([0.0, 0.0, 0.30])  # the tool centre point that is judged
T_SENSOR_BASE = frames.invert(  # it looks along +y, 30 deg down
    frames.transform(frames.exp_rotation([np.radians(-120.0), 0.0, 0.0]), [1.70, -0.90, 1.20])
)


def true_robot(
    nominal: SerialArm, rng: np.random.Generator, effects: Effects | None = None
) -> TrueRobot:
    """One robot of the type; ``rng`` makes it an individual."""
    n = nominal.n
    length = np.array([True, False, True, False, False])
    static = rng.standard_normal((n, 5)) * np.where(length, STATIC_LENGTH_M, STATIC_ANGLE_RAD)
    motor_gain, link_gain = np.zeros((n, 5, n)), np.zeros((n, 5, n))
    for i in range(n):
        housing = HOUSING_M * EXPANSION_PER_K * rng.uniform(0.0, 1.0, 2)
        motor_gain[i, [0, 2], i] = housing
        link_gain[i, [0, 2], i] = nominal.mdh[i, [0, 2]] * EXPANSION_PER_K
        bending = BENDING_RAD_PER_K * rng.standard_normal((2, 3))
        motor_gain[i, [1, 3, 4], i] = bending[0]
        link_gain[i, [1, 3, 4], i] = bending[1] - bending[0]
    return TrueRobot(
        nominal=nominal,
        static_error=static,
        motor_gain=motor_gain,
        link_gain=link_gain,
        body=BODY,
        eccentricity=np.full(n, ECCENTRICITY_RAD),
        phase=rng.uniform(-np.pi, np.pi, n),
        repeatability=REPEATABILITY_RAD,
        effects=effects or Effects(),
        gears=gear_errors(n, rng.spawn(1)[0]),
    )


def sphere_sensor(effects: Effects | None = None) -> SphereSensor:
    """The sensor of the cell, beside the robot at table height."""
    return SphereSensor(T_SENSOR_BASE, BALL, effects=effects or Effects())
