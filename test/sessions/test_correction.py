"""The correction session: off until asked, never a jump, never beyond its bounds, never NaN."""

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    NAMES,
    NOMINAL,
    NOT_STRAIGHT,
    RATE,
    ROUNDING,
    Robot,
    bent_tool,
    distance,
    drifted,
    good_here_only,
    offer,
    pose,
    refused,
    still,
)
from hypothesis import given, settings
from hypothesis import strategies as st

from robocal_ros.core.joint_correction import JointCorrection
from robocal_ros.core.joint_correction.bounds import CorrectionConfig
from robocal_ros.core.joint_correction.staged import StagedCorrection, StagedResult
from robocal_ros.core.samples import CORRECTED, TAUGHT
from robocal_ros.sessions.correction import (
    CorrectionSession,
    JointCommand,
    OfferedTool,
    Reason,
    TrajectoryCommand,
    finite_command,
    joint_command,
    trajectory_command,
)


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.fixture
def warm() -> Robot:
    """Enabled, with a drifted model, settled."""
    robot = Robot()
    robot.session.offer_model(offer(drifted()))
    robot.session.enable(True)
    robot.settle()
    return robot


# ---- off, on, off --------------------------------------------------------------------------------


def test_off_until_enabled(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted()))
    robot.session.offer_tool(bent_tool())
    for _ in range(100):
        assert np.array_equal(robot.stream(), HOME)
    points = np.stack([HOME, HOME + 0.1])
    command = TrajectoryCommand(NAMES, points, np.array([0.0, 5.0]))
    assert robot.session.trajectory(command, robot.now) is command
    assert np.array_equal(robot.read(HOME).position, HOME)
    status = robot.session.status()
    assert not status.enabled
    assert not status.active
    assert status.revision == 1


def test_enabled_without_a_model_changes_nothing(robot: Robot) -> None:
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_reaches_the_taught_pose_and_goes_back(robot: Robot) -> None:
    actual = drifted()
    robot.session.offer_model(offer(actual))
    robot.session.enable(True)
    q = robot.settle()
    goal = pose(NOMINAL, HOME)
    assert distance(pose(actual, HOME), goal) > 1e-4
    assert distance(pose(actual, q), goal) < 1e-9
    assert np.allclose(robot.read(q).position, HOME, rtol=0.0, atol=1e-12)
    robot.session.enable(False)
    assert np.array_equal(robot.settle(), HOME)
    assert not robot.session.status().active


def test_reaches_it_with_a_new_tool_too(warm: Robot) -> None:
    tool = bent_tool()
    warm.change_tool(tool)
    q = warm.settle()
    actual = replace(drifted(), T_flange_tool=tool.T_flange_tool)
    assert distance(pose(actual, q), pose(NOMINAL, HOME)) < 1e-9
    assert np.allclose(warm.read(q).position, HOME, rtol=0.0, atol=1e-12)


def test_the_reference_is_what_the_program_was_taught_with() -> None:
    cold = drifted(20.0, seed=5)  # millimetres from the nominal model
    warm_arm = cold.with_mdh(cold.mdh + drifted().mdh - NOMINAL.mdh)
    robot = Robot()
    robot.session = CorrectionSession(NOMINAL, cold, "s1")
    robot.session.offer_model(offer(warm_arm))
    robot.session.enable(True)
    q = robot.settle()
    assert distance(pose(warm_arm, q), pose(cold, HOME)) < 1e-9
    # back to the nominal model: no drift is known, so nothing is corrected
    robot.session.offer_model(offer(NOMINAL, revision=2))
    assert np.array_equal(robot.settle(), HOME)


def test_the_blend_moves_no_joint_faster_than_its_bound(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.offer_tool(bent_tool())
    robot.session.enable(True)
    outputs = [robot.stream()]
    while not robot.session.status().settled:
        outputs.append(robot.stream())
    speed = np.abs(np.diff(outputs, axis=0)).max(axis=1) / DT
    assert speed.max() <= RATE + ROUNDING / DT
    assert np.median(speed) > 0.9 * RATE


def test_a_pause_does_not_let_the_blend_jump(robot: Robot) -> None:
    robot.stream()
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    assert np.abs(robot.stream(dt=100.0) - HOME).max() <= RATE * 0.02 + ROUNDING


# ---- continuity for any sequence of events -------------------------------------------------------

EVENTS = st.lists(
    st.tuples(
        st.sampled_from(
            ["on", "off", "model", "nominal", "tool", "taught tool", "stop", "nothing"]
        ),
        st.integers(0, 5),
        st.integers(1, 60),
    ),
    min_size=1,
    max_size=12,
)


def happen(
    robot: Robot, what: str, seed: int, revision: int, change_tool: Callable[[OfferedTool], None]
) -> None:
    session = robot.session
    if what in ("on", "off"):
        session.enable(what == "on")
    elif what == "model":
        session.offer_model(offer(drifted(0.4 * seed, seed), revision))
    elif what == "nominal":
        session.offer_model(offer(NOMINAL, revision))
    elif what == "tool":
        change_tool(bent_tool(1e-3 * seed, 0.3 * seed))
    elif what == "taught tool":
        change_tool(bent_tool(0.0, 0.0))
    elif what == "stop":
        empty = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
        assert session.trajectory(empty, robot.now) is empty


def blend_since(robot: Robot, sent_s: float) -> float:
    """Largest step of a blend between two targets: a pause counts for no more than is stated."""
    return RATE * min(robot.now - sent_s, CorrectionConfig().longest_step_s)


@settings(max_examples=25, deadline=None)
@given(EVENTS)
def test_no_sequence_of_events_makes_a_stream_jump(events: list[tuple[str, int, int]]) -> None:
    """At a standing target every step is a blend's; readings give the taught joints throughout."""
    robot = Robot(thermal=CorrectionConfig().tool)
    last = robot.stream()
    for revision, (what, seed, count) in enumerate(events, start=1):
        sent_s = robot.now
        happen(robot, what, seed, revision, robot.change_tool)
        for _ in range(count):
            q = robot.stream()
            assert np.all(np.isfinite(q))
            assert np.abs(q - last).max() <= blend_since(robot, sent_s) + ROUNDING
            sent_s = robot.now
            assert np.allclose(robot.read(q).position, HOME, rtol=0.0, atol=1e-11)
            last = q


@settings(max_examples=25, deadline=None)
@given(EVENTS, st.floats(0.05, 2.0))
def test_a_moving_stream_steps_no_more_than_its_motion_and_the_blend(
    events: list[tuple[str, int, int]], speed: float
) -> None:
    robot = Robot(thermal=CorrectionConfig().tool)
    t, shift = 0.0, robot.stream() - HOME
    for revision, (what, seed, count) in enumerate(events, start=1):
        sent_s = robot.now
        happen(robot, what, seed, revision, robot.change_tool)
        for i in range(count):
            t += DT * (i > 0)  # after a pause it goes on where it was
            q = HOME + 0.3 * np.sin(speed * t)
            now = robot.stream(q) - q
            # By the motion, a correction of some mrad changes by some mrad per rad moved.
            by_motion = 0.3 * speed * DT * 0.15
            assert np.abs(now - shift).max() <= blend_since(robot, sent_s) + by_motion
            shift, sent_s = now, robot.now


@settings(max_examples=25, deadline=None)
@given(EVENTS, st.integers(2, 30), st.floats(0.2, 4.0))
def test_trajectories_start_where_the_last_command_was_and_never_jump(
    events: list[tuple[str, int, int]], m: int, duration: float
) -> None:
    """A resting trajectory: whatever is sent when, the shift along time is continuous."""
    robot = Robot(thermal=CorrectionConfig().tool)
    times = np.linspace(0.0, duration, m)
    points = np.tile(HOME, (m, 1))
    last = np.zeros(6)
    robot.read(HOME)
    for revision, (what, seed, count) in enumerate(events, start=1):
        happen(robot, what, seed, revision, robot.session.offer_tool)
        command = TrajectoryCommand(NAMES, points, times, np.zeros((m, 6)), np.zeros((m, 6)))
        out = robot.session.trajectory(command, robot.now)
        assert np.array_equal(out.time_from_start_s, times)
        assert np.abs(out.position[0] - HOME - last).max() <= NOT_STRAIGHT
        steps = np.abs(np.diff(out.position, axis=0)).max(axis=1)
        assert np.all(steps <= RATE * np.diff(times) + ROUNDING)
        assert out.velocity is not None
        assert np.all(out.velocity[[0, -1]] == 0.0)
        assert np.abs(out.velocity).max() <= RATE + 1e-9
        # the next one comes somewhere under way; between points the shift is not quite straight
        robot.now += duration * count / 60.0
        here = np.array(
            [np.interp(duration * count / 60.0, times, column) for column in out.position.T]
        )
        assert np.allclose(robot.read(here).position, HOME, rtol=0.0, atol=NOT_STRAIGHT)
        last = here - HOME


# ---- trajectories --------------------------------------------------------------------------------


def swing(m: int = 201, duration: float = 2.0) -> TrajectoryCommand:
    """A move from rest to rest with its true rates."""
    t = np.linspace(0.0, duration, m)
    w = np.pi / duration
    reach = np.array([0.4, -0.2, 0.3, -0.4, 0.3, 0.5])
    shape = [0.5 * (1 - np.cos(w * t)), 0.5 * w * np.sin(w * t), 0.5 * w * w * np.cos(w * t)]
    q, v, a = (x[:, None] * reach for x in shape)
    return TrajectoryCommand(NAMES, HOME + q, t, v, a)


def test_a_trajectory_is_corrected_as_a_whole(warm: Robot) -> None:
    command = swing()
    out = warm.session.trajectory(command, warm.now)
    assert distance(pose(drifted(), out.position), pose(NOMINAL, command.position)) < 1e-9
    assert np.array_equal(out.time_from_start_s, command.time_from_start_s)
    assert out.mark == CORRECTED
    h = 0.01
    v = (out.position[2:] - out.position[:-2]) / (2 * h)
    assert out.velocity is not None
    assert out.acceleration is not None
    assert np.allclose(out.velocity[1:-1], v, rtol=0.0, atol=1e-4)
    a = (out.position[2:] - 2 * out.position[1:-1] + out.position[:-2]) / h**2
    assert np.allclose(out.acceleration[1:-1], a, rtol=0.0, atol=1e-3)
    assert np.all(out.velocity[[0, -1]] == pytest.approx(0.0, abs=1e-12))


def test_velocities_follow_the_positions_while_a_blend_is_under_way(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now)
    assert out.velocity is not None
    v = (out.position[2:] - out.position[:-2]) / 0.02
    slow = np.abs(out.velocity[1:-1] - v).max(axis=1)
    # where the blend starts and ends its rate has a corner
    assert np.median(slow) < 1e-4
    assert slow.max() < RATE


def test_readings_follow_a_blend_along_the_trajectory(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now)
    for i in (0, 20, 60, 200):
        state = JointCommand(NAMES, out.position[i])
        taught = robot.session.reading(state, robot.now + command.time_from_start_s[i])
        assert np.allclose(taught.position, command.position[i], rtol=0.0, atol=1e-9)
        assert taught.mark == TAUGHT


def test_a_trajectory_that_is_under_way_already_starts_without_a_jump(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    robot.read(command.position[45])  # it lags
    out = robot.session.trajectory(command, robot.now, starts_in_s=-0.5)
    shift = np.abs(out.position - command.position).max(axis=1)
    assert np.all(shift[:51] == 0.0)
    assert shift[60] > 1e-5


def test_a_trajectory_that_came_much_too_late_is_refused(robot: Robot) -> None:
    """The robot still stands where it began: the controller would jump to where it should be."""
    robot.read(HOME)
    command = swing()
    refused(Reason.START_MISMATCH, robot.session.trajectory, command, robot.now, starts_in_s=-0.5)
    robot.session.enable(False)
    robot.session.trajectory(command, robot.now, starts_in_s=-0.05)


def test_a_later_trajectory_begins_when_it_says(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now, starts_in_s=3.0)
    assert np.array_equal(robot.read(HOME).position, HOME)
    taught = robot.session.reading(JointCommand(NAMES, out.position[-1]), robot.now + 5.0)
    assert np.allclose(taught.position, command.position[-1], rtol=0.0, atol=1e-9)


def test_a_waiting_trajectory_begins_from_what_is_commanded_then(robot: Robot) -> None:
    """The running one goes on until then, and the readings follow it."""
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    running = swing()
    first = robot.session.trajectory(running, robot.now)
    robot.session.offer_model(offer(drifted(0.5), revision=2))
    waiting = replace(running, position=np.tile(running.position[50], (201, 1)))
    second = robot.session.trajectory(waiting, robot.now + 0.1, starts_in_s=0.4)
    i = 50  # what the first commands at 0.5 s, where the second begins
    assert running.time_from_start_s[i] == pytest.approx(0.5)
    assert np.allclose(second.position[0], first.position[i], rtol=0.0, atol=1e-9)
    for i in (10, 30, 49):
        state = JointCommand(NAMES, first.position[i])
        taught = robot.session.reading(state, robot.now + running.time_from_start_s[i])
        assert np.allclose(taught.position, running.position[i], rtol=0.0, atol=1e-9)


def test_a_part_of_the_joints_does_not_blend_the_others_unseen(robot: Robot) -> None:
    """Only joint 1 is commanded while a model comes into force; then all of them."""
    before = robot.stream()
    robot.read(before)
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    for _ in range(1000):
        robot.now += DT
        robot.read(before)
        robot.session.target(JointCommand(NAMES[:1], HOME[:1]), robot.now)
    allowed = CorrectionConfig().blend_rates(NOMINAL) * DT
    assert np.all(np.abs(robot.stream() - before) <= allowed * 1.001)


def test_a_stop_passes_at_once_and_as_it_came(warm: Robot) -> None:
    stop = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
    before = warm.stream()
    assert warm.session.trajectory(stop, warm.now) is stop
    assert np.array_equal(warm.stream(), before)
    nameless = TrajectoryCommand((), np.empty((0, 0)), np.empty(0), mark=CORRECTED)
    assert warm.session.trajectory(nameless, -1.0) is nameless


def test_ten_thousand_points_at_once(warm: Robot) -> None:
    command = swing(m=10_000)
    out = warm.session.trajectory(command, warm.now)
    assert distance(pose(drifted(), out.position), pose(NOMINAL, command.position)) < 1e-9


# ---- where a command may begin -------------------------------------------------------------------

FAR = np.radians(0.021)  # beyond the tolerance of 0.02 deg
NEAR = np.radians(0.019)


def moved(by: float, joint: int = 1) -> np.ndarray:
    q = HOME.copy()
    q[joint] += by
    return q


def large() -> Robot:
    """Enabled, with a drift and a bent tool, at rest at home, uncorrected: shifts of degrees."""
    robot = Robot()
    robot.session.offer_model(offer(drifted()))
    robot.session.offer_tool(bent_tool())
    robot.read(HOME)
    robot.session.enable(True)
    return robot


def test_nothing_goes_out_before_joint_states_have_arrived() -> None:
    robot = Robot()
    said = refused(Reason.STALE_JOINTS, robot.session.target, JointCommand(NAMES, HOME), 1.0)
    assert "joint_a1" in said
    refused(Reason.STALE_JOINTS, robot.session.trajectory, still(first_s=60.0), 1.0)
    assert not robot.session.status().mismatch  # nothing is wrong: they will come
    assert np.array_equal(robot.stream(), HOME)


@pytest.mark.parametrize("on", [False, True])
@pytest.mark.parametrize("joint", range(6))
def test_the_first_target_is_where_the_robot_stands(on: bool, joint: int) -> None:
    robot = Robot()
    robot.session.enable(on)
    robot.at = moved(NEAR, joint)
    robot.stream()
    robot = Robot()
    robot.session.enable(on)
    robot.at = moved(-FAR, joint)
    assert NAMES[joint] in refused(Reason.START_MISMATCH, robot.stream)


def test_after_a_mismatch_nothing_goes_out_until_it_is_enabled_again() -> None:
    robot = large()
    robot.at = moved(0.5)
    refused(Reason.START_MISMATCH, robot.stream)
    robot.at = HOME  # also where it would fit now
    refused(Reason.START_MISMATCH, robot.stream)
    refused(Reason.START_MISMATCH, robot.session.trajectory, still(), robot.now)
    assert "joint_a2" in robot.session.status().mismatch
    assert "enable" in robot.session.status().mismatch
    stop = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
    assert robot.session.trajectory(stop, robot.now) is stop
    assert np.array_equal(robot.read(HOME).position, HOME)
    robot.session.enable(True)
    assert not robot.session.status().mismatch
    assert np.array_equal(robot.stream(), HOME)
    assert robot.session.status().refused[Reason.START_MISMATCH] == 3


def test_a_trajectory_that_the_controller_rejected_is_not_believed() -> None:
    """The robot stands at home all the time: what comes next begins there, uncorrected."""
    robot = large()
    first = robot.session.trajectory(still(), robot.now)
    assert np.abs(first.position[-1] - HOME).max() > 10 * FAR
    for _ in range(25):
        robot.now += 1.0
        robot.read(HOME)
    for command in (still(first_s=0.01), still()):
        out = robot.session.trajectory(command, robot.now)
        first_s = command.time_from_start_s[0]
        assert np.abs(out.position[0] - HOME).max() <= RATE * first_s + ROUNDING
    assert np.allclose(robot.read(HOME).position, HOME, rtol=0.0, atol=1e-12)


def test_a_trajectory_goes_on_from_the_correction_of_the_one_before() -> None:
    robot = large()
    first = robot.session.trajectory(still(), robot.now)
    robot.now += 25.0
    robot.read(first.position[-1])
    for first_s in (0.0, 0.01):
        out = robot.session.trajectory(still(first_s=first_s), robot.now)
        assert np.allclose(out.position, first.position[-1], rtol=0.0, atol=1e-12)


def test_a_trajectory_from_nowhere_is_refused_unless_it_takes_its_time() -> None:
    """The robot was moved by hand: nobody knows what correction it shows."""
    for first_s, fine in ((0.0, False), (0.05, False), (20.0, True)):
        robot = large()
        first = robot.session.trajectory(still(), robot.now)
        robot.now += 25.0
        robot.read(first.position[-1] + 0.3)
        command = still(first_s=first_s)
        if fine:
            robot.session.trajectory(command, robot.now)
        else:
            refused(Reason.START_MISMATCH, robot.session.trajectory, command, robot.now)
            assert robot.session.status().mismatch


def straight(seconds: float = 4.0) -> TrajectoryCommand:
    """Half a radian in each joint; 25 ms of it are beyond the tolerance."""
    return TrajectoryCommand(NAMES, np.stack([HOME, HOME + 0.5]), np.array([0.0, seconds]))


def test_a_robot_that_moves_under_a_trajectory_is_taken_to_follow_it() -> None:
    """Between far points its controller goes another way than straight."""
    robot = large()
    at = robot.settle()
    robot.session.trajectory(straight(), robot.now)
    for t in np.arange(0.0, 1.0, 0.05):
        robot.now += 0.05
        robot.read(at + 0.02 + 0.05 * t)
    out = robot.session.trajectory(still(HOME + 0.3, first_s=0.05), robot.now)
    assert np.abs(out.position[0] - HOME - 0.3).max() > 10 * FAR


def test_single_points_in_quick_succession_may_be_ahead_of_the_robot() -> None:
    robot = large()
    at = robot.settle()
    for _ in range(150):  # long enough to be seen at rest
        robot.stream()
    for k in range(1, 4):
        step = TrajectoryCommand(NAMES, HOME[None] + 0.005 * k, np.array([0.034]))
        robot.session.trajectory(step, robot.now)
        robot.now += 0.034 if k < 2 else 0.02
        robot.read(at)


def test_a_stopped_robot_goes_on_from_where_it_stopped() -> None:
    robot = large()
    robot.settle()
    path = robot.session.trajectory(straight(), robot.now)
    robot.now += 1.0
    empty = TrajectoryCommand(NAMES, np.empty((0, 6)), np.empty(0))
    robot.session.trajectory(empty, robot.now)
    robot.now += 5.0
    stands = path.position[0] + (path.position[1] - path.position[0]) * 1.1 / 4.0
    robot.read(stands)
    out = robot.session.trajectory(still(HOME + 0.15, first_s=0.05), robot.now)
    assert np.abs(out.position[0] - HOME - 0.15).max() > 10 * FAR


def test_a_restart_while_corrected_goes_on_where_the_robot_stands() -> None:
    robot = large()
    at = robot.settle()
    assert np.abs(at - HOME).max() > 10 * FAR
    for on in (False, True):
        new = large()
        new.session.enable(on)
        new.at = at
        assert np.abs(new.stream() - at).max() <= ROUNDING
        last = at
        for _ in range(2000):
            assert np.abs(new.stream() - last).max() <= RATE * DT + ROUNDING
            last = new.at
        assert np.allclose(new.settle(), at if on else HOME, rtol=0.0, atol=ROUNDING)


def test_a_restart_that_does_not_know_the_model_yet_waits() -> None:
    at = large().settle()
    new = Robot()
    new.at = at
    refused(Reason.START_MISMATCH, new.stream)


@pytest.mark.parametrize("seconds", [0.3, 3600.0])
def test_after_a_pause_a_stream_begins_where_the_robot_stands(seconds: float) -> None:
    robot = large()
    at = robot.settle()
    assert np.array_equal(robot.stream(dt=seconds), at)
    robot.at = moved(0.5)
    refused(Reason.START_MISMATCH, robot.stream, dt=seconds)


def test_after_a_pause_at_the_uncorrected_target_the_correction_blends_in_again() -> None:
    robot = large()
    at = robot.settle()
    robot.at = HOME
    assert np.array_equal(robot.stream(dt=1.0), HOME)
    assert np.abs(robot.stream() - HOME).max() <= RATE * DT + ROUNDING
    assert np.allclose(robot.settle(), at, rtol=0.0, atol=ROUNDING)


def test_between_two_messages_the_robot_may_be_anywhere(warm: Robot) -> None:
    """A robot lags behind a stream that moves; that is no reason to stop it."""
    at = warm.at
    for t in np.arange(0.0, 0.5, DT):
        warm.at = at
        warm.stream(HOME + 2.0 * t)


def test_a_robot_that_moves_may_lag_after_a_short_pause(warm: Robot) -> None:
    shift = warm.stream() - HOME
    for t in np.arange(0.0, 0.5, DT):
        out = warm.stream(HOME + t)
        warm.at = HOME + shift + max(0.0, t - 0.05)  # 50 ms behind
    warm.now += 0.11
    warm.read(out - 0.01)
    resumed = warm.session.target(JointCommand(NAMES, HOME + 0.5), warm.now)
    assert np.abs(resumed.position - out).max() < 5e-3


def test_an_off_node_that_has_begun_is_transparent() -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted()))
    robot.stream()
    far = moved(0.7)
    assert np.array_equal(robot.stream(far, dt=10.0), far)
    command = still(moved(-0.4))
    assert robot.session.trajectory(command, robot.now) is command


def test_a_part_of_the_joints_does_not_tell_that_the_others_are_uncorrected() -> None:
    """One joint is hardly shifted: where it stands says nothing about the rest."""
    robot = large()
    at = robot.settle()
    joint = int(np.argmin(np.abs(at - HOME)))
    assert abs(at[joint] - HOME[joint]) < NEAR < np.abs(at - HOME).max()
    name, taught = (NAMES[joint],), HOME[[joint]]
    robot.at = at.copy()
    robot.at[joint] = HOME[joint]  # as if it were uncorrected: within the tolerance of both
    part = TrajectoryCommand(name, np.tile(taught, (3, 1)), np.array([0.0, 0.5, 1.0]))
    robot.now += 1.0
    robot.read(robot.at)
    robot.session.target(JointCommand(name, taught), robot.now)
    assert np.abs(robot.stream() - at).max() <= ROUNDING
    robot.session.trajectory(part, robot.now)
    robot.now += 2.0
    robot.at[joint] = HOME[joint]
    robot.read(robot.at)
    out = robot.session.trajectory(still(first_s=0.01), robot.now)
    assert np.allclose(out.position, at, rtol=0.0, atol=1e-12)


def test_old_readings_do_not_tell_where_the_robot_is(warm: Robot) -> None:
    at = warm.stream()
    command = JointCommand(NAMES, HOME)
    warm.now += 0.3
    said = refused(Reason.STALE_JOINTS, warm.session.target, command, warm.now)
    assert "0.300 s" in said
    warm.session.reading(JointCommand(NAMES, at), warm.now, 0.25)  # late on the way
    refused(Reason.STALE_JOINTS, warm.session.target, command, warm.now)
    warm.read(at)
    assert np.array_equal(warm.session.target(command, warm.now).position, at)


def test_a_part_of_the_joints_is_not_completed_from_old_readings(warm: Robot) -> None:
    warm.stream()
    part = JointCommand(NAMES[:2], HOME[:2])
    warm.session.target(part, warm.now)
    warm.now += 0.25
    said = refused(Reason.STALE_JOINTS, warm.session.target, part, warm.now)
    assert "joint_a3" in said
    assert "0.2 s" in said


# ---- joints by name ------------------------------------------------------------------------------


def test_joints_are_matched_by_name(warm: Robot) -> None:
    straight = warm.stream()
    order = [3, 0, 5, 1, 4, 2]
    names = tuple(NAMES[i] for i in order)
    warm.now += DT
    out = warm.session.target(JointCommand(names, HOME[order]), warm.now)
    assert out.names == names
    assert np.array_equal(out.position, straight[order])


def test_a_part_of_the_joints_is_completed_from_the_readings(warm: Robot) -> None:
    part = JointCommand(NAMES[2:4], HOME[2:4])
    new = Robot()
    refused(Reason.MISSING_JOINT, new.session.target, part, new.now)
    straight = warm.stream()
    warm.read(straight)
    assert np.allclose(warm.session.target(part, warm.now).position, straight[2:4], atol=1e-12)


def test_joints_of_others_pass_in_readings_but_not_in_targets(warm: Robot) -> None:
    q = warm.stream()
    names = ("gripper", *NAMES, "track")
    values = np.array([0.04, *q, 1.5])
    out = warm.session.reading(JointCommand(names, values, velocity=0.1 * np.ones(8)), warm.now)
    assert out.names == names
    assert np.allclose(out.position[1:-1], HOME, rtol=0.0, atol=1e-12)
    assert out.position[[0, -1]].tolist() == [0.04, 1.5]
    assert out.velocity is not None
    assert out.velocity[[0, -1]].tolist() == [0.1, 0.1]
    said = refused(Reason.UNKNOWN_JOINT, warm.session.target, JointCommand(names, values), warm.now)
    assert "gripper" in said
    alone = JointCommand(("gripper",), np.array([0.02]))
    assert warm.session.reading(alone, warm.now).position.tolist() == [0.02]


def test_readings_of_velocity_are_un_corrected(warm: Robot) -> None:
    h = 1e-4
    speed = np.array([0.2, -0.1, 0.3, 0.1, -0.2, 0.5])
    before, here, after = (warm.stream(HOME + speed * t) for t in (-h, 0.0, h))
    state = warm.read(here, velocity=(after - before) / (2 * h))
    assert state.velocity is not None
    assert np.allclose(state.velocity, speed, rtol=0.0, atol=1e-6)


# ---- what is refused -----------------------------------------------------------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(warm: Robot, bad: float) -> None:
    q = HOME.copy()
    q[3] = bad
    session, now = warm.session, warm.now
    assert "joint_a4" in refused(Reason.NOT_FINITE, session.target, JointCommand(NAMES, q), now)
    fast = JointCommand(NAMES, HOME, velocity=q)
    refused(Reason.NOT_FINITE, session.target, fast, now)
    refused(Reason.NOT_FINITE, session.reading, JointCommand(NAMES, q), now)
    refused(Reason.NOT_FINITE, session.reading, fast, now)
    points, times = np.stack([HOME, q]), np.array([0.0, 1.0])
    trajectory = TrajectoryCommand(NAMES, points, times)
    assert "point 2" in refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    still = np.stack([HOME, HOME])
    for rates in ({"velocity": points}, {"velocity": still, "acceleration": points}):
        trajectory = TrajectoryCommand(NAMES, still, times, **rates)
        refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    assert session.status().refused[Reason.NOT_FINITE] == 7
    assert np.all(np.isfinite(warm.stream()))


def test_doubled_and_misfitting_joints(warm: Robot) -> None:
    session, now = warm.session, warm.now
    doubled = (NAMES[0], *NAMES[:5])
    refused(Reason.DOUBLED_JOINT, session.target, JointCommand(doubled, HOME), now)
    refused(Reason.DOUBLED_JOINT, session.reading, JointCommand(doubled, HOME), now)
    refused(Reason.WRONG_SIZE, session.target, JointCommand(NAMES, HOME[:5]), now)
    refused(Reason.WRONG_SIZE, session.reading, JointCommand(NAMES, HOME[:5]), now)
    refused(Reason.UNKNOWN_JOINT, session.target, JointCommand((), np.empty(0)), now)


def test_time_that_goes_backwards(warm: Robot) -> None:
    session = warm.session
    warm.stream(stamp_ns=2_000_000_000)
    refused(Reason.TIME_BACKWARDS, warm.stream, stamp_ns=1_999_000_000)
    refused(Reason.TIME_BACKWARDS, warm.stream, dt=-1.0)
    refused(Reason.TIME_BACKWARDS, warm.stream, dt=np.nan)
    warm.now = 1e6
    command = replace(swing(m=3), time_from_start_s=np.array([0.0, 1.0, 1.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    command = replace(command, time_from_start_s=np.array([-0.1, 1.0, 2.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    # after a look by the operator any source time will do
    session.enable(True)
    warm.stream(stamp_ns=5)


def test_readings_of_a_clock_that_was_set_back_are_taken(warm: Robot) -> None:
    q = warm.stream()
    warm.read(q, stamp_ns=10_000_000_000)
    refused(Reason.TIME_BACKWARDS, warm.read, q, stamp_ns=9_900_000_000)
    warm.read(q, stamp_ns=1_000_000_000)


def test_a_source_whose_clock_was_set_back_goes_on(warm: Robot) -> None:
    """A simulator that was started again, or one stamp from the future."""
    warm.stream(stamp_ns=10**15)
    warm.stream(stamp_ns=10**9)
    refused(Reason.TIME_BACKWARDS, warm.stream, stamp_ns=9 * 10**8)


def test_a_trajectory_for_later_does_not_bar_those_that_come_before(warm: Robot) -> None:
    later = replace(still(), stamp_ns=1_000_000_000_000)
    warm.session.trajectory(later, warm.now, 600.0)
    sooner = replace(still(first_s=0.5), stamp_ns=400_000_000_000)
    warm.session.trajectory(sooner, warm.now, 10.0)


@pytest.mark.parametrize("late", [1, 2, 3, 20])
@pytest.mark.parametrize("kind", [np.float64, np.float32])
def test_own_output_without_its_mark_is_known_late_and_rounded(late: int, kind: Any) -> None:
    """The loop is closed while the correction blends in, from its first visible step on."""
    robot = large()
    outputs = [robot.stream() for _ in range(50)]
    back = outputs[-late].astype(kind).astype(np.float64)
    assert np.abs(back - HOME).max() > 1e-5
    refused(Reason.OWN_OUTPUT, robot.stream, back)
    at = robot.settle()
    refused(Reason.OWN_OUTPUT, robot.stream, at.astype(kind).astype(np.float64))
    # what is no echo passes: the same target, and one that is rounded
    assert np.array_equal(robot.stream(), at)
    robot.stream(HOME.astype(np.float32).astype(np.float64))
    robot.stream(at + 1e-5)


def test_a_corrected_trajectory_that_comes_back_without_its_mark(warm: Robot) -> None:
    out = warm.session.trajectory(still(), warm.now)
    rounded = out.position.astype(np.float32).astype(np.float64)
    back = replace(out, position=rounded, mark="")
    refused(Reason.OWN_OUTPUT, warm.session.trajectory, back, warm.now)
    warm.session.trajectory(still(), warm.now)


def test_own_output_in_another_order_is_known(warm: Robot) -> None:
    out, path = warm.stream(), warm.session.trajectory(still(), warm.now)
    back = JointCommand(NAMES[::-1], out[::-1].copy())
    refused(Reason.OWN_OUTPUT, warm.session.target, back, warm.now)
    turned = replace(path, names=NAMES[::-1], position=path.position[:, ::-1].copy(), mark="")
    refused(Reason.OWN_OUTPUT, warm.session.trajectory, turned, warm.now)


def test_a_rounded_target_is_no_echo_of_a_tiny_correction() -> None:
    """Corrected by less than a float32 holds: the same rounded target again is no loop."""
    robot = Robot()
    robot.session.offer_model(offer(drifted(1e-3)))
    robot.session.enable(True)
    rounded = HOME.astype(np.float32).astype(np.float64)
    for _ in range(10):
        shift = np.abs(robot.stream(rounded) - rounded).max()
    assert 0.0 < shift < 5e-7


def test_a_model_that_is_the_reference_to_rounding_corrects_nothing() -> None:
    """A file's decimals and a quaternion on the way leave 1e-13 of it."""
    robot = Robot()
    robot.read(HOME)
    robot.session.offer_model(offer(NOMINAL.with_mdh(NOMINAL.mdh + 1e-13)))
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)
    status = robot.session.status()
    assert status.settled
    assert not status.active


def test_a_reading_is_un_corrected_once(warm: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its velocities are found with what its positions were found with."""
    calls = []
    correct = StagedCorrection.correct

    def counted(stage: StagedCorrection, q: np.ndarray, s: np.ndarray) -> StagedResult:
        calls.append(len(q))
        return correct(stage, q, s)

    q = warm.settle()
    monkeypatch.setattr(StagedCorrection, "correct", counted)
    warm.read(q)
    positions_only = len(calls)
    warm.read(q, velocity=np.full(6, 0.1))
    assert len(calls) == 2 * positions_only


def test_own_output_that_comes_back(warm: Robot) -> None:
    session, now = warm.session, warm.now
    out = warm.stream()
    marked = JointCommand(NAMES, HOME, mark=CORRECTED)
    refused(Reason.OWN_OUTPUT, session.target, marked, warm.now)
    refused(Reason.OWN_OUTPUT, session.trajectory, replace(swing(), mark=CORRECTED), warm.now)
    for mark in (CORRECTED, TAUGHT):
        refused(Reason.OWN_OUTPUT, session.reading, replace(marked, mark=mark), warm.now)
    # also where the mark was lost on the way
    refused(Reason.OWN_OUTPUT, warm.stream, out)
    # the same target again is no loop
    assert np.array_equal(warm.stream(), out)
    assert now < warm.now


def test_joint_limits_hold_after_the_correction(warm: Robot) -> None:
    q = HOME.copy()
    q[1] = NOMINAL.upper[1]
    # One side of the limit or the other: the correction decides, and never passes it.
    shift = (warm.stream() - HOME)[1]
    q[1] = NOMINAL.upper[1] - 0.5 * shift if shift > 0 else NOMINAL.lower[1] - 0.5 * shift
    said = refused(Reason.JOINT_LIMIT, warm.stream, q)
    assert "joint_a2" in said
    trajectory = TrajectoryCommand(NAMES, np.stack([HOME, q]), np.array([0.0, 1.0]))
    assert "point 2" in refused(Reason.JOINT_LIMIT, warm.session.trajectory, trajectory, warm.now)


def test_limits_hold_when_off_too(robot: Robot) -> None:
    q = HOME.copy()
    q[4] = 3.0
    robot.at = q
    refused(Reason.JOINT_LIMIT, robot.stream, q)


def test_a_drift_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    robot.read(HOME)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(drifted(12.0)))
    assert "mm" in said
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_a_blend_that_waits_says_why(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.stream()
    robot.session.enable(True)
    robot.stream()
    assert robot.session.status().waits == ""
    robot.read(robot.at)
    robot.session.target(JointCommand(NAMES[:1], HOME[:1]), robot.now)
    assert "part of the joints" in robot.session.status().waits
    robot.stream()
    assert robot.session.status().waits == ""
    part = TrajectoryCommand(NAMES[:1], HOME[None, :1], np.array([1.0]))
    robot.session.trajectory(part, robot.now)
    assert "part of the joints" in robot.session.status().waits
    robot.session.enable(False)
    robot.settle()
    robot.stream()
    assert robot.session.status().waits == ""


def test_where_the_bound_is_reached_the_blend_waits(robot: Robot) -> None:
    """Without readings the model is judged only when commands come."""
    robot.session.offer_model(offer(drifted(12.0)))
    robot.session.enable(True)
    outputs = [robot.stream() for _ in range(1500)]
    status = robot.session.status()
    assert status.held > 0
    assert "1 mm" in status.waits
    assert not status.settled
    assert status.tcp_shift_m <= 1e-3
    assert np.array_equal(outputs[-1], outputs[-2])
    # disabling leads back without any refusal
    robot.session.enable(False)
    assert np.array_equal(robot.settle(), HOME)
    # a trajectory is refused as a whole
    robot.session.enable(True)
    long = TrajectoryCommand(NAMES, np.tile(HOME, (2, 1)), np.array([0.0, 60.0]))
    refused(Reason.TCP_BOUND, robot.session.trajectory, long, robot.now)


def test_a_tool_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(11e-3, 0.0))
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(0.0, 3.1))
    robot.session.offer_tool(bent_tool(10e-3, 3.0))
    wrong = bent_tool(parent="flange")
    refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)


def test_near_a_singularity_a_drift_is_corrected_in_part_and_a_tool_not_at_all(
    warm: Robot,
) -> None:
    q = HOME.copy()
    for q[4] in np.linspace(0.9, 0.0, 500):
        out = warm.stream(q)
        assert np.abs(out - q).max() <= np.radians(0.3)
    assert warm.session.status().reduced > 0
    q[4] = 0.1
    last = warm.stream(q)
    warm.change_tool(bent_tool(2e-3, 2.0))
    for _ in range(6000):
        out = warm.stream(q)
        assert np.abs(out - last).max() <= RATE * DT + ROUNDING
        last = out
    status = warm.session.status()
    assert status.held > 0
    assert not status.settled
    # settled elsewhere, it is refused there
    warm.settle()
    refused(Reason.JOINT_BOUND, warm.stream, q)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"accepted": False}, Reason.NOT_ACCEPTED),
        ({"robot": "UR10"}, Reason.WRONG_ROBOT),
        ({"serial": "s2"}, Reason.WRONG_ROBOT),
        ({"model_hash": "0123456789abcdef"}, Reason.WRONG_ROBOT),
        ({"joint_names": NAMES[::-1]}, Reason.WRONG_ROBOT),
    ],
)
def test_models_of_others_are_not_taken_over(
    robot: Robot, change: dict[str, Any], reason: Reason
) -> None:
    refused(reason, robot.session.offer_model, offer(drifted(), **change))
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)
    assert robot.session.status().revision is None


def test_revisions_only_grow(warm: Robot) -> None:
    warm.session.offer_model(offer(drifted(), 1))  # the same again, from a restarted node
    refused(Reason.OLD_REVISION, warm.session.offer_model, offer(drifted(0.5), 1))
    warm.session.offer_model(offer(drifted(0.5), 3))
    refused(Reason.OLD_REVISION, warm.session.offer_model, offer(drifted(), 2))
    assert warm.session.status().revision == 3


def test_a_model_that_is_too_large_elsewhere_is_announced(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted()))
    assert robot.session.status().survey.beyond == 0.0
    assert 0.0 < robot.session.status().survey.worst_m < 1e-3
    arm, _ = good_here_only()
    robot.stream()
    robot.session.offer_model(offer(arm, 2))
    survey = robot.session.status().survey
    assert robot.session.status().revision == 2
    # against ten times as many other postures
    q = np.random.default_rng(1).uniform(NOMINAL.lower, NOMINAL.upper, (10_000, 6))
    shift = JointCorrection.between(NOMINAL, arm).correct(q)
    beyond = 1.0 - np.mean(CorrectionConfig().thermal.hold(shift))
    assert beyond > 0.05
    assert survey.beyond == pytest.approx(beyond, abs=0.05)
    assert survey.worst_m == pytest.approx(shift.tcp_shift_m.max(), rel=0.2)
    assert "of the postures" in str(survey)


def test_a_model_that_is_too_large_where_the_robot_goes_is_not_taken_over(robot: Robot) -> None:
    """It is sent far away, and has not got there yet."""
    arm, far = good_here_only()
    robot.read(HOME)
    path = TrajectoryCommand(NAMES, np.stack([HOME, far]), np.array([0.0, 60.0]))
    robot.session.trajectory(path, robot.now)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(arm))
    assert "of the postures" in said
    assert robot.session.status().waiting_revision == 1
    # there, too, the operator's look does not help; at home it does
    robot.session.enable(True)
    assert robot.session.status().revision is None
    robot.session.trajectory(still(), robot.now)
    robot.session.enable(True)
    assert robot.session.status().revision == 1
    assert robot.session.status().waiting_revision is None


@pytest.mark.parametrize("revision", [1, 7])
def test_a_history_that_began_again_is_taken_over_by_its_stamp(revision: int) -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=10**15))
    later = offer(drifted(0.5), revision, stamp_ns=10**15 + 1)
    robot.session.offer_model(later)
    assert robot.session.status().revision == revision
    robot.session.enable(True)
    q = robot.settle()
    assert distance(pose(drifted(0.5), q), pose(NOMINAL, HOME)) < 1e-9


@pytest.mark.parametrize("on", [False, True])
def test_a_history_that_began_again_waits_for_the_operator_without_a_newer_stamp(on: bool) -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=10**15))
    for old in (offer(drifted(0.5), 1, stamp_ns=10**15), offer(NOMINAL, 0)):
        said = refused(Reason.OLD_REVISION, robot.session.offer_model, old)
        assert "enable" in said
        assert robot.session.status().revision == 7
        assert robot.session.status().waiting_revision == old.revision
    robot.session.enable(on)
    status = robot.session.status()
    assert (status.revision, status.waiting_revision) == (0, None)
    # what the one in use says again is no news, and nothing waits after it
    refused(Reason.OLD_REVISION, robot.session.offer_model, offer(drifted(0.5), 0))
    robot.session.offer_model(offer(NOMINAL, 0))
    assert robot.session.status().waiting_revision is None


def test_the_frames_of_a_tool_are_those_configured() -> None:
    robot = Robot(tool_frame="welding_gun")
    named = bent_tool(child="welding_gun")
    for wrong in (bent_tool(), replace(named, child="gripper"), replace(named, parent="base")):
        refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)
    assert not robot.session.status().new_tool
    robot.session.offer_tool(named)
    assert robot.session.status().new_tool


# ---- from messages -------------------------------------------------------------------------------


def header(frame: str = "") -> SimpleNamespace:
    return SimpleNamespace(stamp=SimpleNamespace(sec=1, nanosec=500), frame_id=frame)


def test_targets_are_built_from_messages() -> None:
    message = SimpleNamespace(
        header=header("x"), name=["a", "b"], position=[1.0, 2.0], velocity=[], effort=[]
    )
    command = joint_command(message)
    assert command.names == ("a", "b")
    assert command.velocity is None
    assert (command.stamp_ns, command.mark) == (1_000_000_500, "x")
    message.velocity = [1.0]
    refused(Reason.WRONG_SIZE, joint_command, message)
    message.position = []
    refused(Reason.NO_POSITION, joint_command, message)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_efforts_that_are_not_finite_do_not_go_out(bad: float) -> None:
    target = SimpleNamespace(header=header(), name=["a"], position=[1.0], velocity=[], effort=[bad])
    refused(Reason.NOT_FINITE, finite_command, target)
    moved = point(0.0, [1.0], [], [])
    moved.effort = [bad]
    path = SimpleNamespace(header=header(), joint_names=["a"], points=[moved])
    refused(Reason.NOT_FINITE, trajectory_command, path)


def test_readings_of_foreign_joints_that_are_not_finite_are_refused() -> None:
    state = SimpleNamespace(
        header=header(), name=["a", "gripper"], position=[1.0, np.nan], velocity=[], effort=[]
    )
    refused(Reason.NOT_FINITE, joint_command, state)


def point(t: float, q: list[float], v: list[float], a: list[float]) -> SimpleNamespace:
    duration = SimpleNamespace(sec=int(t), nanosec=round(t % 1 * 1e9))
    return SimpleNamespace(
        time_from_start=duration, positions=q, velocities=v, accelerations=a, effort=[]
    )


def test_trajectories_are_built_from_messages() -> None:
    points = [point(0.0, [1.0, 2.0], [0.0, 0.0], []), point(1.5, [3.0, 4.0], [0.0, 1.0], [])]
    message = SimpleNamespace(header=header(), joint_names=["a", "b"], points=points)
    command = trajectory_command(message)
    assert command.position.tolist() == [[1.0, 2.0], [3.0, 4.0]]
    assert command.time_from_start_s.tolist() == [0.0, 1.5]
    assert command.acceleration is None
    assert len(trajectory_command(SimpleNamespace(**vars(message) | {"points": []}))) == 0
    points[1].velocities = []
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[0].velocities, points[0].accelerations = [], [0.0, 0.0]
    points[1].accelerations = [0.0, 0.0]
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[1].positions = [1.0]
    refused(Reason.WRONG_SIZE, trajectory_command, message)
    points[0].positions = points[1].positions = []
    refused(Reason.NO_POSITION, trajectory_command, message)
