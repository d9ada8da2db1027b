# SPDX-License-Identifier: Apache-2.0
"""joint_correction_node before a trajectory controller, judged by what that commands.

Simulated or real; the real one is looked for in the environment, without it those tests are
skipped.
"""

from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import FollowJointTrajectory
from jumps import no_jump
from long_form import amount
from rclpy.action import ActionClient
from robocal_msgs.msg import CorrectionStatus
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool
from test_joint_correction_killed import CORRECTION, Stream
from trajectory_controllers import (
    CONTROLLERS,
    HOME,
    NAMES,
    NODE,
    Controlled,
    seconds,
    trajectory,
)
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.ground.samples import CORRECTED
from robocal_ros.kinematics.robots import load_description
from robocal_ros.ros import endpoints

pytestmark = pytest.mark.cell  # judged by time: nothing else may slow it down

SPEED = np.array([0.6, 0.2, -0.1, 0.3, -0.2, 0.1])  # rad/s
# The joint that needs longest slows down as it may, the others with it.
SLOWS_S = float(np.max(np.abs(SPEED) / load_description("ur10").max_acceleration))


def motion(start: np.ndarray, speed: np.ndarray) -> list[Any]:
    """Of 4 s: points from rest to rest, with their velocities."""
    ways = (1.0, 0.5, 1.0), (3.0, 2.5, 1.0), (4.0, 3.0, 0.0)
    return [(at_s, start + way * speed, share * speed) for at_s, way, share in ways]


class Program(Stream):
    """A program before the node."""

    def corrects(self) -> None:
        """Start the node, and enable it."""
        self.start()
        self.is_heard()
        self.graph.call(SetBool, f"{CORRECTION}/enable", data=True)
        self.graph.spin_for(0.3)  # what was passed on before that is there

    def says(self, *points: Any) -> JointTrajectory:
        """What the node sends for a trajectory of the program."""
        count = len(self.sent)
        self._planner.publish(trajectory(points))
        self.graph.spin_until(lambda: len(self.sent) > count, "the node sends")
        return self.sent[count]

    def drives(self) -> tuple[np.ndarray, np.ndarray]:
        """Begin a motion of 4 s, and wait for its middle; its speed, and its end as corrected."""
        start = self.controller.q
        speed = SPEED if start[0] < HOME[0] + SPEED[0] else -SPEED
        points = motion(start, speed)
        for _ in range(3):  # the real controller subscribes as best effort
            sent = self.says(*points)
            self.graph.spin_for(0.5)
            if abs(self.controller.q[0] - start[0]) > 1e-3:
                break
        assert sent.header.frame_id == CORRECTED
        self.controller.moved(SPEED[0], start)
        return speed, np.array(sent.points[-1].positions)


class Lossy(Program):
    """What the node sends may be lost on its way to the controller."""

    OUTPUT = "corrected/joint_trajectory"

    def __init__(self, graph: Any, controller: Controlled) -> None:
        super().__init__(graph, controller)
        self.lost = 0
        self._onward = graph.publisher(JointTrajectory, f"{NODE}/joint_trajectory")
        graph.probe.create_subscription(
            JointTrajectory, self.OUTPUT, self._carry, endpoints.own(endpoints.RELIABLE)
        )

    def _carry(self, message: JointTrajectory) -> None:
        if self.lost > 0:
            self.lost -= 1
        else:
            self._onward.publish(message)


class ByAction(Program):
    """Its motions are goals of the node's action."""

    PARAMETERS: ClassVar = {"follow_joint_trajectory": f"/{NODE}/follow_joint_trajectory"}

    def __init__(self, graph: Any, controller: Controlled) -> None:
        super().__init__(graph, controller)
        own = f"{CORRECTION}/follow_joint_trajectory"
        controller.action = ActionClient(graph.probe, FollowJointTrajectory, own)
        self.readings = graph.collect(JointState, f"{CORRECTION}/joint_states")

    @property
    def shown(self) -> np.ndarray:
        """Where the robot is, as a planner sees it."""
        by_name = dict(zip(self.readings[-1].name, self.readings[-1].position, strict=True))
        return np.array([by_name[name] for name in NAMES])


@pytest.fixture
def program(request: Any, graph: Any, tmp_path: Path) -> Program:
    """On a controller of a kind, whose hardware has velocities or has none."""
    kind, velocities, line = request.param
    controller = CONTROLLERS[kind](graph, tmp_path, velocities)
    controller.wait()
    program = line(graph, controller)
    program.corrects()
    return program


def on(line: type[Program], *velocities: bool) -> pytest.MarkDecorator:
    """With controllers of each kind."""
    kinds = [
        pytest.param((kind, told, line), id=f"{kind}-{'velocities' if told else 'positions'}")
        for kind in CONTROLLERS
        for told in velocities
    ]
    return pytest.mark.parametrize("program", kinds, indirect=True)


@on(Program, False, True)
def test_a_trajectory_without_points_is_a_stop_on_the_way(program):
    def stops() -> None:
        for _ in range(3):  # a busy computer may hide the state: then it is not stamped
            speed, end = program.drives()
            began_s = program.controller.now_s
            planned = program.says()
            stood = program.controller.stands()
            if stamp_s := seconds(planned.header.stamp):
                break
        assert stamp_s > 0.0
        assert stood == pytest.approx(planned.points[-1].positions, abs=1e-6)
        assert np.abs(stood - end)[0] > SPEED[0]
        at_s, found = program.controller.speeds(began_s - 0.05)
        found = found * np.sign(speed)
        no_jump(found > -1e-3, "nothing goes back")
        no_jump(found < 1.05 * np.abs(speed) + 1e-3, "no faster than the program")
        harder = np.diff(found, axis=0) / np.diff(at_s)[:, None]
        no_jump(np.abs(harder) < 2.5 * np.abs(speed) / SLOWS_S, "as the joints may")

    program.graph.undisturbed(stops)


@on(Lossy, False)
def test_a_stop_that_is_lost_is_sent_again_in_time(program):
    graph, controller = program.graph, program.controller

    def stops(lost: int) -> None:
        speed, _ = program.drives()
        program.lost, began_s = lost, controller.now_s
        waits = graph.waits
        planned = program.says()
        planned_s = seconds(planned.points[-1].time_from_start)
        if stamp_s := seconds(planned.header.stamp):
            planned_s += stamp_s - began_s
        controller.stands()
        starved_s = graph.starved_s(waits)
        assert program.lost == 0
        at_s, found = controller.speeds(began_s - 0.05)
        found = found * np.sign(speed)
        no_jump(found > -0.05, "it hardly goes back")
        stood_s = at_s[np.max(found, axis=1) > 1e-3][-1] - began_s
        assert stood_s < 1.5 * planned_s + starved_s

    for lost in (1, 2):
        graph.undisturbed(partial(stops, lost))


@on(Program, False)
def test_a_corrected_motion_follows_the_speed_scaling(program):
    controller = program.controller

    def scaled() -> None:
        speed, end = program.drives()
        began_s = controller.now_s
        for factor, for_s in ((0.5, 0.3), (0.1, 0.5), (0.0, amount(1.5, 10.0)), (0.2, 0.5)):
            controller.scale(factor)
            controller.graph.spin_for(for_s)
        controller.scale(1.0)
        assert controller.stands() == pytest.approx(end, abs=1e-6)
        _, found = controller.speeds(began_s)
        no_jump(found * np.sign(speed) > -1e-6, "nothing goes back")
        assert program.status[-1].state == CorrectionStatus.ON

    def stops() -> None:
        controller.scale(1.0)
        speed, end = program.drives()
        controller.scale(0.5)
        began_s = controller.now_s
        program.says()
        stands = controller.stands()
        assert np.abs(stands - end)[0] > 0.5 * SPEED[0]
        _, found = controller.speeds(began_s)
        no_jump(found * np.sign(speed) > -0.05, "it hardly goes back")

    program.graph.undisturbed(scaled)
    program.graph.undisturbed(stops)


@on(ByAction, False)
def test_a_corrected_goal_follows_the_speed_scaling_and_outlasts_a_pause(program):
    controller = program.controller

    def scaled() -> None:
        controller.scale(1.0)
        start = program.shown
        speed = SPEED if start[0] < HOME[0] + SPEED[0] else -SPEED
        points, began_s = motion(start, speed), controller.now_s
        handle = controller.goal(trajectory(points))
        controller.moved(0.1, start)
        for factor, for_s in ((0.5, 0.3), (0.1, 0.5), (0.0, amount(1.5, 10.0)), (0.2, 0.5)):
            controller.scale(factor)
            controller.graph.spin_for(for_s)
        controller.scale(1.0)
        assert controller.end(handle) == (GoalStatus.STATUS_SUCCEEDED, 0)
        controller.stands()
        assert program.shown == pytest.approx(points[-1][1], abs=1e-6)
        assert np.max(np.abs(controller.q - program.shown)) > 1e-5  # it is corrected
        _, found = controller.speeds(began_s)
        no_jump(found * np.sign(speed) > -1e-6, "nothing goes back")
        assert program.status[-1].state == CorrectionStatus.ON

    program.graph.undisturbed(scaled)


@on(Program, False)
def test_a_point_at_time_0_goes_out_only_where_the_robot_is(program):
    """A controller would step there in one cycle."""
    controller = program.controller
    _, end = program.drives()
    assert controller.stands() == pytest.approx(end, abs=1e-6)
    count, began_s = len(program.sent), controller.now_s
    taught = HOME + 3.0 * SPEED
    program.says((0.0, taught, 0.0 * SPEED), (1.0, taught, 0.0 * SPEED))
    assert controller.stands() == pytest.approx(end, abs=1e-4)
    program._planner.publish(trajectory([(0.0, HOME), (1.0, HOME)]))
    controller.graph.spin_until(lambda: program.status[-1].mismatch, "it is refused")
    assert len(program.sent) == count + 1
    _, found = controller.speeds(began_s)
    no_jump(np.abs(found) < 0.05, "no step")
