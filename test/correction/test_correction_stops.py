# SPDX-License-Identifier: Apache-2.0
"""A stop of a trajectory slows down on its way: no joint leaves it, or goes on beyond its end."""

import numpy as np
import pytest
from correction_robot import HOME, LIMITS, NAMES, NOMINAL, Robot, large
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.interpolate import CubicHermiteSpline

from robocal_ros.correction.interface import JointCommand, TrajectoryCommand
from robocal_ros.correction.robot_state import LAG_S, VELOCITY_S, RobotState
from robocal_ros.correction.sent_path import SentPath
from robocal_ros.correction.trajectories import AHEAD_S
from robocal_ros.kinematics.robots import load_description
from robocal_ros.motion.plan import REACTION_S, SHORTEST_STOP_S, JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import STANDS_S
from robocal_ros.motion.stopping import GIVE_UP_S, MOST_SENT, REPEAT_S, WatchedStop

LIMIT = NOMINAL.upper[0] - 0.02  # of the program, which leaves room for the correction
REACH = np.array([0.9, -0.3, 0.4, 0.6, -0.4, 0.8])


def program(strength: float, bend: float, seed: int, spacing_s: float = 0.01) -> TrajectoryCommand:
    """To near joint 1's limit and rest there; the other joints turn back and forth on the way."""
    rng = np.random.default_rng(seed)
    turns, phase = rng.uniform(0.5, 3.0, 6), rng.uniform(0.0, 3.0, 6)
    turns[0], end = 0.0, np.where(np.arange(6) == 0, LIMIT, HOME)
    fastest = np.max(np.abs(REACH) * (1.9 + 8.0 * bend) / LIMITS["velocity_limits"])
    lasts = fastest / strength
    t = np.linspace(0.0, lasts, max(round(lasts / spacing_s), 4) + 1)
    x = t / lasts
    s, rate = x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2 / lasts
    wave = np.sin(turns * s[:, None] + phase) - np.sin(turns + phase)
    q = end + REACH * (s - 1.0)[:, None] + bend * wave * (turns > 0.0)
    slope = REACH + bend * turns * np.cos(turns * s[:, None] + phase)
    return TrajectoryCommand(NAMES, q, t, slope * rate[:, None])


@settings(max_examples=25, deadline=None)
@given(
    st.floats(0.1, 0.95), st.sampled_from([0.0, 0.1, 0.4]), st.integers(0, 50),
    st.floats(0.05, 0.97), st.floats(0.3, 4.0), st.booleans(), st.sampled_from([1.0, 0.5]),
)  # fmt: skip
@example(
    strength=0.84375, bend=0.4, seed=0, when=0.97, brakes=1.0, corrected=False, scaling=1.0
)  # fmt: skip
def test_stops_anywhere(
    strength: float, bend: float, seed: int, when: float, brakes: float, corrected: bool,
    scaling: float,
) -> None:  # fmt: skip
    """Dense samples of what the controller makes of the stop, on the path that it had before."""
    command = program(strength, bend, seed)
    own = np.abs(np.gradient(command.velocity, command.time_from_start_s, axis=0)).max(axis=0)
    limits = np.maximum(brakes * own, 0.1)
    robot = (large if corrected else Robot)(acceleration_limits=limits)
    robot.at = command.position[0]
    robot.rest()
    session, began_s = robot.session, robot.now
    session.controller((), np.empty(0), scaling, robot.now)
    session.trajectory(command, robot.now)
    path = session.output.path
    path.begin(robot.now)
    lasts = command.time_from_start_s[-1]
    robot.now += when * lasts / scaling
    clock = path.time(robot.now) + AHEAD_S
    c = np.append(np.arange(min(clock, lasts), lasts, 1e-3), lasts)
    ahead = np.array([path.place(began_s + at / scaling) for at in c])
    rates = np.gradient(ahead, c, axis=0) if len(c) > 1 else np.zeros_like(ahead)

    stop = session.stop(robot.now, AHEAD_S)
    times = stop.time_from_start_s - AHEAD_S
    assert times[0] == 0.0
    assert np.allclose(stop.position[0], ahead[0], rtol=0.0, atol=1e-6)
    if clock < lasts:
        about = [path.place(began_s + (clock + h) / scaling) for h in (-1e-5, 1e-5)]
        assert np.allclose(stop.velocity[0], np.diff(about, axis=0)[0] / 2e-5, atol=5e-3)
    assert not stop.velocity[-1].any()
    if len(times) < 2:
        assert np.array_equal(stop.position[-1], path.command.position[-1])
        return
    driven = CubicHermiteSpline(times, stop.position, stop.velocity)
    dense = np.linspace(0.0, times[-1], 2001)
    q = driven(dense)
    on = np.interp(q[:, 0], ahead[:, 0], c)  # joint 1 goes on and on
    way = np.array([np.interp(on, c, column) for column in ahead.T]).T
    assert np.allclose(q, way, rtol=0.0, atol=1e-4)  # of the cubics between the points
    assert np.all(q <= ahead.max(axis=0) + 1e-5)
    assert np.all(q >= ahead.min(axis=0) - 1e-5)
    assert q[:, 0].max() <= NOMINAL.upper[0]
    # 1e-6 rad before its end joint 1 still says within 0.1 ms where it is: it has 2e-4 rad/s there
    steps = np.diff(on[q[:, 0] < ahead[-1, 0] - 1e-6][::50])
    assert np.all(steps >= -1e-4)  # never back
    assert np.all(np.diff(steps) <= 1e-3)  # nor faster on the way than before
    bends = np.abs(np.gradient(rates, c, axis=0)[3:-3]).max(axis=0) if len(c) > 9 else 0.0
    assert np.all(np.abs(driven(dense, 2)) <= 1.4 * np.maximum(limits, bends) + 0.05)


@pytest.mark.parametrize("strength", [1.0, 1.3, 2.0])
def test_a_program_that_brakes_itself_is_not_driven_past(strength: float) -> None:
    """60 ms before it does, at 90 deg/s, by as many times the acceleration that is known."""
    a, speed, steady = strength * LIMITS["acceleration_limits"][0], np.radians(90.0), 0.6
    ramp = speed / a
    t = np.linspace(0.0, steady + 2.0 * ramp, 400)
    rate = np.clip(np.minimum(a * t, a * (t[-1] - t)), 0.0, speed)
    left = np.minimum(t, ramp) ** 2 * a / 2 + speed * np.clip(t - ramp, 0.0, steady)
    left += speed * ramp / 2 - a * np.clip(t[-1] - t, 0.0, ramp) ** 2 / 2
    q, v = np.tile(HOME, (len(t), 1)), np.zeros((len(t), 6))
    q[:, 0], v[:, 0] = HOME[0] + left - left[-1], rate
    robot = Robot()
    robot.at = q[0]
    robot.rest()
    robot.session.trajectory(TrajectoryCommand(NAMES, q, t, v), robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += steady + ramp - AHEAD_S
    stop = robot.session.stop(robot.now, AHEAD_S)
    assert stop.position[-1, 0] <= q[-1, 0] + 1e-9
    assert stop.time_from_start_s[-1] <= AHEAD_S + 1.2 * ramp


def test_a_controller_that_is_halted_is_held() -> None:
    robot = Robot()
    command = program(0.5, 0.1, 1)
    robot.at = command.position[0]
    robot.rest()
    robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += 0.4 * command.time_from_start_s[-1]
    robot.session.controller((), np.empty(0), 0.0, robot.now)
    here = robot.session.output.path.place(robot.now)
    robot.now += 0.1
    stop = robot.session.stop(robot.now, AHEAD_S)
    assert np.array_equal(stop.position, here[None])
    assert not stop.velocity.any()


def test_readings_on_a_stop_are_uncorrected_with_what_the_path_had_there() -> None:
    """The offset still comes in as it is stopped, and stands where the robot does."""
    robot = large()
    command = program(0.5, 0.1, 1)
    robot.at = command.position[0]
    robot.rest()
    out = robot.session.trajectory(command, robot.now)
    robot.session.output.path.begin(robot.now)
    robot.now += 0.3 * command.time_from_start_s[-1]
    stop = robot.session.stop(robot.now, AHEAD_S)
    robot.now += stop.time_from_start_s[-1]
    taught = robot.session.reading(JointCommand(NAMES, stop.position[-1]), robot.now).position
    shape = CubicHermiteSpline(out.time_from_start_s, out.position, out.velocity)
    own = CubicHermiteSpline(command.time_from_start_s, command.position, command.velocity)
    t = np.linspace(0.0, out.time_from_start_s[-1], 20_000)
    k = int(np.argmin(np.abs(shape(t)[:, 0] - stop.position[-1, 0])))
    assert np.abs(taught - own(t[k])).max() < 5e-4


# ---- Stops that are watched, against a simulated controller that does as the real one ------------


ROBOT = load_description("kr150_r3100")
ARM = ROBOT.arm
CYCLE_S = 0.004
STOP_LOOK_S = 0.02  # a node looks so often
DELAY_S = 0.01  # of trajectories, and of readings
SPEED = np.array([0.9, -0.4, 0.5, 1.0, -0.2, 0.3])


class SimulatedController:
    """Drives on at constant speed; a trajectory is a cubic from where it is, after `DELAY_S`.

    It begins as fast as the drives are, which a scaled clock slows down.

    Parameters
    ----------
    losses : so many trajectories are lost.
    reports : velocities in readings: "measured", "nan" or "zero".
    period_s : of the readings; infinite: they are silent.
    """

    def __init__(
        self,
        losses: int = 0,
        reports: str = "measured",
        scaling: float = 1.0,
        period_s: float = CYCLE_S,
    ) -> None:
        self.now_s, self.losses, self.reports, self.scaling = 100.0, losses, reports, scaling
        self.period_s, self._read_s = period_s, -np.inf
        self.late_s, self._read = 0.0, []  # readings come so late
        self.q, self.qd = HOME.copy(), SPEED.copy()
        self.state = RobotState(ARM, 0.2, np.full(6, 3.5e-4), ROBOT.max_velocity)
        limits = MotionLimits(stop_deceleration=ROBOT.max_acceleration)
        self.stop = WatchedStop(ARM, limits, again_s=SHORTEST_STOP_S)
        self.plans: list = []
        self.out: list = []
        self._coming: list = []
        self._spline, self._began_s, self._clock_s = None, 0.0, 0.0

    def begins(self, at_s: float | None = None) -> JointPlan:
        at_s = self.now_s if at_s is None else at_s
        self._take(plan := self.stop.begin(self.state.to_stop(at_s), at_s))
        return plan

    def looks(self) -> bool:
        """Look after the stop; whether it is under way."""
        self.state.scaling = self.scaling
        if (plan := self.stop.look(self.state, self.now_s)) is not None:
            self._take(plan)
        return self.stop.under_way

    def _take(self, plan: JointPlan) -> None:
        self.plans.append(plan)
        if self.losses:
            self.losses -= 1
        else:
            self._coming.append((self.now_s + DELAY_S, plan))

    def cycle(self) -> None:
        self.now_s += CYCLE_S
        while self._coming and self._coming[0][0] <= self.now_s:
            plan = self._coming.pop(0)[1]
            ends = np.array([0.0, plan.duration_s])
            self._spline = CubicHermiteSpline(
                ends, [self.q, plan.q[-1]], [self.scaling * self.qd, 0.0 * self.qd]
            )
            self._clock_s = 0.0
        before = self.q
        if self._spline is None:
            self.q = self.q + self.qd * CYCLE_S * self.scaling
        else:
            self._clock_s += CYCLE_S * self.scaling
            at = min(self._clock_s, self._spline.x[-1])
            self.q = self._spline(at)
            self.qd = self._spline(at, 1) if at < self._spline.x[-1] else 0.0 * self.qd
        self.out.append(self.q)
        told = {
            "measured": (self.q - before) / CYCLE_S,
            "nan": np.full(6, np.nan),
            "zero": np.zeros(6),
        }[self.reports]
        if self.now_s - self._read_s >= self.period_s - 1e-6:
            self._read.append((self.now_s + self.late_s - 1e-9, self.q.copy(), told))
            self._read_s = self.now_s
        while self._read and self._read[0][0] <= self.now_s:
            _, q, told = self._read.pop(0)
            everything, late_s = np.arange(6), self.late_s
            self.state.read(everything, q, self.now_s, velocity=told, late_s=late_s)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / CYCLE_S)):
            self.cycle()

    def stops(self) -> float:
        """Time from the stop's begin until the robot stands."""
        began_s = moved_s = self.now_s
        self.begins()
        while self.looks() and self.now_s < began_s + 20.0:
            before = self.q
            self.cycle()
            moved_s = self.now_s if np.any(np.abs(self.q - before) > 1e-9) else moved_s
        return moved_s - began_s


@pytest.mark.parametrize("reports", ["measured", "nan", "zero"])
def test_a_stop_goes_on_in_its_direction_and_ends_at_rest(reports):
    robot = SimulatedController(reports=reports)
    robot.run(0.3)
    begin = len(robot.out)
    took_s = robot.stops()
    assert not robot.stop.failed
    assert robot.stop.sent == 1
    assert took_s <= 1.05 * robot.plans[0].duration_s + DELAY_S + CYCLE_S
    ways = np.diff(robot.out[begin - 1 :], axis=0)
    assert np.all(ways * SPEED >= -1e-9)  # never back
    rates = ways / CYCLE_S
    most = 2.0 * np.abs(SPEED) / robot.plans[0].duration_s  # a cubic's own is 1.5 at its steepest
    assert np.all(np.abs(np.diff(rates, axis=0)) <= most * CYCLE_S)


@pytest.mark.parametrize("losses", [1, 2])
def test_a_stop_that_is_lost_is_sent_again(losses):
    robot = SimulatedController(losses)
    robot.run(0.3)
    took_s = robot.stops()
    assert robot.stop.sent == losses + 1
    assert not robot.stop.failed
    assert took_s <= 1.5 * robot.plans[0].duration_s


@pytest.mark.parametrize("scaling", [0.1, 0.5])
def test_a_controller_that_runs_slowly_is_waited_for(scaling):
    robot = SimulatedController(scaling=scaling)
    robot.run(0.3)
    robot.stops()
    assert robot.stop.sent == 1
    assert not robot.stop.failed


@pytest.mark.parametrize("scaling", [0.1, 0.5])
def test_a_lost_stop_is_sent_again_to_a_controller_that_tells_its_unscaled_speed(scaling):
    """Finding: slower readings than the plan's speeds looked like a robot that obeys."""
    robot = SimulatedController(losses=1, scaling=scaling)
    robot.state.told = lambda now: (robot.q.copy(), robot.qd.copy(), now)
    robot.run(0.3)
    robot.looks()
    took_s = robot.stops()
    assert robot.stop.sent == 2
    assert not robot.stop.failed
    assert took_s <= 1.5 * robot.plans[0].duration_s / scaling


@pytest.mark.parametrize("losses", [0, 1])
@pytest.mark.parametrize("reports", ["measured", "nan"])
@pytest.mark.parametrize("period_s", [0.02, 0.04, 0.1, 0.12])
def test_readings_that_come_seldom_show_a_stop_late(period_s, reports, losses):
    """Finding: a robot that obeyed was stopped anew from old speeds, or held to stand in motion."""
    robot = SimulatedController(losses, reports, period_s=period_s)
    robot.run(1.0)
    robot.stops()
    assert not robot.qd.any()
    assert robot.stop.sent == losses + 1
    assert not robot.stop.failed


@pytest.mark.parametrize("losses", [0, 1])
def test_a_controller_whose_words_come_late_shows_a_stop_late(losses):
    """Finding: by what it said before the stop it seemed to drive on, and was sent another one."""
    robot, cycles = SimulatedController(losses), 12

    def told(now_s):
        """Where it would go on to from what it said 48 ms ago."""
        before, q = robot.out[-cycles - 2 : -cycles]
        qd, at_s = (q - before) / CYCLE_S, robot.now_s - cycles * CYCLE_S
        return q + qd * (now_s - at_s), qd, at_s

    robot.state.told = told
    robot.run(0.3)
    robot.stops()
    assert not robot.qd.any()
    assert robot.stop.sent == losses + 1
    assert not robot.stop.failed


@pytest.mark.parametrize("reports", ["measured", "nan"])
def test_late_readings_of_a_robot_that_stood_end_no_stop(reports):
    """Finding: a stop that was lost was over, by readings of before the motion that it is of."""
    robot = SimulatedController(losses=1, reports=reports)
    robot.qd, robot.late_s = np.zeros(6), 0.15
    robot.run(1.0)
    robot.qd = SPEED.copy()
    robot.run(0.04)
    robot.stops()
    assert robot.stop.sent >= 2
    assert not robot.qd.any()
    assert not robot.stop.failed


def test_a_robot_that_is_heard_no_more_while_it_stops_does_not_stand():
    """Finding: 0.1 s after the last reading of a robot in motion it stood."""
    robot = SimulatedController()
    robot.stop = WatchedStop(ARM, MotionLimits(stop_deceleration=1.0))
    robot.run(0.3)
    robot.begins()
    while robot.looks() and not robot.stop.failed:
        robot.cycle()
        robot.period_s = np.inf if robot.now_s > 100.5 else CYCLE_S
    assert "joint states are missing" in robot.stop.failed


def test_a_robot_that_does_not_stop_is_told():
    robot = SimulatedController(losses=10_000)
    robot.run(0.3)
    robot.begins()
    while robot.looks() and not robot.stop.failed:
        robot.cycle()
    assert "the robot does not stop: it still moves" in robot.stop.failed
    assert robot.stop.sent == MOST_SENT + 1
    assert robot.looks()  # others stop it, and it is watched until it stands
    robot.losses = 0
    while robot.looks():
        robot.cycle()
    assert robot.state.at_rest(robot.now_s)


@pytest.mark.parametrize("silent", [False, True])
def test_a_robot_that_is_not_seen_to_stand_is_told(silent):
    """Also where its stop is asked for again and again."""
    robot = SimulatedController(losses=10_000)
    robot.run(0.3)
    planned_s = robot.begins().duration_s
    began_s = robot.now_s
    while not robot.stop.failed:
        if silent:
            robot.now_s += CYCLE_S
        else:
            robot.cycle()
            robot.begins()
        assert robot.looks()
    assert robot.now_s - began_s <= GIVE_UP_S + max(planned_s, SHORTEST_STOP_S) + 2.0 * CYCLE_S


def test_without_readings_no_stop_is_planned():
    robot = SimulatedController()
    assert robot.state.to_stop(robot.now_s) is None
    robot.run(0.3)
    assert robot.state.to_stop(robot.now_s) is not None
    assert robot.state.to_stop(robot.now_s + 0.3) is None


def test_a_robot_that_stands_holds_where_it_is():
    robot = SimulatedController(reports="nan")
    robot.qd = np.zeros(6)
    robot.run(0.3)
    robot.stops()
    assert robot.stop.sent == 1
    assert np.abs(np.array(robot.out) - HOME).max() < 1e-12


def test_how_long_a_robot_has_stood():
    robot = SimulatedController()
    assert robot.state.stood_s(robot.now_s) == 0.0
    robot.run(0.5)
    assert robot.state.stood_s(robot.now_s) < 2.0 * CYCLE_S
    robot.qd = np.full(6, 1e-3)  # it creeps
    robot.run(2.0)
    assert robot.state.stood_s(robot.now_s) < 0.4
    robot.qd = np.zeros(6)
    robot.run(2.0)
    assert robot.state.stood_s(robot.now_s) == pytest.approx(2.0, abs=0.4)
    assert robot.state.stood_s(robot.now_s + 0.3) == 0.0  # not read now
    robot.now_s += 1.0
    robot.run(0.1)
    assert robot.state.stood_s(robot.now_s) < 0.1  # what it did meanwhile is not known


@pytest.mark.parametrize("late_s", [0.0, 0.1])
def test_whether_a_robot_follows_its_path(late_s):
    robot = SimulatedController()
    began_s, lasts_s = robot.now_s + late_s, 4.0
    times = np.array([0.0, lasts_s])
    path = SentPath(
        TrajectoryCommand(NAMES, np.stack([HOME, HOME + lasts_s * SPEED]), times),
        index=np.arange(6), begin_s=began_s - late_s, known_times=times,
        known=np.zeros((4, 2, 6)), stage=None,
        led_from=HOME, led_rate=None, put_s=began_s, at_once=True,
    )  # fmt: skip
    assert robot.state.follows(path, robot.now_s)  # nothing tells otherwise
    robot.qd = np.zeros(6)
    robot.run(late_s)
    robot.qd = SPEED.copy()
    robot.run(0.5)
    assert robot.state.follows(path, robot.now_s)
    path.scale(0.0, robot.now_s)
    robot.run(1.0)
    assert not robot.state.follows(path, robot.now_s)
    robot.now_s, robot.reports = robot.now_s + 1.0, "nan"
    robot.cycle()  # nobody knows how fast it is: it can be stopped on its path alone
    assert robot.state.to_stop(robot.now_s) is None
    assert robot.state.follows(path, robot.now_s)


# ---- pauses -------------------------------------------------------------------------------------


def pauses(robot: SimulatedController, seconds: float, held_s: float = -np.inf) -> bool:
    """Watch a stop while the controller's clock stands; whether it is still under way."""
    robot.scaling, robot.state.held_s = 0.0, held_s
    for _ in range(round(seconds / CYCLE_S)):
        robot.cycle()
        robot.looks()
    return robot.stop.under_way


@pytest.mark.parametrize("losses", [1, 2, 10_000])
def test_a_stop_that_is_lost_in_a_pause_is_sent_until_the_robot_stands_by_itself(losses):
    """Finding: after 0.1 s it was over; with the pause the old motion went on."""
    robot = SimulatedController()
    robot.run(0.3)
    robot.scaling = 0.0
    robot.run(0.3)
    paused, robot.losses = robot.q, losses
    robot.state.scaling = 0.0
    robot.begins()
    assert pauses(robot, 12.0)  # longer than what still moves is given
    assert not robot.stop.failed
    assert 2.0 * GIVE_UP_S < 12.0
    assert 12.0 / REPEAT_S - 2 <= robot.stop.sent <= 12.0 / REPEAT_S + 2
    robot.scaling, robot.losses = 1.0, 0
    went_on_s = robot.now_s
    while robot.looks():
        robot.cycle()
    assert robot.now_s - went_on_s > STANDS_S
    assert not robot.stop.failed
    # Held in the pause it stays. Where each message was lost its motion goes on, is seen to within
    # the time that readings take to tell a speed, and slows down as any stop that was lost once.
    far = np.abs(robot.q - paused)
    seen_s = VELOCITY_S + LAG_S + STOP_LOOK_S + DELAY_S
    slows_s = 0.5 * max(np.max(np.abs(SPEED) / ROBOT.max_acceleration), SHORTEST_STOP_S)
    assert np.all(far <= (np.abs(SPEED) * (seen_s + slows_s) if losses > 100 else 1e-9))


def test_a_stop_that_a_controller_is_seen_to_take_in_a_pause_is_over():
    robot = SimulatedController()
    robot.run(0.3)
    robot.scaling = 0.0
    robot.run(0.3)
    before_s = robot.now_s
    robot.state.scaling = 0.0
    robot.begins()
    assert pauses(robot, 0.2, held_s=before_s - 0.1)  # that was an earlier motion
    assert not pauses(robot, 0.2, held_s=robot.now_s)


# ---- what is read -------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("joint", "told"), [(0, 57.3), (2, 30.0), (5, 3.0), (5, -1e300), (1, np.inf), (0, 0.0)]
)
def test_a_velocity_that_the_positions_do_not_bear_out_is_not_stopped_from(joint, told):
    """Finding: one velocity in degrees gave a stop that ended 230 deg ahead."""
    robot = SimulatedController()
    robot.qd = SPEED * [1, 1, 1, 1, 1, 0]
    robot.run(0.3)
    odd = robot.qd.copy()
    odd[joint] = told
    robot.state.read(np.arange(6), robot.q, robot.now_s, velocity=odd)
    plan = robot.begins()
    assert plan.qd[0] == pytest.approx(robot.qd, abs=1e-6)
    assert plan.duration_s <= np.max(np.abs(SPEED) / ROBOT.max_acceleration) + 1e-6


@pytest.mark.parametrize("away", [-2.0, 0.3, 1e12])
def test_a_single_wild_position_is_not_stopped_from(away):
    robot = SimulatedController(reports="nan")
    robot.run(0.3)
    wild = robot.q + CYCLE_S * SPEED + away * np.eye(6)[3]
    robot.state.read(np.arange(6), wild, robot.now_s + CYCLE_S)
    robot.begins(robot.now_s + CYCLE_S)
    assert robot.plans[0].q[0] == pytest.approx(robot.q + CYCLE_S * SPEED, abs=1e-3)
    assert robot.plans[0].qd[0] == pytest.approx(SPEED, abs=1e-2)


def test_a_stop_keeps_to_the_joints_speeds_and_limits():
    """Even where all readings say that the robot is faster, and as good as at its limits."""
    robot = SimulatedController()
    robot.qd = 5.0 * ROBOT.max_velocity
    robot.q = ARM.upper - 0.01 - 0.1 * robot.qd
    robot.run(0.1)
    plan = robot.begins().going_on(REACTION_S)
    assert np.all(plan.qd <= ROBOT.max_velocity + 1e-12)
    between, _ = plan.at(np.linspace(0.0, plan.duration_s, 50))
    assert np.all(between <= ARM.upper + REACTION_S * ROBOT.max_velocity)


def test_a_stop_begins_where_the_controller_is_while_the_robot_follows_it():
    robot = SimulatedController()
    told = [HOME, SPEED]
    robot.state.told = lambda now: (*told, now)
    robot.run(0.3)
    told[0] = robot.q + 0.014 * SPEED  # by which drives lag
    robot.begins()
    assert robot.plans[0].q[0] == pytest.approx(told[0], abs=1e-12)
    told[0] = robot.q + 0.3  # a robot that is held, or another one's controller
    robot.begins()
    assert robot.plans[1].q[0] == pytest.approx(robot.q, abs=1e-6)
