# SPDX-License-Identifier: Apache-2.0
"""The joint correction node: taught joints in, corrected ones out (docs/joint_correction.md)."""

import math
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NoReturn

import numpy as np
from control_msgs.msg import JointTrajectoryControllerState as ControllerState
from rclpy.serialization import serialize_message
from robocal_msgs.msg import JointOffset, KinematicModel, MotionLease, ToolFrame
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64, Float64MultiArray
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.action import TrajectoryProxy
from robocal_ros.correction.graph import (
    CommandSources,
    GraphViolation,
    GraphWatch,
    JointSources,
    Leases,
    commanded_by,
)
from robocal_ros.correction.interface import (
    CorrectionState,
    Reason,
    RefusedError,
    TrajectoryCommand,
    offered_model,
    offered_tool,
)
from robocal_ros.correction.messages import (
    ArrayMessage,
    JointMessage,
    JointWire,
    PathMessage,
    changed_path,
    joint_names,
    tail_message,
)
from robocal_ros.correction.report import LOOK_S, STREAM, CorrectionReport
from robocal_ros.correction.robot_state import DECELERATION
from robocal_ros.correction.sent_path import SentPath
from robocal_ros.correction.session import CorrectionSession, load_kernels
from robocal_ros.correction.settings import (
    SETTINGS,
    command_joints,
    joint_limits,
    reference_arm,
    session_config,
)
from robocal_ros.correction.trajectories import AHEAD_S, on_its_path
from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.motion.driver import TRUSTED, HardStopService, StatedController
from robocal_ros.motion.plan import REACTION_S, SHORTEST_STOP_S, JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import BEHIND_S
from robocal_ros.motion.stopping import WatchedStop
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import NO_SERIAL, POLL_S, run
from robocal_ros.ros.endpoints import Health, trigger_text
from robocal_ros.ros.graph import ACTION, TRAJECTORY, SourceGuard
from robocal_ros.ros.parameters import ROBOT
from robocal_ros.ros.robot import RobotNode

TARGETS = "joint_targets"
COMMANDS = "joint_commands"
STATES = "joint_states"
MODEL = "kinematic_model"
TOOL = "tool"
LEASE = "motion_lease"
CONTROLLER = "controller_state"
SCALING = "speed_scaling"
KINDS = {
    TRAJECTORY: JointTrajectory,
    TARGETS: JointState,
    COMMANDS: Float64MultiArray,
    STATES: JointState,
}
# Points of a trajectory by topic while the robot is being moved, when a stop is to be answered
# within 50 ms: with joint functions and a tool bent far 1000 take 6 ms, and 1 to read and write.
MOST_TOPIC_POINTS_IN_MOTION = 6_000
ONE_SOURCE_S = 2.0  # of a stream: commands of another source within it are two at once
# First point of a stop that is not stamped: the controller makes a cubic to it from where and as
# fast as it is, which does not turn back where the message comes 60 ms late.
FIRST_S = 0.12 - REACTION_S
TAIL_S = 0.01  # period of what goes out without messages, where that of the stream is not known
ENDING_S = 0.5  # a deactivation waits so long for the robot to stand
STOP_LOOK_S = 0.02


class JointCorrectionNode(RobotNode):
    """Drives a `CorrectionSession` with live messages."""

    NAME = "joint_correction_node"
    SETTINGS = SETTINGS
    _made_for = ""  # serial of the model in use
    _proxy: TrajectoryProxy | None = None

    def configure(self) -> None:
        """Load the models, then open the topics."""
        super().configure()
        nominal, reference = self.robot.arm, reference_arm(self.settings, self.robot.arm)
        config = session_config(self.settings, self.robot)
        serial = self.settings["serial"] or NO_SERIAL
        self._names = command_joints(self.settings, nominal)
        self._shadow = bool(self.settings["shadow"])
        self._session = CorrectionSession(nominal, reference, serial, config)
        self._session.doubt_robot(self.robot_fault)
        load_kernels(reference)  # the first command must not wait for it
        if self.settings["enable_on_start"] and not self.robot_fault:
            self._session.enable(True)
        self._arm_names = names = nominal.joint_names
        self._controller, robot = StatedController(), self._session.robot
        robot.told = lambda now: self._controller.reference(names, now)
        brakes, slides = joint_limits(self.settings, self.robot)[1], nominal.prismatic
        assumed = np.where(slides, DECELERATION[True], DECELERATION[False])
        known = np.isfinite(brakes) & (brakes > 0.0)
        limits = MotionLimits(stop_deceleration=np.where(known, brakes, assumed))
        # what comes 60 ms late must not turn back: not by a shorter one
        self._stopping = WatchedStop(nominal, limits, again_s=SHORTEST_STOP_S)
        self._stop_why = self._stop_fault = ""  # of the last stop
        self._hard_stop = HardStopService(self, self.settings["hard_stop_service"])
        self._stop_path: SentPath | None = None  # what was put out last when a stop was sent
        self._streams = CommandSources(max(config.stream_gap_s, ONE_SOURCE_S))
        self._paths = CommandSources(config.stream_gap_s)
        self._senders = {TARGETS: self._streams, COMMANDS: self._streams, TRAJECTORY: self._paths}
        self._sources = {topic: SourceGuard(self, topic) for topic in KINDS}
        self._leases = Leases(nominal.name, serial)
        self._violation: GraphViolation | None = None
        self._commanded = self._by_action = False
        self._stream = TARGETS
        self._astray: SentPath | None = None  # a path that the robot is being stopped beside
        self._open_topics()
        self._open_action()
        self._report = CorrectionReport(self, self._session, reference)
        self._release.append(self._report.log.close)

    def _open_topics(self) -> None:
        self._outputs = {
            topic: self.add_output(kind, f"~/{topic}", endpoints.RELIABLE)
            for topic, kind in KINDS.items()
        }
        latched, of_several = endpoints.LATCHED, endpoints.LATCHED_OF_SEVERAL
        self.add_input(KinematicModel, MODEL, self._on_model, latched, kept=True)
        self.add_input(ToolFrame, TOOL, self._on_tool, latched, kept=True)
        self.add_input(MotionLease, LEASE, self._on_lease, of_several, inactive=True)
        self.add_input(Float64, SCALING, self._on_scaling, endpoints.NEWEST)
        self.add_input(ControllerState, CONTROLLER, self._on_controller, endpoints.NEWEST)
        states = partial(JointMessage, JointWire(readings_of=self._arm_names))
        targets, act = partial(JointMessage, JointWire()), self._on_target
        self._listen(STATES, states, self._on_states, endpoints.SENSOR)
        self._listen(
            TARGETS, targets, partial(act, TARGETS), endpoints.HEARTBEAT, self._on_usual_target
        )
        commands = partial(ArrayMessage, self._names)
        self._listen(COMMANDS, commands, partial(act, COMMANDS), endpoints.HEARTBEAT)
        counted = self._session.counted
        self._listen(
            TRAJECTORY, lambda came: counted(lambda: PathMessage(came)), self._on_path,
            endpoints.RELIABLE,
        )  # fmt: skip
        self.add_service(SetBool, "~/enable", self._on_enable)
        self.add_service(Trigger, "~/acknowledge", self._on_acknowledge)
        self.add_service(Trigger, "~/take_over", self._on_take_over)
        self.add_timer(POLL_S, self._look_at_graph, steady=True)
        self.add_timer(LOOK_S, self._look, steady=True)
        self._tail_timer = self.add_timer(TAIL_S, self._on_tail, steady=True)
        self._tail_timer.cancel()
        self._stop_timer = self.add_timer(STOP_LOOK_S, self._watch_stop, steady=True)
        self._stop_timer.cancel()

    def _open_action(self) -> None:
        if self.settings[ACTION]:
            if self._proxy is None:
                self._proxy = TrajectoryProxy(
                    self,
                    f"~/{ACTION}",
                    self._correct_goal,
                    self._goal_sent,
                    # the robot may still follow it, and is stopped by where it is
                    self._stop_lost,
                    self._unheard,
                )
            self._proxy.open(self.settings[ACTION], self._session)
        clients = {} if self._proxy is None else self._proxy.clients
        topics = [self._outputs[topic].topic_name for topic in (TRAJECTORY, TARGETS, COMMANDS)]
        ways = commanded_by(self, topics, clients, by_action=bool(self.settings[ACTION]))
        sources = JointSources(self, self.resolve_topic_name(STATES), self._arm_names)
        told = (self.resolve_topic_name(LEASE), self.resolve_topic_name(CONTROLLER))
        self._graph = GraphWatch(self, *ways, sources, self._leases, *told)
        self._release.append(sources.close)

    def robot_compared(self) -> None:
        """Another robot than the one on the graph is corrected no more: its offset goes to zero."""
        self._session.doubt_robot(self.robot_fault)
        self._tell()

    def activate(self) -> None:
        """Look at the clock and who else is there, and tell at once what is done.

        Also in the log: the first line of a process takes rclpy some 50 ms, which a refusal in
        motion has not.
        """
        self._session.resume(time.monotonic(), self.now_ns())
        self.take_kept()  # or all that is told is of before
        self._look_at_graph()
        self._tell()
        self.get_logger().info(self._session.status(time.monotonic()).in_words())

    def deactivate(self) -> None:
        """Bring the robot to rest, for half a second at most; goals under way are stopped."""
        why = "the joint correction is deactivated"
        until_s = time.monotonic() + ENDING_S
        self.is_active = True  # until what it moves stands
        try:
            self._session.hold(Reason.STOPPED, why, time.monotonic())
            self._stop(why)
            while time.monotonic() < until_s and (self._emit_tail() or self._is_stopping()):
                time.sleep(self._tail_period_s())
                self.take_waiting()  # where the robot is
            if self._proxy is not None:
                self._proxy.end(why)
            if self._stopping.under_way:
                self.get_logger().warning(f"{why} while the robot is still being stopped")
            self._stopping.forget()  # what moves the robot when it is active again is another one
        finally:
            self._session.release(Reason.STOPPED)
            self.is_active = False

    def cleanup(self) -> None:
        """Take no goals any more."""
        if self._proxy is not None:
            self._proxy.close()

    def destroy_node(self) -> None:
        """Take the action down with the node."""
        if self._proxy is not None:
            self._proxy.destroy()
        super().destroy_node()

    def _on_model(self, message: Any) -> None:
        build = self._session.counted
        self._session.offer_model(build(lambda: offered_model(message, KinematicModel.ACCEPTED)))
        self._made_for = self._session.status().serial
        if self.is_active:  # else `activate` tells
            self._tell()

    def _on_tool(self, message: Any) -> None:
        build = self._session.counted
        self._session.offer_tool(build(lambda: offered_tool(message, ToolFrame.ACCEPTED)))
        if self.is_active:
            self._tell()

    def _on_enable(self, request: Any, response: Any) -> Any:
        """Answer whether what was asked for is so now."""
        self._session.enable(request.data)
        status = self._session.status(time.monotonic())
        wanted = CorrectionState.ON if request.data else CorrectionState.OFF
        response.success = status.state is wanted and not status.shadow
        response.message = status.in_words()
        self.get_logger().info(f"enable {request.data}: {response.message}")
        self._tell()
        return response

    def _on_acknowledge(self, _: Any, response: Any) -> Any:
        """End a START_MISMATCH, else take note of a damaged history; the answer says of which."""
        what = self._report.acknowledge()
        self._session.acknowledge(time.monotonic())
        answer = self._answer("acknowledge", "", response)
        answer.message += f"; acknowledged: {what}"
        return answer

    def _on_take_over(self, _: Any, response: Any) -> Any:
        """Look again at what was refused for its revision or its size."""
        self._session.take_over()
        status = self._session.status()
        refused = status.last_refusal if status.waiting_revision is not None else ""
        return self._answer("take_over", refused, response)

    def _answer(self, what: str, refused: str, response: Any) -> Any:
        words = refused or self._session.status(time.monotonic()).in_words()
        response.success = not refused
        code = Code.CONFLICT if refused else Code.ACCEPT
        response.message = trigger_text(0, code, words)
        self.get_logger().info(f"{what}: {words}")
        self._tell()
        return response

    def _listen(
        self,
        topic: str,
        read: Callable[[Any], Any],
        act: Callable[[Any, float], None],
        profile: Any,
        usual: Callable[[bytes, float], bool] = lambda came, now: False,
    ) -> None:
        """Act on an input; refuse what a correction node publishes itself, and several sources.

        In shadow mode a message goes out as it came before anything else is done with it.
        ``act`` is given the message, and when it was taken; ``usual`` says whether it was acted on
        already as it came.
        """
        guard, senders = self._sources[topic], self._senders.get(topic)

        def receive(came: Any) -> None:
            now, fault, rivals = time.monotonic(), guard.fault, ""
            if senders and not fault:
                rivals = senders.hear(topic, now)
            if not (fault or rivals) and usual(came, now):
                return
            message = read(came)
            if fault:
                self._refuse_message(topic, Reason.OWN_OUTPUT, fault, now)
            if self._shadow and message.is_finite():
                self._outputs[topic].publish(message.unchanged())
            if rivals and (topic != TRAJECTORY or message.points):  # anybody may stop the robot
                self._refuse_message(topic, Reason.TWO_SOURCES, rivals, now)
            act(message, now)

        opened = self.add_input(KINDS[topic], topic, receive, profile, raw=topic != COMMANDS)
        if senders:
            senders.inputs[topic] = opened

    def _refuse_message(self, topic: str, reason: Reason, detail: str, now_s: float) -> NoReturn:
        """Refuse a message; a stream that it is of is ended in order."""
        if topic in (TARGETS, COMMANDS):
            self._session.stream.end(RefusedError(reason, detail), now_s)
            self._arm_tail()
        self._session.refuse(reason, detail)

    def _on_target(self, topic: str, message: JointMessage | ArrayMessage, now: float) -> None:
        try:
            command = message.command()
        except RefusedError as error:
            self._refuse_message(topic, error.reason, error.detail, now)
        try:
            corrected = self._session.target(command, now)
            self._stream = topic  # one that is refused leaves the tail of another where it goes out
            self._put_out(topic, message, command, corrected)
        finally:
            self._arm_tail()
        stream = self._session.stream
        if stream.is_usual and isinstance(message, JointMessage):
            stream.like = message.target() or stream.like
        self._tell_offset(STREAM, now)

    def _on_usual_target(self, came: bytes, now: float) -> bool:
        """Correct a target of a stream that runs as usual; whether it was one."""
        try:
            out = self._session.serialized_target(came, now)
            if out is None:
                return False
            self._stream = TARGETS
            self._outputs[TARGETS].publish(out)
        finally:
            self._session.settle()
            self._arm_tail()
        self._tell_offset(STREAM, now)
        return True

    def _on_states(self, message: JointMessage, now: float) -> None:
        session = self._session
        command = session.counted(message.command)
        if not command.names:  # of another driver, which knows no position
            return
        self._rescale(now)
        age = (self.now_ns() - command.stamp_ns) * 1e-9 if command.stamp_ns else 0.0
        self._put_out(STATES, message, command, session.reading(command, now, age))
        if session.late_s > BEHIND_S:
            self._catch_up()

    def _catch_up(self) -> None:
        """Take the newest of the robot that has arrived; of a busy node it waits."""
        self.take_waiting(CONTROLLER)
        self.take_waiting(
            STATES, pick=lambda came: {joint_names(one): one for one in came}.values()
        )

    def _on_path(self, message: PathMessage, now: float) -> None:
        if not message.points:  # what its sender means: a controller drops it and drives on
            words = (
                f"{TRAJECTORY} has no points, which stops no robot: a controller drops it and "
                "drives on; the robot is slowed down in its place"
            )
            if self._log_limit.allows(TRAJECTORY, words, now):
                self.get_logger().error(words)
            if not self._shadow:
                self._stop(f"{TRAJECTORY} without points")
            return
        if (
            message.points > MOST_TOPIC_POINTS_IN_MOTION
            and not self._shadow
            and self._session.moves(now)
        ):
            allowed = f"allowed {MOST_TOPIC_POINTS_IN_MOTION} while the robot is being moved"
            self._session.refuse(Reason.BURST, f"{message.points}, {allowed}")
        self._put_out(TRAJECTORY, message, *self._corrected(message))
        self._by_action = False
        if self._proxy is not None:  # a controller would call a goal reached by another path's end
            self._proxy.end(f"a trajectory on {TRAJECTORY} took its place")
        if self._session.output.path is not None:
            self._session.output.path.begin(time.monotonic())
        self._tell_offset(JointOffset.TRAJECTORY, time.monotonic())

    def _corrected(
        self, message: PathMessage, *, is_goal: bool = False
    ) -> tuple[TrajectoryCommand, TrajectoryCommand]:
        """What is commanded by a message, as it came and corrected."""
        command, act = self._session.counted(message.command), self._session.trajectory
        starts_in = (command.stamp_ns - self.now_ns()) * 1e-9 if command.stamp_ns else 0.0
        return command, act(command, time.monotonic(), starts_in, may_be_rejected=is_goal)

    def _put_out(self, topic: str, message: Any, came: Any, command: Any) -> None:
        """Publish a message with another command than came; in shadow mode it has gone out."""
        if not self._shadow:
            same = command is came
            self._outputs[topic].publish(message.unchanged() if same else message.changed(command))

    def _correct_goal(self, trajectory: JointTrajectory) -> tuple[JointTrajectory, SentPath | None]:
        """A goal's trajectory, corrected, and its path; as it came in shadow mode."""
        message = PathMessage(serialize_message(trajectory))
        try:
            came, command = self._corrected(message, is_goal=True)
        except RefusedError as fault:
            held_back = fault.reason is Reason.OWN_OUTPUT or not message.is_finite()
            if held_back or not self._shadow:
                raise
            return trajectory, None
        path = None if self._shadow else self._session.output.path
        try:
            return trajectory if command is came else changed_path(trajectory, command), path
        except Exception:
            if path is not None:  # it never goes out
                self._session.reject(path)
            raise

    def _goal_sent(self) -> None:
        """Tell what a goal is corrected by."""
        self._by_action = True
        self._tell_offset(JointOffset.TRAJECTORY, time.monotonic())

    def _stop(self, why: str) -> None:
        """Bring what this node moves to rest: by what was put out, else by where the robot is."""
        if self._shadow:
            return
        self._catch_up()
        now = time.monotonic()
        self._rescale(now)
        path, robot, sent = self._session.output.path, self._session.robot, True
        if path is not self._stop_path:  # the last stop was of another motion
            self._stopping.forget()
        if path is not None and path.live(now) and not robot.follows(path, now):
            self._session.stream.end(RefusedError(Reason.STOPPED, why), now)
            sent = self._stop_by_readings(why, now)
        elif (planned := self._session.stop(now, AHEAD_S)) is not None:
            times, speeds = planned.time_from_start_s, planned.velocity
            assert path is not None
            assert speeds is not None
            plan = on_its_path(path, planned, now)
            late = time.monotonic() - now > AHEAD_S  # the robot is past where it was to slow down
            if not (late and self._stop_lost(why)):
                sent = self._send_stop(plan, planned.names, why, now - AHEAD_S)
                self._stop_why, self._stop_fault, measured = why, "", robot.speed(now)
                fastest = np.append(np.nan_to_num(measured), np.abs(speeds).max(axis=1))
                lasts = max(SHORTEST_STOP_S / times[-1], 1.0) * times
                self._stopping.watch(np.append(0.0, lasts), fastest, now)
        elif self._by_action and self._proxy is not None and self._proxy.busy:
            sent = self._stop_by_readings(why, now)
        self._arm_tail()
        if not sent and self._proxy is not None:
            self._proxy.cancel(why)
        self._stop_path = self._session.output.path
        if self._stopping.under_way:
            self._stop_timer.reset()

    def _unheard(self, why: str) -> bool:
        """Whether the robot may follow what nobody answers for; a stop of ours would wait there."""
        self._catch_up()
        if self._shadow or self._session.robot.at_rest(time.monotonic()):
            return False
        self._stop_fault = f"{why}; the robot may still move"
        self._hard_stop(self._stop_fault)
        return True

    def _stop_lost(self, why: str) -> bool:
        if self._shadow:  # nothing is changed
            return False
        self._catch_up()
        return self._stop_by_readings(why, time.monotonic())

    def _stop_by_readings(self, why: str, now_s: float) -> bool:
        """Stop a robot that is elsewhere than its path, which ends when the robot stands."""
        self._stop_path = self._session.output.path
        state = self._session.robot.to_stop(now_s)
        if state is None:
            if not self._stopping.under_way:  # one that is goes on being watched
                self._stop_fault = (
                    f"{why}: no stop can be planned, the joint states are missing or too old"
                )
            return False
        self._astray, self._stop_why, self._stop_fault = self._stop_path, why, ""
        self._send_plan(self._stopping.begin(state, now_s), now_s)
        self._stop_timer.reset()
        return True

    def _send_plan(self, plan: JointPlan, begin_s: float) -> None:
        trusted = self._stopping.sent <= TRUSTED
        going_on = plan.going_on(REACTION_S)
        self._send_stop(going_on, self._arm_names, self._stop_why, begin_s, trusted=trusted)

    def _send_stop(
        self,
        plan: JointPlan,
        names: Sequence[str],
        why: str,
        begin_s: float,
        *,
        trusted: bool = True,
    ) -> bool:
        """Send it, worded by what the controller says, else what the joint states do.

        ``begin_s``: when the plan begins; on a busy computer planning itself takes its time.
        """
        now = time.monotonic()
        self._controller.hear(self._session.robot.velocity, len(self._arm_names), now)
        message = self._controller.stop_message(
            plan, names, now, at_s=now - begin_s, first_s=FIRST_S, trusted=trusted
        )
        if self._by_action and self._proxy is not None:
            return self._proxy.stop(message, why)
        self._outputs[TRAJECTORY].publish(message)
        return True

    def _watch_stop(self) -> None:
        if not self._is_stopping():
            self._stop_timer.cancel()
            if self._proxy is not None:
                self._proxy.end("stopped")

    def _is_stopping(self) -> bool:
        """Let a stop go on; whether one is under way."""
        self._catch_up()
        now = time.monotonic()
        if self._session.output.path is not self._stop_path:
            self._stopping.forget()
        if (plan := self._stopping.look(self._session.robot, now)) is not None:
            self._send_plan(plan, now)
        if self._stopping.under_way:
            if self._stopping.failed and not self._stop_fault:
                self._stop_fault = f"{self._stop_why}: {self._stopping.failed}"
                self._hard_stop(self._stop_fault)
                if self._proxy is not None:
                    self._proxy.end(self._stop_fault)
            return True
        if self._astray is not None:
            self._astray.end(now)
        self._astray = None
        return False

    def _arm_tail(self) -> None:
        """Put out what must go out without a message, now and after each period of the stream."""
        stream, timer = self._session.stream, self._tail_timer
        if stream.has_tail and not self._shadow:
            self._emit_tail()
            period_ns = round(self._tail_period_s() * 1e9)
            if abs(period_ns - timer.timer_period_ns) > 0.1 * timer.timer_period_ns:
                timer.timer_period_ns = period_ns
            timer.reset()

    def _tail_period_s(self) -> float:
        period = self._session.stream.period_s
        return min(max(period, 1e-3), 0.1) if math.isfinite(period) else TAIL_S

    def _on_tail(self) -> None:
        if not self._emit_tail() and not self._session.stream.has_tail:
            self._tail_timer.cancel()

    def _emit_tail(self) -> bool:
        """Put out what must go out now although no message came; whether something did."""
        command = self._session.stream.tail(time.monotonic())
        if command is not None:
            kind = KINDS[self._stream]
            self._outputs[self._stream].publish(tail_message(command, kind, self.now_ns()))
        return command is not None

    def _on_controller(self, message: Any) -> None:
        """Where the controller is, and how fast its clock runs."""
        now = time.monotonic()
        stamp = stamp_ns(message.header.stamp)
        age_s = (self.now_ns() - stamp) * 1e-9 if stamp else 0.0
        self._controller.take(message, now, age_s)
        self._rescale(now)
        self._session.robot.held_s = self._controller.held_s
        position = np.array(message.reference.positions, dtype=np.float64)
        self._session.controller(
            tuple(message.joint_names),
            position if len(position) == len(message.joint_names) else np.empty(0),
            None,
            now,
            np.array(message.reference.velocities, dtype=np.float64),
            max(age_s, self._controller.lateness.late_s),
        )

    def _on_scaling(self, message: Any) -> None:
        now = time.monotonic()
        self._controller.scalings.slider(float(message.data), now)
        self._rescale(now)

    def _rescale(self, now_s: float) -> None:
        """How fast the controller's clock runs now; as planned where nobody told it lately."""
        scaling = self._controller.scalings.at(now_s)
        scaling = 1.0 if scaling is None else scaling
        if scaling != self._session.robot.scaling:
            self._session.controller((), np.empty(0), scaling, now_s)

    def _on_lease(self, message: Any) -> None:
        self._leases.hear(message, time.monotonic())
        if self.is_active:
            self._judge_graph()

    def _look_at_graph(self) -> None:
        for guard in self._sources.values():
            guard.look()
        self._streams.look()
        self._judge_graph()

    def _judge_graph(self) -> None:
        """Hold the program's commands while somebody else may move the robot."""
        now, before, lost = time.monotonic(), self._violation, self._graph.lost
        robot = self._session.robot
        stood_s = robot.stood_s(now) if robot.scaling else 0.0  # one that pauses goes on
        found = self._violation = self._graph.look(now, stood_s)
        if self._graph.lost and not lost:
            self.get_logger().error(self._graph.lost)
        for reason in (Reason.OTHER_COMMANDER, Reason.LEASED):
            if found is not None and found.reason is reason:
                self._session.hold(reason, found.detail, now)
            else:
                self._session.release(reason)
        if found is not None and (before is None or before.reason is not found.reason):
            words = f"{found.reason.value}: {found.detail}"
            if found.reason is Reason.LEASED:  # rclpy refuses one line of two severities
                self.get_logger().info(f"nothing goes out, {words}")
            else:
                self.get_logger().error(f"nothing goes out, {words}")
            self._stop(words)
        elif found is None and before is not None:
            self.get_logger().info(f"over: {before.reason.value}")
        if (found is None) is not (before is None):
            self._tell()

    def _tell_offset(self, cause: int, now_s: float) -> None:
        self._commanded = True
        self._report.offset(cause, now_s)

    def _look(self) -> None:
        """Let time pass, and tell what has changed."""
        now = time.monotonic()
        self._rescale(now)
        self._session.look(now, self.now_ns())
        if self._commanded:
            self._tell_offset(JointOffset.PERIODIC, now)
        self._tell(only_news=True)

    def _tell(self, *, only_news: bool = False) -> None:
        commanders = "; ".join([*self._faults(), *self._rivals()])
        self._report.status(commanders, self._graph.lease, only_news=only_news)

    def _faults(self) -> list[str]:
        """Who must not be there."""
        faults = [guard.fault for guard in self._sources.values() if guard.fault]
        return [*faults, *filter(None, [self._graph.commanders])]

    def _rivals(self) -> list[str]:
        now = time.monotonic()
        late = self._session.late(now), self._controller.lateness.words(now)
        found = [self._streams.words(now), self._paths.words(now), *late]
        for words in filter(None, late):
            self.warn(STATES, words)
        return [words for words in found if words]

    def _serial(self) -> str:
        """The robot's serial: as configured, else the model's, else the robot's name."""
        return super()._serial() or self._made_for or str(self.get_parameter(ROBOT.name).value)

    def health(self) -> Health:
        """Tell what is corrected, and what was refused and why."""
        faults = [*self._faults(), *filter(None, [self._stop_fault, self._graph.lost])]
        return self._report.health(faults, [*self._rivals(), self._hard_stop.absent])


def main() -> None:
    """Run the node."""
    run(JointCorrectionNode, events=True)
