# SPDX-License-Identifier: Apache-2.0
"""A node that moves the robot as maintenance_node does, by orders of the test; run as a process.

`MotionDriver` sends, `Mover` supervises and stops; what goes out may be lost. Orders and reports
are JSON.
"""

import json
import time
from dataclasses import replace
from typing import Any

import numpy as np
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import JointState
from std_msgs.msg import String

from robocal_ros.ground.samples import joint_sample
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.maintenance.accuracy import MaintenanceConfig
from robocal_ros.maintenance.mover import FaultError, Mover, Route, Ways
from robocal_ros.motion.cell import joint_way, load_motion
from robocal_ros.motion.driver import (
    CONTROLLER,
    MOTION,
    MotionDriver,
    driving_config,
    goal_tolerances,
)
from robocal_ros.motion.plan import JointPlan
from robocal_ros.motion.robot_watch import BEHIND_S, MotionReport
from robocal_ros.motion.stopping import SteadyClock
from robocal_ros.ros import endpoints
from robocal_ros.ros.base import HouseNode, run
from robocal_ros.ros.conversions import NS

ARM = load_robot("ur10")
HOME = np.radians([2.3, -124.4, -70.9, 107.7, -91.1, 91.8])
TICK_S = 0.01
REST_S = 0.1
DEEP = QoSProfile(
    depth=100, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
)


class LossyDriver(MotionDriver):
    """The network loses the next ``lost`` messages."""

    lost = 0

    def _send(self, message: Any, tolerances: Any) -> bool:
        if self.lost > 0:
            self.lost -= 1
            return bool(self.action)
        return super()._send(message, tolerances)


class OwnMotions(HouseNode):
    """Orders: ``go`` to joints, from rest; ``stop``.

    Of either, so many of the first messages are ``lost`` or of joints that the controller does not
    have: ``rejected``; ``late_s``: the first one is sent so late. ``slow``: deceleration of the
    stops of a motion, rad/s^2. Reports: ``moves``, ``arrived``, ``stops``, ``stood``.
    """

    NAME = "own_motions"
    SETTINGS = (*MOTION, *CONTROLLER)

    def configure(self) -> None:
        """Open all."""
        load_motion(ARM)
        self._driving = driving_config(self.settings)
        self._steady = SteadyClock(lambda for_s: None)
        self.mover = self._mover(10.0)
        self._order: dict[str, Any] = {}
        self._stops: dict[str, Any] | None = None
        self._going = False
        self._names = list(ARM.joint_names)
        self.motion = LossyDriver(
            self,
            self._names,
            self.settings["follow_joint_trajectory"],
            self.settings["hard_stop_service"],
            goal_tolerances(ARM, self._driving),
            self._reported,
            lambda: self.mover.watch,
            self._steady.now_s,
        )
        self.reports = self.add_output(String, "own/reports", DEEP)
        self.add_input(JointState, "joint_states", self._take_joints, endpoints.STREAM)
        self.add_input(String, "own/orders", self._take_order, DEEP)
        self.add_timer(TICK_S, self._tick, steady=True)

    def activate(self) -> None:
        """Say so."""
        self._say("ready")

    def cleanup(self) -> None:
        """Take the client down."""
        self.motion.close()

    def _mover(self, slow: float) -> Mover:
        limits = replace(self._driving.limits, stop_deceleration=slow)
        config = MaintenanceConfig(
            home=HOME,
            poses=np.empty((0, 6)),
            T_flange_tool=np.eye(4),
            driving=replace(self._driving, limits=limits),
            travel_speed_m_s=2.0,
        )
        ways = Ways(ARM, config)
        self._cell = ways.cell
        return Mover(config, ways)

    def _say(self, what: str, **more: Any) -> None:
        report = {"what": what, "unix_s": time.time(), **more}
        self.reports.publish(String(data=json.dumps(report)))

    def _take_joints(self, message: Any) -> None:
        late_s = self.motion.hear(message)
        sample = joint_sample(message)
        q = sample.position[sample.order(ARM.joint_names)]
        self.mover.reading(sample.stamp_ns / NS, q, self._steady.now_s() - late_s)
        if late_s > BEHIND_S:  # as maintenance_node
            self.take_waiting("joint_states")

    def _take_order(self, message: Any) -> None:
        self._order = json.loads(message.data)
        if "stop" in self._order:
            self._going = False
            self._stop("ordered")
        else:  # once it rests
            self._going, self.mover = True, self._mover(self._order.get("slow", 10.0))

    def _go(self, q: Any) -> None:
        self._going = False
        plan = joint_way(self._cell, q, self._order["go"])
        self.mover.start(Route(plan, ((0, 0),), (plan.duration_s,)), self._steady.now_s())
        self.mover.watch.sent(self._steady.now_s())
        self._send(plan, stop=False)
        self._say("moves", lasts_s=plan.duration_s)

    def _send(self, plan: JointPlan, *, stop: bool) -> None:
        order, names = self._order, list(ARM.joint_names)
        self.motion.lost += order.pop("lost", 0)
        if order.get("rejected", 0) > 0:
            order["rejected"] -= 1
            names = [f"no_{name}" for name in names]
        time.sleep(order.pop("late_s", 0.0))
        self._names[:] = names
        self.motion.send(plan, stop=stop)
        self._names[:] = ARM.joint_names

    def _stop(self, why: str) -> None:
        plan = self.mover.stop(self._steady.now_s())
        if plan is None:
            self._say("refused", why=f"nothing to stop: {why}")
            return
        self._stops = {"why": why, "planned_s": plan.duration_s}
        self._say("stops", **self._stops)
        self._send(plan, stop=True)

    def _reported(self, report: MotionReport) -> None:
        self.mover.reported(report)
        self._tick()

    def _tick(self) -> None:
        mover, now_s = self.mover, self._steady.now_s()
        mover.watch.silence.look(now_s)
        stopping = mover.stopping
        if (plan := stopping.look(mover.watch, now_s)) is not None:
            self._send(plan, stop=True)
        if self._stops is not None and not stopping.under_way:
            how = {"sent": stopping.sent, "failed": stopping.failed}
            self._say("stood", **how, **self._stops)
            self._stops = None
        try:
            mover.require_sane(now_s)
        except FaultError as error:
            self._stop(str(error))
        if self._going and (q := mover.watch.resting(REST_S)) is not None:
            self._go(q)
        if mover.arrived(now_s):
            self._say("arrived", way=self.motion.way)


if __name__ == "__main__":
    run(OwnMotions)
