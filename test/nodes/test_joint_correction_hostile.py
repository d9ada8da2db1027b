"""Hostile messages to the joint correction node, over DDS: nothing wrong ever goes out.

What goes out is finite, within the bounds, and its offset (out less in) changes no faster than the
blend may, besides what the change of the posture alone does to it, at any one blend. Of two
postures far apart the bounds tell more than that; near ones, and the same one twice, are its point.
"""

import itertools
import time
from array import array
from dataclasses import dataclass
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
    Line,
    distance,
    joints,
    model_message,
)
from rclpy.action import ActionClient, ActionServer, GoalResponse
from std_msgs.msg import Float64MultiArray
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.correction.bounds import FADES_FROM
from robocal_ros.correction.joint_correction import JointCorrection, pack_model

LONGEST_STEP_S = 0.02
# A drift of some millimetres that blends in slowly, so that most commands meet a blend.
PARAMETERS = {
    "stream_gap_s": 2.0,
    "blend_deg_s": 0.05,
    "start_deg": 0.02,
    "thermal_tcp_mm": 20.0,
    "thermal_tcp_deg": 2.0,
    "thermal_joint_deg": 3.0,
}
BLEND_RAD_S = np.radians(PARAMETERS["blend_deg_s"])
START_RAD = np.radians(PARAMETERS["start_deg"])
THERMAL_RAD = np.radians(PARAMETERS["thermal_joint_deg"])
CONTROLLER = "/arm_controller/follow_joint_trajectory"
# A blend is straight in the parameters, not quite in the joints: second order of its 1e-3 rad.
CURVED = 1e-6
# Blends at which a posture's effect is looked at; near a singularity the bound on the joints holds
# from a tiny one on.
BLENDS = np.concatenate([[0.0], np.geomspace(1e-9, 0.01, 71), np.linspace(0.02, 1.0, 99)])


@dataclass
class Step:
    """Taught and commanded joints, and the time that the blend had since the step before.

    ``begins``: anew, where the robot stands within ``start_deg``.
    """

    taught: np.ndarray
    out: np.ndarray
    blends_s: float
    begins: bool


class Log:
    """What went in and came out."""

    def __init__(self, free_axis: bool) -> None:
        self.steps: list[Step] = []
        nominal, actual = pack_model(NOMINAL), pack_model(ACTUAL)
        self._correction = JointCorrection(
            np.stack([nominal, nominal, nominal, actual]), FADES_FROM * THERMAL_RAD, free_axis
        )

    def add(self, taught: Any, out: Any, blends_s: float, begins: bool = False) -> None:
        self.steps.append(Step(np.array(taught), np.array(out), blends_s, begins))

    def check(self) -> None:
        """Check what came since the last time."""
        for step in self.steps:
            assert np.all(np.isfinite(step.out))
            assert np.all(np.abs(step.out - step.taught) <= THERMAL_RAD)
            assert np.all((step.out >= NOMINAL.lower - 1e-9) & (step.out <= NOMINAL.upper + 1e-9))
        for earlier, later in itertools.pairwise(self.steps):
            posture = np.max(np.abs(self._shifts(later) - self._shifts(earlier)), axis=0)
            change = np.abs((later.out - later.taught) - (earlier.out - earlier.taught))
            allowed = BLEND_RAD_S * later.blends_s + START_RAD * later.begins + posture + CURVED
            assert np.all(change <= allowed), (change, allowed)
        del self.steps[:-1]

    def _shifts(self, step: Step) -> np.ndarray:
        q = np.tile(step.taught, (len(BLENDS), 1))
        return self._correction.correct(q, BLENDS).joint_shift


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
    """A line whose robot stands where it was sent last."""

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
        self.stream = stream
        self.into = {
            "joint_targets": self.to_target,
            "joint_commands": self.to_array,
            "joint_trajectory": self.to_path,
            "joint_states": self.to_states,
            "kinematic_model": self.to_model,
            "tool": self.to_tool,
        }
        self.sent: set[str] = set()
        self.log = Log(mode.get("free_axis", False))
        self.since_s = time.monotonic()  # the last command was not before it
        self.longest_s = np.inf
        self.taught = HOME.copy()
        self.at = HOME.copy()

    def send(self, what: str, message: Any) -> None:
        if what == "enable":
            self.enable(message)
        elif what == "flood":
            self.command(self.stream, message, copies=50)
        elif what == "taught":
            self.command(self.stream, self.good(message))
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

    def command(self, topic: str, message: Any, copies: int = 1) -> int:
        """Send it; what comes out is noted, and the robot goes there."""
        self.stand()
        self.sent.add(str(message))
        before, taken, accepted = time.monotonic(), *self.counts(topic)
        for _ in range(copies):
            self.into[topic].publish(message)
        self.graph.spin_until(lambda: self.counts(topic)[0] == taken + copies, f"{topic} is taken")
        count = self.counts(topic)[1] - accepted
        inbox = {
            "joint_targets": self.targets,
            "joint_commands": self.arrays,
            "joint_trajectory": self.paths,
        }.get(topic)
        if inbox is not None:
            self.graph.spin_until(lambda: len(inbox) >= count, f"{count} outputs of {topic}")
        if self.shadow:
            for out in itertools.chain(self.targets, self.arrays, self.paths):
                self.passed(out)
            for box in (self.targets, self.arrays, self.paths):
                box.clear()
            return count
        for out in self.targets:
            index = [NAMES.index(name) for name in out.name]
            self.went(before, index, message.position, out.position)
        for out in self.arrays:
            self.went(before, list(range(6)), message.data, out.data)
        paths = list(self.paths)
        for box in (self.targets, self.arrays, self.paths):
            box.clear()
        for path in paths:
            self.follow(path, message, before)
        return count

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
        before, self.controller.accepts = time.monotonic(), accepts
        goal = FollowJointTrajectory.Goal(trajectory=trajectory)
        sent = self.client.send_goal_async(goal)
        self.graph.spin_until(sent.done, "the goal is taken")
        ended = sent.result().get_result_async()
        self.graph.spin_until(ended.done, "the goal ends")
        goals = list(self.controller.goals)
        self.controller.goals.clear()
        succeeded = ended.result().status == GoalStatus.STATUS_SUCCEEDED
        assert succeeded == bool(goals and accepts)
        for out in goals:
            if self.shadow:
                self.passed(out)
            else:
                self.follow(out, trajectory, before, stops=accepts)

    def counts(self, topic: str) -> tuple[int, int]:
        """How many messages were received, and how many of them were not refused."""
        count = self.node.inputs[topic]
        return count.received, count.received - count.invalid

    def went(self, before: float, index: list[int], taught: Any, out: Any) -> None:
        """A target went out, and the robot there; ``before`` it the clock showed this."""
        self.taught[index], self.at[index] = taught, out
        pause = min(time.monotonic() - self.since_s, self.longest_s)
        self.log.add(self.taught, self.at, pause, self.longest_s == np.inf)
        self.since_s, self.longest_s = before, LONGEST_STEP_S

    def follow(
        self, path: JointTrajectory, taught: JointTrajectory, before: float, stops: bool = True
    ) -> None:
        """A trajectory got through; a stop, or its rejection, ends it before the robot moves."""
        if not path.points:
            return
        # one that was stopped, or rejected, before it has blended until then
        under_way_s = before - self.since_s if self.longest_s == np.inf else 0.0
        last_s, kept = -max(under_way_s, 0.0), self.log.steps[-1:]
        for point, given_point in zip(path.points, taught.points, strict=True):
            rows = (point.positions, point.velocities, point.accelerations, point.effort)
            assert all(np.all(np.isfinite(row)) for row in rows)
            if path.joint_names == NAMES:
                at_s = point.time_from_start.sec + 1e-9 * point.time_from_start.nanosec
                self.log.add(given_point.positions, point.positions, at_s - last_s)
                last_s = at_s
        self.log.check()
        self.log.steps[:] = kept
        if stops:
            self.command("joint_trajectory", JointTrajectory(joint_names=NAMES))
        self.since_s, self.longest_s = min(self.since_s, before), np.inf


@pytest.mark.parametrize(
    ("stream", "on", "mode"),
    [
        ("joint_targets", True, {}),
        ("joint_commands", True, {}),
        ("joint_commands", False, {}),
        ("joint_targets", True, {"free_axis": True}),
        ("joint_targets", True, {"shadow": True}),
        ("joint_commands", True, {"shadow": True}),
    ],
)
def test_nothing_wrong_goes_out(graph: Any, stream: str, on: bool, mode: dict[str, bool]) -> None:
    line = Attacked(graph, stream, on, **mode)

    @settings(
        max_examples=10,
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
        line.log.check()
        # and the node goes on: once the operator says so a good command goes out again
        line.enable(on)
        assert line.command(stream, line.good(line.taught)) == 1
        line.log.check()

    attack()
    line.client.destroy()
    line.controller.close()
    for _ in range(3000):
        line.command(stream, line.good(HOME))
        if line.node._session.status().settled:
            break
    line.command(stream, line.good(HOME))
    line.log.check()
    if on and not line.shadow:
        assert distance(ACTUAL, line.at) < 1e-9
    else:
        assert list(line.at) == HOME.tolist()
