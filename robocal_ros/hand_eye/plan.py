"""The service of the hand-eye node that judges planned poses."""

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from robocal_msgs.srv import CheckHandEyePlan

from robocal_ros.ground.samples import joint_sample
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.hand_eye.session_planning import (
    judged_plan,
    pose_of,
    poses_of_flange,
    poses_of_joints,
    require_count,
    require_near,
    require_target,
    rough_mount,
    sphere_centre,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.ros.conversions import pose_message
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.pose_settings import given_pose

if TYPE_CHECKING:
    from robocal_ros.hand_eye.planning import PlanReport

Array = NDArray[np.float64]

ROUGH = "rough"  # the parameters that say about where the sensor sits


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
        from robocal_ros.hand_eye.planning import SensorRange

        session = self._session()
        data = require_target(session)
        poses = _poses(request, session)
        near, far, width = (1e-3 * x for x in self._settings["sensor_range_mm"])
        sensor = SensorRange(near, far, width, noise_m=self._settings["sensor_noise_mm"] * 1e-3)
        given = [pose_of(*_parts(pose), "sensor") for pose in request.sensor]
        configured = given_pose(self._settings, ROUGH)
        mount, who = rough_mount(session, self._history, next(iter(given), None), configured)
        if request.center:
            centre: Array | None = require_near(_point(request.center[0]), "center")
        else:
            centre = sphere_centre(data, self._history, session.current.arm, mount)
        config = session.config
        found = judged_plan(data, poses, list(request.marks), mount, sensor, config, centre)
        return _answered(response, found, who)


def _poses(request: Any, session: HandEyeSession) -> Array:
    require_count(len(request.joints), len(request.flange))
    if len(request.joints):
        return poses_of_joints(session.current.arm, [joint_sample(one) for one in request.joints])
    position, quat = zip(*(_parts(pose) for pose in request.flange), strict=True)
    return poses_of_flange(np.array(position), np.array(quat))


def _parts(pose: Any) -> tuple[list[float], list[float]]:
    o = pose.orientation
    return _point(pose.position), [o.x, o.y, o.z, o.w]


def _point(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def _answered(response: Any, found: "PlanReport", who: str) -> Any:
    response.success, response.status = found.verdict.accept, int(found.verdict.code)
    response.message = f"{found.verdict.reason} (the sensor's place is that of {who})"
    response.rank, response.unknowns = found.rank, found.unknowns
    error_m = found.working_error_m
    response.expected_error_mm = -1.0 if error_m is None else error_m * 1e3
    response.unobservable = list(found.unobservable)
    response.unseen = [f"pose {i + 1}: {why}" for i, why in sorted(found.unseen.items())]
    response.proposed = [pose_message(T) for T in found.proposed]
    return response
