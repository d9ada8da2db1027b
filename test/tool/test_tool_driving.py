# SPDX-License-Identifier: Apache-2.0
"""A session's steps driven as joint motions: by a simulated robot that follows what it is sent."""

import numpy as np
import pytest
from driven_robot import LAG_S, PERIOD_S, AheadMotion, Robot
from long_form import more
from tool_driver import TAUGHT, TRUTH

from robocal_ros.cell_sim.beams import bent, joints_at
from robocal_ros.cell_sim.faults import Faults
from robocal_ros.ground import frames
from robocal_ros.ground.errors import Code, ConflictError
from robocal_ros.motion.plan import MotionLimits
from robocal_ros.session.events import MEASURE_TOOL, Command, Outcome
from robocal_ros.tool.driving import DrivePhase
from robocal_ros.tool.edges import EdgeSample
from robocal_ros.tool.judging import KnownTool


@pytest.fixture
def robot(history) -> Robot:
    made = Robot(history)
    made.run(0.4)
    return made


def test_a_whole_run_is_driven_and_then_disarmed(robot, history):
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(60.0, until=robot.at_rest)
    last = robot.outcomes[-1]
    assert last.status is Code.ACCEPT, last.message
    found = KnownTool.of_document(history.model(last.calibration_id))
    away = found.T_flange_tool[:3, 3] - TRUTH[:3, 3]
    assert away @ np.linalg.solve(found.covariance[:3, :3], away) < 16.3  # chi-square, 1e-3
    assert robot.driver.phase is DrivePhase.IDLE
    assert robot.driver.told == "the run has ended"
    assert len(robot.sent) == 10  # a way and a motion for each of five steps


# Across the flange, so that the tool lies above the housing while it stands in the beams.
ACROSS = frames.exp_rotation(np.radians([-85.0, 0.0, 0.0]))
MANDREL = frames.transform(ACROSS, 0.17 * ACROSS[:, 2] + [0.0, 0.0, 0.04])


def with_mandrel(history, mandrel) -> Robot:
    made = Robot(history, TAUGHT, mandrel)
    made.run(0.5)
    return made


def driven(robot, mode) -> Outcome:
    robot.driver.arm(robot.now_s)
    robot.measure(mode)
    robot.run(100.0, until=robot.at_rest)
    robot.run(0.5)
    return robot.outcomes[-1]


def test_a_mandrel_is_driven_through_the_beams_and_tells_of_a_knock(history):
    robot = with_mandrel(history, MANDREL)
    assert driven(robot, "witness reference").status is Code.ACCEPT
    before, station = robot.cell.station.beams[0].start, robot.cell.station
    robot.cell.station = Faults({"station_knocked_shift": 8e-4}, 1).station(station)
    found = driven(robot, "witness")
    assert found.status is Code.STATION_MOVED, found.message
    moved = robot.cell.station.beams[0].start - before
    off_mm = np.array(found.document["station_shift_mm"]) - 1e3 * moved
    assert np.all(np.abs(off_mm) < 4.0 * np.array(found.document["sigma_mm"]))


@pytest.mark.parametrize("tells", [False, *more(True)])
@pytest.mark.parametrize("mode", ["laser", *more("witness reference")])
def test_a_mandrel_is_measured_by_a_robot_that_is_slow_and_pauses(history, mode, tells):
    """On a way of 23 s as it is planned: longer than a step may have no edge."""
    robot = with_mandrel(history, MANDREL)
    robot.speed, robot.tells = 0.5, tells
    robot.driver.arm(robot.now_s)
    robot.measure(mode)
    for phase in (DrivePhase.APPROACH, DrivePhase.MEASURE):
        robot.run(100.0, until=lambda p=phase: robot.driver.phase is p)
        robot.run(0.4)
        robot.speed = 0.0
        robot.run(10.0)
        assert robot.driver.phase is phase
        robot.speed = 1.0
    robot.run(300.0, until=robot.at_rest)
    assert robot.outcomes[-1].status is Code.ACCEPT, robot.outcomes[-1].message


@pytest.mark.parametrize("mode", ["full", "witness reference"])
def test_what_hangs_beside_what_is_measured_must_be_clear_of_the_housing(history, mode):
    """Straight down, 80 mm beside the tool: the other one would go into the housing's wall."""
    robot = with_mandrel(history, bent(TAUGHT, [0.08, 0.0, 0.0], [0.0, 0.0, 0.0]))
    found = driven(robot, mode)
    other = "mandrel" if mode == "full" else "tool"
    assert found.status is Code.LIMIT_EXCEEDED
    assert f"the {other}, with" in found.message
    assert robot.sent == []


def test_speeds_stay_within_the_limits(robot):
    robot.driver.arm(robot.now_s)
    robot.measure("quick")
    robot.run(40.0, until=robot.at_rest)
    path = np.array(robot.path)
    rate = np.diff(path, axis=0) / PERIOD_S
    limits = MotionLimits()
    assert np.abs(rate).max() <= limits.joint_velocity
    tip = (robot.cell.arm.fk(path) @ np.append(TAUGHT[:3, 3], 1.0))[:, :3]
    speed = np.linalg.norm(np.diff(tip, axis=0), axis=1) / PERIOD_S
    assert speed.max() <= limits.tcp_speed_m_s * (1.0 + 1e-6)


def test_nothing_moves_before_it_is_armed(robot):
    with pytest.raises(ConflictError, match="not armed"):
        robot.measure()
    robot.ask(Command(MEASURE_TOOL, {"mode": "full"}))
    robot.run(1.0)
    assert robot.sent == []


def test_it_disarms_itself_after_a_while(robot):
    robot.driver.arm(robot.now_s)
    robot.run(59.5)
    assert robot.driver.armed
    robot.run(1.0)
    assert not robot.driver.armed
    assert "no run within 60 s" in robot.driver.told


def test_no_step_begins_on_a_heartbeat_from_before_a_pause(robot):
    """Readings that waited all through it are taken before anything else."""
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(1.0, until=lambda: robot.driver.phase is DrivePhase.APPROACH)
    robot.run(0.1)
    robot.beating = False
    robot.now_s += robot.sent[-1][1].duration_s + 1.0  # the way to the step is over meanwhile
    robot.run(0.5)
    assert len(robot.sent) == 2
    stopped(robot, "gap_open is silent", follows=False)


def test_a_closed_gap_is_not_armed_in(robot):
    robot.gap.heard(False, robot.gap.beat, robot.now_s)
    with pytest.raises(ConflictError, match="gap_open is false: nothing may move"):
        robot.driver.arm(robot.now_s)


def stopped(robot, words, *, follows=True):
    """The robot was sent a stop, stands still within its time, and the run has ended."""
    at_s, plan = robot.sent[-1]
    assert plan.duration_s <= 0.13  # 1 rad/s by 10 rad/s^2, or the shortest stop
    if follows:
        slows_down(robot, at_s, plan)
    assert np.all(plan.qd[-1] == 0.0)
    assert robot.now_s > at_s + plan.duration_s + LAG_S + 0.1
    assert robot.stands_still(at_s + plan.duration_s + LAG_S + PERIOD_S)
    assert not robot.driver.armed
    assert words in robot.driver.told
    assert robot.session.run is None


def slows_down(robot, at_s, plan):
    """No joint is thrown back, and none decelerates by more than three times an even stop.

    A cubic's peak is 1.5 times its mean; the lag of the controller does the rest.
    """
    path = np.array(robot.path)
    rate = np.diff(path, axis=0) / PERIOD_S
    first = round(at_s / PERIOD_S)
    before, after = rate[first - 2], rate[first : first + 25]
    assert np.all(after * np.sign(before) > -0.05 * np.max(np.abs(before)))
    hardest = np.max(np.abs(np.diff(rate[first - 2 : first + 25], axis=0))) / PERIOD_S
    assert hardest < 3.0 * np.max(np.abs(before)) / plan.duration_s


def driving(robot, phase, for_s=0.4):
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(20.0, until=lambda: robot.driver.phase is phase)
    robot.run(for_s)
    assert robot.driver.phase is phase


@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_silent_joint_states_stop_it(robot, phase):
    driving(robot, phase)
    at_s = robot.now_s
    robot.silent = True
    robot.run(0.15)
    assert robot.sent[-1][0] - at_s <= 0.1 + 2 * PERIOD_S
    robot.silent = False
    robot.run(0.5)
    stopped(robot, "joint states are silent")


@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_a_stop_after_a_suspend_begins_where_the_robot_stands(robot, phase):
    """Host and controller slept in the middle of a motion."""
    driving(robot, phase)
    q = robot.q.copy()
    robot.now_s += 3600.0
    robot.driver.slept(3600.0)
    robot.driver.tick(robot.now_s)
    at_s, plan = robot.sent[-1]
    assert at_s == robot.now_s
    assert np.max(np.abs(plan.q[0] - q)) <= MotionLimits().joint_velocity * (LAG_S + PERIOD_S)
    assert "gap_open is silent" in robot.driver.told


def test_a_break_on_the_way_stops_it(robot):
    driving(robot, DrivePhase.APPROACH, 0.6)
    robot.edges.insert(0, EdgeSample(robot.ns(robot.now_s), "", "x", True, 1e-4))
    robot.run(0.5)
    stopped(robot, "a beam was broken on the way")


def test_a_deviation_from_the_plan_stops_it(robot):
    driving(robot, DrivePhase.MEASURE)
    robot.offset[4] = np.radians(1.0)
    robot.run(0.5)
    stopped(robot, "deg away from its plan", follows=False)  # its readings are not where it is


@pytest.mark.parametrize("wild_rad", [0.05, -1.0, 1e307])
def test_one_wild_reading_stops_it_where_it_is(robot, wild_rad):
    driving(robot, DrivePhase.MEASURE)
    robot.offset[4] = wild_rad
    robot.step()
    robot.offset[4] = 0.0
    q = robot.q.copy()
    at_s, plan = robot.sent[-1]
    assert at_s == robot.now_s
    assert np.max(np.abs(plan.q[0] - q)) <= MotionLimits().joint_velocity * PERIOD_S
    robot.run(0.5)
    stopped(robot, "away from its plan", follows=False)  # the readings lag behind the plan
    assert np.max(np.abs(robot.q - q)) <= 0.5 * MotionLimits().joint_velocity * 0.12


def test_a_cancel_stops_it(robot):
    driving(robot, DrivePhase.MEASURE)
    robot.ask(Command("break_off", {"reason": "cancelled"}))
    robot.run(0.5)
    stopped(robot, "cancelled")


def test_disarming_stops_it(robot):
    driving(robot, DrivePhase.APPROACH, 0.6)
    robot.driver.disarm("disarmed by the operator", robot.now_s)
    robot.run(0.5)
    stopped(robot, "disarmed by the operator")


def test_a_robot_without_a_way_is_refused_before_anything_is_sent(history):
    robot = Robot(history)
    beside = robot.cell.pose(TAUGHT, 0.0)
    beside[:3, 3] += [0.1, 0.0, 0.0]
    robot.motion = AheadMotion(joints_at(robot.cell.arm, beside[None], robot.cell.q_near)[0])
    robot.run(0.4)
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(0.5)
    assert robot.sent == []
    assert robot.outcomes[-1].status is Code.LIMIT_EXCEEDED
    assert not robot.outcomes[-1].left_plan
    assert "housing" in robot.driver.told


@pytest.mark.parametrize("phase", [DrivePhase.APPROACH, DrivePhase.MEASURE])
def test_a_robot_that_is_held_has_left_its_plan(robot, phase):
    driving(robot, phase)
    robot.motion = AheadMotion(robot.q)
    robot.edges.clear()
    robot.run(10.0)
    assert robot.driver.armed  # it may pause, and nobody tells
    assert "behind its plan, on its path" in robot.driver.trouble(robot.now_s)
    robot.run(10.0, until=lambda: not robot.driver.armed)
    last = robot.outcomes[-1]
    assert (last.status, last.left_plan) == (Code.LIMIT_EXCEEDED, True)
    assert "has not come further on its path" in last.message


@pytest.mark.parametrize("dead", ["tool", "beams"])
def test_a_step_without_an_edge_is_told_as_that(history, dead):
    """Nothing is mounted that could break a beam, or nothing tells that it is broken."""
    robot = Robot(history, bent(TAUGHT, TAUGHT[:3, 2] * -0.03, np.zeros(3)))
    if dead == "beams":
        robot = Robot(history)
        robot.deaf = True
    robot.run(0.4)
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(30.0, until=lambda: not robot.driver.armed)
    last = robot.outcomes[-1]
    assert (last.status, last.left_plan) == (Code.BEAM_EDGES_WRONG, False)
    assert "no edge came" in last.message


def test_a_tool_bent_beyond_the_circle_stops_the_run(history):
    robot = Robot(history, bent(TAUGHT, [0.012, 0.0, 0.0], [0.0, 0.0, 0.0]))
    robot.run(0.4)
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.run(30.0, until=lambda: not robot.driver.armed)
    assert robot.outcomes[-1].status is Code.BEAM_EDGES_WRONG
    assert robot.session.run is None


def test_a_disarmed_run_does_not_wait_to_be_armed_again(robot):
    robot.driver.arm(robot.now_s)
    robot.measure()
    robot.driver.disarm("disarmed by the operator", robot.now_s)
    assert robot.session.run is None
    robot.ask(Command(MEASURE_TOOL, {"mode": "full"}))
    with pytest.raises(ConflictError, match="a run is open"):
        robot.driver.arm(robot.now_s)


def test_a_robot_that_somebody_jogs_is_not_taken_over(robot):
    robot.driver.arm(robot.now_s)
    q, until = robot.q, robot.now_s + 1.0
    robot.motion.follow(robot.now_s, [until - 0.5, until], np.array([q + 0.02, q]))
    robot.run(0.7)
    with pytest.raises(ConflictError, match="the robot moves"):
        robot.measure()


def test_an_armed_robot_that_falls_silent_is_disarmed(robot):
    robot.driver.arm(robot.now_s)
    robot.silent = True
    robot.run(1.5)
    assert not robot.driver.armed


def test_a_clock_that_jumps_back_still_ends_in_a_stop_that_slows_down(robot):
    driving(robot, DrivePhase.MEASURE)
    q = robot.q + robot.offset
    robot.driver.reading(robot.now_s - 3600.0, q, robot.now_s)
    robot.driver.disarm("the clock jumped", robot.now_s)
    at_s, plan = robot.sent[-1]
    assert at_s == robot.now_s
    assert np.max(np.abs(plan.qd[0])) > 0.01  # as it moves, not at rest
