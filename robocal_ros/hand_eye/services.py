# SPDX-License-Identifier: Apache-2.0
"""The services of the hand-eye node: each call becomes a command to the session."""

import os
import re
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np
from geometry_msgs.msg import TransformStamped
from robocal_msgs.msg import CalibrationQuality, HandEyeSample, HandEyeStatus
from robocal_msgs.srv import (
    CalibrateHandEye,
    CaptureHandEye,
    CheckHandEyePlan,
    HandEyeFile,
    RemoveHandEye,
    StartHandEye,
    VerifyHandEye,
)
from sensor_msgs.msg import CameraInfo
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, ConflictError, InputError, RobocalError
from robocal_ros.ground.files import made_folder_beside
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import joint_sample
from robocal_ros.hand_eye.boards import Intrinsics, pixels_apart, told_intrinsics
from robocal_ros.hand_eye.data import (
    IN_HAND,
    MOST_POINTS,
    POINT,
    TO_HAND,
    TOPIC_OF,
    WITHOUT_FILE,
    DataSet,
    data_set_begun,
    data_set_of,
)
from robocal_ros.hand_eye.session import HandEyeSession, sample_poses, solved
from robocal_ros.hand_eye.targets import (
    CAMERA_INFO,
    KIND_OF,
    BoardTarget,
    read_target,
    target_document,
    target_of,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_file import unused
from robocal_ros.history.history_records import Head, hand_eye_kind
from robocal_ros.ros import conversions, endpoints
from robocal_ros.ros.base import HouseNode
from robocal_ros.ros.conversions import StaticTf, pose_message, transform_message
from robocal_ros.ros.endpoints import EndpointNode, trigger_text
from robocal_ros.ros.parameters import given_pose
from robocal_ros.ros.session_node import AddOutput, Ask, SessionEvents, answer, twin
from robocal_ros.session.events import CALIBRATE, CAPTURE, LOAD, REMOVE, START, Command, Outcome

if TYPE_CHECKING:
    from robocal_ros.hand_eye.files import SensorMount

KEPT, SUFFIX = "hand_eye", ".mcap"
RUNS, LONGEST_RUNS_S = 5, 3.0  # of a calibration whose time is taken
MOST_VERIFIED = 5  # calibrations in a call: so long the node does nothing else
MOST_APART_PX = 1.0  # two calibrations of one camera agree to some tenths where boards were
ROUGH = "rough"  # the parameters that say about where the sensor sits

TARGETS = dict(enumerate(TOPIC_OF, 1))  # by the constants of HandEyeStatus
MOUNTS = {HandEyeStatus.ON_FLANGE: IN_HAND, HandEyeStatus.FIXED: TO_HAND}
NUMBER_OF = {name: number for number, name in TARGETS.items()}
MOUNT_NUMBER_OF = {name: number for number, name in MOUNTS.items()}


class HandEyeOutputs:
    """Publishers of one sensor's results.

    ``add``: creates a publisher. ``robot``, ``serial``: as messages carry them.

    ``transforms``: all that were put onto tf.
    ``missing``: what cannot be published on this machine; empty when everything can.
    """

    def __init__(self, add: AddOutput, robot: str, serial: str) -> None:
        self._robot, self._serial = robot, serial
        self._status = add(HandEyeStatus, "~/status", endpoints.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", endpoints.LATCHED)
        self.events = SessionEvents(add)
        self.transforms: list[TransformStamped] = []
        self._tf = StaticTf(add)
        self.missing = self._tf.missing

    def status(self, session: HandEyeSession, last: Outcome | None, *, ended: bool = False) -> None:
        """Say how far the data set is, and what came of the last command.

        ``ended``: the session is over; its captures are told once more, as they ended.
        """
        data, config = session.data, session.config
        fixed = data is not None and data.mount == TO_HAND
        message = HandEyeStatus(
            header=conversions.header(
                session.newest_joints_ns, config.base_frame if fixed else config.flange_frame
            ),
            child_frame_id=config.sensor_frame,
            state=HandEyeStatus.IDLE,
            revision=session.in_force.revision,
        )
        if data is not None:
            if not ended:
                waits = data.waiting is not None
                message.state = HandEyeStatus.CAPTURING if waits else HandEyeStatus.COLLECTING
            message.target, message.method = NUMBER_OF[data.kind], data.method
            message.mount, message.candidate_id = MOUNT_NUMBER_OF[data.mount], data.candidate
            states = {Code.NONE: HandEyeSample.WAITING, Code.ACCEPT: HandEyeSample.CAPTURED}
            message.samples = [
                HandEyeSample(
                    handle=one.handle,
                    mark=one.mark,
                    state=states.get(one.code, HandEyeSample.FAILED),
                    reason=one.reason,
                    status=int(one.code),
                    stamp=conversions.time_message(one.stamp_ns),
                )
                for _, one in sorted(data.captures.items())
            ]
        if last is not None:
            message.last_command, message.last_message = last.command.name, last.message
            message.last_status = int(last.status)
        self._status.publish(message)

    def transform(self, head: Head, stamp_ns: int) -> None:
        """Put what is in force onto tf; nothing in force: late subscribers get no transform."""
        transforms = []
        if (model := head.model) is not None:
            placed = conversions.transform_message(np.array(model["T_parent_sensor"]))
            header = conversions.header(stamp_ns, model["parent"])
            transforms = [
                TransformStamped(header=header, child_frame_id=model["child"], transform=placed)
            ]
        self.transforms += transforms
        self._tf.publish(transforms)

    def quality(self, outcome: Outcome, frame: str) -> None:
        """Show the verdict on a calibration, or why there is none."""
        stamp = conversions.header(outcome.command.stamp_ns or 0, frame)
        message = conversions.verdict_message(
            outcome, robot=self._robot, serial=self._serial, stamp=stamp
        )
        document = outcome.document or {}
        message.unobservable = list(document.get("unobservable", ()))
        message.rejected = list(document.get("rejected", ()))
        if (error_mm := document.get("working_error_mm")) is not None:
            message.predicted_rms_mm = float(error_mm)
        if (left_out := document.get("leave_one_out_mm")) is not None:
            message.held_out = outcome.samples
            errors = {f"{name}_mm": value for name, value in left_out.items()}
            conversions.set_errors(message, "candidate", errors)
        self._quality.publish(message)


class HandEyeFiles:
    """``~/load``, ``~/save`` and its Trigger twin; the data set of each calibration is kept.

    ``ask``: gives a command to the session and awaits its outcome. ``session``: the one that runs;
    raises while the node is inactive. ``history``: beside its file data sets are kept.
    """

    def __init__(
        self,
        node: EndpointNode,
        ask: Ask,
        session: Callable[[], HandEyeSession],
        history: CalibrationHistory,
    ) -> None:
        self._node, self.ask, self.session, self.history = node, ask, session, history
        self._saved: tuple[DataSet | None, frozenset[int]] = None, frozenset()
        self._fault: tuple[int, str] = 0, ""  # of the last calibration
        node.add_service(HandEyeFile, "~/load", self._load)
        node.add_service(HandEyeFile, "~/save", self._save)
        node.add_service(Trigger, "~/save_trigger", self._save_twin)

    async def begin(self, command: Command) -> Outcome:
        """Give a command that opens a data set; the answer tells of what was dropped unsaved."""
        before = self.session().data
        outcome = await self.ask(command)
        if not outcome.done or not (lost := self._unsaved(before)):
            return outcome
        words = f"{outcome.message}; {lost} samples were dropped that were not saved"
        return replace(outcome, message=words)

    async def calibrate(self, command: Command) -> Outcome:
        """Give a command that calibrates; the answer tells when its data set could not be kept."""
        outcome = await self.ask(command)
        number, fault = self._fault
        if not fault or number != outcome.calibration_id:
            return outcome
        return replace(outcome, message=f"{outcome.message}; {fault}")

    def keep(self, outcome: Outcome) -> None:
        """Keep the data set of a calibration under its id; one that cannot be kept is told of."""
        number = outcome.calibration_id
        self._fault = number, ""
        if not number:
            return
        try:
            self._write(unused(self._folder(), str(number), SUFFIX))
        except RobocalError as error:
            self._fault = number, f"its samples were not kept, call save: {error}"
            self._node.get_logger().error(f"calibration {number}: {self._fault[1]}")

    def _folder(self) -> Path:
        return made_folder_beside(self.history.path, KEPT)

    def solved_again_s(self, number: int) -> float:
        """Processor time, s, of a calibration from its kept samples; -1 where they are not there.

        The first run loads the estimator and does not count; the mean is of five at most.
        """
        from robocal_ros.bags.bags import read_data_set

        session, inputs = self.session(), self.history.inputs(number)
        own = re.compile(rf"{number}(_\d+)?{re.escape(SUFFIX)}")  # as `unused` names them
        kept = [path for path in self._folder().iterdir() if own.fullmatch(path.name)]
        method = self.history.get(number).method.rpartition(", ")[2]
        try:
            newest = max(kept, key=lambda path: path.stat().st_mtime)
            data = data_set_of(read_data_set(newest, session.nominal), session.nominal)
            samples = data.chosen(inputs["handle"].tolist())
            if [one.stamp_ns for one in samples] != inputs["stamp_ns"].tolist():
                return -1.0
            runs = list[float]()
            while len(runs) <= RUNS and sum(runs) < LONGEST_RUNS_S:
                begun = time.thread_time()
                solved(data, samples, session.nominal, method, session.config)
                runs.append(time.thread_time() - begun)
        except (RobocalError, OSError, ValueError):
            return -1.0
        return sum(runs[1:] or runs) / len(runs[1:] or runs)

    def _path(self, named: str) -> Path:
        """The whole path of what a caller names, who does not see the node's folders."""
        if not named:
            raise InputError("path is empty: name the file")
        try:
            given = Path(named).expanduser()
        except RuntimeError as error:
            raise InputError(f"{error}: name the whole path", file=named) from error
        whole = given if given.is_absolute() else self._folder() / given
        return Path(os.path.normpath(whole))  # links in it are its owner's

    def _unsaved(self, data: DataSet | None) -> int:
        of, handles = self._saved
        samples = () if data is None else data.samples
        return len(set(samples) - (handles if data is of else set()))

    def _mark_saved(self) -> None:
        data = self.session().data
        self._saved = data, frozenset(() if data is None else data.samples)

    async def _load(self, request: Any, response: Any) -> Any:
        from robocal_ros.bags.bags import read_data_set

        path = self._path(request.path)
        document = read_data_set(path, self.session().nominal)
        outcome = await self.begin(Command(LOAD, {"path": str(path), "set": document}))
        if outcome.done:
            self._mark_saved()
        response.samples = outcome.samples
        return answer(response, outcome)

    def _save(self, request: Any, response: Any) -> Any:
        path, folder = self._path(request.path), self._folder()
        if not path.is_relative_to(folder):
            raise InputError(
                f"data sets are written below {folder} alone: name the file without a folder",
                file=request.path,
            )
        response.samples, response.message = self._write(path)
        response.success, response.status = True, int(Code.ACCEPT)
        return response

    def _save_twin(self, request: Any, response: Any) -> Any:
        """Into the folder of the data sets, called after sensor and time (UTC)."""
        frame = quote(self.session().config.sensor_frame, safe="")
        stem = f"{frame}_{time.strftime('%Y%m%dT%H%M%SZ', time.gmtime())}"
        _, words = self._write(unused(self._folder(), stem, SUFFIX))
        response.success, response.message = True, trigger_text(0, Code.ACCEPT, words)
        return response

    def _write(self, path: Path) -> tuple[int, str]:
        """Write the open data set; how many samples it has, and what to say."""
        from robocal_ros.bags.bags import write_data_set

        session = self.session()
        document, config = session.document(), session.config
        topic = data_set_begun(document).topic
        write_data_set(
            path, document, topic, config.sensor_frame, session.nominal, config.tracker_frame
        )
        self._mark_saved()
        rows = document["samples"]
        words = f"{len(rows)} samples saved in {path}"
        points = sum(len(row["values"]) for row in rows)
        if points > MOST_POINTS:
            words += f"; {points} points are too many to load (at most {MOST_POINTS})"
        return len(rows), words


class CameraTopic:
    """What ``camera_info`` tells, beside the intrinsics of the open data set.

    A session knows them from the command that begins a set: a replay does not need the topic.
    """

    def __init__(self, node: EndpointNode, sensor_frame: str) -> None:
        self._message: Any = None
        self._frame = sensor_frame  # of every image that is taken
        node.add_input(CameraInfo, CAMERA_INFO, self._take, endpoints.SENSOR)

    def _take(self, message: Any) -> None:
        self._message = message

    def _told(self, target: BoardTarget) -> Intrinsics:
        if self._message is None:
            raise InputError(
                "no camera_info has come yet, and the target file takes the intrinsics from it: "
                "does the camera publish it, in this namespace?"
            )
        if other := self.other_frame():
            raise InputError(other)
        return told_intrinsics(self._message, target.rectified)

    def other_frame(self) -> str:
        """Say that the topic is of another camera than the images; empty where it is of theirs."""
        told = self._frame if self._message is None else self._message.header.frame_id
        if told == self._frame:
            return ""
        return (
            f"camera_info in frame '{told}', the images' frame is '{self._frame}': it is another "
            "camera's, or the driver names one of both wrongly; remap camera_info"
        )

    def given(self, document: Mapping[str, Any]) -> Mapping[str, Any]:
        """A target's document with the camera of the topic, where its file takes that.

        Raises `InputError` when nothing has come, or it tells no camera that is known.
        """
        target = target_of(document)
        if not isinstance(target, BoardTarget) or not target.camera_info:
            return document
        return target_document("camera", target.with_intrinsics(self._told(target)))

    def apart(self, document: Mapping[str, Any], taken: bool) -> str:
        """Say that the camera is not what a data set takes it for; empty where it is.

        ``taken``: of one that has its intrinsics from the topic; else from a file.
        """
        target = target_of(document) if "columns" in document else None
        if not isinstance(target, BoardTarget) or target.intrinsics is None:
            return ""
        if self._message is None or bool(target.camera_info) != taken:
            return ""
        try:
            apart_px = pixels_apart(target.intrinsics, self._told(target))
        except InputError as error:
            return str(error) if taken else ""  # a camera that is not calibrated tells no other one
        if apart_px <= (0.0 if taken else MOST_APART_PX):
            return ""
        how = f"by up to {apart_px:.1f} px" if np.isfinite(apart_px) else "in the size of images"
        return f"camera_info differs from the intrinsics of the data set {how}"


class HandEyeServices:
    """Data set, captures, calibration, with their Trigger twins.

    ``files``: asks where data sets begin or are calibrated. ``camera``: what it tells of itself.
    """

    def __init__(self, node: HouseNode, files: HandEyeFiles, camera: CameraTopic) -> None:
        self._node, self._settings, self._files, self._camera = node, node.settings, files, camera
        self._ask, self._session, self._history = files.ask, files.session, files.history
        add = node.add_service
        add(StartHandEye, "~/start", self._start)
        add(Trigger, "~/start_trigger", self._start_twin)
        add(CaptureHandEye, "~/capture", self._capture)
        add(Trigger, "~/capture_trigger", self._capture_twin)
        add(Trigger, "~/result_trigger", self._result_twin)
        add(RemoveHandEye, "~/remove", self._remove)
        add(Trigger, "~/remove_trigger", twin(files.ask, REMOVE, {"handle": 0}))
        add(CalibrateHandEye, "~/calibrate", self._calibrate)
        add(Trigger, "~/calibrate_trigger", twin(files.calibrate, CALIBRATE, {}))
        add(CheckHandEyePlan, "~/check_plan", self._check_plan)
        add(VerifyHandEye, "~/verify", self._verify)

    async def _start(self, request: Any, response: Any) -> Any:
        given = {
            "target": _named(TARGETS, request.target),
            "feature": request.feature,
            "method": request.method,
            "mount": _named(MOUNTS, request.mount),
        }
        arguments = self._begun(given, request.target_file)
        return answer(response, await self._files.begin(Command(START, arguments)))

    def _begun(self, given: Mapping[str, str], file: str = "") -> dict[str, Any]:
        """Arguments of the command that begins a data set; what is empty comes from the settings.

        The configured file counts for the target that it describes, and for no other.
        """
        names = ("target", "feature", "method", "mount")
        told = {name: given.get(name) or self._settings[name] for name in names}
        kind, configured = told["target"], self._settings["target_file"]
        if file:
            target = target_document(kind, read_target(Path(file)))
        else:
            target, found = {"kind": kind}, ""
            if configured and kind in KIND_OF.values():
                described = read_target(Path(configured))
                found = KIND_OF[type(described)]
                if found == kind:
                    target = target_document(kind, described)
            if found != kind and kind not in WITHOUT_FILE:
                words = f"'{configured}' describes a {found}" if found else "is empty"
                raise InputError(f"target_file {words}: name the file that describes the {kind}")
        return told | {"target": self._camera.given(target)}

    async def _start_twin(self, request: Any, response: Any) -> Any:
        return await twin(self._files.begin, START, self._begun({}))(request, response)

    async def _capture_now(self, arguments: Mapping[str, Any]) -> Outcome:
        """A capture takes nothing that was received before its call."""
        self._node.take_waiting()
        data = self._session().data
        fault = "" if data is None else self._camera.apart(data.target, taken=True)
        if fault:
            raise InputError(f"{fault}: was it set anew? Start a new data set")
        return await self._ask(Command(CAPTURE, arguments))

    async def _capture(self, request: Any, response: Any) -> Any:
        outcome = await self._capture_now({"mark": request.mark})
        response.handle = _handle(outcome)
        return answer(response, outcome)

    async def _capture_twin(self, request: Any, response: Any) -> Any:
        outcome = await self._capture_now({})
        response.success = outcome.done
        response.message = trigger_text(_handle(outcome), outcome.status, outcome.message)
        return response

    def _result_twin(self, request: Any, response: Any) -> Any:
        """How the newest capture ended; while it waits: no success, with NONE."""
        data = self._session().data
        if data is None or not data.captures:
            response.message = trigger_text(0, Code.CONFLICT, "nothing was captured yet")
            return response
        last = data.captures[max(data.captures)]
        response.success = last.code is Code.ACCEPT
        response.message = trigger_text(last.handle, last.code, last.reason)
        return response

    async def _remove(self, request: Any, response: Any) -> Any:
        if request.handle == 0:
            raise InputError("remove needs the handle of a capture; look at the status")
        outcome = await self._ask(Command(REMOVE, {"handle": request.handle}))
        response.samples = outcome.samples
        return answer(response, outcome)

    async def _calibrate(self, request: Any, response: Any) -> Any:
        arguments = {"method": request.method, "handles": list(request.handles)}
        outcome = await self._files.calibrate(Command(CALIBRATE, arguments))
        document = outcome.document or {}
        response.candidate_id, response.samples = outcome.calibration_id, outcome.samples
        response.expected_error_mm = response.residual_mm = -1.0
        response.unobservable = list(document.get("unobservable", ()))
        if outcome.calibration_id:
            model = self._history.model(outcome.calibration_id)
            response.sensor = transform_message(np.array(model["T_parent_sensor"]))
            if document["covariance"] is not None:
                response.covariance = np.ravel(document["covariance"]).tolist()
            if document["working_error_mm"] is not None:
                response.expected_error_mm = float(document["working_error_mm"])
            response.residual_mm = float(document["residual_mm"]["rms"])
            because = document["rejected_because"]
            response.rejected = [f"{name}: {why}" for name, why in because.items()]
        return answer(response, outcome)

    def _check_plan(self, request: Any, response: Any) -> Any:
        from robocal_ros.hand_eye import planning  # here: a node's start does not need it

        session, settings = self._session(), self._settings
        if (data := session.data) is None:
            raise ConflictError("no data set is open: call start, so that the target is known")
        planning.laser_target(data)  # refuses others before it asks for more
        arm, joints = session.current.arm, [joint_sample(one) for one in request.joints]
        poses = planning.planned_poses(arm, joints, [_parts(pose) for pose in request.flange])
        described = session.config.sensor
        told = *settings["sensor_range_mm"], settings["sensor_noise_mm"]
        sensor = described.seen_range(*told)
        given = [planning.pose_of(*_parts(pose), "sensor") for pose in request.sensor]
        mount, who = planning.rough_mount(
            session, self._history, next(iter(given), None), given_pose(settings, ROUGH)
        )
        if request.center:
            centre: Array | None = planning.require_near(_point(request.center[0]), "center")
        else:
            centre = planning.sphere_centre(data, self._history, arm, mount, described)
        found = planning.judged_plan(
            data, poses, list(request.marks), mount, sensor, session.config, centre
        )
        response.success, response.status = found.verdict.accept, int(found.verdict.code)
        response.message = f"{found.verdict.reason} (the sensor's place is that of {who})"
        response.rank, response.unknowns = found.rank, found.unknowns
        error_m = found.working_error_m
        response.expected_error_mm = -1.0 if error_m is None else error_m * 1e3
        response.unobservable = list(found.unobservable)
        response.unseen = [f"pose {i + 1}: {why}" for i, why in sorted(found.unseen.items())]
        response.proposed = [pose_message(T) for T in found.proposed]
        return response

    def _verify(self, request: Any, response: Any) -> Any:
        """The touch test of what is in force, or of candidates side by side."""
        from robocal_ros.estimation.edge import EdgeRule
        from robocal_ros.hand_eye.touch_test import compared, scanned_points, touch_test

        session, limit_m = self._session(), self._session().config.limit_m
        data, numbers = session.data, list(request.candidates)
        if data is None or data.kind != POINT:
            raise ConflictError(
                f"no marked points are open: call start with target {NUMBER_OF[POINT]}, and "
                "capture each point from several poses"
            )
        if not numbers:
            if (number := session.in_force.calibration_id) is None:
                raise ConflictError("no calibration is in force: name candidates")
            numbers = [number]
        numbers = list(dict.fromkeys(numbers))
        if len(numbers) > MOST_VERIFIED:
            raise InputError(
                f"{len(numbers)} candidates, each of which is solved again: at most {MOST_VERIFIED}"
            )
        # Places (3,) in base, m, by name.
        names, places = list(request.points), [np.array(_point(p)) for p in request.touched]
        if len(names) != len(places) or len(set(names)) < len(names):
            raise InputError(
                f"points {names} and {len(places)} touched places: give one for each name"
            )
        if not all(np.all(np.isfinite(place)) for place in places):
            raise InputError("touched places must be finite, m")
        touched = dict(zip(names, places, strict=True))
        samples = data.chosen([])
        scanned, rejected = scanned_points(
            [one.mark for one in samples],
            [one.profile for one in samples],
            sample_poses(samples, session.nominal),
            EdgeRule(session.config.sensor.towards, kind=data.feature),
        )
        found = {}
        for number in numbers:
            test = touch_test(self._mount(number), scanned, touched, limit_m)
            found[f"calibration {number}"] = test
            accuracy, stability_m = test.accuracy, test.stability_m
            response.judged.append(number)
            response.samples.append(len(self._history.inputs(number)["handle"]))
            response.solve_s.append(self._files.solved_again_s(number))
            response.off_mean_mm.append(-1.0 if accuracy is None else accuracy.mean_m * 1e3)
            response.off_max_mm.append(-1.0 if accuracy is None else accuracy.max_m * 1e3)
            response.three_sigma_mm.append(-1.0 if stability_m is None else stability_m * 1e3)
            response.statuses.append(int(test.verdict.code))
        verdict = compared(found)
        response.success, response.status = verdict.accept, int(verdict.code)
        lost = "".join(f"; capture {name} shows no point: {why}" for name, why in rejected.items())
        response.message = f"{verdict.reason}{lost}"
        return response

    def _mount(self, number: int) -> "SensorMount":
        from robocal_ros.hand_eye.files import SensorMount
        from robocal_ros.hand_eye.linearity import SensorLinearity

        kind, config = self._history.get(number).kind, self._session().config
        if kind != hand_eye_kind(config.sensor_frame):
            raise InputError(f"calibration {number} is of {kind}, not of '{config.sensor_frame}'")
        model = self._history.model(number)
        if model["parent"] != config.flange_frame:
            raise InputError(f"calibration {number} is of a sensor that stands beside the robot")
        own = self._history.document(number).get("linearity")
        linearity = None if own is None else SensorLinearity.of_document(own)
        return SensorMount("flange", np.array(model["T_parent_sensor"]), linearity)


def _parts(pose: Any) -> tuple[list[float], list[float]]:
    o = pose.orientation
    return _point(pose.position), [o.x, o.y, o.z, o.w]


def _point(point: Any) -> list[float]:
    return [point.x, point.y, point.z]


def _handle(outcome: Outcome) -> int:
    return int(outcome.command.arguments["handle"]) if outcome.done else 0


def _named(names: Mapping[int, str], number: int) -> str:
    """The name of a constant of HandEyeStatus; empty for 0."""
    if number and number not in names:
        known = ", ".join(f"{n} ({name})" for n, name in names.items())
        raise InputError(f"{number} is none of {known}")
    return names.get(number, "")
