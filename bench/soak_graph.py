# SPDX-License-Identifier: Apache-2.0
"""thermal_node and joint_correction_node as processes, and a robot that streams through them."""

import os
import subprocess
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from rclpy.task import Future
from robocal_msgs.msg import KinematicModel
from robocal_msgs.srv import ListCalibrations
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool

from bench.processes import ENDS_WITH_PARENT, resident_mb
from bench.startup import EXECUTABLES
from robocal_ros.ground.errors import Code
from robocal_ros.history.calibrations import CalibrationHistory
from robocal_ros.history.history_records import Proposal
from robocal_ros.kinematics.arm import model_document
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import time_message

SERIAL, ROBOT = "SOAK-1", "kr150_r3100"
THERMAL, CORRECTION = "thermal_node", "joint_correction_node"
STREAMS = {"joint_states": "un-corrected joint state", "joint_targets": "corrected target"}
ONE_STREAM = "stream_gap_s:=10.0"  # a stall of this machine is no new start
STILL_S, GROWS_S = 1.0, 2.0  # a correction begins where the robot stands
LISTED = "~/list"
DRIFT = 2e-5  # m and rad, of each parameter: about a tenth of a millimetre at the tool
ASK_EVERY_S = 0.5
PATIENCE_S = 20.0


class LoadedGraph:
    """Joint states and targets at a fixed rate; how long each takes to come back."""

    RATE_HZ = 125

    def __init__(self, folder: Path) -> None:
        self._arm = load_robot(ROBOT)
        self._accept_a_drift(folder / "state")
        self._sent: dict[tuple[str, int], float] = {}
        self._began = 0
        self._took: dict[str, list[float]] = defaultdict(list)
        self._processes = {
            name: self._start(folder, name, *more)
            for name, more in (
                (THERMAL, ()),
                (CORRECTION, ("-r", f"kinematic_model:=/{THERMAL}/model", "-p", ONE_STREAM)),
            )
        }
        rclpy.init()
        self._node = rclpy.create_node("soak", start_parameter_services=False)
        self._models: list[KinematicModel] = []
        self._node.create_subscription(
            KinematicModel,
            f"/{THERMAL}/model",
            self._models.append,
            endpoints.own(endpoints.LATCHED),
        )
        self._publishers = {topic: self._stream(topic) for topic in STREAMS}
        self._list = self._node.create_client(ListCalibrations, f"/{THERMAL}/list")
        enable = self._node.create_client(SetBool, f"/{CORRECTION}/enable")
        self._wait(lambda: self._models and self._list.service_is_ready(), THERMAL)
        self._wait(
            lambda: (
                enable.service_is_ready()
                and all(p.get_subscription_count() for p in self._publishers.values())
            ),
            CORRECTION,
        )
        enabled = enable.call_async(SetBool.Request(data=True))
        self._wait(enabled.done, "enable")

    def _accept_a_drift(self, state: Path) -> None:
        drifted = self._arm.with_mdh(self._arm.mdh + DRIFT)
        with CalibrationHistory.open(SERIAL, state_dir=state) as history:
            chosen = history.propose(
                Proposal(
                    model_hash=self._arm.model_hash,
                    based_on=0,
                    cycle_id="",
                    stamp_ns=1,
                    created_ns=1,
                    software="",
                    method="",
                    code=Code.ACCEPT,
                    reason="",
                    document={},
                    model=model_document(drifted),
                )
            )
            history.accept(chosen, by="soak", reason="", wall_ns=1)

    def _start(self, folder: Path, name: str, *more: str) -> "subprocess.Popen[bytes]":
        given = ("-p", f"serial:={SERIAL}", "-p", f"robot:={ROBOT}", *more)
        with (folder / f"{name}.log").open("w") as log:
            return subprocess.Popen(
                [*ENDS_WITH_PARENT, str(EXECUTABLES / name), "--ros-args", *given],
                env=os.environ | {"ROBOCAL_STATE": str(folder / "state")},
                stdout=log,
                stderr=subprocess.STDOUT,
            )

    def _stream(self, topic: str) -> Any:
        def come_back(message: JointState) -> None:
            stamp = message.header.stamp
            sent = self._sent.pop((topic, stamp.sec * 10**9 + stamp.nanosec), None)
            if sent is not None:
                self._took[topic].append(time.perf_counter() - sent)

        profile = endpoints.own(endpoints.RELIABLE)
        self._node.create_subscription(JointState, f"/{CORRECTION}/{topic}", come_back, profile)
        return self._node.create_publisher(JointState, topic, profile)

    def _wait(self, condition: Callable[[], object], what: str) -> None:
        deadline = time.monotonic() + PATIENCE_S
        while not condition():
            if time.monotonic() > deadline:
                raise TimeoutError(f"waited {PATIENCE_S:.0f} s for {what}")
            rclpy.spin_once(self._node, timeout_sec=0.02)

    def run(self, seconds: float) -> None:
        """Stream for so long, and ask for the list now and then."""
        begin = time.monotonic()
        tick, asked = 0, 0
        answer: Future | None = None
        while (now := time.monotonic() - begin) < seconds:
            if now >= tick / self.RATE_HZ:
                self._send()
                tick += 1
            if now >= asked * ASK_EVERY_S and (answer is None or answer.done()):
                answer, asked = self._ask(), asked + 1
            left = tick / self.RATE_HZ - (time.monotonic() - begin)
            rclpy.spin_once(self._node, timeout_sec=max(0.0, left))
        for name, process in self._processes.items():
            if process.poll() is not None:
                raise ChildProcessError(f"{name} ended with status {process.returncode}")

    def _send(self) -> None:
        now = time.time_ns()
        self._began = self._began or now
        size = 0.3 * np.clip(((now - self._began) * 1e-9 - STILL_S) / GROWS_S, 0.0, 1.0)
        wave = size * np.sin(now * 1e-9 * np.linspace(0.3, 0.8, self._arm.n))
        middle = np.radians([0.0, -80.0, 100.0, 10.0, 40.0, 0.0])
        for topic, publisher in self._publishers.items():
            message = JointState(name=list(self._arm.joint_names), position=middle + wave)
            message.header.stamp = time_message(now)
            self._sent[topic, now] = time.perf_counter()
            publisher.publish(message)

    def _ask(self) -> Future:
        begin = time.perf_counter()
        future = self._list.call_async(ListCalibrations.Request(limit=10))
        future.add_done_callback(lambda _: self._took[LISTED].append(time.perf_counter() - begin))
        return future

    def forget(self) -> None:
        """Drop what was measured so far."""
        self._took.clear()
        self._sent.clear()

    def lost(self) -> int:
        """Messages that went out a second ago or more and did not come back."""
        late = time.perf_counter() - 1.0
        return sum(sent < late for sent in self._sent.values())

    def latencies(self) -> list[tuple[str, str, list[float]]]:
        """Node, what came back, and the seconds that each took."""
        streams = [(CORRECTION, words, self._took[topic]) for topic, words in STREAMS.items()]
        return [(THERMAL, LISTED, self._took[LISTED]), *streams]

    def memory_mb(self) -> dict[str, float]:
        """Resident memory of each node."""
        return {name: resident_mb(process.pid) for name, process in self._processes.items()}

    def close(self) -> None:
        """End everything."""
        for process in self._processes.values():
            process.terminate()
        for process in self._processes.values():
            try:
                process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._node.destroy_node()
        rclpy.try_shutdown()
