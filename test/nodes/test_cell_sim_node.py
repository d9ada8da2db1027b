# SPDX-License-Identifier: Apache-2.0
"""The simulated cell over DDS, in its own time."""

import json
from array import array
from typing import Any

import numpy as np
import pytest
from builtin_interfaces.msg import Duration
from cell import KEEP_ALL
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PointStamped, TransformStamped
from rcl_interfaces.msg import Log
from rclpy.parameter import Parameter
from robocal_msgs.msg import BeamEvent, ToolStep
from sensor_msgs.msg import JointState, PointCloud2, Temperature
from std_msgs.msg import String
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from robocal_ros.cell_sim.beams import beams_of
from robocal_ros.cell_sim.cell import poses
from robocal_ros.cell_sim.node import SETTINGS, CellSimNode, laser_pose, straight_arm
from robocal_ros.estimation.sphere import SphereRule, cloud_sample
from robocal_ros.ground import frames
from robocal_ros.ros import endpoints
from robocal_ros.ros.conversions import header, transform_message
from robocal_ros.tool.files import read_beam_points
from robocal_ros.tool.laser_frame import LaserFrame, calibrate_laser
from robocal_ros.tool.run import MeasuringMotion, MeasuringPlan

DEFAULTS = {setting.name: setting.default for setting in SETTINGS}
ARM = straight_arm("ur10")
HOME = np.radians(DEFAULTS["q_start_deg"])
T_BASE_LASER = laser_pose(DEFAULTS)
EXACT = {
    "repeatability_mm": 0.0, "edge_noise_mm": 0.0, "input_jitter_ms": 0.0, "ripple": 0.0,
    "lag_ms": 0.0, "gears": False,
}  # fmt: skip
FIRST = ARM.joint_names[0]


def ns(stamp: Any) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


def in_order(message: JointState, values: Any) -> list[float]:
    """By the arm's names."""
    by_name = dict(zip(message.name, values, strict=True))
    return [by_name[name] for name in ARM.joint_names]


class Cell:
    """The node, and everything it says."""

    def __init__(self, graph: Any, **parameters: Any) -> None:
        self.graph = graph
        self.node = graph.add(CellSimNode, EXACT | parameters)
        # What a busy machine makes wait comes at once.
        self.states = graph.collect(JointState, "joint_states", KEEP_ALL)
        self.events = graph.collect(BeamEvent, "beam_events", KEEP_ALL)
        self.to_path = graph.publisher(JointTrajectory, "joint_trajectory")
        graph.spin_until(lambda: self.states, "joint states")

    def set(self, **values: Any) -> None:
        found = self.node.set_parameters([Parameter(k, value=v) for k, v in values.items()])
        assert all(result.successful for result in found), found

    def path(self, q: Any, times: Any, qd: Any = None, stamp_ns: int = 0) -> None:
        """Publish a trajectory, its joints in the opposite order."""
        qd = np.zeros(np.shape(q)) if qd is None else qd
        points = [
            JointTrajectoryPoint(
                positions=array("d", row[::-1]),
                velocities=array("d", speed[::-1]),
                time_from_start=Duration(sec=int(t), nanosec=round(t % 1 * 1e9)),
            )
            for row, speed, t in zip(np.array(q), np.array(qd), times, strict=True)
        ]
        self.to_path.publish(
            JointTrajectory(
                header=header(stamp_ns, ""), joint_names=list(ARM.joint_names)[::-1], points=points
            )
        )

    def readings(self) -> tuple[np.ndarray, np.ndarray]:
        """Stamps, and joints in the arm's order."""
        stamps = np.array([ns(m.header.stamp) for m in self.states])
        return stamps, np.array([in_order(m, m.position) for m in self.states])

    def away(self) -> float:
        """How far the first joint is from home."""
        return abs(in_order(self.states[-1], self.states[-1].position)[0] - HOME[0])

    def steps(self) -> Any:
        return self.graph.publisher(ToolStep, "next_step", endpoints.LATCHED)

    def rest(self) -> None:
        """Wait until a motion has begun and is over."""
        cell = self.node._cell
        self.graph.spin_until(lambda: cell.moving, "it moves")
        self.graph.spin_until(lambda: not cell.moving, "it stands")
        self.said()

    def said(self) -> None:
        """Wait until all that was published before now has come."""
        now_ns = self.node.now_ns()
        self.graph.spin_until(lambda: ns(self.states[-1].header.stamp) > now_ns, "what it said")


def step_message(number: int = 1, run: int = 1, **changes: Any) -> ToolStep:
    """The first circle of a run, twice as fast as usual."""
    beams = beams_of(T_BASE_LASER, np.radians(DEFAULTS["beam_angle_deg"]))
    laser = LaserFrame(np.array([p for beam in beams for p in (beam.start, beam.end)]))
    plan = MeasuringPlan("full", laser, ARM.T_flange_tool, MeasuringMotion(speed_m_s=0.1))
    step = plan.step(1)
    message = ToolStep(
        run=run, number=number, of=step.of, kind=ToolStep.CIRCLE, name=step.name,
        radius=step.radius_m, speed=step.speed_m_s, direction=1, start_angle=step.start_rad,
    )  # fmt: skip
    flange = transform_message(step.T_base_flange)
    message.flange.orientation = flange.rotation
    message.laser = transform_message(frames.transform(step.R_base_laser, np.zeros(3))).rotation
    place = message.flange.position
    place.x, place.y, place.z = step.T_base_flange[:3, 3].tolist()
    for name, value in changes.items():
        setattr(message, name, value)
    return message


def test_joint_states_come_at_their_rate_with_exact_stamps(graph):
    cell = Cell(graph, rate_hz=250.0)
    graph.spin_until(lambda: len(cell.states) > 100, "joint states")

    def age_ns() -> int:
        return int(cell.node.now_ns() - ns(cell.states[-1].header.stamp))

    graph.spin_until(lambda: 0 <= age_ns() < 500_000_000, "they are of now")
    stamps, q = cell.readings()
    assert np.max(np.abs(np.diff(stamps) - 4_000_000)) <= 1
    assert q == pytest.approx(np.tile(HOME, (len(q), 1)), abs=1e-12)
    assert list(cell.states[0].name) == sorted(ARM.joint_names)


@pytest.mark.parametrize("velocities", [True, False])
def test_a_spindle_has_a_velocity_alone(graph, velocities):
    state = Cell(graph, spindle=True, velocities=velocities).states[0]
    assert list(state.name) == sorted(state.name) == ["a_spindle", *sorted(ARM.joint_names)]
    assert np.isnan(state.position[0])
    assert in_order(state, state.position) == pytest.approx(HOME, abs=1e-12)
    assert state.velocity[0] > 0.0
    assert np.isnan(in_order(state, state.velocity)).all() == (not velocities)


def test_a_trajectory_is_followed_by_name_and_in_time(graph):
    cell = Cell(graph, velocities=True)
    start_ns = cell.node.now_ns() + 300_000_000
    far = HOME + np.array([0.1, -0.05, 0.02, 0.0, 0.03, -0.2])
    cell.path([HOME, far], [0.0, 0.5], stamp_ns=start_ns)
    graph.spin_until(lambda: cell.readings()[0][-1] > start_ns + 700_000_000, "it is there")
    stamps, q = cell.readings()
    s = np.clip((stamps - start_ns) * 1e-9 / 0.5, 0.0, 1.0)[:, None]
    wanted = HOME + s**2 * (3.0 - 2.0 * s) * (far - HOME)  # the cubic from rest to rest
    assert q == pytest.approx(wanted, abs=1e-7)  # stamps are whole ns
    moving = (s[:, 0] > 0.1) & (s[:, 0] < 0.9)
    speed = np.array([in_order(m, m.velocity) for m in cell.states])
    assert moving.sum() > 20
    assert speed[moving] == pytest.approx(
        (6.0 * s * (1.0 - s) / 0.5 * (far - HOME))[moving], abs=1e-6
    )


def test_a_trajectory_without_points_is_rejected_and_the_motion_goes_on(graph):
    cell = Cell(graph)
    logs = graph.collect(Log, "/rosout", endpoints.RELIABLE)
    cell.path([HOME + 0.5], [1.0])
    graph.spin_until(lambda: cell.away() > 0.02, "it moves")
    cell.path([], [])
    graph.spin_until(
        lambda: any(m.level == Log.ERROR and "empty trajectory" in m.msg for m in logs), "logged"
    )
    graph.spin_until(lambda: not cell.node._cell.moving, "it stands")
    cell.said()
    assert cell.readings()[1][-1] == pytest.approx(HOME + 0.5, abs=1e-12)


def test_what_it_rejects_is_counted_and_changes_nothing(graph):
    cell = Cell(graph)
    cell.path([HOME[:3]], [1.0])
    cell.to_path.publish(JointTrajectory(joint_names=["a"], points=[JointTrajectoryPoint()]))
    cell.path([HOME + 0.1], [1.0], stamp_ns=1)
    cell.path([HOME + 0.1], [1.0], qd=[HOME])
    graph.spin_until(lambda: cell.node.inputs["joint_trajectory"].invalid == 4, "four are counted")
    assert cell.node.is_active
    assert not cell.node._cell.moving


def test_drives_with_limits_refuse_a_jump(graph):
    cell = Cell(graph, limits=True)
    truths = graph.collect(String, "/cell_sim_node/truth/state", endpoints.LATCHED)
    logs = graph.collect(Log, "/rosout", endpoints.LATCHED)
    diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
    cell.path([HOME + 0.5], [2.0])
    graph.spin_until(lambda: cell.away() > 0.02, "it moves")
    cell.path([HOME + 1.5], [0.008])
    graph.spin_until(lambda: not cell.node._cell.moving, "it stands")
    cell.said()
    stamps, q = cell.readings()
    assert 0.02 < q[-1, 0] - HOME[0] < 0.5
    speeds = np.diff(q, axis=0) / (1e-9 * np.diff(stamps)[:, None])
    assert np.max(np.abs(speeds)) < 0.4 * 1.1  # peak speed: 0.375 rad/s
    graph.spin_until(lambda: truths and json.loads(truths[-1].data)["drive_faults"] == 1, "counted")
    assert json.loads(truths[-1].data)["peak_speed_share"] > 50.0
    graph.spin_until(lambda: any("drive fault: joint" in m.msg for m in logs), "logged")
    assert {m.level for m in logs if "drive fault" in m.msg} == {Log.ERROR}
    graph.spin_until(lambda: diagnosed(diagnostics, "drive fault: joint"), "diagnosed")
    cell.path([HOME], [2.0])  # what it can follow it follows
    graph.spin_until(lambda: cell.node._cell.moving, "it moves again")


def diagnosed(diagnostics: Any, words: str) -> bool:
    return any(words in status.message for array in diagnostics for status in array.status)


def test_an_announced_step_is_driven_once(graph):
    cell = Cell(graph, run_program=True, tool_bend_mm=[1.0, -0.5, 0.0])
    steps = cell.steps()
    begin_ns = cell.node.now_ns()
    steps.publish(step_message())
    cell.rest()
    assert [sum(e.beam == beam for e in cell.events) for beam in "xy"] == [4, 4]
    for beam in "xy":
        kinds = [e.edge for e in cell.events if e.beam == beam]
        assert kinds == [BeamEvent.BREAK, BeamEvent.RESTORE] * 2
    stamps = [ns(e.header.stamp) for e in cell.events]
    assert stamps == sorted(stamps)
    assert begin_ns < stamps[0] < stamps[-1] < cell.node.now_ns()
    assert {e.header.frame_id for e in cell.events} == {DEFAULTS["station"]}
    steps.publish(step_message())  # again: it was driven already
    graph.spin_for(0.3)
    assert not cell.node._cell.moving
    steps.publish(ToolStep())
    graph.spin_until(lambda: cell.node.inputs["next_step"].received == 3, "nothing is awaited")
    steps.publish(step_message())  # a run of a node that began anew
    graph.spin_until(lambda: cell.node._cell.moving, "it moves")


def test_without_run_program_steps_are_left_to_others(graph):
    cell = Cell(graph)
    assert cell.node.count_subscribers("next_step") == 0


def test_a_step_out_of_reach_is_told(graph):
    cell = Cell(graph, run_program=True)
    diagnostics = graph.collect(DiagnosticArray, "/diagnostics")
    message = step_message()
    message.flange.position.x += 3.0
    cell.steps().publish(message)
    graph.spin_until(lambda: diagnosed(diagnostics, "does not reach"), "told")
    assert cell.node.is_active


def test_a_step_that_is_no_motion_is_counted(graph):
    cell = Cell(graph, run_program=True)
    steps, heard = cell.steps(), cell.node.inputs["next_step"]
    no_motions = {"speed": 0.0}, {"kind": 7}, {"radius": float("nan")}, {"direction": 0}
    for count, changes in enumerate(no_motions, 1):
        steps.publish(step_message(**changes))
        graph.spin_until(lambda n=count: heard.invalid == n, f"{changes} is counted")
        assert not cell.node._cell.moving


@pytest.mark.parametrize(("fault", "edges"), [("lost_edge", 7), ("wrong_station", 8)])
def test_faults_begin_with_the_next_motion(graph, fault, edges):
    cell = Cell(graph, run_program=True)
    cell.set(fault=fault)
    cell.steps().publish(step_message())
    cell.rest()
    assert len(cell.events) == edges
    own = {e.header.frame_id == DEFAULTS["station"] for e in cell.events}
    assert own == {fault != "wrong_station"}


def test_joints_fall_silent_and_their_clock_stands(graph):
    cell = Cell(graph)
    cell.set(fault="joints_silent")
    count = len(cell.states)
    graph.spin_until(lambda: len(cell.states) > count + 10, "still there")
    cell.path([HOME + 0.01], [0.2])
    graph.spin_until(lambda: "joints_silent" in cell.node._cell.faults, "it moves")
    graph.spin_for(0.1)
    count = len(cell.states)
    graph.spin_for(0.2)
    assert len(cell.states) == count
    cell.set(fault="frozen_clock")
    cell.path([HOME], [0.2])
    graph.spin_until(lambda: len(cell.states) > count + 20, "back again")
    stamps, q = cell.readings()
    assert len(set(stamps[count:])) == 1
    assert np.ptp(q[count:], axis=0).max() > 1e-3  # it moves all the same
    cell.set(fault="none")
    graph.spin_until(lambda: cell.readings()[0][-1] > stamps[-1], "the clock goes on")


def test_the_truth_is_latched_and_follows_the_bend(graph):
    cell = Cell(graph, tool_bend_mm=[2.0, -1.0, 0.5])
    truths = graph.collect(TransformStamped, "/cell_sim_node/truth", endpoints.LATCHED)
    graph.spin_until(lambda: truths, "the truth")
    place = truths[0].transform.translation
    assert [place.x, place.y, place.z] == pytest.approx([0.002, -0.001, 0.1505], abs=1e-12)
    assert (truths[0].header.frame_id, truths[0].child_frame_id) == ("tool0", "true_tool")
    cell.set(tool_bend_mm=[0.0, 0.0, 0.0], tool_tilt_deg=[2.0, 0.0])
    graph.spin_for(0.1)
    assert len(truths) == 1
    cell.path([HOME], [0.1])
    graph.spin_until(lambda: len(truths) == 2, "the bent tool")
    turn = truths[1].transform.rotation
    assert turn.x == pytest.approx(np.sin(np.radians(1.0)), abs=1e-12)


def test_the_robot_places_the_beams(graph, tmp_path):
    file = tmp_path / "beams.csv"
    Cell(graph, laser_csv=str(file))
    laser = calibrate_laser(read_beam_points(file))
    # Without scatter only what the tilted beams add to cylinder and coordinates remains.
    off = frames.invert(T_BASE_LASER) @ laser.T_base_laser
    assert np.linalg.norm(off[:3, 3]) < 5e-5
    assert np.degrees(np.linalg.norm(frames.log_rotation(off[:3, :3]))) < 0.1
    assert np.degrees(laser.beam_angle_rad) == pytest.approx(DEFAULTS["beam_angle_deg"], abs=0.1)


def test_the_cell_goes_on_after_a_pause(graph):
    cell = Cell(graph)
    cell.path([HOME + 0.5], [2.0])
    graph.spin_until(lambda: cell.away() > 0.02, "it moves")
    assert cell.node.trigger_deactivate().name == "SUCCESS"
    graph.spin_for(0.3)  # what waited comes
    count = len(cell.states)
    graph.spin_for(0.3)
    assert len(cell.states) == count
    assert cell.node.trigger_activate().name == "SUCCESS"
    seen = len(cell.states)
    graph.spin_until(lambda: len(cell.states) > seen + 20, "joint states")
    stamps, q = cell.readings()
    assert np.all(np.diff(stamps) > 0)
    assert np.ptp(q[seen + 1 :], axis=0).max() < 1e-12  # it stopped


def test_what_is_live_may_change_before_the_cell_lives_and_while_it_pauses(graph):
    node = graph.add(CellSimNode, EXACT | {"autostart": False})
    assert node.trigger_configure().name == "SUCCESS"
    cell = node._cell
    for fault in ("collision", "none", "protective_stop"):
        (found,) = node.set_parameters([Parameter("fault", value=fault)])
        assert found.successful
        assert node.trigger_activate().name == "SUCCESS"
        assert [*cell.faults.sizes] == [fault] * (fault != "none")
        begun_s, now_s = cell.gate._since_s, cell.now_s
        graph.spin_until(lambda at_s=now_s: cell.now_s > at_s + 0.1, "time passes")
        assert node.trigger_deactivate().name == "SUCCESS"
    assert node.trigger_activate().name == "SUCCESS"
    assert cell.gate._since_s == begun_s  # the stop goes on, and does not begin anew


def test_joints_that_do_not_fit_the_robot_are_refused(graph):
    node = graph.add(CellSimNode, {"q_start_deg": [0.0, 1.0]})
    assert node.state == "unconfigured"


class WholeCell(Cell):
    """The cell around a KR 150."""

    def __init__(self, graph: Any, **parameters: Any) -> None:
        kinds = {
            "sphere_cloud": PointCloud2,
            "sphere_center": PointStamped,
            "reference_sphere_center": PointStamped,
            "motor_temperatures": Temperature,
            "/cell_sim_node/truth/state": String,
        }
        self.told = {topic: graph.collect(kind, topic) for topic, kind in kinds.items()}
        super().__init__(graph, cell="kr150", **parameters)
        self.to_judge = graph.publisher(JointTrajectory, "/cell_sim_node/truth/commanded")

    @property
    def names(self) -> list[str]:
        return list(self.states[0].name)

    def go(self, q: Any, time_s: float) -> None:
        """Publish a trajectory with points in the arm's own order."""
        self.to_path.publish(self.trajectory([q], time_s))

    def trajectory(self, rows: Any, time_s: float = 1.0) -> JointTrajectory:
        points = [
            JointTrajectoryPoint(
                positions=array("d", row),
                velocities=array("d", np.zeros(6)),
                time_from_start=Duration(sec=i, nanosec=round(time_s % 1 * 1e9)),
            )
            for i, row in enumerate(np.asarray(rows), start=int(time_s))
        ]
        return JointTrajectory(joint_names=self.names, points=points)

    def truth(self) -> dict[str, Any]:
        return json.loads(self.told["/cell_sim_node/truth/state"][-1].data)

    def wait_for(self, topic: str, count: int) -> None:
        self.graph.spin_until(lambda: len(self.told[topic]) >= count, topic)


def test_the_whole_cell_shows_its_spheres_and_temperatures(graph):
    cell = WholeCell(graph, cloud_points=300, gears=True)
    cell.go(poses("cycle")[0], 1.5)
    cell.wait_for("sphere_cloud", 2)
    cloud = cell.told["sphere_cloud"][0]
    ball = cloud_sample(cloud, SphereRule(0.01905))
    assert (ball.frame, ball.target) == ("sensor", "ball")
    sphere = cell.node._cell.plan.sphere
    seen_s = 1e-9 * (ball.stamp_ns - cell.node._origin_ns)  # the drives may settle still
    T = sphere.sensor.T_sensor_base @ cell.node._cell.flange(np.array([seen_s]))[0]
    centre = (T @ np.append(sphere.sensor.ball, 1.0))[:3]
    assert ball.position_m == pytest.approx(centre, abs=2e-4)
    cell.wait_for("reference_sphere_center", 1)
    floor = cell.told["reference_sphere_center"][0]
    assert floor.header.frame_id == "sensor/floor"
    assert floor.header.stamp == cloud.header.stamp
    assert [floor.point.x, floor.point.y, floor.point.z] == pytest.approx(sphere.floor, abs=1e-4)
    cell.wait_for("motor_temperatures", 12)
    named = [m.header.frame_id for m in cell.told["motor_temperatures"][:12]]
    assert named == cell.names * 2
    assert cell.told["motor_temperatures"][0].temperature == pytest.approx(22.0, abs=0.6)
    assert not cell.told["sphere_center"]


def test_centres_in_place_of_clouds(graph):
    cell = WholeCell(graph, cloud_points=0)
    cell.go(poses("cycle")[1], 1.5)
    cell.wait_for("sphere_center", 1)
    assert cell.told["sphere_center"][0].header.frame_id == "sensor/ball"
    assert not cell.told["sphere_cloud"]


def test_the_truth_says_what_is_wrong_and_by_how_much(graph):
    cell = WholeCell(graph, fault_size=3.0)
    cell.wait_for("/cell_sim_node/truth/state", 1)
    assert cell.truth()["simulated"]
    assert cell.truth()["tcp_error_rms_m"] < 1e-5
    cell.set(fault="collision")
    cell.graph.spin_until(lambda: cell.truth()["faults"], "the collision")
    assert cell.truth()["faults"] == pytest.approx({"collision": 3e-3})
    assert cell.truth()["tcp_error_rms_m"] == pytest.approx(3e-3, rel=0.05)
    work = poses("work")
    cell.to_judge.publish(cell.trajectory(work + 1e-3 * np.eye(6)[0]))
    key = "commanded_tcp_error_rms_m"
    cell.graph.spin_until(lambda: key in cell.truth(), "it is judged")
    wanted = cell.node._cell.tcp_error(work + 1e-3 * np.eye(6)[0])
    assert cell.truth()[key] == pytest.approx(np.sqrt(np.mean(np.sum(wanted**2, axis=1))), rel=0.01)
    some = np.vstack(
        [poses("home"), work[[7, 3]], poses("cycle")[:1], work[7] + 2e-3, poses("home")]
    )
    cell.to_judge.publish(cell.trajectory(some))
    wanted = np.vstack([work[7] + 2e-3, work[3]])
    error = cell.node._cell.tcp_error(wanted, np.array([7, 3]))
    two = pytest.approx(np.sqrt(np.mean(np.sum(error**2, axis=1))), rel=0.01)
    cell.graph.spin_until(lambda: cell.truth()[key] == two, "those of the working poses alone")
    taught = cell.node._cell.tcp_error(work[[7, 3]], np.array([7, 3]))
    rms = pytest.approx(np.sqrt(np.mean(np.sum(taught**2, axis=1))), rel=0.01)
    assert cell.truth()["visited_tcp_error_rms_m"] == rms
    cell.to_judge.publish(cell.trajectory(poses("cycle")))  # none of them is judged
    states = len(cell.told["/cell_sim_node/truth/state"])
    cell.wait_for("/cell_sim_node/truth/state", states + 2)
    assert cell.truth()[key] == two
    cell.set(fault="none")
    cell.graph.spin_until(lambda: not cell.truth()["faults"], "all is well again")
