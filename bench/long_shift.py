# SPDX-License-Identifier: Apache-2.0
"""A long simulated shift as a bag, to time its replay: as many messages as a real one has.

The robot and its sensor are those of the other simulated shifts; nothing goes wrong. Joint states
come at 125 Hz without pause, motor temperatures once a second, clouds of the sphere in every cycle.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from heapq import merge
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bench.measured_shifts import MEASURING, MOVE_S, Shift, ShiftPlan, poses, simulate
from robocal_ros.bags.bag_writer import BagWriter, ros_time
from robocal_ros.bags.mcap_files import encode
from robocal_ros.cell_sim import kr150
from robocal_ros.cell_sim.beams import readings
from robocal_ros.cell_sim.sensors import sphere_cloud
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]
Record = tuple[float, str, str, bytes]

ROBOT = "kr150_r3100"
START_NS = 1_767_592_800_000_000_000
SEED = 11
DUTY = np.array([0.6, 0.9, 1.0, 0.7, 0.8, 0.5])
ROUNDS = 3  # of the cold robot
PERIOD_S = 300.0
JOINTS_HZ = 125.0
POINTS = 2000
AT_ONCE = 100_000  # joint states made together
JOINTS, CLOUD, WARMTH = "joint_states", "sphere_cloud", "motor_temperatures"
JOINT_STATE = "sensor_msgs/msg/JointState"


@dataclass(frozen=True)
class LongShift:
    """A bag, and when its robot was measured: the cold reference first, s from its start."""

    path: Path
    windows: list[tuple[float, float]]
    duration_s: float
    joint_states: int


def write_shift(path: Path, hours: float) -> LongShift:
    """Simulate a shift of some hours after its cold reference, and write its bag."""
    course, joints, clouds, warmth = np.random.default_rng(SEED).spawn(4)
    robot = kr150.true_robot(load_robot(ROBOT), course, None)
    measuring = poses("sphere")[list(MEASURING)]
    reference = np.tile(measuring, (ROUNDS, 1))
    phases = ((hours, 1.0),)
    plan = ShiftPlan(reference, measuring, poses("check"), phases, DUTY, PERIOD_S)
    sensor = kr150.sphere_sensor(None)
    shift = simulate(robot, sensor, kr150.WARM_UP, plan, kr150.TOOL, course)
    end_s = float(shift.path.depart[-1])
    names = list(robot.nominal.joint_names)
    times = np.arange(1.0 / JOINTS_HZ, end_s, 1.0 / JOINTS_HZ)
    records = merge(
        _joint_states(shift, names, times, joints),
        _clouds(shift, clouds),
        _temperatures(shift, names, warmth),
        key=lambda record: record[0],
    )
    with BagWriter(path) as bag:
        for time_s, topic, kind, message in records:
            bag.write(topic, kind, message, _stamp(time_s))
    first_s = {visit.cycle: visit.time_s for visit in reversed(shift.visits)}
    windows = [(max(first_s[c.name] - MOVE_S, 0.0), c.time_s) for c in shift.cycles]
    return LongShift(path, windows, end_s, len(times))


def _stamp(time_s: float) -> int:
    return START_NS + round(time_s * 1e6) * 1000


def _header(time_s: float, frame: str = "") -> dict[str, object]:
    return {"stamp": ros_time(_stamp(time_s)), "frame_id": frame}


def joint_state(names: list[str], time_s: float = 0.0) -> bytes:
    """A serialized joint state with velocities and efforts, as a driver publishes it."""
    zeros = np.zeros(len(names))
    values = {"position": zeros, "velocity": zeros, "effort": zeros}
    return bytes(encode(JOINT_STATE, {"header": _header(time_s), "name": names, **values}))


def _joint_states(
    shift: Shift, names: list[str], times: Array, rng: np.random.Generator
) -> Iterator[Record]:
    """Only stamp and positions differ from message to message: they are put into the bytes."""
    message, count = joint_state(names), 8 * len(names)
    mark = np.full(len(names), 1.5)
    marked = {"header": _header(0.0), "name": names, "position": mark}
    at = bytes(encode(JOINT_STATE, marked)).index(mark.tobytes())
    for first in range(0, len(times), AT_ONCE):
        part = times[first : first + AT_ONCE]
        rows = readings(shift.path, part, rng).tobytes()
        for i, time_s in enumerate(part.tolist()):
            sec, nanosec = divmod(_stamp(time_s), 1_000_000_000)
            stamp = sec.to_bytes(4, "little") + nanosec.to_bytes(4, "little")
            head, tail = message[12:at], message[at + count :]
            row = rows[i * count : (i + 1) * count]
            yield time_s, JOINTS, JOINT_STATE, message[:4] + stamp + head + row + tail


def _clouds(shift: Shift, rng: np.random.Generator) -> Iterator[Record]:
    kind = "sensor_msgs/msg/PointCloud2"
    fields = [
        {"name": name, "offset": 4 * i, "datatype": 7, "count": 1} for i, name in enumerate("xyz")
    ]
    for visit in shift.visits:
        points = np.round(sphere_cloud(visit.position, POINTS, rng), 6).astype("<f4")
        message = {
            "header": _header(visit.time_s, "sensor/ball"),
            "height": 1,
            "width": POINTS,
            "fields": fields,
            "is_bigendian": False,
            "point_step": 12,
            "row_step": 12 * POINTS,
            "data": np.frombuffer(points.tobytes(), dtype=np.uint8),
            "is_dense": True,
        }
        yield visit.time_s + 0.15, CLOUD, kind, bytes(encode(kind, message))


def _temperatures(shift: Shift, names: list[str], rng: np.random.Generator) -> Iterator[Record]:
    kind = "sensor_msgs/msg/Temperature"
    seconds = np.arange(0.5, shift.path.depart[-1], 1.0)
    rise = [np.interp(seconds, shift.temperature_time_s, t) for t in shift.temperatures.T]
    values = np.round(22.0 + np.array(rise).T + 0.1 * rng.standard_normal((len(seconds), 1)), 1)
    for time_s, row in zip(seconds.tolist(), values, strict=True):
        for name, value in zip(names, row.tolist(), strict=True):
            message = {"header": _header(time_s, name), "temperature": value, "variance": 0.01}
            yield time_s, WARMTH, kind, bytes(encode(kind, message))
