"""Is a mount good, in mm? Its errors, its expected error at the working distance, the verdict."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.mount_fit import MountFit, noise_numbers
from robocal_ros.hand_eye.mount_problem import MountProblem, PoseNoise
from robocal_ros.hand_eye.result import point_jacobian, shots_of

Array = NDArray[np.float64]

MOST_REJECTED = 1.0 / 3.0
FEWEST_TOLD = 6  # numbers that tell the noise of poses, where it is found from the data
LARGEST_POSE_M = 2e-3  # error of a pose in space that a robot may have
CONTRADICTED = 2.0  # times the given noise
ARM_M = 1.0
STRIDE = 8  # of the points that tell the field of view
OUTSIDE = 0.02  # share of points beyond it on each side: spikes
MOST_MISFITS = 0.2  # of those that show the target
FEWEST_SPARE = 3  # measured numbers beyond the unknowns, without which nothing is judged


@dataclass(frozen=True)
class HandEyeSettings:
    """What is known of the robot, and what is good enough.

    Attributes
    ----------
    robot_sigma_m, robot_sigma_rad : standard deviation of a reported pose along and about each
        axis; None to estimate both from the profiles. Where the first is given alone, the second
        is that shift at an arm's length of 1 m.
    limit_m : largest expected error (rms) of a point in the field that the profiles cover.
    residual_m : largest distance (rms) of samples from the target.
    """

    robot_sigma_m: float | None = None
    robot_sigma_rad: float | None = None
    limit_m: float = 1e-3
    residual_m: float = 2e-3

    def noise(self) -> PoseNoise | None:
        """Of reported poses; None where it is to be estimated."""
        if self.robot_sigma_m is None:
            return None
        turn = self.robot_sigma_m / ARM_M if self.robot_sigma_rad is None else self.robot_sigma_rad
        return PoseNoise(self.robot_sigma_m, turn)


def field_points(profiles: Sequence[Array]) -> Array:
    """Middle and corners (5, 3) of the field that profiles (n, 2) cover, sensor frame, m."""
    points = np.concatenate([profile[::STRIDE] for profile in profiles])
    low, high = np.quantile(points, [OUTSIDE, 1.0 - OUTSIDE], axis=0)
    x, z = np.stack([low, high]).T
    corners = [[a, 0.0, b] for a in x for b in z]
    return np.array([[x.mean(), 0.0, z.mean()], *corners])


def expected_error_m(covariance: Array, points: Array) -> float:
    """Root mean square error of points (n, 3), counted from the pivot of a covariance (6, 6)."""
    return float(expected_errors_m(covariance, points))


def expected_errors_m(covariance: Array, points: Array) -> Array:
    """`expected_error_m` (...) for many covariances (..., 6, 6)."""
    J = point_jacobian(points)
    spread = J @ covariance[..., None, :, :] @ np.swapaxes(J, 1, 2)
    return np.asarray(np.sqrt(np.trace(spread, axis1=-2, axis2=-1).mean(axis=-1)))


def apart(T_one: Array, T_other: Array, points: Array) -> float:
    """Root mean square distance of sensor points (n, 3), m, under two poses of the sensor."""
    away = points @ (T_one - T_other)[:3, :3].T + (T_one - T_other)[:3, 3]
    return float(np.sqrt(np.mean(np.sum(away**2, axis=1))))


def judge_classic(apart_m: float, error_m: float, settings: HandEyeSettings) -> Verdict:
    """The verdict on a classic estimate that is so far from the best one in the field of view."""
    words = f"a closed form, {apart_m * 1e3:.3f} mm from the best estimate in the field of view; "
    words += f"a point there is expected to be off by {error_m * 1e3:.3f} mm rms"
    if error_m > settings.limit_m:
        words = f"{words} (allowed {settings.limit_m * 1e3:g} mm): use method best"
        return Verdict(Code.POSES_NOT_INFORMATIVE, words)
    return Verdict(Code.ACCEPT, words)


def judge_residuals(
    distances_m: Array, shots: int, lost: int, settings: HandEyeSettings
) -> Verdict | None:
    """Refuse samples that are too far off, or too few of them; None where they will do."""
    rms = float(np.sqrt(np.mean(distances_m**2)))
    if rms > settings.residual_m:
        words = f"samples are off by {rms * 1e3:.2f} mm (allowed {settings.residual_m * 1e3:g} mm)"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    if lost > MOST_REJECTED * shots:
        words = f"{lost} of {shots} samples do not fit the others: see the rejected ones"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    return None


def judge(
    fit: MountFit, shots: int, lost: int, error_m: float, settings: HandEyeSettings
) -> Verdict:
    """The verdict on a mount; ``lost`` of ``shots`` gave nothing or did not fit."""
    refused = (
        _too_few(fit, settings)
        or judge_residuals(fit.distances(), shots, lost, settings)
        or _inconsistent(fit)
    )
    if refused is not None:
        return refused
    if fit.creeping:
        return Verdict(Code.POSES_NOT_INFORMATIVE, fit.creeping)
    figures = f"a point in the field of view is expected to be off by {error_m * 1e3:.3f} mm rms"
    if error_m > settings.limit_m:
        words = (
            f"{figures} (allowed {settings.limit_m * 1e3:g} mm): tilt the flange more, show the "
        )
        words += "target at more distances, or measure more often; check-plan proposes poses"
        return Verdict(Code.POSES_NOT_INFORMATIVE, words)
    rms = float(np.sqrt(np.mean(fit.distances() ** 2)))
    words = f"{figures}; samples are off by {rms * 1e3:.3f} mm rms"
    if fit.scale > CONTRADICTED:
        words += f", {fit.scale:.1f} times what the given noise explains"
    return Verdict(Code.ACCEPT, words)


def _too_few(fit: MountFit, settings: HandEyeSettings) -> Verdict | None:
    """Refuse data that leave too little to judge by; None where they do not."""
    problem = MountProblem(fit.views, fit.noise, fit.state)
    spare = int(problem.sizes.sum()) - len(fit.covariance)
    if spare < FEWEST_SPARE:
        words = f"only {spare} measured numbers beyond the unknowns: show the target more often"
        return Verdict(Code.TOO_FEW_SAMPLES, words)
    if settings.noise() is None and (told := noise_numbers(problem)) < FEWEST_TOLD:
        words = f"{len(problem.poses)} poses leave {max(told, 0)} numbers to tell the robot's noise"
        words += f" (at least {FEWEST_TOLD}): show the target more often, or give the robot's noise"
        return Verdict(Code.TOO_FEW_SAMPLES, words)
    return None


def _inconsistent(fit: MountFit) -> Verdict | None:
    """Refuse poses that contradict each other by more than a robot; None where they do not."""
    off_m = float(np.sqrt(3.0)) * fit.noise.sigma_m * fit.scale
    if off_m > LARGEST_POSE_M:
        words = (
            f"from pose to pose robot and target are off by {off_m * 1e3:.2f} mm: has the target"
        )
        words += " moved, does the robot repeat, are the poses those of the profiles?"
        return Verdict(Code.RESIDUAL_TOO_LARGE, words)
    wrong = len(fit.rejected)
    if wrong > MOST_MISFITS * (wrong + len(fit.names)) and len(shots_of(fit.rejected)) > 1:
        words = f"{wrong} of {wrong + len(fit.names)} features do not fit the others: see the "
        return Verdict(Code.RESIDUAL_TOO_LARGE, f"{words}rejected ones")
    return None
