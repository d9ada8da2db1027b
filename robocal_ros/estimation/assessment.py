# SPDX-License-Identifier: Apache-2.0
"""Is it good, in mm? Errors on data not used to solve, and the decision with its reason."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import Code, TooFewSamplesError
from robocal_ros.ground.frames import Array, Index

if TYPE_CHECKING:
    from robocal_ros.ground.documents import ErrorsDocument, JudgementDocument, VerdictDocument

SAME_POSE_RAD = 1e-3
FEWEST_GROUPS = 5
SIGNIFICANCE = 0.05
LARGEST_RMS_M = 5e-3
SPREAD_POSES = "spread them and turn every joint, the wrist too"
GROSS_RATIO = 10.0
SMALLEST_GROSS_M = 1e-4


@dataclass(frozen=True)
class ErrorSummary:
    """Distances between predicted and measured points, m."""

    mean_m: float
    rms_m: float
    p95_m: float
    max_m: float
    n: int


@dataclass(frozen=True)
class Verdict:
    """A decision and why."""

    code: Code
    reason: str

    @property
    def accept(self) -> bool:
        """Whether the candidate may be accepted."""
        return self.code is Code.ACCEPT


@dataclass(frozen=True)
class Judgement:
    """A candidate's figures on data that were not used to solve, and the decision.

    ``nominal``, ``current``, ``candidate``: held-out errors of the nominal model (for a drift: the
    cold one), of the model in force and of the identified one.
    ``predicted_rms_m``: the candidate's error expected from its covariance alone.
    ``predicted_total_rms_m``: the same with the noise of the measurements added.
    ``workspace_rms_m``: the same as ``predicted_rms_m`` over postures throughout the joint limits,
        of geometry alone: where a joint was not measured its function is not known at all.
    ``held_out_rejected``: samples left out of the judgement because no model can fit them.
    """

    nominal: ErrorSummary
    current: ErrorSummary
    candidate: ErrorSummary
    predicted_rms_m: float
    predicted_total_rms_m: float
    workspace_rms_m: float
    held_out_rejected: tuple[str, ...]
    verdict: Verdict


def summarise(error: Array) -> ErrorSummary:
    """Summarise distances (m,) or error vectors (m, 3)."""
    e = np.linalg.norm(error, axis=1) if error.ndim == 2 else error
    return ErrorSummary(
        float(e.mean()),
        float(np.sqrt(np.mean(e**2))),
        float(np.quantile(e, 0.95)),
        float(e.max()),
        len(e),
    )


def pose_groups(q: Array) -> Index:
    """Group number (m,) of each joint vector: visits of one pose share a group.

    Two readings belong together when all joints agree within 1e-3 rad (0.06 deg; or 1 mm).
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components
    from scipy.spatial import cKDTree

    pairs = cKDTree(q).query_pairs(SAME_POSE_RAD, p=np.inf, output_type="ndarray")
    links = coo_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(q),) * 2)
    return np.asarray(connected_components(links, directed=False)[1], dtype=np.int64)


def hold_out(groups: Index, share: float, seed: int) -> NDArray[np.bool_]:
    """Mark the samples (m,) to hold out: whole groups, about ``share`` of them.

    Raises `TooFewSamplesError` when fewer than two groups are there.
    """
    count = int(groups.max()) + 1 if len(groups) else 0
    if count < 2:
        raise TooFewSamplesError(
            f"{len(groups)} samples of {count} distinct pose(s) cannot be split: measure more poses"
        )
    held = int(np.clip(round(share * count), 1, count - 1))
    chosen = np.random.default_rng(seed).permutation(count) < held
    return np.asarray(chosen[groups])


def gross(current: Array, candidate: Array) -> NDArray[np.bool_]:
    """Mark held-out samples (m,) that are wrong whichever model is true.

    Both models must miss them by more than ten times the median of the better one's distances,
    and by 0.1 mm: a bad model alone cannot hide its errors this way.
    """
    best = np.minimum(current, candidate)
    return np.asarray(best > max(GROSS_RATIO * float(np.median(best)), SMALLEST_GROSS_M))


def judge(current: Array, candidate: Array, groups: Index, uninformative: str = "") -> Verdict:
    """Decide whether a candidate replaces the model in force.

    ``current``, ``candidate`` (m,): distances, m, at the same samples, none used to solve.
    ``groups`` (m,): pose group of each sample; visits of one pose count once.
    ``uninformative``: why the measured poses do not carry over to other ones; empty if they do.

    The gain in squared error must be positive at 5 % significance (one-sided t over groups) to
    be accepted, and negative at 5 % to be called worse. What is not a number is refused.
    """
    before, after = summarise(current), summarise(candidate)
    what = (
        f"held-out rms {after.rms_m * 1e3:.3f} mm (mean {after.mean_m * 1e3:.3f}) against "
        f"{before.rms_m * 1e3:.3f} mm (mean {before.mean_m * 1e3:.3f}) of the model in force"
    )
    _, group = np.unique(groups, return_inverse=True)
    size = np.bincount(group)
    gain = np.bincount(group, current**2 - candidate**2) / size
    if len(gain) < FEWEST_GROUPS:
        return Verdict(
            Code.TOO_FEW_SAMPLES,
            f"{len(gain)} held-out poses cannot judge: at least {FEWEST_GROUPS} are needed; {what}",
        )
    if not np.minimum(before.rms_m, after.rms_m) <= LARGEST_RMS_M:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{what}; more than {LARGEST_RMS_M * 1e3:.0f} mm is no calibration error: check the "
            "robot file, units, joint signs and target names"
            + (f"; {uninformative}" if uninformative else ""),
        )
    if _one_sided_p(-gain) <= SIGNIFICANCE:
        return Verdict(Code.WORSE_THAN_CURRENT, what)
    if uninformative:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{uninformative}; {what}")
    if not (after.rms_m < before.rms_m and after.mean_m < before.mean_m):
        return Verdict(Code.NO_SIGNIFICANT_GAIN, f"{what}; no better, and not clearly worse")
    p = _one_sided_p(gain)
    if not p <= SIGNIFICANCE:
        return Verdict(
            Code.NO_SIGNIFICANT_GAIN, f"{what}; chance alone would give this in {p:.0%} of cases"
        )
    return Verdict(Code.ACCEPT, what)


def too_narrow(error_m: float, change_m: float, current_rms_m: float, remedy: str) -> str:
    """Say why measured poses do not carry over to the whole workspace; empty when they do.

    ``error_m``: rms error, throughout the joint limits, that the candidate's covariance leaves.
    ``change_m``: rms displacement there by which the candidate differs from the model in force.
    ``current_rms_m``: error of the model in force at the check poses.
    ``remedy``: which poses would do.

    The error must be at most twice the present one at the check poses (elsewhere the present one
    is not known, and may be that large), or clearly below what the candidate changes: noise
    cannot pass for a change.
    """
    if error_m <= max(2.0 * current_rms_m, change_m / np.sqrt(3.0)):
        return ""
    return (
        f"over the whole workspace the measured poses leave an error of {error_m * 1e3:.3f} mm "
        f"rms, for a change of {change_m * 1e3:.3f} mm: {remedy}"
    )


def _one_sided_p(gain: Array) -> float:
    """Chance of a mean this large where the true mean gain is zero (Student's t)."""
    from scipy.special import stdtr

    spread = float(np.std(gain, ddof=1))
    if spread == 0.0:
        return 0.0 if gain.mean() > 0.0 else 1.0
    t = float(gain.mean()) / (spread / np.sqrt(len(gain)))
    return float(1.0 - stdtr(len(gain) - 1, t))


def errors_document(errors: ErrorSummary) -> "ErrorsDocument":
    """Held-out errors in mm."""
    return {
        "mean_mm": errors.mean_m * 1e3,
        "rms_mm": errors.rms_m * 1e3,
        "p95_mm": errors.p95_m * 1e3,
        "max_mm": errors.max_m * 1e3,
        "n": errors.n,
    }


def judged_errors_document(judged: Judgement) -> "JudgementDocument":
    """Held-out errors before and after, and those that the candidate's covariance predicts."""
    return {
        "nominal": {"held_out": errors_document(judged.nominal)},
        "in_force": {"held_out": errors_document(judged.current)},
        "calibrated": {
            "held_out": errors_document(judged.candidate),
            "predicted": {
                "model_rms_mm": judged.predicted_rms_m * 1e3,
                "total_rms_mm": judged.predicted_total_rms_m * 1e3,
                "workspace_rms_mm": judged.workspace_rms_m * 1e3,
            },
        },
    }


def verdict_document(verdict: Verdict) -> "VerdictDocument":
    """Decision, its code's name and its reason."""
    return {"accept": verdict.accept, "code": verdict.code.name, "reason": verdict.reason}
