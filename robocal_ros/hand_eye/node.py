# SPDX-License-Identifier: Apache-2.0
"""The hand-eye node: joints and what a sensor sees in, the sensor's place out.

docs/hand_eye_node.md.
"""

import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped, PoseStamped
from sensor_msgs.msg import CompressedImage, Image, JointState, PointCloud2

from robocal_ros import __version__
from robocal_ros.ground.errors import Code, InputError, RobocalError
from robocal_ros.ground.samples import JOINTS, Silence
from robocal_ros.hand_eye.data import (
    COMPRESSED,
    FEATURES,
    IMAGE,
    MOUNTS,
    PROFILE,
    TARGET_POSE,
    TOPIC_OF,
    TRACKER_POINT,
)
from robocal_ros.hand_eye.profiles import PRESETS, Z_GROWS, sensor_of
from robocal_ros.hand_eye.result import METHODS
from robocal_ros.hand_eye.services import (
    CameraTopic,
    HandEyeFiles,
    HandEyeOutputs,
    HandEyeServices,
)
from robocal_ros.hand_eye.session import (
    HandEyeConfig,
    HandEyeSession,
    configuration,
    take_hand_eye_message,
)
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Head, hand_eye_kind
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import run
from robocal_ros.ros.endpoints import ERROR, WARN, Health, NotActiveError
from robocal_ros.ros.graph import FrameWatch
from robocal_ros.ros.parameters import (
    ROBOT_SETTINGS,
    STANDSTILL,
    Setting,
    advanced,
    number,
    pose_settings,
    standstill_rule,
)
from robocal_ros.ros.session_node import (
    JOINT_ERROR,
    STATE_DIR,
    DecisionServices,
    SessionNode,
)
from robocal_ros.session.events import ACCEPT, CALIBRATE, Command, Outcome, named

WATCH_S = 0.1
INPUTS = {
    JOINTS: (JointState, endpoints.STREAM),
    PROFILE: (PointCloud2, endpoints.SENSOR),
    TARGET_POSE: (PoseStamped, endpoints.SENSOR),
    IMAGE: (Image, endpoints.SENSOR),
    COMPRESSED: (CompressedImage, endpoints.SENSOR),
    TRACKER_POINT: (PointStamped, endpoints.SENSOR),
}


def _range_fault(values: list[float]) -> str | None:
    if len(values) != 3:
        return "three lengths are wanted"
    return None if values[0] != values[1] and values[2] > 0.0 else "the field has no extent"


SETTINGS = (
    *ROBOT_SETTINGS,
    STATE_DIR,
    Setting("sensor_frame", "sensor", "Name of the sensor's frame, in its messages and on tf"),
    Setting("target", "sphere", "Target where a call names none", choices=tuple(TOPIC_OF)),
    Setting("target_file", "", "File where a call names none; for the target that it describes"),
    Setting("feature", FEATURES[0], "What a line is in a profile", choices=FEATURES),
    Setting(
        "sensor",
        "",
        f"How a line laser tells its profiles: {', '.join(PRESETS)}, or a file that describes it",
    ),
    Setting(
        "z_grows",
        "",
        "z of a line laser: away from the sensor, a distance, or towards it, a height; empty: as "
        "sensor has it, away without one",
        choices=("", *Z_GROWS),
    ),
    Setting("method", METHODS[0], "Estimator where a call names none", choices=METHODS),
    Setting("mount", MOUNTS[0], "Where the sensor is, where a call does not say", choices=MOUNTS),
    number(
        "robot_sigma_mm", 0.0, "Error of a reported pose in each axis; 0: from the data", 0.0, 10.0
    ),
    Setting(
        "robot_sigma_deg",
        0.0,
        "And of its turn about each axis; 0: robot_sigma_mm over 3 m, of a camera from the data",
        unit="deg",
        low=0.0,
        high=1.0,
    ),
    number(
        "limit_mm",
        1e3 * HandEyeConfig.limit_m,
        "Largest expected error at the working distance",
        1e-3,
        100.0,
    ),
    JOINT_ERROR,
    Setting("tracker_frame", "tracker", "Name of a laser tracker's frame, in its messages"),
    number(
        "tracker_sigma_mm",
        0.015,
        "Noise of a coordinate of a tracker's point, at the distance of the robot",
        1e-4,
        10.0,
    ),
    number(
        "joint_sigma_mm",
        0.02,
        "Error of a sliding joint that moves between the tracker's points",
        0.0,
        10.0,
    ),
    Setting(
        "joint_sigma_deg",
        0.0029,
        "And of a turning one",
        unit="deg",
        low=0.0,
        high=1.0,
    ),
    *pose_settings(
        "rough",
        "About where the sensor sits on the flange, for check_plan before any calibration",
        "Its orientation: x along the laser line, z along the beam",
    ),
    Setting(
        "sensor_range_mm",
        [190.0, 210.0, 60.0],
        "z of the near and the far end of the sensor's field, and its width; for check_plan, where "
        "sensor does not tell them",
        unit="mm",
        low=-20000.0,
        high=20000.0,
        check=_range_fault,
    ),
    number(
        "sensor_noise_mm",
        0.037,
        "Noise of a point along the beam; for check_plan, the same",
        1e-4,
        10.0,
    ),
    *advanced(
        *STANDSTILL,
        Setting(
            "capture_timeout_s",
            10.0,
            "A capture without standstill or without a measurement for so long fails",
            unit="s",
            low=0.5,
            high=600.0,
        ),
    ),
)


def session_config(settings: Mapping[str, Any]) -> HandEyeConfig:
    """Settings of the session, in SI.

    Raises `InputError` when the sensor's frame has no name of its own, the error of a turn is
    given alone, or the sensor is described by no preset or file.
    """
    names = settings["base_frame"], settings["flange_frame"], settings["sensor_frame"]
    if not all(names) or len(set(names)) < len(names):
        told = ", ".join(f"'{name}'" for name in names)
        raise InputError(f"base, flange and sensor need frames of different names, not {told}")
    if settings["robot_sigma_deg"] and not settings["robot_sigma_mm"]:
        turn_deg = settings["robot_sigma_deg"]
        raise InputError(f"robot_sigma_deg is {turn_deg:g}, but robot_sigma_mm is 0: give both")
    return HandEyeConfig(
        base_frame=settings["base_frame"],
        flange_frame=settings["flange_frame"],
        sensor_frame=settings["sensor_frame"],
        standstill=standstill_rule(settings),
        capture_timeout_s=settings["capture_timeout_s"],
        robot_sigma_m=settings["robot_sigma_mm"] * 1e-3 or None,
        robot_sigma_rad=float(np.radians(settings["robot_sigma_deg"])) or None,
        limit_m=settings["limit_mm"] * 1e-3,
        joint_error_rad=settings["joint_error_urad"] * 1e-6,
        sensor=sensor_of(settings["sensor"], settings["z_grows"]),
        tracker_frame=settings["tracker_frame"],
        tracker_sigma_m=settings["tracker_sigma_mm"] * 1e-3,
        joint_sigma_m=settings["joint_sigma_mm"] * 1e-3,
        joint_sigma_rad=float(np.radians(settings["joint_sigma_deg"])),
    )


class HandEyeNode(SessionNode[HandEyeSession]):
    """Drives a `HandEyeSession` with live messages and calls."""

    NAME = "hand_eye_node"
    SETTINGS = SETTINGS
    INPUTS = INPUTS

    def configure(self) -> None:
        """Read the robot, open the history, then the topics and services."""
        super().configure()
        self._config = session_config(self.settings)
        history = self.open_session(sole=False)
        self._kind = hand_eye_kind(self._config.sensor_frame)
        self._outputs = HandEyeOutputs(self.add_output, self._nominal.name, self._serial_in_use)
        self._files = HandEyeFiles(self, self._desk.ask, self._running, history)
        self._camera = CameraTopic(self, self._config.sensor_frame)
        HandEyeServices(self, self._files, self._camera)
        DecisionServices(self.add_service, self._ask_decision, history, self._kind)
        self.add_timer(WATCH_S, self._watch, steady=True)

    def new_session(self, history: CalibrationHistory) -> HandEyeSession:
        """The session of an active node."""
        return HandEyeSession(self._nominal, history, self._config, __version__)

    def activate(self) -> None:
        """Begin a session; it knows nothing of what was captured before."""
        super().activate()
        self._frames = FrameWatch(self, self._config.sensor_frame, self._outputs.transforms)
        self._last: Outcome | None = None
        self._shown: tuple[int, int] | None = None
        self._on_tf: int | None = None  # the revision
        self._silence = Silence()
        self.show_in_force()
        self._outputs.status(self._running(), None)

    def deactivate(self) -> None:
        """End the session; the capture that waits fails, and calls that wait are answered."""
        session = self._session
        if session is not None:
            words = "the node was deactivated: capture again"
            if (command := session.broken_off(Code.CONFLICT, words)) is not None:
                self._desk.ask(command)
            self._publish("the end", lambda: self._outputs.status(session, self._last, ended=True))
        self._frames.close()
        super().deactivate()

    def _running(self) -> HandEyeSession:
        if self._session is None:
            raise NotActiveError("no session: activate the node")
        return self._session

    def take(self, session: HandEyeSession, kind: str, message: Any) -> None:
        """Give a message of the input ``kind`` to the session."""
        take_hand_eye_message(session, kind, message)
        self._silence.heard_if_new(session.newest_joints_ns, time.monotonic())
        if (command := session.recognised()) is not None:
            self._desk.ask(command)

    async def _ask_decision(self, command: Command) -> Outcome:
        if command.name == ACCEPT and self._chosen(command) is not None:
            await self._frames.heard()
            if fault := self._frame_fault(command):
                raise InputError(fault)
        outcome: Outcome = await self._desk.ask(command)
        return outcome

    def _chosen(self, command: Command) -> Mapping[str, Any] | None:
        """The sensor's place that a command would bring into force; None: it will be refused."""
        history = self._history
        if history is None or self._session is None:
            return None
        number = int(named(history, command, self._kind).arguments.get("id", 0))
        model = history.model(number) if number else {}
        return model if "parent" in model else None

    def _frame_fault(self, command: Command) -> str:
        """Why what a command would bring into force cannot stand on tf; empty when it can."""
        model = self._chosen(command)
        return "" if model is None else self._conflict(model)

    def _watch(self) -> None:
        """A capture ends too when the joint states do; what is heard of tf is looked at in time."""
        session = self._session
        if session is None:
            return
        self._frames.tick()
        silent_s = self._silence.look(time.monotonic())
        if (command := session.silent(silent_s)) is not None:
            self._desk.ask(command)

    def polled(self, session: HandEyeSession) -> None:
        """Look at who else puts the sensor's frame onto tf."""
        self._frames.look()

    def show(self, outcome: Outcome) -> None:
        """Publish what came of a command; it is logged already."""
        name, session = outcome.command.name, self._session
        if session is None:
            return
        self._last = outcome
        self._publish(name, lambda: self._outputs.events.tell(outcome.command, outcome))
        if name == CALIBRATE:
            self._publish(name, lambda: self._files.keep(outcome))
            self._publish(name, lambda: self._show_quality(outcome))
        self._publish(name, self.show_in_force)
        self._publish(name, lambda: self._outputs.status(session, outcome))

    def _publish(self, name: str, publish: Callable[[], None]) -> None:
        """What is done stays done, and is shown as far as it can be."""
        try:
            publish()
        except Exception as error:
            told = str(error) if isinstance(error, RobocalError) else traceback.format_exc()
            self.get_logger().error(f"{name} was done but not published: {told}")

    def _show_quality(self, outcome: Outcome) -> None:
        history, number = self._history, outcome.calibration_id
        if history is None:
            return
        frame = str(history.model(number)["parent"]) if number else self._config.flange_frame
        self._outputs.quality(outcome, frame)

    def show_in_force(self) -> None:
        """Put the sensor in force onto tf and record the new state, when either changed."""
        session = self._session
        if session is None:
            return
        shown = session.in_force.revision, session.current.thermal.revision
        if self._shown != shown or self._outputs.events.need_configuration:
            self._shown = shown
            self._outputs.events.tell(configuration(session, self._topics), None)
            self._outputs.status(session, self._last)
        self._show_transform(session.in_force)

    def _show_transform(self, head: Head) -> None:
        """Put what is in force onto tf, once it is known that nobody else puts the frame there."""
        history, model = self._history, head.model
        if history is None or self._on_tf == head.revision:
            return
        self._frames.listen()
        if not self._frames.settled:
            return
        if model is not None and self._conflict(model):
            return
        stamp_ns = 0 if head.calibration_id is None else history.get(head.calibration_id).stamp_ns
        self._outputs.transform(head, stamp_ns)
        self._on_tf = head.revision

    def _conflict(self, model: Mapping[str, Any]) -> str:
        return self._frames.conflict(model["parent"], np.array(model["T_parent_sensor"]))

    def report(self, session: HandEyeSession, history: CalibrationHistory, health: Health) -> None:
        """Tell what is captured, and whether the sensor's place stands on tf."""
        data = session.data
        health.values["data set"] = (
            "none"
            if data is None
            else f"{data.kind}, {len(data.samples)} samples of {len(data.captures)} captures"
        )
        model = session.in_force.model
        if model is not None and (taken := self._conflict(model)):
            health.worsen(ERROR, taken)
        if self._outputs.missing:
            health.worsen(WARN, self._outputs.missing)
        if data is not None and "columns" in data.target and (told := self._camera.other_frame()):
            health.worsen(ERROR, told)
        elif data is not None and (told := self._camera.apart(data.target, taken=False)):
            health.worsen(WARN, told)


def main() -> None:
    """Run the node."""
    run(HandEyeNode)
