"""Where a camera sits: from pairs of robot poses and board poses to a result that is judged."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import errors_document, summarise
from robocal_ros.ground.errors import InputError, ResidualError
from robocal_ros.ground.frames import transform_document
from robocal_ros.hand_eye.camera_closed_forms import CLOSED_FORMS, closed_form, closed_forms
from robocal_ros.hand_eye.camera_fit import GivenNoise, PairFit, fit_pairs
from robocal_ros.hand_eye.camera_mistakes import mistake, require_pairs, swapped, wrong_scale
from robocal_ros.hand_eye.camera_model import PairState, linearised
from robocal_ros.hand_eye.camera_quality import (
    LARGEST_RMS_M,
    distances,
    form_error,
    form_verdict,
    held_out_verdict,
    left_out,
    left_out_of_form,
    rms,
    unsettled,
    verdict,
    working_error,
)
from robocal_ros.hand_eye.camera_start import robust_start, score
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs, differences, predicted
from robocal_ros.hand_eye.result import HandEyeResult
from robocal_ros.hand_eye.sightings import same_pose

Array = NDArray[np.float64]
Document = dict[str, Any]

METHODS = ("best", "classic", *CLOSED_FORMS)
LARGEST_START_M = 3e-2  # median miss beyond which no search can be trusted


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


@dataclass(frozen=True, eq=False)
class CheckPairs:
    """Pairs that judge, and the samples left out of them with the reason."""

    pairs: PosePairs
    rejected: Mapping[str, str] = field(default_factory=dict)


def calibrate_camera(
    pairs: PosePairs,
    settings: CameraSettings | None = None,
    *,
    check: CheckPairs | None = None,
    rejected: Mapping[str, str] | None = None,
    more: Mapping[str, Any] | None = None,
) -> HandEyeResult:
    """Place a camera.

    Parameters
    ----------
    check : what judges the result and is not used to find it.
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
    pairs, again = _first_of_each_pose(pairs)
    rejected = {**(rejected or {}), **again}
    sound = require_sound(pairs, rejected)
    fit = fit_pairs(pairs, how.noise, _start(pairs, how.method), sound)
    _require_no_mistake(fit)
    about = {"mount": pairs.mount} | _noise_document(fit, how.noise) | dict(more or {})
    result, state = (_classic if how.method == "classic" else _best)(fit, how)
    result = replace(
        result,
        rejected={**rejected, **result.rejected},
        more=about | result.more,
    )
    return result if check is None else _judged(result, check, state)


def _first_of_each_pose(pairs: PosePairs) -> tuple[PosePairs, dict[str, str]]:
    """The first pair of each robot pose, and why others are left out."""
    first = same_pose(pairs.T_base_flange)
    again = np.flatnonzero(first != np.arange(len(pairs)))
    return pairs.take(np.unique(first)), {
        pairs.names[row]: f"from the pose of {pairs.names[first[row]]}, whose error it shares"
        for row in again
    }


def require_sound(pairs: PosePairs, rejected: Mapping[str, str]) -> Placement:
    """`robust_start`; refuse pairs in which no placement is worth a search.

    The mistake is named if it is known.

    Raises
    ------
    TooFewSamplesError, RankDeficientError, InputError, ResidualError
        As `calibrate_camera`.
    """
    require_pairs(pairs, rejected)
    sound = robust_start(pairs)
    size_m = score(pairs, sound)
    if size_m <= LARGEST_START_M:
        return sound
    words = mistake(pairs, sound)
    if words:
        raise InputError(words)
    raise ResidualError(
        f"robot and board miss each other by {size_m * 1e3:.4g} mm (allowed "
        f"{LARGEST_START_M * 1e3:.0f}): check that each board pose belongs to its robot pose, the "
        "mount (in-hand or to-hand), units and angles, and that the board stayed where it was"
    )


def _start(pairs: PosePairs, method: str) -> Placement | None:
    if method not in CLOSED_FORMS:
        return None
    start = closed_form(method, pairs)
    if start is None:
        raise ResidualError(f"{method} does not solve these pairs: use method best")
    return start


def _forms_document(pairs: PosePairs, forms: Mapping[str, Placement | None]) -> Document:
    return {
        "closed_forms_mean_mm": {
            name: None if at is None else float(distances(pairs, at).mean()) * 1e3
            for name, at in forms.items()
        }
    }


def _judged(result: HandEyeResult, check: CheckPairs, state: PairState) -> HandEyeResult:
    """A result with the errors at pairs that were not used; they may refuse it.

    The errors of the intrinsics are taken as they were found.
    """
    pairs = check.pairs
    known = pairs.shared is not None and len(state.common) > 0
    own = pairs if known else replace(pairs, shared=None)
    miss = linearised(own, state if known else PairState(state.at, np.zeros(0)))[0][:, :3]
    held_out = errors_document(summarise(miss)) | {
        "rejected": list(check.rejected), "rejected_because": dict(check.rejected),
    }  # fmt: skip
    refused = held_out_verdict(np.linalg.norm(miss, axis=1)) if result.verdict.accept else None
    return replace(
        result, verdict=refused or result.verdict, more={**result.more, "held_out": held_out}
    )


def _noise_document(fit: PairFit, known: GivenNoise) -> Document:
    noise, own = fit.noise, fit.pairs.covariance is not None
    return {
        "noise": {
            "position_mm": noise.position_m * 1e3,
            "robot_turn_deg": float(np.degrees(noise.turn_rad)),
            "camera_tilt_deg": None if own else float(np.degrees(noise.tilt_rad)),
            "camera_roll_deg": None if own else float(np.degrees(noise.roll_rad)),
            "camera_depth_mm": None if own else noise.depth_m * 1e3,
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


def _require_no_mistake(fit: PairFit) -> None:
    used = ~fit.rejected
    size = np.linalg.norm(fit.differences[used][:, :3], axis=1)
    wrong = mistake(fit.pairs, fit.at) if rms(size) > LARGEST_RMS_M else ""
    wrong = wrong or wrong_scale(fit.pairs.take(used), fit.at)
    if wrong:
        raise InputError(wrong)


def _best(fit: PairFit, how: CameraSettings) -> tuple[HandEyeResult, PairState]:
    pairs, used = fit.pairs, ~fit.rejected
    miss = fit.differences[used]
    size = np.linalg.norm(miss[:, :3], axis=1)
    kept = pairs.take(used)
    error = working_error(fit)
    result = HandEyeResult(
        kind="camera",
        method="best",
        T_flange_sensor=fit.at.X,
        covariance=fit.covariance[:6, :6],
        samples=kept.names,
        residual_m=size,
        residual_rad=np.asarray(np.linalg.norm(miss[:, 3:], axis=1)),
        leave_one_out_m=left_out(fit),
        rejected=_reasons(fit),
        target=_target_document(pairs, fit.at),
        working_error_m=error,
        verdict=unsettled(fit) or verdict(fit, size, error, how.limit_m),
        more={"start": how.method} | _forms_document(kept, closed_forms(kept)),
        parent=_parent(pairs),
    )
    return result, fit.estimate.state


def _classic(fit: PairFit, how: CameraSettings) -> tuple[HandEyeResult, PairState]:
    """The closed form that fits all samples best; the most likely placement judges it."""
    used = fit.pairs
    forms = closed_forms(used)
    found = {name: at for name, at in forms.items() if at is not None}
    if not found:
        raise ResidualError("no closed form solves these pairs: measure at more different poses")
    name = min(found, key=lambda key: float(distances(used, found[key]).mean()))
    at = found[name]
    miss = differences(predicted(used, at), used)
    size = np.linalg.norm(miss[:, :3], axis=1)
    away_m, error_m = form_error(at, fit)
    result = HandEyeResult(
        kind="camera",
        method="classic",
        T_flange_sensor=at.X,
        covariance=None,
        samples=used.names,
        residual_m=size,
        residual_rad=np.asarray(np.linalg.norm(miss[:, 3:], axis=1)),
        leave_one_out_m=left_out_of_form(name, used, at),
        target=_target_document(used, at),
        working_error_m=error_m,
        verdict=unsettled(fit) or form_verdict(name, size, away_m, error_m, how.limit_m),
        more={"start": name} | _forms_document(used, forms),
        parent=_parent(used),
    )
    return result, PairState(at, np.zeros(0))


def _parent(pairs: PosePairs) -> Literal["flange", "base"]:
    return "flange" if pairs.mount == "in-hand" else "base"


def _target_document(pairs: PosePairs, at: Placement) -> Document:
    parent = "base" if pairs.mount == "in-hand" else "flange"
    return {f"T_{parent}_board": transform_document(at.Z), "distance_mm": pairs.distance_m * 1e3}
