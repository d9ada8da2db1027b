# SPDX-License-Identifier: Apache-2.0
"""Measuring cycles over DDS, and everything that may go wrong with them."""

import resource
from typing import Any

import numpy as np
import pytest
from cell import Cell
from robocal_msgs.msg import AccuracyState
from sensor_msgs.msg import Temperature
from shift import NS, Shift, built, knocked, of_kind, postures, warmed

from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import JointSample
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros.conversions import time_message
from robocal_ros.thermal.drift_following import ThermalConfig

POSES = 6
WARM_K = 15.0


class Robot:
    """The simulated robot before its sensor; time runs on in its own shift."""

    def __init__(self) -> None:
        self.nominal = load_robot("kr150_r3100")
        self.shift = Shift(self.nominal.joint_names)
        self.cold, self.q = built(self.nominal), postures(self.nominal, POSES)

    def visit(
        self, kelvin: float = 0.0, poses: slice = slice(None), after_h: float = 0.0
    ) -> list[Any]:
        return list(self.shift.visit(warmed(self.cold, kelvin), self.q[poses], after_h))


@pytest.fixture
def robot() -> Robot:
    return Robot()


def commissioned(graph: Any, robot: Robot, *, apart: bool = False) -> Cell:
    """A node with a cold reference."""
    made = Cell(graph, apart=apart)
    made.play(robot.visit())
    captured = made.call("capture_reference")
    assert captured.success, captured.message
    return made


@pytest.fixture
def cell(graph, robot) -> Cell:
    return commissioned(graph, robot)


def end(cell: Cell, cycle_id: str = "") -> Any:
    return cell.call("end_cycle", cycle_id=cycle_id)


def production(cell: Cell, robot: Robot) -> None:
    """Two hours pass: a cycle that was begun before them would end by itself."""
    cell.play(robot.visit(WARM_K, slice(2), after_h=2.0))


def accuracy(cell: Cell, state: int, words: str = "") -> AccuracyState:
    """Wait until the node says so of itself."""

    def there() -> bool:
        last = cell.accuracies[-1] if cell.accuracies else None
        return last is not None and last.state == state and words in last.reason

    cell.graph.spin_until(there, f"accuracy is {state} {words}")
    return cell.accuracies[-1]


def test_a_shift_of_cycles(cell, robot):
    """Bracketed by the robot's program; every call may come twice."""
    for number, kelvin in enumerate((8.0, 15.0), start=1):
        name = f"c{number}"
        cell.play(robot.visit(kelvin, slice(2), after_h=2.0))  # production passes by
        for _ in range(2):
            begun = cell.call("begin_cycle", cycle_id=name)
            assert (begun.success, begun.cycle_id) == (True, name), begun.message
        cell.play(robot.visit(kelvin))
        first, second = end(cell, name), end(cell, name)
        assert (first.success, first.status) == (True, Code.ACCEPT), first.message
        assert (first.visited, list(first.missing)) == (POSES, [])
        assert (second.candidate_id, second.status) == (first.candidate_id, first.status)
        accepted = cell.call("accept", id=first.candidate_id, by="plc")
        assert accepted.success, accepted.message
    said = accuracy(cell, AccuracyState.OK)
    assert 0.0 < said.predicted_error_mm < said.bound_mm < said.tolerance_mm
    assert said.due_in_s > 0.0
    assert (said.serial, said.robot, said.header.frame_id) == ("s1", robot.nominal.name, "base")
    recorded = [e.command for e in cell.events if e.command != "configure"]
    assert recorded == ["capture_reference", *(["begin_cycle", "end_cycle", "accept"] * 2)]


def test_triggers_of_a_plc(cell, robot):
    production(cell, robot)
    begun = cell.call("begin_cycle_trigger")
    assert begun.success
    assert begun.message.startswith("0 ACCEPT cycle '")
    cell.play(robot.visit(WARM_K))
    ended = cell.call("end_cycle_trigger")
    assert ended.success
    assert ended.message.startswith("2 ACCEPT ")


def test_missing_poses(cell, robot):
    production(cell, robot)
    cell.call("begin_cycle", cycle_id="c1")
    cell.play(robot.visit(WARM_K, slice(1, 5)))
    cell.graph.spin_until(
        lambda: cell.value("cycle") == "'c1' open, 4 of 6 poses measured", "progress is shown"
    )
    found = end(cell, "c1")
    assert (found.visited, list(found.missing)) == (4, [1, 6])
    assert found.success
    cell.call("begin_cycle", cycle_id="c2")
    cell.play(robot.visit(WARM_K, slice(1)))
    refused = end(cell, "c2")
    assert (refused.success, refused.status) == (False, Code.TOO_FEW_SAMPLES)
    cell.play(robot.visit(WARM_K, slice(1, None)))  # the rest is measured after all
    assert end(cell, "c2").visited == POSES


def test_a_cycle_that_nobody_ends(cell, robot):
    cell.play(robot.visit(WARM_K, after_h=2.0))
    robot.shift.now_ns += round((ThermalConfig().cycle_timeout_s + 1.0) * NS)
    cell.play(of_kind(robot.visit(WARM_K, slice(1)), JointSample))
    cell.graph.spin_until(lambda: cell.qualities, "it ends by itself")
    assert (cell.qualities[-1].accept, cell.qualities[-1].samples) == (True, POSES)


def test_a_knocked_sensor(graph, cell, robot):
    cell.play(robot.visit(WARM_K, after_h=2.0))
    first = end(cell, "c1")
    assert cell.call("accept", id=first.candidate_id).success
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the model is in force")
    cell.play(knocked(robot.visit(WARM_K)))
    refused = end(cell, "c2")
    assert refused.status == Code.SENSOR_OR_ROBOT_MOVED
    decide = "reference_sphere_center, would decide"
    assert decide in refused.message
    accuracy(cell, AccuracyState.FAULT, decide)
    assert cell.models[-1].revision == 1
    denied = cell.call("accept", id=refused.candidate_id)
    assert denied.status == Code.SENSOR_OR_ROBOT_MOVED
    cell.play(robot.visit(WARM_K))  # put back
    assert end(cell, "c3").status != Code.SENSOR_OR_ROBOT_MOVED
    accuracy(cell, AccuracyState.OK)


def test_a_clock_that_jumps(cell, robot):
    """Back by an hour in mid-cycle: what an earlier clock stamped is dropped, and said so."""
    production(cell, robot)
    cell.call("begin_cycle", cycle_id="c1")
    cell.play(robot.visit(WARM_K, slice(3)))
    robot.shift.now_ns -= 3600 * NS
    cell.play(robot.visit(WARM_K))
    found = end(cell, "c1")
    assert (found.success, found.visited) == (True, POSES), found.message
    cell.graph.spin_until(
        lambda: any("clock jumped back" in v.key for v in getattr(cell.status(), "values", [])),
        "it is said",
    )
    robot.shift.now_ns += 24 * 3600 * NS
    cell.play(robot.visit(WARM_K))
    assert end(cell, "c2").visited == POSES


def test_a_full_disk(graph, robot):
    """Nothing is lost, nothing is half-written, and the same call works once there is room."""
    cell = commissioned(graph, robot, apart=True)
    production(cell, robot)
    cell.call("begin_cycle", cycle_id="c1")
    cell.play(robot.visit(WARM_K))
    pid, limit = cell.process.process.pid, resource.RLIMIT_FSIZE
    resource.prlimit(pid, limit, (1, resource.RLIM_INFINITY))
    refused = end(cell, "c1")
    assert (refused.success, refused.status) == (False, Code.STORAGE_FAILED)
    assert "free" in refused.message
    resource.prlimit(pid, limit, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    found = end(cell, "c1")
    assert (found.status, found.visited) == (Code.ACCEPT, POSES), found.message
    listed = cell.call("list").calibrations
    assert [c.kind for c in listed] == ["thermal", "reference"]


def test_a_restart_in_mid_cycle(graph, robot):
    """Killed: what is in force stays, the rest of the cycle is used, what was ended is known."""
    cell = commissioned(graph, robot, apart=True)
    cell.play(robot.visit(WARM_K, after_h=2.0))
    first = end(cell, "c1")
    assert cell.call("accept", id=first.candidate_id).success
    graph.spin_until(lambda: cell.models[-1].revision == 1, "the model is in force")
    before = cell.models[-1]
    cell.call("begin_cycle", cycle_id="c2")
    cell.play(robot.visit(WARM_K, slice(2)))
    cell.process.kill()
    cell.accuracies.clear()
    cell.start()
    assert cell.models[-1] == before
    cell.play(robot.visit(WARM_K, slice(2, None)))
    second = end(cell, "c2")
    assert (second.visited, list(second.missing)) == (POSES - 2, [1, 2])
    again = end(cell, "c1")
    assert (again.candidate_id, again.status) == (first.candidate_id, Code.ACCEPT)
    accuracy(cell, AccuracyState.OK)


def test_a_start_before_any_clock(graph, robot):
    """Simulated time that has not begun, a reference, no model: told, and the node lives on."""
    cell = commissioned(graph, robot, apart=True)
    cell.process.kill()
    cell.accuracies.clear()
    cell.parameters = cell.parameters | {"use_sim_time": True}
    cell.start()
    graph.spin_until(lambda: len(cell.accuracies) > 1, "accuracy is told")
    assert np.isfinite(cell.accuracies[-1].predicted_error_mm)
    assert cell.process.process.poll() is None


def test_silent_and_wrong_temperatures(cell, graph, robot):
    """An optional input does no harm, whatever comes of it; what cannot be used is said."""
    temperatures = graph.publisher(Temperature, "/motor_temperatures")
    for name, value in (("joint_a1", 30.0), ("gearbox", 30.0), ("joint_a2", float("nan"))):
        message = Temperature(temperature=value)
        message.header.frame_id = name
        message.header.stamp = time_message(robot.shift.now_ns)
        temperatures.publish(message)
    graph.spin_until(
        lambda: any("gearbox" in v.value for v in getattr(cell.status(), "values", [])),
        "it is said",
    )
    cell.play(robot.visit(WARM_K, after_h=2.0))
    assert end(cell, "c1").status == Code.ACCEPT
