"""What the simulated cell reads and says, as messages: pure mapping."""

from array import array
from collections.abc import Mapping

import numpy as np
from geometry_msgs.msg import PointStamped
from numpy.typing import NDArray
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState, PointCloud2, PointField, Temperature

from robocal_ros.core import frames
from robocal_ros.core.errors import InputError
from robocal_ros.core.kinematics import SerialArm
from robocal_ros.core.tool.beam_edges import BeamEdge
from robocal_ros.core.tool.crossed_model import StepKind
from robocal_ros.core.tool.measuring_plan import PlannedStep
from robocal_ros.correction.inputs import TrajectoryCommand
from robocal_ros.nodes.conversions import header

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


def in_joint_order(
    command: TrajectoryCommand, arm: SerialArm
) -> tuple[Array, Array | None, Array | None]:
    """Positions, velocities, accelerations (k, n) of a trajectory in the arm's order of joints.

    Raises
    ------
    InputError
        When it does not name each joint once.
    """
    if sorted(command.names) != sorted(arm.joint_names):
        raise InputError(
            f"the trajectory is for {', '.join(command.names)}; this robot has "
            f"{', '.join(arm.joint_names)}"
        )
    order = [command.names.index(name) for name in arm.joint_names]
    qd, qdd = command.velocity, command.acceleration
    return (
        command.position[:, order],
        None if qd is None else qd[:, order],
        None if qdd is None else qdd[:, order],
    )


def beam_event(edge: BeamEdge, stamp_ns: int, station: str) -> BeamEvent:
    """An edge as its input tells it."""
    return BeamEvent(
        header=header(stamp_ns, station),
        beam=edge.beam,
        edge=BeamEvent.BREAK if edge.blocked else BeamEvent.RESTORE,
        stamp_sigma_s=edge.sigma_s,
    )


def joint_state(names: list[str], stamp_ns: int, q: Array, qd: Array) -> JointState:
    """A joint reading."""
    return JointState(
        header=header(stamp_ns, ""),
        name=names,
        position=array("d", q.tobytes()),
        velocity=array("d", qd.tobytes()),
    )


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
