"""How good a calibration by laser tracker is: distances of the profiles, and the decision."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.assessment import Verdict
from robocal_ros.estimation.estimation import Estimate
from robocal_ros.ground.errors import Code
from robocal_ros.hand_eye.tracker_data import FACES, TrackerData, TrackerTarget
from robocal_ros.hand_eye.tracker_problem import TrackerProblem
from robocal_ros.hand_eye.tracker_scan import Scan
from robocal_ros.hand_eye.tracker_state import TrackerUnknowns

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
