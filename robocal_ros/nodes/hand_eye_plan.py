"""The service of the hand-eye node that judges planned poses."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from robocal_msgs.srv import CheckHandEyePlan

from robocal_ros.core import frames
from robocal_ros.core.errors import ConflictError, InputError, LimitError
from robocal_ros.core.samples import joint_sample
from robocal_ros.nodes.endpoints import EndpointNode
from robocal_ros.nodes.pose_settings import given_pose
from robocal_ros.nodes.tool_messages import pose_message
from robocal_ros.sessions.hand_eye import HandEyeSession
from robocal_ros.sessions.hand_eye_planning import judged_plan
from robocal_ros.storage.calibrations import CalibrationHistory

if TYPE_CHECKING:
    from robocal_ros.core.hand_eye.planning import PlanReport

Array = NDArray[np.float64]

ROUGH = "rough"  # the parameters that say about where the sensor sits
MOST_POSES = 200


class HandEyePlan:
    """``~/check_plan``.

    Parameters
    ----------
    session : the one that runs.
    """

    def __init__(
        self,
        node: EndpointNode,
        settings: Mapping[str, Any],
        session: Callable[[], HandEyeSession],
        history: CalibrationHistory,
    ) -> None:
        self._settings, self._session, self._history = settings, session, history
        node.add_service(CheckHandEyePlan, "~/check_plan", self._check)

    def _check(self, request: Any, response: Any) -> Any:
        from robocal_ros.core.hand_eye.planning import SensorRange  # heavy: not at a node's start

        session = self._session()
        if session.data is None:
            raise ConflictError("no data set is open: call start, so that the target is known")
        poses = self._poses(request, session)
        near, far, width = (1e-3 * x for x in self._settings["sensor_range_mm"])
        sensor = SensorRange(near, far, width, noise_m=self._settings["sensor_noise_mm"] * 1e-3)
        mount = self._mount(session)
        found = judged_plan(session.data, poses, list(request.marks), mount, sensor, session.config)
        return _answered(response, found)

    def _poses(self, request: Any, session: HandEyeSession) -> Array:
        count = max(len(request.joints), len(request.flange))
        if not count or (len(request.joints) and len(request.flange)):
            raise InputError("give the planned poses either as joints or as flange poses")
        if count > MOST_POSES:
            raise LimitError(f"{count} poses: at most {MOST_POSES} are judged at a time")
        if len(request.flange):
            return np.array([_matrix(pose, i) for i, pose in enumerate(request.flange, 1)])
        names = session.nominal.joint_names
        samples = [joint_sample(state) for state in request.joints]
        q = np.array([sample.position[sample.order(names)] for sample in samples])
        return session.current.arm.fk(q)

    def _mount(self, session: HandEyeSession) -> Array:
        """Where the sensor sits, as well as it is known: in force, measured last, as configured."""
        model = session.in_force.model
        if model is None and session.data is not None and session.data.candidate:
            model = self._history.model(session.data.candidate)
        if model is not None and model["parent"] == session.config.flange_frame:
            return np.array(model["T_parent_sensor"])
        rough = given_pose(self._settings, ROUGH)
        if rough is None:
            raise InputError(
                "nothing says where the sensor sits: set rough_xyz_mm and rough_quat_xyzw to a few "
                "millimetres and degrees"
            )
        return rough


def _matrix(pose: Any, number: int) -> Array:
    p, o = pose.position, pose.orientation
    quat = np.array([o.x, o.y, o.z, o.w])
    norm = float(np.linalg.norm(quat))
    if not (abs(norm - 1.0) <= 1e-3 and np.all(np.isfinite([p.x, p.y, p.z]))):
        raise InputError(f"flange pose {number} is none: its quaternion has length {norm:.6g}")
    return frames.transform_from_quat([p.x, p.y, p.z], quat / norm)


def _answered(response: Any, found: "PlanReport") -> Any:
    response.success, response.status = found.verdict.accept, int(found.verdict.code)
    response.message = found.verdict.reason
    response.rank, response.unknowns = found.rank, found.unknowns
    error_m = found.working_error_m
    response.expected_error_mm = -1.0 if error_m is None else error_m * 1e3
    response.unobservable = list(found.unobservable)
    response.unseen = [f"pose {i + 1}: {why}" for i, why in sorted(found.unseen.items())]
    response.proposed = [pose_message(T) for T in found.proposed]
    return response
