# SPDX-License-Identifier: Apache-2.0
"""A node that is stopped for a while (SIGSTOP) in a fast stream: what the robot then does.

Planner, node and robot are a process each, the robot a simulated forward_command_controller.
"""

import json
import signal
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from joint_correction_live import NODE, drifted, model_message
from robocal_msgs.msg import CorrectionStatus, KinematicModel
from sensor_msgs.msg import JointState
from stream_parts import BEGIN, PERIOD_S, WAY_RAD

from robocal_ros.ros import endpoints

PARTS = Path(__file__).parents[1] / "worlds" / "stream_parts.py"
DIRECT_RUNS = 10
MOST = 1.1  # of the largest step of the direct runs
STALLED_AT = BEGIN[0] + 0.8
STALLS = (0.05, False), (0.15, False), (0.5, False), (0.05, True), (0.15, True)  # s, corrected


def run(graph: Any, commands: str, node: Any = None, stall_s: float = 0.0) -> np.ndarray:
    """Where joint 1 of the robot was in each cycle; ``node`` is stopped for so long."""
    robot = graph.start(PARTS, None, {"commands": commands}, "follow")
    graph.spin_until(lambda: graph.probe.count_publishers("joint_states"), "the robot", 20.0)
    graph.start(PARTS, None, None, "plan")
    if node is not None:
        inbox = graph.collect(JointState, commands)
        graph.spin_until(lambda: inbox and inbox[-1].position[0] > STALLED_AT, "it runs", 20.0)
        node.process.send_signal(signal.SIGSTOP)
        time.sleep(stall_s)
        node.process.send_signal(signal.SIGCONT)
    graph.spin_until(lambda: robot.process.poll() is not None, "the robot has stopped", 30.0)
    return np.array(json.loads(robot.output.splitlines()[-1]))


def started(graph: Any, status: list[CorrectionStatus], on: bool) -> Any:
    """The node, which has taken the model over."""
    node = graph.start("joint_correction_node", {"serial": "s1", "enable_on_start": on})
    status.clear()
    graph.spin_until(
        lambda: status and status[-1].model_revision and status[-1].enabled == on,
        "the node's status",
        20.0,
    )
    return node


def largest_step(places: np.ndarray) -> float:
    """From one of the robot's cycles to the next; those that the machine left out count."""
    cycles = np.maximum(np.round(np.diff(places[:, 0]) / PERIOD_S), 1.0)
    return float(np.max(np.abs(np.diff(places[:, 1])) / cycles))


def test_no_step_is_larger_than_without_the_node(graph: Any) -> None:
    direct = [run(graph, "joint_targets") for _ in range(DIRECT_RUNS)]
    allowed = MOST * max(largest_step(places) for places in direct)
    status = graph.collect(CorrectionStatus, f"{NODE}/status", endpoints.LATCHED)
    models = graph.probe.create_publisher(KinematicModel, "kinematic_model", endpoints.LATCHED)
    models.publish(model_message(drifted()))
    for stall_s, on in STALLS:
        node = started(graph, status, on)
        places = run(graph, f"{NODE}/joint_targets", node, stall_s)
        assert largest_step(places) <= allowed, (stall_s, on)
        if stall_s == STALLS[0][0]:  # it goes on, and is there in the end
            assert np.ptp(places[:, 1]) == pytest.approx(WAY_RAD, abs=0.02)
        node.stop()
