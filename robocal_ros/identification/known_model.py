# SPDX-License-Identifier: Apache-2.0
"""How well a full model is known: its covariance, where it was measured, what it predicts.

The covariance is found when a model is identified. Of a model that was read back it follows from
what it keeps of that, `IdentifiedFrom`: poses, noise and prior.
"""

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array, Index, Mask
from robocal_ros.identification.cell_model import CellModel, Part, UnknownLayout, make_layout
from robocal_ros.identification.joint_functions import FunctionPrior, JointEvidence, JointTerms
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import THETA, D
from robocal_ros.kinematics.joint_functions import IdentifiedFrom, JointFunctions

GAP_LENGTHS, GAP_SPACINGS = 2.0, 3.0
MOST_POSES = 1500  # that a model keeps
FREE = 1.0  # m and rad: from here on nothing is known of a parameter before the data


@dataclass(frozen=True)
class Rows:
    """Poses T (m, 4, 4) with the columns that they see, and their derivative by each turn."""

    T: Array
    J: Array
    column: Index
    by_turn: Array


def gravity_torque(arm: SerialArm, q: Array) -> Array | None:
    """Torque of gravity (m, n) about each axis, N m, in the controller's sense; None: no load.

    It is what a compliance of one would turn.
    """
    if arm.load is None:
        return None
    n = arm.n
    unit = JointFunctions(np.zeros(n), np.ones(n), np.zeros((n, 1)), np.ones(n))
    return np.asarray(replace(arm, functions=unit).turned(q) - q)


def with_turns(layout: UnknownLayout, arm: SerialArm) -> tuple[UnknownLayout, Index]:
    """The layout with a column for what each joint turns, where it has none; those columns."""
    slots, names = layout.slots.copy(), layout.names
    kinds = np.where(arm.prismatic, D, THETA)
    for joint, kind in enumerate(kinds):
        if slots[joint, kind] < 0:
            slots[joint, kind] = len(names)
            names = (*names, f"turn_{joint}")
    return replace(layout, slots=slots, names=names), slots[range(arm.n), kinds]


def centred(layout: UnknownLayout, terms: JointTerms, arm: SerialArm) -> Array:
    """What (k, k) makes of all unknowns those that predict the same, with functions of mean zero.

    Where theta0 (of a joint that slides d0) is free, a function's mean over the measured range is
    the same as a shift of it: that is where it goes. Beyond the table, where a function is zero,
    predictions move with it, by less than is known of them there.
    """
    T = np.eye(terms.size)
    for joint in np.flatnonzero(terms.count):
        place = layout.slots[joint, D if arm.prismatic[joint] else THETA]
        if place >= 0:
            block, mean = terms.block(int(joint)), terms.mean_weights(int(joint))
            T[block, block] -= mean
            T[place, block] = arm.sign[joint] * mean
    return T


def sparse_rows(
    layout: UnknownLayout, cell: CellModel, terms: JointTerms, q: Array, target: Index
) -> Rows:
    """What poses (m, n) of targets (m,) see of all unknowns."""
    wide, turns = with_turns(layout, cell.arm)
    T, J = wide.jacobian(cell, q, target)
    by_turn = J[:, :, turns] * cell.arm.sign
    return sparse(terms, cell.arm, q, T, J[:, :, : len(layout.names)], by_turn)


def sparse(
    terms: JointTerms, arm: SerialArm, q: Array, T: Array, dense: Array, by_turn: Array
) -> Rows:
    """Put the columns (m, c, k) of the other unknowns and those of the terms together."""
    k = dense.shape[2]
    J, column = terms.rows(q, by_turn, gravity_torque(arm, q))
    own = np.broadcast_to(np.arange(k), (len(q), k))
    return Rows(
        T, np.concatenate([dense, J], axis=2), np.concatenate([own, column], axis=1), by_turn
    )


@dataclass(frozen=True)
class KnownModel:
    """A model with joint functions and what is known of it.

    Attributes
    ----------
    terms : which joints have functions and compliances.
    prior : length and amplitude (n,) that the evidence chose for each function, and the noise.
    covariance : (k, k) of all unknowns, those of ``layout`` first.
    readings : (m, n) readings of each joint, rad (prismatic: m), sorted by size.
    """

    layout: UnknownLayout
    cell: CellModel
    terms: JointTerms
    prior: FunctionPrior
    covariance: Array
    readings: Array

    def uncovered(self, q: Array) -> Mask:
        """Which joints (m, n) have a function that was not measured near readings (m, n).

        Beyond the readings by half of its length, or in a gap that is wide beside the length and
        the usual distance of two readings: there a function is zero, give or take its prior.
        """
        found = np.zeros(q.shape, dtype=np.bool_)
        for joint in np.flatnonzero(self.terms.count):
            x, own, length = q[:, joint], self.readings[:, joint], self.prior.length[joint]
            at = np.clip(np.searchsorted(own, x), 1, len(own) - 1)
            away = np.minimum(np.abs(x - own[at - 1]), np.abs(x - own[at]))
            beyond = (x < own[0] - 0.5 * length) | (x > own[-1] + 0.5 * length)
            found[:, joint] = beyond | (away > self._reach(int(joint)))
        return found

    def _reach(self, joint: int) -> float:
        """How far from a reading, among others, a joint's function counts as measured."""
        own = self.readings[:, joint]
        spacing = float(own[-1] - own[0]) / len(own)
        return max(GAP_LENGTHS * float(self.prior.length[joint]), GAP_SPACINGS * spacing)

    def gaps(self, joint: int) -> Array:
        """Where between its readings (k, 2) a joint's function was not measured."""
        if not self.terms.count[joint]:
            return np.zeros((0, 2))
        own, reach = self.readings[:, joint], self._reach(joint)
        wide = np.flatnonzero(np.diff(own) > 2.0 * reach)
        return np.column_stack([own[wide] + reach, own[wide + 1] - reach])

    def predicted_variance(self, q: Array, target: Index, without: Collection[Part] = ()) -> Array:
        """Covariance (m, 3, 3), m^2, of the predicted target positions.

        Where a joint was not measured its function is zero, give or take the prior.
        """
        from robocal_ros.identification import row_kernels

        rows = sparse_rows(self.layout, self.cell, self.terms, np.ascontiguousarray(q), target)
        J, by_turn = np.ascontiguousarray(rows.J[:, :3]), rows.by_turn[:, :3]
        covariance, own = self.covariance, np.flatnonzero(self.layout.columns(without))
        if len(own):  # what is solved anew takes up what it can of every other error
            k = self.terms.size
            normal, unused = np.zeros((k, k)), np.zeros(k)
            ones, none = np.ones(len(q)), np.zeros((len(q), 3))
            row_kernels.normal_equations(J, rows.column, none, ones, normal, unused)
            keep = np.eye(k)
            keep[own] -= np.linalg.lstsq(normal[np.ix_(own, own)], normal[own], rcond=None)[0]
            covariance = keep @ covariance @ keep.T
        spread = np.empty((len(q), 3, 3))
        row_kernels.spreads(J, rows.column, covariance, spread)
        unknown = self.terms.share_outside(q) * self.prior.amplitude
        beyond = by_turn * unknown[:, None]
        return np.asarray(spread + beyond @ np.swapaxes(beyond, 1, 2))

    def function_sigma(self, q: Array) -> Array:
        """Standard deviation (m, n) of each joint's function at readings (m, n), rad."""
        from robocal_ros.identification import row_kernels

        n = q.shape[1]
        sigma = np.empty(q.shape)
        for joint in range(n):
            by_turn = np.zeros((len(q), 1, n))
            by_turn[:, 0, joint] = 1.0
            J, column = self.terms.rows(q, by_turn, np.zeros(q.shape))
            spread = np.empty((len(q), 1, 1))
            row_kernels.spreads(J, column, self.covariance, spread)
            sigma[:, joint] = spread[:, 0, 0]
        outside = self.terms.share_outside(q) * self.prior.amplitude
        return np.sqrt(np.maximum(sigma, 0.0) + outside**2)


def identified_from(
    known: KnownModel, q: Array, target: Index, weight: Array, lever: float, sigma: Array
) -> IdentifiedFrom:
    """What a model keeps, of the poses (m, n), targets (m,) and weights (m,) that were used.

    ``sigma`` (k,): of the unknowns of the layout before the data, 0: held.

    Of many poses those are kept that the model depends on most, each with a chance that grows with
    its share of what is known (its leverage), and with a weight that makes up for the others.
    """
    from robocal_ros.identification import row_kernels

    layout, cell = known.layout, known.cell
    used = np.flatnonzero(weight)
    q, target, weight = np.ascontiguousarray(q[used]), target[used], weight[used]
    if len(q) > MOST_POSES:
        rows = sparse_rows(layout, cell, known.terms, q, target)
        spread = np.empty((len(q), 3, 3))
        J = np.ascontiguousarray(rows.J[:, :3])
        row_kernels.spreads(J, rows.column, known.covariance, spread)
        share = weight * np.trace(spread, axis1=1, axis2=2)
        chance = np.zeros(len(q))
        for _ in range(20):  # some are kept for certain, which leaves less to the others
            free = chance < 1.0
            left = MOST_POSES - np.sum(~free)
            chance[free] = np.minimum(1.0, share[free] * left / np.sum(share[free]))
        step = np.floor(np.cumsum(chance) + 0.5)
        kept = np.flatnonzero(np.diff(step, prepend=0.0) > 0.0)
        q, target, weight = q[kept], target[kept], weight[kept] / chance[kept]
    arm = cell.arm
    of_parameters = dict(zip(layout.names, sigma.tolist(), strict=True))
    return IdentifiedFrom(
        q=np.round(q, 6),
        target=target,
        weight=weight,
        p_flange=cell.T_flange_target[:, :3, 3],
        lever=lever,
        noise=known.prior.noise,
        parameter_sigma=np.array([of_parameters.get(name, 0.0) for name in arm.parameters.names]),
        base_sigma=0.0 if layout.base < 0 else FREE,
        target_sigma=0.0 if layout.tool[0] < 0 else float(sigma[layout.tool[0]]),
        length=known.prior.length,
        amplitude=np.where(known.terms.count > 0, known.prior.amplitude, 0.0),
    )


def known_model(arm: SerialArm) -> KnownModel:
    """How well an arm with joint functions is known, from what it keeps; the frame is its base.

    Raises `InputError` where it keeps nothing.
    """
    from robocal_ros.identification import row_kernels

    functions = arm.functions
    told = None if functions is None else functions.identified_from
    if functions is None or told is None:
        raise InputError(f"{arm.name} does not say what it was identified from: identify it anew")
    if len(told.parameter_sigma) != len(arm.parameters):
        raise InputError(f"{arm.name} was identified as another type of arm: identify it anew")
    free = told.parameter_sigma > 0.0
    names = tuple(name for name, one in zip(arm.parameters.names, free, strict=True) if one)
    T_flange_target = np.tile(np.eye(4), (len(told.p_flange), 1, 1))
    T_flange_target[:, :3, 3] = told.p_flange
    targets = tuple(str(i) for i in range(len(told.p_flange)))
    layout = make_layout(
        arm, targets, geometry=names, base=told.base_sigma > 0.0, tool=told.target_sigma > 0.0,
        orientation=told.lever > 0.0,
    )  # fmt: skip
    cell = CellModel(arm, np.eye(4), targets, T_flange_target)
    sigma = np.full(len(layout.names), FREE)
    sigma[: len(names)] = told.parameter_sigma[free]
    if told.target_sigma > 0.0:
        sigma[layout.tool_places] = told.target_sigma
    q = np.ascontiguousarray(told.q)
    last = functions.coefficients.shape[1] - np.argmax(functions.coefficients[:, ::-1] != 0, axis=1)
    terms = replace(
        JointTerms.cover(q, gravity_torque(arm, q), len(layout.names)),
        first=functions.first,
        step=functions.step,
        count=np.where(told.amplitude > 0.0, last, 0).astype(np.int64),
    )
    terms = terms.without(told.amplitude <= 0.0, functions.compliance <= 0.0)
    rows = sparse_rows(layout, cell, terms, q, told.target)
    J = rows.J.copy()
    J[:, 3:] *= told.lever
    k = terms.size
    normal, unused = np.zeros((k, k)), np.zeros(k)
    none = np.zeros(J.shape[:2])
    row_kernels.normal_equations(J, rows.column, none, told.weight, normal, unused)
    flat = np.zeros(k, dtype=np.bool_)
    flat[: terms.before] = sigma >= FREE
    fixed = np.diag(sigma[sigma < FREE])
    evidence = JointEvidence(terms, normal, unused, 0.0, 0.0, flat, fixed, 0.0)
    prior = FunctionPrior(told.length, told.amplitude, told.noise)
    to_centred = centred(layout, terms, arm)
    covariance = to_centred @ evidence.posterior(prior).covariance @ to_centred.T
    return KnownModel(layout, cell, terms, prior, covariance, np.sort(q, axis=0))
