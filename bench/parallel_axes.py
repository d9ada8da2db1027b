# SPDX-License-Identifier: Apache-2.0
"""DH against modified DH on an arm with parallel axes: why beta stands in place of d there.

Between parallel axes the common normal is nowhere: a turn of an axis by beta moves it to a / beta,
a kilometre for half a milliradian, and d has to follow (Hayati 1983).
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bench.tables import Table
from robocal_ros.kinematics.arm import ParameterSet, SerialArm
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

RUNS = 10
POSES, FRESH = 50, 100
NOISE_M = 5e-5
ERROR = 5e-4  # m of each length, rad of each angle but beta
POINTS = np.array([[0.10, -0.05, 0.20], [-0.15, 0.10, 0.05], [0.05, 0.20, 0.30]])
MOST_STEPS, HALVINGS, SETTLED = 50, 12, 1e-9
D, BETA = 0, 4  # columns of a model


def with_parameters(arm: SerialArm, kind: str) -> SerialArm:
    """The arm with the free parameters of a notation: ``MDH``, ``DH``, ``DH, d held``."""
    index = arm.parameters.index
    if kind == "DH":
        index = tuple(sorted((joint, D if column == BETA else column) for joint, column in index))
    elif kind != "MDH":
        index = tuple((joint, column) for joint, column in index if column != BETA)
    other = arm.with_mdh(arm.mdh)
    other.__dict__["parameters"] = ParameterSet(index)
    return other


@dataclass(frozen=True, eq=False)
class Fitted:
    """What least squares came to."""

    arm: SerialArm
    steps: int
    settled: bool


def points(arm: SerialArm, q: Array) -> Array:
    """Three points of the flange (m, 3, 3), base."""
    T = arm.fk(q)
    return np.asarray(POINTS @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])


def scaled_rows(arm: SerialArm, q: Array) -> tuple[Array, Array]:
    """Jacobian (9 m, k) of the points, columns of length 1, and those lengths (k,)."""
    J = np.stack([arm.parameter_jacobian(q, p)[:, :3] for p in POINTS], axis=1)
    J = J.reshape(-1, J.shape[-1])
    length = np.linalg.norm(J, axis=0)
    return J / length, length


def fit(arm: SerialArm, q: Array, seen: Array) -> Fitted:
    """Gauss and Newton with halved steps; of what is open, no change."""
    left = (seen - points(arm, q)).ravel()
    for step in range(MOST_STEPS):
        A, length = scaled_rows(arm, q)
        delta = np.linalg.lstsq(A, left, rcond=1e-10)[0] / length
        share = 1.0
        for _ in range(HALVINGS):
            moved = arm.with_mdh(arm.parameters.add(arm.mdh, share * delta))
            then = (seen - points(moved, q)).ravel()
            if then @ then < left @ left:
                break
            share *= 0.5
        else:
            return Fitted(arm, step, True)
        gained = 1.0 - (then @ then) / (left @ left)
        arm, left = moved, then
        if gained < SETTLED:
            return Fitted(arm, step + 1, True)
    return Fitted(arm, MOST_STEPS, False)


def notation_table() -> Table:
    """The same measurements, three notations."""
    table = Table(
        "parallel_axes",
        "UR10, three parallel axes: the same measurements fitted by DH and by modified DH",
        ("beta of joints 2 and 3, mrad", "notation", "parameters", "condition, nominal",
         "rms at fresh poses, mm", "largest", "largest change of a length, mm", "steps",
         "not settled"),
        f"Simulated, {RUNS} robots, {POSES} random poses of three points each, noise 0.05 mm an "
        f"axis, base and points known; {FRESH} fresh poses. All free parameters of MDH but beta "
        "are off by 0.5 mm and 0.5 mrad; beta by what stands in the first column, either sign. "
        "Condition: of the columns' directions; infinite above 1e12. Largest: of the robots' rms.",
    )  # fmt: skip
    nominal = load_robot("ur10")
    for beta in (0.0, 5e-5, 5e-4, 5e-3):
        for kind in ("MDH", "DH", "DH, d held"):
            start = with_parameters(nominal, kind)
            rms, changed, steps, lost, condition = [], [], [], 0, 0.0
            for seed in range(RUNS):
                rng = np.random.default_rng([33, seed])
                true = _off(nominal, beta, rng)
                q = rng.uniform(nominal.lower, nominal.upper, (POSES + FRESH, nominal.n))
                exact = points(true, q)
                seen = exact[:POSES] + NOISE_M * rng.standard_normal((POSES, 3, 3))
                found = fit(start, q[:POSES], seen)
                away = points(found.arm, q[POSES:]) - exact[POSES:]
                rms.append(float(np.sqrt(np.mean(np.sum(away**2, axis=2)))))
                lengths = (found.arm.mdh - nominal.mdh)[:, [0, 2]]
                changed.append(float(np.abs(lengths).max()))
                steps.append(found.steps)
                lost += not found.settled
                if seed == 0:
                    condition = float(np.linalg.cond(scaled_rows(start, q[:POSES])[0]))
            table.add(
                f"{1e3 * beta:g}", kind, len(start.parameters),
                condition if condition < 1e12 else "infinite",
                1e3 * float(np.sqrt(np.mean(np.square(rms)))), 1e3 * max(rms),
                1e3 * float(np.median(changed)), float(np.mean(steps)), lost,
            )  # fmt: skip
    return table


def _off(nominal: SerialArm, beta: float, rng: np.random.Generator) -> SerialArm:
    free = nominal.parameters
    size = ERROR * rng.standard_normal(len(free))
    turned = np.array([column == BETA for _, column in free.index])
    size[turned] = beta * rng.choice([-1.0, 1.0], int(turned.sum()))
    return nominal.with_mdh(free.add(nominal.mdh, size))
