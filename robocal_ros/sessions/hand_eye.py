"""The hand-eye session: joints, what the sensor sees, and commands in; the sensor's place out.

No clock, no ROS.
"""

from collections.abc import Mapping
from dataclasses import replace

from robocal_ros.core.codes import Code
from robocal_ros.core.errors import (
    ConflictError,
    InputError,
    LimitError,
    RobocalError,
)
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.proposals import hand_eye_kind
from robocal_ros.core.samples import JointSample
from robocal_ros.core.streams import NotStillError
from robocal_ros.sessions import events
from robocal_ros.sessions.commanded import Commanded, Handler
from robocal_ros.sessions.events import Command, Outcome
from robocal_ros.sessions.hand_eye_config import HandEyeConfig
from robocal_ros.sessions.hand_eye_data import (
    Capture,
    DataSet,
    HandEyeSample,
    data_set_begun,
    data_set_of,
)
from robocal_ros.sessions.hand_eye_images import seen_corners
from robocal_ros.sessions.hand_eye_in_force import HandEyeInForce
from robocal_ros.sessions.hand_eye_results import HandEyeResults
from robocal_ros.sessions.hand_eye_shots import IMAGE, Shot, ShotLog
from robocal_ros.sessions.hand_eye_solving import require_known
from robocal_ros.sessions.history import History
from robocal_ros.sessions.observations import JOINTS

MOST_CAPTURES = 500
_NO_SET = "no data set is open: call start, or load one"


class HandEyeSession(Commanded):
    """Calibrates one sensor of one robot.

    ``capture`` answers at once; that the robot stood still and what the sensor saw then becomes a
    command of its own, so that a recording holds which shot each sample was made of.

    Attributes
    ----------
    data : the open data set; None without.
    """

    def __init__(
        self, nominal: SerialArm, history: History, config: HandEyeConfig, software: str
    ) -> None:
        self.config = config
        self.current = HandEyeInForce(history, nominal, config.sensor_frame)
        super().__init__(nominal, history, hand_eye_kind(config.sensor_frame), self.current)
        self._results = HandEyeResults(nominal, history, config, software, self.current)
        self._shots = ShotLog()
        self._handle = 0
        self._why: RobocalError | None = None  # why the latest shot was of no use
        self._seen_ns = 0  # shots before it were looked at
        self._found: Command | None = None
        self.data: DataSet | None = None

    # ---- samples --------------------------------------------------------------------------------

    def add(self, sample: JointSample | Shot) -> None:
        """Take a sample.

        Raises
        ------
        InputError
            When it cannot be used; the message says why.
        """
        if isinstance(sample, Shot):
            if sample.stamp_ns <= 0:
                raise InputError(f"{sample.topic} has no time stamp")
            self._shots.add(sample, self.config.sensor_frame, self.newest_joints_ns)
            self.received[sample.topic] += 1
            newest = self.newest_ns.get(sample.topic, 0)
            self.newest_ns[sample.topic] = max(sample.stamp_ns, newest)
        elif self._take_joints(sample):
            self._shots.clear()
            self._found = self._broken_off(Code.CONFLICT, "the clock jumped back: capture again")
        self._look()

    def refuse(self, kind: str, error: RobocalError) -> None:
        """Count a message that cannot be used; a capture that waits for it tells why."""
        self.ignored.add(kind, str(error))
        if self.data is not None and kind == self.data.topic:
            self._why = error

    def _look(self) -> None:
        """Find the first shot at standstill for the capture that waits."""
        capture = None if self.data is None else self.data.waiting
        if self.data is None or capture is None or self._found is not None:
            return
        for shot in self._shots.since(self.data.topic, max(capture.from_ns, self._seen_ns)):
            try:
                reading = self.stream.standstill(shot.stamp_ns, self.config.standstill)
            except NotStillError as error:
                self._why, self._seen_ns = error, shot.stamp_ns + 1
                continue
            if reading is None:
                break
            arguments = {"handle": capture.handle, "shot_ns": shot.stamp_ns}
            self._found = Command(events.SAMPLE, arguments, self.newest_joints_ns)
            return
        limit_s = self.config.capture_timeout_s
        if self.newest_joints_ns - capture.from_ns > limit_s * 1e9:
            words = f"no {self.data.topic} with the robot at standstill within {limit_s:g} s"
            hint = "does the sensor publish it, is it triggered?"
            code = Code.TOO_FEW_SAMPLES if self._why is None else self._why.code
            self._found = self._broken_off(code, f"{words}: {self._why or hint}")

    def silent(self, seconds: float) -> Command | None:
        """The command by which a capture fails when no usable joint reading comes any more."""
        if seconds <= self.config.capture_timeout_s:
            return None
        told = self.ignored.words() or "check the robot's driver"
        words = f"joint states are silent for {seconds:.1f} s: {told}"
        return self._broken_off(Code.TOO_FEW_SAMPLES, words)

    def _broken_off(self, code: Code, reason: str) -> Command | None:
        capture = None if self.data is None else self.data.waiting
        if capture is None:
            return None
        arguments = {"handle": capture.handle, "code": int(code), "reason": reason}
        return Command(events.BREAK_OFF, arguments, self.newest_joints_ns)

    # ---- commands -------------------------------------------------------------------------------

    def recognised(self) -> Command | None:
        """The command that follows from the samples: a capture is complete, or has failed."""
        found, self._found = self._found, None
        return found

    def _handlers(self) -> Mapping[str, Handler]:
        return {
            events.START: self._start,
            events.CAPTURE: self._capture,
            events.SAMPLE: self._sample,
            events.BREAK_OFF: self._break_off,
            events.REMOVE: self._remove,
            events.CALIBRATE: self._calibrate,
            events.LOAD: self._load,
        }

    def _require_set(self) -> DataSet:
        if self.data is None:
            raise ConflictError(_NO_SET)
        return self.data

    def _start(self, command: Command, wall_ns: int) -> Outcome:
        data = data_set_begun(command.arguments)
        require_known(data, data.method)
        self.data = data
        return Outcome(command, Code.ACCEPT, f"data set of a {data.kind} ({data.method}) begun")

    def _capture(self, command: Command, wall_ns: int) -> Outcome:
        data = self._require_set()
        if (waits := data.waiting) is not None:
            raise ConflictError(f"capture {waits.handle} still waits: {waits.reason}")
        if not self.newest_joints_ns:
            told = self.ignored.words() or f"does the robot's driver publish {JOINTS}?"
            raise ConflictError(f"no joint states yet: {told}")
        if len(data.captures) >= MOST_CAPTURES:
            raise LimitError(f"{MOST_CAPTURES} captures: remove some, or start a new data set")
        mark = str(command.arguments.get("mark", ""))
        data.require_mark(mark)
        handle = int(command.arguments.get("handle", self._handle + 1))
        self._handle, self._why, self._seen_ns = handle, None, 0
        words = f"waits for {data.topic} with the robot at standstill"
        data.captures[handle] = Capture(handle, mark, command.stamp_ns or 0, words)
        command = replace(command, arguments={**command.arguments, "handle": handle})
        return Outcome(command, Code.ACCEPT, f"capture {handle} {words}")

    def _sample(self, command: Command, wall_ns: int) -> Outcome:
        data, at_ns = self._require_set(), int(command.arguments["shot_ns"])
        capture = self._require_waiting(data, command)
        shot, rule = self._shots.at(data.topic, at_ns), self.config.standstill
        reading = self.stream.standstill(at_ns, rule)
        if reading is None:
            raise InputError(f"the joint readings about {at_ns} ns are not complete")
        _, q = self.stream.window(at_ns - int(rule.before_s * 1e9), reading.ready_ns)
        mean = q.mean(axis=0)
        T_base_flange = self.current.arm.fk(mean)
        handle, mark = capture.handle, capture.mark
        try:
            values = seen_corners(data.target, shot) if data.topic == IMAGE else shot.values
            words = data.put(HandEyeSample(handle, mark, at_ns, mean, T_base_flange, values))
        except InputError as error:
            capture.code, capture.reason = error.code, str(error)
            return Outcome(command, error.code, f"capture {handle}: {error}")
        return Outcome(command, Code.ACCEPT, f"capture {handle}: {words}", samples=1)

    def _break_off(self, command: Command, wall_ns: int) -> Outcome:
        capture = self._require_waiting(self._require_set(), command)
        arguments = command.arguments
        capture.code, capture.reason = Code(int(arguments["code"])), str(arguments["reason"])
        return Outcome(command, capture.code, f"capture {capture.handle}: {capture.reason}")

    def _require_waiting(self, data: DataSet, command: Command) -> Capture:
        handle, capture = int(command.arguments["handle"]), data.waiting
        if capture is None or capture.handle != handle:
            raise ConflictError(f"capture {handle} does not wait")
        return capture

    def _remove(self, command: Command, wall_ns: int) -> Outcome:
        """Drop a capture; handle 0: the newest."""
        data = self._require_set()
        handle = int(command.arguments["handle"]) or max(data.captures, default=0)
        if handle not in data.captures:
            there = ", ".join(map(str, data.captures)) or "none"
            raise InputError(f"no capture {handle}; there are {there}")
        del data.captures[handle]
        data.samples.pop(handle, None)
        command = replace(command, arguments={**command.arguments, "handle": handle})
        words = f"capture {handle} removed, {len(data.samples)} samples are left"
        return Outcome(command, Code.ACCEPT, words, samples=len(data.samples))

    def _calibrate(self, command: Command, wall_ns: int) -> Outcome:
        data = self._require_set()
        outcome = self._results.calibrate(data, command, wall_ns)
        data.candidate = outcome.calibration_id
        return outcome

    def _load(self, command: Command, wall_ns: int) -> Outcome:
        arguments = command.arguments
        data = data_set_of(arguments["set"], self.current.arm)
        require_known(data, data.method)
        self.data = data
        self._handle = max(self._handle, *data.samples, 0)
        count = len(data.samples)
        words = f"{count} samples of a {data.kind} loaded from {arguments.get('path', 'a file')}"
        return Outcome(command, Code.ACCEPT, words, samples=count)
