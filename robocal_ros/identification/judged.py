# SPDX-License-Identifier: Apache-2.0
"""Identify on one part of the data, judge on another; accuracy and repeatability of a pose."""

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import (
    FEWEST_GROUPS,
    SPREAD_POSES,
    ErrorSummary,
    Judgement,
    Verdict,
    errors_document,
    gross,
    hold_out,
    judge,
    judged_errors_document,
    pose_groups,
    summarise,
    too_narrow,
    verdict_document,
)
from robocal_ros.ground.errors import Code, InputError, RankDeficientError, TooFewSamplesError
from robocal_ros.ground.frames import (
    Array,
    Document,
    invert,
    log_rotation,
    transform_document,
    transform_from_quat,
)
from robocal_ros.ground.samples import DEFAULT_TARGET, Measurements
from robocal_ros.identification.cell_model import (
    CellModel,
    Part,
    carried,
    linear_start,
    place_base_and_points,
)
from robocal_ros.identification.full_model import (
    FullIdentification,
    identify_full,
    without_masses,
)
from robocal_ros.identification.solve import Identification, Method, identify, still_joints
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document, parameters_document
from robocal_ros.kinematics.tables import POSITION, check_plain, read_cells

if TYPE_CHECKING:
    from robocal_ros.ground.documents import JudgedErrorsDocument
    from robocal_ros.identification.documents import (
        CellDocument,
        CoverageDocument,
        CoveredDocument,
        IdentificationDocument,
        IdentifiedJointDocument,
    )

# ---- why data do not fit a robot at all ---------------------------------------------------------


SUSPICIOUS_M = 0.02  # no robot's nominal model is off by this much at half of the poses
CLEAR_M = 0.01
CLEAR_RATIO = 20.0
_ENOUGH_ROWS = 300
_DEGREE = float(np.pi / 180.0)


def require_match(
    arm: SerialArm,
    data: Measurements,
    *,
    base: bool,
    tool: bool,
    hold: bool = False,
    file: str | None = None,
) -> None:
    """Refuse data that miss the nominal arm as no robot does, where the mistake can be named.

    ``base``, ``tool``: whether they are placed from the data or known; ``hold``: poses may hardly
    turn the flange (see ``linear_start``).

    Raises
    ------
    InputError
        Naming the mistake, and ``file``.
    TooFewSamplesError, RankDeficientError
        When the data cannot place base and targets.
    """

    def residual(measured: Measurements) -> Array:
        return linear_start(arm, measured, base=base, tool=tool, hold=hold).residual(measured)

    if mistake := explain_mismatch(arm, data, residual):
        raise InputError(mistake, file=file)


def explain_mismatch(
    arm: SerialArm, data: Measurements, residual: Callable[[Measurements], Array]
) -> str:
    """Name the mistake with which the data fit and without which they do not; empty if none.

    A mistake is named only when undoing it brings the median error from more than 20 mm to under
    10 mm, and to a twentieth: no real deviation of a robot looks like that.

    Parameters
    ----------
    residual : errors (m, 3), m, of a plain fit to (or prediction of) measurements.
    """
    if len(data) > _ENOUGH_ROWS:
        data = data.take(np.linspace(0, len(data) - 1, _ENOUGH_ROWS).astype(np.int64))
    found = _median(residual(data))
    if found < SUSPICIOUS_M:
        return ""
    clear = min(CLEAR_M, found / CLEAR_RATIO)
    for words, corrected in _mistakes(arm, data):
        if (after := _median(residual(corrected))) < clear:
            return (
                f"{words}: as given, the data miss the robot by {found * 1e3:.3g} mm (median), "
                f"with that undone by {after * 1e3:.3g} mm"
            )
    if (after := _median(_seen_from_flange(arm, data))) < clear:
        return (
            "the targets stand still and the sensor sits on the flange: taken as targets on the "
            f"flange they miss the robot by {found * 1e3:.3g} mm (median), so by "
            f"{after * 1e3:.3g} mm; measure targets on the flange by a sensor that stands still"
        )
    return ""


def _seen_from_flange(arm: SerialArm, data: Measurements) -> Array:
    """Errors (m, 3) of points that stand still, as a sensor on the flange would see them."""
    T, index = invert(arm.fk(data.q)), data.target_index(data.targets)
    try:
        T_sensor_flange, points = place_base_and_points(
            T, data.position, index, len(data.targets), np.zeros(3)
        )
    except (TooFewSamplesError, RankDeficientError):
        return np.full((1, 3), np.inf)
    return carried(T_sensor_flange @ T, points[index]) - data.position


def _median(residual: Array) -> float:
    return float(np.median(np.linalg.norm(residual, axis=1)))


def _mistakes(arm: SerialArm, data: Measurements) -> Iterator[tuple[str, Measurements]]:
    """Each common mistake in words, with the data as they are once it is undone."""
    for words, factor in (
        ("the measured positions are 1000 times too large (millimetres given as metres?)", 1e-3),
        ("the measured positions are 1000 times too small (metres given as millimetres?)", 1e3),
    ):
        yield words, replace(data, position=data.position * factor)
    turning = ~arm.prismatic
    for words, factor in (
        ("the joint readings are degrees given as radians", _DEGREE),
        ("the joint readings are radians given as degrees", 1.0 / _DEGREE),
    ):
        yield words, replace(data, q=np.where(turning, data.q * factor, data.q))
    for axis, name in enumerate("xyz"):
        position = data.position.copy()
        position[:, axis] *= -1.0
        words = f"{name} has the wrong sign, or two axes are swapped"
        yield f"the measuring frame is left-handed: {words}", replace(data, position=position)
    for a, b in combinations(range(3), 2):
        position = data.position.copy()
        position[:, [a, b]] = position[:, [b, a]]
        yield f"{'xyz'[a]} and {'xyz'[b]} are swapped", replace(data, position=position)
    for joint, name in enumerate(arm.joint_names):
        q = data.q.copy()
        q[:, joint] *= -1.0
        words = f"joint {joint + 1} ({name}) counts the other way: check its sign"
        yield words, replace(data, q=q)
    for a, b in combinations(range(arm.n), 2):
        q = data.q.copy()
        q[:, [a, b]] = q[:, [b, a]]
        yield f"joints {a + 1} and {b + 1} are swapped", replace(data, q=q)


# ---- identify on one part of the data, judge on another -----------------------------------------


CURVE = 300  # points of a joint's function
MOST_UNCOVERED = 0.05  # of the check poses, from where on the verdict's reason says so
CONTRADICTED = 2.0  # residuals over their sigmas: no choice of weights explains more
MOVED = 2.0  # errors over those with base and targets placed anew: then most is where these are
LARGEST_TURN_RAD = float(np.radians(5.0))  # no robot's wrist is off by this much


Model = Literal["full", "geometric"]


@dataclass(frozen=True)
class JudgedIdentification(Judgement):
    """An identification with its judgement.

    Attributes
    ----------
    robust : of nominal, in_force and calibrated without the rows that do not decide.
    measured : (n, 2) smallest and largest reading of each joint that it was made from.
    away : (m, n) which check poses have which joints where these were not measured.
    parts : errors of in_force and calibrated at the check poses that are covered, and at those
        that are not, where there are such.
    q, errors : readings (m, n) of the check poses, and the errors (m,), m, of nominal, in_force
        and calibrated there.
    """

    identification: Identification
    robust: dict[str, ErrorSummary]
    measured: Array
    away: NDArray[np.bool_]
    parts: dict[str, dict[str, ErrorSummary]]
    q: Array
    errors: dict[str, Array]

    @property
    def check_outside(self) -> float:
        """Share of the check poses that are not covered."""
        return float(np.mean(np.any(self.away, axis=1)))


def identify_and_judge(
    arm: SerialArm,
    train: Measurements,
    check: Measurements,
    *,
    fit: Collection[Part] = ("base", "tool", "geometry"),
    method: Method = "map",
    model: Model = "geometric",
    check_refit: Collection[Part] = (),
    in_force: SerialArm | None = None,
) -> JudgedIdentification:
    """Identify from ``train`` and compare with the model in force on ``check``.

    Figures count every row of ``check``; rows that no model fits do not decide.

    Parameters
    ----------
    model : ``full``: with joint functions and compliances, where the evidence wants them.
    check_refit : ``base``, ``tool``: parts that are solved anew from the check data, for both
        models, because those come from another set-up; the geometry is held.
    in_force : arm with the parameters in force, default the nominal ``arm``; base and targets
        are fitted to it from the same training data.
    """
    if "geometry" in check_refit:
        raise InputError("the geometry is what is checked: refit only base and tool")
    solved = identify_full if model == "full" else identify
    result = solved(arm, train, fit=fit, method=method)
    _require_orientations(result, train)
    set_up = frozenset(fit) - {"geometry"}
    plain = _check_error(_set_up(arm, train, set_up), check, check_refit)
    before = plain
    if in_force is not None:
        before = _check_error(_set_up(in_force, train, set_up), check, check_refit)
    after = _check_error(result.cell, check, check_refit)
    predicted, total = _predicted(result, check, check_refit)
    # a row decides unless it misses the model in force, too, as no robot does
    sound = ~(gross(before, after) & gross(before, before))
    measured = np.column_stack([train.q.min(axis=0), train.q.max(axis=0)])
    away = (check.q < measured[:, 0]) | (check.q > measured[:, 1])
    if isinstance(result, FullIdentification):
        away = result.known.uncovered(check.q)
    workspace_m = result.workspace_rms(result.estimate.covariance)
    doubt = (still_joints(arm, train) and still_joints(arm, check)) or result.estimate.creeping
    if not doubt:
        change_m = result.workspace_change(in_force or arm)
        doubt = too_narrow(workspace_m, change_m, summarise(before[sound]).rms_m, SPREAD_POSES)
    inside = ~np.any(away, axis=1)
    verdict = _decided(result, fit, before, after, pose_groups(check.q), doubt, sound, inside)
    masses = without_masses(arm, result) * (model == "full" and "geometry" in fit)
    verdict = _explained(verdict, _not_covered(result, away), masses)
    errors = {"nominal": plain, "in_force": before, "calibrated": after}
    return JudgedIdentification(
        identification=result,
        robust={name: summarise(error[sound]) for name, error in errors.items()},
        measured=measured,
        away=away,
        parts={
            name: {key: summarise(errors[key][part]) for key in ("in_force", "calibrated")}
            for name, part in (("covered", inside), ("not_covered", ~inside))
            if np.any(part)
        },
        q=check.q,
        errors=errors,
        nominal=summarise(plain),
        current=summarise(before),
        candidate=summarise(after),
        predicted_rms_m=predicted,
        predicted_total_rms_m=total,
        workspace_rms_m=workspace_m,
        held_out_rejected=tuple(check.sample[i] for i in np.flatnonzero(~sound)),
        verdict=verdict,
    )


def _decided(
    result: Identification, fit: Collection[Part], before: Array, after: Array,
    pose: NDArray[np.int64], doubt: str, sound: NDArray[np.bool_], inside: NDArray[np.bool_],
) -> Verdict:  # fmt: skip
    """Judge by the ``sound`` rows (m,), and by those ``inside`` of what was measured alone."""
    verdict = judge(before[sound], after[sound], pose[sound], doubt)
    known = sound & inside
    covers = isinstance(result, FullIdentification) and not np.all(inside)
    if verdict.accept and covers and len(np.unique(pose[known])) >= FEWEST_GROUPS:
        verdict = judge(before[known], after[known], pose[known])  # where it was measured
    if verdict.accept and result.sigma_ratio > CONTRADICTED:
        return Verdict(Code.RESIDUAL_TOO_LARGE, f"{contradicted(result)}; {verdict.reason}")
    if "geometry" not in fit and verdict.code in (
        Code.WORSE_THAN_CURRENT, Code.NO_SIGNIFICANT_GAIN
    ):  # fmt: skip  # base and targets alone were fitted: the model cannot have changed
        why = f"no model parameter was fitted, the geometry stays; {verdict.reason}"
        return Verdict(Code.NO_SIGNIFICANT_GAIN, why)
    return verdict


def _explained(verdict: Verdict, *more: str) -> Verdict:
    """The verdict with what else there is to say of the model, where there is something."""
    return replace(verdict, reason="; ".join(filter(None, (verdict.reason, *more))))


def _not_covered(result: Identification, away: NDArray[np.bool_]) -> str:
    """Say which check poses have joints (m, n) where they were not measured; empty for few.

    And empty for a geometric model, which holds everywhere alike.
    """
    share, names = float(np.mean(np.any(away, axis=1))), result.nominal.joint_names
    if share <= MOST_UNCOVERED or not isinstance(result, FullIdentification):
        return ""
    shares = np.mean(away, axis=0)
    joints = [f"{names[i]} ({shares[i]:.0%})" for i in np.flatnonzero(shares)]
    return (
        f"{share:.0%} of the check poses are not covered, with joints where they were not "
        f"measured: {', '.join(joints)}; there the model is geometry and compliance alone: "
        "measure there too"
    )


def contradicted(result: Identification) -> str:
    """Say that residuals contradict the sigmas that were given; empty where they do not."""
    ratio = result.sigma_ratio
    if 1.0 / CONTRADICTED <= ratio <= CONTRADICTED:
        return ""
    return (
        f"the residuals are {ratio:.2g} times what sigma_mm says: state what robot "
        "and sensor scatter together, or leave the column out, and it is found"
    )


def _require_orientations(result: Identification, data: Measurements) -> None:
    """Refuse orientations that do not belong to the joints; positions alone would hide it."""
    if data.rotation is None:
        return
    T = result.cell.predict(data.q, data.target_index(result.cell.targets))
    turn = log_rotation(T[:, :3, :3] @ np.swapaxes(data.rotation, 1, 2))
    off = float(np.median(np.linalg.norm(turn, axis=1)))
    if off > LARGEST_TURN_RAD:
        raise InputError(
            f"measured orientations miss the model by {np.degrees(off):.3g} deg (median) while "
            "positions fit: check the order of the quaternion (x, y, z, w), the convention of the "
            "angles, and that the rows belong together; or leave the orientations out"
        )


def held_out(
    data: Measurements, share: float, seed: int, file: str | None = None
) -> tuple[Measurements, Measurements]:
    """The measurements that solve, and those at the ``share`` of the poses that judges.

    Raises
    ------
    InputError
        For a target that would only judge, naming it and ``file``.
    """
    judges = hold_out(pose_groups(data.q), share, seed)
    train, check = data.take(~judges), data.take(judges)
    for name in check.targets:
        if name not in train.targets:
            rows = sum(target == name for target in data.target)
            raise InputError(
                f"target {name!r} cannot be placed: its measurements ({rows}) are all held out to "
                "judge; measure it at more poses, leave it out, or take another seed",
                file=file,
                column="target",
            )
    return train, check


def identify_and_hold_out(
    arm: SerialArm,
    data: Measurements,
    *,
    share: float,
    seed: int,
    method: Method = "map",
    model: Model = "geometric",
    in_force: SerialArm | None = None,
) -> JudgedIdentification:
    """Identify base, targets and model from a part of the poses, judge on the ``share`` left out.

    Raises
    ------
    InputError
        When the data miss the arm by a mistake that can be named.
    TooFewSamplesError, RankDeficientError
        When the data cannot answer.
    """
    train, check = held_out(data, share, seed)
    require_match(arm, data, base=True, tool=True, hold=True)
    return identify_and_judge(arm, train, check, method=method, model=model, in_force=in_force)


def held_out_errors(
    document: Document,
    before: SerialArm,
    arm: SerialArm,
    data: Measurements,
    *,
    share: float,
    seed: int,
) -> tuple[Array, Array, Array]:
    """Readings (m, n) of the poses that judged an identification, errors (m,), m, before and after.

    Found again from what is kept of `identify_and_hold_out`: its ``document``, the model in force
    ``before`` it and its own, ``arm``, and ``data``, what it was identified and judged by.
    """
    train, check = held_out(data, share, seed)
    poses = document["T_flange_target"]
    T_frame_base, *T_flange_target = (
        transform_from_quat(np.array(pose["xyz_mm"]) * 1e-3, pose["quat_xyzw"])
        for pose in (document["T_frame_base"], *poses.values())
    )
    cell = CellModel(arm, T_frame_base, tuple(poses), np.array(T_flange_target))
    was = _check_error(_set_up(before, train, ("base", "tool")), check, ())
    return check.q, was, _check_error(cell, check, ())


def _set_up(arm: SerialArm, train: Measurements, fit: Collection[Part]) -> CellModel:
    """Base and targets for a given geometry."""
    return identify(arm, train, fit=fit).cell if fit else linear_start(arm, train)


def _check_error(cell: CellModel, check: Measurements, refit: Collection[Part]) -> Array:
    if refit:  # what is not refitted is kept
        start = linear_start(
            cell.arm, check, base="base" in refit, tool="tool" in refit, known=cell, hold=True
        )
        cell = identify(cell.arm, check, fit=refit, method="map", start=start).cell
    return np.asarray(np.linalg.norm(cell.residual(check), axis=1))


def another_set_up(judged: JudgedIdentification, check: Measurements) -> str:
    """Say by how much less check data miss with base and targets placed anew; empty if by little.

    Placing them makes up for noise as well: sums of squares count by what they leave free.
    """
    free = 1.0 - (6 + 3 * len(check.targets)) / (3 * len(check))
    if free <= 0.0:
        return ""
    try:
        anew = _check_error(judged.identification.cell, check, ("base", "tool"))
    except (TooFewSamplesError, RankDeficientError):
        return ""
    before, after = judged.candidate.rms_m, summarise(anew).rms_m / np.sqrt(free)
    if before <= MOVED * after:
        return ""
    return (
        f"with base and targets placed anew the check data miss the model by {after * 1e3:.3g} mm "
        f"rms instead of {before * 1e3:.3g} mm"
    )


def _predicted(
    result: Identification, check: Measurements, refit: Collection[Part]
) -> tuple[float, float]:
    """Rms error expected at the check poses: of the model, and with measurement noise."""
    known = {name: i for i, name in enumerate(result.cell.targets)}
    target = np.array([known.get(name, 0) for name in check.target], dtype=np.int64)
    variance = result.predicted_variance(check.q, target, without=refit)
    model = float(np.mean(np.trace(variance, axis1=1, axis2=2)))
    noise = result.noise_m
    if check.sigma is not None:  # as much above what is stated as where it was solved from
        noise = max(1.0, result.estimate.scale) * float(np.sqrt(np.mean(check.sigma**2)))
    model = max(model, 0.0)  # of weak directions rounding is left
    return float(np.sqrt(model)), float(np.sqrt(model + 3.0 * noise**2))


def identified_model_document(result: Identification) -> Document:
    """``model_document`` of an identified arm, with its parameters' covariance (SI).

    ``parameters`` are those that were unknown, in the order of ``covariance``.
    """
    _, _, place = result.layout.geometry
    covariance = result.estimate.covariance[np.ix_(place, place)]
    return model_document(result.cell.arm) | {
        "parameters": [result.layout.names[i] for i in place],
        "covariance": covariance.tolist(),
    }


def cell_document(cell: CellModel) -> "CellDocument":
    """Base and targets of a cell model."""
    return {
        "T_frame_base": transform_document(cell.T_frame_base),
        "T_flange_target": {
            name: transform_document(T)
            for name, T in zip(cell.targets, cell.T_flange_target, strict=True)
        },
    }


def joints_document(judged: JudgedIdentification) -> "list[IdentifiedJointDocument]":
    """Of each joint: from where to where it was measured, what its function and its load do."""
    result, arm = judged.identification, judged.identification.cell.arm
    found: list[Any] = []  # names of fields have the joint's unit
    for joint, name in enumerate(arm.joint_names):
        unit, factor = ("mm", 1e3) if arm.prismatic[joint] else ("deg", float(np.degrees(1.0)))
        function = None
        if isinstance(result, FullIdentification) and result.known.terms.count[joint]:
            function = _function_document(result, joint)
        functions = arm.functions
        found.append(
            {
                "name": name,
                f"measured_{unit}": (judged.measured[joint] * factor).tolist(),
                "check_outside": float(np.mean(judged.away[:, joint])),
                "function": function,
                "compliance": 0.0 if functions is None else float(functions.compliance[joint]),
            }
        )
    return found


def _function_document(result: FullIdentification, joint: int) -> Document:
    """Rms of a joint's function, and of its standard deviation, where it was measured."""
    arm, known = result.cell.arm, result.known
    assert arm.functions is not None
    unit, micro, factor = ("deg", "urad", float(np.degrees(1.0)))
    if arm.prismatic[joint]:
        unit, micro, factor = "mm", "um", 1e3
    lower, upper = known.readings[[0, -1], joint].tolist()
    q = np.zeros((CURVE, arm.n))
    q[:, joint] = np.linspace(lower, upper, CURVE)
    value, sigma = arm.functions.delta(q)[:, joint], known.function_sigma(q)[:, joint]
    return {
        f"rms_{micro}": float(np.sqrt(np.mean(value**2))) * 1e6,
        f"sigma_{micro}": float(np.sqrt(np.mean(sigma**2))) * 1e6,
        f"length_{unit}": float(known.prior.length[joint]) * factor,
    }


def _coverage_document(judged: JudgedIdentification) -> "CoverageDocument":
    """Errors at check poses that are covered and that are not, each with its code."""
    found: dict[str, CoveredDocument] = {}
    for name, part in judged.parts.items():
        code = judged.verdict.code if name == "covered" else Code.POSES_NOT_INFORMATIVE
        found[name] = {
            "code": code.name,
            "in_force": errors_document(part["in_force"]),
            "calibrated": errors_document(part["calibrated"]),
        }
    return {"covered": found.get("covered"), "not_covered": found.get("not_covered")}


def identification_document(judged: JudgedIdentification) -> "IdentificationDocument":
    """The ``identify`` document: errors before and after, parameters, rank, verdict."""
    result = judged.identification
    seen = result.estimate.observability
    errors = judged_errors_document(judged)
    parts: dict[str, JudgedErrorsDocument] = {
        "nominal": errors["nominal"],
        "in_force": errors["in_force"],
        "calibrated": errors["calibrated"],
    }
    for name, robust in judged.robust.items():
        parts[name]["held_out_robust"] = errors_document(robust)
    return {
        "robot": result.nominal.name,
        "model_hash": result.nominal.model_hash,
        "method": result.method,
        "model": "full" if isinstance(result, FullIdentification) else "geometric",
        "masses": result.cell.arm.masses,
        "joints": joints_document(judged),
        "check_outside": judged.check_outside,
        "coverage": _coverage_document(judged),
        **errors,
        "parameters": parameters_document(result.nominal, result.cell.arm, result.sigma()),
        **cell_document(result.cell),
        "noise_mm": result.noise_m * 1e3,
        "noise_over_sigma": result.sigma_ratio,
        "bound_sigmas": float(np.sqrt(result.bound_squared)),
        "samples": len(result.estimate.rejected),
        "rank": seen.rank,
        "unknowns": len(result.layout.names) + len(result.held),
        "condition": seen.condition,
        "unobservable": [*result.unobservable, *result.weak],
        "held": list(result.held),
        "rejected": list(result.rejected),
        "held_out_rejected": list(judged.held_out_rejected),
        "converged": result.estimate.converged,
        "verdict": verdict_document(judged.verdict),
    }


# ---- accuracy and repeatability of positions: ISO 9283:1998, 7.2.1 and 7.2.2 --------------------

CYCLES = 30  # that the standard asks for


@dataclass(frozen=True, eq=False)
class Repeated:
    """A commanded pose that was approached ``n`` times.

    Attributes
    ----------
    barycentre : (3,) mean of the attained positions, m.
    mean_distance_m, S_m : mean of the distances to the barycentre and their standard deviation,
        with n - 1.
    offset : (3,) barycentre less the commanded position (AP_x, AP_y, AP_z), m; None where what was
        commanded is not known.
    """

    n: int
    barycentre: Array
    mean_distance_m: float
    S_m: float
    offset: Array | None

    @property
    def RP_m(self) -> float:
        """Position repeatability: mean distance and three standard deviations, m."""
        return self.mean_distance_m + 3.0 * self.S_m

    @property
    def AP_m(self) -> float | None:
        """Position accuracy: distance of the barycentre from what was commanded, m."""
        return None if self.offset is None else float(np.linalg.norm(self.offset))


def repeated(position: Array, commanded: Array | None = None) -> Repeated:
    """Accuracy and repeatability of one pose.

    Parameters
    ----------
    position : (n, 3) attained positions, m, in the frame of ``commanded``.
    commanded : (3,), m.

    Raises
    ------
    TooFewSamplesError
        For a single position: it does not show how well it is repeated.
    """
    n = len(position)
    if n < 2:
        raise TooFewSamplesError(
            f"{n} position shows no repeatability: measure the pose at least twice; ISO 9283 asks "
            f"for {CYCLES} cycles"
        )
    barycentre = position.mean(axis=0)
    distance = np.linalg.norm(position - barycentre, axis=1)
    return Repeated(
        n=n,
        barycentre=barycentre,
        mean_distance_m=float(distance.mean()),
        S_m=float(distance.std(ddof=1)),
        offset=None if commanded is None else barycentre - commanded,
    )


# ---- tables of attained positions (docs/identify.md) ---------------------------------------------


def read_positions(path: Path) -> dict[str, Array]:
    """Positions (n, 3), m, of each target, in the order of the table.

    Raises
    ------
    InputError
        With file, row and column, when the table is not as docs/identify.md says.
    """
    columns = POSITION["mm"]
    table = read_cells(path, lambda header, file: check_plain(header, file, columns, ("target",)))
    position = np.column_stack([table.numbers(name) for name in columns]) * 1e-3
    target = np.array(table.words("target") or (DEFAULT_TARGET,) * len(position))
    return {str(name): position[target == name] for name in dict.fromkeys(target.tolist())}
