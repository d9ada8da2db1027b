"""Which estimator answers for which target.

The estimators are loaded when they are first used: a node's start does not need them.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import InputError, TooFewSamplesError
from robocal_ros.hand_eye.config import HandEyeConfig
from robocal_ros.hand_eye.data import FEATURES, IN_HAND, TO_HAND, TOPIC_OF, DataSet, HandEyeSample
from robocal_ros.hand_eye.images import board_of
from robocal_ros.hand_eye.profile import Profile
from robocal_ros.hand_eye.result import HandEyeResult, Method
from robocal_ros.hand_eye.shots import IMAGE, target_poses
from robocal_ros.hand_eye.target_documents import target_of

Array = NDArray[np.float64]
Samples = Sequence[HandEyeSample]
Solver = Callable[[DataSet, Samples, Array, Method, HandEyeConfig], HandEyeResult]

METHODS = ("best", "classic")
MOUNTS = (IN_HAND, TO_HAND)
WITHOUT_FILE = ("line", "camera")  # solved with the sensor's place


def require_known(data: DataSet, method: str) -> None:
    """Refuse a target, a method or a mount that no estimator answers for.

    Raises
    ------
    InputError
        Naming those that there are.
    """
    for what, value, known in (
        ("target", data.kind, tuple(TOPIC_OF)),
        ("feature", data.feature, FEATURES),
        ("method", method, METHODS),
        ("mount", data.mount, MOUNTS),
    ):
        if value not in known:
            raise InputError(f"{what} '{value}' is none of {', '.join(known)}")
    if target_of(data.target) is None and data.kind not in WITHOUT_FILE:
        raise InputError(f"nothing is known of the {data.kind}: name the file that describes it")
    if data.mount == TO_HAND and data.kind != "camera":
        raise InputError(
            f"a {data.kind} is seen by a sensor on the flange: one that stands still is calibrated "
            "with the target camera"
        )


def solved(
    data: DataSet, samples: Samples, T_base_flange: Array, method: str, config: HandEyeConfig
) -> HandEyeResult:
    """Where the sensor sits; ``T_base_flange`` (k, 4, 4), m, of the samples.

    Raises
    ------
    RobocalError
        When the samples cannot answer.
    """
    require_known(data, method)
    if not samples:
        raise TooFewSamplesError("nothing was captured yet: capture the target from several poses")
    solver = _of_images if data.topic == IMAGE else _SOLVERS[data.kind]
    return solver(data, samples, T_base_flange, cast(Method, method), config)


def _of_profiles(
    data: DataSet, samples: Samples, T_base_flange: Array, method: Method, config: HandEyeConfig
) -> HandEyeResult:
    from robocal_ros.estimation.edge import EdgeRule
    from robocal_ros.hand_eye.quality import HandEyeSettings
    from robocal_ros.hand_eye.solve import solve_line, solve_sphere, solve_step
    from robocal_ros.hand_eye.tasks import HandEyeData

    names = tuple(str(sample.handle) for sample in samples)
    shots = HandEyeData(
        names,
        T_base_flange,
        [Profile(sample.values, name) for name, sample in zip(names, samples, strict=True)],
        tuple(sample.mark for sample in samples) if data.kind == "step" else None,
    )
    settings = HandEyeSettings(config.robot_sigma_m, config.robot_sigma_rad, config.limit_m)
    target: Any = target_of(data.target)
    if data.kind == "line":
        return solve_line(shots, target, method, settings, EdgeRule(kind=data.feature))
    solve = solve_sphere if data.kind == "sphere" else solve_step
    return solve(shots, target, method, settings)


def _of_poses(
    data: DataSet, samples: Samples, T_base_flange: Array, method: Method, config: HandEyeConfig
) -> HandEyeResult:
    from robocal_ros.hand_eye.camera import CameraSettings, calibrate_camera
    from robocal_ros.hand_eye.camera_fit import GivenNoise
    from robocal_ros.hand_eye.pose_pairs import PosePairs

    pairs = PosePairs(
        T_base_flange,
        target_poses(np.concatenate([sample.values for sample in samples])),
        tuple(str(sample.handle) for sample in samples),
        data.mount,
    )
    noise = GivenNoise(config.robot_sigma_m, config.robot_sigma_rad)
    return calibrate_camera(pairs, CameraSettings(method, noise, config.limit_m))


def _of_images(
    data: DataSet, samples: Samples, T_base_flange: Array, method: Method, config: HandEyeConfig
) -> HandEyeResult:
    from robocal_ros.hand_eye.board import boards_of_corners
    from robocal_ros.hand_eye.board_pairs import board_pairs, intrinsics_document
    from robocal_ros.hand_eye.camera import CameraSettings, calibrate_camera
    from robocal_ros.hand_eye.camera_fit import GivenNoise

    target = board_of(data.target)
    names = tuple(str(sample.handle) for sample in samples)
    corners = np.array([sample.values[1:] for sample in samples])
    width, height = samples[0].values[0]
    size = int(width), int(height)
    seen = boards_of_corners(names, corners, target.board, size, target.intrinsics)
    noise = GivenNoise(config.robot_sigma_m, config.robot_sigma_rad)
    return calibrate_camera(
        board_pairs(seen, names, T_base_flange, data.mount),
        CameraSettings(method, noise, config.limit_m),
        rejected=seen.rejected,
        more={"intrinsics": intrinsics_document(seen, target.intrinsics is None)},
    )


_SOLVERS: Mapping[str, Solver] = {
    "sphere": _of_profiles,
    "step": _of_profiles,
    "line": _of_profiles,
    "camera": _of_poses,
}
