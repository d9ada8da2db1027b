"""Where a profile sensor sits on a robot, by laser tracker (multiple coordinate transformations).

Source: Jing, Hu and Guo 2020. ``classic`` is its closed form; ``best`` solves all measurements at
once, from there.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.estimation.estimation import Estimate, solve
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ResidualError
from robocal_ros.hand_eye.quality import HandEyeSettings, apart, field_points, judge_classic
from robocal_ros.hand_eye.result import HandEyeResult, Method, point_covariance
from robocal_ros.hand_eye.tracker_classic import Classic, each_without, solve_classic
from robocal_ros.hand_eye.tracker_data import FACES, Cube, TrackerData, TrackerNoise, TrackerTarget
from robocal_ros.hand_eye.tracker_problem import (
    SENSOR,
    AxisPair,
    TrackerProblem,
    TrackerUnknowns,
    sphere_in,
)
from robocal_ros.hand_eye.tracker_scan import Lines, Scan, fit_caps, fit_lines

# ---- tracker quality ----------------------------------------------------------------------------


Array = NDArray[np.float64]

LARGEST_SCALE = 3.0  # of residuals over the noise that was told
LEAST_REST = 1e-6  # what the others say about a profile, where they say anything


def profile_distances(
    data: TrackerData,
    target: TrackerTarget,
    parts: Sequence[Scan],
    states: Sequence[TrackerUnknowns],
) -> tuple[Array, NDArray[np.bool_]]:
    """Rms distance (m,), m, of each profile's points from the target, and which show it.

    ``states`` (m,): for each profile, where sensor and target are.
    """
    P = np.array([state.sensor_poses(T) for state, T in zip(states, data.motion, strict=True)])
    normals = np.array([state.normals for state in states])
    offsets = np.array([state.offsets for state in states])
    centres = np.array([state.centre for state in states])
    total, count = np.zeros(len(P)), np.zeros(len(P))
    for index, scan in enumerate(parts):
        own = scan.profile
        T, x, z = P[own], scan.points[:, :1], scan.points[:, 1:]
        points = T[:, :3, 0] * x + T[:, :3, 2] * z + T[:, :3, 3]
        if index < len(FACES):
            off = np.einsum("ni,ni->n", points, normals[own, index]) - offsets[own, index]
        else:
            off = np.linalg.norm(points - centres[own], axis=1) - target.sphere_radius_m
        total += np.bincount(own, off**2, len(P))
        count += np.bincount(own, minlength=len(P))
    return np.sqrt(total / np.maximum(count, 1)), count > 0


def states_without(
    problem: TrackerProblem, estimate: Estimate[TrackerUnknowns], names: Sequence[str]
) -> list[TrackerUnknowns | None]:
    """The solution without each of these profiles, to first order; None where it is none.

    Without the rows i the estimate moves by M J_i^T (I - J_i M J_i^T)^-1 r_i, M the inverse
    information (Cook and Weisberg 1982, "Residuals and Influence in Regression", section 3.4).
    """
    J = problem.linearise(estimate.state)[1][:, 0]
    M = estimate.covariance / estimate.scale**2
    rows = np.array(problem.rows)
    found: list[TrackerUnknowns | None] = []
    for name in names:
        own = (rows == name) & ~estimate.rejected
        rest = np.eye(int(own.sum())) - J[own] @ M @ J[own].T
        if np.any(np.linalg.eigvalsh(rest) < LEAST_REST):
            found.append(None)
            continue
        step = M @ J[own].T @ np.linalg.solve(rest, estimate.residual[own, 0])
        found.append(estimate.state.moved(step))
    return found


def misfit(estimate: Estimate[TrackerUnknowns]) -> float:
    """Root mean square of the whitened residuals in use, unknowns counted: about 1."""
    used = estimate.residual[~estimate.rejected]
    return float(np.sqrt(np.sum(used**2) / max(used.size - len(estimate.names), 1)))


def verdict_of(estimate: Estimate[TrackerUnknowns], working_m: float, limit_m: float) -> Verdict:
    """Whether a solution may be used; ``working_m``: error to expect at the working distance."""
    over = misfit(estimate)
    what = (
        f"{working_m * 1e3:.3f} mm rms to expect at the working distance (allowed "
        f"{limit_m * 1e3:.3f}), residuals {over:.2f} times the noise"
    )
    if not estimate.converged:
        return Verdict(Code.POSES_NOT_INFORMATIVE, f"{estimate.creeping}; {what}")
    if over > LARGEST_SCALE:
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


# ---- tracker ------------------------------------------------------------------------------------


LIMIT_M = 5e-4  # of the error to expect at the working distance
SMALLEST_NOISE_M = 1e-7  # no sensor sees less; keeps data without noise solvable
MOST_ROUNDS, NEAR_M = 10, 1e-5  # the sphere is linear only near its place


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
    problem, estimate = solve_best(data, target, noise, classic)
    best = _best(data, target, classic, problem, estimate, limit_m)
    if method == "classic":
        return _classic(data, target, classic, best, limit_m)
    return best


def _best(
    data: TrackerData,
    target: TrackerTarget,
    classic: Classic,
    problem: TrackerProblem,
    estimate: Estimate[TrackerUnknowns],
    limit_m: float,
) -> HandEyeResult:
    covariance = estimate.covariance[SENSOR, SENSOR]
    found = _result(data, target, classic, estimate.state, "best")
    rejected = {**found.rejected, **_rejected(problem, estimate)}
    states = states_without(problem, estimate, [profile.name for profile in data.profiles])
    found = replace(
        found,
        covariance=covariance,
        rejected=rejected,
        leave_one_out_m=_left_out(data, target, classic, states),
    )
    z = float(np.median(np.concatenate([p.points[:, 1] for p in data.profiles])))
    spread = point_covariance(found, np.array([[0.0, 0.0, z]]))
    working_m = float(np.sqrt(np.trace(spread[0])))
    angle, gap_m = estimate.state.mismatch.tolist()
    more = {
        **found.more,
        "residual_over_noise": misfit(estimate),
        "widened_by": estimate.scale,
        "axes_off_nominal": {"angle_deg": float(np.degrees(angle)), "gap_mm": gap_m * 1e3},
    }
    verdict = verdict_of(estimate, working_m, limit_m)
    return replace(found, working_error_m=working_m, verdict=verdict, more=more)


def _classic(
    data: TrackerData,
    target: TrackerTarget,
    classic: Classic,
    best: HandEyeResult,
    limit_m: float,
) -> HandEyeResult:
    """The closed form; its error is its distance from the best estimate, with that one's own."""
    away_m = apart(
        classic.T_flange_sensor,
        best.T_flange_sensor,
        field_points([profile.points for profile in data.profiles]),
    )
    error_m = float(np.hypot(away_m, best.working_error_m or 0.0))
    states = [
        None if T is None else replace(_state(classic), T_flange_sensor=T)
        for T in each_without(classic, target, len(data.profiles))
    ]
    return replace(
        _result(data, target, classic, _state(classic), "classic"),
        leave_one_out_m=_left_out(data, target, classic, states),
        working_error_m=error_m,
        verdict=best.verdict
        if best.verdict.code is Code.RESIDUAL_TOO_LARGE
        else judge_classic(away_m, error_m, HandEyeSettings(limit_m=limit_m)),
    )


def _left_out(
    data: TrackerData,
    target: TrackerTarget,
    classic: Classic,
    states: Sequence[TrackerUnknowns | None],
) -> Array | None:
    """Rms distance (n,), m, of each profile's points from the target as found without it.

    None where a profile alone determines something.
    """
    known = [state for state in states if state is not None]
    if len(known) < len(states):
        return None
    distance_m, seen = profile_distances(data, target, classic.parts, known)
    return distance_m[seen]


def _state(classic: Classic) -> TrackerUnknowns:
    cube = classic.tracked
    return TrackerUnknowns(
        classic.T_tracker_flange, classic.T_flange_sensor, classic.reflector,
        cube.centre, cube.normals, cube.offsets, np.zeros(2),
    )  # fmt: skip


def solve_best(
    data: TrackerData, target: TrackerTarget, noise: TrackerNoise, classic: Classic
) -> tuple[TrackerProblem, Estimate[TrackerUnknowns]]:
    """All measurements at once, from the closed form on; the noise of the profiles is theirs.

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        As `estimation.estimation.solve`.
    ResidualError
        When the place of the sphere does not settle.
    """
    fits = [fit_lines(scan, name) for scan, name in zip(classic.parts, FACES, strict=False)]
    scatter_m = float(np.sqrt(np.mean([scatter**2 for _, scatter in fits])))
    noise_m = max(scatter_m, SMALLEST_NOISE_M)
    lines = [_with_noise(lines, noise_m) for lines, _ in fits]
    state = _state(classic)
    axes = AxisPair.of(data, classic.axes)
    for _ in range(MOST_ROUNDS):
        place = sphere_in(state.sensor_poses(data.motion), state.centre)
        caps = fit_caps(classic.parts[2], place, target.sphere_radius_m, noise_m)
        problem = TrackerProblem(data, target, noise, state, axes, lines, caps)
        estimate = solve(problem, state)
        state = estimate.state
        if np.abs(sphere_in(state.sensor_poses(data.motion), state.centre) - place).max() < NEAR_M:
            return problem, estimate
    raise ResidualError(
        f"the place of the sphere in the profiles did not settle in {MOST_ROUNDS} rounds: scan "
        "more of it, and check the robot file"
    )


def _with_noise(lines: Lines, noise_m: float) -> Lines:
    return replace(lines, z_sigma=lines.z_sigma * noise_m, slope_sigma=lines.slope_sigma * noise_m)


def _rejected(problem: TrackerProblem, estimate: Estimate[TrackerUnknowns]) -> dict[str, str]:
    worst: dict[str, float] = {}
    for index in np.flatnonzero(estimate.rejected):
        name = problem.rows[index]
        worst[name] = max(worst.get(name, 0.0), float(abs(estimate.residual[index, 0])))
    return {
        name: f"misses the solution by {miss:.1f} times its noise" for name, miss in worst.items()
    }


def _result(
    data: TrackerData,
    target: TrackerTarget,
    classic: Classic,
    state: TrackerUnknowns,
    method: Method,
) -> HandEyeResult:
    """What both methods tell, not judged yet."""
    states = [state] * len(data.profiles)
    residual_m, seen = profile_distances(data, target, classic.parts, states)
    names = np.array([profile.name for profile in data.profiles])
    cube = Cube(state.normals, state.offsets, state.centre)
    return HandEyeResult(
        kind="tracker",
        method=method,
        T_flange_sensor=state.T_flange_sensor,
        covariance=None,
        samples=tuple(names[seen].tolist()),
        residual_m=residual_m[seen],
        verdict=Verdict(Code.NONE, ""),
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
