# SPDX-License-Identifier: Apache-2.0
"""Base, targets and model parameters from measurements: least squares or maximum a posteriori."""

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation import estimation
from robocal_ros.estimation.estimation import (
    Freedom,
    describe,
    information_of,
    observability,
    require_told,
)
from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell_model import (
    ADVICE,
    TARGET_REACH_M,
    TYPICAL_ERROR_M,
    WEAK_TARGET_M,
    CellModel,
    CellProblem,
    Part,
    UnknownLayout,
    linear_start,
    make_layout,
)
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import random_postures

# ---- how far parameters may lie from the nominal ones -------------------------------------------


# Spread of a new robot's parameters about the nominal ones: machining and mastering tolerances.
TOLERANCE_LENGTH_M = 3e-3
TOLERANCE_ANGLE_RAD = float(np.radians(0.5))
SMALLEST_SCALE = 0.02
_ROUNDS = 60


def default_prior(arm: SerialArm) -> Array:
    """Variances (k,) of the free parameters of an arm as built."""
    return np.where(arm.parameters.is_length, TOLERANCE_LENGTH_M, TOLERANCE_ANGLE_RAD) ** 2


def fitted_prior(arm: SerialArm, found: Array, covariance: Array) -> Array:
    """Variances (k,) of the free parameters, scaled to what the data show of this robot.

    One scale for the lengths and one for the angles maximise the likelihood of the data with the
    parameters integrated out (empirical Bayes), by expectation-maximisation. Few data then
    neither drown in a prior that is too narrow nor turn noise into millimetres elsewhere.

    Parameters
    ----------
    found, covariance : (k,) deviations from the nominal parameters and their (k, k) covariance,
        as identified with ``default_prior``.
    """
    prior, lengths = default_prior(arm), arm.parameters.is_length
    unit = np.sqrt(prior)  # everything below in units of the tolerances
    total = np.linalg.inv(covariance / np.outer(unit, unit))
    data, pull = total - np.eye(len(unit)), total @ (found / unit)
    scale = np.ones(len(unit))
    for _ in range(_ROUNDS):
        posterior = np.linalg.inv(data + np.diag(1.0 / scale))
        second_moment = (posterior @ pull) ** 2 + np.diag(posterior)
        for group in (lengths, ~lengths):
            if np.any(group):
                scale[group] = max(float(second_moment[group].mean()), SMALLEST_SCALE**2)
    return np.asarray(prior * scale)


# ---- least squares, maximum a posteriori --------------------------------------------------------


Method = Literal["map", "lsq"]

BOUND = 0.95  # share of errors that a stated bound holds
_NAMED_TARGET_M = 0.01  # from here on what is known of a held target is said
_STILL_RAD = float(np.radians(5.0))
_STILL_M = 0.01
_ORIENTATION_SHARE = 0.25
_SHORTEST_LEVER_M = 0.02
_LEVER_ROUNDS = 4


@dataclass(frozen=True)
class Identification:
    """An identified cell model with its uncertainty.

    Attributes
    ----------
    nominal : the arm that was started from.
    cell : the identified model, base and targets.
    held : model parameters kept at their start because base or targets (or other parameters)
        have the same effect on every measurement.
    unobservable : directions, in words, that the data leave to the prior or to ``held``.
    weak : what is known of targets that were held because the flange hardly turned, in words.
    prior_covariance : (g, g), SI, of the model parameters before the data, or None.
    target_reach_m : standard deviation of the held targets' prior about the arm's tool, else None.
    sigma_ratio : found noise over given sigmas; 1 where none were given.
    noise_m : standard deviation of a measured coordinate, as given or as found.
    lever_m : length by which a turn in rad counted as a position error.
    bound_squared : squared length of a position error at a pose that was not used, over its
        predicted covariance (`predicted_variance` and noise), that 95 % stay below.
    """

    nominal: SerialArm
    cell: CellModel
    layout: UnknownLayout
    method: Method
    estimate: estimation.Estimate[CellModel]
    held: tuple[str, ...]
    weak: tuple[str, ...]
    prior_covariance: Array | None
    target_reach_m: float | None
    sigma_ratio: float
    unobservable: tuple[str, ...]
    rejected: tuple[str, ...]
    noise_m: float
    lever_m: float
    bound_squared: float

    def sigma(self) -> dict[str, float]:
        """Standard deviation, SI, of each unknown by name."""
        spread = np.sqrt(np.diag(self.estimate.covariance))
        return dict(zip(self.layout.names, spread.tolist(), strict=True))

    def predicted_variance(
        self, q: Array, target: NDArray[np.int64], without: Collection[Part] = ()
    ) -> Array:
        """Covariance (m, 3, 3), m^2, of the predicted target positions.

        ``without``: parts whose share is projected out because they are solved anew elsewhere.
        """
        J = self._jacobian(q, target, without)
        return np.asarray(J @ self.estimate.covariance @ np.swapaxes(J, 1, 2))

    def workspace_rms(self, covariance: Array) -> float:
        """Rms target position error, m, over postures throughout the joint limits.

        ``covariance`` is of the unknowns, or of the leading ones (the model parameters). What
        another base or target would explain does not count: it belongs to the set-up.
        """
        rows = self._workspace_rows()[..., : len(covariance)]
        return float(np.sqrt(max(np.mean(np.einsum("mik,kl,mil->m", rows, covariance, rows)), 0.0)))

    def workspace_change(self, arm: SerialArm) -> float:
        """Rms target displacement, m, over the same postures from ``arm``'s model to this one."""
        joint, column, place = self.layout.geometry
        change = (self.cell.arm.mdh - arm.mdh)[joint, column]
        moved = self._workspace_rows()[..., place] @ change
        return float(np.sqrt(np.mean(np.sum(moved**2, axis=1))))

    def _workspace_rows(self) -> Array:
        """Position rows (t * 60, 3, k) of each target at the same random postures."""
        q = random_postures(self.nominal)
        targets = np.repeat(np.arange(len(self.cell.targets))[:, None], len(q), axis=1)
        return np.vstack([self._jacobian(q, target, ("base", "tool")) for target in targets])

    def _jacobian(self, q: Array, target: NDArray[np.int64], without: Collection[Part]) -> Array:
        """Position rows (m, 3, k); what ``without`` could explain over all of them is removed."""
        _, J = self.layout.jacobian(self.cell, np.ascontiguousarray(q), target)
        rows = J[:, :3].reshape(-1, J.shape[2])
        own = rows[:, self.layout.columns(without)]
        if own.shape[1]:
            rows = rows - own @ np.linalg.lstsq(own, rows, rcond=None)[0]
        return np.asarray(rows.reshape(len(q), 3, -1))


def identify(
    arm: SerialArm,
    data: Measurements,
    *,
    fit: Collection[Part] = ("base", "tool", "geometry"),
    method: Method = "map",
    prior_covariance: Array | None = None,
    start: CellModel | None = None,
    robust: bool = True,
) -> Identification:
    """Identify the parts named in ``fit``.

    Parameters
    ----------
    arm : nominal arm; the mean of the prior.
    data : m samples of one or several targets; poses when ``data.rotation`` is given.
    method : ``map`` keeps every free parameter, with a Gaussian prior about the nominal one;
        ``lsq`` has no prior and holds parameters whose effect base or targets have too.
    prior_covariance : (k, k) of the arm's free parameters, SI; default: building tolerances,
        scaled to what the data show (`fitted_prior`).
    start : known base and targets; where a part of them is not in ``fit`` it is held there.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the data cannot answer; the message names the missing motion.
    """
    parts = frozenset(fit)
    base, tool = "base" in parts, "tool" in parts
    initial = start
    if initial is None:
        initial = linear_start(arm, data, base=base, tool=tool, hold=True)
    names = arm.parameters.names if "geometry" in parts else ()
    orientation = data.rotation is not None

    def layout_of(geometry: tuple[str, ...]) -> UnknownLayout:
        return make_layout(
            arm, initial.targets, geometry=geometry, base=base, tool=tool, orientation=orientation
        )

    complete = layout_of(names)
    held = _redundant(complete, initial, arm, len(names)) if method == "lsq" else ()
    layout = layout_of(tuple(n for n in names if n not in held)) if held else complete
    by_prior = method == "map" and bool(names)
    covariance = prior_covariance if by_prior else None
    if by_prior and covariance is None:
        covariance = np.diag(default_prior(arm))
    hold = base and tool and (by_prior or not names) and _hardly_turns(arm, data, initial)

    def solved(state: CellModel) -> tuple[estimation.Estimate[CellModel], float]:
        prior = np.zeros((len(layout.names),) * 2)
        if covariance is not None:
            prior[: len(names), : len(names)] = np.linalg.inv(covariance)
        if hold:
            prior[layout.tool_places, layout.tool_places] = TARGET_REACH_M**-2
        return _solve(arm, data, layout, state, prior, robust)

    try:
        estimate, lever = solved(initial)
        if by_prior and prior_covariance is None:
            count, found = len(names), arm.parameters.read(estimate.state.arm.mdh - arm.mdh)
            variances = fitted_prior(arm, found, estimate.covariance[:count, :count])
            covariance = np.diag(variances)
            estimate, lever = solved(estimate.state)
    except (RankDeficientError, np.linalg.LinAlgError) as error:
        words = [str(error), still_joints(arm, data)]
        if hold:
            words.append(ADVICE)
        raise RankDeficientError(
            "; ".join(filter(None, words)), getattr(error, "directions", ())
        ) from error
    result = _report(arm, data, estimate, layout, complete, method, held, lever)
    if hold:
        result = replace(
            result, target_reach_m=TARGET_REACH_M, weak=_weak_targets(estimate, layout, data)
        )
    return replace(result, prior_covariance=covariance)


def _hardly_turns(arm: SerialArm, data: Measurements, cell: CellModel) -> bool:
    """Whether poses leave the place of a target on the flange open, as they hardly turn it."""
    layout = make_layout(arm, cell.targets, geometry=(), base=True, tool=True, orientation=False)
    _, J = layout.jacobian(cell, np.ascontiguousarray(data.q), data.target_index(cell.targets))
    rows = J.reshape(-1, J.shape[2])
    prior = np.zeros(J.shape[2])
    prior[layout.tool_places] = (TYPICAL_ERROR_M / TARGET_REACH_M) ** 2
    covariance = np.linalg.pinv(rows.T @ rows + np.diag(prior), hermitian=True)
    place = layout.tool_places.reshape(-1, 3)
    variance = np.stack([covariance[np.ix_(p, p)] for p in place])
    return float(np.linalg.eigvalsh(variance).max()) > (WEAK_TARGET_M / TYPICAL_ERROR_M) ** 2


def _weak_targets(
    estimate: estimation.Estimate[CellModel], layout: UnknownLayout, data: Measurements
) -> tuple[str, ...]:
    """What is known of targets that were held, in words."""
    words = []
    for name, place in zip(data.targets, layout.tool_places.reshape(-1, 3), strict=True):
        variance, axes = np.linalg.eigh(estimate.covariance[np.ix_(place, place)])
        for sigma, axis in zip(np.sqrt(np.maximum(variance, 0.0)), axes.T, strict=True):
            if sigma > _NAMED_TARGET_M:
                along = ", ".join(frames.fixed(axis, 2))
                words.append(
                    f"{name} along ({along}) of the flange, against the base: known to "
                    f"{sigma * 1e3:.0f} mm; turn the flange about axes across it"
                )
    return tuple(words)


def _solve(
    arm: SerialArm,
    data: Measurements,
    layout: UnknownLayout,
    initial: CellModel,
    prior: Array,
    robust: bool,
) -> tuple[estimation.Estimate[CellModel], float]:
    """Solve; orientations settle what positions leave open and weigh little beside them.

    Sigmas that are clearly too small for the residuals only weigh samples against each other.

    Unmodelled bending and eccentricity shift and tilt the flange together, so orientations add
    less than their fine noise suggests: a turn counts as a quarter of what it moves over the
    target's own distance, and less where orientations scatter more than that.
    """
    sigma = np.ones(len(data)) if data.sigma is None else data.sigma
    reach = float(np.linalg.norm(initial.T_flange_target[:, :3, 3], axis=1).mean())
    most = max(_ORIENTATION_SHARE * reach, _SHORTEST_LEVER_M)
    lever = most
    if data.rotation is not None:
        unit = CellProblem(layout, data, initial.targets, sigma, 1.0, arm)
        lever = _lever(unit.linearise(initial)[0] * sigma[:, None], 1.0, most)
    state, known = initial, data.sigma is not None
    for _ in range(_LEVER_ROUNDS):
        problem = CellProblem(layout, data, initial.targets, sigma, lever, arm)
        estimate = estimation.solve(
            problem, state, prior_information=prior, noise_known=known, robust=robust
        )
        if known and (estimate.scale > 1.0 or _contradicted(problem, estimate, prior)):
            known = False
            estimate = estimation.solve(
                problem, estimate.state, prior_information=prior, noise_known=known, robust=robust
            )
        if data.rotation is None:
            break
        used = (estimate.residual * sigma[:, None])[~estimate.rejected]
        state, settled = estimate.state, _lever(used, lever, most)
        if abs(settled / lever - 1.0) < 0.1:
            break
        lever = settled
    return estimate, lever


def _contradicted(
    problem: CellProblem, estimate: estimation.Estimate[CellModel], prior: Array
) -> bool:
    """Whether positions alone are clearly farther off than their sigmas say.

    Orientations beside them, which weigh little, are no proof of the contrary.
    """
    if problem.data.rotation is None:
        return False
    keep, (residual, J) = ~estimate.rejected, problem.linearise(estimate.state)
    count = 3 * int(np.sum(keep))
    told, information = information_of(J[:, :3], keep), information_of(J, keep)
    left = Freedom.of(count, told, information, prior).at(1.0)
    misfit = float(np.sum(residual[keep, :3] ** 2))
    return left >= 1.0 and misfit > estimation.chi2_quantile(estimation.SOUND_FIT, left)


def _lever(residual: Array, lever: float, most: float) -> float:
    """Length, m, by which a turn counts: ``most``, or the scatters' ratio where that is less."""
    position = np.median(np.linalg.norm(residual[:, :3], axis=1))
    turn = np.median(np.linalg.norm(residual[:, 3:], axis=1)) / lever
    return float(min(most, max(position, 1e-9) / max(turn, 1e-9)))


def _redundant(
    layout: UnknownLayout, cell: CellModel, arm: SerialArm, count: int
) -> tuple[str, ...]:
    """Model parameters whose effect base, targets or earlier parameters have at every posture."""
    q = random_postures(arm)
    target = np.repeat(np.arange(len(cell.targets)), len(q))
    J = layout.jacobian(cell, np.tile(q, (len(cell.targets), 1)), target)[1]
    J = J.reshape(-1, len(layout.names))
    order = [*range(count, J.shape[1]), *range(count)]
    length = np.linalg.norm(J[:, order], axis=0)
    J = J[:, order] / np.where(length > 0.0, length, 1.0)
    dependent = np.abs(np.diag(np.linalg.qr(J, mode="r"))) < 1e-9
    return tuple(layout.names[i] for i, d in zip(order, dependent, strict=True) if d)


def still_joints(arm: SerialArm, data: Measurements) -> str:
    """Name the joints that the data do not turn by 5 deg (or move by 1 cm); empty if none."""
    span = np.ptp(data.q, axis=0)
    still = [
        f"{name} moves only {s * 1e3:.2g} mm"
        if slides
        else f"{name} moves only {np.degrees(s):.2g} deg"
        for name, s, slides in zip(arm.joint_names, span, arm.prismatic, strict=True)
        if s < (_STILL_M if slides else _STILL_RAD)
    ]
    return f"in these data {', '.join(still)}: move it" if still else ""


def _report(
    arm: SerialArm,
    data: Measurements,
    estimate: estimation.Estimate[CellModel],
    layout: UnknownLayout,
    complete: UnknownLayout,
    method: Method,
    held: tuple[str, ...],
    lever: float,
) -> Identification:
    if data.sigma is None:
        require_told(estimate.freedom)
    seen = estimate.observability
    if held:
        sigma = np.ones(len(data)) if data.sigma is None else data.sigma
        problem = CellProblem(complete, data, estimate.state.targets, sigma, lever, arm)
        _, J = problem.linearise(estimate.state)
        seen = observability(J[~estimate.rejected].reshape(-1, J.shape[2]))
    words = tuple(describe(column, complete.names, complete.to_display) for column in seen.null.T)
    known = data.sigma
    used = estimate.residual[~estimate.rejected][:, :3]
    told = min(max(estimate.freedom, 1.0), used.size)
    trusted = known is not None and estimate.scale <= 1.0
    return Identification(
        nominal=arm,
        cell=estimate.state,
        layout=layout,
        method=method,
        estimate=estimate,
        held=held,
        weak=(),
        prior_covariance=None,
        target_reach_m=None,
        sigma_ratio=1.0 if known is None else float(np.sqrt(np.sum(used**2) / told)),
        unobservable=words,
        rejected=tuple(data.sample[i] for i in np.flatnonzero(estimate.rejected)),
        noise_m=estimate.scale * (1.0 if known is None else float(np.sqrt(np.mean(known**2)))),
        lever_m=lever,
        bound_squared=(
            estimation.chi2_quantile(BOUND, 3)
            if trusted
            else estimation.found_noise_quantile(BOUND, 3, told)
        ),
    )
