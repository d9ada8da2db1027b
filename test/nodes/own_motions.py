"""A node that moves the robot as maintenance_node does, by orders of the test; run as a process.

`MotionDriver` sends, `Mover` supervises and stops; nothing of them is replaced. Orders and reports
are JSON.
"""

import json
import time
from typing import Any

import numpy as np
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from robocal_ros.core.samples import joint_sample
from robocal_ros.motion.driver import CONTROLLER, MotionDriver
from robocal_ros.motion.loading import load_motion
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import MotionReport
from robocal_ros.motion.settings import MOTION, NS, driving_config
from robocal_ros.motion.travel import joint_way
from robocal_ros.nodes import qos
from robocal_ros.nodes.base import HouseNode
from robocal_ros.nodes.run import run
from robocal_ros.nodes.steady_clock import SteadyClock
from robocal_ros.sessions.maintenance.config import MaintenanceConfig
from robocal_ros.sessions.maintenance.mover import FaultError, Mover
from robocal_ros.sessions.maintenance.ways import Route, Ways
from robocal_ros.storage.robots import load_robot

ARM = load_robot("ur10")
HOME = np.radians([2.3, -124.4, -70.9, 107.7, -91.1, 91.8])
TICK_S = 0.01


class OwnMotions(HouseNode):
    """Orders: ``{"go": [...]}`` to joints from rest, ``{"replace": [...]}`` in motion, ``{"stop"}``.

    Reports carry what came of the order: ``moves``, ``arrived``, ``stops``, ``stood``, ``fault``.
    """

    NAME = "own_motions"
    SETTINGS = (*MOTION, *CONTROLLER)

    def configure(self) -> None:
        """Open all."""
        load_motion(ARM)
        config = MaintenanceConfig(
            home=HOME,
            poses=np.empty((0, 6)),
            T_flange_tool=np.eye(4),
            driving=driving_config(self.settings),
            travel_speed_m_s=2.0,
        )
        self._cell = Ways(ARM, config).cell
        self.mover, self._steady = Mover(config, Ways(ARM, config)), SteadyClock(lambda for_s: None)
        self._planned_s = 0.0
        self._last: dict[str, Any] = {}
        self.motion = MotionDriver(
            self,
            ARM.joint_names,
            self.settings["follow_joint_trajectory"],
            self.settings["hard_stop_service"],
            self._reported,
            lambda: self.mover.watch,
            self._steady.now_s,
        )
        self.reports = self.add_output(String, "own/reports", qos.LATCHED)
        self.add_input(JointState, "joint_states", self._take_joints, qos.STREAM)
        self.add_input(String, "own/orders", self._take_order, qos.RELIABLE)
        self.add_timer(TICK_S, self._tick, steady=True)

    def activate(self) -> None:
        """Say so."""
        self._say("ready")

    def cleanup(self) -> None:
        """Take the client down."""
        self.motion.close()

    def _say(self, what: str, **more: Any) -> None:
        self._last = {"what": what, "unix_s": time.time(), **more}
        self.reports.publish(String(data=json.dumps(self._last)))

    def _take_joints(self, message: Any) -> None:
        self.motion.hear(message)
        sample = joint_sample(message)
        q = sample.position[sample.order(ARM.joint_names)]
        self.mover.reading(sample.stamp_ns / NS, q, self._steady.now_s())

    def _take_order(self, message: Any) -> None:
        order, now_s = json.loads(message.data), self._steady.now_s()
        if "stop" in order:
            self._stop("ordered")
            return
        if "go" in order:
            q = self.mover.resting(0.1)
            if q is None:
                self._say("fault", why="the robot does not rest")
                return
            plan = joint_way(self._cell, q, order["go"])
        else:
            q, qd = self.mover.watch.state(now_s, keeps=True)
            ends = np.stack([q, order["replace"]]), np.stack([qd, np.zeros(6)])
            plan = JointPlan(np.array([0.0, order["in_s"]]), *ends, np.zeros((2, 6)))
        self.mover.start(Route(plan, ((0, 0),), (plan.duration_s,)), now_s)
        self.mover.sent(self._steady.now_s())
        self.motion.send(plan, stop=False)
        self._say("moves", lasts_s=plan.duration_s)

    def _stop(self, why: str) -> None:
        plan = self.mover.stop(self._steady.now_s())
        if plan is None:
            self._say("fault", why=f"nothing to stop: {why}")
            return
        self._planned_s = plan.duration_s
        self._say("stops", why=why, planned_s=plan.duration_s)
        self.motion.send(plan, stop=True)

    def _reported(self, report: MotionReport) -> None:
        self.mover.reported(report)
        self._tick()

    def _tick(self) -> None:
        mover, now_s = self.mover, self._steady.now_s()
        mover.look(now_s)
        stopping, stopped = mover.stopping, self._last.get("what") == "stops"
        if (plan := stopping.look(mover.watch, now_s)) is not None:
            self.motion.send(plan, stop=True)
        if stopped and not stopping.under_way:
            self._say("stood", why=self._last["why"], sent=stopping.sent, planned_s=self._planned_s)
        try:
            mover.require_sane(now_s)
        except FaultError as error:
            self._stop(str(error))
        if mover.arrived(now_s):
            self._say("arrived", way=self.motion.way)


if __name__ == "__main__":
    run(OwnMotions)
