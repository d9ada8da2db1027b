"""Closed-form start of base and targets, from the nominal arm."""

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import RankDeficientError, TooFewSamplesError
from robocal_ros.ground.samples import Measurements
from robocal_ros.identification.cell import CellModel
from robocal_ros.kinematics import SerialArm

Array = NDArray[np.float64]

_SMALLEST_SPREAD = 1e-6  # of the largest singular value: below it a direction is not seen
_ADVICE = "turn the flange about a second axis between the samples, or give base or target as known"


def linear_start(
    arm: SerialArm, data: Measurements, *, base: bool = False, tool: bool = False
) -> CellModel:
    """Solve base and targets linearly with the arm's present parameters.

    ``R^T p = p_base + c - R_flange p_target`` is linear in R^T (nine numbers), c and p_target;
    the rotation is then projected to SO(3).

    Raises
    ------
    TooFewSamplesError, RankDeficientError
        When the samples cannot give them.
    """
    targets = data.targets
    index = data.target_index(targets)
    T_base_flange = arm.fk(data.q)
    tools = np.broadcast_to(arm.T_flange_tool, (len(targets), 4, 4)).copy()
    T_frame_base = np.eye(4)
    if base and tool:
        T_frame_base, points = _base_and_points(T_base_flange, data.position, index, len(targets))
        tools[:, :3, 3] = points
    elif base:
        T = T_base_flange @ tools[index]
        T_frame_base = _aligned(T[:, :3, 3], data.position)
    elif tool:
        p = (frames.invert(T_base_flange) @ _homogeneous(data.position)[..., None])[:, :3, 0]
        for t in range(len(targets)):
            tools[t, :3, 3] = p[index == t].mean(axis=0)
    if tool and data.rotation is not None:
        relative = np.swapaxes(T_frame_base[:3, :3] @ T_base_flange[:, :3, :3], 1, 2)
        for t in range(len(targets)):
            mean = (relative @ data.rotation)[index == t].mean(axis=0)
            tools[t, :3, :3] = frames.nearest_rotation(mean)
    return CellModel(arm, T_frame_base, targets, tools)


def _homogeneous(points: Array) -> Array:
    return np.hstack([points, np.ones((len(points), 1))])


def _base_and_points(
    T_base_flange: Array, measured: Array, index: NDArray[np.int64], count: int
) -> tuple[Array, Array]:
    m = len(measured)
    unknowns = 12 + 3 * count
    if 3 * m < unknowns:
        raise TooFewSamplesError(
            f"{m} samples cannot place base and {count} target(s): at least "
            f"{-(-unknowns // 3)} are needed"
        )
    centre = measured.mean(axis=0)
    size = max(float(np.abs(measured - centre).max()), 1e-9)
    A = np.zeros((m, 3, unknowns))
    for axis in range(3):
        A[:, axis, 3 * axis : 3 * axis + 3] = (measured - centre) / size
        A[:, axis, 9 + axis] = 1.0
    for t in range(count):
        A[index == t, :, 12 + 3 * t : 15 + 3 * t] = -T_base_flange[index == t, :3, :3]
    rows = A.reshape(3 * m, unknowns)
    x, _, _, s = np.linalg.lstsq(rows, T_base_flange[:, :3, 3].ravel(), rcond=None)
    if s[-1] < _SMALLEST_SPREAD * s[0]:
        rank = int(np.sum(s >= _SMALLEST_SPREAD * s[0]))
        raise RankDeficientError(
            f"base and targets together: rank {rank} of {unknowns}; {_ADVICE}", (_ADVICE,)
        )
    R_base_frame = frames.nearest_rotation(x[:9].reshape(3, 3))
    points = x[12:].reshape(count, 3)
    in_base = T_base_flange[:, :3, 3] + np.einsum(
        "mij,mj->mi", T_base_flange[:, :3, :3], points[index]
    )
    R = R_base_frame.T
    return frames.transform(R, centre - R @ in_base.mean(axis=0)), np.asarray(points)


def _aligned(points: Array, measured: Array) -> Array:
    """Rigid transform (4, 4) that carries points (m, 3) onto measured ones (Kabsch)."""
    if len(points) < 3:
        raise TooFewSamplesError(f"{len(points)} samples cannot place the base: 3 are needed")
    p, y = points - points.mean(axis=0), measured - measured.mean(axis=0)
    s = np.linalg.svd(p, compute_uv=False)
    if s[1] < _SMALLEST_SPREAD * np.linalg.norm(points):
        raise RankDeficientError(
            "the points lie on one line and leave the base free to turn about it",
            ("base turns about the line of points: move off the line",),
        )
    R = frames.nearest_rotation(y.T @ p)
    return frames.transform(R, measured.mean(axis=0) - R @ points.mean(axis=0))
