"""Line laser on a flange: against the bound, whether covariances are true, plans; all simulated.

Here from features that are drawn with their noise; `bench.hand_eye_profiles` takes whole profiles.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from bench import hand_eye_profiles
from bench.hand_eye_bound import Noise, moved
from bench.hand_eye_worlds import (
    CENTRE,
    PITCH_M,
    POINT_M,
    RADIUS_M,
    STAIRCASE,
    T_BASE_USER,
    World,
    X,
    calibrated,
    line_world,
    sphere_world,
    squared_error,
    step_world,
)
from bench.tables import Goal, Table
from robocal_ros.estimation.descent import chi2_quantile
from robocal_ros.ground.errors import RankDeficientError
from robocal_ros.hand_eye.planning import (
    PlannedLine,
    PlannedSphere,
    PlannedStairs,
    PlannedTarget,
    SensorRange,
    check_plan,
)
from robocal_ros.hand_eye.result import PoseNoise, at_origin, expected_error_m, increment
from robocal_ros.hand_eye.targets import StepTarget

Array = NDArray[np.float64]
Draw = Callable[[np.random.Generator], World]

RUNS = 500
PLANNED_RUNS = 100
UNKNOWNS = 6
NEAR = np.repeat([2e-3, 0.02], 3)  # m, rad: how well a plan knows the mount
CASES: dict[str, Draw] = {
    "sphere, 15 poses": sphere_world,
    "stairs, 5 poses": step_world,
    "known edge, 15 poses": lambda rng: line_world(rng, True),
    "unknown edge, 15 poses": lambda rng: line_world(rng, False),
}


@dataclass(frozen=True, eq=False)
class Runs:
    """Outcomes of n runs.

    Attributes
    ----------
    best, classic : (n, 6) increments from the true mount about the pivot (n, 3).
    squared : (n,) squared errors of the best method in units of its own covariance.
    bound : (n, 6, 6); ``apart``: largest difference between it and the estimator's own.
    robot_m : (n,) robot's noise as found; ``rejected``: share of features;
        refused: of runs, as poses that do not show all directions.
    """

    best: Array
    classic: Array
    pivot: Array
    squared: Array
    bound: Array
    apart: float
    robot_m: Array
    rejected: float
    refused: float

    def rms_mm(self, error: Array, pivot: Array | None = None) -> float:
        """Of shifts in the middle of the field; at the sensor's origin where a pivot is given."""
        shift = error[:, :3] if pivot is None else error[:, :3] - np.cross(error[:, 3:], pivot)
        return 1e3 * float(np.sqrt(np.mean(np.sum(shift**2, axis=1))))

    def origin_bound(self) -> float:
        """`bound_of` the shift of the sensor's origin."""
        pairs = zip(self.bound, self.pivot, strict=True)
        return float(np.sqrt(np.mean([np.trace(at_origin(b, p)[:3, :3]) for b, p in pairs])))

    def bound_of(self, rows: slice) -> float:
        """Root of the mean trace of part of the bound."""
        return float(np.sqrt(np.trace(self.bound[:, rows, rows], axis1=1, axis2=2).mean()))


@cache
def outcomes(draw: Draw, runs: int) -> Runs:
    """Draw poses and noise anew and calibrate."""
    best, classic, pivot, squared, bound, apart = [], [], [], [], [], []
    robot, lost, shown, refused = [], 0, 0, 0
    for seed in range(runs):
        rng = np.random.default_rng([50, seed])
        world = draw(rng)
        view = world.measured(rng)
        try:
            fit = calibrated(world.task, view)
        except RankDeficientError:
            refused += 1
            continue
        squared.append(squared_error(fit))
        old = world.task.classic(view, fit.state).T_flange_sensor
        pivot.append(world.pivot)
        best.append(increment(X, fit.state.T_flange_sensor, world.pivot))
        classic.append(increment(X, old, world.pivot))
        least, own = world.bound(), world.own_bound()
        unit = np.sqrt(np.diag(least))
        bound.append(least)
        apart.append(float(np.abs((own - least) / np.outer(unit, unit)).max()))
        robot.append(fit.noise.sigma_m)
        lost += len(fit.rejected)
        shown += len(view.sightings.names)
    return Runs(
        np.array(best), np.array(classic), np.array(pivot), np.array(squared), np.array(bound),
        max(apart), np.array(robot), lost / shown, refused / runs,
    )  # fmt: skip


def bound_table() -> Table:
    """Errors over the least possible ones."""
    table = Table(
        "hand_eye_bound",
        "Mount of a line laser: rms error, mm, in the middle of the field and at the origin",
        ("target", "best", "bound", "ratio", "goal", "ratio at the origin", "goal", "classic",
         "estimator's own bound apart"),
        f"Simulated features, {RUNS} runs, new poses in each: tilted up to 25 deg, a sensor of 190 "
        "to 210 mm with 0.037 mm noise, poses off by 0.05 mm along and 0.05 mrad about each axis "
        "(not told), light laid on the stairs' marks to 0.2 mm. Bound: Cramer-Rao with all noise "
        "known, from numeric derivatives of a geometry of the bench's own; last column: how far "
        "the estimator's bound differs from it.",
    )  # fmt: skip
    for name, draw in CASES.items():
        runs = outcomes(draw, RUNS)
        best, least = runs.rms_mm(runs.best), 1e3 * runs.bound_of(slice(3))
        origin = 1e-3 * runs.rms_mm(runs.best, runs.pivot) / runs.origin_bound()
        table.add(
            name, best, least, best / least, Goal(best / least, 1.1), origin, Goal(origin, 1.1),
            runs.rms_mm(runs.classic), Goal(runs.apart, 1e-5),
        )  # fmt: skip
    return table


def covariance_table() -> Table:
    """Is the reported covariance true?"""
    band = [chi2_quantile(p, UNKNOWNS * RUNS) / (UNKNOWNS * RUNS) for p in (0.025, 0.975)]
    table = Table(
        "hand_eye_covariance",
        "The same: squared error over the reported covariance",
        ("target", "mean of d2 / 6", "goal", "beyond the 95 % quantile, %", "robot found, mm",
         "features rejected, %", "runs refused, %"),
        f"{RUNS} runs; the mean's 95 % band is {band[0]:.3f} to {band[1]:.3f} for a true "
        "covariance. The noise is found from the same poses, so that errors have the tails of "
        "Student's t: more than 5 % lie beyond the quantile of chi-square. Nothing is wrong in "
        "these data: each rejection is a false one. Refused: poses that leave a direction open.",
    )  # fmt: skip
    limit = chi2_quantile(0.95, UNKNOWNS)
    for name, draw in CASES.items():
        runs = outcomes(draw, RUNS)
        mean = float(runs.squared.mean()) / UNKNOWNS
        table.add(
            name, mean,
            Goal(mean, band[1]) if mean > 1.0 else Goal(mean, band[0], at_least=True),
            100.0 * float(np.mean(runs.squared > limit)), 1e3 * float(np.median(runs.robot_m)),
            100.0 * runs.rejected, 100.0 * runs.refused,
        )  # fmt: skip
    return table


def classic_table(runs: int = 100) -> Table:
    """Sphere: both methods where poses are off by more."""
    table = Table(
        "hand_eye_classic",
        "Sphere, 15 poses: rms error of the mount, mm, by pose error",
        (
            "pose error an axis, mm",
            "where",
            "best",
            "bound",
            "classic",
            "classic over best",
            "goal",
        ),
        f"Simulated features, {runs} runs each; poses err in position alone.",
    )
    for pose_m in (2e-5, 1e-4):
        found = outcomes(_sphere_with(pose_m), runs)
        for where, pivot in (("middle of the field", None), ("origin", found.pivot)):
            best, classic = (found.rms_mm(e, pivot) for e in (found.best, found.classic))
            bound = 1e3 * (found.bound_of(slice(3)) if pivot is None else found.origin_bound())
            ratio = classic / best
            table.add(
                1e3 * pose_m, where, best, bound, classic, ratio, Goal(ratio, 3.0, at_least=True)
            )
    return table


@cache
def _sphere_with(pose_m: float) -> Draw:
    return lambda rng: sphere_world(rng, Noise(pose_m, 0.0))


def plan_table() -> Table:
    """What `check-plan` expects of poses against what becomes of them."""
    sensor = SensorRange(width_m=1280.0 * PITCH_M, noise_m=POINT_M)
    target = StepTarget(T_BASE_USER, STAIRCASE.marked_corners(), STAIRCASE.edge_user)
    line = np.stack([T_BASE_USER[:3, 3], T_BASE_USER[:3, 0]])
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
        f"Simulated features, {PLANNED_RUNS} runs from the same five plans each; the plan knows "
        "the mount to 2 mm and 0.02 rad, the sphere's centre, the noise of sensor, robot and eye. "
        "Goal: within "
        "1.5 either way.",
    )
    for (name, draw), plan in zip(CASES.items(), planned, strict=True):
        expected, achieved = _planned(draw, plan, sensor)
        ratio = achieved / expected
        side = Goal(ratio, 1.5) if ratio > 1.0 else Goal(ratio, 1.0 / 1.5, at_least=True)
        table.add(name, 1e3 * expected, 1e3 * achieved, ratio, side)
    return table


def _planned(draw: Draw, plan: PlannedTarget, sensor: SensorRange) -> tuple[float, float]:
    """Expected and achieved rms error, m, in the field of view."""
    expected, achieved = [], []
    for seed in range(5):
        rng = np.random.default_rng([60, seed])
        world = draw(rng)
        first = np.unique(world.pose, return_index=True)[1]
        noise = PoseNoise(world.noise.pose_m, world.noise.pose_rad, world.noise.aim_m)
        near = moved(X, NEAR * rng.standard_normal(6), world.pivot)
        report = check_plan(plan, world.T_base_flange[first], near, sensor, noise, 1.0)
        if report.working_error_m is None:
            raise ValueError(f"the plan is refused: {report.verdict.reason}")
        expected.append(report.working_error_m**2)
        field = sensor.field_points - world.pivot
        for _ in range(PLANNED_RUNS // 5):
            fit = calibrated(world.task, world.measured(rng))
            step = increment(X, fit.state.T_flange_sensor, world.pivot)
            achieved.append(expected_error_m(np.outer(step, step), field) ** 2)
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
