# SPDX-License-Identifier: Apache-2.0
"""Trajectories are corrected as a whole, with a blend along their time."""

import contextlib

import numpy as np
import pytest
from correction_robot import (
    DT,
    FASTEST,
    HOME,
    LARGEST_A,
    LIMITS,
    NAMES,
    NOMINAL,
    REST,
    REST_A,
    ROUNDING,
    Robot,
    bent_tool,
    distance,
    drifted,
    endless,
    large,
    offer,
    pose,
    refused,
    still,
    swing,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from long_form import amount
from scipy.interpolate import BPoly

from robocal_ros.correction.bounds import CorrectionConfig
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.session import CorrectionSession
from robocal_ros.ground.samples import CORRECTED, TAUGHT


def test_a_trajectory_is_corrected_as_a_whole(warm: Robot) -> None:
    command = swing()
    out = warm.session.trajectory(command, warm.now)
    corrected = distance(pose(drifted(), out.position[5:]), pose(NOMINAL, command.position[5:]))
    assert corrected < 1e-9  # after the step of its acceleration
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
    assert slow.max() < REST


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


def test_a_trajectory_that_came_much_too_late_is_refused(robot: Robot) -> None:
    """The robot still stands where it began: the controller would jump to where it should be."""
    robot.read(HOME)
    command = swing()
    refused(Reason.START_MISMATCH, robot.session.trajectory, command, robot.now, starts_in_s=-0.5)
    assert robot.session.status().mismatch


def test_a_later_trajectory_begins_when_it_says(robot: Robot) -> None:
    robot.session.offer_model(offer(drifted(2.0)))
    robot.session.enable(True)
    robot.read(HOME)
    command = swing()
    out = robot.session.trajectory(command, robot.now, starts_in_s=3.0)
    assert np.allclose(robot.read(HOME).position, HOME, rtol=0.0, atol=1e-12)
    taught = robot.session.reading(JointCommand(NAMES, out.position[-1]), robot.now + 5.0)
    assert np.allclose(taught.position, command.position[-1], rtol=0.0, atol=1e-9)


def test_ten_thousand_points_at_once(warm: Robot) -> None:
    command = swing(m=10_000)
    out = warm.session.trajectory(command, warm.now)
    left = distance(pose(drifted(), out.position[100:]), pose(NOMINAL, command.position[100:]))
    assert left < 1e-9  # after the step of its acceleration


# ---- What a controller makes of corrected points keeps the limits of the offset between them too


TOLERANCE = 1e-6  # relative; of the seventeen places of each piece that are looked at
Motion = tuple[np.ndarray, np.ndarray]


class Driven:
    """Cubics through positions and velocities, quintics where there are accelerations.

    It comes in by a cubic from where and as fast as the controller is.
    """

    def __init__(self, command: TrajectoryCommand, begin: Motion) -> None:
        t, fields = command.time_from_start_s, [command.position, command.velocity]
        if command.acceleration is not None:
            fields.append(command.acceleration)
        rows = np.stack(fields, axis=1)
        self.end_s, self.last = t[-1], command.position[-1]
        self.pieces = []
        if t[0] > 0.0:
            ends = [np.array(begin), rows[0, :2]]
            self.pieces.append(BPoly.from_derivatives([0.0, t[0]], ends))
        if len(t) > 1:
            self.pieces.append(BPoly.from_derivatives(t, rows))

    def at(self, t: float) -> Motion:
        for piece in self.pieces:
            if t <= piece.x[-1]:
                return piece(t), piece(t, nu=1)
        return self.last, np.zeros(6)

    def places(self, t: np.ndarray) -> np.ndarray:
        """As `at`, for times (m,)."""
        rows = np.tile(self.last, (len(t), 1))
        for piece in reversed(self.pieces):
            before = t <= piece.x[-1]
            rows[before] = piece(t[before])
        return rows

    def peaks(self, taught: "Driven") -> tuple[float, float]:
        """Fastest rate and acceleration of the offset from the taught motion."""
        rate = bend = 0.0
        for mine, own in zip(self.pieces, taught.pieces, strict=True):
            h = np.diff(mine.x)
            t = (mine.x[:-1, None] + h[:, None] * np.linspace(1e-7, 1 - 1e-7, 17)).ravel()
            rate = max(rate, np.abs(mine(t, nu=1) - own(t, nu=1)).max())
            bend = max(bend, np.abs(mine(t, nu=2) - own(t, nu=2)).max())
        return rate, bend


def quintic(begin: Motion, end: np.ndarray, lasts: float, m: int, *, bends: bool) -> np.ndarray:
    """From where and as fast as it is to rest: times, positions, velocities, accelerations."""
    zero = np.zeros(6)
    curve = BPoly.from_derivatives([0.0, lasts], [[*begin, zero], [end, zero, zero]])
    t = np.linspace(0.0, lasts, m)
    return TrajectoryCommand(NAMES, curve(t), t, curve(t, nu=1), curve(t, nu=2) if bends else None)


def shifted(command: TrajectoryCommand, first_s: float) -> TrajectoryCommand:
    times = command.time_from_start_s + first_s
    fields = command.position, times, command.velocity, command.acceleration
    return TrajectoryCommand(NAMES, *fields)


def check(robot: Robot, command: TrajectoryCommand, begins: tuple[Motion, Motion], rest: bool):
    out = robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    own, mine = (Driven(c, b) for c, b in zip((command, out), begins, strict=True))
    rate, bend = mine.peaks(own)
    assert rate <= (REST if rest else FASTEST) * (1.0 + TOLERANCE)
    assert bend <= (REST_A if rest else LARGEST_A) * (1.0 + TOLERANCE)
    return own, mine


LEG = st.tuples(
    st.sampled_from(["on", "off", "model", "tool", "nothing"]),
    st.integers(0, 50),
    st.sampled_from([0.004, 0.01, 0.02, 0.05, 0.2, 1.0]),  # s between points
    st.sampled_from([0.0, 0.05, 0.3]),  # s to the first
    st.booleans(),  # accelerations
    st.booleans(),  # stands
    st.floats(0.1, 1.4),  # so much of it is driven until the next
)


COARSE = [("tool", 50, 1.0, 0.3, True, False, 0.6), ("on", 20, 1.0, 0.3, True, False, 0.35)]


@settings(max_examples=amount(10, 25), deadline=None)
@example([*COARSE, ("off", 30, 0.2, 0.05, True, False, 0.5)])
@example([*COARSE[::-1], ("model", 30, 0.01, 0.05, False, False, 0.5)])
@example(
    [
        *[("on", 0, 0.004, 0.0, False, False, 1.0)] * 3,
        ("tool", 9, 0.004, 0.0, False, False, 1.25),
        ("off", 0, 0.004, 0.3, False, True, 0.1015625),
        ("on", 0, 0.004, 0.0, False, False, 1.0),
    ]
)
@given(st.lists(LEG, min_size=1, max_size=6))
def test_between_the_points_too(legs: list) -> None:
    """One after the other, from rest and in place of one that is under way."""
    robot = large()
    stood = quintic((HOME, 0.0 * HOME), HOME, 0.1, 2, bends=False)
    own = mine = Driven(stood, (HOME, 0.0 * HOME))
    began_s = robot.now - 1.0
    for revision, (what, seed, spacing, first_s, bends, stands, part) in enumerate(legs, start=10):
        if what in ("on", "off"):
            robot.session.enable(what == "on")
        elif what == "model":
            robot.session.offer_model(offer(drifted(0.04 * seed, seed), revision))
        elif what == "tool":
            robot.session.offer_tool(bent_tool(6e-5 * seed, 0.01 * seed))
        moving = robot.now - began_s < own.end_s
        first_s = max(first_s, 0.05) if moving else first_s
        begins = own.at(robot.now - began_s), mine.at(robot.now - began_s)
        begin = own.at(robot.now - began_s + first_s)
        rest = stands and not moving
        end = begin[0] if rest else HOME + np.random.default_rng(seed).uniform(-0.5, 0.5, 6)
        way_s = np.max(np.abs(end - begin[0]) / LIMITS["velocity_limits"]) * 3.2
        lasts = 2.0 + way_s + 4.0 * np.max(np.abs(begin[1]) / LIMITS["acceleration_limits"])
        m = max(int(lasts / spacing), 1) + 1
        command = shifted(quintic(begin, end, lasts, m, bends=bends), first_s)
        try:
            own, mine = check(robot, command, begins, rest and first_s == 0.0)
            began_s = robot.now
        except RefusedError as error:
            fine = (Reason.VELOCITY_LIMIT, Reason.TCP_BOUND)
            if error.reason not in (fine if spacing < 0.05 else (*fine, Reason.TOO_SHORT)):
                raise
        drive_s = part * own.end_s + (0.5 if part > 1.0 else 0.0)
        times = np.arange(robot.now, robot.now + drive_s, 0.01)
        for now, place in zip(times.tolist(), mine.places(times - began_s), strict=True):
            robot.now, robot.at = now, place
            robot.read(robot.at)


@pytest.mark.parametrize("spacing", [0.01, 0.02, 0.05, 0.1, 0.25, 0.5])
def test_at_rest_between_the_points_too(spacing: float) -> None:
    for bends in (None, np.zeros((round(4.0 / spacing) + 1, 6))):
        robot, t = large(), np.linspace(0.0, 4.0, round(4.0 / spacing) + 1)
        rows = np.tile(HOME, (len(t), 1))
        command = TrajectoryCommand(NAMES, rows, t, np.zeros_like(rows), bends)
        check(robot, command, ((HOME, 0.0 * HOME),) * 2, rest=True)


@pytest.mark.parametrize("m", [11, 21, 51, 101, 201, 2001])
@pytest.mark.parametrize("bends", [False, True])
def test_a_tool_that_comes_in_on_a_swing(m: int, bends: bool) -> None:
    command = swing(m)
    if not bends:
        command = TrajectoryCommand(
            NAMES, command.position, command.time_from_start_s, command.velocity
        )
    check(large(), command, ((HOME, 0.0 * HOME),) * 2, rest=False)


@pytest.mark.parametrize("spacing", [0.004, 0.01, 0.05])
@pytest.mark.parametrize("streamed", [10, 30, 60])
def test_from_a_stream_that_moves(spacing: float, streamed: int) -> None:
    """Its offset still comes in: the trajectory goes on with its rate."""
    robot, speed, q = large(), np.radians(30.0) * np.array([1, -0.5, 0.5, -1, 1, 1]), HOME.copy()
    robot.stream(q)
    before = q, robot.at
    for i in range(streamed):
        before = q, robot.at
        q = q + speed * min((i + 1) / 50, 1.0) * DT
        robot.stream(q)
    v = (q - before[0]) / DT
    rate = (robot.at - before[1]) / DT - v
    command = quintic((q, v), q + 0.3 * speed, 2.0, round(2.0 / spacing) + 1, bends=False)
    own, mine = check(robot, command, ((q, v), (robot.at, v + rate)), rest=False)
    assert np.allclose(mine.at(0.0)[0], robot.at, rtol=0.0, atol=1e-9)
    step = mine.at(0.0)[1] - own.at(0.0)[1] - rate
    assert np.all(np.abs(step) <= LARGEST_A * DT + 1e-9)


# ---- What a robot shows may not be what it was sent: rejected commands, stalls, other hands ------


SECOND = 1_000_000_000


@pytest.fixture
def corrected() -> Robot:
    """At rest, corrected by some tenths of a degree."""
    robot = large()
    robot.settle()
    robot.rest(1.0)
    return robot


def waits(robot: Robot, seconds: float) -> None:
    for _ in range(round(seconds / 0.05)):
        robot.now += 0.05
        robot.read(robot.at)


@pytest.mark.parametrize("again", ["target", "trajectory"])
def test_off_a_way_out_that_was_rejected_is_gone_again(corrected: Robot, again: str) -> None:
    """The correction should have gone with that trajectory; the robot still shows it."""
    corrected.session.enable(False)
    corrected.session.trajectory(still(seconds=20.0), corrected.now)
    waits(corrected, 21.0)
    at = corrected.at
    if again == "target":
        out = np.array([corrected.stream() for _ in range(500)])
        dt = DT
    else:
        out = corrected.session.trajectory(still(seconds=5.0), corrected.now).position
        dt = 5.0 / 40
    assert np.abs(out[0] - at).max() <= ROUNDING  # from where it stands
    assert np.abs(np.diff(out, axis=0)).max() <= REST * dt + ROUNDING
    assert np.array_equal(out[-1], HOME)


def test_a_refused_trajectory_is_no_beginning(corrected: Robot) -> None:
    fresh = large()
    fresh.session.enable(False)
    fresh.at = corrected.at
    fresh.rest()
    beyond = np.tile(HOME, (41, 1))
    beyond[-1, 0] = 4.0
    path = TrajectoryCommand(NAMES, beyond, np.linspace(8.0, 28.0, 41))
    refused(Reason.JOINT_LIMIT, fresh.session.trajectory, path, fresh.now)
    assert np.abs(fresh.stream() - corrected.at).max() < np.radians(0.02)  # goes on from there


def test_a_robot_that_somebody_else_moves_is_not_lagging(corrected: Robot) -> None:
    corrected.now += 60.0
    q = corrected.at.copy()
    for _ in range(60):
        corrected.now += 0.01
        q[0] += 0.008
        corrected.read(q)
    beside = q.copy()
    beside[0] -= 0.14
    command = JointCommand(NAMES, beside)
    refused(Reason.START_MISMATCH, corrected.session.target, command, corrected.now)


def test_a_model_from_the_future_is_as_stale_as_an_old_one() -> None:
    robot = Robot(model_age_s=60.0)
    robot.session.offer_model(offer(drifted(), stamp_ns=200 * SECOND))
    robot.session.look(robot.now, 100 * SECOND)
    assert "100.0 s in the future" in robot.session.status().stale


def test_a_controllers_reference_is_as_old_as_what_it_said_of_the_joint() -> None:
    """A scaling alone, and the states of other joints, say nothing of where it is."""
    robot = Robot()
    session, nothing = robot.session, np.empty(0)
    ahead = HOME + 0.01  # of the robot, which lags
    session.controller(NAMES, ahead, 1.0, robot.now)
    assert np.array_equal(robot.stream(ahead), ahead)
    for names, position in (
        ((), nothing),
        (("gripper",), np.zeros(1)),
        (NAMES[:5], ahead[:5]),
        (NAMES, np.array([*ahead[:5], np.nan])),
    ):
        robot = Robot()
        robot.session.controller(NAMES, ahead, 1.0, robot.now)
        robot.rest(0.2)
        robot.session.controller(names, position, 1.0, robot.now)
        refused(Reason.START_MISMATCH, robot.stream, ahead)


def test_a_controller_that_has_the_robot_elsewhere_is_another_robots() -> None:
    """Finding: a target 28.6 deg beside the robot was accepted, as controller_state had it."""
    robot = Robot()
    robot.session.controller(NAMES, HOME + 0.5, 1.0, robot.now)
    refused(Reason.START_MISMATCH, robot.stream, HOME + 0.5)


# ---- Where the controller is: by its own words, which are old, between points, and in motion -----


TELLS_S = 0.02  # period of joint_trajectory_controller's state: 50 Hz
# Of a stop from a second or later place, whose first point a controller takes at once.
STOP_S = np.linspace(0.0, 1.0, 101)


def on_its_way(age_s: float, *, velocities: bool) -> tuple[Robot, np.ndarray, np.ndarray, float]:
    """A robot in mid-swing whose controller told its state ``age_s`` ago: place, speed, fastest
    acceleration (rad/s^2) of the way."""
    robot, way = Robot(), swing()
    assert way.velocity is not None
    assert way.acceleration is not None
    robot.session.trajectory(way, robot.now)
    path = robot.session.output.path
    assert path is not None
    begin_s = robot.now
    told_s, end_s = begin_s + 0.7 - age_s - 10.0 * TELLS_S, begin_s + 0.7

    def at(now_s: float) -> tuple[np.ndarray, np.ndarray]:
        u = (now_s - begin_s) / 2.0
        share = 0.5 * (1.0 - np.cos(np.pi * u)), 0.25 * np.pi * np.sin(np.pi * u)
        reach = way.position[-1] - HOME
        return HOME + share[0] * reach, share[1] * reach

    while robot.now < end_s - 1e-9:
        robot.now = min(robot.now + DT, end_s)
        robot.read(at(robot.now)[0])
        while told_s <= min(robot.now, end_s - age_s) + 1e-9:
            q, qd = at(told_s)
            given = {"velocity": qd} if velocities else {}
            robot.session.controller(NAMES, q, 1.0, robot.now, age_s=robot.now - told_s, **given)
            told_s += TELLS_S
    return robot, *at(end_s), float(np.abs(way.acceleration).max())


@pytest.mark.parametrize("velocities", [True, False])
@pytest.mark.parametrize("age_s", [0.004, 0.008, 0.02, 0.028, 0.06])
def test_a_reference_of_a_robot_in_motion_is_carried_on(age_s: float, velocities: bool) -> None:
    """A trajectory at once begins where the controller is, not where it was told to have been."""
    for behind_s in (0.0, age_s):
        robot, place, speed, bend = on_its_way(age_s, velocities=velocities)
        begin = place - behind_s * speed
        slow = TrajectoryCommand(
            NAMES,
            begin + np.outer(STOP_S - 0.5 * STOP_S**2, speed),
            STOP_S,
            np.outer(1.0 - STOP_S, speed),
        )
        # one that begins elsewhere may be refused
        with contextlib.suppress(*([RefusedError] if behind_s else [])):
            out = robot.session.trajectory(slow, robot.now)
            # by the mean speed of a period: of its middle
            old_s = age_s if velocities else age_s + TELLS_S
            assert np.abs(out.position[0] - place).max() <= 0.5 * bend * old_s**2 + ROUNDING


def test_a_path_that_has_begun_is_where_its_cubic_is() -> None:
    """Two points in 2 s, begun half a second ago: a controller is not on the line between them."""
    reach = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    way = TrajectoryCommand(
        NAMES, np.array([HOME, HOME + reach]), np.array([0.0, 2.0]), np.zeros((2, 6))
    )
    u = 0.25
    robot = Robot(rested=False)
    robot.at = HOME + (3.0 * u**2 - 2.0 * u**3) * reach
    robot.rest()
    out = robot.session.trajectory(way, robot.now, -u * 2.0)
    assert np.array_equal(out.position, way.position)
    robot = Robot(rested=False)
    robot.at = HOME + u * reach
    robot.rest()
    refused(Reason.START_MISMATCH, robot.session.trajectory, way, robot.now, -u * 2.0)


@pytest.mark.parametrize("lead_s", [0.03, 0.05, 0.1, 0.2])
@pytest.mark.parametrize("speed", [0.1, 0.5])
def test_where_nobody_knows_the_place_the_offset_comes_in_as_ever(
    lead_s: float, speed: float
) -> None:
    """A robot that somebody jogs, a bent tool that waits, and a trajectory that leads in soon."""
    robot = Robot()
    robot.session.enable(True)
    robot.settle()
    moves, begin_s = np.array([speed, 0.0, 0.0, 0.0, 0.0, 0.0]), robot.now
    while robot.now < begin_s + 0.5:
        robot.now += DT
        robot.at = HOME + moves * (robot.now - begin_s)
        robot.read(robot.at)
    robot.session.offer_tool(bent_tool(9e-3, 3.5))
    times = lead_s + np.linspace(0.0, 6.0, 121)
    q = np.tile(robot.at + lead_s * moves, (121, 1))
    out = robot.session.trajectory(TrajectoryCommand(NAMES, q, times), robot.now)
    offset = out.position - q
    assert np.abs(offset[0]).max() <= FASTEST * lead_s + ROUNDING
    assert np.abs(np.diff(offset, axis=0)).max() <= FASTEST * np.diff(times).max() + ROUNDING
    assert np.abs(offset[-1]).max() > np.radians(1.0)  # the tool is corrected in the end


@pytest.mark.parametrize("bends", [False, True])
def test_the_speed_between_points_is_that_of_the_spline(bends: bool) -> None:
    """From rest to rest a cubic is 1.5 times, a quintic 1.875 times as fast as its mean."""
    peak = 1.875 if bends else 1.5
    limit = LIMITS["velocity_limits"][0]

    def move(share: float) -> TrajectoryCommand:
        q = np.array([HOME, HOME + np.array([share * limit * 2.0 / peak, 0, 0, 0, 0, 0])])
        rates = np.zeros((2, 6))
        return TrajectoryCommand(NAMES, q, np.array([0.0, 2.0]), rates, rates if bends else None)

    robot = Robot()
    words = refused(Reason.VELOCITY_LIMIT, robot.session.trajectory, move(1.01), robot.now)
    assert "joint_a1 would move at" in words
    robot.session.trajectory(move(0.99), robot.now)


def test_a_joint_without_limits_stands_where_its_turns_meet() -> None:
    """Readings go to and fro between pi and -pi by a microradian."""
    arm = endless()
    session = CorrectionSession(arm, arm, "s1", CorrectionConfig(**LIMITS))
    here = np.array([*HOME[:5], np.pi])
    for i in range(60):
        here[5] = np.pi - 1e-6 if i % 2 else -np.pi + 1e-6
        session.reading(JointCommand(NAMES, here.copy()), 100.0 + 0.01 * i)
    begin = np.array([*HOME[:5], np.pi])
    session.target(JointCommand(NAMES, begin), 100.6)


def test_a_scaling_that_is_no_number_is_none() -> None:
    robot = Robot()
    robot.session.controller((), np.empty(0), 0.5, robot.now)
    robot.session.controller((), np.empty(0), np.nan, robot.now)
    robot.session.trajectory(swing(), robot.now)
    path = robot.session.output.path
    assert path is not None
    assert path.time(robot.now + 1.0) == pytest.approx(0.5)
