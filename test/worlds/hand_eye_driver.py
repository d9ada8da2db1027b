# SPDX-License-Identifier: Apache-2.0
"""A simulated robot with a sensor before a target; all that it says are messages of ROS types."""

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import cache
from itertools import islice
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np

from bench.hand_eye_cell import ArmRobot, HandEyeCell, SimulatedShots, sphere_shots
from robocal_ros.bags.bag_writer import ros_time
from robocal_ros.cell_sim.cell import rigid_robot
from robocal_ros.cell_sim.sensors import ProfileSensor
from robocal_ros.ground import frames
from robocal_ros.ground.samples import JOINTS
from robocal_ros.hand_eye.data import COMPRESSED, IMAGE, PROFILE, TARGET_POSE, TRACKER_POINT
from robocal_ros.hand_eye.profiles import SensorDescription
from robocal_ros.hand_eye.session import HandEyeSession, take_hand_eye_message
from robocal_ros.hand_eye.targets import SphereTarget, target_document
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.session import events
from robocal_ros.session.events import (
    Command,
    Outcome,
    arguments_text,
    outcome_text,
    read_command,
)

NS = 1_000_000_000
START_NS = 1_700_000_000 * NS
ARM = load_robot("ur10")
CENTRE, RADIUS_M = np.array([0.75, -0.1, 0.15]), 0.02
Q_NEAR = np.radians([-30.0, -100.0, -110.0, -60.0, 90.0, 20.0])
GEOMETRY_M = 1e-4  # of each length, and as much at 1 m of each angle
FRAME = "laser"
LASER = SensorDescription(z_grows="towards")
TYPE = {
    JOINTS: "sensor_msgs/msg/JointState",
    PROFILE: "sensor_msgs/msg/PointCloud2",
    TARGET_POSE: "geometry_msgs/msg/PoseStamped",
    IMAGE: "sensor_msgs/msg/Image",
    COMPRESSED: "sensor_msgs/msg/CompressedImage",
    TRACKER_POINT: "geometry_msgs/msg/PointStamped",
}
SPHERE = {
    "target": target_document("sphere", SphereTarget(RADIUS_M)),
    "method": "best",
    "mount": "in-hand",
    "feature": "edge",
}
CAMERA = SPHERE | {"target": {"kind": "camera"}}
T_BASE_BOARD = frames.transform(frames.exp_rotation([0.1, 0.2, -0.4]), [0.75, -0.1, 0.1])


class Recorded(NamedTuple):
    """A message with its input; its fields as a mapping."""

    kind: str
    stamp_ns: int
    fields: dict[str, Any]


@cache
def sphere_set(count: int = 14) -> tuple[HandEyeCell, SimulatedShots]:
    """Shots of a sphere by a UR10 that repeats to 0.02 mm, and errs by some 0.2 mm."""
    rng = np.random.default_rng(8)
    true = rigid_robot(ARM, GEOMETRY_M, rng)
    true.static_error[-1] = 0.0  # nobody can tell it from a shift of the sensor
    effects = replace(true.effects, noise=True)
    true = replace(true, repeatability=1e-5, effects=effects)
    robot = ArmRobot(true, Q_NEAR)
    cell = HandEyeCell(ProfileSensor(columns=320), robot, roll_rad=0.5)
    return cell, sphere_shots(cell, CENTRE, RADIUS_M, count, rng)


WIDE = ProfileSensor(near_m=0.17, far_m=0.26, half_angle_rad=0.25)


def wide_cell() -> HandEyeCell:
    """The same robot with a sensor that sees 90 mm of depth."""
    return replace(sphere_set()[0], sensor=WIDE)


def namespace(value: Any) -> Any:
    """Fields with the attributes of their message."""
    if isinstance(value, dict):
        return SimpleNamespace(**{name: namespace(part) for name, part in value.items()})
    return [namespace(part) for part in value] if isinstance(value, list) else value


def joints(stamp_ns: int, q: np.ndarray) -> Recorded:
    header = {"stamp": ros_time(stamp_ns), "frame_id": ""}
    fields = {"header": header, "name": list(ARM.joint_names), "position": q.tolist()}
    return Recorded(JOINTS, stamp_ns, fields)


def profile(stamp_ns: int, points: np.ndarray, frame: str = FRAME, y: float = 0.0) -> Recorded:
    """A cloud (32 bit) of points (n, 2)."""
    data = np.insert(np.asarray(points, dtype="<f4"), 1, y, axis=1)
    cloud = {
        "header": {"stamp": ros_time(stamp_ns), "frame_id": frame},
        "height": 1,
        "width": len(data),
        "fields": [
            {"name": name, "offset": 4 * i, "datatype": 7, "count": 1}
            for i, name in enumerate("xyz")
        ],
        "is_bigendian": False,
        "point_step": 12,
        "row_step": 12 * len(data),
        "data": data.tobytes(),
        "is_dense": False,
    }
    return Recorded(PROFILE, stamp_ns, cloud)


def target_pose(stamp_ns: int, T: np.ndarray, frame: str = FRAME) -> Recorded:
    x, y, z = T[:3, 3].tolist()
    turn = dict(zip("xyzw", frames.quat_xyzw(T).tolist(), strict=True))
    pose = {"position": {"x": x, "y": y, "z": z}, "orientation": turn}
    header = {"stamp": ros_time(stamp_ns), "frame_id": frame}
    return Recorded(TARGET_POSE, stamp_ns, {"header": header, "pose": pose})


def tracker_point(stamp_ns: int, point: np.ndarray, frame: str = "tracker") -> Recorded:
    header = {"stamp": ros_time(stamp_ns), "frame_id": frame}
    fields = {"header": header, "point": dict(zip("xyz", point.tolist(), strict=True))}
    return Recorded(TRACKER_POINT, stamp_ns, fields)


class Robot:
    """Moves from pose to pose; `give` takes each message as it arises."""

    def __init__(self, give: Callable[[Recorded], None]) -> None:
        self._give = give
        self._rng = np.random.default_rng(4)
        self.now_ns, self.q = START_NS, Q_NEAR

    def move(self, q: np.ndarray, seconds: float = 0.5) -> None:
        """Drive to joints; the sensor sees something else meanwhile."""
        for share in np.linspace(0.0, 1.0, int(seconds * 50)):
            self._joints((1.0 - share) * self.q + share * q)
        self.q = q

    def rest(
        self, seconds: float = 0.6, shot: Callable[[int], Recorded] | None = None, hz: int = 10
    ) -> None:
        """Stand still; the sensor sends a shot ``hz`` times a second."""
        for i in range(int(seconds * 50)):
            self._joints(self.q + 1e-7 * self._rng.standard_normal(len(self.q)))
            if shot is not None and i % (50 // hz) == 0:
                self._give(shot(self.now_ns - 7_000_000))

    def _joints(self, q: np.ndarray) -> None:
        self.now_ns += NS // 50
        self._give(joints(self.now_ns, q))


class Driver:
    """A robot, a session and all that happened."""

    def __init__(self, session: HandEyeSession) -> None:
        self.session = session
        self.robot = Robot(self.give)
        self.recorded: list[Recorded | Outcome] = []

    def give(self, message: Recorded) -> None:
        """One message, and what follows from it."""
        self.recorded.append(message)
        take_hand_eye_message(self.session, message.kind, namespace(message.fields))
        if (command := self.session.recognised()) is not None:
            self.command(command)

    def ask(self, name: str, **arguments: Any) -> Outcome:
        """Give a command by its name."""
        return self.command(Command(name, arguments))

    def command(self, command: Command) -> Outcome:
        """Give a command and carry it out."""
        self.session.submit(command)
        self.recorded += self.session.step(wall_ns=START_NS + len(self.recorded))
        assert isinstance(self.recorded[-1], Outcome)
        return self.recorded[-1]

    @property
    def outcomes(self) -> list[Outcome]:
        """What came of all commands."""
        return [one for one in self.recorded if isinstance(one, Outcome)]

    @property
    def commands(self) -> list[tuple[Command, Any]]:
        """All of them as a recording tells them, each with what came of it."""
        return [
            (
                read_command(o.command.name, o.command.stamp_ns, arguments_text(o.command)),
                json.loads(outcome_text(o)),
            )
            for o in self.outcomes
        ]

    def sphere(self, count: int = 14) -> None:
        """Start, and capture the sphere from each pose."""
        self.robot.rest(0.1)
        assert self.ask(events.START, **SPHERE).done
        self.capture_sphere(0, count)

    def capture_sphere(self, first: int, last: int) -> None:
        """Capture it from more poses."""
        for q, shot in islice(sphere_shots_of(last), first, None):
            self.robot.move(q)
            self.robot.rest(0.1)
            assert self.ask(events.CAPTURE).done
            self.robot.rest(0.7, shot)


def sphere_shots_of(count: int) -> Iterator[tuple[np.ndarray, Callable[[int], Recorded]]]:
    """Joints of each shot, and the profile there at a stamp."""
    _, shots = sphere_set()
    assert shots.q is not None
    for q, points in zip(shots.q[:count], shots.profiles, strict=False):
        yield q, lambda stamp_ns, points=points: profile(stamp_ns, points)
