# SPDX-License-Identifier: Apache-2.0
"""Which poses to measure, so that the full model errs least where the robot works.

Before anything is measured, geometry lies about the nominal one as robots are built, and each
joint's function is what joints of real robots are: a Gaussian process of some degrees. Each pose
lessens the error to expect at the working poses by an amount that does not depend on what will be
measured; poses are taken one after the other, the one that lessens it most each time (greedy
A-optimal design; of such choices Chaloner and Verdinelli, Bayesian experimental design, 1995).
"""

from dataclasses import dataclass

import numpy as np

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.ground.frames import Array, Index
from robocal_ros.ground.samples import DEFAULT_TARGET
from robocal_ros.identification.cell_model import CellModel, make_layout
from robocal_ros.identification.joint_functions import (
    FunctionPrior,
    JointTerms,
    prior_covariance,
)
from robocal_ros.identification.known_model import sparse_rows
from robocal_ros.identification.solve import default_prior
from robocal_ros.kinematics import SerialArm

NOISE_M = 5e-5  # of a coordinate: a tracker, and what a real robot does not repeat
LEVER_M = (0.1, 0.0, 0.1)  # of a target, where the robot file has no tool
SET_UP = 0.01  # m and rad, of base and target: a few poses tell them, however little is known
WORKING, DRAWS = 400, 5  # poses that are to be predicted; random choices beside the plan


@dataclass(frozen=True, eq=False)
class PosePlanForModel:
    """Poses to measure.

    Attributes
    ----------
    q : (m, n) in the order of their worth: the first k are the plan of k poses.
    chosen : (m,) which candidates they are.
    predicted_rms_m : (m,) error to expect at the working poses after each of them.
    random_rms_m : error after as many random candidates, on average over some draws.
    """

    q: Array
    chosen: Index
    predicted_rms_m: Array
    random_rms_m: float


@dataclass(frozen=True, eq=False)
class _Design:
    """Columns that candidates see, and what is to be predicted.

    ``J`` (m, 3, h), ``column`` (m, h) of m candidates; ``prior`` (k, k) covariance; the mean
    squared error at the working poses is trace(weight C).
    """

    J: Array
    column: Index
    prior: Array
    weight: Array


def plan_poses(arm: SerialArm, candidates: Array, working: Array, count: int) -> PosePlanForModel:
    """Choose ``count`` of candidates (m, n) for predictions at working poses (w, n).

    Raises
    ------
    TooFewSamplesError
        With fewer candidates than poses wanted.
    InputError
        For working poses with a joint where no candidate has it.
    """
    if len(candidates) < count:
        raise TooFewSamplesError(f"{len(candidates)} candidates for {count} poses: give more")
    beyond = (working < candidates.min(axis=0)) | (working > candidates.max(axis=0))
    if np.mean(np.any(beyond, axis=1)) > 0.5:
        raise InputError("most working poses have a joint where no candidate has it: add some")
    design = _design(arm, candidates, working)
    chosen, error = _greedy(design, count)
    rng = np.random.default_rng(0)
    draws = [
        _after(design, rng.choice(len(candidates), count, replace=False)) for _ in range(DRAWS)
    ]
    return PosePlanForModel(candidates[chosen], chosen, error, float(np.mean(draws)))


def _design(arm: SerialArm, candidates: Array, working: Array) -> _Design:
    from robocal_ros.identification import row_kernels

    tool = arm.T_flange_tool.copy()
    if np.linalg.norm(tool[:3, 3]) < 0.01:
        tool[:3, 3] += LEVER_M
    names = (DEFAULT_TARGET,)
    cell = CellModel(arm.with_model(arm.mdh, None, arm.load), np.eye(4), names, tool[None])
    layout = make_layout(
        arm, names, geometry=arm.parameters.names, base=True, tool=True, orientation=False
    )
    q = np.ascontiguousarray(np.vstack([candidates, working]))
    terms = JointTerms.cover(q, None, len(layout.names), coarse=True)
    rows = sparse_rows(layout, cell, terms, q, np.zeros(len(q), dtype=np.int64))
    k, m = terms.size, len(candidates)
    prior = prior_covariance(terms, FunctionPrior.typical(arm.n, NOISE_M))
    others = np.full(len(layout.names), SET_UP**2)
    others[: len(arm.parameters)] = default_prior(arm)
    prior[range(len(others)), range(len(others))] = others
    weight, unused = np.zeros((k, k)), np.zeros(k)
    share = np.full(len(working), 1.0 / len(working))
    J, column = np.ascontiguousarray(rows.J[:, :3]), rows.column
    none = np.zeros((len(working), 3))
    row_kernels.normal_equations(J[m:].copy(), column[m:].copy(), none, share, weight, unused)
    return _Design(J[:m].copy(), column[:m].copy(), prior, weight)


def _greedy(design: _Design, count: int) -> tuple[Index, Array]:
    """Candidates in the order in which they lessen the error most, and the error after each."""
    from robocal_ros.identification import row_kernels

    C = design.prior.copy()
    P = C @ design.weight @ C
    total, free = float(np.sum(design.weight * C)), np.ones(len(design.J), dtype=np.bool_)
    chosen, error = np.empty(count, dtype=np.int64), np.empty(count)
    spread, told = (np.empty((len(design.J), 3, 3)) for _ in range(2))
    for i in range(count):
        row_kernels.spreads(design.J, design.column, C, spread)
        row_kernels.spreads(design.J, design.column, P, told)
        spread += NOISE_M**2 * np.eye(3)
        gain = np.trace(np.linalg.solve(spread, told), axis1=1, axis2=2)
        best = int(np.argmax(np.where(free, gain, -np.inf)))
        chosen[i], free[best] = best, False
        H = _dense(design, best)
        S, CH, PH = spread[best], C @ H.T, P @ H.T
        K = np.linalg.solve(S, CH.T).T
        C -= K @ CH.T
        cross = PH @ K.T
        P += K @ told[best] @ K.T - cross - cross.T
        total -= float(gain[best])
        error[i] = np.sqrt(max(total, 0.0))
    return chosen, error


def _after(design: _Design, chosen: Index) -> float:
    """Rms error at the working poses after these candidates."""
    H = np.concatenate([_dense(design, int(i)) for i in chosen])
    CH = design.prior @ H.T
    S = H @ CH + NOISE_M**2 * np.eye(len(H))
    left = np.sum(design.weight * design.prior)
    left -= np.trace(np.linalg.solve(S, CH.T @ design.weight @ CH))
    return float(np.sqrt(max(left, 0.0)))


def _dense(design: _Design, candidate: int) -> Array:
    """All columns (3, k) of a candidate."""
    H = np.zeros((3, len(design.prior) + 1))
    H[:, design.column[candidate]] = design.J[candidate]  # column -1 falls into the last one
    return H[:, :-1]
