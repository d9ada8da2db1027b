"""What the maintenance session asks is carried out in the right order."""

import time
from typing import Any

import numpy as np
from trajectory_msgs.msg import JointTrajectory

from robocal_ros.motion.driver import MotionDriver
from robocal_ros.motion.plan import JointPlan
from robocal_ros.nodes.endpoints import EndpointNode
from robocal_ros.nodes.maintenance_driver import MaintenanceDriver
from robocal_ros.sessions.maintenance.requests import Move


def test_the_clock_of_a_motion_is_read_before_it_goes_out(graph: Any) -> None:
    """However long that takes: a robot ahead of its plan would be off it."""
    inbox = graph.collect(JointTrajectory, "/driver/joint_trajectory")
    out_by_then: list[int] = []

    def moves() -> None:
        graph.spin_for(0.3)
        out_by_then.append(len(inbox))

    node = EndpointNode("driver", context=graph.context, use_global_arguments=False)
    motion = MotionDriver(node, ("a",), "", "", lambda report: None, lambda: None, time.monotonic)
    driver = MaintenanceDriver(node, motion, lambda number, answer: None, moves)
    node.trigger_configure()
    node.trigger_activate()
    graph.spin_until(lambda: motion.topic.get_subscription_count() > 0, "the probe listens")
    rest = np.zeros((2, 1))
    driver.carry_out(Move(1, JointPlan(np.array([0.0, 1.0]), rest, rest, rest), 1.0))
    assert out_by_then == [0]
    graph.spin_until(lambda: len(inbox) == 1, "the motion goes out")
    driver.close()
    node.destroy_node()
