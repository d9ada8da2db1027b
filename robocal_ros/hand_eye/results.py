"""From captured samples to a calibration in the history."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.ground.errors import RankDeficientError, ResidualError
from robocal_ros.ground.proposals import Proposal, hand_eye_kind
from robocal_ros.hand_eye.config import HandEyeConfig
from robocal_ros.hand_eye.data import DataSet, HandEyeSample
from robocal_ros.hand_eye.result import HandEyeResult, hand_eye_document
from robocal_ros.hand_eye.solving import solved
from robocal_ros.hand_eye.thermal import flange_poses
from robocal_ros.kinematics import SerialArm
from robocal_ros.session.decisions import History
from robocal_ros.session.events import Command, Outcome


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
