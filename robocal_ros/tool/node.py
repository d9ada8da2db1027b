# SPDX-License-Identifier: Apache-2.0
"""The tool node: parameters, services and the action, each call a command to the session."""

import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.task import Future
from robocal_msgs.action import MeasureTool
from robocal_msgs.msg import BeamEvent, ToolFrame, ToolStep
from sensor_msgs.msg import JointState
from std_srvs.srv import Trigger

from robocal_ros import __version__
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.samples import JOINTS, Silence
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import TOOL
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import run
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError, trigger_text
from robocal_ros.ros.parameters import (
    ROBOT_SETTINGS,
    Setting,
    advanced,
    given_pose,
    number,
    pose_settings,
)
from robocal_ros.ros.session_node import (
    JOINT_ERROR,
    STATE_DIR,
    DecisionServices,
    SessionNode,
    trigger_answer,
    twin,
)
from robocal_ros.session.events import (
    BREAK_OFF,
    CLEAR_SWEEPS,
    CLEAR_TOUCHES,
    MEASURE_TOOL,
    SOLVE_SWEEPS,
    SOLVE_TOUCHES,
    SWEEP,
    TOOL_STEP,
    TOUCH,
    Command,
    Outcome,
)
from robocal_ros.tool.crossed_model import RobotNoise
from robocal_ros.tool.driving import load_measuring
from robocal_ros.tool.edges import BEAMS, EDGES, InputRule, ParallelStation
from robocal_ros.tool.judging import CheckRule, ToolLimits
from robocal_ros.tool.laser_frame import LaserFrame, read_laser_for
from robocal_ros.tool.run import MeasuringMotion, PlannedStep, ToolConfig, TraitLimits, rows_of
from robocal_ros.tool.services import ANSWERS, MODES, MOTION_SETTINGS, TcfMotion, TcfOutputs
from robocal_ros.tool.session import (
    FULL,
    LASER,
    QUICK,
    REFERENCE,
    ToolSession,
    configuration,
    take_tool_message,
)

PROGRAM, TRAJECTORY = "program", "trajectory"
BY_TOUCHES = (TOUCH, SOLVE_TOUCHES, CLEAR_TOUCHES)
BY_SWEEPS = (SWEEP, SOLVE_SWEEPS, CLEAR_SWEEPS)


SETTINGS = (
    *ROBOT_SETTINGS,
    STATE_DIR,
    *pose_settings(
        "taught",
        "Taught tool in the flange frame; as the quaternion at its default: the robot file's",
        "Its orientation: z from flange to tip",
    ),
    Setting(
        "laser",
        "",
        "Laser file of the station of crossed beams, as 'robocal tool beams' writes it; empty: "
        "there are parallel ones alone",
    ),
    Setting("tool_frame", "tool", "Name of the tool frame, a child of the flange's"),
    Setting("beams", ["x", "y"], "Names of the x- and the y-beam in beam_events"),
    Setting(
        "parallel_beams", ["up", "down"], "Names of the upper and the lower of two parallel beams"
    ),
    number("parallel_up_mm", 0.0, "Height of the upper one, base; 0 as the other: none", -5e3, 5e3),
    number("parallel_down_mm", 0.0, "Height of the lower one", -5e3, 5e3),
    number("parallel_x_mm", 0.0, "Place of both along the base's x", -5e3, 5e3),
    Setting(
        "motion",
        PROGRAM,
        "Who moves: the robot's program, or this node",
        choices=(PROGRAM, TRAJECTORY),
    ),
    number("input_period_ms", 0.0, "How often the input is read; 0: by interrupt", 0.0, 100.0),
    number("input_jitter_ms", 0.02, "Scatter of an edge's stamp", 1e-4, 10.0),
    number(
        "debounce_ms",
        1e3 * InputRule.debounce_s,
        "Edges nearer than this are one contact",
        0.0,
        20.0,
    ),
    number("repeatability_mm", 0.03, "Scatter of a motion in each axis", 0.0, 2.0),
    number("edge_noise_mm", 0.01, "Further scatter of the robot at each edge", 0.0, 2.0),
    number(
        "circle_radius_mm", 12.0, "Radius of the circles; wider than the largest bend", 2.0, 100.0
    ),
    number("circle_speed_mm_s", 50.0, "Speed on the circles", 0.1, 250.0),
    number("circle_height_mm", 50.0, "Between both circles that give the axis", 5.0, 300.0),
    number(
        "above_tip_mm",
        5.0,
        "Height above the tip at which the lower circles are driven",
        0.5,
        100.0,
    ),
    number("plunge_depth_mm", 7.0, "Depth of a plunge, half of it below the beams", 1.0, 50.0),
    number("plunge_speed_mm_s", 10.0, "Speed of a plunge", 0.1, 50.0),
    number("spin_deg", 0.0, "Turn of the flange about the laser's z", -360.0, 360.0),
    JOINT_ERROR,
    number("taper", 0.0, "Growth of the tool's radius per length above the tip", -2.0, 2.0),
    number("quick_limit_mm", 0.2, "Deviation of the tip that a quick check passes", 0.01, 10.0),
    number("lever_mm", 150.0, "From where a bent tool bends to its tip", 1.0, 2000.0),
    number("sigma_limit_mm", 0.2, "A tip that is known less well is refused", 0.01, 10.0),
    number(
        "change_limit_mm",
        10.0,
        "Largest change of the tip from the taught one; no more than joint_correction_node's "
        "tool_tcp_mm",
        0.1,
        100.0,
    ),
    number(
        "tilt_limit_deg",
        4.0,
        "Largest change of the axis; no more than its tool_tcp_deg",
        0.1,
        45.0,
    ),
    *advanced(
        number(
            "trait_radius_mm",
            0.05,
            "Change of the tool's radius that is no fault yet; 0: any",
            0.0,
            5.0,
        ),
        number(
            "trait_latency_ms",
            5.0,
            "Change of the edges' delay that is no fault yet; 0: any",
            0.0,
            1000.0,
        ),
        number(
            "trait_lost", 0.05, "Share of the joint readings that may be lost; 0: any", 0.0, 1.0
        ),
        number(
            "step_timeout_s", 30.0, "A run ends when a step has no edge for so long", 1.0, 3600.0
        ),
        number(
            "joint_silence_s",
            0.5,
            "A run ends when joint states are silent for so long",
            0.02,
            10.0,
        ),
    ),
)


def taught_tool(settings: Mapping[str, Any], nominal: SerialArm) -> NDArray[np.float64]:
    """T_flange_tool (4, 4) as taught: by the parameters, else by the robot file."""
    given = given_pose(settings, "taught")
    return nominal.T_flange_tool if given is None else given


def parallel_station(settings: Mapping[str, Any]) -> ParallelStation | None:
    """Two parallel beams; None where both heights are 0.

    Raises `InputError` when they are not named as two beams; `RankDeficientError` when they are too
    near each other.
    """
    up, down, x = (1e-3 * settings[f"parallel_{key}_mm"] for key in ("up", "down", "x"))
    if up == down == 0.0:
        return None
    return ParallelStation(up, down, x, two_names(settings, "parallel_beams"))


def two_names(settings: Mapping[str, Any], parameter: str) -> tuple[str, str]:
    """Names of two beams. Raises `InputError` where they are not two."""
    names = settings[parameter]
    if len(names) != 2 or names[0] == names[1]:
        raise InputError(f"{parameter} {names}: two names are wanted, one of each beam")
    return names[0], names[1]


def session_config(
    settings: Mapping[str, Any],
    laser: LaserFrame | None,
    station: str,
    taught: NDArray[np.float64],
) -> ToolConfig:
    """Settings of the session, in SI; ``laser`` None: there are parallel beams alone.

    Raises as `parallel_station`; `InputError` when beams that there are share a name.
    """
    reach = np.zeros(2) if laser is None else laser.reach
    parallel = parallel_station(settings)
    beams = BEAMS if laser is None else two_names(settings, "beams")
    if laser is not None and parallel is not None and {*beams} & {*parallel.names}:
        raise InputError(f"beams {beams} and parallel_beams {parallel.names}: a name of each beam")
    return ToolConfig(
        points_m=() if laser is None else rows_of(laser.points),
        parallel=parallel,
        taught=rows_of(taught),
        mandrel=None if (T := given_pose(settings, "mandrel")) is None else rows_of(T),
        laser_sigma_m=0.0 if laser is None else laser.sigma_m,
        reach_m=(float(reach[0]), float(reach[1])),
        station=station,
        beams=beams,
        mandrel_radius_m=settings["mandrel_radius_mm"] * 1e-3,
        taper=settings["taper"],
        spin_rad=float(np.radians(settings["spin_deg"])),
        step_timeout_s=settings["step_timeout_s"],
        joint_error_rad=settings["joint_error_urad"] * 1e-6,
        motion=MeasuringMotion(
            radius_m=settings["circle_radius_mm"] * 1e-3,
            speed_m_s=settings["circle_speed_mm_s"] * 1e-3,
            height_m=settings["circle_height_mm"] * 1e-3,
            above_tip_m=settings["above_tip_mm"] * 1e-3,
            plunge_depth_m=settings["plunge_depth_mm"] * 1e-3,
            plunge_speed_m_s=settings["plunge_speed_mm_s"] * 1e-3,
        ),
        input=InputRule(
            jitter_s=settings["input_jitter_ms"] * 1e-3,
            sample_period_s=settings["input_period_ms"] * 1e-3,
            debounce_s=settings["debounce_ms"] * 1e-3,
        ),
        noise=RobotNoise(settings["repeatability_mm"] * 1e-3, settings["edge_noise_mm"] * 1e-3),
        check=CheckRule(settings["quick_limit_mm"] * 1e-3, settings["lever_mm"] * 1e-3),
        limits=ToolLimits(
            settings["sigma_limit_mm"] * 1e-3,
            settings["change_limit_mm"] * 1e-3,
            float(np.radians(settings["tilt_limit_deg"])),
        ),
        traits=TraitLimits(
            settings["trait_radius_mm"] * 1e-3,
            settings["trait_latency_ms"] * 1e-3,
            settings["trait_lost"],
        ),
    )


class TcfServices:
    """``~/measure`` as action, the same as Triggers, and the decisions."""

    def __init__(self, node: "TcfNode", ask: Any, history: CalibrationHistory) -> None:
        self._node = node
        self._goal: ServerGoalHandle | None = None
        add = node.add_service
        add(Trigger, "~/measure_trigger", self._starter(FULL))
        add(Trigger, "~/quick_check_trigger", self._starter(QUICK))
        add(Trigger, "~/measure_reference_trigger", self._starter(REFERENCE))
        add(Trigger, "~/laser_frame_trigger", self._starter(LASER))
        for name in (*BY_TOUCHES, *BY_SWEEPS):
            add(Trigger, f"~/{name}_trigger", twin(ask, name, {}))
        add(Trigger, "~/cancel_trigger", self._cancel_twin)
        add(Trigger, "~/result_trigger", self._result)
        DecisionServices(add, ask, history, TOOL)
        self._server = ActionServer(
            node,
            MeasureTool,
            "~/measure",
            self._execute,
            cancel_callback=self._cancel,
            callback_group=node.async_group,
        )

    def close(self) -> None:
        """Take the action down."""
        self._server.destroy()

    def feedback(self, step: ToolStep, state: str) -> None:
        """Tell a waiting caller what goes on."""
        if self._goal is not None and self._goal.is_active:
            self._goal.publish_feedback(MeasureTool.Feedback(step=step, state=state))

    async def _execute(self, goal: ServerGoalHandle) -> Any:
        request = goal.request
        try:
            if not self._node.is_active:
                return self._end(goal, Code.CONFLICT, f"the node is {self._node.state}")
            if request.mode not in MODES:
                words = f"mode {request.mode} is none of {', '.join(MODES.values())}"
                return self._end(goal, Code.BAD_INPUT, words)
            if request.only_in_gap and (why := self._node.deaf()):
                return self._end(goal, Code.CONFLICT, f"{self._node.get_name()}: {why}")
            outcome = await self._node.begin(MODES[request.mode], request.cycle_id, "action")
            if outcome.done and not outcome.repeated:
                self._goal = goal
                self.feedback(self._node.step, outcome.message)
                outcome = await self._node.run_end
        except RobocalError as error:
            return self._end(goal, error.code, str(error))
        finally:
            if self._goal is goal:
                self._goal = None
        return self._end(goal, outcome.status, outcome.message, outcome)

    def _end(
        self, goal: ServerGoalHandle, code: Code, message: str, outcome: Outcome | None = None
    ) -> Any:
        document = None if outcome is None else outcome.document
        result = MeasureTool.Result(success=document is not None, message=message, status=int(code))
        result.left_plan = outcome is not None and outcome.left_plan
        if outcome is not None and document is not None:
            result.candidate_id = outcome.calibration_id
            change = document.get("change", {})
            sigma = document["sigma_mm"]
            result.answer = ANSWERS.get(document.get("answer", ""), MeasureTool.Result.NONE)
            result.deviation_mm = float(change.get("tip_mm", 0.0))
            result.deviation_deg = float(change.get("axis_deg", 0.0))
            result.sigma_mm = float(np.max(sigma))
            if outcome.calibration_id:
                result.tool = self._node.frame(outcome)
        if goal.is_cancel_requested:
            goal.canceled()
        elif result.success:
            goal.succeed()
        else:
            goal.abort()
        return result

    async def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        if goal is not self._goal:
            return CancelResponse.REJECT
        await self._node.break_off(Code.CONFLICT, "cancelled by the caller")
        return CancelResponse.ACCEPT

    def _starter(self, mode: str) -> Callable[[Any, Any], Any]:
        async def start(request: Any, response: Any) -> Any:
            return trigger_answer(response, await self._node.begin(mode, "", "trigger"))

        return start

    async def _cancel_twin(self, request: Any, response: Any) -> Any:
        response.success = self._node.run_is_open
        outcome = await self._node.break_off(Code.CONFLICT, "cancelled by a Trigger")
        response.message = trigger_text(0, outcome.status, outcome.message)
        return response

    def _result(self, request: Any, response: Any) -> Any:
        outcome = self._node.last
        if outcome is None:
            code, words = Code.CONFLICT, "no run has ended yet"
            if self._node.run_is_open:  # no code that ends a run, for a PLC that asks until then
                code, words = Code.NONE, f"run {self._node.step.run} is open"
            response.message = trigger_text(0, code, words)
            return response
        return trigger_answer(response, outcome)


WATCH_S = 0.02
INPUTS = {JOINTS: (JointState, endpoints.STREAM), EDGES: (BeamEvent, endpoints.RELIABLE)}


class TcfNode(SessionNode[ToolSession]):
    """Drives a `ToolSession` with live messages and calls.

    ``last``: outcome of the last run, None before any; ``run_end``: becomes that of the open run,
    done while none is; ``step``: that is awaited.
    """

    NAME = "tcf_node"
    SETTINGS = (*SETTINGS, *MOTION_SETTINGS)
    INPUTS = INPUTS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._calls: TcfServices | None = None
        self._motion: TcfMotion | None = None

    def configure(self) -> None:
        """Read robot and laser, open the history, then the topics, services and the action."""
        super().configure()
        settings = self.settings
        if not settings["laser"] and parallel_station(settings) is None:
            raise InputError("laser is empty: name the file that 'robocal tool beams' wrote")
        laser, station = None, ""
        if settings["laser"]:
            placed = read_laser_for(Path(settings["laser"]), self._nominal)
            laser, station = placed.laser, placed.station
        taught = taught_tool(settings, self._nominal)
        load_measuring(self._nominal)
        self._config = session_config(settings, laser, station, taught)
        history = self.open_session()
        self._outputs = TcfOutputs(self, self._serial_in_use)
        self._calls = TcfServices(self, self._desk.ask, history)
        if settings["motion"] == TRAJECTORY:
            self._motion = TcfMotion(self, self._desk.ask, self._serial_in_use)
        self.add_timer(WATCH_S, self._watch, steady=True)

    def new_session(self, history: CalibrationHistory) -> ToolSession:
        """The session of an active node."""
        return ToolSession(self._nominal, history, self._config, __version__)

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        super().activate()
        self.last: Outcome | None = None
        self.run_end: Future = Future()
        self.run_end.set_result(None)
        self._cycle_id = ""  # of the last run
        self._shown: tuple[int, ...] | None = None
        self._silence = Silence()
        if self._motion is not None and self._session is not None:
            self._motion.activate(self._session)
        self.show_in_force()
        self._show_step()

    def deactivate(self) -> None:
        """Stop what moves and end the session; calls that wait are answered."""
        if self._motion is not None:
            self._motion.deactivate()
        super().deactivate()
        if not self.run_end.done():
            self.run_end.set_exception(NotActiveError("deactivated: the run is broken off"))
            self.run_end.exception()  # else rclpy prints it where no caller waits for it

    def cleanup(self) -> None:
        """Take the action down and close the history."""
        if self._motion is not None:
            self._motion.close()
        self._motion = None
        if self._calls is not None:
            self._calls.close()
        self._calls = None
        super().cleanup()

    def take(self, session: ToolSession, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to what moves, and to the session."""
        motion = self._motion
        if motion is not None:
            motion.take(message) if kind == JOINTS else motion.beam(message)
        take_tool_message(session, kind, message)
        self._silence.heard_if_new(session.newest_joints_ns, time.monotonic())
        if kind == JOINTS and motion is not None and motion.behind:
            self.take_waiting(JOINTS)
        command = session.recognised()
        drives = motion is not None and motion.on_its_way()
        if command is not None and not (drives and command.name == TOOL_STEP):
            self._desk.ask(command)
        elif session.waiting:
            self._desk.step()

    def begin(self, mode: str, cycle_id: str, by: str) -> Any:
        """Begin a run; the outcome of the call."""
        session = self._session
        known = session is not None and session.answered(mode, cycle_id)
        if self._motion is not None and not known:
            self._motion.require_ready()
        return self._desk.ask(Command(MEASURE_TOOL, {"mode": mode, "cycle_id": cycle_id, "by": by}))

    def break_off(self, code: Code, reason: str) -> Any:
        """Break the open run off; the outcome of the call."""
        return self._desk.ask(Command(BREAK_OFF, {"code": int(code), "reason": reason}))

    @property
    def run_is_open(self) -> bool:
        """Whether a run has begun and not ended."""
        return self._session is not None and self._session.run is not None

    def deaf(self) -> str:
        """Why the node would drive on in a closed gap; empty: it would not."""
        return "" if self._motion is None else self._motion.deaf()

    def _watch(self) -> None:
        session = self._session
        if session is None:
            return
        silent_s = self._silence.look(time.monotonic())
        if session.run is not None and silent_s > self.settings["joint_silence_s"]:
            words = f"joint states are silent for {silent_s:.2f} s: check the robot's driver"
            self.break_off(Code.TOO_FEW_SAMPLES, words)

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        name = outcome.command.name
        if outcome.repeated or self._session is None:
            return
        if name == MEASURE_TOOL and outcome.done:
            self.run_end, self.last = Future(), None
            self._cycle_id = str(outcome.command.arguments.get("cycle_id", ""))
        try:
            self._outputs.events.tell(outcome.command, outcome)
            if name in (MEASURE_TOOL, TOOL_STEP, BREAK_OFF):
                self._show_step(f"{name}: {outcome.status.name} {outcome.message}")
            self.show_in_force()
        except (RobocalError, ValueError) as error:  # what is done stays done
            self.get_logger().error(f"{name} was done but not published: {error}")
        ends = name in (TOOL_STEP, BREAK_OFF) and self._session.run is None
        if ends and not self.run_end.done():
            self.last = outcome
            if self._motion is not None:
                self._motion.run_ended(outcome)
            self._show_result(outcome, self._cycle_id)
            self.run_end.set_result(outcome)
        elif name in (SOLVE_TOUCHES, SOLVE_SWEEPS):
            self._show_result(outcome)

    def _show_result(self, outcome: Outcome, cycle_id: str = "") -> None:
        """Publish what was measured, and its verdict."""
        try:
            if outcome.calibration_id and self._history is not None:
                model = self._history.model(outcome.calibration_id)
                of_laser = "points_m" in model
                show = self._outputs.laser if of_laser else self._outputs.candidate
                show(model, outcome.command.stamp_ns or 0)
            self._outputs.quality(outcome, cycle_id)
        except RobocalError as error:  # the caller is answered all the same
            self.get_logger().error(f"it is measured but was not published: {error}")

    def _show_step(self, words: str = "") -> None:
        session = self._session
        if session is None:
            return
        step: PlannedStep | None = session.awaited
        number = 0 if session.run is None else session.run.number
        self.step = self._outputs.step(step, number, session.newest_joints_ns)
        if self._calls is not None:
            self._calls.feedback(self.step, words)

    def frame(self, outcome: Outcome) -> ToolFrame:
        """The measured tool of an outcome."""
        if self._history is None:
            return ToolFrame()
        model = self._history.model(outcome.calibration_id)
        if "points_m" in model:
            return ToolFrame()
        return self._outputs.frame(model, outcome.command.stamp_ns or 0)

    def show_in_force(self) -> None:
        """Publish the tool in force and record the new state, when either changed."""
        session, history = self._session, self._history
        if session is None or history is None:
            return
        current = session.current
        heads = current.head, current.thermal, current.healthy, current.mandrel, current.station
        shown = tuple(head.revision for head in heads)
        if self._shown == shown and not self._outputs.events.need_configuration:
            return
        if self._shown != shown:
            head, model = current.head, current.model
            stamp = history.get(head.calibration_id).stamp_ns if head.calibration_id else 0
            thermal = 0 if model is None else int(model["thermal_revision"])
            self._outputs.tool(
                current.tool, head.revision, thermal, stamp, taught=bool(current.foreign)
            )
        self._shown = shown
        self._outputs.events.tell(configuration(session, self._topics), None)

    def report(self, session: ToolSession, history: CalibrationHistory, health: Health) -> None:
        """Tell what is awaited, what moves, and what became of the last run."""
        values, run = health.values, session.run
        values["run"] = "none" if run is None else f"{run.number}, {run.awaited.name} is awaited"
        if self._motion is not None:
            values["motion"] = self._motion.words()
            if self._motion.fault:
                health.worsen(ERROR, self._motion.fault)
            if trouble := self._motion.trouble():
                health.worsen(WARN, trouble)
        values["last run"] = "none" if self.last is None else self.last.message
        if self._outputs.missing:
            health.worsen(WARN, self._outputs.missing)
        if session.current.foreign:
            health.worsen(ERROR, session.current.foreign)


def main() -> None:
    """Run the node."""
    run(TcfNode)
