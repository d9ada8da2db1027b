# SPDX-License-Identifier: Apache-2.0
"""A robot that streams joint targets and states through a process, and times what comes back."""

import contextlib
import gc
import os
import struct
import subprocess
import time
from array import array
from collections import defaultdict, deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from numpy.typing import NDArray
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.serialization import serialize_message
from rclpy.task import Future
from robocal_msgs.msg import KinematicModel
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from bench.processes import resident_mb
from robocal_ros.correction.joint_correction import JointCorrection
from robocal_ros.kinematics import SerialArm
from robocal_ros.kinematics.arm import model_document
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import header, kinematic_model

Array = NDArray[np.float64]

TARGETS, STATES = "joint_targets", "joint_states"
SERIAL = "STREAM-1"
STAMP_AT = 4  # of the stamp in a serialized message: after the encapsulation
LEAD_S, DRAIN_S = 0.4, 0.3  # a robot is known to stand after 0.2 s
PATIENCE_S = 20.0
MIDDLE = np.radians([0.0, -80.0, 100.0, 10.0, 40.0, 0.0])
SWING, RATES = 0.3, np.linspace(0.3, 0.8, 6)


def path(t_s: float) -> tuple[Array, Array]:
    """Joints and their speeds, rad and rad/s, of a smooth motion; at t = 0 in its middle."""
    return MIDDLE + SWING * np.sin(RATES * t_s), SWING * RATES * np.cos(RATES * t_s)


def drifted(arm: SerialArm, largest_m: float, seed: int = 1) -> SerialArm:
    """The arm after a drift that moves the tool by at most this along the path."""
    q = np.array([path(t)[0] for t in np.linspace(0.0, 60.0, 200)])
    change = np.random.default_rng(seed).normal(size=arm.mdh.shape) * 1e-5
    moved = JointCorrection.between(arm, arm.with_mdh(arm.mdh + change)).correct(q).tcp_shift_m
    return arm.with_mdh(arm.mdh + change * (largest_m / float(np.max(moved))))


def offered(arm: SerialArm, model: SerialArm, revision: int, state: int) -> KinematicModel:
    """A model of an arm as ``thermal_node`` publishes it."""
    return kinematic_model(
        model_document(model),
        serial=SERIAL,
        model_hash=arm.model_hash,
        revision=revision,
        state=state,
        stamp=header(time.time_ns(), "base_link"),
    )


class Buffer:
    """A serialized JointState whose stamp, positions and velocities are written in place."""

    def __init__(self, names: Sequence[str]) -> None:
        zeros = np.zeros(len(names))
        message = JointState(name=list(names), position=zeros, velocity=zeros)
        self._data = bytearray(serialize_message(message))
        self._count = len(names)
        self._places: dict[int, list[int]] = {}  # by the length, which frame_id decides

    def filled(self, stamp_ns: int, position: Array, velocity: Array) -> bytes:
        """The message with these values."""
        struct.pack_into("<iI", self._data, STAMP_AT, *divmod(stamp_ns, 10**9))
        for place, values in zip(self._placed(self._data), (position, velocity), strict=True):
            self._data[place : place + values.nbytes] = values.tobytes()
        return bytes(self._data)

    def joints(self, data: bytes) -> tuple[Array, Array]:
        """Positions and velocities in a message of the same joints."""
        places = self._placed(data)
        position, velocity = (np.frombuffer(data, np.float64, self._count, at) for at in places)
        return position, velocity

    def _placed(self, data: bytes | bytearray) -> list[int]:
        if len(data) not in self._places:
            self._places[len(data)] = _doubles_in(data)
        return self._places[len(data)]


def _doubles_in(data: bytes | bytearray) -> list[int]:
    """Where positions and velocities of a serialized JointState begin (OMG CDR, plain)."""
    at = STAMP_AT + 8

    def count() -> int:
        nonlocal at
        at = -(-at // 4) * 4
        at += 4
        return int(struct.unpack_from("<I", data, at - 4)[0])

    frame_id = count()
    at += frame_id
    for _ in range(count()):
        name = count()
        at += name
    places = []
    for _ in range(2):
        size = 8 * count()
        places.append(-(-(at - STAMP_AT) // 8) * 8 + STAMP_AT)
        at = places[-1] + size
    return places


def stamp_of(data: bytes) -> int:
    """Stamp of a serialized message, ns."""
    sec, nanosec = struct.unpack_from("<iI", data, STAMP_AT)
    return int(sec * 10**9 + nanosec)


class Subject:
    """A process that takes joint messages in its namespace and puts them out below its name."""

    def __init__(self, name: str, node: str, command: Sequence[object], folder: Path) -> None:
        self.name, self.node = name, node
        words = [*map(str, command), "--ros-args", "-r", f"__ns:=/{name}"]
        given = ("-p", f"serial:={SERIAL}")
        self.log = folder / f"{name}.log"
        with self.log.open("w") as log:
            self.process = subprocess.Popen(
                [*words, *given],
                env=os.environ | {"ROBOCAL_STATE": str(folder)},
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def topic(self, name: str) -> str:
        """Name of an input; outputs lie below the node's name."""
        return f"/{self.name}/{name}"

    def cpu_s(self) -> float:
        """Processor time of all its threads so far."""
        return time.clock_gettime(~self.process.pid << 3 | 2)  # Linux: clock of a process

    def memory_mb(self) -> float:
        """Resident memory."""
        return resident_mb(self.process.pid)

    def close(self) -> None:
        """End the process."""
        self.process.terminate()
        try:
            self.process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Stream:
    """Targets and states of one robot through one subject, half a period apart.

    Attributes
    ----------
    t : where on the path the targets are, s.
    robot : joints that were put out last: the robot is where it is sent.
    took : seconds from publishing to coming back, by topic; since `forget`.
    sent : how many went out, by topic; since `forget`.
    watch : called with when a target that comes back went out and came back (`time.perf_counter`),
        and with its taught and corrected positions.
    """

    def __init__(self, probe: "Probe", subject: Subject, names: Sequence[str]) -> None:
        self.subject, self.names = subject, tuple(names)
        self._buffer = Buffer(names)
        self.t = 0.0
        self._pending: dict[tuple[str, int], tuple[float, Array]] = {}
        self.robot = path(0.0)[0]
        self.watch: Callable[[float, float, Array, Array], object] = lambda *_: None
        self.forget()
        self._publishers = {}
        for topic in (TARGETS, STATES):
            name = subject.topic(topic)
            self._publishers[topic] = probe.node.create_publisher(
                JointState, name, endpoints.RELIABLE
            )
            probe.node.create_subscription(
                JointState,
                subject.topic(f"{subject.node}/{topic}"),
                self._taker(topic),
                endpoints.RELIABLE,
                raw=True,
            )

    def forget(self) -> None:
        """Drop what was measured so far."""
        self.took: dict[str, array[float]] = defaultdict(lambda: array("d"))
        self.sent: dict[str, int] = defaultdict(int)
        self._pending.clear()

    @property
    def connected(self) -> bool:
        """Whether the subject hears the streams."""
        return all(p.get_subscription_count() for p in self._publishers.values())

    @property
    def missing(self) -> int:
        """Messages without an answer."""
        return len(self._pending)

    def _taker(self, topic: str) -> Callable[[bytes], None]:
        def come_back(data: bytes) -> None:
            now, stamp = time.perf_counter(), stamp_of(data)
            begun, taught = self._pending.pop((topic, stamp), (None, None))
            if begun is None or taught is None:
                return
            self.took[topic].append(now - begun)
            if topic == TARGETS:
                self.robot = self._buffer.joints(data)[0].copy()  # the robot is where it is sent
                self.watch(begun, now, taught, self.robot)

        return come_back

    def send_target(self, dt_s: float) -> None:
        """The next target along the path."""
        self.t += dt_s
        self._send(TARGETS, *path(self.t))

    def send_state(self) -> None:
        """Where the robot is."""
        self._send(STATES, self.robot, np.zeros(len(self.robot)))

    def _send(self, topic: str, position: Array, velocity: Array) -> None:
        stamp = time.time_ns()
        data = self._buffer.filled(stamp, position, velocity)
        self.sent[topic] += 1
        self._pending[topic, stamp] = time.perf_counter(), position
        self._publishers[topic].publish(data)


class Probe:
    """The process that streams; collects no garbage while it does."""

    def __init__(self) -> None:
        rclpy.init()
        self.node = rclpy.create_node("probe", start_parameter_services=False)
        self._executor = EventsExecutor()
        self._executor.add_node(self.node)

    def spin(self, seconds: float) -> None:
        """Take what comes for so long."""
        self._executor.spin_until_future_complete(Future(), timeout_sec=seconds)

    def wait(
        self, condition: Callable[[], object], what: str, patience_s: float = PATIENCE_S
    ) -> None:
        """Spin until something holds."""
        deadline = time.monotonic() + patience_s
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {patience_s:g} s for {what}")
            self.spin(0.005)

    def stream(self, stream: Stream, rate_hz: float, seconds: float) -> None:
        """States and targets by turns; targets begin a little later, where the robot stands."""
        ticks, begin = 0, 2 * round(LEAD_S * rate_hz)

        def tick() -> None:
            nonlocal ticks
            ticks += 1
            if ticks % 2:
                stream.send_state()
            elif ticks >= begin:
                stream.send_target(1.0 / rate_hz if ticks > begin else 0.0)

        gc.collect()
        gc.disable()
        timer = self.node.create_timer(0.5 / rate_hz, tick)
        self.spin(LEAD_S + seconds)
        self.node.destroy_timer(timer)
        gc.enable()

    def drain(self) -> None:
        """Take what is still under way."""
        self.spin(DRAIN_S)

    def enable(self, subject: Subject) -> None:
        """Switch the correction on."""
        client = self.node.create_client(SetBool, subject.topic(f"{subject.node}/enable"))
        self.wait(client.service_is_ready, f"{subject.node}'s service")
        done = client.call_async(SetBool.Request(data=True))
        self.wait(done.done, "enable")
        self.node.destroy_client(client)

    def model_publisher(self, subject: Subject) -> Any:
        """Where the subject hears of models."""
        return self.node.create_publisher(
            KinematicModel, subject.topic("kinematic_model"), endpoints.own(endpoints.LATCHED)
        )

    def latest(self, kind: type, topic: str) -> deque[Any]:
        """Where the last message of a latched topic is found."""
        found: deque[Any] = deque(maxlen=1)
        take = lambda message: found.append(message)  # noqa: E731 (rclpy looks at it)
        self.node.create_subscription(kind, topic, take, endpoints.own(endpoints.LATCHED))
        return found

    def close(self, *subjects: Subject) -> None:
        """End everything."""
        for subject in subjects:
            subject.close()
        with contextlib.suppress(Exception):
            self.node.destroy_node()
        rclpy.try_shutdown()
