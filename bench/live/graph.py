# SPDX-License-Identifier: Apache-2.0
"""A graph of installed executables as processes, and the cell controller that calls them.

Everything passes through DDS, as between real machines.
"""

import os
import signal
import subprocess
import time
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import rclpy
from rclpy.client import Client
from rclpy.context import Context
from rclpy.node import Node
from rclpy.publisher import Publisher
from std_srvs.srv import Trigger

from bench.processes import ENDS_WITH_PARENT, hand_nice_on
from bench.startup import EXECUTABLES
from robocal_ros.ros import endpoints
from robocal_ros.ros.executor import OneThreadExecutor

PATIENCE_S = 30.0
END_S = 5.0


class LiveError(RuntimeError):
    """The cell cannot go on; the message says why."""


class Executable:
    """A node of the install tree as its own process, its words kept in a log file.

    It does not outlive the thread that starts it.
    """

    def __init__(
        self,
        name: str,
        parameters: Mapping[str, object],
        remap: Mapping[str, str],
        folder: Path,
        files: Sequence[Path] = (),
    ) -> None:
        self.name, self.log = name, folder / f"{name}.log"
        self._asked = False
        program = EXECUTABLES / name
        if not program.exists():
            raise LiveError(f"{program} is missing: run make setup")
        start = [*ENDS_WITH_PARENT, str(program), "--ros-args"]
        options = [("--params-file", str(file)) for file in files]
        options += [("-p", f"{key}:={value}") for key, value in parameters.items()]
        options += [("-r", f"{old}:={new}") for old, new in remap.items()]
        with self.log.open("w") as log:
            self._process = subprocess.Popen(
                [*start, *(word for pair in options for word in pair)],
                env=os.environ | {"ROBOCAL_STATE": str(folder / "state")},
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=subprocess.STDOUT,
                # Linux shares cores out by session (autogroup): eight processes in one of many
                # sessions would starve.
                start_new_session=True,
            )
        hand_nice_on(self.pid)

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def check(self) -> None:
        """Raise when it has ended."""
        status = self._process.poll()
        if status is not None:
            raise LiveError(f"{self.name} ended with status {status}:\n{self.log.read_text()}")

    def ask_to_end(self) -> None:
        """As Ctrl-C does, once: at a second one a node ends whatever it still writes."""
        if not self._asked and self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        self._asked = True

    def stop(self) -> None:
        """End it."""
        self.ask_to_end()
        try:
            self._process.wait(END_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class CellController:
    """What a PLC's bridge is in a real cell: it listens, and calls services."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(args=[], context=self._context)
        self._node = Node("cell_controller", context=self._context)
        self._executor = OneThreadExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._executables: list[Executable] = []
        self._clients: dict[str, Client] = {}

    def listen(self, kind: type, topic: str, inbox: deque[Any], profile: Any) -> None:
        """Gather what comes on a topic in ``inbox``."""
        self._node.create_subscription(
            kind, topic, lambda message: inbox.append(message), endpoints.own(profile)
        )

    def publisher(self, kind: type, topic: str) -> Publisher:
        """Offer a topic."""
        return self._node.create_publisher(kind, topic, endpoints.own(endpoints.RELIABLE))

    def start(
        self,
        folder: Path,
        name: str,
        parameters: Mapping[str, object],
        remap: Mapping[str, str] | None = None,
        files: Sequence[Path] = (),
    ) -> None:
        """Start an executable."""
        self._executables.append(Executable(name, parameters, remap or {}, folder, files))

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
                raise LiveError(f"waited {within_s:.0f} s for {what}{logs}")
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
            raise LiveError(f"{name}: {answer.message}")

    @property
    def pids(self) -> dict[str, int]:
        """Each node's process."""
        return {executable.name: executable.pid for executable in self._executables}

    def end_nodes(self) -> None:
        """End every process: all at once, then wait for each."""
        for executable in self._executables:
            executable.ask_to_end()
        for executable in self._executables:
            executable.stop()
        self._executables.clear()

    def close(self) -> None:
        """End every process and leave the graph."""
        self.end_nodes()
        self._executor.shutdown()
        self._node.destroy_node()
        self._context.try_shutdown()
