# SPDX-License-Identifier: Apache-2.0
"""What ends a motion of the program: others on the graph, a lease, a stop, deactivation. Over DDS.

The controllers are played by the test: a stream is followed at once, a trajectory as
joint_trajectory_controller does it, by cubics from where it is.
"""

import time
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticStatus
from joint_correction_live import HOME, NAMES, NODE, NOMINAL, Line, drifted, joints, model_message
from jumps import no_jump
from lifecycle_msgs.msg import Transition
from lifecycle_msgs.srv import ChangeState
from long_form import more
from rclpy.lifecycle import LifecycleNode
from robocal_msgs.msg import CorrectionStatus, MotionLease
from scipy.interpolate import CubicHermiteSpline
from sensor_msgs.msg import JointState
from std_msgs.msg import Float64
from std_srvs.srv import SetBool
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.correction.trajectories import on_its_path
from robocal_ros.kinematics.robots import load_description
from robocal_ros.ros import conversions, endpoints

pytestmark = pytest.mark.cell  # judged by time: nothing else may slow it down
PERIOD_S = 0.02  # of the joint states
RESTS_S = 0.5  # of a stream that begins: its first messages may be lost
STREAM_TICKS = 2  # a busy machine must not hold the node up for two periods of the stream
SPEED = np.array([0.6, 0.0, 0.0, 0.0, 0.0, 0.3])  # rad/s
ROBOT = load_description("kr150_r3100")
# The joint that needs longest slows down as it may, the others with it, rad/s^2.
SLOWING = SPEED[0] / np.max(SPEED / ROBOT.max_acceleration)
FASTEST = ROBOT.max_velocity[0]
# Between the instant for which something is computed and its stamp, s.
BUSY_S = 0.01
HEARD_S = 0.03  # three times what stops reckon with
OUTPUT = f"{NODE}/joint_targets"
PATH = f"{NODE}/joint_trajectory"
# A machine that is busy stops all of it now and then: what went out is judged over its own time.
PATIENT = {"joint_state_age_s": 0.5, "stream_gap_s": 0.5}


class Moving(Line):
    """A line whose robot follows a stream, or a trajectory as a controller does."""

    def __init__(self, graph: Any, process: bool = False, **parameters: Any) -> None:
        self.graph, self.at, self.rested = graph, HOME, True
        if process:
            graph.start("joint_correction_node", {"serial": "s1"} | PATIENT | parameters)
            self._connect(graph)
        else:
            super().__init__(graph, **(PATIENT | parameters))
        self.out: list[tuple[float, np.ndarray]] = []
        self.stamps: set[int] = set()  # of what the planner streamed
        self.slowed: list[tuple[float, float, float]] = []  # when, where, how fast, without it
        # The planner's own time: in this process it stalls as the node does, and jumps nowhere.
        self._stream_s: float | None = None
        self._ticks = 0
        self._spline: Any = None
        self._spline_s = 0.0
        self._late_s = 0.0  # by which this process heard a plan after it was sent
        graph.probe.create_subscription(
            JointState, OUTPUT, self._obey, endpoints.own(endpoints.RELIABLE)
        )
        graph.probe.create_subscription(
            JointTrajectory, PATH, self._hear, endpoints.own(endpoints.RELIABLE)
        )
        graph.probe.create_timer(PERIOD_S, self._tick)
        taught = graph.collect(JointState, f"{NODE}/joint_states")
        graph.spin_until(lambda: taught, "the node hears the robot")
        graph.spin_for(0.5)

    def _obey(self, message: JointState) -> None:
        self.at = np.array(message.position)
        stamp = message.header.stamp.sec * 10**9 + message.header.stamp.nanosec
        self.out.append((stamp * 1e-9, self.at))
        if stamp not in self.stamps and message.velocity:
            self.slowed.append((stamp * 1e-9, message.position[0], message.velocity[0]))

    def _hear(self, message: JointTrajectory, info: dict[str, int]) -> None:
        self._late_s = max(self._late_s, time.time() - 1e-9 * info["source_timestamp"])
        self._plan(message)

    def _plan(self, message: JointTrajectory) -> None:
        """By cubics from the stamp on; on from where it is to a first point that is ahead."""
        now = time.time()
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        begin = stamp or now
        q, qd = self._now(now)
        times = [p.time_from_start.sec + 1e-9 * p.time_from_start.nanosec for p in message.points]
        speeds = [np.array(p.velocities) if p.velocities else 0.0 * q for p in message.points]
        places = [np.array(p.positions) for p in message.points]
        if begin + times[0] > now:
            times, places, speeds = [now - begin, *times], [q, *places], [qd, *speeds]
        self._spline, self._spline_s = CubicHermiteSpline(times, places, speeds), begin

    def _now(self, now_s: float) -> tuple[np.ndarray, np.ndarray]:
        if self._spline is None:
            return np.array(self.at), np.zeros(6)
        t = min(now_s - self._spline_s, self._spline.x[-1])
        moving = t < self._spline.x[-1]
        return self._spline(t), self._spline(t, 1) if moving else np.zeros(6)

    def _tick(self) -> None:
        now = time.time()
        speed = np.zeros(6)
        if self._spline is not None:
            self.at, speed = self._now(now)
            self.out.append((now, np.array(self.at)))
        self.to_states.publish(joints(self.at, velocity=speed.tolist()))
        self._ticks += 1
        if self._stream_s is not None and not self._ticks % STREAM_TICKS:
            t, stamp = max(self._stream_s - RESTS_S, 0.0), time.time_ns()
            self._stream_s += STREAM_TICKS * PERIOD_S
            self.stamps.add(stamp)
            place = HOME + SPEED * (0.5 * t * t if t < 1.0 else t - 0.5)
            fields = {"header": conversions.header(stamp, ""), "velocity": SPEED * min(t, 1.0)}
            self.to_target.publish(joints(place, **fields))

    def streams(self) -> None:
        """Begin a stream at rest, and let it come to its speed."""
        self._stream_s, self._waits = 0.0, self.graph.waits
        moved = 0.8 * SPEED[0]
        self.graph.spin_until(lambda: self.at[0] - HOME[0] > moved, "the stream runs", 20.0)

    def drives(self, lasts_s: float = 4.0) -> None:
        """Send a trajectory, and wait until the robot is in the middle of it."""
        self._waits = self.graph.waits
        message = JointTrajectory(joint_names=NAMES)
        for seconds, way, speed in (
            (1.0, 0.5, 1.0),
            (lasts_s - 1.0, lasts_s - 1.5, 1.0),
            (lasts_s, lasts_s - 1.0, 0.0),
        ):
            point = JointTrajectoryPoint(positions=(HOME + way * SPEED).tolist())
            point.velocities = (speed * SPEED).tolist()
            point.time_from_start.sec = int(seconds)
            point.time_from_start.nanosec = round(seconds % 1 * 1e9)
            message.points.append(point)
        self.to_path.publish(message)
        self.graph.spin_until(lambda: self.at[0] - HOME[0] > 0.3, "the robot moves", 20.0)

    def comes_to_rest(self, began_s: float, within_s: float = 2.0) -> None:
        """It slows down without a step and without turning back, and stays where it is."""

        def rests() -> bool:
            lately = [q for t, q in self.out if t > time.time() - 0.3]
            places = np.array([*lately, self.at, self.at])
            return time.time() - began_s > 0.4 and np.ptp(places, axis=0).max() < 1e-6

        self.graph.spin_until(rests, "the robot stands", within_s + 8.0)
        times = np.array([t for t, _ in self.out])
        q = np.array([q[0] for _, q in self.out])
        moves = np.flatnonzero(np.diff(q) > 1e-7)
        starved_s = self.graph.starved_s(self._waits)
        assert times[moves[-1] + 1] - began_s < within_s + starved_s
        off = 0.5 * SLOWING * self._late_s**2  # by what it drove on while a plan was under way
        self._no_jump(np.diff(q) > -1e-9 - off, "nothing turns back")
        if self._spline is None:
            self._slows_down(times, q, starved_s)
            return
        q, times = q[times > began_s], times[times > began_s]
        self._no_jump(
            np.diff(q) <= 1.15 * SPEED[0] * np.diff(times) + 1e-9, "no faster than the stream"
        )
        assert q[-1] - q[0] > 0.25 * SPEED[0] ** 2 / SLOWING  # half of the way: not cut off

    def _no_jump(self, is_so: np.ndarray, words: str) -> None:
        """Never again what jumped; a robot that heard its plan late jumped itself."""
        if self._late_s > HEARD_S:
            assert np.all(is_so), f"{words}: a plan was heard {self._late_s:.3f} s late"
        no_jump(is_so, words)

    def _slows_down(self, times: np.ndarray, q: np.ndarray, starved_s: float) -> None:
        """What went out of a stream without its planner: evenly, as the joints may, to rest."""
        when, where, fast = np.array(self.slowed).T
        elapsed, passed = np.diff(when), when[1:-1] - when[0]
        assert len(when) > 3
        assert fast[-1] == 0.0
        no_jump(np.diff(fast) >= -SLOWING * (elapsed + BUSY_S), "slows down as the joints may")
        # all together: of one step the time without a core may be more than there is
        assert np.all(fast[0] - fast[1:-1] >= SLOWING * (passed - BUSY_S - starved_s))
        evenly = 0.5 * (fast[:-1] ** 2 - fast[1:] ** 2) / SLOWING
        # the last step is shorter than the time that has passed
        no_jump(np.abs(np.diff(where) - evenly) <= 1e-9, "slows down evenly")
        first = int(np.flatnonzero(times == when[0])[0])
        before = when[0] - times[first - 1] + BUSY_S
        no_jump(where[0] - q[first - 1] <= FASTEST * before, "the first step of a slow-down")
        assert self.at[0] == where[-1]

    def held(self, words: str, state: int) -> None:
        """Status and diagnostics say so, and nothing new begins."""
        told = self.told(state=state)
        assert words in told.commanders + told.lease
        self.refused(self.to_target, joints(self.at), "joint_targets")
        self.refused(self.to_path, path_of(self.at), "joint_trajectory")


def path_of(q: Any) -> JointTrajectory:
    point = JointTrajectoryPoint(positions=list(q))
    point.time_from_start.sec = 1
    return JointTrajectory(joint_names=NAMES, points=[point])


@pytest.fixture
def line(graph: Any) -> Moving:
    return Moving(graph)


def test_a_second_correction_node_by_accident_ends_the_stream(line: Moving) -> None:
    """Finding: corrected and uncorrected targets alternated, both diagnostics OK."""
    graph = line.graph
    graph.start(
        "joint_correction_node",
        {"serial": "s1", "autostart": "false"},
        {"__node": "by_accident", "~/joint_targets": OUTPUT},
    )
    change = graph.probe.create_client(ChangeState, "/by_accident/change_state")
    graph.spin_until(change.service_is_ready, "the second node", 20.0)
    graph.spin_for(0.5)
    line.streams()
    change.call_async(
        ChangeState.Request(transition=Transition(id=Transition.TRANSITION_CONFIGURE))
    )
    stamp = line.told(state=CorrectionStatus.OTHER_COMMANDER).header.stamp
    line.comes_to_rest(stamp.sec + 1e-9 * stamp.nanosec)
    line._stream_s = None
    line.held("/by_accident publishes", CorrectionStatus.OTHER_COMMANDER)
    error = line.report(DiagnosticStatus.ERROR, "/by_accident publishes")
    assert error.hardware_id == "s1"
    seen = graph.collect(CorrectionStatus, "/by_accident/status", endpoints.LATCHED)
    change.call_async(ChangeState.Request(transition=Transition(id=Transition.TRANSITION_ACTIVATE)))
    graph.spin_until(
        lambda: seen and seen[-1].state == CorrectionStatus.OTHER_COMMANDER, "the other says so"
    )
    assert f"{NODE} publishes {OUTPUT}" in seen[-1].commanders


def test_beside_the_action_nobody_publishes_the_controller_s_own_topic(graph: Any) -> None:
    """A controller takes trajectories there too, whatever a goal's correction is."""
    beside = "/arm_controller/joint_trajectory"
    action = "/arm_controller/follow_joint_trajectory"
    told = graph.collect(CorrectionStatus, f"{NODE}/status", endpoints.LATCHED)
    graph.start("joint_correction_node", {"serial": "s1", "follow_joint_trajectory": action})
    graph.spin_until(lambda: told and not told[-1].commanders, "nobody else commands", 20.0)
    stranger = graph.probe.create_publisher(JointTrajectory, beside, endpoints.RELIABLE)
    graph.spin_until(
        lambda: told[-1].state == CorrectionStatus.OTHER_COMMANDER, f"told of {beside}"
    )
    assert f"publishes {beside}" in told[-1].commanders
    graph.probe.destroy_publisher(stranger)
    graph.spin_until(lambda: not told[-1].commanders, "it has gone")


@pytest.mark.parametrize("how", ["streams", "drives"])
def test_a_lease_ends_the_programs_motion_and_is_over_when_it_is_not_renewed(
    line: Moving, how: str
) -> None:
    measuring = line.graph.other("some_name", LifecycleNode)
    lease = measuring.create_publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    controller = measuring.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    line.graph.spin_until(lambda: line.node.count_publishers(PATH) == 2, "the own node")
    getattr(line, how)()
    assert line.statuses[-1].state == CorrectionStatus.OFF  # its publisher is no stranger
    held = MotionLease(
        robot=NOMINAL.name, serial="s1", holder="/some_name", held=True, purpose="tool"
    )
    began_s = time.time()
    renewal = line.graph.probe.create_timer(0.2, lambda: lease.publish(held))
    lease.publish(held)
    line.told(state=CorrectionStatus.LEASED)
    line.comes_to_rest(began_s)
    line._stream_s = None
    line.held("/some_name: tool", CorrectionStatus.LEASED)
    line.graph.probe.destroy_timer(renewal)
    lost = "/some_name: tool: it has not renewed its lease"
    line.graph.spin_until(lambda: any(lost in s.lease for s in line.statuses), "it is told")
    line.statuses.clear()
    line.told(state=CorrectionStatus.OFF)
    line.graph.spin_for(0.5)
    count = len(line.paths)
    line.to_path.publish(path_of(line.at))
    line.wait(line.paths, count + 1)
    assert controller.get_subscription_count()


def test_a_lease_whose_holder_died_lasts_while_the_robot_moves(line: Moving) -> None:
    """Finding: after a second the program began, while the dead node's motion was driven on."""
    measuring = line.graph.other("some_name", LifecycleNode)
    lease = measuring.create_publisher(MotionLease, "motion_lease", endpoints.LATCHED)
    controller = measuring.create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    line.graph.spin_until(lambda: line.node.count_publishers(PATH) == 2, "the own node")
    line.graph.spin_until(lambda: controller.get_subscription_count() == 2, "its listeners")
    held = MotionLease(
        robot=NOMINAL.name, serial="s1", holder="/some_name", held=True, purpose="tool"
    )
    lease.publish(held)
    line.told(state=CorrectionStatus.LEASED)
    motion = path_of(HOME + 4.0 * SPEED)
    motion.points[0].time_from_start.sec = 4
    controller.publish(motion)
    line.graph.spin_until(lambda: line.at[0] > HOME[0], "the robot moves")
    began_s = time.time()
    line.report(DiagnosticStatus.ERROR, "/some_name: tool: it has not renewed its lease")
    line.statuses.clear()
    line.told(state=CorrectionStatus.OFF)
    assert time.time() - began_s > 4.9  # 4 s of motion, and a second at rest
    line.graph.spin_until(lambda: not line.statuses[-1].lease, "nobody holds it")


def test_a_dead_speed_slider_does_not_make_a_stop_go_back(line: Moving) -> None:
    """Finding: the stop ended where the robot would have been, had it been paused."""
    slider = line.graph.publisher(Float64, "speed_scaling")
    line.drives(5.0)
    for percent in (100.0, 0.0):
        line.take(Float64(data=percent), slider, "speed_scaling")
    since = line.at[0]
    line.graph.spin_until(lambda: line.at[0] - since > 1.4 * SPEED[0], "it drives on")
    began_s, count = time.time(), len(line.paths)
    line.to_path.publish(JointTrajectory(joint_names=NAMES))
    line.wait(line.paths, count + 1)
    line.comes_to_rest(began_s)


def test_a_second_driver_of_the_arm_is_told_and_one_of_a_gripper_is_not(line: Moving) -> None:
    gripper = line.graph.other("gripper")
    hand = gripper.create_publisher(JointState, "joint_states", endpoints.RELIABLE)
    sent = line.graph.probe.create_timer(
        0.02, lambda: hand.publish(JointState(name=["finger"], position=[0.01]))
    )
    line.graph.spin_for(2.0)
    assert line.statuses[-1].commanders == ""
    assert line.statuses[-1].state == CorrectionStatus.OFF
    line.graph.probe.destroy_timer(sent)
    line.graph.probe.create_timer(0.02, lambda: hand.publish(joints(HOME)))
    told = line.told(state=CorrectionStatus.OTHER_COMMANDER)
    assert "joint_a1, joint_a2" in told.commanders
    assert "/gripper" in told.commanders


@pytest.mark.parametrize("lost", [0, 2, *more(1)])
def test_a_trajectory_without_points_becomes_a_stop(line: Moving, lost: int) -> None:
    """Finding: the controller drops it with an error and drives on."""
    take, losses = line._plan, [lost]

    def plan(message: JointTrajectory) -> None:
        if not message.points:
            return  # as joint_trajectory_controller does
        if losses[0]:
            losses[0] -= 1
            return
        take(message)

    line.drives()
    line._plan = plan  # type: ignore[method-assign]
    began_s = time.time()
    count = len(line.paths)
    line.to_path.publish(JointTrajectory(joint_names=NAMES))
    line.wait(line.paths, count + 1)
    line.comes_to_rest(began_s)
    assert all(len(message.points) for message in line.paths)


@pytest.mark.parametrize("planning_s", [0.05, 0.3])
def test_a_stop_that_takes_its_time_to_be_planned_turns_nothing_back(
    line: Moving, monkeypatch: pytest.MonkeyPatch, planning_s: float
) -> None:
    """Finding: on a busy machine its first point lay where the robot had long been."""

    def slowly(*given: Any) -> Any:
        planned = on_its_path(*given)
        time.sleep(planning_s)
        return planned

    monkeypatch.setattr("robocal_ros.correction.node.on_its_path", slowly)
    line.drives()
    began_s, count = time.time(), len(line.paths)
    line.to_path.publish(JointTrajectory(joint_names=NAMES))
    line.wait(line.paths, count + 1)
    line.comes_to_rest(began_s - planning_s)  # the robot ticks in this thread, not while it plans


@pytest.mark.parametrize("how", ["streams", "drives"])
def test_a_deactivation_brings_the_robot_to_rest(graph: Any, how: str) -> None:
    """Of a process: it does nothing else meanwhile."""
    line = Moving(graph, process=True)
    getattr(line, how)()
    began_s = time.time()
    deactivate = Transition(id=Transition.TRANSITION_DEACTIVATE)
    assert graph.call(ChangeState, f"{NODE}/change_state", transition=deactivate).success
    line._stream_s = None
    line.comes_to_rest(began_s)
    activate = Transition(id=Transition.TRANSITION_ACTIVATE)
    assert graph.call(ChangeState, f"{NODE}/change_state", transition=activate).success
    graph.spin_for(0.5)
    count = len(line.paths)
    line.to_path.publish(path_of(line.at))
    line.wait(line.paths, count + 1)


def test_a_refused_target_ends_the_stream_in_order(line: Moving) -> None:
    line.streams()
    began_s = time.time()
    line._stream_s = None
    line.to_target.publish(joints([*HOME[:5], float("nan")]))
    line.comes_to_rest(began_s)
    line.graph.spin_for(0.5)
    line.to_target.publish(joints(line.at))
    count = len(line.targets)
    line.wait(line.targets, count + 1)


def test_an_enable_while_everything_is_held_says_so(line: Moving) -> None:
    line.take(model_message(drifted()), line.to_model, "kinematic_model")
    line.graph.other("planner").create_publisher(JointTrajectory, PATH, endpoints.RELIABLE)
    line.told(state=CorrectionStatus.OTHER_COMMANDER)
    answer = line.graph.call(SetBool, f"{NODE}/enable", data=True)
    assert not answer.success
    assert "nothing goes out, somebody else commands the robot: /planner" in answer.message
