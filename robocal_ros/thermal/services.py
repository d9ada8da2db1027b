# SPDX-License-Identifier: Apache-2.0
"""Topics of a measuring robot: where the flange truly is, and what its sensor sees in base.

And the frame of a placed sensor, on tf.
"""

from collections.abc import Callable
from functools import partial
from typing import Any

from geometry_msgs.msg import Point, PointStamped, PoseStamped, TransformStamped
from sensor_msgs.msg import PointCloud2

from robocal_ros.ground.errors import InputError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.kinematics import SerialArm
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import StaticTf, cloud, header, pose_message
from robocal_ros.ros.endpoints import EndpointNode
from robocal_ros.ros.graph import FrameWatch
from robocal_ros.thermal.measured_points import PlacedShot, PointQueue, shot_of
from robocal_ros.thermal.session import ThermalSession

POINT, CLOUD = "point", "cloud"
UNPLACED = "the sensor is not placed: capture the cold reference"


class SensorOnTf:
    """The placed sensor's frame on ``/tf_static``, unless another node puts it onto tf."""

    def __init__(self, node: EndpointNode) -> None:
        self._node, self._tf = node, StaticTf(node.add_output)
        self._published: list[TransformStamped] = []
        self._placed: tuple[TransformStamped, Array] | None = None
        self._frames: FrameWatch | None = None

    def show(self, message: TransformStamped, T_parent_sensor: Array) -> None:
        """Publish it once it is known that nobody else does."""
        if self._placed is None or self._placed[0].child_frame_id != message.child_frame_id:
            self.close()
            self._frames = FrameWatch(self._node, message.child_frame_id, self._published)
        self._placed = message, T_parent_sensor
        self.poll()

    def poll(self) -> None:
        """Look at what others put onto tf."""
        if self._placed is None or self._frames is None:
            return
        self._frames.look()
        self._frames.tick()
        message, _ = self._placed
        if self._frames.settled and message not in self._published[-1:] and not self.fault():
            self._published.append(message)
            self._tf.publish([message])

    def fault(self) -> str:
        """Why the frame cannot stand on tf; empty when it can, or when there is none."""
        if self._placed is None or self._frames is None:
            return ""
        message, T_parent_sensor = self._placed
        return self._tf.missing or self._frames.conflict(message.header.frame_id, T_parent_sensor)

    def close(self) -> None:
        """Listen no more."""
        if self._frames is not None:
            self._frames.close()
        self._placed = self._frames = None


class MeasuringRobotTopics:
    """``point`` and ``cloud`` in, the same in base out, and the flange beside them.

    ``session``: of the node; None while it is inactive. It counts what cannot be placed.
    """

    def __init__(
        self,
        node: EndpointNode,
        base_frame: str,
        session: Callable[[], ThermalSession | None],
    ) -> None:
        self._base, self._session = base_frame, session
        self._queue: PointQueue | None = None
        self._arm: tuple[int, SerialArm] | None = None
        for kind, topic in ((PointStamped, POINT), (PointCloud2, CLOUD)):
            node.add_input(kind, topic, partial(self._take, topic), endpoints.STREAM)
        self._pose = node.add_output(PoseStamped, "~/flange_pose", endpoints.STREAM)
        self._point = node.add_output(PointStamped, "~/corrected_point", endpoints.RELIABLE)
        self._cloud = node.add_output(PointCloud2, "~/corrected_cloud", endpoints.RELIABLE)

    def joints_came(self, session: ThermalSession) -> None:
        """Tell where the flange is by the model in force, and place what waited for joints."""
        newest = session.desk.stream.newest_ns
        if newest is None:
            return
        _, q = session.desk.stream.window(newest, newest)
        T = self._model(session).fk(q[0])
        self._pose.publish(PoseStamped(header=header(newest, self._base), pose=pose_message(T)))
        self._publish(session)

    def _model(self, session: ThermalSession) -> SerialArm:
        revision = session.in_force.revision
        if self._arm is None or self._arm[0] != revision:
            self._arm = revision, session.current.arm
        return self._arm[1]

    def _take(self, name: str, message: Any) -> None:
        session = self._session()
        if session is None:
            return
        try:
            reference = session.reference
            if reference is None or reference.spheres is None:
                raise InputError(UNPLACED)
            shot, known = shot_of(message, name), reference.spheres.frame
            if shot.frame != known:
                raise InputError(f"frame '{shot.frame}' is not the placed sensor's, '{known}'")
            if self._queue is None or self._queue.stream is not session.desk.stream:
                self._queue = PointQueue(session.desk.stream)
            self._queue.add(shot)
        except RobocalError as error:
            session.refuse(name, error)
            return
        self._publish(session)

    def _publish(self, session: ThermalSession) -> None:
        reference = session.reference
        if self._queue is None or reference is None or reference.spheres is None:
            return
        sensor = reference.spheres.T_flange_sensor
        for shot, placed in self._queue.ready(self._model(session), sensor):
            if isinstance(placed, PlacedShot):
                self._send(placed)
            else:
                session.refuse(shot.name, placed)

    def _send(self, placed: PlacedShot) -> None:
        shot = placed.shot
        if shot.name == CLOUD:
            self._cloud.publish(cloud(shot.stamp_ns, self._base, placed.points))
            return
        x, y, z = placed.points[0].tolist()
        told = PointStamped(header=header(shot.stamp_ns, self._base), point=Point(x=x, y=y, z=z))
        self._point.publish(told)
