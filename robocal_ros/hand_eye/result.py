# SPDX-License-Identifier: Apache-2.0
"""The outcome of a hand-eye calibration, whatever the target, and whether it is good, in mm.

Joints that err of themselves add to it beyond what its residuals tell. Poses far apart show gears
as scatter, which the noise that is found from the shots holds. Near one another they err alike, and
that goes into the mount without a trace in the residuals.
"""

import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Literal

import numpy as np

from robocal_ros.estimation.assessment import Verdict, summarise, verdict_document
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.ground.frames import Array, Document, transform_document
from robocal_ros.hand_eye.linearity import SensorLinearity
from robocal_ros.kinematics.joint_errors import JointErrors, with_joint_errors

if TYPE_CHECKING:
    from robocal_ros.hand_eye.documents import (
        LeaveOneOutDocument,
        MountSigmaDocument,
        ResidualsDocument,
    )

Method = Literal["best", "classic"]
TargetKind = Literal["sphere", "step", "line", "tracker", "camera", "joint"]

METHODS: tuple[Method, ...] = ("best", "classic")
MOST_REJECTED = 1.0 / 3.0
LARGEST_RMS_M = 2e-3  # of samples from the target
ARM_M = 3.0  # a turn of the flange counts as the shift that goes with it there
AIM_M = 2e-4  # by which the eye misses a mark with the light, one sigma, where no shots tell it
STRIDE = 8  # of the points that tell the field of view
OUTSIDE = 0.02  # share of points beyond it on each side: spikes


@dataclass(frozen=True)
class PoseNoise:
    """Standard deviations of what all sightings of one pose have in common.

    ``sigma_m``, ``sigma_rad``: of a coordinate of the reported pose, and of its turn about an axis.
    ``aim_m``: of light that is laid on a mark by eye.
    ``repeat_m``: of what changes from visit to visit of one pose, with its turn as of a shift.
    """

    sigma_m: float
    sigma_rad: float
    aim_m: float = 0.0
    repeat_m: float = 0.0

    def covariance(self, visits: int = 0) -> Array:
        """(8 + 6 visits) square: of (v, w), flange axes, of the shift and the turn of the light.

        Then of (v, w) of each visit.
        """
        sigma = [self.sigma_m, self.sigma_rad, self.aim_m]
        sigma += [self.repeat_m, self.repeat_m / ARM_M] * visits
        return np.diag(np.repeat(sigma, [3, 3, 2] + [3, 3] * visits) ** 2)


@dataclass(frozen=True)
class HandEyeSettings:
    """What is known of the robot, and what is good enough.

    ``robot_sigma_m``, ``robot_sigma_rad``: standard deviation of a reported pose along and about
    each axis; None to estimate both from the profiles. Where the first is given alone, the second
    is that shift at an arm's length of 3 m.
    ``limit_m``: largest expected error (rms) of a point in the field that the profiles cover.
    ``joint_error_rad``: rms by which joints turn otherwise than their encoders show, where the
    model that poses are of does not hold it; 0: nothing is said of it.
    """

    robot_sigma_m: float | None = None
    robot_sigma_rad: float | None = None
    limit_m: float = 1e-3
    joint_error_rad: float = 0.0

    def noise(self) -> PoseNoise | None:
        """Of reported poses, and of the eye; None where it is to be estimated."""
        if self.robot_sigma_m is None:
            return None
        turn = self.robot_sigma_m / ARM_M if self.robot_sigma_rad is None else self.robot_sigma_rad
        return PoseNoise(self.robot_sigma_m, turn, AIM_M)


@dataclass(frozen=True, eq=False)
class HandEyeResult:
    """Where a sensor sits.

    ``T_flange_sensor`` (4, 4), m. For a sensor that does not move (eye-to-hand) ``parent`` is
    "base" and this is T_base_sensor.
    ``covariance`` (6, 6) of the `increment` (v, w) to the true pose, m and rad, sensor axes: a turn
    about ``pivot`` (3,), sensor frame, and its shift; None where the method tells none. About the
    middle of what was seen it is a Gaussian even where the sensor's origin moves far.
    ``samples``: names (n,) of the samples used; ``residual_m`` (n,) their distances, and
    ``residual_rad`` (n,) their angles where the target has any.
    ``leave_one_out_m`` (n,) distance of each sample from the solution without it; None where too
    few samples remain to solve without one.
    ``rejected``: name of each sample not used, with the reason.
    ``target``: what was found of the target, as a document (``center_mm``, ``line`` …); ``place``:
    the same as the target's model has it, where there is one.
    ``working_error_m``: rms error to expect of a point at the working distance; None if not known.
    ``more``: further entries of the document, such as ``point_residual_mm``.
    ``linearity``: of the sensor, where it was taken out of the profiles.
    """

    kind: TargetKind
    method: Method
    T_flange_sensor: Array
    covariance: Array | None
    samples: tuple[str, ...]
    residual_m: Array
    verdict: Verdict
    residual_rad: Array | None = None
    leave_one_out_m: Array | None = None
    rejected: Mapping[str, str] = field(default_factory=dict)
    unobservable: tuple[str, ...] = ()
    target: Document = field(default_factory=dict)
    working_error_m: float | None = None
    more: Document = field(default_factory=dict)
    parent: Literal["flange", "base"] = "flange"
    pivot: Array = field(default_factory=lambda: np.zeros(3))
    place: Array | None = None
    linearity: SensorLinearity | None = None


def increment(T_from: Array, T_to: Array, pivot: Array) -> Array:
    """(v, w) (6,) from T_from to T_to, along T_from's axes: a pivot moves by v, turned by w."""
    T = frames.invert(T_from) @ T_to
    return np.concatenate([T[:3, :3] @ pivot + T[:3, 3] - pivot, frames.log_rotation(T[:3, :3])])


def at_origin(covariance: Array, pivot: Array) -> Array:
    """Covariance (6, 6) of increments about a pivot as of those about the origin."""
    move = np.eye(6)
    move[:3, 3:] = frames.skew(pivot)
    return np.asarray(move @ covariance @ move.T)


def expected_error_m(covariance: Array, points: Array) -> Array:
    """Root mean square error (...) of points (n, 3), counted from the pivot of (..., 6, 6)."""
    one = np.broadcast_to(np.eye(3), (len(points), 3, 3))
    J = np.concatenate([one, -frames.skew(points)], axis=2)  # of a point's place by an increment
    spread = J @ covariance[..., None, :, :] @ np.swapaxes(J, 1, 2)
    return np.asarray(np.sqrt(np.trace(spread, axis1=-2, axis2=-1).mean(axis=-1)))


def apart(T_one: Array, T_other: Array, points: Array) -> float:
    """Root mean square distance of sensor points (n, 3), m, under two poses of the sensor."""
    away = points @ (T_one - T_other)[:3, :3].T + (T_one - T_other)[:3, 3]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def field_points(profiles: Sequence[Array]) -> Array:
    """Middle and corners (5, 3) of the field that profiles (n, 2) cover, sensor frame, m."""
    points = np.concatenate([profile[::STRIDE] for profile in profiles])
    low, high = np.quantile(points, [OUTSIDE, 1.0 - OUTSIDE], axis=0)
    x, z = np.stack([low, high]).T
    corners = [[a, 0.0, b] for a in x for b in z]
    return np.array([[x.mean(), 0.0, z.mean()], *corners])


def judge_classic(apart_m: float, error_m: float, limit_m: float) -> Verdict:
    """The verdict on a classic estimate that is so far from the best one in the field of view."""
    words = f"a closed form, {apart_m * 1e3:.3f} mm from the best estimate in the field of view; "
    words += f"a point there is expected to be off by {error_m * 1e3:.3f} mm rms"
    if error_m > limit_m:
        words = f"{words} (allowed {limit_m * 1e3:g} mm): use method best"
        return Verdict(Code.POSES_NOT_INFORMATIVE, words)
    return Verdict(Code.ACCEPT, words)


def judge_residuals(distances_m: Array, shots: int, lost: int) -> Verdict | None:
    """Refuse samples that are too far off, or too few of them; None where they will do."""
    rms = float(np.sqrt(np.mean(distances_m**2)))
    if rms > LARGEST_RMS_M:
        words = f"samples are off by {rms * 1e3:.2f} mm (allowed {LARGEST_RMS_M * 1e3:g} mm)"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    if lost > MOST_REJECTED * shots:
        words = f"{lost} of {shots} samples show nothing or do not fit: see the rejected ones"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    return None


def said_of_joints(result: HandEyeResult, found: JointErrors | None) -> HandEyeResult:
    """A result whose verdict and document say what the joints add to its sigma.

    ``found``: None where that is not known; the document has null.
    """
    if found is None:
        return replace(result, more={**result.more, "joint_errors": None})
    verdict = with_joint_errors(result.verdict, found, "mount")
    return replace(result, verdict=verdict, more={**result.more, "joint_errors": found.document()})


@dataclass(frozen=True, eq=False)
class PoseRows:
    """A fit's whitened residuals, linearised: r rows of each of g poses.

    ``by_unknowns`` (g, r, k), of which ``mount`` are the sensor's six; ``known`` (k, k): their
    covariance. ``by_pose`` (g, r, 6): by six numbers that a pose errs by.
    """

    by_unknowns: Array
    by_pose: Array
    known: Array
    mount: slice

    @cached_property
    def _own(self) -> Array:
        return np.swapaxes(self.by_pose, 1, 2) @ self.by_pose

    @cached_property
    def _taken(self) -> Array:
        """(g, 6, k): what the unknowns take of the poses' errors."""
        return np.swapaxes(self.by_pose, 1, 2) @ self.by_unknowns

    @cached_property
    def _moves(self) -> Array:
        """(g, 6, 6): of the mount with each pose."""
        return self.known[self.mount] @ np.swapaxes(self._taken, 1, 2)

    def of_mount(self, errors: Array) -> Array:
        """Covariance (6, 6) of the mount by that of the poses (g, 6, g, 6)."""
        moves = self._moves
        return np.asarray(np.einsum("gka,gahb,hlb->kl", moves, errors, moves, optimize=True))

    def of_mount_anew(self) -> Array:
        """The same by numbers of variance one, drawn anew for each pose."""
        return np.asarray(np.einsum("gka,gla->kl", self._moves, self._moves))

    def squared(self, errors: Array) -> float:
        """What such errors of the poses add to the sum of the squared residuals."""
        own = float(np.einsum("gagb,gab->", errors, self._own))
        taken = self._taken
        both = np.einsum("gak,gahb,hbl->kl", taken, errors, taken, optimize=True)
        return own - float(np.sum(both * self.known))

    def share(self, errors: Array) -> float:
        """How much of the scatter such errors make that numbers of variance one make.

        What residuals show of the poses, their own less what the unknowns take, squared: of
        hundreds of shots its product with the errors would take minutes.
        """
        own, taken, poses = self._own, self._taken, len(self._own)
        V, left = (part.reshape(-1, len(self.known)) for part in (taken, own @ taken @ self.known))
        shown = (V @ self.known @ (V.T @ V) @ self.known - left) @ V.T - V @ left.T
        shown = shown.reshape(poses, 6, poses, 6)
        each = np.arange(poses)
        shown[each, :, each, :] += own @ own
        return float(np.sum(errors * shown) / np.einsum("gaga->", shown))


def beside_found_noise(
    rows: PoseRows, errors: Array, noise: PoseNoise, told: Array, size_rad: float, given: bool
) -> JointErrors:
    """What poses that err, (g, 6, g, 6), add where the noise of a pose was found from the shots.

    Of that noise the share that such joints make is in ``told`` already, as if it were drawn anew
    for each pose: what they make of the mount stands in its place. Where they would make more
    scatter than the shots show, they err by less: by so much as makes all of it. Noise that is
    ``given`` does not tell.
    """
    unit = np.repeat([noise.sigma_m, noise.sigma_rad], 3)
    rows = replace(rows, by_pose=rows.by_pose * unit)  # of six numbers of variance one
    errors = errors / unit[:, None, None] / unit
    share, by_joints = rows.share(errors), rows.of_mount(errors)
    if share > 1.0 and not given:
        by_joints, size_rad = by_joints / share, size_rad / float(np.sqrt(share))
    return JointErrors.beside(size_rad, by_joints - min(share, 1.0) * rows.of_mount_anew(), told)


def hand_eye_document(result: HandEyeResult) -> Document:
    """The document of ``robocal hand-eye`` and of the history, in the units people read.

    ``covariance`` (6, 6), SI, and ``sigma``: of the sensor's origin, and of its turn about that
    origin, both along the axes of the parent frame, to first order: where turns are uncertain the
    origin moves on an arc. ``covariance_at_pivot``, sensor axes, holds there too: of the
    `increment` about ``pivot_mm``, a point of the sensor frame. A shot whose
    corners were all rejected is named once.
    """
    covariance: Array | None = None
    sigma_document: MountSigmaDocument | None = None
    left_out_document: LeaveOneOutDocument | None = None
    if result.covariance is not None:
        turn = np.kron(np.eye(2), result.T_flange_sensor[:3, :3])
        covariance = np.asarray(turn @ at_origin(result.covariance, result.pivot) @ turn.T)
        sigma = np.sqrt(np.diag(covariance))
        sigma_document = {
            "xyz_mm": (sigma[:3] * 1e3).tolist(),
            "rot_deg": np.degrees(sigma[3:]).tolist(),
        }
    if result.leave_one_out_m is not None:
        left_out = summarise(result.leave_one_out_m)
        left_out_document = {
            "mean": left_out.mean_m * 1e3,
            "rms": left_out.rms_m * 1e3,
            "p95": left_out.p95_m * 1e3,
            "max": left_out.max_m * 1e3,
        }
    error_m, turned_rad = result.working_error_m, result.residual_rad
    rejected = by_shot(result.rejected, result.samples)
    return {
        "kind": result.kind,
        "method": result.method,
        f"T_{result.parent}_sensor": transform_document(result.T_flange_sensor),
        "sigma": sigma_document,
        "covariance": None if covariance is None else covariance.tolist(),
        "pivot_mm": (result.pivot * 1e3).tolist(),
        "covariance_at_pivot": None if result.covariance is None else result.covariance.tolist(),
        "target": result.target,
        "residual_mm": _residual_document(result.samples, result.residual_m * 1e3),
        "residual_deg": None
        if turned_rad is None
        else _residual_document(result.samples, np.degrees(turned_rad)),
        "leave_one_out_mm": left_out_document,
        "working_error_mm": None if error_m is None else error_m * 1e3,
        "rejected": list(rejected),
        "rejected_because": rejected,
        "unobservable": list(result.unobservable),
        "held_out": None,
        **result.more,
        "verdict": verdict_document(result.verdict),
    }


def _residual_document(samples: tuple[str, ...], residual: Array) -> "ResidualsDocument":
    return {
        "rms": float(np.sqrt(np.mean(residual**2))),
        "max": float(np.max(residual)),
        "per_sample": dict(zip(samples, residual.tolist(), strict=True)),
    }


def by_shot(rejected: Mapping[str, str], samples: Collection[str]) -> dict[str, str]:
    """Reasons by name; a shot that has no corner among the samples used stands there once."""
    used = shots_of(samples)
    found: dict[str, list[str]] = {}
    for name, why in rejected.items():
        shot = _without_corner(name)
        if shot in used:
            found[name] = [why]
        else:
            found.setdefault(shot, []).append(_without_corner(why))
    return {name: max(reasons, key=reasons.count) for name, reasons in found.items()}


def shots_of(names: Iterable[str]) -> set[str]:
    """Names of the shots that samples are named after: several corners may be of one."""
    return {_without_corner(name) for name in names}


def _without_corner(text: str) -> str:
    return re.sub(r"/corner \d+\b", "", text)
