"""The services of the thermal node: each call becomes a command, its outcome the answer."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, TransformStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from robocal_msgs.msg import AccuracyState, CalibrationQuality, KinematicModel
from robocal_msgs.srv import (
    BeginCycle,
    CalibrateSensor,
    CaptureReference,
    EndCycle,
    Identify,
    PlanPoses,
)
from sensor_msgs.msg import JointState
from std_msgs.msg import Header
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, ConflictError, LimitError
from robocal_ros.ground.proposals import THERMAL
from robocal_ros.ground.samples import joint_sample
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.conversions import transform_message
from robocal_ros.ros.decision_services import AddService, Ask, DecisionServices, answer, twin
from robocal_ros.ros.endpoints import trigger_text
from robocal_ros.ros.session_node import SessionEvents
from robocal_ros.session.events import (
    BEGIN_CYCLE,
    CALIBRATE_SENSOR,
    CAPTURE_REFERENCE,
    END_CYCLE,
    IDENTIFY,
    Command,
    Outcome,
)
from robocal_ros.thermal.accuracy_state import Accuracy
from robocal_ros.thermal.documents import placed_of
from robocal_ros.thermal.planning import POSES, SensorField, plan_cycle
from robocal_ros.thermal.proposing import SENSOR


class ThermalServices:
    """Services and their Trigger twins.

    Parameters
    ----------
    add : creates a service.
    ask : gives a command to the session and awaits its outcome.
    """

    def __init__(self, add: AddService, ask: Ask, history: CalibrationHistory) -> None:
        self._ask = ask
        self._history = history
        add(CaptureReference, "~/capture_reference", self._capture_reference)
        add(Identify, "~/identify", self._identify)
        add(BeginCycle, "~/begin_cycle", self._begin_cycle)
        add(EndCycle, "~/end_cycle", self._end_cycle)
        for name in (BEGIN_CYCLE, END_CYCLE, CAPTURE_REFERENCE, IDENTIFY):
            add(Trigger, f"~/{name}_trigger", twin(ask, name, {}))
        DecisionServices(add, ask, history, THERMAL)

    async def _capture_reference(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CAPTURE_REFERENCE, {}))
        response.samples = outcome.samples
        return answer(response, outcome)

    async def _identify(self, request: Any, response: Any) -> Any:
        arguments = {
            "cycle_id": request.cycle_id,
            "samples": request.samples,
            "method": request.method,
        }
        outcome = await self._ask(Command(IDENTIFY, arguments))
        response.candidate_id = outcome.calibration_id
        answer(response, outcome)
        response.success = outcome.calibration_id > 0
        return response

    async def _begin_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(BEGIN_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        return answer(response, outcome)

    async def _end_cycle(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(END_CYCLE, {"cycle_id": request.cycle_id}))
        response.cycle_id = str(outcome.command.arguments["cycle_id"])
        response.candidate_id = outcome.calibration_id
        known = outcome.calibration_id > 0
        poses = self._history.document(outcome.calibration_id).get("poses", {}) if known else {}
        response.visited = poses.get("visited", 0)
        response.missing = poses.get("missing", [])
        answer(response, outcome)
        response.success = known
        return response


# ---- set up services ----------------------------------------------------------------------------


Array = NDArray[np.float64]
MOST_POSES = 20  # a plan holds the node up for two seconds then


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


# ---- what the thermal node says: its topics, and how results get onto them ----------------------


AddOutput = Callable[[type, str, QoSProfile], Any]


class ThermalOutputs:
    """Publishers of one robot's results.

    Parameters
    ----------
    add : creates a publisher.
    serial, robot_file_hash, base_frame : as messages carry them.
    """

    def __init__(
        self,
        add: AddOutput,
        nominal: SerialArm,
        serial: str,
        robot_file_hash: str,
        base_frame: str,
    ) -> None:
        self._nominal, self._serial, self._base_frame = nominal, serial, base_frame
        self._robot_file_hash = robot_file_hash
        self._candidate = add(KinematicModel, "~/candidate", endpoints.LATCHED)
        self._model = add(KinematicModel, "~/model", endpoints.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", endpoints.LATCHED)
        self._accuracy = add(AccuracyState, "~/accuracy", endpoints.LATCHED)
        self._sensor = add(TransformStamped, "~/sensor", endpoints.LATCHED)
        self.events = SessionEvents(add)

    def model(self, model: Mapping[str, Any], revision: int, stamp_ns: int) -> None:
        """Say what is in force."""
        self._model.publish(self._message(model, revision, KinematicModel.ACCEPTED, stamp_ns))

    def candidate(self, model: Mapping[str, Any], stamp_ns: int) -> None:
        """Show what was identified."""
        self._candidate.publish(self._message(model, 0, KinematicModel.CANDIDATE, stamp_ns))

    def quality(self, outcome: Outcome, frame: str) -> None:
        """Show the verdict on a candidate, or why there is none."""
        stamp = conversions.header(outcome.command.stamp_ns or 0, frame)
        self._quality.publish(
            conversions.quality_message(
                outcome, robot=self._nominal.name, serial=self._serial, stamp=stamp
            )
        )

    def accuracy(self, found: Accuracy, tolerance_m: float, stamp_ns: int) -> None:
        """Tell the line how accurate the robot is believed to be."""
        self._accuracy.publish(
            accuracy_message(
                found,
                tolerance_m,
                robot=self._nominal.name,
                serial=self._serial,
                stamp=conversions.header(stamp_ns, self._base_frame),
            )
        )

    def sensor(self, T_base_sensor: Array, frame: str, stamp_ns: int) -> None:
        """Say where the placed sensor stands."""
        self._sensor.publish(
            TransformStamped(
                header=conversions.header(stamp_ns, self._base_frame),
                child_frame_id=frame,
                transform=conversions.transform_message(T_base_sensor),
            )
        )

    def _message(
        self, model: Mapping[str, Any], revision: int, state: int, stamp_ns: int
    ) -> KinematicModel:
        return conversions.kinematic_model(
            model,
            serial=self._serial,
            model_hash=self._nominal.model_hash,
            robot_file_hash=self._robot_file_hash,
            revision=revision,
            state=state,
            stamp=conversions.header(stamp_ns, self._base_frame),
        )


def accuracy_message(
    found: "Accuracy", tolerance_m: float, *, robot: str, serial: str, stamp: Header
) -> AccuracyState:
    """How accurate the robot is believed to be, see `Accuracy.document`."""
    told = found.document(tolerance_m)
    return AccuracyState(header=stamp, robot=robot, serial=serial, **told)
