# SPDX-License-Identifier: Apache-2.0
"""Compliances without the masses of the links: what one mass at the flange leaves."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from bench.monte_carlo import FRESH, HEAVY, HEAVY_MM, MANY, NOISE_M, POINTS, POSES, ROBOTS
from bench.real_data import campaign, data_folder
from bench.tables import Goal, Table
from robocal_ros.bags.ur10_campaigns import halves
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, TrueRobot, Warmth
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import identify_and_judge
from robocal_ros.identification.full_model import identify_full
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import load_robot


def ways(arm: SerialArm, load: ArmLoad | None) -> dict[str, SerialArm]:
    """The arm with links that weigh nothing, with none that it knows of, and with its load."""
    weightless = ArmLoad(np.zeros(arm.n), np.zeros((arm.n, 3)))
    return {
        "no compliance": replace(arm, load=weightless),
        "one mass at the flange": replace(arm, load=None),
        "with its masses": replace(arm, load=load),
    }


def heavy_table() -> Table:
    """Robots that sag."""
    table = Table(
        "heavy",
        f"KR 150 with 120 kg that sags, {ROBOTS} robots: error at {FRESH} fresh poses",
        ("compliances", "poses", "rms, mm", "goal", "largest rms of a robot, mm"),
        "Simulated: static errors, repeatability, eccentric encoders (10 arc seconds), compliant "
        "joints, no gears; noise 0.05 mm an axis. One mass at the flange: what `robocal identify` "
        "does where the robot file has no load.",
    )
    nominal = load_robot("kr150_r3100")
    effects = replace(Effects.none(), static=True, noise=True, eccentricity=True, compliance=True)
    for poses in (POSES, MANY):
        rng, rms_mm = np.random.default_rng(5), dict[str, list[float]]()
        for _ in range(ROBOTS):
            robot = kr150.true_robot(nominal, rng, effects)
            q = rng.uniform(nominal.lower, nominal.upper, (poses + FRESH, nominal.n))
            exact = robot.point(q, Warmth.cold(nominal.n), POINTS[0], rng)
            position = exact + NOISE_M * rng.normal(size=exact.shape)
            names = tuple(str(i) for i in range(len(q)))
            data = Measurements(q, position, ("p",) * len(q), names)
            train, fresh = data.take(np.arange(poses)), _without_noise(robot, q[poses:])
            for name, arm in ways(nominal, HEAVY).items():
                error = identify_full(arm, train).cell.residual(fresh)
                rms_mm.setdefault(name, []).append(_rms_mm(error))
        for name, found in rms_mm.items():
            rms = float(np.sqrt(np.mean(np.square(found))))
            goal = None if name == "no compliance" else Goal(rms, HEAVY_MM)
            table.add(name, poses, rms, goal, max(found))
    return table


def _without_noise(robot: TrueRobot, q: Array) -> Measurements:
    position = robot.point(q, Warmth.cold(q.shape[1]), POINTS[0], None)
    return Measurements(q, position, ("p",) * len(q), tuple(str(i) for i in range(len(q))))


def _rms_mm(error: Array) -> float:
    return float(np.sqrt(np.mean(np.sum(error**2, axis=1)))) * 1e3


def real_table() -> Table:
    """The UR10 of series A, on its other half and in series D."""
    table = Table(
        "ur10_masses",
        "UR10, series A: with masses, without, and without compliances, mean errors, mm",
        ("compliances", "A, the other half", "D, base and T-Mac refitted", "goal"),
        "As in the tables of real_data; masses by the robot's maker. Goal: half of what they gain.",
    )
    (train, check), later, nominal = halves(campaign("A")), campaign("D"), load_robot("ur10")
    own, there = {}, {}
    for name, arm in ways(nominal, nominal.load).items():
        refit = identify_and_judge(arm, train, later, model="full", check_refit=("base", "tool"))
        own[name] = 1e3 * identify_and_judge(arm, train, check, model="full").candidate.mean_m
        there[name] = 1e3 * refit.candidate.mean_m
    none, found, given = there
    goals = {found: Goal(there[found], 0.5 * (there[none] + there[given]))}
    for name, mean in own.items():
        table.add(name, mean, there[name], goals.get(name))
    return table


def tables() -> Sequence[Table]:
    """All tables of this module; those of real measurements only where these are here."""
    made = [heavy_table()]
    return [*made, real_table()] if data_folder().is_dir() else made
