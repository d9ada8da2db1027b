# SPDX-License-Identifier: Apache-2.0
"""Where a camera sits: from pairs of robot poses and board poses to a result that is judged."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict, errors_document, summarise
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, transform_document
from robocal_ros.hand_eye.camera_data import (
    CLOSED_FORMS,
    STEP_S,
    Mount,
    Placement,
    PosePairs,
    PoseStream,
    Shared,
    closed_form,
    coarse_offset,
    pairs_at,
)
from robocal_ros.hand_eye.camera_fit import (
    GivenNoise,
    PairFit,
    PairState,
    board_scale,
    differences,
    fit_pairs,
    linearised,
    predicted,
    robust_start,
    sample_sizes,
    scale_of_board,
    score,
)
from robocal_ros.hand_eye.mount_problem import same_pose
from robocal_ros.hand_eye.result import (
    MOST_REJECTED,
    HandEyeResult,
    HandEyeSettings,
    PoseNoise,
    PoseRows,
    apart,
    beside_found_noise,
    expected_error_m,
    judge_classic,
    said_of_joints,
)
from robocal_ros.kinematics.joint_errors import JointErrors, flange_errors

if TYPE_CHECKING:
    from robocal_ros.hand_eye.documents import CameraNoiseDocument

# ---- camera mistakes ----------------------------------------------------------------------------


FEWEST_PAIRS = 3
LEAST_TURN_RAD = float(np.radians(1.0))  # rms about a second axis
LEAST_SHIFT_M = 1e-2  # of the flange beside its axis
SMALLEST_M, LARGEST_M = 5e-3, 100.0  # reach of robots, cameras and trackers
CLEARLY_BETTER = 0.3
MOST_SHIFTED = 2  # samples by which one table may lag behind the other
MOST_SWAPPED = 20  # rejected samples among which swaps are looked for
SCALE_TOLERANCE = 0.02
ROBOTS_SCALE = 5e-3  # lengths of a robot as built may be off so far: a UR10 shows 2e-3
SCALE_SIGMAS = 5.0
_NEARLY = 0.1  # of a factor of a thousand


def require_pairs(pairs: PosePairs, rejected: Mapping[str, str]) -> None:
    """Refuse pairs that cannot give an answer, before anything is solved.

    ``rejected``: samples that were left out already, with the reason.

    Raises `TooFewSamplesError`: fewer than three; `InputError` when positions have another unit;
    `RankDeficientError` when the flange was turned about one axis only, or not at all.
    """
    if len(pairs) < FEWEST_PAIRS:
        raise TooFewSamplesError(
            f"{len(pairs)} samples: at least {FEWEST_PAIRS} with turns about two axes are needed "
            "(15 or more are better)"
            + "".join(f"; left out: {name}: {why}" for name, why in list(rejected.items())[:3])
        )
    for what, T in (("robot", pairs.T_base_flange), ("board", pairs.T_camera_board)):
        largest = float(np.linalg.norm(T[:, :3, 3], axis=1).max())
        if not SMALLEST_M < largest < LARGEST_M:
            small = largest <= SMALLEST_M
            raise InputError(
                f"the {what}'s positions reach {largest:.4g} m: are they a thousand times too "
                + ("small, m where mm are said?" if small else "large, mm where m are said?")
            )
    R = pairs.T_base_flange[:, :3, :3]
    mean = frames.nearest_rotation(R.mean(axis=0))
    turns = frames.log_rotation(mean.T @ R)
    turns = turns - turns.mean(axis=0)
    _, s, Vt = np.linalg.svd(turns, full_matrices=False)
    spread = s / np.sqrt(len(pairs))
    if spread[1] >= LEAST_TURN_RAD:
        return
    if spread[0] < LEAST_TURN_RAD:
        raise RankDeficientError(
            f"the flange turned by {np.degrees(spread[0]):.2f} deg rms only: the camera's place "
            "does not show; turn the flange about two axes, by 20 deg or more",
            ("translation of the camera in all directions",),
        )
    where = "flange" if pairs.mount == "in-hand" else "base"
    axis = Vt[0] if where == "flange" else mean @ Vt[0]
    words = " ".join(f"{value:+.2f}" for value in axis)
    hidden = [f"translation along the common rotation axis ({words} in the {where})"]
    remedy = "turn the flange about another axis too, by 20 deg or more"
    if _one_centre(pairs.T_boardside_cameraside):
        hidden.append(f"turn about the same axis ({words} in the {where})")
    raise RankDeficientError(
        f"the flange turned about one axis only ({np.degrees(spread[0]):.1f} deg rms, "
        f"{np.degrees(spread[1]):.2f} deg about any other); not determined: {'; '.join(hidden)}: "
        + remedy,
        hidden,
    )


def _one_centre(T: Array) -> bool:
    """Whether all poses (m, 4, 4), turned about one axis, are turns about one line."""
    # R_i u + t_i = p for one u and p
    A = np.concatenate([T[:, :3, :3], np.broadcast_to(-np.eye(3), (len(T), 3, 3))], axis=2)
    rows, t = A.reshape(-1, 6), T[:, :3, 3].ravel()
    miss = t - rows @ np.linalg.lstsq(rows, t, rcond=None)[0]
    spread = np.linalg.svd(miss.reshape(-1, 3), compute_uv=False) / np.sqrt(len(T))
    return bool(spread[1] < LEAST_SHIFT_M)  # along the axis it may move


def scale_words(factor: float, sigma: float, tolerance: float = SCALE_TOLERANCE) -> str:
    """Say that lengths of robot and board differ by a factor, known to a sigma.

    Empty within the tolerance, or where the factor may be 1.
    """
    away = abs(factor - 1.0)
    if away < tolerance or min(away, factor) < SCALE_SIGMAS * sigma:
        return ""
    for thousand, words in ((1e3, "small"), (1e-3, "large")):
        if abs(factor / thousand - 1.0) < _NEARLY:
            return (
                f"the board's positions look a thousand times too {words} beside the robot's: "
                "check the units, m and mm"
            )
    return (
        f"the board's positions fit the robot's when multiplied by {factor:.4f} +- {sigma:.4f}: "
        "check the size of its squares, the intrinsics, and the units"
    )


def mistake(pairs: PosePairs, at: Placement) -> str:
    """The mistake that explains why pairs fit badly, in words; empty where none does."""
    now = score(pairs, at)
    robot, board = pairs.T_base_flange, pairs.T_camera_board
    turned = replace(pairs, T_base_flange=frames.invert(robot))
    other = "to-hand" if pairs.mount == "in-hand" else "in-hand"
    tries = {
        "the robot's poses fit when they are inverted: are they T_flange_base, or is the camera "
        f"mounted {other}?": turned,
        "the board's poses fit when they are inverted: are they T_board_camera?": replace(
            pairs, T_camera_board=frames.invert(board)
        ),
        **_right_handed(pairs),
    }
    for lag in range(1, MOST_SHIFTED + 1):
        if len(pairs) - lag > FEWEST_PAIRS + 2:
            every = np.arange(len(pairs))
            for words, of, to in (
                ("after", every[:-lag], every[lag:]), ("before", every[lag:], every[:-lag])
            ):  # fmt: skip
                tries[
                    f"each board pose fits the robot pose {lag} row(s) {words} its own: the pairs "
                    "are shifted"
                ] = replace(pairs.take(of), T_base_flange=robot[to])
    scores = {words: score(tried, robust_start(tried)) for words, tried in tries.items()}
    best = min(scores, key=lambda words: scores[words])
    if scores[best] < CLEARLY_BETTER * now:
        return best
    return scale_words(*scale_of_board(pairs, at))


def _right_handed(pairs: PosePairs) -> dict[str, PosePairs]:
    """Pairs with a mirror undone, each by its words.

    Which axis a whole mirror turns round is a choice of frames; and to mirror the robot's poses
    undoes a mirror of the board's as well.
    """
    flip = np.diag([1.0, -1.0, 1.0, 1.0])
    remedy = "they come from a left-handed frame: turn one axis round"
    mirrored = replace(pairs, T_base_flange=flip @ pairs.T_base_flange @ flip)
    found = {f"the robot's poses, or the board's, fit when mirrored as a whole: {remedy}": mirrored}
    for axis, name in enumerate("xyz"):
        robot, board = pairs.T_base_flange.copy(), pairs.T_camera_board.copy()
        robot[:, axis, 3] *= -1.0
        board[:, axis, 3] *= -1.0
        words = f"positions fit with {name} negated: {remedy}"
        found[f"the robot's {words}"] = replace(pairs, T_base_flange=robot)
        found[f"the board's {words}"] = replace(pairs, T_camera_board=board)
    return found


def swapped(pairs: PosePairs, at: Placement, rejected: NDArray[np.bool_]) -> dict[str, str]:
    """Which rejected samples fit when their robot poses are exchanged: name and the other's."""
    rows = np.flatnonzero(rejected)
    if not 2 <= len(rows) <= MOST_SWAPPED:
        return {}
    first, second = (grid.ravel() for grid in np.meshgrid(rows, rows, indexing="ij"))
    crossed = replace(pairs.take(first), T_base_flange=pairs.T_base_flange[second])
    size = sample_sizes(crossed, at).reshape(len(rows), len(rows))
    usual = 3.0 * float(np.max(sample_sizes(pairs.take(~rejected), at)))
    found = {}
    for i, row in enumerate(rows):
        others = [j for j in range(len(rows)) if j != i and size[i, j] < usual > size[j, i]]
        if others and size[i, i] >= usual:
            found[pairs.names[row]] = pairs.names[rows[others[0]]]
    return found


# ---- how good a camera's place is: leave-one-out, the error to expect, the decision -------------


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
    return float(expected_error_m(fit.covariance[:6, :6], where[None]))


def unsettled(fit: PairFit) -> Verdict | None:
    """Refuse a fit that is no solution; None where it is one."""
    if fit.estimate.converged and fit.settled:
        return None
    return Verdict(
        Code.POSES_NOT_INFORMATIVE,
        fit.estimate.creeping
        or "the noise did not settle; measure at more poses, or give the robot's noise",
    )


def judge_camera(fit: PairFit, limit_m: float) -> Verdict:
    """Whether a solution may be used."""
    if refused := unsettled(fit):
        return refused
    size = np.linalg.norm(fit.differences[~fit.rejected][:, :3], axis=1)
    count, total, error_m = len(size), len(fit.pairs), working_error(fit)
    words = (
        f"{count} of {total} samples within {rms(size) * 1e3:.3f} mm rms; expected error "
        f"{error_m * 1e3:.3f} mm at {fit.pairs.distance_m * 1e3:.0f} mm"
    )
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
    factor, sigma, moved_m = board_scale(fit)
    doubt = scale_words(factor, sigma, 0.0) if moved_m > error_m else ""
    if doubt:
        doubt = f"; with the camera {moved_m * 1e3:.2f} mm elsewhere {doubt}"
        if moved_m > limit_m and abs(factor - 1.0) > ROBOTS_SCALE:
            return Verdict(Code.RESIDUAL_TOO_LARGE, words + doubt)
    if error_m > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{words} (allowed {limit_m * 1e3:.4g}): measure at more poses, turned "
            f"further about two axes{doubt}",
        )
    return Verdict(Code.ACCEPT, words + doubt)


def rms(size: Array) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(size**2)))


# ---- camera -------------------------------------------------------------------------------------


METHODS = ("best", "classic", *CLOSED_FORMS)
LARGEST_START_M = 3e-2  # median miss beyond which no search can be trusted


@dataclass(frozen=True)
class CameraSettings:
    """How to calibrate.

    ``method``: ``best`` is maximum likelihood; the name of a closed form is the same from that
    start; ``classic`` is the closed form that fits best, alone, without covariance. ``noise``: what
    is known of it. ``limit_m``: largest expected error where the boards were that is accepted.
    ``joint_error_rad``: see `HandEyeSettings`.
    """

    method: str = "best"
    noise: GivenNoise = field(default_factory=GivenNoise)
    limit_m: float = HandEyeSettings.limit_m
    joint_error_rad: float = 0.0

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

    ``check``: what judges the result and is not used to find it. ``rejected``: samples that were
    left out before, with the reason. ``more``: further entries of the document.

    Raises `TooFewSamplesError` or `RankDeficientError` when the poses do not show the camera's
    place; `InputError` when the pairs hold a mistake that can be named: units, inverted, shifted;
    `ResidualError` when nothing fits them.
    """
    how = settings or CameraSettings()
    pairs, again = _first_of_each_pose(pairs)
    rejected = {**(rejected or {}), **again}
    sound = require_sound(pairs, rejected)
    start = None
    if how.method in CLOSED_FORMS and (start := closed_form(how.method, pairs)) is None:
        raise ResidualError(f"{how.method} does not solve these pairs: use method best")
    fit = fit_pairs(pairs, how.noise, start, sound)
    used = ~fit.rejected
    size_m = np.linalg.norm(fit.differences[used][:, :3], axis=1)
    wrong = mistake(fit.pairs, fit.at) if rms(size_m) > LARGEST_RMS_M else ""
    if wrong := wrong or scale_words(*board_scale(fit)[:2]):
        raise InputError(wrong)
    noise = _noise_document(fit, how.noise)
    about = {"mount": pairs.mount, "noise": noise, **(more or {})}
    result, state = (_classic if how.method == "classic" else _best)(fit, how)
    result = replace(result, rejected={**rejected, **result.rejected}, more=about | result.more)
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
    judged, off_m = result.verdict, rms(np.linalg.norm(miss, axis=1))
    if judged.accept and off_m > LARGEST_RMS_M:
        judged = Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"samples that were not used to solve are off by {off_m * 1e3:.2f} mm rms (allowed "
            f"{LARGEST_RMS_M * 1e3:.0f} mm)",
        )
    return replace(result, verdict=judged, more={**result.more, "held_out": held_out})


def _noise_document(fit: PairFit, known: GivenNoise) -> "CameraNoiseDocument":
    noise, own = fit.noise, fit.pairs.covariance is not None
    return {
        "position_mm": noise.position_m * 1e3,
        "robot_turn_deg": float(np.degrees(noise.turn_rad)),
        "camera_tilt_deg": None if own else float(np.degrees(noise.tilt_rad)),
        "camera_roll_deg": None if own else float(np.degrees(noise.roll_rad)),
        "camera_depth_mm": None if own else noise.depth_m * 1e3,
        "camera_scale": noise.camera_scale if own else None,
        "estimated": bool(np.any(np.isnan(known.variances(own)))),
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


def _best(fit: PairFit, how: CameraSettings) -> tuple[HandEyeResult, PairState]:
    kept, miss = fit.pairs.take(~fit.rejected), fit.differences[~fit.rejected]
    forms = {name: closed_form(name, kept) for name in CLOSED_FORMS}
    result = replace(
        _unjudged(kept, fit.at, miss, how.method, forms, fit.pairs.distance_m),
        method="best",
        covariance=fit.covariance[:6, :6],
        leave_one_out_m=left_out(fit),
        rejected=_reasons(fit),
        working_error_m=working_error(fit),
        verdict=judge_camera(fit, how.limit_m),
    )
    erring = joint_errors(fit, how.joint_error_rad, how.noise) if how.joint_error_rad else None
    return said_of_joints(result, erring), fit.estimate.state


def joint_errors(fit: PairFit, size_rad: float, given: GivenNoise) -> JointErrors | None:
    """What joints that err by ``size_rad`` add to a camera's covariance.

    None where joints are not known, or the model holds what they err by, and of a stream, which is
    read while they turn.
    """
    used = np.flatnonzero(~fit.rejected)
    pairs, J = fit.pairs.take(used), fit.jacobian[used]
    if pairs.joints is None or pairs.time_s is not None:
        return None
    errors = flange_errors(pairs.joints.arm, size_rad, pairs.joints.q)
    if errors is None:
        return None
    # A flange that is elsewhere is a camera that is, or to hand a board.
    one, at = (J[..., :6], fit.at.X) if pairs.mount == "in-hand" else (J[..., 6:12], fit.at.Z)
    both = np.concatenate([J, one @ frames.adjoint(frames.invert(at))], axis=2)
    J, G = np.split(np.linalg.solve(np.linalg.cholesky(fit.expected[used]), both), [-6], axis=2)
    rows = PoseRows(J, G, fit.estimate.covariance / fit.estimate.scale**2, slice(0, 6))
    noise = PoseNoise(fit.noise.position_m, fit.noise.turn_rad)
    told = fit.covariance[:6, :6]
    known = given.robot_m is not None and pairs.covariance is not None
    return beside_found_noise(rows, errors, noise, told, size_rad, known)


def _classic(fit: PairFit, how: CameraSettings) -> tuple[HandEyeResult, PairState]:
    """The closed form that fits all samples best; the most likely placement judges it.

    Its error to expect is its distance from that placement, where the boards were, with that one's:
    what refuses that one leaves nothing to judge by.
    """
    pairs = fit.pairs
    forms = {name: closed_form(name, pairs) for name in CLOSED_FORMS}
    found = {name: at for name, at in forms.items() if at is not None}
    if not found:
        raise ResidualError("no closed form solves these pairs: measure at more different poses")
    name = min(found, key=lambda key: float(distances(pairs, found[key]).mean()))
    at = found[name]
    miss = differences(predicted(pairs, at), pairs)
    size = np.linalg.norm(miss[:, :3], axis=1)
    away_m = apart(at.X, fit.at.X, pairs.T_camera_board[:, :3, 3])
    error_m = float(np.hypot(away_m, working_error(fit)))
    words = f"{name} fits {len(size)} samples within {rms(size) * 1e3:.3f} mm rms"
    judged = judge_camera(fit, how.limit_m)
    if judged.accept and rms(size) > LARGEST_RMS_M:
        words += f" (allowed {LARGEST_RMS_M * 1e3:.0f} mm): use method best"
        judged = Verdict(Code.RESIDUAL_TOO_LARGE, words)
    elif judged.accept:
        judged = judge_classic(away_m, error_m, how.limit_m)
        judged = Verdict(judged.code, f"{words}; {judged.reason}")
    result = replace(
        _unjudged(pairs, at, miss, name, forms, pairs.distance_m),
        leave_one_out_m=left_out_of_form(name, pairs, at),
        working_error_m=error_m,
        verdict=judged,
    )
    return result, PairState(at, np.zeros(0))


def _unjudged(
    pairs: PosePairs, at: Placement, miss: Array, start: str,
    forms: Mapping[str, Placement | None], distance_m: float,
) -> HandEyeResult:  # fmt: skip
    """What both methods report of the pairs that they used; ``miss`` (n, 6) of these."""
    in_hand = pairs.mount == "in-hand"
    means = {
        name: None if form is None else float(distances(pairs, form).mean()) * 1e3
        for name, form in forms.items()
    }
    return HandEyeResult(
        kind="camera",
        method="classic",
        T_flange_sensor=at.X,
        covariance=None,
        samples=pairs.names,
        residual_m=np.asarray(np.linalg.norm(miss[:, :3], axis=1)),
        residual_rad=np.asarray(np.linalg.norm(miss[:, 3:], axis=1)),
        target={
            f"T_{'base' if in_hand else 'flange'}_board": transform_document(at.Z),
            "distance_mm": distance_m * 1e3,
        },
        verdict=Verdict(Code.NONE, ""),
        more={"start": start, "closed_forms_mean_mm": means},
        parent="flange" if in_hand else "base",
    )


_FREE_S = 0.5  # prior sigma of what is left of the offset
_CLOSE_S = 1e-6
_ROUNDS = 12
_ALONE = "no robot pose at its time"


def _with_offset(robot: PoseStream, pairs: PosePairs, fit: PairFit, offset_s: float) -> PosePairs:
    """Pairs with what is left of the offset as an error common to all."""
    time = pairs.time_s
    if time is None:
        raise ValueError("pairs of a stream have times")
    half = 0.5 * max(robot.period_s, STEP_S)
    later, sooner = (
        predicted(replace(pairs, T_base_flange=robot.at(time + offset_s + h)), fit.at)
        for h in (half, -half)
    )
    motion = differences(later, replace(pairs, T_camera_board=sooner)) / (2.0 * half)
    return replace(pairs, shared=Shared(-motion[:, :, None], np.array([[_FREE_S**2]])))


@dataclass(frozen=True, eq=False)
class StreamPairs:
    """Paired streams: ``left_out`` names the camera poses without one of the robot."""

    pairs: PosePairs
    offset_s: float
    sigma_s: float
    left_out: tuple[str, ...]


def pair_streams(
    robot: PoseStream, camera: PoseStream, mount: Mount = "in-hand",
    given: GivenNoise | None = None,
) -> StreamPairs:  # fmt: skip
    """Find the offset, and pair the streams by it."""
    offset = coarse_offset(robot, camera)
    pairs, left_out = pairs_at(robot, camera, offset, mount)
    fit = fit_pairs(pairs, given, sound=require_sound(pairs, {}))
    for _ in range(_ROUNDS):
        fit = fit_pairs(_with_offset(robot, pairs, fit, offset), given, fit.at, fit.at)
        step = float(fit.estimate.state.common[0])
        offset += step
        pairs, left_out = pairs_at(robot, camera, offset, mount)
        sigma_s = float(np.sqrt(fit.whole_covariance[12, 12]))
        if abs(step) < max(_CLOSE_S, 0.01 * sigma_s):
            break
    else:
        raise RankDeficientError(
            f"the time offset did not settle (last {offset:.4f} s): record a motion that turns "
            "about all axes, with changes of speed",
            ("time offset",),
        )
    return StreamPairs(_with_offset(robot, pairs, fit, offset), offset, sigma_s, left_out)


def calibrate_streams(
    robot: PoseStream, camera: PoseStream, mount: Mount = "in-hand",
    settings: CameraSettings | None = None, check: PoseStream | None = None,
) -> HandEyeResult:  # fmt: skip
    """Place a camera from two streams; the result's ``more`` tells the offset.

    ``check``: a stream of the robot at times of the camera's that judge the result.
    """
    how = settings or CameraSettings()
    found = pair_streams(robot, camera, mount, how.noise)
    judges = None if check is None else _judges(found, check, camera)
    elsewhere = set() if judges is None else {*judges.pairs.names, *judges.rejected}
    return calibrate_camera(
        found.pairs,
        how,
        check=judges,
        rejected={name: _ALONE for name in found.left_out if name not in elsewhere},
        more={"time_offset_s": found.offset_s, "time_offset_sigma_s": found.sigma_s},
    )


def _judges(found: StreamPairs, check: PoseStream, camera: PoseStream) -> CheckPairs:
    """Pairs of the check's stretch, and the camera poses there that have none of the robot."""
    # the common error is the offset, which is in the times already
    pairs = pairs_at(check, camera, found.offset_s, found.pairs.mount)[0]
    used, held = set(found.pairs.names), set(pairs.names)
    twice = [name for name in pairs.names if name in used]
    if twice:
        raise InputError(
            f"{len(twice)} of the camera's poses, first {twice[0]}, lie in the robot's stream and "
            "in that of the check: other times must judge"
        )
    time = camera.time_s + found.offset_s
    there = (time >= check.time_s[0]) & (time <= check.time_s[-1])
    alone = set(np.array(camera.names)[there].tolist()) & set(found.left_out) - held
    return CheckPairs(pairs, {name: _ALONE for name in found.left_out if name in alone})
