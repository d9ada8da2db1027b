# SPDX-License-Identifier: Apache-2.0
"""A planner that streams joint targets, or a robot that goes to the newest of them: a process each.

The robot is a simulated forward_command_controller at 250 Hz: in each cycle it goes to the newest
command, and holds the last one where none came. At its end it prints its places as JSON.
"""

import json
import sys
import time
from array import array
from typing import Any

import numpy as np
import rclpy
from rclpy.node import Node
from rclpy.qos import QoSProfile
from sensor_msgs.msg import JointState

NAMES = [f"joint_a{i}" for i in range(1, 7)]
PERIOD_S = 0.004
BEGIN = np.array([-1.2, -1.2, 1.2, 0.4, 0.9, -0.3])
SPEED_RAD_S = np.radians(60.0)
RAMP_S, LASTS_S = 0.3, 2.3  # to full speed; all of it
REST_S = 0.5  # the robot is known to stand before
NEWEST = QoSProfile(depth=1)


def place(t: float) -> float:
    """Of joint 1 after ``t`` s, from rest to a constant speed."""
    return float(SPEED_RAD_S * (0.5 * t * t / RAMP_S if t < RAMP_S else t - 0.5 * RAMP_S))


WAY_RAD = place(LASTS_S)


def state(q: np.ndarray) -> JointState:
    message = JointState(name=NAMES, position=array("d", q))
    message.header.stamp.sec, message.header.stamp.nanosec = divmod(time.time_ns(), 10**9)
    return message


def cycles(node: Node) -> Any:
    """Seconds since the begin, at the period; a cycle that comes too late is left out."""
    begin = time.monotonic()
    due = begin
    while rclpy.ok():
        due = max(due + PERIOD_S, time.monotonic())
        time.sleep(max(due - time.monotonic(), 0.0))
        for _ in range(4):
            rclpy.spin_once(node, timeout_sec=0.0)
        yield time.monotonic() - begin


def plan(node: Node) -> None:
    targets = node.create_publisher(JointState, "joint_targets", 10)
    while not targets.get_subscription_count():
        time.sleep(0.05)
    for t in cycles(node):
        if t > REST_S + LASTS_S:
            return
        if t > REST_S:
            q = BEGIN.copy()
            q[0] += place(t - REST_S)
            targets.publish(state(q))


def follow(node: Node) -> None:
    q, places = BEGIN.copy(), []
    newest: list[JointState] = []
    node.create_subscription(JointState, "commands", newest.append, NEWEST)
    states = node.create_publisher(JointState, "joint_states", 10)
    moved_s = None
    for t in cycles(node):
        if newest:
            q = np.array(newest[-1].position)
            newest.clear()
            moved_s = t
        places.append((time.monotonic(), q[0]))
        states.publish(state(q))
        if moved_s is not None and t - moved_s > 1.0:
            print(json.dumps(places), flush=True)
            return


if __name__ == "__main__":
    rclpy.init()
    part = sys.argv[1]
    {"plan": plan, "follow": follow}[part](rclpy.create_node(part))
