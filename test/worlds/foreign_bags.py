# SPDX-License-Identifier: Apache-2.0
"""Recordings as others make them: a tracker that streams over a network beside a robot's driver."""

from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from campaign import ROBOT, postures, true_arm
from recordings import T_SENSOR_BASE, warmed
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_typestore

from robocal_ros.ground.frames import exp_rotation, quat_xyzw, transform
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.robots import load_robot

NS = 1_000_000_000
START_NS = 1_600_000_000 * NS
POSES, MOVE_S, STAND_S = 10, 1.5, 2.5
JOINTS_HZ, TRACKER_HZ = 50, 60
T_FLANGE_BODY = transform(exp_rotation(np.array([0.1, 0.4, -0.2])), [0.06, -0.02, 0.11])
POSITION_M, TURN_RAD = 3e-5, 5e-5  # noise of a tracker with orientation
LATENCY_S, CLOCK_AHEAD_S = 0.14, 1234.5
JOINT_TOPIC, BODY_TOPIC = "/robot/driver/joint_states", "/tracker/body/pose"

Recorded = tuple[int, str, str, dict[str, Any]]  # receipt, topic, type, fields


def way(q: np.ndarray) -> Callable[[float], np.ndarray]:
    """Joints at a time, s: from pose to pose with a pause at each, without a jerk of speed."""

    def at(now_s: float) -> np.ndarray:
        step, since = divmod(now_s, MOVE_S + STAND_S)
        i = min(int(step), len(q) - 1)
        share = min(since / MOVE_S, 1.0)
        smooth = share**3 * (10.0 - 15.0 * share + 6.0 * share**2)
        before = q[max(i - 1, 0)]
        return np.asarray(before + smooth * (q[i] - before))

    return at


def received_ns(at_s: float) -> int:
    """When a network delivers what was measured: late, and in each two seconds 0.4 s at once."""
    arrives = at_s + LATENCY_S
    held = arrives % 2.0
    return round((arrives + (0.4 - held if held < 0.4 else 0.0)) * 1e9)


def visits() -> list[tuple[SerialArm, float]]:
    """A cold robot and the same one twice warm, each from a time, s."""
    cold = true_arm()
    return [(cold, 0.0), (warmed(cold, 20.0), 3600.0), (warmed(cold, 30.0), 7200.0)]


def stream() -> Iterator[Recorded]:
    """The recording, in order of receipt, by which the tracker's computer stamps, on its clock."""
    nominal, rng = load_robot(ROBOT), np.random.default_rng(5)
    at = way(postures(true_arm(), POSES, 21))
    names = sorted(nominal.joint_names, reverse=True)
    order = [nominal.joint_names.index(name) for name in names]
    recorded: list[Recorded] = []
    for arm, start_s in visits():
        length_s = POSES * (MOVE_S + STAND_S)
        for now_s in np.arange(0.0, length_s, 1.0 / JOINTS_HZ):
            now_ns = START_NS + round((start_s + now_s) * 1e9)
            fields = {"name": names, "position": at(now_s)[order], "velocity": np.zeros(0)}
            fields |= {"header": stamped(now_ns, ""), "effort": np.zeros(0)}
            recorded.append((now_ns + 300_000, JOINT_TOPIC, "sensor_msgs/msg/JointState", fields))
        times = np.arange(0.0, length_s - 0.1, 1.0 / TRACKER_HZ)
        flange = arm.fk(np.array([at(now_s) for now_s in times]))
        for now_s, T in zip(times, T_SENSOR_BASE @ flange @ T_FLANGE_BODY, strict=True):
            x = T[:3, 3] + POSITION_M * rng.normal(size=3)
            noisy = T[:3, :3] @ exp_rotation(TURN_RAD * rng.normal(size=3))
            quat = quat_xyzw(transform(noisy, x))
            log_ns = START_NS + received_ns(start_s + now_s)
            header = stamped(log_ns + round(CLOCK_AHEAD_S * 1e9), "/hall")
            fields = {
                "header": header,
                "child_frame_id": "body",
                "transform": {
                    "translation": dict(zip("xyz", x, strict=True)),
                    "rotation": dict(zip("xyzw", quat, strict=True)),
                },
            }
            recorded.append((log_ns, BODY_TOPIC, "geometry_msgs/msg/TransformStamped", fields))
    yield from sorted(recorded, key=lambda one: one[0])


def stamped(at_ns: int, frame: str) -> dict[str, Any]:
    return {"stamp": {"sec": at_ns // NS, "nanosec": at_ns % NS}, "frame_id": frame}


def _message(store: Any, msgtype: str, fields: dict[str, Any], seq: int) -> Any:
    """A message of a type from its fields; ROS 1 numbers its headers."""
    values = {}
    for name, (_, part) in store.fielddefs[msgtype][1]:
        value = fields.get(name, seq)
        values[name] = _message(store, part, value, seq) if isinstance(value, dict) else value
    return store.types[msgtype](**values)


def write_ros1(path: Path, recorded: Iterable[Recorded]) -> Path:
    """The recording as `rosbag record` of ROS 1 keeps it."""
    store, connections = get_typestore(Stores.ROS1_NOETIC), {}
    with Ros1Writer(path) as writer:
        for seq, (log_ns, topic, msgtype, fields) in enumerate(recorded):
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            message = _message(store, msgtype, fields, seq)
            writer.write(connections[topic], log_ns, store.serialize_ros1(message, msgtype))
    return path


def write_sqlite(path: Path, recorded: Iterable[Recorded]) -> Path:
    """The recording as `ros2 bag record` kept it before Iron: SQLite."""
    store, connections = get_typestore(Stores.ROS2_HUMBLE), {}
    with Ros2Writer(path, version=8, storage_plugin=StoragePlugin.SQLITE3) as writer:
        for log_ns, topic, msgtype, fields in recorded:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, msgtype, typestore=store)
            message = _message(store, msgtype, fields, 0)
            writer.write(connections[topic], log_ns, store.serialize_cdr(message, msgtype))
    return path
