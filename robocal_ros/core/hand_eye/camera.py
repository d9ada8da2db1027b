"""Where a camera sits: from pairs of robot poses and board poses to a result that is judged."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core.assessment import Verdict, summarise
from robocal_ros.core.codes import Code
from robocal_ros.core.documents import errors_document, transform_document
from robocal_ros.core.errors import InputError, ResidualError
from robocal_ros.core.hand_eye.camera_closed_forms import CLOSED_FORMS, closed_form
from robocal_ros.core.hand_eye.camera_fit import GivenNoise, PairFit, fit_pairs
from robocal_ros.core.hand_eye.camera_mistakes import mistake, require_pairs, swapped, wrong_scale
from robocal_ros.core.hand_eye.camera_model import PairState, linearised
from robocal_ros.core.hand_eye.camera_quality import (
    LARGEST_RMS_M,
    distances,
    left_out,
    rms,
    verdict,
    working_error,
)
from robocal_ros.core.hand_eye.camera_start import robust_start, score
from robocal_ros.core.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted
from robocal_ros.core.hand_eye.result import HandEyeResult

Array = NDArray[np.float64]
Document = dict[str, Any]

METHODS = ("best", "classic", *CLOSED_FORMS)
LARGEST_START_M = 3e-2  # median miss beyond which no search can be trusted
MOST_COMPARED = 100  # samples for the closed forms: OpenCV pairs each with each


@dataclass(frozen=True)
class CameraSettings:
    """How to calibrate.

    Attributes
    ----------
    method : ``best`` is maximum likelihood; the name of a closed form is the same from that start;
        ``classic`` is the closed form that fits best, alone, without covariance.
    noise : what is known of it.
    limit_m : largest expected error where the boards were that is accepted.
    """

    method: str = "best"
    noise: GivenNoise = field(default_factory=GivenNoise)
    limit_m: float = 2e-3

    def __post_init__(self) -> None:
        if self.method not in METHODS:
            raise ValueError(f"{self.method} is not one of {', '.join(METHODS)}")


def calibrate_camera(
    pairs: PosePairs,
    settings: CameraSettings | None = None,
    *,
    check: PosePairs | None = None,
    rejected: Mapping[str, str] | None = None,
    more: Mapping[str, Any] | None = None,
) -> HandEyeResult:
    """Place a camera.

    Parameters
    ----------
    check : pairs that judge the result and are not used to find it.
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
    """
    how = settings or CameraSettings()
    require_sound(pairs, rejected or {})
    fit = fit_pairs(pairs, how.noise, _start(pairs, how.method))
    about = {"mount": pairs.mount} | _noise_document(fit, how.noise) | dict(more or {})
    if how.method == "classic":
        return _classic(pairs, check, dict(rejected or {}), about)
    return _result(fit, how, check, dict(rejected or {}), about)


def require_sound(pairs: PosePairs, rejected: Mapping[str, str]) -> None:
    """Refuse pairs in which no placement is worth a search, and name the mistake if it is known.

    Raises
    ------
    TooFewSamplesError, RankDeficientError, InputError, ResidualError
        As `calibrate_camera`.
    """
    require_pairs(pairs, rejected)
    sound = robust_start(pairs)
    size_m = score(pairs, sound)
    if size_m <= LARGEST_START_M:
        return
    words = mistake(pairs, sound)
    if words:
        raise InputError(words)
    raise ResidualError(
        f"robot and board miss each other by {size_m * 1e3:.4g} mm (allowed "
        f"{LARGEST_START_M * 1e3:.0f}): check that each board pose belongs to its robot pose, the "
        "mount (in-hand or to-hand), units and angles, and that the board stayed where it was"
    )


def _start(pairs: PosePairs, method: str) -> Placement | None:
    return closed_form(method, pairs) if method in CLOSED_FORMS else None


def closed_forms(pairs: PosePairs) -> dict[str, Placement | None]:
    """Each of OpenCV's, from at most 100 of the samples, spread evenly."""
    rows = np.unique(np.linspace(0, len(pairs) - 1, min(len(pairs), MOST_COMPARED)).astype(int))
    return {name: closed_form(name, pairs.take(rows)) for name in CLOSED_FORMS}


def _forms_document(pairs: PosePairs, forms: Mapping[str, Placement | None]) -> Document:
    return {
        "closed_forms_mean_mm": {
            name: None if at is None else float(distances(pairs, at).mean()) * 1e3
            for name, at in forms.items()
        }
    }


def _check_document(check: PosePairs | None, state: PairState) -> Document:
    """Errors at pairs that were not used, with the errors of the intrinsics as they were found."""
    if check is None:
        return {"check": None}
    known = check.shared is not None and len(state.common) > 0
    own = check if known else replace(check, shared=None)
    miss = linearised(own, state if known else PairState(state.at, np.zeros(0)))[0]
    return {"check": errors_document(summarise(miss[:, :3]))}


def _noise_document(fit: PairFit, known: GivenNoise) -> Document:
    noise, own = fit.noise, fit.pairs.covariance is not None
    return {
        "noise": {
            "position_mm": noise.position_m * 1e3,
            "robot_turn_deg": float(np.degrees(noise.turn_rad)),
            "camera_turn_deg": None if own else float(np.degrees(noise.camera)),
            "camera_scale": noise.camera_scale if own else None,
            "estimated": bool(np.any(np.isnan(known.variances(own)))),
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


def _result(
    fit: PairFit, how: CameraSettings, check: PosePairs | None, rejected: dict[str, str],
    about: Document,
) -> HandEyeResult:  # fmt: skip
    pairs, used = fit.pairs, ~fit.rejected
    miss = fit.differences[used]
    size = np.linalg.norm(miss[:, :3], axis=1)
    wrong = mistake(pairs, fit.at) if rms(size) > LARGEST_RMS_M else ""
    wrong = wrong or wrong_scale(pairs.take(used), fit.at)
    if wrong:
        raise InputError(wrong)
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
        verdict=verdict(fit, size, error, how.limit_m),
        more=about
        | {"start": how.method}
        | _forms_document(kept, closed_forms(kept))
        | _check_document(check, fit.estimate.state),
        parent="flange" if pairs.mount == "in-hand" else "base",
    )


def _classic(
    used: PosePairs, check: PosePairs | None, rejected: dict[str, str], about: Document
) -> HandEyeResult:
    """The closed form that fits all samples best."""
    forms = closed_forms(used)
    found = {name: at for name, at in forms.items() if at is not None}
    if not found:
        raise ResidualError("no closed form solves these pairs: measure at more different poses")
    name = min(found, key=lambda key: float(distances(used, found[key]).mean()))
    at = found[name]
    miss = differences(predicted(used, at), used)
    size = np.linalg.norm(miss[:, :3], axis=1)
    words = f"{name} fits {len(used)} samples within {rms(size) * 1e3:.3f} mm rms"
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
        more=about
        | {"start": name}
        | _forms_document(used, forms)
        | _check_document(check, PairState(at, np.zeros(0))),
        parent="flange" if used.mount == "in-hand" else "base",
    )


def _target_document(pairs: PosePairs, at: Placement) -> Document:
    parent = "base" if pairs.mount == "in-hand" else "flange"
    return {f"T_{parent}_board": transform_document(at.Z), "distance_mm": pairs.distance_m * 1e3}
