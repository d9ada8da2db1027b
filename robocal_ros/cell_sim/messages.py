"""What the simulated cell reads and says, as messages: pure mapping."""

from array import array
from collections.abc import Mapping

import numpy as np
from control_msgs.action import FollowJointTrajectory
from geometry_msgs.msg import PointStamped
from numpy.typing import NDArray
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState, PointCloud2, PointField, Temperature
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.cell_sim.trajectory import Trajectory
from robocal_ros.cell_sim.trajectory_goal import Tolerances
from robocal_ros.ground import frames
from robocal_ros.ground.errors import InputError
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.ros.conversions import header
from robocal_ros.tool.crossed_model import StepKind
from robocal_ros.tool.edges import BeamEdge
from robocal_ros.tool.measuring_plan import PlannedStep

Array = NDArray[np.float64]

KINDS: Mapping[int, StepKind] = {ToolStep.CIRCLE: "circle", ToolStep.PLUNGE: "plunge"}


def planned_step(message: ToolStep) -> PlannedStep:
    """A circle or plunge that is awaited.

    Raises
    ------
    InputError
        When kind, poses or sizes make no motion.
    """
    if message.kind not in KINDS:
        raise InputError(f"step {message.name} has the kind {message.kind}: no circle, no plunge")
    kind = KINDS[message.kind]
    size = "radius" if kind == "circle" else "depth"
    for name in ("speed", size):
        if not 0.0 < getattr(message, name) < np.inf:
            raise InputError(f"step {message.name}: {name} = {getattr(message, name)} is no motion")
    place, turn, laser = message.flange.position, message.flange.orientation, message.laser
    xyz = [place.x, place.y, place.z]
    flange, axes = [turn.x, turn.y, turn.z, turn.w], [laser.x, laser.y, laser.z, laser.w]
    finite = bool(np.all(np.isfinite([*xyz, message.start_angle])))
    if not finite or message.direction not in (-1, 1):
        raise InputError(f"step {message.name}: a pose is not finite, or direction not +1 or -1")
    if not all(abs(np.linalg.norm(quat) - 1.0) < 1e-3 for quat in (flange, axes)):
        raise InputError(f"step {message.name}: a quaternion is not of unit length")
    return PlannedStep(
        name=message.name,
        kind=kind,
        number=message.number,
        of=message.of,
        T_base_flange=frames.transform_from_quat(xyz, flange),
        R_base_laser=frames.transform_from_quat(np.zeros(3), axes)[:3, :3],
        speed_m_s=message.speed,
        radius_m=message.radius,
        direction=message.direction,
        start_rad=message.start_angle,
        depth_m=message.depth,
    )


def trajectory_of(message: JointTrajectory, from_ns: int) -> Trajectory:
    """A trajectory whose start, where it has one, is counted from ``from_ns`` on.

    Raises
    ------
    InputError
        When a controller rejects the numbers of its values.
    """
    points, count = message.points, len(message.joint_names)
    rows = []
    for what, needed in (("positions", True), ("velocities", False), ("accelerations", False)):
        values = [getattr(point, what) for point in points]
        has = np.array([len(row) > 0 for row in values], dtype=bool)
        for i, row in enumerate(values):
            if len(row) != count and (needed or has[i]):
                raise InputError(f"rejected: point {i} has {len(row)} {what} for {count} joints")
        filled = [row if given else [0.0] * count for row, given in zip(values, has, strict=True)]
        rows.append((np.array(filled, dtype=np.float64).reshape(len(points), count), has))
    if any(len(point.effort) for point in points):
        raise InputError("rejected: efforts, for which there is no command interface")
    (q, _), (qd, has_qd), (qdd, has_qdd) = rows
    times = [point.time_from_start for point in points]
    at_ns = stamp_ns(message.header.stamp)
    return Trajectory(
        names=tuple(message.joint_names),
        time_s=np.array([t.sec + 1e-9 * t.nanosec for t in times], dtype=np.float64),
        q=q,
        qd=qd,
        qdd=qdd,
        has_qd=has_qd,
        has_qdd=has_qdd,
        start_s=(at_ns - from_ns) * 1e-9 if at_ns else None,
    )


def tolerances_of(
    goal: FollowJointTrajectory.Goal, names: tuple[str, ...], own: Tolerances
) -> Tolerances:
    """A goal's tolerances for joints ``names``: 0 leaves the controller's ``own``, -1 removes one.

    As get_segment_tolerances of tolerances.hpp: what is wrong anywhere leaves all of its own.
    """

    def resolved(default: float, given: float) -> float:
        return default if given == 0.0 else max(given, 0.0)

    time = goal.goal_time_tolerance
    over_s = time.sec + 1e-9 * time.nanosec
    path, end = own.path.copy(), own.goal.copy()
    for given, into in ((goal.path_tolerance, path), (goal.goal_tolerance, end)):
        for joint in given:
            values = joint.position, joint.velocity, joint.acceleration
            if joint.name not in names or any(x < 0.0 and x != -1.0 for x in values):
                return own
            at = names.index(joint.name)
            into[at] = resolved(into[at], joint.position)
    if over_s < 0.0 and over_s != -1.0:
        return own
    return Tolerances(path, end, resolved(own.goal_time_s, over_s))


def beam_event(edge: BeamEdge, stamp_ns: int, station: str) -> BeamEvent:
    """An edge as its input tells it."""
    return BeamEvent(
        header=header(stamp_ns, station),
        beam=edge.beam,
        edge=BeamEvent.BREAK if edge.blocked else BeamEvent.RESTORE,
        stamp_sigma_s=edge.sigma_s,
    )


def joint_state(
    names: tuple[str, ...], stamp_ns: int, q: Array, qd: Array | None, missing: int = 0
) -> JointState:
    """A reading as joint_state_broadcaster tells it: by alphabet, without effort.

    ``qd`` None: hardware that has positions alone. ``missing``: as `odd_length`.
    """
    order = sorted(range(len(names)), key=lambda i: names[i])
    nothing = np.full(len(names), np.nan)
    velocity = nothing if qd is None else qd[order]
    return JointState(
        header=header(stamp_ns, ""),
        name=[names[i] for i in order],
        position=array("d", q[order].tobytes()),
        velocity=array("d", odd_length(velocity, missing).tobytes()),
        effort=array("d", nothing.tobytes()),
    )


def odd_length(values: Array, missing: int) -> Array:
    """Values (n,) of which so many are missing; negative: there are so many more."""
    return values[missing:] if missing >= 0 else np.concatenate([values, values[missing:]])


def point(stamp_ns: int, frame: str, p: Array) -> PointStamped:
    """A sphere's centre (3,)."""
    message = PointStamped(header=header(stamp_ns, frame))
    message.point.x, message.point.y, message.point.z = p.tolist()
    return message


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


def profile(stamp_ns: int, frame: str, points: Array) -> PointCloud2:
    """A profile (m, 2), x and z, in its sensor's plane y = 0."""
    x, z = points.T
    message = cloud(stamp_ns, frame, np.column_stack([x, np.zeros_like(x), z]))
    message.is_dense = bool(np.all(np.isfinite(points)))
    return message


def temperature(stamp_ns: int, joint: str, celsius: float) -> Temperature:
    """A motor's."""
    return Temperature(header=header(stamp_ns, joint), temperature=celsius, variance=0.01)
