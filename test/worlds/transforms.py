# SPDX-License-Identifier: Apache-2.0
"""Transforms and poses of messages as matrices."""

from typing import Any

import numpy as np

from robocal_ros.ground import frames


def matrix_of(message: Any) -> np.ndarray:
    """A Transform or a Pose (4, 4)."""
    p = getattr(message, "translation", None) or message.position
    q = getattr(message, "rotation", None) or message.orientation
    return frames.transform_from_quat([p.x, p.y, p.z], [q.x, q.y, q.z, q.w])


def away_of(T: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """How far a pose is off and turned (6,), in the axes that its covariance is told in."""
    turn = frames.log_rotation(T[:3, :3] @ truth[:3, :3].T)
    return np.concatenate([T[:3, 3] - truth[:3, 3], turn])


def off_m(transform: Any, truth: np.ndarray, depth_m: float = 0.0) -> float:
    """How far a point at a sensor's working distance is off."""
    off = (matrix_of(transform) - truth) @ [0.0, 0.0, depth_m, 1.0]
    return float(np.linalg.norm(off[:3]))
