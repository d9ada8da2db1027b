# SPDX-License-Identifier: Apache-2.0
"""Setting up: how well the sensor is placed, and what planned poses are worth. Simulated."""

from collections.abc import Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bench.tables import Goal, Table
from bench.thermal_shifts import MEASURING, SIGMA_M
from docs.examples.make_thermal import poses
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, Warmth
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.thermal.cell_setup import (
    Design,
    PosePlan,
    SensorField,
    calibrate_sensor,
    candidate_poses,
    plan_poses,
)
from robocal_ros.thermal.identification import drift_prior

Array = NDArray[np.float64]

RUNS = 300
NOISE_M = 2e-5
LARGEST_RATIO = 1.1
PLANNED_SHARE = 2.0 / 3.0  # of the error that as many random poses leave
COUNT, CANDIDATES, ROUNDS = 6, 1000, 3


def sensor_table() -> Table:
    """Errors of the placed sensor against the least possible ones."""
    table = Table(
        "thermal_sensor",
        f"Placing the sensor: rms error over the Cramér-Rao bound, {RUNS} runs",
        ("poses", "base, mm", "turn, mdeg", "sphere, mm", "base / bound", "turn / bound",
         "sphere / bound", "goal (largest)"),
        "Simulated: the nominal KR 150, noise of 0.02 mm per axis. Rms over the three axes, and "
        "the bound's. The largest of the three ratios is known to about 4 %.",
    )  # fmt: skip
    for count in (9, 20):
        rmse, bound = _sensor_errors(poses("sphere")[:count])
        ratio = rmse / bound
        table.add(
            count, rmse[0] * 1e3, float(np.degrees(rmse[1])) * 1e3, rmse[2] * 1e3,
            *ratio.tolist(), Goal(float(ratio.max()), LARGEST_RATIO),
        )  # fmt: skip
    return table


def _sensor_errors(q: Array) -> tuple[Array, Array]:
    """Rms error and its bound (3,) of base, turn and sphere; m and rad."""
    arm, rng = load_robot("kr150_r3100"), np.random.default_rng(5)
    robot = kr150.true_robot(arm, rng, Effects.none())
    flange = robot.flange(q, Warmth.cold(arm.n))
    exact = _centres(np.zeros(9), flange)
    step = 1e-6 * np.eye(9)
    J = np.stack(
        [(_centres(h, flange) - _centres(-h, flange)).ravel() / 2e-6 for h in step], axis=1
    )
    bound = NOISE_M**2 * np.diag(np.linalg.inv(J.T @ J))
    squares = np.zeros(9)
    for _ in range(RUNS):
        position = exact + NOISE_M * rng.standard_normal(exact.shape)
        names = tuple(str(i) for i in range(len(q)))
        sigma = np.full(len(q), NOISE_M)
        data = Measurements(q, position, ("ball",) * len(q), names, sigma=sigma)
        squares += _error(arm, data) ** 2
    return (
        np.sqrt(squares.reshape(3, 3).sum(axis=1) / RUNS),
        np.sqrt(bound.reshape(3, 3).sum(axis=1)),
    )


def _centres(change: Array, flange: Array) -> Array:
    """Sphere centres (m, 3) in a sensor that is shifted and turned, on a shifted sphere."""
    turn = frames.exp_rotation(change[3:6])
    T = kr150.T_SENSOR_BASE
    p = flange @ np.append(kr150.BALL + change[6:], 1.0)
    return np.asarray(p[:, :3] @ (turn @ T[:3, :3]).T + T[:3, 3] + change[:3])


def _error(arm: SerialArm, data: Measurements) -> Array:
    found = calibrate_sensor(arm, data)
    true = kr150.T_SENSOR_BASE
    turn = found.T_sensor_base[:3, :3] @ true[:3, :3].T
    angles = Rotation.from_matrix(turn).as_rotvec()
    shift = found.T_sensor_base[:3, 3] - true[:3, 3]
    return np.concatenate([shift, angles, found.sphere_in_flange - kr150.BALL])


@cache
def planned(count: int = CANDIDATES) -> PosePlan:
    """Six poses for the nominal robot's cell and the default prior, out of so many candidates."""
    design, candidates = _design(count)
    return plan_poses(design.of_first(count), candidates[:count], COUNT, np.random.default_rng(1))


def _design(count: int) -> tuple[Design, Array]:
    """Of candidates, and of the poses of the shifts behind them."""
    cell, arm = _cell(), load_robot("kr150_r3100")
    candidates = candidate_poses(cell, SensorField(), count, np.random.default_rng(0))
    both = np.vstack([candidates, poses("sphere")[list(MEASURING)]])
    prior = drift_prior(arm)
    design = Design.of(cell, both, poses("check"), kr150.TOOL, prior, SIGMA_M, ROUNDS)
    return design, both


def _cell() -> CellModel:
    ball = frames.transform(np.eye(3), kr150.BALL)[None]
    return CellModel(load_robot("kr150_r3100"), kr150.T_SENSOR_BASE, ("ball",), ball)


def poses_table() -> Table:
    """Planned poses against random ones."""
    table = Table(
        "thermal_poses",
        f"{COUNT} poses a cycle: predicted rms error of the tool after one cycle, mm",
        ("candidates", "before", "random poses", "poses of the shifts", "planned",
         "planned / random", "goal"),
        "Default prior, candidates in the sensor's field, 34 working poses. Random: the median of "
        "50 draws of the candidates. 1000 candidates is the default of the command.",
    )  # fmt: skip
    for count in (500, CANDIDATES, 2000):
        plan, (design, _) = planned(count), _design(count)
        ratio = plan.predicted_rms_m / plan.random_rms_m
        own = design.error(list(range(count, count + len(MEASURING))))
        figures = (plan.before_rms_m, plan.random_rms_m, own, plan.predicted_rms_m)
        goal = Goal(ratio, PLANNED_SHARE) if count == CANDIDATES else None
        table.add(count, *(1e3 * x for x in figures), ratio, goal)
    return table


def tables() -> Sequence[Table]:
    """All of them."""
    return [sensor_table(), poses_table()]
