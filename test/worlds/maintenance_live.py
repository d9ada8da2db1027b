# SPDX-License-Identifier: Apache-2.0
"""A whole cell over DDS: robot, beams, thermal_node, tcf_node, maintenance_node; the probe is PLC
and sphere sensor. Everything is simulated."""

import threading
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from builtin_interfaces.msg import Duration
from command import robocal_json
from geometry_msgs.msg import PointStamped
from rclpy.action import ActionClient
from robocal_msgs.action import RunMaintenance
from robocal_msgs.msg import AccuracyState, GapOpen, MaintenanceStatus, SessionEvent
from robocal_msgs.srv import Acknowledge, CaptureReference
from sensor_msgs.msg import JointState
from shift import BALL, NOISE_M, T_SENSOR_BASE
from trajectory_controllers import accepted_goals
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.kinematics.arm import inverse
from robocal_ros.kinematics.robots import load_robot
from robocal_ros.motion.cell import Housing, MotionCell, ToolBody, joint_way
from robocal_ros.motion.driver import joint_trajectory
from robocal_ros.motion.plan import JointPlan, MotionLimits
from robocal_ros.motion.robot_watch import REST_RAD
from robocal_ros.ros import endpoints
from robocal_ros.ros.session_node import EVENTS

START_DEG = [2.3, -124.4, -70.9, 107.7, -91.1, 91.8]  # of cell_sim_node, over its station
RAISED_M = 0.08


def raised_home() -> list[float]:
    """Higher than the start, so that the ways from there are clear of the housing."""
    arm, q = load_robot("ur10"), np.radians(START_DEG)
    way = np.tile(arm.fk(q), (11, 1, 1))
    way[:, 2, 3] += np.linspace(0.0, RAISED_M, 11)
    return np.degrees(inverse(arm, way, q)[-1]).tolist()


HOME_DEG = raised_home()
OFFSETS_DEG = [
    [25.0, 10, 0, 0, 0, 0],
    [35.0, 10, 15, -10, 20, 15],
    [45.0, -5, 20, 15, 30, 40],
    [55.0, 15, -10, 25, 10, -30],
    [40.0, 20, 10, -25, -20, -50],
    [20.0, 5, 20, 10, 15, 60],
]
POSES_DEG = (np.array(HOME_DEG) + OFFSETS_DEG).tolist()
ROBOT = "/robot/joint_trajectory"
BEAT_S, PLC_BEAT_S = 0.1, 0.2
SENSE_S = 0.1
RESTS_S = 0.35
SERIAL = "K7"
# A machine that has other work too.
BUSY = {"motion_silence_s": 0.5, "motion_late_s": 0.6}
BUSY_TIMES = {"answer_s": 3.0, "rest_s": 2.0, "check_s": 30.0, "full_s": 60.0}


def yaml_list(numbers: Iterable[float]) -> str:
    return str([float(x) for x in numbers])


def placed_beams(folder: Path, csv: Path) -> Path:
    """The laser file of beams that a cell's own robot has placed."""
    laser = folder / "laser.yaml"
    robocal_json(
        "tool.beams.json", "tool", "beams", "--data", csv, "--radius-mm", 2.5,
        "--sigma-mm", 0.03, "--output", laser, "--robot", "ur10", "--station", "station",
    )  # fmt: skip
    return laser


def drive_to(graph: Any, topic: str, joints: list[JointState], goal: JointState, sec: int) -> None:
    """A person drives a robot, of which ``joints`` grows, to rest at other joints."""
    point = JointTrajectoryPoint(positions=goal.position, time_from_start=Duration(sec=sec))
    point.velocities = point.accelerations = [0.0] * len(goal.position)
    stood = joints[-1].position

    def near(q: Any, atol: float) -> bool:
        return np.allclose(joints[-1].position, q, rtol=0.0, atol=atol)

    message = JointTrajectory(joint_names=goal.name, points=[point])
    moves = lambda: near(goal.position, 1e-5) or not near(stood, 1e-3)  # noqa: E731
    graph.drive(topic, message, moves, subscribers=1)
    graph.spin_until(lambda: near(goal.position, 1e-5), "the robot is there")


class BeatingPlc:
    """A PLC that gives the gap: its heartbeat comes from a thread, whatever else goes on here."""

    def __init__(self, graph: Any, beat_s: float = BEAT_S) -> None:
        self.graph, self.beat_s = graph, beat_s
        self.is_open = self.beating = True
        self.statuses = graph.collect(
            MaintenanceStatus, "/maintenance_node/status", endpoints.LATCHED
        )
        self.gap = graph.probe.create_publisher(GapOpen, "gap_open", 10)
        self._ended = threading.Event()
        self._plc = threading.Thread(target=self._beats, daemon=True)
        self._plc.start()
        graph.at_close.append(self._stop_beats)

    @property
    def status(self) -> MaintenanceStatus:
        """The newest."""
        return self.statuses[-1]

    def _beats(self) -> None:
        while not self._ended.wait(self.beat_s):
            if self.beating:
                newest = self.statuses[-1:]  # which the test may clear meanwhile
                beat = newest[0].beat if newest else 0
                self.gap.publish(GapOpen(open=self.is_open, echo=beat))

    def _stop_beats(self) -> None:
        """Who publishes with a node that is being destroyed ends the process."""
        self._ended.set()
        self._plc.join()


class LiveCell(BeatingPlc):
    """All nodes as processes; time is real.

    ``busy``: with limits for a machine that has other work too; else all as it is set.
    ``listens``: tcf_node does, to ``gap_open``.
    """

    def __init__(
        self, graph: Any, folder: Path, *, busy: bool = True, listens: bool = True, **faults: Any
    ) -> None:
        super().__init__(graph, BEAT_S if busy else PLC_BEAT_S)
        self.times = BUSY_TIMES if busy else {}
        self.arm = load_robot("ur10")
        self.rng = np.random.default_rng(2)
        self.sensing = True
        self.joints: list[JointState] = []
        self.goals = accepted_goals(graph, "/cell_sim_node/follow_joint_trajectory")
        self.on_topic = graph.collect(JointTrajectory, ROBOT)
        self.states = graph.collect(AccuracyState, "/accuracy_state", endpoints.LATCHED)
        self.events = graph.collect(SessionEvent, "/maintenance_node/session_events", EVENTS)
        graph.probe.create_subscription(JointState, "joint_states", self._joints, endpoints.STREAM)
        self.sphere = graph.probe.create_publisher(PointStamped, "sphere_center", 10)
        graph.probe.create_timer(SENSE_S, self._sense)
        csv = folder / "beams.csv"
        simulated = {"laser_csv": str(csv), "seed": 7, "q_start_deg": yaml_list(HOME_DEG)} | faults
        graph.start("cell_sim_node", simulated, {"joint_trajectory": ROBOT})
        graph.spin_until(lambda: self.joints and csv.exists(), "the cell")
        self.tool = {
            "laser": str(placed_beams(folder, csv)),
            "taught_xyz_mm": "[0.0, 0.0, 150.0]",
            "serial": SERIAL,
            "gap_stale_s": 0.5,
        } | (BUSY if busy else {})
        out = {"~/joint_trajectory": ROBOT}
        own = {"motion": "trajectory"} | ({} if listens else {"gap_stale_s": 0.0})
        self.tcf = graph.start("tcf_node", self.tool | own, out)
        self.thermal = graph.start(
            "thermal_node", {"robot": "ur10", "serial": SERIAL, "sphere_radius_mm": 19.05}
        )
        self.start_maintenance()
        self.client = ActionClient(graph.probe, RunMaintenance, "/maintenance_node/run_maintenance")

    def start_maintenance(self) -> None:
        self.statuses.clear()
        self.states.clear()
        settings = (
            self.tool
            | self.times
            | {
                "home_deg": yaml_list(HOME_DEG),
                "measuring_poses_deg": yaml_list(np.ravel(POSES_DEG).tolist()),
                "correction_silent_s": 0.0,  # nothing is produced
            }
        )
        out = {"~/joint_trajectory": ROBOT}
        self.node = self.graph.start("maintenance_node", settings, out, mortal=True)
        self.graph.spin_until(lambda: self.statuses and self.states, "the maintenance node", 30.0)
        self.graph.spin_for(1.0)

    # ---- sensor ---------------------------------------------------------------------------------

    def _joints(self, message: JointState) -> None:
        self.joints.append(message)
        del self.joints[:-500]

    def _sense(self) -> None:
        recent = self.joints[-round(RESTS_S * 125) :]
        if not self.sensing or len(recent) < 40:
            return
        q = np.array([self.in_order(message) for message in recent])
        if np.max(np.ptp(q, axis=0)) > 1e-5:
            return
        ball = (T_SENSOR_BASE @ self.arm.fk(q[-1]) @ BALL)[:3]
        message = PointStamped()
        message.header.stamp, message.header.frame_id = recent[-5].header.stamp, "sensor/ball"
        place = ball + NOISE_M * self.rng.normal(size=3)
        message.point.x, message.point.y, message.point.z = place.tolist()
        self.sphere.publish(message)

    @property
    def q(self) -> np.ndarray:
        return self.in_order(self.joints[-1])

    def in_order(self, message: JointState) -> np.ndarray:
        """Joints (n,) of the arm, rad: joint_state_broadcaster names them by alphabet."""
        return np.array(
            [message.position[list(message.name).index(n)] for n in self.arm.joint_names]
        )

    def at_home(self) -> bool:
        return bool(np.max(np.abs(self.q - np.radians(HOME_DEG))) < 1e-3)

    def stands(self, seconds: float) -> bool:
        """Whether the robot rests for so long from now."""
        self.joints.clear()
        self.graph.spin_for(seconds)
        self.graph.spin_until(lambda: len(self.joints) > 5, "readings")
        return bool(np.max(np.ptp([m.position for m in self.joints], axis=0)) < 1e-9)

    def capture_reference(self) -> None:
        """A person drives the cold robot through the poses, and back home."""
        ends = np.radians([*POSES_DEG, HOME_DEG])
        for start, end in zip(np.roll(ends, 1, axis=0), ends, strict=True):
            self.drive_between(start, end)
            self.graph.spin_for(RESTS_S + 0.8)
        # The visit home is none of the poses.
        answer = self.graph.call(CaptureReference, "/thermal_node/capture_reference")
        assert answer.success, answer.message

    def drive_between(self, start: np.ndarray, end: np.ndarray) -> None:
        """A person drives the robot on a straight joint line (n,) to (n,), rad, to its end."""
        body = ToolBody(np.eye(4), 0.1, 0.01, 0.06)
        housing = Housing(0.06, 0.03, -0.12, 0.05)
        limits = MotionLimits(tcp_speed_m_s=1.0)
        cell = MotionCell(self.arm, body, np.eye(4), housing, limits)
        plan: JointPlan = joint_way(cell, start, end)
        stood = self.q

        def near(q: np.ndarray, atol: float) -> bool:
            return np.allclose(self.q, q, rtol=0.0, atol=atol)

        self.graph.drive(
            ROBOT,
            joint_trajectory(self.arm.joint_names, *plan.points()),
            lambda: near(end, REST_RAD) or not near(stood, 10.0 * REST_RAD),
            subscribers=2,  # the robot, and `on_topic`
        )
        self.graph.spin_until(lambda: near(end, REST_RAD), "its end", plan.duration_s + 5.0)

    def drive_home(self) -> None:
        """A person does, and acknowledges what was wrong."""
        self.graph.spin_until(lambda: self.stands(0.5), "the robot rests")
        self.drive_between(self.q, np.radians(HOME_DEG))
        self.graph.spin_until(self.at_home, "at home")
        self.graph.spin_until(self._acknowledged, "it is acknowledged")

    def _acknowledged(self) -> bool:
        self.graph.spin_for(0.5)
        return bool(self.graph.call(Acknowledge, "/maintenance_node/acknowledge", by="me").success)

    # ---- calls ----------------------------------------------------------------------------------

    def begin(self, cycle_id: str, gap_s: float) -> Any:
        """Send the goal; its handle."""
        self.graph.spin_until(self.client.server_is_ready, "the action")
        goal = RunMaintenance.Goal(cycle_id=cycle_id, gap_s=gap_s)
        self.feedback: list[Any] = []
        sent = self.client.send_goal_async(goal, feedback_callback=self.feedback.append)
        return self.graph.awaited(sent, "the goal is taken")

    def measures(self, cycle_id: str, gap_s: float) -> Any:
        """Begin a cycle and let it come to the tool's first circle; its result, to wait for.

        One that a busy machine broke off at home is asked for again, under another name.
        """
        for again in range(3):
            before = len(self.goals)
            ended = self.begin(f"{cycle_id}{'+' * again}", gap_s).get_result_async()
            self.graph.spin_until(
                lambda n=before, e=ended: len(self.goals) == n + 2 or e.done(), "the first circle"
            )
            if not ended.done():
                break
        assert len(self.goals) == before + 2
        return ended

    def run(self, cycle_id: str, gap_s: float) -> Any:
        """A whole cycle by the action; its result."""
        ended = self.begin(cycle_id, gap_s).get_result_async()
        return self.graph.awaited(ended, "the result", gap_s + 5.0).result

    def timed(self, kind: type, name: str, **fields: Any) -> tuple[Any, float]:
        """The answer of a service that is discovered already, and how long it took."""
        begin = time.monotonic()
        answer = self.graph.call(kind, f"/maintenance_node/{name}", **fields)
        return answer, time.monotonic() - begin

    def state(self, state: int, words: str = "") -> AccuracyState:
        """Wait until the line reads so."""

        def there() -> bool:
            last = self.states[-1] if self.states else None
            return last is not None and last.state == state and words in last.reason

        self.graph.spin_until(there, f"accuracy_state {state}: {self.states[-1:]}")
        return self.states[-1]
