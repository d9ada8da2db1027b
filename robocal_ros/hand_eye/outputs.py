"""What the hand-eye node says: its topics, and how results get onto them."""

from collections.abc import Callable
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from rclpy.qos import QoSProfile
from robocal_msgs.msg import CalibrationQuality, HandEyeSample, HandEyeStatus

from robocal_ros.ground.errors import Code
from robocal_ros.ground.proposals import Head
from robocal_ros.hand_eye.data import IN_HAND, TO_HAND, Capture
from robocal_ros.hand_eye.session import HandEyeSession
from robocal_ros.ros import conversions, qos
from robocal_ros.ros.session_events import SessionEvents
from robocal_ros.ros.static_tf import StaticTf
from robocal_ros.session.events import Outcome

AddOutput = Callable[[type, str, QoSProfile], Any]

TARGETS = {
    HandEyeStatus.SPHERE: "sphere",
    HandEyeStatus.STEP: "step",
    HandEyeStatus.LINE: "line",
    HandEyeStatus.CAMERA: "camera",
}
MOUNTS = {HandEyeStatus.ON_FLANGE: IN_HAND, HandEyeStatus.FIXED: TO_HAND}
NUMBER_OF = {name: number for number, name in TARGETS.items()}
MOUNT_NUMBER_OF = {name: number for number, name in MOUNTS.items()}


class HandEyeOutputs:
    """Publishers of one sensor's results.

    Parameters
    ----------
    add : creates a publisher.
    robot, serial : as messages carry them.

    Attributes
    ----------
    transforms : all that were put onto tf.
    missing : what cannot be published on this machine; empty when everything can.
    """

    def __init__(self, add: AddOutput, robot: str, serial: str) -> None:
        self._robot, self._serial = robot, serial
        self._status = add(HandEyeStatus, "~/status", qos.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", qos.LATCHED)
        self.events = SessionEvents(add)
        self.transforms: list[TransformStamped] = []
        self._tf = StaticTf(add)
        self.missing = self._tf.missing

    def status(self, session: HandEyeSession, last: Outcome | None, *, ended: bool = False) -> None:
        """Say how far the data set is, and what came of the last command.

        ``ended``: the session is over; its captures are told once more, as they ended.
        """
        message = status_message(session, last)
        if ended:
            message.state = HandEyeStatus.IDLE
        self._status.publish(message)

    def transform(self, head: Head, stamp_ns: int) -> None:
        """Put what is in force onto tf; nothing in force: late subscribers get no transform."""
        transforms = [] if head.model is None else [transform_message(head.model, stamp_ns)]
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


def status_message(session: HandEyeSession, last: Outcome | None) -> HandEyeStatus:
    """The state of a session."""
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
        waits = data.waiting is not None
        message.state = HandEyeStatus.CAPTURING if waits else HandEyeStatus.COLLECTING
        message.target, message.method = NUMBER_OF[data.kind], data.method
        message.mount, message.candidate_id = MOUNT_NUMBER_OF[data.mount], data.candidate
        message.samples = [_sample(one) for _, one in sorted(data.captures.items())]
    if last is not None:
        message.last_command, message.last_message = last.command.name, last.message
        message.last_status = int(last.status)
    return message


def _sample(capture: Capture) -> HandEyeSample:
    states = {Code.NONE: HandEyeSample.WAITING, Code.ACCEPT: HandEyeSample.CAPTURED}
    return HandEyeSample(
        handle=capture.handle,
        mark=capture.mark,
        state=states.get(capture.code, HandEyeSample.FAILED),
        reason=capture.reason,
        status=int(capture.code),
        stamp=conversions.time_message(capture.stamp_ns),
    )


def transform_message(model: dict[str, Any], stamp_ns: int) -> TransformStamped:
    """A calibration as a transform."""
    return TransformStamped(
        header=conversions.header(stamp_ns, model["parent"]),
        child_frame_id=model["child"],
        transform=conversions.transform_message(np.array(model["T_parent_sensor"])),
    )
