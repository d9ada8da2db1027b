# SPDX-License-Identifier: Apache-2.0
"""What the controller tells the joint correction node, and what that tells of time. Over DDS."""

import time
from typing import Any

import numpy as np
from joint_correction_live import (
    HOME,
    NAMES,
    NODE,
    Line,
    drifted,
    joints,
    model_message,
    trajectory,
)
from robocal_msgs.msg import JointOffset
from std_msgs.msg import Float64
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectoryPoint

from robocal_ros.ros import conversions


def controller_state(q: Any, scaling: float) -> Any:
    from control_msgs.msg import JointTrajectoryControllerState

    state = JointTrajectoryControllerState(joint_names=NAMES, speed_scaling_factor=scaling)
    state.reference = JointTrajectoryPoint(positions=list(q))
    return state


def test_a_command_begins_where_the_controller_is_though_the_robot_lags(graph: Any) -> None:
    line = Line(graph)
    ahead = HOME + 0.005
    line.rest()
    line.refused(line.to_target, joints(ahead), "joint_targets")
    assert graph.call(Trigger, f"{NODE}/acknowledge").success
    state = controller_state(ahead, 1.0)
    told = graph.publisher(type(state), "controller_state")
    graph.probe.create_timer(0.02, lambda: told.publish(state))
    count = line.node.inputs["controller_state"]
    graph.spin_until(lambda: count.received > 3, "the controller's state")
    assert list(line.target(ahead).position) == ahead.tolist()


def path_time(line: Line) -> float:
    path = line.node._session.output.path
    assert path is not None
    return float(path.time(time.monotonic()))


def test_the_offset_waits_while_the_controller_says_that_it_is_halted(graph: Any) -> None:
    """A correction that comes in along a trajectory waits with the controller's clock."""
    line, told = Line(graph, offset_deg_s=0.01), [1.0]
    states = graph.publisher(type(controller_state(HOME, 1.0)), "controller_state")
    graph.probe.create_timer(0.1, lambda: states.publish(controller_state(HOME, told[0])))

    def say(scaling: float) -> None:
        told[0], robot = scaling, line.node._session.robot
        line.graph.spin_until(lambda: robot.scaling == scaling, f"scaled to {scaling}")

    line.target()
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.enable()
    say(1.0)
    line.rest()
    line.to_path.publish(trajectory(np.stack([HOME, HOME]), np.array([0.1, 6.1])))
    line.wait(line.paths)
    line.graph.spin_until(lambda: path_time(line) > 0.3, "it runs")
    say(0.0)
    paused_s = path_time(line)

    def latest(count: int) -> np.ndarray:
        line.offsets.clear()

        def periodic() -> list[JointOffset]:
            return [o for o in line.offsets if o.cause == JointOffset.PERIODIC]

        line.graph.spin_until(lambda: len(periodic()) >= count, "offsets")
        return np.array([o.withheld for o in periodic()])

    halted = latest(6)[1:]  # the first may have been on its way
    assert np.abs(halted[0]).max() > 1e-6  # it is on its way
    assert np.ptp(halted, axis=0).max() == 0.0
    assert abs(path_time(line) - paused_s) < 1e-9
    say(0.5)
    begin_s, begin = time.monotonic(), path_time(line)
    line.graph.spin_for(0.3)
    passed, elapsed = path_time(line) - begin, time.monotonic() - begin_s
    assert abs(passed - 0.5 * elapsed) < 0.1 * elapsed
    say(1.0)
    line.graph.spin_until(lambda: np.abs(latest(1)).max() < 1e-9, "the whole offset")


def test_a_slider_in_percent_scales_too_and_one_that_dies_at_zero_is_forgotten(graph: Any) -> None:
    """Finding: its last word was believed for ever, and the path never ended."""
    line = Line(graph)
    line.rest()
    slider = graph.publisher(Float64, "speed_scaling")
    line.to_path.publish(trajectory(np.stack([HOME, HOME]), np.array([0.1, 1.1])))
    line.wait(line.paths)
    for percent in (100.0, 50.0, 0.0):
        line.take(Float64(data=percent), slider, "speed_scaling")
        assert line.node._session.robot.scaling == 0.01 * percent
    graph.spin_until(lambda: line.node._session.robot.scaling == 1.0, "it is forgotten", 3.0)
    path = line.node._session.output.path
    graph.spin_until(lambda: not path.live(time.monotonic()), "the path ends", 3.0)


def test_hostile_states_and_scalings_end_nothing(graph: Any) -> None:
    line = Line(graph)
    state = controller_state(HOME, 1.0)
    told, slider = graph.publisher(type(state), "controller_state"), graph.publisher(
        Float64, "speed_scaling"
    )  # fmt: skip
    for names, positions, scaling in (
        ([], [], np.nan),
        (NAMES, [], np.inf),
        (NAMES, [np.nan] * 6, -1.0),
        (["gripper"], [0.1], 1.0),
        ([NAMES[0]] * 6, [0.1] * 6, 1.0),
        (NAMES, [0.1] * 3, 1.0),
        (NAMES[:2], [9.9] * 6, 1e300),
    ):
        strange = controller_state([], scaling)
        strange.joint_names, strange.reference.positions = names, positions
        line.take(strange, told, "controller_state")
        line.take(Float64(data=scaling), slider, "speed_scaling")
    line.rest()
    assert list(line.target().position) == HOME.tolist()


def test_what_was_overtaken_is_counted_and_ends_nothing(graph: Any) -> None:
    line = Line(graph)
    now = time.time_ns()
    line.target(header=conversions.header(now, ""))
    late = joints(HOME, header=conversions.header(now - 4_000_000, ""))
    line.refused(line.to_target, late, "joint_targets")
    line.told(overtaken=1)
    line.target(header=conversions.header(now + 4_000_000, ""))


def test_a_stream_that_is_faster_than_the_robot_may_be_is_told_to_lag(graph: Any) -> None:
    speed = 0.1
    line = Line(graph, velocity_limits=[speed] * 6)
    begin_s = begin = 0.0

    def stream() -> None:
        q = HOME.copy()
        q[0] = begin + 1.04 * speed * (time.monotonic() - begin_s)
        line.stand()
        line.to_target.publish(joints(q))
        if line.targets:
            line.at = line.targets[-1].position

    def lags() -> list[float]:
        return [status.lag_s for status in line.statuses if status.lag_s > 0.02]

    count, refused = line.node.inputs["joint_targets"], 0
    for _ in range(10):  # a stream that this machine holds up is ended
        line.rest()
        line.target(line.at)
        line.statuses.clear()
        begin_s, begin = time.monotonic(), line.at[0]
        timer = graph.probe.create_timer(0.02, stream)
        graph.spin_until(lambda: lags() or count.invalid > refused, "the lag is told")  # noqa: B023
        graph.probe.destroy_timer(timer)
        if lags():
            break
        line.rest()
        graph.call(Trigger, f"{NODE}/acknowledge")
        refused = count.invalid
    assert 0.0 < max(lags(), default=0.0) < 0.11
