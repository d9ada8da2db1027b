"""How good a camera's place is: leave-one-out, the error to expect, the decision."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.camera_closed_forms import closed_form
from robocal_ros.hand_eye.camera_fit import PairFit
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted
from robocal_ros.hand_eye.quality import HandEyeSettings, apart, judge_classic

Array = NDArray[np.float64]

MOST_REJECTED = 1.0 / 3.0
LARGEST_RMS_M = 5e-3
MOST_LEFT_OUT = 50
LEAST_REST = 1e-6  # what the others say about a sample, where they say anything


def distances(pairs: PosePairs, at: Placement) -> Array:
    """How far the board, as seen, lies from where the robot has it (m,), m."""
    miss = differences(predicted(pairs, at), pairs)
    return np.asarray(np.linalg.norm(miss[:, :3], axis=1))


def left_out(fit: PairFit) -> Array | None:
    """How far each used sample (n,) lies from the solution without it, m; to first order.

    By the leverage of each sample: (I - H_ii)^-1 r_i, as of linear least squares. None where a
    sample alone determines a direction: nothing solves without it.
    """
    used = ~fit.rejected
    root = np.linalg.cholesky(fit.expected[used])
    J = np.linalg.solve(root, fit.jacobian[used])
    M = fit.estimate.covariance / fit.estimate.scale**2
    rest = np.eye(6) - J @ M @ J.swapaxes(1, 2)
    if float(np.linalg.eigvalsh(rest).min()) < LEAST_REST:
        return None
    alone = root @ np.linalg.solve(rest, fit.estimate.residual[used][..., None])
    return np.asarray(np.linalg.norm(alone[:, :3, 0], axis=1))


def left_out_of_form(name: str, pairs: PosePairs, at: Placement) -> Array | None:
    """How far each sample (n,) lies from a closed form without it, m, solved again each time.

    ``at``: the form's answer with all. None of more than 50 samples (OpenCV pairs each with each,
    every time), and where the form fails without one of them.
    """
    if len(pairs) > MOST_LEFT_OUT:
        return None
    rows, found = np.arange(len(pairs)), distances(pairs, at)
    for row in rows:
        without = closed_form(name, pairs.take(rows != row))
        if without is None:
            return None
        found[row] = distances(pairs.take(np.array([row])), without)[0]
    return found


def working_error(fit: PairFit) -> float:
    """Rms error, m, to expect of a point where the boards were on average."""
    where = fit.pairs.T_camera_board[:, :3, 3].mean(axis=0)
    J = np.concatenate([np.eye(3), -frames.skew(where)], axis=1)
    return float(np.sqrt(np.trace(J @ fit.covariance[:6, :6] @ J.T)))


def unsettled(fit: PairFit) -> Verdict | None:
    """Refuse a fit that is no solution; None where it is one."""
    if fit.estimate.converged and fit.settled:
        return None
    return Verdict(
        Code.POSES_NOT_INFORMATIVE,
        fit.estimate.creeping
        or "the noise did not settle; measure at more poses, or give the robot's noise",
    )


def verdict(fit: PairFit, size: Array, error_m: float, limit_m: float) -> Verdict:
    """Whether a solution may be used; ``size`` (n,) of the residuals used, m."""
    count, total = len(size), len(fit.pairs)
    words = (
        f"{count} of {total} samples within {rms(size) * 1e3:.3f} mm rms; expected error "
        f"{error_m * 1e3:.3f} mm at {fit.pairs.distance_m * 1e3:.0f} mm"
    )
    if fit.estimate.creeping:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{fit.estimate.creeping}; {words}")
    if rms(size) > LARGEST_RMS_M:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words}; more than {LARGEST_RMS_M * 1e3:.0f} mm is no calibration error: check the "
            "intrinsics, the robot's model, and that board and camera sit tight",
        )
    if total - count > MOST_REJECTED * total:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words}; too many samples miss the others: check that board and camera sit tight",
        )
    if error_m > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{words} (allowed {limit_m * 1e3:.4g}): measure at more poses, turned "
            "further about two axes",
        )
    return Verdict(Code.ACCEPT, words)


def form_error(at: Placement, fit: PairFit) -> tuple[float, float]:
    """How far a closed form is from the most likely placement, rms where the boards were, m.

    And its error to expect there: the same with the error of that placement.
    """
    away = apart(at.X, fit.at.X, fit.pairs.T_camera_board[:, :3, 3])
    return away, float(np.hypot(away, working_error(fit)))


def form_verdict(name: str, size: Array, away_m: float, error_m: float, limit_m: float) -> Verdict:
    """Whether a closed form may be used; ``size`` (n,) of its residuals, m."""
    words = f"{name} fits {len(size)} samples within {rms(size) * 1e3:.3f} mm rms"
    if rms(size) > LARGEST_RMS_M:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words} (allowed {LARGEST_RMS_M * 1e3:.0f} mm): use method best",
        )
    judged = judge_classic(away_m, error_m, HandEyeSettings(limit_m=limit_m))
    return Verdict(judged.code, f"{words}; {judged.reason}")


def held_out_verdict(size: Array) -> Verdict | None:
    """Refuse where samples (n,) that were not used are too far off, m; else None."""
    if rms(size) <= LARGEST_RMS_M:
        return None
    return Verdict(
        Code.RESIDUAL_TOO_LARGE,
        f"samples that were not used to solve are off by {rms(size) * 1e3:.2f} mm rms (allowed "
        f"{LARGEST_RMS_M * 1e3:.0f} mm)",
    )


def rms(size: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(size**2)))
