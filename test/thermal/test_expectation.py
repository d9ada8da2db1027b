# SPDX-License-Identifier: Apache-2.0
"""What a robot's own history teaches, with and without motor temperatures."""

from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from shift import NOISE_M, NS, DriftingRobot, warmed

from robocal_ros.ground.errors import Code
from robocal_ros.ground.samples import TemperatureSample
from robocal_ros.session import events
from robocal_ros.session.events import Outcome
from robocal_ros.thermal.accuracy import earlier_shifts, expected_drift
from robocal_ros.thermal.drift_following import FollowerState, ThermalConfig
from robocal_ros.thermal.identification import drift_prior
from robocal_ros.thermal.observations import MotorTemperatures
from robocal_ros.thermal.session import ThermalSession

POSES, CYCLES = 8, 12
COLD_C = 21.0


def config(prior: str) -> ThermalConfig:
    return ThermalConfig(prior="learned" if prior == "learned" else "default", sigma_m=NOISE_M)


class Robot(DriftingRobot):
    """Its links follow its motors at once; shift after shift in one history."""

    def __init__(self, folder: Path, *, prior: str = "default", temperatures: bool = False) -> None:
        self.temperatures = temperatures
        self.silent: tuple[str, ...] = ()
        super().__init__(folder, config(prior), POSES)

    def start(self, prior: str | None = None) -> ThermalSession:
        self.config = config(prior) if prior else self.config
        return super().start()

    def warmth(self, kelvin: float) -> None:
        """All motors are read but those that are silent."""
        if self.temperatures:
            for name in self.nominal.joint_names:
                at = self.shift.now_ns
                if name not in self.silent:
                    self.session.add(TemperatureSample(at, name, COLD_C + kelvin))

    def visit(self, command: str, kelvin: float, after_h: float) -> Outcome:
        self.shift.now_ns += round(after_h * 3600 * NS)
        self.warmth(kelvin)
        self.feed(self.shift.visit(warmed(self.cold, kelvin), self.q))
        return self.ask(command)

    def morning(self) -> Outcome:
        """A cold reference, which it returns, and three cycles."""
        captured = self.visit(events.CAPTURE_REFERENCE, 0.0, 12.0)
        assert captured.done
        for kelvin in (4.0, 7.0, 9.0):
            assert self.visit(events.IDENTIFY, kelvin, 0.3).calibration_id
        return captured

    def work(self, highest_k: float) -> list[Outcome]:
        """A night's rest, a cold reference, and a shift that warms up."""
        assert self.visit(events.CAPTURE_REFERENCE, 0.0, 12.0).done
        rise = highest_k * (1.0 - np.exp(-np.arange(1, CYCLES + 1) / 4.0))
        return [self.visit(events.IDENTIFY, kelvin, 0.3) for kelvin in rise]


def test_the_history_teaches_what_drift_to_expect(tmp_path):
    robot = Robot(tmp_path)
    robot.work(15.0)
    found, words = expected_drift(robot.nominal, robot.history)
    assert found is not None
    assert words == "learned from 1 shifts"
    default = drift_prior(robot.nominal)
    assert np.trace(found.process.covariance) < np.trace(default)
    assert found.sigma_m == pytest.approx(NOISE_M, rel=0.25)
    assert np.array_equal(robot.session.expected_drift(), default)
    robot.start("learned")
    assert np.array_equal(robot.session.expected_drift(), default)  # of this reference
    captured = robot.visit(events.CAPTURE_REFERENCE, 0.0, 12.0)
    assert "learned from 1 shifts" in captured.message
    assert np.array_equal(robot.session.expected_drift(), found.process.covariance)


def test_too_little_teaches_nothing_and_says_so(tmp_path):
    robot = Robot(tmp_path)
    robot.visit(events.CAPTURE_REFERENCE, 0.0, 0.0)
    robot.visit(events.IDENTIFY, 5.0, 1.0)
    found, words = expected_drift(robot.nominal, robot.history)
    assert found is None
    assert words.startswith("default, because no shift has 10 cycles")


def test_what_was_rolled_back_or_rejected_teaches_nothing(tmp_path):
    robot = Robot(tmp_path)
    outcomes = robot.work(15.0)
    ids = [o.calibration_id for o in outcomes]
    robot.history.accept(ids[-1], by="", reason="", wall_ns=1)
    (shift,) = earlier_shifts(robot.nominal, robot.history)
    assert len(shift.cycles) == CYCLES
    robot.history.rollback(None, by="", reason="wrong", wall_ns=2)
    robot.history.reject(ids[-2], by="", reason="wrong", wall_ns=3)
    (shift,) = earlier_shifts(robot.nominal, robot.history)
    assert len(shift.cycles) == CYCLES - 2
    assert shift.temperature is None


@pytest.fixture(scope="module")
def shifts(tmp_path_factory) -> Robot:
    """Three of them with temperatures."""
    robot = Robot(tmp_path_factory.mktemp("shifts"), temperatures=True)
    for highest in (12.0, 20.0, 16.0):
        robot.work(highest)
    robot.history.close()
    return robot


@pytest.fixture
def learned(shifts, tmp_path) -> Robot:
    """A session that has learned from them."""
    copytree(shifts.folder, tmp_path, dirs_exist_ok=True)
    robot = Robot(tmp_path, temperatures=True)
    robot.shift.now_ns = shifts.shift.now_ns
    robot.start("learned")
    return robot


def test_a_motor_that_was_not_read_when_cold_hides_no_drift(learned):
    """Its warmth cannot be told from then on: what it brings is expected, and no step."""
    silent = learned.nominal.joint_names[2]
    learned.silent = (silent,)
    try:
        captured = learned.visit(events.CAPTURE_REFERENCE, 0.0, 12.0)
        default = np.trace(drift_prior(learned.nominal))
        assert np.trace(learned.session.expected_drift()) > 0.1 * default
        found = learned.visit(events.IDENTIFY, 15.0, 2.0)
    finally:
        learned.silent = ()
        again = learned.visit(events.CAPTURE_REFERENCE, 0.0, 12.0)
    assert captured.message.endswith(f"3 shifts, followed without: no temperature of {silent}")
    assert found.status is not Code.SENSOR_OR_ROBOT_MOVED, found.message
    assert "followed without" not in again.message


def test_temperatures_tell_the_drift_between_cycles(learned):
    """Warmer by 6 K since the last cycle, as only the motors tell: most of that drift is seen."""
    session = learned.session
    assert "learned with temperatures from 3 shifts" in learned.morning().message
    follower = session.follower
    assert follower is not None
    learned.shift.now_ns += 1800 * NS
    learned.warmth(15.0)
    now_ns = learned.shift.now_ns
    arm = session.reference.cell.arm
    before = follower.state
    with follower.looking_ahead(session.temperatures.between, now_ns):
        told, _ = follower.forecast(session.current.arm).drift_at(follower.time_s(now_ns))
    assert follower.state is before
    true = arm.parameters.read(warmed(learned.cold, 15.0).mdh - learned.cold.mdh)
    held = arm.parameters.read(warmed(learned.cold, 9.0).mdh - learned.cold.mdh)
    moved = [arm.parameter_jacobian(learned.q, [0.1, 0.05, 0.2])[:, :3] @ d for d in (told, held)]
    true_moved = arm.parameter_jacobian(learned.q, [0.1, 0.05, 0.2])[:, :3] @ true
    error, hold = (np.sqrt(np.mean((m - true_moved) ** 2)) for m in moved)
    assert error < 0.5 * hold


def test_a_restart_keeps_the_temperatures_course(learned):
    learned.morning()
    state = learned.session.follower.state
    session = learned.start("learned")
    again = session.follower.state
    assert np.array_equal(state.heat.array(), again.heat.array())
    assert np.array_equal(state.tracker.mean, again.tracker.mean)
    back = FollowerState.of_document(state.document())
    assert np.array_equal(back.tracker.covariance, state.tracker.covariance)
    assert np.array_equal(back.heat.array(), state.heat.array())


def test_silent_temperatures_cost_certainty_and_not_the_cycle(learned):
    """An hour without a reading: the cycle counts, and less is known than with readings."""
    learned.morning()
    follower = learned.session.follower
    forecast = follower.forecast(learned.session.current.arm)
    _, before = forecast.drift_at(follower.time_s(learned.shift.now_ns))
    learned.warmth(9.0)
    learned.temperatures = False
    try:
        learned.shift.now_ns += 3600 * NS
        _, silent = forecast.drift_at(follower.time_s(learned.shift.now_ns))
        found = learned.visit(events.IDENTIFY, 9.0, 0.0)
    finally:
        learned.temperatures = True
    assert np.trace(silent) > 2.0 * np.trace(before)
    assert found.calibration_id
    assert found.status.name != "SENSOR_OR_ROBOT_MOVED"
    assert "motor_temperature" not in learned.history.inputs(found.calibration_id)
    assert follower.state.heat.time_s < follower.state.tracker.time_s - 3000.0


def test_a_motor_that_falls_silent_is_named_by_accuracy_and_cycle(learned):
    assert learned.visit(events.CAPTURE_REFERENCE, 0.0, 12.0).done
    session, (first, *_) = learned.session, learned.nominal.joint_names
    assert "no temperature" not in session.accuracy(learned.shift.now_ns).reason
    learned.silent = (first,)
    try:
        found = learned.visit(events.IDENTIFY, 4.0, 0.3)
    finally:
        learned.silent = ()
    words = f"no temperature of {first}: see what sends motor_temperatures"
    for reason in (found.message, session.accuracy(learned.shift.now_ns).reason):
        assert reason.endswith(words), reason


def test_a_clock_that_jumps_back_stops_nothing(learned):
    """With temperatures: cycles go on, and accuracy ages on the new clock."""
    learned.morning()
    learned.shift.now_ns -= 6 * 3600 * NS
    statuses = [learned.visit(events.IDENTIFY, 9.0, 0.2).status.name for _ in range(3)]
    assert "STALE" not in statuses
    follower = learned.session.follower
    assert follower.state.heat.time_s > follower.state.tracker.time_s - 600.0
    bounds = [
        learned.session.accuracy(learned.shift.now_ns + hours * 3600 * NS).error.bound_m
        for hours in (0, 1, 4)
    ]
    assert bounds == sorted(bounds)
    assert bounds[2] > bounds[0]
    state = follower.state
    again = learned.start("learned").follower.state
    assert np.array_equal(state.tracker.covariance, again.tracker.covariance)


def test_readings_do_not_depend_on_their_order():
    """The first of each ten seconds of each joint; both joints known, none silent."""
    samples = [TemperatureSample(s * NS, name, s + 0.1) for s in range(1, 40) for name in "ab"]
    straight, shuffled = MotorTemperatures(("a", "b")), MotorTemperatures(("a", "b"))
    for sample in samples:
        straight.add(sample)
    for i in np.random.default_rng(0).permutation(len(samples)):
        shuffled.add(samples[i])
    for found in (straight, shuffled):
        readings = found.between(0, 35 * NS)
        assert [stamp // NS for stamp, _ in readings] == [1, 10, 20, 30]
        assert [t.tolist() for _, t in readings[1:3]] == [[10.1, 10.1], [20.1, 20.1]]
        assert found.at(25 * NS).tolist() == [20.1, 20.1]
        assert found.at(2000 * NS) is None
    straight.add(TemperatureSample(1500 * NS, "a", 50.0))
    assert straight.at(1600 * NS) is None  # b has been silent


def test_one_motor_that_is_never_read_fills_no_memory():
    found = MotorTemperatures(("a", "b"))
    for i in range(25_000):
        found.add(TemperatureSample(i * 10 * NS + 1, "a", 30.0))
    assert found.at(250_000 * NS) is None
    assert len(found._kept) <= 20_000


def test_no_temperatures_are_known_while_a_motor_is_silent():
    """However young the others' are; who asks is told the same by both."""
    found = MotorTemperatures(("a", "b"))
    found.add(TemperatureSample(600 * NS, "a", 20.0))
    found.add(TemperatureSample(1200 * NS, "b", 30.0))
    assert (found.at(1400 * NS).tolist(), found.silent(1400 * NS)) == ([20.0, 30.0], ())
    assert (found.at(1600 * NS), found.silent(1600 * NS)) == (None, ("a",))
