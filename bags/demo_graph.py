"""The demo's graph: installed executables as processes, and the cell controller that calls them.

Everything passes through DDS, as between real machines.
"""

import json
import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from numpy.typing import NDArray
from rclpy.client import Client
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from robocal_msgs.msg import CalibrationQuality, KinematicModel
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.nodes import qos

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
EXECUTABLES = ROOT / "install" / "robocal_ros" / "lib" / "robocal_ros"
PATIENCE_S = 30.0
END_S = 5.0
READINGS = "/demo_robot/joint_states"
POINT_S = 4.0  # between two check poses


class DemoError(RuntimeError):
    """The demo cannot go on; the message says why."""


class Executable:
    """A node of the install tree as its own process, its words kept in a log file."""

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        remap: Mapping[str, str],
        folder: Path,
    ) -> None:
        self.name, self.log = name, folder / f"{name}.log"
        program = EXECUTABLES / name
        if not program.exists():
            raise DemoError(f"{program} is missing: run make setup")
        options = [("-p", f"{key}:={value}") for key, value in parameters.items()]
        options += [("-r", f"{old}:={new}") for old, new in remap.items()]
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                [str(program), "--ros-args", *(word for pair in options for word in pair)],
                env=os.environ | {"ROBOCAL_STATE": str(folder / "state")},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def check(self) -> None:
        """Raise when it has ended."""
        status = self._process.poll()
        if status is not None:
            raise DemoError(f"{self.name} ended with status {status}:\n{self.log.read_text()}")

    def stop(self) -> None:
        """End it as Ctrl-C does."""
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
            try:
                self._process.wait(END_S)
            except subprocess.TimeoutExpired:
                self._process.kill()
                self._process.wait()


class CellController:
    """What a PLC is in a real cell: it knows when a cycle is over and calls the services."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = Node("cell_controller", context=self._context)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._executables: list[Executable] = []
        self._clients: dict[str, Client] = {}
        self.done: deque[String] = deque()
        self.truth: deque[String] = deque()
        self.quality: deque[CalibrationQuality] = deque()
        self.model: deque[KinematicModel] = deque(maxlen=1)
        self.corrected: deque[JointTrajectory] = deque()
        self._status: deque[String] = deque(maxlen=1)
        self._diagnostics: deque[DiagnosticArray] = deque(maxlen=30)
        reliable, latched = qos.RELIABLE, qos.LATCHED
        self.listen(String, "cycle_done", self.done, reliable)
        self.listen(String, "/truth/check_points", self.truth, reliable)
        self.listen(CalibrationQuality, "/thermal_node/quality", self.quality, latched)
        self.listen(KinematicModel, "/thermal_node/model", self.model, latched)
        self.listen(String, "/replay_node/status", self._status, latched)
        self.listen(DiagnosticArray, "/diagnostics", self._diagnostics, reliable)
        self.listen(
            JointTrajectory, "/joint_correction_node/joint_trajectory", self.corrected, reliable
        )
        self._targets = self._node.create_publisher(
            JointTrajectory, "joint_trajectory", qos.own(reliable)
        )
        self._readings = self._node.create_publisher(JointState, READINGS, qos.own(reliable))
        self._way: tuple[float, Array, Array] | None = None  # begin, times, joints of the robot

    def listen(self, kind: type, topic: str, inbox: deque[Any], profile: Any) -> None:
        """Gather what comes on a topic in ``inbox``."""
        self._node.create_subscription(
            kind, topic, lambda message: inbox.append(message), qos.own(profile)
        )

    def start(
        self, folder: Path, name: str, remap: Mapping[str, str] | None = None, **parameters: object
    ) -> None:
        """Start an executable."""
        self._executables.append(Executable(name, parameters, remap or {}, folder))

    def wait(
        self, condition: Callable[[], object], what: str, within_s: float = PATIENCE_S
    ) -> None:
        """Listen until the condition holds."""
        deadline = time.monotonic() + within_s
        while not condition():
            for executable in self._executables:
                executable.check()
            if time.monotonic() > deadline:
                logs = "".join(f"\n--- {e.name}\n{e.log.read_text()}" for e in self._executables)
                raise DemoError(f"waited {within_s:.0f} s for {what}{logs}")
            self._executor.spin_once(timeout_sec=0.02)

    def call(self, kind: type, name: str, **fields: object) -> Any:
        """Call a service and return its answer."""
        client = self._clients.get(name)
        if client is None:
            client = self._clients[name] = self._node.create_client(kind, name)
        self.wait(client.service_is_ready, f"service {name}")
        future = client.call_async(kind.Request(**fields))
        self.wait(future.done, f"the answer of {name}")
        return future.result()

    def trigger(self, name: str) -> None:
        """Call a Trigger that must succeed."""
        answer = self.call(Trigger, name)
        if not answer.success:
            raise DemoError(f"{name}: {answer.message}")

    def pause(self, listener: str, topics: Collection[str]) -> None:
        """Pause the replay and wait until ``listener`` has taken in all that was played.

        A cell that runs in real time needs no such wait: here an hour passes in seconds.
        """
        self._status.clear()
        self.trigger("/replay_node/pause")
        self.wait(lambda: self._status, "the replay's status")
        sent = json.loads(self._status[-1].data)["sent"]
        self.wait(
            lambda: all(self._taken(listener, topic) >= sent[topic] for topic in topics),
            f"{listener} to take in what was played",
        )

    def _taken(self, listener: str, topic: str) -> int:
        """How many messages a node says it has received or lost."""
        for array in reversed(self._diagnostics):
            for status in array.status:
                if status.name == listener:
                    values = {pair.key: pair.value for pair in status.values}
                    return int(values[f"{topic} received"]) + int(values[f"{topic} lost"])
        return -1

    def correct(self, names: list[str], q: Array) -> Array:
        """Send taught joints (m, n) through the correction node and return what comes out."""
        for publisher in (self._targets, self._readings):
            self.wait(lambda p=publisher: p.get_subscription_count() > 0, "the correction node")
        here = self._place(q[0])
        self._readings.publish(self._reading(names, here))
        message = JointTrajectory(joint_names=names)
        for i, joints in enumerate(q):
            point = JointTrajectoryPoint(positions=joints.tolist())
            seconds, rest = divmod((i + 1) * POINT_S, 1.0)
            point.time_from_start.sec = int(seconds)
            point.time_from_start.nanosec = int(rest * 1e9)
            message.points.append(point)
        self.corrected.clear()
        self._targets.publish(message)
        self.wait(lambda: self.corrected, "the corrected trajectory")
        answer = self.corrected[-1]
        if list(answer.joint_names) != names or len(answer.points) != len(q):
            raise DemoError("the corrected trajectory has other joints or points than the taught")
        corrected = np.array([point.positions for point in answer.points])
        times = POINT_S * np.arange(len(q) + 1)
        self._way = time.monotonic(), times, np.vstack([here, corrected])
        return corrected

    def _place(self, first: Array) -> Array:
        """Where (n,) the simulated robot is: it stands at ``first``, then drives what comes out."""
        if self._way is None:
            return first
        begin, times, joints = self._way
        return np.array([np.interp(time.monotonic() - begin, times, row) for row in joints.T])

    def _reading(self, names: list[str], q: Array) -> JointState:
        message = JointState(name=names, position=q.tolist())
        message.header.stamp = self._node.get_clock().now().to_msg()
        return message

    def close(self) -> None:
        """End every process and leave the graph."""
        for executable in self._executables:
            executable.stop()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()
