"""What planned poses would say about a sensor's place, before the robot is moved."""

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError, LimitError, RobocalError
from robocal_ros.ground.samples import JointSample
from robocal_ros.hand_eye.data import DataSet
from robocal_ros.hand_eye.result import HandEyeSettings, PoseNoise
from robocal_ros.hand_eye.session import HandEyeConfig, HandEyeSession
from robocal_ros.hand_eye.shots import Profile
from robocal_ros.hand_eye.targets import BoardTarget, SphereTarget, target_of
from robocal_ros.history.history_records import CalibrationState
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.tables import FARTHEST_M, flange_unit_fault, joint_unit_fault
from robocal_ros.session.events import History

if TYPE_CHECKING:
    from robocal_ros.hand_eye.planning import PlanReport, SensorRange

Array = NDArray[np.float64]

ROBOT_SIGMA_M = 5e-5  # of a reported pose in each axis, where it is not given
MOST_POSES = 200
FEWEST_SEEN = 3  # samples that tell on which side of the laser plane a sphere lies
# What was refused or taken back tells nothing.
TO_GO_BY = (CalibrationState.PENDING, CalibrationState.STALE)


def require_count(joints: int, flange: int) -> None:
    """Refuse poses that were given in both ways or in none, and too many.

    Raises `InputError` or `LimitError`, naming the numbers.
    """
    if bool(joints) == bool(flange):
        raise InputError(
            f"{joints} joint states and {flange} flange poses: give the planned poses in one of "
            "the two ways"
        )
    if joints + flange > MOST_POSES:
        raise LimitError(f"{joints + flange} poses: at most {MOST_POSES} are judged at a time")


def poses_of_joints(arm: SerialArm, samples: Sequence[JointSample]) -> Array:
    """Flange poses (m, 4, 4) at joint positions.

    Raises `InputError` when a joint is missing, or a value is in another unit.
    """
    q = np.array([sample.position[sample.order(arm.joint_names)] for sample in samples])
    _require(joint_unit_fault(arm, q))
    return arm.fk(q)


def poses_of_flange(position: Array, quat_xyzw: Array) -> Array:
    """Flange poses (m, 4, 4) of positions (m, 3), m, and quaternions (m, 4).

    Raises `InputError` when one is no pose, or is in another unit.
    """
    pairs = zip(position, quat_xyzw, strict=True)
    poses = [pose_of(*pair, f"flange pose {i}") for i, pair in enumerate(pairs, 1)]
    _require(flange_unit_fault(position))
    return np.array(poses)


def _require(fault: tuple[int, str] | None) -> None:
    if fault is not None:
        raise InputError(f"planned pose {fault[0] + 1}: {fault[1]}")


def pose_of(position: ArrayLike, quat_xyzw: ArrayLike, name: str) -> Array:
    """A pose (4, 4) of a position (3,), m, and a quaternion (4,).

    Raises `InputError` when it is none; ``name`` says which.
    """
    quat, place = np.asarray(quat_xyzw, np.float64), np.asarray(position, np.float64)
    norm = float(np.linalg.norm(quat))
    if not (abs(norm - 1.0) <= 1e-3):
        raise InputError(f"{name} is none: its quaternion has length {norm:.6g}")
    return frames.transform_from_quat(require_near(place, name), quat / norm)


def require_near(place: ArrayLike, name: str) -> Array:
    """A place (3,), m.

    Raises `InputError` when it is none within reach of an arm; ``name`` says which.
    """
    point = np.asarray(place, np.float64)
    if not np.all(np.isfinite(point)):
        raise InputError(f"{name} is none: its position is {point}")
    if (away := float(np.linalg.norm(point))) > FARTHEST_M:
        raise InputError(
            f"{name} is {away:.4g} m away: is it a thousand times too far: mm where m are expected?"
        )
    return point


def rough_mount(
    session: HandEyeSession, history: History, given: Array | None, configured: Array | None
) -> tuple[Array, str]:
    """About where the sensor sits on the flange (4, 4), and who says so.

    What the request has given; else what is in force; else the open data set's last candidate,
    unless it was refused; else what is configured.

    Raises `InputError` when nothing says it.
    """
    if given is not None:
        return given, "the request"
    head, number = session.in_force, _candidate(session.data, history)
    for model, name in (
        (head.model, f"calibration {head.calibration_id} in force"),
        (history.model(number) if number else None, f"candidate {number}"),
    ):
        if model is not None and model["parent"] == session.config.flange_frame:
            return np.array(model["T_parent_sensor"]), name
    if configured is not None:
        return configured, "rough_xyz_mm and rough_quat_xyzw"
    raise InputError(
        "nothing says where the sensor sits: set rough_xyz_mm and rough_quat_xyzw to a few "
        "millimetres and degrees, or give sensor in the request"
    )


def _candidate(data: DataSet | None, history: History) -> int:
    """The last calibration of a data set that can be gone by; 0 without."""
    number = 0 if data is None else data.candidate
    return number if number and history.get(number).state in TO_GO_BY else 0


def sphere_centre(
    data: DataSet, history: History, arm: SerialArm, T_flange_sensor: Array
) -> Array | None:
    """Where the sphere was last found (3,), base; None where neither result nor samples tell."""
    from robocal_ros.hand_eye.tasks import HandEyeData, SphereTask

    target = target_of(data.target)
    if not isinstance(target, SphereTarget):
        return None
    if number := _candidate(data, history):
        return 1e-3 * np.array(history.document(number)["target"]["center_mm"])
    samples = list(data.samples.values())
    if len(samples) < FEWEST_SEEN:
        return None
    names = tuple(str(sample.handle) for sample in samples)
    profiles = [Profile(sample.values, str(sample.handle)) for sample in samples]
    poses = arm.fk(np.array([sample.q for sample in samples]))
    task = SphereTask(target)
    try:
        view = task.read(HandEyeData(names, poses, profiles), T_flange_sensor).view
    except RobocalError:  # they show no sphere: calibrate says so
        return None
    return task.placed(view, T_flange_sensor) if len(view.sightings.names) >= FEWEST_SEEN else None


def judged_plan(
    data: DataSet,
    T_base_flange: Array,
    marks: Sequence[str],
    T_flange_sensor: Array,
    sensor: "SensorRange",
    config: HandEyeConfig,
    centre: Array | None = None,
) -> "PlanReport":
    """Judge planned flange poses (m, 4, 4) with a rough T_flange_sensor (4, 4).

    ``marks``: of a step target the mark (m) of each pose; without any its first one. ``centre``:
    of a sphere (3,), base; None: where most of the poses see it.

    Raises `InputError` for a target whose plans cannot be judged, and for marks that it does not
    have.
    """
    from robocal_ros.hand_eye.planning import check_plan, planned_target

    if marks and len(marks) != len(T_base_flange):
        raise InputError(f"{len(marks)} marks for {len(T_base_flange)} poses: give each its own")
    for mark in marks:
        data.require_mark(mark)
    if centre is not None and data.kind != "sphere":
        raise InputError(f"center is a sphere's, not a {data.kind}'s: leave it out")
    target = target_of(data.target)
    if data.kind == "camera" or isinstance(target, BoardTarget):
        raise InputError(f"plans are judged for a line laser's targets, not for a {data.kind}")
    given = HandEyeSettings(config.robot_sigma_m, config.robot_sigma_rad).noise()
    noise = given or PoseNoise(ROBOT_SIGMA_M, 0.0)
    middle = None if centre is None else centre.tolist()
    planned = planned_target(target, sensor, middle, tuple(marks) or None)
    return check_plan(planned, T_base_flange, T_flange_sensor, sensor, noise, config.limit_m)
