"""The closed forms of OpenCV: five for AX = XB, two for AX = ZB."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground import frames
from robocal_ros.hand_eye.pose_pairs import Placement, PosePairs

Array = NDArray[np.float64]

HAND_EYE = ("tsai", "park", "horaud", "andreff", "daniilidis")
ROBOT_WORLD = ("shah", "li")
CLOSED_FORMS = (*HAND_EYE, *ROBOT_WORLD)

MOST_COMPARED = 100  # samples: OpenCV pairs each with each
_LEAST_DETERMINANT = 0.5  # of what OpenCV calls a rotation


def closed_form(name: str, pairs: PosePairs) -> Placement | None:
    """`closed_form_of_all`, of at most 100 of the samples, spread evenly."""
    if len(pairs) > MOST_COMPARED:
        pairs = pairs.take(np.linspace(0, len(pairs) - 1, MOST_COMPARED).astype(int))
    return closed_form_of_all(name, pairs)


def closed_form_of_all(name: str, pairs: PosePairs) -> Placement | None:
    """One of ``CLOSED_FORMS`` (cv2.calibrateHandEye, cv2.calibrateRobotWorldHandEye).

    OpenCV's five give X alone; Z is then the mean of what the samples make of it. None where
    OpenCV fails or gives what is no number. Time grows with the square of the samples.
    """
    import cv2

    carrier, board = pairs.T_boardside_cameraside, pairs.T_camera_board
    try:
        if name in HAND_EYE:
            code = getattr(cv2, f"CALIB_HAND_EYE_{name.upper()}")
            X = _transform(_call(cv2.calibrateHandEye, carrier, board, method=code))
            if np.array_equal(X, np.eye(4)):  # what OpenCV gives where motions tell too little
                return None
            Z = _mean(carrier @ X @ board)
        else:
            code = getattr(cv2, f"CALIB_ROBOT_WORLD_HAND_EYE_{name.upper()}")
            # OpenCV's world is our board, and its robot's poses are base in flange
            turned = frames.invert(carrier)
            R, t, R_camera, t_camera = _call(
                cv2.calibrateRobotWorldHandEye, board, turned, method=code
            )
            X = frames.invert(_transform((R_camera, t_camera)))
            Z = frames.invert(_transform((R, t)))
    except (cv2.error, np.linalg.LinAlgError):
        return None
    found = Placement(X, Z)
    return found if np.all(np.isfinite(X)) and np.all(np.isfinite(Z)) else None


def closed_forms(pairs: PosePairs) -> dict[str, Placement | None]:
    """Each of OpenCV's."""
    return {name: closed_form(name, pairs) for name in CLOSED_FORMS}


def _call(solve: Callable[..., Any], first: Array, second: Array, method: int) -> Any:
    return solve(
        list(first[:, :3, :3]),
        list(first[:, :3, 3]),
        list(second[:, :3, :3]),
        list(second[:, :3, 3]),
        method=method,
    )


def _transform(found: Any) -> Array:
    R, t = np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.float64)
    if not np.all(np.isfinite(R)) or np.linalg.det(R) < _LEAST_DETERMINANT:
        return np.full((4, 4), np.nan)
    return frames.transform(frames.nearest_rotation(R), t.ravel())


def _mean(T: Array) -> Array:
    """Mean of poses (m, 4, 4): of their positions, and the rotation nearest to all."""
    if not np.all(np.isfinite(T)):
        return np.full((4, 4), np.nan)
    R = frames.nearest_rotation(T[:, :3, :3].mean(axis=0))
    return frames.transform(R, T[:, :3, 3].mean(axis=0))
