"""The way from where the robot is to the first point of a trajectory."""

import copy
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest
from correction_robot import HOME, NAMES, REST, Robot, bent_tool, drifted, offer, refused, still

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import Reason, TrajectoryCommand

LIMIT = 1.0
NEAR = CorrectionConfig().start_rad
ADDED = np.radians(1.0)  # more than a correction changes the way
ONE = np.array([0.0, -1.0, 0.0, 0.0, 0.0, 0.0])


def standing(on: bool, **config: object) -> Robot:
    robot = Robot(velocity_limits=np.full(6, LIMIT), **config)
    if on:
        robot.session.offer_model(offer(drifted()))
        robot.session.offer_tool(bent_tool())
        robot.session.enable(True)
        robot.settle()
    robot.rest()
    return robot


def to(q: np.ndarray, lead_s: float, rates: bool = False) -> TrajectoryCommand:
    """Rests at ``q`` from then on."""
    path = still(q, first_s=lead_s)
    return replace(path, velocity=np.zeros(path.position.shape)) if rates else path


@pytest.mark.parametrize("on", [False, True])
@pytest.mark.parametrize("rates", [False, True])
def test_a_lead_in_obeys_the_velocity_limits(on: bool, rates: bool) -> None:
    """Held against what a controller does: it draws a line, or a curve from rest to rest."""
    at_rest, rng = standing(on), np.random.default_rng(5)
    peak = 1.875 if rates else 1.0  # of a quintic
    seen = Counter[bool]()
    for _ in range(60):
        robot = copy.deepcopy(at_rest)
        command = to(HOME + rng.uniform(-0.4, 0.4, 6), rng.uniform(0.1, 1.0), rates)
        lead_s = command.time_from_start_s[0]
        way = np.abs(command.position[0] - HOME).max()
        slow, fast = peak * (way + ADDED) / lead_s < LIMIT, peak * (way - ADDED) / lead_s > LIMIT
        seen[slow] += slow or fast
        if fast:
            refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, command, robot.now)
        elif slow:
            robot.session.trajectory(command, robot.now)
    assert min(seen[True], seen[False]) > 5


def test_a_lead_in_is_refused_with_its_joint_and_speed() -> None:
    robot = standing(True)
    words = refused(
        Reason.VELOCITY_LIMIT, robot.session.trajectory, to(HOME + 0.5 * ONE, 0.25), robot.now
    )
    assert NAMES[1] in words
    assert "(point 1)" in words
    robot.session.trajectory(to(HOME + 0.5 * ONE, 0.25), robot.now, 0.5)  # half a second more


def test_clamped_or_passed_it_is_refused_all_the_same() -> None:
    for policy in ("clamp", "pass"):
        robot = standing(False, policy=policy)
        act = robot.session.trajectory
        refused(Reason.VELOCITY_LIMIT, act, to(HOME + 0.5 * ONE, 0.25), robot.now)


def test_a_robot_that_stands_at_the_first_point_need_not_move() -> None:
    """A clock that is ahead by microseconds makes every trajectory lead in."""
    robot = standing(False)
    robot.at = HOME + 0.9 * NEAR
    robot.rest()
    assert np.array_equal(robot.session.trajectory(to(HOME, 1e-5), robot.now).position[0], HOME)


def test_single_points_to_a_robot_that_lags() -> None:
    """A planner that sends the next point 20 ms ahead, again and again; the robot is 0.1 s late."""
    robot, dt, speed = standing(False), 0.02, 0.8
    sent = [HOME] * 6
    for i in range(80):
        robot.now += dt
        robot.read(sent[-6])
        q = sent[-1] + min(1.0, i / 25) * speed * dt * ONE
        command = TrajectoryCommand(NAMES, q[None], np.array([dt]))
        sent.append(robot.session.trajectory(command, robot.now).position[0])
    robot.now += dt
    robot.read(sent[-6])
    far = TrajectoryCommand(NAMES, (sent[-1] + 1.5 * LIMIT * dt * ONE)[None], np.array([dt]))
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, far, robot.now)


def test_what_was_rejected_is_no_place_to_lead_from() -> None:
    """The robot stands at home, and not where a trajectory should have brought it."""
    robot = standing(False)
    robot.session.trajectory(to(HOME + 0.3 * ONE, 0.5), robot.now)
    robot.rest(0.6)
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, to(HOME + 0.3 * ONE, 0.05), robot.now)


def test_a_part_of_the_joints_leads_in_alone() -> None:
    robot = standing(False)
    path = still(HOME + 0.5 * ONE, first_s=0.25)
    part = replace(path, names=NAMES[:1], position=path.position[:, :1])
    robot.session.trajectory(part, robot.now)
    part = replace(path, names=NAMES[1:2], position=path.position[:, 1:2])
    refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, part, robot.now)


@pytest.mark.parametrize("on", [False, True])
def test_a_lead_in_needs_readings_that_are_fresh(on: bool) -> None:
    robot = standing(on)
    robot.now += 0.3
    refused(Reason.STALE_JOINTS, robot.session.trajectory, still(first_s=5.0), robot.now)
    robot.read(robot.at)
    out = robot.session.trajectory(still(first_s=5.0), robot.now)
    assert np.abs(out.position[0] - robot.at).max() <= REST * 5.0
