# SPDX-License-Identifier: Apache-2.0
"""What the tool node publishes, and the motions that it drives itself."""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, Quaternion, TransformStamped
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import CalibrationQuality, MaintenanceStatus, ToolFrame, ToolStep
from std_srvs.srv import SetBool

from robocal_ros.ground import frames
from robocal_ros.ground.errors import ConflictError, InputError
from robocal_ros.ground.frames import Document
from robocal_ros.ground.samples import joint_sample
from robocal_ros.kinematics.robots import RobotDescription
from robocal_ros.motion.driver import (
    CONTROLLER,
    MOTION,
    LeaseHolder,
    MotionDriver,
    driving_config,
    goal_tolerances,
    require_limits,
)
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import BEHIND_S, Gap, MotionReport
from robocal_ros.motion.stopping import SteadyClock
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.conversions import NS, StaticTf, header, pose_message, transform_message
from robocal_ros.ros.endpoints import NotActiveError
from robocal_ros.ros.graph import GAP_BOOL, SHORTEST_STALE_S, STATUS, CommandPath, GapSources
from robocal_ros.ros.parameters import number
from robocal_ros.ros.robot import RobotNode
from robocal_ros.ros.session_node import SessionEvents
from robocal_ros.session.events import Command, Outcome
from robocal_ros.tool.driving import ToolDriver
from robocal_ros.tool.edges import RESTORE
from robocal_ros.tool.judging import KnownTool
from robocal_ros.tool.run import PlannedStep
from robocal_ros.tool.session import (
    FULL,
    LASER,
    QUICK,
    REFERENCE,
    WITNESS,
    WITNESS_REFERENCE,
    ToolSession,
)
from robocal_ros.tool.station import measurement_of

MODES = {
    MeasureTool.Goal.FULL: FULL,
    MeasureTool.Goal.QUICK: QUICK,
    MeasureTool.Goal.REFERENCE: REFERENCE,
    MeasureTool.Goal.WITNESS: WITNESS,
    MeasureTool.Goal.WITNESS_REFERENCE: WITNESS_REFERENCE,
    MeasureTool.Goal.LASER_FRAME: LASER,
}
ANSWERS = {
    "pass": MeasureTool.Result.PASS,
    "recalibrate": MeasureTool.Result.RECALIBRATE,
    "cannot tell": MeasureTool.Result.CANNOT_TELL,
}


KINDS = {"circle": ToolStep.CIRCLE, "plunge": ToolStep.PLUNGE}


def step_message(step: PlannedStep, run: int, stamp_ns: int, frame: str) -> ToolStep:
    """A step that is awaited."""
    turn = frames.quat_xyzw(frames.transform(step.R_base_laser, np.zeros(3))).tolist()
    return ToolStep(
        header=header(stamp_ns, frame),
        run=run,
        number=step.number,
        of=step.of,
        kind=KINDS[step.kind],
        name=step.name,
        flange=pose_message(step.T_base_flange),
        laser=Quaternion(**dict(zip("xyzw", turn, strict=True))),
        radius=step.radius_m,
        speed=step.speed_m_s,
        direction=step.direction,
        start_angle=step.start_rad,
        depth=step.depth_m,
        text=step_words(step),
    )


def step_words(step: PlannedStep) -> str:
    """A step for a person who drives the robot."""
    where = ", ".join(f"{1e3 * x:.2f}" for x in step.T_base_flange[:3, 3])
    place = f"step {step.number} of {step.of}, {step.name}: flange at ({where}) mm"
    speed = f"{step.speed_m_s * 1e3:.0f} mm/s"
    if step.kind == "plunge":
        return f"{place}, down by {step.depth_m * 1e3:.1f} mm and up again at {speed}"
    way = "counter-clockwise" if step.direction > 0 else "clockwise"
    return f"{place}, once round it {way} at {step.radius_m * 1e3:.1f} mm and {speed}"


@dataclass(frozen=True)
class ToolMessages:
    """Tools of one robot as messages; ``flange``, ``tool``: names of the frames."""

    robot: RobotDescription
    serial: str
    flange: str
    tool: str

    def frame(
        self, known: KnownTool, revision: int, thermal_revision: int, state: int, stamp_ns: int
    ) -> ToolFrame:
        """A tool with where it comes from."""
        flat = np.zeros(0) if known.covariance is None else known.covariance.ravel()
        return ToolFrame(
            header=header(stamp_ns, self.flange),
            child_frame_id=self.tool,
            robot=self.robot.arm.name,
            serial=self.serial,
            model_hash=self.robot.arm.model_hash,
            robot_file_hash=self.robot.file_hash,
            revision=revision,
            thermal_revision=thermal_revision,
            tool=transform_message(known.T_flange_tool),
            covariance=flat.tolist(),
            state=state,
        )


class TcfOutputs:
    """Publishers of one tool's results; ``serial``: of the robot, as it is in use.

    ``missing``: what cannot be published on this machine; empty when everything can.
    """

    def __init__(self, node: RobotNode, serial: str) -> None:
        add, names = node.add_output, node.settings
        self._base, self._robot, self._serial = names["base_frame"], node.robot.arm.name, serial
        self._messages = ToolMessages(
            node.robot, serial, names["flange_frame"], names["tool_frame"]
        )
        self._step = add(ToolStep, "~/next_step", endpoints.LATCHED)
        self._candidate = add(ToolFrame, "~/candidate", endpoints.LATCHED)
        self._tool = add(ToolFrame, "~/tool", endpoints.LATCHED)
        self._frame = add(TransformStamped, "~/tool_frame", endpoints.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", endpoints.LATCHED)
        self._laser = add(PoseWithCovarianceStamped, "~/laser_frame", endpoints.LATCHED)
        self.events = SessionEvents(add)
        self._tf = StaticTf(add)
        self.missing = self._tf.missing

    def step(self, step: PlannedStep | None, run: int, stamp_ns: int) -> ToolStep:
        """Say what is awaited; None: nothing is."""
        stamp = conversions.header(stamp_ns, self._base)
        message = (
            ToolStep(header=stamp, run=run)
            if step is None
            else step_message(step, run, stamp_ns, self._base)
        )
        self._step.publish(message)
        return message

    def tool(
        self, known: KnownTool, revision: int, thermal: int, stamp_ns: int, *, taught: bool
    ) -> None:
        """Say what is in force; ``taught``: it is the taught tool, whatever the revision."""
        state = ToolFrame.NONE if taught or not revision else ToolFrame.ACCEPTED
        message = self._messages.frame(known, revision, thermal, state, stamp_ns)
        self._tool.publish(message)
        transform = TransformStamped(
            header=message.header, child_frame_id=message.child_frame_id, transform=message.tool
        )
        self._frame.publish(transform)
        self._tf.publish([transform])

    def frame(self, model: Document, stamp_ns: int) -> ToolFrame:
        """A measured tool."""
        known, thermal = KnownTool.of_document(model), int(model["thermal_revision"])
        return self._messages.frame(known, 0, thermal, ToolFrame.CANDIDATE, stamp_ns)

    def candidate(self, model: Document, stamp_ns: int) -> None:
        """Show what was measured."""
        self._candidate.publish(self.frame(model, stamp_ns))

    def laser(self, model: Document, stamp_ns: int) -> None:
        """Show where the beams were found."""
        found = measurement_of(model)
        message = PoseWithCovarianceStamped(header=conversions.header(stamp_ns, self._base))
        message.pose.pose = pose_message(found.laser.T_base_laser)
        message.pose.covariance = found.frame_covariance.ravel()
        self._laser.publish(message)

    def quality(self, outcome: Outcome, cycle_id: str) -> None:
        """Show the verdict on a run, or on what touches or sweeps gave."""
        document = outcome.document or {}
        message = conversions.verdict_message(
            outcome,
            robot=self._robot,
            serial=self._serial,
            stamp=conversions.header(outcome.command.stamp_ns or 0, self._base),
            cycle_id=cycle_id,
        )
        if "misfit_mm" in document:
            message.candidate_rms_mm = float(document["misfit_mm"])
        if "sigma_mm" in document:
            message.predicted_rms_mm = float(np.max(document["sigma_mm"]))
        self._quality.publish(message)


TICK_S = 0.01
LOOK_S = 0.5
# What maintenance_node and joint_correction_node publish, who command the robot too.
CELL = "accuracy_state", STATUS, "joint_correction_node/status"
MOTION_SETTINGS = (
    *MOTION,
    *CONTROLLER,
    number("plunge_limit_mm", 20.0, "No plunge is deeper", 1.0, 100.0),
    number(
        "gap_stale_s",
        0.5,
        "Nothing moves unless gap_open is true, and neither it nor the beat that it echoes older; "
        "0: it is not listened to, and maintenance_node does not measure with it",
        0.0,
        0.5,
        check=lambda stale_s: (
            f"0, or {SHORTEST_STALE_S:g} s at least" if 0.0 < stale_s < SHORTEST_STALE_S else None
        ),
    ),
    GAP_BOOL,
)
UNHEARD = "gap_open is not listened to: gap_stale_s is 0"


class TcfMotion:
    """``~/arm``, the robot's controller, and ``gap_open`` where it is listened to.

    ``ask``: gives a command to the session. ``serial``: of the robot, as it is in use.
    """

    def __init__(self, node: RobotNode, ask: Callable[[Command], object], serial: str) -> None:
        self._node, self._ask = node, ask
        settings, arm = node.settings, node.robot.arm
        self._config = driving_config(
            settings,
            plunge_speed_m_s=settings["plunge_speed_mm_s"] * 1e-3,
            plunge_depth_m=settings["plunge_limit_mm"] * 1e-3,
        )
        self._names = arm.joint_names
        self.driver: ToolDriver | None = None
        self._steady = SteadyClock(self._slept)
        self._motion = MotionDriver(
            node,
            arm.joint_names,
            settings["follow_joint_trajectory"],
            settings["hard_stop_service"],
            goal_tolerances(arm, self._config),
            self._reported,
            lambda: None if self.driver is None else self.driver.robot,
            self._steady.now_s,
        )
        self._lease = LeaseHolder(node, arm.name, serial)
        self._others = CommandPath(
            node, self._motion.topic.topic_name, CELL, other_robot=lambda: node.robot_fault
        )
        self._gap = Gap(stale_s) if (stale_s := settings["gap_stale_s"]) > 0.0 else None
        if self._gap is not None:
            is_bool = settings["gap_bool"]
            self._sources = GapSources(node, is_bool, self._take_gap)
            if not is_bool:
                # Not latched: a beat of before is not taken for one of now.
                node.add_input(MaintenanceStatus, STATUS, self._take_beat, endpoints.RELIABLE)
        else:
            node.get_logger().warning(self.deaf())
        node.add_service(SetBool, "~/arm", self._arm, inactive=True)
        node.add_timer(TICK_S, self._tick, steady=True)

    def activate(self, session: ToolSession) -> None:
        """Begin, disarmed."""
        require_limits(session.nominal, self._config)
        self._looked_s = -math.inf
        self.driver = ToolDriver(
            session, self._config, self._send, self._ask, self._closed, self._motion.hard_stop
        )

    def deactivate(self) -> None:
        """Stop what moves."""
        if self.driver is not None:
            self.driver.disarm("the node was deactivated", self._steady.now_s())
            if self._motion.see_through(self._stops):
                self._lease.hold("")
            else:
                self._lease.lapse()
        self.driver = None

    def _stops(self) -> bool:
        self._tick()
        return self.driver is not None and self.driver.moves

    def close(self) -> None:
        """Take the controller's client down."""
        self._motion.close()

    def take(self, message: Any) -> None:
        """Take a JointState before the session does: what is odd stops the robot first."""
        if self.driver is None:
            return
        late_s = self._motion.hear(message)
        try:
            sample = joint_sample(message)
            q = sample.position[sample.order(self._names)]
        except InputError:  # the session counts it; without readings the robot stops
            return
        self.driver.reading(sample.stamp_ns / NS, q, self._steady.now_s(), late_s)

    @property
    def behind(self) -> bool:
        """Whether the newest reading of the joints came late: others wait."""
        return self._motion.lateness.late_s > BEHIND_S

    def beam(self, message: Any) -> None:
        """Take a BeamEvent, usable or not: on its way the tool breaks no beam."""
        if self.driver is not None:
            self.driver.beam(message.edge != RESTORE)

    def require_ready(self) -> None:
        """Refuse a run while nothing may move."""
        if self.driver is None:
            raise NotActiveError("no session: activate the node")
        self.driver.require_ready()

    def deaf(self) -> str:
        """Why what moves would go on in a closed gap; empty: it would stop."""
        if self._gap is not None:
            return ""
        return f"{UNHEARD}; set it to 0.5 in a cell with maintenance_node"

    def words(self) -> str:
        """What the diagnostics say."""
        if self.driver is None:
            return "inactive"
        way = f"; motions go on {self._motion.way}" if self._motion.way else ""
        return self.driver.words() + way

    def trouble(self) -> str:
        """What is to be warned of; empty: nothing."""
        if self.driver is None:
            return ""
        trouble = self.driver.trouble(self._steady.now_s()) or self._motion.late()
        return "; ".join(filter(None, (trouble, self._motion.hard_stop.absent)))

    @property
    def fault(self) -> str:
        """Who else commands the robot, so that this node does not; empty: nobody."""
        return self._others.violation

    def on_its_way(self) -> bool:
        """Whether a step is being driven: a robot that rests then only pauses."""
        return self.driver is not None and self.driver.on_its_way(self._steady.now_s())

    def run_ended(self, outcome: Outcome) -> None:
        """A run without a result stops the robot."""
        if self.driver is not None and outcome.document is None:
            self.driver.run_failed(outcome.message, self._steady.now_s())

    def _take_beat(self, message: Any) -> None:
        if self._gap is not None:
            self._gap.saw(message.beat, self._steady.now_s())

    def _take_gap(self, is_open: bool, echo: int | None) -> None:
        if self._gap is not None:
            self._gap.doubt(self._sources.doubt())
            self._gap.heard(is_open, echo, self._steady.now_s())
            self._tick()

    def _slept(self, for_s: float) -> None:
        if self.driver is not None:
            self.driver.slept(for_s)

    def _closed(self, now_s: float) -> str:
        """Why nothing may move, where somebody says so; a pause of this process is looked for."""
        if self._gap is not None:
            self._gap.look(now_s)
            if why := self._gap.closed(now_s):
                return why
        return self._others.violation

    def _look(self, driver: ToolDriver) -> None:
        """Look for the controller's action, and who else commands the robot."""
        if not driver.moves:
            self._motion.look()
        self._others.look(self._motion.action)

    def _tick(self) -> None:
        now_s = self._steady.now_s()
        if self._gap is not None:
            self._gap.look(now_s)
        if self.driver is not None:
            if now_s >= self._looked_s + LOOK_S:
                self._looked_s = now_s
                self._look(self.driver)
            self.driver.tick(now_s)
            self._lease.hold(f"tool: {self.driver.words()}" if self.driver.moves else "")

    def _reported(self, report: MotionReport) -> None:
        if self.driver is not None:
            self.driver.reported(report, self._steady.now_s())

    def _arm(self, request: Any, response: Any) -> Any:
        if self.driver is None:
            if request.data:
                raise NotActiveError(f"the node is {self._node.state}: activate it to arm")
            # deactivation disarmed; who must know that nothing moves gets a plain answer
            response.success, response.message = True, "disarmed: the node is not active"
            return response
        now_s = self._steady.now_s()
        if request.data:
            self._look(self.driver)
            self.driver.arm(now_s)
        else:
            self.driver.disarm("disarmed by a call", now_s)
        response.success = True
        response.message = "disarmed"
        if request.data:
            words = f"armed: begin the measurement within {self._config.armed_s:g} s"
            response.message = words if self._gap is not None else f"{words}; {UNHEARD}"
        self._node.get_logger().warning(f"arm {request.data}: {response.message}")
        return response

    def _send(self, plan: JointPlan, stop: bool) -> float:
        if not stop and (why := self._others.look(self._motion.look())):
            raise ConflictError(why)  # at which the driver stops and disarms
        sent_s = self._steady.now_s()  # not after it: a robot ahead of its plan is off it
        self._motion.send(plan, stop=stop)
        return sent_s
