"""From captured samples to a calibration in the history."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import (
    InputError,
    RankDeficientError,
    ResidualError,
    TooFewSamplesError,
)
from robocal_ros.ground.proposals import Proposal, hand_eye_kind
from robocal_ros.hand_eye.config import HandEyeConfig, flange_poses
from robocal_ros.hand_eye.data import (
    FEATURES,
    IN_HAND,
    TO_HAND,
    TOPIC_OF,
    DataSet,
    HandEyeSample,
    board_of,
)
from robocal_ros.hand_eye.result import HandEyeResult, Method, hand_eye_document
from robocal_ros.hand_eye.shots import IMAGE, Profile, target_poses
from robocal_ros.hand_eye.targets import target_of
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.events import Command, History, Outcome

# ---- which estimator answers for which target ---------------------------------------------------
#
# The estimators are loaded when they are first used: a node's start does not need them.


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
    from robocal_ros.hand_eye.camera_model import PosePairs

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
    from robocal_ros.hand_eye.board import board_pairs, boards_of_corners, intrinsics_document
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


# ---- from captured samples to a calibration in the history --------------------------------------


class HandEyeResults:
    """Solves a data set and keeps what came of it.

    Parameters
    ----------
    software : version that made the calibrations.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: HandEyeConfig,
        software: str,
    ) -> None:
        self._nominal, self._history, self._config = nominal, history, config
        self._software = software

    def calibrate(self, data: DataSet, command: Command, wall_ns: int) -> Outcome:
        """Solve for the samples that the command names, and propose the result.

        Raises
        ------
        RobocalError
            When they cannot answer, or the history refuses.
        """
        arguments = command.arguments
        samples = data.chosen([int(handle) for handle in arguments.get("handles", ())])
        method = str(arguments.get("method") or data.method)
        q = np.array([sample.q for sample in samples]).reshape(-1, self._nominal.n)
        T_base_flange = flange_poses(q, [sample.thermal for sample in samples], self._nominal)
        try:
            result = solved(data, samples, T_base_flange, method, self._config)
        except RankDeficientError as error:
            told = {"unobservable": list(error.directions)}
            return Outcome(command, error.code, str(error), told, samples=len(samples))
        except np.linalg.LinAlgError as error:
            raise ResidualError(f"no pose of the sensor explains the samples: {error}") from error
        document = hand_eye_document(result)
        revisions = sorted({sample.thermal.revision for sample in samples})
        inputs = _inputs(data, samples, T_base_flange)
        kept = self._keep(inputs, result, document, command, wall_ns, revisions)
        verdict = result.verdict
        used = len({name.partition("/")[0] for name in result.samples})  # a step names corners
        return Outcome(command, verdict.code, verdict.reason, document, kept, samples=used)

    def _keep(
        self,
        inputs: dict[str, NDArray[Any]],
        result: HandEyeResult,
        document: dict[str, Any],
        command: Command,
        wall_ns: int,
        revisions: list[int],
    ) -> int:
        kind = hand_eye_kind(self._config.sensor_frame)
        left_out = result.leave_one_out_m
        return self._history.propose(
            Proposal(
                kind=kind,
                model_hash=self._nominal.model_hash,
                based_on=self._history.head(kind).revision,
                cycle_id="",
                stamp_ns=command.stamp_ns or 0,
                created_ns=wall_ns,
                software=self._software,
                method=f"{result.kind}, {result.method}",
                code=result.verdict.code,
                reason=result.verdict.reason,
                candidate_rms_mm=None
                if left_out is None
                else float(np.sqrt(np.mean(left_out**2))) * 1e3,
                document=document,
                model=self._model(result) | {"thermal_revisions": revisions},
                inputs=inputs,
            )
        )

    def _model(self, result: HandEyeResult) -> dict[str, Any]:
        """What comes into force: the pose in full precision, and the names of its frames."""
        config = self._config
        parent = config.base_frame if result.parent == "base" else config.flange_frame
        return {
            "parent": parent,
            "child": config.sensor_frame,
            "T_parent_sensor": result.T_flange_sensor.tolist(),
            "covariance": None if result.covariance is None else result.covariance.tolist(),
        }


def _inputs(
    data: DataSet, samples: Sequence[HandEyeSample], T_base_flange: NDArray[np.float64]
) -> dict[str, NDArray[Any]]:
    return {
        "handle": np.array([sample.handle for sample in samples]),
        "mark": np.array([sample.mark for sample in samples]),
        "stamp_ns": np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
        "q": np.array([sample.q for sample in samples]),
        "T_base_flange": T_base_flange,
        "count": np.array([len(sample.values) for sample in samples]),
        data.topic: np.concatenate([sample.values for sample in samples]),
    }
