"""Where a profile sensor sits on a robot, by laser tracker (multiple coordinate transformations).

Source: Jing, Hu and Guo 2020. ``classic`` is its closed form; ``best`` solves all measurements at
once, from there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.core import frames
from robocal_ros.core.assessment import Verdict
from robocal_ros.core.codes import Code
from robocal_ros.core.estimation import Estimate, solve
from robocal_ros.core.hand_eye.result import HandEyeResult, Method, point_covariance
from robocal_ros.core.hand_eye.tracker_classic import Classic, solve_classic
from robocal_ros.core.hand_eye.tracker_cube import Cube
from robocal_ros.core.hand_eye.tracker_data import TrackerData, TrackerNoise, TrackerTarget
from robocal_ros.core.hand_eye.tracker_features import Lines, fit_caps, fit_lines
from robocal_ros.core.hand_eye.tracker_problem import TrackerProblem, sphere_in
from robocal_ros.core.hand_eye.tracker_scan import Scan
from robocal_ros.core.hand_eye.tracker_skew import AxisPair
from robocal_ros.core.hand_eye.tracker_state import SENSOR, TrackerState

Array = NDArray[np.float64]

LIMIT_M = 5e-4  # of the error to expect at the working distance
SMALLEST_NOISE_M = 1e-7  # no sensor sees less; keeps data without noise solvable
ROUNDS = 2  # the sphere is linear only near its place
LARGEST_SCALE = 3.0  # of residuals over the noise that was told
FACES = ("face_1", "face_2")


def solve_tracker(
    data: TrackerData,
    target: TrackerTarget,
    noise: TrackerNoise,
    method: Method = "best",
    limit_m: float = LIMIT_M,
) -> HandEyeResult:
    """Calibrate.

    Parameters
    ----------
    limit_m : largest error to expect at the working distance that is accepted.

    Raises
    ------
    InputError, TooFewSamplesError, RankDeficientError, ResidualError
        Saying what the measurements lack.
    """
    classic = solve_classic(data, target, noise)
    if method == "classic":
        verdict = Verdict(
            Code.ACCEPT,
            f"tracker and sensor agree about the target within {classic.mismatch_m * 1e3:.3f} mm; "
            "the classic method tells no uncertainty",
        )
        return _result(data, target, classic, _state(classic), "classic", verdict)
    problem, estimate = solve_best(data, target, noise, classic)
    covariance = estimate.covariance[SENSOR, SENSOR]
    found = _result(data, target, classic, estimate.state, "best", Verdict(Code.NONE, ""))
    rejected = {**found.rejected, **_rejected(problem, estimate)}
    found = replace(found, covariance=covariance, rejected=rejected)
    z = float(np.median(np.concatenate([p.points[:, 1] for p in data.profiles])))
    spread = point_covariance(found, np.array([[0.0, 0.0, z]]))
    working_m = float(np.sqrt(np.trace(spread[0])))
    angle, gap_m = estimate.state.mismatch.tolist()
    more = {
        **found.more,
        "residual_over_noise": _misfit(estimate),
        "widened_by": estimate.scale,
        "axes_off_nominal": {"angle_deg": float(np.degrees(angle)), "gap_mm": gap_m * 1e3},
    }
    verdict = _verdict(estimate, working_m, limit_m)
    return replace(found, working_error_m=working_m, verdict=verdict, more=more)


def _state(classic: Classic) -> TrackerState:
    cube = classic.tracked
    return TrackerState(
        classic.T_tracker_flange, classic.T_flange_sensor, classic.reflector,
        cube.centre, cube.normals, cube.offsets, np.zeros(2),
    )  # fmt: skip


def solve_best(
    data: TrackerData, target: TrackerTarget, noise: TrackerNoise, classic: Classic
) -> tuple[TrackerProblem, Estimate[TrackerState]]:
    """All measurements at once, from the closed form on; the noise of the profiles is theirs.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `core.estimation.solve`.
    """
    fits = [fit_lines(scan, name) for scan, name in zip(classic.parts, FACES, strict=False)]
    scatter_m = float(np.sqrt(np.mean([scatter**2 for _, scatter in fits])))
    noise_m = max(scatter_m, SMALLEST_NOISE_M)
    lines = [_with_noise(lines, noise_m) for lines, _ in fits]
    state = _state(classic)
    axes = AxisPair.of(data, classic.axes)
    for _ in range(ROUNDS):
        place = sphere_in(state.sensor_poses(data.motion), state.centre)
        caps = fit_caps(classic.parts[2], place, target.sphere_radius_m, noise_m)
        problem = TrackerProblem(data, target, noise, state, axes, lines, caps)
        estimate = solve(problem, state)
        state = estimate.state
    return problem, estimate


def _with_noise(lines: Lines, noise_m: float) -> Lines:
    return replace(lines, z_sigma=lines.z_sigma * noise_m, slope_sigma=lines.slope_sigma * noise_m)


def _misfit(estimate: Estimate[TrackerState]) -> float:
    """Root mean square of the whitened residuals in use, unknowns counted: about 1."""
    used = estimate.residual[~estimate.rejected]
    return float(np.sqrt(np.sum(used**2) / max(used.size - len(estimate.names), 1)))


def _rejected(problem: TrackerProblem, estimate: Estimate[TrackerState]) -> dict[str, str]:
    worst: dict[str, float] = {}
    for index in np.flatnonzero(estimate.rejected):
        name = problem.rows[index]
        worst[name] = max(worst.get(name, 0.0), float(abs(estimate.residual[index, 0])))
    return {
        name: f"misses the solution by {miss:.1f} times its noise" for name, miss in worst.items()
    }


def _verdict(estimate: Estimate[TrackerState], working_m: float, limit_m: float) -> Verdict:
    misfit = _misfit(estimate)
    what = (
        f"{working_m * 1e3:.3f} mm rms to expect at the working distance (allowed "
        f"{limit_m * 1e3:.3f}), residuals {misfit:.2f} times the noise"
    )
    if not estimate.converged:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{estimate.creeping}; {what}")
    if misfit > LARGEST_SCALE:
        return Verdict(
            Code.RESIDUAL_TOO_LARGE,
            f"{what}: check the robot file, the noise that was given, and that tracker, base and "
            "target stood still",
        )
    if working_m > limit_m:
        return Verdict(
            Code.POSES_NOT_INFORMATIVE,
            f"{what}: measure longer arcs, and more points spread wider over the faces",
        )
    return Verdict(Code.ACCEPT, what)


def _result(
    data: TrackerData,
    target: TrackerTarget,
    classic: Classic,
    state: TrackerState,
    method: Method,
    verdict: Verdict,
) -> HandEyeResult:
    residual_m, seen = _profile_residuals(data, target, classic.parts, state)
    names = np.array([profile.name for profile in data.profiles])
    cube = Cube(state.normals, state.offsets, state.centre)
    return HandEyeResult(
        kind="tracker",
        method=method,
        T_flange_sensor=state.T_flange_sensor,
        covariance=None,
        samples=tuple(names[seen].tolist()),
        residual_m=residual_m[seen],
        verdict=verdict,
        rejected=dict.fromkeys(names[~seen].tolist(), "shows neither the faces nor the sphere"),
        target={
            "center_tracker_mm": (state.centre * 1e3).tolist(),
            "face_angle_deg": float(np.degrees(cube.angle)),
            "sphere_height_mm": (cube.heights * 1e3).tolist(),
        },
        more={
            "reflector_flange_mm": (state.reflector * 1e3).tolist(),
            "mismatch_mm": classic.mismatch_m * 1e3,
        },
    )


def _profile_residuals(
    data: TrackerData, target: TrackerTarget, parts: Sequence[Scan], state: TrackerState
) -> tuple[Array, NDArray[np.bool_]]:
    """Rms distance (m,) of each profile's points from the target, and which profiles show it."""
    P = state.sensor_poses(data.motion)
    total, count = np.zeros(len(P)), np.zeros(len(P))
    for index, scan in enumerate(parts):
        T = P[scan.profile]
        x, z = scan.points[:, :1], scan.points[:, 1:]
        points = T[:, :3, 0] * x + T[:, :3, 2] * z + T[:, :3, 3]
        if index < len(FACES):
            off = points @ state.normals[index] - state.offsets[index]
        else:
            off = np.linalg.norm(points - state.centre, axis=1) - target.sphere_radius_m
        total += np.bincount(scan.profile, off**2, len(P))
        count += np.bincount(scan.profile, minlength=len(P))
    seen = count > 0
    return np.sqrt(total / np.maximum(count, 1)), seen


@dataclass(frozen=True, eq=False)
class Spread:
    """How far runs are from their mean.

    Attributes
    ----------
    axis : (n,) distance of each unit axis of rotation from the mean's.
    angle_rad, translation_m : (n,) the same of the angle and of the translation.
    turn_rad : (n,) angle of the whole rotation from the mean; defined at any angle.
    """

    axis: Array
    angle_rad: Array
    translation_m: Array
    turn_rad: Array


def spread(poses: Array) -> Spread:
    """Repeatability of poses (n, 4, 4), as the source evaluates it, but by the logarithm.

    Near a half turn the axis is taken on the side of the mean's. Source: section 4.3, whose
    arccos loses the angle near 0 and pi.
    """
    R = poses[:, :3, :3]
    mean = frames.nearest_rotation(R.mean(axis=0))
    vectors = np.vstack([frames.log_rotation(mean)[None], frames.log_rotation(R)])
    angles = np.linalg.norm(vectors, axis=1)
    axes = vectors / np.maximum(angles, np.finfo(float).tiny)[:, None]
    back = axes @ axes[0] < 0.0
    axes[back] *= -1.0
    angles[back] = 2.0 * np.pi - angles[back]
    t = poses[:, :3, 3]
    return Spread(
        axis=np.linalg.norm(axes[1:] - axes[0], axis=1),
        angle_rad=np.abs(angles[1:] - angles[0]),
        translation_m=np.linalg.norm(t - t.mean(axis=0), axis=1),
        turn_rad=np.linalg.norm(frames.log_rotation(np.swapaxes(mean[None], 1, 2) @ R), axis=1),
    )
