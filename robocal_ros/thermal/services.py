# SPDX-License-Identifier: Apache-2.0
"""A measuring robot: where the flange truly is, and what its sensor sees in base.

And the frame of a placed sensor, on tf; and the shift of a controller's frames, for robots that ROS
does not command.
"""

import time
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import Point, PointStamped, PoseStamped, TransformStamped
from sensor_msgs.msg import PointCloud2
from std_srvs.srv import Trigger

from robocal_ros.ground.errors import Code, ConflictError, InputError, LimitError, RobocalError
from robocal_ros.ground.frames import Array
from robocal_ros.ground.samples import stamp_ns
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import FRAME_SHIFT
from robocal_ros.programs.frame_shift import PARTS, best_shift
from robocal_ros.programs.postures import CorrectionModels
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import StaticTf, cloud, header, pose_message, transform_message
from robocal_ros.ros.endpoints import EndpointNode, NotActiveError, trigger_text
from robocal_ros.ros.graph import FrameWatch
from robocal_ros.ros.robot import RobotNode
from robocal_ros.ros.session_node import TWIN, trigger_answer
from robocal_ros.session.events import ACCEPT, ONLY, ROLLBACK, Command, decide
from robocal_ros.thermal.observations import (
    PlacedShot,
    PointQueue,
    SensorShot,
    placed_shot,
    shot_of,
)
from robocal_ros.thermal.proposing import keep_shift, shift_document, shift_in_force, shift_verdict
from robocal_ros.thermal.reference import SpheresInCell
from robocal_ros.thermal.session import ThermalSession

POINT, CLOUD = "point", "cloud"
MOST_POINTS = 1000  # of a call: their doubts take a tenth of a second
LIMIT_MM = 0.1  # of the share of coordinates that is told
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


class MeasuringRobotInterface:
    """``point`` and ``cloud`` in, the same in base out, and the flange beside them; also on call.

    ``session``: of the node; None while it is inactive. It counts what cannot be placed.
    """

    def __init__(self, node: RobotNode, session: Callable[[], ThermalSession | None]) -> None:
        self._base, self._session = node.settings["base_frame"], session
        self._queue: PointQueue | None = None
        for kind, topic in ((PointStamped, POINT), (PointCloud2, CLOUD)):
            node.add_input(kind, topic, partial(self._take, topic), endpoints.STREAM)
        self._pose = node.add_output(PoseStamped, "~/flange_pose", endpoints.STREAM)
        self._point = node.add_output(PointStamped, "~/corrected_point", endpoints.RELIABLE)
        self._cloud = node.add_output(PointCloud2, "~/corrected_cloud", endpoints.RELIABLE)
        from robocal_msgs.srv import CorrectPoints  # of this arrangement alone

        node.add_service(CorrectPoints, "~/correct_points", self._correct)

    def joints_came(self, session: ThermalSession) -> None:
        """Tell where the flange is by the model in force, and place what waited for joints."""
        newest = session.desk.stream.newest_ns
        if newest is None:
            return
        _, q = session.desk.stream.window(newest, newest)
        T = session.current.arm.fk(q[0])
        self._pose.publish(PoseStamped(header=header(newest, self._base), pose=pose_message(T)))
        self._publish(session)

    def _take(self, name: str, message: Any) -> None:
        session = self._session()
        if session is None:
            return
        try:
            shot = _of_the_sensor(shot_of(message, name), _placed_sensor(session))
            if self._queue is None or self._queue.stream is not session.desk.stream:
                self._queue = PointQueue(session.desk.stream)
            self._queue.add(shot)
        except RobocalError as error:
            session.refuse(name, error)
            return
        self._publish(session)

    def _publish(self, session: ThermalSession) -> None:
        if self._queue is None:
            return
        try:
            sensor = _placed_sensor(session).T_flange_sensor
        except RobocalError as error:
            for shot, _ in self._queue.end():
                session.refuse(shot.name, error)
            return
        for shot, placed in self._queue.ready(session.current.arm, sensor):
            if isinstance(placed, PlacedShot):
                self._send(placed)
            else:
                session.refuse(shot.name, placed)

    def _send(self, placed: PlacedShot) -> None:
        shot = placed.shot
        if shot.name == CLOUD:
            self._cloud.publish(cloud(shot.stamp_ns, self._base, placed.points))
            return
        self._point.publish(self._told(placed))

    def _told(self, placed: PlacedShot) -> PointStamped:
        x, y, z = placed.points[0].tolist()
        stamp = header(placed.shot.stamp_ns, self._base)
        return PointStamped(header=stamp, point=Point(x=x, y=y, z=z))

    def _correct(self, request: Any, response: Any) -> Any:
        """Place what can be placed now; each other point gets its reason."""
        session = self._session()
        if session is None:
            raise NotActiveError("no session: activate the node")
        spheres, count = _placed_sensor(session), len(request.points)
        if not 0 < count <= MOST_POINTS:
            raise LimitError(f"{count} points: 1 to {MOST_POINTS} are placed at a time")
        arm, stream = session.current.arm, session.desk.stream
        placed: dict[int, PlacedShot] = {}
        response.reasons = [""] * count
        for i, message in enumerate(request.points):
            try:
                shot = _of_the_sensor(shot_of(message, POINT), spheres)
                shot.require_usable()
                placed[i] = placed_shot(shot, stream, arm, spheres.T_flange_sensor)
            except RobocalError as error:
                response.reasons[i] = str(error)
        sigma = session.placing_sigma_m(list(placed.values()))
        response.sigma_mm = [-1.0] * count
        for i, sigma_m in zip(placed, sigma.tolist(), strict=True):
            response.sigma_mm[i] = 1e3 * sigma_m
        nowhere = Point(x=float("nan"), y=float("nan"), z=float("nan"))
        response.corrected = [
            self._told(placed[i])
            if i in placed
            else PointStamped(header=header(stamp_ns(m.header.stamp), self._base), point=nowhere)
            for i, m in enumerate(request.points)
        ]
        response.success = len(placed) == count
        response.status = int(Code.ACCEPT if response.success else Code.BAD_INPUT)
        response.message = f"{len(placed)} of {count} points in {self._base}"
        if not response.success:
            i = min(set(range(count)) - set(placed))
            response.message += f"; point {i + 1}: {response.reasons[i]}"
        return response


def _placed_sensor(session: ThermalSession) -> SpheresInCell:
    reference = session.reference
    if reference is None or reference.spheres is None:
        raise InputError(UNPLACED)
    session.require_unmoved()
    return reference.spheres


def _of_the_sensor(shot: SensorShot, spheres: SpheresInCell) -> SensorShot:
    if shot.frame != spheres.frame:
        raise InputError(f"frame '{shot.frame}' is not the placed sensor's, '{spheres.frame}'")
    return shot


FRAMES_OF = ("nominal", "commissioned")  # which model a program was made with


class FrameShiftInterface:
    """The shift of base and tool frame that serves the working poses best: found, kept, told.

    Nothing else of the session depends on it, so that it needs no place in a recording.

    ``work`` (k, n): the poses; ``T_flange_tool`` (4, 4).
    """

    def __init__(
        self,
        node: RobotNode,
        history: CalibrationHistory,
        session: Callable[[], ThermalSession | None],
        work: Array,
        T_flange_tool: Array,
    ) -> None:
        self._history, self._session = history, session
        self._work, self._T_flange_tool = work, T_flange_tool
        self._settings, self._shown = node.settings, -1
        self._outputs = {
            part: node.add_output(TransformStamped, f"~/{part}_shift", endpoints.LATCHED)
            for part in PARTS
        }
        node.add_service(Trigger, "~/shift_frames_trigger", self._find)
        node.add_service(Trigger, "~/accept_shift_trigger", self._decider(ACCEPT, {"choose": ONLY}))
        node.add_service(
            Trigger, "~/rollback_shift_trigger", self._decider(ROLLBACK, {"previous": True})
        )

    def _find(self, request: Any, response: Any) -> Any:
        """Find the shift for the model in force, judge it, keep it as a candidate."""
        session = self._session()
        if session is None or not len(self._work):
            raise ConflictError("no working poses: give work_poses_deg, a shift serves those")
        current, q, T = session.current, self._work, self._T_flange_tool
        of = self._settings["shift_frames_of"]
        reference = current.commissioned if of == FRAMES_OF[1] else session.nominal
        models = CorrectionModels(session.nominal, current.arm, reference)
        shift = best_shift(models, q, T)
        names = tuple(str(i + 1) for i in range(len(q)))
        found = shift_document(shift, names, LIMIT_MM)
        kept = shift_in_force(self._history, models, q, T)
        was = None if kept is None else kept.document(LIMIT_MM)
        document = {**found, "in_force": was, "shift_frames_of": of}
        verdict = shift_verdict(found, was, only_judged=False)
        number = keep_shift(
            self._history,
            session.nominal,
            shift,
            q,
            T,
            document,
            verdict,
            current.head.revision,
            time.time_ns(),
        )
        response.success = verdict.accept
        response.message = trigger_text(number, verdict.code, verdict.reason)
        return response

    def _decider(self, name: str, arguments: Mapping[str, Any]) -> Callable[[Any, Any], Any]:
        def serve(request: Any, response: Any) -> Any:
            command = Command(name, {"by": TWIN, **arguments})
            expected = self._history.head(FRAME_SHIFT).revision
            outcome = decide(self._history, command, expected, time.time_ns(), FRAME_SHIFT)
            self.look()
            return trigger_answer(response, outcome)

        return serve

    def look(self, again: bool = False) -> None:
        """Tell what is in force, where that has changed, or ``again``."""
        head = self._history.head(FRAME_SHIFT)
        if self._shown == head.revision and not again:
            return
        self._shown = head.revision
        number = head.calibration_id
        stamp_ns = self._history.get(number).stamp_ns if number else 0
        for part, frame in zip(PARTS, (self._settings["base_frame"], "tool"), strict=True):
            T = np.eye(4) if head.model is None else np.array(head.model[f"T_{part}_shift"])
            self._outputs[part].publish(
                TransformStamped(
                    header=header(stamp_ns, frame),
                    child_frame_id=f"{frame}_shifted",
                    transform=transform_message(T),
                )
            )
