# SPDX-License-Identifier: Apache-2.0
"""Whatever happens in whatever order: offset and commands move within their limits in time."""

from typing import Any

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
    START,
    Robot,
    bent_tool,
    drifted,
    large,
    offer,
    refused,
    still,
    swing,
)
from hypothesis import example, given, settings
from hypothesis import strategies as st
from joint_errors import with_joint_errors
from scipy.interpolate import CubicHermiteSpline

from robocal_ros.correction.bounds import CorrectionConfig, Policy, ShiftBounds
from robocal_ros.correction.interface import JointCommand, Reason, RefusedError, TrajectoryCommand
from robocal_ros.correction.limiter import LONGEST_STEP_S, STILL
from robocal_ros.correction.sent_path import SentPath

WIDE = {"thermal": CorrectionConfig().tool}  # bounds that let large drifts through
TIGHT = {"thermal": ShiftBounds(0.1e-3, np.radians(0.1), np.radians(0.3))}  # and that many exceed
MODES = [
    WIDE,
    WIDE | {"free_axis": True},
    TIGHT | {"policy": Policy.CLAMP},
    TIGHT | {"policy": Policy.PASS},
]

BEGINS = np.inf  # for the rate of an offset
INSTANT_S = 1e-6


class Watch:
    """Compares what came in with what went out, step by step, with the limits over time."""

    def __init__(self, robot: Robot, period_s: float = DT) -> None:
        self.robot, self.period_s = robot, period_s  # the least of the stream's
        self.begins, self.now_s, self.elapsed_s = True, -np.inf, np.inf  # nothing went out yet
        self.last: dict[int, tuple[float, float]] = {}  # joint: when, out
        self.came: dict[int, float] = {}  # joint: its target, as it was followed
        self.offsets: dict[int, tuple[float, float, float]] = {}  # when, offset, rate
        self.begun: dict[int, float] = {}  # joints with one step since they stood: its rate at most
        self.taught = np.full(6, np.nan)  # the last target, as it was followed

    def out(self, names: tuple[str, ...], out: np.ndarray, stood: np.ndarray | None = None) -> None:
        """Positions that went out now: no joint is faster than it may be.

        The first of a stream are where the robot ``stood`` (6,), others no more than two periods
        from those before, as the controller has held since.
        """
        now, index = self.robot.now, [NAMES.index(name) for name in names]
        if self.begins and stood is not None:
            assert np.all(np.abs(out - stood[index]) <= START + ROUNDING)
        self.begins, self.now_s, self.elapsed_s = False, now, now - self.now_s
        periods_s = 2.0 * np.fmax(self.period_s, self.robot.session.stream.period_s)
        for j, x in zip(index, out, strict=True):
            if j in self.last:
                at, before = self.last[j]
                fastest = LIMITS["velocity_limits"][j]
                longest = min(now - at, periods_s)
                assert abs(x - before) <= fastest * longest + ROUNDING, (NAMES[j], x - before)
            self.last[j] = now, x

    def offset(
        self, names: tuple[str, ...], taught: np.ndarray, out: np.ndarray, way: bool = False
    ) -> None:
        """The same, of targets as they were followed; where none moves, the limits at rest.

        On a ``way`` between two points of a trajectory that is in motion the limits are those of
        motion from its first instant on.
        """
        now, index = self.robot.now, [NAMES.index(name) for name in names]
        ways = [abs(q - self.came.get(j, q)) for j, q in zip(index, taught, strict=True)]
        moves = way or max(ways) > STILL * self.elapsed_s
        for name, j, q, x in zip(names, index, taught, out, strict=True):
            offset, self.came[j] = x - q, q
            if j in self.offsets:
                at, before, rate = self.offsets[j]
                dt = now - at
                if dt < INSTANT_S:  # rounding over it is more than any rate: the next step tells
                    assert abs(offset - before) <= FASTEST * dt + ROUNDING
                    continue
                new = (offset - before) / dt
                calm = not moves and abs(rate) <= REST
                fastest, change = (REST, REST_A) if calm else (FASTEST, LARGEST_A)
                assert abs(new) <= fastest + ROUNDING / dt
                # after two periods without a message the controller holds, and the robot stands
                held = dt > 2.0 * self.period_s + ROUNDING
                if np.isfinite(rate):
                    # the step that began at rest is one of the rate's already
                    begun = self.begun.get(j, 0.0)
                    goes_on = abs(new - rate) <= change * dt + begun + 2.0 * ROUNDING / dt
                    from_rest = abs(offset - before) <= LARGEST_A * dt * dt + ROUNDING
                    assert goes_on or (held and from_rest), name
                self.begun.pop(j, None)
                if rate == BEGINS:  # after a pause as one of its period, the longest where unknown
                    period_s = self.robot.session.stream.period_s
                    step_s = np.fmin(period_s, LONGEST_STEP_S) if held else self.period_s
                    self.begun[j] = (LARGEST_A if moves else REST_A) * step_s
                self.offsets[j] = now, offset, 0.0 if rate == BEGINS else np.nan if held else new
            else:
                self.offsets[j] = now, offset, 0.0

    def followed(self, index: list[int], target: np.ndarray) -> np.ndarray:
        """A target, or where there is a lag the part of the way there that was followed."""
        followed = self.robot.session.output.taught[index]
        if self.robot.session.status().lag_s == 0.0:
            assert np.array_equal(followed, target)
        else:
            before = self.taught[index]
            assert np.all(np.minimum(before, target) - ROUNDING <= followed)
            assert np.all(followed <= np.maximum(before, target) + ROUNDING)
        self.taught[index] = followed
        return followed

    def ended(self) -> None:
        """What comes next begins at rest with what offset it finds, which is no rate."""
        self.offsets = {j: (at, offset, BEGINS) for j, (at, offset, _) in self.offsets.items()}

    def forget(self) -> None:
        """Nothing was commanded for a while: offsets are those of what begins anew."""
        self.offsets.clear()
        self.begins = True


EVENT = st.tuples(
    st.sampled_from(
        [
            "on", "off", "model", "full", "nominal", "tool", "nan", "beyond", "some", "stall",
            "pause", "backwards", "held", "nothing", "path", "late", "midway", "rejected",
            "acknowledged", "stopped",
        ]
    ),
    st.integers(0, 5),
    st.integers(1, 60),
)  # fmt: skip


def happen(robot: Robot, watch: Watch, what: str, seed: int, revision: int, q: np.ndarray) -> None:
    session = robot.session
    if what in ("on", "off"):
        session.enable(what == "on")
    elif what in ("model", "full"):
        arm = drifted(0.4 * seed, seed)
        if what == "full":
            arm = with_joint_errors(drifted(0.2 * seed, seed), seed)
        try:
            session.offer_model(offer(arm, revision))
        except RefusedError as error:
            if error.reason is not Reason.TCP_BOUND:  # where the robot is, of tight bounds
                raise
    elif what == "nominal":
        session.offer_model(offer(NOMINAL, revision))
    elif what == "tool":
        session.offer_tool(bent_tool(1.5e-3 * seed, 0.5 * seed))
    elif what == "nan":
        refused(Reason.NOT_FINITE, robot.stream, np.full(6, np.nan))
    elif what == "beyond":
        bad = q.copy()
        bad[0] = NOMINAL.upper[0] + 0.1
        with np.testing.assert_raises(RefusedError):
            robot.stream(bad)
    elif what == "stall":
        robot.now += 0.01 * (1 + 2 * seed)
    elif what == "pause":
        robot.rest(0.3 + 0.3 * seed)
    elif what == "backwards":
        robot.session._stamps["target", ()] = ((10**18, robot.now),)
        with np.testing.assert_raises(RefusedError):
            robot.stream(q, stamp_ns=10**18 - 10**6)
        robot.session._stamps.clear()
    elif what == "held":
        session.hold(Reason.LEASED, "a measurement", robot.now)
        refused(Reason.LEASED, robot.stream, q)
        session.release(Reason.LEASED)
    elif what == "late":
        robot.now += (0.2 + 0.15 * seed) * DT
    elif what == "rejected":
        followed = session.output.taught.copy()
        known = np.isfinite(followed).all()
        path = begun(robot, still(followed, 0.0, 5.0)) if known else None
        if path is not None:
            session.reject(path)
    elif what == "acknowledged":
        refused(Reason.START_MISMATCH, session.trajectory, still(q + 0.5), robot.now)
        session.acknowledge(robot.now)
    elif what == "stopped":
        assert session.stop(robot.now, 0.05) is None  # its tail does


def begun(robot: Robot, command: TrajectoryCommand) -> SentPath | None:
    """A trajectory that was put out now; None where there is no time for its offset."""
    try:
        robot.session.trajectory(command, robot.now, may_be_rejected=True)
    except RefusedError as error:
        if error.reason is not Reason.TOO_SHORT:
            raise
        return None
    assert robot.session.output.path is not None
    return robot.session.output.path


def midway(robot: Robot, watch: Watch, seed: int, steps: int, q: np.ndarray) -> bool:
    """A trajectory takes the stream's place, and is stopped on its way; whether it began."""
    t = np.linspace(0.0, 3.0 + seed, 31)
    u = (t / t[-1])[:, None]
    way, speed = 3.0 * u**2 - 2.0 * u**3, 6.0 * (u - u**2) / t[-1]
    reach = 0.05 * seed * np.array([1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    taught = TrajectoryCommand(NAMES, q + reach * way, t, reach * speed)
    path = begun(robot, taught)
    if path is None:
        return False
    begin_s, out = robot.now, path.command
    splines = [CubicHermiteSpline(t, c.position, c.velocity) for c in (taught, out)]
    for _ in range(steps):
        robot.now += DT
        at, robot.at = (spline(robot.now - begin_s) for spline in splines)
        watch.out(NAMES, robot.at)
        watch.offset(NAMES, at, robot.at, seed > 0)
        robot.read(robot.at)
    stop = robot.session.stop(robot.now, 0.05)
    assert stop is not None
    slows = CubicHermiteSpline(stop.time_from_start_s, stop.position, stop.velocity)
    stopped_s, lasts_s = robot.now, stop.time_from_start_s[-1]
    while robot.now < stopped_s + lasts_s:
        robot.now += DT
        t_s = robot.now - stopped_s
        robot.at = slows(min(t_s, lasts_s)) if t_s >= 0.05 else splines[1](robot.now - begin_s)
        watch.out(NAMES, robot.at)
        robot.read(robot.at)
    return True


def slow_down(robot: Robot, watch: Watch) -> None:
    """What an ended stream still puts out: in time with the period, until it stands."""
    for _ in range(500):
        robot.now += DT
        robot.read(robot.at)
        command = robot.session.stream.tail(robot.now)
        if command is None:
            return
        watch.out(command.names, command.position)
        robot.go(command)
    raise AssertionError("the stream does not end")


@settings(max_examples=15, deadline=None)
@given(
    st.lists(EVENT, min_size=1, max_size=12), st.just(0.0) | st.floats(0.0, 1.0), st.booleans(),
    st.sampled_from(range(len(MODES))),
)  # fmt: skip
@example([("on", 0, 1), ("tool", 1, 1), ("pause", 0, 1), ("on", 0, 1)], 0.25, False, 0)
@example([("on", 0, 1), ("model", 1, 4), ("midway", 0, 1)], 0.0, False, 0)  # still on its way in
@example([("on", 0, 2), ("backwards", 0, 2), ("pause", 0, 1), ("on", 0, 1)], 0.375, False, 0)
@example([("on", 0, 9), ("full", 2, 60), ("off", 0, 9), ("on", 0, 60)], 1.0, True, 0)
@example([("full", 5, 9), ("tool", 3, 9), ("on", 0, 60), ("off", 0, 60)], 0.0, True, 1)
@example([("model", 5, 9), ("on", 0, 60), ("tool", 3, 60), ("off", 0, 60)], 1.0, True, 2)
@example([("on", 0, 9), ("model", 5, 60), ("full", 4, 60), ("nominal", 0, 60)], 1.0, True, 3)
def test_streams_through_anything(
    events: list[tuple[str, int, int]], speed: float, whole: bool, mode: int
) -> None:
    """A swinging stream; it is taken up again where the robot stands when it was ended."""
    robot = Robot(**MODES[mode])
    watch, t = Watch(robot), 0.0
    centre = HOME.copy()
    for revision, (what, seed, count) in enumerate(events, start=1):
        q = centre + 0.2 * np.sin(speed * t)
        happen(robot, watch, what, seed, revision, q)
        if not robot.session.stream.runs(robot.now):
            watch.ended()
        if what == "midway" and np.isfinite(robot.session.output.out).all():
            q = robot.session.output.taught.copy()
            if midway(robot, watch, seed, count, q):
                robot.rest()
                centre, t = robot.read(robot.at).position, 0.0
                watch.forget()
        if what == "path":
            slow_down(robot, watch)
            robot.rest()
            begin = robot.session.reading(JointCommand(NAMES, robot.at), robot.now).position
            out = robot.session.trajectory(still(begin, 0.5, 3.0 + seed), robot.now)
            robot.at = out.position[-1]
            robot.now += out.time_from_start_s[-1]
            watch.forget()
            watch.last.clear()
            robot.rest()
        for _ in range(count):
            t += DT
            q = centre + 0.2 * np.sin(speed * t)
            names, target = NAMES, q
            if what == "some" and not whole:
                names, target = NAMES[:3], q[:3]
            stood = robot.at
            try:
                robot.stream(target, names=names)
            except RefusedError:
                slow_down(robot, watch)
                robot.rest()
                robot.session.acknowledge(robot.now)
                # a program that begins anew, where the robot stands by its un-corrected readings
                here = robot.session.reading(JointCommand(NAMES, robot.at), robot.now).position
                centre, t = here.copy(), 0.0
                watch.forget()
                continue
            index = [NAMES.index(n) for n in names]
            watch.out(names, robot.at[index], stood)
            watch.offset(names, watch.followed(index, target), robot.at[index])


@settings(max_examples=15, deadline=None)
@given(st.lists(EVENT, min_size=1, max_size=8), st.integers(2, 60), st.floats(0.8, 4.0))
@example([("on", 0, 1), ("full", 2, 1), ("nominal", 3, 2), ("full", 4, 3)], 60, 0.8)
def test_trajectories_through_anything(
    events: list[tuple[str, int, int]], m: int, duration: float
) -> None:
    """Each begins where the robot is by its un-corrected readings, at once or led in."""
    robot = Robot(**WIDE)
    for revision, (what, seed, count) in enumerate(events, start=1):
        if what in ("on", "off", "model", "full", "nominal", "tool"):
            happen(robot, Watch(robot), what, seed, revision, HOME)
        begin = robot.session.reading(JointCommand(NAMES, robot.at), robot.now).position
        first_s = 0.0 if count % 2 else 0.3
        s = np.linspace(0.0, 1.0, m)[:, None]
        way = 0.1 * seed * (3.0 * s**2 - 2.0 * s**3)
        speed = 0.1 * seed * 6.0 * (s - s**2) / duration
        times = first_s + np.linspace(0.0, duration, m)
        k = 4 if count % 3 == 0 else 6  # joints
        q, rates = (begin + way)[:, :k], (speed * np.ones(6))[:, :k]
        command = TrajectoryCommand(NAMES[:k], q, times, rates)
        try:
            out = robot.session.trajectory(command, robot.now)
        except RefusedError as error:
            if error.reason in (Reason.TOO_SHORT, Reason.JOINT_LIMIT, Reason.VELOCITY_LIMIT):
                continue
            raise
        offset, dt = out.position - command.position, np.diff(times)[:, None]
        if first_s == 0.0:
            assert np.abs(out.position[0] - robot.at[:k]).max() <= ROUNDING
        else:
            steps = np.abs(out.position[0] - robot.at[:k])
            assert np.all(steps <= LIMITS["velocity_limits"][:k] * first_s)
        rate = np.diff(offset, axis=0) / dt
        assert np.all(np.abs(rate) <= FASTEST + ROUNDING)
        if seed == 0:
            assert np.all(np.abs(rate) <= REST + ROUNDING)
        if m > 2 and dt[0, 0] <= 0.02:
            assert np.all(np.abs(np.diff(rate, axis=0)) <= LARGEST_A * dt[1:] + ROUNDING)
        assert out.velocity is None or np.abs(out.velocity[-1]).max() <= ROUNDING
        assert robot.session.status().withheld_most_m < 0.03
        robot.at = np.append(out.position[-1], robot.at[k:])
        robot.now += times[-1]
        robot.rest()
        taught = robot.session.reading(JointCommand(NAMES, robot.at), robot.now).position
        assert np.allclose(taught[:k], command.position[-1], rtol=0.0, atol=1e-9)


def test_at_rest_the_offset_comes_in_as_fast_as_it_may_and_no_faster() -> None:
    robot = large()
    out = np.array([robot.stream() for _ in range(600)])
    rate = np.diff(out, axis=0) / DT
    assert np.abs(rate).max() <= REST + ROUNDING
    assert np.abs(rate).max() > 0.9 * REST
    assert np.abs(np.diff(rate, axis=0)).max() <= REST_A * DT + ROUNDING
    assert robot.session.status().settled
    assert np.array_equal(out[-1], out[-2])


NO_LIMITS = {"velocity_limits": np.array([np.inf]), "acceleration_limits": np.array([np.inf])}


@pytest.mark.parametrize("stall_s", [0.05, 0.06, 0.084])
@pytest.mark.parametrize("limits", [LIMITS, NO_LIMITS], ids=["limits", "no limits"])
def test_a_stall_is_not_made_up_for_in_a_burst(
    limits: dict[str, np.ndarray], stall_s: float
) -> None:
    """Only the newest of what waited is heard; no step is much longer than the stream's own."""
    speed = np.radians(60.0)
    robot, q = under_way(speed, **limits)
    q[0] += speed * stall_s
    before = robot.at[0]
    robot.stream(q, dt=stall_s)
    assert 0.0 < robot.at[0] - before <= 1.06 * speed * DT
    steps = 0
    while robot.at[0] != q[0]:
        q[0] += speed * DT
        before, steps = robot.at[0], steps + 1
        robot.stream(q)
        assert robot.at[0] - before <= 1.06 * speed * DT
    assert steps * DT < 1.3 * stall_s / 0.05  # at 1.05 of the speed it takes 20 times the stall
    assert robot.session.status().lag_s == 0.0


def test_without_limits_nothing_is_enabled_and_a_stream_is_ended_in_order() -> None:
    robot, _ = under_way(**NO_LIMITS)
    said = refused(Reason.NO_SPEED_LIMITS, robot.session.enable, True)
    assert "joint_a1" in said
    assert "velocity_limits" in said
    assert not robot.session.status().enabled
    refused(Reason.NOT_FINITE, robot.stream, np.full(6, np.nan))
    speeds = [np.radians(60.0)]
    while (command := robot.session.stream.tail(robot.now)) is not None:
        speeds.append((command.position[0] - robot.at[0]) / DT)
        robot.go(command)
        robot.now += DT
    assert len(speeds) * DT > 0.1
    assert np.all(np.diff(speeds[1:]) < 0.0)
    assert speeds[-1] < np.radians(5.0)


@pytest.mark.parametrize("limits", [LIMITS, NO_LIMITS], ids=["limits", "no limits"])
def test_after_a_long_stall_the_stream_is_held_and_looked_at(limits: dict[str, np.ndarray]) -> None:
    robot, q = under_way(**limits)
    q[0] += np.radians(60.0) * 0.5
    before = robot.at.copy()
    robot.rest(0.49)
    refused(Reason.START_MISMATCH, robot.stream, q, dt=0.01)
    assert np.array_equal(robot.at, before)
    assert robot.session.stream.tail(robot.now + DT) is None  # it stands already


BEGIN = np.where(np.arange(6) == 3, NOMINAL.upper - 1e-4, HOME)
SLOWEST = LIMITS["acceleration_limits"][0]
BAD = {
    Reason.NOT_FINITE: np.full(6, np.nan),
    Reason.JOINT_LIMIT: np.where(
        np.arange(6) == 3, NOMINAL.upper + 1e-4, HOME + 0.1 * np.eye(6)[0]
    ),
    Reason.VELOCITY_LIMIT: HOME - 1.0,
    Reason.DEGREES: np.degrees(HOME),
}


def under_way(speed: float = np.radians(60.0), **config: Any) -> tuple[Robot, np.ndarray]:
    """A stream at a constant speed of joint 1, and its last target."""
    robot, q = Robot(rested=False, **config), BEGIN.copy()
    robot.at = q.copy()
    robot.rest()
    robot.stream(q)
    for _ in range(50):
        q[0] += speed * DT
        robot.stream(q)
    return robot, q


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 1000), st.floats(0.05, 0.95), st.booleans(), st.sampled_from([*BAD]))
def test_a_refusal_in_motion_slows_the_robot_down(
    seed: int, jitter: float, repeated: bool, why: Reason
) -> None:
    """Over the time that really passes, as evenly as the joint may, from its last speed to rest.

    Also while the messages that are refused go on.
    """
    periods = np.random.default_rng(seed).uniform(1.0 - jitter, 1.0 + jitter, 2000)
    speed = np.radians(60.0)
    robot, q = under_way(speed)
    sent_s, begin = robot.now, robot.at[0]
    refused(why, robot.stream, BAD[why], dt=periods[0] * DT)
    for dt in periods[1:].tolist():
        if (command := robot.session.stream.tail(robot.now)) is None:
            break
        robot.go(command)
        t = min(robot.now - sent_s, speed / SLOWEST)
        way = speed * t - 0.5 * SLOWEST * t * t
        assert np.isclose(robot.at[0] - begin, way, rtol=0.0, atol=1e-9)
        if repeated:
            with np.testing.assert_raises(RefusedError):
                robot.stream(BAD[why], dt=dt * DT)
        else:
            robot.now += dt * DT
    else:
        raise AssertionError("the stream does not end")
    assert np.isclose(robot.at[0] - begin, speed**2 / (2.0 * SLOWEST), rtol=0.0, atol=1e-9)
    q[0] += speed * DT
    refused(Reason.START_MISMATCH, robot.stream, q, dt=0.5)


def test_a_target_that_is_refused_moves_nothing_that_stands() -> None:
    for why, q in BAD.items():
        robot, _ = under_way(speed=0.0)
        refused(why, robot.stream, q)
        for _ in range(10):
            assert robot.session.stream.tail(robot.now) is None
            robot.now += DT


@settings(max_examples=30, deadline=None)
@given(st.floats(2.01, 100.0), st.integers(0, 20))
def test_a_robot_that_stands_is_not_set_in_motion_to_be_stopped(held: float, count: int) -> None:
    """A controller that was sent nothing for two periods holds: so at once, or while it slows."""
    robot, _ = under_way()
    dt = DT if count else held * DT
    refused(Reason.NOT_FINITE, robot.stream, np.full(6, np.nan), dt=dt)
    for _ in range(count):
        command = robot.session.stream.tail(robot.now)
        assert command is not None
        robot.go(command)
        robot.now += DT
    robot.now += held * DT if count else 0.0
    for _ in range(50):
        assert robot.session.stream.tail(robot.now) is None
        robot.now += DT


def test_a_stream_of_some_joints_then_of_all_moves_no_other_joint_at_once() -> None:
    """The others take their offset up where they stand."""
    for bent in ((2e-3, 0.5), (9e-3, 3.5)):
        robot = Robot()
        robot.session.offer_tool(bent_tool(*bent))
        robot.session.enable(True)
        for _ in range(100):
            robot.stream(HOME[:3], names=NAMES[:3])
        assert np.array_equal(robot.at[3:], HOME[3:])
        before = robot.at.copy()
        robot.stream(HOME)
        assert np.abs(robot.at - before).max() <= REST * DT + ROUNDING


@pytest.mark.parametrize("streams", [True, False])
@pytest.mark.parametrize("beside_deg", [1.0, 11.5, -11.5])
def test_a_trajectory_that_begins_at_once_beside_a_moving_robot_does_not_go_out(
    streams: bool, beside_deg: float
) -> None:
    """A controller steps to a point at time 0 from one cycle to the next, whatever its speed."""
    speed, robot = np.array([np.radians(60.0), 0.0, 0.0, 0.0, 0.0, 0.0]), Robot()
    if streams:
        robot, _ = under_way(speed[0])
    else:
        robot.at = BEGIN
        robot.rest()
        way = BEGIN + np.arange(2)[:, None] * speed
        path = TrajectoryCommand(NAMES, way, np.array([0.0, 1.0]))
        out = robot.session.trajectory(path, robot.now)
        for part in np.linspace(0.0, 0.5, 51)[1:]:
            robot.now += 0.01
            robot.at = out.position[0] + part * (out.position[1] - out.position[0])
            robot.read(robot.at)
    before, stream = robot.session.output.path, robot.session.stream.phase
    at = robot.at + np.radians(beside_deg) * np.eye(6)[0]
    for velocity in (None, np.stack([speed, 0.0 * speed])):
        elsewhere = TrajectoryCommand(
            NAMES, np.stack([at, at + 0.2 * speed]), np.array([0.0, 1.0]), velocity
        )
        refused(Reason.START_MISMATCH, robot.session.trajectory, elsewhere, robot.now)
        robot.session.acknowledge(robot.now)
    assert robot.session.output.path is before
    assert robot.session.stream.phase is stream
    on = TrajectoryCommand(NAMES, np.stack([robot.at, robot.at + 0.5 * speed]), np.arange(2.0))
    out = robot.session.trajectory(on, robot.now).position
    assert np.abs(out[0] - robot.at).max() <= ROUNDING


@pytest.mark.parametrize("on", [False, True])
def test_a_target_that_is_refused_leaves_the_trajectory_that_it_came_beside(on: bool) -> None:
    """The controller drives it on: it must be known, to be stopped."""
    robot = Robot()
    if on:
        robot.session.offer_model(offer(drifted()))
        robot.session.enable(True)
    way = TrajectoryCommand(NAMES, np.stack([HOME, HOME + 1.0]), np.array([0.0, 2.0]))
    robot.session.trajectory(way, robot.now)
    path = robot.session.output.path
    assert path is not None
    path.begin(robot.now)
    for _ in range(100):
        robot.now += 0.01
        robot.at = path.place(robot.now)
        robot.read(robot.at)
    beside = JointCommand(NAMES, HOME + 0.5, np.full(6, np.degrees(1.0)))  # in deg/s
    refused(Reason.VELOCITY_LIMIT, robot.session.target, beside, robot.now)
    assert robot.session.output.path is path
    assert robot.session.moves(robot.now)
    assert robot.session.stop(robot.now, 0.05) is not None


def test_refused_messages_leave_nothing_to_jump_to() -> None:
    """Twenty-three refused, then one that could be taken: the robot is no longer there."""
    speed, held = np.radians(60.0), []
    robot, q = under_way(speed)
    for _ in range(23):
        q[0] += speed * DT
        bad = q.copy()
        bad[3] = NOMINAL.upper[3] + 1.0
        with np.testing.assert_raises(RefusedError):
            robot.stream(bad)
        held.append(robot.at.copy())
    with np.testing.assert_raises(RefusedError):
        robot.stream(q)
    assert np.array_equal(robot.at, held[-1])


def test_jitter_moves_nothing_faster() -> None:
    rng = np.random.default_rng(3)
    robot, speed = Robot(), 0.9 * LIMITS["velocity_limits"]
    watch, t, q = Watch(robot), 0.0, HOME.copy()
    q = HOME - speed * 0.4
    robot.at = q.copy()
    robot.rest()
    late = DT * rng.uniform(-0.35, 0.35, 401)  # of the instant at which each is due
    for i in range(400):
        ramp = min(i * DT / 0.3, 1.0)
        q = q + speed * DT * ramp
        t += DT
        if np.any(q > NOMINAL.upper - 0.05):
            break
        robot.stream(q, dt=float(DT + late[i + 1] - late[i]))
        watch.out(NAMES, robot.at)
        assert robot.session.status().lag_s <= 2.0 * DT


@pytest.mark.parametrize("period_s", [DT, 0.2])
def test_a_stream_that_hardly_moves_is_followed(period_s: float) -> None:
    """Its targets lie nearer to what went out before than any tolerance could tell."""
    robot = large()
    robot.settle()
    q = HOME.copy()
    for _ in range(300):
        q = q + 1e-7
        offset = robot.stream(q, dt=period_s) - q
        assert np.all(offset != 0.0)
    assert robot.session.status().refused == {}


def test_a_last_message_that_came_late_is_still_reached() -> None:
    robot, q = under_way()
    q[0] += np.radians(60.0) * 0.06
    robot.stream(q, dt=0.06)
    assert robot.session.status().lag_s > 0.0
    for _ in range(100):
        robot.now += DT
        if (command := robot.session.stream.tail(robot.now)) is not None:
            robot.go(command)
    assert np.allclose(robot.at, q, rtol=0.0, atol=1e-12)


def test_a_trajectory_that_is_too_short_for_its_offset_says_how_long_it_takes() -> None:
    robot = large()
    short = still(seconds=0.05)
    assert "longer" in refused(Reason.TOO_SHORT, robot.session.trajectory, short, robot.now)
    robot.session.trajectory(still(seconds=1.5), robot.now)
    assert not robot.session.status(robot.now + 0.01).settled
    assert robot.session.status(robot.now + 2.0).settled


def test_rates_of_a_settled_swing_are_those_of_its_positions() -> None:
    robot = large()
    robot.settle()
    fine = swing(2001)
    out = robot.session.trajectory(fine, robot.now)
    assert out.velocity is not None
    assert out.acceleration is not None
    t = fine.time_from_start_s
    by_steps = np.gradient(out.position, t, axis=0)[5:-1]  # after the step of its acceleration
    assert np.abs(out.velocity[5:-1] - by_steps).max() < 1e-5
    bends = np.gradient(out.velocity, t, axis=0)[8:-1]
    assert np.abs(out.acceleration[8:-1] - bends).max() < 1e-4


def anew(robot: Robot, *, restart: bool) -> tuple[Robot, Watch, np.ndarray]:
    """A program that begins where the robot stands, with the same node or with another one."""
    if restart:
        robot, before = Robot(rested=False, **WIDE), robot
        robot.now, robot.at = before.now, before.at
    robot.rest()
    robot.session.acknowledge(robot.now)
    robot.session.enable(True)
    taught = robot.session.reading(JointCommand(NAMES, robot.at), robot.now).position
    return robot, Watch(robot, 0.8 * DT), taught.copy()


WANDERS = {"turn": 0.012, "late": 0.01, "model": 0.006, "tool": 0.006, "on": 0.006, "off": 0.004}


@settings(max_examples=15, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_a_program_that_wanders_through_anything(seed: int) -> None:
    """Each joint on its own, up to nine tenths of its speed, in time or not, over restarts."""
    rng = np.random.default_rng(seed)
    fastest, change = 0.9 * LIMITS["velocity_limits"], 0.9 * LIMITS["acceleration_limits"] * DT
    robot, watch, q = anew(Robot(**WIDE), restart=False)
    v, wanted, tells_speed = np.zeros(6), np.zeros(6), bool(rng.random() < 0.5)
    for revision in range(1, 801):
        dt = rng.uniform(0.8, 1.2) * DT
        what = rng.choice([*WANDERS, ""], p=[*WANDERS.values(), 1.0 - sum(WANDERS.values())])
        if what == "turn":
            wanted = rng.uniform(-1.0, 1.0, 6) * fastest * rng.choice([0.0, 0.3, 1.0])
        elif what == "late":
            dt = rng.uniform(0.01, 0.3)
        elif what:
            happen(robot, watch, str(what), int(rng.integers(1, 5)), revision, q)
        stood, near = robot.at, (q < NOMINAL.lower + 1.0) | (q > NOMINAL.upper - 1.0)
        wanted = np.where(near, np.where(q < HOME, 0.3, -0.3), wanted)
        v = v + np.clip(wanted - v, -change, change)
        q = q + v * min(dt, 3.0 * DT)
        try:
            robot.stream(q, dt, **({"velocity": v.copy()} if tells_speed else {}))
        except RefusedError:
            slow_down(robot, watch)
            robot, watch, q = anew(robot, restart=bool(rng.random() < 0.3))
            v, wanted = np.zeros(6), np.zeros(6)
            continue
        watch.out(NAMES, robot.at, stood)
        watch.offset(NAMES, robot.session.output.taught, robot.at)
