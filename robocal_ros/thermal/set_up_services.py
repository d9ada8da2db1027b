"""Services of the thermal node for its set-up: where the sensor stands, which poses to visit."""

from collections.abc import Awaitable, Callable, Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from numpy.typing import NDArray
from robocal_msgs.srv import CalibrateSensor, PlanPoses
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, ConflictError, LimitError
from robocal_ros.ground.samples import joint_sample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros.conversions import transform_message
from robocal_ros.ros.endpoints import trigger_text
from robocal_ros.session.events import CALIBRATE_SENSOR, Command, Outcome
from robocal_ros.thermal.cycle_planning import POSES, plan_cycle
from robocal_ros.thermal.documents import placed_of
from robocal_ros.thermal.pose_planning import SensorField
from robocal_ros.thermal.setting_up import SENSOR

Array = NDArray[np.float64]
MOST_POSES = 20  # a plan holds the node up for two seconds then
AddService = Callable[[type, str, Callable[[Any, Any], Any]], None]
Ask = Callable[[Command], Awaitable[Outcome]]


class SetUpServices:
    """``~/calibrate_sensor`` with its twin, and ``~/plan_poses``.

    Parameters
    ----------
    add, ask : create a service; give a command to the session and await its outcome.
    settings : the node's; ``prior`` tells the expected drift of the session, (k, k), SI.
    """

    def __init__(
        self,
        add: AddService,
        ask: Ask,
        history: CalibrationHistory,
        nominal: SerialArm,
        settings: Mapping[str, Any],
        prior: Callable[[], Array],
    ) -> None:
        self._ask, self._history, self._nominal = ask, history, nominal
        self._settings, self._prior = settings, prior
        add(CalibrateSensor, "~/calibrate_sensor", self._calibrate_sensor)
        add(Trigger, "~/calibrate_sensor_trigger", self._calibrate_twin)
        add(PlanPoses, "~/plan_poses", self._plan_poses)

    async def _calibrate_sensor(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CALIBRATE_SENSOR, {"method": request.method}))
        response.success, response.status = outcome.done, int(outcome.status)
        response.message, response.samples = outcome.message, outcome.samples
        response.calibration_id = outcome.calibration_id
        response.left_out_rms_mm = -1.0
        if outcome.document is None:
            return response
        T_sensor_base, sphere = placed_of(outcome.document)
        response.sensor_base = transform_message(T_sensor_base)
        response.sphere_in_flange = Point(**dict(zip("xyz", sphere.tolist(), strict=True)))
        response.rejected = list(outcome.document["rejected"])
        if outcome.document["left_out"] is not None:
            response.left_out_rms_mm = outcome.document["left_out"]["rms_mm"]
        return response

    async def _calibrate_twin(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CALIBRATE_SENSOR, {}))
        response.success = outcome.done
        response.message = trigger_text(outcome.calibration_id, outcome.status, outcome.message)
        return response

    def _plan_poses(self, request: Any, response: Any) -> Any:
        sensor = self._history.head(SENSOR).model
        if sensor is None:
            raise ConflictError("the sensor is not placed: call calibrate_sensor first")
        T_sensor_base, sphere = placed_of(sensor)
        if request.count > MOST_POSES:
            raise LimitError(f"{request.count} poses: at most {MOST_POSES} are planned at a time")
        found = plan_cycle(
            self._nominal,
            T_sensor_base,
            sphere,
            SensorField(*(1e-3 * x for x in self._settings["sensor_field_mm"])),
            prior=self._prior(),
            sigma_m=self._settings["sigma_mm"] * 1e-3,
            count=request.count or POSES,
            own=self._joints(request.own) if request.own else None,
        )
        plan, names = found.plan, list(self._nominal.joint_names)
        response.poses = [JointState(name=names, position=q) for q in plan.q.tolist()]
        response.predicted_mm = plan.predicted_rms_m * 1e3
        response.random_mm, response.before_mm = plan.random_rms_m * 1e3, plan.before_rms_m * 1e3
        response.own_mm = -1.0 if found.own_rms_m is None else found.own_rms_m * 1e3
        response.success, response.status = True, int(Code.ACCEPT)
        response.message = (
            f"{len(plan.q)} poses: {response.predicted_mm:.3f} mm rms expected after one cycle, "
            f"{response.random_mm:.3f} mm with random ones"
        )
        return response

    def _joints(self, states: Sequence[Any]) -> Array:
        names = self._nominal.joint_names
        samples = [joint_sample(state) for state in states]
        return np.array([sample.position[sample.order(names)] for sample in samples])
