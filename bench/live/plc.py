# SPDX-License-Identifier: Apache-2.0
"""The PLC's bridge: heartbeat, programme, maintenance's services, and the correction's node
(/joint_correction_node/status and enable). Nothing else.

What it knows of the cell it has from these and from ``accuracy_state``, as a PLC does. `Judge`
listens to the simulator's truth, for judging alone.
"""

import json
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from rclpy.exceptions import InvalidHandle
from robocal_msgs.msg import AccuracyState, CorrectionStatus, GapOpen, MaintenanceStatus
from robocal_msgs.srv import GetMaintenance, RunMaintenanceCycle
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.cell_samples import programme
from bench.live.cell import PROGRAM, ROBOT, TRUTH
from bench.live.graph import CellController, LiveError
from robocal_ros.cell_sim.cell import poses
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints

BEAT_S = 0.05  # a PLC's program goes round many times for each beat
GAP_S = 120.0  # an upper bound; the robot is taken back as soon as it is free
START_S = 120.0  # of all nodes, on a machine with much else to do
ASK_S = 0.2  # between two calls of ~/status
LEAD = 4  # rests at home, a second each: after a gap the offset grows there, by 2 deg/s
EACH = 9  # of the cell's working poses one in so many is visited
SPEED_RAD_S, REST_S = 1.8, 0.1  # as fast as the slowest drive goes: the demo is short
STATES = ("NONE", "OK", "DUE", "DEGRADED", "EXPIRED", "FAULT")  # of AccuracyState, by number


@dataclass(frozen=True)
class Gap:
    """How a gap was used: its length and what the maintenance took of it, s; its result."""

    name: str
    length_s: float
    used_s: float
    result: Any


class Plc:
    """Opens gaps, has the maintenance run in them, lets the robot produce between them."""

    def __init__(self, controller: CellController, tell: Callable[[str], None]) -> None:
        self._controller, self._tell = controller, tell
        self._is_open, self._beats = False, True
        self._gap = controller.publisher(GapOpen, "gap_open")
        self._program = controller.publisher(JointTrajectory, PROGRAM)
        self._accuracy: deque[AccuracyState] = deque(maxlen=1)
        self._correction: deque[CorrectionStatus] = deque(maxlen=1)
        controller.listen(AccuracyState, "accuracy_state", self._accuracy, endpoints.LATCHED)
        status = "/joint_correction_node/status"
        controller.listen(CorrectionStatus, status, self._correction, endpoints.LATCHED)
        self._maintenance: deque[MaintenanceStatus] = deque(maxlen=1)
        beats = "/maintenance_node/status"
        controller.listen(MaintenanceStatus, beats, self._maintenance, endpoints.LATCHED)
        self._heart = threading.Thread(target=self._beat, daemon=True)
        self._heart.start()
        self._names = list(load_robot(ROBOT).joint_names)
        home = poses("home")[0]
        way = [*[home] * LEAD, *poses("work")[::EACH], home]
        self._time, self._q, *_ = programme(home, way, SPEED_RAD_S, REST_S)

    def _beat(self) -> None:
        """As a PLC does it: whatever else goes on here."""
        while self._beats:
            with suppress(InvalidHandle):  # the graph ends
                self._gap.publish(GapOpen(open=self._is_open, echo=self._newest_beat()))
            time.sleep(BEAT_S)

    def _newest_beat(self) -> int:
        return self._maintenance[-1].beat if self._maintenance else 0

    def close(self) -> None:
        """End the heartbeat."""
        self._beats = False
        self._heart.join()

    # ---- before the shift -----------------------------------------------------------------------

    def take_over(self) -> None:
        """Wait until all nodes are there, and switch the correction on."""
        controller = self._controller
        controller.wait(lambda: self._accuracy, "accuracy_state", START_S)
        controller.wait(lambda: self._correction, "the joint correction")
        controller.wait(lambda: self._status("").state.at_home, "a robot at home")
        controller.wait(lambda: self._status("").state.disarmed, "a disarmed tcf_node")
        controller.wait(lambda: self._program.get_subscription_count() > 0, "the programme's way")
        answer = controller.call(SetBool, "/joint_correction_node/enable", data=True)
        if not answer.success:
            raise LiveError(f"the correction cannot be enabled: {answer.message}")

    def line(self) -> tuple[str, str]:
        """What the line reads now: state, and its words."""
        last = self._accuracy[-1]
        return STATES[last.state], last.reason

    # ---- production -----------------------------------------------------------------------------

    def produce(self, halfway: Callable[[], None] | None = None) -> None:
        """A pass of the programme as taught; what corrects it stands on its way to the robot."""
        message = JointTrajectory(joint_names=self._names)
        for at, q in zip(self._time, self._q, strict=True):
            zero = [0.0] * len(q)
            point = JointTrajectoryPoint(positions=q.tolist(), velocities=zero, accelerations=zero)
            seconds, rest = divmod(float(at), 1.0)
            point.time_from_start.sec = int(seconds)
            point.time_from_start.nanosec = int(rest * 1e9)
            message.points.append(point)
        refused = sum(self._correction[-1].refused) if self._correction else 0
        begin_s, end_s = time.monotonic(), float(self._time[-1])
        self._program.publish(message)
        if halfway is not None:
            self._until(begin_s + 0.5 * end_s)
            halfway()
        self._until(begin_s + end_s + REST_S)
        self._controller.wait(lambda: self._status("").state.at_home, "the robot at home")
        now = sum(self._correction[-1].refused)
        if now > refused:
            raise LiveError(f"the correction refused the programme: {self._correction[-1]}")

    def _until(self, when_s: float) -> None:
        self._controller.wait(lambda: time.monotonic() >= when_s, "the programme", 120.0)

    # ---- gaps -----------------------------------------------------------------------------------

    def gap(self, name: str, length_s: float) -> Gap:
        """A gap: let the maintenance run in it, take the robot back when it says so."""
        self._is_open, begin_s = True, time.monotonic()
        try:
            answer = self._begin(name, begin_s + length_s)
            if not answer.success:
                raise LiveError(f"{name} cannot begin: {Code(answer.status).name} {answer.message}")
            said, result = "", None
            while result is None:
                self._until(time.monotonic() + ASK_S)
                told = self._status(name)
                if told.state.doing and told.state.doing != said:
                    said = told.state.doing
                    self._tell(f"{time.monotonic() - begin_s:5.1f} s  {said}")
                if told.state.state == MaintenanceStatus.FAULT:
                    raise LiveError(f"{name}: {told.state.fault}")
                if told.result.code != Code.NONE and told.state.at_home:
                    result = told.result
            used_s = time.monotonic() - begin_s
        finally:
            self._is_open = False
        return Gap(name, length_s, used_s, result)

    def _begin(self, name: str, end_s: float) -> Any:
        """The heartbeat may not have been heard yet: a call that was refused may come again."""
        deadline, answer = time.monotonic() + 2.0, None
        while answer is None or (answer.status == Code.CONFLICT and time.monotonic() < deadline):
            self._until(time.monotonic() + ASK_S)
            left_s = end_s - time.monotonic()
            answer = self._controller.call(
                RunMaintenanceCycle, "/maintenance_node/run", cycle_id=name, gap_s=left_s
            )
        return answer

    def _status(self, name: str) -> Any:
        return self._controller.call(GetMaintenance, "/maintenance_node/status", cycle_id=name)


@dataclass(frozen=True)
class Judged:
    """True rms errors of the tool at the visited working poses, mm; not a number: not commanded.

    Attributes
    ----------
    without_mm, with_mm : as taught, without correction, and as commanded last.
    within : λ(0.1 mm) as commanded: the share of coordinates within.
    """

    without_mm: float
    with_mm: float
    within: float


class Judge:
    """Listens to the simulator's truth."""

    def __init__(self, controller: CellController) -> None:
        self._controller = controller
        self._told: deque[String] = deque(maxlen=1)
        controller.listen(String, TRUTH, self._told, endpoints.LATCHED)

    def now(self) -> Judged:
        """As of now; before anything was commanded: as taught at all working poses."""
        self._told.clear()
        self._controller.wait(lambda: self._told, "the truth")
        truth = json.loads(self._told[-1].data)
        taught = truth.get("visited_tcp_error_rms_m", truth["tcp_error_rms_m"])
        corrected = truth.get("commanded_tcp_error_rms_m", np.nan)
        return Judged(1e3 * taught, 1e3 * corrected, truth.get("commanded_within_share", np.nan))
