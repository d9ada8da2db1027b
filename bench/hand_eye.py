# SPDX-License-Identifier: Apache-2.0
"""Line laser on a flange: against the bound, whether covariances are true, plans; all simulated.

Of sensors and robots that err as real ones do; `bench.hand_eye_profiles` takes other conditions.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bench import hand_eye_profiles
from bench.hand_eye_bound import moved
from bench.hand_eye_cell import PoseRobot
from bench.hand_eye_worlds import (
    CELL,
    CENTRE,
    GAUGED_M,
    LINE,
    RADIUS_M,
    STAIRCASE,
    T_BASE_USER,
    Draw,
    X,
    line_world,
    sphere_world,
    squared_error,
    step_world,
)
from bench.tables import Goal, Table
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground.errors import RankDeficientError, RobocalError
from robocal_ros.hand_eye.planning import (
    PlannedLine,
    PlannedSphere,
    PlannedStairs,
    PlannedTarget,
    check_plan,
)
from robocal_ros.hand_eye.profiles import SensorRange
from robocal_ros.hand_eye.result import PoseNoise, expected_error_m, increment

Array = NDArray[np.float64]

RUNS = 60
CLASSIC_RUNS = 20
PLANS, PLANNED_RUNS = 4, 5
UNKNOWNS = 6
NEAR = np.repeat([2e-3, 0.02], 3)  # m, rad: how well a plan knows the mount
CASES: dict[str, Draw] = {
    "sphere, 15 poses": sphere_world,
    "stairs, 5 poses": step_world,
    "known edge, 15 poses": lambda rng: line_world(rng, True),
    "unknown edge, 15 poses": lambda rng: line_world(rng, False),
}
CONDITIONS = (
    "Simulated, whole profiles, new poses in each run: tilted up to 25 deg, a sensor of 190 to 210 "
    "mm that errs as real ones do (0.015 mm of scatter, a field bent by 0.02 to 0.05 mm, wrong "
    "points at ends, outliers, rounded tops), poses off by 0.12 mm along and 0.1 mrad about each "
    "axis (not told), light laid on the stairs' marks to 0.2 mm, stairs gauged to 0.005 mm"
)


@dataclass(frozen=True, eq=False)
class Runs:
    """Outcomes of n runs.

    Attributes
    ----------
    best : (n, 6) increments from the true mount about the middle of what is seen; ``classic``:
        (k, 6) of the first ones, where the published method gave any; ``failed``: where not.
    reached : (n, 6) increments of the estimate that reaches the bound, from the poses' errors.
    squared : (n,) squared errors of the best method in units of its own covariance.
    bound, of_poses : (n, 6, 6), and what of it comes from the poses; ``apart``: largest difference
        between it and the estimator's own.
    robot_m : (n,) robot's noise as found; ``lost``: share of shots not used;
        ``refused``: of runs, as poses that do not show all directions.
    """

    best: Array
    classic: Array
    failed: int
    reached: Array
    squared: Array
    bound: Array
    of_poses: Array
    apart: float
    robot_m: Array
    lost: float
    refused: float

    def least_m(self) -> float:
        """Root of the bound's mean trace, of shifts in the middle of the field."""
        return float(np.sqrt(np.trace(self.bound[:, :3, :3], axis1=1, axis2=2).mean()))

    def reached_m(self) -> tuple[float, float]:
        """Rms error there, and its standard error, m.

        Most of each error is what the poses' errors do to any estimate: that part is known, with
        its expectation, and only the rest is counted (a control variate).
        """
        of_poses = np.trace(self.of_poses[:, :3, :3], axis1=1, axis2=2)
        more = np.sum(self.best[:, :3] ** 2 - self.reached[:, :3] ** 2, axis=1)
        rms = float(np.sqrt(of_poses.mean() + more.mean()))
        return rms, float(more.std(ddof=1) / np.sqrt(len(more)) / (2.0 * rms))


def rms_mm(error: Array) -> float:
    """Of shifts (n, 6) in the middle of the field."""
    return 1e3 * float(np.sqrt(np.mean(np.sum(error[:, :3] ** 2, axis=1))))


@cache
def outcomes(draw: Draw, runs: int, classic_runs: int = 0) -> Runs:
    """Draw poses and noise anew and calibrate."""
    rows: list[tuple[Array, ...]] = []
    classic: list[Array] = []
    apart, lost, shown, refused, failed = 0.0, 0, 0, 0, 0
    for seed in range(runs):
        rng = np.random.default_rng([50, seed])
        world = draw(rng)
        made = world.shot(rng)
        try:
            found = made.solve()
        except RankDeficientError:
            refused += 1
            continue
        least, own = world.least(made, found.pivot)
        unit = np.sqrt(np.diag(least.covariance))
        apart = max(apart, float(np.abs((own - least.covariance) / np.outer(unit, unit)).max()))
        rows.append((
            increment(X, found.T_flange_sensor, found.pivot), least.step, least.covariance,
            least.of_poses, np.array([squared_error(found), found.more["robot_sigma_mm"] * 1e-3]),
        ))  # fmt: skip
        lost += len({name.partition("/")[0] for name in found.rejected})
        shown += len(made.data.names)
        if seed >= classic_runs:
            continue
        try:
            other = made.solve("classic").T_flange_sensor
        except RobocalError:
            failed += 1
        else:
            classic.append(increment(X, other, found.pivot))
    best, reached, bound, of_poses, figures = (np.array(part) for part in zip(*rows, strict=True))
    return Runs(
        best, np.array(classic).reshape(-1, 6), failed, reached, figures[:, 0], bound, of_poses,
        apart, figures[:, 1], lost / shown, refused / runs,
    )  # fmt: skip


def bound_table() -> Table:
    """Errors over the least possible ones."""
    table = Table(
        "hand_eye_bound",
        "Mount of a line laser: rms error, mm, in the middle of the field",
        ("target", "best", "bound", "ratio", "its standard error", "goal",
         "estimator's own bound apart"),
        f"{CONDITIONS}; {RUNS} runs. Bound: Cramer-Rao with all noise known, the poses' errors as "
        "nuisance and the sensor straight, from numeric derivatives of a geometry of the bench's "
        "own; last column: how far the estimator's bound differs from it.",
    )  # fmt: skip
    for name, draw in CASES.items():
        runs = outcomes(draw, RUNS, CLASSIC_RUNS)
        (best, error), least = runs.reached_m(), runs.least_m()
        ratio, error = best / least, error / least
        goal = Goal(ratio, round(1.06 + 2.0 * error, 3))
        table.add(name, 1e3 * best, 1e3 * least, ratio, error, goal, Goal(runs.apart, 1e-5))
    return table


def covariance_table() -> Table:
    """Is the reported covariance true?"""
    table = Table(
        "hand_eye_covariance",
        "The same: squared error over the reported covariance",
        ("target", "mean of d2 / 6", "goal", "beyond the 95 % quantile, %", "robot found, mm",
         "shots not used, %", "runs refused, %"),
        f"{RUNS} runs. The noise is found from the same poses, so that errors have the tails of "
        "Student's t: more than 5 % lie beyond the quantile of chi-square. Not used: of an edge "
        "one side may be out of range or hidden from the camera. Refused: poses that leave a "
        "direction open.",
    )  # fmt: skip
    limit = chi2_quantile(0.95, UNKNOWNS)
    for name, draw in CASES.items():
        runs = outcomes(draw, RUNS, CLASSIC_RUNS)
        mean = float(runs.squared.mean()) / UNKNOWNS
        table.add(
            name, mean, Goal(mean, 1.25) if mean > 1.0 else Goal(mean, 0.8, at_least=True),
            100.0 * float(np.mean(runs.squared > limit)), 1e3 * float(np.median(runs.robot_m)),
            100.0 * runs.lost, 100.0 * runs.refused,
        )  # fmt: skip
    return table


def classic_table() -> Table:
    """Both methods, each with its own features of the same profiles."""
    table = Table(
        "hand_eye_classic",
        "The methods as published beside the best: rms error of the mount, mm, in the field",
        ("target", "pose error an axis, mm", "best", "classic", "classic over best",
         "classic fails, %"),
        f"{CONDITIONS}; {CLASSIC_RUNS} runs each. Classic takes its features from the profiles as "
        "published too: circles, corners where a profile splits, the extremum of its second "
        "derivative. It fails where it finds none, or its solution creeps.",
    )  # fmt: skip
    for name, draw in CASES.items():
        _add_classic(table, name, PoseRobot().position_m, draw)
    for pose_m in (2e-5, 1e-4):
        _add_classic(table, "sphere, 15 poses", pose_m, _sphere_with(pose_m))
    return table


def _add_classic(table: Table, name: str, pose_m: float, draw: Draw) -> None:
    runs = outcomes(draw, RUNS if draw in CASES.values() else CLASSIC_RUNS, CLASSIC_RUNS)
    best = rms_mm(runs.best[:CLASSIC_RUNS])
    classic = rms_mm(runs.classic) if len(runs.classic) else None
    failed = 100.0 * runs.failed / CLASSIC_RUNS
    ratio = None if classic is None else classic / best
    table.add(name, 1e3 * pose_m, best, classic, ratio, failed)


@cache
def _sphere_with(pose_m: float) -> Draw:
    return lambda rng: sphere_world(rng, robot=PoseRobot(pose_m, 0.0))


def plan_table() -> Table:
    """What `check-plan` expects of poses against what becomes of them."""
    half_m = 0.5 * (CELL.sensor.far_m - CELL.sensor.near_m)
    width_m = 2.0 * 0.2 * float(np.tan(CELL.sensor.half_angle_rad))
    sensor = SensorRange(half_m, -half_m, width_m, noise_m=CELL.sensor.noise_m)
    target = STAIRCASE.target(T_BASE_USER, sigma_m=GAUGED_M)
    line = np.stack([LINE.point_base, LINE.direction_base])
    planned: tuple[PlannedTarget, ...] = (
        PlannedSphere(RADIUS_M, sensor, (CENTRE[0], CENTRE[1], CENTRE[2])),
        PlannedStairs(target, sensor, ("near", "far")),
        PlannedLine(sensor, line),
        PlannedLine(sensor),
    )
    table = Table(
        "hand_eye_plan",
        "Planned poses: expected error in the field of view, mm, and what it comes to",
        ("target", "expected", "achieved", "achieved over expected", "goal"),
        f"Simulated, whole profiles, {PLANNED_RUNS} runs from each of {PLANS} plans; the plan "
        "knows the mount to 2 mm and 0.02 rad, the sphere's centre, how well stairs are gauged, "
        "the noise of sensor, robot and eye. Goal: within 1.5 either way.",
    )
    for (name, draw), plan in zip(CASES.items(), planned, strict=True):
        expected, achieved = _planned(draw, plan)
        ratio = achieved / expected
        side = Goal(ratio, 1.5) if ratio > 1.0 else Goal(ratio, 1.0 / 1.5, at_least=True)
        table.add(name, 1e3 * expected, 1e3 * achieved, ratio, side)
    return table


def _planned(draw: Draw, plan: PlannedTarget) -> tuple[float, float]:
    """Expected and achieved rms error, m, in the field of view."""
    expected, achieved = [], []
    for seed in range(PLANS):
        rng = np.random.default_rng([60, seed])
        world = draw(rng)
        noise = PoseNoise(world.noise.pose_m, world.noise.pose_rad, world.noise.aim_m)
        near = moved(X, NEAR * rng.standard_normal(6), np.zeros(3))
        report = check_plan(plan, world.true_T_base_flange, near, noise, 1.0)
        if report.working_error_m is None:
            raise ValueError(f"the plan is refused: {report.verdict.reason}")
        expected.append(report.working_error_m**2)
        for _ in range(PLANNED_RUNS):
            step = increment(X, world.shot(rng).solve().T_flange_sensor, np.zeros(3))
            achieved.append(expected_error_m(np.outer(step, step), plan.sensor.field_points) ** 2)
    return float(np.sqrt(np.mean(expected))), float(np.sqrt(np.mean(achieved)))


def tables() -> Sequence[Table]:
    """All of them."""
    return [
        bound_table(),
        covariance_table(),
        classic_table(),
        plan_table(),
        *hand_eye_profiles.tables(),
    ]
