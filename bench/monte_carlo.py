# SPDX-License-Identifier: Apache-2.0
"""Simulated truth, many runs: is the error the least possible one, and are the sigmas true?"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bench.parallel_axes import notation_table
from bench.tables import Goal, Table
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.robot import Effects, Warmth
from robocal_ros.estimation.estimation import chi2_quantile
from robocal_ros.ground import frames
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification import CellModel, Identification, identify
from robocal_ros.identification.full_model import identify_full
from robocal_ros.kinematics.joint_functions import ArmLoad
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

RUNS = 600
POSES = 50
FRESH = 100
MANY = 250  # poses of a calibration with the full model
HEAVY_MM = 0.15  # what the full model may leave of a robot that sags
NOISE_M = 5e-5
LENGTH_M, ANGLE_RAD = 5e-4, float(np.radians(0.05))  # spread of the true robots about the nominal
T_FRAME_BASE = frames.transform(frames.exp_rotation([0.4, -0.3, 2.0]), [3.0, -1.5, 0.7])
POINTS = np.array([[0.10, -0.05, 0.20], [-0.15, 0.10, 0.05], [0.05, 0.20, 0.30]])
CONFIDENCE = 0.001  # of each bound


@dataclass(frozen=True)
class World:
    """A true robot that is measured with noise; ``nominal`` is what is known of it."""

    truth: CellModel
    start: CellModel

    def postures(self, count: int, rng: np.random.Generator) -> Array:
        """Throughout the joint limits."""
        arm = self.start.arm
        return rng.uniform(arm.lower, arm.upper, (count, arm.n))

    def measure(self, q: Array, rng: np.random.Generator, *, sigma: bool) -> Measurements:
        """Each posture once, the targets in turn."""
        names = self.truth.targets
        which = np.arange(len(q)) % len(names)
        exact = self.truth.predict(q, which)[:, :3, 3]
        return Measurements(
            q=q,
            position=exact + NOISE_M * rng.normal(size=exact.shape),
            target=tuple(names[i] for i in which),
            sample=tuple(str(i) for i in range(len(q))),
            sigma=np.full(len(q), NOISE_M) if sigma else None,
        )

    def errors(self, found: CellModel, q: Array) -> Array:
        """True errors (m, 3), m, of the first target."""
        first = np.zeros(len(q), dtype=np.int64)
        return np.asarray((found.predict(q, first) - self.truth.predict(q, first))[:, :3, 3])


def draw_world(targets: int, rng: np.random.Generator) -> World:
    """One robot of the type in one cell."""
    nominal = load_robot("kr150_r3100")
    chosen, names = nominal.parameters, tuple("pqr"[:targets])
    size = np.where(chosen.is_length, LENGTH_M, ANGLE_RAD)
    true_arm = nominal.with_mdh(chosen.add(nominal.mdh, size * rng.normal(size=len(size))))
    tools = frames.transform(np.broadcast_to(np.eye(3), (targets, 3, 3)), POINTS[:targets])
    truth = CellModel(true_arm, T_FRAME_BASE, names, tools)
    return World(truth, replace(truth, arm=nominal))


def _outliers(data: Measurements, rng: np.random.Generator) -> Measurements:
    """One sample in ten off by 0.5 to 5 mm."""
    position = data.position.copy()
    wrong = rng.choice(len(data), len(data) // 10, replace=False)
    direction = rng.normal(size=(len(wrong), 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    position[wrong] += rng.uniform(5e-4, 5e-3, (len(wrong), 1)) * direction
    return replace(data, position=position)


Solver = Callable[[World, Measurements], Identification]


def _everything(method: str) -> Solver:
    return lambda world, data: identify(world.start.arm, data, method=method)  # type: ignore[arg-type]


def _full(world: World, data: Measurements) -> Identification:
    return identify_full(world.start.arm, data)


def _geometry(world: World, data: Measurements) -> Identification:
    return identify(world.start.arm, data, fit=("geometry",), method="lsq", start=world.start)


def efficiency_table() -> Table:
    """Errors at fresh poses against the Cramér-Rao bound."""
    table = Table(
        "efficiency",
        f"KR 150, {POSES} random poses, noise 0.05 mm per axis: error at fresh poses, {RUNS} runs",
        ("unknown", "rms, mm", "Cramér-Rao, mm", "ratio", "goal", "reported, mm"),
        "Random poses within the joint limits, a new robot, new poses and new noise in each run. "
        "Cramér-Rao: what no unbiased estimator can beat, from the Jacobian at the true robot. "
        "Reported: what the program predicts from its own covariance, without knowing the noise "
        "(fourth row: knowing it). These robots have no joint errors: the full model, which finds "
        "none, loses nothing. Last row: Cramér-Rao of the samples that are no outliers.",
    )
    cases: tuple[tuple[str, int, Solver, bool, bool], ...] = (
        ("base, target, geometry; least squares", 1, _everything("lsq"), False, False),
        ("base, target, geometry; prior", 1, _everything("map"), False, False),
        ("base, target, geometry; full model (default)", 1, _full, False, False),
        ("24 parameters, 3 known targets", 3, _geometry, True, False),
        ("as the first, 10 % outliers of 0.5 to 5 mm", 1, _everything("lsq"), False, True),
    )
    for name, targets, solver, sigma, spoilt in cases:
        total, bound, reported = np.zeros(3)
        rng = np.random.default_rng(1)
        for _ in range(RUNS):
            world = draw_world(targets, rng)
            data = world.measure(world.postures(POSES, rng), rng, sigma=sigma)
            clean = data
            if spoilt:
                data = _outliers(data, rng)
                clean = data.take(np.all(data.position == clean.position, axis=1))
            found, fresh = solver(world, data), world.postures(FRESH, rng)
            total += np.mean(np.sum(world.errors(found.cell, fresh) ** 2, axis=1))
            bound += np.mean(_bound(world, clean, found, fresh))
            first = np.zeros(FRESH, dtype=np.int64)
            variance = found.predicted_variance(fresh, first)
            reported += np.mean(np.trace(variance, axis1=1, axis2=2))
        rms, least, told = np.sqrt(np.array([total, bound, reported]) / RUNS) * 1e3
        goal = Goal(rms / least, 1.03 if solver is _full else 1.05)
        table.add(name, rms, least, rms / least, goal, told)
    return table


def _bound(world: World, data: Measurements, found: Identification, fresh: Array) -> Array:
    """Least variance (m,), m^2, of an unbiased prediction: J (J^T J / sigma^2)^+ J^T at the truth.

    The pseudo-inverse leaves out what no measurement of this kind can show and no prediction needs.
    """
    layout, first = found.layout, np.zeros(len(fresh), dtype=np.int64)
    index = data.target_index(world.truth.targets)
    J = layout.jacobian(world.truth, data.q, index)[1].reshape(-1, len(layout.names)) / NOISE_M
    scale = np.linalg.norm(J, axis=0)
    root = np.linalg.pinv(J / scale, rcond=1e-8)
    rows = layout.jacobian(world.truth, fresh, first)[1] / scale
    return np.asarray(np.sum((rows @ root) ** 2, axis=(1, 2)))


def sigma_table() -> Table:
    """Are the reported standard deviations true?"""
    rng, world_rng = np.random.default_rng(2), np.random.default_rng(3)
    squared, inside = [], []
    for _ in range(RUNS):
        world = draw_world(3, world_rng)
        data = world.measure(world.postures(POSES, rng), rng, sigma=True)
        found = _geometry(world, data)
        chosen = found.nominal.parameters
        error = chosen.read(found.cell.arm.mdh) - chosen.read(world.truth.arm.mdh)
        covariance = found.estimate.covariance
        squared.append(float(error @ np.linalg.solve(covariance, error)))
        ratio = np.abs(error) / np.sqrt(np.diag(covariance))
        inside.append((ratio < 1.0, ratio < 1.959964))
    count = len(chosen)
    table = Table(
        "sigmas",
        f"The same robot, 24 parameters, 3 known targets: are the sigmas true? {RUNS} runs",
        ("figure", "found", "expected", "from", "to", "goal"),
        "Normalised squared error: error^T covariance^-1 error, summed over the runs, over its "
        "degrees of freedom. Coverage: how often the true parameter lies within one (1.96) "
        "reported sigma, over all parameters, then for the worst of the 24. Bounds: chi-square "
        "and binomial, 0.1 % on each side (worst parameter: shared among the 24).",
    )
    freedom = RUNS * count
    _within(
        table, "normalised squared error", float(np.sum(squared)) / freedom, 1.0,
        chi2_quantile(CONFIDENCE, freedom) / freedom,
        chi2_quantile(1.0 - CONFIDENCE, freedom) / freedom,
    )  # fmt: skip
    for k, (words, expected) in enumerate((("68", 0.682689), ("95", 0.95))):
        share = np.mean([pair[k] for pair in inside], axis=0)
        worst = float(share[np.argmax(np.abs(share - expected))])
        # the 24 errors of one run hang together: at least six of them are taken as independent
        for who, value, trials, doubt in (
            ("all", float(share.mean()), RUNS * 6, CONFIDENCE),
            ("worst parameter", worst, RUNS, CONFIDENCE / count),
        ):
            low, high = _binomial_bounds(trials, expected, doubt)
            _within(table, f"{words} % coverage, {who}", value, expected, low, high)
    return table


def _within(
    table: Table, name: str, value: float, expected: float, low: float, high: float
) -> None:
    side = value >= expected
    goal = Goal(value, high) if side else Goal(value, low, at_least=True)
    table.add(name, value, expected, low, high, goal)


def _binomial_bounds(trials: int, p: float, doubt: float) -> tuple[float, float]:
    """Shares between which a binomial count lies but for ``doubt`` on each side."""
    from scipy.stats import binom

    low, high = binom.ppf((doubt, 1.0 - doubt), trials, p) / trials
    return float(low), float(high)


ROBOTS = 12
HEAVY = ArmLoad(kr150.BODY.mass, kr150.BODY.centre)  # the last link's with the payload


def unmodelled_table() -> Table:
    """The same with effects that the geometry of rigid links does not hold, and the full model."""
    table = Table(
        "unmodelled",
        f"KR 150 with effects that geometry does not hold, {ROBOTS} robots",
        ("true robot", "poses", "nominal rms, mm", "geometry rms, mm", "reported with noise, mm",
         "full model rms, mm", "goal", "reported with noise, mm"),
        "Error at fresh poses throughout the joint limits. Encoders with a once-per-turn error and "
        "joints that sag are partly taken up by the geometric parameters; what remains is no "
        "noise. The full model knows masses and payload. Reported with noise takes the residual as "
        "noise of each pose: the figure to trust.",
    )  # fmt: skip
    effects, steps = Effects.none(), []
    for name, switch in (
        ("static errors only", "static"),
        ("and repeatability", "noise"),
        ("and eccentric encoders (10 arc seconds)", "eccentricity"),
        ("and joints that sag (120 kg at the flange)", "compliance"),
        ("and gears (1 minute of arc) with backlash", "gears"),
    ):
        effects = replace(effects, **{switch: True})
        steps.append((name, effects, POSES))
    for name, truth, poses in [*steps, ("the same", effects, MANY)]:
        nominal, geometry, told, full, full_told = _unmodelled(truth, poses)
        goal = Goal(full, HEAVY_MM) if truth.compliance and not truth.gears else None
        table.add(name, poses, nominal, geometry, told, full, goal, full_told)
    return table


def _unmodelled(effects: Effects, poses: int) -> Array:
    """Mean square figures of one kind of truth, as rms in mm."""
    nominal, rng = load_robot("kr150_r3100"), np.random.default_rng(4)
    cold, sums, first = Warmth.cold(nominal.n), np.zeros(5), np.zeros(FRESH, dtype=np.int64)
    for _ in range(ROBOTS):
        robot = kr150.true_robot(nominal, rng, effects)

        def visit(q: Array, noise: float, robot=robot) -> Measurements:  # type: ignore[no-untyped-def]
            exact = robot.point(q, cold, POINTS[0], rng if noise else None)
            exact = exact @ T_FRAME_BASE[:3, :3].T + T_FRAME_BASE[:3, 3]
            names = tuple(str(i) for i in range(len(q)))
            position = exact + noise * rng.normal(size=exact.shape)
            return Measurements(q, position, ("p",) * len(q), names)

        q = rng.uniform(nominal.lower, nominal.upper, (poses + FRESH, nominal.n))
        train, fresh = visit(q[:poses], NOISE_M), visit(q[poses:], 0.0)
        squares = []
        before = identify(nominal, train, fit=("base", "tool")).cell
        squares.append(np.mean(np.sum(before.residual(fresh) ** 2, axis=1)))
        for after in (identify(nominal, train), identify_full(replace(nominal, load=HEAVY), train)):
            variance = np.trace(after.predicted_variance(fresh.q, first), axis1=1, axis2=2)
            squares.append(np.mean(np.sum(after.cell.residual(fresh) ** 2, axis=1)))
            squares.append(np.mean(variance) + 3.0 * after.noise_m**2)
        sums += squares
    return np.asarray(np.sqrt(sums / ROBOTS) * 1e3)


def tables() -> Sequence[Table]:
    """All tables of this module."""
    return [efficiency_table(), sigma_table(), unmodelled_table(), notation_table()]
