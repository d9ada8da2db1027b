"""The thermal session: samples and commands in, judged proposals out. No clock, no ROS."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from robocal_ros.estimation.sphere import SphereRule, cloud_sample
from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError, StorageError
from robocal_ros.ground.proposals import REFERENCE, THERMAL, Head
from robocal_ros.ground.samples import (
    JOINTS,
    JUMPS,
    MEASURED_POINT,
    MEASURED_POSE,
    REFERENCE_SPHERE,
    SPHERE_CENTER,
    SPHERE_CLOUD,
    TEMPERATURES,
    JointBlock,
    JointSample,
    Measurements,
    PointSample,
    PoseSample,
    TemperatureSample,
    joint_sample,
    point_sample,
    pose_sample,
    temperature_sample,
)
from robocal_ros.ground.streams import StandstillRule
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.events import (
    CONFIGURE,
    NEWEST,
    Command,
    History,
    Outcome,
    decide,
    joints_awaited_ns,
    outside_decision,
    reached,
    require_robot,
    seeded,
)
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel
from robocal_ros.thermal.drift_following import (
    DriftFollower,
    FollowerState,
    Following,
    InForce,
    ThermalConfig,
)
from robocal_ros.thermal.observations import (
    TIME_OUT,
    Beside,
    MotorTemperatures,
    Observation,
    ObservationDesk,
    OpenCycle,
    Windows,
    ended,
)
from robocal_ros.thermal.proposing import CandidateStore, Proposer, SetUp
from robocal_ros.thermal.reference import SAME_VISIT_RAD, ColdReference

Array = NDArray[np.float64]


SAME_CLOCK_NS = 1_000_000_000


class Bounds:
    """Gives commands what replay needs to find the same samples."""

    def __init__(
        self, desk: ObservationDesk, cycle: OpenCycle, windows: Windows, config: ThermalConfig
    ) -> None:
        self._desk, self._cycle, self._windows, self._config = desk, cycle, windows, config

    def stamped(self, command: Command, clock_ns: int | None) -> Command:
        """Return the command with a stamp: its own, the clock's, or the newest known."""
        if command.stamp_ns is None:
            newest = self._desk.clock_ns
            near = clock_ns is not None and newest <= clock_ns <= newest + SAME_CLOCK_NS
            command = replace(command, stamp_ns=clock_ns if near else newest)
        return command

    def named(self, command: Command) -> Command:
        """Name a cycle: as the open one, else by its time."""
        begins = command.name == events.BEGIN_CYCLE
        if command.arguments.get("cycle_id") or not (begins or command.name in events.CYCLE):
            return command
        by_time = str(np.datetime64((command.stamp_ns or 0) // 1_000_000, "ms"))
        name = by_time if begins else self._cycle.id or by_time
        return replace(command, arguments={**command.arguments, "cycle_id": name})

    def marked(self, command: Command) -> Command:
        """Return the command with the bounds of its samples, for the record."""
        marks, arguments = self._desk.marks, dict(command.arguments)
        if command.name in events.MEASURED:
            arguments.setdefault("from_ns", self._windows.from_ns(command))
        return replace(command, marks=marks, arguments=arguments)

    def ready(self, command: Command) -> bool:
        """Whether its samples are complete."""
        return reached(self._wanted(command), self._desk.newest_ns, self._desk.jumps)

    def joints_awaited_ns(self, command: Command) -> int | None:
        """Stamp of the joint reading that it waits for; None when it waits for none."""
        return joints_awaited_ns(self._wanted(command), self._desk.newest_ns)

    def _wanted(self, command: Command) -> Mapping[str, int]:
        """Marks up to which samples must have come."""
        if command.marks is not None:
            return command.marks
        marks = {JUMPS: self._desk.jumps}
        if command.name in events.MEASURED:
            marks[JOINTS] = (command.stamp_ns or 0) + int(self._config.lateness_s * 1e9)
        return marks


__all__ = ["ThermalConfig", "ThermalSession"]
_NO_REFERENCE = "no cold reference: capture it before the first cycle"


class ThermalSession:
    """Identifies the model of one arm from measurements at standstill.

    Without a cold reference, ``identify`` calibrates base, targets and model from all poses and
    judges on held-out ones; with one, it identifies the drift since then.

    Attributes
    ----------
    temperatures : of the motors.
    cycle : the measuring cycle that is open.
    windows : which measurements belong to a cycle.
    """

    def __init__(
        self,
        nominal: SerialArm,
        history: History,
        config: ThermalConfig,
        software: str,
    ) -> None:
        self.nominal = nominal
        self.config = config
        self.desk = ObservationDesk(
            nominal.joint_names, config.standstill, config.measuring_frame or None
        )
        self.received, self.ignored = self.desk.received, self.desk.ignored
        self._history = history
        self._queue: list[Command] = []
        self._current = InForce(history, nominal)
        self.temperatures = MotorTemperatures(nominal.joint_names)
        self.cycle = OpenCycle()
        self.windows = Windows(self.desk, self.cycle, self._current, config)
        self._bounds = Bounds(self.desk, self.cycle, self.windows, config)
        self._following = Following(history, self._current, config.sigma_m, config.work)
        keeper = CandidateStore(nominal, history, software, self._current)
        self._set_up = SetUp(nominal, history, config, self._current, keeper)
        self._proposer = Proposer(nominal, config, self._current, self._following, keeper)

    @property
    def in_force(self) -> Head:
        """Head of the history as the session last saw it."""
        return self._current.head

    @property
    def reference(self) -> ColdReference | None:
        """The cold reference, or None."""
        return self._current.reference

    @property
    def reference_id(self) -> int | None:
        """Calibration that is the cold reference, or None."""
        return self._current.reference_id

    @property
    def fault(self) -> str:
        """Why the history could not be read at the last look; empty when it could."""
        return self._current.fault

    @property
    def newest_joints_ns(self) -> int:
        """Stamp of the newest joint reading; 0 before any."""
        return self.desk.newest_ns.get(JOINTS, 0)

    def refuse(self, kind: str, error: RobocalError) -> None:
        """Count a message of an input that cannot be used."""
        self.ignored.add(kind, str(error))

    @property
    def arm(self) -> SerialArm:
        """The arm with the model in force."""
        return self._current.arm

    @property
    def reference_model(self) -> dict[str, Any] | None:
        """The cold reference as it is kept, or None."""
        return self._current.reference_model

    def expected_drift(self) -> Array:
        """Covariance (k, k), SI, of the drift that a shift may bring."""
        if self.follower is not None:
            return self.follower.expected_drift()
        return self._following.expected.process.covariance

    def add(self, sample: JointSample | PointSample | PoseSample | TemperatureSample) -> None:
        """Take a sample."""
        if isinstance(sample, JointSample):
            jumps = self.desk.jumps
            self.desk.add_joints(sample)
            if self.desk.jumps > jumps:
                self._clock_jumped(sample.stamp_ns)
        elif isinstance(sample, TemperatureSample):
            self.temperatures.add(sample)
            self.desk.newest_ns[TEMPERATURES] = self.temperatures.newest_ns or 0
        else:
            self.desk.add_measurement(sample)

    def take_plain(self, block: JointBlock, start: int) -> int:
        """Take the joint readings from ``start`` on that decide nothing: how many these are.

        As `add` of each, many times faster. The reading after them is for `add`.
        """
        awaited_ns = self._bounds.joints_awaited_ns(self._queue[0]) if self._queue else None
        return self.desk.take_plain(block, start, awaited_ns)

    def _clock_jumped(self, stamp_ns: int) -> None:
        """Nothing that an earlier clock stamped can be compared any more."""
        self.temperatures = MotorTemperatures(self.nominal.joint_names)
        self.cycle.begun_ns = stamp_ns
        with suppress(RobocalError):  # said by `accuracy`
            if self.follower is not None:
                self.follower.clock_jumped(stamp_ns)

    def submit(self, command: Command, clock_ns: int | None = None) -> None:
        """Queue a command; ``advance`` carries it out when its samples are complete.

        A command without a stamp gets ``clock_ns`` where that is on the samples' clock (within
        a second after the newest of them), else the newest stamp known.
        """
        self._queue.append(self._bounds.stamped(command, clock_ns))

    @property
    def waiting(self) -> int:
        """Number of commands not yet carried out."""
        return len(self._queue)

    def advance(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out the commands whose samples are complete.

        ``wall_ns`` enters the history's records only; ``force`` carries out all with what is
        there (no more samples will come, or a caller's deadline has passed).
        """
        outcomes: list[Outcome] = []
        while done := self.step(wall_ns=wall_ns, force=force):
            outcomes += done
        return outcomes

    def step(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out one command, as ``advance``: what was decided outside before it, and it."""
        if not self._queue or not (force or self._bounds.ready(self._queue[0])):
            return []
        command = self._bounds.named(self._queue.pop(0))
        outside = self.poll()
        if command.marks is None:
            command = self._bounds.marked(command)
        outcome = self._carry_out(command, wall_ns)
        outside += [
            outside_decision(decision, self.desk.marks) for decision in self._current.look(wall_ns)
        ]
        return [*outside, replace(outcome, revision=self.in_force.revision)]

    def _carry_out(self, command: Command, wall_ns: int) -> Outcome:
        handlers: dict[str, Callable[[Command, int], Outcome]] = {
            events.CALIBRATE_SENSOR: self._calibrate_sensor,
            events.CAPTURE_REFERENCE: self._capture_reference,
            events.IDENTIFY: self._identify,
            events.BEGIN_CYCLE: self._begin_cycle,
            events.END_CYCLE: self._end_cycle,
            events.ACCEPT: self._decide,
            events.REJECT: self._decide,
            events.ROLLBACK: self._decide,
        }
        return events.carried_out(handlers, command, wall_ns)

    def _calibrate_sensor(self, command: Command, wall_ns: int) -> Outcome:
        """Place the sensor; the samples stay, for the cold reference."""
        data, _ = self.windows.of(command)
        return self._set_up.place_sensor(command, data, self.desk.frame or "", wall_ns)

    def _capture_reference(self, command: Command, wall_ns: int) -> Outcome:
        data, fixed = self.windows.of(command)
        reference = self._beside(command, data, fixed)
        outcome = self._set_up.capture(command, data, reference, wall_ns)
        self._close_cycle(command)
        return outcome

    def _identify(self, command: Command, wall_ns: int) -> Outcome:
        method = self._proposer.method(command)
        data, fixed = self.windows.of(command)
        beside = self._beside(command, data, fixed)
        outcome = self._proposer.identify(command, data, beside, method, wall_ns)
        self._close_cycle(command)
        return outcome

    def _beside(self, command: Command, data: Measurements, fixed: Array) -> Beside:
        """With the motor temperatures up to the middle of what was measured."""
        newest = (command.marks or {}).get(TEMPERATURES, -1)
        until_ns = min(data.middle_ns, newest)
        follower = self.follower
        after_ns = 0 if follower is None else follower.read_ns
        readings = self.temperatures.between(after_ns, until_ns)
        return Beside(fixed, readings, self.temperatures.at(until_ns))

    def _close_cycle(self, command: Command) -> None:
        self.cycle.close()
        self.desk.use(command.stamp_ns or 0)

    def _begin_cycle(self, command: Command, wall_ns: int) -> Outcome:
        if self.reference is None:
            raise ConflictError(_NO_REFERENCE)
        cycle_id, stamp_ns = str(command.arguments["cycle_id"]), command.stamp_ns or 0
        going_on = self.cycle.id == cycle_id
        message = self.cycle.begin(cycle_id, stamp_ns, self._history)
        if not going_on:
            self.desk.use(stamp_ns)
        return Outcome(command, Code.ACCEPT, message, repeated=going_on)

    def _end_cycle(self, command: Command, wall_ns: int) -> Outcome:
        """Identify from the cycle; when that fails it stays open, unless its time has run out."""
        cycle_id = str(command.arguments["cycle_id"])
        if self.cycle.id != cycle_id:
            if (before := ended(cycle_id, self._history)) is not None:
                message = f"cycle '{cycle_id}' has ended already: {before.reason}"
                return Outcome(command, before.code, message, None, before.id, repeated=True)
            if self.cycle.id:
                raise ConflictError(f"cycle '{self.cycle.id}' is open, not '{cycle_id}'")
        if self.reference is None:
            raise ConflictError(_NO_REFERENCE)
        try:
            return self._identify(command, wall_ns)
        except StorageError:
            self.cycle.postponed_ns = self.desk.newest_ns.get(JOINTS, 0)
            raise
        except Exception:
            if command.arguments.get("by") == TIME_OUT:
                self._close_cycle(command)
            raise

    def overdue(self) -> Command | None:
        """The command that ends a cycle whose time has run out; None while there is none."""
        idle = not self._queue and self.reference is not None
        return self.windows.overdue() if idle else None

    def _decide(self, command: Command, wall_ns: int) -> Outcome:
        return decide(self._history, command, self.in_force.revision, wall_ns)

    @property
    def follower(self) -> DriftFollower | None:
        """What follows the drift since the cold reference; None without one."""
        return self._following.follower

    def accuracy(self, stamp_ns: int) -> Accuracy:
        """How far the tool may be off at a stamp with the model in force."""
        return accuracy_of(self._following, self._current, self.config, self.temperatures, stamp_ns)

    def poll(self) -> list[Outcome]:
        """Take over what another process decided in the history since the last look."""
        return [outside_decision(decision, self.desk.marks) for decision in self._current.look()]


def take_message(session: ThermalSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason.

    ``kind`` is the input that the message belongs to; other kinds are left alone.
    """
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in (MEASURED_POINT, SPHERE_CENTER, REFERENCE_SPHERE):
            session.add(point_sample(message, session.config.target, kind))
        elif kind == SPHERE_CLOUD:
            session.add(cloud_sample(message, session.config.sphere, session.config.target))
        elif kind == TEMPERATURES:
            session.add(temperature_sample(message))
        elif kind == MEASURED_POSE:
            session.add(pose_sample(message, session.config.target))
    except RobocalError as error:
        session.refuse(kind, error)


DUE_AHEAD_S = 300.0  # a measurement is due so long before the bound reaches the tolerance


def accuracy_of(
    following: Following,
    current: InForce,
    config: ThermalConfig,
    temperatures: MotorTemperatures,
    stamp_ns: int,
) -> Accuracy:
    """Judge the model in force at a stamp, with the motors' temperatures."""
    if current.fault:
        return Accuracy(AccuracyLevel.FAULT, current.fault)
    try:
        follower = following.follower
        if follower is None:
            words = "no cold reference: how far the robot has drifted is not known; capture one"
            return Accuracy(AccuracyLevel.EXPIRED, words)
        with follower.looking_ahead(temperatures.between(follower.read_ns, stamp_ns)):
            return _judged(follower, current, config, stamp_ns)
    except RobocalError as error:
        return Accuracy(AccuracyLevel.FAULT, str(error))


def _judged(
    follower: DriftFollower, current: InForce, config: ThermalConfig, stamp_ns: int
) -> Accuracy:
    time_s = follower.time_s(stamp_ns)
    forecast = follower.forecast(current.arm)
    error, tolerance_mm = forecast.at(time_s), config.tolerance_m * 1e3
    age_s = time_s - follower.state.tracker.time_s
    left_s = config.expires_after_s - age_s
    due_in_s = min(forecast.due_in_s(time_s, config.tolerance_m), left_s) - DUE_AHEAD_S
    bound = f"95 % of tool errors below {error.bound_m * 1e3:.2f} mm"
    allowed = f"of {tolerance_mm:.2f} mm allowed"
    if follower.state.moved:
        return Accuracy(AccuracyLevel.FAULT, follower.state.moved, error, due_in_s)
    if left_s <= 0.0:
        words = f"last measured {age_s / 3600.0:.1f} h ago: measure a cycle"
        return Accuracy(AccuracyLevel.EXPIRED, words, error, due_in_s)
    if error.bound_m > config.tolerance_m:
        words = f"{bound}, {allowed}: measure a cycle, accept its model"
        return Accuracy(AccuracyLevel.DEGRADED, words, error, due_in_s)
    if due_in_s <= 0.0:
        return Accuracy(AccuracyLevel.DUE, f"{bound}, {allowed}: measure a cycle", error, due_in_s)
    return Accuracy(AccuracyLevel.OK, f"{bound}, {allowed}", error, due_in_s)


def session_as_recorded(
    nominal: SerialArm, history: History, configured: Command, software: str
) -> ThermalSession:
    """Make a session with the recorded settings; an empty history gets what was in force.

    Raises
    ------
    WrongRobotError
        The recording was made with another nominal model.
    InputError
        The configuration cannot be read.
    """
    require_robot(nominal, configured)
    arguments = configured.arguments
    try:
        model, reference = arguments["model"], arguments["reference"]
        tracker = arguments["tracker"]
    except KeyError as error:
        raise InputError(f"the recorded configuration lacks {error}") from error
    config = config_of(arguments)
    state = None if tracker is None else FollowerState.of_document(tracker)
    in_force = {THERMAL: model, REFERENCE: reference}
    fresh = seeded(history, nominal, in_force, software)
    session = ThermalSession(nominal, history, config, software)
    if fresh and state is not None and session.follower is not None:
        session.follower.go_on_from(state)
    return session


OWN = "tracker"  # only a thermal session's configuration has it


def configuration(session: ThermalSession, topics: Mapping[str, str] | None = None) -> Command:
    """The session's settings and what is in force, so that replay can start from the same.

    Recorded at the start and after each change of what is in force: a recording that begins
    later has it too. ``topics``: name of each input's topic.
    """
    return Command(
        CONFIGURE,
        {
            "robot": session.nominal.name,
            "model_hash": session.nominal.model_hash,
            "topics": dict(topics or {}),
            "config": asdict(session.config),
            "model": session.in_force.model,
            "reference": session.reference_model,
            OWN: None if session.follower is None else session.follower.state.document(),
        },
        session.desk.newest_ns.get(JOINTS, 0),
        session.desk.marks,
    )


def is_thermal_session(configured: Command | None) -> bool:
    """Whether a configuration was recorded by a thermal session."""
    return configured is not None and OWN in configured.arguments


def config_of(arguments: Mapping[str, Any]) -> ThermalConfig:
    """Read the settings back from a configuration record.

    Raises
    ------
    InputError
        When the record has other settings than this version knows.
    """
    try:
        values = dict(arguments["config"])
        rule = StandstillRule(**values.pop("standstill"))
        sphere = SphereRule(**values.pop("sphere"))
        for name in ("drift_parameters", "tip_m"):
            values[name] = tuple(values.get(name, ()))
        values["work_poses"] = tuple(tuple(q) for q in values.get("work_poses", ()))
        return ThermalConfig(standstill=rule, sphere=sphere, **values)
    except (KeyError, TypeError) as error:
        raise InputError(f"the recorded configuration cannot be read: {error}") from error


LARGEST_CYCLE = 60  # more poses than this are a calibration, not a measuring cycle


def window_commands(
    cold: tuple[int, int] | None, warm: Sequence[tuple[int, int]]
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Commands for time windows (from, to; ns): the cold reference, then one cycle each."""
    commands: list[tuple[Command, Mapping[str, Any]]] = []
    if cold is not None:
        arguments = {"from_ns": cold[0], "by": "replay"}
        commands.append((Command(events.CAPTURE_REFERENCE, arguments, cold[1]), {}))
    for number, (start, end) in enumerate(warm, start=1):
        arguments = {"from_ns": start, "cycle_id": f"window-{number}"}
        commands.append((Command(events.IDENTIFY, arguments, end), {}))
    return commands


def automatic_commands(
    observations: Sequence[Observation],
) -> list[tuple[Command, Mapping[str, Any]]]:
    """Find the cycles of a recording without commands.

    Poses that recur from cycle to cycle: the first visit is the cold reference, each later one
    a warm cycle. Otherwise everything is one calibration.

    Raises
    ------
    InputError
        When nothing was observed.
    """
    if not observations:
        raise InputError("no measurement at standstill in this recording")
    starts = _cycle_starts(observations)
    end = observations[-1].stamp_ns
    if len(starts) < 2:
        return window_commands(None, [(observations[0].stamp_ns, end)])
    edges = [observations[i].stamp_ns for i in starts]
    last = [observations[i - 1].stamp_ns for i in starts[1:]] + [end]
    windows = list(zip(edges, last, strict=True))
    return window_commands(windows[0], windows[1:])


def accepting(
    commands: Iterable[tuple[Command, Mapping[str, Any]]], by: str
) -> list[tuple[Command, Mapping[str, Any]]]:
    """The same commands, with each candidate accepted where its own verdict accepts it."""
    found: list[tuple[Command, Mapping[str, Any]]] = []
    for command, outcome in commands:
        found.append((command, outcome))
        if command.name == events.IDENTIFY:
            arguments = {"choose": NEWEST, "by": by, "reason": "its verdict accepts"}
            found.append((Command(events.ACCEPT, arguments, command.stamp_ns), {}))
    return found


def _cycle_starts(observations: Sequence[Observation]) -> list[int]:
    """Index of the first observation of each cycle; one alone when poses do not recur."""

    def same(a: Observation, b: Observation) -> bool:
        near = np.max(np.abs(a.q - b.q)) < SAME_VISIT_RAD
        return a.target == b.target and bool(near)

    first = observations[0]
    limit = min(len(observations), LARGEST_CYCLE + 1)
    length = next((i for i in range(1, limit) if same(first, observations[i])), None)
    if length is None:
        return [0]
    starts = [i for i, o in enumerate(observations) if same(first, o)]
    known = observations[:length]
    recurring = sum(any(same(o, k) for k in known) for o in observations[length:])
    return starts if recurring >= 0.9 * len(observations[length:]) else [0]
