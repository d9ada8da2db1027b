"""What the thermal node says: its topics, and how results get onto them."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import TransformStamped
from numpy.typing import NDArray
from rclpy.qos import QoSProfile
from robocal_msgs.msg import AccuracyState, CalibrationQuality, KinematicModel
from std_msgs.msg import Header

from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import conversions, qos
from robocal_ros.ros.session_events import SessionEvents
from robocal_ros.session.events import Outcome
from robocal_ros.thermal.accuracy_state import Accuracy

Array = NDArray[np.float64]
AddOutput = Callable[[type, str, QoSProfile], Any]


class ThermalOutputs:
    """Publishers of one robot's results.

    Parameters
    ----------
    add : creates a publisher.
    serial, robot_file_hash, base_frame : as messages carry them.
    """

    def __init__(
        self,
        add: AddOutput,
        nominal: SerialArm,
        serial: str,
        robot_file_hash: str,
        base_frame: str,
    ) -> None:
        self._nominal, self._serial, self._base_frame = nominal, serial, base_frame
        self._robot_file_hash = robot_file_hash
        self._candidate = add(KinematicModel, "~/candidate", qos.LATCHED)
        self._model = add(KinematicModel, "~/model", qos.LATCHED)
        self._quality = add(CalibrationQuality, "~/quality", qos.LATCHED)
        self._accuracy = add(AccuracyState, "~/accuracy", qos.LATCHED)
        self._sensor = add(TransformStamped, "~/sensor", qos.LATCHED)
        self.events = SessionEvents(add)

    def model(self, model: Mapping[str, Any], revision: int, stamp_ns: int) -> None:
        """Say what is in force."""
        self._model.publish(self._message(model, revision, KinematicModel.ACCEPTED, stamp_ns))

    def candidate(self, model: Mapping[str, Any], stamp_ns: int) -> None:
        """Show what was identified."""
        self._candidate.publish(self._message(model, 0, KinematicModel.CANDIDATE, stamp_ns))

    def quality(self, outcome: Outcome, frame: str) -> None:
        """Show the verdict on a candidate, or why there is none."""
        stamp = conversions.header(outcome.command.stamp_ns or 0, frame)
        self._quality.publish(
            conversions.quality_message(
                outcome, robot=self._nominal.name, serial=self._serial, stamp=stamp
            )
        )

    def accuracy(self, found: Accuracy, tolerance_m: float, stamp_ns: int) -> None:
        """Tell the line how accurate the robot is believed to be."""
        self._accuracy.publish(
            accuracy_message(
                found,
                tolerance_m,
                robot=self._nominal.name,
                serial=self._serial,
                stamp=conversions.header(stamp_ns, self._base_frame),
            )
        )

    def sensor(self, T_base_sensor: Array, frame: str, stamp_ns: int) -> None:
        """Say where the placed sensor stands."""
        self._sensor.publish(
            TransformStamped(
                header=conversions.header(stamp_ns, self._base_frame),
                child_frame_id=frame,
                transform=conversions.transform_message(T_base_sensor),
            )
        )

    def _message(
        self, model: Mapping[str, Any], revision: int, state: int, stamp_ns: int
    ) -> KinematicModel:
        return conversions.kinematic_model(
            model,
            serial=self._serial,
            model_hash=self._nominal.model_hash,
            robot_file_hash=self._robot_file_hash,
            revision=revision,
            state=state,
            stamp=conversions.header(stamp_ns, self._base_frame),
        )


def accuracy_message(
    found: "Accuracy", tolerance_m: float, *, robot: str, serial: str, stamp: Header
) -> AccuracyState:
    """How accurate the robot is believed to be, see `Accuracy.document`."""
    told = found.document(tolerance_m)
    return AccuracyState(header=stamp, robot=robot, serial=serial, **told)
