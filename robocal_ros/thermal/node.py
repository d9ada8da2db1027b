# SPDX-License-Identifier: Apache-2.0
"""The thermal node: measurements in, judged models out, decisions kept (docs/thermal_node.md)."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PointStamped, PoseStamped, TransformStamped
from robocal_msgs.msg import AccuracyState, CalibrationQuality, KinematicModel
from robocal_msgs.srv import (
    BeginCycle,
    CalibrateSensor,
    CaptureReference,
    EndCycle,
    Identify,
    PlanPoses,
)
from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_srvs.srv import Trigger

from robocal_ros import __version__
from robocal_ros.estimation.sphere import SphereRule
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ConflictError, LimitError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import (
    DEFAULT_TARGET,
    JOINTS,
    MEASURED_POINT,
    MEASURED_POSE,
    REFERENCE_SPHERE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    TEMPERATURES,
    joint_sample,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document, random_postures
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.base import run
from robocal_ros.ros.conversions import MM, NO_POSES, joint_poses, transform_message
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError
from robocal_ros.ros.parameters import (
    ORIGIN,
    ROBOT_SETTINGS,
    STANDSTILL,
    Setting,
    advanced,
    count_fault,
    number,
    standstill_rule,
)
from robocal_ros.ros.robot import RobotNode
from robocal_ros.ros.session_node import (
    STATE_DIR,
    Ask,
    DataClock,
    DecisionServices,
    SessionEvents,
    SessionNode,
    answer,
    twin,
)
from robocal_ros.session.events import (
    BEGIN_CYCLE,
    CALIBRATE_SENSOR,
    CAPTURE_REFERENCE,
    CYCLE,
    END_CYCLE,
    IDENTIFY,
    Command,
    Outcome,
)
from robocal_ros.thermal.accuracy import Accuracy, Work
from robocal_ros.thermal.cell_setup import POSES, SensorField, placed_of, plan_cycle
from robocal_ros.thermal.drift_following import (
    ARRANGEMENTS,
    FIXED,
    FLANGE,
    METHODS,
    PRIORS,
    SPHERE_RADIUS_M,
    ThermalConfig,
)
from robocal_ros.thermal.identification import require_parameters
from robocal_ros.thermal.proposing import SENSOR
from robocal_ros.thermal.services import (
    FRAMES_OF,
    FrameShiftInterface,
    MeasuringRobotInterface,
    SensorOnTf,
)
from robocal_ros.thermal.session import ThermalSession, configuration, take_message
from robocal_ros.thermal.tracking import APPROACH_S

ACCURACY_S = 1.0
MOST_POSES = 20  # a plan holds the node up for two seconds then
INPUTS = {
    JOINTS: (JointState, endpoints.STREAM),
    MEASURED_POINT: (PointStamped, endpoints.STREAM),
    SPHERE_CENTER: (PointStamped, endpoints.STREAM),
    SPHERE_CLOUD: (PointCloud2, endpoints.STREAM),
    REFERENCE_SPHERE: (PointStamped, endpoints.STREAM),
    MEASURED_POSE: (PoseStamped, endpoints.STREAM),
    TEMPERATURES: (Temperature, endpoints.STREAM),
}


def _field_fault(field: list[float]) -> str | None:
    if len(field) != 5:
        return "five lengths are wanted"
    return None if field[3] < field[4] else "the nearest distance must be below the farthest"


SETTINGS = (
    *ROBOT_SETTINGS,
    STATE_DIR,
    Setting("measuring_frame", "", "Frame of the measurements; empty: that of the first one used"),
    Setting("target", DEFAULT_TARGET, "Target where a measurement's frame_id names none"),
    Setting(
        "arrangement",
        FIXED,
        "A fixed sensor and targets on the flange, or a sensor on the flange and spheres fixed in "
        "the cell",
        choices=ARRANGEMENTS,
    ),
    Setting("method", METHODS[0], "Estimator where a call names none", choices=METHODS),
    Setting("prior", PRIORS[0], "Expected drift: by default or as learned", choices=PRIORS),
    Setting(
        "drift_parameters",
        [""],
        "What lsq solves of a drift (a1_mm, beta2_deg, ...); empty: all, which takes many poses",
    ),
    number(
        "sigma_mm",
        0.03,
        "Standard deviation of one measured coordinate, sensor and repeatability",
        1e-4,
        10.0,
    ),
    number(
        "sphere_radius_mm",
        SPHERE_RADIUS_M * 1e3,
        "Certified radius of the sphere in sphere_cloud",
        1.0,
        200.0,
    ),
    number(
        "sensor_field_mm",
        [570.0, 430.0, 700.0, 550.0, 850.0],
        "Where the sensor measures: width, height, at what distance; nearest and farthest distance",
        1.0,
        20000.0,
        check=_field_fault,
    ),
    number(
        "tolerance_mm",
        0.3,
        "Tool error that the process allows; accuracy is judged by it",
        1e-3,
        100.0,
    ),
    number(
        "expires_after_s",
        28800.0,
        "A measurement older than this says nothing any more",
        60.0,
        7 * 86400.0,
    ),
    number(
        "work_poses_deg",
        NO_POSES,
        "Working poses at which accuracy is judged, and for which plan_poses plans, one after the "
        "other, a number for each joint (sliding joint: mm); at its default: throughout the joint "
        "limits",
        -1e5,
        1e5,
    ),
    number(
        "tip_mm",
        ORIGIN,
        "The tool's tip on the flange, which accuracy is about; at its default: the target, and "
        "the robot file's tool for plan_poses",
        -5000.0,
        5000.0,
        check=count_fault(3),
    ),
    Setting(
        "shift_frames_of",
        FRAMES_OF[0],
        "Model that the programs were made with whose frames are shifted: the nominal one, or, "
        "taught by hand, the commissioned robot's",
        choices=FRAMES_OF,
    ),
    *advanced(
        number(
            "sphere_tolerance_mm",
            0.1,
            "How far the radius of the points of a cloud may be off",
            1e-3,
            5.0,
        ),
        number(
            "sphere_noise_mm",
            0.2,
            "Largest scatter of a cloud's points about the sphere",
            1e-3,
            5.0,
        ),
        number(
            "hold_out",
            0.5,
            "Share of the poses kept to judge a calibration without a reference",
            0.1,
            0.9,
        ),
        number("seed", 0, "Which poses are held out", 0, 2**31 - 1),
        *STANDSTILL,
        number(
            "cycle_timeout_s",
            660.0,
            "A cycle ends when nothing was measured for so long; a minute longer than "
            "maintenance_node's resume_within_s",
            1.0,
            7200.0,
        ),
        number(
            "cycle_span_s",
            APPROACH_S,
            "A cycle ends when its first measurement is so old: links follow what heats them in an "
            "hour; longer than maintenance_node's cycle_within_s and a gap",
            60.0,
            86400.0,
        ),
        number(
            "lateness_s",
            0.2,
            "Commands on measurements wait for joint readings so much newer than the call",
            0.0,
            5.0,
        ),
        number(
            "command_timeout_s",
            1.0,
            "Such commands wait at most so long (wall clock), then use what is there",
            0.05,
            30.0,
        ),
    ),
)


def session_config(settings: Mapping[str, Any], arm: SerialArm) -> ThermalConfig:
    """Settings of the session, in SI."""
    poses = joint_poses(arm, settings["work_poses_deg"], "work_poses_deg").tolist()
    tip_mm = settings["tip_mm"]
    return ThermalConfig(
        method=settings["method"],
        prior=settings["prior"],
        sigma_m=settings["sigma_mm"] * MM,
        drift_parameters=tuple(settings["drift_parameters"]),
        hold_out=settings["hold_out"],
        seed=settings["seed"],
        cycle_timeout_s=settings["cycle_timeout_s"],
        cycle_span_s=settings["cycle_span_s"],
        tolerance_m=settings["tolerance_mm"] * MM,
        expires_after_s=settings["expires_after_s"],
        work_poses=tuple(tuple(pose) for pose in poses),
        tip_m=() if tip_mm == ORIGIN else tuple(value * MM for value in tip_mm),
        lateness_s=settings["lateness_s"],
        arrangement=settings["arrangement"],
        measuring_frame=settings["measuring_frame"],
        target=settings["target"],
        standstill=standstill_rule(settings),
        sphere=SphereRule(
            radius_m=settings["sphere_radius_mm"] * MM,
            radius_tolerance_m=settings["sphere_tolerance_mm"] * MM,
            noise_m=settings["sphere_noise_mm"] * MM,
        ),
    )


class ThermalServices:
    """Services, and the Trigger twins of those that need no more than a name.

    ``ask`` gives a command to the session and awaits its outcome; ``prior`` tells the expected
    drift of the session, (k, k), SI; ``work``: where the tool is to be accurate.
    """

    def __init__(
        self,
        node: RobotNode,
        ask: Ask,
        history: CalibrationHistory,
        prior: Callable[[], Array],
        work: Work,
    ) -> None:
        self._ask, self._history, self._nominal = ask, history, node.robot.arm
        self._work = work
        self._settings, self._prior, add = node.settings, prior, node.add_service
        add(CaptureReference, "~/capture_reference", self._capture_reference)
        add(Identify, "~/identify", self._identify)
        add(BeginCycle, "~/begin_cycle", self._begin_cycle)
        add(EndCycle, "~/end_cycle", self._end_cycle)
        for name in (BEGIN_CYCLE, END_CYCLE, CAPTURE_REFERENCE, IDENTIFY):
            add(Trigger, f"~/{name}_trigger", twin(ask, name, {}))
        DecisionServices(add, ask, history, THERMAL)
        add(CalibrateSensor, "~/calibrate_sensor", self._calibrate_sensor)
        add(Trigger, "~/calibrate_sensor_trigger", twin(ask, CALIBRATE_SENSOR, {}))
        add(PlanPoses, "~/plan_poses", self._plan_poses)

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

    async def _calibrate_sensor(self, request: Any, response: Any) -> Any:
        outcome = await self._ask(Command(CALIBRATE_SENSOR, {"method": request.method}))
        response.success, response.status = outcome.done, int(outcome.status)
        response.message, response.samples = outcome.message, outcome.samples
        response.calibration_id = outcome.calibration_id
        response.left_out_rms_mm = -1.0
        if outcome.document is None:
            return response
        placed = placed_of(outcome.document)
        response.sensor_base = transform_message(placed.T_sensor_base)
        sphere = placed.sphere_in_flange.tolist()
        response.sphere_in_flange = Point(**dict(zip("xyz", sphere, strict=True)))
        response.rejected = list(outcome.document["rejected"])
        if outcome.document["left_out"] is not None:
            response.left_out_rms_mm = outcome.document["left_out"]["rms_mm"]
        return response

    def _plan_poses(self, request: Any, response: Any) -> Any:
        sensor = self._history.head(SENSOR).model
        if sensor is None:
            raise ConflictError("the sensor is not placed: call calibrate_sensor first")
        if request.count > MOST_POSES:
            raise LimitError(f"{request.count} poses: at most {MOST_POSES} are planned at a time")
        names = self._nominal.joint_names
        states = [joint_sample(state) for state in request.own]
        own = np.array([state.position[state.order(names)] for state in states])
        work = self._work
        plan = plan_cycle(
            self._nominal,
            placed_of(sensor),
            SensorField(*(1e-3 * x for x in self._settings["sensor_field_mm"])),
            prior=self._prior(),
            sigma_m=self._settings["sigma_mm"] * 1e-3,
            working=random_postures(self._nominal) if work.q is None else work.q,
            tip=work.tip,
            count=request.count or POSES,
            own=own if states else None,
        )
        response.poses = [JointState(name=list(names), position=q) for q in plan.q.tolist()]
        response.predicted_mm = plan.predicted_rms_m * 1e3
        response.random_mm, response.before_mm = plan.random_rms_m * 1e3, plan.before_rms_m * 1e3
        response.own_mm = -1.0 if plan.own_rms_m is None else plan.own_rms_m * 1e3
        response.success, response.status = True, int(Code.ACCEPT)
        response.message = (
            f"{len(plan.q)} poses: {response.predicted_mm:.3f} mm rms expected after one cycle, "
            f"{response.random_mm:.3f} mm with random ones"
        )
        return response


class ThermalOutputs:
    """Publishers of one robot's results; ``serial``: of the robot, as it is in use."""

    def __init__(self, node: RobotNode, serial: str) -> None:
        self._robot, self._serial, add = node.robot, serial, node.add_output
        self._base_frame = node.settings["base_frame"]
        self._candidate = add(KinematicModel, "~/candidate", endpoints.LATCHED)
        self._model = add(KinematicModel, "~/model", endpoints.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", endpoints.LATCHED)
        self._accuracy = add(AccuracyState, "~/accuracy", endpoints.LATCHED)
        self._sensor = add(TransformStamped, "~/sensor", endpoints.LATCHED)
        self.events = SessionEvents(add)

    def model(self, model: Mapping[str, Any], revision: int | None, stamp_ns: int) -> None:
        """Say what is in force; a candidate has no revision."""
        candidate = revision is None
        message = conversions.kinematic_model(
            model,
            serial=self._serial,
            model_hash=self._robot.arm.model_hash,
            robot_file_hash=self._robot.file_hash,
            revision=revision or 0,
            state=KinematicModel.CANDIDATE if candidate else KinematicModel.ACCEPTED,
            stamp=conversions.header(stamp_ns, self._base_frame),
        )
        (self._candidate if candidate else self._model).publish(message)

    def quality(self, outcome: Outcome, frame: str) -> None:
        """Show the verdict on a candidate, or why there is none."""
        stamp = conversions.header(outcome.command.stamp_ns or 0, frame)
        self._quality.publish(
            conversions.quality_message(
                outcome, robot=self._robot.arm.name, serial=self._serial, stamp=stamp
            )
        )

    def accuracy(self, found: Accuracy, tolerance_m: float, stamp_ns: int) -> None:
        """Tell the line how accurate the robot is believed to be."""
        self._accuracy.publish(
            AccuracyState(
                header=conversions.header(stamp_ns, self._base_frame),
                robot=self._robot.arm.name,
                serial=self._serial,
                **found.document(tolerance_m),
            )
        )

    def sensor(self, T_base_sensor: Array, frame: str, stamp_ns: int) -> TransformStamped:
        """Say where the placed sensor stands; what was said."""
        message = TransformStamped(
            header=conversions.header(stamp_ns, self._base_frame),
            child_frame_id=frame,
            transform=conversions.transform_message(T_base_sensor),
        )
        self._sensor.publish(message)
        return message


class ThermalNode(SessionNode[ThermalSession]):
    """Drives a `ThermalSession` with live messages and calls."""

    NAME = "thermal_node"
    SETTINGS = SETTINGS
    INPUTS = INPUTS

    def configure(self) -> None:
        """Open the history, then the topics and services."""
        super().configure()
        settings = self.settings
        require_parameters(self._nominal, settings["drift_parameters"])
        self._config = session_config(settings, self._nominal)
        history = self.open_session(settings["command_timeout_s"])
        self._outputs = ThermalOutputs(self, self._serial_in_use)
        self._on_tf = SensorOnTf(self)
        self._data_clock = DataClock()
        ThermalServices(self, self._desk.ask, history, self._prior, self._config.work)
        T_flange_tool, tip_m = self._nominal.T_flange_tool.copy(), self._config.tip_m
        if tip_m:
            T_flange_tool[:3, 3] = tip_m
        work = np.array(self._config.work_poses).reshape(-1, self._nominal.n)
        self._shifts = FrameShiftInterface(
            self, history, lambda: self._session, work, T_flange_tool
        )
        self._measuring: MeasuringRobotInterface | None = None
        if self._config.arrangement == FLANGE:
            self._measuring = MeasuringRobotInterface(self, lambda: self._session)
        self.add_timer(ACCURACY_S, self._show_accuracy, steady=True)

    def new_session(self, history: CalibrationHistory) -> ThermalSession:
        """The session of an active node."""
        return ThermalSession(self._nominal, history, self._config, __version__)

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        super().activate()
        self._shown: tuple[Any, ...] = ()
        self._shifts.look(again=True)
        self.show_in_force()

    def deactivate(self) -> None:
        """End the session."""
        self._on_tf.close()
        super().deactivate()

    def take(self, session: ThermalSession, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to the session."""
        take_message(session, kind, message)
        if self._measuring is not None and kind == JOINTS:
            self._measuring.joints_came(session)
        if session.waiting:
            self._desk.step()

    def _prior(self) -> Array:
        if self._session is None:
            raise NotActiveError("no session: activate the node")
        return self._session.expected_drift()

    def polled(self, session: ThermalSession) -> None:
        """End a cycle that is overdue; look at who else puts the sensor's frame onto tf."""
        self._shifts.look()
        self._on_tf.poll()
        if (command := session.overdue()) is not None:
            self.get_logger().info(f"the measuring cycle ends: {command.arguments['reason']}")
            self._desk.ask(command)

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        try:
            if not outcome.repeated:
                self._outputs.events.tell(outcome.command, outcome)
                history, session = self._history, self._session
                if outcome.command.name in CYCLE and session is not None and history is not None:
                    self._outputs.quality(outcome, session.desk.frame or "")
                    if outcome.calibration_id:
                        model = history.model(outcome.calibration_id)
                        self._outputs.model(model, None, outcome.command.stamp_ns or 0)
            self.show_in_force()
        except (RobocalError, ValueError) as error:  # what is done stays done
            self.get_logger().error(f"{outcome.command.name} was done but not published: {error}")

    def show_in_force(self) -> None:
        """Publish the model in force and record the new state, when either changed."""
        session, history = self._session, self._history
        if session is None or history is None:
            return
        head, follower = session.in_force, session.follower
        cycles = 0 if follower is None else follower.state.cycles
        sensor = history.head(SENSOR)
        shown = (head.revision, session.current.reference_id, cycles, sensor.revision)
        if self._shown == shown and not self._outputs.events.need_configuration:
            return
        if self._shown[:1] != shown[:1]:
            stamp = history.get(head.calibration_id).stamp_ns if head.calibration_id else 0
            model = model_document(self._nominal) if head.model is None else head.model
            self._outputs.model(model, head.revision, stamp)
        if sensor.model is not None and sensor.calibration_id and self._shown[3:] != shown[3:]:
            T_base_sensor = frames.invert(placed_of(sensor.model).T_sensor_base)
            stamp = history.get(sensor.calibration_id).stamp_ns
            shown_as = self._outputs.sensor(T_base_sensor, sensor.model["frame"], stamp)
            self._on_tf.show(shown_as, T_base_sensor)
        self._shown = shown
        self._outputs.events.tell(configuration(session, self._topics), None)

    def _show_accuracy(self) -> None:
        if self._session is None:
            return
        stamp_ns = self._stamp_ns(self._session)
        found = self._session.accuracy(stamp_ns)
        self._outputs.accuracy(found, self._session.config.tolerance_m, stamp_ns)

    def _stamp_ns(self, session: ThermalSession) -> int:
        """Now, on the samples' clock."""
        return self._data_clock.at(session.desk.newest_ns.get(JOINTS), self.now_ns())

    def report(self, session: ThermalSession, history: CalibrationHistory, health: Health) -> None:
        """Tell what waits, how far the cycle is, and what was lost."""
        values = health.values
        try:
            pending = [entry.id for entry in history.pending()]
            values["pending candidates"] = ", ".join(map(str, pending)) or "none"
            if unread := session.unread_motors(self._stamp_ns(session)):
                health.worsen(WARN, unread)
        except RobocalError as error:
            health.worsen(ERROR, str(error))
        values["cold reference"] = "captured" if session.current.reference_id else "none"
        visited, poses = session.windows.progress()
        named = f"'{session.cycle.id}' open, " if session.cycle.id else ""
        values["cycle"] = f"{named}{visited} of {poses} poses measured"
        values["joint gaps"] = session.desk.stream.gap_count
        if taken := self._on_tf.fault():
            health.worsen(WARN, taken)


def main() -> None:
    """Run the node."""
    run(ThermalNode)
