"""The tool node: edges of two crossed beams in, the tool's frame out (docs/tcf_node.md)."""

import time
from pathlib import Path
from typing import Any

from rclpy.task import Future
from robocal_msgs.msg import BeamEvent, ToolFrame
from sensor_msgs.msg import JointState

from robocal_ros import __version__
from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError
from robocal_ros.ground.samples import JOINTS
from robocal_ros.ground.streams import Silence
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.kinematics.robots import load_robot, robot_file_hash
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import run
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError
from robocal_ros.ros.session_node import SessionNode
from robocal_ros.session.events import BREAK_OFF, MEASURE_TOOL, TOOL_STEP, Command, Outcome
from robocal_ros.tool import node_motion
from robocal_ros.tool.driving import load_measuring
from robocal_ros.tool.edges import EDGES
from robocal_ros.tool.laser_frame import read_laser_for
from robocal_ros.tool.measuring_plan import PlannedStep
from robocal_ros.tool.node_motion import TcfMotion
from robocal_ros.tool.results import WITNESS, WITNESS_REFERENCE, ToolInForce
from robocal_ros.tool.services import Runner, TcfOutputs, TcfServices
from robocal_ros.tool.session import ToolSession, configuration, take_tool_message
from robocal_ros.tool.settings import SETTINGS, TRAJECTORY, session_config, taught_tool

WATCH_S = 0.02
INPUTS = {JOINTS: (JointState, endpoints.STREAM), EDGES: (BeamEvent, endpoints.RELIABLE)}


class TcfNode(SessionNode[ToolSession]):
    """Drives a `ToolSession` with live messages and calls."""

    NAME = "tcf_node"
    SETTINGS = (*SETTINGS, *node_motion.SETTINGS)
    INPUTS = INPUTS

    def __init__(self, **options: Any) -> None:
        super().__init__(**options)
        self._calls: TcfServices | None = None
        self._motion: TcfMotion | None = None

    def configure(self) -> None:
        """Read robot and laser, open the history, then the topics, services and the action."""
        settings = self.settings
        self._nominal = load_robot(settings["robot"])
        if not settings["laser"]:
            raise InputError("laser is empty: name the file that 'robocal tool beams' wrote")
        placed = read_laser_for(Path(settings["laser"]), self._nominal)
        taught = taught_tool(settings, self._nominal)
        load_measuring(self._nominal)
        self._config = session_config(settings, placed.laser, placed.station, taught)
        history = self.open_session()
        frames = settings["base_frame"], settings["flange_frame"], settings["tool_frame"]
        self._outputs = TcfOutputs(
            self.add_output,
            self._nominal,
            self._serial_in_use,
            robot_file_hash(settings["robot"]),
            frames,
        )
        runner = Runner(
            begin=self._begin,
            ended=lambda: self._run_end,
            cancel=lambda reason: self._break_off(Code.CONFLICT, reason),
            last=lambda: self._last,
            frame=self._frame,
            step=lambda: self._step,
            is_open=lambda: self._session is not None and self._session.run is not None,
            deaf=lambda: "" if self._motion is None else self._motion.deaf(),
        )
        self._calls = TcfServices(self, runner, self._desk.ask, history)
        if settings["motion"] == TRAJECTORY:
            robot = self._nominal, self._serial_in_use
            self._motion = TcfMotion(self, settings, self._desk.ask, *robot)
        self.add_timer(WATCH_S, self._watch, steady=True)

    def new_session(self, history: CalibrationHistory) -> ToolSession:
        """The session of an active node."""
        return ToolSession(self._nominal, history, self._config, __version__)

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was measured before."""
        super().activate()
        self._last: Outcome | None = None
        self._run_end: Future = Future()
        self._shown: tuple[int, int, int] | None = None
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
        if not self._run_end.done():
            self._run_end.set_exception(NotActiveError("deactivated: the run is broken off"))

    def cleanup(self) -> None:
        """Take the action down and close the history."""
        if self._motion is not None:
            self._motion.close()
        self._motion = None
        if self._calls is not None:
            self._calls.close()
        self._calls = None
        super().cleanup()

    # ---- samples and commands -------------------------------------------------------------------

    def take(self, session: ToolSession, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to what moves, and to the session."""
        motion = self._motion
        if motion is not None:
            motion.take(message) if kind == JOINTS else motion.beam(message)
        take_tool_message(session, kind, message)
        self._silence.heard_if_new(session.newest_joints_ns, time.monotonic())
        command = session.recognised()
        drives = motion is not None and motion.on_its_way()
        if command is not None and not (drives and command.name == TOOL_STEP):
            self._desk.ask(command)
        elif session.waiting:
            self._desk.step()

    def _begin(self, mode: str, cycle_id: str, by: str) -> Any:
        session = self._session
        known = session is not None and session.answered(mode, cycle_id)
        if self._motion is not None and not known:
            if mode in (WITNESS, WITNESS_REFERENCE):
                words = "the way of the tool beside the mandrel is not known here"
                raise ConflictError(f"{words}: the robot's program drives it (motion: program)")
            self._motion.require_ready()
        return self._desk.ask(Command(MEASURE_TOOL, {"mode": mode, "cycle_id": cycle_id, "by": by}))

    def _break_off(self, code: Code, reason: str) -> Any:
        return self._desk.ask(Command(BREAK_OFF, {"code": int(code), "reason": reason}))

    def _watch(self) -> None:
        session = self._session
        if session is None:
            return
        silent_s = self._silence.look(time.monotonic())
        if session.run is not None and silent_s > self.settings["joint_silence_s"]:
            words = f"joint states are silent for {silent_s:.2f} s: check the robot's driver"
            self._break_off(Code.TOO_FEW_SAMPLES, words)

    # ---- outputs --------------------------------------------------------------------------------

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        name = outcome.command.name
        if outcome.repeated or self._session is None:
            return
        try:
            if name == MEASURE_TOOL:  # a run goes by the thermal model of its begin
                self.show_in_force()
            self._outputs.events.tell(outcome.command, outcome)
            if name == MEASURE_TOOL and outcome.done:
                self._run_end, self._last = Future(), None
            if name in (MEASURE_TOOL, TOOL_STEP, BREAK_OFF):
                self._show_step(f"{name}: {outcome.status.name} {outcome.message}")
            self.show_in_force()
        except (RobocalError, ValueError) as error:  # what is done stays done
            self.get_logger().error(f"{name} was done but not published: {error}")
        if name in (TOOL_STEP, BREAK_OFF) and self._session.run is None and not self._last:
            self._end_run(outcome)

    def _end_run(self, outcome: Outcome) -> None:
        self._last = outcome
        if self._motion is not None:
            self._motion.run_ended(outcome)
        try:
            if outcome.calibration_id and self._history is not None:
                model = self._history.model(outcome.calibration_id)
                self._outputs.candidate(model, outcome.command.stamp_ns or 0)
            self._outputs.quality(outcome)
        except RobocalError as error:  # the caller is answered all the same
            self.get_logger().error(f"the run has ended but was not published: {error}")
        if not self._run_end.done():
            self._run_end.set_result(outcome)

    def _show_step(self, words: str = "") -> None:
        session = self._session
        if session is None:
            return
        step: PlannedStep | None = session.awaited
        number = 0 if session.run is None else session.run.number
        self._step = self._outputs.step(step, number, session.newest_joints_ns)
        if self._calls is not None:
            self._calls.feedback(self._step, words)

    def _frame(self, outcome: Outcome) -> ToolFrame:
        if self._history is None:
            return ToolFrame()
        model = self._history.model(outcome.calibration_id)
        return self._outputs.frame(model, outcome.command.stamp_ns or 0)

    def show_in_force(self) -> None:
        """Publish the tool in force and record the new state, when either changed."""
        session, history = self._session, self._history
        if session is None or history is None:
            return
        current = session.current
        shown = current.head.revision, current.thermal.revision, current.healthy.revision
        if self._shown == shown and not self._outputs.events.need_configuration:
            return
        if self._shown != shown:
            self._show_tool(history, current)
        self._shown = shown
        self._outputs.events.tell(configuration(session, self._topics), None)

    def _show_tool(self, history: CalibrationHistory, current: ToolInForce) -> None:
        head = current.head
        stamp = history.get(head.calibration_id).stamp_ns if head.calibration_id else 0
        thermal = 0 if head.model is None else int(head.model["thermal_revision"])
        self._outputs.tool(current.tool, head.revision, thermal, stamp)

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
        values["last run"] = "none" if self._last is None else self._last.message
        if self._outputs.missing:
            health.worsen(WARN, self._outputs.missing)


def main() -> None:
    """Run the node."""
    run(TcfNode)
