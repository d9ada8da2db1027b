# SPDX-License-Identifier: Apache-2.0
"""Hostile messages to the joint correction node, over DDS: nothing wrong ever goes out.

What goes out is finite, within the joints' limits and bounds, and changes over the time that passed
no faster than the joints may; nor does its offset (out less in) change faster than the limiter
lets it. A stream's time is that of the session's clock, which is looked at as it is called.
"""

import itertools
import time
from array import array
from typing import Any

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from hostile_messages import ACTUAL, THROUGH_A_SINGULARITY, attacks
from hypothesis import HealthCheck, Phase, example, given, settings
from joint_correction_live import (
    HOME,
    NAMES,
    NODE,
    NOMINAL,
    PATIENT,
    Line,
    joints,
    model_message,
)
from long_form import amount, more
from rclpy.action import ActionClient, ActionServer, GoalResponse
from rclpy.serialization import deserialize_message
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64MultiArray
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.kinematics.robots import load_description

# A drift of some millimetres.
PARAMETERS = PATIENT | {
    "thermal_tcp_mm": 20.0,
    "thermal_tcp_deg": 2.0,
    "thermal_joint_deg": 3.0,
}
THERMAL_RAD = np.radians(PARAMETERS["thermal_joint_deg"])
START_RAD = np.radians(0.02)  # by so much the robot may stand beside where a command begins
OFFSET_RAD_S = np.radians(10.0)
SPEED_RAD_S = load_description("kr150_r3100").max_velocity
ROUNDING = 1e-8
CONTROLLER = "/arm_controller/follow_joint_trajectory"


class Stream:
    """What the session put out, when, and for which taught joints; a lag is no offset."""

    def __init__(self, session: Any) -> None:
        self._session, self._target, self._tail = session, session.target, session.stream.tail
        self._serialized = session.serialized_target
        self.outs: list[list[float]] = []
        self.at_s, self.out, self.offset = np.full((3, 6), np.nan)
        session.target, session.stream.tail = self.target, self.tail
        session.serialized_target = self.serialized

    def target(self, command: Any, now_s: float) -> Any:
        out = self._target(command, now_s)
        index = [NAMES.index(name) for name in command.names]
        lags = self._session.status().lag_s > 0.0
        self.check(index, out.position, None if lags else command.position, now_s)
        return out

    def serialized(self, came: bytes, now_s: float) -> bytes | None:
        out = self._serialized(came, now_s)
        if out is not None:
            taught, corrected = (deserialize_message(data, JointState) for data in (came, out))
            assert taught.name == corrected.name == list(NAMES)
            now, was = np.array(corrected.position), np.array(taught.position)
            self.check(list(range(len(NAMES))), now, was, now_s)
        return bytes(out) if out is not None else None

    def tail(self, now_s: float) -> Any:
        out = self._tail(now_s)
        if out is not None:
            self.check([NAMES.index(name) for name in out.names], out.position, None, now_s)
        return out

    def check(self, index: list[int], out: Any, taught: Any, now_s: float) -> None:
        assert np.all(np.isfinite(out))
        assert np.all((out >= NOMINAL.lower[index] - 1e-9) & (out <= NOMINAL.upper[index] + 1e-9))
        elapsed = np.nan_to_num(now_s - self.at_s[index], nan=np.inf)
        step = np.nan_to_num(np.abs(out - self.out[index]))
        assert np.all(step <= SPEED_RAD_S[index] * elapsed + START_RAD)
        self.at_s[index], self.out[index] = now_s, out
        self.outs.append(out.tolist())
        if taught is None:
            self.offset[index] = np.nan
            return
        offset = out - taught
        assert np.all(np.abs(offset) <= THERMAL_RAD)
        change = np.nan_to_num(np.abs(offset - self.offset[index]))
        assert np.all(change <= OFFSET_RAD_S * elapsed + START_RAD)
        self.offset[index] = offset


class Controller:
    """Accepts goals, or rejects them; one that it accepts has succeeded."""

    def __init__(self, node: Any) -> None:
        self.accepts = True
        self.goals: list[JointTrajectory] = []
        self._server = ActionServer(
            node, FollowJointTrajectory, CONTROLLER, self._follow, goal_callback=self._judge
        )

    def _judge(self, goal: Any) -> GoalResponse:
        self.goals.append(goal.trajectory)
        return GoalResponse.ACCEPT if self.accepts else GoalResponse.REJECT

    @staticmethod
    def _follow(handle: Any) -> Any:
        handle.succeed()
        return FollowJointTrajectory.Result()

    def close(self) -> None:
        self._server.destroy()


class Attacked(Line):
    """A line whose robot goes where a stream sends it, and follows no trajectory."""

    def __init__(self, graph: Any, stream: str, on: bool, **mode: bool) -> None:
        self.controller = Controller(graph.probe)
        super().__init__(
            graph, **PARAMETERS, **mode, enable_on_start=on, follow_joint_trajectory=CONTROLLER
        )
        self.shadow = mode.get("shadow", False)
        self.client = ActionClient(
            graph.probe, FollowJointTrajectory, f"{NODE}/follow_joint_trajectory"
        )
        graph.spin_until(self.client.server_is_ready, "the action")
        graph.spin_until(
            self.node._proxy._clients[CONTROLLER].server_is_ready, "the controller's action"
        )
        self.take(model_message(ACTUAL), self.to_model, "kinematic_model")
        self.stream, self.taught = stream, HOME.copy()
        self.into = {
            "joint_targets": self.to_target,
            "joint_commands": self.to_array,
            "joint_trajectory": self.to_path,
            "joint_states": self.to_states,
            "kinematic_model": self.to_model,
            "tool": self.to_tool,
        }
        self.sent: set[str] = set()
        if not self.shadow:
            self.log = Stream(self.node._session)

    def send(self, what: str, message: Any) -> None:
        if what == "enable":
            self.enable(message)
        elif what == "flood":
            self.command(self.stream, message, copies=50)
        elif what == "taught":
            if self.command(self.stream, self.good(message)):
                self.taught = message
        elif what == "path":
            self.command("joint_trajectory", message)
        elif what == "goal":
            self.goal(*message)
        else:
            self.command(what, message)

    def good(self, q: np.ndarray) -> Any:
        if self.stream == "joint_targets":
            return joints(q)
        return Float64MultiArray(data=array("d", q))

    def command(self, topic: str, message: Any, copies: int = 1) -> bool:
        """Send it, let the robot follow, judge what comes out; whether it was accepted."""
        self.stand()
        self.sent.add(str(message))
        count = self.node.inputs[topic]
        received, invalid = count.received, count.invalid
        for _ in range(copies):
            self.into[topic].publish(message)
        self.graph.spin_until(lambda: count.received > received, f"{topic} is taken")
        if copies > 1:
            self.graph.spin_for(0.05)  # of a stream only the newest that waits is taken
        accepted = bool(count.invalid == invalid)
        if accepted and topic == "joint_trajectory":
            self.graph.spin_until(lambda: self.paths, "the trajectory that was accepted")
        self.look(message)
        return accepted

    def look(self, message: Any) -> None:
        """Judge what came out of the node, and go there."""
        if self.shadow:
            for out in itertools.chain(self.targets, self.arrays, self.paths):
                self.passed(out)
        else:
            inbox = self.targets if self.stream == "joint_targets" else self.arrays
            outs = self.log.outs
            self.graph.spin_until(lambda: len(inbox) >= len(outs), "what the session put out")
            came = [list(out.position if inbox is self.targets else out.data) for out in inbox]
            assert came == outs
            outs.clear()
            known = np.isfinite(self.log.out)
            self.at = np.where(known, self.log.out, HOME)
            for out in self.paths:
                self.follows(out, message)
        for box in (self.targets, self.arrays, self.paths):
            box.clear()

    def passed(self, out: Any) -> None:
        """In shadow mode what goes out is what came, and finite."""
        assert str(out) in self.sent
        if isinstance(out, JointTrajectory):
            rows = [row for p in out.points for row in (p.positions, p.velocities)]
        else:
            rows = [out.data if isinstance(out, Float64MultiArray) else out.position]
        assert all(np.all(np.isfinite(row)) for row in rows)

    def goal(self, trajectory: JointTrajectory, accepts: bool) -> None:
        """Send a goal, which the controller accepts or rejects."""
        self.stand()
        self.sent.add(str(trajectory))
        self.controller.accepts = accepts
        goal = FollowJointTrajectory.Goal(trajectory=trajectory)
        handle = self.graph.awaited(self.client.send_goal_async(goal), "the goal is taken")
        ended = self.graph.awaited(handle.get_result_async(), "the goal ends")
        goals = list(self.controller.goals)
        self.controller.goals.clear()
        succeeded = ended.status == GoalStatus.STATUS_SUCCEEDED
        assert succeeded == bool(goals and accepts)
        for out in goals:
            if self.shadow:
                self.passed(out)
            else:
                self.follows(out, trajectory)
        self.look(None)

    def follows(self, out: JointTrajectory, came: JointTrajectory) -> None:
        """A trajectory got through: over its own time it moves as it may."""
        for point in out.points:
            rows = (point.positions, point.velocities, point.accelerations, point.effort)
            assert all(np.all(np.isfinite(row)) for row in rows)
        index = [NAMES.index(name) for name in out.joint_names]
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in out.points]
        q, taught = (np.array([p.positions for p in path.points]) for path in (out, came))
        elapsed = np.diff(times)[:, None]
        assert np.all(np.abs(q - taught) <= THERMAL_RAD)
        assert np.all(np.abs(np.diff(q, axis=0)) <= SPEED_RAD_S[index] * elapsed + ROUNDING)
        change = np.abs(np.diff(q - taught, axis=0))
        assert np.all(change <= OFFSET_RAD_S * elapsed + ROUNDING)

    def again(self) -> None:
        """The operator acknowledges, and the program begins where the robot stands."""
        if self.shadow:
            assert self.command(self.stream, self.good(HOME))
            return
        for _ in range(20):  # a path that the robot does not follow must have ended
            self.rest()  # acknowledged in motion, what moves goes on
            assert self.graph.call(Trigger, f"{NODE}/acknowledge").success
            self.rest()
            # as at the end of a path that the robot did not follow: with all of the offset
            over_s, names = time.monotonic() + 60.0, tuple(NAMES)
            self.taught, _ = self.node._session.taught(names, np.array(self.at), None, over_s)
            if self.command(self.stream, self.good(self.taught)):
                return
        pytest.fail("the node does not go on")


@pytest.mark.parametrize(
    ("stream", "on", "mode"),
    [
        ("joint_targets", True, {}),
        ("joint_commands", True, {}),
        ("joint_targets", True, {"shadow": True}),
        *more(
            ("joint_commands", False, {}),
            ("joint_targets", True, {"free_axis": True}),
            ("joint_commands", True, {"shadow": True}),
        ),
    ],
)
def test_nothing_wrong_goes_out(graph: Any, stream: str, on: bool, mode: dict[str, bool]) -> None:
    line = Attacked(graph, stream, on, **mode)
    line.rest()

    @settings(
        max_examples=amount(6, 10),
        deadline=None,
        database=None,
        # the node remembers: nothing can be replayed or made smaller
        phases=[Phase.explicit, Phase.generate],
        suppress_health_check=[HealthCheck.too_slow],
    )
    @given(messages=attacks(stream, on))
    @example(messages=THROUGH_A_SINGULARITY)
    def attack(messages: list[tuple[str, Any]]) -> None:
        for what, message in messages:
            line.send(what, message)
        line.enable(on)
        line.again()  # the node goes on

    attack()
    line.client.destroy()
    line.controller.close()
    for _ in range(3000):
        assert line.command(stream, line.good(line.taught))
        if line.node._session.status().settled:
            break
    if line.shadow:
        return
    if not on:
        assert list(line.at) == list(line.taught)
        return
    goal, before, after = (
        arm.fk(np.array(q)) @ arm.T_flange_tool
        for arm, q in ((NOMINAL, line.taught), (ACTUAL, line.taught), (ACTUAL, line.at))
    )
    assert np.linalg.norm((before - goal)[:3, 3]) > 1e-4
    assert np.linalg.norm((after - goal)[:3, 3]) < 1e-6  # weak directions are damped
