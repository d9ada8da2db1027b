# SPDX-License-Identifier: Apache-2.0
"""The hand-eye session: samples and commands in, the sensor's place out. No clock, no ROS."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from robocal_ros.ground import frames
from robocal_ros.ground.errors import (
    Code,
    ConflictError,
    InputError,
    LimitError,
    RankDeficientError,
    ResidualError,
    RobocalError,
    TooFewSamplesError,
)
from robocal_ros.ground.frames import Array, Document
from robocal_ros.ground.samples import (
    CLOCK_JUMP_NS,
    JOINTS,
    JointSample,
    NotStillError,
    StandstillRule,
    joint_sample,
)
from robocal_ros.hand_eye.data import (
    COMPRESSED,
    FEATURES,
    IMAGE,
    MOST_CAPTURES,
    MOST_HANDLE,
    MOUNTS,
    POINT,
    SCAN,
    SHOTS,
    TO_HAND,
    TOPIC_OF,
    TRACKER,
    TRACKER_POINT,
    WITHOUT_FILE,
    Capture,
    DataSet,
    HandEyeSample,
    PoseModels,
    Shot,
    ShotLog,
    board_of,
    data_set_begun,
    data_set_of,
    seen_corners,
    shot_of,
)
from robocal_ros.hand_eye.profiles import DEFAULT, SensorDescription
from robocal_ros.hand_eye.result import (
    METHODS,
    HandEyeResult,
    HandEyeSettings,
    Method,
    hand_eye_document,
)
from robocal_ros.hand_eye.targets import ARCS, FACES, ROLES, SPHERE, target_of
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import THERMAL, Proposal, hand_eye_kind
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.joint_errors import ShotJoints
from robocal_ros.session import events
from robocal_ros.session.events import (
    OWN,
    Command,
    Handler,
    HistoryFollower,
    Outcome,
    SessionBase,
    configured_with,
    recorded_arguments,
    seeded,
)

if TYPE_CHECKING:
    from robocal_ros.hand_eye.tasks import HandEyeData

Samples = Sequence[HandEyeSample]


@dataclass(frozen=True)
class HandEyeConfig:
    """Settings of a hand-eye session; plain values, so that a recording carries them.

    ``base_frame``, ``flange_frame``, ``sensor_frame``: names of the frames. ``standstill``: when
    the robot counts as standing still about a measurement. ``capture_timeout_s``: a capture without
    standstill or without a measurement for so long fails. ``robot_sigma_m``, ``robot_sigma_rad``:
    error of a reported flange pose along and about each axis, one sigma; None: found from the
    samples, but the second of a line laser as `HandEyeSettings`. ``limit_m``: largest expected
    error at the working distance that is accepted. ``sensor``: how a line laser tells its profiles.
    ``tracker_frame``: of the points of a laser tracker; ``tracker_sigma_m``: of a coordinate of
    one; ``joint_sigma_rad``, ``joint_sigma_m``: of a joint that moves between its visits.
    ``joint_error_rad``: see `HandEyeSettings`.
    """

    base_frame: str = "base"
    flange_frame: str = "tool0"
    sensor_frame: str = "sensor"
    standstill: StandstillRule = field(default_factory=StandstillRule)
    capture_timeout_s: float = 10.0
    robot_sigma_m: float | None = None
    robot_sigma_rad: float | None = None
    limit_m: float = HandEyeSettings.limit_m
    sensor: SensorDescription = DEFAULT
    tracker_frame: str = "tracker"
    tracker_sigma_m: float = 1.5e-5
    joint_sigma_rad: float = float(np.radians(0.0029))
    joint_sigma_m: float = 2e-5
    joint_error_rad: float = 0.0

    @classmethod
    def of_document(cls, document: Mapping[str, Any]) -> "HandEyeConfig":
        """Read plain values (`asdict`), also after JSON.

        Raises `InputError` when it has other settings than this version knows.
        """
        try:
            values = dict(document)
            sensor = SensorDescription.of_document(values.pop("sensor", {}))
            if "z_grows" in values:  # alone, before there were descriptions
                sensor = replace(sensor, z_grows=values.pop("z_grows"))
            rule = StandstillRule(**values.pop("standstill"))
            return cls(standstill=rule, sensor=sensor, **values)
        except (KeyError, TypeError) as error:
            raise InputError(f"the recorded configuration cannot be read: {error}") from error


def require_known(data: DataSet, method: str) -> None:
    """Refuse a target, a method or a mount that no estimator answers for.

    Raises `InputError`, naming those that there are.
    """
    for what, value, known in (
        ("target", data.kind, tuple(TOPIC_OF)),
        ("feature", data.feature, FEATURES),
        ("method", method, METHODS),
        ("mount", data.mount, MOUNTS),
    ):
        if value not in known:
            raise InputError(f"{what} '{value}' is none of {', '.join(known)}")
    if target_of(data.target) is None and data.kind not in WITHOUT_FILE:
        raise InputError(f"nothing is known of the {data.kind}: name the file that describes it")
    if data.mount == TO_HAND and data.kind != "camera":
        raise InputError(
            f"a {data.kind} is seen by a sensor on the flange: one that stands still is calibrated "
            "with the target camera"
        )


def solved(
    data: DataSet, samples: Samples, nominal: SerialArm, method: str, config: HandEyeConfig
) -> HandEyeResult:
    """Where the sensor sits; the flange poses of the samples are by their thermal models.

    The estimators are loaded when they are first used: a node's start does not need them.

    Raises `RobocalError` when the samples cannot answer.
    """
    require_known(data, method)
    if not samples:
        raise TooFewSamplesError("nothing was captured yet: capture the target from several poses")
    if data.kind == POINT:
        raise InputError("marked points judge a sensor's place, they find none: call verify")
    if data.kind == TRACKER:
        return _solved_tracker(data, samples, nominal, cast(Method, method), config)
    if data.kind == "camera":
        return _solved_camera(data, samples, nominal, cast(Method, method), config)
    from robocal_ros.hand_eye.solve import solve_task
    from robocal_ros.hand_eye.stairs import task_of

    settings = HandEyeSettings(
        config.robot_sigma_m,
        config.robot_sigma_rad,
        config.limit_m,
        joint_error_rad=config.joint_error_rad,
    )
    target: Any = target_of(data.target)
    task = task_of(target, data.feature, method == "classic", config.sensor.towards)
    return solve_task(task, laser_shots(samples, nominal), cast(Method, method), settings)


def laser_shots(samples: Samples, nominal: SerialArm) -> "HandEyeData":
    """Profiles by their handles, with the poses and joints that they were taken from."""
    from robocal_ros.hand_eye.tasks import HandEyeData

    marks = tuple(sample.mark for sample in samples)
    return HandEyeData(
        tuple(str(sample.handle) for sample in samples),
        sample_poses(samples, nominal),
        [sample.profile for sample in samples],
        marks if any(marks) else None,
        shot_joints(samples, nominal),
    )


def sample_poses(samples: Samples, nominal: SerialArm) -> Array:
    """T_base_flange (k, 4, 4), m, each by the thermal model that was in force at its sample."""
    q = np.array([sample.q for sample in samples]).reshape(-1, nominal.n)
    found = np.zeros((len(q), 4, 4))
    for model in dict.fromkeys(sample.thermal for sample in samples):
        rows = [i for i, sample in enumerate(samples) if sample.thermal is model]
        found[rows] = model.arm(nominal).fk(q[rows])
    return found


def shot_joints(samples: Samples, nominal: SerialArm) -> ShotJoints:
    """The samples' joints; what these err by is the arm's, whatever warmed it in between."""
    return ShotJoints(samples[0].thermal.arm(nominal), np.array([sample.q for sample in samples]))


def _solved_tracker(
    data: DataSet, samples: Samples, nominal: SerialArm, method: Method, config: HandEyeConfig
) -> HandEyeResult:
    """From the points of a laser tracker and a scan; rejected ones are named by their handles."""
    from robocal_ros.hand_eye.tracker import solve_tracker
    from robocal_ros.hand_eye.tracker_data import Arc, TrackerData, TrackerNoise

    of = {mark: [one for one in samples if one.mark == mark] for mark in (*ROLES, SCAN)}
    if missing := [mark for mark, own in of.items() if not own]:
        raise TooFewSamplesError(f"nothing was captured with mark {', '.join(missing)}")
    model = samples[0].thermal
    if any(one.thermal.revision != model.revision for one in samples):
        raise InputError(
            "another thermal model came into force between the captures: what the tracker saw of "
            "one robot does not fit the other's joints; start again"
        )

    def points(mark: str) -> Array:
        return np.concatenate([one.values for one in of[mark]])

    def readings(mark: str) -> Array:
        return np.array([one.q for one in of[mark]])

    first, second = (Arc(mark, readings(mark), points(mark)) for mark in ARCS)
    measured = TrackerData(
        arm=model.arm(nominal),
        arcs=(first, second),
        sphere=points(SPHERE),
        faces=(points(FACES[0]), points(FACES[1])),
        q=readings(SCAN),
        profiles=[one.profile for one in of[SCAN]],
    )
    noise = TrackerNoise(config.tracker_sigma_m, config.joint_sigma_rad, config.joint_sigma_m)
    target: Any = target_of(data.target)
    result = solve_tracker(
        measured, target, noise, method, config.limit_m, config.joint_error_rad,
        config.sensor.towards,
    )  # fmt: skip
    handles = {f"{m} {i}": str(one.handle) for m in ROLES for i, one in enumerate(of[m], 1)}
    rejected = {handles.get(name, name): why for name, why in result.rejected.items()}
    return replace(result, rejected=rejected)


def _solved_camera(
    data: DataSet, samples: Samples, nominal: SerialArm, method: Method, config: HandEyeConfig
) -> HandEyeResult:
    """From the corners of a board in images, or from poses of the target."""
    from robocal_ros.hand_eye.boards import board_pairs, boards_of_corners, intrinsics_document
    from robocal_ros.hand_eye.camera import CameraSettings, calibrate_camera
    from robocal_ros.hand_eye.camera_data import PosePairs
    from robocal_ros.hand_eye.camera_fit import GivenNoise

    names = tuple(str(sample.handle) for sample in samples)
    T_base_flange = sample_poses(samples, nominal)
    noise = GivenNoise(config.robot_sigma_m, config.robot_sigma_rad)
    settings = CameraSettings(method, noise, config.limit_m, config.joint_error_rad)
    joints = shot_joints(samples, nominal)
    if data.topic != IMAGE:
        seen = np.concatenate([sample.values for sample in samples])
        T_camera_board = frames.transform_from_quat(seen[:, :3], seen[:, 3:])
        pairs = PosePairs(T_base_flange, T_camera_board, names, data.mount, joints=joints)
        return calibrate_camera(pairs, settings)
    target = board_of(data.target)
    corners = [sample.values[1:] for sample in samples]
    width, height = samples[0].values[0, :2]
    size = int(width), int(height)
    boards = boards_of_corners(names, corners, target.board, size, target.intrinsics)
    return calibrate_camera(
        board_pairs(boards, target.board, names, T_base_flange, data.mount, joints),
        settings,
        rejected=boards.rejected,
        more={"intrinsics": intrinsics_document(boards, target.intrinsics is None)},
    )


class HandEyeSession(SessionBase):
    """Calibrates one sensor of one robot.

    ``capture`` answers at once; that the robot stood still and what the sensor saw then becomes a
    command of its own, so that a recording holds which shot each sample was made of.

    ``data``: the open data set; None without.
    """

    def __init__(
        self, nominal: SerialArm, history: CalibrationHistory, config: HandEyeConfig, software: str
    ) -> None:
        self.config = config
        self.current = HistoryFollower(history, hand_eye_kind(config.sensor_frame), nominal)
        super().__init__(self.current)
        self._software = software
        self._shots = ShotLog()
        self._handle = 0
        self._why: RobocalError | None = None  # why the latest shot was of no use
        self._seen_ns = 0  # shots before it were looked at
        self._leap_ns = 0  # longest step of the joints' stamps since the capture
        self._found: Command | None = None
        self._models = PoseModels(self.current.thermal)
        self.data: DataSet | None = None

    def add(self, sample: JointSample | Shot) -> None:
        """Take a sample. Raises `InputError` when it cannot be used; the message says why."""
        if isinstance(sample, Shot):
            if sample.stamp_ns <= 0:
                raise InputError(f"{sample.topic} has no time stamp")
            by_tracker = sample.topic == TRACKER_POINT
            frame = self.config.tracker_frame if by_tracker else self.config.sensor_frame
            self._shots.add(sample, frame, self.newest_joints_ns)
            self._took(sample)
        else:
            before_ns = self.newest_joints_ns or sample.stamp_ns
            if self._take_joints(sample):
                self._shots.clear()
                words = "the clock jumped back: capture again"
                self._found = self.broken_off(Code.CONFLICT, words)
            self._leap_ns = max(self._leap_ns, self.newest_joints_ns - before_ns)
            for shot in self._shots.come(self.newest_joints_ns):
                self._took(shot)
        self._look()

    def _took(self, shot: Shot) -> None:
        waiting = self._waits_for(shot.topic)
        if waiting is not None and shot.stamp_ns < waiting.from_ns:
            early_s = (waiting.from_ns - shot.stamp_ns) * 1e-9
            words = f"{shot.topic} is stamped {early_s:.3f} s before the call"
            self._why = InputError(f"{words}: is the sensor's clock behind?")
        self.received[shot.topic] += 1
        newest = self.newest_ns.get(shot.topic, 0)
        self.newest_ns[shot.topic] = max(shot.stamp_ns, newest)

    def _waits_for(self, topic: str) -> Capture | None:
        """The capture that waits, if for this input."""
        waiting = None if self.data is None else self.data.waiting
        if self.data is None or waiting is None or self.data.topic_of(waiting.mark) != topic:
            return None
        return waiting

    def _watches_joints(self) -> bool:
        captures = self.data is not None and self.data.waiting is not None and self._found is None
        return captures or bool(self._shots.ahead)

    def refuse(self, kind: str, error: RobocalError) -> None:
        """Count a message that cannot be used; a capture that waits for it tells why."""
        super().refuse(kind, error)
        if self._waits_for(kind) is not None:
            self._why = error

    def _look(self) -> None:
        """Find the first shot at standstill for the capture that waits."""
        capture = None if self.data is None else self.data.waiting
        if self.data is None or capture is None or self._found is not None:
            return
        topic = self.data.topic_of(capture.mark)
        for shot in self._shots.since(topic, max(capture.from_ns, self._seen_ns)):
            try:
                if self.stream.standstill(shot.stamp_ns, self.config.standstill) is None:
                    break
                shot.read()  # which keeps its pixels: of a whole move they would take gigabytes
            except NotStillError as error:
                self._why, self._seen_ns = error, shot.stamp_ns + 1
                continue
            except RobocalError as error:
                self.refuse(shot.topic, error)
                self._seen_ns = shot.stamp_ns + 1
                continue
            arguments = {"handle": capture.handle, "shot_ns": shot.stamp_ns}
            self._found = Command(events.SAMPLE, arguments, self.newest_joints_ns)
            return
        self._found = self._timed_out(capture, topic)

    def _timed_out(self, capture: Capture, topic: str) -> Command | None:
        limit_s = self.config.capture_timeout_s
        waited_ns, limit_ns = self.newest_joints_ns - capture.from_ns, limit_s * 1e9
        if waited_ns <= limit_ns:
            return None
        if waited_ns - self._leap_ns <= limit_ns and self._leap_ns > CLOCK_JUMP_NS:
            leap_s = self._leap_ns * 1e-9
            words = f"the joint states' clock jumped by {leap_s:.1f} s, or they paused for so long"
            return self.broken_off(Code.CONFLICT, f"{words}: capture again")
        words = f"no {topic} with the robot at standstill within {limit_s:g} s"
        hint = "does the sensor publish it, is it triggered?"
        code = Code.TOO_FEW_SAMPLES if self._why is None else self._why.code
        return self.broken_off(code, f"{words}: {self._why or hint}")

    def silent(self, seconds: float) -> Command | None:
        """The command by which a capture fails when no usable joint reading comes any more."""
        if seconds <= self.config.capture_timeout_s:
            return None
        told = self.ignored.words() or "check the robot's driver"
        words = f"joint states are silent for {seconds:.1f} s: {told}"
        return self.broken_off(Code.TOO_FEW_SAMPLES, words)

    def broken_off(self, code: Code, reason: str) -> Command | None:
        """The command by which the capture that waits fails; None when none waits."""
        capture = None if self.data is None else self.data.waiting
        if capture is None:
            return None
        arguments = {"handle": capture.handle, "code": int(code), "reason": reason}
        return Command(events.BREAK_OFF, arguments, self.newest_joints_ns)

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
            raise ConflictError("no data set is open: call start, or load one")
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
        if self._handle >= MOST_HANDLE:
            raise LimitError(f"handle {self._handle} was the last: begin a new session")
        mark = str(command.arguments.get("mark", ""))
        data.require_mark(mark)
        handle = int(command.arguments.get("handle", self._handle + 1))
        # The earliest stamp of a shot that is newer than all that was received. No clock of ours is
        # asked: those of robot and sensor need not be set to it. Who gives a command for a call
        # gives the messages first that came before it.
        topic = data.topic_of(mark)
        after_ns = self.newest_ns.get(topic, -1) + 1
        from_ns = int(command.arguments.get("from_ns", max(self.newest_joints_ns, after_ns)))
        self._handle, self._why, self._seen_ns, self._leap_ns = handle, None, 0, 0
        words = f"waits for {topic} with the robot at standstill"
        data.captures[handle] = Capture(handle, mark, from_ns, words)
        bound = {"handle": handle, "from_ns": from_ns}
        command = replace(command, arguments={**command.arguments, **bound})
        return Outcome(command, Code.ACCEPT, f"capture {handle} {words}")

    def _sample(self, command: Command, wall_ns: int) -> Outcome:
        data, at_ns = self._require_set(), int(command.arguments["shot_ns"])
        capture = self._require_waiting(data, command)
        shot = self._shots.at(data.topic_of(capture.mark), at_ns)
        mean = self.stream.resting(at_ns, self.config.standstill)
        if mean is None:
            raise InputError(f"the joint readings about {at_ns} ns are not complete")
        handle, mark = capture.handle, capture.mark
        thermal, command = self._models.of(command, self.current.thermal)
        try:
            values = seen_corners(data.target, shot) if data.topic == IMAGE else shot.read()
            words = data.put(HandEyeSample(handle, mark, at_ns, mean, values, thermal))
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
        """Solve for the samples that the command names, and propose the result."""
        data, arguments = self._require_set(), command.arguments
        data.candidate = 0
        samples = data.chosen([int(handle) for handle in arguments.get("handles", ())])
        method = str(arguments.get("method") or data.method)
        try:
            result = solved(data, samples, self.nominal, method, self.config)
        except RankDeficientError as error:
            told = {"unobservable": list(error.directions)}
            return Outcome(command, error.code, str(error), told, samples=len(samples))
        except np.linalg.LinAlgError as error:
            raise ResidualError(f"no pose of the sensor explains the samples: {error}") from error
        document = hand_eye_document(result)
        proposal = self._proposal(data, samples, result, document, command, wall_ns)
        data.candidate = self._history.propose(proposal)
        verdict = result.verdict
        used = len({name.partition("/")[0] for name in result.samples})  # a step names corners
        return Outcome(
            command, verdict.code, verdict.reason, document, data.candidate, samples=used
        )

    def _proposal(
        self,
        data: DataSet,
        samples: Samples,
        result: HandEyeResult,
        document: Document,
        command: Command,
        wall_ns: int,
    ) -> Proposal:
        config, left_out = self.config, result.leave_one_out_m
        left_out_mm = None if left_out is None else float(np.sqrt(np.mean(left_out**2))) * 1e3
        model = {  # what comes into force: in full precision, with the names of its frames
            "parent": config.base_frame if result.parent == "base" else config.flange_frame,
            "child": config.sensor_frame,
            "T_parent_sensor": result.T_flange_sensor.tolist(),
            "covariance": None if result.covariance is None else result.covariance.tolist(),
            "thermal_revisions": sorted({sample.thermal.revision for sample in samples}),
        }
        inputs = {
            "handle": np.array([sample.handle for sample in samples]),
            "mark": np.array([sample.mark for sample in samples]),
            "stamp_ns": np.array([sample.stamp_ns for sample in samples], dtype=np.int64),
            "q": np.array([sample.q for sample in samples]),
            "T_base_flange": sample_poses(samples, self.nominal),
            "count": np.array([len(sample.values) for sample in samples]),
        }
        topics = [data.topic_of(sample.mark) for sample in samples]
        for topic in dict.fromkeys(topics):
            own = [one.values for one, of in zip(samples, topics, strict=True) if of == topic]
            inputs[topic] = np.concatenate(own)
        return Proposal(
            kind=self._kind,
            model_hash=self.nominal.model_hash,
            based_on=self._history.head(self._kind).revision,
            cycle_id="",
            stamp_ns=command.stamp_ns or 0,
            created_ns=wall_ns,
            software=self._software,
            method=f"{result.kind}, {result.method}",
            code=result.verdict.code,
            reason=result.verdict.reason,
            candidate_rms_mm=left_out_mm,
            document=document,
            model=model,
            inputs=inputs,
        )

    def document(self) -> dict[str, Any]:
        """The open data set for a file, with the models that its flange poses come from.

        Raises `ConflictError` when nothing was captured.
        """
        if self.data is None or not self.data.samples:
            raise ConflictError("nothing was captured yet: there is nothing to save")
        return self.data.document()

    def _load(self, command: Command, wall_ns: int) -> Outcome:
        arguments = command.arguments
        data = data_set_of(arguments["set"], self.current.arm)
        for name in ("sensor_frame", "tracker_frame"):
            mine = getattr(self.config, name)
            if (told := arguments["set"].get(name, mine)) != mine:
                raise InputError(
                    f"the data set is referred to {name} '{told}', this node's is '{mine}': load "
                    f"it where {name} is '{told}'"
                )
        require_known(data, data.method)
        self.data = data
        self._handle = max(self._handle, *data.samples, 0)
        count = len(data.samples)
        words = f"{count} samples of a {data.kind} loaded from {arguments.get('path', 'a file')}"
        taken = sorted({sample.thermal.revision for sample in data.samples.values()})
        if taken != [self.current.thermal.revision]:
            told = ", ".join(map(str, taken))
            words += f"; their flange poses are those of thermal revision {told}"
        return Outcome(command, Code.ACCEPT, words, samples=count)


def take_hand_eye_message(session: HandEyeSession, kind: str, message: Any) -> None:
    """Give a message to the session; one that cannot be used is counted with its reason."""
    kind = IMAGE if kind == COMPRESSED else kind
    try:
        if kind == JOINTS:
            session.add(joint_sample(message))
        elif kind in SHOTS:
            session.add(shot_of(kind, message, session.config.sensor))
    except RobocalError as error:
        session.refuse(kind, error)


def configuration(session: HandEyeSession, topics: Mapping[str, str]) -> Command:
    """Settings and what is in force, so that a replay can start from the same.

    ``topics``: name of each input's topic.
    """
    current = session.current
    in_force = {"model": current.thermal.model, OWN["hand_eye"]: current.head.model}
    return configured_with(session, topics, asdict(session.config), in_force)


def hand_eye_session_as_recorded(
    nominal: SerialArm, history: CalibrationHistory, configured: Command, software: str
) -> HandEyeSession:
    """Make a session with the recorded settings; an empty history gets what was in force."""
    arguments = recorded_arguments(nominal, configured, ("model", OWN["hand_eye"]))
    config = HandEyeConfig.of_document(arguments["config"])
    in_force = {
        THERMAL: arguments["model"],
        hand_eye_kind(config.sensor_frame): arguments[OWN["hand_eye"]],
    }
    seeded(history, nominal, in_force, software)
    return HandEyeSession(nominal, history, config, software)
