# SPDX-License-Identifier: Apache-2.0
"""The PLC of the cell: it gives gaps, calls for maintenance, and lets the robot produce.

What it knows of the cell it has by its `Line`. By ROS it does what is none of its own: the
programme's trajectories, and switching the correction on. `Judge` listens to the simulator's truth,
for judging alone.
"""

import json
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from robocal_msgs.msg import CorrectionStatus, MaintenanceStatus
from sensor_msgs.msg import JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from bench.cell_samples import programme
from bench.live.cell import PROGRAM, ROBOT, TRUTH
from bench.live.graph import CellController, LiveError
from bench.live.lines import Answer, Line
from robocal_ros.cell_sim.cell import poses
from robocal_ros.ground.errors import Code
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.ros import endpoints

GAP_S = 120.0  # an upper bound; the robot is taken back as soon as it is free
START_S = 120.0  # of all nodes, on a machine with much else to do
ASK_S = 0.2  # between two looks at the cell
GIVE_UP_S, WAIT_S = 600.0, 3.0  # a gap that broke off is given again, each time after longer
LEAD = 2  # rests at home, a second each: after a gap the offset grows there, by 2 deg/s
EACH = 9  # of the cell's working poses one in so many is visited
SPEED_RAD_S, REST_S = 1.8, 0.1  # as fast as the slowest drive goes: the demo is short
BY_HAND_RAD_S, STANDS_RAD = 0.5, 1e-4
LATE_BEAT = ("gap_open is silent", "gap_open echoes")  # a fault that this machine has made
STATES = ("NONE", "OK", "DUE", "DEGRADED", "EXPIRED", "FAULT")  # of AccuracyState, by number


@dataclass(frozen=True)
class Gap:
    """How a gap was used: its length and what the maintenance took of it, s; its results.

    The last one is of the cycle that left nothing; those before it were broken off, as the gap had
    closed by its own rule.
    """

    name: str
    length_s: float
    used_s: float
    results: tuple[Any, ...]

    @property
    def result(self) -> Any:
        """As it ended."""
        return self.results[-1]


class Plc:
    """Opens gaps, has the maintenance run in them, lets the robot produce between them."""

    def __init__(self, controller: CellController, line: Line, tell: Callable[[str], None]) -> None:
        self._controller, self._line, self._tell = controller, line, tell
        self._program = controller.publisher(JointTrajectory, PROGRAM)
        self._correction: deque[CorrectionStatus] = deque(maxlen=1)
        status = "/joint_correction_node/status"
        controller.listen(CorrectionStatus, status, self._correction, endpoints.LATCHED)
        self._joints: deque[JointState] = deque(maxlen=1)
        taught = "/joint_correction_node/joint_states"
        controller.listen(JointState, taught, self._joints, endpoints.RELIABLE)
        self._names = list(load_robot(ROBOT).joint_names)
        self._home = poses("home")[0]
        self._way = [*poses("work")[::EACH], self._home]
        self._gaps = 0  # that were given

    # ---- before the shift -----------------------------------------------------------------------

    def take_over(self) -> None:
        """Wait until all nodes are there, and switch the correction on."""
        controller = self._controller
        self._line.take_over(START_S)
        controller.wait(lambda: self._correction, "the joint correction")
        controller.wait(self._at_home, "a robot at home")
        controller.wait(lambda: self._line.look().maintenance.disarmed, "a disarmed tcf_node")
        controller.wait(lambda: self._program.get_subscription_count() > 0, "the programme's way")
        answer = controller.call(SetBool, "/joint_correction_node/enable", data=True)
        if not answer.success:
            raise LiveError(f"the correction cannot be enabled: {answer.message}")

    def called_s(self) -> list[float]:
        """How long each of its calls took to the answer, s."""
        return self._line.called_s()

    def line(self) -> tuple[str, str]:
        """What the line reads now: state, and its words."""
        read = self._line.look().accuracy
        return STATES[read.state], read.reason

    def _at_home(self) -> bool:
        return bool(self._line.look().maintenance.at_home)

    # ---- production -----------------------------------------------------------------------------

    def produce(self, halfway: Callable[[], None] | None = None) -> None:
        """A pass of the programme as taught; what corrects it stands on its way to the robot."""
        lead = [self._home] * LEAD if self._gaps else []
        self._drive(self._home, [*lead, *self._way], SPEED_RAD_S, halfway)

    def _drive(
        self,
        start: np.ndarray,
        way: list[np.ndarray],
        speed_rad_s: float,
        halfway: Callable[[], None] | None = None,
    ) -> None:
        """From where the robot stands (n,) through poses (n,) to home."""
        message = JointTrajectory(joint_names=self._names)
        times, joints, *_ = programme(start, way, speed_rad_s, REST_S)
        for at, q in zip(times, joints, strict=True):
            zero = [0.0] * len(q)
            point = JointTrajectoryPoint(positions=q.tolist(), velocities=zero, accelerations=zero)
            seconds, rest = divmod(float(at), 1.0)
            point.time_from_start.sec = int(seconds)
            point.time_from_start.nanosec = int(rest * 1e9)
            message.points.append(point)
        refused = sum(self._correction[-1].refused) if self._correction else 0
        begin_s, end_s = time.monotonic(), float(times[-1])
        self._program.publish(message)
        if halfway is not None:
            self._until(begin_s + 0.5 * end_s)
            halfway()
        self._until(begin_s + end_s + REST_S)
        self._controller.wait(self._at_home, "the robot at home")
        now = sum(self._correction[-1].refused)
        if now > refused:
            raise LiveError(f"the programme: {self._correction[-1].last_refusal}")

    def _until(self, when_s: float) -> None:
        self._controller.wait(lambda: time.monotonic() >= when_s, "the programme", 120.0)

    # ---- gaps -----------------------------------------------------------------------------------

    def gap(self, name: str, length_s: float) -> Gap:
        """A gap: let the maintenance run in it, take the robot back when it says so.

        Where something is left it is given again, as on a line, when the machine may have less to
        do. It was too busy where its heartbeat came too late and the gap closed by its own rule: a
        fault where the robot moved, to which a person sees. To any other fault nobody does here.

        Raises
        ------
        LiveError
            When no cycle begins, it ends in such a fault, or something is still left after
            `GIVE_UP_S`.
        """
        begin_s, results = time.monotonic(), []
        self._gaps += 1
        while True:
            again = len(results)
            result, fault = self._cycle(name + "+" * again, length_s)
            results.append(result)
            if result.code == Code.ACCEPT and result.complete:
                return Gap(name, length_s, time.monotonic() - begin_s, tuple(results))
            if fault and not fault.startswith(LATE_BEAT):
                words = "the line waits until a person has looked and acknowledged it"
                raise LiveError(f"{name}: FAULT {Code(result.code).name}: {fault}; {words}")
            if time.monotonic() - begin_s > GIVE_UP_S:
                raise LiveError(f"{name}: {result.message}")
            self._tell(f"broken off, so again, as this computer is too busy: {result.message}")
            if fault:
                self._see_to_it()
            self._until(time.monotonic() + WAIT_S * (again + 1))

    def _cycle(self, name: str, length_s: float) -> tuple[Any, str]:
        """One cycle in a gap: its result, and the fault with which it ended."""
        self._line.is_open, begin_s = True, time.monotonic()
        try:
            answer = self._begin(name, begin_s + length_s)
            if not answer.success:
                words = f"{Code(answer.status).name} {answer.message}"
                raise LiveError(f"{name} cannot begin: {words}")
            said = ""
            while True:
                self._until(time.monotonic() + ASK_S)
                now = self._line.look().maintenance
                if now.doing and now.doing != said:
                    said = now.doing
                    self._tell(f"{time.monotonic() - begin_s:5.1f} s  {said}")
                ended = now.last.cycle_id == name and now.last.code != Code.NONE
                if ended and (now.at_home or now.state == MaintenanceStatus.FAULT):
                    return now.last, now.fault
        finally:
            self._line.is_open = False

    def _begin(self, name: str, end_s: float) -> Answer:
        """The heartbeat may not have been heard yet: a call that was refused may come again."""
        deadline, answer = time.monotonic() + 2.0, None
        while answer is None or (answer.status == Code.CONFLICT and time.monotonic() < deadline):
            self._until(time.monotonic() + ASK_S)
            answer = self._line.run(name, end_s - time.monotonic())
        return answer

    def _see_to_it(self) -> None:
        """A person looks, drives the robot home by hand and acknowledges the fault."""
        stood: list[np.ndarray] = []

        def stands() -> bool:
            self._until(time.monotonic() + ASK_S)
            here = dict(zip(self._joints[-1].name, self._joints[-1].position, strict=True))
            stood.append(np.array([here[name] for name in self._names]))
            return len(stood) > 2 and bool(np.ptp(stood[-3:], axis=0).max() < STANDS_RAD)

        self._controller.wait(stands, "a robot that stands")
        self._tell("a person drives the robot home and acknowledges the fault")
        self._drive(stood[-1], [self._home], BY_HAND_RAD_S)
        answers: list[Answer] = []

        def acknowledged() -> bool:
            self._until(time.monotonic() + ASK_S)
            answers.append(self._line.acknowledge())
            return answers[-1].success

        self._controller.wait(acknowledged, "the end of the fault")


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
