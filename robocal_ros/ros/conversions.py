# SPDX-License-Identifier: Apache-2.0
"""Documents and history entries as messages: pure mapping. A number that is not finite stays."""

import math
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, Transform, TransformStamped
from rclpy.qos import QoSProfile
from robocal_msgs.msg import CalibrationQuality, CalibrationSummary, KinematicModel
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.frames import Array
from robocal_ros.history.history_records import Entry
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import COLUMNS, layer_of
from robocal_ros.ros import endpoints

if TYPE_CHECKING:
    from robocal_ros.session.events import Outcome


NS = 1_000_000_000
_ERRORS = ("mean_mm", "rms_mm", "p95_mm", "max_mm")


def time_message(stamp_ns: int) -> Time:
    """A stamp; one before the epoch or too late for the message becomes zero."""
    sec, nanosec = divmod(stamp_ns, NS)
    return Time(sec=sec, nanosec=nanosec) if 0 <= sec < 2**31 else Time()


def header(stamp_ns: int, frame: str) -> Header:
    """A header."""
    return Header(stamp=time_message(stamp_ns), frame_id=frame)


def cloud(stamp_ns: int, frame: str, points: Array) -> PointCloud2:
    """Points (m, 3), as a sensor sends them: 32 bit."""
    fields = [
        PointField(name=name, offset=4 * i, datatype=PointField.FLOAT32, count=1)
        for i, name in enumerate("xyz")
    ]
    return PointCloud2(
        header=header(stamp_ns, frame),
        height=1,
        width=len(points),
        fields=fields,
        point_step=12,
        row_step=12 * len(points),
        data=array("B", points.astype("<f4").tobytes()),
        is_dense=True,
    )


def profile_cloud(stamp_ns: int, frame: str, points: Array) -> PointCloud2:
    """A profile (m, 2), x and z, in its sensor's plane y = 0."""
    x, z = points.T
    message = cloud(stamp_ns, frame, np.column_stack([x, np.zeros_like(x), z]))
    message.is_dense = bool(np.all(np.isfinite(points)))
    return message


def transform_message(T: Any) -> Transform:
    """A pose (4, 4), m."""
    matrix = np.array(T, dtype=np.float64)
    message = Transform()
    t, r = message.translation, message.rotation
    t.x, t.y, t.z = matrix[:3, 3].tolist()
    r.x, r.y, r.z, r.w = frames.quat_xyzw(matrix).tolist()
    return message


def kinematic_model(
    model: Mapping[str, Any],
    *,
    serial: str,
    model_hash: str,
    robot_file_hash: str = "",
    revision: int,
    state: int,
    stamp: Header,
) -> KinematicModel:
    """A model document (``model_document``) as a message."""
    mdh = np.array(model["mdh"], dtype=np.float64)
    covariance = np.array(model.get("covariance", []), dtype=np.float64)
    _require_finite("model", [*mdh.ravel(), *covariance.ravel(), *np.ravel(model["T_base_root"])])
    message = KinematicModel(
        header=stamp,
        robot=model["robot"],
        serial=serial,
        model_hash=model_hash,
        robot_file_hash=robot_file_hash,
        revision=revision,
        joint_names=list(model["joint_names"]),
        prismatic=list(model["prismatic"]),
        sign=list(model["sign"]),
        base_root=transform_message(model["T_base_root"]),
        parameter_names=[name.rsplit("_", 1)[0] for name in model.get("parameters", [])],
        covariance=covariance.ravel().tolist(),
        state=state,
    )
    for column, name in enumerate(COLUMNS):
        setattr(message, name, mdh[:, column].tolist())
    functions, load = layer_of(model)  # which holds finite numbers only
    if functions is not None:
        message.function_first = functions.first.tolist()
        message.function_step = functions.step.tolist()
        message.function_coefficients = functions.coefficients.ravel().tolist()
        message.compliance = functions.compliance.tolist()
        if functions.identified_from is not None:
            for part in fields(functions.identified_from):
                value = np.asarray(getattr(functions.identified_from, part.name))
                plain = value.ravel().tolist() if value.ndim else value.item()
                setattr(message, f"identified_{part.name}", plain)
    if load is not None:
        message.link_mass = load.mass.tolist()
        message.link_centre = load.centre.ravel().tolist()
        message.payload_mass = -1.0 if load.found else float(load.payload_mass)
        for part, values in (
            (message.payload_centre, load.payload_centre),
            (message.gravity, load.gravity),
        ):
            part.x, part.y, part.z = values.tolist()
    return message


def verdict_message(
    outcome: "Outcome", *, robot: str, serial: str, stamp: Header, cycle_id: str = ""
) -> CalibrationQuality:
    """A verdict and why; of a candidate the errors are -1, until they are told, else 0."""
    message = CalibrationQuality(
        header=stamp,
        robot=robot,
        serial=serial,
        candidate_id=outcome.calibration_id,
        code=int(outcome.status),
        accept=outcome.done,
        reason=outcome.message,
        cycle_id=cycle_id,
        samples=outcome.samples,
    )
    if outcome.calibration_id:
        errors = [f"{whose}_{name}" for whose in ("current", "candidate") for name in _ERRORS]
        for name in (*errors, "predicted_rms_mm", "condition"):
            setattr(message, name, -1.0)
    return message


def quality_message(outcome: "Outcome", *, robot: str, serial: str, stamp: Header) -> Any:
    """The verdict on a thermal model; without one the figures are 0 and the reason says why."""
    cycle_id = str(outcome.command.arguments.get("cycle_id", ""))
    message = verdict_message(outcome, robot=robot, serial=serial, stamp=stamp, cycle_id=cycle_id)
    document = outcome.document
    if document is None:
        return message
    set_errors(message, "current", document["in_force"]["held_out"])
    set_errors(message, "candidate", document["calibrated"]["held_out"])
    message.predicted_rms_mm = document["calibrated"]["predicted"]["model_rms_mm"]
    message.held_out = document["calibrated"]["held_out"]["n"]
    message.rank = document["rank"]
    message.condition = document["condition"]
    message.unobservable = list(document["unobservable"])
    message.rejected = list(document["rejected"])
    _require_finite("quality", [message.predicted_rms_mm, message.condition])
    return message


def set_errors(message: CalibrationQuality, whose: str, errors: Mapping[str, float]) -> None:
    """Tell errors, mm, by the names ``mean_mm``, ``rms_mm``, ``p95_mm`` and ``max_mm``."""
    for name in _ERRORS:
        _require_finite(f"{whose}_{name}", [errors[name]])
        setattr(message, f"{whose}_{name}", float(errors[name]))


def summary_message(entry: Entry) -> CalibrationSummary:
    """A line of the history; an error that was not judged is 0."""
    last = entry.decisions[-1] if entry.decisions else None
    return CalibrationSummary(
        id=entry.id,
        revision=entry.revision,
        kind=entry.kind,
        state=entry.state.value,
        code=int(entry.code),
        stamp=time_message(entry.stamp_ns),
        cycle_id=entry.cycle_id,
        by=last.by if last else "",
        reason=last.reason if last else "",
        candidate_rms_mm=entry.candidate_rms_mm or 0.0,
    )


def _require_finite(what: str, values: Sequence[float]) -> None:
    if not all(math.isfinite(value) for value in values):
        raise InputError(f"the {what} holds a number that is not finite: it is not sent")


def pose_message(T: Any) -> Pose:
    """A pose (4, 4), m."""
    moved = transform_message(T)
    message = Pose(orientation=moved.rotation)
    message.position.x, message.position.y, message.position.z = T[:3, 3].tolist()
    return message


MM = 1e-3


def joints_of(arm: SerialArm, numbers: Sequence[float], name: str) -> Array:
    """Joints (n,) in rad (prismatic: m) of degrees (mm).

    Raises `InputError` when there is not one for each joint.
    """
    given = np.array(numbers, dtype=np.float64)
    if given.shape != (arm.n,) or not np.all(np.isfinite(given)):
        raise InputError(
            f"{name} has {given.size} numbers, {arm.name} has {arm.n} joints: teach it"
        )
    return np.where(arm.prismatic, given * MM, np.radians(given))


NO_POSES = [0.0]  # ROS knows no empty array of numbers: it would have no type


def joint_poses(arm: SerialArm, numbers: Sequence[float], name: str) -> Array:
    """Poses (m, n) in rad (prismatic: m) of a parameter ``name``, all in one array, deg (mm).

    None (0, n) of `NO_POSES`. Raises `InputError` when it has not a number for each joint.
    """
    given = [] if list(numbers) == NO_POSES else list(numbers)
    if len(given) % arm.n:
        raise InputError(
            f"{name} has {len(given)} numbers: {arm.name} has {arm.n} joints, one pose after the "
            f"other has a multiple of {arm.n}"
        )
    rows = [given[i : i + arm.n] for i in range(0, len(given), arm.n)]
    poses = [joints_of(arm, row, f"{name}, pose {i}") for i, row in enumerate(rows, start=1)]
    return np.array(poses, dtype=np.float64).reshape(-1, arm.n)


class StaticTf:
    """Publisher of a node's static transforms.

    ``add``: creates a publisher.
    ``missing``: why nothing can be published on this machine; empty when it can.
    """

    def __init__(self, add: Callable[[type, str, QoSProfile], Any]) -> None:
        self._publisher: Any = None
        self.missing = ""
        try:
            from tf2_msgs.msg import TFMessage
        except ImportError:
            self.missing = "no /tf_static: tf2_msgs is missing (apt install ros-jazzy-tf2-msgs)"
        else:
            self._message = TFMessage
            self._publisher = add(TFMessage, "/tf_static", endpoints.LATCHED)

    def publish(self, transforms: Sequence[TransformStamped]) -> None:
        """Publish these; none: late subscribers get no transform."""
        if self._publisher is not None:
            self._publisher.publish(self._message(transforms=list(transforms)))
