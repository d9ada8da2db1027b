# SPDX-License-Identifier: Apache-2.0
"""joint_correction_node, stopped for a while (SIGSTOP) in a fast stream: what the robot then does.

``tools/with_ros python -m bench.soak_stalls``; with ``--keep`` it writes
docs/figures/soak_stalls.md too. Planner, node and robot are a process each, the robot a simulated
forward_command_controller (`stream_parts`).
"""

import json
import os
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from itertools import product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from robocal_msgs.msg import CorrectionStatus, KinematicModel
from sensor_msgs.msg import JointState

from bench.soaking import soak_main
from bench.startup import EXECUTABLES
from bench.stream_parts import BEGIN, PERIOD_S, SPEED_RAD_S, WAY_RAD
from bench.stream_probe import TARGETS, Probe, Subject, drifted, offered
from bench.tables import Goal, Table
from robocal_ros.kinematics.robots import load_robot

Array = NDArray[np.float64]

CELL, NODE = "stalls", "joint_correction_node"
DIRECT_RUNS = 10
MOST = 1.1  # of the largest step of the direct runs
STALLED_AT = BEGIN[0] + 0.8
LENGTHS_S = 0.05, 0.15, 0.5  # of the stalls, each with the correction off and on
MADE_GOOD_S = 0.05  # what is caught up with on the way that the stream still has
ARRIVES_RAD = 0.02
LARGEST_M = 0.5e-3
READY_WITHIN_S = 60.0


def run(probe: Probe, commands: str, node: Subject | None = None, stall_s: float = 0.0) -> Array:
    """Times and places (m, 2) of the robot's joint 1 in each cycle; ``node`` is stopped so long."""
    with tempfile.TemporaryDirectory() as folder, ExitStack() as parts:

        def start(part: str) -> Subject:
            program = sys.executable, "-m", "bench.stream_parts", part
            (place := Path(folder, part)).mkdir()
            remap = "--ros-args", "-r", f"commands:={commands}"
            parts.callback((subject := Subject(CELL, part, [*program, *remap], place)).close)
            return subject

        robot, places = start("follow"), list[float]()
        states = robot.topic("joint_states")
        probe.wait(lambda: probe.node.count_publishers(states), "the robot")
        take = lambda message: places.append(message.position[0])  # noqa: E731 (rclpy looks at it)
        heard = probe.node.create_subscription(JointState, robot.topic(commands), take, 10)
        start("plan")
        if node is not None:
            probe.wait(lambda: places and places[-1] > STALLED_AT, "the stream")
            node.process.send_signal(signal.SIGSTOP)
            time.sleep(stall_s)
            node.process.send_signal(signal.SIGCONT)
        probe.wait(lambda: robot.process.poll() is not None, "the robot to stop")
        probe.node.destroy_subscription(heard)
        return np.array(json.loads(robot.log.read_text().splitlines()[-1]))


def largest_step(places: Array) -> float:
    """From one of the robot's cycles to the next; those that the machine left out count."""
    cycles = np.maximum(np.round(np.diff(places[:, 0]) / PERIOD_S), 1.0)
    return float(np.max(np.abs(np.diff(places[:, 1])) / cycles))


@contextmanager
def started(probe: Probe, on: bool) -> Iterator[Subject]:
    """The node, which has taken the model over and is alone."""
    arm, words = load_robot("kr150_r3100"), f"enable_on_start:={str(on).lower()}"
    robot = "--ros-args", "-p", "robot:=kr150_r3100", "-p", words
    with tempfile.TemporaryDirectory() as folder:
        node = Subject(CELL, NODE, [EXECUTABLES / NODE, *robot], Path(folder))
        try:
            models = probe.model_publisher(node)
            model = drifted(arm, LARGEST_M)
            models.publish(offered(arm, model, 1, KinematicModel.ACCEPTED))
            told = probe.latest(CorrectionStatus, node.topic(f"{NODE}/status"))

            def ready() -> bool:
                now = told[-1] if told else None
                return now is not None and now.model_revision > 0 and now.enabled == on

            probe.wait(ready, f"the node: {node.log.read_text()}", READY_WITHIN_S)
            probe.wait(lambda: not told[-1].commanders, "the node before it to be gone")
            probe.node.destroy_publisher(models)
            yield node
        finally:
            node.close()


def soak(direct_runs: int) -> Table:
    """Without the node, then with it, which is stopped on the way."""
    table = Table(
        "soak_stalls",
        f"joint_correction_node stopped at {1.0 / PERIOD_S:.0f} Hz and "
        f"{np.degrees(SPEED_RAD_S):.0f} deg/s: largest step of the robot in a cycle",
        ("stopped for, ms", "correction", "largest step, deg", "of the largest without it", "goal"),
        f"Direct: the planner at the controller, {direct_runs} runs. The node is stopped by "
        "SIGSTOP. The correction: of a drift of up to 0.5 mm. Load of the machine in the last "
        "minute: "
        f"{{load:.2f}}; {os.cpu_count()} CPUs.",
    )
    probe = Probe()
    try:
        steps = [largest_step(run(probe, TARGETS)) for _ in range(direct_runs)]
        largest = max(steps)
        for words, step in (("smallest", min(steps)), ("largest", largest)):
            degrees = float(np.degrees(step))
            table.add(f"direct, {words} of all", None, degrees, step / largest, None)
        for on, stall_s in product((False, True), LENGTHS_S):
            with started(probe, on) as node:
                places = run(probe, f"{NODE}/{TARGETS}", node, stall_s)
            step = largest_step(places)
            degrees, share = float(np.degrees(step)), step / largest
            on_off = "on" if on else "off"
            table.add(f"{1e3 * stall_s:.0f}", on_off, degrees, share, Goal(share, MOST))
            if stall_s <= MADE_GOOD_S:
                off = float(np.degrees(abs(np.ptp(places[:, 1]) - WAY_RAD)))
                words = f"{1e3 * stall_s:.0f}: from its end at last, deg"
                table.add(words, on_off, off, None, Goal(off, float(np.degrees(ARRIVES_RAD))))
    finally:
        probe.close()
    table.remark = table.remark.format(load=os.getloadavg()[0])
    return table


def main(arguments: Sequence[str] | None = None) -> int:
    """1 when a goal is missed."""
    return soak_main("soak_stalls", soak, __doc__, arguments, "runs", DIRECT_RUNS)


if __name__ == "__main__":
    sys.exit(main())
