"""Where a camera sits: from pairs of robot poses and board poses to a result that is judged."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.assessment import Verdict
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import transform_document
from robocal_ros.core.errors import InputError, ResidualError
from robocal_ros.core.hand_eye.camera_closed_forms import CLOSED_FORMS, closed_form
from robocal_ros.core.hand_eye.camera_fit import GivenNoise, PairFit, fit_pairs
from robocal_ros.core.hand_eye.camera_mistakes import mistake, require_pairs, swapped, wrong_scale
from robocal_ros.core.hand_eye.camera_start import robust_start, score
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted
from robocal_ros.core.hand_eye.result import HandEyeResult

Array = NDArray[np.float64]
Document = dict[str, Any]

METHODS = ("best", "classic", *CLOSED_FORMS)
LARGEST_START_M = 3e-2  # median miss beyond which no search can be trusted
LARGEST_RMS_M = 1e-2
LARGEST_WORKING_ERROR_M = 2e-3
MOST_REJECTED = 1.0 / 3.0
MOST_COMPARED = 100  # samples for the closed forms: OpenCV pairs each with each


def calibrate_camera(
    pairs: PosePairs,
    method: str = "best",
    given: GivenNoise | None = None,
    rejected: Mapping[str, str] | None = None,
    more: Document | None = None,
) -> HandEyeResult:
    """Place a camera.

    Parameters
    ----------
    method : ``best`` is maximum likelihood; the name of a closed form is the same from that start;
        ``classic`` is the closed form that fits best, alone, without covariance.
    rejected : samples that were left out before, with the reason.
    more : further entries of the document.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the poses do not show the camera's place.
    InputError
        When the pairs hold a mistake that can be named: units, inverted, shifted.
    ResidualError
        When nothing fits them.
    ValueError
        For an unknown method.
    """
    if method not in METHODS:
        raise ValueError(f"{method} is not one of {', '.join(METHODS)}")
    require_pairs(pairs)
    sound = robust_start(pairs)
    _require_fit(pairs, sound, score(pairs, sound), LARGEST_START_M)
    fit = fit_pairs(pairs, given, _start(pairs, method))
    about = _noise_document(fit, given) | {"mount": pairs.mount} | (more or {})
    if method == "classic":
        return _classic(pairs, dict(rejected or {}), about)
    return _result(fit, method, dict(rejected or {}), about)


def _start(pairs: PosePairs, method: str) -> Placement | None:
    return closed_form(method, pairs) if method in CLOSED_FORMS else None


def _require_fit(pairs: PosePairs, at: Placement, size_m: float, limit_m: float) -> None:
    if size_m <= limit_m:
        return
    words = mistake(pairs, at)
    if words:
        raise InputError(words)
    raise ResidualError(
        f"robot and board miss each other by {size_m * 1e3:.4g} mm (allowed {limit_m * 1e3:.0f}): "
        "check that each board pose belongs to its robot pose, the mount (in-hand or to-hand), "
        "units and angles, and that the board stayed where it was"
    )


def closed_forms(pairs: PosePairs) -> dict[str, Placement | None]:
    """Each of OpenCV's, from at most 100 of the samples, spread evenly."""
    rows = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_COMPARED)).astype(int))
    return {name: closed_form(name, pairs.take(rows)) for name in CLOSED_FORMS}


def distances(pairs: PosePairs, at: Placement) -> Array:
    """How far the board, as seen, lies from where the robot has it (m,), m."""
    miss = differences(predicted(pairs, at), pairs)
    return np.asarray(np.linalg.norm(miss[:, :3], axis=1))


def _forms_document(pairs: PosePairs, forms: Mapping[str, Placement | None]) -> Document:
    return {
        "closed_forms_mean_mm": {
            name: None if at is None else float(distances(pairs, at).mean()) * 1e3
            for name, at in forms.items()
        }
    }


def _noise_document(fit: PairFit, given: GivenNoise | None) -> Document:
    noise, known = fit.noise, given or GivenNoise()
    return {
        "noise": {
            "position_mm": float(np.sqrt(noise.variances[0])) * 1e3,
            "robot_turn_deg": float(np.degrees(noise.turn_rad)),
            "camera_turn_deg": float(np.degrees(noise.camera_rad)),
            "robot_given": known.robot_m is not None and known.robot_rad is not None,
            "camera_given": fit.pairs.covariance is not None or known.camera_m is not None,
        }
    }


def _reasons(fit: PairFit) -> dict[str, str]:
    """Why each sample was rejected."""
    partner = swapped(fit.pairs, fit.at, fit.rejected)
    size = np.linalg.norm(fit.differences[:, :3], axis=1) * 1e3
    turn = np.degrees(np.linalg.norm(fit.differences[:, 3:], axis=1))
    reasons = {}
    for row in np.flatnonzero(fit.rejected):
        name = fit.pairs.names[row]
        words = f"misses the others by {size[row]:.2f} mm and {turn[row]:.3f} deg"
        if name in partner:
            words += f"; fits with the robot pose of {partner[name]}: are the two swapped?"
        reasons[name] = words
    return reasons


def _result(fit: PairFit, method: str, rejected: dict[str, str], about: Document) -> HandEyeResult:
    pairs, used = fit.pairs, ~fit.rejected
    miss = fit.differences[used]
    size = np.linalg.norm(miss[:, :3], axis=1)
    _require_fit(pairs, fit.at, float(np.sqrt(np.mean(size**2))), LARGEST_RMS_M)
    scale = wrong_scale(pairs.take(used), fit.at)
    if scale:
        raise InputError(scale)
    kept = pairs.take(used)
    error = working_error(fit)
    return HandEyeResult(
        kind="camera",
        method="best",
        T_flange_sensor=fit.at.X,
        covariance=fit.covariance[:6, :6],
        samples=kept.names,
        residual_m=size,
        residual_rad=np.asarray(np.linalg.norm(miss[:, 3:], axis=1)),
        leave_one_out_m=left_out(fit),
        rejected=rejected | _reasons(fit),
        target=_target_document(pairs, fit.at),
        working_error_m=error,
        verdict=_verdict(fit, size, error),
        more=about | {"start": method} | _forms_document(kept, closed_forms(kept)),
        parent="flange" if pairs.mount == "in-hand" else "base",
    )


def _classic(used: PosePairs, rejected: dict[str, str], about: Document) -> HandEyeResult:
    """The closed form that fits all samples best."""
    forms = closed_forms(used)
    found = {name: at for name, at in forms.items() if at is not None}
    if not found:
        raise ResidualError("no closed form solves these pairs: measure at more different poses")
    name = min(found, key=lambda key: float(distances(used, found[key]).mean()))
    at = found[name]
    miss = differences(predicted(used, at), used)
    size = np.linalg.norm(miss[:, :3], axis=1)
    words = f"{name} fits {len(used)} samples within {_rms(size) * 1e3:.3f} mm rms"
    return HandEyeResult(
        kind="camera",
        method="classic",
        T_flange_sensor=at.X,
        covariance=None,
        samples=used.names,
        residual_m=size,
        residual_rad=np.asarray(np.linalg.norm(miss[:, 3:], axis=1)),
        rejected=rejected,
        target=_target_document(used, at),
        verdict=Verdict(Code.ACCEPT, words),
        more=about | {"start": name} | _forms_document(used, forms),
        parent="flange" if used.mount == "in-hand" else "base",
    )


def _target_document(pairs: PosePairs, at: Placement) -> Document:
    parent = "base" if pairs.mount == "in-hand" else "flange"
    return {f"T_{parent}_board": transform_document(at.Z), "distance_mm": pairs.distance_m * 1e3}


def left_out(fit: PairFit) -> Array | None:
    """How far each used sample (n,) lies from the solution without it, m; to first order.

    By the leverage of each sample: (I - H_ii)^-1 r_i, as of linear least squares.
    """
    used = ~fit.rejected
    if int(used.sum()) <= 4:
        return None
    J, V = fit.jacobian[used], fit.expected[used]
    M = fit.estimate.covariance / fit.estimate.scale**2
    rest = np.eye(6) - J @ M @ J.swapaxes(1, 2) @ np.linalg.inv(V)
    alone = np.linalg.solve(rest, fit.differences[used][..., None])[..., 0]
    return np.asarray(np.linalg.norm(alone[:, :3], axis=1))


def working_error(fit: PairFit) -> float:
    """Rms error, m, to expect of a point where the boards were on average."""
    where = fit.pairs.T_camera_board[:, :3, 3].mean(axis=0)
    J = np.concatenate([np.eye(3), -frames.skew(where)], axis=1)
    return float(np.sqrt(np.trace(J @ fit.covariance[:6, :6] @ J.T)))


def _verdict(fit: PairFit, size: Array, error_m: float) -> Verdict:
    count, total = len(size), len(fit.pairs)
    words = (
        f"{count} of {total} samples within {_rms(size) * 1e3:.3f} mm rms; expected error "
        f"{error_m * 1e3:.3f} mm at {fit.pairs.distance_m * 1e3:.0f} mm"
    )
    if fit.estimate.creeping:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{fit.estimate.creeping}; {words}")
    if total - count > MOST_REJECTED * total:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{words}; too many samples miss the others: check that board and camera sit tight",
        )
    if error_m > LARGEST_WORKING_ERROR_M:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{words} (allowed {LARGEST_WORKING_ERROR_M * 1e3:.1f}): measure at more poses, turned "
            "further about two axes",
        )
    return Verdict(Code.ACCEPT, words)


def _rms(size: Array) -> float:
    return float(np.sqrt(np.mean(size**2)))
