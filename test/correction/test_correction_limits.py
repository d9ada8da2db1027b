# SPDX-License-Identifier: Apache-2.0
"""Beyond its bounds and limits nothing is corrected, nor with a model of others."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from correction_robot import (
    DT,
    HOME,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    ROUNDING,
    Robot,
    bent_tool,
    distance,
    drifted,
    endless,
    good_here_only,
    offer,
    pose,
    refused,
    still,
    swing,
)

from robocal_ros.correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.correction.interface import JointCommand, Reason, TrajectoryCommand
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground.samples import CORRECTED, TAUGHT
from robocal_ros.history.history_records import Past


def test_joint_limits_hold_after_the_correction(warm: Robot) -> None:
    q = HOME.copy()
    q[1] = NOMINAL.upper[1]
    # One side of the limit or the other: the correction decides, and never passes it.
    shift = (warm.stream() - HOME)[1]
    q[1] = NOMINAL.upper[1] - 0.5 * shift if shift > 0 else NOMINAL.lower[1] - 0.5 * shift
    trajectory = TrajectoryCommand(NAMES, np.stack([HOME, q]), np.array([0.0, 5.0]))
    assert "point 2" in refused(Reason.JOINT_LIMIT, warm.session.trajectory, trajectory, warm.now)


def test_limits_hold_when_off_too(robot: Robot) -> None:
    q = HOME.copy()
    q[4] = 3.0
    robot.at = q
    robot.rest()
    refused(Reason.JOINT_LIMIT, robot.stream, q)


def test_a_drift_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    robot.read(HOME)
    said = refused(Reason.TCP_BOUND, robot.session.offer_model, offer(drifted(12.0)))
    assert "mm" in said
    robot.session.enable(True)
    assert np.array_equal(robot.stream(), HOME)


def test_a_tool_beyond_its_bound_is_not_taken_over(robot: Robot) -> None:
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(11e-3, 0.0))
    refused(Reason.TOOL_BOUND, robot.session.offer_tool, bent_tool(0.0, 4.1))
    robot.session.offer_tool(bent_tool(10e-3, 3.0))
    wrong = bent_tool(parent="flange")
    refused(Reason.BAD_TOOL, robot.session.offer_tool, wrong)


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


def test_without_serials_robots_share_a_model_only_with_the_same_robot_file() -> None:
    nameless = Robot(robot_file_hash="0123456789abcdef")
    for other in ("", "fedcba9876543210"):
        told = refused(
            Reason.WRONG_ROBOT,
            nameless.session.offer_model,
            offer(drifted(), robot_file_hash=other),
        )
        assert "set the serial" in told
        refused(Reason.WRONG_ROBOT, nameless.session.offer_tool, bent_tool(robot_file_hash=other))
    nameless.session.offer_model(offer(drifted(), robot_file_hash="0123456789abcdef"))
    nameless.session.offer_tool(bent_tool(robot_file_hash="0123456789abcdef"))
    named = Robot()
    named.session.offer_model(offer(drifted(), robot_file_hash="fedcba9876543210"))


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
    robot.session.take_over()
    assert robot.session.status().revision is None
    robot.rest()
    robot.session.trajectory(still(first_s=1.0), robot.now)
    robot.session.take_over()
    assert robot.session.status().revision == 1
    assert robot.session.status().waiting_revision is None


def test_a_model_is_not_judged_where_the_robot_was_before_a_pause() -> None:
    """Others moved it meanwhile; where it is counts once it is read there."""
    robot = Robot()
    arm, far = good_here_only()
    robot.at = far
    robot.rest()
    robot.session.trajectory(still(far), robot.now)
    refused(Reason.TCP_BOUND, robot.session.offer_model, offer(arm))
    robot.now += 60.0
    robot.session.look(robot.now, 0)
    # it is still where it was sent, for all that is known
    refused(Reason.TCP_BOUND, robot.session.offer_model, offer(arm))
    robot.session.resume(robot.now, 0)
    robot.session.offer_model(offer(arm))
    assert robot.session.status().revision == 1
    robot.read(far)
    refused(Reason.TCP_BOUND, robot.session.offer_model, offer(arm, 2))
    status = robot.session.status()
    assert (status.revision, status.waiting_revision) == (1, 2)


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


def test_a_model_that_was_rolled_back_stays_so_where_its_message_is_repeated() -> None:
    """What is in force by then was measured before it."""
    robot = Robot()
    withdrawn = offer(drifted(), 7, stamp_ns=200)
    robot.session.offer_model(withdrawn)
    for arm, revision, stamp_ns in ((drifted(0.5), 8, 100), (NOMINAL, 9, 0)):
        robot.session.offer_model(offer(arm, revision, stamp_ns=stamp_ns))
        refused(Reason.OLD_REVISION, robot.session.offer_model, withdrawn)
        assert robot.session.status().revision == revision


def test_a_model_that_was_rolled_back_before_the_session_stays_so_where_it_is_repeated() -> None:
    robot = Robot()
    robot.session.know_past(Past(9, 200), Past())
    for _ in range(2):  # as the first one, and after the one in force
        refused(Reason.OLD_REVISION, robot.session.offer_model, offer(drifted(), 7, stamp_ns=200))
        robot.session.offer_model(offer(NOMINAL, 9))
    assert robot.session.status().revision == 9
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=201))  # the history began again
    assert robot.session.status().revision == 7


@pytest.mark.parametrize("on", [False, True])
def test_a_history_that_began_again_waits_for_the_operator_without_a_newer_stamp(on: bool) -> None:
    robot = Robot()
    robot.session.offer_model(offer(drifted(), 7, stamp_ns=10**15))
    for old in (offer(drifted(0.5), 1, stamp_ns=10**15), offer(NOMINAL, 0)):
        said = refused(Reason.OLD_REVISION, robot.session.offer_model, old)
        assert "take_over" in said
        assert robot.session.status().revision == 7
        assert robot.session.status().waiting_revision == old.revision
    robot.session.enable(on)  # is no look at it
    assert robot.session.status().revision == 7
    robot.session.take_over()
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


# ---- What the session does not take: bad values, clocks, its own output --------------------------


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite(warm: Robot, bad: float) -> None:
    q = HOME.copy()
    q[3] = bad
    session, now = warm.session, warm.now
    assert "joint_a4" in refused(Reason.NOT_FINITE, session.target, JointCommand(NAMES, q), now)
    fast = JointCommand(NAMES, HOME, velocity=q)
    refused(Reason.NOT_FINITE, session.target, fast, now)
    refused(Reason.NOT_FINITE, session.reading, JointCommand(NAMES, q), now)
    assert session.reading(fast, now).velocity is None  # a driver that has none says NaN
    points, times = np.stack([HOME, q]), np.array([0.0, 1.0])
    trajectory = TrajectoryCommand(NAMES, points, times)
    assert "point 2" in refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    still = np.stack([HOME, HOME])
    for rates in ({"velocity": points}, {"velocity": still, "acceleration": points}):
        trajectory = TrajectoryCommand(NAMES, still, times, **rates)
        refused(Reason.NOT_FINITE, session.trajectory, trajectory, now)
    assert session.status().refused[Reason.NOT_FINITE] == 6
    assert np.all(np.isfinite(warm.read(HOME).position))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_of_a_joint_without_limits_that_are_not_finite(bad: float) -> None:
    arm, q = endless(), HOME.copy()
    session = CorrectionSession(arm, arm, "s1", CorrectionConfig(**LIMITS))
    session.reading(JointCommand(NAMES, HOME), 100.0)
    q[5] = bad
    refused(Reason.NOT_FINITE, session.reading, JointCommand(NAMES, q), 100.0)
    refused(Reason.NOT_FINITE, session.target, JointCommand(NAMES, q), 100.0)
    refused(Reason.NOT_FINITE, session.taught, NAMES, q, None, 100.0)


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
    command = replace(swing(m=3), time_from_start_s=np.array([0.0, 1.0, 1.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    command = replace(command, time_from_start_s=np.array([-0.1, 1.0, 2.0]))
    refused(Reason.TIME_BACKWARDS, session.trajectory, command, warm.now)
    # after a look by the operator any source time will do
    session.acknowledge(warm.now)
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


def test_own_output_that_comes_back(warm: Robot) -> None:
    session, now = warm.session, warm.now
    out = warm.stream()
    marked = JointCommand(NAMES, HOME, mark=CORRECTED)
    refused(Reason.OWN_OUTPUT, session.target, marked, warm.now)
    refused(Reason.OWN_OUTPUT, session.trajectory, replace(swing(), mark=CORRECTED), warm.now)
    for mark in (CORRECTED, TAUGHT):
        refused(Reason.OWN_OUTPUT, session.reading, replace(marked, mark=mark), warm.now)
    # the same target again is no loop
    assert np.array_equal(warm.stream(), out)
    assert now < warm.now


# ---- What is done with a command whose correction exceeds a bound, and what is refused anyway ----


TIGHT = ShiftBounds(0.2e-3, np.radians(0.1), np.radians(0.3))
WIDE = ShiftBounds(1e-3, np.radians(0.1), np.radians(0.3))
LARGE = drifted(3.0)  # 0.3 mm at home: beyond the tight bound


def corrected(policy: Policy, **config: Any) -> Robot:
    """Enabled, with a drift that is too large at home; it was taken over before it was seen."""
    robot = Robot(rested=False, **({"policy": policy, "thermal": TIGHT} | config))
    robot.session.offer_model(offer(LARGE))
    robot.rest()
    robot.session.enable(True)
    return robot


def outputs(robot: Robot, count: int, q: np.ndarray = HOME) -> np.ndarray:
    return np.array([robot.stream(q) for _ in range(count)])


def speeds_are_the_blends(out: np.ndarray) -> bool:
    return bool(np.abs(np.diff(out, axis=0)).max() <= REST * DT + ROUNDING)


def test_the_drift_is_beyond_the_bound() -> None:
    assert distance(pose(LARGE, HOME), pose(NOMINAL, HOME)) > 1.2 * TIGHT.tcp_m


def test_clamped_it_goes_to_the_bound_and_no_further() -> None:
    robot = corrected(Policy.CLAMP)
    out = outputs(robot, 400)
    assert speeds_are_the_blends(out)
    made = distance(pose(LARGE, out[-1]), pose(LARGE, HOME))
    assert made == pytest.approx(TIGHT.tcp_m, rel=1e-3)
    rest = distance(pose(LARGE, out[-1]), pose(NOMINAL, HOME))
    whole = distance(pose(LARGE, HOME), pose(NOMINAL, HOME))
    assert rest == pytest.approx(whole - TIGHT.tcp_m, abs=2e-6)
    status = robot.session.status()
    assert status.settled
    assert status.policy is Policy.CLAMP
    assert status.clamped[Reason.TCP_BOUND] > 0
    assert not status.passed
    assert not status.refused
    assert np.allclose(robot.read(out[-1]).position, HOME, rtol=0.0, atol=1e-11)


def test_passed_on_the_offset_goes_on_the_way_there_and_comes_on_the_way_back() -> None:
    arm, far = good_here_only()
    robot = Robot(policy=Policy.PASS)
    robot.session.offer_model(offer(arm))
    robot.session.enable(True)
    shift = first = robot.settle() - HOME
    assert np.abs(shift).max() > 1e-4
    way = np.linspace(0.0, 1.0, 800)
    for x in np.concatenate([way, np.ones(200), way[::-1]]):
        q = HOME + x * (far - HOME)
        now = robot.stream(q) - q
        # by the motion a correction of some mrad changes by some mrad per rad
        assert np.abs(now - shift).max() <= REST * DT + 0.02 * np.abs(far - HOME).max() / 800
        assert np.allclose(robot.read(robot.at).position, q, rtol=0.0, atol=1e-11)
        shift = now
        if x == 1.0:
            there = now
    assert np.array_equal(there, np.zeros(6))
    assert robot.session.status().passed[Reason.TCP_BOUND] > 200
    assert np.allclose(robot.settle() - HOME, first, rtol=0.0, atol=1e-11)
    # of a direction that is weak for so large a drift, so much is given up as is reported
    left = robot.session.status().remaining_m
    assert distance(pose(arm, robot.at), pose(NOMINAL, HOME)) == pytest.approx(left, abs=1e-9)
    assert left < 1e-2 * distance(pose(arm, HOME), pose(NOMINAL, HOME))


def test_a_trajectory_is_clamped_or_passed_on_as_a_whole() -> None:
    for policy in (Policy.CLAMP, Policy.PASS):
        robot = corrected(policy)
        robot.read(HOME)
        out = robot.session.trajectory(still(), robot.now)
        steps = np.abs(np.diff(out.position, axis=0)).max(axis=1)
        assert steps.max() <= REST * 0.5 + ROUNDING
        made = distance(pose(LARGE, out.position[-1]), pose(LARGE, HOME))
        assert made == pytest.approx(TIGHT.tcp_m if policy is Policy.CLAMP else 0.0, abs=1e-7)
        status = robot.session.status()
        counted = status.clamped if policy is Policy.CLAMP else status.passed
        assert counted == {Reason.TCP_BOUND: 1}


def test_what_is_clamped_is_counted_where_it_goes_out() -> None:
    robot = corrected(Policy.CLAMP, velocity_limits=np.ones(6))
    robot.read(HOME)
    refused(Reason.TOO_SHORT, robot.session.trajectory, still(seconds=1e-3), robot.now)
    assert not robot.session.status().clamped
    outputs(robot, 400)
    robot.stream(HOME + 0.01)  # so far in several steps
    assert robot.session.status().lag_s > 0.0
    assert robot.session.status().clamped == {Reason.TCP_BOUND: 401}


def test_a_blend_along_a_trajectory_is_no_faster_where_a_bound_holds_on_a_part_of_it() -> None:
    """The clamped shift is made on the first third of the blend, and then stays."""
    robot = Robot(rested=False, policy=Policy.CLAMP, thermal=ShiftBounds(0.1e-3, 0.1, 0.1))
    robot.session.offer_model(offer(LARGE))
    robot.rest()
    robot.session.enable(True)
    robot.read(HOME)
    times = np.linspace(0.0, 2.0, 201)
    path = TrajectoryCommand(NAMES, np.tile(HOME, (201, 1)), times)
    out = robot.session.trajectory(path, robot.now)
    steps = np.abs(np.diff(out.position, axis=0)).max(axis=1)
    assert 0.0 < steps.max() <= REST * 0.01 + ROUNDING


@pytest.mark.parametrize("policy", [Policy.CLAMP, Policy.PASS])
def test_towards_a_joint_limit_a_stream_goes_on(policy: Policy) -> None:
    robot = Robot(policy=policy)
    robot.session.offer_model(offer(drifted(3.0)))
    robot.session.enable(True)
    q = HOME.copy()
    q[1] = NOMINAL.upper[1] - 1e-3
    robot.at = q
    robot.rest()
    robot.settle(q)
    last, worst = robot.at - q, 0.0
    for x in np.concatenate([np.linspace(1e-3, 0.0, 400), np.linspace(0.0, 1e-3, 400)]):
        q[1] = NOMINAL.upper[1] - x
        shift = robot.stream(q) - q
        assert robot.at[1] <= NOMINAL.upper[1] + 1e-12
        assert np.allclose(robot.read(robot.at).position, q, rtol=0.0, atol=1e-11)
        worst = max(worst, float(np.abs(shift - last).max()))
        last = shift
    # by a third of the motion where it fades, and by the blend where it is passed on
    assert worst <= REST * DT + 1e-3 / 400 / 2
    status = robot.session.status()
    counted = status.clamped if policy is Policy.CLAMP else status.passed
    assert counted[Reason.JOINT_LIMIT] > 0
    assert not status.refused
    # nothing can be done for a taught joint beyond it
    q[1] = NOMINAL.upper[1] + 1e-4
    refused(Reason.JOINT_LIMIT, robot.stream, q)


# ---- velocity limits -----------------------------------------------------------------------------

LIMIT = np.full(6, 1.0)


def line(speed: float, m: int = 41) -> TrajectoryCommand:
    """All joints at one speed."""
    times = np.linspace(0.0, 0.4, m)
    q = HOME + speed * times[:, None]
    return TrajectoryCommand(NAMES, q, times, np.full((m, 6), speed))


@pytest.mark.parametrize("policy", Policy)
@pytest.mark.parametrize("with_rates", [False, True])
def test_a_trajectory_beyond_a_velocity_limit(policy: Policy, with_rates: bool) -> None:
    robot = Robot(policy=policy, velocity_limits=LIMIT)
    robot.read(HOME)
    for on in (False, True):
        robot.session.enable(on)
        path = line(1.01)
        if not with_rates:
            path = replace(path, velocity=None)
        said = refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, path, robot.now)
        assert "joint_a1" in said
    robot.session.trajectory(line(0.99), robot.now)


def test_two_messages_at_once_after_a_delay_are_not_too_fast() -> None:
    robot = Robot(velocity_limits=LIMIT)
    q = HOME
    for k in range(100):
        q = HOME + 0.9 * DT * k
        robot.stream(q, dt=1.9 * DT if k % 2 else 0.1 * DT)
    assert not robot.session.status().refused


def test_a_velocity_that_a_target_names_counts() -> None:
    robot = Robot(velocity_limits=LIMIT)
    robot.stream()
    refused(Reason.VELOCITY_LIMIT, robot.stream, velocity=np.full(6, 1.1))
    robot.stream(velocity=np.full(6, 0.9))


# ---- what nobody can mean ------------------------------------------------------------------------


def test_positions_that_look_like_degrees(robot: Robot) -> None:
    session, now = robot.session, robot.now
    degrees = np.degrees(HOME)
    robot.read(HOME)
    for act in (session.target, session.reading):
        refused(Reason.DEGREES, act, JointCommand(NAMES, degrees), now)
    path = TrajectoryCommand(NAMES, np.stack([HOME, degrees]), np.array([0.0, 1.0]))
    refused(Reason.DEGREES, session.trajectory, path, now)
    # a joint that may turn so far is not in degrees; one that is beyond its limit is just that
    wide = replace(NOMINAL, upper=np.full(6, 20.0), lower=np.full(6, -20.0))
    turning = Robot()
    turning.session = type(session)(wide, wide, "s1")
    turning.at = HOME + 15.0
    turning.rest()
    turning.stream(turning.at)
    robot.at = HOME + np.array([0.0, 0.0, 0.0, 0.0, 5.0, 0.0])
    robot.rest()
    refused(Reason.JOINT_LIMIT, robot.stream, robot.at)


def test_all_joints_far_beyond_their_limits_are_degrees_too() -> None:
    """Small limits: ten degrees are less than two turns."""
    narrow = replace(NOMINAL, upper=np.full(6, 0.5), lower=np.full(6, -0.5))
    robot = Robot()
    robot.session = type(robot.session)(narrow, narrow, "s1")
    refused(Reason.DEGREES, robot.session.reading, JointCommand(NAMES, np.full(6, 5.1)), 1.0)
    robot.session.reading(JointCommand(NAMES, np.array([0.4] + [5.1] * 5)), 1.0)


def test_a_burst_is_refused_before_it_is_looked_at(robot: Robot) -> None:
    robot.read(HOME)
    points = np.broadcast_to(HOME, (100_001, 6))
    path = TrajectoryCommand(NAMES, points, np.arange(100_001.0))
    refused(Reason.BURST, robot.session.trajectory, path, robot.now)
    robot.session.trajectory(line(0.1, m=10_000), robot.now)


# ---- shadow --------------------------------------------------------------------------------------


def test_in_shadow_mode_everything_passes_as_it_came_and_the_correction_is_shown() -> None:
    robot = Robot(shadow=True)
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.offer_tool(bent_tool())
    robot.session.enable(True)
    for _ in range(3000):
        assert np.array_equal(robot.stream(), HOME)
        assert np.array_equal(robot.read(HOME).position, HOME)
    status = robot.session.status()
    assert status.shadow
    assert status.settled
    seen = Robot()
    seen.session.offer_model(offer(drifted(2.0)))
    seen.session.offer_tool(bent_tool())
    seen.session.enable(True)
    assert np.allclose(robot.session.offset(robot.now).offset, seen.settle() - HOME, atol=1e-12)
    path = still(first_s=0.01)
    assert robot.session.trajectory(path, robot.now) is path


def test_in_shadow_mode_a_refusal_of_the_correction_is_only_counted() -> None:
    robot = corrected(Policy.REFUSE, shadow=True)
    long = TrajectoryCommand(NAMES, np.tile(HOME, (2, 1)), np.array([0.0, 60.0]))
    assert robot.session.trajectory(long, robot.now) is long
    assert robot.session.status().refused == {Reason.TCP_BOUND: 1}
    marked = JointCommand(NAMES, HOME, mark=CORRECTED)
    refused(Reason.OWN_OUTPUT, robot.session.target, marked, robot.now)
    refused(Reason.NOT_FINITE, robot.stream, HOME * np.nan)
