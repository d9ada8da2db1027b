# SPDX-License-Identifier: Apache-2.0
"""The least that a relay of joint messages costs in rclpy: each goes out as it came.

``python bench/bare_relay.py events`` or ``single``: the executor; ``bytes``: events, and what is
relayed is never made a message, as in joint_correction_node. ROS arguments may follow.
"""

import sys

import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.experimental.events_executor import EventsExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from sensor_msgs.msg import JointState
from trajectory_msgs.msg import JointTrajectory

EXECUTORS = {
    "events": EventsExecutor,
    "bytes": EventsExecutor,
    "single": SingleThreadedExecutor,
}
KINDS = {
    "joint_targets": JointState,
    "joint_states": JointState,
    "joint_trajectory": JointTrajectory,
}


def main(kind_of_relay: str) -> None:
    """Relay each topic to the same one below ``~/`` until the process is ended."""
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)  # a signal ends it at once
    node = rclpy.create_node("relay")
    reliable = QoSProfile(depth=100)
    sensor = QoSProfile(depth=100, reliability=ReliabilityPolicy.BEST_EFFORT)
    for topic, kind in KINDS.items():
        publisher = node.create_publisher(kind, f"~/{topic}", reliable)
        profile = sensor if topic == "joint_states" else reliable
        raw = kind_of_relay == "bytes"
        node.create_subscription(kind, topic, publisher.publish, profile, raw=raw)
    spinning = EXECUTORS[kind_of_relay]()
    spinning.add_node(node)
    while rclpy.ok():
        spinning.spin_until_future_complete(Future(), timeout_sec=0.5)  # as nodes.run does


if __name__ == "__main__":
    main(sys.argv[1])
