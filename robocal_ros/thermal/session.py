# SPDX-License-Identifier: Apache-2.0
"""The thermal session: samples and commands in, judged proposals out. No clock, no ROS."""

from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import asdict, replace
from typing import Any

import numpy as np

from robocal_ros.estimation.sphere import SphereRule, cloud_sample
from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    RobocalError,
    StorageError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array
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
    StandstillRule,
    TemperatureSample,
    joint_sample,
    point_sample,
    pose_sample,
    temperature_sample,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import REFERENCE, THERMAL, Entry
from robocal_ros.kinematics import SerialArm
from robocal_ros.session import events
from robocal_ros.session.events import (
    NEWEST,
    OWN,
    Command,
    Handler,
    Outcome,
    SessionBase,
    configured_with,
    recorded_arguments,
    seeded,
)
from robocal_ros.thermal.accuracy import Accuracy, AccuracyLevel
from robocal_ros.thermal.drift_following import (
    FLANGE,
    DriftFollower,
    FollowerState,
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
    PlacedShot,
    Windows,
)
from robocal_ros.thermal.proposing import LEFT_OUT, Proposer
from robocal_ros.thermal.reference import SAME_VISIT_RAD, ColdReference

SAME_CLOCK_NS = 1_000_000_000
REMEMBERED = 200  # calibrations back to which a cycle's id is known
DUE_AHEAD_S = 300.0  # a measurement is due so long before the bound reaches the tolerance
LARGEST_CYCLE = 60  # more poses than this are a calibration, not a measuring cycle
NO_REFERENCE = "no cold reference: capture it before the first cycle"


class ThermalSession(SessionBase):
    """Identifies the model of one arm from measurements at standstill.

    Without a cold reference, ``identify`` calibrates base, targets and model from all poses and
    judges on held-out ones; with one, it identifies the drift since then.

    ``current``: what is in force. ``temperatures``: of the motors. ``cycle``: the measuring cycle
    that is open. ``windows``: which measurements belong to a cycle.
    """

    def __init__(
        self, nominal: SerialArm, history: CalibrationHistory, config: ThermalConfig, software: str
    ) -> None:
        self.config = config
        self.current = InForce(history, nominal, config)
        super().__init__(self.current)
        self.desk = ObservationDesk(
            nominal.joint_names, config.standstill, config.measuring_frame or None
        )
        self.received, self.ignored = self.desk.received, self.desk.ignored
        self.stream, self.newest_ns = self.desk.stream, self.desk.newest_ns
        self.temperatures = MotorTemperatures(nominal.joint_names)
        self.cycle = OpenCycle()
        self.windows = Windows(self.desk, self.cycle, self.current)
        self._proposer = Proposer(software, self.current)

    @property
    def marks(self) -> dict[str, int]:
        """How far the samples have come: newest stamps, and jumps of the clock."""
        return self.desk.marks

    @property
    def reference(self) -> ColdReference | None:
        """The cold reference, or None."""
        return self.current.reference

    @property
    def follower(self) -> DriftFollower | None:
        """What follows the drift since the cold reference; None without one."""
        return self.current.follower

    def expected_drift(self) -> Array:
        """Covariance (k, k), SI, of the drift that a shift may bring."""
        if self.follower is not None:
            return self.follower.expected_drift()
        return self.current.expected.process.covariance

    def add(self, sample: JointSample | PointSample | TemperatureSample) -> None:
        """Take a sample."""
        if isinstance(sample, JointSample):
            jumps, left_ns = self.desk.jumps, self.desk.newest_ns.get(JOINTS, 0)
            self.desk.add_joints(sample)
            if self.desk.jumps > jumps:  # what an earlier clock stamped cannot be compared any more
                self.temperatures = MotorTemperatures(self.nominal.joint_names)
                self.cycle.begun_ns, self.cycle.postponed_ns = sample.stamp_ns, 0
                with suppress(RobocalError):  # said by `accuracy`
                    if self.follower is not None:
                        self.follower.clock_jumped(left_ns, sample.stamp_ns)
        elif isinstance(sample, TemperatureSample):
            self.temperatures.add(sample)
            self.desk.newest_ns[TEMPERATURES] = self.temperatures.newest_ns or 0
        else:
            self.desk.add_measurement(sample)

    def take_plain(self, block: JointBlock, start: int) -> int:
        """As `SessionBase.take_plain`."""
        return self.desk.take_plain(block, start, self._joints_awaited_ns())

    def _stamp_ns(self, clock_ns: int | None) -> int:
        """The clock where it is on the samples' (within a second after their newest), else that."""
        newest = self.desk.clock_ns
        near = clock_ns is not None and newest <= clock_ns <= newest + SAME_CLOCK_NS
        return clock_ns if near and clock_ns is not None else newest

    def advance(self, *, wall_ns: int, force: bool = False) -> list[Outcome]:
        """Carry out the commands whose samples are complete.

        ``wall_ns`` enters the history's records only; ``force`` carries out all with what is
        there (no more samples will come, or a caller's deadline has passed).
        """
        outcomes: list[Outcome] = []
        while done := self.step(wall_ns=wall_ns, force=force):
            outcomes += done
        return outcomes

    def _wanted(self, command: Command) -> Mapping[str, int]:
        if command.marks is not None:
            return command.marks
        marks = {JUMPS: self.desk.jumps}
        if command.name in events.MEASURED:
            marks[JOINTS] = (command.stamp_ns or 0) + int(self.config.lateness_s * 1e9)
        return marks

    def _completed(self, command: Command) -> Command:
        """The command with a cycle's name, the marks of its samples, the stamp of their first."""
        arguments, begins = dict(command.arguments), command.name == events.BEGIN_CYCLE
        if (begins or command.name in events.CYCLE) and not arguments.get("cycle_id"):
            by_time = str(np.datetime64((command.stamp_ns or 0) // 1_000_000, "ms"))
            arguments["cycle_id"] = by_time if begins else self.cycle.id or by_time
        chosen = "from_ns" in arguments or command.marks is not None  # by the caller, or recorded
        if command.name in events.MEASURED and not chosen:
            arguments["from_ns"] = from_ns = self.windows.from_ns(command)
            if command.name == events.CAPTURE_REFERENCE:
                arguments[LEFT_OUT] = self.windows.left_out(from_ns)
        return super()._completed(replace(command, arguments=arguments))

    def _handlers(self) -> Mapping[str, Handler]:
        return {
            events.CALIBRATE_SENSOR: self._calibrate_sensor,
            events.CAPTURE_REFERENCE: self._capture_reference,
            events.IDENTIFY: self._identify,
            events.BEGIN_CYCLE: self._begin_cycle,
            events.END_CYCLE: self._end_cycle,
        }

    def _calibrate_sensor(self, command: Command, wall_ns: int) -> Outcome:
        """Place the sensor; the samples stay, for the cold reference."""
        data, _ = self.windows.of(command)
        return self._proposer.place_sensor(command, data, self.desk.frame or "", wall_ns)

    def _capture_reference(self, command: Command, wall_ns: int) -> Outcome:
        data, fixed = self.windows.of(command)
        beside = self._beside(command, data, fixed)
        frame = self.desk.frame or ""
        try:
            outcome = self._proposer.capture(command, data, beside, frame, wall_ns)
        except TooFewSamplesError as error:
            raise TooFewSamplesError(f"{error}{command.arguments.get(LEFT_OUT, '')}") from error
        self._close_cycle(command)
        return outcome

    def _identify(self, command: Command, wall_ns: int) -> Outcome:
        method = self._proposer.method(command)
        data, fixed = self.windows.of(command)
        beside = self._beside(command, data, fixed)
        outcome = self._proposer.identify(command, data, beside, method, self.follower, wall_ns)
        self._close_cycle(command)
        return outcome

    def _beside(self, command: Command, data: Measurements, fixed: Array) -> Beside:
        """With the motor temperatures up to the middle of what was measured."""
        middle_ns = data.middle_ns
        until_ns = min(middle_ns, (command.marks or {}).get(TEMPERATURES, -1))
        after_ns = 0 if self.follower is None else self.follower.read_ns
        readings = self.temperatures.between(after_ns, until_ns)
        if self.config.arrangement == FLANGE:  # all spheres are fixed, and targets
            fixed = fixed[:0]
        motors = self.temperatures
        now, silent = motors.at(middle_ns, until_ns), motors.silent(middle_ns, until_ns)
        return Beside(fixed, readings, now, silent)

    def _close_cycle(self, command: Command) -> None:
        self.cycle.id = ""
        self.desk.use(command.stamp_ns or 0)

    def _ended(self, cycle_id: str) -> Entry | None:
        """The calibration that a cycle of this id gave, the latest of them; None without."""
        entries = self._history.list(REMEMBERED)
        return next((e for e in entries if e.kind == THERMAL and e.cycle_id == cycle_id), None)

    def _begin_cycle(self, command: Command, wall_ns: int) -> Outcome:
        """Open a cycle; one that is open already goes on, another one is broken off."""
        if self.reference is None:
            raise ConflictError(NO_REFERENCE)
        cycle, cycle_id = self.cycle, str(command.arguments["cycle_id"])
        if cycle.id == cycle_id:
            message = f"cycle '{cycle_id}' is open already"
            return Outcome(command, Code.ACCEPT, message, repeated=True)
        if self._ended(cycle_id) is not None:
            raise ConflictError(
                f"cycle '{cycle_id}' has ended already: give each cycle an id of its own"
            )
        broken = f"; cycle '{cycle.id}' is broken off" if cycle.id else ""
        cycle.id, cycle.begun_ns = cycle_id, command.stamp_ns or 0
        self.desk.use(cycle.begun_ns)
        return Outcome(command, Code.ACCEPT, f"cycle '{cycle_id}' is open{broken}")

    def _end_cycle(self, command: Command, wall_ns: int) -> Outcome:
        """As `_end`; where the history fails the cycle stays open, and its time begins anew."""
        try:
            return self._end(command, wall_ns)
        except StorageError:
            self.cycle.postponed_ns = self.desk.newest_ns.get(JOINTS, 0)
            raise

    def _end(self, command: Command, wall_ns: int) -> Outcome:
        """Identify from the cycle; when that fails it stays open, unless its time has run out."""
        cycle_id = str(command.arguments["cycle_id"])
        if self.cycle.id != cycle_id:
            if (before := self._ended(cycle_id)) is not None:
                message = f"cycle '{cycle_id}' has ended already: {before.reason}"
                return Outcome(command, before.code, message, None, before.id, repeated=True)
            if self.cycle.id:
                raise ConflictError(f"cycle '{self.cycle.id}' is open, not '{cycle_id}'")
        if self.reference is None:
            raise ConflictError(NO_REFERENCE)
        try:
            return self._identify(command, wall_ns)
        except Exception as error:
            if command.arguments.get("by") == TIME_OUT and not isinstance(error, StorageError):
                self._close_cycle(command)
            raise

    def overdue(self) -> Command | None:
        """The command that ends a cycle whose time has run out; None while there is none."""
        idle = not self._queue and self.reference is not None
        return self.windows.overdue() if idle else None

    def accuracy(self, stamp_ns: int) -> Accuracy:
        """How far the tool may be off at a stamp with the model in force.

        The tracker is told the motors' temperatures until then, and forgets them again.
        """
        if self.fault:
            return Accuracy(AccuracyLevel.FAULT, self.fault)
        try:
            follower = self.follower
            if follower is None:
                words = "no cold reference: how far the robot has drifted is not known; capture one"
                return Accuracy(AccuracyLevel.EXPIRED, words)
            with follower.looking_ahead(self.temperatures.between, stamp_ns):
                return self._judged(follower, stamp_ns)
        except RobocalError as error:
            return Accuracy(AccuracyLevel.FAULT, str(error))

    def unread_motors(self, stamp_ns: int) -> str:
        """Which motors' temperatures the drift is followed by and do not come, in words."""
        follower = self.follower
        return "" if follower is None else follower.unread(self.temperatures.silent(stamp_ns))

    def require_unmoved(self) -> None:
        """Raise `ConflictError` where the last cycle found that something was moved."""
        if self.follower is not None and self.follower.state.moved:
            raise ConflictError(self.follower.state.moved)

    def placing_sigma_m(self, placed: Sequence[PlacedShot]) -> Array:
        """One sigma (m,), m, the norm over all axes, of the first point of shots in base.

        Of the drift that the model in force misses at that posture and point, as the tracker
        expects it at the stamp; of the arm and the mounting, as the spheres tell it that the cold
        reference saw; and of a measurement. A common move of the base is in none of them.

        Raises `ConflictError` where something was moved since.
        """
        self.require_unmoved()
        follower, reference = self.follower, self.reference
        if follower is None or reference is None or not placed:
            return np.zeros(0)
        static_m = reference.static_error_m
        last_ns = max(one.shot.stamp_ns for one in placed)
        found = []
        with follower.looking_ahead(self.temperatures.between, last_ns):
            for one in placed:
                tip = frames.apply(frames.invert(one.T_base_flange), one.points[:1])[0]
                forecast = follower.forecast_at(self.current.arm, one.q, tip)
                found.append(forecast.at(follower.time_s(one.shot.stamp_ns)).rms_m)
        return np.hypot(found, static_m)

    def _judged(self, follower: DriftFollower, stamp_ns: int) -> Accuracy:
        config, time_s = self.config, follower.time_s(stamp_ns)
        forecast = follower.forecast(self.current.arm)
        error = forecast.at(time_s)
        age_s = time_s - follower.state.tracker.time_s
        left_s = config.expires_after_s - age_s
        due_in_s = min(forecast.due_in_s(time_s, config.tolerance_m), left_s) - DUE_AHEAD_S
        words = f"95 % of tool errors below {error.bound_m * 1e3:.2f} mm"
        words += f", of {config.tolerance_m * 1e3:.2f} mm allowed"
        level = AccuracyLevel.OK
        if follower.state.moved:
            level, words = AccuracyLevel.FAULT, follower.state.moved
        elif left_s <= 0.0:
            words = f"last measured {age_s / 3600.0:.1f} h ago: measure a cycle"
            level = AccuracyLevel.EXPIRED
        elif stamp_ns < follower.state.anchor_ns:
            words = "the clock is before the last cycle, whose age is not known: measure a cycle"
            level = AccuracyLevel.EXPIRED
        elif error.bound_m > config.tolerance_m:
            level, words = AccuracyLevel.DEGRADED, f"{words}: measure a cycle, accept its model"
        elif due_in_s <= 0.0:
            level, words = AccuracyLevel.DUE, f"{words}: measure a cycle"
        words = "; ".join(filter(None, (words, self.unread_motors(stamp_ns))))
        return Accuracy(level, words, error, due_in_s)


def take_message(session: ThermalSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason.

    ``kind`` is the input that the message belongs to; other kinds are left alone.
    """
    config = session.config
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in (MEASURED_POINT, SPHERE_CENTER, REFERENCE_SPHERE):
            session.add(point_sample(message, config.target, kind))
        elif kind == SPHERE_CLOUD:
            session.add(cloud_sample(message, config.sphere, config.target))
        elif kind == TEMPERATURES:
            session.add(temperature_sample(message))
        elif kind == MEASURED_POSE:
            session.add(pose_sample(message, config.target))
    except RobocalError as error:
        session.refuse(kind, error)


def session_as_recorded(
    nominal: SerialArm, history: CalibrationHistory, configured: Command, software: str
) -> ThermalSession:
    """Make a session with the recorded settings; an empty history gets what was in force."""
    arguments = recorded_arguments(nominal, configured, ("model", "reference", OWN["thermal"]))
    in_force = {THERMAL: arguments["model"], REFERENCE: arguments["reference"]}
    tracker = arguments[OWN["thermal"]]
    config = config_of(arguments)
    state = None if tracker is None else FollowerState.of_document(tracker)
    fresh = seeded(history, nominal, in_force, software)
    session = ThermalSession(nominal, history, config, software)
    if fresh and state is not None and session.follower is not None:
        session.follower.go_on_from(state)
    return session


def configuration(session: ThermalSession, topics: Mapping[str, str] | None = None) -> Command:
    """The session's settings and what is in force, so that replay can start from the same.

    Recorded at the start and after each change of what is in force: a recording that begins
    later has it too. ``topics``: name of each input's topic.
    """
    in_force = {
        "model": session.in_force.model,
        "reference": session.current.reference_model,
        OWN["thermal"]: None if session.follower is None else session.follower.state.document(),
    }
    return configured_with(session, topics or {}, asdict(session.config), in_force)


def config_of(arguments: Mapping[str, Any]) -> ThermalConfig:
    """Read the settings back from a configuration record.

    Raises `InputError` when the record has other settings than this version knows.
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

    Raises `InputError` when nothing was observed.
    """
    if not observations:
        raise InputError("no measurement at standstill in this recording")

    def near(a: Observation, b: Observation) -> bool:
        return bool(np.max(np.abs(a.q - b.q)) < SAME_VISIT_RAD)

    def same(a: list[Observation], b: list[Observation]) -> bool:
        targets = {one.sample.target for one in a} & {one.sample.target for one in b}
        return near(a[0], b[0]) and bool(targets)

    visits: list[list[Observation]] = []  # of a pose, however much was measured there
    for one in observations:
        if visits and near(visits[-1][0], one):
            visits[-1].append(one)
        else:
            visits.append([one])
    limit = min(len(visits), LARGEST_CYCLE + 1)
    length = next((i for i in range(1, limit) if same(visits[0], visits[i])), None)
    known, later = visits[:length], visits[length or len(visits) :]
    recurring = sum(any(same(visit, k) for k in known) for visit in later)
    if length is None or recurring < 0.9 * len(later):
        stamps = [one.sample.stamp_ns for one in observations]
        return window_commands(None, [(stamps[0], stamps[-1])])
    starts = [i for i, visit in enumerate(visits) if same(visits[0], visit)]
    ends = [*(i - 1 for i in starts[1:]), len(visits) - 1]
    windows = [
        (visits[start][0].sample.stamp_ns, visits[end][-1].sample.stamp_ns)
        for start, end in zip(starts, ends, strict=True)
    ]
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
